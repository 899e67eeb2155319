"""A flat drawing in millimeters, as SVG to print and as DXF for a cutter.

DXF is ASCII of AutoCAD's release 12 (AC1009), which all CAD programs read: POLYLINE, CIRCLE and TEXT with group codes
on lines of their own (Autodesk 1992, AutoCAD Release 12 Customization Manual, chapter 11). Its y axis points up.
"""

from __future__ import annotations

from collections.abc import Iterator
from html import escape
from typing import NamedTuple
from skysim.core.types import Floats



class Path(NamedTuple):
    """A polyline through (K, 2) points."""

    xy_mm: Floats
    closed: bool = False
    dashed: bool = False
    layer: str = "OUTLINE"


class Circle(NamedTuple):
    """A circle about a point."""

    x_mm: float
    y_mm: float
    radius_mm: float
    layer: str = "LEDS"


class Text(NamedTuple):
    """Words to the right of a point on their base line."""

    x_mm: float
    y_mm: float
    size_mm: float
    words: str
    layer: str = "TEXT"


Shape = Path | Circle | Text


class Drawing(NamedTuple):
    """Shapes on a sheet whose origin is its upper left corner, y downward; all in mm."""

    width_mm: float
    height_mm: float
    shapes: list[Shape]


def to_svg(drawing: Drawing) -> str:
    """The drawing at full scale: 1 user unit = 1 mm."""
    width = f"{drawing.width_mm:.3f}"
    height = f"{drawing.height_mm:.3f}"
    size = f'width="{width}mm" height="{height}mm" viewBox="0 0 {width} {height}"'
    head = f'<svg xmlns="http://www.w3.org/2000/svg" {size} fill="none" stroke="black" stroke-width="0.2">'
    return "\n".join([head, *map(svg_element, drawing.shapes), "</svg>\n"])


def svg_element(shape: Shape) -> str:
    match shape:
        case Path():
            points = " ".join(f"{x:.3f},{y:.3f}" for x, y in shape.xy_mm)
            dashes = ' stroke-dasharray="4 2"' if shape.dashed else ""
            return f'<{"polygon" if shape.closed else "polyline"} points="{points}"{dashes}/>'
        case Circle():
            return (
                f'<circle cx="{shape.x_mm:.3f}" cy="{shape.y_mm:.3f}" r="{shape.radius_mm:.3f}"/>'
            )
        case Text():
            return (
                f'<text x="{shape.x_mm:.3f}" y="{shape.y_mm:.3f}" font-size="{shape.size_mm:g}"'
                f' font-family="sans-serif" fill="black" stroke="none">{escape(shape.words)}</text>'
            )


def to_dxf(drawing: Drawing) -> str:
    """The drawing with 1 drawing unit = 1 mm, the origin at its lower left corner, and a layer for each use."""
    groups: list[tuple[int, object]] = [
        (0, "SECTION"),
        (2, "HEADER"),
        (9, "$ACADVER"),
        (1, "AC1009"),
    ]
    groups += [
        (9, "$INSUNITS"),
        (70, 4),
        (0, "ENDSEC"),
        (0, "SECTION"),
        (2, "ENTITIES"),
    ]  # 4: millimeters
    for shape in drawing.shapes:
        groups += dxf_groups(shape, drawing.height_mm)
    groups += [(0, "ENDSEC"), (0, "EOF")]
    return "".join(
        f"{code}\n{f'{value:.4f}' if isinstance(value, float) else value}\n"
        for code, value in groups
    )


def dxf_groups(shape: Shape, height_mm: float) -> Iterator[tuple[int, object]]:
    """The group codes and values of a shape; a dashed line is on a layer of its own."""
    kind = type(shape).__name__.upper()
    layer = (8, shape.layer)
    if isinstance(shape, Path):
        layer = (8, "HELP" if shape.dashed else shape.layer)
        yield from ((0, "POLYLINE"), layer, (66, 1), (70, int(shape.closed)))
        for x, y in shape.xy_mm.tolist():
            yield from ((0, "VERTEX"), layer, (10, x), (20, height_mm - y), (30, 0.0))
        yield from ((0, "SEQEND"), layer)
        return
    yield from (
        (0, kind),
        layer,
        (10, float(shape.x_mm)),
        (20, float(height_mm - shape.y_mm)),
        (30, 0.0),
    )
    if isinstance(shape, Circle):
        yield 40, float(shape.radius_mm)
    else:
        words = "".join(one if one.isascii() else f"\\U+{ord(one):04X}" for one in shape.words)
        yield from ((40, float(shape.size_mm)), (1, words))


