"""Which star is which, lost in space: the default. A pair of lights as every pair of stars, proved by the whole field.

Two lights and two stars as far apart give an attitude, which must put other stars where lights are. What it puts there
is weighed as evidence over lights that fell anywhere; the first attitude beyond chance is the answer. Where the focal
length is only known within a share, the pair's own angle tells it, and the rest of the field must agree.
"""

from __future__ import annotations

from math import log10, pi, sqrt

import numpy as np
from numpy.typing import NDArray

from estimator.catalog.sky_index import Sky, nearest
from estimator.catalog.spatial_grid import cell_of
from estimator.core import vectors
from estimator.core.arrays import Floats
from estimator.core.jit import jit
from estimator.identification.stars.evidence import (
    GATE,
    LEAST,
    Fix,
    Guess,
    Lights,
    area,
    fixed,
    nothing,
    ray,
    share_at,
    turned,
    volume_dex,
    weigh,
)

# Evidence for an attitude, against lights that fell anywhere, in powers of ten. Markov's inequality allows one such in
# 10^5 frames of false lights. With 4 a mirrored sky had an attitude, one in 10^5 hostile pictures
# (docs/findings/robustness.md); 5 costs two in a thousand of the hardest frames (python -m benchmarks.lost_in_space), 6
# would cost twelve.
ACCEPT_DEX = 5.0
DECISIVE_DEX = 10.0  # evidence beyond which no rival is looked for
MARGIN_DEX = 3.0  # by which the answer must beat every other attitude
NO_RIVAL_DEX = ACCEPT_DEX - MARGIN_DEX  # of less evidence an attitude is neither the answer nor in its way
AGAIN, AGAIN_LEAST = (
    2,
    2000,
)  # how much more is looked for rivals: times the effort so far, and lights at least
LONG = 0.2  # of the field: pairs as long as that say where the other stars are
MAG_GATE = (
    4.0  # standard deviations by which a light's magnitude may differ from its star's, in the first round
)
WEIGH_CHECKS = (
    6  # what weighing an attitude counts for beside looking up a light: a frame with no answer must end
)
PATIENCE = 4  # lights without a star, before an attitude is given up in the first round


@jit
def lost_in_space(lights: Lights, patterns: Sky, stars: Sky, base_lights: int, max_checks: int) -> Fix:
    """Which of the stars all the lights are: sought among the brightest lights and the patterns, told by all.

    No answer unless the brightest are beyond chance, nor where the whole field does not hold what they found.
    """
    few = min(base_lights, len(lights.sigma))
    head = Lights(
        lights.tangent[:few],
        lights.sigma[:few],
        lights.weight[:few],
        lights.mag[:few],
        lights.mag_sigma,
        lights.field,
        lights.zoom,
    )
    found = search(head, patterns, max_checks)
    if found.dex < ACCEPT_DEX:
        return fixed(lights, stars, nothing())
    gates = 1.5 * GATE * lights.sigma
    whole = weigh(lights, stars, found.R_cam_from_ref.copy(), found.zoom, gates, -np.inf)
    if 2 * len(whole.observed) <= len(found.observed):
        return fixed(lights, stars, nothing())
    best = Guess(
        whole.observed, whole.star, whole.R_cam_from_ref, whole.zoom, whole.info, max(whole.dex, found.dex)
    )
    return fixed(lights, stars, best)


