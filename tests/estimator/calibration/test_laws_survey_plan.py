"""Laws of the survey's plan and of the detection of faults."""

from __future__ import annotations

import itertools
from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as some
from scipy import stats
from scipy.spatial.transform import Rotation

from estimator.calibration import (
    survey_faults,
    survey_plan,
    survey_subset,
)
from estimator.calibration.bundle_adjustment import Bundle
from estimator.calibration.survey_faults import HeldFrames, LightTable
from estimator.calibration.survey_plan import SurveyAccuracy, SurveyModel
from estimator.core.camera import Camera
from tests.helpers.laws import SEEDS, answered, law
from tests.helpers.surveyed_dome import attitudes, model, pixels


@law(
    *(
        survey_plan.predict,
        survey_plan.measurable,
        SurveyAccuracy.led_rms_m,
        SurveyModel.visible,
        survey_subset.covariance,
        survey_subset.connected_subset,
    ),
    slow=True,
)
@given(rng=SEEDS, factor=some.floats(0.1, 10))
def test_predicted_errors_grow_with_noise_and_list_errors_and_shrink_with_frames(
    rng: np.random.Generator, factor: float
) -> None:
    assumed = model(50)
    held = attitudes(rng, 30)
    seen = assumed.visible(held)
    first = answered(lambda: survey_plan.predict(assumed, held[:25], seen[:25]))
    larger = replace(
        assumed,
        sigma_px=factor * assumed.sigma_px,
        leds_sigma_m=factor * assumed.leds_sigma_m,
    )
    scaled = answered(lambda: survey_plan.predict(larger, held[:25], seen[:25]))
    every = answered(lambda: survey_plan.predict(assumed, held, seen))
    if first is None or every is None or scaled is None:
        return
    np.testing.assert_array_equal(first.measured, scaled.measured)
    countable = survey_plan.measurable(larger, held[:25], seen[:25])
    np.testing.assert_array_equal(countable, first.measured)
    assert not survey_plan.measurable(larger, held[:1], seen[:1]).any()
    np.testing.assert_allclose(scaled.led_sigma_m, factor * first.led_sigma_m, rtol=1e-6)
    np.testing.assert_allclose(scaled.lens_sigma, factor * first.lens_sigma, rtol=1e-6)
    assert (every.led_sigma_m <= first.led_sigma_m * (1 + 1e-9)).all()
    assert (every.lever_sigma_m <= first.lever_sigma_m * (1 + 1e-9)).all()
    assert 0 < every.led_rms_m <= assumed.leds_sigma_m
    assert not seen[:, ~every.measured].sum(axis=0).max(initial=0) > len(held)


@law(SurveyModel.assumed, slow=True)
@given(rng=SEEDS, lever_sigma_m=some.floats(1e-6, 1e-3))
def test_what_is_known_of_the_lever_and_the_lens_is_not_lost(
    rng: np.random.Generator, lever_sigma_m: float
) -> None:
    """The prior has the model's values, and a survey knows both at least as well as its prior."""
    known = replace(model(50), lever_sigma_m=lever_sigma_m, focal_sigma_px=0.1)
    prior = known.assumed
    start = Bundle.start(known.leds, known.lever, known.camera, Rotation.identity(1), False)
    assert not prior.less(start).any()
    held = attitudes(rng, 25)
    found = answered(lambda: survey_plan.predict(known, held, known.visible(held)))
    if found is None:
        return
    assert (found.lever_sigma_m <= prior.lever_sigma_m * (1 + 1e-9)).all()
    assert found.lens_sigma[0] <= prior.focal_sigma_px * (1 + 1e-9)


@law(survey_plan.choose)
@given(rng=SEEDS, count=some.integers(1, 12))
def test_a_longer_plan_extends_a_shorter_one(rng: np.random.Generator, count: int) -> None:
    assumed = model(80)
    candidates = attitudes(rng, 60)
    shown = assumed.visible(candidates)
    plan = survey_plan.choose(assumed, candidates, shown, 12)
    assert survey_plan.choose(assumed, candidates, shown, count) == plan[:count]
    covered = shown[plan[0]]
    for row in plan[1:]:
        reachable = (shown & covered).sum(axis=1)
        assert reachable[row] >= min(survey_plan.LEAST_CROSSING, reachable.max())
        covered = covered | shown[row]
    assert (
        answered(lambda: survey_plan.choose(assumed, candidates, shown[:, :-1], count))
        is None
    )


