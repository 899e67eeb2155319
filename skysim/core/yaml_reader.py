"""Read YAML files safely, and turn a pydantic validation error into an InputError with file and line.

Input files may come from untrusted sources, so their size, depth and number of values are limited (`StrictLoader`), and
duplicate keys are rejected (`reject_duplicate_keys`). `explain` makes the error message of a validation:

1. Take the first error that pydantic reports.
2. Translate its location to the keys of the YAML tree (`yaml_keys`), and its type to a problem (`fault_of`).
3. Find the line of that key in the file that defines it (`where_of`).
"""

import copy
import datetime
import difflib
import functools
import json
import re
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from decimal import Decimal
from pathlib import Path
from typing import Annotated, Any

import yaml
from pydantic import AfterValidator, ValidationError
from pydantic_core import ErrorDetails

from skysim.core import __version__
from skysim.core.errors import OVERRIDES, InputError, Where, reason, shortened, unknown_name
from skysim.core.paths import shipped_files

Files = list[tuple[Path, str]]  # paths and texts
Tree = dict[str, Any]  # nested keys: a file or a section as read, or a JSON schema
Keys = Mapping[str, Any]  # of a file or a section, as given
OverrideTexts = Mapping[str, str]  # YAML texts by dotted key
# Version of scene and study files. An incompatible change increases it and adds a conversion of old files here.
VERSION = 1

# Stands for the file's name of a mapping that is given in Python, or in a study; its files are in the folder.
MAPPING = "mapping"
MAX_BYTES = 1 << 20  # of a file: a minute of reading
MAX_KEPT = 1 << 15  # number of characters of a text whose values are cached
MAX_NODES = 100_000  # of a document, counting the content of an alias each time
MAX_EXCERPT = 200  # number of characters of a value in a message
MAX_DEPTH = 40  # levels of nesting


class StrictLoader(yaml.SafeLoader):
    """SafeLoader with limits: nested aliases that expand, deep nesting and recursive aliases raise an error."""

    def __init__(self, text: str) -> None:
        super().__init__(text)
        self.depth = self.nodes = 0
        # Number of nodes in each completely composed node, by its id.
        self.size: dict[int, int] = {}

    def compose_node(self, parent: yaml.Node | None, index: Any) -> yaml.Node | None:
        """As in SafeLoader, with the limits."""
        before = self.nodes
        mark = self.peek_event().start_mark
        aliased = self.check_event(yaml.AliasEvent)
        # Limits are checked while composing, before any value is constructed from an expanding alias.
        self.depth += 1
        if self.depth > MAX_DEPTH:
            raise yaml.composer.ComposerError(
                None, None, f"more than {MAX_DEPTH} sections deep", mark
            )
        node = super().compose_node(parent, index)
        self.depth -= 1
        # An alias of a node that is not yet complete is part of that node: it is recursive.
        if aliased and id(node) not in self.size:
            raise yaml.composer.ComposerError(
                None, None, "an alias within its own anchor", mark
            )
        self.nodes += self.size[id(node)] if aliased else 1
        self.size[id(node)] = self.nodes - before
        if self.nodes > MAX_NODES:
            raise yaml.composer.ComposerError(
                None, None, f"more than {MAX_NODES} values", mark
            )
        return node

    def construct_object(self, node: yaml.Node, deep: bool = False) -> Any:
        """As in SafeLoader, but invalid numbers and dates are YAML errors."""
        try:
            return super().construct_object(node, deep)
        except (ValueError, TypeError, LookupError, OverflowError, AttributeError) as error:
            problem = f"{str(node.value)[:40]!r} is not a valid {node.tag.rpartition(':')[2]} ({error})"
            raise yaml.constructor.ConstructorError(
                None, None, problem, node.start_mark
            ) from None


# YAML 1.2, JSON and Python write 1e-4 without a point, and 1.5e9 without a sign.
StrictLoader.add_implicit_resolver(
    "tag:yaml.org,2002:float",
    re.compile(r"[-+]?(\d+\.?\d*|\.\d+)[eE][-+]?\d+$"),
    list("-+.0123456789"),
)


