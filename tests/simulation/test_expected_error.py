"""Expected errors against closed forms, against the renderer, and against the errors of real solved frames."""

from __future__ import annotations

import datetime
from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest
import scipy
from scipy.spatial import cKDTree
from scipy.spatial.transform import Rotation

from estimator.centroiding.centroid import CENTROIDERS
from estimator.centroiding.gaussian_fit import fit_all
from estimator.detection.background import FILTERED_NOISE
from estimator.detection.detect import DETECTORS
from skysim.camera.detector import repel
from skysim.camera.psf.kernel import build_kernel
from skysim.core.constants import ARCSEC_RAD
from skysim.core.types import Floats, Frame, Truth
from skysim.results import metrics
from skysim.results.run import render_at
from skysim.scene import loader
from skysim.scene.sections.camera import CameraConfig
from skysim.simulation.checks import (
    attitudes,
    beliefs,
    detection,
    expected_error,
    facts,
    sampling,
)
from skysim.simulation.checks.attitudes import CheckedAttitudes
from skysim.simulation.checks.detection import Context, timing_sigma_s
from skysim.simulation.checks.expected_error import (
    Expected,
    gains,
    of_common,
    of_independent,
)
from skysim.simulation.checks.views import VISIBLE, View, image_gradient, peak_share, view
from skysim.simulation.exposure import expected_exposure
from skysim.simulation.flight import Flight
from skysim.simulation.lab import Lab, build_lab, build_tracker, exposure_window
from skysim.simulation.lights.light import Exposure, Lit, beam_of
from skysim.sources.dome.led import lit_moments_s
from skysim.tracking import factory
from tests.helpers.splatting import add_kernel

LEDS = 12
# of a ring of LEDs over the bearing, the pupil, and the ring's radius
HEIGHT_M = 1.2
PUPIL_M = 0.4
RING_M = 0.08


def ring(arm_m: Floats, offset_m: Floats, lab: Lab) -> View:
    """Lights at (n, 3) places in camera axes, each with an error of one pixel."""
    count = len(arm_m)
    nothing = np.zeros(len(arm_m))
    xy_px = lab.camera.optics.project(offset_m)
    gradient = image_gradient(lab.camera.optics, offset_m)
    row = np.arange(count)
    streak = np.zeros((count, 2))
    depth_m = offset_m[:, 2]
    behind = np.full(count, VISIBLE)
    return View(
        datetime.datetime(2020, 1, 1),
        Rotation.identity(),
        row,
        xy_px,
        offset_m,
        gradient,
        np.cross(arm_m[:, None], gradient),
        depth_m,
        *[nothing] * 4,
        streak,
        nothing,
        behind,
        np.zeros((count, 2, 2)),
    )


def px2(sigma_px: Floats) -> Floats:
    """(n, 2, 2) covariances of equal standard deviations along both axes."""
    return sigma_px[:, None, None] ** 2 * np.eye(2)


def around(radius: float, height: float, count: int = LEDS) -> Floats:
    """(count, 3) points on a ring about the boresight."""
    angle = 2 * np.pi * np.arange(count) / count
    return np.column_stack(
        [radius * np.cos(angle), radius * np.sin(angle), np.full(count, height)]
    )


@pytest.fixture(scope="module")
def stars() -> Lab:
    return build_lab(loader.load("shefex2"))


@pytest.fixture(scope="module")
def leds() -> Lab:
    return build_lab(loader.load("afit_simsat"))


def test_expected_errors_of_stars_on_a_ring_match_the_textbook(stars: Lab) -> None:
    """Roll sigma / (r sqrt n); cross sqrt(2 / n) sigma / f over sqrt(1 + t^2 + t^4 / 2), t = r / f, both axes."""
    tangent = 0.11
    sigma_px = 0.2
    places = around(tangent, 1.0)
    places /= np.linalg.norm(places, axis=1, keepdims=True)
    circle = ring(places, places, stars)
    gain = gains(circle, px2(np.full(LEDS, 0.3)))  # equal weights: their size does not matter
    variance = np.diag(of_independent(gain, np.tile(sigma_px**2 * np.eye(2), (LEDS, 1, 1))))
    focal_px = stars.scene.camera.focal_px
    assert np.sqrt(variance[2]) == pytest.approx(
        sigma_px / (tangent * focal_px * np.sqrt(LEDS)), rel=1e-6
    )
    across = np.sqrt(2 / LEDS / (1 + tangent**2 + tangent**4 / 2)) * sigma_px / focal_px
    assert np.sqrt(variance[:2].sum()) == pytest.approx(across, rel=1e-6)


def test_weights_favor_the_accurate_lights(stars: Lab) -> None:
    """Of two lights on a line through the center the better one decides: variances add as 1 / sum(1 / sigma^2)."""
    tangent = 1e-4
    focal_px = stars.scene.camera.focal_px
    places = np.array([[tangent, 0, 1], [-tangent, 0, 1], [0, tangent, 1], [0, -tangent, 1]])
    sigma_px = np.array([0.1, 0.1, 0.4, 0.4])
    gain = gains(ring(places, places, stars), px2(sigma_px))
    variance = np.diag(of_independent(gain, sigma_px[:, None, None] ** 2 * np.eye(2)))
    assert np.sqrt(variance[:2]) == pytest.approx(
        np.full(2, 1 / focal_px / np.sqrt(np.sum(1 / sigma_px**2))), rel=1e-3
    )


