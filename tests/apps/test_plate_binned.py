"""Images with large stars are solved binned: centroids are in full pixels, and more evidence is required."""

from __future__ import annotations

import math

import cv2
import numpy as np
import pytest
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from estimator.catalog import catalog
from estimator.core.types import Attitude, Centroids
from estimator.trackers.pipeline import Report, Settings
from skysim.apps import plate_solver
from skysim.apps.plate_solver import diagnosis
from skysim.apps.plate_solver import picture as plate_picture
from skysim.core import images
from skysim.core.paths import CATALOGS
from tests.helpers import photographs

SHOT = photographs.Shot(1600, 1200, 25.0, 5.6, radius_px=14.0)


@pytest.fixture(scope="module")
def drawn() -> tuple[NDArray, Rotation]:
    """An image with stars of 28 px hardly brighter than the noise of a pixel, and its attitude."""
    stars = catalog.read(CATALOGS / "gaia_v8.0.ecsv")
    return photographs.draw(
        SHOT, stars, catalog.at_epoch(stars, 2020), np.random.default_rng(5)
    )


@pytest.fixture(scope="module")
def blurred(drawn: tuple[NDArray, Rotation]) -> NDArray:
    return drawn[0]


@pytest.mark.slow
def test_a_defocused_image_is_solved_binned_and_reported_as_such(
    drawn: tuple[NDArray, Rotation],
) -> None:
    blurred, truth = drawn
    solver = plate_solver.make_solver(SHOT.fov_deg, None)
    alone, _ = plate_solver.solve_array(blurred, solver)
    assert not alone.attitude.solved
    outcome = plate_solver.solve_picture(images.ViewedImage(blurred), solver)
    found = plate_solver.outcome_fields(outcome)
    assert found["status"] == "solved"
    assert (
        math.degrees((outcome.report.attitude.cam_from_ref * truth.inv()).magnitude()) < 0.1
    )
    assert found["fov_deg"] == pytest.approx(SHOT.fov_deg, rel=0.01)
    assert found["hint"] == "its lights are large: they were found in the picture binned 4x4"


def test_centroids_of_a_binned_image_are_in_its_full_resolution_pixels() -> None:
    """Centers of disks are accurate to a small part of a disk for both parities of the blocks' corner."""
    rng = np.random.default_rng(2)
    image = np.zeros((1700, 2100), np.uint8)
    places = np.array([(x, y) for x in (200, 700, 1200, 1703) for y in (201, 702, 1203)])
    for x, y in places:
        cv2.circle(image, (int(x), int(y)), 20, 60, -1)
    noisy = np.clip(image + rng.normal(60, 4, image.shape), 0, 255).astype(np.uint8)
    tried = dict(diagnosis.large_lights(noisy, Settings()))
    assert list(tried) == [8, 4, 2]
    for factor, centroids in tried.items():
        off_px = np.linalg.norm(centroids.xy_px[:, None] - places, axis=2).min(axis=1)
        assert len(off_px) == len(places)
        assert np.sqrt(np.mean(off_px**2)) < 0.35, factor
        assert centroids.sigma_px.min() >= 0.1 * factor


def test_sharp_pictures_and_small_ones_are_not_binned(blurred: NDArray) -> None:
    rng = np.random.default_rng(4)
    light = np.zeros((1000, 1300))
    light[rng.integers(0, 1000, 60), rng.integers(0, 1300, 60)] = rng.uniform(
        1000, 30_000, 60
    )
    sharp = 300 + 20 * rng.standard_normal(light.shape) + cv2.GaussianBlur(light, (0, 0), 1.2)
    assert list(diagnosis.large_lights(sharp.astype(np.uint16), Settings())) == []
    assert [
        factor for factor, _ in diagnosis.large_lights(blurred[:850, :850], Settings())
    ] == [
        4,
        2,
    ]
    assert list(diagnosis.large_lights(blurred[:390, :390], Settings())) == []
    assert list(diagnosis.large_lights(np.full((900, 900), 7, np.uint8), Settings())) == []


def test_a_binned_image_needs_more_evidence(
    monkeypatch: pytest.MonkeyPatch, blurred: NDArray
) -> None:
    """Required chance probability: a thousand times less than for the full image, so none is added."""
    tries = []

    def never(
        pixels: NDArray, solver: plate_solver.Solver, *_: object
    ) -> tuple[Report, None]:
        tries.append(solver.hypotheses)
        return Report(Attitude("no"), Centroids.empty()), None

    monkeypatch.setattr(plate_picture, "solve_array", never)
    plate_solver.solve_picture(
        images.ViewedImage(blurred), plate_solver.make_solver(SHOT.fov_deg, None)
    )
    assert tries[0] == 1
    assert set(tries[1:]) == {1000}
    tries.clear()
    fits = images.ViewedImage(blurred, row_order_known=False)
    plate_solver.solve_picture(fits, plate_solver.make_solver(None, None))
    assert tries[:2] == [2, 2]
    assert set(tries[2:]) == {2000}


def test_a_binned_pixel_is_the_mean_of_its_block() -> None:
    image = np.random.default_rng(3).integers(0, 256, (33, 47)).astype(np.uint8)
    means = image[:32, :44].reshape(8, 4, 11, 4).mean(axis=(1, 3))
    small = diagnosis.bin_pixels(image, 4).astype(float)
    scale = (means.max() - means.min()) / 65535
    np.testing.assert_allclose(small * scale + means.min(), means, atol=scale)
    assert math.isclose(small.max(), 65535)
