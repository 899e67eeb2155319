"""Wheels, gimbals, fans, drag and cables, each against its closed form."""

from __future__ import annotations

import math
from collections.abc import Callable

import mujoco
import numpy as np
import pytest
from pydantic import ValidationError
from scipy.integrate import solve_ivp
from scipy.optimize import brentq
from scipy.spatial.transform import Rotation

from skysim.core.types import Floats
from skysim.dynamics import multibody
from skysim.scene.sections.vehicle import VehicleConfig

STILL = np.zeros(3)
LEVEL = Rotation.identity()
INERTIA = np.array([6.0, 6.5, 9.0])
SIMSAT = {
    "model": "vehicles/simsat.xml",
    "mass": "80 kg",
    "inertia": ["6 kg m2", "6.5 kg m2", "9 kg m2"],
    "center_of_mass": ["0 m", "0 m", "0 m"],
}
HEAVY = {
    "inertia": ["6e6 kg m2", "6.5e6 kg m2", "9e6 kg m2"]
}  # nothing that it carries moves it
WHEEL_KG_M2 = 2.5 * 0.09**2 / 2  # simsat.xml's wheels: cylinders of 2.5 kg and 9 cm
RPM = math.pi / 30


def vehicle_config(**changes: object) -> VehicleConfig:
    return VehicleConfig.model_validate(SIMSAT | changes)


def flown(
    vehicle: multibody.VehicleModel, rate: Floats, control: Floats
) -> multibody.Simulation:
    """A whole flight, level at first, with a control (K, nu) for each step."""
    flight = multibody.Simulation(
        vehicle, LEVEL, rate, len(control) * vehicle.model.opt.timestep
    )
    flight.advance(control)
    return flight


def still(vehicle: multibody.VehicleModel, duration_s: float) -> Floats:
    """(K, nu) zero controls."""
    return np.zeros((round(duration_s / vehicle.model.opt.timestep), vehicle.model.nu))


def held(
    vehicle: multibody.VehicleModel, motor: int, control: float, duration_s: float
) -> Floats:
    """One control held, all others zero: (K, nu)."""
    controls = still(vehicle, duration_s)
    controls[:, motor] = control
    return controls


def angles(flight: multibody.Simulation) -> Floats:
    """(K + 1, nq)"""
    return flight.states[:, 1 : 1 + flight.model.nq]


def speeds(flight: multibody.Simulation) -> Floats:
    """(K + 1, nv)"""
    return flight.states[:, 1 + flight.model.nq :][:, : flight.model.nv]


# --- wheels -------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("axis", [0, 1, 2])
def test_a_wheel_motor_turns_the_body_the_other_way_up_to_its_limit(axis: int) -> None:
    """Ask for 5 N m of a motor that has 0.2: the body goes with -0.2 t / (I - I_wheel), the total is nothing."""
    vehicle = multibody.build(
        vehicle_config(mount="free", wheels={"torque_limit": "0.2 N m"})
    )
    flight = flown(vehicle, STILL, held(vehicle, vehicle.wheels.motor[axis], 5.0, 2.0))
    body = -0.2 * 2.0 / (INERTIA[axis] - WHEEL_KG_M2)
    np.testing.assert_allclose(
        flight.rate_body_rad_s, body * np.eye(3)[axis], rtol=0, atol=1e-12
    )
    wheel = flight.speeds_rad_s[vehicle.wheels.dof[axis]]
    assert WHEEL_KG_M2 * (wheel + body) == pytest.approx(0.2 * 2.0, rel=1e-9)


def test_wheel_starts_at_its_speed_relative_to_the_body() -> None:
    vehicle = multibody.build(
        vehicle_config(mount="free", wheels={"start_rpm": [300, -200, 100]})
    )
    flight = multibody.Simulation(vehicle, LEVEL, np.array([0.1, 0.2, 0.3]), 1.0)
    np.testing.assert_allclose(
        flight.speeds_rad_s, [0.1, 0.2, 0.3, 300 * RPM, -200 * RPM, 100 * RPM], rtol=1e-15
    )


