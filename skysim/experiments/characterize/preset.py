"""A camera preset with the measured values in place of those of the camera that the frames were taken with."""

from __future__ import annotations

import copy
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any

from skysim.core.errors import printable
from skysim.experiments.characterize.night.lens import LENS, Night, lens_estimates
from skysim.experiments.characterize.sensor.estimate import Estimate
from skysim.experiments.characterize.sensor.sensor import Sensor
from skysim.scene.data_sheet.sheet import Line, yaml_lines
from skysim.scene.sections.camera import CameraConfig

DIGITS = 6
AT_LEAST_ZERO = ("nonlinearity", "hot_pixels")  # an estimate below 0 is 0


def preset_text(
    camera: Mapping[str, Any], config: CameraConfig, sensor: Sensor, night: Night | None, name: str
) -> str:
    """The file: YAML with the source of each value. camera : raw section of the camera that was measured"""
    head = [
        f"# {printable(name)}, measured. Written by `skysim characterize`.",
        "# [M] measured, with its 95 % interval. Other values are those of the camera's file.",
    ]
    found = measured(sensor) | (measured_lens(config, night) if night else {})
    return "\n".join([*head, *yaml_lines(list(lines(camera, found)))]) + "\n"


def measured(sensor: Sensor) -> dict[str, tuple[Any, str]]:
    """Value and comment by key of the section camera."""
    found: dict[str, tuple[Any, str]] = {}
    for key, one in sensor.estimates.items():
        value = max(one.value, 0.0) if key in AT_LEAST_ZERO or one.value < 0 else one.value
        found[f"detector.{key}"] = (rounded(value), comment(one))
    if sensor.dark_temperature_c is not None:
        found["detector.dark_temperature_c"] = (
            rounded(sensor.dark_temperature_c),
            "[M] of the darks",
        )
    else:
        found["detector.temperature_c"] = (
            None,
            "the darks' temperature is unknown: dark_e_s is at it",
        )
    found["detector.reset_noise_e"] = (0.0, "[M] contained in read_noise_e")
    return found


def measured_lens(config: CameraConfig, night: Night) -> dict[str, tuple[Any, str]]:
    """Value and comment by key, of the lens."""
    size = night.size
    found: dict[str, tuple[Any, str]] = {
        "psf.kind": ("gaussian", "[M]"),
        "psf.sigma_px": (rounded(size.sigma_px.value), comment(size.sigma_px)),
        "psf.corner_sigma_px": (rounded(size.corner_sigma_px.value), comment(size.corner_sigma_px)),
    }
    if night.lens is None:
        return found
    lens = lens_estimates(config, night.lens)
    focal = lens["focal_length_mm"]
    x, y, *distortion = (lens[name] for name in LENS[1:])
    points = f"{comment(x)}, {y.low:.5g} to {y.high:.5g}"
    return found | {
        "focal_length": (f"{focal.value:.7g} mm", f"[M] {focal.low:.7g} to {focal.high:.7g} mm"),
        "principal_point_px": ([rounded(x.value), rounded(y.value)], points),
        "distortion": ([rounded(one.value) for one in distortion], f"k1 {comment(distortion[0])}"),
    }


def comment(one: Estimate) -> str:
    return f"[M] {one.low:.5g} to {one.high:.5g}"


def rounded(value: float) -> float:
    """With DIGITS significant digits."""
    return float(f"{value:.{DIGITS}g}")


def lines(camera: Mapping[str, Any], found: Mapping[str, tuple[Any, str]]) -> Iterator[Line]:
    """The lines of the section with the values that were found in place of the camera's own, sections last."""
    tree = copy.deepcopy(dict(camera))
    if "psf.kind" in found:
        tree["psf"] = {}  # keys of another kind
    for key, (value, _) in found.items():
        section, _, last = key.rpartition(".")
        (tree.setdefault(section, {}) if section else tree)[last] = value
    yield from section_lines(tree, "", {key: source for key, (_, source) in found.items()})


def section_lines(
    section: Mapping[str, Any], prefix: str, sources: Mapping[str, str]
) -> Iterator[Line]:
    """The lines of a section and, after its values, of the sections in it."""
    for key, value in section.items():
        if not isinstance(value, dict):
            yield Line(prefix + key, value, sources.get(prefix + key, "of the camera's file"))
    for key, value in section.items():
        if isinstance(value, dict):
            yield from section_lines(value, f"{prefix}{key}.", sources)


def write(path: Path, contents: str) -> None:
    """Write the file and read it as a scene would. Raises InputError if it is no camera."""
    from skysim.core.io.files import make_folder, write_text
    from skysim.scene.data_sheet.sheet import PLACEHOLDER_LENS
    from skysim.scene.loader import load_camera

    make_folder(path.parent)
    write_text(path, contents)
    load_camera(path, PLACEHOLDER_LENS)
