"""Identification of LEDs at a finite distance: equal LEDs, dead LEDs, reflections, any dome shape, and twins."""

from __future__ import annotations

import itertools
from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest
from scipy.spatial import cKDTree
from scipy.spatial.transform import Rotation

from estimator.attitude.dome_map import LedMap, Lever, on_sphere, on_surface, project
from estimator.core.camera import Camera
from estimator.core.checks import Floats
from estimator.core.types import Centroids, StarMatch
from estimator.identification import led_detections, led_evidence, led_search
from estimator.identification.led_index import PART, DomeIndex, build_dome_index
from estimator.trackers.dome_tracker import DomeTracker
from estimator.trackers.pipeline import Settings
from tests.helpers.interpreted import interpreted

# AFIT's SimSat focused on its LEDs at 33 in; the camera is a little askew.
CAMERA = Camera(1600, 1200, 8698.0, (799.5, 599.5))
LEVER = Lever(
    np.array([0.004, -0.003, 0.381]), Rotation.from_euler("xyz", [0.01, -0.02, 0.3])
)
# Measured: 38.88 and 28.60 in.
OVAL = (np.array([0.0, 0.003, 0.492]), np.array([0.9876, 0.9876, 0.7264]))
FLAT = np.zeros(3), np.array([np.inf, np.inf, 1.2192])  # a panel at 48 in
NOISE_PX = 0.2
ERROR_M = 0.2e-3


def spread(
    count: int, surface: tuple[Floats, Floats], seed: int, cap_deg: float = 40.0
) -> LedMap:
    """This number of LEDs at random places on a surface with a minimum distance."""
    rng = np.random.default_rng(seed)
    z = 1 - rng.random(40 * count) * (1 - np.cos(np.radians(cap_deg)))
    azimuth = rng.uniform(0, 2 * np.pi, len(z))
    across = np.sqrt(1 - z**2)
    nowhere = LedMap(np.arange(0), np.zeros((0, 3)), *surface)
    rays = np.column_stack([across * np.cos(azimuth), across * np.sin(azimuth), z])
    darts = on_surface(rays, np.zeros(3), nowhere)
    spacing = 1.22 * np.sqrt(2 * np.pi * (1 - np.cos(np.radians(cap_deg))) / count) * 0.7
    tree = cKDTree(darts)
    free = np.ones(len(darts), bool)
    chosen = []
    for n, dart in enumerate(darts):
        if free[n] and len(chosen) < count:
            chosen.append(n)
            free[tree.query_ball_point(dart, spacing)] = False
    return LedMap(np.arange(len(chosen)), darts[chosen], *surface)


def surveyed(leds: LedMap, seed: int) -> LedMap:
    """The tracker's map: every LED is displaced by ERROR_M along each axis."""
    error_m = ERROR_M * np.random.default_rng(seed).standard_normal(leds.position_m.shape)
    return LedMap(
        leds.id,
        leds.position_m + error_m,
        leds.center_m,
        leds.semi_axes_m,
        leds.board,
        ERROR_M,
    )


def pose(rng: np.random.Generator, tilt_deg: float = 28.0) -> Rotation:
    """Random body_from_lab with any yaw and tilts up to tilt_deg."""
    tilt = np.arccos(1 - rng.random() * (1 - np.cos(np.radians(tilt_deg))))
    about, yaw = rng.uniform(0, 2 * np.pi, 2)
    tilt_rotation = Rotation.from_rotvec(tilt * np.array([np.cos(about), np.sin(about), 0]))
    return Rotation.from_euler("z", yaw) * tilt_rotation


def lights(
    leds: LedMap,
    body_from_lab: Rotation,
    rng: np.random.Generator,
    dead: float = 0.0,
    false: int = 0,
) -> tuple[Floats, Floats]:
    """Pixels in random order and the LED of each; -1 for a reflection."""
    xy = project(body_from_lab, leds.position_m, LEVER, CAMERA)
    seen = np.flatnonzero(CAMERA.contains(np.nan_to_num(xy, nan=-1e9), 12))
    seen = seen[rng.random(len(seen)) >= dead]
    pixels = xy[seen] + NOISE_PX * rng.standard_normal((len(seen), 2))
    pixels = np.concatenate([pixels, rng.uniform(0, [1599, 1199], (false, 2))])
    order = rng.permutation(len(pixels))
    return pixels[order], np.concatenate([seen, np.full(false, -1)])[order]


def identified(pixels: Floats, dome: DomeIndex) -> StarMatch | str:
    sigma = np.full(len(pixels), NOISE_PX / CAMERA.focal_px)
    return led_search.identify(CAMERA.rays(pixels), sigma, dome)


def names_right(match: StarMatch, names: Floats) -> bool:
    """Whether no light has another LED's name; a reflection beside a dead LED may have its name."""
    named = names[match.observed]
    return bool(np.all((named == match.star) | (named < 0)) and np.any(named >= 0))


