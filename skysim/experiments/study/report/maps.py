"""Maps of a study: a response over the directions of the random attitudes, in cells of about equal solid angle."""

import itertools
import math
from collections.abc import Iterator, Sequence
from typing import Any, NamedTuple

import numpy as np

from skysim.core.errors import InputError
from skysim.core.types import Array, Floats
from skysim.experiments.study.plan import Map
from skysim.experiments.study.report.figures import (
    HATCHED,
    add_color_bar,
    annotate,
    color_scale,
    halo,
    is_light,
)
from skysim.experiments.study.report.layout import caption_title, fixed_text
from skysim.experiments.study.table import PointTable
from skysim.experiments.study.worst import ColumnsOf, WorstTrial, worst_trials
from skysim.results import metrics
from skysim.results.files.row_parts import subset
from skysim.results.plots import png

CELL_TRIALS = 25  # mean number of trials in a cell
MAX_CELLS = 240  # maximum number of cells of a panel
MIN_VALUES = 5  # a cell with fewer values is hatched
SPARE = 1.6  # mean number of trials in a cell over the least number that a quantile takes
# Maximum number of cells of a panel with their numbers of trials written in them.
MAX_NUMBERED = 70
SKY_RANGE_DEG = (-90.0, 90.0)
MARK = "#111111"  # color of the marks of the worst trials
EDGE_POINTS = 24  # points along each edge of a cell
RING_LABEL_DEG = 67.5  # azimuth of the labels of the rings
LABEL: Any = {"ha": "center", "va": "center", "fontsize": 7, "color": "#444444"}


class MapCell(NamedTuple):
    """A cell: its range of tilt or declination, and of azimuth or right ascension, in degrees.

    Attributes
    ----------
    value
        The response, NaN without values
    values
        Number of trials with a value
    """

    low_deg: float
    high_deg: float
    left_deg: float
    right_deg: float
    value: float
    values: int

    @property
    def shown(self) -> bool:
        """Whether it has enough values to be drawn."""
        return self.values >= MIN_VALUES and math.isfinite(self.value)


class DirectionMap(NamedTuple):
    """A panel of a map: the level of `by`, whether it is of the sky, its cells and the worst trials."""

    label: str
    sky: bool
    cells: list[MapCell]
    worst: list[WorstTrial]


# Contents.


def direction_maps(
    lines: PointTable, figure: Map, columns_of: ColumnsOf
) -> list[DirectionMap]:
    """The panels of a map, one for each level of `by`. Raises InputError for points of dome and of sky."""
    return [
        direction_map(label, columns_of(*(line.point for line in group)), figure.value)
        for label, group in lines.groups(figure).items()
    ]


def direction_map(label: str, columns: metrics.Columns, response: str) -> DirectionMap:
    """One panel, from the columns of its trials."""
    in_dome = np.isfinite(columns["body_tilt_deg"])
    in_sky = np.isfinite(columns["boresight_dec_deg"])
    if in_dome.any() and in_sky.any():
        raise InputError(
            f"map of {response}",
            "trials under a dome and under the stars",
            "where, to choose one",
        )
    sky = bool(in_sky.any())
    known = in_dome | in_sky
    if not known.any():
        return DirectionMap(label, sky, [], [])
    radial_deg = columns["boresight_dec_deg" if sky else "body_tilt_deg"]
    around_deg = columns["boresight_ra_deg" if sky else "body_azimuth_deg"]
    least = least_values(response)
    count = int(known.sum() * min(CELL_TRIALS / (SPARE * least), 1.0))
    low_deg, high_deg = radial_range(radial_deg[known], sky)
    ranges = list(partition(low_deg, high_deg, count, sky))
    number = cell_numbers(ranges, radial_deg, around_deg)
    order = np.argsort(number, kind="stable")
    ends = np.searchsorted(number[order], np.arange(len(ranges) + 1))
    summarize = metrics.response(response)
    cells = []
    for one, (first, end) in zip(ranges, itertools.pairwise(ends.tolist()), strict=True):
        summary = summarize(subset(columns, order[first:end]))
        value = summary.value if summary.trials >= least else math.nan
        cells.append(MapCell(*one, value, summary.trials))
    return DirectionMap(label, sky, cells, worst_trials(columns, response))


def least_values(response: str) -> int:
    """Least number of values of a cell that is drawn: MIN_VALUES, and for a quantile p as many as its tail holds one.

    Of 1 / (1 - p) values one exceeds the quantile p, of 1 / p one is below it. With fewer values the quantile is about
    the largest or the smallest one.
    """
    share = metrics.probability_of(metrics.split_name(response)[1]) or 0.5
    return max(MIN_VALUES, math.ceil(round(1 / min(share, 1 - share), 9)))


