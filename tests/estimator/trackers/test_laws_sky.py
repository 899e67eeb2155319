"""Laws of the identifiers and of the star tracker, on any sky and for any lights."""

from __future__ import annotations

from itertools import pairwise

import numpy as np
import pytest
from hypothesis import example, given
from hypothesis import strategies as some
from hypothesis.extra.numpy import arrays
from numpy.typing import NDArray
from scipy import stats
from scipy.spatial import cKDTree
from scipy.spatial.transform import Rotation

from estimator.calibration.zero_point import magnitude_zero
from estimator.catalog import catalog, pair_index
from estimator.core.camera import Camera
from estimator.core.errors import ImageError
from estimator.core.types import Attitude, Centroids, StarMatch
from estimator.identification.direct_match import to_star_match
from estimator.identification.published import primary_pair, shefex
from estimator.identification.published.fialho import fialho_1, fialho_2, fialho_3, fialho_4
from estimator.identification.published.fialho import search_options as fialho_options
from estimator.identification.published.master_star import master_star
from estimator.identification.published.pyramid import pyramid
from estimator.identification.published.saa import AssumptionPool, saa
from estimator.identification.registry import IDENTIFIERS, STEP, candidates
from estimator.identification.solver_options import ACCEPTANCES, Options
from estimator.identification.star_detections import flat_centroids
from estimator.identification.star_evidence import Solution
from estimator.trackers import refinement
from estimator.trackers.pipeline import Settings
from estimator.trackers.refinement import FieldMatcher
from estimator.trackers.star_tracker import StarTracker
from estimator.trackers.tracking_mode import TrackingMode
from tests.helpers.laws import (
    ANY,
    NUMBERS,
    SEEDS,
    answered,
    assert_covariance,
    drawn,
    law,
    turn,
    units,
)

pytestmark = [pytest.mark.slow, pytest.mark.filterwarnings("ignore::RuntimeWarning")]
CAMERA = Camera.from_fov(640, 480, np.radians(40))
RAYS = arrays("f8", some.tuples(some.integers(0, 12), some.just(3)), elements=ANY)


# Identifiers


class World:
    """A sky with its index, and a camera's observations of it."""

    def __init__(self, rng: np.random.Generator, count: int = 800) -> None:
        self.vectors = units(rng, count)
        self.mag = np.sort(rng.uniform(0, 6, count))
        self.index = pair_index.build(self.vectors, CAMERA.diagonal_rad, None, self.mag)
        self.truth = turn(rng)
        px = np.nan_to_num(CAMERA.pixels(self.truth.apply(self.vectors)), nan=-1e9)
        self.star = np.flatnonzero(CAMERA.contains(px, 3))
        self.seen = self.truth.apply(self.vectors[self.star])


@law(
    saa,
    shefex.shefex,
    master_star,
    fialho_1,
    fialho_2,
    fialho_3,
    fialho_4,
    pyramid,
    to_star_match,
    fialho_options,
    AssumptionPool.add,
)
@given(
    rng=SEEDS,
    name=some.sampled_from(sorted(IDENTIFIERS)),
    false=some.integers(0, 6),
    with_magnitudes=some.booleans(),
)
def test_identified_stars_are_the_true_stars(
    rng: np.random.Generator, name: str, false: int, with_magnitudes: bool
) -> None:
    """Each star is matched once, false ones never, with the true attitude; or there is no match."""
    world = World(rng)
    tolerance_rad = 2e-4
    seen = np.concatenate([world.seen, CAMERA.rays(rng.uniform(0, [639, 479], (false, 2)))])
    mag = np.concatenate([world.mag[world.star], np.full(false, 6.0)])
    star = np.concatenate([world.star, np.full(false, -1)])
    more = {"magnitude": mag, "epsilon_mag": 0.1} if with_magnitudes else {}
    match = IDENTIFIERS[name](seen, world.index, tolerance_rad, **more)
    # None is better than a guess.
    match = match or StarMatch(np.arange(len(world.star)), world.star, world.truth, -9.0)
    assert len(set(match.observed.tolist())) == len(match.observed) >= min(4, len(world.star))
    assert match.log10_chance <= -5
    off = np.linalg.norm(
        match.cam_from_ref.apply(world.vectors[match.star]) - seen[match.observed], axis=1
    )
    assert (off < 3 * tolerance_rad).all()
    assert (match.cam_from_ref * world.truth.inv()).magnitude() < 10 * tolerance_rad
    true = star[match.observed] >= 0
    assert (match.star == star[match.observed])[true].all()