@pytest.mark.slow
@pytest.mark.parametrize("surface", [OVAL, FLAT], ids=["ellipsoid", "flat"])
@pytest.mark.parametrize(
    ("dead", "false", "least"),
    [
        pytest.param(0.0, 0, 0.98, marks=pytest.mark.long),
        (0.0, 5, 0.98),
        pytest.param(0.2, 5, 0.8, marks=pytest.mark.long),
        pytest.param(0.5, 5, 0.15, marks=pytest.mark.long),
    ],
)
def test_equal_leds_are_identified_and_never_wrongly(surface, dead, false, least):
    truth = spread(1400, surface, 1)
    leds = surveyed(truth, 2)
    dome = build_dome_index(leds, LEVER, CAMERA)
    rng = np.random.default_rng(3)
    found = 0
    for _ in range(80):
        pixels, names = lights(truth, pose(rng, 25), rng, dead, false)
        match = identified(pixels, dome)
        if not isinstance(match, str):
            found += 1
            assert names_right(match, names)
            assert match.log10_chance <= -led_search.ACCEPT_DEX
    assert found >= least * 80


def test_an_accurate_survey_identifies_leds_of_which_half_are_dead():
    """The number of fitting false attitudes sets the limit: it scales with the square of an LED's error per light."""
    truth = spread(1400, OVAL, 4)
    dome = build_dome_index(truth, LEVER, CAMERA)
    rng = np.random.default_rng(5)
    tries = [lights(truth, pose(rng), rng, 0.5, 5) for _ in range(80)]
    enough = [(pixels, names) for pixels, names in tries if np.sum(names >= 0) >= 4]
    came = [(identified(pixels, dome), names) for pixels, names in enough]
    right = [names_right(match, names) for match, names in came if not isinstance(match, str)]
    assert all(right)
    assert len(right) >= 0.9 * len(enough)


@pytest.mark.long
def test_random_lights_give_no_attitude():
    """Evidence of x powers of ten occurs in at most one of 10^x such frames (Markov): x = 1, 200 frames."""
    leds = surveyed(spread(1400, OVAL, 6), 7)
    dome = build_dome_index(leds, LEVER, CAMERA)
    rng = np.random.default_rng(8)
    dex = []
    for _ in range(200):
        rays = CAMERA.rays(rng.uniform(0, [1599, 1199], (8, 2)))
        fallen = led_detections.build_detections(
            rays, np.full(8, NOISE_PX / CAMERA.focal_px), dome
        )
        best, _ = led_search._search(fallen, dome, 10**7)
        dex.append(best.dex)
    # At most .1 of them, and three deviations of a binomial count.
    assert np.mean(np.array(dex) > 1) <= 0.1 + 3 * np.sqrt(0.09 / 200)
    assert max(dex) < led_search.ACCEPT_DEX


@pytest.mark.parametrize("surface", [OVAL, FLAT], ids=["ellipsoid", "flat"])
def test_a_pair_s_angle_at_the_usual_radius_is_within_the_slack(surface):
    """The lookup angle of a pair, with both rays extended to one sphere, against the index's angle."""
    leds = spread(600, surface, 9)
    dome = build_dome_index(leds, LEVER, CAMERA)
    rng = np.random.default_rng(10)
    keys = dict(
        zip(map(frozenset, dome.pairs.pair.tolist()), dome.pairs.angle_rad, strict=True)
    )
    checked = 0
    for _ in range(60):
        body_from_lab = pose(rng)
        xy = project(body_from_lab, leds.position_m, LEVER, CAMERA)
        seen = np.flatnonzero(CAMERA.contains(np.nan_to_num(xy, nan=-1e9)))
        direction = (
            on_sphere(CAMERA.rays(xy[seen]), dome.pupil_m, dome.median_radius_m)
            / dome.median_radius_m
        )
        for a in range(len(seen)):
            for b in range(a):
                angle = 2 * np.arcsin(np.linalg.norm(direction[a] - direction[b]) / 2)
                assert (
                    abs(angle - keys[frozenset((seen[a], seen[b]))])
                    < dome.scaling_error_rad + 1e-9
                )
                checked += 1
    assert checked > 300


def boards(turns_deg: tuple[float, ...], extra: bool) -> LedMap:
    """Equal patch boards of 3x3 LEDs around the apex, one per azimuth, with an optional single LED."""
    lattice = 0.008 * np.array([[x, y, 0] for y in (-1, 0, 1) for x in (-1, 0, 1)])
    places = [
        Rotation.from_euler("z", turn, degrees=True).apply(
            lattice + np.array([0.045, 0, 1.219])
        )
        for turn in turns_deg
    ]
    place = np.concatenate([*places, *([[[0.02, -0.036, 1.219]]] if extra else [])])
    board = np.repeat(np.arange(len(turns_deg)), 9)
    board = np.append(board, len(turns_deg)) if extra else board
    return LedMap(np.arange(len(place)), place, *FLAT, board)


