"""Frames of a camera from image files, grouped by exposure time and temperature.

A frame's exposure time and temperature are those of its folder's `frames.csv` (columns file, exposure_s and, if known,
temperature_c), else of its FITS header (EXPTIME, CCD-TEMP), else of its name or that of a folder above it: `100ms`,
`2s`, `-5C` between other words, as in `dark_100ms_-5C_03.tif`.
"""

import math
import re
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import NamedTuple

import numpy as np
from scipy import ndimage, special

from skysim.camera import detector
from skysim.core import images
from skysim.core.errors import InputError
from skysim.core.files import atomic_file, make_folder
from skysim.core.random_streams import random_stream
from skysim.core.text import read_named_rows
from skysim.core.types import Array, Bools, Floats, median
from skysim.experiments.characterize.photon_transfer import (
    FIT_RANGE,
    Level,
    blocks,
    exposures_s,
    median_and_spread,
)
from skysim.scene.sections.camera import CameraConfig, DetectorConfig

Numbers = Array[np.uint16]  # (H, W) digital numbers of a frame
TABLE = "frames.csv"
UNITS_S = {"us": 1e-6, "ms": 1e-3, "s": 1.0}
EXPOSURE = re.compile(r"(?:^|[_\- ])(\d+(?:\.\d+)?)(us|ms|s)(?=$|[_\- ])")
TEMPERATURE = re.compile(r"(?:^|[_\- ])([-+]?\d+(?:\.\d+)?)C(?=$|[_\- ])")
# Temperatures are rounded to it: a cooled chip is held to a tenth of a degree.
TEMPERATURE_STEP_C = 0.5


class Setting(NamedTuple):
    """Exposure time, and temperature of the chip if known."""

    exposure_s: float
    temperature_c: float | None


def image_files(folder: Path) -> list[Path]:
    """The images of a folder and its subfolders by name; FITS if one name has several formats. Raises InputError."""
    found = images.best_images(folder, lambda path: not images.is_fits(path), recursive=True)
    if not found:
        raise InputError(folder, "no images", ", ".join(images.IMAGE_SUFFIXES))
    return list(found.values())


def read_frames(folder: Path) -> Iterator[tuple[Path, Setting, Numbers]]:
    """The frames of a folder. Raises InputError for a frame that cannot be used."""
    tables: dict[Path, dict[str, Setting]] = {}
    for path in image_files(folder):
        table = path.parent / TABLE
        if table not in tables:
            tables[table] = read_settings(table) if table.exists() else {}
        picture = images.read_picture(path)
        setting = frame_setting(path, folder, picture, tables[table])
        yield path, setting, raw_numbers(path, picture)


def raw_numbers(path: Path, picture: images.ViewedImage) -> Numbers:
    """The digital numbers of a frame. Raises InputError unless they are a raw monochrome frame's."""
    pixels = picture.pixels
    if pixels.ndim != 2 or picture.mosaic:
        raise InputError(
            path, "a color image", "monochrome frames, raw, of 8 to 16 bits a pixel"
        )
    if images.image_suffix(path.name) in (".jpg", ".jpeg"):
        raise InputError(path, "JPEG changes the noise", "raw frames in FITS, PNG or TIFF")
    if pixels.dtype.kind == "f" and not np.all(pixels == np.rint(pixels)):
        raise InputError(path, "numbers that are not whole, as of an average", "raw frames")
    if pixels.min() < 0 or pixels.max() > 65535:
        raise InputError(path, f"{pixels.min()} to {pixels.max()} DN", "0 to 65535")
    return pixels.astype(np.uint16)