def under_ring(lab: Lab) -> View:
    arm_m = around(RING_M, HEIGHT_M)
    return ring(arm_m, arm_m - [0, 0, PUPIL_M], lab)


def test_a_survey_s_errors_are_angles_at_the_bearing(leds: Lab) -> None:
    """Of a narrow ring: LEDs sigma / (R sqrt n) across each axis and sigma / (ring sqrt n) in roll; lever sigma / R."""
    circle = under_ring(leds)
    sigma_m = 1e-4
    gain = gains(circle, px2(np.ones(LEDS)))
    places = np.diag(
        of_independent(
            gain, sigma_m**2 * circle.gradient @ np.swapaxes(circle.gradient, 1, 2)
        )
    )
    assert np.sqrt(places[:2]) == pytest.approx(
        np.full(2, sigma_m / HEIGHT_M / np.sqrt(LEDS)), rel=0.02
    )
    assert np.sqrt(places[2]) == pytest.approx(sigma_m / RING_M / np.sqrt(LEDS), rel=1e-3)
    lever = np.diag(of_common(gain, -sigma_m * circle.gradient))
    assert np.sqrt(lever[:2]) == pytest.approx(np.full(2, sigma_m / HEIGHT_M), rel=0.02)
    assert lever[2] < 1e-6 * lever[0]


def test_a_rotated_survey_rotates_the_solution_equally(leds: Lab) -> None:
    """Exactly: it is the rotation that the tracker measures."""
    circle = under_ring(leds)
    turn_rad = np.array([2e-4, -1e-4, 3e-4])
    arm_m = around(RING_M, HEIGHT_M)
    shift_px = np.einsum("nij,nj->ni", circle.gradient, np.cross(turn_rad, arm_m))
    matrix = of_common(gains(circle, px2(np.ones(LEDS))), shift_px[:, :, None])
    np.testing.assert_allclose(matrix, np.outer(turn_rad, turn_rad), rtol=1e-6, atol=1e-16)


def test_a_wrong_focal_length_moves_the_solution_by_the_mean_of_the_field(stars: Lab) -> None:
    """An even ring about the center by nothing, one about a place off it by the relative error of that angle."""
    for aside in (0.0, 0.05):
        places = around(0.02, 1.0) + np.array([aside, 0, 0])
        circle = ring(places, places, stars)
        shift_px = 1e-3 * (circle.xy_px - np.array(stars.scene.camera.center_px))
        cross = of_common(gains(circle, px2(np.ones(LEDS))), shift_px[:, :, None])[
            :2, :2
        ].trace()
        assert np.sqrt(cross) == pytest.approx(1e-3 * aside, rel=0.02, abs=1e-9)


def test_a_fitted_place_absorbs_the_lever(leds: Lab) -> None:
    """`pnp`: the lever's error does nothing, and noise does far more across the boresight."""
    circle = under_ring(leds)
    exact = gains(circle, px2(np.ones(LEDS)))
    free = gains(circle, px2(np.ones(LEDS)), circle.gradient)
    lever = circle.gradient
    noise = np.tile(np.eye(2), (LEDS, 1, 1))
    assert of_common(free, lever).trace() < 1e-6 * of_common(exact, lever).trace()
    assert of_independent(free, noise)[0, 0] > 100 * of_independent(exact, noise)[0, 0]


@pytest.mark.slow
def test_a_fitted_focal_length_has_no_error_in_the_attitude() -> None:
    """`non_dimensional`: an assumed one that is 5 % short errs by nothing and is not warned of; 15 % are."""
    uneven = {"light.layout": "{kind: poisson_disk, cap_deg: 40, count: 1400}"}
    found = {}
    for identifier, focal_length in (
        ("non_dimensional", 33.25),
        ("led_pairs", 33.25),
        ("non_dimensional", 29.75),
    ):
        keys = {
            "tracker.identifier": identifier,
            "tracker.assumed_focal_length": f"{focal_length} mm",
        }
        lab = build_lab(loader.load("afit_simsat", uneven | keys))
        context = detection.context_of(lab)
        samples = sampling.sampled(attitudes.of_frames(lab), context)
        error = samples.error.total("cross")
        found[identifier, focal_length] = (
            samples.error.rad2["cross"]["focal length"].max(),
            error.mean(),
        )
        mismatch = expected_error.mismatch(samples.used[0], context)
        assert (mismatch is None) == (
            (identifier, focal_length) == ("non_dimensional", 33.25)
        )
    assert found["non_dimensional", 33.25][0] < 1e-9 * found["led_pairs", 33.25][0]
    assert found["non_dimensional", 33.25][1] < found["led_pairs", 33.25][1]


