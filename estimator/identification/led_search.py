"""Lost-in-space LED identification under a dome: pair hypotheses and a Bayes factor, with near-field parallax.

The angles between near LEDs, seen from the camera, change with the attitude. But the camera only rotates about the
bearing center, from which every LED has a fixed distance. A measured ray is intersected with the sphere of the
hypothetical LED's own radius about the bearing. This gives the direction from the bearing to the LED in camera axes,
without knowledge of the attitude. A pair of detections and a pair of LEDs must then agree in one angle about the
bearing, and they determine an attitude, which the other detections must confirm.

The steps; the same numbers return as comments in the code:

1. Convert rays to directions from the bearing, with their total errors (`led_detections.build_detections`).
2. Sort the pairs of detections by the number of LED pairs of the same angle (`_ordered_pairs`).
3. Take the next pair, and all LED pairs of its angle, in both orders (`_test_pair`).
4. Compute the focal ratio and the exact directions with the LEDs' own radii; compare the angle; compute the attitude.
5. Quick check: look for an LED at the direction of each other detection (`_quick_check`).
6. Match the LEDs around, fit the attitude and compute its Bayes factor (`led_evidence.evaluate`).
7. Once an attitude reaches ACCEPT_DEX, search for rivals (`_search`): the same pair again with a lower bound, then one
   pair that shares no detection with it. A rival that explains almost as much must contain one of the two pairs.
8. Refuse an attitude that a rival approaches within MARGIN_DEX, or that is not beyond chance (`identify`).

A dense dome (`led_index`) has too many pairs of any angle, and parts of a regular one are alike: a lattice whose cells
change slowly differs from its neighborhood by its spacing times the angle that is compared. So parts of a field only
propose attitudes, and the whole field decides. The steps that differ:

2. Take a detection, from the boresight outward, with its PATTERN nearest ones (`_search_parts`).
3. Find the LEDs that it may be, with chords c_k to their nearest ones like those of the detections, d_k
   (`part_pairs`): sum_k (c_k - d_k)^2 <= 4 gate^2, where gate = GATE_SIGMA 2^(1/2) sigma. The sum's mean is
   2 PATTERN sigma^2; half of it is the detection's own error, which all chords share, so that the sum scatters widely.
   Each LED forms pairs with those near it that are as far as the farthest of the detections.
5. Look for an LED at the direction of these detections only.
6. Match and fit the LEDs of the part, then those of the field, of which the Bayes factor is (`led_evidence.evaluate`).
   It has the volume of all attitudes, so that it needs no penalty for the number of parts.
7. Another part of the field, far from the first, must find the same attitude. A part with a stray light or a dark LED
   finds nothing, and would find no rival either. If no two parts do, try again with LEDs of any pattern, and with
   more stray lights.

If the focal length is uncertain, an angle alone says little. Angles of triangles in the focal plane hardly depend on
it (Samaan, Mortari & Junkins 2003, AAS 03-131: non-dimensional star identification; Leake, Arnas & Mortari 2020,
arXiv:2003.13736). A pair of detections is then compared with all LED pairs of any angle in its range. Each LED pair
gives an attitude and a focal length, that is, the frame of a similarity in which the places of the other detections
are invariants: the pair makes a triangle with each of them, whose angles the quick check compares with the LEDs'.
"""

from math import log10, pi, sqrt

import numpy as np
from numpy.typing import NDArray

from estimator.attitude.solvers import rotation
from estimator.catalog.pair_index import pair_range
from estimator.catalog.sky_index import nearest
from estimator.core import vectors
from estimator.core.checks import Floats
from estimator.core.jit import jit
from estimator.core.types import StarMatch
from estimator.core.vectors import Vector
from estimator.identification.chance import (
    ACCEPT_DEX,
    GATE_SIGMA,
    MIN_EVIDENCE_MATCHES,
    SHORT_PAIR,
    attitude_dex,
    least,
    required_matches,
    separation,
)
from estimator.identification.led_detections import (
    PATTERN,
    LedDetections,
    bearing_angle_ratio,
    build_detections,
    direction_from_bearing,
    pair_gates,
    part_pairs,
)
from estimator.identification.led_evidence import LedHypothesis, evaluate, shared_matches
from estimator.identification.led_index import DomeIndex
from estimator.identification.refusals import AMBIGUOUS, NO_MATCH
from estimator.identification.star_detections import ray