@law(
    pyramid,
    saa,
    shefex.shefex,
    master_star,
    fialho_1,
    fialho_2,
    fialho_3,
    fialho_4,
    to_star_match,
)
@given(
    rng=SEEDS,
    rays=RAYS,
    tolerance=some.floats(1e-6, 1e-3) | ANY,
    mag=NUMBERS,
    name=some.sampled_from(sorted(IDENTIFIERS)),
)
def test_random_directions_match_each_star_once_or_none(
    rng: np.random.Generator, rays: NDArray, tolerance: float, mag: NDArray, name: str
) -> None:
    world = World(rng, 60)
    count = len(rays)
    for light in (None, mag):
        more = {"max_checks": 100_000, "magnitude": light}
        match = answered(lambda: IDENTIFIERS[name](rays, world.index, tolerance, **more))  # noqa: B023
        assert match is None or (
            len(set(match.observed.tolist())) == len(match.observed) <= count
        )
    with pytest.raises(ImageError, match="focal length is uncertain"):
        Options(focal_unknown=True).require_known_focal(name)


@law(candidates)
@given(rng=SEEDS, steps=some.integers(-2, 2))
def test_the_true_camera_and_attitude_are_a_candidate(
    rng: np.random.Generator, steps: int
) -> None:
    """The focal length is known or off by whole steps of the search."""
    world = World(rng)
    light = 10 ** (-0.4 * world.mag[world.star])
    centroids = Centroids(CAMERA.pixels(world.seen), np.full(len(light), 0.05), light)
    camera = CAMERA.zoomed(1 / (1 + STEP * steps))
    uncertainty = 0.04 if steps else 0.0
    found = candidates(
        "pyramid", centroids, camera, world.index, uncertainty, 0.05, Settings().base_stars
    )
    right = (
        abs(lens.focal_px / CAMERA.focal_px - 1) < 1e-9
        and (match.cam_from_ref * world.truth.inv()).magnitude() < 1e-3
        for lens, match in found
    )
    assert any(right)


@law(Options.magnitudes, Options.require_known_focal, Options.by_paper)
@given(mag=NUMBERS, count=some.integers(0, 6))
@example(mag=np.array(3.0), count=1)
def test_magnitudes_are_one_per_star_or_unknown(mag: NDArray, count: int) -> None:
    magnitudes = answered(lambda: Options(magnitude=mag).magnitudes(count), ImageError)
    assert (magnitudes is not None) == (mag.shape == (count,))
    assert np.isnan(Options().magnitudes(count)).tolist() == [True] * count
    Options().require_known_focal("any")
    assert [Options(acceptance=one).by_paper for one in ACCEPTANCES] == [False, True]


@law(AssumptionPool.log10_chance, AssumptionPool.best_match)
@given(rng=SEEDS)
def test_a_pool_without_assumptions_gives_no_answer(rng: np.random.Generator) -> None:
    world = World(rng, 60)
    known = world.index
    unknown = np.full(len(world.seen), np.nan)
    gates = primary_pair.Gates(1e-4, 1e-4, np.inf, 0.0)
    seen = primary_pair.SearchInput(
        world.seen, unknown, known.vectors, known.magnitude, known.cells, gates
    )
    pool = AssumptionPool(seen, (-1.0, 1.0, -1.0, 1.0), 0.0)
    assert pool.log10_chance == 0
    assert pool.best_match() is None


@law(shefex.cos_error, shefex.direction_tolerance_rad)
@given(
    fov=some.floats(0.01, 1.5),
    errors=some.lists(some.floats(0, 1e-3), min_size=2, max_size=2),
    factor=some.floats(0, 9),
)
def test_the_gate_grows_with_the_error(
    fov: float, errors: list[float], factor: float
) -> None:
    small, large = (shefex.cos_error(fov, error, factor) for error in sorted(errors))
    assert (
        0 <= small <= large <= factor * max(errors) * 1.000001 + 1e-15
    )  # cosines of 16 digits
    # The inverse of c = 1, to the digits of a cosine.
    error = shefex.direction_tolerance_rad(
        fov, shefex.cos_error(fov, min(errors[0], fov / 2))
    )
    assert error == pytest.approx(min(errors[0], fov / 2), rel=1e-6, abs=1e-13 / np.sin(fov))