def parse_yaml(
    text: str, kind: type[StrictLoader] = StrictLoader
) -> tuple[yaml.Node | None, Any]:
    """The node tree of a YAML document, and its value. Raises YAMLError."""
    loader = kind(text)
    try:
        node = loader.get_single_node()
        return node, None if node is None else loader.construct_document(node)
    finally:
        loader.dispose()


@functools.lru_cache(maxsize=16)
def parse_kept(text: str) -> tuple[yaml.Node | None, Any]:
    """`parse_yaml` with a cache. The result must not be changed.

    All points of a study have the same scene and camera file, whose parsing takes ten times as long as the rest.
    """
    return parse_yaml(text)


def is_file(path: Path) -> bool:
    """Whether the file exists; False for a name that is not possible for a file."""
    try:
        return path.is_file()
    except OSError:
        return False


def existing_file(value: str) -> str:
    """The path of a file, as the validator of a key. Raises InputError if there is no such file."""
    if not is_file(Path(value)):
        raise InputError(
            "", f"{value!r} is not a file", "a path, or a file in the scene's folder"
        )
    return value


ExistingFile = Annotated[str, AfterValidator(existing_file)]


def find_file(name: str, folder: Path, what: str) -> Path:
    """The path of a .yaml file given by its path, or by its name in a folder. Raises InputError."""
    path = Path(name)
    if path.suffix in {".yaml", ".yml"} and is_file(path):
        return path
    shipped = shipped_files(folder)
    if name in shipped:
        return shipped[name]
    near = Path(f"{name}.yaml")
    if is_file(near):
        raise InputError(excerpt(name), f"no such {what}; did you mean {excerpt(near)}?")
    raise InputError(
        excerpt(name), f"no such {what}", f"a .yaml file or one of {', '.join(shipped)}"
    )


def excerpt(value: object) -> str:
    """A value for a message: on one line, truncated to MAX_EXCERPT characters."""
    return shortened(value, MAX_EXCERPT)


def parse_overrides(
    sets: list[str] | None, parameter: str = "overrides", form: str = "path.to.key=value"
) -> dict[str, str]:
    """Values by key from texts `path.to.key=value`, or of another form. Raises InputError that names the parameter."""
    overrides = {}
    for item in sets or []:
        key, equals, value = item.partition("=")
        if not equals or not key:
            raise InputError(parameter, excerpt(item), form)
        overrides[key] = value
    return overrides


def override_texts(
    overrides: Keys | None, base: Tree, whole: Sequence[str] = ()
) -> dict[str, str]:
    """The values of overrides as YAML texts, like those of `--set`: strings unchanged, other values as JSON.

    A mapping gives the dotted keys in it, so that it changes only these: `{"exposure": {"frames": 3}}` is
    `{"exposure.frames": 3}`. Some replace what the base has: an empty one, one with another `kind`, one over a value
    that is no mapping, and those of the keys `whole`. Raises InputError for a key that is given twice, and for values
    without a text.
    """
    if not isinstance(overrides, Mapping | None):
        raise InputError("overrides", excerpt(repr(overrides)), "values by dotted key")
    texts: dict[str, str] = {}

    def add(key: object, value: Any) -> None:
        if not isinstance(key, str):
            raise InputError("overrides", excerpt(repr(key)), "dotted keys")
        below = value_at(base, key)
        nested = isinstance(value, Mapping) and value and isinstance(below, dict)
        if nested and key not in whole and value.get("kind") in (None, below.get("kind")):
            for name, inner in value.items():
                add(f"{key}.{name}", inner)
            return
        text = value if isinstance(value, str) else as_json(key, value)
        if texts.setdefault(key, text) != text:
            problem = f"given twice, as {excerpt(texts[key])} and as {excerpt(text)}"
            raise InputError(key, problem, "one of the two", OVERRIDES)

    for key, value in (overrides or {}).items():
        add(key, value)
    return texts


def value_at(tree: Any, key: str) -> Any:
    """The value of a dotted key of a raw tree; an empty mapping without one."""
    for part in key.split("."):
        tree = tree.get(part, {}) if isinstance(tree, dict) else None
    return tree


