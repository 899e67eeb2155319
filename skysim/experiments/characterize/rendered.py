"""Darks and flats as a camera of a scene would take them, written as files: to try the command, and to test it."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from skysim.camera.detector import detector
from skysim.camera.detector.detector import Detector
from skysim.core.io.files import atomic_file, make_folder
from skysim.core.random_streams import random_stream
from skysim.scene.sections.camera import CameraConfig, DetectorConfig

# frames of a dark's exposure, and of a flat's
DARKS = 16
PAIR = 2
DARK_PARTS = (0.01, 0.3, 1.0)  # exposures of the darks, of the longest
# dark current of the longest dark: squared read noises, electrons
DARK_NOISES = 8.0
LEAST_DARK_E = 200.0
WARMER_C = 10.0
FLAT_S = 0.1  # exposure that saturates a flat
FLAT_PARTS = (0.02, 0.05, 0.1, 0.2, 0.3, 0.4, 0.5, 0.6, 0.66, 0.8, 0.9, 1.3, 1.5)


class Shot(NamedTuple):
    """Frames to take: their kind, exposure, temperature, light in electrons a second, and number of frames."""

    kind: str
    exposure_s: float
    temperature_c: float
    light_e_s: float
    frames: int


def shots(config: DetectorConfig) -> Iterator[Shot]:
    """Darks at three exposures and two temperatures, flats in pairs from 2 to 150 % of the full well."""
    own_c = config.dark_temperature_c if config.temperature_c is None else config.temperature_c
    own_e_s = config.dark_e_s * 2.0**config.doublings
    wanted_e = min(max(DARK_NOISES * config.read_noise_e**2, LEAST_DARK_E), capacity_e(config) / 16)
    longest_s = float(f"{wanted_e / own_e_s:.2g}") if own_e_s > 0 else 10.0
    for temperature_c in (own_c, own_c + WARMER_C):
        for part in DARK_PARTS:
            yield Shot("darks", float(f"{part * longest_s:.3g}"), temperature_c, 0.0, DARKS)
    for part in FLAT_PARTS:
        yield Shot("flats", float(f"{part * FLAT_S:.3g}"), own_c, capacity_e(config) / FLAT_S, PAIR)


def capacity_e(config: DetectorConfig) -> float:
    """Electrons at which a pixel or the converter is full."""
    return min(config.full_well_e, (2**config.bits - 1 - config.offset_dn) * config.gain_e_dn)


def frames_of(camera: CameraConfig, shot: Shot, seed: int) -> Iterator[NDArray[np.uint16]]:
    """The frames of a shot by the simulated detector, uniform light."""
    at_it = camera.detector.model_copy(update={"temperature_c": shot.temperature_c})
    made = Detector.from_camera(camera.model_copy(update={"detector": at_it}))
    key = (
        shot.kind == "flats",
        round(1e6 * shot.exposure_s),
        round(10 * (shot.temperature_c + 300)),
    )
    for n in range(shot.frames):
        light_e = np.full(
            (camera.height_px, camera.width_px), shot.light_e_s * shot.exposure_s, np.float32
        )
        detector.smear(light_e, max(shot.exposure_s, 1e-9), camera.shutter)
        yield detector.expose(
            light_e, shot.exposure_s, made, random_stream(seed, *map(int, key), n)
        )


def write_frames(camera: CameraConfig, folder: Path, seed: int) -> Iterator[Path]:
    """Write the frames of all shots to folder/darks and folder/flats, with exposure and temperature in the headers."""
    from astropy.io import fits

    for shot in shots(camera.detector):
        parent = make_folder(folder / shot.kind)
        name = f"{shot.kind[:-1]}_{shot.exposure_s:g}s_{shot.temperature_c:g}C".replace("/", "")
        for n, frame in enumerate(frames_of(camera, shot, seed)):
            header = fits.Header()
            header["EXPTIME"] = (shot.exposure_s, "exposure [s]")
            header["CCD-TEMP"] = (shot.temperature_c, "temperature of the chip [C]")
            path = parent / f"{name}_{n:03d}.fits"
            with atomic_file(path) as temporary:
                fits.PrimaryHDU(frame, header).writeto(temporary, overwrite=True)
            yield path


def frame_count(config: DetectorConfig) -> int:
    """Number of files of `write_frames`."""
    return sum(shot.frames for shot in shots(config))
