"""Occlusion of sources by the vehicle and the lab, by MuJoCo's ray casting.

1. `Obstacles` compiles the vehicle once, with its attitude free to set, and finds the geoms of the camera's
   housing, which let light through.
2. `occluded` sets the attitude and casts a ray from the pupil to each source.

Sources and pupil are points: a source is visible or not, at the pose of mid-exposure. Wheels and gimbals keep their
initial angles.
"""

import math

import mujoco
import numpy as np
from scipy.spatial.transform import Rotation

from skysim.core import quaternion
from skysim.core.jit import jit
from skysim.core.paths import SCENES
from skysim.core.types import Bools, Floats, Mount
from skysim.dynamics.multibody.mass import CAMERA
from skysim.dynamics.multibody.mjcf import MujocoWarnings, compile_spec
from skysim.dynamics.multibody.model import (
    VehicleModel,
    camera_mount,
    load_at_origin,
    lock_unused,
    place_camera,
    set_start,
)

# Groups of geoms: those that block light, and the camera's own housing. Rays are tested against the first only.
OPAQUE = 0
TRANSPARENT = 5
GROUPS = np.array([1, 0, 0, 0, 0, 0], dtype=np.uint8)


class Obstacles:
    """The geoms that can hide a source from the main camera, or from a further camera with the given mount.

    The attitude of the vehicle can be set.

    1. Compile the vehicle's file again with separate bodies, since the simulated model has all rigid bodies fused
       into bus.
    2. The camera's housing lets light through: all geoms of the body that carries the camera, if it is not bus, and
       any geom that surrounds the pupil, since the camera then looks out through a hole in it. A further camera has
       no housing of its own, and the housing of the main camera blocks its light.

    MuJoCo's rays ignore geoms with an alpha of 0.

    Attributes
    ----------
    model, data
        MuJoCo model and data, separate from the simulated ones; body bus is a mocap body
    camera_body_m
        (3,) position of the pupil, where all rays begin, in body axes
    """

    def __init__(self, vehicle: VehicleModel, mount: Mount | None = None) -> None:
        # 1. Model with the initial angles of wheels and gimbals.
        path = SCENES / vehicle.config.model
        with MujocoWarnings():
            spec, bus = load_at_origin(path)
            place_camera(spec, vehicle.config)
            bus.mocap = True  # the pose of a mocap body is set, not simulated
            lock_unused(spec, vehicle.config, path)
            self.model = compile_spec(spec, path)
        self.data = mujoco.MjData(self.model)
        set_start(vehicle.config, self.model, self.data)
        mujoco.mj_kinematics(self.model, self.data)
        # 2. Housing.
        self.camera_body_m = (mount or camera_mount(vehicle)).camera_body_m
        housing = camera_housing(self, is_main=mount is None)
        self.model.geom_group[:] = np.where(housing, TRANSPARENT, OPAQUE)


def camera_housing(obstacles: Obstacles, is_main: bool) -> Bools:
    """(ngeom,) whether each geom belongs to the camera's housing. Overwrites the geoms' groups."""
    model = obstacles.model
    body = model.cam_bodyid[model.camera(CAMERA).id]
    is_housing = (model.geom_bodyid == body) & (body != model.body("bus").id) & is_main
    # A geom surrounds the pupil if rays in six directions meet it, with all other geoms transparent.
    six_directions = np.vstack([np.eye(3), -np.eye(3)])
    for geom in np.flatnonzero(~is_housing):
        model.geom_group[:] = TRANSPARENT
        model.geom_group[geom] = OPAQUE
        distance_m = free_distance_m(obstacles, obstacles.camera_body_m, six_directions)
        is_housing[geom] = np.isfinite(distance_m).all()
    return np.asarray(is_housing)


def occluded(obstacles: Obstacles, lab_from_body: Rotation, place: Floats) -> Bools:
    """(N,) whether a part of the vehicle or the lab is between the pupil and each LED or star.

    Parameters
    ----------
    obstacles
        Geoms that block light
    lab_from_body
        Attitude of the vehicle
    place
        (N, 4) places as in `Sources`: positions of LEDs in the lab in m and 1, or directions of stars and 0
    """
    # 1. Rays from the pupil at this attitude.
    lab_from_body_wxyz = quaternion.from_rotation(lab_from_body)
    camera_m = quaternion.apply(lab_from_body_wxyz, obstacles.camera_body_m)
    rays, end_m = _rays(np.ascontiguousarray(place), camera_m)
    # 2. Pose of the vehicle, and the nearest geom on each ray.
    obstacles.data.mocap_quat[obstacles.model.body("bus").mocapid[0]] = lab_from_body_wxyz
    mujoco.mj_kinematics(obstacles.model, obstacles.data)
    return free_distance_m(obstacles, camera_m, rays) < end_m


@jit
def _rays(place: Floats, camera_m: Floats) -> tuple[Floats, Floats]:
    """(N, 3) unit vectors from the pupil to the sources, and (N,) the sources' distances in m, infinite for stars."""
    rays = np.empty((len(place), 3))
    end_m = np.empty(len(place))
    for n in range(len(place)):
        # The fourth component of a place is 1 for an LED, which is seen from the pupil, and 0 for a direction.
        square = 0.0
        for i in range(3):
            rays[n, i] = place[n, i] - place[n, 3] * camera_m[i]
            square += rays[n, i] * rays[n, i]
        length = math.sqrt(square)
        end_m[n] = length if place[n, 3] > 0 else math.inf
        for i in range(3):
            rays[n, i] /= length
    return rays, end_m


def free_distance_m(obstacles: Obstacles, from_m: Floats, rays: Floats) -> Floats:
    """(N,) distance in m from a point of the lab along unit vectors (N, 3) to the next opaque geom; inf if none."""
    count = len(rays)
    geom = np.empty(count, np.int32)
    distance_m = np.empty(count)
    mujoco.mj_multiRay(
        obstacles.model,
        obstacles.data,
        from_m,
        np.ascontiguousarray(rays).ravel(),
        GROUPS,
        True,
        -1,
        geom,
        distance_m,
        None,
        count,
        mujoco.mjMAXVAL,
    )
    return np.where(distance_m >= 0, distance_m, np.inf)
