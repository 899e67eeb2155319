"""Check panel: the scene's check, and ambiguous fields of the dome; Survey panel: attitudes that can be flown."""

import math
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from nicegui import ui
from scipy.spatial.transform import Rotation

from skysim.apps.gui.messages import AmbiguityMap, SurveyFound, SurveyPlan, Triple
from skysim.apps.gui.page.run_panel import RunPanel
from skysim.apps.gui.views import context, forms, space, style, widgets
from skysim.core.types import Floats, Ints
from skysim.core.yaml_reader import yaml_line
from skysim.dynamics import guidance, multibody
from skysim.experiments.dome_survey import survey_frames
from skysim.scene.sections.motion import PRESCRIBED

if TYPE_CHECKING:
    from skysim.simulation.checks.plan_check import Check

# Frame rate and holds of a survey flight: few frames while the vehicle slews, and a whole exposure in each hold.
SURVEY_RATE_HZ = 0.1
HOLD_PERIODS = 2.0
TILT_MARGIN_DEG = 0.5  # least distance of the tilt from the vehicle's stop
TILT_STEPS = 61  # number of points of a slew at which its tilt is computed
FRAMES = 20  # initial number of frames of a survey
ALIKE = 0.9  # fraction of coinciding LEDs from which a tracker without a prior refuses a field as ambiguous
UNCHECKED = "Check computes what this scene will show and how accurate its tracker will be. Nothing is rendered."
UNMAPPED = "Map compares the fields of the dome with one another: a field that looks like another one is ambiguous."
COVERAGE = "Coverage"
COLORED = "In the 3-D view the LEDs are the brighter the better they are measured."
UNPLANNED = (
    "Plan begins a survey: it chooses the attitudes from which the dome's LEDs are measured best. Fly takes frames at"
    " them. Adjust adds these to the survey's frames, measures the LEDs by all of them, and plans the next attitudes."
)


class CoverageMap(ui.element, component="js/coverage.js"):  # type: ignore[call-arg]
    """What the tracker makes of frames at many attitudes, implemented in coverage.js."""


class CheckPanel:
    """Panel with three parts, each computed on request and emptied when the scene changes.

    Attributes
    ----------
    covering
        Token of the map of coverage that is being computed; None if there is none
    angles_deg
        Attitudes of this map
    """

    covering: object | None = None
    angles_deg: Sequence[Triple] = ()

    def __init__(self, page: context.PageContext, scene_3d: space.Scene3D) -> None:
        self.page = page
        self.scene_3d = scene_3d
        with widgets.row():
            widgets.button("Check", self.check)
        self.facts = ui.column().classes("w-full gap-1")
        with widgets.row().style("margin-top: 8px"):
            widgets.button("Map", self.map)
        self.fields = ui.column().classes("w-full gap-1")
        with widgets.row().style("margin-top: 8px"):
            self.cover_button = widgets.button(COVERAGE, self.cover)
        self.coverage = CoverageMap().on("point", self.point)
        self.empty()
        page.derive(lambda view: view.opened, self.empty)

    def empty(self) -> None:
        """Show what each part does."""
        for column, text in ((self.facts, UNCHECKED), (self.fields, UNMAPPED)):
            column.clear()
            with column:
                widgets.quiet(text)
        self.stop()
        self.coverage.run_method("begin", [], False)

    def stop(self) -> None:
        """Compute no further attitude of the map of coverage."""
        self.covering = None
        self.cover_button.set_text(COVERAGE)

    async def cover(self) -> None:
        """Solve a frame at each attitude in reach, or stop that. Keys are served between two frames."""
        if self.covering:
            self.stop()
            return
        own = self.covering = object()
        self.cover_button.set_text("Stop")
        reach = await self.page.ask("reach")
        info = self.page.scene_info
        if self.covering is not own or info is None:
            return
        self.angles_deg, boresights = reach or ([], [])
        self.coverage.run_method("begin", boresights, info.scene.stars is not None)
        for angles_deg in self.angles_deg:
            found = await self.page.ask("cover", angles_deg)
            if found is None or self.covering is not own:
                break
            lights, row = found
            counts = lights, row.detected, row.matched
            self.coverage.run_method("add", angles_deg, *counts, row.status, row.wrong)
        if self.covering is own:
            self.stop()

    async def point(self, event: Any) -> None:
        """Show the frame at an attitude of the map."""
        self.page.stop_playback()
        await self.page.show_live("point", self.angles_deg[int(event.args)])

    async def check(self) -> None:
        found: Check | None = await self.page.run_task(
            "check", activity="checking the scene …"
        )
        if found is None:
            return
        self.facts.clear()
        with self.facts:
            for finding in found.findings:
                ui.label(finding).classes("warn").style("overflow-wrap: anywhere")
            if not found.findings:
                ui.label("No warnings.").classes("good")
            with widgets.div("lab-facts"):
                for fact in found.facts:
                    widgets.quiet(fact.name)
                    ui.label("\n".join(fact.lines)).style(
                        "white-space: pre-line; overflow-wrap: anywhere"
                    )

    async def map(self) -> None:
        found: AmbiguityMap | None = await self.page.run_task(
            "ambiguity", activity="comparing the fields …"
        )
        if found is None:
            return
        self.fields.clear()
        with self.fields:
            ui.label(ambiguity_text(found))
            with ui.row().classes("no-wrap items-center gap-2") as legend:
                widgets.quiet(f"{100 * found.least:.0f} % or less")
                scale = 255 * style.color_scale(np.linspace(0, 1, 8))
                colors = ", ".join(f"rgb({r:.0f} {g:.0f} {b:.0f})" for r, g, b in scale)
                ui.element("div").style(
                    f"width: 120px; height: 10px; background: linear-gradient(90deg, {colors})"
                )
                widgets.quiet("100 % of the LEDs coincide; drawn in the 3-D view")
        share = (found.fraction - found.least) / (1 - found.least)
        self.scene_3d.color_lights(found.ids, share, legend)


