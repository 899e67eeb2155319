"""Pyramid star identification (Mortari, Samaan & Junkins 2001), verified by the direct match of the whole field.

1. Take a triangle of observed stars, in an order that changes all three stars soon (`_search`).
2. Find the catalog triangles with the same sides, by the k-vector and the neighbor lists (`_triangle`).
3. Reject those of the other handedness. With an uncertain focal length, each triangle also estimates it, from the ratio
   of the catalog's to the observed perimeter; the three sides must agree on it.
4. Find a fourth star whose angles to all three corners fit: a pyramid (`_pyramid`).
5. Test the attitude on all stars by the direct match, with a penalty for missing stars (`_match_with_penalty`).
6. Accept the first match with fewer than 1e-5 chance matches expected over all hypotheses tried.
"""

from math import sqrt
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from estimator.catalog.pair_index import PairIndex, neighbor_range, pair_range
from estimator.core.checks import Floats
from estimator.core.jit import inlined, jit
from estimator.core.types import StarMatch
from estimator.identification.chance import ACCEPT_LOG10_CHANCE, MIN_MATCHES
from estimator.identification.direct_match import (
    DirectMatch,
    angle,
    match_field,
    no_match,
    smart_triangles,
    to_star_match,
    triangle_sides_rad,
    triple,
)
from estimator.identification.solver_options import Options


class PyramidOptions(NamedTuple):
    """Search parameters. A named tuple, because numba can compile functions that take one.

    Attributes
    ----------
    tolerance
        Tolerance of a direction, rad
    stretch, focal_unknown, triangles, checks, base, missed_dex
        See `Options`
    left, right, top, bottom
        Tangents of the sensor's edges from the boresight
    """

    tolerance: float
    stretch: float
    focal_unknown: bool
    triangles: int
    checks: int
    base: int
    missed_dex: float
    left: float
    right: float
    top: float
    bottom: float


