"""The sequence of stages with true centroids, rendered frames, and input to be refused."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from scipy.spatial.transform import Rotation
from scipy.special import erf

from estimator.attitude import dome_map
from estimator.attitude.dome_map import LedMap, Lever
from estimator.catalog import catalog
from estimator.core.camera import Camera
from estimator.core.checks import Floats
from estimator.core.errors import ImageError
from estimator.core.types import Attitude, Centroids
from estimator.identification.refusals import (
    BUDGET,
    FALSE_LIGHTS,
    NO_LIGHTS,
    NO_MATCH,
    NO_STARS,
)
from estimator.trackers.dome_tracker import SETTINGS, DomeTracker
from estimator.trackers.pipeline import SATURATED, Clock, Settings, detect_and_centroid
from estimator.trackers.refinement import mutual_nearest
from estimator.trackers.star_tracker import StarTracker

FILE = Path(__file__).parents[3] / "data/catalogs/hipparcos_hp6.5.ecsv"
CAMERA = Camera.from_fov(659, 493, np.radians(14.87))
OBSERVER = catalog.Observer(2025.0, np.array([0.3, 0.9, 0.4]), np.array([-25e3, 12e3, 5e3]))
NOISE_PX = 0.1


@pytest.fixture(scope="module")
def tracker() -> StarTracker:
    stars = catalog.read(FILE)
    return StarTracker(CAMERA, stars, catalog.apparent(stars, OBSERVER))


@pytest.fixture(scope="module")
def uncertain() -> StarTracker:
    """A tracker with a focal length assumed 3 % too long and uncertain to 5 %."""
    stars = catalog.read(FILE)
    believed = CAMERA.zoomed(1.03)
    return StarTracker(
        believed, stars, catalog.apparent(stars, OBSERVER), focal_uncertainty=0.05
    )


def starfield(
    tracker: StarTracker, rng: np.random.Generator, lens: Camera, limit_mag: float = 6.0
) -> tuple[Rotation, Floats, Floats]:
    """A random attitude, and pixels and light of the stars to a magnitude, brightest first."""
    truth = Rotation.random(rng=rng)
    bright = catalog.brighter_than(tracker.stars, limit_mag)
    pixels = np.nan_to_num(lens.pixels(truth.apply(bright.vectors)), nan=-1e9)
    inside = np.flatnonzero(lens.contains(pixels, 5.0))
    return truth, pixels[inside], 10 ** (-0.4 * bright.v_mag[inside])


def centroids(pixels: Floats, sigma_px: float = NOISE_PX) -> Centroids:
    count = len(pixels)
    return Centroids(pixels, np.full(count, sigma_px), np.linspace(2, 1, count))


def apart_rad(answer: Attitude, truth: Rotation) -> float:
    return (answer.cam_from_ref * truth.inv()).magnitude()


def frame(lens: Camera, pixels: Floats, light_e: Floats, seed: int) -> np.ndarray:
    """A picture of Gaussian stars of sigma 0.8 px with photon and read noise, in electrons."""
    image = np.full((lens.height_px, lens.width_px), 20.0)
    columns = np.arange(lens.width_px + 1) - 0.5
    rows = np.arange(lens.height_px + 1) - 0.5
    for (x, y), light in zip(pixels, light_e, strict=True):
        across, down = (
            np.diff(erf((e - at) / (0.8 * 2**0.5))) / 2 for e, at in ((columns, x), (rows, y))
        )
        image += light * np.outer(down, across)
    rng = np.random.default_rng(seed)
    return rng.poisson(image) + rng.normal(300, 12, image.shape)


def test_true_centroids_give_the_true_attitude(tracker: StarTracker) -> None:
    rng = np.random.default_rng(80)
    for _ in range(40):
        truth, pixels, _ = starfield(tracker, rng, CAMERA)
        answer = tracker.solve_centroids(centroids(pixels))
        assert answer.status == "solved"
        assert answer.camera == CAMERA
        # Rounding over a spread of 0.1 rad.
        assert apart_rad(answer, truth) < 1e-12
        assert answer.rms_px < 1e-9


def test_covariance_and_rms_of_the_answer_match_the_errors(tracker: StarTracker) -> None:
    # The settings' floor of 0.1 px and the centroids' own 0.1 add: sqrt(2) of it is the noise.
    rng = np.random.default_rng(81)
    nees = []
    rms = []
    for _ in range(250):
        truth, pixels, _ = starfield(tracker, rng, CAMERA)
        noisy = pixels + rng.normal(0, NOISE_PX * 2**0.5, pixels.shape)
        answer = tracker.solve_centroids(centroids(noisy))
        error = (answer.cam_from_ref * truth.inv()).as_rotvec()
        nees.append(error @ np.linalg.inv(answer.covariance_rad2) @ error)
        rms.append(answer.rms_px)
    # Chi-square of three degrees: mean 3, deviation sqrt(6 / 250) = 0.155; three of them.
    assert np.mean(nees) == pytest.approx(3, abs=0.47)
    # A residual an axis, less what three angles of some fifteen stars take up: 0.141 sqrt(1 - 3 / 30).
    assert np.mean(rms) == pytest.approx(0.141 * np.sqrt(0.93), rel=0.06)


def test_the_match_names_the_tracker_s_own_stars(tracker: StarTracker) -> None:
    truth, pixels, _ = starfield(tracker, np.random.default_rng(82), CAMERA)
    match = tracker.solve_centroids(centroids(pixels)).match
    named = CAMERA.pixels(truth.apply(tracker.stars.vectors[match.star]))
    np.testing.assert_allclose(named, pixels[match.observed], rtol=0, atol=1e-9)  # rounding
    assert len(match.star) == len(pixels)


def test_false_centroids_do_not_change_the_answer(tracker: StarTracker) -> None:
    rng = np.random.default_rng(83)
    for _ in range(25):
        truth, pixels, _ = starfield(tracker, rng, CAMERA)
        spots = rng.uniform(0, [658, 492], (len(pixels) // 4 + 2, 2))
        seen = np.vstack([spots[:2], pixels, spots[2:]]) + rng.normal(
            0, NOISE_PX, (len(spots) + len(pixels), 2)
        )
        answer = tracker.solve_centroids(centroids(seen))
        assert answer.solved
        # Roll of some stars at .1 px is 20"; 2e-3 rad is 400", a wrong attitude far more.
        assert apart_rad(answer, truth) < 2e-3


@pytest.mark.parametrize("count", [0, 1, 2])
def test_too_few_stars_give_a_failure_status(tracker: StarTracker, count: int) -> None:
    answer = tracker.solve_centroids(
        centroids(np.random.default_rng(84).uniform(0, 400, (count, 2)))
    )
    assert answer.status == (NO_STARS if count else NO_LIGHTS)
    assert (
        answer.cam_from_ref is answer.covariance_rad2 is answer.match is answer.camera is None
    )
    assert np.isnan(answer.rms_px)
    assert not answer.solved


def test_spots_that_are_no_stars_give_a_failure_status(tracker: StarTracker) -> None:
    rng = np.random.default_rng(85)
    answers = [
        tracker.solve_centroids(centroids(rng.uniform(0, [658, 492], (7, 2))))
        for _ in range(10)
    ]
    assert {answer.status for answer in answers} <= {FALSE_LIGHTS, BUDGET}
    assert {answer.cam_from_ref for answer in answers} == {None}


def test_a_mirrored_field_gives_a_failure_status(tracker: StarTracker) -> None:
    rng = np.random.default_rng(86)
    fields = [starfield(tracker, rng, CAMERA, 5.0)[1] for _ in range(6)]
    mirrored = [tracker.solve_centroids(centroids(xy * [-1, 1] + [658, 0])) for xy in fields]
    assert not any(answer.solved for answer in mirrored)


@pytest.mark.slow
@pytest.mark.parametrize("centroider", ["cog", "gaussian_fit"])
def test_an_image_gives_its_attitude(tracker: StarTracker, centroider: str) -> None:
    rng = np.random.default_rng(87)
    tracker = replaced(
        tracker, replace(tracker.settings, centroider=centroider, centroid_sigma_px=0.05)
    )
    for seed in range(3):
        truth, pixels, light = starfield(tracker, rng, CAMERA)
        report = tracker.solve(frame(CAMERA, pixels, 1e6 * light, seed))
        assert report.attitude.solved
        # Some ten stars of a tenth to a third of a pixel of noise: two arcminutes of roll at most.
        assert apart_rad(report.attitude, truth) < 6e-4
        assert set(report.seconds) == {"detect", "centroid", "identify", "solve"}
        assert len(report.centroids) >= len(report.attitude.match.observed)


def replaced(tracker: StarTracker, settings: Settings) -> StarTracker:
    other = StarTracker.__new__(StarTracker)
    other.__dict__.update(tracker.__dict__)
    other.settings = settings
    return other


@pytest.mark.slow
def test_a_dark_frame_gives_a_failure_status(tracker: StarTracker) -> None:
    report = tracker.solve(np.random.default_rng(88).normal(300, 5, (493, 659)))
    assert report.attitude.status == NO_LIGHTS
    assert len(report.centroids) == 0


def test_a_frame_of_another_size_is_refused(tracker: StarTracker) -> None:
    with pytest.raises(
        ImageError, match="the image is 640x480 pixels; this camera's are 659x493"
    ):
        tracker.solve(np.random.default_rng(89).normal(300, 5, (480, 640)))


def test_a_saturated_frame_is_refused(tracker: StarTracker) -> None:
    image = np.full((493, 659), 255, np.uint8)
    image[:100] = 250
    blinded = replaced(tracker, replace(tracker.settings, saturation=255))
    with pytest.raises(ImageError, match=f"{SATURATED}: over half of its pixels are at 255"):
        blinded.solve(image)


@pytest.mark.slow
def test_a_light_cut_off_by_the_border_is_left_out(tracker: StarTracker) -> None:
    places = np.array([[0.4, 200.0], [300.0, 491.8], [100.0, 100.0], [400.0, 300.0]])
    image = frame(CAMERA, places, np.full(4, 2e4), seed=90)
    found = detect_and_centroid(image, CAMERA, Settings(), Clock())
    assert len(found) == 2
    # .1 px: center of gravity of 2e4 electrons under read noise 12 (reference section 3).
    np.testing.assert_allclose(np.sort(found.xy_px[:, 0]), [100, 400], rtol=0, atol=0.3)


@pytest.mark.slow
def test_a_focal_length_three_per_cent_off_is_found(uncertain: StarTracker) -> None:
    rng = np.random.default_rng(91)
    for _ in range(8):
        truth, pixels, _ = starfield(uncertain, rng, CAMERA, 5.8)
        noisy = pixels + rng.normal(0, NOISE_PX, pixels.shape)
        answer = uncertain.solve_centroids(centroids(noisy))
        assert answer.status == "solved"
        # 0.1 px of some ten stars at 200 px from the middle: 0.1 / (200 sqrt(10)) = 1.6e-4; with the radial
        # coefficient fitted beside it, that is some times less well known.
        assert answer.camera.focal_px == pytest.approx(CAMERA.focal_px, rel=2e-3)
        assert apart_rad(answer, truth) < 1e-3


def test_a_lamp_beside_a_faint_star_does_not_rotate_the_attitude(
    uncertain: StarTracker,
) -> None:
    """If the lens may be off by the distance of the lamp from the star, only brightness distinguishes them."""
    rng = np.random.default_rng(96)
    for _ in range(5):
        truth, pixels, light = starfield(uncertain, rng, CAMERA)
        alone = np.array(
            [np.partition(np.linalg.norm(pixels - one, axis=1), 1)[1] > 12 for one in pixels]
        )
        outer = (
            np.linalg.norm(pixels - CAMERA.center_px, axis=1)
            * alone
            * (light < np.median(light))
        )
        pixels[outer.argmax()] += 1.5
        light[outer.argmax()] = 10 * light.max()
        order = np.argsort(-light)
        lights = Centroids(pixels[order], np.full(len(order), NOISE_PX), light[order])
        answer = uncertain.solve_centroids(lights)
        assert 0 not in answer.match.observed
        assert apart_rad(answer, truth) < 2e-4


def test_a_radial_distortion_is_found_with_the_focal_length(uncertain: StarTracker) -> None:
    lens = replace(CAMERA, distortion=(-0.15, 0.0, 0.0, 0.0, 0.0))
    rng = np.random.default_rng(92)
    found = []
    for _ in range(5):
        truth, pixels, _ = starfield(uncertain, rng, lens)
        # A distortion that the centroids' errors could explain is not fitted.
        lights = replace(centroids(pixels), sigma_px=np.full(len(pixels), 0.02))
        answer = uncertain.solve_centroids(lights)
        assert apart_rad(answer, truth) < 1e-3
        found.append(answer.camera.distortion[0])
    # Noise-free; a star doubled or a soft pair may pull some.
    assert np.median(found) == pytest.approx(-0.15, abs=0.01)


def test_the_residual_is_the_rms_of_the_coordinates(
    tracker: StarTracker, uncertain: StarTracker
) -> None:
    rng = np.random.default_rng(98)
    # 0.3 px: the lens is fitted to the stars.
    for eye, noise_px in ((tracker, 0.1), (uncertain, 0.3)):
        _, pixels, _ = starfield(eye, rng, CAMERA)
        lights = centroids(pixels + noise_px * rng.standard_normal(pixels.shape))
        answer = eye.solve_centroids(lights)
        seen = answer.camera.pixels(
            answer.cam_from_ref.apply(eye.stars.vectors[answer.match.star])
        )
        residual = seen - lights.xy_px[answer.match.observed]
        assert answer.rms_px == pytest.approx(np.sqrt(np.mean(residual**2)), rel=1e-3)


def test_a_sheared_image_is_refused(tracker: StarTracker) -> None:
    """A rolling shutter shears the image of a rotating camera, so stars of only a part of the field fit."""
    rng = np.random.default_rng(97)
    solved = 0
    for _ in range(20):
        _truth, pixels, _ = starfield(tracker, rng, CAMERA, limit_mag=7.0)
        assert tracker.solve_centroids(centroids(pixels)).solved
        # 2.5 px at the edge.
        sheared = pixels + 0.01 * (pixels[:, [1]] - CAMERA.center_px[1]) * [1, 0]
        solved += tracker.solve_centroids(centroids(sheared)).solved
    assert solved == 0


def test_a_focal_length_beyond_its_uncertainty_is_refused() -> None:
    stars = catalog.read(FILE)
    vectors = catalog.apparent(stars, OBSERVER)
    wrong = StarTracker(CAMERA.zoomed(1.06), stars, vectors, focal_uncertainty=0.01)
    rng = np.random.default_rng(93)
    fields = [starfield(wrong, rng, CAMERA, 5.5)[1] for _ in range(1)]
    assert not any(wrong.solve_centroids(centroids(xy)).solved for xy in fields)


def test_pairs_are_mutual_nearest_neighbors_within_the_radius() -> None:
    # Two seen points by one prediction: the nearer has it. A third is out of reach.
    seen = np.array([[0.0, 0], [1.0, 0], [50.0, 0]])
    predicted = np.array([[0.8, 0], [54.0, 0]])
    hit, rows = mutual_nearest(seen, predicted, 3.0, np.array([7, 9]))
    assert (hit.tolist(), rows.tolist()) == ([1], [7])
    empty = mutual_nearest(seen, np.empty((0, 2)), 3.0, np.empty(0, int))
    assert [len(part) for part in empty] == [0, 0]


# AFIT's SimSat under its dome (reference 1.1): 35 mm, 4 um, 38.88 in across and 28.60 in up.
DOME_CAMERA = Camera(1600, 1200, 8750.0, (799.5, 599.5))
WIDE_CAMERA = replace(DOME_CAMERA, focal_px=1000.0)  # 90 degrees from corner to corner
LEVERS = {
    "axial": Lever(np.array([0.0, 0.0, 0.381]), Rotation.identity()),
    "askew": Lever(
        np.array([0.01, -0.02, 0.37]), Rotation.from_euler("xyz", [0.02, -0.03, 0.9])
    ),
}
SHAPES = {
    "sphere": (np.zeros(3), np.full(3, 1.2192)),
    "ellipsoid": (np.array([0.0, 0.0, 0.4928]), np.array([0.9876, 0.9876, 0.7264])),
}


def dome(shape: str, count: int = 2500) -> LedMap:
    """Random LEDs within 40 deg of the dome's apex, at least 5 mm apart."""
    rng = np.random.default_rng(94)
    z = rng.uniform(np.cos(np.radians(40)), 1, count)
    around = rng.uniform(0, 2 * np.pi, count)
    across = np.sqrt(1 - z**2)
    rays = np.column_stack([across * np.cos(around), across * np.sin(around), z])
    leds = LedMap(np.arange(count), np.zeros((count, 3)), *SHAPES[shape])
    places = dome_map.on_surface(rays, np.array([0.0, 0.0, 0.0]), leds)
    apart = np.linalg.norm(places[:, None] - places[None], axis=2) + 9 * np.eye(count)
    return replace(
        leds,
        position_m=places[apart.min(axis=1) > 0.005],
        id=np.flatnonzero(apart.min(axis=1) > 0.005),
    )


