"""The Bayes factor of a candidate attitude under a dome: matches on one patch board are not independent."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from estimator.attitude.dome_map import LedMap, Lever, project
from estimator.core.camera import Camera
from estimator.identification.leds import evidence, search
from estimator.identification.leds.index import build_dome_index

CAMERA = Camera(1600, 1200, 8698.0, (799.5, 599.5))
LEVER = Lever(np.array([0.0, 0.0, 0.381]), Rotation.identity())
# Six LEDs near the apex of a flat panel, in no regular pattern.
PLACES_M = np.array([[0, 0], [0.03, 0.01], [-0.02, 0.03], [0.04, -0.03], [-0.05, -0.02], [-0.01, -0.04]])


@pytest.mark.parametrize(
    ("boards", "second", "further"),
    [([0, 0, 0, 0, 0, 0], 1, 4), ([0, 0, 0, 1, 1, 1], 2, 2), ([0, 0, 1, 1, 2, 2], 3, 0), ([0, 1, 2, 3, 3, 3], 1, 1)],
)
def test_matches_on_one_board_count_little(boards: list[int], second: int, further: int) -> None:
    """A board's first match counts in full, log10(1 / (2 pi sigma^2 rho)), its second 1, each further one 0.3.

    All detections are exact, so that every match that counts in full counts the same.
    """
    place_m = np.column_stack([PLACES_M, np.full(6, 1.2192)])
    leds = LedMap(np.arange(6), place_m, np.zeros(3), np.array([np.inf, np.inf, 1.2192]))
    dome = build_dome_index(leds, LEVER, CAMERA)
    sigma = 0.2 / CAMERA.focal_px
    rays = CAMERA.rays(project(Rotation.identity(), place_m, LEVER, CAMERA))
    detections = search.build_detections(rays, np.full(6, sigma), dome)._replace(sigma=np.full(6, sigma))
    boarded = dome._replace(pairs=dome.pairs._replace(group=np.array(boards)))
    apart = dome._replace(pairs=dome.pairs._replace(group=np.arange(6)))
    found = [evidence.evaluate(detections, index, np.eye(3), 0, 0, 3) for index in (apart, boarded)]
    assert [len(hypothesis.star) for hypothesis in found] == [6, 6]
    area = CAMERA.width_px * CAMERA.height_px / CAMERA.focal_px**2
    in_full = np.log10(area / 6 / (2 * np.pi * sigma**2))
    lost = second * (in_full - 1.0) + further * (in_full - 0.3)
    assert found[0].dex - found[1].dex == pytest.approx(lost, abs=1e-6)
