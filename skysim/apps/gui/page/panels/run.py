"""Run panel: simulates the scene's motion and plays it at a chosen speed, with strip charts of errors and lights."""

from __future__ import annotations

import math
import time
from typing import TYPE_CHECKING, Any

from nicegui import ui

from skysim.apps.gui.messages import FrameView, MotionLog
from skysim.apps.gui.page import keys
from skysim.apps.gui.page.forms import FEEDBACKS, loop_overrides
from skysim.apps.gui.page.style import COLORS, CURVE_COLORS, TOOLTIP

if TYPE_CHECKING:
    from skysim.apps.gui.page.page import Tab

SPEEDS = {"real time": 1.0, "½": 0.5, "¼": 0.25, "1/10": 0.1, "2×": 2.0, "5×": 5.0}
CHARTS = ("error, arcsec", "lights", "innovation, arcsec", "momentum, N m s")
LOGARITHMIC = (0, 2)
CONTROL_KEYS = ("motion.control", "motion.maneuver")
ERROR_CURVES = ("pointing", "IMU alone", "filter", "star tracker")


class RunPanel:
    """Panel that simulates the motion, plays, pauses and seeks.

    started_s, from_s : monotonic time of the last start of playback, and the playback time there
    frame_curves : by curve its points (t_s, value) from frames played so far
    closed_scene, closed_overrides : last scene with a closed loop and its overrides, with which an opened loop is
        closed again
    """

    def __init__(self, tab: Tab) -> None:
        self.tab, self.log = tab, MotionLog(())
        self.playing, self.simulating, self.busy = False, False, False
        self.started_s = self.from_s = 0.0
        self.factor = 1.0
        self.frame_curves: dict[str, list[list[float]]] = {}
        self.dragging, self.closed_scene, self.closed_overrides = False, "", dict[str, str]()
        with ui.row().classes("w-full no-wrap items-center gap-2"):
            self.simulate_button = ui.button("Simulate", on_click=self.simulate).props("dense outline size=sm")
            self.simulate_button.mark("fly")
            self.play = ui.button(icon="play_arrow", on_click=self.toggle).props('dense flat aria-label="Play"')
            self.play.mark("play").disable()
            self.speed = ui.select(list(SPEEDS), value="real time").props('dense borderless aria-label="Speed"')
            self.speed.classes("w-24").on("popup-hide", js_handler=keys.BLUR_JS).on_value_change(self.resync)
            self.loop = ui.select({}, on_change=self.close_loop).props("dense borderless options-dense")
            self.loop.props('aria-label="Feedback"').mark("feedback").on("popup-hide", js_handler=keys.BLUR_JS)
            ui.space()
            self.clock = ui.label("0.00 s").classes("mono")
        self.bar = ui.linear_progress(0, show_value=False, size="3px").props("instant-feedback")
        self.seek = ui.slider(min=0, max=1, step=0.01, value=0).props('dense aria-label="Time"')
        self.seek.on("change", self.seek_to).on("pan", self.slider_dragged)
        self.seek.disable()
        self.chart = ui.echart(options()).classes("lab-strips w-full").mark("strips")
        ui.timer(1 / 30, self.tick)

    def set_scene(self) -> None:
        """Take over a new scene, which has no simulated motion yet."""
        self.pause()
        self.log, self.frame_curves, self.from_s = MotionLog(()), {}, 0.0
        self.play.disable()
        self.seek.disable()
        self.seek.set_value(0)
        self.clock.set_text("0.00 s")
        feedback = self.tab.feedback
        if feedback:
            self.closed_scene, self.closed_overrides = self.tab.scene, dict(self.tab.overrides)
        self.loop.set_options(
            FEEDBACKS if self.closed_scene == self.tab.scene else {"": FEEDBACKS[""]}, value=feedback or ""
        )
        self.draw()

    async def close_loop(self) -> None:
        """Reopen the scene with another feedback. An opened loop can be closed again with its old controller."""
        current, feedback = self.tab.feedback or "", str(self.loop.value or "")
        if self.closed_scene != self.tab.scene or feedback == current:
            return
        others = {key: value for key, value in self.tab.overrides.items() if not key.startswith(CONTROL_KEYS)}
        controls = {key: value for key, value in self.closed_overrides.items() if key.startswith(CONTROL_KEYS)}
        maneuver = {key: value for key, value in controls.items() if feedback and key.startswith("motion.maneuver")}
        control = loop_overrides(self.tab.scene_path, others | controls, feedback)
        self.loop.disable()  # no second change while this one runs
        await self.tab.open(self.tab.scene, others | maneuver | control)
        if self.tab.is_open:
            self.loop.set_value(self.tab.feedback or "")  # the old value, if the scene refused the change
            self.loop.enable()

    async def simulate(self) -> None:
        """Simulate the motion from its start, then play it; if a simulation runs, stop it."""
        if self.simulating:
            self.tab.session.halt()
            return
        self.pause()
        self.simulating = True
        self.simulate_button.set_text("Stop")
        log = await self.tab.run_task("simulate", activity="simulating the motion …")
        self.simulating = False
        self.simulate_button.set_text("Simulate")
        self.bar.set_value(0)
        if log is None:
            return
        self.log, self.frame_curves = log, {}
        self.seek.props(f"max={log.t_s[-1]:.2f}")
        self.play.enable()
        self.seek.enable()
        self.draw()
        self.tab.log(f"simulated {log.t_s[-1]:.2f} s")
        self.from_s = 0.0
        self.start()

    def start(self) -> None:
        self.tab.photo.stop()
        self.playing, self.started_s = True, time.monotonic()
        self.play.props("icon=pause")

    def toggle(self) -> None:
        """Play or pause; at the end, play again from the start."""
        if self.playing:
            self.pause()
            return
        if self.log.t_s and self.from_s >= self.log.t_s[-1] - 0.05:
            self.from_s, self.frame_curves = 0.0, {}
        self.start()

    def pause(self) -> None:
        self.from_s, self.playing = self.now_s, False
        self.play.props("icon=play_arrow")

    @property
    def now_s(self) -> float:
        """Current playback time, limited to the duration of the motion."""
        elapsed = (time.monotonic() - self.started_s) * self.factor if self.playing else 0.0
        return min(self.from_s + elapsed, self.log.t_s[-1] if self.log.t_s else 0.0)

    def resync(self) -> None:
        """Continue from the current time at another speed."""
        if self.playing:
            self.from_s, self.started_s = self.now_s, time.monotonic()
        self.factor = SPEEDS[str(self.speed.value)]

    async def seek_to(self, event: Any) -> None:
        if not self.log.t_s:
            return
        self.from_s, self.started_s = float(event.args), time.monotonic()
        await self.show_current()

    def slider_dragged(self, event: Any) -> None:
        """Note whether the user drags the slider; playback does not move it then."""
        self.dragging = event.args == "start"

    async def tick(self) -> None:
        """Timer: update the progress bar, and show the next frame if the last one has been displayed."""
        if self.simulating:
            self.bar.set_value(self.tab.session.progress_fraction)
        if self.playing and not self.busy:
            await self.show_current()
            if self.log.t_s and self.now_s >= self.log.t_s[-1]:
                self.pause()

    async def show_current(self) -> None:
        """Render and show the frame at the current playback time."""
        self.busy = True
        try:
            now_s = self.now_s
            view = await self.tab.show_frame(self.tab.session.run("play", now_s, self.tab.solving))
            if view is not None:
                if not self.dragging:
                    self.seek.set_value(round(now_s, 2))
                self.clock.set_text(f"{view.t_s:.2f} s")
                self.append_frame(view)
            await self.tab.sensor.wait_drawn()
        finally:
            self.busy = False

    def append_frame(self, view: FrameView) -> None:
        result = view.result
        error_arcsec = math.hypot(result.cross_arcsec, result.roll_arcsec) if result and result.solved else math.nan
        for name, value in (
            ("star tracker", max(error_arcsec, 1e-3)),
            ("in the field", float(len(view.lights))),
            ("identified", float(result.identified) if result else math.nan),
            ("innovation", view.innovation_arcsec),
        ):
            if not math.isnan(value):
                self.frame_curves.setdefault(name, []).append([round(view.t_s, 3), round(value, 3)])
        self.draw(view.t_s)

    def draw(self, now_s: float = 0.0) -> None:
        """Draw the strip charts with the playback time marked."""
        curves = [
            *((name, 0, self.frame_curves.get(name) or curve_points(self.log, name)) for name in ERROR_CURVES),
            *((name, 1, self.frame_curves.get(name, [])) for name in ("in the field", "identified")),
            ("innovation", 2, self.frame_curves.get("innovation", [])),
            ("momentum", 3, curve_points(self.log, "momentum")),
        ]
        chart, end_s = self.chart.options, self.log.t_s[-1] if self.log.t_s else 1.0
        chart["series"] = [
            line_series(name, chart_index, points, CURVE_COLORS[n % len(CURVE_COLORS)])
            for n, (name, chart_index, points) in enumerate(curves)
            if points
        ] + [time_marker(chart_index, now_s) for chart_index in range(len(CHARTS))]
        for chart_index, axis in enumerate(chart["xAxis"]):
            axis["max"] = round(end_s, 2)
            drawn = {name: points for name, index, points in curves if index == chart_index and points}
            if chart_index in LOGARITHMIC:
                chart["yAxis"][chart_index] |= decades([y for points in drawn.values() for _, y in points])
            chart["legend"][chart_index]["data"] = list(drawn)
            chart["title"][len(CHARTS) + chart_index]["text"] = "" if drawn else self.empty_text(chart_index)
        self.chart.update()

    def empty_text(self, chart_index: int) -> str:
        """The text of an empty strip: why it has no curve."""
        if not self.log.t_s:
            info = self.tab.scene_info
            return f"no motion yet: Simulate runs {info.duration_s:.4g} s" if info and chart_index == 0 else ""
        if CHARTS[chart_index].startswith("innovation"):
            if "filter" not in self.log.curves:
                return "this scene has no filter (Scene, filter)"
            if not self.tab.solving:
                return "identify is off: no attitude to compare with the filter"
        return "appears during playback"


