"""The list of a dome's LEDs for its builder, as a CSV file that `layout: {kind: listed, file: ...}` reads back."""

from __future__ import annotations

import math

import numpy as np

from skysim.core.types import Floats, Sources
from skysim.scene.sections.layouts import StringConfig
from skysim.scene.sections.light import DomeConfig
from skysim.sources.dome.display import ideal_led
from skysim.sources.dome.layouts.placing import Ints
from skysim.sources.dome.layouts.registry import LAYOUTS
from skysim.sources.dome.layouts.string import winding_m
from skysim.sources.dome.led import full_strength_e_s_sr
from skysim.sources.dome.shell.surface import Surface, build_surface
from skysim.sources.photometry import Band

HEADER = """\
# LEDs of {name}: x_m, y_m, z_m from the center of the bearing in the lab (z up); azimuth from +x toward +y, and tilt
# from the zenith, seen from there; level: nominal brightness, 1 at the full drive{tape}.
"""
TAPE = "; tape: number of the\n# tape from the zenith; tape_m: from its first LED, along the surface"


def led_list(config: DomeConfig, band: Band, name: str) -> tuple[str, int]:
    """The LEDs of a dome as CSV, and the cap_deg, in whole degrees, of a listed layout that holds all of them.

    Columns are id, place, direction from the bearing and level; of tapes also the place along them. The level is that
    of the drive, without the scatter from LED to LED.
    """
    leds = design_leds(config, build_surface(config.surface), band)
    place_m = leds.place[:, :3]
    level = leds.strength / max(full_strength_e_s_sr(ideal_led(config.led), band), float(leds.strength.max()))
    azimuth_deg = np.degrees(np.arctan2(place_m[:, 1], place_m[:, 0])) % 360
    tilt_deg = np.degrees(np.arctan2(np.hypot(*place_m[:, :2].T), place_m[:, 2]))
    columns = {
        "id": [f"{number}" for number in leds.id],
        **{f"{axis}_m": [f"{value:.12f}" for value in place_m[:, n]] for n, axis in enumerate("xyz")},
        "azimuth_deg": [f"{value:.6f}" for value in azimuth_deg],
        "tilt_deg": [f"{value:.6f}" for value in tilt_deg],
    }
    if isinstance(config.layout, StringConfig):
        tape, tape_m = along_tape(config, config.layout, leds.id)
        columns |= {"tape": [f"{number}" for number in tape], "tape_m": [f"{value:.6f}" for value in tape_m]}
    columns["level"] = [f"{value:.9g}" for value in level]
    rows = [",".join(row) for row in zip(*columns.values(), strict=True)]
    header = HEADER.format(name=name, tape=TAPE if "tape" in columns else "")
    return header + "\n".join([",".join(columns), *rows, ""]), math.ceil(max_tilt_deg(place_m))


def design_leds(config: DomeConfig, surface: Surface, band: Band) -> Sources:
    """The LEDs of a dome without their scatter."""
    return LAYOUTS[config.layout.kind](config.layout, surface, ideal_led(config.led), band)


def max_tilt_deg(place_m: Floats) -> float:
    """Greatest angle of these places (N, 3) from the zenith, seen from the bearing."""
    return float(np.degrees(np.arctan2(np.hypot(*place_m[:, :2].T), place_m[:, 2])).max())


def along_tape(config: DomeConfig, layout: StringConfig, led: Ints) -> tuple[Ints, Floats]:
    """(N,) number of the tape, from 0, that bears each of these LEDs, and the LED's place along it, m.

    A spiral is one tape. Each circle is a tape whose first LED is at azimuth 0.
    """
    if layout.winding == "spiral":
        return np.zeros_like(led), np.asarray(led * layout.pitch_m)
    places_m = winding_m(layout, build_surface(config.surface))
    azimuth_rad = np.arctan2(places_m[:, 1], places_m[:, 0]) % (2 * np.pi)
    azimuth_rad[azimuth_rad > 2 * np.pi - 1e-9] = 0.0
    first = np.flatnonzero(np.append(True, np.diff(azimuth_rad) <= 0))
    tape = np.searchsorted(first, led, side="right").astype(np.int64) - 1
    return tape, np.asarray((led - first[tape]) * layout.pitch_m)
