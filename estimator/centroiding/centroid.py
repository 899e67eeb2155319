"""Where each blob is, to a fraction of a pixel, and how well that is known."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
from numpy.typing import NDArray

from estimator.centroiding import disc_fit, moments, streak_fit
from estimator.centroiding import gaussian_fit as gaussian
from estimator.core.arrays import Floats
from estimator.core.types import NO_PRIORS, Blobs, Centroids, FramePriors
from estimator.detection.detect import native

# (image, blobs, gain_e_dn, hints): the gain in electrons a unit of the image tells the light's own noise.
Centroider = Callable[..., Centroids]


def cog(image: NDArray, blobs: Blobs, gain_e_dn: float = 1.0, hints: FramePriors = NO_PRIORS) -> Centroids:
    """Centre of gravity of the light above the sky in the blob's box and a margin around it.

    x = sum(I x) / sum(I), with var(x) = sum((I / g + noise^2) (x - x_mean)^2) / sum(I)^2 for a gain of g
    electrons a unit. A pixel that lies nearer to another blob's box is left out.
    """
    sky = blobs.background
    return _measured(moments.gravity(native(image), blobs.box_px, sky.level, sky.noise, gain_e_dn))


def weighted(
    image: NDArray, blobs: Blobs, gain_e_dn: float = 1.0, hints: FramePriors = NO_PRIORS
) -> Centroids:
    """Centre of gravity with the light itself as the weight: x = sum(I^2 x) / sum(I^2).

    The wings, which are mostly noise, count less. var(x) = sum(4 I^2 (x - x_mean)^2 (I / g + noise^2)) / sum(I^2)^2,
    and the S-curve's mean square of a profile narrower by the square root of 2.
    """
    sky = blobs.background
    return _measured(moments.squared(native(image), blobs.box_px, sky.level, sky.noise, gain_e_dn))


def gaussian_window(
    image: NDArray, blobs: Blobs, gain_e_dn: float = 1.0, hints: FramePriors = NO_PRIORS
) -> Centroids:
    """Centre of gravity in a Gaussian window w, moved until it is in the window's own middle: sum(w I (x - c)) = 0.

    As SExtractor's XWIN (Bertin & Arnouts 1996), but by Newton's method, and with a window of twice the star's own
    variance. var(c) = sum(w^2 (x - c)^2 (I / g + noise^2)) / sum(w I (1 - (x - c)^2 / s^2))^2, and the S-curve's mean
    square. An eighth above the least error for faint and for bright stars. A blob on which it does not settle keeps
    its centre of gravity.
    """
    sky = blobs.background
    rows = moments.windowed(native(image), blobs.xy_px, blobs.box_px, sky.level, sky.noise, gain_e_dn)
    return _measured(_or_gravity(rows, image, blobs, gain_e_dn))


def gaussian_fit(
    image: NDArray, blobs: Blobs, gain_e_dn: float = 1.0, hints: FramePriors = NO_PRIORS
) -> Centroids:
    """Least-squares fit of a Gaussian integrated over each pixel: x, y, flux, sigma and the sky under it.

    Gauss-Newton on a 7x7 window around the blob's middle. The model is I = b + F gx gy with
    gx = [erf((x - x0 + 1/2) / (sigma sqrt 2)) - erf((x - x0 - 1/2) / (sigma sqrt 2))] / 2, and a pixel weighs
    1 / (noise^2 + F gx gy / g) for a gain of g electrons a unit: with equal weights a bright star is placed
    4/3 times worse than the photons allow. Saturated pixels are left out: the wings tell where the star is. A blob
    that the model does not fit (no convergence, larger than the window) keeps its centre of gravity.
    """
    return _measured(_or_gravity(_gaussians(image, blobs, gain_e_dn, hints), image, blobs, gain_e_dn))


def streak(image: NDArray, blobs: Blobs, gain_e_dn: float = 1.0, hints: FramePriors = NO_PRIORS) -> Centroids:
    """Least-squares fit of a line segment blurred by a Gaussian: its middle is the star at mid-exposure.

    Middle, flux and sky are free; length, direction and width nearly so, about the hints' streak, else what the
    frame's blobs share. The ends are `streak_ends`. The covariance is Cramer and Rao's, worse along than across, and
    what noise makes of the ends of a faint one. Frames that are not smeared get `gaussian_fit`; in the others blobs
    that are no streak get it too, or their centre of gravity where a streak is longer than a round star's window.
    """
    lines = _streaks(image, blobs, gain_e_dn, hints)
    lost = np.isnan(lines[:, 0])
    if lost.all():
        return gaussian_fit(image, blobs, gain_e_dn, hints)
    covariance = lines[:, [5, 7, 7, 6]].reshape(-1, 2, 2)
    rows = lines[:, [0, 1, 5, 2]]
    rows[:, 2] = np.sqrt((lines[:, 5] + lines[:, 6]) / 2)
    if lost.any():
        rows[lost] = np.nan
        # A longer one does not fit the window of a round star.
        if np.hypot(*_smear(blobs, hints)) <= gaussian.HALF_PX:
            rows[lost] = _gaussians(image, blobs.take(lost), gain_e_dn, hints)
        rows = _or_gravity(rows, image, blobs, gain_e_dn)
        covariance[lost] = rows[lost, 2, None, None] ** 2 * np.eye(2)
    return Centroids(rows[:, :2], rows[:, 2], rows[:, 3], covariance)


def streak_ends(
    image: NDArray, blobs: Blobs, gain_e_dn: float = 1.0, hints: FramePriors = NO_PRIORS
) -> tuple[Floats, Floats]:
    """(N, 2) and (N, 2) where each streak of `streak` begins and ends, or the reverse; NaN for what is none."""
    rows = _streaks(image, blobs, gain_e_dn, hints)
    return rows[:, :2] - rows[:, 3:5] / 2, rows[:, :2] + rows[:, 3:5] / 2


def disc(image: NDArray, blobs: Blobs, gain_e_dn: float = 1.0, hints: FramePriors = NO_PRIORS) -> Centroids:
    """Least-squares fit of an evenly bright disc with a blurred edge: an LED near by.

    Middle, radius, edge width, brightness and sky are free. The edge alone tells the place, so that a saturated
    disc is placed as well as another; its full pixels are left out. A blob too small for a disc, or none, keeps its
    centre of gravity.
    """
    sky = blobs.background
    rows = disc_fit.fit_all(
        native(image),
        blobs.xy_px,
        blobs.flux,
        blobs.area_px,
        blobs.box_px,
        sky.level,
        sky.noise,
        gain_e_dn,
        hints.saturation,
    )
    return _measured(_or_gravity(rows[:, :4], image, blobs, gain_e_dn))


CENTROIDERS: dict[str, Centroider] = {
    "default": streak,
    "cog": cog,
    "weighted": weighted,
    "gaussian_window": gaussian_window,
    "gaussian_fit": gaussian_fit,
    "streak": streak,
    "disc": disc,
}


def _gaussians(image: NDArray, blobs: Blobs, gain_e_dn: float, hints: FramePriors) -> Floats:
    """The rows of `starfit.fit_all`."""
    sky = blobs.background
    return gaussian.fit_all(
        native(image),
        blobs.xy_px,
        blobs.flux,
        blobs.box_px,
        blobs.peak,
        sky.level,
        sky.noise,
        gain_e_dn,
        hints.saturation,
    )


def _streaks(image: NDArray, blobs: Blobs, gain_e_dn: float, hints: FramePriors) -> Floats:
    """The rows of `streaks.fit_all`; all NaN for a frame that is not smeared."""
    line = _smear(blobs, hints)
    if np.hypot(*line) < streak_fit.SHORTEST_PX:
        return np.full((len(blobs), 8), np.nan)
    sky = blobs.background
    return streak_fit.fit_all(
        native(image), blobs.xy_px, blobs.box_px, sky.level, sky.noise, line, gain_e_dn, hints.saturation
    )


def _smear(blobs: Blobs, hints: FramePriors) -> tuple[float, float]:
    """(dx, dy) of the frame's streaks, px: as told, else as its blobs share; 0 where there are none."""
    return hints.streak_px or blobs.streak_px or (0.0, 0.0)


def _or_gravity(rows: Floats, image: NDArray, blobs: Blobs, gain_e_dn: float) -> Floats:
    """The rows, and the centre of gravity's where they are NaN."""
    lost = np.isnan(rows[:, 0])
    if lost.any():
        sky = blobs.background
        rows[lost] = moments.gravity(native(image), blobs.box_px, sky.level, sky.noise, gain_e_dn)[lost]
    return rows


def _measured(rows: Floats) -> Centroids:
    return Centroids(rows[:, :2], rows[:, 2], rows[:, 3])
