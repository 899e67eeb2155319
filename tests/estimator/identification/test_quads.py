"""Quads: their index against brute force, and frames of a camera whose focal length is wrong."""

import functools
from dataclasses import replace
from itertools import combinations, permutations

import numpy as np
import pytest
from scipy.spatial.distance import pdist, squareform
from scipy.spatial.transform import Rotation

from estimator.catalog import quad_index, sky_index
from estimator.core.camera import Camera
from estimator.core.types import Centroids
from estimator.identification import star_quads, star_search
from estimator.trackers.pipeline import Settings
from estimator.trackers.star_tracker import StarTracker
from tests.helpers.star_fields import (
    CHECKS,
    FIELD,
    SEARCHED,
    SKY,
    attitude_error,
    detections_of,
    observe,
    random_sky,
)

HEIGHT_RAD = np.radians(8.0)


@functools.cache
def all_quads() -> quad_index.QuadIndex:
    """The quads of the sky; a fixture, so that workers do not compile them during collection."""
    return quad_index.build(SKY, HEIGHT_RAD)


def code_of(stars):
    """The code of four unit vectors by its definition, and their order A, B, C, D."""
    apart = squareform(pdist(stars))
    a, b = np.unravel_index(apart.argmax(), apart.shape)
    rest = [n for n in range(4) if n not in (a, b)]
    along = (stars[a] - stars[b]) / apart[a, b]
    across = np.cross(stars[a], stars[b]) / np.linalg.norm(np.cross(stars[a], stars[b]))
    place = np.column_stack([stars[rest] @ along, stars[rest] @ across]) / apart[a, b]
    if place[:, 0].sum() < 0:
        place, a, b = -place, b, a
    order = place[:, 0].argsort()
    return place[order].ravel(), [a, b, rest[order[0]], rest[order[1]]]


@pytest.mark.slow
def test_the_index_holds_every_quad_of_locally_bright_stars_by_its_code() -> None:
    height = np.radians(85.0)
    vectors, mag = random_sky(45, 3)
    sky = sky_index.build(vectors, mag)
    index = quad_index.build(sky, height)
    apart = 2 * np.arcsin(squareform(pdist(vectors)) / 2)
    brighter = [np.count_nonzero(apart[n, :n] < height / 2) for n in range(len(vectors))]
    chosen = np.flatnonzero(np.array(brighter) < quad_index.PER_CIRCLE)
    expected = set()
    for four in combinations(chosen.tolist(), 4):
        longest = apart[np.ix_(four, four)].max()
        if quad_index.SHORTEST * height < longest < quad_index.LONGEST * height:
            expected.add(four)
    found = {
        tuple(sorted(star)): code
        for star, code in zip(index.star.tolist(), index.code, strict=True)
    }
    assert len(found) == len(index.star) > 100
    missing = expected - found.keys()
    # Of stars at the shortest angle, which is taken as a chord.
    assert len(missing) < 0.01 * len(expected)
    for star, code in zip(index.star, index.code, strict=True):
        by_definition, order = code_of(vectors[star])
        np.testing.assert_allclose(code, by_definition, atol=1e-7)
        assert order == [0, 1, 2, 3]


def test_a_quad_is_in_the_cell_of_its_code() -> None:
    number = np.repeat(np.arange(quad_index.SIDE**4), np.diff(all_quads().first))
    bound = np.array([quad_index.ALONG, quad_index.ACROSS] * 2)
    cell = np.clip(
        (all_quads().code + bound) / (2 * bound) * quad_index.SIDE, 0, quad_index.SIDE - 1
    ).astype(int)
    np.testing.assert_array_equal(cell @ quad_index.SIDE ** np.arange(3, -1, -1), number)


def test_a_code_is_the_same_in_every_order_and_at_every_scale() -> None:
    """A small quad through lenses of other focal lengths; a third of its size squared is the error of the scale."""
    tangent = 0.03 * np.array([[0.0, 0.0], [1.0, 0.1], [0.4, 0.5], [0.7, -0.3]])
    expected, _ = code_of(rays_of(tangent))
    for order in permutations(range(4)):
        for ratio in (0.9, 1.0, 1.1):
            detections = detections_of(ratio * tangent[list(order)], np.full(4, 5.0))
            quad = np.arange(4)
            star_quads._longest_first(detections.tangent, quad)
            code, _ = code_of(rays_of(detections.tangent[quad]))
            np.testing.assert_allclose(code, expected, atol=0.2 * 0.03**2)
            assert {order[quad[0]], order[quad[1]]} == {0, 1}


@pytest.mark.parametrize("radius", [0.05, 0.3, 0.5])
def test_the_gate_of_a_code_holds_a_wrong_focal_length_and_no_more(radius: float) -> None:
    """Four stars within a radius through a lens that is 5 % too long: the worst moves by 0.6 to 0.7 of the gate."""
    uncertainty = 0.05
    worst = np.array([[0.076, 0.589], [0.604, 0.506], [0.518, 0.182], [0.669, 0.743]])
    rng = np.random.default_rng(20)
    fours = [worst, *(units(rng) for _ in range(300))]
    shares = []
    for tangent in radius * np.array(fours):
        detections = detections_of(tangent, np.full(4, 5.0), sigma=1e-9, zoom=uncertainty)
        quad = np.arange(4)
        star_quads._longest_first(tangent, quad)
        stars = rays_of(tangent)
        length = np.linalg.norm(stars[quad[0]] - stars[quad[1]])
        gate = star_quads._code_gate(detections, quad, length)
        (code, order), (seen, again) = (
            code_of(one) for one in (stars, rays_of(tangent / (1 + uncertainty)))
        )
        # Where both order the stars alike; elsewhere the codes are of other stars.
        shares.append(np.abs(code - seen).max() / gate if order == again else 0.0)
    assert 0.55 < shares[0] < 1
    assert max(shares) < 1


