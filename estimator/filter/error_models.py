"""Error models of the gyro, of the star tracker, and of jumps. A standard deviation of 0 removes its state."""

import math
from dataclasses import fields

import numpy as np

from estimator.core import checks
from estimator.core.checks import frozen


@frozen
class GyroModel:
    """Error model of a gyro, the same for each axis: measured rate = (I + M) rate + bias + white noise.

    M (Crassidis & Junkins, Optimal Estimation of Dynamic Systems, 7.2; Markley & Crassidis, Fundamentals of Spacecraft
    Attitude Determination and Control, 4.7) has the scale factors in its diagonal and the misalignments of the three
    sense axes elsewhere, all constant. A common rotation of the axes is among the misalignments.

    Farrenkopf's random walk of the bias with density u (rad / s^1.5) is the limit of a long time t with
    bias_rad_s = u sqrt(t / 2).

    Attributes
    ----------
    arw_rad_sqrt_s
        Angle random walk, rad / sqrt(s)
    bias_rad_s
        Standard deviation of the bias, a first-order Gauss-Markov process (ignored if
        bias_time_s is inf)
    bias_time_s
        Correlation time of the bias, long compared with a sample interval; inf for a constant bias
    scale, misalignment_rad
        Standard deviations of M's elements on the diagonal and off it
    limit_rad_s
        The largest rate about an axis that the gyro measures; inf if saturation is flagged with
        the samples
    outage_rad_s
        Standard deviation of the rate about each axis while the gyro gives no samples
        (`assumed`)

    Raises
    ------
    ValueError
        For negative or unusable numbers.
    """

    arw_rad_sqrt_s: float
    bias_rad_s: float
    bias_time_s: float
    scale: float = 0.0
    misalignment_rad: float = 0.0
    limit_rad_s: float = math.inf
    outage_rad_s: float = 0.1

    def __post_init__(self) -> None:
        _check(self, "gyro", above_0=("bias_time_s", "limit_rad_s"))


@frozen
class TrackerModel:
    """Errors that successive solutions of a star tracker share: they do not average out.

    The slow error is a first-order Gauss-Markov process with the correlation exp(-T / time - rotation / angle). The
    covariance that comes with a solution (`Attitude.systematic_rad2`) is part of the same process, and is added to
    systematic_rad^2. The times and angles are `assumed`.

    Attributes
    ----------
    systematic_rad
        Standard deviation about each axis of the slow error (distortion across the field, a
        survey)
    systematic_time_s
        Correlation time of the slow error; inf for a constant
    systematic_angle_rad
        Rotation in which its correlation falls by a factor e, because other stars are in the field
    mounting_rad
        Standard deviation about each axis of the rotation from assumed to true mounting
    mounting_drift_rad_sqrt_s
        Random walk of the mounting about each axis, rad / sqrt(s); 0 for a constant one

    Raises
    ------
    ValueError
        For negative or unusable numbers.
    """

    systematic_rad: float = 0.0
    systematic_time_s: float = 3600.0
    systematic_angle_rad: float = 0.2
    mounting_rad: float = 0.0
    mounting_drift_rad_sqrt_s: float = 0.0

    def __post_init__(self) -> None:
        _check(self, "tracker", above_0=("systematic_time_s", "systematic_angle_rad"))
        if self.mounting_drift_rad_sqrt_s and not self.mounting_rad:
            raise ValueError("tracker: mounting_drift_rad_sqrt_s needs mounting_rad above 0")


@frozen
class JumpModel:
    """Probabilities of wrong solutions and of motions that a gyro misses, for `consistency.log_odds`; all `assumed`.

    Attributes
    ----------
    missed_per_s
        Rate at which a gyro that flags nothing misses a motion, 1e-4 an hour
    wrong_share
        Probability that any given solution is the first of a series of wrong ones
    wrong_repeat
        Probability that the next solution is wrong too and agrees with a wrong one
    wrong_start
        Probability that the initial attitude is wrong beyond its standard deviation

    Raises
    ------
    ValueError
        Unless all are above 0 and below 1.
    """

    missed_per_s: float = 1e-4 / 3600
    wrong_share: float = 1e-4
    wrong_repeat: float = 0.75
    wrong_start: float = 0.01

    def __post_init__(self) -> None:
        for field in fields(self):
            if not 0 < getattr(self, field.name) < 1:
                raise ValueError(
                    f"jumps: {field.name} is {getattr(self, field.name)}; allowed: above 0, below 1"
                )


def _check(model: GyroModel | TrackerModel, what: str, above_0: tuple[str, ...]) -> None:
    """Raise ValueError unless the named fields are above 0 (inf too) and the others finite and 0 or more."""
    for field in fields(model):
        value = getattr(model, field.name)
        checks.of_type(f"{what}: {field.name}", value, float, int, np.floating, np.integer)
        if field.name in above_0 and not value > 0:
            raise ValueError(f"{what}: {field.name} is {value}; allowed: above 0, also inf")
        if field.name not in above_0 and not 0 <= value < math.inf:
            raise ValueError(f"{what}: {field.name} is {value}; allowed: finite, 0 or more")
