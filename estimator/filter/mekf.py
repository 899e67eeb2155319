"""Multiplicative extended Kalman filter (MEKF): attitude and gyro errors from gyro and star tracker.

The attitude is a unit quaternion, its error a three-component rotation vector in body axes. Gyro samples propagate the
attitude, the other states and their covariance (`propagate`); a star tracker's solution corrects them (`update`).
After each correction the estimated error is multiplied into the quaternion and reset to zero, so the quaternion keeps
its unit norm and the covariance is not singular. The equations are in the docstring of AttitudeFilter.

Solutions arrive late. The filter therefore keeps its recent history: the states after the solutions used, and the gyro
samples since. A late solution is applied to the state at its own time, and the later samples and solutions are applied
again. One update (`AttitudeFilter.update`) is:

1. Find the state before the solution's time, and propagate it to that time.
2. Compute the innovation: residual and Mahalanobis distance.
3. Inside the gate: correct the state by Schmidt's update.
4. Outside the gate: refuse the solution, unless it and earlier refused ones agree and the odds are that the filter is
   wrong; then adopt it.
5. Repeat the later solutions, and propagate the last state to the present.

Sources: Farrenkopf 1978 (J. Guidance & Control 1, 282) for the gyro's noise; Lefferts, Markley & Shuster 1982 (J.
Guidance 5, 417) for the six-state filter; Crassidis & Junkins, Optimal Estimation of Dynamic Systems, chapter 7, for
its discrete transition; Markley & Crassidis, Fundamentals of Spacecraft Attitude Determination and Control, 4.7 and
6.2, for scale factors and misalignments; Schmidt 1966 (Advances in Control Systems 3, 293) for considered states.
"""

import math
from typing import NamedTuple

import numpy as np
from numpy.typing import ArrayLike
from scipy.spatial.transform import Rotation
from scipy.special import chdtrc, chdtri

from estimator.core import checks
from estimator.core.checks import Floats, frozen
from estimator.core.types import FilterState
from estimator.filter.consistency import (
    CONFIRMATIONS,
    ENOUGH,
    Jump,
    checked_covariances,
    checked_samples,
    log_odds,
    not_negative,
    shock_rad,
)
from estimator.filter.correct import AttitudeFix, adopt, correct, innovation, wxyz_of
from estimator.filter.error_models import GyroModel, JumpModel, TrackerModel
from estimator.filter.states import (
    CONSIDERED,
    MekfState,
    build_layout,
    decorrelate,
    inverse_response,
    propagate_state,
    start_state,
)

USED = "used"
RESET = "reset"
OUTSIDE_GATE = "refused: outside the gate"
DISPUTED = "refused: solutions agree, but the gyros missed nothing"
TOO_OLD = "refused: older than the filter remembers"

# Duration of the history of samples and solutions; at least half of it is kept (`assumed`: some frames).
HISTORY_S = 10.0
# Rounding by which a solution's time may be later than the last gyro sample.
ROUNDING_S = 1e-9


@frozen
class Update:
    """Result of an update with a star tracker's solution.

    Residual and distance are NaN for a solution that is too old.

    Attributes
    ----------
    status
        "used", "reset" (the filter was lost and adopted the solution), or "refused: why"
    residual_rad
        (3,) rotation vector in body axes from the filter's attitude to the solution's
    distance
        Mahalanobis distance of the residual: the root of a chi-square with 3 degrees of freedom,
        or less with a systematic error
    agreeing
        Number of solutions outside the gate in a row that agree with this one, itself included;
        0 if used
    log_odds
        Natural-log odds that the filter is wrong and not these solutions
        (`consistency.log_odds`); NaN if used
    """

    status: str
    residual_rad: Floats
    distance: float
    agreeing: int = 0
    log_odds: float = math.nan


class _Segment(NamedTuple):
    """History from one used solution to the next.

    Attributes
    ----------
    state
        State after the solution
    samples
        (M, 5) gyro samples since, rows as of `states.advance`
    solution
        The solution; None for the oldest segment if that begins between two solutions. The oldest
        segment's solution is not applied again
    """

    state: MekfState
    samples: Floats
    solution: AttitudeFix | None


