"""The assembled vehicle: masses, actuators, camera, tilt stop, and refused files.

The laws of mechanics are in test_physics_vehicle and test_physics_actuators.
"""

from __future__ import annotations

import math
import re
from pathlib import Path

import mujoco
import numpy as np
import pytest
import yaml
from scipy.spatial.transform import Rotation

from skysim.core import quaternion
from skysim.core.errors import InputError
from skysim.core.paths import SCENES
from skysim.core.types import Floats, Trajectory
from skysim.dynamics import multibody
from skysim.dynamics.attitude_control import Pid
from skysim.dynamics.guidance import plan, start_attitude
from skysim.scene.sections.motion import MotionConfig
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


def vehicle_config(**changes: object) -> VehicleConfig:
    return VehicleConfig.model_validate(SIMSAT | changes)


def tilt_deg(flight: Trajectory) -> np.ndarray:
    up = flight.lab_from_body.as_matrix()[:, :, 2]
    return np.degrees(np.arctan2(np.hypot(up[:, 0], up[:, 1]), up[:, 2]))


def yaw_deg(flight: Trajectory) -> np.ndarray:
    return np.degrees(np.unwrap(flight.lab_from_body.as_euler("ZYX")[:, 0]))


# --- the laws -----------------------------------------------------------------------------------------------


def test_a_free_sphere_keeps_its_rate() -> None:
    """The SHEFEX-2 scene's law of motion: lab_from_body = start * exp(w t)."""
    given = yaml.safe_load((SCENES / "shefex2.yaml").read_text(encoding="utf-8"))["vehicle"]
    flown = multibody.build(VehicleConfig.model_validate(given))
    begin = Rotation.from_rotvec([0.1, -0.7, 0.4])
    rate = np.radians([0.3, 0.4, 0.0])
    flight = multibody.simulate(flown, begin, rate, 10.0)
    expected = begin * Rotation.from_rotvec(10.0 * rate)
    assert (expected.inv() * flight.attitude_at(10.0)).magnitude() < 1e-12
    np.testing.assert_allclose(flight.rate_body_rad_s[-1], rate, rtol=0, atol=1e-14)


@pytest.mark.parametrize("axis", [0, 1, 2])
def test_motor_turns_its_axis_and_stops_at_its_limit(axis: int) -> None:
    """w = T t / I: ask for 5 N m, of a motor that has 0.5."""
    flown = multibody.build(vehicle_config(torque_limit="0.5 N m"))
    flight = multibody.simulate(flown, LEVEL, STILL, 2.0, lambda *_: 5.0 * np.eye(3)[axis])
    expected = np.eye(3)[axis] * 0.5 * 2.0 / INERTIA[axis]
    np.testing.assert_allclose(flight.rate_body_rad_s[-1], expected, rtol=0, atol=1e-12)


# --- mass properties ----------------------------------------------------------------------------------------


def test_the_vehicle_has_the_declared_mass() -> None:
    """MuJoCo's own totals: mass of the tree, its center in the lab, its joint-space inertia."""
    center = np.array([20e-6, -10e-6, -50e-6])
    flown = multibody.build(vehicle_config(center_of_mass=["20 um", "-10 um", "-50 um"]))
    data = mujoco.MjData(flown.model)
    mujoco.mj_forward(flown.model, data)
    bus = flown.model.body("bus").id
    assert flown.model.body_subtreemass[bus] == pytest.approx(80, rel=1e-12)
    np.testing.assert_allclose(data.subtree_com[bus], center, rtol=0, atol=1e-12)
    joint_space = np.zeros((3, 3))
    mujoco.mj_fullM(flown.model, data, joint_space)
    np.testing.assert_allclose(joint_space, np.diag(INERTIA), rtol=0, atol=1e-10)


def test_balance_masses_do_not_move_the_camera() -> None:
    moved = multibody.build(vehicle_config(center_of_mass=["1 cm", "0 m", "-2 cm"]))
    np.testing.assert_allclose(
        multibody.camera_mount(moved).camera_body_m, [0, 0, 0.381], rtol=0, atol=1e-15
    )


def test_undeclared_mass_properties_are_those_of_the_file() -> None:
    """The sum of the geoms in simsat.xml, read as text, and their center by MuJoCo alone."""
    text = (SCENES / "vehicles" / "simsat.xml").read_text(encoding="utf-8")
    spec = mujoco.MjSpec.from_string(text)
    listed = sum(geom.mass for geom in spec.geoms)
    own = multibody.build(VehicleConfig.model_validate({"model": "vehicles/simsat.xml"}))
    assert own.mass.mass_kg == pytest.approx(listed, rel=1e-12)
    model = spec.compile()
    data = mujoco.MjData(model)
    mujoco.mj_forward(model, data)
    center_m = data.subtree_com[model.body("bus").id]
    assert np.linalg.norm(center_m) > 0.01
    np.testing.assert_allclose(own.mass.center_m, center_m, rtol=0, atol=1e-12)


