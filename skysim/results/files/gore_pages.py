"""Gores as the pages of a PDF to print at full scale: a gore a page, on sheets to be joined, or on a roll.

On sheets, a gore is no wider than a sheet, and as many sheets long as it takes. Two neighbors share a strip of
OVERLAP_MM with a registration mark at each side: lay one sheet's marks on the other's.
"""

import math
from collections.abc import Iterator
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from skysim.core import files
from skysim.core.constants import INCH_M
from skysim.core.errors import check_name
from skysim.results.files.parts import DomeDesign
from skysim.results.files.templates import (
    CAPTION_MM,
    GAP_MM,
    MARGIN_MM,
    RULE_MM,
    Circle,
    Gore,
    Polyline,
    Shape,
    SheetText,
    cross,
    gore,
    gore_count,
    moved,
    scale_line,
)

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
    """The pages of a dome's gores. Raises InputError for an unknown paper."""
    check_name("paper", "paper", paper, PAPERS)
    width_mm, height_mm = SHEETS_MM.get(paper, (math.inf, math.inf))
    count = gore_count(dome, 1e-3 * (width_mm - 2 * MARGIN_MM))
    gores = [gore(dome, number, count) for number in range(count)]
    if paper not in SHEETS_MM:
        yield from long_pages(dome.name, gores, ROLL_MM if paper == "roll" else 0.0)
        return
    for number, one in enumerate(gores, 1):
        title = f"{dome.name}: gore {number} of {count}, seen from inside"
        yield from sheet_pages(title, one, width_mm, height_mm)


def long_pages(name: str, gores: list[Gore], width_mm: float) -> Iterator[Page]:
    """As many gores side by side as a page of this width has room for; one on a page that is as large as the gore.

    A page is at least as wide as its title.
    """
    half_mm = max(float(one.outline_mm[:, 0].max()) for one in gores)
    length_mm = max(float(one.outline_mm[:, 1].max()) for one in gores)
    step_mm = 2 * half_mm + GAP_MM
    across = max(1, int((width_mm - 2 * MARGIN_MM + GAP_MM) // step_mm))
    page_mm = max(width_mm, 2 * (half_mm + MARGIN_MM), 1.5 * RULE_MM + 2 * MARGIN_MM)
    # The title of a gore is above its apex.
    height_mm = length_mm + 2 * MARGIN_MM + HEAD_MM + CAPTION_MM
    for first in range(0, len(gores), across):
        some = gores[first : first + across]
        shapes = [
            moved(shape, n * step_mm, 0) for n, one in enumerate(some) for shape in one.shapes
        ]
        which = (
            f"gores {first + 1} to {first + len(some)}" if width_mm else f"gore {first + 1}"
        )
        title = f"{name}: {which} of {len(gores)}, seen from inside"
        yield Page(page_mm, height_mm, title, (-half_mm, -CAPTION_MM), shapes)


def sheet_pages(title: str, one: Gore, width_mm: float, height_mm: float) -> Iterator[Page]:
    """The sheets of one gore, from its apex down, with marks in the strips that two of them share."""
    half_mm = width_mm / 2 - MARGIN_MM
    shown_mm = height_mm - 2 * MARGIN_MM - HEAD_MM
    step_mm = shown_mm - OVERLAP_MM
    length_mm = CAPTION_MM + float(one.outline_mm[:, 1].max())
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
