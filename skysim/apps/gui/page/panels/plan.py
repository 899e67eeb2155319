"""Plan panel: the scene's check, ambiguous fields on the dome, and attitudes of a survey, which can be flown."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from nicegui import run, ui

from skysim.apps.gui.messages import AmbiguityMap, PlanCheck, SurveyFound, SurveyPlan
from skysim.apps.gui.page import forms
from skysim.apps.gui.page.style import color_scale
from skysim.dynamics import guidance
from skysim.scene.sections.motion import PRESCRIBED

if TYPE_CHECKING:
    from skysim.apps.gui.page.page import Tab

# Of a survey that is flown: few frames while the vehicle slews, and a whole exposure in each hold.
SURVEY_RATE_HZ, HOLD_PERIODS = 0.5, 2.0
FRAMES = 20  # of a survey, at first
ALIKE = 0.9  # of the LEDs that coincide: a tracker without a prior refuses the field as ambiguous
UNCHECKED = "Check computes what this scene will show and how accurate its tracker will be. Nothing is rendered."
UNMAPPED = "Map compares the fields of the dome with one another: a field that looks like another one is ambiguous."
UNPLANNED = (
    "Plan chooses the attitudes from which a survey measures the dome's LEDs best. Fly takes frames at them, Adjust"
    " measures the LEDs by all frames flown so far and plans the next attitudes."
)


class PlanPanel:
    """Panel with three parts, each computed at a button's press and cleared when the scene changes."""

    def __init__(self, tab: Tab) -> None:
        self.tab = tab
        self.plan: SurveyPlan | None = None
        self.lines: Sequence[str] = ()
        with self.part():
            ui.button("Check", on_click=self.check).props("dense outline size=sm").mark("check")
        self.facts = ui.column().classes("w-full gap-1").mark("check-result")
        with self.part():
            ui.button("Map", on_click=self.map).props("dense outline size=sm").mark("map")
        self.fields = ui.column().classes("w-full gap-1").mark("map-result")
        with self.part():
            ui.button("Plan", on_click=self.plan_survey).props("dense outline size=sm").mark("survey")
            self.frames = ui.number(value=FRAMES, min=2, step=1, label="frames").props("dense outlined").classes("w-24")
            self.fly = self.survey_button("Fly", self.fly_plan, "fly the vehicle to these attitudes")
            self.adjust_button = self.survey_button("Adjust", self.adjust, "adjust LEDs, lever and lens to all frames")
            self.save_map = self.survey_button("Map file", self.download_map, "save the LEDs for tracker.map")
        self.stops = ui.column().classes("w-full gap-1").mark("survey-result")
        self.clear()

    def part(self) -> ui.row:
        return ui.row().classes("w-full no-wrap items-center gap-2").style("margin-top: 8px")

    def survey_button(self, label: str, action: Callable[[], Any], title: str) -> ui.button:
        button = ui.button(label, on_click=action).props(f'dense outline size=sm title="{title}"')
        return button.classes("flex-none")

    def clear(self) -> None:
        """Say what each part does, because nothing is known of this scene yet."""
        self.plan, self.lines = None, ()
        for button in (self.fly, self.adjust_button, self.save_map):
            button.set_enabled(False)
        for column, text in ((self.facts, UNCHECKED), (self.fields, UNMAPPED), (self.stops, UNPLANNED)):
            column.clear()
            with column:
                ui.label(text).classes("quiet")

    # The check.

    async def check(self) -> None:
        found: PlanCheck | None = await self.tab.run_task("check", activity="checking the scene …")
        if found is None:
            return
        self.facts.clear()
        with self.facts:
            for finding in found.findings:
                ui.label(finding).classes("warn").style("overflow-wrap: anywhere")
            if not found.findings:
                ui.label("No warnings.").classes("good")
            with ui.element("div").classes("lab-facts"):
                for name, lines in found.facts:
                    ui.label(name).classes("quiet")
                    ui.label("\n".join(lines)).style("white-space: pre-line; overflow-wrap: anywhere")

    # The ambiguity map.

    async def map(self) -> None:
        found: AmbiguityMap | None = await self.tab.run_task("ambiguity", activity="comparing the fields …")
        if found is None:
            return
        span = (found.fraction - found.least) / (1 - found.least)
        self.tab.scene_3d.color_lights(found.ids, span)
        self.fields.clear()
        with self.fields:
            ui.label(ambiguity_text(found))
            with ui.row().classes("no-wrap items-center gap-2"):
                ui.label(f"{100 * found.least:.0f} % or less").classes("quiet")
                colors = ", ".join(
                    f"rgb({r:.0f} {g:.0f} {b:.0f})" for r, g, b in 255 * color_scale(np.linspace(0, 1, 8))
                )
                ui.element("div").style(f"width: 120px; height: 10px; background: linear-gradient(90deg, {colors})")
                ui.label("100 % of the LEDs coincide; drawn in the 3-D view").classes("quiet")

    # The survey.

    async def plan_survey(self) -> None:
        """Plan the first attitudes of a new survey."""
        found: SurveyPlan | None = await self.tab.run_task(
            "plan_survey", int(self.frames.value or 0), activity="planning the survey …"
        )
        if found is not None:
            self.show_survey([prediction_text(found)], found)

    async def adjust(self) -> None:
        """Adjust the dome to the frames flown, and show what they measure and the attitudes to hold next."""
        found: SurveyFound | None = await self.tab.run_task(
            "adjust_survey", int(self.frames.value or 0), activity="adjusting the survey …"
        )
        if found is None:
            return
        lines = survey_lines(found)
        self.show_survey([*lines, prediction_text(found.plan)], found.plan)
        self.save_map.set_enabled(not found.refusal)
        self.tab.scene_3d.color_lights(found.ids, found.known)
        self.tab.log(f"survey of {Path(self.tab.scene).name}: {lines[0]}")

    def show_survey(self, lines: Sequence[str], plan: SurveyPlan) -> None:
        """Show what a survey has found and its next attitudes, which can then be flown."""
        self.plan, self.lines = plan, lines
        self.fly.set_enabled(True)
        self.adjust_button.set_enabled(False)
        self.save_map.set_enabled(False)
        self.stops.clear()
        with self.stops:
            for line in lines:
                ui.label(line).style("overflow-wrap: anywhere")
            with ui.element("div").classes("lab-stops mono"):
                for head in ("", "roll °", "pitch °", "yaw °", "LEDs"):
                    ui.label(head).classes("quiet num")
                for number, (angles, leds) in enumerate(zip(plan.angles_deg, plan.shown, strict=True), 1):
                    button = ui.button(str(number), on_click=partial(self.point, number - 1)).props(
                        "dense flat size=sm"
                    )
                    button.props(f'aria-label="Point to attitude {number}"')
                    for text in (*(f"{angle:.2f}" for angle in angles), str(leds)):
                        ui.label(text).classes("num")

    async def point(self, number: int) -> None:
        """Show the frame at an attitude of the plan."""
        assert self.plan is not None
        self.tab.stop_playback()
        await self.tab.show_live(self.tab.session.run("point", self.plan.angles_deg[number], self.tab.solving))

    async def fly_plan(self) -> None:
        """Change the scene's maneuver to the plan's attitudes, in order, and compute this flight."""
        assert self.plan is not None
        plan, lines, tab = self.plan, self.lines, self.tab
        flight = survey_flight, tab.scene, dict(tab.overrides), plan.angles_deg
        overrides = await tab.await_result(run.io_bound(*flight))
        if overrides is None or not await tab.open(tab.scene, overrides):
            return
        self.show_survey(lines, plan)  # the survey goes on, although the scene has changed
        tab.tabs.set_value("Run")
        await tab.run_panel.simulate()
        self.adjust_button.set_enabled(self.plan is plan and bool(tab.run_panel.rows))

    async def download_map(self) -> None:
        data: bytes | None = await self.tab.run_task("survey_map")
        if data is not None:
            ui.download(data, f"{Path(self.tab.scene).stem}_leds.ecsv")


