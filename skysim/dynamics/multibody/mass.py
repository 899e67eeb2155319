"""Mass properties: compute those of the vehicle, set those that the scene declares, and move its trim masses.

Trim masses are motorized masses on slides that bring the center of mass to the bearing's center. A motor with a lead
screw holds its mass where it is, so that a mass does not move during a run: its body is moved along the joint's axis,
and the joint is removed.
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Any

import mujoco
import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from skysim.core.errors import InputError
from skysim.core.types import Floats
from skysim.dynamics.multibody.actuator_kind import joints
from skysim.dynamics.multibody.actuators import TRIM
from skysim.scene.sections.vehicle import TrimConfig, VehicleConfig, WheelsConfig

CAMERA = "star_camera"


@dataclass(frozen=True, slots=True)
class MassProperties:
    """Of the vehicle, in body axes: mass, center of mass (3,), inertia (3, 3) about the body's origin."""

    mass_kg: float
    center_m: Floats
    inertia_kg_m2: Floats


def tree_mass(model: Any, without_bus: bool = False) -> MassProperties:
    """Mass properties of the bus and all it carries, from the compiled model; with without_bus of what
    it carries only.
    """
    data = mujoco.MjData(model)
    mujoco.mj_forward(model, data)
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
    """(3, 3) inertia of a point mass about the origin: m (r.r E - r r^T) (Steiner)."""
    return mass_kg * (position_m @ position_m * np.eye(3) - np.outer(position_m, position_m))


def declare_mass(bus: Any, model: Any, vehicle: VehicleConfig, path: Path) -> MassProperties:
    """Set the bus's inertial so that the vehicle has the declared mass properties: declared minus what it
    carries.

    Mass and inertia that the scene leaves out stay as in the file; the center of mass is always the scene's.
    The inertia is that about the bearing's center, with principal axes along the body's. No part is moved: only the
    bus's inertial changes (in place of a lab's balance masses), and the camera keeps its position.
    """
    total = tree_mass(model)
    carried = tree_mass(model, without_bus=True)
    center = np.array(vehicle.center_of_mass_m)
    inertia = (
        total.inertia_kg_m2 if vehicle.inertia_kg_m2 is None else np.diag(vehicle.inertia_kg_m2)
    )
    declared = MassProperties(vehicle.mass_kg or total.mass_kg, center, inertia)
    mass = declared.mass_kg - carried.mass_kg
    if mass <= 0:
        raise InputError(
            "vehicle.mass",
            f"{declared.mass_kg:g} kg",
            f"more than the {carried.mass_kg:g} kg that the bus carries ({path})",
        )
    # The bus's own center follows from the first moments: total minus carried, over the bus's mass.
    center_bus = (declared.mass_kg * declared.center_m - carried.mass_kg * carried.center_m) / mass
    own_inertia = inertia - carried.inertia_kg_m2 - parallel_axis(mass, center_bus)
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
    """Whether the bus's inertia is impossible only because the scene puts the camera's housing far from the bearing."""
    carrier = model.cam_bodyid[model.camera(CAMERA).id]
    if carrier == model.body("bus").id:
        return False
    without_lever = bus_inertia_kg_m2 + parallel_axis(model.body_subtreemass[carrier], camera_m)
    return not is_possible(np.linalg.eigvalsh(bus_inertia_kg_m2)) and is_possible(
        np.linalg.eigvalsh(without_lever)
    )


def unbalance(model: Any, wheel_joints: list[Any], wheels: WheelsConfig, path: Path) -> None:
    """Unbalance the wheels: offset each center of mass from the axle and tilt the principal axes.

    Static: the rotor's center is moved across the axle by static_imbalance / mass; the axle feels the force
    U_s speed^2, the bearing its moment. Dynamic: a product of inertia U_d between the axle and the second axis
    across it; the axle feels the torque U_d speed^2, 90 deg from the former. Changes the joints' bodies; model is
    what they compiled to while balanced.
    """
    if not (wheels.static_imbalance_kg_m or wheels.dynamic_imbalance_kg_m2):
        return
    for joint in wheel_joints:
        rotor = joint.parent
        own = model.body(joint.parent.name)
        axle = model.joint(
            joint.name
        ).axis  # in the rotor's axes, whatever frame the file gave it in
        across = np.cross(axle, np.eye(3)[np.argmin(np.abs(axle))])
        across /= np.linalg.norm(across)
        product = np.outer(axle, np.cross(axle, across))
        axes = Rotation.from_quat(own.iquat, scalar_first=True).as_matrix()
        inertia = axes @ np.diag(own.inertia) @ axes.T + wheels.dynamic_imbalance_kg_m2 * (
            product + product.T
        )
        center_m = own.ipos + wheels.static_imbalance_kg_m / own.mass[0] * across
        subject = ("vehicle.wheels.dynamic_imbalance", f"with it {joint.name}'s ({path})")
        set_inertial(rotor, own.mass[0], center_m, inertia, subject)


