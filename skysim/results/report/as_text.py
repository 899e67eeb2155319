"""Blocks of a report on the terminal: tables that fit into it, wrapped sentences, no figures."""

from __future__ import annotations

import textwrap
from collections.abc import Callable, Sequence
from typing import Any

from skysim.core.errors import printable
from skysim.results.report.blocks import (
    Block,
    Cell,
    Code,
    Facts,
    Items,
    Section,
    Table,
    Text,
    Verdict,
)

WIDE = 240  # characters in a line of a file
NARROW = 40  # characters, below which no text is wrapped
MAX_ROWS = 60  # printed rows of a table; the page has all
FACT_COLUMN = 21  # characters before the text of a fact
FACT_WIDTH = 80  # of the lines of facts and warnings
COLORS = {"good": "green", "warning": "yellow", "bad": "bold red"}


def print_blocks(blocks: Sequence[Block]) -> None:
    """Print blocks one below the other; those without a terminal's form, such as figures, are skipped."""
    for one in blocks:
        if one.on_terminal and type(one) in PRINTERS:
            PRINTERS[type(one)](one)


def print_section(section: Section) -> None:
    """Print a section under its title; nothing if it has nothing to print."""
    if not any(one.on_terminal and type(one) in PRINTERS for one in section.blocks):
        return
    console().print(styled(Cell(section.title), "bold"))
    print_blocks(section.blocks)
    print()


def print_items(items: Items) -> None:
    """Print one wrapped sentence after the other; warnings are named, and as narrow as facts."""
    if items.title:
        print_wrapped(items.title)
    for line in items.lines:
        if items.tone == "warning":
            print_wrapped(f"warning: {line}", width=FACT_WIDTH)
        else:
            print_wrapped(line)


def print_facts(facts: Facts) -> None:
    """Print facts, names at the left."""
    for name, lines in facts.rows:
        texts = [one.text if isinstance(one, Cell) else one for one in lines]
        wrapped = [
            part
            for text in texts
            for part in textwrap.wrap(printable(text), FACT_WIDTH - FACT_COLUMN)
        ]
        for head, line in zip([name, *[""] * (len(wrapped) - 1)], wrapped, strict=True):
            print(f"{head:{FACT_COLUMN}}{line}")


def print_table(table: Table, title: str = "") -> None:
    """Print a table's first MAX_ROWS rows; optional columns are left out if it is too wide. Asides follow below it."""
    from rich.table import Table as Grid

    rows = table.cells()
    shown = fitting_columns(table, rows[:MAX_ROWS])
    grid = Grid(
        box=None,
        header_style="bold",
        pad_edge=False,
        title=styled(Cell(title), "") if title else None,
    )
    grid.title_justify = "left"
    for n in shown:
        column = table.columns[n]
        justify: Any = "right" if column.kind == "number" else "left"
        grid.add_column(styled(Cell(column.head), ""), justify=justify, no_wrap=True)
    for row in rows[:MAX_ROWS]:
        grid.add_row(*(styled(row[n], COLORS.get(row[n].tone, "")) for n in shown))
    console().print(grid)
    for row in rows[:MAX_ROWS]:
        for column, one in zip(table.columns, row, strict=True):
            if column.kind == "aside" and one.text:
                name = "" if one.text.startswith(row[0].text) else f"{row[0].text}: "
                print_wrapped(name + one.text, first="  ", others="    ")
    if left_out := [
        column.head
        for n, column in enumerate(table.columns)
        if n not in shown and column.kind != "aside"
    ]:
        print_wrapped(f"in the report, or in a wider terminal: {', '.join(left_out)}")
    if len(rows) > MAX_ROWS:
        print(f"and {len(rows) - MAX_ROWS} more rows in the report")


def fitting_columns(table: Table, rows: Sequence[Sequence[Cell]]) -> list[int]:
    """The columns that fit into the terminal, asides left out; all that are not optional."""
    shown = [n for n, column in enumerate(table.columns) if column.kind != "aside"]
    texts = [
        [column.head for column in table.columns],
        *([one.text for one in row] for row in rows),
    ]
    widths = [max(map(len, column)) for column in zip(*texts, strict=True)]
    for group in table.optional:
        if sum(widths[n] for n in shown) + 2 * (len(shown) - 1) > terminal_width():
            shown = [n for n in shown if n not in group]
    return shown


def styled(cell: Cell, style: str) -> Any:
    """A cell's text literally: rich's markup in it has no effect."""
    from rich.text import Text as RichText

    return RichText(printable(cell.text), style)


def print_wrapped(text: str, first: str = "", others: str = "  ", width: int | None = None) -> None:
    """Print a text in lines of a width, by default the terminal's.

    first, others : what the first line and the others begin with
    """
    width = width or max(terminal_width(), NARROW)
    print(
        textwrap.fill(
            printable(text),
            width,
            initial_indent=first,
            subsequent_indent=others,
            break_on_hyphens=False,
        )
    )


def console() -> Any:
    """The terminal, or a file of WIDE characters a line."""
    from rich.console import Console

    return Console(width=terminal_width())


def terminal_width() -> int:
    """Characters in a line: of the terminal, or WIDE if the output goes to a file."""
    from rich.console import Console

    shown = Console()
    return shown.width if shown.is_terminal else max(shown.width, WIDE)


PRINTERS: dict[type[Block], Callable[[Any], None]] = {
    Code: lambda one: print(one.text),
    Facts: print_facts,
    Items: print_items,
    Section: print_section,
    Table: print_table,
    Text: lambda one: print_wrapped(one.text),
    Verdict: lambda one: print_wrapped(one.text),
}
