"""PWM drive: when an LED is lit, and where in time its light lies."""

from __future__ import annotations

from math import ceil, floor, sqrt
from typing import Any

from skysim.compiled import jit


@jit
def lit_moments_s(begin_s: float, end_s: float, period_s: float, start_s: float, on_s: float) -> Any:
    """Seconds of [begin, end] during which a pulse train shines, their mean time and its standard deviation.

    It is lit from start_s for on_s in every period_s, before and after. Exact for any interval: the first and the
    last pulse are cut where it ends; the n whole ones between have the moments of a comb, whose centres' variance
    is period^2 (n^2 - 1) / 12. (0, the middle, 0) where it is dark.
    """
    middle = (begin_s + end_s) / 2
    if on_s >= period_s:
        return end_s - begin_s, middle, (end_s - begin_s) / sqrt(12.0)
    first = floor((begin_s - start_s - on_s) / period_s) + 1
    last = ceil((end_s - start_s) / period_s) - 1
    lit, sum1, sum2 = 0.0, 0.0, 0.0
    for j in range(first, last + 1, max(last - first, 1)):  # the two at the ends, or the only one
        up = max(start_s + j * period_s, begin_s)
        width = min(start_s + j * period_s + on_s, end_s) - up
        if width > 0:
            centre = up + width / 2 - middle
            lit, sum1, sum2 = lit + width, sum1 + width * centre, sum2 + width * (centre**2 + width**2 / 12)
    n = last - first - 1
    if n > 0:
        centre = start_s + (first + 1) * period_s + on_s / 2 + (n - 1) * period_s / 2 - middle
        lit += n * on_s
        sum1 += n * on_s * centre
        sum2 += n * on_s * (centre**2 + (period_s**2 * (n * n - 1) + on_s**2) / 12)
    if lit <= 0:
        return 0.0, middle, 0.0
    mean = sum1 / lit
    return lit, middle + mean, sqrt(max(sum2 / lit - mean**2, 0.0))
