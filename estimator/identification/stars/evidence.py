"""Bayes factor of a candidate attitude from matched and missing stars.

`weigh` matches the detections to the catalog stars that the candidate attitude projects next to them, fits the attitude
(and the focal length, if it is uncertain) to the matches, and returns log10 of the Bayes factor ("dex") of the
hypothesis "this attitude" over the hypothesis "the detections are distributed at random over the sensor":

    dex = sum_k log10( N(residual_k) / rho ) + sum_k log10( p(magnitude_k | star) / p(magnitude_k) )
          + log10( (2 pi)^(n/2) / sqrt(det info) / V ) + log10 B(matched + 1, missing + 1) - penalty

rho is the density of detections on the sensor and info the n x n Fisher information of the fit. V is the prior volume
of attitudes (8 pi^2) and focal lengths; the term with V is Laplace's approximation of the integral over them. By
Markov's inequality, random detections reach x dex for any attitude in at most one of 10^x frames.
"""

from __future__ import annotations

from math import lgamma, log, log10, pi, sqrt
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from estimator.catalog.sky_index import MAG_BLUR, MAG_STEP, Sky, nearest
from estimator.catalog.spatial_grid import cell_of
from estimator.core import least_squares, vectors
from estimator.core.arrays import Floats
from estimator.core.jit import jit

GATE = 3.5  # matching radius in standard deviations: it loses one true match in 450
LEAST = 3  # matches needed for a solution
# Fraction of stars whose magnitude disagrees with the catalog: variable stars, doubles, an unusual passband.
MAG_ODD = 0.05
# Penalty for unmatched detections brighter than the faintest match, for each one in excess of the number of matches.
UNMATCHED_PENALTY_DEX = 0.5
INNER = 0.97  # fraction of the field in which an unmatched star counts as missing; the border may cut it off


class Detections(NamedTuple):
    """The detections of one frame. A named tuple, because numba can compile functions that take one.

    tangent : (N, 2) x / z and y / z in camera axes, brightest first
    sigma   : (N,) standard deviation of a tangent along the major axis of its error ellipse
    weight  : (N, 3) inverse covariance of the tangents: xx, yy, xy
    mag     : (N,) magnitudes on the catalog's scale, NaN if unknown;  mag_sigma : their standard deviation
    field   : (4,) tangents left, right, top, bottom of the sensor's edges
    zoom    : relative uncertainty of the focal length; 0 for a calibrated camera
    """

    tangent: Floats
    sigma: Floats
    weight: Floats
    mag: Floats
    mag_sigma: float
    field: Floats
    zoom: float


class Hypothesis(NamedTuple):
    """A hypothesis: candidate attitude, matches and evidence.

    observed, star : (K,) rows of detections and of stars;  R_cam_from_ref : (3, 3)
    zoom : ratio of the true to the assumed focal length
    info : (4, 4) Fisher information of the small rotation in camera axes and of log zoom
    dex  : log10 of the Bayes factor
    """

    observed: NDArray[np.int64]
    star: NDArray[np.int64]
    R_cam_from_ref: Floats
    zoom: float
    info: Floats
    dex: float


class Solution(NamedTuple):
    """The solution from all detections and stars.

    observed, star : (K,) rows of detections and of stars; empty if there is no solution
    cam_from_ref_xyzw : (4,);  covariance_rad2 : (3, 3) of the small rotation in camera axes
    zoom : ratio of the true to the assumed focal length;  rms : of the residuals, tangents
    dex  : log10 of the Bayes factor
    """

    observed: NDArray[np.int64]
    star: NDArray[np.int64]
    cam_from_ref_xyzw: Floats
    covariance_rad2: Floats
    zoom: float
    rms: float
    dex: float


@jit
def no_hypothesis() -> Hypothesis:
    """The empty hypothesis, with evidence -inf."""
    return Hypothesis(np.empty(0, np.int64), np.empty(0, np.int64), np.eye(3), 1.0, np.eye(4), -np.inf)


@jit
def share_at(sky: Sky, mag: float) -> float:
    """Probability density of the catalog's magnitudes at `mag`, 1 / mag."""
    return sky.share[cell_of((mag - sky.mag[0]) / MAG_STEP, len(sky.share) - 1)]


@jit
def ray(tangent: Floats, n: int, zoom: float) -> vectors.Vector:
    """Unit vector of detection n in camera axes, for a focal length `zoom` times the assumed one."""
    x, y = tangent[n, 0] / zoom, tangent[n, 1] / zoom
    inverse = 1 / sqrt(x * x + y * y + 1)
    return x * inverse, y * inverse, inverse


