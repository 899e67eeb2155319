"""Bayes factor of a candidate attitude from matched and missing stars.

`evaluate` matches the detections to the catalog stars that a candidate attitude projects next to them, fits the
attitude to the matches, and returns log10 of the Bayes factor ("dex"): the probability of the detections if the
attitude is true, over that if they are distributed at random over the sensor.

    dex = sum_k log10( N(residual_k) / rho )               positions of the matched detections
        + sum_k log10( p(mag_k | star) / p(mag_k) )        their magnitudes
        + log10( (2 pi)^(n/2) / sqrt(det info) / V )       attitude and focal length
        + log10 B(matched + 1, missing + 1)                counts of matched and missing stars
        - UNMATCHED_PENALTY_DEX * excess                   unmatched detections in excess of the matches

N is the Gaussian of a residual, rho the density of detections on the sensor, and info the n x n Fisher information of
the fit (n = 3, or 4 with an uncertain focal length). V is the prior volume of attitudes (8 pi^2) and focal lengths; the
term with V is Laplace's approximation of the integral over them. By Markov's inequality, random detections reach x dex
at any attitude in at most one of 10^x frames.

The steps of `evaluate`; the same numbers return as comments in the code:

1. Match each detection to its nearest star (`_match`).
2. Fit attitude and focal ratio to the matches by one Gauss-Newton step (`_fit`).
3. Match again, with the gates of the detections alone; reject few matches of too little evidence without residuals.
4. Fit and match once more, unless the fit has converged.
5. Compute the evidence (`_evidence`), and count the missing stars (`_count_missing`).
"""

from math import lgamma, log, log10, pi, sqrt
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from estimator.catalog.pair_index import first_from
from estimator.catalog.sky_index import (
    MAG_SMOOTHING,
    Cells,
    SkyIndex,
    magnitude_density,
    nearest,
    within,
)
from estimator.core import least_squares, vectors
from estimator.core.checks import Floats
from estimator.core.jit import inlined, jit
from estimator.identification.chance import GATE_SIGMA, MIN_EVIDENCE_MATCHES, counts_dex
from estimator.identification.star_detections import (
    Detections,
    field_area,
    gates_of,
    ray,
    squared_corner,
)

MAG_OUTLIER_FRACTION = 0.05  # of stars: variables, doubles, an unusual passband
# Penalty for each detection brighter than the faintest match that is unmatched, in excess of the number of matches.
UNMATCHED_PENALTY_DEX = 0.5
UNMATCHED_SHARE = 0.5  # of the evidence that this penalty takes at most
FOCAL_MARGIN = 1.2  # greatest error of the focal length, in units of its uncertainty
INNER_FRACTION = 0.97  # of the field, where an unmatched star is missing and not cut off


class Hypothesis(NamedTuple):
    """A candidate attitude with its matches and its evidence.

    Attributes
    ----------
    observed, star
        (K,) rows of the matched detections and of their stars
    R_cam_from_ref
        (3, 3) rotation from the catalog's frame to camera axes
    focal_ratio
        Ratio of the true to the assumed focal length
    info
        (4, 4) Fisher information of a small rotation in camera axes and of log focal_ratio
    dex
        log10 of the Bayes factor
    """

    observed: NDArray[np.int64]
    star: NDArray[np.int64]
    R_cam_from_ref: Floats
    focal_ratio: float
    info: Floats
    dex: float


class Solution(NamedTuple):
    """The solution from all detections and stars.

    Attributes
    ----------
    observed, star
        (K,) rows of the matched detections and of their stars; empty if there is no solution
    cam_from_ref_xyzw
        (4,) quaternion from the catalog's frame to camera axes
    covariance_rad2
        (3, 3) covariance of the small rotation in camera axes, rad^2
    focal_ratio
        Ratio of the true to the assumed focal length
    rms
        Root mean square of the residuals along one axis, tangents
    chi2
        Sum of the squared Mahalanobis distances of the matches per degree of freedom
    dex
        log10 of the Bayes factor; without a solution -inf, or NaN if the effort of the search is used up
    """

    observed: NDArray[np.int64]
    star: NDArray[np.int64]
    cam_from_ref_xyzw: Floats
    covariance_rad2: Floats
    focal_ratio: float
    rms: float
    chi2: float
    dex: float


