"""The report of a finished or unfinished study: answers, figures and tables, made from its plan and its store."""

import itertools
import shlex
from collections.abc import Callable, Mapping, Sequence
from functools import partial
from itertools import starmap
from pathlib import Path
from typing import Any, NamedTuple

from skysim.core.paths import STUDIES, shipped_files
from skysim.core.yaml_reader import OverrideTexts
from skysim.experiments.study import answer, search, thresholds
from skysim.experiments.study.execution.store import Store
from skysim.experiments.study.plan import Curve, Heat, Map, Plan, Study
from skysim.experiments.study.report import figures, layout, maps
from skysim.experiments.study.report.overview import Overview, overview
from skysim.experiments.study.table import (
    Index,
    PointTable,
    format_level,
    format_response,
    format_summary,
    indices,
    pooled,
    pooled_row,
    quantities,
    rank_correlations,
    same,
    select_responses,
    switches_causes,
    table,
)
from skysim.experiments.study.worst import ColumnsOf, ranked, worst_trials
from skysim.results import metrics
from skysim.results.report import (
    Block,
    Cell,
    Code,
    Column,
    Facts,
    Figure,
    Items,
    Report,
    Section,
    Table,
    Text,
    Tone,
    Verdict,
)
from skysim.results.requirements import NOT_MET, Judgment, percent, requirement

Command = Callable[[str], str]  # from a verb to the shell command that applies it to a study
POINTS = "Points"  # titles of sections
POOLED = "All points together"
STUDY_FILE = "The study file"
# Columns of the table of ranges: the least and the largest value of a response, with their points.
RANGES = ("response", "least", "at", "largest", "at")
LISTED = 10  # maximum number of failures listed
ROWS = 5000  # maximum number of rows in the table of points
OPEN_ROWS = 20  # number of rows above which that table is folded
# Title and caption of the indices.
SOBOL = (
    "Sobol indices",
    "Sobol indices of {}: the share of its variance that would go were a factor known, and that would stay were all"
    " others known; intervals of 95 %.",
)
ERROR_CAUSES = (
    "Error causes",
    "Causes of {}: of its mean square with all causes on, the share that each adds alone (first order), and that goes"
    " without it (total); intervals of 95 %.",
)


class Analysis(NamedTuple):
    """The analysis of a study's trials.

    Attributes
    ----------
    lines
        All points, with the responses of `responses` and those of the answers
    about
        Scene table and findings of the scene's checks
    verdict
        The answer in a few sentences
    headline
        All answers in words
    answers
        These, and the range of each response, in words
    indices
        Sobol indices, for the design saltelli; shares of causes where the factors switch causes on and off
    result
        Candidates and front, for a search
    pooled
        In place of the table of points: all points of a sampled design together
    judged
        Judgments of each requirement at all points with an answer
    """

    lines: PointTable
    about: Overview
    verdict: str
    headline: Sequence[str]
    answers: Sequence[str]
    indices: Sequence[Index]
    result: search.SearchResult | None
    pooled: Sequence[Block]
    judged: Sequence[Sequence[Judgment]]


def study_report(plan: Plan, store: Store) -> Report:
    """The report of a study.

    Raises
    ------
    InputError
        If `where` of a figure names an unknown factor or level.
    """
    command = commands(plan, store)
    return compose(store, analyze(plan, store, command), command)


def commands(plan: Plan, store: Store, study: str = "", out: Path | None = None) -> Command:
    """The function from a verb to the shell command that applies it to a study, with overrides if the verb runs it.

    Parameters
    ----------
    study, out
        Study and folder in the command; by default the study's name or path, and the store's
        folder
    """
    if not study:
        shipped = plan.path in shipped_files(STUDIES).values()
        study = plan.name if shipped else str(plan.path)
        out = store.path.parent
    return partial(shell_command, study, out, store.overrides())


def shell_command(study: str, out: Path | None, overrides: OverrideTexts, verb: str) -> str:
    """The shell command that applies `verb` to a study."""
    words = ["skysim", "study", verb, study]
    if out:
        words += ["--out", str(out)]
    if verb in ("run", "optimize"):
        words += [f"--set={key}={value}" for key, value in overrides.items()]
    return shlex.join(words)


