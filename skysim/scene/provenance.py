"""The effective scene: every key with its value and where the value comes from.

The raw trees of all files are merged as `loader` merges them, but with leaves that know their origin (`Located`). The
fields of the validated scene are then looked up in that tree; one that is not there has its default.
"""

from __future__ import annotations

import datetime
import functools
import math
from collections.abc import Iterator, Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, NamedTuple

import yaml

from skysim.core.units import ConfigModel, si_unit
from skysim.core.yaml_reader import parse_yaml, read_yaml
from skysim.scene import loader, unused
from skysim.scene.loader import CALIBRATED_KEYS, Layer, merge
from skysim.scene.scene import NAME_ALIAS

COMMENT_COLUMN = 44  # of the origins; longer lines have theirs at their end


class Origin(NamedTuple):
    """Where a value comes from: a description, and the file and the line if it is from a file."""

    what: str
    file: str = ""
    line: int = 0

    def __str__(self) -> str:
        return f"{self.what}, line {self.line}" if self.line else self.what


DEFAULT = Origin("default")
OVERRIDE = Origin("--set")


class Entry(NamedTuple):
    """One key of the effective scene: its path, its value as YAML has it, and where it comes from.

    Attributes
    ----------
    no_effect
        Why the key does nothing in this scene; empty if it does something
    """

    path: tuple[str, ...]
    value: Any
    origin: Origin
    no_effect: str = ""


@dataclass(frozen=True)
class Located:
    """A raw value with its origin; two are equal if their values are, as `merge` compares kinds."""

    value: Any
    origin: Origin = field(compare=False)


def effective(name: str | Path, overrides: Mapping[str, str] | None = None) -> list[Entry]:
    """Every key of a scene in the order of the schema. Raises InputError as `loader.load`."""
    overrides = overrides or {}
    scene = loader.load(name, overrides)
    tree = located_tree(loader.read_layers(loader.find(str(name))), overrides)
    found = [entry for entry in entries(scene, tree) if entry.path != (NAME_ALIAS,)]
    reasons = (
        "" if entry.value is None else unused.reason(".".join(entry.path), scene) for entry in found
    )
    return [entry._replace(no_effect=reason) for entry, reason in zip(found, reasons, strict=True)]


def located_tree(layers: list[Layer], overrides: Mapping[str, str]) -> dict[str, Any]:
    """The raw scene with preset, calibration and overrides applied, and an origin for each value."""
    whats = ["this file", *(f"base {layer.path.name}" for layer in layers[1:])]
    trees = [with_origins(*layer, what) for layer, what in zip(layers, whats, strict=True)]
    tree: dict[str, Any] = functools.reduce(over_base, reversed(trees))
    for key in loader.REPLACING:
        if key in overrides:
            tree = over_base(tree, put({}, key.split("."), parse_yaml(overrides[key])[1]))
    for key, text in overrides.items():
        tree = put(tree, key.split("."), parse_yaml(text)[1])
    camera = tree.get("camera")
    return tree | {"camera": with_preset(camera)} if isinstance(camera, dict) else tree


def over_base(base: dict[str, Any], own: dict[str, Any]) -> dict[str, Any]:
    """`loader.over_base` for located values."""
    return loader.over_base(base, own, preset_camera)


def preset_camera(preset: Located) -> dict[str, Any]:
    """The camera of a preset with the origin of each value; empty if there is none."""
    if preset.value is None:
        return {}
    path = loader.preset_path(str(preset.value))
    tree, text = read_yaml(path)
    camera: dict[str, Any] = with_origins(path, text, tree, f"preset {path.name}")["camera"]
    return camera


def with_preset(camera: dict[str, Any]) -> dict[str, Any]:
    """The camera's keys over those of its preset, and a calibration's over both."""
    own = {key: value for key, value in camera.items() if key not in ("preset", "calibration")}
    if preset := camera.get("preset"):
        own = merge(preset_camera(preset), own)
    if (calibration := camera.get("calibration")) and calibration.value is not None:
        path = Path(str(calibration.value))
        origin = Origin(f"calibration {path.name}", str(path))
        own |= dict.fromkeys(CALIBRATED_KEYS, Located(None, origin))
    return own


def with_origins(path: Path, text: str, tree: Mapping[str, Any], what: str) -> dict[str, Any]:
    """A file's tree with the origin of each value; lists are values."""
    lines = lines_of(text)

    def locate(value: Any, keys: tuple[str, ...]) -> Any:
        if isinstance(value, dict):
            return {key: locate(inner, (*keys, str(key))) for key, inner in value.items()}
        return Located(value, Origin(what, str(path), lines.get(keys, 0)))

    located: dict[str, Any] = locate(tree, ())
    return located


