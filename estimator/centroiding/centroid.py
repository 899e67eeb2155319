"""Centroiding: the subpixel position of each blob, with its standard deviation.

Each centroider takes the frame and its `Blobs` and returns `Centroids`. The first three are moments of the light (see
`estimator.centroiding.moments`); the others fit a model by weighted least squares: a Gaussian, a streak, a disk. A
blob that the model does not fit keeps its center of gravity.
"""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
from numpy.typing import NDArray

from estimator.centroiding import disk_fit, moments, streak_fit
from estimator.centroiding import gaussian_fit as gaussian
from estimator.core import checks
from estimator.core.checks import Floats, ImageError
from estimator.core.types import NO_PRIORS, Blobs, Centroids, FramePriors
from estimator.detection.classify import streaks_px
from estimator.detection.detect import check_pixel_type, to_native

# (image, blobs, gain_e_dn, priors): the gain, in electrons per unit of the image, determines the photon noise.
Centroider = Callable[..., Centroids]


def cog(
    image: NDArray, blobs: Blobs, gain_e_dn: float = 1.0, priors: FramePriors = NO_PRIORS
) -> Centroids:
    """Center of gravity of the light above the sky, in the blob's box and a margin around it.

    x = sum(I x) / sum(I), with var(x) = sum((I / g + noise^2) (x - x_mean)^2) / sum(I)^2 for a gain of g
    electrons per unit. Pixels closer to another blob's box are excluded.
    """
    image = prepare(image, blobs, gain_e_dn, priors)
    return _to_centroids(_gravity_rows(image, blobs, gain_e_dn))


def weighted(
    image: NDArray, blobs: Blobs, gain_e_dn: float = 1.0, priors: FramePriors = NO_PRIORS
) -> Centroids:
    """Center of gravity weighted by the light itself: x = sum(I^2 x) / sum(I^2).

    The wings, which are mostly noise, get less weight. The variance is
    sum(4 I^2 (x - x_mean)^2 (I / g + noise^2)) / sum(I^2)^2 plus the mean square of the S-curve (the pixel-phase error)
    of the squared profile, which is narrower by the square root of 2.
    """
    image = prepare(image, blobs, gain_e_dn, priors)
    sky = blobs.background
    rows = moments.squared_light(image, blobs.box_px, sky.level, sky.noise, float(gain_e_dn))
    return _to_centroids(rows)


def gaussian_window(
    image: NDArray, blobs: Blobs, gain_e_dn: float = 1.0, priors: FramePriors = NO_PRIORS
) -> Centroids:
    """Center of gravity in a Gaussian window w, iterated until it is the center c of the window: sum(w I (x - c)) = 0.

    As SExtractor's XWIN (Bertin & Arnouts 1996), but solved by Newton's method, and with a window of twice the star's
    variance. var(c) = sum(w^2 (x - c)^2 (I / g + noise^2)) / sum(w I (1 - (x - c)^2 / s^2))^2 plus the mean square of
    the S-curve. The error is an eighth above the minimum, for faint and for bright stars. A blob for which the
    iteration does not converge keeps its center of gravity.
    """
    image = prepare(image, blobs, gain_e_dn, priors)
    sky = blobs.background
    rows = moments.gaussian_windowed(
        image, blobs.xy_px, blobs.box_px, sky.level, sky.noise, float(gain_e_dn)
    )
    return _to_centroids(_with_fallback(rows, image, blobs, gain_e_dn))


def gaussian_fit(
    image: NDArray, blobs: Blobs, gain_e_dn: float = 1.0, priors: FramePriors = NO_PRIORS
) -> Centroids:
    """Least-squares fit of a Gaussian integrated over each pixel; free are x, y, flux, sigma and the sky level.

    Gauss-Newton on a 7x7 window around the blob's center. The model is I = b + F gx gy with
    gx = [erf((x - x0 + 1/2) / (sigma sqrt 2)) - erf((x - x0 - 1/2) / (sigma sqrt 2))] / 2, and a pixel's weight is
    1 / (noise^2 + F gx gy / g) for a gain of g electrons per unit; with equal weights the error of a bright star would
    be 4/3 of the photon-noise limit. Saturated pixels are excluded: the wings determine the position. A blob that the
    model does not fit (no convergence, larger than the window) keeps its center of gravity.
    """
    image = prepare(image, blobs, gain_e_dn, priors)
    return _gaussian_centroids(image, blobs, gain_e_dn, priors)