@pytest.mark.parametrize("given", [{}, {"center_of_mass": None}])
def test_a_vehicle_swings_about_the_center_of_mass_of_its_file(
    tmp_path: Path, given: dict[str, None]
) -> None:
    """A compound pendulum, 2 mm below the bearing: theta = theta_0 cos(w t), w^2 = m g l / (I + m l^2)."""
    inertial = '<inertial pos="0 0 -0.002" mass="12" diaginertia="0.4 0.5 0.6"/>'
    own = built(tmp_path, f'<body name="bus">{inertial}{CAMERA}</body>', "", **given)
    begin = Rotation.from_euler("x", 1.0, degrees=True)
    flight = multibody.simulate(own, begin, STILL, 2.0)
    w_rad_s = math.sqrt(12 * 9.80665 * 0.002 / (0.4 + 12 * 0.002**2))
    expected_deg = np.cos(w_rad_s * 2.0)
    assert abs(expected_deg) < 0.5
    turned_deg = np.degrees(flight.attitude_at(2.0).as_rotvec()[0])
    assert turned_deg == pytest.approx(expected_deg, abs=1e-3)


def test_mass_less_than_what_the_bus_carries_is_refused() -> None:
    with pytest.raises(
        InputError,
        match=r"vehicle.mass: 5 kg; allowed: more than the 20.6 kg that the bus carries",
    ):
        multibody.build(vehicle_config(mass="5 kg"))
    with pytest.raises(InputError, match=r"vehicle.inertia: .* impossible for a rigid body"):
        multibody.build(vehicle_config(inertia=["0.5 kg m2"] * 3))
    with pytest.raises(
        InputError,
        match=r"vehicle.camera: with the camera 5 m .* impossible for a rigid body",
    ):
        multibody.build(vehicle_config(camera=["0 m", "3 m", "4 m"]))


# --- actuators ----------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("parts", "joints", "motors"),
    [
        ((), 0, 0),
        (("wheels",), 3, 3),
        (("cmgs",), 8, 4),
        (("fans",), 0, 6),
        (("wheels", "cmgs", "fans"), 11, 13),
    ],
)
def test_actuators_that_the_scene_does_not_use_are_locked(
    parts: tuple[str, ...], joints: int, motors: int
) -> None:
    """Beside the bearing's three freedoms and the three ideal torques; the whole weighs the same."""
    vehicle = multibody.build(vehicle_config(**{part: {} for part in parts}))
    assert vehicle.model.nv == 3 + joints
    assert vehicle.model.nu == 3 + motors
    assert (len(vehicle.wheels), len(vehicle.gimbals), len(vehicle.rotors), len(vehicle.fans)) == (
        3 * ("wheels" in parts), 4 * ("cmgs" in parts), 4 * ("cmgs" in parts), 6 * ("fans" in parts),
    )  # fmt: skip
    data = mujoco.MjData(vehicle.model)
    full = np.zeros((vehicle.model.nv, vehicle.model.nv))
    mujoco.mj_forward(vehicle.model, data)
    mujoco.mj_fullM(vehicle.model, data, full)
    np.testing.assert_allclose(full[:3, :3], np.diag(INERTIA), rtol=0, atol=1e-10)


def test_wheels_have_the_axes_and_inertia_of_the_file() -> None:
    """Cylinders of 2.5 kg and 9 cm: m r^2 / 2 = 0.010125 kg m2 about the axle."""
    wheels = multibody.build(vehicle_config(wheels={})).wheels
    assert wheels.names == ("wheel_x", "wheel_y", "wheel_z")
    np.testing.assert_allclose(wheels.axes, np.eye(3), rtol=0, atol=1e-15)
    np.testing.assert_allclose(wheels.inertia_kg_m2, 0.010125, rtol=1e-12)


