"""Command `skysim reproduce`."""

from pathlib import Path
from typing import Annotated

import typer
from typer import Argument

from skysim.apps.cli.options import Json, OpenReport
from skysim.apps.cli.terminal import print_json, print_list, progress_callback
from skysim.core.errors import InputError
from skysim.results.report import page_path, print_blocks


def reproduce(
    ids: Annotated[list[str] | None, Argument()] = None,
    quick: bool = False,
    seed: int = 1,
    report: bool = False,
    out: Path = Path("out/reproduce"),
    markdown: Path | None = None,
    open_: OpenReport = False,
    json: Json = False,
) -> None:
    """Repeat the experiments of papers and compare the published numbers with ours.

    Parameters
    ----------
    ids : ID|all
        Experiments, or all; default: list them.
    quick
        Run fewer trials; the intervals are wider.
    seed
        Seed of all random streams.
    report
        Also write an HTML page with the papers' figures.
    out
        Folder for the report.
    markdown
        Also write a Markdown page with its images beside it.
    """
    if open_ and not report:
        raise InputError("--open", "has no effect without --report", "--report --open")
    if not ids:
        list_experiments(json)
        return
    page = out / "report.html"
    paths = [page_path(path) for path in (page if report else None, markdown) if path]
    from skysim.experiments.papers import reproduction

    reproductions = []
    for id in reproduction.check_ids(ids):
        with progress_callback(id) as watch:
            done = reproduction.reproduce(id, reproduction.Options(quick, seed, watch))
        reproductions.append(done)
        if not json:
            print_blocks([reproduction.section(done)])
    if paths:
        made = reproduction.papers_report(reproductions, ids, quick, seed)
        for path in paths:
            made.save(path)
    if open_:
        typer.launch(str(page))
    if json:
        print_json(
            [line.as_dict() for result in reproductions for line in result.comparisons]
        )
        return
    print_blocks([reproduction.headline(reproductions)])
    for path in paths:
        print(path)


def list_experiments(json: bool) -> None:
    """Print the experiments that can be repeated."""
    from skysim.experiments.papers.published import experiments

    listed = [
        {"id": id, "title": published.title, "source": published.source}
        for id, published in experiments().items()
    ]
    print_list(listed, json, lambda entry: f"{entry['id']:20s} {entry['title']}")
