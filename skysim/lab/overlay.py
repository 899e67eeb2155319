"""What is drawn over a frame, as paths in the frame's pixels; every kind can be switched off."""

from __future__ import annotations

from collections.abc import Callable, Collection, Mapping
from typing import Any

from skysim.lab.views import Answer, Light, Spot

INK = {
    **{"truth": "#5aa9ff", "detected": "#ff7b6b", "identified": "#6fdc7f", "false": "#ffc04d"},
    "windows": "#7f8a9a",
}
KINDS = tuple(INK)
NAMED = 40  # labels at most: the brightest
MARKED = 400  # true lights at most
NEAR_PX = 4.0  # within which a spot is a true light's


def marks(
    lights: Collection[Light],
    answer: Answer | None,
    width_px: int,
    shown: Collection[str],
    name: Callable[[int], str],
) -> list[dict[str, Any]]:
    """The marks of a look: truth ticked, detections squared, identified circled and named, false crossed, windows.

    A kind is one path as SVG writes it, with what frame.js draws it by: ink, width, dash, font, names (x, y, text).
    """
    size = max(4.0, width_px / 130)
    spots = answer.spots if answer else ()
    known = [spot for spot in spots if spot.id >= 0]
    drawn: Mapping[str, list[str]] = {
        "windows": [box(x, y, 2.2 * size) for x, y in answer.windows_px] if answer else [],
        "truth": [ticks(light.x, light.y, size) for light in list(lights)[:MARKED]],
        "detected": [box(spot.x, spot.y, size) for spot in spots],
        "identified": [circle(one.x, one.y, 1.6 * size) for one in known],
        "false": [cross(one.x, one.y, size) for one in false(spots, lights)],
    }
    names = [label(one, size, name(one.id)) for one in known[:NAMED]]
    return [
        {
            **{"kind": kind, "path": "".join(drawn[kind]), "names": names if kind == "identified" else []},
            **{"ink": INK[kind], "width": round(size / 6, 2), "font": round(1.8 * size, 1)},
            "dash": [round(size / 2, 1)] if kind == "windows" else [],
        }
        for kind in KINDS
        if kind in shown and drawn[kind]
    ]


def false(spots: Collection[Spot], lights: Collection[Light]) -> list[Spot]:
    """What was seen where no true light is."""
    if not lights:
        return []
    return [
        spot
        for spot in spots
        if not any(abs(one.x - spot.x) < NEAR_PX and abs(one.y - spot.y) < NEAR_PX for one in lights)
    ]


def ticks(x: float, y: float, size: float) -> str:
    """Four strokes that leave the middle open. An integer is a pixel's centre; SVG's is its corner."""
    x, y, near, long = x + 0.5, y + 0.5, 0.6 * size, 0.6 * size
    far = near + long
    return (
        f"M{x - far:.1f} {y:.1f}h{long:.1f}M{x + near:.1f} {y:.1f}h{long:.1f}"
        f"M{x:.1f} {y - far:.1f}v{long:.1f}M{x:.1f} {y + near:.1f}v{long:.1f}"
    )


def box(x: float, y: float, half: float) -> str:
    side = 2 * half
    return f"M{x + 0.5 - half:.1f} {y + 0.5 - half:.1f}h{side:.1f}v{side:.1f}h{-side:.1f}z"


def circle(x: float, y: float, radius: float) -> str:
    """Two half circles."""
    half = f"a{radius:.1f} {radius:.1f} 0 1 0"
    return f"M{x + 0.5 - radius:.1f} {y + 0.5:.1f}{half} {2 * radius:.1f} 0{half} {-2 * radius:.1f} 0"


def cross(x: float, y: float, size: float) -> str:
    x, y, side = x + 0.5 - size, y + 0.5 - size, 2 * size
    return f"M{x:.1f} {y:.1f}l{side:.1f} {side:.1f}M{x:.1f} {y + side:.1f}l{side:.1f} {-side:.1f}"


def label(spot: Spot, size: float, text: str) -> tuple[float, float, str]:
    """A name beside its circle."""
    return round(spot.x + 0.5 + 2 * size, 1), round(spot.y + 0.5 + 0.6 * size, 1), text


def magnified(dn: tuple[tuple[int, ...], ...], spots: Collection[Spot], x0: int, y0: int, side: int) -> str:
    """Pixels as squares with their numbers, and crosses at the centroids among them."""
    rows, columns = len(dn), len(dn[0])
    cell = side / max(rows, columns)
    low, high = min(map(min, dn)), max(map(max, dn))
    reach = max(high - low, 1)
    parts = []
    for y, row in enumerate(dn):
        for x, value in enumerate(row):
            grey = round(255 * ((value - low) / reach) ** 0.5)
            at = f'x="{x * cell:.1f}" y="{y * cell:.1f}"'
            parts.append(
                f'<rect {at} width="{cell:.1f}" height="{cell:.1f}" fill="rgb({grey},{grey},{grey})"/>'
            )
            ink = "#000" if grey > 140 else "#99a3b3"
            place = f'x="{(x + 0.5) * cell:.1f}" y="{(y + 0.62) * cell:.1f}"'
            parts.append(
                f'<text {place} font-size="{cell / 2.9:.1f}" text-anchor="middle" fill="{ink}">{value}</text>'
            )
    for spot in spots:
        along, down = (spot.x - x0 + 0.5) * cell, (spot.y - y0 + 0.5) * cell
        if 0 < along < side and 0 < down < side:
            look = f'stroke="{INK["detected"]}" stroke-width="1.2"'
            parts.append(f'<path d="M{along - 6:.1f} {down:.1f}h12M{along:.1f} {down - 6:.1f}v12" {look}/>')
    box_px = f'viewBox="0 0 {side} {side}" width="{side}" height="{side}"'
    return f'<svg {box_px} font-family="monospace">{"".join(parts)}</svg>'
