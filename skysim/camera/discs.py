"""Draw the Sun, the Moon and the planets: points, small discs of a few points, and large discs by convolution.

A large disc (`render_disc`) is a star's image convolved with a map of the disc's light:

1. A lattice of 1 / s pixels covers the disc. All its points with the same sub-pixel phase have the same image,
   displaced by whole pixels. s is chosen so that the rim's frequencies that the lattice folds back are those that the
   star's image does not pass (LATTICE).
2. `star_images` draws the star's image at each of the s^2 phases by the renderer, with lens, streak and shutter.
3. `light_on_lattice` maps the disc's light on the lattice, without what nearer bodies and the vehicle hide.
4. `convolved` adds the s^2 discrete convolutions of image and map at equal phase.
"""

import math
from collections.abc import Callable, Sequence
from typing import Any, NamedTuple

import numpy as np
import scipy

from skysim.camera.optics import Optics
from skysim.camera.projection import (
    Poses,
    image_tracks,
    in_view,
    poses,
    project,
    sample_times,
)
from skysim.camera.psf.kernel_cache import source_kernels
from skysim.camera.render import STEP, OcclusionTest, Window, draw, render
from skysim.core.types import (
    Array,
    Bools,
    Floats,
    Ints,
    Mount,
    Sources,
    SourceTruth,
    Trajectory,
    grid_points,
)
from skysim.sources.bodies import BodyLight
from skysim.sources.body_discs import disc_elements, lattice_light
from skysim.sources.dome.led import Emitter
from skysim.sources.stars import steady_points

# The image of a disc: a star's image convolved with a map of the disc's light.

# Largest spacing of the lattice, in units of the star image's sharpest feature (sigma).
LATTICE = 0.7
SUBSAMPLES = 2  # least number of samples across a point of the lattice
# Number of samples across a disc.
MIN_SAMPLES = 160
MAX_SAMPLES = 480
CRESCENT_SAMPLES = 4  # wanted across a crescent
ON_DISC = 1.2  # square of the radius within which a sample can have light
SMALL = 1e-3  # step, in units of the radius, by which the disc's scale on the chip is found


class Exposed(NamedTuple):
    """A camera during an exposure."""

    optics: Optics
    trajectory: Trajectory
    mount: Mount
    window: Window

    def few_poses(self) -> Poses:
        """FEW poses over the exposure, to find sources near the field."""
        t_s = np.linspace(self.window.open_s, self.window.close_s, FEW)
        return poses(self.trajectory, self.mount, t_s)


class DiscOnChip(NamedTuple):
    """Place and scale of a disc on the chip at mid-exposure.

    Attributes
    ----------
    center_px
        (2,) pixel coordinates (x, y) of the disc's center
    px_from_radius
        (2, 2) matrix from coordinates on the disc, in units of its radius, to pixels (x, y)
    """

    center_px: Floats
    px_from_radius: Floats


FEW = 9  # poses in an exposure at which a body is looked for in the field
Hidden = Callable[[Floats], Bools]  # which of (M, 2) points of a disc are hidden


def disc_on_chip(body: BodyLight, exposed: Exposed) -> DiscOnChip:
    """Project the disc's center and two points near it. Center and scale are NaN behind the camera."""
    xy = SMALL * np.array([[0.0, 0.0], [1.0, 0.0], [0.0, 1.0]])
    middle = poses(exposed.trajectory, exposed.mount, np.array([exposed.window.middle_s]))
    # Columns of the matrix by difference quotients.
    center, x, y = project(points_of(body, xy), exposed.optics, middle)[0][0]
    return DiscOnChip(center, np.column_stack([x - center, y - center]) / SMALL)


def points_of(body: BodyLight, xy: Floats, share: Floats | None = None) -> Any:
    """Points (M, 2) of a body's disc as Sources.

    Point m has the fraction share[m] of the body's light; without `share` each has all of it.
    """
    share = np.ones(len(xy)) if share is None else share
    ids = np.full(len(xy), body.id, np.int64)
    magnitude = np.full(len(xy), body.magnitude)
    colors = None if body.chromatic is None else np.tile(body.chromatic, (len(xy), 1))
    return steady_points(
        ids, body.directions(xy), share * body.flux_e_s_m2, magnitude, colors
    )


