"""The detector model: mean photo-electrons to digital numbers, one function per step, in the order of the signal.

1. `smear`: light that frame-transfer and interline chips collect while charge moves.
2. PRNU and dark current scale and add to the mean; Poisson counting (`noise.count`).
3. Ionizing particles (cosmic_rays.py).
4. Full well: charge above it blooms along the column or is lost.
5. Charge-transfer loss (charge_transfer.py).
6. Column offset, read noise, nonlinearity, gain, rounding and clipping (`_read_row`).

Each step is switched off by its parameter. The noise law that follows, for a pixel that collects N electrons on
average of light and dark current together, far below the full well, is

    variance = N + read_noise^2 + reset_noise^2 + gain^2 / 12    e-^2,

the last term that of rounding to whole numbers of gain e-/DN.
"""

from collections.abc import Iterator
from contextlib import contextmanager, nullcontext
from dataclasses import replace
from functools import lru_cache
from math import hypot
from typing import Any, NamedTuple

import numba
import numpy as np
from numba import float32, int32
from numpy.random import Generator
from numpy.typing import NDArray

from skysim.camera import charge_transfer, cosmic_rays, noise
from skysim.core.jit import jit, loop
from skysim.core.random_streams import random_stream
from skysim.core.types import Bools, Singles, SourceTruth, frozen
from skysim.scene.sections.camera import (
    CameraConfig,
    DetectorConfig,
    FrameTransferConfig,
    InterlineConfig,
    Shutter,
)
from skysim.sources.photometry import snr

# Masks of the pixels to which the shutter's smear or particles add charge, for labelled frames.


SMEAR = "smear"
PARTICLES = "cosmic_ray"


class AddedCharge:
    """Masks of the pixels that gain more than threshold_e electrons in a watched step, by the step's name.

    Watching takes a copy of the frame, so a frame is watched only where its masks are wanted.
    """

    def __init__(self, threshold_e: float) -> None:
        self.threshold_e = threshold_e
        self.masks = dict[str, Bools]()

    @contextmanager
    def watch(self, name: str, electrons: NDArray) -> Iterator[None]:
        """Compare a frame of electrons before and after the body of this context changes it in place."""
        before = electrons.copy()
        yield
        np.subtract(electrons, before, out=before)
        self.masks[name] = before > self.threshold_e


ROWS = 16  # rows that share one buffer for their random numbers, and go from step to step together


@frozen
class Detector:
    """One chip: its parameters and its fixed pattern, drawn from its hardware seed.

    Attributes
    ----------
    sensitivity
        (H, W) relative sensitivity of the pixels (PRNU), mean 1
    dark_e_s
        (H, W) dark current at the chip's temperature in e-/s, with DSNU and hot pixels
    column_offset_e
        (W,) offsets of the column amplifiers in electrons
    """

    config: DetectorConfig
    shutter: Shutter
    pixel_m: float
    sensitivity: Singles
    dark_e_s: Singles
    column_offset_e: Singles

    @classmethod
    @lru_cache(maxsize=2)  # laboratories of one process often share a camera
    def from_camera(cls, camera: CameraConfig) -> "Detector":
        """Draw the fixed pattern of a camera's chip; each kind has its own random stream."""
        config = camera.detector
        shape = (camera.height_px, camera.width_px)
        # Each kind of pattern has its own stream, so that changing one leaves the others.
        prnu, dark, column = (random_stream(config.hardware_seed, key) for key in range(3))
        return cls(
            config,
            camera.shutter,
            camera.pixel_m,
            sensitivity(config, shape, prnu),
            dark_current_e_s(config, shape, dark),
            (config.column_offset_e * column.standard_normal(shape[1])).astype(np.float32),
        )


def sensitivity(config: DetectorConfig, shape: tuple[int, int], rng: Generator) -> Singles:
    """Photo-response non-uniformity (PRNU): Gaussian about 1, independent in each pixel, not below 0."""
    if config.prnu == 0:
        return np.ones(shape, np.float32)
    prnu = rng.standard_normal(shape, np.float32)
    prnu *= config.prnu
    prnu += 1
    return np.maximum(prnu, 0, out=prnu)


