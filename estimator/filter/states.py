"""States of the attitude filter: their order, and their propagation by gyro samples.

Each gyro sample is a rotation vector (`advance`):

1. Remove the gyro's estimated errors: bias, scale factors, misalignments.
2. Multiply the exponential of the rotation into the quaternion.
3. Let the bias and the slow errors decay.
4. Multiply the covariance by the discrete transition of the error state, P <- F P F^T, with the right Jacobian of the
   rotation.
5. Add the process noise. While the gyro is saturated or gives no samples, the attitude's standard deviation grows
   linearly with time.

The equations are in the docstring of `mekf.AttitudeFilter`.
"""

import math
from typing import NamedTuple

import numpy as np
from numpy.typing import ArrayLike
from scipy.spatial.transform import Rotation

from estimator.core.checks import Floats, Ints
from estimator.core.jit import jit
from estimator.core.vectors import dot, norm, rotate
from estimator.filter.error_models import GyroModel, TrackerModel

# Compiled propagation by gyro samples.

# Kinds of a sample, in its last column.
MEASURED = 0
SATURATED = 1
MISSING = 2


@jit
def advance(
    state: tuple[float, Floats, Floats, Floats, float, float],
    samples: Floats,
    noise: tuple[float, float, float, float, float],
    columns: Ints,
    inverse: Floats,
    slow: tuple[int, int],
) -> tuple[Floats, Floats, Floats, float, float]:
    """Return wxyz, values, covariance, saturation_rad and lost_rad after the samples: the numbered steps of the module.

    Parameters
    ----------
    state
        The first six fields of MekfState
    samples
        (M, 5) rows of the end of an interval, the rotation in it (3), and its kind: MEASURED, SATURATED or MISSING
    noise
        arw^2, bias^2, 1 / bias_time, 1 / systematic_time, outage_rad_s
    columns, inverse, slow
        Columns of Layout, A of `inverse_response`, and the first number of the slow errors and their last + 1
    """
    t_s, wxyz, values, covariance, saturation_rad, lost_rad = state
    arw2, bias2, decay_per_s, slow_per_s, outage_rad_s = noise
    wxyz = wxyz.copy()
    values = values.copy()
    covariance = covariance.copy()
    size = len(values)
    rotation = np.empty(3)
    rows = np.zeros((3, size))
    buffer = np.empty((3, size))
    exponential = np.empty((3, 6))
    decay = np.ones(size)
    for n in range(len(samples)):
        step_s = samples[n, 0] - t_s
        t_s = samples[n, 0]
        # 1. The effective time is the integral of the decaying bias over the interval, divided by the bias.
        effective_s = step_s * (1 - step_s * decay_per_s / 2)
        remove_errors(samples[n, 1:4], effective_s, values, inverse, rotation)
        # 2. Attitude
        rotate_quaternion(wxyz, rotation)
        # Attitude rows of F, which depend on the values before they decay.
        transition(rotation, 1.0, exponential)
        fill_rows(exponential, inverse, rotation, effective_s, columns, rows)
        # 3. Decay
        decay[3:6] = math.exp(-step_s * decay_per_s)
        decay[slow[0] : slow[1]] = math.exp(-step_s * slow_per_s)
        values *= decay
        # 4. P <- F P F^T
        propagate_covariance(rows, decay, covariance, buffer)
        # 5. Process noise
        grown_rad = unknown_rad(samples[n], outage_rad_s * step_s)
        saturation_rad, missed_variance = _grow(saturation_rad, grown_rad)
        lost_rad += grown_rad
        # The variance gained by the bias in the interval, u^2 T to first order.
        bias_variance = -bias2 * math.expm1(-2 * step_s * decay_per_s)
        add_noise(covariance, arw2 * step_s + missed_variance, bias_variance, step_s)
        # The slow error is normalized: its noise is 1 - exp(-2 T / time).
        for i in range(slow[0], slow[1]):
            covariance[i, i] -= math.expm1(-2 * step_s * slow_per_s)
    return wxyz, values, covariance, saturation_rad, lost_rad


@jit
def remove_errors(
    angle: Floats, effective_s: float, values: Floats, inverse: Floats, out: Floats
) -> None:
    """Fill `out` (3,) with the rotation A (a - T b) of a measured angle a, with the effective time T and the bias b."""
    out[:] = rotate(inverse, angle - effective_s * values[3:6])