def frame_setting(
    path: Path, root: Path, picture: images.ViewedImage, table: dict[str, Setting]
) -> Setting:
    """Exposure and temperature of a frame. Raises InputError without an exposure."""
    if path.name in table:
        return table[path.name]
    names = [images.stem_of(path), *path.relative_to(root).parts[-2::-1]]
    exposure_s = picture.exposure_s
    temperature_c = picture.temperature_c
    for name in names:
        if exposure_s is None and (hit := EXPOSURE.search(name)):
            exposure_s = float(hit[1]) * UNITS_S[hit[2]]
        if temperature_c is None and (hit := TEMPERATURE.search(name)):
            temperature_c = float(hit[1])
    if exposure_s is None or exposure_s < 0:
        raise InputError(
            path,
            "no exposure time",
            f"EXPTIME in a FITS header, a row of {TABLE} beside it (file, exposure_s, temperature_c), or a name such"
            " as dark_100ms_20C_01.png",
        )
    if temperature_c is not None:
        temperature_c = round(temperature_c / TEMPERATURE_STEP_C) * TEMPERATURE_STEP_C
    return Setting(float(f"{exposure_s:.6g}"), temperature_c)


def read_settings(path: Path) -> dict[str, Setting]:
    """Exposure and temperature by the file's name, from a CSV file. Raises InputError with one line."""
    refusal = InputError(
        path, "no exposures", "columns file, exposure_s and, if known, temperature_c"
    )
    files, numbers = read_named_rows(path, "file", ["exposure_s"], refusal, ["temperature_c"])
    if (numbers[:, 0] < 0).any():
        raise InputError(path, "an exposure below 0", "seconds, 0 or more")
    return {
        name: Setting(float(row[0]), float(row[1]) if len(row) == 2 else None)
        for name, row in zip(files, numbers, strict=True)
    }


def read_stack(folder: Path, shape: tuple[int, int], bits: int) -> list[Level]:
    """The levels of a folder's frames, by exposure. Raises InputError with one line.

    Numbers that a camera or program has shifted to the upper bits of 16 are shifted back, if all are multiples.

    Parameters
    ----------
    shape
        (height, width) of the camera's frames
    """
    levels: dict[Setting, Level] = {}
    shift = None
    for path, setting, frame in read_frames(folder):
        images.check_size(path, frame, shape)
        shift = padding_bits(frame, bits) if shift is None else shift
        numbers = np.right_shift(frame, np.uint16(shift))
        if numbers.max() >= 2**bits:
            raise InputError(
                path,
                f"{numbers.max()} DN",
                f"up to {2**bits - 1}, the {bits} bits of the camera",
            )
        level = levels.setdefault(setting, Level(*setting))
        level.add(numbers)
        level.medians.append((median(numbers), path))
    found = list(levels.values())
    check_settings(found)
    found.sort(key=lambda one: (one.exposure_s, one.temperature_c or 0.0))
    return found


def padding_bits(frame: Numbers, bits: int) -> int:
    """Number of bits by which the numbers are shifted to the left; 0 if they are within the camera's range."""
    if frame.max() < 2**bits:
        return 0
    union = int(np.bitwise_or.reduce(frame, axis=None))
    zeros = (union & -union).bit_length() - 1
    return min(zeros, 16 - bits)


def check_settings(levels: Sequence[Level]) -> None:
    """Raise InputError if an exposure has a single frame, or if only some frames have a temperature."""
    for one in levels:
        if not one.pairs:
            path = one.medians[0][1]
            raise InputError(path, f"the only frame of {describe(one)}", "2 or more, alike")
    unknown = [one for one in levels if one.temperature_c is None]
    if unknown and len(unknown) < len(levels):
        path = unknown[0].medians[0][1]
        raise InputError(
            path, "no temperature, which other frames have", "of all frames, or of none"
        )


def describe(one: Level) -> str:
    """An exposure and temperature for a message."""
    at = "" if one.temperature_c is None else f" at {one.temperature_c:g} °C"
    return f"{one.exposure_s:g} s{at}"


# Simulated darks and flats of a scene's camera, written as files to try and to test the command.


DARKS = 16  # frames at each exposure of the darks
PAIR = 2  # frames at each exposure of the flats
DARK_PARTS = (0.01, 0.3, 1.0)  # exposures of the darks over the longest one
# Least dark current in the longest dark: in squared read noises, and in electrons.
DARK_NOISES = 8.0
LEAST_DARK_E = 200.0
WARMER_C = 10.0
FLAT_S = 0.1  # exposure that saturates a flat
FLAT_PARTS = (0.02, 0.05, 0.1, 0.2, 0.3, 0.4, 0.5, 0.6, 0.66, 0.8, 0.9, 1.3, 1.5)