class DisplacedImages(NamedTuple):
    """Images of a point with all of the disc's light, at the disc's center and displaced by sub-pixel phases.

    Attributes
    ----------
    patches
        (s, s, h, w) electrons; patch (q, p) is displaced by q / s pixels down and p / s pixels right
    corner_px
        (2,) chip pixel (x, y) of a patch's first pixel
    speed_px_s
        (2,) velocity of the image at mid-exposure
    streak_px
        Path length of the image during the exposure
    """

    patches: Floats
    corner_px: Ints
    speed_px_s: Floats
    streak_px: float


def star_images(body: BodyLight, disc: DiscOnChip, exposed: Exposed) -> DisplacedImages:
    """Draw a point with all of the body's light at the disc's center and at s^2 sub-pixel phases from it.

    1. The number s of phases per pixel follows from the star image's sharpest feature.
    2. Project a point at each phase over the exposure.
    3. Draw each on a patch of its own; all patches have the size that the longest reach needs.
    """
    optics = exposed.optics
    window = exposed.window
    t_s = sample_times(window.open_s, window.close_s, exposed.trajectory)
    all_poses = poses(exposed.trajectory, exposed.mount, t_s)
    center = points_of(body, np.zeros((1, 2)))
    star = source_kernels(center, optics, disc.center_px[None], *np.ones((2, 1)))
    # 1. Phases (x, y) in pixels, x fastest.
    steps = math.ceil(1 / (LATTICE * float(star.sharp_px[0])))
    phase = np.arange(steps) / steps
    phase_px = grid_points(phase, phase)
    # 2. Their directions and tracks.
    points = points_of(body, phase_px @ np.linalg.inv(disc.px_from_radius).T)
    tracks, _, _ = image_tracks(points, optics, all_poses, t_s, Emitter())
    xy_px = tracks.xy_px
    middle = len(t_s) // 2
    kernels = source_kernels(points, optics, xy_px[middle], *np.ones((2, len(points))))
    # 3. One size of patch for all phases, in whole pixels of the chip.
    reach_px = kernels.reach_px.max() + 2
    low = np.floor(np.nanmin(xy_px, axis=(0, 1)) - reach_px).astype(np.int64)
    high = np.ceil(np.nanmax(xy_px, axis=(0, 1)) + reach_px).astype(np.int64)
    width, height = (high - low + 1).tolist()
    # The patches stand side by side in one strip, which `draw` takes for a chip.
    strip = np.zeros((height, len(points) * width))
    moved = (
        xy_px - low + width * np.column_stack([np.arange(len(points)), np.zeros(len(points))])
    )
    # The strip's first row is the chip's row low[1], which a rolling shutter exposes later.
    window = window._replace(open_s=window.open_s + low[1] * window.row_time_s)
    drawn = draw(
        strip, tracks._replace(xy_px=moved), kernels, STEP * kernels.sharp_px, window
    )
    patches = strip.reshape(height, steps, steps, width).transpose(1, 2, 0, 3)
    speed = (xy_px[middle + 1, 0] - xy_px[middle - 1, 0]) / (2 * tracks.step_s)
    return DisplacedImages(patches, low, speed, float(drawn[0, 5]))


def render_disc(
    image: Array, body: BodyLight, disc: DiscOnChip, exposed: Exposed, hidden: Hidden | None
) -> list[SourceTruth]:
    """Draw a large disc by the module's steps; return its truth, or an empty list if it misses the chip.

    In a rolling shutter a point d rows below the center is exposed d row_time later, when the image has moved by
    v row_time d: the map is sheared by the inverse of I - v row_time e_y^T. The rotation of the disc about its center
    during the exposure is neglected.
    """
    # 1. and 2. The star's image at the phases of the lattice.
    star = star_images(body, disc, exposed)
    # 3. The map of the light, on a lattice that the whole disc fits on.
    sheared = np.eye(2) - np.outer(star.speed_px_s * exposed.window.row_time_s, [0.0, 1.0])
    radius_from_px = np.asarray(np.linalg.inv(disc.px_from_radius) @ sheared, float)
    reach_px = math.ceil(float(np.linalg.norm(np.linalg.inv(radius_from_px), 2))) + 4
    light = light_on_lattice(body, radius_from_px, reach_px, len(star.patches), hidden)
    # 4. The convolution, also beyond the chip, begins that much up and left.
    electrons = convolved(light, star.patches)
    corner_px = star.corner_px - reach_px
    # The part that is on the chip.
    limit = np.array(image.shape[::-1])
    low = np.clip(corner_px, 0, limit)
    high = np.clip(corner_px + electrons.shape[::-1], 0, limit)
    (x0, y0), (x1, y1) = low - corner_px, high - corner_px
    own = electrons[y0:y1, x0:x1]
    if not own.size or own.max() <= 0:
        return []
    image[low[1] : high[1], low[0] : high[0]] += own
    # The displacement is that at the velocity of mid-exposure.
    streak_xy_px = star.speed_px_s * exposed.window.exposure_s
    return [whole(own, low, body, disc.center_px, star.streak_px, streak_xy_px)]


