"""Ambiguity of an LED layout: the fraction of LEDs that coincide when one field of view is laid over another.

A tracker identifies an attitude by the pattern of LEDs in its field. If another attitude shows nearly the same
pattern, then noise, a failed LED or a reflection decides between the two. Pairs of LEDs with equal separation are
harmless, so the whole field is compared.

1. For each LED that a boresight can reach, the other LEDs of its field are stored in polar image coordinates: the
   tangent of the angle from the center and the azimuth (`fields_about`).
2. For every pair of fields (i, j) one field is laid on the other, center on center (`most_similar`). A field is also
   compared with itself, rotated. A cheap upper bound (`upper_bound`) skips most pairs.
3. Every rotation about the center that makes a second LED coincide is tried (`max_coincident`).
4. The LEDs that then are within the tolerance are counted (`count_coincident`).

The ambiguity of field i is the maximum over j and over the rotations of

    fraction = (1 + coincident LEDs) / (1 + LEDs of the larger field),

where the 1 is the center LED.
"""

import math
from typing import NamedTuple

import numpy as np
from scipy.spatial import KDTree

from skysim.core.errors import InputError
from skysim.core.jit import jit
from skysim.core.types import Floats, Ints, lengths, normalized, positive


class Fields(NamedTuple):
    """The neighbors of each of C center LEDs, in polar image coordinates about it, nearest first.

    Attributes
    ----------
    center
        (C,) numbers of the center LEDs
    first
        (C + 1,) neighbor n belongs to center[c] for first[c] <= n < first[c + 1]
    radius, angle_rad
        (M,) tangent of the angle from the center, and azimuth
    tolerance
        (C,) greatest distance of coincident LEDs, as a tangent
    """

    center: Ints
    first: Ints
    radius: Floats
    angle_rad: Floats
    tolerance: Floats


class Ambiguity(NamedTuple):
    """For the field about each of C LEDs, the most similar other field.

    Attributes
    ----------
    led, other
        (C,) numbers of the LEDs at the centers of the field and of its most similar field
    fraction
        (C,) fraction of LEDs that coincide, of those in the larger of the two fields; the center LEDs count
    """

    led: Ints
    other: Ints
    fraction: Floats


def field_ambiguity(
    place_m: Floats,
    height_m: float,
    tilt_rad: float,
    radius_rad: float,
    coincidence_m: float,
    least: float = 0.0,
) -> Ambiguity:
    """For every LED that the boresight can reach, the largest fraction of its field that another attitude also shows.

    One center LED is laid on another and the field is rotated about it. For a camera on its lever arm that is a
    rotation about the bearing. The rotations tried are those that bring a second LED to coincide. A field is also
    laid on itself, rotated. Coincidence is judged in the camera's perspective, so on a dome that is not a sphere the
    fields differ.

    Parameters
    ----------
    place_m
        (N, 3) places in the lab, origin at the bearing's center
    height_m
        Height of the entrance pupil above the bearing, along the boresight (its lateral offset is neglected)
    tilt_rad
        Fields are centered on the LEDs within this angle from the zenith
    radius_rad
        Radius of the round field
    coincidence_m
        Two LEDs coincide if they are nearer than this after one field is laid on the other
    least
        Fractions below this are not searched, which is much faster, and are returned as this
    """
    fields = fields_about(place_m, height_m, tilt_rad, radius_rad, coincidence_m)
    fraction, other = most_similar(fields, least)
    return Ambiguity(fields.center, fields.center[other], fraction)


