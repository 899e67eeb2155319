"""The detections of one frame as the star search uses them: tangents, errors, magnitudes.

A centroid in pixels becomes a tangent (x / z, y / z) in camera axes, with the inverse covariance that weights it in
the fit and the error of its worst axis, which sets its matching radius.
"""

from dataclasses import replace
from math import hypot, log10, sqrt
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from estimator.catalog.sky_index import cell_of
from estimator.core import vectors
from estimator.core.camera import Distortion, undistorted
from estimator.core.checks import Floats, Ints
from estimator.core.jit import jit
from estimator.core.types import NO_SPREAD, Centroids
from estimator.identification.chance import GATE_SIGMA, middle, squared_separation

DOUBLE_PX = 6.0  # greatest distance of double images
CELLS = 6  # along each side of the field, in which the brightest lights are chosen


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


# Centroids as compiled code takes them: a plain tuple, as numba takes twice as long to read a named one.
#
# - (N, 2) positions, pixels
# - (N,) standard deviations of a position by its own noise, and in total
# - (N,) flux of each light
# - (N, 2, 2) covariance of the noise; (0, 2, 2) if it is the same in all directions
FlatCentroids = tuple[Floats, ...]


def flat_centroids(centroids: Centroids, sigma_px: Floats) -> FlatCentroids:
    """Centroids in the form for compiled code, with their total errors (N,)."""
    spread_px2 = NO_SPREAD if centroids.covariance_px2 is None else centroids.covariance_px2
    return centroids.xy_px, centroids.sigma_px, sigma_px, centroids.flux, spread_px2


class ChosenLights(NamedTuple):
    """The lights of a frame that are identified.

    Attributes
    ----------
    centroids
        Their centroids
    rows
        (N,) rows of the frame's centroids: of each light's brightest image; None if all are lights as they are
    offset_px
        (2,) standard deviation along x and y of the common error of double images
    """

    centroids: Centroids
    rows: NDArray[np.int64] | None
    offset_px: Floats


def lights_of(centroids: Centroids, width_px: int, height_px: int, most: int) -> ChosenLights:
    """The lights of a frame that are identified: not too many, and double images as one light.

    1. Of more than `most` centroids the brightest of each part of the field are taken (`spread`).
    2. Lights within DOUBLE_PX of a brighter one form a group with it. If at least half of the groups are pairs, and no
       more than an eighth of the lights are so close by chance, the images are double, by vibration or a reflection,
       and either image may be the true one. The members of a group become one light at their mean place, whose error
       reaches to the farthest member, or as far as in the median.
    3. The images of a reflection are all displaced alike. The medians of their second moments then have unequal
       eigenvalues, and their difference is the variance of an error that is common to all lights.
    """
    # 1. Number
    rows = None
    if len(centroids) > most:
        field = np.array([0.0, width_px, 0.0, height_px])
        rows = spread(centroids.xy_px, field, most)
        centroids = centroids.take(rows)
    # 2. Double images
    head = brighter_within(centroids.xy_px, DOUBLE_PX)
    by_chance = len(centroids) * np.pi * DOUBLE_PX**2 / 2 / (width_px * height_px)
    if head is None or by_chance > 1 / 8:
        return ChosenLights(centroids, rows, np.zeros(2))
    first, group, members = np.unique(head, return_inverse=True, return_counts=True)
    sums_px = [np.bincount(group, x) for x in centroids.xy_px.T]
    mean_px = np.stack(sums_px, axis=1) / members[:, None]
    offset_px = centroids.xy_px - mean_px[group]
    second = np.flatnonzero(head < np.arange(len(head)))
    distance2_px2 = np.sum(offset_px**2, axis=1)
    # A light without a second image may be either of its images, too.
    reach2_px2 = np.full(len(first), np.median(distance2_px2[second]))
    np.maximum.at(reach2_px2, group, distance2_px2)
    merged = centroids.take(first)
    spread_px2 = merged.covariance_px2
    if spread_px2 is not None:
        spread_px2 = spread_px2 + reach2_px2[:, None, None] * np.eye(2)
    merged = replace(
        merged,
        xy_px=mean_px,
        sigma_px=np.sqrt(merged.sigma_px**2 + reach2_px2),
        covariance_px2=spread_px2,
    )
    # 3. Common error
    second_px = offset_px[second]
    # Medians: a star beside another one is displaced otherwise.
    moments = np.median(second_px[:, :, None] * second_px[:, None, :], axis=0)
    variance, axes = np.linalg.eigh(moments)
    common_px = np.sqrt(variance[1] - variance[0]) * axes[:, 1]
    return ChosenLights(merged, first if rows is None else rows[first], common_px)


@jit
def brighter_within(xy_px: Floats, reach_px: float) -> Ints | None:
    """Groups of near lights: (N,) row of the brightest of each light's group; None unless at least half are pairs.

    The brightest is the first light within reach that is not itself near a brighter one, or else the light itself.
    """
    head = np.arange(len(xy_px))
    members = np.zeros(len(xy_px), np.int64)
    for n in range(len(xy_px)):
        for m in range(n):
            dx = xy_px[n, 0] - xy_px[m, 0]
            dy = xy_px[n, 1] - xy_px[m, 1]
            if head[m] == m and dx * dx + dy * dy < reach_px * reach_px:
                head[n] = m
                break
        members[head[n]] += 1
    return head if 2 * np.sum(members == 2) >= np.sum(members > 0) else None


