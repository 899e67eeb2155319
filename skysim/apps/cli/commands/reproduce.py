"""Command `skysim reproduce`."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from skysim.apps.cli.options import Json, OpenReport
from skysim.apps.cli.terminal import colored, print_json, print_list, print_table, progress_callback
from skysim.core.errors import InputError

if TYPE_CHECKING:
    from rich.text import Text

    from skysim.experiments.papers.compare import Reproduction

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
    open_: OpenReport = False,
    json: Json = False,
) -> None:
    """Repeat the experiments of papers and compare the published numbers with ours."""
    if open_ and not report:
        raise InputError("--open", "has no effect without --report", "--report --open")
    if not ids:
        from skysim.experiments.papers.published import experiments

        listed = [
            {"id": id, "title": published.title, "source": published.source} for id, published in experiments().items()
        ]
        print_list(listed, json, lambda entry: f"{entry['id']:20s} {entry['title']}")
        return
    from skysim.core.io import files
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
    arguments = page.CommandArguments(tuple(ids), quick, seed)
    written: list[Path] = []
    if report:
        written.append(files.make_folder(out) / "report.html")
        page.write_html(written[-1], reproductions, arguments)
        if open_:
            typer.launch(str(written[-1]))
    if markdown:
        files.make_folder(markdown.parent)
        written.append(markdown)
        page.write_markdown(markdown, reproductions, arguments)
    if json:
        print_json([line.as_dict() for result in reproductions for line in result.comparisons])
        return
    print(", ".join(f"{count} {kind}" for kind, count in page.total_counts(reproductions).items()))
    for path in written:
        print(path)


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
