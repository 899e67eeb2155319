"""Which LED is which, lost under a dome: pairs of lights at their own distances, proved by the whole field.

Inter-LED angles depend on where the camera stands. But the camera can only turn about the bearing's centre, from
which each LED keeps its distance: a ray carried to the sphere of a hypothetical LED's own radius meets it at a known
direction in the body, whatever the attitude. Two rays and two LEDs then have one angle to agree on, and give an
attitude, which must put the other LEDs where lights are in the image.
"""

from __future__ import annotations

from math import log10, pi, sqrt

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from estimator.attitude.dome_map import on_sphere
from estimator.catalog.pair_index import between
from estimator.catalog.spatial_grid import cell_of
from estimator.core import vectors
from estimator.core.arrays import Floats
from estimator.core.jit import jit
from estimator.core.types import StarMatch
from estimator.core.vectors import Vector
from estimator.identification.leds.evidence import GATE, LEAST, Guess, Lights, alike, apart, prove
from estimator.identification.leds.index import Grid, Sight

ACCEPT_DEX = 5.0  # evidence for an attitude, against lights that fell anywhere, in powers of ten
MARGIN_DEX = 5.0  # by which the best attitude must beat every other one
TWIN_DEX = 2.0  # two attitudes of as much evidence are worth to be called ambiguous
SAME = 1e-9  # as tangents: two lights so near to one another have no direction between them
LONG = 0.2  # of the field: pairs as long as that say where the other LEDs are
AMBIGUOUS = "ambiguous: another attitude fits the lights as well"
NO_MATCH = "no identification beyond chance"


def identify(
    rays_cam: Floats, sigma_rad: Floats, sight: Sight, max_checks: int = 4_000_000
) -> StarMatch | str:
    """The LEDs that (N, 3) rays come from and the attitude that says so, or the reason for a refusal.

    sigma_rad  : (N,) of a ray about each axis; what the errors of the survey add is in `sight`
    max_checks : pairs of LEDs looked at, and lights times LEDs compared, before giving up
    Pairs of lights are taken, and for each every pair of LEDs that may be it (`_attempt`). An attitude's worth is the
    evidence (`_evidence`) for it over lights that fell anywhere. One beyond ACCEPT_DEX is sought once more, from two
    lights that it did not come from: whatever rival explains almost as much must have one of the two pairs. If a
    rival comes within MARGIN_DEX the pattern is one that cannot be told apart.
    No brightness is used: every LED may be equal.
    """
    if len(rays_cam) < LEAST:
        return NO_MATCH
    guess, rival_dex = _search(lights_of(rays_cam, sigma_rad, sight), sight, max_checks)
    if guess.dex > TWIN_DEX and guess.dex - rival_dex < MARGIN_DEX:
        return AMBIGUOUS
    if guess.dex < ACCEPT_DEX:
        return NO_MATCH
    return StarMatch(guess.observed, guess.star, Rotation.from_matrix(guess.matrix), -guess.dex)


def lights_of(rays_cam: Floats, sigma_rad: Floats, sight: Sight) -> Lights:
    """Rays laid out for the search, with the errors of what is believed in theirs.

    A camera that is aside sees all LEDs aside, which is a turn; one that is nearer sees them farther from the middle.

    With p = r + s u on the sphere |p| = R, ds/dR = R / (u . p), so that p / R moves by u / (u . p) - p / R^2.
    """
    tangent = np.ascontiguousarray(rays_cam[:, :2] / rays_cam[:, 2:])
    nearer = sight.lever_sigma * np.linalg.norm(tangent, axis=1)
    seen = np.hypot(sigma_rad, sight.led_sigma) / rays_cam[:, 2] ** 2
    point_m = on_sphere(rays_cam, sight.pupil_m, sight.usual_m)
    along_m = np.sum(rays_cam * point_m, axis=1)[:, None]
    return Lights(
        np.ascontiguousarray(rays_cam),
        tangent,
        np.hypot(seen, nearer),
        point_m / sight.usual_m,
        rays_cam / along_m - point_m / sight.usual_m**2,
    )


@jit
def _search(lights: Lights, sight: Sight, max_checks: int) -> tuple[Guess, float]:
    """The best attitude, and how much speaks for the best that is another."""
    best = Guess(np.empty(0, np.int64), np.empty(0, np.int64), np.eye(3), -np.inf)
    rival_dex, checks = -np.inf, np.zeros(1, np.int64)
    order = _pairs(lights, sight)
    for rank in range(len(order)):
        a, b = order[rank]
        best, rival_dex = _attempt(lights, sight, a, b, ACCEPT_DEX, best, rival_dex, checks)
        if best.dex >= ACCEPT_DEX:
            rival_floor = best.dex - MARGIN_DEX
            if rival_floor < ACCEPT_DEX:  # too weak to be found so far
                best, rival_dex = _attempt(lights, sight, a, b, rival_floor, best, rival_dex, checks)
            a, b = order[_second(order, rank, best)]
            return _attempt(lights, sight, a, b, rival_floor, best, rival_dex, checks)
        if checks[0] > max_checks:
            break
    return best, rival_dex


