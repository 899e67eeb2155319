"""Trials of six near-field methods under five surfaces.

The lights are at intersections of random rays
with the true surface. The methods receive the true positions of the lights, and a centered sphere as the assumed
surface of the dome.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from estimator.attitude.dome_map import LedMap, Lever, on_surface, project
from estimator.attitude.nearfield import SOLVERS, fitted_sigma_rad
from estimator.core.camera import Camera

INCH_M = 0.0254
NOISE_PX = 0.1
START_OFF_RAD = np.radians(2)  # start error of Tappe's iterated trial


@dataclass(frozen=True, slots=True)
class Geometry:
    """A test geometry: true surface, camera, radius of the assumed sphere, tilts, and number of lights."""

    surface: LedMap
    camera: Camera
    lever_m: float
    radius_m: float
    tilts_deg: tuple[float, ...] = (0, 10, 20, 30)
    lights: int = 5

    @property
    def lever(self) -> Lever:
        return Lever(np.array([0.0, 0.0, self.lever_m]), Rotation.identity())


def _dome(
    center_in: tuple[float, float, float], semi_axes_in: tuple[float, float, float]
) -> LedMap:
    """A surface without lights; infinite semi-axes make it a plane."""
    nowhere = np.empty(0, dtype=np.int64), np.empty((0, 3))
    return LedMap(*nowhere, np.array(center_in) * INCH_M, np.array(semi_axes_in) * INCH_M)


# AFIT: 10.45 x 7.85 deg on 1600 x 1200 pixels, camera 15 in up, apex at 48 in (reference, 1.1 and 1.2 item 12).
AFIT_CAMERA = Camera(1600, 1200, float(800 / np.tan(np.radians(10.45 / 2))), (799.5, 599.5))
# NPS: nine lights; 8.5 mm lens on a 1/2-inch chip, 41 x 32 deg; its pixel, 10 um, and the lever, 0.30 m, are assumed.
NPS_CAMERA = Camera(640, 480, 850.0, (319.5, 239.5))
AFIT = AFIT_CAMERA, 15 * INCH_M, 48 * INCH_M
GEOMETRIES = {
    "sphere": Geometry(_dome((0, 0, 0), (48, 48, 48)), *AFIT),
    "sphere 0.125 in off": Geometry(_dome((0.125, 0, 0), (48, 48, 48)), *AFIT),
    "measured ellipsoid": Geometry(_dome((0, 0, 48 - 28.60), (38.88, 38.88, 28.60)), *AFIT),
    "flat at 48 in": Geometry(_dome((0, 0, 0), (np.inf, np.inf, 48)), *AFIT),
    "NPS flat at 1 m": Geometry(
        _dome((0, 0, 0), (np.inf, np.inf, 1 / INCH_M)),
        NPS_CAMERA,
        0.30,
        1.0,
        (0, 5, 10, 15),
        9,
    ),
}


@dataclass(frozen=True, slots=True)
class Trial:
    """One attitude, the start attitude, the lights, and their pixel positions."""

    truth: Rotation
    start: Rotation
    leds: LedMap
    pixels: NDArray[np.float64]


def trial(
    geometry: Geometry, tilt_deg: float, rng: np.random.Generator, noise_px: float = 0.0
) -> Trial:
    """A trial at random yaw and tilt direction, with lights where the rays of random pixels meet the true surface.

    The start attitude is START_OFF_RAD from the truth, about a random axis.
    """
    azimuth, yaw = rng.uniform(0, 2 * np.pi, 2)
    tilt = np.radians(tilt_deg) * np.array([np.cos(azimuth), np.sin(azimuth), 0])
    truth = Rotation.from_rotvec(tilt) * Rotation.from_rotvec([0, 0, yaw])
    camera = geometry.camera
    lever = geometry.lever
    pixels = rng.uniform(
        -0.5, [camera.width_px - 0.5, camera.height_px - 0.5], (geometry.lights, 2)
    )
    rays_lab = (lever.cam_from_body * truth).inv().apply(camera.rays(pixels))
    place = on_surface(rays_lab, truth.inv().apply(lever.camera_body_m), geometry.surface)
    leds = LedMap(
        np.arange(geometry.lights), place, np.zeros(3), np.full(3, geometry.radius_m)
    )
    axis = rng.standard_normal(3)
    start = Rotation.from_rotvec(START_OFF_RAD * axis / np.linalg.norm(axis)) * truth
    seen = project(truth, place, lever, camera) + noise_px * rng.standard_normal(
        (geometry.lights, 2)
    )
    return Trial(truth, start, leds, seen)


def solved(
    method: str, geometry: Geometry, one: Trial
) -> tuple[Rotation, NDArray[np.float64]]:
    """body_from_lab and its covariance from one method."""
    rays = geometry.camera.rays(one.pixels)
    sigma_rad = fitted_sigma_rad(
        method, rays, np.full(geometry.lights, NOISE_PX / geometry.camera.focal_px)
    )
    return SOLVERS[method](
        rays, sigma_rad, one.leds.position_m, one.leds, geometry.lever, one.start
    )


def errors_deg(
    method: str,
    geometry: Geometry,
    tilt_deg: float,
    trials: int,
    seed: int,
    noise_px: float = 0.0,
) -> NDArray[np.float64]:
    """(trials, 3) errors about the body's axes, degrees; the same trials for every method."""
    rng = np.random.default_rng(seed)
    errors = np.empty((trials, 3))
    for n in range(trials):
        case = trial(geometry, tilt_deg, rng, noise_px)
        errors[n] = (solved(method, geometry, case)[0] * case.truth.inv()).as_rotvec(
            degrees=True
        )
    return errors


def cross_and_roll(errors: NDArray[np.float64]) -> tuple[float, float]:
    """RMS cross-boresight error, sqrt(mean(x^2 + y^2)), and RMS roll error."""
    square = np.mean(errors**2, axis=0)
    return float(np.sqrt(square[0] + square[1])), float(np.sqrt(square[2]))