@jit
def search(lights: Lights, sky: Sky, max_checks: int) -> Guess:
    """The first attitude with DECISIVE_DEX of evidence; else the best one met, if it is beyond chance and every rival.

    Pairs go by how few pairs of stars they may be: short ones, of those long enough, of lights of a rare brightness; a
    light that has been tried goes back. A first round gives an attitude up after PATIENCE lights without a star, so
    that false pairs cost little, and passes over stars of another magnitude; a second one looks at all. An attitude
    that is beyond chance and not decisive is held against what other pairs find, AGAIN times the effort so far.
    max_checks bounds the lights looked up, and WEIGH_CHECKS for each attitude weighed.
    """
    total = len(lights.sigma)
    length, rare = _lengths(lights), _rarity(lights, sky)
    best, rival_dex, checks, limit = nothing(), -np.inf, np.zeros(1, np.int64), max_checks
    for patience in (PATIENCE, total):
        tried = np.zeros((total, total), np.bool_)
        cost = rare.copy()
        for _ in range(total * (total - 1) // 2):
            a, b = _next(length, tried, cost)
            tried[a, b] = True
            guess = _attempt(lights, sky, a, b, patience, best, checks)
            same = _alike(guess, best)
            if guess.dex > best.dex:
                rival_dex = rival_dex if same else max(rival_dex, best.dex)
                if best.dex < ACCEPT_DEX <= guess.dex:
                    limit = min(max_checks, (1 + AGAIN) * checks[0] + AGAIN_LEAST)
                best = guess
            elif not same:
                rival_dex = max(rival_dex, guess.dex)
            if best.dex >= DECISIVE_DEX:
                return best
            cost[a] *= 2
            cost[b] *= 2
            if checks[0] > limit:
                break
        if checks[0] > limit or total - 2 <= PATIENCE:
            break
    return best if best.dex >= ACCEPT_DEX and best.dex - rival_dex >= MARGIN_DEX else nothing()


@jit
def _alike(one: Guess, other: Guess) -> bool:
    """Whether two guesses are one attitude, to some degrees; nothing is like nothing."""
    return other.dex > -np.inf and bool(np.sum(one.R_cam_from_ref * other.R_cam_from_ref) > 2.99)


@jit
def _lengths(lights: Lights) -> Floats:
    """(N, N) of every pair a < b; those too short to tell the turn about the boresight count as very long."""
    total, field = len(lights.sigma), lights.field
    long = LONG * sqrt((field[1] - field[0]) * (field[3] - field[2]))
    out = np.empty((total, total))
    for a in range(total):
        for b in range(a + 1, total):
            apart = sqrt(_apart2(lights.tangent, a, b))
            out[a, b] = apart if apart >= long else 1e3 * long * long / max(apart, 1e-9)
    return out


@jit
def _rarity(lights: Lights, sky: Sky) -> Floats:
    """(N,) share of the stars that are as bright as a light."""
    out = np.ones(len(lights.sigma))
    for n in range(len(out)):
        if np.isfinite(lights.mag[n]):
            out[n] = min(2 * MAG_GATE * lights.mag_sigma * share_at(sky, lights.mag[n]) + 1e-3, 1.0)
    return out


@jit
def _apart2(tangent: Floats, a: int, b: int) -> float:
    return (tangent[a, 0] - tangent[b, 0]) ** 2 + (tangent[a, 1] - tangent[b, 1]) ** 2


@jit
def _next(length: Floats, tried: NDArray, vain: Floats) -> tuple[int, int]:
    """The most promising pair that is left."""
    best, at_a, at_b = np.inf, 0, 1
    for a in range(len(vain)):
        for b in range(a + 1, len(vain)):
            cost = length[a, b] * vain[a] * vain[b]
            if cost < best and not tried[a, b]:
                best, at_a, at_b = cost, a, b
    return at_a, at_b


@jit
def _attempt(lights: Lights, sky: Sky, a: int, b: int, patience: int, known: Guess, checks: NDArray) -> Guess:
    """Two lights as every pair of stars that they may be: the first attitude beyond chance, else the best.

    An attitude that is known by now is not the first: its rivals are looked for.
    """
    gates, order = _gates(lights, a, b), _others(len(lights.sigma), a, b)
    wanted = _wanted(lights, a, b)
    in_cam, in_ref, R_ref_from_cam = np.empty((3, 3)), np.empty((3, 3)), np.empty((3, 3))
    best, zoom = nothing(), 1.0
    at_a, at_b = ray(lights.tangent, a, 1.0), ray(lights.tangent, b, 1.0)
    chord = vectors.chord(at_a, at_b)
    vectors.axes(at_a, at_b, in_cam)
    gate = GATE * sqrt(lights.sigma[a] ** 2 + lights.sigma[b] ** 2)
    angle = 2 * np.arcsin(min(chord / 2, 1.0))
    last = len(sky.first) - 2
    low = cell_of((angle / (1 + lights.zoom) - gate) / sky.bin_rad, last + 1)
    high = cell_of((angle / (1 - lights.zoom) + gate) / sky.bin_rad, last)
    # Members of tuples are taken out here: in the loop each would cost two counts of its references.
    tangent, first, pair, star, mag = lights.tangent, sky.first, sky.pair, sky.vectors, sky.mag
    cell_first, cell_star, side, zooms = sky.cell_first, sky.cell_star, sky.side, lights.zoom
    mag_a, mag_b = lights.mag[a], lights.mag[b]
    mag_gate = MAG_GATE * lights.mag_sigma if patience == PATIENCE else np.inf
    for p in range(first[low], first[high + 1]):
        i, j = pair[p, 0], pair[p, 1]
        # A magnitude that is not known, NaN, is not beyond any gate.
        forward = not (abs(mag_a - mag[i]) > mag_gate or abs(mag_b - mag[j]) > mag_gate)
        backward = not (abs(mag_a - mag[j]) > mag_gate or abs(mag_b - mag[i]) > mag_gate)
        if not (forward or backward):
            continue
        one, other = vectors.row(star, i), vectors.row(star, j)
        wide = vectors.chord(one, other)
        if zooms > 0:
            zoom = _zoom(tangent, a, b, chord, wide)
            if abs(zoom - 1) > zooms:
                continue
            vectors.axes(ray(tangent, a, zoom), ray(tangent, b, zoom), in_cam)
        elif abs(wide - chord) > gate:
            continue
        vectors.axes(one, other, in_ref)
        for flip in range(2):
            if backward if flip else forward:
                vectors.times_transposed(in_ref, in_cam, R_ref_from_cam)
                looked, fits = _glance(
                    tangent,
                    star,
                    cell_first,
                    cell_star,
                    side,
                    R_ref_from_cam,
                    zoom,
                    gates,
                    order,
                    wanted,
                    patience,
                )
                checks[0] += 1 + looked
                if fits:
                    checks[0] += WEIGH_CHECKS
                    guess = weigh(lights, sky, R_ref_from_cam.T.copy(), zoom, gates, NO_RIVAL_DEX)
                    if guess.dex >= ACCEPT_DEX and not _alike(guess, known):
                        return guess
                    if guess.dex > best.dex:
                        best = guess
            for k in range(3):  # the same two stars the other way round
                in_ref[k, 1], in_ref[k, 2] = -in_ref[k, 1], -in_ref[k, 2]
    return best


@jit
def _others(total: int, a: int, b: int) -> NDArray[np.int64]:
    out, count = np.empty(total, np.int64), 0
    for n in range(total):
        if n not in (a, b):
            out[count] = n
            count += 1
    return out[:count]


@jit
def _zoom(tangent: Floats, a: int, b: int, chord: float, wanted: float) -> float:
    """The zoom at which two lights are a chord apart."""
    zoom = chord / wanted
    for _ in range(2):
        zoom *= vectors.chord(ray(tangent, a, zoom), ray(tangent, b, zoom)) / wanted
    return zoom


@jit
def _gates(lights: Lights, a: int, b: int) -> Floats:
    """(N,) angles within which a star is to be where a pair's attitude puts a light: its own error and the pair's.

    The pair's middle errs by (sa^2 + sb^2) / 4, its direction and its length by (sa^2 + sb^2) / apart^2.
    """
    tangent = lights.tangent
    x, y = (tangent[a, 0] + tangent[b, 0]) / 2, (tangent[a, 1] + tangent[b, 1]) / 2
    pair2 = lights.sigma[a] ** 2 + lights.sigma[b] ** 2
    turning = pair2 / _apart2(tangent, a, b)
    out = np.empty(len(lights.sigma))
    for n in range(len(out)):
        off2 = (tangent[n, 0] - x) ** 2 + (tangent[n, 1] - y) ** 2
        out[n] = GATE * sqrt(lights.sigma[n] ** 2 + pair2 / 4 + turning * off2)
    return out


@jit
def _wanted(lights: Lights, a: int, b: int) -> int:
    """How many matches it takes for ACCEPT_DEX, at best: an upper bound of `_evidence`.

    No residuals, nothing missed, and an attitude as loose as the pair alone leaves it: sqrt(2) sigma / apart about the
    boresight (and of the zoom), sigma / sqrt(2) across it.
    """
    total, sigma = len(lights.sigma), lights.sigma.min()
    each = -log10(2 * pi * sigma**2 * total / area(lights))
    turn = sqrt(2.0) * sigma / sqrt(_apart2(lights.tangent, a, b))
    loose = 1.5 * log10(2 * pi) + log10(sigma**2 / 2 * turn) - volume_dex(lights)
    if lights.zoom > 0:
        loose += log10(sqrt(2 * pi) * turn)
    for count in range(LEAST, total):
        if count * each + loose - log10(count + 1.0) >= ACCEPT_DEX:
            return count
    return total


@jit
def _glance(
    tangent: Floats,
    vectors_ref: Floats,
    cell_first: NDArray,
    cell_star: NDArray,
    side: int,
    R_ref_from_cam: Floats,
    zoom: float,
    gates: Floats,
    order: NDArray,
    wanted: int,
    patience: int,
) -> tuple[int, bool]:
    """How many lights were looked at, and whether as many as wanted have a star where an attitude puts them.

    The pair's two count.
    """
    count, left = 2, len(order)
    for step in range(left):
        if count + left - step < wanted or (step >= patience and count == 2):
            return step, False
        x, y, z = turned(R_ref_from_cam, ray(tangent, order[step], zoom))
        count += nearest(vectors_ref, cell_first, cell_star, side, x, y, z, gates[order[step]])[0] >= 0
        if count >= wanted:
            return step + 1, True
    return left, False
