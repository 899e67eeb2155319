"""Write docs/findings/studies/*.md with their figures, from the stores of completed studies. `make studies` does both.

`python docs/site/studies.py [FOLDER]`: of every study's store in FOLDER/NAME (out/ if left out).
"""

from __future__ import annotations

import sys
from collections.abc import Iterator
from pathlib import Path

from skysim.apps.cli.commands.study import total
from skysim.experiments.study import store
from skysim.experiments.study.analysis import search, sensitivity, table
from skysim.experiments.study.analysis.table import Line
from skysim.experiments.study.loader import load
from skysim.experiments.study.plan import STUDIES, Curve, Figure, Plan
from skysim.experiments.study.report import figures as study_figures
from skysim.experiments.study.report import layout
from skysim.experiments.study.store import STORE, Store

PAGES = Path(__file__).parents[1] / "findings" / "studies"
MOST = 72  # lines of a table that is printed whole


def main(folder: Path) -> None:
    """A page for every study that is there."""
    PAGES.mkdir(exist_ok=True)
    for path in sorted(STUDIES.glob("*.yaml")):
        told = load(path)
        where = folder / told.name / STORE
        if not where.is_file():
            print(f"{where}: not there; left as it was")
            continue
        with store.open_store(where) as kept:
            unfinished = kept.counts()["done"] < total(told)
            if kept.meta("digest") != told.digest or unfinished:
                print(f"{where}: not finished, or of another version of the study; left as it was")
                continue
            (PAGES / f"{told.name}.md").write_text("\n".join(page(told, kept)) + "\n", encoding="utf-8")
        print(PAGES / f"{told.name}.md")


def page(told: Plan, kept: Store) -> Iterator[str]:
    """A study's page, line by line; its pictures are written beside it."""
    study, name, counts = told.study, told.name, kept.counts()
    verb = "optimise" if study.optimise else "run"
    question = [line[2:] for line in told.path.read_text("utf-8").splitlines() if line.startswith("# ")]
    yield f"# {study.title}\n\n" + " ".join(question)
    yield f"\n```sh\nskysim study {verb} {name}\n```\n"
    seconds, cores = sum(run["seconds"] for run in kept.runs()), max(run["workers"] for run in kept.runs())
    effort = f"{seconds:.0f} s on {cores} {'core' if cores == 1 else 'cores'}"
    yield (
        f"{counts['done']} trials, {counts['failed']} failed, in {effort}; scene"
        f" `{study.scene}`, seed {study.seed}. What is varied:"
        f" [`{told.path.name}`](../../../scenes/studies/{told.path.name}). Intervals are of 95 %.\n"
    )
    lines = table.table(kept, study.responses)
    if study.optimise:
        yield from searched(told, kept, lines)
    elif study.design.kind == "saltelli":
        yield from budgeted(told, kept)
    for n, figure in enumerate(study.figures):
        picture = f"{name}_{n + 1}.png"
        (PAGES / picture).write_bytes(study_figures.figure_png(lines, figure, study))
        yield f"![{figure.kind}]({picture})\n\n*{layout.caption(figure, study, lines)}*\n"
        yield from pivot(figure, lines, told)
    if len(lines) <= MOST and study.design.kind != "saltelli" and not study.optimise:
        yield from whole(lines)


def pivot(figure: Figure, lines: list[Line], told: Plan) -> Iterator[str]:
    """A figure's numbers: its x across, the other factor down."""
    across = layout.axis(told.study, lines, figure.x)
    other = figure.by if isinstance(figure, Curve) else figure.y
    name = figure.y if isinstance(figure, Curve) else figure.value
    chosen = layout.kept(lines, figure, told.study)
    down = layout.axis(told.study, lines, other) if other else None
    yield markdown([f"{name}: {across.label}", *(across.told(one) for one in across.levels)])
    yield markdown(["---"] * (1 + len(across.levels)))
    for level in down.levels if down else [None]:
        row = [line for line in chosen if other is None or layout.same(line.levels[other], level)]
        cells = [
            next(
                table.figure(line.responses[name]) for line in row if layout.same(line.levels[figure.x], one)
            )
            for one in across.levels
        ]
        yield markdown([down.told(level) if down else "", *cells])
    yield ""


def whole(lines: list[Line]) -> Iterator[str]:
    """The table of all points."""
    heads, cells = table.cells(lines)
    yield markdown(heads[1:])
    yield markdown(["---"] * (len(heads) - 1))
    yield from (markdown(line[1:]) for line in cells[:MOST])
    yield ""


def budgeted(told: Plan, kept: Store) -> Iterator[str]:
    """Sobol indices as pictures and as a table, the worst offender first."""
    found = sensitivity.indices(told, kept)
    for response in sensitivity.AXES:
        picture = f"{told.name}_{response}.png"
        (PAGES / picture).write_bytes(study_figures.indices_png(found, response))
        yield f"![Sobol indices]({picture})\n"
        yield markdown([response, "alone, rms ″", "first-order index", "total index"])
        yield markdown(["---"] * 4)
        own = sorted((one for one in found if one.response == response), key=lambda one: -one.total.value)
        for one in own:
            figures = [table.figure(one.first), table.figure(one.total)]
            yield markdown([one.factor, f"{one.rms_arcsec:.3g}", *figures])
        yield ""


def searched(told: Plan, kept: Store, lines: list[Line]) -> Iterator[str]:
    """The front of a search, and a picture of it."""
    assert told.study.optimise is not None
    found = search.found(told, kept)
    costs = {one.number: one.cost for one in found.candidates}
    panels = layout.panels(lines, told.study.optimise, costs)
    names = [one.response for one in told.study.optimise.objectives]
    picture = f"{told.name}.png"
    points, front = [line.point for line in lines], [one.number for one in found.front]
    drawn = study_figures.pareto_png(panels[names[0]], panels[names[-1]], points, front)
    (PAGES / picture).write_bytes(drawn)
    yield f"![Pareto front]({picture})\n"
    feasible = sum(one.feasible for one in found.candidates)
    yield f"{len(found.candidates)} candidates, {feasible} of them feasible; the front:\n"
    rest = [name for name in found.front[0].figures if name not in names] if found.front else []
    yield markdown(["candidate", *told.study.factors, *names, *rest])
    yield markdown(["---"] * (1 + len(told.study.factors) + len(names) + len(rest)))
    for one in found.front:
        cells = [
            table.figure(one.figures[name]) if name in one.figures else f"{one.cost:.4g}" for name in names
        ]
        more = [table.figure(one.figures[name]) for name in rest]
        yield markdown([str(one.number), *map(table.level, one.levels.values()), *cells, *more])
    yield ""


def markdown(cells: list[str]) -> str:
    """A line of a table."""
    return "| " + " | ".join(cells) + " |"


if __name__ == "__main__":
    main(Path(sys.argv[1]) if len(sys.argv) > 1 else Path("out"))
