"""Lost-in-space star identification by pair hypotheses and a Bayes factor: the default method.

Two detections and two catalog stars with the same angular separation determine an attitude. If it is the true one, the
other detections have catalog stars at their predicted directions. A quick check counts these stars. The Bayes factor
(`star_evidence`) then decides whether chance could have placed them there. If the focal length is uncertain, each pair
also determines it, from the ratio of the measured to the catalog separation, and the other detections must confirm
both.

The steps; the same numbers return as comments in the code:

1. Choose up to `max_detections` detections, the brightest of each part of the field (`star_detections.spread`).
2. Take the pair of detections that the fewest catalog pairs are expected to match (`search`).
3. Look up the catalog pairs of the same separation within GATE_SIGMA (`_pair_range`).
4. For each catalog pair, in both orders (`_test_pair`):
   reject it by its magnitudes and its separation, and compute the focal ratio and the attitude.
5. Quick check: look up the other detections, until enough of them or too few have a star nearby (`star_check`).
6. Match all detections, fit the attitude and compute its Bayes factor (`star_evidence.evaluate`).
7. Stop at DECISIVE_DEX. From ACCEPT_DEX on, continue only to find rivals, with limited effort (`search`).
8. Accept an attitude that passes ACCEPT_DEX and beats every other one by MARGIN_DEX (`search`).
9. Fit the attitude to all detections, with the calibrated and with a free focal length (`fit_to_all`).

Steps 2 to 7 are repeated with less strict quick checks if they find nothing.
Angles in the image are tangents; `ref` is the frame of the catalog's vectors.
"""

from math import hypot, pi, sqrt

import numpy as np
from numpy.typing import NDArray

from estimator.catalog.sky_index import SkyIndex, cell_of, magnitude_density
from estimator.core import vectors
from estimator.core.checks import Floats
from estimator.core.jit import jit
from estimator.identification.chance import (
    ACCEPT_DEX,
    GATE_SIGMA,
    least,
    separation,
)
from estimator.identification.star_check import quick_check, trial
from estimator.identification.star_detections import (
    Detections,
    changed,
    chosen,
    field_area,
    gates_of,
    ray,
    spread,
)
from estimator.identification.star_evidence import (
    FOCAL_MARGIN,
    Hypothesis,
    Solution,
    build_solution,
    evaluate,
    focal_gain_dex,
    no_hypothesis,
)

DECISIVE_DEX = 10.0  # evidence at which the search stops without looking for rivals
MARGIN_DEX = 3.0  # by which the solution must beat every other attitude
NO_RIVAL_DEX = (
    ACCEPT_DEX - MARGIN_DEX
)  # below this an attitude is neither acceptable nor a rival
# Effort to find rivals of an accepted attitude: a multiple of the effort so far, plus a number of star look-ups.
RIVAL_EFFORT = 2
MIN_RIVAL_EFFORT = 2000
MAG_GATE_SIGMA = (
    4.0  # greatest difference of magnitudes in the first round, in standard deviations
)
# Cost of an evaluation in star look-ups. It is part of the effort, so that frames without a solution end in time.
EVALUATION_COST = 6
SHORTEST = 0.04  # of the field's size: shorter pairs are tried last
# The star of detection r is one of the RANK_MARGIN + RANK_FACTOR r brightest per field.
RANK_MARGIN = 8
RANK_FACTOR = 3
WRONG_FOCAL = (
    0.05  # greatest relative error of a calibrated focal length that step 9 can find
)
WRONG_FOCAL_DEX = 2.0  # evidence by which another focal length must beat the calibrated one
FREE_DEX = (
    1.0  # least gain by a free focal length, with the same matches, for which it is tried
)
MAX_MISSES = 4  # detections without a star after which the first round drops a candidate