def test_friction_brings_a_wheel_to_rest_and_the_body_takes_its_momentum() -> None:
    """I dw/dt = -T_c - c w: w = (w0 + T_c / c) exp(-c t / I) - T_c / c until it stops, and then it stays.

    I is that of wheel and body against each other. Then the two turn together with what the wheel brought.
    """
    friction = {"coulomb": "0.1 N m", "viscous": "1e-3 N m s", "start_rpm": [500, 0, 0]}
    vehicle = multibody.build(vehicle_config(mount="free", wheels=friction))
    flight = flown(vehicle, STILL, still(vehicle, 6.0))
    t = np.arange(6001) * 1e-3
    speed = speeds(flight)[:, vehicle.wheels.dof[0]]
    start = 500 * RPM
    both = WHEEL_KG_M2 * (6 - WHEEL_KG_M2) / 6
    stops_s = both / 1e-3 * math.log(1 + start * 1e-3 / 0.1)
    assert 4 < stops_s < 5
    turning = t < stops_s - 0.01
    expected = (start + 100) * np.exp(-1e-3 * t / both) - 100
    np.testing.assert_allclose(
        speed[turning], expected[turning], rtol=0, atol=1e-4
    )  # of 52 rad/s
    assert np.abs(speed[t > stops_s + 1]).max() < 1e-6
    body = [WHEEL_KG_M2 * start / 6, 0, 0]
    np.testing.assert_allclose(flight.rate_body_rad_s, body, rtol=0, atol=1e-9)


@pytest.mark.parametrize(
    ("torque_nm", "expected"), [(0.019, 0.0), (0.03, 0.01 / WHEEL_KG_M2)]
)
def test_wheel_sticks_until_its_motor_beats_coulombs_friction(
    torque_nm: float, expected: float
) -> None:
    """Speed after a second of a motor against 0.02 N m; MuJoCo's friction creeps, by 2e-3 rad/s here."""
    vehicle = multibody.build(
        vehicle_config(mount="free", wheels={"coulomb": "0.02 N m"}, **HEAVY)
    )
    flight = flown(vehicle, STILL, held(vehicle, vehicle.wheels.motor[2], torque_nm, 1.0))
    assert flight.speeds_rad_s[vehicle.wheels.dof[2]] == pytest.approx(expected, abs=5e-3)


def shaking_rad(vehicle: multibody.VehicleModel, rad_s: float) -> Floats:
    """(3,) amplitude at a frequency about the body axes over 0.2 s of flight, without slow drift."""
    flight = flown(vehicle, STILL, still(vehicle, 0.2))
    t = np.arange(len(flight.states)) * vehicle.model.opt.timestep
    turn = Rotation.from_quat(angles(flight)[:, :4], scalar_first=True).as_rotvec()
    laws = np.stack(
        [np.ones_like(t), t, t**2, t**3, np.cos(rad_s * t), np.sin(rad_s * t)], axis=1
    )
    found, *_ = np.linalg.lstsq(laws, turn, rcond=None)
    return np.hypot(found[4], found[5])


def torque_of_imbalance(axis: int, static_kg_m: float, dynamic_kg_m2: float) -> Floats:
    """(3,) complex: T = Re(this w^2 exp(i w t)) of simsat.xml's wheel along an axis, but for its phase."""
    place = {0: [0.30, 0, -0.02], 1: [0, 0.30, -0.02], 2: [-0.30, 0, -0.02]}[axis]
    # What turns with the wheel.
    line = np.roll(np.eye(3)[0], axis + 1) - 1j * np.roll(np.eye(3)[0], axis + 2)
    return static_kg_m * np.cross(place, line) + dynamic_kg_m2 * line


