"""The flown vehicle against the laws of mechanics and against MuJoCo's own camera."""

from __future__ import annotations

import math
from pathlib import Path

import mujoco
import numpy as np
import pytest
import yaml
from scipy.integrate import solve_ivp
from scipy.optimize import brentq
from scipy.spatial.transform import Rotation
from scipy.special import ellipk

from skysim import scene, world
from skysim.control import pid, plan, start
from skysim.types import BadInput, Trajectory

STILL = np.zeros(3)
LEVEL = Rotation.identity()
INERTIA = np.array([6.0, 6.5, 9.0])
SIMSAT = {"model": "vehicles/simsat.xml", "mass": "80 kg", "inertia": ["6 kg m2", "6.5 kg m2", "9 kg m2"]}


def vehicle(**changes: object) -> scene.Vehicle:
    return scene.Vehicle.model_validate(SIMSAT | changes)


def tilt_deg(flight: Trajectory) -> np.ndarray:
    up = flight.lab_from_body.as_matrix()[:, :, 2]
    return np.degrees(np.arctan2(np.hypot(up[:, 0], up[:, 1]), up[:, 2]))


def yaw_deg(flight: Trajectory) -> np.ndarray:
    return np.degrees(np.unwrap(flight.lab_from_body.as_euler("ZYX")[:, 0]))


# --- the laws -----------------------------------------------------------------------------------------------


@pytest.mark.parametrize(("axis", "name"), [(0, "roll"), (1, "pitch")])
def test_bottom_heavy_vehicle_is_a_pendulum(axis: int, name: str) -> None:
    """T = 4 sqrt(I / m g d) K(sin^2(amplitude / 2)), from rest at 20 deg; 1e-9 is a root finder's."""
    below_m, amplitude = 5e-3, math.radians(20)
    flown = world.build(vehicle(centre_of_mass=["0 m", "0 m", "-5 mm"]))
    period = 4 * math.sqrt(INERTIA[axis] / (80 * 9.80665 * below_m)) * ellipk(math.sin(amplitude / 2) ** 2)
    flight = world.fly(flown, Rotation.from_rotvec(amplitude * np.eye(3)[axis]), STILL, 1.3 * period)

    def angle(t_s: float) -> float:
        return flight.at(t_s).as_rotvec()[axis]

    down, up = brentq(angle, 0.0, 0.5 * period, xtol=1e-12), brentq(angle, 0.5 * period, period, xtol=1e-12)
    assert 4 * down == pytest.approx(period, rel=1e-9), name
    assert 2 * (up - down) == pytest.approx(period, rel=1e-9), name


def test_torque_free_motion_keeps_momentum_and_energy() -> None:
    """A tumble about the middle axis, a minute long: L in the lab and w.Jw/2 stay to 1e-11 of themselves."""
    flown = world.build(vehicle(mount="free"))
    flight = world.fly(flown, Rotation.from_rotvec([0.3, 0.2, -1.0]), np.array([0.02, 1.0, 0.01]), 60.0)
    rate = flight.rate_body_rad_s
    momentum = flight.lab_from_body.apply(rate * INERTIA)
    assert np.abs(momentum - momentum[0]).max() < 1e-11 * np.linalg.norm(momentum[0])
    energy = (rate**2 @ INERTIA) / 2
    assert np.ptp(energy) < 1e-11 * energy[0]
    assert rate[:, 1].min() < -0.9  # it did flip, as a body spun about its middle axis must


def test_sphere_keeps_its_rate() -> None:
    """The SHEFEX-2 scene's law of motion: lab_from_body = start * exp(w t)."""
    given = yaml.safe_load((scene.SCENES / "shefex2.yaml").read_text(encoding="utf-8"))["vehicle"]
    flown = world.build(scene.Vehicle.model_validate(given))
    begin, rate = Rotation.from_rotvec([0.1, -0.7, 0.4]), np.radians([0.3, 0.4, 0.0])
    flight = world.fly(flown, begin, rate, 10.0)
    expected = begin * Rotation.from_rotvec(10.0 * rate)
    assert (expected.inv() * flight.at(10.0)).magnitude() < 1e-12
    np.testing.assert_allclose(flight.rate_body_rad_s[-1], rate, rtol=0, atol=1e-14)


