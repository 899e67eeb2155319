"""Fisher information about the attitude from the LEDs in the camera's field of view.

An LED at b in body axes, seen from the entrance pupil at r, has the line of sight q = b - r and the image tangents
x = q_x / q_z and y = q_y / q_z. A small rotation w of the body about the bearing changes b by w x b, up to the sign.
A tangent with the gradient d with respect to q, for example d = (1, 0, -x) / q_z, therefore changes by

    d . (w x b) = w . (b x d),

so that b x d is a row of the Jacobian J_i (2, 3) of LED i. With independent errors of equal variance sigma^2 in each
tangent, the rotation has the covariance sigma^2 M^-1, with the information M = sum_i J_i'J_i over the LEDs in view, and
the total variance sigma^2 tr(M^-1). `optimize` minimizes tr(M^-1), summed over attitudes with a high power.

1. `visible_from` computes J_i'J_i once per round for every pair of a site and an attitude that sees it.
2. `sum_information` adds them to M for each attitude.
3. `cost` is the term of an attitude in the sum that is minimized.
4. Moving an LED only adds and subtracts terms in the sums of the attitudes concerned (`add_led`, `update_costs`).
"""

import math
from typing import NamedTuple

import numpy as np

from skysim.core.jit import jit
from skysim.core.types import Floats, Ints

# Prior information, rad^-2, that keeps M invertible when too few LEDs are in view.
PRIOR_INFORMATION = 1e-6
HARDNESS = (
    10  # power of the variance in the soft maximum: 1 is the mean, infinity the worst case
)
COLUMNS = 4  # columns of the attitude index per half width of the search window
MISSING_LED_FACTOR = (
    1.5  # factor on the variance for each LED that a field lacks of the minimum
)


class Visibility(NamedTuple):
    """The attitudes that see each of K sites: those of site k are attitude[start[k]:start[k + 1]].

    Attributes
    ----------
    start
        (K + 1,) first row of each site, and the number of rows M
    attitude
        (M,) numbers of the attitudes
    information
        (M, 7) J'J of one LED at the site for unit variance of the tangents: xx, yy, zz, xy, xz, yz in body axes,
        rad^-2; and a 1, which counts LEDs when rows are added
    """

    start: Ints
    attitude: Ints
    information: Floats


@jit
def in_field(
    R: Floats, point_m: Floats, camera_m: Floats, tan_half: Floats, b: Floats
) -> bool:
    """Whether the attitude R_body_from_lab has a point in its field of view; writes the point in body axes to b.

    The height is computed first: most points fail there, or in x.
    """
    b[2] = R[2, 0] * point_m[0] + R[2, 1] * point_m[1] + R[2, 2] * point_m[2]
    ahead_m = b[2] - camera_m[2]
    b[0] = R[0, 0] * point_m[0] + R[0, 1] * point_m[1] + R[0, 2] * point_m[2]
    if ahead_m <= 0 or abs(b[0] - camera_m[0]) > tan_half[0] * ahead_m:
        return False
    b[1] = R[1, 0] * point_m[0] + R[1, 1] * point_m[1] + R[1, 2] * point_m[2]
    return abs(b[1] - camera_m[1]) <= tan_half[1] * ahead_m


@jit
def led_information(b: Floats, camera_m: Floats, out: Floats) -> None:
    """Write the information of one LED at b (body axes) to out (7,): J'J and a 1. The module docstring derives J."""
    # gx = b x (dx, 0, x) and gy = b x (0, dy, y) are the rows of J, with d = (dx, 0, x) the gradient of the tangent x.
    ahead_m = b[2] - camera_m[2]
    dx = 1 / ahead_m
    dy = 1 / ahead_m
    x = -(b[0] - camera_m[0]) / ahead_m**2
    y = -(b[1] - camera_m[1]) / ahead_m**2
    gx = (b[1] * x, b[2] * dx - b[0] * x, -b[1] * dx)
    gy = (b[1] * y - b[2] * dy, -b[0] * y, b[0] * dy)
    # J'J, diagonal and off it, and the count.
    for i in range(3):
        out[i] = gx[i] ** 2 + gy[i] ** 2
    out[3] = gx[0] * gx[1] + gy[0] * gy[1]
    out[4] = gx[0] * gx[2] + gy[0] * gy[2]
    out[5] = gx[1] * gx[2] + gy[1] * gy[2]
    out[6] = 1


@jit
def max_chord(sites_m: Floats, camera_m: Floats, tan_half: Floats) -> float:
    """Upper bound of the chord between the unit vectors from the bearing to a boresight and to a site in its field."""
    # The sine law: the pupil's offset from the boresight, and half the field's diagonal, at the site's range.
    lateral_m = math.hypot(camera_m[0], camera_m[1])
    chord = 0.0
    for k in range(len(sites_m)):
        range_m = math.sqrt(np.sum(sites_m[k] ** 2))
        ahead_m = max(range_m - camera_m[2], 0.0)
        sine = (lateral_m + math.hypot(tan_half[0], tan_half[1]) * ahead_m) / range_m
        chord = max(chord, 2 * math.sin(math.asin(sine) / 2) if sine < 1 else 2.0)
    return chord


