"""Sensor view: the newest frame with its marks, its display settings, and data on the light under the mouse."""

import asyncio
import base64
import functools
import math
from collections.abc import Collection
from pathlib import Path
from typing import Any
from urllib.parse import parse_qsl

import cv2
import numpy as np
from nicegui import ui

from skysim.apps.gui.messages import (
    LIMITS,
    NO_LIGHTS,
    Detection,
    FrameView,
    Lens,
    Pose,
    SceneInfo,
    TrackerResult,
    places_px,
)
from skysim.apps.gui.views import overlay, widgets
from skysim.apps.gui.worker.photo import Photo
from skysim.apps.gui.worker.session import Session
from skysim.core.types import Floats, Record
from skysim.results import plots
from skysim.sources.bodies import NAMES as BODIES

FIRST_START = (
    "The first frame on a machine takes up to a minute, because the code is compiled."
)
LABELS = overlay.NAMES | BODIES  # names of lights by number
STRETCHES = list(plots.CURVES)
COLOR_MAPS = {
    "gray": None,
    "gray, inverted": None,
    "viridis": cv2.COLORMAP_VIRIDIS,
    "cividis": cv2.COLORMAP_CIVIDIS,
    "inferno": cv2.COLORMAP_INFERNO,
    "hot": cv2.COLORMAP_HOT,
}
AHEAD = 2  # number of frames that the browser fetches while it draws another one
DRAW_TIMEOUT_S = 1.0  # time for the browser to report a drawn frame


class Canvas(ui.element, component="js/frame.js", esm={"skysim-views": "js"}):  # type: ignore[call-arg]
    """The frame with its loupe and plot, implemented in frame.js."""