def test_heavy_top_against_an_integrator_of_its_own() -> None:
    """Euler's equation with gravity's torque, c x m g, by scipy's DOP853: a fast, unbalanced tumble."""
    centre = np.array([3e-3, -2e-3, 5e-3])
    flown = world.build(vehicle(centre_of_mass=["3 mm", "-2 mm", "5 mm"], tilt_stop_deg=89))
    begin, rate = Rotation.from_rotvec([0.2, 0.1, 0.5]), np.array([0.1, -0.2, 2.0])

    def law(_: float, state: np.ndarray) -> np.ndarray:
        (x, y, z, w), spin = state[:4], state[4:]
        down_body = Rotation.from_quat(state[:4]).apply([0, 0, -9.80665], inverse=True)
        torque = np.cross(centre, 80 * down_body) - np.cross(spin, INERTIA * spin)
        turn = np.array([[w, -z, y], [z, w, -x], [-y, x, w], [-x, -y, -z]]) @ spin / 2
        return np.concatenate([turn, torque / INERTIA])

    run = solve_ivp(law, (0, 5), [*begin.as_quat(), *rate], method="DOP853", rtol=1e-12, atol=1e-13)
    flight = world.fly(flown, begin, rate, 5.0)
    assert tilt_deg(flight).max() < 85  # the stop had no part in it
    assert (Rotation.from_quat(run.y[:4, -1]).inv() * flight.at(5.0)).magnitude() < 1e-9
    np.testing.assert_allclose(flight.rate_body_rad_s[-1], run.y[4:, -1], rtol=0, atol=1e-9)


@pytest.mark.parametrize("axis", [0, 1, 2])
def test_motor_turns_its_axis_and_stops_at_its_limit(axis: int) -> None:
    """w = T t / I: ask for 5 N m, of a motor that has 0.5."""
    flown = world.build(vehicle(torque_limit="0.5 N m"))
    flight = world.fly(flown, LEVEL, STILL, 2.0, lambda *_: 5.0 * np.eye(3)[axis])
    expected = np.eye(3)[axis] * 0.5 * 2.0 / INERTIA[axis]
    np.testing.assert_allclose(flight.rate_body_rad_s[-1], expected, rtol=0, atol=1e-12)


# --- mass properties ----------------------------------------------------------------------------------------


def test_vehicle_weighs_what_the_scene_declares() -> None:
    """MuJoCo's own totals: mass of the tree, its centre in the lab, its joint-space inertia."""
    centre = np.array([20e-6, -10e-6, -50e-6])
    flown = world.build(vehicle(centre_of_mass=["20 um", "-10 um", "-50 um"]))
    data = mujoco.MjData(flown.model)
    mujoco.mj_forward(flown.model, data)
    bus = flown.model.body("bus").id
    assert flown.model.body_subtreemass[bus] == pytest.approx(80, rel=1e-12)
    np.testing.assert_allclose(data.subtree_com[bus], centre, rtol=0, atol=1e-12)
    joint_space = np.zeros((3, 3))
    mujoco.mj_fullM(flown.model, data, joint_space)
    np.testing.assert_allclose(joint_space, np.diag(INERTIA), rtol=0, atol=1e-10)


def test_balance_masses_do_not_move_the_camera() -> None:
    moved = world.build(vehicle(centre_of_mass=["1 cm", "0 m", "-2 cm"]))
    np.testing.assert_allclose(world.mount(moved).camera_body_m, [0, 0, 0.381], rtol=0, atol=1e-15)


def test_undeclared_mass_is_the_files_own() -> None:
    """The sum of the geoms in simsat.xml, read as text."""
    text = (scene.SCENES / "vehicles" / "simsat.xml").read_text(encoding="utf-8")
    spec = mujoco.MjSpec.from_string(text)
    listed = sum(geom.mass for geom in spec.geoms)
    own = world.build(scene.Vehicle.model_validate({"model": "vehicles/simsat.xml"}))
    assert own.mass.mass_kg == pytest.approx(listed, rel=1e-12)
    np.testing.assert_allclose(own.mass.centre_m, np.zeros(3), rtol=0, atol=1e-12)


def test_mass_less_than_what_the_bus_carries_is_refused() -> None:
    with pytest.raises(
        BadInput, match=r"vehicle.mass: 5 kg leaves nothing for the bus, which carries 20.6 kg"
    ):
        world.build(vehicle(mass="5 kg"))
    with pytest.raises(BadInput, match=r"vehicle.inertia: .* which no rigid body has"):
        world.build(vehicle(inertia=["0.5 kg m2"] * 3))


# --- camera -------------------------------------------------------------------------------------------------


