"""Run panel: simulates the scene's motion and plays it at a chosen speed, with strip charts of errors and lights."""

from __future__ import annotations

import math
import time
from typing import TYPE_CHECKING, Any

from nicegui import ui

from skysim.apps.gui.messages import FlightLog, FrameView
from skysim.apps.gui.page import keys
from skysim.apps.gui.page.forms import LOOPS, looped
from skysim.apps.gui.page.style import CURVES, INK, TOOLTIP

if TYPE_CHECKING:
    from skysim.apps.gui.page.page import Tab

SPEEDS = {"real time": 1.0, "½": 0.5, "¼": 0.25, "1/10": 0.1, "2×": 2.0, "5×": 5.0}
STRIPS = ("error, arcsec", "lights", "innovation, arcsec", "momentum, N m s")
LOGARITHMIC = (0, 2)
STEERED = ("motion.control", "motion.manoeuvre")
OFF = ("off what was asked", "IMU alone", "filter", "star tracker")


class RunPanel:
    """Panel that simulates the motion, plays, pauses and seeks.

    begun_s, from_s : monotonic time of the last start of playback, and the playback time there
    came : by curve its points (t_s, value) from frames played so far
    of, closed : scene with a closed loop, and its overrides then, so that an opened loop can be closed again
    """

    def __init__(self, tab: Tab) -> None:
        self.tab, self.log = tab, FlightLog(())
        self.playing, self.flying, self.busy = False, False, False
        self.begun_s = self.from_s = 0.0
        self.factor = 1.0
        self.came: dict[str, list[list[float]]] = {}
        self.held, self.of, self.closed = False, "", dict[str, str]()
        with ui.row().classes("w-full no-wrap items-center gap-2"):
            self.fly = ui.button("Fly", on_click=self.begin).props("dense outline size=sm").mark("fly")
            self.play = ui.button(icon="play_arrow", on_click=self.toggle).props(
                'dense flat aria-label="Play"'
            )
            self.play.mark("play").disable()
            self.speed = ui.select(list(SPEEDS), value="real time").props(
                'dense borderless aria-label="Speed"'
            )
            self.speed.classes("w-24").on("popup-hide", js_handler=keys.LEAVE).on_value_change(self.resync)
            self.loop = ui.select({}, on_change=self.close_loop).props("dense borderless options-dense")
            self.loop.props('aria-label="Feedback"').mark("feedback").on("popup-hide", js_handler=keys.LEAVE)
            ui.space()
            self.clock = ui.label("0.00 s").classes("mono")
        self.bar = ui.linear_progress(0, show_value=False, size="3px").props("instant-feedback")
        self.seek = ui.slider(min=0, max=1, step=0.01, value=0).props('dense aria-label="Time"')
        self.seek.on("change", self.sought).on("pan", self.hold)
        self.seek.disable()
        self.chart = ui.echart(options()).classes("lab-strips w-full").mark("strips")
        ui.timer(1 / 30, self.tick)

    def set(self) -> None:
        """Take over a new scene, which has no simulated motion yet."""
        self.pause()
        self.log, self.came, self.from_s = FlightLog(()), {}, 0.0
        self.play.disable()
        self.seek.disable()
        self.seek.set_value(0)
        self.clock.set_text("0.00 s")
        told = self.tab.feedback
        if told:
            self.of, self.closed = self.tab.scene, dict(self.tab.overrides)
        self.loop.set_options(LOOPS if self.of == self.tab.scene else {"": LOOPS[""]}, value=told or "")
        self.draw()

    async def close_loop(self) -> None:
        """Reopen the scene with another feedback. An opened loop can be closed again with its old controller."""
        now, wanted = self.tab.feedback or "", str(self.loop.value or "")
        if self.of != self.tab.scene or wanted == now:
            return
        kept = {key: told for key, told in self.tab.overrides.items() if not key.startswith(STEERED)}
        steered = {key: told for key, told in self.closed.items() if key.startswith(STEERED)}
        control = looped(self.tab.scene_path, {**kept, **steered}, wanted)
        flown = {key: told for key, told in steered.items() if key.startswith(STEERED[1]) and wanted}
        self.loop.disable()  # no second change while this one runs
        await self.tab.open(self.tab.scene, {**kept, **flown, **control})
        if self.tab.open_still:
            self.loop.set_value(self.tab.feedback or "")  # the old value, if the scene refused the change
            self.loop.enable()

    async def begin(self) -> None:
        """Simulate the motion from its start, then play it; if a simulation runs, stop it."""
        if self.flying:
            self.tab.session.halt()
            return
        self.pause()
        self.flying = True
        self.fly.set_text("Stop")
        log = await self.tab.ask("fly", doing="flying …")
        self.flying = False
        self.fly.set_text("Fly")
        self.bar.set_value(0)
        if log is None:
            return
        self.log, self.came = log, {}
        self.seek.props(f"max={log.t_s[-1]:.2f}")
        self.play.enable()
        self.seek.enable()
        self.draw()
        self.tab.log(f"flew {log.t_s[-1]:.2f} s")
        self.from_s = 0.0
        self.start()

    def start(self) -> None:
        """Start or continue playback."""
        self.tab.photo.stop()
        self.playing, self.begun_s = True, time.monotonic()
        self.play.props("icon=pause")

    def toggle(self) -> None:
        """Play or pause; at the end, play again from the start."""
        if self.playing:
            self.pause()
            return
        if self.log.t_s and self.from_s >= self.log.t_s[-1] - 0.05:
            self.from_s, self.came = 0.0, {}
        self.start()

    def pause(self) -> None:
        """Pause at the current time."""
        self.from_s, self.playing = self.now_s, False
        self.play.props("icon=play_arrow")

    @property
    def now_s(self) -> float:
        """Current playback time, limited to the duration of the motion."""
        since = (time.monotonic() - self.begun_s) * self.factor if self.playing else 0.0
        return min(self.from_s + since, self.log.t_s[-1] if self.log.t_s else 0.0)

    def resync(self) -> None:
        """Continue from the current time at another speed."""
        if self.playing:
            self.from_s, self.begun_s = self.now_s, time.monotonic()
        self.factor = SPEEDS[str(self.speed.value)]

    async def sought(self, event: Any) -> None:
        """Jump to the slider's time."""
        if not self.log.t_s:
            return
        self.from_s, self.begun_s = float(event.args), time.monotonic()
        await self.moment()

    def hold(self, event: Any) -> None:
        """Note whether the user drags the slider; playback does not move it then."""
        self.held = event.args == "start"

    async def tick(self) -> None:
        """Timer: update the progress bar, and show the next frame if the last one has been displayed."""
        if self.flying:
            self.bar.set_value(self.tab.session.share)
        if self.playing and not self.busy:
            await self.moment()
            if self.log.t_s and self.now_s >= self.log.t_s[-1]:
                self.pause()

    async def moment(self) -> None:
        """Render and show the frame at the current playback time."""
        self.busy = True
        try:
            now_s = self.now_s
            view = await self.tab.show(self.tab.session.ask("play", now_s, self.tab.solving))
            if view is not None:
                if not self.held:
                    self.seek.set_value(round(now_s, 2))
                self.clock.set_text(f"{view.t_s:.2f} s")
                self.gather(view)
            await self.tab.sensor.ready()
        finally:
            self.busy = False

    def gather(self, view: FrameView) -> None:
        """Append a frame's values to the curves."""
        answer = view.answer
        off = math.hypot(answer.cross_arcsec, answer.roll_arcsec) if answer and answer.solved else math.nan
        for name, value in (
            ("star tracker", max(off, 1e-3)),
            ("in the field", float(len(view.lights))),
            ("named", float(answer.identified) if answer else math.nan),
            ("innovation", view.innovation_arcsec),
        ):
            if not math.isnan(value):
                self.came.setdefault(name, []).append([round(view.t_s, 3), round(value, 3)])
        self.draw(view.t_s)

    def draw(self, now_s: float = 0.0) -> None:
        """Draw the strip charts with the playback time marked."""
        curves = [
            *((name, 0, self.came.get(name) or curve(self.log, name)) for name in OFF),
            *((name, 1, self.came.get(name, [])) for name in ("in the field", "named")),
            ("innovation", 2, self.came.get("innovation", [])),
            ("momentum", 3, curve(self.log, "momentum")),
        ]
        shown, end_s = self.chart.options, self.log.t_s[-1] if self.log.t_s else 1.0
        shown["series"] = [
            line(name, strip, points, CURVES[n % len(CURVES)])
            for n, (name, strip, points) in enumerate(curves)
            if points
        ] + [moment(strip, now_s) for strip in range(len(STRIPS))]
        for strip, axis in enumerate(shown["xAxis"]):
            axis["max"] = round(end_s, 2)
            here = {name: points for name, at, points in curves if at == strip and points}
            if strip in LOGARITHMIC:
                shown["yAxis"][strip] |= decades([y for points in here.values() for _, y in points])
            shown["legend"][strip]["data"] = list(here)
            shown["title"][len(STRIPS) + strip]["text"] = "" if here else self.empty(strip)
        self.chart.update()

    def empty(self, strip: int) -> str:
        """The text of an empty strip: why it has no curve."""
        if not self.log.t_s:
            told = self.tab.setting
            return f"not flown yet: Fly flies {told.duration_s:.4g} s" if told and strip == 0 else ""
        if STRIPS[strip].startswith("innovation"):
            if "filter" not in self.log.curves:
                return "no filter in this scene (Scene, filter)"
            if not self.tab.solving:
                return "identify is off: no star tracker's answer to hold against the filter"
        return "comes while it plays"


