"""Lost-in-space star identification by pair hypotheses and a Bayes factor: the default method.

A pair of detections and a pair of catalog stars with the same angular separation determine a candidate attitude. A
quick check counts how many of the other detections have a star at the predicted position; if enough do, the candidate
is fitted to the whole field and its Bayes factor is computed (`evidence.evaluate`). Pairs that few catalog pairs can
match are tried first. The search ends at DECISIVE_DEX; a weaker candidate must have ACCEPT_DEX and beat every other
attitude by MARGIN_DEX.

If the focal length is uncertain, each pair hypothesis also determines it, from the ratio of the measured to the catalog
separation, and the rest of the field must confirm both.
"""

from __future__ import annotations

from math import log10, pi, sqrt

import numpy as np
from numpy.typing import NDArray

from estimator.catalog.sky_index import SkyIndex, cell_of, nearest
from estimator.core import vectors
from estimator.core.checks import Floats
from estimator.core.jit import jit
from estimator.identification.chance import (
    ACCEPT_DEX,
    GATE_SIGMA,
    SHORT_PAIR,
    least,
    middle,
    required_matches,
    separation,
    squared_separation,
)
from estimator.identification.star_detections import Detections, changed, field_area, gates_of, ray
from estimator.identification.star_evidence import (
    Hypothesis,
    Solution,
    build_solution,
    evaluate,
    focal_gain_dex,
    magnitude_density,
    no_hypothesis,
    prior_volume_dex,
)

DECISIVE_DEX = 10.0  # evidence at which the search stops without looking for rivals
MARGIN_DEX = 3.0  # by which the solution must beat every other attitude
NO_RIVAL_DEX = ACCEPT_DEX - MARGIN_DEX  # below this an attitude is neither acceptable nor a rival
# Extra effort for finding rivals of an accepted attitude: multiple of the effort so far, plus a number of look-ups.
RIVAL_EFFORT = 2
MIN_RIVAL_EFFORT = 2000
MAG_GATE_SIGMA = 4.0  # greatest difference of magnitudes in the first round, in standard deviations
EVALUATION_COST = (
    6  # of one evaluation in units of one star look-up, so that frames without a solution end
)
FEW = 20  # number of detections of the first search
# fractions of the effort: of the first search at first, and of the second
SHORT_EFFORT = 1 / 16
MANY_EFFORT = 1 / 4
WRONG_FOCAL = 0.05  # greatest relative error of a calibrated focal length that is found
WRONG_FOCAL_DEX = 2.0  # evidence by which another focal length must beat the calibrated one
FREE_DEX = 1.0  # gain of a free focal length with the same matches below which the field is not matched with it
MAX_MISSES = 4  # detections without a star after which the first round drops a candidate


@jit
def lost_in_space(
    detections: Detections, stars: SkyIndex, max_detections: int, max_checks: int
) -> Solution:
    """Identify the detections and solve the attitude.

    The search uses the FEW brightest detections and, if it fails, the `max_detections` brightest, with the pairs of
    `stars`: a few bright stars among many faint false lights are found by the first, stars among brighter false
    lights by the second. The first is short; it is repeated with the whole effort if the second fails too. Each of the
    two must have twice the evidence, so that together they accept a chance match as rarely as one. The attitude found
    is then fitted to all detections. Returns an empty solution if the search finds nothing beyond
    chance, or if the full field keeps no more than half of its matches.

    Parameters
    ----------
    max_checks
        Bound on the effort (see `search`)
    """
    few = min(FEW, max_detections, len(detections.sigma))
    many = min(max_detections, len(detections.sigma))
    if many == few:
        accept_dex = ACCEPT_DEX
        candidate = search(
            changed(detections, few, 1.0, detections.focal_uncertainty), stars, max_checks
        )
    else:
        accept_dex = ACCEPT_DEX + log10(2.0)
        for count, effort in ((few, SHORT_EFFORT), (many, MANY_EFFORT), (few, 1.0)):
            searched = changed(detections, count, 1.0, detections.focal_uncertainty)
            candidate = search(searched, stars, int(effort * max_checks))
            if candidate.dex >= accept_dex:
                break
    calibrated = detections.focal_uncertainty == 0
    free = (
        changed(detections, len(detections.sigma), 1.0, WRONG_FOCAL) if calibrated else detections
    )
    return fit_to_all(free, stars, candidate, accept_dex, calibrated, few == len(detections.sigma))


