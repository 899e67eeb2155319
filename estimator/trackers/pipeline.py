"""Settings and processing stages common to all trackers: detection, centroiding, timing.

A frame passes through four stages, each a function named in `Settings`: detect (frame to blobs), centroid (blobs to
positions with errors), identify (positions to stars or LEDs) and solve (matches to an attitude). This module has the
first two (`detect_and_centroid`):

1. Check the frame: its shape, saturation, and bad pixels. A color camera's frame becomes a gray one.
2. Detect blobs, and drop those that cannot be stars (hot pixels, tracks, the Moon, texture) or touch the border.
3. Centroid them, with larger errors for saturated blobs and bad pixels.
4. Drop centroids that are too inaccurate to distinguish stars.
"""

from __future__ import annotations

import math
import time
from collections.abc import Callable, Iterable
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np
from numpy.typing import DTypeLike, NDArray

from estimator.attitude.rate import center_streak_px, image_paths
from estimator.centroiding.centroid import CENTROIDERS, known_streaks
from estimator.core import checks
from estimator.core.camera import Camera, check_frame
from estimator.core.checks import Allowed, Floats, Ints, Step, frozen
from estimator.core.errors import ImageError
from estimator.core.jit import compiled_s
from estimator.core.types import (
    THESIS_INTENSITY,
    Attitude,
    Blobs,
    Centroids,
    FramePriors,
    RateEstimate,
)
from estimator.detection import classify
from estimator.detection.background import cleaned
from estimator.detection.bayer import PATTERNS, gray_from_bayer
from estimator.detection.classify import Flag
from estimator.detection.detect import DETECTORS, in_row_order, replace_bad_pixels, to_native
from estimator.identification.solver_options import ACCEPTANCES

SATURATED = "the frame is saturated"
# Extra centroid error of a saturated blob, whose plateau has edges at whole pixels. Monte Carlo: 0.01 to 0.07 px, more
# with deeper saturation.
SATURATED_SIGMA_PX = 0.05
MAX_CENTROID_SIGMA_PX = 5.0  # less accurate centroids are dropped: they could match any star
# Extra error of a centroid on an interpolated bad pixel, from Monte Carlo.
BAD_PIXEL_SIGMA_PX = 0.06


SEARCHED_SIGMA_PX = 0.1  # floor of the errors in searches, where none is set
TINY = 1e-300
GREATEST = 1e300
POSITIVE = Allowed(TINY, GREATEST, "finite, above 0")
NOT_NEGATIVE = Allowed(0.0, GREATEST, "finite, 0 or more")
COUNT = Allowed(1, 1e9, "whole, 1 or more", True)
ALLOWED = {
    "threshold_sigma": POSITIVE,
    "min_area_px": COUNT,
    "max_blobs": COUNT,
    "intensity_threshold": Allowed(TINY, 1.0, "above 0, up to 1"),
    "gain_e_dn": Allowed(TINY, math.inf, "above 0; inf without photon noise"),
    "saturation": Allowed(TINY, math.inf, "above 0; inf if unknown"),
    "centroid_sigma_px": NOT_NEGATIVE._replace(optional=True),
    "base_stars": COUNT,
    "searched_stars": COUNT,
    "field_stars": POSITIVE,
    "merge_px": NOT_NEGATIVE,
    "magnitude_sigma": POSITIVE,
    "missed_dex": NOT_NEGATIVE,
    "reject": Allowed(0, int(max(Flag)) * 2 - 1, "bits of detection.classify.Flag", True),
    "zero_point_mag": Allowed(-100, 100, "-100 to 100, or None", optional=True),
    "cos_error": Allowed(1e-12, 0.1, "1e-12 to 0.1, or None", optional=True),
}