def images(
    electrons: float, sigma_px: float, disk_px: float = 0.0, streak_px: float = 0.0
) -> View:
    """One image with a streak along x."""
    one = np.ones(1)
    zero = np.zeros(1)
    places = np.array([[0.0, 0.0, 1.0]])
    rms_px = np.sqrt(sigma_px**2 + disk_px**2 / 4) * one
    streak = np.array([[streak_px, 0.0]])
    gradient = np.zeros((1, 2, 3))
    row = np.zeros(1, int)
    return View(
        datetime.datetime(2020, 1, 1),
        Rotation.identity(),
        row,
        zero[:, None] + np.zeros(2),
        places,
        gradient,
        gradient,
        one,
        electrons * one,
        disk_px * one,
        zero,
        rms_px,
        streak,
        zero,
        row,
        np.zeros((1, 2, 2)),
    )


def test_a_fit_reaches_the_bound_of_mortensen() -> None:
    """sigma^2 / N / (1 + int_0^1 ln t / (1 + t / tau) dt), tau = 2 pi sigma^2 b / N (2010, Nature Methods 7, 377)."""
    electrons = 1000.0
    sigma_px = 0.8
    for tau in (0.01, 0.3, 7.0):
        integral = scipy.integrate.quad(lambda t, tau=tau: np.log(t) / (1 + t / tau), 0, 1)[0]
        noise_e2 = tau * electrons / (2 * np.pi * sigma_px**2)
        found = detection.weighted_variance(
            images(electrons, sigma_px),
            np.array([electrons]),
            noise_e2,
            detection.WEIGHTS["fit"],
        )
        expected_px2 = sigma_px**2 / electrons / (1 + integral)
        assert np.ravel(found) == pytest.approx(np.full(2, expected_px2), rel=2e-3)


