"""Which star is which, lost in space: pyramids of angles, proved by every star in the field."""

from __future__ import annotations

from collections.abc import Callable
from math import pi, sqrt
from typing import NamedTuple

import numba
import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from estimator.chance import ACCEPT_LOG10_CHANCE, MIN_MATCHES, log10_tail
from estimator.index import PairIndex, around, between
from estimator.saa import saa
from estimator.types import Floats, StarMatch

Identifier = Callable[..., StarMatch | None]


class Rules(NamedTuple):
    """How a search is done. A plain tuple, so that compiled code can take it.

    tolerance, stretch, zooms, triangles, checks, base, missed_dex : as `pyramid` says
    left, right, top, bottom : tangents of the sensor's edges from the boresight
    """

    tolerance: float
    stretch: float
    zooms: bool
    triangles: int
    checks: int
    base: int
    missed_dex: float
    left: float
    right: float
    top: float
    bottom: float


def pyramid(
    vectors_cam: Floats,
    index: PairIndex,
    tolerance_rad: float,
    stretch: float = 0.0,
    zooms: bool = False,
    max_triangles: int = 3000,
    max_checks: int = 20_000_000,
    base_stars: int = 20,
    missed_dex: float = 0.0,
    field_tan: tuple[float, float, float, float] = (-1.0, 1.0, -1.0, 1.0),
) -> StarMatch | None:
    """Pyramid (Mortari, Samaan & Junkins 2001): a triangle, a fourth star, then the whole field.

    vectors_cam   : (N, 3) observed unit vectors, brightest first
    tolerance_rad : of a direction; of an angle sqrt(2) times it, plus `stretch` times the angle
    zooms         : whether the stretch is one unknown focal length, which each triangle then measures by itself
    max_triangles, max_checks : observed triangles tried, and angles compared, before giving up; the latter bounds
        the time, at some tens of nanoseconds each
    base_stars    : among how many of the brightest the pyramids are sought
    missed_dex    : what a catalogue star that should be in the field and is not costs, in powers of ten; 0 where
        nobody knows how faint the camera sees, more where every light is known to shine
    field_tan     : (left, right, top, bottom) tangents of the field's edges, for missed_dex
    Triangles are taken from three groups of the index, in an order that changes all three stars soon (their
    `smart` order), so that one false star costs little. A pyramid is only a hypothesis: the attitude that it gives
    must explain so many of the observed stars that, over all that was tried, a match this good is expected less
    than 1e-5 times by chance.
    Returns None rather than a guess.
    """
    if len(vectors_cam) < MIN_MATCHES:
        return None
    base = min(base_stars, len(vectors_cam))
    rules = Rules(tolerance_rad, stretch, zooms, max_triangles, max_checks, base, missed_dex, *field_tan)
    observed, star, matrix, chance = _search(np.ascontiguousarray(vectors_cam), index, rules)
    if len(observed) < MIN_MATCHES or chance > ACCEPT_LOG10_CHANCE:
        return None
    return StarMatch(observed, star, Rotation.from_matrix(matrix), chance)


# `default` is the pyramid where the focal length is uncertain; a known camera's stars are found by evidence (ledpairs).
IDENTIFIERS: dict[str, Identifier] = {"default": pyramid, "pyramid": pyramid, "saa": saa}

Found = tuple[NDArray[np.int64], NDArray[np.int64], Floats, float]