def seen_by_tracker(leds: LedMap, yaw_deg: float) -> tuple[str, float]:
    """The dome tracker's status, and its attitude's error in degrees."""
    lever = Lever(np.array([0.0, 0.0, 0.381]), Rotation.identity())
    tracker = DomeTracker(CAMERA, leds, lever)
    rng = np.random.default_rng(11)
    truth = Rotation.from_euler("z", yaw_deg, degrees=True)
    pixels = project(truth, leds.position_m, lever, CAMERA)
    pixels = rng.permutation(pixels + 0.05 * rng.standard_normal(pixels.shape))
    answer = tracker.solve_centroids(
        Centroids(pixels, np.full(len(pixels), 0.05), np.ones(len(pixels)))
    )
    error = (answer.cam_from_ref * truth.inv()).magnitude() if answer.solved else np.inf
    return answer.status, float(np.degrees(error))


@pytest.mark.parametrize(
    "turns", [(0.0, 180.0), (0.0, 120.0, 240.0)], ids=["two boards", "three boards"]
)
def test_a_symmetric_pattern_is_called_ambiguous(turns):
    assert seen_by_tracker(boards(turns, extra=False), 33.0)[0] == led_search.AMBIGUOUS


def test_one_light_that_breaks_the_symmetry_makes_the_attitude_unique():
    status, error_deg = seen_by_tracker(boards((0.0, 120.0, 240.0), extra=True), 33.0)
    assert status == "solved"
    # .05 px across a pattern of 500 px: .006 deg of roll; five times that.
    assert error_deg < 0.03


def test_too_few_lights_give_no_attitude():
    leds = spread(300, OVAL, 12)
    dome = build_dome_index(leds, LEVER, CAMERA)
    for count in range(3):
        pixels = np.random.default_rng(13).uniform(0, [1599, 1199], (count, 2))
        assert identified(pixels.reshape(-1, 2), dome) == led_search.NO_MATCH


@pytest.mark.long
def test_the_covariance_includes_the_map_s_errors():
    """NEES over maps drawn anew: chi-square of three degrees, mean 3 +- sqrt(6 / 100)."""
    rng = np.random.default_rng(14)
    nees = []
    truth = spread(1400, OVAL, 15)
    for n in range(100):
        body_from_lab = pose(rng)
        pixels, _ = lights(truth, body_from_lab, rng)
        tracker = DomeTracker(CAMERA, surveyed(truth, 100 + n), LEVER)
        answer = tracker.solve_centroids(
            Centroids(pixels, np.full(len(pixels), NOISE_PX), np.ones(len(pixels)))
        )
        if answer.solved:
            error = (
                answer.cam_from_ref * (LEVER.cam_from_body * body_from_lab).inv()
            ).as_rotvec()
            nees.append(error @ np.linalg.inv(answer.covariance_rad2) @ error)
    assert len(nees) >= 97
    assert np.mean(nees) == pytest.approx(3, abs=3 * np.sqrt(6 / 100))


def test_two_leds_whose_images_touch_are_left_out_of_the_attitude():
    """One blob between them is 10 px from both, while the others are accurate to 0.05 px."""
    lone = spread(1400, OVAL, 16)
    beside = lone.position_m + np.array([0.0025, 0, 0])  # 26 px
    leds = LedMap(np.arange(2800), np.concatenate([lone.position_m, beside]), *OVAL)
    tracker = DomeTracker(CAMERA, leds, LEVER)
    rng = np.random.default_rng(17)
    pulls = []
    for _ in range(30):
        body_from_lab = pose(rng)
        xy = project(body_from_lab, leds.position_m, LEVER, CAMERA)
        seen = np.flatnonzero(CAMERA.contains(np.nan_to_num(xy[:1400], nan=-1e9), 40))
        sharp = seen[2:]
        blend = seen[:2]
        pixels = np.concatenate(
            [xy[sharp], xy[sharp + 1400], 0.6 * xy[blend] + 0.4 * xy[blend + 1400]]
        )
        pixels += 0.05 * rng.standard_normal(pixels.shape)
        answer = tracker.solve_centroids(
            Centroids(pixels, np.full(len(pixels), 0.05), np.ones(len(pixels)))
        )
        assert answer.solved
        error = (
            answer.cam_from_ref * (LEVER.cam_from_body * body_from_lab).inv()
        ).as_rotvec()
        pulls.append(error @ np.linalg.inv(answer.covariance_rad2) @ error)
    # Chi-square of three or less, a centroid's error having a floor above the noise; deviation sqrt(6 / 30).
    assert np.mean(pulls) < 3 + 3 * np.sqrt(6 / 30)


@pytest.mark.long
def test_the_covariance_includes_the_lever_s_error():
    """A pupil position error of 1 mm is 0.047 deg at 48 in, far beyond the lights' noise, and is claimed."""
    truth = spread(1400, OVAL, 18)
    rng = np.random.default_rng(19)
    nees = []
    for _ in range(60):
        aside = Lever(
            LEVER.camera_body_m + 1e-3 * rng.standard_normal(3), LEVER.cam_from_body, 1e-3
        )
        body_from_lab = pose(rng)
        pixels, _ = lights(truth, body_from_lab, rng)
        answer = DomeTracker(CAMERA, truth, aside).solve_centroids(
            Centroids(pixels, np.full(len(pixels), NOISE_PX), np.ones(len(pixels)))
        )
        assert answer.solved
        error = (
            answer.cam_from_ref * (LEVER.cam_from_body * body_from_lab).inv()
        ).as_rotvec()
        nees.append(error[:2] @ np.linalg.inv(answer.covariance_rad2[:2, :2]) @ error[:2])
    # Chi-square of two: mean 2, deviation sqrt(4 / 60).
    assert np.mean(nees) == pytest.approx(2, abs=3 * np.sqrt(4 / 60))


