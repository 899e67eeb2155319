"""Streak fit of one smeared star: a line segment blurred by a Gaussian, by weighted least squares.

The model is a uniform segment of length L and direction a, convolved with a Gaussian of width w. With u along and v
across the streak from its center,

    I = sky + F / L [erf((u + L/2) / (w sqrt 2)) - erf((u - L/2) / (w sqrt 2))] / 2 exp(-v^2 / 2 w^2) / (w sqrt(2 pi)).

Gauss-Newton solves for center, flux, length, direction, width and sky (`_fit`). Length, direction and width have
Gaussian priors around the streak shared by the frame: without them, the fit of a faint streak would converge to its
brightest piece. The covariance is the Cramer-Rao bound of the center, inflated by the reduced chi-square where the
model does not fit, plus the error along the streak of misplacing its ends in noise (`_end_variance_px2`).

For the angular rate, the streak's vector is also computed without its priors (`_own_vector`): all stars share the mean
of the priors, so that its error would not average out.
"""

from math import cos, erf, exp, hypot, pi, sin, sqrt

import numpy as np
from numpy.typing import NDArray

from estimator.centroiding.moments import neighbors
from estimator.core import least_squares
from estimator.core.checks import Floats, Ints
from estimator.core.jit import inlined, jit
from estimator.detection.background import FILTERED_NOISE, interpolate

# Margin of the window about the streak, and its largest half-width.
MARGIN_PX = 4
MAX_HALF_WINDOW_PX = 96
REACH_PX = (
    4.5  # largest distance of a pixel from the initial line; farther ones contain only sky
)
CORE_PX = (
    2.0  # pixels nearer than this belong to a streak even if they are nearer to another one
)
MIN_STREAK_PX = 1.5  # shortest streak whose length and direction can be measured
MAX_ITERATIONS = 40
# Standard deviations of the priors: difference of a star's streak from the frame's, because slow rotation about the
# boresight and distortion make streaks vary over the field; difference of its width from that of the star before.
LENGTH_FRACTION = 0.15
LENGTH_PX = 0.5
ANGLE_RAD = 0.15
WIDTH_FRACTION = 0.15
FAR_SIGMA = (
    5.0  # distance from an end of the line beyond which only 3e-7 of the light is left
)
# Parameters: center, flux, length, direction, width, sky.
X, Y, FLUX, LENGTH, ANGLE, WIDTH, SKY = range(7)
OUTPUTS = 13
# Streaks of at least 6 widths show how their light fades, up to a share by faint neighbors and unequal pixels.
MIN_INNER = 0.4
FADING_SIGMA = 0.02
MAX_OWN_ERROR = (
    0.3  # largest relative error of a length without priors that the linear theory holds for
)


@jit
def fit_all(
    image: NDArray,
    xy: Floats,
    boxes: Ints,
    level: Floats,
    noise: Floats,
    streaks: Floats,
    gain_e_dn: float,
    saturation: float,
    tightness: float = 1.0,
) -> Floats:
    """Fit every blob around its expected streak; return (N, 13), NaN if it is not a streak.

    The columns are x, y, flux, dx, dy; xx, yy, xy of the center's covariance; dx, dy without the priors; and xx, yy, xy
    of their covariance. The last five are NaN if the star alone does not determine its streak. With tight priors two of
    them are the distance of the center from the center of light, along the streak, and its variance.

    Parameters
    ----------
    streaks
        (N, 2) expected streak (dx, dy) of each blob, px
    tightness
        Factor of the priors' standard deviations: below 1 where the streaks are known better than by a frame's median
    """
    height, width = image.shape
    out = np.full((len(xy), OUTPUTS), np.nan)
    p = np.empty(7)
    width_px = 0.9
    for n in range(len(xy)):
        length = hypot(streaks[n, 0], streaks[n, 1])
        angle = np.arctan2(streaks[n, 1], streaks[n, 0])
        half_x = int(abs(streaks[n, 0]) / 2) + MARGIN_PX
        half_y = int(abs(streaks[n, 1]) / 2) + MARGIN_PX
        if length < MIN_STREAK_PX or max(half_x, half_y) > MAX_HALF_WINDOW_PX:
            continue
        x0 = round(xy[n, 0]) - half_x
        y0 = round(xy[n, 1]) - half_y
        x1 = x0 + 2 * half_x
        y1 = y0 + 2 * half_y
        if x0 < 0 or y0 < 0 or x1 >= width or y1 >= height:
            continue
        sigma = interpolate(noise, height, width, xy[n, 1], xy[n, 0]) / FILTERED_NOISE
        # Initial values: the expected streak at the blob's center
        p[X] = xy[n, 0]
        p[Y] = xy[n, 1]
        p[LENGTH] = length
        p[ANGLE] = angle
        p[WIDTH] = width_px
        p[SKY] = interpolate(level, height, width, xy[n, 1], xy[n, 0])
        capacity = (2 * half_x + 1) * (2 * half_y + 1)
        pixels = np.empty((3, capacity))
        near = neighbors(boxes, n, x0, y0, x1, y1)
        offsets = _offsets_of_others(xy, near, n, p)
        count = _select_pixels(image, offsets, (x0, y0, x1, y1), saturation, p, pixels)
        data = pixels[:, :count]
        rows = np.ones((8, count))  # those of the sky stay 1
        weight = np.empty(count)
        if p[FLUX] > 0 and _fit(data, sigma, gain_e_dn, rows, weight, p, out[n], tightness):
            width_px = p[WIDTH]  # the optics are the same for the next star
    return out


