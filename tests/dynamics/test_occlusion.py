"""Occlusion: boxes against the slab test, walls against a quadratic equation."""

from __future__ import annotations

from pathlib import Path
from types import SimpleNamespace
from typing import Any

import mujoco
import numpy as np
import pytest
from pydantic import TypeAdapter
from scipy.spatial.transform import Rotation

from skysim.core.paths import SCENES
from skysim.core.types import Floats, Sources
from skysim.dynamics import multibody
from skysim.dynamics.multibody.integrator import Simulation
from skysim.scene import loader
from skysim.scene.sections import light
from skysim.simulation.exposure import expected_exposure, render_at_rest
from skysim.simulation.lab import Lab, build_lab
from skysim.simulation.lights.effects import DomeWall, Vehicle, behind_wall
from skysim.simulation.lights.light import Obstacle, find_light
from skysim.sources.dome import surface
from skysim.sources.dome.surface import Surface

SIMSAT = (SCENES / "vehicles" / "simsat.xml").read_text(encoding="utf-8")
QUIET = {
    "exposure": "{time: 10 ms, rate_hz: 2, frames: 1, first: 0 s}",
    "camera.detector.noise": "false",
    "light.layout.spacing": "1.6 in",
}
STARTS = [
    "{roll_deg: 0}",
    "{roll_deg: -15, pitch_deg: 8, yaw_deg: 100}",
    "{pitch_deg: -20, yaw_deg: -170}",
]
# A mast in the camera's view: where it stands in the frame that it is fixed to, how it is turned, and half its sides.
MAST_M = np.array([0.012, -0.004, 0.6])
MAST_TURN = Rotation.from_euler("xyz", [30, 50, 10], True)
MAST_HALF_M = np.array([0.005, 0.03, 0.02])


def words(values: Floats) -> str:
    return " ".join(repr(float(value)) for value in values)


def mast(place_m: Floats) -> str:
    quat = words(MAST_TURN.as_quat(scalar_first=True))
    return f'<geom type="box" pos="{words(place_m)}" quat="{quat}" size="{words(MAST_HALF_M)}" mass="0.1"/>'


def furnished(folder: Path, mjcf: str, **changes: str) -> Lab:
    """The lab of afit_simsat with another vehicle, whose body stands at its start throughout."""
    (folder / "vehicle.xml").write_text(mjcf, encoding="utf-8")
    given = QUIET | {"vehicle.model": str(folder / "vehicle.xml")}
    return build_lab(
        loader.load(
            "afit_simsat", given | {k.replace("__", "."): v for k, v in changes.items()}
        )
    )


def on_bus(geom: str) -> str:
    return SIMSAT.replace(
        '<body name="star_camera_housing"', f'{geom}<body name="star_camera_housing"'
    )


def crosses(begin_m: Floats, end_m: Floats, middle_m: Floats) -> np.ndarray:
    """(N,) whether segments from one point to (N, 3) pass through the mast about its middle: the slab test."""
    start = MAST_TURN.inv().apply(begin_m - middle_m)
    along = MAST_TURN.inv().apply(end_m - begin_m)
    near = (-MAST_HALF_M - start) / along
    far = (MAST_HALF_M - start) / along
    enters = np.minimum(near, far).max(axis=1)
    leaves = np.maximum(near, far).min(axis=1)
    return np.asarray((enters < leaves) & (leaves > 0) & (enters < 1))


def obstacles_of(lab: Lab) -> multibody.Obstacles:
    vehicle = find_light(lab.camera.lights, Vehicle)
    assert vehicle is not None
    return vehicle.obstacles


def picture(lab: Lab) -> tuple[bytes, set[int], Any]:
    frame, truth = render_at_rest(lab.camera, lab.start)
    return frame.image_dn.tobytes(), set(truth.sources.id.tolist()), truth


@pytest.mark.slow
@pytest.mark.parametrize("start", STARTS)
def test_a_mast_on_the_vehicle_hides_exactly_the_leds_behind_it(
    start: str, tmp_path: Path
) -> None:
    lab = furnished(tmp_path, on_bus(mast(MAST_M)), motion__start=start)
    bare = furnished(
        tmp_path, on_bus(mast(MAST_M)), motion__start=start, light__occlusion="false"
    )
    _, seen, truth = picture(lab)
    everything = picture(bare)[1]
    to_body = truth.lab_from_body.inv()
    behind = crosses(
        lab.camera.mount.camera_body_m, to_body.apply(lab.camera.sources.place[:, :3]), MAST_M
    )
    gone = set(lab.camera.sources.id[behind].tolist())
    assert seen == everything - gone
    # Those beyond the border whose blur reaches in are on the frame, but not on the chip.
    assert set(truth.hidden.tolist()) <= gone & everything
    assert len(truth.hidden) >= len(gone & everything) - 3
    assert len(picture(bare)[2].hidden) == 0
    assert len(everything & gone) >= 4
    assert len(seen) >= 10
    np.testing.assert_array_equal(
        multibody.occluded(obstacles_of(lab), truth.lab_from_body, lab.camera.sources.place),
        behind,
    )


