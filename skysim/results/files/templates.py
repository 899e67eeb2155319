"""Templates for the builder of a dome: gores at full scale (SVG, DXF, PDF), and the shell with its LEDs (OBJ, mm).

A gore is a strip of the surface along a meridian. Paper bends along the meridian but does not stretch, so a point of
the surface is drawn by its Cassini coordinates: y is the length of the gore's central meridian from the apex to the
foot of the perpendicular through the point, and x the length of that perpendicular. On a sphere of radius R, at the
angle t from the zenith and a from the meridian,

    sin(x / R) = sin t sin a,   tan(y / R) = tan t cos a

(Snyder 1987, USGS Professional Paper 1395, section 13). On any other surface the lengths are those of the surface,
along the directions that these equations give as seen from the bearing. At the distance x from the meridian the paper
is longer than the surface by the factor 1 / cos(x / R), which `MAX_WIDTH_M` limits.
"""

import math
from collections.abc import Callable, Iterator
from html import escape
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from skysim.core import files
from skysim.core.constants import INCH_M
from skysim.core.errors import check_name
from skysim.core.types import UP, Floats, Ints, azimuths_rad, lengths, normalized
from skysim.results.files.parts import DomeDesign
from skysim.simulation.lab import Lab
from skysim.sources.dome.layouts.placing import project_from_bearing, tilts_rad
from skysim.sources.dome.layouts.string import directions
from skysim.sources.dome.surface import Surface, circle_rad, perpendicular

# A flat drawing in millimeters, as SVG to print and as DXF for a cutter.


class Polyline(NamedTuple):
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


class SheetText(NamedTuple):
    """Words to the right of a point on their base line."""

    x_mm: float
    y_mm: float
    size_mm: float
    words: str
    layer: str = "TEXT"


Shape = Polyline | Circle | SheetText


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
        case Polyline():
            points = " ".join(f"{x:.3f},{y:.3f}" for x, y in shape.xy_mm)
            dashes = ' stroke-dasharray="4 2"' if shape.dashed else ""
            return f'<{"polygon" if shape.closed else "polyline"} points="{points}"{dashes}/>'
        case Circle():
            return f'<circle cx="{shape.x_mm:.3f}" cy="{shape.y_mm:.3f}" r="{shape.radius_mm:.3f}"/>'
        case SheetText():
            return (
                f'<text x="{shape.x_mm:.3f}" y="{shape.y_mm:.3f}" font-size="{shape.size_mm:g}"'
                f' font-family="sans-serif" fill="black" stroke="none">{escape(shape.words)}</text>'
            )


# A DXF file is of groups of two lines, a code and a value.
DXF_BEGIN = (
    "0\nSECTION\n2\nHEADER\n9\n$ACADVER\n1\nAC1009\n"
    "9\n$INSUNITS\n70\n4\n"  # 4: millimeters
    "0\nENDSEC\n0\nSECTION\n2\nENTITIES\n"
)
DXF_END = "0\nENDSEC\n0\nEOF\n"


def to_dxf(drawing: Drawing) -> str:
    """The drawing with 1 drawing unit = 1 mm, the origin at its lower left corner, and a layer for each use."""
    elements = (dxf_element(shape, drawing.height_mm) for shape in drawing.shapes)
    return "".join([DXF_BEGIN, *elements, DXF_END])


def dxf_element(shape: Shape, height_mm: float) -> str:
    """The groups of a shape; a dashed line is on a layer of its own."""
    if isinstance(shape, Polyline):
        layer = "HELP" if shape.dashed else shape.layer
        vertices = "".join(
            f"0\nVERTEX\n8\n{layer}\n{dxf_place(x, height_mm - y)}" for x, y in shape.xy_mm
        )
        head = f"0\nPOLYLINE\n8\n{layer}\n66\n1\n70\n{shape.closed:d}\n"
        return f"{head}{vertices}0\nSEQEND\n8\n{layer}\n"
    place = f"8\n{shape.layer}\n{dxf_place(shape.x_mm, height_mm - shape.y_mm)}"
    if isinstance(shape, Circle):
        return f"0\nCIRCLE\n{place}40\n{shape.radius_mm:.4f}\n"
    words = "".join(one if one.isascii() else f"\\U+{ord(one):04X}" for one in shape.words)
    return f"0\nTEXT\n{place}40\n{shape.size_mm:.4f}\n1\n{words}\n"


