"""A candidate attitude under a dome: its fit, its information and its Bayes factor."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.spatial.transform import Rotation
from scipy.special import betaln

from estimator.attitude.dome_map import LedMap, Lever, project
from estimator.core.camera import Camera
from estimator.core.checks import Floats
from estimator.identification import led_detections, led_evidence
from estimator.identification.led_detections import LedDetections
from estimator.identification.led_index import DomeIndex, build_dome_index
from tests.helpers.interpreted import interpreted

CAMERA = Camera(1600, 1200, 8698.0, (799.5, 599.5))
LEVER = Lever(np.array([0.0, 0.0, 0.381]), Rotation.identity())
# Six LEDs near the apex of a flat panel, in no regular pattern.
PLACES_M = np.array(
    [[0, 0], [0.03, 0.01], [-0.02, 0.03], [0.04, -0.03], [-0.05, -0.02], [-0.01, -0.04]]
)


@pytest.mark.slow
@pytest.mark.parametrize(
    ("boards", "second", "further"),
    [
        ([0, 0, 0, 0, 0, 0], 1, 4),
        ([0, 0, 0, 1, 1, 1], 2, 2),
        ([0, 0, 1, 1, 2, 2], 3, 0),
        ([0, 1, 2, 3, 3, 3], 1, 1),
    ],
)
def test_matches_on_one_board_count_little(
    boards: list[int], second: int, further: int
) -> None:
    """A board's first match counts in full, log10(1 / (2 pi sigma^2 rho)), its second 1, each further one 0.3.

    All detections are exact, so that every match that counts in full counts the same.
    """
    place_m = np.column_stack([PLACES_M, np.full(6, 1.2192)])
    leds = LedMap(np.arange(6), place_m, np.zeros(3), np.array([np.inf, np.inf, 1.2192]))
    dome = build_dome_index(leds, LEVER, CAMERA)
    sigma = 0.2 / CAMERA.focal_px
    rays = CAMERA.rays(project(Rotation.identity(), place_m, LEVER, CAMERA))
    detections = led_detections.build_detections(rays, np.full(6, sigma), dome)._replace(
        sigma=np.full(6, sigma)
    )
    boarded = dome._replace(pairs=dome.pairs._replace(group=np.array(boards)))
    apart = dome._replace(pairs=dome.pairs._replace(group=np.arange(6)))
    found = [
        led_evidence.evaluate(detections, index, np.eye(3), 0, 0, 3)
        for index in (apart, boarded)
    ]
    assert [len(hypothesis.star) for hypothesis in found] == [6, 6]
    area = CAMERA.width_px * CAMERA.height_px / CAMERA.focal_px**2
    in_full = np.log10(area / 6 / (2 * np.pi * sigma**2))
    lost = second * (in_full - 1.0) + further * (in_full - 0.3)
    assert found[0].dex - found[1].dex == pytest.approx(lost, abs=1e-6)


WIDE = Camera(1600, 1200, 900.0, (799.5, 599.5))
ASIDE = Lever(
    np.array([0.1, -0.05, 0.3]), Rotation.from_euler("xyz", [4, -3, 20], degrees=True)
)


def wide_field(level_from_lab: Rotation) -> tuple[DomeIndex, LedDetections, Floats]:
    """LEDs on a panel in a field of 83 deg, seen exactly by a camera beside the bearing; and R_cam_from_lab."""
    place_m = np.column_stack([4 * PLACES_M, 1.2 + 3 * PLACES_M[:, 0]])
    leds = LedMap(np.arange(6), place_m, np.zeros(3), np.array([np.inf, np.inf, 1.2]))
    dome = build_dome_index(leds, ASIDE, WIDE)
    rays = WIDE.rays(project(level_from_lab, place_m, ASIDE, WIDE))
    sigma = np.full(6, 0.01)
    R_cam_from_lab = (ASIDE.cam_from_body * level_from_lab).as_matrix()
    return (
        dome,
        led_detections.build_detections(rays, sigma, dome)._replace(sigma=sigma),
        R_cam_from_lab,
    )


@pytest.mark.slow
@pytest.mark.parametrize("axis", [(1, 0, 0), (0, 1, 0), (0, 0, 1), (0.5, -0.7, 0.5)])
def test_two_iterations_of_the_attitude_reach_the_truth(
    axis: tuple[float, float, float],
) -> None:
    """Gauss-Newton of exact detections squares the error: 0.5 deg, some 1e-4 rad, below 1e-6 rad."""
    dome, detections, R_cam_from_lab = wide_field(
        Rotation.from_euler("xyz", [5, -8, 30], degrees=True)
    )
    off = Rotation.from_rotvec(np.radians(0.5) * np.array(axis)).as_matrix() @ R_cam_from_lab
    hypothesis = led_evidence.evaluate(detections, dome, off, 0, 0, 3)
    assert len(hypothesis.star) == 6
    error = Rotation.from_matrix(hypothesis.R_cam_from_lab @ R_cam_from_lab.T).magnitude()
    assert error < 1e-6


@pytest.mark.parametrize("uncertainty", [0.0, 0.1])
def test_the_information_matches_the_projection_s_derivatives(uncertainty: float) -> None:
    """J' J / sigma^2, J the tangents' derivatives by a rotation of the camera about the bearing, by differences.

    And by the logarithm of the focal length, if that is uncertain.
    """
    dome, detections, R_cam_from_lab = wide_field(
        Rotation.from_euler("xyz", [5, -8, 30], degrees=True)
    )
    rows = np.arange(6)
    step = 1e-6

    def tangents(change: Floats) -> Floats:
        q = (
            dome.position_m
            @ (Rotation.from_rotvec(change[:3]).as_matrix() @ R_cam_from_lab).T
            - dome.pupil_m
        )
        return 1.07 * np.exp(change[3]) * (q[:, :2] / q[:, 2:]).ravel()

    unknowns = np.eye(4)[: 4 if uncertainty else 3]
    slopes = np.array(
        [(tangents(step * e) - tangents(-step * e)) / (2 * step) for e in unknowns]
    )
    detections = detections._replace(focal_uncertainty=uncertainty)
    info, _ = led_evidence._fit(detections, dome, R_cam_from_lab.copy(), 1.07, rows, rows)
    np.testing.assert_allclose(
        info, slopes @ slopes.T / 0.01**2, rtol=0, atol=1e-7 * np.abs(info).max()
    )


@pytest.mark.slow
def test_two_iterations_of_attitude_and_focal_length_reach_the_truth() -> None:
    """Tangents of a lens 8 % longer than assumed; the start is 0.3 deg and 1 % off."""
    dome, detections, R_cam_from_lab = wide_field(
        Rotation.from_euler("xyz", [5, -8, 30], degrees=True)
    )
    zoomed = detections._replace(tangent=1.08 * detections.tangent, focal_uncertainty=0.1)
    off = Rotation.from_rotvec(np.radians([0.2, -0.1, 0.2])).as_matrix() @ R_cam_from_lab
    hypothesis = led_evidence.evaluate(zoomed, dome, off, 0, 0, 3, 1.07)
    assert len(hypothesis.star) == 6
    assert (
        Rotation.from_matrix(hypothesis.R_cam_from_lab @ R_cam_from_lab.T).magnitude() < 1e-5
    )
    beyond = zoomed._replace(focal_uncertainty=0.05)  # to 6 % at most
    assert led_evidence.evaluate(beyond, dome, off.copy(), 0, 0, 3, 1.07).dex == -np.inf


@pytest.mark.slow
@pytest.mark.parametrize(("sigmas", "matched"), [(3.0, 6), (-3.0, 6), (8.0, 0)])
def test_leds_are_matched_within_the_error_of_their_pair_s_direction(
    sigmas: float, matched: int
) -> None:
    """Two detections of error sigma, s apart, give the roll about their middle to sqrt(2) sigma / s.

    At 3 standard deviations of the roll all LEDs are within 3.5 of their own places. At 8 the pair itself is not:
    each is 0.5 s from the middle, 5.7 sigma from its place, where the gate is 3.5 sqrt(1 + 1 / 2 + 1 / 2) sigma.
    """
    place_m = np.array(
        [
            [0.015, 0],
            [-0.015, 0],
            [0.04, 0.03],
            [-0.03, 0.045],
            [-0.045, -0.03],
            [0.03, -0.04],
        ]
    )
    place_m = np.column_stack([place_m, np.full(6, 1.2192)])
    leds = LedMap(np.arange(6), place_m, np.zeros(3), np.array([np.inf, np.inf, 1.2192]))
    dome = build_dome_index(leds, LEVER, CAMERA)
    sigma = 0.2 / CAMERA.focal_px
    rays = CAMERA.rays(project(Rotation.identity(), place_m, LEVER, CAMERA))
    detections = led_detections.build_detections(rays, np.full(6, sigma), dome)._replace(
        sigma=np.full(6, sigma)
    )
    apart = 0.03 / (1.2192 - 0.381)
    rolled = Rotation.from_euler("z", sigmas * np.sqrt(2) * sigma / apart).as_matrix()
    hypothesis = led_evidence.evaluate(detections, dome, rolled, 0, 0, 1)
    assert len(hypothesis.star) == matched
    assert np.isfinite(hypothesis.dex) == (matched > 0)


@pytest.mark.parametrize("dead", [[], [1], [1, 4], [0, 2, 5]])
def test_dead_leds_cost_the_beta_function_of_the_counts(dead: list[int]) -> None:
    """Against the same frame on a dome without these LEDs, by the interpreter; the rest are matched all the same."""
    plain = interpreted("estimator.identification.led_evidence")
    place_m = np.column_stack(
        [np.vstack([PLACES_M, [[0.02, 0.045], [0.06, 0.02]]]), np.full(8, 1.2192)]
    )
    kept = np.setdiff1d(np.arange(8), dead)
    dex = []
    surface = (np.zeros(3), np.array([np.inf, np.inf, 1.2192]))
    rays = CAMERA.rays(project(Rotation.identity(), place_m[kept], LEVER, CAMERA))
    for rows in (np.arange(8), kept):
        dome = build_dome_index(LedMap(rows, place_m[rows], *surface), LEVER, CAMERA)
        dome = dome._replace(prior_volume=1.0)
        sigma = np.full(len(kept), 0.2 / CAMERA.focal_px)
        detections = led_detections.build_detections(rays, sigma, dome)._replace(sigma=sigma)
        center = int(np.flatnonzero(rows == 3)[0])
        hypothesis = plain.evaluate(detections, dome, np.eye(3), center, 0, len(kept) - 1)
        assert sorted(hypothesis.observed) == list(range(len(kept)))
        np.testing.assert_array_equal(rows[hypothesis.star], kept[hypothesis.observed])
        dex.append(hypothesis.dex)
    toll = (betaln(len(kept) + 1, len(dead) + 1) - betaln(len(kept) + 1, 1)) / np.log(10)
    assert dex[0] - dex[1] == pytest.approx(toll, abs=1e-9)
