"""Prediction of detections and centroids: the lights that the tracker detects, and the covariance of their positions.

1. `threshold_e` is the detection threshold of the scene's detector.
2. `detected_px` is the extent of an image above the threshold.
3. `usable` selects the lights that are detected.
4. `with_noise` predicts the covariance of their centroids.
"""

import math
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from functools import lru_cache

import numpy as np
from scipy import special

from estimator.centroiding.gaussian_fit import HALF_WINDOW_PX, fit_all
from estimator.centroiding.moments import sampling_variance
from estimator.detection.background import FILTERED_NOISE
from estimator.detection.detect import (
    MAX_STREAK_PX,
    SHORTEST_PX,
    line_taps,
    noise_factor,
)
from estimator.trackers.pipeline import SATURATED_SIGMA_PX, Settings
from skysim.camera.detector import repel, saturation_dn
from skysim.core.constants import GOLDEN_ANGLE_RAD
from skysim.core.types import Bools, Floats, Ints, median
from skysim.scene.scene import Scene
from skysim.simulation.checks import beliefs
from skysim.simulation.checks.beliefs import Beliefs
from skysim.simulation.checks.views import CameraModel, View, peak_share
from skysim.simulation.lab import Lab
from skysim.sources.dome.led import lit_moments_s
from skysim.sources.dome.surface import Surface, build_surface
from skysim.tracking.factory import assumed_settings
from skysim.tracking.onboard_model import rows_of

# Variance that the detectors' filter [1 2 1] / 4 adds to an image, along each axis
BINOMIAL_VARIANCE_PX2 = 0.5
# Grid on which images are integrated, in standard deviations of the blur: its step, and its margin.
STEP = 0.4
MARGIN = 5.0
DISK_POINTS = 24  # points of a disk
SHAPES = 10  # images whose sizes differ by less than one in this number count as equal
COG_MARGIN_PX = 4.0  # margin of the window about the pixels above the threshold
STILL_PX = np.zeros(2)
# Edges of the pixels of the window of a fit.
WINDOW_PX = 2 * HALF_WINDOW_PX + 1
EDGES_PX = np.arange(WINDOW_PX + 1) - WINDOW_PX / 2
# Places (x, y) as complex numbers, and where rays through even parts of the pupil end for a coma of 1 (`otf.coma`).
COMPLEX = np.array([1, 1j])
RAYS = np.outer(np.arange(1, 12, 2) / 12, 2 + 1j ** (np.arange(8) / 2)).ravel() - 1
STREAK_CENTROIDERS = ("default", "streak")
# Error of a streak's ends at which half of the fits converge (frames of paths of 25 to 150 px)
MAX_END_SIGMA_PX = 1.1
# Streaks less far apart across their paths touch; a blob whose center is displaced by more is lost (same frames).
ACROSS_PX = 3.0
MERGED_PX = 3.0
PHASES = 64  # number of phases of the pulses relative to the exposure
# Number of periods in an exposure from which the mean time of the light does not vary
MAX_PERIODS = 499


@dataclass(frozen=True)
class Context:
    """The data that all checks share.

    Attributes
    ----------
    lab
        Laboratory
    settings, beliefs
        Settings and beliefs of the tracker
    camera
        Camera
    surface
        Surface of the dome; None under the stars
    timing_s
        (N,) standard deviation of the mean time within an exposure of each light that the tracker knows
    """

    lab: Lab
    settings: Settings
    beliefs: Beliefs
    camera: CameraModel
    surface: Surface | None
    timing_s: Floats

    @property
    def scene(self) -> Scene:
        """The scene."""
        return self.lab.scene

    @property
    def full_e(self) -> float:
        """Electrons in a pixel at the saturation of converter or well."""
        detector = self.scene.camera.detector
        return (saturation_dn(detector) - detector.offset_dn) * detector.gain_e_dn

    def rows_of(self, ids: Ints) -> Ints:
        """(M,) rows in the tracker's beliefs of lights with these numbers; -1 for lights that it does not know."""
        known = self.beliefs.lights.id
        if not len(known):
            return np.full(len(ids), -1)
        row = rows_of(ids, known)
        return np.where(known[row] == ids, row, -1)