@inlined
def _offsets_of_others(xy: Floats, near: Ints, n: int, p: Floats) -> Floats:
    """Return the (K, 2) offsets of nearby blobs from blob n, without those that may be fragments of its streak."""
    offsets = xy[near] - xy[n]
    along = offsets[:, 0] * cos(p[ANGLE]) + offsets[:, 1] * sin(p[ANGLE])
    across = offsets[:, 1] * cos(p[ANGLE]) - offsets[:, 0] * sin(p[ANGLE])
    return offsets[(np.abs(across) > CORE_PX) | (np.abs(along) > p[LENGTH])]


@inlined
def _select_pixels(
    image: NDArray,
    offsets: Floats,
    window: tuple[int, int, int, int],
    saturation: float,
    p: Floats,
    pixels: Floats,
) -> int:
    """Select the pixels near the line that are not saturated; return their number.

    Parameters
    ----------
    offsets
        (K, 2) offsets of other streaks, whose pixels are left out
    window
        x0, y0, x1, y1
    p
        (7,) initial parameters; the flux, saturated pixels included, is written to it
    pixels
        (3, K) x, y and value of the pixels, written in place
    """
    x0, y0, x1, y1 = window
    p[FLUX] = 0.0
    count = 0
    for y in range(y0, y1 + 1):
        for x in range(x0, x1 + 1):
            distance = _distance_to_line(p, x, y)
            if distance > REACH_PX:
                continue
            own = True
            for k in range(len(offsets)):
                other = _distance_to_line(p, x - offsets[k, 0], y - offsets[k, 1])
                own = own and (distance < CORE_PX or distance <= other)
            if not own:
                continue
            p[FLUX] += image[y, x] - p[SKY]
            if image[y, x] < saturation:
                pixels[0, count] = x
                pixels[1, count] = y
                pixels[2, count] = image[y, x]
                count += 1
    return count


@jit
def length_sigma_px(length_px: float) -> float:
    """Return the standard deviation of the prior on a streak's length."""
    return LENGTH_FRACTION * length_px + LENGTH_PX


@jit
def _distance_to_line(p: Floats, x: float, y: float) -> float:
    """Return the distance of a pixel from the line segment, px."""
    along_x = cos(p[ANGLE])
    along_y = sin(p[ANGLE])
    # u along and v across the line
    u = (x - p[X]) * along_x + (y - p[Y]) * along_y
    v = (y - p[Y]) * along_x - (x - p[X]) * along_y
    return hypot(max(abs(u) - p[LENGTH] / 2, 0.0), v)


