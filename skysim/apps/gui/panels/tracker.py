"""Tracker panel: what PTASE's F6 and F7 configure, image processing with the sensor's noise, and identification."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from functools import partial
from typing import TYPE_CHECKING

from nicegui import ui

from skysim.apps.gui.panels.key_form import KeyForm
from skysim.apps.gui.shared import forms, keys

if TYPE_CHECKING:
    from skysim.apps.gui.page.tab import Tab

SENSOR, IDENTIFIER = "sensor, F6", "identifier, F7"
NAMES = {  # by group and key
    SENSOR: {
        "tracker.detector": "detector",
        "tracker.centroider": "centroider",
        "tracker.threshold_sigma": "threshold, σ",
        "tracker.min_area_px": "least area",
        "camera.detector.noise": "camera's noise, N",
        "camera.detector.read_noise_e": "read noise",
        "light.limit_mag": "faintest star, V",
    },
    IDENTIFIER: {
        "tracker.identifier": "identifier",
        "tracker.solver": "solver",
        "tracker.limit_mag": "limiting magnitude",
        "tracker.catalog": "catalog",
        "tracker.centroid_sigma_px": "least error",
        "tracker.brightest": "brightest lights",
        "tracker.brightness_sigma": "brightness, σ",
        "tracker.decoder.gate_px": "decoder's gate",
        "tracker.decoder.frames": "decoder's frames",
    },
}
FOCUS_S = 0.2  # until a part that opens is drawn
MODEL = "Sensor model: the Monte Carlo simulation of centroids takes stars of the catalog with random errors."


class TrackerPanel:
    """The form of two parts, without keys that have no effect, and the noise of the Monte Carlo simulation's lights.

    shown : scene and overrides in the form
    """

    def __init__(self, tab: Tab) -> None:
        self.tab = tab
        self.shown: tuple[str, Mapping[str, str]] | None = None
        names = {key: name for group in NAMES.values() for key, name in group.items()}
        self.form = KeyForm(tab, lambda field: names[field.key], opens=SENSOR)
        ui.label(MODEL).classes("quiet").style("margin: 10px 0 4px")
        study = tab.study_panel
        with ui.row().classes("w-full no-wrap items-center gap-2"):
            self.arcsec = ui.number("noise, ″ an axis", min=0, step=1).props("dense outlined").mark("noise-arcsec")
            self.arcsec.on("blur", self.typed).on("keydown.enter", self.typed)
            magnitude = (
                ui.number("noise, magnitudes", min=0, max=5, step=0.05)
                .props("dense outlined")
                .classes("w-36 flex-none")
            )
            magnitude.bind_value(study.magnitude)
            ui.checkbox("with noise").props("dense size=xs").bind_value(study.with_noise).mark("model-noise")
        study.noise.on_value_change(self.show_noise)

    def set_scene(self, fields: Sequence[forms.Field]) -> None:
        """Show the fields of the current scene."""
        offered = {field.key: field for field in fields if not field.no_effect}
        self.form.show({group: [offered[key] for key in NAMES[group] if key in offered] for group in NAMES})
        self.show_noise()

    def show_noise(self) -> None:
        """Show the noise of a centroid, which is in pixels, as an angle in the middle of the frame."""
        info = self.tab.scene_info
        if info:
            self.arcsec.set_value(float(f"{float(self.tab.study_panel.noise.value or 0) * info.pixel_arcsec:.4g}"))

    def typed(self) -> None:
        """Take over a typed angle."""
        info, noise = self.tab.scene_info, self.tab.study_panel.noise
        shown = float(f"{float(noise.value or 0) * info.pixel_arcsec:.4g}") if info else 0.0
        if info and self.arcsec.value != shown:
            noise.set_value(float(f"{float(self.arcsec.value or 0) / info.pixel_arcsec:.4g}"))

    async def open(self, action: str) -> None:
        """Show the part of an action, sensor or identifier, with the keyboard on its first field."""
        await self.tab.fill_form()
        group = SENSOR if action == "sensor" else IDENTIFIER
        if group in self.form.expansions:
            self.form.expansions[group].open()
            entry = self.form.inputs.get(f"tracker.{'detector' if group == SENSOR else 'identifier'}")
            if entry:
                ui.timer(FOCUS_S, partial(keys.focus, entry), once=True)
