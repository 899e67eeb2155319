"""Star images over the field: fits of images drawn by numpy, and uninformative frames."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest
import yaml
from astropy.io import fits
from numpy.typing import NDArray
from scipy import special
from scipy.spatial.transform import Rotation

from skysim.core import files
from skysim.core.errors import InputError
from skysim.core.types import Floats, Frame, Truth
from skysim.experiments.characterize import characterize_camera, night_sky
from skysim.experiments.characterize.night_sky import NightFrame, StarImages
from skysim.experiments.characterize.photon_transfer import Transfer
from skysim.experiments.dome_survey.survey_frames import render_stops
from skysim.scene import loader
from skysim.scene.sections.camera import CameraConfig
from skysim.simulation.lab import build_lab
from skysim.tracking.onboard_model import calibration
from tests.helpers.lens_and_streak import disagreement_px
from tests.helpers.two_samples import histogram_p

SIDE_PX = 700
GAIN_DN_E = 0.4
READ_DN = 2.0
CENTER_PX = ((SIDE_PX - 1) / 2, (SIDE_PX - 1) / 2)
CORNER_PX = SIDE_PX / np.sqrt(2)


def gaussian(at: Floats, center: float, sigma: float) -> Floats:
    """Integral over each pixel, by the error function."""
    edge = (np.append(at, at[-1] + 1) - 0.5 - center) / (np.sqrt(2) * sigma)
    return np.diff(special.erf(edge)) / 2


def drawn(
    rng: np.random.Generator, sigma: float, corner: float, trail_px: float = 0.0
) -> tuple[Floats, Floats]:
    """A frame without black level of some 250 stars on a grid, and their places; trails are along the rows."""
    places = np.stack(
        np.meshgrid(*(np.arange(22.0, SIDE_PX - 22, 42),) * 2), axis=-1
    ).reshape(-1, 2)
    places += rng.uniform(-0.5, 0.5, places.shape)
    light = np.full((SIDE_PX, SIDE_PX), 20.0)
    for x, y in places:
        own = np.hypot(
            sigma, corner * np.hypot(x - CENTER_PX[0], y - CENTER_PX[1]) / CORNER_PX
        )
        columns, rows = (np.arange(int(at) - 12, int(at) + 14) for at in (x, y))
        along = np.mean(
            [
                gaussian(columns, x + trail_px * t, own)
                for t in (np.arange(9) + 0.5) / 9 - 0.5
            ],
            axis=0,
        )
        light[rows[:, None], columns] += (
            5000 * 10 ** rng.uniform(-0.4, 0.4) * np.outer(gaussian(rows, y, own), along)
        )
    return np.rint(
        GAIN_DN_E * rng.poisson(light) + rng.normal(0, READ_DN, light.shape)
    ), places


def fitted(rng: np.random.Generator, *law: float) -> tuple[StarImages, Floats]:
    image, places = drawn(rng, *law)
    start = places + rng.normal(0, 0.1, places.shape)
    return night_sky.fit_images(image, start, GAIN_DN_E, READ_DN**2), places


@pytest.mark.slow
def test_image_sizes_over_the_field_are_recovered_within_their_errors() -> None:
    pulls = []
    for seed in range(6):
        stars, places = fitted(np.random.default_rng(seed), 0.7, 0.5)
        assert np.mean(stars.chi2) == pytest.approx(1, abs=0.03)
        assert np.std((stars.xy_px - places)[stars.flux_dn > 1500]) < 0.03
        size = night_sky.image_size(stars, CENTER_PX, CORNER_PX)
        assert size is not None
        assert size.left_out < 5
        pairs = ((size.sigma_px, 0.7), (size.corner_sigma_px, 0.5))
        assert all(one.sigma < 0.02 * truth for one, truth in pairs)
        pulls.append([(one.value - truth) / one.sigma for one, truth in pairs])
    assert np.all(np.abs(np.mean(pulls, axis=0)) < 4 / np.sqrt(6))
    assert np.all(np.abs(pulls) < 4)


@pytest.mark.slow
def test_double_stars_are_left_out() -> None:
    rng = np.random.default_rng(9)
    image, places = drawn(rng, 0.8, 0.0)
    # Companions at the left.
    image += np.roll(np.where(np.arange(SIDE_PX) < 120, image, 0.0), (1, 2), axis=(0, 1))
    stars = night_sky.fit_images(image, places, GAIN_DN_E, READ_DN**2)
    size = night_sky.image_size(stars, CENTER_PX, CORNER_PX)
    assert size is not None
    assert size.left_out >= 0.9 * np.sum(places[:, 0] < 105)
    assert size.sigma_px.value == pytest.approx(0.8, rel=0.01)


@pytest.mark.slow
def test_trails_are_measured_and_refused() -> None:
    """A streak of length L has the variance L^2 / 12 along it."""
    stars, _ = fitted(np.random.default_rng(4), 0.8, 0.0, 1.6)
    along, across = np.median(stars.stretch_px2, axis=0)
    assert along == pytest.approx(1.6**2 / 12, rel=0.1)
    assert abs(across) < 0.03
    frame = NightFrame(Path("night_1.fits"), None, stars, None)  # type: ignore[arg-type]
    with pytest.raises(
        InputError,
        match=r"night_1.fits: stars trail by 1\.[5-8] px at -?[01]° from the rows; allowed",
    ):
        night_sky.check_trails([frame])
    still, _ = fitted(np.random.default_rng(4), 0.8, 0.0)
    night_sky.check_trails([frame._replace(stars=still)])
    # What the trail adds to the mean variance is taken off.
    assert np.median(night_sky.without_trail(stars).variance_px2) == pytest.approx(
        0.64, rel=0.03
    )
    assert np.median(night_sky.without_trail(still).variance_px2) == pytest.approx(
        0.64, rel=0.01
    )


def test_image_slopes_match_finite_differences() -> None:
    p = np.array([[7.2, 6.7, 900.0, 12.0, np.log(0.8), np.log(1.1)]])
    _, slopes = night_sky.model(p)
    for n in range(6):
        step = np.zeros(6)
        step[n] = 1e-5 * max(abs(p[0, n]), 1)
        difference = (night_sky.model(p + step)[0] - night_sky.model(p - step)[0]) / (
            2 * step[n]
        )
        np.testing.assert_allclose(
            slopes[:, :, n], difference, rtol=1e-6, atol=1e-7 * np.abs(slopes[:, :, n]).max()
        )


def test_a_tilt_of_the_chip_is_detected() -> None:
    """An image with the covariance c: drawn as many small Gaussians along the diagonal."""
    span = np.arange(2 * night_sky.HALF_PX + 1.0)
    light = np.zeros((len(span), len(span)))
    for t in np.linspace(-1, 1, 21):
        light += 200 * np.outer(
            gaussian(span, 7 + 0.7 * t, 1.0), gaussian(span, 7 + 0.7 * t, 1.0)
        )
    image = np.pad(light, 10)
    stars = night_sky.fit_images(image, np.array([[17.0, 17.0]]), 1.0, 0.01)
    covariance = float(np.mean(np.linspace(-1, 1, 21) ** 2) * 0.7**2)
    assert stars.stretch_px2[0, 1] == pytest.approx(2 * covariance, rel=0.25)
    assert abs(stars.stretch_px2[0, 0]) < 1e-3


# Frames of the renderer

CHIP = {
    "quantum_efficiency": 0.6,
    "bits": 12,
    "gain_e_dn": 2.6,
    "offset_dn": 100,
    "full_well_e": 10_000,
    "read_noise_e": 5.0,
    "prnu": 0.009,
    "dark_e_s": 4.0,
    "dsnu": 0.3,
}
TRUE = {
    "width_px": 400,
    "height_px": 300,
    "pixel": "11.8 um",
    "focal_length": "16 mm",
    "f_number": 1.4,
    "distortion": [-0.06, 0.02, 0, 0, 0],
    "psf": {"kind": "gaussian", "sigma_px": 0.8, "corner_sigma_px": 0.6},
    "detector": CHIP,
}
SHEET = TRUE | {
    "focal_length": "16.3 mm",
    "distortion": [0, 0, 0, 0, 0],
    "psf": {"kind": "gaussian"},
}
FRAMES = 12
EXPOSURE_S = 0.1
SATURATION_DN = 3946.0


def transfer() -> Transfer:
    """The photon transfer of this chip, exact."""
    gain = 1 / CHIP["gain_e_dn"]
    values = np.array(
        [
            gain,
            0.0,
            (gain * CHIP["read_noise_e"]) ** 2,
            CHIP["offset_dn"],
            1.0,
            gain * CHIP["dark_e_s"],
        ]
    )
    return Transfer(values, np.zeros((6, 6)), 0.0, 1.0, [])


def rendered(folder: Path, camera: dict[str, Any], seed: int) -> list[tuple[Frame, Truth]]:
    """Frames at rest at attitudes over the whole sky; the camera's file is written into the folder."""
    path = folder / f"camera_{seed}.yaml"
    path.write_text(yaml.safe_dump({"camera": camera}), encoding="utf-8")
    overrides = {
        "camera.preset": str(path),
        "exposure.time": f"{EXPOSURE_S} s",
        "seed": seed,
        "exposure.frames": 1,
    }
    lab = build_lab(loader.load_scene("shefex2", overrides))
    return list(render_stops(lab, Rotation.random(FRAMES, rng=np.random.default_rng(3))))