@frozen
class Settings:
    """Algorithm of each stage, and its parameters.

    Attributes
    ----------
    detector, centroider, identifier, solver
        Names of the algorithms
    threshold_sigma, min_area_px, max_blobs
        Parameters of the detector (`detection.detect`)
    intensity_threshold
        Threshold of the detector `thesis`, as a share of full scale
    gain_e_dn
        Gain in electrons per unit of the image
    saturation
        Least value of a saturated pixel; inf if unknown
    centroid_sigma_px
        Standard deviation added in quadrature to a centroid's error, for errors beyond its noise; None: estimated from
        each frame of stars (`trackers.misfit.with_floor`). The search then uses SEARCHED_SIGMA_PX
    base_stars
        Number of brightest blobs from which the published identifiers form patterns
    searched_stars
        Number of brightest blobs that the default identifier uses to find an attitude
    field_stars
        Mean number of catalog stars per field in the pattern index
    merge_px
        Catalog stars closer than this are merged into one
    zero_point_mag
        Magnitude of a source of flux 1; None if unknown: magnitudes are then not used
    magnitude_sigma
        Standard deviation of a star's magnitude, including the effect of its color
    missed_dex, acceptance
        Penalty of a missed star, and the rule by which a published identifier accepts a match: see
        `identification.solver_options`
    cos_error
        Tolerance of the cosine of an angle, for the identifier `shefex`; None: from the centroids' errors
    missed_dex
        Penalty of a missed star: see `identification.solver_options`
    assumed_deg
        Roll, pitch and yaw (3-2-1) of the vehicle by another sensor, for star identifiers under LEDs; None if unknown
    reject
        Flags of `detection.classify.Flag` that exclude a blob; NO_STAR, for photographs, also text and trees
    bad_px
        (K, 2) x and y of the sensor's bad pixels; None without a map
    bayer
        Filters of a color camera, a key of `detection.bayer.PATTERNS`; None for a monochrome one

    Raises
    ------
    ImageError
        For a number that cannot be used, and for an unknown keyword. The algorithms' names are
        checked by the tracker (`check_algorithms`): a dome has others than the sky.
    """

    detector: str = "default"
    centroider: str = "default"
    identifier: str = "default"
    solver: str = "default"
    threshold_sigma: float = 5.0
    min_area_px: int = 3
    max_blobs: int = 100
    intensity_threshold: float = THESIS_INTENSITY
    gain_e_dn: float = 1.0
    saturation: float = float("inf")
    centroid_sigma_px: float | None = None
    base_stars: int = 20
    searched_stars: int = 80
    field_stars: float = 30.0
    merge_px: float = 2.0
    zero_point_mag: float | None = None
    magnitude_sigma: float = 0.25
    missed_dex: float = 0.5
    acceptance: str = "evidence"
    cos_error: float | None = None
    assumed_deg: tuple[float, float, float] | None = None
    reject: int = int(Flag.HOT | Flag.TRACK | Flag.HUGE)
    bad_px: Ints | None = field(default=None, compare=False)
    bayer: str | None = None

    def __new__(cls, *args: Any, **named: Any) -> Settings:
        for name in named:
            checks.known("settings", name, cls.__dataclass_fields__)
        return object.__new__(cls)

    @property
    def searched_sigma_px(self) -> float:
        """The floor of the centroids' errors in searches and gates."""
        return SEARCHED_SIGMA_PX if self.centroid_sigma_px is None else self.centroid_sigma_px

    def __post_init__(self) -> None:
        checks.store_numbers(self, "settings: ", ALLOWED)
        checks.of_type("settings: acceptance", self.acceptance, str)
        checks.known("settings: acceptance", self.acceptance, ACCEPTANCES)
        if self.assumed_deg is not None:
            angles = checks.floats("settings: assumed_deg", self.assumed_deg, (3,))
            object.__setattr__(self, "assumed_deg", tuple(angles.tolist()))
        if self.bayer is not None:
            checks.of_type("settings: bayer", self.bayer, str)
            checks.known("settings: bayer", self.bayer, PATTERNS)
            if self.bad_px is not None:
                raise ImageError("settings: bad_px with bayer; allowed: one of the two")
        if self.bad_px is not None:
            bad = np.asarray(self.bad_px)
            if (
                bad.ndim != 2
                or bad.shape[1] != 2
                or (bad.size and bad.dtype.kind not in "iu")
            ):
                raise ImageError(
                    f"settings: bad_px has shape {bad.shape} of {bad.dtype}; allowed: (K, 2) whole numbers"
                )