@jit
def unknown_rad(sample: Floats, outage_rad: float) -> float:
    """Return the standard deviation of the rotation that a sample leaves unknown.

    It is 0 for a measured sample, the largest measured angle for a saturated one, and `outage_rad` for a missing one.
    """
    if sample[4] == MISSING:
        return outage_rad
    return np.abs(sample[1:4]).max() if sample[4] == SATURATED else 0.0


@jit
def _grow(saturation_rad: float, grown_rad: float) -> tuple[float, float]:
    """Return the standard deviation from saturation after an interval, and the variance that it adds to the attitude.

    While the rate is unknown the standard deviation grows linearly: the variance by a difference of squares.
    """
    total_rad = saturation_rad + grown_rad if grown_rad > 0 else 0.0
    return total_rad, total_rad**2 - min(saturation_rad, total_rad) ** 2


@jit
def add_noise(
    covariance: Floats, angle_variance: float, bias_variance: float, step_s: float
) -> None:
    """Add Farrenkopf's process noise of an interval T to attitude and bias, in place.

    With the variance u^2 T that the bias gains: angle_variance + u^2 T^3 / 3 in the angle, -u^2 T^2 / 2 in the
    cross-covariance, u^2 T in the bias.
    """
    for i in range(3):
        covariance[i, i] += angle_variance + bias_variance * step_s**2 / 3
        covariance[i, i + 3] -= bias_variance * step_s / 2
        covariance[i + 3, i] -= bias_variance * step_s / 2
        covariance[i + 3, i + 3] += bias_variance


def inverse_response(values: Floats, columns: Ints) -> Floats:
    """Return A = (I + M)^-1, (3, 3), with the elements of M from the values; those that are no states are 0."""
    used = columns >= 0
    if not used.any():
        return np.eye(3)
    response = np.eye(3).ravel()
    response[used] += values[columns[used]]
    return np.asarray(np.linalg.inv(response.reshape(3, 3)), dtype=float)


@jit
def fill_rows(
    exponential: Floats,
    inverse: Floats,
    p: Floats,
    effective_s: float,
    columns: Ints,
    rows: Floats,
) -> None:
    """Fill the attitude rows (3, N) of the transition matrix F.

    From e+ = exp(-[p]) e - J A (T db + dM p) they are exp(-[p]) in the columns of the attitude, -T J A in those of the
    bias, and -(J A)_ij p_k in row i of the column of M_jk.

    Parameters
    ----------
    exponential
        (3, 6) matrix [exp(-[p]), -J] of `transition` with an effective time of 1
    inverse
        (3, 3) A = (I + M)^-1
    p
        (3,) rotation in the interval
    columns
        (9,) state number of each element of M, row by row; -1 for no state
    """
    rows[:, :3] = exponential[:, :3]
    for i in range(3):
        for j in range(3):
            # -(J A)_ij
            total = dot(exponential[i, 3:], inverse[:, j])
            rows[i, 3 + j] = effective_s * total
            for k in range(3):
                if columns[3 * j + k] >= 0:
                    rows[i, columns[3 * j + k]] = total * p[k]


@jit
def propagate_covariance(
    rows: Floats, decay: Floats, covariance: Floats, buffer: Floats
) -> None:
    """Replace P by F P F^T, exactly symmetric. F has the three attitude `rows`; below, its diagonal is `decay`."""
    size = len(decay)
    # buffer = the attitude rows of F P
    for i in range(3):
        for j in range(size):
            total = 0.0
            for k in range(size):
                total += rows[i, k] * covariance[k, j]
            buffer[i, j] = total
    # Attitude rows and columns of F P F^T
    for i in range(3):
        for j in range(i + 1):
            total = 0.0
            for k in range(size):
                total += buffer[i, k] * rows[j, k]
            covariance[i, j] = covariance[j, i] = total
        for j in range(3, size):
            covariance[i, j] = covariance[j, i] = buffer[i, j] * decay[j]
    # The other states only decay.
    for i in range(3, size):
        for j in range(3, i + 1):
            covariance[i, j] = covariance[j, i] = covariance[i, j] * decay[i] * decay[j]