def test_cmgs_have_the_axes_of_the_file() -> None:
    """A pyramid of four: gimbal axes lean outwards by 54.74 deg, rotors lie along the base's edges.

    About the gimbal a box of 1.2 kg, 0.14 x 0.04 m across, and a cylinder of 1.8 kg, 5 cm and 4 cm long on its side:
    1.2 (0.14^2 + 0.04^2) / 12 + 1.8 (3 0.05^2 + 0.04^2) / 12 kg m2.
    """
    vehicle = multibody.build(vehicle_config(cmgs={}))
    assert vehicle.gimbals.names == ("gimbal_1", "gimbal_2", "gimbal_3", "gimbal_4")
    assert vehicle.rotors.names == ("rotor_1", "rotor_2", "rotor_3", "rotor_4")
    s = math.sqrt(2 / 3)
    c = math.sqrt(1 / 3)
    np.testing.assert_allclose(
        vehicle.gimbals.axes, [[s, 0, -s, 0], [0, s, 0, -s], [c, c, c, c]], rtol=0, atol=5e-6
    )
    np.testing.assert_allclose(
        vehicle.rotors.axes, [[0, -1, 0, 1], [1, 0, -1, 0], [0, 0, 0, 0]], rtol=0, atol=1e-15
    )
    np.testing.assert_allclose(vehicle.gimbals.inertia_kg_m2, 0.00212 + 0.001365, rtol=1e-9)
    np.testing.assert_allclose(vehicle.rotors.inertia_kg_m2, 1.8 * 0.05**2 / 2, rtol=1e-12)


def test_fans_have_the_places_of_the_file() -> None:
    """Pairs that push opposite ways on opposite sides: place x direction is about x, y, z in turn."""
    fans = multibody.build(vehicle_config(fans={})).fans
    assert fans.names == ("fan_x_1", "fan_x_2", "fan_y_1", "fan_y_2", "fan_z_1", "fan_z_2")
    arms = np.cross(fans.positions_m, fans.axes, axis=0)
    expected = np.repeat(np.diag([0.46, 0.46, 0.33 * math.sqrt(2)]), 2, axis=1)
    np.testing.assert_allclose(arms, expected, rtol=0, atol=1e-12)
    np.testing.assert_allclose(fans.axes[:, ::2], -fans.axes[:, 1::2], rtol=0, atol=1e-12)


def test_tas2_has_three_cmgs_of_variable_speed() -> None:
    """57 deg from body z, 120 deg apart; both gimbals and rotors are driven."""
    vehicle = multibody.build(
        VehicleConfig.model_validate(
            {"model": "vehicles/tas2.xml", "cmgs": {"rotor_torque_limit": "0.5 N m"}}
        )
    )
    assert vehicle.gimbals.names == ("gimbal_1", "gimbal_2", "gimbal_3")
    np.testing.assert_allclose(
        np.degrees(np.arccos(vehicle.gimbals.axes[2])), 57, rtol=0, atol=1e-3
    )
    np.testing.assert_allclose(vehicle.gimbals.axes[:2].sum(axis=1), 0, rtol=0, atol=1e-5)
    assert (vehicle.rotors.motor >= 0).all()
    np.testing.assert_allclose(
        (vehicle.gimbals.axes * vehicle.rotors.axes).sum(axis=0), 0, rtol=0, atol=1e-12
    )


def test_accelerometers_sit_at_the_site_imu_or_at_the_bearing() -> None:
    np.testing.assert_allclose(
        multibody.imu_position_m(multibody.build(vehicle_config())),
        [0.1, 0.1, 0.14],
        rtol=0,
        atol=1e-15,
    )
    other = multibody.build(VehicleConfig.model_validate({"model": "vehicles/shefex2.xml"}))
    np.testing.assert_array_equal(multibody.imu_position_m(other), np.zeros(3))


# --- camera -------------------------------------------------------------------------------------------------


def test_the_mount_is_mujoco_s_camera_pose() -> None:
    """At a rotated pose: place of the camera, and the columns of xmat (right, up, backwards)."""
    flown = multibody.build(vehicle_config())
    seat = multibody.camera_mount(flown)
    lab_from_body = Rotation.from_euler("ZYX", [40, -12, 17], degrees=True)
    data = mujoco.MjData(flown.model)
    data.qpos[:4] = lab_from_body.as_quat(scalar_first=True)
    mujoco.mj_forward(flown.model, data)
    camera = data.camera("star_camera")
    np.testing.assert_allclose(
        lab_from_body.apply(seat.camera_body_m), camera.xpos, rtol=0, atol=1e-14
    )
    lab_from_cam = (lab_from_body * seat.cam_from_body.inv()).as_matrix()
    right, up, back = camera.xmat.reshape(3, 3).T
    np.testing.assert_allclose(lab_from_cam.T, [right, -up, -back], rtol=0, atol=1e-14)


def test_the_camera_tilts_with_the_vehicle_s_roll() -> None:
    """By hand: rolled by +30 deg about lab x, body +z, and so the boresight, leans towards lab -y."""
    seat = multibody.camera_mount(multibody.build(vehicle_config()))
    lab_from_body = Rotation.from_euler("x", 30, degrees=True)
    boresight_lab = (seat.cam_from_body * lab_from_body.inv()).apply([0, 0, 1], inverse=True)
    np.testing.assert_allclose(boresight_lab, [0, -0.5, math.sqrt(0.75)], rtol=0, atol=1e-15)
    place = [0, -0.1905, 0.381 * math.sqrt(0.75)]
    np.testing.assert_allclose(
        lab_from_body.apply(seat.camera_body_m), place, rtol=0, atol=1e-15
    )


