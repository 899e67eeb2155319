"""The inertial measurement unit: ideal increments against closed forms, each error against its theory.

Allan deviations are overlapped ones by the textbook (IEEE Std 952), from the angle theta, m samples of step to tau:
sigma^2(tau) = mean of (theta_(k+2m) - 2 theta_(k+m) + theta_k)^2 / (2 tau^2). Their own relative scatter over a run
of N is 1 / sqrt(2 edf) with edf = 1.5 N / m for white noise and no less than N / m - 2 for what is smoother.
"""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from scipy.integrate import quad_vec
from scipy.spatial.transform import Rotation

from skysim.core.constants import EARTH_RATE_RAD_S, STANDARD_GRAVITY_M_S2
from skysim.core.errors import InputError
from skysim.core.types import Floats
from skysim.dynamics.imu import (
    Imu,
    Increments,
    Navigator,
    Triad,
    earth_rate_lab_rad_s,
    ideal_increments,
    tilt_rad,
)
from skysim.scene.sections.vehicle import ImuConfig, SiteConfig

G = 9.80665
DEG_H = np.radians(1) / 3600
ARCSEC = np.radians(1 / 3600)
STEP = 2.5e-3
PLACE = np.array([0.1, -0.2, 0.3])
EARTH = earth_rate_lab_rad_s(SiteConfig())  # the thesis's lab: 39.8 N, x east, y north
TILTED = Rotation.from_euler("ZYX", [70.0, -20.0, 25.0], degrees=True)

QUIET_GYRO: dict[str, Any] = dict.fromkeys(
    (
        "arw_deg_sqrt_h",
        "bias_deg_h",
        "turn_on_bias_deg_h",
        "scale_ppm",
        "misalignment_arcsec",
        "quantum_arcsec",
    ),
    0.0,
)
QUIET_ACCELEROMETER: dict[str, Any] = dict.fromkeys(
    (
        "vrw_ug_sqrt_hz",
        "bias_ug",
        "turn_on_bias_ug",
        "scale_ppm",
        "misalignment_arcsec",
        "quantum_um_s",
    ),
    0.0,
)


def euler_deg(navigator: Navigator) -> np.ndarray:
    """(3,) roll, pitch, yaw."""
    attitude = Rotation.from_quat(navigator.lab_from_body_wxyz, scalar_first=True)
    return attitude.as_euler("ZYX", degrees=True)[::-1]


def part(
    gyro: dict[str, Any] | None = None,
    accelerometer: dict[str, Any] | None = None,
    seed: int = 200,
) -> ImuConfig:
    """A unit with only the named errors."""
    return ImuConfig.model_validate(
        {
            "gyro": QUIET_GYRO | (gyro or {}),
            "accelerometer": QUIET_ACCELEROMETER | (accelerometer or {}),
            "hardware_seed": seed,
        }
    )


def unit(gyro: dict[str, Any] | None = None, seed: int = 200, draws: int = 1) -> Imu:
    return Imu(part(gyro, seed=seed), np.random.default_rng(draws))


def samples(
    angle: Floats, velocity: Floats | None = None, step_s: float = STEP
) -> Increments:
    count = len(angle)
    rest = np.zeros((count, 3)) if velocity is None else velocity
    fine = np.zeros(count, bool)
    return Increments(step_s * np.arange(1, count + 1), step_s, angle, rest, fine, fine)


def steady(rate: Any, count: int, step_s: float = STEP) -> Increments:
    """A constant rate about a body-fixed axis, in free fall."""
    return samples(np.tile(np.array(rate, float) * step_s, (count, 1)), step_s=step_s)


def wxyz(rotation: Rotation) -> Floats:
    return np.asarray(rotation.as_quat(scalar_first=True))


def still(attitude: Rotation, seconds: float, step_s: float, earth: Floats) -> Increments:
    """Ideal increments of a unit on a vehicle at rest in the lab."""
    knots = np.arange(0, seconds + 1.5, 1.0)
    ends = step_s * np.arange(1, round(seconds / step_s) + 1)
    attitudes = np.tile(wxyz(attitude), (len(knots), 1))
    return ideal_increments(
        knots, attitudes, np.zeros((len(knots), 3)), ends, step_s, PLACE, G, earth
    )


class Cone:
    """A coning motion whose z axis moves on a cone of half-angle a: lab_from_body = exp(a (cos wt, sin wt, 0)).

    2 conj(q) dq/dt is its rate in its own axes: w (-sin a sin wt, sin a cos wt, cos a - 1).
    """

    half = 0.3
    w = 25.0

    def attitude(self, t: Any) -> Rotation:
        t = np.asarray(t)
        return Rotation.from_rotvec(
            self.half * np.stack([np.cos(self.w * t), np.sin(self.w * t), 0 * t], axis=-1)
        )

    def rate(self, t: Any) -> Floats:
        t = np.asarray(t)
        flat = np.sin(self.half)
        along = np.cos(self.half) - 1
        return self.w * np.stack(
            [-flat * np.sin(self.w * t), flat * np.cos(self.w * t), along + 0 * t], axis=-1
        )

    def angle(self, t: Any) -> Floats:
        t = np.asarray(t)
        flat = np.sin(self.half)
        along = np.cos(self.half) - 1
        return np.stack(
            [flat * np.cos(self.w * t), flat * np.sin(self.w * t), along * self.w * t],
            axis=-1,
        )

    def acceleration(self, t: Any) -> Floats:
        t = np.asarray(t)
        return (
            -np.sin(self.half)
            * self.w**2
            * np.stack([np.cos(self.w * t), np.sin(self.w * t), 0 * t], axis=-1)
        )

    def felt(
        self, knots: Floats, ends: Floats, earth: Floats, step_s: float = STEP
    ) -> Increments:
        return ideal_increments(
            knots, wxyz(self.attitude(knots)), self.rate(knots), ends, step_s, PLACE, G, earth
        )


