"""The vehicle on its bearing, flown by MuJoCo. The only module that knows MuJoCo.

MuJoCo's qpos of a ball joint is lab_from_body as wxyz, its qvel the angular rate in body axes.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import mujoco
import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from skysim import scene
from skysim.types import BadInput, Floats, Mount, Trajectory

GRAVITY_M_S2 = 9.80665
STEP_S = 1e-3
CAMERA = "star_camera"
MOTORS = ("torque_x", "torque_y", "torque_z")
NEEDED = f"body bus, camera {CAMERA}, motors {', '.join(MOTORS)}"

# MuJoCo's camera has +y up and looks along -z; ours has +y down and looks along +z.
CAM_FROM_MJCAM = Rotation.from_matrix(np.diag([1.0, -1.0, -1.0]))

# The tilt stop's two ends, above the bearing in the lab and on the vehicle. Unequal, so that the line between
# them never vanishes and its length has a slope at every tilt but none.
STOP_LAB_M, STOP_BODY_M = 1.0, 0.5

Controller = Callable[[float, Rotation, Floats], Floats]


@dataclass(frozen=True, slots=True)
class MassProperties:
    """Of the whole tree, in body axes: mass, centre of mass (3,), inertia (3, 3) about the body's origin."""

    mass_kg: float
    centre_m: Floats
    inertia_kg_m2: Floats


@dataclass(frozen=True, slots=True)
class World:
    """A vehicle on its bearing, ready to fly. The model is not changed by flying.

    model   : mujoco.MjModel, whose first four qpos and three qvel are the bearing's
    mass    : what the whole vehicle came out as
    motors  : (3,) actuator numbers of the torques about body x, y, z
    """

    model: Any
    vehicle: scene.Vehicle
    mass: MassProperties
    motors: NDArray[np.int64]

    @property
    def inertia_kg_m2(self) -> Floats:
        """(3, 3) inertia tensor about the bearing's centre, in body axes."""
        return self.mass.inertia_kg_m2


def build(vehicle: scene.Vehicle) -> World:
    """Put the vehicle's MJCF on a bearing at the lab's origin, with the mass properties the scene declares.

    mount `air_bearing`: gravity along lab -z and a tilt stop. mount `free`: neither, and the vehicle turns
    about its centre of mass, which must be the body's origin. Raises BadInput with one line.
    """
    path = scene.SCENES / vehicle.model
    if vehicle.mount == "free" and any(vehicle.centre_of_mass_m):
        raise BadInput(
            "vehicle.centre_of_mass: a free vehicle turns about it, so it is the body's origin; leave it out"
        )
    with mujoco_warnings():
        spec = read(path)
        bus = put_at_origin(spec, path)
        wanted = declare_mass(bus, compiled(spec, path), vehicle, path)
        add_bearing(spec, bus, vehicle)
        model = compiled(spec, path)
        world = World(
            model, vehicle, tree_mass(model), np.array([model.actuator(name).id for name in MOTORS])
        )
        check(world, wanted, path)
    return world


def read(path: Path) -> Any:
    """The MJCF as a MuJoCo spec that has every name needed."""
    if not path.is_file():
        raise BadInput(f"{path}: no such file; vehicle.model is a path relative to {scene.SCENES}")
    try:
        spec = mujoco.MjSpec.from_file(str(path))
    except (ValueError, mujoco.FatalError) as error:
        raise BadInput(f"{path}: not a MuJoCo model: {one_line(error)}") from error
    has = {"body bus": spec.body("bus"), f"camera {CAMERA}": spec.camera(CAMERA)}
    has |= {f"motor {name}": spec.actuator(name) for name in MOTORS}
    missing = [name for name, element in has.items() if element is None]
    if missing:
        raise BadInput(f"{path}: has no {', no '.join(missing)}; a vehicle needs {NEEDED}")
    return spec


