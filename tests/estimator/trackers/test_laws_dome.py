"""Laws of lights at a finite distance: surfaces, exact and thesis's solves, identification, the home catalog."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as some
from hypothesis.extra.numpy import arrays
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from estimator.attitude import dome_map, nearfield, rotation_fit
from estimator.attitude.dome_map import LedMap, Lever
from estimator.attitude.nearfield import SOLVERS
from estimator.calibration import home_position
from estimator.calibration.home_position import Sighting
from estimator.catalog import pair_index
from estimator.core.camera import Camera
from estimator.core.checks import Floats
from estimator.core.errors import ImageError
from estimator.core.types import Centroids
from estimator.core.vectors import normalized
from estimator.identification import led_detections, led_index, led_search
from estimator.trackers import dome_tracker
from estimator.trackers.dome_tracker import DomeTracker
from tests.helpers.laws import (
    ANY,
    NUMBERS,
    SEEDS,
    answered,
    assert_covariance,
    law,
    turn,
    units,
)

pytestmark = [pytest.mark.slow, pytest.mark.filterwarnings("ignore::RuntimeWarning")]
CAMERA = Camera(640, 480, 900.0, (319.5, 239.5))
SPHERE = LedMap(np.arange(0), np.empty((0, 3)), np.zeros(3), np.full(3, 1.2))
OVAL = LedMap(
    np.arange(0), np.empty((0, 3)), np.array([0, 0, 0.4]), np.array([1.0, 1.0, 0.8])
)
RAYS = arrays("f8", (5, 3), elements=ANY)
UP = np.array([[0.1, -0.2, 1.0], [0.0, 0.0, 1.0], [-0.1, 0.1, 1.0]])


def lever(rng: np.random.Generator) -> Lever:
    """A random lever of up to 0.35 m, nearly upward, with the camera nearly aligned to the body."""
    along = np.array([0.0, 0.0, rng.uniform(0.1, 0.35)]) + rng.normal(0, 0.01, 3)
    return Lever(along, turn(rng, 0.05))


@law(dome_map.common_shifts_m, dome_map.common_images_px)
@given(rng=SEEDS)
def test_common_errors_move_all_lights_and_the_lens(rng: np.random.Generator) -> None:
    """A light's shift from the pupil is that of its place less that of the pupil; the lens has the changed numbers."""
    place_m = rng.normal([0, 0, 1.2], 0.1, (6, 3))
    common_m = 1e-3 * rng.standard_normal((2, 6, 3))
    change = rng.standard_normal((2, 11)) * [*[1e-3] * 3, 2.0, 1.0, 1.0, *[1e-3] * 5]
    leds = replace(SPHERE, position_m=place_m, common_m=common_m, common_camera=change)
    arm = lever(rng)
    body_from_lab = turn(rng)
    star = rng.permutation(6)[:4]
    cam_from_lab = arm.cam_from_body * body_from_lab
    shifts_m = dome_map.common_shifts_m(leds, star, arm, cam_from_lab)
    images_px = dome_map.common_images_px(leds, CAMERA, UP)
    for n in range(2):
        in_body = body_from_lab.apply(place_m + common_m[n]) - arm.camera_body_m
        moved = arm.cam_from_body.apply(in_body - change[n, :3])
        still = arm.cam_from_body.apply(body_from_lab.apply(place_m) - arm.camera_body_m)
        np.testing.assert_allclose(shifts_m[n], (moved - still)[star], rtol=0, atol=1e-12)
        focal_px, x, y = [900.0, 319.5, 239.5] + change[n, 3:6]
        lens = Camera(640, 480, focal_px, (x, y), tuple(change[n, 6:]))
        np.testing.assert_allclose(images_px[n], lens.pixels(UP), rtol=0, atol=1e-9)