@pytest.mark.parametrize("axis", [0, 1, 2])
@pytest.mark.parametrize(("static_g_cm", "dynamic_g_cm2"), [(1.0, 0.0), (0.0, 10.0)])
def test_unbalanced_wheel_shakes_the_body(
    axis: int, static_g_cm: float, dynamic_g_cm2: float
) -> None:
    """At 3000 rpm: amplitudes U_s arm / J and U_d / J about each axis, as a run of ten times finer steps has them.

    J dw/dt + w x h = T, the wheel's own momentum h coupling the axes by I_wheel / J, one in 600. J is without the
    wheels, for about its own axle none of the three turns along. This holds to 2e-5.
    """
    turned_by: dict[str, object] = {"static_imbalance": f"{static_g_cm} g cm"}
    turned_by |= {
        "dynamic_imbalance": f"{dynamic_g_cm2} g cm2",
        "start_rpm": list(3000 * np.eye(3)[axis]),
    }
    vehicle = multibody.build(vehicle_config(mount="free", wheels=turned_by))
    w = 3000 * RPM
    h = WHEEL_KG_M2 * w * np.eye(3)[axis]
    inertia = np.diag(INERTIA - WHEEL_KG_M2)
    across = np.cross(np.eye(3), h).T  # across @ rate = rate x h
    torque = torque_of_imbalance(axis, static_g_cm * 1e-5, dynamic_g_cm2 * 1e-7) * w**2
    expected = np.abs(np.linalg.solve(1j * w * inertia + across, torque) / w)
    coarse = shaking_rad(vehicle, w)
    vehicle.model.opt.timestep = 1e-4
    fine = shaking_rad(vehicle, w)
    largest = expected.max()
    assert largest > 1e-7
    np.testing.assert_allclose(coarse, expected, rtol=0, atol=2e-5 * largest)
    np.testing.assert_allclose(fine, coarse, rtol=0, atol=2e-5 * largest)


def test_the_force_of_an_imbalance_matches_a_hand_calculation() -> None:
    """Wheel z, dynamic 10 g cm2: 1e-6 / 6 rad about x and 1e-6 / 6.5 rad about y, whatever its speed; none about z."""
    wheels = {"dynamic_imbalance": "10 g cm2", "start_rpm": [0, 0, 3000]}
    found = shaking_rad(
        multibody.build(vehicle_config(mount="free", wheels=wheels)), 3000 * RPM
    )
    np.testing.assert_allclose(found, [1e-6 / 6, 1e-6 / 6.5, 0], rtol=0.01, atol=1e-10)


@pytest.mark.parametrize("axis", [0, 1, 2])
def test_dynamic_imbalance_pulls_about_the_line_of_the_static_one(axis: int) -> None:
    """Acceleration of the body at the start: J a = w^2 (U_s place x u + U_d u), u from the axle to the heavy side.

    Two masses m at (+-d along the axle, -+r along v = axle x u) are a product of inertia U_d = 2 m d r, and their
    centrifugal forces a torque 2 d m r w^2 (v x axle) = U_d w^2 u. A sign is not seen in the amplitudes of shaking.
    """
    w = 3000 * RPM
    heavy_kg_m = 1e-4
    product_kg_m2 = 1e-5
    start = list(3000 * np.eye(3)[axis])
    wheels = {"static_imbalance": f"{heavy_kg_m} kg m", "start_rpm": start}
    torques = []
    for dynamic in (0.0, product_kg_m2):
        vehicle = multibody.build(
            vehicle_config(
                mount="free", wheels=wheels | {"dynamic_imbalance": f"{dynamic} kg m2"}
            )
        )
        data = mujoco.MjData(vehicle.model)
        data.qvel[:] = multibody.Simulation(vehicle, LEVEL, STILL, 0.1).speeds_rad_s
        mujoco.mj_forward(vehicle.model, data)
        torques.append(data.qacc[:3] * (INERTIA - WHEEL_KG_M2))
        wheel = vehicle.model.body(
            vehicle.model.jnt_bodyid[vehicle.model.joint(vehicle.wheels.names[axis]).id]
        )
        heavy_m = wheel.ipos - wheel.ipos @ np.eye(3)[axis] * np.eye(3)[axis]
    line = heavy_m / np.linalg.norm(heavy_m)
    largest = product_kg_m2 * w**2
    np.testing.assert_allclose(
        torques[1] - torques[0], largest * line, rtol=0, atol=0.01 * largest
    )


