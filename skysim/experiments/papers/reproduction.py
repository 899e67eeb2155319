"""Repeat a published experiment by the command that a user would type, and compare its numbers with the paper's.

Each experiment of data/published names a scene or a study, and each row a response: a path into the JSON of the command
that runs it, as in `leds.0.mean` or `stops.4.difference_deg.2`. A study's response has the levels of the point in
brackets: `identified[rate=2, chain=default]`. Two terms may be subtracted or divided: `a - b`, `a / b`; a term may be a
number.

The verdict tests the difference d between our number and the published one. With our standard error s (of the mean over
runs, or of the study's response), the scatter p of the published number and an allowed difference t,

    agrees:     |d| <= t + 1.96 sqrt(s^2 + p^2)
    undecided:  it agrees, but our own part 1.96 s alone is larger than t + 1.96 p: more runs are needed
    disagrees:  else.

For a bound d is how far our number is beyond it, 0 on the allowed side, with t and s as above; a verdict is undecided
where the bound is within 1.96 s of our number.
"""

import contextlib
import math
import re
import shlex
import tempfile
import time
from collections.abc import Callable, Sequence
from dataclasses import asdict, field
from pathlib import Path
from typing import Any, Literal, NamedTuple, get_args

import numpy as np

from skysim.core.errors import InputError
from skysim.core.types import Record, frozen
from skysim.experiments import home_calibration
from skysim.experiments.papers.published import Experiment, PublishedRow, experiments
from skysim.experiments.study.api import run_study
from skysim.experiments.study.execution.store import open_store
from skysim.experiments.study.table import PointRow, format_level, table
from skysim.results import run_report, scoring, telemetry_report
from skysim.results.metrics import SIGMAS
from skysim.results.report import (
    Cell,
    Code,
    Column,
    Items,
    Report,
    Section,
    Table,
    Text,
    Tone,
    Verdict,
)
from skysim.scene import loader
from skysim.simulation.flight import Progress, open_flight

RowVerdict = Literal["agrees", "undecided", "disagrees"]
VERDICTS: tuple[RowVerdict, ...] = get_args(RowVerdict)
TERM = re.compile(r"\s*([\w.-]+?)\s*(?:\[(.*?)\])?\s*")
BOTH = re.compile(r"^(.*?\S)\s+([-/])\s+(\S.*)$")


class Options(NamedTuple):
    """Options of `skysim reproduce`.

    Attributes
    ----------
    quick
        Fewer runs, wider intervals
    seed
        Seed of the first run; further runs use the next integers
    watch
        Progress callback, called with (completed, total)
    """

    quick: bool = False
    seed: int = 1
    watch: Progress = lambda completed, total: None


class Ours(NamedTuple):
    """Our number: its mean over n runs, the standard error of this mean, and the deviation between runs."""

    value: float
    error: float = 0.0
    deviation: float = 0.0
    runs: int = 1


class Comparison(NamedTuple):
    """One row of the table: published number, ours and the verdict."""

    id: str
    row: PublishedRow
    ours: Ours
    verdict: RowVerdict

    def as_dict(self) -> Record:
        """For JSON. A bound is published as [least, most], an open end as null."""
        row = self.row
        bounds = [row.at_least, row.at_most]
        return {
            "id": self.id,
            "quantity": row.quantity,
            "class": row.row_class,
            "published": bounds if row.published is None else row.published,
            "scatter": row.scatter,
            "tolerance": row.tolerance,
            "ours": self.ours.value,
            "error": self.ours.error,
            "runs": self.ours.runs,
            "verdict": self.verdict,
            "note": row.note,
        }


@frozen
class Reproduction:
    """A repeated experiment: the published data, the commands, the comparison of each row, and the time in seconds."""

    id: str
    published: Experiment
    commands: tuple[str, ...]
    comparisons: tuple[Comparison, ...]
    seconds: float = field(compare=False)

    def count(self, verdict: RowVerdict, predictions: bool = False) -> int:
        """Number of rows with a verdict, of all or of the predictions alone."""
        return sum(
            one.verdict == verdict and (not predictions or one.row.row_class == "prediction")
            for one in self.comparisons
        )