def seen_through(
    rng: np.random.Generator, surface: LedMap, arm: Lever, body_from_lab: Rotation, count: int
) -> tuple[LedMap, Floats]:
    """Lights where rays through random pixels meet a surface, and those rays."""
    rays = CAMERA.rays(rng.uniform(0, [639, 479], (count, 2)))
    lab_from_body = body_from_lab.inv()
    origin = lab_from_body.apply(arm.camera_body_m)
    places = dome_map.on_surface(
        lab_from_body.apply(arm.cam_from_body.inv().apply(rays)), origin, surface
    )
    return replace(surface, id=np.arange(count), position_m=places), rays


def even(count: int) -> LedMap:
    """Lights over the sphere's upper part on a golden spiral with nonrepeating perturbations."""
    rng = np.random.default_rng(count)
    z = 1 - (np.arange(count) + 0.5) / count * 0.4
    azimuth = np.arange(count) * np.pi * (3 - np.sqrt(5))
    across = np.sqrt(1 - z**2)
    along = np.column_stack(
        [across * np.cos(azimuth), across * np.sin(azimuth), z]
    ) + rng.normal(0, 0.01, (count, 3))
    return replace(
        SPHERE,
        id=np.arange(count),
        position_m=1.2 * along / np.linalg.norm(along, axis=1, keepdims=True),
    )


# Lists of LEDs


@law(dome_map.LedMap.from_csv)
@given(
    rng=SEEDS,
    count=some.integers(1, 9),
    unit=some.sampled_from(sorted(dome_map.UNIT_M)),
    names=some.booleans(),
    text=some.text("0123456789.,xyz_mid \n#-e", max_size=60),
)
def test_a_list_of_leds_is_read_in_its_unit_and_any_other_text_refused(
    rng: np.random.Generator,
    count: int,
    unit: str,
    names: bool,
    text: str,
    tmp_path_factory: pytest.TempPathFactory,
) -> None:
    path = tmp_path_factory.mktemp("list") / "leds.csv"
    place_m = units(rng, count)
    rows = (place_m / dome_map.UNIT_M[unit]).tolist()
    head = [f"{axis}_{unit}" if names else axis for axis in "xyz"]
    path.write_text("\n".join(",".join(map(str, row)) for row in [head, *rows]))
    read = LedMap.from_csv(path, None if names else unit)
    np.testing.assert_allclose(read.position_m, place_m, rtol=1e-12)
    assert read.id.tolist() == list(range(count))
    path.write_text(text)
    other = answered(lambda: LedMap.from_csv(path, "m"), ImageError)
    assert other is None or np.isfinite(other.position_m).all()


# Surfaces


@law(dome_map.on_sphere, dome_map.on_surface, dome_map.project, dome_map.check_lever)
@given(
    rng=SEEDS,
    radius_m=some.floats(0.1, 3),
    place_m=arrays("f8", 3, elements=some.floats(-2, 2)),
)
def test_rays_intersect_the_surface_ahead_of_the_camera(
    rng: np.random.Generator, radius_m: float, place_m: Floats
) -> None:
    rays = units(rng, 9)
    met = answered(lambda: dome_map.on_sphere(rays, place_m, radius_m))
    assert (met is not None) == (np.linalg.norm(place_m) < radius_m)
    ball = replace(SPHERE, semi_axes_m=np.full(3, radius_m))
    same = dome_map.on_surface(rays, place_m, ball)
    np.testing.assert_allclose(same if met is None else met, same, rtol=0, atol=1e-6)
    arm = lever(rng)
    body_from_lab = turn(rng)
    leds, seen = seen_through(rng, OVAL, arm, body_from_lab, 9)
    on_it = np.sum(((leds.position_m - OVAL.center_m) / OVAL.semi_axes_m) ** 2, axis=1)
    np.testing.assert_allclose(on_it, 1, rtol=0, atol=1e-9)
    pixels = dome_map.project(body_from_lab, leds.position_m, arm, CAMERA)
    np.testing.assert_allclose(CAMERA.rays(pixels), seen, rtol=0, atol=1e-9)
    far = answered(
        lambda: dome_map.check_lever(leds, Lever(place_m, Rotation.identity())) or True,
        ImageError,
    )
    assert bool(far) == (
        np.linalg.norm(place_m) < np.linalg.norm(leds.position_m, axis=1).min()
    )


