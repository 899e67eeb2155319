"""Draw a study's figures, each as a PNG. `layout` selects their contents."""

import math
import textwrap
from collections.abc import Sequence
from typing import Any

import numpy as np

from skysim.core.types import Floats, Record
from skysim.experiments.study.plan import Curve, Heat, Map, Study
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
    PointRows,
    axis,
    is_sampled,
    label,
    shown_points,
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
    """Color map and normalization of a response: every proportion has the same, from 0 to 1."""
    from matplotlib.colors import Normalize

    share = is_proportion(figure.response)
    if share and not figure.log:
        return {"cmap": SHARE_COLORS, "norm": Normalize(0, 1)}
    colors = SHARE_COLORS if share else COLORS
    if split_name(figure.response)[0] in MORE_IS_BETTER:
        colors += "_r"
    return {"cmap": colors, "norm": color_norm(values, figure.log)}


def color_norm(values: Floats, log: bool) -> Any:
    """Color normalization over the finite values; a valid default range if all are equal or there are none."""
    from matplotlib.colors import LogNorm, Normalize

    finite = values[np.isfinite(values) & ((values > 0) | (not log))]
    low = float(finite.min()) if len(finite) else 0.5
    high = float(finite.max()) if len(finite) else 1.0
    if high <= low:
        high = low + (abs(low) or 1.0)
    return LogNorm(low, high, clip=True) if log else Normalize(low, high)


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


MAX_TICKS = 16  # maximum number of levels that have a tick each
# Maximum number of tick labels that are wrapped; with more, long ones are rotated.
MAX_WRAPPED_LABELS = 8
LABEL_WIDTH = 88  # characters that fit below an axis
# Maximum rows and columns of a heat map with values written in its cells.
MAX_CELLS_WITH_TEXT = 12
MAX_LABELED_POINTS = 12  # maximum number of Pareto points that are labeled
GRAY = "#8fa1b3"
ORANGE = "#d55e00"


def figure_png(lines: PointRows, figure: Curve | Heat, study: Study) -> bytes:
    """A curve or heat map as PNG. Raises InputError if its `where` names an unknown factor or level."""
    if isinstance(figure, Curve):
        return png(lambda fig: draw_curve(fig, lines, figure, study), (7.4, 3.9))
    if is_sampled(study):
        return png(lambda fig: draw_scatter(fig, lines, figure, study), (7.0, 4.4))
    cells = grid(lines, figure, study)
    rows, columns = cells.value.shape
    width_in = min(max(2.6 + 0.6 * columns, 4.6), 9.6)
    height_in = min(max(1.2 + 0.42 * rows, 2.6), 7.0)
    return png(lambda fig: draw_heat(fig, cells, figure), (width_in, height_in))


# Curves.


