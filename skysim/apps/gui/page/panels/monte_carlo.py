"""Monte Carlo panel: start and stop studies, show statistics and histogram while they run, replay failed trials."""

from __future__ import annotations

import math
import time
from pathlib import Path
from typing import TYPE_CHECKING, Any
from urllib.parse import quote

from nicegui import run, ui

from skysim.apps.gui.page import keys
from skysim.apps.gui.page.style import INK, TOOLTIP, digits
from skysim.apps.gui.worker.study_process import Tally, Trials, finished, monte_carlo
from skysim.core import files
from skysim.core.errors import InputError
from skysim.experiments.study import loader, plan
from skysim.experiments.study.plan import STUDIES

if TYPE_CHECKING:
    from skysim.apps.gui.page.page import Tab

POLL_S = 0.5
NAMED = {
    **{
        "identified": "identified",
        "wrong": "wrong",
        "refused": "refused",
        "cross_arcsec_rms": "cross rms, ″",
    },
    **{
        "roll_arcsec_rms": "roll rms, ″",
        "angle_arcsec_mean": "angle mean, ″",
        "time_ms_median": "ms a trial",
    },
}
KINDS = {"centroids": "centroids", "frames": "whole frames"}


class TrialPanel:
    """Panel that runs one study at a time."""

    def __init__(self, tab: Tab) -> None:
        self.tab, self.trials, self.runs = tab, Trials(Path()), 0
        self.failed: tuple[tuple[int, str], ...] = ()
        self.stopped = False
        with ui.row().classes("w-full no-wrap items-center gap-2"):
            self.what = ui.select({}, value=None).props('dense outlined options-dense aria-label="Study"')
            self.what.classes("flex-grow").mark("study").on_value_change(self.chosen)
            self.what.on("popup-hide", js_handler=keys.LEAVE)
            self.button = (
                ui.button("Start", on_click=self.start_or_stop)
                .props("dense outline size=sm")
                .mark("monte-carlo")
            )
        with ui.element("div").classes("lab-trial") as self.fields:
            self.count = (
                ui.number("runs, F8", value=200, min=1, max=100_000, precision=0)
                .props("dense outlined")
                .mark("runs")
            )
            self.kind = ui.select(KINDS, value="centroids", label="of").props("dense outlined options-dense")
            self.kind.on("popup-hide", js_handler=keys.LEAVE)
            self.noise = ui.number("noise, px", value=0.1, min=0, max=10, step=0.05).props("dense outlined")
            self.false = ui.number("false", value=0, min=0, max=100, precision=0).props("dense outlined")
            self.field = ui.number("field, °", min=1, max=90).props("dense outlined").mark("field")
            self.field.on("keydown.enter", self.refield)
        self.bar = ui.linear_progress(0, show_value=False, size="3px").props("instant-feedback")
        self.note = ui.label("Nothing run yet: press 2.").classes("quiet").style("margin-top: 6px")
        self.note.mark("trials-note")
        self.chart = ui.echart(options()).classes("w-full").style("height: 190px").mark("histogram")
        self.table = ui.element("div").classes("mono w-full").mark("figures")
        self.failures = ui.column().classes("w-full gap-1")
        ui.separator().style("margin: 8px 0")
        ui.label("Finished studies").classes("quiet")
        self.reports = ui.column().classes("w-full gap-0")
        ui.timer(POLL_S, self.poll)
        self.list()

    def set(self) -> None:
        """Take over a new scene."""
        options = {"": f"Monte Carlo of {Path(self.tab.scene).stem}"}
        options |= {
            path.stem: f"{path.stem}: {plan.title_of(path)}" for path in sorted(STUDIES.glob("*.yaml"))
        }
        self.what.set_options(options, value=self.what.value or "")
        if self.tab.setting:
            self.field.set_value(round(self.tab.setting.field_deg, 3))

    def chosen(self) -> None:
        """Hide the Monte Carlo fields when a study file is chosen."""
        self.fields.set_visibility(not self.what.value)

    async def refield(self) -> None:
        """Change the field of view, by the focal length."""
        setting = self.tab.setting
        if setting and self.field.value:
            await self.tab.refield(float(self.field.value))

    async def start_or_stop(self) -> None:
        """Handle the button: start a study or stop the running one."""
        if self.trials.running:
            self.trials.stop()
            self.stopped = True
            self.note.set_text("stopping …")
            return
        await self.start()

    async def start(self) -> None:
        """Start the chosen study and wait for its end; resume it if its store exists."""
        if self.trials.running:
            return
        self.tab.say("")
        try:
            path = await run.io_bound(self.file)
            told = await run.io_bound(loader.load, path)
            if told.study.optimise is not None:
                raise InputError(f"{path.stem}: a search; allowed here: studies with a design")
        except InputError as error:
            self.tab.say(str(error))
            return
        self.trials = Trials(path.parent if not self.what.value else self.tab.out / path.stem)
        self.trials.total = told.trials
        self.bar.set_value(0)
        self.button.set_text("Stop")
        self.stopped = False
        self.note.set_text("starting …")
        self.tab.log(f"study {path.stem}: {told.trials} trials")
        there = (self.trials.folder / "study.sqlite").is_file()
        await self.trials.begin(path, "resume" if there else "run")
        fault = await self.trials.end()
        if self.tab.open_still:
            self.ended("" if self.stopped else fault)

    def file(self) -> Path:
        """Path of the study file: the chosen one, or a new Monte Carlo study; a stopped one if it is unchanged.

        Raises InputError for a wrong number of runs.
        """
        if self.what.value:
            return STUDIES / f"{self.what.value}.yaml"
        trial: dict[str, Any] = {"kind": self.kind.value}
        if self.kind.value == "centroids":
            trial |= {"noise_px": float(self.noise.value or 0), "false_lights": int(self.false.value or 0)}
        if not (self.count.value and 1 <= self.count.value <= 100_000):
            raise InputError("runs: allowed: 1 to 100000")
        told = self.tab.scene_path, self.tab.overrides, trial, int(self.count.value)
        # A stopped run with unchanged settings is resumed from its own file.
        before = self.trials.folder / "monte_carlo.yaml"
        if self.stopped and before.is_file() and before.read_text() == monte_carlo(*told, self.runs):
            return before
        self.runs += 1
        text = monte_carlo(*told, self.runs)
        folder = files.make_folder(self.tab.out / f"monte_carlo_{self.tab.id}_{self.runs}")
        files.write_text(folder / "monte_carlo.yaml", text)
        return folder / "monte_carlo.yaml"

    def ended(self, fault: str) -> None:
        """Display the final result of a study, or its error."""
        self.button.set_text("Start")
        told = self.trials.tally()
        if told:
            self.show(told)
        done = told.done if told else 0
        if fault:
            self.tab.say(fault)
        whole = done >= self.trials.total
        self.note.set_text(
            f"{done} of {self.trials.total} trials" + ("" if whole else ": stopped, Start goes on")
        )
        self.tab.log(f"study ended: {done} of {self.trials.total} trials")
        self.list()

    async def poll(self) -> None:
        """Read the store of a running study and display its results so far."""
        if self.trials.running:
            told = await run.io_bound(self.trials.tally)
            if told and self.trials.running:
                self.show(told)
                self.note.set_text(f"{told.done} of {self.trials.total} trials")

    def show(self, told: Tally) -> None:
        """Display statistics, histogram and failed trials."""
        self.bar.set_value(told.done / max(self.trials.total, 1))
        self.chart.options["xAxis"]["data"] = [digits(one) for one in told.bins]
        self.chart.options["series"][0]["data"] = list(told.counts)
        self.chart.options["title"]["text"] = "" if told.counts else "none solved: no error to count"
        self.chart.update()
        self.table.clear()
        with self.table:
            ui.label(f"{'':16s}{'value':>8s}   95 % interval").classes("mono quiet")
            lines = [f"{NAMED[name]:16s}{figure(*value)}" for name, value in told.figures.items()]
            ui.label("\n".join(lines)).classes("mono")
        if told.failed == self.failed:
            return
        self.failed = told.failed
        self.failures.clear()
        with self.failures:
            if told.failed:
                ui.label("Failed trials, the first of them").classes("quiet").style("margin-top: 8px")
            for number, why in told.failed:
                with ui.row().classes("items-center gap-2 no-wrap"):
                    ui.label(f"trial {number}: {why}").classes("mono warn ellipsis")
                    ui.button("replay", on_click=lambda number=number: self.replay(number)).props(
                        "dense flat size=sm"
                    )

    async def replay(self, number: int) -> None:
        """Repeat a failed trial and show its frame in the sensor view."""
        study = next(iter(self.trials.folder.glob("*.yaml")), STUDIES / f"{self.what.value}.yaml")
        self.tab.rest()
        photo = await self.tab.ask(
            "replay", str(study), str(self.trials.folder), number, doing=f"replaying trial {number} …"
        )
        if photo:
            self.tab.sensor.show_photo(photo)
            self.tab.attitude.show_photo(photo)
            self.tab.log(f"replayed trial {number}: {photo.answer.status}")

    def list(self) -> None:
        """List the reports of finished studies."""
        self.reports.clear()
        with self.reports:
            found = finished(self.tab.out)
            for folder in found[:12]:
                done = time.strftime("%d %b %H:%M", time.localtime((folder / "report.html").stat().st_mtime))
                with ui.row().classes("w-full no-wrap gap-3"):
                    ui.label(done).classes("mono quiet flex-none")
                    link = ui.link(named(folder), f"/report/{quote(folder.name)}", new_tab=True)
                    link.classes("ellipsis").props["title"] = folder.name
            if not found:
                ui.label("none yet").classes("quiet")