# --- gyroscopes ---------------------------------------------------------------------------------------------


def test_gimbal_reaches_its_commanded_rate_with_the_time_constant() -> None:
    """A critically damped spring after a ramp: d(angle)/dt = r (1 - (1 + t / tau) exp(-t / tau))."""
    vehicle = multibody.build(
        vehicle_config(
            mount="free", cmgs={"gimbal_time_constant": "20 ms", "rotor_rpm": 1e-6}, **HEAVY
        )
    )
    flight = flown(vehicle, STILL, held(vehicle, vehicle.gimbals.motor[1], 0.5, 0.2))
    x = np.arange(201) * 1e-3 / 0.02
    expected = 0.5 * (1 - (1 + x) * np.exp(-x))
    found = speeds(flight)[:, vehicle.gimbals.dof[1]]
    np.testing.assert_allclose(found, expected, rtol=0, atol=1e-5)


def test_gimbal_keeps_its_rate_while_the_vehicle_turns() -> None:
    """A vehicle that turns at w presses the gimbal of a rotor of momentum h with up to w h = 0.6 N m.

    The servo's spring, I / tau^2 = 35 N m/rad, gives way by w h / spring, and no further: the rate in the mean is
    what was commanded. A damper alone would lag by w h tau / 2 I = 50 deg/s.
    """
    cmgs = {"rotor_rpm": 2600, "gimbal_time_constant": "10 ms"}
    vehicle = multibody.build(vehicle_config(mount="free", cmgs=cmgs, **HEAVY))
    t = np.arange(5001) * 1e-3
    rate = np.radians([10.0, -10.0, 5.0, 0.0])
    control = still(vehicle, 5.0)
    control[:, vehicle.gimbals.motor] = rate
    flight = flown(vehicle, np.array([0.0, 0.0, 1.0]), control)
    own = vehicle.gimbals.inertia_kg_m2[0]
    given_way = 1.0 * 1.8 * 0.05**2 / 2 * 2600 * RPM / (own / 0.01**2)
    late = angles(flight)[:, vehicle.gimbals.qpos] - t[:, None] * rate
    assert np.abs(late[t > 0.1] + 2 * 0.01 * rate).max() < given_way
    assert (
        np.abs(late[t > 0.1] + 2 * 0.01 * rate).max() > given_way / 4
    )  # it was pressed indeed


def test_rotor_keeps_its_speed_or_is_driven_where_it_has_a_motor() -> None:
    """2600 rpm kept to a part in 1e12 by nothing at all; with a motor of 0.1 N m, 0.1 t / I more."""
    free = multibody.build(vehicle_config(mount="free", cmgs={"rotor_rpm": 2600}, **HEAVY))
    assert (free.rotors.motor == -1).all()
    flight = flown(free, STILL, still(free, 1.0))
    np.testing.assert_allclose(flight.speeds_rad_s[free.rotors.dof], 2600 * RPM, rtol=1e-12)
    driven = multibody.build(
        vehicle_config(
            mount="free", cmgs={"rotor_rpm": 2600, "rotor_torque_limit": "0.1 N m"}, **HEAVY
        )
    )
    flight = flown(driven, STILL, held(driven, driven.rotors.motor[2], 7.0, 1.0))
    expected = 2600 * RPM + np.array([0, 0, 0.1, 0]) / (1.8 * 0.05**2 / 2)
    np.testing.assert_allclose(flight.speeds_rad_s[driven.rotors.dof], expected, rtol=1e-6)


