"""Wheels, fans and CMGs against conservation of angular momentum and known facts of the CMG pyramid."""

from __future__ import annotations

import math
from dataclasses import dataclass
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from scipy.integrate import solve_ivp
from scipy.spatial.transform import Rotation

from skysim.core.errors import InputError
from skysim.dynamics.multibody.actuator_kind import Actuators, ControlInput
from skysim.dynamics.multibody.cmgs import STEERING, CmgActuator
from skysim.dynamics.multibody.thrusters import FanSet, MomentumDump
from skysim.dynamics.multibody.wheels import WheelActuator
from skysim.scene.sections.motion import DesaturationConfig
from skysim.scene.sections.vehicle import CmgsConfig, WheelsConfig
from tests.helpers.interpreted import interpreted

# Kg m2, less the rotors about their axles.
BUS = np.array([[3.0, 0.2, -0.1], [0.2, 4.0, 0.3], [-0.1, 0.3, 5.0]])
BUS_INVERSE = np.linalg.inv(BUS)
# 54.74 deg: the pyramid with nearly the same momentum in every direction.
SKEW = math.acos(1 / math.sqrt(3))
SLANT = math.cos(SKEW)
STILL = np.zeros(3)


def pyramid(skew_rad: float, n: int = 4) -> tuple[np.ndarray, np.ndarray]:
    """Gimbal axes leaning by the skew from z towards x, y, -x, -y; rotors level, along y, -x, -y, x."""
    around = Rotation.from_euler("z", 90 * np.arange(n)[:, None], degrees=True)
    gimbal = around.apply([math.sin(skew_rad), 0, math.cos(skew_rad)])
    return gimbal.T.copy(), around.apply([0.0, 1.0, 0.0]).T.copy()


class Joints(SimpleNamespace):
    """Joints whose angles, speeds and motors have the numbers from `first` on."""

    def __init__(self, axes: np.ndarray, inertia: np.ndarray, first: int = 0) -> None:
        number = first + np.arange(len(inertia))
        super().__init__(
            axes=axes, inertia_kg_m2=inertia, qpos=number, dof=number, motor=number
        )

    def __len__(self) -> int:
        return len(self.motor)


def cmg_set(
    gimbal_axes: np.ndarray,
    spin_axes: np.ndarray,
    inertia: np.ndarray,
    rate_limit_rad_s: float,
    rotor_torque_limit_nm: float | None = None,
    steering: str = "singularity_robust",
) -> CmgActuator:
    """CMGs without a model: their gimbals come before their rotors."""
    config = CmgsConfig.model_validate({"steering": steering})
    config = config.model_copy(update={"rotor_torque_limit_nm": rotor_torque_limit_nm})
    rotors = Joints(spin_axes, inertia, len(inertia))
    gimbals = Joints(gimbal_axes, inertia)
    set_ = CmgActuator(SimpleNamespace(gimbals=gimbals, rotors=rotors), config)
    set_.limit = rate_limit_rad_s
    return set_


def wheel_set(axes: np.ndarray, inertia: np.ndarray, torque_limit_nm: float) -> WheelActuator:
    """Wheels without a model, up to 300 rad/s."""
    config = WheelsConfig().model_copy(update={"torque_limit_nm": torque_limit_nm})
    set_ = WheelActuator(SimpleNamespace(wheels=Joints(axes, inertia)), config)
    set_.speed_limit_rad_s = 300.0
    return set_


def allocated(set_: Actuators, torque: np.ndarray, *state: Any) -> np.ndarray:
    """The controls for a torque, from the fields of `ControlInput`."""
    control = np.zeros(16)
    set_.allocate(control, torque, ControlInput(*state))
    return control


def driven_wheels(
    set_: WheelActuator, torque: np.ndarray, speed: np.ndarray, period_s: float
) -> np.ndarray:
    """The wheels' motor torques."""
    return allocated(set_, torque, 0.0, period_s, STILL, STILL, speed)[set_.motor]


def steered(
    set_: CmgActuator,
    torque: np.ndarray,
    rate: np.ndarray,
    angle: np.ndarray,
    spin: np.ndarray,
    t_s: float,
) -> tuple[np.ndarray, np.ndarray]:
    """Gimbal rates and the rotors' motor torques."""
    speeds = np.concatenate([np.zeros_like(spin), spin])
    control = allocated(set_, torque, t_s, 0.01, rate, angle, speeds)
    return control[set_.motor], control[set_.rotors.motor]


