"""The exported MJCF laboratory moves like the stepped model, has the scene's geometry, and can be drawn."""

from __future__ import annotations

import os
from pathlib import Path

import cv2
import mujoco
import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from skysim.camera.optics import Optics
from skysim.core.errors import InputError
from skysim.core.types import Sources
from skysim.dynamics import guidance, multibody
from skysim.dynamics.multibody import mjcf_export, scene_picture
from skysim.dynamics.multibody.integrator import Simulation
from skysim.dynamics.multibody.mjcf import MujocoWarnings
from skysim.scene.loader import list_scenes, load
from skysim.scene.scene import Scene
from skysim.simulation.flight import open_flight
from skysim.sources import catalog, dome
from skysim.sources import stars as star_sources
from skysim.sources.dome import surface
from skysim.sources.photometry import Band
from tests.test_every_scene import FEWER

EVERYTHING = {
    "vehicle.wheels": "{coulomb: 2 mN m, viscous: 1e-5 N m s, static_imbalance: 1e-5 kg m,"
    " dynamic_imbalance: 1e-6 kg m2, start_rpm: [500, -300, 1200]}",
    "vehicle.cmgs": "{start_deg: [10, 20, -30, 40], rotor_torque_limit: 0.1 N m}",
    "vehicle.fans": "{}",
    "vehicle.drag": "{viscous: 0.01 N m s, quadratic: 0.02 N m s2}",
    "vehicle.disturbances": "{cable: {stiffness: 0.1 N m/rad}}",
    "motion.rate_deg_s": "[1.0, -2.0, 5.0]",
}
STARTS = {  # 3-2-1 Euler angles; the second falls into the tilt stop within the second
    "free": ([20.0, 5.0, -8.0], "[1.0, -2.0, 5.0]"),
    "against the stop": ([0.0, 0.0, 29.5], "[20.0, 0.0, 5.0]"),
}
LEVEL = Rotation.identity()


def dome_lab(
    overrides: dict[str, str] | None = None,
) -> tuple[Scene, multibody.VehicleModel, Sources]:
    scene = load("afit_simsat", overrides or {})
    assert scene.light.kind == "dome"
    band = Band.from_efficiency(scene.camera.detector.quantum_efficiency)
    return scene, multibody.build(scene.vehicle), dome.sources(scene.light, band)


def mjcf(
    vehicle: multibody.VehicleModel, scene: Scene, sources: Sources, lab_from_body: Rotation
) -> str:
    """The export of a scene without profiles."""
    rate_rad_s = guidance.body_rate_rad_s(scene, lab_from_body, ())
    return mjcf_export.mjcf(vehicle, scene, sources, lab_from_body, rate_rad_s)


def star_lab() -> tuple[Scene, multibody.VehicleModel, Sources, Rotation]:
    scene = load("shefex2")
    assert scene.light.kind == "stars"
    band = Band.from_efficiency(scene.camera.detector.quantum_efficiency)
    stars = catalog.read(scene.light.catalog)
    sources = star_sources.sources(
        stars, scene.start_time, scene.light.limit_mag, Rotation.identity(), band
    )
    lab_from_body = star_sources.cam_from_icrs(83.0, 2.0, 20.0).inv()
    return scene, multibody.build(scene.vehicle), sources, lab_from_body


def loaded(text: str) -> tuple[mujoco.MjModel, mujoco.MjData]:
    """The exported model in its keyframe `start`."""
    model = mujoco.MjModel.from_xml_string(text)
    data = mujoco.MjData(model)
    mujoco.mj_resetDataKeyframe(model, data, model.key("start").id)
    mujoco.mj_forward(model, data)
    return model, data


def vertices_m(model: mujoco.MjModel, data: mujoco.MjData, prefix: str) -> np.ndarray:
    """(N, 3) in the lab: the vertices of every mesh whose name begins so."""
    found = []
    for k in range(model.ngeom):
        if model.geom(k).name.startswith(prefix) and model.geom_dataid[k] >= 0:
            mesh = model.mesh(model.geom_dataid[k])
            own = model.mesh_vert[mesh.vertadr[0] : mesh.vertadr[0] + mesh.vertnum[0]]
            found.append(own @ data.geom_xmat[k].reshape(3, 3).T + data.geom_xpos[k])
    return np.concatenate(found)


