"""Errors: parts survive every copy, the text is one printable line, and rules for all code that raises them."""

from __future__ import annotations

import ast
import copy
import pickle
import re
from collections.abc import Callable, Iterator
from concurrent.futures import ProcessPoolExecutor
from pathlib import Path

import pytest

from estimator.core.errors import ImageError
from skysim.core.errors import OVERRIDES, InputError, Where, check_name, unknown_name

ROOT = Path(__file__).parents[2]
COUNT = InputError(
    "light.layout.count", "-3 is negative", "1 to 100,000", Where("scenes/x.yaml", 31)
)
READS_TEXT = {
    "split",
    "partition",
    "rpartition",
    "startswith",
    "endswith",
    "removeprefix",
    "removesuffix",
    "replace",
}
COMMAND_LINE = re.compile(r"(?<![\w-])--[a-z]|skysim \w+ ")


@pytest.mark.parametrize("error", [lambda text: InputError("", text), ImageError])
@pytest.mark.parametrize("quoted", ["\x1e", "a\nb", "\x1b[2J", "\u2028", "\ud800"])
def test_message_is_one_printable_line(
    error: Callable[[str], Exception], quoted: str
) -> None:
    message = str(error(f"file.tle, line 2: the checksum is {quoted}; it should be 9"))
    assert message.isprintable()
    assert message.startswith("file.tle, line 2: ")
    assert message.endswith("; it should be 9")


@pytest.mark.parametrize("quoted", ["\x1e", "a\nb", "\x1b[2J", "\u2028", "\ud800"])
def test_every_part_is_printable(quoted: str) -> None:
    error = InputError(quoted, quoted, quoted, Where(quoted, 3))
    assert str(error).isprintable()
    assert all(
        part.isprintable()
        for part in (error.key, error.problem, error.allowed, str(error.where))
    )


@pytest.mark.parametrize(
    ("error", "line"),
    [
        (
            COUNT,
            "light.layout.count: -3 is negative; allowed: 1 to 100,000 (scenes/x.yaml, line 31)",
        ),
        (InputError("seed", "missing"), "seed: missing"),
        (InputError("seed", "", "0 or more"), "seed: allowed: 0 or more"),
        (InputError("", "no frame has been rendered"), "no frame has been rendered"),
        (
            InputError("seed", "-1", "0 or more", OVERRIDES),
            "seed: -1; allowed: 0 or more (overrides)",
        ),
        (InputError("schema", "missing", where=Where("x.yaml")), "schema: missing (x.yaml)"),
        (
            InputError("a.csv", "3 numbers", 4, Where("a.csv", 7)),
            "a.csv, line 7: 3 numbers; allowed: 4",
        ),
        (
            InputError(Path("a.csv"), "bad", "", Where(Path("a.csv"), 7, "row")),
            "a.csv, row 7: bad",
        ),
        (
            InputError("a.csv", "empty", "a table", Where("a.csv")),
            "a.csv: empty; allowed: a table",
        ),
    ],
)
def test_the_error_line_has_place_problem_and_allowed_values(
    error: InputError, line: str
) -> None:
    assert str(error) == line


def test_an_unknown_name_has_a_problem_and_the_allowed_names() -> None:
    error = InputError("tracker.solver", *unknown_name("solver", "magic", ["quest", "svd"]))
    assert (error.problem, error.allowed) == ("unknown solver 'magic'", "quest, svd")


def test_only_a_name_that_is_not_allowed_is_refused() -> None:
    check_name("tracker.solver", "solver", "svd", ["quest", "svd"])
    with pytest.raises(InputError) as refused:
        check_name("tracker.solver", "solver", "magic", ["quest", "svd"])
    assert str(refused.value) == "tracker.solver: unknown solver 'magic'; allowed: quest, svd"


def parts(error: InputError) -> tuple[str, str, str, Where | None]:
    return error.key, error.problem, error.allowed, error.where


@pytest.mark.parametrize(
    "twin", [copy.copy, copy.deepcopy, lambda error: pickle.loads(pickle.dumps(error))]
)
@pytest.mark.parametrize(
    "error", [COUNT, InputError("", "none"), InputError("a", "b", "c", OVERRIDES)]
)
def test_a_copy_has_the_same_parts(
    twin: Callable[[InputError], InputError], error: InputError
) -> None:
    other = twin(error)
    assert other is not error
    assert parts(other) == parts(error)
    assert str(other) == str(error)


def refuse() -> None:
    raise COUNT


def test_an_error_keeps_its_parts_across_processes() -> None:
    with ProcessPoolExecutor(1) as pool, pytest.raises(InputError) as raised:
        pool.submit(refuse).result()
    assert parts(raised.value) == parts(COUNT)


def test_a_section_is_prepended_to_an_error_s_key() -> None:
    assert parts(COUNT.under("heads.0")) == ("heads.0.light.layout.count", *parts(COUNT)[1:])
    assert InputError("", "missing").under("heads.0").key == "heads.0"