def check_algorithms(
    settings: Settings, identifiers: Iterable[str], solvers: Iterable[str]
) -> None:
    """Raise ImageError for an unknown algorithm of a stage; identifiers and solvers are those of the tracker."""
    checks.of_type("settings", settings, Settings)
    stages: dict[str, Iterable[str]] = {
        "detector": DETECTORS,
        "centroider": CENTROIDERS,
        "identifier": identifiers,
        "solver": solvers,
    }
    for stage, names in stages.items():
        checks.known(f"settings: {stage}", getattr(settings, stage), names)


@dataclass(slots=True)
class Report:
    """Result of one frame: the attitude, the centroids, and the time of each stage in seconds."""

    attitude: Attitude
    centroids: Centroids
    seconds: dict[str, float] = field(default_factory=dict)


class Clock:
    """Stopwatch: accumulated seconds between laps, by name. It stands still while a function is compiled or loaded."""

    def __init__(self) -> None:
        self.seconds: dict[str, float] = {}
        self._last = time.perf_counter() - compiled_s()

    def lap(self, name: str) -> None:
        """Add the time since the last lap to a name's seconds."""
        now = time.perf_counter() - compiled_s()
        self.seconds[name] = self.seconds.get(name, 0.0) + now - self._last
        self._last = now


def detect_and_centroid(
    image: NDArray,
    camera: Camera,
    settings: Settings,
    clock: Clock,
    streak_px: Step | None = None,
    turn_rad: float = 0.0,
    exposure_s: float | None = None,
) -> Centroids:
    """Detect blobs and compute their centroids: the numbered steps of the module.

    Parameters
    ----------
    streak_px, turn_rad
        Streak and turn of FramePriors, from the gyro; None if unknown
    exposure_s
        Exposure time; None if unknown

    Raises
    ------
    ImageError
        For a frame of another shape than the camera's, or a saturated one.
    """
    # 1. Frame
    check_frame(image, camera)
    image = in_row_order(image)
    streak_px = checks.pixel_step("streak_px", streak_px)
    if np.isfinite(settings.saturation):
        sample = image[::37]  # every 37th row is enough to estimate the saturated fraction
        if np.count_nonzero(sample >= settings.saturation) > 0.5 * sample.size:
            raise ImageError(
                f"{SATURATED}: over half of its pixels are at {settings.saturation:g}"
            )
    if settings.bad_px is not None:
        image = replace_bad_pixels(image, settings.bad_px)
    image = monochrome(image, settings)
    # 2. Blobs
    priors = FramePriors(
        streak_px,
        settings.saturation,
        turn_rad,
        settings.intensity_threshold,
        settings.reject,
    )
    image, blobs = cleaned(
        DETECTORS[settings.detector],
        image,
        priors,
        settings.threshold_sigma,
        settings.min_area_px,
        settings.max_blobs,
    )
    stars = away_from_border(blobs.box_px, camera) & (blobs.flag & settings.reject == 0)
    if not stars.all():
        blobs = blobs.take(stars)
    clock.lap("detect")
    # 3. Centroids
    gain_e_dn = settings.gain_e_dn
    centroids = CENTROIDERS[settings.centroider](image, blobs, gain_e_dn, priors)
    paths = None
    # Without the time between rows an exposure of 1 s gives the rotation during it.
    if exposure_s or not camera.row_time_s:
        paths = image_paths(camera, centroids, exposure_s or 1.0)
    if paths is not None:
        streaks_px, light_px, ahead_px = paths
        centroids = known_streaks(
            image, blobs, centroids, (streaks_px, ahead_px), gain_e_dn, priors
        )
        centroids = replace(centroids, xy_px=centroids.xy_px - light_px - ahead_px)
    centroids = inflate_uncertainty(centroids, blobs, settings)
    if camera.row_time_s and streak_px is None and centroids.streak_px is None:
        # The rows of a frame are far apart in time, so that even a rough rate is needed to identify its lights.
        centroids = replace(centroids, moments_px2=classify.moments(to_native(image), blobs))
    clock.lap("centroid")
    # 4. Usable centroids
    sigma_px = centroids.sigma_px
    valid = (
        camera.contains(centroids.xy_px) & (sigma_px > 0) & (sigma_px < MAX_CENTROID_SIGMA_PX)
    )
    valid &= (centroids.flux > 0) & (centroids.flux < np.inf)
    return centroids if valid.all() else centroids.take(valid)


