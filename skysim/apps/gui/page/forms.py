"""A scene's keys as fields of a form, made from the schema: what each holds, its unit, what it may be."""

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
from skysim.core.yaml_reader import put, read_yaml
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

    key   : dotted;  text: its value as YAML, as its file has it, else the value that stands in for it
    unit  : of a bare number;  choices: all that it may be, where those are few
    given : whether a file has it
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
    """Every key that a scene has or could have, sections in the order of the README. Raises InputError."""
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
    """The fields beneath a section; a list of sections is one field, and so is one told by a word (`control: pid`)."""
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
    """A file that comes along by its name in scenes/."""
    return (
        str(Path(value).relative_to(SCENES))
        if isinstance(value, str) and value.startswith(str(SCENES))
        else value
    )


def unit_of(name: str) -> str:
    """The unit in which a value with a unit is kept."""
    told = SI_SUFFIX.search(name)
    return UNITS.get(told[1], "") if told else ""


def shown_unit(own: str) -> str:
    """The unit of a bare number, by its key's end."""
    told = SUFFIX.search(own)
    return SHOWN[told[1]] if told else ""


def choices(annotation: Any) -> tuple[str, ...]:
    """What a key of few values may be."""
    if annotation is bool:
        return ("true", "false")
    if get_origin(annotation) is Literal:
        return tuple(str(one) for one in get_args(annotation))
    parts = [one for one in get_args(annotation) if one is not type(None)]
    return choices(parts[0]) if len(parts) == 1 and get_origin(annotation) is not tuple else ()


def plain(value: Any, unit: str) -> Any:
    """A value as a file would have it: with its unit, without pydantic."""
    if isinstance(value, BaseModel):
        return value.model_dump(mode="json", by_alias=True)
    if isinstance(value, tuple | list):
        return [plain(one, unit) for one in value]
    if unit and isinstance(value, float):
        return f"{value:.6g} {unit}" if isfinite(value) else "infinity"
    return value


def in_yaml(value: Any) -> str:
    """One line of YAML; a text as it is."""
    if isinstance(value, str):
        return value
    told = yaml.safe_dump(value, default_flow_style=True, width=10_000, allow_unicode=True, sort_keys=False)
    return told.strip().removesuffix("...").strip()


def checked(name: str, overrides: Mapping[str, str]) -> Scene:
    """The scene with those keys, if it is one and names no file outside its folder. Raises InputError."""
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
    """Whether a YAML file looks like a scene of its own or one that changes another."""
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
    """What closes the loop of a scene that has a controller by something else; `` opens it: nobody steers."""
    tree = read(find(name))[0]
    for key, value in overrides.items():
        put(tree, key, value)
    control = spelt_out(tree.get("motion", {}).get("control"))
    if not feedback or control is None:
        return {"motion.control": "null", "motion.manoeuvre": "[]"}
    return {"motion.control": in_yaml(control | {"feedback": feedback})}


def save(folder: Path, name: str, base: str, overrides: Mapping[str, str], title: str) -> Path:
    """A new scene file in a folder: the base's keys but for those changed. Raises InputError; overwrites nothing."""
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