# Solves


@law(
    rotation_fit.rotation_only,
    rotation_fit.in_body_axes,
    nearfield.tappe,
    nearfield.ray_on_surface,
    nearfield.pnp,
)
@given(
    rng=SEEDS,
    count=some.integers(6, 20),
    off_rad=some.floats(0, 0.05),
    name=some.sampled_from(["rotation_only", "tappe", "ray_on_surface", "pnp"]),
)
def test_exact_solves_find_the_truth(
    rng: np.random.Generator, count: int, off_rad: float, name: str
) -> None:
    arm = lever(rng)
    truth = turn(rng, 0.4)
    leds, rays = seen_through(rng, OVAL, arm, truth, count)
    start = turn(rng, off_rad) * truth
    found, covariance = SOLVERS[name](
        rays, np.full(count, 1e-4), leds.position_m, leds, arm, start
    )
    assert (found * truth.inv()).magnitude() < 1e-6
    assert_covariance(covariance)
    # Back to camera axes
    R = arm.cam_from_body.as_matrix()
    back = R @ rotation_fit.in_body_axes(covariance, arm) @ R.T
    np.testing.assert_allclose(back, covariance, rtol=0, atol=1e-9 * np.abs(covariance).max())


@law(rotation_fit.fit_focal_ratio)
@given(
    rng=SEEDS,
    count=some.integers(4, 20),
    ratio=some.floats(0.85, 1.15),
    sigma=some.floats(1e-5, 1e-2),
)
def test_a_focal_length_is_fitted_with_the_attitude(
    rng: np.random.Generator, count: int, ratio: float, sigma: float
) -> None:
    """Exact rays give the exact attitude from a start 2 deg off for any assumed error."""
    arm = lever(rng)
    truth = turn(rng, 0.4)
    leds, rays = seen_through(rng, OVAL, arm, truth, count)
    seen = CAMERA.zoomed(1 / ratio).rays(CAMERA.pixels(rays))
    start = turn(rng, 0.035) * truth
    found = rotation_fit.fit_focal_ratio(
        seen, np.full(count, sigma), leds.position_m, arm, start
    )
    assert found == pytest.approx(ratio, abs=1e-9)


@law(nearfield.fitted_sigma_rad)
@given(rng=SEEDS, name=some.sampled_from(sorted(SOLVERS)))
def test_the_error_of_a_fitted_parameter_is_that_of_a_shifted_pixel(
    rng: np.random.Generator, name: str
) -> None:
    """By differences: of a pixel shifted along x and along y, the turn of its ray and the change of its tangents."""
    pixel = rng.uniform([0, 0], [640, 480], (9, 2))
    step = 1e-3
    moved = np.array(
        [CAMERA.rays(pixel + step * axis) - CAMERA.rays(pixel) for axis in np.eye(2)]
    )
    turned_rad = np.sqrt(np.sum(moved**2, axis=(0, 2)) / 2)
    expected = np.full(9, step / 900) if name in ("rotation_only", "pnp") else turned_rad
    found = nearfield.fitted_sigma_rad(name, CAMERA.rays(pixel), np.full(9, step / 900))
    np.testing.assert_allclose(found, expected, rtol=1e-5, atol=0)


