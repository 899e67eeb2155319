"""Write docs/findings/studies/*.md with their figures, from the stores of completed studies. `make studies` does both.

`python docs/site/studies.py [FOLDER]`: of every study's store in FOLDER/NAME (out/ if left out).
"""

from __future__ import annotations

import sys
from collections.abc import Iterator
from pathlib import Path

import numpy as np

from skysim.apps.cli.study_summary import trial_count
from skysim.core.paths import STUDIES
from skysim.core.types import Floats
from skysim.experiments.study.analysis import answer, axes, search, sensitivity, table
from skysim.experiments.study.analysis.table import PointRow
from skysim.experiments.study.execution import store
from skysim.experiments.study.execution.store import STORE, Store
from skysim.experiments.study.loader import load
from skysim.experiments.study.plan import Curve, Heat, Map, Plan
from skysim.experiments.study.report import figures as study_figures
from skysim.experiments.study.report import layout, maps, overview
from skysim.experiments.study.report import page as study_page

PAGES = Path(__file__).parents[1] / "findings" / "studies"
BESIDE = {"dome_for_the_money": "dome_without_codes"}  # a search whose front is drawn in another one's figure
MAX_OPEN_ROWS = 72  # longer tables are folded


def main(folder: Path) -> None:
    """Write a page for every study with a complete store."""
    PAGES.mkdir(exist_ok=True)
    for path in sorted(STUDIES.glob("*.yaml")):
        plan = load(path)
        store_path = folder / plan.name / STORE
        if not store_path.is_file():
            print(f"{store_path}: no such store; page not changed")
            continue
        with store.open_store(store_path) as trial_store:
            unfinished = trial_store.counts()["done"] < trial_count(plan)
            if trial_store.meta("digest") != plan.digest or unfinished:
                print(f"{store_path}: not finished, or of another version of the study; page not changed")
                continue
            (PAGES / f"{plan.name}.md").write_text("\n".join(page(plan, trial_store, folder)) + "\n", encoding="utf-8")
        print(PAGES / f"{plan.name}.md")


def page(plan: Plan, trial_store: Store, folder: Path) -> Iterator[str]:
    """Yield a study's page line by line; write its figures beside it."""
    study, name, counts = plan.study, plan.name, trial_store.counts()
    verb = "optimize" if study.optimize else "run"
    question = [line[2:] for line in plan.path.read_text("utf-8").splitlines() if line.startswith("# ")]
    yield f"# {study.title}\n\n" + " ".join(question)
    yield f"\n```sh\nskysim study {verb} {name}\n```\n"
    runs = trial_store.runs()
    seconds, cores = sum(run["seconds"] for run in runs), max(run["workers"] for run in runs)
    effort = f"{seconds:.0f} s on {cores} {'core' if cores == 1 else 'cores'}"
    yield (
        f"{counts['done']} trials, {counts['failed']} failed, in {effort}; scene"
        f" `{study.scene}`, seed {study.seed}. What is varied:"
        f" [`{plan.path.name}`](../../../scenes/studies/{plan.path.name}). Intervals are of 95 %.\n"
    )
    lines = table.table(trial_store, list(dict.fromkeys([*study_page.responses(study), *answer.RESPONSES])))
    yield from opening(plan, lines)
    lines = table.select_responses(lines, study_page.responses(study))
    if study.optimize:
        yield from search_section(plan, trial_store, lines, folder)
    elif study.design.kind == "saltelli":
        yield from sobol_section(plan, trial_store)
    for n, figure in enumerate(study.figures):
        picture = PAGES / f"{name}_{n + 1}.png"
        if isinstance(figure, Map):
            yield from map_section(figure, picture, plan, trial_store, lines)
            continue
        picture.write_bytes(study_figures.figure_png(lines, figure, study))
        yield f"![{figure.kind}]({picture.name})\n\n*{layout.caption(figure, study, lines)}*\n"
        yield from pivot_table(figure, lines, plan)
    if study.design.kind != "saltelli" and not study.optimize:
        yield from full_table(table.select_responses(lines, study.responses))


def opening(plan: Plan, lines: list[PointRow]) -> Iterator[str]:
    """The scene as a table, what its checks find, and the answer in words."""
    about = overview.overview(plan)
    yield "| | |\n| --- | --- |"
    yield from (markdown_row([name, text.replace("|", "\\|")]) for name, text in about.rows)
    yield f"\nThe checks of this scene find{':' if about.findings else ' nothing to warn of.'}\n"
    yield from (f"- {line}" for line in about.findings)
    yield "\n## Answer\n"
    yield from (
        f"- {line}"
        for line in answer.headline(plan.study, lines, about.may_be_ambiguous, f"skysim study worst {plan.name}")
    )
    yield from (f"- {line}" for line in answer.one_unit(about.fixed))
    yield from (f"- {line}" for line in answer.ranges(plan.study, lines))
    yield "\n## Figures\n" if plan.study.figures else ""