def ambiguity_text(found: AmbiguityMap) -> str:
    """How many fields look like another one, and which the most alike are."""
    count = int(np.sum(found.fraction >= ALIKE))
    most = int(np.argmax(found.fraction))
    return (
        f"{count} of {len(found.ids)} fields look like another one: {100 * ALIKE:.0f} % of the LEDs or more coincide"
        f" within {found.coincidence_mm:.2g} mm. Most alike: the fields about LED {found.ids[most]} and"
        f" {found.others[most]}, {100 * found.fraction[most]:.0f} %"
        + (" or less." if found.fraction[most] <= found.least else ".")
    )


def prediction_text(plan: SurveyPlan) -> str:
    """What a survey is predicted to reach with the attitudes of its plan."""
    steps = [f"after {frames} frames {measured} LEDs to {mm:.2g} mm rms" for frames, measured, mm in plan.steps if mm]
    return f"Predicted of the {plan.leds} LEDs: {'; '.join(steps) or 'none measured, the frames are too few'}."


def survey_lines(found: SurveyFound) -> list[str]:
    """What the frames of a survey have measured, and the faults of the dome."""
    unmeasured = f"{found.seen_once} seen once, {found.unseen} not seen."
    if found.refusal:
        return [f"{found.frames} frames: no LED measured; {unmeasured}", f"Not determined yet: {found.refusal}."]
    return [
        f"{found.frames} frames, {found.connected} of them connected: {found.measured} of {len(found.ids)} LEDs"
        f" measured to {found.sigma_mm:.2g} mm rms about each axis (1σ); their true error is"
        f" {found.error_mm:.2g} mm, {found.before_mm:.2g} mm before. {unmeasured}",
        *found.faults,
        "The 3-D view shows by how much the uncertainty of each LED is reduced: measured ones are bright.",
    ]


def survey_flight(
    scene: str, overrides: Mapping[str, str], angles_deg: tuple[tuple[float, ...], ...]
) -> dict[str, str]:
    """Overrides with which the vehicle slews to each attitude and holds it, with frames over the whole time.

    An exposure is no longer than the frame period, so one lies wholly in a hold of two periods. Raises InputError.
    """
    before = forms.validated_scene(scene, overrides)
    rate_hz = min(SURVEY_RATE_HZ, before.exposure.rate_hz)
    legs = list[dict[str, object]]()
    for angles in angles_deg:
        named = zip(("roll_deg", "pitch_deg", "yaw_deg"), angles, strict=True)
        legs.append({"kind": "slew", **{name: round(angle, 3) for name, angle in named}})
        legs.append({"kind": "hold", "duration": f"{HOLD_PERIODS / rate_hz:g} s"})
    flown = {**overrides, "motion.maneuver": forms.yaml_line(legs), "exposure.rate_hz": f"{rate_hz:g}"}
    if before.motion.control is None:
        flown["motion.control"] = PRESCRIBED
    loaded = forms.validated_scene(scene, flown)
    duration_s = guidance.plan(loaded.motion).duration_s - loaded.exposure.first_s
    return {**flown, "exposure.frames": str(max(math.floor(duration_s * rate_hz), 1))}