def test_the_index_converts_errors_and_field_to_angles() -> None:
    """Errors of LEDs and pupil over the least distance from the camera; the sensor's area in tangents squared."""
    leds = spread(60, OVAL, seed=1)
    lever = Lever(LEVER.camera_body_m, LEVER.cam_from_body, 1e-3)
    leds = replace(leds, sigma_m=2e-4)
    dome = build_dome_index(leds, lever, CAMERA)
    least_m = np.linalg.norm(leds.position_m, axis=1).min() - np.linalg.norm(
        LEVER.camera_body_m
    )
    assert dome.lever_sigma == pytest.approx(1e-3 / least_m, rel=1e-12)
    assert dome.led_sigma == pytest.approx(2e-4 / least_m, rel=1e-12)
    assert dome.field_area == pytest.approx(1600 * 1200 / 8698.0**2, rel=1e-9)


# ---- steps of the search, by the interpreter

PLAIN = interpreted("estimator.identification.led_search")
CHANCE = interpreted("estimator.identification.chance")


def test_a_ray_intersects_the_sphere_of_an_led_s_radius() -> None:
    """From the pupil along the ray: the point is `radius_m` from the bearing, and its direction is returned."""
    dome = build_dome_index(spread(60, OVAL, seed=1), LEVER, CAMERA)
    for ray in CAMERA.rays(np.array([[0.0, 0.0], [1599.0, 300.0], [799.5, 599.5]])):
        for radius_m in (0.9, 1.3):
            point_m = radius_m * np.array(PLAIN.direction_from_bearing(ray, dome, radius_m))
            assert np.linalg.norm(point_m) == pytest.approx(radius_m, rel=1e-14)
            seen = point_m - dome.pupil_m
            np.testing.assert_allclose(seen / np.linalg.norm(seen), ray, rtol=0, atol=1e-14)


def test_a_pair_s_gates_are_the_error_of_where_it_puts_a_detection() -> None:
    """3.5 standard deviations along the worst axis, as an angle about the bearing: (R - M) / R of the camera's."""
    dome = build_dome_index(spread(60, OVAL, seed=1), LEVER, CAMERA)
    sigma = 1e-5
    rng = np.random.default_rng(3)
    a = 0
    b = 2
    places = np.array([[0.05, 0.02], [0.0, 0.03], [-0.04, 0.01], [0.07, -0.05]])
    rays = np.column_stack([places, np.ones(4)])
    detections = led_detections.build_detections(
        rays / np.linalg.norm(rays, axis=1, keepdims=True), np.full(4, sigma), dome
    )
    seen = places[:, 0] + 1j * places[:, 1]
    noisy = seen + sigma * (
        rng.standard_normal((20_000, 4)) + 1j * rng.standard_normal((20_000, 4))
    )
    turn = (
        (noisy[:, b] - noisy[:, a])
        / np.abs(noisy[:, b] - noisy[:, a])
        / (seen[b] - seen[a])
        * abs(seen[b] - seen[a])
    )
    middle = (noisy[:, [a]] + noisy[:, [b]]) / 2
    errors = middle + turn[:, None] * (seen - (seen[a] + seen[b]) / 2) - noisy
    gates = PLAIN.pair_gates(detections._replace(sigma=np.full(4, sigma)), dome, a, b)
    ratio = 1 - np.linalg.norm(LEVER.camera_body_m) / dome.median_radius_m
    for n in (1, 3):
        worst2 = np.linalg.eigvalsh(np.cov(errors[:, n].real, errors[:, n].imag)).max()
        angle = gates[n] - dome.scaling_error_rad
        # 4 deviations of a variance.
        assert angle == pytest.approx(3.5 * np.sqrt(worst2) * ratio, rel=0.02)


@pytest.mark.parametrize(
    ("dead", "required", "found"),
    [([], 4, 4), ([], 5, 5), ([4], 5, 4), ([2], 4, 4), ([2], 5, 2)],
)
def test_the_quick_check_stops_once_the_outcome_is_decided(
    dead: list[int], required: int, found: int
) -> None:
    """Five exact detections; without the LEDs of some it ends where the rest cannot reach what is required."""
    places = np.array([[0, 0], [0.03, 0.01], [-0.02, 0.03], [0.04, -0.03], [-0.05, -0.02]])
    position_m = np.column_stack([places, np.full(5, 1.2192)])
    camera = Camera(1600, 1200, 8698.0, (799.5, 599.5))
    lever = Lever(np.array([0, 0, 0.381]), Rotation.identity())
    leds = LedMap(np.arange(5), position_m, *FLAT)
    whole = build_dome_index(leds, lever, camera)
    kept = np.setdiff1d(np.arange(5), dead)
    dome = (
        build_dome_index(LedMap(kept, position_m[kept], *FLAT), lever, camera)
        if dead
        else whole
    )
    rays = camera.rays(project(Rotation.identity(), position_m, lever, camera))
    detections = led_detections.build_detections(rays, np.full(5, 1e-5), dome)
    gates = np.full(5, 1e-4)
    rows = np.arange(5)
    median_m = dome.median_radius_m
    assert (
        PLAIN._quick_check(
            detections, dome, np.eye(3), 1.0, median_m, 0, 1, gates, rows, required
        )
        == found
    )
    zoomed = led_detections.build_detections(
        camera.zoomed(1 / 1.08).rays(camera.pixels(rays)),
        np.full(5, 1e-5),
        dome,
        focal_uncertainty=0.1,
    )
    assert (
        PLAIN._quick_check(
            zoomed, dome, np.eye(3), 1.08, median_m, 0, 1, gates, rows, required
        )
        == found
    )
    if found > 2:
        assert (
            PLAIN._quick_check(
                zoomed, dome, np.eye(3), 1.0, median_m, 0, 1, gates, rows, required
            )
            < found
        )


