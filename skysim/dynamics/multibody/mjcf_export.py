"""Export the laboratory as one MJCF file (`mjcf`), for MuJoCo's viewer, `picture` and `laboratory`.

The elements that are added to the vehicle are for display only: no mass, no contacts, no constraints. Groups of
MuJoCo's viewer: 0 vehicle, floor and pedestal; 1 dome and LEDs or stars; 2 the star camera's field of view; 4, hidden,
the tilt stop.
"""

import ctypes
import re
from collections.abc import Iterator
from contextlib import contextmanager
from itertools import combinations, product
from pathlib import Path
from typing import Any

import mujoco
import numpy as np
from scipy.spatial.transform import Rotation

from skysim.core.errors import InputError
from skysim.core.paths import SCENES
from skysim.core.types import (
    UP,
    Array,
    Floats,
    Ints,
    Mount,
    Sources,
    homogeneous,
    lengths,
    normalized,
)
from skysim.dynamics.multibody.integrator import Simulation
from skysim.dynamics.multibody.mjcf import LAB_CAMERA, MujocoWarnings, compile_spec
from skysim.dynamics.multibody.model import VehicleModel, camera_mount
from skysim.scene.scene import Scene
from skysim.scene.sections.camera import CameraConfig
from skysim.scene.sections.light import RoomConfig
from skysim.sources.dome import surface
from skysim.sources.dome.surface import Ellipsoid, Plane, Surface

GROUP_LIGHTS = 1
GROUP_FIELD = 2
GROUP_HIDDEN = 4
MAX_PX = (1920, 1440)  # width, height of the largest picture
FOVY_DEG = 38.0

SKY_RADIUS_M = 5.0
SKY = Ellipsoid(np.zeros(3), np.full(3, SKY_RADIUS_M))
MAX_STARS = 300
LED_RADIUS_M = 5e-3  # larger than the true disk, which would be less than a pixel
LEVELS = 12  # steps of brightness
DIM = 0.15  # brightness of the darkest LED, relative to the brightest
RIM_M = 0.03
EDGE_M = 0.012  # radius of the bars along the edges of a room
# Number of vertices of the dome's mesh around its axis and down from its top.
SECTORS = 72
RINGS = 24
FLOOR_BELOW_M = 0.95
VEHICLE_BELOW_M = 0.6
LIT_RGB = np.array([1.0, 0.93, 0.78])
FIELD_RGB = np.array([0.25, 0.75, 1.0])


def mjcf(
    vehicle: VehicleModel,
    scene: Scene,
    sources: Sources,
    lab_from_body: Rotation,
    rate_rad_s: Floats,
) -> str:
    """The laboratory as the text of one MJCF file, which MuJoCo's own viewer can open and simulate.

    1. Copy the vehicle's spec, hide the tilt stop, and copy mesh files into it.
    2. Add background and room, and the dome with a view from the side, or a view of the sky.
    3. Add LEDs or stars, the camera's field of view, and the keyframe `start`.
    4. Compile and write.

    The simulated model is not changed.

    Parameters
    ----------
    sources
        LEDs in lab coordinates (m), or stars; the brightest stars are put on a sphere
    lab_from_body, rate_rad_s
        Attitude and (3,) rate in body axes in the keyframe `start`, which also has the scene's speeds and gimbal angles

    Raises
    ------
    InputError
        For a start beyond the tilt stop, and for a vehicle that has a camera named `lab`.
    """
    # 1. Vehicle.
    spec = vehicle.spec.copy()
    mount = camera_mount(vehicle)
    if spec.camera(LAB_CAMERA):
        raise InputError(
            scene.vehicle.model,
            f"camera name {LAB_CAMERA!r} is reserved for the view of the laboratory; rename it",
        )
    on_earth = vehicle.config.mount == "air_bearing"
    dome = scene.dome
    inside = surface.build_surface(dome.surface) if dome else SKY
    hide_tilt_stop(spec)
    inline_meshes(spec, vehicle.model)
    # 2. Surroundings.
    add_backdrop(spec, on_earth)
    if on_earth:
        add_room(spec, dome.room if dome else None)
    if dome:
        rings_m = shell_m(inside, np.radians(dome.points.cap_deg))
        add_dome(spec, rings_m)
        look_at(spec, *dome_view(rings_m))
    else:
        boresight = lab_from_body.apply(mount.body_from_cam.apply(UP))
        look_at(spec, *sky_view(vehicle, boresight))
    # 3. Lights, field of view, keyframe.
    add_lights(spec, sources)
    add_field(spec, mount, field_corners(scene.camera, mount, lab_from_body, inside))
    add_start(spec, Simulation(vehicle, lab_from_body, rate_rad_s, 0.0).data)
    # 4. Text.
    with MujocoWarnings(), full_precision():
        compile_spec(spec, SCENES / scene.vehicle.model)
        return shorten_colors(spec.to_xml())


