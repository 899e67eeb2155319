"""The effective scene: every key with its value and the origin of the value.

1. Merge the raw trees of all files as `loader` does, with values that know their origin (`located_tree`).
2. Look up each field of the validated scene in that tree; a field that is not there has its default (`entries`).
3. Mark the keys that have no effect (unused.py).
"""

import datetime
import functools
import math
from collections.abc import Iterator
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, NamedTuple

from skysim.core.units import ConfigModel, si_unit
from skysim.core.yaml_reader import (
    Keys,
    OverrideTexts,
    Tree,
    key_lines,
    one_line,
    opened_sections,
    parse_yaml,
    read_yaml,
)
from skysim.scene import loader, unused
from skysim.scene.camera_sheet import rounded
from skysim.scene.loader import CALIBRATED_KEYS, Layer, merge
from skysim.scene.scene import NAME_ALIAS

COMMENT_COLUMN = 44  # column of the origins; a longer line has its origin at its end


class Origin(NamedTuple):
    """The origin of a value: a description, and file and line if it is from a file."""

    what: str
    file: str = ""
    line: int = 0

    def __str__(self) -> str:
        return f"{self.what}, line {self.line}" if self.line else self.what


DEFAULT = Origin("default")
OVERRIDE = Origin("--set")


class Entry(NamedTuple):
    """One key of the effective scene.

    Attributes
    ----------
    path
        Nested keys
    value
        Value as in YAML
    origin
        Origin of the value
    no_effect
        Reason why the key has no effect in this scene; empty if it has one
    """

    path: tuple[str, ...]
    value: Any
    origin: Origin
    no_effect: str = ""


@dataclass(frozen=True)
class Located:
    """A raw value with its origin. Two are equal if their values are, because `merge` compares kinds."""

    value: Any
    origin: Origin = field(compare=False)


def effective(name: str | Path, overrides: OverrideTexts | None = None) -> list[Entry]:
    """All keys of a scene in the order of the schema. Raises InputError as `loader.load`."""
    # 1. Tree with origins.
    path = loader.find(str(name))
    overrides = loader.resolve_overrides(path, overrides or {})
    scene = loader.load(name, overrides)
    tree = located_tree(loader.read_layers(path), overrides)
    # 2. Fields of the scene. 3. Reasons.
    found = []
    for entry in entries(scene, tree):
        if entry.path != (NAME_ALIAS,):
            unset = entry.value is None
            reason = "" if unset else unused.reason(".".join(entry.path), scene)
            found.append(entry._replace(no_effect=reason))
    return found


def located_tree(layers: list[Layer], overrides: OverrideTexts) -> Tree:
    """The raw scene with preset, calibration and overrides applied, and the origin of each value."""
    whats = ["this file", *(f"base {layer.path.name}" for layer in layers[1:])]
    trees = [with_origins(*layer, what) for layer, what in zip(layers, whats, strict=True)]
    tree: Tree = functools.reduce(over_base, reversed(trees))
    for key in loader.REPLACING:
        if key in overrides:
            tree = over_base(tree, put({}, key.split("."), parse_yaml(overrides[key])[1]))
    for key, text in overrides.items():
        tree = put(tree, key.split("."), parse_yaml(text)[1])
    camera = tree.get("camera")
    return tree | {"camera": with_preset(camera)} if isinstance(camera, dict) else tree


def preset_camera(preset: Located) -> Tree:
    """The camera section of a preset with the origin of each value; empty if there is no preset."""
    if preset.value is None:
        return {}
    path = loader.preset_path(str(preset.value))
    tree, text = read_yaml(path)
    camera: Tree = with_origins(path, text, tree, f"preset {path.name}")["camera"]
    return camera


# `loader.over_base` for located values.
over_base = functools.partial(loader.over_base, camera_of=preset_camera)


def with_preset(camera: Tree) -> Tree:
    """The keys of a camera merged over the keys of its preset, and the keys of a calibration merged over both."""
    own = {
        key: value for key, value in camera.items() if key not in ("preset", "calibration")
    }
    if preset := camera.get("preset"):
        own = merge(preset_camera(preset), own)
    if (calibration := camera.get("calibration")) and calibration.value is not None:
        path = Path(str(calibration.value))
        origin = Origin(f"calibration {path.name}", str(path))
        own |= dict.fromkeys(CALIBRATED_KEYS, Located(None, origin))
    return own


