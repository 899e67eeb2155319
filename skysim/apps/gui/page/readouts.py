"""The tracker's results on the frame: the card of its attitude, and the table of its lights.

The log panel has the events of this session, and a table of the identifications as CSV.
"""

import math
import time
from collections.abc import Collection, Iterator, MutableMapping
from pathlib import Path
from typing import Any

import numpy as np
from nicegui import ui

from skysim.apps.gui.messages import (
    Detection,
    FrameView,
    LightName,
    Lights,
    SceneInfo,
    TrackerResult,
    places_px,
)
from skysim.apps.gui.views import context, overlay, widgets
from skysim.apps.gui.views.widgets import LiveInput, LiveText, format_number
from skysim.apps.gui.worker.photo import Photo
from skysim.core.types import Record

KINDS = "true (F5)", "tracker"
COMPARED = "simulated", "real"  # of a real camera's frame
ANGLES_JS = (
    "() => emit([...document.querySelectorAll('.lab-angle')].map(field => field.value))"
)


class AttitudeCard:
    """True and estimated angles with the error, and the algorithms of the tracker's four stages."""

    def __init__(self, page: context.PageContext) -> None:
        self.page = page
        with widgets.div("lab-card"):
            with widgets.div("lab-grid"):
                widgets.quiet("attitude")
                self.heads = [ui.label().classes("quiet num") for _ in range(3)]
                self.kinds = [widgets.quiet(KINDS[0])]
                self.inputs = [self.angle_input() for _ in range(3)]
                self.kinds.append(widgets.quiet(KINDS[1]))
                self.estimates = [
                    LiveText(page.contents, "–").classes("mono num") for _ in range(3)
                ]
                widgets.quiet("error")
                self.errors = [
                    LiveText(page.contents, "–").classes("mono num") for _ in range(3)
                ]
            self.status = LiveText(page.contents).classes("mono ellipsis lab-status")
            self.stages = ui.label(" ").classes("quiet ellipsis")
        page.derive(lambda view: view.image, self.empty)

    def angle_input(self) -> LiveInput:
        return (
            LiveInput(self.page.contents, "text")
            .classes("mono lab-angle")
            .on("keydown.enter", self.point, js_handler=ANGLES_JS)
        )

    def set_scene(self, scene_info: SceneInfo) -> None:
        """Show the algorithms of a new scene."""
        for name, field in zip(scene_info.names, self.inputs, strict=True):
            field.props(f'aria-label="true {name} in degrees"')
            field.update()
        self.stages.set_text("stages (F6, F7): " + " · ".join(scene_info.stages.values()))
        self.stages.props["title"] = ", ".join(
            f"{stage} {name}" for stage, name in scene_info.stages.items()
        )

    async def point(self, event: Any) -> None:
        """Point the camera at the typed angles."""
        self.page.stop_playback()
        self.page.show_message("")
        try:
            angles = tuple(float(text) for text in event.args)
        except (TypeError, ValueError):
            self.page.show_message("an angle is not a number; allowed: degrees, e.g. 83.6")
            return
        if await self.page.show_live("point", angles):
            for field in self.inputs:
                field.run_method("blur")  # so that the arrow keys move the camera again

    def focus(self) -> None:
        """Give the first angle the keyboard focus."""
        self.inputs[0].run_method("focus")

    def empty(self) -> None:
        """Show no attitude."""
        for field in self.inputs:
            field.set_value("")
        for label in (*self.estimates, *self.errors, self.status):
            label.set_text("")

    def show(self, image: FrameView | Photo, of: SceneInfo | Photo) -> None:
        """Display the attitudes of a frame of a scene or of another image; a user's image has no true attitude."""
        for head, name in zip(self.heads, of.names, strict=True):
            head.set_text(f"{name}, deg")
        compared = isinstance(image, Photo) and image.compared
        for label, text in zip(self.kinds, COMPARED if compared else KINDS, strict=True):
            label.set_text(text)
        known = image.angles_deg
        placeholder = "" if known else "unknown"
        for n, field in enumerate(self.inputs):
            field.set_value(format_angle(known[n]) if known else "")
            if field.props.get("placeholder", "") != placeholder:
                field.props["placeholder"] = placeholder
                field.update()
        estimates = errors = ["–"] * 3  # without a solution
        result = image.result
        if result and result.row.estimate_deg:
            row = result.row
            estimates = [format_angle(angle) for angle in result.row.estimate_deg]
            cross = row.cross_sigma_arcsec
            roll = row.roll_sigma_arcsec
            texts = (
                (row.cross_arcsec, f"cross {row.cross_arcsec:.2f}″"),
                (row.roll_arcsec, f"roll {row.roll_arcsec:+.1f}″"),
                (cross, f"σ {format_number(cross)}″ {format_number(roll)}″"),
            )
            errors = ["–" if math.isnan(value) else text for value, text in texts]
        for label, text in zip(
            (*self.estimates, *self.errors), (*estimates, *errors), strict=True
        ):
            label.set_text(text)
        color, text = status_line(result)
        self.status.set_text(text, color)


