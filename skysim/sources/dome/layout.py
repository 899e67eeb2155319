"""LED layouts of a dome: where the LEDs are and how bright each is.

LAYOUTS maps the scene's `light.layout.kind` to a function that returns all LEDs as `Sources`. The kinds are patch
boards, even (Fibonacci), Poisson-disc, random and optimized spreads, the real sky, lists, and two that take the
points of another layout: optical fibers and an LCD panel.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree
from scipy.spatial.transform import Rotation

from skysim.core.errors import InputError
from skysim.core.types import Floats, Sources
from skysim.scene import leds
from skysim.sources.dome import celestial as celestial_dome
from skysim.sources.dome import display
from skysim.sources.dome.led import DRIVES, Lamps, full_e_s_sr
from skysim.sources.dome.placement import optimize
from skysim.sources.dome.surface import Inside
from skysim.sources.photometry import Band

HOLES = leds.HOLES  # on a patch board; LED number = board * HOLES + hole
GOLDEN_ANGLE_RAD = np.pi * (3 - np.sqrt(5))
GLUE = 1  # spawn key of the glue's own random stream, so that glue errors leave a board's pattern unchanged
TRIES = 100  # darts per square of the least spacing: a gap of .03 of that area is found with probability .95
MOST_TRIES = 3_000_000
DARTS = 30  # per LED of a count
HALVINGS = 14  # bisection steps from the dome's width: to some tenths of a millimeter
STANDS_OFF_M = 0.05  # of a listed LED from the surface; more is an error in a unit or an axis

Ints = NDArray[np.int64]


@dataclass(frozen=True, slots=True)
class Spots:
    """LED positions before drive and brightness are assigned.

    id        : (N,) LED numbers
    place_m   : (N, 3) in the lab;  normal : (N, 3) unit
    level     : (N,) share of full brightness, 0 < level <= 1
    magnitude : (N,) of the star that the LED represents; NaN if it represents none
    """

    id: Ints
    place_m: Floats
    normal: Floats
    level: Floats
    magnitude: Floats


@dataclass(frozen=True, slots=True)
class Boards:
    """Patch boards, (B, 3) each: center in the lab, m, unit normal, and unit vectors of the two axes of their holes."""

    middle_m: Floats
    normal: Floats
    u: Floats
    v: Floats


def lit(spots: Spots, led: leds.LedConfig, band: Band, rng: np.random.Generator) -> Sources:
    """The sources at these spots: strength with its scatter from LED to LED, and the drive's pulse timing.

    The strength is lognormal about the nominal one; the logarithm's standard deviation is led.scatter, for which
    AFIT's Table 2 gives .07 to .09. rng is the hardware's.
    """
    count = len(spots.id)
    scatter = np.exp(led.scatter * rng.standard_normal(count))
    strength = full_e_s_sr(led, band) * scatter
    pulses = DRIVES[led.drive.kind](led, Lamps(spots.level, spots.id // HOLES), rng)
    return Sources(
        id=spots.id,
        place=np.column_stack([spots.place_m, np.ones(count)]),
        normal=spots.normal,
        radius_m=np.full(count, led.disc_diameter_m / 2),
        strength=strength * pulses.strength,
        period_s=pulses.period_s,
        start_s=pulses.start_s,
        on_s=pulses.on_s,
        magnitude=spots.magnitude,
    )


def on_surface(inside: Inside, place_m: Floats, level: Floats) -> Spots:
    """Spots at (N, 3) places with the surface's normals there, numbered from 0."""
    number = np.arange(len(place_m), dtype=np.int64)
    return Spots(number, place_m, inside.inward(place_m), level, np.full(len(place_m), np.nan))


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


def rays(directions_deg: Any) -> Floats:
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
            f"{key}.{beyond[0]}: is {tilt_deg[beyond[0]]:.4g} deg from the zenith as the bearing's centre sees it;"
            f" allowed: light.layout.cap_deg, {cap_deg:g}"
        )


