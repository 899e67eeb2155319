"""Sensor view: the newest frame with its marks, enlarged pixels of a star, and data on what is under the mouse."""

from __future__ import annotations

import asyncio
import itertools
import math
from pathlib import Path
from typing import TYPE_CHECKING, Any

from nicegui import ui

from skysim.apps.gui.messages import Detection, FrameView, Light, SceneInfo, TrackerResult
from skysim.apps.gui.page import keys, overlay
from skysim.apps.gui.page.star_names import NAMES
from skysim.results import stretch
from skysim.sources.solar_system.bodies import NAMES as BODIES

if TYPE_CHECKING:
    from skysim.apps.gui.page.page import Tab
    from skysim.apps.gui.worker.photo import Photo

ZOOM_PX = 160  # height of the enlarged pixels on the screen
FIRST_START = "The first frame on a machine takes up to a minute, because the code is compiled."
LABELS = NAMES | BODIES  # by number
STRETCHES = list(stretch.CURVES)
FRAME_NUMBERS = itertools.count(1)  # of frames, so that each has its own address
FRAMES: dict[str, dict[int, bytes]] = {}  # JPEG by tab and number, the newest KEPT
KEPT_FRAMES = 3
DRAW_TIMEOUT_S = 1.0  # for the browser to report a drawn frame


class Canvas(ui.element, component="frame.js"):  # type: ignore[call-arg]
    """Canvas with a frame and its marks, implemented in frame.js."""


