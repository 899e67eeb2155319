"""Pictures of which a part, or what is left without the clouds, is the sky."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from benchmarks import photographs
from estimator.catalog import catalog
from estimator.core.types import Centroids
from estimator.trackers.pipeline import Settings
from skysim.apps import plate_solver
from skysim.apps.plate_solver import retries
from skysim.core.io import images
from skysim.core.paths import CATALOGS

SHOT = photographs.Shot(1280, 960, 22.0, 6.3)


def drawn(shot: photographs.Shot, seed: int) -> tuple[NDArray, Rotation]:
    stars = catalog.read(CATALOGS / "gaia_v8.0.ecsv")
    return photographs.draw(shot, stars, catalog.at_epoch(stars, 2020), np.random.default_rng(seed))


def town(light: NDArray, rng: np.random.Generator) -> None:
    """The lower half is a town at night, with 60 lamps."""
    light[480:] = photographs.SKY
    for x, y in rng.uniform([5, 485], [1275, 955], (60, 2)):
        photographs.add_star(light, x, y, 10 ** rng.uniform(3.3, 4.3), 1.1, 0.0, (0.0, 0.0))


def test_a_picture_with_a_town_below_is_solved_by_its_upper_half() -> None:
    image, truth = drawn(replace(SHOT, limit_mag=5.4, spoil=town), 3)
    solver = plate_solver.make_solver(SHOT.fov_deg, None)
    assert not plate_solver.solve_array(image, solver, None)[0].attitude.solved
    outcome = plate_solver.solve_picture(images.Picture(image), solver, None)
    assert photographs.is_same(outcome.report.attitude.cam_from_ref, truth)
    assert plate_solver.outcome_fields(outcome, None)["hint"] == "its stars were found in its upper half alone"
    assert (outcome.report.centroids.xy_px[:, 1] < 480).all()


def test_clouds_are_taken_away_and_stars_stay() -> None:
    """The clouds change the sky by more than the noise within a tile of the background."""

    def clouds(light: NDArray, _: np.random.Generator) -> None:
        y, x = np.mgrid[:960, :1280]
        light += np.where(y < 700, 40 * (1 + np.sin(x / 25) * np.sin(y / 25)), 0).astype(np.float32)

    image, _ = drawn(replace(SHOT, spoil=clouds), 4)
    plain, _ = drawn(SHOT, 4)
    seen = [
        len(plate_solver.solve_array(one, plate_solver.make_solver(22.0, None), None)[0].centroids)
        for one in (image, plain)
    ]
    found = retries.without_clouds(image, Settings())
    assert len(found) > 1.5 * seen[0]
    assert len(retries.without_clouds(plain, Settings())) == 0


def test_halves_are_complete_and_not_tried_with_few_lights() -> None:
    rng = np.random.default_rng(5)
    xy_px = np.concatenate([rng.uniform([0, 0], [99, 49], (30, 2)), rng.uniform([0, 51], [99, 99], (9, 2))])
    lights = Centroids(xy_px, np.full(39, 0.1), np.ones(39))
    parts = {note: (efforts, part) for note, efforts, part in retries.halves(np.zeros((100, 100)), lights, "")}
    assert set(parts) == {retries.HALF.format(side) for side in ("upper", "left", "right")}
    efforts, upper = parts[retries.HALF.format("upper")]
    assert (efforts, len(upper)) == (retries.MORE_EFFORTS, 30)
    assert len(parts[retries.HALF.format("left")][1]) + len(parts[retries.HALF.format("right")][1]) == 39


@pytest.mark.slow
def test_lights_at_random_are_refused_in_every_part() -> None:
    blind = plate_solver.make_solver(None, None)
    for seed in range(10):
        image, _ = drawn(replace(SHOT, starless=True, spoil=photographs.trees), seed)
        assert not plate_solver.solve_picture(images.Picture(image), blind, None).report.attitude.solved