CONE = Cone()


# --- the Earth


def test_the_earth_rate_matches_a_hand_calculation() -> None:
    """sin and cos of 39.8 deg of 15.041 deg/h: 9.63 up, 11.56 north."""
    # With x east, y is north; with x north, y is west.
    up_north_of = {90.0: (2, 1, 0), 0.0: (2, 0, 1)}
    for azimuth, (up, north, across) in up_north_of.items():
        rate = (
            earth_rate_lab_rad_s(SiteConfig(latitude_deg=39.8, x_azimuth_deg=azimuth)) / DEG_H
        )
        np.testing.assert_allclose(
            rate[[up, north, across]], [9.63, 11.56, 0.0], rtol=0, atol=0.005
        )
        np.testing.assert_allclose(np.linalg.norm(rate), 15.041, rtol=0, atol=5e-4)


@pytest.mark.parametrize("latitude", [-90.0, -33.0, 0.0, 39.8])
@pytest.mark.parametrize("azimuth", [0.0, 37.0, 90.0, -120.0])
def test_the_earth_rate_is_along_the_pole(latitude: float, azimuth: float) -> None:
    """Lab axes made in the Earth's own frame, z to the pole: x, up and their product, at longitude 0."""
    phi = np.radians(latitude)
    a = np.radians(azimuth)
    up = np.array([np.cos(phi), 0, np.sin(phi)])
    north = np.array([-np.sin(phi), 0, np.cos(phi)])
    east = np.array([0.0, 1.0, 0.0])
    x = np.cos(a) * north + np.sin(a) * east
    pole_lab = np.stack([x, np.cross(up, x), up]) @ [0, 0, 1]
    rate = earth_rate_lab_rad_s(SiteConfig(latitude_deg=latitude, x_azimuth_deg=azimuth))
    np.testing.assert_allclose(rate, EARTH_RATE_RAD_S * pole_lab, rtol=0, atol=1e-19)


ATTITUDES = [Rotation.identity(), TILTED, Rotation.from_rotvec([1.0, 2.0, -0.5])]


@pytest.mark.compiles
@pytest.mark.parametrize("attitude", ATTITUDES)
def test_uncompensated_earth_rate_rotates_a_still_vehicle_s_navigator(
    attitude: Rotation,
) -> None:
    """An hour: 15.04 deg about the Earth's own axis, whatever the vehicle's attitude."""
    navigator = Navigator(wxyz(attitude))
    navigator.add(still(attitude, 3600.0, 0.1, EARTH))
    believed = Rotation.from_quat(navigator.lab_from_body_wxyz, scalar_first=True)
    drift = (believed * attitude.inv()).as_rotvec(degrees=True)
    np.testing.assert_allclose(drift, [0.0, 11.556, 9.628], rtol=0, atol=1e-3)
    np.testing.assert_allclose(np.linalg.norm(drift), 15.041, rtol=0, atol=1e-3)


@pytest.mark.compiles
@pytest.mark.parametrize("attitude", ATTITUDES)
def test_compensated_earth_rate_keeps_a_still_vehicle_s_attitude(attitude: Rotation) -> None:
    navigator = Navigator(wxyz(attitude), EARTH)
    navigator.add(still(attitude, 3600.0, 0.1, EARTH))
    believed = Rotation.from_quat(navigator.lab_from_body_wxyz, scalar_first=True)
    assert (believed * attitude.inv()).magnitude() < 1e-11


@pytest.mark.compiles
def test_compensation_holds_on_a_turning_vehicle() -> None:
    """20 s at 20 deg/s: what is left is the swing of the Earth rate in the body, Omega (w dt)^2 / 12 for 20 s: 1e-10.

    Taken away in the axes of each sample's start it would be w dt / 2 of the Earth rate, 1e-7.
    """
    knots = np.arange(0, 20.0005, 1e-3)
    ends = STEP * np.arange(1, 8001)
    rate = np.array([0.2, -0.2, 0.2])
    attitude = TILTED * Rotation.from_rotvec(knots[:, None] * rate)
    navigator = Navigator(wxyz(TILTED), EARTH)
    navigator.add(
        ideal_increments(
            knots, wxyz(attitude), np.tile(rate, (20001, 1)), ends, STEP, PLACE, G, EARTH
        )
    )
    believed = Rotation.from_quat(navigator.lab_from_body_wxyz, scalar_first=True)
    assert (believed * attitude[-1].inv()).magnitude() < 5e-10


def test_the_thesiss_error_takes_minutes_of_uncompensated_earth() -> None:
    """reference.md 1.3: 0.716 deg of the horizontal 11.56 deg/h take 3.7 min; about north, which is pitch here."""
    navigator = Navigator(wxyz(Rotation.identity()))
    navigator.add(still(Rotation.identity(), 3.7 * 60, 0.1, EARTH))
    roll, pitch, yaw = euler_deg(navigator)
    np.testing.assert_allclose([roll, pitch, yaw], [0, 0.713, 0.594], rtol=0, atol=0.005)


# --- what is felt