def radial_range(radial_deg: Floats, sky: bool) -> tuple[float, float]:
    """Range of tilts or declinations to draw: that of the trials in whole degrees, extended to near poles."""
    low = float(np.floor(radial_deg.min()))
    high = float(np.floor(radial_deg.max())) + 1
    bottom, top = SKY_RANGE_DEG if sky else (0.0, math.inf)
    near = 5 if sky else 2
    return (bottom if low < bottom + near else low), (top if high > top - near else high)


def partition(
    low_deg: float, high_deg: float, trials: int, sky: bool
) -> Iterator[tuple[float, float, float, float]]:
    """Cells of about equal solid angle, about as wide as high: low, high, left and right of each in degrees.

    A ring between two tilts has the solid angle 2 pi (cos a - cos b), between two declinations 2 pi (sin b - sin a).
    """
    count = min(max(trials // CELL_TRIALS, 4), MAX_CELLS)

    def height(deg: float) -> float:
        return math.sin(math.radians(deg)) if sky else -math.cos(math.radians(deg))

    cell_sr = 2 * math.pi * (height(high_deg) - height(low_deg)) / count
    rings = max(round(math.radians(high_deg - low_deg) / math.sqrt(cell_sr)), 1)
    edges = np.linspace(low_deg, high_deg, rings + 1).tolist()
    for low, high in itertools.pairwise(edges):
        sectors = max(round(2 * math.pi * (height(high) - height(low)) / cell_sr), 1)
        # A cell of the sky begins at RA 180 deg, where the projection is cut.
        bounds = np.linspace(180 if sky else 0, 540 if sky else 360, sectors + 1).tolist()
        yield from ((low, high, left, right) for left, right in itertools.pairwise(bounds))


def cell_numbers(
    ranges: Sequence[tuple[float, float, float, float]],
    radial_deg: Floats,
    around_deg: Floats,
) -> Array[np.int16]:
    """(N,) number of the cell that each trial is in, by the ranges of `partition`; -1 for none."""
    number = np.full(len(radial_deg), -1, np.int16)
    first = 0
    for (low, high), group in itertools.groupby(ranges, key=lambda one: one[:2]):
        lefts = [left for _, _, left, _ in group]
        ring = np.flatnonzero((radial_deg >= low) & (radial_deg < high))
        sector = (around_deg[ring] - lefts[0]) % 360 * (len(lefts) / 360)
        number[ring] = first + np.minimum(sector, len(lefts) - 1).astype(np.int16)
        first += len(lefts)
    return number


# Drawing.


def map_png(panels: Sequence[DirectionMap], figure: Map) -> bytes:
    """A map as PNG."""
    sky = panels[0].sky
    width_in = min((6.5 if sky else 4.4) * len(panels), 12.5)
    height_in = width_in / len(panels) * (0.5 if sky else 1.0)
    return png(lambda fig: draw_maps(fig, panels, figure), (width_in + 1.0, height_in + 0.25))


def draw_maps(fig: Any, panels: Sequence[DirectionMap], figure: Map) -> None:
    """Draw the panels side by side with one color scale."""
    from matplotlib.cm import ScalarMappable

    stack = fig.subplots(1, len(panels), squeeze=False)[0]
    values = np.array([cell.value for panel in panels for cell in panel.cells if cell.shown])
    colors = ScalarMappable(**color_scale(values, figure))
    for axes, panel in zip(stack, panels, strict=True):
        axes.set_aspect("equal")
        axes.set_axis_off()
        draw_cells(axes, panel, colors)
        if panel.sky:
            draw_sky_labels(axes)
        else:
            draw_dome_labels(axes, panel)
        mark_worst(axes, panel)
        axes.set_title(f"{figure.by} = {panel.label}" if panel.label else "", fontsize=9)
    add_color_bar(fig, colors, figure, ax=list(stack), shrink=0.8)


def place(radial_deg: Floats | float, around_deg: Floats | float, sky: bool) -> Floats:
    """(..., 2) place of a direction in the drawing.

    Under a dome: azimuthal equidistant, the tilt as radius and the azimuth as angle. Of the sky: Hammer's projection,
    which keeps areas, with RA increasing to the left (Snyder 1987, p. 160):

        x = 2 sqrt(2) cos(dec) sin(l / 2) / d,    y = sqrt(2) sin(dec) / d,    d = sqrt(1 + cos(dec) cos(l / 2)).

    Parameters
    ----------
    around_deg
        Azimuth, or RA from 180 to 540
    """
    if sky:
        dec = np.radians(radial_deg)
        around = np.radians(360.0 - np.asarray(around_deg))
        divisor = np.sqrt(1 + np.cos(dec) * np.cos(around / 2))
        x = 2 * math.sqrt(2) * np.cos(dec) * np.sin(around / 2) / divisor
        y = math.sqrt(2) * np.sin(dec) / divisor
    else:
        x = radial_deg * np.cos(np.radians(around_deg))
        y = radial_deg * np.sin(np.radians(around_deg))
    return np.stack(np.broadcast_arrays(x, y), axis=-1)


def draw_cells(axes: Any, panel: DirectionMap, colors: Any) -> None:
    """Draw each cell in the color of its value, or hatched if it has too few; write their numbers if cells are few."""
    from matplotlib.collections import PolyCollection

    shown = [cell for cell in panel.cells if cell.shown]
    faces = [colors.to_rgba(cell.value) for cell in shown]
    edges: Any = {"facecolors": faces, "edgecolors": "white", "linewidths": 0.4}
    axes.add_collection(PolyCollection([outline(cell, panel.sky) for cell in shown], **edges))
    empty = [outline(cell, panel.sky) for cell in panel.cells if not cell.shown]
    axes.add_collection(PolyCollection(empty, **HATCHED))
    if len(panel.cells) > MAX_NUMBERED:
        return
    for cell in panel.cells:
        dark = cell.shown and not is_light(colors.to_rgba(cell.value))
        style = LABEL | {"fontsize": 6.5, "color": "#eeeeee" if dark else "#333333"}
        radial_deg = (cell.low_deg + cell.high_deg) / 2
        around_deg = (cell.left_deg + cell.right_deg) / 2
        axes.text(*place(radial_deg, around_deg, panel.sky), str(cell.values), **style)


def outline(cell: MapCell, sky: bool) -> Floats:
    """(K, 2) outline of a cell in the drawing."""
    around = np.linspace(cell.left_deg, cell.right_deg, EDGE_POINTS)
    radial = np.linspace(cell.low_deg, cell.high_deg, EDGE_POINTS)
    bottom = place(cell.low_deg, around, sky)
    end = place(radial, cell.right_deg, sky)
    top = place(cell.high_deg, around[::-1], sky)
    begin = place(radial[::-1], cell.left_deg, sky)
    return np.concatenate([bottom, end, top, begin])


def draw_dome_labels(axes: Any, panel: DirectionMap) -> None:
    """Label azimuths around the map, and the tilts of its rings."""
    edges = sorted({cell.high_deg for cell in panel.cells}) or [1.0]
    limit = 1.17 * edges[-1]
    axes.set(xlim=(-limit, limit), ylim=(-limit, limit))
    for azimuth_deg in range(0, 360, 45):
        text = f"{azimuth_deg}°" + {0: " (x)", 90: " (y)"}.get(azimuth_deg, "")
        axes.text(*place(1.09 * edges[-1], azimuth_deg, False), text, **LABEL)
    for edge in edges:
        axes.text(
            *place(edge, RING_LABEL_DEG, False),
            f"{edge:.3g}°",
            path_effects=[halo()],
            **LABEL,
        )


def draw_sky_labels(axes: Any) -> None:
    """Draw the sky's border, and label right ascensions along the equator and declinations at the left."""
    dec_deg = np.linspace(-90, 90, 91)
    for edge in (180.0, 540.0):
        axes.plot(*place(dec_deg, edge, True).T, color="#888888", linewidth=1)
    axes.set(xlim=(-3.2, 2.9), ylim=(-1.5, 1.5))
    for ra_deg in (240, 300, 360, 420, 480):
        axes.text(
            *place(0.0, ra_deg, True), f"{ra_deg % 360}°", path_effects=[halo()], **LABEL
        )
    for dec in (-60.0, -30.0, 0.0, 30.0, 60.0):
        x, y = place(dec, 540.0, True)
        axes.text(x - 0.22, y, f"{dec:+.0f}°" if dec else "0°", **LABEL)


def mark_worst(axes: Any, panel: DirectionMap) -> None:
    """Mark the worst trials with their rank."""
    for rank, one in enumerate(panel.worst, 1):
        xy = place(one.tilt_deg, one.azimuth_deg, False)
        if panel.sky:
            xy = place(one.dec_deg, (one.ra_deg - 180) % 360 + 180, True)
        style = {"markerfacecolor": "none", "path_effects": [halo()]}
        axes.plot(*xy, "o", markersize=8, color=MARK, **style)
        annotate(axes, str(rank), xy, MARK, fontsize=8)


# Caption.


def caption(panels: Sequence[DirectionMap], figure: Map, lines: PointTable) -> str:
    """Caption of a map: its response, the fixed levels, the meaning of directions, and the numbers in the cells."""
    text = caption_title(figure) + fixed_text(figure, lines)
    cells = [cell for panel in panels for cell in panel.cells]
    if not cells:
        return f"{text}. No trial of it is in yet."
    counts = [cell.values for cell in cells]
    axis_text = (
        "boresight, RA increasing to the left"
        if panels[0].sky
        else "body's z axis, tilt outward, seen from above"
    )
    text += f". Directions of the {axis_text}. n = {min(counts)} to {max(counts)} in a cell"
    if max(len(panel.cells) for panel in panels) <= MAX_NUMBERED:
        text += ", written in it"
    if not all(cell.shown for cell in cells):
        text += f"; hatched: fewer than {least_values(figure.value)}"
    return text + (". Circles: the worst." if any(panel.worst for panel in panels) else ".")
