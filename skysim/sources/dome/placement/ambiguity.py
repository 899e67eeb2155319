"""How alike two fields of one dome can look: whether an identifier, however clever, could tell one from the other.

An attitude is identified by which LEDs are where in its field. If another attitude has LEDs at the same places, but
for a few, then noise, a dead LED or a reflection decides between them. Pairs of equal separation do not matter.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from skysim.core.jit import jit
from skysim.core.types import Floats

Ints = NDArray[np.int64]


class Fields(NamedTuple):
    """What is about each of C LEDs, in polar coordinates of the image whose middle it has, nearest first.

    centre : (C,) the LED;  first : (C + 1,) row `n` of what is about LED centre[c] has first[c] <= n < first[c + 1]
    radius, angle_rad : (M,) tangent of the angle from the middle, and the direction;  alike : (C,) tolerance, a tangent
    """

    centre: Ints
    first: Ints
    radius: Floats
    angle_rad: Floats
    alike: Floats


class Likeness(NamedTuple):
    """The likest other field of the field about each of C LEDs.

    led, other : (C,) numbers of LEDs in the middle of the field and of its likest
    share      : (C,) LEDs that coincide, of those in the fuller of the two fields; the middle ones count
    """

    led: Ints
    other: Ints
    share: Floats


def likeness(
    place_m: Floats, height_m: float, tilt_rad: float, radius_rad: float, alike_m: float
) -> Likeness:
    """For every LED the camera can point at, how much of the field about it another attitude shows as well.

    place_m    : (N, 3) in the lab, origin at the bearing's centre
    height_m   : of the entrance pupil over it, along the boresight (what it is aside of that is left out)
    tilt_rad   : no LED farther from the zenith has a field about it; radius_rad: of the field, a round one
    alike_m    : two LEDs nearer than that after one field is laid on the other coincide
    One LED is laid on another and the field turned about it, which for a camera on its lever is a turn about the
    bearing: every turn is tried that brings a second LED to coincide. An LED is also laid on itself, turned.
    Coincidence is judged as the camera sees it, so a dome that is not a sphere makes fields differ.
    """
    fields = fields_about(place_m, height_m, tilt_rad, radius_rad, alike_m)
    share, other = likest(fields)
    return Likeness(fields.centre, fields.centre[other], share)


def fields_about(
    place_m: Floats, height_m: float, tilt_rad: float, radius_rad: float, alike_m: float
) -> Fields:
    """Every LED within the tilt brought to the boresight, and what it has about it."""
    range_m = np.linalg.norm(place_m, axis=1)
    up = place_m / range_m[:, None]
    centre = np.flatnonzero(up[:, 2] >= math.cos(tilt_rad))
    across = np.cross([0.0, 1.0, 0.0], up[centre])
    across /= np.linalg.norm(across, axis=1, keepdims=True)
    x_m, y_m = across @ place_m.T, np.cross(up[centre], across) @ place_m.T
    ahead_m = up[centre] @ place_m.T - height_m
    radius = np.hypot(x_m, y_m) / np.where(ahead_m > 0, ahead_m, np.nan)
    radius[np.arange(len(centre)), centre] = np.nan
    row, led = np.nonzero(radius <= math.tan(radius_rad))
    radius, angle_rad = radius[row, led], np.arctan2(y_m[row, led], x_m[row, led])
    order = np.lexsort((radius, row))
    first = np.concatenate([[0], np.cumsum(np.bincount(row, minlength=len(centre)))])
    alike = alike_m / (range_m[centre] - height_m)
    return Fields(centre, first, radius[order], angle_rad[order], alike)


@jit
def likest(fields: Fields) -> tuple[Floats, Ints]:
    """(C,) greatest share of each field that another one has, and which one that is."""
    count = len(fields.centre)
    share, other = np.zeros(count), np.arange(count)
    for i in range(count):
        for j in range(i, count):
            fuller = 1 + max(fields.first[i + 1] - fields.first[i], fields.first[j + 1] - fields.first[j])
            # Only what would raise either of the two is worth a search.
            enough = min(share[i], share[j]) * fuller
            alike = (1 + coincide(fields, i, j, enough - 1)) / fuller
            if alike > share[i]:
                share[i], other[i] = alike, j
            if alike > share[j]:
                share[j], other[j] = alike, i
    return share, other


@jit
def coincide(fields: Fields, i: int, j: int, enough: float) -> int:
    """The most LEDs about i that meet ones about j at one turn; 0 if they cannot be more than `enough`."""
    first, radius, angle, alike = fields.first, fields.radius, fields.angle_rad, fields.alike[i]
    if reach(fields, i, j) <= enough:
        return 0
    most, begin = 0, first[j]
    for k in range(first[i], first[i + 1]):
        while begin < first[j + 1] and radius[begin] < radius[k] - alike:
            begin += 1
        n = begin
        while n < first[j + 1] and radius[n] <= radius[k] + alike:
            if i != j or n != k:
                most = max(most, met(fields, i, j, angle[n] - angle[k]))
            n += 1
    return most


@jit
def reach(fields: Fields, i: int, j: int) -> int:
    """How many LEDs about i have one about j as far from the middle: no turn makes more of them meet."""
    first, radius, alike = fields.first, fields.radius, fields.alike[i]
    total, n = 0, first[j]
    for k in range(first[i], first[i + 1]):
        while n < first[j + 1] and radius[n] < radius[k] - alike:
            n += 1
        total += n < first[j + 1] and radius[n] <= radius[k] + alike
    return total


@jit
def met(fields: Fields, i: int, j: int, turn_rad: float) -> int:
    """How many LEDs about i, turned, meet one about j."""
    first, radius, angle, alike = fields.first, fields.radius, fields.angle_rad, fields.alike[i]
    total, begin = 0, first[j]
    for k in range(first[i], first[i + 1]):
        while begin < first[j + 1] and radius[begin] < radius[k] - alike:
            begin += 1
        n = begin
        while n < first[j + 1] and radius[n] <= radius[k] + alike:
            off_rad = angle[n] - angle[k] - turn_rad
            chord = 2 * radius[k] * math.sin(off_rad / 2)
            if (radius[n] - radius[k]) ** 2 + chord**2 <= alike**2:
                total += 1
                break
            n += 1
    return total
