"""Attitude card: true angles (editable), the tracker's angles, its error, and the names of its algorithms."""

from __future__ import annotations

import math
from typing import Any
from nicegui import ui
from skysim.apps.gui.messages import FrameView, SceneInfo, TrackerResult
from skysim.apps.gui.views.context import PageContext
from skysim.apps.gui.views.live import (Contents, LiveInput, LiveText)
from skysim.apps.gui.views.live import format_number
from skysim.apps.gui.worker.photo import Photo



ANGLES_JS = "() => emit([...document.querySelectorAll('.lab-angle')].map(field => field.value))"


class AttitudeCard:
    """True and estimated angles with the error, and the algorithms of the tracker's four stages.

    contents : of the tab's live fields
    shows_photo : whether the card shows an image that is not of the current scene
    """

    def __init__(self, page: PageContext, contents: Contents) -> None:
        self.page = page
        self.contents = contents
        self.shows_photo = False
        with ui.element("div").classes("lab-card"):
            with ui.element("div").classes("lab-grid"):
                ui.label("attitude").classes("quiet")
                self.heads = [ui.label().classes("quiet num") for _ in range(3)]
                ui.label("true (F5)").classes("quiet")
                self.inputs = [self.angle_input(n) for n in range(3)]
                ui.label("tracker").classes("quiet")
                self.estimates = [LiveText(contents, "–").classes("mono num") for _ in range(3)]
                ui.label("error").classes("quiet")
                self.errors = [LiveText(contents, "–").classes("mono num") for _ in range(3)]
            self.status = LiveText(contents).classes("mono ellipsis lab-status").mark("status")
            self.stages = ui.label(" ").classes("quiet ellipsis").mark("stages")

    def angle_input(self, n: int) -> LiveInput:
        field = LiveInput(self.contents, "text").props(f'aria-label="angle {n + 1}"')
        return (
            field.classes("mono lab-angle")
            .mark(f"angle-{n}")
            .on("keydown.enter", self.point, js_handler=ANGLES_JS)
        )

    def set_scene(self, scene_info: SceneInfo) -> None:
        """Take over a new scene: angle names and algorithms."""
        self.set_headers(scene_info.names)
        self.stages.set_text("stages (F6, F7): " + " · ".join(scene_info.stages.values()))
        self.stages.props["title"] = ", ".join(
            f"{stage} {name}" for stage, name in scene_info.stages.items()
        )

    def set_headers(self, names: tuple[str, str, str]) -> None:
        for head, name in zip(self.heads, names, strict=True):
            head.set_text(f"{name}, deg")

    async def point(self, event: Any) -> None:
        """Point the camera at the typed angles."""
        self.page.stop_playback()
        self.page.show_message("")
        try:
            angles = tuple(float(text) for text in event.args)
        except (TypeError, ValueError):
            self.page.show_message("an angle is not a number; allowed: degrees, e.g. 83.6")
            return
        if await self.page.show_live("point", angles, self.page.solving):
            for field in self.inputs:
                field.run_method("blur")  # so that the arrow keys move the camera again

    def focus(self) -> None:
        """Give the first angle the keyboard focus."""
        self.inputs[0].run_method("focus")

    def show(self, view: FrameView) -> None:
        info = self.page.scene_info
        if self.shows_photo and info:
            self.shows_photo = False
            self.set_headers(info.names)
            self.set_placeholder("")
        for field, angle in zip(self.inputs, view.angles_deg, strict=True):
            field.set_value(format_angle(angle))
        self.show_result(view.result)

    def show_photo(self, photo: Photo) -> None:
        """Display the attitudes of an image that is not of the current scene; a user's image has no true attitude."""
        self.shows_photo = True
        self.set_headers(photo.names)
        self.set_placeholder("unknown")
        texts = (
            [format_angle(angle) for angle in photo.true_deg] if photo.true_deg else ["", "", ""]
        )
        for field, text in zip(self.inputs, texts, strict=True):
            field.set_value(text)
        self.show_result(photo.result)

    def set_placeholder(self, text: str) -> None:
        for field in self.inputs:
            field.props["placeholder"] = text
            field.update()

    def show_result(self, result: TrackerResult | None) -> None:
        """Display the tracker's angles, errors and status; dashes without a solution."""
        if result is None or result.angles_deg is None:
            for label in (*self.estimates, *self.errors):
                label.set_text("–")
        else:
            for label, angle in zip(self.estimates, result.angles_deg, strict=True):
                label.set_text(format_angle(angle))
            cross, roll = result.sigma_arcsec
            self.errors[0].set_text(
                "–" if math.isnan(result.cross_arcsec) else f"cross {result.cross_arcsec:.2f}″"
            )
            self.errors[1].set_text(
                "–" if math.isnan(result.roll_arcsec) else f"roll {result.roll_arcsec:+.1f}″"
            )
            self.errors[2].set_text(
                "–" if math.isnan(cross) else f"σ {format_number(cross)}″ {format_number(roll)}″"
            )
        color, text = status_line(result)
        self.status.set_text(text, color)


def format_angle(angle: float) -> str:
    """Format with four decimals; adding 0.0 turns minus zero into zero."""
    return f"{round(angle, 4) + 0.0:.4f}"


def status_line(result: TrackerResult | None) -> tuple[str, str]:
    """Style class and status line: solved, refused, wrong, or not solved."""
    if result is None:
        return "quiet", "not solved: press 1 to identify"
    if not result.solved:
        return "warn", f"{result.status}; {len(result.detections)} lights detected"
    time_text = f", {result.ms:.1f} ms" if result.ms else ""  # a replayed trial has no time
    counts = f"{result.identified} of {len(result.detections)} lights identified{time_text}"
    if result.wrong:
        return "bad", f"WRONG by more than 10′ and than claimed; {counts}"
    return "good", f"solved; {counts}"


