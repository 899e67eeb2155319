"""Lost-in-space star identification by triangle hypotheses and a Bayes factor: the default method.

A detection (the hub) and two others form a triangle. Three catalog stars with the same three separations and the same
orientation determine an attitude. If it is the true one, the other detections have catalog stars at their predicted
directions. The Bayes factor (`star_evidence`) decides whether chance could have placed them there. If the focal length
is uncertain, each side also determines it, from the ratio of the measured to the catalog separation, and the sides and
the other detections must agree.

The catalog lists pairs of stars by their separation (after the Pyramid algorithm, Mortari et al. 2004, Navigation 51,
171). The pairs of the hub and one partner are linked to the star of the hub. Only those pairs of the hub and another
partner that have the same star form a triangle, and most of these have a third side of another length. No star is
therefore looked up by its direction before the triangle is closed.

The steps; the same numbers return as comments in the code:

1. Choose up to `max_detections` detections, the brightest of each part of the field (`star_detections.spread`).
2. Take a hub, bright and not in a clump first, and its partners, those first that the fewest catalog pairs are expected
   to match (`search`, `_pair_costs`).
3. Look up the catalog pairs of the separation of hub and partner within GATE_SIGMA (`_pair_range`).
4. Close triangles with the pairs of earlier partners (`_test_partner`).
5. Take the attitude of one side (`pair_hypothesis`).
6. Match all detections, fit the attitude and compute its Bayes factor (`star_evidence.evaluate`).
7. Stop at DECISIVE_DEX. From ACCEPT_DEX on, continue only to find rivals, with limited effort (`search`).
8. Accept an attitude that passes ACCEPT_DEX and beats every other one by MARGIN_DEX (`search`).
9. Fit the attitude to all detections, with the calibrated and with a free focal length (`fit_to_all`).

Angles in the image are tangents; `ref` is the frame of the catalog's vectors.
"""