def test_a_constant_rate_is_integrated_between_the_knots() -> None:
    rate = np.array([0.3, -0.2, 0.5])
    knots = np.arange(0, 0.101, 1e-3)
    attitude = TILTED * Rotation.from_rotvec(knots[:, None] * rate)
    got = ideal_increments(
        knots,
        wxyz(attitude),
        np.tile(rate, (101, 1)),
        np.array([0.0033, 0.05, 0.0999]),
        0.0031,
        PLACE,
        G,
    )
    np.testing.assert_allclose(got.angle_rad, np.tile(rate * 0.0031, (3, 1)), rtol=1e-13)
    assert not got.saturated.any()


def test_coning_motion_has_its_closed_form_increments() -> None:
    """Off by what a cubic leaves: 11/720 (w h)^4 of the rate, 6e-9, and less as the errors alternate."""
    knots = np.arange(0, 1.0005, 1e-3)
    ends = np.arange(1, 400) * STEP + 0.0004
    got = CONE.felt(knots, ends, np.zeros(3))
    np.testing.assert_allclose(
        got.angle_rad, CONE.angle(ends) - CONE.angle(ends - STEP), rtol=0, atol=2e-10
    )


def cone_by_quadrature(ends: Floats, earth: Floats) -> tuple[Floats, Floats]:
    """Angle and velocity by adaptive quadrature of the analytic motion; the acceleration is explicit here."""

    def both(t: float) -> Floats:
        body_from_lab = CONE.attitude(t).inv()
        turning = body_from_lab.apply(earth)
        w = CONE.rate(t) + turning
        alpha = CONE.acceleration(t) - np.cross(CONE.rate(t), turning)
        force = (
            np.cross(alpha, PLACE)
            + np.cross(w, np.cross(w, PLACE))
            + body_from_lab.apply([0, 0, G])
        )
        return np.concatenate([w, force])

    total = np.array(
        [quad_vec(both, end - STEP, end, epsabs=1e-15, epsrel=1e-13)[0] for end in ends]
    )
    return total[:, :3], total[:, 3:]


@pytest.mark.parametrize(
    "earth", [np.zeros(3), EARTH, 1e4 * EARTH], ids=["space", "Earth", "a faster Earth"]
)
def test_coning_increments_match_quadrature(earth: Floats) -> None:
    """An Earth ten thousand times faster shows what the lab's turning does to the force.

    The last end is in the last cell, whose one-sided cubic is off by 0.04 (w h)^4 = 1e-9 of the rate.
    """
    ends = np.array([0.0071, 0.02, 0.0333, 0.0499])
    angle, velocity = cone_by_quadrature(ends, earth)
    got = CONE.felt(np.arange(0, 0.0505, 5e-4), ends, earth)
    np.testing.assert_allclose(got.angle_rad, angle, rtol=0, atol=3e-11)
    np.testing.assert_allclose(got.velocity_m_s, velocity, rtol=0, atol=5e-9)


def test_the_increments_are_of_fourth_order_in_the_knot_spacing() -> None:
    """Half the spacing, a sixteenth of the error; half a power is left to chance."""
    ends = np.array([0.0671, 0.12, 0.1333, 0.1499])
    errors = []
    angle, velocity = cone_by_quadrature(ends, 1e4 * EARTH)
    for spacing in (8e-3, 4e-3, 2e-3):
        got = CONE.felt(np.arange(0, 0.2, spacing), ends, 1e4 * EARTH)
        errors.append(
            [np.abs(got.angle_rad - angle).max(), np.abs(got.velocity_m_s - velocity).max()]
        )
    order = np.log2(np.array(errors[:-1]) / np.array(errors[1:]))
    assert (order > 3.5).all()


@pytest.mark.parametrize("count", [2, 3, 4, 7])
def test_few_or_uneven_knots_give_exact_increments(count: int) -> None:
    """A rate that is a polynomial of one degree less than the knots, three at most, is integrated exactly."""
    knots = np.array([0.0, 0.3, 0.45, 1.1, 1.2, 1.9, 2.0])[:count]
    degree = min(count, 4) - 1
    rate = np.polynomial.Polynomial(np.array([0.3, -0.7, 1.1, 0.9])[: degree + 1])
    ends = knots[-1] * np.array([0.4, 0.73, 1.0])
    step_s = 0.35 * float(knots[-1])
    rates = rate(knots)[:, None] * np.array([1.0, -2.0, 0.5])
    got = ideal_increments(
        knots, np.tile([1.0, 0, 0, 0], (count, 1)), rates, ends, step_s, PLACE, G
    )
    whole = rate.integ()
    np.testing.assert_allclose(
        got.angle_rad[:, 0], whole(ends) - whole(ends - step_s), rtol=0, atol=1e-14
    )


def test_sampling_a_flight_tick_by_tick_equals_sampling_it_at_once() -> None:
    """Cells at the ends of a tick have one-sided cubics, 30/720 (w h)^4 of 7 rad/s apart: 1e-7 rad/s for 1 ms."""
    knots = np.arange(0, 501) * 1e-3
    ends = np.arange(1, 201) * STEP
    whole = CONE.felt(knots, ends, EARTH)
    ticks = [
        CONE.felt(knots[10 * k : 10 * k + 11], ends[4 * k : 4 * k + 4], EARTH)
        for k in range(50)
    ]
    for name, bar in (("angle_rad", 2.5e-10), ("velocity_m_s", 5e-9)):
        joined = np.concatenate([getattr(tick, name) for tick in ticks])
        np.testing.assert_allclose(joined, getattr(whole, name), rtol=0, atol=bar)