def dark_current_e_s(
    config: DetectorConfig, shape: tuple[int, int], rng: Generator
) -> Singles:
    """Dark current of every pixel: D = D_ref 2^((T - T_ref) / T_double), D_ref lognormal over the pixels.

    A lognormal of mean 1 and standard deviation dsnu has s^2 = ln(1 + dsnu^2) and median exp(-s^2 / 2). Hot pixels
    add an exponential of mean hot_e_s. Generation in the depletion region doubles every 6 to 8 K near room
    temperature (Janesick 2001, Scientific Charge-Coupled Devices, ch. 7).
    """
    # Lognormal DSNU of mean 1.
    dark = np.full(shape, config.dark_e_s, np.float32)
    if config.dsnu > 0 and config.dark_e_s > 0:
        s2 = np.log1p(config.dsnu**2)
        normal = rng.standard_normal(shape, np.float32)
        dark *= np.exp(np.float32(np.sqrt(s2)) * normal - np.float32(s2 / 2))
    # Hot pixels: their number is binomial, their places are random.
    hot = rng.choice(dark.size, rng.binomial(dark.size, config.hot_pixels), replace=False)
    dark.reshape(-1)[hot] += rng.exponential(config.hot_e_s, len(hot)).astype(np.float32)
    # From the reference temperature to the chip's.
    dark *= np.float32(2.0**config.doublings)
    return dark


def expose(
    light_e: NDArray,
    exposure_s: float,
    detector: Detector,
    rng: Generator,
    added: AddedCharge | None = None,
) -> NDArray:
    """Convert a frame's light to digital numbers, by steps 2 to 6 of the module. Returns (H, W) uint16.

    With noise off the frame is the expected value in digital numbers, of light_e's own type, neither rounded nor
    clipped, for tests of the steps that follow.

    Parameters
    ----------
    light_e
        (H, W) float32 mean photo-electrons of a perfect pixel, including the shutter's `smear`; overwritten
    rng
        The frame's generator. Counting, read noise and particles draw from it in turn, so a new kind of noise draws
        from `rng.spawn(1)[0]`, which leaves their numbers as they are
    added
        Receives the mask of the particles' pixels
    """
    config = detector.config
    if not config.noise:
        return expectation(light_e, exposure_s, detector)
    frame = np.empty(light_e.shape, np.uint16)
    rows = (
        light_e,
        detector.sensitivity,
        detector.dark_e_s,
        detector.column_offset_e,
        readout_constants(config, exposure_s),
        # Seeds of the rows' streams, for counting and for read noise.
        noise.seeds(rng, len(light_e)),
        noise.seeds(rng, len(light_e)),
        noise.guide(),
        frame,
    )
    # With no step between counting and read-out, one pass does both, with the same numbers.
    if not (
        config.particles
        or config.blooming == "column"
        or config.cti_parallel
        or config.cti_serial
    ):
        _convert(*rows, True, True)
        return frame
    # 2. Counting.
    _convert(*rows, True, False)
    # 3. to 5.
    collect_charge(light_e, exposure_s, detector, rng, added)
    # 6. Read-out.
    _convert(*rows, False, True)
    return frame


def collect_charge(
    charge_e: NDArray,
    exposure_s: float,
    detector: Detector,
    rng: Generator,
    added: AddedCharge | None,
) -> None:
    """Steps 3 to 5, between counting and read-out, in place."""
    config = detector.config
    # 3. Particles.
    if config.particles:
        with added.watch(PARTICLES, charge_e) if added else nullcontext():
            cosmic_rays.add_particles(
                charge_e, exposure_s, detector.pixel_m, config.particles, rng
            )
    # 4. Full well.
    if config.blooming == "column":
        charge_transfer.bloom(charge_e, config.full_well_e, config.anti_blooming)
    else:
        np.minimum(charge_e, config.full_well_e, out=charge_e)
    # 5. Transfer loss.
    if config.cti_parallel or config.cti_serial:
        charge_transfer.transfer_loss(charge_e, config.cti_parallel, config.cti_serial)


