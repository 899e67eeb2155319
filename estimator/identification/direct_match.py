"""Direct match: test the attitude of a few identified stars on the whole field, against chance.

Common to the published identifiers, which find a few stars each in their own way:

1. Solve the attitude of these stars by least squares (Wahba's problem, `fit_rotation`).
2. Match each observed star to the nearest catalog star at that attitude (`match_nearest`).
3. Solve the attitude of all matches and match again.
4. Compute the probability of such a match by chance (`log10_chance`), times the number of hypotheses tried.
"""

from math import pi
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from estimator.attitude.solvers import rotation
from estimator.attitude.wahba import wahba
from estimator.catalog.pair_index import PairIndex
from estimator.catalog.sky_index import nearest
from estimator.core import vectors
from estimator.core.checks import Floats
from estimator.core.jit import jit
from estimator.core.types import StarMatch
from estimator.identification.chance import ACCEPT_LOG10_CHANCE, MIN_MATCHES, log10_tail


class DirectMatch(NamedTuple):
    """A match of the whole field. A named tuple, because numba can compile functions that return one.

    Attributes
    ----------
    observed, star
        (K,) rows of the matched observed stars and of their catalog stars
    R_cam_from_ref
        (3, 3) rotation from the catalog's frame to camera axes
    log10_chance
        log10 of the expected number of equally good chance matches
    """

    observed: NDArray[np.int64]
    star: NDArray[np.int64]
    R_cam_from_ref: Floats
    log10_chance: float


def to_star_match(match: DirectMatch, by_paper: bool = False) -> StarMatch | None:
    """The match as a StarMatch, or None if it is not significant (ACCEPT_LOG10_CHANCE, MIN_MATCHES).

    A match accepted by its paper's rule is not tested: its log10_chance is NaN.
    """
    chance = float("nan") if by_paper else match.log10_chance
    if len(match.observed) < MIN_MATCHES or chance > ACCEPT_LOG10_CHANCE:
        return None
    return StarMatch(match.observed, match.star, rotation(match.R_cam_from_ref), chance)


def mutual_nearest(
    observed_px: Floats, predicted_px: Floats, radius_px: float, rows: NDArray
) -> tuple[NDArray, NDArray]:
    """Return mutual nearest neighbors within a radius: indices of observed_px, and `rows` of the predictions."""
    if not len(predicted_px) or not len(observed_px):
        return np.empty(0, int), np.empty(0, int)
    distance, nearest = cKDTree(predicted_px).query(
        observed_px, distance_upper_bound=radius_px
    )
    _, back = cKDTree(observed_px).query(predicted_px)
    match = np.flatnonzero(np.isfinite(distance))
    match = match[back[nearest[match]] == match]
    return match, rows[nearest[match]]


@jit
def match_field(
    rays: Floats,
    index: PairIndex,
    corners: NDArray,
    stars: NDArray,
    tolerance: float,
    stretch: float,
    hypotheses: int,
) -> DirectMatch:
    """The direct match of all observed stars at the attitude of a few: the module's steps.

    Parameters
    ----------
    rays
        (N, 3) unit vectors of the observed stars, in camera axes
    corners, stars
        Rows of the observed and of the catalog stars of the hypothesis, two or more
    tolerance
        Tolerance of a direction, rad
    stretch
        Relative tolerance of the angle from the boresight, added to the tolerance
    hypotheses
        Number of hypotheses so far, which multiplies the probability

    Returns
    -------
    DirectMatch
        Empty with fewer than MIN_MATCHES matches
    """
    # 1. and 2. The attitude of a few stars, and its matches.
    R_cam_from_ref = fit_rotation(rays[corners], index.vectors[stars])
    # The attitude of a few stars is less accurate than a star's direction: the first match has twice the tolerance.
    observed, star, _ = match_nearest(
        rays, index, stars[0], R_cam_from_ref, 2 * tolerance, stretch
    )
    if len(observed) < MIN_MATCHES:
        return no_match()
    # 3. The attitude of all of them, and its matches.
    R_cam_from_ref = fit_rotation(rays[observed], index.vectors[star])
    observed, star, expected = match_nearest(
        rays, index, stars[0], R_cam_from_ref, tolerance, stretch
    )
    if len(observed) < MIN_MATCHES:
        return no_match()
    # 4. The probability by chance.
    chance = log10_chance(index.group[star], len(rays), expected) + np.log10(hypotheses)
    return DirectMatch(
        observed, star, fit_rotation(rays[observed], index.vectors[star]), chance
    )


@jit
def no_match() -> DirectMatch:
    """The empty match, with the probability 1 by chance."""
    return DirectMatch(np.empty(0, np.int64), np.empty(0, np.int64), np.eye(3), 0.0)