def dxf_place(x_mm: float, y_mm: float) -> str:
    return f"10\n{x_mm:.4f}\n20\n{y_mm:.4f}\n30\n0.0000\n"


MAX_WIDTH_M = 0.25  # of a gore: at its edge the paper is 0.5 % too long under a dome of 1.2 m
LEAST_GORES = 6
STEPS = 64  # of a polyline whose length is measured
EDGE_DEG = 0.5  # spacing of an edge's points
FROM_INSIDE = np.array(
    [-1.0, 1.0]
)  # seen from inside with the apex up, azimuths grow to the left
MARGIN_MM = 10.0
GAP_MM = 5.0
CAPTION_MM = 12.0
RULE_MM = 100.0  # of the scale that is to be measured after printing
# of the shell's mesh
RINGS = 60
SECTORS = 180
MARK_M = 4e-3  # size of an LED's mark on the mesh


def template(lab: Lab, ending: str) -> str:
    """The text of a template for a scene's dome, by its file's ending. Raises InputError without a dome."""
    return TEMPLATES[ending](DomeDesign(lab.scene, "templates"))


def length_m(points_m: Floats) -> Floats:
    """(...) lengths of polylines (..., K, 3)."""
    return lengths(np.diff(points_m, axis=-2)).sum(axis=-1)


def on_paper_m(surface: Surface, rays: Floats, meridian_rad: float) -> Floats:
    """(N, 2) x and y on the gore of a meridian of points in these directions (N, 3) from the bearing."""
    azimuth_rad = azimuths_rad(rays) - meridian_rad
    tilt_rad = tilts_rad(rays)
    aside_rad = np.arcsin(np.clip(np.sin(tilt_rad) * np.sin(azimuth_rad), -1, 1))
    foot_rad = np.arctan2(np.sin(tilt_rad) * np.cos(azimuth_rad), np.cos(tilt_rad))
    steps = np.linspace(0, 1, STEPS + 1)
    along = project_from_bearing(
        surface,
        directions(foot_rad[:, None] * steps, meridian_rad),
    )
    foot = directions(foot_rad, meridian_rad)
    across = np.array([-math.sin(meridian_rad), math.cos(meridian_rad), 0.0])
    turn = aside_rad[:, None] * steps
    perpendicular = project_from_bearing(
        surface, np.cos(turn)[..., None] * foot[:, None] + np.sin(turn)[..., None] * across
    )
    x_m = np.sign(aside_rad) * length_m(perpendicular)
    y_m = np.sign(foot_rad) * length_m(along)
    return np.column_stack([x_m, y_m])


def gore_count(dome: DomeDesign, widest_m: float = MAX_WIDTH_M) -> int:
    """The least number of gores of which none is wider than a sheet, nor than MAX_WIDTH_M."""
    tilt_rad = np.radians(np.arange(1, dome.cap_deg + 1))
    azimuth_rad = np.radians(np.arange(0, 360, 10.0))
    around_m = project_from_bearing(dome.surface, directions(tilt_rad[:, None], azimuth_rad))
    ring_m = float(np.hypot(around_m[..., 0], around_m[..., 1]).max())
    return max(LEAST_GORES, math.ceil(2 * math.pi * ring_m / min(widest_m, MAX_WIDTH_M)))


class Gore(NamedTuple):
    """A gore at full scale, its apex up and at the origin, seen from inside the dome; x to the right and y down, mm."""

    half_mm: float  # half of its width
    length_mm: float  # from the apex
    shapes: list[Shape]


def gore(dome: DomeDesign, number: int, count: int) -> Gore:
    """Gore `number`, from 0, of `count`: outline, meridian, title, a circle and a number for each LED."""
    rays = normalized(dome.leds.xyz)
    turns = azimuths_rad(rays) * count / (2 * np.pi)
    own = np.rint(turns).astype(int) % count == number
    meridian_rad = 2 * math.pi / count * number
    edge = outline(meridian_rad, math.pi / count, dome.cap_deg)
    outline_mm, leds_mm = (
        1e3 * FROM_INSIDE * on_paper_m(dome.surface, some, meridian_rad)
        for some in (edge, rays[own])
    )
    half_mm, length_mm = outline_mm.max(axis=0).tolist()
    x_mm, y_mm = outline_mm[0]
    meridian_mm = np.array([[x_mm, y_mm], [x_mm, length_mm]])
    title = f"{number + 1}: {math.degrees(meridian_rad):.4g} deg"
    shapes: list[Shape] = [
        Polyline(outline_mm, closed=True),
        Polyline(meridian_mm, dashed=True),
        SheetText(x_mm - 12, y_mm - 2, 4.0, title),
        *marks(dome.leds.id[own], leds_mm, 1e3 * dome.light.led.disk_diameter_m / 2),
    ]
    return Gore(half_mm, length_mm, shapes)