# The model


@pytest.mark.slow
@pytest.mark.parametrize("start", STARTS)
def test_the_exported_laboratory_flies_like_the_stepped_model(start: str) -> None:
    angles_deg, rate = STARTS[start]
    scene, vehicle, sources = dome_lab(EVERYTHING | {"motion.rate_deg_s": rate})
    lab_from_body = Rotation.from_euler("ZYX", angles_deg, degrees=True)
    model, data = loaded(mjcf(vehicle, scene, sources, lab_from_body))
    flight = Simulation(vehicle, lab_from_body, np.radians(scene.motion.rate_deg_s), 1.0)
    np.testing.assert_allclose(data.qpos, flight.angles_rad, rtol=0, atol=1e-14)
    np.testing.assert_allclose(data.qvel, flight.speeds_rad_s, rtol=1e-14, atol=1e-14)
    control = 0.2 * np.sin(np.arange(model.nu))
    flight.advance(np.tile(control, (1000, 1)))
    data.ctrl = control
    with MujocoWarnings() as warned:
        mujoco.mj_step(model, data, 1000)
    assert not warned
    assert not any(warning.number for warning in data.warning)
    moved = np.abs(flight.angles_rad - flight.states[0, 1 : 1 + model.nq])
    assert moved.min() > 1e-3  # every joint has been asked
    np.testing.assert_allclose(data.qpos, flight.angles_rad, rtol=1e-9, atol=1e-9)
    np.testing.assert_allclose(data.qvel, flight.speeds_rad_s, rtol=1e-8, atol=1e-8)


@pytest.mark.slow
@pytest.mark.parametrize("name", list_scenes())
def test_the_keyframe_of_every_shipped_scene_is_the_start_of_its_flight(name: str) -> None:
    flight = open_flight(load(name, FEWER.get(name, {})))
    lab = flight.lab
    _, data = loaded(lab.export_mjcf())
    simulation = flight.motion.simulation
    lab_from_body = Rotation.from_quat(data.body("bus").xquat, scalar_first=True)
    assert (lab_from_body.inv() * lab.start).magnitude() < 1e-9
    if isinstance(simulation, Simulation) and not lab.scene.motion.is_prescribed:
        np.testing.assert_allclose(data.qvel, simulation.speeds_rad_s, rtol=1e-14, atol=1e-14)
    if lab.scene.motion.start == "profile":
        state_at = lab.reference.state_at
        begin, end = (
            Rotation.from_quat(state_at(t_s)[0], scalar_first=True) for t_s in (0.0, 1e-4)
        )
        rate_rad_s = (begin.inv() * end).as_rotvec() / 1e-4
        np.testing.assert_allclose(data.qvel[:3], rate_rad_s, rtol=1e-3, atol=1e-5)


def test_the_second_initial_attitude_reaches_the_tilt_stop() -> None:
    """The flight above compares the tendon's limit only if that is felt."""
    angles_deg, rate = STARTS["against the stop"]
    scene, vehicle, _ = dome_lab(EVERYTHING | {"motion.rate_deg_s": rate})
    start = Rotation.from_euler("ZYX", angles_deg, degrees=True)
    flight = Simulation(vehicle, start, np.radians(scene.motion.rate_deg_s), 1.0)
    flight.advance(np.zeros((1000, vehicle.model.nu)))
    up = Rotation.from_quat(flight.states[:, 1:5], scalar_first=True).as_matrix()[:, 2, 2]
    assert 30.0 < np.degrees(np.arccos(up.min())) < 30.5


def test_a_free_vehicle_flies_like_the_stepped_model_under_the_stars() -> None:
    scene, vehicle, sources, lab_from_body = star_lab()
    model, data = loaded(mjcf(vehicle, scene, sources, lab_from_body))
    flight = Simulation(vehicle, lab_from_body, np.radians(scene.motion.rate_deg_s), 1.0)
    flight.advance(np.full((1000, 3), 0.3))
    data.ctrl = 0.3
    mujoco.mj_step(model, data, 1000)
    np.testing.assert_allclose(data.qpos, flight.angles_rad, rtol=0, atol=1e-9)
    assert not [k for k in range(model.ngeom) if "floor" in model.geom(k).name]