def monochrome(image: NDArray, settings: Settings) -> NDArray:
    """Return the gray image of a color camera's frame; the frame of a monochrome camera as it is."""
    if settings.bayer is None:
        return image
    return gray_from_bayer(image, settings.bayer, settings.saturation)


def inflate_uncertainty(centroids: Centroids, blobs: Blobs, settings: Settings) -> Centroids:
    """Return the centroids with larger errors for saturated blobs and for blobs that touch bad pixels."""
    extra = SATURATED_SIGMA_PX * (blobs.flag & int(Flag.SATURATED) != 0)
    if settings.bad_px is not None and len(blobs):
        bad_px = np.asarray(settings.bad_px)[:, None]
        inside = np.all(
            (bad_px >= blobs.box_px[:, :2] - 1) & (bad_px <= blobs.box_px[:, 2:] + 1), axis=2
        )
        extra = np.where(inside.any(axis=0), np.hypot(extra, BAD_PIXEL_SIGMA_PX), extra)
    if not extra.any():
        return centroids
    covariance_px2 = centroids.covariance_px2
    if covariance_px2 is not None:
        covariance_px2 = covariance_px2 + (extra**2)[:, None, None] * np.eye(2)
    return replace(
        centroids, sigma_px=np.hypot(centroids.sigma_px, extra), covariance_px2=covariance_px2
    )


class FrameTracker:
    """What the trackers do with a frame: detection and centroiding, then `solve_centroids` of each kind.

    Attributes
    ----------
    camera
        On-board calibration
    settings
        Algorithms of the stages, and their parameters
    solve_centroids
        Method that identifies and solves centroids
    """

    camera: Camera
    settings: Settings
    solve_centroids: Callable[..., Attitude]

    def solve(
        self,
        image: NDArray,
        streak_px: Step | None = None,
        rate: RateEstimate | None = None,
        exposure_s: float | None = None,
        **when: Any,
    ) -> Report:
        """Solve one frame. Raises ImageError for bad input; the status reports any other failure.

        Parameters
        ----------
        streak_px
            (dx, dy) by which lights move during the exposure, from the gyro; None: unknown, or from a rate of known
            sign and the exposure time, which also give the turn
        rate
            Rate of the camera, from the gyro; None: with a rolling shutter it is estimated from the frame
        exposure_s
            Exposure time, to estimate the rate from streaks; None if unknown
        when
            Time `t_s` and number `frame` of the frame, as far as `solve_centroids` of the tracker takes them
        """
        clock = Clock()
        turn_rad = 0.0
        if streak_px is None and rate and rate.sign_known and exposure_s is not None:
            streak_px = center_streak_px(self.camera, rate, exposure_s)
            turn_rad = -float(rate.rate_rad_s[2]) * exposure_s
        centroids = detect_and_centroid(
            image, self.camera, self.settings, clock, streak_px, turn_rad, exposure_s
        )
        attitude = self.solve_centroids(
            centroids, clock, rate=rate, exposure_s=exposure_s, **when
        )
        return Report(attitude, centroids, clock.seconds)

    def direction_sigma_rad(self, centroids: Centroids) -> Floats:
        """Return the (N,) standard deviation of a direction, rad, from the centroid's own error and the floor."""
        sigma_px = np.hypot(centroids.sigma_px, self.settings.searched_sigma_px)
        return sigma_px / self.camera.focal_px


def brightest(centroids: Centroids, settings: Settings) -> Centroids:
    """Return the brightest centroids, 2 * base_stars at most, for identification."""
    return centroids.take(np.arange(min(len(centroids), 2 * settings.base_stars)))


