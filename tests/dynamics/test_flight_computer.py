"""Every set of actuators delivers the commanded torque, reports its limits, and is desaturated."""

from __future__ import annotations

import math
from dataclasses import dataclass, field

import mujoco
import numpy as np
import pytest
from scipy.integrate import solve_ivp
from scipy.spatial.transform import Rotation

from skysim.core import quaternion
from skysim.core.types import Floats, Telemetry
from skysim.dynamics import multibody
from skysim.dynamics.flight_computer import FlightComputer
from skysim.dynamics.guidance import plan
from skysim.dynamics.multibody.actuator_kind import ControlInput
from skysim.scene import loader
from skysim.simulation.flight import simulate_motion

FREE = {
    "vehicle.mount": "free",
    "vehicle.center_of_mass": "[0 m, 0 m, 0 m]",
    "vehicle.torque_limit": "0.6 N m",
    "motion.maneuver": "[]",
}
WHEELS = {"vehicle.wheels": '{torque_limit: "0.6 N m", start_rpm: [300, -500, 800]}'}
CMGS = {"vehicle.cmgs": "{}"}
VARIABLE = {
    "vehicle.model": "vehicles/tas2.xml",
    "vehicle.mass": "130 kg",
    "vehicle.inertia": '["16 kg m2", "16 kg m2", "24 kg m2"]',
    "vehicle.cmgs": '{rotor_torque_limit: "0.4 N m", rotor_rpm: 1200}',
}
FANS = {"vehicle.fans": '{thrust_limit: "0.8 N", time_constant: "20 ms"}'}
THRUSTERS = {
    "vehicle.model": "vehicles/simsat_thrusters.xml",
    "vehicle.mass": "80 kg",
    "vehicle.inertia": '["6 kg m2", "6.5 kg m2", "9 kg m2"]',
    "vehicle.thrusters": '{thrust: "0.8 N"}',
}
SETS = {
    "ideal": ("ideal", {}),
    "wheels": ("wheels", WHEELS),
    "cmgs": ("cmgs", CMGS),
    "cmgs of variable speed": ("cmgs", VARIABLE),
    "fans": ("fans", FANS),
    "thrusters": ("thrusters", THRUSTERS),
}


@dataclass
class Asks:
    """A controller that commands one constant torque of the body for any rotor momentum."""

    torque: Floats
    given: list[tuple[Floats, Floats]] = field(default_factory=list)

    def torque_nm(self, _t: float, _a: Floats, rate: Floats, momentum_nms: Floats) -> Floats:
        return self.torque + np.cross(rate, momentum_nms)

    def integrate(self, wanted_nm: Floats, given_nm: Floats, _period_s: float) -> None:
        self.given.append((wanted_nm, given_nm))


def manned(name: str, **more: str) -> tuple[FlightComputer, multibody.Simulation]:
    """A free SimSat or TAS-2 at rest with its flight computer."""
    actuators, parts = SETS[name]
    changes = FREE | parts | {"motion.control": f"{{actuators: {actuators}}}"} | more
    loaded = loader.load("afit_simsat", changes)
    vehicle = multibody.build(loaded.vehicle)
    return FlightComputer(loaded, vehicle, plan(loaded.motion)), multibody.Simulation(
        vehicle, Rotation.identity(), np.zeros(3), 2.0
    )


def present_controls(flight_computer: FlightComputer, flight: multibody.Simulation) -> Floats:
    """(nu,) controls of the present tick."""
    stored = flight_computer.momentum_nms(flight.angles_rad, flight.speeds_rad_s)
    now = ControlInput(
        flight.now_s,
        flight_computer.period_s,
        flight.rate_body_rad_s,
        flight.angles_rad,
        flight.speeds_rad_s,
    )
    return flight_computer.compute_controls(now, flight.lab_from_body_wxyz, stored)


def bodys_inertia(vehicle: multibody.VehicleModel) -> Floats:
    """(3, 3) inertia about the body axes without the wheels' inertia about their free axles."""
    wheels = vehicle.wheels
    return vehicle.inertia_kg_m2 - (wheels.axes * wheels.inertia_kg_m2) @ wheels.axes.T