@jit
def no_hypothesis(dex: float = -np.inf) -> Hypothesis:
    """The empty hypothesis, with evidence -inf; with NaN of a search whose effort is used up."""
    none = np.empty(0, np.int64)
    return Hypothesis(none, none, np.eye(3), 1.0, np.eye(4), dex)


@inlined
def prior_volume_dex(detections: Detections) -> float:
    """log10 of the prior volume: 8 pi^2 of attitudes, times the width of the interval of log focal_ratio."""
    width = 2 * detections.focal_uncertainty
    return log10(8 * pi * pi) + (log10(width) if width > 0 else 0.0)


@jit
def evaluate(
    detections: Detections,
    sky: SkyIndex,
    R_cam_from_ref: Floats,
    focal_ratio: float,
    gates: Floats,
    min_dex: float,
) -> Hypothesis:
    """Match, fit and score a candidate attitude: the module's steps 1 to 5.

    Parameters
    ----------
    R_cam_from_ref, focal_ratio
        (3, 3) candidate attitude, changed in place by the fit, and ratio of the true to the assumed focal length
    gates
        (N,) rad, matching radius of each detection in the first round; later rounds use GATE_SIGMA
    min_dex
        Least evidence of interest; -inf for none

    Returns
    -------
    Hypothesis
        Empty if too few stars match, if the focal ratio leaves its interval, or if the evidence is below `min_dex`
    """
    R = R_cam_from_ref
    info = np.zeros((4, 4))
    max_sigma = np.inf
    fall = np.inf
    observed = star = np.empty(0, np.int64)
    for n in range(3):
        # 1. Match. Only the first round allows for the error of the candidate attitude.
        before = observed, star
        observed, star = _match(detections, sky, R, focal_ratio, gates, max_sigma)
        gates = gates_of(detections, 1.0)
        max_sigma = GATE_SIGMA
        if len(observed) < MIN_EVIDENCE_MATCHES:
            return no_hypothesis()
        # 3. Unless most detections match, reject early, with the information of the first fit: exact, no missing star.
        if n == 1 and min_dex > -np.inf and 2 * len(observed) < len(gates):
            dex = _evidence(detections, sky, R, focal_ratio, observed, star, info, n > 1)
            if dex + counts_dex(len(observed), 0) < min_dex:
                return no_hypothesis()
        # A fit that has converged on the same matches need not be repeated.
        same = fall < least_squares.CONVERGED_CHI2 and np.array_equal(observed, before[0])
        if same and np.array_equal(star, before[1]):
            break
        # 2. and 4. Fit; the interval of the focal ratio has a margin, as the fit is noisy.
        if n < 2:
            focal_ratio, fall = _fit(detections, sky, R, focal_ratio, observed, star, info)
            if abs(focal_ratio - 1) > FOCAL_MARGIN * detections.focal_uncertainty + 1e-12:
                return no_hypothesis()
            if n == 1 and fall < least_squares.CONVERGED_CHI2:
                break
    # 5. The evidence, with residuals: a literal True would be compiled as another type.
    dex = _evidence(detections, sky, R, focal_ratio, observed, star, info, n > 0)
    # Missing stars only reduce the evidence: count them if it suffices without any.
    if dex + counts_dex(len(observed), 0) < min_dex:
        return no_hypothesis()
    dex += counts_dex(len(observed), _count_missing(detections, sky, R, focal_ratio, star))
    return Hypothesis(observed, star, R, focal_ratio, info, dex)