def away_from_border(box_px: NDArray, camera: Camera) -> NDArray:
    """Return (N,) whether a blob's box is inside the border; a blob cut off by the border has a biased centroid."""
    x0, y0, x1, y1 = box_px.T
    return (x0 > 0) & (y0 > 0) & (x1 < camera.width_px - 1) & (y1 < camera.height_px - 1)


# Compilation before the flight: frames of the tracker's own lights, drawn here, on which every stage runs once.
#
# numba compiles a function for the types of its first call, which takes seconds, and keeps the code on disk. The frames
# reach every compiled function of a tracker: round lights and streaks, dim and bright ones for both widths of the
# detector's sums, a square that no model fits, too few lights, and a mirrored sky, for which every search runs to its
# end.


SKY = 100.0
NOISE = 2.0
# Peaks of the brightest light: 12-bit pixels have narrower sums than 16-bit ones.
DIM = 1500.0
BRIGHT = 6000.0
SPOT_SIGMA_PX = 1.0
REACH_PX = 6
STREAK_PX = (7.0, 4.0)
MAX_SPOTS = 40


def loop_type(dtype: DTypeLike) -> np.dtype:
    """Return the type of pixels for which the loops are compiled: that of `to_native` for an image of this type."""
    try:
        return to_native(np.zeros((1, 1), dtype)).dtype
    except (TypeError, ImageError):
        raise ImageError(
            f"warm_up: dtype is {dtype!r}; allowed: the type of the frames' pixels, numbers"
        ) from None


def draw(
    camera: Camera, xy_px: Floats, peak: Floats, dtype: np.dtype, streak_px: Step = (0.0, 0.0)
) -> NDArray:
    """Return a frame with Gaussian spots over sky and noise.

    Parameters
    ----------
    xy_px, peak
        (N, 2) positions and (N,) peak light of the spots
    dtype
        Type of the pixels
    streak_px
        (dx, dy) along which each spot is smeared
    """
    image = np.random.Generator(np.random.PCG64(1)).normal(
        SKY, NOISE, (camera.height_px, camera.width_px)
    )
    steps = np.linspace(-0.5, 0.5, 1 + 2 * int(np.hypot(*streak_px)))[:, None] * np.array(
        streak_px
    )
    for middle_px, light in zip(xy_px, peak, strict=True):
        for x_px, y_px in middle_px + steps:
            left = max(int(x_px) - REACH_PX, 0)
            top = max(int(y_px) - REACH_PX, 0)
            part = image[top : int(y_px) + REACH_PX, left : int(x_px) + REACH_PX]
            across = np.arange(part.shape[1]) + left - x_px
            down = np.arange(part.shape[0]) + top - y_px
            squares = across**2 + down[:, None] ** 2
            part += light / np.sqrt(len(steps)) * np.exp(-squares / (2 * SPOT_SIGMA_PX**2))
    return image.astype(dtype)


def run_all_stages(
    camera: Camera,
    xy_px: Floats,
    light: Floats,
    dtype: DTypeLike,
    look: Callable[[NDArray, Step | None], object],
) -> None:
    """Call `look(image, streak_px)` on every kind of frame of lights at (N, 2) pixels with (N,) relative brightness."""
    kind = loop_type(dtype)
    spots = slice(0, MAX_SPOTS)
    xy_px = xy_px[spots]
    light = np.maximum(light[spots] / light.max(), 0.05)
    dim, bright = (draw(camera, xy_px, peak * light, kind) for peak in (DIM, BRIGHT))
    smeared = draw(camera, xy_px, DIM * light, kind, STREAK_PX)
    square = bright.copy()
    y = camera.height_px // 2
    x = camera.width_px // 2
    square[y - 5 : y + 5, x - 5 : x + 5] = BRIGHT
    few = draw(camera, xy_px[:2], DIM * light[:2], kind, STREAK_PX)
    mirrored = np.ascontiguousarray(dim[:, ::-1])
    two_skies = np.maximum(dim, mirrored)
    for image in (dim, bright, few, smeared, mirrored, two_skies):
        look(image, None)
    look(square, (0.0, 0.0))
    look(smeared, STREAK_PX)