class PlannedFrame(NamedTuple):
    """Frames to take: kind, exposure, temperature, light in electrons per second, and number of frames."""

    kind: str
    exposure_s: float
    temperature_c: float
    light_e_s: float
    frames: int


def shots(config: DetectorConfig) -> Iterator[PlannedFrame]:
    """Darks at three exposures and two temperatures, flats in pairs from 2 to 150 % of the full well."""
    own_e_s = config.dark_e_s * 2.0**config.doublings
    wanted_e = min(
        max(DARK_NOISES * config.read_noise_e**2, LEAST_DARK_E), capacity_e(config) / 16
    )
    longest_s = float(f"{wanted_e / own_e_s:.2g}") if own_e_s > 0 else 10.0
    for temperature_c in (config.own_c, config.own_c + WARMER_C):
        for part in DARK_PARTS:
            yield PlannedFrame(
                "darks", float(f"{part * longest_s:.3g}"), temperature_c, 0.0, DARKS
            )
    for part in FLAT_PARTS:
        yield PlannedFrame(
            "flats",
            float(f"{part * FLAT_S:.3g}"),
            config.own_c,
            capacity_e(config) / FLAT_S,
            PAIR,
        )


def capacity_e(config: DetectorConfig) -> float:
    """Electrons at which a pixel or the converter is full."""
    return min(config.full_well_e, (2**config.bits - 1 - config.offset_dn) * config.gain_e_dn)


def frames_of(camera: CameraConfig, shot: PlannedFrame, seed: int) -> Iterator[Numbers]:
    """The frames of a shot by the simulated detector in uniform light."""
    at_it = camera.with_values("detector", temperature_c=shot.temperature_c)
    made = detector.Detector.from_camera(at_it)
    key = (
        int(shot.kind == "flats"),
        round(1e6 * shot.exposure_s),
        round(10 * (shot.temperature_c + 300)),
    )
    for n in range(shot.frames):
        light_e = np.full(
            (camera.height_px, camera.width_px), shot.light_e_s * shot.exposure_s, np.float32
        )
        detector.smear(light_e, max(shot.exposure_s, 1e-9), camera.shutter)
        yield detector.expose(light_e, shot.exposure_s, made, random_stream(seed, *key, n))


def write_frames(camera: CameraConfig, folder: Path, seed: int) -> Iterator[Path]:
    """Write the frames of all shots to folder/darks and folder/flats, with exposure and temperature in the headers."""
    from astropy.io import fits

    for shot in shots(camera.detector):
        parent = make_folder(folder / shot.kind)
        name = f"{shot.kind[:-1]}_{shot.exposure_s:g}s_{shot.temperature_c:g}C"
        for n, frame in enumerate(frames_of(camera, shot, seed)):
            header = fits.Header([images.TOP_DOWN_CARD])
            header["EXPTIME"] = (shot.exposure_s, "exposure [s]")
            header["CCD-TEMP"] = (shot.temperature_c, "temperature of the chip [C]")
            path = parent / f"{name}_{n:03d}.fits"
            with atomic_file(path) as temporary:
                fits.PrimaryHDU(frame, header).writeto(temporary, overwrite=True)
            yield path


def frame_count(config: DetectorConfig) -> int:
    """Number of files of `write_frames`."""
    return sum(shot.frames for shot in shots(config))


# Checks that frames are usable: darks without light, flats that are flat, and enough of both.