def test_within_the_key_of_a_file_the_problem_starts_with_the_file_s_name() -> None:
    table = InputError("a.csv", "3 numbers", "4", Where("a.csv", 7))
    assert parts(table.within("light.file")) == (
        "light.file",
        "a.csv, line 7: 3 numbers",
        "4",
        None,
    )
    assert str(table.within("light.file").at(Where("x.yaml", 2))) == (
        "light.file: a.csv, line 7: 3 numbers; allowed: 4 (x.yaml, line 2)"
    )
    assert COUNT.within("factors.size").where == COUNT.where  # the key's own place stays
    assert InputError("", "not even").within("points").problem == "not even"


def test_setting_an_error_s_place_keeps_its_other_parts() -> None:
    assert parts(COUNT.at(Where("y.yaml"))) == (*parts(COUNT)[:3], Where("y.yaml"))
    assert COUNT.at(None).where is None


def test_every_change_of_an_error_returns_a_new_one() -> None:
    before = parts(COUNT)
    COUNT.under("a").within("b").at(None)
    assert parts(COUNT) == before


def modules(folder: str) -> Iterator[tuple[Path, ast.Module, str]]:
    for path in sorted((ROOT / folder).rglob("*.py")):
        text = path.read_text(encoding="utf-8")
        yield path.relative_to(ROOT), ast.parse(text), text


def made_errors(tree: ast.AST) -> Iterator[ast.Call]:
    """Calls of InputError."""
    for node in ast.walk(tree):
        if (
            isinstance(node, ast.Call)
            and getattr(node.func, "id", getattr(node.func, "attr", "")) == "InputError"
        ):
            yield node


def mentions(tree: ast.AST, name: str) -> bool:
    return any(isinstance(node, ast.Name) and node.id == name for node in ast.walk(tree))


@pytest.mark.slow
def test_an_error_requires_a_key_and_a_problem() -> None:
    found = [
        f"{path}:{call.lineno}"
        for path, tree, _ in modules("skysim")
        for call in made_errors(tree)
        if len(call.args) < 2
    ]
    assert not found


@pytest.mark.slow
def test_only_errors_of_the_command_line_mention_it() -> None:
    found = [
        f"{path}:{node.lineno}"
        for path, tree, text in modules("skysim")
        if path.parts[1:3] not in (("apps", "cli"), ("apps", "live"))
        and COMMAND_LINE.search(text)  # else no node is searched, which takes seconds
        for node in [
            *made_errors(tree),
            *(one for one in ast.walk(tree) if isinstance(one, ast.Raise)),
        ]
        if COMMAND_LINE.search(ast.get_source_segment(text, node) or "")
    ]
    assert not found


def catchers(tree: ast.AST) -> Iterator[ast.ExceptHandler]:
    """Handlers of InputError that name it."""
    for node in ast.walk(tree):
        if (
            isinstance(node, ast.ExceptHandler)
            and node.type
            and node.name
            and mentions(node.type, "InputError")
        ):
            yield node


def reads_text(node: ast.AST, error: str) -> bool:
    """Whether an expression splits or searches the text of an error, or uses it as a key."""
    if isinstance(node, ast.Compare):
        return any(mentions(one, "str") and mentions(one, error) for one in node.comparators)
    if not isinstance(node, ast.Call) or not isinstance(node.func, ast.Attribute | ast.Name):
        return False
    if isinstance(node.func, ast.Name):
        return (
            node.func.id == "InputError"
            and isinstance(node.args[0], ast.JoinedStr)
            and mentions(node.args[0], error)
        )
    if mentions(node.func.value, "re"):
        return any(mentions(one, error) for one in node.args)
    return (
        node.func.attr in READS_TEXT
        and mentions(node.func.value, "str")
        and mentions(node.func.value, error)
    )


@pytest.mark.slow
def test_no_handler_reads_the_text_of_an_error() -> None:
    found = [
        f"{path}:{node.lineno}"
        for path, tree, _ in modules("skysim")
        for handler in catchers(tree)
        for statement in handler.body
        for node in ast.walk(statement)
        if handler.name and reads_text(node, handler.name)
    ]
    assert not found


@pytest.mark.parametrize(
    "statement",
    [
        'key = str(error).partition(":")[0]',
        'text = str(error).removeprefix("light: ")',
        'text = re.sub("a", "b", str(error))',
        'if "light" in str(error): pass',
        'raise InputError(f"heads.0.{error}", "bad")',
    ],
)
def test_a_handler_that_reads_an_error_s_text_is_detected(statement: str) -> None:
    tree = ast.parse(f"try:\n    pass\nexcept InputError as error:\n    {statement}\n")
    (handler,) = catchers(tree)
    assert any(reads_text(node, "error") for node in ast.walk(handler))
