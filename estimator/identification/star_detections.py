"""The detections of one frame as the star search uses them: tangents, errors, magnitudes.

A centroid in pixels becomes a tangent (x / z, y / z) in camera axes, with the inverse covariance that weights it in
the fit and the error of its worst axis, which sets its matching radius.
"""

from math import hypot, log10, sqrt
from typing import NamedTuple

import numpy as np

from estimator.core import vectors
from estimator.core.camera import Distortion, undistorted
from estimator.core.checks import Floats
from estimator.core.jit import jit
from estimator.core.types import NO_SPREAD, Centroids
from estimator.identification.chance import GATE_SIGMA


class Detections(NamedTuple):
    """The detections of one frame. A named tuple, because numba can compile functions that take one.

    Attributes
    ----------
    tangent
        (N, 2) x / z and y / z in camera axes, brightest first
    sigma
        (N,) standard deviation of a tangent along the major axis of its error ellipse
    weight
        (N, 3) inverse covariance of the tangents: xx, yy, xy
    mag
        (N,) magnitudes on the catalog's scale, NaN if unknown
    mag_sigma
        Standard deviation of a magnitude
    field
        (4,) tangents left, right, top, bottom of the sensor's edges
    focal_uncertainty
        Relative uncertainty of the focal length; 0 for a calibrated camera
    limit_mag
        Magnitude down to which every star should be detected: that of the median detection, because an image that shows
        faint false lights also shows the stars of their magnitude. NaN if unknown, and for a part of the detections
    """

    tangent: Floats
    sigma: Floats
    weight: Floats
    mag: Floats
    mag_sigma: float
    field: Floats
    focal_uncertainty: float
    limit_mag: float


class Sensor(NamedTuple):
    """The camera's calibration and the scale of its magnitudes, which turn centroids into detections.

    Attributes
    ----------
    focal_px
        Focal length, pixels
    center_px
        (x, y) principal point, pixels
    distortion
        Coefficients of the lens distortion
    field
        See `Detections`
    zero_point_mag, magnitude_sigma
        See `trackers.pipeline.Settings`; the zero point is NaN if unknown
    aspect
        Width over height of a pixel
    """

    focal_px: float
    center_px: tuple[float, float]
    distortion: Distortion
    field: Floats
    zero_point_mag: float
    magnitude_sigma: float
    aspect: float = 1.0


class FlatCentroids(NamedTuple):
    """Centroids as compiled code takes them.

    Attributes
    ----------
    xy_px
        (N, 2) positions, pixels
    own_px, sigma_px
        (N,) standard deviations of a position: of its own noise, and in total
    flux
        (N,) flux of each light
    spread_px2
        (N, 2, 2) covariance of the noise; (0, 2, 2) if it is the same in all directions
    """

    xy_px: Floats
    own_px: Floats
    flux: Floats
    spread_px2: Floats
    sigma_px: Floats


def flat_centroids(centroids: Centroids, sigma_px: Floats) -> FlatCentroids:
    """Centroids in the form for compiled code, with their total errors (N,)."""
    spread_px2 = NO_SPREAD if centroids.covariance_px2 is None else centroids.covariance_px2
    return FlatCentroids(
        centroids.xy_px, centroids.sigma_px, centroids.flux, spread_px2, sigma_px
    )


@jit
def detections_of(
    lights: FlatCentroids, sensor: Sensor, focal_uncertainty: float
) -> Detections:
    """The detections of centroids.

    The covariance of a position is that of its noise plus an isotropic excess, sigma_px^2 - own_px^2. Divided by the
    squared focal length it is the covariance of the tangents, to first order.
    """
    count = len(lights.flux)
    focal_px = sensor.focal_px
    (center_x, center_y) = sensor.center_px
    sigma = np.empty(count)
    weight = np.empty((count, 3))
    mag = np.empty(count)
    for n in range(count):
        xx = yy = lights.sigma_px[n] ** 2
        xy = 0.0
        if len(lights.spread_px2):
            excess = xx - lights.own_px[n] ** 2
            xx = lights.spread_px2[n, 0, 0] + excess
            yy = lights.spread_px2[n, 1, 1] + excess
            xy = lights.spread_px2[n, 0, 1]
        # The variance along the major axis is the greater eigenvalue, (xx + yy) / 2 + hypot((xx - yy) / 2, xy).
        sigma[n] = sqrt((xx + yy) / 2 + hypot((xx - yy) / 2, xy)) / focal_px
        # The inverse of [xx xy; xy yy] is [yy -xy; -xy xx] / (xx yy - xy^2).
        scale = focal_px**2 / (xx * yy - xy * xy)
        weight[n, 0] = yy * scale
        weight[n, 1] = xx * scale
        weight[n, 2] = -xy * scale
        mag[n] = sensor.zero_point_mag - 2.5 * log10(lights.flux[n])
    tangent = undistorted(
        lights.xy_px, focal_px, center_x, center_y, sensor.distortion, sensor.aspect
    )
    # Detections are sorted by brightness: the middle one is the median.
    limit_mag = mag[count // 2] if count else np.nan
    return Detections(
        tangent,
        sigma,
        weight,
        mag,
        sensor.magnitude_sigma,
        sensor.field,
        focal_uncertainty,
        limit_mag,
    )


@jit
def changed(
    detections: Detections, count: int, variance: float, focal_uncertainty: float
) -> Detections:
    """The first `count` detections, with their variances multiplied by a factor and another focal uncertainty."""
    sigma = np.empty(count)
    weight = np.empty((count, 3))
    factor = sqrt(variance)
    # The inverse covariance falls as the variance grows.
    for n in range(count):
        sigma[n] = detections.sigma[n] * factor
        for k in range(3):
            weight[n, k] = detections.weight[n, k] / variance
    # A part of the detections has no limiting magnitude.
    return Detections(
        detections.tangent[:count],
        sigma,
        weight,
        detections.mag[:count],
        detections.mag_sigma,
        detections.field,
        focal_uncertainty,
        detections.limit_mag if count == len(detections.sigma) else np.nan,
    )


@jit
def gates_of(detections: Detections, factor: float) -> Floats:
    """(N,) matching radii in tangents: `factor` times GATE_SIGMA standard deviations."""
    gates = np.empty(len(detections.sigma))
    for n in range(len(gates)):
        gates[n] = factor * GATE_SIGMA * detections.sigma[n]
    return gates


def information_of(weight: Floats) -> Floats:
    """(N, 2, 2) inverse covariances of the tangents, from (N, 3) rows of `Detections.weight`."""
    return np.asarray(weight[:, [0, 2, 2, 1]].reshape(-1, 2, 2))


@jit
def ray(tangent: Floats, n: int, focal_ratio: float) -> vectors.Vector:
    """Unit vector of detection n in camera axes, for a focal length `focal_ratio` times the assumed one."""
    x = tangent[n, 0] / focal_ratio
    y = tangent[n, 1] / focal_ratio
    inverse = 1 / sqrt(x * x + y * y + 1)
    return x * inverse, y * inverse, inverse


@jit
def field_area(detections: Detections) -> float:
    """Area of the sensor, tangents squared."""
    return (detections.field[1] - detections.field[0]) * (
        detections.field[3] - detections.field[2]
    )