class SensorView:
    """The view and its controls. It shows a frame of the scene, or another image such as a user's.

    Attributes
    ----------
    id, contents
        Id of the tab, and contents of its live fields
    source
        Source of pixels, once the tab has a worker
    well
        Electrons per digital number, bias in digital numbers, and electrons of a full well, of a scene's detector
    hover_px
        Place of the light under the mouse, or None
    sent_number
        Number of the last frame sent to the browser
    has_image
        Whether there is an image, or soon will be
    frames
        The newest frames
    """

    source: Session

    result: TrackerResult | None = None
    prefix = "HIP"
    lens: Lens | None = None
    pose: Pose | None = None
    well: tuple[float, float, float] | None = None
    statistics = ""  # numbers of the frame, shown while no light is under the mouse
    hover_px: tuple[float, float] | None = None
    sent_number = 0
    has_image = False

    def __init__(self, id: str, contents: widgets.Contents) -> None:
        self.id = id
        self.contents = contents
        self.shown = {"truth", "identified", "false"}
        self.lights = NO_LIGHTS
        self.size_px = (4, 3)
        self.frames = overlay.TabFrames(self.announce)
        self.frame_drawn = asyncio.Event()
        with widgets.div("lab-sensor"):
            self.build_controls()
            with Canvas() as self.canvas:
                self.hover = widgets.LiveText(contents).classes("mono")
            with self.canvas.add_slot("wait"), widgets.div("lab-wait") as self.wait:
                # No spinner: without a graphics card each takes a sixth of a core from the worker that it waits for.
                self.waited = widgets.div("lab-waited mono")
                self.wait_label = ui.label()
        contents.send = lambda changed: self.canvas.run_method("setContents", changed)
        self.canvas.on("hover", self.hover_changed)
        self.canvas.on("manual", lambda: self.limits.set_value("manual"))
        self.canvas.on("drawn", self.drawn)
        self.update_display()

    def show_setting_up(self, scene: str) -> None:
        """Show that the first frame of a scene is being made."""
        self.show_waiting(f"Setting up {Path(scene).name} …", FIRST_START)

    def show_waiting(self, *lines: str, in_vain: bool = False) -> None:
        """Show what the first frame waits for and since when; with `in_vain`, why there is none."""
        self.wait_label.set_text("\n".join(lines))
        self.waited.set_visibility(not in_vain)

    def empty(self) -> None:
        """Show no image, unless the next one follows at once."""
        self.has_image = False
        if asyncio._get_running_loop() is not None:
            asyncio.get_running_loop().call_soon(self.blank)

    def blank(self) -> None:
        if self.has_image:
            return
        self.lights = NO_LIGHTS
        self.result = None
        self.statistics = ""
        self.hover_px = None
        self.update_text()
        self.canvas.run_method("empty", self.sent_number)
        self.sent_number += 1  # the table of lights is another one
        self.wait.set_visibility(True)

    def build_controls(self) -> None:
        with widgets.div("lab-bar"):
            for kind in overlay.KINDS:
                box = widgets.checkbox(kind, value=kind in self.shown)
                box.style(f"color: {overlay.COLORS[kind]}")
                box.on_value_change(lambda event, kind=kind: self.toggle(kind, event.value))
            self.grid = widgets.checkbox("grid", on_change=self.update_display)
            ui.space()
            self.stretch = self.select("Stretch", STRETCHES, "w-28")
            self.limits = self.select("Limits", LIMITS, "w-24")
            self.colors = self.select("Colors", list(COLOR_MAPS), "w-20")

    def select(self, name: str, options: Collection[str], width: str) -> ui.select:
        """A list of display settings."""
        chosen = widgets.select(
            list(options),
            "borderless",
            value=next(iter(options)),
            on_change=self.update_display,
        )
        return chosen.props(f'aria-label="{name}"').classes(width)

    def update_display(self) -> None:
        """Send the display settings; the browser applies them."""
        self.canvas.props["display"] = {
            "curve": self.stretch.value,
            "limits": self.limits.value,
            "table": color_table(str(self.colors.value)),
            "grid": self.grid.value,
        }
        self.canvas.update()

    def clear_zoom(self) -> None:
        """Show the whole frame."""
        self.canvas.run_method("fit")

    def toggle(self, kind: str, on: bool) -> None:
        """Show a kind of marks, or no more: send the marks of the newest frame again.

        It is a message, since NiceGUI sends all properties if one changes.
        """
        self.shown = self.shown | {kind} if on else self.shown - {kind}
        self.canvas.run_method(
            "show", {"src": self.address(self.sent_number)} | self.fields()
        )

    def announce(self, number: int) -> None:
        """Let the browser request a frame."""
        self.canvas.run_method("show", {"src": self.address(number)})

    def drawn(self, event: Any) -> None:
        """Handle the browser's report of a drawn frame, and of its display for the next ones."""
        self.frames.drawn = int(event.args["src"].rpartition("/")[2])
        self.frame_drawn.set()
        display = overlay.display_of(dict(parse_qsl(str(event.args["display"]))))
        if display:
            self.source.display = display

    async def wait_drawn(self) -> None:
        """Wait until the browser has few frames to draw, so that they do not queue up there."""
        while self.sent_number > self.frames.drawn + AHEAD:
            self.frame_drawn.clear()
            try:
                await asyncio.wait_for(self.frame_drawn.wait(), DRAW_TIMEOUT_S)
            except TimeoutError:
                return

    def show(self, image: FrameView | Photo, of: SceneInfo | Photo) -> None:
        """Show a frame of a scene, or another image: a user's, or the frame of a study's trial."""
        self.prefix = of.prefix
        self.statistics = statistics_text(image, of)
        self.lights = image.lights
        self.result = image.result
        if self.size_px != image.pixels.fields["size"]:
            self.hover_px = None
        self.size_px = image.pixels.fields["size"]
        self.pose = image.pose
        self.well = None
        if isinstance(of, SceneInfo):
            detector = of.scene.camera.detector
            self.well = detector.gain_e_dn, detector.offset_dn, detector.full_well_e
        is_new_lens = of.lens is not self.lens
        if is_new_lens:
            self.lens = of.lens
            self.canvas.run_method("setLens", of.lens)
        self.update_text()
        self.has_image = True
        self.wait.set_visibility(False)
        self.sent_number += 1  # so that each frame has its own address
        fields = self.fields() | {"contents": self.contents.take()}
        overlay.FRAMES[self.id] = self.frames
        served = overlay.ServedFrame(image.pixels, fields, self.source)
        self.frames.add(self.sent_number, served, alone=is_new_lens)

    def update_text(self) -> None:
        """Show data on the light under the mouse, or else the frame's numbers."""
        at = self.hover_px
        self.hover.set_text(self.light_text(*self.nearest(*at)) if at else self.statistics)

    def address(self, number: int) -> str:
        return f"/frame/{self.id}/{number}"

    def fields(self) -> Record:
        """Further data for frame.js: pointing and marks."""
        view = {"pose": self.pose, "label": self.description(), "well": self.well}
        return view | overlay.marks(self.lights, self.result, self.shown, self.name)

    def description(self) -> str:
        """Text alternative of the view for screen readers."""
        detections = self.result.detections if self.result else ()
        identified = [
            self.name(detection.id) for detection in detections if detection.id >= 0
        ]
        return f"Sensor view: {len(self.lights)} true lights; identified: {', '.join(identified) or 'none'}"

    def name(self, id: int) -> str:
        if self.prefix != "HIP":
            return f"{self.prefix} {id}"
        return LABELS.get(id, f"HIP {id}" if id < 1_000_000 else f"star {id}")

    def hover_changed(self, event: Any) -> None:
        """Handle a move of the mouse to another light, or to none, or a click.

        After a click the data of the light stay on the page until the mouse is on another one.
        """
        self.hover_px = (event.args["x"], event.args["y"]) if event.args["inside"] else None
        self.update_text()

    def nearest(self, x: float, y: float) -> tuple[Detection | None, Any]:
        """The nearest detection and the nearest true light within a few widths of a mark, or None."""
        radius_px = max(8.0, self.size_px[0] / 60)

        def nearest(places_px: Floats) -> int | None:
            distance_px = np.hypot(*(places_px - (x, y)).T)
            return int(distance_px.argmin()) if (distance_px < radius_px).any() else None

        detections = self.result.detections if self.result else ()
        spot = nearest(places_px(detections))
        light = nearest(self.lights.xy_px)
        return (
            None if spot is None else detections[spot],
            None if light is None else self.lights[light],
        )

    def light_text(self, detection: Detection | None, light: Any) -> str:
        """Text on a light: its true place, its detection and the error."""
        lines = []
        if light is not None:
            x, y = light.xy_px
            brightness = "" if math.isnan(light.magnitude) else f"V {light.magnitude:.2f}  "
            lines += [
                f"truth      {x:8.2f} {y:8.2f}   {self.name(light.id)}",
                f"           {brightness}{light.electrons:.4g} e-",
            ]
        if detection:
            identity = self.name(detection.id) if detection.id >= 0 else "not identified"
            residual_px = math.hypot(*detection.residual_px)
            residual = "" if math.isnan(residual_px) else f"   residual {residual_px:.3f} px"
            lines += [
                f"centroid   {detection.x:8.2f} {detection.y:8.2f} ± {detection.sigma_px:.3f} px",
                f"           {identity}",
                f"           flux {detection.flux:.4g}{residual}",
            ]
            if light is not None:
                error_px = math.hypot(detection.x - x, detection.y - y)
                lines += [f"           error {error_px:.3f} px"]
        return "\n".join(lines)


