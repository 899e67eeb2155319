"""A scene's keys as form fields, derived from the schema: value, unit and allowed values of each."""

from __future__ import annotations

import re
from collections.abc import Iterator, Mapping
from math import isfinite, radians, tan
from pathlib import Path
from typing import Any, Literal, NamedTuple, get_args, get_origin

import yaml
from pydantic import BaseModel

from skysim.core.errors import InputError
from skysim.core.io.yaml_reader import read_yaml, set_key
from skysim.core.paths import SCENES
from skysim.core.quantities.units import SI_SUFFIX, si_unit
from skysim.scene.loader import file_names, find, load, read
from skysim.scene.scene import NAME_ALIAS, Scene
from skysim.scene.sections.motion import expand_control

# Units of bare numbers by suffix of a key.
DISPLAY_UNITS = {
    **{"deg": "deg", "arcsec": "arcsec", "px": "px", "hz": "Hz", "e": "e-", "e_s": "e-/s", "dn": "DN"},
    **{"mag": "mag", "deg_s": "deg/s", "deg_s2": "deg/s²", "rpm": "rpm", "c": "°C", "e_dn": "e-/DN"},
    **{"deg_h": "deg/h", "px_s": "px/s"},
}
UNIT_SUFFIX = re.compile(rf"_({'|'.join(sorted(DISPLAY_UNITS, key=len, reverse=True))})$")
SECTIONS = ("vehicle", "motion", "site", "light", "background", "camera", "exposure", "filter", "tracker")


class Field(NamedTuple):
    """One key of a scene.

    key   : dotted;  text: its value as YAML, from the file, or else the default
    unit  : of a bare number;  allowed_values: those of an enumeration
    is_set: whether a file sets it
    """

    key: str
    text: str
    unit: str
    allowed_values: tuple[str, ...]
    is_set: bool

    @property
    def section(self) -> str:
        first = self.key.partition(".")[0]
        return first if first in SECTIONS else "scene"


def fields(name: str, overrides: Mapping[str, str]) -> list[Field]:
    """All keys that a scene has or could have, sections in the order of the README. Raises InputError."""
    scene = load(name, overrides)
    tree = read(find(name))[0]
    form_fields = [
        item._replace(text=overrides[item.key], is_set=True) if item.key in overrides else item
        for item in section_fields(scene, tree, "")
        if item.key not in (NAME_ALIAS, "schema")
    ]
    order = ("scene", *SECTIONS)
    return sorted(form_fields, key=lambda item: order.index(item.section))


def section_fields(model: BaseModel, tree: Any, prefix: str) -> Iterator[Field]:
    """Yield the fields of a section. A list of sections is one field, as is one given by a word (`control: pid`)."""
    for name, info in type(model).model_fields.items():
        file_key = info.alias or SI_SUFFIX.sub("", name)
        key, value = f"{prefix}{file_key}", getattr(model, name)
        is_set = isinstance(tree, dict) and file_key in tree
        subtree = tree[file_key] if is_set else None
        if isinstance(value, BaseModel) and (subtree is None or isinstance(subtree, dict)):
            yield from section_fields(value, subtree, f"{key}.")
        else:
            subtree = short_path(subtree)
            text = yaml_line(subtree) if is_set else yaml_line(file_value(value, si_unit(name)))
            yield Field(key, text, display_unit(file_key), allowed_values(info.annotation), is_set)


def short_path(value: Any) -> Any:
    """Shorten the path of a shipped file to its name in scenes/."""
    return str(Path(value).relative_to(SCENES)) if isinstance(value, str) and value.startswith(str(SCENES)) else value


def display_unit(file_key: str) -> str:
    """The unit of a bare number, from the suffix of its key."""
    match = UNIT_SUFFIX.search(file_key)
    return DISPLAY_UNITS[match[1]] if match else ""


