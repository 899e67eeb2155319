"""Lost-in-space LED identification under a dome: pair hypotheses and a Bayes factor, with near-field parallax.

The angles between near LEDs, seen from the camera, change with the attitude. But the camera only rotates about the
bearing center, from which every LED has a fixed distance. A measured ray is intersected with the sphere of the
hypothetical LED's own radius about the bearing, which gives the direction from the bearing to the LED in body axes
without knowledge of the attitude. A pair of detections and a pair of LEDs must then agree in one angle about the
bearing, and determine an attitude. A quick check counts the other detections that have an LED at the predicted
direction; if enough do, the candidate is fitted to the whole field and its Bayes factor is computed
(`evidence.evaluate`).

If the focal length is uncertain, an angle alone says little. Angles of triangles in the focal plane hardly depend on
it (Samaan, Mortari & Junkins 2003, AAS 03-131: non-dimensional star identification; Leake, Arnas & Mortari 2020,
arXiv:2003.13736). A pair of detections is then compared with all LED pairs of any length in its range. Each gives an
attitude and a focal length, that is, the frame of a similarity in which the places of the other detections are
invariants: with each of them the pair makes a triangle, whose angles the quick check compares with the LEDs'.
"""

from __future__ import annotations

from math import log10, pi, sqrt

import numpy as np
from numpy.typing import NDArray

from estimator.attitude.dome_map import on_sphere
from estimator.attitude.solvers import rotation
from estimator.catalog.pair_index import pair_range
from estimator.catalog.sky_index import cell_of
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
    least,
    middle,
    required_matches,
    separation,
)
from estimator.identification.led_evidence import (
    STRAY,
    STRAY_DENSITY,
    LedDetections,
    LedHypothesis,
    evaluate,
    same_identification,
)
from estimator.identification.led_index import DirectionGrid, DomeIndex

MARGIN_DEX = 5.0  # by which the best attitude must beat every other one
AMBIGUOUS_DEX = (
    2.0  # least evidence of the best attitude for a near rival to be reported as an ambiguity
)
MIN_SEPARATION = 1e-9  # of a pair, in tangents: closer detections have no direction between them
AMBIGUOUS = "ambiguous: another attitude fits the lights as well"
NO_MATCH = "no identification beyond chance"


def identify(
    rays_cam: Floats,
    sigma_rad: Floats,
    dome: DomeIndex,
    max_checks: int = 4_000_000,
    flux_s: Floats | None = None,
    focal_uncertainty: float = 0.0,
) -> StarMatch | str:
    """Identify the LEDs of (N, 3) rays in camera axes: the matches and the attitude, or the reason for a refusal.

    Detection pairs are tested against all LED pairs of the same angle (`_test_pair`), the pairs with the fewest first.
    After an attitude reaches ACCEPT_DEX, rivals are searched for with a second, disjoint pair of its detections: a
    rival that explains almost as much must contain one of the two pairs. If a rival comes within MARGIN_DEX, the
    pattern is ambiguous and no attitude is returned. Brightness counts only if the map's LEDs differ in it.

    Parameters
    ----------
    sigma_rad
        (N,) standard deviation of a ray about each axis; `dome` holds the survey's own errors
    max_checks
        LED pairs tested, plus detections times LEDs compared, before giving up
    flux_s
        (N,) flux of the lights per second of exposure, for LEDs that differ in brightness;
        None: unknown
    focal_uncertainty
        Greatest relative error of the focal length; `dome` must hold the pairs of the widest
        field
    """
    if len(rays_cam) < MIN_EVIDENCE_MATCHES:
        return NO_MATCH
    detections = build_detections(rays_cam, sigma_rad, dome, flux_s, focal_uncertainty)
    hypothesis, rival_dex = _search(detections, dome, max_checks)
    if hypothesis.dex > AMBIGUOUS_DEX and hypothesis.dex - rival_dex < MARGIN_DEX:
        return AMBIGUOUS
    if hypothesis.dex < ACCEPT_DEX:
        return NO_MATCH
    return StarMatch(
        hypothesis.observed, hypothesis.star, rotation(hypothesis.R_cam_from_lab), -hypothesis.dex
    )