@law(survey_subset.ray_angles)
@given(rng=SEEDS, half_rad=some.floats(1e-3, 0.5))
def test_rays_from_a_circle_cross_at_its_half_angle(
    rng: np.random.Generator, half_rad: float
) -> None:
    """Seen from the light, the cameras lie on a cone of this half angle. A light of one ray or none has none."""
    around = rng.uniform(0, 2 * np.pi) + np.arange(5) * 2 * np.pi / 5
    cone = np.column_stack(
        [np.sin(half_rad) * np.cos(around), np.sin(half_rad) * np.sin(around), 0 * around]
    )
    cone[:, 2] = -np.cos(half_rad)
    turn = Rotation.random(rng=rng)
    at_m = rng.normal(size=3)
    camera_m = at_m + rng.uniform(0.1, 3, (5, 1)) * turn.apply(cone)
    lights_m = np.array([at_m, at_m + 1, at_m - 1])
    frame = np.array([0, 1, 2, 3, 4, 2])
    led = np.array([0, 0, 0, 0, 0, 1])
    angle_rad = survey_subset.ray_angles(lights_m, camera_m, frame, led)
    assert np.sin(half_rad) == pytest.approx(angle_rad[0], rel=1e-6)
    np.testing.assert_allclose(angle_rad[1:], 0, atol=1e-7)


@law(HeldFrames.shown, HeldFrames.rays)
@given(rng=SEEDS)
def test_rays_of_pixels_pass_through_the_leds(rng: np.random.Generator) -> None:
    assumed = model(60)
    held = attitudes(rng, 6)
    frames = HeldFrames(assumed.camera, assumed.leds, assumed.lever, held)
    shown = frames.shown(5.0, 10.0)
    assert not (shown & ~assumed.visible(held)).any()
    frame, led = np.nonzero(shown)
    xy_px = np.array(
        [
            pixels(assumed, assumed.leds.position_m, held[int(k)])[n]
            for k, n in zip(frame, led, strict=True)
        ]
    )
    origins, directions = frames.rays(frame, xy_px.reshape(-1, 2))
    toward = assumed.leds.position_m[led] - origins
    np.testing.assert_allclose(np.cross(toward, directions), 0, atol=1e-9)


@law(survey_faults.dark)
@given(rng=SEEDS)
def test_an_led_seen_or_rarely_in_view_is_not_called_dark(rng: np.random.Generator) -> None:
    shown = rng.random((30, 40)) < rng.random()
    seen = shown & (rng.random((30, 40)) < 0.99)
    seen[:, :2] = False
    found = survey_faults.dark(shown, seen)
    assert not seen[:, found].any()
    assert (shown[:, found].sum(axis=0) >= survey_faults.MIN_FRAMES).all()


@law(survey_faults.displaced)
@given(rng=SEEDS, size=some.floats(1e-5, 1e-1), far=some.floats(12, 1e3))
def test_an_led_far_from_the_list_is_displaced(
    rng: np.random.Generator, size: float, far: float
) -> None:
    listed = rng.normal(0, 1, (60, 3))
    found = listed + size * rng.normal(0, 1, (60, 3))
    found[7] = listed[7] + [far * size, 0, 0]
    covariance = np.tile(np.eye(3) * (size / 10) ** 2, (60, 1, 1))
    covariance[50:] = np.nan
    rows, sigma = survey_faults.displaced(listed, found, covariance)
    assert 7 in rows
    assert rows.max() < 50
    assert 0.5 * size < sigma < 1.6 * size
    none = survey_faults.displaced(listed, found, np.full((60, 3, 3), np.nan))
    assert (len(none[0]), none[1]) == (0, 0.0)


