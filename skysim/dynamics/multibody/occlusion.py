"""What stands between the camera and a light: the vehicle's own parts and the lab's, by MuJoCo's rays; the dome's wall.

A light is a point here and so is the pupil: a source is seen or it is not, at the pose of mid-exposure. Wheels and
gimbals stand as they do at the start.
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

BLOCKS, PASSES = 0, 5  # groups of geoms: those that are in the way of light, and the camera's own housing
GROUPS = np.array([1, 0, 0, 0, 0, 0], dtype=np.uint8)  # of which rays heed the first alone
INWARDS = 1e-6  # share of its distance from the bearing by which an LED is taken off the wall that it sits on


@dataclass(frozen=True, slots=True)
class Obstacles:
    """All that can hide a light, with the vehicle free to be turned.

    model, data   : of MuJoCo, not those that are flown: body bus is moved by hand
    camera_body_m : (3,) the pupil, where all rays end
    wall          : the dome's inside; None under the stars
    """

    model: Any
    data: Any
    camera_body_m: Floats
    wall: Surface | None


def obstacles(world: World, wall: Surface | None) -> Obstacles:
    """The vehicle's file once more, each body by itself: the flown model has all rigid ones fused into bus.

    The camera's housing lets light through: all geoms of the body that carries the camera, if it is not bus, and any
    geom that stands all around the pupil, for then the camera looks out through a hole in it. A geom whose alpha is 0
    is none for MuJoCo's rays.
    """
    path = SCENES / world.vehicle.model
    with mujoco_warnings():
        spec = load(path)
        spec.compiler.fusestatic = False
        bus = put_at_origin(spec, path)
        place_camera(spec, world.vehicle)
        bus.mocap = True  # a body that stands where it is put
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
    """(ngeom,) which geoms the camera sits in, the vehicle level. The groups are left in disorder."""
    body = model.cam_bodyid[model.camera(CAMERA).id]
    own = (model.geom_bodyid == body) & (body != model.body("bus").id)
    six_ways = np.vstack([np.eye(3), -np.eye(3)])
    for geom in np.flatnonzero(~own):
        model.geom_group[:], model.geom_group[geom] = PASSES, BLOCKS
        own[geom] = np.isfinite(clear_m(model, data, camera_body_m, six_ways)).all()
    return np.asarray(own)


def hidden(things: Obstacles, lab_from_body: Rotation, sources: Sources) -> NDArray[np.bool_]:
    """(N,) whether something stands on the line from the pupil to each source, LED or star, at that attitude."""
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
    """(N,) how far one sees from a point of the lab along unit vectors (N, 3): to the next geom that blocks, or inf."""
    count = len(rays)
    geom, distance_m = np.empty(count, np.int32), np.empty(count)
    if count:
        along = np.ascontiguousarray(rays).ravel()
        mujoco.mj_multiRay(
            model, data, from_m, along, GROUPS, True, -1, geom, distance_m, None, count, mujoco.mjMAXVAL
        )
    return np.where(distance_m >= 0, distance_m, np.inf)


def behind_wall(wall: Surface, camera_m: Floats, place_m: Floats) -> NDArray[np.bool_]:
    """(N,) whether the way from LEDs at (N, 3) to the camera leaves the dome through its wall, not beneath its rim.

    From inside nothing is behind a wall that is convex, and all our surfaces are, but for a survey's millimetres.
    """
    out = np.zeros(len(place_m), dtype=bool)
    if wall.inside(camera_m):
        return out
    for n, here_m in enumerate(place_m * (1 - INWARDS)):
        way = (camera_m - here_m)[None]
        through_m = wall.meet(here_m, way)[0]
        out[n] = np.linalg.norm(through_m - here_m) < np.linalg.norm(way)  # NaN, beneath the rim, is not
    return out