@pytest.mark.parametrize("ratio", [0.89, 1.0, 1.11])
def test_a_pair_gives_the_focal_length_at_which_it_matches_two_leds(ratio: float) -> None:
    """At the exact chord, radii of 1.1 m and 1.3 m; the error left by three iterations is below 1e-6."""
    rays = CAMERA.rays(np.array([[100.0, 300.0], [1500.0, 900.0]]))
    dome = build_dome_index(spread(60, OVAL, seed=1), LEVER, CAMERA)
    ends = [
        np.array(PLAIN.direction_from_bearing(*one))
        for one in ((rays[0], dome, 1.1), (rays[1], dome, 1.3))
    ]
    pixels = CAMERA.pixels(rays)
    seen = led_detections.build_detections(
        CAMERA.zoomed(1 / ratio).rays(pixels), np.full(2, 1e-5), dome, focal_uncertainty=0.12
    )
    chord = float(np.linalg.norm(ends[0] - ends[1]))
    assert PLAIN._fit_focal_ratio(seen, dome, 0, 1, 1.1, 1.3, chord) == pytest.approx(
        ratio, abs=1e-6
    )
    known = seen._replace(focal_uncertainty=0.0)
    assert PLAIN._fit_focal_ratio(known, dome, 0, 1, 1.1, 1.3, chord) == 1


def test_a_second_pair_is_the_first_that_shares_the_fewest_detections_with_the_best() -> None:
    """Both ends matched before all else; then both new, then one, then none."""
    rng = np.random.default_rng(4)
    for matched in (2, 3, 4, 6):
        pairs = rng.permutation(list(itertools.combinations(range(6), 2)))
        best = SimpleNamespace(observed=rng.permutation(6)[:matched])
        rank = int(rng.integers(len(pairs)))
        unmatched = (~np.isin(pairs, best.observed)).sum(axis=1)
        shared = np.isin(pairs, pairs[rank]).sum(axis=1)
        wanted = np.lexsort([np.arange(len(pairs)), shared, unmatched])[0]
        assert PLAIN._disjoint_pair(pairs, rank, best) == wanted


def test_the_prior_of_a_pair_s_attitude_is_its_share_of_all_attitudes() -> None:
    """The integral of a normal density of the three errors over the prior's volume: sqrt(det 2 pi P) / V."""
    dome = build_dome_index(spread(60, OVAL, seed=1), LEVER, CAMERA)
    rays = np.array([[0.05, 0.02, 1.0], [-0.04, 0.01, 1.0]])
    rays /= np.linalg.norm(rays, axis=1, keepdims=True)
    detections = led_detections.build_detections(rays, np.array([1e-5, 2e-5]), dome)
    across = detections.sigma.min() / np.sqrt(2)
    apart = np.hypot(0.09, 0.01)
    covariance = np.diag([across, across, np.sqrt(2) * detections.sigma.min() / apart]) ** 2
    wanted = np.log10(np.sqrt(np.linalg.det(2 * np.pi * covariance)) / dome.prior_volume)
    pair = (detections.tangent, detections.sigma, 0, 1, dome.prior_volume)
    assert CHANCE.attitude_dex(*pair, 0.0) == pytest.approx(wanted, abs=1e-9)
    # A length errs relatively as a direction does; a uniform prior of the focal length over +-12 %.
    focal = np.log10(np.sqrt(2 * np.pi) * np.sqrt(covariance[2, 2]) / 0.24)
    assert CHANCE.attitude_dex(*pair, 0.12) == pytest.approx(wanted + focal, abs=1e-9)


# ---- a focal length that is known to a tenth


def uncalibrated(leds: LedMap, ratio: float) -> DomeTracker:
    """A tracker whose assumed focal length is `ratio` times too short, with no uncertainty."""
    settings = Settings(
        identifier="non_dimensional", solver="rotation_only", centroid_sigma_px=NOISE_PX
    )
    return DomeTracker(CAMERA.zoomed(1 / ratio), leds, LEVER, settings)


