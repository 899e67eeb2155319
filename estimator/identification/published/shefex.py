"""SHEFEX-2's identifier: a base triangle of bright stars, a fourth star, then the rest, by cosines of angles.

Samaan & Theil 2011, section 3.4 and Fig. 6. Two angles agree if their cosines differ by less than cosError. This
gate is wide for stars close together: for 5.5e-5 it is 0.090 deg at 2 deg, and 0.010 deg at 18.57 deg.

1. Take a base triangle of observed stars, by brightness (`search`).
2. Find the catalog triangles with the same sides, by the k-vector and the neighbor lists (`_triangle`).
3. Reject those of the other handedness (not in the paper).
4. Identify every other star by its three angles to the base, a fourth star first (`_match_others`, `_partner`).
5. Keep those that are near their predicted place at the attitude found (not in the paper).
6. Accept a match with fewer than 1e-5 chance matches expected over all triangles. The paper accepts any fourth star,
   and so does the acceptance `thesis`.
"""

from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from estimator.catalog.pair_index import PairIndex, neighbor_range, pair_range
from estimator.core.checks import Floats
from estimator.core.jit import inlined, jit
from estimator.core.types import StarMatch
from estimator.identification.chance import ACCEPT_LOG10_CHANCE, MIN_MATCHES, log10_tail
from estimator.identification.direct_match import (
    DirectMatch,
    angle,
    fit_rotation,
    no_match,
    to_star_match,
    triangle_sides_rad,
    triple,
)
from estimator.identification.solver_options import Options

FOURTH_STAR = 1e300  # the paper's own rule: "it is already certain that a success will occur"
# Least angle between base stars, and from them to others, in tolerances: smaller angles carry little information.
MIN_SIDE_TOLERANCES = 6.0


class ShefexOptions(NamedTuple):
    """Search parameters.

    Attributes
    ----------
    cos_error
        Greatest difference of the cosines of two angles that agree
    tolerance_rad
        Tolerance of a direction
    triangles, checks, base
        Limits of the effort (see `Options`)
    accept
        log10 of the chance at which a match is accepted; FOURTH_STAR accepts any match with a fourth star
    """

    cos_error: float
    tolerance_rad: float
    triangles: int
    checks: int
    base: int
    accept: float = ACCEPT_LOG10_CHANCE


def cos_error(fov_rad: float, centroid_error_rad: float, factor: float = 1.0) -> float:
    """cosError by eq. 3: c |cos FOV - cos(FOV - centroidError)|.

    With c from 1.6 to 5, centroid errors from 0.3 to 0.1 pixels give the paper's 5.5e-5.

    Parameters
    ----------
    fov_rad
        Greatest angle of the index
    centroid_error_rad
        Error of a direction
    factor
        The constant c
    """
    return factor * abs(float(np.cos(fov_rad) - np.cos(fov_rad - centroid_error_rad)))


def direction_tolerance_rad(fov_rad: float, cosine_error: float) -> float:
    """The error of a direction to which a cosError corresponds: the inverse of eq. 3 with c = 1."""
    return float(fov_rad - np.arccos(min(np.cos(fov_rad) + cosine_error, 1.0)))


@jit
def angle_interval(angle_rad: float, cos_error: float) -> tuple[float, float]:
    """Interval of angles whose cosines differ by at most cosError from that of an angle: eqs 4 and 5 with correct
    signs.

    Computed with cos a = 1 - 2 sin^2(a / 2), which is accurate for small angles.

    Returns
    -------
    tuple[float, float]
        Lower and upper end, rad
    """
    half = np.sin(angle_rad / 2) ** 2
    low = 2 * np.arcsin(np.sqrt(max(half - cos_error / 2, 0.0)))
    return low, 2 * np.arcsin(np.sqrt(min(half + cos_error / 2, 1.0)))


def shefex(
    vectors_cam: Floats, index: PairIndex, tolerance_rad: float, **options: Any
) -> StarMatch | None:
    """Identify stars by SHEFEX-2's pyramids, brightest first (see the module's steps).

    Unless `cos_error` is given, cosError is that of eq. 3 for the tolerance and the greatest angle of the index.

    Parameters
    ----------
    vectors_cam
        (N, 3) observed unit vectors, brightest first; the paper has 15 at most
    index
        Catalog of the stars and pairs
    tolerance_rad
        Tolerance of a direction
    options
        Keywords of `Options`; magnitudes are not used

    Returns
    -------
    StarMatch | None
        None if no match is significant

    Raises
    ------
    ImageError
        Unless the tolerance is positive.
    """
    settings = Options(**options)
    settings.require_known_focal("shefex")
    settings.require_tolerance("shefex", tolerance_rad)
    if len(vectors_cam) < MIN_MATCHES:
        return None
    if settings.cos_error is None:
        # cosError is one number for all angles: the stretch counts at the greatest angle.
        tolerance_rad += settings.stretch * index.max_angle_rad
        error = cos_error(index.max_angle_rad, tolerance_rad)
    else:
        error = settings.cos_error
        tolerance_rad = direction_tolerance_rad(index.max_angle_rad, error)
    base = min(settings.base_stars, len(vectors_cam))
    accept = FOURTH_STAR if settings.by_paper else ACCEPT_LOG10_CHANCE
    parameters = ShefexOptions(
        error, tolerance_rad, settings.max_triangles, settings.max_checks, base, accept
    )
    tried = np.zeros(3, np.int64)
    match = search(np.ascontiguousarray(vectors_cam), index, parameters, tried)
    if settings.compared is not None:
        # Three angles of each observed triangle, and those of its candidates.
        settings.compared[0] += tried[1] + 3 * tried[2]
    return to_star_match(match, settings.by_paper)


