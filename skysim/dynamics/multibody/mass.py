"""Mass properties: compute those of the vehicle, set those that the scene declares, and move its trim masses.

1. `tree_mass` adds up the bodies of a compiled model.
2. `declare_mass` gives body bus the difference between the declared mass properties and those of what it carries.
3. `unbalance` offsets and tilts the wheels' mass.
4. `hold_trims` moves the trim masses: motorized masses on slides that bring the center of mass to the bearing's
   center. A motor with a lead screw holds its mass in place during a run, so the body is moved along the axis of the
   joint, and the joint is removed unless `vehicle.trims` moves it in flight.

Trim masses that motors move in flight are slide joints `trim_*`. With the masses m at displacements d from their start,
along axes a, gravity g turns the body by

    T = sum m d a x g

which is horizontal: no displacement gives a torque about the vertical. MuJoCo computes it, and all other effects of the
moving masses. A lead screw is stiff, so its servo is fast, and its set-point leads by what gravity would make it yield.
"""

from pathlib import Path
from typing import Any

import mujoco
import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from skysim.core.errors import InputError
from skysim.core.quaternion import to_rotation
from skysim.core.types import Floats, frozen
from skysim.dynamics.multibody.actuator_kind import (
    ActuatorKind,
    Actuators,
    ControlInput,
    Hinges,
    add_servos,
    at_zero,
    inverse,
    named,
)
from skysim.scene.sections.vehicle import TrimsConfig, VehicleConfig, WheelsConfig

CAMERA = "star_camera"


@frozen
class MassProperties:
    """Mass properties of the vehicle, in body axes.

    Attributes
    ----------
    mass_kg
        Mass
    center_m
        (3,) center of mass
    inertia_kg_m2
        (3, 3) inertia about the body's origin
    """

    mass_kg: float
    center_m: Floats
    inertia_kg_m2: Floats


def tree_mass(model: Any, without_bus: bool = False) -> MassProperties:
    """Mass properties of body bus and all that it carries, from the compiled model; without_bus leaves out the bus.

    M = sum m,    center = sum m c / M,    J = sum R diag(I) R^T + m (c.c E - c c^T)    (Steiner)
    """
    data = at_zero(model)
    bus = model.body("bus").id
    counted = model.body_rootid == bus
    counted[bus] &= not without_bus
    mass = model.body_mass[counted]
    center = data.xipos[counted]
    axes = data.ximat[counted].reshape(-1, 3, 3)
    inertia = np.einsum("nij,nj,nkj->ik", axes, model.body_inertia[counted], axes)
    inertia += sum(
        (parallel_axis(m, p) for m, p in zip(mass, center, strict=True)), np.zeros((3, 3))
    )
    return MassProperties(float(mass.sum()), mass @ center / max(mass.sum(), 1e-300), inertia)


def parallel_axis(mass_kg: float, position_m: Floats) -> Floats:
    """(3, 3) inertia of a point mass at r (3,) about the origin: m (r.r E - r r^T)."""
    return mass_kg * (position_m @ position_m * np.eye(3) - np.outer(position_m, position_m))


def declare_mass(bus: Any, model: Any, vehicle: VehicleConfig, path: Path) -> MassProperties:
    """Set the mass properties of body bus so that the vehicle has the declared ones, which are returned.

    1. The declared properties: those of the scene, or of the file where the scene leaves one out. The scene's inertia
       is about the bearing's center, with principal axes along the body's.
    2. The bus has the declared mass and first moment minus those of what it carries.
    3. Its inertia about its own center is the declared one minus that of what it carries, minus Steiner's term.

    No part moves: the bus's properties change in place of a lab's balance masses, and the camera keeps its position.
    Raises InputError if the bus would need an impossible mass or inertia.
    """
    # 1. Declared properties.
    total = tree_mass(model)
    carried = tree_mass(model, without_bus=True)
    center = total.center_m
    inertia = total.inertia_kg_m2
    if vehicle.center_of_mass_m is not None:
        center = np.array(vehicle.center_of_mass_m)
    if vehicle.inertia_kg_m2 is not None:
        inertia = np.diag(vehicle.inertia_kg_m2)
    declared = MassProperties(vehicle.mass_kg or total.mass_kg, center, inertia)
    # 2. Mass and center of the bus.
    mass = declared.mass_kg - carried.mass_kg
    if mass <= 0:
        raise InputError(
            "vehicle.mass",
            f"{declared.mass_kg:g} kg",
            f"more than the {carried.mass_kg:g} kg that the bus carries ({path})",
        )
    center_bus = (
        declared.mass_kg * declared.center_m - carried.mass_kg * carried.center_m
    ) / mass
    # 3. Inertia of the bus about its center.
    own_inertia = inertia - carried.inertia_kg_m2 - parallel_axis(mass, center_bus)
    # The error message names the camera if its lever arm alone makes the inertia impossible.
    subject = ("vehicle.inertia", f"less what the bus carries ({path}), its")
    if vehicle.camera_m is not None and is_lever_too_long(
        own_inertia, model, np.array(vehicle.camera_m)
    ):
        distance_m = np.linalg.norm(vehicle.camera_m)
        subject = (
            "vehicle.camera",
            f"with the camera {distance_m:.3g} m from the bearing, the bus's ({path})",
        )
    set_inertial(bus, mass, center_bus, own_inertia, subject)
    return declared