def test_a_jump_of_the_torque_has_the_stated_error() -> None:
    """Acceleration 2 rad/s2 sets in at a knot: the two cubics over the corner give h^2 / 12 of it too little."""
    knots = np.arange(0, 21) * 1e-3
    h = 1e-3
    rate = 2.0 * np.maximum(knots - 0.01, 0.0)[:, None] * np.array([0.0, 0.0, 1.0])
    none = np.tile([1.0, 0.0, 0.0, 0.0], (21, 1))
    got = ideal_increments(knots, none, rate, np.array([0.02]), 0.02, PLACE, G)
    np.testing.assert_allclose(
        got.angle_rad[0, 2] - 2.0 * 0.01**2 / 2, -2.0 * h**2 / 12, rtol=1e-6
    )


def test_at_rest_the_specific_force_is_g_upwards() -> None:
    for attitude in ATTITUDES:
        got = still(attitude, 2.0, 0.1, np.zeros(3))
        up_body = attitude.inv().apply([0, 0, 1])
        np.testing.assert_allclose(
            got.velocity_m_s / 0.1, np.tile(G * up_body, (20, 1)), rtol=0, atol=1e-12
        )
        np.testing.assert_array_equal(got.angle_rad, 0)


def test_an_accelerometer_on_a_lever_measures_the_centripetal_force() -> None:
    """60 deg/s about z, 0.2 m off it: w^2 r = 0.219 m/s2 inwards, by hand."""
    knots = np.arange(0, 1.001, 1e-3)
    spin = np.tile([0, 0, np.radians(60)], (len(knots), 1))
    attitude = Rotation.from_rotvec(knots[:, None] * spin)
    got = ideal_increments(
        knots, wxyz(attitude), spin, np.array([0.5]), STEP, (0.2, 0.0, 0.7), G
    )
    np.testing.assert_allclose(
        got.velocity_m_s[0] / STEP, [-0.219325, 0, G], rtol=0, atol=1e-6
    )


def test_an_accelerometer_on_a_lever_measures_the_angular_acceleration() -> None:
    """1 rad/s2 about z from rest, 0.2 m out on x: 0.2 m/s2 along y."""
    knots = np.arange(0, 0.0105, 1e-3)
    spin = knots[:, None] * np.array([0.0, 0.0, 1.0])
    attitude = Rotation.from_rotvec(knots[:, None] * spin / 2)
    got = ideal_increments(
        knots, wxyz(attitude), spin, np.array([0.0093]), STEP, (0.2, 0.0, 0.0), G
    )
    np.testing.assert_allclose(got.velocity_m_s[0, 1] / STEP, 0.2, rtol=1e-12)


@pytest.mark.parametrize("ends", [[0.0024], [0.0101], [0.005, np.nan], [0.005, 0.02]])
def test_samples_outside_the_flight_are_refused(ends: list[float]) -> None:
    with pytest.raises(
        InputError,
        match=r"^imu: samples from .* allowed: within the motion, 0\.000000 to 0\.010000 s$",
    ):
        CONE.felt(np.arange(11) * 1e-3, np.array(ends), np.zeros(3))


def test_one_knot_is_refused_and_no_samples_give_an_empty_result() -> None:
    with pytest.raises(InputError, match=r"^imu: 1 samples .* allowed: two or more$"):
        CONE.felt(np.zeros(1), np.array([0.0]), np.zeros(3))
    assert CONE.felt(np.arange(11) * 1e-3, np.zeros(0), np.zeros(3)).angle_rad.shape == (0, 3)


# --- the unit's errors


def test_without_errors_the_imu_is_exact() -> None:
    """Zero parameters leave every bit."""
    ideal = CONE.felt(np.arange(0, 1.0005, 1e-3), np.arange(1, 401) * STEP, EARTH)
    got = Imu(part(), np.random.default_rng(1)).measure(ideal)
    np.testing.assert_array_equal(got.angle_rad, ideal.angle_rad)
    np.testing.assert_array_equal(got.velocity_m_s, ideal.velocity_m_s)
    np.testing.assert_array_equal(got.t_s, ideal.t_s)
    assert not got.saturated.any()


@pytest.mark.parametrize("pieces", [1, 3, 400])
def test_measuring_in_pieces_equals_measuring_at_once(pieces: int) -> None:
    ideal = CONE.felt(np.arange(0, 3.0005, 1e-3), np.arange(1, 1201) * STEP, EARTH)
    whole = Imu(ImuConfig(), np.random.default_rng(5)).measure(ideal)
    again = Imu(ImuConfig(), np.random.default_rng(5))
    got = [
        again.measure(
            replace(
                ideal,
                t_s=ideal.t_s[k],
                angle_rad=ideal.angle_rad[k],
                velocity_m_s=ideal.velocity_m_s[k],
            )
        )
        for k in np.array_split(np.arange(1200), pieces)
    ]
    for name in ("angle_rad", "velocity_m_s", "saturated"):
        np.testing.assert_array_equal(
            np.concatenate([getattr(one, name) for one in got]), getattr(whole, name)
        )


