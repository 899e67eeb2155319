"""Rotational dynamics of a vehicle with wheels on an air bearing, integrated over many intervals at once.

The state at an attitude is the rotation lab_from_body R, the angular momentum H about the bearing in lab axes with
respect to inertial space, and a random torque d about lab axes:

    w = J^-1 (R^T H - A (1 + e) h) - R^T W              rate in the lab, body axes
    dR/dt = R [w]
    dH/dt = (R m r) x g - W x H + T + R J J0^-1 R^T d - R (v + q |w|) w
    dd/dt = -d / tau + noise

J0 is the assumed inertia, so that d represents the random acceleration J0^-1 R^T d. If d were the torque itself, a fit
of J and of the motion at once would prefer small inertias, since with them small random torques explain a motion:
such a fit maximizes the joint probability of J and d, not the probability of J alone (Box & Tiao, Bayesian Inference in
Statistical Analysis, 1973, section 1.5).

J is the inertia with the wheels locked, A the wheel axes, h the wheels' assumed momenta and e their relative errors,
m r the mass times the center of mass, g gravity, W the Earth's rate, T a torque constant in the lab, v and q the air's
viscous and quadratic drag about each body axis (Hughes, Spacecraft Attitude Dynamics, 1986, ch. 3). H changes by
external torques only, so that friction and motor torques of the wheels do not enter.

Arrays have their components first, (3, B) for B motions. `transition` integrates K intervals at once:

1. Change each state and parameter a little, for the difference quotients.
2. Integrate all of them by the fourth-order Runge-Kutta method (`EquationsOfMotion.integrate`).
3. Form the difference quotients: the derivatives of the states after the interval.
4. Compute the covariance from the random torque and the wheels' noise (`torque_noise`).
"""

from __future__ import annotations

from dataclasses import field, replace
from typing import NamedTuple

import numpy as np
from scipy.spatial.transform import Rotation

from estimator.core.checks import Floats, Ints, frozen
from estimator.core.errors import ImageError

# Measurements of a motion on an air bearing, assumptions, and the parameters that are estimated.

# Elements of the parameters; those of the wheels are the last, from WHEELS on.
INERTIA = slice(0, 6)
MOMENT = slice(6, 9)
LAB_TORQUE = slice(9, 12)
DRAG = slice(12, 14)
BIAS = slice(14, 17)
WHEELS = 17
# Rows and columns of the six numbers of an inertia tensor.
TRIANGLE = ((0, 1, 2, 0, 0, 1), (0, 1, 2, 1, 2, 2))
MIN_ATTITUDES = 4


@frozen
class BearingRecord:
    """One motion without contact: attitudes of the star tracker, and momenta of the wheels from their speeds.

    Attributes
    ----------
    t_s
        (N,) ascending times of the attitudes
    lab_from_body
        N measured attitudes
    covariance_rad2
        (N, 3, 3) covariance of their errors, rotation vectors in body axes
    wheel_t_s
        (M,) ascending times of the wheel speeds, which cover the times of all attitudes
    wheel_momentum_nms
        (M, n) assumed axial inertia times measured speed
    added_inertia_kg_m2, added_moment_kg_m
        (3, 3) inertia and (3,) moment that trim masses have added to the vehicle since the
        configuration whose mass properties are sought
    systematic_rad2
        (N, 3, 3) part of covariance_rad2 that attitudes near one another share; None without one
    constant_rad2
        (N, 3, 3) part of systematic_rad2 that is one rotation in body axes at all attitudes; None without one
    lights
        (N, M) 1 for each light of a map that an attitude is from, else 0: two attitudes share the errors of their
        common lights. None to let the shared errors fall with the rotation between them
    """

    t_s: Floats
    lab_from_body: Rotation
    covariance_rad2: Floats
    wheel_t_s: Floats
    wheel_momentum_nms: Floats
    added_inertia_kg_m2: Floats = field(default_factory=lambda: np.zeros((3, 3)))
    added_moment_kg_m: Floats = field(default_factory=lambda: np.zeros(3))
    systematic_rad2: Floats | None = None
    constant_rad2: Floats | None = None
    lights: Floats | None = None

    def __post_init__(self) -> None:
        if len(self.t_s) < MIN_ATTITUDES:
            raise ImageError(
                f"mass properties: {len(self.t_s)} attitudes; allowed: {MIN_ATTITUDES} or more"
            )
        if not (np.all(np.diff(self.t_s) > 0) and np.all(np.diff(self.wheel_t_s) > 0)):
            raise ImageError("mass properties: times do not ascend")
        if self.t_s[0] < self.wheel_t_s[0] or self.t_s[-1] > self.wheel_t_s[-1]:
            raise ImageError(
                f"mass properties: wheel speeds from {self.wheel_t_s[0]:g} to {self.wheel_t_s[-1]:g} s; allowed: over"
                f" all attitudes, {self.t_s[0]:g} to {self.t_s[-1]:g} s"
            )

    @property
    def noise_rad2(self) -> Floats:
        """(N, 3, 3) part of covariance_rad2 that is independent from attitude to attitude."""
        if self.systematic_rad2 is None:
            return self.covariance_rad2
        return self.covariance_rad2 - self.systematic_rad2

    @property
    def varying_rad2(self) -> Floats:
        """(N, 3, 3) part of covariance_rad2 that changes with the attitude, by which attitudes are weighted."""
        if self.constant_rad2 is None:
            return self.covariance_rad2
        return self.covariance_rad2 - self.constant_rad2

    def with_noise(self, factor: float) -> BearingRecord:
        """Return the record with the independent part of its covariance scaled by a factor."""
        added = (factor - 1) * self.noise_rad2
        return replace(self, covariance_rad2=self.covariance_rad2 + added)