@pytest.mark.slow
def test_a_beam_in_the_lab_does_not_rotate_with_the_vehicle(tmp_path: Path) -> None:
    beam = SIMSAT.replace("<worldbody>", f"<worldbody>{mast(MAST_M)}", 1)
    counts = []
    for start in ["{yaw_deg: 0}", "{roll_deg: 3, yaw_deg: 60}", "{roll_deg: 20}"]:
        lab = furnished(tmp_path, beam, motion__start=start)
        lab_from_body = lab.start
        found = multibody.occluded(obstacles_of(lab), lab_from_body, lab.camera.sources.place)
        camera_m = lab_from_body.apply(lab.camera.mount.camera_body_m)
        behind = crosses(camera_m, lab.camera.sources.place[:, :3], MAST_M)
        np.testing.assert_array_equal(found, behind)
        counts.append(int(behind.sum()))
    assert min(counts) >= 4


@pytest.mark.slow
def test_an_unobstructed_frame_is_unchanged_bit_for_bit(tmp_path: Path) -> None:
    """With occlusion on and off; switched off, a mast has no effect."""
    on, off = (
        picture(furnished(tmp_path, SIMSAT, light__occlusion=word))
        for word in ("true", "false")
    )
    assert on[:2] == off[:2]
    masted = {
        word: picture(furnished(tmp_path, on_bus(mast(MAST_M)), light__occlusion=word))
        for word in ("true", "false")
    }
    assert masted["false"][:2] == off[:2]
    assert masted["true"][0] != off[0]
    assert masted["true"][1] < off[1]


def test_occlusion_is_on_by_default() -> None:
    hides = [
        any(
            isinstance(light, Obstacle)
            for light in build_lab(loader.load("afit_simsat", keys)).camera.lights
        )
        for keys in ({}, {"light.occlusion": "false"})
    ]
    assert hides == [True, False]


LENS = '<geom type="cylinder" size="0.022 0.015" pos="0 0 0.065" mass="0.2" rgba="0.05 0.05 0.06 1"/>'


@pytest.mark.slow
def test_the_camera_s_own_housing_does_not_occlude_it(tmp_path: Path) -> None:
    """Neither a cap before the lens on the camera's own body, nor a box on bus that it sits in; a cap on bus does."""
    assert SIMSAT.count(LENS) == 1
    cap = LENS.replace("0.065", "{}")
    own = SIMSAT.replace(LENS, LENS + cap.format("0.12"))
    box = on_bus('<geom type="box" size="0.05 0.05 0.05" pos="0 0 0.37" mass="0.1"/>')
    plain = picture(furnished(tmp_path, SIMSAT, light__occlusion="false"))
    for mjcf in (own, box):
        assert picture(furnished(tmp_path, mjcf))[:2] == plain[:2]
    assert len(plain[1]) >= 10
    # As wide as the whole field, and 4 cm before the pupil.
    assert picture(furnished(tmp_path, on_bus(cap.format("0.43"))))[1] == set()


@pytest.mark.slow
def test_an_invisible_geom_hides_nothing(tmp_path: Path) -> None:
    clear = on_bus(mast(MAST_M).replace("/>", ' rgba="1 1 1 0"/>'))
    assert len(picture(furnished(tmp_path, clear))[1]) == len(
        picture(furnished(tmp_path, SIMSAT))[1]
    )


def test_stars_behind_the_body_are_hidden() -> None:
    """SHEFEX-2 looks out of its payload's cylinder, and its forebody, an ellipsoid behind, hides what it covers.

    A ray u from the origin meets it where the discriminant of |(s u - c) / a|^2 = 1 is not negative, ahead.
    """
    lab = build_lab(loader.load("shefex2"))
    center = np.array([0.0, 0.0, -0.8])
    axes = np.array([0.25, 0.25, 0.6])
    turn = lab.start
    rays = turn.inv().apply(lab.camera.sources.place[:, :3]) / axes
    along = rays @ (center / axes)
    root = along**2 - np.sum(rays**2, axis=1) * (np.sum((center / axes) ** 2) - 1)
    behind = (root >= 0) & (along > 0)
    np.testing.assert_array_equal(
        multibody.occluded(obstacles_of(lab), turn, lab.camera.sources.place), behind
    )
    assert 100 < behind.sum() < len(behind) / 4


