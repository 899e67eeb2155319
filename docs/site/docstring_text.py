"""Convert docstrings in NumPy style to Markdown: equations are indented, sections have underlined heads."""

from __future__ import annotations

import re

HEAD = re.compile(r"^([A-Z]\w+)\n-+\n")
MARKS = re.compile(r"([*_\[\]])")
CODE = re.compile(r"(`[^`]*`)")


def to_markdown(text: str) -> str:
    """Convert sections to lists and escape marks; indented blocks stay code."""
    return "\n\n".join(
        paragraph_to_markdown(paragraph) for paragraph in re.split(r"\n\s*\n", text)
    )


def paragraph_to_markdown(paragraph: str) -> str:
    """Convert one paragraph, or one section."""
    if head := HEAD.match(paragraph):
        items = [f"- `{names}`: {escape(text)}" for names, text in terms(paragraph).items()]
        return "\n".join(items if head[1] == "Attributes" else [f"**{head[1]}**", "", *items])
    lines = paragraph.split("\n")
    if all(line.startswith("    ") for line in lines):
        return paragraph
    return "\n".join(escape(line.strip()) for line in lines)


def terms(docstring: str) -> dict[str, str]:
    """What a docstring's sections say of each name, or of several names on one line."""
    found: dict[str, str] = {}
    for section in re.split(r"\n\s*\n", docstring):
        if not HEAD.match(section):
            continue
        names = ""
        for line in section.splitlines()[2:]:
            if line.startswith(" "):
                found[names] = f"{found[names]} {line.strip()}".strip()
            else:
                names = line.strip()
                found[names] = ""
    return found


def escape(text: str) -> str:
    """Escape Markdown and HTML outside of code."""
    pieces = CODE.split(text)
    return "".join(
        piece if piece[:1] == "`" else MARKS.sub(r"\\\1", piece.replace("<", "&lt;"))
        for piece in pieces
    )