def units(rng):
    """Four places within the unit circle."""
    angle = rng.uniform(0, 2 * np.pi, 4)
    return np.sqrt(rng.uniform(0, 1, (4, 1))) * np.column_stack(
        [np.cos(angle), np.sin(angle)]
    )


def rays_of(tangent):
    rays = np.column_stack([tangent, np.ones(len(tangent))])
    return rays / np.linalg.norm(rays, axis=1, keepdims=True)


def identify(detections, calibrated=False):
    return star_quads.identify(detections, all_quads(), SKY, SEARCHED, CHECKS, calibrated)


@pytest.mark.parametrize("ratio", [0.955, 1.0, 1.045])
def test_a_focal_length_that_is_wrong_by_some_percent_is_found(ratio: float) -> None:
    rng = np.random.default_rng(11)
    solved = 0
    for _ in range(20):
        truth = Rotation.random(rng=rng)
        tangent, mag, row = observe(truth, rng, zoom=ratio)
        solution = identify(detections_of(tangent, mag, zoom=0.05))
        if not len(solution.star):  # too few stars for decisive evidence
            assert len(row) < 7
            continue
        solved += 1
        assert (solution.star == row[solution.observed]).all()
        assert solution.focal_ratio == pytest.approx(ratio, rel=2e-3)
        assert np.linalg.norm(attitude_error(solution, truth)) < 1e-3
    assert solved > 15


def test_a_field_is_identified_if_half_of_its_lights_and_the_brightest_are_false() -> None:
    rng = np.random.default_rng(12)
    for _ in range(10):
        truth = Rotation.random(rng=rng)
        tangent, mag, _ = observe(truth, rng, zoom=1.03)
        false = rng.uniform(FIELD[[0, 2]], FIELD[[1, 3]], (min(len(mag), 8), 2))
        lights = (
            np.concatenate([false, tangent]),
            np.concatenate([np.full(len(false), mag[0] - 1), mag]),
        )
        solution = identify(detections_of(*lights, zoom=0.05))
        assert np.linalg.norm(attitude_error(solution, truth)) < 1e-3


@pytest.mark.slow
def test_random_lights_and_a_mirrored_sky_are_refused() -> None:
    rng = np.random.default_rng(13)
    for _ in range(200):
        tangent = rng.uniform(FIELD[[0, 2]], FIELD[[1, 3]], (rng.integers(4, 40), 2))
        assert not len(
            identify(
                detections_of(tangent, rng.choice(SKY.mag, len(tangent)), zoom=0.05)
            ).star
        )
        tangent, mag, _ = observe(Rotation.random(rng=rng), rng)
        assert not len(identify(detections_of(tangent * [-1, 1], mag, zoom=0.05)).star)


def test_a_focal_length_beyond_its_uncertainty_is_no_solution() -> None:
    rng = np.random.default_rng(14)
    for _ in range(10):
        tangent, mag, _ = observe(Rotation.random(rng=rng), rng, zoom=1.08)
        assert not len(identify(detections_of(tangent, mag, zoom=0.05)).star)


def test_the_effort_is_bounded() -> None:
    rng = np.random.default_rng(15)
    tangent = rng.uniform(FIELD[[0, 2]], FIELD[[1, 3]], (40, 2))
    tangent = np.concatenate([tangent, observe(Rotation.identity(), rng)[0]])
    loose = detections_of(tangent, np.full(len(tangent), np.nan), sigma=3e-4, zoom=0.05)
    assert not len(star_quads.identify(loose, all_quads(), SKY, SEARCHED, 0, False).star)


def test_a_correct_focal_length_is_kept() -> None:
    rng = np.random.default_rng(16)
    for ratio in (1.0, 1.01):
        truth = Rotation.random(rng=rng)
        tangent, mag, _ = observe(truth, rng, zoom=ratio)
        solution = identify(detections_of(tangent, mag, zoom=0.05), calibrated=True)
        assert (solution.focal_ratio == 1.0) == (ratio == 1.0)


@pytest.mark.slow
def test_a_calibrated_tracker_finds_that_its_focal_length_is_wrong() -> None:
    camera = Camera.from_fov(659, 494, fov_deg=14.87)
    rng = np.random.default_rng(17)
    tracker = StarTracker.for_sky(
        camera.zoomed(1.01), limit_mag=5.75, settings=Settings(centroid_sigma_px=0.0)
    )
    solved = []
    for _ in range(20):
        truth = Rotation.random(rng=rng)
        xy = camera.pixels(truth.apply(tracker.stars.vectors))
        row = np.flatnonzero(camera.contains(np.nan_to_num(xy, nan=-1e9)))
        lights = Centroids(
            xy[row] + 0.1 * rng.normal(size=(len(row), 2)),
            np.full(len(row), 0.1),
            1.0 / (1 + row),
        )
        attitude = tracker.solve_centroids(lights)
        solved.append(attitude.solved)
        if attitude.solved:
            assert attitude.camera.focal_px == pytest.approx(camera.focal_px, rel=2e-3)
            assert (attitude.cam_from_ref * truth.inv()).magnitude() < 1e-3
            known = replace(tracker.camera, focal_px=camera.focal_px)
            assert (
                StarTracker.for_sky(known, 5.75).solve_centroids(lights).camera.focal_px
                == camera.focal_px
            )
    assert np.mean(solved) > 0.9
    assert star_search.DECISIVE_DEX == 10.0
