"""The image of a disc as a convolution of a star's image with a map of the disc's light.

A lattice of 1 / s pixels covers the disc. All its points with the same sub-pixel phase have the same image, displaced
by whole pixels, so the disc's image is the sum over s^2 phases of discrete convolutions: of the star's image at that
phase, as the renderer draws it with lens, streak and shutter, with the map of the light at the points of that phase.
s is chosen so that the rim's frequencies that the lattice folds back are those that the star's image does not pass.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy import fft

from skysim.camera.discs.lattice import lattice_light
from skysim.camera.optics import Optics
from skysim.camera.psf.kernel_cache import Kernels, source_kernels
from skysim.camera.render import STEP, Window, draw, image_tracks, poses, project, sample_times
from skysim.core.types import Floats, Mount, Trajectory
from skysim.sources.dome.led import Emitter
from skysim.sources.solar_system.bodies import BodyLight
from skysim.sources.stars import steady_points

LATTICE = (
    0.7  # largest spacing of the lattice, in units of the star image's sharpest feature (sigma)
)
SUBSAMPLES = 2  # least number of samples across a point of the lattice
# across a disc
MIN_SAMPLES = 160
MAX_SAMPLES = 480
CRESCENT_SAMPLES = 4  # wanted across a crescent
ON_DISC = 1.2  # square of the radius within which a sample can have light
SMALL = 1e-3  # of the radius: the step by which the disc's scale on the chip is found


class Exposed(NamedTuple):
    """A camera during an exposure."""

    optics: Optics
    trajectory: Trajectory
    mount: Mount
    window: Window


class DiscOnChip(NamedTuple):
    """Where a disc lies on the chip at mid-exposure.

    center_px       : (2,)
    px_from_radius  : (2, 2) pixels (x, y) from coordinates on the disc in units of its radius
    """

    center_px: Floats
    px_from_radius: Floats


Hidden = Callable[[Floats], NDArray[np.bool_]]  # which of (M, 2) points of a disc are hidden


def disc_on_chip(body: BodyLight, exposed: Exposed) -> DiscOnChip:
    """Project the disc's center and two points near it. Center and scale are NaN behind the camera."""
    window = exposed.window
    rows = exposed.optics.camera.height_px
    xy = SMALL * np.array([[0.0, 0.0], [1.0, 0.0], [0.0, 1.0]])
    middle = poses(exposed.trajectory, exposed.mount, np.array([window.middle_s(rows)]))
    center, x, y = project(points_of(body, xy), exposed.optics, middle)[0][0]
    return DiscOnChip(center, np.column_stack([x - center, y - center]) / SMALL)


def points_of(body: BodyLight, xy: Floats, share: Floats | None = None) -> Any:
    """Points (M, 2) of a body's disc as Sources with (M,) shares of its light, all of it each if left out."""
    share = np.ones(len(xy)) if share is None else share
    ids = np.full(len(xy), body.id, np.int64)
    magnitude = np.full(len(xy), body.magnitude)
    colors = None if body.chromatic is None else np.tile(body.chromatic, (len(xy), 1))
    return steady_points(ids, body.directions(xy), share * body.flux_e_s_m2, magnitude, colors)


class StarImages(NamedTuple):
    """A point of the disc's full light at its center and displaced by sub-pixel phases.

    patches   : (s, s, h, w) electrons, at phases (q / s, p / s) pixels down and right
    corner_px : (2,) chip's pixel (x, y) of a patch's first one
    speed_px_s: (2,) velocity of the image at mid-exposure
    streak_px : path length
    """

    patches: Floats
    corner_px: NDArray[np.int64]
    speed_px_s: Floats
    streak_px: float


def star_images(body: BodyLight, disc: DiscOnChip, exposed: Exposed) -> StarImages:
    """Draw a point with all of the body's light at the disc's center and at s^2 sub-pixel phases from it."""
    optics = exposed.optics
    camera = exposed.optics.camera
    t_s = sample_times(
        exposed.window.open_s, exposed.window.close_s(camera.height_px), exposed.trajectory
    )
    all_poses = poses(exposed.trajectory, exposed.mount, t_s)
    star = star_kernel(optics, disc.center_px, body.chromatic)
    steps = math.ceil(1 / (LATTICE * float(star.sharp_px[0])))
    phase_px = np.stack(np.meshgrid(*2 * (np.arange(steps) / steps,)), axis=-1).reshape(
        -1, 2
    )  # x fastest
    points = points_of(body, phase_px @ np.linalg.inv(disc.px_from_radius).T)
    tracks, distance_m, cos_in = image_tracks(points, optics, all_poses, t_s, Emitter())
    xy_px = tracks.xy_px
    middle = len(t_s) // 2
    is_led = np.zeros(len(points), bool)
    blur_px = optics.blur_px
    kernels = source_kernels(
        camera,
        xy_px[middle],
        points.radius_m,
        is_led,
        distance_m,
        cos_in,
        None,
        blur_px,
        points.chromatic,
    )
    reach_px = kernels.reach_px.max() + 2
    low = np.floor(np.nanmin(xy_px, axis=(0, 1)) - reach_px).astype(np.int64)
    width, height = (
        np.ceil(np.nanmax(xy_px, axis=(0, 1)) + reach_px).astype(np.int64) - low + 1
    ).tolist()
    # Side by side in one strip, each in a patch of its own.
    strip = np.zeros((height, len(points) * width))
    moved = xy_px - low + width * np.column_stack([np.arange(len(points)), np.zeros(len(points))])
    window = exposed.window._replace(
        open_s=exposed.window.open_s + low[1] * exposed.window.row_time_s
    )
    drawn = draw(strip, tracks._replace(xy_px=moved), kernels, STEP * kernels.sharp_px, window)
    patches = strip.reshape(height, steps, steps, width).transpose(1, 2, 0, 3)
    speed = (xy_px[middle + 1, 0] - xy_px[middle - 1, 0]) / (2 * tracks.step_s)
    return StarImages(patches, low, speed, float(drawn[0, 5]))