@pytest.mark.slow
def test_lens_and_star_images_are_recovered_and_reproduce_the_frames(
    tmp_path: Path,
) -> None:
    truth = rendered(tmp_path, TRUE, 1)
    for n, (frame, _) in enumerate(truth):
        files.write_png16(
            files.make_folder(tmp_path / "night") / f"night_{n}.png", frame.image_dn
        )
    config = CameraConfig.model_validate(SHEET)
    night = night_sky.measure_night(config, tmp_path / "night", transfer(), SATURATION_DN)
    assert night.identified == FRAMES
    assert night.size.sigma_px.value == pytest.approx(0.8, rel=0.02)
    assert night.size.corner_sigma_px.value == pytest.approx(0.6, rel=0.05)
    assert night.lens is not None
    found = night_sky.lens_estimates(config, night.lens)
    assert found["focal_length_mm"].value == pytest.approx(16.0, rel=1e-3)
    assert (
        disagreement_px(night.lens.camera, calibration(CameraConfig.model_validate(TRUE)))
        < 0.1
    )
    psf = {"kind": "gaussian", "sigma_px": night.size.sigma_px.value}
    psf["corner_sigma_px"] = night.size.corner_sigma_px.value
    measured = {
        key: value
        for key, (value, _) in characterize_camera.measured_lens(config, night).items()
        if "." not in key
    }
    ours = rendered(
        tmp_path, TRUE | measured | {"psf": psf, "detector": CHIP | {"hardware_seed": 5}}, 2
    )
    wide = rendered(
        tmp_path,
        TRUE | {"psf": psf | {"sigma_px": 0.88}, "detector": CHIP | {"hardware_seed": 5}},
        2,
    )
    near = [star_pixels(one) for _, one in truth]
    first, same, other = (
        np.concatenate(
            [frame.image_dn[mask] for (frame, _), mask in zip(frames, near, strict=True)]
        )
        for frames in (truth, ours, wide)
    )
    assert histogram_p(first, same) > 0.01
    assert histogram_p(first, other) < 1e-3