@pytest.mark.parametrize(
    "model", ["vehicles/simsat.xml", "vehicles/shefex2.xml", "vehicles/tas2.xml"]
)
def test_shipped_cameras_look_up_with_their_right_along_x(model: str) -> None:
    seat = multibody.camera_mount(
        multibody.build(VehicleConfig.model_validate({"model": model}))
    )
    assert seat.cam_from_body.magnitude() < 1e-15


# --- tilt stop ----------------------------------------------------------------------------------------------


def test_tilt_stop_holds_a_top_heavy_vehicle_through_two_turns_of_yaw() -> None:
    """2 cm out of balance upwards and too slow a top to sleep, (I w)^2 < 4 J m g d: it falls on the stop."""
    flown = multibody.build(vehicle_config(center_of_mass=["0 m", "0 m", "2 cm"]))
    begin = Rotation.from_euler("x", 5, degrees=True)
    flight = multibody.simulate(flown, begin, np.radians([0, 0, 90.0]), 12.0)
    assert abs(yaw_deg(flight)[-1]) > 720
    assert 29.9 < tilt_deg(flight).max() <= 30.1


@pytest.mark.parametrize("rate_deg_s", [10, 60])
def test_tilt_stop_is_hard_and_does_not_throw_back(rate_deg_s: float) -> None:
    flight = multibody.simulate(
        multibody.build(vehicle_config()), LEVEL, np.radians([rate_deg_s, 0, 0]), 5.0
    )
    tilt = tilt_deg(flight)
    assert 29.9 < tilt.max() <= 30.1
    assert np.abs(np.degrees(flight.rate_body_rad_s[-1])).max() < 0.07 * rate_deg_s


def test_tilt_stop_leaves_yaw_alone() -> None:
    """Level and spinning at 90 deg/s: nothing has slowed it after two turns, nor tilted it."""
    flight = multibody.simulate(
        multibody.build(vehicle_config()), LEVEL, np.radians([0, 0, 90.0]), 8.0
    )
    assert yaw_deg(flight)[-1] == pytest.approx(720, abs=1e-9)
    assert tilt_deg(flight).max() < 1e-9


def test_start_beyond_the_stop_is_refused() -> None:
    with pytest.raises(
        InputError,
        match=r"motion.start: tilt of 35.0 deg; allowed: up to vehicle.tilt_stop_deg 30",
    ):
        multibody.simulate(
            multibody.build(vehicle_config()),
            Rotation.from_euler("y", 35, degrees=True),
            STILL,
            1.0,
        )


# --- trajectory ---------------------------------------------------------------------------------------------


def test_a_flight_has_the_requested_start_and_duration() -> None:
    begin = Rotation.from_rotvec([0.1, 0.2, 0.3])
    rate = np.array([0.01, 0.02, 0.03])
    flight = multibody.simulate(multibody.build(vehicle_config()), begin, rate, 0.25)
    np.testing.assert_allclose(flight.t_s, np.arange(251) * 1e-3, rtol=0, atol=1e-15)
    assert (begin.inv() * flight.lab_from_body[0]).magnitude() < 1e-15
    np.testing.assert_array_equal(flight.rate_body_rad_s[0], rate)


def test_a_flight_by_control_periods_is_that_of_plain_steps() -> None:
    """To the last bit, also with friction and at the tilt stop: MuJoCo's solver starts from its last solution."""
    top_heavy = ["0 m", "0 m", "2 cm"]
    flown = multibody.build(
        vehicle_config(center_of_mass=top_heavy, wheels={"coulomb": "50 mN m"})
    )
    begin = Rotation.from_euler("x", 28, degrees=True)
    flight = multibody.Simulation(flown, begin, np.radians([40.0, 10.0, 30.0]), 0.5)
    data = mujoco.MjData(flown.model)
    data.qpos[:] = flight.angles_rad
    data.qvel[:] = flight.speeds_rad_s
    mujoco.mj_forward(flown.model, data)
    rng = np.random.default_rng(0)
    most = 0
    while flight.steps_left:
        data.ctrl[:] = 0.3 * rng.standard_normal(flown.model.nu)
        flight.advance(np.tile(data.ctrl, (10, 1)))
        mujoco.mj_step(flown.model, data, 10)
        np.testing.assert_array_equal(flight.angles_rad, data.qpos)
        np.testing.assert_array_equal(flight.speeds_rad_s, data.qvel)
        most = max(most, data.nefc)
    assert most == 4  # the friction of three wheels, and the stop


