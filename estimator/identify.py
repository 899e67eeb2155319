"""Which star is which, lost in space: pyramids of angles, proved by every star in the field."""

from __future__ import annotations

from collections.abc import Callable
from math import lgamma, log, pi, sqrt

import numba
import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from estimator.index import PairIndex, around, between
from estimator.types import Floats, StarMatch

Identifier = Callable[..., StarMatch | None]

ACCEPT_LOG10_CHANCE = -5.0
MIN_MATCHES = 4


def pyramid(
    vectors_cam: Floats,
    index: PairIndex,
    tolerance_rad: float,
    stretch: float = 0.0,
    zooms: bool = False,
    max_triangles: int = 3000,
    base_stars: int = 20,
) -> StarMatch | None:
    """Pyramid (Mortari, Samaan & Junkins 2001): a triangle, a fourth star, then the whole field.

    vectors_cam   : (N, 3) observed unit vectors, brightest first
    tolerance_rad : of a direction; of an angle sqrt(2) times it, plus `stretch` times the angle
    zooms         : whether the stretch is one unknown focal length, which each triangle then measures by itself
    base_stars    : among how many of the brightest the pyramids are sought
    Triangles are taken in an order that changes all three stars soon (their `smart` order), so that one false
    star costs little. A pyramid is only a hypothesis: the attitude that it gives must explain so many of the
    observed stars that, over all that was tried, a match this good is expected less than 1e-5 times by chance.
    Returns None rather than a guess.
    """
    if len(vectors_cam) < MIN_MATCHES:
        return None
    observed, star, matrix, chance = _search(
        np.ascontiguousarray(vectors_cam),
        index,
        tolerance_rad,
        stretch,
        zooms,
        max_triangles,
        min(base_stars, len(vectors_cam)),
    )
    if len(observed) < MIN_MATCHES or chance > ACCEPT_LOG10_CHANCE:
        return None
    return StarMatch(observed, star, Rotation.from_matrix(matrix), chance)


IDENTIFIERS: dict[str, Identifier] = {"pyramid": pyramid}


@numba.njit(cache=True)
def _search(
    seen: Floats,
    index: PairIndex,
    tolerance: float,
    stretch: float,
    zooms: bool,
    max_triangles: int,
    base: int,
) -> tuple[NDArray, NDArray, Floats, float]:
    """Walk the triangles (i, i + dj, i + dj + dk) and stop at the first attitude beyond chance."""
    tried = np.zeros(2, np.int64)
    for dj in range(1, base - 1):
        for dk in range(1, base - dj):
            for i in range(base - dj - dk):
                corners = np.array([i, i + dj, i + dj + dk])
                found = _triangle(seen, index, corners, tolerance, stretch, zooms, base, tried)
                if found[3] < ACCEPT_LOG10_CHANCE:
                    return found
                tried[0] += 1
                if tried[0] >= max_triangles:
                    return _nothing()
    return _nothing()


@numba.njit(cache=True)
def _nothing() -> tuple[NDArray, NDArray, Floats, float]:
    return np.empty(0, np.int64), np.empty(0, np.int64), np.eye(3), 0.0


@numba.njit(cache=True)
def _angle(u: Floats, v: Floats) -> float:
    """Angle between unit vectors by the half-chord, exact when small."""
    half = sqrt((u[0] - v[0]) ** 2 + (u[1] - v[1]) ** 2 + (u[2] - v[2]) ** 2) / 2
    return 2 * np.arcsin(min(half, 1.0))


@numba.njit(cache=True)
def _triple(u: Floats, v: Floats, w: Floats) -> float:
    return (
        u[0] * (v[1] * w[2] - v[2] * w[1])
        + u[1] * (v[2] * w[0] - v[0] * w[2])
        + u[2] * (v[0] * w[1] - v[1] * w[0])
    )


@numba.njit(cache=True)
def _triangle(
    seen: Floats,
    index: PairIndex,
    corners: NDArray,
    tolerance: float,
    stretch: float,
    zooms: bool,
    base: int,
    tried: NDArray,
) -> tuple[NDArray, NDArray, Floats, float]:
    """Every catalogue triangle like an observed one, of the same handedness, that a fourth star confirms."""
    i, j, k = corners
    ij, ik, jk = _angle(seen[i], seen[j]), _angle(seen[i], seen[k]), _angle(seen[j], seen[k])
    t_ij, t_ik, t_jk = sqrt(2.0) * tolerance + stretch * np.array([ij, ik, jk])
    shortest, longest = min(ij, ik, jk), max(ij, ik, jk)
    if shortest < 4 * t_ij or longest > index.max_angle_rad:
        return _nothing()
    # Three sides that agree on one focal length leave only what the lens distorts.
    tight = stretch / 3 if zooms else stretch
    handed = _triple(seen[i], seen[j], seen[k])
    begin, end = between(index, ij - t_ij, ij + t_ij)
    for p in range(begin, end):
        if abs(index.angle_rad[p] - ij) > t_ij:
            continue
        for flip in range(2):
            a, b = index.pair[p, flip], index.pair[p, 1 - flip]
            place = around(index, a, ik - t_ik)
            while place < index.first[a + 1] and index.separation_rad[place] <= ik + t_ik:
                c = index.neighbour[place]
                place += 1
                far = _angle(index.vectors[b], index.vectors[c])
                if abs(far - jk) > t_jk:
                    continue
                if handed * _triple(index.vectors[a], index.vectors[b], index.vectors[c]) <= 0:
                    continue
                near = index.separation_rad[place - 1]
                zoom = (index.angle_rad[p] + near + far) / (ij + ik + jk) if zooms else 1.0
                slip = max(
                    abs(index.angle_rad[p] - zoom * ij) - tight * ij,
                    abs(near - zoom * ik) - tight * ik,
                    abs(far - zoom * jk) - tight * jk,
                )
                if slip > sqrt(2.0) * tolerance:
                    continue
                tried[1] += 1
                stars = np.array([a, b, c])
                zoomed = _zoomed(seen, zoom) if zooms else seen
                if not _fourth(zoomed, index, corners, stars, tolerance, tight, base):
                    continue
                found = _prove(zoomed, index, corners, stars, tolerance, tight, tried[1])
                if found[3] < ACCEPT_LOG10_CHANCE:
                    return found
    return _nothing()


