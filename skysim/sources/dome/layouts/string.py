"""LED tape wound on the surface, and optical fibers in it.

Tapes are circles about the zenith, a spiral from the apex, or strips along meridians. A turn of the tape is the
projection of a curve of directions from the bearing, tilt over azimuth, on the surface. The distance of the turns is
measured along the surface's mean meridian (`Meridian`), the distance of two LEDs along the turn itself, by the lengths
of its chords at `STEPS_PER_PITCH` steps per LED and `STEPS_PER_TURN` per turn at least. The chords of a circle are too
short by (2 pi / STEPS_PER_TURN)^2 / 24 of their length, 3e-6.

1. The mean meridian of the surface (`mean_meridian`).
2. Curves of the tapes (`circles`, `spiral`, `strips`), with their lengths (`lay`).
3. An LED every pitch along each tape, with the errors of pitch and glue (`wind`, `aside`).
"""

import dataclasses
import math
from typing import NamedTuple

import numpy as np
from numpy.random import Generator
from scipy.spatial.transform import Rotation

from skysim.core.constants import ARCSEC_RAD
from skysim.core.errors import InputError
from skysim.core.random_streams import random_stream
from skysim.core.types import UP, Floats, Ints, Sources, lengths, normalized
from skysim.core.units import scaled_errors
from skysim.scene.sections.layouts import AimingConfig, FibersConfig, StringConfig
from skysim.sources.dome.layouts.placing import project_from_bearing
from skysim.sources.dome.surface import Surface, circle_rad, directions, perpendicular

STEPS_PER_TURN = 720
STEPS_PER_PITCH = 16
MAX_STEPS = 1_000_000  # of all turns
MERIDIAN_STEPS = 400
MERIDIANS = 36
TAPE_STREAM = 3  # spawn key of the errors of tapes, which leave levels and gaps unchanged
GLUE_M = 0.3  # length of tape over which its sideways error is correlated, assumed


class Meridian(NamedTuple):
    """The surface's mean meridian from the apex to the cap's rim, (K,) each.

    Attributes
    ----------
    tilt_rad
        Angles from the zenith, seen from the bearing
    arc_m
        Lengths along the surface from the apex, mean of the meridians
    ring_m
        Circumference of the circle of each tilt over 2 pi
    """

    tilt_rad: Floats
    arc_m: Floats
    ring_m: Floats


class Tape(NamedTuple):
    """A tape as laid.

    Attributes
    ----------
    tilt_rad, azimuth_rad
        (K,) directions along it, from the bearing
    length_m
        (K,) length of the tape from its beginning to each
    closed
        Whether it is a ring
    """

    tilt_rad: Floats
    azimuth_rad: Floats
    length_m: Floats
    closed: bool

    def rays(self, at_m: Floats) -> Floats:
        """(N, 3) unit vectors from the bearing to places along the tape."""
        tilt_rad = np.interp(at_m, self.length_m, self.tilt_rad)
        azimuth_rad = np.interp(at_m, self.length_m, self.azimuth_rad)
        return directions(tilt_rad, azimuth_rad)


class Wound(NamedTuple):
    """The LEDs of all tapes in order: (N, 3) places, (N,) number of the tape, and length from its first LED."""

    place_m: Floats
    tape: Ints
    tape_m: Floats


def string(config: StringConfig, surface: Surface, rng: Generator) -> Floats:
    """LEDs of tapes, one every pitch along the surface. Raises InputError for too long a tape."""
    return wind(config, surface).place_m


