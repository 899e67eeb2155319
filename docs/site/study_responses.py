"""Write the reference page of a study's responses from the code that computes them.

`make reference` writes docs/reference/responses.md; a test compares it with the code.
"""

from __future__ import annotations

import inspect
import re
import sys
from collections.abc import Iterable
from pathlib import Path

sys.path.insert(0, str(Path(__file__).parent))
from docstring_text import escape

from skysim.core.files import ROOT
from skysim.experiments.study.execution.outcomes import Outcome
from skysim.results import metrics

PAGE = ROOT / "docs" / "reference" / "responses.md"
TERM = re.compile(r"^(\w+(?:, \w+)*) *: (.*)$")
# Quantities whose names are not those of a column, or that need more words than a column has.
QUANTITIES = {
    "cross_arcsec": "error across the boresight, the hypotenuse of both axes",
    "roll_arcsec": "error about the boresight, its magnitude",
    "angle_arcsec": "rotation angle of the error",
    "time_ms": "time of a trial, on the machine that ran it",
}
BOOTSTRAP = (
    "percentile bootstrap, from two values on; of more than 2,000 the 50 most extreme are resampled one by one, the sum"
    " of the others is normal"
)
EXTREMUM = "none: it is that of these trials"
INTERVALS = {"mean": BOOTSTRAP, "rms": BOOTSTRAP, "worst": EXTREMUM, "least": EXTREMUM}
QUANTILES = {"median": 0.5, "p90": 0.9, "p95": 0.95, "p99": 0.99}

HEAD = """# Responses of a study

The names that `responses`, `figures`, `thresholds`, `objectives` and `constraints` of a [study](../howto/study.md)
take, written by `make reference` from the code that computes them ([`skysim.results.metrics`](running.md)). Intervals
are of 95 %.

## Proportions

Of the frames, except where it says otherwise; [Conventions](../explanation/conventions.md) define *wrong*. The interval
is Wilson's; of none, and of all, it is the exact one-sided bound. The frames of a flight are not independent, so its
interval is that of as many frames as there are flights.

"""
MIDDLE = """

## Quantities

A quantity with the ending of a statistic is a response: `cross_arcsec_p95`. Errors are those of all solutions, wrong
ones included, and quantities of a flight those of its frames together.

"""
TAIL = """

## Statistics

| ending | interval |
|---|---|
"""


def terms(docstring: str | None) -> dict[str, str]:
    """The meanings of a docstring's lines `name, name : meaning`, by their names; meanings may go on, indented."""
    found: dict[str, str] = {}
    last = ""
    for line in inspect.cleandoc(docstring or "").splitlines():
        if term := TERM.match(line):
            last = term[1]
            found[last] = term[2].strip()
        elif last and line.startswith("  ") and line.strip():
            found[last] += f" {line.strip()}"
        else:
            last = ""
    return found


def meaning(name: str, found: dict[str, str]) -> str:
    """The meaning of a name among terms. Raises StopIteration if there is none."""
    return next(text for names, text in found.items() if name in names.split(", "))


def table(head: str, rows: Iterable[tuple[str, str]]) -> str:
    return "\n".join(
        [f"| {head} | meaning |", "|---|---|", *(f"| {name} | {text} |" for name, text in rows)]
    )


def page() -> str:
    """The text of the page."""
    shares = terms(metrics.response.__doc__)
    proportions = [
        (", ".join(f"`{name}`" for name in names.split(", ")), escape(text))
        for names, text in shares.items()
        if any(metrics.is_proportion(name) or name == "coverage_N" for name in names.split(", "))
    ]
    columns = terms(Outcome.__doc__)
    of_meaning: dict[str, list[str]] = {}
    for name in metrics.QUANTITIES:
        of_meaning.setdefault(QUANTITIES.get(name) or meaning(name, columns), []).append(
            f"`{name}`"
        )
    quantities = [(", ".join(same), escape(text)) for text, same in of_meaning.items()]
    short = [
        (f"`{name}`", f"`{name}_{statistic}`")
        for name, statistic in metrics.DEFAULT_STATISTICS.items()
    ]
    intervals = INTERVALS | {
        name: f"two order statistics, whatever the distribution; from {metrics.values_for_quantile(share)} values on"
        for name, share in QUANTILES.items()
    }
    statistics = "\n".join(f"| `_{name}` | {intervals[name]} |" for name in metrics.STATISTICS)
    return (
        f"{HEAD}{table('name', proportions)}{MIDDLE}{table('quantity', quantities)}{TAIL}{statistics}\n\n"
        f"Without an ending: {'; '.join(f'{name} is {full}' for name, full in short)}.\n"
    )


if __name__ == "__main__":
    PAGE.write_text(page(), encoding="utf-8")
