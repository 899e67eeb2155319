"""Pushing the vehicle in the 3-D view: a drag pulls at a point of it, and frames show its motion."""

from __future__ import annotations

import time
from collections.abc import Callable
from typing import Any

from nicegui import ui

from skysim.apps.gui.messages import Triple
from skysim.apps.gui.shared.context import PageContext
from skysim.apps.gui.views.sensor import Sensor
from skysim.apps.gui.worker.scene.push import Grip

COAST_S = 60.0  # after a drag, until the vehicle is held


class PushControl:
    """The drag, and the label and the button that are shown while the vehicle moves.

    moved  : called after each frame of the motion
    grip   : the newest one; None while the vehicle is not held;  held_s : when there was one last
    before : attitude before the push, deg;  motion : of which frames are being computed; None if there is none
    """

    def __init__(self, page: PageContext, sensor: Sensor, canvas: ui.element, moved: Callable[[], None]) -> None:
        self.page = page
        self.sensor = sensor
        self.moved = moved
        self.grip: Grip | None = None
        self.before: Triple | None = None
        self.motion: object | None = None
        self.held_s = 0.0
        canvas.on("grip", self.gripped)
        canvas.on("release", self.released)
        with ui.element("div").classes("lab-push") as self.bar:
            self.label = ui.label().classes("mono").mark("push")
            button = (
                ui.button("reset", color=None, on_click=self.reset).props("dense outline size=xs").mark("push-reset")
            )
            button.props('title="back to the attitude before the push"')
        self.bar.set_visibility(False)

    async def gripped(self, event: Any) -> None:
        """The user drags the vehicle."""
        grip = Grip(tuple(event.args["held"]), tuple(event.args["wanted"]))
        view = self.page.view
        if self.motion is None and view:
            self.page.stop_playback()  # forgets grip and attitude of an earlier push
            self.before = view.angles_deg
            self.hold(grip)
            await self.run()
        else:
            self.hold(grip)

    def hold(self, grip: Grip) -> None:
        self.grip = grip
        self.held_s = time.monotonic()

    def released(self) -> None:
        self.grip = None

    async def run(self) -> None:
        """Show frames of the motion, as many as there is time for, until it is stopped."""
        page = self.page
        motion = self.motion = object()
        now_s = time.monotonic()
        while self.motion is motion and now_s - self.held_s < COAST_S:
            last_s = now_s
            now_s = time.monotonic()
            pushed = await page.ask("push", self.grip, now_s - last_s, page.solving)
            if pushed is None or self.motion is not motion:
                break
            page.show_frame(pushed.view, kind="live", angles_deg=pushed.view.angles_deg)
            self.moved()
            self.label.set_text(f"{pushed.torque_nm:.3g} N m   {pushed.rate_deg_s:.3g} °/s")
            self.bar.set_visibility(True)
            await self.sensor.wait_drawn()
        if page.is_open and self.motion is motion:
            self.stop()

    def stop(self) -> None:
        """Hold the vehicle where it is, because something else is shown."""
        self.motion = self.grip = self.before = None
        self.bar.set_visibility(False)

    async def reset(self) -> None:
        """Return to the attitude before the push."""
        before = self.before
        self.stop()
        if before:
            await self.page.show_live("point", before, self.page.solving)
