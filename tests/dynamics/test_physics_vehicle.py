"""The vehicle's motion against conservation laws and analytic solutions.

Every expected value here is computed independently of MuJoCo.
"""

from __future__ import annotations

import math

import mujoco
import numpy as np
import pytest
from scipy.integrate import solve_ivp
from scipy.optimize import brentq
from scipy.spatial.transform import Rotation
from scipy.special import ellipj, ellipk, elliprf, elliprj

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
SPINNING: dict[str, object] = {
    "mount": "free",
    "wheels": {"start_rpm": [3000, 2000, -1000]},
    "cmgs": {},
}


def vehicle_config(**changes: object) -> VehicleConfig:
    return VehicleConfig.model_validate(SIMSAT | changes)


def flown(
    vehicle: multibody.VehicleModel, lab_from_body: Rotation, rate: Floats, control: Floats
) -> multibody.Simulation:
    """A whole flight with a control (K, nu) for each step."""
    flight = multibody.Simulation(
        vehicle, lab_from_body, rate, len(control) * vehicle.model.opt.timestep
    )
    flight.advance(control)
    return flight


def still(vehicle: multibody.VehicleModel, duration_s: float) -> Floats:
    """(K, nu) zero controls."""
    return np.zeros((round(duration_s / vehicle.model.opt.timestep), vehicle.model.nu))


def carried(flight: multibody.Simulation, step: int) -> tuple[Floats, float]:
    """Angular momentum (3,) about the lab's origin and kinetic energy, summed over the bodies.

    L = sum m r x v + J w, from each body's velocity, position, mass and principal inertia in MuJoCo.
    """
    model = flight.model
    data = mujoco.MjData(flight.model)
    state = flight.states[step, 1:]
    data.qpos[:], data.qvel[:] = state[: model.nq], state[model.nq : model.nq + model.nv]
    mujoco.mj_forward(model, data)
    momentum = np.zeros(3)
    energy = 0.0
    velocity = np.zeros(6)
    for body in range(1, model.nbody):
        mujoco.mj_objectVelocity(model, data, mujoco.mjtObj.mjOBJ_BODY, body, velocity, 0)
        spin = velocity[:3]
        speed = velocity[3:]
        axes = data.ximat[body].reshape(3, 3)
        own = axes @ (model.body_inertia[body] * (spin @ axes))
        momentum += own + model.body_mass[body] * np.cross(data.xipos[body], speed)
        energy += (spin @ own + model.body_mass[body] * speed @ speed) / 2
    return momentum, energy


# --- what is kept -------------------------------------------------------------------------------------------


@pytest.mark.long
def test_angular_momentum_is_conserved_with_wheels_and_gimbals_driven() -> None:
    """To 1e-8 N m s: torques between the vehicle's parts do not change the total momentum.

    For 40 s of 60 s, random gimbal rates up to 1 rad/s and wheel torques up to 0.3 N m change every 0.1 s.
    """
    vehicle = multibody.build(vehicle_config(**SPINNING))
    rng = np.random.default_rng(4)
    control = still(vehicle, 60.0)
    control[:40_000, vehicle.gimbals.motor] = np.repeat(
        rng.uniform(-1, 1, (400, 4)), 100, axis=0
    )
    control[:40_000, vehicle.wheels.motor] = np.repeat(
        rng.uniform(-0.3, 0.3, (400, 3)), 100, axis=0
    )
    flight = flown(
        vehicle, Rotation.from_rotvec([0.3, -0.2, 0.5]), np.array([0.1, 0.2, -0.15]), control
    )
    kept = np.array([carried(flight, step) for step in range(0, 60_001, 2000)], dtype=object)
    momentum = np.stack(kept[:, 0])
    assert np.abs(momentum - momentum[0]).max() < 1e-8
    assert np.ptp(kept[:, 1].astype(float)) > 10  # J: they were driven indeed
    assert np.linalg.norm(momentum[0]) > 5


