"""Build the MuJoCo model: the vehicle's MJCF on its bearing, with the actuators that the scene switches on.

`compose` makes the model as an MjSpec:

1. Load the file, and move body bus to the lab's origin without joints of its own.
2. Place the camera.
3. Lock the joints of unused actuators.
4. Set the declared mass properties.
5. Add a ball joint (the air bearing) with drag, cable spring and tilt stop.
6. Check that MuJoCo compiles it as declared.
7. Unbalance the wheels, add the motors, and move the trim masses.

`build` compiles it and looks up the actuators. MuJoCo's qpos of a ball joint is lab_from_body as wxyz, its qvel the
angular rate in body axes.

A new kind of actuator is a file beside this one, an entry in `KINDS`, and its section in scene/sections/vehicle.py. The
MJCF of a vehicle places the actuators by the names of joints and sites; the scene sets their limits.
"""

import itertools
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import mujoco
import numpy as np
from scipy.spatial.transform import Rotation

from skysim.core.constants import STANDARD_GRAVITY_M_S2
from skysim.core.errors import InputError
from skysim.core.paths import SCENES
from skysim.core.quaternion import to_rotation
from skysim.core.types import Floats, Ints, Mount, frozen
from skysim.dynamics.multibody.actuator_kind import (
    ActuatorDrive,
    ActuatorKind,
    Actuators,
    Hinges,
    add_motor,
    all_names,
    at_zero,
    named,
)
from skysim.dynamics.multibody.cmgs import CMGS, GIMBAL, ROTOR
from skysim.dynamics.multibody.mass import (
    CAMERA,
    TRIM,
    TRIMS,
    MassProperties,
    Trims,
    declare_mass,
    hold_trims,
    tree_mass,
    unbalance,
)
from skysim.dynamics.multibody.mjcf import MujocoWarnings, compile_spec, load, mujoco_errors
from skysim.dynamics.multibody.thrusters import FAN, FANS, THRUSTER, THRUSTERS, Fans
from skysim.dynamics.multibody.wheels import WHEEL, WHEELS
from skysim.scene.sections.vehicle import VehicleConfig

# All kinds of actuators, and their use in a vehicle's model.

KINDS: tuple[ActuatorKind, ...] = (WHEELS, CMGS, FANS, THRUSTERS, TRIMS)

TORQUES = ("torque_x", "torque_y", "torque_z")
PREFIXES = (*(prefix for kind in KINDS for prefix in (*kind.joints, *kind.sites)), TRIM)


class IdealTorques(Actuators):
    """Ideal torques about the body's axes, each of which is clipped by itself."""

    def drive(self, torque_nm: Floats) -> Floats:
        return torque_nm


def kinds_on(vehicle: VehicleConfig) -> list[tuple[ActuatorKind, Any]]:
    """The kinds that a scene switches on, each with its section."""
    kinds = [(kind, getattr(vehicle, kind.key)) for kind in KINDS]
    return [(kind, config) for kind, config in kinds if config is not None]


def build_actuators(config: VehicleConfig, vehicle: Any) -> dict[str, Actuators]:
    """All actuators that are switched on, by their key in `vehicle`, and `ideal` torques about the body's axes."""
    ideal = IdealTorques(vehicle.torques, np.eye(3), np.eye(3), config.torque_limit_nm)
    return {"ideal": ideal} | {
        kind.key: kind.control(vehicle, own) for kind, own in kinds_on(config)
    }


def build_drives(config: VehicleConfig, vehicle: Any) -> list[ActuatorDrive]:
    """The hardware between commands and motors of all actuators that are switched on."""
    return [kind.drive(vehicle, own) for kind, own in kinds_on(config) if kind.drive]


def set_start(vehicle: VehicleConfig, model: Any, data: Any) -> None:
    """Set the angles and speeds of the actuators' joints in the data of a model to those at the scene's start."""
    for kind, config in kinds_on(vehicle):
        kind.start(model, data, config)


