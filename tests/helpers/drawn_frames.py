"""Frames of stars, drawn independently of skysim's camera.

Gaussian stars of a catalog along a streak, with photon and read noise, and nuisances if they are asked for.
"""

from __future__ import annotations

from dataclasses import dataclass

import numba
import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from estimator.catalog import catalog
from estimator.core.camera import Camera

STEP_PX = 0.1  # step of the Gaussians along a streak


@dataclass(frozen=True)
class CameraSetup:
    """A camera and its signal levels.

    zero_e : electrons of a star of magnitude 0; deepest : magnitude of the faintest star drawn
    gain_e : electrons per count; depth : maximum count
    leak   : share of a column's light in each of its pixels: readout smear
    dawn_e : electrons of the sky in the brightest corner, over a gradient along x and y
    nuisances : whether there are hot pixels, cosmic rays, a satellite's trail, false stars and a gradient of the sky
    """

    name: str
    camera: Camera
    zero_e: float
    deepest: float
    sky_e: float
    read_e: float
    gain_e: float
    depth: int
    psf_px: float = 0.7
    streak_px: float = 0.0
    leak: float = 0.0
    dawn_e: float = 0.0
    nuisances: bool = False


EC655 = Camera.from_fov(659, 493, float(np.radians(14.87)))
SQUARE = Camera.from_fov(
    1024, 1024, float(np.radians(13.5))
)  # holds 22 stars brighter than 6
LIEBE_E = 6008 * 10 ** (0.4 * 4)  # EC655, f/1.4, 50 ms: a star of magnitude 4 gives 6008 e
SETUPS = (
    CameraSetup("EC655, 50 ms", EC655, LIEBE_E, 7.0, 60, 15, 16, 4095),
    CameraSetup("1024 x 1024", SQUARE, LIEBE_E, 7.0, 60, 15, 16, 4095, psf_px=0.9),
    CameraSetup(
        "1024 x 1024, smear of 12 px",
        SQUARE,
        LIEBE_E,
        7.0,
        60,
        15,
        16,
        4095,
        psf_px=0.9,
        streak_px=12,
    ),
    CameraSetup(
        "saturated, readout smear",
        SQUARE,
        40 * LIEBE_E,
        7.5,
        600,
        15,
        16,
        4095,
        psf_px=0.9,
        leak=5e-4,
    ),
    CameraSetup(
        "all nuisances",
        SQUARE,
        4 * LIEBE_E,
        7.0,
        100,
        15,
        16,
        4095,
        psf_px=0.9,
        leak=2e-5,
        nuisances=True,
    ),
)


@numba.njit(cache=True)
def paint(light: NDArray, xy: NDArray, flux: NDArray, streak: NDArray, psf_px: float) -> None:
    """Add stars to `light`: each is a sum of Gaussians at equal steps along a streak (dx, dy) centered at xy."""
    reach, height, width = int(5 * psf_px) + 2, *light.shape
    for n in range(len(xy)):
        steps = int(np.hypot(streak[n, 0], streak[n, 1]) / STEP_PX) + 1
        for k in range(steps):
            along = (k + 0.5) / steps - 0.5
            x = xy[n, 0] + along * streak[n, 0]
            y = xy[n, 1] + along * streak[n, 1]
            for row in range(max(round(y) - reach, 0), min(round(y) + reach + 1, height)):
                down = np.exp(-((row - y) ** 2) / 2 / psf_px**2)
                for column in range(
                    max(round(x) - reach, 0), min(round(x) + reach + 1, width)
                ):
                    across = np.exp(-((column - x) ** 2) / 2 / psf_px**2)
                    light[row, column] += (
                        flux[n] / steps * down * across / (2 * np.pi * psf_px**2)
                    )


def render(
    setup: CameraSetup, stars: catalog.StarCatalog, rng: np.random.Generator
) -> tuple[NDArray, Rotation]:
    """One frame at a random attitude, and that attitude at mid-exposure."""
    camera = setup.camera
    truth = Rotation.random(rng=rng)
    xy = camera.pixels(truth.apply(stars.vectors))
    inside = camera.contains(np.nan_to_num(xy, nan=-1e9), -10.0)
    angle = rng.uniform(0, 2 * np.pi)
    streak = np.tile(
        setup.streak_px * np.array([np.cos(angle), np.sin(angle)]), (inside.sum(), 1)
    )
    light = np.full((camera.height_px, camera.width_px), float(setup.sky_e))
    paint(
        light,
        xy[inside],
        setup.zero_e * 10 ** (-0.4 * stars.v_mag[inside]),
        streak,
        setup.psf_px,
    )
    height, width = light.shape
    light += setup.dawn_e * np.linspace(0, 1, width) * np.linspace(0.5, 1, height)[:, None]
    if setup.nuisances:
        disturb(light, setup, rng)
    light += setup.leak * light.sum(axis=0)
    noisy = rng.poisson(light) + rng.normal(0, setup.read_e, light.shape)
    return np.clip(noisy / setup.gain_e + 16, 0, setup.depth).astype(np.uint16), truth


def disturb(light: NDArray, setup: CameraSetup, rng: np.random.Generator) -> None:
    """Add a gradient of the sky, hot pixels, cosmic rays, a satellite's trail and false stars."""
    height, width = light.shape
    light += setup.sky_e * np.linspace(0, 3, width) * np.linspace(0.5, 1.5, height)[:, None]
    hot = rng.integers(0, [width, height], (200, 2))
    light[hot[:, 1], hot[:, 0]] += rng.uniform(1e3, 5e4, len(hot))
    rays, trail, false = (rng.uniform(0, [width, height], (count, 2)) for count in (8, 1, 15))
    length = rng.uniform(3, 20, (len(rays), 1)) * rng.normal(size=(len(rays), 2))
    paint(light, rays, rng.uniform(5e3, 5e4, len(rays)), length, 0.25)
    paint(light, trail, np.array([3e5]), rng.uniform(200, 600, (1, 2)), setup.psf_px)
    mag = rng.uniform(2.0, 6.0, len(false))
    paint(
        light,
        false,
        setup.zero_e * 10 ** (-0.4 * mag),
        np.zeros((len(false), 2)),
        setup.psf_px,
    )