def draw_curve(fig: Any, lines: PointRows, figure: Curve, study: Study) -> None:
    """Draw series with their intervals; sampled points as markers, with a running median if they are many."""
    axes = fig.subplots()
    x_axis = axis(study, lines, figure.x)
    sampled = is_sampled(study)
    shown = series(lines, figure, study)
    dots = draws_medians(study, x_axis, sum(len(one.x) for one in shown))
    set_up_y_axis(axes, figure.y, shown, figure.log, not dots)
    set_up_x_axis(axes, x_axis)
    if (expected := expected_value(figure.y)) is not None:
        axes.axhline(expected, color="#777777", linestyle=":", linewidth=1.2)
    group_axis = axis(study, lines, figure.by) if figure.by is not None else None
    inks = colors(len(shown), group_axis)
    # Bars of several series are side by side.
    widest_pt, room_pt = (3.0, 20.0) if x_axis.numeric else (6.0, 60.0)
    step_pt = min(widest_pt, room_pt / max(len(shown), 1))
    middle = (len(shown) - 1) / 2
    for n, (one, ink) in enumerate(zip(shown, inks, strict=True)):
        mark = MARKS[n % len(MARKS)]
        if sampled:
            draw_points(axes, one, ink, mark, x_axis.numeric, dots)
        else:
            draw_line(axes, one, ink, mark, x_axis, (n - middle) * step_pt)
    draw_thresholds(axes, figure, study, lines, group_axis)
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
    axes: Any, figure: Curve, study: Study, lines: PointRows, group_axis: Axis | None
) -> None:
    """Draw the thresholds of this curve: the limit dashed, a tick at each crossing and a bar over its interval."""
    for threshold in thresholds_of(figure, study, lines):
        axes.axhline(threshold.limit, color="#777777", linestyle="--", linewidth=0.8)
        found = crossings(threshold, study, lines)
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
    axes: Any, one: Series, ink: Any, mark: str, x_axis: Axis, step_pt: float
) -> None:
    """Draw one series, offset sideways by `step_pt` points; named levels are joined by a dotted line.

    On a logarithmic axis a value of zero cannot be drawn; an open triangle marks its upper bound.
    """
    from matplotlib.transforms import offset_copy

    offset = offset_copy(axes.transData, axes.figure, x=step_pt, units="points")
    low, high = drawn_interval(axes, one)
    if x_axis.numeric and len(x_axis.levels) > MAX_X_WITH_BARS:
        offset = axes.transData
        axes.fill_between(one.x, low, high, color=ink, alpha=0.15, linewidth=0)
    else:
        draw_bars(axes, one.x, one, ink, offset)
    # The line skips points with few values, because these come from the easy trials only.
    style = {"color": ink, "transform": offset}
    joined = np.where(one.few, np.nan, one.value)
    line = "-" if x_axis.numeric else ":"
    axes.plot(one.x, joined, label=one.label or None, marker=mark, linestyle=line, **style)
    draw_few(axes, one, mark, **style)
    if axes.get_yscale() == "log":
        none = (one.value <= 0) & (one.high > 0)
        axes.plot(one.x[none], one.high[none], "v", markerfacecolor="white", **style)


def draw_few(axes: Any, one: Series, mark: str, **style: Any) -> None:
    """Draw points that have few values as hollow marks, each with its number of values."""
    axes.plot(one.x[one.few], one.value[one.few], mark, markerfacecolor="white", **style)
    text = {
        "fontsize": 6.5,
        "color": style["color"],
        "path_effects": [halo()],
        "xytext": (4, 4),
        "textcoords": "offset points",
        "xycoords": style["transform"],
    }
    for n in np.flatnonzero(one.few & np.isfinite(one.value)):
        axes.annotate(f"n={one.values[n]}", (one.x[n], one.value[n]), **text)


def draw_points(
    axes: Any, one: Series, ink: Any, mark: str, numeric: bool, dots: bool
) -> None:
    """Draw sampled points: with error bars, or, if they are many, with their running median.

    On an axis of named levels the median at each level replaces the running median.
    """
    style = {"marker": mark, "color": ink, "linestyle": "none"}
    if not dots:
        draw_bars(axes, one.x, one, ink, axes.transData)
        axes.plot(
            one.x, np.where(one.few, np.nan, one.value), label=one.label or None, **style
        )
        draw_few(axes, one, mark, color=ink, transform=axes.transData)
        return
    size = min(max(4.5 * (MAX_POINTS_WITH_BARS / len(one.x)) ** 0.3, 1.8), 4.5)
    axes.plot(one.x, one.value, markersize=size, markeredgewidth=0, alpha=0.5, **style)
    style = {"linewidth": 2.2}
    if not numeric:
        style = {
            "marker": "_",
            "markersize": 26,
            "markeredgewidth": 2.2,
            "linestyle": "none",
        }
    axes.plot(*medians(one, numeric), color=ink, label=one.label or None, **style)


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


def set_up_x_axis(axes: Any, x_axis: Axis) -> None:
    """Set up the x axis: one tick per level if they are few, with labels rotated if they would overlap."""
    axes.set_xlabel(x_axis.label)
    places = np.array([x_axis.coordinate(one) for one in x_axis.levels])
    if x_axis.log:
        pad = max((places[-1] / places[0]) ** 0.04, 1.05)
        ends = places[0] / pad, places[-1] * pad
        logarithmic(axes, "x", *ends)
    else:
        pad = (0.04 * np.ptp(places) or 0.5) if x_axis.numeric else 0.5
        ends = places[0] - pad, places[-1] + pad
    axes.set_xlim(*ends)
    positions = np.log(places) if x_axis.log else places
    close = len(places) > 1 and np.diff(positions).min() < 0.055 * np.ptp(positions)
    if x_axis.numeric and (len(places) > MAX_TICKS or close):
        return
    names = [wrapped(x_axis.tick_label(one), len(places)) for one in x_axis.levels]
    width = max(map(len, names)) * len(names)
    rotated = len(places) > MAX_WRAPPED_LABELS and width > LABEL_WIDTH
    axes.set_xticks(places, names, rotation=25 * rotated, ha="right" if rotated else "center")
    if x_axis.log:
        axes.tick_params(axis="x", which="minor", length=0)


