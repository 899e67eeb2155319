"""A report: its title, the command that repeats it, and its blocks.

It prints as a self-contained HTML page, as Markdown with its figures beside it, and as text on a terminal. Blocks are
what they hold, not how they look. Texts are plain, but for parts in `backticks`, which are code. They may come from
outside: the writers escape them.
"""

import base64
import math
import re
import textwrap
from collections.abc import Iterator, Sequence
from dataclasses import InitVar, dataclass, field, fields, replace
from pathlib import Path
from typing import Any, Literal, NamedTuple

from skysim.core import __version__
from skysim.core.errors import InputError, check_name, printable

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
    heads
        The columns; a text alone is the title of a column of texts
    optional
        Groups of columns that are left out on a narrow terminal, the first group first
    """

    heads: InitVar[Sequence[Any]]
    columns: list[Column] = field(init=False)
    rows: Sequence[Sequence[Any]]
    optional: Sequence[Sequence[int]] = ()

    def __post_init__(self, heads: Sequence[Any]) -> None:
        columns = [Column(one, kind="text") if isinstance(one, str) else one for one in heads]
        object.__setattr__(self, "columns", columns)

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


# A report as a Markdown page. Its figures are files beside it.


TAG = re.compile(r"<(?=[A-Za-z/!?])")
FENCE = re.compile(r"^`{3,}", re.MULTILINE)


def paragraphs(block: Block, level: int, names: Iterator[str]) -> Iterator[str]:
    """The paragraphs of a block.

    Parameters
    ----------
    level
        Level of a section's heading
    names
        File names of this figure and those after it
    """
    match block:
        case Section(title=title, folded=folded):
            opened = '<details markdown="1"><summary>{}</summary>'
            heading = opened if folded else "#" * level + " {}"
            yield heading.format(inline(title))
            for one in block.blocks:
                yield from paragraphs(one, level + 1, names)
            if folded:
                yield "</details>"
        case Figure(caption=caption):
            if name := next(names, ""):
                yield f"![{inline(caption).replace('[', '(').replace(']', ')')}]({name})"
                yield f"*{inline(caption)}*"
        case Verdict(text=text):
            yield f"**{inline(text)}**"
        case Text(text=text):
            yield inline(text)
        case Items(lines=lines, title=title):
            if title:
                yield f"**{inline(title)}**"
            yield "\n".join(f"- {inline(line)}" for line in lines)
        case Facts(rows=rows):
            facts = [[cell(name), "<br>".join(map(cell, lines))] for name, lines in rows]
            yield table(["", ""], facts)
        case Table():
            heads = [inline(one.head) for one in block.columns]
            yield table(heads, [list(map(cell, row)) for row in block.cells()])
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


# Blocks of a report on the terminal: tables that fit into it, wrapped sentences, no figures.


WIDE = 240  # characters in a line of a file
NARROW = 40  # characters, below which no text is wrapped
MAX_ROWS = 60  # printed rows of a table; the page has all
FACT_COLUMN = 21  # characters before the text of a fact
FACT_WIDTH = 80  # of the lines of facts and warnings
COLORS = {"good": "green", "warning": "yellow", "bad": "bold red"}


def is_printed(block: Block) -> bool:
    """Whether a terminal shows a block: it has no figures."""
    return block.on_terminal and not isinstance(block, Figure)


def print_blocks(blocks: Sequence[Block]) -> None:
    """Print blocks one below the other, a section under its title if it has something to print.

    Warnings are named, and as narrow as facts.
    """
    for block in filter(is_printed, blocks):
        match block:
            case Section(title=title, blocks=inner) if any(map(is_printed, inner)):
                console().print(styled(title, "bold"))
                print_blocks(inner)
                print()
            case Items(lines=lines, title=title, tone=tone):
                if title:
                    print_wrapped(title)
                for line in lines:
                    if tone == "warning":
                        print_wrapped(f"warning: {line}", width=FACT_WIDTH)
                    else:
                        print_wrapped(line)
            case Facts(rows=rows):
                for name, texts in rows:
                    print_fact(name, texts)
            case Table():
                print_table(block)
            case Code(text=text):
                print(text)
            case Text(text=text):
                print_wrapped(text)


def print_fact(head: str, texts: Sequence[str | Cell]) -> None:
    """Print the texts of a fact, its name at the left."""
    for one in texts:
        text = printable(one.text if isinstance(one, Cell) else one)
        for line in textwrap.wrap(text, FACT_WIDTH - FACT_COLUMN):
            print(f"{head:{FACT_COLUMN}}{line}")
            head = ""


def print_table(table: Table, title: str = "") -> None:
    """Print a table's first MAX_ROWS rows; optional columns are left out if it is too wide. Asides follow below it."""
    from rich import table as rich_table

    every = table.cells()
    rows = every[:MAX_ROWS]
    shown = fitting_columns(table, rows)
    heading = styled(title) if title else None
    grid = rich_table.Table(box=None, header_style="bold", pad_edge=False, title=heading)
    grid.title_justify = "left"
    for n in shown:
        column = table.columns[n]
        justify: Any = "right" if column.kind == "number" else "left"
        grid.add_column(styled(column.head), justify=justify, no_wrap=True)
    for row in rows:
        grid.add_row(*(styled(row[n].text, COLORS.get(row[n].tone, "")) for n in shown))
    console().print(grid)
    for row in rows:
        for column, one in zip(table.columns, row, strict=True):
            if column.kind == "aside" and one.text:
                name = "" if one.text.startswith(row[0].text) else f"{row[0].text}: "
                print_wrapped(name + one.text, first="  ", others="    ")
    hidden = (column for n, column in enumerate(table.columns) if n not in shown)
    if left_out := [column.head for column in hidden if column.kind != "aside"]:
        print_wrapped(f"in the report, or in a wider terminal: {', '.join(left_out)}")
    if len(every) > MAX_ROWS:
        print(f"and {len(every) - MAX_ROWS} more rows in the report")


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


