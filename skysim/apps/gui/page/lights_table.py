"""Lights panel: a table of the true lights of the frame and of what the tracker made of each."""

from __future__ import annotations

import math
from collections.abc import Callable, Collection, Iterator
from typing import Any
import numpy as np
from nicegui import ui
from skysim.apps.gui.messages import Detection, Light
from skysim.apps.gui.views.overlay import (MAX_TRUTH_MARKS, NEAR_PX)
from skysim.apps.gui.views.sensor import Sensor



HEADS = ("light", "V", "e⁻", "x, px", "y, px", "error, px", "taken for")
UPDATE_S = 0.5


class Table(ui.element, component="js/lights.js"):  # type: ignore[call-arg]
    """The table, implemented in lights.js."""


class LightsPanel:
    """Panel with the table. sent : number of the frame in it"""

    def __init__(self, sensor: Sensor) -> None:
        self.sensor = sensor
        self.sent = 0
        self.table = Table().mark("lights")

    def update(self) -> None:
        """Send the table of the sensor's frame if it is another one; every UPDATE_S while the panel is open."""
        sensor = self.sensor
        if self.sent == sensor.sent_number:
            return
        self.sent = sensor.sent_number
        detections = sensor.result.detections if sensor.result else ()
        self.table.run_method(
            "show", HEADS, list(rows(sensor.lights[:MAX_TRUTH_MARKS], detections, sensor.name))
        )


def rows(
    lights: Collection[Light], detections: Collection[Detection], name: Callable[[int], str]
) -> Iterator[dict[str, Any]]:
    """Rows of the table: every true light with its detection, the brightest first, then detections of no light.

    state : good if the light was identified, warn if a detection is false or taken for another light, else quiet
    """
    found = list(detections)
    found_px = np.array([(one.x, one.y) for one in found]).reshape(-1, 2)
    left = set(range(len(found)))
    for light in lights:
        distance_px = np.hypot(*(found_px - (light.x, light.y)).T)
        n = int(distance_px.argmin()) if len(found) else -1
        near = n in left and distance_px[n] < NEAR_PX
        spot = found[n] if near else None
        left -= {n} if near else set()
        yield {
            "key": f"light {light.id}",
            "id": light.id,
            "state": state(light, spot),
            "cells": cells(light, spot, name),
        }
    for n in sorted(left):
        spot = found[n]
        taken = name(spot.id) if spot.id >= 0 else ""
        texts = ["no light", "", f"{spot.flux:.4g}", f"{spot.x:.2f}", f"{spot.y:.2f}", "", taken]
        yield {"key": f"detection {n}", "id": -1, "state": "warn", "cells": texts}


def cells(light: Light, spot: Detection | None, name: Callable[[int], str]) -> list[str]:
    magnitude = "" if math.isnan(light.magnitude) else f"{light.magnitude:.2f}"
    texts = [
        name(light.id),
        magnitude,
        f"{light.electrons:.4g}",
        f"{light.x:.2f}",
        f"{light.y:.2f}",
    ]
    if spot is None:
        return [*texts, "", ""]
    error_px = math.hypot(spot.x - light.x, spot.y - light.y)
    return [*texts, f"{error_px:.3f}", name(spot.id) if spot.id >= 0 else "–"]


def state(light: Light, spot: Detection | None) -> str:
    if spot is None or spot.id < 0:
        return "quiet"
    return "good" if spot.id == light.id else "warn"