def add_actuators(spec: Any, model: Any, vehicle: VehicleConfig) -> None:
    """Add three ideal torques and the motors of all actuators that are on; model is the compiled spec."""
    for name, axis in zip(TORQUES, np.eye(3), strict=True):
        # The motor of a ball joint acts about an axis of the body.
        add_motor(spec, "bearing", gear=[*axis, 0, 0, 0]).name = name
    for kind, config in kinds_on(vehicle):
        kind.add(spec, model, config)


def lock_unused(spec: Any, vehicle: VehicleConfig, path: Path) -> dict[str, str]:
    """Delete the joints of actuators that are off, which locks them; check those of actuators that are on.

    Returns the names of the deleted joints, each with the key of the scene that would have kept it. Raises
    InputError if an actuator that is on has no joint, or for names in the file that skysim reserves.
    """
    locked: dict[str, str] = {}
    check_names(spec, path)
    # 1. Joints: delete or check.
    trim = "trims" if vehicle.trims else "trim"
    prefixes_by_key = {kind.key: kind.joints for kind in KINDS} | {trim: (TRIM,)}
    for key, prefixes in prefixes_by_key.items():
        for prefix in prefixes:
            found = named(spec.joints, prefix)
            if getattr(vehicle, key) is None:
                locked |= dict.fromkeys((joint.name for joint in found), f"vehicle.{key}")
                for joint in found:
                    spec.delete(joint)
            else:
                check_joints(found, prefix, key, path)
    # 2. The kinds' own checks, and their sites.
    for kind, _ in kinds_on(vehicle):
        kind.check(spec, path)
        for prefix in kind.sites:
            if not named(spec.sites, prefix):
                raise InputError(path, f"no site {prefix}*, which vehicle.{kind.key} needs")
    # 3. Names of the motors that `add_actuators` adds.
    for actuator in spec.actuators:
        problem = ""
        if actuator.name in TORQUES or actuator.name.startswith(PREFIXES):
            problem = f"actuator {actuator.name}: an actuator of this name is added"
        elif actuator.target.startswith(PREFIXES):
            problem = f"actuator of {actuator.target} is set by the scene"
        if problem:
            raise InputError(path, f"{problem}; remove it from the file")
    return locked


def check_joints(found: Sequence[Any], prefix: str, key: str, path: Path) -> None:
    """Raise InputError if joints of an actuator are missing, have another type, or have properties of their own.

    The scene sets their limit, spring, damping and drive.
    """
    wanted = mujoco.mjtJoint.mjJNT_SLIDE if prefix == TRIM else mujoco.mjtJoint.mjJNT_HINGE
    if not found:
        raise InputError(path, f"no joint {prefix}*, which vehicle.{key} needs")
    if any(joint.type != wanted for joint in found):
        raise InputError(
            path, f"joints {prefix}* must be {'slides' if prefix == TRIM else 'hinges'}"
        )
    # Each of these would act in addition to the scene's values.
    names = "range stiffness springref damping frictionloss armature actfrcrange"
    for joint, name in itertools.product(found, names.split()):
        if np.any(getattr(joint, name)):
            in_file = name.replace("actfrc", "actuatorfrc")
            raise InputError(
                path,
                f"joint {joint.name}: {in_file} is set by the scene; remove it from the file",
            )


def locked_joint_hint(spec: Any, locked: dict[str, str]) -> str:
    """Text to add to the error of a model that does not compile, if it refers to a deleted joint; else ""."""
    # All names that sensors, actuators and constraints refer to.
    named = {sensor.objname for sensor in spec.sensors} | {
        actuator.target for actuator in spec.actuators
    }
    named |= {
        name for equality in spec.equalities for name in (equality.name1, equality.name2)
    }
    name = next((name for name in locked if name in named), "")
    return name and f"; {locked[name]} is off, which locks joint {name}"


