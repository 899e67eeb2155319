"""The report of reproduced experiments: each published number beside ours, with a verdict."""

from __future__ import annotations

import shlex
from collections.abc import Sequence

from skysim.experiments.papers import compare
from skysim.experiments.papers.compare import VERDICTS, Comparison, Reproduction
from skysim.results.plots import png
from skysim.results.report import Report
from skysim.results.report_blocks import (
    Cell,
    Column,
    Figure,
    Items,
    Section,
    Table,
    Text,
    Tone,
    Verdict,
    text_column,
)

KINDS = (*VERDICTS, "derived", "open")
TONES: dict[compare.Verdict, Tone] = {
    "agrees": "good",
    "explained": "warning",
    "disagrees": "bad",
}
INTRODUCTION = (
    "All experiments with published numbers, repeated with our simulator and estimator: the published number, ours with"
    " its 95 % interval, and a verdict. Seed {seed}{quick}. The published numbers with their sources and tolerances are"
    " in `data/published`. No parameter is tuned to a number unless it is listed under Fitted."
)
MEANINGS = (
    "agrees: our interval overlaps the published number with its tolerance.",
    "explained: it overlaps only with causes that the row names and that were simulated too. A fitted cause is listed"
    " under Fitted; it shows only that the number can arise in this way.",
    "disagrees: neither.",
    "derived: the number is not printed, but follows from printed ones.",
    "open: our interval is wider than the tolerance or contains the bound; more trials might change the verdict.",
)


def papers_report(
    reproductions: Sequence[Reproduction], ids: Sequence[str], quick: bool, seed: int
) -> Report:
    """The report of some experiments; the other arguments are those of the command that repeats it."""
    papers = dict.fromkeys(one.published.paper for one in reproductions)
    blocks = [
        verdict(reproductions),
        Text(
            INTRODUCTION.format(seed=seed, quick=", quick: wider intervals" if quick else "")
        ),
        Items(MEANINGS),
        Section("Experiments", [contents(reproductions)]),
        *(
            Section(
                paper, [section(one) for one in reproductions if one.published.paper == paper]
            )
            for paper in papers
        ),
    ]
    options = ["--quick"] * quick + (["--seed", str(seed)] if seed != 1 else [])
    return Report(
        "The papers, reproduced", blocks, shlex.join(["skysim", "reproduce", *ids, *options])
    )


def total_counts(reproductions: Sequence[Reproduction]) -> dict[str, int]:
    """Number of rows of each kind in KINDS, over all experiments."""
    return {kind: sum(one.counts[kind] for one in reproductions) for kind in KINDS}


def verdict(reproductions: Sequence[Reproduction]) -> Verdict:
    """How many published numbers agree with ours."""
    counts = total_counts(reproductions)
    text = "Of {} published numbers {agrees} agree, {explained} are explained and {disagrees} disagree".format(
        sum(counts[kind] for kind in VERDICTS), **counts
    )
    tone: Tone = "bad" if counts["disagrees"] else "good"
    return Verdict(
        f"{text}; {counts['derived']} are derived, {counts['open']} verdicts are open.", tone
    )


def contents(reproductions: Sequence[Reproduction]) -> Table:
    """Counts and seconds of each experiment, with links, and their sums."""
    columns = [text_column("experiment"), text_column(""), *map(Column, KINDS)]
    rows = []
    for one in reproductions:
        counts = [
            Cell(str(count), "bad" if kind == "disagrees" and count else "")
            for kind, count in one.counts.items()
        ]
        rows.append(
            [Cell(one.id, link=f"#{one.id}"), one.published.title, *counts, one.seconds]
        )
    total = [
        "all",
        "",
        *total_counts(reproductions).values(),
        sum(one.seconds for one in reproductions),
    ]
    return Table([*columns, Column("time", "s", ".0f")], [*rows, total])


def section(reproduction: Reproduction, drawn: bool = True) -> Section:
    """An experiment: what its paper leaves open, its table and, if `drawn`, its figures."""
    published = reproduction.published
    remarks = [
        ("What the paper gets wrong", published.wrong),
        ("Assumed, as the paper gives no value", "; ".join(published.assumed)),
        ("Fitted", "; ".join(published.fitted)),
    ]
    figures = [
        Figure(png(one.draw, one.size_in), one.caption, name=f"{reproduction.id}_{n}")
        for n, one in enumerate(reproduction.drawings if drawn else (), 1)
    ]
    blocks = [
        Text(f"{published.title}. {published.source}."),
        Items([f"{heading}: {text}" for heading, text in remarks if text]),
        *figures,
        comparison_table(reproduction.comparisons),
    ]
    return Section(reproduction.id, blocks, id=reproduction.id)


def comparison_table(comparisons: Sequence[Comparison]) -> Table:
    """The published numbers beside ours."""
    columns = [text_column("what"), Column("published"), Column("ours (95 %)")]
    columns += [text_column("verdict"), Column("note", kind="aside")]
    rows = []
    for one in comparisons:
        numbers = [
            compare.format_with_source(one.row),
            compare.format_summary(one.result.ours),
        ]
        rows.append(
            [one.row.quantity, *numbers, Cell(one.verdict, TONES[one.verdict]), one.note]
        )
    return Table(columns, rows)
