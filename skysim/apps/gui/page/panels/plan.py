"""Plan panel: the scene's check, ambiguous fields on the dome, and attitudes of a survey, which can be flown."""

from __future__ import annotations

import math
from collections.abc import Mapping
from functools import partial
from typing import TYPE_CHECKING

import numpy as np
from nicegui import run, ui

from skysim.apps.gui.messages import AmbiguityMap, PlanCheck, SurveyPlan
from skysim.apps.gui.page import forms
from skysim.apps.gui.page.style import color_scale
from skysim.dynamics import guidance
from skysim.scene.sections.motion import PRESCRIBED

if TYPE_CHECKING:
    from skysim.apps.gui.page.page import Tab

HOLD_S = 2.0  # at each attitude of a survey that is flown
FRAMES = 20  # of a survey, at first
ALIKE = 0.9  # of the LEDs that coincide: a tracker without a prior refuses the field as ambiguous
UNCHECKED = "Check computes what this scene will show and how accurate its tracker will be. Nothing is rendered."
UNMAPPED = "Map compares the fields of the dome with one another: a field that looks like another one is ambiguous."
UNPLANNED = "Plan chooses the attitudes from which a survey measures the dome's LEDs best."


class PlanPanel:
    """Panel with three parts, each computed at a button's press and cleared when the scene changes."""

    def __init__(self, tab: Tab) -> None:
        self.tab = tab
        self.plan: SurveyPlan | None = None
        with self.part():
            ui.button("Check", on_click=self.check).props("dense outline size=sm").mark("check")
        self.facts = ui.column().classes("w-full gap-1").mark("check-result")
        with self.part():
            ui.button("Map", on_click=self.map).props("dense outline size=sm").mark("map")
        self.fields = ui.column().classes("w-full gap-1").mark("map-result")
        with self.part():
            ui.button("Plan", on_click=self.survey).props("dense outline size=sm").mark("survey")
            self.frames = ui.number(value=FRAMES, min=2, step=1, label="frames").props("dense outlined").classes("w-24")
            self.fly = ui.button("Fly", on_click=self.fly_plan).props("dense outline size=sm").mark("fly-survey")
        self.stops = ui.column().classes("w-full gap-1").mark("survey-result")
        self.clear()

    def part(self) -> ui.row:
        return ui.row().classes("w-full no-wrap items-center gap-2").style("margin-top: 8px")

    def clear(self) -> None:
        """Say what each part does, because nothing is known of this scene yet."""
        self.plan = None
        self.fly.set_enabled(False)
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

    async def survey(self) -> None:
        frames = int(self.frames.value or 0)
        found: SurveyPlan | None = await self.tab.run_task("survey", frames, activity="planning the survey …")
        if found is None:
            return
        self.plan = found
        self.fly.set_enabled(True)
        self.stops.clear()
        with self.stops:
            ui.label(prediction_text(found))
            with ui.element("div").classes("lab-stops mono"):
                for head in ("", "roll °", "pitch °", "yaw °", "LEDs"):
                    ui.label(head).classes("quiet num")
                for number, (angles, leds) in enumerate(zip(found.angles_deg, found.shown, strict=True), 1):
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
        angles, tab = self.plan.angles_deg, self.tab
        overrides = await run.io_bound(survey_flight, tab.scene, dict(tab.overrides), angles)
        if await tab.open(tab.scene, overrides):
            tab.tabs.set_value("Run")
            await tab.run_panel.simulate()


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
    """The error that the survey is predicted to reach."""
    steps = ", ".join(f"{mm:.2g} mm after {count}" for count, mm in plan.led_mm if mm is not None)
    return f"Predicted rms error of the {plan.leds} LEDs that are measured: {steps or 'not determined'} frames."


def survey_flight(
    scene: str, overrides: Mapping[str, str], angles_deg: tuple[tuple[float, ...], ...]
) -> dict[str, str]:
    """Overrides with which the vehicle slews to each attitude and holds it, with frames over the whole time."""
    legs = []
    for roll, pitch, yaw in angles_deg:
        legs.append(
            {"kind": "slew", "roll_deg": round(roll, 3), "pitch_deg": round(pitch, 3), "yaw_deg": round(yaw, 3)}
        )
        legs.append({"kind": "hold", "duration": f"{HOLD_S:g} s"})
    flown = {**overrides, "motion.maneuver": forms.yaml_line(legs)}
    if forms.validated_scene(scene, overrides).motion.control is None:
        flown["motion.control"] = PRESCRIBED
    loaded = forms.validated_scene(scene, flown)
    duration_s = guidance.plan(loaded.motion).duration_s - loaded.exposure.first_s
    return {**flown, "exposure.frames": str(max(math.floor(duration_s * loaded.exposure.rate_hz), 1))}