def decades(values: list[float]) -> dict[str, float]:
    """Axis limits: whole decades that contain the values."""
    positive = [one for one in values if one > 0] or [1.0]
    low, high = math.floor(math.log10(min(positive))), math.ceil(math.log10(max(positive)))
    return {"min": 10.0**low, "max": 10.0 ** max(high, low + 1)}


def curve(log: FlightLog, name: str) -> list[list[float]]:
    return [[t, value] for t, value in zip(log.t_s, log.curves.get(name, ()), strict=False)]


def line(name: str, strip: int, points: list[list[float]], ink: str) -> dict[str, Any]:
    """ECharts series of a curve in one strip; values that exist per frame are drawn as dots."""
    dots = name in ("star tracker", "innovation")
    return {
        **{"name": name, "type": "scatter" if dots else "line", "data": points, "xAxisIndex": strip},
        **{"yAxisIndex": strip, "showSymbol": dots, "symbolSize": 4, "animation": False},
        **{"lineStyle": {"width": 1.4, "color": ink}, "itemStyle": {"color": ink}},
    }


def moment(strip: int, now_s: float) -> dict[str, Any]:
    """ECharts series of a vertical line in a strip at a time."""
    look = {"color": INK["quiet"], "width": 1, "type": "solid"}
    at = {"silent": True, "symbol": "none", "animation": False, "label": {"show": False}, "lineStyle": look}
    marked = {"markLine": at | {"data": [{"xAxis": now_s}]}}
    return {"type": "line", "data": [], "xAxisIndex": strip, "yAxisIndex": strip, "animation": False} | marked