def test_export_adds_no_mass_and_does_not_change_the_stepped_model() -> None:
    scene, vehicle, sources = dome_lab(EVERYTHING)
    before = vehicle.spec.to_xml()
    geoms = vehicle.model.ngeom
    model, _ = loaded(mjcf(vehicle, scene, sources, LEVEL))
    assert vehicle.spec.to_xml() == before
    assert vehicle.model.ngeom == geoms < model.ngeom
    np.testing.assert_allclose(model.body_mass, vehicle.model.body_mass, rtol=1e-14)
    np.testing.assert_allclose(model.body_inertia, vehicle.model.body_inertia, rtol=1e-14)
    added = [k for k in range(model.ngeom) if model.geom(k).name.startswith("stage_")]
    assert not model.geom_contype[added].any()
    assert not model.geom_conaffinity[added].any()


@pytest.mark.slow
def test_an_exported_vehicle_contains_its_mesh_files(tmp_path: Path) -> None:
    """The tetrahedron is off its origin, turned, scaled and mirrored; it stays where it was, without its file."""
    points = np.array([[0.1, 0.2, 0.0], [0.6, 0.2, 0.1], [0.1, 0.5, 0.0], [0.2, 0.2, 0.7]])
    faces = "f 1 3 2\nf 1 2 4\nf 1 4 3\nf 2 3 4\n"
    lines = "".join("v {:g} {:g} {:g}\n".format(*point) for point in points)
    (tmp_path / "tetra.obj").write_text(lines + faces)
    (tmp_path / "v.xml").write_text(
        """<mujoco><asset><mesh name="tetra" file="tetra.obj" scale="0.5 -0.5 0.5" refpos="0.01 0 0"/></asset>
        <worldbody><body name="bus"><geom name="hull" type="mesh" mesh="tetra" mass="80"
        pos="0 0.1 0" euler="10 20 30"/>
        <camera name="star_camera" quat="0 1 0 0"/></body></worldbody></mujoco>"""
    )
    scene, vehicle, sources = dome_lab(
        {
            "vehicle.model": str(tmp_path / "v.xml"),
            "vehicle.center_of_mass": "[0 m, 0 m, 0 m]",
        }
    )
    text = mjcf(vehicle, scene, sources, LEVEL)
    assert "tetra.obj" not in text
    own = mujoco.MjData(vehicle.model)
    mujoco.mj_forward(vehicle.model, own)
    here = vertices_m(*loaded(text), "hull")
    np.testing.assert_allclose(
        here, vertices_m(vehicle.model, own, "hull"), rtol=0, atol=1e-6
    )


@pytest.mark.slow
def test_a_vehicle_that_has_its_own_camera_lab_is_refused(tmp_path: Path) -> None:
    (tmp_path / "v.xml").write_text(
        """<mujoco><worldbody><camera name="lab"/><body name="bus"><geom size="0.1" mass="80"/>
        <camera name="star_camera" quat="0 1 0 0"/></body></worldbody></mujoco>"""
    )
    scene, vehicle, sources = dome_lab(
        {
            "vehicle.model": str(tmp_path / "v.xml"),
            "vehicle.center_of_mass": "[0 m, 0 m, 0 m]",
        }
    )
    with pytest.raises(InputError, match="lab") as refused:
        mjcf(vehicle, scene, sources, LEVEL)
    assert "\n" not in str(refused.value)


# Where things stand


@pytest.mark.slow
def test_exported_dome_and_leds_have_the_scene_s_positions() -> None:
    scene, vehicle, sources = dome_lab()
    model, data = loaded(mjcf(vehicle, scene, sources, LEVEL))
    inside = surface.build_surface(scene.light.surface)
    shell = vertices_m(model, data, "stage_dome_")
    on_it = np.sum(((shell - inside.center_m) / inside.semi_axes_m) ** 2, axis=1)
    np.testing.assert_allclose(on_it, 1.0, rtol=0, atol=1e-5)
    assert shell[:, 2].max() == pytest.approx(48 * 0.0254, abs=1e-5)
    grains = vertices_m(model, data, "stage_leds_")
    led_m = grains.reshape(-1, 6, 3).mean(axis=1)
    assert len(led_m) == len(sources)
    offset = np.linalg.norm(led_m[:, None, :] - sources.place[None, :, :3], axis=2)
    assert offset.min(axis=1).max() < 2e-6
    assert sorted(offset.argmin(axis=1)) == list(range(len(sources)))


