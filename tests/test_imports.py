"""The import graph: one way down, and no circle anywhere, lazy imports and those for type checkers counted."""

import ast
from collections.abc import Iterator
from functools import cache
from pathlib import Path

import pytest

from skysim.core.files import ROOT


def module_of(path: Path) -> str:
    parts = path.relative_to(ROOT).with_suffix("").parts
    return ".".join(parts[:-1] if parts[-1] == "__init__" else parts)


FILES = {
    module_of(path): path
    for package in ("skysim", "estimator")
    for path in (ROOT / package).rglob("*.py")
}


def statements(node: ast.AST) -> Iterator[ast.AST]:
    """Every import, in functions and for type checkers too."""
    for child in ast.iter_child_nodes(node):
        if isinstance(child, ast.Import | ast.ImportFrom):
            yield child
        yield from statements(child)


def imported(path: Path) -> set[str]:
    """Our own modules that a file imports: `from a import b` is a.b where that is a module, else a."""
    names = set()
    for statement in statements(ast.parse(path.read_text(encoding="utf-8"))):
        if isinstance(statement, ast.Import):
            names |= {alias.name for alias in statement.names}
        elif statement.module:
            full = {f"{statement.module}.{alias.name}" for alias in statement.names}
            names |= {name if name in FILES else statement.module for name in full}
    return names & FILES.keys()


@cache
def graph() -> dict[str, set[str]]:
    """What each module imports."""
    return {name: imported(path) - {name} for name, path in FILES.items()}


def circles(uses_of: dict[str, set[str]]) -> list[str]:
    """What is left when modules whose imports are all gone are taken away, again and again."""
    left = {name: set(uses) for name, uses in uses_of.items()}
    while done := {name for name, uses in left.items() if not uses}:
        left = {name: uses - done for name, uses in left.items() if name not in done}
    return sorted(left)


def test_a_circle_is_found() -> None:
    assert circles({"a": {"b"}, "b": {"c"}, "c": {"b"}, "d": set()}) == ["a", "b", "c"]


def test_no_module_imports_itself_by_way_of_others() -> None:
    assert len(graph()) > 250
    assert circles(graph()) == []


@pytest.mark.parametrize("package", ["skysim", "estimator"])
def test_no_folder_holds_more_than_a_reader_takes_in(package: str) -> None:
    """A dozen or a little more; a folder needs a sentence of its own, so that many small ones read no better."""
    for folder in {path.parent for path in FILES.values() if path.is_relative_to(ROOT / package)}:
        entries = {path.name for path in folder.iterdir()} - {
            "__init__.py",
            "__pycache__",
            "__main__.py",
            "README.md",
        }
        assert len(entries) <= 18, sorted(entries)