def analyze(plan: Plan, store: Store, command: Command) -> Analysis:
    """The analysis of the trials in a store; `command` is the function of `commands`."""
    study = plan.study
    about = overview(plan)
    deciding = [one.response for one in starmap(requirement, about.require.items())]
    names = list(dict.fromkeys([*responses(study), *answer.RESPONSES, *deciding]))
    lines = PointTable(study, table(store, names))
    columns = pooled(plan, store)
    answered = lines.with_rows([pooled_row(plan, columns, names)]) if columns else lines
    judged = thresholds.judged(about.require, answer.answered(answered))
    headline = answer.headline(
        answered, about.may_be_ambiguous, command("worst"), judged, about.survey_share
    )
    headline += answer.one_unit(about.fixed) if headline else []
    sobol = study.design.kind == "saltelli" and not study.optimize
    return Analysis(
        lines,
        about,
        answer.verdict(answered, judged, about.survey_share),
        headline,
        [*headline, *answer.ranges(answered)],
        indices(plan, store) if sobol or switches_causes(study) else [],
        search.collect_result(plan, store) if study.optimize else None,
        pooled_blocks(plan, columns, command("replay")) if columns else (),
        judged,
    )


def responses(study: Study) -> list[str]:
    """The study's responses and those used by its figures, thresholds, objectives and constraints, without `cost`."""
    names = [*study.responses, *(one.response for one in (*study.figures, *study.thresholds))]
    names += study.optimize.responses if study.optimize else []
    return [name for name in dict.fromkeys(names) if name != "cost"]


def compose(store: Store, found: Analysis, command: Command) -> Report:
    """The report of an analyzed study: its question, its answer, one figure, and then the details.

    `command` is the function of `commands`.
    """
    study = found.lines.study
    lines = select_responses(found.lines, responses(study))
    result = found.result or search.SearchResult([], [], finished=False)
    front = [one.number for one in result.front]
    costs = {one.number: one.cost for one in result.candidates}
    title, shares = ERROR_CAUSES if switches_causes(study) else SOBOL
    drawn = [
        *search_figures(lines, front, costs),
        *(
            Figure(figures.indices_png(found.indices, one), shares.format(one), name=one)
            for one in dict.fromkeys(index.response for index in found.indices)
        ),
        *study_figures(lines, store.point_columns, command("replay")),
    ]
    shown = {one.response for one in layout.figures(lines)}
    left = ", ".join(name for name in study.responses if name not in shown)
    done = progress(study, store)
    unmet = any(one.answer == NOT_MET for row in found.judged for one in row)
    tone: Tone = "bad" if unmet else done.tone
    further = [*drawn[1:], Text(left and f"In the table alone: {left}.")]
    blocks = [
        Text(question(store.meta("study")), on_terminal=False),
        *(
            [Verdict(found.verdict, tone), done]
            if found.verdict
            else [Verdict(done.text, done.tone)]
        ),
        failures(store, command("replay")),
        *drawn[:1],
        folded("All answers", [Items(found.headline)], on_terminal=True),
        folded("Further figures", further),
        folded("Ranges of the responses", [Table(RANGES, answer.range_rows(found.lines))])
        if not found.pooled
        else Text(""),
        Section("Requirements", requirement_table(found)),
        Section(title, [index_table(found.indices)]),
        Section("Front", front_table(study, found.result)),
        Section(POOLED, found.pooled)
        if found.pooled
        else points_section(lines, front, costs),
        *scene_sections(found.about, store.meta("code")),
        runs_section(store),
        folded(STUDY_FILE, [Code(store.meta("study"), "yaml")]),
    ]
    return Report(study.title, blocks, command("optimize" if study.optimize else "run"))


def folded(title: str, blocks: Sequence[Block], on_terminal: bool = False) -> Section:
    """A folded section of the page; it is printed on a terminal only with `on_terminal`."""
    return Section(title, blocks, folded=True, on_terminal=on_terminal)


def scene_sections(about: Overview, code: str) -> list[Section]:
    """The findings of the scene's checks, and the scene as a table with the version of the code."""
    findings = (
        Items(about.findings, tone="warning")
        if about.findings
        else Text("Nothing to warn of.")
    )
    facts = [*((name, [text]) for name, text in about.rows), ("code version", [code])]
    return [
        folded("Checks of the scene", [findings], on_terminal=True),
        folded("Scene", [Facts(facts)]),
    ]


# Texts.


def question(text: str) -> str:
    """The comment at the beginning of a study file."""
    lines = itertools.takewhile(lambda line: line.startswith("#"), text.splitlines())
    return " ".join(line.removeprefix("#").strip() for line in lines)


def progress(study: Study, store: Store) -> Text:
    """Numbers of trials that are done, that failed, and that gave a wrong attitude; the tone says if all are done."""
    counts = store.counts()
    trials = study.trial_count(len(store.points()))
    finished = 0 < trials <= counts["done"]
    text = "{done} of {} trials, {failed} failed, {wrong} wrong attitudes (over 10′).".format(
        trials, **counts
    )
    text += "" if finished else " Not finished: what follows is of the trials that are in."
    tone: Tone = "bad" if counts["failed"] else "good" if finished else "warning"
    return Text(text, tone)