@law(nearfield.infinity, nearfield.thesis, nearfield.thesis_points)
@given(rng=SEEDS, name=some.sampled_from(["infinity", "thesis"]))
def test_the_thesis_s_methods_are_near_the_truth(rng: np.random.Generator, name: str) -> None:
    """Within a few degrees with few lights in view; each point is R - M from the camera (eqs 43, 44)."""
    arm = lever(rng)
    truth = turn(rng, 0.4)
    leds, rays = seen_through(rng, SPHERE, arm, truth, 12)
    found, covariance = SOLVERS[name](
        rays, np.full(12, 1e-4), leds.position_m, leds, arm, truth
    )
    assert (found * truth.inv()).magnitude() < np.radians(6)
    assert_covariance(covariance)
    points, reach_m = nearfield.thesis_points(rays, leds, arm)
    np.testing.assert_allclose(np.linalg.norm(points, axis=1), reach_m, rtol=1e-12)
    across = reach_m * rays[:, :2] / rays[:, 2:]
    np.testing.assert_allclose(points[:, :2], across, rtol=0, atol=1e-12)


@law(*SOLVERS.values(), nearfield.thesis_points)
@given(
    rng=SEEDS,
    rays=RAYS,
    sigma=arrays("f8", 5, elements=ANY),
    place=RAYS,
    name=some.sampled_from(sorted(SOLVERS)),
)
def test_any_rays_are_solved_or_refused(
    rng: np.random.Generator, rays: Floats, sigma: Floats, place: Floats, name: str
) -> None:
    arm = lever(rng)
    solution = answered(
        lambda: SOLVERS[name](rays, sigma, place, SPHERE, arm, Rotation.identity())
    )
    assert solution is None or solution[1].shape == (3, 3)
    answered(lambda: nearfield.thesis_points(rays, SPHERE, arm))


# Identification


@pytest.fixture(scope="module")
def eye() -> DomeTracker:
    return DomeTracker(
        CAMERA, even(150), Lever(np.array([0.01, 0.0, 0.3]), Rotation.identity())
    )


@law(
    DomeTracker.solve_centroids,
    led_search.identify,
    led_detections.build_detections,
    dome_tracker.led_pairs,
)
@given(rng=SEEDS, false=some.integers(0, 4))
def test_lights_are_named_correctly_or_not_at_all(
    eye: DomeTracker, rng: np.random.Generator, false: int
) -> None:
    truth = turn(rng, 0.3)
    px = np.nan_to_num(
        dome_map.project(truth, eye.leds.position_m, eye.lever, CAMERA), nan=-1e9
    )
    star = np.flatnonzero(CAMERA.contains(px, 3))
    xy = np.concatenate(
        [
            px[star] + rng.normal(0, 0.1, (len(star), 2)),
            rng.uniform(0, [639, 479], (false, 2)),
        ]
    )
    star = np.concatenate([star, np.full(false, -1)])
    solution = eye.solve_centroids(
        Centroids(xy, np.full(len(xy), 0.1), np.linspace(2, 1, len(xy)))
    )
    truth_cam = eye.lever.cam_from_body * truth
    assert not solution.solved or (solution.cam_from_ref * truth_cam.inv()).magnitude() < 0.01
    assert (
        not solution.solved
        or (star[solution.match.observed] >= 0).sum() >= len(solution.match.observed) - false
    )
    rays = CAMERA.rays(xy)
    sigma = np.full(len(xy), 1e-4)
    dome = led_index.build_dome_index(eye.leds, eye.lever, CAMERA)
    lights = led_detections.build_detections(rays, sigma, dome)
    np.testing.assert_allclose(np.linalg.norm(lights.direction, axis=1), 1, rtol=0, atol=1e-9)
    for match in (led_search.identify(rays, sigma, dome), eye.identify(rays, sigma, None)):
        named = [] if isinstance(match, str) else match.observed.tolist()
        assert len(set(named)) == len(named)