def moved(shape: Shape, x_mm: float, y_mm: float) -> Shape:
    """A shape that is moved."""
    if isinstance(shape, Polyline):
        return shape._replace(xy_mm=np.add(shape.xy_mm, (x_mm, y_mm)))
    return shape._replace(x_mm=shape.x_mm + x_mm, y_mm=shape.y_mm + y_mm)


def gores(dome: DomeDesign) -> Drawing:
    """The gores of a dome side by side at full scale; a line of RULE_MM tells whether the print is to scale."""
    count = gore_count(dome)
    shapes = list[Shape]()
    left_mm = MARGIN_MM
    bottom_mm = 0.0
    for number in range(count):
        one = gore(dome, number, count)
        top_mm = MARGIN_MM + CAPTION_MM
        shapes += [moved(shape, left_mm + one.half_mm, top_mm) for shape in one.shapes]
        left_mm += 2 * one.half_mm + GAP_MM
        bottom_mm = max(bottom_mm, top_mm + one.length_mm)
    rule_mm = bottom_mm + CAPTION_MM
    caption = f"{dome.name}: {count} gores, seen from inside, azimuth on top"
    shapes += scale_line(MARGIN_MM, rule_mm, caption)
    return Drawing(left_mm - GAP_MM + MARGIN_MM, rule_mm + CAPTION_MM + MARGIN_MM, shapes)


def scale_line(x_mm: float, y_mm: float, caption: str) -> list[Shape]:
    """A line of RULE_MM, which is to be measured after printing, and a caption under it."""
    return [
        Polyline(np.array([[x_mm, y_mm], [x_mm + RULE_MM, y_mm]])),
        SheetText(
            x_mm, y_mm + 6, 5.0, f"{caption}. To scale if this line is {RULE_MM:g} mm."
        ),
    ]


def outline(meridian_rad: float, half_rad: float, cap_deg: float) -> Floats:
    """(K, 3) directions around a gore: from the apex down one edge, along the rim, up the other."""
    down = np.radians(np.linspace(0, cap_deg, math.ceil(cap_deg / EDGE_DEG) + 1))
    along = np.linspace(1, -1, STEPS) * half_rad
    tilt_rad = np.concatenate([down, np.full(STEPS, down[-1]), down[::-1]])
    aside_rad = np.concatenate(
        [np.full(len(down), half_rad), along, np.full(len(down), -half_rad)]
    )
    return directions(tilt_rad, meridian_rad + aside_rad)


def marks(numbers: Ints, xy_mm: Floats, radius_mm: float) -> Iterator[Shape]:
    """A circle with a cross for each LED, and its number."""
    for number, (x, y) in zip(numbers, xy_mm, strict=True):
        yield Circle(x, y, radius_mm)
        yield from cross(x, y, 1.0, "CENTERS")
        yield SheetText(x + radius_mm + 0.5, y - 0.5, 2.0, f"{number}")


def cross(x_mm: float, y_mm: float, reach_mm: float, layer: str) -> Iterator[Shape]:
    """Two lines of twice this reach through a point."""
    for arm in np.diag([reach_mm, reach_mm]):
        yield Polyline(np.add(np.outer([-1, 1], arm), (x_mm, y_mm)), layer=layer)


