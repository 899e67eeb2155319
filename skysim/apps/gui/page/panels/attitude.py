"""Attitude card: true angles (editable), the tracker's angles, its error, and its algorithms by stage."""

from __future__ import annotations

import math
from functools import partial
from typing import TYPE_CHECKING

from nicegui import ui

from skysim.apps.gui.messages import Answer, FrameView, SceneInfo
from skysim.apps.gui.page import keys
from skysim.apps.gui.page.style import digits

if TYPE_CHECKING:
    from skysim.apps.gui.page.page import Tab
    from skysim.apps.gui.worker.photo import Photo

ASIDE = {"detector": "F6", "identifier": "F7"}


class AttitudeCard:
    """True and estimated angles with the error, and one list of algorithms for each of the tracker's four stages.

    foreign : whether the card shows an image that is not of the current scene
    """

    def __init__(self, tab: Tab) -> None:
        self.tab, self.foreign = tab, False
        with ui.element("div").classes("lab-card"):
            with ui.element("div").classes("lab-grid"):
                ui.label("attitude").classes("quiet")
                self.heads = [ui.label().classes("quiet num") for _ in range(3)]
                ui.label("true (F5)").classes("quiet")
                self.inputs = [self.typed(n) for n in range(3)]
                ui.label("tracker").classes("quiet")
                self.estimates = [ui.label("–").classes("mono num") for _ in range(3)]
                ui.label("off").classes("quiet")
                self.errors = [ui.label("–").classes("mono num") for _ in range(3)]
            self.status = ui.label(" ").classes("mono ellipsis").style("margin-top: 6px").mark("status")
        with (
            ui.element("div").classes("lab-card"),
            ui.element("div").classes("lab-stages"),
        ):
            self.stages = {
                stage: self.stage(stage) for stage in ("detector", "centroider", "identifier", "solver")
            }

    def typed(self, n: int) -> ui.input:
        """Input field of one angle."""
        field = ui.input().props(f'dense outlined input-class="text-right" aria-label="angle {n + 1}"')
        return field.classes("mono").mark(f"angle-{n}").on("keydown.enter", self.point)

    def stage(self, name: str) -> ui.select:
        """List of one stage's algorithms."""
        label = f"{name} {ASIDE[name]}" if name in ASIDE else name
        field = ui.select([], label=label, on_change=partial(self.choose, name))
        field.on("popup-hide", js_handler=keys.LEAVE)
        return field.props("dense outlined options-dense").mark(name)

    def set(self, setting: SceneInfo) -> None:
        """Take over a new scene: angle names and algorithms."""
        self.head(setting.names)
        for name, field in self.stages.items():
            field.props["title"] = f"{name}: {setting.stages[name]}"  # tooltip with the full name
            field.set_options(list(setting.choices[name]), value=setting.stages[name])

    def head(self, names: tuple[str, str, str]) -> None:
        """Set the heads of the three angle columns."""
        for head, name in zip(self.heads, names, strict=True):
            head.set_text(f"{name}, deg")

    async def choose(self, stage: str) -> None:
        """Select an algorithm: the tracker is rebuilt, the rest of the scene is kept."""
        setting, value = self.tab.setting, self.stages[stage].value
        if setting and value and value != setting.stages[stage]:
            await self.tab.change({f"tracker.{stage}": value})

    async def point(self) -> None:
        """Point the camera at the typed attitude."""
        self.tab.rest()
        self.tab.say("")
        try:
            angles = tuple(float(field.value) for field in self.inputs)
        except (TypeError, ValueError):
            self.tab.say("an angle is not a number; allowed: degrees such as 83.6")
            return
        if await self.tab.show(self.tab.session.ask("point", angles, self.tab.solving)):
            for field in self.inputs:
                field.run_method("blur")  # so that the arrow keys move the camera again

    def show(self, view: FrameView) -> None:
        """Display the newest frame's attitudes."""
        if self.foreign and self.tab.setting:
            self.foreign = False
            self.head(self.tab.setting.names)
            self.hint("")
        for field, angle in zip(self.inputs, view.angles_deg, strict=True):
            field.set_value(degrees(angle))
        self.tell(view.answer)

    def show_photo(self, photo: Photo) -> None:
        """Display the attitudes of an image that is not of the current scene; a user's image has no true attitude."""
        self.foreign = True
        self.head(photo.names)
        self.hint("unknown")
        told = [degrees(angle) for angle in photo.true_deg] if photo.true_deg else ["", "", ""]
        for field, text in zip(self.inputs, told, strict=True):
            field.set_value(text)
        self.tell(photo.answer)

    def hint(self, text: str) -> None:
        """Set the placeholder of empty angle fields."""
        for field in self.inputs:
            field.props["placeholder"] = text
            field.update()

    def tell(self, answer: Answer | None) -> None:
        """Display the tracker's angles, errors and status; dashes without a solution."""
        if answer is None or answer.angles_deg is None:
            for label in (*self.estimates, *self.errors):
                label.set_text("–")
        else:
            for label, angle in zip(self.estimates, answer.angles_deg, strict=True):
                label.set_text(degrees(angle))
            cross, roll = answer.sigma_arcsec
            self.errors[0].set_text(
                "–" if math.isnan(answer.cross_arcsec) else f"cross {answer.cross_arcsec:.2f}″"
            )
            self.errors[1].set_text(
                "–" if math.isnan(answer.roll_arcsec) else f"roll {answer.roll_arcsec:+.1f}″"
            )
            self.errors[2].set_text("–" if math.isnan(cross) else f"σ {digits(cross)}″ {digits(roll)}″")
        ink, text = verdict(answer)
        self.status.set_text(text)
        self.status.classes(remove="good bad warn quiet", add=ink)


def degrees(angle: float) -> str:
    """Format with four decimals; adding 0.0 turns minus zero into zero."""
    return f"{round(angle, 4) + 0.0:.4f}"


def verdict(answer: Answer | None) -> tuple[str, str]:
    """Style class and status line: solved, refused, wrong, or not asked."""
    if answer is None:
        return "quiet", "not asked: press 1 to identify"
    if not answer.solved:
        return "warn", f"{answer.status}; {len(answer.spots)} lights seen"
    took = f", {answer.ms:.1f} ms" if answer.ms else ""  # a replayed trial has no time
    counts = f"{answer.identified} of {len(answer.spots)} lights named{took}"
    return ("bad", f"WRONG by more than 10′; {counts}") if answer.wrong else ("good", f"solved; {counts}")