class Sensor:
    """The view and its controls. It shows a frame of the scene, or another image such as a user's.

    mouse_px : pixel under the mouse, or None;  zoom_is_current : whether the enlarged pixels are of the current frame
    sent_number, drawn_number : number of the last frame sent to the browser, and of the last it reported as drawn
    """

    def __init__(self, tab: Tab) -> None:
        self.tab = tab
        self.shown = {"truth", "identified", "false"}
        self.lights: tuple[Light, ...] = ()
        self.result: TrackerResult | None = None
        self.size_px, self.prefix = (4, 3), "HIP"
        self.statistics = ""  # numbers of the frame, shown while the mouse is outside
        self.mouse_px: tuple[float, float] | None = None
        self.zoom_is_current = False
        self.sent_number = self.drawn_number = 0
        self.frame_drawn = asyncio.Event()
        with ui.element("div").classes("lab-sensor"):
            self.build_controls()
            with ui.element("div").classes("lab-frame"):
                self.canvas = Canvas().mark("sensor")
                self.canvas.on("mouse", self.mouse, throttle=0.06)
                self.canvas.on("drawn", self.drawn)
                self.canvas.on("sized", self.sized, throttle=0.5)
                with ui.element("div").classes("lab-wait") as self.wait:
                    ui.spinner(size="28px")
                    self.wait_label = ui.label().mark("wait")
            with ui.element("div").classes("lab-under"):
                self.magnified = ui.html(sanitize=False).classes("quiet").mark("zoom")
                self.hover = ui.label().classes("mono").mark("hover")
        self.canvas.set_visibility(False)
        self.show_waiting(f"Setting up {Path(tab.scene).name} …", FIRST_START)
        self.clear_zoom()

    def show_waiting(self, *lines: str) -> None:
        """Show what the first frame waits for, or the reason for none."""
        self.wait_label.set_text("\n".join(lines))

    def build_controls(self) -> None:
        with ui.element("div").classes("lab-bar"):
            for kind in overlay.KINDS:
                box = ui.checkbox(kind, value=kind in self.shown).props("dense size=xs")
                box.style(f"color: {overlay.COLORS[kind]}").mark(f"overlay-{kind}")
                box.on_value_change(lambda event, kind=kind: self.toggle(kind, event.value))
            ui.space()
            self.stretch = ui.select(STRETCHES, value=STRETCHES[0], on_change=self.restretch)
            self.stretch.props('dense borderless options-dense aria-label="Stretch"').classes("w-28")
            self.stretch.on("popup-hide", js_handler=keys.BLUR_JS)
            self.brightness = ui.slider(min=-2, max=4, step=0.25, value=0).props('dense aria-label="Brightness"')
            self.brightness.classes("w-24").on("change", self.restretch)

    def clear_zoom(self) -> None:
        self.mouse_px, self.zoom_is_current = None, False
        self.magnified.set_content('<div class="lab-zoom">click a star to see its pixels</div>')
        self.magnified.classes(remove="stale")

    def toggle(self, kind: str, on: bool) -> None:
        self.shown = self.shown | {kind} if on else self.shown - {kind}
        self.update_marks()

    async def restretch(self) -> None:
        """Show the same frame with another stretch or brightness."""
        data = await self.tab.run_task("show", self.stretch.value, 2.0 ** float(self.brightness.value))
        if data:
            self.display_image(data, self.size_px)

    def display_image(self, data: bytes, size_px: tuple[int, int]) -> None:
        """Display an image, as large as the window allows."""
        if size_px != self.size_px:
            aspect = size_px[0] / size_px[1]
            self.canvas.style(f"width: min(100cqw, calc(100cqh * {aspect:.5f})); aspect-ratio: {aspect:.5f}")
        if not self.sent_number:
            self.wait.set_visibility(False)
            self.canvas.set_visibility(True)
        self.size_px = size_px
        self.sent_number = next(FRAME_NUMBERS)
        frames = FRAMES.setdefault(self.tab.id, {})
        frames[self.sent_number] = data
        frames.pop(min(frames) if len(frames) > KEPT_FRAMES else -1, None)
        self.update_marks()

    def drawn(self, event: Any) -> None:
        """The browser reports a drawn frame."""
        self.drawn_number = int(event.args["src"].rpartition("/")[2])
        self.frame_drawn.set()

    async def sized(self, event: Any) -> None:
        """The browser reports the width of the image on the screen; fit the image to it."""
        data = await self.tab.await_result(self.tab.session.run("fit", max(int(event.args["wide"]), 1)))
        if data:
            self.display_image(data, self.size_px)

    async def wait_drawn(self) -> None:
        """Wait until at most one frame is not drawn yet, so that frames do not queue up in the browser."""
        while self.sent_number > self.drawn_number + 1:
            self.frame_drawn.clear()
            try:
                await asyncio.wait_for(self.frame_drawn.wait(), DRAW_TIMEOUT_S)
            except TimeoutError:
                return

    def show(self, view: FrameView) -> None:
        self.lights, self.result = view.lights, view.result
        self.prefix = self.tab.scene_info.prefix if self.tab.scene_info else "HIP"
        self.statistics = statistics_text(view.size_px, view.statistics, view.result, view, self.tab.scene_info)
        self.frame_changed()
        self.display_image(view.jpeg, view.size_px)

    def show_photo(self, photo: Photo) -> None:
        """Show a user's image or the frame of a study's trial."""
        self.lights, self.result, self.prefix = photo.lights, photo.result, photo.prefix
        self.statistics = statistics_text(photo.size_px, photo.statistics, photo.result)
        self.frame_changed()
        self.display_image(photo.jpeg, photo.size_px)

    def frame_changed(self) -> None:
        """Update the text for a new frame, and mark the enlarged pixels as those of an older one."""
        self.update_text()
        if self.zoom_is_current:
            self.zoom_is_current = False
            self.magnified.classes("stale")

    def update_text(self) -> None:
        """Show data on what is under the mouse, or else the frame's numbers."""
        at = self.mouse_px
        self.hover.set_text(self.pixel_text(*at, *self.nearest(*at)) if at else self.statistics)

    def update_marks(self) -> None:
        """Send the frame's address and its marks to the canvas."""
        self.canvas.props["view"] = {
            "src": f"/frame/{self.tab.id}/{self.sent_number}",
            "size": self.size_px,
            "marks": overlay.marks(self.lights, self.result, self.size_px, self.shown, self.name),
            "label": self.description(),
        }
        self.canvas.update()

    def description(self) -> str:
        """Text alternative of the view for screen readers."""
        detections = self.result.detections if self.result else ()
        identified = [self.name(detection.id) for detection in detections if detection.id >= 0]
        return f"Sensor view: {len(self.lights)} true lights; identified: {', '.join(identified) or 'none'}"

    def name(self, id: int) -> str:
        if self.prefix != "HIP":
            return f"{self.prefix} {id}"
        return LABELS.get(id, f"HIP {id}" if id < 1_000_000 else f"star {id}")

    async def mouse(self, event: Any) -> None:
        """Handle the mouse: show data on what is under it; a click enlarges the pixels there."""
        x, y = event.args["x"] - 0.5, event.args["y"] - 0.5
        self.mouse_px = None if event.args["kind"] == "mouseleave" else (x, y)
        self.update_text()
        if event.args["kind"] != "click" or not self.tab.scene_info:
            return
        detection, light = self.nearest(x, y)
        target = detection or light
        zoom = await self.tab.run_task("zoom", target.x if target else x, target.y if target else y)
        if zoom:
            detections = self.result.detections if self.result else ()
            self.magnified.set_content(overlay.pixels_svg(zoom.dn, detections, zoom.x, zoom.y, ZOOM_PX))
            self.magnified.classes(remove="stale")
            self.zoom_is_current = True

    def nearest(self, x: float, y: float) -> tuple[Detection | None, Light | None]:
        """The nearest detection and the nearest true light within a few marks' width, or None."""
        radius_px = max(8.0, self.size_px[0] / 60)

        def distance_px(item: Detection | Light) -> float:
            return math.hypot(item.x - x, item.y - y)

        detections = self.result.detections if self.result else ()
        detections = tuple(detection for detection in detections if distance_px(detection) < radius_px)
        lights = [light for light in self.lights if distance_px(light) < radius_px]
        return min(detections, key=distance_px, default=None), min(lights, key=distance_px, default=None)

    def pixel_text(self, x: float, y: float, detection: Detection | None, light: Light | None) -> str:
        """Text on a pixel: its true light, the detection and its error."""
        lines = [f"pixel      {x:8.1f} {y:8.1f}"]
        if light:
            brightness = "" if math.isnan(light.magnitude) else f"V {light.magnitude:.2f}  "
            lines += [f"truth      {light.x:8.2f} {light.y:8.2f}   {self.name(light.id)}"]
            lines += [f"           {brightness}{light.electrons:.4g} e-"]
        if detection:
            identity = self.name(detection.id) if detection.id >= 0 else "not identified"
            lines += [f"centroid   {detection.x:8.2f} {detection.y:8.2f} ± {detection.sigma_px:.3f} px   {identity}"]
            residual = "" if math.isnan(detection.residual_px) else f"   residual {detection.residual_px:.3f} px"
            lines += [f"           flux {detection.flux:.4g}{residual}"]
            if light:
                lines += [f"           error {math.hypot(detection.x - light.x, detection.y - light.y):.3f} px"]
        return "\n".join(lines)


