"""Cold-gas thrusters against momentum, the rocket equation's flow, and the closed form of a lag."""

from __future__ import annotations

import math

import numpy as np
import pytest
from scipy.integrate import quad
from scipy.spatial.transform import Rotation, Slerp

from skysim.core.types import Floats
from skysim.dynamics import multibody
from skysim.dynamics.flight_computer import authority_nm, usage
from skysim.dynamics.multibody.actuator_kind import ControlInput
from skysim.dynamics.multibody.model import build_actuators, build_drives
from skysim.dynamics.multibody.thrusters import ThrusterActuator, ValveDrive
from skysim.results.telemetry_report import summary
from skysim.scene import loader
from skysim.scene.sections.vehicle import VehicleConfig
from skysim.simulation import motion
from skysim.simulation.checks import plan_check
from skysim.simulation.flight import open_flight, simulate_motion
from skysim.simulation.lab import build_lab

INERTIA = np.diag([5.5, 5.8, 8.0])
SHIP = {
    "model": "vehicles/simsat_thrusters.xml",
    "mount": "free",
    "mass": "70 kg",
    "inertia": ["5.5 kg m2", "5.8 kg m2", "8 kg m2"],
    "center_of_mass": ["0 m", "0 m", "0 m"],
}
# The file's thrusters by hand, in the order of their names: axes of torque, and its size for each newton.
AXES = np.array([[-1, 0, 0], [1, 0, 0], [0, -1, 0], [0, 1, 0], [0, 0, -1], [0, 0, 1]]).repeat(
    2, axis=0
)
LEVERS = AXES * np.repeat([0.46, 0.46, 0.33 * math.sqrt(2)], 4)[:, None]
G0 = 9.80665
STEP_S = 1e-3
PERIOD = 10  # steps


def ship(**thrusters: str) -> multibody.VehicleModel:
    return multibody.build(VehicleConfig.model_validate(SHIP | {"thrusters": thrusters}))


def valves(**thrusters: str) -> tuple[multibody.VehicleModel, ValveDrive]:
    vehicle = ship(**thrusters)
    (drive,) = build_drives(vehicle.config, vehicle)
    assert isinstance(drive, ValveDrive)
    return vehicle, drive


def given(vehicle: multibody.VehicleModel, drive: ValveDrive, wanted_n: Floats) -> Floats:
    """(K, PERIOD, 12) thrusts at every step, for thrusts (K, 12) that are wanted in each period."""
    rows = []
    for wanted in wanted_n:
        control = np.zeros((PERIOD, vehicle.model.nu))
        control[:, vehicle.thrusters.motor] = wanted
        drive.apply(control, vehicle.model.qpos0)
        rows.append(control[:, vehicle.thrusters.motor])
    return np.array(rows)


def inputs() -> ControlInput:
    return ControlInput(0.0, 0.01, np.zeros(3), np.zeros(0), np.zeros(0))


def computer(**thrusters: str) -> tuple[multibody.VehicleModel, ThrusterActuator]:
    vehicle = ship(**thrusters)
    found = build_actuators(vehicle.config, vehicle)["thrusters"]
    assert isinstance(found, ThrusterActuator)
    return vehicle, found


def test_the_angular_momentum_of_a_free_vehicle_is_the_integral_of_the_thrusts_torque() -> (
    None
):
    """L(t) - L(0) = integral of lab_from_body T dt, by Simpson's rule, over a tumble with random pulses."""
    vehicle, drive = valves()
    wanted = np.random.default_rng(3).uniform(-0.3, 0.5, (300, 12)) * np.tile(
        [1, 1, 0.2, 0.2], 3
    )
    thrust = given(vehicle, drive, wanted).reshape(-1, 12)
    control = np.zeros((len(thrust), vehicle.model.nu))
    control[:, vehicle.thrusters.motor] = thrust
    flight = multibody.Simulation(
        vehicle, Rotation.identity(), np.array([0.2, -0.3, 0.1]), len(thrust) * STEP_S
    )
    flight.advance(control)
    t_s, wxyz, rate = flight.knots()
    attitude = Rotation.from_quat(wxyz, scalar_first=True)
    # Between two knots the angle is quadratic in time.
    halfway = Slerp(t_s, attitude)(t_s[:-1] + STEP_S / 2)
    halfway *= Rotation.from_rotvec(-np.diff(rate, axis=0) * STEP_S / 8)
    torque = thrust @ LEVERS
    mean = (attitude[:-1].apply(torque) + attitude[1:].apply(torque)) / 6
    pushed = (mean + 4 / 6 * halfway.apply(torque)).sum(axis=0) * STEP_S
    ends = attitude[[0, -1]].apply(rate[[0, -1]] @ INERTIA)
    change = ends[1] - ends[0]
    assert np.linalg.norm(change) > 0.3
    np.testing.assert_allclose(change, pushed, rtol=0, atol=1e-9 * np.linalg.norm(change))