# Of a dense dome: parts of a field that are tried; lights of a part that may be no LEDs, in the first attempt and in
# the second; attitudes that are evaluated
PARTS = 16
STRAYS = 2
MOST_STRAYS = 6
MOST_ALIKE = 40
MARGIN_DEX = 5.0  # by which the best attitude must beat every other one
MARGIN_SIGMA = 4.3  # as improbable, in standard deviations on one side
AMBIGUOUS_DEX = 2.0  # least evidence of the best attitude for a near rival to be reported
MIN_SEPARATION = (
    1e-9  # of a pair, in tangents: closer detections have no direction between them
)


def identify(
    rays_cam: Floats,
    sigma_rad: Floats,
    dome: DomeIndex,
    max_checks: int = 4_000_000,
    flux_s: Floats | None = None,
    focal_uncertainty: float = 0.0,
    most_lights: int | None = None,
) -> StarMatch | str:
    """Identify the LEDs of (N, 3) rays in camera axes: the whole search (see the module's steps).

    Parameters
    ----------
    rays_cam
        (N, 3) unit vectors in camera axes
    sigma_rad
        (N,) standard deviation of a ray about each axis; `dome` holds the survey's own errors
    dome
        Index of the LEDs
    max_checks
        Bound on the effort: LED pairs tested, plus a quarter of the detections times the LEDs compared with them
    flux_s
        (N,) flux of the lights per second of exposure; None: unknown. It counts only if the map's LEDs differ in
        brightness
    focal_uncertainty
        Greatest relative error of the focal length; `dome` must hold the pairs of the widest field
    most_lights
        Number of lights that are used, the first ones; None: all, as always under a dense dome

    Returns
    -------
    StarMatch | str
        The matches and the attitude, or the reason for a refusal
    """
    if len(rays_cam) < MIN_EVIDENCE_MATCHES:
        return NO_MATCH
    # The first lights, or of a dense dome all, from left to right as `evaluate` needs them.
    order = np.arange(len(rays_cam))[:most_lights]
    if len(dome.near):
        order = np.argsort(rays_cam[:, 0] / rays_cam[:, 2])
    flux_s = None if flux_s is None else flux_s[order]
    # 1. Directions from the bearing.
    detections = build_detections(
        rays_cam[order], sigma_rad[order], dome, flux_s, focal_uncertainty
    )
    # 2. to 7. The best attitude, and the evidence of its best rival.
    search = _search_parts if len(dome.near) else _search
    hypothesis, rival_dex = search(detections, dome, max_checks)
    # 8. Refuse an ambiguous or insignificant one.
    if hypothesis.dex > AMBIGUOUS_DEX and hypothesis.dex - rival_dex < MARGIN_DEX:
        return AMBIGUOUS
    if hypothesis.dex < ACCEPT_DEX:
        return NO_MATCH
    return StarMatch(
        order[hypothesis.observed],
        hypothesis.star,
        rotation(hypothesis.R_cam_from_lab),
        -hypothesis.dex,
    )


