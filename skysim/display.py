"""Stars on displays and at the ends of fibres: an LCD panel overhead, a collimated micro-display, an APL dome."""

from __future__ import annotations

import dataclasses
import datetime
from functools import lru_cache
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from skysim import lamp, light, sky
from skysim.background import look, view_of
from skysim.catalogue import Catalogue
from skysim.led import DRIVES, LOBES, Lamps, full_e_s_sr
from skysim.optics import Optics
from skysim.photometry import SUN, Band, star_flux_e_s_m2
from skysim.surface import Plane, surface
from skysim.types import BadInput, Floats, Sources

SHELL = 2  # the spawn key of the shell's own random stream: fibres keep their places when the radius varies

Ints = NDArray[np.int64]


def standing_off(part: lamp.Fibres, ends: Sources) -> Sources:
    """A stretched shell's radius varies: each fibre's end is off the surface along its normal, by v R.

    v is uniform in +-part.radius_variation, R the end's distance from the bearing; positive is outwards. To a camera
    r off the centre of a dome that it takes for a perfect one, an end is wrong by up to (r / R) v (JHU/APL's .4 % of
    4 ft, 50 mm off: 34"). Normals stay. The numbers come from part.points.hardware_seed.
    """
    rng = np.random.default_rng(np.random.SeedSequence(part.points.hardware_seed, spawn_key=(SHELL,)))
    place_m = ends.place[:, :3]
    share = part.radius_variation * rng.uniform(-1, 1, len(ends))
    off_m = share * np.linalg.norm(place_m, axis=1)
    moved = place_m - off_m[:, None] * ends.normal
    return dataclasses.replace(ends, place=np.column_stack([moved, ends.place[:, 3]]))


class Drawn(NamedTuple):
    """Stars on a display, M of them, as many as blocks are lit.

    star      : (M,) which of the stars wanted each is; where several fall on one block, the brightest of them
    corner_px : (M, 2) column and row of the block's first pixel
    middle_px : (M, 2) column and row of its middle, from the display's middle
    level     : (M,) the light that gets through above that of black, as a share of a white block's
    """

    star: Ints
    corner_px: Ints
    middle_px: Floats
    level: Floats


def drawn(part: lamp.Pixels, from_middle_m: Floats, level: Floats) -> Drawn:
    """Stars become blocks of pixels: places rounded to the nearest block that fits, levels to the nearest grey.

    from_middle_m : (N, 2) places on the display along its columns' and its rows' direction
    level         : (N,) share of white; stars on one block add up, to white
    Rounding to a pitch p is an error uniform over p, p / sqrt(12) along each axis. A level of 0 is a star too faint
    for the greys.
    """
    pixels = np.array(part.pixels)
    wanted_px = from_middle_m / part.pitch_m + (pixels - 1) / 2 - (part.block - 1) / 2
    corner = np.clip(np.rint(wanted_px), 0, pixels - part.block).astype(np.int64)
    order = np.argsort(-level, kind="stable")
    _, first, block = np.unique(corner[order] @ [1, pixels[0]], return_index=True, return_inverse=True)
    together = np.minimum(np.bincount(block, level[order], len(first)), 1.0)
    star = order[first]
    middle_px = corner[star] + (part.block - 1) / 2 - (pixels - 1) / 2
    return Drawn(star, corner[star], middle_px, grey(part, together) * (1 - black(part)))


def black(part: lamp.Pixels) -> float:
    """What a black pixel lets through, as a share of white."""
    return 1 / part.contrast if part.contrast else 0.0


def grey(part: lamp.Pixels, level: Floats) -> Floats:
    """(N,) transmission of the nearest of the display's greys: (g / (G - 1))^gamma, g rounded from level^(1 / gamma).

    The nearest in g, as a program does that writes a picture: steps are fine for the faint.
    """
    top = part.grey_levels - 1
    return np.asarray((np.rint(top * level ** (1 / part.gamma)) / top) ** part.gamma)


def faintest(part: lamp.Pixels) -> float:
    """Levels below it are black: half a step of grey."""
    return float((0.5 / (part.grey_levels - 1)) ** part.gamma)


def glass(part: lamp.Lcd, inside: Any) -> Plane:
    """The panel as a surface: the flat one, which ends where the pixels do.

    Raises BadInput for pixels that the surface, which has a width and a height of its own, has no room for.
    """
    assert isinstance(inside, Plane)  # light.Dome lets no other through
    half_m = np.array(part.pixels) * part.pitch_m / 2
    if np.any(half_m > inside.half_m * (1 + 1e-9)):
        raise BadInput(
            f"light.layout.pixels: take {2 * half_m[0]:.4g} m by {2 * half_m[1]:.4g} m; allowed: the surface's"
            f" {2 * inside.half_m[0]:.4g} m by {2 * inside.half_m[1]:.4g} m"
        )
    return dataclasses.replace(inside, half_m=half_m)


