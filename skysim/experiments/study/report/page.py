"""HTML report of a study: one self-contained page with counts, figures and a table, made from its store."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any, NamedTuple

from skysim.core.io.files import write_text
from skysim.experiments.study.analysis.axes import axis
from skysim.experiments.study.analysis.table import PointRow, cells, format_summary
from skysim.experiments.study.analysis.worst import ColumnsOf
from skysim.experiments.study.execution.store import Store
from skysim.experiments.study.plan import Map, Study
from skysim.experiments.study.report import figures, layout, maps
from skysim.experiments.study.report.maps import DirectionMap
from skysim.results.report import embed, render_page

if TYPE_CHECKING:
    from skysim.experiments.study.analysis.sensitivity import Index
    from skysim.experiments.study.report.overview import Overview

LISTED = 10  # maximum number of failures listed
ROWS = 5000  # maximum number of rows in the table


class WorstRow(NamedTuple):
    """One of the worst trials of a map: the panel, where it is, what happened, lights in the field, replay command."""

    panel: str
    direction: str
    event: str
    lights: int
    command: str


class Picture(NamedTuple):
    """An image of the page: a data URI, its caption and, of a map, the worst trials."""

    source: str
    caption: str
    worst: Sequence[WorstRow] = ()


class Cell(NamedTuple):
    """A table cell: its text, its sort key (an empty key sorts last), and whether it is a number."""

    text: str
    key: float | str
    number: bool


def write_page(
    path: Path,
    store: Store,
    study: Study,
    command: str,
    lines: Sequence[PointRow],
    indices: Sequence[Index] | None = None,
    front: Sequence[int] | None = None,
    costs: Mapping[int, float] | None = None,
    about: Overview | None = None,
    answers: Sequence[str] = (),
    replay: str = "skysim study replay FILE",
) -> None:
    """Write the report as one self-contained HTML file.

    command : command that repeats the study;  lines : its table with all responses of `responses`
    about   : scene table and findings;  answers : in words;  replay : command that repeats a trial, without its number
    indices : Sobol indices, for a study of design saltelli
    front   : Pareto-optimal points of an optimization;  costs : cost by point, if the study has costs
    Raises InputError if `where` of a figure names an unknown factor or level.
    """
    heads, rows = table_cells(lines, study, costs)
    drawn = {one.response for one in layout.figures(study, lines)}
    text = render_page(
        "study.html",
        study=study,
        command=command,
        facts=facts(store, study),
        failures=store.failures()[:LISTED],
        runs=store.runs(),
        text=store.meta("study"),
        pictures=search_images(lines, study, front or (), costs)
        + sobol_images(indices or ())
        + figure_images(lines, study, store.point_columns, replay),
        about=about,
        answers=answers,
        replay=replay,
        indices=[(one, format_summary(one.first), format_summary(one.total)) for one in indices or ()],
        heads=heads,
        rows=rows[:ROWS],
        front=set(front or ()),
        left=[name for name in study.responses if name not in drawn],
        more=max(len(rows) - ROWS, 0),
    )
    write_text(path, text)


# Text and tables.


def responses(study: Study) -> list[str]:
    """The study's responses and those used by its figures, thresholds, objectives and constraints, without `cost`."""
    searched = study.optimize.responses if study.optimize else []
    names = dict.fromkeys([*study.responses, *(one.response for one in (*study.figures, *study.thresholds)), *searched])
    return [name for name in names if name != "cost"]


def facts(store: Store, study: Study) -> dict[str, Any]:
    """Counts of points and trials (planned, done, failed, wrong), and the code version."""
    counts, points = store.counts(), len(store.points())
    planned = study.optimize.candidates if study.optimize else points
    trials, by_runs = planned * study.replicates, sum(run["trials"] for run in store.runs())
    return {
        **counts,
        "points": points,
        "planned": planned,
        "replicates": study.replicates,
        "trials": trials,
        "complete": points > 0 and counts["done"] >= trials,
        "code": store.meta("code"),
        "untimed": max(counts["done"] - by_runs, 0),  # trials of killed runs
    }


def table_cells(
    lines: Sequence[PointRow], study: Study, costs: Mapping[int, float] | None
) -> tuple[list[str], list[list[Cell]]]:
    """Column heads and cells of the table. Named levels sort in the order of the study file."""
    heads, texts = cells(lines)
    axes = {name: axis(study, lines, name) for name in (lines[0].levels if lines else ())}
    rows = []
    for line, row_texts in zip(lines[:ROWS], texts[:ROWS], strict=True):
        keys = [line.point, *(axes[name].coordinate(one) for name, one in line.levels.items())]
        keys += [one.value for one in line.responses.values()]
        numbers = [True, *(axes[name].numeric for name in line.levels), *[True] * len(line.responses)]
        row = [Cell(text, sort_key(key), one) for text, key, one in zip(row_texts, keys, numbers, strict=True)]
        if costs is not None:
            cost = costs.get(line.point, math.nan)
            row.append(Cell("-" if math.isnan(cost) else f"{cost:.4g}", sort_key(cost), True))
        rows.append(row)
    return heads + (["cost"] if costs is not None else []), rows


def sort_key(key: float) -> float | str:
    """Sort key of a number for the page's script; an empty string for NaN."""
    return "" if math.isnan(key) else key


# Images.


def figure_images(lines: Sequence[PointRow], study: Study, columns_of: ColumnsOf, replay: str) -> list[Picture]:
    """The study's figures; maps with their worst trials. columns_of : the trials of a point"""
    found = []
    for one in layout.figures(study, lines):
        if isinstance(one, Map):
            panels = maps.direction_maps(lines, one, study, columns_of)
            picture, caption = maps.map_png(panels, one), maps.caption(panels, one, study, lines)
            found.append(Picture(embed(picture), caption, worst_rows(panels, replay)))
        else:
            found.append(Picture(embed(figures.figure_png(lines, one, study)), layout.caption(one, study, lines)))
    return found


def worst_rows(panels: Sequence[DirectionMap], replay: str) -> list[WorstRow]:
    """The worst trials of a map's panels with the commands that repeat them."""
    return [
        WorstRow(panel.label, one.direction, one.event, round(one.lights), f"{replay} {one.trial}")
        for panel in panels
        for one in panel.worst
    ]


def sobol_images(indices: Sequence[Index]) -> list[Picture]:
    """Sobol indices, one image per response."""
    named = dict.fromkeys(one.response for one in indices)
    text = "Sobol indices of {}: the share of its variance that would go were a factor known, and that would stay"
    text += " were all others known; intervals of 95 %."
    return [Picture(embed(figures.indices_png(indices, name)), text.format(name)) for name in named]


def search_images(
    lines: Sequence[PointRow], study: Study, front: Sequence[int], costs: Mapping[int, float] | None
) -> list[Picture]:
    """Plots of an optimization: every candidate and, with two objectives, the Pareto front."""
    if study.optimize is None or not lines:
        return []
    panels, points = layout.panels(lines, study.optimize, costs), [line.point for line in lines]
    named, marked = [one.response for one in study.optimize.objectives], ", ".join(map(str, front))
    best = f"none beats {marked} in all objectives" if front else "no candidate is marked yet"
    shown = [Picture(embed(figures.search_png(panels, points, front)), f"Every candidate; {best}. Dashed: bounds.")]
    if len(named) == 2:
        one, other = (panels[name] for name in named)
        text = f"{named[1]} against {named[0]}: the Pareto front of {len(front)} among {len(lines)} candidates."
        shown.insert(0, Picture(embed(figures.pareto_png(one, other, points, front)), text))
    return shown
