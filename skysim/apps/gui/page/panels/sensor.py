"""Sensor view: the newest frame with its marks, enlarged pixels of a star, and data on what is under the mouse."""

from __future__ import annotations

import asyncio
import itertools
import math
from pathlib import Path
from typing import TYPE_CHECKING, Any

from nicegui import ui

from skysim.apps.gui.messages import Answer, Detection, FrameView, Light, SceneInfo
from skysim.apps.gui.page import keys, overlay
from skysim.apps.gui.page.star_names import NAMES
from skysim.results import stretch

if TYPE_CHECKING:
    from skysim.apps.gui.page.page import Tab
    from skysim.apps.gui.worker.photo import Photo

ZOOM_PX = 160  # height of the enlarged pixels on the screen
FIRST = "The first look on a machine takes up to a minute: the code is loaded and compiled, once."
STRETCHES = list(stretch.CURVES)
NUMBER = itertools.count(1)  # of frames, so that each has its own address
FRAMES: dict[str, dict[int, bytes]] = {}  # JPEG by tab and number, the newest KEPT
KEPT = 3
PATIENCE_S = 1.0  # for the browser to report a drawn frame


class Canvas(ui.element, component="frame.js"):  # type: ignore[call-arg]
    """Canvas with a frame and its marks, implemented in frame.js."""


