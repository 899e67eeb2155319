"""Plot style shared by all figures (colors, lines, markers), and rendering of a figure to PNG."""

from __future__ import annotations

import io as std_io
from collections.abc import Callable, Sequence
from typing import Any

DPI = 120
# Palette for color-blind readers (Okabe & Ito 2008), plus two colors.
INK = ["#0072b2", "#d55e00", "#009e73", "#cc79a7", "#e69f00", "#56b4e9", "#555555", "#882255"]
MARKS = "osD^vP<X"
LOOK: Any = {
    "font.size": 9,
    "axes.spines.top": False,
    "axes.spines.right": False,
    "axes.edgecolor": "#888888",
    "axes.grid": True,
    "grid.color": "#e8e8e8",
    "grid.linewidth": 0.6,
    "axes.axisbelow": True,
    "xtick.color": "#444444",
    "ytick.color": "#444444",
    "legend.frameon": False,
    "lines.linewidth": 1.2,
    "text.parse_math": False,
    "lines.markersize": 4.5,
    "hatch.color": "#b8b8b8",
    "hatch.linewidth": 0.7,
}


def png(draw: Callable[[Any], None], size_in: tuple[float, float]) -> bytes:
    """PNG bytes of the figure that `draw` fills, in the shared style, without a software tag (reproducible bytes)."""
    import matplotlib
    from matplotlib.figure import Figure as Canvas

    with matplotlib.rc_context(LOOK):
        fig = Canvas(figsize=size_in, layout="constrained")
        draw(fig)
        return figure_png(fig, dpi=DPI, metadata={"Software": None})


def figure_png(fig: Any, **options: Any) -> bytes:
    """PNG bytes of a figure. options : of `savefig`"""
    buffer = std_io.BytesIO()
    fig.savefig(buffer, format="png", **options)
    return buffer.getvalue()


def stacked_axes(heights_in: Sequence[float]) -> tuple[Any, list[Any]]:
    """A figure with one panel above the other over a common time axis, heights in inches, and its axes from the top.

    The margins are fixed: to measure all labels first (`layout="constrained"`) doubles the time of drawing.
    """
    from matplotlib.figure import Figure

    width_in = 10
    left_in = 0.95
    right_in = 0.15
    top_in = 0.12
    bottom_in = 0.55
    gap_in = 0.15
    height_in = top_in + sum(heights_in) + gap_in * (len(heights_in) - 1) + bottom_in
    fig = Figure(figsize=(width_in, height_in))
    grid = fig.add_gridspec(
        len(heights_in),
        height_ratios=heights_in,
        left=left_in / width_in,
        right=1 - right_in / width_in,
        bottom=bottom_in / height_in,
        top=1 - top_in / height_in,
        hspace=gap_in * len(heights_in) / sum(heights_in),
    )
    stack = list(grid.subplots(sharex=True, squeeze=False)[:, 0])
    for axes in stack:
        axes.grid(alpha=0.3)
    stack[-1].set_xlabel("time [s]")
    return fig, stack
