"""photutils and sep measure the true light of our frames (extra `oracle`)."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest

from skysim.scene import loader
from skysim.simulation.flight import simulate_motion

CLEAN = {
    "exposure.frames": "1",
    "light.limit_mag": "5.0",
    "motion.rate_deg_s": "[0, 0, 0]",
    "camera.detector.prnu": "0",
    "camera.detector.hot_pixels": "0",
    "camera.detector.dsnu": "0",
    "camera.detector.cti_parallel": "0",
    "camera.detector.cti_serial": "0",
    "camera.shutter": "{kind: global}",
}


@pytest.fixture(scope="module")
def stars() -> dict[str, Any]:
    """A still frame of bright stars without background, and the truth of isolated stars inside the frame."""
    loaded = loader.load("shefex2", CLEAN)
    frame, truth = simulate_motion(loaded).render(0)
    part = loaded.camera.detector
    seen = truth.sources
    image_e = (frame.image_dn.astype(float) - part.offset_dn) * part.gain_e_dn
    image_e -= part.dark_e_s * frame.exposure_s
    apart = np.linalg.norm(seen.xy_px[:, None] - seen.xy_px, axis=2) + 1e9 * np.eye(
        len(seen.id)
    )
    inside = ((seen.xy_px > 15) & (seen.xy_px < [643, 477])).all(axis=1)
    good = inside & (apart.min(axis=1) > 25) & ~seen.saturated
    assert good.sum() >= 10
    noise_e = np.hypot(part.read_noise_e, part.gain_e_dn / np.sqrt(12))
    return {
        "image": image_e,
        "xy": seen.xy_px[good],
        "electrons": seen.electrons[good],
        "noise_e": noise_e,
    }


def within_its_noise(flux: np.ndarray, stars: dict[str, Any], area_px: float) -> None:
    """Check all errors and each one against the star's shot noise and the aperture's read noise."""
    sigma = np.sqrt(stars["electrons"] + area_px * stars["noise_e"] ** 2)
    pull = (flux - stars["electrons"]) / sigma
    assert np.abs(pull).max() < 4
    assert np.abs(pull.mean()) < 4 / np.sqrt(len(pull))


def test_photutils_measures_the_true_electrons(stars: dict[str, Any]) -> None:
    aperture = pytest.importorskip("photutils.aperture")
    circles = aperture.CircularAperture(stars["xy"], r=4.0)
    flux = np.asarray(aperture.aperture_photometry(stars["image"], circles)["aperture_sum"])
    within_its_noise(flux, stars, np.pi * 16)


def test_sep_measures_the_true_electrons(stars: dict[str, Any]) -> None:
    sep = pytest.importorskip("sep")
    image = np.ascontiguousarray(stars["image"])
    flux, _, flag = sep.sum_circle(image, stars["xy"][:, 0], stars["xy"][:, 1], 4.0, subpix=0)
    assert not flag.any()
    within_its_noise(flux, stars, np.pi * 16)


def test_sep_finds_the_stars_at_their_positions(stars: dict[str, Any]) -> None:
    sep = pytest.importorskip("sep")
    found = sep.extract(np.ascontiguousarray(stars["image"]), 6.0, err=stars["noise_e"])
    away = np.linalg.norm(
        np.column_stack([found["x"], found["y"]])[:, None] - stars["xy"], axis=2
    )
    bright = stars["electrons"] > 3000
    assert bright.any()
    assert away.min(axis=0)[bright].max() < 0.2