@law(survey_faults.found_displacements_m)
@given(size=some.floats(1e-5, 1e-1), ratio=some.floats(0.1, 10), count=some.integers(3, 2000))
def test_a_displacement_that_is_found_exceeds_the_limit_in_95_percent_of_surveys(
    size: float, ratio: float, count: int
) -> None:
    """The test value of a displaced LED is noncentral chi-square of three degrees."""
    covariance = np.tile(np.eye(3) * size**2, (count + 2, 1, 1))
    covariance[:2] = np.nan
    found_m = survey_faults.found_displacements_m(covariance, ratio * size)
    assert found_m.shape == (count,)
    limit = stats.chi2.isf(survey_faults.FALSE_ALARMS / count, 3)
    shift2 = found_m[0] ** 2 / (size**2 * (1 + ratio**2))
    assert 0.945 < stats.ncx2.sf(limit, 3, shift2) < 0.98


@law(survey_faults.stray_lights)
@given(rng=SEEDS)
def test_a_stationary_light_is_found_and_a_defective_pixel_is_not(
    rng: np.random.Generator,
) -> None:
    assumed = model(60)
    held = attitudes(rng, 40)
    frames = HeldFrames(assumed.camera, assumed.leds, assumed.lever, held)
    place_m = assumed.leds.position_m[3] * 1.003
    xy_px = np.array([pixels(assumed, place_m[None], one)[0] for one in held])
    frame = np.flatnonzero(assumed.camera.contains(xy_px))
    hot = np.tile([400.0, 100.0], (len(held), 1))  # moves over the dome with the camera
    rows = np.concatenate([frame, np.arange(len(held))])
    strays = survey_faults.stray_lights(
        frames, rows, np.vstack([xy_px[frame], hot]), 0.1, 0.004
    )
    near = [stray for stray in strays if np.linalg.norm(stray - place_m) < 2e-3]
    assert len(near) == (len(frame) >= survey_faults.MIN_FRAMES)
    assert survey_faults.stray_lights(frames, rows[:0], hot[:0], 0.1, 0.004) == []


@law(survey_faults.name_strays)
@given(rng=SEEDS, count=some.integers(0, 5))
def test_stray_lights_are_named_by_the_nearest_positions(
    rng: np.random.Generator, count: int
) -> None:
    listed = 10 * rng.normal(0, 1, (8, 3))
    chosen = rng.permutation(8)[:count]
    strays = [listed[k] + 0.001 * rng.normal(0, 1, 3) for k in chosen]
    pairs = survey_faults.name_strays(strays, np.arange(8), listed, 0.1)
    assert sorted(pairs) == sorted((int(k), n) for n, k in enumerate(chosen))
    assert survey_faults.name_strays(strays, np.arange(0), listed, 0.1) == []


# error of a list, and distance of LEDs that it may have in the wrong order
LIST_M = 0.001
CLOSE_M = 0.004


def close_group(
    rng: np.random.Generator, levels: np.ndarray
) -> tuple[np.ndarray, np.ndarray, np.ndarray, LightTable]:
    """List, places, covariance and light of four LEDs in a row and of 56 distant ones with these levels."""
    place_m = 10 * rng.normal(0, 1, (60, 3))
    place_m[:4] = place_m[0] + CLOSE_M * np.arange(4)[:, None] * [1.0, 0.0, 0.0]
    listed = place_m + LIST_M * rng.normal(0, 1, place_m.shape)
    light = levels * np.exp(0.03 * rng.normal(0, 1, (8, 60)))
    table = LightTable(light, np.ones((8, 60), dtype=bool), np.tile(levels, (8, 1)))
    return listed, place_m, np.tile(np.eye(3) * 1e-10, (60, 1, 1)), table