@jit
def search(
    rays: Floats, index: PairIndex, options: ShefexOptions, tried: NDArray
) -> DirectMatch:
    """The compiled search: steps 1 to 6.

    Parameters
    ----------
    tried
        (3,) base triangles found, angles compared and observed triangles so far, increased in place

    Returns
    -------
    DirectMatch
        The first match that is accepted, or else the empty one
    """
    # 1. Triangles of base stars, brightest first.
    for i in range(options.base - 2):
        for j in range(i + 1, options.base - 1):
            for k in range(j + 1, options.base):
                if tried[2] >= options.triangles or tried[1] >= options.checks:
                    return no_match()
                tried[2] += 1
                match = _triangle(rays, index, np.array([i, j, k]), options, tried)
                # 6. Accept.
                if len(match.observed) and match.log10_chance <= options.accept:
                    return match
    return no_match()


@jit
def _triangle(
    rays: Floats, index: PairIndex, corners: NDArray, options: ShefexOptions, tried: NDArray
) -> DirectMatch:
    """Steps 2 to 5: test every catalog triangle that fits an observed one.

    Parameters
    ----------
    corners
        (3,) rows of the observed stars
    """
    i, j, k = corners
    ij, ik, jk = triangle_sides_rad(rays, corners)
    # Short sides carry little information, and the index holds no longer pairs.
    if (
        min(ij, ik, jk) < MIN_SIDE_TOLERANCES * options.tolerance_rad
        or max(ij, ik, jk) > index.max_angle_rad
    ):
        return no_match()
    handedness = triple(rays[i], rays[j], rays[k])
    low, high = angle_interval(ij, options.cos_error)
    low_ik, high_ik = angle_interval(ik, options.cos_error)
    low_jk, high_jk = angle_interval(jk, options.cos_error)
    # The gates of the other stars are the same for all catalog triangles.
    gates = _angle_gates(rays, corners, options)
    # 2. Catalog pairs (a, b) for side ij, in both orders; then neighbors c of a for side ik; then side jk is tested.
    begin, end = pair_range(index, low, high)
    for p in range(begin, end):
        if tried[1] >= options.checks:
            break
        if not low <= index.angle_rad[p] <= high:
            continue
        for flip in range(2):
            a = index.pair[p, flip]
            b = index.pair[p, 1 - flip]
            first, last = neighbor_range(index, a, low_ik, high_ik)
            for c in index.neighbor[first:last]:
                tried[1] += 1
                if not low_jk <= angle(index.vectors[b], index.vectors[c]) <= high_jk:
                    continue
                # 3. The mirror image has the same sides.
                if (
                    handedness * triple(index.vectors[a], index.vectors[b], index.vectors[c])
                    <= 0
                ):
                    continue
                tried[0] += 1
                # 4. and 5. The other stars.
                match = _match_others(
                    rays, index, corners, np.array([a, b, c], np.int64), gates, options, tried
                )
                if len(match.observed) and match.log10_chance <= options.accept:
                    return match
    return no_match()


@inlined
def _angle_gates(rays: Floats, corners: NDArray, options: ShefexOptions) -> Floats:
    """Gates of each observed star's three angles to the base.

    Returns
    -------
    Floats
        (N, 10): three lower ends and three upper ends, rad, three cosines, and the area inside the gates, sr. The
        area is 0 for base stars and for stars too close to one; these are not identified
    """
    gates = np.zeros((len(rays), 10))
    side = np.empty(3)
    for n in range(len(rays)):
        # Each angle's interval and cosine.
        for m in range(3):
            side[m] = angle(rays[corners[m]], rays[n])
            gates[n, m], gates[n, 3 + m] = angle_interval(side[m], options.cos_error)
            gates[n, 6 + m] = np.cos(side[m])
        # A star too close to the base keeps the area 0.
        if side.min() >= MIN_SIDE_TOLERANCES * options.tolerance_rad:
            gates[n, 9] = _gate_area(rays, corners, n, side, gates[n, 3:6] - gates[n, :3])
    return gates


