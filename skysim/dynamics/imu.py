"""Inertial measurement unit: ideal increments, sensor errors, and the inertial navigator that integrates the gyros.

1. `ideal_increments` integrates the ideal angular rate and specific force of the simulated motion over each sample
   interval.
2. `Imu.measure` adds scale factor, misalignment, bias (constant and Gauss-Markov), white noise, limits and
   quantization.
3. `Navigator.add` integrates the gyro increments to an attitude.

The unit's axes are the body's. Its outputs are increments (delta angle, delta velocity), as those of a strapdown
unit. They contain all motion between two samples; only its order within the interval is lost.
"""

import math

import numpy as np
from numpy.random import Generator
from numpy.typing import ArrayLike

from skysim.core import quaternion
from skysim.core.constants import (
    ARCSEC_RAD,
    DEG_H_RAD_S,
    EARTH_RATE_RAD_S,
    PPM,
    STANDARD_GRAVITY_M_S2,
)
from skysim.core.errors import InputError
from skysim.core.jit import jit
from skysim.core.random_streams import random_stream
from skysim.core.types import Bools, Floats, frozen
from skysim.core.units import scaled_errors
from skysim.scene.sections.vehicle import (
    AccelerometerConfig,
    GyroConfig,
    ImuConfig,
    SiteConfig,
)

# Knots per polynomial: a cubic, with an error of fourth order in their spacing.
CUBIC_POINTS = 4
# Distance of the two Gauss-Legendre points from the middle of a unit interval; they integrate a cubic exactly.
GAUSS_OFFSET = 0.5 / math.sqrt(3)
TIME_TOLERANCE_S = 1e-9  # tolerance for rounding of sample times
NO_RATE = np.zeros(3)


@frozen
class Increments:
    """Integrals of angular rate and of specific force over sample intervals, in body axes.

    Attributes
    ----------
    t_s
        (N,) ends of the intervals
    step_s
        Length of each interval
    angle_rad
        (N, 3) integral of the rate about each body axis; a rotation vector only if the axis is constant
    velocity_m_s
        (N, 3) integral of the specific force, which is +g along the vertical for a unit at rest
    saturated
        (N,) whether a gyro was at its limit; False for an ideal unit
    overloaded
        (N,) whether an accelerometer was at its limit; False for an ideal unit
    """

    t_s: Floats
    step_s: float
    angle_rad: Floats
    velocity_m_s: Floats
    saturated: Bools
    overloaded: Bools


def earth_rate_lab_rad_s(site: SiteConfig) -> Floats:
    """(3,) Earth rate relative to the stars, in lab axes.

        up: W sin(latitude),    north: W cos(latitude)

    Lab z is up, x is at the azimuth from north through east, y = z cross x.
    """
    latitude = math.radians(site.latitude_deg)
    azimuth = math.radians(site.x_azimuth_deg)
    north = math.cos(latitude)
    return EARTH_RATE_RAD_S * np.array(
        [north * math.cos(azimuth), north * math.sin(azimuth), math.sin(latitude)]
    )


