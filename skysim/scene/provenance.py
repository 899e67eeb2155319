"""The effective scene: every key with its value and the origin of the value.

1. Merge the raw trees of all files as `loader` does.
2. Look up each field of the validated scene in that tree (a field that is not there has its default), and then in the
   files, from the first to the last, for the origin of its value (`entries`).
3. Mark the keys that have no effect (unused.py).
"""

import datetime
import math
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any, NamedTuple

from skysim.core.units import ConfigModel, si_unit
from skysim.core.yaml_reader import (
    OverrideTexts,
    Tree,
    key_lines,
    one_line,
    opened_sections,
    read_yaml,
)
from skysim.scene import loader, unused
from skysim.scene.camera_sheet import rounded
from skysim.scene.loader import Layer
from skysim.scene.scene import NAME_ALIAS

KeyPath = tuple[str, ...]  # nested keys
COMMENT_COLUMN = 44  # column of the origins; a longer line has its origin at its end


class Origin(NamedTuple):
    """The origin of a value: a description, and file and line if it is from a file."""

    what: str
    file: str = ""
    line: int = 0

    def __str__(self) -> str:
        return f"{self.what}, line {self.line}" if self.line else self.what


DEFAULT = Origin("default")
ABSENT = object()  # stands for the value of a key that is not in a tree


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

    path: KeyPath
    value: Any
    origin: Origin
    no_effect: str = ""


class Source(NamedTuple):
    """The raw keys of a file or of the overrides, and the line of each key in the file."""

    what: str
    tree: Tree
    file: str = ""
    lines: Mapping[KeyPath, int] = {}


def effective(name: str | Path, overrides: OverrideTexts | None = None) -> list[Entry]:
    """All keys of a scene in the order of the schema. Raises InputError as `loader.load`."""
    # 1. The merged tree, and what it is made of.
    path = loader.find(str(name))
    overrides = loader.resolve_overrides(path, overrides or {})
    scene = loader.load(name, overrides)
    layers = loader.read_layers(path)
    sources = sources_of(layers, overrides)
    tree = loader.with_overrides(loader.merged(layers), overrides)
    camera = tree["camera"]
    if preset := camera.get("preset"):
        camera = tree["camera"] = loader.merge(loader.preset(str(preset)), camera)
    if calibration := camera.get("calibration"):
        # Their values are not in the files: those of the scene are shown.
        keys: Tree = {"camera": dict.fromkeys(loader.CALIBRATED_KEYS)}
        camera |= keys["camera"]
        sources.insert(
            0, Source(f"calibration {Path(calibration).name}", keys, str(calibration))
        )
    # 2. Fields of the scene. 3. Reasons.
    return [
        entry
        if entry.value is None
        else entry._replace(no_effect=unused.reason(".".join(entry.path), scene))
        for entry in entries(scene, tree, sources)
        if entry.path != (NAME_ALIAS,)
    ]


def sources_of(layers: list[Layer], overrides: OverrideTexts) -> list[Source]:
    """The overrides, the files of a scene, and its camera's preset, before the bases of the file that names it."""
    found = [Source("--set", loader.with_overrides({}, overrides))]
    for n, layer in enumerate(layers):
        what = f"base {layer.path.name}" if n else "this file"
        found.append(Source(what, layer.tree, str(layer.path), key_lines(layer.text)))
    for n, source in enumerate(found):
        preset = value_at(source.tree, ("camera", "preset"))
        if preset is ABSENT:
            continue
        if preset is not None:
            path = loader.preset_path(str(preset))
            keys = {"camera": loader.preset(str(preset))}
            lines = key_lines(read_yaml(path)[1])
            found.insert(n + 1, Source(f"preset {path.name}", keys, str(path), lines))
        break
    return found


def value_at(tree: Any, keys: KeyPath) -> Any:
    """The value at nested keys of a tree; ABSENT if there is none."""
    for key in keys:
        tree = tree.get(key, ABSENT) if isinstance(tree, dict) else ABSENT
    return tree


def entries(
    model: ConfigModel, tree: Any, sources: list[Source], parent: KeyPath = ()
) -> Iterator[Entry]:
    """Yield the keys of a section and of the sections in it.

    `tree` has the raw values of the section, or is one value for the section as a whole.
    """
    for name, info in type(model).model_fields.items():
        key = info.alias or name
        path = (*parent, key)
        value = getattr(model, name)
        raw = value_at(tree, (key,))
        origin = origin_of(path, raw, sources)
        # A section may be written as one value, such as control: pid.
        if isinstance(tree, str) and tree == value:
            raw = tree
            origin = origin_of(parent, raw, sources)
        # A table is shown as a whole: its columns may be those of a file.
        if isinstance(value, ConfigModel) and name != "lens_table":
            yield from entries(value, raw, sources, path)
        elif isinstance(value, dict) and any(
            isinstance(v, ConfigModel) for v in value.values()
        ):
            # Sections by names of the user's, such as types of LEDs.
            for word, section in value.items():
                yield from entries(section, value_at(raw, (word,)), sources, (*path, word))
        else:
            # A list of sections has defaults that are not written.
            listed = isinstance(value, tuple) and any(
                isinstance(item, ConfigModel) for item in value
            )
            written = not (raw in (ABSENT, None) or isinstance(raw, dict) or listed)
            yield Entry(path, raw if written else plain(value, name), origin)


def origin_of(keys: KeyPath, value: Any, sources: list[Source]) -> Origin:
    """The origin of a value at nested keys of the merged tree; that of a mapping is the origin of its first value."""
    while isinstance(value, dict) and value:
        key = next(iter(value))
        keys = (*keys, key)
        value = value[key]
    for what, tree, file, lines in sources:
        found = value_at(tree, keys)
        # An override of an item is the origin of its list.
        if found == value is not ABSENT or (
            isinstance(found, dict) and isinstance(value, list)
        ):
            return Origin(what, file, lines.get(keys, 0))
    return DEFAULT


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
    lines = []
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
