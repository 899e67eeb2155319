"""The likely cause of a refusal, with a remedy.

Causes are tested from the most certain to the vaguest. Two are tested by solving: a mirrored sky, and another field of
view. Such a solution only shows the cause; it is never the answer.

Other centroids of a refused picture: of its halves, without its clouds, of trails, and of binned pixels.

Trees, roofs and street lamps are at one side of a picture and may have more lights than there are stars; one half may
show only sky. Clouds and twilight vary within a tile of the detector's background, which takes this variation for
noise; a top-hat filter removes everything larger than stars. Noise breaks faint star trails into pieces; the streak
found in binned pixels joins them. Each retry counts as EXTRA_TRIES tries, so all retries together, twenty at most, add
no more than two hundredths to the accepted chance of a false match. They use the quick searches.
"""

import functools
import math
from collections.abc import Iterator
from dataclasses import dataclass, replace
from math import hypot
from typing import NamedTuple

import cv2
import numpy as np

from estimator.attitude.rate import covariance_of
from estimator.core.camera import Camera
from estimator.core.errors import ImageError
from estimator.core.types import Blobs, Centroids, FramePriors
from estimator.detection.background import estimate_background
from estimator.detection.classify import NO_STAR, streaks_px
from estimator.detection.detect import DETECTORS, to_native
from estimator.identification.chance import MIN_EVIDENCE_MATCHES
from estimator.trackers.pipeline import Clock, Settings, detect_and_centroid
from skysim.apps.plate_solver.solver import WIDEST_DEG, Solver, best_attitude, solve_centroids
from skysim.core.types import Array

# Expected numbers of stars in a field: hardly solvable below the first, safe above the second.
MIN_CATALOG_STARS = 6.0
ENOUGH_CATALOG_STARS = 15.0
# Stars of the Gaia catalogs of `skysim catalog build`: 45,709 to V 8, 130,337 to V 9, 357,037 to V 10, their limit.
GAIA_STARS = 45_709
GAIA_DEX_PER_MAG = 0.45
GAIA_LIMITS_MAG = (8, 9, 10)
OVEREXPOSED_SHARE = 0.3  # least fraction of pixels at the greatest value
# Number of brightest blobs whose shapes are compared; least number and fraction of them that have one shape.
SHAPED_BLOBS = 6
MIN_BLOBS = 3
SAME_SHARE = 0.5
# Least diameter of defocused stars (sharp ones have 4 to 10 px), and its greatest relative spread.
BLUR_PX = 14.0
SAME_SIZE = 0.3
FILLED = 0.6  # least fraction of its box that a defocused star fills; a disk fills 0.79
# Least length of a trail, and least ratio of its square to the area, which is 2.5 for a disk.
TRAIL_PX = 20.0
THIN = 6.0
SAME_ANGLE_RAD = 0.1  # greatest difference between the directions of parallel trails
TRAILS = "trails of {:.0f} px: a shorter exposure, a steadier camera, or a mount that tracks"
MIRRORED = "perhaps mirrored: it solves when flipped left to right; flip it, and solve that"
FEW_LIGHTS = 10
MIRROR_EFFORTS = 3  # searches of the mirrored picture, so that diagnosis is faster than the searches before it


@dataclass(frozen=True)
class Refusal:
    """A monochrome image that was refused: its centroids, and the solvers that were tried.

    Attributes
    ----------
    row_order_known
        Whether the row order is known; if not, both orders, and so the mirrored sky, were tried
    """

    image: Array
    centroids: Centroids
    solvers: tuple[Solver, ...]
    row_order_known: bool = True

    @property
    def size_px(self) -> tuple[int, int]:
        """Width and height."""
        return self.image.shape[1], self.image.shape[0]

    @property
    def can_be_tried(self) -> bool:
        """Whether there are enough lights for a solution."""
        return len(self.centroids) >= MIN_EVIDENCE_MATCHES

    @functools.cached_property
    def blobs(self) -> Blobs:
        """The blobs that the detector found, including those that cannot be stars."""
        settings = self.solvers[0].settings
        detect = DETECTORS[settings.detector]
        priors = FramePriors(None, settings.saturation)
        return detect(
            self.image,
            settings.threshold_sigma,
            settings.min_area_px,
            settings.max_blobs,
            priors,
        )