@law(survey_faults.names)
@given(rng=SEEDS)
def test_equal_leds_get_the_assignment_of_least_distance(rng: np.random.Generator) -> None:
    """The oracle tries all 24 orders of four LEDs that the list may have in any."""
    listed, place_m, covariance, table = close_group(rng, np.ones(60))
    listed[:4] = place_m[:4] + 3 * LIST_M * rng.normal(0, 1, (4, 3))
    rows, new = survey_faults.names(table, listed, place_m, covariance)
    cost = np.sum((place_m[:4, None] - listed[:4]) ** 2, axis=2)
    orders = [np.array(order) for order in itertools.permutations(range(4))]
    best = min(orders, key=lambda order: cost[range(4), order].sum())
    np.testing.assert_array_equal(rows, np.arange(60))
    _, sigma_m = survey_faults.displaced(listed, place_m, covariance)
    # Well below the quantile: 26 for 60 LEDs.
    plausible = cost[range(4), best].max() < 20 * sigma_m**2
    assert (new[:4].tolist() == best.tolist()) or not plausible
    np.testing.assert_array_equal(new[4:], np.arange(4, 60))


@law(survey_faults.names)
@given(rng=SEEDS)
def test_brightness_identifies_leds_exchanged_in_the_list(rng: np.random.Generator) -> None:
    """Brightness identifies neighbors and position distant LEDs; an exchange is reported."""
    levels = np.exp(np.linspace(0, -30, 60))
    listed, place_m, covariance, table = close_group(rng, levels)
    wrong = np.arange(60)
    wrong[[1, 2]] = [2, 1]
    listed[[1, 2]] = place_m[[2, 1]]  # by place alone each would have the other's name
    mixed = replace(table, light=table.light[:, wrong])
    _, new = survey_faults.names(mixed, listed, place_m[wrong], covariance)
    np.testing.assert_array_equal(new, wrong)
    far = np.arange(60)
    far[[10, 20]] = [20, 10]
    exchanged = replace(table, light=table.light[:, far])
    rows, same = survey_faults.names(exchanged, listed, place_m, covariance)
    np.testing.assert_array_equal(same, rows)
    assert [(one.led, one.shows) for one in survey_faults.exchanged(exchanged)[0]] == [
        (10, 20),
        (20, 10),
    ]
    none = survey_faults.names(table, listed, place_m, np.full((60, 3, 3), np.nan))
    assert [len(one) for one in none] == [0, 0]


@law(survey_faults.names)
@given(rng=SEEDS)
def test_no_other_light_gets_the_name_of_a_dark_led(rng: np.random.Generator) -> None:
    """LED 1 is dark, and its name was given to the light of LED 2, which is called 2 again."""
    listed, place_m, covariance, table = close_group(rng, np.exp(np.linspace(0, -30, 60)))
    covariance[2] = np.nan
    light = table.light.copy()
    light[:, 1] = table.light[:, 2]
    light[:, 2] = np.nan
    found_m = place_m.copy()
    found_m[1] = place_m[2]
    rows, new = survey_faults.names(replace(table, light=light), listed, found_m, covariance)
    assert new[rows == 1] == [2]
    assert 1 not in new


@law(survey_faults.exchanged)
@given(rng=SEEDS, gain=some.floats(0.1, 10))
def test_exchanged_lights_are_found_at_any_gain(
    rng: np.random.Generator, gain: float
) -> None:
    levels = np.exp(np.linspace(0, -3, 12))[rng.permutation(12)]
    shown = np.ones((10, 12), dtype=bool)
    light = gain * levels * np.exp(0.03 * rng.normal(0, 1, (10, 12)))
    expected = np.tile(levels, (10, 1))
    none, observable = survey_faults.exchanged(LightTable(light, shown, expected))
    assert none == []
    assert observable > 0.5
    light[:, [2, 9]] = light[:, [9, 2]]
    found, _ = survey_faults.exchanged(LightTable(light, shown, expected))
    far_apart = abs(np.log(levels[2] / levels[9])) > 0.5
    assert ([(one.led, one.shows) for one in found] == [(2, 9), (9, 2)]) or not far_apart
    alike, share = survey_faults.exchanged(LightTable(light, shown, np.ones((10, 12))))
    assert (alike, share) == ([], 0.0)


def test_a_model_of_no_noise_is_refused() -> None:
    assert answered(lambda: replace(model(20), sigma_px=0.0)) is None
    assert answered(lambda: replace(model(20), leds_sigma_m=np.inf)) is None
    assert isinstance(model(20).camera, Camera)
