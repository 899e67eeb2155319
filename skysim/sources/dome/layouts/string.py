"""LED tape wound on the surface, in circles about the zenith or in a spiral from the apex.

A turn of the tape is the projection of a curve of directions from the bearing, tilt over azimuth, on the surface. The
distance of the turns is measured along the surface's mean meridian (`Meridian`), the distance of two LEDs along the
turn itself, by the lengths of its chords at `STEPS_PER_PITCH` steps per LED and `STEPS_PER_TURN` per turn at least.
The chords of a circle are too short by (2 pi / STEPS_PER_TURN)^2 / 24 of their length, 3e-6.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from skysim.core.errors import InputError
from skysim.core.types import Floats, Sources
from skysim.scene.sections.layouts import StringConfig
from skysim.scene.sections.leds import LedConfig
from skysim.sources.dome.layouts.placing import lit_sources, project_from_bearing
from skysim.sources.dome.shell.surface import Surface
from skysim.sources.photometry import Band

STEPS_PER_TURN = 720
STEPS_PER_PITCH = 16
MAX_STEPS = 1_000_000  # of all turns
MERIDIAN_STEPS, MERIDIANS = 400, 36


class Meridian(NamedTuple):
    """The surface's mean meridian from the apex to the cap's rim, (K,) each.

    tilt_rad : from the zenith, seen from the bearing
    arc_m    : length along the surface from the apex, mean of the meridians
    ring_m   : circumference of the circle of this tilt over 2 pi
    """

    tilt_rad: Floats
    arc_m: Floats
    ring_m: Floats


def string(config: StringConfig, surface: Surface, led: LedConfig, band: Band) -> Sources:
    """LEDs of a tape, one every pitch along the surface. Raises InputError for too long a tape."""
    return lit_sources(config, surface, winding_m(config, surface), led, band)


def winding_m(config: StringConfig, surface: Surface) -> Floats:
    """(N, 3) places of all LEDs of a tape, in its order; an LED's number is its row. Raises as `string` does."""
    meridian = mean_meridian(surface, np.radians(config.cap_deg))
    return {"latitude": circles, "spiral": spiral}[config.winding](config, surface, meridian)


def directions(tilt_rad: Floats, azimuth_rad: Floats) -> Floats:
    """(..., 3) unit vectors from the bearing."""
    ring = np.sin(tilt_rad)
    return np.stack([ring * np.cos(azimuth_rad), ring * np.sin(azimuth_rad), np.cos(tilt_rad)], axis=-1)


def mean_meridian(surface: Surface, half_rad: float) -> Meridian:
    """The surface's mean meridian over the cap. Raises InputError if the cap exceeds the surface."""
    tilt_rad = np.linspace(0, half_rad, MERIDIAN_STEPS + 1)
    azimuth_rad = np.arange(MERIDIANS) * (2 * np.pi / MERIDIANS)
    rays = directions(*np.meshgrid(tilt_rad, azimuth_rad, indexing="ij"))
    place_m = project_from_bearing(surface, rays.reshape(-1, 3)).reshape(rays.shape)
    step_m = np.linalg.norm(np.diff(place_m, axis=0), axis=2).mean(axis=1)
    around_m = np.linalg.norm(place_m - np.roll(place_m, 1, axis=1), axis=2).sum(axis=1)
    return Meridian(tilt_rad, np.append(0, np.cumsum(step_m)), around_m / (2 * np.pi))


def check_length(length_m: float, turns: float, config: StringConfig) -> None:
    """Raise InputError for a tape of this length that has too many steps."""
    steps = length_m / config.pitch_m * STEPS_PER_PITCH + turns * STEPS_PER_TURN
    if not steps <= MAX_STEPS:
        raise InputError(
            f"light.layout.pitch: {length_m:.4g} m of tape with an LED every {config.pitch_m:g} m are"
            f" {length_m / config.pitch_m:.0f} LEDs in {turns:.0f} turns; allowed: up to"
            f" {MAX_STEPS // STEPS_PER_PITCH}, a larger spacing or pitch"
        )


def circles(config: StringConfig, surface: Surface, meridian: Meridian) -> Floats:
    """(N, 3) places of LEDs on circles of equal tilt, each from azimuth 0 as many as fit."""
    arcs_m = np.arange(config.spacing_m / 2, meridian.arc_m[-1], config.spacing_m)
    check_length(2 * np.pi * float(np.interp(arcs_m, meridian.arc_m, meridian.ring_m).sum()), len(arcs_m), config)
    rows = []
    for tilt_rad in np.interp(arcs_m, meridian.arc_m, meridian.tilt_rad):
        ring_m = float(np.interp(tilt_rad, meridian.tilt_rad, meridian.ring_m))
        steps = max(STEPS_PER_TURN, int(STEPS_PER_PITCH * 2 * np.pi * ring_m / config.pitch_m))
        azimuth_rad = np.linspace(0, 2 * np.pi, steps + 1)
        tape_m = tape_length_m(surface, np.full(steps + 1, tilt_rad), azimuth_rad)
        leds_m = np.arange(max(int(tape_m[-1] / config.pitch_m), 1)) * config.pitch_m
        at_rad = np.interp(leds_m, tape_m, azimuth_rad)
        rows.append(project_from_bearing(surface, directions(np.full(len(at_rad), tilt_rad), at_rad)))
    return np.concatenate(rows) if rows else project_from_bearing(surface, np.array([[0.0, 0.0, 1.0]]))


def spiral(config: StringConfig, surface: Surface, meridian: Meridian) -> Floats:
    """(N, 3) places of LEDs on one tape whose turns are `spacing` apart on the mean meridian."""
    turns = float(meridian.arc_m[-1]) / config.spacing_m
    arc_m = np.linspace(0, meridian.arc_m[-1], int(20 * turns) + 1000)
    azimuth_rad = 2 * np.pi * arc_m / config.spacing_m
    per_rad_m = np.hypot(np.interp(arc_m, meridian.arc_m, meridian.ring_m), config.spacing_m / (2 * np.pi))
    check_length(float(np.trapezoid(per_rad_m, azimuth_rad)), turns, config)
    # Steps of equal length, and of equal azimuth near the apex, where the tape is most curved.
    per_rad = np.maximum(STEPS_PER_TURN / (2 * np.pi), STEPS_PER_PITCH * per_rad_m / config.pitch_m)
    steps = np.append(0, np.cumsum((per_rad[1:] + per_rad[:-1]) / 2 * np.diff(azimuth_rad)))
    fine_rad = np.interp(np.arange(int(steps[-1]) + 1), steps, azimuth_rad)
    tilt_rad = np.interp(fine_rad, azimuth_rad, np.interp(arc_m, meridian.arc_m, meridian.tilt_rad))
    tape_m = tape_length_m(surface, tilt_rad, fine_rad)
    leds_m = np.arange(int(tape_m[-1] / config.pitch_m) + 1) * config.pitch_m
    rays = directions(np.interp(leds_m, tape_m, tilt_rad), np.interp(leds_m, tape_m, fine_rad))
    return project_from_bearing(surface, rays)


def tape_length_m(surface: Surface, tilt_rad: Floats, azimuth_rad: Floats) -> Floats:
    """(K,) length of the tape from its beginning to each of K points, along the surface."""
    place_m = project_from_bearing(surface, directions(tilt_rad, azimuth_rad))
    return np.append(0, np.cumsum(np.linalg.norm(np.diff(place_m, axis=0), axis=1)))