# --- what is delivered --------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("name", "within"),
    [
        ("ideal", 1e-9),
        ("wheels", 1e-4),
        ("fans", 1e-3),
        ("thrusters", 1e-6),
        ("cmgs", 1e-2),
        ("cmgs of variable speed", 1e-2),
    ],
)
def test_the_body_gets_the_commanded_torque(name: str, within: float) -> None:
    """The body's momentum over twenty ticks, once fans and gimbals have followed: it changes by the wanted T t.

    In axes that stand still. Fans and the servos of gimbals are late, by less and less; and a servo gives way to what
    the vehicle's own turn does to its rotor, which is some tenths of a percent.
    """
    flight_computer, flight = manned(name)
    wanted = np.array([0.15, -0.1, 0.12])
    flight_computer.law = Asks(wanted)  # type: ignore[assignment]
    inertia = bodys_inertia(flight.vehicle)
    held = []
    for _ in range(40):
        turn = Rotation.from_quat(flight.lab_from_body_wxyz, scalar_first=True)
        held.append(turn.apply(inertia @ flight.rate_body_rad_s))
        flight.advance(np.tile(present_controls(flight_computer, flight), (10, 1)))
    torque = (held[-1] - held[-21]) / 0.2
    turned_by = Rotation.from_quat(flight.lab_from_body_wxyz, scalar_first=True).magnitude()
    assert np.linalg.norm(torque - wanted) < (within + turned_by) * np.linalg.norm(wanted)
    assert turned_by < 4e-3  # by so much are the body's axes not those that stand still


@pytest.mark.parametrize("name", SETS)
def test_the_reported_torque_is_the_torque_delivered(name: str) -> None:
    """If the command is within the limits, the controller receives the full torque as delivered."""
    flight_computer, flight = manned(name)
    law = Asks(np.array([0.15, -0.1, 0.12]))
    flight_computer.law = law  # type: ignore[assignment]
    present_controls(flight_computer, flight)
    ((wanted, given),) = law.given
    np.testing.assert_array_equal(wanted, flight_computer.control_torque_nm)
    np.testing.assert_allclose(given, wanted, rtol=0, atol=1e-3 * np.linalg.norm(wanted))


@pytest.mark.parametrize("name", SETS)
def test_the_anti_windup_uses_the_actuator_limits(name: str) -> None:
    """At 0.5 rad/s the command about x exceeds the limit of every set, and the integral is frozen.

    Ideal torques have a limit for each axis, the other sets one for all, beyond which the direction is kept.
    """
    flight_computer, flight = manned(name)
    flight.states[0, 1:5] = quaternion.from_rotation(Rotation.from_rotvec([1e-4, 1e-4, 0.0]))
    flight.rate_body_rad_s[:] = [0.5, 0, 0]
    control = present_controls(flight_computer, flight)
    vehicle = flight.vehicle
    motors = {
        "ideal": vehicle.torques,
        "wheels": vehicle.wheels.motor,
        "cmgs": vehicle.gimbals.motor,
        "cmgs of variable speed": vehicle.gimbals.motor,
        "fans": vehicle.fans.motor,
        "thrusters": vehicle.thrusters.motor,
    }[name]
    largest = {"ideal": 0.6, "wheels": 0.6, "cmgs": math.radians(60), "fans": 0.8}
    largest |= {"cmgs of variable speed": math.radians(60), "thrusters": 0.8}
    assert np.abs(control[motors]).max() == pytest.approx(largest[name], rel=1e-9)
    about_y = {"ideal": 1e-4 * 0.01}.get(name, 0.0)
    np.testing.assert_allclose(
        flight_computer.law.error_sum_rad_s, [0, about_y, 0], rtol=0, atol=1e-12
    )


def test_without_a_controller_the_controls_are_zero() -> None:
    flight_computer, flight = manned("wheels", **{"motion.control": "none"})
    np.testing.assert_array_equal(
        present_controls(flight_computer, flight), np.zeros(flight.model.nu)
    )
    np.testing.assert_array_equal(flight_computer.control_torque_nm, np.zeros(3))


def test_a_constant_torque_leaves_no_error_with_cmgs() -> None:
    """The steering law damps singularities and gives a little less than is wanted: no reason to stop the integral.

    0.05 mm out of balance; a PD controller of 3 rad/s would be left 0.042 deg off. Gimbals at 75 deg are half-way to a
    singularity; what is left after 6 s is what the integral's pole leaves, exp(-0.6 t) of it.
    """
    changes = {
        "vehicle.center_of_mass": "[0 m, 0.05 mm, 0 m]",
        "vehicle.cmgs.start_deg": "[75, 75, 75, 75]",
        "motion.maneuver": "[]",
        "exposure": "{time: 10 ms, rate_hz: 1, frames: 1, first: 6 s}",
    }
    telemetry = simulate_motion(loader.load("simsat_cmg", changes)).telemetry()
    error_deg = np.degrees(telemetry.lab_from_body.magnitude())
    late = telemetry.t_s > 3
    decay = np.polyfit(telemetry.t_s[late], np.log(error_deg[late]), 1)[0]
    assert decay == pytest.approx(-0.6, rel=0.02)
    assert error_deg[-1] < 0.002