def under_the_dome(
    rng: np.random.Generator,
    leds: LedMap,
    lever: Lever,
    noise_px: float,
    camera: Camera = DOME_CAMERA,
) -> tuple[Rotation, Floats]:
    """A vehicle tilted by up to 15 degrees: cam_from_lab and the pixels of the LEDs on the sensor."""
    heading, about = rng.uniform(0, 2 * np.pi, 2)
    tilt = np.radians(rng.uniform(0, 15)) * np.array([np.cos(about), np.sin(about), 0])
    body_from_lab = Rotation.from_rotvec(tilt) * Rotation.from_rotvec([0, 0, heading])
    pixels = dome_map.project(body_from_lab, leds.position_m, lever, camera)
    pixels = pixels[camera.contains(np.nan_to_num(pixels, nan=-1e9))]
    pixels = rng.permutation(pixels) + rng.normal(0, noise_px, pixels.shape)
    return lever.cam_from_body * body_from_lab, pixels


@pytest.mark.slow
@pytest.mark.parametrize("shape", SHAPES)
@pytest.mark.parametrize("lever", LEVERS)
def test_true_centroids_under_a_dome_give_the_true_attitude(lever: str, shape: str) -> None:
    leds = dome(shape)
    tracker = DomeTracker(DOME_CAMERA, leds, LEVERS[lever])
    rng = np.random.default_rng(95)
    for _ in range(15):
        truth, pixels = under_the_dome(rng, leds, LEVERS[lever], 0.0)
        answer = tracker.solve_centroids(centroids(pixels))
        assert answer.status == "solved"
        # 1e-12: rounding over a pattern of 0.1 rad.
        assert apart_rad(answer, truth) < 1e-12
        assert len(answer.match.star) == len(pixels)


