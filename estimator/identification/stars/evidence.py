"""What an attitude under the stars is worth: the stars that it puts where lights are, as evidence."""

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

GATE = 3.5  # standard deviations within which a light is a star's: one in 450 is lost
LEAST = 3  # matches
MAG_ODD = (
    0.05  # of the stars have another magnitude than the catalogue's: variables, doubles, what a filter does
)
TOLL_DEX = 0.5  # for each light of no star, as bright as those matched, by which these outnumber the matches
INNER = 0.97  # of the field: a star nearer to its border may be cut off, which is no reason to miss it


class Lights(NamedTuple):
    """What is seen. A plain tuple, so that compiled code can take it.

    tangent : (N, 2) x / z and y / z in camera axes, brightest first
    sigma   : (N,) in the direction of the greatest error;  weight : (N, 3) the inverse covariance: xx, yy, xy
    mag     : (N,) magnitudes on the catalogue's scale, mag_sigma their error; NaN where they are not known
    field   : (4,) tangents left, right, top, bottom of the sensor's edges
    zoom    : the share by which the focal length may differ; 0 for a camera that is known
    """

    tangent: Floats
    sigma: Floats
    weight: Floats
    mag: Floats
    mag_sigma: float
    field: Floats
    zoom: float


class Guess(NamedTuple):
    """An attitude with what speaks for it.

    observed, star : (K,) rows of lights and stars;  R_cam_from_ref : (3, 3)
    zoom : the true focal length over the believed;  info : (4, 4) of the small turn in camera axes and of log zoom
    dex  : evidence in powers of ten
    """

    observed: NDArray[np.int64]
    star: NDArray[np.int64]
    R_cam_from_ref: Floats
    zoom: float
    info: Floats
    dex: float


class Fix(NamedTuple):
    """An attitude from all lights and stars.

    observed, star : (K,) rows; none where there is no attitude
    cam_from_ref_xyzw : (4,);  covariance_rad2 : (3, 3) of the small turn in camera axes
    zoom : the true focal length over the believed;  rms : of the residuals, tangents;  dex : evidence in powers of ten
    """

    observed: NDArray[np.int64]
    star: NDArray[np.int64]
    cam_from_ref_xyzw: Floats
    covariance_rad2: Floats
    zoom: float
    rms: float
    dex: float


@jit
def nothing() -> Guess:
    """No attitude."""
    return Guess(np.empty(0, np.int64), np.empty(0, np.int64), np.eye(3), 1.0, np.eye(4), -np.inf)


@jit
def share_at(sky: Sky, mag: float) -> float:
    """Density of the catalogue's magnitudes at one."""
    return sky.share[cell_of((mag - sky.mag[0]) / MAG_STEP, len(sky.share) - 1)]


@jit
def ray(tangent: Floats, n: int, zoom: float) -> vectors.Vector:
    """Unit vector of a light for a focal length `zoom` times the believed one."""
    x, y = tangent[n, 0] / zoom, tangent[n, 1] / zoom
    inverse = 1 / sqrt(x * x + y * y + 1)
    return x * inverse, y * inverse, inverse


@jit
def volume_dex(lights: Lights) -> float:
    """log10 of the volume of all attitudes, 8 pi^2, and of all zooms."""
    return log10(8 * pi * pi) + (log10(2 * lights.zoom) if lights.zoom > 0 else 0.0)


@jit
def area(lights: Lights) -> float:
    return (lights.field[1] - lights.field[0]) * (lights.field[3] - lights.field[2])


@jit
def turned(matrix: Floats, u: vectors.Vector) -> vectors.Vector:
    return (
        matrix[0, 0] * u[0] + matrix[0, 1] * u[1] + matrix[0, 2] * u[2],
        matrix[1, 0] * u[0] + matrix[1, 1] * u[1] + matrix[1, 2] * u[2],
        matrix[2, 0] * u[0] + matrix[2, 1] * u[1] + matrix[2, 2] * u[2],
    )


@jit
def weigh(
    lights: Lights, sky: Sky, R_cam_from_ref: Floats, zoom: float, gates: Floats, floor_dex: float
) -> Guess:
    """Match the field at an attitude (turned in place), fit it to the matches, twice, and weigh what they match.

    Nothing where the evidence is below floor_dex, or would be though every match were exact and no star missed: that
    is seen before most of the work.
    """
    R, info = R_cam_from_ref, np.zeros((4, 4))
    own = GATE * lights.sigma
    for turn in range(3):
        observed, star = _match(lights, sky, R, zoom, own if turn else gates, GATE if turn else np.inf)
        if len(observed) < LEAST:
            return nothing()
        if turn == 1:
            most_dex = _evidence(lights, sky, R, zoom, observed, star, info, False)
            if most_dex + _seen_dex(len(observed), 0) < floor_dex:
                return nothing()
        if turn < 2:
            zoom = _fit(lights, sky, R, zoom, observed, star, info)
            if abs(zoom - 1) > 1.2 * lights.zoom + 1e-12:
                return nothing()
    dex, seen = _evidence(lights, sky, R, zoom, observed, star, info, True), len(observed)
    if dex + _seen_dex(seen, 0) < floor_dex:
        return nothing()
    dex += _seen_dex(seen, _missed(lights, sky, R, zoom, observed, star))
    return Guess(observed, star, R, zoom, info, dex)


@jit
def _match(
    lights: Lights, sky: Sky, R_cam_from_ref: Floats, zoom: float, gates: Floats, most_sigma: float
) -> tuple[NDArray, NDArray]:
    """Each light's nearest star within its gate and so many of its errors; of two lights at one star the nearer."""
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
        place = 0
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
    """A star in camera axes: tangents of x and y, and z."""
    x, y, z = turned(R, vectors.row(vectors_ref, star))
    return x / z, y / z, z