def expectation(light_e: NDArray, exposure_s: float, detector: Detector) -> NDArray:
    """Expected digital numbers without full well, nonlinearity and particles.

    DN = (PRNU light + dark t, after transfer loss, + column offset) / gain + offset.
    """
    config = detector.config
    # Expected electrons of light and dark current.
    mean_e = light_e * detector.sensitivity + detector.dark_e_s * exposure_s
    charge_transfer.transfer_loss(mean_e, config.cti_parallel, config.cti_serial)
    return (mean_e + detector.column_offset_e) / config.gain_e_dn + config.offset_dn


def smear(
    light_e: NDArray,
    exposure_s: float,
    shutter: Shutter,
    added: AddedCharge | None = None,
) -> None:
    """Step 1: add the smear of a frame-transfer or interline shutter to the light, in place. Other shutters add none.

    Rolling shutters are part of the time integral in render.py.

    Parameters
    ----------
    added
        Receives the mask of the smeared pixels
    """
    if not isinstance(shutter, FrameTransferConfig | InterlineConfig):
        return
    with added.watch(SMEAR, light_e) if added else nullcontext():
        leak = shutter.leak if isinstance(shutter, InterlineConfig) else 1.0
        charge_transfer.smear(light_e, exposure_s, shutter.row_time_s, leak)


def repel(light_e: NDArray, config: DetectorConfig) -> None:
    """Brighter-fatter effect, in place: charge q in a pixel repels what comes after it into the pixels beside it.

    The boundary of pixels with q and p moves by a (q - p) into the brighter one, which so loses a (q - p) (q + p) / 2.
    Over the four boundaries q changes by (a / 2) times the discrete Laplacian of q^2, and no charge is lost (Antilogus
    et al. 2014, JINST 9, C03048, with the nearest pixels alone). It acts on the expected charge, so that counts stay
    Poisson's; on real chips a bright flat varies less.
    """
    if config.brighter_fatter_per_e:
        import cv2  # slow to import

        held_e = np.minimum(light_e, config.full_well_e)
        flow = cv2.Laplacian(held_e * held_e, -1, borderType=cv2.BORDER_REPLICATE)
        light_e += config.brighter_fatter_per_e / 2 * flow


class ReadoutConstants(NamedTuple):
    """Detector parameters for the compiled loops, in single precision."""

    exposure_s: np.float32
    well_e: np.float32
    noise_e: np.float32
    nonlinearity_per_e: np.float32
    dn_per_e: np.float32
    offset_dn: np.float32
    top_dn: np.float32


def readout_constants(config: DetectorConfig, exposure_s: float) -> ReadoutConstants:
    """The parameters that `_mean_row` and `_read_row` need, in single precision."""
    # In the order of the fields.
    values = (
        exposure_s,
        np.inf if config.blooming == "column" else config.full_well_e,
        hypot(config.read_noise_e, config.reset_noise_e),
        config.nonlinearity / config.full_well_e,
        1 / config.gain_e_dn,
        config.offset_dn + 0.5,  # truncation after adding 0.5 rounds
        2**config.bits - 1,
    )
    return ReadoutConstants(*map(np.float32, values))


@loop
def _mean_row(row: Any, sensitivity: Any, dark_e_s: Any, constants: ReadoutConstants) -> None:
    """The expected electrons of one row, light and dark current together, in place.

    n ~ Poisson(sensitivity light + dark t): variance equal to the mean. PRNU is a pixel's relative quantum efficiency,
    so it scales the mean, and the sum of light and dark current stays a Poisson variable.
    """
    for x in range(row.size):
        # Interpolated images may be slightly negative (about 1e-6).
        row[x] = max(row[x], float32(0)) * sensitivity[x] + dark_e_s[x] * constants.exposure_s


