"""Frames of the night sky: detection, identification and calibration by the estimator, and the size of star images."""

import datetime
import math
from pathlib import Path
from typing import NamedTuple

import numpy as np
from scipy import special
from scipy.spatial import cKDTree

from estimator.calibration.star_field import Calibration, self_calibrate
from estimator.catalog import catalog
from estimator.core.camera import Camera
from estimator.core.errors import ImageError
from estimator.core.types import Centroids
from estimator.trackers.pipeline import Clock, Settings, detect_and_centroid
from estimator.trackers.star_tracker import StarTracker
from skysim.core import images
from skysim.core.constants import MAD_PER_SIGMA
from skysim.core.errors import InputError, refusing
from skysim.core.types import Array, Floats, joined, median, taken
from skysim.experiments.characterize.frame_files import image_files, padding_bits, raw_numbers
from skysim.experiments.characterize.photon_transfer import (
    BLACK,
    GAIN,
    READ,
    ROUNDING_DN2,
    Estimate,
    Transfer,
)
from skysim.scene.sections.camera import CameraConfig
from skysim.tracking.onboard_model import calibration, onboard_catalog

# Size of star images over the field, from Gaussian fits of single stars.


HALF_PX = 7  # a star's window is 2 HALF_PX + 1 pixels wide
X, Y, FLUX, SKY, LN_SX, LN_SY = range(6)
STEPS = 30  # most steps of the fit
CONVERGED = 1e-3  # length of the last step, in standard deviations
START_SIGMA_PX = 1.0
MAX_STEP = 0.5  # greatest step: pixels of a position, or of the logarithm of a size
OUTLIER_SIGMAS = 4.0  # greatest deviation of a chi-square, and of a size
ROUNDS = 12  # most rounds of leaving out outliers
SETTLED = 1e-4  # relative change of the errors that ends the rounds
LEAST_VARIANCE_PX2 = 1e-3


class StarImages(NamedTuple):
    """Fitted images of N stars.

    Attributes
    ----------
    xy_px
        (N, 2) positions
    flux_dn
        (N,) fluxes
    variance_px2, variance_sigma_px2
        (N,) mean of s_x^2 and s_y^2, and its error
    stretch_px2
        (N, 2) s_x^2 - s_y^2, and twice the covariance of x and y: of a trail
    chi2
        (N,) reduced
    """

    xy_px: Floats
    flux_dn: Floats
    variance_px2: Floats
    variance_sigma_px2: Floats
    stretch_px2: Floats
    chi2: Floats


class ImageSize(NamedTuple):
    """sigma_px and corner_sigma_px of the key psf; the stars that were used, and the number of those left out."""

    sigma_px: Estimate
    corner_sigma_px: Estimate
    used: StarImages
    left_out: int


def windows(image_dn: Floats, xy_px: Floats) -> tuple[Floats, Floats]:
    """(N, M) pixels of each star's window, and (N, 2) their upper left corners; stars are HALF_PX from the border."""
    corner = np.rint(xy_px).astype(int) - HALF_PX
    every = np.lib.stride_tricks.sliding_window_view(image_dn, (2 * HALF_PX + 1,) * 2)
    chosen = every[corner[:, 1], corner[:, 0]].reshape(len(xy_px), -1)
    return chosen.astype(np.float64), corner.astype(np.float64)


def integrals(center: Floats, ln_sigma: Floats) -> tuple[Floats, Floats, Floats]:
    """(N, S) integrals of a Gaussian over the pixels of a window, and their slopes to center and logarithm of sigma."""
    sigma = np.exp(ln_sigma)[:, None]
    z = (np.arange(2 * HALF_PX + 2) - 0.5 - center[:, None]) / sigma
    density = np.exp(-(z**2) / 2) / np.sqrt(2 * np.pi)
    return np.diff(special.ndtr(z)), -np.diff(density) / sigma, -np.diff(z * density)


def model(p: Floats) -> tuple[Floats, Floats]:
    """(N, M) pixels, and (N, M, 6) their slopes, of images with the parameters p (N, 6)."""
    gx, dx, wx = integrals(p[:, X], p[:, LN_SX])
    gy, dy, wy = integrals(p[:, Y], p[:, LN_SY])

    def plane(by_y: Floats, by_x: Floats) -> Floats:
        return (by_y[:, :, None] * by_x[:, None, :]).reshape(len(p), -1)

    flux = p[:, FLUX, None]
    image = plane(gy, gx)
    slopes = [
        flux * plane(gy, dx),
        flux * plane(dy, gx),
        image,
        np.ones_like(image),
        flux * plane(gy, wx),
        flux * plane(wy, gx),
    ]
    return p[:, SKY, None] + flux * image, np.stack(slopes, axis=2)


