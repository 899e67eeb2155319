"""The reference obeys its limits and joins without a jump; the controller obeys its poles."""

from __future__ import annotations

import math

import numpy as np
import pytest
from scipy.integrate import solve_ivp
from scipy.spatial.transform import Rotation

from skysim.control import Reference, attitude, pid, plan
from skysim.scene import Attitude, Motion, Slew

HOLD = {"kind": "hold", "duration": "2 s"}
LIMITS = {"rate_deg_s": 2.0, "acceleration_deg_s2": 0.5}


def turn_to(roll: float, pitch: float, yaw: float, **limits: float) -> dict[str, object]:
    return {"kind": "slew", "roll_deg": roll, "pitch_deg": pitch, "yaw_deg": yaw} | LIMITS | limits


def reference(*manoeuvre: object, **motion: object) -> Reference:
    return plan(Motion.model_validate({"control": "pid", "manoeuvre": manoeuvre} | motion))


@pytest.fixture
def tour() -> Reference:
    """Long slews that cruise, one too short to, and holds between them."""
    start = {"roll_deg": 3, "pitch_deg": -4, "yaw_deg": 170}
    short = turn_to(-2, 14, 80)
    return reference(HOLD, turn_to(12, -6, -160), turn_to(-8, 14, 80), HOLD, short, start=start)


def sampled(ref: Reference, t_s: np.ndarray) -> tuple[Rotation, np.ndarray, np.ndarray]:
    there, rates, accelerations = zip(*(ref.at(t) for t in t_s), strict=True)
    return Rotation.concatenate(there), np.array(rates), np.array(accelerations)


def test_euler_angles_are_yaw_then_pitch_then_roll() -> None:
    """Rz(yaw) Ry(pitch) Rx(roll) written out by hand."""
    roll, pitch, yaw = 0.3, -0.5, 1.1
    about_x = [[1, 0, 0], [0, math.cos(roll), -math.sin(roll)], [0, math.sin(roll), math.cos(roll)]]
    about_y = [[math.cos(pitch), 0, math.sin(pitch)], [0, 1, 0], [-math.sin(pitch), 0, math.cos(pitch)]]
    about_z = [[math.cos(yaw), -math.sin(yaw), 0], [math.sin(yaw), math.cos(yaw), 0], [0, 0, 1]]
    angles = dict(zip(("roll_deg", "pitch_deg", "yaw_deg"), np.degrees([roll, pitch, yaw]), strict=True))
    expected = np.array(about_z) @ about_y @ about_x
    for given in (Attitude.model_validate(angles), Slew.model_validate(angles | {"kind": "slew"})):
        np.testing.assert_allclose(attitude(given).as_matrix(), expected, rtol=0, atol=1e-15)


def test_reference_visits_every_attitude_of_the_list(tour: Reference) -> None:
    wanted = [(3, -4, 170), (3, -4, 170), (12, -6, -160), (-8, 14, 80), (-8, 14, 80), (-2, 14, 80)]
    times = [*tour.start_s, tour.duration_s]
    for t, (roll, pitch, yaw) in zip(times, wanted, strict=True):
        there = attitude(Attitude.model_validate({"roll_deg": roll, "pitch_deg": pitch, "yaw_deg": yaw}))
        assert (there.inv() * tour.at(t)[0]).magnitude() < 1e-14
        # The sums of durations round; the rate leaves zero with their square.
        np.testing.assert_allclose(tour.at(t)[1], np.zeros(3), rtol=0, atol=1e-20)


def test_reference_keeps_its_limits_and_uses_them(tour: Reference) -> None:
    t = np.arange(0, tour.duration_s, 1e-2)
    _, rate, acceleration = sampled(tour, t)
    rate_deg_s = np.degrees(np.linalg.norm(rate, axis=1))
    acceleration_deg_s2 = np.degrees(np.linalg.norm(acceleration, axis=1))
    assert rate_deg_s.max() == pytest.approx(2.0, abs=1e-12)
    assert acceleration_deg_s2.max() <= 0.5 + 1e-12
    assert acceleration_deg_s2.max() > 0.4999
    # The last slew, 6 degrees of roll, has no time to cruise: it peaks at sqrt(a angle / 1.5).
    assert rate_deg_s[t > tour.start_s[-1]].max() == pytest.approx(math.sqrt(0.5 * 6 / 1.5), abs=1e-4)


def test_rate_and_acceleration_are_the_derivatives_of_the_attitude(tour: Reference) -> None:
    """Central differences, whose error is step^2 / 6 times the next derivative (jerk < 0.02 rad/s3)."""
    step = 1e-3
    t = np.arange(step, tour.duration_s, 0.0537)
    here, rate, acceleration = sampled(tour, t)
    before, rate_before, _ = sampled(tour, t - step)
    after, rate_after, _ = sampled(tour, t + step)
    middle = ((here.inv() * after).as_rotvec() - (here.inv() * before).as_rotvec()) / (2 * step)
    np.testing.assert_allclose(middle, rate, rtol=0, atol=1e-8)
    # A ramp's acceleration has corners at its ends: there the difference is off by half a step of jerk.
    slope = (rate_after - rate_before) / (2 * step)
    np.testing.assert_allclose(slope, acceleration, rtol=0, atol=1e-5)


def test_reference_is_continuous_at_the_joints(tour: Reference) -> None:
    for joint in (*tour.start_s[1:], tour.duration_s):
        (before, rate_before, accel_before), (after, rate_after, accel_after) = (
            tour.at(joint - 1e-9),
            tour.at(joint + 1e-9),
        )
        assert (before.inv() * after).magnitude() < 1e-12
        np.testing.assert_allclose(rate_before, rate_after, rtol=0, atol=1e-12)
        np.testing.assert_allclose(accel_before, accel_after, rtol=0, atol=1e-10)  # 2 ns of jerk