def test_the_controller_is_called_every_period_with_the_present_state() -> None:
    """The state passed to the controller is the trajectory's at the time passed with it, not a step older."""
    asked: list[tuple[float, Rotation, np.ndarray]] = []

    def listen(*now: object) -> np.ndarray:
        asked.append(now)  # type: ignore[arg-type]
        return np.array([0.1, 0.0, 0.0])

    flight = multibody.simulate(
        multibody.build(vehicle_config()), LEVEL, np.array([0.1, 0.2, 0.3]), 0.2, listen, 0.02
    )
    np.testing.assert_allclose(
        [t for t, _, _ in asked], np.arange(10) * 0.02, rtol=0, atol=1e-15
    )
    for t, seen, rate in asked:
        k = round(t / 1e-3)
        assert (seen.inv() * flight.lab_from_body[k]).magnitude() == 0
        np.testing.assert_array_equal(rate, flight.rate_body_rad_s[k])


def test_same_flight_twice_is_the_same_to_the_last_bit() -> None:
    flown = multibody.build(vehicle_config(center_of_mass=["0 m", "0 m", "-5 mm"]))
    one, two = (
        multibody.simulate(flown, LEVEL, np.array([0.1, 0.2, 0.3]), 1.0) for _ in range(2)
    )
    np.testing.assert_array_equal(one.lab_from_body.as_quat(), two.lab_from_body.as_quat())