class SurveyPanel:
    """Panel of a survey, which is continued when its scene is opened again.

    Attributes
    ----------
    scene_3d
        3-D view, in which LEDs are colored
    run_panel
        Panel that flies the survey
    taken
        Number of frames of the survey that have been adjusted
    progress
        Text on the flight that is computed
    colored
        LEDs of the survey, and how well each is known
    legend
        Meaning of the LED colors in the 3-D view
    """

    def __init__(
        self, page: context.PageContext, scene_3d: space.Scene3D, run_panel: RunPanel
    ) -> None:
        self.page = page
        self.scene_3d = scene_3d
        self.run_panel = run_panel
        with widgets.row():
            self.begin = self.button("Plan", self.plan_survey, "begin a new survey")
            self.frames = widgets.number(value=FRAMES, min=2, step=1, label="frames").classes(
                "w-24"
            )
            self.fly = self.button("Fly", self.fly_plan, "fly the vehicle to these attitudes")
            self.adjust_button = self.button(
                "Adjust",
                self.adjust,
                "adjust LEDs, lever and lens to the frames of the last flight and those before",
            )
            self.save_map = self.button(
                "Map file", self.download_map, "save the LEDs for tracker.map"
            )
        self.stops = ui.column().classes("w-full gap-1")
        self.set_scene()
        page.derive(lambda view: view.opened, self.set_scene)

    def button(self, label: str, action: Callable[[], Any], title: str) -> ui.button:
        return widgets.button(label, action).props(f'title="{title}"').classes("flex-none")

    def set_scene(self) -> None:
        """Continue the survey of a scene that is opened again; forget that of another one."""
        info = self.page.scene_info
        if info and info.surveyed:
            self.color()
        else:
            self.clear_survey()

    def color(self) -> None:
        """Color the LEDs of the 3-D view by how well each is known, if that is determined."""
        if self.colored:
            self.scene_3d.color_lights(*self.colored, self.legend)

    def clear_survey(self) -> None:
        """Discard the survey, and show what a survey does."""
        self.plan: SurveyPlan | None = None
        self.colored: tuple[Ints, Floats] | None = None
        self.taken = 0
        self.enable()
        self.save_map.set_enabled(False)
        self.stops.clear()
        with self.stops:
            widgets.quiet(UNPLANNED)

    def enable(self) -> None:
        """Enable the buttons of a planned survey."""
        self.begin.set_enabled(True)
        for button in (self.fly, self.adjust_button):
            button.set_enabled(self.plan is not None)

    @contextmanager
    def working(self) -> Iterator[None]:
        """Context in which no second step of the survey can begin."""
        for button in (self.begin, self.fly, self.adjust_button):
            button.set_enabled(False)
        try:
            yield
        finally:
            if self.page.is_open:
                self.enable()

    async def plan_survey(self) -> None:
        """Begin a new survey: plan its first attitudes."""
        with self.working():
            if self.taken and not await self.confirmed():
                return
            found: SurveyPlan | None = await self.page.run_task(
                "plan_survey", int(self.frames.value or 0), activity="planning the survey …"
            )
            if found is not None:
                self.clear_survey()
                self.show_survey([prediction_text(found)], found)

    async def confirmed(self) -> bool:
        """Ask the user to confirm that a new survey loses the frames of this one."""
        with ui.dialog() as dialog, ui.card():
            ui.label(f"A new survey forgets the {self.taken} frames of this one.")
            with ui.row():
                widgets.button("Begin anew", partial(dialog.submit, True))
                widgets.button("Cancel", partial(dialog.submit, False), look="flat")
        answer = await dialog
        if not dialog.is_deleted:
            dialog.delete()
        return bool(answer)

    async def adjust(self) -> None:
        """Adjust the dome to the frames flown; show the results and the attitudes to hold next."""
        with self.working():
            found: SurveyFound | None = await self.page.run_task(
                "adjust_survey",
                int(self.frames.value or 0),
                activity="adjusting the survey …",
            )
            if found is None:
                return
            self.taken = found.statistics["frames"]
            lines = survey_lines(found)
            self.show_survey([*lines, prediction_text(found.plan)], found.plan)
            self.page.log(f"survey of {Path(self.page.state.scene).name}: {lines[0]}")
            if not found.statistics["refusal"]:
                self.save_map.set_enabled(True)
                self.colored = found.ids, found.known
            self.color()

    def show_survey(self, lines: Sequence[str], plan: SurveyPlan) -> None:
        """Show the findings of a survey and its next attitudes, which can then be flown."""
        self.plan = plan
        self.stops.clear()
        with self.stops:
            for line in lines:
                ui.label(line).style("overflow-wrap: anywhere")
            self.progress = ui.label().bind_text_from(self.run_panel.summary, "text")
            self.progress.set_visibility(False)
            self.legend = ui.label(COLORED)
            self.legend.set_visibility(False)
            with widgets.div("lab-stops mono"):
                for head in ("", "roll °", "pitch °", "yaw °", "LEDs"):
                    ui.label(head).classes("quiet num")
                for number, (angles, leds) in enumerate(
                    zip(plan.angles_deg, plan.shown, strict=True), 1
                ):
                    button = widgets.button(
                        str(number), partial(self.point, number - 1), look="flat"
                    )
                    button.props(f'aria-label="Point to attitude {number}"')
                    for text in (*(f"{angle:.2f}" for angle in angles), str(leds)):
                        ui.label(text).classes("num")

    async def point(self, number: int) -> None:
        """Show the frame at an attitude of the plan."""
        assert self.plan is not None
        self.page.stop_playback()
        await self.page.show_live("point", self.plan.angles_deg[number])

    async def fly_plan(self) -> None:
        """Change the scene's maneuver to the plan's attitudes, in order, and compute this flight."""
        assert self.plan is not None
        scene = self.page.state.scene
        with self.working():
            overrides = await self.page.run_here(
                survey_flight, *self.page.state.opened, self.plan.angles_deg
            )
            if overrides and self.page.is_open and await self.page.open(scene, overrides):
                self.progress.set_visibility(True)
                await self.run_panel.simulate()

    async def download_map(self) -> None:
        data: bytes | None = await self.page.run_task("survey_map")
        if data is not None:
            ui.download(data, f"{Path(self.page.state.scene).stem}_leds.ecsv")


