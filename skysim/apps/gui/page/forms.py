"""A scene's keys as form fields, derived from the schema: value, unit and allowed values of each."""

from __future__ import annotations

import re
from collections.abc import Iterator, Mapping
from math import isfinite
from pathlib import Path
from typing import Any, Literal, NamedTuple, get_args, get_origin

import yaml
from pydantic import BaseModel

from skysim.core.errors import InputError
from skysim.core.paths import SCENES
from skysim.core.units import SI_SUFFIX
from skysim.core.yaml_reader import read_yaml, set_key
from skysim.scene.loader import FILES, find, load, read
from skysim.scene.motion import spelt_out
from skysim.scene.scene import STEM, Scene

UNITS = {
    **{
        "m": "m",
        "s": "s",
        "n": "N",
        "kg": "kg",
        "kg_m": "kg m",
        "kg_m2": "kg m2",
        "cd": "cd",
        "w_sr": "W/sr",
    },
    **{"nm": "N m", "nm_rad": "N m/rad", "nms": "N m s", "nms2": "N m s2"},
}
SHOWN = {
    **{
        "deg": "deg",
        "arcsec": "arcsec",
        "px": "px",
        "hz": "Hz",
        "e": "e-",
        "e_s": "e-/s",
        "dn": "DN",
        "mag": "mag",
    },
    **{
        "deg_s": "deg/s",
        "deg_s2": "deg/s²",
        "rpm": "rpm",
        "c": "°C",
        "e_dn": "e-/DN",
        "deg_h": "deg/h",
        "px_s": "px/s",
    },
}
SUFFIX = re.compile(rf"_({'|'.join(sorted(SHOWN, key=len, reverse=True))})$")
SECTIONS = ("vehicle", "motion", "lab", "light", "background", "camera", "exposure", "filter", "tracker")


class Field(NamedTuple):
    """One key of a scene.

    key   : dotted;  text: its value as YAML, from the file, or else the default
    unit  : of a bare number;  choices: the allowed values of an enumeration
    given : whether a file sets it
    """

    key: str
    text: str
    unit: str
    choices: tuple[str, ...]
    given: bool

    @property
    def section(self) -> str:
        first = self.key.partition(".")[0]
        return first if first in SECTIONS else "scene"


def fields(name: str, overrides: Mapping[str, str]) -> list[Field]:
    """All keys that a scene has or could have, sections in the order of the README. Raises InputError."""
    scene = load(name, overrides)
    tree = read(find(name))[0]
    found = [
        one._replace(text=overrides[one.key], given=True) if one.key in overrides else one
        for one in leaves(scene, tree, "")
        if one.key not in (STEM, "schema")
    ]
    order = ("scene", *SECTIONS)
    return sorted(found, key=lambda one: order.index(one.section))


def leaves(model: BaseModel, tree: Any, above: str) -> Iterator[Field]:
    """Yield the fields of a section. A list of sections is one field, as is one given by a word (`control: pid`)."""
    for name, info in type(model).model_fields.items():
        own = info.alias or SI_SUFFIX.sub("", name)
        key, value = f"{above}{own}", getattr(model, name)
        given = isinstance(tree, dict) and own in tree
        beneath = tree[own] if given else None
        if isinstance(value, BaseModel) and (beneath is None or isinstance(beneath, dict)):
            yield from leaves(value, beneath, f"{key}.")
        else:
            beneath = short(beneath)
            text = in_yaml(beneath) if given else in_yaml(plain(value, unit_of(name)))
            yield Field(key, text, shown_unit(own), choices(info.annotation), given)


def short(value: Any) -> Any:
    """Shorten the path of a shipped file to its name in scenes/."""
    return (
        str(Path(value).relative_to(SCENES))
        if isinstance(value, str) and value.startswith(str(SCENES))
        else value
    )