def add_start(spec: Any, start: Any) -> None:
    """Add MuJoCo's state at the start as the keyframe `start`."""
    spec.add_key(
        name="start", qpos=start.qpos, qvel=start.qvel, act=start.act, ctrl=start.ctrl
    )


def hide_tilt_stop(spec: Any) -> None:
    """Put the tendon of the tilt stop and its ends into the hidden group, since they are not hardware."""
    for element in (*spec.tendons, *spec.sites):
        if element.name.startswith("tilt_stop"):
            element.group = GROUP_HIDDEN


def inline_meshes(spec: Any, model: Any) -> None:
    """Copy the vertices of the vehicle's mesh files into the model, so that it needs no other file.

    A compiled mesh is rotated to its principal axes; mesh_pos and mesh_quat undo this.
    """
    for mesh in spec.meshes:
        if not mesh.file:
            continue
        compiled_mesh = model.mesh(mesh.name or Path(mesh.file).stem)
        vertices_m, faces = mesh_arrays(model, compiled_mesh.id)
        file_from_compiled = Rotation.from_quat(
            model.mesh_quat[compiled_mesh.id], scalar_first=True
        )
        mesh.name = compiled_mesh.name
        mesh.file = ""
        mesh.scale = [1.0, 1.0, 1.0]
        mesh.refpos = [0.0, 0.0, 0.0]
        mesh.refquat = [1.0, 0.0, 0.0, 0.0]
        placed_m = file_from_compiled.apply(vertices_m) + model.mesh_pos[compiled_mesh.id]
        mesh.uservert = placed_m.ravel()
        mesh.userface = faces.ravel()


def mesh_arrays(model: Any, k: int) -> tuple[Floats, Array[np.int32]]:
    """(N, 3) vertices and (M, 3) faces of mesh k of a compiled model."""
    vertices = slice(model.mesh_vertadr[k], model.mesh_vertadr[k] + model.mesh_vertnum[k])
    faces = slice(model.mesh_faceadr[k], model.mesh_faceadr[k] + model.mesh_facenum[k])
    return model.mesh_vert[vertices].astype(float), model.mesh_face[faces].copy()


def add_backdrop(spec: Any, on_earth: bool) -> None:
    """Add a dim room or black space as background, and a lamp."""
    # Colors of the gradient from zenith to nadir.
    top, bottom = (
        ([0.16, 0.19, 0.24], [0.03, 0.035, 0.05])
        if on_earth
        else ([0.0, 0.0, 0.01], [0.0] * 3)
    )
    spec.add_texture(
        name="stage_backdrop",
        type=mujoco.mjtTexture.mjTEXTURE_SKYBOX,
        builtin=mujoco.mjtBuiltin.mjBUILTIN_GRADIENT,
        rgb1=top,
        rgb2=bottom,
        width=256,
        height=1536,
    )
    spec.visual.headlight.ambient = [0.22] * 3
    spec.visual.headlight.diffuse = [0.35] * 3
    spec.visual.headlight.specular = [0.1] * 3
    spec.visual.global_.offwidth, spec.visual.global_.offheight = MAX_PX
    spec.visual.quality.shadowsize = 2048
    spec.worldbody.add_light(
        name="stage_lamp",
        pos=[2.0, -2.5, 0.9],
        dir=[-2.0, 2.5, -1.0],
        diffuse=[0.6] * 3,
        specular=[0.3] * 3,
        castshadow=on_earth,
    )


