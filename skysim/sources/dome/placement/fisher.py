"""What the LEDs in a camera's field tell of the attitude: the Fisher information of turns about the bearing.

For very many attitudes and places at once; how much of it makes a good dome is `optimise`'s to say.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from skysim.core.jit import jit
from skysim.core.types import Floats

Ints = NDArray[np.int64]

UNKNOWN = 1e-6  # information, rad^-2, of a turn that no LED tells: a variance of a million
HARDNESS = 10  # the soft maximum's power of the variance: 1 is the mean, infinity the worst
COLUMNS = 4  # to a field's reach, by which attitudes are sorted
SHORT = 1.5  # an LED too few in a field counts as this factor of its variance


class Seen(NamedTuple):
    """Which attitudes see each of K sites: those of site k are attitude[start[k]:start[k + 1]].

    told : (M, 7) by one LED there, J'J per rad^2 of a ray's tangents: xx, yy, zz, xy, xz, yz of body axes; and a 1
    """

    start: Ints
    attitude: Ints
    told: Floats


@jit
def in_field(R: Floats, point_m: Floats, camera_m: Floats, tan_half: Floats, b: Floats) -> bool:
    """Whether the attitude R_body_from_lab has a point in its field; b becomes the point in body axes."""
    b[2] = R[2, 0] * point_m[0] + R[2, 1] * point_m[1] + R[2, 2] * point_m[2]
    ahead_m = b[2] - camera_m[2]
    b[0] = R[0, 0] * point_m[0] + R[0, 1] * point_m[1] + R[0, 2] * point_m[2]
    if ahead_m <= 0 or abs(b[0] - camera_m[0]) > tan_half[0] * ahead_m:
        return False
    b[1] = R[1, 0] * point_m[0] + R[1, 1] * point_m[1] + R[1, 2] * point_m[2]
    return abs(b[1] - camera_m[1]) <= tan_half[1] * ahead_m


@jit
def tell(b: Floats, camera_m: Floats, out: Floats) -> None:
    """(7,) J'J of one LED, and 1: q = b - r, dq = w x b, so a tangent q_x / q_z turns by w . (b x d), d its slope."""
    ahead_m = b[2] - camera_m[2]
    dx, dy = 1 / ahead_m, 1 / ahead_m
    x, y = -(b[0] - camera_m[0]) / ahead_m**2, -(b[1] - camera_m[1]) / ahead_m**2
    gx = (b[1] * x, b[2] * dx - b[0] * x, -b[1] * dx)
    gy = (b[1] * y - b[2] * dy, -b[0] * y, b[0] * dy)
    for i in range(3):
        out[i] = gx[i] ** 2 + gy[i] ** 2
    out[3] = gx[0] * gx[1] + gy[0] * gy[1]
    out[4] = gx[0] * gx[2] + gy[0] * gy[2]
    out[5] = gx[1] * gx[2] + gy[1] * gy[2]
    out[6] = 1


@jit
def widest(sites_m: Floats, camera_m: Floats, tan_half: Floats) -> float:
    """Chord of unit vectors, between a boresight and what is in its field, both seen from the bearing; or more."""
    aside_m = math.hypot(camera_m[0], camera_m[1])
    chord = 0.0
    for k in range(len(sites_m)):
        range_m = math.sqrt(np.sum(sites_m[k] ** 2))
        ahead_m = max(range_m - camera_m[2], 0.0)
        sine = (aside_m + math.hypot(tan_half[0], tan_half[1]) * ahead_m) / range_m
        chord = max(chord, 2 * math.sin(math.asin(sine) / 2) if sine < 1 else 2.0)
    return chord


