"""Laws of the steps of the tracker of coded LEDs: motion, errors, phases, and which lights are named."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from estimator.attitude.dome_map import LedMap, Lever
from estimator.core.camera import Camera
from estimator.core.errors import ImageError
from estimator.core.types import Centroids, RateEstimate, StarMatch
from estimator.identification import led_codes, led_naming
from estimator.identification.led_codes import LedCode
from estimator.identification.refusals import NO_LIGHTS
from estimator.trackers.coded_tracker import COLLECTING, CodedTracker, DecoderSettings
from estimator.trackers.dome_tracker import MIN_ERROR_PX, SETTINGS

CAMERA = Camera(640, 480, 900.0, (319.5, 239.5))
LEVER = Lever(np.array([0.01, 0.0, 0.3]), Rotation.identity(), 2e-4)
LEVELS = np.random.default_rng(3).uniform(0.4, 1.0, (12, 6))


def tracker(
    bit_time_s: float | None = None, levels: Any = LEVELS, **decoder: Any
) -> CodedTracker:
    rng = np.random.default_rng(2)
    along = np.column_stack([rng.uniform(-0.3, 0.3, (len(levels), 2)), np.ones(len(levels))])
    along /= np.linalg.norm(along, axis=1)[:, None]
    place_m = along * rng.uniform(1.0, 1.2, (len(levels), 1))
    leds = LedMap(np.arange(len(levels)), place_m, np.full(3, 3e-4), np.full(3, 1.2))
    code = LedCode(levels, bit_time_s)
    return CodedTracker(CAMERA, leds, LEVER, SETTINGS, code, DecoderSettings(**decoder))


def lights(count: int = 5, flux: float = 1e4) -> Centroids:
    xy_px = np.random.default_rng(4).uniform(100, 400, (count, 2))
    return Centroids(xy_px, np.full(count, 0.1), np.full(count, flux))


class Recorded:
    """Tracks that note what they are given."""

    def __init__(self) -> None:
        self.cleared = 0
        self.given: list[Any] = []
        self.column = 0
        self.frames = 6

    def clear(self) -> None:
        self.cleared += 1

    def advance(self, *arguments: Any) -> None:
        self.given.append(arguments)


def test_a_tracker_remembers_frames_in_order_and_forgets_others() -> None:
    """Times that do not increase, and none, clear it; the motion since the last frame is that of the gyro's rate."""
    eye = tracker(0.1)
    noted: Any = Recorded()
    eye.tracks = noted
    rate = RateEstimate(np.array([0.1, -0.2, 0.3]), np.eye(3))
    steps: list[tuple[float | None, int, float]] = [
        (5.0, 1, 0.0),
        (5.5, 1, 0.5),
        (5.6, 1, 0.1),
        (5.6, 2, 0.0),
        (5.0, 3, -0.6),
        (None, 4, 0.0),
        (7.0, 5, 0.0),
        (7.25, 5, 0.25),
    ]
    for t_s, cleared, elapsed_s in steps:
        eye.phases[:] = False
        eye._advance(lights(flux=400.0), t_s, rate)
        assert noted.cleared == cleared
        _, sigma, elapsed, turn = noted.given[-1]
        assert elapsed == pytest.approx(elapsed_s)
        expected = Rotation.from_rotvec(-rate.rate_rad_s * elapsed_s)
        assert (turn * expected.inv()).magnitude() < 1e-12
        # 3 % besides the photons' noise
        relative = np.sqrt(0.03**2 + 1 / (400.0 * SETTINGS.gain_e_dn))
        np.testing.assert_allclose(sigma, 400.0 * relative)
        assert eye.phases.all() == (elapsed_s <= 0)
    unsigned = RateEstimate(rate.rate_rad_s, np.eye(3), sign_known=False)
    for none in (None, unsigned):
        eye._advance(lights(), 8.0, none)
        assert noted.given[-1][3] is None
    with pytest.raises(ImageError, match="t_s"):
        eye._advance(lights(), np.inf, None)


