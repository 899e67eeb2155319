"""Centroiding: the subpixel position of each blob, with its standard deviation.

Each centroider takes the frame and its `Blobs` and returns `Centroids`. The first three are moments of the light (see
`estimator.centroiding.moments`); the others fit a model by weighted least squares: a Gaussian, a streak, a disk. A
blob that the model does not fit keeps its center of gravity.

All centroiders have the parameters of `_moments` but the first, and raise ImageError for unusable ones (`prepare`).
"""

from collections.abc import Callable
from dataclasses import replace
from functools import partial

import numpy as np
from numpy.typing import NDArray

from estimator.attitude.rate import OUTLIER_CHI2, covariance_of
from estimator.centroiding import disk_fit, moments, streak_fit
from estimator.centroiding import gaussian_fit as gaussian
from estimator.core import checks
from estimator.core.checks import Floats, Ints
from estimator.core.errors import ImageError
from estimator.core.types import NO_PRIORS, Blobs, Centroids, FramePriors
from estimator.detection.classify import VOTING_BLOBS, streaks_px
from estimator.detection.detect import check_monochrome, to_native

Centroider = Callable[..., Centroids]  # (image, blobs, gain_e_dn, priors)


def _moments(
    kernel: Callable[..., Floats],
    image: NDArray,
    blobs: Blobs,
    gain_e_dn: float = 1.0,
    priors: FramePriors = NO_PRIORS,
) -> Centroids:
    """Run one of the kernels of `moments` that use the blobs' boxes.

    Parameters
    ----------
    image
        (height, width) frame
    blobs
        Blobs detected in it
    gain_e_dn
        Gain g in electrons per unit of the image, which determines the photon noise
    priors
        Prior information about the frame: streak, saturation
    """
    image = prepare(image, blobs, gain_e_dn, priors)
    every = np.arange(len(blobs))
    return _to_centroids(
        kernel(image, blobs.box_px, every, *blobs.background, float(gain_e_dn))
    )


cog = partial(_moments, moments.center_of_gravity)
"""Measure the center of gravity of the light above the sky, in the blob's box and a margin around it.

With xbar = sum(I x) / sum(I), its variance is var(xbar) = sum((I / g + noise^2) (x - xbar)^2) / sum(I)^2
(`moments.center_of_gravity`). Pixels closer to another blob's box are excluded.
"""

weighted = partial(_moments, moments.squared_light)
"""Measure the center of gravity weighted by the light itself: xbar = sum(I^2 x) / sum(I^2).

The wings, which are mostly noise, get less weight. The variance is
sum(4 I^2 (x - xbar)^2 (I / g + noise^2)) / sum(I^2)^2 plus the mean square of the S-curve (the pixel-phase error)
of the squared profile, which is narrower by the square root of 2 (`moments.squared_light`).
"""


def _fitted(
    fit: Callable[..., Floats],
    image: NDArray,
    blobs: Blobs,
    gain_e_dn: float = 1.0,
    priors: FramePriors = NO_PRIORS,
) -> Centroids:
    """Run a fit; a blob that it does not describe keeps its center of gravity. Parameters as in `_moments`."""
    image = prepare(image, blobs, gain_e_dn, priors)
    rows = fit(image, blobs, gain_e_dn, priors)
    return _to_centroids(_with_fallback(rows, image, blobs, gain_e_dn))


def _fit_windows(
    image: NDArray, blobs: Blobs, gain_e_dn: float, _priors: FramePriors
) -> Floats:
    """Return the rows of `moments.gaussian_windowed`."""
    return moments.gaussian_windowed(
        image, blobs.xy_px, blobs.box_px, *blobs.background, float(gain_e_dn)
    )


gaussian_window = partial(_fitted, _fit_windows)
"""Measure the center c of a Gaussian window w that is also the center of gravity in it: sum(w I (x - c)) = 0.

This is SExtractor's XWIN (Bertin & Arnouts 1996), but solved by Newton's method, and with a window of twice the
star's variance (`moments.gaussian_windowed`). The variance is
var(c) = sum(w^2 (x - c)^2 (I / g + noise^2)) / sum(w I (1 - (x - c)^2 / s^2))^2 plus the mean square of the
S-curve. The error is an eighth above the minimum, for faint and for bright stars. A blob for which the iteration
does not converge keeps its center of gravity.
"""


def _fit_gaussians(
    image: NDArray, blobs: Blobs, gain_e_dn: float, priors: FramePriors
) -> Floats:
    """Return the rows of `gaussian_fit.fit_all`."""
    return gaussian.fit_all(
        image,
        blobs.xy_px,
        blobs.flux,
        blobs.box_px,
        blobs.peak,
        *blobs.background,
        float(gain_e_dn),
        priors.saturation,
    )


