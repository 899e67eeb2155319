"""All layouts of LEDs by name: LAYOUTS maps the scene's `light.layout.kind` to a function that returns all LEDs.

Those defined here are LEDs by list, the real sky, and three kinds that take the points of another layout (fibers,
panel, projector); the others are in their own modules. `led_list` writes a dome's LEDs for its builder, as a CSV file
that `layout: {kind: listed, file: ...}` reads back.
"""

import math
from collections.abc import Callable
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from numpy.random import Generator

from skysim.core.errors import InputError, Where
from skysim.core.random_streams import random_stream
from skysim.core.types import Floats, Sources, normalized
from skysim.core.yaml_reader import read_limited
from skysim.scene.sections.layouts import (
    HOLES,
    MAX_LEDS,
    CelestialConfig,
    FibersConfig,
    Layout,
    LcdConfig,
    ListedConfig,
    PatchBoardsConfig,
    ProjectorConfig,
    StringConfig,
    relative_levels,
)
from skysim.scene.sections.leds import LedConfig
from skysim.scene.sections.light import DomeConfig
from skysim.sources.dome import celestial as celestial_dome
from skysim.sources.dome.display import (
    ideal_led,
    panel_sources,
    panel_surface,
    projector_sources,
)
from skysim.sources.dome.layouts.placing import (
    Ints,
    PlacedLeds,
    check_cap,
    directions_from_angles,
    led_sources,
    on_surface,
    project_from_bearing,
    thin,
    tilts_rad,
)
from skysim.sources.dome.layouts.spreads import (
    fibonacci,
    geodesic,
    optimized,
    patch_boards,
    poisson_disk,
    random_places,
)
from skysim.sources.dome.layouts.string import displace_ends, string, wind
from skysim.sources.dome.led import full_strength_e_s_sr
from skysim.sources.dome.point_cloud import UNIT_M
from skysim.sources.dome.surface import Surface, build_surface
from skysim.sources.photometry import Band

# LEDs by list: places in the lab or directions from the bearing, from the scene or from a CSV file.

MAX_SURFACE_OFFSET_M = 0.05  # of a listed LED; a larger one is an error in a unit or an axis
MAX_BYTES = 1 << 25  # of a file
SAME_PLACE = 1e-4  # distance of two LEDs of a file that are one, in m or rad
PLACES = {tuple(f"{axis}_{unit}" for axis in "xyz"): scale for unit, scale in UNIT_M.items()}
ANGLES = ("azimuth_deg", "tilt_deg")
BRIGHTNESS = ("level", "magnitude")
FURTHER = (
    "id",
    "tape",
    "tape_m",
    "sigma_m",
)  # `id` numbers the LEDs, the others are not used


class LedFile(NamedTuple):
    """Contents of a file of LEDs.

    Attributes
    ----------
    coordinates
        (N, 3) places, or (N, 2) azimuths and tilts
    level, id
        (N,) each, None if the file has no such column
    """

    coordinates: Floats
    level: Floats | None
    id: Ints | None


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
    key = "light.layout.positions" if config.positions_m else "light.layout.directions_deg"
    if config.file:
        key = config.file
        coordinates, level, number = read_csv(Path(config.file))
    else:
        coordinates = np.array(config.positions_m or config.directions_deg)
    # Places are used as they are; directions are projected from the bearing.
    are_places = coordinates.shape[1] == 3
    directions = coordinates if are_places else directions_from_angles(coordinates)
    # A file is measured, with errors; the numbers of a list are exact, and stars of a display are close.
    apart = thin(directions, SAME_PLACE if config.file else 1e-6)
    if len(apart) < len(directions):
        second = np.setdiff1d(np.arange(len(directions)), apart)[0]
        first = np.linalg.norm(directions[:second] - directions[second], axis=1).argmin()
        raise InputError(f"{key}.{second}", f"at the place of {first}", "each LED once")
    check_cap(key, directions, config.cap_deg)
    place_m = coordinates if are_places else project_from_bearing(surface, directions)
    check_on_surface(key, surface, place_m)
    # Without levels every LED is at full brightness.
    level = level if level is not None and len(level) else np.ones(len(place_m))
    placed = on_surface(surface, place_m, level)._replace(types=config.types or ())
    return placed if number is None else placed._replace(id=number)