def streak(
    image: NDArray, blobs: Blobs, gain_e_dn: float = 1.0, priors: FramePriors = NO_PRIORS
) -> Centroids:
    """Least-squares fit of a line segment blurred by a Gaussian; its center is the star's position at mid-exposure.

    Center, flux and sky are free. Length, direction and width have Gaussian priors around the streak of `priors`,
    otherwise around the streak that the frame's blobs share. `streak_ends` returns the ends. The covariance is the
    Cramer-Rao bound, larger along than across, plus the error of a faint streak's ends (see `streak_fit`).

    A frame that is not smeared is passed to `gaussian_fit`. In a smeared frame, blobs that are not streaks are too;
    but if the streak is longer than half a round star's window, they keep their center of gravity.
    """
    image = prepare(image, blobs, gain_e_dn, priors)
    streaks = _fit_streaks(image, blobs, gain_e_dn, priors)
    failed = np.isnan(streaks[:, 0])
    if failed.all():
        return _gaussian_centroids(image, blobs, gain_e_dn, priors)
    covariance = streaks[:, [5, 7, 7, 6]].reshape(-1, 2, 2)
    rows = streaks[:, [0, 1, 5, 2]]
    rows[:, 2] = np.sqrt((streaks[:, 5] + streaks[:, 6]) / 2)
    if failed.any():
        rows[failed] = np.nan
        # A streak longer than half the window of a round star does not fit into it.
        short = failed & (
            np.hypot(*_frame_streaks(image, blobs, priors).T) <= gaussian.HALF_WINDOW_PX
        )
        if short.any():
            rows[short] = _fit_gaussians(image, blobs.take(short), gain_e_dn, priors)
        rows = _with_fallback(rows, image, blobs, gain_e_dn)
        covariance[failed] = rows[failed, 2, None, None] ** 2 * np.eye(2)
    own = streaks[:, [10, 12, 12, 11]].reshape(-1, 2, 2)
    if blobs.turn_rad:
        # A streak v that a roll w bends is an arc, whose mean is off its middle by a 24th of the acceleration w J v.
        x, y = _frame_streaks(image, blobs, priors).T
        rows[:, :2] -= blobs.turn_rad / 24 * np.column_stack([-y, x])
    return Centroids(rows[:, :2], rows[:, 2], rows[:, 3], covariance, streaks[:, 8:10], own)


def streak_ends(
    image: NDArray, blobs: Blobs, gain_e_dn: float = 1.0, priors: FramePriors = NO_PRIORS
) -> tuple[Floats, Floats]:
    """Return (N, 2) and (N, 2): the two ends of each streak in arbitrary order; NaN for a blob that is not a streak."""
    image = prepare(image, blobs, gain_e_dn, priors)
    rows = _fit_streaks(image, blobs, gain_e_dn, priors)
    return rows[:, :2] - rows[:, 3:5] / 2, rows[:, :2] + rows[:, 3:5] / 2


def disk(
    image: NDArray, blobs: Blobs, gain_e_dn: float = 1.0, priors: FramePriors = NO_PRIORS
) -> Centroids:
    """Least-squares fit of a uniform disk with a blurred edge: the image of a nearby LED.

    Center, radius, edge width, brightness and sky are free. Only the edge carries information about the position, so a
    saturated disk is measured as accurately as any other; its saturated pixels are excluded. A blob that is too small
    or not a disk keeps its center of gravity.
    """
    image = prepare(image, blobs, gain_e_dn, priors)
    sky = blobs.background
    rows = disk_fit.fit_all(
        image,
        blobs.xy_px,
        blobs.flux,
        blobs.area_px,
        blobs.box_px,
        sky.level,
        sky.noise,
        float(gain_e_dn),
        priors.saturation,
    )
    return _to_centroids(_with_fallback(rows[:, :4], image, blobs, gain_e_dn))


def prepare(image: NDArray, blobs: Blobs, gain_e_dn: float, priors: FramePriors) -> NDArray:
    """Check a centroider's arguments, and convert the image to a type that compiled code accepts.

    Raises
    ------
    ImageError
        For another type, a gain that is not above 0, or blobs beyond the image: the loops do
        not look.
    """
    check_pixel_type(image)
    checks.of_type("blobs", blobs, Blobs)
    checks.of_type("priors", priors, FramePriors)
    checks.number("gain_e_dn", gain_e_dn, 1e-300, np.inf, "above 0; inf without photon noise")
    if image.ndim != 2:
        raise ImageError(f"an image of shape {image.shape}; allowed: monochrome, (height, width)")
    edge = np.array([image.shape[1], image.shape[0]] * 2)
    if len(blobs) and not (blobs.box_px.min() >= 0 and (blobs.box_px.max(axis=0) < edge).all()):
        raise ImageError(
            f"blobs reach beyond the image of {image.shape[1]}x{image.shape[0]} pixels"
        )
    return to_native(image)


