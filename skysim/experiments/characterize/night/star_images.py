"""Size of star images over the field, from Gaussian fits of single stars.

A star's image is a Gaussian integrated over the pixels, of standard deviations s_x and s_y along rows and columns, on a
constant sky. All stars are fitted at once, each with its six parameters, by damped Gauss-Newton steps with the weights
1 / (K signal + r^2 + 1/12) of the photon transfer, so that the errors of the sizes are known. Over the field

    s^2(rho) = sigma^2 + corner_sigma^2 rho^2,  rho = distance from the principal point over that of the corner,

which is the law of the key `psf` of a camera (field curvature and coma to first order), is fitted by weighted least
squares; stars whose image is no Gaussian, such as doubles, are left out. Stars that trail, by a tripod that does not
follow the sky, have s_x^2 - s_y^2 or a tilt in common; they are refused.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from scipy import special

from skysim.core.constants import MAD_PER_SIGMA
from skysim.core.types import Floats
from skysim.experiments.characterize.sensor.estimate import Estimate
from skysim.experiments.characterize.sensor.photon_transfer import ROUNDING_DN2

HALF_PX = 7  # half of a star's window
X, Y, FLUX, SKY, LN_SX, LN_SY = range(6)
# of the fit; a step in standard deviations
STEPS = 30
CONVERGED = 1e-3
START_SIGMA_PX = 1.0
MAX_STEP = 0.5  # pixels, and of the logarithms
OUTLIER_SIGMAS = 4.0  # of a chi-square, and of a size
# of leaving out outliers, and the change of the errors at their end
ROUNDS = 12
SETTLED = 1e-4
LEAST_VARIANCE_PX2 = 1e-3


class StarImages(NamedTuple):
    """Fitted images of N stars.

    xy_px : (N, 2);  flux_dn : (N,);  variance_px2, variance_sigma_px2 : (N,) mean of s_x^2 and s_y^2, and its error
    stretch_px2 : (N, 2) s_x^2 - s_y^2, and twice the covariance of x and y: of a trail
    chi2 : (N,) reduced
    """

    xy_px: Floats
    flux_dn: Floats
    variance_px2: Floats
    variance_sigma_px2: Floats
    stretch_px2: Floats
    chi2: Floats

    def take(self, rows: Floats) -> StarImages:
        return StarImages(*(one[rows] for one in self))


class ImageSize(NamedTuple):
    """sigma_px and corner_sigma_px of the key psf; the stars used, and how many were left out."""

    sigma_px: Estimate
    corner_sigma_px: Estimate
    used: StarImages
    left_out: int


def windows(image_dn: Floats, xy_px: Floats) -> tuple[Floats, Floats]:
    """(N, M) pixels of each star's window, and (N, 2) their upper left corners; stars are HALF_PX from the border."""
    corner = np.rint(xy_px).astype(int) - HALF_PX
    span = np.arange(2 * HALF_PX + 1)
    rows = corner[:, 1, None, None] + span[:, None]
    columns = corner[:, 0, None, None] + span[None, :]
    return np.asarray(
        image_dn[rows, columns].reshape(len(xy_px), -1), dtype=np.float64
    ), corner.astype(np.float64)


def integrals(center: Floats, ln_sigma: Floats) -> tuple[Floats, Floats, Floats]:
    """(N, S) integrals of a Gaussian over the pixels of a window, and their slopes to center and logarithm of sigma."""
    sigma = np.exp(ln_sigma)[:, None]
    z = (np.arange(2 * HALF_PX + 2) - 0.5 - center[:, None]) / sigma
    density = np.exp(-(z**2) / 2) / np.sqrt(2 * np.pi)
    return np.diff(special.ndtr(z)), -np.diff(density) / sigma, -np.diff(z * density)


def model(p: Floats) -> tuple[Floats, Floats]:
    """(N, M) pixels, and (N, M, 6) their slopes, of images with the parameters p (N, 6)."""
    (gx, dx, wx), (gy, dy, wy) = integrals(p[:, X], p[:, LN_SX]), integrals(p[:, Y], p[:, LN_SY])

    def plane(by_y: Floats, by_x: Floats) -> Floats:
        return np.asarray((by_y[:, :, None] * by_x[:, None, :]).reshape(len(p), -1))

    flux = p[:, FLUX, None]
    image = plane(gy, gx)
    slopes = [flux * plane(gy, dx), flux * plane(dy, gx), image, np.ones_like(image)]
    slopes += [flux * plane(gy, wx), flux * plane(wy, gx)]
    return p[:, SKY, None] + flux * image, np.stack(slopes, axis=2)


