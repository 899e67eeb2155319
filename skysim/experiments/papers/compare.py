"""Ours beside the published: the verdict follows from the numbers and from nothing else."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from typing import Any, Literal, NamedTuple

from skysim.experiments.papers.published import Experiment, Row
from skysim.results.metrics import Summary

Verdict = Literal["agrees", "explained", "disagrees"]
VERDICTS: tuple[Verdict, ...] = ("agrees", "explained", "disagrees")


@dataclass(frozen=True, slots=True)
class Ask:
    """How an experiment is to be done.

    quick: fewer trials, wider intervals;  seed: of all its random streams
    watch: to be called with how much is done of how much
    """

    quick: bool = False
    seed: int = 1
    watch: Callable[[float, float], None] = lambda done, everything: None

    def trials(self, full: int, quick: int) -> int:
        return quick if self.quick else full


class Cause(NamedTuple):
    """What a paper's lab had and our baseline has not: its name, and ours when it is simulated too."""

    name: str
    ours: Summary


class Answer(NamedTuple):
    """Our number for a published one; a cause where the baseline alone would not give it."""

    ours: Summary
    note: str = ""
    cause: Cause | None = None


class Drawing(NamedTuple):
    """A picture of our data: draw(figure) draws into an empty figure of matplotlib of that size."""

    caption: str
    draw: Callable[[Any], None]
    size_in: tuple[float, float] = (7.4, 3.9)


@dataclass(frozen=True, slots=True)
class Found:
    """What an experiment found: an answer to every published row, by key, and pictures."""

    answers: Mapping[str, Answer]
    drawings: tuple[Drawing, ...] = ()


class Comparison(NamedTuple):
    """A line of the table."""

    id: str
    row: Row
    answer: Answer
    verdict: Verdict

    @property
    def note(self) -> str:
        """The cause and what comes of it; how weak the comparison is; what data and experiment say besides."""
        cause = self.answer.cause
        told = f"with {cause.name}: {number(cause.ours)}" if cause else ""
        return "; ".join(part for part in (told, self.weakness, self.answer.note, self.row.note) if part)

    @property
    def weakness(self) -> str:
        """Said where a verdict other than disagrees rests on an interval that leaves it open."""
        cause, (low, high) = self.answer.cause, self.row.band
        if self.verdict == "disagrees":
            return ""
        ours = cause.ours if cause and self.verdict == "explained" else self.answer.ours
        if low > -math.inf and high < math.inf:
            return "interval wider than the tolerance" if ours.high - ours.low > high - low else ""
        bound = low if low > -math.inf else high
        return "the bound lies within the interval" if ours.low < bound < ours.high else ""

    def as_dict(self) -> dict[str, Any]:
        """For machines. A bound is published as [least, most], an open end as null."""
        row, ours = self.row, self.answer.ours
        bounds = [row.at_least, row.at_most]
        return {
            "id": self.id,
            "quantity": row.quantity,
            "published": bounds if row.published is None else row.published,
            "ours": ours.value,
            "interval": [ours.low, ours.high],
            "tolerance": row.tolerance,
            "verdict": self.verdict,
            "note": self.note,
        }


@dataclass(frozen=True, slots=True)
class Reproduction:
    """An experiment that was done: what is published, line by line ours, pictures, seconds."""

    id: str
    published: Experiment
    lines: tuple[Comparison, ...]
    drawings: tuple[Drawing, ...]
    seconds: float = field(compare=False)

    @property
    def counts(self) -> dict[str, int]:
        """Lines of each verdict; of them those whose number is derived, and whose verdict an interval leaves open."""
        told: dict[str, int] = {
            verdict: sum(line.verdict == verdict for line in self.lines) for verdict in VERDICTS
        }
        told["derived"] = sum(line.row.derived for line in self.lines)
        told["open"] = sum(bool(line.weakness) for line in self.lines)
        return told


def compare(id: str, published: Experiment, found: Found, seconds: float) -> Reproduction:
    """Every published row beside its answer.

    Raises ValueError where an experiment leaves a row unanswered or answers one that nobody published.
    """
    if missed := published.rows.keys() ^ found.answers.keys():
        raise ValueError(f"{id}: published or answered, but not both: {', '.join(sorted(missed))}")
    lines = tuple(
        Comparison(id, row, found.answers[key], verdict(row, found.answers[key]))
        for key, row in published.rows.items()
    )
    return Reproduction(id, published, lines, found.drawings, seconds)


def verdict(row: Row, answer: Answer) -> Verdict:
    """agrees where our interval meets the published number's band; explained where it does with the cause alone."""
    if meets(row, answer.ours):
        return "agrees"
    return "explained" if answer.cause and meets(row, answer.cause.ours) else "disagrees"


def meets(row: Row, ours: Summary) -> bool:
    """Whether the interval, or the number where it has none, and the band have a point in common."""
    low, high = row.band
    ends = (ours.value if end != end else end for end in (ours.low, ours.high))
    least, most = ends
    return least <= high and most >= low


def printed(row: Row) -> str:
    """The published number and where it stands; `derived` where it is not printed."""
    where = "; ".join(part for part in ("derived" if row.derived else "", row.source) if part)
    return f"{stated(row)} ({where})" if where else stated(row)


def number(told: Summary) -> str:
    """A number with its interval where it has one."""
    if told.low == told.high or told.low != told.low:
        return f"{told.value:.4g}"
    return f"{told.value:.4g} ({told.low:.4g}..{told.high:.4g})"


def stated(row: Row) -> str:
    """The published number or bounds, and the tolerance."""
    if row.published is not None:
        told = f"{row.published:.6g}"
    elif row.at_least is None:
        told = f"≤ {row.at_most:.6g}"
    else:
        told = f"≥ {row.at_least:.6g}" if row.at_most is None else f"{row.at_least:.6g}..{row.at_most:.6g}"
    return f"{told} ± {row.tolerance:.3g}" if row.tolerance else told
