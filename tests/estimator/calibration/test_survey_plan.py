"""The survey's predicted errors against simulated surveys, its plan against random attitudes, and injected faults."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

import numpy as np
import pytest
from scipy.spatial.transform import Rotation
from scipy.stats import chi2

from estimator.attitude.dome_map import Lever
from estimator.calibration import survey_faults, survey_plan
from estimator.calibration.bundle_adjustment import Assumed
from estimator.calibration.dome_survey import (
    DomeFrame,
    DomeSurvey,
    survey,
)
from estimator.calibration.survey_faults import LightTable
from estimator.calibration.survey_plan import SurveyModel
from estimator.calibration.survey_subset import CONNECTING_RAD, ray_angles
from estimator.core.camera import Camera
from estimator.core.types import Centroids
from estimator.trackers.dome_tracker import SETTINGS, DomeTracker
from tests.helpers.surveyed_dome import LIST_SIGMA_M, NOISE_PX, attitudes, leds, model, pixels

LEDS = 120
FRAMES = 30
SURVEYS = 60
# of what is assumed
LEVER_SIGMA_M = 0.005
FOCAL_ERROR = 0.01


def planned(count: int, frames: int) -> tuple[SurveyModel, Rotation]:
    """A true dome and the attitudes of its plan."""
    true = model(count)
    candidates = attitudes(np.random.default_rng(1), 300)
    rows = survey_plan.choose(true, candidates, true.visible(candidates), frames)
    return true, candidates[rows]


def simulated(
    rng: np.random.Generator,
    true: SurveyModel,
    held: Rotation,
    sigma_factor: float = 1.0,
    uses_assumed: bool = False,
    change: Callable[[DomeFrame], DomeFrame] | None = None,
) -> DomeSurvey:
    """A survey of noisy pixels with errors of list, lever, lens and initial attitudes.

    sigma_factor : factor by which the noise is smaller than assumed
    uses_assumed : whether lever and focal length are measurements; the focal length then errs at random, else by 1 %
    change       : applied to each frame; the survey then uses a robust loss
    """
    frames = []
    for attitude, seen in zip(held, true.visible(held), strict=True):
        led = np.flatnonzero(seen)
        xy_px = pixels(true, true.leds.position_m[led], attitude) + rng.normal(
            0, true.sigma_px, (len(led), 2)
        )
        start = Rotation.from_rotvec(0.005 * rng.normal(size=3)) * attitude
        frames.append(
            DomeFrame(led, xy_px, np.full(len(led), sigma_factor * true.sigma_px), start)
        )
    if change:
        frames = [change(frame) for frame in frames]
    list_error_m = rng.normal(0, LIST_SIGMA_M, true.leds.position_m.shape)
    listed = replace(true.leds, position_m=true.leds.position_m + list_error_m)
    lever = Lever(
        true.lever.camera_body_m + rng.normal(0, LEVER_SIGMA_M, 3), true.lever.cam_from_body
    )
    sigma_px = FOCAL_ERROR * true.camera.focal_px
    camera = replace(
        true.camera,
        focal_px=true.camera.focal_px + sigma_px * (rng.normal() if uses_assumed else 1),
    )
    assumed = (
        Assumed(lever.camera_body_m, LEVER_SIGMA_M, camera.focal_px, sigma_px)
        if uses_assumed
        else None
    )
    return survey(
        frames,
        listed,
        lever,
        camera,
        leds_sigma_m=LIST_SIGMA_M,
        fit_noise=True,
        assumed=assumed,
    )


@pytest.mark.slow
@pytest.mark.parametrize("sigma_factor", [1.0, 3.0])
def test_surveys_have_the_predicted_errors(sigma_factor: float) -> None:
    """To 20 % for any assumed noise. The focal length has one error per survey: 9 % of scatter with 60 surveys."""
    true, held = planned(LEDS, FRAMES)
    predicted = survey_plan.predict(true, held, true.visible(held))
    rng = np.random.default_rng(2)
    squares = []
    claimed = []
    for _ in range(SURVEYS):
        found = simulated(rng, true, held, sigma_factor)
        assert (
            abs(found.surveyed.sum() - predicted.measured.sum()) <= 2
        )  # rays that hardly cross
        led_m = (found.leds.position_m - true.leds.position_m)[found.surveyed]
        lever_m = found.lever.camera_body_m - true.lever.camera_body_m
        squares.append(
            [
                np.mean(led_m**2),
                np.mean(lever_m**2),
                (found.camera.focal_px - true.camera.focal_px) ** 2,
            ]
        )
        claimed.append(
            [np.nanmean(np.einsum("nii->n", found.led_covariance_m2)) / 3, found.misfit]
        )
        assert found.noise_scale * sigma_factor == pytest.approx(1, abs=5 / np.sqrt(2 * 150))
    rms = np.sqrt(np.mean(squares, axis=0))
    lever_m = np.sqrt(np.mean(predicted.lever_sigma_m**2))
    np.testing.assert_allclose(
        rms / [predicted.led_rms_m, lever_m, predicted.lens_sigma[0]], 1, atol=0.2
    )
    led_m2, misfit = np.mean(claimed, axis=0)
    assert np.sqrt(led_m2) == pytest.approx(predicted.led_rms_m, rel=0.05)
    assert misfit == pytest.approx(1, abs=0.02)


@pytest.mark.slow
def test_the_map_s_covariance_makes_the_tracker_s_claims_true() -> None:
    """100 surveys, each with a list, lever and focal length of its own: the 95 % interval of the mean NEES contains 3.

    Most of the error is common to all lights. Without it the claims are 2.5 times too wide about the boresight (by the
    lights' distances) and too narrow across it: NEES 1.2 on this dome, 10 on a larger one.
    """
    true, held = planned(LEDS, FRAMES)
    checks = attitudes(np.random.default_rng(3), 4, 18.0)
    rng = np.random.default_rng(4)
    nees = []
    for _ in range(100):
        found = simulated(rng, true, held, uses_assumed=True)
        settings = replace(SETTINGS, centroid_sigma_px=1e-3)
        tracker = DomeTracker(found.camera, found.surveyed_leds, found.lever, settings)
        each = []
        for attitude in checks:
            xy_px = pixels(true, true.leds.position_m[found.surveyed], attitude)
            xy_px = xy_px[true.camera.contains(xy_px)]
            noisy = xy_px + rng.normal(0, true.sigma_px, xy_px.shape)
            count = len(xy_px)
            answer = tracker.solve_centroids(
                Centroids(noisy, np.full(count, true.sigma_px), np.ones(count))
            )
            assert answer.cam_from_ref is not None
            off = true.lever.cam_from_body * attitude * answer.cam_from_ref.inv()
            error_rad = off.as_rotvec()
            each.append(error_rad @ np.linalg.solve(answer.covariance_rad2, error_rad))
        nees.append(np.mean(each))
    half_width = 1.96 * np.std(nees) / 10
    assert half_width < 0.75  # it can tell 3 from 4
    assert abs(np.mean(nees) - 3) < half_width


@pytest.mark.slow
def test_with_few_frames_prior_assumptions_reduce_the_error() -> None:
    """Eight frames determine the focal length to 0.3 %, and to a seventh less with the lever and the focal length that
    are known to 5 mm and 1 % before. The survey errs by what is predicted."""
    true, held = planned(LEDS, 8)
    informed = replace(
        true, lever_sigma_m=LEVER_SIGMA_M, focal_sigma_px=FOCAL_ERROR * true.camera.focal_px
    )
    without, predicted = (
        survey_plan.predict(one, held, true.visible(held)) for one in (true, informed)
    )
    assert (predicted.lever_sigma_m < without.lever_sigma_m).all()
    assert predicted.lens_sigma[0] < 0.9 * without.lens_sigma[0]
    rng = np.random.default_rng(5)
    errors = []
    for _ in range(SURVEYS):
        found = simulated(rng, true, held, uses_assumed=True)
        lever_m = found.lever.camera_body_m - true.lever.camera_body_m
        sigma_m = np.sqrt(np.diag(found.lever_covariance_m2))
        errors.append(
            [
                *(lever_m / sigma_m),
                (found.camera.focal_px - true.camera.focal_px) / found.focal_sigma_px,
            ]
        )
        np.testing.assert_allclose(found.focal_sigma_px, predicted.lens_sigma[0], rtol=0.3)
    np.testing.assert_allclose(
        np.sqrt(np.mean(np.square(errors), axis=0)), 1, atol=4 / np.sqrt(2 * SURVEYS)
    )


@pytest.mark.slow
def test_a_plan_needs_a_third_of_the_frames_of_random_attitudes() -> None:
    """For the mean square error of all LEDs, of which those not seen keep the list's."""
    true, held = planned(200, 40)
    rng = np.random.default_rng(3)
    random = attitudes(rng, 120)
    errors = []
    for some in (held, random):
        led_m = survey_plan.predict(true, some, true.visible(some)).led_sigma_m
        errors.append(np.sqrt(np.mean(led_m**2)))
    assert errors[0] < errors[1]


@pytest.mark.slow
def test_a_plan_continues_from_the_frames_at_hand() -> None:
    """From the same candidates the next choices show LEDs outside of the first half of the dome."""
    true = model(200)
    candidates = attitudes(np.random.default_rng(4), 300)
    shown = true.visible(candidates)
    west = candidates[
        candidates.inv().apply(true.lever.cam_from_body.inv().apply([0, 0, 1.0]))[:, 0]
        < -0.15
    ]
    seen = true.visible(west)
    further = survey_plan.choose(true, candidates, shown, 10, west, seen)
    known = np.sum(seen, axis=0) >= 2
    assert np.mean(shown[further][:, ~known].sum(axis=1)) > 1.3 * np.mean(
        shown[:, ~known].sum(axis=1)
    )


NARROW = Camera(1024, 1024, 9222.0, (511.5, 511.5))  # AFIT's 35 mm lens


def narrow_dome(sigma_px: float = NOISE_PX) -> SurveyModel:
    """A dense dome under a narrow field, as AFIT's: two attitudes that share LEDs see them in nearly one direction."""
    return replace(model(1400), camera=NARROW, leds=leds(1400, 20.0), sigma_px=sigma_px)


def test_planned_attitudes_are_connected_by_rays_that_cross() -> None:
    """Otherwise the adjustment would leave out frames that the plan counts on."""
    true = narrow_dome()
    candidates = attitudes(np.random.default_rng(3), 1000, 20.0)
    held = candidates[survey_plan.choose(true, candidates, true.visible(candidates), 12)]
    seen = true.visible(held)
    camera_m = held.inv().apply(true.lever.camera_body_m)
    for k in range(1, len(held)):
        angle_rad = ray_angles(true.leds.position_m, camera_m, *np.nonzero(seen[: k + 1]))
        connecting = seen[k] & seen[:k].any(axis=0) & (angle_rad > CONNECTING_RAD)
        assert connecting.sum() >= survey_plan.MIN_SHARED


def test_an_attitude_is_planned_once() -> None:
    """A repetition would reduce the noise, but no ray of it crosses another one."""
    true = narrow_dome()
    candidates = attitudes(np.random.default_rng(3), 40, 20.0)
    rows = survey_plan.choose(true, candidates, true.visible(candidates), 60)
    assert len(rows) == len(set(rows)) > 12


@pytest.mark.parametrize(("arm_m", "least"), [(0.1, 20), (0.15, 25), (0.2, 15)])
def test_a_plan_with_a_short_lever_still_connects_its_attitudes(
    arm_m: float, least: int
) -> None:
    """Few rays cross, so the requested number is not reached; LEDs that are only shared are used instead."""
    camera = Camera(640, 480, 2500.0, (319.5, 239.5))
    true = replace(model(400), camera=camera, lever_sigma_m=0.005, focal_sigma_px=9.0)
    true = replace(true, lever=replace(true.lever, camera_body_m=np.array([0.0, 0.0, arm_m])))
    candidates = attitudes(np.random.default_rng(3), 300)
    shown = true.visible(candidates)
    rows = survey_plan.choose(true, candidates, shown, 12)
    assert survey_plan.predict(true, candidates[rows], shown[rows]).measured.sum() >= least


@pytest.mark.slow
@pytest.mark.parametrize("seed", [0, 2])
def test_one_wrong_light_in_a_hundred_does_not_bias_a_survey(seed: int) -> None:
    """A light 80 px off, as a neighbor of the LED that it is taken for, is as far off as four errors of the list.

    Weighted by the noise of 0.02 px alone, it would be fitted by a lever 90 mm off, and the right ones be rejected.
    """
    true = narrow_dome(0.02)
    rng = np.random.default_rng(seed)
    candidates = attitudes(np.random.default_rng(1), 1000, 20.0)
    held = candidates[survey_plan.choose(true, candidates, true.visible(candidates), 12)]

    def moved(frame: DomeFrame) -> DomeFrame:
        wrong = rng.random((len(frame.led), 1)) < 0.01
        direction = rng.normal(size=(len(frame.led), 2))
        off_px = 80 * direction / np.linalg.norm(direction, axis=1, keepdims=True)
        return replace(frame, xy_px=frame.xy_px + wrong * off_px)

    found = simulated(rng, true, held, uses_assumed=True, change=moved)
    error_m = (found.leds.position_m - true.leds.position_m)[found.surveyed]
    sigma_m = np.sqrt(np.einsum("nii->n", found.led_covariance_m2[found.surveyed]) / 3)
    assert found.surveyed.sum() > 75
    assert 0.5 < np.sqrt(np.mean(error_m**2) / np.mean(sigma_m**2)) < 1.5
    lever_m = found.lever.camera_body_m - true.lever.camera_body_m
    assert (np.abs(lever_m) < 3 * np.sqrt(np.diag(found.lever_covariance_m2))).all()
    assert found.misfit == pytest.approx(1, abs=0.05)


# --- false alarms -------------------------------------------------------------------------------------------


@pytest.mark.slow
def test_a_dome_without_a_fault_gives_few_alarms() -> None:
    """One in a thousand surveys of each kind by design: 0.4 of 400, 5 by chance once in 16,000."""
    rng = np.random.default_rng(5)
    alarms = np.zeros(2)
    covariance = np.tile(0.01 * np.eye(3), (300, 1, 1))
    for _ in range(400):
        listed = rng.normal(0, 1, (300, 3))
        found = listed + np.sqrt(1.01) * rng.normal(0, 1, (300, 3))
        alarms[0] += len(survey_faults.displaced(listed, found, covariance)[0]) > 0
        shown = rng.random((12, 300)) < 0.3
        alarms[1] += (
            len(survey_faults.dark(shown, shown & (rng.random((12, 300)) < 0.97))) > 0
        )
    assert (alarms <= 4).all()


@pytest.mark.slow
def test_leds_in_the_right_order_are_not_reported_as_exchanged() -> None:
    """LEDs that scatter by 8 % in four levels, 300 surveys of 100 of them: none."""
    rng = np.random.default_rng(6)
    alarms = 0
    for _ in range(300):
        levels = np.array([1.0, 0.7, 0.5, 0.35])[rng.integers(0, 4, 100)]
        light = levels * np.exp(
            0.08 * rng.normal(size=100) + 0.02 * rng.normal(size=(8, 100))
        )
        alarms += len(
            survey_faults.exchanged(
                LightTable(light, np.ones((8, 100), bool), np.tile(levels, (8, 1)))
            )[0]
        )
    assert alarms == 0


def test_a_dead_led_among_many_is_found_by_four_frames() -> None:
    rng = np.random.default_rng(7)
    shown = np.zeros((40, 600), dtype=bool)
    for led in range(600):
        shown[rng.permutation(40)[:4], led] = True
    seen = shown & (rng.random(shown.shape) < 0.995)
    seen[:, [17, 401]] = False
    assert survey_faults.dark(shown, seen).tolist() == [17, 401]


def test_codes_reveal_exchanged_leds_of_equal_brightness() -> None:
    """Words of on and off that differ in half of the frames; two pairs at once, and a cycle of three."""
    rng = np.random.default_rng(8)
    words = rng.integers(0, 2, (60, 30)).T.astype(float)
    truth = np.arange(60)
    truth[[3, 9]] = [9, 3]
    truth[[20, 30, 40]] = [30, 40, 20]
    on = words[:, truth] > 0
    light = np.where(
        on, np.exp(0.08 * rng.normal(size=60) + 0.03 * rng.normal(size=on.shape)), np.nan
    )
    table = LightTable(light, np.ones_like(on), words)
    found, observable = survey_faults.exchanged(table)
    assert {(one.led, one.shows) for one in found} == {
        (3, 9),
        (9, 3),
        (20, 30),
        (30, 40),
        (40, 20),
    }
    assert all(one.or_any_of == () for one in found)
    assert observable > 0.8


def test_the_median_of_chi_square_matches_scipy() -> None:
    assert pytest.approx(chi2.median(3), abs=1e-3) == survey_faults.CHI2_MEDIAN