def sources_at(place: Any) -> Sources:
    """Sources at (N, 4) homogeneous places; other properties are irrelevant here."""
    place = np.array(place, float)
    count = np.zeros(len(place), np.int64)
    number = np.zeros(len(place))
    return Sources(count, place, np.zeros((len(place), 3)), *[number] * 5, count, number)


def test_a_box_hides_what_is_beyond_its_face_and_within_its_edges() -> None:
    """A box of the lab, whose face of 0.2 m is 1.9 m ahead of the pupil: LEDs by depth, and LEDs and stars by side.

    Stars are farther than any thing, also beyond a meter, but not hidden by what is on the other side of the pupil.
    """
    box = '<geom type="box" size="0.1 0.1 0.1" pos="0.1 0 2.2"/>'
    mjcf = f'<mujoco><worldbody>{box}<body name="bus" mocap="true"/></worldbody></mujoco>'
    model = mujoco.MjModel.from_xml_string(mjcf)
    obstacles: Any = SimpleNamespace(
        model=model, data=mujoco.MjData(model), camera_body_m=np.array([0.1, 0.0, 0.2])
    )
    # Depths beyond the pupil; the box is from 1.9 to 2.1 m.
    led_z_m = 0.2 + np.array([0.5, 1.9 - 1e-6, 1.9 + 1e-6, 3.0, 1e3, -1.9, -3.0])
    leds = [[0.1, 0.0, z, 1.0] for z in led_z_m]
    np.testing.assert_array_equal(
        multibody.occluded(obstacles, Rotation.identity(), sources_at(leds).place),
        [False, False, True, True, True, False, False],
    )
    edge = 0.1 / 1.9  # tangent of the angle to the edge of the face
    for tangent, hidden in ((0.0, True), (edge - 1e-6, True), (edge + 1e-6, False)):
        beside = [[0.1 + 3 * tangent, 0.0, 3.2, 1.0]]
        star = np.array([tangent, 0.0, 1.0]) / np.hypot(tangent, 1)
        stars = [[*star, 0.0], [*-star, 0.0]]
        found = multibody.occluded(
            obstacles, Rotation.identity(), sources_at(beside + stars).place
        )
        np.testing.assert_array_equal(found, [hidden, hidden, False])


def test_occlusion_uses_the_gimbals_initial_angles() -> None:
    """Every geom, by its place, as in the model that is flown."""
    given = loader.load("simsat_cmg", {"vehicle.cmgs.start_deg": "[10, 25, -30, 70]"})
    vehicle = multibody.build(given.vehicle)
    flown = Simulation(vehicle, Rotation.identity(), np.zeros(3), 0.1).data
    things = multibody.Obstacles(vehicle)

    def placed(data: Any) -> Floats:
        pose = np.hstack([data.geom_xpos, np.abs(data.geom_xmat)])
        return pose[np.lexsort(np.round(pose, 9).T)]

    np.testing.assert_allclose(placed(things.data), placed(flown), rtol=0, atol=1e-9)
    level = multibody.Obstacles(multibody.build(loader.load("simsat_cmg").vehicle))
    assert np.abs(placed(things.data) - placed(level.data)).max() > 0.1


def test_without_sources_occlusion_returns_nothing() -> None:
    lab = build_lab(loader.load("afit_simsat"))
    no_sources = lab.camera.sources.take(np.zeros(0, np.int64))
    assert multibody.occluded(
        obstacles_of(lab), Rotation.identity(), no_sources.place
    ).shape == (0,)


# --- the dome's wall ----------------------------------------------------------------------------------------


def made(text: dict[str, Any]) -> Surface:
    return surface.build_surface(TypeAdapter(light.AnySurface).validate_python(text))


def places(inside: Surface, half_deg: float) -> Floats:
    """(500, 3) LEDs all over the cap that the bearing sees."""
    rng = np.random.default_rng(5)
    up = rng.uniform(np.cos(np.radians(half_deg)), 1, 500)
    azimuth = rng.uniform(0, 2 * np.pi, 500)
    out = np.sqrt(1 - up**2)
    return inside.meet(
        np.zeros(3), np.column_stack([out * np.cos(azimuth), out * np.sin(azimuth), up])
    )