def wind(config: StringConfig, surface: Surface) -> Wound:
    """The LEDs of all tapes, as glued; an LED's number is its row. Raises InputError for too long a tape."""
    meridian = mean_meridian(surface, np.radians(config.cap_deg))
    tapes = WINDINGS[config.winding](config, surface, meridian)
    # A cap that is too small for a tape has one LED at the zenith.
    if not tapes:
        zenith_m = project_from_bearing(surface, UP[None])
        return Wound(zenith_m, np.zeros(1, np.int64), np.zeros(1))
    # As many as fit; on a ring the last has a pitch to the first.
    fit = [int(tape.length_m[-1] / config.pitch_m) for tape in tapes]
    counts = [max(n, 1) if tape.closed else n + 1 for n, tape in zip(fit, tapes, strict=True)]
    design_m = [config.pitch_m * np.arange(n, dtype=float) for n in counts]
    rng = random_stream(config.hardware_seed, TAPE_STREAM)
    stretch = 1 + scaled_errors(config.pitch_error, rng.standard_normal(len(tapes)))
    # The pitch errs by a factor for each tape, the glue sideways along it.
    place_m = []
    for tape, at_m, factor in zip(tapes, design_m, stretch, strict=True):
        sideways_m = scaled_errors(config.glue_scatter_m, wander(at_m, rng))
        place_m.append(aside(surface, tape, factor * at_m, sideways_m))
    number = np.repeat(np.arange(len(tapes)), counts)
    return Wound(np.concatenate(place_m), number, np.concatenate(design_m))


def wander(at_m: Floats, rng: Generator) -> Floats:
    """Standard normal numbers at increasing places of a tape, correlated by exp(-d / GLUE_M) (Gauss-Markov).

    x_n = rho x_(n-1) + sqrt(1 - rho^2) g_n, rho = exp(-(d_n - d_(n-1)) / GLUE_M).
    """
    normal = rng.standard_normal(len(at_m))
    kept = np.exp(-np.diff(at_m) / GLUE_M)
    for n, rho in enumerate(kept.tolist(), 1):
        normal[n] = rho * normal[n - 1] + np.sqrt(1 - rho**2) * normal[n]
    return normal


def aside(surface: Surface, tape: Tape, at_m: Floats, sideways_m: Floats) -> Floats:
    """(N, 3) places on the surface at (N,) lengths along a tape, displaced to its side by (N,) distances.

    Places beyond an end of the tape stay at the end.
    """
    place_m = project_from_bearing(surface, tape.rays(at_m))
    if not sideways_m.any():
        return place_m
    # The tape's direction by a central difference; the side is across it and the normal.
    step_m = 1e-4 * tape.length_m[-1]
    middle_m = np.clip(at_m, step_m, tape.length_m[-1] - step_m)
    along = tape.rays(middle_m + step_m) - tape.rays(middle_m - step_m)
    side = np.cross(surface.inward(place_m), along)
    moved = place_m + sideways_m[:, None] * side / lengths(side)[:, None]
    return project_from_bearing(surface, moved)


def mean_meridian(surface: Surface, half_rad: float) -> Meridian:
    """The surface's mean meridian over the cap. Raises InputError if the cap exceeds the surface."""
    tilt_rad = np.linspace(0, half_rad, MERIDIAN_STEPS + 1)
    azimuth_rad = circle_rad(MERIDIANS)
    rays = directions(tilt_rad[:, None], azimuth_rad)
    place_m = project_from_bearing(surface, rays)
    # Chords along the meridians and around the circles.
    step_m = lengths(np.diff(place_m, axis=0)).mean(axis=1)
    around_m = lengths(place_m - np.roll(place_m, 1, axis=1)).sum(axis=1)
    return Meridian(tilt_rad, np.append(0, np.cumsum(step_m)), around_m / (2 * np.pi))


def check_length(length_m: float, turns: float, config: StringConfig) -> None:
    """Raise InputError for a tape of this length that has too many steps."""
    steps = length_m / config.pitch_m * STEPS_PER_PITCH + turns * STEPS_PER_TURN
    if not steps <= MAX_STEPS:
        raise InputError(
            "light.layout.pitch",
            f"{length_m:.4g} m of tape with an LED every {config.pitch_m:g} m are {length_m / config.pitch_m:.0f}"
            f" LEDs in {turns:.0f} turns",
            f"up to {MAX_STEPS // STEPS_PER_PITCH}, a larger spacing or pitch",
        )


