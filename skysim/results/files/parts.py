"""The list of a dome's parts with their prices: quantities follow from the scene, prices from a table.

The rim at the end of the LED cap has the controllers. A pair of wires runs from there along the surface to every LED,
board or tape, as far as its place is from the rim on the surface's mean meridian; tape is joined at its LED next to the
rim. An LED with a drive of its own (`pwm`, or any with a code) takes a channel of a driver board; LEDs that a
controller lights one after another, or all the time, have a series resistor instead. On tape a code, levels or PWM take
tape with a driver chip at each LED.
"""

import csv
import io
import math
from pathlib import Path
from typing import NamedTuple

import numpy as np

from skysim.core.errors import InputError, Where
from skysim.core.paths import DATA
from skysim.core.text import excerpt, read_lines
from skysim.core.types import Floats, Ints
from skysim.core.yaml_reader import suggestion
from skysim.scene.scene import Scene
from skysim.scene.sections.layouts import HOLES, LcdConfig, PatchBoardsConfig, StringConfig
from skysim.scene.sections.leds import PwmConfig, SequentialConfig
from skysim.sources.dome.layouts.led_list import design_leds, max_tilt_deg
from skysim.sources.dome.layouts.placing import tilts_rad
from skysim.sources.dome.layouts.string import mean_meridian, wind
from skysim.sources.dome.surface import build_surface, cap_area_m2
from skysim.sources.photometry import Band

# Prices of a dome's parts: a CSV table that the user edits; the shipped one, `assumed`, is a guess
# throughout.


ASSUMED = "assumed"
SURVEY = "survey"  # a line whose part begins so is a way to survey the LEDs
UNITS = {
    **dict.fromkeys(("shell", "shell_bent", "shell_flat"), "m2"),
    **dict.fromkeys(
        (
            "led",
            "board",
            "panel",
            "mounting_led",
            "mounting_board",
            "resistor",
            "filter",
            "driver",
            "microcontroller",
            "sequencer",
            "tape_controller",
            "trigger",
            "power_supply",
        ),
        "each",
    ),
    **dict.fromkeys(("tape", "tape_addressable", "fiber", "mounting_tape", "wire"), "m"),
}
NEEDED = ("part", "unit", "price")
FURTHER = ("fixed", "serves", "sigma_mm", "what")
LARGEST = 1e9


class Price(NamedTuple):
    """A line of the table.

    Attributes
    ----------
    price
        Price of a unit
    fixed
        Price that is paid once, for any number of units
    serves
        How many LEDs or channels one part serves
    sigma_m
        Error of an LED's place along each axis that a survey reaches; nan for other parts
    """

    unit: str
    price: float
    fixed: float
    serves: int
    sigma_m: float
    what: str


class Prices(NamedTuple):
    """A table of prices by part, and its name for messages."""

    name: str
    parts: dict[str, Price]

    def of(self, part: str) -> Price:
        """The price of a part. Raises InputError if the table lacks it."""
        if part not in self.parts:
            raise InputError(self.name, f"no price of {part}", "a line that begins with it")
        return self.parts[part]

    def survey(self, sigma_m: float, leds: int) -> str:
        """The cheapest survey of `leds` LEDs that reaches an error. Raises InputError if none does."""
        able = {
            name: one.fixed + leds * one.price
            for name, one in self.parts.items()
            if name.startswith(SURVEY) and one.sigma_m <= sigma_m * (1 + 1e-9)
        }
        if not able:
            raise InputError(
                self.name,
                f"no {SURVEY} reaches {1e3 * sigma_m:.3g} mm",
                f"a line {SURVEY}_NAME with a sigma_mm of at most that",
            )
        return min(able, key=lambda name: able[name])


def find_prices(name: str, folder: Path | None = None) -> Path:
    """The file of a table: `assumed`, the one that comes along, or a path, relative to a folder if it is given."""
    shipped = DATA / "prices" / f"{ASSUMED}.csv"
    return shipped if name == ASSUMED else (folder or Path()) / name


def read_prices(path: Path) -> Prices:
    """Read a table: comments begin with #, then the columns' names and one line a part. Raises InputError, one line."""
    lines = [(n, line) for n, line in read_lines(path) if not line.startswith("#")]
    names = [cell.strip() for cell in lines[0][1].split(",")] if lines else []
    if (
        {*NEEDED} - {*names}
        or {*names} - {*NEEDED, *FURTHER}
        or len({*names}) < len(names)
        or len(lines) < 2
    ):
        raise InputError(
            path,
            "not a table of prices",
            f"columns {', '.join(NEEDED)}, optionally {', '.join(FURTHER)}; one part per line",
        )
    parts = dict[str, Price]()
    for number, line in lines[1:]:
        try:
            part, price = parse_line(line, names)
            if part in parts:
                raise InputError("", f"{part} occurs twice", "once")
        except InputError as error:
            raise error.within(path).at(Where(path, number)) from None
        parts[part] = price
    return Prices(str(path), parts)


