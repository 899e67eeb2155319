"""Draw a study's figures, each as a PNG. `layout` selects their contents."""

import math
import textwrap
from collections.abc import Sequence
from typing import Any

import numpy as np

from skysim.core.types import Floats, Record
from skysim.experiments.study.plan import Curve, Heat, Map
from skysim.experiments.study.report.layout import (
    MAX_POINTS_WITH_BARS,
    MAX_X_WITH_BARS,
    Grid,
    Panel,
    Series,
    draws_medians,
    expected_value,
    grid,
    limits,
    series,
)
from skysim.experiments.study.table import (
    Axis,
    Index,
    PointTable,
    label,
)
from skysim.experiments.study.thresholds import crossings, thresholds_of
from skysim.results.metrics import MORE_IS_BETTER, is_proportion, split_name
from skysim.results.plots import INK, MARKS, png

# Color scales of a study's figures, outlines of texts, and ticks of logarithmic axes.


SHARE_COLORS = "cividis"  # color map of all proportions
COLORS = "YlOrRd"  # color map of other responses, dark is bad: reversed if more is better
# Style of a cell without value.
HATCHED: Any = {
    "facecolor": "#eeeeee",
    "edgecolor": "#b8b8b8",
    "hatch": "////",
    "linewidth": 0,
}


def add_color_bar(fig: Any, image: Any, figure: Heat | Map, **where: Any) -> None:
    """Add the color bar, labeled with the response."""
    if figure.log:
        where["ticks"], where["format"] = ticks(image.norm.vmin, image.norm.vmax)
    fig.colorbar(image, label=label(figure.response), **where).minorticks_off()


def color_scale(values: Floats, figure: Heat | Map) -> Record:
    """Color map and normalization of a response: every proportion has the same, from 0 to 1.

    Others extend over the finite values; a valid default range if all are equal or there are none.
    """
    from matplotlib.colors import LogNorm, Normalize

    share = is_proportion(figure.response)
    if share and not figure.log:
        return {"cmap": SHARE_COLORS, "norm": Normalize(0, 1)}
    colors = SHARE_COLORS if share else COLORS
    if split_name(figure.response)[0] in MORE_IS_BETTER:
        colors += "_r"
    finite = values[np.isfinite(values) & ((values > 0) | (not figure.log))]
    low = float(finite.min()) if len(finite) else 0.5
    high = float(finite.max()) if len(finite) else 1.0
    if high <= low:
        high = low + (abs(low) or 1.0)
    norm = LogNorm(low, high, clip=True) if figure.log else Normalize(low, high)
    return {"cmap": colors, "norm": norm}


def ticks(low: float, high: float) -> tuple[Any, Any]:
    """Tick locator and formatter of a logarithmic axis.

    Ticks are at each decade over three decades or more, at 1, 2 and 5 of each decade over less, and at round numbers
    if the range is a factor of 8 or less.
    """
    from matplotlib.ticker import FuncFormatter, LogLocator, MaxNLocator

    where: Any
    if high <= 8 * low:
        where = MaxNLocator(5)
    elif high < 1000 * low:
        where = LogLocator(subs=(1, 2, 5))
    else:
        where = LogLocator(subs=(1,))
    return where, FuncFormatter(lambda value, _: f"{value:.6g}")


def is_light(rgba: Sequence[float]) -> bool:
    """Whether a color is so light that text on it must be dark: its luma (ITU-R BT.601) is above one half."""
    return float(np.dot(rgba[:3], (0.299, 0.587, 0.114))) > 0.5


def halo() -> Any:
    """A white outline that keeps text and marks readable on any color."""
    from matplotlib.patheffects import withStroke

    return withStroke(linewidth=2.2, foreground="white")


def annotate(axes: Any, text: str, at: Any, ink: str, **style: Any) -> None:
    """Write a text beside a point, readable on any color."""
    beside = {"xytext": (5, 4), "textcoords": "offset points", "path_effects": [halo()]}
    axes.annotate(text, at, color=ink, **beside, **style)


MAX_TICKS = 16  # maximum number of levels that have a tick each
# Maximum number of tick labels that are wrapped; with more, long ones are rotated.
MAX_WRAPPED_LABELS = 8
LABEL_WIDTH = 88  # characters that fit below an axis
# Maximum rows and columns of a heat map with values written in its cells.
MAX_CELLS_WITH_TEXT = 12
MAX_LABELED_POINTS = 12  # maximum number of Pareto points that are labeled
GRAY = "#8fa1b3"
ORANGE = "#d55e00"


