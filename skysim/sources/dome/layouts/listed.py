"""LEDs by list: places in the lab or directions from the bearing, from the scene or from a CSV file."""

from collections.abc import Sequence
from pathlib import Path
from typing import NamedTuple

import numpy as np
from numpy.random import Generator

from skysim.core.errors import InputError, Where, errors_within
from skysim.core.text import cells_of, column_numbers, read_lines
from skysim.core.types import Floats, lengths, normalized
from skysim.scene.sections.layouts import MAX_LEDS, ListedConfig, relative_levels
from skysim.sources.dome.layouts.placing import (
    Ints,
    PlacedLeds,
    check_cap,
    directions_from_angles,
    on_surface,
    project_from_bearing,
    thin,
)
from skysim.sources.dome.point_cloud import UNIT_M
from skysim.sources.dome.surface import Surface

MAX_SURFACE_OFFSET_M = 0.05  # of a listed LED; a larger one is an error in a unit or an axis
SAME_PLACE = 1e-4  # distance of two LEDs of a file that are one, in m or rad
PLACES = {tuple(f"{axis}_{unit}" for axis in "xyz"): scale for unit, scale in UNIT_M.items()}
ANGLES = ("azimuth_deg", "tilt_deg")
BRIGHTNESS = ("level", "magnitude")
# `id` numbers the LEDs; the others, of a display's tapes and of a survey's map, are not used.
FURTHER = ("id", "tape", "tape_m", "sigma_m", "own_m2", "common_m")


class LedFile(NamedTuple):
    """Contents of a file of LEDs.

    Attributes
    ----------
    coordinates
        (N, 3) places, or (N, 2) azimuths and tilts
    level, id
        (N,) each, None if the file has no such column
    places
        File and line of each
    """

    coordinates: Floats
    level: Floats | None
    id: Ints | None
    places: list[str]


def listed(config: ListedConfig, surface: Surface, _rng: Generator) -> PlacedLeds:
    """LEDs from a list or a CSV file: places in the lab, used unchanged, or directions from the bearing.

    Normals are the surface's.

    Raises
    ------
    InputError
        For a place more than 5 cm off the surface or beyond the cap, and for two LEDs at one place.
    """
    level: Floats | None = np.array(config.levels or relative_levels(config.magnitudes or ()))
    number: Ints | None = None
    if config.file:
        coordinates, level, number, keys = read_csv(Path(config.file))
    else:
        name = "positions" if config.positions_m else "directions_deg"
        coordinates = np.array(config.positions_m or config.directions_deg)
        keys = [f"light.layout.{name}.{n}" for n in range(len(coordinates))]
    # Places are used as they are; directions are projected from the bearing.
    are_places = coordinates.shape[1] == 3
    directions = coordinates if are_places else directions_from_angles(coordinates)
    # A file is measured, with errors; the numbers of a list are exact, and stars of a display are close.
    apart = thin(directions, SAME_PLACE if config.file else 1e-6)
    if len(apart) < len(directions):
        second = np.setdiff1d(np.arange(len(directions)), apart)[0]
        first = lengths(directions[:second] - directions[second]).argmin()
        raise InputError(keys[second], f"at the place of {keys[first]}", "each LED once")
    check_cap(keys, directions, config.cap_deg)
    place_m = coordinates if are_places else project_from_bearing(surface, directions)
    check_on_surface(keys, surface, place_m)
    # Without levels every LED is at full brightness.
    level = level if level is not None and len(level) else np.ones(len(place_m))
    placed = on_surface(surface, place_m, level)._replace(types=config.types or ())
    return placed if number is None else placed._replace(id=number)


def check_on_surface(keys: Sequence[str], surface: Surface, place_m: Floats) -> None:
    """Raise InputError for the first LED that is too far from the surface, along the ray from the bearing."""
    # Written so that NaN is too far.
    directions = normalized(place_m)
    offset_m = lengths(project_from_bearing(surface, directions) - place_m)
    far = np.flatnonzero(~(offset_m <= MAX_SURFACE_OFFSET_M))
    if len(far):
        raise InputError(
            keys[far[0]],
            f"{offset_m[far[0]]:.3g} m from the surface",
            f"{MAX_SURFACE_OFFSET_M:g} m; columns x_mm, y_mm, z_mm of a file are in millimeters",
        )


def read_csv(path: Path) -> LedFile:
    """Read a file of LEDs: columns x_m, y_m, z_m or azimuth_deg, tilt_deg; and level or magnitude, or neither.

    Places may be in other units: x_mm, x_cm, x_in. Comments begin with #; the first other line has the names, in any
    order, separated by commas or, as in an ECSV of `skysim survey`, by blanks. If there are places and directions, the
    places are used.

    Raises
    ------
    InputError
        With one line, and with the number of the wrong line.
    """
    with errors_within("light.layout.file"):
        rows = cells_of(read_lines(path))
    names = rows[0][1] if rows else []
    allowed = {**PLACES, ANGLES: 1.0}
    chosen = next((columns for columns in allowed if {*columns} <= {*names}), None)
    brightness = [name for name in names if name in BRIGHTNESS]
    known = {*BRIGHTNESS, *FURTHER, *ANGLES, *(chosen or ())}
    # Every column must be known and there once; one kind of place, and one of brightness at most.
    repeated = len(brightness) > 1 or len({*names}) < len(names)
    if chosen is None or repeated or {*names} - known or len(rows) < 2:
        header = str(Where(path, rows[0][0])) if rows else path
        raise InputError(
            header,
            "not a list of LEDs",
            f"columns x_m, y_m, z_m or {', '.join(ANGLES)}, or x_mm and so on; optionally {' or '.join(BRIGHTNESS)},"
            f" {', '.join(FURTHER)}; one LED per line",
        )
    # One line is the header.
    if len(rows) > MAX_LEDS + 1:
        raise InputError(path, f"{len(rows) - 1} LEDs", f"up to {MAX_LEDS}")
    used = [name for name in names if name not in FURTHER[1:]]
    column = dict(zip(used, column_numbers(path, rows, used).T, strict=True))
    places = [str(Where(path, n)) for n, _ in rows[1:]]
    level = column.get("level")
    if "magnitude" in column:
        level = np.array(relative_levels(column["magnitude"].tolist()))
    elif level is not None and len(bad := np.flatnonzero((level <= 0) | (level > 1))):
        raise InputError(places[bad[0]], f"level {level[bad[0]]:g}", "above 0 and at most 1")
    return LedFile(
        allowed[chosen] * np.column_stack([column[name] for name in chosen]),
        level,
        led_numbers(places, column["id"]) if "id" in column else None,
        places,
    )


def led_numbers(places: Sequence[str], column: Floats) -> Ints:
    """The LED numbers in a file's column `id`. Raises InputError with the place of the first other number."""
    # NaN and fractions differ from their whole number.
    with np.errstate(invalid="ignore"):
        number = column.astype(np.int64)
    wrong = (number != column) | (number < 0)
    repeated = np.ones(len(number), bool)
    # All but the first of equal numbers.
    repeated[np.unique(number, return_index=True)[1]] = False
    found = np.flatnonzero(wrong | repeated)
    if len(found):
        raise InputError(
            places[found[0]], f"id {column[found[0]]:g}", "whole numbers from 0, each once"
        )
    return number