def check_names(spec: Any, path: Path) -> None:
    """Raise InputError for a joint or site whose name lacks the underscore of a prefix.

    It would silently not be an actuator.
    """
    # Prefixes end with an underscore: wheel_1 is a wheel, wheel1 nearly one.
    for element in (*spec.joints, *spec.sites):
        prefix = next((p for p in PREFIXES if element.name.startswith(p[:-1])), None)
        if prefix and not element.name.startswith(prefix):
            raise InputError(
                path,
                element.name,
                f"{prefix}{element.name[len(prefix) - 1 :]}, or another word",
            )


# The model: the vehicle's MJCF on its bearing, with its actuators.

STEP_S = 1e-3
CENTERED_M = 1e-9  # offset of a file's center of mass by rounding
GIVEN_TOLERANCE = 1e-3  # relative difference of a file's gravity, such as 9.81
IMU = "imu"
REQUIRED = f"body bus and camera {CAMERA}"

# MuJoCo's camera has +y up and looks along -z; ours has +y down and looks along +z.
CAM_FROM_MJCAM = Rotation.from_matrix(np.diag([1.0, -1.0, -1.0]))

# Heights of the two ends of the tilt stop above the bearing, in the lab and on the vehicle. They are unequal, so the
# distance between the ends never vanishes, and its derivative by the tilt is zero only at zero tilt.
STOP_LAB_M = 1.0
STOP_BODY_M = 0.5


@frozen
class VehicleModel:
    """A vehicle on its bearing, ready to simulate. Simulation does not change the model.

    Attributes
    ----------
    spec
        mujoco.MjSpec from which the model was compiled
    model
        mujoco.MjModel, whose first four qpos and three qvel are those of the bearing
    config
        The scene's section `vehicle`
    mass
        Mass properties of the whole vehicle, with balanced wheels and the trim masses at their positions
    torques
        (3,) numbers of the actuators for ideal torques about body x, y, z
    wheels, gimbals, rotors, fans, trims, thrusters
        Actuators; empty if they are not switched on
    """

    spec: Any
    model: Any
    config: VehicleConfig
    mass: MassProperties
    torques: Ints
    wheels: Hinges
    gimbals: Hinges
    rotors: Hinges
    fans: Fans
    trims: Trims
    thrusters: Fans

    @property
    def inertia_kg_m2(self) -> Floats:
        """(3, 3) inertia tensor about the bearing's center, in body axes, with every joint locked."""
        return self.mass.inertia_kg_m2

    @property
    def free_joints(self) -> list[str]:
        """Names of the joints that belong to no actuator, without the bearing and those without a name."""
        members = (self.wheels, self.gimbals, self.rotors, self.trims)
        known = {"", "bearing", *itertools.chain.from_iterable(one.names for one in members)}
        return [
            name for name in all_names(self.model.joint, self.model.njnt) if name not in known
        ]

    @property
    def ignored(self) -> list[str]:
        """The file's own actuators, which get no control, and its sensors, which are not read."""
        own = (*TORQUES, *PREFIXES)
        motors = all_names(self.model.actuator, self.model.nu)
        sensors = all_names(self.model.sensor, self.model.nsensor)
        return [f"actuator {name}" for name in motors if not name.startswith(own)] + [
            f"sensor {name}" for name in sensors
        ]

    @property
    def gravity_m_s2(self) -> float:
        """Gravity along lab -z, a positive number."""
        return float(-self.model.opt.gravity[2])


def build(vehicle: VehicleConfig) -> VehicleModel:
    """The compiled vehicle with its actuators. Raises InputError for a file or section that makes no vehicle."""
    path = SCENES / vehicle.model
    with MujocoWarnings():
        spec, mass, trims = compose(vehicle, path)
        model = compile_spec(spec, path)
    return VehicleModel(
        spec,
        model,
        vehicle,
        mass,
        np.array([model.actuator(name).id for name in TORQUES]),
        Hinges(model, WHEEL),
        Hinges(model, GIMBAL),
        Hinges(model, ROTOR),
        Fans(model, FAN),
        trims,
        Fans(model, THRUSTER),
    )