def fit_images(
    image_dn: Floats, xy_px: Floats, gain_dn_e: float, read_dn2: float
) -> StarImages:
    """Fit the stars at these pixels of a linear frame without black level; the gain is in DN per electron."""
    pixels, corner = windows(image_dn, xy_px)
    sky = np.median(pixels, axis=1)
    flux = np.maximum((pixels - sky[:, None]).sum(axis=1), 1.0)
    start = np.full(len(xy_px), np.log(START_SIGMA_PX))
    p = np.column_stack([xy_px - corner, flux, sky, start, start])
    damping = np.full(len(p), 1e-3)
    expected, slopes = model(p)
    limited = [X, Y, LN_SX, LN_SY]
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
        step[:, limited] = np.clip(step[:, limited], -MAX_STEP, MAX_STEP)
        trial = p + step
        trial_expected, trial_slopes = model(trial)
        better = np.sum(weight * (pixels - trial_expected) ** 2, axis=1) <= chi2 * (1 + 1e-12)
        p[better] = trial[better]
        expected[better] = trial_expected[better]
        slopes[better] = trial_slopes[better]
        damping = np.where(better, damping / 10, damping * 10)
        if np.all(np.einsum("ni,nij,nj->n", step, normal, step) < CONVERGED**2):
            break
    return summary(p, corner, pixels - expected, normal, chi2)


def summary(
    p: Floats, corner: Floats, residual: Floats, normal: Floats, chi2: Floats
) -> StarImages:
    """The star images from the parameters of the fits."""
    # (N, 2) s_x^2 and s_y^2, which are also the slopes of their mean by the logarithms of s_x and s_y.
    variance = np.exp(2 * p[:, LN_SX:])
    covariance = np.linalg.inv(normal)[:, LN_SX:, LN_SX:]
    error = np.sqrt(np.einsum("ni,nij,nj->n", variance, covariance, variance))
    # A tilt leaves residuals F c g (x - x0)(y - y0) / (s_x^2 s_y^2), c the covariance, to first order.
    span = np.arange(2 * HALF_PX + 1)
    across, down = (
        (span - p[:, axis, None])
        / variance[:, axis, None]
        * integrals(p[:, axis], p[:, LN_SX + axis])[0]
        for axis in (X, Y)
    )
    tilt = np.einsum("n,ny,nx->nyx", p[:, FLUX], down, across).reshape(len(p), -1)
    square = np.maximum(np.sum(tilt**2, axis=1), 1e-300)
    covariance_px2 = np.sum(tilt * residual, axis=1) / square
    stretch = np.column_stack([-np.diff(variance), 2 * covariance_px2])
    freedom = residual.shape[1] - 6
    return StarImages(
        corner + p[:, [X, Y]],
        p[:, FLUX],
        variance.mean(axis=1),
        error,
        stretch,
        chi2 / freedom,
    )


def image_size(
    stars: StarImages, center_px: tuple[float, float], corner_px: float
) -> ImageSize | None:
    """The law of the size over the field; None if fewer than three stars fit a Gaussian."""
    freedom = (2 * HALF_PX + 1) ** 2 - 6
    sound = np.isfinite(stars.variance_sigma_px2) & (
        stars.chi2 < 1 + OUTLIER_SIGMAS * np.sqrt(2 / freedom) + 0.2
    )
    rho2 = np.sum((stars.xy_px - np.array(center_px)) ** 2, axis=1) / corner_px**2
    design = np.column_stack([np.ones(len(rho2)), rho2])
    # The error is a star's relative error times the law's size: with its own size, images that were measured too small
    # would have too much weight.
    kept = sound
    relative = stars.variance_sigma_px2 / stars.variance_px2
    expected = stars.variance_px2
    for _ in range(ROUNDS):
        if kept.sum() < 3:
            return None
        error = relative * expected
        weighted = design.T * np.where(kept, 1 / error**2, 0.0)
        normal = np.linalg.inv(weighted @ design)
        found = normal @ (weighted @ stars.variance_px2)
        expected = np.maximum(design @ found, LEAST_VARIANCE_PX2)
        pull = (stars.variance_px2 - expected) / (relative * expected)
        again = sound & (
            np.abs(pull)
            < OUTLIER_SIGMAS * max(1.0, median(np.abs(pull[kept])) / MAD_PER_SIGMA)
        )
        is_settled = np.array_equal(again, kept) and np.allclose(
            error, relative * expected, rtol=SETTLED
        )
        kept = again
        if is_settled:
            break
    scatter = max(1.0, float(np.sum(pull[kept] ** 2)) / max(int(kept.sum()) - 2, 1))
    sigma2, corner2 = np.sqrt(np.diag(normal) * scatter)
    used = taken(stars, kept)
    return ImageSize(
        Estimate.root(found[0], sigma2),
        Estimate.root(found[1], corner2),
        used,
        len(rho2) - int(kept.sum()),
    )