def parse_line(line: str, names: list[str]) -> tuple[str, Price]:
    """A part and its price. Raises InputError."""
    try:
        cells = next(csv.reader([line], strict=True))
    except csv.Error as error:
        raise InputError("", f"{line[:80]!r} is no line of CSV ({error})") from None
    if len(cells) != len(names):
        raise InputError("", f"{len(cells)} cells", f"{len(names)}, one a column")
    cell = dict(zip(names, (one.strip() for one in cells), strict=True))
    part = cell["part"]
    unit = cell["unit"]
    survey = part.startswith(SURVEY)
    if part not in UNITS and not survey:
        known = [*UNITS, f"{SURVEY}_NAME"]
        raise InputError(
            "", f"unknown part {excerpt(part)}{suggestion(part, known)}", ", ".join(known)
        )
    if unit != UNITS.get(part, "each"):
        raise InputError(f"unit of {part}", f"{unit!r}", UNITS.get(part, "each"))
    if survey != bool(cell.get("sigma_mm")):
        raise InputError(
            f"sigma_mm of {part}",
            cell.get("sigma_mm") or "none",
            f"of a {SURVEY}, which needs it",
        )
    price, fixed = (number(cell, key, 0.0) for key in ("price", "fixed"))
    serves = number(cell, "serves", 1.0)
    if serves < 1 or serves % 1:
        raise InputError("serves", cell["serves"], "a whole number from 1")
    sigma_m = 1e-3 * number(cell, "sigma_mm", math.nan)
    return part, Price(unit, price, fixed, int(serves), sigma_m, cell.get("what", ""))


def number(cell: dict[str, str], key: str, default: float) -> float:
    """The number in a cell, `default` if an optional one is empty. Raises InputError."""
    text = cell.get(key, "")
    if not text and key != "price":
        return default
    try:
        value = float(text)
    except ValueError:
        value = math.nan
    if not 0 <= value <= LARGEST:
        raise InputError(key, f"{text!r}", f"a number from 0 to {LARGEST:g}")
    return value


SHELLS = {"cylinder": "shell_bent", "flat": "shell_flat"}  # all others are doubly curved

Quantities = dict[str, float]


class PartLine(NamedTuple):
    """A part that is bought: quantity in units, price of a unit, what is paid once, and both together."""

    part: str
    quantity: float
    unit: str
    price: float
    fixed: float
    sum: float
    what: str


COLUMNS = PartLine._fields


class PartsList(NamedTuple):
    """The parts of a dome; the total is the sum of the lines, each rounded to a hundredth."""

    lines: list[PartLine]

    @property
    def total(self) -> float:
        """Sum of all lines."""
        return round(sum(line.sum for line in self.lines), 2)

    def rows(self) -> list[list[str]]:
        """The lines as texts, the total below them."""
        return [*map(cells, self.lines), ["total", "", "", "", "", f"{self.total:.2f}", ""]]

    def groups(self) -> dict[str, float]:
        """The sums of shell, survey and all else; they add up to the total."""
        groups = dict.fromkeys(("shell", "LEDs and electronics", SURVEY), 0.0)
        for line in self.lines:
            kind = line.part.partition("_")[0]
            groups[kind if kind in groups else "LEDs and electronics"] += line.sum
        return {name: round(value, 2) for name, value in groups.items()}


class DomeDesign:
    """A scene's dome as designed; boards may stand out beyond the cap of the layout.

    Raises
    ------
    InputError
        Without a dome, which has no `what`.
    """

    def __init__(self, scene: Scene, what: str = "parts") -> None:
        light = scene.dome
        if light is None:
            raise InputError("light.kind", f"{scene.light.kind} has no {what}", "dome")
        self.name = scene.name
        self.light = light
        self.surface = build_surface(light.surface)
        self.leds = design_leds(light, self.surface, Band.from_camera(scene.camera))
        # Boards stand out.
        self.cap_deg = max(light.points.cap_deg, max_tilt_deg(self.leds.xyz))

    def to_rim_m(self, place_m: Floats) -> Floats:
        """(N,) lengths along the surface from places to the cap's rim, on the mean meridian."""
        meridian = mean_meridian(self.surface, math.radians(self.cap_deg))
        tilt_rad = tilts_rad(place_m)
        return meridian.arc_m[-1] - np.interp(tilt_rad, meridian.tilt_rad, meridian.arc_m)


