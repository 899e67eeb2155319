"""Laws of the tracker of coded LEDs: names are right or refused, at rest and rotating, with failed bits."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as some
from scipy.spatial.transform import Rotation

from estimator.attitude.dome_map import LedMap, Lever, project
from estimator.core.camera import Camera
from estimator.core.errors import ImageError
from estimator.core.types import Centroids, RateEstimate
from estimator.identification.led_codes import LedCode
from estimator.trackers.coded_tracker import CodedTracker, DecoderSettings
from estimator.trackers.dome_tracker import SETTINGS, DomeTracker
from tests.helpers.laws import SEEDS, answered, law, turn, units

pytestmark = pytest.mark.slow
CAMERA = Camera(640, 480, 900.0, (319.5, 239.5))
LEVER = Lever(np.array([0.01, 0.0, 0.3]), Rotation.identity())
# Of random words the least distance is 3.
WORDS = np.random.default_rng(8).integers(0, 2, (120, 24))


def spiral(count: int = 120) -> LedMap:
    """LEDs on a golden spiral, where every field looks like its neighbors."""
    z = 1 - (np.arange(count) + 0.5) / count * 0.4
    azimuth = np.arange(count) * np.pi * (3 - np.sqrt(5))
    ring = np.sqrt(1 - z**2)
    place_m = 1.2 * np.column_stack([ring * np.cos(azimuth), ring * np.sin(azimuth), z])
    return LedMap(np.arange(count), place_m, np.zeros(3), np.full(3, 1.2))


def tracker(depth: float, bit_time_s: float | None = None, **settings: float) -> CodedTracker:
    code = LedCode(np.where(WORDS > 0, 1.0, 1 - depth), bit_time_s)
    return CodedTracker(CAMERA, spiral(), LEVER, SETTINGS, code, DecoderSettings(**settings))


@law(CodedTracker.solve_centroids, DomeTracker.solve_match, slow=True)
@given(
    rng=SEEDS,
    depth=some.sampled_from([0.3, 0.5, 1.0]),
    rate_rad_s=some.sampled_from([0.0, 0.1]),
    failing=some.sampled_from([0.0, 0.02]),
    gyro=some.booleans(),
)
def test_lights_are_named_correctly_by_their_codes_or_not_at_all(
    rng: np.random.Generator, depth: float, rate_rad_s: float, failing: float, gyro: bool
) -> None:
    """Within a code's length of frames at 50 Hz, with 2 % of noise in the light."""
    eye = tracker(depth)
    start = turn(rng, 0.3)
    axis = units(rng, 1)[0]
    solved = 0
    for frame in range(24):
        body_from_lab = Rotation.from_rotvec(axis * rate_rad_s * 0.02 * frame) * start
        px = np.nan_to_num(
            project(body_from_lab, eye.leds.position_m, LEVER, CAMERA), nan=-1e9
        )
        star = np.flatnonzero(CAMERA.contains(px, 3))
        bit = (WORDS[star, frame] > 0) != (rng.random(len(star)) < failing)
        light = (
            1e5 * np.where(bit, 1.0, 1 - depth) * (1 + 0.02 * rng.standard_normal(len(star)))
        )
        star = star[light > 1e3]
        light = light[light > 1e3]
        xy_px = px[star] + rng.normal(0, 0.1, (len(star), 2))
        rate = RateEstimate(-axis * rate_rad_s, 1e-10 * np.eye(3)) if gyro else None
        found = eye.solve_centroids(
            Centroids(xy_px, np.full(len(star), 0.1), light),
            rate=rate,
            exposure_s=2e-3,
            t_s=0.02 * frame,
            frame=frame,
        )
        if found.solved:
            solved += 1
            np.testing.assert_array_equal(found.match.star, star[found.match.observed])
            assert (found.cam_from_ref * body_from_lab.inv()).magnitude() < 0.01
    assert solved


@law(CodedTracker.solve_centroids, slow=True)
@given(
    rng=SEEDS,
    bit_time_s=some.sampled_from([None, 0.021]),
    noise=some.sampled_from([0.06, 0.09]),
)
def test_light_noisier_than_declared_gives_no_wrong_attitude(
    rng: np.random.Generator, bit_time_s: float | None, noise: float
) -> None:
    """With two and three times `flux_sigma`, and up to seven random lights."""
    eye = tracker(0.5, bit_time_s)
    body_from_lab = turn(rng, 0.3)
    late_s = rng.uniform(0, 0.5)
    px = np.nan_to_num(project(body_from_lab, eye.leds.position_m, LEVER, CAMERA), nan=-1e9)
    star = rng.permutation(np.flatnonzero(CAMERA.contains(px, 3)))[: rng.integers(2, 8)]
    levels = np.where(WORDS[star] > 0, 1.0, 0.5)
    for frame in range(24):
        bit = frame if bit_time_s is None else int((0.02 * frame + late_s) / bit_time_s) % 24
        light = (
            1e5 * levels[:, bit] * np.maximum(1 + noise * rng.standard_normal(len(star)), 0.1)
        )
        found = eye.solve_centroids(
            Centroids(px[star], np.full(len(star), 0.1), light), t_s=0.02 * frame, frame=frame
        )
        if found.solved:
            np.testing.assert_array_equal(found.match.star, star[found.match.observed])


@law(CodedTracker.solve_centroids, slow=True)
@given(rng=SEEDS)
def test_a_code_of_other_leds_gives_no_attitude(rng: np.random.Generator) -> None:
    """The lights show code words that no LED has."""
    eye = tracker(0.5)
    body_from_lab = turn(rng, 0.3)
    others = rng.integers(0, 2, WORDS.shape)
    px = np.nan_to_num(project(body_from_lab, eye.leds.position_m, LEVER, CAMERA), nan=-1e9)
    star = np.flatnonzero(CAMERA.contains(px, 3))
    for frame in range(24):
        light = (
            1e5
            * np.where(others[star, frame], 1.0, 0.5)
            * (1 + 0.02 * rng.standard_normal(len(star)))
        )
        found = eye.solve_centroids(
            Centroids(px[star], np.full(len(star), 0.1), light), t_s=0.02 * frame, frame=frame
        )
        assert not found.solved or frame < 12  # within few bits the places alone may decide
        if found.solved:
            np.testing.assert_array_equal(found.match.star, star[found.match.observed])


@law(CodedTracker.solve, slow=True)
@given(noise=SEEDS)
def test_frames_of_noise_have_no_attitude(noise: np.random.Generator) -> None:
    eye = tracker(0.5)
    for frame in range(4):
        image = noise.normal(100, 5, (480, 640))
        assert not eye.solve(
            image, exposure_s=2e-3, t_s=0.02 * frame, frame=frame
        ).attitude.solved
    assert not eye.solve(image).attitude.solved
    answered(lambda: eye.solve(image[:3]), ImageError)


def test_a_code_or_setting_that_does_not_fit_is_refused() -> None:
    code = LedCode(np.array([[0.0, 1.0]] * 7))
    for build, reason in (
        (
            lambda: CodedTracker(CAMERA, spiral(), LEVER, SETTINGS, code),
            "code: 7 words; allowed: 120, one an LED",
        ),
        (lambda: tracker(0.5, flux_sigma=0.0), "flux_sigma"),
        (lambda: tracker(0.5, gate_px=np.nan), "gate_px"),
        (lambda: tracker(0.5, frames=2), "frames"),
    ):
        with pytest.raises(ImageError, match=reason):
            build()
