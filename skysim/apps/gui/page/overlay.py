"""Overlay of a frame: marks as SVG paths in the frame's pixels. Each kind can be switched off."""

from __future__ import annotations

from collections.abc import Callable, Collection, Mapping
from typing import Any

from skysim.apps.gui.messages import Detection, Light, TrackerResult

COLORS = {
    **{"truth": "#5aa9ff", "detected": "#ff7b6b", "identified": "#6fdc7f", "false": "#ffc04d"},
    "windows": "#7f8a9a",
}
KINDS = tuple(COLORS)
MAX_LABELS = 40  # most labels; the brightest lights get them
MAX_TRUTH_MARKS = 400  # most marks of true lights
NEAR_PX = 4.0  # a detection within this distance of a true light is not false
# Smallest size of the frame on the screen, in screen pixels: marks and names must be readable there.
SCREEN_PX = (806.0, 511.0)
MARK_PX, FONT_PX = 5.2, 10.0
LETTER = 0.61  # width of a letter over its font size


def marks(
    lights: Collection[Light],
    result: TrackerResult | None,
    size_px: tuple[int, int],
    shown: Collection[str],
    name: Callable[[int], str],
) -> list[dict[str, Any]]:
    """Marks of a frame: ticks for true lights, squares for detections, circles and names for identified ones, crosses
    for false ones, dashed squares for predicted windows.

    Each kind is one SVG path with its style for frame.js: color, width, dash, font, names (x, y, text).
    """
    scale = max(size_px[0] / SCREEN_PX[0], size_px[1] / SCREEN_PX[1])
    size, font = MARK_PX * scale, FONT_PX * scale
    detections = result.detections if result else ()
    identified = [detection for detection in detections if detection.id >= 0]
    paths: Mapping[str, list[str]] = {
        "windows": [box(x, y, 2.2 * size) for x, y in result.windows_px] if result else [],
        "truth": [ticks(light.x, light.y, size) for light in list(lights)[:MAX_TRUTH_MARKS]],
        "detected": [box(detection.x, detection.y, size) for detection in detections],
        "identified": [circle(detection.x, detection.y, 1.6 * size) for detection in identified],
        "false": [cross(detection.x, detection.y, size) for detection in false_detections(detections, lights)],
    }
    names = labels(identified[:MAX_LABELS], size, font, size_px, name) if "identified" in shown else []
    return [
        {
            **{"kind": kind, "path": "".join(paths[kind]), "names": names if kind == "identified" else []},
            **{"color": COLORS[kind], "width": round(size / 6, 2), "font": round(font, 1)},
            "dash": [round(size / 2, 1)] if kind == "windows" else [],
        }
        for kind in KINDS
        if kind in shown and paths[kind]
    ]


def false_detections(detections: Collection[Detection], lights: Collection[Light]) -> list[Detection]:
    """Detections that have no true light within NEAR_PX; none if the truth is unknown."""
    if not lights:
        return []
    return [
        detection
        for detection in detections
        if not any(abs(light.x - detection.x) < NEAR_PX and abs(light.y - detection.y) < NEAR_PX for light in lights)
    ]


def ticks(x: float, y: float, size: float) -> str:
    """Four strokes around an open center. Half a pixel is added: integers are pixel centers here, corners in SVG."""
    x, y, near, length = x + 0.5, y + 0.5, 0.6 * size, 0.6 * size
    far = near + length
    return (
        f"M{x - far:.1f} {y:.1f}h{length:.1f}M{x + near:.1f} {y:.1f}h{length:.1f}"
        f"M{x:.1f} {y - far:.1f}v{length:.1f}M{x:.1f} {y + near:.1f}v{length:.1f}"
    )


def box(x: float, y: float, half: float) -> str:
    side = 2 * half
    return f"M{x + 0.5 - half:.1f} {y + 0.5 - half:.1f}h{side:.1f}v{side:.1f}h{-side:.1f}z"


def circle(x: float, y: float, radius: float) -> str:
    """A circle as two semicircular arcs."""
    half = f"a{radius:.1f} {radius:.1f} 0 1 0"
    return f"M{x + 0.5 - radius:.1f} {y + 0.5:.1f}{half} {2 * radius:.1f} 0{half} {-2 * radius:.1f} 0"


def cross(x: float, y: float, size: float) -> str:
    x, y, side = x + 0.5 - size, y + 0.5 - size, 2 * size
    return f"M{x:.1f} {y:.1f}l{side:.1f} {side:.1f}M{x:.1f} {y + side:.1f}l{side:.1f} {-side:.1f}"