@jit
def volume_dex(lights: Detections) -> float:
    """log10 of the prior volume: 8 pi^2 of attitudes times the width of the interval of log zoom."""
    return log10(8 * pi * pi) + (log10(2 * lights.zoom) if lights.zoom > 0 else 0.0)


@jit
def area(lights: Detections) -> float:
    return (lights.field[1] - lights.field[0]) * (lights.field[3] - lights.field[2])


@jit
def turned(matrix: Floats, u: vectors.Vector) -> vectors.Vector:
    return (
        matrix[0, 0] * u[0] + matrix[0, 1] * u[1] + matrix[0, 2] * u[2],
        matrix[1, 0] * u[0] + matrix[1, 1] * u[1] + matrix[1, 2] * u[2],
        matrix[2, 0] * u[0] + matrix[2, 1] * u[1] + matrix[2, 2] * u[2],
    )


@jit
def evaluate(
    lights: Detections, sky: Sky, R_cam_from_ref: Floats, zoom: float, gates: Floats, floor_dex: float
) -> Hypothesis:
    """Evaluate a candidate attitude: match detections to stars, fit attitude and zoom (twice), compute the evidence.

    gates : (N,) rad, matching radius of each detection in the first round; later rounds use GATE standard deviations

    R_cam_from_ref is changed in place by the fit. Returns the empty hypothesis if fewer than LEAST stars match, the
    zoom leaves its interval, or the evidence is below floor_dex. The last test is made early with an upper bound of
    the evidence (exact matches, no missing star), which rejects most false candidates before the full evaluation.
    """
    R, info = R_cam_from_ref, np.zeros((4, 4))
    own = GATE * lights.sigma
    for turn in range(3):
        observed, star = _match(lights, sky, R, zoom, own if turn else gates, GATE if turn else np.inf)
        if len(observed) < LEAST:
            return no_hypothesis()
        if turn == 1:
            # `info` is that of the first fit; without the residuals the evidence is an upper bound.
            most_dex = _evidence(lights, sky, R, zoom, observed, star, info, False)
            if most_dex + _seen_dex(len(observed), 0) < floor_dex:
                return no_hypothesis()
        if turn < 2:
            zoom = _fit(lights, sky, R, zoom, observed, star, info)
            if abs(zoom - 1) > 1.2 * lights.zoom + 1e-12:
                return no_hypothesis()
    dex, seen = _evidence(lights, sky, R, zoom, observed, star, info, True), len(observed)
    if dex + _seen_dex(seen, 0) < floor_dex:
        return no_hypothesis()
    dex += _seen_dex(seen, _missed(lights, sky, R, zoom, observed, star))
    return Hypothesis(observed, star, R, zoom, info, dex)


@jit
def _match(
    lights: Detections, sky: Sky, R_cam_from_ref: Floats, zoom: float, gates: Floats, most_sigma: float
) -> tuple[NDArray, NDArray]:
    """Match each detection to its nearest star, within gates[n] rad and most_sigma standard deviations.

    If two detections match one star, the one with the smaller Mahalanobis distance keeps it. Returns the rows of the
    detections and of the stars.
    """
    total, count = len(lights.sigma), 0
    observed, star, gap = np.empty(total, np.int64), np.empty(total, np.int64), np.empty(total)
    R_ref_from_cam, tangent, vectors_ref = R_cam_from_ref.T.copy(), lights.tangent, sky.vectors
    cell_first, cell_star, side = sky.cell_first, sky.cell_star, sky.side
    for n in range(total):
        x, y, z = turned(R_ref_from_cam, ray(tangent, n, zoom))
        s, _ = nearest(vectors_ref, cell_first, cell_star, side, x, y, z, gates[n])
        if s < 0:
            continue
        off2 = misfit2(lights, sky, R_cam_from_ref, zoom, n, s)
        if off2 > most_sigma**2:
            continue
        place = 0  # of an earlier match of the same star, or `count`
        while place < count and star[place] != s:
            place += 1
        if place == count:
            count += 1
        elif off2 >= gap[place]:
            continue
        observed[place], star[place], gap[place] = n, s, off2
    return observed[:count], star[:count]


@jit
def predicted(vectors_ref: Floats, R: Floats, star: int) -> vectors.Vector:
    """Project a star into camera axes: x / z, y / z, and z."""
    x, y, z = turned(R, vectors.row(vectors_ref, star))
    return x / z, y / z, z