def steady(led: lamp.Led) -> lamp.Led:
    """The same LED on direct current, each like the other: what a layout wants, before a panel draws it."""
    return led.model_copy(update={"drive": lamp.Direct(kind="direct"), "scatter": 0.0})


def on_panel(part: lamp.Lcd, panel: Plane, led: lamp.Led, band: Band, wanted: Sources) -> Sources:
    """Stars on an LCD panel, each a block of n x n equal pixels: n^2 times a pixel's light from n times its width.

    wanted : the stars as LEDs that shine all the time, anywhere on the panel (or near it, and they are put onto it)
    Places and greys as `drawn`; a disc of the block's area stands for it, numbers are those of the stars.
    Raises BadInput for a star that is nearer to black than to the first grey.
    """
    own_m = panel.lab_from_own.inv().apply(wanted.place[:, :3] - panel.centre_m)
    level = wanted.strength / full_e_s_sr(led, band)
    show = drawn(part, own_m[:, :2], level)
    if not np.all(show.level > 0):
        raise BadInput(
            f"light.layout.points: a star of level {level.min():.2g} is black on {part.grey_levels} grey levels;"
            f" allowed: {faintest(part):.2g} or more"
        )
    rng = np.random.default_rng(part.points.hardware_seed)
    count = len(show.star)
    # Each pixel has its own share in the scatter; a block's is that of the mean of n^2 of them.
    scatter = np.exp(led.scatter / part.block * rng.standard_normal(count))
    row = show.corner_px[:, 1] / part.pixels[1]
    pulses = DRIVES[led.drive.kind](led, Lamps(show.level, np.zeros(count, dtype=np.int64), row), rng)
    flat_m = np.column_stack([show.middle_px * part.pitch_m, np.zeros(count)])
    place_m = panel.centre_m + panel.lab_from_own.apply(flat_m)
    return Sources(
        id=wanted.id[show.star],
        place=np.column_stack([place_m, np.ones(count)]),
        normal=panel.inward(place_m),
        radius_m=np.full(count, part.block * led.disc_diameter_m / 2),
        strength=full_e_s_sr(led, band) * part.block**2 * scatter * pulses.strength,
        period_s=pulses.period_s,
        start_s=pulses.start_s,
        on_s=pulses.on_s,
        magnitude=wanted.magnitude[show.star],
    )


def lab_from_icrs(part: light.Bench) -> Rotation:
    """Where the bench has put the lab among the stars: its axis is the lab's +z, position angle roll the lab's -y."""
    return sky.cam_from_icrs(part.axis_ra_deg, part.axis_dec_deg, part.roll_deg)


def bench(part: light.Bench, stars: Catalogue, time: datetime.datetime, band: Band) -> Sources:
    """A collimator of focal length f sends a pixel (x, y) off its axis as a beam along (x, y, f), parallel in itself.

    time : UTC, whose apparent places are shown
    Returns Sources in lab axes: points at infinity, or, with part.conjugate_m = D, at D from the bearing's centre:
    a camera off it by r sees them shifted by r / D. Strength is that of a star of part.brightest_mag and the Sun's
    colour, times `grey`; magnitude is the catalogue's. Pixels are not resolved.
    Raises BadInput for no star in the field, and for one that is nearer to black than to the first grey.
    """
    stars = stars.take(stars.v_mag <= part.limit_mag)
    direction = lab_from_icrs(part).apply(sky.apparent(stars, time)) if len(stars) else np.zeros((0, 3))
    above = direction[:, 2] > 0
    stars, direction = stars.take(above), direction[above]
    on_display_m = direction[:, :2] / direction[:, 2:] * part.focal_length_m
    half_m = np.array(part.pixels) * part.pitch_m / 2
    within = np.all(np.abs(on_display_m) <= half_m, axis=1)
    stars, on_display_m = stars.take(within), on_display_m[within]
    if not len(stars):
        raise BadInput("light.limit_mag: no star on the display is so bright; allowed: a fainter limit")
    level = np.minimum(10 ** (-0.4 * (stars.v_mag - part.brightest_mag)), 1.0)
    show = drawn(part, on_display_m, level)
    if not np.all(show.level > 0):
        darkest_mag = part.brightest_mag - 2.5 * np.log10(faintest(part))
        raise BadInput(
            f"light.limit_mag: stars of V {stars.v_mag.max():.3g} are black on {part.grey_levels} grey levels;"
            f" allowed: to {darkest_mag:.3g}"
        )
    beam = np.column_stack([show.middle_px * part.pitch_m, np.full(len(show.star), part.focal_length_m)])
    white_e_s_m2 = float(star_flux_e_s_m2(part.brightest_mag, *SUN, band))
    return collimated(part, beam, white_e_s_m2 * show.level, stars.take(show.star))