@pytest.mark.slow
def test_energy_and_momentum_are_conserved_without_control() -> None:
    """To 1e-8 J (of 1112) and 1e-8 N m s (of 5.6), with every wheel, rotor and gimbal free."""
    vehicle = multibody.build(vehicle_config(**SPINNING))
    # No servo holds the gimbals.
    vehicle.model.opt.disableflags |= int(mujoco.mjtDisableBit.mjDSBL_ACTUATION)
    flight = multibody.Simulation(
        vehicle, Rotation.from_rotvec([0.3, -0.2, 0.5]), np.array([0.1, 0.2, -0.15]), 60.0
    )
    flight.states[0, 1 + vehicle.model.nq + vehicle.gimbals.dof] = [0.5, -0.3, 0.2, 0.1]
    flight.advance(still(vehicle, 60.0))
    kept = [carried(flight, step) for step in range(0, 60_001, 2000)]
    assert np.ptp([energy for _, energy in kept]) < 1e-8
    assert np.ptp([momentum for momentum, _ in kept], axis=0).max() < 1e-8
    assert kept[0][1] > 1000
    assert np.ptp(flight.angles_rad[vehicle.gimbals.qpos]) > 1  # rad: they did swing


@pytest.mark.slow
def test_torque_free_motion_conserves_momentum_and_energy() -> None:
    """A tumble about the middle axis, a minute long: L in the lab and w.Jw/2 stay to 1e-11 of themselves."""
    vehicle = multibody.build(vehicle_config(mount="free"))
    flight = multibody.simulate(
        vehicle, Rotation.from_rotvec([0.3, 0.2, -1.0]), np.array([0.02, 1.0, 0.01]), 60.0
    )
    rate = flight.rate_body_rad_s
    momentum = flight.lab_from_body.apply(rate * INERTIA)
    assert np.abs(momentum - momentum[0]).max() < 1e-11 * np.linalg.norm(momentum[0])
    energy = (rate**2 @ INERTIA) / 2
    assert np.ptp(energy) < 1e-11 * energy[0]
    assert rate[:, 1].min() < -0.9  # it did flip, as a body spun about its middle axis must


# --- what theory solves -------------------------------------------------------------------------------------


@pytest.mark.parametrize(("axis", "name"), [(0, "roll"), (1, "pitch")])
def test_bottom_heavy_vehicle_is_a_pendulum(axis: int, name: str) -> None:
    """T = 4 sqrt(I / m g d) K(sin^2(amplitude / 2)), from rest at 20 deg. The bar is 1e-6; 1e-9 is a root finder's."""
    below_m = 5e-3
    amplitude = math.radians(20)
    vehicle = multibody.build(vehicle_config(center_of_mass=["0 m", "0 m", "-5 mm"]))
    period = (
        4
        * math.sqrt(INERTIA[axis] / (80 * 9.80665 * below_m))
        * ellipk(math.sin(amplitude / 2) ** 2)
    )
    flight = multibody.simulate(
        vehicle, Rotation.from_rotvec(amplitude * np.eye(3)[axis]), STILL, 1.3 * period
    )

    def angle(t_s: float) -> float:
        return flight.attitude_at(t_s).as_rotvec()[axis]

    down = brentq(angle, 0.0, 0.5 * period, xtol=1e-12)
    up = brentq(angle, 0.5 * period, period, xtol=1e-12)
    assert 4 * down == pytest.approx(period, rel=1e-9), name
    assert 2 * (up - down) == pytest.approx(period, rel=1e-9), name


def third_kind(n: Floats, amplitude: Floats, m: float) -> Floats:
    """Legendre's incomplete integral of the third kind, by Carlson's forms (DLMF 19.25.14), for every amplitude."""
    half_turns = np.round(amplitude / np.pi)
    sine = np.sin(amplitude - half_turns * np.pi)
    cosine = np.cos(amplitude - half_turns * np.pi)
    delta = 1 - m * sine**2
    pole = 1 - n * sine**2
    part = sine * elliprf(cosine**2, delta, 1) + n / 3 * sine**3 * elliprj(
        cosine**2, delta, 1, pole
    )
    complete = elliprf(0, 1 - m, 1) + n / 3 * elliprj(0, 1 - m, 1, 1 - n)
    return part + 2 * half_turns * complete


