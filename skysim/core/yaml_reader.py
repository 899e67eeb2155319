"""Read YAML files safely, and turn a pydantic validation error into a one-line message with file and line.

Input files may come from untrusted sources, so their size, depth and number of values are limited (`Careful`), and
duplicate keys are rejected (`once`). `explain` takes the first error that pydantic reports, translates its location
to the keys of the YAML tree, and `place_of` finds the line of that key in the file that defines it.
"""

from __future__ import annotations

import difflib
import json
import re
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import yaml
from pydantic import BaseModel, ValidationError

from skysim import __version__
from skysim.core.errors import InputError, printable

Files = list[tuple[Path, str]]  # paths and texts
VERSION = 1  # of scene and study files; raised by an incompatible change, with a conversion of old files here


MOST_BYTES = 1 << 20  # of a file: a minute of reading
MOST_NODES = 100_000  # of a document, counting the content of an alias each time
LONGEST = 200  # characters of a value in a message
DEEPEST = 40  # levels of nesting


class StrictLoader(yaml.SafeLoader):
    """SafeLoader with limits: nested aliases that expand, deep nesting and recursive aliases raise an error."""

    def __init__(self, text: str) -> None:
        super().__init__(text)
        self.depth = self.nodes = 0
        self.size: dict[int, int] = {}  # nodes within each completely composed node, by id

    def compose_node(self, parent: yaml.Node | None, index: Any) -> yaml.Node | None:
        before, mark = self.nodes, self.peek_event().start_mark
        aliased = self.check_event(yaml.AliasEvent)
        # Limits are checked while composing, before any value is constructed from an expanding alias.
        self.depth += 1
        if self.depth > DEEPEST:
            raise yaml.composer.ComposerError(None, None, f"more than {DEEPEST} sections deep", mark)
        node = super().compose_node(parent, index)
        self.depth -= 1
        # An alias of a node that is not yet complete lies within that node: it is recursive.
        if aliased and id(node) not in self.size:
            raise yaml.composer.ComposerError(None, None, "an alias of what it stands in", mark)
        self.nodes += self.size[id(node)] if aliased else 1
        self.size[id(node)] = self.nodes - before
        if self.nodes > MOST_NODES:
            raise yaml.composer.ComposerError(None, None, f"more than {MOST_NODES} values", mark)
        return node

    def construct_object(self, node: yaml.Node, deep: bool = False) -> Any:
        """As in SafeLoader, but report invalid numbers and dates as YAML errors."""
        try:
            return super().construct_object(node, deep)
        except (ValueError, TypeError, LookupError, OverflowError, AttributeError) as error:
            problem = f"{str(node.value)[:40]!r} is no {node.tag.rpartition(':')[2]} ({error})"
            raise yaml.constructor.ConstructorError(None, None, problem, node.start_mark) from None


def parse_yaml(text: str, kind: type[StrictLoader] = StrictLoader) -> tuple[yaml.Node | None, Any]:
    """The node tree of a YAML document, and its values. Raises YAMLError."""
    loader = kind(text)
    try:
        node = loader.get_single_node()
        return node, None if node is None else loader.construct_document(node)
    finally:
        loader.dispose()


def is_file(path: Path) -> bool:
    """Whether the file exists; False for a name that no file can have."""
    try:
        return path.is_file()
    except OSError:
        return False


def find(name: str, folder: Path, what: str) -> Path:
    """The path of a file given by path, or by its name in a folder. Raises InputError."""
    path, shipped = Path(name), folder / f"{name}.yaml"
    if path.suffix in {".yaml", ".yml"} and is_file(path):
        return path
    if not path.suffix and is_file(shipped):
        return shipped
    known = sorted(one.stem for one in folder.glob("*.yaml"))
    raise InputError(f"{shown(name)}: no such {what}; allowed: a .yaml file or one of {', '.join(known)}")


def shown(value: object) -> str:
    """A value for a message: on one line, truncated to LONGEST characters."""
    text = printable(value)
    return text if len(text) <= LONGEST else f"{text[:LONGEST]}…"


def parse_overrides(sets: list[str] | None) -> dict[str, str]:
    """Keys and values of `--set path.to.key=value`. Raises InputError."""
    overrides = {}
    for item in sets or []:
        key, equals, value = item.partition("=")
        if not equals or not key:
            raise InputError(f"--set {shown(item)}: allowed: path.to.key=value")
        overrides[key] = value
    return overrides


def override_texts(overrides: Mapping[str, Any] | None) -> dict[str, str]:
    """Overrides given in Python as the YAML texts of `--set`: strings as they are, other values as JSON."""
    return {key: one if isinstance(one, str) else json.dumps(one) for key, one in (overrides or {}).items()}