@jit
def _search(
    detections: LedDetections, dome: DomeIndex, max_checks: int
) -> tuple[LedHypothesis, float]:
    """Steps 2 to 7: search for the best attitude and for its rivals.

    Returns
    -------
    best
        The best hypothesis
    rival_dex
        Evidence of the strongest rival, which is the best hypothesis with a different attitude; log10
    """
    best = _nothing()
    rival_dex = -np.inf
    checks = np.zeros(1, np.int64)
    # 2. The order of the pairs.
    order = _ordered_pairs(detections, dome)
    for rank in range(len(order)):
        # 3. to 6. Test the next pair.
        a, b = order[rank]
        best, rival_dex = _test_pair(
            detections, dome, a, b, ACCEPT_DEX, best, rival_dex, checks
        )
        if best.dex >= ACCEPT_DEX:
            # 7. Search for rivals. One below `min_rival_dex` cannot matter. If that is below ACCEPT_DEX, `_test_pair`
            # has skipped such rivals so far, and the same pair is tested again.
            min_rival_dex = best.dex - MARGIN_DEX
            if min_rival_dex < ACCEPT_DEX:
                best, rival_dex = _test_pair(
                    detections, dome, a, b, min_rival_dex, best, rival_dex, checks
                )
            # A second pair, because detections a and b may not be in the rival.
            a, b = order[_disjoint_pair(order, rank, best)]
            return _test_pair(detections, dome, a, b, min_rival_dex, best, rival_dex, checks)
        if checks[0] > max_checks:
            break
    return best, rival_dex