def is_lever_too_long(bus_inertia_kg_m2: Floats, model: Any, camera_m: Floats) -> bool:
    """Whether the bus's inertia is impossible only because the scene puts the camera far from the bearing."""
    carrier = model.cam_bodyid[model.camera(CAMERA).id]
    if carrier == model.body("bus").id:
        return False
    without_lever = bus_inertia_kg_m2 + parallel_axis(
        model.body_subtreemass[carrier], camera_m
    )
    return not is_possible(np.linalg.eigvalsh(bus_inertia_kg_m2)) and is_possible(
        np.linalg.eigvalsh(without_lever)
    )


def unbalance(model: Any, wheel_joints: list[Any], wheels: WheelsConfig, path: Path) -> None:
    """Unbalance the wheels: offset each center of mass from the axle and tilt the principal axes.

    1. Two directions across the axle.
    2. Static imbalance U_s: offset the center of mass across the axle by U_s / mass. The axle feels the rotating
       force U_s speed^2, and the bearing its moment.
    3. Dynamic imbalance U_d: add a product of inertia between the axle and the second direction. The axle feels the
       rotating torque U_d speed^2, 90 deg from the force.

    The bodies of wheel_joints are changed; model is the compiled model with balanced wheels.
    """
    if not (wheels.static_imbalance_kg_m or wheels.dynamic_imbalance_kg_m2):
        return
    for joint in wheel_joints:
        rotor = joint.parent
        own = model.body(joint.parent.name)
        # 1. Directions in the rotor's axes; the compiled model has the axle in them.
        axle = model.joint(joint.name).axis
        across = np.cross(axle, np.eye(3)[np.argmin(np.abs(axle))])
        across /= np.linalg.norm(across)
        # 2. Center of mass.
        center_m = own.ipos + wheels.static_imbalance_kg_m / own.mass[0] * across
        # 3. Inertia.
        product = np.outer(axle, np.cross(axle, across))
        axes = to_rotation(own.iquat).as_matrix()
        balanced = axes @ np.diag(own.inertia) @ axes.T
        inertia = balanced + wheels.dynamic_imbalance_kg_m2 * (product + product.T)
        subject = ("vehicle.wheels.dynamic_imbalance", f"with it {joint.name}'s ({path})")
        set_inertial(rotor, own.mass[0], center_m, inertia, subject)


def is_possible(moments: NDArray) -> bool:
    """Whether a rigid body can have these principal moments I1 <= I2 <= I3: 0 < I1 and I3 <= I1 + I2."""
    return bool(moments[0] > 0 and moments[2] <= (moments[0] + moments[1]) * (1 + 1e-12))


def set_inertial(
    body: Any,
    mass_kg: float,
    center_m: Floats,
    inertia_kg_m2: Floats,
    subject: tuple[str, str],
) -> None:
    """Set the mass properties of a body of a spec. Raises InputError for an impossible inertia.

    Parameters
    ----------
    body
        Body of the spec
    mass_kg
        Mass
    center_m
        (3,) center of mass, in the body's axes
    inertia_kg_m2
        (3, 3) inertia about the center of mass
    subject
        Key of the error, and the possessive with which its message begins
    """
    key, whose = subject
    moments, axes = np.linalg.eigh(inertia_kg_m2)
    if not is_possible(moments):
        raise InputError(
            key,
            f"{whose} principal moments about its center of mass are {', '.join(f'{m:.3g}' for m in moments)} kg m2,"
            " impossible for a rigid body",
        )
    body.explicitinertial = True
    # MuJoCo silently takes a NaN ipos as the body's pos: always set it.
    body.mass = mass_kg
    body.ipos = center_m
    body.inertia = moments
    body.iquat = Rotation.from_matrix(axes * np.linalg.det(axes)).as_quat(scalar_first=True)
    # An orientation or full inertia that the file gives in another form would override these.
    body.ialt.type = mujoco.mjtOrientation.mjORIENTATION_QUAT
    body.fullinertia = np.full(6, np.nan)


