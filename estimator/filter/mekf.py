"""Multiplicative extended Kalman filter (MEKF): attitude and gyro bias from gyro and star tracker.

The attitude is a unit quaternion, its error a three-component rotation vector in body axes. Gyro samples propagate the
attitude, the bias and their covariance (`propagate`); a star tracker's solution corrects them (`update`). After each
correction the estimated error is multiplied into the quaternion and reset to zero, so the quaternion keeps its unit
norm and the covariance (6, 6) is not singular. The equations are in the docstring of AttitudeFilter.

Solutions arrive late. The filter therefore keeps its recent history: the states after the solutions used, and the gyro
samples since. A late solution is applied to the state at its own time, and the later samples and solutions are applied
again.

Sources: Farrenkopf 1978 (J. Guidance & Control 1, 282) for the gyro's noise; Lefferts, Markley & Shuster 1982 (J.
Guidance 5, 417) for the six-state filter; Crassidis & Junkins, Optimal Estimation of Dynamic Systems, chapter 7, for
its discrete transition.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy.linalg import block_diag
from scipy.spatial.transform import Rotation
from scipy.special import chdtrc, chdtri

from estimator.core import checks
from estimator.core.arrays import Floats
from estimator.core.errors import ImageError
from estimator.core.types import FilterState
from estimator.filter.propagate import advance, rotate_quaternion, transition

USED = "used"
RESET = "reset"
OUTSIDE_GATE = "refused: outside the gate"
TOO_OLD = "refused: older than the filter remembers"

# Duration of the history of samples and solutions; at least half of it is kept. `assumed`: some frames.
HISTORY_S = 10.0
# Number of consecutive refused solutions that must agree before the filter is reset to them.
CONFIRMATIONS = 3
# A solution's time may be ahead of the last gyro sample by this much, for rounding.
ROUNDING_S = 1e-9


@dataclass(frozen=True, slots=True)
class GyroModel:
    """Error model of a gyro, the same for each axis: measured rate = rate + bias + white noise.

    arw_rad_sqrt_s : angle random walk, rad / sqrt(s)
    bias_rad_s     : standard deviation of the bias, a first-order Gauss-Markov process (ignored if its time is inf)
    bias_time_s    : its correlation time, long compared with a sample interval; inf for a constant bias

    Farrenkopf's random walk of the bias with density u (rad / s^1.5) is the limit of a long time t with
    bias_rad_s = u sqrt(t / 2). Raises ValueError for negative or unusable numbers.
    """

    arw_rad_sqrt_s: float
    bias_rad_s: float
    bias_time_s: float

    def __post_init__(self) -> None:
        for name in ("arw_rad_sqrt_s", "bias_rad_s", "bias_time_s"):
            checks.of_type(f"gyro: {name}", getattr(self, name), float, int, np.floating, np.integer)
        for name in ("arw_rad_sqrt_s", "bias_rad_s"):
            if not 0 <= getattr(self, name) < math.inf:
                raise ValueError(f"gyro: {name} is {getattr(self, name)}; allowed: finite, 0 or more")
        if not self.bias_time_s > 0:
            raise ValueError(f"gyro: bias_time_s is {self.bias_time_s}; allowed: above 0, inf for a constant")


@dataclass(frozen=True, slots=True)
class Update:
    """Result of an update with a star tracker's solution.

    status       : "used", "reset" (the filter was lost and adopted the solution), or "refused: why"
    residual_rad : (3,) rotation vector in body axes from the filter's attitude to the solution's
    distance     : Mahalanobis distance of the residual, the root of a chi-square with 3 degrees of freedom
    Both are NaN for a solution that is too old.
    """

    status: str
    residual_rad: Floats
    distance: float


class _State(NamedTuple):
    """State of the filter at one time; `saturation_rad` is the attitude uncertainty from the current saturation."""

    t_s: float
    ref_from_body_wxyz: Floats
    bias_rad_s: Floats
    covariance: Floats
    saturation_rad: float

    @property
    def body_from_ref(self) -> Rotation:
        return Rotation.from_quat(self.ref_from_body_wxyz, scalar_first=True).inv()


class _Solution(NamedTuple):
    """A star tracker's solution, at the time of a _State."""

    body_from_ref: Rotation
    covariance_rad2: Floats
    systematic_rad2: Floats


