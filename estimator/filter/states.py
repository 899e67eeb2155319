"""States of the attitude filter: which there are, in which order, and their estimate at one time."""

from __future__ import annotations

import math
from dataclasses import dataclass, fields
import numpy as np
from estimator.core import checks
from typing import NamedTuple
from numpy.typing import ArrayLike
from scipy.spatial.transform import Rotation
from estimator.core.checks import (Floats, Ints)
from estimator.filter.propagate import advance, inverse_response





# Error models of the attitude filter: of the gyro, of the star tracker, and of jumps.


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


DIAGONAL = np.arange(0, 9, 4)
OFF_DIAGONAL = np.array([1, 2, 3, 5, 6, 7])


class Layout(NamedTuple):
    """Order of the error states: attitude (3), bias (3), then those in use, then the slow error (3) of each head.

    The slow error is normalized: its standard deviation is 1, and each solution has the matrix that makes it an angle.
    Heads are the star cameras on the body. The states of head n above 0 have its number in their name: "mounting_1",
    which is relative to the mounting of the first head.

    size      : N
    slices    : of each state by name, "attitude" and "systematic" included
    slow      : that of the slow errors of all heads
    mountings : (M,) index of each state of a mounting
    columns   : (9,) state of each element of the gyro's matrix M, row by row; -1 if it is none
    estimated : (N,) whether its value is estimated; False if it is only considered
    """

    size: int
    slices: dict[str, slice]
    slow: slice
    mountings: Ints
    columns: Ints
    estimated: Floats

    @property
    def reported(self) -> dict[str, slice]:
        """The slices without the normalized slow error, whose effect is in the covariance of the attitude."""
        return {
            name: rows for name, rows in self.slices.items() if not name.startswith("systematic")
        }


class State(NamedTuple):
    """State of the filter at one time.

    values         : (N,) estimates in the order of Layout; those of the attitude are 0
    covariance     : (N, N) of the errors
    saturation_rad : standard deviation of the attitude from the saturation or outage that now lasts, else 0
    lost_rad       : rotation that the gyro may have missed since the last solution that was used
    used_s, used_wxyz : time and attitude of the last solution that was used, or of the start
    support        : number of solutions used in agreement, see Jump
    """

    t_s: float
    ref_from_body_wxyz: Floats
    values: Floats
    covariance: Floats
    saturation_rad: float
    lost_rad: float
    used_s: float
    used_wxyz: Floats
    support: int

    @property
    def body_from_ref(self) -> Rotation:
        return Rotation.from_quat(self.ref_from_body_wxyz, scalar_first=True).inv()


def of_head(name: str, head: int) -> str:
    """The name of a head's state."""
    return f"{name}_{head}" if head else name


def build_layout(
    gyro: GyroModel, tracker: TrackerModel, considered: tuple[str, ...], heads: int = 1
) -> Layout:
    """The states in use. Raises ValueError for a considered one that there is not."""
    unknown = sorted(set(considered) - set(STATES))
    if unknown:
        raise ValueError(f"considered: {unknown[0]!r}; allowed: {', '.join(STATES)}")
    counts = {
        "attitude": 3,
        "bias": 3,
        "scale": 3 * (gyro.scale > 0),
        "misalignment": 6 * (gyro.misalignment_rad > 0),
        **{of_head("mounting", head): 3 * (tracker.mounting_rad > 0) for head in range(heads)},
        **{of_head("systematic", head): 3 for head in range(heads)},
    }
    # The mount of the first head defines the attitude of the body, so the others can be estimated beside it.
    fixed = {
        of_head(name, head)
        for name in considered
        for head in range(heads if name == "systematic" else 1)
    }
    slices = {}
    size = 0
    estimated = []
    for name, count in counts.items():
        if count:
            slices[name] = slice(size, size + count)
            size += count
            estimated += [float(name not in fixed)] * count
    columns = np.full(9, -1)
    for name, elements in (("scale", DIAGONAL), ("misalignment", OFF_DIAGONAL)):
        if name in slices:
            columns[elements] = np.arange(slices[name].start, slices[name].stop)
    slow = slice(slices["systematic"].start, size)
    mounts = [rows for name, rows in slices.items() if name.startswith("mounting")]
    mountings = [row for rows in mounts for row in range(rows.start, rows.stop)]
    return Layout(size, slices, slow, np.array(mountings, dtype=int), columns, np.array(estimated))


def start_state(t_s: float, wxyz: Floats, sigmas: dict[str, ArrayLike], layout: Layout) -> State:
    """The state at the start: all values 0, all states independent with these standard deviations."""
    sigma = np.empty(layout.size)
    for name, rows in layout.slices.items():
        sigma[rows] = sigmas[name.partition("_")[0]]
    return State(t_s, wxyz, np.zeros(layout.size), np.diag(sigma**2), 0.0, 0.0, t_s, wxyz, 0)


def propagate_state(
    state: State, samples: Floats, gyro: GyroModel, tracker: TrackerModel, layout: Layout
) -> State:
    """Propagate a state through gyro samples, rows as of `advance`."""
    if not len(samples):
        return state
    noise = (
        gyro.arw_rad_sqrt_s**2,
        gyro.bias_rad_s**2,
        1 / gyro.bias_time_s,
        1 / tracker.systematic_time_s,
        gyro.outage_rad_s,
    )
    slow = layout.slow
    inverse = inverse_response(state.values, layout.columns)
    wxyz, values, covariance, saturation_rad, lost_rad = advance(
        tuple(state[:6]), samples, noise, layout.columns, inverse, (slow.start, slow.stop)
    )
    # Nothing else depends on a mounting between two solutions, so its random walk can be added at the end.
    walked_rad2 = tracker.mounting_drift_rad_sqrt_s**2 * (float(samples[-1, 0]) - state.t_s)
    covariance[layout.mountings, layout.mountings] += walked_rad2
    return state._replace(
        t_s=float(samples[-1, 0]),
        ref_from_body_wxyz=wxyz,
        values=values,
        covariance=covariance,
        saturation_rad=saturation_rad,
        lost_rad=lost_rad,
    )


def decorrelate(state: State, tracker: TrackerModel, layout: Layout) -> State:
    """Let the slow errors change by the rotation since the last solution that was used."""
    rows = layout.slow
    # The angle between two quaternions; the scalar product may exceed 1 by rounding.
    turned_rad = 2 * math.acos(min(abs(float(state.ref_from_body_wxyz @ state.used_wxyz)), 1.0))
    kept = math.exp(-turned_rad / tracker.systematic_angle_rad)
    factor = np.ones(layout.size)
    factor[rows] = kept
    covariance = state.covariance * np.outer(factor, factor)
    covariance[rows, rows] += (1 - kept**2) * np.eye(rows.stop - rows.start)
    return state._replace(values=state.values * factor, covariance=covariance)