def pyramid(
    vectors_cam: Floats, index: PairIndex, tolerance_rad: float, **options: Any
) -> StarMatch | None:
    """Identify stars by pyramids (Mortari, Samaan & Junkins 2001): a triangle, a fourth star, then the whole field.

    The three catalog stars are from different groups of the index (patch boards). Observed triangles are tried in the
    paper's `smart` order, so that one false star costs little.

    Parameters
    ----------
    vectors_cam
        (N, 3) observed unit vectors, brightest first
    index
        Catalog of the stars and pairs
    tolerance_rad
        Tolerance of a direction; that of an angle is sqrt(2) times it, plus `stretch` times the angle
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
    settings.require_tolerance("pyramid", tolerance_rad)
    if len(vectors_cam) < MIN_MATCHES:
        return None
    parameters = PyramidOptions(
        tolerance_rad,
        settings.stretch,
        settings.focal_unknown,
        settings.max_triangles,
        settings.max_checks,
        min(settings.base_stars, len(vectors_cam)),
        settings.missed_dex,
        *settings.field_tan,
    )
    return to_star_match(_search(np.ascontiguousarray(vectors_cam), index, parameters))


@jit
def _search(rays: Floats, index: PairIndex, options: PyramidOptions) -> DirectMatch:
    """Steps 1 to 6: try triangles in the smart order; return the first significant match."""
    tried = np.zeros(3, np.int64)  # observed triangles, hypotheses, checks
    # 1. Triangles that change all three stars soon.
    for corners in smart_triangles(options.base):
        match = _triangle(rays, index, corners, options, tried)
        if match.log10_chance < ACCEPT_LOG10_CHANCE:
            return match
        tried[0] += 1
        if tried[0] >= options.triangles or tried[2] >= options.checks:
            return no_match()
    return no_match()


@jit
def _triangle(
    rays: Floats, index: PairIndex, corners: NDArray, options: PyramidOptions, tried: NDArray
) -> DirectMatch:
    """Steps 2 to 5: test every catalog triangle that fits an observed one in its sides and its handedness.

    Parameters
    ----------
    corners
        (3,) rows of the observed stars
    tried
        (3,) observed triangles, hypotheses and checks so far, increased in place

    Returns
    -------
    DirectMatch
        The first significant one, or else the empty one
    """
    i, j, k = corners
    ij, ik, jk = triangle_sides_rad(rays, corners)
    t_ij, t_ik, t_jk = sqrt(2.0) * options.tolerance + options.stretch * np.array(
        [ij, ik, jk]
    )
    # Short sides carry little information, and the index holds no longer pairs.
    if min(ij, ik, jk) < 4 * t_ij or max(ij, ik, jk) > index.max_angle_rad:
        return no_match()
    # If the three sides agree on one focal length, only the lens distortion remains of the stretch.
    residual_stretch = options.stretch / 3 if options.focal_unknown else options.stretch
    handedness = triple(rays[i], rays[j], rays[k])
    # 2. Catalog pairs (a, b) for side ij, in both orders; then neighbors c of a for side ik; then side jk is tested.
    begin, end = pair_range(index, ij - t_ij, ij + t_ij)
    for p in range(begin, end):
        if tried[2] >= options.checks:
            break
        side = index.angle_rad[p]
        if abs(side - ij) > t_ij:
            continue
        for flip in range(2):
            a = index.pair[p, flip]
            b = index.pair[p, 1 - flip]
            first, last = neighbor_range(index, a, ik - t_ik, ik + t_ik)
            for place in range(first, last):
                c = index.neighbor[place]
                side_ac = index.separation_rad[place]
                tried[2] += 1
                if index.group[c] == index.group[a] or index.group[c] == index.group[b]:
                    continue
                side_bc = angle(index.vectors[b], index.vectors[c])
                if abs(side_bc - jk) > t_jk:
                    continue
                # 3. The mirror image has the same sides.
                if (
                    handedness * triple(index.vectors[a], index.vectors[b], index.vectors[c])
                    <= 0
                ):
                    continue
                # One factor for all three sides: the assumed over the true focal length.
                tangent_scale = (
                    (side + side_ac + side_bc) / (ij + ik + jk)
                    if options.focal_unknown
                    else 1.0
                )
                misfit = max(
                    abs(side - tangent_scale * ij) - residual_stretch * ij,
                    abs(side_ac - tangent_scale * ik) - residual_stretch * ik,
                    abs(side_bc - tangent_scale * jk) - residual_stretch * jk,
                )
                if misfit > sqrt(2.0) * options.tolerance:
                    continue
                # 4. and 5. Find a fourth star, and test the whole field.
                tried[1] += 1
                scaled = (
                    _scale_tangents(rays, tangent_scale) if options.focal_unknown else rays
                )
                match = _pyramid(
                    scaled,
                    index,
                    corners,
                    np.array([a, b, c]),
                    options,
                    residual_stretch,
                    tried,
                )
                if match.log10_chance < ACCEPT_LOG10_CHANCE:
                    return match
    return no_match()


@inlined
def _pyramid(
    rays: Floats,
    index: PairIndex,
    corners: NDArray,
    stars: NDArray,
    options: PyramidOptions,
    stretch: float,
    tried: NDArray,
) -> DirectMatch:
    """Steps 4 and 5: find a fourth star that fits a triangle; if there is one, return the direct match.

    Parameters
    ----------
    corners, stars
        (3,) rows of the observed and of the catalog triangle
    stretch
        Relative tolerance of an angle that remains
    """
    for r in range(options.base):
        tried[2] += 1
        # The fourth star is none of the corners.
        if r == corners[0] or r == corners[1] or r == corners[2]:
            continue
        # Catalog stars d at the angle of r from the first corner.
        reach = angle(rays[corners[0]], rays[r])
        tolerance = sqrt(2.0) * options.tolerance + stretch * reach
        begin, end = neighbor_range(index, stars[0], reach - tolerance, reach + tolerance)
        for d in index.neighbor[begin:end]:
            # The angles to the two other corners.
            fits = True
            for corner in range(1, 3):
                side = angle(rays[corners[corner]], rays[r])
                misfit = abs(angle(index.vectors[stars[corner]], index.vectors[d]) - side)
                fits = fits and misfit <= sqrt(2.0) * options.tolerance + stretch * side
            if fits:
                tried[2] += len(rays) * (index.first[stars[0] + 1] - index.first[stars[0]])
                return _match_with_penalty(
                    rays, index, corners, stars, options, stretch, tried[1]
                )
    return no_match()


@inlined
def _scale_tangents(rays: Floats, factor: float) -> Floats:
    """The (N, 3) unit vectors with their tangents multiplied by a factor, as if the focal length were shorter by it."""
    out = np.empty_like(rays)
    for n in range(len(rays)):
        # Scale the tangents, then normalize.
        z = rays[n, 2]
        x = rays[n, 0] / z * factor
        y = rays[n, 1] / z * factor
        length = sqrt(x * x + y * y + 1)
        out[n] = x / length, y / length, 1 / length
    return out


@inlined
def _match_with_penalty(
    rays: Floats,
    index: PairIndex,
    corners: NDArray,
    stars: NDArray,
    options: PyramidOptions,
    stretch: float,
    hypotheses: int,
) -> DirectMatch:
    """Step 5: the direct match of the whole field, with a penalty of missed_dex for each missing catalog star."""
    match = match_field(rays, index, corners, stars, options.tolerance, stretch, hypotheses)
    if len(match.observed) == 0 or options.missed_dex <= 0:
        return match
    # Catalog stars that the attitude puts into the field and that are not matched.
    missing = max(
        _count_in_field(index, stars[0], match.R_cam_from_ref, options) - len(match.observed),
        0,
    )
    chance = match.log10_chance + options.missed_dex * missing
    return DirectMatch(match.observed, match.star, match.R_cam_from_ref, chance)


@inlined
def _count_in_field(
    index: PairIndex, center: int, R_cam_from_ref: Floats, options: PyramidOptions
) -> int:
    """Number of catalog stars in the field at an attitude.

    Parameters
    ----------
    center
        Row of a star in the field; itself and its neighbors are tested
    """
    count = 0
    begin = index.first[center]
    end = index.first[center + 1]
    for place in range(begin - 1, end):
        # The star itself, then its neighbors.
        s = center if place < begin else index.neighbor[place]
        x, y, z = R_cam_from_ref @ index.vectors[s]
        inside = (
            options.left * z < x < options.right * z
            and options.top * z < y < options.bottom * z
        )
        count += z > 0 and inside
    return count
