"""SHEFEX-2's formulas and geometry against the renderer, and its experiments, shortened (Samaan & Theil 2011)."""

from __future__ import annotations

import math
from functools import cache

import numpy as np
import pytest
from scipy.spatial.transform import Rotation
from scipy.special import erf

from estimator.catalog import catalog, pair_index
from estimator.core.checks import Floats
from estimator.identification.published.shefex import ShefexOptions, search
from skysim.camera.render import Window, render
from skysim.core.paths import CATALOGS
from skysim.core.types import Trajectory
from skysim.experiments.papers import published
from skysim.scene.loader import load
from skysim.simulation.lab import Lab, build_lab
from skysim.tracking import onboard_model

EXPOSURE_S = 0.05
COS_ERROR = 5.5e-5
FIELD_RAD = np.radians(18.57)


@cache
def lab(**overrides: str) -> Lab:
    keys = {name.replace("__", "."): value for name, value in overrides.items()}
    return build_lab(load("shefex2", {"light.catalog": "hipparcos_hp6.5"} | keys))


def star_image(shown: Lab, exposure_s: float = EXPOSURE_S, rate_deg_s: float = 0.0) -> Floats:
    """(H, W) noise-free electrons of the brightest star, at the image's center and moving along its row."""
    camera = shown.camera
    brightest = camera.sources.take(np.array([np.argmax(camera.sources.strength)]))
    cam_from_lab = Rotation.align_vectors([[0.0, 0.0, 1.0]], brightest.place[:, :3])[0]
    body_from_cam = camera.mount.cam_from_body.inv()
    rate_body = body_from_cam.apply([0.0, np.radians(rate_deg_s), 0.0])
    t_s = np.linspace(-0.01, exposure_s + 0.01, 9)
    turned = Rotation.from_rotvec(np.outer(t_s - exposure_s / 2, rate_body))
    lab_from_body = (body_from_cam * cam_from_lab).inv() * turned
    motion = Trajectory(t_s, lab_from_body, np.tile(rate_body, (len(t_s), 1)))
    image = np.zeros(camera.canvas.shape)
    render(image, brightest, camera.optics, motion, camera.mount, Window(0.0, exposure_s))
    return image


def variance_px2(image: Floats) -> Floats:
    """(2,) variances of an image about its centroid along x and y."""
    y, x = np.indices(image.shape)
    total = image.sum()
    means = [(image * axis).sum() / total for axis in (x, y)]
    return np.array(
        [
            (image * (axis - mean) ** 2).sum() / total
            for axis, mean in zip((x, y), means, strict=True)
        ]
    )


# Section 2.1 and table 1: 659 x 493 pixels of 9.9 um behind 25 mm.


def test_the_fields_are_the_printed_ones_and_the_diagonal_is_not() -> None:
    """Section 2.1: "14.87 deg x 11.15 deg, which results in a diagonal FOV of 18.57 deg"; it is 18.51 deg."""
    camera = onboard_model.calibration(load("shefex2", {}).camera)
    x, y = camera.center_px
    ends = [[(-0.5, y), (658.5, y)], [(x, -0.5), (x, 492.5)], [(-0.5, -0.5), (658.5, 492.5)]]
    rays = [camera.rays(np.array(pair)) for pair in ends]
    horizontal, vertical, diagonal = (float(np.degrees(np.arccos(a @ b))) for a, b in rays)
    assert horizontal == pytest.approx(14.87, abs=0.005)
    assert vertical == pytest.approx(11.15, abs=0.005)
    half = np.hypot(659, 493) / 2 * 9.9e-6 / 25e-3
    assert diagonal == pytest.approx(np.degrees(2 * np.arctan(half)), rel=1e-9)
    assert diagonal == pytest.approx(18.51, abs=0.005)
    assert math.hypot(horizontal, vertical) == pytest.approx(18.58, abs=0.01)


# Section 3.1: smear and light.