def likely_cause(refusal: Refusal) -> str:
    """The likeliest cause in one line, with a remedy."""
    text = next(text for cause in CAUSES if (text := cause(refusal)))
    camera = refusal.solvers[0].camera
    if camera and camera.dome:
        return f"LEDs of the dome of {camera.dome}? solve them with --dome {camera.dome}; of the sky: {text}"
    return text


def shallow_catalog(refusal: Refusal) -> str:
    """There are enough lights, but by the catalog's mean density few stars in the widest field that was tried."""
    solver = max(refusal.solvers, key=lambda one: one.tried_fov_deg(*refusal.size_px)[1])
    narrow_deg, wide_deg = solver.tried_fov_deg(*refusal.size_px)
    share = sphere_share(refusal.size_px, (narrow_deg + wide_deg) / 2)
    expected = len(solver.stars) * share
    if not solver.field_is_known or expected >= MIN_CATALOG_STARS or not refusal.can_be_tried:
        return ""
    return (
        f"the catalog is too shallow for this field: {expected:.1f} of its {len(solver.stars)} stars are expected"
        f" there; take {deeper_catalog(solver, share)}"
    )


def sphere_share(size_px: tuple[int, int], fov_deg: float) -> float:
    """Fraction of the sphere in an image with this horizontal field: the solid angle of a pyramid over 4 pi."""
    camera = Camera.from_fov(*size_px, math.radians(fov_deg))
    a, b = (side / 2 / camera.focal_px for side in size_px)
    return math.asin(a * b / math.sqrt((1 + a * a) * (1 + b * b))) / math.pi


def deeper_catalog(solver: Solver, share: float) -> str:
    """The remedy for a field that is this fraction of the sphere: the shallowest Gaia catalog with enough stars."""
    first = GAIA_LIMITS_MAG[0]
    last = GAIA_LIMITS_MAG[-1]
    for limit in GAIA_LIMITS_MAG:
        expected = GAIA_STARS * 10 ** (GAIA_DEX_PER_MAG * (limit - first)) * share
        if limit <= solver.stars.v_mag[-1] or expected < ENOUGH_CATALOG_STARS:
            continue
        if limit == first:
            return f"the catalog gaia_v{limit}.0"
        build = f"`skysim catalog build --source gaia --limit {limit}`"
        return f"the catalog gaia_v{limit}.0, after {build}"
    return f"a wider picture: the deepest catalog, to V {last}, has too few as well"


def mirrored(refusal: Refusal) -> str:
    """The picture is solved with its columns reversed; the centroids are reversed, not the image."""
    if not (refusal.can_be_tried and refusal.row_order_known):
        return ""
    flipped = reversed_columns(refusal.centroids, refusal.size_px[0])
    for solver in refusal.solvers:
        attitude, _ = solve_centroids(
            flipped, solver, refusal.size_px, Clock(), MIRROR_EFFORTS
        )
        if attitude.solved:
            return MIRRORED
    return ""


def reversed_columns(centroids: Centroids, width_px: int) -> Centroids:
    """The centroids of the image with its columns in reverse order."""
    xy_px = centroids.xy_px * [-1, 1] + [width_px - 1, 0]
    covariance_px2 = centroids.covariance_px2
    if covariance_px2 is not None:
        covariance_px2 = covariance_px2 * [[1, -1], [-1, 1]]
    return replace(centroids, xy_px=xy_px, covariance_px2=covariance_px2)


