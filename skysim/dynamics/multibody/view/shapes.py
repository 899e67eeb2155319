"""The vehicle's geometry as plain shapes, for other drawing programs than MuJoCo's."""

from __future__ import annotations

from typing import NamedTuple

import mujoco
import numpy as np
from scipy.spatial.transform import Rotation

from skysim.dynamics.multibody.model import VehicleModel

KINDS = {
    mujoco.mjtGeom.mjGEOM_BOX: "box",
    mujoco.mjtGeom.mjGEOM_SPHERE: "sphere",
    mujoco.mjtGeom.mjGEOM_CYLINDER: "cylinder",
    mujoco.mjtGeom.mjGEOM_CAPSULE: "cylinder",
    mujoco.mjtGeom.mjGEOM_ELLIPSOID: "sphere",
    mujoco.mjtGeom.mjGEOM_MESH: "box",  # its bounding box
}


class Shape(NamedTuple):
    """A part of the vehicle in body axes, every joint at zero.

    kind   : box (size_m half its edges), sphere (its radius first), cylinder (radius, half its length, along its z)
    """

    kind: str
    size_m: tuple[float, float, float]
    position_m: tuple[float, float, float]
    body_from_shape_wxyz: tuple[float, float, float, float]
    rgba: tuple[float, float, float, float]


def shapes(vehicle: VehicleModel) -> list[Shape]:
    """All shapes of the vehicle's file, without those of the bearing."""
    model = vehicle.model
    data = mujoco.MjData(model)
    mujoco.mj_kinematics(model, data)
    result = []
    for n in range(model.ngeom):
        kind = KINDS.get(mujoco.mjtGeom(model.geom_type[n]))
        if kind is None or model.geom_bodyid[n] == 0:
            continue
        mesh = model.geom_type[n] == mujoco.mjtGeom.mjGEOM_MESH
        size = model.geom_aabb[n, 3:] if mesh else model.geom_size[n]
        body_from_shape = Rotation.from_matrix(data.geom_xmat[n].reshape(3, 3))
        # The box of a mesh is not about the geom's origin, which is the mesh's center of mass; of other geoms it is.
        position_m = data.geom_xpos[n] + body_from_shape.apply(model.geom_aabb[n, :3])
        fields = (size, position_m, body_from_shape.as_quat(scalar_first=True), model.geom_rgba[n])
        result.append(Shape(kind, *(tuple(np.asarray(value, float).tolist()) for value in fields)))
    return result