@jit
def _fit(
    pixels: Floats,
    noise: float,
    gain_e_dn: float,
    rows: Floats,
    weight: Floats,
    p: Floats,
    out: Floats,
    tightness: float = 1.0,
) -> bool:
    """Fit one streak by Gauss-Newton, starting from `p`; return False if it does not converge near its start.

    The start is the frame's streak; it is also the mean of the priors on length, direction and width.

    1. Compute derivatives, residuals and weights at every pixel (`_rows`).
    2. Sum the normal equations, add the priors, and solve for the step.
    3. Apply the step, shortened to about a pixel, and give up far from the start.
    4. At convergence, read the center's covariance from the inverse normal matrix. Where the model does not fit (two
       crossing streaks) the residuals inflate it. Add the error of the ends (`_write_streak`).
    5. Compute the streak's vector without its priors (`_own_vector`); with tight ones, how its light fades (`_fading`).

    Parameters
    ----------
    pixels
        (3, K) x, y and value of the pixels used
    noise
        Standard deviation of a pixel of the sky
    rows, weight
        Work arrays for `_rows`
    p
        (7,) parameters, updated in place
    out
        (13,) row of `fit_all`
    tightness
        Factor of the priors' standard deviations
    """
    count = pixels.shape[1]
    start = p.copy()
    normal = np.empty((8, 8))
    step = np.empty(7)
    for _ in range(MAX_ITERATIONS):
        # 1. Derivatives
        _rows(pixels, noise, gain_e_dn, p, rows, weight)
        # 2. Step
        least_squares.normal_equations(rows, weight, count, normal)
        _add_priors(normal, p, start, tightness)
        fall = least_squares.step(normal, step)
        if not fall >= 0:
            return False
        # 3. Shortened step
        largest_step = _apply_step(step, p)
        if not _is_near(p, start):
            return False
        # 4. Convergence
        if largest_step < least_squares.CONVERGED_PX or fall < least_squares.CONVERGED_CHI2:
            # Degrees of freedom: seven parameters, three priors.
            misfit = least_squares.misfit_factor(normal[7, 7], count - 4)
            end_variance_px2 = _end_variance_px2(p, noise, gain_e_dn)
            _write_streak(normal, p, misfit, end_variance_px2, step, out)
            # 5. The streak's own vector
            if tightness == 1:
                _own_vector(normal, p, start, misfit, 8 * end_variance_px2, out[8:])
            else:
                out[8], out[9] = _fading(pixels, rows, weight, p)
            return True
    return False


@inlined
def _add_priors(normal: Floats, p: Floats, start: Floats, tightness: float) -> None:
    """Add the priors on length, direction and width to the normal matrix."""
    length_sigma = tightness * length_sigma_px(start[LENGTH])
    least_squares.add_prior(normal, LENGTH, start[LENGTH] - p[LENGTH], length_sigma)
    angle_sigma = tightness * ANGLE_RAD
    least_squares.add_prior(normal, ANGLE, start[ANGLE] - p[ANGLE], angle_sigma)
    width_sigma = WIDTH_FRACTION * start[WIDTH]
    least_squares.add_prior(normal, WIDTH, start[WIDTH] - p[WIDTH], width_sigma)


@inlined
def _apply_step(step: Floats, p: Floats) -> float:
    """Add a step to `p`, shortened so that center, length and direction move an end by about a pixel at most.

    Returns the largest of the steps of center and length before shortening, px.
    """
    largest_step = max(abs(step[X]), abs(step[Y]), abs(step[LENGTH]))
    end_shift = abs(step[ANGLE]) * p[LENGTH] / 2
    scale = min(1.0, 1 / max(largest_step, end_shift, 2 * abs(step[WIDTH]), 1e-300))
    p += scale * step
    p[WIDTH] = min(max(p[WIDTH], 0.3), 4.0)
    return largest_step


@inlined
def _is_near(p: Floats, start: Floats) -> bool:
    """Return whether the parameters are still those of a streak near the start."""
    if abs(p[X] - start[X]) + abs(p[Y] - start[Y]) > 2 + start[LENGTH] / 2:
        return False
    return p[FLUX] > 0 and MIN_STREAK_PX < p[LENGTH] < 2 * start[LENGTH] + 4