def figure_png(lines: PointTable, figure: Curve | Heat) -> bytes:
    """A curve or heat map as PNG. Raises InputError if its `where` names an unknown factor or level."""
    if isinstance(figure, Curve):
        return png(lambda fig: draw_curve(fig, lines, figure), (7.4, 3.9))
    if lines.study.is_sampled:
        return png(lambda fig: draw_scatter(fig, lines, figure), (7.0, 4.4))
    cells = grid(lines, figure)
    rows, columns = cells.value.shape
    width_in = min(max(2.6 + 0.6 * columns, 4.6), 9.6)
    height_in = min(max(1.2 + 0.42 * rows, 2.6), 7.0)
    return png(lambda fig: draw_heat(fig, cells, figure), (width_in, height_in))


# Curves.


def draw_curve(fig: Any, lines: PointTable, figure: Curve) -> None:
    """Draw series with their intervals; sampled points as markers, with a running median if they are many."""
    axes = fig.subplots()
    x_axis = lines.axes[figure.x]
    shown = series(lines, figure)
    dots = draws_medians(lines, x_axis, sum(len(one.x) for one in shown))
    set_up_y_axis(axes, figure.y, shown, figure.log, not dots)
    set_up_axis(axes, "x", x_axis)
    if (expected := expected_value(figure.y)) is not None:
        axes.axhline(expected, color="#777777", linestyle=":", linewidth=1.2)
    group_axis = lines.axes[figure.by] if figure.by is not None else None
    # Sampled points are not joined. Bars of several series with common levels are side by side.
    line = "-" if x_axis.numeric else ":"
    widest_pt, room_pt = (3.0, 20.0) if x_axis.numeric else (6.0, 60.0)
    step_pt = min(widest_pt, room_pt / max(len(shown), 1))
    if lines.study.is_sampled:
        line = "none"
        step_pt = 0.0
    for n, (one, ink) in enumerate(zip(shown, colors(len(shown), group_axis), strict=True)):
        mark = MARKS[n % len(MARKS)]
        if dots:
            draw_dots(axes, one, ink, mark, x_axis.numeric)
        else:
            shift_pt = (n - (len(shown) - 1) / 2) * step_pt
            draw_line(axes, one, ink, mark, line, shift_pt)
    draw_thresholds(axes, figure, lines, group_axis)
    if not any(np.isfinite(one.value).any() for one in shown):
        axes.text(
            0.5, 0.5, "nothing yet", transform=axes.transAxes, ha="center", color="#888888"
        )
    if group_axis is not None and shown:
        columns = math.ceil(len(shown) / 14)
        fig.legend(
            title=group_axis.label, loc="outside right upper", ncols=columns, alignment="left"
        )


def draw_thresholds(
    axes: Any, figure: Curve, lines: PointTable, group_axis: Axis | None
) -> None:
    """Draw the thresholds of this curve: the limit dashed, a tick at each crossing and a bar over its interval."""
    for threshold in thresholds_of(figure, lines):
        axes.axhline(threshold.limit, color="#777777", linestyle="--", linewidth=0.8)
        found = crossings(threshold, lines)
        first, last = axes.get_xlim()
        for one, ink in zip(found.values(), colors(len(found), group_axis), strict=True):
            if one is None or not np.isfinite(one.value):
                continue
            low, high = np.clip([one.low, one.high], first, last)
            axes.hlines(threshold.limit, low, high, color=ink, linewidth=6, alpha=0.25)
            axes.plot(
                one.value, threshold.limit, "|", color=ink, markersize=13, markeredgewidth=2
            )


def set_up_y_axis(
    axes: Any, name: str, shown: Sequence[Series | Panel], log: bool, bars: bool = True
) -> None:
    """Set up the y axis: limits that include all values and, if drawn, their error bars; label and scale."""
    bounds = [end for one in shown for end in (one.low, one.high)] if bars else []
    expected = expected_value(name)
    marked = [np.array([expected])] if expected is not None else []
    values = [*(one.value for one in shown), *marked]
    low, high = limits(values, bounds, log, is_proportion(name))
    if log:
        logarithmic(axes, "y", low, high)
    axes.set_ylim(low, high)
    axes.set_ylabel(label(name))