def other_field(refusal: Refusal) -> str:
    """The picture is solved, with little effort, with another field of view than those that were tried."""
    if not refusal.can_be_tried or not all(
        solver.field_is_known for solver in refusal.solvers
    ):
        return ""
    unknown = replace(refusal.solvers[0], fov_deg=None, camera=None)
    cameras = unknown.candidate_cameras(*refusal.size_px)
    trackers = unknown.trackers(*refusal.size_px)
    attitude, _ = best_attitude(refusal.centroids, trackers, Clock(), 0, len(cameras))
    if not attitude.solved:
        return ""
    assert attitude.camera is not None
    return f"perhaps another field of view: it solves with a field of {math.degrees(attitude.camera.fov_rad):.1f}°"


def overexposed(refusal: Refusal) -> str:
    """A large part of the image is at its greatest value."""
    brightest = refusal.image.max()
    share = np.count_nonzero(refusal.image == brightest) / refusal.image.size
    if share < OVEREXPOSED_SHARE:
        return ""
    return f"overexposed: {share:.0%} of the pixels are at {brightest:g}; a shorter exposure, or a darker sky"


def trailed(refusal: Refusal) -> str:
    """The brightest blobs are parallel lines: by the detector's streak, or as most of them are long for their area."""
    blobs = refusal.blobs
    if blobs.streak_px is not None:
        trails_px = streaks_px(blobs, refusal.image.shape, blobs.streak_px)
        return TRAILS.format(np.median(np.hypot(*trails_px.T)))
    sides_px, area_px = brightest_shapes(blobs)
    lengths_px = np.hypot(*sides_px.T)
    angle_rad = np.arctan2(*sides_px.T)
    lines = (lengths_px >= TRAIL_PX) & (lengths_px**2 >= THIN * area_px)
    if not lines.any():
        return ""
    lines &= np.abs(angle_rad - np.median(angle_rad[lines])) < SAME_ANGLE_RAD
    return TRAILS.format(np.median(lengths_px[lines])) if is_most(lines) else ""


def out_of_focus(refusal: Refusal) -> str:
    """The brightest blobs are large, filled, and of one size at any brightness."""
    sides_px, area_px = brightest_shapes(refusal.blobs)
    diameter_px = np.sqrt(4 / np.pi * area_px)
    large = (diameter_px >= BLUR_PX) & (area_px >= FILLED * sides_px.prod(axis=1))
    if not large.any():
        return ""
    typical_px = float(np.median(diameter_px[large]))
    large &= np.abs(diameter_px / typical_px - 1) < SAME_SIZE
    return f"blobs of {typical_px:.0f} px: out of focus?" if is_most(large) else ""


def brightest_shapes(blobs: Blobs) -> tuple[Array, Array]:
    """Width and height, (N, 2), and area, (N,), of the brightest blobs, in pixels."""
    box_px = blobs.box_px[:SHAPED_BLOBS]
    return box_px[:, 2:] - box_px[:, :2] + 1, blobs.area_px[:SHAPED_BLOBS]


def is_most(chosen: Array) -> bool:
    """Whether the chosen blobs are most of the brightest ones, and not too few."""
    return bool(np.count_nonzero(chosen) >= MIN_BLOBS and chosen.mean() >= SAME_SHARE)


def few_lights(refusal: Refusal) -> str:
    """There are few lights to identify."""
    count = len(refusal.centroids)
    if count >= FEW_LIGHTS:
        return ""
    return f"too few lights ({count}): a longer exposure or a higher gain, sharper focus; is it the night sky?"


def unknown_cause(refusal: Refusal) -> str:
    """No cause was found: advice on what may help."""
    solver = refusal.solvers[0]
    # `other_field` has tried another field.
    unknown = replace(solver, fov_deg=None, camera=None)
    narrow_deg = min(
        one.tried_fov_deg(*refusal.size_px)[0] for one in (unknown, *refusal.solvers)
    )
    text = (
        f"no cause found: no field of {narrow_deg:.1g}° to {WIDEST_DEG:g}° fits, nor the mirrored picture;"
        " are there trees, lamps or clouds? crop them away"
    )
    share = sphere_share(refusal.size_px, solver.tried_fov_deg(*refusal.size_px)[0])
    if len(solver.stars) * share >= ENOUGH_CATALOG_STARS:
        return text
    enough_deg = narrow_deg * math.sqrt(ENOUGH_CATALOG_STARS / (len(solver.stars) * share))
    field = (
        "or take "
        if solver.field_is_known
        else f"if the field is below {enough_deg:.1g}°, give it and take "
    )
    return f"{text}; {field}{deeper_catalog(solver, share)}"


