"""List the findings pages whose code has changed since they were made; `make stale` runs this.

A page has one line such as

    Code version: `1a2b3c4d` (skysim.camera, estimator, scenes/studies/led_count.yaml), 2026-11-26, seed 3

The version is a hash over what the page depends on. For Python packages it is taken from the syntax tree, so layout,
comments and docstrings do not change it; neither does a move of a function between modules of one package.

`python docs/site/stale.py` lists stale pages. `python docs/site/stale.py --stamp PAGE...` writes today's version and
date into pages that were made again by hand.
"""

from __future__ import annotations

import ast
import datetime
import hashlib
import re
import sys
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path
from typing import NamedTuple

import yaml

ROOT = Path(__file__).resolve().parents[2]
FINDINGS = ROOT / "docs" / "findings"
OURS = ("skysim", "estimator")
LINE = re.compile(
    r"^Code version: `(?P<version>[0-9a-f]{8})` \((?P<needs>[^)]+)\), (?P<date>\d{4}-\d\d-\d\d), seed (?P<seed>\S+)$",
    re.MULTILINE,
)
COMMAND = re.compile(r"^```(?:sh|text)\n(.*?)$", re.MULTILINE)

Files = Callable[
    [str], dict[str, bytes]
]  # contents by path, of a package, a folder or a file


class Stamp(NamedTuple):
    """The line of a page: hash, what it covers (packages and paths), date, and the seed or seeds."""

    version: str
    needs: tuple[str, ...]
    date: str
    seed: str

    @property
    def line(self) -> str:
        """The line as a page has it."""
        return f"Code version: `{self.version}` ({', '.join(self.needs)}), {self.date}, seed {self.seed}"


def read_stamp(text: str) -> Stamp:
    """The stamp of a page. Raises ValueError unless the page has exactly one."""
    found = LINE.findall(text)
    if len(found) != 1:
        raise ValueError(f"{len(found)} lines 'Code version: …' instead of one")
    version, needs, date, seed = found[0]
    return Stamp(version, tuple(needs.split(", ")), date, seed)


def make_stamp(needs: Sequence[str], seed: object, date: str = "") -> Stamp:
    """The stamp of a page that was made from the code in the working tree, today by default."""
    date = date or datetime.date.today().isoformat()
    return Stamp(code_version(needs), tuple(needs), date, str(seed))


def code_version(needs: Sequence[str], files: Files | None = None) -> str:
    """Hash of packages, folders and files, 8 hexadecimal digits.

    needs : dotted names of packages, or paths in the repository
    files : reads them; by default from the working tree

    1. Read the files of each name.
    2. Reduce Python to the set of its statements, YAML to its values; other files count as they are.
    3. Hash the sorted parts. A name without files counts as empty, so a removed package changes the version.
    """
    files = files or working_tree
    total = hashlib.sha256()
    for name in needs:
        parts = {part for path, text in files(name).items() for part in meaning(path, text)}
        total.update(repr((name, sorted(parts))).encode())
    return total.hexdigest()[:8]


def meaning(path: str, text: bytes) -> Iterator[str]:
    """Parts of a file that can change a result, without comments, docstrings and layout."""
    if path.endswith(".py"):
        yield from statements(text.decode("utf-8"))
    elif path.endswith((".yaml", ".yml")):
        yield f"{Path(path).name} {yaml.safe_load(text)!r}"
    else:
        yield f"{Path(path).name} {hashlib.sha256(text).hexdigest()}"


def statements(source: str) -> Iterator[str]:
    """Top-level statements of a module as dumps of their syntax trees.

    Imports from our own packages are left out: they change when a function moves, and its body is hashed where it is.
    """
    tree = ast.parse(source)
    for node in ast.walk(tree):
        strip_docstring(node)
    for statement in tree.body:
        if not is_own_import(statement):
            yield ast.dump(statement)


def strip_docstring(node: ast.AST) -> None:
    """Remove the docstring of a module, class or function, in place."""
    if isinstance(node, (ast.Module, ast.ClassDef, ast.FunctionDef, ast.AsyncFunctionDef)):
        first = node.body[0] if node.body else None
        match first:
            case ast.Expr(value=ast.Constant(value=str())):
                del node.body[0]


def is_own_import(statement: ast.stmt) -> bool:
    """Return True for imports from our packages, from __future__, and those for type checking alone."""
    match statement:
        case ast.Import():
            modules = [alias.name for alias in statement.names]
        case ast.ImportFrom():
            modules = [statement.module or ""]
        case ast.If(test=ast.Name(id="TYPE_CHECKING")):
            return True
        case _:
            return False
    return all(module.split(".")[0] in (*OURS, "__future__") for module in modules)


def folder_of(name: str) -> str:
    """Path in the repository of a dotted name; a path is returned as it is."""
    return name.replace(".", "/") if name.split(".")[0] in OURS and "/" not in name else name


def working_tree(name: str) -> dict[str, bytes]:
    """Files of a package or path in the working tree."""
    path = ROOT / folder_of(name)
    if path.is_file():
        return {name: path.read_bytes()}
    pattern = "*.py" if name.split(".")[0] in OURS else "*"
    return {
        str(one.relative_to(ROOT)): one.read_bytes()
        for one in path.rglob(pattern)
        if one.is_file()
    }


def pages() -> list[Path]:
    """All findings pages with a stamp; an overview of other pages has none."""
    found = sorted(FINDINGS.rglob("*.md"))
    return [path for path in found if "\nCode version: " in path.read_text(encoding="utf-8")]


def stale_lines() -> list[str]:
    """One line for each stale page: its path, the date it was made, and the command that makes it again."""
    lines = []
    for path in pages():
        text = path.read_text(encoding="utf-8")
        stamp = read_stamp(text)
        if code_version(stamp.needs) != stamp.version:
            command = COMMAND.search(text)
            again = f"; again: {command[1].partition('  #')[0].strip()}" if command else ""
            lines.append(f"{path.relative_to(ROOT)}: code changed since {stamp.date}{again}")
    return lines


def main(arguments: Sequence[str]) -> None:
    """List stale pages, or stamp pages anew."""
    if arguments[:1] == ["--stamp"]:
        for name in arguments[1:]:
            path = Path(name)
            text = path.read_text(encoding="utf-8")
            old = read_stamp(text)
            path.write_text(
                LINE.sub(make_stamp(old.needs, old.seed).line, text), encoding="utf-8"
            )
        return
    lines = stale_lines()
    print("\n".join(lines) or f"All {len(pages())} pages are of today's code.")


if __name__ == "__main__":
    main(sys.argv[1:])