def draw_line(
    axes: Any, one: Series, ink: Any, mark: str, line: str, shift_pt: float
) -> None:
    """Draw one series with its intervals, offset sideways: bars, or a band along a line of many points.

    The line skips points with few values, because these come from the easy trials only: they are hollow marks, each
    with its number of values. On a logarithmic axis a value of zero cannot be drawn; an open triangle marks its upper
    bound.
    """
    from matplotlib.transforms import offset_copy

    offset = offset_copy(axes.transData, axes.figure, x=shift_pt, units="points")
    if line == "-" and len(one.x) > MAX_X_WITH_BARS:
        offset = axes.transData
        axes.fill_between(
            one.x, *drawn_interval(axes, one), color=ink, alpha=0.15, linewidth=0
        )
    else:
        draw_bars(axes, one.x, one, ink, offset)
    style = {"color": ink, "transform": offset}
    joined = np.where(one.few, np.nan, one.value)
    axes.plot(one.x, joined, label=one.label or None, marker=mark, linestyle=line, **style)
    style["markerfacecolor"] = "white"
    axes.plot(one.x[one.few], one.value[one.few], mark, **style)
    for n in np.flatnonzero(one.few & np.isfinite(one.value)):
        at = one.x[n], one.value[n]
        annotate(axes, f"n={one.values[n]}", at, ink, fontsize=6.5, xycoords=offset)
    if axes.get_yscale() == "log":
        none = (one.value <= 0) & (one.high > 0)
        axes.plot(one.x[none], one.high[none], "v", **style)


def draw_dots(axes: Any, one: Series, ink: Any, mark: str, numeric: bool) -> None:
    """Draw many sampled points with their running median, or with the median at each named level."""
    size = min(max(4.5 * (MAX_POINTS_WITH_BARS / len(one.x)) ** 0.3, 1.8), 4.5)
    axes.plot(
        one.x, one.value, mark, color=ink, markersize=size, markeredgewidth=0, alpha=0.5
    )
    thick = {"linewidth": 2.2, "markeredgewidth": 2.2, "markersize": 26}
    shape = "-" if numeric else "_"
    axes.plot(*medians(one, numeric), shape, color=ink, label=one.label or None, **thick)


def draw_bars(axes: Any, x: Floats, one: Series | Panel, ink: Any, where: Any) -> None:
    """Draw intervals as bars with caps."""
    style = {"color": ink, "alpha": 0.6, "transform": where}
    axes.vlines(x, *drawn_interval(axes, one), linewidth=1, **style)
    for end in (one.low, one.high):
        axes.plot(x, end, "_", markersize=6, **style)


def drawn_interval(axes: Any, one: Series | Panel) -> tuple[Floats, Floats]:
    """Interval bounds for drawing; those <= 0 on a logarithmic axis are moved to a point below its limits."""
    if axes.get_yscale() != "log":
        return one.low, one.high
    below = axes.get_ylim()[0] / 10
    return np.maximum(one.low, below), np.maximum(one.high, below)


def medians(one: Series, numeric: bool) -> tuple[Floats, Floats]:
    """Medians of x and value in twelve groups of equal size along a series ascending in x, or at each named level."""
    good = np.flatnonzero(np.isfinite(one.value))
    groups = np.array_split(good, 12)
    if not numeric:
        groups = [good[one.x[good] == level] for level in np.unique(one.x[good])]
    filled = [rows for rows in groups if len(rows)]
    x, values = (
        np.array([np.median(each[rows]) for rows in filled]) for each in (one.x, one.value)
    )
    return x, values


def colors(count: int, group_axis: Axis | None) -> list[Any]:
    """Colors of `count` lines: from a color scale if their axis is numeric, else from the palette."""
    from matplotlib import colormaps

    if count > 2 and group_axis is not None and group_axis.numeric:
        return list(colormaps["viridis"](np.linspace(0, 0.82, count)))
    return [INK[n % len(INK)] for n in range(count)]


