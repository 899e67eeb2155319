"""Tracks of particles against their laws, with charge conserved."""

from __future__ import annotations

import numpy as np
import pytest
from scipy import stats

from skysim.camera.cosmic_rays import (
    MAX_TANGENT,
    STEP_PX,
    TRACK,
    add_particles,
    deposit,
    draw_tracks,
)
from skysim.core.errors import InputError
from skysim.scene.sections.camera import ParticlesConfig

PIXEL_M = 10e-6
SHAPE = (200, 300)


def protons(**part: object) -> ParticlesConfig:
    return ParticlesConfig.model_validate({"per_cm2_s": 1e4, "depth": "10 um"} | part)


def many(count: int = 100_000, **part: object) -> np.ndarray:
    """About this number of tracks on a chip with negligible margins: 0.06 cm2 and a depth of 1 nm."""
    thin = protons(per_cm2_s=count / 0.06, depth="1 nm", **part)
    return draw_tracks(thin, SHAPE, 1.0, PIXEL_M, np.random.default_rng(1))


def test_the_count_is_flux_times_area_times_time() -> None:
    """Entries within the frame are Poisson: mean and variance of 400 exposures."""
    rng = np.random.default_rng(2)
    counts = []
    for _ in range(400):
        tracks = draw_tracks(protons(), SHAPE, 0.1, PIXEL_M, rng)
        inside = (np.abs(tracks["x_px"] - 149.5) < 150) & (
            np.abs(tracks["y_px"] - 99.5) < 100
        )
        counts.append(inside.sum())
    wanted = 1e4 * 0.06 * 0.1  # 60
    assert np.mean(counts) == pytest.approx(wanted, abs=4 * np.sqrt(wanted / 400))
    assert np.var(counts) == pytest.approx(wanted, rel=4 * np.sqrt(2 / 400))


def test_entry_points_are_uniform_over_the_frame() -> None:
    tracks = many(20_000)
    assert stats.kstest((tracks["x_px"] + 0.5) / 300, "uniform").pvalue > 1e-4
    assert stats.kstest((tracks["y_px"] + 0.5) / 200, "uniform").pvalue > 1e-4


def test_directions_follow_an_isotropic_flux_through_a_plate() -> None:
    """p(theta) = sin 2 theta: the cosine's square is uniform, azimuths are too."""
    tracks = many()
    cosine = 1e-9 / tracks["length_m"]
    theta = np.arccos(cosine)
    assert stats.kstest(theta, lambda t: np.sin(t) ** 2).pvalue > 1e-4
    azimuth = np.arctan2(
        tracks["end_y_px"] - tracks["y_px"], tracks["end_x_px"] - tracks["x_px"]
    )
    assert stats.kstest((azimuth + np.pi) / (2 * np.pi), "uniform").pvalue > 1e-4


def test_the_mean_path_through_a_plate_is_twice_its_depth() -> None:
    """Cauchy's mean chord 4 V / S of a wide plate. The variance of 1 / cos grows as the logarithm of the cut."""
    length = many()["length_m"] / 1e-9
    sigma = np.sqrt((2 * np.log(MAX_TANGENT) - 4) / len(length))
    assert length.mean() == pytest.approx(2 * (1 - 1 / MAX_TANGENT), abs=4 * sigma)


def test_a_track_s_image_has_the_length_of_depth_times_tangent() -> None:
    tracks = draw_tracks(protons(), SHAPE, 1.0, PIXEL_M, np.random.default_rng(3))
    along = np.hypot(tracks["end_x_px"] - tracks["x_px"], tracks["end_y_px"] - tracks["y_px"])
    np.testing.assert_allclose(
        np.hypot(along * PIXEL_M, 10e-6), tracks["length_m"], rtol=1e-12
    )
    # 45 degrees, 10 um, 10 um.
    assert np.median(along) == pytest.approx(1.0, abs=4 * 1.0 / np.sqrt(len(tracks)))


def test_the_most_probable_charge_follows_from_the_path_length() -> None:
    """Mode and mean of Moyal's law in units of the most probable charge: 1 and 1 + 0.06 (gamma + ln 2)."""
    tracks = many()
    ratio = tracks["electrons"] / (80.0 * tracks["length_m"] * 1e6)
    counts, edges = np.histogram(ratio, np.arange(0.8, 1.3, 0.02))
    peak = counts.argmax()
    mode = np.polyfit(
        (edges[peak - 3 : peak + 4] + 0.01) - edges[peak], counts[peak - 3 : peak + 4], 2
    )
    assert edges[peak] - mode[1] / (2 * mode[0]) == pytest.approx(1.0, abs=0.02)
    sigma = 0.06 * np.pi / np.sqrt(2)
    assert ratio.mean() == pytest.approx(
        1 + 0.06 * (np.euler_gamma + np.log(2)), abs=4 * sigma / np.sqrt(len(ratio))
    )
    assert ratio.std() == pytest.approx(sigma, rel=0.03)
    assert ratio.min() > 0


