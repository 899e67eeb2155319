"""Rivals of an attitude: a second sky in the frame, such as a reflection of the stars in a window or a baffle.

The lights of a frame with two skies determine two attitudes, each beyond chance. Geometry alone cannot tell the sky
from its reflection, and the search stops at the first that it finds. `with_rivals` therefore searches the lights that
an attitude leaves unmatched:

1. Skip frames whose unmatched lights are too few for a comparable rival.
2. Compare pairs of the brightest unmatched lights with pairs of the brightest matched stars: in a reflection, displaced
   or turned by any angle, the same stars are seen twice.
3. Compare a few pairs of them with the whole catalog, unless the first sky is as bright as the calibrated zero point
   has it: the other sky may be that of another field. This finds it where most unmatched lights are its stars.
4. A rival has the evidence of an accepted attitude among the unmatched lights. A lens or a shutter that does not fit
   its model also leaves stars unmatched, which fit a second, slightly different attitude; but each star is then seen
   once. Such a solution is no rival, and neither is one that the covariance of the first attitude covers. Repeat from
   step 2 with the lights that are left.
5. Compare the numbers of matches. If the weaker sky is comparable, the answer is ambiguous.

If two skies had the same throughput, each of their n = n_A + n_B matched lights would belong to A with the probability
q = N_A / (N_A + N_B), N the numbers of catalog stars in the two fields. B is comparable unless it is significantly too
weak for that:

    P(n_A or more of n lights belong to A) = sum over k from n_A to n of  C(n, k) q^k (1 - q)^(n - k)  >  10^-3

With equal fields, 9 lights against 30 are no rival, and 10 are. A reflection is not brighter than its stars: the sky of
significantly more matches is the true one.
"""

from collections.abc import Callable
from dataclasses import replace
from math import hypot, pi, sqrt

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from estimator.catalog.sky_index import SkyIndex, magnitude_density
from estimator.core import vectors
from estimator.core.camera import Camera
from estimator.core.checks import Floats
from estimator.core.jit import jit
from estimator.core.types import Attitude, Centroids, StarMatch
from estimator.identification import star_search
from estimator.identification.chance import (
    ACCEPT_DEX,
    GATE_SIGMA,
    MIN_EVIDENCE_MATCHES,
    MIN_MATCHES,
    log10_tail,
    separation,
)
from estimator.identification.refusals import AMBIGUOUS
from estimator.identification.star_check import pair_gates, quick_check
from estimator.identification.star_detections import (
    Detections,
    FlatCentroids,
    Sensor,
    changed,
    detections_of,
    flat_centroids,
    gates_of,
    ray,
)
from estimator.identification.star_evidence import (
    Hypothesis,
    Solution,
    build_solution,
    evaluate,
    no_hypothesis,
)
from estimator.trackers.refinement import FieldMatcher

LOG10_COMPARABLE = -3.0
MOST_RIVALS = 3
FEW_STARS = 6  # matched stars of which pairs are compared
FEW_LIGHTS = 10  # unmatched lights of which pairs are compared
MAX_MISSES = (
    4  # lights without a star after which an attitude with stars seen twice is dropped
)
PAIRS = 3  # pairs of lights that are compared with the whole catalog
SHORT_PAIR = 0.04  # of the field size: shorter pairs hardly determine the roll
THROUGHPUT_MAG = 1.5  # greatest difference of the brightness of two skies
MAGNITUDE_SIGMA = 0.3  # least error of a difference of magnitudes
TRUE_SKY_MAG = 0.25  # a sky no fainter than this against the calibration is no reflection
SAME_SIGMAS = 5.0  # difference of attitudes that the covariance of the first one covers
SAME_RAD = 0.1  # difference of attitudes that no misfit of the camera model causes


def with_rivals(
    attitude: Attitude,
    centroids: Centroids,
    errors_px: Callable[[Centroids], Floats],
    sensor: Sensor,
    sky: SkyIndex,
    matcher: FieldMatcher,
) -> Attitude:
    """Return an attitude with its rivals, or the refusal of an ambiguous one: the numbered steps of the module.

    Parameters
    ----------
    attitude
        Solution of the frame; a refusal is returned as it is
    errors_px
        Function that returns the (N,) total errors of centroids
    """
    match = attitude.match
    camera = attitude.camera
    covariance_rad2 = attitude.covariance_rad2
    if match is None or camera is None or covariance_rad2 is None:
        return attitude
    # 1. Unmatched lights: another field may have half as many stars as the mean one.
    matched = match.observed
    if len(centroids) - len(matched) < MIN_MATCHES:
        return attitude
    left, right, top, bottom = sensor.field
    field_sr = (right - left) * (bottom - top)
    poor_field = int(match.star.max()) * field_sr / (8 * pi)
    share = max(len(matched) / (len(matched) + poor_field), 0.5)
    if not _is_comparable(len(matched), len(centroids) - len(matched), share):
        return attitude
    skies = [(match, attitude)]
    lights = flat_centroids(centroids, errors_px(centroids))
    # A lens that is fitted to a distorted reflection does not fit the stars.
    cameras = (camera,) if camera == matcher.camera else (camera, matcher.camera)
    while len(skies) <= MOST_RIVALS and len(centroids) - len(matched) >= MIN_MATCHES:
        # 2. and 3. Search
        for lens in cameras:
            view = sensor._replace(
                focal_px=lens.focal_px,
                center_px=lens.center_px,
                distortion=lens.distortion,
                aspect=lens.aspect,
            )
            found = find(lights, view, sky, matched, match.star)
            if len(found.star):
                break
        if not len(found.star):
            break
        matched = np.concatenate([matched, found.observed])
        # 4. Second sky, or misfit
        if not _is_second_sky(found, match, covariance_rad2):
            continue
        cam_from_ref = Rotation.from_quat(found.cam_from_ref_xyzw)
        v_mag = sky.mag[found.star]
        other = StarMatch(found.observed, found.star, cam_from_ref, -found.dex, v_mag)
        spread_rad2 = max(found.chi2, 1.0) * found.covariance_rad2
        rms_px = found.rms * lens.focal_px
        solved = Attitude("solved", cam_from_ref, spread_rad2, other, rms_px, lens)
        skies.append((other, solved))
    return _compared(skies, matcher, camera) if len(skies) > 1 else attitude