def read_yaml(path: Path) -> tuple[dict[str, Any], str]:
    """A YAML mapping and its text. Raises InputError."""
    try:
        if path.stat().st_size > MOST_BYTES:
            raise InputError(f"{path}: {path.stat().st_size} bytes; allowed: up to {MOST_BYTES}")
        text = path.read_text(encoding="utf-8")
        node, tree = parse_yaml(text)
    except (OSError, UnicodeDecodeError) as error:
        raise InputError(f"{path}: cannot be read: {getattr(error, 'strerror', None) or error}") from error
    except yaml.YAMLError as error:
        mark = getattr(error, "problem_mark", None)
        where = f", line {mark.line + 1}" if mark else ""
        problem = " ".join(str(getattr(error, "problem", error)).split())
        raise InputError(f"{path}{where}: not YAML: {problem}") from error
    if not isinstance(tree, dict):
        raise InputError(f"{path}: allowed: a mapping of keys to values")
    reject_duplicate_keys(node, path)
    return tree, text


def reject_duplicate_keys(node: yaml.Node | None, path: Path) -> None:
    """Raise InputError for a key that occurs twice in a mapping; YAML would silently use the last."""
    if isinstance(node, yaml.SequenceNode):
        for item in node.value:
            reject_duplicate_keys(item, path)
    if isinstance(node, yaml.MappingNode):
        seen: set[str] = set()
        for key, value in node.value:
            if str(key.value) in seen:
                raise InputError(
                    f"{shown(key.value)}: stands twice in one section ({path}, line {key.start_mark.line + 1})"
                )
            seen.add(str(key.value))
            reject_duplicate_keys(value, path)


def check_version(tree: Mapping[str, Any], path: Path, text: str) -> None:
    """Raise InputError for a file of another schema version, before its unknown keys are reported as mistakes."""
    if "schema" not in tree:
        raise InputError(f"schema: missing; add the line schema: {VERSION} ({path})")
    told = tree["schema"]
    if type(told) is int and told == VERSION:
        return
    what = f"{shown(repr(told))} is not known"
    if type(told) is int:
        what = f"{told} is " + (
            f"of a newer skysim than {__version__}" if told > VERSION else "older than this skysim reads"
        )
    raise InputError(f"schema: {what}; allowed: {VERSION} {place_of(['schema'], [(path, text)], {})}")


def set_key(tree: dict[str, Any], key: str, value: str) -> None:
    """Set one dotted key of the raw scene; the value is YAML. A number is an index into a list: `camera_body.2`."""
    *parents, last = key.split(".")
    if not all((*parents, last)):
        raise InputError(f"--set {shown(key)}={shown(value)}: allowed: path.to.key=value")
    node: Any = tree
    for depth, parent in enumerate(parents):
        node = node.setdefault(parent, {}) if isinstance(node, dict) else node[place_in(node, parent, key)]
        if not isinstance(node, dict | list):
            raise InputError(
                f"--set {shown(key)}: {shown('.'.join(parents[: depth + 1]))} holds a value, not keys"
            )
    try:
        node[last if isinstance(node, dict) else place_in(node, last, key)] = parse_yaml(value)[1]
    except yaml.YAMLError as error:
        raise InputError(f"--set {shown(key)}: {shown(repr(value))} is not YAML") from error


def place_in(values: list[Any], place: str, key: str) -> int:
    """The list index that a component of a dotted key gives. Raises InputError."""
    if not (place.isascii() and place.isdigit() and len(place) < 10) or int(place) >= len(values):
        raise InputError(
            f"--set {shown(key)}: {shown(place)} is no place in a list; allowed: 0 to {len(values) - 1}"
        )
    return int(place)


