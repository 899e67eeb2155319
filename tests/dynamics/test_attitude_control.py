"""The controller: poles, feed-forward by Euler's equation, anti-windup, and closed-loop motion by theory."""

from __future__ import annotations

import math

import numpy as np
import pytest
from scipy.integrate import solve_ivp
from scipy.linalg import expm
from scipy.spatial.transform import Rotation

from skysim.core import quaternion
from skysim.core.types import Floats
from skysim.dynamics.attitude_control import Pid
from skysim.dynamics.guidance import Reference, plan
from skysim.scene import loader
from skysim.scene.sections.motion import ControlConfig, MotionConfig
from skysim.simulation.flight import simulate_motion

INERTIA = np.array([6.0, 6.5, 9.0])
ABOUT_AXES = np.diag(INERTIA)
AXES = Rotation.from_rotvec([0.2, -0.4, 0.3]).as_matrix()
TENSOR = (
    AXES @ np.diag(INERTIA) @ AXES.T
)  # of a vehicle whose principal axes are not the body's
STORED = np.array([1.5, -2.0, 3.0])  # N m s in wheels
NONE = np.zeros(3)
PLACED = {"bandwidth_rad_s": 2.0, "damping": 0.7, "integral_rad_s": 0.5}
POLES = np.polymul([1, 2 * 0.7 * 2.0, 2.0**2], [1, 0.5])  # (s^2 + 2 z b s + b^2)(s + p)
SLEW = {"kind": "slew", "roll_deg": 20, "pitch_deg": -12, "yaw_deg": 90}
SLEW |= {"rate_deg_s": 20, "acceleration_deg_s2": 15}


def planned(*elements: object) -> Reference:
    return plan(MotionConfig.model_validate({"control": "pid", "maneuver": elements}))


def holding(inertia: Floats = ABOUT_AXES, **part: object) -> Pid:
    """A controller that holds the attitude (0, 0, 0)."""
    return Pid(planned(), inertia, ControlConfig.model_validate(part))


def closed(
    law: Pid,
    lab_from_start: Rotation,
    rate: Floats,
    until_s: Floats,
    disturbance_nm: Floats = NONE,
    stored_nms: Floats = STORED,
) -> tuple[Rotation, Floats]:
    """Attitudes and rates of a rigid body with rotors under the continuously evaluated law.

    J dw/dt + w x (J w + h) = T + disturbance and dR/dt = R [w], by SciPy; the error's integral is integrated too.
    """
    inverse = np.linalg.inv(law.inertia_kg_m2)

    def slope(t_s: float, y: Floats) -> Floats:
        R = y[:9].reshape(3, 3)
        w = y[9:12]
        law.error_sum_rad_s = y[12:].copy()
        torque = (
            law.torque_nm(
                t_s, quaternion.from_rotation(Rotation.from_matrix(R)), w, stored_nms
            )
            + disturbance_nm
        )
        moves = inverse @ (torque - np.cross(w, law.inertia_kg_m2 @ w + stored_nms))
        return np.concatenate([np.cross(R, w).ravel(), moves, law.error_rad])

    begin = np.concatenate([lab_from_start.as_matrix().ravel(), rate, NONE])
    until = np.concatenate([[0.0], until_s])
    run = solve_ivp(
        slope, (0, until[-1]), begin, t_eval=until[1:], method="DOP853", rtol=1e-9, atol=1e-11
    )
    return Rotation.from_matrix(run.y[:9].T.reshape(-1, 3, 3)), run.y[9:12].T


# --- the law ------------------------------------------------------------------------------------------------


def test_the_error_decays_with_the_placed_poles() -> None:
    """e''' + a2 e'' + a1 e' + a0 e = 0 from e, e' and no integral, by the exponential of its companion matrix.

    The feed-forward takes the gyroscopic torque away, so that about any axis of an uneven vehicle with spinning
    wheels, and through 60 deg, the law is this one to the last digit.
    """
    axis = np.array([2.0, -1.0, 2.0]) / 3
    t_s = np.linspace(0.2, 6.0, 30)
    there, rate = closed(
        holding(TENSOR, **PLACED), Rotation.from_rotvec(axis), 0.3 * axis, t_s
    )
    companion = np.array([[0, 1, 0], [0, 0, 1], -POLES[:0:-1]])
    expected = np.array([expm(companion * t) @ [0.0, 1.0, 0.3] for t in t_s])[:, 1:]
    np.testing.assert_allclose(
        there.as_rotvec(), np.outer(expected[:, 0], axis), rtol=0, atol=1e-8
    )
    np.testing.assert_allclose(rate, np.outer(expected[:, 1], axis), rtol=0, atol=1e-8)


def test_the_poles_are_the_roots_of_the_characteristic_polynomial() -> None:
    """s^3 + kd s^2 + kp s + ki, of which pd has no last one and s^2 + 2 z b s + b^2 left."""
    pid = holding(**PLACED)
    pd = holding(**PLACED, law="pd")
    np.testing.assert_allclose([1, *np.take(pid.gains, [2, 0, 1])], POLES, rtol=1e-15, atol=0)
    np.testing.assert_allclose(
        [1, *np.take(pd.gains, [2, 0, 1])], [1, 2.8, 4.0, 0.0], rtol=1e-15, atol=0
    )