def test_a_mujoco_warning_is_an_error_and_leaves_no_log_file(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    flown = multibody.build(vehicle_config())
    with pytest.raises(InputError, match=r"MuJoCo warned before 0\.010 s \(mjWARN_BADCTRL\)"):
        multibody.simulate(flown, LEVEL, STILL, 0.1, lambda *_: np.full(3, np.nan))
    assert not list(tmp_path.iterdir())


# --- the scene's own maneuver ------------------------------------------------------------------------------


@pytest.mark.slow
def test_pid_flies_the_afit_maneuver() -> None:
    """80 kg, tens of micrometers out of balance: below 0.02 deg throughout, below 0.001 deg when settled."""
    given = yaml.safe_load((SCENES / "afit_simsat.yaml").read_text(encoding="utf-8"))
    motion = MotionConfig.model_validate(given["motion"])
    flown = multibody.build(VehicleConfig.model_validate(given["vehicle"]))
    reference = plan(motion)
    law = Pid(reference, flown.inertia_kg_m2)

    def steer(t_s: float, here: Rotation, rate_rad_s: Floats) -> Floats:
        wanted = law.torque_nm(t_s, quaternion.from_rotation(here), rate_rad_s, STILL)
        law.integrate(wanted, wanted, 0.01)
        return wanted

    flight = multibody.simulate(
        flown, start_attitude(motion, ()), STILL, reference.duration_s, steer
    )
    t = np.append(np.arange(0, reference.duration_s, 0.2), reference.duration_s)
    error_deg = np.degrees((reference.attitudes(t).inv() * flight.attitude_at(t)).magnitude())
    assert error_deg.max() < 0.02
    assert error_deg[t > reference.duration_s - 1].max() < 0.001
    assert 10 < tilt_deg(flight).max() < 29


# --- bad vehicles -------------------------------------------------------------------------------------------

BALL = '<geom size="0.3" mass="50"/>'
CAMERA = '<camera name="star_camera" quat="0 1 0 0"/>'
BUS = f'<body name="bus"><site name="center"/>{BALL}{CAMERA}</body>'
NEEDS = "a vehicle needs body bus and camera star_camera"
DISK = '<geom type="cylinder" size="0.2 0.01" mass="10"/>'
WHEEL = f'<body name="wheel"><joint name="wheel_a" axis="0 0 1"/>{DISK}</body>'
GIMBAL = f'<body><joint name="gimbal_1" axis="0 0 1"/>{DISK}%s</body>'
ROTOR = f'<body><joint name="rotor_%s" axis="0 1 0"/>{DISK}</body>'


def carrying(parts: str) -> str:
    """The bus with further bodies."""
    return BUS.replace(CAMERA, CAMERA + parts)


def built(
    folder: Path, bodies: str, more: str = "", **changes: object
) -> multibody.VehicleModel:
    file = folder / "mine.xml"
    file.write_text(
        f"<mujoco>{more}<worldbody>{bodies}</worldbody></mujoco>", encoding="utf-8"
    )
    return multibody.build(VehicleConfig.model_validate({"model": str(file)} | changes))


REFUSED = "not a MuJoCo model that skysim reads: .*"


@pytest.mark.slow
@pytest.mark.parametrize(
    ("bodies", "message"),
    [
        (BUS.replace("bus", "hull"), f"no body bus; {NEEDS}"),
        (BUS.replace("star_", ""), f"no camera star_camera; {NEEDS}"),
        (BALL, f"no body bus, no camera star_camera; {NEEDS}"),
        (f'<body name="b">{BUS}</body>', "bus must be a direct child of worldbody"),
        (f'<frame pos="1 0 0">{BUS}</frame>', "bus must be a direct child of worldbody"),
        (BUS.replace(CAMERA, "") + CAMERA, "camera star_camera must be on body bus"),
        (f"{BUS}<body><freejoint/>{BALL}</body>", "a joint outside body bus"),
        (BUS.replace("<geom", "<gem"), f"{REFUSED}unrecognized element"),
        (BUS.replace('size="0.3"', 'size="-1"'), f"{REFUSED}size"),
        (BUS.replace(' mass="50"', ' mass="0"'), "vehicle.mass: 0 kg; allowed: more than"),
        (
            carrying(WHEEL.replace("wheel_a", "bearing")),
            "reserved for skysim's bearing: .*'bearing'",
        ),
    ],
)
def test_a_bad_vehicle_is_refused_in_one_line(
    tmp_path: Path, bodies: str, message: str
) -> None:
    with pytest.raises(InputError, match=message) as caught:
        built(tmp_path, bodies)
    assert "mine.xml" in str(caught.value)
    assert "\n" not in str(caught.value)


@pytest.mark.slow
@pytest.mark.parametrize(
    ("part", "bodies", "message"),
    [
        ("wheels", BUS, r"no joint wheel_\*, which vehicle.wheels needs"),
        ("cmgs", BUS, r"no joint gimbal_\*, which vehicle.cmgs needs"),
        ("cmgs", carrying(GIMBAL % ""), r"no joint rotor_\*, which vehicle.cmgs needs"),
        ("fans", BUS, r"no site fan_\*, which vehicle.fans needs"),
        ("fans", f'{BUS}<site name="fan_1"/>', r"sites fan_\* must be on body bus"),
        (
            "wheels",
            carrying(WHEEL.replace("axis", 'type="ball" axis')),
            r"joints wheel_\* must be hinges",
        ),
        (
            "cmgs",
            carrying(GIMBAL % (ROTOR % "2")),
            "joint gimbal_1 has no joint rotor_1 on a child body of its own",
        ),
        (
            "cmgs",
            carrying(GIMBAL % "" + ROTOR % "1"),
            "joint gimbal_1 has no joint rotor_1 on a child body of its own",
        ),
        (
            "cmgs",
            carrying(GIMBAL % (ROTOR % "1") + ROTOR % "2"),
            r"a joint rotor_\* has no joint gimbal_\*",
        ),
    ],
)
def test_actuators_missing_in_the_file_are_refused_in_one_line(
    tmp_path: Path, part: str, bodies: str, message: str
) -> None:
    with pytest.raises(InputError, match=message) as caught:
        built(tmp_path, bodies, **{part: {}})
    assert "mine.xml" in str(caught.value)
    assert "\n" not in str(caught.value)


@pytest.mark.slow
@pytest.mark.parametrize("name", ["torque_x", "wheel_a", "gimbal_1", "rotor_1", "fan_1"])
def test_actuator_of_a_reserved_name_is_refused(tmp_path: Path, name: str) -> None:
    motor = f'<actuator><motor name="{name}" site="center" gear="0 0 0 1 0 0"/></actuator>'
    with pytest.raises(
        InputError, match=rf"mine\.xml: actuator {name}: an actuator of this name is added"
    ):
        built(tmp_path, BUS, motor)


def test_other_actuators_of_the_file_stay_and_get_no_control(tmp_path: Path) -> None:
    """They come first in the model, and the torques are still those about x, y, z."""
    motor = '<actuator><motor name="mine" site="center" gear="0 0 0 1 0 0"/></actuator>'
    own = built(tmp_path, BUS, motor)
    assert own.model.nu == 4
    flight = multibody.simulate(own, LEVEL, STILL, 1.0, lambda *_: np.array([0.0, 0.0, 0.5]))
    expected = [0, 0, 0.5 / (0.4 * 50 * 0.3**2)]
    np.testing.assert_allclose(flight.rate_body_rad_s[-1], expected, rtol=0, atol=1e-12)


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        (
            {"wheels": {"start_rpm": [100, 200]}},
            r"vehicle\.wheels\.start_rpm: 2 values; allowed: 3",
        ),
        (
            {"cmgs": {"start_deg": [1, 2, 3]}},
            r"vehicle\.cmgs\.start_deg: 3 values; allowed: 4",
        ),
    ],
)
def test_start_values_must_be_one_for_each(changes: dict[str, object], message: str) -> None:
    with pytest.raises(InputError, match=message):
        multibody.Simulation(multibody.build(vehicle_config(**changes)), LEVEL, STILL, 1.0)