def circles(config: StringConfig, surface: Surface, meridian: Meridian) -> list[Tape]:
    """Tapes on circles of equal tilt, `spacing` apart on the mean meridian, each from azimuth 0."""
    arcs_m = np.arange(config.spacing_m / 2, meridian.arc_m[-1], config.spacing_m)
    length_m = 2 * np.pi * float(np.interp(arcs_m, meridian.arc_m, meridian.ring_m).sum())
    check_length(length_m, len(arcs_m), config)
    tapes = []
    for tilt_rad in np.interp(arcs_m, meridian.arc_m, meridian.tilt_rad):
        ring_m = float(np.interp(tilt_rad, meridian.tilt_rad, meridian.ring_m))
        steps = max(
            STEPS_PER_TURN, int(STEPS_PER_PITCH * 2 * np.pi * ring_m / config.pitch_m)
        )
        around_rad = np.linspace(0, 2 * np.pi, steps + 1)
        tapes.append(lay(surface, np.full(steps + 1, tilt_rad), around_rad, closed=True))
    return tapes


def spiral(config: StringConfig, surface: Surface, meridian: Meridian) -> list[Tape]:
    """One tape whose turns are `spacing` apart on the mean meridian: azimuth = 2 pi arc / spacing."""
    turns = float(meridian.arc_m[-1]) / config.spacing_m
    arc_m = np.linspace(0, meridian.arc_m[-1], int(20 * turns) + 1000)
    azimuth_rad = 2 * np.pi * arc_m / config.spacing_m
    # Length per radian of azimuth: around the circle, and down the meridian.
    ring_m = np.interp(arc_m, meridian.arc_m, meridian.ring_m)
    per_rad_m = np.hypot(ring_m, config.spacing_m / (2 * np.pi))
    check_length(float(np.trapezoid(per_rad_m, azimuth_rad)), turns, config)
    # Steps of equal length, and of equal azimuth near the apex, where the tape is most curved.
    per_rad = np.maximum(
        STEPS_PER_TURN / (2 * np.pi), STEPS_PER_PITCH * per_rad_m / config.pitch_m
    )
    steps = np.append(0, np.cumsum((per_rad[1:] + per_rad[:-1]) / 2 * np.diff(azimuth_rad)))
    fine_rad = np.interp(np.arange(int(steps[-1]) + 1), steps, azimuth_rad)
    tilt_rad = np.interp(arc_m, meridian.arc_m, meridian.tilt_rad)
    tilt_rad = np.interp(fine_rad, azimuth_rad, tilt_rad)
    return [lay(surface, tilt_rad, fine_rad)]


def strips(config: StringConfig, surface: Surface, meridian: Meridian) -> list[Tape]:
    """Straight tapes down the meridians, 4 2^m of them, so many that they are at most `spacing` apart at the rim.

    Every second one begins where all are half a spacing apart, half of the others where these are, and so on.
    """
    count = 4
    widest_m = np.maximum.accumulate(meridian.ring_m)
    while 2 * np.pi * widest_m[-1] > count * config.spacing_m:
        count *= 2
    check_length(count * float(meridian.arc_m[-1]), count, config)
    leds = float(meridian.arc_m[-1]) / config.pitch_m
    steps = max(STEPS_PER_TURN, int(STEPS_PER_PITCH * leds))
    tapes = []
    for number in range(count):
        # Number of strips in the coarsest set that contains this one; it begins where these are half a spacing apart.
        neighbors = count // math.gcd(number, count // 4)
        least_ring_m = neighbors * config.spacing_m / (4 * np.pi)
        first_rad = np.interp(least_ring_m, widest_m, meridian.tilt_rad)
        tilt_rad = np.linspace(first_rad, meridian.tilt_rad[-1], steps + 1)
        tapes.append(lay(surface, tilt_rad, np.full(steps + 1, 2 * np.pi * number / count)))
    return tapes


WINDINGS = {"latitude": circles, "spiral": spiral, "meridian": strips}


def lay(
    surface: Surface, tilt_rad: Floats, azimuth_rad: Floats, closed: bool = False
) -> Tape:
    """A tape along (K,) directions from the bearing, with its length along the surface to each."""
    place_m = project_from_bearing(surface, directions(tilt_rad, azimuth_rad))
    steps_m = lengths(np.diff(place_m, axis=0))
    return Tape(tilt_rad, azimuth_rad, np.append(0, np.cumsum(steps_m)), closed)


