"""LED layouts of a dome: where the LEDs are and how bright each is.

LAYOUTS maps the scene's `light.layout.kind` to a function that returns all LEDs as `Sources`. The kinds are patch
boards, even (Fibonacci), Poisson-disk, random and optimized spreads, the real sky, lists, and two that take the
points of another layout: optical fibers and an LCD panel.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree
from scipy.spatial.transform import Rotation

from skysim.core.errors import InputError
from skysim.core.random_streams import random_stream
from skysim.core.types import Floats, Sources
from skysim.scene import leds
from skysim.sources.dome import celestial as celestial_dome
from skysim.sources.dome import display
from skysim.sources.dome.led import DRIVES, DriveInput, full_strength_e_s_sr
from skysim.sources.dome.placement import optimize
from skysim.sources.dome.surface import Surface
from skysim.sources.photometry import Band

HOLES = leds.HOLES  # on a patch board; LED number = board * HOLES + hole
GOLDEN_ANGLE_RAD = np.pi * (3 - np.sqrt(5))
GLUE_STREAM = 1  # spawn key of the glue's own random stream, so that glue errors leave a board's pattern unchanged
DARTS_PER_SPACING2 = 100  # random points per spacing^2: a gap of .03 of that area is found with probability .95
MAX_DARTS = 3_000_000
DARTS_PER_LED = 30  # random points per LED, if a count is given
BISECTIONS = 14  # bisection steps from the dome's width: to some tenths of a millimeter
MAX_SURFACE_OFFSET_M = 0.05  # of a listed LED; more is an error in a unit or an axis

Ints = NDArray[np.int64]


@dataclass(frozen=True, slots=True)
class PlacedLeds:
    """LED positions before drive and brightness are assigned.

    id        : (N,) LED numbers
    place_m   : (N, 3) in the lab;  normal : (N, 3) unit
    level     : (N,) fraction of full brightness, 0 < level <= 1
    magnitude : (N,) of the star that the LED represents; NaN if it represents none
    """

    id: Ints
    place_m: Floats
    normal: Floats
    level: Floats
    magnitude: Floats


@dataclass(frozen=True, slots=True)
class Boards:
    """Patch boards, (B, 3) each: center in the lab, m, unit normal, and unit vectors of the two axes of the holes."""

    center_m: Floats
    normal: Floats
    u: Floats
    v: Floats


def led_sources(placed: PlacedLeds, led: leds.LedConfig, band: Band, rng: np.random.Generator) -> Sources:
    """Sources of placed LEDs: strength with its scatter from LED to LED, and the drive's pulse timing.

    The strength is lognormal about the nominal one; the logarithm's standard deviation is led.scatter, for which
    AFIT's Table 2 gives .07 to .09. rng is the hardware's.
    """
    count = len(placed.id)
    scatter = np.exp(led.scatter * rng.standard_normal(count))
    strength = full_strength_e_s_sr(led, band) * scatter
    pulses = DRIVES[led.drive.kind](led, DriveInput(placed.level, placed.id // HOLES), rng)
    return Sources(
        id=placed.id,
        place=np.column_stack([placed.place_m, np.ones(count)]),
        normal=placed.normal,
        radius_m=np.full(count, led.disk_diameter_m / 2),
        strength=strength * pulses.strength,
        period_s=pulses.period_s,
        start_s=pulses.start_s,
        on_s=pulses.on_s,
        clock=pulses.clock,
        magnitude=placed.magnitude,
    )


def on_surface(surface: Surface, place_m: Floats, level: Floats) -> PlacedLeds:
    """LEDs at (N, 3) places with the surface's normals there, numbered from 0."""
    number = np.arange(len(place_m), dtype=np.int64)
    return PlacedLeds(number, place_m, surface.inward(place_m), level, np.full(len(place_m), np.nan))


def dimmed_sources(
    dimming: Sequence[float],
    surface: Surface,
    place_m: Floats,
    led: leds.LedConfig,
    band: Band,
    rng: np.random.Generator,
) -> Sources:
    """Sources of LEDs at (N, 3) places on the surface, each with a random level of `dimming`."""
    level = rng.choice(dimming, len(place_m))
    return led_sources(on_surface(surface, place_m, level), led, band, rng)