@pytest.mark.slow
@pytest.mark.parametrize("rate_deg_s", [2.0, 4.0])
def test_smear_is_rate_times_time_and_the_peak_falls_as_that_of_a_line(
    rate_deg_s: float,
) -> None:
    """A line of L pixels adds L^2 / 12 to the variance and has the share erf(1 / (2 sqrt 2 sigma)) / L in its pixel.

    At 2 deg/s L is 4.4 px ("a maximum image smear of 4.5 pixel"), and the brightest pixel loses 0.91 mag.
    """
    moving = star_image(lab(), rate_deg_s=rate_deg_s)
    at_rest = star_image(lab())
    length_px = math.radians(rate_deg_s) * EXPOSURE_S * 25e-3 / 9.9e-6
    added = variance_px2(moving)[0] - variance_px2(at_rest)[0]
    assert math.sqrt(12 * added) == pytest.approx(length_px, rel=2e-3)
    alone = erf(0.5 / (0.7 * math.sqrt(2)))
    # The line's own ends are rounded by the blur: a few thousandths.
    loss_mag = 2.5 * math.log10(at_rest.max() / moving.max())
    assert loss_mag == pytest.approx(2.5 * math.log10(alone * length_px), abs=0.02)
    if rate_deg_s == 2:
        assert length_px == pytest.approx(4.5, abs=0.1)
        assert loss_mag == pytest.approx(0.91, abs=0.02)


@pytest.mark.slow
def test_the_light_of_50_ms_under_the_air_is_that_of_35_ms_in_space() -> None:
    """Section 3.1: the atmosphere absorbs about 30 %, so 50 ms on ground are "equivalent to about 35 ms in space"."""
    on_ground = star_image(lab(camera__transmission="0.595"), 0.05).sum()
    assert on_ground == pytest.approx(star_image(lab(), 0.035).sum(), rel=1e-6)


# Section 4: the focusing range of 0.1 mm.


@pytest.mark.slow
def test_the_blur_disk_is_the_defocus_over_the_f_number() -> None:
    """0.1 mm / 1.4 = 71 um: 7.2 px. A uniform disk of diameter D adds D^2 / 16 to the variance along an axis."""
    added = variance_px2(star_image(lab(camera__focus="6.275 m"))) - variance_px2(
        star_image(lab())
    )
    assert 4 * math.sqrt(added.mean()) == pytest.approx(1e-4 / 1.4 / 9.9e-6, rel=0.01)


# Section 3.4: equations 1 and 5.


@cache
def pairs() -> pair_index.PairIndex:
    chosen = catalog.read(CATALOGS / "shefex_chosen.ecsv")
    return pair_index.build(chosen.vectors, FIELD_RAD)


@pytest.mark.slow
def test_the_triangles_of_fifteen_are_the_binomial_coefficient() -> None:
    """Eq. 1: 15! / (3! 12!) = 455, all of which a search tries on lights that are no stars."""
    camera = onboard_model.calibration(lab().scene.camera)
    lights_px = np.random.default_rng(2).random((15, 2)) * [659, 493] - 0.5
    counters = np.zeros(3, np.int64)
    options = ShefexOptions(COS_ERROR, 1e-3, 10**9, 10**9, 15, -np.inf)
    search(camera.rays(lights_px), pairs(), options, counters)
    assert counters[2] == 455


def test_equation_5_fails_as_printed_and_holds_when_corrected() -> None:
    """Printed is ceil((cos a - cosError) / m + q / m) for the upper index; + cosError and - q / m is right.

    Of 500 measured pairs, within cosError of true ones, all printed indices are outside of the k-vector, and no true
    pair is outside of the corrected range.
    """
    rng = np.random.default_rng(3)
    cosines = np.sort(np.cos(pairs().angle_rad))
    kvector, slope, offset = pair_index.k_vector(cosines)
    true_pair = rng.integers(0, len(cosines), 500)
    measured = cosines[true_pair] + COS_ERROR * rng.uniform(-1, 1, 500)
    last = len(kvector) - 1
    printed = np.ceil((measured - COS_ERROR) / slope + offset / slope)
    assert np.all((printed < 0) | (printed > last))
    low = np.floor((measured - COS_ERROR - offset) / slope)
    high = np.ceil((measured + COS_ERROR - offset) / slope)
    begin = np.where(low < 0, 0, kvector[np.clip(low, 0, last).astype(int)])
    end = kvector[np.clip(high, 0, last).astype(int)]
    assert np.all((begin <= true_pair) & (true_pair < end))


# The experiments.

EXPERIMENTS = published.read(published.FOLDER / "shefex.yaml").experiments