def star_kernel(optics: Optics, xy_px: Floats, chromatic: Floats | None) -> Kernels:
    """The kernel of a point at a place on the chip; chromatic: (4,) of its light."""
    one = np.ones(1)
    is_led = np.zeros(1, bool)
    colors = None if chromatic is None else chromatic[None]
    return source_kernels(
        optics.camera, xy_px[None], 0 * one, is_led, one, one, None, optics.blur_px, colors
    )


class DiscImage(NamedTuple):
    """(h, w) electrons, the chip's pixel (x, y) of the first one, the path length, and the (2,) displacement at the
    speed of mid-exposure.
    """

    electrons: Floats
    corner_px: NDArray[np.int64]
    streak_px: float
    streak_xy_px: Floats


def disc_image(
    body: BodyLight, disc: DiscOnChip, exposed: Exposed, hidden: Hidden | None
) -> DiscImage:
    """The mean photo-electrons of a disc, also those beyond the chip.

    In a rolling shutter a point d below the center is exposed d rows later, and the image has moved by v row_time d
    more: the map is sheared by the inverse of I - v row_time e_y^T. The rotation of the disc about its center during
    the exposure is neglected.
    """
    star = star_images(body, disc, exposed)
    steps = len(star.patches)
    sheared = np.eye(2) - np.outer(star.speed_px_s * exposed.window.row_time_s, [0.0, 1.0])
    radius_from_px = np.asarray(np.linalg.inv(disc.px_from_radius) @ sheared, float)
    reach_px = math.ceil(float(np.linalg.norm(np.linalg.inv(radius_from_px), 2))) + 4
    light = light_on_lattice(body, radius_from_px, reach_px, steps, hidden)
    corner_px = star.corner_px - reach_px
    streak_xy_px = star.speed_px_s * exposed.window.exposure_s
    return DiscImage(convolved(light, star.patches), corner_px, star.streak_px, streak_xy_px)


def convolved(light: Floats, patches: Floats) -> Floats:
    """The sum over phases (q, p) of the convolutions of light[q::s, p::s] with patches[q, p], in full.

    The transforms round where there is no light; what falls below zero is cut, as a disc's edge alone may be on the
    chip, whose light would be negative.
    """
    steps, _, height, width = patches.shape
    full = (len(light) // steps + height - 1, len(light) // steps + width - 1)
    shape = [fft.next_fast_len(size, real=True) for size in full]
    by_phase = light.reshape(len(light) // steps, steps, -1, steps).transpose(1, 3, 0, 2)
    spectrum = (fft.rfft2(by_phase, shape) * fft.rfft2(patches, shape)).sum(axis=(0, 1))
    return np.maximum(fft.irfft2(spectrum, shape)[: full[0], : full[1]], 0.0)


def light_on_lattice(
    body: BodyLight, radius_from_px: Floats, reach_px: int, steps: int, hidden: Hidden | None
) -> Floats:
    """Shares of the light of the lattice's points, (n, n) from -reach_px to reach_px in both directions."""
    count = (2 * reach_px + 1) * steps
    radius_px = 1 / float(np.linalg.norm(radius_from_px, 2))
    crescent = 1 + math.cos(body.place.phase_rad)  # its width in units of the radius
    samples = min(max(MIN_SAMPLES, 2 * CRESCENT_SAMPLES / max(crescent, 1e-9)), MAX_SAMPLES)
    subsamples = max(SUBSAMPLES, math.ceil(samples / (2 * radius_px * steps)))
    fine = count * subsamples
    # The cells of points 0, 1/s, ... are centered on them.
    axis_px = (np.arange(fine) + 0.5) / (steps * subsamples) - 0.5 / steps - reach_px
    shown = np.ones((fine, fine)) if hidden else np.ones((0, 0))
    if hidden:
        xy = np.stack(np.meshgrid(axis_px, axis_px), axis=-1) @ radius_from_px.T
        on_disc = np.sum(xy**2, axis=2) < ON_DISC
        shown[on_disc] = ~hidden(xy[on_disc])
    return lattice_light(body.surface, count, subsamples, axis_px, radius_from_px, shown)
