"""Run panel: computes the scene's flight in the worker, and plays, scrubs and steps through its frames."""

import asyncio
import bisect
import math
import time
from collections.abc import Callable, Sequence
from functools import partial
from operator import attrgetter
from pathlib import Path
from typing import Any, NamedTuple

from nicegui import ui

from skysim.apps.gui.messages import (
    AtLimit,
    Curves,
    FlightRow,
    FlightStep,
    Residual,
    SceneInfo,
)
from skysim.apps.gui.page.residuals import FlightLights, by_light
from skysim.apps.gui.page.strips import Strip, Strips, rms_line, same_times, strips
from skysim.apps.gui.views import context, forms, widgets
from skysim.apps.gui.views.context import PageView
from skysim.apps.gui.worker import photo
from skysim.core.types import Record
from skysim.results import run_report, scoring
from skysim.scene.scene import Scene

SPEEDS = {"real time": 1.0, "½": 0.5, "¼": 0.25, "1/10": 0.1, "2×": 2.0, "5×": 5.0}
TIME_S = attrgetter("row.t_s")  # time of a flight's row
REFERENCE = "reference"  # of its frames, in the page's banner
CONTROL = "motion.control"
CONTROL_KEYS = (CONTROL, "motion.maneuver")
BUDGET_S = 0.04  # time to compute a piece of the flight; a key waits for at most one
LOOK_S = 0.05  # interval of checks whether the flight still plays
DOUBLE_CLICK_S = (
    0.5  # the second click of a double click does not stop what the first has begun
)
DRAW_S = 0.7  # interval of drawing the strips while frames are computed


class Timeline(ui.element, component="js/timeline.js"):  # type: ignore[call-arg]
    """What happened in a flight, implemented in timeline.js; a click shows the frame."""


class Comparison(ui.element, component="js/compared.js"):  # type: ignore[call-arg]
    """How this flight differs from the reference, implemented in compared.js."""


class KeptRun(NamedTuple):
    """A flight to which others are compared: its `description`, scene, rows, strips, and their end."""

    shown: Record
    scene: Scene
    rows: Sequence[FlightRow]
    strips: Sequence[Strip]
    end_s: float