LEAST_LEVELS = 4  # least levels of flats below saturation: for three rates and a curvature, and one to test them
MEDIAN_SIGMAS = 0.5  # greatest difference of a dark's median from the others, in standard deviations of a pixel
MAX_ZEROS = 1e-3  # greatest fraction of a dark's pixels that are 0
BLOCK = 32  # side in pixels of the blocks whose medians show structure
# Greatest range of the blocks' medians in a dark, in standard deviations of a pixel.
MAX_DARK_RANGE = 2.0
MAX_FLAT_RANGE = 0.3  # greatest range of the light over a flat, relative to its mean
BRIGHT = 0.2  # signal, relative to the brightest flat, above which a flat must be flat
MAX_PAIR_CHANGE = 0.03  # greatest relative change of the light from frame to frame
SPOT_SIGMAS = 12.0  # standard deviations above which a pixel is bright
SPOT_PIXELS = 4  # least number of touching bright pixels of a spot
MAX_SPOTS = 3  # greatest number of spots beyond those expected by chance
# Figures of four squares that touch by sides or corners, fixed (OEIS A006770).
POLYPLETS = 110


def check_darks(folder: Path, darks: Sequence[Level]) -> None:
    """Raise InputError unless these are darks of two exposures or more, with equal medians, no structure, no stars."""
    for level in darks:
        noise_dn = math.sqrt(median(level.variance_dn2) + 1)
        middle = median([one for one, _ in level.medians])
        worst, path = max(level.medians)
        if worst - middle > max(MEDIAN_SIGMAS * noise_dn, 1.0):
            raise InputError(
                path,
                f"not dark: median {worst:g} DN, the other frames of {describe(level)} {middle:g} DN",
                "darks with the lens capped",
            )
    for level in darks:
        check_dark(folder, level)
    times = {one.exposure_s for one in darks}
    if len(times) < 2:
        only = times.pop()
        raise InputError(
            folder,
            f"darks of {only:g} s only",
            f"two exposures or more: add 4 of the shortest and 4 of {max(10 * only, 10):g} s",
        )


def check_dark(folder: Path, level: Level) -> None:
    """Raise InputError for a level of darks that is cut off at 0, has identical frames, or has structure or stars."""
    which = f"the darks of {describe(level)}"
    mean = level.mean_dn
    noise_dn = max(math.sqrt(median(level.variance_dn2)), 0.3)
    zeros = float(np.mean(mean < 1))
    if zeros > MAX_ZEROS:
        raise InputError(
            folder,
            f"{which} have {100 * zeros:.2g} % of the pixels at 0 DN",
            "a higher black level",
        )
    if not level.variance_dn2.any():
        raise InputError(
            folder, f"{which} are equal in every pixel", "frames of their own, no copies"
        )
    medians = block_medians(mean)
    allowed_dn = MAX_DARK_RANGE * noise_dn + chance_range(mean, medians)
    if (extent := float(np.ptp(medians))) > allowed_dn:
        raise InputError(
            folder,
            f"{which} are not dark: {extent:.3g} DN brighter at {extremes(medians)}",
            f"{allowed_dn:.2g} DN: cap the lens, cover the window",
        )
    # Hot pixels are single, except those that touch by chance; images of stars cover several pixels. A track of a
    # particle is in one half of the frames.
    bright = level.halves_dn.min(axis=0) > median(mean) + SPOT_SIGMAS * max(
        median_and_spread(mean)[1], noise_dn / math.sqrt(level.count)
    )
    labels, _ = ndimage.label(bright, np.ones((3, 3)))
    sizes = np.bincount(labels.ravel())[1:]
    by_chance = POLYPLETS * bright.mean() ** SPOT_PIXELS * bright.size
    if (touching := int((sizes >= SPOT_PIXELS).sum())) > MAX_SPOTS + by_chance:
        y, x = ndimage.center_of_mass(bright, labels, int(np.argmax(sizes)) + 1)
        raise InputError(
            folder,
            f"{which} are not dark: {touching} spots of {SPOT_PIXELS} pixels or more, the largest at x {x:.0f},"
            f" y {y:.0f}",
            "darks with the lens capped",
        )


