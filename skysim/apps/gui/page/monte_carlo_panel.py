"""Monte Carlo panel: start and stop studies, show statistics and histogram while they run, replay failed trials."""

import math
import signal
import time
from contextlib import suppress
from functools import partial
from pathlib import Path
from urllib.parse import quote

from nicegui import run, ui
from pydantic import ValidationError

from skysim.apps.gui.views import context, forms, keys, style, widgets
from skysim.apps.gui.worker.study_process import (
    NO_RESULTS,
    PAGE_STUDY,
    RESPONSES,
    StudyProcess,
    StudyResults,
    finished,
    is_shown,
    monte_carlo,
)
from skysim.core import files
from skysim.core.errors import InputError
from skysim.core.paths import STUDIES, shipped_files, title_of
from skysim.core.types import Record
from skysim.experiments.study import study_file as loader
from skysim.experiments.study import unused_options
from skysim.experiments.study.execution.store import STORE
from skysim.experiments.study.plan import Plan, TrialSection
from skysim.scene.loader import load

POLL_S = 0.5
NO_STUDY = "No study of this scene has been run yet: press 2."
MODEL = "A trial of centroids takes stars of the catalog with random errors."
TRIAL_KINDS = {"centroids": "centroids", "frames": "rendered frames"}


class MonteCarloPanel:
    """Panel that runs one study at a time.

    Attributes
    ----------
    process
        Process of the study
    run_number
        Number of the tab's last Monte Carlo study
    failed
        Trials that the page lists, as in `StudyResults`
    stopped
        Whether the study was stopped and can be continued
    starting
        Whether its process is being started
    """

    run_number = 0
    stopped = False
    starting = False

    def __init__(self, page: context.PageContext) -> None:
        self.page = page
        self.process = StudyProcess(Path())
        self.failed: tuple[tuple[int, str], ...] = ()
        with widgets.row():
            self.study_select = (
                widgets.select({}).props('aria-label="Study"').classes("flex-grow")
            )
            self.study_select.on_value_change(self.study_chosen)
            self.button = widgets.button("Start", self.start_or_stop)
            self.report = widgets.button("Report", self.open_report)
        with widgets.div("lab-trial") as self.fields:
            self.count = widgets.number(
                "runs, F8", value=200, min=1, max=100_000, precision=0
            )
            self.kind = widgets.select(TRIAL_KINDS, value="centroids", label="of")
            self.kind.tooltip(MODEL)
            self.noise = widgets.number("noise, px", value=0.1, min=0, max=10, step=0.05)
            self.noise.on_value_change(self.show_noise)
            self.magnitude = widgets.number("noise, mag", value=0.25, min=0, max=5, step=0.05)
            self.false_lights = widgets.number("false", value=0, min=0, max=100, precision=0)
            self.field = widgets.number("field, °", min=1, max=90)
            self.field.on("keydown.enter", self.set_field_of_view)
        with widgets.row(3) as self.model:
            self.with_noise = widgets.checkbox("with noise", value=True)
            self.arcsec = widgets.number("noise, ″ an axis", min=0, step=1)
            self.arcsec.on("blur", self.angle_typed).on("keydown.enter", self.angle_typed)
        self.bar = ui.linear_progress(0, show_value=False, size="3px").props(
            "instant-feedback"
        )
        self.note = widgets.quiet(NO_STUDY).style("margin-top: 6px")
        self.chart = ui.echart(options()).classes("w-full").style("height: 190px")
        self.table = widgets.div("mono w-full")
        self.failures = ui.column().classes("w-full gap-1")
        ui.separator().style("margin: 8px 0")
        widgets.quiet("Finished studies")
        self.reports = ui.column().classes("w-full gap-0")
        self.list_reports()
        page.derive(lambda view: view.study, self.empty)

    def empty(self) -> None:
        self.show(NO_RESULTS)
        self.note.set_text(NO_STUDY)
        self.report.set_enabled(False)

    def open_report(self) -> None:
        ui.navigate.to(f"/report/{quote(self.process.folder.name)}", new_tab=True)

    @property
    def running(self) -> str:
        """Folder of the study that is running, "" if none is."""
        return self.process.folder.name if self.process.running else ""

    def set_scene(self) -> None:
        options = {"": f"Monte Carlo of {Path(self.page.state.scene).stem}"}
        options |= {
            name: f"{name}: {title_of(path)}" for name, path in shipped_files(STUDIES).items()
        }
        self.study_select.set_options(options, value=self.study_select.value or "")
        info = self.page.scene_info
        if info:
            self.field.set_value(round(info.field_deg, 3))
        self.show_noise()

    @property
    def noise_arcsec(self) -> float:
        """The centroids' noise as an angle in the middle of the frame."""
        info = self.page.scene_info
        pixel_arcsec = info.pixel_arcsec if info else 0.0
        return float(f"{float(self.noise.value or 0) * pixel_arcsec:.4g}")

    def show_noise(self) -> None:
        self.arcsec.set_value(self.noise_arcsec)

    def angle_typed(self) -> None:
        """Set the noise from a typed angle."""
        info = self.page.scene_info
        if info and self.arcsec.value != self.noise_arcsec:
            noise_px = float(self.arcsec.value or 0) / info.pixel_arcsec
            self.noise.set_value(float(f"{noise_px:.4g}"))

    def study_chosen(self) -> None:
        """Hide the Monte Carlo fields when a study file is chosen, and the results of the study before."""
        self.page.set_state(study=self.running)
        for item in (self.fields, self.model):
            item.set_visibility(not self.study_select.value)

    async def set_field_of_view(self) -> None:
        """Change the scene's field of view by the focal length."""
        field_deg = float(self.field.value or 0)
        change = await self.page.run_here(
            forms.field_override, *self.page.state.opened, field_deg
        )
        if change is not None:
            await self.page.apply_overrides(change)

    def focus(self) -> None:
        """Give the number of runs the keyboard focus."""
        keys.focus(self.count)

    def close(self) -> None:
        """End the study with the page; its trials so far are kept."""
        self.process.stop(signal.SIGTERM)

    async def start_or_stop(self) -> None:
        if not self.process.running:
            await self.start()
            return
        self.process.stop()
        self.stopped = True
        self.note.set_text("stopping …")

    async def start(self) -> None:
        """Start the chosen study and wait for its end; resume it if its store exists. Only one runs at a time."""
        if self.starting or self.process.running:
            return
        self.starting = True
        try:
            started = await self.start_process()
        finally:
            self.starting = False
        if not started:
            return
        fault = await self.process.wait()
        if not self.page.is_open:
            return
        self.button.set_text("Start")
        if fault and not self.stopped:
            self.page.show_message(fault)
        done = await self.show_results()
        self.page.log(f"study ended: {done} of {self.process.total} trials")
        self.list_reports()

    async def start_process(self) -> bool:
        """Start the process of the chosen study; return whether it has started."""
        self.page.show_message("")
        found = await self.page.run_here(self.load_study)
        if found is None:
            return False
        path, study = found
        self.process = StudyProcess(
            self.page.out / path.stem if self.study_select.value else path.parent
        )
        self.process.total = study.trials
        self.page.set_state(study=self.process.folder.name)
        self.button.set_text("Stop")
        self.stopped = False
        self.note.set_text("starting …")
        self.page.log(f"study {path.stem}: {study.trials} trials")
        unused = self.page.state.overrides.keys() - study.spec.base.keys()
        if unused and not self.study_select.value:
            self.page.show_message(
                f"trials of {self.kind.value} do not use {', '.join(sorted(unused))}", "quiet"
            )
        await self.process.start(path)
        if not self.page.is_open:  # the page was closed before there was a process to end
            self.process.stop(signal.SIGTERM)
        return True

    def load_study(self) -> tuple[Path, Plan]:
        """The file of the study to start, and its plan. Raises InputError if it cannot be started."""
        StudyProcess.check_count()
        path = self.study_file()
        study = loader.load(path)
        if study.study.optimize is not None:
            raise InputError(path.stem, "has the key optimize", "studies with a design")
        return path, study

    def study_file(self) -> Path:
        """Path of the study file: the chosen one, a stopped study with unchanged settings, or a new Monte Carlo study.

        Raises
        ------
        InputError
            For a wrong number of runs.
        """
        if self.study_select.value:
            return STUDIES / f"{self.study_select.value}.yaml"
        trial: Record = {"kind": self.kind.value}
        if self.kind.value == "centroids":
            noise = {"noise_px": self.noise, "magnitude_sigma": self.magnitude}
            trial |= {
                name: float(field.value or 0) * bool(self.with_noise.value)
                for name, field in noise.items()
            }
            trial |= {"false_lights": int(self.false_lights.value or 0)}
        if not 1 <= (self.count.value or 0) <= 100_000:
            raise InputError("runs", "", "1 to 100000")
        scene = forms.absolute_path(self.page.state.scene)
        # A study with changes of the scene that have no effect on a trial would be refused.
        overrides = dict(self.page.state.overrides)
        with suppress(ValidationError):  # the study's loader reports it in one line
            section = TrialSection.model_validate({"trial": trial})
            for key in unused_options.unused_overrides(
                overrides, load(scene, overrides), section.trial
            ):
                del overrides[key]
        settings = scene, overrides, trial, int(self.count.value)
        # A stopped run with unchanged settings is resumed from its own file.
        before = self.process.folder / "monte_carlo.yaml"
        if (
            self.stopped
            and before.is_file()
            and before.read_text() == monte_carlo(*settings, self.run_number)
        ):
            return before
        self.run_number += 1
        folder = files.make_folder(
            # Browser and tab, so that each has studies of its own.
            self.page.out / f"{PAGE_STUDY}{self.page.user}_{self.page.id}_{self.run_number}"
        )
        path = folder / "monte_carlo.yaml"
        files.write_text(path, monte_carlo(*settings, self.run_number))
        return path

    async def show_study(self, name: str) -> None:
        """Show the results of a study of the page's folder, as after a reload; a stopped one can be continued."""
        if self.process.running or self.starting:
            return
        folder = self.page.out / name
        is_here = name and folder.parent == self.page.out and is_shown(name, self.page.user)
        found = await run.io_bound(stored_study, folder) if is_here else None
        if found is None:
            if name:
                self.page.show_message(f"study {name!r} is not in the folder of this page")
            self.page.set_state(study="")
            return
        self.process = StudyProcess(folder)
        self.process.total = found.trials
        self.stopped = True
        self.study_select.set_value(name if (STUDIES / f"{name}.yaml").is_file() else "")
        if not self.study_select.value:
            self.set_fields(name, found)
        self.page.set_state(study=name)
        await self.show_results()

    def set_fields(self, name: str, study: Plan) -> None:
        """Fill in the fields with the settings of a Monte Carlo study of this page, so that Start continues it."""
        number = name.rpartition("_")[2]
        trial = study.spec.trial
        self.run_number = int(number) if number.isdigit() else 0
        self.count.set_value(study.trials)
        self.kind.set_value(trial["kind"])
        noise_px = trial.get("noise_px")
        magnitude_sigma = trial.get("magnitude_sigma")
        self.with_noise.set_value(noise_px != 0 or magnitude_sigma != 0)
        if self.with_noise.value and noise_px is not None:
            self.noise.set_value(noise_px)
            self.magnitude.set_value(magnitude_sigma)
        self.false_lights.set_value(trial.get("false_lights", self.false_lights.value))

    async def poll(self) -> None:
        """Timer, every POLL_S: show the results of a running study so far."""
        if self.process.running:
            await self.show_results()

    async def show_results(self) -> int:
        """Read the study's store, and show its results and how to continue it; return the number of its trials."""
        process = self.process
        was_running = process.running
        results = await run.io_bound(process.results) or NO_RESULTS
        # Not if the page is on another study by now, or if this was not its end.
        if self.page.state.study == process.folder.name and was_running == process.running:
            self.show(results)
            is_done = results.done >= process.total
            rest = "" if is_done or was_running else "; stopped, Start continues"
            self.note.set_text(f"{results.done} of {process.total} trials{rest}")
            self.report.set_enabled(is_done and not was_running)
        return results.done

    def show(self, results: StudyResults) -> None:
        self.bar.set_value(results.done / max(self.process.total, 1))
        self.chart.options["xAxis"]["data"] = [
            widgets.format_number(center) for center in results.bins
        ]
        self.chart.options["series"][0]["data"] = list(results.counts)
        empty = "no trial solved" if results.done else "no trials yet"
        self.chart.options["title"]["text"] = "" if results.counts else empty
        self.chart.update()
        self.table.clear()
        with self.table:
            ui.label(f"{'':16s}{'value':>8s}   95 % interval").classes("mono quiet")
            lines = [
                f"{RESPONSES[name]:16s}{format_interval(*value)}"
                for name, value in results.statistics.items()
            ]
            ui.label("\n".join(lines)).classes("mono")
        if results.failed == self.failed:
            return
        self.failed = results.failed
        self.failures.clear()
        with self.failures:
            if results.failed:
                widgets.quiet("Failed trials, the first of them").style("margin-top: 8px")
            for number, reason in results.failed:
                with ui.row().classes("items-center gap-2 no-wrap"):
                    ui.label(f"trial {number}: {reason}").classes("mono warn ellipsis")
                    widgets.button("replay", partial(self.replay, number), look="flat")

    async def replay(self, number: int) -> None:
        """Repeat a failed trial and show its frame in the sensor view."""
        shipped = STUDIES / f"{self.study_select.value}.yaml"
        study = min(self.process.folder.glob("*.yaml"), default=shipped)
        self.page.stop_playback()
        photo = await self.page.run_task(
            "replay",
            str(study),
            str(self.process.folder),
            number,
            activity=f"replaying trial {number} …",
        )
        if photo:
            self.page.show_photo(
                photo, kind="replay", study=self.process.folder.name, trial=number
            )
            self.page.log(f"replayed trial {number}: {photo.result.row.status}")

    def list_reports(self) -> None:
        self.reports.clear()
        with self.reports:
            folders = finished(self.page.out, self.page.user)
            for folder in folders[:12]:
                done = time.strftime(
                    "%d %b %H:%M", time.localtime((folder / "report.html").stat().st_mtime)
                )
                # The study's title if its file is in the report's folder, else the folder's name.
                file = min(folder.glob("*.yaml"), default=None)
                title = (title_of(file) if file else "") or folder.name
                with ui.row().classes("w-full no-wrap gap-3"):
                    ui.label(done).classes("mono quiet flex-none")
                    link = ui.link(title, f"/report/{quote(folder.name)}", new_tab=True)
                    link.classes("ellipsis").props["title"] = folder.name
            if not folders:
                widgets.quiet("none yet")


