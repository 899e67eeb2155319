"""A camera preset with the measured values in place of those of the camera that the frames were taken with."""

from __future__ import annotations

import copy
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any

from skysim.core.errors import printable
from skysim.experiments.characterize.sensor.estimate import Estimate
from skysim.experiments.characterize.sensor.sensor import Sensor
from skysim.scene.data_sheet.sheet import Line, yaml_lines

DIGITS = 6
AT_LEAST_ZERO = ("nonlinearity", "hot_pixels")  # an estimate below 0 is 0


def preset_text(camera: Mapping[str, Any], sensor: Sensor, name: str) -> str:
    """The file: YAML with the source of each value. camera : raw section of the camera that was measured"""
    head = [
        f"# {printable(name)}, measured. Written by `skysim characterize`.",
        "# [M] measured, with its 95 % interval. Other values are those of the camera's file.",
    ]
    return "\n".join([*head, *yaml_lines(list(lines(camera, measured(sensor))))]) + "\n"


def measured(sensor: Sensor) -> dict[str, tuple[Any, str]]:
    """Value and comment by key of the section camera."""
    found: dict[str, tuple[Any, str]] = {}
    for key, one in sensor.estimates.items():
        value = max(one.value, 0.0) if key in AT_LEAST_ZERO or one.value < 0 else one.value
        found[f"detector.{key}"] = (rounded(value), comment(one))
    if sensor.dark_temperature_c is not None:
        found["detector.dark_temperature_c"] = (rounded(sensor.dark_temperature_c), "[M] of the darks")
    else:
        found["detector.temperature_c"] = (None, "the darks' temperature is unknown: dark_e_s is at it")
    found["detector.reset_noise_e"] = (0.0, "[M] contained in read_noise_e")
    return found


def comment(one: Estimate) -> str:
    return f"[M] {one.low:.5g} to {one.high:.5g}"


def rounded(value: float) -> float:
    """With DIGITS significant digits."""
    return float(f"{value:.{DIGITS}g}")


def lines(camera: Mapping[str, Any], found: Mapping[str, tuple[Any, str]]) -> Iterator[Line]:
    """The lines of the section with the values that were found in place of the camera's own, sections last."""
    tree = copy.deepcopy(dict(camera))
    for key, (value, _) in found.items():
        section, _, last = key.rpartition(".")
        (tree.setdefault(section, {}) if section else tree)[last] = value
    yield from section_lines(tree, "", {key: source for key, (_, source) in found.items()})


def section_lines(section: Mapping[str, Any], prefix: str, sources: Mapping[str, str]) -> Iterator[Line]:
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