@frozen
class LabConstants:
    """Known constants of the lab and of the wheels.

    Attributes
    ----------
    gravity_m_s2
        Gravity, along lab -z
    wheel_axes
        (3, n) unit vectors of the wheels' axes in body axes
    torque_rms_nm
        (3,) standard deviation of the random torque (air currents) about each lab axis
    torque_correlation_s
        Correlation time of the random torque; its autocorrelation is
        rms^2 exp(-|lag| / correlation)
    earth_lab_rad_s
        (3,) rate of the Earth's rotation in lab axes
    wheel_sigma_nms
        Standard deviation of a measured wheel momentum, independent from sample to sample
    """

    gravity_m_s2: float
    wheel_axes: Floats
    torque_rms_nm: Floats
    torque_correlation_s: float
    earth_lab_rad_s: Floats = field(default_factory=lambda: np.zeros(3))
    wheel_sigma_nms: float = 0.0


@frozen
class Prior:
    """Prior values of the parameters, (P,), and their standard deviations; and the known constants.

    The parameters are, in this order: inertia xx, yy, zz, xy, xz, yz about the bearing (kg m2); moment m r, mass times
    center of mass (3,) (kg m); torque constant in the lab (3,) (N m); viscous and quadratic drag (N m s, N m s2);
    rotation of the tracker's body axes from the true ones (3,) (rad); relative error of each wheel's assumed axial
    inertia (n,).
    """

    values: Floats
    sigma: Floats
    lab: LabConstants

    def __post_init__(self) -> None:
        if not (np.all(np.isfinite(self.values)) and np.all(self.sigma > 0)):
            raise ImageError(
                "mass properties: assumed values must be finite and their standard deviations above 0"
            )


@frozen
class MassEstimate:
    """The nine mass properties with their covariance, and the other parameters.

    Attributes
    ----------
    values, covariance
        (P,) parameters and their (P, P) covariance, in the order of `Prior`
    misfit
        Chi-square of the residuals over their number; 1 if noise and torques are as assumed
    """

    values: Floats
    covariance: Floats
    misfit: float

    @property
    def inertia_kg_m2(self) -> Floats:
        """(3, 3) inertia about the bearing with the wheels locked, in body axes."""
        return inertia_matrix(self.values[INERTIA])

    @property
    def moment_kg_m(self) -> Floats:
        """(3,) mass times center of mass from the bearing's center, in body axes."""
        return self.values[MOMENT]

    @property
    def sigma(self) -> Floats:
        """(P,) standard deviations of the parameters."""
        return np.sqrt(np.diag(self.covariance))


def inertia_matrix(six: Floats) -> Floats:
    """Return the (3, 3, ...) symmetric matrix of xx, yy, zz, xy, xz, yz (6, ...)."""
    xx, yy, zz, xy, xz, yz = six
    return np.array([[xx, xy, xz], [xy, yy, yz], [xz, yz, zz]])


def inertia_six(inertia: Floats) -> Floats:
    """Return xx, yy, zz, xy, xz, yz, (6,), of a symmetric (3, 3) matrix."""
    return inertia[TRIANGLE]