CATALOG = "gaia_v8.0"
DEFAULT_EPOCH_YR = 2020.0
STARS_A_FIELD = 300.0  # mean number of catalog stars in a field
FOCAL_UNCERTAINTY = 0.05  # relative, of the focal length in the camera's file
LEAST_SNR = 40.0  # least signal-to-noise ratio of a star whose image is measured
MAX_PEAK = 0.8  # greatest peak of such a star, relative to saturation
LEAST_STARS = 20
LEAST_FRAMES = 3
LEAST_TRAILED = 3
MEDIAN_COST = 1.25  # ratio of the standard errors of a median and of a mean
MAX_STRETCH = 0.25  # greatest stretch of the images, relative to their variance
LENS = ("focal_px", "center_x_px", "center_y_px", "k1", "k2", "p1", "p2", "k3")


class Night(NamedTuple):
    """Image size, and the lens with its covariance if the sky was identified; remarks on what is unknown."""

    size: ImageSize
    lens: Calibration | None
    frames: int
    identified: int
    remarks: list[str]


class NightFrame(NamedTuple):
    """A frame of the night: its stars' centroids and images."""

    path: Path
    centroids: Centroids
    stars: StarImages
    date_utc: datetime.datetime | None
    row_order_known: bool = True


def measure_night(
    config: CameraConfig, folder: Path, transfer: Transfer, saturation_dn: float
) -> Night:
    """The lens from frames of the sky. Raises InputError for frames that cannot be used."""
    paths = image_files(folder)
    settings = Settings(
        gain_e_dn=float(1 / transfer.values[GAIN]),
        saturation=saturation_dn,
        centroid_sigma_px=0.02,
    )
    frames = [read_frame(path, config, transfer, settings) for path in paths]
    stars = all_stars(frames)
    if len(stars.chi2) < LEAST_STARS:
        raise InputError(
            folder,
            f"{len(stars.chi2)} single stars of a signal to noise of {LEAST_SNR:g}, not saturated, in"
            f" {len(frames)} frames",
            f"{LEAST_STARS} or more: more frames, or longer exposures",
        )
    check_trails(frames)
    lens, remarks = find_lens(config, frames, settings)
    if lens is None and not all(one.row_order_known for one in frames):
        frames = [read_frame(path, config, transfer, settings, True) for path in paths]
        lens, found = find_lens(config, frames, settings)
        if lens:
            stars = all_stars(frames)
            remarks = [f"rows: {images.ASSUMED_TOP_DOWN}", *found]
    center_px = lens.camera.center_px if lens else config.center_px
    size = image_size(stars, center_px, config.corner_px)
    if size is None:
        raise InputError(
            folder, "no star's image is a Gaussian", "stars in focus, not trailed"
        )
    if size.left_out > 0.5 * len(stars.chi2):
        remarks.append(
            f"psf: {size.left_out} of {len(stars.chi2)} star images are no Gaussians, and were left out"
        )
    identified = int(lens.report.tied.sum()) if lens else 0
    return Night(size, lens, len(frames), identified, remarks)


def all_stars(frames: list[NightFrame]) -> StarImages:
    """The star images of all frames, without the effect of trails."""
    return joined([without_trail(one.stars) for one in frames])


def read_frame(
    path: Path,
    config: CameraConfig,
    transfer: Transfer,
    settings: Settings,
    as_stored: bool = False,
) -> NightFrame:
    """Detect and fit the stars of a frame. Raises InputError for a frame of another camera.

    as_stored takes the first row of a file without a row order for the highest.
    """
    picture = images.read_picture(path)
    numbers = raw_numbers(path, picture)
    if as_stored and not picture.row_order_known:
        numbers = np.ascontiguousarray(numbers[::-1])
    images.check_size(path, numbers, (config.height_px, config.width_px))
    numbers = np.right_shift(numbers, np.uint16(padding_bits(numbers, config.detector.bits)))
    with refusing(ImageError, path):
        centroids = detect_and_centroid(numbers, calibration(config), settings, Clock())
    signal = transfer.linear_dn(numbers - transfer.values[BLACK])
    chosen = measurable(numbers, centroids, transfer, settings.saturation)
    gain, _, read = transfer.values[: READ + 1].tolist()
    return NightFrame(
        path,
        centroids,
        fit_images(signal, chosen, gain, read),
        picture.date_utc,
        picture.row_order_known,
    )