@law(magnitude_zero)
@given(rng=SEEDS, shift=some.floats(-5, 5), often=some.integers(1, 3))
def test_the_magnitudes_offset_is_a_shift(
    rng: np.random.Generator, shift: float, often: int
) -> None:
    vectors = units(rng, 9)
    v_mag = rng.uniform(0, 6, 9)
    seen = rng.normal(0, 1, 9)
    one = magnitude_zero(seen, v_mag, vectors)
    order = rng.permutation(9 * often)
    many = (
        np.tile(seen, often)[order],
        np.tile(v_mag + shift, often)[order],
        np.tile(vectors, (often, 1))[order],
    )
    other = magnitude_zero(*many)
    assert one.stars == other.stars == 9
    np.testing.assert_allclose(other.offset_mag - one.offset_mag, shift, rtol=0, atol=1e-9)
    np.testing.assert_allclose(other.scatter_mag, one.scatter_mag, rtol=0, atol=1e-9)


# Tracker


@pytest.fixture(scope="module")
def eye() -> StarTracker:
    stars = drawn(np.random.default_rng(7), 800)
    return StarTracker(CAMERA, stars, stars.vectors)


def seen_by(
    eye: StarTracker, rng: np.random.Generator, truth: Rotation
) -> tuple[Centroids, NDArray]:
    """The field's stars, brightest first, with errors of a tenth of a pixel, and their rows."""
    rows, xy = eye.field_matcher.in_field(CAMERA, truth)
    inside = CAMERA.contains(xy, 2)
    rows = rows[inside]
    xy = xy[inside] + rng.normal(0, 0.1, (int(inside.sum()), 2))
    return Centroids(xy, np.full(len(rows), 0.1), 10 ** (-0.4 * eye.stars.v_mag[rows])), rows


@law(FieldMatcher.nearest)
@given(rng=SEEDS)
def test_a_field_is_matched_at_its_attitude(
    eye: StarTracker, rng: np.random.Generator
) -> None:
    truth = turn(rng)
    centroids, rows = seen_by(eye, rng, truth)
    observed, star = eye.field_matcher.nearest(centroids, CAMERA, truth, 3.0)
    assert np.array_equal(star, rows[observed])
    assert len(star) >= 0.9 * len(rows)


def solution_of(truth: Rotation, matched: NDArray, rows: NDArray) -> Solution:
    """The solution at an attitude by some of the detections, as a search returns it."""
    rms = 0.1 / CAMERA.focal_px
    nothing = np.zeros((3, 3))
    return Solution(matched, rows[matched], truth.as_quat(), nothing, 1.0, rms, 1.0, 20.0)


@law(FieldMatcher.misfits, FieldMatcher.near_misses, FieldMatcher.fits)
@given(rng=SEEDS, aside=some.booleans())
def test_stars_beside_detections_reveal_a_wrong_camera(
    eye: StarTracker, rng: np.random.Generator, aside: bool
) -> None:
    truth = turn(rng)
    centroids, rows = seen_by(eye, rng, truth)
    matcher = eye.field_matcher
    count = len(rows)
    # Every second star: by more than its error, by less than the gate.
    moved = np.arange(count) % 2 == 1
    centroids.xy_px[moved] += 3.0 * aside
    matched = np.flatnonzero(~moved if aside else moved | ~moved)
    solution = solution_of(truth, matched, rows)
    weight = eye.detections(centroids, np.full(count, 0.1)).weight
    near, by_chance = matcher.near_misses(CAMERA, solution, centroids)[0]
    assert near >= moved.sum() * aside
    assert by_chance < 0.2 * max(count, 1)
    if count >= 8:
        assert matcher.misfits(CAMERA, solution, centroids) is aside
        assert not (aside and matcher.fits(solution, centroids, weight))


