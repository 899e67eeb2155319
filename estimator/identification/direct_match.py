"""Direct match: the attitude of a few identified stars is applied to the whole field, and tested against chance.

Common to the published identifiers: angles between directions, the least-squares attitude of a hypothesis (Wahba's
problem), nearest-neighbor matching of all observed stars at that attitude, and the probability of such a match by
chance.
"""

from __future__ import annotations

from math import pi, sqrt

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from estimator.attitude.wahba import wahba
from estimator.catalog.pair_index import PairIndex
from estimator.catalog.spatial_grid import nearest
from estimator.core.arrays import Floats
from estimator.core.jit import jit
from estimator.core.types import StarMatch
from estimator.identification.chance import ACCEPT_LOG10_CHANCE, MIN_MATCHES, log10_tail

# Rows of the observed stars, rows of the catalog, R_cam_from_ref, log10 of the expected number of chance matches.
Found = tuple[NDArray[np.int64], NDArray[np.int64], Floats, float]


def answer(found: Found) -> StarMatch | None:
    """The match as a StarMatch, or None if it is not significant (ACCEPT_LOG10_CHANCE, MIN_MATCHES)."""
    observed, star, matrix, chance = found
    if len(observed) < MIN_MATCHES or chance > ACCEPT_LOG10_CHANCE:
        return None
    return StarMatch(observed, star, Rotation.from_matrix(matrix), chance)


@jit
def settled(
    seen: Floats,
    index: PairIndex,
    corners: NDArray,
    stars: NDArray,
    tolerance: float,
    stretch: float,
    tried: int,
) -> Found:
    """The direct match: match all observed stars at the attitude of a few, refine it once, and test against chance.

    corners, stars : rows of the observed and of the catalog stars of the hypothesis, two or more
    tried          : number of hypotheses so far, which multiplies the probability
    """
    matrix = turned(seen[corners], index.vectors[stars])
    # The attitude of a few stars is less accurate than a star's direction: the first match has twice the tolerance.
    observed, star, _ = match(seen, index, stars[0], matrix, 2 * tolerance, stretch)
    if len(observed) < MIN_MATCHES:
        return nothing()
    matrix = turned(seen[observed], index.vectors[star])
    observed, star, expected = match(seen, index, stars[0], matrix, tolerance, stretch)
    if len(observed) < MIN_MATCHES:
        return nothing()
    chance = log10_chance(index.group[star], len(seen), expected) + np.log10(tried)
    return observed, star, turned(seen[observed], index.vectors[star]), chance


@jit
def nothing() -> Found:
    """The empty match, with probability 1 by chance."""
    return np.empty(0, np.int64), np.empty(0, np.int64), np.eye(3), 0.0


@jit
def angle(u: Floats, v: Floats) -> float:
    """Angle between unit vectors, from half the chord: accurate for small angles."""
    half = sqrt((u[0] - v[0]) ** 2 + (u[1] - v[1]) ** 2 + (u[2] - v[2]) ** 2) / 2
    return 2 * np.arcsin(min(half, 1.0))


@jit
def triple(u: Floats, v: Floats, w: Floats) -> float:
    """Triple product u . (v x w); its sign is the handedness of a triangle of directions."""
    return (
        u[0] * (v[1] * w[2] - v[2] * w[1])
        + u[1] * (v[2] * w[0] - v[0] * w[2])
        + u[2] * (v[0] * w[1] - v[1] * w[0])
    )


@jit
def turned(cam: Floats, ref: Floats) -> Floats:
    """R_cam_from_ref by Wahba's problem with equal weights."""
    return wahba(cam, ref, np.ones(len(cam)))[0]


@jit
def match(
    seen: Floats, index: PairIndex, centre: int, matrix: Floats, tolerance: float, stretch: float
) -> tuple[NDArray, NDArray, float]:
    """Match each observed star to the nearest catalog star within its tolerance; each catalog star is used once.

    centre : row of a catalog star in the field; its neighbors give the local density of the catalog
    Returns the rows of the observed stars, the rows of the catalog, and the probability that a random direction has a
    catalog star within the mean tolerance.
    """
    observed, star = np.empty(len(seen), np.int64), np.empty(len(seen), np.int64)
    cap_sr = 2 * pi * (1 - np.cos(index.max_angle_rad))
    density = (index.first[centre + 1] - index.first[centre] + 1) / cap_sr
    count, covered = 0, 0.0
    for n in range(len(seen)):
        u, v, w = seen[n]
        x = matrix[0, 0] * u + matrix[1, 0] * v + matrix[2, 0] * w
        y = matrix[0, 1] * u + matrix[1, 1] * v + matrix[2, 1] * w
        z = matrix[0, 2] * u + matrix[1, 2] * v + matrix[2, 2] * w
        radius = tolerance + (stretch * np.arccos(min(max(w, -1.0), 1.0)) if stretch > 0 else 0.0)
        covered += density * pi * radius**2
        best = nearest(index.cells, index.vectors, x, y, z, 2 * np.sin(min(radius, pi) / 2))
        taken = False
        for m in range(count):
            taken = taken or star[m] == best
        if best >= 0 and not taken:
            observed[count], star[count] = n, best
            count += 1
    return observed[:count], star[:count], 1 - np.exp(-covered / len(seen))


@jit
def log10_chance(groups: NDArray, seen: int, p: float) -> float:
    """log10 of the probability that a false attitude gives this match; three independent matches define the attitude.

    The first match of each group (patch board) has probability p. All boards have the same pattern, so that further
    matches of a group are not independent: the second counts 1/10 (it fixes the orientation of the lattice), each
    further one 1/2 (lit or not). If every star is its own group, this is the binomial tail.
    """
    independent, second, further = 0, 0, 0
    for n in range(len(groups)):
        before = 0
        for m in range(n):
            before += groups[m] == groups[n]
        independent += before == 0
        second += before == 1
        further += before > 1
    tail = log10_tail(max(seen - 3 - second - further, 0), independent - 3, p)
    return tail - second - 0.3 * further
