"""What is believed of a dome, laid out for identification: LEDs by the angles between them and by direction."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from estimator.attitude.dome_map import LedMap, Lever
from estimator.catalog.pair_index import PairIndex, build, line
from estimator.core.arrays import Floats
from estimator.core.camera import Camera

INNER = 0.95  # of the field: an LED nearer to its border may be cut off, which is no reason to miss it


class Grid(NamedTuple):
    """Where LEDs are, by cells: a square of side * side cells over their directions' x and y.

    R_grid_from_lab : (3, 3) turns their middle to +z
    cell, side      : of a cell, and how many are along a side
    first           : LEDs first[c] to first[c + 1] are in cell c;  direction : (N, 3) of the LEDs in that order, turned
    """

    R_grid_from_lab: Floats
    cell: float
    side: int
    first: NDArray[np.int64]
    direction: Floats


class Sight(NamedTuple):
    """What is believed, laid out for the search. A plain tuple, so that compiled code can take it.

    pairs      : of LEDs by the angle in which the bearing would see them at the usual radius (`at_usual`)
    grid       : the LEDs by direction
    position_m : (L, 3) LEDs in the lab;  radius_m : (L,) from the bearing;  usual_m : their median
    pupil_m    : (3,) from the bearing, in camera axes
    slack_rad  : by which an angle at the usual radius may differ from a pair's at its own radii
    field_tan  : (4,) tangents left, right, top, bottom within which an LED must be seen whole
    area       : of the sensor, in tangents squared
    volume     : of attitudes that show any of it: steradians of boresights times 2 pi of rolls
    led_sigma, lever_sigma : of an LED's place and of the pupil's, by the least distance between the two
    brightest_first : whether rows go by brightness, so that what is fainter than all that is seen is not missed
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
    """Lay out a dome for the search: every pair of LEDs that one field can hold.

    The bearing sees a ray at alpha off the boresight at theta, R sin(alpha - theta) = M sin(alpha), so that an angle
    at radius R is one at the usual radius R0 times ((R0 - M) / R0) / ((R - M) / R) for small angles. What that leaves
    out is d(theta)/dR = M alpha / R^2 times what the two radii differ by, and alpha^2 of itself where the field is
    wide, and a second-order rest. Raises ImageError where there are no pairs.
    """
    radius = np.linalg.norm(leds.position_m, axis=1)
    usual, lever_m = float(np.median(radius)), float(np.linalg.norm(lever.camera_body_m))
    rays = corner_rays(camera)
    inner, half = inner_field(rays)
    alpha = float(np.arccos(rays[:, 2].min()))
    # From the bearing the farthest light in a corner is the widest apart.
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
    """Stars, (N, 3) unit vectors, brightest first: a dome of radius 1 with the camera at its centre."""
    stars = LedMap(np.arange(len(vectors)), vectors, np.zeros(3), np.ones(3))
    return sight_of(stars, Lever(np.zeros(3), Rotation.identity()), camera)._replace(brightest_first=True)


def corner_rays(camera: Camera) -> Floats:
    """(4, 3) rays of the sensor's corners."""
    return camera.rays(np.array([[0, 0], [1, 0], [0, 1], [1, 1]]) * [camera.width_px, camera.height_px] - 0.5)


def inner_field(corners: Floats) -> tuple[Floats, Floats]:
    """Of a field's corners, (4, 3): tangents left, right, top, bottom of what is well inside, and half of all, (2,)."""
    tangent = corners[:, :2] / corners[:, 2:]
    middle, half = (tangent.max(axis=0) + tangent.min(axis=0)) / 2, np.ptp(tangent, axis=0) / 2
    return np.array([middle - INNER * half, middle + INNER * half]).T.ravel(), half


def grid_of(directions: Floats) -> Grid:
    """(N, 3) unit vectors by cells, one to a cell on average."""
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
    """The index with each pair's angle times the mean of its LEDs' scales (N,), sorted by that."""
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
    """1 - cos of the half-angle of the cap about (N, 3) directions' middle that holds them, and a margin more."""
    middle = directions.mean(axis=0)
    nearest = (directions @ middle).min() / max(np.linalg.norm(middle), 1e-9)
    return float(1 - np.cos(min(np.arccos(np.clip(nearest, -1, 1)) + margin_rad, np.pi)))
