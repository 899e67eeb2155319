"""Laws of coded lights: templates, misfits, tracks, and names by codes and places."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as some
from scipy.optimize import brentq, minimize_scalar
from scipy.spatial.transform import Rotation
from scipy.stats import chi2

from estimator.attitude.dome_map import Lever, project
from estimator.core.camera import Camera
from estimator.core.checks import Floats
from estimator.core.errors import ImageError
from estimator.core.types import Centroids, StarMatch
from estimator.identification import led_codes, led_naming
from estimator.identification.led_codes import GROSS, LedCode, LightTracks
from tests.helpers.laws import SEEDS, answered, law, turn, units

CAMERA = Camera(640, 480, 900.0, (319.5, 239.5))
LEVER = Lever(np.array([0.01, 0.0, 0.3]), Rotation.identity())


@law(LedCode.templates, LedCode.phases, LedCode.bits)
@given(rng=SEEDS, begin_s=some.floats(-50, 50), length_s=some.floats(1e-4, 3.0))
def test_a_template_is_the_mean_level_of_an_exposure(
    rng: np.random.Generator, begin_s: float, length_s: float
) -> None:
    """Against two thousand samples of the exposure; a frame of a triggered code shows its bit."""
    levels = rng.random((5, 7))
    free = LedCode(levels, 0.3)
    triggered = LedCode(levels)
    time = begin_s + (np.arange(2000) + 0.5) / 2000 * length_s
    bit = np.floor(time / 0.3 + free.phases[:, None]).astype(int) % free.bits
    found, spread = free.templates(0, begin_s, begin_s + length_s)
    assert spread.min() >= 0
    assert found.shape == (len(free.phases), 5)
    np.testing.assert_allclose(found, levels[:, bit].mean(axis=2).T, rtol=0, atol=2e-3)
    np.testing.assert_array_equal(triggered.templates(17, 0.0, 1.0)[0], levels[None, :, 3])
    assert triggered.templates(17, 0.0, 1.0)[1].max() == 0


@pytest.mark.slow
@law(led_codes.misfits, led_codes.expected_misfit, led_codes.likely)
@given(rng=SEEDS, gross=some.integers(0, 2))
def test_a_misfit_is_the_least_over_the_brightness(
    rng: np.random.Generator, gross: int
) -> None:
    """Of the true template it is that of a fine search of brightnesses; of others at least as much as theirs."""
    template = rng.integers(0, 2, (6, 20)) * 0.5 + 0.5
    light = 1e4 * template[:1] * (1 + 0.02 * rng.standard_normal(20))
    light[0, :gross] = rng.uniform(0.3, 1.2, gross) * 1e4
    light[0, 5] = np.nan
    sigma = np.full((1, 20), 200.0)
    found = led_codes.misfits(light, sigma, template, np.zeros_like(template))

    def misfit(brightness: float, row: Floats) -> float:
        each = ((light[0] - brightness * row) / sigma[0]) ** 2 / 2
        return float(np.nansum(np.minimum(each, GROSS)))

    for n, row in enumerate(template):
        start = min(np.linspace(3e3, 2e4, 2000), key=lambda one: misfit(one, row))
        best = minimize_scalar(
            misfit, args=(row,), bounds=(start - 20, start + 20), method="bounded"
        ).fun
        assert found[0, n] >= best - 1e-6
        if n == 0:
            # Two starts miss the least misfit of frames with gross errors by 0.9 at most, of 200 draws.
            assert found[0, n] == pytest.approx(best, abs=1.0 if gross else 1e-6)
    assert 0 in led_codes.likely(light[0], template)
    assert found[0, 0] <= led_codes.expected_misfit(np.array([19]))[0] + GROSS * gross


def test_a_true_code_word_is_seldom_called_suspicious() -> None:
    """Half of a chi-square exceeds the limit without its allowance for gross errors in 1 of 50 cases or fewer."""
    for measured in (3, 9, 19, 31):
        limit = led_codes.expected_misfit(np.array([measured]))[0] - GROSS * max(
            1, measured / 6
        )
        assert chi2.sf(2 * limit, measured) < 0.02


@law(led_codes.excess_noise)
@given(rng=SEEDS, factor=some.floats(0.3, 4.0))
def test_noise_beyond_the_declared_is_found_from_the_misfits(
    rng: np.random.Generator, factor: float
) -> None:
    """Squared errors `factor`^2 times the declared ones; one light in nine is no LED. Never below 1."""
    measured = np.full(90, 24)
    least = factor**2 * rng.chisquare(measured) / 2
    least[::9] = 1e4
    found = led_codes.excess_noise(least, measured)
    assert (
        found == 1 if factor < 0.85 else found == pytest.approx(max(1.0, factor**2), rel=0.25)
    )


@law(led_naming.is_supported)
@given(lights=some.integers(2, 6), rival=some.floats(0.0, 30.0))
def test_names_require_a_common_time_and_consistency_with_the_other_lights(
    lights: int, rival: float
) -> None:
    """Two lights that are perfect at different phases of the clock, or together at one; and lights without a name."""
    misfit = np.full((2, lights, 4), 20.0)
    misfit[0, 0, 1] = misfit[1, 1, 2] = 0.0
    misfit[1, 0, 1] = misfit[0, 1, 2] = rival
    match = StarMatch(np.array([0, 1]), np.array([1, 2]), Rotation.identity(), 0.0)
    assert led_naming.is_supported(match, misfit, lights) == (
        lights == 2 and rival <= led_naming.TRUSTED * np.sqrt(2)
    )


def dome(count: int) -> led_naming.Sphere:
    """LEDs on a golden spiral of radius 1.2 m, where every field looks like its neighbors."""
    z = 1 - (np.arange(count) + 0.5) / count * 0.4
    azimuth = np.arange(count) * np.pi * (3 - np.sqrt(5))
    ring = np.sqrt(1 - z**2)
    along = np.column_stack([ring * np.cos(azimuth), ring * np.sin(azimuth), z])
    return led_naming.Sphere(1.2 * along, np.full(count, 1.2), along, LEVER.camera_body_m)


def field(sphere: led_naming.Sphere, body_from_lab: Rotation) -> tuple[Floats, Floats]:
    """The LEDs in the field and their pixels."""
    xy_px = np.nan_to_num(project(body_from_lab, sphere.position_m, LEVER, CAMERA), nan=-1e9)
    seen = np.flatnonzero(CAMERA.contains(xy_px, 3))
    return seen, xy_px[seen]


@law(led_naming.identify)
@given(rng=SEEDS, known=some.floats(0, 40), lied=some.integers(0, 1))
def test_names_are_right_or_refused(
    rng: np.random.Generator, known: float, lied: int
) -> None:
    """Codes that identify each LED by `known`, in some cases one of them wrongly: no attitude is wrong."""
    sphere = dome(100)
    truth = turn(rng, 0.3)
    seen, xy_px = field(sphere, truth)
    misfit = known * (np.arange(100) != seen[:, None]).astype(float)
    if lied:
        misfit[0] = 40.0 * (np.arange(100) != rng.integers(100))
    rays = CAMERA.rays(xy_px + rng.normal(0, 0.1, xy_px.shape))
    found = led_naming.identify(
        led_naming.NamedLights(rays, np.full(len(seen), 3e-4), misfit), sphere
    )
    if isinstance(found, str):
        assert known < 25 or lied
        return
    np.testing.assert_array_equal(found.star, seen[found.observed])
    assert (found.cam_from_ref * truth.inv()).magnitude() < 0.02


@law(LightTracks.advance, LightTracks.clear)
@given(rng=SEEDS, rate_rad_s=some.floats(0, 1.5), gyro=some.booleans(), dark=some.booleans())
def test_lights_keep_their_tracks_while_the_vehicle_turns(
    rng: np.random.Generator, rate_rad_s: float, gyro: bool, dark: bool
) -> None:
    """Ten frames of 20 ms; light n has the brightness n + 1, or is dark in some frames: no track has two of them."""
    sphere = dome(100)
    start = turn(rng, 0.3)
    axis = units(rng, 1)[0]
    tracks = LightTracks(CAMERA, LEVER.camera_body_m, 1.2, 10, 40.0, 2, dark)
    tracks.clear()
    for frame in range(10):
        turned = Rotation.from_rotvec(axis * rate_rad_s * 0.02 * frame)
        seen, xy_px = field(sphere, turned * start)
        lit = rng.random(len(seen)) > 0.2 * dark * (frame > 2)
        seen = seen[lit]
        xy_px = xy_px[lit]
        centroids = Centroids(xy_px, np.full(len(seen), 0.1), seen + 1.0)
        step = Rotation.from_rotvec(axis * rate_rad_s * 0.02) if gyro else None
        tracks.advance(centroids, 0.01 * (seen + 1.0), 0.02, step)
        np.testing.assert_array_equal(
            np.sort(tracks.row[tracks.row >= 0]), np.arange(len(seen))
        )
    shown = [set(row[row > 0].tolist()) for row in tracks.light]
    assert all(len(one) <= 1 for one in shown)
    if not dark:
        assert len({tuple(one) for one in shown}) == len(shown)
    tracks.clear()
    assert len(tracks.row) == 0


@pytest.mark.parametrize(
    "levels", [np.ones((3, 4)), np.full((2, 2), 2.0), np.zeros((0, 3)), np.ones(3)]
)
def test_codes_that_name_nothing_are_refused(levels: Floats) -> None:
    assert answered(lambda: LedCode(levels), ImageError) is None


@pytest.mark.parametrize(("excess", "decided"), [(2.0, False), (11.0, False), (12.0, True)])
def test_two_lights_are_named_if_every_other_pair_is_1e5_times_less_likely(
    excess: float, decided: bool
) -> None:
    """Of eight LEDs on a circle all neighbors are as far apart; ln(10^5) is 11.5."""
    azimuth = np.arange(8) * np.pi / 4
    ring = np.column_stack(
        [0.1 * np.cos(azimuth), 0.1 * np.sin(azimuth), np.full(8, 0.99499)]
    )
    sphere = led_naming.Sphere(1.2 * ring, np.full(8, 1.2), ring, LEVER.camera_body_m)
    _, xy_px = field(sphere, Rotation.identity())
    misfit = np.full((2, 8), 100.0)
    misfit[[0, 1], [0, 1]] = 3.0
    misfit[[0, 1], [4, 5]] = 3.0 + excess / 2
    found = led_naming.identify(
        led_naming.NamedLights(CAMERA.rays(xy_px[:2]), np.full(2, 3e-4), misfit), sphere
    )
    assert (found == led_naming.UNDECIDED) if not decided else found.star.tolist() == [0, 1]


@pytest.mark.parametrize("measured", [3, 6, 9, 24])
def test_a_suspicious_misfit_is_three_deviations_and_a_gross_error_in_six(
    measured: int,
) -> None:
    """Of half a chi-square, whose moments SciPy knows; a gross error counts 7."""
    half = chi2(measured)
    expected = half.mean() / 2 + 3 * half.std() / 2 + 7 * max(1, measured / 6)
    assert led_codes.expected_misfit(np.array([measured]))[0] == pytest.approx(expected)


def test_the_excess_of_noise_is_the_median_over_the_lights() -> None:
    """Half of the measurements is what a light without excess has."""
    assert led_codes.excess_noise(np.array([6.0, 24.0, 900.0]), np.array([4, 16, 10])) == 3
    assert led_codes.excess_noise(np.array([1.0, 2.0, 3.0]), np.array([8, 8, 8])) == 1
    assert led_codes.excess_noise(np.array([5.0, 5.0, 5.0]), np.array([8, 8, 8])) == 1.25


def test_words_are_likely_within_forty_of_the_best_s_misfit() -> None:
    """Errors of a tenth of the brightest frame; by least squares of each word. A missing frame counts for none."""
    rng = np.random.default_rng(31)
    light = 50.0 * np.array([1.0, 0.5, 1.0, np.nan, 0.5, 1.0, 0.5, 0.5])
    templates = np.vstack([rng.uniform(0.2, 1.0, (60, 8)), np.where(light > 30, 1.0, 0.5)])
    seen = np.isfinite(light)
    misfit = []
    for word in templates[:, seen]:
        (brightness,), *_ = np.linalg.lstsq(word[:, None], light[seen])
        misfit.append(np.sum(((light[seen] - brightness * word) / 5.0) ** 2) / 2)
    expected = np.flatnonzero(np.array(misfit) <= min(misfit) + 40)
    assert 3 < len(expected) < 58
    assert led_codes.likely(light, templates).tolist() == expected.tolist()
    # Closer: 39 and 41 beyond the best
    for excess, kept in ((39.0, True), (41.0, False)):
        # Two frames: [1, 1] fits; [1, c] has the misfit 100 (1 - c)^2 / (1 + c^2) / 2 in excess.
        c = brentq(lambda c, e=excess: 50 * (1 - c) ** 2 / (1 + c**2) - e, 0.0, 1.0)
        found = led_codes.likely(np.array([3.0, 3.0]), np.array([[1.0, 1.0], [1.0, c]]))
        assert (1 in found) == kept
    # Fractions count: 194.95 of the light less 114.5 of a word are 80.45, half of which is above 40.
    light = np.array([10.0, np.sqrt(94.95)])
    c = brentq(
        lambda c: (10 * (10 + c * light[1])) ** 2 / 100 / (1 + c**2) - 114.5, -1.0, 0.9
    )
    assert led_codes.likely(light, np.array([light, [1.0, c]])).tolist() == [0]


def test_a_misfit_weighs_frames_by_noise_and_by_the_unknown_phase() -> None:
    """The error by the phase is a share of the brightest frame; the least over the brightness in closed form."""
    rng = np.random.default_rng(32)
    templates = rng.uniform(0.3, 1.0, (4, 9))
    spread = rng.uniform(0.0, 0.02, (4, 9))
    sigma = rng.uniform(10.0, 60.0, (2, 9))
    light = 1000.0 * templates[[1, 3]] + sigma * rng.standard_normal((2, 9))
    light[0, 4] = np.nan
    found = led_codes.misfits(light, sigma, templates, spread)
    for t, best in enumerate((1, 3)):
        seen = np.isfinite(light[t])
        y = light[t, seen]
        variance = sigma[t, seen] ** 2 + (np.nanmax(light[t]) * spread[best, seen]) ** 2
        word = templates[best, seen] / np.sqrt(variance)
        (brightness,), *_ = np.linalg.lstsq(word[:, None], y / np.sqrt(variance))
        expected = np.sum((y - brightness * templates[best, seen]) ** 2 / variance) / 2
        assert found[t, best] == pytest.approx(expected, rel=1e-9)
        assert found[t].argmin() == best


@pytest.mark.parametrize("wrong", [1.3, 0.0])
def test_a_gross_error_counts_seven_and_moves_no_brightness(wrong: float) -> None:
    """A frame that is dark or too bright, of twelve: the brightness is that of the others."""
    template = np.tile([1.0, 0.5], 6)
    light = 1000.0 * template
    light[7] = 1000.0 * wrong
    light[[2, 3]] += [10.0, -20.0]
    sigma = np.full(12, 20.0)
    kept = np.arange(12) != 7
    (brightness,), *_ = np.linalg.lstsq(template[kept, None], light[kept])
    others = np.sum((light[kept] - brightness * template[kept]) ** 2) / 400 / 2
    found = led_codes.misfits(light[None], sigma[None], template[None], np.zeros((1, 12)))
    assert found[0, 0] == pytest.approx(7 + others, rel=1e-9)
    # A frame's misfit of less than 7 is no gross error.
    for off, expected in ((0.99, None), (1.01, 7.0)):
        alone = np.full(60, 1000.0)
        alone[0] += off * 20 * np.sqrt(14) * 60 / 59
        ones = np.ones((1, 60))
        value = led_codes.misfits(alone[None], np.full((1, 60), 20.0), ones, 0 * ones)[0, 0]
        if expected is None:
            chi = np.sum((alone - alone.mean()) ** 2) / 400 / 2
            assert value == pytest.approx(min(chi, 7.0), rel=1e-6)
        else:
            assert value == pytest.approx(expected, rel=1e-6)


@pytest.mark.parametrize("length_s", [0.05, 0.3, 1.0])
def test_a_template_errs_by_the_change_over_half_a_step_of_the_phase(length_s: float) -> None:
    """Of eight phases a bit; the change over half a step, over sqrt(3), by mean levels of a fine scan."""
    code = LedCode(np.random.default_rng(33).random((4, 5)), 0.3)
    assert len(code.phases) == 5 * 8
    np.testing.assert_allclose(code.phases, np.arange(40) / 8)
    level, error = code.templates(0, 1.234, 1.234 + length_s)

    def mean_level(phase: Floats) -> Floats:
        fine = (np.arange(40_000) + 0.5) / 40_000
        bits = (1.234 + fine * length_s) / 0.3 + phase[:, None]
        return code.levels[:, np.floor(bits).astype(int) % 5].mean(axis=2).T

    before, at, after = (mean_level(code.phases + step / 16) for step in (-1, 0, 1))
    np.testing.assert_allclose(level, at, rtol=0, atol=1e-3)
    change = np.maximum(np.abs(before - at), np.abs(after - at))
    np.testing.assert_allclose(error, change / np.sqrt(3), rtol=0, atol=1e-3)
    # An exposure of no length shows a level, and not a division by 0.
    assert np.isfinite(code.templates(0, 1.0, 1.0)[0]).all()


def tracked(goes_dark: bool, patience: int = 2) -> LightTracks:
    return LightTracks(CAMERA, LEVER.camera_body_m, 1.2, 4, 20.0, patience, goes_dark)


def shown(xy_px: list[list[float]], flux: float = 5.0) -> Centroids:
    count = len(xy_px)
    places = np.array(xy_px, float).reshape(-1, 2)
    return Centroids(places, np.full(count, 0.1), np.full(count, flux))


@pytest.mark.parametrize("goes_dark", [False, True])
@pytest.mark.parametrize(("x_px", "inside"), [(30.0, True), (28.0, False)])
def test_a_dark_light_well_inside_has_a_measurement_of_zero(
    goes_dark: bool, x_px: float, inside: bool
) -> None:
    """30 px from the border; with the greatest error of its other frames. Else its level is unknown."""
    tracks = tracked(goes_dark)
    tracks.advance(shown([[x_px, 200.0]], 7.0), np.array([0.3]), 0.0)
    tracks.advance(shown([[x_px, 200.0]], 9.0), np.array([0.2]), 0.02)
    tracks.advance(shown([]), np.zeros(0), 0.02)
    assert tracks.light[0, :2].tolist() == [7.0, 9.0]
    if goes_dark and inside:
        assert (tracks.light[0, 2], tracks.sigma[0, 2]) == (0.0, 0.3)
    else:
        assert np.isnan(tracks.light[0, 2])
        assert np.isnan(tracks.sigma[0, 2])
    assert np.isnan(tracks.light[0, 3])
    assert tracks.row.tolist() == [-1]
    assert tracks.missed.tolist() == [1]
    tracks.advance(shown([[x_px, 200.0]], 4.0), np.array([0.1]), 0.02)
    tracks.advance(shown([[x_px, 200.0]], 6.0), np.array([0.1]), 0.02)
    # Of four frames the first is forgotten.
    assert tracks.light[0, [0, 1, 3]].tolist() == [6.0, 9.0, 4.0]
    assert tracks.missed.tolist() == [0]


@pytest.mark.parametrize("patience", [0, 2, 5])
def test_a_track_ends_after_its_patience(patience: int) -> None:
    tracks = tracked(True, patience)
    tracks.advance(shown([[300.0, 200.0]]), np.array([0.1]), 0.0)
    for missed in range(1, patience + 3):
        tracks.advance(shown([]), np.zeros(0), 0.02)
        assert len(tracks.row) == (missed <= patience)


def test_a_light_beyond_the_gate_begins_a_track_of_its_own() -> None:
    for off_px, count in ((19.5, 1), (20.5, 2)):
        tracks = tracked(True)
        tracks.advance(shown([[300.0, 200.0]]), np.array([0.1]), 0.0)
        tracks.advance(shown([[300.0 + off_px, 200.0]]), np.array([0.1]), 0.02)
        assert len(tracks.row) == count
        assert tracks.light.shape == (count, 4)
        if count == 2:
            assert tracks.row.tolist() == [-1, 0]
            assert np.isnan(tracks.light[1, 0])
            assert tracks.light[1, 1] == 5.0


@pytest.mark.parametrize("lights", [1, 2, 5])
def test_the_rate_of_two_lights_predicts_the_next_frame(lights: int) -> None:
    """From 0.5 rad/s and frames 20 ms apart; of one light no rate is measured. Of no time neither."""
    rng = np.random.default_rng(34)
    points = CAMERA.rays(rng.uniform(200, 300, (lights, 2)))
    pupil_m = LEVER.camera_body_m
    along = points @ pupil_m
    places = (
        pupil_m + points * (-along + np.sqrt(along**2 + 1.44 - pupil_m @ pupil_m))[:, None]
    )
    rate = np.array([0.1, -0.3, 0.5])
    tracks = tracked(False)
    for frame in range(3):
        turned = Rotation.from_rotvec(rate * 0.02 * frame).apply(places)
        centroids = shown(CAMERA.pixels(turned - pupil_m).tolist())
        tracks.advance(centroids, np.full(lights, 0.1), 0.02 if frame else 0.0)
        if frame:
            expected = rate if lights > 1 else np.zeros(3)
            np.testing.assert_allclose(tracks.rate_rad_s, expected, rtol=0, atol=1e-9)
        np.testing.assert_allclose(tracks.point_m, turned, rtol=0, atol=1e-9)
        assert tracks.row.tolist() == list(range(lights))
    tracks.advance(shown([]), np.zeros(0), 0.02)
    predicted = places if lights < 2 else Rotation.from_rotvec(rate * 0.06).apply(places)
    if lights > 1:
        np.testing.assert_allclose(tracks.point_m, predicted, rtol=0, atol=1e-8)
    tracks.clear()
    assert tracks.column == -1
    assert not tracks.rate_rad_s.any()