@numba.njit(cache=True)
def _fourth(
    seen: Floats,
    index: PairIndex,
    corners: NDArray,
    stars: NDArray,
    tolerance: float,
    stretch: float,
    base: int,
) -> bool:
    """Whether some other bright observed star has its place beside the triangle in the catalogue too."""
    for r in range(base):
        if r == corners[0] or r == corners[1] or r == corners[2]:
            continue
        reach = _angle(seen[corners[0]], seen[r])
        slack = sqrt(2.0) * tolerance + stretch * reach
        place = around(index, stars[0], reach - slack)
        while place < index.first[stars[0] + 1] and index.separation_rad[place] <= reach + slack:
            d = index.neighbour[place]
            place += 1
            fits = True
            for corner in range(1, 3):
                angle = _angle(seen[corners[corner]], seen[r])
                slip = abs(_angle(index.vectors[stars[corner]], index.vectors[d]) - angle)
                fits = fits and slip <= sqrt(2.0) * tolerance + stretch * angle
            if fits:
                return True
    return False


@numba.njit(cache=True)
def _zoomed(seen: Floats, zoom: float) -> Floats:
    """The directions with all angles from the boresight stretched, as a shorter focal length would see them."""
    out = np.empty_like(seen)
    for n in range(len(seen)):
        x, y = seen[n, 0] / seen[n, 2] * zoom, seen[n, 1] / seen[n, 2] * zoom
        length = sqrt(x * x + y * y + 1)
        out[n, 0], out[n, 1], out[n, 2] = x / length, y / length, 1 / length
    return out


@numba.njit(cache=True)
def _prove(
    seen: Floats,
    index: PairIndex,
    corners: NDArray,
    stars: NDArray,
    tolerance: float,
    stretch: float,
    hypotheses: int,
) -> tuple[NDArray, NDArray, Floats, float]:
    """Match all observed stars at the triangle's attitude, refine it once, and weigh the match against chance."""
    matrix = _wahba(seen[corners], index.vectors[stars])
    # A triangle's attitude is worse than a star's direction; the refined one needs no such allowance.
    observed, star, _ = _match(seen, index, stars[0], matrix, 2 * tolerance, stretch)
    if len(observed) < MIN_MATCHES:
        return _nothing()
    matrix = _wahba(seen[observed], index.vectors[star])
    observed, star, expected = _match(seen, index, stars[0], matrix, tolerance, stretch)
    if len(observed) < MIN_MATCHES:
        return _nothing()
    chance = log10_tail(len(seen) - 3, len(observed) - 3, expected) + np.log10(hypotheses)
    return observed, star, _wahba(seen[observed], index.vectors[star]), chance


@numba.njit(cache=True)
def _match(
    seen: Floats, index: PairIndex, centre: int, matrix: Floats, tolerance: float, stretch: float
) -> tuple[NDArray, NDArray, float]:
    """Nearest catalogue star to each observed one within its tolerance; each star once.

    Also returns how probable it is that a direction drawn at random has a star as near as that.
    """
    begin, end = index.first[centre], index.first[centre + 1]
    observed, star = np.empty(len(seen), np.int64), np.empty(len(seen), np.int64)
    cap_sr = 2 * pi * (1 - np.cos(index.max_angle_rad))
    density = (end - begin + 1) / cap_sr
    count, covered = 0, 0.0
    for n in range(len(seen)):
        in_ref = matrix.T @ seen[n]
        radius = tolerance + stretch * np.arccos(min(max(seen[n, 2], -1.0), 1.0))
        covered += density * pi * radius**2
        best, nearest = -1, radius
        for place in range(begin - 1, end):
            s = centre if place < begin else index.neighbour[place]
            apart = _angle(in_ref, index.vectors[s])
            if apart < nearest:
                best, nearest = s, apart
        taken = False
        for m in range(count):
            taken = taken or star[m] == best
        if best >= 0 and not taken:
            observed[count], star[count] = n, best
            count += 1
    return observed[:count], star[:count], 1 - np.exp(-covered / len(seen))


@numba.njit(cache=True)
def _wahba(cam: Floats, ref: Floats) -> Floats:
    """R_cam_from_ref by singular values (Markley 1988), equal weights."""
    u, _, vt = np.linalg.svd(cam.T @ ref)
    sign = np.linalg.det(u) * np.linalg.det(vt)
    u[:, 2] *= sign
    return u @ vt


@numba.njit(cache=True)
def log10_tail(trials: int, hits: int, p: float) -> float:
    """log10 of the probability of `hits` or more in `trials` at probability p each."""
    if hits <= 0:
        return 0.0
    total = 0.0
    for k in range(hits, trials + 1):
        ways = lgamma(trials + 1.0) - lgamma(k + 1.0) - lgamma(trials - k + 1.0)
        total += np.exp(ways + k * log(p) + (trials - k) * log(1 - p))
    return np.log10(max(total, 1e-300))