def test_noise_and_hardware_errors_have_separate_seeds() -> None:
    """The same unit with other noise keeps its axes and turn-on bias; another unit with the same noise does not."""
    first = unit(scale_etc(), 200, 1)
    noisy = unit(scale_etc(), 200, 2)
    other = unit(scale_etc(), 201, 1)
    still_run = steady([0, 0, 0], 1000)
    np.testing.assert_array_equal(first.gyro.matrix, noisy.gyro.matrix)
    np.testing.assert_array_equal(first.gyro.turn_on_bias, noisy.gyro.turn_on_bias)
    assert not np.isclose(first.gyro.matrix, other.gyro.matrix, rtol=0, atol=1e-9).any()
    noise = [
        one.measure(still_run).angle_rad - STEP * one.gyro.turn_on_bias
        for one in (first, noisy, other)
    ]
    np.testing.assert_allclose(noise[0], noise[2], rtol=0, atol=1e-18)
    assert np.abs(np.corrcoef(noise[0].ravel(), noise[1].ravel())[0, 1]) < 4 / np.sqrt(3000)


def scale_etc() -> dict[str, Any]:
    return {
        "scale_ppm": 100,
        "misalignment_arcsec": 20,
        "turn_on_bias_deg_h": 1,
        "arw_deg_sqrt_h": 0.07,
    }


def test_a_further_error_does_not_change_the_noise() -> None:
    quiet = unit({"arw_deg_sqrt_h": 0.07}).measure(steady([0, 0, 0], 50)).angle_rad
    biased = unit({"arw_deg_sqrt_h": 0.07, "bias_deg_h": 1.0, "bias_time": "1e9 s"})
    got = biased.measure(steady([0, 0, 0], 50)).angle_rad - STEP * biased.gyro_bias_rad_s
    np.testing.assert_allclose(got, quiet, rtol=0, atol=1e-12)


@pytest.mark.slow
def test_turn_on_errors_of_units_scatter_as_declared() -> None:
    """2000 units: a standard deviation is sure to 1/sqrt(2 n), a mean to sigma/sqrt(n); 4 sigma of each."""
    many = [
        Imu(ImuConfig(hardware_seed=seed), np.random.default_rng(0)) for seed in range(2000)
    ]
    turn_on = np.array([one.gyro.turn_on_bias for one in many]) / DEG_H
    axes = np.array([one.gyro.matrix for one in many]) - np.eye(3)
    scale = axes[:, np.eye(3) > 0] / 1e-4
    tilt = axes[:, np.eye(3) == 0] / (20 * ARCSEC)
    push = np.array([one.accelerometer.turn_on_bias for one in many]) / (
        300e-6 * STANDARD_GRAVITY_M_S2
    )
    for drawn in (turn_on, scale, tilt, push):
        n = drawn.shape[0]
        assert (np.abs(drawn.std(axis=0) - 1) < 4 / np.sqrt(2 * n)).all()
        assert (np.abs(drawn.mean(axis=0)) < 4 / np.sqrt(n)).all()
        between = np.corrcoef(drawn.T) - np.eye(drawn.shape[1])
        assert np.abs(between).max() < 5 / np.sqrt(n)  # tens of pairs


def test_scale_errors_are_on_the_diagonal_and_misalignments_off_it() -> None:
    normal = np.random.default_rng(4).normal(size=(3, 3))
    config = part({"scale_ppm": 500, "misalignment_arcsec": 30}).gyro
    draws = np.vstack([np.zeros(3), normal])
    errors = Triad(config, draws, np.zeros(3)).matrix - np.eye(3)
    np.testing.assert_allclose(np.diag(errors), 500e-6 * np.diag(normal), rtol=1e-9)
    off = ~np.eye(3, dtype=bool)
    np.testing.assert_allclose(errors[off], 30 * ARCSEC * normal[off], rtol=1e-12)


def test_scale_and_misalignment_change_a_known_rotation_as_declared() -> None:
    """A whole turn about body y: sensor y counts 360 deg (1 + scale), x and z their tilt towards y times 360 deg."""
    one = unit({"scale_ppm": 500, "misalignment_arcsec": 100})
    turn = np.radians([0, 36, 0])
    total = one.measure(steady(turn, 4000)).angle_rad.sum(axis=0)
    matrix = one.gyro.matrix
    np.testing.assert_allclose(total, 2 * np.pi * matrix[:, 1], rtol=1e-12)
    np.testing.assert_allclose(
        total[1] - 2 * np.pi, 2 * np.pi * (matrix[1, 1] - 1), rtol=1e-6
    )
    assert 0 < abs(matrix[1, 1] - 1) < 4 * 500e-6
    assert (np.abs(matrix[[0, 2], 1]) < 4 * 100 * ARCSEC).all()
    backwards = unit({"scale_ppm": 500, "misalignment_arcsec": 100}).measure(
        steady(-turn, 4000)
    )
    np.testing.assert_allclose(backwards.angle_rad.sum(axis=0), -total, rtol=1e-12)


def test_the_measured_rate_at_rest_is_the_bias() -> None:
    one = unit({"turn_on_bias_deg_h": 5.0, "bias_deg_h": 2.0})
    count = one.measure(steady([0, 0, 0], 1))
    np.testing.assert_allclose(count.angle_rad[0] / STEP, one.gyro_bias_rad_s, rtol=1e-14)
    np.testing.assert_allclose(
        one.gyro_bias_rad_s - one.gyro.turn_on_bias, one.gyro.markov_bias, rtol=0, atol=1e-18
    )