def _is_second_sky(found: Solution, match: StarMatch, covariance_rad2: Floats) -> bool:
    """Return whether a solution is a second sky: step 4; `covariance_rad2` is that of the first one."""
    cam_from_ref = Rotation.from_quat(found.cam_from_ref_xyzw)
    turn_rad = (cam_from_ref * match.cam_from_ref.inv()).as_rotvec()
    distance2 = turn_rad @ np.linalg.solve(covariance_rad2 + found.covariance_rad2, turn_rad)
    twice = len(np.intersect1d(found.star, match.star))
    is_far = turn_rad @ turn_rad > SAME_RAD**2 or twice >= MIN_EVIDENCE_MATCHES
    return bool(is_far and distance2 > SAME_SIGMAS**2)


def _compared(
    skies: list[tuple[StarMatch, Attitude]], matcher: FieldMatcher, camera: Camera
) -> Attitude:
    """Return the attitude of most matches with its rivals, or the refusal of an ambiguous frame: step 5."""
    skies.sort(key=lambda one: -len(one[0].star))
    (first, best), (second, _) = skies[:2]
    # The catalog's stars of both fields, down to the faintest match
    faintest = max(first.star.max(), second.star.max())
    rich, poor = (
        np.count_nonzero(matcher.in_field(camera, one.cam_from_ref)[0] <= faintest)
        for one in (first, second)
    )
    attitudes = tuple(one for _, one in skies)
    if _is_comparable(len(first.star), len(second.star), rich / (rich + poor)):
        return Attitude(AMBIGUOUS, rivals=attitudes)
    return replace(best, rivals=attitudes[1:])


def _is_comparable(matches: int, fewer: int, share: float) -> bool:
    """Whether a sky of fewer matches is comparable; `share` is the first one's share q of the catalog's stars."""
    return log10_tail(matches + fewer, matches, share) > LOG10_COMPARABLE


