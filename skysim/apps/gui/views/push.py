"""Pushing the vehicle in the 3-D view: a drag pulls at a point of it, and frames show its motion."""

from __future__ import annotations

import time
from typing import TYPE_CHECKING, Any

from nicegui import ui

from skysim.apps.gui.messages import Triple
from skysim.apps.gui.worker.scene.push import Grip

if TYPE_CHECKING:
    from skysim.apps.gui.page.tab import Tab

COAST_S = 60.0  # after a drag, until the vehicle is held


class PushControl:
    """The drag, and the label and the button that are shown while the vehicle moves.

    grip   : the newest one; None while the vehicle is not held;  held_s : when there was one last
    before : attitude before the push, deg;  motion : of which frames are being computed; None if there is none
    """

    def __init__(self, tab: Tab, canvas: ui.element) -> None:
        self.tab = tab
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
        self.grip, self.held_s = Grip(tuple(event.args["held"]), tuple(event.args["wanted"])), time.monotonic()
        if self.motion is None and self.tab.view:
            grip = self.grip
            self.tab.stop_playback()
            self.grip, self.before = grip, self.tab.view.angles_deg
            await self.run()

    def released(self) -> None:
        self.grip = None

    async def run(self) -> None:
        """Show frames of the motion, as many as there is time for, until it is stopped."""
        tab, now_s = self.tab, time.monotonic()
        motion = self.motion = object()
        while self.motion is motion and now_s - self.held_s < COAST_S:
            last_s, now_s = now_s, time.monotonic()
            pushed = await tab.await_result(tab.session.run("push", self.grip, now_s - last_s, tab.solving))
            if pushed is None or self.motion is not motion:
                break
            tab.display_live(pushed.view)
            tab.scene_3d.update()
            self.label.set_text(f"{pushed.torque_nm:.3g} N m   {pushed.rate_deg_s:.3g} °/s")
            self.bar.set_visibility(True)
            await tab.sensor.wait_drawn()
        if tab.is_open and self.motion is motion:
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
            await self.tab.show_live(self.tab.session.run("point", before, self.tab.solving))