def as_json(key: object, value: Any) -> str:
    """A value given in Python as JSON; numbers and arrays of numpy, dates and paths are those of YAML.

    Raises InputError for values of other types, with the key.
    """

    def as_plain(value: Any) -> Any:
        if isinstance(value, Path | datetime.date):
            return str(value)
        if isinstance(value, Mapping):
            return dict(value)
        if hasattr(value, "tolist"):
            return value.tolist()
        raise TypeError(excerpt(repr(value)))

    try:
        return json.dumps(value, default=as_plain)
    except (TypeError, ValueError, RecursionError) as error:
        raise InputError(key, error, "text, numbers, lists and mappings") from None


def as_tree(keys: Keys) -> tuple[Tree, str]:
    """A file's keys given in Python as a tree of YAML values, and its YAML text. Raises InputError as `as_json`."""
    tree = {"schema": VERSION, **{key: json.loads(as_json(key, keys[key])) for key in keys}}
    return tree, yaml.safe_dump(tree, sort_keys=False)


def check_bytes(path: Path, limit_bytes: int) -> None:
    """Raise InputError for a file of more than limit_bytes, and for a pipe or a device, whose reading may not end."""
    size = path.stat().st_size
    if not path.is_file():
        raise InputError(path, "not a regular file")
    if size > limit_bytes:
        raise InputError(path, f"{size} bytes", f"up to {limit_bytes}")


def read_limited(path: Path, limit_bytes: int, encoding: str = "utf-8") -> str:
    """The text of a file. Raises InputError if it is too large, cannot be read or is not UTF-8."""
    try:
        check_bytes(path, limit_bytes)
        return path.read_text(encoding)
    except (OSError, UnicodeDecodeError) as error:
        raise InputError(path, f"cannot be read: {reason(error)}") from error


def read_yaml(path: Path) -> tuple[Tree, str]:
    """A YAML mapping and its text. Raises InputError."""
    text = read_limited(path, MAX_BYTES)
    try:
        node, tree = (parse_kept if len(text) <= MAX_KEPT else parse_yaml)(text)
    except yaml.YAMLError as error:
        mark = getattr(error, "problem_mark", None)
        where = Where(path, mark.line + 1 if mark else None)
        raise InputError(
            path, f"not YAML: {getattr(error, 'problem', error)}", where=where
        ) from error
    if not isinstance(tree, dict):
        raise InputError(path, "", "a mapping of keys to values")
    reject_duplicate_keys(node, path)
    return copy.deepcopy(tree), text


def reject_duplicate_keys(node: yaml.Node | None, path: Path) -> None:
    """Raise InputError for a key that occurs twice in a mapping, of which YAML would use the last, or is null."""
    if isinstance(node, yaml.SequenceNode):
        for item in node.value:
            reject_duplicate_keys(item, path)
    if isinstance(node, yaml.MappingNode):
        names: set[str] = set()
        for key, value in node.value:
            is_null = key.tag.endswith(":null")
            if is_null or str(key.value) in names:
                where = Where(path, key.start_mark.line + 1)
                problem = "not a key" if is_null else "duplicate key"
                raise InputError(excerpt(key.value or "null"), problem, where=where)
            names.add(str(key.value))
            reject_duplicate_keys(value, path)


def check_version(tree: Keys, path: Path, text: str) -> None:
    """Raise InputError for a file of another schema version, so that its keys are not reported as unknown."""
    if "schema" not in tree:
        raise InputError(
            "schema", f"missing; add the line schema: {VERSION}", where=Where(path)
        )
    version = tree["schema"]
    if type(version) is int and version == VERSION:
        return
    problem = f"unknown version {excerpt(repr(version))}"
    if type(version) is int and version > VERSION:
        problem = f"version {version} is newer than skysim {__version__} supports"
    elif type(version) is int:
        problem = f"version {version} is no longer supported"
    raise InputError("schema", problem, VERSION, where_of("schema", [(path, text)], {}))