def convolved(light: Floats, patches: Floats) -> Floats:
    """The sum over phases (q, p) of the full convolutions of light[q::s, p::s] with patches[q, p].

    The Fourier transforms leave rounding errors where there is no light, of either sign. Negative values are set to
    zero: if only the disc's edge is on the chip, its total could be negative.
    """
    steps, _, height, width = patches.shape
    full = (len(light) // steps + height - 1, len(light) // steps + width - 1)
    shape = [scipy.fft.next_fast_len(size, real=True) for size in full]
    # (q, p, row, column): the lattice's points by their phase.
    by_phase = light.reshape(len(light) // steps, steps, -1, steps).transpose(1, 3, 0, 2)
    # Convolutions are products of spectra, which add before the one inverse transform.
    spectrum = (scipy.fft.rfft2(by_phase, shape) * scipy.fft.rfft2(patches, shape)).sum(
        axis=(0, 1)
    )
    return np.maximum(scipy.fft.irfft2(spectrum, shape)[: full[0], : full[1]], 0.0)


def light_on_lattice(
    body: BodyLight, radius_from_px: Floats, reach_px: int, steps: int, hidden: Hidden | None
) -> Floats:
    """Fractions of the disc's light on the lattice, (n, n) points from -reach_px to reach_px in both directions."""
    count = (2 * reach_px + 1) * steps
    radius_px = 1 / float(np.linalg.norm(radius_from_px, 2))
    # A crescent is 1 + cos(phase) wide in units of the radius.
    crescent = 1 + math.cos(body.place.phase_rad)
    samples = min(max(MIN_SAMPLES, 2 * CRESCENT_SAMPLES / max(crescent, 1e-9)), MAX_SAMPLES)
    # Enough samples across the disc and across its crescent.
    subsamples = max(SUBSAMPLES, math.ceil(samples / (2 * radius_px * steps)))
    fine = count * subsamples
    # The cells of points 0, 1/s, ... are centered on them.
    axis_px = (np.arange(fine) + 0.5) / (steps * subsamples) - 0.5 / steps - reach_px
    # What hides the disc is asked for samples that can have light alone.
    shown = np.ones((fine, fine)) if hidden else np.ones((0, 0))
    if hidden:
        xy = np.stack(np.meshgrid(axis_px, axis_px), axis=-1) @ radius_from_px.T
        on_disc = np.sum(xy**2, axis=2) < ON_DISC
        shown[on_disc] = ~hidden(xy[on_disc])
    return lattice_light(body.surface, count, subsamples, axis_px, radius_from_px, shown)


# A disc of a smaller diameter is a point: its image is wider by 0.006 px^2, or half a percent.
POINT_PX = 0.3
SMALL_PX = 4.0  # a disc of a smaller diameter is a few points
COARSE = 16  # places across a disc at which the vehicle is tested for hiding it


def render_bodies(
    image: Array,
    bodies: Sequence[BodyLight],
    exposed: Exposed,
    occluded: OcclusionTest | None = None,
) -> list[SourceTruth]:
    """Add the light of the bodies, farthest first, to the (H, W) image, in place.

    Returns the truth of each body in view. Lens, motion and shutter act on a disc as on a star (`render_disc`). Light
    that a nearer body hides is left out.
    """
    few_poses = exposed.few_poses()
    truths = []
    for n in in_view(centers_of(bodies), exposed.optics, few_poses).tolist():
        body = bodies[n]
        disc = disc_on_chip(body, exposed)
        # Behind the camera the scale is NaN; the body is then drawn as a point, which has no image.
        diameter_px = (
            2 * float(np.linalg.norm(disc.px_from_radius, 2))
            if np.isfinite(disc.center_px).all()
            else 0.0
        )
        # The bodies come farthest first, so those after it are nearer.
        nearer = bodies[n + 1 :]
        if diameter_px > SMALL_PX:
            points = hidden_points(body, nearer, occluded)
            truths += render_disc(image, body, disc, exposed, points)
        else:
            hidden = behind(nearer, occluded)
            truths += render_points(
                image, body, diameter_px > POINT_PX, exposed, hidden, disc.center_px
            )
    return truths


def centers_of(bodies: Sequence[BodyLight]) -> Sources:
    """The centers of bodies as points with all of their light, as Sources."""
    number = [(body.id, body.flux_e_s_m2, body.magnitude) for body in bodies]
    ids, flux_e_s_m2, magnitude = np.array(number, float).reshape(-1, 3).T
    directions = np.array([body.place.direction for body in bodies]).reshape(-1, 3)
    return steady_points(ids.astype(np.int64), directions, flux_e_s_m2, magnitude)


def render_points(
    image: Array,
    body: BodyLight,
    resolved: bool,
    exposed: Exposed,
    hidden: OcclusionTest | None,
    center_px: Floats,
) -> list[SourceTruth]:
    """Draw a small disc as a few points, or as one at the center of its light if it is not resolved."""
    elements = disc_elements(body.surface)
    if not resolved:
        elements = elements.merged()
    # The truth of a body is that of its points' light together, so it needs an image of its own.
    own = np.zeros_like(image) if resolved else image
    truth = render(own, points_of(body, *elements), *exposed, None, hidden)
    if not resolved or not len(truth.id):
        return [truth] if len(truth.id) else []
    image += own
    streak = (float(truth.streak_px.mean()), truth.streak_xy_px.mean(axis=0))
    return [whole(own, np.zeros(2, np.int64), body, center_px, *streak)]


def whole(
    own_e: Array,
    corner_px: Ints,
    body: BodyLight,
    center_px: Floats,
    streak_px: float,
    streak_xy_px: Floats,
) -> SourceTruth:
    """The truth of one body, as one row, from its own light on a part of the image that begins at corner_px (x, y)."""
    electrons = own_e.sum(dtype=float)
    y, x = np.unravel_index(np.argmax(own_e), own_e.shape)
    center = np.array(scipy.ndimage.center_of_mass(own_e.astype(float)))[::-1]
    return SourceTruth(
        id=np.array([body.id]),
        xy_px=center_px[None],
        flux_xy_px=(corner_px + center)[None],
        electrons=np.array([electrons]),
        peak_e=np.array([own_e[y, x]], float),
        streak_px=np.array([streak_px]),
        area_px=np.array([electrons**2 / np.sum(np.square(own_e, dtype=float))]),
        peak_xy=corner_px[None] + np.array([[x, y]]),
        saturated=np.zeros(1, bool),  # set by the detector
        snr=np.full(1, np.nan),
        streak_xy_px=streak_xy_px[None],
    )


def behind(
    bodies: Sequence[BodyLight], occluded: OcclusionTest | None
) -> OcclusionTest | None:
    """The test whether nearer bodies' discs or the vehicle hide a source; None if nothing can."""

    def hidden(place: Floats) -> Bools:
        by_discs = [body.hides(place[:, :3]) for body in bodies]
        return np.any([*by_discs, *([occluded(place)] if occluded else [])], axis=0)

    return hidden if bodies else occluded


def hidden_points(
    body: BodyLight, nearer: Sequence[BodyLight], occluded: OcclusionTest | None
) -> Hidden | None:
    """The test whether nearer bodies or the vehicle hide points (M, 2) of a disc; None if nothing does.

    The vehicle's test is slow, so it is made once, at COARSE places across the disc.
    """
    overlapping = [other for other in nearer if body.overlaps(other)]
    axis = (np.arange(COARSE) + 0.5) * (2 / COARSE) - 1
    coarse = grid_points(axis, axis)
    by_vehicle = (
        occluded(points_of(body, coarse).place) if occluded else np.zeros(len(coarse), bool)
    )

    def hidden(xy: Floats) -> Bools:
        column, row = np.clip(((xy + 1) * (COARSE / 2)).astype(int), 0, COARSE - 1).T
        directions = body.directions(xy)
        return np.any(
            [
                by_vehicle[row * COARSE + column],
                *(other.hides(directions) for other in overlapping),
            ],
            axis=0,
        )

    return hidden if overlapping or by_vehicle.any() else None
