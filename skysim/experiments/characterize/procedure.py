"""From folders of frames to a camera: read, check, estimate, write."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np

from skysim.core.errors import InputError
from skysim.experiments.characterize import checks, preset
from skysim.experiments.characterize.frames import read_stack
from skysim.experiments.characterize.sensor import sensor
from skysim.experiments.characterize.sensor.estimate import Estimate
from skysim.experiments.characterize.sensor.sensor import Sensor
from skysim.scene import loader
from skysim.scene.data_sheet.sheet import PLACEHOLDER_LENS
from skysim.scene.sections.camera import CameraConfig

UNITS = {
    "gain_e_dn": "e-/DN",
    "offset_dn": "DN",
    "read_noise_e": "e-",
    "full_well_e": "e-",
    "nonlinearity": "",
    "dark_e_s": "e-/s",
    "dark_doubling_c": "K",
    "dsnu": "",
    "hot_pixels": "",
    "hot_e_s": "e-/s",
    "prnu": "",
    "column_offset_e": "e-",
}


def read_camera(name: str) -> tuple[CameraConfig, dict[str, Any]]:
    """The camera of a preset, a camera file or a scene, and its raw section. Raises InputError."""
    path = loader.preset_path(name) if name in loader.list_cameras() else loader.find(name)
    camera = loader.load_camera(path, PLACEHOLDER_LENS)
    tree, files = loader.read(path)
    return camera, loader.camera_tree(path, tree, files, {})["camera"]


def measure_sensor(camera: CameraConfig, darks_folder: Path, flats_folder: Path) -> Sensor:
    """The sensor from folders of darks and flats. Raises InputError for frames that do not tell."""
    shape, bits = (camera.height_px, camera.width_px), camera.detector.bits
    darks = read_stack(darks_folder, "darks", shape, bits)
    checks.check_darks(darks)
    flats = read_stack(flats_folder, "flats", shape, bits)
    usable = sensor.usable_pixels(darks.levels)
    shortest = min(darks.levels, key=lambda one: one.exposure_s)
    checks.check_flats(flats, usable, float(np.median(shortest.mean_dn)))
    return sensor.characterize(darks.levels, flats.levels)


def write_results(folder: Path, raw: dict[str, Any], found: Sensor, name: str) -> dict[str, Any]:
    """Write the preset; returns its statistics, which `characterize.json` holds too."""
    from skysim.core.io import files

    path = folder / "camera.yaml"
    preset.write(path, preset.preset_text(raw, found, name))
    detector = raw["detector"]
    statistics = {
        "camera": name,
        "preset": str(path),
        "temperature_c": found.dark_temperature_c,
        "values": [row(key, one, detector.get(key)) for key, one in found.estimates.items()],
        "linearity_error": found.linearity_error,
        "flicker": found.transfer.flicker,
        "misfit": found.transfer.misfit,
        "remarks": found.remarks,
    }
    files.write_text(folder / "characterize.json", files.to_json(statistics))
    return statistics


def row(key: str, one: Estimate, before: object) -> dict[str, Any]:
    """A row of the table: name, value, interval, unit, and the value of the camera's file."""
    return {
        "what": key,
        "value": one.value,
        "low": one.low,
        "high": one.high,
        "unit": UNITS[key],
        "file": before if isinstance(before, int | float) else None,
    }


def check_folders(darks: Path | None, flats: Path | None) -> tuple[Path, Path]:
    """Both folders. Raises InputError if one is missing."""
    for name, folder, why in (("darks", darks, "dark current and black level"), ("flats", flats, "gain and full well")):
        if folder is None:
            raise InputError(f"--{name}: missing: without them {why} are unknown; allowed: a folder of {name}")
    assert darks is not None
    assert flats is not None
    return darks, flats