@numba.njit(cache=True)
def _search(seen: Floats, index: PairIndex, rules: Rules) -> Found:
    """Walk the triangles (i, i + dj, i + dj + dk) and stop at the first attitude beyond chance."""
    tried = np.zeros(3, np.int64)  # observed triangles, hypotheses, checks
    for dj in range(1, rules.base - 1):
        for dk in range(1, rules.base - dj):
            for i in range(rules.base - dj - dk):
                corners = np.array([i, i + dj, i + dj + dk])
                found = _triangle(seen, index, corners, rules, tried)
                if found[3] < ACCEPT_LOG10_CHANCE:
                    return found
                tried[0] += 1
                if tried[0] >= rules.triangles or tried[2] >= rules.checks:
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
def _triangle(seen: Floats, index: PairIndex, corners: NDArray, rules: Rules, tried: NDArray) -> Found:
    """Every catalogue triangle like an observed one, of the same handedness, that a fourth star confirms."""
    i, j, k = corners
    ij, ik, jk = _angle(seen[i], seen[j]), _angle(seen[i], seen[k]), _angle(seen[j], seen[k])
    t_ij, t_ik, t_jk = sqrt(2.0) * rules.tolerance + rules.stretch * np.array([ij, ik, jk])
    if min(ij, ik, jk) < 4 * t_ij or max(ij, ik, jk) > index.max_angle_rad:
        return _nothing()
    # Three sides that agree on one focal length leave only what the lens distorts.
    tight = rules.stretch / 3 if rules.zooms else rules.stretch
    handed = _triple(seen[i], seen[j], seen[k])
    begin, end = between(index, ij - t_ij, ij + t_ij)
    for p in range(begin, end):
        if tried[2] >= rules.checks:
            break
        side = index.angle_rad[p]
        if abs(side - ij) > t_ij:
            continue
        for flip in range(2):
            a, b = index.pair[p, flip], index.pair[p, 1 - flip]
            place = around(index, a, ik - t_ik)
            while place < index.first[a + 1] and index.separation_rad[place] <= ik + t_ik:
                c, near = index.neighbour[place], index.separation_rad[place]
                place += 1
                tried[2] += 1
                if index.group[c] == index.group[a] or index.group[c] == index.group[b]:
                    continue
                far = _angle(index.vectors[b], index.vectors[c])
                if abs(far - jk) > t_jk:
                    continue
                if handed * _triple(index.vectors[a], index.vectors[b], index.vectors[c]) <= 0:
                    continue
                zoom = (side + near + far) / (ij + ik + jk) if rules.zooms else 1.0
                slip = max(
                    abs(side - zoom * ij) - tight * ij,
                    abs(near - zoom * ik) - tight * ik,
                    abs(far - zoom * jk) - tight * jk,
                )
                if slip > sqrt(2.0) * rules.tolerance:
                    continue
                tried[1] += 1
                zoomed = _zoomed(seen, zoom) if rules.zooms else seen
                found = _pyramid(zoomed, index, corners, np.array([a, b, c]), rules, tight, tried)
                if found[3] < ACCEPT_LOG10_CHANCE:
                    return found
    return _nothing()


@numba.njit(cache=True)
def _pyramid(
    seen: Floats,
    index: PairIndex,
    corners: NDArray,
    stars: NDArray,
    rules: Rules,
    stretch: float,
    tried: NDArray,
) -> Found:
    """A triangle with a fourth star is worth proving."""
    for r in range(rules.base):
        tried[2] += 1
        if r == corners[0] or r == corners[1] or r == corners[2]:
            continue
        reach = _angle(seen[corners[0]], seen[r])
        slack = sqrt(2.0) * rules.tolerance + stretch * reach
        place = around(index, stars[0], reach - slack)
        while place < index.first[stars[0] + 1] and index.separation_rad[place] <= reach + slack:
            d = index.neighbour[place]
            place += 1
            fits = True
            for corner in range(1, 3):
                angle = _angle(seen[corners[corner]], seen[r])
                slip = abs(_angle(index.vectors[stars[corner]], index.vectors[d]) - angle)
                fits = fits and slip <= sqrt(2.0) * rules.tolerance + stretch * angle
            if fits:
                tried[2] += len(seen) * (index.first[stars[0] + 1] - index.first[stars[0]])
                return _prove(seen, index, corners, stars, rules, stretch, tried[1])
    return _nothing()


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
    rules: Rules,
    stretch: float,
    hypotheses: int,
) -> Found:
    """Match all observed stars at the triangle's attitude, refine it once, and weigh the match against chance."""
    matrix = _wahba(seen[corners], index.vectors[stars])
    # A triangle's attitude is worse than a star's direction; the refined one needs no such allowance.
    observed, star, _ = _match(seen, index, stars[0], matrix, 2 * rules.tolerance, stretch)
    if len(observed) < MIN_MATCHES:
        return _nothing()
    matrix = _wahba(seen[observed], index.vectors[star])
    observed, star, expected = _match(seen, index, stars[0], matrix, rules.tolerance, stretch)
    if len(observed) < MIN_MATCHES:
        return _nothing()
    chance = _log10_chance(index.group[star], len(seen), expected) + np.log10(hypotheses)
    if rules.missed_dex > 0:
        missed = max(_expected(index, stars[0], matrix, rules) - len(observed), 0)
        chance += rules.missed_dex * missed
    return observed, star, _wahba(seen[observed], index.vectors[star]), chance


@numba.njit(cache=True)
def _expected(index: PairIndex, centre: int, matrix: Floats, rules: Rules) -> int:
    """How many catalogue stars should be in the field at an attitude."""
    count = 0
    begin, end = index.first[centre], index.first[centre + 1]
    for place in range(begin - 1, end):
        s = centre if place < begin else index.neighbour[place]
        x, y, z = matrix @ index.vectors[s]
        inside = z > 0 and rules.left * z < x < rules.right * z and rules.top * z < y < rules.bottom * z
        count += inside
    return count


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
def _log10_chance(groups: NDArray, seen: int, p: float) -> float:
    """log10 of the probability that a false attitude matches this much, three independent matches being spent.

    The first match of each group is as improbable as a star's, p. What follows in a group follows from its
    pattern, which is everybody's: the second light fixes which way the lattice lies (one in ten), each further
    one is there or not (one in two). Where each star is its own group this is the binomial tail.
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
