"""Our frames solved by tetra3rs and astrometry.net: their coordinates agree with our headers.

Each gets only the file and the camera's width (tetra3rs: its calibration), and solves lost in space
with its own centroids and catalog. The allowed errors are predicted from their residuals:
docs/findings/oracles.md.
"""

from __future__ import annotations

import numpy as np
import pytest

from tests.helpers import oracles

MISSING = {
    "tetra3rs": "needs tetra3rs",
    "astrometry.net": "needs astrometry.net and its wide index files",
}
SOLVED = {"tetra3rs": 0.95, "astrometry.net": 0.98}  # at least
SHEFEX, WIDE = oracles.SCENES


def pairs(name: str, who: str, frames: int, seed: int) -> list[oracles.Pair]:
    solve = oracles.ORACLES[who](name)
    if solve is None:
        pytest.skip(MISSING[who])
    return oracles.confront(name, who, solve, frames, seed)


@pytest.mark.parametrize("who", oracles.ORACLES)
def test_a_solver_s_coordinates_agree_with_our_truth(who: str) -> None:
    held = pairs(SHEFEX, who, 8, 5)
    assert len(held) >= 7
    for coordinates, stars in held:
        assert coordinates.within
        assert stars.within
        assert not coordinates.wrong


@pytest.mark.parametrize("who", oracles.ORACLES)
def test_a_solver_finds_our_stars_through_a_distorted_lens(who: str) -> None:
    """Distortion moves the corners by 12.5 px; the solver knows it from the SIP polynomials of our header."""
    held = pairs(WIDE, who, 4, 5)
    assert len(held) >= 3
    assert all(stars.within for _, stars in held)


@pytest.mark.long
@pytest.mark.parametrize("who", oracles.ORACLES)
def test_two_hundred_frames_are_solved_with_the_predicted_error(who: str) -> None:
    """Nearly all solved, none wrong, and the prediction is right: mean squares of the errors over it are 1, which
    196 frames scatter by 0.07 (two axes) and 0.10 (one). A frame with its own scatter predicts more."""
    held = pairs(SHEFEX, who, 200, 1)
    assert len(held) >= 200 * SOLVED[who]
    for part in zip(*held, strict=True):
        assert sum(not one.within for one in part) <= 1  # 0.6 of 200 by chance
        assert not any(one.wrong for one in part)
        cross, roll = oracles.squares(part)
        assert 0.6 < cross < 1.3
        assert 0.6 < roll < 1.4


def test_a_wrong_header_is_detected() -> None:
    """A sixth of a pixel between truth and header, or the Earth's motion left out (20 arcsec): not within."""
    ray = np.column_stack([np.random.default_rng(1).uniform(-0.1, 0.1, (25, 2)), np.ones(25)])
    ray /= np.linalg.norm(ray, axis=1, keepdims=True)
    sigma = oracles.attitude_spread(ray, np.full(25, 0.12 / 2525))
    for off_rad in (1 / 6 / 2525, 1e-4):
        assert not oracles.Agreement(0, off_rad, 0.0, *sigma, 25).within


@pytest.mark.slow
def test_the_predicted_errors_match_least_squares() -> None:
    """Attitudes and plates of stars of unequal errors, by Monte Carlo: 2,000 draws tell sigma to 1.6 %."""
    rng = np.random.default_rng(2)
    camera = oracles.load(SHEFEX, "tetra3rs", 1).camera
    believed = oracles.onboard_model.calibration(camera)
    xy_px = rng.uniform((0, 0), (camera.width_px - 1, camera.height_px - 1), (20, 2))
    sigma_px = rng.uniform(0.05, 0.2, 20)
    rays = believed.rays(xy_px)
    nothing = np.zeros((20, 3))
    found = oracles.Found(nothing, 1, xy_px, nothing[:, :2], sigma_px, nothing)
    attitude = oracles.attitude_spread(rays, sigma_px / believed.focal_px)
    plate = oracles.plate_spread(found, sigma_px, believed)
    pixels = oracles.lattice(camera.width_px, camera.height_px)
    middle = np.array([(camera.width_px - 1) / 2, (camera.height_px - 1) / 2])
    turns = []
    shifts = []
    for _ in range(2000):
        off_px = sigma_px[:, None] * rng.standard_normal((20, 2))
        turns.append(
            oracles.Rotation.align_vectors(believed.rays(xy_px + off_px), rays)[0].as_rotvec()
        )
        fitted = np.linalg.lstsq(np.column_stack([np.ones(20), xy_px]), off_px, rcond=None)[0]
        moved = np.column_stack([np.ones(len(pixels)), pixels]) @ fitted
        arms = pixels - middle
        spin = np.sum(arms[:, 0] * moved[:, 1] - arms[:, 1] * moved[:, 0]) / np.sum(arms**2)
        shifts.append([*moved.mean(axis=0) / believed.focal_px, spin])
    for drawn, predicted in ((turns, attitude), (shifts, plate)):
        x, y, z = np.std(drawn, axis=0)
        np.testing.assert_allclose(predicted, (np.hypot(x, y), z), rtol=0.06, atol=0)