def wheel_momentum(set_: WheelActuator, speed: np.ndarray) -> np.ndarray:
    return set_.momentum_nms(STILL, speed)


def pyramid_set(
    steering: str = "singularity_robust", rate_limit_rad_s: float = 1.0
) -> CmgActuator:
    """Four CMGs of one N m s each at 100 rad/s."""
    return cmg_set(*pyramid(SKEW), np.full(4, 0.01), rate_limit_rad_s, None, steering)


SPEED = np.full(4, 100.0)  # rad/s


@dataclass
class Body:
    """The independent oracle: conservation of angular momentum instead of equations of motion.

    A motor changes its rotor's momentum about the axle, spin = inertia (speed + rate . axle), and nothing else does.
    The body has what is left of the whole: BUS rate = whole - sum axle spin, and in body axes the whole changes by
    d(whole)/dt = torque from outside - rate x whole. Wheels are rotors whose gimbals never turn.
    """

    gimbal: np.ndarray  # (3, n)
    axle: np.ndarray  # (3, n) at angle zero
    inertia: np.ndarray  # (n,)
    angle: np.ndarray
    spin: np.ndarray
    whole: np.ndarray
    turn: np.ndarray  # small rotation vector, d(turn)/dt = rate

    @classmethod
    def start(cls, gimbal, axle, inertia, angle, speed, rate) -> Body:
        body = cls(
            gimbal,
            axle,
            inertia,
            np.array(angle, float),
            np.zeros(len(inertia)),
            STILL,
            STILL,
        )
        axles = body.axles(body.angle)
        body.spin = inertia * (np.asarray(speed, float) + rate @ axles)
        body.whole = BUS @ rate + axles @ body.spin
        return body

    def axles(self, angle: np.ndarray) -> np.ndarray:
        return Rotation.from_rotvec((self.gimbal * angle).T).apply(self.axle.T).T

    def rate_of(self, whole: np.ndarray, angle: np.ndarray, spin: np.ndarray) -> np.ndarray:
        return BUS_INVERSE @ (whole - self.axles(angle) @ spin)

    @property
    def rate(self) -> np.ndarray:
        return self.rate_of(self.whole, self.angle, self.spin)

    @property
    def speed(self) -> np.ndarray:
        return self.spin / self.inertia - self.rate @ self.axles(self.angle)

    def move(self, dt: float, gimbal_rate=0.0, motor=0.0, outside=STILL) -> Body:
        """The body dt later (or earlier) under constant commands."""
        n = len(self.inertia)
        gimbal_rate = np.broadcast_to(gimbal_rate, n)
        motor = np.broadcast_to(motor, n)

        def flow(t: float, state: np.ndarray) -> np.ndarray:
            whole = state[:3]
            angle = state[6 : 6 + n]
            spin = state[6 + n :]
            rate = self.rate_of(whole, angle, spin)
            return np.concatenate([outside - np.cross(rate, whole), rate, gimbal_rate, motor])

        begin = np.concatenate([self.whole, self.turn, self.angle, self.spin])
        end = solve_ivp(flow, (0, dt), begin, rtol=1e-9, atol=1e-11).y[:, -1]
        constant = self.gimbal, self.axle, self.inertia
        return Body(*constant, end[6 : 6 + n], end[6 + n :], end[:3], end[3:6])


def torque_felt(body: Body, gimbal_rate=0.0, motor=0.0, dt: float = 1e-4) -> np.ndarray:
    """BUS d(rate)/dt by a central difference with an error of the order of dt squared."""
    later = body.move(dt, gimbal_rate, motor)
    earlier = body.move(-dt, gimbal_rate, motor)
    return BUS @ (later.rate - earlier.rate) / (2 * dt)


def wheels(n: int, torque_limit_nm: float = 0.5) -> WheelActuator:
    axes = np.eye(3) if n == 3 else pyramid(SKEW)[0]
    return wheel_set(axes, np.full(n, 0.02), torque_limit_nm)


# ---- wheels ----------------------------------------------------------------------------------------------------