def lines_of(text: str) -> dict[tuple[str, ...], int]:
    """The line of every key of a YAML text, by its path."""
    lines: dict[tuple[str, ...], int] = {}

    def visit(node: yaml.Node | None, keys: tuple[str, ...]) -> None:
        for key, value in node.value if isinstance(node, yaml.MappingNode) else ():
            lines[(*keys, str(key.value))] = key.start_mark.line + 1
            visit(value, (*keys, str(key.value)))

    visit(parse_yaml(text)[0], ())
    return lines


def put(tree: Any, keys: list[str], value: Any) -> Any:
    """The tree with the value of an override; an element of a list makes the list the override's."""
    if keys and (isinstance(tree, dict) or tree is None):
        tree = tree or {}
        return tree | {keys[0]: put(tree.get(keys[0]), keys[1:], value)}
    if keys:  # within a list
        return Located(None, OVERRIDE)
    if isinstance(value, dict):
        return {key: put(None, [], inner) for key, inner in value.items()}
    return Located(value, OVERRIDE)


def entries(model: ConfigModel, tree: Any, parent: tuple[str, ...] = ()) -> Iterator[Entry]:
    """The keys of a section, with those of its sections; tree: the located values of the section, or one for all."""
    for name, info in type(model).model_fields.items():
        key = info.alias or name
        value = getattr(model, name)
        raw = tree.get(key) if isinstance(tree, dict) else None
        if isinstance(tree, Located) and tree.value == value:
            raw = tree  # a section in short: control: pid
        if isinstance(value, ConfigModel):
            yield from entries(value, raw, (*parent, key))
        else:
            written = raw.value if isinstance(raw, Located) and not sections(value) else None
            origin = next(origins_in(raw), DEFAULT)
            yield Entry((*parent, key), plain(value, name) if written is None else written, origin)


def origins_in(tree: Any) -> Iterator[Origin]:
    """The origins of the values within a tree: of a key whose value is any mapping."""
    if isinstance(tree, Located):
        yield tree.origin
    for inner in tree.values() if isinstance(tree, dict) else ():
        yield from origins_in(inner)


def sections(value: Any) -> bool:
    """Whether a value of the schema is a list of sections."""
    return isinstance(value, tuple) and bool(value) and isinstance(value[0], ConfigModel)


def plain(value: Any, name: str) -> Any:
    """A value of the schema as YAML has it: quantities with their unit, sections of a list as mappings.

    Parameters
    ----------
    name
        Of its field, whose suffix gives the unit
    """
    if isinstance(value, ConfigModel):
        return {
            (info.alias or inner): plain(getattr(value, inner), inner)
            for inner, info in type(value).model_fields.items()
        }
    if isinstance(value, tuple):
        return [plain(item, name) for item in value]
    if isinstance(value, dict) or value is None or isinstance(value, bool | datetime.datetime):
        return value
    if isinstance(value, float) and (unit := si_unit(name)):
        return f"{tidy(value)} {unit}" if math.isfinite(value) else "infinity"
    return tidy(value) if isinstance(value, float) else value


def tidy(value: float) -> float | int:
    """The number without the digits of rounding in its unit's conversion: the shortest within 1e-15 of it."""
    short = float(f"{value:.15g}")
    return int(short) if short.is_integer() and abs(short) < 1e15 else short


def as_dicts(found: list[Entry]) -> list[dict[str, Any]]:
    """The entries for JSON: key, value, what, file, line, no_effect; dates as ISO 8601."""
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
    """The effective scene as YAML; each line ends with the origin of its value, and `no effect` if it has none."""
    lines: list[tuple[str, str]] = []
    open_: tuple[str, ...] = ()
    for path, value, origin, no_effect in found:
        *parents, key = path
        shared = next(
            (n for n, pair in enumerate(zip(open_, parents, strict=False)) if pair[0] != pair[1]),
            len(open_),
        )
        shared = min(shared, len(parents))
        lines += [(f"{'  ' * depth}{parents[depth]}:", "") for depth in range(shared, len(parents))]
        open_ = tuple(parents)
        indent = "  " * len(parents)
        comment = f"{origin}; no effect" if no_effect else str(origin)
        if not (isinstance(value, list) and value and isinstance(value[0], dict)):
            lines.append((f"{indent}{key}: {flow(value)}", comment))
            continue
        lines.append((f"{indent}{key}:", comment))
        lines += [(f"{indent}  - {flow(item)}", "") for item in value]
    return "".join(
        f"{line.ljust(COMMENT_COLUMN)}  # {note}\n" if note else f"{line}\n" for line, note in lines
    )


def flow(value: Any) -> str:
    """A value as YAML on one line."""
    dumped = yaml.safe_dump(value, default_flow_style=True, width=1_000_000, sort_keys=False)
    return dumped.removesuffix("\n...\n").strip()