def add_room(spec: Any, room: RoomConfig | None) -> None:
    """Add a tiled floor, the pedestal whose cup holds the ball of the bearing, and the edges of a known room."""
    spec.add_texture(
        name="stage_tiles",
        type=mujoco.mjtTexture.mjTEXTURE_2D,
        builtin=mujoco.mjtBuiltin.mjBUILTIN_CHECKER,
        rgb1=[0.34, 0.36, 0.40],
        rgb2=[0.46, 0.48, 0.52],
        width=256,
        height=256,
    )
    tiles = spec.add_material(
        name="stage_tiles", texrepeat=[2.0, 2.0], texuniform=True, reflectance=0.08
    )
    tiles.textures[mujoco.mjtTextureRole.mjTEXROLE_RGB] = "stage_tiles"
    bottom = -FLOOR_BELOW_M
    half_m = [6.0, 6.0]
    if room and room.bearing_height_m is not None:
        bottom = -room.bearing_height_m
    if room and (sides_m := [side for side in (room.width_m, room.length_m) if side]):
        # A side that is left out is as long as the other one.
        half_m = [sides_m[0] / 2, sides_m[-1] / 2]
        add_edges(spec, half_m, bottom, bottom + room.height_m if room.height_m else bottom)
    add_visual_geom(
        spec.worldbody,
        "stage_floor",
        mujoco.mjtGeom.mjGEOM_PLANE,
        size=[*half_m, 0.1],
        pos=[0, 0, bottom],
        material="stage_tiles",
    )
    for name, radius, low, high in (
        ("foot", 0.30, bottom, bottom + 0.04),
        ("column", 0.10, bottom, -0.35),
        ("neck", 0.05, -0.35, -0.06),
    ):
        add_visual_geom(
            spec.worldbody,
            f"stage_{name}",
            mujoco.mjtGeom.mjGEOM_CYLINDER,
            size=[radius, 0, 0],
            fromto=[0.0, 0.0, low, 0.0, 0.0, high],
            rgba=[0.36, 0.39, 0.44, 1],
        )


def add_edges(spec: Any, half_m: list[float], bottom_m: float, top_m: float) -> None:
    """Add the edges of a room as bars; without its height those of the floor."""
    corners_m = list(
        product((-half_m[0], half_m[0]), (-half_m[1], half_m[1]), {bottom_m, top_m})
    )
    for n, (a, b) in enumerate(combinations(corners_m, 2)):
        if np.count_nonzero(np.subtract(a, b)) == 1:
            add_visual_geom(
                spec.worldbody,
                f"room_edge_{n}",
                mujoco.mjtGeom.mjGEOM_CAPSULE,
                size=[EDGE_M, 0, 0],
                fromto=[*a, *b],
                rgba=[0.45, 0.50, 0.58, 1],
            )


def add_visual_geom(body: Any, name: str, kind: Any, **more: Any) -> Any:
    """Add and return a geom for display only: no mass, no contact."""
    return body.add_geom(name=name, type=kind, mass=0.0, contype=0, conaffinity=0, **more)


def add_dome(spec: Any, rings_m: Floats) -> None:
    """Add the dome, opaque from inside and transparent from outside, with a rim."""
    add_sheet(spec, "stage_dome", rings_m, [0.16, 0.19, 0.27, 1.0], [0.60, 0.72, 0.90, 0.10])
    # The rim is a short vertical strip below the last ring.
    rim_m = np.stack([rings_m[-1], rings_m[-1] - [0.0, 0.0, RIM_M]])
    add_sheet(spec, "stage_rim", rim_m, [0.45, 0.50, 0.58, 1.0], [0.45, 0.50, 0.58, 0.6])