gaussian_fit = partial(_fitted, _fit_gaussians)
"""Fit a Gaussian integrated over each pixel by weighted least squares: x, y, flux, sigma and sky level are free.

Gauss-Newton runs on a 7x7 window around the blob's center; see `estimator.centroiding.gaussian_fit` for the model
I = b + F gx gy. A pixel's weight is 1 / (noise^2 + F gx gy / g); with equal weights the error of a bright star
would be 4/3 of the photon-noise limit. Saturated pixels are excluded: the wings determine the position. A blob that
the model does not fit (no convergence, larger than the window) keeps its center of gravity.
"""


def streak(
    image: NDArray, blobs: Blobs, gain_e_dn: float = 1.0, priors: FramePriors = NO_PRIORS
) -> Centroids:
    """Fit a line segment blurred by a Gaussian; its center is the star's position at mid-exposure.

    Center, flux and sky are free. Length, direction and width have Gaussian priors around the streak of `priors`,
    otherwise around the streak that the frame's blobs share. The covariance is the
    Cramer-Rao bound, larger along than across, plus the error of a faint streak's ends (see `streak_fit`).

    1. Fit the streaks. If none converges (a frame that is not smeared), all blobs are fitted by `gaussian_fit`.
    2. Fit the blobs that are not streaks by a Gaussian, if the streaks are no longer than half its window; those that
       fail, and longer ones, keep their center of gravity.
    """
    image = prepare(image, blobs, gain_e_dn, priors)
    # 1. Streaks
    streaks = _fit_streaks(image, blobs, gain_e_dn, priors)
    failed = np.isnan(streaks[:, 0])
    if failed.all():
        return gaussian_fit(image, blobs, gain_e_dn, priors)
    # Columns of `streak_fit.fit_all`: x, y, flux; xx, yy, xy
    covariance = streaks[:, [5, 7, 7, 6]].reshape(-1, 2, 2)
    rows = streaks[:, [0, 1, 5, 2]]
    rows[:, 2] = np.sqrt((streaks[:, 5] + streaks[:, 6]) / 2)
    # 2. Blobs that are not streaks
    if failed.any():
        rows[failed] = np.nan
        length_px = np.hypot(*_frame_streaks(image, blobs, priors).T)
        short = failed & (length_px <= gaussian.HALF_WINDOW_PX)
        if short.any():
            rows[short] = _fit_gaussians(image, blobs.take(short), gain_e_dn, priors)
        rows = _with_fallback(rows, image, blobs, gain_e_dn)
        covariance[failed] = rows[failed, 2, None, None] ** 2 * np.eye(2)
    # Covariance of the streaks without their priors
    own = streaks[:, [10, 12, 12, 11]].reshape(-1, 2, 2)
    return Centroids(rows[:, :2], rows[:, 2], rows[:, 3], covariance, streaks[:, 8:10], own)


def known_streaks(
    image: NDArray,
    blobs: Blobs,
    centroids: Centroids,
    paths_px: tuple[Floats, Floats],
    gain_e_dn: float,
    priors: FramePriors,
) -> Centroids:
    """Fit the centers of streaks again, with the streak vectors that all streaks of the frame together determine.

    Noise breaks a faint streak into fragments, and a fit of one star alone may take a fragment for the whole. With its
    length known, both ends determine the center: their likelihood falls twice as steeply (`_end_variance_px2`).

    1. Fit every streak of a known vector; begin again where the center has moved, with the pixels around it.
    2. Of two fits at one place, which are fragments of one streak, keep the first, of the brighter blob. Those that
       fail are no whole streaks. The errors of all these are NaN. Short streaks stay as they are.
    3. Move the centers to the centers of light where the rate changes in the exposure (`_acceleration`). The error of
       that is common to all stars: their variances along the streak are multiplied by a factor with which the variance
       of their weighted mean grows by it.

    Parameters
    ----------
    centroids
        Centroids of the blobs
    paths_px
        (N, 2) vector of each blob's streak, and (N, 2) how far its middle is off from its center of light by the
        constant rate alone
    """
    image = prepare(image, blobs, gain_e_dn, priors)
    streak_px, ahead_px = paths_px
    length_px = np.hypot(*streak_px.T)
    long = length_px > gaussian.HALF_WINDOW_PX
    if not long.any():
        return centroids
    # 1. Fits
    rows = np.full((len(blobs), streak_fit.OUTPUTS), np.nan)
    xy_px = centroids.xy_px.copy()
    moved = np.flatnonzero(long)
    for _ in range(STREAK_ROUNDS):
        again = _fit_around(image, blobs, xy_px, streak_px, moved, gain_e_dn, priors, TIGHT)
        rows[moved] = again[moved]
        moved = np.flatnonzero(np.hypot(*(rows[:, :2] - xy_px).T) > MOVED_PX)
        xy_px[moved] = rows[moved, :2]
    # 2. Fragments
    offset_px = np.abs(rows[:, None, :2] - rows[:, :2]).max(axis=2)
    rows[np.tril(offset_px < ONE_PLACE_PX, -1).any(axis=1)] = np.nan
    # 3. Acceleration
    along = streak_px / np.maximum(length_px, gaussian.HALF_WINDOW_PX)[:, None]
    measured_px = rows[:, 8] - np.sum(ahead_px * along, axis=1)
    shift, variance = _acceleration(measured_px / length_px, rows[:, 9] / length_px**2)
    covariance_px2 = rows[:, [5, 7, 7, 6]].reshape(-1, 2, 2)
    own_px2 = np.einsum("ni,nij,nj->n", along, covariance_px2, along)
    common_px2 = variance * np.nansum(length_px**2 / own_px2) * own_px2
    covariance_px2 += common_px2[:, None, None] * along[:, :, None] * along[:, None, :]
    covariance_px2[~long] = covariance_of(centroids)[~long]
    return replace(
        centroids,
        xy_px=np.where(long[:, None], rows[:, :2] - shift * streak_px, xy_px),
        sigma_px=np.sqrt(np.trace(covariance_px2, axis1=1, axis2=2) / 2),
        flux=np.where(long, rows[:, 2], centroids.flux),
        covariance_px2=covariance_px2,
    )