def test_mount_is_mujocos_own_camera() -> None:
    """At a rotated pose: place of the camera, and the columns of xmat (right, up, backwards)."""
    flown = world.build(vehicle())
    seat = world.mount(flown)
    lab_from_body = Rotation.from_euler("ZYX", [40, -12, 17], degrees=True)
    data = mujoco.MjData(flown.model)
    data.qpos[:4] = lab_from_body.as_quat(scalar_first=True)
    mujoco.mj_forward(flown.model, data)
    camera = data.camera("star_camera")
    np.testing.assert_allclose(lab_from_body.apply(seat.camera_body_m), camera.xpos, rtol=0, atol=1e-14)
    lab_from_cam = (lab_from_body * seat.cam_from_body.inv()).as_matrix()
    right, up, back = camera.xmat.reshape(3, 3).T
    np.testing.assert_allclose(lab_from_cam.T, [right, -up, -back], rtol=0, atol=1e-14)


def test_camera_leans_the_way_the_vehicle_rolls() -> None:
    """By hand: rolled by +30 deg about lab x, body +z, and so the boresight, leans towards lab -y."""
    seat = world.mount(world.build(vehicle()))
    lab_from_body = Rotation.from_euler("x", 30, degrees=True)
    boresight_lab = (seat.cam_from_body * lab_from_body.inv()).apply([0, 0, 1], inverse=True)
    np.testing.assert_allclose(boresight_lab, [0, -0.5, math.sqrt(0.75)], rtol=0, atol=1e-15)
    place = [0, -0.1905, 0.381 * math.sqrt(0.75)]
    np.testing.assert_allclose(lab_from_body.apply(seat.camera_body_m), place, rtol=0, atol=1e-15)


@pytest.mark.parametrize("model", ["vehicles/simsat.xml", "vehicles/shefex2.xml"])
def test_shipped_cameras_look_up_with_their_right_along_x(model: str) -> None:
    seat = world.mount(world.build(scene.Vehicle.model_validate({"model": model})))
    assert seat.cam_from_body.magnitude() < 1e-15


# --- tilt stop ----------------------------------------------------------------------------------------------


def test_tilt_stop_holds_a_top_heavy_vehicle_through_two_turns_of_yaw() -> None:
    """2 cm out of balance upwards and too slow a top to sleep, (I w)^2 < 4 J m g d: it falls on the stop."""
    flown = world.build(vehicle(centre_of_mass=["0 m", "0 m", "2 cm"]))
    begin = Rotation.from_euler("x", 5, degrees=True)
    flight = world.fly(flown, begin, np.radians([0, 0, 90.0]), 12.0)
    assert abs(yaw_deg(flight)[-1]) > 720
    assert 29.9 < tilt_deg(flight).max() <= 30.1


@pytest.mark.parametrize("rate_deg_s", [10, 60])
def test_tilt_stop_is_hard_and_does_not_throw_back(rate_deg_s: float) -> None:
    flight = world.fly(world.build(vehicle()), LEVEL, np.radians([rate_deg_s, 0, 0]), 5.0)
    tilt = tilt_deg(flight)
    assert 29.9 < tilt.max() <= 30.1
    assert np.abs(np.degrees(flight.rate_body_rad_s[-1])).max() < 0.07 * rate_deg_s


def test_tilt_stop_leaves_yaw_alone() -> None:
    """Level and spinning at 90 deg/s: nothing has slowed it after two turns, nor tilted it."""
    flight = world.fly(world.build(vehicle()), LEVEL, np.radians([0, 0, 90.0]), 8.0)
    assert yaw_deg(flight)[-1] == pytest.approx(720, abs=1e-9)
    assert tilt_deg(flight).max() < 1e-9


def test_start_beyond_the_stop_is_refused() -> None:
    with pytest.raises(BadInput, match=r"motion.start: tilted by 35.0 deg, beyond vehicle.tilt_stop_deg 30"):
        world.fly(world.build(vehicle()), Rotation.from_euler("y", 35, degrees=True), STILL, 1.0)


# --- trajectory ---------------------------------------------------------------------------------------------


def test_attitude_between_steps_is_that_of_a_run_ten_times_finer() -> None:
    """A tumble of 2 rad/s under a changing torque; the finer run has samples inside the coarser's steps."""

    def wobble(t_s: float, _: Rotation, __: np.ndarray) -> np.ndarray:
        return np.sin(7 * t_s + np.array([0.0, 1.0, 2.0]))

    flown = world.build(vehicle(mount="free"))
    begin, rate = Rotation.from_rotvec([0.5, -0.2, 0.1]), np.array([1.0, 1.5, -1.0])
    coarse = world.fly(flown, begin, rate, 2.0, wobble)
    flown.model.opt.timestep = 1e-4
    fine = world.fly(flown, begin, rate, 2.0, wobble)
    inside = np.arange(len(fine.t_s))[np.arange(len(fine.t_s)) % 10 > 0]
    apart = fine.lab_from_body[inside].inv() * coarse.at(fine.t_s[inside])
    assert apart.magnitude().max() <= 1e-9


