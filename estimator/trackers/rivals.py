"""Rivals of an attitude: a second sky in the frame, such as a reflection of the stars in a window or a baffle.

The lights of a frame with two skies determine two attitudes, each beyond chance. Geometry alone cannot tell the sky
from its reflection, and the search stops at the first that it finds. `with_rivals` therefore searches the lights that
an attitude leaves unmatched:

1. Skip frames whose unmatched lights are too few for a comparable rival.
2. Search the unmatched lights for a short time, as those of a frame (`star_search`, in a deep sky `star_quads`). The
   zero point follows from the matched stars. This finds another sky where most of the bright unmatched lights are its
   stars.
3. A rival has the evidence of an accepted attitude among the unmatched lights. A lens or a shutter that does not fit
   its model also leaves stars unmatched, which fit a second, slightly different attitude; but each star is then seen
   once. Such a solution is no rival, and neither is one that the covariance of the first attitude covers. Repeat from
   step 2 with the lights that are left.
4. Compare the numbers of matches. If the weaker sky is comparable, the answer is ambiguous.

If two skies had the same throughput, each of their n = n_A + n_B matched lights would belong to A with the probability
q = N_A / (N_A + N_B), N the numbers of catalog stars in the two fields. B is comparable unless it is significantly too
weak for that:

    P(n_A or more of n lights belong to A) = sum over k from n_A to n of  C(n, k) q^k (1 - q)^(n - k)  >  10^-3

With equal fields, 9 lights against 30 are no rival, and 10 are. A sky of half as many lights is comparable in any case,
as a camera that reports only its brightest lights does not show all stars of a rich field. A reflection is not brighter
than its stars: the sky of significantly more matches is the true one.
"""

from collections.abc import Callable
from dataclasses import replace
from math import hypot, pi

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from estimator.catalog.quad_index import QuadIndex
from estimator.catalog.sky_index import SkyIndex
from estimator.core.camera import Camera
from estimator.core.checks import Floats
from estimator.core.jit import jit
from estimator.core.types import Attitude, Centroids, StarMatch
from estimator.identification import star_quads, star_search
from estimator.identification.chance import (
    MIN_EVIDENCE_MATCHES,
    MIN_MATCHES,
    log10_tail,
)
from estimator.identification.refusals import AMBIGUOUS
from estimator.identification.star_detections import (
    Detections,
    FlatCentroids,
    Sensor,
    chosen,
    detections_of,
    flat_centroids,
)
from estimator.identification.star_evidence import Solution
from estimator.trackers.refinement import FieldMatcher

LOG10_COMPARABLE = -3.0
MOST_RIVALS = 3
MOST_LIGHTS = 20  # unmatched lights that are searched
# Efforts of the search by pairs and by quads, which find as many second skies
MAX_CHECKS = 5000
QUAD_CHECKS = 20_000
MAGNITUDE_SIGMA = 0.3  # least error of a difference of magnitudes
SAME_SIGMAS = 5.0  # difference of attitudes that the covariance of the first one covers
SAME_RAD = 0.1  # difference of attitudes that no misfit of the camera model causes


def with_rivals(
    attitude: Attitude,
    centroids: Centroids,
    errors_px: Callable[[Centroids], Floats],
    sensor: Sensor,
    sky: SkyIndex,
    matcher: FieldMatcher,
    quads: QuadIndex | None,
) -> Attitude:
    """Return an attitude with its rivals, or the refusal of an ambiguous one: the numbered steps of the module.

    Parameters
    ----------
    attitude
        Solution of the frame; a refusal is returned as it is
    errors_px
        Function that returns the (N,) total errors of centroids
    quads
        Quads of a deep sky, which are searched in place of its pairs
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
    # The matches give the zero point.
    zero_mag = sky.mag[match.star] + 2.5 * np.log10(centroids.flux[matched])
    # A lens that is fitted to a distorted reflection does not fit the stars.
    cameras = (camera,) if camera == matcher.camera else (camera, matcher.camera)
    while len(skies) <= MOST_RIVALS and len(centroids) - len(matched) >= MIN_MATCHES:
        # 2. Search
        rest = np.delete(np.arange(len(centroids)), matched)
        for lens in cameras:
            view = sensor._replace(
                focal_px=lens.focal_px,
                center_px=lens.center_px,
                distortion=lens.distortion,
                aspect=lens.aspect,
                zero_point_mag=float(np.mean(zero_mag)),
                magnitude_sigma=hypot(MAGNITUDE_SIGMA, np.std(zero_mag)),
            )
            found = _find(_unmatched(lights, view, rest), sky, quads)
            if len(found.star):
                break
        if not len(found.star):
            break
        found.observed[:] = rest[found.observed]
        matched = np.concatenate([matched, found.observed])
        # 3. Second sky, or misfit
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
    """Return whether a solution is a second sky: step 3; `covariance_rad2` is that of the first one."""
    cam_from_ref = Rotation.from_quat(found.cam_from_ref_xyzw)
    turn_rad = (cam_from_ref * match.cam_from_ref.inv()).as_rotvec()
    distance2 = turn_rad @ np.linalg.solve(covariance_rad2 + found.covariance_rad2, turn_rad)
    twice = len(np.intersect1d(found.star, match.star))
    is_far = turn_rad @ turn_rad > SAME_RAD**2 or twice >= MIN_EVIDENCE_MATCHES
    return bool(is_far and distance2 > SAME_SIGMAS**2)


def _compared(
    skies: list[tuple[StarMatch, Attitude]], matcher: FieldMatcher, camera: Camera
) -> Attitude:
    """Return the attitude of most matches with its rivals, or the refusal of an ambiguous frame: step 4."""
    skies.sort(key=lambda one: -len(one[0].star))
    (first, best), (second, _) = skies[:2]
    # The catalog's stars of both fields, down to the faintest match
    faintest = max(first.star.max(), second.star.max())
    rich, poor = (
        np.count_nonzero(matcher.in_field(camera, one.cam_from_ref)[0] <= faintest)
        for one in (first, second)
    )
    attitudes = tuple(one for _, one in skies)
    matches = len(first.star), len(second.star)
    if 2 * matches[1] >= matches[0] or _is_comparable(*matches, rich / (rich + poor)):
        return Attitude(AMBIGUOUS, rivals=attitudes)
    return replace(best, rivals=attitudes[1:])


def _is_comparable(matches: int, fewer: int, share: float) -> bool:
    """Whether a sky of fewer matches is comparable; `share` is the first one's share q of the catalog's stars."""
    return log10_tail(matches + fewer, matches, share) > LOG10_COMPARABLE


def _find(detections: Detections, sky: SkyIndex, quads: QuadIndex | None) -> Solution:
    """Search for a second sky: step 2 of the module. A frame's own search is called, so that it is compiled once."""
    if quads is None:
        return star_search.lost_in_space(detections, sky, MOST_LIGHTS, MAX_CHECKS)
    return star_quads.identify(detections, quads, sky, MOST_LIGHTS, QUAD_CHECKS, False)


@jit
def _unmatched(lights: FlatCentroids, sensor: Sensor, rest: NDArray) -> Detections:
    """Some rows of the lights, as detections."""
    return chosen(detections_of(lights, sensor, 0.0), rest)