def _acceleration(ahead: Floats, variances: Floats) -> tuple[float, float]:
    """Return by how much of its length an acceleration moves the middle of a streak, and the variance of that.

    The share is the same for all streaks if the acceleration is along the rate. Most exposures have none: the share is
    0 with the probability 1 - ACCELERATED, otherwise anything to a twelfth, with which an image stands still at one
    end. With the weighted mean m of the measured values and its variance v, an acceleration has the odds

        ACCELERATED / (1 - ACCELERATED) 6 sqrt(2 pi v) exp(m^2 / 2 v).

    With this probability q, the mean of the share is q m, and its variance q (v + (e m)^2) + q (1 - q) m^2, with the
    share e of FADING_MODEL that the linear model of fading light leaves open.

    Parameters
    ----------
    ahead, variances
        (N,) measured shifts of the streaks over their lengths, and their variances; NaN if unknown
    """
    usable = np.isfinite(ahead)
    if usable.sum() < MIN_STREAKS:
        return 0.0, 0.0
    # Weighted mean, without outliers: neighbors brighten one end.
    usable &= (ahead - np.median(ahead[usable])) ** 2 < OUTLIER_CHI2 * variances
    v = 1 / float(np.sum(1 / variances[usable]))
    m = v * float(np.sum(ahead[usable] / variances[usable]))
    # Probability of an acceleration
    prior = ACCELERATED / (1 - ACCELERATED) * 6 * np.sqrt(2 * np.pi * v)
    odds = prior * np.exp(min(m**2 / (2 * v), 50.0))
    q = odds / (1 + odds)
    return q * m, q * (v + (FADING_MODEL**2 + 1 - q) * m**2)


def _fit_disks(image: NDArray, blobs: Blobs, gain_e_dn: float, priors: FramePriors) -> Floats:
    """Return x, y, sigma and flux of `disk_fit.fit_all`."""
    rows = disk_fit.fit_all(
        image,
        blobs.xy_px,
        blobs.flux,
        blobs.area_px,
        blobs.box_px,
        *blobs.background,
        float(gain_e_dn),
        priors.saturation,
    )
    return rows[:, :4]


disk = partial(_fitted, _fit_disks)
"""Fit a uniform disk with a blurred edge, the image of a nearby LED, by weighted least squares.

Center, radius, edge width, brightness and sky are free (`disk_fit`). Only the edge carries information about the
position, so a saturated disk is measured as accurately as any other; its saturated pixels are excluded. A blob that
is too small or not a disk keeps its center of gravity.
"""


def prepare(image: NDArray, blobs: Blobs, gain_e_dn: float, priors: FramePriors) -> NDArray:
    """Check a centroider's arguments, and convert the image to a type that compiled code accepts.

    Raises
    ------
    ImageError
        For another type, a gain that is not above 0, or blobs beyond the image: compiled loops do
        not check their indices.
    """
    check_monochrome(image)
    checks.of_type("blobs", blobs, Blobs)
    checks.of_type("priors", priors, FramePriors)
    checks.number("gain_e_dn", gain_e_dn, 1e-300, np.inf, "above 0; inf without photon noise")
    # Boxes within the image: x0, y0 of 0 or more, x1, y1 below its size
    edge = np.array([image.shape[1], image.shape[0]] * 2)
    if len(blobs) and not (
        blobs.box_px.min() >= 0 and (blobs.box_px.max(axis=0) < edge).all()
    ):
        raise ImageError(
            f"blobs reach beyond the image of {image.shape[1]}x{image.shape[0]} pixels"
        )
    return to_native(image)


