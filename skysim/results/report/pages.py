"""A report as a Markdown page. Its figures are files beside it."""

from __future__ import annotations

import re
from collections.abc import Iterator, Sequence
from skysim.results.report.blocks import (
    Block,
    Cell,
    Code,
    Facts,
    Figure,
    Items,
    Section,
    Table,
    Text,
    Verdict,
    figure_files,
)
import base64
import math
from skysim.results.report.blocks import Block, Cell



TAG = re.compile(r"<(?=[A-Za-z/!?])")
FENCE = re.compile(r"^`{3,}", re.MULTILINE)


def markdown_page(title: str, command: str, blocks: Sequence[Block], pictures: str = "") -> str:
    """The page. pictures : what the paths of the figures begin with; they are left out without it"""
    begin = [Code(command, "sh")] if command else []
    names = iter([pictures + name for name, _ in figure_files(blocks)] if pictures else [])
    return "\n\n".join(paragraphs(Section(title, [*begin, *blocks]), 1, names)) + "\n"


def paragraphs(block: Block, level: int, names: Iterator[str]) -> Iterator[str]:
    """A block's paragraphs. level : of a section's heading;  names : of the figures from this one on"""
    match block:
        case Section(title=title, folded=folded):
            opened = (
                '<details markdown="1"><summary>{}</summary>' if folded else "#" * level + " {}"
            )
            yield opened.format(inline(title))
            for one in block.blocks:
                yield from paragraphs(one, level + 1, names)
            yield from ["</details>"] if folded else []
        case Figure(caption=caption):
            if name := next(names, ""):
                yield f"![{inline(caption).replace('[', '(').replace(']', ')')}]({name})"
                yield f"*{inline(caption)}*"
        case Verdict(text=text):
            yield f"**{inline(text)}**"
        case Text(text=text):
            yield inline(text)
        case Items(lines=lines, title=title):
            yield from [f"**{inline(title)}**"] if title else []
            yield "\n".join(f"- {inline(line)}" for line in lines)
        case Facts(rows=rows):
            yield table(
                ["", ""],
                [[cell(Cell(name)), "<br>".join(map(cell, lines))] for name, lines in rows],
            )
        case Table():
            yield table(
                [inline(one.head) for one in block.columns],
                [list(map(cell, row)) for row in block.cells()],
            )
        case Code(text=text, language=language):
            fence = max(["```", *(found + "`" for found in FENCE.findall(text))], key=len)
            yield f"{fence}{language}\n{text}\n{fence}"


def table(heads: Sequence[str], rows: Sequence[Sequence[str]]) -> str:
    """A Markdown table of cells that are escaped already."""
    lines = [heads, ["---"] * len(heads), *rows]
    return "\n".join(f"| {' | '.join(line)} |" for line in lines)


def cell(one: Cell | str) -> str:
    """A cell, what is bad in bold."""
    found = Cell(one) if isinstance(one, str) else one
    text = inline(found.text).replace("|", "\\|")
    text = f"**{text}**" if found.tone == "bad" else text
    return f"[{text}]({found.link})" if found.link else text


def inline(text: str) -> str:
    """A text on one line that opens no HTML element."""
    return TAG.sub("&lt;", " ".join(text.split()))




# A report as one self-contained HTML page: images embedded, texts escaped, nothing loaded from
# elsewhere.


def html_page(title: str, command: str, version: str, blocks: Sequence[Block]) -> str:
    """The page of a report (`page.html`)."""
    from jinja2 import Environment, PackageLoader

    loader = PackageLoader("skysim.results", "report")
    environment = Environment(loader=loader, autoescape=True, trim_blocks=True, lstrip_blocks=True)
    environment.filters |= {"parts": parts, "embed": embed, "sort_key": sort_key}
    environment.tests["cell"] = lambda one: isinstance(one, Cell)
    environment.globals["kind"] = lambda block: type(block).__name__
    return environment.get_template("page.html").render(
        title=title, command=command, version=version, blocks=blocks
    )


def parts(text: str) -> Iterator[tuple[bool, str]]:
    """The parts of a text, and whether each is in backticks; a last backtick without a partner is a letter."""
    pieces = text.split("`")
    if len(pieces) % 2 == 0:
        pieces[-2:] = ["`".join(pieces[-2:])]
    return ((n % 2 == 1, piece) for n, piece in enumerate(pieces) if piece)


def embed(image: bytes, kind: str = "png") -> str:
    """An image as the address of an <img> element."""
    return f"data:image/{kind};base64," + base64.b64encode(image).decode()


def sort_key(cell: Cell) -> str:
    """What a column is sorted by, for the page's script: a number, or nothing for NaN."""
    return "" if cell.key is None or math.isnan(cell.key) else str(cell.key)