@jit
def misfit2(
    lights: Detections, sky: Sky, R_cam_from_ref: Floats, zoom: float, light: int, star: int
) -> float:
    """Squared Mahalanobis distance of a detection from a star's predicted image."""
    x, y, _ = predicted(sky.vectors, R_cam_from_ref, star)
    off_x, off_y = lights.tangent[light, 0] - zoom * x, lights.tangent[light, 1] - zoom * y
    xx, yy, xy = vectors.row(lights.weight, light)
    return xx * off_x * off_x + 2 * xy * off_x * off_y + yy * off_y * off_y


@jit
def _fit(
    lights: Detections,
    sky: Sky,
    R_cam_from_ref: Floats,
    zoom: float,
    observed: NDArray,
    star: NDArray,
    info: Floats,
) -> float:
    """One weighted Gauss-Newton step of the attitude (in place) and of the zoom (returned).

    With t = zoom (x, y) / z and a small rotation q <- q + w x q, the derivative of t_x with respect to w is
    zoom (-x y / z^2, 1 + x^2 / z^2, -y / z), that of t_y is zoom (-1 - y^2 / z^2, x y / z^2, x / z), and that of t with
    respect to log zoom is t itself. The (4, 4) Fisher information is written to `info`.
    """
    count = 4 if lights.zoom > 0 else 3
    info[:] = 0.0
    pull, by_x, by_y = np.zeros(4), np.zeros(4), np.zeros(4)
    tangent, weight, vectors_ref = lights.tangent, lights.weight, sky.vectors
    for k in range(len(observed)):
        x, y, _ = predicted(vectors_ref, R_cam_from_ref, star[k])
        by_x[0], by_x[1], by_x[2], by_x[3] = -zoom * x * y, zoom * (1 + x * x), -zoom * y, zoom * x
        by_y[0], by_y[1], by_y[2], by_y[3] = -zoom * (1 + y * y), zoom * x * y, zoom * x, zoom * y
        xx, yy, xy = vectors.row(weight, observed[k])
        off_x, off_y = tangent[observed[k], 0] - zoom * x, tangent[observed[k], 1] - zoom * y
        for i in range(count):
            heavy_x, heavy_y = by_x[i] * xx + by_y[i] * xy, by_x[i] * xy + by_y[i] * yy
            pull[i] += heavy_x * off_x + heavy_y * off_y
            for j in range(i + 1):
                info[i, j] += heavy_x * by_x[j] + heavy_y * by_y[j]
    factor = info[:count, :count].copy()
    step = solved(factor, pull[:count])
    for i in range(4):
        for j in range(i):
            info[j, i] = info[i, j]
    vectors.turn(step[:3], R_cam_from_ref)
    return zoom * np.exp(step[3]) if count == 4 else zoom


@jit
def solved(a: Floats, b: Floats) -> Floats:
    """Solve a x = b by Cholesky factorization; the lower triangle of `a` is replaced by its factor.

    Pivots are floored, so that a nearly singular matrix gives large but finite values.
    """
    x = b.copy()
    for i in range(len(b)):
        for j in range(i + 1):
            for k in range(j):
                a[i, j] -= a[i, k] * a[j, k]
            a[i, j] = sqrt(max(a[i, i], 1e-300)) if i == j else a[i, j] / a[j, j]
    least_squares.solve(a, x)
    return x


@jit
def _missed(lights: Detections, sky: Sky, R: Floats, zoom: float, observed: NDArray, star: NDArray) -> int:
    """Number of missing stars: brighter than the faintest matched star, well inside the field, and not matched."""
    left, right, top, bottom = lights.field * (INNER / zoom)
    vectors_ref, inside = sky.vectors, 0
    # Cosine of the angle from the boresight to the farthest corner: it rejects most stars with one dot product.
    corner = 1 / sqrt(1 + max(left * left, right * right) + max(top * top, bottom * bottom))
    for s in range(star.max() + 1):  # stars are sorted by brightness
        x, y, z = vectors.row(vectors_ref, s)
        if R[2, 0] * x + R[2, 1] * y + R[2, 2] * z > corner:
            x, y, z = turned(R, (x, y, z))
            inside += left * z < x < right * z and top * z < y < bottom * z
    matched = 0
    for s in star:
        x, y, _ = predicted(vectors_ref, R, s)
        matched += left < x < right and top < y < bottom
    return inside - matched


