"""What a study's numbers allow to claim, in words: whether the tracker's claimed errors are true, and rare events.

The NEES e' P^-1 e of a true covariance P has the mean 3. If the claimed standard deviations are too small by a factor
f, it has the mean 3 f^2.
"""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np

from skysim.experiments.study.analysis.table import Place, PointRow
from skysim.results import metrics
from skysim.results.metrics import Summary

TRUE_NEES = (2.5, 3.5)  # mean NEES of claimed errors that are true to a tenth


def claimed_errors(lines: Sequence[PointRow], place: Place) -> list[str]:
    """Whether the claimed errors are true at all points, by the intervals of the mean NEES; none without any NEES."""
    found = [(known(line.responses.get("nees", metrics.NO_VALUE)), line) for line in lines]
    found = [(one, line) for one, line in found if np.isfinite(one.low)]
    if not found:
        return []
    low, high = TRUE_NEES
    question = "Are the claimed errors true?"
    false = [(one, line) for one, line in found if one.low > high or one.high < low]
    if not false:
        if all(one.low >= low and one.high <= high for one, _ in found):
            return [f"{question} Yes: NEES is {low:g} to {high:g}{everywhere(len(found))}."]
        widest, line = max(found, key=lambda pair: pair[0].high - pair[0].low)
        at = f" at {place(line)}" if len(found) > 1 else ""
        between = f"{widest.low:.3g} to {widest.high:.3g}"
        return [
            f"{question} Nothing says otherwise, but NEES is known to {between} only{at}; more trials decide it."
        ]
    worst, line = max(false, key=lambda pair: abs(math.log(max(pair[0].value, 1e-9) / 3)))
    factor = math.sqrt(worst.value / 3)
    size = "small"
    if factor < 1:
        factor = 1 / factor
        size = "large"
    at = f" at {place(line)}" if len(found) > 1 else ""
    count = f", at {len(false)} of {len(found)} points" if len(found) > 1 else ""
    wrong = line.responses.get("wrong", metrics.NO_VALUE).value
    cause = ", wrong attitudes included" if wrong > 0 else ""
    interval = f"{worst.low:.3g} to {worst.high:.3g}"
    return [
        f"{question} No: too {size} by a factor of {factor:.2g}{at} (NEES {worst.value:.3g}, {interval}{cause}; 3 if"
        f" true){count}."
    ]


def known(nees: Summary) -> Summary:
    """A mean NEES, also of a single solution if no true covariance has it (probability 1e-8)."""
    if np.isnan(nees.low) and nees.value > metrics.OVERCONFIDENT_NEES:
        return nees._replace(low=nees.value, high=nees.value)
    return nees


def effect_of_wrong_matches(lines: Sequence[PointRow], place: Place) -> list[str]:
    """How many matches are wrong, and whether the attitude errs more than claimed because of them; none if none are."""
    shares = [
        one
        for line in lines
        if (one := line.responses.get("mismatched", metrics.NO_VALUE)).value > 0
    ]
    if not shares:
        return []
    matches = sum(one.trials for one in shares)
    count = round(sum(one.value * one.trials for one in shares))
    text = f"There {count:,} of {matches:,} matches {'is' if count == 1 else 'are'} wrong"
    misled = [(one, line) for line in lines if (one := line.responses["misled"]).value > 0]
    if not misled:
        return [f"{text}; the attitude is unaffected: all errors are as claimed."]
    most, line = max(misled, key=lambda pair: pair[0].value)
    at = (
        f" at {len(misled)} of {len(lines)} points, most at {place(line)}:"
        if len(lines) > 1
        else " in"
    )
    share = (
        f"{100 * most.value:.3g} % of the frames ({100 * most.low:.3g} to {100 * most.high:.3g} %)"
    )
    return [f"{text}; the attitude errs more than claimed{at} {share}."]


def everywhere(points: int) -> str:
    """ " at all 5 points"; empty for one."""
    return f" at all {points} points" if points > 1 else ""


def runs_needed(lines: Sequence[PointRow], events: Sequence[str]) -> list[str]:
    """How many trials the next smaller claim about an event that was never seen needs; none if all were seen.

    The next smaller claim is the next power of ten below the bound of the point with the fewest trials.
    """
    shares = [line.responses[name] for line in lines for name in events]
    never = [share.trials for share in shares if share.value == 0]
    if not never:
        return []
    fewest = min(never)
    bound = metrics.exact_bounds(0, fewest)[1]
    claim = 10.0 ** (math.ceil(math.log10(bound) - 1e-9) - 1)
    needed = metrics.trials_for_bound(claim)
    each = " at each point" if len(lines) > 1 else ""
    return [
        f"None in {fewest:,} is less than {100 * bound:.2g} % at {100 * metrics.CONFIDENCE:g} % confidence; a claim of"
        f" less than {100 * claim:.6g} % needs {needed:,} in all{each} without any."
    ]