def test_a_flat_panel_is_a_disk_at_its_height_that_covers_its_leds() -> None:
    flat = {"light.surface": "{kind: flat, apex: 1.2 m}", "light.layout.cap_deg": "20"}
    scene, vehicle, sources = dome_lab(flat)
    shell = vertices_m(*loaded(mjcf(vehicle, scene, sources, LEVEL)), "stage_dome_")
    np.testing.assert_allclose(shell[:, 2], 1.2, rtol=0, atol=1e-6)
    assert np.hypot(*shell[:, :2].T).max() > np.hypot(*sources.place[:, :2].T).max()


def test_a_dome_for_a_room_ends_at_its_cap_and_stands_in_the_room() -> None:
    """The floor is as deep as the bearing is high; the bars are the twelve edges of a box of the room's size."""
    room = "{width: 4 m, length: 5 m, height: 2.9 m, bearing_height: 1.1 m}"
    sphere = "{kind: sphere, apex: 1.2 m, radius: 1.2 m}"
    changes = {"light.surface": sphere, "light.layout.cap_deg": "25", "light.room": room}
    scene, vehicle, sources = dome_lab(changes)
    model, data = loaded(mjcf(vehicle, scene, sources, LEVEL))
    shell = vertices_m(model, data, "stage_dome_")
    tilt_rad = np.arctan2(np.hypot(shell[:, 0], shell[:, 1]), shell[:, 2])
    assert np.degrees(tilt_rad.max()) == pytest.approx(25, abs=1e-3)
    assert data.geom("stage_floor").xpos[2] == pytest.approx(-1.1)
    bars = [n for n in range(model.ngeom) if model.geom(n).name.startswith("room_edge")]
    assert len(bars) == 12
    length_m = 2 * model.geom_size[bars, 1]
    assert sorted(length_m.round(9)) == pytest.approx([2.9] * 4 + [4.0] * 4 + [5.0] * 4)
    assert np.ptp(data.geom_xpos[bars], axis=0) == pytest.approx([4.0, 5.0, 2.9])


def test_the_dome_s_sheets_face_inwards_and_outwards() -> None:
    """OpenGL draws a triangle whose corners go against the clock's hands as seen by the eye."""
    scene, vehicle, sources = dome_lab()
    model, data = loaded(mjcf(vehicle, scene, sources, LEVEL))
    middle = surface.build_surface(scene.light.surface).center_m
    for name, sign in (("inside", -1), ("outside", 1)):
        mesh = model.mesh(f"stage_dome_{name}")
        faces = model.mesh_face[mesh.faceadr[0] : mesh.faceadr[0] + mesh.facenum[0]]
        corner = vertices_m(model, data, f"stage_dome_{name}")[faces]
        normal = np.cross(corner[:, 1] - corner[:, 0], corner[:, 2] - corner[:, 0])
        assert (sign * np.sum(normal * (corner.mean(axis=1) - middle), axis=1) > 0).all()


def test_the_field_s_corners_are_the_chip_s_projected_onto_the_dome() -> None:
    scene, vehicle, sources = dome_lab()
    lab_from_body = Rotation.from_euler("ZYX", [30.0, 8.0, -5.0], degrees=True)
    model, data = loaded(mjcf(vehicle, scene, sources, lab_from_body))
    here = multibody.camera_mount(vehicle)
    corner = vertices_m(model, data, "stage_field")
    tip_m = lab_from_body.apply(here.camera_body_m)
    corner = corner[np.linalg.norm(corner - tip_m, axis=1) > 0.1]
    inside = surface.build_surface(scene.light.surface)
    on_it = np.sum(((corner - inside.center_m) / inside.semi_axes_m) ** 2, axis=1)
    np.testing.assert_allclose(on_it, 1.0, rtol=0, atol=1e-5)
    cam_from_lab = here.cam_from_body * lab_from_body.inv()
    seen_px = Optics.from_camera(scene.camera).project(cam_from_lab.apply(corner - tip_m))
    wide = scene.camera.width_px - 0.5
    high = scene.camera.height_px - 0.5
    wanted = {(-0.5, -0.5), (wide, -0.5), (wide, high), (-0.5, high)}
    # Vertices are rounded to a micrometer, in front of a camera of 9,131 px at 0.84 m.
    assert {tuple(np.round(2 * one) / 2) for one in seen_px} == wanted