@pytest.mark.slow
@pytest.mark.parametrize("n", [3, 4])
def test_wheels_turn_the_body_and_take_its_momentum(n):
    """From rest rate = BUS^-1 T t, and the total momentum stays zero."""
    set_ = wheels(n)
    torque = np.array([0.05, -0.08, 0.03])
    body = Body.start(
        set_.hinges.axes,
        set_.hinges.axes,
        set_.hinges.inertia_kg_m2,
        np.zeros(n),
        np.zeros(n),
        STILL,
    )
    for _ in range(100):
        body = body.move(0.01, motor=driven_wheels(set_, torque, body.speed, 0.01))
    np.testing.assert_allclose(
        body.rate, np.linalg.solve(BUS, torque * 1.0), rtol=1e-9, atol=0
    )
    everything = BUS + set_.hinges.axes * set_.hinges.inertia_kg_m2 @ set_.hinges.axes.T
    np.testing.assert_allclose(
        wheel_momentum(set_, body.speed), -everything @ body.rate, rtol=1e-9, atol=0
    )


def test_with_gyroscopic_feed_forward_spinning_wheels_give_the_commanded_torque():
    """The convention: ask for T + rate x (all momentum), and BUS d(rate)/dt = T; without it, not."""
    set_ = wheels(4, torque_limit_nm=5.0)
    speed = np.array([200.0, -50, 120, 10])
    rate = np.array([0.3, -0.2, 0.4])
    torque = np.array([0.1, 0.2, -0.3])
    body = Body.start(
        set_.hinges.axes,
        set_.hinges.axes,
        set_.hinges.inertia_kg_m2,
        np.zeros(4),
        speed,
        rate,
    )
    everything = BUS + set_.hinges.axes * set_.hinges.inertia_kg_m2 @ set_.hinges.axes.T
    gyroscopic = np.cross(rate, everything @ rate + wheel_momentum(set_, speed))
    with_it = torque_felt(body, motor=driven_wheels(set_, torque + gyroscopic, speed, 0.01))
    without = torque_felt(body, motor=driven_wheels(set_, torque, speed, 0.01))
    np.testing.assert_allclose(with_it, torque, rtol=1e-6, atol=0)
    np.testing.assert_allclose(without, torque - gyroscopic, rtol=1e-6, atol=0)
    assert np.linalg.norm(gyroscopic) > 0.5


def test_four_wheels_share_a_torque_with_the_least_norm():
    """Of all motor torques that do it, the pseudo-inverse's are the smallest: none of the null vector in them."""
    set_ = wheels(4)
    motor = driven_wheels(set_, np.array([0.1, -0.05, 0.2]), np.zeros(4), 0.01)
    assert abs(motor @ [1, -1, 1, -1]) < 1e-15  # the pyramid's null vector
    np.testing.assert_allclose(
        set_.hinges.axes @ motor, [-0.1, 0.05, -0.2], rtol=0, atol=1e-15
    )


def test_beyond_the_torque_limit_the_direction_is_kept():
    torque = np.array([3.0, -1.0, 0.5])
    motor = driven_wheels(wheels(3), torque, np.zeros(3), 0.01)
    np.testing.assert_allclose(motor, -torque / 6, rtol=1e-15, atol=0)


@pytest.mark.parametrize(
    ("speed", "wanted", "motor"),
    [
        (299.9, -0.5, 0.02 * 0.1 / 0.01),  # reaches 300 rad/s at the end of the period
        (-299.9, 0.5, -0.02 * 0.1 / 0.01),
        (300.0, -0.5, 0.0),
        (301.0, -0.5, 0.0),  # beyond it already: not driven further, nor braked unasked
        (301.0, 0.3, -0.3),
        (290.0, -0.5, 0.5),  # far enough
    ],
)
def test_a_wheel_is_not_driven_beyond_its_speed(speed, wanted, motor):
    driven = driven_wheels(
        wheels(3), np.array([wanted, 0.1, 0]), np.array([speed, 0, 0]), 0.01
    )
    np.testing.assert_allclose(driven, [motor, -0.1, 0], rtol=1e-9, atol=1e-15)


@pytest.mark.parametrize("angles_deg", [[0, 90], [0, 120, 240]])
def test_a_torque_outside_the_plane_of_level_wheels_is_dropped(angles_deg):
    """All axes in the plane of x and y: least squares gives the torque's part in the plane, and none about z."""
    a = np.radians(angles_deg)
    tilted = Rotation.from_rotvec([0.3, -0.2, 0.9])  # so that rounding has its say
    axes = tilted.apply(np.array([np.cos(a), np.sin(a), 0 * a]).T).T
    set_ = wheel_set(axes, np.full(len(a), 0.01), 1.0)
    motor = driven_wheels(set_, tilted.apply([0.1, 0.2, 0.3]), np.zeros(len(a)), 0.01)
    np.testing.assert_allclose(
        tilted.inv().apply(-axes @ motor), [0.1, 0.2, 0], rtol=0, atol=1e-14
    )