@pytest.mark.parametrize("supply", ["regulated", "blowdown"])
def test_the_propellant_is_that_of_the_impulse(supply: str) -> None:
    vehicle, drive = valves(specific_impulse="65 s", supply=supply)
    wanted = np.random.default_rng(5).uniform(0, 0.5, (200, 12))
    impulse = given(vehicle, drive, wanted).sum() * STEP_S
    used = 0.3 - float(drive.readings["propellant_kg"])
    assert used == pytest.approx(impulse / (65 * G0), rel=1e-12)
    assert used > 5e-3


@pytest.mark.parametrize(
    ("shortest_mns", "share"),
    [(2.5, 0.1), (2.5, 0.03), (12.0, 0.1), (12.0, 0.7), (0.0, 0.013)],
)
def test_no_pulse_is_shorter_than_the_minimum_and_the_mean_is_right(
    shortest_mns: float, share: float
) -> None:
    """A constant demand, 5 mN s a period in full: pulses of 12 mN s last more than two periods."""
    vehicle, drive = valves(minimum_impulse=f"{shortest_mns} mN s", time_constant="0 s")
    wanted = np.full((400, 12), 0.5 * share)
    thrust = given(vehicle, drive, wanted)[..., 0].ravel()
    total = wanted[:, 0].sum() * 0.01
    # At the end a pulse may be owed, or one may have gone on.
    assert abs(thrust.sum() * STEP_S - total) <= shortest_mns * 1e-3 + 1e-12
    edges = np.flatnonzero(np.diff(np.concatenate(([0], thrust > 0, [0]))))
    pulses = np.add.reduceat(np.append(thrust, 0), edges)[::2] * STEP_S
    assert pulses[:-1].min() >= shortest_mns * 1e-3 - 1e-12
    assert thrust.max() <= 0.5 + 1e-12


def test_the_duty_is_the_mean_of_random_demands() -> None:
    vehicle, drive = valves()
    wanted = np.random.default_rng(8).uniform(0, 0.5, (500, 12))
    duty = []
    for row in wanted:
        given(vehicle, drive, row[None])
        duty.append(drive.readings["thruster_duty"])
    # What is owed at the end is less than a pulse of 2.5 mN s.
    np.testing.assert_allclose(
        np.mean(duty, axis=0), wanted.mean(axis=0) / 0.5, rtol=0, atol=2.5e-3 / (0.5 * 5)
    )
    assert np.min(duty) == 0 < np.max(duty) <= 1 + 1e-12


def test_thrust_follows_its_valve_with_the_lag() -> None:
    """F (1 - exp(-t / tau)) for 43 ms, then it decays: the mean of each step by quadrature."""
    tau = 7e-3
    vehicle, drive = valves(time_constant="7 ms", minimum_impulse="0 N s")
    wanted = np.zeros((8, 12))
    wanted[:4] = 0.5
    wanted[4] = 0.5 * 0.3  # open for 3 ms of the fifth period
    thrust = given(vehicle, drive, wanted)[..., 7].ravel()

    def theory(t: float) -> float:
        opened = 0.5 * (1 - math.exp(-min(t, 0.043) / tau))
        return opened * math.exp(-max(t - 0.043, 0) / tau)

    mean = [quad(theory, k * STEP_S, (k + 1) * STEP_S)[0] / STEP_S for k in range(80)]
    np.testing.assert_allclose(thrust, mean, rtol=0, atol=1e-12)


def test_an_empty_tank_ends_the_thrust() -> None:
    """Twelve thrusters of 0.5 N burn 1 g in 1e-3 60 g0 / 6 N = 98 ms."""
    vehicle, drive = valves(propellant="1 g", time_constant="0 s")
    thrust = given(vehicle, drive, np.full((20, 12), 0.5)).reshape(-1, 12)
    assert thrust.sum() * STEP_S == pytest.approx(1e-3 * 60 * G0, rel=1e-12)
    np.testing.assert_allclose(thrust[:98], 0.5, rtol=1e-11)
    assert not thrust[99:].any()
    assert float(drive.readings["propellant_kg"]) == 0.0