def statistics_text(
    size_px: tuple[int, int],
    statistics: stretch.FrameStatistics,
    result: TrackerResult | None,
    view: FrameView | None = None,
    scene_info: SceneInfo | None = None,
) -> str:
    """A frame's numbers in two columns; fewer for an image that is not of the scene (view is None)."""
    field = ("field", f"{scene_info.field_deg:.4g}°") if scene_info else ("", "")
    rows = [("frame", f"{size_px[0]} × {size_px[1]} px", *field)]
    if view:
        rows += [("exposure", f"{1e3 * view.exposure_s:.4g} ms", "rendering", f"{view.ms:.0f} ms")]
    rows += [
        ("sky", f"{statistics.sky_dn:.5g} DN", "scatter", f"{statistics.scatter_dn:.3g} DN"),
        ("brightest", f"{statistics.peak_dn:.5g} DN", "saturated", f"{statistics.saturated} px"),
    ]
    lights = ("lights", f"{len(view.lights)} in the field") if view else ()
    detected = ("identified", f"{result.identified} of {len(result.detections)}") if result else ()
    rows += [(*lights, *detected, "", "", "", "")[:4]]
    return "\n".join(f"{a:<11s}{b:<20s}{c:<11s}{d}".rstrip() for a, b, c, d in rows)
