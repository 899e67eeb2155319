"""Lost-in-space LED identification under a dome: pair hypotheses and a Bayes factor, with near-field parallax.

The angles between near LEDs, seen from the camera, change with the attitude. But the camera only rotates about the
bearing center, from which every LED has a fixed distance. A measured ray is intersected with the sphere of the
hypothetical LED's own radius about the bearing, which gives the direction from the bearing to the LED in body axes
without knowledge of the attitude. A pair of detections and a pair of LEDs must then agree in one angle about the
bearing, and determine an attitude. A quick check counts the other detections that have an LED at the predicted
direction; if enough do, the candidate is fitted to the whole field and its Bayes factor is computed
(`evidence.prove`).
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

ACCEPT_DEX = 5.0  # least log10 Bayes factor of an accepted attitude, over detections at random positions
MARGIN_DEX = 5.0  # by which the best attitude must beat every other one
TWIN_DEX = 2.0  # least evidence of the best attitude for a near rival to be reported as an ambiguity
SAME = 1e-9  # least separation of a pair, in tangents: closer detections have no direction between them
LONG = 0.2  # of the field size: shorter pairs determine the roll poorly and are tried last
AMBIGUOUS = "ambiguous: another attitude fits the lights as well"
NO_MATCH = "no identification beyond chance"


def identify(
    rays_cam: Floats, sigma_rad: Floats, sight: Sight, max_checks: int = 4_000_000
) -> StarMatch | str:
    """Identify the LEDs of (N, 3) rays in camera axes: the matches and the attitude, or the reason for a refusal.

    sigma_rad  : (N,) standard deviation of a ray about each axis; `sight` holds the survey's own errors
    max_checks : LED pairs tested, plus detections times LEDs compared, before giving up

    Detection pairs are tested against all LED pairs of the same angle (`_attempt`), in the order of how few these are.
    After an attitude reaches ACCEPT_DEX, rivals are searched for with a second, disjoint pair of its detections: a
    rival that explains almost as much must contain one of the two pairs. If a rival comes within MARGIN_DEX, the
    pattern is ambiguous and no attitude is returned. Brightness is not used, because all LEDs may be equally bright.
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
    """Detections for the search: rays with their total errors, which include those of the LED map and of the lever.

    A lateral error of the pupil shifts all LEDs alike and is absorbed by the attitude; an axial one scales the
    image and adds an error proportional to the distance from the boresight.

    With p = r + s u on the sphere |p| = R, ds/dR = R / (u . p), so that d(p / R)/dR = u / (u . p) - p / R^2.
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
    """The best hypothesis, and the evidence of the best one with another attitude."""
    best = Guess(np.empty(0, np.int64), np.empty(0, np.int64), np.eye(3), -np.inf)
    rival_dex, checks = -np.inf, np.zeros(1, np.int64)
    order = _pairs(lights, sight)
    for rank in range(len(order)):
        a, b = order[rank]
        best, rival_dex = _attempt(lights, sight, a, b, ACCEPT_DEX, best, rival_dex, checks)
        if best.dex >= ACCEPT_DEX:
            # A rival below this floor cannot matter. If the floor is below ACCEPT_DEX, `_attempt` has skipped such
            # rivals so far, and the same pair is tested again; then a second pair is tested.
            rival_floor = best.dex - MARGIN_DEX
            if rival_floor < ACCEPT_DEX:
                best, rival_dex = _attempt(lights, sight, a, b, rival_floor, best, rival_dex, checks)
            a, b = order[_second(order, rank, best)]
            return _attempt(lights, sight, a, b, rival_floor, best, rival_dex, checks)
        if checks[0] > max_checks:
            break
    return best, rival_dex


@jit
def _pairs(lights: Lights, sight: Sight) -> NDArray[np.int64]:
    """(P, 2) pairs of detections, sorted by the number of LED pairs they may be; short pairs come last.

    Short pairs also match few LED pairs, but determine the roll about the boresight poorly. Coincident detections are
    left out.
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
    """Half-open range of index pairs that two detections may be, and the gate of their angle about the bearing, rad."""
    gate = GATE * sqrt(lights.sigma[a] ** 2 + lights.sigma[b] ** 2) * _to_bearing(sight)
    at_a, at_b = vectors.row(lights.usual, a), vectors.row(lights.usual, b)
    angle = 2 * np.arcsin(min(vectors.chord(at_a, at_b) / 2, 1.0))
    begin, end = between(sight.pairs, angle - gate - sight.slack_rad, angle + gate + sight.slack_rad)
    return begin, end, gate


@jit
def _to_bearing(sight: Sight) -> float:
    """Ratio of an angle about the bearing to the angle seen by the camera: (R - M) / R."""
    return 1 - sqrt(sight.pupil_m[0] ** 2 + sight.pupil_m[1] ** 2 + sight.pupil_m[2] ** 2) / sight.usual_m


@jit
def _second(pairs: NDArray, rank: int, best: Guess) -> int:
    """Rank of the first pair of two matched detections that shares none with pair `rank`, or as few as possible."""
    kept, cost = rank, 9
    for other in range(len(pairs)):
        stale = 0
        for end in range(2):
            known = False
            for n in best.observed:
                known = known or n == pairs[other, end]
            stale += 3 * (not known)  # an unmatched detection is worse than two shared ones
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
    """Test two detections against every LED pair of the same angle, in both orders.

    Candidates that cannot reach floor_dex are skipped. Returns the updated best hypothesis and the evidence of its best
    rival. checks : (1,) effort so far, increased in place.
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
            # The index holds angles scaled to the median radius; here each ray meets the LED's own radius.
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
    """Unit vector from the bearing to the point where a camera ray meets the sphere of radius_m, in camera axes."""
    px, py, pz = sight.pupil_m
    along = ray[0] * px + ray[1] * py + ray[2] * pz
    reach = -along + sqrt(max(along * along - px * px - py * py - pz * pz + radius_m * radius_m, 0.0))
    inverse = 1 / radius_m
    return (px + reach * ray[0]) * inverse, (py + reach * ray[1]) * inverse, (pz + reach * ray[2]) * inverse


@jit
def _wanted(lights: Lights, sight: Sight, a: int, b: int, floor_dex: float) -> int:
    """Least number of matches that can reach floor_dex, from an upper bound of `_evidence`.

    The bound has no residuals, no missing LEDs, and the attitude uncertainty of the pair alone: sqrt(2) sigma /
    separation about the boresight, sigma / sqrt(2) across it.
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
    """(N,) matching radius of each detection at a pair's attitude, as an angle about the bearing, rad.

    The pair's own error adds a shift with half of a detection's variance and a rotation with 2 sigma^2 / separation^2.
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
    """Quick check: number of detections with an LED at the predicted direction, the pair included.

    Stops as soon as `wanted` is reached or out of reach. Every ray is taken to the radius of the hypothetical LED
    (radius_m) by a first-order step from the median radius.
    """
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
    """Whether any LED is within `gate` (rad) of a direction in grid axes."""
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
