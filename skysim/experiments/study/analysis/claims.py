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

TRUE_NEES = (2.5, 3.5)  # mean NEES of claimed errors that are true to a tenth


def claimed_errors(lines: Sequence[PointRow], place: Place) -> list[str]:
    """Whether the claimed errors are true at all points, by the intervals of the mean NEES; none without any NEES."""
    found = [(one, line) for line in lines if np.isfinite((one := line.responses.get("nees", metrics.NO_VALUE)).low)]
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
        return [f"{question} Nothing says otherwise, but NEES is known to {between} only{at}; more trials decide it."]
    worst, line = max(false, key=lambda pair: abs(math.log(max(pair[0].value, 1e-9) / 3)))
    factor, size = math.sqrt(worst.value / 3), "small"
    if factor < 1:
        factor, size = 1 / factor, "large"
    at = f" at {place(line)}" if len(found) > 1 else ""
    count = f", at {len(false)} of {len(found)} points" if len(found) > 1 else ""
    wrong = line.responses.get("wrong", metrics.NO_VALUE).value
    cause = ", wrong attitudes included" if wrong > 0 else ""
    interval = f"{worst.low:.3g} to {worst.high:.3g}"
    return [
        f"{question} No: too {size} by a factor of {factor:.2g}{at} (NEES {worst.value:.3g}, {interval}{cause}; 3 if"
        f" true){count}."
    ]


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
    needed, each = metrics.trials_for_bound(claim), " at each point" if len(lines) > 1 else ""
    return [
        f"None in {fewest:,} is less than {100 * bound:.2g} % at {100 * metrics.CONFIDENCE:g} % confidence; a claim of"
        f" less than {100 * claim:.6g} % needs {needed:,} in all{each} without any."
    ]
