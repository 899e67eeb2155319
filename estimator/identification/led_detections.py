"""Detections of a dome's LEDs: rays with their total errors, directions from the bearing, brightness, and their pairs.

The brightness of a light is evidence for its LED, but a fraction STRAY of the lights may have any brightness
(`light_dex`).
"""

from math import exp, log10, pi, sqrt
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from estimator.attitude.dome_map import on_sphere
from estimator.core import vectors
from estimator.core.checks import Floats
from estimator.core.jit import jit
from estimator.core.vectors import Vector
from estimator.identification.chance import GATE_SIGMA, middle, separation
from estimator.identification.led_index import PART, DomeIndex

STRAY = 0.01  # fraction of the lights that may have any brightness: blends, reflections
STRAY_DENSITY = 0.1  # density of their brightness, per unit of the logarithm
PATTERN = 12  # nearest lights of a part of a dense dome, of which the farthest forms the pair


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
    blur_dex
        Noise of the difference in evidence of two places that are alike, for one light (`build_detections`)
    """

    ray: Floats
    tangent: Floats
    sigma: Floats
    direction: Floats
    direction_per_m: Floats
    log_flux: Floats
    light_density: Floats
    focal_uncertainty: float = 0.0
    blur_dex: float = 0.0


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

    Two places of a regular dome may be alike to less than the map's errors, which then decide between them, and not the
    frame. With the share f of the map in the variance sigma^2 of a residual along an axis, n the light's noise, and s
    and s' the errors of the LEDs of both places, the difference of their squared residuals, (|n - s|^2 - |n - s'|^2) /
    sigma^2, has the variance 8 f^2 + 16 f (1 - f) = 8 f (2 - f) for one light, and K times that for K of them.
    `blur_dex` is the root of it over 2 ln 10.

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
    share = np.mean(dome.led_sigma**2 / (sigma_rad**2 + dome.led_sigma**2))
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
        float(np.sqrt(8 * share * (2 - share)) / (2 * np.log(10))),
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
    # Some thousand LEDs have the distribution of all.
    some = dome.log_flux[:: len(dome.log_flux) // 5000 + 1]
    z = (log_flux[:, None] - some) / dome.flux_sigma
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


@jit
def bearing_angle_ratio(dome: DomeIndex) -> float:
    """Ratio of a small angle about the bearing to that seen by the camera: (R - M) / R, M the length of the lever."""
    return 1 - vectors.norm(dome.pupil_m) / dome.median_radius_m


@jit
def pair_gates(detections: LedDetections, dome: DomeIndex, a: int, b: int) -> Floats:
    """Matching radius of each detection at a pair's attitude, as an angle about the bearing.

        gate_n = GATE_SIGMA s_n sqrt(1 + 1/2 + 2 d_n^2 / D^2)

    The pair's own error adds a shift with half of a detection's variance, and a rotation with 2 s^2 / D^2 times the
    squared distance d_n from the midpoint; D is the separation.

    Returns
    -------
    Floats
        (N,) rad
    """
    x, y = middle(detections.tangent, a, b)
    direction_variance = 2 / separation(detections.tangent, a, b) ** 2
    out = np.empty(len(detections.ray))
    for n in range(len(out)):
        distance2 = (detections.tangent[n, 0] - x) ** 2 + (detections.tangent[n, 1] - y) ** 2
        # As seen by the camera, then about the bearing.
        gate = GATE_SIGMA * detections.sigma[n] * sqrt(1.5 + direction_variance * distance2)
        out[n] = gate * bearing_angle_ratio(dome) + dome.scaling_error_rad
    return out


@jit
def part_pairs(
    detections: LedDetections, dome: DomeIndex, rows: NDArray[np.int64], by_pattern: bool
) -> tuple[NDArray[np.int32], float]:
    """Step 3 of a dense dome: the (P, 2) LEDs that the first and the last of some detections may be, and the gate.

    Parameters
    ----------
    rows
        A detection and its PATTERN nearest ones
    by_pattern
        Whether the first LED's nearest ones must be as far as the first detection's
    """
    from_first = detections.direction[rows] - detections.direction[rows[0]]
    seen = np.sqrt((from_first**2).sum(axis=1))
    gate = GATE_SIGMA * sqrt(2.0) * detections.sigma[rows[0]] * bearing_angle_ratio(dome)
    slack = dome.scaling_error_rad + 1.2 * detections.focal_uncertainty * seen
    most_misfit = 4 * gate**2 if by_pattern else np.inf
    pairs = np.empty((dome.near.size, 2), np.int32)
    count = 0
    for i in range(len(dome.near)):
        misfit = 0.0
        for k in range(1, PATTERN + 1):
            misfit += max(abs(dome.near_chord[i, k] - seen[k]) - slack[k], 0.0) ** 2
            if misfit > most_misfit:
                break
        for k in range(1, PART if misfit <= most_misfit else 1):
            if abs(dome.near_chord[i, k] - seen[-1]) <= gate + slack[-1]:
                pairs[count, 0] = i
                pairs[count, 1] = dome.near[i, k]
                count += 1
    return pairs[:count], gate


@jit
def direction_from_bearing(ray: Vector, dome: DomeIndex, radius_m: float) -> Vector:
    """Direction from the bearing to the point where a camera ray meets a sphere, in camera axes.

    The point is p = r + s u, s = -u . r + sqrt((u . r)^2 - r . r + R^2), with the pupil r, the ray u and the radius R.

    Parameters
    ----------
    ray
        Unit ray in camera axes
    radius_m
        Radius of the sphere about the bearing

    Returns
    -------
    Vector
        Unit vector p / R
    """
    px, py, pz = dome.pupil_m
    # u . r, then the distance s along the ray.
    along = vectors.dot(ray, dome.pupil_m)
    distance = -along + sqrt(
        max(along * along - px * px - py * py - pz * pz + radius_m * radius_m, 0.0)
    )
    inverse = 1 / radius_m
    return (
        (px + distance * ray[0]) * inverse,
        (py + distance * ray[1]) * inverse,
        (pz + distance * ray[2]) * inverse,
    )