def decades(values: list[float]) -> dict[str, float]:
    """Axis limits: whole decades that contain the values."""
    positive = [value for value in values if value > 0] or [1.0]
    low, high = math.floor(math.log10(min(positive))), math.ceil(math.log10(max(positive)))
    return {"min": 10.0**low, "max": 10.0 ** max(high, low + 1)}


def curve_points(log: MotionLog, name: str) -> list[list[float]]:
    return [[t, value] for t, value in zip(log.t_s, log.curves.get(name, ()), strict=False)]


def line_series(name: str, chart_index: int, points: list[list[float]], color: str) -> dict[str, Any]:
    """ECharts series of a curve in one strip; values that exist per frame are drawn as dots."""
    dots = name in ("star tracker", "innovation")
    series = {"name": name, "type": "scatter" if dots else "line", "data": points, "animation": False}
    look = {"lineStyle": {"width": 1.4, "color": color}, "itemStyle": {"color": color}}
    return series | look | {"showSymbol": dots, "symbolSize": 4} | in_strip(chart_index)


def time_marker(chart_index: int, now_s: float) -> dict[str, Any]:
    """ECharts series of a vertical line in a strip at a time."""
    line_style = {"color": COLORS["quiet"], "width": 1, "type": "solid"}
    mark = {"silent": True, "symbol": "none", "animation": False, "label": {"show": False}, "lineStyle": line_style}
    series = {"type": "line", "data": [], "animation": False, "markLine": mark | {"data": [{"xAxis": now_s}]}}
    return series | in_strip(chart_index)