def test_accelerometer_errors_are_independent_of_gyro_errors() -> None:
    """At rest on the table: bias of a whole minute's mean is turn-on + wandering; gyros stay exact."""
    settings = {
        "turn_on_bias_ug": 300,
        "bias_ug": 50,
        "bias_time": "1e9 s",
        "scale_ppm": 300,
    }
    one = Imu(part(None, settings), np.random.default_rng(3))
    ideal = still(Rotation.identity(), 60.0, STEP, np.zeros(3))
    got = one.measure(ideal)
    np.testing.assert_array_equal(got.angle_rad, ideal.angle_rad)
    wanted = one.gyro.matrix  # of a gyro without errors: unity
    np.testing.assert_array_equal(wanted, np.eye(3))
    mean = got.velocity_m_s.mean(axis=0) / STEP
    up = one.accelerometer.matrix[2, 2] * G * np.array([0, 0, 1])
    np.testing.assert_allclose(
        mean - up, one.accelerometer.turn_on_bias + one.accelerometer.markov_bias, rtol=2e-4
    )
    assert abs(one.accelerometer.matrix[2, 2] - 1) < 4 * 300e-6


def test_a_rate_beyond_the_limit_reads_the_limit_and_leaves_an_attitude_error() -> None:
    """A second of 20 deg/s with a limit of 10, then a second of 5: ten of the 25 degrees are lost for good."""
    one = unit({"rate_limit_deg_s": 10})
    navigator = Navigator(wxyz(Rotation.identity()))
    fast = steady(np.radians([0, 0, 20]), 400)
    slow = steady(np.radians([0, 0, 5]), 400)
    cut = one.measure(fast)
    after = one.measure(slow)
    np.testing.assert_array_equal(
        cut.angle_rad, np.tile([0, 0, np.radians(10) * STEP], (400, 1))
    )
    assert cut.saturated.all()
    assert not after.saturated.any()
    np.testing.assert_array_equal(after.angle_rad, slow.angle_rad)
    navigator.add(cut)
    navigator.add(after)
    np.testing.assert_allclose(euler_deg(navigator), [0, 0, 15], rtol=0, atol=1e-10)
    assert (
        unit({"rate_limit_deg_s": 10})
        .measure(steady(np.radians([0, -20, 0]), 3))
        .angle_rad[:, 1]
        < 0
    ).all()


def test_gyros_and_accelerometers_have_separate_limits() -> None:
    below = unit({"rate_limit_deg_s": 10}).measure(steady(np.radians([9.99, -9.99, 0]), 5))
    assert not below.saturated.any()
    push = np.array([[0, 0, 0.5 * G], [0, 0, 3 * G], [0, -3 * G, 0]]) * STEP
    got = Imu(part(None, {"limit_g": 2}), np.random.default_rng(1)).measure(
        samples(0 * push, push)
    )
    np.testing.assert_array_equal(got.overloaded, [False, True, True])
    assert not got.saturated.any()
    np.testing.assert_allclose(
        got.velocity_m_s[1:, [2, 1]].diagonal(), [2 * G * STEP, -2 * G * STEP], rtol=1e-15
    )


def test_quantization_loses_no_angle() -> None:
    """Whole quanta come out, and their sum is the angle to half a quantum at all times."""
    quantum = 0.4 * ARCSEC
    one = unit({"quantum_arcsec": 0.4})
    ideal = CONE.felt(np.arange(0, 5.0005, 1e-3), np.arange(1, 2001) * STEP, EARTH)
    got = np.concatenate([one.measure(ideal).angle_rad, one.measure(ideal).angle_rad])
    counts = got / quantum
    np.testing.assert_allclose(counts, np.rint(counts), rtol=0, atol=1e-8)
    missed = np.cumsum(got - np.tile(ideal.angle_rad, (2, 1)), axis=0)
    assert np.abs(missed).max() < 0.5001 * quantum
    # Evenly spread, of 12,000.
    np.testing.assert_allclose(missed.std(), quantum / np.sqrt(12), rtol=0.02)


def test_a_rotation_below_one_count_is_counted_eventually() -> None:
    """1 deg/h is 0.0025 arcsec a sample, a count is 0.4 arcsec: one in 160 samples, 25 in 4000."""
    counted = unit({"quantum_arcsec": 0.4}).measure(steady([DEG_H, 0, 0], 4000)).angle_rad[
        :, 0
    ] / (0.4 * ARCSEC)
    assert np.count_nonzero(counted) == 25
    np.testing.assert_allclose(np.diff(np.flatnonzero(counted)), 160, rtol=0, atol=1)


def test_white_noise_has_the_declared_random_walk() -> None:
    """ARW^2 / dt, of both kinds of sensor, whatever the step; one in sqrt(2 n) is 0.2 % of 300,000 draws."""
    for step_s in (2.5e-3, 0.1):
        settings = part({"arw_deg_sqrt_h": 0.07}, {"vrw_ug_sqrt_hz": 50})
        run = steady([0, 0, 0], 100_000, step_s)
        got = Imu(settings, np.random.default_rng(7)).measure(run)
        rate_deg_h = got.angle_rad / step_s / DEG_H
        force_ug = got.velocity_m_s / step_s / G * 1e6
        np.testing.assert_allclose(rate_deg_h.std(), 0.07 * 60 / np.sqrt(step_s), rtol=6e-3)
        np.testing.assert_allclose(force_ug.std(), 50 / np.sqrt(step_s), rtol=6e-3)
        next_to = (rate_deg_h[1:] * rate_deg_h[:-1]).mean() / rate_deg_h.var()
        assert abs(next_to) < 4 / np.sqrt(300_000)