def set_key(tree: Tree, key: str, value: str) -> None:
    """Set one dotted key of a raw tree to a YAML value. A number is an index into a list: `camera_body.2`.

    Raises InputError for a value that is not YAML, and for a key below a value.
    """
    *parents, last = key.split(".")
    if not all((*parents, last)):
        raise InputError(
            OVERRIDES.file, f"{excerpt(key)}={excerpt(value)}", "path.to.key=value"
        )
    node: Any = tree
    for depth, parent in enumerate(parents):
        if isinstance(node, dict):
            node.setdefault(parent, {})
        node = node[index_in(node, parent, key)]
        if not isinstance(node, dict | list):
            section = excerpt(".".join(parents[: depth + 1]))
            raise InputError(
                excerpt(key), f"{section} holds a value, not keys", where=OVERRIDES
            )
    try:
        node[index_in(node, last, key)] = parse_yaml(value)[1]
    except yaml.YAMLError as error:
        raise InputError(
            excerpt(key), f"{excerpt(repr(value))} is not YAML", where=OVERRIDES
        ) from error


def one_line(value: Any, **options: Any) -> str:
    """A value as YAML on one line, with further options of YAML's writer."""
    dumped: str = yaml.safe_dump(value, default_flow_style=True, width=1_000_000, **options)
    return dumped.removesuffix("...\n").strip()


def opened_sections(before: list[str], sections: list[str]) -> list[str]:
    """The lines of YAML that open the nested sections of a key, without those that it shares with the key before."""
    return [
        f"{'  ' * n}{name}:"
        for n, name in enumerate(sections)
        if before[: n + 1] != sections[: n + 1]
    ]


def index_in(values: Any, component: str, key: str) -> Any:
    """A component of a dotted key as the key of a mapping or the index of a list. Raises InputError if it is none."""
    if isinstance(values, dict):
        return component
    digits = component.isascii() and component.isdigit() and len(component) < 10
    if not digits or int(component) >= len(values):
        raise InputError(
            excerpt(key),
            f"{excerpt(component)} is not a list index",
            f"0 to {len(values) - 1}",
            OVERRIDES,
        )
    return int(component)


# The allowed values by pydantic's type of the error, with placeholders for its context.
EXPECTED = {
    "greater_than": "greater than {gt}",
    "greater_than_equal": "greater than or equal to {ge}",
    "less_than": "less than {lt}",
    "less_than_equal": "less than or equal to {le}",
    "literal_error": "{expected}",
    "string_pattern_mismatch": "{pattern}",
    "string_too_short": "a text that is not empty",
    "string_too_long": "at most {max_length} characters",
    "too_short": "at least {min_length} values",
    "too_long": "at most {max_length} values",
    "string_type": "text",
    "model_type": "a mapping of keys to values",
    "model_attributes_type": "a mapping of keys to values",
    "dict_type": "a mapping of keys to values",
    "int_type": "a valid integer",
    "float_type": "a valid number",
    "finite_number": "a finite number",
    "bool_type": "true or false",
    "tuple_type": "a list",
    "list_type": "a list",
}


# The patterns of names and keys in words.
PATTERNS = {
    r"^\w[\w.-]*$": "letters, digits, _, . and -, the first no . or -",
    r"^[a-z]\w*$": "letters, digits and _, the first a small letter",
    r"^[a-z_]+(\.\w+)*$": "a dotted key, such as exposure.time",
    r"^[a-z_]+(\.\w+)*[._]seed$": "a dotted key of a seed",
}


@contextmanager
def explained(tree: Tree, files: Files, overrides: OverrideTexts) -> Iterator[None]:
    """Raise the first error of a validation as an InputError.

    Such as `light.kind: unknown kind 'domes'; allowed: … (scenes/x.yaml, line 31)`.

    Parameters
    ----------
    tree
        Merged content of the files
    files
        Paths and texts of the files, the one with the highest priority first
    overrides
        YAML texts by dotted key
    """
    try:
        yield
        return
    except ValidationError as error:
        faults = error.errors()
    # 1. A key of another section may be missing too.
    first = min(faults, key=lambda item: item["type"] == "missing")
    missing = first["type"] == "missing"
    # 2. Keys and problem.
    keys = [str(key) for key in yaml_keys(first["loc"], tree, missing)]
    found = fault_of(first)
    if found.key:
        keys.append(found.key)
    key = ".".join(keys)
    # 3. A missing key has no line of its own, so the line is that of its section. (A file may have the key in a section
    # or list that another file replaces.)
    where = where_of(key.rpartition(".")[0] if missing else key, files, overrides)
    raise InputError(excerpt(key), found.problem, found.allowed, where) from None