def test_gimbals_start_where_the_scene_has_them() -> None:
    """And stay there: the servo aims at the same angle."""
    vehicle = multibody.build(
        vehicle_config(mount="free", cmgs={"start_deg": [10, -20, 30, 90]}, **HEAVY)
    )
    flight = flown(vehicle, STILL, still(vehicle, 1.0))
    np.testing.assert_allclose(
        np.degrees(angles(flight)[:, vehicle.gimbals.qpos]),
        np.tile([10, -20, 30, 90], (1001, 1)),
        atol=1e-6,
    )


# --- stiction -----------------------------------------------------------------------------------------------

STICKY = {
    "torque_limit": "0.2 N m",
    "coulomb": "2 mN m",
    "viscous": "1e-4 N m s",
    "stiction": "3 mN m",
}


def one_axis_speed(
    motor_nm: Callable[[float], float], start_rad_s: float, t_s: Floats
) -> Floats:
    """Speeds of wheel x relative to the body, integrated by hand from rest or motion until it would stick."""
    reduced = WHEEL_KG_M2 * (INERTIA[0] - WHEEL_KG_M2) / INERTIA[0]

    def rate(t: float, speed: Floats) -> list[float]:
        friction = 2e-3 * np.sign(speed[0] or motor_nm(t)) + 1e-4 * speed[0]
        return [(motor_nm(t) - friction) / reduced]

    solved = solve_ivp(
        rate, t_s[[0, -1]], [start_rad_s], t_eval=t_s, rtol=1e-9, atol=1e-12, max_step=0.01
    )
    return solved.y[0]


def test_a_wheel_at_rest_breaks_away_at_its_stiction() -> None:
    """The motor's torque grows as 2 mN m/s t: 3 mN m at 1.5 s, from where Coulomb's 2 mN m and viscous friction act.

    The first step with a torque above the stiction is that of 1.5 s, or the one after.
    """
    vehicle = multibody.build(vehicle_config(mount="free", wheels=STICKY))
    control = still(vehicle, 3.0)
    t_s = np.arange(3001) * 1e-3
    control[:, vehicle.wheels.motor[0]] = 2e-3 * t_s[:-1]
    flight = flown(vehicle, STILL, control)
    wheel = speeds(flight)[:, vehicle.wheels.dof[0]]
    assert np.abs(wheel[:1500]).max() < 1e-5
    assert wheel[1503] > 1e-4
    expected = one_axis_speed(lambda t: 2e-3 * t, 0.0, t_s[1500:])
    np.testing.assert_allclose(wheel[1500:], expected, rtol=0, atol=3e-3 * expected[-1])
    # Nothing from outside: the total angular momentum stays zero.
    body = speeds(flight)[:, 0]
    np.testing.assert_allclose(INERTIA[0] * body + WHEEL_KG_M2 * wheel, 0, atol=1e-12)


@pytest.mark.parametrize(("torque_mnm", "sticks"), [(-2.8, True), (-3.2, False)])
def test_a_wheel_sticks_at_zero_speed_unless_the_torque_exceeds_its_stiction(
    torque_mnm: float, sticks: bool
) -> None:
    """From 20 rpm: a torque between Coulomb's friction and the stiction stops the wheel, a greater one reverses it."""
    start = 20 * RPM
    vehicle = multibody.build(
        vehicle_config(mount="free", wheels=STICKY | {"start_rpm": [20, 0, 0]})
    )
    flight = flown(
        vehicle, STILL, held(vehicle, vehicle.wheels.motor[0], torque_mnm * 1e-3, 8.0)
    )
    wheel = speeds(flight)[:, vehicle.wheels.dof[0]]
    t_s = np.arange(8001) * 1e-3
    expected = one_axis_speed(lambda _: torque_mnm * 1e-3, start, t_s)
    stops = int(np.flatnonzero(expected < 0)[0])
    if sticks:
        expected[stops:] = 0
    assert 3000 < stops < 6000
    np.testing.assert_allclose(wheel, expected, rtol=0, atol=2e-3 * start)
    assert sticks == (np.abs(wheel[stops + 10 :]).max() < 1e-5)


