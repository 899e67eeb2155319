"""3-D view of the laboratory (three.js): the shapes of its MJCF file, the lights and the vehicle's attitude.

A drag pulls at a point of the vehicle; frames show the motion.
"""

import asyncio
import time
from collections.abc import Callable
from typing import Any

import nicegui.elements.scene  # registers three.js with the page  # noqa: F401
from nicegui import ui

from skysim.apps.gui.messages import FrameView, Triple
from skysim.apps.gui.views import context, style, widgets
from skysim.apps.gui.worker.geometry import Grip
from skysim.core.types import Floats, Ints

VIEWS = {
    "outside": "from beside the laboratory",
    "camera": "from the star camera along its boresight",
    "bearing": "from the bearing upwards",
    "top": "from above",
}
UPDATE_S = 0.1
COAST_S = 60.0  # time after a drag until the vehicle is stopped


class Space(ui.element, component="js/space.js", esm={"skysim-views": "js"}):  # type: ignore[call-arg]
    """The picture, implemented in space.js."""


class Scene3D:
    """The view and its buttons. `build` builds it; `show` sets the attitude, which is sent a little later.

    Attributes
    ----------
    newest_view
        Newest frame, which is not sent yet
    legend
        Meaning of the lights' colors
    waits
        Whether `update` will be called
    """

    def __init__(self, page: context.PageContext) -> None:
        self.page = page
        self.newest_view: FrameView | None = None
        self.legend: ui.element | None = None
        self.waits = False
        self.canvas = Space().classes("w-full h-full")
        with widgets.div("lab-looks"):
            for name, text in VIEWS.items():
                ui.button(name, color=None, on_click=lambda name=name: self.look(name)).props(
                    f'dense outline size=xs title="look {text}"'
                )
        hint = ui.label(
            "drag: rotate · drag the vehicle: push it · right drag: pan · wheel: zoom"
        )
        hint.classes("lab-turn")
        self.push = PushControl(page, self.canvas, self.update)
        page.derive(lambda view: view.image, self.forget)
        page.derive(lambda view: view.opened, self.build)

    def look(self, name: str) -> None:
        """Look from a preset place, also to reset a view that the user has turned."""
        self.canvas.run_method("look", name)

    def build(self) -> None:
        """Show the laboratory of a new scene."""
        self.legend = None
        info = self.page.scene_info
        if info:
            fields = {"background": style.DARK["ground"], "prefix": info.prefix}
            self.canvas.run_method("build", info.geometry | fields)

    def color_lights(self, ids: Ints, values: Floats, legend: ui.element) -> None:
        """Color some lights by values from 0 to 1, until the scene changes; show the meaning of only these colors."""
        if self.legend and not self.legend.is_deleted:
            self.legend.set_visibility(False)
        self.legend = legend
        legend.set_visibility(True)
        colors = (
            f"rgb({r:.0f},{g:.0f},{b:.0f})" for r, g, b in 255 * style.color_scale(values)
        )
        self.canvas.run_method("color", list(zip(ids, colors, strict=True)))

    def forget(self) -> None:
        """Mark no lights: those of the last frame are not in the image on the page."""
        self.newest_view = None
        self.canvas.run_method("show", {"seen": [], "identified": []})

    def show(self, view: FrameView) -> None:
        """Send the attitude after a delay, so that of many frames in a short time only the last one is sent."""
        self.newest_view = view
        if not self.waits:
            self.waits = True
            asyncio.get_running_loop().call_later(UPDATE_S, self.update)

    def update(self) -> None:
        """Send the vehicle's attitude, and the lights that are in the frame or identified."""
        view = self.newest_view
        self.newest_view = None
        self.waits = False
        if view is None or not self.page.is_open:
            return
        found = view.result.detections if view.result else ()
        identified = {
            spot.id: self.page.sensor.name(spot.id) for spot in found if spot.id >= 0
        }
        fields = {"wxyz": view.body_wxyz, "seen": view.lights.id.tolist()}
        self.canvas.run_method("show", fields | {"identified": list(identified.items())})


class PushControl:
    """The drag, and the label and the button that are shown while the vehicle moves.

    Attributes
    ----------
    moved
        Function that is called after each frame of the motion
    grip
        Newest grip; None while the vehicle is not held
    held_s
        Time of the last grip
    before
        Attitude before the push, deg
    motion
        Token of the motion whose frames are being computed; None if there is none
    """

    grip: Grip | None = None
    before: Triple | None = None
    motion: object | None = None
    held_s = 0.0

    def __init__(
        self,
        page: context.PageContext,
        canvas: ui.element,
        moved: Callable[[], None],
    ) -> None:
        self.page = page
        self.moved = moved
        canvas.on("grip", self.gripped)
        canvas.on("release", self.released)
        with widgets.div("lab-push") as self.bar:
            self.label = ui.label().classes("mono")
            ui.button("reset", color=None, on_click=self.reset).props(
                'dense outline size=xs title="back to the attitude before the push"'
            )
        self.bar.set_visibility(False)

    async def gripped(self, event: Any) -> None:
        """Handle a drag of the vehicle."""
        grip = Grip(event.args["held"], event.args["wanted"])
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
        """Show frames of the motion as fast as possible until it is stopped."""
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
            await page.sensor.wait_drawn()
        if page.is_open and self.motion is motion:
            self.stop()

    def stop(self) -> None:
        """Stop the vehicle where it is, because something else is shown."""
        self.motion = self.grip = self.before = None
        self.bar.set_visibility(False)

    async def reset(self) -> None:
        """Return to the attitude before the push."""
        before = self.before
        self.stop()
        if before:
            await self.page.show_live("point", before)