STREAK_ROUNDS = 4  # largest number of fits of a streak
# Factor of the priors of a streak that is known from all others.
TIGHT = 0.02
ACCELERATED = 0.3  # prior probability that the rate changes during an exposure
FADING_MODEL = 0.1
MOVED_PX = 1.0  # a center farther from its start is fitted again
ONE_PLACE_PX = 2.0  # two fits that are nearer than this are of one streak
MIN_STREAKS = 3  # least number of fitted streaks whose median replaces the frame's streak

CENTROIDERS: dict[str, Centroider] = {
    "default": streak,
    "cog": cog,
    "weighted": weighted,
    "gaussian_window": gaussian_window,
    "gaussian_fit": gaussian_fit,
    "streak": streak,
    "disk": disk,
}


def _fit_streaks(
    image: NDArray, blobs: Blobs, gain_e_dn: float, priors: FramePriors
) -> Floats:
    """Return the rows of `streak_fit.fit_all`; all NaN for a frame that is not smeared.

    Without a streak from the gyro, the brightest blobs are first fitted with the median of their fitted streaks until
    that agrees with the expected one: the ends of faint streaks are below the threshold, so their moments make them
    too short.
    """
    expected_px = _frame_streaks(image, blobs, priors)
    if np.all(np.hypot(*expected_px.T) < streak_fit.MIN_STREAK_PX):
        return np.full((len(blobs), streak_fit.OUTPUTS), np.nan)
    some = np.arange(min(VOTING_BLOBS, len(blobs)))
    for _ in range(0 if priors.streak_px else STREAK_ROUNDS):
        rows = _fit_around(image, blobs, blobs.xy_px, expected_px, some, gain_e_dn, priors)
        measured = some[np.isfinite(rows[some, 8])]
        if len(measured) < MIN_STREAKS:
            break
        # The streaks without their priors, as those depend on the expected streak.
        vectors = rows[measured, 8:10]
        expected = expected_px[measured]
        # A streak and its reverse are equal: give each the sign of the expected one.
        sign = np.where(np.sum(vectors * expected, axis=1) < 0, -1.0, 1.0)
        shift_px = np.median(sign[:, None] * vectors - expected, axis=0)
        length_px = float(np.median(np.hypot(*expected_px.T)))
        if np.hypot(*shift_px) < streak_fit.length_sigma_px(length_px) / 4:
            break
        expected_px = expected_px + shift_px
    every = np.arange(len(blobs))
    return _fit_around(image, blobs, blobs.xy_px, expected_px, every, gain_e_dn, priors)


def _fit_around(
    image: NDArray,
    blobs: Blobs,
    xy_px: Floats,
    expected_px: Floats,
    which: Ints,
    gain_e_dn: float,
    priors: FramePriors,
    tightness: float = 1.0,
) -> Floats:
    """Return the rows of `streak_fit.fit_all` around centers and streaks (N, 2), NaN but for the blobs `which`."""
    chosen_px = np.zeros_like(expected_px)
    chosen_px[which] = expected_px[which]
    return streak_fit.fit_all(
        image,
        xy_px,
        blobs.box_px,
        *blobs.background,
        chosen_px,
        float(gain_e_dn),
        priors.saturation,
        tightness,
    )


def _frame_streaks(image: NDArray, blobs: Blobs, priors: FramePriors) -> Floats:
    """Return the (N, 2) expected streaks of the blobs, px: from the priors, else from the frame's blobs, else 0."""
    return streaks_px(blobs, image.shape, priors.streak_px or blobs.streak_px or (0.0, 0.0))


def _with_fallback(rows: Floats, image: NDArray, blobs: Blobs, gain_e_dn: float) -> Floats:
    """Replace the rows that are NaN by those of the center of gravity, in place."""
    failed = np.flatnonzero(np.isnan(rows[:, 0]))
    if len(failed):
        rows[failed] = moments.center_of_gravity(
            image, blobs.box_px, failed, *blobs.background, float(gain_e_dn)
        )
    return rows


def _to_centroids(rows: Floats) -> Centroids:
    """Return centroids from rows of x, y, sigma, flux."""
    return Centroids(rows[:, :2], rows[:, 2], rows[:, 3])