class AttitudeFilter:
    """Attitude filter of a star tracker: the attitude as a quaternion, its error e as a small rotation in body axes.

    Let ref_from_body = estimate exp(e). With A = (I + M)^-1, the bias b and the matrix M of scale factors and
    misalignments (GyroModel), a gyro sample a in the interval T is the rotation p = A (a - T b). It gives

        e+ = exp(-[p]) e - J(p) A (T db + dM p + noise),      db+ = exp(-T / bias_time) db + noise,
        J(p) = I - (1 - cos p) / p^2 [p] + (p - sin p) / p^3 [p]^2,

    and Farrenkopf's process noise with v = arw, u^2 = 2 bias^2 / bias_time: v^2 T + u^2 T^3 / 3 in the angle,
    -u^2 T^2 / 2 in the cross-covariance, u^2 T in the bias. Each sample is propagated separately (1 us each,
    compiled), so the result does not depend on how the samples are divided among calls.

    Considered states (Schmidt 1966). Their uncertainty is in the covariance and in the gain; their values stay 0 and
    their variances as they were. A state that the data hardly determines can then not absorb other errors.

    Systematic errors. An error that many solutions share (of a survey, of distortion) does not average out: the
    filter's attitude tends to it. It is the considered state "systematic": a slow error whose covariance is the
    solution's own `systematic_rad2` plus that of TrackerModel. The covariance of the attitude then tends to it too, for
    any number of solutions. A constant error has no effect on the residuals, so the filter must receive its size.

    Several heads. Each solution is truth exp(o_n + v) (`correct.innovation`). The offset of head n is
    o_n = m_0 + m_n + L slow_n, where m_0 is the mounting of the first head and m_n that of head n relative to it. The
    filter estimates m_n. At rest the solutions determine only m_n, so m_0 is considered. Where the body rotates about
    more than one axis and the gyro is accurate, they also determine m_0, the rotation of the first head relative to the
    gyro's axes: the filter estimates it if `considered` is without "mounting".

    Saturation. While the gyro is at its rate limit, the true rate can be anything above it. The rate error is assumed
    constant throughout the saturation, with a standard deviation on each axis as large as the measured rate
    (`assumed`). The standard deviation of the attitude then grows linearly with time, as |measured rate| t, and a
    shock of six times the limit is still within the default gate. The uncertainty grows about all axes, because a
    rotation missed about one axis misdirects the rotations about the others. Only the attitude's covariance grows,
    so that a large residual is attributed to the missed rotation and not to the bias. While samples are missing it
    grows in the same way, by the gyro's `outage_rad_s`.

    Order. Solutions may come at any rate, late, in any order, or not at all. Each is used at its own time, and
    solutions for later times that were already used are applied again after it, so the result is that of the correct
    order.

    Gate. A wrong solution is worse than none, so an improbable one is refused and changes nothing. But a filter whose
    own state is wrong would refuse correct solutions forever. Refused solutions that agree with each other (each
    propagated to the next by the gyro, within the gate of their own covariances and the gyro's) are therefore weighed
    against the filter (`consistency.log_odds`): could the gyros have missed this motion, or was the filter wrong
    before? If three or more agree and the odds are 100 to 1, the filter adopts the last of them with its covariance.
    The bias is kept, but its variance is increased by the initial variance, as a wrong bias may have been the cause.
    After a saturation, an outage or a shock, or for a start that no solution has confirmed, three are enough. Against a
    filter that many solutions confirmed and a gyro that missed nothing, dozens are needed; meanwhile the status is
    DISPUTED.

    Parameters
    ----------
    gyro
        Error model of the gyro
    t_s, body_from_ref
        Initial time and attitude; the initial bias is 0
    sigma_attitude_rad, sigma_bias_rad_s
        Standard deviations at the start, one number or (3,) in body axes
    floor_rad
        Standard deviation that is added in quadrature to every solution's noise, for errors that
        its stars share but other solutions do not
    gate_sigma
        A solution is refused if its distance is less probable than this number of sigmas of a
        scalar Gaussian
    tracker
        Errors that solutions share
    jumps
        Probabilities of wrong solutions and of missed motions
    considered
        Names of the states that are considered and not estimated, out of "bias", "scale",
        "misalignment", "mounting", "systematic"
    heads
        Number of star cameras on the body, each with its own mounting and slow error
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
        tracker: TrackerModel | None = None,
        jumps: JumpModel | None = None,
        considered: tuple[str, ...] = CONSIDERED,
        heads: int = 1,
    ) -> None:
        checks.of_type("filter: gyro", gyro, GyroModel)
        checks.one_rotation("filter: body_from_ref", body_from_ref)
        t_s = checks.number("filter: t_s", t_s, -1e300, 1e300, "a finite time in seconds")
        self._gyro = gyro
        self._tracker = tracker or TrackerModel()
        self._jumps = jumps or JumpModel()
        self._floor_rad2 = not_negative("floor_rad", floor_rad) ** 2
        # The chi-square of 3 degrees of freedom with the tail probability of gate_sigma for a scalar Gaussian.
        self._gate = float(chdtri(3, chdtrc(1, not_negative("gate_sigma", gate_sigma) ** 2)))
        self._layout = build_layout(gyro, self._tracker, considered, heads)
        self._heads = heads
        # Standard deviations at the start; the slow error is normalized.
        sigma_bias = not_negative("sigma_bias_rad_s", sigma_bias_rad_s) * np.ones(3)
        sigmas: dict[str, ArrayLike] = {
            "attitude": not_negative("sigma_attitude_rad", sigma_attitude_rad) * np.ones(3),
            "bias": sigma_bias,
            "scale": gyro.scale,
            "misalignment": gyro.misalignment_rad,
            "mounting": self._tracker.mounting_rad,
            "systematic": 1.0,
        }
        self._initial_bias_variance = sigma_bias**2
        self._current = start_state(t_s, wxyz_of(body_from_ref), sigmas, self._layout)
        self._segments = [_Segment(self._current, np.empty((0, 5)), None)]
        # Consecutive refused solutions, each of which agrees with the one before, and the states before them.
        self._refused: list[tuple[MekfState, AttitudeFix]] = []
        self._measured_rad_s = np.zeros(3)

    @property
    def state(self) -> FilterState:
        """Attitude, bias, errors of the gyro and the mounting, and their covariance, after the last gyro sample."""
        state = self._current
        slices = self._layout.reported
        size = max(rows.stop for rows in slices.values())
        # Attitude and bias are the first six states.
        return FilterState(
            state.t_s,
            state.body_from_ref,
            self.bias_rad_s,
            state.covariance[:size, :size].copy(),
            {
                name: state.values[rows].copy()
                for name, rows in slices.items()
                if rows.start >= 6
            },
        )

    @property
    def body_from_ref(self) -> Rotation:
        """Attitude after the last gyro sample."""
        return self._current.body_from_ref

    @property
    def ref_from_body_wxyz(self) -> Floats:
        """(4,) quaternion of ref_from_body, scalar first, as stored: quick enough for callers in every tick."""
        return self._current.ref_from_body_wxyz

    @property
    def bias_rad_s(self) -> Floats:
        """(3,) estimated gyro bias in body axes."""
        return self._current.values[3:6].copy()

    @property
    def rate_rad_s(self) -> Floats:
        """(3,) rate in body axes, corrected for the gyro's errors: the mean over the last call's samples; 0 before."""
        rate = self._measured_rad_s - self.bias_rad_s
        return inverse_response(self._current.values, self._layout.columns) @ rate

    def propagate(
        self,
        t_s: ArrayLike,
        angle_rad: ArrayLike,
        saturated: ArrayLike,
        missing: ArrayLike | None = None,
    ) -> None:
        """Propagate the state by gyro samples.

        Parameters
        ----------
        t_s
            (N,) ends of the sample intervals; the first interval begins at the filter's time
        angle_rad
            (N, 3) rotation angle in each interval, about the body axes
        saturated
            (N,) whether the gyro was at its rate limit
        missing
            (N,) whether the sample is missing (an outage): its angle is then a guess, NaN for 0;
            None: none is missing

        Raises
        ------
        ValueError
            For other shapes, non-finite numbers, times that do not increase, or intervals that
            are too long.
        """
        start_s = self._current.t_s
        samples = checked_samples(start_s, t_s, angle_rad, saturated, missing, self._gyro)
        self._current = self._propagate_state(self._current, samples)
        self._measured_rad_s = samples[:, 1:4].sum(axis=0) / (samples[-1, 0] - start_s)
        # The samples belong to the history since the last solution.
        last = self._segments[-1]
        self._segments[-1] = last._replace(samples=np.concatenate([last.samples, samples]))
        # Older history is deleted: whole segments, and the first half of the samples of a long one.
        before_s = float(samples[-1, 0]) - HISTORY_S
        while len(self._segments) > 1 and self._segments[1].state.t_s < before_s:
            del self._segments[0]
        # Half at a time, so that the cost of propagating the first state is spread over many calls.
        first = self._segments[0]
        if len(first.samples) and first.samples[0, 0] < before_s:
            half = len(first.samples) // 2
            state = self._propagate_state(first.state, first.samples[:half])
            self._segments[0] = _Segment(state, first.samples[half:], None)

    def update(
        self,
        t_s: float,
        body_from_ref_measured: Rotation,
        covariance_rad2: ArrayLike,
        systematic_rad2: ArrayLike | None = None,
        head: int = 0,
    ) -> Update:
        """Apply a star tracker's solution for the current or a past time: the numbered steps of the module.

        Parameters
        ----------
        t_s, head
            Time of the solution, and number of the star camera, from 0
        body_from_ref_measured, covariance_rad2
            Attitude, and (3, 3) covariance of its small rotation error, in body axes
        systematic_rad2
            (3, 3) part of the covariance that is common to successive solutions; None for 0

        Raises
        ------
        ValueError
            For a covariance that is not symmetric and positive definite, a systematic part that
            is not less, an unknown head, or a time after the last sample.
        """
        t_s = self._checked_time_s(t_s)
        solution = self._solution(
            body_from_ref_measured, covariance_rad2, systematic_rad2, head
        )
        if t_s < self._segments[0].state.t_s:
            return Update(TOO_OLD, np.full(3, np.nan), math.nan)
        # 1. Find the segment that contains t_s, and propagate its state to that time.
        k = max(k for k, segment in enumerate(self._segments) if segment.state.t_s <= t_s)
        segment = self._segments[k]
        before, after = _split(
            segment.samples, segment.state.t_s, min(t_s, self._current.t_s)
        )
        prior = self._prior(segment.state, before)
        # 2. Innovation
        found = innovation(prior, solution, self._layout)
        update = Update(USED, found.residual_rad, math.sqrt(found.distance2))
        if found.distance2 <= self._gate:
            # 3. Correct the state and split the segment at the solution; 5. repeat the later solutions.
            corrected = correct(prior, found, self._layout)
            first = segment._replace(samples=before)
            self._segments[k : k + 1] = [first, _Segment(corrected, after, solution)]
            self._replay(k + 1)
        else:
            # 4. Refuse the solution, or adopt it.
            shock = shock_rad(segment.state.t_s, before, self._gyro.arw_rad_sqrt_s)
            shocked = prior._replace(lost_rad=prior.lost_rad + shock)
            update = self._weigh(shocked, solution, update)
            if update.status != RESET:
                return update
            # Solutions used later than t_s were judged by a lost filter: only their gyro samples are kept.
            later = [segment.samples for segment in self._segments[k + 1 :]]
            # The new history begins with the state that the solution gives.
            variance = self._initial_bias_variance
            state = adopt(prior, solution, self._layout, variance, update.agreeing)
            self._segments = [_Segment(state, np.concatenate([after, *later]), None)]
        # 5. Propagate to the present.
        self._refused = []
        last = self._segments[-1]
        self._current = self._propagate_state(last.state, last.samples)
        return update

    def _checked_time_s(self, t_s: float) -> float:
        """Return the time of a solution. Raises ValueError for one after the last gyro sample."""
        t_s = checks.number("update: t_s", t_s, -math.inf, math.inf, "a time in seconds")
        now_s = self._current.t_s
        if not t_s <= now_s + ROUNDING_S:
            raise ValueError(
                f"update: a solution at {t_s} s; allowed: up to the last gyro sample, {now_s} s"
            )
        return t_s

    def _solution(
        self,
        body_from_ref: Rotation,
        total_rad2: ArrayLike,
        systematic_rad2: ArrayLike | None,
        head: int,
    ) -> AttitudeFix:
        """Check a solution, and return it with the filter's floor and systematic error added to its covariances."""
        checks.one_rotation("update: body_from_ref_measured", body_from_ref)
        if head not in range(self._heads):
            raise ValueError(f"update: head {head}; allowed: 0 to {self._heads - 1}")
        noise, systematic = checked_covariances(total_rad2, systematic_rad2)
        unit = np.eye(3)
        common = systematic + self._tracker.systematic_rad**2 * unit
        return AttitudeFix(body_from_ref, noise + self._floor_rad2 * unit, common, head)

    def _weigh(self, prior: MekfState, solution: AttitudeFix, update: Update) -> Update:
        """Return the update by a solution outside the gate: refused, or a reset if the filter is probably wrong."""
        # Extend the series of agreeing solutions, or begin a new one.
        if self._refused and not self._agrees(prior, solution):
            self._refused = []
        self._refused.append((prior, solution))
        agreeing = len(self._refused)
        angle_rad = float(np.linalg.norm(update.residual_rad))
        since_s = prior.t_s - prior.used_s
        jump = Jump(
            angle_rad, update.distance, agreeing, since_s, prior.lost_rad, prior.support
        )
        odds = log_odds(jump, self._jumps)
        # Adopt only what is confirmed and probable.
        status = OUTSIDE_GATE
        if agreeing >= CONFIRMATIONS:
            status = RESET if odds >= ENOUGH else DISPUTED
        return Update(status, update.residual_rad, update.distance, agreeing, odds)

    def _agrees(self, prior: MekfState, solution: AttitudeFix) -> bool:
        """Return whether a refused solution agrees with the one before it, propagated by the gyro alone.

        No solution was used between the two, so the filter's states give the gyro's rotation.
        """
        state, earlier = self._refused[-1]
        later_from_earlier = prior.body_from_ref * state.body_from_ref.inv()
        predicted = later_from_earlier * earlier.body_from_ref
        difference = (predicted * solution.body_from_ref.inv()).as_rotvec()
        # Both covariances in the later body axes, plus those of the gyro's noise and bias in the gap.
        gap_s = abs(prior.t_s - state.t_s)
        R = later_from_earlier.as_matrix()
        covariance = R @ (earlier.noise_rad2 + earlier.systematic_rad2) @ R.T
        covariance += solution.noise_rad2 + solution.systematic_rad2
        by_noise = gap_s * self._gyro.arw_rad_sqrt_s**2 * np.eye(3)
        covariance += by_noise + gap_s**2 * prior.covariance[3:6, 3:6]
        return bool(difference @ np.linalg.solve(covariance, difference) <= self._gate)

    def _replay(self, k: int) -> None:
        """Apply the solutions after segment k again, from its new state. They have passed the gate already."""
        for j in range(k + 1, len(self._segments)):
            # State before solution j, from the new state after the one before it
            earlier = self._segments[j - 1]
            segment = self._segments[j]
            assert segment.solution is not None
            prior = self._prior(earlier.state, earlier.samples)
            found = innovation(prior, segment.solution, self._layout)
            self._segments[j] = segment._replace(state=correct(prior, found, self._layout))

    def _propagate_state(self, state: MekfState, samples: Floats) -> MekfState:
        """Return the state after gyro samples, by the filter's own models."""
        return propagate_state(state, samples, self._gyro, self._tracker, self._layout)

    def _prior(self, state: MekfState, samples: Floats) -> MekfState:
        """Return the state before a solution: propagated by the samples since the last solution that was used."""
        return decorrelate(self._propagate_state(state, samples), self._tracker, self._layout)


def _split(samples: Floats, start_s: float, t_s: float) -> tuple[Floats, Floats]:
    """Split samples at t_s into those before and after; the first interval begins at start_s.

    An interval that contains t_s is divided in proportion, assuming a constant rate in it.
    """
    # k is the interval that contains t_s.
    k = int(np.searchsorted(samples[:, 0], t_s, side="right"))
    begin_s = samples[k - 1, 0] if k else start_s
    if k == len(samples) or begin_s == t_s:
        return samples[:k], samples[k:]
    fraction = (t_s - begin_s) / (samples[k, 0] - begin_s)
    before = samples[: k + 1].copy()
    after = samples[k:].copy()
    before[-1, 0] = t_s
    before[-1, 1:4] *= fraction
    after[0, 1:4] *= 1 - fraction
    return before, after