def put_at_origin(spec: Any, path: Path) -> Any:
    """The bus, freed of the joints and the place that its file gave it: the bearing decides on both."""
    bus = spec.body("bus")
    if bus.parent.name != "world" or bus.frame is not None:
        raise BadInput(f"{path}: body bus must stand directly in the worldbody, in no other body or frame")
    for joint in list(bus.joints):
        spec.delete(joint)
    for key in list(spec.keys):  # keyframes are lists of joint positions, which no longer fit
        spec.delete(key)
    bus.alt.type = mujoco.mjtOrientation.mjORIENTATION_QUAT  # an euler or axisangle would win over the quat
    bus.pos, bus.quat = [0.0, 0.0, 0.0], [1.0, 0.0, 0.0, 0.0]
    return bus


def compiled(spec: Any, path: Path) -> Any:
    try:
        return spec.compile()
    except (ValueError, mujoco.FatalError) as error:
        raise BadInput(f"{path}: MuJoCo cannot compile it: {one_line(error)}") from error


def tree_mass(model: Any, without_bus: bool = False) -> MassProperties:
    """The bus and all it carries, as the compiled model has them; without_bus only what it carries."""
    data = mujoco.MjData(model)
    mujoco.mj_forward(model, data)
    bus = model.body("bus").id
    rides = model.body_rootid == bus
    rides[bus] &= not without_bus
    mass, centre = model.body_mass[rides], data.xipos[rides]
    axes = data.ximat[rides].reshape(-1, 3, 3)
    inertia = np.einsum("nij,nj,nkj->ik", axes, model.body_inertia[rides], axes)
    inertia += sum((parallel_axis(m, p) for m, p in zip(mass, centre, strict=True)), np.zeros((3, 3)))
    return MassProperties(float(mass.sum()), mass @ centre / max(mass.sum(), 1e-300), inertia)


def parallel_axis(mass_kg: float, place_m: Floats) -> Floats:
    """(3, 3) inertia about the origin of a point mass: m (r.r E - r r^T) (Steiner)."""
    return mass_kg * (place_m @ place_m * np.eye(3) - np.outer(place_m, place_m))


def declare_mass(bus: Any, model: Any, vehicle: scene.Vehicle, path: Path) -> MassProperties:
    """Give the bus the inertial that makes the whole tree come out as declared: wanted minus what it carries.

    Mass and inertia that the scene leaves out stay as in the file; the centre of mass is always the scene's.
    The inertia is that about the bearing's centre, its principal axes the body's. Nothing is moved: what a
    lab does with balance masses is done to the bus's inertial alone, and the camera stays where it is.
    """
    own, carried = tree_mass(model), tree_mass(model, without_bus=True)
    centre = np.array(vehicle.centre_of_mass_m)
    inertia = own.inertia_kg_m2 if vehicle.inertia_kg_m2 is None else np.diag(vehicle.inertia_kg_m2)
    wanted = MassProperties(vehicle.mass_kg or own.mass_kg, centre, inertia)
    mass = wanted.mass_kg - carried.mass_kg
    if mass <= 0:
        raise BadInput(
            f"vehicle.mass: {wanted.mass_kg:g} kg leaves nothing for the bus, which carries"
            f" {carried.mass_kg:g} kg ({path})"
        )
    place = (wanted.mass_kg * wanted.centre_m - carried.mass_kg * carried.centre_m) / mass
    moments, axes = np.linalg.eigh(inertia - carried.inertia_kg_m2 - parallel_axis(mass, place))
    if moments[0] <= 0 or moments[2] > moments[0] + moments[1]:
        raise BadInput(
            f"vehicle.inertia: less what the bus carries, its principal moments about its centre of mass are"
            f" {', '.join(f'{m:.3g}' for m in moments)} kg m2, which no rigid body has ({path})"
        )
    bus.explicitinertial = True
    # MuJoCo takes a NaN ipos for the body's pos without a word: always set it.
    bus.mass, bus.ipos, bus.inertia = mass, place, moments
    bus.iquat = Rotation.from_matrix(axes * np.linalg.det(axes)).as_quat(scalar_first=True)
    return wanted