# States, equations of motion, and their integration.

MAX_STEP_S = 0.1  # largest Runge-Kutta step: relative error below 1e-7 at 0.5 rad/s
STATE = 9  # attitude error, momentum, torque
GAUSS_X, GAUSS_W = np.polynomial.legendre.leggauss(8)
# Steps of the difference quotients.
ATTITUDE_STEP_RAD = 1e-5
RELATIVE_STEP = 1e-5


class States(NamedTuple):
    """B states.

    Attributes
    ----------
    quaternion
        (4, B) lab_from_body as unit quaternions x, y, z, w
    momentum
        (3, B) angular momentum H in lab axes
    torque
        (3, B) random torque d in lab axes
    """

    quaternion: Floats
    momentum: Floats
    torque: Floats

    def take(self, which: slice | Ints) -> States:
        """Select states by slice or index."""
        return States(*(part[:, which] for part in self))

    @property
    def rotation(self) -> Rotation:
        """The B rotations lab_from_body."""
        return Rotation.from_quat(self.quaternion.T)

    def moved(self, change: Floats) -> States:
        """Return the states after a change (9, B): rotation vector in body axes, momentum, torque."""
        turned = (self.rotation * Rotation.from_rotvec(change[:3].T)).as_quat().T
        return States(turned, self.momentum + change[3:6], self.torque + change[6:])

    def minus(self, other: States) -> Floats:
        """Return the (9, B) change from other states to these: the inverse of `moved`."""
        turn = (other.rotation.inv() * self.rotation).as_rotvec().T
        return np.vstack([turn, self.momentum - other.momentum, self.torque - other.torque])


class Transition(NamedTuple):
    """States after K intervals, and their derivatives.

    Attributes
    ----------
    after
        K states after the intervals
    by_state, by_parameter
        (K, 9, 9) and (K, 9, P) derivatives with respect to the states before and the parameters
    noise
        (K, 9, 9) covariance from the random torque and the wheels' noise
    """

    after: States
    by_state: Floats
    by_parameter: Floats
    noise: Floats


def cross(a: Floats, b: Floats) -> Floats:
    """Return the (3, B) cross products of (3, B) vectors."""
    return np.array(
        [a[1] * b[2] - a[2] * b[1], a[2] * b[0] - a[0] * b[2], a[0] * b[1] - a[1] * b[0]]
    )


def turn(quaternion: Floats, vector: Floats, inverse: bool = False) -> Floats:
    """Return R v, or R^T v, (3, B), of quaternions (u, s): v + 2 s u x v + 2 u x (u x v)."""
    u = -quaternion[:3] if inverse else quaternion[:3]
    twice = 2 * cross(u, vector)
    return vector + quaternion[3] * twice + cross(u, twice)