@jit
def _evidence(
    lights: Detections,
    sky: Sky,
    R: Floats,
    zoom: float,
    observed: NDArray,
    star: NDArray,
    info: Floats,
    misfit: bool,
) -> float:
    """log10 of the Bayes factor of this attitude over detections at random positions, without the term `_seen_dex`.

    Each match contributes N(residual) / rho, rho the density of detections on the sensor, and the ratio of `_mag_dex`.
    The attitude and the zoom contribute sqrt(2 pi)^n / sqrt(det info) over their prior volume (Laplace's
    approximation). Unmatched detections cost nothing as long as they are no more than the matches; each one above
    that, among the detections brighter than the faintest match, costs TOLL_DEX.
    misfit : include the residuals; without them the result is an upper bound for these matches
    """
    count = 4 if lights.zoom > 0 else 3
    factor = info[:count, :count].copy()
    solved(factor, np.zeros(count))
    total = 0.5 * count * log10(2 * pi) - volume_dex(lights)
    for i in range(count):  # the product of the Cholesky factor's diagonal is sqrt(det info)
        total -= log10(factor[i, i])
    as_bright = _share_to(sky, lights.mag)
    for k in range(len(observed)):
        # Every number of false detections is equally probable a priori, so that n of them against n - m contribute the
        # ratio n! / (n - m)!: the density drops by one detection per match.
        density = (len(lights.sigma) - k) / area(lights)
        xx, yy, xy = vectors.row(lights.weight, observed[k])
        total -= log10(2 * pi * density / sqrt(xx * yy - xy * xy))
        if misfit:
            total -= misfit2(lights, sky, R, zoom, observed[k], star[k]) / 2 / log(10.0)
        total += _mag_dex(lights, sky, observed[k], star[k], as_bright)
    return total - UNMATCHED_PENALTY_DEX * max(observed.max() + 1 - 2.0 * len(observed), 0.0)


@jit
def _seen_dex(seen: int, missed: int) -> float:
    """log10 B(seen + 1, missed + 1): likelihood of the counts, with a uniform prior on the detection probability."""
    return (lgamma(seen + 1.0) + lgamma(missed + 1.0) - lgamma(seen + missed + 2.0)) / log(10.0)


@jit
def _share_to(sky: Sky, mag: Floats) -> float:
    """Fraction of the stars that are at least as bright as the faintest detection; 1 if magnitudes are unknown."""
    faintest = mag[0]
    for one in mag:
        faintest = max(faintest, one)
    if not np.isfinite(faintest):
        return 1.0
    return max(np.searchsorted(sky.mag, faintest + MAG_BLUR), 1) / len(sky.mag)


@jit
def _mag_dex(lights: Detections, sky: Sky, light: int, star: int, as_bright: float) -> float:
    """log10 of the likelihood ratio of a detection's magnitude: given its star, over a random star as bright as these.

    A fraction MAG_ODD of the stars is taken to have any magnitude, so that one outlier costs log10(MAG_ODD) at most.
    Returns 0 if the magnitude is unknown.
    """
    off = lights.mag[light] - sky.mag[star]
    if not np.isfinite(off):
        return 0.0
    share = share_at(sky, lights.mag[light]) / as_bright
    likely = np.exp(-0.5 * (off / lights.mag_sigma) ** 2) / lights.mag_sigma / sqrt(2 * pi)
    return log10(MAG_ODD + (1 - MAG_ODD) * likely / share)


@jit
def fixed(lights: Detections, stars: Sky, guess: Hypothesis) -> Solution:
    """The solution of a hypothesis, with attitude covariance and rms residual.

    The covariance is marginalized over the zoom if the focal length is uncertain.
    """
    covariance, total, count = np.zeros((3, 3)), 0.0, 4 if lights.zoom > 0 else 3
    for axis in range(3):
        unit = np.zeros(count)
        unit[axis] = 1.0
        covariance[axis] = solved(guess.info[:count, :count].copy(), unit)[:3]
    for k in range(len(guess.star)):
        x, y, _ = predicted(stars.vectors, guess.R_cam_from_ref, guess.star[k])
        tx, ty = lights.tangent[guess.observed[k], 0], lights.tangent[guess.observed[k], 1]
        total += (tx - guess.zoom * x) ** 2 + (ty - guess.zoom * y) ** 2
    rms = sqrt(total / max(2 * len(guess.star), 1))
    xyzw = vectors.xyzw_of(guess.R_cam_from_ref)
    return Solution(guess.observed, guess.star, xyzw, covariance, guess.zoom, rms, guess.dex)
