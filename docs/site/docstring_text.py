"""Convert this project's docstrings (indented equations, lines `name : meaning`) to Markdown."""

from __future__ import annotations

import re

TERM = re.compile(r"^([a-zA-Z]\w*(?:, \w+)* +|[a-z]\w*(?:, \w+)*): +(?=\S)")
MARKS = re.compile(r"([*_\[\]])")
CODE = re.compile(r"(`[^`]*`)")


def to_markdown(text: str) -> str:
    """Convert lines `name : meaning` to lists and escape marks; indented blocks stay code."""
    return "\n\n".join(paragraph_to_markdown(paragraph) for paragraph in re.split(r"\n\s*\n", text))


def paragraph_to_markdown(paragraph: str) -> str:
    """Convert one paragraph."""
    lines = paragraph.split("\n")
    if all(line.startswith("    ") for line in lines):
        return paragraph
    lines_out: list[str] = []
    in_list = False
    for line in lines:
        term = TERM.match(line)
        if term:
            separator = [""] if lines_out and not in_list else []
            lines_out += [*separator, f"- `{term[1].strip()}`: {escape(line[term.end() :])}"]
            in_list = True
        elif in_list and line.startswith(" "):
            lines_out.append(f"    {escape(line.strip())}")
        else:
            lines_out += ["", escape(line.strip())] if in_list else [escape(line.strip())]
            in_list = False
    return "\n".join(lines_out)


def escape(text: str) -> str:
    """Escape Markdown and HTML outside of code."""
    pieces = CODE.split(text)
    return "".join(
        piece if piece[:1] == "`" else MARKS.sub(r"\\\1", piece.replace("<", "&lt;"))
        for piece in pieces
    )