def test_templates_are_those_of_the_exposure_about_its_middle(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    eye = tracker(0.1)
    noted: Any = Recorded()
    noted.column = 2
    eye.tracks = noted
    monkeypatch.setattr(eye, "_identify_codes", lambda _: COLLECTING)
    assert (
        eye.solve_centroids(lights(), exposure_s=0.06, t_s=1.0, frame=4).status == COLLECTING
    )
    level, error = eye.code.templates(4, 0.97, 1.03)
    np.testing.assert_allclose(eye.templates[0, :, :, 2], level)
    np.testing.assert_allclose(eye.templates[1, :, :, 2], error)
    assert not eye.templates[..., [0, 1, 3, 4, 5]].any()
    found = eye.solve_centroids(lights(0), t_s=2.0)
    assert found.status == NO_LIGHTS
    np.testing.assert_allclose(eye.templates[..., 2], eye.code.templates(0, 2.0, 2.0))


@pytest.mark.parametrize(("bit_time_s", "least"), [(None, 3), (0.1, 8)])
def test_lights_that_were_seen_long_enough_and_fit_a_word_are_named(
    monkeypatch: pytest.MonkeyPatch, bit_time_s: float | None, least: int
) -> None:
    """In three frames, or in eight if the time is unknown; errors are the greatest of each light's frames."""
    eye = tracker(bit_time_s, levels=np.random.default_rng(3).uniform(0.4, 1, (12, 10)))
    tracks = eye.tracks
    centroids = lights(5)
    tracks.advance(centroids, np.ones(5), 0.0)
    tracks.light = np.full((5, 10), np.nan)
    tracks.sigma = np.full((5, 10), np.nan)
    counts = [least, least - 1, 10, 9, 10]
    for row, count in enumerate(counts):
        tracks.light[row, :count] = 100.0
        tracks.sigma[row, :count] = 1.0 + np.arange(count) / 10
    tracks.row = np.array([4, 3, 2, 1, 0])
    given: dict[str, Any] = {}
    misfit = np.zeros((2, 4, 12))
    # Of tracks 0, 2, 3, 4 the third is no LED.
    misfit[:, 2] = led_codes.expected_misfit(np.array([9.0]))[0] + 0.01
    misfit[:, [0, 1, 3]] = 1.0
    misfit[1, 3, 7] = 0.5

    def fake_misfit(light: Any, sigma: Any) -> Any:
        given.update(light=light, sigma=sigma)
        return misfit

    def fake_identify(named: Any, sphere: Any) -> Any:
        given.update(named=named)
        return StarMatch(np.array([0, 2]), np.array([5, 7]), Rotation.identity(), 0.0)

    monkeypatch.setattr(eye, "_misfit", fake_misfit)
    monkeypatch.setattr(led_naming, "identify", fake_identify)
    asked: list[Any] = []
    monkeypatch.setattr(
        led_naming, "is_supported", lambda *those: asked.append(those) or True
    )
    match = eye._identify_codes(centroids)
    assert isinstance(match, StarMatch)
    np.testing.assert_array_equal(given["light"], tracks.light[[0, 2, 3, 4]])
    for row, count in zip(given["sigma"], (least, 10, 9, 10), strict=True):
        np.testing.assert_allclose(row[:count], 1.0 + (count - 1) / 10)
        np.testing.assert_allclose(row[count:], 1.0)
    # Rows of the three that fit: tracks 0, 2, 4 are lights 4, 2, 0.
    expected = CAMERA.rays(centroids.xy_px[[4, 2, 0]])
    np.testing.assert_allclose(given["named"].ray, expected)
    np.testing.assert_allclose(given["named"].misfit, misfit[:, [0, 1, 3]].min(axis=0))
    assert match.observed.tolist() == [4, 0]
    assert match.star.tolist() == [5, 7]
    (those,) = asked
    assert those[2] == 4
    monkeypatch.setattr(led_naming, "is_supported", lambda *_: False)
    assert eye._identify_codes(centroids) == led_naming.CONTRADICTED
    monkeypatch.setattr(led_naming, "identify", lambda *_: "why not")
    assert eye._identify_codes(centroids) == "why not"
    misfit[:, [0, 1]] = 1e3
    eye.phases[:] = False
    assert eye._identify_codes(centroids) == COLLECTING
    assert eye.phases.all()
    tracks.row[[0, 2, 3]] = -1
    given.clear()
    assert eye._identify_codes(centroids) == COLLECTING
    assert not given
    # A light of the limit itself fits.
    tracks.row = np.array([4, 3, 2, 1, 0])
    misfit[:] = 1.0
    misfit[:, 2] = led_codes.expected_misfit(np.array([9.0]))[0] - 0.01
    monkeypatch.setattr(led_naming, "identify", fake_identify)
    monkeypatch.setattr(led_naming, "is_supported", lambda *_: True)
    eye._identify_codes(centroids)
    assert len(given["named"].ray) == 4


def test_misfits_are_divided_by_the_excess_of_noise(monkeypatch: pytest.MonkeyPatch) -> None:
    eye = tracker()
    tracks = eye.tracks
    tracks.advance(lights(3), np.ones(3), 0.0)
    tracks.light = np.full((3, 6), 100.0)
    tracks.sigma = np.ones((3, 6))
    given: list[Any] = []
    monkeypatch.setattr(eye, "_misfit", lambda *_: np.full((1, 3, 12), 6.0))
    monkeypatch.setattr(
        led_naming, "identify", lambda named, _: given.append(named.misfit) or "no"
    )
    eye._identify_codes(lights(3))
    # Half of six measurements is 3: twice the noise.
    np.testing.assert_allclose(given[0], 3.0)


def test_phases_are_kept_within_25_of_the_best_with_their_neighbors(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """The misfit of a phase is the sum over the lights, each with its best LED; neighbors go around."""
    eye = tracker(0.1, levels=np.random.default_rng(5).uniform(0.4, 1, (3, 2)))
    count = len(eye.code.phases)
    assert count == 16
    sums = np.full(16, 100.0)
    sums[[0, 5, 9]] = 10.0, 34.9, 35.1

    def fake(light: Any, sigma: Any, templates: Any, spread: Any) -> Any:
        # Words of a phase carry its number; the second LED is the best.
        phase = np.rint(templates[:, 0]).astype(int)
        led = np.rint(templates[:, 1]).astype(int)
        return (sums[phase] / 2 + np.abs(led - 1))[None]

    eye.templates = np.zeros((2, 16, 3, 2))
    eye.templates[0, :, :, 0] = np.arange(16)[:, None]
    eye.templates[0, :, :, 1] = np.arange(3)
    monkeypatch.setattr(led_codes, "misfits", fake)
    monkeypatch.setattr(led_codes, "likely", lambda row, templates: np.arange(len(templates)))
    eye.phases[:] = True
    found = eye._misfit(np.ones((2, 2)), np.ones((2, 2)))
    assert found.shape == (2, 2, 3)
    np.testing.assert_allclose(found[0], [[6, 5, 6], [6, 5, 6]])
    np.testing.assert_allclose(found[1], [[18.45, 17.45, 18.45]] * 2)
    assert np.flatnonzero(eye.phases).tolist() == [0, 1, 4, 5, 6, 15]
    # Only these are tried in the next frame.
    sums[4] = 1.0
    sums[9] = 0.0
    eye._misfit(np.ones((2, 2)), np.ones((2, 2)))
    assert np.flatnonzero(eye.phases).tolist() == [0, 1, 3, 4, 5, 15]
    # A word that is not likely has no misfit.
    monkeypatch.setattr(
        led_codes, "likely", lambda row, templates: np.arange(1, len(templates))
    )
    eye.phases[:] = True
    found = eye._misfit(np.ones((1, 2)), np.ones((1, 2)))
    assert np.isinf(found).sum() <= 1


def test_a_tangent_errs_by_direction_map_and_lever() -> None:
    """An angle's error grows by 1 / cos^2 in the tangent; the lever's as the tangent, over the nearest distance."""
    eye = tracker()
    centroids = lights(6)
    rays, sigma = eye._tangents(centroids)
    np.testing.assert_allclose(rays, CAMERA.rays(centroids.xy_px))
    offset = (centroids.xy_px - CAMERA.center_px) / 900.0
    tangent = np.hypot(*offset.T)
    own = np.hypot(eye.direction_sigma_rad(centroids), MIN_ERROR_PX / 900.0)
    angle = np.hypot(own, eye.led_sigma_rad.max())
    lever = 2e-4 / np.linalg.norm(eye.sphere.position_m, axis=1).min() * tangent
    np.testing.assert_allclose(sigma, np.hypot(angle * (1 + tangent**2), lever), rtol=1e-9)
    assert (lever > 0).all()
    assert lever.max() > 0.01 * angle.min()


@pytest.mark.parametrize(("dark", "patience"), [(0.0, 6), (0.3, 2)])
def test_a_tracker_waits_for_leds_that_may_be_dark(dark: float, patience: int) -> None:
    """For a word's length; two frames otherwise. As many frames are kept as the code has bits, or as asked for."""
    levels = np.maximum(LEVELS, 0.5)
    levels[3, 2] = dark
    eye = tracker(levels=levels)
    assert (eye.tracks.goes_dark, eye.tracks.patience) == (dark == 0, patience)
    assert eye.tracks.frames == 6
    assert eye.tracks.gate_px == 60
    assert eye.tracks.radius_m == pytest.approx(
        np.median(np.linalg.norm(eye.leds.position_m, axis=1))
    )
    assert eye.templates.shape == (2, 1, 12, 6)
    longer = tracker(levels=levels, frames=9)
    assert longer.templates.shape == (2, 1, 12, 9)
    assert longer.tracks.frames == 9
    np.testing.assert_allclose(np.linalg.norm(eye.sphere.direction, axis=1), 1)


def test_rows_of_a_rolling_shutter_show_different_bits_of_a_free_code() -> None:
    rolling = Camera(640, 480, 900.0, (319.5, 239.5), row_time_s=1e-5)
    base = tracker()
    with pytest.raises(ImageError, match="rolling shutter show different bits"):
        CodedTracker(rolling, base.leds, LEVER, SETTINGS, LedCode(LEVELS, 0.1))
    CodedTracker(rolling, base.leds, LEVER, SETTINGS, LedCode(LEVELS))