def labels(
    detections: Collection[Detection], size: float, font: float, size_px: tuple[int, int], name: Callable[[int], str]
) -> list[tuple[float, float, str]]:
    """Place labels without overlap: (x, y, name) to the right or left of a detection, above or below it, or none.

    The first free position inside the frame is used, and earlier detections choose first. The occupied area is a
    bitmap of cells of half the font size: one integer per row, one bit per column.
    """
    side, occupied = font / 2, dict[int, int]()
    # The marks themselves occupy space first, so that no label covers one.
    for detection in detections:
        x, y, half = detection.x + 0.5, detection.y + 0.5, 0.9 * size
        reserve(occupied, max(x - half, 0.0), max(y - half, 0.0), x + half, y + half, side)
    placed = []
    for detection in detections:
        text, x, y = name(detection.id), detection.x + 0.5, detection.y + 0.5
        width, gap = LETTER * font * len(text), 2 * size
        level, above, below = y + 0.35 * font, y - gap, y + gap + 0.7 * font
        for left, base in (
            *((x + gap, level), (x - gap - width, level)),
            *((x - width / 2, above), (x - width / 2, below)),
        ):
            left = max(min(left, size_px[0] - width), 0.0)
            base = max(min(base, size_px[1] - 0.25 * font), 0.75 * font)
            if reserve(occupied, left, base - 0.75 * font, left + width, base, side):
                placed.append((round(left, 1), round(base, 1), text))
                break
    return placed


def reserve(occupied: dict[int, int], left: float, top: float, right: float, bottom: float, side: float) -> bool:
    """Mark the cells of a box as occupied; return False, and mark none, if one of them is occupied already."""
    first = max(int(left / side), 0)
    # Bits first..last of a row.
    bits = (2 << (int(right / side) - first)) - 1 << first
    rows = range(int(top / side), int(bottom / side) + 1)
    if any(occupied.get(row, 0) & bits for row in rows):
        return False
    for row in rows:
        occupied[row] = occupied.get(row, 0) | bits
    return True


def pixels_svg(
    dn: tuple[tuple[int, ...], ...], detections: Collection[Detection], x0: int, y0: int, height: int
) -> str:
    """SVG of enlarged pixels with their values, and crosses at the centroids. height : in screen pixels."""
    rows, columns = len(dn), len(dn[0])
    cell, width = height / rows, columns * height / rows
    low, high = min(map(min, dn)), max(map(max, dn))
    digits = len(str(high))
    font = min(0.46 * cell, 0.94 * cell / (LETTER * digits))
    elements = [
        pixel_svg(x, y, value, ((value - low) / max(high - low, 1)) ** 0.5, cell, (x0, y0))
        for y, row in enumerate(dn)
        for x, value in enumerate(row)
    ]
    for detection in detections:
        along, down = (detection.x - x0 + 0.5) * cell, (detection.y - y0 + 0.5) * cell
        if 0 < along < width and 0 < down < height:
            style = f'stroke="{COLORS["detected"]}" stroke-width="1.5"'
            elements.append(f'<path d="M{along - 8:.1f} {down:.1f}h16M{along:.1f} {down - 8:.1f}v16" {style}/>')
    box_px = f'viewBox="0 0 {width:.1f} {height}" width="{width:.1f}" height="{height}"'
    letter = f'font-family="ui-monospace, monospace" font-size="{font:.1f}" text-anchor="middle"'
    return f"<svg {box_px} {letter}>{''.join(elements)}</svg>"


def pixel_svg(x: int, y: int, dn: int, brightness: float, cell: float, first: tuple[int, int]) -> str:
    """SVG of one enlarged pixel: a square, its value, and its coordinates as a tooltip."""
    gray = round(255 * brightness)
    square = f'x="{x * cell:.1f}" y="{y * cell:.1f}" width="{cell:.1f}" height="{cell:.1f}"'
    text_attributes = (
        f'x="{(x + 0.5) * cell:.1f}" y="{(y + 0.64) * cell:.1f}" fill="{"#000" if gray > 120 else "#b6bfcd"}"'
    )
    return (
        f"<g><title>x {first[0] + x}, y {first[1] + y}: {dn} DN</title>"
        f'<rect {square} fill="rgb({gray},{gray},{gray})"/><text {text_attributes}>{dn}</text></g>'
    )
