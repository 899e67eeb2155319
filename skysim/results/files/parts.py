"""The list of a dome's parts with their prices: quantities follow from the scene, prices from a table.

The rim at the end of the LED cap has the controllers. A pair of wires runs from there along the surface to every LED,
board or tape, as far as its place is from the rim on the surface's mean meridian; tape is joined at its LED next to the
rim. An LED with a drive of its own (`pwm`, or any with a code) takes a channel of a driver board; LEDs that a
controller lights one after another, or all the time, have a series resistor instead. On tape a code, levels or PWM take
tape with a driver chip at each LED.
"""

from __future__ import annotations

import csv
import io
import math
from collections.abc import Callable
from typing import NamedTuple
import numpy as np
from skysim.core.errors import InputError
from skysim.core.types import Floats, Sources
from skysim.results.files.prices import (SURVEY, Prices)
from skysim.scene.scene import Scene
from skysim.scene.sections.layouts import HOLES, LcdConfig, StringConfig
from skysim.scene.sections.leds import LedConfig, PwmConfig, SequentialConfig
from skysim.scene.sections.light import DomeConfig
from skysim.sources.dome.layouts.led_list import design_leds, max_tilt_deg
from skysim.sources.dome.layouts.placing import Ints
from skysim.sources.dome.layouts.string import (mean_meridian, wind)
from skysim.sources.dome.surface import cap_area_m2
from skysim.sources.dome.surface import (Surface, build_surface)
from skysim.sources.photometry import Band



SHELLS = {"cylinder": "shell_bent", "flat": "shell_flat"}  # all others are doubly curved
COLUMNS = ("part", "quantity", "unit", "price", "fixed", "sum", "what")

Quantities = dict[str, float]


class Line(NamedTuple):
    """A part that is bought: quantity in units, price of a unit, what is paid once, and both together."""

    part: str
    quantity: float
    unit: str
    price: float
    fixed: float
    sum: float
    what: str


class PartsList(NamedTuple):
    """The parts of a dome; the total is the sum of the lines, each rounded to a hundredth."""

    lines: list[Line]

    @property
    def total(self) -> float:
        """Sum of all lines."""
        return round(sum(line.sum for line in self.lines), 2)


class Design(NamedTuple):
    """A dome as designed: what the functions of this module count."""

    light: DomeConfig
    surface: Surface
    leds: Sources
    cap_deg: float

    def to_rim_m(self, place_m: Floats) -> Floats:
        """(N,) lengths along the surface from places to the cap's rim, on the mean meridian."""
        meridian = mean_meridian(self.surface, math.radians(self.cap_deg))
        tilt_rad = np.arctan2(np.hypot(place_m[:, 0], place_m[:, 1]), place_m[:, 2])
        return np.asarray(
            meridian.arc_m[-1] - np.interp(tilt_rad, meridian.tilt_rad, meridian.arc_m)
        )


def parts_list(scene: Scene, prices: Prices) -> PartsList:
    """The parts of a scene's dome. Raises InputError without a dome and for a part without a price."""
    lines = []
    for part, quantity in quantities(scene, prices).items():
        one = prices.of(part)
        bought = quantity if one.unit != "each" else float(math.ceil(quantity / one.serves))
        lines.append(
            Line(
                part,
                bought,
                one.unit,
                one.price,
                one.fixed,
                round(one.fixed + bought * one.price, 2),
                one.what,
            )
        )
    return PartsList(lines)


def quantities(scene: Scene, prices: Prices) -> Quantities:
    """How much of each part the scene's dome needs, in its unit; of electronics the LEDs or channels to be served."""
    design = build_design(scene)
    layout = design.light.layout
    leds = len(design.leds)
    shell = SHELLS.get(design.light.surface.kind, "shell")
    found: Quantities = (
        {}
        if isinstance(layout, LcdConfig)
        else {shell: cap_area_m2(design.surface, design.cap_deg)}
    )
    found |= MOUNTED.get(layout.kind, single_leds)(design)
    if not isinstance(layout, LcdConfig):
        found |= electronics(design) | {"power_supply": leds}
    if design.light.led.code and design.light.led.code.bit_time_s == "frame":
        found["trigger"] = 1
    survey = scene.tracker.survey
    if survey.instrument:
        found[f"{SURVEY}_{survey.instrument.kind}"] = leds
    elif survey.led_sigma_m:
        found[prices.survey(survey.led_sigma_m, leds)] = leds
    return found


