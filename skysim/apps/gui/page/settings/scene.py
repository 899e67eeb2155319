"""Scene panel: a form with all keys and units of the scene; saves a new scene file."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING

from nicegui import run, ui

from skysim.apps.gui.page import forms
from skysim.apps.gui.page.settings.key_form import KeyForm
from skysim.apps.gui.page.shell.wording import for_page
from skysim.core.errors import InputError

if TYPE_CHECKING:
    from skysim.apps.gui.page.page import Tab


class ScenePanel:
    """The form, one part per section of the scene, and a field that finds keys. shown : scene and overrides in it"""

    def __init__(self, tab: Tab) -> None:
        self.tab = tab
        self.shown: tuple[str, Mapping[str, str]] | None = None
        with ui.row().classes("w-full no-wrap items-center gap-2").style("margin-bottom: 8px"):
            self.find = ui.input(placeholder="find a key", on_change=lambda: self.search())
            self.find.props("dense outlined clearable").classes("flex-grow").mark("find-key")
            self.name = ui.input(placeholder="new-name").props('dense outlined aria-label="Name of the new scene"')
            self.name.classes("w-36").mark("save-name")
            ui.button("Save as", on_click=self.save).props("dense outline no-wrap size=sm").mark("save")
            self.undo = ui.button("Undo all", on_click=self.revert).props("dense flat no-wrap size=sm").mark("revert")
        self.no_match = ui.label("No key contains this text.").classes("w-full empty")
        self.no_match.set_visibility(False)
        self.form = KeyForm(tab, lambda field: field.key.removeprefix(f"{field.section}."))

    def set_scene(self, fields: Sequence[forms.Field]) -> None:
        """Show the fields of the current scene."""
        sections = dict.fromkeys(field.section for field in fields)
        self.form.show({name: [field for field in fields if field.section == name] for name in sections})
        self.undo.set_visibility(bool(self.tab.overrides))
        self.filter()

    def filter(self) -> None:
        """Show only keys that contain the search text, and sections with such keys."""
        text = (self.find.value or "").lower()
        for key, box in self.form.rows.items():
            box.set_visibility(text in key.lower())
        visible = {field.section for key, field in self.form.fields.items() if text in key.lower()}
        for section, expansion in self.form.expansions.items():
            expansion.set_visibility(section in visible)
        self.no_match.set_visibility(not visible)

    def search(self) -> None:
        """Filter, and open the first section with a matching key if none is open."""
        self.filter()
        expansions = self.form.expansions.values()
        first = next((item for item in expansions if item.visible), None)
        if self.find.value and first and not any(item.value and item.visible for item in expansions):
            first.open()

    async def save(self) -> None:
        name = (self.name.value or "").strip()
        title_before = self.tab.scene_info.title.removesuffix(", changed") if self.tab.scene_info else ""
        title = f"{title_before}, changed" if title_before else name
        try:
            path = await run.io_bound(
                forms.save, self.tab.folder, name, self.tab.scene, dict(self.tab.overrides), title
            )
        except InputError as error:
            self.tab.show_message(for_page(error))
            return
        self.tab.log(f"saved {path}")
        self.tab.picker.set_options(self.tab.scenes())
        self.name.set_value("")
        self.tab.show_message(f"saved as {path.name}", "good")

    async def revert(self) -> None:
        """Reopen the scene without overrides."""
        self.form.scene = ""  # forces a rebuild, which removes refused values too
        await self.tab.open(self.tab.scene)