@frozen
class Trims:
    """Trim masses, in the order of their joints' names.

    Attributes
    ----------
    names
        Names of the n joints
    axes
        (3, n) unit vectors of the slides, in body axes
    centers_m
        (3, n) centers of mass at position zero, in body axes
    mass_kg
        (n,) masses
    position_m
        (n,) positions along the slides at which they are held, or from which they start
    """

    names: tuple[str, ...]
    axes: Floats
    centers_m: Floats
    mass_kg: Floats
    position_m: Floats

    def __len__(self) -> int:
        return len(self.names)

    def added(self, position_m: Floats) -> tuple[Floats, Floats]:
        """Changes of the inertia (3, 3) about the bearing's center and of the first moment (3,), mass times position.

        They are those of moving the masses from zero to these positions (n,).
        """
        moved_m = self.centers_m + self.axes * position_m
        inertia = np.zeros((3, 3))
        for mass_kg, before, after in zip(
            self.mass_kg, self.centers_m.T, moved_m.T, strict=True
        ):
            inertia += parallel_axis(mass_kg, after) - parallel_axis(mass_kg, before)
        return inertia, np.asarray(self.axes @ (self.mass_kg * position_m))

    def moved_mass(self, at_zero: MassProperties) -> MassProperties:
        """The vehicle's mass properties with the masses at their positions, from those with all masses at zero."""
        inertia, moment = self.added(self.position_m)
        center_m = at_zero.center_m + moment / at_zero.mass_kg
        return MassProperties(at_zero.mass_kg, center_m, at_zero.inertia_kg_m2 + inertia)


def hold_trims(spec: Any, model: Any, vehicle: VehicleConfig, path: Path) -> Trims:
    """Move the trim masses of a spec to their positions; model is the compiled spec before.

    Their joints are removed unless motors move them in flight.
    """
    # 1. Axes and centers at position zero, from the compiled model.
    slides = named(spec.joints, TRIM)
    hinges = Hinges(model, TRIM)
    names = hinges.names
    bodies = [model.joint(name).bodyid[0] for name in names]
    data = at_zero(model)
    centers_m = data.subtree_com[bodies].T.copy()
    # 2. Move the bodies.
    position_m = np.zeros(len(names))
    if config := vehicle.trim:
        if config.position_m and len(config.position_m) != len(names):
            raise InputError(
                "vehicle.trim.position",
                f"{len(config.position_m)} values",
                f"{len(names)}, one for each of {', '.join(names)}, or none",
            )
        # Whole steps of the motors.
        wanted_m = np.array(config.position_m or (0.0,) * len(names))
        position_m = config.step_m * np.round(wanted_m / config.step_m)
    if vehicle.trims and np.abs(position_m).max() > vehicle.trims.travel_m:
        raise InputError(
            "vehicle.trim.position",
            f"beyond vehicle.trims.travel {vehicle.trims.travel_m:g} m",
        )
    for joint, axis, at_m in zip(slides, hinges.axes.T, position_m, strict=True):
        body = joint.parent
        if body.parent.name != "bus" or body.frame is not None:
            raise InputError(
                path,
                f"joint {joint.name} must be on a body directly in body bus, not in another body",
            )
        body.pos = body.pos + at_m * axis  # in the model the axes of bus are those of the lab
        # In flight the position of the joint is that of the mass.
        joint.ref = at_m
        if vehicle.trims is None:
            spec.delete(joint)
    mass_kg = model.body_subtreemass[bodies].copy()
    return Trims(names, hinges.axes, centers_m, mass_kg, position_m)


# Trim masses that motors move in flight: slide joints `trim_*`.


TRIM = "trim_"

SERVO_S = 5e-3  # time constant of the servo; five steps of the integration


def gravity_body_m_s2(model: Any, angles_rad: Floats) -> Floats:
    """(3,) the model's gravity in body axes, at a full qpos."""
    lab_from_body = to_rotation(angles_rad[:4])
    return lab_from_body.inv().apply(model.opt.gravity)