CAUSES = (
    shallow_catalog,
    mirrored,
    other_field,
    overexposed,
    trailed,
    out_of_focus,
    few_lights,
    unknown_cause,
)


# Centroids of a picture whose stars are large: out of focus, or blurred by motion.


FACTORS = (8, 4, 2)  # sides of the binned squares; the most reduced picture is the fastest
MIN_SIDE_PX = 200  # least side of a binned picture
# Number of the brightest lights of the binned picture, and their least median area; a sharp star has 10 pixels.
BRIGHTEST = 12
MIN_AREA_PX = 30
MAX_SIGMA_PX = 20.0  # greatest error that `Centroids.check_values` allows


def large_lights(image: Array, settings: Settings) -> Iterator[tuple[int, Centroids]]:
    """The sides of the squares for which a picture's lights are large, and the centroids in pixels of the picture."""
    for factor in FACTORS:
        if min(image.shape) < factor * MIN_SIDE_PX:
            continue
        small = bin_pixels(image, factor)
        try:
            found = DETECTORS[settings.detector](
                small, settings.threshold_sigma, settings.min_area_px
            )
            area_px = found.area_px[found.flag & NO_STAR == 0][:BRIGHTEST]
            if not len(area_px) or np.median(area_px) < MIN_AREA_PX:
                continue
            yield factor, enlarged(centroids_of(small, settings), factor, settings)
        except ImageError:  # there are no lights, or thousands
            continue


