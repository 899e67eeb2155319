"""Tools of SHEFEX-2's experiments against geometry, counting and theory."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.spatial.transform import Rotation
from scipy.special import erf

from estimator.identification.published.shefex import FOURTH_STAR
from skysim.core.types import Frame
from skysim.experiments.papers import (
    shefex_camera,
    shefex_identification,
    shefex_nights,
    shefex_setup,
)
from skysim.experiments.papers.compare import ExperimentOptions, bootstrap_of_means
from skysim.experiments.papers.shefex_setup import StarField, pairs, random_fields, shefex_lab
from skysim.scene.loader import load
from skysim.tracking import onboard_model
from skysim.tracking.factory import ExposureController

pytestmark = pytest.mark.long  # compiles the paper's algorithms for ten seconds


def test_the_bootstrap_of_means_matches_theory_and_skips_missing_values() -> None:
    """A mean's 95 % interval is +-1.96 sigma / sqrt(N); NaN values are skipped."""
    values = np.random.default_rng(1).normal(3.0, 2.0, 4000)
    found = bootstrap_of_means(values[:, None], lambda m: m[..., 0])
    half = 1.96 * values.std() / np.sqrt(len(values))
    assert found.value == pytest.approx(values.mean(), rel=1e-12)
    # The ends of 999 resamples are good to a tenth of the half.
    assert found.high - found.value == pytest.approx(half, rel=0.15)
    assert found.value - found.low == pytest.approx(half, rel=0.15)
    holed = np.where(np.arange(4000) % 2, values, np.nan)
    assert bootstrap_of_means(holed[:, None], lambda m: m[..., 0]).value == pytest.approx(
        values[1::2].mean(), rel=1e-12
    )


def test_a_field_s_stars_are_the_catalog_s_where_the_attitude_puts_them() -> None:
    camera = onboard_model.calibration(shefex_lab().scene.camera)
    for field in random_fields(5, 3):
        shown = camera.pixels(field.cam_from_ref.apply(pairs().vectors))
        shown = shown[camera.contains(np.nan_to_num(shown, nan=-1e9))]
        assert len(shown) == len(field.xy_px)
        apart = np.linalg.norm(field.xy_px[:, None] - shown[None], axis=2).min(axis=1)
        # Aberration and proper motion by two codes: thousandths of a pixel.
        assert apart.max() < 0.01


@pytest.mark.long
def test_without_noise_a_field_is_named_and_its_attitude_found() -> None:
    field = next(one for one in random_fields(20, 4) if len(one.xy_px) >= 6)
    result = shefex_identification.identify(
        field, 1e-6, 1e-5, 0, FOURTH_STAR, np.random.default_rng(1)
    )
    assert (result.right, result.wrong) == (1.0, 0.0)
    assert np.abs(result.error_deg).max() < 1e-3


def test_three_stars_are_no_success() -> None:
    field = StarField(
        np.array([[100.0, 100.0], [300.0, 80.0], [200.0, 400.0]]), Rotation.identity()
    )
    result = shefex_identification.identify(
        field, 0.1, 1e-4, 0, FOURTH_STAR, np.random.default_rng(1)
    )
    assert (result.right, result.wrong) == (0.0, 0.0)


def test_the_triangles_of_fifteen_are_the_binomial_coefficient() -> None:
    assert (
        shefex_identification.count_triangles(np.random.default_rng(2)) == 15 * 14 * 13 // 6
    )


def test_equation_5_fails_as_printed_and_holds_when_corrected() -> None:
    assert shefex_identification.eq5_failures(np.random.default_rng(3), 500) == (500, 0)


def test_the_crossing_of_a_line_and_a_limit_is_interpolated() -> None:
    """0.2 deg a pixel passes 0.1 deg at half a pixel; one that stays below ends at the last."""
    yaw_deg = 0.2 * shefex_identification.ERRORS_PX
    assert shefex_identification.error_at_limit(1.0, yaw_deg**2) == pytest.approx(
        0.5, abs=0.01
    )
    assert shefex_identification.error_at_limit(2.0, yaw_deg**2) == pytest.approx(
        0.25, abs=0.01
    )
    assert (
        shefex_identification.error_at_limit(1.0, 1e-4 * yaw_deg**2)
        == shefex_identification.ERRORS_PX[-1]
    )