def stored_study(folder: Path) -> Plan | None:
    """The plan of a study with a store in the folder; None if there is none."""
    try:
        shipped = shipped_files(STUDIES).get(folder.name, folder)
        file = min(folder.glob("*.yaml"), default=shipped)
        return loader.load(file) if (folder / STORE).is_file() else None
    except (InputError, ValueError, OSError):  # a name with a null byte, or too long
        return None


def format_interval(value: float, low: float, high: float) -> str:
    if math.isnan(value):
        return "       –"
    text = f"{value:8.4g}"
    return text if math.isnan(low) or low == high else f"{text}   {low:.4g} .. {high:.4g}"


def options() -> Record:
    """ECharts options of the histogram of the error angle."""
    text = {":color": style.chart_color("quiet"), "fontSize": 10}
    title = {"text": "no trials yet", "left": "center", "top": "middle"}
    axis = {"axisLabel": text, "nameTextStyle": text}
    x_name = {"name": "error angle, ″", "nameLocation": "middle", "nameGap": 24}
    return {
        "animation": False,
        "title": title | {"textStyle": text | {"fontWeight": "normal", "fontSize": 11}},
        "grid": {"left": 42, "right": 10, "top": 22, "bottom": 36},
        "xAxis": axis | x_name | {"type": "category", "data": []},
        "yAxis": axis | {"name": "trials", "type": "value", "splitLine": style.RULE},
        "tooltip": style.TOOLTIP,
        "series": [
            {
                "type": "bar",
                "data": [],
                "barCategoryGap": "8%",
                "itemStyle": {"color": style.CURVE_COLORS[0]},
            }
        ],
    }
