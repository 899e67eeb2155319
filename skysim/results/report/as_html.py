"""A report as one self-contained HTML page: images embedded, texts escaped, nothing loaded from elsewhere."""

from __future__ import annotations

import base64
import math
from collections.abc import Iterator, Sequence

from skysim.results.report.blocks import Block, Cell


def page(title: str, command: str, version: str, blocks: Sequence[Block]) -> str:
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