def cap(count: int, half_angle_rad: float) -> Floats:
    """(count, 3) unit vectors spread evenly over a cap about +z: Fibonacci spiral, equal areas in z."""
    n = np.arange(count) + 0.5
    z = 1 - n / count * (1 - np.cos(half_angle_rad))
    ring = np.sqrt(1 - z**2)
    return np.column_stack([ring * np.cos(n * GOLDEN_ANGLE_RAD), ring * np.sin(n * GOLDEN_ANGLE_RAD), z])


def scattered_cap(count: int, half_angle_rad: float, rng: np.random.Generator) -> Floats:
    """(count, 3) independent unit vectors, uniform over a cap about +z: uniform in z and in azimuth."""
    z = 1 - rng.random(count) * (1 - np.cos(half_angle_rad))
    azimuth, ring = rng.uniform(0, 2 * np.pi, count), np.sqrt(1 - z**2)
    return np.column_stack([ring * np.cos(azimuth), ring * np.sin(azimuth), z])


def directions_from_angles(directions_deg: Any) -> Floats:
    """(N, 3) unit vectors from the bearing, for (N, 2) azimuth from +x toward +y and tilt from +z."""
    azimuth, tilt = np.radians(np.asarray(directions_deg, dtype=float)).T
    return np.column_stack([np.sin(tilt) * np.cos(azimuth), np.sin(tilt) * np.sin(azimuth), np.cos(tilt)])


def check_cap(key: str, directions: Floats, cap_deg: float) -> None:
    """Raise InputError for the first of (N, 3) directions from the bearing that is outside the cap."""
    length = np.linalg.norm(directions, axis=1)
    tilt_deg = np.degrees(np.arctan2(np.hypot(*directions.T[:2]), directions[:, 2]))
    beyond = np.flatnonzero(~((length > 0) & (tilt_deg <= cap_deg * (1 + 1e-12))))
    if len(beyond):
        raise InputError(
            f"{key}.{beyond[0]}: {tilt_deg[beyond[0]]:.4g} deg from the zenith, seen from the bearing's center;"
            f" allowed: light.layout.cap_deg, {cap_deg:g}"
        )


def project_from_bearing(surface: Surface, directions: Floats) -> Floats:
    """(N, 3) points where rays from the bearing's center meet the surface. Raises InputError where they miss it."""
    place_m = surface.meet(np.zeros(3), directions)
    if np.isnan(place_m).any():
        raise InputError(
            "light.layout: exceeds the surface; allowed: a smaller cap_deg, a larger surface or rim, or kind listed"
        )
    return place_m