def ideal_increments(
    t_s: Floats,
    lab_from_body_wxyz: Floats,
    rate_body_rad_s: Floats,
    ends_s: Floats,
    step_s: float,
    position_body_m: ArrayLike,
    gravity_m_s2: float,
    earth_rate_lab_rad_s: Floats = NO_RATE,
) -> Increments:
    """Increments of an ideal unit (without errors) on a body that rotates about the lab's origin.

    Raises InputError for intervals outside the knots.

        w = rate + body_from_lab earth_rate           angle    = int w dt
        f = dw/dt x r + w x (w x r) - g_body          velocity = int f dt

    (Titterton & Weston, Strapdown Inertial Navigation Technology, ch. 3; `assumed`). Since w is the inertial rate,
    f includes the centripetal and Coriolis acceleration of the lab's rotation. g is plumb-line gravity,
    (0, 0, -gravity) in the lab, which includes the Earth's centrifugal acceleration at the origin.

    1. Compute w, and f without dw/dt x r, at the knots (`inertial_knots`).
    2. Between knots every component is the cubic through the four nearest knots (`add_cubic`). Integrate it exactly
       by two Gauss points. The error is of fourth order in the spacing h; if the acceleration jumps by dalpha at a
       knot, the angle has an error of dalpha h^2 / 12, once.
    3. int dw/dt x r dt = (w(end) - w(begin)) x r.

    Parameters
    ----------
    t_s
        (K,) knots of the motion, ascending, K >= 2, in any spacing
    lab_from_body_wxyz, rate_body_rad_s
        (K, 4) attitudes at the knots, and (K, 3) rates of the body in the lab, in body axes
    ends_s, step_s
        (N,) ends of the sample intervals, which need not coincide with knots, and their length
    position_body_m
        (3,) position r of the unit, in body axes
    gravity_m_s2
        Plumb-line gravity along lab -z, a positive number
    earth_rate_lab_rad_s
        (3,) Earth rate in lab axes; zeros for a unit that does not sense it
    """
    check_times(t_s, ends_s, step_s)
    position = np.asarray(position_body_m, dtype=float)
    # 1. Contiguous arrays, since numba compiles for each memory layout.
    knots = inertial_knots(
        np.ascontiguousarray(lab_from_body_wxyz),
        np.ascontiguousarray(rate_body_rad_s),
        position,
        gravity_m_s2,
        earth_rate_lab_rad_s,
    )
    # 2. and 3.
    angle, velocity = integrate_intervals(
        np.ascontiguousarray(t_s), knots, np.ascontiguousarray(ends_s), step_s, position
    )
    in_range = np.zeros(len(ends_s), dtype=bool)
    return Increments(ends_s, step_s, angle, velocity, in_range, in_range)


def check_times(t_s: Floats, ends_s: Floats, step_s: float) -> None:
    """Raise InputError if there are fewer than two knots, or an interval is outside them."""
    if len(t_s) < 2:
        raise InputError("imu", f"{len(t_s)} samples of the motion", "two or more")
    first_s = np.min(ends_s, initial=np.inf) - step_s
    last_s = np.max(ends_s, initial=-np.inf)
    # Also rejects NaN.
    if len(ends_s) and not (
        t_s[0] - TIME_TOLERANCE_S <= first_s and last_s <= t_s[-1] + TIME_TOLERANCE_S
    ):
        raise InputError(
            "imu",
            f"samples from {first_s:.6f} to {last_s:.6f} s",
            f"within the motion, {t_s[0]:.6f} to {t_s[-1]:.6f} s",
        )


@jit
def inertial_knots(
    lab_from_body_wxyz: Floats,
    rate_body_rad_s: Floats,
    position_m: Floats,
    gravity_m_s2: float,
    earth_rate: Floats,
) -> Floats:
    """(K, 6) inertial rate w and specific force w x (w x r) - g_body at every knot, in body axes."""
    knots = np.empty((len(rate_body_rad_s), 6))
    up = np.array([0.0, 0.0, gravity_m_s2])
    for k in range(len(knots)):
        body_from_lab = quaternion.inverse(lab_from_body_wxyz[k])
        # w = rate + body_from_lab earth_rate.
        rate = rate_body_rad_s[k] + quaternion.apply(body_from_lab, earth_rate)
        # w x (w x r) - g_body; a unit at rest feels +g upwards.
        centripetal = quaternion.cross(rate, quaternion.cross(rate, position_m))
        weight = quaternion.apply(body_from_lab, up)
        knots[k, :3] = rate
        knots[k, 3:] = centripetal + weight
    return knots