def is_possible(moments: NDArray[Any]) -> bool:
    """Whether a rigid body can have these principal moments, in ascending order."""
    return bool(moments[0] > 0 and moments[2] <= (moments[0] + moments[1]) * (1 + 1e-12))


def set_inertial(
    body: Any, mass_kg: float, center_m: Floats, inertia_kg_m2: Floats, subject: tuple[str, str]
) -> None:
    """Set mass, center and inertia (3, 3) about it in a body of a spec. Raises InputError for impossible inertia.

    Parameters
    ----------
    subject
        The key at fault, and whose moments they are
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


@dataclass(frozen=True, slots=True)
class Trims:
    """Trim masses, in the order of their joints' names.

    Attributes
    ----------
    axes
        (3, n) directions in body axes
    centers_m
        (3, n) centers of mass at position zero
    mass_kg
        (n,)
    position_m
        (n,) where they are held
    """

    names: tuple[str, ...]
    axes: Floats
    centers_m: Floats
    mass_kg: Floats
    position_m: Floats

    def __len__(self) -> int:
        return len(self.names)

    def added(self, position_m: Floats) -> tuple[Floats, Floats]:
        """Inertia (3, 3) about the bearing's center and moment (3,), mass times position, that moving the masses from
        zero to these positions (n,) adds.
        """
        moved_m = self.centers_m + self.axes * position_m
        inertia = np.zeros((3, 3))
        for mass_kg, before, after in zip(self.mass_kg, self.centers_m.T, moved_m.T, strict=True):
            inertia += parallel_axis(mass_kg, after) - parallel_axis(mass_kg, before)
        return inertia, np.asarray(self.axes @ (self.mass_kg * position_m))

    def moved_mass(self, at_zero: MassProperties) -> MassProperties:
        """The vehicle's mass properties with the masses where they are held, from those with all at zero."""
        inertia, moment = self.added(self.position_m)
        center_m = at_zero.center_m + moment / at_zero.mass_kg
        return MassProperties(at_zero.mass_kg, center_m, at_zero.inertia_kg_m2 + inertia)


def held_position_m(config: TrimConfig, names: tuple[str, ...]) -> Floats:
    """(n,) positions that the motors can hold: whole steps. Raises InputError for another number of positions."""
    if config.position_m and len(config.position_m) != len(names):
        raise InputError(
            "vehicle.trim.position",
            f"{len(config.position_m)} values",
            f"{len(names)}, one for each of {', '.join(names)}, or none",
        )
    position_m = np.array(config.position_m or (0.0,) * len(names))
    return np.asarray(config.step_m * np.round(position_m / config.step_m))


def hold_trims(spec: Any, model: Any, vehicle: VehicleConfig, path: Path) -> Trims:
    """Move the trim masses of a spec to their places and remove their joints; model is the compiled spec before."""
    slides = joints(spec, TRIM) if vehicle.trim else []
    names = tuple(joint.name for joint in slides)
    data = mujoco.MjData(model)
    mujoco.mj_forward(model, data)
    ids = [model.joint(name).id for name in names]
    bodies = model.jnt_bodyid[ids]
    axes = data.xaxis[ids].T.copy()
    centers_m = data.subtree_com[bodies].T.copy()
    position_m = held_position_m(vehicle.trim, names) if vehicle.trim else np.zeros(0)
    for joint, axis, at_m in zip(slides, axes.T, position_m, strict=True):
        body = joint.parent
        if body.parent.name != "bus" or body.frame is not None:
            raise InputError(
                path,
                f"joint {joint.name} must be on a body directly in body bus, not in another body",
            )
        body.pos = body.pos + at_m * axis  # the bus's axes are the lab's in the model
        spec.delete(joint)
    return Trims(names, axes, centers_m, model.body_subtreemass[bodies].copy(), position_m)