def shell_m(inside: Surface, cap_rad: float) -> Floats:
    """(RINGS, SECTORS, 3) points of the dome in the lab: rings from its top down, each counterclockwise from above.

    1. A panel ends slightly beyond its LEDs.
    2. Any other surface ends at its rim, or without one at the cap, as the shell does that is built (`RoomConfig`).
       Rays from the bearing are tested in 400 steps of equal angle to there, or to 80 deg from the zenith. Points
       lower than about a third of the surface's height are ignored.
    3. The rings are at equal steps between the first and the last ray in each direction that meets the surface.
    """
    azimuth = np.linspace(0, 2 * np.pi, SECTORS, endpoint=False)
    # 1. Panel: circles about its center, clipped to its edges.
    if isinstance(inside, Plane):
        outer_m = inside.center_m[2] * np.tan(min(cap_rad + 0.1, 1.3))
        radius_m = np.linspace(1e-3, outer_m, RINGS)[:, None, None]
        half_m = np.append(inside.half_m, np.inf)
        around = np.stack([np.cos(azimuth), np.sin(azimuth), np.zeros(SECTORS)], axis=1)
        panel_m = np.clip(radius_m * around, -half_m, half_m)
        return inside.center_m + panel_m @ inside.lab_from_own.as_matrix().T

    def points_at(polar: Floats) -> Floats:
        """(..., 3) points at these polar angles (..., SECTORS)."""
        return inside.from_bearing(surface.directions(polar, azimuth))

    # 2. The first and the last ray in each direction that meets the surface. A wall that begins below the cap has none.
    for lowest_rad in (
        (cap_rad, np.radians(80)) if inside.rim.unbounded else (np.radians(80),)
    ):
        polar = np.linspace(1e-3, lowest_rad, 400)[:, None] * np.ones(SECTORS)
        height_m = np.nan_to_num(points_at(polar)[..., 2], nan=-np.inf)
        on_surface = height_m > 0.35 * height_m.max()
        if on_surface.any(axis=0).all():
            break
    first = on_surface.argmax(axis=0)
    last = 399 - on_surface[::-1].argmax(axis=0)
    # 3. Rings of equal steps between the two.
    fraction = np.linspace(0, 1, RINGS)[:, None]
    return points_at(polar[first, 0] * (1 - fraction) + polar[last, 0] * fraction)


def add_sheet(
    spec: Any, name: str, rings_m: Floats, inside_rgba: list[float], outside_rgba: list[float]
) -> None:
    """Add a surface with a color for each side: two meshes, since OpenGL does not draw the back of a triangle.

    Parameters
    ----------
    spec
        Spec of the file
    name
        Beginning of the names of the meshes
    rings_m
        (K, n, 3) rings, each counterclockwise seen from above, beneath or around the previous one
    inside_rgba, outside_rgba
        Colors of the two sides
    """
    # Two triangles for each quadrilateral a, b, c, d of neighbors on one ring and the next.
    index = np.arange(rings_m.shape[0] * rings_m.shape[1]).reshape(rings_m.shape[:2])
    a = index[:-1].ravel()
    d = index[1:].ravel()
    b = np.roll(index, -1, axis=1)[:-1].ravel()
    c = np.roll(index, -1, axis=1)[1:].ravel()
    inwards = np.concatenate([np.column_stack([a, b, c]), np.column_stack([a, c, d])])
    points_m = rings_m.reshape(-1, 3)
    add_mesh(spec, f"{name}_inside", points_m, inwards, inside_rgba)
    add_mesh(spec, f"{name}_outside", points_m, inwards[:, ::-1], outside_rgba)


def add_mesh(
    spec: Any,
    name: str,
    vertices_m: Floats,
    faces: Ints,
    rgba: Any,
    body: Any = None,
    group: int = GROUP_LIGHTS,
    **more: Any,
) -> None:
    """Add a mesh, open or closed, and its geom on a body, by default in the lab.

    Its inertia is that of a shell, which needs no volume.
    """
    mesh = spec.add_mesh(
        name=name,
        uservert=np.round(vertices_m, 6).ravel(),
        userface=faces.astype(np.int32).ravel(),
    )
    mesh.inertia = mujoco.mjtMeshInertia.mjMESH_INERTIA_SHELL
    kind = mujoco.mjtGeom.mjGEOM_MESH
    more |= {"meshname": name, "rgba": rgba, "group": group}
    add_visual_geom(body or spec.worldbody, name, kind, **more)


