"""Residuals of each light over a flight: their mean and scatter, worst first, in a table and as arrows on the dome.

A wrong place of a light is constant in the lab frame, so residuals are compared along its axes.
"""

from collections.abc import Sequence

import numpy as np
from nicegui import ui

from skysim.apps.gui.messages import Residual
from skysim.core.types import Floats, Ints, lengths


class FlightLights(ui.element, component="js/residuals.js"):  # type: ignore[call-arg]
    """The table, and the switch of the arrows in the 3-D view, implemented in residuals.js."""


def by_light(residuals: Sequence[Residual]) -> tuple[Ints, Ints, Floats, Floats]:
    """Mean and scatter of the residuals of N lights, the greatest mean first.

    Returns
    -------
    ids, frames
        (N,) numbers of the lights, and of the frames in which each was identified
    mean_px
        (N, 3) means along the axes of the lab frame
    scatter_px
        (N,) root mean square of the residuals about them, with frames - 1 degrees of freedom (NaN for one frame)
    """
    ids, rows, frames = np.unique(
        [one.id for one in residuals], return_inverse=True, return_counts=True
    )
    vectors_px = np.array([one.lab_px for one in residuals]).reshape(-1, 3)
    mean_px = np.zeros((len(ids), 3))
    np.add.at(mean_px, rows, vectors_px / frames[rows, None])
    squares_px2 = np.bincount(rows, np.sum((vectors_px - mean_px[rows]) ** 2, axis=1))
    with np.errstate(invalid="ignore"):
        scatter_px = np.sqrt(squares_px2[: len(ids)] / (frames - 1))
    worst = np.argsort(-lengths(mean_px), kind="stable")
    return ids[worst], frames[worst], mean_px[worst], scatter_px[worst]