@jit
def transition(p: Floats, effective_s: float, out: Floats) -> None:
    """Fill out[:3] with [exp(-[p]), -effective_s J(p)], (3, 6), where [p] v = p x v.

    exp(-[p]) = I - (sin p / p) [p] + ((1 - cos p) / p^2) [p]^2 (Rodrigues), and
    J(p) = I - ((1 - cos p) / p^2) [p] + ((p - sin p) / p^3) [p]^2.
    """
    square = dot(p, p)
    # Below 1e-6 a series, whose error in `out` is below 1e-16: the quotients would lose digits.
    if square < 1e-6:
        sine = 1 - square / 6
        cosine = 0.5 - square / 24
        cubic = 1 / 6 - square / 120
    else:
        angle = math.sqrt(square)
        sine = math.sin(angle) / angle
        cosine = (1 - math.cos(angle)) / square
        cubic = (1 - sine) / square
    for i in range(3):
        for j in range(3):
            # Element (i, j) of [p] is the component of the third axis with the sign of the permutation;
            # [p]^2 = p p^T - |p|^2 I.
            cross = 0.0 if i == j else p[3 - i - j] * (1.0 if (j - i) % 3 == 2 else -1.0)
            identity = 1.0 if i == j else 0.0
            cross_squared = p[i] * p[j] - square * identity
            out[i, j] = identity - sine * cross + cosine * cross_squared
            out[i, j + 3] = -effective_s * (identity - cosine * cross + cubic * cross_squared)


@jit
def rotate_quaternion(ref_from_body_wxyz: Floats, rotation_rad: Floats) -> None:
    """Multiply the unit quaternion by that of a rotation vector in body axes (Hamilton product), in place."""
    q = ref_from_body_wxyz
    # Quaternion (w, x, y, z) of the rotation vector: (cos(p / 2), sin(p / 2) p / |p|)
    x, y, z = rotation_rad
    half = norm(rotation_rad) / 2
    scale = math.sin(half) / (2 * half) if half > 1e-9 else 0.5
    w = math.cos(half)
    x = scale * x
    y = scale * y
    z = scale * z
    a, b, c, d = q
    q[:] = (
        a * w - b * x - c * y - d * z,
        a * x + b * w + c * z - d * y,
        a * y - b * z + c * w + d * x,
        a * z + b * y - c * x + d * w,
    )
    # Rounding would otherwise accumulate in the norm.
    q /= math.sqrt(np.sum(q**2))


# CONSIDERED are the states whose uncertainty counts but whose value is not estimated (Schmidt's filter), unless
# AttitudeFilter gets others.

STATES = ("bias", "scale", "misalignment", "mounting", "systematic")
CONSIDERED = ("mounting", "systematic")


# Order of the states, and their estimate at one time.

# Elements of the gyro's matrix M, row by row.
DIAGONAL = np.arange(0, 9, 4)
OFF_DIAGONAL = np.array([1, 2, 3, 5, 6, 7])


class Layout(NamedTuple):
    """Order of the error states: attitude (3), bias (3), then those in use, then the slow error (3) of each head.

    The slow error is normalized: its standard deviation is 1, and each solution has the matrix that maps it to an
    angle. Heads are the star cameras on the body, numbered from 0. The states of further heads have the head's number
    in their name: "mounting_1" is the mounting of head 1 relative to that of head 0.

    Attributes
    ----------
    size
        Number N of states
    slices
        Slice of each state by name, "attitude" and "systematic" included
    slow
        Slice of the slow errors of all heads
    mountings
        (M,) number of each state of a mounting
    columns
        (9,) state number of each element of the gyro's matrix M, row by row; -1 for no state
    estimated
        (N,) 1 if the state's value is estimated, 0 if the state is only considered
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
            name: rows
            for name, rows in self.slices.items()
            if not name.startswith("systematic")
        }


class MekfState(NamedTuple):
    """State of the filter at one time.

    Attributes
    ----------
    t_s
        Time
    ref_from_body_wxyz
        (4,) attitude as a unit quaternion, scalar first
    values
        (N,) estimates in the order of Layout; those of the attitude error are 0
    covariance
        (N, N) covariance of the errors
    saturation_rad
        Standard deviation of the attitude from the current saturation or outage; 0 without one
    lost_rad
        Rotation that the gyro may have missed since the last solution that was used
    used_s, used_wxyz
        Time and attitude of the last solution that was used, or of the start
    support
        Number of solutions used in agreement: see `consistency.Jump`
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
    """Return the name of a head's state: "mounting" of the first head, "mounting_1" of the second."""
    return f"{name}_{head}" if head else name