def map_section(figure: Map, picture: Path, plan: Plan, trial_store: Store, lines: list[PointRow]) -> Iterator[str]:
    """A map with its worst trials and the commands that repeat them."""
    panels = maps.direction_maps(lines, figure, plan.study, trial_store.point_columns)
    picture.write_bytes(maps.map_png(panels, figure))
    yield f"![{figure.kind}]({picture.name})\n\n*{maps.caption(panels, figure, plan.study, lines)}*\n"
    rows = study_page.worst_rows(panels, f"skysim study replay {plan.name}")
    if rows:
        yield markdown_row(["worst", "lights", "what happened", "repeat it"])
        yield markdown_row(["---"] * 4)
    for one in rows:
        where = f"{one.panel}: {one.direction}" if one.panel else one.direction
        yield markdown_row([where, str(one.lights), one.event, f"`{one.command}`"])
    yield ""


def pivot_table(figure: Curve | Heat, lines: list[PointRow], plan: Plan) -> Iterator[str]:
    """A figure's numbers: its x across, the other factor down."""
    across = axes.axis(plan.study, lines, figure.x)
    other = figure.by if isinstance(figure, Curve) else figure.y
    chosen = axes.shown_points(lines, figure, plan.study)
    down = axes.axis(plan.study, lines, other) if other else None
    yield markdown_row([f"{figure.response}: {across.label}", *(across.tick_label(x) for x in across.levels)])
    yield markdown_row(["---"] * (1 + len(across.levels)))
    for level in down.levels if down else [None]:
        row = [line for line in chosen if other is None or axes.same(line.levels[other], level)]
        cells = [
            next(table.format_response(line, figure.response) for line in row if axes.same(line.levels[figure.x], x))
            for x in across.levels
        ]
        yield markdown_row([down.tick_label(level) if down else "", *cells])
    yield ""


def full_table(lines: list[PointRow]) -> Iterator[str]:
    """The table of all points; a long one is folded."""
    heads, cells = table.cells(lines)
    folded = len(cells) > MAX_OPEN_ROWS
    yield f'<details markdown="1"><summary>All {len(cells)} points</summary>\n' if folded else "## All points\n"
    yield markdown_row(heads)
    yield markdown_row(["---"] * len(heads))
    yield from (markdown_row(line) for line in cells)
    yield "\n</details>\n" if folded else ""


def sobol_section(plan: Plan, trial_store: Store) -> Iterator[str]:
    """Figures and tables of the Sobol indices, largest total index first."""
    indices = sensitivity.indices(plan, trial_store)
    for response in sensitivity.AXES:
        picture = f"{plan.name}_{response}.png"
        (PAGES / picture).write_bytes(study_figures.indices_png(indices, response))
        yield f"![Sobol indices]({picture})\n"
        yield markdown_row([response, "alone, rms ″", "first-order index", "total index"])
        yield markdown_row(["---"] * 4)
        ranked = sorted(
            (index for index in indices if index.response == response), key=lambda index: -index.total.value
        )
        for index in ranked:
            figures = [table.format_summary(index.first), table.format_summary(index.total)]
            yield markdown_row([index.factor, f"{index.rms_arcsec:.3g}", *figures])
        yield ""


def front_of(name: str, folder: Path) -> Floats:
    """(K, 2) objectives of the front of another search."""
    with store.open_store(folder / name / STORE) as trial_store:
        found = search.collect_result(load(name), trial_store).front
    return np.array([candidate.objectives for candidate in found])


def search_section(plan: Plan, trial_store: Store, lines: list[PointRow], folder: Path) -> Iterator[str]:
    """The front of a search, and a picture of it."""
    assert plan.study.optimize is not None
    result = search.collect_result(plan, trial_store)
    costs = {candidate.number: candidate.cost for candidate in result.candidates}
    panels = layout.panels(lines, plan.study.optimize, costs)
    names = [candidate.response for candidate in plan.study.optimize.objectives]
    picture = f"{plan.name}.png"
    points, front = [line.point for line in lines], [candidate.number for candidate in result.front]
    also = {f"front of {other}": front_of(other, folder) for name, other in BESIDE.items() if name == plan.name}
    png = study_figures.pareto_png(panels[names[0]], panels[names[-1]], points, front, also)
    (PAGES / picture).write_bytes(png)
    yield f"![Pareto front]({picture})\n"
    feasible = sum(candidate.feasible for candidate in result.candidates)
    yield f"{len(result.candidates)} candidates, {feasible} of them feasible; the front:\n"
    heads, rows = search.front_cells(plan.study, result)
    yield markdown_row(heads)
    yield markdown_row(["---"] * len(heads))
    yield from map(markdown_row, rows)
    yield ""


def markdown_row(cells: list[str]) -> str:
    """A row of a Markdown table."""
    return "| " + " | ".join(cells) + " |"


if __name__ == "__main__":
    main(Path(sys.argv[1]) if len(sys.argv) > 1 else Path("out"))