# ---- fans ------------------------------------------------------------------------------------------------------


def fans(limit_n: float = 0.5) -> FanSet:
    """A pair of fans about each axis, one meter apart, whose forces cancel."""
    places = (
        0.5
        * np.array([[0, 1, 0], [0, -1, 0], [0, 0, 1], [0, 0, -1], [1, 0, 0], [-1, 0, 0]]).T
    )
    pushes = np.array(
        [[0, 0, 1], [0, 0, -1], [1, 0, 0], [-1, 0, 0], [0, 1, 0], [0, -1, 0]], float
    ).T
    found: Any = SimpleNamespace(axes=pushes, positions_m=places, motor=np.zeros(0, int))
    return FanSet(found, limit_n)


def test_a_fan_pair_is_a_couple():
    """A newton from each of a pair a meter apart is a newton meter; by hand: y x z = x, z x x = y, x x y = z."""
    for axis in range(3):
        thrust = np.repeat(np.eye(3)[axis], 2)
        np.testing.assert_array_equal(fans().torque_from_command @ thrust, np.eye(3)[axis])


def test_fans_give_the_torque_with_the_least_thrust():
    set_ = fans()
    torque = np.array([0.1, -0.2, 0.05])
    thrust = set_.drive(torque)
    np.testing.assert_allclose(set_.torque_from_command @ thrust, torque, rtol=0, atol=1e-15)
    np.testing.assert_allclose(thrust, np.repeat(torque / 2 / 0.5, 2), rtol=1e-13, atol=0)


def test_fans_at_their_limit_keep_the_direction():
    set_ = fans()
    torque = np.array([3.0, -2.0, 1.0])
    thrust = set_.drive(torque)
    assert np.abs(thrust).max() == pytest.approx(0.5, rel=1e-15)
    np.testing.assert_allclose(
        set_.torque_from_command @ thrust, torque / 6, rtol=1e-13, atol=0
    )


# ---- the geometry of gyros -------------------------------------------------------------------------------------

ANGLES = np.array([0.4, -1.1, 2.0, 0.7])
SPEEDS = np.array([100.0, 80, -120, 95])


def test_the_momentum_is_that_of_the_gimballed_rotors():
    set_ = pyramid_set()
    axles = Rotation.from_rotvec((set_.gimbals.axes * ANGLES).T).apply(set_.rotors.axes.T)
    np.testing.assert_allclose(
        set_.momentum(ANGLES, SPEEDS), 0.01 * SPEEDS @ axles, rtol=0, atol=1e-14
    )


@pytest.mark.compiles
def test_the_jacobian_is_the_momentums_derivative():
    """By a five-point difference, exact to the fourth order of 1e-3 rad."""
    set_ = pyramid_set()
    step = 1e-3
    for k, column in enumerate(set_.jacobian(ANGLES, SPEEDS).T):
        near, far = (np.eye(4)[k] * m * step for m in (1, 2))
        one = set_.momentum(ANGLES + near, SPEEDS) - set_.momentum(ANGLES - near, SPEEDS)
        two = set_.momentum(ANGLES + far, SPEEDS) - set_.momentum(ANGLES - far, SPEEDS)
        np.testing.assert_allclose(column, (8 * one - two) / (12 * step), rtol=0, atol=1e-11)


def test_manipulability_is_one_at_best_and_nothing_at_a_singularity():
    square = cmg_set(np.eye(3), np.roll(np.eye(3), 1, axis=0), np.full(3, 0.01), 1.0)
    assert square.manipulability(np.zeros(3), np.full(3, 100.0)) == pytest.approx(
        1, rel=1e-12
    )
    assert square.manipulability(np.zeros(3), np.zeros(3)) == 0
    set_ = pyramid_set()
    assert set_.manipulability(ANGLES, 7 * SPEEDS) == pytest.approx(
        set_.manipulability(ANGLES, SPEEDS)
    )
    # At rest the columns are (-c, 0, s), (0, -c, s), ...: A A^T = diag(2 c^2, 2 c^2, 4 s^2), c^2 = 1/3, trace 4.
    at_rest = math.sqrt(2 / 3 * 2 / 3 * 8 / 3 / (4 / 3) ** 3)
    assert set_.manipulability(np.zeros(4), SPEED) == pytest.approx(at_rest, rel=1e-12)
    assert set_.manipulability(np.radians([-90, 0, 90, 0]), SPEED) < 1e-12


