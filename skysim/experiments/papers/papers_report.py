"""The report of repeated experiments: each published number beside ours, with a verdict."""

import math
import shlex
from collections.abc import Sequence

from skysim.experiments.papers.published import PublishedRow
from skysim.experiments.papers.reproduction import VERDICTS, Comparison, Ours, Reproduction
from skysim.experiments.papers.reproduction import Verdict as RowVerdict
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
    text_column,
)

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
        verdict(reproductions),
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


def verdict(reproductions: Sequence[Reproduction]) -> Verdict:
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
        text_column("experiment"),
        text_column(""),
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
        text_column("what"),
        text_column("class"),
        Column("published"),
        Column("ours"),
        text_column("verdict"),
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