def brightest(
    sources: Sources, most_stars: int, most_leds: int | None = None
) -> tuple[bool, Ints, Floats, Floats, Floats]:
    """The brightest lights as they are drawn.

    Returns
    -------
    stars
        Whether they are stars, on a sphere
    rows
        (N,) their rows in the sources, brightest first
    fraction
        (N,) mean strength over a period, relative to the brightest light
    position_m, radius_m
        (N, 3) places in the lab frame, and (N,) sizes: of a star by the square root of its strength
    """
    mean = sources.strength * sources.on_s / sources.period_s
    # A place whose fourth component is 0 is a direction.
    stars = bool((sources.place[:, 3] == 0).any())
    rows = np.argsort(-mean, kind="stable")[: most_stars if stars else most_leds]
    fraction = mean[rows] / mean.max(initial=1e-300)
    position_m = sources.xyz[rows] * (SKY_RADIUS_M if stars else 1.0)
    sizes_m = 0.006 + 0.04 * np.sqrt(fraction) if stars else np.full(len(rows), LED_RADIUS_M)
    return stars, rows, fraction, position_m, sizes_m


def add_lights(spec: Any, sources: Sources) -> None:
    """Add a glowing octahedron for each LED, or for each of the brightest stars.

    The color of an LED shows its mean strength. The size of a star does, by the square root. Markers of similar color
    share one mesh: as many sites would make a step eight times as slow, and a picture take seconds.
    """
    glow = spec.add_material(name="stage_glow", emission=0.8, specular=0.0)
    stars, shown, fraction, position_m, radius_m = brightest(sources, MAX_STARS)
    # One mesh for each step of brightness; all stars have the brightest.
    level = np.full(len(shown), LEVELS) if stars else np.ceil(fraction * LEVELS).astype(int)
    for step in np.unique(level):
        vertices, faces = octahedra(position_m[level == step], radius_m[level == step])
        rgba = [*(LIT_RGB * (DIM + (1 - DIM) * step / LEVELS)), 1.0]
        name = f"stage_{'stars' if stars else 'leds'}_{step}"
        add_mesh(spec, name, vertices, faces, rgba, material=glow.name)


def octahedra(position_m: Floats, radius_m: Floats) -> tuple[Floats, Ints]:
    """(6 N, 3) vertices and (8 N, 3) faces of N octahedra: corners on the axes, a face in every octant."""
    # Corners 0 to 2 are on the positive axes, 3 to 5 on the negative ones.
    corners = np.concatenate([np.eye(3), -np.eye(3)])
    signs = np.array([*product((0, 3), repeat=3)])
    faces = signs + np.arange(3)
    # A mirrored octant reverses the order of the corners; undo that, so that all faces are outwards.
    odd = (signs > 0).sum(axis=1) % 2 == 1
    faces[odd] = faces[odd][:, ::-1]
    vertices = position_m[:, None, :] + radius_m[:, None, None] * corners
    all_faces = 6 * np.arange(len(position_m))[:, None, None] + faces
    return vertices.reshape(-1, 3), all_faces.reshape(-1, 3)


def field_corners(
    camera: CameraConfig, mount: Mount, lab_from_body: Rotation, inside: Surface
) -> Floats:
    """(4, 3) points in body axes at which the rays of the detector's corners meet dome or sky, at a given attitude.

    The camera is taken as a pinhole. A ray that misses a flat panel, or meets it far away, ends at the distance of
    the sky.
    """
    # Corners are half a pixel outside of the outer pixels' centers.
    corners_px = np.array([[0, 0], [1, 0], [1, 1], [0, 1]]) * camera.size_px - 0.5
    xy_px = corners_px - camera.center_px
    rays_cam = homogeneous(xy_px, camera.focal_px)
    lab_from_cam = lab_from_body * mount.body_from_cam
    rays = lab_from_cam.apply(normalized(rays_cam))
    tip_m = lab_from_body.apply(mount.camera_body_m)
    length_m = lengths(inside.meet(tip_m, rays) - tip_m)
    return lab_from_body.inv().apply(tip_m + np.fmin(length_m, SKY_RADIUS_M)[:, None] * rays)


