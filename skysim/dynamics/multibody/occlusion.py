"""Occlusion of sources by the vehicle and the lab (MuJoCo ray casting) and by the dome's wall.

Sources and pupil are points: a source is visible or not, at the pose of mid-exposure. Wheels and gimbals are as at
the start.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import mujoco
import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from skysim.core import quaternion
from skysim.core.paths import SCENES
from skysim.core.types import Floats, Sources
from skysim.dynamics.multibody.integrator import as_many
from skysim.dynamics.multibody.joints import lock_unused
from skysim.dynamics.multibody.mjcf import compiled, load, mujoco_warnings
from skysim.dynamics.multibody.model import CAMERA, World, mount, place_camera, put_at_origin
from skysim.sources.dome.surface import Surface

BLOCKS, PASSES = 0, 5  # groups of geoms: those that block light, and the camera's own housing
GROUPS = np.array([1, 0, 0, 0, 0, 0], dtype=np.uint8)  # rays are tested against the first only
INWARDS = 1e-6  # an LED is moved off its wall by this fraction of its distance from the bearing


@dataclass(frozen=True, slots=True)
class Obstacles:
    """Everything that can hide a source; the vehicle's attitude can be set.

    model, data   : MuJoCo model and data of their own, not the simulated ones; body bus is set as a mocap body
    camera_body_m : (3,) the pupil, where all rays end
    wall          : the dome's inside; None in star scenes
    """

    model: Any
    data: Any
    camera_body_m: Floats
    wall: Surface | None


def obstacles(world: World, wall: Surface | None) -> Obstacles:
    """Compile the vehicle's file again with separate bodies: the simulated model has all rigid ones fused into bus.

    The camera's housing lets light through: all geoms of the body that carries the camera, if it is not bus, and any
    geom that surrounds the pupil, since the camera then looks out through a hole in it. MuJoCo's rays ignore geoms
    with an alpha of 0.
    """
    path = SCENES / world.vehicle.model
    with mujoco_warnings():
        spec = load(path)
        spec.compiler.fusestatic = False
        bus = put_at_origin(spec, path)
        place_camera(spec, world.vehicle)
        bus.mocap = True  # its pose is set, not simulated
        lock_unused(spec, world.vehicle, path)
        model = compiled(spec, path)
    data = mujoco.MjData(model)
    if world.vehicle.cmgs:
        start_deg = as_many(world.vehicle.cmgs.start_deg, len(world.gimbals), "vehicle.cmgs.start_deg")
        for name, angle_deg in zip(world.gimbals.names, start_deg, strict=True):
            data.joint(name).qpos[:] = np.radians(angle_deg)
    mujoco.mj_kinematics(model, data)
    camera_body_m = mount(world).camera_body_m
    model.geom_group[:] = np.where(housing(model, data, camera_body_m), PASSES, BLOCKS)
    return Obstacles(model, data, camera_body_m, wall)


def housing(model: Any, data: Any, camera_body_m: Floats) -> NDArray[np.bool_]:
    """(ngeom,) which geoms belong to the camera's housing. Overwrites the geoms' groups."""
    body = model.cam_bodyid[model.camera(CAMERA).id]
    own = (model.geom_bodyid == body) & (body != model.body("bus").id)
    six_ways = np.vstack([np.eye(3), -np.eye(3)])
    for geom in np.flatnonzero(~own):
        model.geom_group[:], model.geom_group[geom] = PASSES, BLOCKS
        own[geom] = np.isfinite(clear_m(model, data, camera_body_m, six_ways)).all()
    return np.asarray(own)


def hidden(things: Obstacles, lab_from_body: Rotation, sources: Sources) -> NDArray[np.bool_]:
    """(N,) whether an obstacle is on the line from the pupil to each source, LED or star, at that attitude."""
    turn = quaternion.of(lab_from_body)
    camera_m = quaternion.apply(turn, things.camera_body_m)
    place_m, near = sources.place[:, :3], sources.place[:, 3] > 0
    rays = place_m - sources.place[:, 3:] * camera_m
    far_m = np.linalg.norm(rays, axis=1)
    things.data.mocap_quat[things.model.body("bus").mocapid[0]] = turn
    mujoco.mj_kinematics(things.model, things.data)
    clear = clear_m(things.model, things.data, camera_m, rays / far_m[:, None])
    out = clear < np.where(near, far_m, np.inf)
    if things.wall is not None:
        out[near] |= behind_wall(things.wall, camera_m, place_m[near])
    return np.asarray(out)


def clear_m(model: Any, data: Any, from_m: Floats, rays: Floats) -> Floats:
    """(N,) distance from a point of the lab along unit vectors (N, 3) to the next geom that blocks; inf if none."""
    count = len(rays)
    geom, distance_m = np.empty(count, np.int32), np.empty(count)
    if count:
        along = np.ascontiguousarray(rays).ravel()
        mujoco.mj_multiRay(
            model, data, from_m, along, GROUPS, True, -1, geom, distance_m, None, count, mujoco.mjMAXVAL
        )
    return np.where(distance_m >= 0, distance_m, np.inf)


def behind_wall(wall: Surface, camera_m: Floats, place_m: Floats) -> NDArray[np.bool_]:
    """(N,) whether the line from LEDs at (N, 3) to the camera passes through the dome's wall (not beneath its rim).

    A camera inside sees no LED through the wall, as convex surfaces cannot hide their inside; all surfaces here are
    convex, except for the millimeters of a surveyed one.
    """
    out = np.zeros(len(place_m), dtype=bool)
    if wall.inside(camera_m):
        return out
    for n, here_m in enumerate(place_m * (1 - INWARDS)):
        way = (camera_m - here_m)[None]
        through_m = wall.meet(here_m, way)[0]
        out[n] = np.linalg.norm(through_m - here_m) < np.linalg.norm(way)  # NaN, beneath the rim, is not
    return out
