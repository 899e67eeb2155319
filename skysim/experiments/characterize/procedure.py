"""From folders of frames to a camera: read, check, estimate, write."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np

from skysim.core.errors import InputError
from skysim.core.io import files
from skysim.experiments.characterize import checks, preset
from skysim.experiments.characterize.characterize_report import characterize_report
from skysim.experiments.characterize.frames import read_stack
from skysim.experiments.characterize.night import lens
from skysim.experiments.characterize.night.lens import Night
from skysim.experiments.characterize.sensor import sensor
from skysim.experiments.characterize.sensor.estimate import Estimate
from skysim.experiments.characterize.sensor.sensor import Sensor
from skysim.results.report import Report
from skysim.scene import loader
from skysim.scene.data_sheet.sheet import PLACEHOLDER_LENS
from skysim.scene.sections.camera import CameraConfig, GaussianPsfConfig

UNITS = {
    "gain_e_dn": "e-/DN",
    "offset_dn": "DN",
    "read_noise_e": "e-",
    "full_well_e": "e-",
    "dark_e_s": "e-/s",
    "dark_doubling_c": "K",
    "hot_e_s": "e-/s",
    "column_offset_e": "e-",
    "sigma_px": "px",
    "corner_sigma_px": "px",
    "focal_length_mm": "mm",
    "center_x_px": "px",
    "center_y_px": "px",
}


def read_camera(name: str) -> tuple[CameraConfig, dict[str, Any]]:
    """The camera of a preset, a camera file or a scene, and its raw section. Raises InputError."""
    path = loader.preset_path(name) if name in loader.list_cameras() else loader.find(name)
    camera = loader.load_camera(path, PLACEHOLDER_LENS)
    tree, files = loader.read(path)
    return camera, loader.camera_tree(path, tree, files, {})["camera"]


def measure_sensor(camera: CameraConfig, darks_folder: Path, flats_folder: Path) -> Sensor:
    """The sensor from folders of darks and flats. Raises InputError for frames that do not tell."""
    shape = (camera.height_px, camera.width_px)
    bits = camera.detector.bits
    darks = read_stack(darks_folder, shape, bits)
    checks.check_darks(darks)
    flats = read_stack(flats_folder, shape, bits)
    usable = sensor.usable_pixels(darks.levels)
    shortest = min(darks.levels, key=lambda one: one.exposure_s)
    checks.check_flats(flats, usable, float(np.median(shortest.mean_dn)))
    return sensor.characterize(darks.levels, flats.levels)


def measure_night(config: CameraConfig, raw: dict[str, Any], folder: Path, found: Sensor) -> Night:
    """The lens from a folder of night frames. Raises InputError for a camera without a lens, and as `lens` does."""
    if "focal_length" not in raw:
        raise InputError(
            "characterize.night",
            "the camera's file has no lens",
            "a camera file with focal_length, to 5 %, and f_number",
        )
    return lens.measure_night(config, folder, found.transfer, found.saturation_dn)


def write_results(
    folder: Path,
    config: CameraConfig,
    raw: dict[str, Any],
    found: Sensor,
    night: Night | None,
    name: str,
) -> tuple[dict[str, Any], Report]:
    """Write preset and report; returns the statistics, which `characterize.json` holds too, and the report."""
    path = folder / "camera.yaml"
    preset.write(path, preset.preset_text(raw, config, found, night, name))
    statistics = {
        "camera": name,
        "preset": str(path),
        "report": str(folder / "report.html"),
        "temperature_c": found.dark_temperature_c,
        "values": [row(key, one, raw["detector"].get(key)) for key, one in found.estimates.items()],
        "linearity_error": found.linearity_error,
        "flicker": found.transfer.flicker,
        "misfit": found.transfer.misfit,
        "night": night_statistics(config, night) if night else None,
        "remarks": found.remarks + (night.remarks if night else []),
    }
    files.write_text(folder / "characterize.json", files.to_json(statistics))
    report = characterize_report(statistics, config, found, night)
    report.save(folder / "report.html")
    return statistics, report


def night_statistics(config: CameraConfig, night: Night) -> dict[str, Any]:
    """Rows of the lens, and the frames and stars from which they are."""
    psf = config.psf if isinstance(config.psf, GaussianPsfConfig) else None
    rows = [
        row("sigma_px", night.size.sigma_px, psf and psf.sigma_px),
        row("corner_sigma_px", night.size.corner_sigma_px, psf and psf.corner_sigma_px),
    ]
    if night.lens:
        before = [1e3 * config.focal_length_m, *config.center_px, *config.distortion]
        found = lens.lens_estimates(config, night.lens)
        rows += [
            row(name, one, value) for (name, one), value in zip(found.items(), before, strict=True)
        ]
    return {
        "values": rows,
        "frames": night.frames,
        "identified": night.identified,
        "stars": len(night.size.used.chi2),
        "rms_px": night.lens.report.rms_px if night.lens else None,
    }


def row(key: str, one: Estimate, before: object) -> dict[str, Any]:
    """A row of the table: name, value, interval, unit, and the value of the camera's file."""
    return {
        "what": key,
        "value": one.value,
        "low": one.low,
        "high": one.high,
        "unit": UNITS.get(key, ""),
        "file": before if isinstance(before, int | float) else None,
    }


def check_folders(darks: Path | None, flats: Path | None) -> tuple[Path, Path]:
    """Both folders. Raises InputError if one is missing."""
    for name, folder, why in (
        ("darks", darks, "dark current and black level"),
        ("flats", flats, "gain and full well"),
    ):
        if folder is None:
            raise InputError(
                f"characterize.{name}",
                f"missing: without them {why} are unknown",
                f"a folder of {name}",
            )
    assert darks is not None
    assert flats is not None
    return darks, flats
