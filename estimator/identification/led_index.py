"""Index of a dome's LEDs for identification: pairs by the angle between them, and the nearest LEDs of each.

Angles are measured about the bearing center, from which they do not change with the attitude. They are scaled to those
that LEDs at the median radius would have; the search allows for the error of that scaling. Pairs are sorted by angle,
with a k-vector to find a range of angles.

All pairs that a field can hold grow with the square of the number of LEDs. Of a dense dome the index has near pairs
only, and the chords from each LED to its nearest ones, so that it grows in proportion.
"""

from typing import NamedTuple

import numpy as np
from scipy.spatial import cKDTree

from estimator.attitude.dome_map import LedMap, Lever
from estimator.catalog.pair_index import PairIndex, build, k_vector
from estimator.core.camera import Camera
from estimator.core.checks import Floats, Ints

# Fraction of the field in which an unmatched LED counts as missing; nearer to the border it may be cut off.
INNER_FRACTION = 0.95
# A dome of more LEDs, with more pairs of LEDs that one field can hold, is dense: the pairs of an angle are too many.
PAIRED_LEDS = 2500
MOST_PAIRS = 1_000_000
PART = 24  # LEDs of a part of a dense dome: one and its nearest ones


class DomeIndex(NamedTuple):
    """The dome map prepared for the search. A named tuple, because numba can compile functions that take one.

    Attributes
    ----------
    pairs
        LED pairs by their angle about the bearing, scaled to the median radius (`scale_pair_angles`)
    near, near_chord
        (L, PART) rows of each LED and of its nearest ones, and their increasing chords from it, scaled like pair
        angles, of a dense dome, whose index has pairs of near LEDs only; of length 0 if it has all pairs of a field
    reach
        Chord about the bearing, from the direction of the boresight to beyond the field's corners
    position_m
        (L, 3) positions of the LEDs in the lab frame
    radius_m
        (L,) distances of the LEDs from the bearing
    median_radius_m
        Median of these distances
    pupil_m
        (3,) camera's entrance pupil from the bearing, in camera axes
    scaling_error_rad
        Greatest error of a pair angle that results from the scaling to the median radius
    field_tan
        (4,) tangents left, right, top, bottom inside which an LED is fully visible
    field_area
        Area of the sensor, tangents squared
    prior_volume
        Volume of the attitudes that see the dome: steradians of boresight times 2 pi of roll
    led_sigma, lever_sigma
        Standard deviations of LED positions and of the pupil, over their least distance
    log_flux
        (L,) logarithm of each LED's flux per second; of length 0 if all are alike
    flux_sigma
        Standard deviation of the logarithm of a measured flux
    """

    pairs: PairIndex
    near: Ints
    near_chord: Floats
    reach: float
    position_m: Floats
    radius_m: Floats
    median_radius_m: float
    pupil_m: Floats
    scaling_error_rad: float
    field_tan: Floats
    field_area: float
    prior_volume: float
    led_sigma: float
    lever_sigma: float
    log_flux: Floats
    flux_sigma: float


