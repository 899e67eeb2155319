"""Prices of a dome's parts: a CSV table that the user edits; the shipped one, `assumed`, is a guess throughout."""

from __future__ import annotations

import csv
import math
from pathlib import Path
from typing import NamedTuple
from skysim.core.errors import InputError, Where
from skysim.core.text import (excerpt, read_lines)
from skysim.core.yaml_reader import suggestion
from skysim.core.files import DATA



ASSUMED = "assumed"
SURVEY = "survey"  # a line whose part begins so is a way to survey the LEDs
UNITS = {
    **dict.fromkeys(("shell", "shell_bent", "shell_flat"), "m2"),
    **dict.fromkeys(
        ("led", "board", "panel", "mounting_led", "mounting_board", "resistor", "filter"), "each"
    ),
    **dict.fromkeys(
        ("driver", "microcontroller", "sequencer", "tape_controller", "trigger", "power_supply"),
        "each",
    ),
    **dict.fromkeys(("tape", "tape_addressable", "fiber", "mounting_tape", "wire"), "m"),
}
NEEDED = ("part", "unit", "price")
FURTHER = ("fixed", "serves", "sigma_mm", "what")
LARGEST = 1e9


class Price(NamedTuple):
    """A line of the table.

    price : of a unit;  fixed : once;  serves : how many LEDs or channels one part serves
    sigma_m : error of an LED's place along each axis that a survey reaches; nan for other parts
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
        """The cheapest survey of so many LEDs that reaches an error. Raises InputError if none does."""
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
            f"sigma_mm of {part}", cell.get("sigma_mm") or "none", f"of a {SURVEY}, which needs it"
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