def check_ids(ids: Sequence[str]) -> list[str]:
    """The requested ids without repeats; `all` for every experiment. Raises InputError for an unknown id."""
    if list(ids) == ["all"]:
        return list(experiments())
    for id in ids:
        if id not in experiments():
            raise InputError(
                "", f"unknown experiment '{id}'", f"all, {', '.join(experiments())}"
            )
    return list(dict.fromkeys(ids))


def reproduce(id: str, options: Options) -> Reproduction:
    """Repeat one experiment and compare it with the published numbers. Raises InputError."""
    begin = time.perf_counter()
    experiment = experiments()[id]
    if experiment.command == "study":
        commands, number = study_numbers(experiment, options)
    else:
        commands, number = run_numbers(experiment, options)
    comparisons = []
    for key, row in experiment.rows.items():
        try:
            ours = evaluate(row.response, number)
        except (KeyError, IndexError, TypeError, ValueError) as error:
            raise InputError(f"{id}.{key}.response", f"{row.response}: {error!r}") from None
        comparisons.append(Comparison(id, row, ours, verdict(row, ours)))
    seconds = time.perf_counter() - begin
    return Reproduction(id, experiment, tuple(commands), tuple(comparisons), seconds)


# Our numbers.


Number = Callable[[str, str], Ours]  # of a path and the text in its brackets


def run_numbers(experiment: Experiment, options: Options) -> tuple[list[str], Number]:
    """Run a scene with several seeds; a number is the mean of its values, of the runs in which it has one."""
    runs = experiment.quick_runs if options.quick else experiment.runs
    clicks = home_calibration.CLICKS if experiment.clicks is None else experiment.clicks
    commands = []
    results = []
    for n in range(runs):
        seed = options.seed + n
        overrides = {key: str(seed) for key in ("seed", *experiment.hardware)}
        sets = [f"--set={key}={seed}" for key in experiment.hardware]
        if experiment.clicks is not None:
            sets.append(f"--clicks={experiment.clicks}")
        commands.append(
            shlex.join(
                ["skysim", experiment.command, experiment.file, f"--seed={seed}", *sets]
            )
        )
        scene = loader.load(experiment.file, overrides)
        if experiment.command == "calibrate":
            measured = home_calibration.measure_scene(scene)
            calibrated = home_calibration.calibrated(*measured, clicks)
            results.append(home_calibration.statistics(calibrated))
        else:
            # What `skysim run --json` prints of a flight, without the files.
            with open_flight(scene) as flight:
                rows = [scoring.Score(shot).row for shot in flight.shots()]
                motion = telemetry_report.summary(flight.telemetry())
            found = {"flight": motion, "rows": [asdict(row) for row in rows]}
            results.append(run_report.summary(rows) | found)
        options.watch(n + 1, runs)

    def number(path: str, levels: str) -> Ours:
        values = np.array([at_path(result, path) for result in results], float)
        values = values[np.isfinite(values)]
        count = len(values)
        if not count:
            return Ours(math.nan, runs=0)
        deviation = float(values.std(ddof=1)) if count > 1 else 0.0
        return Ours(float(values.mean()), deviation / math.sqrt(count), deviation, count)

    return commands, number


def study_numbers(experiment: Experiment, options: Options) -> tuple[list[str], Number]:
    """Run a study; a number is a response at one of its points."""
    replicates = experiment.quick_runs if options.quick else experiment.runs
    overrides = {"replicates": replicates, "seed": options.seed}
    sets = [f"--set={key}={value}" for key, value in overrides.items()]
    command = shlex.join(["skysim", "study", "run", experiment.file, *sets])
    with tempfile.TemporaryDirectory() as folder:
        result = run_study(experiment.file, overrides, out=Path(folder))
        with open_store(result.path) as store:
            rows = table(store, result.plan.study.responses)

    def number(path: str, levels: str) -> Ours:
        summary = point_at(rows, levels).responses[path]
        half = (summary.high - summary.low) / 2
        error = 0.0 if math.isnan(half) else half / SIGMAS
        return Ours(summary.value, error, error * math.sqrt(summary.trials), summary.trials)

    return [command], number