# ---- the torque of gyros ---------------------------------------------------------------------------------------


@pytest.mark.slow
@pytest.mark.parametrize("rate", [[0, 0, 0], [0.3, -0.2, 0.4]])
def test_a_cmg_s_torque_is_gimbal_rate_times_momentum(rate):
    """On a body of its own: ask for T + rate x (all momentum), and BUS d(rate)/dt = T to 1e-6."""
    set_ = pyramid_set("pseudo_inverse")
    rate = np.array(rate)
    torque = np.array([0.1, 0.2, -0.3])
    body = Body.start(
        set_.gimbals.axes, set_.rotors.axes, set_.rotors.inertia_kg_m2, ANGLES, SPEEDS, rate
    )
    asked = torque + np.cross(rate, body.whole)
    gimbal_rate, motor = steered(set_, asked, rate, ANGLES, SPEEDS, 0.0)
    assert np.abs(gimbal_rate).max() < 1
    np.testing.assert_array_equal(motor, np.zeros(4))
    np.testing.assert_allclose(torque_felt(body, gimbal_rate), torque, rtol=1e-6, atol=0)
    momenta = body.axles(ANGLES) * body.spin
    crossed = -np.cross(set_.gimbals.axes * gimbal_rate, momenta, axis=0).sum(axis=1)
    np.testing.assert_allclose(crossed, asked, rtol=1e-12, atol=0)


def test_away_from_singularities_both_steering_laws_agree():
    """lambda is 0.01 exp(-10 det A A^T), 5e-8 at rest with det = 32/27: the rates differ by no more."""
    torque = np.array([0.1, -0.05, 0.2])
    plain, robust = (
        steered(pyramid_set(name), torque, STILL, np.zeros(4), SPEED, 3.0)[0]
        for name in STEERING
    )
    lambda_ = 0.01 * math.exp(-10 * 32 / 27)
    assert 0 < np.abs(plain - robust).max() < 3 * lambda_ * np.abs(plain).max()


def test_the_robust_inverse_matches_wie_s_formula_at_any_time():
    """A^T (A A^T + lambda E)^-1: E is 1 on the diagonal, e_i = 0.01 sin(pi t / 2 + phase_i) off it."""
    plain = interpreted("skysim.dynamics.multibody.cmgs")
    rng = np.random.default_rng(4)
    for t_s in (0.0, 0.3, 1.1, 2.6):
        jacobian = 0.3 * rng.normal(size=(3, 4))
        asked = rng.normal(size=3)
        e_1, e_2, e_3 = 0.01 * np.sin(np.pi * t_s / 2 + np.array([0, np.pi / 2, np.pi]))
        gram = jacobian @ jacobian.T
        damping = (
            0.01
            * np.exp(-10 * np.linalg.det(gram))
            * np.array([[1, e_3, e_2], [e_3, 1, e_1], [e_2, e_1, 1]])
        )
        wanted = jacobian.T @ np.linalg.solve(gram + damping, asked)
        np.testing.assert_allclose(
            plain.singularity_robust(jacobian, asked, t_s), wanted, rtol=1e-9
        )


@pytest.mark.compiles
@pytest.mark.parametrize("steering", STEERING)
def test_gimbals_at_their_limit_keep_the_direction(steering):
    torque = np.array([1.0, -0.5, 2.0])
    set_ = pyramid_set(steering, rate_limit_rad_s=0.1)
    rate, _ = steered(set_, torque, STILL, np.zeros(4), SPEED, 0.0)
    assert np.abs(rate).max() == pytest.approx(0.1, rel=1e-12)
    given = -set_.jacobian(np.zeros(4), SPEED) @ rate
    # The robust inverse is off by lambda, 5e-8 there, over the smallest eigenvalue 2/3.
    np.testing.assert_allclose(
        given / np.linalg.norm(given), torque / np.linalg.norm(torque), rtol=0, atol=1e-6
    )
    assert np.linalg.norm(given) < 0.5 * np.linalg.norm(torque)


