"""The detector model: mean photo-electrons to digital numbers, one function per step, in the order of the signal.

Light and shutter smear, PRNU and dark current, Poisson counting, particles, full well or blooming, transfer loss,
read noise, nonlinearity and the converter. Each step is switched off by its parameter.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from math import hypot
from typing import Any, NamedTuple

import numba
import numpy as np
from numba import float32, int32
from numpy.random import Generator
from numpy.typing import NDArray

from skysim.camera.detector import charge_transfer, cosmic_rays, noise
from skysim.core.jit import jit
from skysim.core.types import SourceTruth
from skysim.scene.camera import CameraConfig, DetectorConfig, FrameTransferConfig, InterlineConfig, Shutter
from skysim.sources.photometry import snr


@dataclass(frozen=True, slots=True)
class Detector:
    """One chip: its parameters and its fixed pattern, drawn from its hardware seed.

    sensitivity     : (H, W) relative, mean 1: PRNU
    dark_e_s        : (H, W) dark current at the chip's temperature, with DSNU and hot pixels
    column_offset_e : (W,) offsets of the column amplifiers
    """

    part: DetectorConfig
    shutter: Shutter
    pixel_m: float
    sensitivity: NDArray[np.float32]
    dark_e_s: NDArray[np.float32]
    column_offset_e: NDArray[np.float32]

    @classmethod
    def of(cls, camera: CameraConfig) -> Detector:
        """Draw the fixed pattern."""
        part, shape = camera.detector, (camera.height_px, camera.width_px)
        streams = np.random.SeedSequence(part.hardware_seed).spawn(3)
        prnu, dark, column = (np.random.default_rng(stream) for stream in streams)
        return cls(
            part,
            camera.shutter,
            camera.pixel_m,
            sensitivity(part, shape, prnu),
            dark_current_e_s(part, shape, dark),
            (part.column_offset_e * column.standard_normal(shape[1])).astype(np.float32),
        )


def sensitivity(part: DetectorConfig, shape: tuple[int, int], rng: Generator) -> NDArray[np.float32]:
    """Photo-response non-uniformity (PRNU): Gaussian about 1, independent in each pixel, not below 0."""
    if part.prnu == 0:
        return np.ones(shape, np.float32)
    spread = rng.standard_normal(shape, np.float32)
    spread *= part.prnu
    spread += 1
    return np.maximum(spread, 0, out=spread)


def dark_current_e_s(part: DetectorConfig, shape: tuple[int, int], rng: Generator) -> NDArray[np.float32]:
    """Dark current of every pixel: D = D_ref 2^((T - T_ref) / T_double), D_ref lognormal over the pixels.

    A lognormal of mean 1 and standard deviation dsnu has s^2 = ln(1 + dsnu^2) and median exp(-s^2 / 2). Hot pixels
    add an exponential of mean hot_e_s. Generation in the depletion region doubles every 6 to 8 K near room
    temperature (Janesick 2001, Scientific Charge-Coupled Devices, ch. 7).
    """
    dark = np.full(shape, part.dark_e_s, np.float32)
    if part.dsnu > 0 and part.dark_e_s > 0:
        s2 = np.log1p(part.dsnu**2)
        spread = rng.standard_normal(shape, np.float32)
        dark *= np.exp(np.float32(np.sqrt(s2)) * spread - np.float32(s2 / 2))
    hot = rng.choice(dark.size, rng.binomial(dark.size, part.hot_pixels), replace=False)
    dark.reshape(-1)[hot] += rng.exponential(part.hot_e_s, len(hot)).astype(np.float32)
    dark *= np.float32(2.0**part.doublings)
    return dark


def expose(light_e: NDArray[Any], exposure_s: float, chip: Detector, rng: Generator) -> NDArray[Any]:
    """Convert a frame's light to digital numbers. Returns (H, W) uint16.

    light_e : (H, W) float32 mean photo-electrons of a perfect pixel, including the shutter's `smear`; overwritten
    With noise off the frame is the expected value in digital numbers, of light_e's own type, neither rounded nor
    clipped, for tests of the steps that follow.
    """
    part = chip.part
    if not part.noise:
        return expectation(light_e, exposure_s, chip)
    counting, reading = noise.seeds(rng, len(light_e)), noise.seeds(rng, len(light_e))
    # With no step between counting and read-out, one fused loop does both, with the same numbers.
    if not (part.particles or part.blooming == "column" or part.cti_parallel or part.cti_serial):
        return count_and_read(light_e, exposure_s, chip, counting, reading)
    count(light_e, exposure_s, chip, counting)
    if part.particles:
        cosmic_rays.hit(light_e, exposure_s, chip.pixel_m, part.particles, rng)
    if part.blooming == "column":
        charge_transfer.bloom(light_e, part.full_well_e, part.anti_blooming)
    else:
        np.minimum(light_e, part.full_well_e, out=light_e)
    if part.cti_parallel or part.cti_serial:
        charge_transfer.transfer_loss(light_e, part.cti_parallel, part.cti_serial)
    return read_out(light_e, chip, reading)


def expectation(light_e: NDArray[Any], exposure_s: float, chip: Detector) -> NDArray[Any]:
    """Expected digital numbers without full well, nonlinearity and particles."""
    part = chip.part
    mean_e = light_e * chip.sensitivity + chip.dark_e_s * exposure_s
    charge_transfer.transfer_loss(mean_e, part.cti_parallel, part.cti_serial)
    return (mean_e + chip.column_offset_e) / part.gain_e_dn + part.offset_dn


def smear(light_e: NDArray[Any], exposure_s: float, shutter: Shutter) -> None:
    """Add the smear of a frame-transfer or interline shutter to the light (in place). Other shutters add none.

    Rolling shutters are part of the time integral in render.py.
    """
    if isinstance(shutter, FrameTransferConfig):
        charge_transfer.frame_transfer_smear(light_e, exposure_s, shutter.row_time_s)
    elif isinstance(shutter, InterlineConfig):
        charge_transfer.interline_smear(light_e, exposure_s, shutter.row_time_s, shutter.leak)


class ReadoutConstants(NamedTuple):
    """Detector parameters for the compiled loops, in single precision."""

    exposure_s: np.float32
    well_e: np.float32
    noise_e: np.float32
    bend: np.float32
    per_e: np.float32
    offset_dn: np.float32
    top_dn: np.float32


def rules(part: DetectorConfig, exposure_s: float) -> ReadoutConstants:
    """The parameters that _gather and _convert need."""
    numbers = (
        exposure_s,
        np.inf if part.blooming == "column" else part.full_well_e,
        hypot(part.read_noise_e, part.reset_noise_e),
        part.nonlinearity / part.full_well_e,
        1 / part.gain_e_dn,
        part.offset_dn + 0.5,  # truncation after adding 0.5 rounds
        2**part.bits - 1,
    )
    return ReadoutConstants(*map(np.float32, numbers))


@jit
def _gather(
    row: Any, sensitivity: Any, dark_e_s: Any, rules: ReadoutConstants, seed: Any, tables: noise.Tables
) -> None:
    """Count electrons, light and dark together: Poisson, variance equal to the mean. One row, in place.

    PRNU is a pixel's relative quantum efficiency, so it scales the mean and the sum stays a Poisson variable.
    """
    for x in range(row.size):
        # Interpolated images may be slightly negative (about 1e-6).
        row[x] = max(row[x], float32(0)) * sensitivity[x] + dark_e_s[x] * rules.exposure_s
    noise.count(row, seed, tables)


@jit
def _convert(
    row: Any, offset_e: Any, rules: ReadoutConstants, seed: Any, tables: noise.Tables, numbers: Any
) -> None:
    """Convert charge to numbers: full well, column offset and read noise, nonlinearity, gain, rounding, clipping.

    Without blooming a well holds at most its capacity. The amplifier gives e (1 - nonlinearity e / full_well);
    DN = round(that / gain + offset), clipped to the converter's bits.
    """
    random = np.empty(row.size, np.float32)
    noise.normal(random, seed, tables)
    for x in range(row.size):
        e = min(row[x], rules.well_e) + offset_e[x] + rules.noise_e * random[x]
        dn = e * (float32(1) - rules.bend * e) * rules.per_e + rules.offset_dn
        numbers[x] = np.uint16(int32(min(max(dn, float32(0)), rules.top_dn)))


def count(light_e: NDArray[Any], exposure_s: float, chip: Detector, seeds: NDArray[np.uint64]) -> None:
    """Light to electrons, in place; see _gather."""
    _count(light_e, chip.sensitivity, chip.dark_e_s, rules(chip.part, exposure_s), seeds, noise.tables())


@jit(parallel=True)
def _count(
    light_e: Any, sensitivity: Any, dark_e_s: Any, rules: ReadoutConstants, seeds: Any, tables: noise.Tables
) -> None:
    for y in numba.prange(light_e.shape[0]):
        _gather(light_e[y], sensitivity[y], dark_e_s[y], rules, seeds[y], tables)


def read_out(electrons: NDArray[Any], chip: Detector, seeds: NDArray[np.uint64]) -> NDArray[np.uint16]:
    """Electrons to digital numbers; see _convert."""
    frame = np.empty(electrons.shape, np.uint16)
    _read_out(electrons, chip.column_offset_e, rules(chip.part, 0.0), seeds, noise.tables(), frame)
    return frame


@jit(parallel=True)
def _read_out(
    electrons: Any, offset_e: Any, rules: ReadoutConstants, seeds: Any, tables: noise.Tables, frame: Any
) -> None:
    for y in numba.prange(electrons.shape[0]):
        _convert(electrons[y], offset_e, rules, seeds[y], tables, frame[y])


def count_and_read(
    light_e: NDArray[Any],
    exposure_s: float,
    chip: Detector,
    counting: NDArray[np.uint64],
    reading: NDArray[np.uint64],
) -> NDArray[np.uint16]:
    """`count` and `read_out` fused row by row: the same numbers, faster. Only if no charge leaves its
    row in between.
    """
    frame = np.empty(light_e.shape, np.uint16)
    pattern = (chip.sensitivity, chip.dark_e_s, chip.column_offset_e)
    _count_and_read(light_e, *pattern, rules(chip.part, exposure_s), counting, reading, noise.tables(), frame)
    return frame


@jit(parallel=True)
def _count_and_read(
    light_e: Any,
    sensitivity: Any,
    dark_e_s: Any,
    offset_e: Any,
    rules: ReadoutConstants,
    counting: Any,
    reading: Any,
    tables: noise.Tables,
    frame: Any,
) -> None:
    for y in numba.prange(light_e.shape[0]):
        _gather(light_e[y], sensitivity[y], dark_e_s[y], rules, counting[y], tables)
        _convert(light_e[y], offset_e, rules, reading[y], tables, frame[y])


def saturation_dn(part: DetectorConfig) -> float:
    """The digital number from which a pixel counts as saturated: full well less three sigma of the read-out noise,
    or the converter's maximum.
    """
    well_e = part.full_well_e - 3 * hypot(part.read_noise_e, part.reset_noise_e)
    well_dn = well_e * (1 - part.nonlinearity * well_e / part.full_well_e) / part.gain_e_dn + part.offset_dn
    return float(min(max(well_dn, 0.0), 2**part.bits - 1))


def add_snr_and_saturation(
    seen: SourceTruth, light_e: NDArray[Any], exposure_s: float, chip: Detector
) -> SourceTruth:
    """Which sources are expected to saturate, and the signal-to-noise ratio of each.

    light_e : (H, W) mean photo-electrons of the whole frame, smear included, before `expose` overwrites it
    Both use the incident light: losses by full well or nonlinearity are not subtracted. A source is saturated if the
    expected value in its brightest pixel reaches `saturation_dn`. The ratio is that of the CCD equation over the
    noise-equivalent area of its image, with all other charge in its brightest pixel as background, and with the
    converter's rounding added to the read noise.
    """
    part = chip.part
    x, y = seen.peak_xy.T
    own_e = seen.peak_e * chip.sensitivity[y, x]
    mean_e = light_e[y, x] * chip.sensitivity[y, x] + chip.dark_e_s[y, x] * exposure_s
    bent = mean_e * (1 - part.nonlinearity * np.minimum(mean_e / part.full_well_e, 1))
    # The relative nonlinearity is held at its value at full well, since beyond it the parabola turns down.
    full = bent / part.gain_e_dn + part.offset_dn >= saturation_dn(part)
    noise_e = np.sqrt(part.read_noise_e**2 + part.reset_noise_e**2 + part.gain_e_dn**2 / 12)
    ratio = snr(seen.electrons, seen.area_px, np.maximum(mean_e - own_e, 0), noise_e)
    return replace(seen, saturated=full, snr=ratio)