def failures(store: Store, replay: str) -> Items:
    """The first failed trials, and the command that repeats one."""
    count = store.counts()["failed"]
    listed = store.failures()[:LISTED]
    lines = [f"trial {trial}: {error}" for trial, error in listed]
    if lines:
        lines.append(f"`{replay} {listed[0][0]}` does one again and keeps its frames.")
    trials = "1 trial failed and counts" if count == 1 else f"{count} trials failed and count"
    first = ", the first of them" if count > len(listed) else ""
    return Items(
        lines, f"{trials} in no figure but `failed`{first}:", "bad", on_terminal=False
    )


# Tables.


def points_section(
    lines: PointTable, front: Sequence[int], costs: Mapping[int, float]
) -> Section:
    """The table of all points. Named levels sort in the order of the study file; points of a front are marked."""
    heads = ["point", *lines.axes, *(lines[0].responses if lines else ())]
    named = [name for name, one in lines.axes.items() if not one.numeric]
    columns = [Column(head, kind="text" if head in named else "number") for head in heads]
    rows: list[list[Any]] = []
    for line in lines[:ROWS]:
        tone: Tone = "marked" if line.point in front else ""
        row: list[Any] = [Cell(str(line.point), tone, line.point)]
        row += [
            Cell(format_level(line.levels[name]), key=one.at(line))
            for name, one in lines.axes.items()
        ]
        row += [
            Cell(format_response(line, name), key=one.value)
            for name, one in line.responses.items()
        ]
        if lines.study.optimize:
            row.append(costs.get(line.point))
        rows.append(row)
    if lines.study.optimize:
        columns.append(Column("cost", format=".4g"))
    note = "In brackets intervals of 95 %."
    if front:
        note += " Tinted: the front."
    if len(lines) > ROWS:
        note += (
            f" And {len(lines) - ROWS} points more: `skysim study export` writes them all."
        )
    shown = Table(columns, rows, from_the_last(len(lines.axes) + 1, len(columns)))
    return Section(POINTS, [shown, Text(note)], folded=len(lines) > OPEN_ROWS)


def pooled_blocks(plan: Plan, columns: metrics.Columns, replay: str) -> list[Block]:
    """A sampled design as a whole: each response with its spread, its dependence on the factors, the worst trials."""
    responses = list(plan.study.responses)
    for quantity in quantities(responses):
        tail = ["least"] if quantity in metrics.MORE_IS_BETTER else ["p95", "worst"]
        responses += [f"{quantity}_{statistic}" for statistic in ("median", *tail)]
    row = pooled_row(plan, columns, responses)
    spread = [[name, with_key(one)] for name, one in row.responses.items()]
    found = rank_correlations(plan, columns)
    response = responses[0]
    worst = [
        [one.value, one.event, one.point, f"`{replay} {one.trial}`"]
        for one in worst_trials(columns, response, flights=True)
    ]
    heads = ["what happened", Column("point"), "repeat it"]
    return [
        Text(f"{row.trials} trials, one at each point; in brackets intervals of 95 %."),
        Table(["response", Column("of all points")], spread),
        Text(
            "Dependence on the factors: an interval that excludes 0 shows one, 95 % for all together."
            if found
            else f"Dependence on the factors: too few to say, {metrics.FEWEST} trials are needed."
        ),
        Table(
            ["quantity", "factor", Column("rank correlation")],
            [[*names, with_key(one)] for *names, one in found],
        ),
        Table([Column(f"worst {ranked(response)}", format=".4g"), *heads], worst),
    ]


def requirement_table(found: Analysis) -> list[Block]:
    """The judgment of each requirement at each point, and the share of its trials that miss it."""
    if not any(found.judged) or found.pooled:
        return []
    lines = answer.answered(found.lines)
    places = map(lines.place, lines)
    answers = [
        [f"{one.answer} ({percent(one.misses)} miss)" for one in row] for row in found.judged
    ]
    heads = ["at", *(row[0].claim for row in found.judged)]
    return [Table(heads, list(zip(places, *answers, strict=True)))]


def index_table(indices: Sequence[Index]) -> Table:
    """The Sobol indices, the largest total of each error first."""
    columns = [
        "error",
        "factor",
        Column("alone, rms", "″", ".3g"),
        Column("first order"),
        Column("total"),
    ]
    rows = [
        [one.response, one.factor, one.rms_arcsec, with_key(one.first), with_key(one.total)]
        for one in sorted(indices, key=lambda one: (one.response, -one.total.value))
    ]
    return Table(columns, rows)


def with_key(summary: Any) -> Cell:
    """A cell with a statistic and its interval, which sorts by value."""
    return Cell(format_summary(summary), key=summary.value)