def test_the_brightest_stars_are_on_a_sphere_in_their_true_directions() -> None:
    scene, vehicle, sources, lab_from_body = star_lab()
    grains = vertices_m(*loaded(mjcf(vehicle, scene, sources, lab_from_body)), "stage_stars_")
    star_m = grains.reshape(-1, 6, 3).mean(axis=1)
    assert len(star_m) == mjcf_export.MAX_STARS
    np.testing.assert_allclose(
        np.linalg.norm(star_m, axis=1), mjcf_export.SKY_RADIUS_M, rtol=1e-5
    )
    brightest = sources.place[np.argsort(-sources.strength)[: mjcf_export.MAX_STARS], :3]
    apart = 1 - star_m / mjcf_export.SKY_RADIUS_M @ brightest.T
    assert apart.min(axis=0).max() < 1e-5
    assert apart.min(axis=1).max() < 1e-5


SURFACES = {
    "afit's": {},
    "a great sphere": {"light.surface": "{kind: sphere, apex: 2 m, radius: 3 m}"},
    "a low sphere": {"light.surface": "{kind: sphere, apex: 0.9 m, radius: 0.8 m}"},
    "a panel": {"light.surface": "{kind: flat, apex: 1.2 m}", "light.layout.cap_deg": "20"},
}


@pytest.mark.slow
@pytest.mark.parametrize("surface", SURFACES)
def test_the_lab_camera_sees_the_whole_dome_and_vehicle(surface: str) -> None:
    scene, vehicle, sources = dome_lab(SURFACES[surface])
    model, data = loaded(mjcf(vehicle, scene, sources, LEVEL))
    hardware = data.geom_xpos[model.body_rootid[model.geom_bodyid] == model.body("bus").id]
    deck_m = [[0.45 * np.cos(a), 0.45 * np.sin(a), -0.2] for a in np.arange(12) * np.pi / 6]
    parts = [
        vertices_m(model, data, name)
        for name in ("stage_dome", "stage_rim", "stage_leds", "stage_field")
    ]
    seen = seen_px(model, data, np.concatenate([*parts, hardware, deck_m]))
    assert seen.min() >= 0
    assert (seen < SIZE_PX).all()
    assert np.ptp(seen, axis=0).max() > 0.5 * SIZE_PX[1]


def test_the_viewer_starts_where_the_lab_s_camera_looks() -> None:
    """MuJoCo's free camera looks along (cos el cos az, cos el sin az, sin el), its own cameras along -z."""
    scene, vehicle, sources = dome_lab()
    star_scene, star_vehicle, stars, lab_from_body = star_lab()
    for text in (
        mjcf(vehicle, scene, sources, LEVEL),
        mjcf(star_vehicle, star_scene, stars, lab_from_body),
    ):
        model, data = loaded(text)
        azimuth, elevation = np.radians(
            [model.vis.global_.azimuth, model.vis.global_.elevation]
        )
        ring = np.cos(elevation)
        forward = [ring * np.cos(azimuth), ring * np.sin(azimuth), np.sin(elevation)]
        camera = data.camera("lab")
        np.testing.assert_allclose(
            forward, -camera.xmat.reshape(3, 3)[:, 2], rtol=0, atol=1e-6
        )
        sight = model.stat.center - camera.xpos
        np.testing.assert_allclose(sight / np.linalg.norm(sight), forward, rtol=0, atol=1e-6)