@inlined
def _match_others(
    rays: Floats,
    index: PairIndex,
    corners: NDArray,
    stars: NDArray,
    gates: Floats,
    options: ShefexOptions,
    tried: NDArray,
) -> DirectMatch:
    """Steps 4 and 5: identify the other stars by their angles to the base, then keep those near their predicted places.

    Step 5 rejects mirror images, which a slim base, or stars in line with it, cannot distinguish by angles.

    Parameters
    ----------
    corners, stars
        (3,) rows of the observed and of the catalog base
    gates
        (N, 10) see `_angle_gates`
    """
    observed = np.empty(len(rays), np.int64)
    star = np.empty(len(rays), np.int64)
    observed[:3] = corners
    star[:3] = stars
    count = 3
    # 4. Identify by angles; each catalog star is used once.
    for n in range(len(rays)):
        s = (
            _partner(rays, index, corners, stars, n, gates[n], tried)
            if gates[n, 9] > 0
            else -1
        )
        if s >= 0 and not (star[:count] == s).any():
            observed[count] = n
            star[count] = s
            count += 1
    if count < MIN_MATCHES:
        return no_match()
    # 5. Keep what is near its predicted place.
    observed = observed[:count]
    star = star[:count]
    R_cam_from_ref = fit_rotation(rays[observed], index.vectors[star])
    is_near = np.empty(count, np.bool_)
    for n in range(count):
        predicted = R_cam_from_ref @ index.vectors[star[n]]
        is_near[n] = angle(predicted, rays[observed[n]]) <= 2 * options.tolerance_rad
    observed = observed[is_near]
    star = star[is_near]
    count = is_near.sum()
    if count < MIN_MATCHES:
        return no_match()
    # Probability that a random direction falls into the gates of an observed star, from the local catalog density.
    cap_sr = 2 * np.pi * (1 - np.cos(index.max_angle_rad))
    density = (index.first[stars[0] + 1] - index.first[stars[0]] + 1) / cap_sr
    p = 1 - np.exp(-density * gates[:, 9].sum() / (len(rays) - 3))
    chance = log10_tail(len(rays) - 3, count - 3, p) + np.log10(tried[0])
    return DirectMatch(
        observed, star, fit_rotation(rays[observed], index.vectors[star]), chance
    )


@inlined
def _partner(
    rays: Floats,
    index: PairIndex,
    corners: NDArray,
    stars: NDArray,
    n: int,
    gate: Floats,
    tried: NDArray,
) -> int:
    """The catalog star whose three angles to the base fit those of observed star n, or -1.

    If several fit, the one with the least sum of cosine differences. With a slim base three angles do not distinguish a
    place from its mirror image, so that the side of the base line is tested too.

    Parameters
    ----------
    gate
        (10,) gates of the star, see `_angle_gates`
    """
    best = -1
    least = np.inf
    begin, end = neighbor_range(index, stars[0], gate[0], gate[3])
    tried[1] += 3
    for place in range(begin, end):
        d = index.neighbor[place]
        # The angle to the first star of the base.
        difference = abs(np.cos(index.separation_rad[place]) - gate[6])
        tried[1] += 1
        # The angles to the second and third star of the base.
        fits = d != stars[1] and d != stars[2]
        for m in range(1, 3):
            if not fits:
                break
            side = angle(index.vectors[stars[m]], index.vectors[d])
            fits = gate[m] <= side <= gate[3 + m]
            difference += abs(np.cos(side) - gate[6 + m])
        if fits and difference < least and _same_side(rays, index, corners, stars, n, d):
            best = d
            least = difference
    return best


@inlined
def _same_side(
    rays: Floats, index: PairIndex, corners: NDArray, stars: NDArray, n: int, d: int
) -> bool:
    """Whether observed star n and catalog star d are on the same side of the base line farthest from the star.

    The side is the sign of the triple product of the line's two stars and the star.
    """
    best = 0.0
    product = 1.0
    for m in range(3):
        b = (m + 1) % 3
        volume = triple(rays[corners[m]], rays[corners[b]], rays[n])
        # The line farthest from the star decides: noise cannot move the star across it.
        if abs(volume) > best:
            best = abs(volume)
            product = volume * triple(
                index.vectors[stars[m]], index.vectors[stars[b]], index.vectors[d]
            )
    return product > 0


@inlined
def _gate_area(rays: Floats, corners: NDArray, n: int, side: Floats, width: Floats) -> float:
    """Area in which a star can be identified by its angles, sr.

    Two rings about base stars, as wide as their gates, cross at the star in a rhombus of the area w_a w_b /
    sin(angle). The angle is that between the two base stars as seen from the star; its sine is the triple product
    of the three directions over the sines of the two sides. The least of the three rhombi counts.

    Parameters
    ----------
    n
        Row of the observed star
    side
        (3,) its angles to the base stars, rad
    width
        (3,) widths of their gates, rad
    """
    least = np.inf
    for m in range(3):
        b = (m + 1) % 3
        volume = abs(triple(rays[corners[m]], rays[corners[b]], rays[n]))
        # Sine of the angle at which the rings cross.
        sine = max(volume / (np.sin(side[m]) * np.sin(side[b])), 1e-9)
        least = min(least, width[m] * width[b] / sine)
    return least