@pytest.mark.long
@pytest.mark.parametrize(
    ("camera", "count", "solver"),
    [
        (DOME_CAMERA, 2500, "rotation_only"),
        (WIDE_CAMERA, 60, "rotation_only"),
        (WIDE_CAMERA, 60, "tappe"),
    ],
)
def test_the_dome_tracker_s_covariance_matches_its_errors(
    camera: Camera, count: int, solver: str
) -> None:
    leds = dome("ellipsoid", count)
    lever = LEVERS["askew"]
    tracker = DomeTracker(
        camera, leds, lever, replace(SETTINGS, solver=solver, centroid_sigma_px=0.0)
    )
    rng = np.random.default_rng(96)
    nees = []
    for _ in range(150):
        truth, pixels = under_the_dome(rng, leds, lever, NOISE_PX, camera)
        answer = tracker.solve_centroids(centroids(pixels))
        error = (answer.cam_from_ref * truth.inv()).as_rotvec()
        nees.append(error @ np.linalg.inv(answer.covariance_rad2) @ error)
    # Chi-square of three degrees: deviation of the mean sqrt(6 / 150) = 0.2; three of them.
    assert np.mean(nees) == pytest.approx(3, abs=0.6)


@pytest.mark.slow
def test_the_dome_tracker_refuses_too_few_and_unknown_lights() -> None:
    tracker = DomeTracker(DOME_CAMERA, dome("sphere"), LEVERS["axial"])
    rng = np.random.default_rng(97)
    assert tracker.solve_centroids(centroids(rng.uniform(0, 1000, (2, 2)))).status == NO_STARS
    spots = [
        tracker.solve_centroids(centroids(rng.uniform(0, [1599, 1199], (12, 2))))
        for _ in range(10)
    ]
    assert {answer.status for answer in spots} == {NO_MATCH}


@pytest.mark.slow
def test_a_star_tracker_does_not_solve_a_dome_at_finite_distance(
    tracker: StarTracker,
) -> None:
    leds = dome("sphere")
    rng = np.random.default_rng(98)
    fields = [under_the_dome(rng, leds, LEVERS["axial"], 0.1)[1] * 0.41 for _ in range(2)]
    assert not any(tracker.solve_centroids(centroids(xy)).solved for xy in fields)