def with_origins(path: Path, text: str, tree: Keys, what: str) -> Tree:
    """The tree of a file with the origin of each value; a list is one value."""
    lines = key_lines(text)

    def locate(value: Any, keys: tuple[str, ...]) -> Any:
        """The value at nested keys with its origin, or the mapping with those of its values."""
        if isinstance(value, dict):
            return {key: locate(inner, (*keys, str(key))) for key, inner in value.items()}
        return Located(value, Origin(what, str(path), lines.get(keys, 0)))

    located: Tree = locate(tree, ())
    return located


def put(tree: Any, keys: list[str], value: Any) -> Any:
    """The tree with the value of an override at nested keys; an override of an element is the origin of its list."""
    if keys and (isinstance(tree, dict) or tree is None):
        tree = tree or {}
        return tree | {keys[0]: put(tree.get(keys[0]), keys[1:], value)}
    # Keys that are left lead into a list.
    if keys:
        return Located(None, OVERRIDE)
    if isinstance(value, dict):
        return {key: put(None, [], inner) for key, inner in value.items()}
    return Located(value, OVERRIDE)


def entries(model: ConfigModel, tree: Any, parent: tuple[str, ...] = ()) -> Iterator[Entry]:
    """Yield the keys of a section and of the sections in it.

    `tree` has the located values of the section, or is one located value for the section as a whole.
    """
    for name, info in type(model).model_fields.items():
        key = info.alias or name
        value = getattr(model, name)
        raw = tree.get(key) if isinstance(tree, dict) else None
        # A section may be written as one value, such as control: pid.
        if isinstance(tree, Located) and tree.value == value:
            raw = tree
        if isinstance(value, ConfigModel):
            yield from entries(value, raw, (*parent, key))
        elif isinstance(value, dict) and any(
            isinstance(v, ConfigModel) for v in value.values()
        ):
            # Sections by names of the user's, such as types of LEDs.
            for word, section in value.items():
                named = raw.get(word) if isinstance(raw, dict) else None
                yield from entries(section, named, (*parent, key, word))
        else:
            written = raw.value if isinstance(raw, Located) and not sections(value) else None
            shown = plain(value, name) if written is None else written
            yield Entry((*parent, key), shown, next(origins_in(raw), DEFAULT))


def origins_in(tree: Any) -> Iterator[Origin]:
    """Yield the origins of the values within a tree, since the value of a key may be any mapping."""
    if isinstance(tree, Located):
        yield tree.origin
    for inner in tree.values() if isinstance(tree, dict) else ():
        yield from origins_in(inner)


def sections(value: Any) -> bool:
    """Whether a value of the schema is a list of sections."""
    return isinstance(value, tuple) and bool(value) and isinstance(value[0], ConfigModel)


def plain(value: Any, name: str) -> Any:
    """A value of the schema as in YAML: quantities with their unit, sections of a list as mappings.

    The suffix of the field's name gives the unit.
    """
    if isinstance(value, ConfigModel):
        return {
            (info.alias or inner): plain(getattr(value, inner), inner)
            for inner, info in type(value).model_fields.items()
        }
    if isinstance(value, tuple):
        return [plain(item, name) for item in value]
    if not isinstance(value, float):
        return value
    # 15 digits are without the rounding error of the unit's conversion.
    unit = si_unit(name)
    if unit and math.isinf(value):
        return "infinity"
    return f"{rounded(value, 15)} {unit}" if unit else rounded(value, 15)


def as_dicts(found: list[Entry]) -> list[Tree]:
    """The entries as JSON objects: key, value, what, file, line, no_effect; dates as ISO 8601."""
    return [
        {
            "key": ".".join(path),
            "value": value.isoformat() if isinstance(value, datetime.datetime) else value,
        }
        | origin._asdict()
        | {"no_effect": no_effect}
        for path, value, origin, no_effect in found
    ]


def text(found: list[Entry]) -> str:
    """The effective scene as YAML; each line ends with the origin of its value, and `no effect` if that is so."""
    lines: list[tuple[str, str]] = []
    open_: list[str] = []
    for path, value, origin, no_effect in found:
        *parents, key = path
        lines += [(line, "") for line in opened_sections(open_, parents)]
        open_ = parents
        indent = "  " * len(parents)
        comment = f"{origin}; no effect" if no_effect else str(origin)
        if not (isinstance(value, list) and value and isinstance(value[0], dict)):
            lines.append((f"{indent}{key}: {one_line(value, sort_keys=False)}", comment))
            continue
        lines.append((f"{indent}{key}:", comment))
        lines += [(f"{indent}  - {one_line(item, sort_keys=False)}", "") for item in value]
    return "".join(
        f"{line.ljust(COMMENT_COLUMN)}  # {note}\n" if note else f"{line}\n"
        for line, note in lines
    )
