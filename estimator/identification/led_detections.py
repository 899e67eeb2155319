"""Detections of a dome's LEDs: rays with their total errors, directions from the bearing, and brightness.

The brightness of a light is evidence for its LED, but a fraction STRAY of the lights may have any brightness
(`light_dex`).
"""

from math import exp, log10, pi, sqrt
from typing import NamedTuple

import numpy as np

from estimator.attitude.dome_map import on_sphere
from estimator.core.checks import Floats
from estimator.core.jit import jit
from estimator.identification.led_index import DomeIndex

STRAY = 0.01  # fraction of the lights that may have any brightness: blends, reflections
STRAY_DENSITY = 0.1  # density of their brightness, per unit of the logarithm


class LedDetections(NamedTuple):
    """The detections of one frame, in camera axes.

    Attributes
    ----------
    ray
        (N, 3) unit vectors
    tangent
        (N, 2) x / z and y / z
    sigma
        (N,) total standard deviation of each tangent
    direction
        (N, 3) unit vectors from the bearing to the point where the ray meets the sphere of the median LED radius
    direction_per_m
        (N, 3) derivative of `direction` with respect to that radius, 1 / m
    log_flux
        (N,) logarithm of the flux per second of exposure; of length 0 if brightness is not used
    light_density
        (N,) density of that brightness, per unit of the logarithm, if the light may be any LED or none
    focal_uncertainty
        Greatest relative error of the focal length; 0 for a calibrated camera
    """

    ray: Floats
    tangent: Floats
    sigma: Floats
    direction: Floats
    direction_per_m: Floats
    log_flux: Floats
    light_density: Floats
    focal_uncertainty: float = 0.0


def build_detections(
    rays_cam: Floats,
    sigma_rad: Floats,
    dome: DomeIndex,
    flux_s: Floats | None = None,
    focal_uncertainty: float = 0.0,
) -> LedDetections:
    """Rays with their total errors, which include those of the LED map and of the lever.

    A lateral error of the pupil shifts all LEDs alike and is absorbed by the attitude. An axial error scales the image,
    and adds an error proportional to the distance from the boresight.

    A ray u from the pupil r meets the sphere of radius R at p = r + s u with |p| = R. Then ds/dR = R / (u . p), so
    that the direction p / R changes by d(p / R)/dR = u / (u . p) - p / R^2.

    Parameters
    ----------
    rays_cam, sigma_rad, dome, flux_s, focal_uncertainty
        See `led_search.identify`

    Returns
    -------
    LedDetections
        The tangents' errors are those of the rays divided by z^2 = cos^2 of the angle from the boresight
    """
    # Total standard deviations of the tangents.
    tangent = np.ascontiguousarray(rays_cam[:, :2] / rays_cam[:, 2:])
    pupil_sigma = dome.lever_sigma * np.linalg.norm(tangent, axis=1)
    ray_sigma = np.hypot(sigma_rad, dome.led_sigma) / rays_cam[:, 2] ** 2
    # Directions from the bearing, and their change with the radius.
    point_m = on_sphere(rays_cam, dome.pupil_m, dome.median_radius_m)
    along_m = np.sum(rays_cam * point_m, axis=1)[:, None]
    return LedDetections(
        np.ascontiguousarray(rays_cam),
        tangent,
        np.hypot(ray_sigma, pupil_sigma),
        point_m / dome.median_radius_m,
        rays_cam / along_m - point_m / dome.median_radius_m**2,
        *_brightness(flux_s, dome),
        float(focal_uncertainty),
    )


def _brightness(flux_s: Floats | None, dome: DomeIndex) -> tuple[Floats, Floats]:
    """The brightness of lights, for `light_dex`.

    Returns
    -------
    log_flux
        (N,) logarithms of the fluxes
    light_density
        (N,) density of each, if the light may be any LED or none

    Both are empty if brightness is not used.
    """
    if flux_s is None or not len(dome.log_flux):
        return np.zeros(0), np.zeros(0)
    log_flux = np.log(np.maximum(flux_s, 1e-300))
    z = (log_flux[:, None] - dome.log_flux) / dome.flux_sigma
    as_any = np.exp(-(z**2) / 2).mean(axis=1) / (np.sqrt(2 * np.pi) * dome.flux_sigma)
    return log_flux, (1 - STRAY) * as_any + STRAY * STRAY_DENSITY


@jit
def light_dex(detections: LedDetections, dome: DomeIndex, n: int, star: int) -> float:
    """Evidence of the brightness of light n for being LED `star`; 0 if brightness is not used.

        log10( ((1 - e) N(log flux - log flux of the LED) + e STRAY_DENSITY) / p )

    e = STRAY is the fraction of lights of any brightness, and p the density of this brightness if the light may be
    any LED or none.
    """
    if len(detections.log_flux) == 0 or len(dome.log_flux) == 0:
        return 0.0
    # Difference of the logarithms in standard deviations.
    z = (detections.log_flux[n] - dome.log_flux[star]) / dome.flux_sigma
    as_led = exp(-z * z / 2) / (sqrt(2 * pi) * dome.flux_sigma)
    return log10(((1 - STRAY) * as_led + STRAY * STRAY_DENSITY) / detections.light_density[n])