def test_the_edges_of_the_camera_s_field_are_thin_capsules_along_it() -> None:
    """Each ray from the camera to a corner, and each edge between corners: under a hundredth of its length thick."""
    scene, vehicle, sources = dome_lab()
    model, data = loaded(mjcf(vehicle, scene, sources, LEVEL))
    tip_m = multibody.camera_mount(vehicle).camera_body_m
    corner_m = vertices_m(model, data, "stage_field")
    corner_m = corner_m[np.linalg.norm(corner_m - tip_m, axis=1) > 0.1]
    ends = [
        (data.geom(f"stage_ray_{k}"), model.geom(f"stage_ray_{k}").size) for k in range(4)
    ]
    for ray, (radius, half_m, _) in ends:
        middle = ray.xpos
        along = ray.xmat.reshape(3, 3)[:, 2]
        reached = np.array([middle + half_m * along, middle - half_m * along])
        assert np.linalg.norm(reached - tip_m, axis=1).min() < 1e-6
        corners_off_m = np.linalg.norm(reached[:, None] - corner_m, axis=2)
        assert corners_off_m.min() < 1e-5  # vertices are rounded to a micrometer
        assert 0 < radius < 0.01 * half_m


# Pictures

SIZE_PX = (640, 480)
Drawn = tuple[
    Sources, multibody.VehicleModel, mujoco.MjModel, mujoco.MjData, np.ndarray, np.ndarray
]
TILTED = Rotation.from_euler("ZYX", [0.0, 0.0, 20.0], degrees=True)
NOTHING = "<mujoco><worldbody><camera name='lab'/></worldbody></mujoco>"


def states(*attitudes: Rotation) -> np.ndarray:
    return np.array([one.as_quat(scalar_first=True) for one in attitudes])


@pytest.fixture(scope="module")
def opengl() -> None:
    """Skip with the reason if not even an empty room can be drawn."""
    try:
        scene_picture.picture(NOTHING, np.zeros(0), (64, 48))
    except scene_picture.NoPicture as reason:
        pytest.skip(str(reason))


@pytest.fixture(scope="module")
def drawn(opengl: None) -> Drawn:
    """The dome with its LEDs, the vehicle level and tilted; and the same without LEDs."""
    scene, vehicle, sources = dome_lab()
    text = mjcf(vehicle, scene, sources, LEVEL)
    dark = mjcf(vehicle, scene, sources.take(np.zeros(len(sources), bool)), LEVEL)
    lit = np.array(list(scene_picture.film(text, states(LEVEL, TILTED), SIZE_PX)), float)
    return (
        sources,
        vehicle,
        *loaded(text),
        lit,
        scene_picture.picture(dark, states(LEVEL), SIZE_PX).astype(float),
    )


def seen_px(model: mujoco.MjModel, data: mujoco.MjData, place_m: np.ndarray) -> np.ndarray:
    """(N, 2) whole pixels (x, y) of points in the lab, by MuJoCo's manual: its camera looks along -z, y is up."""
    camera = data.camera("lab")
    own = (np.atleast_2d(place_m) - camera.xpos) @ camera.xmat.reshape(3, 3)
    focal_px = SIZE_PX[1] / 2 / np.tan(np.radians(model.camera("lab").fovy[0]) / 2)
    tangent = own[:, :2] / -own[:, 2:]
    middle = (np.array(SIZE_PX) - 1) / 2
    return np.round(middle + focal_px * tangent * [1, -1]).astype(int)


@pytest.mark.long
def test_the_leds_glow_where_they_are_projected_and_nowhere_else(drawn: Drawn) -> None:
    sources, _, model, data, lit, dark = drawn
    x, y = seen_px(model, data, sources.place[:, :3]).T
    gained = (lit[0] - dark).sum(axis=2)
    near = np.zeros(gained.shape, np.uint8)
    near[y, x] = 1
    # A grain is 1.1 px in radius, its edge is smoothed over one more, and the place is rounded.
    assert np.abs(gained[cv2.dilate(near, np.ones((7, 7))) == 0]).max() <= 3
    brightest = cv2.dilate(gained, np.ones((3, 3)))[y, x]
    assert (brightest > 60).mean() > 0.95
    assert np.median(brightest) > 200