def front_table(study: Study, result: search.SearchResult | None) -> list[Block]:
    """The front of a search."""
    if result is None:
        return []
    feasible = sum(one.feasible for one in result.candidates)
    text = f"{len(result.candidates)} candidates, {feasible} of them feasible"
    text += "; the front:" if feasible else "."
    heads, rows = search.front_cells(study, result)
    optional = from_the_last(len(study.factors) + 1, len(heads))
    return [Text(text), Table(list(map(Column, heads)), rows, optional)]


def from_the_last(kept: int, count: int) -> list[tuple[int]]:
    """The columns that a narrow terminal leaves out: the last one first, but not the first `kept`."""
    return [(column,) for column in range(count - 1, kept - 1, -1)]


def runs_section(store: Store) -> Section:
    """The runs that have filled the store."""
    columns = [
        "engine",
        Column("workers"),
        Column("trials"),
        Column("time", "s", ".1f"),
        Column("trials/s", format=".2g"),
    ]
    runs = store.runs()
    rows = [
        [*run.values(), run["trials"] / run["seconds"] if run["seconds"] else None]
        for run in runs
    ]
    untimed = store.counts()["done"] - sum(run["trials"] for run in runs)
    note = f"{untimed} trials are of runs that were killed." if untimed > 0 else ""
    return Section("Runs", [Table(columns, rows), Text(note)], folded=True)


# Figures.


def study_figures(lines: PointTable, columns_of: ColumnsOf, replay: str) -> list[Block]:
    """The study's figures: maps with tables of their worst trials, other figures with tables of their numbers.

    Parameters
    ----------
    columns_of
        Returns the columns of the trials of some points
    replay
        The command that repeats a trial
    """
    blocks: list[Block] = []
    for one in layout.figures(lines):
        if isinstance(one, Map):
            panels = maps.direction_maps(lines, one, columns_of)
            picture = Figure(maps.map_png(panels, one), maps.caption(panels, one, lines))
            blocks += [picture, worst_table(panels, replay)]
            continue
        blocks.append(Figure(figures.figure_png(lines, one), layout.caption(one, lines)))
        if not lines.study.is_sampled:
            blocks.append(
                Section("The figure's numbers", [pivot_table(one, lines)], folded=True)
            )
    return blocks


def worst_table(panels: Sequence[maps.DirectionMap], replay: str) -> Table:
    """The worst trials of a map's panels with the commands that repeat them."""
    columns = [
        "worst",
        Column("lights", format=".0f"),
        "what happened",
    ]
    rows = [
        [
            f"{panel.label}: " * bool(panel.label) + one.direction,
            one.lights,
            one.event,
            f"`{replay} {one.trial}`",
        ]
        for panel in panels
        for one in panel.worst
    ]
    return Table([*columns, "repeat it"], rows)


def pivot_table(figure: Curve | Heat, lines: PointTable) -> Table:
    """A figure's numbers: a column per level of x, a row per level of the other factor."""
    across = lines.axes[figure.x]
    other = figure.by if isinstance(figure, Curve) else figure.y
    chosen = lines.shown_in(figure)
    down = lines.axes[other] if other else None

    def text(x: Any, level: Any) -> str:
        for line in chosen:
            if same(line.levels[figure.x], x) and (
                other is None or same(line.levels[other], level)
            ):
                return format_response(line, figure.response)
        return ""

    levels = down.levels if down else [None]
    rows = [
        [down.tick_label(one) if down else "", *(text(x, one) for x in across.levels)]
        for one in levels
    ]
    heads = [Column(across.tick_label(x)) for x in across.levels]
    return Table([f"{figure.response}: {across.label}", *heads], rows)


def search_figures(
    lines: PointTable, front: Sequence[int], costs: Mapping[int, float]
) -> list[Figure]:
    """Plots of an optimization: every candidate and, with two objectives, the Pareto front."""
    config = lines.study.optimize
    if config is None or not lines:
        return []
    panels = layout.panels(lines, config, costs)
    points = [line.point for line in lines]
    named = [one.response for one in config.objectives]
    marked = ", ".join(map(str, front))
    best = f"none beats {marked} in all objectives" if front else "no candidate is marked yet"
    text = f"Every candidate; {best}. Dashed: bounds."
    shown = [Figure(figures.search_png(panels, points, front), text, name="candidates")]
    if len(named) == 2:
        one, other = (panels[name] for name in named)
        text = f"{named[1]} against {named[0]}: the Pareto front of {len(front)} among {len(lines)} candidates."
        shown.insert(
            0,
            Figure(figures.pareto_png(one, other, points, front), text, name="pareto"),
        )
    return shown
