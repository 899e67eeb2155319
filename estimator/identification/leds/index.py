"""Index of a dome's LEDs for identification: pairs by the angle between them, and LEDs by direction."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from estimator.attitude.dome_map import LedMap, Lever
from estimator.catalog.pair_index import PairIndex, build, line
from estimator.core.arrays import Floats
from estimator.core.camera import Camera

INNER = 0.95  # fraction of the field in which an unmatched LED counts as missing; the border may cut it off


class Grid(NamedTuple):
    """LED directions in a square grid of side * side cells over their x and y components.

    R_grid_from_lab : (3, 3) rotates the mean direction of the LEDs to +z
    cell, side      : width of a cell, and number of cells along a side
    first           : LEDs first[c] to first[c + 1] are in cell c
    direction       : (N, 3) unit vectors of the LEDs in that order, in grid axes
    """

    R_grid_from_lab: Floats
    cell: float
    side: int
    first: NDArray[np.int64]
    direction: Floats


class Sight(NamedTuple):
    """The dome map prepared for the search. A named tuple, because numba can compile functions that take one.

    pairs      : LED pairs by their angle about the bearing, scaled to the median radius (`at_usual`)
    grid       : the LEDs by direction
    position_m : (L, 3) LEDs in the lab frame;  radius_m : (L,) from the bearing;  usual_m : their median radius
    pupil_m    : (3,) camera's entrance pupil from the bearing, in camera axes
    slack_rad  : greatest error of a pair angle that results from the scaling to the median radius
    field_tan  : (4,) tangents left, right, top, bottom inside which an LED is fully visible
    area       : of the sensor, in tangents squared
    volume     : prior volume of attitudes that see the dome: steradians of boresight times 2 pi of roll
    led_sigma, lever_sigma : standard deviations of LED positions and of the pupil, over their least distance
    brightest_first : rows are sorted by brightness: LEDs fainter than every match do not count as missing
    """

    pairs: PairIndex
    grid: Grid
    position_m: Floats
    radius_m: Floats
    usual_m: float
    pupil_m: Floats
    slack_rad: float
    field_tan: Floats
    area: float
    volume: float
    led_sigma: float
    lever_sigma: float
    brightest_first: bool


def sight_of(leds: LedMap, lever: Lever, camera: Camera) -> Sight:
    """Index of a dome: every pair of LEDs that one field of view can hold.

    A ray at angle alpha from the boresight meets radius R at an angle theta about the bearing, with
    R sin(alpha - theta) = M sin(alpha), M the length of the lever. For small angles a pair angle at radius R therefore
    scales to the median radius R0 by the factor ((R0 - M) / R0) / ((R - M) / R). `slack_rad` bounds the neglected
    terms: d(theta)/dR = M alpha / R^2 times the difference of the two radii, a relative term alpha^2 in wide fields,
    and a second-order term. Raises ImageError if there are no pairs.
    """
    radius = np.linalg.norm(leds.position_m, axis=1)
    usual, lever_m = float(np.median(radius)), float(np.linalg.norm(lever.camera_body_m))
    rays = corner_rays(camera)
    inner, half = inner_field(rays)
    alpha = float(np.arccos(rays[:, 2].min()))
    # At a given angle from the boresight, the LED of the greatest radius has the greatest angle about the bearing.
    theta = alpha - np.arcsin(min(lever_m / radius.max() * np.sin(alpha), 1.0))
    index = build(leds.position_m / radius[:, None], min(2.1 * theta, np.pi), leds.board)
    scale = (usual - lever_m) / usual * radius / (radius - lever_m)
    first, second = index.pair.T
    off_m = np.abs(radius - usual).max()
    differ_m = np.abs(radius[first] - radius[second]).max() + alpha**2 * off_m + off_m**2 / usual
    slack = 1.5 * differ_m * lever_m * alpha / radius.min() ** 2
    return Sight(
        at_usual(index, scale),
        grid_of(index.vectors),
        np.ascontiguousarray(leds.position_m, dtype=float),
        radius,
        usual,
        lever.cam_from_body.apply(lever.camera_body_m),
        float(slack),
        inner,
        float(4 * half[0] * half[1]),
        (2 * np.pi) ** 2 * cap_height(leds.position_m / radius[:, None], theta),
        float(leds.sigma_m / (radius.min() - lever_m)),
        float(lever.sigma_m / (radius.min() - lever_m)),
        False,
    )


def sky_of(vectors: Floats, camera: Camera) -> Sight:
    """Index of stars, (N, 3) unit vectors sorted by brightness: a dome of radius 1 with the camera at its center."""
    stars = LedMap(np.arange(len(vectors)), vectors, np.zeros(3), np.ones(3))
    return sight_of(stars, Lever(np.zeros(3), Rotation.identity()), camera)._replace(brightest_first=True)


def corner_rays(camera: Camera) -> Floats:
    """(4, 3) unit rays of the sensor's corners, in camera axes."""
    return camera.rays(np.array([[0, 0], [1, 0], [0, 1], [1, 1]]) * [camera.width_px, camera.height_px] - 0.5)


def inner_field(corners: Floats) -> tuple[Floats, Floats]:
    """The inner field of a sensor with (4, 3) corner rays.

    Returns its (4,) tangents left, right, top, bottom, INNER times the full field, and (2,) the half-size of the full
    field.
    """
    tangent = corners[:, :2] / corners[:, 2:]
    middle, half = (tangent.max(axis=0) + tangent.min(axis=0)) / 2, np.ptp(tangent, axis=0) / 2
    return np.array([middle - INNER * half, middle + INNER * half]).T.ravel(), half


def grid_of(directions: Floats) -> Grid:
    """Grid of (N, 3) unit vectors with one vector per cell on average."""
    middle = directions.mean(axis=0)
    R_grid_from_lab = Rotation.align_vectors([[0.0, 0.0, 1.0]], [middle])[0].as_matrix()
    turned = directions @ R_grid_from_lab.T
    flat = turned[:, :2]
    half = np.abs(flat).max() * 1.001
    side = max(int(np.sqrt(len(flat))), 1)
    cell = 2 * half / side
    column, row = ((flat + half) / cell).astype(np.int64).T
    number = row * side + column
    order = np.argsort(number, kind="stable")
    first = np.searchsorted(number[order], np.arange(side * side + 1))
    return Grid(R_grid_from_lab, float(cell), side, first, np.ascontiguousarray(turned[order]))


def at_usual(index: PairIndex, scale: Floats) -> PairIndex:
    """The index with each pair angle multiplied by the mean scale (N,) of its LEDs, sorted again by angle."""
    first, second = index.pair.T
    angle = index.angle_rad * (scale[first] + scale[second]) / 2
    order = np.argsort(angle, kind="stable")
    kvector, slope, offset = line(angle[order])
    return index._replace(
        pair=np.ascontiguousarray(index.pair[order]),
        angle_rad=angle[order],
        kvector=kvector,
        slope_rad=slope,
        offset_rad=offset,
    )


def cap_height(directions: Floats, margin_rad: float) -> float:
    """1 - cos(half-angle) of the cap about the mean of (N, 3) directions that holds all of them, plus a margin."""
    middle = directions.mean(axis=0)
    nearest = (directions @ middle).min() / max(np.linalg.norm(middle), 1e-9)
    return float(1 - np.cos(min(np.arccos(np.clip(nearest, -1, 1)) + margin_rad, np.pi)))