@inlined
def _write_streak(
    factor: Floats,
    p: Floats,
    misfit: float,
    end_variance_px2: float,
    column: Floats,
    out: Floats,
) -> None:
    """Write x, y, flux, dx, dy of a streak, and xx, yy, xy of its center's covariance."""
    dx = p[LENGTH] * cos(p[ANGLE])
    dy = p[LENGTH] * sin(p[ANGLE])
    out[:5] = p[X], p[Y], p[FLUX], dx, dy
    out[5:8] = least_squares.position_covariance(factor, column)
    out[5:8] *= misfit
    # The variance along the streak becomes a covariance in x and y: times (dx, dy)^T (dx, dy) / L^2.
    end_variance = end_variance_px2 / p[LENGTH] ** 2
    out[5] += end_variance * dx**2
    out[6] += end_variance * dy**2
    out[7] += end_variance * dx * dy


@inlined
def _own_vector(
    factor: Floats, p: Floats, start: Floats, misfit: float, ends_px2: float, out: Floats
) -> None:
    """Write dx, dy of a streak without the priors on length and angle, and xx, yy, xy of their covariance.

    With the prior's information P about `start` and the posterior's covariance S and mean m, the data alone have the
    information D = S^-1 - P and the mean m + D^-1 P (m - start), as all are Gaussian near the solution.

    1. Read S of length and angle from the factor of the normal matrix.
    2. Subtract the prior's information: D and its inverse. Leave `out` NaN if D is not positive definite.
    3. Compute the mean without the prior.
    4. Inflate the covariance by the misfit, and add the variance of the ends. Leave `out` NaN if it is too large.
    5. Convert length and angle to dx and dy.

    Parameters
    ----------
    ends_px2
        Variance of the length from ends misplaced in noise: eight times that of the center
    """
    # 1. S: columns of the inverse normal matrix
    cov = np.empty((2, 2))
    for i in range(2):
        column = np.zeros(len(p))
        column[LENGTH + i] = 1.0
        least_squares.cholesky_solve(factor, column)
        cov[i, 0] = column[LENGTH]
        cov[i, 1] = column[ANGLE]
    # 2. D = S^-1 - P, and then D^-1
    prior = np.array([1 / length_sigma_px(start[LENGTH]) ** 2, 1 / ANGLE_RAD**2])
    own = np.linalg.inv(cov)
    for i in range(2):
        own[i, i] -= prior[i]
    if not (own[0, 0] > 0 and own[0, 0] * own[1, 1] > own[0, 1] ** 2):
        return
    own = np.linalg.inv(own)
    # 3. m + D^-1 P (m - start)
    length, angle = p[LENGTH:WIDTH] + own @ (prior * (p[LENGTH:WIDTH] - start[LENGTH:WIDTH]))
    # 4. Errors
    own *= misfit
    own[0, 0] += ends_px2
    largest = MAX_OWN_ERROR**2
    if not (own[0, 0] < largest * length**2 and own[1, 1] < largest and length > 0):
        return
    # 5. (dx, dy) = L (c, s), and its derivatives by L and the angle
    c = cos(angle)
    s = sin(angle)
    slopes = np.array([[c, -length * s], [s, length * c]])
    own = slopes @ own @ slopes.T.copy()
    out[:] = length * c, length * s, own[0, 0], own[1, 1], own[0, 1]


@inlined
def _fading(pixels: Floats, rows: Floats, weight: Floats, p: Floats) -> tuple[float, float]:
    """Return how far the fit's center is from the center of light along the streak, px, and the variance of that.

    An image that accelerates by a in the exposure T leaves light that fades by the share s = a T^2 / L from one end to
    the other, I (1 - s u / L), and the middle between its ends is s L / 12 ahead of its center of light. With g = I u /
    L, the residuals r and their weights W, s is -sum(W g r) / sum(W g^2). Ends of the width w draw the fit's center
    back by sqrt(pi) / 2 w s, a share 6 sqrt(pi) w / L, which takes half that share of the residuals. Both are exact to
    first order in w / L; exponentials continue them to short streaks.
    """
    length = p[LENGTH]
    inner = exp(-3 * sqrt(pi) * p[WIDTH] / length)
    if inner < MIN_INNER:
        return np.nan, np.nan
    u = (pixels[0] - p[X]) * cos(p[ANGLE]) + (pixels[1] - p[Y]) * sin(p[ANGLE])
    g = p[FLUX] * rows[FLUX] * u / length
    information = np.sum(weight * g * g) * inner
    fading = -np.sum(weight * g * rows[7]) / information
    ahead = length / 12 * inner * inner
    return fading * ahead, (1 / information + FADING_SIGMA**2) * ahead**2