@pytest.mark.long
def test_the_field_of_the_camera_is_seen_and_tilts_with_the_vehicle(drawn: Drawn) -> None:
    """Half-way up, level and tilted by 20 degrees, the pyramid is 0.15 m from where it was, itself 0.08 m wide."""
    _, vehicle, model, data, lit, _ = drawn
    here = multibody.camera_mount(vehicle)
    half_body_m = here.camera_body_m + here.cam_from_body.inv().apply([0.0, 0.0, 0.45])
    places = [seen_px(model, data, one.apply(half_body_m))[0] for one in (LEVEL, TILTED)]
    blue = lit[..., 2] - lit[..., 0]
    there = np.array([[frame[y, x] for x, y in places] for frame in blue])
    assert there.diagonal().min() > 60
    assert max(there[0, 1], there[1, 0]) < 40


@pytest.mark.slow
def test_the_picture_changes_where_the_vehicle_tilts(drawn: Drawn) -> None:
    _, _, model, data, lit, _ = drawn
    moved = np.abs(lit[1] - lit[0]).sum(axis=2) > 30
    y, _ = np.nonzero(moved)
    rim_px = seen_px(model, data, vertices_m(model, data, "stage_rim"))[:, 1]
    assert 0.02 < moved.mean() < 0.3
    assert (
        y > rim_px.min()
    ).mean() > 0.6  # beneath the dome, the rest is the camera's field in it


@pytest.mark.long
def test_stars_are_drawn_around_a_free_vehicle(opengl: None) -> None:
    """The room is black: whatever is white and small is a star, and half of the sphere or less is in the field."""
    scene, vehicle, sources, lab_from_body = star_lab()
    text = mjcf(vehicle, scene, sources, lab_from_body)
    drawn = scene_picture.picture(text, states(lab_from_body), SIZE_PX)
    count, _, boxes, _ = cv2.connectedComponentsWithStats(
        (drawn.min(axis=2) > 90).astype(np.uint8)
    )
    small = boxes[1:, cv2.CC_STAT_AREA] < 100
    assert 20 < small.sum() < mjcf_export.MAX_STARS
    assert count - 1 - small.sum() >= 1  # the vehicle