@pytest.mark.slow
@pytest.mark.parametrize("diffusion_px", [0.0, 0.3, 2.0])
@pytest.mark.parametrize("kind", [np.float32, np.float64])
def test_every_electron_of_a_track_within_the_frame_is_in_it(
    diffusion_px: float, kind: type
) -> None:
    image = np.zeros(SHAPE, kind)
    ends = np.array([[40.2, 60.0, 47.9, 20.3], [100.0, 100.0, 100.0, 100.0]])
    kept = deposit(image, ends, np.array([5000.0, 300.0]), max(diffusion_px, 1e-3))
    np.testing.assert_allclose(kept, [5000, 300], rtol=1e-8)
    assert image.sum(dtype=float) == pytest.approx(5300, rel=1e-5)


@pytest.mark.compiles
def test_charge_is_spread_evenly_along_the_track() -> None:
    """Sum over rows of a level track: 10 electrons per pixel, half in the end pixels; rows are Gaussian."""
    image = np.zeros((41, 141))
    deposit(image, np.array([[20.0, 20.0, 120.0, 20.0]]), np.array([1000.0]), 0.5)
    columns = image.sum(axis=0)
    rows = image.sum(axis=1)
    # Whole steps are no whole part of a pixel.
    np.testing.assert_allclose(columns[25:116], 10.0, rtol=0.02)
    assert np.average(np.arange(141), weights=columns) == pytest.approx(70.0, abs=1e-6)
    share = np.diff(stats.norm.cdf(np.arange(42) - 0.5, 20.0, 0.5))
    np.testing.assert_allclose(rows / 1000, share, rtol=0, atol=1e-8)
    assert STEP_PX <= 0.5  # half a sigma of the cloud: no beads


@pytest.mark.compiles
def test_diffusion_widens_the_cloud() -> None:
    spots = []
    for sigma_px in (0.7, 1.5):
        image = np.zeros((61, 61))
        deposit(image, np.array([[30.0, 30.0, 30.0, 30.0]]), np.array([1.0]), sigma_px)
        spots.append(image.sum(axis=0) @ (np.arange(61) - 30.0) ** 2)
    # Sheppard: the pixel's own 1/12.
    np.testing.assert_allclose(spots, [0.49 + 1 / 12, 2.25 + 1 / 12], rtol=1e-3)


@pytest.mark.slow
def test_tracks_enter_from_outside_the_frame_and_leave_it() -> None:
    thick = protons(depth="100 um", per_cm2_s=1e5)
    image = np.zeros((50, 50))
    tracks = add_particles(image, 1.0, PIXEL_M, (thick,), np.random.default_rng(4))
    outside = (tracks["x_px"] < -2.5) | (tracks["x_px"] > 51.5)
    assert outside.sum() > 20
    assert (tracks["deposited_e"] <= tracks["electrons"] * (1 + 1e-6)).all()
    assert (tracks["deposited_e"] < 0.9 * tracks["electrons"]).sum() > 20
    assert image.sum() == pytest.approx(tracks["deposited_e"].sum(), rel=1e-9)
    # As many electrons a volume as flux x mean way x charge: the layer's edges neither gain nor lose.
    wanted = 1e5 * 0.0025 * 80.0 * 200.0 * (1 + 0.06 * (np.euler_gamma + np.log(2)))
    relative = np.sqrt(2 * np.log(MAX_TANGENT)) / 2 / np.sqrt(250)
    assert image.sum() == pytest.approx(wanted, rel=4 * relative)


def test_tracks_are_added_to_the_frame_s_electrons() -> None:
    sky = np.random.default_rng(5).uniform(50, 60, SHAPE).astype(np.float32)
    image = sky.copy()
    parts = (protons(), protons(electrons_um=800.0))
    tracks = add_particles(image, 0.1, PIXEL_M, parts, np.random.default_rng(6))
    assert tracks.dtype == TRACK
    gained = (image - sky).sum(dtype=float)
    assert gained == pytest.approx(tracks["deposited_e"].sum(), rel=1e-4)
    assert (image >= sky).all()
    assert np.median(image - sky) == 0


def test_without_particles_the_frame_is_unchanged() -> None:
    image = np.zeros(SHAPE, np.float32)
    assert len(add_particles(image, 1.0, PIXEL_M, (), np.random.default_rng(7))) == 0
    assert (
        len(
            add_particles(
                image, 1.0, PIXEL_M, (protons(per_cm2_s=0.0),), np.random.default_rng(7)
            )
        )
        == 0
    )
    assert not image.any()


def test_the_same_stream_draws_the_same_tracks() -> None:
    first = np.zeros(SHAPE)
    again = np.zeros(SHAPE)
    other = np.zeros(SHAPE)
    for image, seed in ((first, 1), (again, 1), (other, 2)):
        add_particles(image, 0.1, PIXEL_M, (protons(),), np.random.default_rng(seed))
    np.testing.assert_array_equal(first, again)
    assert not np.array_equal(first, other)


def test_too_many_tracks_for_memory_are_refused() -> None:
    image = np.zeros((64, 64), np.float32)
    with pytest.raises(
        InputError, match=r"camera\.detector\.particles: .* tracks .*; allowed: 1,000,000"
    ):
        add_particles(
            image, 1e6, PIXEL_M, (protons(per_cm2_s=1e6),), np.random.default_rng(1)
        )