def add_field(spec: Any, mount: Mount, corners_m: Floats) -> None:
    """Add the star camera's field of view as a translucent pyramid on the vehicle, with its edges."""
    bus = spec.body("bus")
    tip = mount.camera_body_m
    # The pyramid has no base, which would block the camera's own view.
    sides = np.array([[0, 1, 2], [0, 2, 3], [0, 3, 4], [0, 4, 1]])
    glow = spec.add_material(name="stage_field", emission=0.6, specular=0.0)
    more = {"material": glow.name, "group": GROUP_FIELD}
    vertices = np.vstack([tip, corners_m])
    add_mesh(spec, "stage_field", vertices, sides, [*FIELD_RGB, 0.4], bus, **more)
    # Edges of the pyramid: a ray to each corner, and the side to the previous corner.
    length_m = lengths(corners_m - tip).min()
    for k, corner in enumerate(corners_m):
        for kind, end in (("ray", tip), ("edge", corners_m[k - 1])):
            add_visual_geom(
                bus,
                f"stage_{kind}_{k}",
                mujoco.mjtGeom.mjGEOM_CAPSULE,
                size=[0.003 * length_m, 0, 0],
                fromto=[*end, *corner],
                rgba=[*FIELD_RGB, 0.9],
                **more,
            )


def dome_view(rings_m: Floats) -> tuple[Floats, Floats, Floats, float]:
    """(eye, target, up, size) in m of a view from the side, which shows the inside under the dome's rim.

    At the eye's distance dome and vehicle fill a picture of 4:3; the near side of the rim is the widest part.
    """
    wide = np.hypot(*rings_m[-1, :, :2].T).max()
    top = rings_m[..., 2].max()
    # Half of the height from the vehicle's lowest point to the top.
    size = (top + VEHICLE_BELOW_M) / 2
    tangent = np.tan(np.radians(FOVY_DEG / 2))
    distance = max(1.25 * size / tangent, wide * (1.05 / (4 / 3 * tangent) + 0.35))
    middle = np.array([0.0, 0.0, top - size])
    # From the azimuth -62 deg and 8 deg above.
    toward_eye = Rotation.from_euler("ZY", [-62.0, -8.0], degrees=True).apply([1.0, 0.0, 0.0])
    return middle + distance * toward_eye, middle, UP, 0.55 * distance


def sky_view(
    vehicle: VehicleModel, boresight: Floats
) -> tuple[Floats, Floats, Floats, float]:
    """As `dome_view`, from beside and behind the vehicle, with the boresight along the picture's diagonal."""
    size = float(vehicle.model.stat.extent) / 2 + SKY_RADIUS_M / 2
    back = surface.perpendicular(boresight[None])[0] - 0.5 * boresight
    up = Rotation.from_rotvec(np.radians(-40.0) * normalized(back)).apply(boresight)
    return size * (2.0 * back + 0.5 * boresight), 0.5 * size * boresight, up, 1.2 * size


def look_at(spec: Any, eye_m: Floats, middle_m: Floats, up: Floats, size_m: float) -> None:
    """Add the camera `lab` and set the initial view of MuJoCo's viewer."""
    # MuJoCo's cameras look along -z, y is up.
    back = normalized(eye_m - middle_m)
    right = normalized(np.cross(up, back))
    lab_from_view = Rotation.from_matrix(
        np.column_stack([right, np.cross(back, right), back])
    )
    spec.worldbody.add_camera(
        name=LAB_CAMERA,
        pos=eye_m,
        quat=lab_from_view.as_quat(scalar_first=True),
        fovy=FOVY_DEG,
    )
    # The viewer's free camera starts at the same view.
    spec.stat.center = middle_m
    spec.stat.extent = size_m
    spec.visual.map.znear = 0.01
    spec.visual.map.zfar = 50.0
    spec.visual.global_.azimuth = float(np.degrees(np.arctan2(-back[1], -back[0])))
    spec.visual.global_.elevation = float(-np.degrees(np.arcsin(back[2])))


@contextmanager
def full_precision() -> Iterator[None]:
    """Make MuJoCo write MJCF with fifteen digits; its usual six would shift a balanced vehicle's center of mass.

    MuJoCo's switch for this is private; a version that lacks it writes six digits.
    """
    library = ctypes.CDLL(mujoco._functions.__file__)
    switch = getattr(library, "_mjPRIVATE__set_xml_precision", lambda digits: None)
    switch(15)
    try:
        yield
    finally:
        switch(6)


def shorten_colors(text: str) -> str:
    """The text with four digits in colors: in single precision, fifteen digits make 0.1 into 0.100000001490116."""
    return re.sub(
        r'(rgba|rgb1|rgb2)="([^"]*)"',
        lambda m: f'{m[1]}="{" ".join(f"{float(x):.4g}" for x in m[2].split())}"',
        text,
    )