def unit_of(name: str) -> str:
    """The SI unit of a model field, from the suffix of its name."""
    told = SI_SUFFIX.search(name)
    return UNITS.get(told[1], "") if told else ""


def shown_unit(own: str) -> str:
    """The unit of a bare number, from the suffix of its key."""
    told = SUFFIX.search(own)
    return SHOWN[told[1]] if told else ""


def choices(annotation: Any) -> tuple[str, ...]:
    """The allowed values of a Boolean or an enumeration; () for others."""
    if annotation is bool:
        return ("true", "false")
    if get_origin(annotation) is Literal:
        return tuple(str(one) for one in get_args(annotation))
    parts = [one for one in get_args(annotation) if one is not type(None)]
    return choices(parts[0]) if len(parts) == 1 and get_origin(annotation) is not tuple else ()


def plain(value: Any, unit: str) -> Any:
    """Convert a validated value to what a file would contain: plain types, with the unit."""
    if isinstance(value, BaseModel):
        return value.model_dump(mode="json", by_alias=True)
    if isinstance(value, tuple | list):
        return [plain(one, unit) for one in value]
    if unit and isinstance(value, float):
        return f"{value:.6g} {unit}" if isfinite(value) else "infinity"
    return value


def in_yaml(value: Any) -> str:
    """Format a value as one line of YAML; strings are returned unchanged."""
    if isinstance(value, str):
        return value
    told = yaml.safe_dump(value, default_flow_style=True, width=10_000, allow_unicode=True, sort_keys=False)
    return told.strip().removesuffix("...").strip()


def checked(name: str, overrides: Mapping[str, str]) -> Scene:
    """Load the scene with the overrides. Raises InputError if it is invalid or names a file outside its folder."""
    scene = load(name, overrides)
    tree, folder = scene.model_dump(mode="json", by_alias=True), find(name).resolve().parent
    for keys in FILES:
        node: Any = tree
        for key in keys:
            node = node.get(key) if isinstance(node, dict) else None
        allowed = isinstance(node, str) and any(
            (at / node).resolve().is_relative_to(at) for at in (folder, SCENES)
        )
        if isinstance(node, str) and not allowed:
            raise InputError(f"{'.'.join(keys)}: {node!r}: allowed: a file in the scene's own folder")
    return scene


def is_scene(path: Path) -> bool:
    """Return True if a YAML file looks like a scene: no study, with a camera or a base scene."""
    try:
        tree, _ = read_yaml(path)
    except InputError:
        return False
    return "factors" not in tree and not {"base", "camera"}.isdisjoint(tree)


LOOPS = {
    "truth": "closed by the truth",
    "imu": "closed by the IMU",
    "filter": "closed by the filter",
    "": "open loop",
}


def looped(name: str, overrides: Mapping[str, str], feedback: str) -> dict[str, str]:
    """Overrides that close the loop with another feedback (a key of LOOPS); "" removes controller and maneuver."""
    tree = read(find(name))[0]
    for key, value in overrides.items():
        set_key(tree, key, value)
    control = spelt_out(tree.get("motion", {}).get("control"))
    if not feedback or control is None:
        return {"motion.control": "null", "motion.manoeuvre": "[]"}
    return {"motion.control": in_yaml(control | {"feedback": feedback})}


def save(folder: Path, name: str, base: str, overrides: Mapping[str, str], title: str) -> Path:
    """Save a new scene file that consists of a base and overrides. Raises InputError, also if the file exists."""
    from skysim.apps.gui.worker.export import base_of, scene_yaml
    from skysim.core import files

    if not re.fullmatch(r"[A-Za-z0-9][\w-]{0,60}", name):
        raise InputError(f"{name!r}: allowed: letters, digits, _ and -")
    path = folder / f"{name}.yaml"
    if path.exists():
        raise InputError(f"{path.name}: is there already; allowed: another name")
    checked(base, overrides)
    files.write_text(path, scene_yaml(base_of(base, folder), dict(overrides), title))
    return path
