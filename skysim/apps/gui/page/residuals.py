"""Residuals of each light over a flight: their mean and scatter in a table, worst first, and as arrows on the dome.

A wrong place of a light is constant in the lab frame, so residuals are compared along its axes.
"""

from collections.abc import Iterator, Sequence
from typing import Any, NamedTuple

import numpy as np
from nicegui import ui

from skysim.apps.gui.messages import LightName, Residual
from skysim.apps.gui.page.readouts import LightsTable
from skysim.apps.gui.views import context, overlay, space, widgets
from skysim.core.constants import ARCSEC_RAD
from skysim.core.types import Floats, Ints, Record

HEADS = ("light", "frames", "mean, px", "scatter, px", "mean / error")
ARROW_RAD = 0.04  # least length of the median arrow, as an angle seen from the middle of the laboratory
CLEAR = 4.0  # mean over its standard error from which the mean is no chance


class LightMeans(NamedTuple):
    """Residuals of N lights over a flight, the greatest mean first.

    Attributes
    ----------
    ids, frames
        (N,) their numbers, and the numbers of frames in which they were identified
    mean_px
        (N, 3) means along the axes of the lab frame
    length_px, scatter_px
        (N,) absolute values of the means; root mean square of the residuals about them, with
        frames - 1 degrees of freedom (NaN for one frame)
    """

    ids: Ints
    frames: Ints
    mean_px: Floats
    length_px: Floats
    scatter_px: Floats


def by_light(residuals: Sequence[Residual]) -> LightMeans:
    """Mean and scatter of each light's residuals."""
    ids, rows, frames = np.unique(
        [one.id for one in residuals], return_inverse=True, return_counts=True
    )
    vectors_px = np.array([one.lab_px for one in residuals]).reshape(-1, 3)
    mean_px = np.zeros((len(ids), 3))
    np.add.at(mean_px, rows, vectors_px / frames[rows, None])
    squares_px2 = np.bincount(
        rows, np.sum((vectors_px - mean_px[rows]) ** 2, axis=1), len(ids)
    )
    with np.errstate(invalid="ignore"):
        scatter_px = np.sqrt(squares_px2 / (frames - 1))
    length_px = np.linalg.norm(mean_px, axis=1)
    worst = np.argsort(-length_px, kind="stable")
    columns: tuple[Any, ...] = (ids, frames, mean_px, length_px, scatter_px)
    return LightMeans(*(column[worst] for column in columns))


def rows(means: LightMeans, name: LightName) -> Iterator[Record]:
    """Rows of the table; those whose mean is no chance are warnings."""
    errors_px = means.scatter_px / np.sqrt(means.frames)
    columns = (means.ids, means.frames, means.length_px, means.scatter_px, errors_px)
    for id, frames, mean_px, scatter_px, error_px in zip(
        *(column.tolist() for column in columns), strict=True
    ):
        ratio = mean_px / error_px if error_px > 0 else np.nan
        texts = (f"{mean_px:.3g}", f"{scatter_px:.3g}", f"{ratio:.1f}")
        cells = [name(id), str(frames), *("–" if text == "nan" else text for text in texts)]
        state = "warn" if ratio > CLEAR else "quiet"
        yield {"key": f"light {id}", "id": id, "state": state, "cells": cells}


class FlightLights:
    """The table of a flight's lights, and the switch of the arrows in the 3-D view."""

    def __init__(self, page: context.PageContext, scene_3d: space.Scene3D) -> None:
        self.page = page
        self.scene_3d = scene_3d
        with widgets.row() as self.head:
            self.switch = widgets.checkbox("residuals in 3-D", on_change=self.draw_arrows)
            self.switch.mark("residuals-3d")
            self.scale = ui.label().classes("quiet").mark("residuals-scale")
        self.table = LightsTable().props("still").mark("residuals")

    def show(self, residuals: Sequence[Residual]) -> None:
        """Show the residuals of a flight."""
        self.means = by_light(residuals)
        self.head.set_visibility(bool(residuals))
        self.table.set_visibility(bool(residuals))
        self.table.run_method("show", HEADS, list(rows(self.means, self.page.sensor.name)))
        self.draw_arrows()

    def draw_arrows(self) -> None:
        """Draw the means on the lights of the 3-D view, or erase them, and say on which scale."""
        means = self.means
        info = self.page.scene_info
        places = np.zeros((0, 3))
        text = "mean of each light over the flight, worst first"
        if info and self.switch.value and len(means.ids):
            pixel_rad = info.pixel_arcsec * ARCSEC_RAD
            factor, longest_px, text = overlay.arrow_scale(
                means.length_px, ARROW_RAD / pixel_rad
            )
            shorter = longest_px / np.maximum(means.length_px, longest_px)
            places = factor * pixel_rad * shorter[:, None] * means.mean_px
        self.scale.set_text(text)
        self.scene_3d.draw_arrows(means.ids[: len(places)], places)