def point_at(rows: Sequence[PointRow], levels: str) -> PointRow:
    """The only point with the levels of a text such as `rate=2, chain=default`. Raises ValueError."""
    wanted = dict(
        re.split(r"\s*=\s*", part, maxsplit=1) for part in levels.split(",") if part.strip()
    )
    found = [
        row
        for row in rows
        if all(
            format_level(row.levels[name.strip()]) == level.strip()
            for name, level in wanted.items()
        )
    ]
    if len(found) != 1:
        raise ValueError(f"{len(found)} points with {levels or 'any levels'}")
    return found[0]


def at_path(result: Any, path: str) -> float:
    """The number at a dotted path of mappings and lists; NaN below a value that is missing."""
    for part in path.split("."):
        if result is None:  # of a frame without a solution
            return math.nan
        result = result[part] if isinstance(result, dict) else result[int(part)]
    return float(result)


def evaluate(response: str, number: Number) -> Ours:
    """The value of a response: one term, or two with - or / between them.

    Independent errors add in quadrature, each times the derivative of the value by its term.
    """
    if both := BOTH.match(response):
        a = evaluate(both[1], number)
        b = evaluate(both[3], number)
        value = a.value - b.value
        by_a = by_b = 1.0
        if both[2] == "/":
            value = a.value / b.value
            by_a = 1 / b.value
            by_b = value / b.value
        error, deviation = (
            math.hypot(by_a * one, by_b * two)
            for one, two in ((a.error, b.error), (a.deviation, b.deviation))
        )
        return Ours(value, error, deviation, max(a.runs, b.runs))
    term = TERM.fullmatch(response)
    if not term:
        raise ValueError("no response")
    with contextlib.suppress(ValueError):
        return Ours(float(term[1]))
    return number(term[1], term[2] or "")


# Verdicts.


def verdict(row: PublishedRow, ours: Ours) -> RowVerdict:
    """The verdict of the module's docstring."""
    own = SIGMAS * ours.error
    if math.isnan(ours.value):
        return "disagrees"
    if row.published is None:
        low = -math.inf if row.at_least is None else row.at_least - row.tolerance
        high = math.inf if row.at_most is None else row.at_most + row.tolerance
        if min(abs(ours.value - low), abs(ours.value - high)) < own:
            return "undecided"
        return "agrees" if low <= ours.value <= high else "disagrees"
    theirs = row.tolerance + SIGMAS * scatter(row, ours)
    limit = row.tolerance + SIGMAS * math.hypot(ours.error, scatter(row, ours))
    if abs(ours.value - row.published) > limit + 1e-12 * abs(row.published):
        return "disagrees"
    return "undecided" if own > theirs > 0 else "agrees"


def scatter(row: PublishedRow, ours: Ours) -> float:
    """Standard deviation of the published number: as stated, and that of one of our runs if it is a single draw."""
    return math.hypot(row.scatter, ours.deviation if row.draw else 0.0)


# The report of repeated experiments: each published number beside ours, with a verdict.


TONES: dict[RowVerdict, Tone] = {
    "agrees": "good",
    "undecided": "warning",
    "disagrees": "bad",
}
INTRODUCTION = (
    "Experiments with published numbers, repeated by the commands that each section gives. Seed {seed}{quick}. The"
    " published numbers with their sources are in `data/published`."
)
MEANINGS = (
    "agrees: the difference is within the tolerance and 1.96 standard deviations of ours and theirs together.",
    "undecided: it agrees, but our own part of that is larger than the rest; more runs might change it.",
    "disagrees: the difference is larger. A note says what is known of the cause.",
    "prediction: nothing of the number is used; bound: only a bound is published; derived: computed from printed"
    " numbers; fitted: a parameter was fitted to it or its table; repeated: it follows from another row; input: the"
    " experiment is given it. Only predictions count in the headline.",
)