def build_detections(
    rays_cam: Floats,
    sigma_rad: Floats,
    dome: DomeIndex,
    flux_s: Floats | None = None,
    focal_uncertainty: float = 0.0,
) -> LedDetections:
    """Detections for the search: rays with their total errors, which include those of the LED map and of the lever.

    A lateral error of the pupil shifts all LEDs alike and is absorbed by the attitude; an axial one scales the
    image and adds an error proportional to the distance from the boresight.

    With p = r + s u on the sphere |p| = R, ds/dR = R / (u . p), so that d(p / R)/dR = u / (u . p) - p / R^2.
    """
    tangent = np.ascontiguousarray(rays_cam[:, :2] / rays_cam[:, 2:])
    pupil_sigma = dome.lever_sigma * np.linalg.norm(tangent, axis=1)
    ray_sigma = np.hypot(sigma_rad, dome.led_sigma) / rays_cam[:, 2] ** 2
    point_m = on_sphere(rays_cam, dome.pupil_m, dome.median_radius_m)
    along_m = np.sum(rays_cam * point_m, axis=1)[:, None]
    return LedDetections(
        np.ascontiguousarray(rays_cam),
        tangent,
        np.hypot(ray_sigma, pupil_sigma),
        point_m / dome.median_radius_m,
        rays_cam / along_m - point_m / dome.median_radius_m**2,
        *_brightness(flux_s, dome),
        float(focal_uncertainty),
    )


def _brightness(flux_s: Floats | None, dome: DomeIndex) -> tuple[Floats, Floats]:
    """(N,) logarithms of lights' fluxes, and (N,) density of each if it may be any LED or none; empty if unused."""
    if flux_s is None or not len(dome.log_flux):
        return np.zeros(0), np.zeros(0)
    log_flux = np.log(np.maximum(flux_s, 1e-300))
    z = (log_flux[:, None] - dome.log_flux) / dome.flux_sigma
    as_any = np.exp(-(z**2) / 2).mean(axis=1) / (np.sqrt(2 * np.pi) * dome.flux_sigma)
    return log_flux, (1 - STRAY) * as_any + STRAY * STRAY_DENSITY


@jit
def _search(
    detections: LedDetections, dome: DomeIndex, max_checks: int
) -> tuple[LedHypothesis, float]:
    """The best hypothesis, and the evidence of the best one with another attitude."""
    R_cam_from_lab = np.zeros((3, 3))
    for axis in range(3):
        R_cam_from_lab[axis, axis] = 1.0
    best = LedHypothesis(np.empty(0, np.int64), np.empty(0, np.int64), R_cam_from_lab, -np.inf)
    rival_dex = -np.inf
    checks = np.zeros(1, np.int64)
    order = _ordered_pairs(detections, dome)
    for rank in range(len(order)):
        a, b = order[rank]
        best, rival_dex = _test_pair(detections, dome, a, b, ACCEPT_DEX, best, rival_dex, checks)
        if best.dex >= ACCEPT_DEX:
            # A rival below this floor cannot matter. If the floor is below ACCEPT_DEX, `_test_pair` has skipped such
            # rivals so far, and the same pair is tested again; then a second pair is tested.
            min_rival_dex = best.dex - MARGIN_DEX
            if min_rival_dex < ACCEPT_DEX:
                best, rival_dex = _test_pair(
                    detections, dome, a, b, min_rival_dex, best, rival_dex, checks
                )
            a, b = order[_disjoint_pair(order, rank, best)]
            return _test_pair(detections, dome, a, b, min_rival_dex, best, rival_dex, checks)
        if checks[0] > max_checks:
            break
    return best, rival_dex