class _Segment(NamedTuple):
    """History from one used solution to the next: the state after it, the gyro samples since, and the solution.

    The solution of the oldest segment is not applied again, and is None if it begins between two solutions.
    """

    state: _State
    samples: Floats
    solution: _Solution | None


class AttitudeFilter:
    """Attitude filter of a star tracker: the attitude as a quaternion, its error e as a small rotation in body axes.

    With ref_from_body = estimate exp(e), a gyro sample of rotation p (with the bias subtracted) in the interval T gives

        e+ = exp(-[p]) e - T J(p) db - noise,      db+ = exp(-T / bias_time) db + noise,
        J(p) = 1 - (1 - cos p) / p^2 [p] + (p - sin p) / p^3 [p]^2,

    and Farrenkopf's process noise with v = arw, u^2 = 2 bias^2 / bias_time: v^2 T + u^2 T^3 / 3 in the angle,
    -u^2 T^2 / 2 in the cross-covariance, u^2 T in the bias. Each sample is propagated separately (1 us each,
    compiled), so the result does not depend on how the samples are divided among calls.

    gyro               : error model of the gyro
    t_s, body_from_ref : initial time and attitude; the initial bias is 0
    sigma_attitude_rad, sigma_bias_rad_s : standard deviations at the start, one number or (3,) in body axes
    floor_rad          : added in quadrature to every solution's covariance, for errors common to its stars
    gate_sigma         : a solution is refused if its distance is less probable than so many sigma of a scalar Gaussian

    Systematic errors. An error that all solutions share (of a survey, of a lever arm) does not average out: the
    filter's attitude tends to it. Its covariance S is part of a solution's covariance, as if it were noise, so that
    solutions of other stars pass the gate; and the S of the last solution is added to the covariance that `state`
    reports. For many solutions of one attitude the sum tends to S, for a single one it is up to twice S.

    Saturation. While the gyro is at its rate limit, the true rate can be anything above it. The rate error is assumed
    constant throughout the saturation, with a standard deviation on each axis as large as the measured rate
    (`assumed`). The standard deviation of the attitude then grows linearly with time, as |measured rate| t, and a
    shock of six times the limit is still within the default gate. The uncertainty grows about all axes, because a
    rotation missed about one axis misdirects the rotations about the others. Only the attitude's covariance grows,
    so that a large residual is attributed to the missed rotation and not to the bias.

    Order. Solutions may come at any rate, late, in any order, or not at all. Each is used at its own time, and
    solutions for later times that were already used are applied again after it, so the result is that of the correct
    order.

    Gate. A wrong solution is worse than none, so an improbable one is refused and changes nothing. But a filter whose
    own state is wrong would refuse correct solutions forever. So if three consecutive refused solutions agree with each
    other (each propagated to the next by the gyro, within the gate of their own covariances and the gyro's), the filter
    adopts the last of them with its covariance. The bias is kept, but its variance is increased by the initial
    variance, as a wrong bias may have been the cause. False solutions agree repeatedly only if the tracker makes the
    same error each time.
    """

    def __init__(
        self,
        gyro: GyroModel,
        t_s: float,
        body_from_ref: Rotation,
        sigma_attitude_rad: ArrayLike,
        sigma_bias_rad_s: ArrayLike,
        floor_rad: float = 0.0,
        gate_sigma: float = 5.0,
    ) -> None:
        checks.of_type("filter: gyro", gyro, GyroModel)
        checks.one_rotation("filter: body_from_ref", body_from_ref)
        t_s = checks.number("filter: t_s", t_s, -1e300, 1e300, "a finite time in seconds")
        self._gyro = gyro
        self._floor_rad2 = _not_negative("floor_rad", floor_rad) ** 2
        # The chi-square of 3 degrees of freedom with the tail probability of gate_sigma for a scalar Gaussian.
        self._gate = float(chdtri(3, chdtrc(1, _not_negative("gate_sigma", gate_sigma) ** 2)))
        sigma_attitude = _not_negative("sigma_attitude_rad", sigma_attitude_rad) * np.ones(3)
        self._initial_bias_variance = (_not_negative("sigma_bias_rad_s", sigma_bias_rad_s) * np.ones(3)) ** 2
        covariance = np.diag(np.concatenate([sigma_attitude**2, self._initial_bias_variance]))
        self._current = _State(float(t_s), _ref_from_body_wxyz(body_from_ref), np.zeros(3), covariance, 0.0)
        self._segments = [_Segment(self._current, np.empty((0, 5)), None)]  # rows of _checked_samples
        self._refused: list[tuple[_State, _Solution]] = []  # in a row, each agrees with the one before
        self._measured_rad_s = np.zeros(3)
        self._systematic_rad2 = np.zeros((3, 3))

    @property
    def state(self) -> FilterState:
        """Attitude, bias and their covariance after the last gyro sample, with the systematic error."""
        state, covariance = self._current, self._current.covariance.copy()
        covariance[:3, :3] += self._systematic_rad2
        return FilterState(state.t_s, state.body_from_ref, state.bias_rad_s.copy(), covariance)

    @property
    def body_from_ref(self) -> Rotation:
        return self._current.body_from_ref

    @property
    def ref_from_body_wxyz(self) -> Floats:
        """(4,) quaternion of the inverse of body_from_ref, scalar first, as stored: for callers in every tick."""
        return self._current.ref_from_body_wxyz

    @property
    def bias_rad_s(self) -> Floats:
        """(3,) estimated gyro bias in body axes."""
        return self._current.bias_rad_s.copy()

    @property
    def rate_rad_s(self) -> Floats:
        """(3,) measured rate less the bias, in body axes: the mean over the last call's samples; 0 before the first."""
        return self._measured_rad_s - self._current.bias_rad_s

    def propagate(self, t_s: ArrayLike, angle_rad: ArrayLike, saturated: ArrayLike) -> None:
        """Propagate the state by gyro samples.

        t_s       : (N,) ends of the sample intervals; the first interval begins at the filter's time
        angle_rad : (N, 3) rotation angle in each interval, about the body axes
        saturated : (N,) whether the gyro was at its rate limit

        Raises ValueError for other shapes, non-finite numbers, times that do not increase, or intervals that are too
        long.
        """
        start_s = self._current.t_s
        # At most a tenth: the process noise is a series in the ratio of sample interval to bias time.
        samples = _checked_samples(start_s, t_s, angle_rad, saturated, 0.1 * self._gyro.bias_time_s)
        self._current = self._propagate_state(self._current, samples)
        self._measured_rad_s = samples[:, 1:4].sum(axis=0) / (samples[-1, 0] - start_s)
        last = self._segments[-1]
        self._segments[-1] = last._replace(samples=np.concatenate([last.samples, samples]))
        self._trim_history(float(samples[-1, 0]) - HISTORY_S)

    def update(
        self,
        t_s: float,
        body_from_ref_measured: Rotation,
        covariance_rad2: ArrayLike,
        systematic_rad2: Floats | None = None,
    ) -> Update:
        """Apply a star tracker's solution for the current or a past time, then repropagate from there to the present.

        covariance_rad2 : (3, 3) of the small rotation error of the solution, in body axes
        systematic_rad2 : (3, 3) the part of it that is common to successive solutions; None for 0

        Raises ValueError for a covariance that is not symmetric and positive definite, or a time after the last sample.
        """
        checks.one_rotation("update: body_from_ref_measured", body_from_ref_measured)
        covariance = _checked_covariance(covariance_rad2) + self._floor_rad2 * np.eye(3)
        systematic = np.zeros((3, 3)) if systematic_rad2 is None else _checked_systematic(systematic_rad2)
        t_s = checks.number("update: t_s", t_s, -math.inf, math.inf, "a time in seconds")
        solution, now_s = _Solution(body_from_ref_measured, covariance, systematic), self._current.t_s
        if not t_s <= now_s + ROUNDING_S:
            raise ValueError(f"update: a solution at {t_s} s; allowed: up to the last gyro sample, {now_s} s")
        if t_s < self._segments[0].state.t_s:
            return Update(TOO_OLD, np.full(3, np.nan), math.nan)
        # Find the segment that contains t_s, and propagate its state to that time.
        k = next(k for k in reversed(range(len(self._segments))) if self._segments[k].state.t_s <= t_s)
        segment = self._segments[k]
        before, after = _split(segment.samples, segment.state.t_s, min(float(t_s), now_s))
        prior = self._propagate_state(segment.state, before)
        residual, noise, distance2 = _innovation(prior, solution)
        if distance2 <= self._gate:
            # Split the segment at the solution, then repeat the later solutions from the corrected state.
            status, corrected = USED, _correct(prior, residual, noise)
            self._segments[k : k + 1] = [
                segment._replace(samples=before),
                _Segment(corrected, after, solution),
            ]
            self._replay(k + 1)
        elif self._confirms_refused(prior, solution):
            status = RESET
            # Solutions used later than t_s were judged by a lost filter: only their gyro samples are kept.
            rest = np.concatenate([after, *(later.samples for later in self._segments[k + 1 :])])
            self._segments = [_Segment(self._reset_to(prior, solution), rest, None)]
        else:
            return Update(OUTSIDE_GATE, residual, math.sqrt(distance2))
        self._refused = []
        self._systematic_rad2 = (self._segments[-1].solution or solution).systematic_rad2
        self._current = self._propagate_state(self._segments[-1].state, self._segments[-1].samples)
        return Update(status, residual, math.sqrt(distance2))

    def _replay(self, k: int) -> None:
        """Apply again the solutions after segment k, from its new state; they have passed the gate already."""
        for j in range(k + 1, len(self._segments)):
            earlier, segment = self._segments[j - 1], self._segments[j]
            assert segment.solution is not None
            prior = self._propagate_state(earlier.state, earlier.samples)
            residual, noise, _ = _innovation(prior, segment.solution)
            self._segments[j] = segment._replace(state=_correct(prior, residual, noise))

    def _trim_history(self, before_s: float) -> None:
        """Delete history before a time: whole segments, and the first half of the samples of a long one."""
        while len(self._segments) > 1 and self._segments[1].state.t_s < before_s:
            del self._segments[0]
        # Half at a time, so that the cost of propagating the first state is spread over many calls.
        first = self._segments[0]
        if len(first.samples) and first.samples[0, 0] < before_s:
            half = len(first.samples) // 2
            state = self._propagate_state(first.state, first.samples[:half])
            self._segments[0] = _Segment(state, first.samples[half:], None)

    def _propagate_state(self, state: _State, samples: Floats) -> _State:
        """Propagate a state through gyro samples."""
        if not len(samples):
            return state
        noise = (self._gyro.arw_rad_sqrt_s**2, self._gyro.bias_rad_s**2, 1 / self._gyro.bias_time_s)
        return _State(float(samples[-1, 0]), *advance(tuple(state), samples, noise))

    def _confirms_refused(self, prior: _State, solution: _Solution) -> bool:
        """Whether a refused solution is the third in a row, each in agreement with the one before."""
        if self._refused:
            state, earlier = self._refused[-1]
            # From the gyro alone: no solution was used in between.
            later_from_earlier = prior.body_from_ref * state.body_from_ref.inv()
            difference = (later_from_earlier * earlier.body_from_ref * solution.body_from_ref.inv()).as_rotvec()
            # Both covariances in the later body axes, plus what the gyro's noise and bias add in the gap.
            gap_s, R = abs(prior.t_s - state.t_s), later_from_earlier.as_matrix()
            covariance = R @ earlier.covariance_rad2 @ R.T + solution.covariance_rad2
            covariance += gap_s * self._gyro.arw_rad_sqrt_s**2 * np.eye(3) + gap_s**2 * prior.covariance[3:, 3:]
            if difference @ np.linalg.solve(covariance, difference) > self._gate:
                self._refused = []
        self._refused.append((prior, solution))
        return len(self._refused) >= CONFIRMATIONS

    def _reset_to(self, prior: _State, solution: _Solution) -> _State:
        """Reset to the solution's attitude and covariance; keep the bias and add the initial variance to its own."""
        bias_covariance = prior.covariance[3:, 3:] + np.diag(self._initial_bias_variance)
        return prior._replace(
            ref_from_body_wxyz=_ref_from_body_wxyz(solution.body_from_ref),
            covariance=block_diag(solution.covariance_rad2, bias_covariance),
        )