def format_angle(angle: float) -> str:
    """Format with four decimals; adding 0.0 turns minus zero into zero."""
    return f"{round(angle, 4) + 0.0:.4f}"


def status_line(result: TrackerResult | None) -> tuple[str, str]:
    """Style class and status line: solved, refused, wrong, or not solved."""
    if result is None:
        return "quiet", "not solved: press 1 to identify"
    row = result.row
    if not row.estimate_deg:
        return "warn", f"{row.status}; {row.detected} lights detected"
    time_text = (
        f", {row.time_ms:.1f} ms" if row.time_ms else ""
    )  # a replayed trial has no time
    counts = f"{row.matched} of {row.detected} lights identified{time_text}"
    if row.wrong:
        return "bad", f"WRONG by more than 10′ and than claimed; {counts}"
    return "good", f"solved; {counts}"


# Lights panel: a table of the true lights of the frame with their detections and matches.


UPDATE_S = 0.5


class LightsTable(ui.element, component="js/lights.js"):  # type: ignore[call-arg]
    """The table, implemented in lights.js."""


class LightsPanel:
    """Panel with the table.

    Attributes
    ----------
    sent
        Number of the frame in the table
    """

    def __init__(self, page: context.PageContext) -> None:
        self.page = page
        self.sent = 0
        self.table = LightsTable()

    def update(self) -> None:
        """Send the table if the sensor shows another frame; called every UPDATE_S while the panel is open."""
        sensor = self.page.sensor
        if self.sent == sensor.sent_number:
            return
        self.sent = sensor.sent_number
        detections = sensor.result.detections if sensor.result else ()
        full_well_e = sensor.well[2] if sensor.well else math.nan
        lights = sensor.lights[: overlay.MAX_TRUTH_MARKS]
        found = rows(lights, detections, sensor.name, full_well_e)
        self.table.run_method("show", list(found))


def rows(
    lights: Lights,
    detections: Collection[Detection],
    name: LightName,
    full_well_e: float = math.nan,
) -> Iterator[Record]:
    """Rows of the table: true lights with their detections, brightest first, then detections of no light.

    Parameters
    ----------
    full_well_e
        Electrons of a full well; NaN if it is not known

    Returns
    -------
    state
        `good` if the light was identified, `warn` if a detection is false or matched with another
        light, else `quiet`
    cells
        Values of the columns in lights.js
    """
    found = list(detections)
    found_px = places_px(found)
    left = dict(enumerate(found))
    for light in lights:
        distance_px = np.hypot(*(found_px - light.xy_px).T)
        error_px = distance_px.min(initial=np.inf)
        is_near = error_px < overlay.NEAR_PX
        spot = left.pop(int(distance_px.argmin()), None) if is_near else None
        last = [error_px, name(spot.id) if spot.id >= 0 else "–"] if spot else [None, None]
        share = "full" if light.saturated else light.peak_e / full_well_e
        charge = light.electrons, light.peak_e, share
        cells = [name(light.id), light.magnitude, *charge, *light.xy_px, *last]
        row = {"key": f"light {light.id}", "id": light.id, "state": state(light, spot)}
        yield row | {"cells": cells}
    for n, spot in left.items():
        taken = name(spot.id) if spot.id >= 0 else None
        cells = ["no light", None, spot.flux, None, None, spot.x, spot.y, None, taken]
        yield {"key": f"detection {n}", "id": -1, "state": "warn", "cells": cells}


