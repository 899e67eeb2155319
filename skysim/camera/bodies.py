"""Draw the Sun, the Moon and the planets: points, or discs as many points, by the renderer of the stars."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import fields
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from skysim.camera.optics import Optics
from skysim.camera.psf.kernel_cache import source_kernels
from skysim.camera.render import STEP, OcclusionTest, Window, in_view, poses, project, render
from skysim.core.types import Floats, Mount, Sources, SourceTruth, Trajectory
from skysim.sources.solar_system.bodies import BodyLight
from skysim.sources.stars import steady_points

POINT_PX = 0.3  # a disc of a smaller diameter is a point: its image is wider by 0.006 px^2, or half a percent
MIN_ACROSS = 8  # least number of elements across a disc
FEW = 9  # poses in an exposure at which the bodies' places on the chip are found


def render_bodies(
    image: NDArray[Any],
    bodies: Sequence[BodyLight],
    optics: Optics,
    trajectory: Trajectory,
    mount: Mount,
    window: Window,
    occluded: OcclusionTest | None = None,
) -> list[SourceTruth]:
    """Add the light of the bodies, farthest first, to the (H, W) image, in place; return the truth of each in view.

    A disc is drawn as elements nearer to each other than the image is sharp (STEP, as along a streak), each a point of
    light, so that lens, motion and shutter act on it as on a star. Elements behind a nearer body's disc are left out.
    """
    few_poses = poses(trajectory, mount, np.linspace(window.open_s, window.close_s(len(image)), FEW))
    truths = []
    for n, body in enumerate(bodies):
        center = body_points(body, np.zeros((1, 2)), np.ones(1))
        if not len(in_view(center, optics, few_poses)):
            continue
        path_px, _, _, cos_field = project(center, optics, few_poses)
        size = image_size(body, optics, float(cos_field[FEW // 2, 0]))
        xy, share = body.elements(max(size.across, MIN_ACROSS))
        if not size.across:  # a point at the center of its light
            xy, share = (share @ xy)[None], np.array([share.sum()])
        points = body_points(body, xy, share)
        hidden = behind(bodies[n + 1 :], occluded)
        part = box(path_px[:, 0], size.reach_px, image.shape)
        before = image[part].copy()
        truth = render(image, points, optics, trajectory, mount, window, None, hidden)
        if size.across and len(truth.id):
            truth = whole_disc(truth, path_px[FEW // 2], image[part] - before, part)
        truths.append(truth)
    return truths


def behind(bodies: Sequence[BodyLight], occluded: OcclusionTest | None) -> OcclusionTest | None:
    """The test for sources that the discs of these bodies or anything else hide; None if nothing can."""

    def hidden(sources: Sources) -> NDArray[np.bool_]:
        by_discs = [body.hides(sources.place[:, :3]) for body in bodies]
        return np.any([*by_discs, *([occluded(sources)] if occluded else [])], axis=0)

    return hidden if bodies else occluded


def body_points(body: BodyLight, xy: Floats, share: Floats) -> Sources:
    """Points (M, 2) of a body's disc with (M,) shares of its light."""
    ids, magnitude = np.full(len(xy), body.id, np.int64), np.full(len(xy), body.magnitude)
    return steady_points(ids, body.directions(xy), share * body.flux_e_s_m2, magnitude)


class ImageSize(NamedTuple):
    """Elements across a disc's image, 0 for a point, and the reach of its light from its center in pixels."""

    across: int
    reach_px: float


def image_size(body: BodyLight, optics: Optics, cos_field: float) -> ImageSize:
    """How finely a disc must be drawn. The lens enlarges it by 1 / cos^2 of the field angle along the radius."""
    camera = optics.camera
    diameter_px = 2 * math.tan(body.radius_rad) * camera.focal_px / max(cos_field, 0.1) ** 2
    one = np.ones(1)
    star = source_kernels(camera, np.array([camera.center_px]), 0 * one, np.zeros(1, bool), one, one)
    across = math.ceil(diameter_px / (STEP * float(star.sharp_px[0]))) if diameter_px >= POINT_PX else 0
    return ImageSize(across, diameter_px / 2 + float(star.reach_px[0]))


def box(path_px: Floats, reach_px: float, shape: tuple[int, ...]) -> tuple[slice, slice]:
    """Rows and columns within reach of a path (K, 2) on the image; one pixel at least."""
    limit = np.array(shape[::-1])
    low = np.clip(np.floor(np.nanmin(path_px, axis=0) - reach_px), 0, limit - 1).astype(int)
    high = np.clip(np.ceil(np.nanmax(path_px, axis=0) + reach_px) + 1, low + 1, limit).astype(int)
    return slice(low[1], high[1]), slice(low[0], high[0])


def whole_disc(elements: SourceTruth, center_px: Floats, own_e: NDArray[Any], part: tuple[slice, slice]) -> SourceTruth:
    """The truth of a disc, one row, from that of its elements and its own light in a part of the image.

    center_px : (1, 2) the disc's center at mid-exposure
    """
    electrons = elements.electrons.sum()
    share = elements.electrons / electrons
    y, x = np.unravel_index(np.argmax(own_e), own_e.shape)
    return SourceTruth(
        id=elements.id[:1],
        xy_px=center_px,
        flux_xy_px=(share @ elements.flux_xy_px)[None],
        electrons=np.array([electrons]),
        peak_e=np.array([own_e[y, x]], float),
        streak_px=np.array([share @ elements.streak_px]),
        area_px=np.array([electrons**2 / np.sum(np.square(own_e, dtype=float))]),
        peak_xy=np.array([[part[1].start + x, part[0].start + y]]),
        saturated=np.zeros(1, bool),
        snr=np.full(1, np.nan),
    )


def concatenated(truths: Sequence[SourceTruth]) -> SourceTruth:
    """The rows of several truths, in their order."""
    names = [field.name for field in fields(SourceTruth)]
    return SourceTruth(**{name: np.concatenate([getattr(truth, name) for truth in truths]) for name in names})
