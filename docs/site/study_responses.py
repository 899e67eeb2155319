"""Tables of a study's responses as Markdown, from the code that computes them.

`reference.py` puts them into the reference.
"""

from __future__ import annotations

import inspect
import sys
from collections.abc import Iterable
from pathlib import Path

sys.path.insert(0, str(Path(__file__).parent))
from docstring_text import escape, terms

from skysim.experiments.study.execution.outcomes import Outcome
from skysim.results import metrics

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
INTERVALS = {
    "mean": f"{BOOTSTRAP}; of the NEES chi-square, wider where trials vary more",
    "rms": BOOTSTRAP,
    "sd": "percentile bootstrap, from two values on",
    "tol95": "none: it is a limit; tolNN of NN % of all values, with 95 % confidence",
    "worst": EXTREMUM,
    "least": EXTREMUM,
}


def meaning(name: str, found: dict[str, str]) -> str:
    """The meaning of a name among terms. Raises StopIteration if there is none."""
    return next(text for names, text in found.items() if name in names.split(", "))


def table(head: str, rows: Iterable[tuple[str, str]]) -> str:
    return "\n".join(
        [
            f"| {head} | meaning |",
            "|---|---|",
            *(f"| {name} | {text[:1].upper() + text[1:]} |" for name, text in rows),
        ]
    )


def proportions() -> str:
    """Table of the proportions."""
    shares = terms(inspect.cleandoc(metrics.response.__doc__ or ""))
    rows = [
        (", ".join(f"`{name}`" for name in names.split(", ")), escape(text))
        for names, text in shares.items()
        if any(
            metrics.is_proportion(name) or name == "coverage_N" for name in names.split(", ")
        )
    ]
    return table("name", rows)


def quantities() -> str:
    """Table of the quantities, those of one meaning in one row."""
    columns = terms(inspect.cleandoc(Outcome.__doc__ or ""))
    of_meaning: dict[str, list[str]] = {}
    for name in metrics.QUANTITIES:
        of_meaning.setdefault(QUANTITIES.get(name) or meaning(name, columns), []).append(
            f"`{name}`"
        )
    return table(
        "quantity", [(", ".join(same), escape(text)) for text, same in of_meaning.items()]
    )


def statistics() -> str:
    """Table of the statistics with their intervals, and the statistic of a quantity without an ending."""
    intervals = INTERVALS | {
        name: f"two order statistics, whatever the distribution; from {metrics.values_for_quantile(share)} values on"
        for name, share in metrics.QUANTILES.items()
    }
    rows = [f"| `_{name}` | {intervals[name]} |" for name in metrics.STATISTICS]
    short = [
        f"`{name}` is `{name}_{statistic}`"
        for name, statistic in metrics.DEFAULT_STATISTICS.items()
    ]
    head = ["| ending | interval |", "|---|---|"]
    return "\n".join([*head, *rows, "", f"Without an ending: {'; '.join(short)}."])