def ambiguity_text(found: AmbiguityMap) -> str:
    """The number of fields that look like another one, and the most similar pair."""
    count = int(np.sum(found.fraction >= ALIKE))
    most = int(np.argmax(found.fraction))
    return (
        f"{count} of {len(found.ids)} fields look like another one: {100 * ALIKE:.0f} % of the LEDs or more coincide"
        f" within {found.coincidence_mm:.2g} mm. Most alike: the fields about LED {found.ids[most]} and"
        f" {found.others[most]}, {100 * found.fraction[most]:.0f} %"
        + (" or less." if found.fraction[most] <= found.least else ".")
    )


def prediction_text(plan: SurveyPlan) -> str:
    """The predicted accuracy of a survey with the attitudes of its plan."""
    steps = [
        f"after {frames} frames {measured} LEDs to {mm:.2g} mm rms"
        for frames, measured, mm in plan.steps
        if mm
    ]
    return f"Predicted of the {plan.leds} LEDs: {'; '.join(steps) or 'none measured, the frames are too few'}."


def survey_lines(found: SurveyFound) -> list[str]:
    """The results of a survey's frames, and the faults of the dome."""
    of = found.statistics
    missed = []
    if of["missed"]:
        missed = [f"{of['missed']} attitudes have no frame: the vehicle did not rest there."]
    unmeasured = f"{of['seen_once']} seen once, {of['unseen']} not seen"
    if of["refusal"]:
        return [
            f"{of['frames']} frames: no LED measured; {unmeasured}.",
            *missed,
            f"Not determined yet: {of['refusal']}.",
        ]
    renamed = f"; {of['renamed']} have the number of another one" if of["renamed"] else ""
    return [
        f"{of['frames']} frames, {of['connected']} of them connected: {of['measured']} of {of['leds']} LEDs measured"
        f" to {of['sigma_mm']:.2g} mm rms about each axis (1σ), {unmeasured} in the connected ones. Their true error is"
        f" {of['led_mm_after']:.2g} mm, {of['led_mm_before']:.2g} mm before{renamed}.",
        *missed,
        *found.faults,
    ]