@law(DomeTracker.solve_centroids, DomeTracker.solve, dome_tracker.star_identifier, slow=True)
@given(
    xy_px=arrays("f8", (8, 2), elements=ANY),
    sigma=arrays("f8", 8, elements=ANY),
    noise=SEEDS,
    name=some.sampled_from(["pyramid", "saa"]),
)
def test_no_lights_of_noise_have_an_attitude_under_a_dome(
    eye: DomeTracker, xy_px: NDArray, sigma: NDArray, noise: np.random.Generator, name: str
) -> None:
    found = answered(
        lambda: eye.solve_centroids(Centroids(xy_px, sigma, np.ones(8))), ImageError
    )
    assert found is None or not found.solved
    assert not eye.solve(noise.normal(100, 5, (480, 640))).attitude.solved
    answered(lambda: eye.solve(xy_px), ImageError)
    identify = dome_tracker.star_identifier(name, CAMERA, eye.leds, eye.lever, eye.settings)
    assert isinstance(
        answered(lambda: identify(CAMERA.rays(xy_px), sigma, None)) or "refused", str
    )


@law(dome_tracker.non_dimensional)
@given(rng=SEEDS, ratio=some.floats(0.9, 1.1), false=some.integers(0, 3))
def test_leds_are_named_correctly_at_any_focal_length_or_not_at_all(
    eye: DomeTracker, rng: np.random.Generator, ratio: float, false: int
) -> None:
    truth = turn(rng, 0.3)
    settings = replace(eye.settings, identifier="non_dimensional")
    px = np.nan_to_num(
        dome_map.project(truth, eye.leds.position_m, eye.lever, CAMERA), nan=-1e9
    )
    star = np.flatnonzero(CAMERA.contains(px, 3))
    xy = np.concatenate(
        [
            px[star] + rng.normal(0, 0.1, (len(star), 2)),
            rng.uniform(0, [639, 479], (false, 2)),
        ]
    )
    star = np.concatenate([star, np.full(false, -1)])
    camera = CAMERA.zoomed(1 / ratio)
    identify = dome_tracker.non_dimensional(camera, eye.leds, eye.lever, settings)
    match = identify(camera.rays(xy), np.full(len(xy), 1e-4), None)
    named = (
        np.zeros((0, 2), int)
        if isinstance(match, str)
        else np.column_stack([star[match.observed], match.star])
    )
    assert all(seen in (led, -1) for seen, led in named)
    solved = DomeTracker(camera, eye.leds, eye.lever, settings).solve_centroids(
        Centroids(xy, np.full(len(xy), 0.1), np.linspace(2, 1, len(xy)))
    )
    truth_cam = eye.lever.cam_from_body * truth
    assert not solved.solved or (solved.cam_from_ref * truth_cam.inv()).magnitude() < 0.01
    assert not solved.solved or abs(solved.camera.focal_px / CAMERA.focal_px - 1) < 0.01


@law(DomeTracker.warm_up, slow=True)
@given(noise=SEEDS)
def test_a_warm_up_changes_no_answer_under_a_dome(
    eye: DomeTracker, noise: np.random.Generator
) -> None:
    frame = noise.normal(100, 5, (480, 640))
    before = eye.solve(frame).attitude.status
    eye.warm_up()
    assert eye.solve(frame).attitude.status == before


@law(led_index.build_dome_index, led_index.near_leds, led_index.scale_pair_angles)
@given(rng=SEEDS, count=some.integers(20, 60))
def test_a_dome_index_covers_the_whole_dome(rng: np.random.Generator, count: int) -> None:
    leds = even(count)
    dome = led_index.build_dome_index(leds, lever(rng), CAMERA)
    near, chord = led_index.near_leds(leds.position_m / 1.2, 0.5)
    assert near.shape == chord.shape == (0, led_index.PART)
    np.testing.assert_allclose(np.sort(dome.radius_m), 1.2, rtol=1e-12, atol=0)
    assert (np.diff(dome.pairs.angle_rad) >= 0).all()
    known = pair_index.build(units(rng, count), 1.0)
    scaled = led_index.scale_pair_angles(known, np.full(count, 1.5))
    np.testing.assert_allclose(scaled.angle_rad, 1.5 * known.angle_rad, rtol=1e-12, atol=0)


