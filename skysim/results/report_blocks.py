"""The blocks of a report: what they hold, not how they look.

Texts are plain, but for parts in `backticks`, which are code. They may come from outside: the writers escape them.
"""

import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from typing import Any, Literal, NamedTuple

Tone = Literal["", "good", "warning", "bad", "marked"]
Kind = Literal["number", "text", "aside"]
MISSING = "–"


class Cell(NamedTuple):
    """A text of a table or of facts.

    Attributes
    ----------
    key
        Number by which a column is sorted; NaN comes last, None sorts by the text
    link
        Id of a section ("#results") or a file beside the report
    """

    text: str
    tone: Tone = ""
    key: float | None = None
    link: str = ""


class Column(NamedTuple):
    """Head of a table's column.

    Attributes
    ----------
    format
        Format of its numbers, such as ".3f"
    kind
        Numbers are aligned to the right; an aside is a longer text, on a terminal a line below
        the table
    """

    title: str
    unit: str = ""
    format: str = ""
    kind: Kind = "number"

    @property
    def head(self) -> str:
        """Title and unit."""
        return f"{self.title} {self.unit}".strip()

    def cell(self, value: Any) -> Cell:
        """The cell of a text or a number; a dash for None and NaN."""
        if isinstance(value, Cell):
            return value
        if isinstance(value, str):
            return Cell(value)
        missing = value is None or math.isnan(value)
        return Cell(
            MISSING if missing else format(value, self.format),
            key=math.nan if missing else value,
        )


def text_column(title: str) -> Column:
    """Head of a column of texts."""
    return Column(title, kind="text")


@dataclass(frozen=True, kw_only=True)
class Block:
    """A part of a report.

    Attributes
    ----------
    on_terminal
        Whether it is printed on a terminal too, and not on the page alone
    """

    on_terminal: bool = True


@dataclass(frozen=True)
class Text(Block):
    """A paragraph."""

    text: str
    tone: Tone = ""


@dataclass(frozen=True)
class Verdict(Text):
    """A sentence that answers what the report is about."""


@dataclass(frozen=True)
class Items(Block):
    """A list of sentences; with a tone it stands out, as warnings do."""

    lines: Sequence[str]
    title: str = ""
    tone: Tone = ""


@dataclass(frozen=True)
class Facts(Block):
    """Names with one or more lines of text each."""

    rows: Sequence[tuple[str, Sequence[str | Cell]]]


@dataclass(frozen=True)
class Table(Block):
    """Rows of values under columns: cells, texts, numbers, or None for what is missing.

    Attributes
    ----------
    optional
        Groups of columns that are left out on a narrow terminal, the first group first
    """

    columns: Sequence[Column]
    rows: Sequence[Sequence[Any]]
    optional: Sequence[Sequence[int]] = ()

    def cells(self) -> list[list[Cell]]:
        """The rows as cells."""
        return [
            [column.cell(value) for column, value in zip(self.columns, row, strict=True)]
            for row in self.rows
        ]


@dataclass(frozen=True)
class Figure(Block):
    """An image.

    Attributes
    ----------
    kind
        Format of the image: png, jpeg or gif
    name
        Name of its file without suffix; by default its number in the report
    """

    image: bytes
    caption: str
    kind: str = "png"
    name: str = ""


@dataclass(frozen=True)
class Code(Block):
    """A command or a file, literally."""

    text: str
    language: str = ""


@dataclass(frozen=True)
class Section(Block):
    """A heading with its blocks, which may be sections again.

    Attributes
    ----------
    id
        Id of the heading, for links
    folded
        Closed until a reader opens it
    """

    title: str
    blocks: Sequence[Block]
    id: str = ""
    folded: bool = False


def filled(blocks: Sequence[Block]) -> list[Block]:
    """The blocks without those that hold nothing: a text of no words, a table of no rows, a section of such blocks."""
    found: list[Block] = []
    for one in blocks:
        match one:
            case Section():
                inner = filled(one.blocks)
                found += [replace(one, blocks=inner)] if inner else []
            case Text(text="") | Items(lines=[]) | Facts(rows=[]) | Table(rows=[]):
                pass
            case _:
                found.append(one)
    return found


def figure_files(blocks: Sequence[Block]) -> list[tuple[str, Figure]]:
    """The figures with the names of their files."""
    return [(f"{one.name or n}.{one.kind}", one) for n, one in enumerate(figures(blocks), 1)]


def figures(blocks: Sequence[Block]) -> Iterator[Figure]:
    """The figures of blocks and of their sections, in order."""
    for one in blocks:
        if isinstance(one, Figure):
            yield one
        elif isinstance(one, Section):
            yield from figures(one.blocks)
