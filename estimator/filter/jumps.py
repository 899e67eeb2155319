"""Weigh a jump: is the filter wrong, because the gyros missed a motion, or are the solutions that contradict it?"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np

from estimator.core.arrays import Floats
from estimator.filter.models import JumpModel

# Number of consecutive refused solutions that must agree before the filter is reset to them, at least.
CONFIRMATIONS = 3
# Natural-log odds that the filter is wrong from which it is reset: 100 to 1 (`assumed`).
ENOUGH = math.log(100.0)
# Distance by which the probability of an error of the filter's own models decreases by a factor e (`assumed`).
MODEL_DISTANCE = 5.0
# A bend of the rate is a shock from this multiple of the gyro's noise in an interval; its own is sqrt(6) (`assumed`).
SHOCK_SIGMA = 20.0


class Jump(NamedTuple):
    """Refused solutions that agree with each other, and what supports the filter.

    angle_rad : rotation from the filter's attitude to the last of them
    distance  : its Mahalanobis distance
    agreeing  : their number, 1 or more
    since_s   : time since the last solution that was used
    lost_rad  : rotation since then that the gyro may have missed: the sum of the attitude's standard deviations due to
        saturation and outages, and `shock_rad`
    support   : number of solutions used since the attitude depends on solutions alone; 0: it is the initial one
    """

    angle_rad: float
    distance: float
    agreeing: int
    since_s: float
    lost_rad: float
    support: int


def log_odds(jump: Jump, model: JumpModel) -> float:
    """Natural-log odds that the filter's attitude is wrong, and not the k solutions that contradict it.

    The probabilities of the two explanations are, with the names of JumpModel:

        solutions wrong:  wrong_share wrong_repeat^(k-1)
        filter wrong:     missed_per_s T + lost / (lost + angle) + exp(-distance / 5)
                          + wrong_share wrong_repeat^(support-1), or wrong_start for the initial attitude.

    The terms of the second are: a gyro that missed a motion in silence; one with a saturation, an outage or a shock,
    where it may have missed `lost` and with a heavy tail more; an error of the filter's own models, which can be
    several standard deviations but not hundreds; solutions that the filter used and that were wrong. Agreement alone
    is little evidence, because a wrong identification repeats itself while the view is the same.

    With the defaults, a jump of many sigma with a quiet gyro is adopted after some 35 solutions in 35 s; one during a
    saturation after CONFIRMATIONS; and an attitude that rests on one wrong solution is given up after 18 right ones.
    """
    wrong = math.log(model.wrong_share)
    repeat = math.log(model.wrong_repeat)
    # 0 / 0 is no jump at all.
    missed = jump.lost_rad / (jump.lost_rad + jump.angle_rad) if jump.lost_rad > 0 else 0.0
    unsupported = (
        math.exp(wrong + (jump.support - 1) * repeat) if jump.support else model.wrong_start
    )
    own = math.exp(-jump.distance / MODEL_DISTANCE)
    filter_wrong = model.missed_per_s * jump.since_s + missed + own + unsupported
    # All of them underflow for a supported filter that contradicts itself at one time.
    return math.log(min(max(filter_wrong, 1e-300), 1.0)) - wrong - (jump.agreeing - 1) * repeat


def shock_rad(start_s: float, samples: Floats, arw_rad_sqrt_s: float) -> float:
    """Rotation that the gyro may have missed at the sharpest bend of its rate: second difference times interval.

    A knock shows so even where its saturation is not flagged: a rate that steps within an interval, or faster than the
    gyro follows, is known to about this. A smooth maneuver and the gyro's noise are no shocks.

    start_s : begin of the first interval;  samples : (N, 5) rows as of `propagate.advance`
    """
    step_s = np.diff(samples[:, 0], prepend=start_s)
    if len(step_s) < 3:
        return 0.0
    bend_rad_s = np.linalg.norm(np.diff(samples[:, 1:4] / step_s[:, None], n=2, axis=0), axis=1)
    turn_rad = bend_rad_s * step_s[2:]
    noise_rad = arw_rad_sqrt_s * np.sqrt(step_s[2:])
    return float(turn_rad[turn_rad > SHOCK_SIGMA * noise_rad].max(initial=0.0))