@jit
def _ordered_pairs(detections: LedDetections, dome: DomeIndex) -> NDArray[np.int64]:
    """Step 2: pairs of detections, sorted by the number of LED pairs that they may be; short pairs come last.

    Short pairs also match few LED pairs, but determine the roll about the boresight poorly. Coincident detections are
    left out.

    Returns
    -------
    NDArray
        (P, 2) rows of the detections
    """
    total = len(detections.ray)
    min_length = SHORT_PAIR * sqrt(dome.field_area)
    pair = np.empty((total * (total - 1) // 2, 2), np.int64)
    cost = np.empty(total * (total - 1) // 2)
    count = 0
    for a in range(total):
        for b in range(a + 1, total):
            length = separation(detections.tangent, a, b)
            # Coincident detections have no direction between them.
            if not length > MIN_SEPARATION:
                continue
            begin, end, _ = _pair_range(detections, dome, a, b)
            # The cost: number of LED pairs, or one beyond all of these for a short pair.
            pair[count, 0] = a
            pair[count, 1] = b
            cost[count] = end - begin if length >= min_length else 1e9 - length
            count += 1
    return pair[:count][np.argsort(cost[:count])]


@jit
def _pair_range(
    detections: LedDetections, dome: DomeIndex, a: int, b: int
) -> tuple[int, int, float]:
    """Step 3: the LED pairs that two detections may be.

    The gate is GATE_SIGMA standard deviations of the angle, converted to an angle about the bearing. The range is
    wider by the error of the index's angles, and by the uncertain focal length.

    Returns
    -------
    begin, end
        Half-open range of pairs in the index
    gate
        Greatest difference of the angles about the bearing, rad
    """
    gate = (
        GATE_SIGMA
        * sqrt(detections.sigma[a] ** 2 + detections.sigma[b] ** 2)
        * bearing_angle_ratio(dome)
    )
    direction_a = vectors.row(detections.direction, a)
    direction_b = vectors.row(detections.direction, b)
    # The angle about the bearing, for LEDs at the median radius.
    angle = 2 * np.arcsin(min(vectors.chord(direction_a, direction_b) / 2, 1.0))
    # The index holds angles that are scaled to the median radius, with an error.
    slack = gate + dome.scaling_error_rad
    uncertainty = detections.focal_uncertainty
    # An uncertain focal length widens the range in proportion.
    begin, end = pair_range(
        dome.pairs, angle / (1 + uncertainty) - slack, angle / (1 - uncertainty) + slack
    )
    return begin, end, gate


@jit
def _disjoint_pair(pairs: NDArray, rank: int, best: LedHypothesis) -> int:
    """Rank of the first pair of two matched detections that shares none with pair `rank`, or else as few as possible.

    Parameters
    ----------
    pairs
        (P, 2) rows of the detections
    best
        The hypothesis that matches them
    """
    # Each end costs 3 if it is not matched, and 1 if it is shared.
    cost = np.full(max(pairs.max(), best.observed.max()) + 1, 3)
    cost[best.observed] = 0
    cost[pairs[rank, 0]] += 1
    cost[pairs[rank, 1]] += 1
    return int(np.argmin(cost[pairs[:, 0]] + cost[pairs[:, 1]]))


@jit
def _test_pair(
    detections: LedDetections,
    dome: DomeIndex,
    a: int,
    b: int,
    min_dex: float,
    best: LedHypothesis,
    rival_dex: float,
    checks: NDArray,
) -> tuple[LedHypothesis, float]:
    """Steps 3 to 6: test two detections against all LED pairs of their angle, in both orders: best and rival_dex.

    Parameters
    ----------
    a, b
        Rows of the two detections; under a dense dome of one, and whether its LED must have its pattern
    min_dex
        Candidates that cannot reach this evidence are skipped
    best, rival_dex
        Best hypothesis so far, and the evidence of its best rival
    checks
        (1,) effort so far, increased in place
    """
    index = dome.pairs
    rows = np.arange(len(detections.ray))
    # 3. LED pairs of the same angle, and what the quick check needs.
    if len(dome.near) > 0:
        offset = detections.direction - detections.direction[a]
        rows = np.argsort((offset**2).sum(axis=1))[: PATTERN + 1]
        required = PATTERN + 1 - (STRAYS if b > 0 else MOST_STRAYS)
        pairs, gate = part_pairs(detections, dome, rows, b > 0)
        b = rows[-1]
    else:
        begin, end, gate = _pair_range(detections, dome, a, b)
        required = _required_matches(detections, dome, a, b, min_dex)
        pairs = np.empty((2 * (end - begin), 2), np.int32)
        for n in range(end - begin):
            for k in range(2):
                pairs[2 * n, k] = pairs[2 * n + 1, 1 - k] = index.pair[begin + n, k]
    gates = pair_gates(detections, dome, a, b)
    in_cam = np.empty((3, 3))
    in_lab = np.empty((3, 3))
    R_cam_from_lab = np.empty((3, 3))
    checks[0] += len(pairs)
    alike = 0
    for p in range(len(pairs)):
        i = pairs[p, 0]
        j = pairs[p, 1]
        # 4. The attitude.
        focal_ratio = _pair_attitude(
            detections, dome, a, b, i, j, gate, in_cam, in_lab, R_cam_from_lab
        )
        if not focal_ratio > 0:
            continue
        # 5. Quick check.
        counted = _quick_check(
            detections,
            dome,
            R_cam_from_lab.T,
            focal_ratio,
            dome.radius_m[i],
            a,
            b,
            gates,
            rows,
            required,
        )
        if counted < required:
            continue
        # 6. Evidence.
        checks[0] += len(detections.ray) * (index.first[i + 1] - index.first[i]) // 4
        hypothesis = evaluate(detections, dome, R_cam_from_lab.copy(), i, a, b, focal_ratio)
        best, rival_dex = _better(hypothesis, best, rival_dex, detections)
        # Too many places of a regular dome are alike.
        alike += hypothesis.dex > -np.inf
        if alike > MOST_ALIKE and len(dome.near) > 0:
            return best, np.inf
    return best, rival_dex


@jit
def _better(
    hypothesis: LedHypothesis,
    best: LedHypothesis,
    rival_dex: float,
    detections: LedDetections,
) -> tuple[LedHypothesis, float]:
    """The better of two hypotheses, and the evidence of the best one with another identification.

    Identifications agree if more than half of the matches of the smaller one are also in the other.

    A rival beyond chance is a place that is alike, and the errors of the map may decide between the two. The difference
    must then also exceed MARGIN_SIGMA standard deviations of them: of `LedDetections.blur_dex` times the root of the
    number of lights that both match.
    """
    both, same = shared_matches(hypothesis, best, len(detections.ray))
    if 2 * same <= min(len(hypothesis.observed), len(best.observed)):
        dex = min(hypothesis.dex, best.dex)
        if dex > ACCEPT_DEX:
            blur_dex = detections.blur_dex * sqrt(both)
            dex += max(MARGIN_SIGMA * blur_dex - MARGIN_DEX, 0.0)
        rival_dex = max(rival_dex, dex)
    return (hypothesis if hypothesis.dex > best.dex else best), rival_dex


@jit
def _nothing() -> LedHypothesis:
    """A hypothesis without matches."""
    none = np.empty(0, np.int64)
    return LedHypothesis(none, none, np.eye(3), -np.inf)


@jit
def _search_parts(
    detections: LedDetections, dome: DomeIndex, max_checks: int
) -> tuple[LedHypothesis, float]:
    """Steps 2 to 7 of a dense dome, like `_search`; the best attitude is its own rival if no other part agrees."""
    best = _nothing()
    rival_dex = -np.inf
    checks = np.zeros(1, np.int64)
    # 2. The order of the parts: from the boresight outward, then again, with LEDs of any pattern.
    order = np.argsort((detections.tangent**2).sum(axis=1))
    order = order[:: len(order) // (2 * PARTS) + 1][: PARTS * (len(order) > PATTERN)]
    last = -1
    for turn in range(2 * len(order)):
        a = order[turn % len(order)]
        apart = last < 0 or (
            separation(detections.tangent, a, last) > SHORT_PAIR * sqrt(dome.field_area)
        )
        if apart and checks[0] < max_checks:
            # 3. to 6. Test the part.
            by_pattern = int(turn < len(order))
            found, found_rival_dex = _test_pair(
                detections, dome, a, by_pattern, 0.0, _nothing(), -np.inf, checks
            )
            # 7. Another part that finds the same, or a place that is alike.
            _, same = shared_matches(found, best, len(detections.ray))
            rival_dex = max(rival_dex, found_rival_dex)
            best, rival_dex = _better(found, best, rival_dex, detections)
            if 2 * same > len(found.observed) or rival_dex > max(best.dex - MARGIN_DEX, 0.0):
                return best, rival_dex
            last = a if found.dex >= ACCEPT_DEX else last
    return best, best.dex


@jit
def _pair_attitude(
    detections: LedDetections,
    dome: DomeIndex,
    a: int,
    b: int,
    i: int,
    j: int,
    gate: float,
    in_cam: Floats,
    in_lab: Floats,
    R_cam_from_lab: Floats,
) -> float:
    """Step 4: the attitude of two detections as two LEDs; returns the focal ratio, NaN if they differ in angle.

    Parameters
    ----------
    a, b, i, j
        Rows of the two detections and of the two LEDs
    gate
        Greatest difference of the angles about the bearing, rad
    in_cam, in_lab
        (3, 3) work arrays
    R_cam_from_lab
        (3, 3) attitude, written in place
    """
    led_i = vectors.row(dome.pairs.vectors, i)
    led_j = vectors.row(dome.pairs.vectors, j)
    chord = vectors.chord(led_i, led_j)
    radius_i = dome.radius_m[i]
    radius_j = dome.radius_m[j]
    # 4a. The focal ratio at which the chord is that of the LEDs.
    focal_ratio = _fit_focal_ratio(detections, dome, a, b, radius_i, radius_j, chord)
    if abs(focal_ratio - 1) > detections.focal_uncertainty:
        return np.nan
    direction_a = direction_from_bearing(_ray(detections, a, focal_ratio), dome, radius_i)
    direction_b = direction_from_bearing(_ray(detections, b, focal_ratio), dome, radius_j)
    # 4b. Compare the angle. The index holds angles scaled to the median radius; here each ray meets the LED's own
    # radius.
    if abs(vectors.chord(direction_a, direction_b) - chord) > gate:
        return np.nan
    # 4c. The attitude turns the axes of the LEDs into those of the detections.
    vectors.pair_frame(direction_a, direction_b, in_cam)
    vectors.pair_frame(led_i, led_j, in_lab)
    vectors.multiply_transposed(in_cam, in_lab, R_cam_from_lab)
    return focal_ratio


@jit
def _ray(detections: LedDetections, n: int, focal_ratio: float) -> Vector:
    """Unit ray of detection n in camera axes, if the focal length is `focal_ratio` times the assumed one."""
    if focal_ratio == 1:
        return vectors.row(detections.ray, n)
    return ray(detections.tangent, n, focal_ratio)


@jit
def _fit_focal_ratio(
    detections: LedDetections,
    dome: DomeIndex,
    a: int,
    b: int,
    radius_a_m: float,
    radius_b_m: float,
    chord: float,
) -> float:
    """Step 4a: the focal ratio at which two detections are two LEDs with this chord of directions from the bearing.

    By fixed-point iteration, as a chord is nearly proportional to 1 / focal length; 1 for a calibrated camera.

    Parameters
    ----------
    radius_a_m, radius_b_m
        Distances of the two LEDs from the bearing
    chord
        Chord between the directions of the two LEDs
    """
    focal_ratio = 1.0
    if detections.focal_uncertainty > 0:
        # f <- f chord(f) / chord of the LEDs
        for _ in range(3):
            direction_a = direction_from_bearing(
                _ray(detections, a, focal_ratio), dome, radius_a_m
            )
            direction_b = direction_from_bearing(
                _ray(detections, b, focal_ratio), dome, radius_b_m
            )
            focal_ratio *= vectors.chord(direction_a, direction_b) / chord
    return focal_ratio


@jit
def _required_matches(
    detections: LedDetections, dome: DomeIndex, a: int, b: int, min_dex: float
) -> int:
    """Number of matches, the pair included, without which the evidence cannot reach `min_dex`."""
    pair_dex = attitude_dex(
        detections.tangent,
        detections.sigma,
        a,
        b,
        dome.prior_volume,
        detections.focal_uncertainty,
    )
    # Greatest evidence that brightness can give: the peak of the LED's density over the least density of a light.
    light_dex = 0.0
    if len(detections.light_density) > 0:
        light_dex = -log10(least(detections.light_density) * sqrt(2 * pi) * dome.flux_sigma)
    return required_matches(detections.sigma, dome.field_area, pair_dex, min_dex, light_dex)


@jit
def _quick_check(
    detections: LedDetections,
    dome: DomeIndex,
    R_lab_from_cam: Floats,
    focal_ratio: float,
    radius_m: float,
    a: int,
    b: int,
    gates: Floats,
    rows: NDArray[np.int64],
    required: int,
) -> int:
    """Step 5: count the detections with an LED at their predicted direction.

    Every ray is taken to the radius of the hypothetical LED: by a first-order step from the median radius, or
    exactly if the focal length is not the assumed one.

    Parameters
    ----------
    R_lab_from_cam
        (3, 3) rotation from camera axes to the lab frame
    radius_m
        Distance of the hypothetical LED from the bearing
    a, b
        Rows of the pair's detections, which count as matched
    gates, rows
        (N,) rad, matching radius of each detection, and the rows of the detections to count
    required
        The count stops as soon as it reaches this number, or cannot

    Returns
    -------
    int
        Number of detections counted, the pair included
    """
    count = 2
    leds = dome.pairs.vectors
    cells = dome.pairs.cells
    radius_offset_m = radius_m - dome.median_radius_m
    for done, n in enumerate(rows):
        # Reached or out of reach.
        if count >= required or count + len(rows) - done < required:
            break
        if n in (a, b):
            continue
        # The direction from the bearing, then the LEDs near it.
        if focal_ratio != 1:
            x, y, z = direction_from_bearing(_ray(detections, n, focal_ratio), dome, radius_m)
        else:
            u = vectors.row(detections.direction, n)
            slope = vectors.row(detections.direction_per_m, n)
            x = u[0] + radius_offset_m * slope[0]
            y = u[1] + radius_offset_m * slope[1]
            z = u[2] + radius_offset_m * slope[2]
        x, y, z = vectors.rotate(R_lab_from_cam, (x, y, z))
        count += nearest(leds, cells.first, cells.row, cells.side, x, y, z, gates[n])[0] >= 0
    return count