@jit
def _match(
    detections: Detections,
    sky: SkyIndex,
    R: Floats,
    focal_ratio: float,
    gates: Floats,
    max_sigma: float,
) -> tuple[NDArray, NDArray]:
    """Match each detection to its nearest star: steps 1, 3 and 4.

    If two detections match one star, the one with the smaller Mahalanobis distance keeps it.

    Parameters
    ----------
    gates
        (N,) rad, greatest distance of a star
    max_sigma
        Greatest Mahalanobis distance of a star

    Returns
    -------
    tuple[NDArray, NDArray]
        (K,) rows of the detections and of the stars
    """
    total = len(detections.sigma)
    count = 0
    observed = np.empty(total, np.int64)
    star = np.empty(total, np.int64)
    distances2 = np.empty(total)
    R_ref_from_cam = R.T.copy()
    tangent = detections.tangent
    vectors_ref = sky.vectors
    cell_first = sky.cell_first
    cell_star = sky.cell_star
    side = sky.side
    for n in range(total):
        # The star nearest to the detection's direction in the catalog's frame.
        x, y, z = vectors.rotate(R_ref_from_cam, ray(tangent, n, focal_ratio))
        s, _ = nearest(vectors_ref, cell_first, cell_star, side, x, y, z, gates[n])
        if s < 0:
            continue
        # The gate is a circle; an elongated error ellipse asks for the Mahalanobis distance.
        distance2 = squared_mahalanobis(detections, sky, R, focal_ratio, n, s)
        if distance2 > max_sigma**2:
            continue
        # The slot of an earlier match of the same star, or a new one at the end.
        slot = 0
        while slot < count and star[slot] != s:
            slot += 1
        if slot == count:
            count += 1
        elif distance2 >= distances2[slot]:
            continue
        observed[slot] = n
        star[slot] = s
        distances2[slot] = distance2
    return observed[:count], star[:count]


@inlined
def focal_gain_dex(detections: Detections, sky: SkyIndex, hypothesis: Hypothesis) -> float:
    """log10 of the Bayes factor of a free focal length to the hypothesis's own focal length, with the same matches.

        fall / 2 / ln 10  +  log10( sqrt(2 pi) sigma / (2 u) )

    fall is the decrease of chi-square by one step of the fit, sigma the posterior standard deviation of log
    focal_ratio, which is the inverse of the last diagonal element of the Cholesky factor of the information, and 2
    u the width of its prior interval.
    """
    info = np.zeros((4, 4))
    R = hypothesis.R_cam_from_ref.copy()
    _, fall = _fit(
        detections, sky, R, hypothesis.focal_ratio, hypothesis.observed, hypothesis.star, info
    )
    factorize(info)
    width_dex = log10(sqrt(2 * pi) / info[3, 3] / (2 * detections.focal_uncertainty))
    return fall / 2 / log(10.0) + width_dex


@jit
def project(vectors_ref: Floats, R: Floats, star: int) -> tuple[float, float]:
    """Tangents x / z and y / z of a star in camera axes."""
    x, y, z = vectors.rotate(R, vectors.row(vectors_ref, star))
    return x / z, y / z


@jit
def squared_mahalanobis(
    detections: Detections,
    sky: SkyIndex,
    R: Floats,
    focal_ratio: float,
    detection: int,
    star: int,
) -> float:
    """Squared Mahalanobis distance of a detection from a star's predicted image: r^T W r, W the inverse covariance."""
    x, y = project(sky.vectors, R, star)
    dx = detections.tangent[detection, 0] - focal_ratio * x
    dy = detections.tangent[detection, 1] - focal_ratio * y
    xx, yy, xy = vectors.row(detections.weight, detection)
    return xx * dx * dx + 2 * xy * dx * dy + yy * dy * dy