def allowed_values(annotation: Any) -> tuple[str, ...]:
    """The allowed values of a Boolean or an enumeration; () for others."""
    if annotation is bool:
        return ("true", "false")
    if get_origin(annotation) is Literal:
        return tuple(str(item) for item in get_args(annotation))
    parts = [item for item in get_args(annotation) if item is not type(None)]
    return allowed_values(parts[0]) if len(parts) == 1 and get_origin(annotation) is not tuple else ()


def file_value(value: Any, unit: str) -> Any:
    """Convert a validated value to what a file would contain: plain types, with the unit."""
    if isinstance(value, BaseModel):
        return value.model_dump(mode="json", by_alias=True)
    if isinstance(value, tuple | list):
        return [file_value(item, unit) for item in value]
    if unit and isinstance(value, float):
        return f"{value:.6g} {unit}" if isfinite(value) else "infinity"
    return value


def yaml_line(value: Any) -> str:
    """Format a value as one line of YAML; strings are returned unchanged."""
    if isinstance(value, str):
        return value
    text = yaml.safe_dump(value, default_flow_style=True, width=10_000, allow_unicode=True, sort_keys=False)
    return text.strip().removesuffix("...").strip()


def validated_scene(name: str, overrides: Mapping[str, str]) -> Scene:
    """Load the scene with the overrides. Raises InputError if it is invalid or names a file outside its folder."""
    scene = load(name, overrides)
    tree, folder = scene.model_dump(mode="json", by_alias=True), find(name).resolve().parent
    for key, name in file_names(tree):
        if not any((at / name).resolve().is_relative_to(at) for at in (folder, SCENES)):
            raise InputError(f"{key}: {name!r}: allowed: a file in the scene's own folder")
    return scene


def is_scene(path: Path) -> bool:
    """Return True if a YAML file looks like a scene: no study, with a camera or a base scene."""
    try:
        tree, _ = read_yaml(path)
    except InputError:
        return False
    return "factors" not in tree and not {"base", "camera"}.isdisjoint(tree)


FEEDBACKS = {
    "truth": "closed by the truth",
    "imu": "closed by the IMU",
    "filter": "closed by the filter",
    "": "open loop",
}


def field_override(name: str, overrides: Mapping[str, str], field_deg: float) -> dict[str, str]:
    """Override by which a scene's horizontal field of view becomes another: f = width / (2 tan(field / 2)).

    Raises InputError.
    """
    if not 0.5 <= field_deg <= 120:
        raise InputError("field: allowed: 0.5 to 120 deg")
    camera = load(name, overrides).camera
    focal_m = camera.focal_length_m / camera.focal_px * camera.width_px / 2 / tan(radians(field_deg / 2))
    return {"camera.focal_length": f"{1e3 * focal_m:.5g} mm"}


def loop_overrides(name: str, overrides: Mapping[str, str], feedback: str) -> dict[str, str]:
    """Overrides that close the loop with another feedback (a key of FEEDBACKS); "" removes controller and maneuver."""
    tree = read(find(name))[0]
    for key, value in overrides.items():
        set_key(tree, key, value)
    control = expand_control(tree.get("motion", {}).get("control"))
    if not feedback or control is None:
        return {"motion.control": "null", "motion.maneuver": "[]"}
    return {"motion.control": yaml_line(control | {"feedback": feedback})}


def save(folder: Path, name: str, base: str, overrides: Mapping[str, str], title: str) -> Path:
    """Save a new scene file that consists of a base and overrides. Raises InputError, also if the file exists."""
    from skysim.apps.gui.worker.export import base_reference, scene_yaml
    from skysim.core.io import files

    if not re.fullmatch(r"[A-Za-z0-9][\w-]{0,60}", name):
        raise InputError(f"{name!r}: allowed: letters, digits, _ and -")
    path = folder / f"{name}.yaml"
    if path.exists():
        raise InputError(f"{path.name}: file exists; allowed: another name")
    validated_scene(base, overrides)
    files.write_text(path, scene_yaml(base_reference(base, folder), dict(overrides), title))
    return path
