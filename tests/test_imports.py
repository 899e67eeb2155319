"""The import graph has no cycle, counting lazy imports and those for type checkers."""

import ast
from collections.abc import Iterator
from functools import cache
from pathlib import Path

import pytest

from skysim.core.paths import ROOT


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
    """Imports of each module."""
    return {name: imported(path) - {name} for name, path in FILES.items()}


def circles(uses_of: dict[str, set[str]]) -> list[str]:
    """Modules left after repeatedly removing those without remaining imports: the cycles."""
    left = {name: set(uses) for name, uses in uses_of.items()}
    while done := {name for name, uses in left.items() if not uses}:
        left = {name: uses - done for name, uses in left.items() if name not in done}
    return sorted(left)


def test_an_import_cycle_is_found() -> None:
    assert circles({"a": {"b"}, "b": {"c"}, "c": {"b"}, "d": set()}) == ["a", "b", "c"]


@pytest.mark.slow
def test_no_module_imports_itself_through_others() -> None:
    assert len(graph()) > 250
    assert circles(graph()) == []


@pytest.mark.parametrize("package", ["skysim", "estimator"])
def test_no_folder_holds_too_many_modules(package: str) -> None:
    """About a dozen modules per folder; each folder needs a description, so many small ones are no better."""
    for folder in {
        path.parent for path in FILES.values() if path.is_relative_to(ROOT / package)
    }:
        entries = {path.name for path in folder.iterdir()} - {
            "__init__.py",
            "__pycache__",
            "__main__.py",
            "README.md",
        }
        assert len(entries) <= 18, sorted(entries)


@pytest.mark.slow
def test_no_file_imports_a_module_of_ours_under_two_names() -> None:
    """Two names for one module read like two modules."""
    for name, path in FILES.items():
        names_of: dict[str, set[str]] = {}
        for statement in statements(ast.parse(path.read_text(encoding="utf-8"))):
            if isinstance(statement, ast.ImportFrom):
                for alias in statement.names:
                    module = f"{statement.module}.{alias.name}"
                    if module in FILES:
                        names_of.setdefault(module, set()).add(alias.asname or alias.name)
        doubled = {module: names for module, names in names_of.items() if len(names) > 1}
        assert doubled == {}, name