def collimated(part: light.Bench, beam: Floats, flux_e_s_m2: Floats, stars: Catalogue) -> Sources:
    """Beams along (N, 3) as sources that always shine, at infinity or, where the collimator is off, at a distance."""
    direction = beam / np.linalg.norm(beam, axis=1, keepdims=True)
    zero, one = np.zeros(len(beam)), np.ones(len(beam))
    place, normal, strength = np.column_stack([direction, zero]), 0 * direction, flux_e_s_m2
    if part.conjugate_m is not None:
        place = np.column_stack([direction * part.conjugate_m, one])
        normal, strength = -direction, flux_e_s_m2 * part.conjugate_m**2
    return Sources(
        id=stars.hip,
        place=place,
        normal=normal,
        radius_m=zero,
        strength=strength,
        period_s=one,
        start_s=zero,
        on_s=one,
        magnitude=stars.v_mag,
    )


def black_glow(
    part: light.Dome | light.Stars | light.Bench,
    optics: Optics,
    cam_from_lab: Rotation,
    camera_m: Floats,
    band: Band,
) -> Floats | None:
    """(H, W) electrons s^-1 px^-1 of a display's black pixels, 1 / contrast of white; None where nothing glows so.

    camera_m : (3,) the entrance pupil in the lab
    A pixel of the chip sees the display or not, by its middle; so sharp an edge, the movement in an exposure and the
    rows' turns are left out.
    """
    screen = part.layout if isinstance(part, light.Dome) else part
    if not isinstance(screen, lamp.Pixels) or not screen.contrast:
        return None
    view = view_of(*look_of_all(optics), optics, cam_from_lab, band)
    if isinstance(part, light.Bench):
        white = bench_radiance_e_s_m2_sr(part, view.toward_lab, band)
    else:
        assert isinstance(part, light.Dome)  # the screen is its layout
        white = panel_radiance_e_s_m2_sr(part, view.toward_lab, camera_m, band)
    glow = black(screen) * white * view.gathered_m2_sr()
    return glow.reshape(optics.camera.height_px, optics.camera.width_px)


@lru_cache(maxsize=2)
def look_of_all(optics: Optics) -> tuple[Floats, Floats]:
    """Where every pixel of the chip looks, (H * W, 3) in camera axes, and its solid angle."""
    y, x = np.indices((optics.camera.height_px, optics.camera.width_px), dtype=float)
    return look(np.column_stack([x.ravel(), y.ravel()]), optics)


def panel_radiance_e_s_m2_sr(part: light.Dome, toward_lab: Floats, camera_m: Floats, band: Band) -> Floats:
    """(N,) radiance of a white panel, mean over a frame, towards the camera: L = I(theta) / (p^2 cos theta).

    0 along (N, 3) looks that miss it. p is the pitch, I a white pixel's intensity by the LED's lobe.
    """
    assert isinstance(part.layout, lamp.Lcd)
    panel = glass(part.layout, surface(part.surface))
    on_it = np.isfinite(panel.meet(camera_m, toward_lab)[:, 0])
    cos_emission = np.where(on_it, -toward_lab @ panel.inward(panel.centre_m[None])[0], 1.0)
    emitted = LOBES[part.led.lobe.kind](part.led.lobe, cos_emission) / cos_emission
    lit = part.led.drive.duty if isinstance(part.led.drive, lamp.Refresh) else 1.0
    return np.asarray(on_it * emitted * lit * full_e_s_sr(part.led, band) / part.layout.pitch_m**2)


def bench_radiance_e_s_m2_sr(part: light.Bench, toward_lab: Floats, band: Band) -> Floats:
    """(N,) radiance behind the collimator of a white display: each pixel's light from (p / f)^2 cos^3 of a steradian.

    0 along (N, 3) looks past it.
    """
    white_e_s_m2 = float(star_flux_e_s_m2(part.brightest_mag, *SUN, band)) / part.block**2
    up = np.maximum(toward_lab[:, 2], 1e-9)
    half = np.array(part.pixels) * part.pitch_m / 2 / part.focal_length_m
    within = np.all(np.abs(toward_lab[:, :2]) <= half * up[:, None], axis=1) & (toward_lab[:, 2] > 0)
    return np.asarray(within * white_e_s_m2 / ((part.pitch_m / part.focal_length_m) ** 2 * up**3))