def survey_flight(
    scene: str, overrides: Mapping[str, str], angles_deg: Sequence[Sequence[float]]
) -> dict[str, str]:
    """Overrides with which the vehicle slews to each attitude and holds it, with frames over the whole time.

    An exposure is no longer than the frame period, so a hold of two periods contains a whole exposure. Between two
    tilted attitudes the vehicle may tilt more than at either; if this exceeds the limit, it is leveled in between.
    Raises InputError.
    """
    # Without maneuvers, which may not begin with a profile that the start refers to.
    before = forms.validated_scene(scene, {**overrides, "motion.maneuver": "[]"})
    rate_hz = min(SURVEY_RATE_HZ, before.exposure.rate_hz)
    legs: list[dict[str, object]] = []
    at = guidance.start_attitude(before.motion, ())
    for angles in angles_deg:
        attitude = survey_frames.from_angles(np.array([angles]))[0]
        if greatest_tilt_deg(at, attitude) > before.vehicle.tilt_stop_deg - TILT_MARGIN_DEG:
            yaw_deg = float(at.as_euler("ZYX", degrees=True)[0])
            legs += [slew((0.0, 0.0, yaw_deg)), slew((0.0, 0.0, angles[2]))]
        legs += [slew(angles), {"kind": "hold", "duration": f"{HOLD_PERIODS / rate_hz:g} s"}]
        at = attitude
    flown = {
        **overrides,
        "motion.maneuver": yaml_line(legs),
        "exposure.rate_hz": f"{rate_hz:g}",
        "exposure.first": "0 s",
    }
    if before.motion.control is None:
        flown["motion.control"] = PRESCRIBED
    duration_s = guidance.plan(forms.validated_scene(scene, flown).motion).duration_s
    return {**flown, "exposure.frames": str(max(math.floor(duration_s * rate_hz), 1))}


def slew(angles_deg: Sequence[float]) -> dict[str, object]:
    """A slew to roll, pitch and yaw, as a maneuver of a scene."""
    names = "roll_deg", "pitch_deg", "yaw_deg"
    return {
        "kind": "slew",
        **{name: round(angle, 3) for name, angle in zip(names, angles_deg, strict=True)},
    }


def greatest_tilt_deg(first: Rotation, last: Rotation) -> float:
    """Greatest tilt of the vehicle between two attitudes lab_from_body, along the rotation about one axis."""
    share = np.linspace(0, 1, TILT_STEPS)[:, None]
    turn = Rotation.from_rotvec(share * (first.inv() * last).as_rotvec())
    return float(multibody.tilt_deg(first * turn).max())