@jit
def integrate_intervals(
    t_s: Floats, knots: Floats, ends_s: Floats, step_s: float, position_m: Floats
) -> tuple[Floats, Floats]:
    """(N, 3) angle and (N, 3) velocity of every sample interval from the knots of `inertial_knots`.

    An interval is split at the knots. Each part is one cubic, which two Gauss points integrate exactly:
    int f dt = length / 2 (f(middle - g length) + f(middle + g length)), g = 1 / (2 sqrt 3).
    """
    angle = np.empty((len(ends_s), 3))
    velocity = np.empty((len(ends_s), 3))
    last = len(t_s) - 2
    for n in range(len(ends_s)):
        begin = ends_s[n] - step_s
        end = ends_s[n]
        first = min(max(np.searchsorted(t_s, begin, side="right") - 1, 0), last)
        # change = w(end) - w(begin), which is the integral of dw/dt.
        total = np.zeros(6)
        change = np.zeros(6)
        add_cubic(t_s, knots, first, begin, -1.0, change)
        # The parts of the interval, from knot to knot. The last cubic also extends beyond the last knot by rounding.
        for k in range(first, last + 1):
            stop = end if k == last else min(end, t_s[k + 1])
            middle = (begin + stop) / 2
            length = stop - begin
            add_cubic(t_s, knots, k, middle - GAUSS_OFFSET * length, length / 2, total)
            add_cubic(t_s, knots, k, middle + GAUSS_OFFSET * length, length / 2, total)
            begin = stop
            if stop >= end:
                break
        add_cubic(t_s, knots, k, end, 1.0, change)
        # The tangential part of the specific force, int dw/dt x r dt.
        angle[n] = total[:3]
        velocity[n] = total[3:] + quaternion.cross(change[:3], position_m)
    return angle, velocity


@jit
def add_cubic(
    t_s: Floats, knots: Floats, k: int, at_s: float, factor: float, out: Floats
) -> None:
    """Add to out (C,) factor times the value at at_s of the Lagrange cubic through the four knots nearest to step k.

        p(t) = sum_i f_i prod_(j != i) (t - t_j) / (t_i - t_j)

    If there are fewer than four knots, the polynomial goes through all of them.
    """
    # The knots k - 1 to k + 2, shifted inwards at both ends.
    count = min(CUBIC_POINTS, len(t_s))
    first = min(max(k - 1, 0), len(t_s) - count)
    for i in range(first, first + count):
        weight = factor
        for j in range(first, first + count):
            if j != i:
                weight *= (at_s - t_s[j]) / (t_s[i] - t_s[j])
        for c in range(len(out)):
            out[c] += weight * knots[i, c]


class Triad:
    """Three orthogonal sensors of one kind and their errors, in SI units, from standard normal draws.

    The unit x of an increment is rad for gyros and m/s for accelerometers. The square of an accelerometer's noise
    density in ug/sqrt(Hz) is the variance of a mean over 1 s.

    Parameters
    ----------
    config
        The gyros or the accelerometers of the scene's IMU
    hardware
        (4, 3) draws of the fixed errors: bias, then the rows of the response matrix
    start
        (3,) draws of the initial Gauss-Markov bias

    Attributes
    ----------
    matrix
        (3, 3) response of each sensor to motion along each body axis: 1 + scale error on the diagonal, the
        misalignment of sensor i towards axis j at [i, j]
    turn_on_bias
        (3,) constant bias, x/s
    markov_bias
        (3,) Gauss-Markov bias (bias instability), x/s; a state
    markov_sd
        Standard deviation of the Gauss-Markov bias, x/s
    markov_time_s
        Correlation time of the Gauss-Markov bias
    white
        Random walk of the integral, x/sqrt(s)
    limit
        Input at which the output saturates, x/s
    quantum
        Size of one count, x; 0 for no quantization
    remainder
        (3,) input not yet counted, x; a state
    """

    def __init__(
        self, config: GyroConfig | AccelerometerConfig, hardware: Floats, start: Floats
    ) -> None:
        if isinstance(config, GyroConfig):
            turn_on = DEG_H_RAD_S * scaled_errors(config.turn_on_bias_deg_h, hardware[0])
            self.markov_sd = config.bias_deg_h * DEG_H_RAD_S
            self.white = math.radians(config.arw_deg_sqrt_h) / 60
            self.limit = math.radians(config.rate_limit_deg_s)
            self.quantum = math.radians(config.quantum_arcsec / 3600)
        else:
            ug = PPM * STANDARD_GRAVITY_M_S2  # a micro-g in m/s2
            turn_on = ug * scaled_errors(config.turn_on_bias_ug, hardware[0])
            self.markov_sd = config.bias_ug * ug
            self.white = config.vrw_ug_sqrt_hz * ug
            self.limit = config.limit_g * STANDARD_GRAVITY_M_S2
            self.quantum = 1e-6 * config.quantum_um_s
        # 1 + scale error on the diagonal, the sensors' misalignments off it.
        scale = PPM * scaled_errors(config.scale_ppm, hardware[1:])
        tilt_rad = ARCSEC_RAD * scaled_errors(config.misalignment_arcsec, hardware[1:])
        self.matrix = np.eye(3) + np.where(np.eye(3) > 0, scale, tilt_rad)
        self.turn_on_bias = turn_on
        self.markov_bias = self.markov_sd * start
        self.markov_time_s = config.bias_time_s
        self.remainder = np.zeros(3)

    def measure(self, ideal: Floats, step_s: float, normal: Floats) -> tuple[Floats, Bools]:
        """(N, 3) measured increments, and (N,) whether one was limited; see `corrupt`.

        Parameters
        ----------
        ideal
            (N, 3) ideal increments
        step_s
            Length of the intervals
        normal
            (N, 6) standard normal draws: white noise, then innovations of the Gauss-Markov biases
        """
        # A step of the Gauss-Markov process: decay exp(-h / tau), innovation sd sqrt(1 - exp(-2 h / tau)).
        decay = math.exp(-step_s / self.markov_time_s)
        innovation = self.markov_sd * math.sqrt(-math.expm1(-2 * step_s / self.markov_time_s))
        return corrupt(
            ideal,
            self.matrix,
            self.turn_on_bias,
            self.markov_bias,
            self.remainder,
            normal,
            (
                step_s,
                decay,
                innovation,
                self.white * math.sqrt(step_s),
                self.limit * step_s,
                self.quantum,
            ),
        )