def test_imbalance_that_no_rigid_wheel_has_is_refused() -> None:
    with pytest.raises(
        InputError,
        match=r"vehicle\.wheels\.dynamic_imbalance: with it wheel_x's .* impossible for a rigid body",
    ):
        multibody.build(vehicle_config(wheels={"dynamic_imbalance": "1 kg m2"}))


def test_compiler_setting_that_undoes_the_declared_mass_is_refused(tmp_path: Path) -> None:
    with pytest.raises(
        InputError,
        match=r"the compiled mass is 50 kg .* not as declared; remove inertiafromgeom",
    ):
        built(tmp_path, BUS, '<compiler inertiafromgeom="true"/>', mass="80 kg")


def test_a_vehicle_may_have_passive_wheels(tmp_path: Path) -> None:
    """A wheel on a frictionless axle stays behind when the bus is turned: what turns is I - I_wheel."""
    wheel = WHEEL.replace(' name="wheel_a"', "")  # a joint of no name that skysim knows
    given = {"mass": "80 kg", "inertia": ["6 kg m2", "6.5 kg m2", "9 kg m2"]}
    own = built(tmp_path, carrying(wheel), **given)
    flight = multibody.simulate(own, LEVEL, STILL, 1.0, lambda *_: np.array([0, 0, 0.5]))
    expected = 0.5 / (9 - 10 * 0.2**2 / 2)
    assert flight.rate_body_rad_s[-1, 2] == pytest.approx(expected, abs=1e-12)


@pytest.mark.parametrize(
    "names",
    [
        '<include file="../secret.xml"/>',
        '<include file="part.xml"/>',
        '<include file="linked.xml"/>',
        '<asset><mesh name="m" file="/etc/hostname.obj"/></asset>',
        '<compiler meshdir="/etc"/>',
        '<asset><texture name="t" type="cube" fileright="../../t.png"/></asset>',
    ],
)
def test_an_untrusted_vehicle_reads_no_file_outside_of_its_folder(
    tmp_path: Path, names: str
) -> None:
    folder = tmp_path / "theirs"
    (folder / "deep").mkdir(parents=True)
    (tmp_path / "secret.xml").write_text(f"<mujoco><worldbody>{BUS}</worldbody></mujoco>")
    (folder / "part.xml").write_text('<mujoco><include file="deep/part.xml"/></mujoco>')
    (folder / "deep" / "part.xml").write_text(
        '<mujoco><include file="../secret.xml"/></mujoco>'
    )
    (folder / "linked.xml").symlink_to(tmp_path / "secret.xml")
    with pytest.raises(InputError, match=r"is outside .*theirs; allowed: files in it$"):
        built(folder, BUS, names)


def test_a_vehicle_of_several_files_is_assembled(tmp_path: Path) -> None:
    (tmp_path / "deep").mkdir()
    (tmp_path / "deep" / "bus.xml").write_text(
        f"<mujoco><worldbody>{BUS}</worldbody></mujoco>"
    )
    assert built(tmp_path, "", '<include file="deep/bus.xml"/>').spec.body("bus") is not None


def test_missing_file_is_named() -> None:
    with pytest.raises(
        InputError,
        match=r"scenes/vehicles/no_such\.xml: no such file; .* relative to the scene or to scenes/",
    ):
        multibody.build(VehicleConfig.model_validate({"model": "vehicles/no_such.xml"}))


def test_users_own_vehicle_loses_its_joints_place_and_keyframes(tmp_path: Path) -> None:
    """A file made for other uses: a free joint, a place and heading of its own, a keyframe, a floor."""
    bus = BUS.replace('name="bus"', 'name="bus" pos="1 2 3" euler="0 0 30"').replace(
        "<site", "<freejoint/><site"
    )
    keys = '<keyframe><key qpos="1 2 3 1 0 0 0"/></keyframe>'
    own = built(tmp_path, f'<geom type="plane" size="5 5 1"/>{bus}', keys)
    assert own.model.nq == 4
    assert multibody.camera_mount(own).cam_from_body.magnitude() < 1e-15


def test_free_vehicle_turns_about_its_center_of_mass() -> None:
    with pytest.raises(
        InputError, match=r"vehicle.center_of_mass: a free vehicle rotates about it"
    ):
        multibody.build(vehicle_config(mount="free", center_of_mass=["1 mm", "0 m", "0 m"]))


# --- what a file must not say, or says in another way -------------------------------------------------------