def _innovation(prior: _State, solution: _Solution) -> tuple[Floats, Floats, float]:
    """Return the residual (3,) in body axes, its noise covariance (3, 3), and the squared Mahalanobis distance."""
    residual = (prior.body_from_ref * solution.body_from_ref.inv()).as_rotvec()
    noise = _residual_covariance(residual, solution.covariance_rad2)
    return residual, noise, float(residual @ np.linalg.solve(prior.covariance[:3, :3] + noise, residual))


def _correct(prior: _State, residual: Floats, noise: Floats) -> _State:
    """Kalman update in Joseph form; the attitude error is then multiplied into the quaternion."""
    gain = np.linalg.solve(prior.covariance[:3, :3] + noise, prior.covariance[:3]).T
    error = gain @ residual
    # Joseph form, (I - K H) P (I - K H)^T + K R K^T with H = [I 0], stays symmetric and positive.
    joseph = np.eye(6)
    joseph[:, :3] -= gain
    # Reset of the error state: exp(error) exp(e) = exp(error + change) gives e = J(error) change.
    reset_jacobian = np.eye(6)
    reset_jacobian[:3, :3] = _right_jacobian(error[:3])
    covariance = reset_jacobian @ (joseph @ prior.covariance @ joseph.T + gain @ noise @ gain.T) @ reset_jacobian.T
    wxyz, bias = prior.ref_from_body_wxyz.copy(), prior.bias_rad_s + error[3:]
    rotate_quaternion(wxyz, error[:3])
    return _State(prior.t_s, wxyz, bias, (covariance + covariance.T) / 2, prior.saturation_rad)