class Sensor:
    """The view and its controls. It shows a frame of the scene, or another image such as a user's.

    at : pixel under the mouse, or None;  fresh : whether the enlarged pixels are of the current frame
    sent, came : number of the last frame sent to the browser, and of the last it reported as drawn
    """

    def __init__(self, tab: Tab) -> None:
        self.tab = tab
        self.shown = {"truth", "identified", "false"}
        self.lights: tuple[Light, ...] = ()
        self.answer: Answer | None = None
        self.size_px, self.prefix = (4, 3), "HIP"
        self.facts = ""  # numbers of the frame, shown while the mouse is outside
        self.at: tuple[float, float] | None = None
        self.fresh = False
        self.sent = self.came = 0
        self.arrived = asyncio.Event()
        with ui.element("div").classes("lab-sensor"):
            self.bar()
            with ui.element("div").classes("lab-frame"):
                self.canvas = Canvas().mark("sensor")
                self.canvas.on("mouse", self.mouse, throttle=0.06)
                self.canvas.on("drawn", self.drawn)
                self.canvas.on("sized", self.sized, throttle=0.5)
                with ui.element("div").classes("lab-wait") as self.wait:
                    ui.spinner(size="28px")
                    self.why = ui.label().mark("wait")
            with ui.element("div").classes("lab-under"):
                self.magnified = ui.html(sanitize=False).classes("quiet").mark("zoom")
                self.hover = ui.label().classes("mono").mark("hover")
        self.canvas.set_visibility(False)
        self.waiting(f"Setting up {Path(tab.scene).name} …", FIRST)
        self.rest()

    def waiting(self, *lines: str) -> None:
        """Show what the first frame waits for, or why there is none."""
        self.why.set_text("\n".join(lines))

    def bar(self) -> None:
        """Build the controls: overlays, stretch, brightness."""
        with ui.element("div").classes("lab-bar"):
            for kind in overlay.KINDS:
                box = ui.checkbox(kind, value=kind in self.shown).props("dense size=xs")
                box.style(f"color: {overlay.INK[kind]}").mark(f"overlay-{kind}")
                box.on_value_change(lambda event, kind=kind: self.toggle(kind, event.value))
            ui.space()
            self.stretch = ui.select(STRETCHES, value=STRETCHES[0], on_change=self.restretch)
            self.stretch.props('dense borderless options-dense aria-label="Stretch"').classes("w-28")
            self.stretch.on("popup-hide", js_handler=keys.LEAVE)
            self.bright = ui.slider(min=-2, max=4, step=0.25, value=0).props('dense aria-label="Brightness"')
            self.bright.classes("w-24").on("change", self.restretch)

    def rest(self) -> None:
        """Clear the enlarged pixels and the mouse position."""
        self.at, self.fresh = None, False
        self.magnified.set_content('<div class="lab-zoom">click a star: its pixels</div>')
        self.magnified.classes(remove="stale")

    def toggle(self, kind: str, on: bool) -> None:
        self.shown = self.shown | {kind} if on else self.shown - {kind}
        self.mark()

    async def restretch(self) -> None:
        """Show the same frame with another stretch or brightness."""
        data = await self.tab.ask("show", self.stretch.value, 2.0 ** float(self.bright.value))
        if data:
            self.picture(data, self.size_px)

    def picture(self, data: bytes, size_px: tuple[int, int]) -> None:
        """Display an image, as large as the window allows."""
        if size_px != self.size_px:
            share = size_px[0] / size_px[1]
            self.canvas.style(f"width: min(100cqw, calc(100cqh * {share:.5f})); aspect-ratio: {share:.5f}")
        if not self.sent:
            self.wait.set_visibility(False)
            self.canvas.set_visibility(True)
        self.size_px = size_px
        self.sent = next(NUMBER)
        kept = FRAMES.setdefault(self.tab.id, {})
        kept[self.sent] = data
        kept.pop(min(kept) if len(kept) > KEPT else -1, None)
        self.mark()

    def drawn(self, event: Any) -> None:
        """The browser reports a drawn frame."""
        self.came = int(event.args["src"].rpartition("/")[2])
        self.arrived.set()

    async def sized(self, event: Any) -> None:
        """The browser reports the width of the image on the screen; fit the image to it."""
        data = await self.tab.wait(self.tab.session.ask("fit", max(int(event.args["wide"]), 1)))
        if data:
            self.picture(data, self.size_px)

    async def ready(self) -> None:
        """Wait until at most one frame is not drawn yet, so that frames do not queue up in the browser."""
        while self.sent > self.came + 1:
            self.arrived.clear()
            try:
                await asyncio.wait_for(self.arrived.wait(), PATIENCE_S)
            except TimeoutError:
                return

    def show(self, view: FrameView) -> None:
        """Show a frame of the scene."""
        self.lights, self.answer = view.lights, view.answer
        self.prefix = self.tab.setting.prefix if self.tab.setting else "HIP"
        self.facts = facts(view.size_px, view.facts, view.answer, view, self.tab.setting)
        self.renewed()
        self.picture(view.jpeg, view.size_px)

    def show_photo(self, photo: Photo) -> None:
        """Show a user's image or the frame of a study's trial."""
        self.lights, self.answer, self.prefix = photo.lights, photo.answer, photo.prefix
        self.facts = facts(photo.size_px, photo.facts, photo.answer)
        self.renewed()
        self.picture(photo.jpeg, photo.size_px)

    def renewed(self) -> None:
        """Update the text for a new frame, and mark the enlarged pixels as those of an older one."""
        self.tell()
        if self.fresh:
            self.fresh = False
            self.magnified.classes("stale")

    def tell(self) -> None:
        """Show data on what is under the mouse, or else the frame's numbers."""
        if self.at is None:
            self.hover.set_text(self.facts)
            return
        self.hover.set_text(self.told(*self.at, *self.nearest(*self.at)))

    def mark(self) -> None:
        """Send the frame's address and its marks to the canvas."""
        self.canvas.props["look"] = {
            "src": f"/frame/{self.tab.id}/{self.sent}",
            "size": self.size_px,
            "marks": overlay.marks(self.lights, self.answer, self.size_px, self.shown, self.name),
            "label": self.words(),
        }
        self.canvas.update()

    def words(self) -> str:
        """Text alternative of the view for screen readers."""
        known = [self.name(spot.id) for spot in self.answer.spots if spot.id >= 0] if self.answer else []
        return f"Sensor view: {len(self.lights)} true lights; named: {', '.join(known) or 'none'}"

    def name(self, id: int) -> str:
        """Name of a light by its number."""
        return NAMES.get(id, f"HIP {id}") if self.prefix == "HIP" else f"{self.prefix} {id}"

    async def mouse(self, event: Any) -> None:
        """Handle the mouse: show data on what is under it; a click enlarges the pixels there."""
        x, y = event.args["x"] - 0.5, event.args["y"] - 0.5
        self.at = None if event.args["kind"] == "mouseleave" else (x, y)
        self.tell()
        if event.args["kind"] != "click" or not self.tab.setting:
            return
        spot, light = self.nearest(x, y)
        middle = spot or light
        zoom = await self.tab.ask("zoom", middle.x if middle else x, middle.y if middle else y)
        if zoom:
            spots = self.answer.spots if self.answer else ()
            self.magnified.set_content(overlay.magnified(zoom.dn, spots, zoom.x, zoom.y, ZOOM_PX))
            self.magnified.classes(remove="stale")
            self.fresh = True

    def nearest(self, x: float, y: float) -> tuple[Detection | None, Light | None]:
        """The nearest detection and the nearest true light within a few marks' width, or None."""
        reach = max(8.0, self.size_px[0] / 60)

        def off(one: Detection | Light) -> float:
            return math.hypot(one.x - x, one.y - y)

        spots = [spot for spot in (self.answer.spots if self.answer else ()) if off(spot) < reach]
        lights = [light for light in self.lights if off(light) < reach]
        return min(spots, key=off, default=None), min(lights, key=off, default=None)

    def told(self, x: float, y: float, spot: Detection | None, light: Light | None) -> str:
        """Text on a pixel: its true light, the detection and its error."""
        lines = [f"pixel      {x:8.1f} {y:8.1f}"]
        if light:
            bright = "" if math.isnan(light.magnitude) else f"V {light.magnitude:.2f}  "
            lines += [f"truth      {light.x:8.2f} {light.y:8.2f}   {self.name(light.id)}"]
            lines += [f"           {bright}{light.electrons:.4g} e-"]
        if spot:
            who = self.name(spot.id) if spot.id >= 0 else "no name"
            lines += [f"centroid   {spot.x:8.2f} {spot.y:8.2f} ± {spot.sigma_px:.3f} px   {who}"]
            residual = "" if math.isnan(spot.residual_px) else f"   residual {spot.residual_px:.3f} px"
            lines += [f"           flux {spot.flux:.4g}{residual}"]
            if light:
                lines += [
                    f"           off the truth by {math.hypot(spot.x - light.x, spot.y - light.y):.3f} px"
                ]
        return "\n".join(lines)


def facts(
    size_px: tuple[int, int],
    told: stretch.Facts,
    answer: Answer | None,
    view: FrameView | None = None,
    setting: SceneInfo | None = None,
) -> str:
    """A frame's numbers in two columns; fewer for an image that is not of the scene (view is None)."""
    rows = [
        (
            "frame",
            f"{size_px[0]} × {size_px[1]} px",
            *(("field", f"{setting.field_deg:.4g}°") if setting else ("", "")),
        )
    ]
    if view:
        rows += [("exposure", f"{1e3 * view.exposure_s:.4g} ms", "made in", f"{view.ms:.0f} ms")]
    rows += [
        ("sky", f"{told.sky_dn:.5g} DN", "scatter", f"{told.scatter_dn:.3g} DN"),
        ("brightest", f"{told.peak_dn:.5g} DN", "saturated", f"{told.saturated} px"),
    ]
    lights = ("lights", f"{len(view.lights)} in the field") if view else ()
    seen = ("named", f"{answer.identified} of {len(answer.spots)} seen") if answer else ()
    rows += [(*lights, *seen, "", "", "", "")[:4]]
    return "\n".join(f"{a:<11s}{b:<20s}{c:<11s}{d}".rstrip() for a, b, c, d in rows)
