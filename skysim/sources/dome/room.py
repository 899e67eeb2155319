"""Fit of a dome into the room where it is to be built: under the ceiling, between the walls, through the door.

The shell is sampled along meridians about the vertical through the bearing, on its inner surface and on the outer
one, `thickness` outside. The rim and the apex are among the samples, and between samples 2 deg apart on a meridian a
shell bulges by 1.5e-4 of its radius at most.
"""

import numpy as np

from skysim.core.errors import InputError
from skysim.core.types import UP, Bools, Floats, Record
from skysim.scene.sections.light import RoomConfig
from skysim.sources.dome.surface import Plane, Surface, directions

TILTS = 91  # from the zenith to the nadir
MERIDIANS = 72  # of the whole shell, divisible by 4
MERIDIANS_OF_PART = 17  # of one part, its edges and its middle included
BISECTIONS = 40
TURNS = 91  # orientations of the box about a part, from 0 to 90 deg
PROPOSED_SEGMENTS = (2, 3, 4, 5, 6, 8, 10, 12, 16, 20, 24)  # in the message about a door
# Azimuths of the whole shell.
ALL_ROUND_RAD = np.linspace(0.0, 2 * np.pi, MERIDIANS, endpoint=False)


def check_room(room: RoomConfig, surface: Surface, cap_deg: float) -> None:
    """Raise InputError, one line with the size and the limit, for a dome that does not fit into the room."""
    found = fit(room, surface, cap_deg)
    # Heights above the floor, if the bearing's height is known.
    if room.bearing_height_m is not None:
        top_m = found["top_m"]
        bottom_m = found["rim_m"]
        if room.height_m is not None and top_m > room.height_m:
            raise InputError(
                "light.room.height",
                f"the dome's top is {top_m:.3f} m above the floor",
                f"{room.height_m:.3f} m, the ceiling",
            )
        if bottom_m < 0:
            raise InputError(
                "light.room.bearing_height",
                f"{room.bearing_height_m:.3f} m puts the dome's rim {-bottom_m:.3f} m below the floor",
                f"{room.bearing_height_m - bottom_m:.3f} m or more, or a higher rim",
            )
    # Widths between the walls.
    for axis, (key, limit_m) in enumerate(
        (("width", room.width_m), ("length", room.length_m))
    ):
        if limit_m is not None and found["extent_m"][axis] > limit_m:
            raise InputError(
                f"light.room.{key}",
                f"the dome is {found['extent_m'][axis]:.3f} m wide along {'xy'[axis]}",
                f"{limit_m:.3f} m, the room",
            )
    if room.door_m is not None:
        check_door(room, room.door_m, found["part_m"], surface, cap_deg)


def fit(room: RoomConfig, surface: Surface, cap_deg: float) -> Record:
    """Sizes of a dome in its room in m, as a dict.

    `extent_m`: (3,) along x, y, z, thickness included. `top_m`, `rim_m`: heights above the floor, if the room has
    bearing_height. `part_m`: sides of the box about the part that fits the door least, ascending, if the room has a
    door.
    """
    points_m = shell_m(room, surface, cap_deg, ALL_ROUND_RAD)
    low_m = points_m.min(axis=0)
    high_m = points_m.max(axis=0)
    found: Record = {"extent_m": (high_m - low_m).tolist()}
    if room.bearing_height_m is not None:
        found["top_m"] = room.bearing_height_m + float(high_m[2])
        found["rim_m"] = room.bearing_height_m + float(low_m[2])
    if room.door_m is not None:
        box_m, _ = largest_part_m(room, room.door_m, surface, cap_deg, room.segments)
        found["part_m"] = box_m.tolist()
    return found


def check_door(
    room: RoomConfig,
    door_m: tuple[float, float],
    box_m: list[float],
    surface: Surface,
    cap_deg: float,
) -> None:
    """Raise InputError if the largest part of the shell, with a box of these sides, does not go through the door."""
    if np.all(box_m[:2] <= np.sort(door_m)):
        return
    # The least number of segments that would fit is part of the message.
    more = [n for n in PROPOSED_SEGMENTS if n > room.segments]
    enough = next(
        (n for n in more if largest_part_m(room, door_m, surface, cap_deg, n)[1] <= 1), None
    )
    sides = " x ".join(f"{side:.3f}" for side in box_m)
    whole = (
        "the shell"
        if room.segments == 1
        else f"a part of the shell in {room.segments} segments"
    )
    raise InputError(
        "light.room.door",
        f"{whole} is {sides} m",
        f"two of its sides within {door_m[0]:.3f} x {door_m[1]:.3f} m"
        + (f", or segments: {enough}" if enough else ""),
    )