@loop
def _read_row(
    row: Any,
    offset_e: Any,
    constants: ReadoutConstants,
    seed: Any,
    memory: noise.Scratch,
    dn_row: Any,
) -> None:
    """Convert one row's charge to digital numbers: full well, offset, noise, nonlinearity, gain, rounding, clipping.

    e  = min(n, full_well) + column offset + sigma_read z, z standard normal; no limit with blooming
    DN = round(e (1 - nonlinearity e / full_well) / gain + offset), clipped to 0 and the converter's maximum.
    """
    noise_row = memory.normals
    # z of this row.
    noise.normal(noise_row, seed, memory)
    for x in range(row.size):
        e = min(row[x], constants.well_e) + offset_e[x] + constants.noise_e * noise_row[x]
        dn = (
            e * (float32(1) - constants.nonlinearity_per_e * e) * constants.dn_per_e
            + constants.offset_dn
        )
        # offset_dn contains the 0.5 by which truncation rounds.
        dn_row[x] = np.uint16(int32(min(max(dn, float32(0)), constants.top_dn)))


@jit(parallel=True)
def _convert(
    electrons: Any,
    sensitivity: Any,
    dark_e_s: Any,
    offset_e: Any,
    constants: ReadoutConstants,
    count_seeds: Any,
    read_seeds: Any,
    guide: Any,
    frame: Any,
    counts: bool,
    reads: bool,
) -> None:
    """Count a frame's electrons in place, or read them to digital numbers, blocks of rows in parallel; or both at once.

    Both at once is faster, but only for chips on which no charge leaves its row in between. See `_mean_row`,
    `noise.count` and `_read_row`.
    """
    height, width = electrons.shape
    for block in numba.prange((height + ROWS - 1) // ROWS):
        memory = noise.scratch(width)
        rows = range(block * ROWS, min((block + 1) * ROWS, height))
        if counts:
            # The means of all rows first: long passes over memory are faster.
            for y in rows:
                _mean_row(electrons[y], sensitivity[y], dark_e_s[y], constants)
            for y in rows:
                noise.count(electrons[y], count_seeds[y], guide, memory)
        if reads:
            for y in rows:
                _read_row(electrons[y], offset_e, constants, read_seeds[y], memory, frame[y])


def saturation_dn(config: DetectorConfig) -> float:
    """The digital number from which a pixel counts as saturated.

    The lower of the full well less three sigma of the read-out noise and the converter's maximum.
    """
    # A full well reads less than this in 0.1 % of the pixels.
    well_e = config.full_well_e - 3 * hypot(config.read_noise_e, config.reset_noise_e)
    well_dn = (
        well_e * (1 - config.nonlinearity * well_e / config.full_well_e) / config.gain_e_dn
        + config.offset_dn
    )
    return float(min(max(well_dn, 0.0), 2**config.bits - 1))


def add_snr_and_saturation(
    sources: SourceTruth, light_e: NDArray, exposure_s: float, detector: Detector
) -> SourceTruth:
    """Add to the truth which sources are expected to saturate, and the signal-to-noise ratio of each.

    Both use the incident light: losses by full well or nonlinearity are not subtracted. A source is saturated if the
    expected value in its brightest pixel reaches `saturation_dn`. The SNR is that of the CCD equation (`snr`) over the
    noise-equivalent area of its image, with all other charge in its brightest pixel as background, and with the
    converter's rounding, gain / sqrt(12), added to the read noise.

    Parameters
    ----------
    light_e
        (H, W) mean photo-electrons of the whole frame, smear included, before `expose` overwrites it
    """
    config = detector.config
    x, y = sources.peak_xy.T
    # Expected charge in the brightest pixel: the source's own, and all of it.
    own_e = sources.peak_e * detector.sensitivity[y, x]
    mean_e = light_e[y, x] * detector.sensitivity[y, x] + detector.dark_e_s[y, x] * exposure_s
    read_e = mean_e * (1 - config.nonlinearity * np.minimum(mean_e / config.full_well_e, 1))
    # The relative nonlinearity is held at its value at full well, since beyond it the parabola turns down.
    is_saturated = read_e / config.gain_e_dn + config.offset_dn >= saturation_dn(config)
    # Read noise and rounding; background is what the source itself does not give.
    noise_e = np.sqrt(
        config.read_noise_e**2 + config.reset_noise_e**2 + config.gain_e_dn**2 / 12
    )
    sources_snr = snr(
        sources.electrons, sources.area_px, np.maximum(mean_e - own_e, 0), noise_e
    )
    return replace(sources, saturated=is_saturated, snr=sources_snr)