class RunPanel:
    """Panel that computes the flight, plays, pauses, steps and seeks.

    Attributes
    ----------
    feedback
        Feedback of the scene's controller; empty without a controller
    rows, log
        Rows of the computed frames, and curves of the motion
    residuals
        Residuals of the identified lights, as in `FlightStep`
    reference
        The flight that is kept for comparison, if any; another scene does not empty it
    computing, stopping
        Whether the flight is being computed, and whether the computation must stop
    playing, showing
        Whether it plays, and whether `play_on` shows its frames
    slot
        Slot of the panel in the page
    wanted_s
        Time to be shown once the flight is computed; None: play it from its start
    when_shown
        Function that is called when this time is shown
    sought
        Position of the slider while its frame is not shown yet
    index
        Index of the frame on the page
    begun_s
        Time at which the last computation has begun
    started_s, from_s
        Time of the last start of playback, and the time in the flight at this start
    """

    feedback = ""
    computing = stopping = playing = showing = False
    reference: KeptRun | None = None
    wanted_s: float | None = None
    sought: int | None = None
    plays_when_done = False
    started_s = 0.0
    begun_s = -math.inf
    drawn_s = 0.0

    def __init__(self, page: context.PageContext) -> None:
        self.page = page
        self.when_shown: Callable[[], None] | None = None
        self.factor = SPEEDS["real time"]
        self.slot = ui.context.slot
        self.build()

    def build(self) -> None:
        with widgets.row(1):
            self.simulate_button = widgets.button("Simulate", self.simulate)
            self.back = self.player_button(
                "skip_previous", "Previous frame", partial(self.step, -1)
            )
            self.play = self.player_button("play_arrow", "Play", self.toggle)
            self.forward = self.player_button(
                "skip_next", "Next frame", partial(self.step, 1)
            )
            self.speed = widgets.select(list(SPEEDS), "borderless", value="real time")
            self.speed.props('aria-label="Speed"').classes("w-24").on_value_change(
                self.resync
            )
            self.loop = widgets.select({}, "borderless", on_change=self.close_loop)
            self.loop.props('aria-label="Feedback"')
        self.bar = ui.linear_progress(0, show_value=False, size="3px").props(
            "instant-feedback"
        )
        with widgets.row(3):
            self.seek = widgets.LiveInput(self.page.contents, "range").props(
                'min=0 step=1 aria-label="Frame of the flight"'
            )
            self.seek.classes("lab-seek").on(
                "input", self.slid, js_handler="event => emit(event.target.value)"
            )
            self.clock = widgets.LiveText(self.page.contents).classes("mono flex-none")
        with widgets.row(3):
            self.summary = ui.label().classes("quiet flex-grow")
            self.keep_button = widgets.button("Keep as reference", self.keep, "flat")
            self.keep_button.props("no-wrap")
            self.csv_button = widgets.button("CSV", self.download, "flat")
        self.comparison = Comparison().on("switch", self.switch).on("forget", self.forget)
        self.timeline = Timeline().on("moment", self.clicked)
        self.strips = Strips().on("moment", self.clicked)
        self.lights = FlightLights()
        self.clear()
        self.page.derive(lambda view: view.opened, self.clear)
        self.page.derive(lambda view: view.kind == "flight", self.hide_moment)

    def player_button(self, icon: str, label: str, action: Any) -> ui.button:
        return ui.button(icon=icon, on_click=action).props(f'dense flat aria-label="{label}"')

    @property
    def is_ready(self) -> bool:
        """Whether there are frames to show, all of them computed."""
        return bool(self.rows) and not self.computing

    def enable(self) -> None:
        """Enable the controls if there are frames; without frames, show what to do."""
        for item in (self.back, self.play, self.forward, self.keep_button, self.csv_button):
            item.set_enabled(self.is_ready)
        self.seek.props(f"max={max(len(self.rows) - 1, 1)}")
        self.seek.props["disabled"] = not self.is_ready
        if self.rows or self.computing:
            return
        info = self.page.scene_info
        self.hide_moment()
        self.summary.set_text(
            f"No flight yet. Simulate computes the motion of {info.duration_s:.4g} s and every frame of it."
            if info
            else ""
        )

    def set_scene(self, info: SceneInfo) -> None:
        """Set up the panel for a new scene."""
        control = info.scene.motion.control
        self.feedback = control.feedback if control else ""
        has_loop = self.feedback or CONTROL in self.page.state.overrides
        offered = forms.FEEDBACKS if has_loop else {"": forms.FEEDBACKS[""]}
        self.loop.set_options(offered, value=self.feedback)

    def clear(self) -> None:
        """Forget the flight."""
        self.rows: list[FlightRow] = []
        self.log: Curves = {}
        self.residuals: list[Residual] = []
        self.limits: Sequence[AtLimit] = ()
        self.index = 0
        self.from_s = 0.0
        self.seek.set_value(0)
        self.bar.set_value(0)
        self.strips.run_method("show", [], [], 1.0, {})
        self.lights.run_method("show", [])
        self.timeline.run_method("show", [], [], 1.0)
        self.compare()
        self.enable()

    def hide_moment(self) -> None:
        """Show no moment of the flight, as the page does not."""
        self.clock.set_text("")
        self.page.contents.set(self.strips.id, {"moment": "nan"})

    async def close_loop(self) -> None:
        """Reopen the scene with another feedback. An opened loop is closed again with the controller of the file."""
        state = self.page.state
        feedback = str(self.loop.value or "")
        if feedback == self.feedback:
            return
        stays_closed = feedback and self.feedback
        replaced = CONTROL if stays_closed else CONTROL_KEYS
        others = {
            key: value
            for key, value in state.overrides.items()
            if not key.startswith(replaced)
        }
        control = forms.loop_overrides(
            state.scene, state.overrides if stays_closed else others, feedback
        )
        self.loop.disable()  # no second change while this one runs
        await self.page.open(state.scene, others | control, head=state.head)
        if self.page.is_open:
            # The old value, if the scene refused the change.
            self.loop.set_value(self.feedback)
            self.loop.enable()

    # Computing.

    def stop_computing(self) -> None:
        """Ask the computation of the flight to end after its current piece; the frames so far are kept."""
        self.stopping = self.computing

    async def simulate(self) -> None:
        """Compute the flight, then play it; if it is being computed, stop that and keep the frames so far."""
        if time.monotonic() < self.begun_s + DOUBLE_CLICK_S:
            return
        self.stop_computing()
        if self.computing:
            return
        self.pause()
        self.computing = self.plays_when_done = True
        self.begun_s = time.monotonic()
        self.clear()
        self.simulate_button.set_text("Stop")
        self.page.show_message("")
        # Piece by piece, so that keys and other requests get their turn.
        step = await self.page.ask("begin_flight")
        while step is not None and not step.is_done and not self.stopping:
            self.take(step)
            step = await self.page.ask("advance_flight", BUDGET_S)
        if step is not None:
            self.take(step)
        self.stopping = False
        done = step is not None and step.is_done
        if not self.page.is_open:
            return
        self.computing = False
        self.simulate_button.set_text("Simulate")
        self.bar.set_value(0)
        self.draw()
        self.enable()
        if self.rows:
            flown = f"flight of {Path(self.page.state.scene).name}: {rms_line(self.rows)}"
            self.page.log(flown if done else f"{flown}; stopped")
        if self.wanted_s is not None:
            await self.show_linked(self.wanted_s)
            self.wanted_s = None
            if self.when_shown:
                self.when_shown()
        elif self.rows and self.plays_when_done and done:
            self.start()

    def take(self, step: FlightStep) -> None:
        """Add new rows, residuals and curves of the flight."""
        self.rows += step.rows
        self.residuals += step.residuals
        self.log = step.log or self.log
        self.limits = step.limits or self.limits
        self.bar.set_value(step.t_s / max(step.duration_s, 1e-9))
        self.summary.set_text(
            f"{step.t_s:.2f} of {step.duration_s:.2f} s, {len(self.rows)} frames"
        )
        if time.monotonic() > self.drawn_s + DRAW_S and (step.rows or step.log):
            self.draw()

    def draw(self) -> None:
        """Draw the strips with the frames so far."""
        self.drawn_s = time.monotonic()
        lights = (
            () if self.computing else self.residuals
        )  # residuals are many, so they are sent once
        kept = self.other_run
        drawn = strips(self.rows, self.log, lights, kept.rows if kept else ())
        end_s = max(self.end_s, kept.end_s) if kept else self.end_s
        names = {one.id: self.page.sensor.name(one.id) for one in lights}
        self.strips.run_method("show", drawn, kept.strips if kept else [], end_s, names)
        frames = [
            (one.row.t_s, one.row.status, one.row.wrong, one.saturated, one.row.filter)
            for one in self.rows
        ]
        self.timeline.run_method("show", frames, self.limits, end_s)
        info = self.page.scene_info
        assert info is not None
        self.lights.run_method("show", *by_light(lights), info.prefix, info.pixel_arcsec)
        if self.rows:
            self.summary.set_text(rms_line(self.rows))
        self.compare()

    @property
    def end_s(self) -> float:
        """Time at which the strips end."""
        ends = [*self.log.get("t_s", ())[-1:], *map(TIME_S, self.rows[-1:])]
        return max(ends, default=1.0)

    # Comparing with another flight.

    @property
    def other_run(self) -> KeptRun | None:
        """The reference, unless it is this flight itself."""
        kept = self.reference
        return kept if kept and kept.rows is not self.rows else None

    async def keep(self) -> None:
        """Keep this flight, to which the next ones are compared."""
        info = self.page.scene_info
        assert info is not None
        shown = description(self.page.state, self.rows)
        drawn = strips(self.rows, self.log)
        kept = KeptRun(shown, info.scene, self.rows, drawn, self.end_s)
        await self.page.ask("keep_flight", True)
        self.reference = kept
        self.draw()

    async def forget(self) -> None:
        """Compare no more."""
        self.reference = None
        self.draw()
        await self.page.ask("keep_flight", False)

    def compare(self) -> None:
        """Show how this flight differs from the reference."""
        shown: list[object] = []
        if self.reference:
            own = description(self.page.state, self.rows if self.other_run else ())
            pairs = same_times(self.rows, self.reference.rows)
            shown += [own, self.reference.shown, len(pairs)]
        self.comparison.run_method("show", *shown)

    async def switch(self) -> None:
        """Show the reference's frame nearest to the shown time, or this flight's again."""
        self.pause()
        state = self.page.state
        if state.kind == "photo" and state.photo.startswith(REFERENCE):
            await self.show_index(self.index)
            return
        assert self.reference is not None
        index = nearest(self.reference.rows, TIME_S(self.rows[self.index]))
        picture = await self.page.ask("kept_frame", index)
        if picture is not None:
            name = f"{REFERENCE} at {TIME_S(self.reference.rows[index]):.2f} s"
            self.page.show_photo(picture, kind="photo", photo=name)

    async def restore(self, t_s: float, when_shown: Callable[[], None]) -> None:
        """Show a moment of the flight again; compute the flight first if it was not kept.

        Parameters
        ----------
        when_shown
            Called after this computation
        """
        if self.is_ready:
            await self.show_linked(t_s)
            return
        self.wanted_s = t_s
        self.when_shown = when_shown
        if not self.computing:
            self.page.show_panel("Run")
            ui.timer(0, self.simulate, once=True)

    async def show_linked(self, t_s: float) -> None:
        """Show the moment of an address; say it if the flight has no such time."""
        await self.show_moment(t_s)
        if self.rows and t_s > TIME_S(self.rows[-1]) + 1e-4:  # an address rounds to this
            last_s = TIME_S(self.rows[-1])
            self.page.show_message(f"{t_s:g} s is after the last frame, at {last_s:g} s")

    # Playing.

    def start(self) -> None:
        self.page.stop_playback()
        self.playing = True
        self.started_s = time.monotonic()
        self.play.props("icon=pause")
        with self.slot:  # not in the slot of a palette's row, which ends with the palette
            ui.timer(0, self.play_on, once=True)

    def toggle(self) -> None:
        """Play or pause; at the end, play again from the start."""
        if self.playing:
            self.pause()
        elif self.is_ready:
            is_over = self.index >= len(self.rows) - 1
            self.from_s = 0.0 if is_over else TIME_S(self.rows[self.index])
            self.start()

    def pause(self) -> None:
        self.from_s = self.now_s
        self.playing = False
        self.plays_when_done = False
        self.play.props("icon=play_arrow")

    @property
    def now_s(self) -> float:
        """Current playback time."""
        elapsed = (time.monotonic() - self.started_s) * self.factor if self.playing else 0.0
        return self.from_s + elapsed

    def resync(self) -> None:
        """Continue from the current time at a new speed."""
        self.from_s = self.now_s
        self.started_s = time.monotonic()
        self.factor = SPEEDS[str(self.speed.value)]

    async def step(self, frames: int) -> None:
        """Show the next or the previous frame."""
        if self.is_ready:
            self.pause()
            await self.show_index(min(max(self.index + frames, 0), len(self.rows) - 1))

    async def clicked(self, event: Any) -> None:
        """Show the moment at which a strip was clicked."""
        await self.show_moment(float(event.args))

    async def show_moment(self, t_s: float) -> None:
        """Show the frame nearest to a time of the flight."""
        if self.is_ready:
            self.pause()
            await self.show_index(nearest(self.rows, t_s))

    async def slid(self, event: Any) -> None:
        """Show the frame at the position of the dragged slider; skip all but the newest position."""
        is_showing = self.sought is not None
        self.sought = int(event.args)
        while not is_showing and self.sought is not None:
            index = self.sought
            if 0 <= index < len(self.rows):
                self.from_s = TIME_S(self.rows[index])
                self.started_s = time.monotonic()
                await self.show_index(index)
            if self.sought == index:
                self.sought = None

    async def play_on(self) -> None:
        """While the flight plays, show the frame that is due; pause at the last one."""
        if self.showing:  # it was paused and started again meanwhile
            return
        self.showing = True
        try:
            while self.playing and self.rows and self.page.is_open:
                index = max(bisect.bisect_right(self.rows, self.now_s, key=TIME_S) - 1, 0)
                if index != self.index or self.page.state.kind != "flight":
                    await self.show_index(index)
                if self.index >= len(self.rows) - 1:
                    self.pause()
                elif self.playing:
                    wait_s = (TIME_S(self.rows[self.index + 1]) - self.now_s) / self.factor
                    await asyncio.sleep(min(max(wait_s, 0.001), LOOK_S))
        except Exception:
            self.pause()
            raise
        finally:
            self.showing = False

    async def show_index(self, index: int) -> None:
        """Show a frame of the flight."""
        self.index = index
        view = await self.page.ask("flight_frame", index)
        if view is None or index >= len(self.rows):
            return
        t_s = TIME_S(self.rows[index])
        self.page.set_state(kind="flight", t_s=t_s)
        self.seek.set_value(index)
        self.clock.set_text(f"{t_s:.2f} s  {index + 1}/{len(self.rows)}")
        self.page.contents.set(self.strips.id, {"moment": f"{t_s:.4f}"})
        self.page.show_frame(view)
        await self.page.sensor.wait_drawn()

    def download(self) -> None:
        assert self.page.scene_info
        table = flight_table(self.rows, self.page.scene_info.scene)
        if self.other_run:
            table = with_kept(table, self.page.state.name, self.other_run)
        ui.download(
            widgets.csv_table(table.colnames, table),
            f"{Path(self.page.state.scene).stem}_flight.csv",
        )


def nearest(rows: Sequence[FlightRow], t_s: float) -> int:
    """The row nearest to a time."""
    return min(range(len(rows)), key=lambda n: abs(TIME_S(rows[n]) - t_s))


def description(view: PageView, rows: Sequence[FlightRow]) -> Record:
    """A flight's name, its command, and what `skysim run --json` prints of its frames, if there are any."""
    return {
        "name": view.name,
        "command": photo.command(forms.absolute_path(view.scene), view.overrides),
        "run": run_report.summary([one.row for one in rows]) if rows else None,
    }


def with_kept(table: Any, name: str, kept: KeptRun) -> Any:
    """A flight's table and that of the reference, with the names of both in the column `run`."""
    from astropy.table import vstack

    other = flight_table(kept.rows, kept.scene)
    table["run"] = name
    other["run"] = kept.shown["name"]
    return vstack([table, other]).filled(math.nan)


def flight_table(rows: Sequence[FlightRow], scene: Scene) -> Any:
    """The table of `solutions.ecsv` with the page's columns, as an astropy table."""
    table = scoring.table([one.row for one in rows], scene)
    for name in FlightRow._fields[1:]:
        table[name] = [getattr(one, name) for one in rows]
    return table