@pytest.mark.long
@pytest.mark.parametrize("opengl_name", ["disable", "nonsense"])
def test_without_opengl_one_line_names_the_remedy(
    opengl_name: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("MUJOCO_GL", opengl_name)
    with pytest.raises(scene_picture.NoPicture, match="apt-get install libegl1") as refused:
        scene_picture.picture(NOTHING, np.zeros(0), (64, 48))
    assert "\n" not in str(refused.value)
    assert "MUJOCO_GL=osmesa" in str(refused.value)


def test_a_driver_that_crashes_the_renderer_is_named(tmp_path: Path) -> None:
    with (tmp_path / "stderr").open("w+b") as complaints:
        assert "SIGSEGV" in scene_picture.failure_reason(-11, complaints)
        complaints.write(b"warning\nImportError: no libEGL\n")
        assert scene_picture.failure_reason(1, complaints) == "ImportError: no libEGL"


# Films

RED_TO_GREEN = [np.full((48, 64, 3), (250 - 20 * k, 20 * k, 0), np.uint8) for k in range(10)]


@pytest.mark.parametrize("suffix", scene_picture.ANIMATED)
def test_a_film_keeps_its_colors_and_duration(suffix: str, tmp_path: Path) -> None:
    path = tmp_path / f"film{suffix}"
    scene_picture.write_film(iter(RED_TO_GREEN), path, fps=10.0)
    assert os.listdir(tmp_path) == [path.name]
    done, film = cv2.imreadanimation(str(path))
    assert done
    assert list(film.durations) == [100] * 10
    back = np.array(
        [cv2.cvtColor(one[:, :, :3], cv2.COLOR_BGR2RGB) for one in film.frames], float
    )
    # A GIF has few colors, WebP halves the resolution of color: 16 of 255 is a step of the former.
    np.testing.assert_allclose(back, RED_TO_GREEN, rtol=0, atol=20)


@pytest.mark.long
def test_a_film_of_ten_seconds_fits_into_a_page(drawn: Drawn, tmp_path: Path) -> None:
    """One hundred frames of the lab at the film's size, the vehicle in two poses by turns."""
    lit = [
        cv2.resize(one.astype(np.uint8), scene_picture.FILM_PX, interpolation=cv2.INTER_AREA)
        for one in drawn[4]
    ]
    scene_picture.write_film(
        (lit[k % 2] for k in range(100)), tmp_path / "film.gif", fps=10.0
    )
    assert (tmp_path / "film.gif").stat().st_size < 2.5e6


def test_a_film_that_cannot_be_written_is_reported(tmp_path: Path) -> None:
    with pytest.raises(OSError, match="nowhere"):
        scene_picture.write_film(RED_TO_GREEN, tmp_path / "nowhere" / "film.gif", fps=10.0)
    with pytest.raises(
        InputError,
        match=r"film\.avi: unknown animation format '\.avi'; allowed: \.gif, \.webp",
    ):
        scene_picture.write_film(RED_TO_GREEN, tmp_path / "film.avi", fps=10.0)
    assert not list(tmp_path.iterdir())


@pytest.mark.parametrize("on_earth", [True, False])
def test_the_backdrop_is_dim_and_space_is_black(on_earth: bool) -> None:
    spec = mujoco.MjSpec()
    mjcf_export.add_backdrop(spec, on_earth)
    colors = np.array([spec.textures[0].rgb1, spec.textures[0].rgb2])
    assert colors.min() >= 0
    assert colors.max() < (0.25 if on_earth else 0.02)


def test_all_colors_are_within_zero_and_one() -> None:
    scene, vehicle, sources = dome_lab()
    model, _ = loaded(mjcf(vehicle, scene, sources, LEVEL))
    for colors in (model.geom_rgba, model.mat_rgba, model.site_rgba):
        assert len(colors)
        assert colors.min() >= 0
        assert colors.max() <= 1


def test_the_tilt_stop_is_hidden_and_no_hardware_is() -> None:
    scene, vehicle, sources = dome_lab()
    model, _ = loaded(mjcf(vehicle, scene, sources, LEVEL))
    tendons = [(model.tendon(k).name, model.tendon_group[k]) for k in range(model.ntendon)]
    sites = [(model.site(k).name, model.site_group[k]) for k in range(model.nsite)]
    for named in (tendons, sites):
        stop = [
            group == mjcf_export.GROUP_HIDDEN
            for name, group in named
            if name.startswith("tilt_stop")
        ]
        assert stop
        assert all(stop)
        assert not any(
            group == mjcf_export.GROUP_HIDDEN
            for name, group in named
            if not name.startswith("tilt_stop")
        )


# The shapes for other drawing programs


def test_the_shapes_of_a_laboratory_are_the_file_s_without_its_lights() -> None:
    scene, vehicle, sources = dome_lab()
    lab_from_body = Rotation.from_euler("ZYX", (30.0, -5.0, 10.0), degrees=True)
    text = mjcf(vehicle, scene, sources, lab_from_body)
    lab = multibody.Laboratory(text)
    (model, data) = loaded(text)
    by_name = {shape.name: shape for shape in lab.shapes}
    assert {"stage_floor", "stage_column", "stage_rim_inside", "stage_field"} < set(by_name)
    assert not [name for name in by_name if name.startswith(("stage_leds", "stage_stars"))]
    dome = by_name["stage_dome_inside"]
    turn = Rotation.from_quat(dome.parent_from_shape_wxyz, scalar_first=True)
    inside = surface.build_surface(scene.light.surface)
    on_it = turn.apply(dome.vertices_m) + dome.position_m
    np.testing.assert_allclose(
        np.sum(((on_it - inside.center_m) / inside.semi_axes_m) ** 2, axis=1),
        1.0,
        rtol=0,
        atol=1e-5,
    )
    assert dome.faces.max() == len(dome.vertices_m) - 1
    # Shapes of the vehicle turn with it: the file's start has them where its attitude takes those of body axes.
    for name in ("ball", "upper_deck", "stage_ray_0"):
        shape = by_name[name]
        geom = model.geom(name).id
        assert shape.on_vehicle
        np.testing.assert_allclose(
            lab_from_body.apply(shape.position_m), data.geom_xpos[geom], rtol=0, atol=1e-9
        )
    assert not dome.on_vehicle
    np.testing.assert_array_equal(lab.eye_m, model.camera("lab").pos)
