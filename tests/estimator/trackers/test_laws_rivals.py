"""A second sky in the frame makes the answer ambiguous, unless it is far weaker; each star of it is seen twice."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from hypothesis import given
from scipy import stats
from scipy.spatial.transform import Rotation

from estimator.catalog import index_file, sky_index
from estimator.core.camera import Camera
from estimator.core.checks import Floats
from estimator.core.types import Attitude, Centroids
from estimator.identification.refusals import AMBIGUOUS, NO_LIGHTS, NO_STARS, WRONG_SCALE
from estimator.trackers import rivals
from estimator.trackers.search_models import DEEP_SEARCHES
from estimator.trackers.star_tracker import StarTracker
from tests.helpers.laws import SEEDS, law

CAMERA = Camera.from_fov(1024, 1024, fov_deg=16.0)
TRACKER = StarTracker.for_sky(CAMERA)
# The camera turned about its boresight, or by 0.3 degrees across it.
TURNS = [Rotation.from_rotvec([0, 0, np.pi]), Rotation.from_rotvec([0.005, 0, 0])]


def lights(*skies: tuple[Rotation, float, int], scale: float = 1.0) -> Centroids:
    """The stars of attitudes, each so many magnitudes fainter and the brightest so many alone."""
    places: list[Floats] = []
    mags: list[Floats] = []
    for cam_from_icrs, fainter_mag, most in skies:
        seen = cam_from_icrs.apply(TRACKER.stars.vectors)
        ahead = np.flatnonzero(seen[:, 2] > 0.9)
        xy_px = (CAMERA.pixels(seen[ahead]) - CAMERA.center_px) * scale + CAMERA.center_px
        mag = TRACKER.stars.v_mag[ahead] + fainter_mag
        shown = np.flatnonzero(CAMERA.contains(xy_px, 3) & (mag < 5.8))[:most]
        places.append(xy_px[shown])
        mags.append(mag[shown])
    xy_px = np.concatenate(places)
    mag = np.concatenate(mags)
    order = np.argsort(mag)
    return Centroids(xy_px[order], np.full(len(mag), 0.05), 10 ** (-0.4 * mag[order]))


@law(rivals.with_rivals)
@given(rng=SEEDS)
def test_one_sky_has_no_rival_among_false_lights(rng: np.random.Generator) -> None:
    """As many false lights as stars, and a refusal is returned as it is."""
    frame = lights((Rotation.random(rng=rng), 0.0, 100))
    false_px = rng.uniform(0, 1023, (len(frame), 2))
    order = rng.permutation(2 * len(frame))
    xy_px = np.concatenate([frame.xy_px, false_px])[order]
    flux = np.concatenate([frame.flux, frame.flux])[order]
    bright = np.argsort(-flux)
    answer = TRACKER.solve_centroids(
        Centroids(xy_px[bright], np.full(len(order), 0.05), flux[bright])
    )
    assert answer.rivals == ()
    refused = Attitude(NO_STARS)
    sky = TRACKER.sky
    matcher = TRACKER.field_matcher
    same = rivals.with_rivals(
        refused, frame, TRACKER.sigma_px, TRACKER.sensor, sky, matcher, None
    )
    assert same is refused


@pytest.fixture(params=["by pairs", "by quads"])
def tracker(
    request: pytest.FixtureRequest, monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> StarTracker:
    """A tracker of a shallow sky, and one that takes the same stars for a deep sky."""
    if request.param == "by pairs":
        return TRACKER
    monkeypatch.setenv("ESTIMATOR_CACHE_DIR", str(tmp_path))
    monkeypatch.setattr(index_file, "FEW_STARS", 0)
    deep = StarTracker.for_sky(CAMERA)
    assert deep.searches == DEEP_SEARCHES
    assert deep.searches[0].by_quads
    # Neither the frame nor its rivals are found by pairs.
    deep.searches = deep.searches[:1]
    monkeypatch.setattr(sky_index, "add_pairs", None)
    return deep


@pytest.mark.parametrize("turn", TURNS, ids=["half turn", "shift"])
def test_two_comparable_skies_are_ambiguous_and_both_are_reported(
    turn: Rotation, tracker: StarTracker
) -> None:
    """Whichever of the two the search finds first, no attitude is answered."""
    for truth in Rotation.random(5, rng=3):
        frame = lights((truth, 0.0, 100), (turn * truth, 0.5, 100))
        answer = tracker.solve_centroids(frame)
        assert (answer.status, answer.cam_from_ref) == (AMBIGUOUS, None)
        for sky in (truth, turn * truth):
            off = [(one.cam_from_ref * sky.inv()).magnitude() for one in answer.rivals]
            assert min(off) < 1e-4
        # The evidence is that of a solution, and no light belongs to both.
        assert all(one.log10_chance < -5 for one in answer.rivals)
        observed = np.concatenate([one.match.observed for one in answer.rivals])
        assert len(np.unique(observed)) == len(observed)


def test_a_far_weaker_sky_is_no_rival_and_is_listed() -> None:
    """Five lights against 30 or more; also where the search finds the weaker sky first."""
    listed = 0
    for truth in Rotation.random(30, rng=4):
        frame = lights((truth, 0.0, 100), (TURNS[0] * truth, 0.5, 5))
        if len(frame) < 35:
            continue
        answer = TRACKER.solve_centroids(frame)
        assert (answer.cam_from_ref * truth.inv()).magnitude() < 1e-4
        listed += len(answer.rivals)
    assert listed > 3


def test_stars_that_are_seen_once_are_no_second_sky() -> None:
    """A frame of which one half is displaced has two attitudes, but no star of it is seen twice."""
    for truth in Rotation.random(5, rng=5):
        frame = lights((truth, 0.0, 100))
        left = frame.xy_px[:, 0] < 400
        xy_px = frame.xy_px + np.outer(left, [0.0, 30.0])
        answer = TRACKER.solve_centroids(Centroids(xy_px, frame.sigma_px, frame.flux))
        assert answer.status != AMBIGUOUS


@pytest.mark.parametrize("share", [0.5, 0.3, 0.8])
def test_a_rival_is_comparable_by_the_binomial_tail(share: float) -> None:
    for more in (4, 10, 30, 60):
        for fewer in range(more + 1):
            tail = stats.binom.sf(more - 1, more + fewer, share)
            assert rivals._is_comparable(more, fewer, share) == (tail > 1e-3)


def test_a_refusal_names_its_reason() -> None:
    """Nothing and two lights; stars at a focal length that is a fifth longer."""
    frame = lights((Rotation.random(rng=6), 0.0, 100))
    for count, status in ((0, NO_LIGHTS), (2, NO_STARS)):
        answer = TRACKER.solve_centroids(frame.take(np.arange(count)))
        assert answer.status == status
    for truth in Rotation.random(3, rng=7):
        zoomed = lights((truth, 0.0, 100), scale=1.2)
        assert TRACKER.solve_centroids(zoomed).status == WRONG_SCALE


def test_a_deep_sky_gets_its_pairs_when_they_are_searched(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    monkeypatch.setenv("ESTIMATOR_CACHE_DIR", str(tmp_path))
    monkeypatch.setattr(index_file, "FEW_STARS", 0)
    deep = StarTracker.for_sky(CAMERA)
    frame = lights((Rotation.random(rng=5), 0.0, 30))
    assert deep.solve_centroids(frame).solved
    assert not len(deep.sky.pair)  # quads have found it
    assert deep.field_matcher.patterns == len(TRACKER.sky.pair)
    by_pairs = deep.solve_centroids(frame, effort=1)
    expected = TRACKER.solve_centroids(frame, effort=0)
    assert by_pairs.cam_from_ref is not None
    assert expected.cam_from_ref is not None
    np.testing.assert_array_equal(
        by_pairs.cam_from_ref.as_quat(), expected.cam_from_ref.as_quat()
    )
    for name in ("pair", "first", "bin_rad"):
        np.testing.assert_array_equal(getattr(deep.sky, name), getattr(TRACKER.sky, name))