def shell_obj(dome: DomeDesign) -> str:
    """The inner surface to the cap's rim as a mesh in mm, and for each LED an object `led_NUMBER`, a small pyramid
    whose base is on the surface and whose tip points outward.
    """
    tilt_rad = np.radians(np.linspace(0, dome.cap_deg, RINGS + 1))[1:]
    azimuth_rad = circle_rad(SECTORS)
    rings_m = project_from_bearing(
        dome.surface, directions(tilt_rad[:, None], azimuth_rad)
    ).reshape(-1, 3)
    vertices_m = np.concatenate([project_from_bearing(dome.surface, UP[None]), rings_m])
    lines = [
        f"# {dome.name}: inner surface and LEDs, mm from the bearing's center, z up",
        "o shell",
    ]
    lines += vertex_lines(vertices_m)
    around = np.arange(SECTORS)
    onward = (around + 1) % SECTORS
    lines += [f"f 1 {b} {a}" for a, b in zip(around + 2, onward + 2, strict=True)]
    for ring in range(RINGS - 1):
        low = 2 + ring * SECTORS
        high = 2 + (ring + 1) * SECTORS
        corners = zip(around + low, onward + low, onward + high, around + high, strict=True)
        lines += [f"f {a} {b} {c} {d}" for a, b, c, d in corners]
    leds = zip(dome.leds.id, dome.leds.xyz, dome.surface.inward(dome.leds.xyz), strict=True)
    for n, (number, place_m, inward) in enumerate(leds):
        # A face counts from the pyramid's first vertex, 1-based.
        first = len(vertices_m) + 4 * n + 1
        faces = (first + np.array([[0, 1, 2], [0, 3, 1], [1, 3, 2], [2, 3, 0]])).tolist()
        lines += [f"o led_{number}", *vertex_lines(pyramid_m(place_m, inward))]
        lines += [f"f {a} {b} {c}" for a, b, c in faces]
    return "\n".join([*lines, ""])


def pyramid_m(place_m: Floats, inward: Floats) -> Floats:
    """(4, 3) three corners about a place on the surface, and a tip outside."""
    first = perpendicular(inward[None])[0]
    angle = 2 * np.pi / 3 * np.arange(3)
    base = np.outer(np.cos(angle), first) + np.outer(np.sin(angle), np.cross(inward, first))
    return place_m + MARK_M * np.concatenate([base / 2, -inward[None]])


def vertex_lines(points_m: Floats) -> list[str]:
    return [f"v {x:.4f} {y:.4f} {z:.4f}" for x, y, z in 1e3 * points_m]


TEMPLATES: dict[str, Callable[[DomeDesign], str]] = {
    ".svg": lambda dome: to_svg(gores(dome)),
    ".dxf": lambda dome: to_dxf(gores(dome)),
    ".obj": shell_obj,
}


# Gores as the pages of a PDF to print at full scale: a gore a page, on sheets to be joined, or on a roll.
#
# On sheets, a gore is no wider than a sheet, and as many sheets long as it takes. Two neighbors share a strip of
# OVERLAP_MM with a registration mark at each side: lay one sheet's marks on the other's.


INCH_MM = 1e3 * INCH_M
POINT_MM = INCH_MM / 72
SHEETS_MM = {"a4": (210.0, 297.0), "a3": (297.0, 420.0)}
PAPERS = (*SHEETS_MM, "roll", "gore")
ROLL_MM = 610.0  # 24 inches
OVERLAP_MM = 15.0
MARK_MM = 3.0  # radius of a registration mark
HEAD_MM = CAPTION_MM + 2  # of a page: its scale line and its title


class Page(NamedTuple):
    """A page: its size, its title, and the shapes of which it shows those right of and below `corner_mm`."""

    width_mm: float
    height_mm: float
    title: str
    corner_mm: tuple[float, float]
    shapes: list[Shape]


