"""Patch boards: 3x3 LED boards glued to the surface, spread evenly, on a grid, or listed."""

from typing import NamedTuple

import numpy as np
from numpy.random import Generator
from scipy.spatial import cKDTree
from scipy.spatial.transform import Rotation

from skysim.core.errors import InputError
from skysim.core.random_streams import random_stream
from skysim.core.types import UP, Floats, lengths, normalized
from skysim.core.units import scaled_errors
from skysim.scene.sections.layouts import HOLES, PatchBoardsConfig
from skysim.sources.dome.layouts.placing import (
    Ints,
    PlacedLeds,
    cap,
    check_cap,
    directions_from_angles,
    project_from_bearing,
)
from skysim.sources.dome.surface import Surface

GLUE_STREAM = 1  # spawn key of the glue's own random stream, so that glue errors leave a board's pattern unchanged


class Boards(NamedTuple):
    """B patch boards.

    Attributes
    ----------
    center_m
        (B, 3) centers in the lab
    normal
        (B, 3) unit normals
    u, v
        (B, 3) unit vectors along the two axes of the holes
    """

    center_m: Floats
    normal: Floats
    u: Floats
    v: Floats


def patch_boards(config: PatchBoardsConfig, surface: Surface, rng: Generator) -> PlacedLeds:
    """3x3 boards glued flat to the surface, listed or spread evenly, each with its own choice of LEDs and levels.

    A board is a plane tangent at its center, so its outer LEDs are off the surface, as on the real dome. Everything
    random here is hardware and is drawn from config.hardware_seed: which LEDs are soldered, their levels and strengths,
    the phases of their pulses.

    1. Places and orientations of the boards, and the holes that each uses.
    2. The glue tilts each board, and displaces each LED in the board's plane.
    3. Places of the LEDs: hole h is in column h % 3 and row h // 3; hole 4 is the center.
    """
    # 1.
    level: Floats | None
    if config.boards:
        boards, holes, level = listed_boards(config, surface)
    else:
        boards, holes = spread_boards(config, surface, rng)
        level = rng.choice(config.pwm_levels, sum(map(len, holes)))
    board = np.repeat(np.arange(len(holes)), [len(board_holes) for board_holes in holes])
    hole = np.concatenate(holes)
    # 2.
    glue = random_stream(config.hardware_seed, GLUE_STREAM)
    if config.glue_tilt_deg:
        boards = tilt_boards(boards, np.radians(config.glue_tilt_deg), glue)
    displacement_m = scaled_errors(
        config.glue_scatter_m, glue.standard_normal((2, len(board)))
    )
    # 3.
    place = (
        boards.center_m[board]
        + ((hole % 3 - 1) * config.pitch_m + displacement_m[0])[:, None] * boards.u[board]
        + ((hole // 3 - 1) * config.pitch_m + displacement_m[1])[:, None] * boards.v[board]
    )
    number = (board * HOLES + hole).astype(np.int64)
    types = [name for each in config.boards for name in each.types or [""] * len(each.leds)]
    return PlacedLeds(
        number, place, boards.normal[board], level, np.full(len(board), np.nan), types
    )


def spread_boards(
    config: PatchBoardsConfig, surface: Surface, rng: Generator
) -> tuple[Boards, list[Ints]]:
    """Boards all over the cap as seen from the bearing, and the holes that each uses.

    On a spiral each board has a random orientation; on a grid all are aligned with its rows.
    """
    half = np.radians(config.cap_deg)
    spacing_m = config.spacing_m or config.pitch_m
    apex_m = project_from_bearing(surface, UP[None])[0, 2]
    if config.spread == "grid":
        directions = grid(spacing_m / apex_m, half)
        rotation = np.zeros(len(directions))
    else:
        # The cap's area on a sphere of the apex's height, over one square of the spacing per board.
        area_m2 = 2 * np.pi * apex_m**2 * (1 - np.cos(half))
        directions = cap(max(1, round(area_m2 / spacing_m**2)), half)
        rotation = rng.uniform(0, 2 * np.pi, len(directions))
    boards = tangent_boards(surface, project_from_bearing(surface, directions), rotation)
    # A random choice of holes, as many as `lit` allows.
    holes = [
        rng.permutation(HOLES)[: rng.integers(config.lit[0], config.lit[1] + 1)]
        for _ in range(len(rotation))
    ]
    return boards, holes


def grid(spacing_rad: float, half_angle_rad: float) -> Floats:
    """(N, 3) unit vectors in rows and columns over a cap about +z, one of them at +z.

    Equal steps on Lambert's equal-area map, where a direction at the angle t from the center is at radius 2 sin(t / 2).
    """
    steps = int(2 * np.sin(half_angle_rad / 2) / spacing_rad)
    axis = np.arange(-steps, steps + 1)
    x, y = (side.ravel() * spacing_rad for side in np.meshgrid(axis, axis))
    radius2 = x**2 + y**2
    within = radius2 <= (2 * np.sin(half_angle_rad / 2)) ** 2
    x = x[within]
    y = y[within]
    radius2 = radius2[within]
    # Inverse of the map: at the radius rho, z = 1 - rho^2 / 2, at the distance rho sqrt(1 - rho^2 / 4) from the axis.
    scale = np.sqrt(1 - radius2 / 4)
    return np.column_stack([x * scale, y * scale, 1 - radius2 / 2])


def listed_boards(
    config: PatchBoardsConfig, surface: Surface
) -> tuple[Boards, list[Ints], Floats]:
    """Boards at the listed places, their holes, and the level of every LED.

    Raises
    ------
    InputError
        If two boards overlap, or one is outside the cap.
    """
    listed = config.boards
    directions = directions_from_angles(
        [(board.azimuth_deg, board.tilt_deg) for board in listed]
    )
    check_cap(
        [f"light.layout.boards.{n}" for n in range(len(listed))], directions, config.cap_deg
    )
    center_m = project_from_bearing(surface, directions)
    close = cKDTree(center_m).query_pairs(3 * config.pitch_m * (1 - 1e-9))
    if close:
        first, second = min(close)
        distance_m = np.linalg.norm(center_m[first] - center_m[second])
        raise InputError(
            f"light.layout.boards.{second}",
            f"overlaps board {first}, {distance_m:.3g} m away",
            f"{3 * config.pitch_m:.3g} m, three pitches",
        )
    boards = tangent_boards(
        surface, center_m, np.radians([board.rotation_deg for board in listed])
    )
    level = np.concatenate([board.levels or np.ones(len(board.leds)) for board in listed])
    return boards, [np.array(board.leds, dtype=np.int64) for board in listed], level


def tangent_boards(surface: Surface, center_m: Floats, rotation_rad: Floats) -> Boards:
    """Boards tangent to the surface. At rotation 0 the holes' columns run along normal x (lab x)."""
    normal = surface.inward(center_m)
    across = np.cross(normal, [1.0, 0.0, 0.0])
    # The normal is parallel to lab x.
    edge_on = lengths(across) < 1e-9
    across[edge_on] = [0.0, 1.0, 0.0]
    across = normalized(across)
    along = np.cross(normal, across)
    rotation = rotation_rad[:, None]
    u = across * np.cos(rotation) + along * np.sin(rotation)
    v = along * np.cos(rotation) - across * np.sin(rotation)
    return Boards(center_m, normal, u, v)


def tilt_boards(boards: Boards, max_rad: float, rng: Generator) -> Boards:
    """Boards tilted by the glue: normals uniform over a cap of max_rad about the surface's, centers unchanged."""
    count = len(boards.normal)
    # A tilt uniform in solid angle, about a random axis in the board's plane.
    angle = np.arccos(1 - rng.random(count) * (1 - np.cos(max_rad)))
    azimuth = rng.uniform(0, 2 * np.pi, count)[:, None]
    axis = boards.u * np.cos(azimuth) + boards.v * np.sin(azimuth)
    rotation = Rotation.from_rotvec(angle[:, None] * axis)
    return Boards(boards.center_m, *map(rotation.apply, boards[1:]))