@jit
def _fit(
    detections: Detections,
    sky: SkyIndex,
    R: Floats,
    focal_ratio: float,
    observed: NDArray,
    star: NDArray,
    info: Floats,
) -> tuple[float, float]:
    """One weighted Gauss-Newton step of the attitude R (in place) and of the focal ratio f: steps 2 and 4.

    The step is info^-1 g, info = sum J^T W J, g = sum J^T W r, r the residuals, W their inverse covariances, and J the
    derivatives of the tangents (`slopes`).

    Parameters
    ----------
    observed, star
        (K,) rows of the matched detections and of their stars
    info
        (4, 4), the Fisher information is written to it

    Returns
    -------
    tuple[float, float]
        The new focal ratio, and the fall of chi-square g . step: the squared length of the step in standard deviations
    """
    f = focal_ratio
    count = 4 if detections.focal_uncertainty > 0 else 3
    info[:] = 0.0
    gradient = np.zeros(4)
    d_x = np.zeros(4)
    d_y = np.zeros(4)
    tangent = detections.tangent
    for k in range(len(observed)):
        x, y = project(sky.vectors, R, star[k])
        slopes(x, y, f, d_x, d_y)
        # Weighted sums of the derivatives; the matrix is symmetric, so that its lower triangle suffices.
        xx, yy, xy = vectors.row(detections.weight, observed[k])
        residual_x = tangent[observed[k], 0] - f * x
        residual_y = tangent[observed[k], 1] - f * y
        for i in range(count):
            weighted_x = d_x[i] * xx + d_y[i] * xy
            weighted_y = d_x[i] * xy + d_y[i] * yy
            gradient[i] += weighted_x * residual_x + weighted_y * residual_y
            for j in range(i + 1):
                info[i, j] += weighted_x * d_x[j] + weighted_y * d_y[j]
    # Solve for the step, and complete the symmetric matrix.
    factor = info[:count, :count].copy()
    factorize(factor)
    step = gradient[:count].copy()
    least_squares.cholesky_solve(factor, step)
    for i in range(4):
        for j in range(i):
            info[j, i] = info[i, j]
    # Apply the step; its squared length is the predicted fall of chi-square.
    vectors.rotate_in_place(step[:3], R)
    fall = 0.0
    for i in range(count):
        fall += gradient[i] * step[i]
    return (f * np.exp(step[3]) if count == 4 else f), fall


@jit
def slopes(x: float, y: float, f: float, d_x: Floats, d_y: Floats) -> None:
    """Fill the derivatives (4,) of a star's tangents t with respect to a small rotation w and to log f.

    The model is t = f (x, y) / z with the star q = (x, y, z) in camera axes. The rotation changes q to q + w x q. With
    (x, y) here for (x / z, y / z),

        d t_x = f (-x y,      1 + x^2,  -y,  x)
        d t_y = f (-1 - y^2,  x y,       x,  y)
    """
    # Element by element: slices would make this function too large to be inlined.
    d_x[0] = -f * x * y
    d_x[1] = f * (1 + x * x)
    d_x[2] = -f * y
    d_x[3] = f * x
    d_y[0] = -f * (1 + y * y)
    d_y[1] = f * x * y
    d_y[2] = f * x
    d_y[3] = f * y


@jit
def factorize(a: Floats) -> None:
    """Replace the lower triangle of a matrix by its Cholesky factor.

    Pivots are floored, so that a nearly singular matrix gives large but finite solutions.
    """
    for i in range(len(a)):
        for j in range(i + 1):
            # a_ij - sum over k < j of L_ik L_jk, then the pivot or the quotient.
            for k in range(j):
                a[i, j] -= a[i, k] * a[j, k]
            a[i, j] = sqrt(max(a[i, i], 1e-300)) if i == j else a[i, j] / a[j, j]


