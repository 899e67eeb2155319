"""Command `skysim reproduce`."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from skysim.apps.cli.terminal import colored, print_table, progress_callback

if TYPE_CHECKING:
    from rich.text import Text

    from skysim.experiments.papers.compare import Reproduction
    from skysim.experiments.papers.page import Told

INK = {"agrees": "green", "explained": "yellow", "disagrees": "bold red"}


def reproduce(
    ids: Annotated[
        list[str] | None, typer.Argument(metavar="ID|all", help="Experiments; lists them if left out.")
    ] = None,
    quick: Annotated[bool, typer.Option("--quick", help="Fewer trials, wider intervals.")] = False,
    seed: Annotated[int, typer.Option(help="Of all random streams: the same seed, the same numbers.")] = 1,
    report: Annotated[
        bool, typer.Option("--report", help="Also one HTML page with the papers' figures.")
    ] = False,
    out: Annotated[Path, typer.Option(help="Folder for the report.")] = Path("out/reproduce"),
    markdown: Annotated[
        Path | None,
        typer.Option(help="Also a page of Markdown with its pictures beside it, as docs/findings/papers.md."),
    ] = None,
    json: Annotated[bool, typer.Option("--json", help="Print JSON for machines instead of tables.")] = False,
) -> None:
    """Repeat the experiments of papers and compare the published numbers with ours."""
    from skysim.core import files

    if not ids:
        listing(json)
        return
    from skysim.experiments.papers import page
    from skysim.experiments.papers.compare import Ask
    from skysim.experiments.papers.registry import named
    from skysim.experiments.papers.registry import reproduce as do

    done = []
    for id in named(ids):
        with progress_callback(id, quiet=json) as watch:
            done.append(do(id, Ask(quick, seed, watch)))
        if not json:
            show(done[-1])
    told = page.Told(tuple(ids), quick, seed)
    written = pages(done, told, out if report else None, markdown)
    if json:
        print(files.to_json([line.as_dict() for one in done for line in one.lines]))
        return
    summed(done)
    for path in written:
        print(path)


def pages(done: list[Reproduction], told: Told, out: Path | None, markdown: Path | None) -> list[Path]:
    """Write the requested pages (HTML in folder `out`, Markdown to a file) and return their paths."""
    from skysim.core import files
    from skysim.experiments.papers import page

    written = []
    if out:
        written.append(files.make_folder(out) / "report.html")
        page.write_html(written[-1], done, told)
    if markdown:
        files.make_folder(markdown.parent)
        written.append(markdown)
        page.write_markdown(markdown, done, told)
    return written


def listing(json: bool) -> None:
    """Print the identifiers and titles of all experiments."""
    from skysim.core import files
    from skysim.experiments.papers.published import experiments

    listed = [{"id": id, "title": one.title, "source": one.source} for id, one in experiments().items()]
    if json:
        print(files.to_json(listed))
        return
    for entry in listed:
        print(f"{entry['id']:20s} {entry['title']}")


def show(one: Reproduction) -> None:
    """Print an experiment's table, with notes on the rows that disagree or have a weakness."""
    from skysim.experiments.papers.compare import number, stated

    heads = ["what", "published", "ours", "verdict"]
    lines: list[list[str | Text]] = [
        [
            line.row.quantity,
            stated(line.row),
            number(line.answer.ours),
            colored(line.verdict, INK[line.verdict]),
        ]
        for line in one.lines
    ]
    print_table(
        f"{one.id}: {one.published.title} ({one.published.source}), {one.seconds:.1f} s", heads, lines
    )
    for line in one.lines:
        if line.verdict != "agrees" or line.weakness:
            print(f"  {line.row.quantity}: {line.note or 'no cause found'}")
    print()


def summed(done: list[Reproduction]) -> None:
    """Print the number of rows with each verdict."""
    from skysim.experiments.papers.page import counts

    print(", ".join(f"{count} {kind}" for kind, count in counts(done).items()))