def build_dome_index(leds: LedMap, lever: Lever, camera: Camera) -> DomeIndex:
    """Index of a dome: every pair of LEDs that one field of view can hold.

    A ray at the angle alpha from the boresight meets the sphere of radius R at an angle theta about the bearing, with
    R sin(alpha - theta) = M sin(alpha), M the length of the lever. For small angles, theta = alpha (R - M) / R. A
    pair angle at radius R therefore scales to the median radius R0 by the factor ((R0 - M) / R0) / ((R - M) / R).

    `scaling_error_rad` bounds the neglected terms: d(theta)/dR = M alpha / R^2 times the difference of the two radii, a
    relative term alpha^2 in wide fields, and a second-order term.

    Raises
    ------
    ImageError
        If there are no pairs.
    """
    radius = leds.radius_m
    median_m = float(np.median(radius))
    lever_m = float(np.linalg.norm(lever.camera_body_m))
    # The greatest angle between two LEDs in one field.
    rays = camera.rays(camera.corners_px)
    inner, half_size = inner_field(rays)
    alpha = float(np.arccos(rays[:, 2].min()))
    # At a given angle from the boresight, the LED of the greatest radius has the greatest angle about the bearing.
    theta = alpha - np.arcsin(min(lever_m / radius.max() * np.sin(alpha), 1.0))
    directions = leds.position_m / radius[:, None]
    widest = min(2.1 * theta, np.pi)
    near, near_chord = near_leds(directions, widest)
    longest = float(np.median(near_chord[:, -1])) if len(near) else widest
    index = build(directions, longest, leds.board)
    # Scale the angles to the median radius, and bound the error of that.
    scale = (median_m - lever_m) / median_m * radius / (radius - lever_m)
    first, second = index.pair.T
    max_offset_m = np.abs(radius - median_m).max()
    difference_m = np.abs(radius[first] - radius[second]).max()
    max_difference_m = difference_m + alpha**2 * max_offset_m + max_offset_m**2 / median_m
    scaling_error = 1.5 * max_difference_m * lever_m * alpha / radius.min() ** 2
    return DomeIndex(
        scale_pair_angles(index, scale),
        near,
        near_chord * (scale[: len(near), None] + scale[near]) / 2,
        float(2 * np.sin(0.55 * theta) + np.hypot(*lever.pupil_cam_m[:2]) / radius.min()),
        np.ascontiguousarray(leds.position_m, dtype=float),
        radius,
        median_m,
        lever.pupil_cam_m,
        float(scaling_error),
        inner,
        float(4 * half_size[0] * half_size[1]),
        (2 * np.pi) ** 2 * cap_height(directions, theta),
        float(leds.sigma_m / (radius.min() - lever_m)),
        float(lever.sigma_m / (radius.min() - lever_m)),
        np.zeros(0) if leds.flux_s is None else np.log(leds.flux_s),
        float(leds.flux_sigma),
    )


def near_leds(directions: Floats, widest_rad: float) -> tuple[Ints, Floats]:
    """The fields `near` and `near_chord` of DomeIndex, with chords that are not scaled.

    All pairs of a field grow with the square of the number of LEDs, those of near LEDs in proportion.

    Parameters
    ----------
    directions
        (L, 3) unit vectors of the LEDs
    widest_rad
        Greatest angle between two LEDs in one field
    """
    count = len(directions)
    pairs = count**2 / 2 * (1 - np.cos(widest_rad)) / cap_height(directions, 0.0)
    if count <= PAIRED_LEDS or pairs < MOST_PAIRS:
        directions = directions[:0]
    chord, near = cKDTree(directions).query(directions, PART)
    return near, chord


def inner_field(corners: Floats) -> tuple[Floats, Floats]:
    """The inner field of a sensor, in which a missing LED counts.

    Parameters
    ----------
    corners
        (4, 3) rays of the sensor's corners

    Returns
    -------
    inner
        (4,) tangents left, right, top, bottom of INNER_FRACTION times the full field
    half_size
        (2,) half-size of the full field, tangents
    """
    tangent = corners[:, :2] / corners[:, 2:]
    mean = (tangent.max(axis=0) + tangent.min(axis=0)) / 2
    half_size = np.ptp(tangent, axis=0) / 2
    return np.array(
        [mean - INNER_FRACTION * half_size, mean + INNER_FRACTION * half_size]
    ).T.ravel(), half_size


def scale_pair_angles(index: PairIndex, scale: Floats) -> PairIndex:
    """The index with each pair angle multiplied by the mean scale of its LEDs, sorted again by angle.

    Parameters
    ----------
    scale
        (L,) factor of each LED
    """
    first, second = index.pair.T
    # The order of the pairs changes with the angles, and with it the k-vector.
    angle = index.angle_rad * (scale[first] + scale[second]) / 2
    order = np.argsort(angle, kind="stable")
    kvector, slope, offset = k_vector(angle[order])
    return index._replace(
        pair=np.ascontiguousarray(index.pair[order]),
        angle_rad=angle[order],
        kvector=kvector,
        slope_rad=slope,
        offset_rad=offset,
    )


def cap_height(directions: Floats, margin_rad: float) -> float:
    """1 - cos(half-angle) of the cap about the mean of (L, 3) directions that holds all of them, plus a margin.

    The solid angle of the cap is 2 pi times this.
    """
    mean = directions.mean(axis=0)
    # Cosine of the angle of the LED farthest from the mean.
    nearest = (directions @ mean).min() / max(np.linalg.norm(mean), 1e-9)
    return float(1 - np.cos(min(np.arccos(np.clip(nearest, -1, 1)) + margin_rad, np.pi)))
