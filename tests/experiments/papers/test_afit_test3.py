"""AFIT's Test 3 reproduced: figures against the thesis's calibration and hand calculations."""

from __future__ import annotations

import numpy as np
import pytest
from scipy import stats

from estimator.calibration.home_position import Sighting, calibrate
from skysim.experiments.papers.afit import test3, test3_attitude
from skysim.experiments.papers.afit.test3 import (
    IMU_DEG,
    build_test3,
    lab_from_body,
    measure,
    photograph,
)
from skysim.experiments.papers.compare import prediction_interval
from skysim.experiments.papers.published import experiments
from skysim.simulation.lab import Lab
from skysim.tracking import onboard_model


@pytest.fixture(scope="module")
def lab() -> Lab:
    return build_test3()


@pytest.fixture(scope="module")
def sightings(lab: Lab) -> list[Sighting]:
    """Two images at each position, with a small IMU error at the last."""
    seen = test3.photograph_positions(lab, 2, np.random.default_rng(70))
    return test3.ImageSeries(lab, seen).sightings


def test_every_position_shows_all_five_leds(sightings: list[Sighting]) -> None:
    assert [one.stop for one in sightings] == [0, 0, 1, 1, 2, 2, 3, 3, 4, 4]


def test_the_epsilons_match_the_thesis_s_calibration(
    lab: Lab, sightings: list[Sighting]
) -> None:
    measurements = measure(lab, sightings)
    believed = onboard_model.assumed_dome(lab.scene, lab.scene.light, lab.camera.sources)  # type: ignore[arg-type]
    lever = onboard_model.assumed_lever(lab.scene, lab.camera.mount)
    calibration = calibrate(
        sightings, onboard_model.calibration(lab.scene.camera), believed, lever
    )
    found = [
        test3.largest_std(measurements.magnitude),
        test3.largest_std(measurements.lab_m.reshape(len(sightings), -1)),
        np.radians(test3.largest_std(measurements.separation_arcsec) / 3600),
    ]
    # The thesis divides by n - 1, ours by n: most of the spread is what differs between positions.
    theirs = np.array(
        [calibration.epsilon_mag, calibration.epsilon_pos_m, calibration.epsilon_sep_rad]
    )
    np.testing.assert_allclose(found, theirs * np.sqrt(1 - 1 / len(sightings)), rtol=1e-9)


def test_an_imu_error_at_one_of_five_stops_spreads_a_position_by_two_fifths(
    lab: Lab, sightings: list[Sighting]
) -> None:
    """A shift d of one in five: sd = d sqrt(1/5 4/5), 48 in times the IMU's .239 deg (Table 14); n - 1 aside."""
    shift_mm = 48 * 25.4 * np.radians(0.239)
    expected = shift_mm * np.sqrt(0.2 * 0.8) * np.sqrt(10 / 9)
    bumped = test3.ImageSeries(lab, sightings).bumped(test3.BUMPED_POSITION)
    x_mm = bumped.lab_m[:, :, 0] * 1e3
    # What eq. 44 leaves between the positions without a bump, 0.1 mm, is in it.
    np.testing.assert_allclose(x_mm.std(axis=0, ddof=1).mean(), expected, rtol=0.05)


@pytest.mark.long
def test_the_fitted_positions_are_table_8_s_with_an_8_mm_cross(lab: Lab) -> None:
    place_m = test3.fit_positions(lab)
    rows = experiments()["afit-table-6-9"].rows
    published = [rows[f"separation_{n}"].published for n in range(1, 11)]
    assert np.abs(np.sort(test3.expected_angles_arcsec(lab, place_m)) - published).max() < 1
    arms_mm = np.linalg.norm(place_m[1:, :2], axis=1) * 1e3
    assert np.abs(arms_mm - 8).max() < 0.25  # set by hand


def test_intervals_resample_images_within_positions_not_positions(
    lab: Lab, sightings: list[Sighting]
) -> None:
    """What differs between positions alone has no interval."""
    measurements = measure(lab, sightings)
    values = measurements.position[:, None].astype(float)
    found = test3.stratified_bootstrap(measurements, values, test3.mean)
    assert found[:3] == (2.0, 2.0, 2.0)


def test_a_new_draw_is_in_its_interval_as_often_as_stated() -> None:
    draws = np.random.default_rng(71).standard_normal((4000, 5))
    inside = 0
    for row in draws:
        one = prediction_interval(row[:-1])
        inside += one.low < row[-1] < one.high
    low, high = stats.binom.ppf([5e-5, 1 - 5e-5], len(draws), 0.95)
    assert low <= inside <= high


@pytest.mark.long
def test_an_image_against_the_catalog_of_itself_is_not_turned_at_all(lab: Lab) -> None:
    """Reference 1.2, item 14: the thesis has .0335 deg there."""
    found = test3_attitude.algorithm_errors(lab, 1, 2, np.random.default_rng(72))
    assert np.abs(found.error_deg[:, 0]).max() < 1e-9
    assert found.named == (5, 5)
    assert np.abs(found.error_deg[:, 1:, :2]).max() < 0.02  # the error of eq. 44


@pytest.mark.slow
def test_an_imu_drifts_by_the_earth_s_rate() -> None:
    """15.04 deg/h: north by the cosine of 39.8 deg of latitude along x, up by its sine along z; t from home."""
    units = 40
    off = test3_attitude.imu_drift(1.0, units, np.random.default_rng(73))
    latitude = np.radians(39.8)
    hours = np.arange(1, 5) / 60
    expected = 15.041 * np.outer(hours, [np.cos(latitude), 0, np.sin(latitude)])
    # The way between positions takes some seconds more, a twentieth; the lean of 3 deg mixes axes by as much.
    error = off.std(axis=0, ddof=1)[1:] / np.sqrt(units)
    assert np.all(
        np.abs(off.mean(axis=0)[1:] - expected)
        < 4 * error + 0.1 * np.abs(expected).max(axis=1)[:, None]
    )
    assert np.abs(off[:, 0]).max() < 1e-12


@pytest.mark.long
def test_gyros_lose_only_the_rate_beyond_their_limit() -> None:
    calm = test3_attitude.simulate_bump(None, 74)
    knocked = test3_attitude.simulate_bump(test3_attitude.FITTED_BUMP, 74)
    assert calm.saturated_s == 0
    assert 0.15 < knocked.saturated_s < 0.25  # caught after 0.2 s
    lost = np.abs(knocked.imu_deg[-1] - calm.imu_deg[-1])
    assert lost[0] < 0.03 < lost[1] < lost[2]
    # No more than the excess of (12.1, 15) deg/s over 10 for as long as it stood at the limit.
    assert lost[1] < 2.1 * knocked.saturated_s
    assert lost[2] < 5.0 * knocked.saturated_s
    assert test3_attitude.filter_errors_after(knocked).max() < 0.01


def test_the_vehicle_has_the_tables_attitudes() -> None:
    for angles in IMU_DEG:
        np.testing.assert_allclose(
            lab_from_body(angles).as_euler("ZYX", degrees=True)[::-1],
            angles,
            rtol=0,
            atol=1e-12,
        )


def test_the_same_seed_gives_the_same_images(lab: Lab) -> None:
    first, again = (
        photograph(lab, 0, lab_from_body(IMU_DEG[0]), 1, np.random.default_rng(75))[0].xy_px
        for _ in range(2)
    )
    np.testing.assert_array_equal(first, again)