class EquationsOfMotion:
    """Equations of motion of one record, for B motions.

    Parameters
    ----------
    record
        Measured motion
    prior
        The inertia J0 and the known constants
    parameters
        (P, B) parameters of the motions, in the order of `Prior`
    """

    def __init__(self, record: BearingRecord, prior: Prior, parameters: Floats) -> None:
        # J, J^-1 and J J0^-1, (3, 3, B), with the trim masses of the record
        inertia = inertia_matrix(parameters[INERTIA]) + record.added_inertia_kg_m2[:, :, None]
        inverse = np.asarray(np.linalg.inv(inertia.transpose(2, 0, 1)), dtype=np.float64)
        self.inverse: Floats = inverse.transpose(1, 2, 0)
        self.torque_scale = np.einsum(
            "ijb,jk->ikb", inertia, inverse_inertia(record, prior.values)
        )
        self.moment = parameters[MOMENT] + record.added_moment_kg_m[:, None]
        self.lab_torque = parameters[LAB_TORQUE]
        self.drag = parameters[DRAG]
        self.wheel_scale = 1 + parameters[WHEELS:]
        lab = prior.lab
        self.axes = lab.wheel_axes
        self.earth = lab.earth_lab_rad_s[:, None]
        self.gravity = np.array([[0.0], [0.0], [-lab.gravity_m_s2]])
        self.record = record

    def stored(self, t_s: Floats) -> Floats:
        """Return A (1 + e) h, (3, B): the momentum of the wheels at times (B,), in body axes."""
        measured = [
            np.interp(t_s, self.record.wheel_t_s, one)
            for one in self.record.wheel_momentum_nms.T
        ]
        return self.axes @ (self.wheel_scale * np.array(measured))

    def rate(self, states: States, stored: Floats) -> Floats:
        """Return the rate relative to the lab, (3, B) in body axes: w = J^-1 (R^T H - stored) - R^T W."""
        q = states.quaternion
        own = turn(q, states.momentum, inverse=True) - stored
        inertial: Floats = np.einsum("ijb,jb->ib", self.inverse, own)
        return inertial - turn(q, np.broadcast_to(self.earth, own.shape), inverse=True)

    def slope(self, t_s: Floats, states: States) -> States:
        """Return the derivatives with respect to time: the equations of the module, without the torque's decay."""
        q = states.quaternion
        rate = self.rate(states, self.stored(t_s))
        # R (v + q |w|) w
        viscous, quadratic = self.drag
        drag = turn(q, (viscous + quadratic * np.abs(rate)) * rate)
        # (R m r) x g - W x H
        torque = cross(turn(q, self.moment), self.gravity) - cross(
            self.earth, states.momentum
        )
        # J J0^-1 R^T d
        in_body = np.einsum(
            "ijb,jb->ib", self.torque_scale, turn(q, states.torque, inverse=True)
        )
        # dq/dt = q (w, 0) / 2, a Hamilton product
        vector = q[3] * rate + cross(q[:3], rate)
        spin = np.vstack([vector, -np.sum(q[:3] * rate, axis=0)[None]]) / 2
        return States(
            spin, torque + self.lab_torque + turn(q, in_body) - drag, np.zeros_like(rate)
        )

    def integrate(
        self, begin_s: Floats, end_s: Floats, states: States, correlation_s: float
    ) -> States:
        """Return the states at end_s (B,) by the fourth-order Runge-Kutta method.

        The random torque decays as exp(-t / correlation); in each step h the motion feels its mean,
        d (correlation / h) (1 - exp(-h / correlation)).
        """
        steps = max(1, int(np.ceil(np.max(end_s - begin_s) / MAX_STEP_S)))
        h = (end_s - begin_s) / steps
        decay = np.exp(-h / correlation_s)
        mean = correlation_s / h * (1 - decay)
        for n in range(steps):
            t_s = begin_s + n * h
            last = states.torque
            now = states._replace(torque=mean * last)
            a = self.slope(t_s, now)
            b = self.slope(t_s + h / 2, moved_on(now, a, h / 2))
            c = self.slope(t_s + h / 2, moved_on(now, b, h / 2))
            d = self.slope(t_s + h, moved_on(now, c, h))
            # y + h / 6 (a + 2 b + 2 c + d); the quaternion is normalized.
            slope = States(
                *(
                    (k1 + 2 * k2 + 2 * k3 + k4) / 6
                    for k1, k2, k3, k4 in zip(a, b, c, d, strict=True)
                )
            )
            q, momentum, _ = moved_on(now, slope, h)
            states = States(q / np.sqrt(np.sum(q * q, axis=0)), momentum, decay * last)
        return states


def inverse_inertia(record: BearingRecord, values: Floats) -> Floats:
    """Return the (3, 3) inverse inertia of the vehicle with a record's trim masses, for parameters (P,)."""
    return np.asarray(
        np.linalg.inv(inertia_matrix(values[INERTIA]) + record.added_inertia_kg_m2)
    )


def moved_on(states: States, slope: States, by_s: Floats | float) -> States:
    """Return the states after the time by_s at a constant slope."""
    return States(*(one + by_s * rate for one, rate in zip(states, slope, strict=True)))


def difference_steps(
    values: Floats, sigma: Floats, momentum_nms: float, torque_nm: float
) -> tuple[Floats, Floats]:
    """Return the steps of the difference quotients: (9,) of the states, (P,) of the parameters."""
    state = np.repeat([ATTITUDE_STEP_RAD, RELATIVE_STEP * momentum_nms, torque_nm], 3)
    return state, np.minimum(1e-3 * sigma, RELATIVE_STEP * np.maximum(np.abs(values), sigma))