@inlined
def _count_missing(
    detections: Detections, sky: SkyIndex, R: Floats, focal_ratio: float, star: NDArray
) -> int:
    """Number of missing stars: well inside the field, not matched, and bright enough to be detected.

    A star is bright enough if it is as bright as the faintest matched one, or brighter than `detections.limit_mag`,
    if that is known.

    Parameters
    ----------
    star
        (K,) rows of the matched stars
    """
    inner = detections.field * (INNER_FRACTION / focal_ratio)
    left, right, top, bottom = inner
    # Stars are sorted by brightness: the row of the faintest detectable star bounds them all.
    matched = 0
    faintest = np.int64(0)
    if np.isfinite(detections.limit_mag):
        faintest = first_from(sky.mag, 0, len(sky.mag), detections.limit_mag) - 1
    for s in star:
        x, y = project(sky.vectors, R, s)
        matched += left < x < right and top < y < bottom
        faintest = max(faintest, s)
    # Chord of the angle from the boresight to the farthest corner; a hair longer, so that rounding excludes no star.
    chord = sqrt(2 - 2 / sqrt(1 + squared_corner(inner))) * (1 + 1e-9)
    bx, by, bz = vectors.row(R, 2)
    # Stars within the circle around the field, then those in the field.
    near = np.empty(len(sky.vectors), np.int64)
    cells = Cells(sky.side, sky.cell_first, sky.cell_star)
    count = within(cells, sky.vectors, bx, by, bz, chord, near)
    inside = 0
    for s in near[:count]:
        if s > faintest:
            continue
        x, y, z = vectors.rotate(R, vectors.row(sky.vectors, s))
        inside += left * z < x < right * z and top * z < y < bottom * z
    return inside - matched


@jit
def _evidence(
    detections: Detections,
    sky: SkyIndex,
    R: Floats,
    focal_ratio: float,
    observed: NDArray,
    star: NDArray,
    info: Floats,
    with_residuals: bool,
) -> float:
    """log10 of the Bayes factor of an attitude, without the term `counts_dex` (see the module's equation).

    Parameters
    ----------
    observed, star
        (K,) rows of the matched detections and of their stars
    info
        (4, 4) Fisher information of the fit
    with_residuals
        Whether the residuals count; without them the result is an upper bound for these matches

    Returns
    -------
    float
        dex, of all detections or of the brightest ones down to any match, whichever is greater. Unmatched detections
        cost nothing as long as they are no more than the matches; each further one among the detections brighter than
        that match costs UNMATCHED_PENALTY_DEX
    """
    # Attitude and focal length: (2 pi)^(n/2) / sqrt(det info) over the prior volume.
    count = 4 if detections.focal_uncertainty > 0 else 3
    factor = info[:count, :count].copy()
    factorize(factor)
    total = 0.5 * count * log10(2 * pi) - prior_volume_dex(detections)
    for i in range(count):  # the product of the Cholesky factor's diagonal is sqrt(det info)
        total -= log10(factor[i, i])
    # Positions and magnitudes of the matched detections.
    fraction_brighter = _fraction_brighter(sky, detections.mag)
    lights = len(detections.sigma)
    prefix = np.int64(0)
    best = -np.inf
    for k in range(len(observed)):
        prefix = max(prefix, observed[k] + 1)
        xx, yy, xy = vectors.row(detections.weight, observed[k])
        ratio = _magnitude_ratio(detections, sky, observed[k], star[k], fraction_brighter)
        total += log10(ratio * sqrt(xx * yy - xy * xy) / (2 * pi) * field_area(detections))
        if with_residuals:
            distance2 = squared_mahalanobis(
                detections, sky, R, focal_ratio, observed[k], star[k]
            )
            total -= distance2 / 2 / log(10.0)
        if k + 1 >= MIN_EVIDENCE_MATCHES:
            # Only the detections down to this one count; any number of them is equally probable.
            dex = total - log10(lights) - _ways_dex(prefix, k + 1)
            best = max(best, dex - _unmatched_dex(prefix, k + 1, dex))
    # All detections count.
    dex = total - _ways_dex(lights, len(observed))
    return max(best, dex - _unmatched_dex(prefix, len(observed), dex))


@jit
def _unmatched_dex(lights: int, matched: int, dex: float) -> float:
    """Penalty of unmatched detections in excess of the matches, of `lights` detections with the evidence `dex`."""
    excess = max(lights - 2.0 * matched, 0.0)
    return min(UNMATCHED_PENALTY_DEX * excess, UNMATCHED_SHARE * max(dex, 0.0))