def changed_model(
    folder: Path, right: str, wrong: str, **changes: object
) -> multibody.VehicleModel:
    """simsat.xml with one thing changed."""
    text = (SCENES / "vehicles" / "simsat.xml").read_text(encoding="utf-8")
    assert right in text
    file = folder / "mine.xml"
    file.write_text(text.replace(right, wrong, 1), encoding="utf-8")
    return multibody.build(vehicle_config(model=str(file), **changes))


@pytest.mark.slow
@pytest.mark.parametrize(
    ("right", "wrong", "says"),
    [
        (
            'name="wheel_x" axis',
            'name="wheelx" axis',
            "wheelx; allowed: wheel_x, or another word",
        ),
        ('name="fan_x_1"', 'name="fanx"', "fanx; allowed: fan_x, or another word"),
        (
            'name="wheel_x" axis',
            'range="0 90" name="wheel_x" axis',
            "joint wheel_x: range is set by the scene",
        ),
        (
            'name="wheel_y" axis',
            'armature="1" name="wheel_y" axis',
            "joint wheel_y: armature is set by the scene",
        ),
        (
            '<site name="imu"',
            '<joint name="wheel_0"/><site name="imu"',
            "joint wheel_0 must be on a child body of bus",
        ),
    ],
)
def test_the_scene_s_declared_values_replace_the_file_s(
    tmp_path: Path, right: str, wrong: str, says: str
) -> None:
    with pytest.raises(InputError, match=re.escape(says)):
        changed_model(tmp_path, right, wrong, wheels={}, fans={})


@pytest.mark.slow
def test_a_reference_to_a_locked_joint_is_refused_with_the_reason(tmp_path: Path) -> None:
    sensor = '<sensor><jointvel joint="wheel_x"/></sensor></mujoco>'
    with pytest.raises(
        InputError, match=r"vehicle\.wheels is off, which locks joint wheel_x"
    ):
        changed_model(tmp_path, "</mujoco>", sensor)
    assert len(changed_model(tmp_path, "</mujoco>", sensor, wheels={}).wheels) == 3


@pytest.mark.slow
@pytest.mark.parametrize(
    "inertial",
    [
        'diaginertia="0.006 0.0101 0.006" euler="0 0 90"',  # turned: the axle, the body's x, has the 0.0101
        'fullinertia="0.0101 0.006 0.006 0 0 0"',
    ],
)
def test_a_wheel_s_inertia_is_read_in_any_notation(tmp_path: Path, inertial: str) -> None:
    given = f'<inertial pos="0 0 0" mass="2.5" {inertial}/><joint name="wheel_x" axis'
    made = changed_model(
        tmp_path, '<joint name="wheel_x" axis', given, wheels={"dynamic_imbalance": "1 g cm2"}
    )
    assert made.wheels.inertia_kg_m2[0] == pytest.approx(0.0101, rel=1e-6)


@pytest.mark.parametrize(
    ("wheels", "end_s"), [(None, "0.020"), ({"stiction": "1e-3 N m"}, "0.011")]
)
def test_an_unstable_flight_is_an_error_even_if_it_settles(
    wheels: dict[str, str] | None, end_s: str
) -> None:
    """MuJoCo puts the vehicle back to its start and forgets its warning with the next call: a step, with stiction."""
    vehicle = multibody.build(vehicle_config(wheels=wheels))
    flight = multibody.Simulation(vehicle, LEVEL, STILL, 0.1)
    control = np.zeros((10, vehicle.model.nu))
    flight.advance(control)
    control[0] = np.nan
    with pytest.raises(InputError, match=rf"MuJoCo warned before {end_s} s"):
        flight.advance(control)


def test_a_camera_rolled_on_its_mount_turns_its_axes_and_keeps_its_place() -> None:
    """A rotation vector in the file's camera axes: +90 deg of roll brings the image's x axis where its y axis was."""
    plain = multibody.camera_mount(multibody.build(vehicle_config()))
    rolled = multibody.camera_mount(
        multibody.build(vehicle_config(camera_rotation_deg=[0, 0, 90]))
    )
    tilted = multibody.camera_mount(
        multibody.build(vehicle_config(camera_rotation_deg=[30, 0, 0]))
    )
    plain_from_rolled = plain.cam_from_body * rolled.cam_from_body.inv()
    assert plain_from_rolled.apply([1, 0, 0]) == pytest.approx([0, 1, 0], abs=1e-12)
    assert plain_from_rolled.apply([0, 0, 1]) == pytest.approx([0, 0, 1], abs=1e-12)
    plain_from_tilted = plain.cam_from_body * tilted.cam_from_body.inv()
    assert plain_from_tilted.as_rotvec(degrees=True) == pytest.approx([30, 0, 0])
    assert rolled.camera_body_m == pytest.approx(plain.camera_body_m)