def largest_part_m(
    room: RoomConfig,
    door_m: tuple[float, float],
    surface: Surface,
    cap_deg: float,
    segments: int,
) -> tuple[Floats, float]:
    """The part of the shell that fits the door least: ascending sides of its box, and its ratio to the door."""
    if segments == 1:
        return best_box(shell_m(room, surface, cap_deg, ALL_ROUND_RAD), 0.0, door_m)
    width_rad = 2 * np.pi / segments
    boxes = []
    for part in range(segments):
        azimuth_rad = width_rad * (part + np.linspace(0.0, 1.0, MERIDIANS_OF_PART))
        part_m = shell_m(room, surface, cap_deg, azimuth_rad)
        boxes.append(best_box(part_m, width_rad * (part + 0.5), door_m))
    return max(boxes, key=lambda box: box[1])


def best_box(
    points_m: Floats, middle_rad: float, door_m: tuple[float, float]
) -> tuple[Floats, float]:
    """The box about (N, 3) points that goes best through the door: ascending sides in m, and the ratio to the door.

    A box goes through if its smallest side is within the door's smaller one and its next within the larger one; the
    ratio is the greater of the two.

    Parameters
    ----------
    middle_rad
        Azimuth of the vertical plane in which the box is turned, that of the part's middle
    """
    # Axes of the box at each orientation: one stays level, two turn in the vertical plane.
    across = np.array([-np.sin(middle_rad), np.cos(middle_rad), 0.0])
    outward = np.array([np.cos(middle_rad), np.sin(middle_rad), 0.0])
    turn = np.linspace(0, np.pi / 2, TURNS)[:, None]
    first = np.cos(turn) * outward + np.sin(turn) * UP
    second = -np.sin(turn) * outward + np.cos(turn) * UP
    # Sides along the three axes.
    sides_m = np.column_stack([np.ptp(points_m @ axes.T, axis=0) for axes in (first, second)])
    sides_m = np.sort(
        np.column_stack([sides_m, np.full(TURNS, np.ptp(points_m @ across))]), axis=1
    )
    ratio = (sides_m[:, :2] / np.sort(door_m)).max(axis=1)
    best = int(ratio.argmin())
    return sides_m[best], float(ratio[best])


def shell_m(
    room: RoomConfig, surface: Surface, cap_deg: float, azimuth_rad: Floats
) -> Floats:
    """(N, 3) points of the shell on meridians of these azimuths about the bearing, inside and outside.

    1. Sample each meridian at equal steps of the angle from the zenith.
    2. Find the angles where the shell begins and ends, to 1e-13 rad by bisection.
    3. Add the outer surface.

    Raises
    ------
    InputError
        If the shell has no part on the meridians.
    """
    # 1. A surface without a rim is cut at the cap.
    ends = (
        np.isfinite(surface.half_m).all()
        if isinstance(surface, Plane)
        else not surface.rim.unbounded
    )
    limit_rad = np.pi if ends else np.radians(cap_deg)
    tilt_rad = np.linspace(0, limit_rad, TILTS)
    met = meet(surface, tilt_rad[:, None], azimuth_rad)
    on_shell = np.isfinite(met[..., 0])
    edges = []
    # 2. A neighbor that is not on the shell: above, or below.
    for step in (1, -1):
        inner, column = np.nonzero(on_shell & ~np.roll(on_shell, step, axis=0))
        outer = inner - step
        inside = (outer >= 0) & (outer < TILTS)
        inner = inner[inside]
        outer = outer[inside]
        column = column[inside]
        edges.append(
            find_edges(surface, tilt_rad[inner], tilt_rad[outer], azimuth_rad[column])
        )
    points_m = np.concatenate([met[on_shell], *edges])
    if not len(points_m):
        raise InputError(
            "light.room", "the dome has no shell within cap_deg", "a surface over the bearing"
        )
    # 3.
    return np.concatenate([points_m, points_m - room.thickness_m * surface.inward(points_m)])


def meet(surface: Surface, tilt_rad: Floats, azimuth_rad: Floats) -> Floats:
    """(..., 3) points where rays from the bearing meet the surface; NaN where they miss."""
    return surface.from_bearing(directions(tilt_rad, azimuth_rad))


def find_edges(
    surface: Surface, on_rad: Floats, off_rad: Floats, azimuth_rad: Floats
) -> Floats:
    """(N, 3) last points of the shell between tilts on it and tilts off it, by bisection."""
    for _ in range(BISECTIONS):
        middle_rad = (on_rad + off_rad) / 2
        met: Bools = np.isfinite(meet(surface, middle_rad, azimuth_rad)[:, 0])
        on_rad = np.where(met, middle_rad, on_rad)
        off_rad = np.where(met, off_rad, middle_rad)
    return meet(surface, on_rad, azimuth_rad)