@jit
def _ways_dex(lights: int, matched: int) -> float:
    """log10 of lights! / (lights - matched)!, the number of ways to choose the detections of the matched stars.

    Every number of false detections is equally probable a priori: of n detections, m matches leave n - m false ones,
    and the density drops by one detection per match.
    """
    return (lgamma(lights + 1.0) - lgamma(lights - matched + 1.0)) / log(10.0)


@inlined
def _fraction_brighter(sky: SkyIndex, mag: Floats) -> float:
    """Fraction of the stars that are at least as bright as the faintest detection; 1 if magnitudes are unknown."""
    faintest = mag.max()
    if not np.isfinite(faintest):
        return 1.0
    return max(first_from(sky.mag, 0, len(sky.mag), faintest + MAG_SMOOTHING), 1) / len(
        sky.mag
    )


@inlined
def _magnitude_ratio(
    detections: Detections, sky: SkyIndex, detection: int, star: int, fraction_brighter: float
) -> float:
    """Likelihood ratio of a detection's magnitude: given its star, over a random star as bright as the detections.

        ratio = e + (1 - e) N(mag - star's mag) / p(mag)

    A fraction e = MAG_OUTLIER_FRACTION of the stars is taken to have any magnitude, so that one outlier costs at
    most that factor. p is the density of the catalog's magnitudes among the stars that are bright enough. Returns 1
    if the magnitude is unknown.
    """
    difference = detections.mag[detection] - sky.mag[star]
    if not np.isfinite(difference):
        return 1.0
    relative_density = magnitude_density(sky, detections.mag[detection]) / fraction_brighter
    # The Gaussian density of the difference.
    likelihood = (
        np.exp(-0.5 * (difference / detections.mag_sigma) ** 2)
        / detections.mag_sigma
        / sqrt(2 * pi)
    )
    return MAG_OUTLIER_FRACTION + (1 - MAG_OUTLIER_FRACTION) * likelihood / relative_density


@jit
def build_solution(
    detections: Detections, stars: SkyIndex, hypothesis: Hypothesis
) -> Solution:
    """The solution of a hypothesis, with its covariance and its residuals.

    The covariance is the attitude's block of info^-1: if the focal length is uncertain, it is marginalized over the
    focal ratio.
    """
    total = 0.0
    chi2 = 0.0
    count = 4 if detections.focal_uncertainty > 0 else 3
    # Column by column of the inverse of the Fisher information.
    factor = hypothesis.info[:count, :count].copy()
    factorize(factor)
    inverse = np.eye(count)
    for axis in range(3):
        least_squares.cholesky_solve(factor, inverse[axis])
    # Residuals: weighted by the inverse covariances for chi-square, and plain for the rms.
    for k in range(len(hypothesis.star)):
        observed = hypothesis.observed[k]
        star = hypothesis.star[k]
        chi2 += squared_mahalanobis(
            detections,
            stars,
            hypothesis.R_cam_from_ref,
            hypothesis.focal_ratio,
            observed,
            star,
        )
        x, y = project(stars.vectors, hypothesis.R_cam_from_ref, star)
        tx = detections.tangent[observed, 0]
        ty = detections.tangent[observed, 1]
        total += (tx - hypothesis.focal_ratio * x) ** 2 + (
            ty - hypothesis.focal_ratio * y
        ) ** 2
    # Two residuals for each match, of which `count` are used up by the fit.
    rms = sqrt(total / max(2 * len(hypothesis.star), 1))
    chi2 /= max(2 * len(hypothesis.star) - count, 1)
    xyzw = vectors.quaternion_xyzw(hypothesis.R_cam_from_ref)
    return Solution(
        hypothesis.observed,
        hypothesis.star,
        xyzw,
        inverse[:3, :3].copy(),
        hypothesis.focal_ratio,
        rms,
        chi2,
        hypothesis.dex,
    )