def compose(vehicle: VehicleConfig, path: Path) -> tuple[Any, MassProperties, Trims]:
    """The vehicle's MJCF on a bearing at the lab's origin as MjSpec, its mass properties, and its trim masses.

    Mount `air_bearing` has gravity along lab -z and a tilt stop. Mount `free` has neither; the vehicle rotates about
    its center of mass, which must be the body's origin. The steps are those of the module's docstring. Raises
    InputError.
    """
    # 1. Body bus.
    spec, bus = load_at_origin(path)
    # 2. Camera.
    place_camera(spec, vehicle)
    # 3. Locking comes before the mass: a locked rotor is part of the rigid vehicle.
    locked = lock_unused(spec, vehicle, path)
    try:
        bare = compile_spec(spec, path)
    except InputError as error:
        raise InputError(
            error.key, f"{error.problem}{locked_joint_hint(spec, locked)}"
        ) from None
    # 4. Mass properties.
    mass = declare_mass(bus, bare, vehicle, path)
    if vehicle.mount == "free" and np.abs(mass.center_m).max() > CENTERED_M:
        raise InputError(
            "vehicle.center_of_mass",
            "a free vehicle rotates about it, so it must be the body's origin",
            f"[0 m, 0 m, 0 m]; it is {np.round(mass.center_m, 6).tolist()} m",
        )
    # 5. Bearing.
    check_options(spec, vehicle, path)
    with mujoco_errors(path, "a name is reserved for skysim's bearing"):
        add_bearing(spec, bus, vehicle)
    # 6. Check while the wheels are balanced, since `unbalance` changes the mass properties on purpose.
    balanced = compile_spec(spec, path)
    check_compiled(balanced, mass, path)
    # 7. Actuators.
    if vehicle.wheels:
        unbalance(balanced, named(spec.joints, WHEEL), vehicle.wheels, path)
    add_actuators(spec, balanced, vehicle)
    trims = hold_trims(spec, balanced, vehicle, path)
    return spec, trims.moved_mass(mass), trims


def load_at_origin(path: Path) -> tuple[Any, Any]:
    """The spec of a file, and its body bus, moved to the lab's origin and without joints of its own. Raises InputError.

    The compiler fuses no bodies, which it must not until the bearing is added.
    """
    spec = load(path)
    spec.compiler.fusestatic = False
    # The file must have the bus, as a child of the world, and the camera.
    required = {"body bus": spec.body("bus"), f"camera {CAMERA}": spec.camera(CAMERA)}
    missing = [name for name, element in required.items() if element is None]
    if missing:
        raise InputError(path, f"no {', no '.join(missing)}; a vehicle needs {REQUIRED}")
    bus = spec.body("bus")
    if bus.parent.name != "world" or bus.frame is not None:
        raise InputError(
            path, "body bus must be a direct child of worldbody, not of another body or frame"
        )
    for joint in list(bus.joints):
        if joint.name.startswith(tuple(prefix for kind in KINDS for prefix in kind.joints)):
            raise InputError(path, f"joint {joint.name} must be on a child body of bus")
        spec.delete(joint)
    # Keyframes are lists of joint positions, which no longer fit.
    for key in list(spec.keys):
        spec.delete(key)
    # Without this an euler or axisangle of the file would override the quaternion.
    bus.alt.type = mujoco.mjtOrientation.mjORIENTATION_QUAT
    bus.pos = [0.0, 0.0, 0.0]
    bus.quat = [1.0, 0.0, 0.0, 0.0]
    return spec, bus


