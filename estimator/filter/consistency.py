"""Checks of what the attitude filter receives, and the decision whether the filter or the solutions are wrong.

The checks cover standard deviations, gyro samples and covariances; every error message is one line. `log_odds` weighs
a jump: is the filter wrong, because the gyros missed a motion, or are the solutions that contradict it?
"""

import math
from typing import NamedTuple

import numpy as np
from numpy.typing import ArrayLike, NDArray

from estimator.core.checks import Floats
from estimator.filter.error_models import GyroModel, JumpModel
from estimator.filter.states import MISSING, SATURATED

# Share of the gyro's limit from which a sample's mean rate counts as saturated (`assumed`).
NEAR_LIMIT = 0.9


def not_negative(name: str, value: ArrayLike) -> NDArray:
    """Return standard deviations as an array. Raises ValueError unless they are one or three numbers of 0 or more."""
    array = np.asarray(value, dtype=float)
    if array.shape not in ((), (3,)) or not (array >= 0).all():
        raise ValueError(
            f"{name} is {array.tolist()}; allowed: 0 or more, one number or one for each axis"
        )
    return array


def checked_samples(
    start_s: float,
    t_s: ArrayLike,
    angle_rad: ArrayLike,
    saturated: ArrayLike,
    missing: ArrayLike | None,
    gyro: GyroModel,
) -> Floats:
    """Return the gyro samples (N, 5) of `states.advance`: end of the interval, rotation about x, y, z, and its kind.

    The kind is MEASURED, SATURATED or MISSING. A missing sample keeps the rotation that was given, and 0 for NaN.
    Arguments are those of `AttitudeFilter.propagate`.

    Raises
    ------
    ValueError
        For wrong shapes, non-finite numbers, and intervals that are not above 0 and up to a tenth
        of the bias's correlation time: the process noise is a series in the ratio of the two.
    """
    ends_s = np.asarray(t_s, float)
    angle = np.asarray(angle_rad, float)
    absent = np.zeros(ends_s.shape) if missing is None else np.asarray(missing)
    count = ends_s.size
    shapes = [ends_s.shape, angle.shape, np.shape(saturated), absent.shape]
    if not count or shapes != [(count,), (count, 3), (count,), (count,)]:
        raise ValueError(
            f"propagate: shapes {shapes}; allowed: (N,), (N, 3), (N,), (N,) with N of 1 or more"
        )
    samples = np.empty((count, 5))
    lost = absent != 0
    samples[:, 0] = ends_s
    samples[:, 1:4] = np.where(lost[:, None] & np.isnan(angle), 0.0, angle)
    if not (
        np.isfinite(samples[:, :4]).all() and np.isfinite(np.asarray(saturated, float)).all()
    ):
        raise ValueError("propagate: NaN or infinite times or angles; allowed: finite ones")
    # Lengths of the intervals
    step_s = np.diff(ends_s, prepend=start_s)
    longest_s = 0.1 * gyro.bias_time_s
    if not (step_s.min() > 0 and step_s.max() <= longest_s):
        bad = int(np.argmax(~((step_s > 0) & (step_s <= longest_s))))
        raise ValueError(
            f"propagate: the sample that ends at {ends_s[bad]} s is {step_s[bad]:g} s long; "
            f"allowed: above 0, up to {longest_s:g} s (a tenth of bias_time_s)"
        )
    # A mean rate near the limit means that the rate was at the limit for a part of the interval.
    limited = np.abs(samples[:, 1:4]).max(axis=1) >= NEAR_LIMIT * gyro.limit_rad_s * step_s
    samples[:, 4] = np.where(
        lost, MISSING, SATURATED * (limited | (np.asarray(saturated) != 0))
    )
    return samples


def checked_covariances(
    covariance_rad2: ArrayLike, systematic_rad2: ArrayLike | None
) -> tuple[Floats, Floats]:
    """Return the covariance without its systematic part, and that part, (3, 3) each, exactly symmetric.

    Raises
    ------
    ValueError
        Unless the covariance and its part without the systematic one are symmetric and positive
        definite, and the systematic one is symmetric and without negative eigenvalues.
    """
    total = np.asarray(covariance_rad2, dtype=float)
    if not is_covariance(total):
        raise ValueError(
            f"update: covariance_rad2 {total.tolist()}; allowed: (3, 3), symmetric, positive definite"
        )
    if systematic_rad2 is None:
        return (total + total.T) / 2, np.zeros((3, 3))
    systematic = np.asarray(systematic_rad2, dtype=float)
    if not (is_covariance(systematic, singular=True) and is_covariance(total - systematic)):
        raise ValueError(
            f"update: systematic_rad2 {systematic.tolist()}; "
            "allowed: (3, 3), symmetric, not negative, less than covariance_rad2"
        )
    noise = total - systematic
    return (noise + noise.T) / 2, (systematic + systematic.T) / 2