def test_flight_starts_and_ends_where_and_when_it_was_told() -> None:
    begin, rate = Rotation.from_rotvec([0.1, 0.2, 0.3]), np.array([0.01, 0.02, 0.03])
    flight = world.fly(world.build(vehicle()), begin, rate, 0.25)
    np.testing.assert_allclose(flight.t_s, np.arange(251) * 1e-3, rtol=0, atol=1e-15)
    assert (begin.inv() * flight.lab_from_body[0]).magnitude() < 1e-15
    np.testing.assert_array_equal(flight.rate_body_rad_s[0], rate)


def test_controller_is_asked_every_period_about_the_present() -> None:
    """The state it is shown is the trajectory's at the very time it is told, not a step old."""
    asked: list[tuple[float, Rotation, np.ndarray]] = []

    def listen(*now: object) -> np.ndarray:
        asked.append(now)  # type: ignore[arg-type]
        return np.array([0.1, 0.0, 0.0])

    flight = world.fly(world.build(vehicle()), LEVEL, np.array([0.1, 0.2, 0.3]), 0.2, listen, 0.02)
    np.testing.assert_allclose([t for t, _, _ in asked], np.arange(10) * 0.02, rtol=0, atol=1e-15)
    for t, seen, rate in asked:
        k = round(t / 1e-3)
        assert (seen.inv() * flight.lab_from_body[k]).magnitude() == 0
        np.testing.assert_array_equal(rate, flight.rate_body_rad_s[k])


def test_same_flight_twice_is_the_same_to_the_last_bit() -> None:
    flown = world.build(vehicle(centre_of_mass=["0 m", "0 m", "-5 mm"]))
    one, two = (world.fly(flown, LEVEL, np.array([0.1, 0.2, 0.3]), 1.0) for _ in range(2))
    np.testing.assert_array_equal(one.lab_from_body.as_quat(), two.lab_from_body.as_quat())