def set_up_axis(axes: Any, which: str, one: Axis) -> None:
    """Set up axis `which`: one tick per level if they are few, with labels of x rotated if they would overlap.

    Named levels of y go from the top down.
    """
    places = np.array([one.coordinate(level) for level in one.levels])
    if one.log:
        pad = max((places[-1] / places[0]) ** 0.04, 1.05)
        ends = places[0] / pad, places[-1] * pad
        logarithmic(axes, which, *ends)
    else:
        pad = (0.04 * np.ptp(places) or 0.5) if one.numeric else 0.5
        ends = places[0] - pad, places[-1] + pad
    if which == "y" and not one.numeric:
        ends = ends[::-1]
    axes.set(**{f"{which}label": one.label, f"{which}lim": ends})
    positions = np.log(places) if one.log else places
    close = len(places) > 1 and np.diff(positions).min() < 0.055 * np.ptp(positions)
    if one.numeric and (len(places) > MAX_TICKS or close):
        return
    count = len(places) if which == "x" else 4
    names = [wrapped(one.tick_label(level), count) for level in one.levels]
    width = max(map(len, names)) * len(names)
    rotated = count > MAX_WRAPPED_LABELS and width > LABEL_WIDTH
    style = {"rotation": 25, "ha": "right"} if rotated else {}
    getattr(axes, f"set_{which}ticks")(places, names, **style)
    if one.log:
        axes.tick_params(axis=which, which="minor", length=0)