@inlined
def _end_variance_px2(p: Floats, noise: float, gain_e_dn: float) -> float:
    """Return the variance along the streak that the Cramer-Rao bound omits: the error of locating its ends in noise.

    Where light of brightness a per pixel of length begins in noise of deviation n, the maximum-likelihood position of
    the onset has a mean square error of 26 (n / a)^4 px^2 (Yao 1987: the maximum of a Brownian motion with a drift
    down to both sides). Two ends at a known distance shift together; their likelihood falls twice as steeply, so the
    variance is a quarter of that, 6.5 (n / a)^4. After optimal weighting across the streak, n^2 is 2 sqrt(pi) w times
    the variance of a pixel, sky and light together, and a = F / L.
    """
    across = 2 * sqrt(pi) * p[WIDTH]
    variance = noise * noise + p[FLUX] / (across * p[LENGTH]) / gain_e_dn
    return 6.5 * (variance * across * (p[LENGTH] / p[FLUX]) ** 2) ** 2


@jit
def _rows(
    pixels: Floats, noise: float, gain_e_dn: float, p: Floats, rows: Floats, weight: Floats
) -> None:
    """Fill the model's derivatives by the seven parameters, the residual and the weight of every pixel.

    The model is that of the module, F times `unit`. The pixel's width is part of w: w^2 = sigma^2 + 1/12. With the
    derivatives of `unit` by u and v, the chain rule gives those by the center, u = dx cos a + dy sin a and
    v = dy cos a - dx sin a, and by the direction, du/da = v and dv/da = -u.
    """
    along_x = cos(p[ANGLE])
    along_y = sin(p[ANGLE])
    flux = p[FLUX]
    length = p[LENGTH]
    w = p[WIDTH]
    for k in range(pixels.shape[1]):
        dx = pixels[0, k] - p[X]
        dy = pixels[1, k] - p[Y]
        u = dx * along_x + dy * along_y
        v = dy * along_x - dx * along_y
        # Distances from both ends in units of w, their integrals and densities
        head = (u + length / 2) / w
        tail = (u - length / 2) / w
        head_sum, head_bell = _gaussian_integral(head)
        tail_sum, tail_bell = _gaussian_integral(tail)
        across = exp(-v * v / (2 * w * w)) / (w * sqrt(2 * pi) * length)
        unit = (head_sum - tail_sum) * across
        # Derivatives of `unit` by u and v
        by_u = (head_bell - tail_bell) / w * across
        by_v = -v / (w * w) * unit
        rows[X, k] = -flux * (along_x * by_u - along_y * by_v)
        rows[Y, k] = -flux * (along_y * by_u + along_x * by_v)
        rows[FLUX, k] = unit
        rows[LENGTH, k] = flux * ((head_bell + tail_bell) / (2 * w) * across - unit / length)
        rows[ANGLE, k] = flux * (v * by_u - u * by_v)
        by_w_along = (tail * tail_bell - head * head_bell) / w * across
        rows[WIDTH, k] = flux * (by_w_along + unit * (v * v / (w * w * w) - 1 / w))
        rows[7, k] = pixels[2, k] - p[SKY] - flux * unit
        weight[k] = 1 / (noise * noise + max(flux * unit, 0.0) / gain_e_dn + 1e-9)


@jit
def _gaussian_integral(t: float) -> tuple[float, float]:
    """Return a unit Gaussian's integral from 0 to t and its density; beyond FAR_SIGMA their limits, to save time."""
    if abs(t) > FAR_SIGMA:
        return (0.5 if t > 0 else -0.5), 0.0
    return erf(t * sqrt(0.5)) / 2, exp(-t * t / 2) / sqrt(2 * pi)