def patch_boards(config: leds.PatchBoardsConfig, surface: Surface, led: leds.LedConfig, band: Band) -> Sources:
    """3x3 boards glued flat to the surface, listed or spread evenly, each with its own choice of LEDs and levels.

    A board is a plane tangent at its center, so its outer LEDs are off the surface, as on the real dome. The glue
    tilts the board, and each LED is displaced in the board's plane. Everything random here is hardware and is drawn
    from config.hardware_seed: which LEDs are soldered, their levels and strengths, the phases of their pulses.
    """
    rng = random_stream(config.hardware_seed)
    boards, holes, level = listed_boards(config, surface) if config.boards else spread_boards(config, surface, rng)
    board = np.repeat(np.arange(len(holes)), [len(board_holes) for board_holes in holes])
    hole = np.concatenate(holes)
    if level is None:
        level = rng.choice(config.pwm_levels, len(board))
    glue = random_stream(config.hardware_seed, GLUE_STREAM)
    if config.glue_tilt_deg:
        boards = tilt_boards(boards, np.radians(config.glue_tilt_deg), glue)
    displacement_m = config.glue_scatter_m * glue.standard_normal((2, len(board)))
    # Hole h is in column h % 3 and row h // 3; hole 4 is the center.
    place = (
        boards.center_m[board]
        + ((hole % 3 - 1) * config.pitch_m + displacement_m[0])[:, None] * boards.u[board]
        + ((hole // 3 - 1) * config.pitch_m + displacement_m[1])[:, None] * boards.v[board]
    )
    number = (board * HOLES + hole).astype(np.int64)
    return led_sources(
        PlacedLeds(number, place, boards.normal[board], level, np.full(len(board), np.nan)), led, band, rng
    )


def spread_boards(
    config: leds.PatchBoardsConfig, surface: Surface, rng: np.random.Generator
) -> tuple[Boards, list[Ints], None]:
    """Boards all over the cap as seen from the bearing, and the holes that each uses.

    On a spiral each board has a random orientation; on a grid all are aligned with its rows.
    """
    half, spacing_m = np.radians(config.cap_deg), config.spacing_m or config.pitch_m
    apex_m = project_from_bearing(surface, np.array([[0.0, 0.0, 1.0]]))[0, 2]
    if config.spread == "grid":
        directions = grid(spacing_m / apex_m, half)
        rotation = np.zeros(len(directions))
    else:
        # The cap's area on a sphere of the apex's height, over one square of the spacing per board.
        area_m2 = 2 * np.pi * apex_m**2 * (1 - np.cos(half))
        directions = cap(max(1, round(area_m2 / spacing_m**2)), half)
        rotation = rng.uniform(0, 2 * np.pi, len(directions))
    boards = tangent_boards(surface, project_from_bearing(surface, directions), rotation)
    holes = [rng.permutation(HOLES)[: rng.integers(config.lit[0], config.lit[1] + 1)] for _ in range(len(rotation))]
    return boards, holes, None


def grid(spacing_rad: float, half_angle_rad: float) -> Floats:
    """(N, 3) unit vectors in rows and columns over a cap about +z, one of them at +z.

    Equal steps on Lambert's equal-area map, where a direction at the angle t from the center is at radius 2 sin(t /
    2).
    """
    steps = int(2 * np.sin(half_angle_rad / 2) / spacing_rad)
    x, y = (axis.ravel() * spacing_rad for axis in np.meshgrid(*2 * [np.arange(-steps, steps + 1)]))
    radius2 = x**2 + y**2
    within = radius2 <= (2 * np.sin(half_angle_rad / 2)) ** 2
    x, y, radius2 = x[within], y[within], radius2[within]
    # Inverse of the map: at the radius rho, z = 1 - rho^2 / 2, at the distance rho sqrt(1 - rho^2 / 4) from the axis.
    scale = np.sqrt(1 - radius2 / 4)
    return np.column_stack([x * scale, y * scale, 1 - radius2 / 2])


def listed_boards(config: leds.PatchBoardsConfig, surface: Surface) -> tuple[Boards, list[Ints], Floats]:
    """Boards at the listed places, their holes, and the level of every LED. Raises InputError if two boards overlap."""
    listed = config.boards
    directions = directions_from_angles([(board.azimuth_deg, board.tilt_deg) for board in listed])
    check_cap("light.layout.boards", directions, config.cap_deg)
    center_m = project_from_bearing(surface, directions)
    close = cKDTree(center_m).query_pairs(3 * config.pitch_m * (1 - 1e-9))
    if close:
        first, second = min(close)
        distance_m = np.linalg.norm(center_m[first] - center_m[second])
        raise InputError(
            f"light.layout.boards.{second}: overlaps board {first}, {distance_m:.3g} m away; allowed:"
            f" {3 * config.pitch_m:.3g} m, three pitches"
        )
    boards = tangent_boards(surface, center_m, np.radians([board.rotation_deg for board in listed]))
    level = np.concatenate([board.levels or np.ones(len(board.leds)) for board in listed])
    return boards, [np.array(board.leds, dtype=np.int64) for board in listed], level


def tangent_boards(surface: Surface, center_m: Floats, rotation_rad: Floats) -> Boards:
    """Boards tangent to the surface. At turn 0 the holes' columns run along normal x (lab x)."""
    normal = surface.inward(center_m)
    across = np.cross(normal, [1.0, 0.0, 0.0])
    edge_on = np.linalg.norm(across, axis=1) < 1e-9  # the normal is parallel to lab x
    across[edge_on] = [0.0, 1.0, 0.0]
    across /= np.linalg.norm(across, axis=1, keepdims=True)
    along = np.cross(normal, across)
    rotation = rotation_rad[:, None]
    u, v = (
        across * np.cos(rotation) + along * np.sin(rotation),
        along * np.cos(rotation) - across * np.sin(rotation),
    )
    return Boards(center_m, normal, u, v)


def tilt_boards(boards: Boards, max_rad: float, rng: np.random.Generator) -> Boards:
    """Boards tilted by the glue: normals uniform over a cap of most_rad about the surface's, centers unchanged."""
    count = len(boards.normal)
    angle = np.arccos(1 - rng.random(count) * (1 - np.cos(max_rad)))
    azimuth = rng.uniform(0, 2 * np.pi, count)[:, None]
    axis = boards.u * np.cos(azimuth) + boards.v * np.sin(azimuth)
    rotation = Rotation.from_rotvec(angle[:, None] * axis)
    return replace(boards, normal=rotation.apply(boards.normal), u=rotation.apply(boards.u), v=rotation.apply(boards.v))


def fibonacci(config: leds.FibonacciConfig, surface: Surface, led: leds.LedConfig, band: Band) -> Sources:
    """LEDs on a Fibonacci spiral: equal solid angles about the bearing hold equal numbers, to within a few."""
    rng = random_stream(config.hardware_seed)
    place_m = project_from_bearing(surface, cap(config.count, np.radians(config.cap_deg)))
    return dimmed_sources(config.dimming, surface, place_m, led, band, rng)


def random_places(config: leds.RandomPlacesConfig, surface: Surface, led: leds.LedConfig, band: Band) -> Sources:
    """Independent LEDs, uniform in solid angle about the bearing: a Poisson field, like that of real stars."""
    rng = random_stream(config.hardware_seed)
    place_m = project_from_bearing(surface, scattered_cap(config.count, np.radians(config.cap_deg), rng))
    return dimmed_sources(config.dimming, surface, place_m, led, band, rng)


def poisson_disk(config: leds.PoissonDiskConfig, surface: Surface, led: leds.LedConfig, band: Band) -> Sources:
    """LEDs at random with a least spacing, as many as fit: random sequential adsorption.

    Random points, uniform over the cap, are taken in turn; each is accepted if no accepted one is within the spacing.
    Disks of that diameter would jam at a coverage of .547 (Feder 1980, J. theor. Biol. 87, 237; assumed).
    DARTS_PER_SPACING2 points per square of the spacing reach .52, that is .66 LEDs per square of the spacing, and a
    higher density along the rim.
    If a count is given instead, the result is the first `count` points accepted at the widest spacing that has room
    for them. Raises InputError for a spacing that makes more LEDs than fit into memory.
    """
    rng = random_stream(config.hardware_seed)
    half = np.radians(config.cap_deg)
    if config.spacing_m is None:
        count = config.count or 1
        darts_m = project_from_bearing(surface, scattered_cap(DARTS_PER_LED * count, half, rng))
        place_m = darts_m[optimize.spread(darts_m, 0.0, count, BISECTIONS)]
        return dimmed_sources(config.dimming, surface, place_m, led, band, rng)
    directions = cap(1000, half)
    points = project_from_bearing(surface, directions)
    # Surface area per steradian seen from the bearing, r^2 / cos(incidence). Where it is greatest, points uniform in
    # solid angle are sparsest on the surface, so this maximum sets how many are needed.
    slant = -np.einsum("nj,nj->n", surface.inward(points), directions)
    meters2_sr = np.sum(points**2, axis=1) / slant
    dart_count = DARTS_PER_SPACING2 * 2 * np.pi * (1 - np.cos(half)) * meters2_sr.max() / config.spacing_m**2
    if not 0 < dart_count <= MAX_DARTS:
        min_spacing_m = config.spacing_m * np.sqrt(dart_count / MAX_DARTS) if dart_count > 0 else np.inf
        raise InputError(
            f"light.layout.spacing: {config.spacing_m:g} m gives too many LEDs; allowed: {min_spacing_m:.3g} m or more"
        )
    darts_m = project_from_bearing(surface, scattered_cap(max(int(dart_count), 1), half, rng))
    place_m = darts_m[optimize.thin(darts_m, config.spacing_m)]
    return dimmed_sources(config.dimming, surface, place_m, led, band, rng)


def optimized(config: leds.OptimizedConfig, surface: Surface, led: leds.LedConfig, band: Band) -> Sources:
    """LEDs at the places that make the camera's worst attitudes most accurate: see `optimize.optimize_places`.

    No LED is placed where no attitude's field reaches. In the mean of the worst attitudes the layout is not worse
    than a Fibonacci spiral.
    """
    rng = random_stream(config.hardware_seed)
    options = optimize.OPTIONS
    reach = optimize.field_reach_rad(config, surface)
    sites = project_from_bearing(surface, scattered_cap(options.sites_per_led * config.count, reach, rng))
    spirals = [project_from_bearing(surface, cap(config.count, half)) for half in (np.radians(config.cap_deg), reach)]
    place_m = optimize.optimize_places(config, sites, spirals, rng, options)
    return dimmed_sources(config.dimming, surface, place_m, led, band, rng)


def celestial(config: leds.CelestialConfig, surface: Surface, led: leds.LedConfig, band: Band) -> Sources:
    """The real sky (JHU/APL's idea): an LED where the camera at its nominal place sees each of the brightest stars.

    LED numbers are Hipparcos numbers. Places are from `celestial.project_stars`, levels from `celestial.led_levels`.
    """
    stars = celestial_dome.project_stars(config, surface, led, band)
    normal = surface.inward(stars.place_m)
    level = celestial_dome.led_levels(config, stars, normal, led)
    placed = PlacedLeds(stars.hip, stars.place_m, normal, level, stars.v_mag)
    return led_sources(placed, led, band, random_stream(config.hardware_seed))


def listed(config: leds.ListedConfig, surface: Surface, led: leds.LedConfig, band: Band) -> Sources:
    """LEDs from a list or a CSV file: places in the lab, used unchanged, or directions from the bearing.

    Normals are the surface's. Raises InputError for a place more than 5 cm off the surface or beyond the cap.
    """
    level: Floats | None = np.array(config.levels or leds.relative_levels(config.magnitudes or ()))
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
    return table[:, :-1], last if brightness == "level" else np.array(leds.relative_levels(last.tolist()))


COLUMNS = (("x_m", "y_m", "z_m"), ("azimuth_deg", "tilt_deg"))


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


def fibers(config: leds.FibersConfig, surface: Surface, led: leds.LedConfig, band: Band) -> Sources:
    """Ends of optical fibers at another layout's points, with the shell's radius error: `display.displace_ends`."""
    return display.displace_ends(config, LAYOUTS[config.points.kind](config.points, surface, led, band))


def lcd(config: leds.LcdConfig, surface: Surface, led: leds.LedConfig, band: Band) -> Sources:
    """Another layout's LEDs drawn on the nearest pixels of a panel: `display.panel_sources`."""
    panel = display.panel_surface(config, surface)
    stars = LAYOUTS[config.points.kind](config.points, panel, display.ideal_led(led), band)
    return display.panel_sources(config, panel, led, band, stars)


# Arguments: its section of the scene, the surface, the LED type, the chip's band. Returns all LEDs.
LAYOUTS: dict[str, Callable[[Any, Surface, leds.LedConfig, Band], Sources]] = {
    "patch_boards": patch_boards,
    "fibonacci": fibonacci,
    "poisson_disk": poisson_disk,
    "random": random_places,
    "optimized": optimized,
    "celestial": celestial,
    "listed": listed,
    "fibers": fibers,
    "lcd": lcd,
}


def board_of(config: leds.Layout, led_ids: Ints) -> Ints | None:
    """(N,) board of each of these LED numbers; None if no two boards can be distinguished: no boards, or only one."""
    board = led_ids // HOLES
    return board if isinstance(config, leds.PatchBoardsConfig) and len(np.unique(board)) > 1 else None