def _right_jacobian(rotation_rad: Floats) -> Floats:
    """Return (3, 3) J(p) of AttitudeFilter's docstring: the right Jacobian of SO(3)."""
    rows = np.empty((3, 6))
    transition(rotation_rad, -1.0, rows)
    return rows[:, 3:]


def _residual_covariance(residual: Floats, measured_rad2: Floats) -> Floats:
    """Return the (3, 3) noise covariance of the residual's rotation vector.

    The solution is truth exp(v), so truth = filter exp(residual) exp(-v), and the error of the vector is
    J(residual)^-1 v. For a small residual this is the covariance of the solution itself.
    """
    inverse = np.linalg.inv(_right_jacobian(residual))
    return inverse @ measured_rad2 @ inverse.T


def _ref_from_body_wxyz(body_from_ref: Rotation) -> Floats:
    return body_from_ref.inv().as_quat(scalar_first=True).copy()


def _not_negative(name: str, value: ArrayLike) -> NDArray:
    """Convert standard deviations to an array. Raises ValueError unless they are 0 or more, one or three."""
    array = np.asarray(value, dtype=float)
    if array.shape not in ((), (3,)) or not (array >= 0).all():
        raise ValueError(f"{name} is {array.tolist()}; allowed: 0 or more, one number or one for each axis")
    return array