def in_strip(chart_index: int) -> dict[str, int]:
    return {"xAxisIndex": chart_index, "yAxisIndex": chart_index}


def options() -> dict[str, Any]:
    """ECharts options of four stacked strips with a common time axis; each has a title, a legend and an empty text."""
    text, rule = {"color": COLORS["quiet"], "fontSize": 10}, {"lineStyle": {"color": COLORS["line"]}}
    title = {"padding": 0, "textStyle": text | {"fontWeight": "normal", "fontSize": 11}}
    strips, slot = range(len(CHARTS)), 24.2  # percent of the chart's height
    tops = [1 + n * slot for n in strips]
    x_axis = {"type": "value", "min": 0, "splitLine": {"show": False}}
    y_axis = {"splitNumber": 3, "axisLabel": text, "splitLine": rule}
    legend = {"textStyle": text, "itemWidth": 12, "itemHeight": 6, "itemGap": 8, "right": 10, "padding": 0}
    return {
        "animation": False,
        "title": [
            *(title | {"text": name, "left": 0, "top": f"{top}%"} for name, top in zip(CHARTS, tops, strict=True)),
            *(title | {"text": "", "left": "center", "top": f"{top + 11}%"} for top in tops),
        ],
        "legend": [legend | {"top": f"{top}%", "data": []} for top in tops],
        "tooltip": TOOLTIP,
        "grid": [{"left": 50, "right": 12, "top": f"{top + 5.4}%", "height": "16.4%"} for top in tops],
        "xAxis": [x_axis | {"gridIndex": n, "axisLabel": text | {"show": n == strips[-1]}} for n in strips],
        "yAxis": [y_axis | {"gridIndex": n, "type": "log" if n in LOGARITHMIC else "value"} for n in strips],
        "series": [],
    }