def test_a_jolt_of_the_body_tears_a_sticking_wheel_loose() -> None:
    """A torque of 5 N m on the body asks 5 mN m and more of the bearing at first: J_w T / J = 8.4 mN m > 3 mN m."""
    vehicle = multibody.build(vehicle_config(mount="free", wheels=STICKY))
    control = still(vehicle, 0.5)
    control[:100, vehicle.torques[0]] = 5.0
    flight = flown(vehicle, STILL, control)
    wheel = speeds(flight)[:, vehicle.wheels.dof[0]]
    # On a wheel that the body leaves behind, only friction acts: J_w (dw/dt + a) = 2 mN m.
    relative = (2e-3 / WHEEL_KG_M2 - 5.0 / (INERTIA[0] - WHEEL_KG_M2)) * 0.1
    assert wheel[100] == pytest.approx(relative, rel=0.03)


def test_a_stiction_below_the_coulomb_friction_is_refused() -> None:
    with pytest.raises(ValidationError, match=r"stiction: below coulomb 0.002 N m"):
        vehicle_config(wheels={"coulomb": "2 mN m", "stiction": "1 mN m"})


# --- fans ---------------------------------------------------------------------------------------------------


def test_fans_thrust_follows_with_a_lag_and_stops_at_its_limit() -> None:
    """J dw/dt = T (1 - exp(-t / tau)): w = T / J (t - tau (1 - exp(-t / tau))), then all of it decays.

    A pair at 0.46 m is commanded 5 N each for a second; its limit is 0.3 N.
    """
    vehicle = multibody.build(
        vehicle_config(
            mount="free", fans={"time_constant": "200 ms", "thrust_limit": "0.3 N"}
        )
    )
    control = still(vehicle, 3.0)
    control[:1000, vehicle.fans.motor[:2]] = 5.0
    rate = speeds(flown(vehicle, STILL, control))[:, 0]
    t = np.arange(3001) * 1e-3
    torque = 2 * 0.3 * 0.46
    tau = 0.2
    pushed = torque / 6 * (t - tau * (1 - np.exp(-t / tau)))
    np.testing.assert_allclose(rate[:1001], pushed[:1001], rtol=0, atol=1e-10)
    left = torque / 6 * tau * (1 - math.exp(-1 / tau)) * (1 - np.exp(-(t - 1) / tau))
    np.testing.assert_allclose(rate[1000:], pushed[1000] + left[1000:], rtol=0, atol=1e-10)


@pytest.mark.parametrize("axis", [0, 1, 2])
def test_pair_of_fans_turns_about_its_axis_alone(axis: int) -> None:
    """simsat.xml's fan_x_1 and fan_x_2 push 0.46 m from the axis, fan_z_* sqrt(2) 0.33 m."""
    vehicle = multibody.build(vehicle_config(mount="free", fans={"time_constant": "5 ms"}))
    control = still(vehicle, 1.0)
    control[:, vehicle.fans.motor[2 * axis : 2 * axis + 2]] = 0.25
    rate = flown(vehicle, STILL, control).rate_body_rad_s
    arm = [0.46, 0.46, 0.33 * math.sqrt(2)][axis]
    expected = 2 * 0.25 * arm * (1 - 5e-3) / INERTIA[axis] * np.eye(3)[axis]
    np.testing.assert_allclose(rate, expected, rtol=0, atol=1e-5 * expected.max())


# --- air and cable ------------------------------------------------------------------------------------------