def test_slew_takes_the_time_of_its_profile() -> None:
    """Trapezoid with smoothstep ramps: duration = 1.5 v / a + angle / v, here 6 + 30 s."""
    assert reference(turn_to(0, 0, 60)).duration_s == pytest.approx(36.0, abs=1e-12)


def test_slew_goes_the_shorter_way_round() -> None:
    start = {"roll_deg": 0, "pitch_deg": 0, "yaw_deg": 170}
    ref = reference(turn_to(0, 0, -170), start=start)
    assert ref.at(ref.duration_s / 2)[0].as_euler("ZYX", degrees=True)[0] == pytest.approx(180, abs=1e-9)


def test_reference_holds_after_its_end_and_without_a_manoeuvre(tour: Reference) -> None:
    end, rate, _ = tour.at(tour.duration_s + 1e3)
    assert (end.inv() * tour.at(tour.duration_s)[0]).magnitude() == 0
    np.testing.assert_array_equal(rate, np.zeros(3))
    idle = plan(Motion.model_validate({"start": {"yaw_deg": 40}}))
    assert idle.duration_s == 0
    assert np.degrees(idle.at(7.0)[0].magnitude()) == pytest.approx(40, abs=1e-12)


def test_slew_to_where_it_stands_takes_no_time() -> None:
    ref = reference(turn_to(0, 0, 0), HOLD, turn_to(0, 0, 0))
    assert ref.duration_s == 2
    assert ref.at(1.0)[0].magnitude() == 0


def test_pointing_at_stars_starts_from_the_lab_axes() -> None:
    ref = plan(Motion.model_validate({"start": {"ra_deg": 83, "dec_deg": 2}}))
    assert ref.at(0.0)[0].magnitude() == 0


INERTIA = np.array([6.0, 6.5, 9.0])


def error_after(t_s: float, error_rad: float, period_s: float) -> float:
    """Roll error of a body on one axis under the controller, integrated exactly between its calls."""
    controller = pid(plan(Motion()), INERTIA)
    angle, rate = error_rad, 0.0
    for k in range(round(t_s / period_s)):
        body = Rotation.from_rotvec([angle, 0, 0])
        acceleration = controller(k * period_s, body, np.array([rate, 0, 0]))[0] / INERTIA[0]
        angle += rate * period_s + acceleration * period_s**2 / 2
        rate += acceleration * period_s
    return angle


def test_error_decays_by_the_placed_poles() -> None:
    """(s^2 + 2 z b s + b^2)(s + p) e = 0 from e(0) = 1, e' = 0, integral 0, by scipy's integrator.

    The held torque is half a period late: an error of first order in the period, so it must halve with it.
    """
    b, z, p = 3.0, 0.8, 0.6
    law = [-(b**2) * p, -(b**2 + 2 * z * b * p), -(2 * z * b + p)]
    run = solve_ivp(lambda _, y: [y[1], y[2], np.dot(law, y)], (0, 1.5), [0, 1, 0], rtol=1e-10, atol=1e-12)
    expected = run.y[1, -1]
    start = 1e-2
    late = [error_after(1.5, start, period) / start - expected for period in (4e-3, 2e-3, 1e-3)]
    assert abs(late[2]) < 5e-3
    assert late[0] / late[1] == pytest.approx(2, abs=0.05)
    assert late[1] / late[2] == pytest.approx(2, abs=0.05)


def test_constant_torque_leaves_no_error() -> None:
    """What the integral is for: at rest under a disturbance the torque is its opposite and the error zero."""
    controller = pid(plan(Motion()), INERTIA)
    angle, rate, disturbance = np.zeros(3), np.zeros(3), np.array([0.03, -0.02, 0.01])
    for k in range(4000):
        torque = controller(k * 0.01, Rotation.from_rotvec(angle), rate)
        rate = rate + (torque + disturbance) / INERTIA * 0.01
        angle = angle + rate * 0.01
    assert np.abs(angle).max() < 1e-9
    np.testing.assert_allclose(torque, -disturbance, rtol=0, atol=1e-8)


def test_feed_forward_is_eulers_equation(tour: Reference) -> None:
    """On the reference itself the torque is J a + w x J w, for a full inertia tensor too."""
    axes = Rotation.from_rotvec([0.2, -0.4, 0.3]).as_matrix()
    tensor = axes @ np.diag(INERTIA) @ axes.T
    t = tour.start_s[1] + 1.7
    there, rate, acceleration = tour.at(t)
    expected = tensor @ acceleration + np.cross(rate, tensor @ rate)
    np.testing.assert_allclose(pid(tour, tensor)(t, there, rate), expected, rtol=0, atol=1e-14)


def test_torque_stays_within_its_limit() -> None:
    controller = pid(plan(Motion()), INERTIA, torque_limit_nm=0.5)
    torque = controller(0.0, Rotation.from_rotvec([1.0, -1.0, 1e-3]), np.zeros(3))
    np.testing.assert_array_equal(torque[:2], [-0.5, 0.5])
    assert 0 < -torque[2] < 0.5


def test_integral_does_not_wind_up() -> None:
    """Held off its target for a minute at full torque, it lets go at once when the target is crossed."""
    controller = pid(plan(Motion()), INERTIA, torque_limit_nm=0.5)
    away = Rotation.from_rotvec([0.2, 0, 0])
    for k in range(6000):
        controller(k * 0.01, away, np.zeros(3))
    at_target = controller(60.0, Rotation.identity(), np.zeros(3))
    assert np.abs(at_target).max() < 1e-9