@pytest.mark.slow
@pytest.mark.parametrize("top_down", [True, False])
def test_frames_without_a_row_order_are_identified_in_both(
    top_down: bool, tmp_path: Path
) -> None:
    """As `skysim solve` does; astropy writes row 0 first, the standard takes it for the lowest."""
    folder = files.make_folder(tmp_path / "night")
    for n, (frame, _) in enumerate(rendered(tmp_path, TRUE, 1)):
        rows = frame.image_dn if top_down else frame.image_dn[::-1]
        fits.PrimaryHDU(rows).writeto(folder / f"{n}.fits")
    config = CameraConfig.model_validate(SHEET)
    night = night_sky.measure_night(config, folder, transfer(), SATURATION_DN)
    assert night.identified == FRAMES
    assert ("rows: no ROWORDER" in " ".join(night.remarks)) == top_down
    assert night.lens is not None
    true = calibration(CameraConfig.model_validate(TRUE))
    assert disagreement_px(night.lens.camera, true) < 0.1


def star_pixels(truth: Truth) -> NDArray[np.bool_]:
    """Pixels within 3 px of a star that can be detected."""
    mask = np.zeros((TRUE["height_px"], TRUE["width_px"]), bool)
    for x, y in truth.sources.flux_xy_px[truth.sources.snr > 8]:
        mask[max(round(y) - 3, 0) : round(y) + 4, max(round(x) - 3, 0) : round(x) + 4] = True
    return mask