@pytest.mark.parametrize("rate_deg_s", [2.0, 4.0])
def test_smear_is_rate_times_time_and_the_peak_falls_as_that_of_a_line(
    rate_deg_s: float,
) -> None:
    """A line of L pixels over one centered star's pixel: (1 / L) of erf(1 / (2 sqrt 2 sigma)), ends far away."""
    length_px = np.radians(rate_deg_s) * 0.05 * shefex_lab().scene.camera.focal_px
    assert shefex_nights.smear_px(rate_deg_s) == pytest.approx(length_px, rel=2e-3)
    alone = erf(0.5 / (0.7 * np.sqrt(2)))
    loss_mag = 2.5 * np.log10(alone * length_px)
    # The pixel's own ends are rounded by the blur: a few thousandths.
    assert shefex_nights.peak_loss(rate_deg_s, 1, 1).ours.value == pytest.approx(
        loss_mag, abs=0.02
    )


def test_the_blur_disk_is_the_defocus_over_the_f_number() -> None:
    assert shefex_nights.blur_px() == pytest.approx(1e-4 / 1.4 / 9.9e-6, rel=0.01)


def test_the_chip_s_fields_follow_from_its_half_sizes() -> None:
    half = np.array([659, 493, np.hypot(659, 493)]) / 2 * 9.9e-6 / 25e-3
    field_deg = shefex_nights.field_deg(onboard_model.calibration(shefex_lab().scene.camera))
    np.testing.assert_allclose(field_deg, np.degrees(2 * np.arctan(half)), rtol=1e-9)


def test_a_poisson_sky_has_the_expected_unevenness_and_an_even_sky_less() -> None:
    rng = np.random.default_rng(5)
    poisson = rng.poisson(8, (20_000, 2))
    even = np.full(20_000, 8.0) + rng.integers(-1, 2, 20_000)
    for counts, expected in (
        (poisson, 1.0),
        (np.column_stack([poisson[:, 0], even]), (2 / 3) / 8),
    ):
        columns = np.hstack([counts, counts**2.0])
        assert shefex_setup.relative_dispersion(columns.mean(axis=0)) == pytest.approx(
            expected, rel=0.05
        )


def test_both_scans_have_the_same_objects() -> None:
    rng = np.random.default_rng(6)
    image = rng.normal(100, 3, (200, 300))
    for x, y in rng.uniform(20, 180, (10, 2)):
        image[int(y) : int(y) + 3, int(x) : int(x) + 3] += 200
    count, share = shefex_camera.count_common(np.rint(image).astype(np.uint16), 100)
    assert count >= 8
    assert share == 1.0


def test_an_empty_frame_of_a_coarse_converter_lengthens_the_exposure() -> None:
    """Every pixel equals the offset: no star, and nothing too bright."""
    controller = ExposureController(
        load("shefex2", {"tracker.exposure_control": "{mean_dn: 9}"})
    )
    controller.update(Frame(0, np.full((493, 659), 4, np.uint16), 0.0, 0.04, 255.0))
    assert controller.exposure_s == pytest.approx(0.042, abs=1e-12)


def test_a_planet_s_light_follows_pogson_s_law() -> None:
    loop = shefex_camera.ExposureLoop({}, shefex_camera.random_attitudes(1, 1)[0], 40)
    before = loop.lab.camera.sources
    after = shefex_camera.with_planets(loop.lab.camera, loop.rest, 3)
    changed = after.strength != before.strength
    assert changed.sum() == 3
    gained_mag = 2.5 * np.log10(after.strength[changed] / before.strength[changed])
    np.testing.assert_allclose(
        gained_mag, before.magnitude[changed] - shefex_camera.PLANET_MAG, rtol=1e-9
    )


@pytest.mark.long
def test_the_same_seed_gives_the_same_numbers() -> None:
    first, again = (
        shefex_camera.exposure_control(ExperimentOptions(quick=True, seed=2)).results
        for _ in range(2)
    )
    assert first == again


def test_a_lab_under_the_air_gathers_thirty_per_cent_less() -> None:
    """The light of 35 ms without air equals that of 50 ms under the air."""
    on_ground = shefex_nights.star_image(shefex_nights.ground_lab(), 0.05).sum()
    assert on_ground == pytest.approx(
        shefex_nights.star_image(shefex_lab(), 0.035).sum(), rel=1e-6
    )