@jit
def fit_to_all(
    detections: Detections,
    stars: SkyIndex,
    candidate: Hypothesis,
    accept_dex: float,
    calibrated: bool,
    whole: bool,
) -> Solution:
    """Fit a candidate of some detections to all of them and all stars.

    Of a calibrated camera it is fitted with the calibrated focal length and with a free one. The calibrated one is kept
    unless the other has WRONG_FOCAL_DEX more evidence: with a wrong focal length a part of the stars may still match,
    at a wrong attitude. The solution is empty if the candidate has less than `accept_dex`, if it keeps no more than
    half of its matches, or if all detections together are not beyond chance.

    Parameters
    ----------
    detections
        With the focal uncertainty of the free fit
    whole
        Whether the candidate is the calibrated fit to all detections already
    """
    chosen = detections
    full = no_hypothesis()
    gates = gates_of(detections, 1.5)
    R = candidate.R_cam_from_ref
    ratio = candidate.focal_ratio
    found = candidate.dex >= accept_dex
    free = True
    if found and calibrated:
        chosen = changed(detections, len(detections.sigma), 1.0, 0.0)
        full = candidate if whole else evaluate(chosen, stars, R.copy(), 1.0, gates, -np.inf)
        # If all detections match there is none that another focal length could match.
        free = len(full.star) < len(gates) or focal_gain_dex(detections, stars, full) >= FREE_DEX
    if found and free:
        fitted = evaluate(detections, stars, R.copy(), ratio, gates, -np.inf)
        if not calibrated or fitted.dex > full.dex + WRONG_FOCAL_DEX:
            chosen = detections
            full = fitted
    if not found or 2 * len(full.observed) <= len(candidate.observed) or full.dex < ACCEPT_DEX:
        return build_solution(chosen, stars, no_hypothesis())
    dex = max(full.dex, candidate.dex)
    best = Hypothesis(
        full.observed, full.star, full.R_cam_from_ref, full.focal_ratio, full.info, dex
    )
    return build_solution(chosen, stars, best)


