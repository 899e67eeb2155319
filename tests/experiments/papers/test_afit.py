"""AFIT's LED tests: angles, magnitudes and thresholds against geometry, arithmetic and the sum of pulses."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from skysim.core.constants import INCH_M
from skysim.experiments.papers.afit import afit_surface, led_tests, test1, test2
from skysim.experiments.papers.afit.test2 import PAIR_M, BoardPlace, geometric_angle_arcsec
from skysim.experiments.papers.afit.test_stand import (
    build_test_stand,
    gray_levels,
    measure_lights,
    render_at_attitude,
    separations_arcsec,
)
from skysim.experiments.papers.compare import confidence_interval
from skysim.experiments.tracker_comparison import with_config
from skysim.scene.loader import load
from skysim.simulation.lab import Lab

R_M = 48 * INCH_M
M_M = 15 * INCH_M


@pytest.fixture(scope="module")
def pair() -> Lab:
    return build_test_stand(test2.scene(0.3))


def test_the_angle_of_a_pair_at_the_apex_follows_eq_45(pair: Lab) -> None:
    """y is half the pair, x the root of (R - M)^2 - y^2; the camera's M is added: an angle about the bearing."""
    y = PAIR_M / 2
    angle = 2 * np.arctan(y / (np.sqrt((R_M - M_M) ** 2 - y**2) + M_M))
    assert geometric_angle_arcsec(pair, BoardPlace(0.0)) == pytest.approx(
        np.degrees(angle) * 3600, abs=1e-3
    )


def test_a_board_that_leans_shows_the_cosine_of_its_angle(pair: Lab) -> None:
    """One LED comes nearer and the other farther, which cancels but for the square of half the pair's angle."""
    share = geometric_angle_arcsec(pair, BoardPlace(28.0, 5.0)) / geometric_angle_arcsec(
        pair, BoardPlace(28.0)
    )
    # The dome's own normal leans there by a little, so that five degrees are added to it.
    normal = test2.place_pair(pair, BoardPlace(28.0)).camera.sources.normal[0]
    crop_board = np.array([-np.sin(np.radians(28)), 0, -np.cos(np.radians(28))])
    own = np.arctan2(np.cross(crop_board, normal)[1], crop_board @ normal)
    assert share == pytest.approx(np.cos(own + np.radians(5)) / np.cos(own), abs=2e-5)


def test_a_dome_moved_away_shows_pairs_smaller_by_the_distance(pair: Lab) -> None:
    """The range from the camera grows; the pair in the image plane at R - M shrinks by as much."""
    places = [BoardPlace(28.0), BoardPlace(28.0, 0.0, 0.125)]
    camera_m = M_M * np.array([np.sin(np.radians(28)), 0, np.cos(np.radians(28))])
    pairs_m = [test2.place_pair(pair, place).camera.sources.place[:, :3] for place in places]
    range_m = [np.linalg.norm(pair_m.mean(axis=0) - camera_m) for pair_m in pairs_m]
    angle = [geometric_angle_arcsec(pair, place) for place in places]
    assert angle[1] / angle[0] == pytest.approx(range_m[0] / range_m[1], abs=5e-5)
    assert angle[1] < angle[0] - 4


def test_rendered_pairs_have_the_geometric_angle(pair: Lab) -> None:
    board = test2.place_pair(pair, BoardPlace(28.0))
    frame, truth = render_at_attitude(
        board, test2.point_at(BoardPlace(28.0)), np.random.default_rng(1)
    )
    lights = measure_lights(gray_levels(frame, board))
    assert separations_arcsec(lights.xy_px, board)[0] == pytest.approx(
        geometric_angle_arcsec(pair, BoardPlace(28.0)), abs=1.0
    )
    assert len(truth.sources.id) == 2


def test_the_rim_of_the_measured_dome_is_its_ellipse_where_it_is_62_in_wide() -> None:
    found = afit_surface.contour(test2.measured_dome(load("afit_test2_ideal")))
    rim = 48 - 28.60 + 28.60 * np.sqrt(1 - (31 / 38.88) ** 2)
    assert found["rim_z"].value == pytest.approx(rim, abs=1e-9)
    assert found["rim_rho"].value == pytest.approx(np.hypot(31, rim), abs=1e-9)
    assert found["height_by_axes"].value == pytest.approx(48 - rim, abs=1e-9)


def test_an_unseen_led_is_left_out_of_the_order() -> None:
    """Of three images one has all LEDs, falling; one lacks the last; one has two in the wrong order."""
    share = led_tests.fraction_in_order(
        np.array([[3.0, 2.0, 1.0], [3.0, 2.0, 0.0], [2.0, 3.0, 1.0]])
    )
    assert share.value == pytest.approx(1 / 3)


def test_a_magnitude_is_light_over_the_median_area() -> None:
    """Squares of one gray: four times the light has four times the magnitude, whatever the threshold adds at edges."""
    image = np.zeros((200, 300), np.uint8)
    image[20:40, 20:40] = image[20:40, 100:120] = image[100:140, 150:190] = 100
    lights = measure_lights(image)
    assert lights.magnitude / lights.magnitude[-1] == pytest.approx([4, 1, 1])
    assert lights.magnitude * np.median(lights.area_px) == pytest.approx(
        [160_000, 40_000, 40_000]
    )


def test_a_threshold_separates_leds_from_glare_and_noise() -> None:
    image = np.zeros((400, 400), np.uint8)
    image[195:206, 195:206] = 100  # an LED of 121 px
    image[200, 225:228] = 6  # glare beside it
    image[10, 10] = image[390, 390] = 6  # noise far away
    at = [
        led_tests.count_above(image, np.array([[200.0, 200.0]]), share)
        for share in (0.02, 0.10, 0.5)
    ]
    assert [(one.area_px.tolist(), one.glare_px, one.dark_px) for one in at] == [
        ([121.0], 3, 2),
        ([121.0], 0, 0),
        ([0.0], 0, 0),
    ]


def test_one_led_in_nine_is_lit_at_any_time() -> None:
    """Whatever the phase: the nine share 100 ms, and each has eleven pulses of 1 ms or a twelfth or a part of it."""
    rng = np.random.default_rng(2)
    level = Rotation.identity()
    exact = with_config(
        test1.scene_with_exposure(0.1), "light.led.clock", offset_ppm=0.0, drift_ppm_h=0.0
    )
    whole, frame = (
        build_test_stand(with_config(exact, "exposure", time_s=time_s))
        for time_s in (36e-3, 100e-3)
    )
    each_e = render_at_attitude(whole, level, rng)[
        1
    ].sources.electrons  # of four pulses, 4 ms
    for _ in range(3):
        lit_ms = 4 * render_at_attitude(frame, level, rng)[1].sources.electrons / each_e
        assert lit_ms.sum() == pytest.approx(100, abs=1e-3)
        assert lit_ms.min() > 11 - 1e-3
        assert lit_ms.max() < 12 + 1e-3


def test_a_relative_decrease_has_the_reversed_interval_of_the_mean() -> None:
    angles = np.array([96.0, 92.0, 94.0, 95.0, 93.0])
    fall = test2.relative_decrease(100.0, angles)
    mean = confidence_interval(angles)
    assert (fall.value, fall.low, fall.high) == pytest.approx(
        (6.0, 100 - mean.high, 100 - mean.low)
    )
    assert (mean.value, fall.trials) == (pytest.approx(94.0), 5)