@law(Camera.corners_px, led_index.inner_field, led_index.cap_height)
@given(rng=SEEDS, factor=some.floats(0.3, 5), margin_rad=some.floats(0, 3))
def test_the_inner_field_is_smaller_than_the_field(
    rng: np.random.Generator, factor: float, margin_rad: float
) -> None:
    seen = CAMERA.zoomed(factor)
    corners = seen.rays(seen.corners_px)
    (left, right, top, bottom), half = led_index.inner_field(corners)
    assert 0 < right - left < 2 * half[0]
    assert 0 < bottom - top < 2 * half[1]
    directions = units(rng, 5)
    assert (
        0
        <= led_index.cap_height(directions, 0.0)
        <= led_index.cap_height(directions, margin_rad)
        <= 2
    )


# The claimed error


@pytest.mark.parametrize(
    ("led_mm", "lever_mm", "noise_px"), [(0.5, 0.0, 0.5), (0.0, 1.0, 0.5), (0.4, 0.5, 0.2)]
)
def test_the_mean_of_many_frames_has_the_claimed_systematic_error(
    led_mm: float, lever_mm: float, noise_px: float
) -> None:
    """A survey drawn once: over K frames of one attitude the mean error has covariance S + (P - S) / K."""
    frames = 6
    nees = []
    single = []
    arm = Lever(np.array([0.01, 0.0, 0.3]), Rotation.identity())
    body_from_lab = Rotation.from_rotvec([0.1, -0.1, 0.5])
    dome = even(300)
    px = np.nan_to_num(
        dome_map.project(body_from_lab, dome.position_m, arm, CAMERA), nan=-1e9
    )
    px = px[CAMERA.contains(px, 3)]
    settings = replace(dome_tracker.SETTINGS, centroid_sigma_px=1e-6)
    for survey in range(60):
        rng = np.random.default_rng([led_mm > 0, lever_mm > 0, survey])
        position_m = dome.position_m + rng.normal(0, led_mm / 1e3, (len(dome.id), 3))
        camera_m = arm.camera_body_m + rng.normal(0, lever_mm / 1e3, 3)
        leds = replace(dome, position_m=position_m, sigma_m=led_mm / 1e3)
        tracker = DomeTracker(
            CAMERA,
            leds,
            replace(arm, camera_body_m=camera_m, sigma_m=lever_mm / 1e3),
            settings,
        )
        noise = np.full(len(px), noise_px)
        flux = np.linspace(2, 1, len(px))
        draws_px = px + rng.normal(0, noise_px, (frames, *px.shape))
        found = [
            tracker.solve_centroids(Centroids(one_px, noise, flux)) for one_px in draws_px
        ]
        assert all(one.solved for one in found)
        errors = np.array(
            [(one.cam_from_ref * body_from_lab.inv()).as_rotvec() for one in found]
        )
        total = found[0].covariance_rad2
        common = found[0].systematic_rad2
        mean = errors.mean(axis=0)
        nees.append(mean @ np.linalg.solve(common + (total - common) / frames, mean))
        single.append(errors[0] @ np.linalg.solve(total, errors[0]))
    spread = 4 * np.sqrt(6 / 60)
    assert np.mean(nees) == pytest.approx(3, abs=spread)
    assert np.mean(single) == pytest.approx(3, abs=spread)


# The thesis's catalog


@law(home_position.pooled, home_position.instrument_brightness)
@given(rng=SEEDS, shift=some.floats(-100, 100), scale=some.floats(0.1, 10))
def test_a_spread_scales_with_its_data_and_ignores_shifts(
    rng: np.random.Generator, shift: float, scale: float
) -> None:
    value = rng.normal(size=40)
    group = np.arange(40) % 5
    one = home_position.pooled(value, group)
    other = home_position.pooled(scale * value + shift, group)
    np.testing.assert_allclose(other, scale * one, rtol=1e-6, atol=0)
    by_numpy = [np.std(value[group == g], ddof=1) for g in range(5)]
    np.testing.assert_allclose(one, by_numpy, rtol=1e-9, atol=0)
    light = home_position.instrument_brightness(np.abs(value), 1.0 + group)
    np.testing.assert_allclose(
        home_position.instrument_brightness(np.abs(value), scale * (1.0 + group)),
        light,
        rtol=1e-9,
    )