def build_design(scene: Scene) -> Design:
    """The scene's dome as designed. Raises InputError without a dome."""
    light = scene.light
    if not isinstance(light, DomeConfig):
        raise InputError("light.kind", f"{light.kind} has no parts", "dome")
    surface = build_surface(light.surface)
    leds = design_leds(light, surface, Band.from_camera(scene.camera))
    return Design(light, surface, leds, max(light.layout.cap_deg, max_tilt_deg(leds.place[:, :3])))


def single_leds(design: Design) -> Quantities:
    """LEDs one by one, each in its hole."""
    count = len(design.leds)
    return {
        "led": count,
        "mounting_led": count,
        "wire": float(design.to_rim_m(design.leds.place[:, :3]).sum()),
    }


def boards(design: Design) -> Quantities:
    """Patch boards; a board's wire goes to its LED next to the rim."""
    length_m = nearest_m(design.to_rim_m(design.leds.place[:, :3]), design.leds.id // HOLES)
    count = len(length_m)
    return {
        "board": count,
        "led": len(design.leds),
        "mounting_board": count,
        "wire": float(length_m.sum()),
    }


def tape(design: Design) -> Quantities:
    """LED tape, cut between LEDs: a pitch of it for each, also for those that are covered."""
    layout = design.light.layout
    assert isinstance(layout, StringConfig)
    wound = wind(
        layout.model_copy(update={"pitch_error": 0.0, "glue_scatter_m": 0.0}), design.surface
    )
    length_m = layout.pitch_m * len(wound.place_m)
    kind = "tape_addressable" if is_addressable(design) else "tape"
    wire_m = nearest_m(design.to_rim_m(wound.place_m), wound.tape).sum()
    return {kind: length_m, "mounting_tape": length_m, "wire": float(wire_m)}


def fibers(design: Design) -> Quantities:
    """LEDs at the rim, each with a fiber to its hole."""
    count = len(design.leds)
    return {
        "led": count,
        "fiber": float(design.to_rim_m(design.leds.place[:, :3]).sum()),
        "mounting_led": count,
    }


def panel(design: Design) -> Quantities:
    """An LCD panel, with all that drives it."""
    return {"panel": 1}


MOUNTED: dict[str, Callable[[Design], Quantities]] = {
    "patch_boards": boards,
    "string": tape,
    "fibers": fibers,
    "lcd": panel,
}


def nearest_m(length_m: Floats, group: Ints) -> Floats:
    """The least length of each group, that of a negative one 0."""
    return np.array([length_m[group == one].min() for one in np.unique(group)]).clip(0)


def is_addressable(design: Design) -> bool:
    """Whether the LEDs of a tape need a driver each: they differ in brightness, or in time."""
    layout = design.light.layout
    led = design.light.led
    assert isinstance(layout, StringConfig)
    return led.code is not None or led.drive.kind != "direct" or len(set(layout.dimming)) > 1


def electronics(design: Design) -> Quantities:
    """What drives the LEDs: by the drive, the code and the layout."""
    led = design.light.led
    count = float(len(design.leds))
    if isinstance(design.light.layout, StringConfig):
        return {"tape_controller": count} if is_addressable(design) else {}
    if isinstance(led.drive, SequentialConfig):
        return {"resistor": count, "sequencer": len(np.unique(design.leds.clock))}
    if led.drive.kind == "direct" and led.code is None:
        return {"resistor": count}
    channels: Quantities = {"driver": count, "microcontroller": count}
    return channels | {"filter": count} if has_filter(led) else channels


def has_filter(led: LedConfig) -> bool:
    return isinstance(led.drive, PwmConfig) and led.drive.filter is not None


def to_csv(parts: PartsList, name: str) -> str:
    """The list as CSV, with the total in its last line."""
    text = io.StringIO()
    text.write(f"# Parts of {name}; the prices are those of the table that was given\n")
    writer = csv.writer(text, lineterminator="\n")
    writer.writerow(COLUMNS)
    writer.writerows(cells(line) for line in parts.lines)
    writer.writerow(["total", "", "", "", "", f"{parts.total:.2f}", ""])
    return text.getvalue()


def cells(line: Line) -> list[str]:
    """The cells of a line, by COLUMNS."""
    quantity = f"{line.quantity:.0f}" if line.unit == "each" else f"{line.quantity:.2f}"
    money = [f"{line.price:.2f}", f"{line.fixed:.2f}", f"{line.sum:.2f}"]
    return [line.part, quantity, line.unit, *money, line.what]