# --- momentum -----------------------------------------------------------------------------------------------


@pytest.mark.parametrize("name", ["wheels", "cmgs", "cmgs of variable speed"])
def test_stored_momentum_matches_mujoco(name: str) -> None:
    """`mj_subtreeVel` of a body at rest in any attitude, its gimbals at any angle, its rotors at any speed."""
    flight_computer, flight = manned(name)
    vehicle = flight.vehicle
    data = flight.data
    rng = np.random.default_rng(3)
    there = Rotation.from_rotvec([0.3, -0.7, 1.1])
    data.qpos[:4] = there.as_quat(scalar_first=True)
    data.qpos[vehicle.gimbals.qpos] = rng.uniform(-2, 2, len(vehicle.gimbals))
    data.qvel[:] = 0
    for spinning in (vehicle.wheels, vehicle.rotors):
        data.qvel[spinning.dof] = rng.uniform(-300, 300, len(spinning))
    mujoco.mj_forward(vehicle.model, data)
    mujoco.mj_subtreeVel(vehicle.model, data)
    expected = there.inv().apply(data.subtree_angmom[vehicle.model.body("bus").id])
    found = flight_computer.momentum_nms(data.qpos, data.qvel)
    assert np.linalg.norm(expected) > 0.5
    np.testing.assert_allclose(found, expected, rtol=0, atol=1e-12)


@pytest.mark.parametrize("control", ["none", "{law: pid, actuators: ideal}"])
def test_momentum_is_in_the_telemetry_with_and_without_a_controller(control: str) -> None:
    """Wheels without friction keep what they had, 0.010125 kg m2 at 300, -500 and 800 rpm."""
    changes = (
        FREE
        | WHEELS
        | {"motion.control": control, "exposure.frames": "1", "exposure.first": "0.2 s"}
    )
    telemetry = simulate_motion(loader.load("afit_simsat", changes)).telemetry()
    expected = 0.010125 * np.array([300, -500, 800]) * math.pi / 30
    np.testing.assert_allclose(
        telemetry.momentum_nms, np.tile(expected, (len(telemetry.t_s), 1)), rtol=0, atol=1e-6
    )


# --- desaturation -------------------------------------------------------------------------------------------


@pytest.fixture(scope="module")
def relieved() -> Telemetry:
    """SimSat holds its attitude while the fans take the momentum out of its wheel z, at 1800 rpm at first."""
    changes = {
        "vehicle.wheels": '{torque_limit: "0.6 N m", start_rpm: [0, 0, 1800]}',
        "vehicle.center_of_mass": "[0 m, 0 m, 0 m]",
        "motion.control.desaturation": "{start: 1.7 N m s, stop: 0.8 N m s, time: 5 s}",
        "motion.maneuver": "[]",
        "exposure": "{time: 10 ms, rate_hz: 1, frames: 1, first: 8 s}",
        "vehicle.disturbances": "{}",
    }
    return simulate_motion(loader.load("simsat_slew", changes)).telemetry()


def test_desaturation_compensates_the_lag_of_the_fans(relieved: Telemetry) -> None:
    """dh/dt = T, dT/dt = (-h / time - T) / lag: the wheels hold against the fans' torque, and slow down."""
    h0 = 0.010125 * 1800 * math.pi / 30
    run = solve_ivp(
        lambda _, y: [y[1], (-y[0] / 5 - y[1]) / 0.2],
        (0, 4),
        [h0, 0],
        rtol=1e-9,
        dense_output=True,
    )
    t_s = np.arange(0.5, 4, 0.5)
    held = np.interp(t_s, relieved.t_s, relieved.momentum_nms[:, 2])
    np.testing.assert_allclose(held, run.sol(t_s)[0], rtol=2e-3, atol=0)


def test_desaturation_ends_below_its_threshold_and_keeps_the_attitude(
    relieved: Telemetry,
) -> None:
    size = np.linalg.norm(relieved.momentum_nms, axis=1)
    assert size[0] > 1.7
    assert 0.7 < size[-1] < 0.8
    assert np.ptp(size[relieved.t_s > 7]) < 1e-3  # no stored momentum left to remove
    assert np.degrees(relieved.lab_from_body.magnitude()).max() < 0.02
