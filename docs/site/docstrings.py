"""Docstrings as they are written here, for Markdown: equations are indented, and `name : meaning` stands on a line.

A section of a scene or study file gains the table of its keys.
"""

from __future__ import annotations

import re
import sys
from pathlib import Path
from typing import Any

import griffe

sys.path.insert(0, str(Path(__file__).parent))
import keys

SECTIONS = keys.sections()

TERM = re.compile(r"^([a-zA-Z]\w*(?:, \w+)* +|[a-z]\w*(?:, \w+)*): +(?=\S)")
MARKS = re.compile(r"([*_\[\]])")
CODE = re.compile(r"(`[^`]*`)")


class Docstrings(griffe.Extension):
    """Rewrite every docstring before it is shown."""

    def on_object(self, *, obj: Any, **_: Any) -> None:
        """Called once an object has been read."""
        told = [] if obj.docstring is None else [markdown(obj.docstring.value)]
        if obj.path in SECTIONS:
            told.append(keys.table(SECTIONS[obj.path]))
        if told:
            obj.docstring = griffe.Docstring("\n\n".join(told), parent=obj)


def markdown(text: str) -> str:
    """Lists of terms become lists, marks become letters; indented blocks stay the code that they are."""
    return "\n\n".join(shown(part) for part in re.split(r"\n\s*\n", text))


def shown(part: str) -> str:
    """One paragraph."""
    lines = part.split("\n")
    if all(line.startswith("    ") for line in lines):
        return part
    out: list[str] = []
    listed = False
    for line in lines:
        term = TERM.match(line)
        if term:
            gap = [""] if out and not listed else []
            out += [*gap, f"- `{term[1].strip()}`: {plain(line[term.end() :])}"]
            listed = True
        elif listed and line.startswith(" "):
            out.append(f"    {plain(line.strip())}")
        else:
            out += ["", plain(line.strip())] if listed else [plain(line.strip())]
            listed = False
    return "\n".join(out)


def plain(text: str) -> str:
    """Markdown's and HTML's marks outside of code as the letters that they are."""
    pieces = CODE.split(text)
    return "".join(
        piece if piece[:1] == "`" else MARKS.sub(r"\\\1", piece.replace("<", "&lt;")) for piece in pieces
    )