def context_of(lab: Lab) -> Context:
    """The context of a lab. Raises InputError for a map or a catalog that cannot be read."""
    camera = CameraModel.of(lab)
    believed = beliefs.of(lab, camera)
    dome = lab.scene.dome
    lights = believed.lights
    surface = build_surface(dome.surface) if dome else None
    timing_s = timing_sigma_s(lights.period_s, lights.on_s, lab.scene.exposure.time_s)
    return Context(
        lab,
        assumed_settings(lab.scene),
        believed,
        camera,
        surface,
        timing_s,
    )


def threshold_e(context: Context, streak_px: Floats = STILL_PX) -> float:
    """Detection threshold: electrons above the background of a pixel after the detector's filter.

    The detector `default` averages along streaks (2,), with `line_taps`.
    """
    settings = context.settings
    camera = context.camera
    if settings.detector == "thesis":
        detector = context.scene.camera.detector
        threshold_dn = settings.intensity_threshold * saturation_dn(detector)
        return max(
            (threshold_dn - detector.offset_dn) * detector.gain_e_dn - camera.background_e,
            1.0,
        )
    length_px = np.abs(streak_px).max()
    along = settings.detector == "default" and SHORTEST_PX <= length_px <= MAX_STREAK_PX
    taps = line_taps(tuple(streak_px) if along else (0.0, 0.0))
    return settings.threshold_sigma * noise_factor(taps) * camera.noise_e


def peak_ratio(view: View, context: Context) -> Floats:
    """(n,) peak of each image over the detection threshold, both after the detector's filter."""
    share = peak_share(
        view.blur2_px2 + BINOMIAL_VARIANCE_PX2,
        view.disk_px,
        view.defocus_px,
        view.streak_length_px,
    )
    path_px = np.median(view.streak_px, axis=0) if len(view) else STILL_PX
    return view.electrons * share / threshold_e(context, path_px)