def from_bearing(inside: Inside, directions: Floats) -> Floats:
    """(N, 3) points where rays from the bearing's center meet the surface. Raises InputError where they miss it."""
    place_m = inside.meet(np.zeros(3), directions)
    if np.isnan(place_m).any():
        raise InputError(
            "light.layout: the surface ends within it; allowed: a smaller cap_deg, a rim farther out, or kind listed"
        )
    return place_m


def patch_boards(part: leds.PatchBoardsConfig, inside: Inside, led: leds.LedConfig, band: Band) -> Sources:
    """3x3 boards glued flat to the surface, listed or spread evenly, each with its own choice of LEDs and levels.

    A board is a plane tangent at its center, so its outer LEDs are off the surface, as on the real dome. The glue
    tilts the board, and each LED is displaced in the board's plane. Everything random here is hardware and is drawn
    from part.hardware_seed: which LEDs are soldered, their levels and strengths, the phases of their pulses.
    """
    rng = np.random.default_rng(part.hardware_seed)
    boards, holes, level = listed_boards(part, inside) if part.boards else spread_boards(part, inside, rng)
    board = np.concatenate([np.full(len(some), b) for b, some in enumerate(holes)])
    hole = np.concatenate(holes)
    if level is None:
        level = rng.choice(part.pwm_levels, len(board))
    glue = np.random.default_rng(np.random.SeedSequence(part.hardware_seed, spawn_key=(GLUE,)))
    if part.glue_tilt_deg:
        boards = tilted(boards, np.radians(part.glue_tilt_deg), glue)
    slip_m = part.glue_scatter_m * glue.standard_normal((2, len(board)))
    # Hole h is in column h % 3 and row h // 3; hole 4 is the center.
    place = (
        boards.middle_m[board]
        + ((hole % 3 - 1) * part.pitch_m + slip_m[0])[:, None] * boards.u[board]
        + ((hole // 3 - 1) * part.pitch_m + slip_m[1])[:, None] * boards.v[board]
    )
    number = (board * HOLES + hole).astype(np.int64)
    return lit(Spots(number, place, boards.normal[board], level, np.full(len(board), np.nan)), led, band, rng)


def spread_boards(
    part: leds.PatchBoardsConfig, inside: Inside, rng: np.random.Generator
) -> tuple[Boards, list[Ints], None]:
    """Boards all over the cap as seen from the bearing, and the holes that each uses.

    On a spiral each board has a random orientation; on a grid all are aligned with its rows.
    """
    half, spacing_m = np.radians(part.cap_deg), part.spacing_m or part.pitch_m
    apex_m = from_bearing(inside, np.array([[0.0, 0.0, 1.0]]))[0, 2]
    if part.spread == "grid":
        directions = grid(spacing_m / apex_m, half)
        turn = np.zeros(len(directions))
    else:
        # The cap's area on a sphere of the apex's height, over one square of the spacing per board.
        area_m2 = 2 * np.pi * apex_m**2 * (1 - np.cos(half))
        directions = cap(max(1, round(area_m2 / spacing_m**2)), half)
        turn = rng.uniform(0, 2 * np.pi, len(directions))
    boards = tangent(inside, from_bearing(inside, directions), turn)
    holes = [rng.permutation(HOLES)[: rng.integers(part.lit[0], part.lit[1] + 1)] for _ in range(len(turn))]
    return boards, holes, None


def grid(spacing_rad: float, half_angle_rad: float) -> Floats:
    """(N, 3) unit vectors in rows and columns over a cap about +z, one of them at +z.

    Equal steps on Lambert's equal-area map, where a direction at the angle t from the center is at radius 2 sin(t /
    2).
    """
    steps = int(2 * np.sin(half_angle_rad / 2) / spacing_rad)
    x, y = (one.ravel() * spacing_rad for one in np.meshgrid(*2 * [np.arange(-steps, steps + 1)]))
    out2 = x**2 + y**2
    within = out2 <= (2 * np.sin(half_angle_rad / 2)) ** 2
    x, y, out2 = x[within], y[within], out2[within]
    # Inverse of the map: at the radius rho, z = 1 - rho^2 / 2, at the distance rho sqrt(1 - rho^2 / 4) from the axis.
    stretch = np.sqrt(1 - out2 / 4)
    return np.column_stack([x * stretch, y * stretch, 1 - out2 / 2])


def listed_boards(part: leds.PatchBoardsConfig, inside: Inside) -> tuple[Boards, list[Ints], Floats]:
    """Boards at the listed places, their holes, and the level of every LED. Raises InputError if two boards overlap."""
    listed = part.boards
    directions = rays([(one.azimuth_deg, one.tilt_deg) for one in listed])
    check_cap("light.layout.boards", directions, part.cap_deg)
    middle_m = from_bearing(inside, directions)
    close = cKDTree(middle_m).query_pairs(3 * part.pitch_m * (1 - 1e-9))
    if close:
        first, second = min(close)
        away_m = np.linalg.norm(middle_m[first] - middle_m[second])
        raise InputError(
            f"light.layout.boards.{second}: overlaps board {first}, {away_m:.3g} m away; allowed:"
            f" {3 * part.pitch_m:.3g} m, three pitches"
        )
    boards = tangent(inside, middle_m, np.radians([one.turn_deg for one in listed]))
    level = np.concatenate([one.levels or np.ones(len(one.leds)) for one in listed])
    return boards, [np.array(one.leds, dtype=np.int64) for one in listed], level


def tangent(inside: Inside, middle_m: Floats, turn_rad: Floats) -> Boards:
    """Boards tangent to the surface. At turn 0 the holes' columns run along normal x (lab x)."""
    normal = inside.inward(middle_m)
    across = np.cross(normal, [1.0, 0.0, 0.0])
    edge_on = np.linalg.norm(across, axis=1) < 1e-9  # the normal is parallel to lab x
    across[edge_on] = [0.0, 1.0, 0.0]
    across /= np.linalg.norm(across, axis=1, keepdims=True)
    along = np.cross(normal, across)
    turn = turn_rad[:, None]
    u, v = across * np.cos(turn) + along * np.sin(turn), along * np.cos(turn) - across * np.sin(turn)
    return Boards(middle_m, normal, u, v)


def tilted(boards: Boards, most_rad: float, rng: np.random.Generator) -> Boards:
    """Boards tilted by the glue: normals uniform over a cap of most_rad about the surface's, centers unchanged."""
    count = len(boards.normal)
    angle = np.arccos(1 - rng.random(count) * (1 - np.cos(most_rad)))
    towards = rng.uniform(0, 2 * np.pi, count)[:, None]
    axis = boards.u * np.cos(towards) + boards.v * np.sin(towards)
    turn = Rotation.from_rotvec(angle[:, None] * axis)
    return replace(boards, normal=turn.apply(boards.normal), u=turn.apply(boards.u), v=turn.apply(boards.v))


def fibonacci(part: leds.FibonacciConfig, inside: Inside, led: leds.LedConfig, band: Band) -> Sources:
    """LEDs on a Fibonacci spiral: equal solid angles about the bearing hold equal numbers, to within a few."""
    rng = np.random.default_rng(part.hardware_seed)
    place_m = from_bearing(inside, cap(part.count, np.radians(part.cap_deg)))
    return lit(on_surface(inside, place_m, rng.choice(part.dimming, part.count)), led, band, rng)


def at_random(part: leds.RandomPlacesConfig, inside: Inside, led: leds.LedConfig, band: Band) -> Sources:
    """Independent LEDs, uniform in solid angle about the bearing: a Poisson field, like that of real stars."""
    rng = np.random.default_rng(part.hardware_seed)
    place_m = from_bearing(inside, scattered_cap(part.count, np.radians(part.cap_deg), rng))
    return lit(on_surface(inside, place_m, rng.choice(part.dimming, part.count)), led, band, rng)


def poisson_disc(part: leds.PoissonDiscConfig, inside: Inside, led: leds.LedConfig, band: Band) -> Sources:
    """LEDs at random with a least spacing, as many as fit: random sequential adsorption.

    Random points, uniform over the cap, are taken in turn; each is kept if no kept one is within the spacing. Discs
    of that diameter would jam at a coverage of .547 (Feder 1980, J. theor. Biol. 87, 237; assumed). TRIES points per
    square of the spacing reach .52, that is .66 LEDs per square of the spacing, and a higher density along the rim.
    If a count is given instead, the result is the first `count` of the points kept at the widest spacing that leaves
    room for them. Raises InputError for a spacing that makes more LEDs than fit into memory.
    """
    rng = np.random.default_rng(part.hardware_seed)
    half = np.radians(part.cap_deg)
    if part.spacing_m is None:
        count = part.count or 1
        darts_m = from_bearing(inside, scattered_cap(DARTS * count, half, rng))
        place_m = darts_m[optimize.evenly(darts_m, 0.0, count, HALVINGS)]
        return lit(on_surface(inside, place_m, rng.choice(part.dimming, count)), led, band, rng)
    directions = cap(1000, half)
    points = from_bearing(inside, directions)
    # Surface area per steradian seen from the bearing, r^2 / cos(incidence). Where it is greatest, points uniform in
    # solid angle are sparsest on the surface, so this maximum sets how many are needed.
    slant = -np.einsum("nj,nj->n", inside.inward(points), directions)
    metres2_sr = np.sum(points**2, axis=1) / slant
    tries = TRIES * 2 * np.pi * (1 - np.cos(half)) * metres2_sr.max() / part.spacing_m**2
    if not 0 < tries <= MOST_TRIES:
        least_m = part.spacing_m * np.sqrt(tries / MOST_TRIES) if tries > 0 else np.inf
        raise InputError(
            f"light.layout.spacing: {part.spacing_m:g} m makes too many LEDs; allowed: {least_m:.3g} m or more"
        )
    darts_m = from_bearing(inside, scattered_cap(max(int(tries), 1), half, rng))
    place_m = darts_m[optimize.apart(darts_m, part.spacing_m)]
    return lit(on_surface(inside, place_m, rng.choice(part.dimming, len(place_m))), led, band, rng)


def optimised(part: leds.OptimisedConfig, inside: Inside, led: leds.LedConfig, band: Band) -> Sources:
    """LEDs at the places that make the camera's worst attitudes most accurate: see `optimize.places`.

    No LED is placed where no attitude's field reaches. In the mean of the worst attitudes the layout is not worse
    than a Fibonacci spiral.
    """
    rng = np.random.default_rng(part.hardware_seed)
    reach = optimize.reach_rad(part, inside)
    sites = from_bearing(inside, scattered_cap(optimize.SITES_AN_LED * part.count, reach, rng))
    spirals = [from_bearing(inside, cap(part.count, half)) for half in (np.radians(part.cap_deg), reach)]
    place_m = optimize.places(part, sites, spirals, rng)
    return lit(on_surface(inside, place_m, rng.choice(part.dimming, part.count)), led, band, rng)


def celestial(part: leds.CelestialConfig, inside: Inside, led: leds.LedConfig, band: Band) -> Sources:
    """The real sky (JHU/APL's idea): an LED where the camera at its nominal place sees each of the brightest stars.

    LED numbers are Hipparcos numbers. Places are from `celestial.projected`, levels from `celestial.levels`.
    """
    stars = celestial_dome.projected(part, inside, led, band)
    normal = inside.inward(stars.place_m)
    level = celestial_dome.levels(part, stars, normal, led)
    spots = Spots(stars.hip, stars.place_m, normal, level, stars.v_mag)
    return lit(spots, led, band, np.random.default_rng(part.hardware_seed))


def listed(part: leds.ListedConfig, inside: Inside, led: leds.LedConfig, band: Band) -> Sources:
    """LEDs from a list or a CSV file: places in the lab, used as given, or directions from the bearing.

    Normals are the surface's. Raises InputError for a place more than 5 cm off the surface or beyond the cap.
    """
    level: Floats | None = np.array(part.levels or leds.levels_of(part.magnitudes or ()))
    key = "light.layout.positions" if part.positions_m else "light.layout.directions_deg"
    if part.file:
        key = part.file
        where, level = read_csv(Path(part.file))
    else:
        where = np.array(part.positions_m or part.directions_deg)
    directions = where if where.shape[1] == 3 else rays(where)
    check_cap(key, directions, part.cap_deg)
    place_m = where if where.shape[1] == 3 else from_bearing(inside, directions)
    check_near(key, inside, place_m)
    level = level if level is not None and len(level) else np.ones(len(place_m))
    return lit(on_surface(inside, place_m, level), led, band, np.random.default_rng(part.hardware_seed))


def check_near(key: str, inside: Inside, place_m: Floats) -> None:
    """Raise InputError for the first LED that is too far from the surface, along the ray from the bearing."""
    directions = place_m / np.linalg.norm(place_m, axis=1, keepdims=True)
    off_m = np.linalg.norm(from_bearing(inside, directions) - place_m, axis=1)
    far = np.flatnonzero(~(off_m <= STANDS_OFF_M))
    if len(far):
        raise InputError(
            f"{key}.{far[0]}: is {off_m[far[0]]:.3g} m off the surface; allowed: {STANDS_OFF_M:g} m"
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
    bright = names[-1] if names and names[-1] in ("level", "magnitude") else ""
    if names[: len(names) - bool(bright)] not in COLUMNS or len(lines) < 2:
        raise InputError(
            f"{path}: is no list of LEDs; allowed: columns {' or '.join(', '.join(some) for some in COLUMNS)}, then"
            " level or magnitude or neither, a line an LED"
        )
    table = np.array([numbers(path, n, line, len(names), bright) for n, line in lines[1:]])
    if not bright:
        return table, None
    last = table[:, -1]
    return table[:, :-1], last if bright == "level" else np.array(leds.levels_of(last.tolist()))


COLUMNS = (("x_m", "y_m", "z_m"), ("azimuth_deg", "tilt_deg"))


def numbers(path: Path, number: int, line: str, count: int, bright: str) -> list[float]:
    """The numbers of one line of an LED file. Raises InputError."""
    try:
        row = [float(cell) for cell in line.split(",")]
    except ValueError:
        row = []
    if len(row) != count or not np.all(np.isfinite(row)) or (bright == "level" and not 0 < row[-1] <= 1):
        raise InputError(
            f"{path}, line {number}: {line!r} is no LED; allowed: {count} numbers, a level above 0 and not above 1"
        )
    return row


def fibres(part: leds.FibresConfig, inside: Inside, led: leds.LedConfig, band: Band) -> Sources:
    """Ends of optical fibers at another layout's points, with the shell's radius error: `display.standing_off`."""
    return display.standing_off(part, LAYOUTS[part.points.kind](part.points, inside, led, band))


def lcd(part: leds.LcdConfig, inside: Inside, led: leds.LedConfig, band: Band) -> Sources:
    """Another layout's LEDs drawn on the nearest pixels of a panel: `display.on_panel`."""
    glass = display.glass(part, inside)
    wanted = LAYOUTS[part.points.kind](part.points, glass, display.steady(led), band)
    return display.on_panel(part, glass, led, band, wanted)


# Each takes (its section of the scene, the surface, the LED type, the chip's band) and returns all LEDs.
LAYOUTS: dict[str, Callable[[Any, Inside, leds.LedConfig, Band], Sources]] = {
    "patch_boards": patch_boards,
    "fibonacci": fibonacci,
    "poisson_disc": poisson_disc,
    "random": at_random,
    "optimised": optimised,
    "celestial": celestial,
    "listed": listed,
    "fibres": fibres,
    "lcd": lcd,
}


def board_of(part: leds.Layout, numbers: Ints) -> Ints | None:
    """(N,) board of each of these LED numbers; None if no two boards can be distinguished: no boards, or only one."""
    board = numbers // HOLES
    return board if isinstance(part, leds.PatchBoardsConfig) and len(np.unique(board)) > 1 else None