def place_camera(spec: Any, vehicle: VehicleConfig) -> None:
    """Move the camera's pupil to the position that the scene gives, and turn the camera on its mount.

    The body that carries the camera moves, or the camera itself if it is on bus. Only the camera turns.
    """
    camera = spec.camera(CAMERA)
    if any(vehicle.camera_rotation_deg):
        # The rotation vector is in the camera's axes (+x right, +y down, +z boresight).
        wxyz = spec.compile().camera(CAMERA).quat
        file_from_turned = Rotation.from_rotvec(vehicle.camera_rotation_deg, degrees=True)
        mjcam_from_turned = CAM_FROM_MJCAM.inv() * file_from_turned * CAM_FROM_MJCAM
        parent_from_turned = to_rotation(wxyz) * mjcam_from_turned
        camera.alt.type = mujoco.mjtOrientation.mjORIENTATION_QUAT
        camera.quat = parent_from_turned.as_quat(scalar_first=True)
    if vehicle.camera_m is None:
        return
    model = spec.compile()
    data = mujoco.MjData(model)
    mujoco.mj_kinematics(model, data)
    carrier = camera if camera.parent.name == "bus" else camera.parent
    R_lab_from_parent = data.body(carrier.parent.name).xmat.reshape(3, 3)
    mujoco.mj_camlight(model, data)
    offset_m = np.array(vehicle.camera_m) - data.camera(CAMERA).xpos
    carrier.pos = carrier.pos + R_lab_from_parent.T @ offset_m


def gravity_lab_m_s2(vehicle: VehicleConfig) -> list[float]:
    """Gravity on the vehicle in lab axes."""
    on_bearing = vehicle.mount == "air_bearing"
    return [0.0, 0.0, -STANDARD_GRAVITY_M_S2 if on_bearing else 0.0]


def check_options(spec: Any, vehicle: VehicleConfig, path: Path) -> None:
    """Raise InputError for an <option> of the file that `add_bearing` would replace by another value.

    MuJoCo's defaults pass, since a spec does not tell them from a file's.
    """
    own: dict[str, Any] = {
        "gravity": gravity_lab_m_s2(vehicle),
        "timestep": STEP_S,
        "integrator": int(mujoco.mjtIntegrator.mjINT_RK4),
        "disableflags": 0,
    }
    default = mujoco.MjSpec().option
    for name, value in own.items():
        given = np.asarray(getattr(spec.option, name))
        is_default = np.array_equal(given, getattr(default, name))
        if not (is_default or np.allclose(given, value, rtol=GIVEN_TOLERANCE, atol=0)):
            raise InputError(
                path,
                f"<option> {name} {given.tolist()} is not used: with mount {vehicle.mount} it is {value}; remove it"
                " from the file",
            )


def add_bearing(spec: Any, bus: Any, vehicle: VehicleConfig) -> None:
    """Add a ball joint with air drag and cable spring; for an air bearing also gravity and a tilt stop.

        drag:   T = -(viscous + quadratic |rate|) rate    about each axis
        spring: T = -stiffness rotvec(lab_from_body)

    MuJoCo computes both, at every stage of a Runge-Kutta step.
    """
    drag = vehicle.drag
    cable = vehicle.disturbances.cable
    bus.add_joint(
        type=mujoco.mjtJoint.mjJNT_BALL,
        name="bearing",
        damping=[drag.viscous_nms, drag.quadratic_nms2, 0.0],
        stiffness=[cable.stiffness_nm_rad if cable else 0.0, 0.0, 0.0],
    )
    on_bearing = vehicle.mount == "air_bearing"
    spec.option.gravity = gravity_lab_m_s2(vehicle)
    spec.option.timestep = STEP_S
    spec.option.integrator = mujoco.mjtIntegrator.mjINT_RK4
    # The solver's tolerance is in units of the mean inertia: MuJoCo's default of 1e-8 would hide the friction of a
    # small wheel in a heavy vehicle. The smaller one costs no time.
    spec.option.tolerance = 1e-16
    # There are few constraints, on one tree: no contacts, no search for islands. PGS is the fastest solver for this.
    spec.option.disableflags |= int(
        mujoco.mjtDisableBit.mjDSBL_CONTACT | mujoco.mjtDisableBit.mjDSBL_ISLAND
    )
    spec.option.solver = mujoco.mjtSolver.mjSOL_PGS
    spec.option.jacobian = mujoco.mjtJacobian.mjJAC_DENSE
    # One rigid body instead of ten takes 14 us a step instead of 20.
    spec.compiler.fusestatic = True
    if on_bearing:
        add_tilt_stop(spec, bus, vehicle.tilt_stop_deg)