@jit
def lost_in_space(
    detections: Detections, stars: SkyIndex, max_detections: int, max_checks: int
) -> Solution:
    """Identify the detections and solve the attitude: the whole search (see the module's steps).

    Parameters
    ----------
    detections
        All detections of the frame, brightest first
    stars
        The catalog's stars and pairs
    max_detections
        Greatest number of detections to search with
    max_checks
        Bound on the effort (see `search`)

    Returns
    -------
    Solution
        Empty if the search finds nothing beyond chance, or if all detections together do not confirm what it finds
    """
    # 1. Choose the detections to search with.
    total = len(detections.sigma)
    searched = chosen(
        detections, spread(detections.tangent, detections.field, max_detections)
    )
    # 2. to 8. The search.
    candidate = search(searched, stars, max_checks)
    # 9. Fit to all detections. A calibrated camera may be wrong by up to WRONG_FOCAL.
    calibrated = detections.focal_uncertainty == 0
    free = changed(detections, total, 1.0, WRONG_FOCAL) if calibrated else detections
    return fit_to_all(free, stars, candidate, ACCEPT_DEX, calibrated, max_detections >= total)


@jit
def search(detections: Detections, sky: SkyIndex, max_checks: int) -> Hypothesis:
    """Steps 2 to 8: search one set of detections for the attitude.

    Pairs of detections are tried in passes. A pass tries the pairs whose cost is below a limit, and the limit doubles
    with each pass. The cost is `_pair_costs`, doubled for each earlier attempt with either detection, so that a false
    detection does not hold up the search.

    The first round drops a candidate after a few detections without a star, one at first and MAX_MISSES later, and
    skips stars outside of the magnitude gate or too faint for the detection's rank (`_faintest_stars`). The second
    round has none of these limits.

    Parameters
    ----------
    max_checks
        Bound on the effort: star look-ups, plus EVALUATION_COST for each candidate evaluated

    Returns
    -------
    Hypothesis
        The first one with DECISIVE_DEX, or else the best if it passes ACCEPT_DEX and MARGIN_DEX, or else the empty one
    """
    total = len(detections.sigma)
    pairs = total * (total - 1) // 2
    cost = _pair_costs(detections, sky)
    best = no_hypothesis()
    rival_dex = -np.inf
    checks = np.zeros(1, np.int64)
    limit = max_checks
    for strict in (True, False):
        faintest = _faintest_stars(detections, sky, strict)
        tried = np.zeros((total, total), np.bool_)
        weight = np.ones(total)
        max_cost = 2 * least(cost.ravel())
        attempt = 0
        while attempt < pairs and checks[0] <= limit:
            for a in range(total):
                for b in range(a + 1, total):
                    # 2. The untried pairs of detections of least cost.
                    if (
                        cost[a, b] * weight[a] * weight[b] > max_cost
                        or tried[a, b]
                        or checks[0] > limit
                    ):
                        continue
                    tried[a, b] = True
                    weight[a] *= 2
                    weight[b] *= 2
                    # 3. to 6. Test the pair.
                    misses = min(1 + attempt // 4, MAX_MISSES) if strict else total
                    attempt += 1
                    candidate = _test_pair(
                        detections, sky, a, b, misses, faintest, best, checks
                    )
                    same = _same_attitude(candidate, best)
                    if candidate.dex > best.dex:
                        # The previous best becomes a rival unless it is the same attitude.
                        rival_dex = rival_dex if same else max(rival_dex, best.dex)
                        if best.dex < ACCEPT_DEX <= candidate.dex:
                            limit = min(
                                max_checks, (1 + RIVAL_EFFORT) * checks[0] + MIN_RIVAL_EFFORT
                            )
                        best = candidate
                    elif not same:
                        rival_dex = max(rival_dex, candidate.dex)
                    # 7. A decisive attitude needs no search for rivals.
                    if best.dex >= DECISIVE_DEX:
                        return best
            max_cost *= 2
    # 8. A weaker attitude must be significant, and clearly better than any other.
    if best.dex >= ACCEPT_DEX and best.dex - rival_dex >= MARGIN_DEX:
        return best
    return no_hypothesis()


@jit
def _same_attitude(first: Hypothesis, second: Hypothesis) -> bool:
    """Whether two hypotheses have the same attitude within 5.7 degrees; False if `second` is empty.

    The trace of R1^T R2 is 1 + 2 cos(angle): 2.99 for 5.7 degrees.
    """
    trace = 0.0
    # trace(R1^T R2) = sum of the products of the elements.
    for i in range(3):
        for j in range(3):
            trace += first.R_cam_from_ref[i, j] * second.R_cam_from_ref[i, j]
    return second.dex > -np.inf and trace > 2.99


@jit
def _pair_costs(detections: Detections, sky: SkyIndex) -> Floats:
    """Costs of all pairs of detections, for the order of the search.

        cost = s_ab sqrt(sa^2 + sb^2) f_a f_b c_a c_b

    The expected number of catalog pairs in a gate grows with the separation s_ab, with the width of the gate, and with
    the fractions f of the catalog's stars that the magnitudes allow. A detection among c others within SHORTEST of the
    field is less probably a star the more there are: c + 1 counts clumps of false lights as one. A pair shorter than
    SHORTEST of the field hardly determines the roll: it is given a separation beyond all others, the greater the
    shorter it is.

    Returns
    -------
    Floats
        (N, N) costs for a < b; infinite elsewhere
    """
    total = len(detections.sigma)
    min_length = SHORTEST * sqrt(field_area(detections))
    weight = np.ones(total)
    out = np.full((total, total), np.inf)
    for a in range(total):
        for b in range(a + 1, total):
            length = separation(detections.tangent, a, b)
            # A short pair comes after all others.
            if length < min_length:
                weight[a] += 1
                weight[b] += 1
                length = 1e3 * min_length * min_length / max(length, 1e-9)
            out[a, b] = length * hypot(detections.sigma[a], detections.sigma[b])
    for n in range(total):
        if np.isfinite(detections.mag[n]):
            # The gate's full width times the density of magnitudes; the small constant keeps every cost above 0.
            density = magnitude_density(sky, detections.mag[n])
            weight[n] *= min(2 * MAG_GATE_SIGMA * detections.mag_sigma * density + 1e-3, 1.0)
    for a in range(total):
        for b in range(a + 1, total):
            out[a, b] *= weight[a] * weight[b]
    return out


@jit
def _faintest_stars(detections: Detections, sky: SkyIndex, strict: bool) -> NDArray:
    """(N,) row of the faintest star that each detection may be: the catalog's stars are sorted by brightness, too.

    False detections only increase the rank of a star among the detections, brightest first. The star of the detection
    r, from 0, is therefore not much fainter than the r brightest stars of a field. RANK_FACTOR allows for fields with
    fewer stars than the mean, RANK_MARGIN for the scatter of counts and magnitudes. Without `strict`, any star.
    """
    out = np.full(len(detections.sigma), len(sky.vectors))
    if strict:
        fields = 4 * pi / field_area(detections)
        for n in range(len(out)):
            out[n] = int(min((RANK_MARGIN + RANK_FACTOR * n) * fields, 1e9))
    return out


@jit
def _test_pair(
    detections: Detections,
    sky: SkyIndex,
    a: int,
    b: int,
    max_misses: int,
    faintest: NDArray,
    previous: Hypothesis,
    checks: NDArray,
) -> Hypothesis:
    """Steps 3 to 6: test two detections against every catalog pair of the same separation, in both orders.

    Parameters
    ----------
    a, b
        Rows of the two detections
    max_misses
        The quick check drops a candidate after this many detections without a star
    faintest
        (N,) row of the faintest star that each detection may be
    previous
        Best hypothesis so far
    checks
        (1,) effort so far, increased in place

    Returns
    -------
    Hypothesis
        The first one with ACCEPT_DEX whose attitude is not that of `previous`, or else the best one
    """
    gates, order, required = trial(detections, a, b, ACCEPT_DEX)
    in_cam = np.empty((3, 3))
    in_ref = np.empty((3, 3))
    R_ref_from_cam = np.empty((3, 3))
    best = no_hypothesis()
    focal_ratio = 1.0
    # 3. Catalog pairs of the same separation.
    begin, end, chord, gate = _pair_range(detections, sky, a, b)
    # Tuple members are unpacked here: in the loop each access would cost two updates of a reference count.
    tangent = detections.tangent
    focal_uncertainty = FOCAL_MARGIN * detections.focal_uncertainty
    pair = sky.pair
    star = sky.vectors
    mag = sky.mag
    grid = (sky.cell_first, sky.cell_star, sky.side)
    vectors.pair_frame(ray(tangent, a, 1.0), ray(tangent, b, 1.0), in_cam)
    mag_a = detections.mag[a]
    mag_b = detections.mag[b]
    last_a = faintest[a]
    last_b = faintest[b]
    mag_gate = MAG_GATE_SIGMA * detections.mag_sigma if max_misses <= MAX_MISSES else np.inf
    # 4. Candidate attitudes.
    for p in range(begin, end):
        i = pair[p, 0]
        j = pair[p, 1]
        # 4a. Compare ranks and magnitudes first: this needs no geometry.
        forward = i <= last_a and j <= last_b
        backward = j <= last_a and i <= last_b
        forward = forward and _alike(mag_a - mag[i], mag_b - mag[j], mag_gate)
        backward = backward and _alike(mag_a - mag[j], mag_b - mag[i], mag_gate)
        if not (forward or backward):
            continue
        star_i = vectors.row(star, i)
        star_j = vectors.row(star, j)
        catalog_chord = vectors.chord(star_i, star_j)
        # 4b. An uncertain focal length follows from the separations; else the separations must agree.
        if focal_uncertainty > 0:
            focal_ratio = fit_focal_ratio(tangent, a, b, chord, catalog_chord)
            if abs(focal_ratio - 1) > focal_uncertainty:
                continue
            vectors.pair_frame(
                ray(tangent, a, focal_ratio), ray(tangent, b, focal_ratio), in_cam
            )
        elif abs(catalog_chord - chord) > gate:
            continue
        vectors.pair_frame(star_i, star_j, in_ref)
        for flip in range(2):
            if flip:
                # The star pair in reverse order: a half turn about its bisector, the first axis.
                for k in range(3):
                    in_ref[k, 1] = -in_ref[k, 1]
                    in_ref[k, 2] = -in_ref[k, 2]
            if not (backward if flip else forward):
                continue
            # 4c. The attitude turns the axes of the detections into those of the stars.
            vectors.multiply_transposed(in_ref, in_cam, R_ref_from_cam)
            # 5. Quick check.
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
                # 6. Evidence. Below NO_RIVAL_DEX the candidate is neither acceptable nor a rival.
                checks[0] += EVALUATION_COST
                candidate = evaluate(
                    detections, sky, R_ref_from_cam.T.copy(), focal_ratio, gates, NO_RIVAL_DEX
                )
                if candidate.dex >= ACCEPT_DEX and not _same_attitude(candidate, previous):
                    return candidate
                best = candidate if candidate.dex > best.dex else best
    return best


@jit
def _alike(difference_a: float, difference_b: float, gate: float) -> bool:
    """Whether two differences of magnitudes are together within a gate; an unknown magnitude (NaN) passes."""
    return not difference_a * difference_a + difference_b * difference_b > gate * gate


@jit
def _pair_range(
    detections: Detections, sky: SkyIndex, a: int, b: int
) -> tuple[int, int, float, float]:
    """Step 3: the catalog pairs whose separation two detections may have.

    The gate is GATE_SIGMA sqrt(sa^2 + sb^2). A focal length that is uncertain by the fraction u, with FOCAL_MARGIN,
    widens the range of angles to angle / (1 + u) .. angle / (1 - u).

    Returns
    -------
    begin, end
        Half-open range of rows of `sky.pair`
    chord
        Chord between the two rays
    gate
        Greatest difference of the separations, rad
    """
    chord = vectors.chord(ray(detections.tangent, a, 1.0), ray(detections.tangent, b, 1.0))
    gate = GATE_SIGMA * sqrt(detections.sigma[a] ** 2 + detections.sigma[b] ** 2)
    angle = 2 * np.arcsin(min(chord / 2, 1.0))
    # Cell k of the index holds the angles from k to k + 1 times bin_rad.
    last = len(sky.first) - 2
    uncertainty = FOCAL_MARGIN * detections.focal_uncertainty
    low = cell_of((angle / (1 + uncertainty) - gate) / sky.bin_rad, last + 1)
    high = cell_of((angle / (1 - uncertainty) + gate) / sky.bin_rad, last)
    return sky.first[low], sky.first[high + 1], chord, gate


@jit
def fit_focal_ratio(tangent: Floats, a: int, b: int, chord: float, target: float) -> float:
    """The focal ratio at which the chord between two detections is `target`.

    A chord is nearly proportional to 1 / focal length: f <- f chord(f) / target converges in two iterations.

    Parameters
    ----------
    chord
        Chord between the two rays at the assumed focal length
    target
        Chord between the two stars

    Returns
    -------
    float
        Ratio of the true to the assumed focal length
    """
    focal_ratio = chord / target
    # f <- f chord(f) / target
    for _ in range(2):
        focal_ratio *= (
            vectors.chord(ray(tangent, a, focal_ratio), ray(tangent, b, focal_ratio)) / target
        )
    return focal_ratio


@jit
def fit_to_all(
    detections: Detections,
    stars: SkyIndex,
    candidate: Hypothesis,
    accept_dex: float,
    calibrated: bool,
    whole: bool,
) -> Solution:
    """Step 9: fit a candidate attitude of some detections to all detections and all stars.

    With a wrong focal length a part of the stars may still match, at a wrong attitude. The candidate of a calibrated
    camera is therefore also fitted with a free focal length, which is taken if it has WRONG_FOCAL_DEX more evidence.

    Parameters
    ----------
    detections
        All detections, with the focal uncertainty of the free fit
    candidate, accept_dex
        Best hypothesis of the search, and its least evidence, log10
    calibrated
        Whether the focal length is calibrated
    whole
        Whether the candidate already is the calibrated fit to all detections

    Returns
    -------
    Solution
        Empty if the candidate has less than `accept_dex`, if the full field keeps no more than half of its matches, or
        if all detections together are not beyond chance
    """
    if not candidate.dex >= accept_dex:
        return build_solution(detections, stars, no_hypothesis())
    chosen = detections
    full = no_hypothesis()
    # A candidate of some detections is less accurate than the fit to all: the first match has a wider gate.
    gates = gates_of(detections, 1.5)
    R = candidate.R_cam_from_ref
    free = True
    if calibrated:
        # 9a. The fit with the calibrated focal length.
        chosen = changed(detections, len(detections.sigma), 1.0, 0.0)
        full = candidate if whole else evaluate(chosen, stars, R.copy(), 1.0, gates, -np.inf)
        # If all detections match there is none that another focal length could match.
        free = (
            len(full.star) < len(gates) or focal_gain_dex(detections, stars, full) >= FREE_DEX
        )
    if free:
        # 9b. The fit with a free focal length.
        fitted = evaluate(detections, stars, R.copy(), candidate.focal_ratio, gates, -np.inf)
        if not calibrated or fitted.dex > full.dex + WRONG_FOCAL_DEX:
            chosen = detections
            full = fitted
    # 9c. Refuse what all detections together do not confirm.
    if 2 * len(full.observed) <= len(candidate.observed) or full.dex < ACCEPT_DEX:
        return build_solution(chosen, stars, no_hypothesis())
    dex = max(full.dex, candidate.dex)
    best = Hypothesis(
        full.observed, full.star, full.R_cam_from_ref, full.focal_ratio, full.info, dex
    )
    return build_solution(chosen, stars, best)