def detected_radius_px(view: View, context: Context) -> Floats:
    """(n,) distance from its path up to which each image is above the detection threshold; 0 if it is below."""
    log_ratio = np.log(np.maximum(peak_ratio(view, context), 1.0))
    radius = np.zeros(len(view))
    for rows, blur_px, ((u, v), image, *_) in shapes_of(view, BINOMIAL_VARIANCE_PX2):
        outward = v[0] >= 0
        fall = -np.log(image[len(u) // 2, outward])
        # Linear for a Gaussian.
        square = np.interp(log_ratio[rows], fall - fall[0], v[0, outward] ** 2)
        radius[rows] = blur_px * np.sqrt(square)
    # A disk's flat top ends at its rim, also where it is below the threshold.
    return np.where(log_ratio > 0, radius, 0.0)


def detected_px(view: View, context: Context) -> tuple[Floats, Floats]:
    """(n,) `detected_radius_px` r of each image, and its area pi r^2 + 2 r L in px^2, on a path of length L."""
    radius = detected_radius_px(view, context)
    return radius, np.pi * radius**2 + 2 * radius * view.streak_length_px


def end_sigma_px(view: View, context: Context) -> Floats:
    """(n,) error of a streak's center along its path because noise hides the streak's ends; 0 for other images.

    The Cramer-Rao bound omits it. With a electrons per pixel of length and the noise n of such a length after weighting
    across the path, the variance is 6.5 (n / a)^4 px^2 (Yao 1987, see `estimator.centroiding.streak_fit`).
    """
    length_px = view.streak_length_px
    if context.settings.centroider not in STREAK_CENTROIDERS:
        return np.zeros(len(view))
    across_px = 2 * math.sqrt(math.pi) * view.sigma_px
    a_e = np.maximum(view.electrons, 1e-9) / np.maximum(length_px, 1e-12)
    n_e2 = across_px * context.camera.noise_e**2 + a_e
    return np.where(length_px >= SHORTEST_PX, math.sqrt(6.5) * n_e2 / a_e**2, 0.0)


def broken(view: View, context: Context) -> Bools:
    """(n,) whether a streak is lost: its fit does not converge, or the detector joins it with others.

    The fit fails if the ends are too uncertain. The filter along a path of length L spreads a streak of q times the
    threshold over |u| < L (1 - 1 / q); others that it touches move its center, by more than MERGED_PX if it is lost.
    """
    lost = end_sigma_px(view, context) > MAX_END_SIGMA_PX
    length_px = view.streak_length_px
    if context.settings.detector != "default" or not (length_px >= SHORTEST_PX).any():
        return lost
    path_px = np.median(view.streak_px, axis=0)
    q = peak_ratio(view, context)
    rows = np.flatnonzero(q > 1)
    reach_px = length_px[rows] * (1 - 1 / q[rows])
    x, y = path_px / np.linalg.norm(path_px)
    apart_px = view.xy_px[rows, None] - view.xy_px[rows]
    along_px = np.abs(apart_px @ [x, y])
    across_px = np.abs(apart_px @ [-y, x])
    electrons = view.electrons[rows]
    touch = (across_px < ACROSS_PX) & (along_px < reach_px[:, None] + reach_px)
    moved_px = touch * along_px * electrons / (electrons[:, None] + electrons)
    lost[rows] |= moved_px.max(axis=1, initial=0.0) > MERGED_PX
    return lost


def usable(view: View, context: Context) -> View:
    """The brightest lights, at most `tracker.brightest`, whose images are detected and entirely on the detector."""
    settings = context.settings
    config = context.scene.camera
    # Distance of each image from the nearest edges, which must exceed its half size.
    far_px = np.array(config.size_px) - 1 - view.xy_px
    edge = np.minimum(view.xy_px, far_px)
    radius_px, area_px2 = detected_px(view, context)
    half_px = np.abs(view.streak_px) / 2 + radius_px[:, None]
    large = area_px2 >= settings.min_area_px
    found = np.flatnonzero(large & (edge > half_px).all(axis=1))
    return view.take(
        found[np.argsort(-view.electrons[found], kind="stable")][: settings.max_blobs]
    )


def with_noise(view: View, context: Context, prnu: float | None = None) -> View:
    """The lights with the covariances of their centroids: the sum of

    1. photon noise, and background noise of b electrons^2 a pixel. For a center of gravity in a window of sides A along
       and B across an axis it is sigma^2 / N + b A^3 B / (12 N^2), with sigma^2 increased by L^2 / 12 along the path;
       for other centroiders see `weighted_variance`; `weighted` adds its S-curve, the fit of streaks their ends.
    2. pixel sensitivity that varies by p: p^2 sum(I^2 x^2) / N^2, which is p^2 / (8 pi) for a Gaussian and
       p^2 / (4 pi) for a disk.
    3. the plateau of a saturated image.
    4. the mean time of pulsed light, timing^2 v v' with the image's velocity v.

    Parameters
    ----------
    view
        The n lights
    context
        Data of the checks
    prnu
        Relative variation p of the pixels' sensitivity; None for that of the detector
    """
    # 1. Noise along and across the path.
    lab = context.lab
    camera = context.camera
    noise_e2 = camera.noise_e**2
    n_e = np.maximum(view.electrons, 1e-9)
    length_px = view.streak_length_px
    centroider = context.settings.centroider
    if centroider == "gaussian_fit" and (length_px > HALF_WINDOW_PX).any():
        centroider = "cog"  # what does not fit keeps its center of gravity
    floor = np.zeros((len(view), 2))
    if centroider == "cog":
        margin_px = detected_radius_px(view, context)[:, None] + COG_MARGIN_PX
        sides_px = np.abs(view.streak_px) + 2 * margin_px
        floor = sides_px**2 * (noise_e2 * sides_px.prod(axis=1) / (12 * n_e**2))[:, None]
        along = (view.sigma_px**2 + length_px**2 / 12) / n_e
        across = view.sigma_px**2 / n_e
    else:
        weight = WEIGHTS.get(centroider, WEIGHTS["fit"])
        along, across = weighted_variance(view, n_e, noise_e2, weight)
        along = along + end_sigma_px(view, context) ** 2
        if centroider == "weighted" and len(view):
            curve_px2 = sampling_variance(median(view.sigma_px) ** 2 / 2)
            floor += np.where(length_px < 1, curve_px2, 0.0)[:, None]  # a path averages it
    # 2. Sensitivity of the pixels, between that of a Gaussian and that of a disk.
    disk = (view.disk_px**2 + view.defocus_px**2) / 4 / view.sigma_px**2
    varies = lab.scene.camera.detector.prnu if prnu is None else prnu
    pattern = varies**2 / (8 * np.pi) * (1 + disk)
    # 3. Saturation.
    plateau = SATURATED_SIGMA_PX**2 * (view.peak_e >= context.full_e)
    unit = view.streak_px / np.maximum(length_px, 1e-12)[:, None]
    along_path = unit[:, :, None] * unit[:, None, :]
    # 4. Timing.
    moved = (view.streak_px / lab.scene.exposure.time_s) * context.timing_s[view.row, None]
    return View(
        *view[:-1],
        ((across + pattern + plateau)[:, None] + floor)[:, :, None] * np.eye(2)
        + (along - across)[:, None, None] * along_path
        + moved[:, :, None] * moved[:, None, :],
    )


# Weights of the pixels in centroiders: functions of the distance from the center along an axis, of that from the
# center, of the image, of its derivative, and of the variance of the pixels. Lengths are in deviations of the blur.
Weight = Callable[[Floats, Floats, Floats, Floats, Floats], Floats]
WEIGHTS: dict[str, Weight] = {
    # Weighted least squares, which reaches the Cramer-Rao bound: all centroiders that are not named here.
    "fit": lambda u, r, image, slope, variance: slope / variance,
    "weighted": lambda u, r, image, slope, variance: u * image,
    # A Gaussian of twice the image's variance.
    "gaussian_window": lambda u, r, image, slope, variance: (
        u * np.exp(-(r**2) / (2 * (r**2 * image).sum() / image.sum()))
    ),
}


def weighted_variance(
    view: View, n_e: Floats, noise_e2: float, weight: Weight
) -> tuple[Floats, Floats]:
    """(n,) variances along and across the path, in px^2, of a centroid that is linear in the pixels.

    With N electrons in an image I of unit volume, b electrons^2 of background in a pixel, and the pixels' weight W for
    a displacement along u, to first order

        variance = sum W^2 (N I + b) / (N sum W dI/du)^2

    The fit of the image, W = N dI/du / (N I + b), has the least, 1 / sum (N dI/du)^2 / (N I + b): the Cramer-Rao bound.
    """
    variance = np.empty((2, len(view)))
    for rows, blur_px, (grid, image, *slopes) in shapes_of(view):
        scale = blur_px[:, None, None]
        pixels = n_e[rows, None, None] * image + noise_e2 * scale**2
        r = np.hypot(*grid)
        for axis, slope in enumerate(slopes):
            w = weight(grid[axis], r, image, slope, pixels)
            gain = n_e[rows] * (w * slope).sum(axis=(-2, -1))
            noise = (w**2 * pixels).sum(axis=(-2, -1))
            variance[axis, rows] = blur_px**2 * noise / (STEP * gain) ** 2
    return variance[0], variance[1]


def misshapen_px(view: View, context: Context) -> Floats | None:
    """(n, 2, 1) errors of fits by coma, and by charge that repels charge, each at its image's place in its pixel.

    The tracker's fit of a Gaussian to the expected images, means over rays through the pupil of Gaussians of the lens's
    variance. What it refuses keeps its center of light, which neither moves. A streak counts as a star of its peak.
    """
    camera = context.scene.camera
    moves = camera.psf.coma_px or camera.detector.brighter_fatter_per_e
    if context.settings.centroider == "cog" or not moves:
        return None
    at = view.xy_px @ COMPLEX
    place = at - np.rint(at)
    coma = camera.psf.coma_px / camera.corner_px * (at - camera.center_px @ COMPLEX)
    rays = place[:, None] + coma[:, None] * RAYS
    # The deviation with the peak of the image: erf(1 / (2 sqrt 2 lens))^2 is the share of the middle pixel.
    root_share = gauss(0.0) / view.sigma_px
    lens_px = 0.5 / special.ndtri((1 + root_share) / 2)[:, None, None]
    columns, rows = (
        np.diff(special.ndtr((EDGES_PX - part[..., None]) / lens_px))
        for part in (rays.real, rays.imag)
    )
    light_e = (view.peak_e - context.camera.background_e) / root_share**2
    # Their windows one below another, without sky.
    image_e = np.einsum("n,nki,nkj->nij", light_e / len(RAYS), rows, columns).reshape(
        -1, WINDOW_PX
    )
    repel(image_e, camera.detector)
    row_px = WINDOW_PX * np.arange(len(view))
    at_px = np.column_stack([place.real, place.imag + row_px]) + HALF_WINDOW_PX
    sky_e = np.zeros((2, 2))
    fitted = fit_all(
        image_e,
        at_px,
        light_e,
        np.zeros((len(view), 4), int),
        light_e,
        sky_e,
        sky_e + context.camera.noise_e * FILTERED_NOISE,
        1.0,
        np.inf,
    )
    return np.nan_to_num(fitted[:, :2] - at_px)[:, :, None]


def shapes_of(
    view: View, filter_px2: float = 0.0
) -> Iterator[tuple[Bools, Floats, tuple[Floats, ...]]]:
    """Lights with images of one shape: their mask (n,), the blur of each, filtered or not, and the shape."""
    large = np.maximum(view.disk_px, view.defocus_px)
    small = np.minimum(view.disk_px, view.defocus_px)
    blur_px = np.sqrt(view.blur2_px2 + filter_px2 + small**2 / 4)
    sizes = np.column_stack([view.streak_length_px, large]) / blur_px[:, None]
    keys = np.rint(SHAPES * np.log1p(sizes)).astype(int)
    for key in set(map(tuple, keys.tolist())):
        rows = (keys == key).all(axis=1)
        yield rows, blur_px[rows], image_shape(*key)


@lru_cache(maxsize=256)
def image_shape(length_key: int, radius_key: int) -> tuple[Floats, ...]:
    """The grid (2, U, V), and on it an image of unit volume and its derivatives (U, V) along and across its path.

    It is a segment, spread over a disk and blurred by a Gaussian of unit variance; the keys are SHAPES ln(1 + size).
    """
    length = max(math.expm1(length_key / SHAPES), 1e-3)
    radius = math.expm1(radius_key / SHAPES)
    k = np.arange(DISK_POINTS if radius else 1)
    at = (
        radius
        * np.sqrt((k + 0.5) / len(k))
        * np.stack([np.cos(GOLDEN_ANGLE_RAD * k), np.sin(GOLDEN_ANGLE_RAD * k)])
    )
    end = MARGIN + radius
    counts = (math.ceil(half / STEP) for half in (end + length / 2, end))
    u, v = (STEP * np.arange(-count, count + 1) for count in counts)
    du = u[:, None] - at[0]
    dv = v[:, None] - at[1]
    low = du - length / 2
    high = du + length / 2
    across = gauss(dv).T / len(k)
    along = (special.ndtr(high) - special.ndtr(low)) / length
    slope = (gauss(high) - gauss(low)) / length
    grid = np.array(np.meshgrid(u, v, indexing="ij"))
    return grid, along @ across, slope @ across, along @ (-dv.T * across)


def gauss(x: Floats | float) -> Floats:
    """The normal density."""
    return np.exp(-(x**2) / 2) / math.sqrt(2 * math.pi)


def timing_sigma_s(period_s: Floats, on_s: Floats, exposure_s: float) -> Floats:
    """(N,) standard deviation of the mean time of pulsed light within an exposure, over the phase of the pulses.

    The ends of the exposure cut the first and the last pulse, by an amount that depends on the phase.
    """
    # LEDs share few pairs of period and on-time.
    pairs, index = np.unique(np.column_stack([period_s, on_s]), axis=0, return_inverse=True)
    sigma = np.zeros(len(pairs))
    for k, (period, on) in enumerate(pairs):
        if on >= period or exposure_s / period >= MAX_PERIODS:
            continue
        begins_s = (np.arange(PHASES) + 0.5) / PHASES * period
        found = [lit_moments_s(0.0, exposure_s, period, begin_s, on) for begin_s in begins_s]
        means_s = [mean_s for lit_s, mean_s, _ in found if lit_s > 0]
        sigma[k] = np.std(means_s) if means_s else 0.0
    return sigma[index.ravel()]