@functools.cache
def color_table(name: str) -> str:
    """256 x (red, green, blue) of a color map, base64."""
    ramp = np.arange(256, dtype=np.uint8)[:, None]
    kind = COLOR_MAPS[name]
    if kind is None:
        table = np.repeat(255 - ramp if "inverted" in name else ramp, 3, axis=1)
    else:
        table = cv2.applyColorMap(ramp, kind)[:, 0, ::-1]
    return base64.b64encode(table.tobytes()).decode()


def statistics_text(image: FrameView | Photo, of: SceneInfo | Photo) -> str:
    """An image's numbers in two columns; fewer if it is not of a scene."""
    statistics = image.statistics
    result = image.result
    field = ("field", f"{of.field_deg:.4g}°") if isinstance(of, SceneInfo) else ("", "")
    width, height = image.pixels.fields["size"]
    rows = [("frame", f"{width} × {height} px", *field)]
    lights: tuple[str, ...] = ()
    if isinstance(image, FrameView):
        lights = ("lights", f"{len(image.lights)} in the field")
        exposure = f"{1e3 * image.exposure_s:.4g} ms"
        rows += [("exposure", exposure, "rendering", f"{image.ms:.0f} ms")]
    rows += [
        ("sky", f"{statistics.sky_dn:.5g} DN", "scatter", f"{statistics.scatter_dn:.3g} DN"),
        (
            "brightest",
            f"{statistics.peak_dn:.5g} DN",
            "saturated",
            f"{statistics.saturated} px",
        ),
    ]
    detected = (
        ("identified", f"{result.row.matched} of {result.row.detected}") if result else ()
    )
    rows += [(*lights, *detected, "", "", "", "")[:4]]
    return "\n".join(f"{a:<11s}{b:<18s}{c:<11s}{d}".rstrip() for a, b, c, d in rows)