def check_on_surface(key: str, surface: Surface, place_m: Floats) -> None:
    """Raise InputError for the first LED that is too far from the surface, along the ray from the bearing."""
    # Written so that NaN is too far.
    directions = normalized(place_m)
    offset_m = np.linalg.norm(project_from_bearing(surface, directions) - place_m, axis=1)
    far = np.flatnonzero(~(offset_m <= MAX_SURFACE_OFFSET_M))
    if len(far):
        raise InputError(
            f"{key}.{far[0]}",
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
    text = read_limited(path, MAX_BYTES).splitlines()
    lines = [
        (n, line)
        for n, line in enumerate(text, 1)
        if line.strip() and not line.startswith("#")
    ]
    names = split_row(lines[0][1]) if lines else []
    allowed = {**PLACES, ANGLES: 1.0}
    chosen = next((columns for columns in allowed if {*columns} <= {*names}), None)
    brightness = [name for name in names if name in BRIGHTNESS]
    known = {*BRIGHTNESS, *FURTHER, *ANGLES, *(chosen or ())}
    # Every column must be known and there once; one kind of place, and one of brightness at most.
    repeated = len(brightness) > 1 or len({*names}) < len(names)
    if chosen is None or repeated or {*names} - known or len(lines) < 2:
        raise InputError(
            path,
            "not a list of LEDs",
            f"columns x_m, y_m, z_m or {', '.join(ANGLES)}, or x_mm and so on; optionally {' or '.join(BRIGHTNESS)},"
            f" {', '.join(FURTHER)}; one LED per line",
        )
    # One line is the header.
    if len(lines) > MAX_LEDS + 1:
        raise InputError(path, f"{len(lines) - 1} LEDs", f"up to {MAX_LEDS}")
    # Each row is checked with its number in the file.
    rows = [parse_row(path, n, line, names) for n, line in lines[1:]]
    column = dict(zip(names, np.array(rows).T, strict=True))
    level = column.get("level")
    if "magnitude" in column:
        level = np.array(relative_levels(column["magnitude"].tolist()))
    return LedFile(
        allowed[chosen] * np.column_stack([column[name] for name in chosen]),
        level,
        led_numbers(path, column.get("id")),
    )


def split_row(line: str) -> list[str]:
    """The cells of a line, separated by commas, or by blanks in a line without commas."""
    return [cell.strip() for cell in line.split(",")] if "," in line else line.split()


def led_numbers(path: Path, column: Floats | None) -> Ints | None:
    """The LED numbers in a file's column `id`; None without it. Raises InputError for other numbers."""
    if column is None:
        return None
    # NaN and fractions differ from their whole number.
    with np.errstate(invalid="ignore"):
        number = column.astype(np.int64)
    wrong = (number != column) | (number < 0)
    repeated = np.ones(len(number), bool)
    # All but the first of equal numbers.
    repeated[np.unique(number, return_index=True)[1]] = False
    found = np.flatnonzero(wrong | repeated)
    if len(found):
        raise InputError(path, f"id {column[found[0]]:g}", "whole numbers from 0, each once")
    return number


def parse_row(path: Path, number: int, line: str, names: list[str]) -> list[float]:
    """The numbers of one line of an LED file. Raises InputError."""
    try:
        row = [float(cell) for cell in split_row(line)]
    except ValueError:
        row = []
    level = dict(zip(names, row, strict=False)).get("level", 1.0)
    if len(row) != len(names) or not all(map(math.isfinite, row)) or not 0 < level <= 1:
        raise Where(path, number).error(
            f"{line!r} is not an LED", f"{len(names)} numbers, a level above 0 and at most 1"
        )
    return row


# The layouts by name.

LayoutFunction = Callable[[Any, Surface, LedConfig, Band], Sources]


def fitted(place: Callable[[Any, Surface, Generator], PlacedLeds]) -> LayoutFunction:
    """The layout of the LEDs that a function places; all draws are from one stream of the hardware."""

    def layout(config: Any, surface: Surface, led: LedConfig, band: Band) -> Sources:
        rng = random_stream(config.hardware_seed)
        return led_sources(place(config, surface, rng), led, band, rng)

    return layout


def celestial(
    config: CelestialConfig, surface: Surface, led: LedConfig, band: Band
) -> Sources:
    """The real sky (JHU/APL's idea): an LED where the camera at its nominal place sees each of the brightest stars.

    LED numbers are Hipparcos numbers. Places are those of `celestial.project_stars`, levels those of
    `celestial.led_levels`.
    """
    stars = celestial_dome.project_stars(config, surface, led, band)
    normal = surface.inward(stars.place_m)
    level = celestial_dome.led_levels(config, stars, normal, led)
    placed = PlacedLeds(stars.hip, stars.place_m, normal, level, stars.v_mag)
    return led_sources(placed, led, band, random_stream(config.hardware_seed))


def fibers(config: FibersConfig, surface: Surface, led: LedConfig, band: Band) -> Sources:
    """Ends of optical fibers at another layout's points, with the errors of shell and holes: `displace_ends`."""
    designed = LAYOUTS[config.points.kind](config.points, surface, led, band)
    return displace_ends(config, surface, designed)


def lcd(config: LcdConfig, surface: Surface, led: LedConfig, band: Band) -> Sources:
    """Another layout's LEDs drawn on the nearest pixels of a panel: `display.panel_sources`."""
    # The points are placed on the panel as ideal LEDs, whose strengths are levels.
    panel = panel_surface(config, surface)
    stars = LAYOUTS[config.points.kind](config.points, panel, ideal_led(led), band)
    return panel_sources(config, panel, led, band, stars)


def projector(
    config: ProjectorConfig, surface: Surface, led: LedConfig, band: Band
) -> Sources:
    """Another layout's LEDs drawn on the nearest pixels of a projector: `display.projector_sources`."""
    stars = LAYOUTS[config.points.kind](config.points, surface, ideal_led(led), band)
    return projector_sources(config, surface, led, band, stars)


# Arguments: the layout's section of the scene, the surface, the LED section, the chip's band. Returns all LEDs.
LAYOUTS: dict[str, LayoutFunction] = {
    "patch_boards": fitted(patch_boards),
    "fibonacci": fitted(fibonacci),
    "poisson_disk": fitted(poisson_disk),
    "random": fitted(random_places),
    "geodesic": fitted(geodesic),
    "string": fitted(string),
    "optimized": fitted(optimized),
    "celestial": celestial,
    "listed": fitted(listed),
    "fibers": fibers,
    "lcd": lcd,
    "projector": projector,
}


def board_of(config: Layout, led_ids: Ints) -> Ints | None:
    """(N,) board of each of these LED numbers; None if boards cannot tell LEDs apart: no boards, or only one."""
    board = led_ids // HOLES
    return (
        board if isinstance(config, PatchBoardsConfig) and len(np.unique(board)) > 1 else None
    )


# The list of a dome's LEDs for its builder.

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
    place_m = leds.place[:, :3]
    full = full_strength_e_s_sr(ideal_led(config.led), band)
    level = leds.strength / max(full, float(leds.strength.max()))
    azimuth_deg = np.degrees(np.arctan2(place_m[:, 1], place_m[:, 0])) % 360
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