BOWL = {"kind": "sphere", "apex": "1.5 m", "radius": "1 m", "rim_height": "0.5 m"}


def test_the_wall_hides_leds_from_a_camera_beside_the_dome_unless_it_looks_beneath_the_rim() -> (
    None
):
    """A half-sphere open at 0.5 m: a sight enters it through the wall or beneath, by the lesser root of a quadratic."""
    inside = made(BOWL)
    center = np.array([0.0, 0.0, 0.5])
    leds = places(inside, 60)
    for camera_m in ([1.3, 0.0, 0.3], [0.4, -1.1, 0.45], [1.05, 0.2, 0.1]):
        way = leds - camera_m
        start = np.array(camera_m) - center
        a = np.sum(way**2, axis=1)
        b = way @ start
        c = start @ start - 1
        entry = (-b - np.sqrt(np.maximum(b**2 - a * c, 0))) / a
        height_m = camera_m[2] + entry * way[:, 2]
        # An LED on the near side is where the sight enters: it shows its back.
        hidden = (height_m > 0.5) & (entry < 1 - 1e-9)
        back = entry >= 1 - 1e-9
        found = behind_wall(inside, np.array(camera_m), leds)
        np.testing.assert_array_equal(found[~back], hidden[~back])
        assert found[back].all()
        assert hidden.sum() > 10
        assert (~found).sum() > 50


def test_the_wall_hides_nothing_from_a_camera_within() -> None:
    inside = made(BOWL)
    assert not behind_wall(inside, np.array([0.2, 0.1, 0.4]), places(inside, 60)).any()


def test_a_panel_hides_its_leds_from_above_as_far_as_it_reaches() -> None:
    """Every LED sits on the panel's underside; from beyond its edge one looks past it, but not through it."""
    panel = made({"kind": "flat", "apex": "1 m", "width": "2 m", "height": "1 m"})
    assert behind_wall(
        panel, np.array([0.1, 0.2, 1.5]), np.array([[0.3, 0.2, 1.0], [-0.9, 0.4, 1.0]])
    ).all()
    assert not behind_wall(
        panel, np.array([0.1, 0.2, 0.5]), np.array([[0.3, 0.2, 1.0]])
    ).any()


@pytest.mark.slow
def test_a_wall_occludes_only_if_its_scene_says_so(tmp_path: Path) -> None:
    """Through `furnish`: a camera beside a narrow drum looks at the wall's outside, and at LEDs beneath its edge."""
    beside = SIMSAT.replace(
        'name="star_camera" pos="0 0 0.081"', 'name="star_camera" pos="0.5 0 0.0"'
    )
    drum = "{kind: cylinder, axis: z, apex: 3 m, radius: 0.4 m, length: 2.4 m}"
    layout = (
        "{kind: listed, cap_deg: 40, positions: [[-0.4 m, 0 m, 0.8 m], [-0.4 m, 0 m, 2.8 m]]}"
    )
    lab = furnished_drum(tmp_path, beside, drum, layout)
    # At the near wall, 1/9 of the way over, the sights are 0.36 m and 0.58 m high; the wall begins at 0.6 m.
    np.testing.assert_array_equal(hidden_by_wall(lab), [False, False])
    # Farther out, at 1 m, half of the way: 0.55 m and 1.55 m.
    far = SIMSAT.replace(
        'name="star_camera" pos="0 0 0.081"', 'name="star_camera" pos="1.2 0 0.0"'
    )
    lab = furnished_drum(tmp_path, far, drum, layout)
    np.testing.assert_array_equal(hidden_by_wall(lab), [False, True])


def hidden_by_wall(lab: Lab) -> np.ndarray:
    """(N,) which LEDs the dome's wall hides from a level camera."""
    exposure = expected_exposure(lab.camera, Rotation.identity(), np.zeros(3), 0.0)
    walls = [
        light.during(exposure).hides
        for light in lab.camera.lights
        if isinstance(light, DomeWall)
    ]
    (wall,) = walls
    assert wall is not None
    return wall.hides(lab.camera.sources.place)


def furnished_drum(folder: Path, mjcf: str, drum: str, layout: str) -> Lab:
    (folder / "vehicle.xml").write_text(mjcf, encoding="utf-8")
    given = {
        "vehicle.model": str(folder / "vehicle.xml"),
        "light.surface": drum,
        "light.layout": layout,
    }
    return build_lab(loader.load("afit_simsat", given))