def test_the_attitude_error_takes_the_shorter_way() -> None:
    """At 200 deg of yaw it is wrong by -160: the torque goes on in the positive sense."""
    law = holding(law="pd", **PLACED)
    torque = law.torque_nm(
        0.0, quaternion.from_rotation(Rotation.from_euler("z", 200, degrees=True)), NONE, NONE
    )
    np.testing.assert_allclose(
        torque, [0, 0, 9.0 * 4.0 * math.radians(160)], rtol=0, atol=1e-12
    )


def late(period_s: float) -> float:
    """Difference of the roll error after 1.6 s between sampled and continuous control.

    A body on one axis is integrated exactly between the calls.
    """
    law = holding(**PLACED)
    angle = 0.01
    rate = 0.0
    for k in range(round(1.6 / period_s)):
        here = quaternion.from_rotation(Rotation.from_rotvec([angle, 0, 0]))
        torque = law.torque_nm(k * period_s, here, np.array([rate, 0, 0]), NONE)
        law.integrate(torque, torque, period_s)
        angle += rate * period_s + torque[0] / INERTIA[0] * period_s**2 / 2
        rate += torque[0] / INERTIA[0] * period_s
    companion = np.array([[0, 1, 0], [0, 0, 1], -POLES[:0:-1]])
    return angle / 0.01 - float((expm(1.6 * companion) @ [0.0, 1.0, 0.0])[1])


def test_a_held_torque_is_late_by_half_a_period() -> None:
    """The error is of first order in the period."""
    errors = [late(period_s) for period_s in (8e-3, 4e-3, 2e-3)]
    assert abs(errors[2]) < 5e-3
    assert errors[0] / errors[1] == pytest.approx(2, abs=0.05)
    assert errors[1] / errors[2] == pytest.approx(2, abs=0.05)


@pytest.mark.parametrize("law", ["pd", "pid"])
def test_a_constant_torque_leaves_its_static_error(law: str) -> None:
    """pd: J^-1 T / b^2, at which the spring holds against it; pid: nothing."""
    push = np.array([0.3, -0.2, 0.1])
    there, rate = closed(
        holding(TENSOR, **PLACED, law=law), Rotation.identity(), NONE, np.array([50.0]), push
    )
    left = {"pd": np.linalg.solve(TENSOR, push) / 2.0**2, "pid": NONE}[law]
    np.testing.assert_allclose(there[0].as_rotvec(), left, rtol=0, atol=1e-8)
    np.testing.assert_allclose(rate[0], NONE, rtol=0, atol=1e-8)


def test_the_feed_forward_torque_satisfies_eulers_equation() -> None:
    """On the reference itself the torque is J a + w x (J w + h), of a full inertia tensor and of stored momentum."""
    tour = planned(SLEW)
    lab_from_ref, rate, acceleration = tour.state_at(1.3)
    torque = Pid(tour, TENSOR).torque_nm(1.3, lab_from_ref, rate, STORED)
    expected = TENSOR @ acceleration + np.cross(rate, TENSOR @ rate + STORED)
    np.testing.assert_allclose(torque, expected, rtol=0, atol=1e-14)
    assert np.abs(np.cross(rate, STORED)).max() > 0.1  # which is not nothing


@pytest.mark.slow
def test_a_rigid_body_follows_the_reference_throughout_a_slew() -> None:
    """By feed-forward alone: no error arises that feedback would have to correct."""
    tour = planned(SLEW)
    t_s = np.linspace(0.5, tour.duration_s + 1, 15)
    there, _ = closed(Pid(tour, TENSOR), Rotation.identity(), NONE, t_s)
    error = (tour.attitudes(t_s).inv() * there).as_rotvec()
    np.testing.assert_allclose(error, np.zeros((15, 3)), rtol=0, atol=1e-8)


# --- anti-windup --------------------------------------------------------------------------------------------


def test_the_integral_does_not_wind_up_at_the_torque_limit() -> None:
    """After a minute at full torque away from its target, the torque reverses at once when the target is crossed."""
    law = holding()
    away = quaternion.from_rotation(Rotation.from_rotvec([0.2, 0, 0]))
    for k in range(6000):
        wanted = law.torque_nm(k * 0.01, away, NONE, NONE)
        law.integrate(wanted, np.clip(wanted, -0.5, 0.5), 0.01)
    at_target = law.torque_nm(60.0, quaternion.from_rotation(Rotation.identity()), NONE, NONE)
    assert np.abs(at_target).max() < 1e-9


def test_the_integral_grows_on_every_axis_below_its_limit() -> None:
    """Half of what is wanted about x; all about y; about z a little less than all, as a steering law's rounding."""
    law = holding()
    wanted = law.torque_nm(
        0.0, quaternion.from_rotation(Rotation.from_rotvec([0.2, 0.2, 0.2])), NONE, NONE
    )
    law.integrate(wanted, wanted * [0.5, 1.0, 0.999], 0.01)
    np.testing.assert_allclose(law.error_sum_rad_s, [0, 2e-3, 2e-3], rtol=1e-12, atol=0)