class TrimMotors:
    """Motors of the trim masses that count their steps. Stateful: one object per motion.

    Parameters
    ----------
    vehicle
        `VehicleModel`
    config
        The scene's `vehicle.trims`

    Attributes
    ----------
    start_m, position_m
        (n,) positions along the slides at the start and now
    """

    def __init__(self, vehicle: Any, config: TrimsConfig) -> None:
        self.model = vehicle.model
        self.config = config
        self.slides = Hinges(self.model, TRIM)
        self.motor = self.slides.motor
        self.start_m = self.model.qpos0[self.slides.qpos]
        self.position_m = self.start_m

    def moved(self, displacement_m: Floats, times_s: Floats) -> Floats:
        """Positions (K, n) at times (K, 1) after the start of a move to displacements (n,), within the travel."""
        wanted_m = np.clip(
            self.start_m + displacement_m, -self.config.travel_m, self.config.travel_m
        )
        reach_m = self.config.speed_limit_m_s * times_s
        return self.position_m + np.clip(wanted_m - self.position_m, -reach_m, reach_m)


class TrimActuator(TrimMotors, Actuators):
    """Actuators of the flight computer: trim masses. A command is a displacement from the position at the start.

    The computer measures the vertical as an inclinometer without errors would.
    """

    def __init__(self, vehicle: Any, config: TrimsConfig) -> None:
        TrimMotors.__init__(self, vehicle, config)
        lever_n = self.levers_n(self.model.qpos0)
        Actuators.__init__(self, self.motor, lever_n, inverse(lever_n), config.travel_m)

    def levers_n(self, angles_rad: Floats) -> Floats:
        """(3, n) torque on the body for each displacement, m a x g, at a full qpos."""
        gravity = gravity_body_m_s2(self.model, angles_rad)
        # The inertia of a slide is its mass.
        return np.cross(self.slides.axes.T, gravity).T * self.slides.inertia_kg_m2

    def allocate(self, control: Floats, torque_nm: Floats, inputs: ControlInput) -> Floats:
        """Command the smallest displacements that give the torque, or the nearest to it in least squares."""
        displacement_m = inverse(self.levers_n(inputs.angles_rad)) @ torque_nm
        return self.command(control, displacement_m, inputs)

    def command(self, control: Floats, commands: Floats, inputs: ControlInput) -> Floats:
        """The torque returned is that of the displacements in reach of a period."""
        control[self.motor] = commands
        self.position_m = self.moved(commands, np.array(inputs.period_s))
        return self.levers_n(inputs.angles_rad) @ (self.position_m - self.start_m)


class TrimDrive(TrimMotors):
    """The motors themselves: they move at a limited speed to the commanded displacements.

    Attributes
    ----------
    readings
        trim_m (n,): positions of the masses along their slides
    set_point_m
        (n,) set-points of the servos; None before the first period
    """

    set_point_m: Floats | None = None

    @property
    def readings(self) -> dict[str, Floats]:
        return {"trim_m": self.position_m}

    def apply(self, control: Floats, angles_rad: Floats) -> None:
        """Replace the displacements by the rates of the servos' set-points."""
        step_s = np.float64(self.model.opt.timestep)
        # 1. Positions after each step.
        times_s = step_s * np.arange(1, len(control) + 1)[:, None]
        path_m = self.moved(control[0, self.motor], times_s)
        # 2. A servo yields by the acceleration of gravity over its frequency squared.
        sag_m = SERVO_S**2 * (gravity_body_m_s2(self.model, angles_rad) @ self.slides.axes)
        if self.set_point_m is None:
            self.set_point_m = self.start_m - sag_m
        set_points_m = np.vstack((self.set_point_m, path_m - sag_m))
        control[:, self.motor] = np.diff(set_points_m, axis=0) / step_s
        self.position_m = path_m[-1]
        self.set_point_m = set_points_m[-1]


def add_trims(spec: Any, model: Any, _: TrimsConfig) -> None:
    """Add a servo at each slide."""
    add_servos(spec, model, TRIM, SERVO_S)


def start_trims(model: Any, data: Any, _: TrimsConfig) -> None:
    """Set the set-points of the servos to the positions at the start, less what gravity makes them yield."""
    slides = Hinges(model, TRIM)
    if (slides.motor < 0).any():
        return  # a model without motors, of the shapes alone
    sag_m = SERVO_S**2 * (gravity_body_m_s2(model, data.qpos) @ slides.axes)
    data.act[model.actuator_actadr[slides.motor]] = model.qpos0[slides.qpos] - sag_m


TRIMS = ActuatorKind("trims", add_trims, TrimActuator, start=start_trims, drive=TrimDrive)
