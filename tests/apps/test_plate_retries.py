"""Images of which only a part, or the image without clouds, shows the sky."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from estimator.catalog import catalog
from estimator.core.types import Centroids
from estimator.trackers.pipeline import Settings
from skysim.apps import plate_solver
from skysim.apps.plate_solver import diagnosis
from skysim.core import images
from skysim.core.paths import CATALOGS
from tests.helpers import photographs

SHOT = photographs.Shot(1280, 960, 22.0, 6.3)


def drawn(shot: photographs.Shot, seed: int) -> tuple[NDArray, Rotation]:
    stars = catalog.read(CATALOGS / "gaia_v8.0.ecsv")
    return photographs.draw(
        shot, stars, catalog.at_epoch(stars, 2020), np.random.default_rng(seed)
    )


def town(light: NDArray, rng: np.random.Generator) -> None:
    """The lower half is a town at night, with 60 lamps."""
    light[480:] = photographs.SKY
    for x, y in rng.uniform([5, 485], [1275, 955], (60, 2)):
        photographs.add_star(light, x, y, 10 ** rng.uniform(3.3, 4.3), 1.1, 0.0, (0.0, 0.0))


@pytest.mark.slow
def test_an_image_with_a_town_below_is_solved_by_its_upper_half() -> None:
    image, truth = drawn(replace(SHOT, limit_mag=5.4, spoil=town), 3)
    solver = plate_solver.make_solver(SHOT.fov_deg, None)
    assert not plate_solver.solve_array(image, solver)[0].attitude.solved
    outcome = plate_solver.solve_picture(images.ViewedImage(image), solver)
    assert photographs.is_same(outcome.report.attitude.cam_from_ref, truth)
    assert (
        plate_solver.outcome_fields(outcome)["hint"]
        == "its stars were found in its upper half alone"
    )
    assert (outcome.report.centroids.xy_px[:, 1] < 480).all()


@pytest.mark.slow
def test_removing_clouds_keeps_the_stars() -> None:
    """The clouds change the sky within a background tile by more than the noise."""

    def clouds(light: NDArray, _: np.random.Generator) -> None:
        y, x = np.mgrid[:960, :1280]
        light += np.where(y < 700, 40 * (1 + np.sin(x / 25) * np.sin(y / 25)), 0).astype(
            np.float32
        )

    image, _ = drawn(replace(SHOT, spoil=clouds), 4)
    plain, _ = drawn(SHOT, 4)
    seen = [
        len(plate_solver.solve_array(one, plate_solver.make_solver(22.0, None))[0].centroids)
        for one in (image, plain)
    ]
    found = diagnosis.without_clouds(image, Settings())
    assert len(found) > 1.5 * seen[0]
    assert len(diagnosis.without_clouds(plain, Settings())) == 0


def test_edges_of_trees_are_not_taken_for_the_stars_streak() -> None:
    """Bars in front of the clouds leave parallel edges, which would flag every star as a track."""

    def bars(light: NDArray, _: np.random.Generator) -> None:
        y, x = np.mgrid[:960, :1280]
        light += 40 * (1 + np.sin(x / 25) * np.sin(y / 25)).astype(np.float32)
        light[480:][:, np.arange(1280) % 40 < 30] = photographs.SKY / 4
        for at in range(35, 1280, 40):
            light[480:500, at - 2 : at + 3] += 400

    image, truth = drawn(replace(SHOT, spoil=bars), 4)
    stars = catalog.read(CATALOGS / "gaia_v8.0.ecsv")
    seen = truth.apply(catalog.at_epoch(stars, 2020))
    bright = (seen[:, 2] > 0.9) & (stars.v_mag < SHOT.limit_mag - 1.5)
    xy_px = SHOT.camera.pixels(seen[bright])
    xy_px = xy_px[np.all((xy_px > 20) & (xy_px < [1260, 460]), axis=1)]
    found = diagnosis.without_clouds(image, Settings())
    near = np.linalg.norm(xy_px[:, None] - found.xy_px, axis=2).min(axis=1)
    assert len(xy_px) >= 5
    assert np.mean(near < 1.0) >= 0.8


@pytest.mark.slow
@pytest.mark.parametrize("number", [29, 36])
def test_faint_trails_are_detected_along_a_streak_found_in_binned_pixels(number: int) -> None:
    """For trails that are detected in pieces, this more than doubles the number of correct centroids."""
    rng = np.random.default_rng([25, number])
    shot = photographs.trailed(rng)
    stars = catalog.read(CATALOGS / "gaia_v8.0.ecsv")
    vectors = catalog.at_epoch(stars, 2020)
    image, truth = photographs.draw(shot, stars, vectors, rng)
    seen = truth.apply(vectors)
    xy_px = shot.camera.pixels(
        seen[(seen[:, 2] > 0.9) & (stars.v_mag < shot.limit_mag + 0.5)]
    )

    def right(found: Centroids) -> int:
        off = np.linalg.norm(xy_px[:, None] - found.xy_px, axis=2)
        return int(np.count_nonzero(off.min(axis=1) < 2))

    solver = plate_solver.make_solver(shot.fov_deg, None)
    report, _ = plate_solver.solve_array(image, solver)
    assert not report.attitude.solved
    first = right(report.centroids)
    most = max(map(right, diagnosis.trails(image, Settings())))
    assert most > 2 * first
    outcome = plate_solver.solve_picture(images.ViewedImage(image), solver)
    assert photographs.is_same(outcome.report.attitude.cam_from_ref, truth)


def test_round_stars_are_not_taken_for_trails() -> None:
    image, _ = drawn(SHOT, 4)
    assert not list(diagnosis.trails(image, Settings()))


@pytest.mark.slow
def test_an_upper_half_is_solved_in_its_own_field() -> None:
    """The trackers' field is the upper half; attitude and camera refer to the whole image."""
    image, truth = drawn(replace(SHOT, fov_deg=36.0, limit_mag=5.6), 7)
    centroids = plate_solver.solve_array(image, plate_solver.make_solver(36.0, None))[
        0
    ].centroids
    upper = centroids.take(centroids.xy_px[:, 1] < 479.5)
    solver = replace(plate_solver.make_solver(None, None), upper_half=True)
    report, tracker = plate_solver.solve_array(image, solver, upper)
    assert tracker.camera.height_px == 480
    assert report.attitude.camera.height_px == 960
    assert photographs.is_same(report.attitude.cam_from_ref, truth)