def styled(text: str, style: str = "") -> Any:
    """A text literally: rich's markup in it has no effect."""
    from rich.text import Text as RichText

    return RichText(printable(text), style)


def print_wrapped(
    text: str, first: str = "", others: str = "  ", width: int | None = None
) -> None:
    """Print a text in lines of a width, by default the terminal's.

    Parameters
    ----------
    first, others
        What the first line and the others begin with
    """
    width = width or max(terminal_width(), NARROW)
    lines = textwrap.TextWrapper(width, first, others, break_on_hyphens=False)
    print(lines.fill(printable(text)))


def console() -> Any:
    """The terminal, or a file of WIDE characters a line."""
    from rich.console import Console

    return Console(width=terminal_width())


def terminal_width() -> int:
    """Characters in a line of the terminal; at least WIDE if the output goes to a file."""
    from rich.console import Console

    shown = Console()
    return shown.width if shown.is_terminal else max(shown.width, WIDE)


SUFFIXES = (".html", ".md", ".json")
# Fields that JSON leaves out.
LOOKS = ("folded", "id", "image", "kind", "name", "on_terminal", "optional")


@dataclass(frozen=True)
class Report:
    """What a run, a study or a measurement says to people.

    Attributes
    ----------
    blocks
        The answer and what must be known with it, then sections; those that hold nothing are
        left out
    command
        The command that repeats it
    """

    title: str
    blocks: Sequence[Block]
    command: str = ""
    version: str = __version__

    def __post_init__(self) -> None:
        object.__setattr__(self, "blocks", filled(self.blocks))

    @property
    def verdict(self) -> str:
        """The sentence that answers; empty without one."""
        return next((one.text for one in self.blocks if isinstance(one, Verdict)), "")

    def html(self) -> str:
        """One self-contained page (`page.html`), its images embedded."""
        from jinja2 import Environment, PackageLoader

        loader = PackageLoader("skysim", "results")
        environment = Environment(
            loader=loader, autoescape=True, trim_blocks=True, lstrip_blocks=True
        )
        environment.filters |= {"parts": parts, "embed": embed, "sort_key": sort_key}
        environment.tests["cell"] = lambda one: isinstance(one, Cell)
        environment.globals["kind"] = lambda block: type(block).__name__
        return environment.get_template("page.html").render(vars(self))

    def markdown(self, pictures: str = "") -> str:
        """A Markdown page; its figures are left out if no `pictures`, the beginning of their paths, is given."""
        begin = [Code(self.command, "sh")] if self.command else []
        files = figure_files(self.blocks) if pictures else []
        names = (pictures + name for name, _ in files)
        page = Section(self.title, [*begin, *self.blocks])
        return "\n\n".join(paragraphs(page, 1, names)) + "\n"

    def json(self) -> dict[str, Any]:
        """Title, command, version and blocks as values for JSON; figures by their captions."""
        return {
            "title": self.title,
            "command": self.command,
            "version": self.version,
            "blocks": plain(self.blocks),
        }

    def print(self) -> None:
        """Print it on the terminal, without figures; the answer comes last, above the prompt."""
        opening = [one for one in self.blocks if not isinstance(one, Section)]
        print_blocks([*(one for one in self.blocks if isinstance(one, Section)), *opening])

    def save(self, path: str | Path, pictures: str = "") -> Path:
        """Write a page in the format of the suffix: .html, .md or .json. Returns the path.

        Parameters
        ----------
        pictures
            What the paths of a Markdown page's figures begin with; by default a folder of the
            page's name

        Raises
        ------
        InputError
            As `page_path`.
        """
        from skysim.core import files

        path = page_path(path)
        if path.suffix == ".html":
            files.write_text(path, self.html())
        elif path.suffix == ".json":
            files.write_json(path, self.json())
        else:
            pictures = pictures or f"{path.stem}/"
            for name, figure in figure_files(self.blocks):
                file = path.parent / f"{pictures}{name}"
                files.make_folder(file.parent)
                files.write_bytes(file, figure.image)
            files.write_text(path, self.markdown(pictures))
        return path


def page_path(path: str | Path) -> Path:
    """The path of a page, whose folder is created: called before the work that the page reports.

    Raises
    ------
    InputError
        For a suffix that is not in SUFFIXES, for a folder, and if its folder cannot be created.
    """
    from skysim.core.files import make_folder

    path = Path(path)
    check_name(path, "file format", path.suffix, SUFFIXES)
    make_folder(path.parent)
    if path.is_dir():
        raise InputError(path, "is a folder", "a file")
    return path


def plain(value: Any) -> Any:
    """Blocks and what they hold as values for JSON."""
    if isinstance(value, Block):
        held = {
            one.name: plain(getattr(value, one.name))
            for one in fields(value)
            if one.name not in LOOKS
        }
        return {"kind": type(value).__name__.lower()} | held
    if isinstance(value, Cell):
        return value.text
    if isinstance(value, Column):
        return {"title": value.title, "unit": value.unit}
    return [plain(one) for one in value] if isinstance(value, list | tuple) else value
