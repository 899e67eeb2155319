"""Color cameras: each pixel has the light of its filter, and the tracker makes a gray image of them."""

from __future__ import annotations

import functools
import math
from typing import Any

import cv2
import numpy as np
import pytest
from scipy.special import erf

from estimator.detection.bayer import PATTERNS, WB, WG, WR, gray_from_bayer
from skysim.core.errors import InputError
from skysim.core.paths import DATA
from skysim.core.types import Floats, Frame, Truth
from skysim.scene import loader
from skysim.simulation.exposure import render_at_rest
from skysim.simulation.lab import StarCamera, build_lab, build_tracker
from skysim.sources.photometry import temperature_k
from skysim.tracking import factory

COLORS = "{red: bayer_red, green: bayer_green, blue: bayer_blue}"
SHARP_PX = (
    1.5  # sigma of images so wide that every color of the mosaic samples the same light
)
STILL = {
    "exposure": "{time: 200 ms, rate_hz: 1, frames: 1}",
    "motion.rate_deg_s": "[0, 0, 0]",
    "camera.psf.sigma_px": str(SHARP_PX),
    "light.limit_mag": "6",
}
# Lonely stars of the frame with their B-V and V-I: a K giant and a B9 star.
RED_STAR = (27750, 1.382, 1.31)
BLUE_STAR = (26594, -0.098, -0.02)


@functools.cache
def taken(**changes: str) -> tuple[StarCamera, Frame, Truth]:
    """SHEFEX-2's camera at rest towards Orion, its frame and its truth."""
    own = {f"camera.detector.{key}": value for key, value in changes.items()}
    lab = build_lab(loader.load("shefex2", STILL | own))
    return lab.camera, *render_at_rest(lab.camera, lab.start)


def expected(**changes: str) -> tuple[StarCamera, Floats, Truth]:
    """The same as the expected number of electrons of light in each pixel, without fixed pattern."""
    clean = {"noise": "false", "prnu": "0", "dark_e_s": "0", "hot_pixels": "0"}
    camera, frame, truth = taken(**clean, **changes)
    config = camera.scene.camera.detector
    return camera, (frame.image_dn - config.offset_dn) * config.gain_e_dn, truth


def photons_in(curve: str, kelvin: float) -> float:
    """Integral of Planck's photons times a curve, by the trapezoidal rule on its samples each nanometer."""
    rows = (DATA / curve).read_text().splitlines()
    nm, response = np.loadtxt(
        [row for row in rows if row[0].isdigit()], delimiter=",", unpack=True
    )
    grid = np.arange(nm[0], nm[-1] + 0.5)
    photons = grid**-4 / np.expm1(1.438777e7 / grid / kelvin)
    return float(np.trapezoid(photons * np.interp(grid, nm, response), grid))