@jit
def search(detections: Detections, sky: SkyIndex, max_checks: int) -> Hypothesis:
    """The first attitude with DECISIVE_DEX of evidence; else the best one, if it passes ACCEPT_DEX and MARGIN_DEX.

    Detection pairs are tried in the order of the expected number of matching catalog pairs: short pairs (above
    SHORT_PAIR) and rare magnitudes first. Each attempt doubles the cost of its two detections, so that a false
    detection does not hold up the search. The first round drops a candidate after MAX_MISSES detections without a star
    and skips stars outside of the magnitude gate; the second round has neither limit, and is skipped if there are so
    few detections that MAX_MISSES covers them. Every attempt checks its candidates at another MAX_MISSES detections
    first: a fixed order would drop every true candidate of a frame in which these are all false. After an attitude
    reaches ACCEPT_DEX the search continues for rivals, with RIVAL_EFFORT times the effort so far.

    Parameters
    ----------
    max_checks
        Bound on the effort: star look-ups, plus EVALUATION_COST for each candidate evaluated
    """
    total = len(detections.sigma)
    length = _pair_lengths(detections)
    rarity = _rarity(detections, sky)
    best = no_hypothesis()
    rival_dex = -np.inf
    checks = np.zeros(1, np.int64)
    limit = max_checks
    for max_misses in (MAX_MISSES, total):
        tried = np.zeros((total, total), np.bool_)
        cost = rarity.copy()
        for attempt in range(total * (total - 1) // 2):
            a, b = _next_pair(length, tried, cost)
            tried[a, b] = True
            candidate = _test_pair(
                detections, sky, a, b, attempt * MAX_MISSES, max_misses, best, checks
            )
            same = _same_attitude(candidate, best)
            if candidate.dex > best.dex:
                # The previous best becomes a rival unless it is the same attitude.
                rival_dex = rival_dex if same else max(rival_dex, best.dex)
                if best.dex < ACCEPT_DEX <= candidate.dex:
                    limit = min(max_checks, (1 + RIVAL_EFFORT) * checks[0] + MIN_RIVAL_EFFORT)
                best = candidate
            elif not same:
                rival_dex = max(rival_dex, candidate.dex)
            if best.dex >= DECISIVE_DEX:
                return best
            cost[a] *= 2
            cost[b] *= 2
            if checks[0] > limit:
                break
        if checks[0] > limit or total - 2 <= MAX_MISSES:
            break
    return (
        best if best.dex >= ACCEPT_DEX and best.dex - rival_dex >= MARGIN_DEX else no_hypothesis()
    )


@jit
def _same_attitude(first: Hypothesis, second: Hypothesis) -> bool:
    """Whether two hypotheses are the same attitude within 5.7 degrees (trace > 2.99); False if `second` is empty."""
    trace = 0.0
    for i in range(3):
        for j in range(3):
            trace += first.R_cam_from_ref[i, j] * second.R_cam_from_ref[i, j]
    return second.dex > -np.inf and trace > 2.99


@jit
def _pair_lengths(detections: Detections) -> Floats:
    """(N, N) length in tangents of every pair a < b; pairs too short to determine the roll count as very long."""
    total = len(detections.sigma)
    field = detections.field
    min_length = SHORT_PAIR * sqrt((field[1] - field[0]) * (field[3] - field[2]))
    out = np.empty((total, total))
    for a in range(total):
        for b in range(a + 1, total):
            length = separation(detections.tangent, a, b)
            out[a, b] = (
                length
                if length >= min_length
                else 1e3 * min_length * min_length / max(length, 1e-9)
            )
    return out


@jit
def _rarity(detections: Detections, sky: SkyIndex) -> Floats:
    """(N,) fraction of the stars inside the magnitude gate of each detection; 1 if its magnitude is unknown."""
    out = np.ones(len(detections.sigma))
    for n in range(len(out)):
        if np.isfinite(detections.mag[n]):
            density = magnitude_density(sky, detections.mag[n])
            out[n] = min(2 * MAG_GATE_SIGMA * detections.mag_sigma * density + 1e-3, 1.0)
    return out


@jit
def _next_pair(length: Floats, tried: NDArray, weight: Floats) -> tuple[int, int]:
    """The untried pair a < b of the least cost length[a, b] * weight[a] * weight[b]."""
    best = np.inf
    best_a = 0
    best_b = 1
    for a in range(len(weight)):
        for b in range(a + 1, len(weight)):
            cost = length[a, b] * weight[a] * weight[b]
            if cost < best and not tried[a, b]:
                best = cost
                best_a = a
                best_b = b
    return best_a, best_b


@jit
def _test_pair(
    detections: Detections,
    sky: SkyIndex,
    a: int,
    b: int,
    start: int,
    max_misses: int,
    previous: Hypothesis,
    checks: NDArray,
) -> Hypothesis:
    """Test two detections against every catalog pair of the same separation, in both orders.

    Returns the first hypothesis with ACCEPT_DEX that is another attitude than `previous`, else the best one.

    Parameters
    ----------
    start
        The other detections are looked up from this one on
    checks
        (1,) effort so far, increased in place
    """
    gates, order, required = trial(detections, a, b, start, ACCEPT_DEX)
    in_cam = np.empty((3, 3))
    in_ref = np.empty((3, 3))
    R_ref_from_cam = np.empty((3, 3))
    best = no_hypothesis()
    focal_ratio = 1.0
    begin, end, chord, gate = _pair_range(detections, sky, a, b)
    # Tuple members are unpacked here: in the loop each access would cost two updates of a reference count.
    tangent = detections.tangent
    focal_uncertainty = detections.focal_uncertainty
    pair = sky.pair
    star = sky.vectors
    mag = sky.mag
    grid = (sky.cell_first, sky.cell_star, sky.side)
    vectors.pair_frame(ray(tangent, a, 1.0), ray(tangent, b, 1.0), in_cam)
    mag_a = detections.mag[a]
    mag_b = detections.mag[b]
    mag_gate = MAG_GATE_SIGMA * detections.mag_sigma if max_misses == MAX_MISSES else np.inf
    for p in range(begin, end):
        i = pair[p, 0]
        j = pair[p, 1]
        forward = _alike(mag_a - mag[i], mag_b - mag[j], mag_gate)
        backward = _alike(mag_a - mag[j], mag_b - mag[i], mag_gate)
        if not (forward or backward):
            continue
        star_i = vectors.row(star, i)
        star_j = vectors.row(star, j)
        catalog_chord = vectors.chord(star_i, star_j)
        if focal_uncertainty > 0:
            focal_ratio = fit_focal_ratio(tangent, a, b, chord, catalog_chord)
            if abs(focal_ratio - 1) > focal_uncertainty:
                continue
            vectors.pair_frame(ray(tangent, a, focal_ratio), ray(tangent, b, focal_ratio), in_cam)
        elif abs(catalog_chord - chord) > gate:
            continue
        vectors.pair_frame(star_i, star_j, in_ref)
        for flip in range(2):
            if flip:  # the star pair in reverse order: a half turn about its first axis
                for k in range(3):
                    in_ref[k, 1], in_ref[k, 2] = -in_ref[k, 1], -in_ref[k, 2]
            if not (backward if flip else forward):
                continue
            vectors.multiply_transposed(in_ref, in_cam, R_ref_from_cam)
            lookups, fits = quick_check(
                tangent,
                star,
                *grid,
                R_ref_from_cam,
                focal_ratio,
                gates,
                order,
                required,
                max_misses,
            )
            checks[0] += 1 + lookups
            if fits:
                checks[0] += EVALUATION_COST
                candidate = evaluate(
                    detections, sky, R_ref_from_cam.T.copy(), focal_ratio, gates, NO_RIVAL_DEX
                )
                if candidate.dex >= ACCEPT_DEX and not _same_attitude(candidate, previous):
                    return candidate
                best = candidate if candidate.dex > best.dex else best
    return best


@jit
def trial(
    detections: Detections, a: int, b: int, start: int, min_dex: float
) -> tuple[Floats, NDArray[np.int64], int]:
    """What a quick check of an attitude by two detections takes: gates, the other detections, and matches required.

    Parameters
    ----------
    start
        The other detections are looked up from this one on
    min_dex
        Least evidence of interest
    """
    gates = pair_gates(detections, a, b)
    order = other_detections(len(detections.sigma), a, b, start)
    pair_dex = attitude_dex(detections, a, b)
    return (
        gates,
        order,
        required_matches(detections.sigma, field_area(detections), pair_dex, min_dex),
    )


@jit
def _alike(difference_a: float, difference_b: float, gate: float) -> bool:
    """Whether two differences of magnitudes are together within a gate; an unknown magnitude (NaN) passes."""
    return not difference_a * difference_a + difference_b * difference_b > gate * gate


@jit
def _pair_range(
    detections: Detections, sky: SkyIndex, a: int, b: int
) -> tuple[int, int, float, float]:
    """Half-open range of catalog pairs that two detections may be; their chord, and the gate of their angle, rad."""
    chord = vectors.chord(ray(detections.tangent, a, 1.0), ray(detections.tangent, b, 1.0))
    gate = GATE_SIGMA * sqrt(detections.sigma[a] ** 2 + detections.sigma[b] ** 2)
    angle = 2 * np.arcsin(min(chord / 2, 1.0))
    last = len(sky.first) - 2
    low = cell_of((angle / (1 + detections.focal_uncertainty) - gate) / sky.bin_rad, last + 1)
    high = cell_of((angle / (1 - detections.focal_uncertainty) + gate) / sky.bin_rad, last)
    return sky.first[low], sky.first[high + 1], chord, gate


@jit
def other_detections(total: int, a: int, b: int, start: int) -> NDArray[np.int64]:
    """(N - 2,) all detections but a and b, from number `start` on and around."""
    out = np.empty(total, np.int64)
    count = 0
    for step in range(total):
        n = (start + step) % total
        if n not in (a, b):
            out[count] = n
            count += 1
    return out[:count]


@jit
def fit_focal_ratio(tangent: Floats, a: int, b: int, chord: float, target: float) -> float:
    """The focal ratio at which the chord between two detections is `target`, by two fixed-point iterations."""
    focal_ratio = chord / target
    for _ in range(2):
        focal_ratio *= (
            vectors.chord(ray(tangent, a, focal_ratio), ray(tangent, b, focal_ratio)) / target
        )
    return focal_ratio


@jit
def pair_gates(detections: Detections, a: int, b: int) -> Floats:
    """(N,) matching radius of each detection at a pair's attitude: its own error and that of the attitude.

    The variance of the pair's midpoint is (sa^2 + sb^2) / 4; that of its direction, and of its relative length, is
    (sa^2 + sb^2) / separation^2 and grows with the squared distance from the midpoint.
    """
    tangent = detections.tangent
    x, y = middle(tangent, a, b)
    pair_variance = detections.sigma[a] ** 2 + detections.sigma[b] ** 2
    direction_variance = pair_variance / squared_separation(tangent, a, b)
    out = np.empty(len(detections.sigma))
    for n in range(len(out)):
        distance2 = (tangent[n, 0] - x) ** 2 + (tangent[n, 1] - y) ** 2
        out[n] = GATE_SIGMA * sqrt(
            detections.sigma[n] ** 2 + pair_variance / 4 + direction_variance * distance2
        )
    return out


@jit
def attitude_dex(detections: Detections, a: int, b: int) -> float:
    """Contribution of a pair's attitude alone to the evidence, for `required_matches`.

    The uncertainty is sqrt(2) sigma / separation about the boresight (and of the focal ratio), sigma / sqrt(2) across
    it, with the least sigma of all detections and isotropic errors.
    """
    sigma = least(detections.sigma)
    direction_sigma = sqrt(2.0) * sigma / separation(detections.tangent, a, b)
    dex = 1.5 * log10(2 * pi) + log10(sigma**2 / 2 * direction_sigma) - prior_volume_dex(detections)
    if detections.focal_uncertainty > 0:
        dex += log10(sqrt(2 * pi) * direction_sigma)
    return dex


@jit
def quick_check(
    tangent: Floats,
    vectors_ref: Floats,
    cell_first: NDArray,
    cell_star: NDArray,
    side: int,
    R_ref_from_cam: Floats,
    focal_ratio: float,
    gates: Floats,
    order: NDArray,
    required: int,
    max_misses: int,
) -> tuple[int, bool]:
    """Quick check of an attitude: number of detections looked up, and whether `required` of them have a star nearby.

    The two detections of the pair count as matched. Stops as soon as the count is reached or out of reach, or after
    `max_misses` detections without any match.
    """
    count = 2
    remaining = len(order)
    for step in range(remaining):
        if count + remaining - step < required or (step >= max_misses and count == 2):
            return step, False
        x, y, z = vectors.rotate(R_ref_from_cam, ray(tangent, order[step], focal_ratio))
        count += (
            nearest(vectors_ref, cell_first, cell_star, side, x, y, z, gates[order[step]])[0] >= 0
        )
        if count >= required:
            return step + 1, True
    return remaining, False
