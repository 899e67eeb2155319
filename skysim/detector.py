"""Mean photo-electrons to digital numbers, one function a step, in the charge's own order."""

from __future__ import annotations

import numpy as np
from numpy.random import Generator
from numpy.typing import NDArray

from skysim.scene import Detector
from skysim.types import Floats


def expose(mean_e: Floats, exposure_s: float, chip: Detector, rng: Generator) -> NDArray:
    """A frame from its expectation: charge, then electronics. Returns (H, W) uint16.

    With chip.noise off the frame is the expectation itself in digital numbers: float64, neither rounded nor
    clipped, for tests of everything behind it.
    """
    charge = collect(mean_e, exposure_s, chip)
    if not chip.noise:
        return charge / chip.gain_e_dn + chip.offset_dn
    electrons = shot(charge, rng)
    saturate(electrons, chip.full_well_e)
    read(electrons, chip.read_noise_e, rng)
    return digitise(electrons, chip.gain_e_dn, chip.offset_dn, chip.bits)


def collect(mean_e: Floats, exposure_s: float, chip: Detector) -> Floats:
    """Light, sky and dark current gather in the same well."""
    return mean_e + (chip.dark_e_s + chip.sky_e_s) * exposure_s


def shot(mean_e: Floats, rng: Generator) -> Floats:
    """Electrons are counted: Poisson, variance equal to the mean."""
    return rng.poisson(mean_e).astype(np.float64)


def saturate(electrons: Floats, full_well_e: float) -> None:
    """A well holds no more than its capacity (in place)."""
    np.minimum(electrons, full_well_e, out=electrons)


def read(electrons: Floats, read_noise_e: float, rng: Generator) -> None:
    """The output amplifier adds Gaussian noise (in place)."""
    if read_noise_e > 0:
        electrons += read_noise_e * rng.standard_normal(electrons.shape)


def digitise(electrons: Floats, gain_e_dn: float, offset_dn: float, bits: int) -> NDArray[np.uint16]:
    """Gain, offset, rounding, and the converter's ends."""
    numbers = np.rint(electrons / gain_e_dn + offset_dn)
    return np.clip(numbers, 0, 2**bits - 1).astype(np.uint16)


def saturation_dn(chip: Detector) -> float:
    """The digital number from which a pixel tells nothing more: full well, less three sigma of what read-out
    adds to it, or the converter's end.
    """
    well_e = chip.full_well_e - 3 * chip.read_noise_e
    return float(min(well_e / chip.gain_e_dn + chip.offset_dn, 2**chip.bits - 1))