@jit
def detections_of(
    lights: FlatCentroids, sensor: Sensor, focal_uncertainty: float
) -> Detections:
    """The detections of centroids.

    The covariance of a position is that of its noise plus an isotropic excess, sigma_px^2 - own_px^2. Divided by the
    squared focal length it is the covariance of the tangents, to first order.
    """
    xy_px, own_px, sigma_px, flux, spread_px2 = lights
    count = len(flux)
    focal_px = sensor.focal_px
    (center_x, center_y) = sensor.center_px
    sigma = np.empty(count)
    weight = np.empty((count, 3))
    mag = np.empty(count)
    for n in range(count):
        xx = yy = sigma_px[n] ** 2
        xy = 0.0
        if len(spread_px2):
            excess = xx - own_px[n] ** 2
            xx = spread_px2[n, 0, 0] + excess
            yy = spread_px2[n, 1, 1] + excess
            xy = spread_px2[n, 0, 1]
        # The variance along the major axis is the greater eigenvalue, (xx + yy) / 2 + hypot((xx - yy) / 2, xy).
        sigma[n] = sqrt((xx + yy) / 2 + hypot((xx - yy) / 2, xy)) / focal_px
        # The inverse of [xx xy; xy yy] is [yy -xy; -xy xx] / (xx yy - xy^2).
        scale = focal_px**2 / (xx * yy - xy * xy)
        vectors.set_row(weight, n, (yy * scale, xx * scale, -xy * scale))
        mag[n] = sensor.zero_point_mag - 2.5 * log10(flux[n])
    tangent = undistorted(
        xy_px, focal_px, center_x, center_y, sensor.distortion, sensor.aspect
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
def changed(detections: Detections, variance: float, focal_uncertainty: float) -> Detections:
    """The detections, with their variances multiplied by a factor and another focal uncertainty."""
    return Detections(
        detections.tangent,
        detections.sigma * sqrt(variance),
        detections.weight / variance,
        detections.mag,
        detections.mag_sigma,
        detections.field,
        focal_uncertainty,
        detections.limit_mag,
    )


@jit
def spread(places: Floats, field: Floats, count: int) -> NDArray[np.int64]:
    """Rows of `count` lights, the brightest of each part of the field: a clump of false lights displaces no other.

    The field is divided into CELLS x CELLS cells. First come the brightest lights of all cells, then the second
    brightest, and so on.

    Parameters
    ----------
    places
        (N, 2) positions, brightest first
    field
        (4,) edges of the sensor in the same unit: left, right, top, bottom

    Returns
    -------
    NDArray
        Rows by decreasing brightness; all rows if there are no more than `count`
    """
    if len(places) <= count:
        return np.arange(len(places))
    used = np.zeros(CELLS * CELLS, np.int64)
    rank = np.empty(len(places), np.int64)
    for n in range(len(places)):
        column = cell_of(CELLS * (places[n, 0] - field[0]) / (field[1] - field[0]), CELLS - 1)
        row = cell_of(CELLS * (places[n, 1] - field[2]) / (field[3] - field[2]), CELLS - 1)
        cell = row * CELLS + column
        rank[n] = used[cell]
        used[cell] += 1
    kept = np.zeros(len(places), np.bool_)
    turn = 0
    left = min(count, len(places))
    while left:
        for n in range(len(places)):
            if rank[n] == turn and left:
                kept[n] = True
                left -= 1
        turn += 1
    return np.flatnonzero(kept)


@jit
def chosen(detections: Detections, rows: NDArray) -> Detections:
    """The detections of increasing rows. A part of the detections has no limiting magnitude."""
    if len(rows) == len(detections.sigma):
        return detections
    return Detections(
        detections.tangent[rows],
        detections.sigma[rows],
        detections.weight[rows],
        detections.mag[rows],
        detections.mag_sigma,
        detections.field,
        detections.focal_uncertainty,
        np.nan,
    )


@jit
def gates_of(detections: Detections, factor: float) -> Floats:
    """(N,) matching radii in tangents: `factor` times GATE_SIGMA standard deviations."""
    return factor * GATE_SIGMA * detections.sigma


@jit
def pair_gates(detections: Detections, a: int, b: int) -> Floats:
    """Matching radius of each detection at the attitude of a pair: its own error and that of the attitude.

        gate_n = GATE_SIGMA sqrt(s_n^2 + (sa^2 + sb^2) / 4 + (sa^2 + sb^2) d_n^2 / D^2)

    The second term is the variance of the pair's midpoint. The third is that of its direction, and of its relative
    length (for an uncertain focal length), which grows with the squared distance d_n from the midpoint; D is the
    separation.

    Returns
    -------
    Floats
        (N,) tangents
    """
    tangent = detections.tangent
    x, y = middle(tangent, a, b)
    pair_variance = detections.sigma[a] ** 2 + detections.sigma[b] ** 2
    direction_variance = pair_variance / squared_separation(tangent, a, b)
    out = np.empty(len(detections.sigma))
    for n in range(len(out)):
        distance2 = (tangent[n, 0] - x) ** 2 + (tangent[n, 1] - y) ** 2
        # The detection's variance, that of the midpoint, and that of the direction at this distance.
        out[n] = GATE_SIGMA * sqrt(
            detections.sigma[n] ** 2 + pair_variance / 4 + direction_variance * distance2
        )
    return out


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
def squared_corner(field: Floats) -> float:
    """Return the squared tangent of the farthest corner of a field (`Detections.field`)."""
    left, right, top, bottom = field
    return max(left * left, right * right) + max(top * top, bottom * bottom)


@jit
def field_area(detections: Detections) -> float:
    """Area of the sensor, tangents squared."""
    left, right, top, bottom = detections.field
    return (right - left) * (bottom - top)