@law(
    FieldMatcher.in_field,
    Attitude.log10_chance,
    flat_centroids,
    StarTracker.solve_centroids,
    StarTracker.solve_matches,
    StarTracker.attitude_of,
    Attitude.solved,
)
@given(rng=SEEDS, false=some.integers(0, 8))
def test_an_attitude_is_correct_or_none(
    eye: StarTracker, rng: np.random.Generator, false: int
) -> None:
    truth = turn(rng)
    centroids, rows = seen_by(eye, rng, truth)
    everywhere = np.nan_to_num(CAMERA.pixels(truth.apply(eye.stars.vectors)), nan=-1e9)
    assert set(np.flatnonzero(CAMERA.contains(everywhere)).tolist()) <= set(
        eye.field_matcher.in_field(CAMERA, truth)[0].tolist()
    )
    named = eye.solve_matches(centroids, np.arange(len(rows)), rows)
    assert named.solved == (len(rows) >= 2)
    assert not named.solved or (named.cam_from_ref * truth.inv()).magnitude() < 0.02
    xy = np.concatenate([centroids.xy_px, rng.uniform(0, [639, 479], (false, 2))])
    mixed = Centroids(xy, np.full(len(xy), 0.1), np.linspace(2, 1, len(xy)))
    _, own_px, sigma_px, _, spread_px2 = flat_centroids(mixed, np.full(len(xy), 0.2))
    assert spread_px2.shape == (0, 2, 2)
    assert (sigma_px > own_px).all()
    solution = eye.solve_centroids(mixed)
    assert (solution.log10_chance < 0) == solution.solved
    assert (
        solution.solved
        == (solution.status == "solved")
        == (solution.match is not None)
        == (solution.camera is not None)
    )
    assert not solution.solved or (solution.cam_from_ref * truth.inv()).magnitude() < 0.02
    assert not solution.solved or set(solution.match.observed.tolist()) <= set(range(len(xy)))


@pytest.mark.long
@law(
    StarTracker.solve_centroids,
    StarTracker.sigma_px,
    StarTracker.detections,
    StarTracker.efforts,
)
@given(
    xy_px=arrays("f8", (9, 2), elements=ANY),
    sigma_px=arrays("f8", 9, elements=ANY),
    flux=arrays("f8", 9, elements=ANY),
)
def test_any_valid_lights_get_an_answer_and_invalid_ones_are_refused(
    eye: StarTracker, xy_px: NDArray, sigma_px: NDArray, flux: NDArray
) -> None:
    lights = Centroids(xy_px, sigma_px, flux)
    found = [
        answered(lambda n=n: eye.solve_centroids(lights, effort=n), ImageError)
        for n in (None, *range(eye.efforts))
    ]  # type: ignore[misc]
    usable = (
        np.isfinite(xy_px).all()
        and ((sigma_px > 0) & (sigma_px <= 20) & (flux > 0) & (flux < np.inf)).all()
    )
    assert all((one is not None) == usable for one in found)
    assert not any(one is not None and one.solved for one in found)
    sigma = eye.sigma_px(lights, 0.5, 0.01)
    assert (sigma >= np.abs(sigma_px))[np.isfinite(sigma)].all()
    assert eye.detections(lights, sigma).tangent.shape == (9, 2)


@law(StarTracker.solve, TrackingMode.solve, TrackingMode.window_centers_px)
@given(
    rng=SEEDS,
    t_s=some.lists(ANY, min_size=3, max_size=3),
    image=arrays("u2", (48, 64), fill=some.just(0)),
)
def test_no_picture_of_noise_has_an_attitude_at_any_time(
    eye: StarTracker, rng: np.random.Generator, t_s: list[float], image: NDArray
) -> None:
    answered(lambda: eye.solve(image), ImageError)  # not this camera's
    frame = rng.normal(100, 5, (480, 640))
    frame[:48, :64] += image
    follower = TrackingMode(eye)
    assert not eye.solve(frame).attitude.solved
    for when_s in t_s:
        report = answered(lambda when_s=when_s: follower.solve(frame, when_s), ImageError)  # type: ignore[misc]
        assert report is None or not report.attitude.solved
    expected = follower.window_centers_px(turn(rng))
    assert CAMERA.contains(expected, follower.reach_px).all()
    off = np.abs(expected[:, None] - expected).max(axis=2)[np.triu_indices(len(expected), 1)]
    assert (off >= follower.reach_px).all()


@law(StarTracker.warm_up, StarTracker.rich_field, TrackingMode.warm_up, slow=True)
@given(rng=SEEDS)
def test_a_warm_up_changes_no_answer_and_no_memory(
    eye: StarTracker, rng: np.random.Generator
) -> None:
    cam_from_ref, xy_px, light = eye.rich_field()
    assert CAMERA.contains(xy_px, -2.0).all()
    assert len(xy_px) == len(light) > 20
    assert (np.diff(light) <= 0).all()
    seen = CAMERA.pixels(cam_from_ref.apply(eye.stars.vectors))
    assert set(map(tuple, xy_px)) <= set(map(tuple, seen))
    centroids, _ = seen_by(eye, rng, turn(rng))
    before = eye.solve_centroids(centroids)
    follower = TrackingMode(eye)
    follower.warm_up()
    after = eye.solve_centroids(centroids)
    assert follower.last is None
    assert (before.status, before.rms_px) == (after.status, after.rms_px)