@jit
def _pairs(lights: Lights, sight: Sight) -> NDArray[np.int64]:
    """(P, 2) pairs of lights, those that the fewest LEDs may be first; short ones last, two in one place not at all.

    A short pair may be few LEDs too, but says little of the turn about the boresight.
    """
    total, long = len(lights.ray), LONG * sqrt(sight.area)
    pair, cost = np.empty((total * (total - 1) // 2, 2), np.int64), np.empty(total * (total - 1) // 2)
    place = 0
    for a in range(total):
        for b in range(a + 1, total):
            length = apart(lights.tangent, a, b)
            if not length > SAME:
                continue
            begin, end, _ = _window(lights, sight, a, b)
            pair[place, 0], pair[place, 1] = a, b
            cost[place] = end - begin if length >= long else 1e9 - length
            place += 1
    return pair[:place][np.argsort(cost[:place])]


@jit
def _window(lights: Lights, sight: Sight, a: int, b: int) -> tuple[int, int, float]:
    """Which pairs of the index two lights may be, half-open, and the gate for the angle about the bearing."""
    gate = GATE * sqrt(lights.sigma[a] ** 2 + lights.sigma[b] ** 2) * _to_bearing(sight)
    at_a, at_b = vectors.row(lights.usual, a), vectors.row(lights.usual, b)
    angle = 2 * np.arcsin(min(vectors.chord(at_a, at_b) / 2, 1.0))
    begin, end = between(sight.pairs, angle - gate - sight.slack_rad, angle + gate + sight.slack_rad)
    return begin, end, gate


@jit
def _to_bearing(sight: Sight) -> float:
    """An angle about the bearing for one at the camera: (R - M) / R."""
    return 1 - sqrt(sight.pupil_m[0] ** 2 + sight.pupil_m[1] ** 2 + sight.pupil_m[2] ** 2) / sight.usual_m


@jit
def _second(pairs: NDArray, rank: int, best: Guess) -> int:
    """The first of the pairs of matched lights that has none of that pair's, or as few as can be."""
    kept, cost = rank, 9
    for other in range(len(pairs)):
        stale = 0
        for end in range(2):
            known = False
            for n in best.observed:
                known = known or n == pairs[other, end]
            stale += 3 * (not known)
            stale += pairs[other, end] == pairs[rank, 0] or pairs[other, end] == pairs[rank, 1]
        if stale < cost:
            kept, cost = other, stale
    return kept


@jit
def _attempt(
    lights: Lights,
    sight: Sight,
    a: int,
    b: int,
    floor_dex: float,
    best: Guess,
    rival_dex: float,
    checks: NDArray,
) -> tuple[Guess, float]:
    """Two lights as every pair of LEDs that they may be; the best attitude so far and its best rival's evidence.

    What cannot have more than floor_dex of evidence is passed over.
    """
    index, radius = sight.pairs, sight.radius_m
    begin, end, gate = _window(lights, sight, a, b)
    wanted, gates = _wanted(lights, sight, a, b, floor_dex), _first_gates(lights, sight, a, b)
    in_cam, in_lab, matrix = np.empty((3, 3)), np.empty((3, 3)), np.empty((3, 3))
    grid_from_cam = np.empty((3, 3))
    checks[0] += 2 * (end - begin)
    for p in range(begin, end):
        for flip in range(2):
            i, j = index.pair[p, flip], index.pair[p, 1 - flip]
            at_i, at_j = _carried(lights.ray[a], sight, radius[i]), _carried(lights.ray[b], sight, radius[j])
            led_i, led_j = vectors.row(index.vectors, i), vectors.row(index.vectors, j)
            if abs(vectors.chord(at_i, at_j) - vectors.chord(led_i, led_j)) > gate:
                continue
            vectors.axes(at_i, at_j, in_cam)
            vectors.axes(led_i, led_j, in_lab)
            vectors.times_transposed(in_cam, in_lab, matrix)
            vectors.times_transposed(sight.grid.R_grid_from_lab, matrix, grid_from_cam)
            if _glance(lights, sight, grid_from_cam, radius[i], a, b, gates, wanted) < wanted:
                continue
            checks[0] += len(lights.ray) * (index.first[i + 1] - index.first[i]) // 4
            guess = prove(lights, sight, matrix.copy(), i, a, b)
            same = alike(guess, best)
            if guess.dex > best.dex:
                rival_dex = rival_dex if same else max(rival_dex, best.dex)
                best = guess
            elif not same:
                rival_dex = max(rival_dex, guess.dex)
    return best, rival_dex


@jit
def _carried(ray: Floats, sight: Sight, radius_m: float) -> Vector:
    """Unit vector from the bearing to where a ray from the camera meets the sphere of a radius, in camera axes."""
    px, py, pz = sight.pupil_m
    along = ray[0] * px + ray[1] * py + ray[2] * pz
    reach = -along + sqrt(max(along * along - px * px - py * py - pz * pz + radius_m * radius_m, 0.0))
    inverse = 1 / radius_m
    return (px + reach * ray[0]) * inverse, (py + reach * ray[1]) * inverse, (pz + reach * ray[2]) * inverse


@jit
def _wanted(lights: Lights, sight: Sight, a: int, b: int, floor_dex: float) -> int:
    """How many matches it takes for that evidence.

    An upper bound of `_evidence`: no residuals, nothing missed, and an attitude as loose as the pair alone leaves it:
    sqrt(2) sigma / apart about the boresight, sigma / sqrt(2) across it.
    """
    sigma = lights.sigma.min()
    each = -log10(2 * pi * sigma**2 * len(lights.ray) / sight.area)
    loose = 1.5 * log10(2 * pi) - log10(sight.volume)
    loose += log10(sigma**3 / sqrt(2.0) / apart(lights.tangent, a, b))
    for count in range(LEAST, len(lights.ray)):
        if count * each + loose - log10(count + 1.0) >= floor_dex:
            return count
    return len(lights.ray)


@jit
def _first_gates(lights: Lights, sight: Sight, a: int, b: int) -> Floats:
    """(N,) angles about the bearing within which an LED is to be where a pair's attitude puts a light.

    The pair's own error shifts what it predicts by half of a light's variance, and turns it by 2 sigma^2 / apart^2.
    """
    x, y = (lights.tangent[a] + lights.tangent[b]) / 2
    turning = 2 / apart(lights.tangent, a, b) ** 2
    out = np.empty(len(lights.ray))
    for n in range(len(out)):
        off2 = (lights.tangent[n, 0] - x) ** 2 + (lights.tangent[n, 1] - y) ** 2
        out[n] = GATE * lights.sigma[n] * sqrt(1.5 + turning * off2) * _to_bearing(sight) + sight.slack_rad
    return out


@jit
def _glance(
    lights: Lights,
    sight: Sight,
    grid_from_cam: Floats,
    radius_m: float,
    a: int,
    b: int,
    gates: Floats,
    wanted: int,
) -> int:
    """How many lights have an LED where an attitude puts them, the pair's two included; no more than are wanted."""
    count, total, higher_m = 2, len(lights.ray), radius_m - sight.usual_m
    for n in range(total):
        if count >= wanted or count + total - n < wanted:
            break
        if n in (a, b):
            continue
        x = lights.usual[n, 0] + higher_m * lights.rise[n, 0]
        y = lights.usual[n, 1] + higher_m * lights.rise[n, 1]
        z = lights.usual[n, 2] + higher_m * lights.rise[n, 2]
        where = (
            grid_from_cam[0, 0] * x + grid_from_cam[0, 1] * y + grid_from_cam[0, 2] * z,
            grid_from_cam[1, 0] * x + grid_from_cam[1, 1] * y + grid_from_cam[1, 2] * z,
            grid_from_cam[2, 0] * x + grid_from_cam[2, 1] * y + grid_from_cam[2, 2] * z,
        )
        count += _anything(sight.grid, where, gates[n])
    return count


@jit
def _anything(grid: Grid, where: Vector, gate: float) -> bool:
    """Whether an LED is within an angle of a direction in the grid's axes."""
    inverse, half, reach = 1 / grid.cell, grid.side / 2, gate / grid.cell
    x, y = where[0] * inverse + half, where[1] * inverse + half
    for line in range(cell_of(y - reach, grid.side), cell_of(y + reach, grid.side - 1) + 1):
        left = line * grid.side + cell_of(x - reach, grid.side)
        right = line * grid.side + cell_of(x + reach, grid.side - 1)
        if left > right:
            continue
        for place in range(grid.first[left], grid.first[right + 1]):
            off = (
                grid.direction[place, 0] - where[0],
                grid.direction[place, 1] - where[1],
                grid.direction[place, 2] - where[2],
            )
            if off[0] * off[0] + off[1] * off[1] + off[2] * off[2] < gate * gate:
                return True
    return False
