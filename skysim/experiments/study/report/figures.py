"""Draw a study's figures, each as a PNG. `layout` selects their contents."""

from __future__ import annotations

import math
import textwrap
from collections.abc import Sequence
from typing import TYPE_CHECKING, Any

import numpy as np

from skysim.core.types import Floats
from skysim.experiments.study.analysis.table import Line
from skysim.experiments.study.plan import Curve, Figure, Heat, Study
from skysim.experiments.study.report import layout
from skysim.experiments.study.report.layout import CROWD, Axis, Grid, Panel, Series, is_drawn, label
from skysim.results.plots import INK, MARKS, png

if TYPE_CHECKING:
    from skysim.experiments.study.analysis.sensitivity import Index

TICKS = 16  # maximum number of levels with a tick each
UPRIGHT = 8  # maximum number of tick labels that are wrapped; with more, long ones are rotated
WIDE = 88  # characters that fit below an axis
WRITTEN = 12  # maximum rows and columns of a heat map with values written in its cells
NAMED = 12  # maximum number of Pareto points that are labeled
QUIET, FRONT = "#8fa1b3", "#d55e00"


def figure_png(lines: Sequence[Line], figure: Figure, study: Study) -> bytes:
    """A figure of a study as PNG. Raises InputError if its `where` names an unknown factor or level."""
    if isinstance(figure, Curve):
        return png(lambda fig: draw_curve(fig, lines, figure, study), (7.4, 3.9))
    if is_drawn(study):
        return png(lambda fig: draw_scatter(fig, lines, figure, study), (7.0, 4.4))
    cells = layout.grid(lines, figure, study)
    rows, columns = cells.value.shape
    size = float(np.clip(2.6 + 0.6 * columns, 4.6, 9.6)), float(np.clip(1.2 + 0.42 * rows, 2.6, 7.0))
    return png(lambda fig: draw_heat(fig, cells, figure), size)


# Curves.


def draw_curve(fig: Any, lines: Sequence[Line], figure: Curve, study: Study) -> None:
    """Draw series with their intervals; sampled points as markers, with a running median if they are many."""
    axes, across, loose = fig.subplots(), layout.axis(study, lines, figure.x), is_drawn(study)
    shown = layout.series(lines, figure, study)
    dots = layout.in_dots(study, across, sum(len(one.x) for one in shown))
    upright(axes, figure.y, shown, figure.log, not dots)
    along(axes, across)
    apart = layout.axis(study, lines, figure.by) if figure.by is not None else None
    for n, one in enumerate(shown):
        ink = colour(n, len(shown), apart is not None and apart.numeric)
        wide_pt = min(3.0, 20 / len(shown)) if across.numeric else min(6.0, 60 / len(shown))
        step_pt = (n - (len(shown) - 1) / 2) * wide_pt  # bars side by side
        if loose:
            draw_points(axes, one, ink, MARKS[n % len(MARKS)], across.numeric, dots)
        else:
            draw_line(axes, one, ink, MARKS[n % len(MARKS)], across, step_pt)
    if not any(np.isfinite(one.value).any() for one in shown):
        axes.text(0.5, 0.5, "nothing yet", transform=axes.transAxes, ha="center", color="#888888")
    if apart is not None and shown:
        columns = math.ceil(len(shown) / 14)
        fig.legend(title=apart.label, loc="outside right upper", ncols=columns, alignment="left")


def upright(axes: Any, name: str, shown: Sequence[Series | Panel], log: bool, bars: bool = True) -> None:
    """Set up the y axis: limits that include all values and, if drawn, their error bars; label and scale."""
    ends = [end for one in shown for end in (one.low, one.high)] if bars else []
    low, high = layout.limits([one.value for one in shown], ends, log, layout.is_share(name))
    if log:
        logarithmic(axes, "y", low, high)
    axes.set_ylim(low, high)
    axes.set_ylabel(label(name))


def draw_line(axes: Any, one: Series, ink: Any, mark: str, across: Axis, step_pt: float) -> None:
    """Draw one series, offset sideways by `step_pt` points; named levels are joined by a dotted line.

    On a logarithmic axis a value of zero cannot be drawn; an open triangle marks its upper bound.
    """
    from matplotlib.transforms import offset_copy

    beside = offset_copy(axes.transData, axes.figure, x=step_pt, units="points")
    low, high = reach(axes, one)
    if layout.in_bands(across):
        beside = axes.transData
        low, high = np.where(np.isinf(one.low), one.value, low), np.where(np.isinf(one.high), one.value, high)
        axes.fill_between(one.x, low, high, color=ink, alpha=0.15, linewidth=0)
    else:
        draw_bars(axes, one, ink, beside)
    style = {"marker": mark, "color": ink, "linestyle": "-" if across.numeric else ":", "transform": beside}
    axes.plot(one.x, one.value, label=one.label or None, **style)
    if axes.get_yscale() == "log":
        none = (one.value <= 0) & (one.high > 0)
        axes.plot(one.x[none], one.high[none], "v", color=ink, markerfacecolor="white", transform=beside)