# fits of a frame's streaks; measured ones that replace the frame's
STREAK_ROUNDS = 4
MIN_STREAKS = 3

CENTROIDERS: dict[str, Centroider] = {
    "default": streak,
    "cog": cog,
    "weighted": weighted,
    "gaussian_window": gaussian_window,
    "gaussian_fit": gaussian_fit,
    "streak": streak,
    "disk": disk,
}


def _gaussian_centroids(
    image: NDArray, blobs: Blobs, gain_e_dn: float, priors: FramePriors
) -> Centroids:
    """Centroids of `gaussian_fit` in an image that is prepared."""
    rows = _fit_gaussians(image, blobs, gain_e_dn, priors)
    return _to_centroids(_with_fallback(rows, image, blobs, gain_e_dn))


def _fit_gaussians(image: NDArray, blobs: Blobs, gain_e_dn: float, priors: FramePriors) -> Floats:
    """Return the rows of `gaussian_fit.fit_all`."""
    sky = blobs.background
    return gaussian.fit_all(
        image,
        blobs.xy_px,
        blobs.flux,
        blobs.box_px,
        blobs.peak,
        sky.level,
        sky.noise,
        float(gain_e_dn),
        priors.saturation,
    )


def _fit_streaks(image: NDArray, blobs: Blobs, gain_e_dn: float, priors: FramePriors) -> Floats:
    """Return the rows of `streak_fit.fit_all`; all NaN for a frame that is not smeared.

    Where no gyro tells the frame's streak, the fit is repeated with the median of the fitted ones if that is another:
    the moments of faint streaks, of which the ends are below the threshold, make them too short.
    """
    expected_px = _frame_streaks(image, blobs, priors)
    sky = blobs.background
    rows = np.full((len(blobs), streak_fit.OUTPUTS), np.nan)
    for _ in range(1 if priors.streak_px else STREAK_ROUNDS):
        length_px = np.hypot(*expected_px.T)
        if np.all(length_px < streak_fit.MIN_STREAK_PX):
            break
        scene = image, blobs.xy_px, blobs.box_px, sky.level, sky.noise
        rows = streak_fit.fit_all(*scene, expected_px, float(gain_e_dn), priors.saturation)
        shift_px = _median_shift(rows[:, 8:10], expected_px)
        if np.hypot(*shift_px) < streak_fit.length_sigma_px(float(np.median(length_px))) / 4:
            break
        expected_px = expected_px + shift_px
    return rows


def _median_shift(vectors_px: Floats, expected_px: Floats) -> Floats:
    """Median (2,) of the measured streaks (N, 2) less those expected, of equal signs; 0 with too few."""
    measured = np.isfinite(vectors_px[:, 0])
    if np.count_nonzero(measured) < MIN_STREAKS:
        return np.zeros(2)
    vectors = vectors_px[measured]
    expected = expected_px[measured]
    sign = np.where(np.sum(vectors * expected, axis=1) < 0, -1.0, 1.0)
    return np.asarray(np.median(sign[:, None] * vectors - expected, axis=0))


def _frame_streaks(image: NDArray, blobs: Blobs, priors: FramePriors) -> Floats:
    """Return (N, 2) streaks of the blobs, px: of the frame from the priors, otherwise from its blobs, otherwise 0."""
    return streaks_px(blobs, image.shape, priors.streak_px or blobs.streak_px or (0.0, 0.0))


def _gravity_rows(image: NDArray, blobs: Blobs, gain_e_dn: float) -> Floats:
    """Return the rows of `moments.center_of_gravity`."""
    sky = blobs.background
    return moments.center_of_gravity(image, blobs.box_px, sky.level, sky.noise, float(gain_e_dn))


def _with_fallback(rows: Floats, image: NDArray, blobs: Blobs, gain_e_dn: float) -> Floats:
    """Replace the rows that are NaN by those of the center of gravity, in place."""
    failed = np.isnan(rows[:, 0])
    if failed.any():
        rows[failed] = _gravity_rows(image, blobs, gain_e_dn)[failed]
    return rows


def _to_centroids(rows: Floats) -> Centroids:
    return Centroids(rows[:, :2], rows[:, 2], rows[:, 3])