def add_tilt_stop(spec: Any, bus: Any, stop_deg: float) -> None:
    """Limit the tilt by a tendon from a point on the lab's z axis at L to a point on the body's z axis at b.

        length^2 = L^2 + b^2 - 2 L b cos(tilt)

    The length depends on tilt only, so yaw is free; the range of a ball joint would limit the whole rotation. The
    limit has the shortest time constant that MuJoCo allows, two steps, and twice the critical damping. It yields by
    0.001 deg for each deg/s of impact and returns 6 % of that rate.
    """
    spec.worldbody.add_site(name="tilt_stop_lab", pos=[0.0, 0.0, STOP_LAB_M])
    bus.add_site(name="tilt_stop_body", pos=[0.0, 0.0, STOP_BODY_M])
    cosine = np.cos(np.radians(stop_deg))
    length = np.sqrt(STOP_LAB_M**2 + STOP_BODY_M**2 - 2 * STOP_LAB_M * STOP_BODY_M * cosine)
    tendon = spec.add_tendon(
        name="tilt_stop",
        limited=mujoco.mjtLimited.mjLIMITED_TRUE,
        range=[0.0, length],
        solref_limit=[2 * STEP_S, 2.0],
        solimp_limit=[0.99, 0.999, 1e-3, 0.5, 2.0],
    )
    tendon.wrap_site("tilt_stop_lab")
    tendon.wrap_site("tilt_stop_body")


def check_compiled(model: Any, declared: MassProperties, path: Path) -> None:
    """Raise InputError unless the compiled model is as declared; MuJoCo may change it silently."""
    # All sites of actuators, all joints and the camera are on bus or its children.
    bus = model.body("bus").id
    mass = tree_mass(model)
    for prefix in (prefix for kind in KINDS for prefix in kind.sites):
        bodies = [
            model.site(name).bodyid[0] for name in all_names(model.site, model.nsite, prefix)
        ]
        if any(model.body_rootid[body] != bus for body in bodies):
            raise InputError(path, f"sites {prefix}* must be on body bus or its children")
    if (model.body_rootid[model.jnt_bodyid] != bus).any():
        raise InputError(path, "a joint outside body bus", "joints of bus and its children")
    if model.body_rootid[model.cam_bodyid[model.camera(CAMERA).id]] != bus:
        raise InputError(path, f"camera {CAMERA} must be on body bus or its children")
    # Mass, center and inertia.
    matches = (
        abs(mass.mass_kg - declared.mass_kg) < 1e-9 * declared.mass_kg
        and np.abs(mass.center_m - declared.center_m).max() < 1e-9
        and np.abs(mass.inertia_kg_m2 - declared.inertia_kg_m2).max()
        < 1e-7 * declared.inertia_kg_m2.max()
    )
    if not matches:
        raise InputError(
            path,
            f"the compiled mass is {mass.mass_kg:g} kg at {mass.center_m} m, not as declared; remove inertiafromgeom,"
            " settotalmass and the like from <compiler>",
        )


def camera_mount(vehicle: VehicleModel) -> Mount:
    """Position and attitude of the camera on the body.

    Only this function converts MuJoCo's camera axes to skysim's.
    """
    data = at_zero(vehicle.model)
    camera = data.camera(CAMERA)
    body_from_mjcam = Rotation.from_matrix(camera.xmat.reshape(3, 3))
    return Mount(np.array(camera.xpos), CAM_FROM_MJCAM * body_from_mjcam.inv())


def imu_position_m(vehicle: VehicleModel) -> Floats:
    """(3,) position of the accelerometers in body axes: site `imu`, or the bearing's center if there is none."""
    if vehicle.spec.site(IMU) is None:
        return np.zeros(3)
    data = at_zero(vehicle.model)
    return np.array(data.site(IMU).xpos)