@pytest.mark.long
def test_the_bias_instability_is_stationary_from_the_start() -> None:
    """Over 4000 starts: variance sigma^2 at once and 300 s later, and exp(-1) of it between the two."""
    sigma = DEG_H
    first = []
    later = []
    for draws in range(4000):
        one = unit({"bias_deg_h": 1.0, "bias_time": "300.0 s"}, draws=draws)
        first.append(one.gyro_bias_rad_s)
        one.measure(steady([0, 0, 0], 3, step_s=100.0))  # the law is exact for any step
        later.append(one.gyro_bias_rad_s)
    a = np.array(first) / sigma
    b = np.array(later) / sigma
    bar = 4 / np.sqrt(12_000)
    assert abs(np.mean(a**2) - 1) < bar * np.sqrt(2)
    assert abs(np.mean(b**2) - 1) < bar * np.sqrt(2)
    assert abs(np.mean(a * b) - np.exp(-1)) < bar * np.sqrt(1 + np.exp(-2))


# --- Allan deviation


def allan(angle: Floats, step_s: float, tau_s: float) -> float:
    """Overlapped Allan deviation of the rate, of all axes together; angle (N, 3) increments."""
    m = round(tau_s / step_s)
    theta = np.concatenate([np.zeros((1, 3)), np.cumsum(angle, axis=0)])
    second = theta[2 * m :] - 2 * theta[m:-m] + theta[: -2 * m]
    return float(np.sqrt(np.mean(second**2) / 2) / (m * step_s))


def markov_allan(tau_s: Any, sigma: float, time_s: float) -> Any:
    """Of a Gauss-Markov process: with x = tau / T, sigma^2 / x^2 (2x - 3 + 4 exp(-x) - exp(-2x)) under the root.

    Allan variance = variance of a mean over tau - covariance with the next one. With R(t) = sigma^2 exp(-|t| / T)
    these are 2 sigma^2 / x^2 (x - 1 + exp(-x)) and sigma^2 / x^2 (1 - exp(-x))^2.
    """
    x = np.asarray(tau_s) / time_s
    return sigma / x * np.sqrt(2 * x - 3 + 4 * np.exp(-x) - np.exp(-2 * x))


def declared(gyro: Any, tau_s: float) -> float:
    """Of random walk, wandering bias and counter together, deg/h; the counter's error is white in the angle."""
    walk = gyro.arw_deg_sqrt_h * 60 / np.sqrt(tau_s)
    counter = np.sqrt(3 / 12) * gyro.quantum_arcsec / tau_s  # 1 arcsec/s is 1 deg/h
    return float(
        np.sqrt(
            walk**2 + markov_allan(tau_s, gyro.bias_deg_h, gyro.bias_time_s) ** 2 + counter**2
        )
    )


def test_the_theoretical_allan_deviation_of_the_bias_peaks_at_0617() -> None:
    """reference.md: 1 deg/h and 300 s peak at 0.617; and a mean over tau drawn from the exact covariance agrees."""
    tau = np.linspace(300, 900, 6001)
    peak = markov_allan(tau, 1.0, 300.0)
    np.testing.assert_allclose(peak.max(), 0.617, rtol=0, atol=5e-4)
    t = (np.arange(2000) + 0.5) / 1000  # two means of 1000 points over tau = T each
    sign = np.repeat([-1.0, 1.0], 1000) / 1000
    variance = sign @ np.exp(-np.abs(t[:, None] - t)) @ sign / 2
    np.testing.assert_allclose(markov_allan(300.0, 1.0, 300.0), np.sqrt(variance), rtol=1e-6)


@pytest.mark.slow
def test_allan_deviation_of_an_ln200_is_its_random_walk_at_one_second() -> None:
    """Forty minutes at 400 Hz with all its errors: ADEV 4.20 deg/h at 1 s (bar: 5 %).

    Scatter: 1 / sqrt(3 * 7500) = 0.7 % at 1 s of three axes, 2.1 % at 10 s.
    """
    gyro = ImuConfig().gyro
    angle = (
        Imu(ImuConfig(), np.random.default_rng(11))
        .measure(steady([0, 0, 0], 1_000_000))
        .angle_rad
        / DEG_H
    )
    np.testing.assert_allclose(allan(angle, STEP, 1.0), 4.20, rtol=0.03)
    for tau_s, scatter in ((0.1, 0.0021), (1.0, 0.0067), (10.0, 0.021)):
        np.testing.assert_allclose(
            allan(angle, STEP, tau_s), declared(gyro, tau_s), rtol=4 * scatter
        )


@pytest.mark.long
def test_the_allan_deviation_of_the_bias_peaks_as_theory_predicts() -> None:
    """Bias alone, 23 days in steps of 1 s: 0.617 sigma at 567 s (bar: 5 %).

    The process is exact at any step, and its mean over 1 s that of its ends to (1/300)^2 / 12. The scatter at
    567 s is at most 1 / sqrt(2 * 3 * 3500) = 0.7 %.
    """
    one = unit({"bias_deg_h": 1.0, "bias_time": "300.0 s"}, draws=12)
    angle = one.measure(steady([0, 0, 0], 2_000_000, step_s=1.0)).angle_rad / DEG_H
    np.testing.assert_allclose(allan(angle, 1.0, 567.0), 0.617, rtol=0.028)
    for tau_s in (60.0, 300.0, 567.0, 1500.0):
        scatter = 1 / np.sqrt(2 * 3 * 2e6 / tau_s)
        np.testing.assert_allclose(
            allan(angle, 1.0, tau_s), markov_allan(tau_s, 1.0, 300.0), rtol=4 * scatter
        )


