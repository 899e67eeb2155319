"""Lost-in-space star identification by pair hypotheses and a Bayes factor: the default method.

A pair of detections and a pair of catalog stars with the same angular separation determine a candidate attitude. A
quick check counts how many of the other detections have a star at the predicted position; if enough do, the candidate
is fitted to the whole field and its Bayes factor is computed (`evidence.weigh`). Pairs that few catalog pairs can
match are tried first. The search ends at DECISIVE_DEX; a weaker candidate must have ACCEPT_DEX and beat every other
attitude by MARGIN_DEX.

If the focal length is uncertain, each pair hypothesis also determines it, from the ratio of the measured to the catalog
separation, and the rest of the field must confirm both.
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
    Detections,
    Hypothesis,
    Solution,
    area,
    evaluate,
    fixed,
    no_hypothesis,
    ray,
    share_at,
    turned,
    volume_dex,
)

# Least log10 Bayes factor of an accepted attitude. By Markov's inequality, random detections reach it in at most one of
# 10^5 frames. With 4, a mirrored sky was solved in one of 10^5 adversarial images
# (docs/findings/robustness.md); 5 loses two in a thousand of the hardest frames (python -m benchmarks.lost_in_space),
# 6 would lose twelve.
ACCEPT_DEX = 5.0
DECISIVE_DEX = 10.0  # evidence at which the search stops without looking for rivals
MARGIN_DEX = 3.0  # by which the solution must beat every other attitude
NO_RIVAL_DEX = ACCEPT_DEX - MARGIN_DEX  # below this an attitude is neither acceptable nor a rival
# Extra effort for finding rivals of an accepted attitude: multiple of the effort so far, plus a number of look-ups.
AGAIN, AGAIN_LEAST = 2, 2000
LONG = 0.2  # of the field size: shorter pairs determine the roll poorly and are tried last
MAG_GATE = 4.0  # greatest difference of magnitudes in the first round, in standard deviations
WEIGH_CHECKS = 6  # cost of one evaluation in units of one star look-up, so that frames without a solution end
PATIENCE = 4  # detections without a star after which the first round drops a candidate


@jit
def lost_in_space(
    lights: Detections, patterns: Sky, stars: Sky, base_lights: int, max_checks: int
) -> Solution:
    """Identify the detections and solve the attitude.

    The search uses the `base_lights` brightest detections and the pairs of `patterns`; the attitude found is then
    fitted to all detections and all `stars`. Returns an empty solution if the search finds nothing beyond chance, or
    if the full field keeps no more than half of its matches. max_checks bounds the effort (see `search`).
    """
    few = min(base_lights, len(lights.sigma))
    head = Detections(
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
        return fixed(lights, stars, no_hypothesis())
    gates = 1.5 * GATE * lights.sigma
    whole = evaluate(lights, stars, found.R_cam_from_ref.copy(), found.zoom, gates, -np.inf)
    if 2 * len(whole.observed) <= len(found.observed):
        return fixed(lights, stars, no_hypothesis())
    best = Hypothesis(
        whole.observed, whole.star, whole.R_cam_from_ref, whole.zoom, whole.info, max(whole.dex, found.dex)
    )
    return fixed(lights, stars, best)


@jit
def search(lights: Detections, sky: Sky, max_checks: int) -> Hypothesis:
    """The first attitude with DECISIVE_DEX of evidence; else the best one, if it passes ACCEPT_DEX and MARGIN_DEX.

    Detection pairs are tried in the order of the expected number of matching catalog pairs: short pairs (above LONG)
    and rare magnitudes first. Each attempt doubles the cost of its two detections, so that a false detection does not
    hold up the search. The first round drops a candidate after PATIENCE detections without a star and skips stars
    outside of the magnitude gate; the second round has neither limit, and is skipped if there are so few detections
    that PATIENCE covers them. After an attitude reaches ACCEPT_DEX the search continues for rivals, with AGAIN times
    the effort so far.
    max_checks : bound on the effort: star look-ups, plus WEIGH_CHECKS for each candidate evaluated
    """
    total = len(lights.sigma)
    length, rare = _lengths(lights), _rarity(lights, sky)
    best, rival_dex, checks, limit = no_hypothesis(), -np.inf, np.zeros(1, np.int64), max_checks
    for patience in (PATIENCE, total):
        tried = np.zeros((total, total), np.bool_)
        cost = rare.copy()
        for _ in range(total * (total - 1) // 2):
            a, b = _next(length, tried, cost)
            tried[a, b] = True
            guess = _attempt(lights, sky, a, b, patience, best, checks)
            same = _alike(guess, best)
            if guess.dex > best.dex:
                # The previous best becomes a rival unless it is the same attitude.
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
    return best if best.dex >= ACCEPT_DEX and best.dex - rival_dex >= MARGIN_DEX else no_hypothesis()


@jit
def _alike(one: Hypothesis, other: Hypothesis) -> bool:
    """Whether two hypotheses are the same attitude within 5.7 degrees (trace > 2.99); False if `other` is empty."""
    return other.dex > -np.inf and bool(np.sum(one.R_cam_from_ref * other.R_cam_from_ref) > 2.99)


@jit
def _lengths(lights: Detections) -> Floats:
    """(N, N) length in tangents of every pair a < b; pairs too short to determine the roll count as very long."""
    total, field = len(lights.sigma), lights.field
    long = LONG * sqrt((field[1] - field[0]) * (field[3] - field[2]))
    out = np.empty((total, total))
    for a in range(total):
        for b in range(a + 1, total):
            apart = sqrt(_apart2(lights.tangent, a, b))
            out[a, b] = apart if apart >= long else 1e3 * long * long / max(apart, 1e-9)
    return out


@jit
def _rarity(lights: Detections, sky: Sky) -> Floats:
    """(N,) fraction of the stars inside the magnitude gate of each detection; 1 if its magnitude is unknown."""
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
    """The untried pair a < b of the least cost length[a, b] * vain[a] * vain[b]."""
    best, at_a, at_b = np.inf, 0, 1
    for a in range(len(vain)):
        for b in range(a + 1, len(vain)):
            cost = length[a, b] * vain[a] * vain[b]
            if cost < best and not tried[a, b]:
                best, at_a, at_b = cost, a, b
    return at_a, at_b


@jit
def _attempt(
    lights: Detections, sky: Sky, a: int, b: int, patience: int, known: Hypothesis, checks: NDArray
) -> Hypothesis:
    """Test two detections against every catalog pair of the same separation, in both orders.

    Returns the first hypothesis with ACCEPT_DEX that is another attitude than `known`, else the best one. checks : (1,)
    effort so far, increased in place.
    """
    gates, order = _gates(lights, a, b), _others(len(lights.sigma), a, b)
    wanted = _wanted(lights, a, b)
    in_cam, in_ref, R_ref_from_cam = np.empty((3, 3)), np.empty((3, 3)), np.empty((3, 3))
    best, zoom = no_hypothesis(), 1.0
    at_a, at_b = ray(lights.tangent, a, 1.0), ray(lights.tangent, b, 1.0)
    chord = vectors.chord(at_a, at_b)
    vectors.axes(at_a, at_b, in_cam)
    gate = GATE * sqrt(lights.sigma[a] ** 2 + lights.sigma[b] ** 2)
    angle = 2 * np.arcsin(min(chord / 2, 1.0))
    last = len(sky.first) - 2
    low = cell_of((angle / (1 + lights.zoom) - gate) / sky.bin_rad, last + 1)
    high = cell_of((angle / (1 - lights.zoom) + gate) / sky.bin_rad, last)
    # Tuple members are unpacked here: in the loop each access would cost two updates of a reference count.
    tangent, first, pair, star, mag = lights.tangent, sky.first, sky.pair, sky.vectors, sky.mag
    cell_first, cell_star, side, zooms = sky.cell_first, sky.cell_star, sky.side, lights.zoom
    mag_a, mag_b = lights.mag[a], lights.mag[b]
    mag_gate = MAG_GATE * lights.mag_sigma if patience == PATIENCE else np.inf
    for p in range(first[low], first[high + 1]):
        i, j = pair[p, 0], pair[p, 1]
        # Written with `not ... >`, so that an unknown magnitude (NaN) passes.
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
                    guess = evaluate(lights, sky, R_ref_from_cam.T.copy(), zoom, gates, NO_RIVAL_DEX)
                    if guess.dex >= ACCEPT_DEX and not _alike(guess, known):
                        return guess
                    if guess.dex > best.dex:
                        best = guess
            for k in range(3):  # the star pair in reverse order: a half turn about its first axis
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
    """The zoom at which the chord between two detections is `wanted`: two fixed-point iterations from its ratio."""
    zoom = chord / wanted
    for _ in range(2):
        zoom *= vectors.chord(ray(tangent, a, zoom), ray(tangent, b, zoom)) / wanted
    return zoom


@jit
def _gates(lights: Detections, a: int, b: int) -> Floats:
    """(N,) matching radius of each detection at a pair's attitude: its own error and that of the attitude.

    The variance of the pair's midpoint is (sa^2 + sb^2) / 4; that of its direction, and of its relative length, is
    (sa^2 + sb^2) / separation^2 and grows with the squared distance from the midpoint.
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
def _wanted(lights: Detections, a: int, b: int) -> int:
    """Least number of matches that can reach ACCEPT_DEX, from an estimate of the greatest `_evidence`.

    The estimate has no residuals, no missing stars, and the attitude uncertainty of the pair alone: sqrt(2) sigma /
    separation about the boresight (and of the zoom), sigma / sqrt(2) across it. It takes the least sigma of all
    detections, isotropic errors, a constant density of detections and no magnitudes.
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
    """Quick check of an attitude: how many detections were looked up, and whether `wanted` of them have a star nearby.

    The two detections of the pair count as matched. Stops as soon as the count is reached or out of reach, or after
    `patience` detections without any match.
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
