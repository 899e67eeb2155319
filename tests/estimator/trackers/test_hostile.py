"""Any array gives an answer or one error line, and images without a sky give no attitude."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as some
from hypothesis.extra.numpy import array_shapes, arrays
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from estimator.attitude.solvers import SOLVERS, covariance
from estimator.catalog import catalog
from estimator.centroiding.centroid import CENTROIDERS
from estimator.core.camera import Camera
from estimator.core.errors import ImageError
from estimator.core.types import Centroids, FramePriors
from estimator.detection.detect import DETECTORS
from estimator.trackers.pipeline import Settings
from estimator.trackers.star_tracker import StarTracker
from estimator.trackers.tracking_mode import TrackingMode
from skysim.core.paths import CATALOGS
from skysim.results import metrics
from tests.helpers import hostile

BRIEF = settings(max_examples=25, deadline=None)
CAMERA = Camera.from_fov(40, 30, 0.5)
ANY = some.floats(width=64)
KINDS = some.sampled_from(["u2", "f8", ">f8"])
IMAGES = KINDS.flatmap(lambda kind: arrays(kind, (30, 40), fill=some.just(0)))
PIXELS = arrays("f8", some.tuples(some.integers(0, 12), some.just(2)), elements=ANY)
# Of overflow: what counts is the answer.
pytestmark = pytest.mark.filterwarnings("ignore::RuntimeWarning")


def one_line(error: Exception) -> None:
    assert len(str(error).splitlines()) == 1


@pytest.fixture(scope="module")
def stars() -> catalog.StarCatalog:
    return catalog.read(CATALOGS / "hipparcos_hp6.5.ecsv")


@pytest.fixture(scope="module")
def tracker(stars: catalog.StarCatalog) -> StarTracker:
    return StarTracker(CAMERA, stars, stars.vectors, Settings())


@pytest.mark.slow
@pytest.mark.parametrize("detector", DETECTORS)
@BRIEF
@given(image=IMAGES, centroider=some.sampled_from(sorted(CENTROIDERS)))
def test_any_image_gives_centroids_or_one_error_line(
    detector: str, centroider: str, image: NDArray
) -> None:
    try:
        blobs = DETECTORS[detector](image, 5.0, 3, 100, FramePriors(None, np.inf))
        seen = CENTROIDERS[centroider](image, blobs, 1.0, FramePriors(None, np.inf))
    except ImageError as error:
        one_line(error)
        return
    assert len(seen) == len(blobs) <= 100


@pytest.mark.long
@BRIEF
@given(image=IMAGES | arrays("f8", array_shapes(max_dims=4, max_side=40), fill=some.just(0)))
def test_no_image_of_noise_has_an_attitude(tracker: StarTracker, image: NDArray) -> None:
    for look in (tracker.solve, lambda seen: TrackingMode(tracker).solve(seen, 0.0)):
        try:
            assert not look(image).attitude.solved
        except ImageError as error:
            one_line(error)


@pytest.mark.long
@BRIEF
@given(xy_px=PIXELS, data=some.data())
def test_no_lights_of_noise_have_an_attitude(
    tracker: StarTracker, xy_px: NDArray, data: some.DataObject
) -> None:
    sigma_px, flux = (data.draw(arrays("f8", len(xy_px), elements=ANY)) for _ in range(2))
    try:
        assert not tracker.solve_centroids(Centroids(xy_px, sigma_px, flux)).solved
    except ImageError as error:
        one_line(error)


@pytest.mark.slow
@pytest.mark.parametrize("solver", SOLVERS)
@BRIEF
@given(count=some.integers(0, 6), data=some.data())
def test_any_directions_give_a_rotation_or_one_error_line(
    solver: str, count: int, data: some.DataObject
) -> None:
    cam, ref = (data.draw(arrays("f8", (count, 3), elements=ANY)) for _ in range(2))
    sigma_rad = data.draw(arrays("f8", count, elements=ANY))
    try:
        matrix = SOLVERS[solver](cam, ref, sigma_rad).as_matrix()
    except ValueError as error:
        one_line(error)
    else:
        np.testing.assert_allclose(matrix @ matrix.T, np.eye(3), rtol=0, atol=1e-6)
    try:
        covariance(cam, sigma_rad, solver)
    except ValueError as error:
        one_line(error)


@BRIEF
@given(xy_px=PIXELS, k1=some.floats(-1e3, 1e3))
def test_any_pixels_and_lens_give_directions_of_their_shape(
    xy_px: NDArray, k1: float
) -> None:
    lens = Camera(40, 30, 80.0, (20.0, 15.0), (k1, 0.0, 0.0, 0.0, 0.0))
    rays = lens.rays(xy_px)
    assert rays.shape == (len(xy_px), 3)
    assert lens.pixels(rays).shape == xy_px.shape
    assert lens.contains(xy_px).shape == (len(xy_px),)


# Pictures by file, as `skysim solve` takes them


@pytest.mark.long
@pytest.mark.parametrize(
    ("count", "seed"),
    [(30, 1), pytest.param(5000, 3, marks=pytest.mark.long)],
    ids=["some", "many"],
)
def test_hostile_pictures_are_refused(
    monkeypatch: pytest.MonkeyPatch, count: int, seed: int
) -> None:
    """No wrong attitude, no exception, at most two seconds per megapixel, and memory of at most ten frames."""
    monkeypatch.setattr(hostile, "SEARCHED", 0.0)  # at all focal lengths: see the benchmark
    verdicts = hostile.judged(count, seed)
    assert sum(one.looked for one in verdicts.values()) == count
    assert [line for one in verdicts.values() for line in one.defects] == []


@pytest.mark.slow
@pytest.mark.parametrize("frames", [3, pytest.param(1000, marks=pytest.mark.long)])
def test_a_mirrored_sky_is_refused(stars: catalog.StarCatalog, frames: int) -> None:
    """The unmirrored sky of each is solved, so only the mirror image is the reason of the refusal."""
    camera = hostile.camera()
    eye = StarTracker(camera, stars, stars.vectors)
    right = 0
    for n in range(frames):
        picture, there = hostile.starry(np.random.default_rng([2026, n]))
        for seen in (picture[:, ::-1], picture[::-1]):
            assert not eye.solve(np.ascontiguousarray(seen)).attitude.solved
        answered = eye.solve(picture).attitude.cam_from_ref or Rotation.identity()
        right += (answered * there.inv()).magnitude() < metrics.WRONG_RAD
    assert right >= 0.9 * frames


@pytest.mark.slow
def test_four_stars_among_twice_as_many_false_ones_are_refused(tmp_path: Path) -> None:
    """A mirrored sky that once had an answer: 4 of 12 lights on stars, a chance of one in ten thousand by itself."""
    name, shot, answer, _, _ = hostile.Judge(tmp_path).take(68, 14)
    assert (name, shot.skies) == ("mirrored", ())
    assert answer["status"].startswith("no identification beyond chance")