@pytest.mark.slow
@pytest.mark.parametrize(
    ("error_m", "surface_m", "least"),
    [(0.2e-3, 0.0, 0.98), (1e-3, 0.0, 0.7), (3e-2, 0.0, 0.0), (0.2e-3, 3e-2, 0.95)],
)
def test_an_unknown_focal_length_is_found_with_the_attitude_or_nothing_is(
    error_m: float, surface_m: float, least: float
) -> None:
    """Every answer has the right LEDs; attitude and focal length err as claimed (chi-square of 3 and of 1).

    surface_m : an error that all LEDs share, along the normals, whose scale goes into the focal length
    """
    rng = np.random.default_rng(20)
    truth = spread(1400, OVAL, 21)
    tries = 60 if error_m < 1e-2 else 2  # a search of a second each, in vain
    nees = []
    focal = []
    for n in range(tries):
        if n % 3 == 0:
            outward = (truth.position_m - truth.center_m) / truth.semi_axes_m**2
            shift_m = surface_m * outward / np.linalg.norm(outward, axis=1, keepdims=True)
            believed_m = truth.position_m + error_m * rng.standard_normal(
                truth.position_m.shape
            )
            believed_m += rng.standard_normal() * shift_m
            leds = replace(
                truth,
                position_m=believed_m,
                sigma_m=error_m,
                common_m=shift_m[None] if surface_m else None,
            )
            tracker = uncalibrated(leds, 1 + rng.uniform(-0.1, 0.1))
        body_from_lab = pose(rng, 25)
        pixels, names = lights(truth, body_from_lab, rng)
        answer = tracker.solve_centroids(
            Centroids(pixels, np.full(len(pixels), 1e-3), np.ones(len(pixels)))
        )
        if answer.solved:
            assert np.array_equal(names[answer.match.observed], answer.match.star)
            error = (
                answer.cam_from_ref * (LEVER.cam_from_body * body_from_lab).inv()
            ).as_rotvec()
            nees.append(error @ np.linalg.solve(answer.covariance_rad2, error))
            focal.append(
                (answer.camera.focal_px / CAMERA.focal_px - 1) / answer.camera.focal_sigma
            )
    assert len(nees) >= least * tries
    if nees:
        # Frames in threes share a map's errors, in other fields of it, but the surface's in all.
        draws = len(nees) / 3 if surface_m else len(nees)
        assert np.mean(nees) == pytest.approx(3, abs=4 * np.sqrt(6 / draws))
        assert np.mean(np.square(focal)) == pytest.approx(1, abs=4 * np.sqrt(2 / draws))


@pytest.mark.slow
def test_a_calibrated_tracker_finds_nothing_at_a_focal_length_ten_percent_off() -> None:
    """All pair angles are wrong, which only the search with a free focal length handles."""
    truth = spread(1400, OVAL, 21)
    rng = np.random.default_rng(22)
    leds = surveyed(truth, 23)
    solved = []
    for identifier in ("led_pairs", "non_dimensional"):
        settings = Settings(
            identifier=identifier, solver="rotation_only", centroid_sigma_px=NOISE_PX
        )
        tracker = DomeTracker(CAMERA.zoomed(1.1), leds, LEVER, settings)
        seen = [lights(truth, pose(rng, 25), rng)[0] for _ in range(10)]
        answers = [
            tracker.solve_centroids(
                Centroids(one, np.full(len(one), 1e-3), np.ones(len(one)))
            )
            for one in seen
        ]
        solved.append(sum(answer.solved for answer in answers))
    assert solved[0] == 0
    assert solved[1] >= 9


@pytest.mark.long
def test_random_lights_give_no_attitude_at_any_focal_length() -> None:
    """As for a calibrated camera, evidence of x powers of ten occurs in at most one of 10^x frames."""
    dome = build_dome_index(surveyed(spread(1400, OVAL, 6), 7), LEVER, CAMERA.zoomed(0.88))
    rng = np.random.default_rng(8)
    dex = []
    for _ in range(200):
        rays = CAMERA.rays(rng.uniform(0, [1599, 1199], (8, 2)))
        fallen = led_detections.build_detections(
            rays, np.full(8, NOISE_PX / CAMERA.focal_px), dome, focal_uncertainty=0.12
        )
        best, _ = led_search._search(fallen, dome, 10**7)
        dex.append(best.dex)
    assert np.mean(np.array(dex) > 1) <= 0.1 + 3 * np.sqrt(0.09 / 200)
    assert max(dex) < led_search.ACCEPT_DEX


# ---- dense domes

DENSE = 6000


def lattice(count: int) -> LedMap:
    """A Fibonacci lattice in a cap of 27 deg."""
    row = np.arange(count) + 0.5
    z = 1 - (1 - np.cos(np.radians(27))) * row / count
    azimuth = np.pi * (3 - np.sqrt(5)) * row
    across = np.sqrt(1 - z**2)
    place_m = 1.2 * np.column_stack([across * np.cos(azimuth), across * np.sin(azimuth), z])
    return LedMap(np.arange(count), place_m, np.zeros(3), np.full(3, 1.2))


@pytest.fixture(scope="module")
def dense() -> tuple[LedMap, DomeIndex]:
    """LEDs at random places, and the index of their survey."""
    truth = spread(DENSE, OVAL, 31, 30.0)
    return truth, build_dome_index(surveyed(truth, 32), LEVER, CAMERA)