def fields_about(
    place_m: Floats, height_m: float, tilt_rad: float, radius_rad: float, coincidence_m: float
) -> Fields:
    """The neighbors of every LED within the tilt, as seen with that LED on the boresight (step 1)."""
    range_m = lengths(place_m)
    up = place_m / range_m[:, None]
    center = np.flatnonzero(up[:, 2] >= math.cos(tilt_rad))
    # Image axes: x = y_lab x boresight, which is defined because the tilt stays below 90 deg.
    across = normalized(np.cross([0.0, 1.0, 0.0], up[center]))
    x_m = across @ place_m.T
    y_m = np.cross(up[center], across) @ place_m.T
    ahead_m = up[center] @ place_m.T - height_m
    radius = np.hypot(x_m, y_m) / positive(ahead_m)
    # The center LED is not its own neighbor.
    radius[np.arange(len(center)), center] = np.nan
    row, led = np.nonzero(radius <= math.tan(radius_rad))
    radius = radius[row, led]
    angle_rad = np.arctan2(y_m[row, led], x_m[row, led])
    # By field, nearest first.
    order = np.lexsort((radius, row))
    first = np.concatenate([[0], np.cumsum(np.bincount(row, minlength=len(center)))])
    tolerance = coincidence_m / (range_m[center] - height_m)
    return Fields(center, first, radius[order], angle_rad[order], tolerance)


@jit
def most_similar(fields: Fields, least: float) -> tuple[Floats, Ints]:
    """(C,) greatest fraction of each field that another field shows too, at least `least`, and (C,) that field."""
    count = len(fields.center)
    fraction = np.full(count, least)
    other = np.arange(count)
    for i in range(count):
        for j in range(i, count):
            larger = 1 + max(
                fields.first[i + 1] - fields.first[i], fields.first[j + 1] - fields.first[j]
            )
            # The exact search is needed only if the pair can raise the maximum of one of its two fields.
            threshold = min(fraction[i], fraction[j]) * larger
            overlap = (1 + max_coincident(fields, i, j, threshold - 1, least > 0)) / larger
            if overlap > fraction[i]:
                fraction[i] = overlap
                other[i] = j
            if overlap > fraction[j]:
                fraction[j] = overlap
                other[j] = i
    return fraction, other