def test_a_cmg_may_have_any_skew_angle():
    """Gimbal and rotor at 45 deg between x and y: at right angles, though no product of their components is zero."""
    one = cmg_set(
        np.sqrt([[0.5], [0.5], [0.0]]),
        np.sqrt([[0.5], [0.5], [0.0]]) * [[1], [-1], [1]],
        np.array([0.01]),
        1.0,
    )
    np.testing.assert_allclose(
        one.momentum(np.zeros(1), np.array([100.0])),
        np.sqrt([0.5, 0.5, 0.0]) * [1, -1, 1],
        rtol=1e-12,
    )


@pytest.mark.parametrize("steering", STEERING)
def test_resting_rotors_are_not_gimballed(steering):
    rate, motor = steered(pyramid_set(steering), np.ones(3), STILL, ANGLES, np.zeros(4), 0.0)
    np.testing.assert_array_equal([rate, motor], np.zeros((2, 4)))


# ---- the pyramid's singularities -------------------------------------------------------------------------------


def test_the_pyramid_saturates_with_every_rotor_at_its_largest_projection():
    """A rotor's axle reaches within g's plane: at most sqrt(1 - g_x^2) along x. c, 1, c, 1: 2 + 2 c = 3.155."""
    set_ = pyramid_set()
    best = np.sqrt(1 - set_.gimbals.axes[0] ** 2).sum()
    assert best == pytest.approx(2 + 2 * SLANT, rel=1e-12)
    angles = np.radians([-90, 180, 90, 0])
    np.testing.assert_allclose(set_.momentum(angles, SPEED), [best, 0, 0], rtol=0, atol=1e-14)
    assert set_.manipulability(angles, SPEED) < 1e-12


def test_in_a_singularity_the_pseudo_inverse_gives_the_other_components():
    set_ = pyramid_set("pseudo_inverse")
    angles = np.radians([-90, 0, 90, 0])
    rate, _ = steered(set_, np.array([0.3, 0.1, -0.2]), STILL, angles, SPEED, 0.0)
    np.testing.assert_allclose(
        -set_.jacobian(angles, SPEED) @ rate, [0, 0.1, -0.2], rtol=0, atol=1e-14
    )