def asymmetric_top(
    inertia: Floats, first: float, third: float, t_s: Floats
) -> tuple[Floats, Rotation]:
    """Rates (N, 3) in body axes and body_start_from_body of a free top: Jacobi's solution.

    It starts with the rates (first, 0, third) about its first and third axes, and is to circle about the third: the
    second moment lies between the others, and L^2 is on the third axis' side of 2 E I2. Euler's angles (3-1-3) about
    the momentum: tilt and spin from J w = L (sin a sin c, sin a cos c, cos a), precession by

        d(precession)/dt = L (2 E - I3 w3^2) / (L^2 - I3^2 w3^2)

    which is L / I3 and an elliptic integral of the third kind. Landau & Lifshitz, Mechanics, section 37 (`assumed`).
    """
    i1, i2, i3 = inertia
    energy2 = i1 * first**2 + i3 * third**2
    squared = (i1 * first) ** 2 + (i3 * third) ** 2
    pace = math.sqrt((i3 - i2) * (squared - energy2 * i1) / (i1 * i2 * i3))
    m = (i2 - i1) * (energy2 * i3 - squared) / ((i3 - i2) * (squared - energy2 * i1))
    assert 0 < m < 1
    second = math.copysign(
        math.sqrt((energy2 * i3 - squared) / (i2 * (i3 - i2))), (i3 - i1) * first * third
    )
    sn, cn, dn, amplitude = ellipj(pace * t_s, m)
    rate = np.stack([first * cn, second * sn, third * dn], axis=1)

    size = math.sqrt(squared)
    leans = (
        1 - (i2 * second / (i1 * first)) ** 2
    )  # L^2 - I3^2 w3^2 = (I1 first)^2 (1 - leans sn^2)
    swing = size * (energy2 - squared / i3) / (i1 * first) ** 2 / pace
    precession = size / i3 * t_s + swing * third_kind(np.array(leans), amplitude, m)
    own = rate * inertia / size
    angles = np.stack(
        [precession, np.arccos(own[:, 2]), np.arctan2(own[:, 0], own[:, 1])], axis=1
    )
    momentum_from_body = Rotation.from_euler("ZXZ", angles)
    return rate, momentum_from_body[0].inv() * momentum_from_body


@pytest.mark.slow
@pytest.mark.parametrize(
    ("inertia", "first", "third"),
    [((6.0, 6.5, 9.0), 0.3, 0.8), ((9.0, 6.5, 6.0), 0.2, 1.0), ((6.0, 6.5, 9.0), 0.9, 0.33)],
    ids=["about the greatest moment", "about the least", "nearly about the middle one"],
)
def test_an_asymmetric_top_follows_jacobi_s_solution(
    inertia: tuple[float, float, float], first: float, third: float
) -> None:
    """Required: 1e-6 rad within 60 s; rounding allows 1e-12."""
    vehicle = multibody.build(
        vehicle_config(mount="free", inertia=[f"{moment} kg m2" for moment in inertia])
    )
    lab_from_start = Rotation.from_rotvec([0.4, -1.1, 0.7])
    flight = multibody.simulate(vehicle, lab_from_start, np.array([first, 0.0, third]), 60.0)
    some = np.arange(0, 60_001, 500)
    rate, start_from_body = asymmetric_top(np.array(inertia), first, third, flight.t_s[some])
    apart = (lab_from_start * start_from_body).inv() * flight.lab_from_body[some]
    np.testing.assert_allclose(flight.rate_body_rad_s[some], rate, rtol=0, atol=1e-11)
    assert apart.magnitude().max() < 1e-11