def state(light: Any, spot: Detection | None) -> str:
    if spot is None or spot.id < 0:
        return "quiet"
    return "good" if spot.id == light.id else "warn"


MAX_LINES = 500
MAX_ROWS = 10_000
COLUMNS = (
    "time",
    "scene",
    "noise",
    "detector",
    "identifier",
    "status",
    "detected",
    "identified",
    "true_1_deg",
    "true_2_deg",
    "true_3_deg",
    "found_1_deg",
    "found_2_deg",
    "found_3_deg",
    "cross_arcsec",
    "roll_arcsec",
    "cross_sigma_arcsec",
    "roll_sigma_arcsec",
    "wrong",
)


class LogPanel:
    """The log, newest line first.

    Attributes
    ----------
    kept
        The `lines`, and `rows` of identifications as values of COLUMNS
    """

    def __init__(self, page: context.PageContext) -> None:
        self.page = page
        self.kept: MutableMapping[str, list[Any]] = {"lines": [], "rows": []}
        self.button = widgets.button("CSV of the identifications", self.download, "flat")
        self.button.set_enabled(False)
        self.label = ui.label("Nothing yet.").classes("mono lab-log").props('role="log"')

    def add(self, text: str) -> None:
        lines = [f"{time.strftime('%H:%M:%S')}  {text}", *self.kept["lines"]][:MAX_LINES]
        self.kept["lines"] = lines
        self.label.set_text("\n".join(lines))

    def keep(self, storage: MutableMapping[str, list[Any]]) -> None:
        """Go on with the log of the tab's storage, which a reload keeps."""
        for name, now in self.kept.items():
            storage[name] = [*now, *storage.get(name, ())]
        self.kept = storage
        self.label.set_text("\n".join(storage["lines"]))
        self.button.set_enabled(bool(storage["rows"]))

    def identified(self, view: FrameView, info: SceneInfo) -> None:
        """Log an identification with its attitude and error."""
        text, row = identification(view, info)
        self.add(text)
        self.kept["rows"] = [*self.kept["rows"][1 - MAX_ROWS :], row]
        self.button.set_enabled(True)

    def download(self) -> None:
        ui.download(
            widgets.csv_table(COLUMNS, self.kept["rows"]),
            f"{Path(self.page.state.scene).stem}_log.csv",
        )


def identification(view: FrameView, info: SceneInfo) -> tuple[str, tuple[Any, ...]]:
    """An identification as a line of text, and as values of COLUMNS; None or NaN where there is no solution."""
    assert view.result is not None
    row = view.result.row
    text = f"identify {'with' if info.noise else 'without'} noise: {row.status}"
    if row.estimate_deg is not None:
        angles = "  ".join(
            f"{name} {angle:.4f}°"
            for name, angle in zip(info.names, row.estimate_deg, strict=True)
        )
        text += (
            f", {row.matched} of {row.detected}; {angles}; error {row.cross_arcsec:.2f}″ across,"
            f" {row.roll_arcsec:+.1f}″ about the boresight"
        )
    return text, (
        time.strftime("%H:%M:%S"),
        info.scene.name,
        info.noise,
        info.stages["detector"],
        info.stages["identifier"],
        row.status,
        row.detected,
        row.matched,
        *row.truth_deg,
        *(row.estimate_deg or (None,) * 3),
        row.cross_arcsec,
        row.roll_arcsec,
        row.cross_sigma_arcsec,
        row.roll_sigma_arcsec,
        row.wrong,
    )