@jit
def look(
    sites_m: Floats, R_body_from_lab: Floats, camera_m: Floats, tan_half: Floats
) -> tuple[Ints, Ints, Floats]:
    """Seen of every site: its attitudes, and what an LED there would tell them.

    Attitudes are taken by columns of their boresights' x, in each in the order of y: only those near a site are asked.
    """
    b, wide = np.empty(3), widest(sites_m, camera_m, tan_half)
    columns = max(int(2 * COLUMNS / wide), 1)
    column = np.minimum(((R_body_from_lab[:, 2, 0] + 1) / 2 * columns).astype(np.int64), columns - 1)
    order = np.argsort(4.0 * column + R_body_from_lab[:, 2, 1])
    R, y = R_body_from_lab[order], R_body_from_lab[order, 2, 1]
    first = np.searchsorted(column[order], np.arange(columns + 1))
    start = np.zeros(len(sites_m) + 1, dtype=np.int64)
    attitude, information = np.empty(1024, dtype=np.int64), np.empty((1024, 7))
    m = 0
    for k in range(len(sites_m)):
        up = sites_m[k] / math.sqrt(np.sum(sites_m[k] ** 2))
        left = max(int((up[0] - wide + 1) / 2 * columns), 0)
        right = min(int((up[0] + wide + 1) / 2 * columns), columns - 1)
        for c in range(left, right + 1):
            those = y[first[c] : first[c + 1]]
            for q in range(
                first[c] + np.searchsorted(those, up[1] - wide),
                first[c] + np.searchsorted(those, up[1] + wide),
            ):
                if not in_field(R[q], sites_m[k], camera_m, tan_half, b):
                    continue
                if m == len(attitude):
                    attitude = np.concatenate((attitude, np.empty_like(attitude)))
                    information = np.concatenate((information, np.empty_like(information)))
                tell(b, camera_m, information[m])
                attitude[m] = order[q]
                m += 1
        start[k + 1] = m
    return start, attitude[:m], information[:m]


def told(place_m: Floats, R_body_from_lab: Floats, camera_m: Floats, tan_half: Floats) -> Floats:
    """(A, 7) of every attitude, what all LEDs in its field tell together; the last is how many they are."""
    seen = Seen(*look(place_m, R_body_from_lab, camera_m, tan_half))
    return tally(np.arange(len(place_m)), seen, len(R_body_from_lab))


@jit
def variance(m: Floats) -> float:
    """tr(M^-1) of a symmetric (3, 3) matrix as (6,), by its minors: the turn's variance for rays of 1 rad^2."""
    a, b, c, d, e, f = m[0] + UNKNOWN, m[1] + UNKNOWN, m[2] + UNKNOWN, m[3], m[4], m[5]
    minors = (a * b - d * d) + (a * c - e * e) + (b * c - f * f)
    whole = a * (b * c - f * f) - d * (d * c - e * f) + e * (d * f - b * e)
    return minors / max(whole, 1e-30)


@jit
def variances(total: Floats) -> Floats:
    """(A,) of every attitude."""
    out = np.empty(len(total))
    for a in range(len(total)):
        out[a] = variance(total[a])
    return out


@jit
def cost(m: Floats, wanted: int) -> float:
    """One attitude's share of the soft maximum: (SHORT^missing tr(M^-1))^HARDNESS."""
    each = variance(m)
    for _ in range(wanted - round(m[6])):
        each *= SHORT
    return each**HARDNESS


@jit
def costs(total: Floats, wanted: int) -> Floats:
    """(A,) of every attitude."""
    out = np.empty(len(total))
    for a in range(len(total)):
        out[a] = cost(total[a], wanted)
    return out


@jit
def tally(chosen: Ints, seen: Seen, attitude_count: int) -> Floats:
    """(A, 7) of every attitude, as `told`, from what the sites are known to tell."""
    total = np.zeros((attitude_count, 7))
    for site in chosen:
        add(site, 1, seen, total)
    return total


@jit
def add(site: int, sign: int, seen: Seen, total: Floats) -> None:
    """Light an LED (sign 1) or put it out (-1) in the sums of those who see it."""
    for m in range(seen.start[site], seen.start[site + 1]):
        a = seen.attitude[m]
        for i in range(7):
            total[a, i] += sign * seen.told[m, i]


@jit
def renew(site: int, seen: Seen, total: Floats, each: Floats, wanted: int) -> float:
    """By how much the cost of those who see a site changes; `each` becomes the new one."""
    change = 0.0
    for m in range(seen.start[site], seen.start[site + 1]):
        a = seen.attitude[m]
        fresh = cost(total[a], wanted)
        change += fresh - each[a]
        each[a] = fresh
    return change