def test_a_heavy_top_agrees_with_an_independent_integrator() -> None:
    """Euler's equation with gravity's torque, c x m g, by scipy's DOP853: a fast, unbalanced tumble."""
    center = np.array([3e-3, -2e-3, 5e-3])
    vehicle = multibody.build(
        vehicle_config(center_of_mass=["3 mm", "-2 mm", "5 mm"], tilt_stop_deg=89)
    )
    begin = Rotation.from_rotvec([0.2, 0.1, 0.5])
    rate = np.array([0.1, -0.2, 2.0])

    def law(_: float, state: Floats) -> Floats:
        spin = state[4:]
        (x, y, z, w) = state[:4]
        down_body = Rotation.from_quat(state[:4]).apply([0, 0, -9.80665], inverse=True)
        torque = np.cross(center, 80 * down_body) - np.cross(spin, INERTIA * spin)
        turn = np.array([[w, -z, y], [z, w, -x], [-y, x, w], [-x, -y, -z]]) @ spin / 2
        return np.concatenate([turn, torque / INERTIA])

    run = solve_ivp(
        law, (0, 5), [*begin.as_quat(), *rate], method="DOP853", rtol=1e-12, atol=1e-13
    )
    flight = multibody.simulate(vehicle, begin, rate, 5.0)
    # The stop had no part.
    assert (flight.lab_from_body.as_matrix()[:, 2, 2] > math.cos(math.radians(85))).all()
    assert (
        Rotation.from_quat(run.y[:4, -1]).inv() * flight.attitude_at(5.0)
    ).magnitude() < 1e-9
    np.testing.assert_allclose(flight.rate_body_rad_s[-1], run.y[4:, -1], rtol=0, atol=1e-9)


# --- gyroscopes ---------------------------------------------------------------------------------------------


def axle(k: int, angle_rad: float) -> Floats:
    """(3,) where simsat.xml has the axle of CMG k: along y across its gimbal, the k-th quarter of the pyramid."""
    gimbal = np.array([0.81650, 0, 0.57735]) / math.hypot(0.81650, 0.57735)
    place = Rotation.from_euler("z", 90 * k, degrees=True)
    return (place * Rotation.from_rotvec(angle_rad * gimbal)).apply([0, 1, 0])


ROTOR_KG_M2 = 1.8 * 0.05**2 / 2  # simsat.xml's rotors: cylinders of 1.8 kg and 5 cm


@pytest.mark.parametrize("k", [0, 1, 2, 3])
def test_torque_of_a_cmg_is_gimbal_rate_times_momentum(k: int) -> None:
    """The issue's bar, 1e-6: to hold the vehicle while a gimbal turns steadily takes d(angle)/dt x h.

    By MuJoCo's inverse dynamics, no part accelerating; h by hand, 2600 rpm of a rotor at an angle of 0.6 rad.
    """
    vehicle = multibody.build(vehicle_config(mount="free", cmgs={}))
    data = mujoco.MjData(vehicle.model)
    rate_rad_s = 0.7
    h = ROTOR_KG_M2 * 2600 * math.pi / 30
    data.qpos[vehicle.gimbals.qpos[k]], data.qvel[vehicle.gimbals.dof[k]] = 0.6, rate_rad_s
    data.qvel[vehicle.rotors.dof] = 2600 * math.pi / 30
    mujoco.mj_inverse(vehicle.model, data)
    gimbal = Rotation.from_euler("z", 90 * k, degrees=True).apply(
        [0.81650, 0, 0.57735]
    ) / math.hypot(0.81650, 0.57735)
    expected = h * np.cross(rate_rad_s * gimbal, axle(k, 0.6))
    np.testing.assert_allclose(
        data.qfrc_inverse[:3], expected, rtol=0, atol=1e-6 * h * rate_rad_s
    )
    assert np.linalg.norm(expected) == pytest.approx(h * rate_rad_s, rel=1e-12)


def test_a_free_vehicle_gains_the_momentum_that_gimballed_rotors_lose() -> None:
    """At rest, then all four gimbals turn by half a radian and stop: J w = h(before) - h(after), turned along.

    Each rotor keeps I (its own spin + the body's about its axle), for it has no motor and no friction; by hand all
    but the inertia of the vehicle with its gimbals as they then stand.
    """
    vehicle = multibody.build(vehicle_config(mount="free", cmgs={"rotor_rpm": 2600}))
    control = still(vehicle, 1.5)
    control[:500, vehicle.gimbals.motor] = [1.0, -0.8, 0.6, 1.0]
    flight = flown(vehicle, LEVEL, STILL, control)
    angles = flight.angles_rad[vehicle.gimbals.qpos]
    np.testing.assert_allclose(angles, [0.5, -0.4, 0.3, 0.5], rtol=0, atol=1e-2)
    h = ROTOR_KG_M2 * 2600 * math.pi / 30
    before = h * sum(axle(k, 0.0) for k in range(4))
    axles = np.stack([axle(k, angles[k]) for k in range(4)], axis=1)
    data = mujoco.MjData(vehicle.model)
    data.qpos[:] = flight.angles_rad
    mujoco.mj_forward(vehicle.model, data)
    everything = np.zeros((vehicle.model.nv, vehicle.model.nv))
    mujoco.mj_fullM(vehicle.model, data, everything)
    without_spin = everything[:3, :3] - ROTOR_KG_M2 * axles @ axles.T
    body_from_lab = Rotation.from_quat(flight.lab_from_body_wxyz, scalar_first=True).inv()
    given = body_from_lab.apply(before) - h * axles.sum(axis=1)
    got = without_spin @ flight.rate_body_rad_s
    np.testing.assert_allclose(got, given, rtol=0, atol=1e-6 * np.linalg.norm(given))
    assert np.linalg.norm(given) > 0.4  # N m s