@jit
def max_coincident(fields: Fields, i: int, j: int, threshold: float, farther: bool) -> int:
    """The most neighbors of i that coincide with neighbors of j at any rotation; a lower bound if at most `threshold`.

    Parameters
    ----------
    farther
        Try only the rotations of the farther half of n neighbors, or of n - threshold if that is more. They are more
        accurate than those of near neighbors, and of any n - threshold neighbors one must coincide.
    """
    first = fields.first
    radius = fields.radius
    angle = fields.angle_rad
    tolerance = fields.tolerance[i]
    if upper_bound(fields, i, j) <= threshold:
        return 0
    most = 0
    # First neighbor of i to try.
    begin = first[j]
    inner = max(min(int(threshold), (first[i + 1] - first[i]) // 2), 0) if farther else 0
    for k in range(first[i] + inner, first[i + 1]):
        # Radii ascend, so the window of equal radii in field j only moves forward.
        while begin < first[j + 1] and radius[begin] < radius[k] - tolerance:
            begin += 1
        n = begin
        while n < first[j + 1] and radius[n] <= radius[k] + tolerance:
            # The identity, a field laid on itself without rotation, is no ambiguity.
            if i != j or n != k:
                most = max(
                    most,
                    count_coincident(fields, i, j, angle[n] - angle[k], max(most, threshold)),
                )
            n += 1
    return most


@jit
def upper_bound(fields: Fields, i: int, j: int) -> int:
    """Upper bound of `count_coincident` over all rotations: neighbors of i with a neighbor of j at an equal radius."""
    first = fields.first
    radius = fields.radius
    tolerance = fields.tolerance[i]
    total = 0
    n = first[j]
    for k in range(first[i], first[i + 1]):
        while n < first[j + 1] and radius[n] < radius[k] - tolerance:
            n += 1
        total += n < first[j + 1] and radius[n] <= radius[k] + tolerance
    return total


@jit
def count_coincident(
    fields: Fields, i: int, j: int, rotation_rad: float, threshold: float
) -> int:
    """Neighbors of i that coincide with one of j after i is rotated; fewer if no more than the threshold do."""
    first = fields.first
    radius = fields.radius
    angle = fields.angle_rad
    tolerance = fields.tolerance[i]
    total = 0
    begin = first[j]
    for k in range(first[i], first[i + 1]):
        # Too few are left to exceed the threshold.
        if total + first[i + 1] - k <= threshold:
            break
        while begin < first[j + 1] and radius[begin] < radius[k] - tolerance:
            begin += 1
        n = begin
        while n < first[j + 1] and radius[n] <= radius[k] + tolerance:
            # Squared distance in polar coordinates, by the chord.
            difference_rad = angle[n] - angle[k] - rotation_rad
            chord = 2 * radius[k] * math.sin(difference_rad / 2)
            if (radius[n] - radius[k]) ** 2 + chord**2 <= tolerance**2:
                total += 1
                break
            n += 1
    return total


# Neighborhood codes: levels of brightness by which every LED is known from its surroundings. The neighborhood of an LED
# is its own level and those of its nearest LEDs, in the order of their azimuths about it. It is the same however the
# field is turned: the least word of all turns represents it. Levels are drawn at random; as long as two neighborhoods
# are alike, an LED of one gets another level if no more are alike then, as in the pseudorandom patterns of structured
# light (Morano et al. 1998, IEEE Trans. Pattern Analysis and Machine Intelligence 20, 322).


ROUNDS = 5000  # of new levels before the search fails


def unique_levels(
    levels: int, nearest: int, position_m: Floats, rng: np.random.Generator
) -> Ints:
    """(N,) numbers of the LEDs' levels at (N, 3) places, so that no two neighborhoods are alike.

    Raises
    ------
    InputError
        If no such pattern is found.
    """
    count = len(position_m)
    if count <= nearest:
        raise InputError(
            "light.layout.unique_neighbors", f"{nearest} of {count} LEDs", "fewer"
        )
    around = neighbors(position_m, nearest)
    level = rng.integers(0, levels, count)
    alike = alike_leds(level, around, levels)
    for _ in range(ROUNDS):
        if not len(alike):
            return level
        # New levels for some of the LEDs in question or their neighbors, fewer at a time toward the end.
        tried = level.copy()
        some = rng.permutation(alike)[: max(len(alike) // 10, 1)]
        drawn = rng.integers(0, levels, len(some))
        tried[rng.choice(np.append(around[some].ravel(), some), len(some))] = drawn
        after = alike_leds(tried, around, levels)
        if len(after) <= len(alike):
            level = tried
            alike = after
    raise InputError(
        "light.layout.unique_neighbors",
        f"{nearest} with {levels} levels leave some of {count} LEDs alike",
        "more levels or neighbors",
    )


def neighbors(position_m: Floats, nearest: int) -> Ints:
    """(N, nearest) the nearest LEDs of each, by increasing azimuth about its direction from the bearing."""
    direction = normalized(position_m)
    near = KDTree(direction).query(direction, nearest + 1)[1][:, 1:]
    offset = direction[near] - direction[:, None]
    # Two axes across the direction; any two serve, since the comparison is of all turns.
    x = np.cross(
        direction, np.where(np.abs(direction[:, :1]) < 0.9, [[1.0, 0, 0]], [[0, 1.0, 0]])
    )
    y = np.cross(direction, x)
    azimuth = np.arctan2(
        np.einsum("nki,ni->nk", offset, y), np.einsum("nki,ni->nk", offset, x)
    )
    return np.take_along_axis(near, np.argsort(azimuth, axis=1), axis=1)


def alike_leds(level: Ints, around: Ints, levels: int) -> Ints:
    """LEDs with a neighborhood that another LED has too."""
    words = neighborhoods(level, around, levels)
    _, number, count = np.unique(words, return_inverse=True, return_counts=True)
    return np.flatnonzero(count[number] > 1)


def neighborhoods(level: Ints, around: Ints, levels: int) -> Ints:
    """(N,) number of each neighborhood: the levels as digits of base `levels`, the least number of all turns."""
    nearest = around.shape[1]
    power = levels ** np.arange(nearest)
    ring = np.min(
        [np.roll(level[around], turn, axis=1) @ power for turn in range(nearest)], axis=0
    )
    return level * levels**nearest + ring