def is_covariance(matrix: NDArray, singular: bool = False) -> bool:
    """Return whether a matrix is (3, 3), finite, symmetric and positive definite.

    `singular` also accepts eigenvalues of 0, to rounding.
    """
    if matrix.shape != (3, 3) or not np.isfinite(matrix).all():
        return False
    tolerance = 1e-9 * max(np.trace(matrix), 0.0)
    if np.abs(matrix - matrix.T).max() > tolerance:
        return False
    least = np.linalg.eigvalsh(matrix)[0]
    return bool(least > 0 or (singular and least >= -tolerance))


# The evidence of a jump: is the filter wrong, or are the solutions that contradict it?

# Least number of consecutive refused solutions that must agree before the filter is reset to them.
CONFIRMATIONS = 3
# Least natural-log odds that the filter is wrong at which it is reset: 100 to 1 (`assumed`).
ENOUGH = math.log(100.0)
# Distance by which the probability of an error of the filter's own models decreases by a factor e (`assumed`).
MODEL_DISTANCE = 5.0
# Least change of the rate that is a shock, as a multiple of the gyro's noise in an interval (`assumed`). That noise
# alone gives sqrt(6).
SHOCK_SIGMA = 20.0


class Jump(NamedTuple):
    """Refused solutions that agree with each other, and the evidence for the filter.

    Attributes
    ----------
    angle_rad
        Rotation from the filter's attitude to the last of these solutions
    distance
        Mahalanobis distance of that rotation
    agreeing
        Number k of these solutions, 1 or more
    since_s
        Time T since the last solution that was used
    lost_rad
        Rotation since then that the gyro may have missed: the sum of the attitude's standard
        deviations due to saturation and outages, and `shock_rad`
    support
        Number of solutions used since the attitude depends on solutions alone; 0 if the attitude
        is the initial one
    """

    angle_rad: float
    distance: float
    agreeing: int
    since_s: float
    lost_rad: float
    support: int


def log_odds(jump: Jump, model: JumpModel) -> float:
    """Return the natural-log odds that the filter's attitude is wrong, and not the k solutions that contradict it.

    The probabilities of the two explanations are, with the names of JumpModel:

        solutions wrong:  wrong_share wrong_repeat^(k-1)
        filter wrong:     missed_per_s T + lost / (lost + angle) + exp(-distance / 5)
                          + wrong_share wrong_repeat^(support-1), or wrong_start for the initial attitude.

    The terms of the second are:

    1. missed_per_s T: a gyro missed a motion and flagged nothing.
    2. lost / (lost + angle): at a saturation, an outage or a shock, a gyro missed about `lost`, and with a heavy tail
       more.
    3. exp(-distance / 5): the filter's own models are wrong, by several standard deviations but not hundreds.
    4. The filter's attitude comes from wrong solutions, or the initial attitude is wrong.

    Agreement alone is little evidence, because a wrong identification repeats itself while the view is the same.

    With the defaults, a jump of many sigma with a quiet gyro is adopted after some 35 solutions in 35 s; one during a
    saturation after CONFIRMATIONS; and an attitude that comes from one wrong solution is given up after 18 right ones.
    """
    wrong = math.log(model.wrong_share)
    repeat = math.log(model.wrong_repeat)
    # 1. Missed in silence
    silent = model.missed_per_s * jump.since_s
    # 2. Missed at a flagged event; without one, 0 / 0 would be no jump at all.
    missed = jump.lost_rad / (jump.lost_rad + jump.angle_rad) if jump.lost_rad > 0 else 0.0
    # 3. Wrong models
    own = math.exp(-jump.distance / MODEL_DISTANCE)
    # 4. Wrong solutions, or a wrong start
    unsupported = model.wrong_start
    if jump.support:
        unsupported = math.exp(wrong + (jump.support - 1) * repeat)
    filter_wrong = silent + missed + own + unsupported
    # All terms underflow for a supported filter that contradicts itself at one time.
    return (
        math.log(min(max(filter_wrong, 1e-300), 1.0)) - wrong - (jump.agreeing - 1) * repeat
    )


def shock_rad(start_s: float, samples: Floats, arw_rad_sqrt_s: float) -> float:
    """Return the rotation that the gyro may have missed at the sharpest change of its rate; 0 without a shock.

    It is the second difference of the mean rates times the interval. It reveals a knock even where saturation is not
    flagged: a rotation whose rate steps within an interval, or faster than the gyro follows, is uncertain by about
    this amount. A smooth maneuver and the gyro's noise are no shocks.

    Parameters
    ----------
    start_s
        Begin of the first interval
    samples
        (N, 5) rows as of `states.advance`
    arw_rad_sqrt_s
        Angle random walk of the gyro
    """
    step_s = np.diff(samples[:, 0], prepend=start_s)
    if len(step_s) < 3:
        return 0.0
    rate_rad_s = samples[:, 1:4] / step_s[:, None]
    bend_rad_s = np.linalg.norm(np.diff(rate_rad_s, n=2, axis=0), axis=1)
    turn_rad = bend_rad_s * step_s[2:]
    noise_rad = arw_rad_sqrt_s * np.sqrt(step_s[2:])
    return float(turn_rad[turn_rad > SHOCK_SIGMA * noise_rad].max(initial=0.0))