@jit
def misfit2(lights: Lights, sky: Sky, R_cam_from_ref: Floats, zoom: float, light: int, star: int) -> float:
    """Square of a light's distance from a star in its own standard deviations (Mahalanobis)."""
    x, y, _ = predicted(sky.vectors, R_cam_from_ref, star)
    off_x, off_y = lights.tangent[light, 0] - zoom * x, lights.tangent[light, 1] - zoom * y
    xx, yy, xy = vectors.row(lights.weight, light)
    return xx * off_x * off_x + 2 * xy * off_x * off_y + yy * off_y * off_y


@jit
def _fit(
    lights: Lights,
    sky: Sky,
    R_cam_from_ref: Floats,
    zoom: float,
    observed: NDArray,
    star: NDArray,
    info: Floats,
) -> float:
    """One Gauss-Newton step of the attitude (in place) and of the zoom (returned), weighted by the lights' errors.

    With t = zoom (x, y) / z and q <- q + w x q the slopes of t_x by w are zoom (-x y / z^2, 1 + x^2 / z^2, -y / z), of
    t_y zoom (-1 - y^2 / z^2, x y / z^2, x / z), and both by log zoom t itself. Leaves the information in `info`.
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
    """x of a x = b by Cholesky; `a` (its lower half) becomes the factor, be it as good as singular."""
    x = b.copy()
    for i in range(len(b)):
        for j in range(i + 1):
            for k in range(j):
                a[i, j] -= a[i, k] * a[j, k]
            a[i, j] = sqrt(max(a[i, i], 1e-300)) if i == j else a[i, j] / a[j, j]
    least_squares.solve(a, x)
    return x


@jit
def _missed(lights: Lights, sky: Sky, R: Floats, zoom: float, observed: NDArray, star: NDArray) -> int:
    """How many stars that are brighter than the faintest match, and well within the field, no light is matched to."""
    left, right, top, bottom = lights.field * (INNER / zoom)
    vectors_ref, inside = sky.vectors, 0
    corner = 1 / sqrt(1 + max(left * left, right * right) + max(top * top, bottom * bottom))
    for s in range(star.max() + 1):
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
    lights: Lights,
    sky: Sky,
    R: Floats,
    zoom: float,
    observed: NDArray,
    star: NDArray,
    info: Floats,
    misfit: bool,
) -> float:
    """How many powers of ten more probable the lights are at this attitude than fallen anywhere (Bayes' factor).

    But for `_seen_dex`. Each match is worth N(residual) / rho, rho the lights on the sensor's area, and as much for the
    magnitude; the attitude is one among all: sqrt(2 pi)^n / sqrt(det info) of their volume (Laplace's integral over
    it). Among lights that fell anywhere evidence beyond 10^x for any attitude is met once in 10^x frames at most
    (Markov's inequality). So much for strangers up to half of the lights; more of them are less and less likely
    (TOLL_DEX).
    misfit : whether the residuals count; without them it is the most that these matches could be worth
    """
    count = 4 if lights.zoom > 0 else 3
    factor = info[:count, :count].copy()
    solved(factor, np.zeros(count))
    total = 0.5 * count * log10(2 * pi) - volume_dex(lights)
    for i in range(count):
        total -= log10(factor[i, i])
    as_bright = _share_to(sky, lights.mag)
    for k in range(len(observed)):
        # Any number of false lights being as probable, n of them are n! / (n - m)! times as many as n - m.
        density = (len(lights.sigma) - k) / area(lights)
        xx, yy, xy = vectors.row(lights.weight, observed[k])
        total -= log10(2 * pi * density / sqrt(xx * yy - xy * xy))
        if misfit:
            total -= misfit2(lights, sky, R, zoom, observed[k], star[k]) / 2 / log(10.0)
        total += _mag_dex(lights, sky, observed[k], star[k], as_bright)
    return total - TOLL_DEX * max(observed.max() + 1 - 2.0 * len(observed), 0.0)


@jit
def _seen_dex(seen: int, missed: int) -> float:
    """That so many of the stars are seen and so many are not: B(m + 1, k + 1), every share being as probable before."""
    return (lgamma(seen + 1.0) + lgamma(missed + 1.0) - lgamma(seen + missed + 2.0)) / log(10.0)


@jit
def _share_to(sky: Sky, mag: Floats) -> float:
    """Share of the stars that are as bright as the faintest of the lights."""
    faintest = mag[0]
    for one in mag:
        faintest = max(faintest, one)
    if not np.isfinite(faintest):
        return 1.0
    return max(np.searchsorted(sky.mag, faintest + MAG_BLUR), 1) / len(sky.mag)


@jit
def _mag_dex(lights: Lights, sky: Sky, light: int, star: int, as_bright: float) -> float:
    """What a light's magnitude says for a star, dex: N(difference) over its density among stars as bright as these.

    MAG_ODD of the stars have any magnitude.
    """
    off = lights.mag[light] - sky.mag[star]
    if not np.isfinite(off):
        return 0.0
    share = share_at(sky, lights.mag[light]) / as_bright
    likely = np.exp(-0.5 * (off / lights.mag_sigma) ** 2) / lights.mag_sigma / sqrt(2 * pi)
    return log10(MAG_ODD + (1 - MAG_ODD) * likely / share)


@jit
def fixed(lights: Lights, stars: Sky, guess: Guess) -> Fix:
    """A guess with its errors. The covariance is of the attitude with the zoom unknown, where it is."""
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
    return Fix(guess.observed, guess.star, xyzw, covariance, guess.zoom, rms, guess.dex)