from math import hypot, sqrt
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from estimator.catalog.sky_index import SkyIndex, cell_of
from estimator.core import vectors
from estimator.core.checks import Floats
from estimator.core.jit import inlined, jit
from estimator.identification.chance import (
    ACCEPT_DEX,
    GATE_SIGMA,
    separation,
    squared_separation,
)
from estimator.identification.star_detections import (
    Detections,
    changed,
    chosen,
    field_area,
    gates_of,
    pair_gates,
    ray,
    spread,
    squared_corner,
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
# Below this an attitude is neither acceptable nor a rival.
NO_RIVAL_DEX = ACCEPT_DEX - MARGIN_DEX
# Effort to find rivals of an accepted attitude: a multiple of the effort so far, plus a number of star look-ups.
RIVAL_EFFORT = 2
MIN_RIVAL_EFFORT = 2000
MAG_GATE_SIGMA = 4.0  # greatest difference of magnitudes, in standard deviations
# Cost of an evaluation in star look-ups. It is part of the effort, so that frames without a solution end in time.
EVALUATION_COST = 15
SHORTEST = 0.07  # of the field's size: shorter pairs are tried last
# Greatest relative error of a calibrated focal length that step 9 can find
WRONG_FOCAL = 0.05
WRONG_FOCAL_DEX = 2.0  # evidence by which another focal length must beat the calibrated one
# Least gain by a free focal length, with the same matches, for which it is tried
FREE_DEX = 1.0
PARTNERS = 12  # of a hub
MAX_LINKS = 2**16  # catalog pairs of a hub that are kept
MAX_CLOSED = 2**12  # triangles of a hub and one partner
STEPS_PER_CHECK = 16  # comparisons of catalog pairs that take as long as a star look-up


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
    rows = spread(detections.tangent, detections.field, max_detections)
    searched = chosen(detections, rows)
    # 2. to 8. The search.
    candidate = search(searched, stars, max_checks)
    # 9. Fit to all detections. A calibrated camera may be wrong by up to WRONG_FOCAL.
    calibrated = detections.focal_uncertainty == 0
    free = changed(detections, 1.0, WRONG_FOCAL) if calibrated else detections
    return fit_to_all(free, stars, candidate, calibrated)


@inlined
def search(detections: Detections, sky: SkyIndex, max_checks: int) -> Hypothesis:
    """Steps 2 to 8: search one set of detections for the attitude.

    Parameters
    ----------
    max_checks
        Bound on the effort: star look-ups, and what takes as long

    Returns
    -------
    Hypothesis
        The first one with DECISIVE_DEX, or else the best if it passes ACCEPT_DEX and MARGIN_DEX, or else the empty one
    """
    crowd, hubs = _crowds(detections)
    best = no_hypothesis()
    rival_dex = -np.inf
    checks = np.zeros(1, np.int64)
    limit = max_checks
    links = _no_links(len(sky.vectors))
    for hub in hubs:
        # 2. A hub, and the partners of the least cost.
        most = min(PARTNERS, len(hubs) - 1)
        partners = np.argsort(_pair_costs(detections, crowd, hub))[:most]
        for p in range(most):
            # 3. to 6. Test the triangles of the hub, this partner and an earlier one.
            candidate = _test_partner(
                detections, sky, hub, partners[: p + 1], links, best, checks
            )
            # The lesser of two attitudes is a rival.
            if not _same_attitude(candidate, best):
                rival_dex = max(rival_dex, min(candidate.dex, best.dex))
            if candidate.dex > best.dex:
                if best.dex < ACCEPT_DEX <= candidate.dex:
                    limit = min(max_checks, (1 + RIVAL_EFFORT) * checks[0] + MIN_RIVAL_EFFORT)
                best = candidate
            # 7. A decisive attitude needs no search for rivals.
            if best.dex >= DECISIVE_DEX:
                return best
            if checks[0] > limit:
                break
        _clear(links)
        if checks[0] > limit:
            break
    # 8. A weaker attitude must be significant, and clearly better than any other.
    if best.dex >= ACCEPT_DEX and best.dex - rival_dex >= MARGIN_DEX:
        return best
    return no_hypothesis(np.nan if checks[0] > limit else -np.inf)


@jit
def _same_attitude(first: Hypothesis, second: Hypothesis) -> bool:
    """Whether two hypotheses have the same attitude within 5.7 degrees; False if `second` is empty.

    The trace of R1^T R2, the sum of the products of their elements, is 1 + 2 cos(angle): 2.99 for 5.7 degrees.
    """
    if second.dex == -np.inf:
        return False
    R1 = first.R_cam_from_ref
    R2 = second.R_cam_from_ref
    trace = 0.0
    for n in range(3):
        trace += vectors.dot(vectors.row(R1, n), vectors.row(R2, n))
    return trace > 2.99


@inlined
def _crowds(detections: Detections) -> tuple[Floats, NDArray]:
    """Numbers of detections within SHORTEST of the field, and the hubs: those first that are bright and alone.

    A detection among c - 1 others is less probably a star the more there are: a clump of false lights counts as one.

    Returns
    -------
    crowd, hubs
        (N,) numbers c, and rows of the detections
    """
    total = len(detections.sigma)
    crowd = np.ones(total)
    least2 = SHORTEST * SHORTEST * field_area(detections)
    for a in range(total):
        for b in range(a):
            if squared_separation(detections.tangent, a, b) < least2:
                crowd[a] += 1
                crowd[b] += 1
    return crowd, np.argsort((np.arange(total) + 1) * crowd)


@inlined
def _pair_costs(detections: Detections, crowd: Floats, hub: int) -> Floats:
    """(N,) costs of the pairs of a hub and each detection, infinite for the hub itself.

        cost = s_ab sqrt(sa^2 + sb^2) c_a c_b

    The expected number of catalog pairs in a gate grows with the separation s_ab and with the width of the gate. c is
    `crowd` (`_crowds`). A pair shorter than SHORTEST hardly determines the roll: it is given a separation beyond all
    others, the greater the shorter it is.
    """
    cost = np.empty(len(crowd))
    min_length = SHORTEST * sqrt(field_area(detections))
    for n in range(len(crowd)):
        length = separation(detections.tangent, hub, n)
        # A short pair comes after all others.
        if length < min_length:
            length = 1e3 * min_length * min_length / max(length, 1e-9)
        error = hypot(detections.sigma[hub], detections.sigma[n])
        cost[n] = length * error * (crowd[hub] * crowd[n])
    cost[hub] = np.inf
    return cost


class Links(NamedTuple):
    """Catalog pairs that the hub and one of its partners may be, by the star of the hub: linked lists.

    Attributes
    ----------
    last
        (S,) entry that was added last of each star, plus 1; 0 without one
    entry
        (L, 4) star of the hub, star of the partner, number of the partner, and entry before it of the same hub, plus 1
    ratio
        (L,) focal ratio by the separation
    total
        (1,) number of entries
    closed
        (T, 2) of each triangle that was closed last: stars of the hub and of the last partner
    """

    last: NDArray[np.int32]
    entry: NDArray[np.int32]
    ratio: Floats
    total: NDArray[np.int64]
    closed: NDArray[np.int64]


@inlined
def _no_links(stars: int) -> Links:
    """No entry for any star: zeros, which take no time, as the system provides them when they are used."""
    return Links(
        np.zeros(stars, np.int32),
        np.empty((MAX_LINKS, 4), np.int32),
        np.empty(MAX_LINKS),
        np.zeros(1, np.int64),
        np.empty((MAX_CLOSED, 2), np.int64),
    )


@inlined
def _clear(links: Links) -> None:
    """Remove all entries."""
    for n in range(links.total[0]):
        links.last[links.entry[n, 0]] = 0
    links.total[0] = 0


@inlined
def _test_partner(
    detections: Detections,
    sky: SkyIndex,
    hub: int,
    partners: NDArray,
    links: Links,
    previous: Hypothesis,
    checks: NDArray,
) -> Hypothesis:
    """Steps 3 to 6: test the triangles of the hub, its last partner, and an earlier one.

    Each catalog pair of the separation of hub and partner is compared with the links of its stars, in both orders. If
    the stars of two partners are as far apart as the partners, and on the same side, the three stars are a candidate.

    Parameters
    ----------
    hub, partners
        Row of the hub, and rows of its partners so far
    links
        Pairs of the hub with its partners, to which those of the last one are added
    previous
        Best hypothesis so far
    checks
        (1,) effort so far, increased in place

    Returns
    -------
    Hypothesis
        The first one with ACCEPT_DEX whose attitude is not that of `previous`, or else the best one
    """
    y = partners[-1]
    best = no_hypothesis()
    # 3. Catalog pairs of the same separation.
    low, high, chord, gate = _pair_range(detections, sky, hub, y)
    # 4. Triangles.
    wanted = _wanted(detections, hub, partners, gate / chord)
    mags = (detections.mag[hub], detections.mag[y], MAG_GATE_SIGMA * detections.mag_sigma)
    chord = chord if detections.focal_uncertainty > 0 else 0.0
    pairs = (sky.pair, sky.first, low, high, sky.bin_rad)
    closed, steps = _close(pairs, sky.vectors, sky.mag, mags, chord, wanted, links)
    checks[0] += 1 + steps // STEPS_PER_CHECK
    for n in range(closed):
        # 5. and 6. Below NO_RIVAL_DEX the candidate is neither acceptable nor a rival.
        checks[0] += EVALUATION_COST
        candidate = pair_hypothesis(
            detections, sky, (hub, y, links.closed[n, 0], links.closed[n, 1]), NO_RIVAL_DEX
        )
        if candidate.dex >= ACCEPT_DEX and not _same_attitude(candidate, previous):
            return candidate
        best = candidate if candidate.dex > best.dex else best
    return best


@inlined
def _close(
    pairs: tuple[NDArray, NDArray, int, int, float],
    star: Floats,
    mag: Floats,
    mags: tuple[float, float, float],
    chord: float,
    wanted: Floats,
    links: Links,
) -> tuple[int, int]:
    """Step 4: close triangles with the catalog pairs of the hub and its last partner, and link these pairs.

    Parameters
    ----------
    pairs
        Pairs of the sky index, the first entries of its cells, the first and the last cell of the wanted separation,
        and the width of a cell
    star, mag
        Stars and their magnitudes
    mags
        Magnitudes of the hub and of the partner, and their greatest error
    chord
        Chord between hub and partner if the focal length is uncertain, else 0
    wanted
        See `_wanted`
    links
        Pairs of the earlier partners. The new ones are added; triangles are written to `closed`

    Returns
    -------
    tuple[int, int]
        Number of triangles, and of comparisons
    """
    # Tuple members are unpacked here: in the loop each access would cost two updates of a reference count.
    pair, first, low, high, bin_rad = pairs
    last, entries, ratios, total, closed = links
    mag_hub, mag_partner, mag_gate = mags
    p = np.int32(len(wanted) - 1)
    ratio = 1.0
    count = total[0]
    found = 0
    tests = 0
    for cell in range(low, high + 1):
        if chord > 0:
            # The angle of a cell's pairs is known to the width of the cell, much less than the gate.
            ratio = chord / (2 * np.sin((cell + 0.5) * bin_rad / 2))
        for row in range(2 * first[cell], 2 * first[cell + 1]):
            # Each pair in both orders; magnitudes first, as they need no geometry.
            i = pair[row >> 1, row & 1]
            k = pair[row >> 1, ~row & 1]
            if not _alike(mag_hub - mag[i], mag_partner - mag[k], mag_gate):
                continue
            entry = last[i]
            while entry:
                n = entry - 1
                j = entries[n, 1]
                q = entries[n, 2]
                entry = entries[n, 3]
                tests += 1
                if q == p or abs(ratios[n] / ratio - 1) > wanted[q, 3]:
                    continue
                star_j = vectors.row(star, j)
                star_k = vectors.row(star, k)
                if abs(vectors.chord(star_j, star_k) * ratio - wanted[q, 0]) > wanted[q, 1]:
                    continue
                normal = vectors.cross(star_j, star_k)
                if wanted[q, 2] * vectors.dot(vectors.row(star, i), normal) < 0:
                    continue
                if found < len(closed):
                    closed[found, 0] = i
                    closed[found, 1] = k
                    found += 1
            if count < len(entries):
                vectors.set_row(entries, count, (i, k, p))  # its first three elements
                entries[count, 3] = last[i]
                ratios[count] = ratio
                count += 1
                last[i] = count
    total[0] = count
    return found, tests + first[high + 1] - first[low]


@inlined
def _wanted(detections: Detections, hub: int, partners: NDArray, tolerance: float) -> Floats:
    """What stars must satisfy to form the triangle of a hub, its last partner, and each earlier partner.

    An uncertain focal length follows from the side between the hub and the last partner, whose relative error is
    `tolerance`, and is compared with that from the other side at the hub. At the angle A from the boresight ratios of
    chords differ by up to 2 u sin^2 A for a focal length that is wrong by the fraction u (see `star_quads._code_gate`).

    Returns
    -------
    Floats
        (P, 4) of each partner: chord to the last one, its greatest error; triple product of hub, partner and last
        partner, 0 if its sign is uncertain; greatest relative difference of the focal ratios of the sides at the hub
    """
    tangent = detections.tangent
    sigma = detections.sigma
    out = np.empty((len(partners), 4))
    y = partners[-1]
    u = FOCAL_MARGIN * detections.focal_uncertainty
    r2 = squared_corner(detections.field)
    slack = 2 * u * r2 / (1 + r2) + (tolerance if u > 0 else 0.0)
    ray_hub = ray(tangent, hub, 1.0)
    ray_y = ray(tangent, y, 1.0)
    for q in range(len(partners)):
        x = partners[q]
        ray_x = ray(tangent, x, 1.0)
        at_hub = vectors.chord(ray_hub, ray_x)
        side = vectors.chord(ray_x, ray_y)
        out[q, 0] = side
        out[q, 1] = GATE_SIGMA * hypot(sigma[x], sigma[y]) + slack * side
        # The triple product is one side times the distance of the third corner from it, whose error is the gate.
        product = vectors.dot(ray_hub, vectors.cross(ray_x, ray_y))
        out[q, 2] = 0.0 if abs(product) < out[q, 1] * max(at_hub, side) else product
        out[q, 3] = GATE_SIGMA * hypot(sigma[x], sigma[hub]) / at_hub + slack
    return out


@inlined
def pair_hypothesis(
    detections: Detections,
    sky: SkyIndex,
    match: tuple[int, int, int, int],
    min_dex: float,
) -> Hypothesis:
    """The hypothesis that two detections are two stars, with all others that match at the attitude of these two.

    Parameters
    ----------
    match
        Rows of the detections a and b, and of their stars
    min_dex
        Least evidence of interest

    Returns
    -------
    Hypothesis
        Empty if the focal length or the evidence refutes it
    """
    a, b, i, j = match
    tangent = detections.tangent
    star_a = vectors.row(sky.vectors, i)
    star_b = vectors.row(sky.vectors, j)
    ratio = 1.0
    if detections.focal_uncertainty > 0:
        ratio = fit_focal_ratio(tangent, a, b, vectors.chord(star_a, star_b))
        if abs(ratio - 1) > FOCAL_MARGIN * detections.focal_uncertainty:
            return no_hypothesis()
    # The attitude turns the axes of the stars into those of the detections.
    in_cam = np.empty((3, 3))
    in_ref = np.empty((3, 3))
    R_cam_from_ref = np.empty((3, 3))
    vectors.pair_frame(ray(tangent, a, ratio), ray(tangent, b, ratio), in_cam)
    vectors.pair_frame(star_a, star_b, in_ref)
    vectors.multiply_transposed(in_cam, in_ref, R_cam_from_ref)
    gates = pair_gates(detections, a, b)
    return evaluate(detections, sky, R_cam_from_ref, ratio, gates, min_dex)


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
    low, high
        First and last cell of the pairs
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
    return low, high, chord, gate


@jit
def fit_focal_ratio(tangent: Floats, a: int, b: int, target: float) -> float:
    """The focal ratio at which the chord between two detections is `target`.

    A chord is nearly proportional to 1 / focal length: f <- f chord(f) / target converges in three iterations.

    Parameters
    ----------
    target
        Chord between the two stars

    Returns
    -------
    float
        Ratio of the true to the assumed focal length
    """
    focal_ratio = 1.0
    # f <- f chord(f) / target
    for _ in range(3):
        chord = vectors.chord(ray(tangent, a, focal_ratio), ray(tangent, b, focal_ratio))
        focal_ratio *= chord / target
    return focal_ratio


@inlined
def fit_to_all(
    detections: Detections,
    stars: SkyIndex,
    candidate: Hypothesis,
    calibrated: bool,
) -> Solution:
    """Step 9: fit a candidate attitude of some detections to all detections and all stars.

    With a wrong focal length a part of the stars may still match, at a wrong attitude. The candidate of a calibrated
    camera is therefore also fitted with a free focal length, which is taken if it has WRONG_FOCAL_DEX more evidence.

    Parameters
    ----------
    detections
        All detections, with the focal uncertainty of the free fit
    candidate
        Best hypothesis of the search
    calibrated
        Whether the focal length is calibrated

    Returns
    -------
    Solution
        Empty if the candidate is, if the full field keeps no more than half of its matches, or
        if all detections together are not beyond chance
    """
    if not len(candidate.star):
        return build_solution(detections, stars, candidate)
    fitted_to = detections
    full = candidate
    # A candidate of some detections is less accurate than the fit to all: the first match has a wider gate.
    gates = gates_of(detections, 1.5)
    R = candidate.R_cam_from_ref
    if calibrated:
        # 9a. The fit with the calibrated focal length; a candidate with it that all detections match is this fit.
        fitted_to = changed(detections, 1.0, 0.0)
        if len(candidate.star) < len(gates) or candidate.focal_ratio != 1:
            full = evaluate(fitted_to, stars, R.copy(), 1.0, gates, -np.inf)
    # If all detections match there is none that another focal length could match.
    whole = calibrated and len(full.star) == len(gates)
    if not whole or focal_gain_dex(detections, stars, full) >= FREE_DEX:
        # 9b. The fit with a free focal length.
        fitted = evaluate(detections, stars, R.copy(), candidate.focal_ratio, gates, -np.inf)
        if not calibrated or fitted.dex > full.dex + WRONG_FOCAL_DEX:
            fitted_to = detections
            full = fitted
    # 9c. Refuse what all detections together do not confirm.
    if 2 * len(full.observed) <= len(candidate.observed) or full.dex < ACCEPT_DEX:
        full = no_hypothesis()
    return build_solution(fitted_to, stars, full)