def options() -> dict[str, Any]:
    """ECharts options of four stacked strips with a common time axis; each has a title, a legend and an empty text."""
    text, rule = {"color": INK["quiet"], "fontSize": 10}, {"lineStyle": {"color": INK["line"]}}
    plain = text | {"fontWeight": "normal", "fontSize": 11}
    last, slot = len(STRIPS) - 1, 24.2  # percent of the chart's height
    tops = [1 + n * slot for n in range(last + 1)]
    legend = {"textStyle": text, "itemWidth": 12, "itemHeight": 6, "itemGap": 8, "right": 10, "padding": 0}
    return {
        "animation": False,
        "title": [
            *(
                {"text": name, "left": 0, "top": f"{top}%", "padding": 0, "textStyle": plain}
                for name, top in zip(STRIPS, tops, strict=True)
            ),
            *(
                {"text": "", "left": "center", "top": f"{top + 11}%", "padding": 0, "textStyle": plain}
                for top in tops
            ),
        ],
        "legend": [legend | {"top": f"{top}%", "data": []} for top in tops],
        "tooltip": TOOLTIP,
        "grid": [{"left": 50, "right": 12, "top": f"{top + 5.4}%", "height": "16.4%"} for top in tops],
        "xAxis": [
            {
                **{"type": "value", "gridIndex": n, "min": 0, "splitLine": {"show": False}},
                "axisLabel": {**text, "show": n == last},
            }
            for n in range(last + 1)
        ],
        "yAxis": [
            {
                **{"type": "log" if n in LOGARITHMIC else "value", "gridIndex": n, "splitNumber": 3},
                **{"axisLabel": text, "splitLine": rule},
            }
            for n in range(last + 1)
        ],
        "series": [],
    }