def draw_points(axes: Any, one: Series, ink: Any, mark: str, numeric: bool, dots: bool) -> None:
    """Draw sampled points: with error bars, or, if they are many, with their running median.

    On an axis of named levels the median at each level replaces the running median.
    """
    style = {"marker": mark, "color": ink, "linestyle": "none"}
    if not dots:
        draw_bars(axes, one, ink, axes.transData)
        axes.plot(one.x, one.value, label=one.label or None, **style)
        return
    size = min(max(4.5 * (CROWD / len(one.x)) ** 0.3, 1.8), 4.5)
    axes.plot(one.x, one.value, markersize=size, markeredgewidth=0, alpha=0.5, **style)
    if numeric:
        axes.plot(*running(one), color=ink, linewidth=2.2, label=one.label or None)
    else:
        medians = {"marker": "_", "markersize": 26, "markeredgewidth": 2.2, "linestyle": "none"}
        axes.plot(*by_name(one), color=ink, label=one.label or None, **medians)


def draw_bars(axes: Any, one: Series | Panel, ink: Any, where: Any, x: Floats | None = None) -> None:
    """Draw intervals as bars; an infinite bound extends beyond the axis limits."""
    places = one.x if isinstance(one, Series) else x
    low, high = reach(axes, one)
    axes.vlines(places, low, high, color=ink, alpha=0.6, linewidth=1, transform=where)
    for end in (one.low, one.high):
        axes.plot(
            places,
            np.where(np.isfinite(end), end, np.nan),
            "_",
            color=ink,
            alpha=0.6,
            markersize=6,
            transform=where,
        )


def reach(axes: Any, one: Series | Panel) -> tuple[Floats, Floats]:
    """Interval bounds for drawing; infinite bounds, and those <= 0 on a logarithmic axis, are moved to a point well
    outside the axis limits."""
    bottom, top = axes.get_ylim()
    beyond = (bottom / 10, top * 10) if axes.get_yscale() == "log" else (2 * bottom - top, 2 * top - bottom)
    return np.clip(one.low, *beyond), np.clip(one.high, *beyond)


def running(one: Series) -> tuple[Floats, Floats]:
    """Medians of x and of value in twelve groups of equal size, along a series ascending in x."""
    good = np.isfinite(one.value)
    parts = zip(np.array_split(one.x[good], 12), np.array_split(one.value[good], 12), strict=True)
    told = np.array([(np.median(x), np.median(y)) for x, y in parts if len(x)]).reshape(-1, 2)
    return told[:, 0], told[:, 1]


def by_name(one: Series) -> tuple[Floats, Floats]:
    """Median of the values at each distinct x."""
    places = np.unique(one.x[np.isfinite(one.value)])
    return places, np.array([np.nanmedian(one.value[one.x == place]) for place in places])


def colour(n: int, count: int, ordered: bool) -> Any:
    """Color of line n of `count`: from a color scale if the lines are ordered, else from the palette."""
    from matplotlib import colormaps

    return colormaps["viridis"](0.82 * n / max(count - 1, 1)) if ordered and count > 2 else INK[n % len(INK)]


def along(axes: Any, across: Axis) -> None:
    """Set up the x axis: one tick per level if they are few, with labels rotated if they would overlap."""
    axes.set_xlabel(across.label)
    places = np.array([across.place(one) for one in across.levels])
    if across.log:
        pad = max((places[-1] / places[0]) ** 0.04, 1.05)
        logarithmic(axes, "x", places[0] / pad, places[-1] * pad)
        axes.set_xlim(places[0] / pad, places[-1] * pad)
    else:
        pad = (0.04 * np.ptp(places) or 0.5) if across.numeric else 0.5
        axes.set_xlim(places[0] - pad, places[-1] + pad)
    told = np.log(places) if across.log else places
    close = len(places) > 1 and np.diff(told).min() < 0.055 * np.ptp(told)
    if across.numeric and (len(places) > TICKS or close):
        return
    names = [wrapped(across.told(one), len(places)) for one in across.levels]
    turned = len(places) > UPRIGHT and max(map(len, names)) * len(names) > WIDE
    axes.set_xticks(places, names, rotation=25 if turned else 0, ha="right" if turned else "center")
    if across.log:
        axes.tick_params(axis="x", which="minor", length=0)


