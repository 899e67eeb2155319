"""Comparison of our results with published numbers; the verdict follows from the numbers alone.

A published number has a tolerance, which gives a band; ours has an interval of 95 %. The verdict is `agrees` if the
interval and the band overlap; `explained` if they overlap only after a named cause is simulated too (for instance a
fault of the paper's laboratory); else `disagrees`.
"""

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
    """Options of an experiment.

    quick: fewer trials, wider intervals;  seed: of all its random streams
    watch: progress callback, called with (done, total)
    """

    quick: bool = False
    seed: int = 1
    watch: Callable[[float, float], None] = lambda done, everything: None

    def trials(self, full: int, quick: int) -> int:
        return quick if self.quick else full


class Cause(NamedTuple):
    """A property of the paper's laboratory that our baseline lacks: its name, and our number with it simulated too."""

    name: str
    ours: Summary


class Answer(NamedTuple):
    """Our number for a published one; a cause if the baseline alone does not reproduce it."""

    ours: Summary
    note: str = ""
    cause: Cause | None = None


class Drawing(NamedTuple):
    """A figure of our data: draw(figure) draws into an empty matplotlib figure of that size."""

    caption: str
    draw: Callable[[Any], None]
    size_in: tuple[float, float] = (7.4, 3.9)


@dataclass(frozen=True, slots=True)
class Found:
    """Results of an experiment: an answer to every published row, by key, and figures."""

    answers: Mapping[str, Answer]
    drawings: tuple[Drawing, ...] = ()


class Comparison(NamedTuple):
    """One row of the table: published number, ours and the verdict."""

    id: str
    row: Row
    answer: Answer
    verdict: Verdict

    @property
    def note(self) -> str:
        """Remarks: our number with the cause, the weakness of the comparison, and notes of experiment and data."""
        cause = self.answer.cause
        told = f"with {cause.name}: {number(cause.ours)}" if cause else ""
        return "; ".join(part for part in (told, self.weakness, self.answer.note, self.row.note) if part)

    @property
    def weakness(self) -> str:
        """Why the interval leaves the verdict open, or "": it is wider than the band, or contains a one-sided bound."""
        cause, (low, high) = self.answer.cause, self.row.band
        if self.verdict == "disagrees":
            return ""
        ours = cause.ours if cause and self.verdict == "explained" else self.answer.ours
        if low > -math.inf and high < math.inf:
            return "interval wider than the tolerance" if ours.high - ours.low > high - low else ""
        bound = low if low > -math.inf else high
        return "the bound lies within the interval" if ours.low < bound < ours.high else ""

    def as_dict(self) -> dict[str, Any]:
        """For JSON. A bound is published as [least, most], an open end as null."""
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
    """A reproduced experiment: the published data, the comparison of each row, figures, and run time in seconds."""

    id: str
    published: Experiment
    lines: tuple[Comparison, ...]
    drawings: tuple[Drawing, ...]
    seconds: float = field(compare=False)

    @property
    def counts(self) -> dict[str, int]:
        """Number of rows by verdict, of rows with a derived number (`derived`), and of open verdicts (`open`)."""
        told: dict[str, int] = {
            verdict: sum(line.verdict == verdict for line in self.lines) for verdict in VERDICTS
        }
        told["derived"] = sum(line.row.derived for line in self.lines)
        told["open"] = sum(bool(line.weakness) for line in self.lines)
        return told


def compare(id: str, published: Experiment, found: Found, seconds: float) -> Reproduction:
    """Compare every published row with its answer.

    Raises ValueError if an experiment leaves a row unanswered or answers one that is not published.
    """
    if missed := published.rows.keys() ^ found.answers.keys():
        raise ValueError(f"{id}: published or answered, but not both: {', '.join(sorted(missed))}")
    lines = tuple(
        Comparison(id, row, found.answers[key], verdict(row, found.answers[key]))
        for key, row in published.rows.items()
    )
    return Reproduction(id, published, lines, found.drawings, seconds)


def verdict(row: Row, answer: Answer) -> Verdict:
    """agrees: our interval overlaps the published number's band; explained: it does so only with the cause."""
    if meets(row, answer.ours):
        return "agrees"
    return "explained" if answer.cause and meets(row, answer.cause.ours) else "disagrees"


def meets(row: Row, ours: Summary) -> bool:
    """Return True if our interval (the number itself if it has none) and the row's band overlap."""
    low, high = row.band
    ends = (ours.value if end != end else end for end in (ours.low, ours.high))  # NaN: no interval
    least, most = ends
    return least <= high and most >= low


def printed(row: Row) -> str:
    """Format the published number with its source; `derived` if the paper does not print it."""
    where = "; ".join(part for part in ("derived" if row.derived else "", row.source) if part)
    return f"{stated(row)} ({where})" if where else stated(row)


def number(told: Summary) -> str:
    """Format a number, with its interval if it has one."""
    if told.low == told.high or told.low != told.low:
        return f"{told.value:.4g}"
    return f"{told.value:.4g} ({told.low:.4g}..{told.high:.4g})"


def stated(row: Row) -> str:
    """Format the published number or its bounds, with the tolerance."""
    if row.published is not None:
        told = f"{row.published:.6g}"
    elif row.at_least is None:
        told = f"≤ {row.at_most:.6g}"
    else:
        told = f"≥ {row.at_least:.6g}" if row.at_most is None else f"{row.at_least:.6g}..{row.at_most:.6g}"
    return f"{told} ± {row.tolerance:.3g}" if row.tolerance else told