def pages(dome: DomeDesign, paper: str) -> Iterator[Page]:
    """The pages of a dome's gores. Raises InputError for an unknown paper.

    On a roll, as many gores side by side as its width has room for; without sheets or a roll, one on a page that is as
    large as the gore. Such a page is at least as wide as its title.
    """
    check_name("paper", "paper", paper, PAPERS)
    width_mm, height_mm = SHEETS_MM.get(paper, (math.inf, math.inf))
    count = gore_count(dome, 1e-3 * (width_mm - 2 * MARGIN_MM))
    gores = [gore(dome, number, count) for number in range(count)]
    if paper in SHEETS_MM:
        for number, one in enumerate(gores, 1):
            title = f"{dome.name}: gore {number} of {count}, seen from inside"
            yield from sheet_pages(title, one, width_mm, height_mm)
        return
    width_mm = ROLL_MM if paper == "roll" else 0.0
    half_mm = max(one.half_mm for one in gores)
    length_mm = max(one.length_mm for one in gores)
    step_mm = 2 * half_mm + GAP_MM
    across = max(1, int((width_mm - 2 * MARGIN_MM + GAP_MM) // step_mm))
    page_mm = max(width_mm, 2 * (half_mm + MARGIN_MM), 1.5 * RULE_MM + 2 * MARGIN_MM)
    # The title of a gore is above its apex.
    height_mm = length_mm + 2 * MARGIN_MM + HEAD_MM + CAPTION_MM
    for first in range(0, count, across):
        some = gores[first : first + across]
        shapes = [
            moved(shape, n * step_mm, 0) for n, one in enumerate(some) for shape in one.shapes
        ]
        which = (
            f"gores {first + 1} to {first + len(some)}" if width_mm else f"gore {first + 1}"
        )
        title = f"{dome.name}: {which} of {count}, seen from inside"
        yield Page(page_mm, height_mm, title, (-half_mm, -CAPTION_MM), shapes)


def sheet_pages(title: str, one: Gore, width_mm: float, height_mm: float) -> Iterator[Page]:
    """The sheets of one gore, from its apex down, with marks in the strips that two of them share."""
    half_mm = width_mm / 2 - MARGIN_MM
    shown_mm = height_mm - 2 * MARGIN_MM - HEAD_MM
    step_mm = shown_mm - OVERLAP_MM
    length_mm = CAPTION_MM + one.length_mm
    count = max(1, math.ceil((length_mm - OVERLAP_MM) / step_mm))
    tops_mm = [-CAPTION_MM + sheet * step_mm for sheet in range(count)]
    shapes = list(one.shapes)
    for top_mm in tops_mm[1:]:
        for x_mm in (-half_mm + 2 * MARK_MM, half_mm - 2 * MARK_MM):
            # A registration mark: a circle with a cross.
            at_mm = x_mm, top_mm + OVERLAP_MM / 2
            shapes.append(Circle(*at_mm, MARK_MM, "MARKS"))
            shapes += cross(*at_mm, 1.5 * MARK_MM, "MARKS")
    for sheet, top_mm in enumerate(tops_mm, 1):
        name = f"{title}; sheet {sheet} of {count}"
        yield Page(width_mm, height_mm, name, (-half_mm, top_mm), shapes)


def write_pdf(path: Path, dome: DomeDesign, paper: str) -> int:
    """Write the pages, and return how many they are. Raises InputError for an unknown paper."""
    from matplotlib.backends.backend_pdf import PdfPages
    from matplotlib.figure import Figure

    with files.atomic_file(path) as temporary, PdfPages(temporary) as pdf:
        count = 0
        for page in pages(dome, paper):
            figure = Figure(figsize=(page.width_mm / INCH_MM, page.height_mm / INCH_MM))
            shown_mm = page.height_mm - 2 * MARGIN_MM - HEAD_MM
            draw(figure, page, page.shapes, page.corner_mm, MARGIN_MM, shown_mm)
            head = scale_line(0, 2, page.title)
            draw(figure, page, head, (0.0, 0.0), MARGIN_MM + shown_mm, HEAD_MM)
            pdf.savefig(figure)
            count += 1
    return count


def draw(
    figure: Any,
    page: Page,
    shapes: list[Shape],
    corner_mm: tuple[float, float],
    bottom_mm: float,
    shown_mm: float,
) -> None:
    """Draw shapes at full scale between the margins of a page, in a strip `shown_mm` high; cut off what is outside."""
    from matplotlib.patches import Circle as Disk

    x_mm, y_mm = corner_mm
    wide_mm = page.width_mm - 2 * MARGIN_MM
    axes = figure.add_axes(
        (
            MARGIN_MM / page.width_mm,
            bottom_mm / page.height_mm,
            wide_mm / page.width_mm,
            shown_mm / page.height_mm,
        )
    )
    axes.set_xlim(x_mm, x_mm + wide_mm)
    axes.set_ylim(y_mm + shown_mm, y_mm)
    axes.axis("off")
    line = {"color": "black", "linewidth": 0.2 / POINT_MM}
    for shape in shapes:
        match shape:
            case Polyline():
                xy_mm = np.vstack([shape.xy_mm, shape.xy_mm[: shape.closed]])
                axes.plot(*xy_mm.T, linestyle="--" if shape.dashed else "-", **line)
            case Circle():
                axes.add_patch(
                    Disk((shape.x_mm, shape.y_mm), shape.radius_mm, fill=False, **line)
                )
            case SheetText():
                # A height of letters, as SVG and DXF have it, is the size of the font.
                axes.text(
                    shape.x_mm,
                    shape.y_mm,
                    shape.words,
                    fontsize=shape.size_mm / POINT_MM,
                    clip_on=True,
                )