def star_e(light_e: Floats, truth: Truth, star: int, weight: Floats) -> float:
    """Electrons of a star within 8 pixels of its image, each pixel times the weight (2, 2) of its filter."""
    x, y = truth.sources.xy_px[list(truth.sources.id).index(star)].round().astype(int)
    tiled = np.tile(weight, (light_e.shape[0] // 2 + 1, light_e.shape[1] // 2 + 1))
    part = np.s_[y - 8 : y + 9, x - 8 : x + 9]
    return float((light_e[part] * tiled[part]).sum())


def test_three_equal_filters_are_a_monochrome_camera_bit_for_bit() -> None:
    _, gray, _ = taken(quantum_efficiency="cmos")
    _, mosaic, _ = taken(
        quantum_efficiency="{red: cmos, green: cmos, blue: cmos}", bayer="GBRG"
    )
    np.testing.assert_array_equal(mosaic.image_dn, gray.image_dn)


@pytest.mark.parametrize("pattern", PATTERNS)
def test_a_sunlit_flat_field_has_the_ratios_of_the_three_responses(pattern: str) -> None:
    """A sky as bright as V 5 a square arcsecond, of the light of a G2 star, 5,770 K in the table."""
    sky = {"background": "[{kind: sky, mag_arcsec2: 5}]", "light.limit_mag": "0"}
    own = {"bayer": pattern, "quantum_efficiency": COLORS, "noise": "false", "prnu": "0"}
    lab = build_lab(
        loader.load(
            "shefex2", STILL | sky | {f"camera.detector.{key}": v for key, v in own.items()}
        )
    )
    frame, _ = render_at_rest(lab.camera, lab.start)
    config = lab.scene.camera.detector
    dark_dn = float(config.dark_e_s * 2**config.doublings * 0.2 / config.gain_e_dn)
    kelvin = float(temperature_k(0.650, 0.713))
    for name in "red", "green", "blue":
        n = pattern.index(name[0].upper())
        pixels = frame.image_dn[n // 2 :: 2, n % 2 :: 2] - config.offset_dn - dark_dn
        g = pattern.index("G")
        green = frame.image_dn[g // 2 :: 2, g % 2 :: 2] - config.offset_dn - dark_dn
        ratio = photons_in(f"qe/bayer_{name}.csv", kelvin) / photons_in(
            "qe/bayer_green.csv", kelvin
        )
        center = np.s_[100:120, 150:170]
        assert pixels[center].mean() / green[center].mean() == pytest.approx(ratio, rel=2e-3)


@pytest.mark.parametrize("name", ["red", "green", "blue"])
def test_a_star_s_magnitude_through_a_filter_follows_its_color(name: str) -> None:
    """Black bodies of the stars' temperatures in the filter, relative to their V magnitudes."""
    camera, light_e, truth = expected(bayer="RGGB", quantum_efficiency=COLORS)
    weight = np.array([[c == name[0] for c in "rg"], [c == name[0] for c in "gb"]]) * 1.0
    sources = camera.sources
    measured = []
    predicted = []
    for star, b_v, v_i in RED_STAR, BLUE_STAR:
        kelvin = float(temperature_k(b_v, v_i))
        v_mag = float(sources.magnitude[list(sources.id).index(star)])
        measured.append(-2.5 * math.log10(star_e(light_e, truth, star, weight)) - v_mag)
        ratio = photons_in(f"qe/bayer_{name}.csv", kelvin) / energy_in_v(kelvin)
        predicted.append(-2.5 * math.log10(ratio))
    assert measured[0] - measured[1] == pytest.approx(predicted[0] - predicted[1], abs=0.02)


def energy_in_v(kelvin: float) -> float:
    """Integral of Planck's power in Johnson's V."""
    rows = (DATA / "bands/johnson_v.csv").read_text().splitlines()
    nm, response = np.loadtxt(
        [row for row in rows if row[0].isdigit()], delimiter=",", unpack=True
    )
    grid = np.arange(nm[0], nm[-1] + 0.5)
    power = grid**-5 / np.expm1(1.438777e7 / grid / kelvin)
    return float(np.trapezoid(power * np.interp(grid, nm, response), grid))


def test_the_truth_has_the_electrons_that_all_filters_together_pass() -> None:
    _, light_e, truth = expected(bayer="RGGB", quantum_efficiency=COLORS)
    row = list(truth.sources.id).index(BLUE_STAR[0])
    assert len(set(truth.sources.id)) == len(truth.sources.id)
    assert star_e(light_e, truth, BLUE_STAR[0], np.ones((2, 2))) == pytest.approx(
        truth.sources.electrons[row], rel=2e-3
    )


@pytest.mark.slow
def test_the_tracker_solves_a_color_frame() -> None:
    camera, frame, truth = taken(bayer="BGGR", quantum_efficiency=COLORS)
    found = factory.solve_frame(build_tracker(camera), frame).attitude.cam_from_ref
    assert found is not None
    assert (found * truth.cam_from_lab.inv()).magnitude() < 1e-4


CV2_NAMES = {
    "RGGB": cv2.COLOR_BayerRGGB2GRAY,
    "BGGR": cv2.COLOR_BayerBGGR2GRAY,
    "GRBG": cv2.COLOR_BayerGRBG2GRAY,
    "GBRG": cv2.COLOR_BayerGBRG2GRAY,
}


@pytest.mark.parametrize("pattern", PATTERNS)
def test_gray_is_opencv_s_bilinear_demosaicing(pattern: str) -> None:
    raw = np.random.default_rng(3).integers(0, 4095, (31, 44)).astype(np.uint16)
    gray = gray_from_bayer(raw, pattern)
    theirs = cv2.cvtColor(raw, CV2_NAMES[pattern])
    inner = np.s_[1:-1, 1:-1]
    assert gray.dtype == np.uint16
    # Their weights have three digits (0.299), ours four.
    assert np.abs(gray[inner].astype(int) - theirs[inner]).max() <= 1


def test_a_saturated_pixel_stays_saturated_in_gray() -> None:
    raw = np.full((16, 16), 100, np.uint16)
    raw[7, 8] = 4095
    assert (gray_from_bayer(raw, "RGGB", 4095.0) >= 4095).sum() == 1
    assert (gray_from_bayer(raw, "RGGB") >= 4095).sum() == 0


def gaussian_px(center: float, sigma_px: float) -> Floats:
    """Fractions of a Gaussian in 40 pixels."""
    edges = (np.arange(41) - 0.5 - center) / sigma_px / math.sqrt(2)
    return np.diff(erf(edges)) / 2


@pytest.mark.slow
@pytest.mark.parametrize("sigma_px", [0.4, 0.5, 0.7, 1.0])
def test_the_centroid_of_a_narrow_colored_star_is_biased_as_the_mosaic_samples_it(
    sigma_px: float,
) -> None:
    """Gray keeps first moments, so a light's center of gravity is that of the raw pixels with the weights 4 WR r,
    2 WG g, 4 WB b. Along x they are m0 + m1 (-1)^x for a center between two rows, and by Poisson's sum, with F(w) the
    transform of a pixel's Gaussian,

        bias = 2 (m1 F'(pi) sin(pi x) + m0 F'(2 pi) sin(2 pi x)) / (m0 + 2 m1 F(pi) cos(pi x)).
    """
    r, g, b = 0.9, 0.5, 0.1  # a red star
    red, green, blue = 4 * WR * r, 2 * WG * g, 4 * WB * b
    m0 = (red + 2 * green + blue) / 4
    m1 = (red - blue) / 4

    def transform(w: float) -> float:
        return math.exp(-((sigma_px * w) ** 2) / 2) * math.sin(w / 2) / (w / 2)

    def slope(w: float) -> float:
        return (transform(w + 1e-5) - transform(w - 1e-5)) / 2e-5

    gains = np.tile([[r, g], [g, b]], (20, 20))
    for x in 20.0, 20.2, 20.5, 20.8:
        raw = gains * np.outer(gaussian_px(20.5, sigma_px), gaussian_px(x, sigma_px))
        gray = gray_from_bayer(raw, "RGGB")
        bias = (gray.sum(axis=0) @ np.arange(40)) / gray.sum() - x
        mosaic = m1 * slope(math.pi) * math.sin(math.pi * x)
        pixels = m0 * slope(2 * math.pi) * math.sin(2 * math.pi * x)
        total = m0 + 2 * m1 * transform(math.pi) * math.cos(math.pi * x)
        assert bias == pytest.approx(2 * (mosaic + pixels) / total, abs=5e-4)


@pytest.mark.parametrize(
    ("changes", "told"),
    [
        ({"bayer": "RGGB"}, "one with bayer: RGGB"),
        ({"quantum_efficiency": COLORS}, "three curves with bayer: none"),
        ({"bayer": "RGBG"}, "RGGB"),
        (
            {"bayer": "RGGB", "quantum_efficiency": COLORS.replace("_red", "_rot")},
            "bayer_rot",
        ),
    ],
)
def test_a_mosaic_and_its_curves_go_together(changes: dict[str, Any], told: str) -> None:
    with pytest.raises(InputError, match=told):
        loader.load("shefex2", {f"camera.detector.{key}": v for key, v in changes.items()})