def build_layout(
    gyro: GyroModel, tracker: TrackerModel, considered: tuple[str, ...], heads: int = 1
) -> Layout:
    """Return the layout of the states in use. Raises ValueError for an unknown name among the considered ones."""
    unknown = sorted(set(considered) - set(STATES))
    if unknown:
        raise ValueError(f"considered: {unknown[0]!r}; allowed: {', '.join(STATES)}")
    counts = {
        "attitude": 3,
        "bias": 3,
        "scale": 3 * (gyro.scale > 0),
        "misalignment": 6 * (gyro.misalignment_rad > 0),
        **{
            of_head("mounting", head): 3 * (tracker.mounting_rad > 0) for head in range(heads)
        },
        **{of_head("systematic", head): 3 for head in range(heads)},
    }
    # "systematic" means the slow errors of all heads; "mounting" only that of the first head, which defines the
    # attitude of the body, so that the others can be estimated relative to it.
    fixed = set(considered)
    if "systematic" in fixed:
        fixed |= {of_head("systematic", head) for head in range(heads)}
    # Number the states in this order.
    slices = {}
    size = 0
    estimated = []
    for name, count in counts.items():
        if count:
            slices[name] = slice(size, size + count)
            size += count
            estimated += [float(name not in fixed)] * count
    # State of each element of M
    columns = np.full(9, -1)
    for name, elements in (("scale", DIAGONAL), ("misalignment", OFF_DIAGONAL)):
        if name in slices:
            columns[elements] = np.arange(slices[name].start, slices[name].stop)
    # The slow errors are the last states; the mountings of all heads are side by side.
    slow = slice(slices["systematic"].start, size)
    mounts = [rows for name, rows in slices.items() if name.startswith("mounting")]
    mountings = [row for rows in mounts for row in range(rows.start, rows.stop)]
    return Layout(
        size, slices, slow, np.array(mountings, dtype=int), columns, np.array(estimated)
    )


def start_state(
    t_s: float, wxyz: Floats, sigmas: dict[str, ArrayLike], layout: Layout
) -> MekfState:
    """Return the initial state: all values 0, all states independent, with the given standard deviations by name."""
    sigma = np.empty(layout.size)
    for name, rows in layout.slices.items():
        sigma[rows] = sigmas[name.partition("_")[0]]
    return MekfState(
        t_s, wxyz, np.zeros(layout.size), np.diag(sigma**2), 0.0, 0.0, t_s, wxyz, 0
    )


def propagate_state(
    state: MekfState, samples: Floats, gyro: GyroModel, tracker: TrackerModel, layout: Layout
) -> MekfState:
    """Return the state after gyro samples, rows as of `advance`."""
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
    # No other state depends on a mounting between two solutions, so its random walk can be added at the end.
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


def decorrelate(state: MekfState, tracker: TrackerModel, layout: Layout) -> MekfState:
    """Return the state with the slow errors changed by the rotation since the last solution that was used.

    They keep the share k = exp(-rotation / systematic_angle_rad): values and covariances are multiplied by k, and their
    variance gains 1 - k^2.
    """
    rows = layout.slow
    # The angle between two quaternions; the scalar product may exceed 1 by rounding.
    turned_rad = 2 * math.acos(
        min(abs(float(state.ref_from_body_wxyz @ state.used_wxyz)), 1.0)
    )
    kept = math.exp(-turned_rad / tracker.systematic_angle_rad)
    # P <- D P D with D = k for the slow errors and 1 for the others
    factor = np.ones(layout.size)
    factor[rows] = kept
    covariance = state.covariance * np.outer(factor, factor)
    covariance[rows, rows] += (1 - kept**2) * np.eye(rows.stop - rows.start)
    return state._replace(values=state.values * factor, covariance=covariance)