def wrapped(name: str, count: int) -> str:
    """A tick label wrapped so that `count` labels fit below the axis without overlap."""
    return textwrap.fill(name, max(WIDE // count, 8)) if count <= UPRIGHT else name


def logarithmic(axes: Any, which: str, low: float, high: float) -> None:
    """Make axis `which` logarithmic, with plain decimal tick labels."""
    from matplotlib.ticker import NullFormatter

    getattr(axes, f"set_{which}scale")("log")
    one = getattr(axes, f"{which}axis")
    locator, formatter = ticks(low, high)
    one.set_major_locator(locator)
    one.set_major_formatter(formatter)
    one.set_minor_formatter(NullFormatter())


def ticks(low: float, high: float) -> tuple[Any, Any]:
    """Tick locator and formatter of a logarithmic axis.

    Ticks are at each decade over three decades or more, at 1, 2 and 5 of each decade over less, and at round numbers
    if the range is a factor of 8 or less.
    """
    from matplotlib.ticker import FuncFormatter, LogLocator, MaxNLocator

    where = LogLocator(subs=(1, 2, 5) if high < 1000 * low else (1,)) if high > 8 * low else MaxNLocator(5)
    return where, FuncFormatter(lambda value, _: f"{value:.6g}")


# Heat maps and scatter plots of two factors.


def draw_heat(fig: Any, cells: Grid, figure: Heat) -> None:
    """Draw one cell for each pair of levels, hatched if it has no value."""
    axes = fig.subplots()
    image = axes.imshow(
        np.ma.masked_invalid(cells.value),
        cmap="cividis",
        norm=norm(cells.value, figure.log),
        aspect="auto",
        origin="lower" if cells.y.numeric else "upper",
    )
    rows, columns = cells.value.shape
    for row, column in np.argwhere(~np.isfinite(cells.value)):
        place = (column - 0.5, row - 0.5)
        axes.add_patch(patch(place, facecolor="#eeeeee", edgecolor="#b8b8b8", hatch="////", linewidth=0))
    if max(rows, columns) <= WRITTEN:
        for (row, column), value in np.ndenumerate(cells.value):
            if np.isfinite(value):
                light = np.dot(image.to_rgba([value])[0][:3], (0.299, 0.587, 0.114)) > 0.5
                ink = "#111111" if light else "white"
                axes.text(column, row, short(value), ha="center", va="center", color=ink, fontsize=8)
    for which, one, most in (("x", cells.x, TICKS * 2 // 3), ("y", cells.y, TICKS)):
        step = max(math.ceil(len(one.levels) / most), 1) if len(one.levels) > WRITTEN else 1
        names = [
            wrapped(one.told(level), max(columns, 4) if which == "x" else 4) for level in one.levels[::step]
        ]
        getattr(axes, f"set_{which}ticks")(range(0, len(one.levels), step), names)
        getattr(axes, f"set_{which}label")(one.label)
    axes.grid(False)
    bar(fig, image, figure)


def bar(fig: Any, image: Any, figure: Heat) -> None:
    """Add the color bar, labeled with the response."""
    locator, formatter = ticks(image.norm.vmin, image.norm.vmax) if figure.log else (None, None)
    fig.colorbar(image, label=label(figure.value), ticks=locator, format=formatter).minorticks_off()


def norm(values: Floats, log: bool) -> Any:
    """Color normalization over the finite values; a valid default range if all are equal or there are none."""
    from matplotlib.colors import LogNorm, Normalize

    told = values[np.isfinite(values) & ((values > 0) | (not log))]
    low, high = (float(told.min()), float(told.max())) if len(told) else (0.5, 1.0)
    high = high if high > low else low + (abs(low) or 1.0)
    return LogNorm(low, high, clip=True) if log else Normalize(low, high)


def patch(place: tuple[float, float], **look: Any) -> Any:
    """A rectangle of one heat map cell."""
    from matplotlib.patches import Rectangle

    return Rectangle(place, 1, 1, **look)


def short(value: float) -> str:
    """A number in a form short enough for a cell."""
    return f"{value:.0f}" if 1000 <= abs(value) < 1e5 else f"{value:.3g}"


def draw_scatter(fig: Any, lines: Sequence[Line], figure: Heat, study: Study) -> None:
    """Draw sampled points over two factors, colored by response."""
    axes, chosen = fig.subplots(), layout.kept(lines, figure, study)
    x, y = (layout.axis(study, lines, name) for name in (figure.x, figure.y))
    places = [(x.place(line.levels[figure.x]), y.place(line.levels[figure.y])) for line in chosen]
    values = np.array([line.responses[figure.value].value for line in chosen])
    told = np.array(places).reshape(-1, 2)
    size = float(np.clip(6000 / max(len(told), 1), 4, 45))
    along(axes, x)
    if y.log:
        logarithmic(axes, "y", *np.quantile(told[:, 1], (0, 1)))
    elif not y.numeric:
        axes.set_yticks(range(len(y.levels)), [wrapped(y.told(one), 4) for one in y.levels])
        axes.set_ylim(len(y.levels) - 0.5, -0.5)
    dots = axes.scatter(*told.T, c=values, s=size, cmap="cividis", norm=norm(values, figure.log))
    axes.set_ylabel(y.label)
    bar(fig, dots, figure)


# Sensitivity.


def indices_png(indices: Sequence[Index], response: str) -> bytes:
    """Bar chart of the first-order and total Sobol indices of one response, largest total first, as PNG."""
    told = [one for one in indices if one.response == response]
    told.sort(key=lambda one: -np.nan_to_num(one.total.value, nan=-np.inf))
    return png(lambda fig: draw_indices(fig, told, response), (7.0, 1.1 + 0.42 * len(told)))


def draw_indices(fig: Any, told: Sequence[Index], response: str) -> None:
    """Draw two bars per factor, with their intervals."""
    axes, rows = fig.subplots(), np.arange(len(told))
    for shift, name, ink, parts in (
        (-0.19, "first order", INK[0], [one.first for one in told]),
        (0.19, "total", QUIET, [one.total for one in told]),
    ):
        value, low, high = (np.array([one[n] for one in parts], dtype=float) for n in range(3))
        axes.barh(rows + shift, np.nan_to_num(value), 0.36, color=ink, label=name)
        axes.hlines(rows + shift, np.clip(low, -9, 9), np.clip(high, -9, 9), color="#333333", linewidth=1)
    ends = np.array([end for one in told for end in (*one.first[:3], *one.total[:3], 0.0)])
    ends = ends[np.isfinite(ends)]
    axes.set_xlim(min(ends.min() * 1.05, 0.0), max(min(ends.max() * 1.05, 2.0), 0.1))
    axes.set_yticks(rows, [one.factor for one in told])
    axes.set_ylim(len(told) - 0.4, -0.6)
    axes.grid(False, axis="y")
    axes.set_xlabel(f"share of the variance, {label(response).partition(' [')[0]}")
    fig.legend(loc="outside right upper")


# Optimizations.


def search_png(panels: dict[str, Panel], points: Sequence[int], front: Sequence[int]) -> bytes:
    """Responses of an optimization against candidate number, stacked panels; Pareto points marked, bounds dashed."""

    def draw(fig: Any) -> None:
        x, marked = np.array(points, dtype=float), np.isin(points, front)
        for axes, (name, one) in zip(
            np.ravel(fig.subplots(len(panels), 1, sharex=True)), panels.items(), strict=True
        ):
            upright(axes, name, [one._replace(value=np.append(one.value, one.bounds))], False)
            axes.set_ylabel(one.label.replace(", ", "\n"))
            draw_bars(axes, one, QUIET, axes.transData, x)
            axes.plot(x, one.value, "o", color=QUIET, markersize=3.5)
            axes.plot(x[marked], one.value[marked], "D", color=FRONT)
            for bound in one.bounds:
                axes.axhline(bound, color="#444444", linestyle="--", linewidth=1)
        axes.set_xlabel("candidate")

    return png(draw, (7.4, 0.6 + 1.9 * len(panels)))


def pareto_png(one: Panel, other: Panel, points: Sequence[int], front: Sequence[int]) -> bytes:
    """Candidates in the plane of the two objectives; Pareto-optimal ones are joined and, if few, labeled."""
    from matplotlib.patheffects import withStroke

    def draw(fig: Any) -> None:
        axes, marked = fig.subplots(), np.flatnonzero(np.isin(points, front))
        axes.plot(one.value, other.value, "o", color=QUIET, label="candidate")
        marked = marked[np.argsort(one.value[marked], kind="stable")]
        low, high = layout.limits([other.value], [other.low[marked], other.high[marked]], False, False)
        axes.set_ylim(low, high)
        low_m, high_m = reach(axes, Panel("", other.value, other.low, other.high, []))
        axes.vlines(one.value[marked], low_m[marked], high_m[marked], color=FRONT, alpha=0.5, linewidth=1)
        axes.plot(one.value[marked], other.value[marked], "D--", color=FRONT, label="front")
        for n in marked.tolist() if len(marked) <= NAMED else ():
            place = (one.value[n], other.value[n])
            look = {
                "fontsize": 8,
                "color": FRONT,
                "path_effects": [withStroke(linewidth=2.5, foreground="white")],
            }
            axes.annotate(str(points[n]), place, xytext=(5, 5), textcoords="offset points", **look)
        axes.set_xlabel(one.label)
        axes.set_ylabel(other.label)
        fig.legend(loc="outside right upper")

    return png(draw, (7.0, 4.4))