def add_bearing(spec: Any, bus: Any, vehicle: scene.Vehicle) -> None:
    """A ball joint without friction, gravity and a tilt stop where there is a lab, and torque limits."""
    bus.add_joint(type=mujoco.mjtJoint.mjJNT_BALL, name="bearing")
    lab = vehicle.mount == "air_bearing"
    spec.option.gravity = [0.0, 0.0, -GRAVITY_M_S2 if lab else 0.0]
    spec.option.timestep = STEP_S
    spec.option.integrator = mujoco.mjtIntegrator.mjINT_RK4
    spec.option.disableflags |= int(mujoco.mjtDisableBit.mjDSBL_CONTACT)
    spec.compiler.fusestatic = True  # one rigid body instead of ten: 14 us a step instead of 20
    for name in MOTORS:
        motor = spec.actuator(name)
        motor.ctrllimited = mujoco.mjtLimited.mjLIMITED_TRUE
        motor.ctrlrange = [-vehicle.torque_limit_nm, vehicle.torque_limit_nm]
    if lab:
        add_tilt_stop(spec, bus, vehicle.tilt_stop_deg)


def add_tilt_stop(spec: Any, bus: Any, stop_deg: float) -> None:
    """A rope from the lab's z axis to the body's: its length is a function of tilt alone, so yaw is free.

    length^2 = L^2 + b^2 - 2 L b cos(tilt). A ball joint's own range would limit the whole rotation, yaw too.
    The limit has the shortest time constant that MuJoCo allows, two steps, and twice the critical damping: it
    gives way by 0.001 deg for each deg/s of the blow, and throws back 6 % of it.
    """
    spec.worldbody.add_site(name="tilt_stop_lab", pos=[0.0, 0.0, STOP_LAB_M])
    bus.add_site(name="tilt_stop_body", pos=[0.0, 0.0, STOP_BODY_M])
    cosine = np.cos(np.radians(stop_deg))
    length = np.sqrt(STOP_LAB_M**2 + STOP_BODY_M**2 - 2 * STOP_LAB_M * STOP_BODY_M * cosine)
    rope = spec.add_tendon(
        name="tilt_stop",
        limited=mujoco.mjtLimited.mjLIMITED_TRUE,
        range=[0.0, length],
        solref_limit=[2 * STEP_S, 2.0],
        solimp_limit=[0.99, 0.999, 1e-3, 0.5, 2.0],
    )
    rope.wrap_site("tilt_stop_lab")
    rope.wrap_site("tilt_stop_body")


def check(world: World, wanted: MassProperties, path: Path) -> None:
    """The compiled model is what was asked for; MuJoCo has ways of changing it without a word."""
    model, mass, bus = world.model, world.mass, world.model.body("bus").id
    if (model.body_rootid[model.jnt_bodyid] != bus).any():
        raise BadInput(f"{path}: only bus and what it carries may have joints")
    if model.body_rootid[model.cam_bodyid[model.camera(CAMERA).id]] != bus:
        raise BadInput(f"{path}: camera {CAMERA} must ride on body bus")
    same = (
        abs(mass.mass_kg - wanted.mass_kg) < 1e-9 * wanted.mass_kg
        and np.abs(mass.centre_m - wanted.centre_m).max() < 1e-9
        and np.abs(mass.inertia_kg_m2 - wanted.inertia_kg_m2).max() < 1e-9 * wanted.inertia_kg_m2.max()
    )
    if not same:
        raise BadInput(
            f"{path}: the mass comes out as {mass.mass_kg:g} kg at {mass.centre_m} m, not as declared;"
            " leave inertiafromgeom, settotalmass and the like out of <compiler>"
        )
    data = mujoco.MjData(model)
    for axis, name in enumerate(MOTORS):
        data.ctrl[:] = 0.0
        data.ctrl[world.motors[axis]] = push = world.vehicle.torque_limit_nm
        mujoco.mj_forward(model, data)
        if np.abs(data.qfrc_actuator[:3] - push * np.eye(3)[axis]).max() > 1e-9 * push:
            raise BadInput(
                f"{path}: motor {name} must turn bus about body {'xyz'[axis]} with 1 N m a unit of control"
            )