@pytest.mark.parametrize("begin", [0.8, -0.8])
@pytest.mark.parametrize(("viscous", "quadratic"), [(1.0, 0.0), (0.0, 3.0), (1.0, 3.0)])
def test_drag_slows_a_spin(begin: float, viscous: float, quadratic: float) -> None:
    """J dw/dt = -(c + q |w|) w about z, of which

    w = w0 exp(-c t / J) / (1 + q |w0| (1 - exp(-c t / J)) / c), or w0 / (1 + q |w0| t / J) where c is zero.
    """
    drag = {"viscous": f"{viscous} N m s", "quadratic": f"{quadratic} N m s2"}
    vehicle = multibody.build(vehicle_config(drag=drag))
    flight = flown(vehicle, np.array([0, 0, begin]), still(vehicle, 8.0))
    t = np.arange(8001) * 1e-3
    fades = np.exp(-viscous * t / 9)
    over = -np.expm1(-viscous * t / 9) / viscous if viscous else t / 9
    expected = begin * fades / (1 + quadratic * abs(begin) * over)
    np.testing.assert_allclose(speeds(flight)[:, 2], expected, rtol=0, atol=1e-12)
    assert abs(expected[-1]) < 0.5 * abs(begin)


def test_drag_is_felt_about_each_axis_by_its_own_rate() -> None:
    """T = -(0.01 + 0.02 |w_i|) w_i at (0.1, -0.2, 0.3) rad/s, by hand."""
    vehicle = multibody.build(
        vehicle_config(drag={"viscous": "0.01 N m s", "quadratic": "0.02 N m s2"})
    )
    data = mujoco.MjData(vehicle.model)
    data.qvel[:] = [0.1, -0.2, 0.3]
    mujoco.mj_forward(vehicle.model, data)
    np.testing.assert_allclose(
        data.qfrc_passive, [-0.0012, 0.0028, -0.0048], rtol=0, atol=1e-15
    )


@pytest.mark.parametrize(("axis", "amplitude_deg"), [(0, 6), (1, 6), (2, 6), (2, 120)])
def test_cable_swings_the_vehicle_like_a_spring(axis: int, amplitude_deg: float) -> None:
    """T = 2 pi sqrt(J / k) about each axis, whatever the amplitude: the torque goes with the angle."""
    stiffness = 2.0
    vehicle = multibody.build(
        vehicle_config(disturbances={"cable": {"stiffness": f"{stiffness} N m / rad"}})
    )
    period = 2 * math.pi * math.sqrt(INERTIA[axis] / stiffness)
    begin = Rotation.from_rotvec(math.radians(amplitude_deg) * np.eye(3)[axis])
    flight = multibody.simulate(vehicle, begin, STILL, 0.8 * period)

    def angle(t_s: float) -> float:
        return flight.attitude_at(t_s).as_rotvec()[axis]

    down = brentq(angle, 0.0, 0.5 * period, xtol=1e-12)
    up = brentq(angle, 0.5 * period, 0.8 * period, xtol=1e-12)
    assert 4 * down == pytest.approx(period, rel=1e-9)
    assert 2 * (up - down) == pytest.approx(period, rel=1e-9)


def test_the_cable_turns_the_vehicle_back_by_the_shorter_way() -> None:
    """At 200 deg of yaw it is wound by 160 the other way: 0.1 N m/rad pull with +0.279 N m."""
    vehicle = multibody.build(
        vehicle_config(disturbances={"cable": {"stiffness": "0.1 N m / rad"}})
    )
    data = mujoco.MjData(vehicle.model)
    data.qpos[:4] = Rotation.from_euler("z", 200, degrees=True).as_quat(scalar_first=True)
    mujoco.mj_forward(vehicle.model, data)
    np.testing.assert_allclose(
        data.qfrc_passive, [0, 0, 0.1 * math.radians(160)], rtol=0, atol=1e-12
    )