def bin_pixels(image: Array, factor: int) -> Array[np.uint16]:
    """The means of squares of pixels, scaled to 16 bits; incomplete squares at the right and below are cut off."""
    height, width = (side // factor for side in image.shape)
    light = image[: height * factor, : width * factor].astype(np.float32)
    small = cv2.resize(light, (width, height), interpolation=cv2.INTER_AREA)
    low = float(small.min())
    high = float(small.max())
    return np.rint((small - low) * (65535 / max(high - low, 1e-30))).astype(np.uint16)


def enlarged(centroids: Centroids, factor: int, settings: Settings) -> Centroids:
    """Centroids of a binned picture in pixels of the original; the floor of their errors is in binned pixels."""
    floor_px = settings.searched_sigma_px
    out = replace(
        centroids,
        xy_px=factor * centroids.xy_px + (factor - 1) / 2,
        sigma_px=factor * np.hypot(centroids.sigma_px, floor_px),
        covariance_px2=factor**2 * (covariance_of(centroids) + floor_px**2 * np.eye(2)),
        streak_px=None,
        streak_covariance_px2=None,
    )
    return out.take(out.sigma_px < MAX_SIGMA_PX)


def centroids_of(
    pixels: Array, settings: Settings, streak_px: tuple[float, float] | None = None
) -> Centroids:
    """The centroids of a picture, along a streak if one is given."""
    # The detection uses only the camera's size.
    camera = Camera.from_fov(pixels.shape[1], pixels.shape[0], 1.0)
    return detect_and_centroid(pixels, camera, settings, Clock(), streak_px)


EXTRA_TRIES = 1000
MIN_LIGHTS = (
    10  # least lights of a half; fewer were searched in all combinations with the others
)
# Number of searches of a half, and of the upper half (the likeliest) and of other centroids.
EFFORTS = 1
MORE_EFFORTS = 2
UNEVEN = (
    2.0  # least ratio of the 90 % to the 10 % quantile of the noise of the background's tiles
)
TOPHAT_PX = 15  # width of the filter, more than that of a sharp star
# Sides of the binned squares. Trails shorter than MIN_TRAIL_PX are found without binning.
TRAIL_FACTORS = (3, 2, 4)
MIN_TRAIL_PX = 10.0
# Streak for sharp stars, because remains of the edges of trees are parallel, as streaks are.
ROUND = (0.0, 0.0)
FLAT_SIGMA_PX = (
    0.25  # least error of their centroids: JPEG has removed faint light beside clouds
)
FLAT = "its stars were found without its clouds"
HALF = "its stars were found in its {} half alone"
TRAILED = "its stars are trails, some too faint to be seen as one in single pixels"
BINNED = "its lights are large: they were found in the picture binned {0}x{0}"


class Retry(NamedTuple):
    """A note on what is tried, the number of searches, the centroids; `upper_half` as in `solver.Solver`."""

    note: str
    efforts: int
    centroids: Centroids
    upper_half: bool = False


def retries(pixels: Array, centroids: Centroids, settings: Settings) -> Iterator[Retry]:
    """Yield the retries of a picture; `centroids` are those of the refused attempt, in the unchanged picture."""
    yield from halves(pixels, centroids, "")
    flat = without_clouds(pixels, settings)
    if len(flat):
        yield Retry(FLAT, EFFORTS, flat)
        yield from halves(pixels, flat, f"{FLAT}, ")
    for trailed in trails(pixels, settings):
        yield Retry(TRAILED, MORE_EFFORTS, trailed)
    for factor, large in large_lights(pixels, settings):
        yield Retry(BINNED.format(factor), MORE_EFFORTS, large)


def halves(pixels: Array, centroids: Centroids, note: str) -> Iterator[Retry]:
    """The halves of a picture as retries; `note` is put before their own notes."""
    middle = (np.array(pixels.shape[::-1]) - 1) / 2
    right, low = (centroids.xy_px > middle).T
    for side, inside in (("upper", ~low), ("lower", low), ("left", ~right), ("right", right)):
        if MIN_LIGHTS <= np.count_nonzero(inside) < len(centroids):
            efforts = MORE_EFFORTS if side == "upper" else EFFORTS
            part = centroids.take(inside)
            yield Retry(note + HALF.format(side), efforts, part)
            if side == "upper":
                yield Retry(note + HALF.format(side), efforts, part, upper_half=True)


def trails(pixels: Array, settings: Settings) -> Iterator[Centroids]:
    """The centroids of star trails, detected along the streak that the picture's binned blobs share.

    Noise breaks a long faint trail into pieces. Most blobs then are pieces, and their common streak is too short. The
    mean of n^2 pixels has n times the signal-to-noise ratio, so the trail is one piece there. With its streak the
    detector adds up the light along each trail in the original pixels.
    """
    for factor in TRAIL_FACTORS:
        try:
            blobs = DETECTORS[settings.detector](
                bin_pixels(pixels, factor), settings.threshold_sigma
            )
            x, y = factor * np.array(blobs.streak_px or ROUND)
            if hypot(x, y) >= MIN_TRAIL_PX:
                yield centroids_of(pixels, settings, (x, y))
        except ImageError:
            continue


def without_clouds(pixels: Array, settings: Settings) -> Centroids:
    """The centroids of a picture from which all that is wider than stars is removed; none if its noise is uniform."""
    noise = estimate_background(to_native(pixels)).noise
    if np.quantile(noise, 0.9) < UNEVEN * np.quantile(noise, 0.1):
        return Centroids.empty()
    light = cv2.GaussianBlur(bin_pixels(pixels, 1), (0, 0), 0.5)
    flat = cv2.morphologyEx(
        light, cv2.MORPH_TOPHAT, np.ones((TOPHAT_PX, TOPHAT_PX), np.uint8)
    )
    try:
        # The edges of trees add about as many lights as there are stars.
        more = replace(settings, max_blobs=2 * settings.max_blobs)
        found = centroids_of(flat, more, ROUND)
        return replace(found, sigma_px=np.hypot(found.sigma_px, FLAT_SIGMA_PX))
    except ImageError:
        return Centroids.empty()
