"""The geometry of an MJCF file as plain shapes, for drawing programs other than MuJoCo's."""

from typing import NamedTuple

import mujoco
import numpy as np

from skysim.core.types import Array, Floats
from skysim.dynamics.multibody.mjcf import LAB_CAMERA, MujocoWarnings
from skysim.dynamics.multibody.mjcf_export import GROUP_HIDDEN, mesh_arrays

KINDS = {
    mujoco.mjtGeom.mjGEOM_PLANE: "plane",
    mujoco.mjtGeom.mjGEOM_BOX: "box",
    mujoco.mjtGeom.mjGEOM_SPHERE: "sphere",
    mujoco.mjtGeom.mjGEOM_ELLIPSOID: "ellipsoid",
    mujoco.mjtGeom.mjGEOM_CYLINDER: "cylinder",
    mujoco.mjtGeom.mjGEOM_CAPSULE: "capsule",
    mujoco.mjtGeom.mjGEOM_MESH: "mesh",
}
LIGHTS = ("stage_leds", "stage_stars")  # prefixes of the names of the lights' geoms


class Shape(NamedTuple):
    """A shape in the lab, or on the vehicle in body axes with every joint at zero.

    Attributes
    ----------
    name
        Name of the geom; empty if it has none
    kind
        One of the values of KINDS
    size_m
        Size as defined by MuJoCo: half edges, radius and half length along z, or semi-axes
    position_m
        (3,) position of its center
    parent_from_shape_wxyz
        (4,) rotation from the shape's axes to those of lab or body
    rgba
        (4,) color
    on_vehicle
        Whether it rotates with the vehicle
    vertices_m, faces
        (N, 3) vertices and (M, 3) faces of a mesh, in the shape's axes; empty for other kinds
    """

    name: str
    kind: str
    size_m: tuple[float, ...]
    position_m: tuple[float, ...]
    parent_from_shape_wxyz: tuple[float, ...]
    rgba: tuple[float, ...]
    on_vehicle: bool
    vertices_m: Floats
    faces: Array[np.int32]


class Laboratory:
    """All visible shapes of a laboratory except its lights, and the view of the camera `lab`.

    Parameters
    ----------
    mjcf
        Text from `mjcf_export.mjcf`

    Attributes
    ----------
    shapes
        Shapes of vehicle, dome and room
    eye_m, target_m
        (3,) positions in the lab of the camera and of the point at which it looks
    """

    def __init__(self, mjcf: str) -> None:
        with MujocoWarnings():
            model = mujoco.MjModel.from_xml_string(mjcf)
            data = mujoco.MjData(model)
            mujoco.mj_kinematics(model, data)
        shown = [n for n in range(model.ngeom) if is_shown(model, n)]
        self.shapes = tuple(shape(model, data, n) for n in shown)
        self.eye_m = model.camera(LAB_CAMERA).pos.copy()
        self.target_m = model.stat.center.copy()


def is_shown(model: mujoco.MjModel, n: int) -> bool:
    """Whether the geom with index n is visible and is no light."""
    known = mujoco.mjtGeom(model.geom_type[n]) in KINDS
    is_light = model.geom(n).name.startswith(LIGHTS)
    return known and model.geom_group[n] != GROUP_HIDDEN and not is_light


def shape(model: mujoco.MjModel, data: mujoco.MjData, n: int) -> Shape:
    """The geom with index n as a shape, in the pose of data."""
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
    """(4,) color of a geom: its own, or that of its material if it has none."""
    material = model.geom_matid[n]
    # MuJoCo's default color marks a geom without one.
    unset = (model.geom_rgba[n] == (0.5, 0.5, 0.5, 1.0)).all()
    return np.asarray(
        model.mat_rgba[material] if material >= 0 and unset else model.geom_rgba[n], float
    )


def mesh(model: mujoco.MjModel, n: int) -> tuple[Floats, Array[np.int32]]:
    """Vertices (N, 3) and faces (M, 3) of the mesh of a geom; empty for other kinds."""
    if model.geom_type[n] != mujoco.mjtGeom.mjGEOM_MESH:
        return np.empty((0, 3)), np.empty((0, 3), np.int32)
    return mesh_arrays(model, model.geom_dataid[n])