def test_halves_cover_the_image_and_are_not_tried_with_few_lights() -> None:
    rng = np.random.default_rng(5)
    xy_px = np.concatenate(
        [rng.uniform([0, 0], [99, 49], (30, 2)), rng.uniform([0, 51], [99, 99], (9, 2))]
    )
    lights = Centroids(xy_px, np.full(39, 0.1), np.ones(39))
    found = list(diagnosis.halves(np.zeros((100, 100)), lights, ""))
    parts = {one.note: (one.efforts, one.centroids) for one in found}
    assert [one.note for one in found if one.upper_half] == [diagnosis.HALF.format("upper")]
    assert set(parts) == {diagnosis.HALF.format(side) for side in ("upper", "left", "right")}
    efforts, upper = parts[diagnosis.HALF.format("upper")]
    assert (efforts, len(upper)) == (diagnosis.MORE_EFFORTS, 30)
    assert (
        len(parts[diagnosis.HALF.format("left")][1])
        + len(parts[diagnosis.HALF.format("right")][1])
        == 39
    )


@pytest.mark.long
def test_lights_at_random_are_refused_in_every_part() -> None:
    blind = plate_solver.make_solver(None, None)
    for seed in range(10):
        image, _ = drawn(replace(SHOT, starless=True, spoil=photographs.trees), seed)
        assert not plate_solver.solve_picture(
            images.ViewedImage(image), blind
        ).report.attitude.solved
