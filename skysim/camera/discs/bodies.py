"""Draw the Sun, the Moon and the planets: points, small discs of a few points, and large discs by convolution."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import fields
from typing import Any

import numpy as np
from numpy.typing import NDArray

from skysim.camera.discs.disc_image import (
    DiscImage,
    Exposed,
    Hidden,
    disc_image,
    disc_on_chip,
    points_of,
)
from skysim.camera.render import OcclusionTest, in_view, poses, render
from skysim.core.types import Floats, Sources, SourceTruth
from skysim.sources.solar_system.bodies import BodyLight
from skysim.sources.solar_system.discs import disc_elements
from skysim.sources.stars import steady_points

POINT_PX = 0.3  # a disc of a smaller diameter is a point: its image is wider by 0.006 px^2, or half a percent
SMALL_PX = 4.0  # one of a smaller diameter is a few points
COARSE = 16  # places across a disc at which the vehicle is tested for hiding it
FEW = 9  # poses in an exposure at which a body is looked for in the field


def render_bodies(
    image: NDArray[Any],
    bodies: Sequence[BodyLight],
    exposed: Exposed,
    occluded: OcclusionTest | None = None,
) -> list[SourceTruth]:
    """Add the light of the bodies, farthest first, to the (H, W) image, in place; return the truth of each in view.

    Lens, motion and shutter act on a disc as on a star (see disc_image.py). What is behind a nearer body is left out.
    """
    window = exposed.window
    few_poses = poses(
        exposed.trajectory,
        exposed.mount,
        np.linspace(window.open_s, window.close_s(len(image)), FEW),
    )
    truths = []
    for n in in_view(centers_of(bodies), exposed.optics, few_poses).tolist():
        body = bodies[n]
        disc = disc_on_chip(body, exposed)
        diameter_px = (
            2 * float(np.linalg.norm(disc.px_from_radius, 2))
            if np.isfinite(disc.center_px).all()
            else 0.0
        )
        nearer = bodies[n + 1 :]
        if diameter_px > SMALL_PX:
            drawn = disc_image(body, disc, exposed, hidden_points(body, nearer, occluded))
            truths += add_disc(image, drawn, body, disc.center_px)
        else:
            hidden = behind(nearer, occluded)
            truths += render_points(
                image, body, diameter_px > POINT_PX, exposed, hidden, disc.center_px
            )
    return truths


def centers_of(bodies: Sequence[BodyLight]) -> Sources:
    """The centers of bodies as points with all of their light."""
    number = [(body.id, body.flux_e_s_m2, body.magnitude) for body in bodies]
    ids, flux_e_s_m2, magnitude = np.array(number, float).reshape(-1, 3).T
    directions = np.array([body.place.direction for body in bodies]).reshape(-1, 3)
    return steady_points(ids.astype(np.int64), directions, flux_e_s_m2, magnitude)


def render_points(
    image: NDArray[Any],
    body: BodyLight,
    resolved: bool,
    exposed: Exposed,
    hidden: OcclusionTest | None,
    center_px: Floats,
) -> list[SourceTruth]:
    """Draw a small disc as points, one at the center of its light if it is not resolved."""
    elements = disc_elements(body.surface)
    if not resolved:
        elements = elements.merged()
    own = np.zeros_like(image) if resolved else image
    truth = render(own, points_of(body, *elements), *exposed, None, hidden)
    if not resolved or not len(truth.id):
        return [truth] if len(truth.id) else []
    image += own
    streak = (float(truth.streak_px.mean()), truth.streak_xy_px.mean(axis=0))
    return [whole(own, np.zeros(2, np.int64), body, center_px, *streak)]


def add_disc(
    image: NDArray[Any], disc: DiscImage, body: BodyLight, center_px: Floats
) -> list[SourceTruth]:
    """Add a disc's image to the chip's; return its truth, none if it misses the chip."""
    size = np.array(disc.electrons.shape[::-1])
    limit = np.array(image.shape[::-1])
    low = np.clip(disc.corner_px, 0, limit)
    high = np.clip(disc.corner_px + size, 0, limit)
    (x0, y0), (x1, y1) = low - disc.corner_px, high - disc.corner_px
    own = disc.electrons[y0:y1, x0:x1]
    if not own.size or own.max() <= 0:
        return []
    image[low[1] : high[1], low[0] : high[0]] += own
    return [whole(own, low, body, center_px, disc.streak_px, disc.streak_xy_px)]


def whole(
    own_e: NDArray[Any],
    corner_px: NDArray[np.int64],
    body: BodyLight,
    center_px: Floats,
    streak_px: float,
    streak_xy_px: Floats,
) -> SourceTruth:
    """The truth of one body, a row, from its own light in a part of the image that begins at a corner (x, y)."""
    electrons = own_e.sum(dtype=float)
    y, x = np.unravel_index(np.argmax(own_e), own_e.shape)
    columns = own_e.sum(axis=0, dtype=float)
    rows = own_e.sum(axis=1, dtype=float)
    center = np.array([columns @ np.arange(len(columns)), rows @ np.arange(len(rows))]) / electrons
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


def behind(bodies: Sequence[BodyLight], occluded: OcclusionTest | None) -> OcclusionTest | None:
    """The test for sources that the discs of these bodies or anything else hide; None if nothing can."""

    def hidden(place: Floats) -> NDArray[np.bool_]:
        by_discs = [body.hides(place[:, :3]) for body in bodies]
        return np.any([*by_discs, *([occluded(place)] if occluded else [])], axis=0)

    return hidden if bodies else occluded


def hidden_points(
    body: BodyLight, nearer: Sequence[BodyLight], occluded: OcclusionTest | None
) -> Hidden | None:
    """The test for points (M, 2) of a disc that nearer bodies or the vehicle hide; None if nothing does.

    The vehicle is tested at COARSE places across the disc.
    """
    overlapping = [other for other in nearer if body.overlaps(other)]
    axis = (np.arange(COARSE) + 0.5) * (2 / COARSE) - 1
    coarse = np.stack(np.meshgrid(axis, axis), axis=-1).reshape(-1, 2)
    by_vehicle = (
        occluded(points_of(body, coarse).place) if occluded else np.zeros(len(coarse), bool)
    )

    def hidden(xy: Floats) -> NDArray[np.bool_]:
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


def concatenated(truths: Sequence[SourceTruth]) -> SourceTruth:
    """The rows of several truths, in their order."""
    if len(truths) == 1:
        return truths[0]
    names = [field.name for field in fields(SourceTruth)]
    return SourceTruth(
        **{name: np.concatenate([getattr(truth, name) for truth in truths]) for name in names}
    )