# --- poses inside an exposure -------------------------------------------------------------------------------


def apart_from_a_finer_run_rad(
    vehicle: multibody.VehicleModel, rate: Floats, control: Floats
) -> Floats:
    """(N,) poses asked for between the steps of a flight, against the samples of one stepped ten times finer.

    Nine times in each step; ship's step is changed.
    """
    begin = Rotation.from_rotvec([0.1, -0.2, 0.1])
    coarse = flown(vehicle, begin, rate, control).trajectory()
    vehicle.model.opt.timestep /= 10
    fine = flown(vehicle, begin, rate, np.repeat(control, 10, axis=0)).trajectory()
    inside = np.arange(len(fine.t_s))[np.arange(len(fine.t_s)) % 10 > 0]
    return (
        fine.lab_from_body[inside].inv() * coarse.attitude_at(fine.t_s[inside])
    ).magnitude()


def test_the_pose_within_an_exposure_is_exact_for_a_tumbling_vehicle() -> None:
    """2 rad/s under torques of up to 1 N m that change each 10 ms: within 1e-11 rad of the finer run."""
    vehicle = multibody.build(vehicle_config(mount="free"))
    control = still(vehicle, 2.0)
    t = np.repeat(np.arange(200), 10) * 0.01
    control[:, vehicle.torques] = np.sin(7 * t[:, None] + np.array([0.0, 1.0, 2.0]))
    assert (
        apart_from_a_finer_run_rad(vehicle, np.array([1.0, 1.5, -1.0]), control).max() < 1e-11
    )


def test_the_pose_within_an_exposure_is_exact_with_unbalanced_wheels() -> None:
    """3000 rpm, 1 g cm and 1 g cm2 out of balance, on the bearing: within 3e-9 rad, 0.6 milliarcseconds.

    The shaking is 200 times that. A step is a twentieth of a wheel's turn; what Runge and Kutta lose in the rate of
    the first turn, some 1e-9 rad/s, is what the two runs drift apart by.
    """
    shaking: dict[str, object] = {
        "static_imbalance": "1 g cm",
        "dynamic_imbalance": "1e-7 kg m2",
    }
    shaking |= {"start_rpm": [3000, -2900, 2800]}
    vehicle = multibody.build(
        vehicle_config(wheels=shaking, center_of_mass=["20 um", "-10 um", "-50 um"])
    )
    apart = apart_from_a_finer_run_rad(
        vehicle, np.array([0.05, 0.1, -0.2]), still(vehicle, 2.0)
    )
    assert apart.max() < 3e-9


@pytest.mark.slow
def test_the_pose_within_an_exposure_is_exact_with_driven_gimbals() -> None:
    """CMGs at 2600 rpm whose gimbal rates change every 10 ms: within 1e-9 rad."""
    vehicle = multibody.build(vehicle_config(cmgs={}))
    rng = np.random.default_rng(6)
    control = still(vehicle, 2.0)
    control[:, vehicle.gimbals.motor] = np.repeat(rng.uniform(-1, 1, (200, 4)), 10, axis=0)
    apart = apart_from_a_finer_run_rad(vehicle, np.array([0.05, 0.1, -0.2]), control)
    assert apart.max() < 1e-9
