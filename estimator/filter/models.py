"""Error models of the attitude filter: of the gyro, of the star tracker, and of jumps.

A standard deviation of 0 removes its state from the filter. `CONSIDERED` are the states whose uncertainty counts but
whose value is not estimated (Schmidt's filter), unless AttitudeFilter is given others.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, fields

import numpy as np

from estimator.core import checks

STATES = ("bias", "scale", "misalignment", "mounting", "systematic")
CONSIDERED = ("mounting", "systematic")


@dataclass(frozen=True, slots=True)
class GyroModel:
    """Error model of a gyro, the same for each axis: measured rate = (I + M) rate + bias + white noise.

    M (Crassidis & Junkins, Optimal Estimation of Dynamic Systems, 7.2; Markley & Crassidis, Fundamentals of Spacecraft
    Attitude Determination and Control, 4.7) has the scale factors in its diagonal and the misalignments of the three
    sense axes elsewhere, all constant. A common rotation of the axes is among the misalignments.

    arw_rad_sqrt_s : angle random walk, rad / sqrt(s)
    bias_rad_s     : standard deviation of the bias, a first-order Gauss-Markov process (ignored if its time is inf)
    bias_time_s    : its correlation time, long compared with a sample interval; inf for a constant bias
    scale, misalignment_rad : standard deviations of M's elements on the diagonal and off it
    limit_rad_s    : the largest rate about an axis that is measured; inf if saturation is flagged with the samples
    outage_rad_s   : standard deviation of the rate about each axis while the gyro gives no samples (`assumed`)

    Farrenkopf's random walk of the bias with density u (rad / s^1.5) is the limit of a long time t with
    bias_rad_s = u sqrt(t / 2). Raises ValueError for negative or unusable numbers.
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


@dataclass(frozen=True, slots=True)
class TrackerModel:
    """Errors that successive solutions of a star tracker share: they do not average out.

    systematic_rad       : standard deviation about each axis of the slow error: distortion across the field, a survey
    systematic_time_s    : its correlation time; inf for a constant
    systematic_angle_rad : rotation after which it is another one, because other stars are in the field
    mounting_rad         : standard deviation about each axis of the rotation from assumed to true mount
    mounting_drift_rad_sqrt_s : its random walk about each axis, rad / sqrt(s); 0 for a constant one

    The slow error is a first-order Gauss-Markov process with the correlation exp(-T / time - rotation / angle). The
    covariance that a solution names (`Attitude.systematic_rad2`) is part of the same process, and is added to
    systematic_rad^2. The times and angles are `assumed`. Raises ValueError for negative or unusable numbers.
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


@dataclass(frozen=True, slots=True)
class JumpModel:
    """What is assumed of wrong solutions and of motions that a gyro misses; all `assumed`. See `jumps.log_odds`.

    missed_per_s : rate at which a gyro that flags nothing misses a motion, 1e-4 an hour
    wrong_share  : probability that a wrong solution begins at any given one
    wrong_repeat : probability that a wrong solution is followed by one that agrees with it
    wrong_start  : probability that the initial attitude is wrong beyond its standard deviation

    Raises ValueError unless all are above 0 and below 1.
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