@jit
def _ordered_pairs(detections: LedDetections, dome: DomeIndex) -> NDArray[np.int64]:
    """(P, 2) pairs of detections, sorted by the number of LED pairs they may be; short pairs come last.

    Short pairs also match few LED pairs, but determine the roll about the boresight poorly. Coincident detections are
    left out.
    """
    total = len(detections.ray)
    min_length = SHORT_PAIR * sqrt(dome.field_area)
    pair = np.empty((total * (total - 1) // 2, 2), np.int64)
    cost = np.empty(total * (total - 1) // 2)
    count = 0
    for a in range(total):
        for b in range(a + 1, total):
            length = separation(detections.tangent, a, b)
            if not length > MIN_SEPARATION:
                continue
            begin, end, _ = _pair_range(detections, dome, a, b)
            pair[count, 0] = a
            pair[count, 1] = b
            cost[count] = end - begin if length >= min_length else 1e9 - length
            count += 1
    return pair[:count][np.argsort(cost[:count])]


@jit
def _pair_range(
    detections: LedDetections, dome: DomeIndex, a: int, b: int
) -> tuple[int, int, float]:
    """Half-open range of index pairs that two detections may be, and the gate of their angle about the bearing, rad."""
    gate = (
        GATE_SIGMA
        * sqrt(detections.sigma[a] ** 2 + detections.sigma[b] ** 2)
        * _bearing_angle_ratio(dome)
    )
    direction_a = vectors.row(detections.direction, a)
    direction_b = vectors.row(detections.direction, b)
    angle = 2 * np.arcsin(min(vectors.chord(direction_a, direction_b) / 2, 1.0))
    slack = gate + dome.scaling_error_rad
    uncertainty = detections.focal_uncertainty
    begin, end = pair_range(
        dome.pairs, angle / (1 + uncertainty) - slack, angle / (1 - uncertainty) + slack
    )
    return begin, end, gate


@jit
def _bearing_angle_ratio(dome: DomeIndex) -> float:
    """Ratio of an angle about the bearing to the angle seen by the camera: (R - M) / R."""
    return (
        1
        - sqrt(dome.pupil_m[0] ** 2 + dome.pupil_m[1] ** 2 + dome.pupil_m[2] ** 2)
        / dome.median_radius_m
    )


@jit
def _disjoint_pair(pairs: NDArray, rank: int, best: LedHypothesis) -> int:
    """Rank of the first pair of two matched detections that shares none with pair `rank`, or as few as possible."""
    best_rank = rank
    cost = 9
    for other in range(len(pairs)):
        penalty = 0
        for end in range(2):
            is_matched = False
            for n in best.observed:
                is_matched = is_matched or n == pairs[other, end]
            penalty += 3 * (not is_matched)  # an unmatched detection is worse than two shared ones
            penalty += pairs[other, end] == pairs[rank, 0] or pairs[other, end] == pairs[rank, 1]
        if penalty < cost:
            best_rank = other
            cost = penalty
    return best_rank


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
    """Test two detections against every LED pair of the same angle, in both orders.

    Candidates that cannot reach min_dex are skipped. Returns the updated best hypothesis and the evidence of its best
    rival.

    Parameters
    ----------
    checks
        (1,) effort so far, increased in place
    """
    index = dome.pairs
    radius = dome.radius_m
    begin, end, gate = _pair_range(detections, dome, a, b)
    attitude_dex = _attitude_dex(detections, dome, a, b)
    most_light_dex = _most_light_dex(detections, dome)
    required = required_matches(
        detections.sigma, dome.field_area, attitude_dex, min_dex, most_light_dex
    )
    gates = _pair_gates(detections, dome, a, b)
    in_cam = np.empty((3, 3))
    in_lab = np.empty((3, 3))
    R_cam_from_lab = np.empty((3, 3))
    R_grid_from_cam = np.empty((3, 3))
    checks[0] += 2 * (end - begin)
    for p in range(begin, end):
        for flip in range(2):
            i = index.pair[p, flip]
            j = index.pair[p, 1 - flip]
            led_i = vectors.row(index.vectors, i)
            led_j = vectors.row(index.vectors, j)
            focal_ratio = _fit_focal_ratio(
                detections, dome, a, b, radius[i], radius[j], vectors.chord(led_i, led_j)
            )
            if abs(focal_ratio - 1) > detections.focal_uncertainty:
                continue
            direction_a = _direction_from_bearing(_ray(detections, a, focal_ratio), dome, radius[i])
            direction_b = _direction_from_bearing(_ray(detections, b, focal_ratio), dome, radius[j])
            # The index holds angles scaled to the median radius; here each ray meets the LED's own radius.
            if abs(vectors.chord(direction_a, direction_b) - vectors.chord(led_i, led_j)) > gate:
                continue
            vectors.pair_frame(direction_a, direction_b, in_cam)
            vectors.pair_frame(led_i, led_j, in_lab)
            vectors.multiply_transposed(in_cam, in_lab, R_cam_from_lab)
            vectors.multiply_transposed(dome.grid.R_grid_from_lab, R_cam_from_lab, R_grid_from_cam)
            counted = _quick_check(
                detections, dome, R_grid_from_cam, focal_ratio, radius[i], a, b, gates, required
            )
            if counted < required:
                continue
            checks[0] += len(detections.ray) * (index.first[i + 1] - index.first[i]) // 4
            hypothesis = evaluate(detections, dome, R_cam_from_lab.copy(), i, a, b, focal_ratio)
            same = same_identification(hypothesis, best)
            if hypothesis.dex > best.dex:
                rival_dex = rival_dex if same else max(rival_dex, best.dex)
                best = hypothesis
            elif not same:
                rival_dex = max(rival_dex, hypothesis.dex)
    return best, rival_dex


@jit
def _ray(detections: LedDetections, n: int, focal_ratio: float) -> Vector:
    """Unit ray of a detection in camera axes, if the focal length is `focal_ratio` times the assumed one."""
    if focal_ratio == 1:
        return vectors.row(detections.ray, n)
    x = detections.tangent[n, 0] / focal_ratio
    y = detections.tangent[n, 1] / focal_ratio
    inverse = 1 / sqrt(x * x + y * y + 1)
    return x * inverse, y * inverse, inverse


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
    """The focal ratio at which two detections are two LEDs with this chord of directions from the bearing.

    By fixed-point iteration: a chord is nearly proportional to 1 / focal length. 1 for a calibrated camera.
    """
    focal_ratio = 1.0
    if detections.focal_uncertainty > 0:
        for _ in range(3):
            direction_a = _direction_from_bearing(
                _ray(detections, a, focal_ratio), dome, radius_a_m
            )
            direction_b = _direction_from_bearing(
                _ray(detections, b, focal_ratio), dome, radius_b_m
            )
            focal_ratio *= vectors.chord(direction_a, direction_b) / chord
    return focal_ratio


@jit
def _direction_from_bearing(ray: Vector, dome: DomeIndex, radius_m: float) -> Vector:
    """Unit vector from the bearing to the point where a camera ray meets the sphere of radius_m, in camera axes."""
    px, py, pz = dome.pupil_m
    along = ray[0] * px + ray[1] * py + ray[2] * pz
    distance = -along + sqrt(
        max(along * along - px * px - py * py - pz * pz + radius_m * radius_m, 0.0)
    )
    inverse = 1 / radius_m
    return (
        (px + distance * ray[0]) * inverse,
        (py + distance * ray[1]) * inverse,
        (pz + distance * ray[2]) * inverse,
    )


@jit
def _most_light_dex(detections: LedDetections, dome: DomeIndex) -> float:
    """Greatest evidence that the brightness of any light can give."""
    if len(detections.light_density) == 0:
        return 0.0
    return -log10(least(detections.light_density) * sqrt(2 * pi) * dome.flux_sigma)


@jit
def _attitude_dex(detections: LedDetections, dome: DomeIndex, a: int, b: int) -> float:
    """Contribution of a pair's attitude alone to the evidence, for `required_matches`.

    The uncertainty is sqrt(2) sigma / separation about the boresight, sigma / sqrt(2) across it; that of the focal
    length, if the pair has to tell it too, is sqrt(2) sigma / separation.
    """
    sigma = least(detections.sigma)
    length = separation(detections.tangent, a, b)
    attitude_dex = (
        1.5 * log10(2 * pi) - log10(dome.prior_volume) + log10(sigma**3 / sqrt(2.0) / length)
    )
    if detections.focal_uncertainty > 0:
        attitude_dex += log10(
            sqrt(2 * pi) * sqrt(2.0) * sigma / length / (2 * detections.focal_uncertainty)
        )
    return attitude_dex


@jit
def _pair_gates(detections: LedDetections, dome: DomeIndex, a: int, b: int) -> Floats:
    """(N,) matching radius of each detection at a pair's attitude, as an angle about the bearing, rad.

    The pair's own error adds a shift with half of a detection's variance and a rotation with 2 sigma^2 / separation^2.
    """
    x, y = middle(detections.tangent, a, b)
    direction_variance = 2 / separation(detections.tangent, a, b) ** 2
    out = np.empty(len(detections.ray))
    for n in range(len(out)):
        distance2 = (detections.tangent[n, 0] - x) ** 2 + (detections.tangent[n, 1] - y) ** 2
        gate = GATE_SIGMA * detections.sigma[n] * sqrt(1.5 + direction_variance * distance2)
        out[n] = gate * _bearing_angle_ratio(dome) + dome.scaling_error_rad
    return out


@jit
def _quick_check(
    detections: LedDetections,
    dome: DomeIndex,
    R_grid_from_cam: Floats,
    focal_ratio: float,
    radius_m: float,
    a: int,
    b: int,
    gates: Floats,
    required: int,
) -> int:
    """Quick check: number of detections with an LED at the predicted direction, the pair included.

    Stops as soon as `required` is reached or out of reach. Every ray is taken to the radius of the hypothetical LED
    (radius_m) by a first-order step from the median radius, or exactly if the focal length is another one.
    """
    count = 2
    total = len(detections.ray)
    radius_offset_m = radius_m - dome.median_radius_m
    for n in range(total):
        if count >= required or count + total - n < required:
            break
        if n in (a, b):
            continue
        if focal_ratio != 1:
            x, y, z = _direction_from_bearing(_ray(detections, n, focal_ratio), dome, radius_m)
        else:
            x = detections.direction[n, 0] + radius_offset_m * detections.direction_per_m[n, 0]
            y = detections.direction[n, 1] + radius_offset_m * detections.direction_per_m[n, 1]
            z = detections.direction[n, 2] + radius_offset_m * detections.direction_per_m[n, 2]
        count += _has_led_near(dome.grid, vectors.rotate(R_grid_from_cam, (x, y, z)), gates[n])
    return count


@jit
def _has_led_near(grid: DirectionGrid, direction: Vector, gate: float) -> bool:
    """Whether any LED is within `gate` (rad) of a direction in grid axes."""
    inverse = 1 / grid.cell
    half = grid.side / 2
    reach = gate / grid.cell
    x = direction[0] * inverse + half
    y = direction[1] * inverse + half
    for line in range(cell_of(y - reach, grid.side), cell_of(y + reach, grid.side - 1) + 1):
        left = line * grid.side + cell_of(x - reach, grid.side)
        right = line * grid.side + cell_of(x + reach, grid.side - 1)
        if left > right:
            continue
        for place in range(grid.first[left], grid.first[right + 1]):
            dx = grid.direction[place, 0] - direction[0]
            dy = grid.direction[place, 1] - direction[1]
            dz = grid.direction[place, 2] - direction[2]
            if dx * dx + dy * dy + dz * dz < gate * gate:
                return True
    return False