def mount(world: World) -> Mount:
    """Where the compiled camera sits on the body; MuJoCo's camera axes become ours here and nowhere else."""
    data = mujoco.MjData(world.model)
    mujoco.mj_forward(world.model, data)  # at qpos0 the body frame is the lab frame
    camera = data.camera(CAMERA)
    body_from_mjcam = Rotation.from_matrix(camera.xmat.reshape(3, 3))
    return Mount(np.array(camera.xpos), CAM_FROM_MJCAM * body_from_mjcam.inv())


def fly(
    world: World,
    lab_from_body_start: Rotation,
    rate_body_rad_s: Floats,
    duration_s: float,
    controller: Controller | None = None,
    control_period_s: float = 0.01,
) -> Trajectory:
    """The vehicle's motion under gravity, its stop and the controller's torques, sampled at every step.

    controller(t_s, lab_from_body, rate_body_rad_s) -> (3,) torque in N m about the body axes. It is asked at
    the start and every control period (whole steps); its torque, clipped to the limit, is held in between.
    rate_body_rad_s : (3,) at the start. Raises BadInput for a start beyond the tilt stop, RuntimeError where
    MuJoCo warned: it puts an unstable model back to its start and goes on.
    """
    check_tilt(world, lab_from_body_start)
    model, data = world.model, mujoco.MjData(world.model)
    data.qpos[:4] = lab_from_body_start.as_quat(scalar_first=True)
    data.qvel[:3] = rate_body_rad_s
    step_s = model.opt.timestep
    steps = max(1, int(np.ceil(duration_s / step_s - 1e-6)))
    every = max(1, round(control_period_s / step_s))
    quat_wxyz, rate = np.empty((steps + 1, 4)), np.empty((steps + 1, 3))
    attitude_wxyz, spin = data.qpos[:4], data.qvel[:3]  # views: they follow the state
    with mujoco_warnings() as warnings:
        for k in range(steps):
            quat_wxyz[k], rate[k] = attitude_wxyz, spin
            if controller and k % every == 0:
                here = Rotation.from_quat(attitude_wxyz, scalar_first=True)
                data.ctrl[world.motors] = controller(k * step_s, here, rate[k].copy())
            mujoco.mj_step(model, data)
    quat_wxyz[steps], rate[steps] = attitude_wxyz, spin
    if warnings:
        raise RuntimeError(f"MuJoCo warned in flight: {warnings[0]}")
    return Trajectory(np.arange(steps + 1) * step_s, Rotation.from_quat(quat_wxyz, scalar_first=True), rate)


def check_tilt(world: World, lab_from_body: Rotation) -> None:
    up_body = lab_from_body.as_matrix()[:, 2]
    tilt_deg = float(np.degrees(np.arccos(np.clip(up_body[2], -1, 1))))
    if world.vehicle.mount == "air_bearing" and tilt_deg > world.vehicle.tilt_stop_deg:
        raise BadInput(
            f"motion.start: tilted by {tilt_deg:.1f} deg, beyond vehicle.tilt_stop_deg"
            f" {world.vehicle.tilt_stop_deg:g}"
        )


@contextmanager
def mujoco_warnings() -> Iterator[list[str]]:
    """Collect MuJoCo's warnings, which it would print and append to a file in the user's folder."""
    caught: list[str] = []
    before = mujoco.get_mju_user_warning()
    mujoco.set_mju_user_warning(caught.append)
    try:
        yield caught
    finally:
        mujoco.set_mju_user_warning(before)


def one_line(error: Exception) -> str:
    return " ".join(str(error).split())