@jit
def corrupt(
    ideal: Floats,
    matrix: Floats,
    turn_on_bias: Floats,
    markov_bias: Floats,
    remainder: Floats,
    normal: Floats,
    parameters: tuple[float, float, float, float, float, float],
) -> tuple[Floats, Bools]:
    """Apply the sensor errors to increments (N, 3); markov_bias and remainder (3,) are updated in place.

    1. b_n = decay b_(n-1) + innovation z, exact for a Gauss-Markov process (Gelb 1974, ch. 3; `assumed`)
    2. x_n = matrix ideal_n + (turn_on_bias + b_n) step + white z'
    3. Clip x_n to +-limit; the clipped part is lost.
    4. Quantize; the remainder is carried to the next sample.

    Parameters
    ----------
    normal
        (N, 6) standard normal draws z' and z
    parameters
        Interval in s, decay, innovation, white noise, limit and quantum of one increment

    Returns
    -------
    (N, 3) measured increments, and (N,) whether one was limited
    """
    step, decay, innovation, white, limit, quantum = parameters
    counted = np.empty(ideal.shape)
    limited = np.zeros(len(ideal), dtype=np.bool_)
    for n in range(len(ideal)):
        for i in range(3):
            # 1. Gauss-Markov bias.
            markov_bias[i] = decay * markov_bias[i] + innovation * normal[n, 3 + i]
            # 2. Scale, misalignment, bias and white noise.
            x = (
                matrix[i, 0] * ideal[n, 0]
                + matrix[i, 1] * ideal[n, 1]
                + matrix[i, 2] * ideal[n, 2]
            )
            x += (turn_on_bias[i] + markov_bias[i]) * step + white * normal[n, i]
            # 3. Saturation.
            if abs(x) > limit:
                x = math.copysign(limit, x)
                limited[n] = True
            # 4. Quantization.
            if quantum > 0:
                remainder[i] += x
                x = quantum * np.rint(remainder[i] / quantum)
                remainder[i] -= x
            counted[n, i] = x
    return counted, limited