def test_the_integral_leaves_the_limit_again() -> None:
    """At the positive torque limit due to the integral, an error that reduces the torque is integrated."""
    law = holding()
    law.error_sum_rad_s = np.array([-5.0, 0, 0])
    wanted = law.torque_nm(
        0.0, quaternion.from_rotation(Rotation.from_rotvec([0.1, 0, 0])), NONE, NONE
    )
    assert wanted[0] > 0.5
    law.integrate(wanted, np.clip(wanted, -0.5, 0.5), 0.01)
    assert law.error_sum_rad_s[0] == pytest.approx(-5.0 + 1e-3, abs=1e-12)


# --- far from its reference ---------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("fastest", "expected"), [(math.inf, math.sqrt(0.9 / 9.0)), (0.2, 0.2)]
)
def test_a_large_error_commands_at_most_a_rate_that_can_be_braked(
    fastest: float, expected: float
) -> None:
    """A radian off and at rest, kd J w_most; at that rate towards the reference, nothing: w = min(limit, sqrt(a e))."""
    config = ControlConfig.model_validate(PLACED)
    law = Pid(planned(), ABOUT_AXES, config, authority_nm=0.9, rate_limit_rad_s=fastest)
    here = quaternion.from_rotation(Rotation.from_rotvec([0, 0, 1.0]))
    torque = law.torque_nm(0.0, here, NONE, NONE)
    np.testing.assert_allclose(
        torque, [0, 0, -9.0 * law.gains[2] * expected], rtol=1e-12, atol=1e-15
    )
    coasting = law.torque_nm(0.0, here, np.array([0, 0, -expected]), NONE)
    np.testing.assert_allclose(coasting, NONE, rtol=0, atol=1e-12)
    law.integrate(torque, torque, 0.01)
    np.testing.assert_array_equal(law.error_sum_rad_s, NONE)


@pytest.mark.slow
def test_a_large_step_has_no_overshoot() -> None:
    """60 deg of yaw all at once with 1 N m on 9 kg m2: there in little more than the quickest, 2 sqrt(e J / T) = 6.1 s.

    It overshoots by less than half a degree, and comes to rest.
    """
    step = {
        "motion.maneuver": '[{kind: step, yaw_deg: 60, duration: "40 s"}]',
        "vehicle.center_of_mass": "[0 m, 0 m, 0 m]",
        "exposure": "{time: 10 ms, rate_hz: 1, frames: 1, first: 25 s}",
    }
    telemetry = simulate_motion(loader.load("afit_simsat", step)).telemetry()
    yaw_deg = np.degrees(telemetry.lab_from_body.as_rotvec()[:, 2])
    quickest_s = 2 * math.sqrt(math.radians(60) * 9.0 / 1.0)
    arrived_s = telemetry.t_s[np.argmax(yaw_deg > 59.9)]
    assert quickest_s < arrived_s < 1.3 * quickest_s
    assert yaw_deg.max() < 60.5
    assert abs(yaw_deg[-1] - 60) < 1e-3


# --- flown --------------------------------------------------------------------------------------------------

OFFSET_M = 0.05e-3
WEIGHT_N = 80 * 9.80665
SOFT_RAD_S = math.sqrt(WEIGHT_N * OFFSET_M / (6.0 * math.radians(1.03)))  # 0.603


@pytest.mark.long
@pytest.mark.parametrize("law", ["pd", "pid"])
def test_an_unbalanced_bearing_needs_the_integral(law: str) -> None:
    """80 kg whose center is 0.05 mm aside pull with 0.039 N m, at every attitude the same but for cos(tilt).

    The spring J b^2 of a PD controller holds against them 1.03 deg off, where its bandwidth is 0.60 rad/s (J = 6
    kg m2): J b^2 e = m g r cos e. The integral leaves none.
    """
    control = (
        f"{{law: {law}, bandwidth_rad_s: {SOFT_RAD_S}, damping: 0.8, integral_rad_s: 0.6}}"
    )
    out_of_balance = {
        "vehicle.center_of_mass": "[0 m, 0.05 mm, 0 m]",
        "motion.control": control,
        "motion.maneuver": "[]",
        "exposure": "{time: 10 ms, rate_hz: 1, frames: 1, first: 25 s}",
    }
    telemetry = simulate_motion(loader.load("afit_simsat", out_of_balance)).telemetry()
    left_deg = np.degrees(telemetry.lab_from_body[-1].as_rotvec())
    tilt = math.radians(1.03)
    expected = {"pd": -1.03 * math.cos(tilt), "pid": 0.0}[law]  # towards the heavy side
    np.testing.assert_allclose(left_deg, [expected, 0, 0], rtol=0, atol=1e-4)
    torque = telemetry.torque_nm[-1]
    np.testing.assert_allclose(
        torque, [WEIGHT_N * OFFSET_M * math.cos(expected * tilt), 0, 0], atol=1e-5
    )