def wrapped(name: str, count: int) -> str:
    """A tick label wrapped so that `count` labels fit below the axis without overlap."""
    if count > MAX_WRAPPED_LABELS:
        return name
    return textwrap.fill(name, max(LABEL_WIDTH // count, 8))


def logarithmic(axes: Any, which: str, low: float, high: float) -> None:
    """Make axis `which` logarithmic, with plain decimal tick labels."""
    from matplotlib.ticker import NullFormatter

    axes.set(**{f"{which}scale": "log"})
    one = getattr(axes, f"{which}axis")
    locator, formatter = ticks(low, high)
    one.set_major_locator(locator)
    one.set_major_formatter(formatter)
    one.set_minor_formatter(NullFormatter())


# Heat maps and scatter plots of two factors.


def draw_heat(fig: Any, cells: Grid, figure: Heat) -> None:
    """Draw one cell for each pair of levels, hatched if it has no value."""
    from matplotlib.patches import Rectangle

    axes = fig.subplots()
    image = axes.imshow(
        np.ma.masked_invalid(cells.value),
        **color_scale(cells.value, figure),
        aspect="auto",
        origin="lower" if cells.y.numeric else "upper",
    )
    rows, columns = cells.value.shape
    known = np.isfinite(cells.value)
    dotted: Any = {"fill": False, "edgecolor": "white", "hatch": "...", "linewidth": 0}
    for chosen, style in ((~known, HATCHED), (cells.few & known, dotted)):
        for row, column in np.argwhere(chosen):
            axes.add_patch(Rectangle((column - 0.5, row - 0.5), 1, 1, **style))
    if max(rows, columns) <= MAX_CELLS_WITH_TEXT:
        write_values(axes, cells, image)
    for which, one, most in (("x", cells.x, MAX_TICKS * 2 // 3), ("y", cells.y, MAX_TICKS)):
        count = len(one.levels)
        step = math.ceil(count / most) if count > MAX_CELLS_WITH_TEXT else 1
        width = max(columns, 4) if which == "x" else 4
        names = [wrapped(one.tick_label(level), width) for level in one.levels[::step]]
        getattr(axes, f"set_{which}ticks")(range(0, count, step), names)
        axes.set(**{f"{which}label": one.label})
    axes.grid(False)
    add_color_bar(fig, image, figure)


def write_values(axes: Any, cells: Grid, image: Any) -> None:
    """Write the value in each cell, with the number of values where they are few."""
    for row, column in np.argwhere(np.isfinite(cells.value)):
        value = cells.value[row, column]
        ink = "#111111" if is_light(image.to_rgba([value])[0]) else "white"
        text = f"{value:.0f}" if 1000 <= abs(value) < 1e5 else f"{value:.3g}"
        if cells.few[row, column]:
            text += f"\nn={cells.values[row, column]}"
        axes.text(column, row, text, ha="center", va="center", color=ink, fontsize=8)


def draw_scatter(fig: Any, lines: PointTable, figure: Heat) -> None:
    """Draw sampled points over two factors, colored by response."""
    axes = fig.subplots()
    points = lines.shown_in(figure)
    places = []
    for which, name in (("x", figure.x), ("y", figure.y)):
        one = lines.axes[name]
        set_up_axis(axes, which, one)
        places.append(list(map(one.at, points)))
    values = np.array([line.responses[figure.value].value for line in points])
    size = min(max(6000 / max(len(points), 1), 4), 45)
    dots = axes.scatter(*places, c=values, s=size, **color_scale(values, figure))
    add_color_bar(fig, dots, figure)


# Sensitivity.


def indices_png(indices: Sequence[Index], response: str) -> bytes:
    """Bar chart of the first-order and total indices of one response, largest total first, as PNG."""
    selected = [one for one in indices if one.response == response]
    selected.sort(key=lambda one: -np.nan_to_num(one.total.value, nan=-np.inf))
    # (2, 3, F) value and ends of both indices of each factor.
    parts = np.array([[one.first[:3], one.total[:3]] for one in selected], dtype=float)
    parts = np.nan_to_num(parts, posinf=0.0, neginf=0.0).transpose(1, 2, 0)

    def draw(fig: Any) -> None:
        """Two bars per factor, with their intervals."""
        axes = fig.subplots()
        rows = np.arange(len(selected))
        looks = ((-0.19, "first order", INK[0]), (0.19, "total", GRAY))
        for (shift, name, ink), (value, *ends) in zip(looks, parts, strict=True):
            axes.barh(rows + shift, value, 0.36, color=ink, label=name)
            axes.hlines(rows + shift, *ends, color="#333333", linewidth=1)
        right = np.clip(1.05 * parts.max(), 0.1, 2.0)
        axes.set(xlim=(min(1.05 * parts.min(), 0.0), right))
        axes.set_yticks(rows, [one.factor for one in selected])
        axes.set_ylim(len(selected) - 0.4, -0.6)
        axes.grid(False, axis="y")
        axes.set_xlabel(f"share of the variance, {label(response).partition(' [')[0]}")
        fig.legend(loc="outside right upper")

    return png(draw, (7.0, 1.1 + 0.42 * len(selected)))


# Optimizations.


def search_png(
    panels: dict[str, Panel], points: Sequence[int], front: Sequence[int]
) -> bytes:
    """Responses of an optimization against candidate number, stacked panels; Pareto points marked, bounds dashed."""

    def draw(fig: Any) -> None:
        x = np.array(points, dtype=float)
        marked = np.isin(points, front)
        stack = np.ravel(fig.subplots(len(panels), 1, sharex=True))
        for axes, (name, one) in zip(stack, panels.items(), strict=True):
            with_bounds = one._replace(value=np.append(one.value, one.bounds))
            set_up_y_axis(axes, name, [with_bounds], False)
            axes.set_ylabel(one.label.replace(", ", "\n"))
            draw_bars(axes, x, one, GRAY, axes.transData)
            axes.plot(x, one.value, "o", color=GRAY, markersize=3.5)
            axes.plot(x[marked], one.value[marked], "D", color=ORANGE)
            for bound in one.bounds:
                axes.axhline(bound, color="#444444", linestyle="--", linewidth=1)
        axes.set_xlabel("candidate")

    return png(draw, (7.4, 0.6 + 1.9 * len(panels)))


def pareto_png(
    one: Panel,
    other: Panel,
    points: Sequence[int],
    front: Sequence[int],
) -> bytes:
    """Candidates in the plane of the two objectives; Pareto-optimal ones are joined and, if few, labeled."""

    def draw(fig: Any) -> None:
        axes = fig.subplots()
        axes.plot(one.value, other.value, "o", color=GRAY, label="candidate")
        marked = np.flatnonzero(np.isin(points, front))
        marked = marked[np.argsort(one.value[marked], kind="stable")]
        x = one.value[marked]
        y = other.value[marked]
        low = other.low[marked]
        high = other.high[marked]
        axes.set_ylim(*limits([other.value], [low, high], False, False))
        axes.vlines(x, low, high, color=ORANGE, alpha=0.5, linewidth=1)
        axes.plot(x, y, "D--", color=ORANGE, label="front")
        if len(x) <= MAX_LABELED_POINTS:
            for n, *at in zip(marked.tolist(), x, y, strict=True):
                annotate(axes, str(points[n]), at, ORANGE, fontsize=8)
        axes.set(xlabel=one.label, ylabel=other.label)
        fig.legend(loc="outside right upper")

    return png(draw, (7.0, 4.4))