@pytest.mark.long
def test_the_allan_deviation_of_a_long_run_at_400_hz_follows_theory() -> None:
    """An LN-200 with all its errors, a week at 400 Hz: random walk and bias at once, to 5 % at 1 s and at its peak.

    The scatter at 567 s is 1 / sqrt(2 * 3 * 1066) = 1.25 %.
    """
    one = Imu(ImuConfig(), np.random.default_rng(13))
    seconds = []
    run = steady([0, 0, 0], 400_000)
    for _ in range(605):
        seconds.append(one.measure(run).angle_rad.reshape(-1, 400, 3).sum(axis=1) / DEG_H)
    angle = np.concatenate(seconds)
    for tau_s in (1.0, 10.0, 100.0, 567.0):
        np.testing.assert_allclose(
            allan(angle, 1.0, tau_s), declared(ImuConfig().gyro, tau_s), rtol=0.05
        )


# --- the navigator


def test_a_navigator_follows_a_constant_rate_exactly() -> None:
    rate = np.array([0.3, -0.2, 0.5])
    navigator = Navigator(wxyz(TILTED))
    navigator.add(steady(rate, 4000))
    wanted = TILTED * Rotation.from_rotvec(10 * rate)
    assert (
        Rotation.from_quat(navigator.lab_from_body_wxyz, scalar_first=True).inv() * wanted
    ).magnitude() < 1e-12
    np.testing.assert_allclose(
        euler_deg(navigator), wanted.as_euler("ZYX", degrees=True)[::-1], rtol=0, atol=1e-10
    )
    assert np.linalg.norm(navigator.lab_from_body_wxyz) == pytest.approx(1, abs=1e-14)


def test_a_navigator_gives_the_same_attitude_in_pieces_and_at_once() -> None:
    whole = Navigator(wxyz(TILTED), EARTH)
    pieces = Navigator(wxyz(TILTED), EARTH)
    run = CONE.felt(np.arange(0, 1.0005, 1e-3), np.arange(1, 401) * STEP, EARTH)
    whole.add(run)
    for k in np.array_split(np.arange(400), 100):
        pieces.add(
            replace(
                run,
                t_s=run.t_s[k],
                angle_rad=run.angle_rad[k],
                velocity_m_s=run.velocity_m_s[k],
            )
        )
    np.testing.assert_array_equal(whole.lab_from_body_wxyz, pieces.lab_from_body_wxyz)


def test_coning_makes_the_navigator_drift_as_theory_predicts() -> None:
    """Increments taken for rotation vectors miss half the integral of angle x rate: sin^2(a) (w h - sin(w h)) / 2
    about the cone's axis in each sample, here 1.8e-6 rad, so 7e-3 rad in 10 s; and they miss nothing else."""
    knots = np.arange(0, 10.0005, 1e-3)
    ends = STEP * np.arange(1, 4001)
    navigator = Navigator(wxyz(CONE.attitude(0.0)))
    navigator.add(CONE.felt(knots, ends, np.zeros(3)))
    believed = Rotation.from_quat(navigator.lab_from_body_wxyz, scalar_first=True)
    error = (CONE.attitude(10.0).inv() * believed).as_rotvec()
    wh = CONE.w * STEP
    missed = 4000 * np.sin(CONE.half) ** 2 / 2 * (wh - np.sin(wh))
    np.testing.assert_allclose(np.linalg.norm(error), missed, rtol=0.01)


@pytest.mark.parametrize(
    "euler", [(10.0, 20.0, 30.0), (-170.0, -85.0, 179.0), (0.0, 0.0, -90.0)]
)
def test_euler_angles_match_scipy(euler: tuple[float, float, float]) -> None:
    start = Rotation.from_euler("ZYX", euler[::-1], degrees=True)
    np.testing.assert_allclose(
        euler_deg(Navigator(3 * wxyz(start))), euler, rtol=0, atol=1e-10
    )


def test_an_initial_attitude_error_is_constant_in_the_lab() -> None:
    """Home believed level while the vehicle stands 0.5 deg wrong: the error stays with it, in the lab's axes."""
    home_error = Rotation.from_euler("x", 0.5, degrees=True)
    truth = home_error
    navigator = Navigator(wxyz(Rotation.identity()))
    navigator.add(steady(np.radians([0, 0, 90]), 400))
    truth = truth * Rotation.from_euler("z", 90, degrees=True)
    np.testing.assert_allclose(euler_deg(navigator), [0, 0, 90], rtol=0, atol=1e-10)
    believed = Rotation.from_quat(navigator.lab_from_body_wxyz, scalar_first=True)
    np.testing.assert_allclose(
        (truth * believed.inv()).as_rotvec(degrees=True), [0.5, 0, 0], rtol=0, atol=1e-10
    )


@pytest.mark.parametrize(
    ("roll", "pitch", "yaw"), [(0, 0, 40), (25, -20, 70), (-29, 12, -110), (120, 80, 5)]
)
def test_the_tilt_is_found_from_gravity(roll: float, pitch: float, yaw: float) -> None:
    attitude = Rotation.from_euler("ZYX", [yaw, pitch, roll], degrees=True)
    got = np.degrees(tilt_rad(still(attitude, 2.0, 0.1, np.zeros(3)).velocity_m_s))
    np.testing.assert_allclose(got, [roll, pitch], rtol=0, atol=1e-10)