def parts_list(scene: Scene, prices: Prices) -> PartsList:
    """The parts of a scene's dome. Raises InputError without a dome and for a part without a price."""
    lines = []
    for part, quantity in quantities(scene, prices).items():
        one = prices.of(part)
        bought = quantity if one.unit != "each" else float(math.ceil(quantity / one.serves))
        lines.append(
            PartLine(
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
    design = DomeDesign(scene)
    layout = design.light.layout
    leds = len(design.leds)
    found: Quantities = {"panel": 1}  # an LCD panel comes with all that drives it
    if not isinstance(layout, LcdConfig):
        shell = SHELLS.get(design.light.surface.kind, "shell")
        found = {shell: cap_area_m2(design.surface, design.cap_deg)}
        found |= mounted(design) | {"power_supply": leds}
    if design.light.led.code and design.light.led.code.bit_time_s == "frame":
        found["trigger"] = 1
    survey = scene.tracker.survey
    if survey.instrument:
        found[f"{SURVEY}_{survey.instrument.kind}"] = leds
    elif survey.led_sigma_m:
        found[prices.survey(survey.led_sigma_m, leds)] = leds
    return found


def mounted(design: DomeDesign) -> Quantities:
    """LEDs, boards or tape, with what mounts, connects and drives them."""
    layout = design.light.layout
    led = design.light.led
    count = len(design.leds)
    match layout:
        case StringConfig():
            # Cut between LEDs: a pitch of it for each, also for those that are covered.
            wound = wind(
                layout.with_values(pitch_error=0.0, glue_scatter_m=0.0), design.surface
            )
            tape_m = layout.pitch_m * len(wound.place_m)
            wire_m = nearest_m(design.to_rim_m(wound.place_m), wound.tape).sum()
            found = {"mounting_tape": tape_m, "wire": float(wire_m)}
            # LEDs that differ in brightness, or in time, need a driver each.
            if led.code or led.drive.kind != "direct" or len(set(layout.dimming)) > 1:
                return {"tape_addressable": tape_m, **found, "tape_controller": count}
            return {"tape": tape_m, **found}
        case PatchBoardsConfig():
            # A board's wire goes to its LED next to the rim.
            length_m = nearest_m(design.to_rim_m(design.leds.xyz), design.leds.id // HOLES)
            boards = len(length_m)
            found = {"board": boards, "led": count, "mounting_board": boards}
        case _:
            # One by one, each in its hole, or at the rim with a fiber to its hole.
            length_m = design.to_rim_m(design.leds.xyz)
            found = {"led": count, "mounting_led": count}
    line = "fiber" if layout.kind == "fibers" else "wire"
    return {**found, line: float(length_m.sum()), **electronics(design)}


def nearest_m(length_m: Floats, group: Ints) -> Floats:
    """The least length of each group, that of a negative one 0."""
    return np.array([length_m[group == one].min() for one in np.unique(group)]).clip(0)


def electronics(design: DomeDesign) -> Quantities:
    """What drives LEDs that are not on tape: by the drive and the code."""
    led = design.light.led
    count = float(len(design.leds))
    if isinstance(led.drive, SequentialConfig):
        return {"resistor": count, "sequencer": len(np.unique(design.leds.clock))}
    if led.drive.kind == "direct" and led.code is None:
        return {"resistor": count}
    channels: Quantities = {"driver": count, "microcontroller": count}
    filtered = isinstance(led.drive, PwmConfig) and led.drive.filter is not None
    return channels | {"filter": count} if filtered else channels


def to_csv(parts: PartsList, name: str) -> str:
    """The list as CSV, with the total in its last line."""
    text = io.StringIO()
    text.write(f"# Parts of {name}; the prices are those of the table that was given\n")
    writer = csv.writer(text, lineterminator="\n")
    writer.writerows([COLUMNS, *parts.rows()])
    return text.getvalue()


def cells(line: PartLine) -> list[str]:
    """The cells of a line, by COLUMNS."""
    quantity = f"{line.quantity:.0f}" if line.unit == "each" else f"{line.quantity:.2f}"
    money = [f"{line.price:.2f}", f"{line.fixed:.2f}", f"{line.sum:.2f}"]
    return [line.part, quantity, line.unit, *money, line.what]