def papers_report(
    reproductions: Sequence[Reproduction], ids: Sequence[str], quick: bool, seed: int
) -> Report:
    """The report of some experiments; the other arguments are those of the command that repeats it."""
    papers = dict.fromkeys(one.published.paper for one in reproductions)
    by_paper = [
        Section(
            paper, [section(one) for one in reproductions if one.published.paper == paper]
        )
        for paper in papers
    ]
    blocks = [
        headline(reproductions),
        Text(
            INTRODUCTION.format(seed=seed, quick=", quick: wider intervals" if quick else "")
        ),
        Items(MEANINGS),
        Section("Experiments", [contents(reproductions)]),
        *by_paper,
    ]
    options = ["--quick"] * quick + (["--seed", str(seed)] if seed != 1 else [])
    command = shlex.join(["skysim", "reproduce", *ids, *options])
    return Report("The papers, repeated", blocks, command)


def headline(reproductions: Sequence[Reproduction]) -> Verdict:
    """How many predictions agree, and how many rows of any class disagree."""
    agree, undecided, disagree = (
        sum(one.count(kind, predictions=True) for one in reproductions) for kind in VERDICTS
    )
    rows = sum(len(one.comparisons) for one in reproductions)
    others = sum(one.count("disagrees") for one in reproductions) - disagree
    text = (
        f"Of {agree + undecided + disagree} predictions {agree} agree with the published number, {disagree} disagree"
        f" and {undecided} are undecided; of the {rows - agree - undecided - disagree} other rows {others} disagree."
    )
    return Verdict(text, "bad" if disagree else "good")


def contents(reproductions: Sequence[Reproduction]) -> Table:
    """Verdicts and seconds of each experiment, with links."""
    columns = [
        "experiment",
        "",
        *(Column(f"predictions: {kind}") for kind in VERDICTS),
        Column("rows"),
        Column("time", "s", ".0f"),
    ]
    rows = []
    for one in reproductions:
        counts = [one.count(kind, predictions=True) for kind in VERDICTS]
        name = Cell(one.id, link=f"#{one.id}")
        rows.append([name, one.published.title, *counts, len(one.comparisons), one.seconds])
    return Table(columns, rows)


def section(reproduction: Reproduction) -> Section:
    """An experiment: its commands, what its paper leaves open, and its table."""
    published = reproduction.published
    remarks = [
        ("What the paper gets wrong", published.wrong),
        ("Assumed, as the paper gives no value", "; ".join(published.assumed)),
        ("Fitted", "; ".join(published.fitted)),
    ]
    first, *others = reproduction.commands
    more = (
        f"\n# and {len(others)} more, to {others[-1].split('--seed=')[-1]}" if others else ""
    )
    blocks = [
        Text(f"{published.title}. {published.source}."),
        Code(f"{first}{more}", "sh"),
        Items([f"{heading}: {text}" for heading, text in remarks if text]),
        comparison_table(reproduction.comparisons),
    ]
    return Section(reproduction.id, blocks, id=reproduction.id)


def comparison_table(comparisons: Sequence[Comparison]) -> Table:
    """The published numbers beside ours."""
    columns = [
        "what",
        "class",
        Column("published"),
        Column("ours"),
        "verdict",
        Column("note", kind="aside"),
    ]
    rows = []
    for one in comparisons:
        row = one.row
        source = f" ({row.source})" if row.source else ""
        numbers = [format_published(row) + source, format_ours(one.ours)]
        cell = Cell(one.verdict, TONES[one.verdict])
        rows.append([row.quantity, row.row_class, *numbers, cell, row.note])
    return Table(columns, rows)


def format_ours(ours: Ours) -> str:
    """Our number with its 95 % interval, if it has one."""
    half = SIGMAS * ours.error
    return f"{ours.value:.4g} ± {half:.2g}" if half else f"{ours.value:.4g}"


def format_published(row: PublishedRow) -> str:
    """The published number or its bounds, with what is allowed: tolerance, and 1.96 times the scatter."""
    if row.published is not None:
        text = f"{row.published:.6g}"
    elif row.at_least is None:
        text = f"≤ {row.at_most:.6g}"
    elif row.at_most is None:
        text = f"≥ {row.at_least:.6g}"
    else:
        text = f"{row.at_least:.6g}..{row.at_most:.6g}"
    allowed = math.hypot(row.tolerance, SIGMAS * row.scatter)
    single = ", one draw" if row.draw else ""
    return f"{text} ± {allowed:.2g}{single}" if allowed else f"{text}{single}"