def check_flats(folder: Path, flats: Sequence[Level], usable: Bools, black_dn: float) -> None:
    """Raise InputError unless these are flats of LEAST_LEVELS levels or more below saturation, flat and steady."""
    signals = np.array([float(one.mean_dn[usable].mean()) - black_dn for one in flats])
    times = exposures_s(flats)
    top = signals.max()
    below = (signals < FIT_RANGE * top) & (signals > 0.01 * top)
    if signals.min() > 0.95 * top and times.max() > 1.2 * times.min():
        raise InputError(
            folder,
            f"all saturated, at {top + black_dn:.0f} DN",
            f"{LEAST_LEVELS} levels or more below: exposures shorter than {times.min():.3g} s",
        )
    if below.sum() < LEAST_LEVELS:
        lacking = LEAST_LEVELS - int(below.sum())
        longest = float(times[signals >= top].min())
        raise InputError(
            folder,
            f"{int(below.sum())} levels from 1 to {100 * FIT_RANGE:.0f} % of the brightest",
            f"{LEAST_LEVELS} or more: add pairs at {lacking} exposures from {0.05 * longest:.2g} to"
            f" {0.6 * longest:.2g} s",
        )
    for one, signal in zip(flats, signals, strict=True):
        which = f"the flats of {describe(one)}"
        if not one.variance_dn2.any() and signal < 0.95 * top:
            raise InputError(
                folder,
                f"{which} are equal in every pixel",
                "frames of their own, no copies",
            )
        change = (
            math.sqrt(one.square_dn2 / one.pairs) / signal if signal > 0.02 * top else 0.0
        )
        if change > MAX_PAIR_CHANGE:
            raise InputError(
                folder,
                f"{which} differ by {100 * change:.2g} % from frame to frame",
                f"{100 * MAX_PAIR_CHANGE:g} %: a steady lamp, warmed up, on direct current",
            )
        if BRIGHT * top < signal < FIT_RANGE * top:
            medians = block_medians(one.mean_dn) - black_dn
            extent = float(np.ptp(medians) / medians.mean())
            if extent > MAX_FLAT_RANGE:
                raise InputError(
                    folder,
                    f"{which} are not flat: {100 * extent:.0f} % brighter at {extremes(medians)}",
                    f"{100 * MAX_FLAT_RANGE:.0f} %: an integrating sphere or a diffuser, no lens",
                )


def block_side(image: Floats) -> int:
    """Side of the blocks of `block_medians`."""
    return max(min(BLOCK, *(size // 3 for size in image.shape)), 1)


def block_medians(image: Floats) -> Floats:
    """Medians of square blocks, at most BLOCK pixels wide, and small enough that there are at least nine."""
    return np.median(blocks(image, block_side(image)), axis=(1, 3))


def chance_range(image: Floats, medians: Floats) -> float:
    """Expected range of the medians of a dark's blocks, from its pixels' own scatter and its columns'.

    Differences of pixels one above the other have the pixels' scatter s, those side by side the columns' scatter c too.
    The median of n normal numbers has the standard error sqrt(pi / 2 n) of their scatter; a block has as many columns
    as pixels on a side, and blocks above each other have the same. The range of N normal numbers is
    2 Phi^-1((N - 3/8) / (N + 1/4)) standard deviations (Blom 1958). The two are independent.
    """
    pixels, both = (
        median_and_spread(np.diff(image, axis=axis))[1] ** 2 / 2 for axis in (0, 1)
    )
    side = block_side(image)
    variance = np.pi / 2 * np.array([pixels / side**2, max(both - pixels, 0.0) / side])
    count = np.array([medians.size, medians.shape[1]])
    quantile = special.ndtri((count - 0.375) / (count + 0.25))
    return float(2 * np.sqrt(quantile**2 @ variance))


def extremes(medians: Floats) -> str:
    """The places of the brightest and of the darkest ninth of the blocks, in words."""
    rows = [np.array_split(part, 3, axis=1) for part in np.array_split(medians, 3)]
    means = [part.mean() for row in rows for part in row]

    def word(index: int) -> str:
        row, column = divmod(index, 3)
        text = f"{('top', 'middle', 'bottom')[row]} {('left', 'center', 'right')[column]}"
        return text.removeprefix("middle ") if index == 4 else text

    return f"the {word(int(np.argmax(means)))} than at the {word(int(np.argmin(means)))}"
