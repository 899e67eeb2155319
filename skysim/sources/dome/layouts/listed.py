"""LEDs by list: places in the lab or directions from the bearing, from the scene or from a CSV file."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from skysim.core.errors import InputError
from skysim.core.random_streams import random_stream
from skysim.core.types import Floats, Sources
from skysim.scene.sections.layouts import ListedConfig, relative_levels
from skysim.scene.sections.leds import LedConfig
from skysim.sources.dome.layouts.placing import (
    check_cap,
    directions_from_angles,
    led_sources,
    on_surface,
    project_from_bearing,
)
from skysim.sources.dome.shell.surface import Surface
from skysim.sources.photometry import Band

MAX_SURFACE_OFFSET_M = 0.05  # of a listed LED; more is an error in a unit or an axis
COLUMNS = (("x_m", "y_m", "z_m"), ("azimuth_deg", "tilt_deg"))


def listed(config: ListedConfig, surface: Surface, led: LedConfig, band: Band) -> Sources:
    """LEDs from a list or a CSV file: places in the lab, used unchanged, or directions from the bearing.

    Normals are the surface's. Raises InputError for a place more than 5 cm off the surface or beyond the cap.
    """
    level: Floats | None = np.array(config.levels or relative_levels(config.magnitudes or ()))
    key = "light.layout.positions" if config.positions_m else "light.layout.directions_deg"
    if config.file:
        key = config.file
        coordinates, level = read_csv(Path(config.file))
    else:
        coordinates = np.array(config.positions_m or config.directions_deg)
    directions = coordinates if coordinates.shape[1] == 3 else directions_from_angles(coordinates)
    check_cap(key, directions, config.cap_deg)
    place_m = coordinates if coordinates.shape[1] == 3 else project_from_bearing(surface, directions)
    check_on_surface(key, surface, place_m)
    level = level if level is not None and len(level) else np.ones(len(place_m))
    return led_sources(on_surface(surface, place_m, level), led, band, random_stream(config.hardware_seed))


def check_on_surface(key: str, surface: Surface, place_m: Floats) -> None:
    """Raise InputError for the first LED that is too far from the surface, along the ray from the bearing."""
    directions = place_m / np.linalg.norm(place_m, axis=1, keepdims=True)
    offset_m = np.linalg.norm(project_from_bearing(surface, directions) - place_m, axis=1)
    far = np.flatnonzero(~(offset_m <= MAX_SURFACE_OFFSET_M))
    if len(far):
        raise InputError(
            f"{key}.{far[0]}: {offset_m[far[0]]:.3g} m from the surface; allowed: {MAX_SURFACE_OFFSET_M:g} m"
        )


def read_csv(path: Path) -> tuple[Floats, Floats | None]:
    """Read a file of LEDs: columns x_m, y_m, z_m or azimuth_deg, tilt_deg; and level or magnitude, or neither.

    Comments begin with #; the first other line holds the names. Returns (N, 3) or (N, 2), and levels (N,) or None.
    Raises InputError, one line, with the line's number.
    """
    try:
        text = path.read_text(encoding="utf-8").splitlines()
    except (OSError, UnicodeDecodeError) as error:
        raise InputError(f"light.layout.file: {path} cannot be read ({error})") from None
    lines = [(n, line) for n, line in enumerate(text, 1) if line.strip() and not line.startswith("#")]
    names = tuple(name.strip() for name in lines[0][1].split(",")) if lines else ()
    brightness = names[-1] if names and names[-1] in ("level", "magnitude") else ""
    if names[: len(names) - bool(brightness)] not in COLUMNS or len(lines) < 2:
        raise InputError(
            f"{path}: not a list of LEDs; allowed: columns {' or '.join(map(', '.join, COLUMNS))}, then"
            " optionally level or magnitude; one LED per line"
        )
    table = np.array([parse_row(path, n, line, len(names), brightness) for n, line in lines[1:]])
    if not brightness:
        return table, None
    last = table[:, -1]
    return table[:, :-1], last if brightness == "level" else np.array(relative_levels(last.tolist()))


def parse_row(path: Path, number: int, line: str, count: int, brightness: str) -> list[float]:
    """The numbers of one line of an LED file. Raises InputError."""
    try:
        row = [float(cell) for cell in line.split(",")]
    except ValueError:
        row = []
    if len(row) != count or not np.all(np.isfinite(row)) or (brightness == "level" and not 0 < row[-1] <= 1):
        raise InputError(
            f"{path}, line {number}: {line!r} is not an LED; allowed: {count} numbers, a level above 0 and at most 1"
        )
    return row
