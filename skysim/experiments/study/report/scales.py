"""Color scales of a study's figures, outlines of texts, and ticks of logarithmic axes."""

from __future__ import annotations

from typing import Any

import numpy as np

from skysim.core.types import Floats
from skysim.experiments.study.analysis.axes import is_share, label
from skysim.experiments.study.plan import Heat, Map
from skysim.results.metrics import MORE_IS_BETTER, split_name

SHARE_COLORS = "cividis"  # color map of all proportions
COLORS = "YlOrRd"  # of other responses, dark where they are bad: reversed where more is better
HATCHED: Any = {
    "facecolor": "#eeeeee",
    "edgecolor": "#b8b8b8",
    "hatch": "////",
    "linewidth": 0,
}  # a cell without value


def add_color_bar(fig: Any, image: Any, figure: Heat | Map, **where: Any) -> None:
    """Add the color bar, labeled with the response."""
    locator, formatter = ticks(image.norm.vmin, image.norm.vmax) if figure.log else (None, None)
    fig.colorbar(
        image, label=label(figure.response), ticks=locator, format=formatter, **where
    ).minorticks_off()


def color_scale(values: Floats, figure: Heat | Map) -> dict[str, Any]:
    """Color map and normalization of a response: every proportion has the same, from 0 to 1."""
    from matplotlib.colors import Normalize

    if is_share(figure.response) and not figure.log:
        return {"cmap": SHARE_COLORS, "norm": Normalize(0, 1)}
    colors = SHARE_COLORS if is_share(figure.response) else COLORS
    if split_name(figure.response)[0] in MORE_IS_BETTER:
        colors += "_r"
    return {"cmap": colors, "norm": color_norm(values, figure.log)}


def color_norm(values: Floats, log: bool) -> Any:
    """Color normalization over the finite values; a valid default range if all are equal or there are none."""
    from matplotlib.colors import LogNorm, Normalize

    finite = values[np.isfinite(values) & ((values > 0) | (not log))]
    low, high = (float(finite.min()), float(finite.max())) if len(finite) else (0.5, 1.0)
    high = high if high > low else low + (abs(low) or 1.0)
    return LogNorm(low, high, clip=True) if log else Normalize(low, high)


def ticks(low: float, high: float) -> tuple[Any, Any]:
    """Tick locator and formatter of a logarithmic axis.

    Ticks are at each decade over three decades or more, at 1, 2 and 5 of each decade over less, and at round numbers
    if the range is a factor of 8 or less.
    """
    from matplotlib.ticker import FuncFormatter, LogLocator, MaxNLocator

    where = (
        LogLocator(subs=(1, 2, 5) if high < 1000 * low else (1,))
        if high > 8 * low
        else MaxNLocator(5)
    )
    return where, FuncFormatter(lambda value, _: f"{value:.6g}")


def halo() -> Any:
    """A white outline that keeps text and marks readable on any color."""
    from matplotlib.patheffects import withStroke

    return withStroke(linewidth=2.2, foreground="white")