# Optical fibers in a shell (JHU/APL's dome): their ends at another layout's points, with the errors of making them.
# JHU/APL put a laser on the star tracker's mount, turned it to each star's direction and drilled where its spot was
# (Boone et al. 2005, as described by Padro 2012, section 2.6; the procedure is what Padro's section 5.2.2 recommends).
# So a hole errs by the laser's direction, and an error of the shell displaces it along the laser's line, where a
# camera at the laser's place does not see it. Without a laser the error of the shell displaces it along the surface's
# normal.


# Spawn key of the shell's own random stream, which leaves the fibers' places unchanged
SHELL_STREAM = 2
AIMING_STREAM = 5  # spawn key of the laser's errors


def displace_ends(config: FibersConfig, surface: Surface, fibers: Sources) -> Sources:
    """Displace each fiber's end by the errors of its hole and by v R, the radius error of a stretched shell.

    v is uniform in +-config.radius_variation, R the end's distance from the bearing; positive is outward, along the
    surface's normal, or with a laser along its line by v R / cos(incidence). If the error is along the line of sight
    from some place, a camera r off that place sees an end displaced by up to (r / R) v rad (JHU/APL's .4 % of 4 ft,
    50 mm off: 34"). Normals are those of the design. The random stream is that of config.points.hardware_seed.
    """
    seed = config.points.hardware_seed
    place_m = fibers.xyz
    drawn = random_stream(seed, SHELL_STREAM).uniform(-1, 1, len(fibers))
    fraction = config.radius_variation * drawn
    outward_m = fraction * lengths(place_m)
    if config.aiming is None:
        moved = place_m - outward_m[:, None] * fibers.normal
    else:
        rng = random_stream(seed, AIMING_STREAM)
        moved = marked_m(config.aiming, surface, place_m, outward_m, rng)
    return dataclasses.replace(fibers, place=np.column_stack([moved, fibers.place[:, 3]]))


def marked_m(
    config: AimingConfig,
    surface: Surface,
    place_m: Floats,
    outward_m: Floats,
    rng: Generator,
) -> Floats:
    """(N, 3) places of holes that a laser marks for designed places (N, 3) of a surface that is outward_m off there.

    1. From the laser at s toward p the line has the direction u = (p - s) / |p - s|. It is rotated by the mount's
       common error and by two angles across it.
    2. It meets the surface at q, and the real shell, e outward, at q + e / (n . u) u, with the outward normal n.
    3. The drill errs along two axes in the surface.

    So an angle a displaces a hole by D a across its line, with the distance D, and by D a / (n . u) along the surface
    in the plane of incidence.

    Raises
    ------
    InputError
        For a laser outside the dome, and for a line that passes below its rim.
    """
    laser_m = np.array(config.laser_m)
    if not surface.inside(laser_m):
        raise InputError(
            "light.layout.aiming.laser",
            f"{config.laser_m} m is outside of the dome",
            "inside",
        )
    # 1.
    sight_m = place_m - laser_m
    line = normalized(sight_m)
    common = (
        scaled_errors(config.orientation_sigma_arcsec, rng.standard_normal(3)) * ARCSEC_RAD
    )
    pointing = scaled_errors(
        config.pointing_sigma_arcsec, rng.standard_normal((len(line), 2))
    )
    line = line + along_two_axes(line, pointing * ARCSEC_RAD)
    line = Rotation.from_rotvec(common).apply(line)
    line = normalized(line)
    # 2.
    mark_m = surface.meet(laser_m, line)
    if np.isnan(mark_m).any():
        raise InputError(
            "light.layout.aiming",
            "the laser's line passes below the rim",
            "a smaller cap_deg",
        )
    normal = surface.inward(mark_m)
    mark_m += (-outward_m / np.sum(normal * line, axis=1))[:, None] * line
    # 3.
    drill_m = scaled_errors(config.drill_sigma_m, rng.standard_normal((len(line), 2)))
    return mark_m + along_two_axes(normal, drill_m)


def along_two_axes(unit: Floats, size: Floats) -> Floats:
    """(N, 3) vectors perpendicular to unit vectors (N, 3), with components (N, 2) along two axes across them."""
    first = perpendicular(unit)
    return size[:, :1] * first + size[:, 1:] * np.cross(unit, first)