class Imu:
    """An inertial measurement unit with its fixed errors and its states (biases, remainders).

    At first it is the unit of the scene's hardware_seed at turn-on; its Gauss-Markov biases start in their stationary
    distribution.

    Twelve numbers are drawn per sample, whichever errors are on. A run split into pieces therefore equals one run bit
    for bit, and switching one error does not change the others.
    """

    def __init__(self, config: ImuConfig, rng: Generator) -> None:
        # Fixed errors have the seed of the unit, states that of the run: gyros first, then accelerometers.
        hardware = random_stream(config.hardware_seed).standard_normal((2, 4, 3))
        start = rng.standard_normal((2, 3))
        self.gyro = Triad(config.gyro, hardware[0], start[0])
        self.accelerometer = Triad(config.accelerometer, hardware[1], start[1])
        self.rng = rng

    def measure(self, ideal: Increments) -> Increments:
        """The unit's output for the next samples of `ideal_increments`."""
        normal = self.rng.standard_normal((len(ideal.t_s), 2, 6))
        angle, saturated = self.gyro.measure(ideal.angle_rad, ideal.step_s, normal[:, 0])
        velocity, overloaded = self.accelerometer.measure(
            ideal.velocity_m_s, ideal.step_s, normal[:, 1]
        )
        return Increments(ideal.t_s, ideal.step_s, angle, velocity, saturated, overloaded)

    @property
    def gyro_bias_rad_s(self) -> Floats:
        """(3,) gyro bias, turn-on plus Gauss-Markov part, at the last sample; initially that at turn-on."""
        return self.gyro.turn_on_bias + self.gyro.markov_bias


class Navigator:
    """Inertial navigator: integrates the gyro increments from the attitude at which the vehicle was zeroed.

    Attributes
    ----------
    lab_from_body_wxyz
        (4,) estimated attitude, at first that of the home position
    earth_rate_lab_rad_s
        (3,) Earth rate to compensate; with zeros the Earth's rotation appears as one of the vehicle
    """

    def __init__(
        self, lab_from_body_wxyz: Floats, earth_rate_lab_rad_s: Floats = NO_RATE
    ) -> None:
        start = np.asarray(lab_from_body_wxyz, dtype=float)
        self.lab_from_body_wxyz = start / np.linalg.norm(start)
        self.earth_rate_lab_rad_s = earth_rate_lab_rad_s

    def add(self, increments: Increments) -> None:
        """Integrate the next samples, in order; see `integrate_attitude`."""
        self.lab_from_body_wxyz = integrate_attitude(
            self.lab_from_body_wxyz,
            increments.angle_rad,
            self.earth_rate_lab_rad_s,
            increments.step_s,
        )


@jit
def integrate_attitude(
    lab_from_body_wxyz: Floats, angle_rad: Floats, earth_rate: Floats, step_s: float
) -> Floats:
    """(4,) attitude after (N, 3) increments:

        lab_from_body <- exp(-earth_rate step) lab_from_body exp(angle)

    The left factor is the rotation of the lab, in lab axes. The Earth rate is therefore compensated continuously and
    not at the attitude of the sample's start. Each increment is taken as a rotation vector; if the axis moves within
    a sample, the error is half the integral of angle x rate (coning; `assumed`).
    """
    # The lab rotates with the Earth, so the vehicle rotates backwards in it.
    lab_now_from_before = quaternion.from_rotvec(-step_s * earth_rate)
    attitude = lab_from_body_wxyz
    for n in range(len(angle_rad)):
        attitude = quaternion.multiply(
            lab_now_from_before,
            quaternion.multiply(attitude, quaternion.from_rotvec(angle_rad[n])),
        )
        # Normalization prevents a drift of the norm.
        attitude = attitude / math.sqrt((attitude**2).sum())
    return attitude


def tilt_rad(velocity_m_s: Floats) -> tuple[float, float]:
    """(roll, pitch) of a vehicle at rest from velocity increments (N, 3) of its accelerometers.

    The specific force points up. In body axes it is g (-sin pitch, sin roll cos pitch, cos roll cos pitch).
    """
    x, y, z = map(float, np.mean(velocity_m_s, axis=0))
    return math.atan2(y, z), math.atan2(-x, math.hypot(y, z))