@jit
def visible_from(
    sites_m: Floats, R_body_from_lab: Floats, camera_m: Floats, tan_half: Floats
) -> tuple[Ints, Ints, Floats]:
    """Start, attitude and information of `Visibility`, for every site.

    1. Sort the boresights into columns of lab x, and by lab y within each column.
    2. For each site test only attitudes whose boresight is within the chord `max_chord`: the columns and the part of
       each column that the chord reaches.
    3. Store the information of those that have the site in their field.
    """
    # 1.
    b = np.empty(3)
    chord = max_chord(sites_m, camera_m, tan_half)
    columns = max(int(2 * COLUMNS / chord), 1)
    column = np.minimum(
        ((R_body_from_lab[:, 2, 0] + 1) / 2 * columns).astype(np.int64), columns - 1
    )
    # |y| <= 1, so the factor 4 keeps the columns apart in one sort key.
    order = np.argsort(4.0 * column + R_body_from_lab[:, 2, 1])
    R = R_body_from_lab[order]
    y = R_body_from_lab[order, 2, 1]
    first = np.searchsorted(column[order], np.arange(columns + 1))
    # Number of stored rows; the buffers grow as needed.
    start = np.zeros(len(sites_m) + 1, dtype=np.int64)
    attitude = np.empty(1024, dtype=np.int64)
    information = np.empty((1024, 7))
    m = 0
    for k in range(len(sites_m)):
        # 2.
        direction = sites_m[k] / math.sqrt(np.sum(sites_m[k] ** 2))
        left = max(int((direction[0] - chord + 1) / 2 * columns), 0)
        right = min(int((direction[0] + chord + 1) / 2 * columns), columns - 1)
        for c in range(left, right + 1):
            column_y = y[first[c] : first[c + 1]]
            for q in range(
                first[c] + np.searchsorted(column_y, direction[1] - chord),
                first[c] + np.searchsorted(column_y, direction[1] + chord),
            ):
                if not in_field(R[q], sites_m[k], camera_m, tan_half, b):
                    continue
                # 3. Double the buffers when they are full.
                if m == len(attitude):
                    attitude = np.concatenate((attitude, np.empty_like(attitude)))
                    information = np.concatenate((information, np.empty_like(information)))
                led_information(b, camera_m, information[m])
                attitude[m] = order[q]
                m += 1
        start[k + 1] = m
    return start, attitude[:m], information[:m]


def total_information(
    place_m: Floats, R_body_from_lab: Floats, camera_m: Floats, tan_half: Floats
) -> Floats:
    """(A, 7) information of all LEDs in the field of each attitude; the last column is their number."""
    visibility = Visibility(*visible_from(place_m, R_body_from_lab, camera_m, tan_half))
    return sum_information(np.arange(len(place_m)), visibility, len(R_body_from_lab))


@jit
def variance(m: Floats) -> float:
    """tr(M^-1) of a symmetric (3, 3) matrix given as (6,): the rotation's variance for tangents of unit variance.

    The sum of the principal minors over the determinant, with PRIOR_INFORMATION added to the diagonal.
    """
    a = m[0] + PRIOR_INFORMATION
    b = m[1] + PRIOR_INFORMATION
    c = m[2] + PRIOR_INFORMATION
    d = m[3]
    e = m[4]
    f = m[5]
    minors = (a * b - d * d) + (a * c - e * e) + (b * c - f * f)
    determinant = a * (b * c - f * f) - d * (d * c - e * f) + e * (d * f - b * e)
    return minors / max(determinant, 1e-30)


@jit
def variances(total: Floats) -> Floats:
    """(A,) `variance` of every attitude."""
    out = np.empty(len(total))
    for a in range(len(total)):
        out[a] = variance(total[a])
    return out


@jit
def cost(m: Floats, min_leds: int) -> float:
    """One attitude's term of the soft maximum: (MISSING_LED_FACTOR^missing tr(M^-1))^HARDNESS."""
    effective = variance(m)
    # LEDs missing from the field.
    for _ in range(min_leds - round(m[6])):
        effective *= MISSING_LED_FACTOR
    return effective**HARDNESS


@jit
def costs(total: Floats, min_leds: int) -> Floats:
    """(A,) `cost` of every attitude."""
    out = np.empty(len(total))
    for a in range(len(total)):
        out[a] = cost(total[a], min_leds)
    return out


@jit
def sum_information(chosen: Ints, visibility: Visibility, attitude_count: int) -> Floats:
    """(A, 7) information of every attitude, summed from the stored terms of the chosen sites."""
    total = np.zeros((attitude_count, 7))
    for site in chosen:
        add_led(site, 1, visibility, total)
    return total


@jit
def add_led(site: int, sign: int, visibility: Visibility, total: Floats) -> None:
    """Add (sign 1) or remove (-1) an LED at a site in the sums of the attitudes that see it, in place."""
    for m in range(visibility.start[site], visibility.start[site + 1]):
        a = visibility.attitude[m]
        for i in range(7):
            total[a, i] += sign * visibility.information[m, i]


@jit
def update_costs(
    site: int, visibility: Visibility, total: Floats, attitude_cost: Floats, min_leds: int
) -> float:
    """Recompute the costs of the attitudes that see a site, in place, and return the change of their sum."""
    change = 0.0
    for m in range(visibility.start[site], visibility.start[site + 1]):
        a = visibility.attitude[m]
        new_cost = cost(total[a], min_leds)
        change += new_cost - attitude_cost[a]
        attitude_cost[a] = new_cost
    return change