def test_mujocos_warning_is_an_error_and_leaves_no_file(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    flown = world.build(vehicle())
    with pytest.raises(RuntimeError, match="MuJoCo warned in flight: Nan, Inf or huge value in CTRL"):
        world.fly(flown, LEVEL, STILL, 0.1, lambda *_: np.full(3, np.nan))
    assert not list(tmp_path.iterdir())


# --- the scene's own manoeuvre ------------------------------------------------------------------------------


def test_pid_flies_the_afit_manoeuvre() -> None:
    """80 kg, tens of micrometres out of balance: below 0.5 deg throughout, below 0.01 deg when settled."""
    given = yaml.safe_load((scene.SCENES / "afit_simsat.yaml").read_text(encoding="utf-8"))
    told = scene.Motion.model_validate(given["motion"])
    flown = world.build(scene.Vehicle.model_validate(given["vehicle"]))
    reference = plan(told)
    fly_it = pid(reference, flown.inertia_kg_m2, flown.vehicle.torque_limit_nm)
    flight = world.fly(flown, start(told), STILL, reference.duration_s, fly_it)
    t = np.append(np.arange(0, reference.duration_s, 0.2), reference.duration_s)
    asked = Rotation.concatenate([reference.at(moment)[0] for moment in t])
    error_deg = np.degrees((asked.inv() * flight.at(t)).magnitude())
    assert error_deg.max() < 0.5
    assert error_deg[t > reference.duration_s - 1].max() < 0.01
    assert tilt_deg(flight).max() < 29


# --- bad vehicles -------------------------------------------------------------------------------------------

MOTORS = "".join(
    f'<motor name="torque_{axis}" site="centre" gear="0 0 0 {gear}"/>'
    for axis, gear in {"x": "1 0 0", "y": "0 1 0", "z": "0 0 1"}.items()
)
BALL = '<geom size="0.3" mass="50"/>'
CAMERA = '<camera name="star_camera" quat="0 1 0 0"/>'
BUS = f'<body name="bus"><site name="centre"/>{BALL}{CAMERA}</body>'
NEEDS = "a vehicle needs body bus, camera star_camera, motors torque_x"


def built(folder: Path, bodies: str, motors: str = MOTORS, head: str = "", **changes: object) -> world.World:
    file = folder / "mine.xml"
    file.write_text(
        f"<mujoco>{head}<worldbody>{bodies}</worldbody><actuator>{motors}</actuator></mujoco>",
        encoding="utf-8",
    )
    return world.build(scene.Vehicle.model_validate({"model": str(file)} | changes))


@pytest.mark.parametrize(
    ("bodies", "motors", "head", "message"),
    [
        (BUS.replace("bus", "hull"), MOTORS, "", f"has no body bus; {NEEDS}"),
        (BUS.replace("star_", ""), MOTORS, "", f"has no camera star_camera; {NEEDS}"),
        (BUS, MOTORS.replace("torque_z", "spin"), "", f"has no motor torque_z; {NEEDS}"),
        (BUS, "", "", "has no motor torque_x, no motor torque_y, no motor torque_z"),
        (f'<body name="b">{BUS}</body>', MOTORS, "", "bus must stand directly in the worldbody"),
        (f'<frame pos="1 0 0">{BUS}</frame>', MOTORS, "", "bus must stand directly in the worldbody"),
        (BUS.replace(CAMERA, "") + CAMERA, MOTORS, "", "camera star_camera must ride on body bus"),
        (f"{BUS}<body><freejoint/>{BALL}</body>", MOTORS, "", "only bus and what it carries may have joints"),
        (BUS, MOTORS.replace("1 0 0", "2 0 0"), "", "motor torque_x must turn bus about body x"),
        (BUS, MOTORS.replace("1 0 0", "0 0 1"), "", "motor torque_x must turn bus about body x"),
        (BUS.replace("<geom", "<gem"), MOTORS, "", "not a MuJoCo model: .*unrecognized element"),
        (BUS.replace('size="0.3"', 'size="-1"'), MOTORS, "", "MuJoCo cannot compile it: .*size"),
        (BUS.replace(' mass="50"', ' mass="0"'), MOTORS, "", "vehicle.mass: 0 kg leaves nothing"),
    ],
)  # fmt: skip
def test_bad_vehicle_is_answered_in_one_line(
    tmp_path: Path, bodies: str, motors: str, head: str, message: str
) -> None:
    with pytest.raises(BadInput, match=message) as caught:
        built(tmp_path, bodies, motors, head)
    assert "mine.xml" in str(caught.value)
    assert "\n" not in str(caught.value)


def test_compiler_setting_that_undoes_the_declared_mass_is_refused(tmp_path: Path) -> None:
    with pytest.raises(BadInput, match=r"comes out as 50 kg .* not as declared; leave inertiafromgeom"):
        built(tmp_path, BUS, head='<compiler inertiafromgeom="true"/>', mass="80 kg")


def test_vehicle_may_carry_wheels_that_turn(tmp_path: Path) -> None:
    """A wheel on a frictionless axle stays behind when the bus is turned: what turns is I - I_wheel."""
    wheel = '<body name="wheel"><joint axis="0 0 1"/><geom type="cylinder" size="0.2 0.01" mass="10"/></body>'
    given = {"mass": "80 kg", "inertia": ["6 kg m2", "6.5 kg m2", "9 kg m2"]}
    own = built(tmp_path, BUS.replace(CAMERA, CAMERA + wheel), **given)
    flight = world.fly(own, LEVEL, STILL, 1.0, lambda *_: np.array([0, 0, 0.5]))
    expected = 0.5 / (9 - 10 * 0.2**2 / 2)
    assert flight.rate_body_rad_s[-1, 2] == pytest.approx(expected, abs=1e-12)


def test_missing_file_is_named() -> None:
    with pytest.raises(
        BadInput, match=r"scenes/vehicles/no_such\.xml: no such file; .* relative to .*scenes"
    ):
        world.build(scene.Vehicle.model_validate({"model": "vehicles/no_such.xml"}))


def test_users_own_vehicle_loses_its_joints_place_and_keyframes(tmp_path: Path) -> None:
    """A file made for other uses: a free joint, a place and heading of its own, a keyframe, a floor."""
    bus = BUS.replace('name="bus"', 'name="bus" pos="1 2 3" euler="0 0 30"').replace(
        "<site", "<freejoint/><site"
    )
    keys = '<keyframe><key qpos="1 2 3 1 0 0 0"/></keyframe>'
    own = built(tmp_path, f'<geom type="plane" size="5 5 1"/>{bus}', head=keys)
    assert own.model.nq == 4
    assert world.mount(own).cam_from_body.magnitude() < 1e-15


def test_free_vehicle_turns_about_its_centre_of_mass() -> None:
    with pytest.raises(BadInput, match=r"vehicle.centre_of_mass: a free vehicle turns about it"):
        world.build(vehicle(mount="free", centre_of_mass=["1 mm", "0 m", "0 m"]))