def _checked_samples(
    start_s: float, t_s: ArrayLike, angle_rad: ArrayLike, saturated: ArrayLike, longest_s: float
) -> Floats:
    """Return (N, 5) gyro samples: end of the interval, rotation about x, y, z, and 1 if saturated, otherwise 0.

    Raises ValueError for wrong shapes, non-finite numbers, and intervals not above 0 and up to longest_s.
    """
    ends_s, angle = np.asarray(t_s, float), np.asarray(angle_rad, float)
    count, shapes = ends_s.size, [ends_s.shape, angle.shape, np.shape(saturated)]
    if not count or shapes != [(count,), (count, 3), (count,)]:
        raise ValueError(f"propagate: shapes {shapes}; allowed: (N,), (N, 3), (N,) with N of 1 or more")
    samples = np.empty((count, 5))
    samples[:, 0], samples[:, 1:4], samples[:, 4] = ends_s, angle, saturated
    if not np.isfinite(samples).all():
        raise ValueError("propagate: NaN or infinite times or angles; allowed: finite ones")
    step_s = np.diff(ends_s, prepend=start_s)
    if not (step_s.min() > 0 and step_s.max() <= longest_s):
        bad = int(np.argmax(~((step_s > 0) & (step_s <= longest_s))))
        raise ValueError(
            f"propagate: the sample that ends at {ends_s[bad]} s is {step_s[bad]:g} s long; "
            f"allowed: above 0, up to {longest_s:g} s (a tenth of bias_time_s)"
        )
    return samples