def measurable(
    numbers: Array, centroids: Centroids, transfer: Transfer, saturation_dn: float
) -> Floats:
    """(N, 2) pixels of stars that are bright, not saturated, and away from the border and from other stars."""
    xy = centroids.xy_px
    last = np.array(numbers.shape[::-1]) - 1
    inside = np.all((xy >= HALF_PX) & (xy <= last - HALF_PX), axis=1)
    near = cKDTree(xy).query(xy, k=2)[0][:, 1]
    x, y = np.clip(np.rint(xy).astype(int), 0, last).T
    background = median(numbers)
    gain, _, read, black = transfer.values[: BLACK + 1]
    dark_e2 = (background - black) / gain + read / gain**2
    flux_e = centroids.flux / gain
    snr = flux_e / np.sqrt(np.maximum(flux_e + 12 * max(dark_e2, 0.0), 1.0))
    kept = (
        inside
        & (near > HALF_PX * math.sqrt(2))
        & (numbers[y, x] < MAX_PEAK * saturation_dn)
        & (snr > LEAST_SNR)
    )
    return xy[kept]


def without_trail(stars: StarImages) -> StarImages:
    """The images without the effect of a common trail on their mean variance: half of the stretch minus its error."""
    count = len(stars.chi2)
    if count < LEAST_TRAILED:
        return stars
    noise2 = float(np.sum(np.var(stars.stretch_px2, axis=0))) * MEDIAN_COST**2 / count
    trail_px2 = math.hypot(*np.median(stars.stretch_px2, axis=0))
    added = math.sqrt(max(trail_px2**2 - noise2, 0.0)) / 2
    return stars._replace(variance_px2=stars.variance_px2 - added)


def check_trails(frames: list[NightFrame]) -> None:
    """Raise InputError for a frame whose stars trail: their images are longer in one direction."""
    for one in frames:
        if len(one.stars.chi2) < LEAST_TRAILED:
            continue
        along, across = np.median(one.stars.stretch_px2, axis=0).tolist()
        stretch = math.hypot(along, across)
        variance = median(one.stars.variance_px2)
        if stretch > MAX_STRETCH * variance:
            # A uniform streak of length L has the variance L^2 / 12.
            trail_px = math.sqrt(12 * stretch)
            angle_deg = math.degrees(math.atan2(across, along)) / 2
            raise InputError(
                one.path,
                f"stars trail by {trail_px:.2g} px at {angle_deg:.0f}° from the rows",
                f"{math.sqrt(12 * MAX_STRETCH * variance):.2g} px: a shorter exposure, or a mount that follows the sky",
            )


def find_lens(
    config: CameraConfig, frames: list[NightFrame], settings: Settings
) -> tuple[Calibration | None, list[str]]:
    """The lens from identified stars, starting at the focal length in the camera's file; or why it is unknown."""
    if len(frames) < LEAST_FRAMES:
        lacking = LEAST_FRAMES - len(frames)
        return None, [
            f"focal length, distortion: {len(frames)} frames of the night; allowed: {lacking} more elsewhere"
        ]
    camera = calibration(config)
    stars = onboard_catalog("characterize.night", CATALOG)
    narrow_sr = camera.zoomed(1 + FOCAL_UNCERTAINTY).field_sr
    limit_mag = catalog.limit_for_density(stars, narrow_sr, STARS_A_FIELD)
    stars = catalog.brighter_than(stars, limit_mag)
    dates = [one.date_utc for one in frames if one.date_utc is not None]
    vectors = (
        catalog.apparent(stars, catalog.on_earth(dates[0]))
        if dates
        else catalog.at_epoch(stars, DEFAULT_EPOCH_YR)
    )

    def tracker(model: Camera, uncertainty: float) -> StarTracker:
        return StarTracker(model, stars, vectors, settings, uncertainty)

    try:
        found = self_calibrate(
            [one.centroids for one in frames], tracker, camera, FOCAL_UNCERTAINTY
        )
    except ValueError as error:
        return None, [
            f"focal length, distortion: {error}; the camera's file states {camera.focal_px:.5g} px, to 5 %"
        ]
    return found, [] if dates else [
        "date: no frame has one; allowed: DATE-OBS in a FITS header, for aberration to 20″"
    ]


def lens_estimates(config: CameraConfig, found: Calibration) -> dict[str, Estimate]:
    """Focal length in millimeters, principal point in pixels, and coefficients of distortion.

    The calibration measures the distance of the image in pixels; by the thin lens the focal length is
    1 / (1 / v + 1 / u).
    """
    errors = np.sqrt(np.diag(found.covariance))
    camera = found.camera
    image_m = camera.focal_px * config.pixel_m
    focal_m = 1 / (1 / image_m + 1 / config.focus_m)
    focal = Estimate.normal(
        1e3 * focal_m, 1e3 * float(errors[0]) * config.pixel_m * (focal_m / image_m) ** 2
    )
    values = [*camera.center_px, *camera.distortion]
    rest = {
        name: Estimate.normal(value, error)
        for name, value, error in zip(LENS[1:], values, errors[1:], strict=True)
    }
    return {"focal_length_mm": focal, **rest}