def mosaic(light: View, background_e: float, angle_rad: float) -> tuple[Floats, Floats]:
    """144 images of a light with shot noise, its streak turned, each in 64 pixels; and their (144, 2) centers."""
    rng = np.random.default_rng(5)
    cells = 12
    size = 64
    x, y = np.mgrid[:cells, :cells].reshape(2, -1) * size + size / 2
    centers = np.column_stack([x, y]) + rng.uniform(-0.5, 0.5, (cells**2, 2))
    # Points of the disk along the path: 60 of each, or one where there is none.
    points_of_disk, points_of_path = (
        60 if extent_px else 1 for extent_px in (light.disk_px[0], light.streak_px[0, 0])
    )
    k = np.arange(points_of_disk)
    r = light.disk_px[0] * np.sqrt((k + 0.5) / points_of_disk)
    along = (np.arange(points_of_path) + 0.5) / points_of_path * light.streak_px[0, 0]
    along = (along - along.mean()) * np.array([[np.cos(angle_rad)], [np.sin(angle_rad)]])
    disk = r * np.array([np.cos(2.4 * k), np.sin(2.4 * k)])
    points = (along[:, :, None] + disk[:, None]).reshape(2, -1)
    blur = np.sqrt(light.blur2_px2[0] - 1 / 12)
    edge = np.arange(size + 1) - 0.5
    frame = np.full((cells * size, cells * size), background_e)
    for center in centers:
        corner = (center // size).astype(int) * size
        place = (center - corner)[:, None] + points
        share_x, share_y = (
            np.diff(scipy.special.ndtr((edge[:, None] - axis) / blur), axis=0)
            for axis in place
        )
        frame[corner[1] : corner[1] + size, corner[0] : corner[0] + size] += (
            light.electrons[0] * (share_y @ share_x.T) / points.shape[1]
        )
    return rng.poisson(frame).astype(np.uint16), centers


@pytest.mark.slow
@pytest.mark.parametrize(
    ("centroider", "detector", "disk_px", "streak_px"),
    [
        ("default", "default", 0.0, 0.0),
        ("weighted", "default", 0.0, 0.0),
        ("gaussian_window", "default", 0.0, 0.0),
        ("gaussian_fit", "default", 0.0, 0.0),
        ("cog", "local", 0.0, 0.0),
        ("cog", "local", 3.0, 0.0),
        ("weighted", "local", 3.0, 0.0),
        ("default", "default", 0.0, 5.0),
        ("default", "default", 0.0, 20.0),
        ("default", "default", 0.0, 40.0),
        ("weighted", "default", 0.0, 20.0),
    ],
)
def test_every_centroider_scatters_as_forecast(
    stars: Lab, centroider: str, detector: str, disk_px: float, streak_px: float
) -> None:
    """Rms of 144 images along and across the path, within 22 %: it varies by 6 %, and `cog` errs by 8 % less."""
    context = detection.context_of(stars)
    background_e = 60.0
    settings = replace(context.settings, centroider=centroider, detector=detector)
    context = replace(
        context,
        settings=settings,
        camera=context.camera._replace(noise_e=np.sqrt(background_e)),
        timing_s=np.zeros(1),
    )
    light = images(10_000.0, 0.75, disk_px, streak_px)
    angle_rad = 0.5
    frame, centers = mosaic(light, background_e, angle_rad)
    blobs = DETECTORS[detector](frame, 5.0, 3, 400)
    centroids = CENTROIDERS[centroider](frame, blobs, 1.0)
    away_px, near = cKDTree(centroids.xy_px).query(centers)
    assert away_px.max() < 3
    error = centroids.xy_px[near] - centers
    turned = error @ np.array(
        [[np.cos(angle_rad), -np.sin(angle_rad)], [np.sin(angle_rad), np.cos(angle_rad)]]
    )
    forecast = np.sqrt(np.diag(detection.with_noise(light, context, prnu=0.0).noise_px2[0]))
    assert turned.std(axis=0) == pytest.approx(forecast, rel=0.22)


def test_the_mean_time_of_pulses_varies_as_their_integral_does() -> None:
    """Against the renderer's own on-times at random phases, and nothing for steady light."""
    rng = np.random.default_rng(1)
    for period_s, on_s, exposure_s in (
        (1e-3, 0.35e-3, 10e-3),
        (9e-3, 1e-3, 36e-3),
        (4e-3, 3e-3, 10e-3),
    ):
        drawn = [
            lit_moments_s(0.0, exposure_s, period_s, start, on_s)[1]
            for start in rng.uniform(0, period_s, 3000)
        ]
        found = timing_sigma_s(np.array([period_s]), np.array([on_s]), exposure_s)[0]
        assert found == pytest.approx(np.std(drawn), rel=0.06)
    assert timing_sigma_s(np.ones(3), np.ones(3), 0.01).tolist() == [0, 0, 0]


def render_moving(
    lab: Lab, lab_from_body: Rotation, rate_body_rad_s: Floats
) -> tuple[Frame, Truth]:
    """Frame 0 of a vehicle that rotates at a constant rate, at that attitude at mid-exposure."""
    middle_s = exposure_window(lab.scene, 0).middle_s
    return render_at(lab, lab_from_body, rate_body_rad_s, middle_s)


def lit_by_known(exposure: Exposure, lab: Lab) -> Lit:
    """Sources that the tracker's map contains."""
    (lit,) = (lit for lit in beam_of(lab.camera.lights, exposure).lits if lit.known)
    return lit


@pytest.mark.slow
@pytest.mark.parametrize(
    ("name", "rate_deg_s"), [("afit_simsat", 2.0), ("shefex2", 2.0), ("apl_dome", 0.5)]
)
def test_positions_electrons_peaks_and_paths_match_the_renderer(
    name: str, rate_deg_s: float
) -> None:
    """Peaks are those of centered images: an image between pixels is lower by what a pixel's phase does."""
    lab = build_lab(loader.load(name, {"exposure.frames": "1"}))
    context = detection.context_of(lab)
    rate = np.radians([rate_deg_s, 0.0, 0.0])
    _, truth = render_moving(lab, lab.start, rate)
    exposure = expected_exposure(lab.camera, lab.start, rate, 0.0)
    lit = lit_by_known(exposure, lab)
    seen = view(lit, exposure, context.camera, lit.hidden_by)
    seen = seen.take(seen.behind == VISIBLE)
    _, row, other = np.intersect1d(
        lab.camera.sources.id[seen.row], truth.sources.id, return_indices=True
    )
    assert len(row) == len(seen) > 10
    inside = (
        np.minimum(seen.xy_px, np.array(lab.camera.canvas.shape[::-1]) - seen.xy_px).min(
            axis=1
        )[row]
        > 30
    )
    row = row[inside]
    other = other[inside]
    np.testing.assert_allclose(seen.xy_px[row], truth.sources.xy_px[other], rtol=0, atol=1e-3)
    np.testing.assert_allclose(
        seen.streak_length_px[row], truth.sources.streak_px[other], rtol=2e-3
    )
    # A pulse more or less in the exposure.
    share = truth.sources.electrons[other] / seen.electrons[row]
    assert np.median(share) == pytest.approx(1, abs=0.02)
    peak = (
        (seen.peak_e[row] - context.camera.background_e) * share / truth.sources.peak_e[other]
    )
    assert np.min(peak) > 0.98
    assert np.median(peak) < 1.2
    assert np.max(peak) < 1.7


def test_the_expected_peak_matches_a_disk_blurred_by_a_gaussian() -> None:
    """By integration over the disk, and for a disk alone and a Gaussian alone."""
    for radius, sigma in ((5.0, 1.0), (1.0, 1.0), (0.3, 0.8)):
        r = np.linspace(0, radius, 20001)
        integral = (
            np.trapezoid(r * np.exp(-(r**2) / 2 / sigma**2), r) / sigma**2 / np.pi / radius**2
        )
        values = (np.array([value]) for value in (sigma**2, radius, 0.0, 0.0))
        assert peak_share(*values)[0] == pytest.approx(integral, rel=1e-6)
    sharp = peak_share(np.full(1, 1e-6), np.full(1, 3.0), np.zeros(1), np.zeros(1))[0]
    assert sharp == pytest.approx(1 / np.pi / 9, rel=1e-6)
    assert peak_share(np.ones(1), *(np.zeros((3, 1))))[0] == pytest.approx(
        1 / 2 / np.pi, rel=1e-6
    )


def test_a_neighbor_moves_a_fitted_star(stars: Lab) -> None:
    """A weighted fit of a Gaussian to the sum of both, by least squares; near stars give their center of light."""
    camera = detection.context_of(stars).camera
    for apart_px, star_e, faint_e in (
        (1.5, 20_000.0, 300.0),
        (0.2, 2_000.0, 40.0),
        (2.5, 3_000.0, 60.0),
    ):
        x, y = np.mgrid[-3:4, -3:4].astype(float)

        def image(at_px: float, x: Floats = x, y: Floats = y) -> Floats:
            return (
                np.exp(-((x - at_px) ** 2 + y**2) / 2 / camera.lens_px**2)
                / 2
                / np.pi
                / camera.lens_px**2
            )

        light = star_e * image(0) + faint_e * image(apart_px)
        deviation = np.sqrt(camera.noise_e**2 + star_e * image(0))
        fit = scipy.optimize.least_squares(
            lambda p: ((p[0] * image(p[1]) - light) / deviation).ravel(),  # noqa: B023
            [star_e, 0.0],
        )
        found = beliefs.response_px(
            np.array([apart_px]), np.array([star_e]), np.array([faint_e]), camera
        )[0]
        assert found == pytest.approx(fit.x[1], rel=0.12)
    near = beliefs.response_px(
        np.array([1e-3]), np.array([1000.0]), np.array([500.0]), camera
    )[0]
    assert near == pytest.approx(1e-3 / 3, rel=0.02)


# Coma, charge that repels charge, colors in the air


SIDE_PX = 25


def fitted_shift_px(
    config: CameraConfig, coma_px: float, electrons: float, at: Floats
) -> Floats:
    """(2,) the tracker's fit minus the place of an image that the renderer draws, with its charge repelled."""
    patch = np.zeros((SIDE_PX, SIDE_PX), np.float32)
    kernel = build_kernel(config.psf, config, coma_px=(coma_px, 0.0) if coma_px else ())
    add_kernel(patch, 0, SIDE_PX, 12 + at[0], 12 + at[1], electrons, kernel)
    repel(patch, config.detector)
    place = 12 + at
    noise = np.full((2, 2), 15.0 * FILTERED_NOISE)
    box = np.array([[11, 11, 13, 13]])
    light = np.array([electrons])
    fitted = fit_all(
        patch.astype(float), place[None], light, box, light, 0 * noise, noise, 1.0, np.inf
    )
    return np.asarray(fitted[0, :2] - place)


@pytest.mark.parametrize("sigma_px", [0.3, 0.5, 0.7, 1.0])
@pytest.mark.parametrize(
    ("coma_px", "per_e", "electrons"),
    [(0.5, 0.0, 2_000.0), (1.0, 0.0, 30_000.0), (1.5, 0.0, 500.0), (0.0, 2e-6, 30_000.0)],
)
def test_fits_of_flares_and_of_charge_err_as_check_counts(
    stars: Lab, sigma_px: float, coma_px: float, per_e: float, electrons: float
) -> None:
    """At places all over a pixel, against the renderer's image: its transfer function, and its charge."""
    corner_px = 2 * coma_px
    keys = {
        "camera.psf": f"{{kind: gaussian, sigma_px: {sigma_px}, coma_px: {corner_px}}}",
        "camera.detector.brighter_fatter_per_e": f"{per_e}",
    }
    scene = loader.load("shefex2", keys)
    config = scene.camera
    peak = build_kernel(config.psf, config).peak
    phases = (np.arange(5) + 0.5) / 5 - 0.5
    at = np.array([[x, y] for x in phases for y in phases])
    # Halfway to the corner, along x.
    half_px = np.round(config.center_px) + np.array([round(config.corner_px / 2), 0])
    lights = images(electrons, 1 / np.sqrt(2 * np.pi * peak)).take(np.zeros(len(at), int))
    columns = dict(zip(View._fields, lights, strict=True))
    columns |= {"xy_px": half_px + at, "peak_e": np.full(len(at), electrons * peak)}
    context = SimpleNamespace(
        scene=scene,
        settings=SimpleNamespace(centroider="default"),
        camera=SimpleNamespace(background_e=0.0, noise_e=15.0),
    )
    found = detection.misshapen_px(View(**columns), context)
    assert found is not None
    fitted = [fitted_shift_px(config, coma_px, electrons, one) for one in at]
    largest_px = np.abs(fitted).max()
    np.testing.assert_allclose(found[:, :, 0], fitted, atol=0.06 * largest_px + 2e-5)
    context.settings.centroider = "cog"
    assert detection.misshapen_px(View(**columns), context) is None


SLOW_TURN = {"motion.rate_deg_s": "[0.05, 0.2, 0]", "exposure.rate_hz": "0.1"}


def paired_errors(
    name: str, keys: dict[str, str], more: dict[str, str], count: int
) -> tuple[Floats, Floats, dict[str, Floats]]:
    """(N, 2) squares of cross and roll errors, of all and of what keys add frame by frame, rad^2; forecast by cause."""
    labs = [build_lab(loader.load(name, one)) for one in (keys, keys | more)]
    trackers = [build_tracker(lab.camera) for lab in labs]
    frames = attitudes.of_frames(labs[1])
    error = sampling.sampled(frames, detection.context_of(labs[1])).error
    errors = []
    rows = np.arange(count) % len(frames.t_s)
    for n, row in enumerate(rows):
        pair = []
        for lab, tracker in zip(labs, trackers, strict=True):
            frame, truth = render_at(
                lab.in_run(n),
                frames.lab_from_body[row],
                frames.rate_body_rad_s[row],
                float(frames.t_s[row]),
            )
            solution = factory.solve_frame(tracker, frame).attitude.cam_from_ref
            assert solution is not None
            pair.append((solution * truth.cam_from_lab.inv()).as_rotvec())
        errors.append(pair)
    squares = [
        np.column_stack([(one[:, :2] ** 2).sum(axis=1), one[:, 2] ** 2])
        for one in (np.array(errors)[:, 1], np.diff(np.array(errors), axis=1)[:, 0])
    ]
    forecast = {
        cause: np.column_stack([error.rad2["cross"][cause], error.rad2["roll"][cause]])[
            :count
        ]
        for cause in error.rad2["cross"]
    }
    return squares[0], squares[1], forecast


@pytest.mark.slow
def test_coma_adds_to_the_error_of_solved_frames_what_check_counts() -> None:
    """At 40 attitudes: cross errors, and what a coma of 1 px at the corner adds frame by frame."""
    every, added, forecast = paired_errors(
        "shefex2", SLOW_TURN, {"camera.psf.coma_px": "1"}, 40
    )
    cause = forecast["coma and charge"][:, 0].mean()
    assert np.sqrt(added[:, 0].mean() / cause) == pytest.approx(1, abs=0.25)
    total = sum(forecast.values())[:, 0].mean()
    assert cause > total / 2
    assert np.sqrt(every[:, 0].mean() / total) == pytest.approx(1, abs=0.25)


@pytest.mark.slow
def test_colors_in_the_air_turn_solutions_as_check_counts() -> None:
    """Frames without noise, and equal weights, so that the colors alone make the difference."""
    keys = SLOW_TURN | {
        "site": "{latitude_deg: 53.1, longitude_deg: 8.8, height: 10 m}",
        "start_time": "2012-12-29T22:00:00",
        "motion.start": "{ra_deg: 71, dec_deg: 15, roll_deg: 0}",
        "light.occlusion": "false",
        "light.air": "{pressure_hpa: 1000, temperature_c: 10, scintillation: false}",
        "camera.detector.noise": "false",
        "tracker.refraction": "true",
        "tracker.centroid_sigma_px": "0.5",
    }
    _, added, forecast = paired_errors("shefex2", keys, {"light.air.dispersion": "true"}, 8)
    expected = forecast["dispersion"]
    assert np.sqrt(expected[:, 0].mean()) / ARCSEC_RAD > 0.1
    np.testing.assert_allclose(np.sqrt(added[:, 0]), np.sqrt(expected[:, 0]), rtol=0.25)
    gray = sampling.sampled(
        attitudes.of_frames(lab := build_lab(loader.load("shefex2", keys))),
        detection.context_of(lab),
    )
    assert not gray.error.rad2["cross"]["dispersion"].any()
    # The tracker knows the air, so refraction is no error of the hardware.
    edge = keys | {"light.air.dispersion": "true", "camera.detector.edge_px": "1e-9"}
    built = sampling.sampled(
        attitudes.of_frames(lab := build_lab(loader.load("shefex2", edge))),
        detection.context_of(lab),
    )
    assert built.error.rad2["cross"]["hardware as built"].max() < (1e-3 * ARCSEC_RAD) ** 2


# A total station


INSTRUMENT = '{kind: total_station, position: ["3 m", "1 m", "0.2 m"], angle_sigma_arcsec: 0, distance_sigma: "0 mm"'


def variances_of(survey: dict[str, str]) -> dict[str, Floats]:
    """(2,) cross and roll variances by cause at the frames of AFIT's dome, with only these errors of the survey."""
    none = {"led_sigma": "0 mm", "lever_sigma": "0 mm"}
    lab = build_lab(loader.load("afit_simsat", keyed(none | survey)))
    context = detection.context_of(lab)
    found = sampling.sampled(attitudes.of_frames(lab), context).error
    return {
        name: np.array([found.rad2["cross"][name].mean(), found.rad2["roll"][name].mean()])
        for name in found.rad2["cross"]
    }


def keyed(survey: dict[str, str]) -> dict[str, str]:
    return {f"tracker.survey.{key}": value for key, value in survey.items()}


def test_a_station_s_position_error_acts_as_a_lever_error() -> None:
    """All LEDs move together by the centering's error, as they do against a camera that is elsewhere."""
    station = variances_of({"instrument": f'{INSTRUMENT}, centering: "0.4 mm"}}'})
    lever = variances_of({"lever_sigma": "0.4 mm"})
    np.testing.assert_allclose(station["survey set-up"], lever["lever survey"], rtol=1e-9)
    assert not station["LED survey"].any()


def test_a_station_s_cross_errors_are_angle_times_distance() -> None:
    """Angles of 10″ at some 3.3 m, and distances of 0.16 mm, err by 0.16 mm along each axis."""
    sight = INSTRUMENT.replace("arcsec: 0", "arcsec: 10").replace('"0 mm"', '"0.16 mm"')
    station = variances_of({"instrument": f"{sight}}}"})
    leds = variances_of({"led_sigma": "0.16 mm"})
    np.testing.assert_allclose(station["LED survey"], leds["LED survey"], rtol=0.2)


# Against solved frames


def normalized_errors(
    name: str, count: int, rate_deg_s: float, surveys: bool
) -> tuple[Floats, Floats, int]:
    """(N, 2) cross and roll errors of solved frames at random attitudes, (N, 2) expected ones, and how many failed.

    surveys : whether each frame is solved with a survey of its own
    """
    rng = np.random.default_rng(4)
    scene = loader.load(name)
    lab = build_lab(scene)
    frames = attitudes.of_frames(lab)
    tracker = build_tracker(lab.camera)
    context = detection.context_of(lab)
    errors = []
    wanted = []
    failed = 0
    for n in range(count):
        if surveys:
            seeded = loader.load(name, {"tracker.survey.seed": str(n)})
            tracker = build_tracker(lab.with_scene(seeded).camera)
        lab_from_body = random_attitude(lab, frames, rng)
        rate = lab.camera.mount.cam_from_body.inv().apply(
            np.radians(rate_deg_s) * np.array([0.6, 0.8, 0.0])
        )
        frame, truth = render_moving(lab.in_run(n), lab_from_body, rate)
        solution = factory.solve_frame(tracker, frame).attitude.cam_from_ref
        if solution is None:
            failed += 1
            continue
        errors.append(metrics.cross_and_roll_rad(solution, truth.cam_from_lab))
        wanted.append(expected_at(context, lab_from_body, rate))
    return np.array(errors), np.array(wanted), failed


def random_attitude(lab: Lab, frames: CheckedAttitudes, rng: np.random.Generator) -> Rotation:
    if lab.scene.light.kind == "stars":
        return Rotation.random(rng=rng)
    cosine = np.cos(np.radians(attitudes.greatest_tilt_deg(frames)))
    azimuth, yaw = rng.uniform(0, 2 * np.pi, 2)
    return Rotation.from_euler("ZYZ", [azimuth, np.arccos(rng.uniform(cosine, 1)), yaw])


def expected_at(
    context: Context, lab_from_body: Rotation, rate_rad_s: Floats
) -> tuple[float, float]:
    at = CheckedAttitudes(
        context.lab,
        Rotation.concatenate([lab_from_body]),
        rate_rad_s[None],
        np.zeros(1),
    )
    return tuple(
        value * ARCSEC_RAD for value in sampling.sampled(at, context).error.rms_arcsec()
    )  # type: ignore[return-value]


@pytest.mark.long
@pytest.mark.parametrize(
    ("name", "count", "rate_deg_s", "surveys"),
    [
        ("afit_simsat", 100, 1.0, True),
        ("afit_simsat_ideal", 80, 2.0, False),
        ("nps_tas2", 100, 0.5, True),
        ("shefex2", 100, 0.5, False),
        ("ptase_2003", 100, 0.0, False),
    ],
)
def test_expected_errors_match_solved_frames(
    name: str, count: int, rate_deg_s: float, surveys: bool
) -> None:
    """Mean squares of error over expectation. 100 of them vary by 14 % in roll and 10 % across. Stars have 10 to 40 %
    more than the Cramer-Rao bound: a fit with a free sky, hot pixels."""
    errors, wanted, failed = normalized_errors(name, count, rate_deg_s, surveys)
    assert failed <= 0.06 * count  # in fields of three stars
    cross, roll = np.mean((errors / wanted) ** 2, axis=0)
    assert 0.7 < cross < 1.7
    assert 0.65 < roll < 1.7
    rms, expectation = (np.sqrt(np.mean(values**2, axis=0)) for values in (errors, wanted))
    np.testing.assert_allclose(rms, expectation, rtol=0.3)


def test_lights_in_use_have_the_noise_of_their_own_centroids(stars: Lab) -> None:
    context = detection.context_of(stars)
    used = sampling.sampled(attitudes.of_frames(stars), context).used
    assert sum(map(len, used)) > 10
    for lights in used:
        own = detection.with_noise(lights, context)
        np.testing.assert_array_equal(lights.noise_px2, own.noise_px2)
        assert (np.linalg.eigvalsh(lights.noise_px2) > 0).all()


def test_the_expected_error_is_nan_with_two_lights(stars: Lab) -> None:
    context = detection.context_of(stars)
    at = attitudes.of_frames(stars)
    few = [one.take(np.arange(2)) for one in sampling.sampled(at, context).used]
    assert np.isnan(expected_error.expected(few, context).rms_arcsec()).all()


def test_requirements_are_forecast_by_the_laws_of_normal_errors() -> None:
    """Cross by Rayleigh's law, roll by the normal one, their hypotenuse by drawing; one of two frames is dark."""
    none = dict.fromkeys(facts.DRAWN_ONCE, np.zeros(2))
    noise = np.array([ARCSEC_RAD**2 * 15, np.nan])
    error = Expected(
        {
            "cross": none | {"centroid noise": noise, "LED survey": noise / 15},
            "roll": none | {"centroid noise": 2 * noise},
        }
    )
    require = {
        "cross_arcsec_p95": 6.93,
        "roll_arcsec_median": 4.0,
        "angle_arcsec_tol90": 20.0,
        "right_within_cross_arcsec_4": 0.3,
        "wrong": 0.001,
    }
    scene = SimpleNamespace(require=require)
    plan = SimpleNamespace(scene=scene, frames=SimpleNamespace(error=error))
    fact = facts.requirements(plan)
    found = {name: fact.values[name]["expected"] for name in require}
    rng = np.random.default_rng(1)
    drawn = rng.normal(size=(3, 400_000)) * np.sqrt([[8.0], [8.0], [30.0]])
    angle = np.quantile(np.linalg.norm(drawn, axis=0), 0.9)
    assert found["cross_arcsec_p95"] == pytest.approx(4 * np.sqrt(-np.log(0.05)), rel=2e-3)
    assert found["roll_arcsec_median"] == pytest.approx(0.6745 * np.sqrt(30), rel=5e-3)
    assert found["angle_arcsec_tol90"] == pytest.approx(angle, rel=5e-3)
    assert found["right_within_cross_arcsec_4"] == pytest.approx(
        (1 - np.exp(-1)) / 2, abs=1e-3
    )
    assert fact.values["drawn_once"] == pytest.approx(1 / 16)
    met = ["expected to be met" in one for one in fact.lines]
    assert met == [True, True, True, True, False]
    assert "not forecast" in fact.lines[-1]
    assert not any(": met" in one for one in fact.lines)


LONG_STREAKS = {
    "camera.width_px": "1024",
    "camera.height_px": "1024",
    "camera.focal_length": "35 mm",
    "camera.f_number": "1.6",
    "exposure.time": "100 ms",
    "tracker.limit_mag": "6.5",
}


@pytest.mark.slow
@pytest.mark.parametrize(("rate_deg_s", "known"), [(4, True), (7, True), (24, False)])
def test_long_streaks_break_in_the_forecast_as_in_frames(
    rate_deg_s: float, known: bool
) -> None:
    """The stars matched, and the errors or that these are unknown, over 16 attitudes of the whole sky."""
    keys = LONG_STREAKS | {"motion.rate_deg_s": f"[{rate_deg_s}, 0, 0]"}
    lab = build_lab(loader.load("shefex2", keys))
    context = detection.context_of(lab)
    rate_rad_s = np.radians([rate_deg_s, 0.0, 0.0])
    turned = Rotation.random(16, random_state=1)
    at = CheckedAttitudes(lab, turned, np.tile(rate_rad_s, (16, 1)), np.zeros(16))
    expected = sampling.sampled(at, context)
    tracker = build_tracker(lab.camera)
    matched = np.zeros(16)
    squares = []
    for n in range(16):
        frame, truth = render_at(lab.in_run(n), turned[n], rate_rad_s, 0.0)
        solved = factory.solve_frame(tracker, frame).attitude
        if solved.cam_from_ref is not None and solved.match is not None:
            matched[n] = len(solved.match.observed)
            error_rad = metrics.cross_and_roll_rad(solved.cam_from_ref, truth.cam_from_lab)
            squares.append(error_rad[0] ** 2 / expected.error.total("cross")[n])
    # Some streaks whose fit fails are matched by their center of gravity, to a few pixels.
    assert 0.6 < expected.counts().mean() / matched.mean() < 1.1
    assert (2 * expected.broken().sum() <= 16) == known
    if known:
        assert 0.4 < np.nanmean(squares) < 2.5


@pytest.mark.slow
def test_jitter_moves_images_as_in_the_run() -> None:
    """Streaks of the frames, and uneven motion: over whole periods a sine of rms s about two axes has sqrt(2) s."""
    for frequency_hz in (3, 60):
        jitter = f"[{{kind: line, frequency_hz: {frequency_hz}, rms_arcsec: [300, 300, 0]}}]"
        keys = LONG_STREAKS | {"motion.jitter": jitter}
        keys |= {"motion.rate_deg_s": "[0, 0, 0]", "exposure.frames": "3"}
        lab = build_lab(loader.load("shefex2", keys))
        context = detection.context_of(lab)
        at = attitudes.of_frames(lab)
        length_px = np.array(
            [np.median(view.streak_length_px) for view in sampling.sampled(at, context).seen]
        )
        flight = Flight(lab).simulate_motion()
        for n in range(3):
            sources = flight.render(n)[1].sources
            streak_px = np.nanmedian(np.linalg.norm(sources.streak_xy_px, axis=1))
            assert streak_px == pytest.approx(length_px[n], rel=0.05, abs=0.05)
        uneven_px = facts.uneven_px(context, at.t_s, context.camera.exposure_s)
        whole_px = context.camera.optics.camera.focal_px * 300 * ARCSEC_RAD * 2**0.5
        assert (uneven_px == pytest.approx(whole_px, rel=0.05)) == (frequency_hz == 60)