@law(home_position.body_positions, home_position.separation_rad)
@given(rng=SEEDS)
def test_positions_of_lights_are_those_of_equations_43_to_45(
    rng: np.random.Generator,
) -> None:
    """A camera level at height M below a sphere of radius R: across (R - M) tan a, and (R - M) in all."""
    surface = LedMap(np.arange(1), np.array([[0.0, 0.0, 1.2]]), np.zeros(3), np.full(3, 1.2))
    arm = Lever(np.array([0.0, 0.0, 0.3]), Rotation.identity())
    xy_px = rng.uniform(100, 400, (5, 2))
    tangent = (xy_px - CAMERA.center_px) / CAMERA.focal_px
    found = home_position.body_positions(xy_px, CAMERA, surface, arm) - [0, 0, 0.3]
    np.testing.assert_allclose(found[:, :2], 0.9 * tangent, rtol=0, atol=1e-12)
    np.testing.assert_allclose(np.linalg.norm(found, axis=1), 0.9, rtol=1e-12, atol=0)
    first, second = normalized(rng.standard_normal((2, 3)))
    angle = home_position.separation_rad(first, second)
    assert np.cos(angle) == pytest.approx(first @ second, abs=1e-12)


@law(home_position.calibrate, home_position.led_map)
@given(
    rng=SEEDS,
    frames=some.integers(2, 6),
)
def test_a_home_catalog_holds_exactly_the_lights_shown(
    rng: np.random.Generator, frames: int
) -> None:
    arm = Lever(np.array([0, 0, 0.3]), Rotation.identity())
    leds, _ = seen_through(rng, SPHERE, arm, Rotation.identity(), 8)
    px = dome_map.project(Rotation.identity(), leds.position_m, arm, CAMERA)
    light = rng.uniform(10, 99, 8)
    shown = [
        Sighting(
            0,
            Rotation.identity(),
            leds.id,
            px + rng.normal(0, 0.2, px.shape),
            light + rng.normal(0, 1, 8),
        )
        for _ in range(frames)
    ]
    home = home_position.calibrate(shown, CAMERA, SPHERE, arm)
    assert sorted(home.id) == sorted(leds.id)
    assert (np.diff(home.brightness) <= 0).all()
    assert (home.samples == frames).all()
    for covariance in home.covariance_m2:
        assert_covariance(covariance)
    assert 0 < home.epsilon_pos_m < 0.012
    on = home_position.led_map(home, SPHERE)
    np.testing.assert_allclose(np.linalg.norm(on.position_m, axis=1), 1.2, rtol=1e-9, atol=0)
    np.testing.assert_allclose(np.cross(on.position_m, home.vectors), 0, rtol=0, atol=1e-9)


@law(home_position.calibrate)
@given(
    led=NUMBERS,
    xy=NUMBERS | arrays("f8", (2, 2), elements=ANY),
    magnitude=NUMBERS,
    position=some.integers(0, 2),
)
def test_any_sightings_give_a_catalog_or_are_refused(
    led: NDArray, xy: NDArray, magnitude: NDArray, position: int
) -> None:
    arm = Lever(np.array([0, 0, 0.3]), Rotation.identity())
    for names in (np.arange(2), np.ravel(np.nan_to_num(led)).clip(-9, 9).astype(np.int64)):
        sighting = Sighting(position, Rotation.identity(), names, xy, magnitude)
        answered(lambda: home_position.calibrate([sighting, sighting], CAMERA, SPHERE, arm))  # noqa: B023
    with pytest.raises(ImageError, match="no sightings"):
        home_position.calibrate([], CAMERA, SPHERE, arm)