def pushed_along_x(
    set_: CmgActuator, seconds: float
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Momentum (N, 3), gimbal rates and angles (N, 4) from rest, momentum wanted to grow by 0.1 N m along +x."""
    angle = np.zeros(4)
    story = []
    for k in range(round(seconds / 0.01)):
        rate, _ = steered(set_, np.array([-0.1, 0, 0]), STILL, angle, SPEED, 0.01 * k)
        angle = angle + 0.01 * rate
        story.append((set_.momentum(angle, SPEED), rate, angle))
    momentum, rates, angles = zip(*story, strict=True)
    return np.array(momentum), np.array(rates), np.array(angles)


def test_the_pseudo_inverse_is_stuck_at_the_internal_singularity():
    """It keeps rotors 2 and 4 opposed; at (-90, 0, 90, 0) deg the others are spent: h_x = 2 c = 1.155 and no more."""
    momentum, rates, angles = pushed_along_x(pyramid_set("pseudo_inverse"), 60)
    reached = 2 * SLANT
    before = round(0.99 * reached / 0.1 / 0.01)
    # Until then all is well; Euler's steps of 10 ms are good to a percent.
    grown = 0.001 * np.arange(1, before)
    np.testing.assert_allclose(momentum[: before - 1, 0], grown, rtol=0, atol=0.01 * reached)
    assert momentum[:, 0].max() <= reached * (1 + 1e-12)
    assert momentum[2000:, 0].min() > 0.999 * reached
    np.testing.assert_allclose(
        np.degrees(angles[2000:]), [[-90, 0, 90, 0]] * 4000, rtol=0, atol=2
    )
    # At the limit, to and fro, for nothing.
    assert np.abs(rates[2000:]).max() == pytest.approx(1, rel=1e-12)


@pytest.mark.slow
def test_the_robust_inverse_passes_the_internal_singularity_and_reaches_saturation():
    """It reaches 2 + 2 c = 3.155 instead of 1.155 at bounded rates with a few percent of cross momentum."""
    momentum, rates, angles = pushed_along_x(pyramid_set("singularity_robust"), 60)
    full = 2 + 2 * SLANT
    assert 0.999 * full < momentum[-1, 0] <= full
    assert np.abs(rates).max() < 0.9
    assert np.abs(momentum[:, 1:]).max() < 0.05 * full
    inside = (momentum[:, 0] > 0.999 * 2 * SLANT) & (momentum[:, 0] < 1.001 * 2 * SLANT)
    # It went through there.
    assert np.linalg.norm(angles[inside] - np.radians([-90, 0, 90, 0]), axis=1).min() < 0.1
    folded = np.degrees(np.mod(angles[-1] + 0.5, 2 * np.pi) - 0.5)
    np.testing.assert_allclose(folded, [270, 180, 90, 0], rtol=0, atol=5)


# ---- variable-speed gyros --------------------------------------------------------------------------------------


def variable(rotor_torque_limit_nm: float = 0.5) -> CmgActuator:
    """Three variable-speed CMGs about the body axes, 1 N m s each at 100 rad/s; d(h)/d(angle) is diagonal at zero."""
    return cmg_set(
        np.eye(3), np.roll(np.eye(3), 1, axis=0), np.full(3, 0.01), 1.0, rotor_torque_limit_nm
    )


THREE = np.full(3, 100.0)


def singular_angles(set_: CmgActuator, along: np.ndarray) -> np.ndarray:
    """Gimbal angles with every rotor at its largest component along a direction: a singularity."""
    across = np.cross(set_.gimbals.axes, set_.rotors.axes, axis=0)
    return np.arctan2(along @ across, along @ set_.rotors.axes)


@pytest.mark.compiles
def test_rotors_deliver_what_singular_gimbals_cannot():
    set_ = variable()
    along = np.array([2.0, 1.0, -2.0]) / 3
    angles = singular_angles(set_, along)
    np.testing.assert_allclose(
        along @ set_.jacobian(angles, THREE), np.zeros(3), rtol=0, atol=1e-15
    )
    torque = 0.3 * along + 0.2 * np.array([1.0, 0, 1.0])
    rate, motor = steered(set_, torque, STILL, angles, THREE, 0.0)
    assert np.abs(motor).max() < 0.5
    body = Body.start(
        set_.gimbals.axes, set_.rotors.axes, set_.rotors.inertia_kg_m2, angles, THREE, STILL
    )
    np.testing.assert_allclose(torque_felt(body, rate, motor), torque, rtol=0, atol=3e-7)
    # All by the rotors.
    assert along @ (body.axles(angles) @ motor) == pytest.approx(-along @ torque, rel=1e-12)
    fixed = cmg_set(set_.gimbals.axes, set_.rotors.axes, set_.rotors.inertia_kg_m2, 1.0)
    stuck, _ = steered(fixed, along, STILL, angles, THREE, 0.0)
    assert np.linalg.norm(along @ fixed.jacobian(angles, THREE) * stuck) < 1e-14


def test_rotors_keep_their_speed_where_gimbals_suffice():
    """At angle zero A = 1 N m s, det A A^T = 1: the weights leave the rotors 0.25 exp(-10) of the torque."""
    set_ = variable()
    torque = np.array([0.3, -0.2, 0.1])
    rate, motor = steered(set_, torque, STILL, np.zeros(3), THREE, 0.0)
    axles = set_.rotors.axes
    np.testing.assert_allclose(
        -set_.jacobian(np.zeros(3), THREE) @ rate - axles @ motor, torque, rtol=1e-12, atol=0
    )
    assert 0 < np.linalg.norm(motor) < 2 * 0.25 * math.exp(-10) * np.linalg.norm(torque)


@pytest.mark.slow
def test_variable_speed_cmgs_give_the_commanded_torque_at_any_angle():
    """800 random attitudes of the gimbals: exact to rounding wherever nothing is at its limit."""
    set_ = variable(rotor_torque_limit_nm=5.0)
    rng = np.random.default_rng(4)
    for angles in rng.uniform(-np.pi, np.pi, (800, 3)):
        torque = 0.1 * rng.standard_normal(3)
        rate, motor = steered(set_, torque, STILL, angles, THREE, 0.0)
        axles = (
            Rotation.from_rotvec((set_.gimbals.axes * angles).T).apply(set_.rotors.axes.T).T
        )
        given = -set_.jacobian(angles, THREE) @ rate - axles @ motor
        np.testing.assert_allclose(given, torque, rtol=0, atol=1e-12)


@pytest.mark.compiles
def test_variable_speed_gyros_at_their_limits_keep_the_direction():
    set_ = variable(rotor_torque_limit_nm=0.05)
    along = np.array([2.0, 1.0, -2.0]) / 3
    angles = singular_angles(set_, along)
    for torque in (3.0 * along, 10 * np.array([1.0, 0, 1]) + 0.01 * along):
        rate, motor = steered(set_, torque, STILL, angles, THREE, 0.0)
        used = max(np.abs(rate).max() / 1.0, np.abs(motor).max() / 0.05)
        assert used == pytest.approx(1, rel=1e-12)
        axles = (
            Rotation.from_rotvec((set_.gimbals.axes * angles).T).apply(set_.rotors.axes.T).T
        )
        given = -set_.jacobian(angles, THREE) @ rate - axles @ motor
        np.testing.assert_allclose(np.cross(given, torque), STILL, rtol=0, atol=1e-11)
        assert given @ torque > 0


@pytest.mark.compiles
def test_rotors_at_rest_work_as_wheels():
    set_ = variable()
    torque = np.array([0.1, 0.2, -0.1])
    rate, motor = steered(set_, torque, STILL, np.zeros(3), np.zeros(3), 0.0)
    np.testing.assert_allclose(-set_.rotors.axes @ motor, torque, rtol=1e-12, atol=0)
    np.testing.assert_array_equal(rate, np.zeros(3))


# ---- desaturation ----------------------------------------------------------------------------------------------

PART = DesaturationConfig.model_validate(
    {"start": "1 N m s", "stop": "0.2 N m s", "time": "8 s"}
)


def test_desaturation_starts_and_stops_at_different_thresholds():
    fan = MomentumDump(fans(), 1.0, PART)
    size = [0.5, 0.99, 1.01, 0.8, 0.21, 0.19, 0.5, 0.99, 1.5]
    running = [bool(fan.torque(np.array([0, -h, 0])).any()) for h in size]
    assert running == [False, False, True, True, True, False, False, False, True]


def test_the_desaturation_torque_opposes_the_momentum_over_its_time():
    np.testing.assert_allclose(
        MomentumDump(fans(), 1.0, PART).torque(np.array([4.0, -8.0, 0])),
        [-0.5, 1, 0],
        rtol=1e-15,
        atol=0,
    )


@pytest.mark.slow
def test_fans_empty_the_wheels_while_the_controller_holds_the_body():
    """h falls as exp(-t / 8 s), from 1.5 to 0.2 N m s in 8 ln 7.5 = 16.1 s, and the body comes to rest where it was."""
    set_ = wheels(3)
    fan = MomentumDump(fans(), 1.0, PART)
    blow = fans(limit_n=1.0)
    body = Body.start(
        np.eye(3), np.eye(3), set_.hinges.inertia_kg_m2, np.zeros(3), [50.0, -50, 25], STILL
    )
    period = 0.1
    stored = []
    turned = []
    fanned = []
    for _ in range(300):
        held = wheel_momentum(set_, body.speed)
        outside = blow.torque_from_command @ blow.drive(fan.torque(held))
        feedback = -BUS @ (4 * body.turn + 3.2 * body.rate) + np.cross(body.rate, body.whole)
        body = body.move(
            period, motor=driven_wheels(set_, feedback, body.speed, period), outside=outside
        )
        stored.append(float(np.linalg.norm(held)))
        turned.append(float(np.linalg.norm(body.turn)))
        fanned.append(bool(outside.any()))
    stopped = fanned.index(False)
    assert stored[0] == pytest.approx(1.5, rel=1e-12)
    assert not any(fanned[stopped:])
    # The loop of 2 rad/s follows the fans by 2 damping / bandwidth = 0.8 s.
    assert stopped * period == pytest.approx(8 * math.log(7.5), abs=1.0)
    assert stored[stopped] < 0.2
    # Stays, once the loop has settled.
    assert stored[stopped + 80] == pytest.approx(stored[-1], abs=0.001)
    # A torque of 1.5 / 8 N m against stiffness 4 BUS, and some overshoot.
    assert max(turned) < 0.2 / 3 / 4 * 1.2
    assert turned[-1] < 1e-3 * max(turned)


# ---- mistakes --------------------------------------------------------------------------------------------------


def test_rotors_that_are_not_across_their_gimbals_are_refused_in_one_line() -> None:
    with pytest.raises(InputError, match=r"rotor axes: .*at right angles") as caught:
        cmg_set(np.eye(3), np.eye(3), np.ones(3), 1.0)
    assert "\n" not in str(caught.value)
