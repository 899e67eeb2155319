"""Laws of a frame's sky: a steep one and the columns of readout smear are subtracted, and the stars stay."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as some

from estimator.core.checks import Floats
from estimator.core.errors import ImageError
from estimator.core.types import FramePriors
from estimator.detection import background, detect
from estimator.trackers.pipeline import Settings
from tests.helpers.laws import SEEDS, law

pytestmark = pytest.mark.slow
SIDE = 256
SIGMA_PX = 1.2
NOISE = 4.0
FULL = 60_000.0


def star(x_px: float, y_px: float, flux: float) -> Floats:
    """The light of a star in every pixel."""
    y, x = np.mgrid[:SIDE, :SIDE]
    squares = (x - x_px) ** 2 + (y - y_px) ** 2
    light: Floats = np.exp(-squares / (2 * SIGMA_PX**2)) * flux / (2 * np.pi * SIGMA_PX**2)
    return light


def beside(place_px: Floats) -> np.ndarray:
    """The pixels within 5 px of a place."""
    y, x = np.mgrid[:SIDE, :SIDE]
    return (x - place_px[0]) ** 2 + (y - place_px[1]) ** 2 < 25


@law(background.flattened)
@given(rng=SEEDS, slope=some.floats(-8, 8), bend=some.floats(-0.02, 0.02))
def test_a_curved_sky_becomes_level_and_a_star_keeps_its_light(
    rng: np.random.Generator, slope: float, bend: float
) -> None:
    y, x = np.mgrid[:SIDE, :SIDE] - SIDE / 2
    sky = 3000 + slope * x + bend * (x**2 + x * y)
    place_px = rng.uniform(60, SIDE - 60, 2)
    flux = 8000.0
    frame = sky + star(*place_px, flux) + rng.normal(0, NOISE, sky.shape)
    flat = background.flattened(frame, FULL)
    near = beside(place_px)
    level = np.median(flat[~near])
    # Sixteen parts of the frame are equally bright to a part of the noise.
    parts = flat.reshape(4, SIDE // 4, 4, SIDE // 4).swapaxes(1, 2).reshape(16, -1)
    assert np.ptp(np.median(parts, axis=1)) < NOISE
    # A tenth of the light counts as sky. The brightest pixel is one like others.
    assert np.sum(flat[near] - level) == pytest.approx(flux, rel=0.15)
    y_px, x_px = np.unravel_index(np.argmax(flat), flat.shape)
    assert flat[y_px, x_px] - level < 1.3 * star(*place_px, flux).max() + 5 * NOISE


@law(background.without_smear)
@given(rng=SEEDS, share=some.floats(0.02, 0.5), integers=some.booleans())
def test_a_smeared_column_becomes_as_bright_as_its_neighbors(
    rng: np.random.Generator, share: float, integers: bool
) -> None:
    place_px = rng.uniform(60, SIDE - 60, 2)
    light = star(*place_px, 40_000)
    # A share of the column's light in each of its pixels (readout under light)
    smear = share * light.sum(axis=0) / 10
    frame = 500 + light + smear + rng.normal(0, NOISE, light.shape)
    frame = np.rint(frame).astype(np.uint16) if integers else frame
    plain, _ = background.without_smear(frame, FULL)
    assert plain.dtype == frame.dtype
    column = np.mean(plain[:40], axis=0)
    assert np.abs(column - 500).max() < 5 * NOISE / np.sqrt(40) + 0.5
    near = beside(place_px)
    assert np.sum(plain[near] - 500.0) == pytest.approx(light[near].sum(), rel=0.05)


@law(background.cleaned)
@given(rng=SEEDS)
def test_a_dark_frame_is_cleaned_of_nothing(rng: np.random.Generator) -> None:
    frame = 200 + star(*rng.uniform(20, SIDE - 20, 2), 5000)
    frame += rng.normal(0, NOISE, frame.shape)
    find = detect.DETECTORS["local"]
    priors = FramePriors()
    image, blobs = background.cleaned(find, frame, priors, 5.0, 3, 50)
    assert image is frame
    np.testing.assert_array_equal(blobs.xy_px, find(frame, 5.0, 3, 50, priors).xy_px)


@law(detect.to_blobs)
@given(count=some.integers(1, 40), most=some.integers(1, 50), area_px=some.integers(1, 9))
def test_the_brightest_blobs_of_enough_pixels_are_kept(
    count: int, most: int, area_px: int
) -> None:
    """Lights on a dark frame, of which each is brighter than the one before."""
    frame = np.full((SIDE, SIDE), 100.0)
    for n in range(count):
        row, column = divmod(n, 8)
        frame[20 + 24 * row : 23 + 24 * row, 20 + 24 * column : 23 + 24 * column] += 900 + n
    blobs = detect.DETECTORS["local"](frame, 5.0, area_px, most, FramePriors())
    assert len(blobs) == min(count, most)
    brightest = np.arange(count)[::-1][:most]
    row, column = np.divmod(brightest, 8)
    places = np.column_stack([21 + 24 * column, 21 + 24 * row])
    np.testing.assert_allclose(blobs.xy_px, places.reshape(-1, 2), rtol=0, atol=0.1)


def test_a_frame_of_texture_is_refused() -> None:
    frame = np.zeros((1200, 1200))
    frame[::6, ::6] = frame[1::6, ::6] = frame[::6, 1::6] = 1000.0
    with pytest.raises(ImageError, match=r"over .* blobs: the frame is noise or texture"):
        detect.DETECTORS["local"](frame, 5.0, 1, 50, FramePriors())


@law(Settings.searched_sigma_px)
@given(sigma_px=some.none() | some.floats(0, 5))
def test_searches_use_the_given_floor_or_the_usual_one(sigma_px: float | None) -> None:
    found = Settings(centroid_sigma_px=sigma_px).searched_sigma_px
    assert found == (0.1 if sigma_px is None else sigma_px)


@law()
@given(rng=SEEDS, height=some.integers(1, 6), width=some.integers(1, 6))
def test_a_sky_is_steep_if_many_steps_exceed_the_noise(
    rng: np.random.Generator, height: int, width: int
) -> None:
    """Steps down and to the right of each tile, by NumPy's differences."""
    level = rng.normal(size=(height, width))
    noise = np.full(level.shape, rng.uniform(0.5, 5))
    step = np.abs(np.diff(level, axis=0)[:, 1:]) + np.abs(np.diff(level, axis=1)[1:])
    steep = np.sum(step > noise[1:, 1:]) > background.STEEP * step.size
    assert background.is_steep(level, noise) == steep