def wrapped(name: str, count: int) -> str:
    """A tick label wrapped so that `count` labels fit below the axis without overlap."""
    if count > MAX_WRAPPED_LABELS:
        return name
    return textwrap.fill(name, max(LABEL_WIDTH // count, 8))


def logarithmic(axes: Any, which: str, low: float, high: float) -> None:
    """Make axis `which` logarithmic, with plain decimal tick labels."""
    from matplotlib.ticker import NullFormatter

    getattr(axes, f"set_{which}scale")("log")
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
        getattr(axes, f"set_{which}ticks")(range(0, len(one.levels), step), names)
        getattr(axes, f"set_{which}label")(one.label)
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


def draw_scatter(fig: Any, lines: PointRows, figure: Heat, study: Study) -> None:
    """Draw sampled points over two factors, colored by response."""
    axes = fig.subplots()
    points = shown_points(lines, figure, study)
    x = axis(study, lines, figure.x)
    y = axis(study, lines, figure.y)
    across = list(map(x.at, points))
    up = list(map(y.at, points))
    values = np.array([line.responses[figure.value].value for line in points])
    size = min(max(6000 / max(len(points), 1), 4), 45)
    set_up_x_axis(axes, x)
    if y.log:
        logarithmic(axes, "y", min(up), max(up))
    elif not y.numeric:
        axes.set_yticks(
            range(len(y.levels)), [wrapped(y.tick_label(one), 4) for one in y.levels]
        )
        axes.set_ylim(len(y.levels) - 0.5, -0.5)
    dots = axes.scatter(across, up, c=values, s=size, **color_scale(values, figure))
    axes.set_ylabel(y.label)
    add_color_bar(fig, dots, figure)


# Sensitivity.


def indices_png(indices: Sequence[Index], response: str) -> bytes:
    """Bar chart of the first-order and total indices of one response, largest total first, as PNG."""
    selected = [one for one in indices if one.response == response]
    selected.sort(key=lambda one: -np.nan_to_num(one.total.value, nan=-np.inf))

    def draw(fig: Any) -> None:
        """Two bars per factor, with their intervals."""
        axes = fig.subplots()
        rows = np.arange(len(selected))
        for shift, name, ink, parts in (
            (-0.19, "first order", INK[0], [one.first[:3] for one in selected]),
            (0.19, "total", GRAY, [one.total[:3] for one in selected]),
        ):
            value, low, high = np.array(parts, dtype=float).reshape(-1, 3).T
            axes.barh(rows + shift, np.nan_to_num(value), 0.36, color=ink, label=name)
            ends = np.clip([low, high], -9, 9)
            axes.hlines(rows + shift, *ends, color="#333333", linewidth=1)
        bounds = np.array(
            [end for one in selected for end in (*one.first[:3], *one.total[:3], 0.0)]
        )
        bounds = bounds[np.isfinite(bounds)]
        left = min(1.05 * bounds.min(), 0.0)
        right = np.clip(1.05 * bounds.max(), 0.1, 2.0)
        axes.set_xlim(left, right)
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
        style: Any = {
            "fontsize": 8,
            "color": ORANGE,
            "path_effects": [halo()],
            "xytext": (5, 5),
            "textcoords": "offset points",
        }
        if len(x) <= MAX_LABELED_POINTS:
            for n, *at in zip(marked.tolist(), x, y, strict=True):
                axes.annotate(str(points[n]), at, **style)
        axes.set_xlabel(one.label)
        axes.set_ylabel(other.label)
        fig.legend(loc="outside right upper")

    return png(draw, (7.0, 4.4))