@jit
def angle(u: Floats, v: Floats) -> float:
    """Angle between unit vectors, rad: 2 arcsin(|u - v| / 2), which is accurate for small angles."""
    return 2 * np.arcsin(min(vectors.chord(u, v) / 2, 1.0))


@jit
def triangle_sides_rad(rays: Floats, corners: NDArray) -> tuple[float, float, float]:
    """Sides of the triangle of three rows i, j, k: the angles ij, ik and jk."""
    i, j, k = corners
    return angle(rays[i], rays[j]), angle(rays[i], rays[k]), angle(rays[j], rays[k])


@jit
def smart_triangles(base: int) -> NDArray[np.int64]:
    """(T, 3) triangles of the first `base` stars in the smart order of Mortari, Samaan & Junkins 2001.

    They are (i, i + dj, i + dj + dk) with i running fastest: successive triangles share few stars, so that one false
    star costs little.
    """
    out = np.empty((max(base * (base - 1) * (base - 2) // 6, 0), 3), np.int64)
    count = 0
    for dj in range(1, base - 1):
        for dk in range(1, base - dj):
            for i in range(base - dj - dk):
                out[count] = i, i + dj, i + dj + dk
                count += 1
    return out


@jit
def triple(u: Floats, v: Floats, w: Floats) -> float:
    """Triple product u . (v x w); its sign is the handedness of a triangle of directions."""
    return vectors.dot(u, vectors.cross(v, w))


@jit
def fit_rotation(cam: Floats, ref: Floats) -> Floats:
    """R_cam_from_ref of (K, 3) unit vectors in both frames: Wahba's problem with equal weights."""
    return wahba(cam, ref, np.ones(len(cam)))[0]


@jit
def match_nearest(
    rays: Floats,
    index: PairIndex,
    center: int,
    R_cam_from_ref: Floats,
    tolerance: float,
    stretch: float,
) -> tuple[NDArray, NDArray, float]:
    """Match each observed star to the nearest catalog star within its tolerance; each catalog star is used once.

    A random direction has a catalog star within its tolerance r with the probability p = 1 - exp(-density pi r^2).
    The mean of pi r^2 over the observed stars is used, and the density of the catalog around star `center`.

    Parameters
    ----------
    center
        Row of a catalog star in the field; the number of its neighbors gives the local density of the catalog

    Returns
    -------
    observed, star
        (K,) rows of the observed and of the catalog stars
    p
        Probability of a chance match
    """
    observed = np.empty(len(rays), np.int64)
    star = np.empty(len(rays), np.int64)
    # Stars per steradian in the cap of the neighbors.
    cap_sr = 2 * pi * (1 - np.cos(index.max_angle_rad))
    density = (index.first[center + 1] - index.first[center] + 1) / cap_sr
    R_ref_from_cam = R_cam_from_ref.T.copy()
    count = 0
    covered_sr = 0.0
    for n in range(len(rays)):
        ray = vectors.row(rays, n)
        x, y, z = vectors.rotate(R_ref_from_cam, ray)
        # The uncertain focal length or distortion adds an error that grows with the angle from the boresight.
        radius = tolerance + (
            stretch * np.arccos(min(max(ray[2], -1.0), 1.0)) if stretch > 0 else 0.0
        )
        covered_sr += density * pi * radius**2
        chord = 2 * np.sin(min(radius, pi) / 2)
        side, cell_first, cell_row = index.cells
        best, _ = nearest(index.vectors, cell_first, cell_row, side, x, y, z, chord)
        # A catalog star that is used already cannot match again.
        if best >= 0 and not (star[:count] == best).any():
            observed[count] = n
            star[count] = best
            count += 1
    return observed[:count], star[:count], 1 - np.exp(-covered_sr / len(rays))


@jit
def log10_chance(groups: NDArray, count: int, p: float) -> float:
    """log10 of the probability that a false attitude gives this match; three independent matches define the attitude.

    The first match of each group (patch board) has the probability p. All boards have the same pattern, so that further
    matches of a group are not independent: the second counts 1/10 (it fixes the orientation of the lattice), each
    further one 1/2 (lit or not). If every star is its own group, this is the binomial tail of the other matches.

    Parameters
    ----------
    groups
        (K,) groups of the matched stars
    count
        Number of observed stars
    p
        Probability of one chance match
    """
    independent = 0
    second = 0
    further = 0
    for n in range(len(groups)):
        # Number of earlier matches of the same group.
        earlier = np.sum(groups[:n] == groups[n])
        independent += earlier == 0
        second += earlier == 1
        further += earlier > 1
    # Three independent matches define the attitude: the others are trials.
    tail = log10_tail(max(count - 3 - second - further, 0), independent - 3, p)
    # log10 2 = 0.3.
    return tail - second - 0.3 * further
