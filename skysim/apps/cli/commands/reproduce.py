"""Command `skysim reproduce`."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from skysim.apps.cli.options import Json
from skysim.apps.cli.terminal import colored, print_table, progress_callback

if TYPE_CHECKING:
    from rich.text import Text

    from skysim.experiments.papers.compare import Reproduction
    from skysim.experiments.papers.page import CommandArguments

VERDICT_COLORS = {"agrees": "green", "explained": "yellow", "disagrees": "bold red"}


def reproduce(
    ids: Annotated[
        list[str] | None, typer.Argument(metavar="ID|all", help="Experiments, or all; default: list them.")
    ] = None,
    quick: Annotated[bool, typer.Option("--quick", help="Run fewer trials; the intervals are wider.")] = False,
    seed: Annotated[int, typer.Option(help="Seed of all random streams.")] = 1,
    report: Annotated[bool, typer.Option("--report", help="Also write an HTML page with the papers' figures.")] = False,
    out: Annotated[Path, typer.Option(help="Folder for the report.")] = Path("out/reproduce"),
    markdown: Annotated[
        Path | None,
        typer.Option(help="Also write a Markdown page with its images beside it, as docs/findings/papers.md."),
    ] = None,
    json: Json = False,
) -> None:
    """Repeat the experiments of papers and compare the published numbers with ours."""
    from skysim.core import files

    if not ids:
        print_list(json)
        return
    from skysim.experiments.papers import page
    from skysim.experiments.papers.compare import ExperimentOptions
    from skysim.experiments.papers.registry import check_ids
    from skysim.experiments.papers.registry import reproduce as reproduce_one

    reproductions = []
    for id in check_ids(ids):
        with progress_callback(id, quiet=json) as watch:
            reproductions.append(reproduce_one(id, ExperimentOptions(quick, seed, watch)))
        if not json:
            print_reproduction(reproductions[-1])
    command_options = page.CommandArguments(tuple(ids), quick, seed)
    written = write_pages(reproductions, command_options, out if report else None, markdown)
    if json:
        print(files.to_json([line.as_dict() for result in reproductions for line in result.comparisons]))
        return
    print_verdict_counts(reproductions)
    for path in written:
        print(path)


def write_pages(
    reproductions: list[Reproduction], command_options: CommandArguments, out: Path | None, markdown: Path | None
) -> list[Path]:
    """Write the requested pages (HTML in folder `out`, Markdown to a file) and return their paths."""
    from skysim.core import files
    from skysim.experiments.papers import page

    written = []
    if out:
        written.append(files.make_folder(out) / "report.html")
        page.write_html(written[-1], reproductions, command_options)
    if markdown:
        files.make_folder(markdown.parent)
        written.append(markdown)
        page.write_markdown(markdown, reproductions, command_options)
    return written


def print_list(json: bool) -> None:
    """Print the identifiers and titles of all experiments."""
    from skysim.core import files
    from skysim.experiments.papers.published import experiments

    entries = [
        {"id": id, "title": published.title, "source": published.source} for id, published in experiments().items()
    ]
    if json:
        print(files.to_json(entries))
        return
    for entry in entries:
        print(f"{entry['id']:20s} {entry['title']}")


def print_reproduction(reproduction: Reproduction) -> None:
    """Print an experiment's table, with notes on the rows that disagree or have a weakness."""
    from skysim.experiments.papers.compare import format_published, format_summary

    headers = ["what", "published", "ours", "verdict"]
    lines: list[list[str | Text]] = [
        [
            line.row.quantity,
            format_published(line.row),
            format_summary(line.result.ours),
            colored(line.verdict, VERDICT_COLORS[line.verdict]),
        ]
        for line in reproduction.comparisons
    ]
    published = reproduction.published
    title = f"{reproduction.id}: {published.title} ({published.source}), {reproduction.seconds:.1f} s"
    print_table(title, headers, lines)
    for line in reproduction.comparisons:
        if line.verdict != "agrees" or line.weakness:
            print(f"  {line.row.quantity}: {line.note or 'cause unknown'}")
    print()


def print_verdict_counts(reproductions: list[Reproduction]) -> None:
    """Print the number of rows with each verdict."""
    from skysim.experiments.papers.page import total_counts

    print(", ".join(f"{count} {kind}" for kind, count in total_counts(reproductions).items()))