def _split(samples: Floats, start_s: float, t_s: float) -> tuple[Floats, Floats]:
    """Split samples at t_s into those before and after; the first interval begins at start_s.

    An interval that contains t_s is divided, assuming a constant rate in it.
    """
    k = int(np.searchsorted(samples[:, 0], t_s, side="right"))
    begin_s = samples[k - 1, 0] if k else start_s
    if k == len(samples) or begin_s == t_s:
        return samples[:k], samples[k:]
    fraction = (t_s - begin_s) / (samples[k, 0] - begin_s)
    before, after = samples[: k + 1].copy(), samples[k:].copy()
    before[-1, 0] = t_s
    before[-1, 1:4] *= fraction
    after[0, 1:4] *= 1 - fraction
    return before, after


def _checked_covariance(covariance_rad2: ArrayLike) -> Floats:
    """Return the covariance as a (3, 3) array. Raises ValueError unless it is symmetric and positive definite."""
    matrix = np.asarray(covariance_rad2, dtype=float)
    valid = matrix.shape == (3, 3) and bool(np.isfinite(matrix).all())
    if valid:
        symmetric = np.abs(matrix - matrix.T).max() <= 1e-9 * np.trace(matrix)
        valid = symmetric and np.linalg.eigvalsh(matrix)[0] > 0
    if not valid:
        raise ValueError(f"update: covariance_rad2 {matrix.tolist()}; allowed: (3, 3), symmetric, positive definite")
    return (matrix + matrix.T) / 2


def _checked_systematic(systematic_rad2: ArrayLike) -> Floats:
    """Return the covariance as a (3, 3) array. Raises ImageError unless it is symmetric and nowhere negative."""
    matrix = checks.rows("update: systematic_rad2", systematic_rad2, 3, 3)
    rounding = 1e-9 * np.abs(matrix).max()
    if np.abs(matrix - matrix.T).max() > rounding or np.linalg.eigvalsh(matrix)[0] < -rounding:
        raise ImageError(f"update: systematic_rad2 {matrix.tolist()}; allowed: (3, 3), symmetric, not negative")
    return matrix