def test_the_nearest_leds_of_a_dense_dome_match_brute_force(
    dense: tuple[LedMap, DomeIndex],
) -> None:
    _, dome = dense
    direction = dome.position_m / dome.radius_m[:, None]
    lever_m = np.linalg.norm(LEVER.camera_body_m)
    scale = (1 - lever_m / dome.median_radius_m) / (1 - lever_m / dome.radius_m)
    for led in range(0, DENSE, 97):
        chord = np.linalg.norm(direction - direction[led], axis=1)
        nearest = np.argsort(chord)[:PART]
        assert dome.near[led].tolist() == nearest.tolist()
        np.testing.assert_allclose(
            dome.near_chord[led], chord[nearest] * (scale[led] + scale[nearest]) / 2, 1e-9, 0
        )


def test_the_index_of_a_dense_dome_grows_with_its_leds() -> None:
    """Pairs of one LED, of three times as many LEDs: all pairs would be three times as many."""
    pairs = []
    for count in (5000, 15_000):
        dome = build_dome_index(lattice(count), LEVER, CAMERA)
        pairs.append(len(dome.pairs.pair) / len(dome.radius_m))
    assert pairs[1] == pytest.approx(pairs[0], rel=0.05)


@pytest.mark.parametrize("surface", [OVAL, FLAT], ids=["ellipsoid", "flat"])
def test_all_leds_that_the_camera_can_see_are_in_the_field(surface: tuple) -> None:
    """Against the projection of every LED of a sparse dome, which has the same field."""
    leds = spread(1500, surface, 3)
    dome = build_dome_index(leds, LEVER, CAMERA)
    rng = np.random.default_rng(4)
    for _ in range(100):
        body_from_lab = pose(rng)
        xy = project(body_from_lab, leds.position_m, LEVER, CAMERA)
        seen = np.flatnonzero(CAMERA.contains(np.nan_to_num(xy, nan=-1e9)))
        R_cam_from_lab = (LEVER.cam_from_body * body_from_lab).as_matrix()
        field = led_evidence._field(dome, R_cam_from_lab)
        assert len(set(field)) == len(field)
        assert np.isin(seen, field).all()


def test_lights_from_left_to_right_match_as_those_in_any_order(
    dense: tuple[LedMap, DomeIndex],
) -> None:
    """A search by halves under a dense dome finds the nearest light that a search of all lights finds."""
    truth, dome = dense
    sparse = dome._replace(near=dome.near[:0])
    rng = np.random.default_rng(5)
    for _ in range(20):
        body_from_lab = pose(rng, 18)
        pixels, _ = lights(truth, body_from_lab, rng, 0.2, 40)
        rays = CAMERA.rays(pixels[np.argsort(pixels[:, 0])])
        rays = rays[np.argsort(rays[:, 0] / rays[:, 2])]
        detections = led_detections.build_detections(rays, np.full(len(rays), 2e-5), dome)
        R_cam_from_lab = (LEVER.cam_from_body * body_from_lab).as_matrix()
        leds = led_evidence._field(dome, R_cam_from_lab)
        found = [
            led_evidence._match(
                detections, index, R_cam_from_lab, 1.0, leds, (0.01, -0.02), 1.5, 20.0
            )
            for index in (dome, sparse)
        ]
        assert len(found[0][0]) > 40
        np.testing.assert_array_equal(found[0][0], found[1][0])
        np.testing.assert_array_equal(found[0][1], found[1][1])
        assert found[0][2] == found[1][2]


@pytest.mark.slow
@pytest.mark.parametrize(
    ("dead", "false", "least"), [(0.0, 0, 0.97), (0.05, 4, 0.9), (0.2, 10, 0.5)]
)
def test_a_dense_dome_is_identified_and_never_wrongly(
    dense: tuple[LedMap, DomeIndex], dead: float, false: int, least: float
) -> None:
    truth, dome = dense
    rng = np.random.default_rng(34)
    found = 0
    for _ in range(40):
        pixels, names = lights(truth, pose(rng, 20), rng, dead, false)
        match = identified(pixels, dome)
        if not isinstance(match, str):
            found += 1
            assert names_right(match, names)
    assert found >= least * 40


def test_like_thirds_of_a_dense_dome_are_called_ambiguous(
    dense: tuple[LedMap, DomeIndex],
) -> None:
    """A third of the dome, turned twice by 120 deg: three attitudes explain every field."""
    truth, _ = dense
    azimuth = np.arctan2(truth.position_m[:, 1], truth.position_m[:, 0])
    third = truth.position_m[(azimuth > 0) & (azimuth < 2 * np.pi / 3)]
    place_m = np.concatenate(
        [Rotation.from_euler("z", 120 * k, degrees=True).apply(third) for k in range(3)]
    )
    leds = LedMap(np.arange(len(place_m)), place_m, *OVAL)
    dome = build_dome_index(leds, LEVER, CAMERA)
    assert len(dome.near) == len(place_m)
    rng = np.random.default_rng(38)
    for _ in range(15):
        pixels, _ = lights(leds, pose(rng, 18), rng)
        assert identified(pixels, dome) == led_search.AMBIGUOUS