def fault_of(error: ErrorDetails) -> InputError:
    """One error of pydantic as InputError; its key is relative to the error's location."""
    kind = error["type"]
    context = error.get("ctx", {})
    # An error of a validator, which may name a key below.
    if kind == "value_error":
        cause = context["error"]
        return cause if isinstance(cause, InputError) else InputError("", cause)
    if kind == "missing":
        return InputError("", "missing")
    if kind == "union_tag_invalid":
        kinds = [context["expected_tags"].replace("'", "")]
        return InputError("kind", *unknown_name("kind", context["tag"], kinds))
    if kind == "union_tag_not_found":
        return InputError("", "kind is missing")
    value = excerpt(repr(error["input"]))
    if kind not in EXPECTED:
        return InputError("", f"{value} is not allowed: {error['msg']}")
    limits = {  # numbers without an exponent, such as 0.000001
        name: f"{Decimal(repr(limit)).normalize():f}" if isinstance(limit, float) else limit
        for name, limit in context.items()
    }
    if kind == "string_pattern_mismatch":
        limits["pattern"] = PATTERNS[limits["pattern"]]
    return InputError("", f"{value} is not allowed", EXPECTED[kind].format(**limits))


def where_of(key: str, files: Files, overrides: OverrideTexts) -> Where | None:
    """The place that sets a dotted key: OVERRIDES, or the line in the file that has most components of the key."""
    if any(f"{key}.".startswith(f"{one}.") for one in overrides):
        return OVERRIDES
    matches = [(*line_of(text, key.split(".")), path) for path, text in files]
    # `max` takes the first file of those with equal depth; in Python there may be no file.
    _, line, path = max(matches, key=lambda match: match[0], default=(0, None, None))
    if path and path.name == MAPPING:
        return Where(f"{MAPPING}, files in {path.resolve().parent}")
    return Where(path, line) if path else None


def yaml_keys(loc: tuple[int | str, ...], tree: Any, missing: bool) -> list[int | str]:
    """The location of an error as keys of the tree, without pydantic's names of union branches.

    The last key may be missing in the tree.
    """
    keys = []
    for n, key in enumerate(loc):
        last = missing and n == len(loc) - 1
        if isinstance(tree, list):
            tree = dict(enumerate(tree))
        if isinstance(tree, dict) and (key in tree or last):
            keys.append(key)
            tree = tree.get(key)
    return keys


def suggestion(word: str, allowed: Sequence[str]) -> str:
    """Text with the most similar of the allowed words, to end a problem; empty if none is similar."""
    close = difflib.get_close_matches(word, allowed, 1)
    return f"; did you mean {close[0]}?" if close else ""


def line_of(text: str, keys: list[str]) -> tuple[int, int | None]:
    """The number of leading components of a dotted key that are in the text, and the line of the last of them."""
    lines = key_lines(text)
    depth = max((n for n in range(len(keys) + 1) if tuple(keys[:n]) in lines), default=0)
    return depth, lines.get(tuple(keys[:depth]))


def key_lines(text: str) -> dict[tuple[str, ...], int]:
    """The line of every key of a YAML text, and of every item of its lists, by nested keys."""
    lines: dict[tuple[str, ...], int] = {}

    def visit(node: yaml.Node | None, keys: tuple[str, ...]) -> None:
        """Add the lines below a node at nested keys."""
        found = node.value if isinstance(node, yaml.MappingNode) else ()
        inner = [(str(key.value), key, value) for key, value in found]
        if isinstance(node, yaml.SequenceNode):
            inner = [(str(n), item, item) for n, item in enumerate(node.value)]
        for name, place, value in inner:
            # A key with dots is found by its components.
            inside = (*keys, *name.split("."))
            lines[inside] = place.start_mark.line + 1
            visit(value, inside)

    visit(yaml.compose(text, yaml.SafeLoader), ())
    return lines


def yaml_line(value: Any) -> str:
    """Format a value as one line of YAML; strings are returned unchanged."""
    if isinstance(value, str):
        return value
    return one_line(value, allow_unicode=True, sort_keys=False)