@law(refinement.mutual_nearest)
@given(
    rng=SEEDS,
    radius_px=some.floats(0, 50),
    counts=some.tuples(some.integers(0, 9), some.integers(0, 9)),
)
def test_mutual_neighbors_are_each_other_s_nearest(
    rng: np.random.Generator, radius_px: float, counts: tuple[int, int]
) -> None:
    seen, there = (rng.uniform(0, 100, (count, 2)) for count in counts)
    rows = rng.permutation(100)[: len(there)]
    hit, row = refinement.mutual_nearest(seen, there, radius_px, rows)
    between = np.linalg.norm(seen[:, None] - there, axis=2)
    mutual = {
        (int(a), int(np.flatnonzero(rows == b)[0])) for a, b in zip(hit, row, strict=True)
    }
    least = [(a, int(np.argmin(between[a]))) for a in range(len(seen)) if len(there)]
    assert mutual == {
        (a, b)
        for a, b in least
        if np.argmin(between[:, b]) == a and between[a, b] < radius_px
    }


@law(refinement.log10_chance)
@given(
    blobs=some.integers(4, 100),
    predicted=some.integers(1, 100),
    radius_px=some.floats(0.5, 5),
)
def test_more_matches_are_less_likely_by_chance(
    blobs: int, predicted: int, radius_px: float
) -> None:
    chances = [
        refinement.log10_chance(np.arange(n), blobs, predicted, radius_px, CAMERA, 1000)
        for n in range(2, blobs + 1)
    ]
    assert all(b <= a + 1e-9 for a, b in pairwise(chances))


@law(StarTracker.solve)
@given(
    settings_=some.builds(
        Settings,
        identifier=some.sampled_from(["pyramid"]),
        solver=some.sampled_from(["triad", "svd"]),
    )
)
def test_a_tracker_s_answer_has_a_covariance(settings_: Settings) -> None:
    rng = np.random.default_rng(5)
    stars = drawn(rng, 800)
    eye = StarTracker(CAMERA, stars, stars.vectors, settings_)
    solution = eye.solve_centroids(seen_by(eye, rng, turn(rng))[0])
    assert solution.solved
    assert_covariance(solution.covariance_rad2)


@law(StarTracker.for_sky, catalog.hipparcos)
@given(limit_mag=some.floats(3, 6.5), year=some.integers(1950, 2049))
def test_a_tracker_for_the_sky_has_the_stars_to_its_limit_as_seen_at_the_date(
    limit_mag: float, year: int
) -> None:
    """No star is fainter than the limit (merged doubles are brighter); aberration is 20.5" at most."""
    tracker = StarTracker.for_sky(CAMERA, limit_mag, f"{year}-06-22")
    assert tracker.stars.v_mag.max() <= limit_mag + 1e-12  # a merged magnitude is rounded
    mean = catalog.at_epoch(catalog.hipparcos(), year + 0.47)
    chord = cKDTree(mean).query(tracker.stars.vectors[:20])[0]
    assert np.median(chord) < np.radians(20.6 / 3600)
    assert chord.max() > np.radians(1 / 3600)
    # The order of a catalog is not relied on.
    faintest_first = catalog.hipparcos().take(slice(None, None, -1))
    other = StarTracker.for_sky(CAMERA, limit_mag, f"{year}-06-22", stars=faintest_first)
    np.testing.assert_allclose(other.stars.v_mag, tracker.stars.v_mag, rtol=0, atol=1e-12)


def test_chance_matches_are_counted_over_the_circles_of_the_predicted_stars() -> None:
    """Binomial tail among the 15 brightest of 40 blobs, of 30 and of all; one stray in a circle at probability p."""
    observed = np.array([0, 2, 3, 5, 7, 11, 13, 35])
    radius_px = 3.0
    predicted = 50
    area = predicted * np.pi * radius_px**2 / (CAMERA.width_px * CAMERA.height_px)
    tails = [
        stats.binom.logsf(hits - 3, count - 2, -np.expm1(-area))
        for count, hits in ((15, 7), (30, 7), (40, 8))
    ]
    wanted = min(tails) / np.log(10) + np.log10(3 * 20)
    found = refinement.log10_chance(observed, 40, predicted, radius_px, CAMERA, 20)
    assert found == pytest.approx(wanted, abs=1e-9)