def transition(
    record: BearingRecord,
    first: int,
    before: States,
    values: Floats,
    prior: Prior,
) -> Transition:
    """Integrate K states, each to the next attitude's time, with derivatives: the numbered steps of the module.

    Parameters
    ----------
    first
        Number of the attitude of the first state
    before
        K states at successive attitudes
    values
        (P,) parameters
    prior
        Prior of the parameters, whose standard deviations scale the steps of the difference
        quotients
    """
    count = before.momentum.shape[1]
    size = len(values)
    largest = float(
        np.max(np.abs(before.momentum), initial=1e-3 * float(np.max(values[INERTIA])))
    )
    state_step, step = difference_steps(
        values, prior.sigma, largest, float(np.max(prior.lab.torque_rms_nm))
    )
    # 1. Columns of each interval: unchanged, each element of the state changed, each parameter changed
    columns = 1 + STATE + size
    change = np.zeros((STATE, columns))
    change[:, 1 : 1 + STATE] = np.diag(state_step)
    parameters = np.repeat(values[:, None], columns, axis=1)
    parameters[:, 1 + STATE :] += np.diag(step)
    pick: Ints = np.repeat(np.arange(count), columns)
    motion = EquationsOfMotion(record, prior, np.tile(parameters, count))
    t_s = record.t_s[first : first + count + 1]
    start = before.take(pick).moved(np.tile(change, count))
    # 2. Integration
    end = motion.integrate(
        t_s[:-1][pick], t_s[1:][pick], start, prior.lab.torque_correlation_s
    )
    # 3. Difference quotients
    after = end.take(slice(None, None, columns))
    slopes = end.minus(after.take(pick)).reshape(STATE, count, columns).transpose(1, 0, 2)
    slopes = slopes[:, :, 1:] / np.concatenate([state_step, step])
    # 4. Noise
    noise = torque_noise(np.diff(t_s), record, before, values, prior)
    return Transition(after, slopes[:, :, :STATE], slopes[:, :, STATE:], noise)


def torque_noise(
    duration_s: Floats,
    record: BearingRecord,
    before: States,
    values: Floats,
    prior: Prior,
) -> Floats:
    """Return the (K, 9, 9) covariance of the states after K intervals from the random torque and the wheels' noise.

    White noise of density 2 rms^2 / tau that acts at s before the end has by then changed torque, momentum and angle by

        c = exp(-s / tau),   R J J0^-1 R^T b,  b = tau (1 - c),   a = J0^-1 R^T tau (s - b)

    per unit of noise. Their products are integrated over s by Gauss's rule. Noise of a measured momentum, sigma in
    every sample, moves the angle by J0^-1 sigma times the sample's time, a random walk.

    Parameters
    ----------
    duration_s
        (K,) lengths of the intervals
    values, prior
        (P,) parameters with the inertia J, and the prior with J0
    """
    lab = prior.lab
    tau = lab.torque_correlation_s
    s = duration_s[:, None] * (1 + GAUSS_X) / 2
    c = np.exp(-s / tau)
    b = tau * (1 - c)
    # Integrals of the products of the three time functions
    factors = np.array([tau * (s - b), b, c])
    weights = duration_s[:, None] * GAUSS_W / 2
    moments = np.einsum("iks,jks,ks->kij", factors, factors, weights)
    # Matrices of the three effects
    density = np.diag(2 * lab.torque_rms_nm**2 / tau)
    spread = np.zeros((len(duration_s), 3, 3, 3))
    R_body_from_lab = before.rotation.inv().as_matrix()
    inverse = inverse_inertia(record, prior.values)
    spread[:, 0] = inverse @ R_body_from_lab
    spread[:, 1] = momentum_scale(record, before, prior.values, values)
    spread[:, 2] = np.eye(3)
    blocks = np.einsum("kij,kiab,bc,kjdc->kiajd", moments, spread, density, spread)
    noise = blocks.reshape(-1, STATE, STATE)
    # Random walk from the wheels' noise
    sample_s = float(np.median(np.diff(record.wheel_t_s)))
    walk = (
        lab.wheel_sigma_nms**2
        * sample_s
        * inverse
        @ lab.wheel_axes
        @ lab.wheel_axes.T
        @ inverse.T
    )
    noise[:, :3, :3] += walk * duration_s[:, None, None]
    return noise


def momentum_scale(
    record: BearingRecord, states: States, values: Floats, assumed: Floats
) -> Floats:
    """Return R J0 J^-1 R^T, (K, 3, 3): it converts a momentum to that of the assumed inertia at the same rate."""
    R_lab_from_body = states.rotation.as_matrix()
    scale = np.linalg.solve(inverse_inertia(record, assumed), inverse_inertia(record, values))
    return R_lab_from_body @ scale @ R_lab_from_body.mT