@jit
def find(
    lights: FlatCentroids, sensor: Sensor, sky: SkyIndex, matched: NDArray, star: NDArray
) -> Solution:
    """Search unmatched lights for a second sky: steps 2 and 3 of the module.

    Parameters
    ----------
    lights
        All lights, brightest first
    matched
        (M,) rows of matched lights, the first K those of the first sky
    star
        (K,) rows of the stars of the first sky

    Returns
    -------
    Solution
        Empty below ACCEPT_DEX
    """
    # The matches give the zero point.
    zero_mag = sky.mag[star] + 2.5 * np.log10(lights.flux[matched[: len(star)]])
    detections, rest = _unmatched(lights, sensor, matched, zero_mag)
    bright = changed(detections, min(FEW_LIGHTS, len(rest)), 1.0, 0.0)
    total = len(bright.sigma)
    found = no_hypothesis()
    # 2. Stars that are seen twice
    known = _pairs_of(np.sort(star)[:FEW_STARS])
    for b in range(1, total):
        for a in range(b):
            if not found.dex >= ACCEPT_DEX:
                found = _test_pair(bright, sky, a, b, known, MIN_MATCHES, MAX_MISSES)
    # 3. Another field
    is_true_sky = np.mean(zero_mag) > sensor.zero_point_mag - TRUE_SKY_MAG
    for a, b in _rare_pairs(bright, sky):
        if not (is_true_sky or found.dex >= ACCEPT_DEX):
            begin, end, _, _ = star_search._pair_range(bright, sky, a, b)
            most = max(total // 2, MIN_MATCHES)
            found = _test_pair(bright, sky, a, b, sky.pair[begin:end], most, 1)
    if found.dex >= ACCEPT_DEX:
        R = found.R_cam_from_ref
        found = evaluate(detections, sky, R, 1.0, gates_of(detections, 1.5), ACCEPT_DEX)
    solution = build_solution(detections, sky, found)
    solution.observed[:] = rest[solution.observed]
    return solution


@jit
def _unmatched(
    lights: FlatCentroids, sensor: Sensor, matched: NDArray, zero_mag: Floats
) -> tuple[Detections, NDArray]:
    """The unmatched detections, and their rows, with magnitudes by the zero points (K,) of the matched stars."""
    is_left = np.ones(len(lights.flux), np.bool_)
    is_left[matched] = False
    rest = np.flatnonzero(is_left)
    every = detections_of(lights, sensor, 0.0)
    detections = Detections(
        every.tangent[rest],
        every.sigma[rest],
        every.weight[rest],
        np.mean(zero_mag) - 2.5 * np.log10(lights.flux[rest]),
        hypot(MAGNITUDE_SIGMA, np.std(zero_mag)),
        every.field,
        0.0,
        np.nan,
    )
    return detections, rest


@jit
def _pairs_of(star: NDArray) -> NDArray:
    """(P, 2) all pairs of rows."""
    pairs = [(star[i], star[j]) for j in range(len(star)) for i in range(j)]
    return np.array(pairs)


@jit
def _rare_pairs(detections: Detections, sky: SkyIndex) -> list[tuple[int, int]]:
    """The PAIRS pairs of detections that share none and that fewest catalog pairs match: short and bright ones."""
    left, right, top, bottom = detections.field
    shortest = SHORT_PAIR * sqrt((right - left) * (bottom - top))
    weight = np.array([magnitude_density(sky, mag) for mag in detections.mag])
    out = []
    for _ in range(PAIRS):
        chosen = (0, 0)
        least = np.inf
        for b in range(len(weight)):
            for a in range(b):
                length = separation(detections.tangent, a, b)
                cost = length * weight[a] * weight[b]
                if length > shortest and cost < least:
                    chosen = (a, b)
                    least = cost
        if least == np.inf:
            break
        weight[chosen[0]] = weight[chosen[1]] = np.inf
        out.append(chosen)
    return out


@jit
def _test_pair(
    detections: Detections,
    sky: SkyIndex,
    a: int,
    b: int,
    pair: NDArray,
    required: int,
    max_misses: int,
) -> Hypothesis:
    """Test two detections against catalog pairs in both orders.

    Separations must agree within GATE_SIGMA, and both lights must be as bright as their stars times one throughput.

    Parameters
    ----------
    a, b
        Rows of the detections
    pair
        (P, 2) rows of stars
    required, max_misses
        See `quick_check`

    Returns
    -------
    Hypothesis
        The first one with ACCEPT_DEX, else the empty one
    """
    in_cam = np.empty((3, 3))
    in_ref = np.empty((3, 3))
    R_ref_from_cam = np.empty((3, 3))
    ray_a = ray(detections.tangent, a, 1.0)
    ray_b = ray(detections.tangent, b, 1.0)
    vectors.pair_frame(ray_a, ray_b, in_cam)
    chord = vectors.chord(ray_a, ray_b)
    gate = GATE_SIGMA * sqrt(detections.sigma[a] ** 2 + detections.sigma[b] ** 2)
    # Tuple members are unpacked here: in the loop each access would cost two updates of a reference count.
    tangent = detections.tangent
    mag = sky.mag
    stars = sky.vectors
    grid = (sky.cell_first, sky.cell_star, sky.side)
    mag_a = detections.mag[a]
    mag_b = detections.mag[b]
    mag_gate = GATE_SIGMA * detections.mag_sigma
    gates = np.empty(0)
    order = np.empty(0, np.int64)
    for p in range(len(pair)):
        i = pair[p, 0]
        j = pair[p, 1]
        # The sum of the magnitudes is the same in both orders.
        if abs(mag_a + mag_b - mag[i] - mag[j]) > 2 * THROUGHPUT_MAG:
            continue
        star_i = vectors.row(stars, i)
        star_j = vectors.row(stars, j)
        if abs(vectors.chord(star_i, star_j) - chord) > gate:
            continue
        vectors.pair_frame(star_i, star_j, in_ref)
        for flip in range(2):
            if flip:
                # The star pair in reverse order: a half turn about its bisector, the first axis.
                in_ref[:, 1:] *= -1
            order_mag = mag[j] - mag[i] if flip else mag[i] - mag[j]
            if abs(mag_a - mag_b - order_mag) > mag_gate:
                continue
            vectors.multiply_transposed(in_ref, in_cam, R_ref_from_cam)
            if not len(gates):
                gates = pair_gates(detections, a, b)
                order = np.array([n for n in range(len(gates)) if n not in (a, b)])
            _, fits = quick_check(
                tangent,
                stars,
                *grid,
                R_ref_from_cam,
                1.0,
                gates,
                order,
                required,
                max_misses,
            )
            if not fits:
                continue
            R = R_ref_from_cam.T.copy()
            found = evaluate(detections, sky, R, 1.0, gates, ACCEPT_DEX)
            if found.dex >= ACCEPT_DEX:
                return found
    return no_hypothesis()