@pytest.mark.slow
def test_a_dense_lattice_gives_no_wrong_attitude() -> None:
    """A Fibonacci lattice turned by the golden angle is the same, but for one LED's share of the dome.

    A turn moves an LED at the angle t from the axis by c / (N sin t), c = 1 - cos of the dome's half-angle: 0.04 mrad,
    of which most turns the field. The map's errors are 0.3 mrad, so that no attitude may be given at most poses.
    """
    truth = lattice(DENSE)
    dome = build_dome_index(surveyed(truth, 35), LEVER, CAMERA)
    rng = np.random.default_rng(36)
    statuses = []
    for _ in range(60):
        pixels, names = lights(truth, pose(rng, 18), rng)
        match = identified(pixels, dome)
        statuses.append(match)
        assert isinstance(match, str) or names_right(match, names)
    assert statuses.count(led_search.AMBIGUOUS) >= 40


def test_places_that_are_alike_differ_in_evidence_by_the_map_s_errors() -> None:
    """Residuals of the same lights with the LEDs of two like places, of 20,000 frames of 30 lights."""
    dome = build_dome_index(
        replace(spread(150, OVAL, seed=1), sigma_m=ERROR_M), LEVER, CAMERA
    )
    sigma_rad = 1.5 * dome.led_sigma
    rays = CAMERA.rays(np.random.default_rng(6).uniform(0, 1200, (30, 2)))
    detections = led_detections.build_detections(rays, np.full(30, sigma_rad), dome)
    rng = np.random.default_rng(7)
    noise = sigma_rad * rng.standard_normal((20_000, 60))
    errors = dome.led_sigma * rng.standard_normal((2, 20_000, 60))
    chi2 = ((noise - errors) ** 2).sum(axis=2) / (sigma_rad**2 + dome.led_sigma**2)
    difference_dex = (chi2[0] - chi2[1]) / (2 * np.log(10))
    # 4 deviations of a standard deviation.
    assert detections.blur_dex * np.sqrt(30) == pytest.approx(difference_dex.std(), rel=0.02)


def test_a_like_place_within_the_map_s_errors_is_a_rival() -> None:
    """Two hypotheses of 20 lights, all of other LEDs: beyond chance their difference must exceed its own noise."""
    star = np.arange(20)
    best = led_evidence.LedHypothesis(star, star, np.eye(3), 60.0)
    # 4.3 standard deviations of 20 lights are 38.5 powers of ten, of which identify() asks for five, and 3.8.
    for blur_dex, rival_dex, added_dex in (
        (2.0, 40.0, 33.46037),
        (0.2, 40, 0),
        (2.0, 4.0, 0),
    ):
        detections = SimpleNamespace(ray=np.zeros((20, 3)), blur_dex=blur_dex)
        rival = led_evidence.LedHypothesis(star, star + 100, np.eye(3), rival_dex)
        for pair in ((rival, best), (best, rival)):
            kept, counted = PLAIN._better(*pair, -np.inf, detections)
            assert kept.dex == 60.0
            assert counted == pytest.approx(rival_dex + added_dex, rel=1e-6)
    agreeing = led_evidence.LedHypothesis(star, star, np.eye(3), 50.0)
    assert PLAIN._better(agreeing, best, -np.inf, detections)[1] == -np.inf


@pytest.mark.slow
def test_random_lights_give_no_attitude_under_a_dense_dome(
    dense: tuple[LedMap, DomeIndex],
) -> None:
    rng = np.random.default_rng(37)
    for _ in range(20):
        pixels = rng.uniform(0, [1599, 1199], (75, 2))
        assert isinstance(identified(pixels, dense[1]), str)


@pytest.mark.parametrize("agreeing", [1, 2])
def test_another_part_of_the_field_must_find_the_same(
    dense: tuple[LedMap, DomeIndex], agreeing: int, monkeypatch: pytest.MonkeyPatch
) -> None:
    """An attitude that one part alone finds is its own rival; a second part that agrees ends the search."""
    _, dome = dense
    rays = CAMERA.rays(np.random.default_rng(39).uniform(0, [1599, 1199], (75, 2)))
    detections = led_detections.build_detections(rays, np.full(75, 2e-5), dome)
    star = np.arange(40)
    found = led_evidence.LedHypothesis(star, star, np.eye(3), 90.0)
    tested = []

    def answer(*arguments):
        tested.append(arguments[2])
        return (found if len(tested) in (3, 5, 6)[:agreeing] else PLAIN._nothing()), -np.inf

    monkeypatch.setattr(PLAIN, "_test_pair", answer)
    best, rival_dex = PLAIN._search_parts(detections, dome, 10**6)
    assert best.dex == 90.0
    assert rival_dex == (90.0 if agreeing == 1 else -np.inf)
    assert (len(tested) == 5) == (agreeing == 2)
    apart = np.linalg.norm(
        detections.tangent[tested[3:]] - detections.tangent[tested[2]], axis=1
    )
    assert (apart > 0.2 * np.sqrt(dome.field_area)).all()