def named(folder: Path) -> str:
    """The study's title if its file is in the report's folder, else the folder's name."""
    file = next(iter(sorted(folder.glob("*.yaml"))), None)
    return (plan.title_of(file) if file else "") or folder.name


def figure(value: float, low: float, high: float) -> str:
    """Format a value with its interval."""
    if math.isnan(value):
        return "       –"
    told = f"{value:8.4g}"
    return told if math.isnan(low) or low == high else f"{told}   {low:.4g} .. {high:.4g}"


def options() -> dict[str, Any]:
    """ECharts options of the histogram of the error angle."""
    text = {"color": INK["quiet"], "fontSize": 10}
    return {
        "animation": False,
        "title": {
            **{"text": "the errors of trials come here", "left": "center", "top": "middle"},
            "textStyle": text | {"fontWeight": "normal", "fontSize": 11},
        },
        "grid": {"left": 42, "right": 10, "top": 22, "bottom": 36},
        "xAxis": {
            "type": "category",
            "data": [],
            "axisLabel": text,
            "name": "angle of error, ″",
            "nameLocation": "middle",
            "nameGap": 24,
            "nameTextStyle": text,
        },
        "yAxis": {
            "type": "value",
            "axisLabel": text,
            "splitLine": {"lineStyle": {"color": INK["line"]}},
            "name": "trials",
            "nameTextStyle": text,
        },
        "tooltip": TOOLTIP,
        "series": [
            {"type": "bar", "data": [], "barCategoryGap": "8%", "itemStyle": {"color": INK["accent"]}}
        ],
    }
