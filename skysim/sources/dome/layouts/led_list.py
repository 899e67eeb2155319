"""The list of a dome's LEDs for its builder, as a CSV file that `layout: {kind: listed, file: ...}` reads back."""

import math

import numpy as np

from skysim.core.types import Floats, Sources, azimuths_rad
from skysim.scene.sections.layouts import StringConfig
from skysim.scene.sections.light import DomeConfig
from skysim.sources.dome.display import ideal_led
from skysim.sources.dome.layouts.placing import tilts_rad
from skysim.sources.dome.layouts.registry import LAYOUTS
from skysim.sources.dome.layouts.string import wind
from skysim.sources.dome.led import full_strength_e_s_sr
from skysim.sources.dome.surface import Surface, build_surface
from skysim.sources.photometry import Band

# Errors of a layout as built, without which it is the design.
BUILT = {"glue_scatter_m": 0.0, "glue_tilt_deg": 0.0, "pitch_error": 0.0}
# Errors of a layout whose places a laser marks.
AIMED = {"aiming": None, "radius_variation": 0.0}
HEADER = """\
# LEDs of {name}: x_m, y_m, z_m from the center of the bearing in the lab (z up); azimuth from +x toward +y, and tilt
# from the zenith, seen from there; level: nominal brightness, 1 at the full drive{tape}.
"""
TAPE = "; tape: number of the\n# tape from the zenith; tape_m: from its first LED, along the surface"


def led_list(config: DomeConfig, band: Band, name: str) -> tuple[str, int]:
    """The LEDs of a dome as CSV, and the cap_deg, in whole degrees, of a listed layout that contains all of them.

    Columns are id, place, direction from the bearing and level; for tapes also the place along them. The level is that
    of the drive, without the scatter from LED to LED.
    """
    leds = design_leds(config, build_surface(config.surface), band)
    place_m = leds.xyz
    full = full_strength_e_s_sr(ideal_led(config.led), band)
    level = leds.strength / max(full, float(leds.strength.max()))
    azimuth_deg = np.degrees(azimuths_rad(place_m)) % 360
    tilt_deg = np.degrees(tilts_rad(place_m))
    columns = {"id": [f"{number}" for number in leds.id]}
    for n, axis in enumerate("xyz"):
        columns[f"{axis}_m"] = [f"{value:.12f}" for value in place_m[:, n]]
    columns["azimuth_deg"] = [f"{value:.6f}" for value in azimuth_deg]
    columns["tilt_deg"] = [f"{value:.6f}" for value in tilt_deg]
    # The tapes' own columns.
    if isinstance(config.layout, StringConfig):
        wound = wind(config.layout, build_surface(config.surface))
        columns |= {
            "tape": [f"{number}" for number in wound.tape[leds.id]],
            "tape_m": [f"{value:.6f}" for value in wound.tape_m[leds.id]],
        }
    columns["level"] = [f"{value:.9g}" for value in level]
    rows = [",".join(row) for row in zip(*columns.values(), strict=True)]
    header = HEADER.format(name=name, tape=TAPE if "tape" in columns else "")
    lines = [",".join(columns), *rows, ""]
    return header + "\n".join(lines), math.ceil(tilt_deg.max())


def design_leds(config: DomeConfig, surface: Surface, band: Band) -> Sources:
    """The LEDs of a dome as designed: without scatter, and without errors of glue, tape and laser."""
    errors = AIMED if getattr(config.layout, "aiming", None) else BUILT
    absent = {key: none for key, none in errors.items() if hasattr(config.layout, key)}
    layout = config.layout.with_values(**absent)
    return LAYOUTS[layout.kind](layout, surface, ideal_led(config.led), band)


def max_tilt_deg(place_m: Floats) -> float:
    """The greatest angle of places (N, 3) from the zenith, seen from the bearing."""
    return float(np.degrees(tilts_rad(place_m)).max())