def explain(
    error: ValidationError,
    model: type[BaseModel],
    tree: dict[str, Any],
    files: Files,
    overrides: Mapping[str, str],
) -> str:
    """One-line message of the first validation error: `led.falloff: 'cubic' is none of … (scenes/x.yaml, line 31)`.

    tree is the merged content of the files; files are their paths and texts, the one with the highest priority first.
    """
    # A misspelled key causes two errors, unknown and missing. Report the unknown one.
    first = min(error.errors(), key=lambda fault: fault["type"] == "missing")
    keys = [str(key) for key in in_tree(first["loc"], tree, first["type"] == "missing")]
    message = re.sub(r"^(Value error, |\w+ should )", "", first["msg"])
    if first["type"] == "extra_forbidden":
        message = "unknown key" + hint(keys[-1], allowed_keys(model, first["loc"][:-1]))
    elif first["type"] == "missing":
        message = "missing"
    elif first["type"] == "union_tag_invalid":
        keys, context = [*keys, "kind"], first["ctx"]
        message = f"{context['tag']!r} is none of {context['expected_tags'].replace(chr(39), '')}"
    elif first["type"] == "union_tag_not_found":
        message = "kind is missing"
    elif first["type"] in ("model_type", "model_attributes_type"):
        message = f"{shown(repr(first['input']))} is not allowed; it should be a mapping of keys to values"
    elif (
        first["type"] == "value_error" and not keys
    ):  # validator of the whole scene: its message begins with the key
        dotted, _, message = message.partition(": ")
        keys = dotted.split(".")
    elif not first["type"].startswith("value_error"):
        message = f"{shown(repr(first['input']))} is not allowed; it should {message}"
    dotted = ".".join(keys)
    # A missing key has no line of its own, so its section's is given. (A file may have it in a section or list that
    # another file replaces.)
    given = keys[:-1] if first["type"] == "missing" else keys
    return f"{shown(dotted) + ': ' if dotted else ''}{message} {place_of(given, files, overrides)}"


def place_of(keys: list[str], files: Files, overrides: Mapping[str, str]) -> str:
    """Where a key was given: `(--set)`, or `(scenes/x.yaml, line 31)` in the file that has most of its components."""
    dotted = ".".join(keys)
    if any(k == dotted or dotted.startswith(k + ".") for k in overrides):
        return "(--set)"
    found = [(*line_of(text, keys), path) for path, text in files]
    depth = max(found, key=lambda one: one[0])[0]
    line, path = next((line, path) for deep, line, path in found if deep == depth)
    return f"({path}{f', line {line}' if line else ''})"


def in_tree(loc: tuple[int | str, ...], tree: Any, missing: bool) -> list[int | str]:
    """The error's location as keys of the tree, without pydantic's names of union branches; the last may be missing."""
    keys: list[int | str] = []
    for n, key in enumerate(loc):
        last = missing and n == len(loc) - 1
        if isinstance(tree, dict) and (key in tree or last):
            keys.append(key)
            tree = tree.get(key)
        elif isinstance(tree, list) and isinstance(key, int) and (key < len(tree) or last):
            keys.append(key)
            tree = tree[key] if key < len(tree) else None
    return keys


def allowed_keys(model: type[BaseModel], loc: tuple[int | str, ...]) -> list[str]:
    """The keys that a section takes, found by following an error's location through the JSON schema."""
    schema = model.model_json_schema(by_alias=True)
    node: dict[str, Any] = schema
    for key in loc:
        node = resolve(node, schema)
        # Branches of a union; an optional section has its union nested one level deeper.
        options = [resolve(option, schema) for option in node.get("anyOf", []) + node.get("oneOf", [])]
        options += [resolve(option, schema) for one in options for option in one.get("oneOf", [])]
        if key in node.get("properties", {}):
            node = node["properties"][key]
        elif isinstance(key, int):
            node = node.get("items", {})
        else:
            named = [o for o in options if key in (o.get("title"), kind_of(o))]
            node = named[0] if named else node
    return list(resolve(node, schema).get("properties", {}))


def resolve(node: dict[str, Any], schema: dict[str, Any]) -> dict[str, Any]:
    """The schema that a node refers to; for an optional section, the section's."""
    options = [option for option in node.get("anyOf", []) if option.get("type") != "null"]
    if len(options) == 1:
        node = options[0]
    return schema["$defs"][node["$ref"].rsplit("/", 1)[1]] if "$ref" in node else node


def kind_of(node: dict[str, Any]) -> str | None:
    return node.get("properties", {}).get("kind", {}).get("const")


def hint(word: str, allowed: list[str]) -> str:
    close = difflib.get_close_matches(word, allowed, 1)
    meant = f"; did you mean {close[0]}?" if close else ""
    return f"{meant}; allowed: {', '.join(k for k in allowed if k.isidentifier())}" if allowed else meant


def line_of(text: str, keys: list[str]) -> tuple[int, int | None]:
    """How many components of a dotted key occur in the text, and the line of the last one that does."""
    node = yaml.compose(text, yaml.SafeLoader)
    depth, line = 0, None
    for key in keys:
        found = None
        if isinstance(node, yaml.MappingNode):
            found = next(((k, v) for k, v in node.value if k.value == key), None)
        elif (
            isinstance(node, yaml.SequenceNode)
            and key.isascii()
            and key.isdigit()
            and int(key) < len(node.value)
        ):
            found = (node.value[int(key)],) * 2
        if not found:
            break
        depth, line, node = depth + 1, found[0].start_mark.line + 1, found[1]
    return depth, line
