"""The geometry of an MJCF file as plain shapes, for other drawing programs than MuJoCo's."""

from __future__ import annotations

from typing import NamedTuple

import mujoco
import numpy as np
from numpy.typing import NDArray

from skysim.core.types import Floats
from skysim.dynamics.multibody.mjcf import mujoco_warnings
from skysim.dynamics.multibody.view.mjcf_export import GROUP_HIDDEN
from skysim.dynamics.multibody.view.picture import LAB_CAMERA

KINDS = {
    mujoco.mjtGeom.mjGEOM_PLANE: "plane",
    mujoco.mjtGeom.mjGEOM_BOX: "box",
    mujoco.mjtGeom.mjGEOM_SPHERE: "sphere",
    mujoco.mjtGeom.mjGEOM_ELLIPSOID: "ellipsoid",
    mujoco.mjtGeom.mjGEOM_CYLINDER: "cylinder",
    mujoco.mjtGeom.mjGEOM_CAPSULE: "capsule",
    mujoco.mjtGeom.mjGEOM_MESH: "mesh",
}
LIGHTS = ("stage_leds", "stage_stars")  # begin of the names of the lights' geoms


class Shape(NamedTuple):
    """A shape in the lab, or on the vehicle in body axes with every joint at zero.

    name       : of the geom; empty if it has none
    kind       : of KINDS;  size_m : as MuJoCo has it: half edges, radius and half length along z, semi-axes
    on_vehicle : whether it turns with the vehicle
    vertices_m, faces : (N, 3) and (M, 3) of a mesh, in the shape's axes; empty of other kinds
    """

    name: str
    kind: str
    size_m: tuple[float, ...]
    position_m: tuple[float, ...]
    parent_from_shape_wxyz: tuple[float, ...]
    rgba: tuple[float, ...]
    on_vehicle: bool
    vertices_m: Floats
    faces: NDArray[np.int32]


class Laboratory(NamedTuple):
    """All visible shapes of a laboratory without its lights, and the camera `lab`: (3,) eye and what it looks at, m."""

    shapes: tuple[Shape, ...]
    eye_m: Floats
    target_m: Floats


def laboratory(mjcf: str) -> Laboratory:
    """The laboratory of an MJCF text, see `mjcf_export.mjcf`."""
    with mujoco_warnings():
        model = mujoco.MjModel.from_xml_string(mjcf)
        data = mujoco.MjData(model)
        mujoco.mj_kinematics(model, data)
    shown = [n for n in range(model.ngeom) if is_shown(model, n)]
    shapes = tuple(shape(model, data, n) for n in shown)
    return Laboratory(shapes, model.camera(LAB_CAMERA).pos.copy(), model.stat.center.copy())


def is_shown(model: mujoco.MjModel, n: int) -> bool:
    kind = mujoco.mjtGeom(model.geom_type[n])
    name = model.geom(n).name
    return kind in KINDS and model.geom_group[n] != GROUP_HIDDEN and not name.startswith(LIGHTS)


def shape(model: mujoco.MjModel, data: mujoco.MjData, n: int) -> Shape:
    """The geom with index n, in the pose of data."""
    wxyz = np.empty(4)
    mujoco.mju_mat2Quat(wxyz, data.geom_xmat[n])
    vertices_m, faces = mesh(model, n)
    return Shape(
        model.geom(n).name,
        KINDS[mujoco.mjtGeom(model.geom_type[n])],
        tuple(model.geom_size[n].tolist()),
        tuple(data.geom_xpos[n].tolist()),
        tuple(wxyz.tolist()),
        tuple(color(model, n).tolist()),
        bool(model.geom_bodyid[n] != 0),
        vertices_m,
        faces,
    )


def color(model: mujoco.MjModel, n: int) -> Floats:
    """(4,) of a geom: its own, or its material's if it has none of its own."""
    material = model.geom_matid[n]
    unset = (model.geom_rgba[n] == (0.5, 0.5, 0.5, 1.0)).all()
    return np.asarray(
        model.mat_rgba[material] if material >= 0 and unset else model.geom_rgba[n], float
    )


def mesh(model: mujoco.MjModel, n: int) -> tuple[Floats, NDArray[np.int32]]:
    """Vertices and faces of a geom's mesh; empty if it is none."""
    if model.geom_type[n] != mujoco.mjtGeom.mjGEOM_MESH:
        return np.empty((0, 3)), np.empty((0, 3), np.int32)
    k = model.geom_dataid[n]
    vertices = slice(model.mesh_vertadr[k], model.mesh_vertadr[k] + model.mesh_vertnum[k])
    faces = slice(model.mesh_faceadr[k], model.mesh_faceadr[k] + model.mesh_facenum[k])
    return model.mesh_vert[vertices].astype(float), model.mesh_face[faces].copy()