def test_blowdown_decays_exponentially() -> None:
    """dm/dt = -12 F0 (m / m0) / (Isp g0): m = m0 exp(-12 F0 t / (m0 Isp g0)); F is that of the period's start."""
    vehicle, drive = valves(propellant="20 g", time_constant="0 s", supply="blowdown")
    thrust = given(vehicle, drive, np.full((200, 12), 0.5))
    decay = math.exp(-12 * 0.5 * 2.0 / (0.02 * 60 * G0))
    assert float(drive.readings["propellant_kg"]) == pytest.approx(0.02 * decay, rel=6e-3)
    assert thrust[-1, 0, 0] == pytest.approx(0.5 * decay, rel=1e-2)
    assert decay < 0.4


def test_allocation_is_one_sided_optimal_and_exact() -> None:
    """Karush, Kuhn, Tucker: the gradient A^T (A f - T) + e f is zero where f > 0 and not negative elsewhere."""
    vehicle, actuator = computer(thrust="50 N")
    weight = (1e-4 * np.linalg.norm(LEVERS)) ** 2
    for torque in np.random.default_rng(2).normal(size=(50, 3)):
        control = np.zeros(vehicle.model.nu)
        achieved = actuator.allocate(control, torque, inputs())
        thrust = control[vehicle.thrusters.motor]
        assert thrust.min() >= 0
        np.testing.assert_allclose(achieved, torque, rtol=0, atol=1e-7 * np.abs(torque).max())
        np.testing.assert_allclose(thrust @ LEVERS, achieved, rtol=0, atol=1e-12)
        gradient = LEVERS @ (thrust @ LEVERS - torque) + weight * thrust
        np.testing.assert_allclose(gradient[thrust > 0], 0, atol=1e-12)
        assert gradient.min() > -1e-12


def test_a_torque_beyond_the_thrusts_keeps_its_direction() -> None:
    """A couple of two thrusters of 0.5 N at 0.46 m gives 0.46 N m; the authority is that of the shortest arm."""
    vehicle, actuator = computer()
    control = np.zeros(vehicle.model.nu)
    achieved = actuator.allocate(control, np.array([4.6, -2.3, 0.0]), inputs())
    np.testing.assert_allclose(achieved, [0.46, -0.23, 0], rtol=0, atol=1e-7)
    assert control.max() == pytest.approx(0.5)
    assert authority_nm(actuator) == pytest.approx(0.46, rel=1e-6)
    torques = np.array([[0.46, 0, 0], [0, -0.23, 0], [0.1, -0.23, 0.2]])
    np.testing.assert_allclose(usage(actuator, torques), [1, 0.5, 0.5], rtol=1e-6)


@pytest.mark.slow
def test_the_thruster_scene_flies_on_the_propellant_of_its_forecast() -> None:
    """Rest to rest twice; the forecast is of continuous thrusts on the reference, the flight of pulses."""
    scene = loader.load("simsat_thrusters")
    lab = build_lab(scene)
    forecast = motion.forecast_torque(lab)
    assert forecast is not None
    log = simulate_motion(scene).telemetry()
    flown_kg = log.readings["propellant_kg"][0] - log.readings["propellant_kg"][-1]
    assert flown_kg == pytest.approx(forecast.propellant_kg, rel=0.03)
    assert summary(log)["propellant_g_used"] == pytest.approx(1e3 * flown_kg)
    assert (np.diff(log.readings["propellant_kg"]) <= 0).all()
    assert summary(log)["pointing_deg_worst"] < 0.05
    assert set(log.loads) == {
        f"thruster_{a}{s}_{n}" for a in "xyz" for s in "pn" for n in "12"
    }


@pytest.mark.slow
def test_check_tells_the_propellant_and_warns_of_too_little() -> None:
    lab = build_lab(loader.load("simsat_thrusters", {"vehicle.thrusters.propellant": "5 g"}))
    checked = plan_check.check(lab)
    fact = next(fact for fact in checked.facts if fact.name == "propellant")
    assert fact.values["propellant_kg"] == 5e-3
    assert 8e-3 < fact.values["needed_kg"] < 11e-3
    assert any(line.startswith("vehicle.thrusters.propellant") for line in checked.findings)


def test_the_state_tells_duty_and_propellant() -> None:
    with open_flight(loader.load("simsat_thrusters")) as flight:
        assert float(flight.state.readings["propellant_kg"]) == 0.3
        flight.step(np.array([0.276, 0.0, 0.0]))
        readings = flight.state.readings
    # Both thrusters of the couple of 0.46 N m about +x, for 0.6 of the period.
    np.testing.assert_allclose(
        readings["thruster_duty"], [0, 0, 0.6, 0.6] + 8 * [0], rtol=0, atol=1e-6
    )
    assert 0.29 < float(readings["propellant_kg"]) < 0.3
