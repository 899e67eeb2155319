"""Ionizing particles: straight tracks of charge through the chip, with or without light."""

from collections.abc import Sequence
from math import erf, sqrt

import numpy as np
import scipy
from numpy.random import Generator
from numpy.typing import NDArray

from skysim.camera.psf.splat import add_gaussian
from skysim.core.errors import InputError
from skysim.core.jit import jit
from skysim.core.types import Floats
from skysim.scene.sections.camera import ParticlesConfig

STEP_PX = 0.25  # longest step along a track
# Landau's scale 0.1535 MeV cm^2/g x Z/A 0.498 x 2.33 g/cm^3 = 17.8 eV a micrometer, 4.9 electrons of 3.65 eV, over
# 80 most probable ones (`assumed`, for a fast singly charged particle). Layers of a few micrometers straggle more.
MOYAL_WIDTH = 0.06
# Tangent of the largest angle from the normal; 1e-4 of an isotropic flux is beyond.
MAX_TANGENT = 100.0
MAX_TRACKS = 1_000_000

TRACK = np.dtype(
    [
        ("x_px", "f8"),
        ("y_px", "f8"),
        ("end_x_px", "f8"),
        ("end_y_px", "f8"),
        ("length_m", "f8"),
        ("electrons", "f8"),
        ("deposited_e", "f8"),
    ]
)


def add_particles(
    electrons: NDArray,
    exposure_s: float,
    pixel_m: float,
    particles: Sequence[ParticlesConfig],
    rng: Generator,
) -> NDArray:
    """Add the particle tracks of an exposure to a frame of electrons, in place (float32 or float64).

    Returns the truth of the tracks that left charge on the chip, a structured array of dtype TRACK: entry at the
    front and exit at the back (pixels, also outside of the frame), path length through the layer, charge released,
    and the charge that fell on the frame.
    """
    # All kinds are drawn first, so that a kind's diffusion does not change another kind's random numbers.
    tracks = [
        draw_tracks(config, electrons.shape, exposure_s, pixel_m, rng) for config in particles
    ]
    for config, track in zip(particles, tracks, strict=True):
        # Diffusion 0 would divide by zero.
        ends_px = np.column_stack(
            [track["x_px"], track["y_px"], track["end_x_px"], track["end_y_px"]]
        )
        track["deposited_e"] = deposit(
            electrons, ends_px, track["electrons"], max(config.diffusion_px, 1e-3)
        )
    all_tracks = np.concatenate(tracks) if tracks else np.empty(0, TRACK)
    return all_tracks[all_tracks["deposited_e"] > 0]


def draw_tracks(
    config: ParticlesConfig,
    shape: tuple[int, ...],
    exposure_s: float,
    pixel_m: float,
    rng: Generator,
) -> NDArray:
    """Draw every track that could reach a chip of this shape (H, W): its ends, length and charge.

    1. The number of tracks is a Poisson number: per_cm2_s counts the particles that cross a square centimeter of the
       chip's plane in a second, from either side (an isotropic flux of J through a sphere of 1 cm^2 section gives J /
       2).
    2. Directions are isotropic, but the chip is foreshortened: p(theta) = 2 sin(theta) cos(theta) = sin(2 theta) from
       its normal, so cos^2(theta) is uniform.
    3. Tracks enter anywhere on the plane and leave depth tan(theta) further; the path length is depth / cos(theta).
    4. The charge follows Moyal's law (1955, Phil. Mag. 46, 263) about the most probable value, electrons_um times the
       length, with a scale of MOYAL_WIDTH times that.

    Raises
    ------
    InputError
        For more than MAX_TRACKS tracks.
    """
    height, width = shape
    # 1. Tracks that enter beside the frame may reach it too.
    margin = MAX_TANGENT * config.depth_m / pixel_m
    area_cm2 = (width + 2 * margin) * (height + 2 * margin) * pixel_m**2 * 1e4
    expected = config.per_cm2_s * area_cm2 * exposure_s
    if expected > MAX_TRACKS:
        raise InputError(
            "camera.detector.particles",
            f"{expected:.3g} tracks come near the chip in an exposure",
            f"{MAX_TRACKS:,}",
        )
    count = rng.poisson(expected)
    tracks = np.zeros(count, TRACK)
    # 2. The lower end of cos^2(theta) bounds the tangent by MAX_TANGENT.
    cos_theta = np.sqrt(rng.uniform(1 / (1 + MAX_TANGENT**2), 1, count))
    azimuth = rng.uniform(0, 2 * np.pi, count)
    # 3. Entry, exit and length.
    lateral_px = config.depth_m / pixel_m * np.sqrt(1 / cos_theta**2 - 1)
    tracks["x_px"] = rng.uniform(-0.5 - margin, width - 0.5 + margin, count)
    tracks["y_px"] = rng.uniform(-0.5 - margin, height - 0.5 + margin, count)
    tracks["end_x_px"] = tracks["x_px"] + lateral_px * np.cos(azimuth)
    tracks["end_y_px"] = tracks["y_px"] + lateral_px * np.sin(azimuth)
    tracks["length_m"] = config.depth_m / cos_theta
    # 4. Charge; Moyal's law has a tail below zero, which no particle has.
    probable_e = config.electrons_um * 1e6 * tracks["length_m"]
    tracks["electrons"] = probable_e * np.maximum(
        1 + MOYAL_WIDTH * scipy.stats.moyal.rvs(size=count, random_state=rng), 0
    )
    return tracks


@jit
def deposit(image: NDArray, ends_px: Floats, electrons: Floats, sigma_px: float) -> Floats:
    """Spread each charge evenly along its track, in steps of at most STEP_PX, each a pixel-integrated Gaussian.

    Parameters
    ----------
    ends_px
        (N, 4) x, y of entry and of exit

    Returns
    -------
    Floats
        (N,) charge that fell on the frame
    """
    height, width = image.shape
    deposited = np.zeros(len(electrons))
    for n in range(len(electrons)):
        x, y, end_x, end_y = ends_px[n]
        steps = int(np.ceil(sqrt((end_x - x) ** 2 + (end_y - y) ** 2) / STEP_PX)) + 1
        for k in range(steps):
            # The middle of each step.
            along = (k + 0.5) / steps
            charge = electrons[n] / steps
            center_x = x + along * (end_x - x)
            center_y = y + along * (end_y - y)
            add_gaussian(image, 0, height, center_x, center_y, charge, sigma_px)
            inside_x = _fraction_inside(center_x, width, sigma_px)
            deposited[n] += charge * inside_x * _fraction_inside(center_y, height, sigma_px)
    return deposited


@jit
def _fraction_inside(center: float, size: int, sigma_px: float) -> float:
    """Fraction of a Gaussian centered at `center` that falls within an axis of `size` pixels."""
    scale = 1 / (sigma_px * sqrt(2.0))
    return (erf((size - 0.5 - center) * scale) - erf((-0.5 - center) * scale)) / 2