def fit_images(image_dn: Floats, xy_px: Floats, gain_dn_e: float, read_dn2: float) -> StarImages:
    """Fit the stars at these pixels of a frame without black level, its signal linear; gain in DN per electron."""
    pixels, corner = windows(image_dn, xy_px)
    sky = np.median(pixels, axis=1)
    flux = np.maximum((pixels - sky[:, None]).sum(axis=1), 1.0)
    start = np.full(len(xy_px), np.log(START_SIGMA_PX))
    p = np.column_stack([xy_px - corner, flux, sky, start, start])
    damping = np.full(len(p), 1e-3)
    expected, slopes = model(p)
    chi2 = np.full(len(p), np.inf)
    for _ in range(STEPS):
        weight = 1 / (gain_dn_e * np.maximum(expected, 0.0) + read_dn2 + ROUNDING_DN2)
        residual = pixels - expected
        chi2 = np.sum(weight * residual**2, axis=1)
        normal = np.einsum("nmi,nm,nmj->nij", slopes, weight, slopes, optimize=True)
        gradient = np.einsum("nmi,nm->ni", slopes, weight * residual)
        damped = (
            normal
            + np.eye(6)
            * (damping[:, None] * np.diagonal(normal, axis1=1, axis2=2) + 1e-12)[:, None, :]
        )
        step = np.linalg.solve(damped, gradient[:, :, None])[:, :, 0]
        limited = np.clip(step[:, [X, Y, LN_SX, LN_SY]], -MAX_STEP, MAX_STEP)
        step[:, [X, Y, LN_SX, LN_SY]] = limited
        trial = p + step
        trial_expected, trial_slopes = model(trial)
        better = np.sum(weight * (pixels - trial_expected) ** 2, axis=1) <= chi2 * (1 + 1e-12)
        p = np.where(better[:, None], trial, p)
        expected = np.where(better[:, None], trial_expected, expected)
        slopes = np.where(better[:, None, None], trial_slopes, slopes)
        damping = np.where(better, damping / 10, damping * 10)
        if np.all(np.einsum("ni,nij,nj->n", step, normal, step) < CONVERGED**2):
            break
    return summary(p, corner, pixels - expected, normal, chi2)


def summary(
    p: Floats, corner: Floats, residual: Floats, normal: Floats, chi2: Floats
) -> StarImages:
    """What is used of the fits."""
    covariance = np.linalg.inv(normal)
    sx2 = np.exp(2 * p[:, LN_SX])
    sy2 = np.exp(2 * p[:, LN_SY])
    slope = np.zeros((len(p), 6))
    # of (s_x^2 + s_y^2) / 2
    slope[:, LN_SX] = sx2
    slope[:, LN_SY] = sy2
    error = np.sqrt(np.einsum("ni,nij,nj->n", slope, covariance, slope))
    # A tilt leaves residuals F c g (x - x0)(y - y0) / (s_x^2 s_y^2), c the covariance, to first order.
    span = np.arange(2 * HALF_PX + 1)
    u = (span - p[:, X, None]) / sx2[:, None]
    v = (span - p[:, Y, None]) / sy2[:, None]
    gx = integrals(p[:, X], p[:, LN_SX])[0]
    gy = integrals(p[:, Y], p[:, LN_SY])[0]
    tilt = p[:, FLUX, None] * ((v * gy)[:, :, None] * (u * gx)[:, None, :]).reshape(len(p), -1)
    covariance_px2 = np.sum(tilt * residual, axis=1) / np.maximum(np.sum(tilt**2, axis=1), 1e-300)
    stretch = np.column_stack([sx2 - sy2, 2 * covariance_px2])
    freedom = residual.shape[1] - 6
    return StarImages(
        corner + p[:, [X, Y]], p[:, FLUX], (sx2 + sy2) / 2, error, stretch, chi2 / freedom
    )


def image_size(
    stars: StarImages, center_px: tuple[float, float], corner_px: float
) -> ImageSize | None:
    """The law of the size over the field; None for fewer than three stars that are Gaussians."""
    freedom = (2 * HALF_PX + 1) ** 2 - 6
    sound = np.isfinite(stars.variance_sigma_px2) & (
        stars.chi2 < 1 + OUTLIER_SIGMAS * np.sqrt(2 / freedom) + 0.2
    )
    rho2 = np.sum((stars.xy_px - np.array(center_px)) ** 2, axis=1) / corner_px**2
    design = np.column_stack([np.ones(len(rho2)), rho2])
    # A star's relative error, times the law's size: its own error would give images that came out small more weight.
    kept = sound
    relative = stars.variance_sigma_px2 / stars.variance_px2
    expected = stars.variance_px2
    for _ in range(ROUNDS):
        if kept.sum() < 3:
            return None
        error = relative * expected
        weight = np.where(kept, 1 / error**2, 0.0)
        normal = np.linalg.inv((design.T * weight) @ design)
        found = normal @ ((design.T * weight) @ stars.variance_px2)
        expected = np.maximum(design @ found, LEAST_VARIANCE_PX2)
        pull = (stars.variance_px2 - expected) / (relative * expected)
        again = sound & (
            np.abs(pull)
            < OUTLIER_SIGMAS * max(1.0, float(np.median(np.abs(pull[kept]))) / MAD_PER_SIGMA)
        )
        is_settled = np.array_equal(again, kept) and np.allclose(
            error, relative * expected, rtol=SETTLED
        )
        kept = again
        if is_settled:
            break
    scatter = max(1.0, float(np.sum(pull[kept] ** 2)) / max(int(kept.sum()) - 2, 1))
    sigma2, corner2 = np.sqrt(np.diag(normal) * scatter)
    used = stars.take(kept)
    return ImageSize(
        Estimate.root(float(found[0]), float(sigma2)),
        Estimate.root(float(found[1]), float(corner2)),
        used,
        len(rho2) - int(kept.sum()),
    )
