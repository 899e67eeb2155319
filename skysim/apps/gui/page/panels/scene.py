"""Scene panel: a form with all keys and units of the scene; errors appear at the field; saves a new scene file."""

from __future__ import annotations

from collections.abc import Mapping
from functools import partial
from typing import TYPE_CHECKING

from nicegui import run, ui

from skysim.apps.gui.page import forms
from skysim.core.errors import InputError

if TYPE_CHECKING:
    from skysim.apps.gui.page.page import Tab


class ScenePanel:
    """Form with one expandable section per scene section; values that differ from the file are marked.

    shown : the fields as the scene has them;  tried : by key the last typed value, accepted or refused
    boxes, heads, entries : by key its row, its label and its input element
    """

    def __init__(self, tab: Tab) -> None:
        self.tab = tab
        with ui.row().classes("w-full no-wrap items-center gap-2").style("margin-bottom: 8px"):
            self.find = ui.input(placeholder="find a key", on_change=lambda: self.search()).props(
                "dense outlined clearable"
            )
            self.find.classes("flex-grow").mark("find-key")
            self.name = ui.input(placeholder="new-name").props(
                'dense outlined aria-label="Name of the new scene"'
            )
            self.name.classes("w-36").mark("save-name")
            ui.button("Save as", on_click=self.save).props("dense outline no-wrap size=sm").mark("save")
            self.undo = (
                ui.button("Undo all", on_click=self.revert).props("dense flat no-wrap size=sm").mark("revert")
            )
        self.none = ui.label("No key has these letters.").classes("w-full empty")
        self.none.set_visibility(False)
        self.sections = ui.column().classes("lab-sections w-full gap-0")
        self.boxes: dict[str, ui.element] = {}
        self.opened: dict[str, ui.expansion] = {}
        self.entries: dict[str, ui.input | ui.select] = {}
        self.scene, self.shown = "", dict[str, forms.Field]()
        self.tried: dict[str, str] = {}
        self.heads: dict[str, ui.label] = {}

    async def set(self) -> None:
        """Show the fields of the current scene. Open sections stay open, and text being typed is kept."""
        fields = await run.io_bound(forms.fields, self.tab.scene, dict(self.tab.overrides))
        told = {field.key: field for field in fields}
        if self.scene == self.tab.scene and told.keys() == self.shown.keys():
            for key, field in told.items():
                self.renew(field, self.shown[key])
        else:
            self.build(told)
        self.scene, self.shown = self.tab.scene, told
        self.undo.set_visibility(bool(self.tab.overrides))
        self.filter()

    def build(self, told: Mapping[str, forms.Field]) -> None:
        """Rebuild all fields."""
        open_now = {name for name, one in self.opened.items() if one.value}
        self.sections.clear()
        for kept in (self.opened, self.tried, self.boxes, self.heads, self.entries):
            kept.clear()
        with self.sections:
            for section in dict.fromkeys(field.section for field in told.values()):
                box = ui.expansion(section, group="scene", value=section in open_now)
                self.opened[section] = box.classes("w-full").props("dense dense-toggle")
                with box:
                    for field in told.values():
                        if field.section == section:
                            self.row(field)

    def row(self, field: forms.Field) -> None:
        """Build the row of one key."""
        own = field.key.removeprefix(f"{field.section}.")
        with ui.row().classes("w-full no-wrap items-start gap-2") as box:
            head = ui.label(own).classes("mono w-48 flex-none ellipsis").style("padding-top: 6px")
            head.tooltip(field.key).classes(self.ink(field))
            if field.choices:
                known = field.text if field.text in field.choices else None
                entry: ui.input | ui.select = ui.select(list(field.choices), value=known)
                entry.props("dense outlined options-dense").on_value_change(partial(self.edit, field.key))
            else:
                entry = ui.input(value=field.text).props(f'dense outlined suffix="{field.unit}"')
                leave = partial(self.edit, field.key)
                entry.on("keydown.enter", leave).on("blur", leave)
            entry.classes("flex-grow").style("width: 0; margin-bottom: 3px").props(
                f'hide-bottom-space aria-label="{field.key}"'
            )
            entry.mark(f"key-{field.key}")
        self.boxes[field.key], self.entries[field.key], self.heads[field.key] = box, entry, head

    def ink(self, field: forms.Field) -> str:
        """Style class of a key: changed here, set in a file, or default."""
        return "warn" if field.key in self.tab.overrides else "given" if field.given else "quiet"

    def renew(self, field: forms.Field, before: forms.Field) -> None:
        """Update a field after the scene has changed; text typed since then is kept."""
        self.heads[field.key].classes(remove="warn given quiet", add=self.ink(field))
        if field.text != before.text and (not field.choices or field.text in field.choices):
            self.tried[field.key] = field.text
            self.entries[field.key].set_value(field.text)
            self.refuse(field.key, "")

    async def edit(self, key: str, *_: object) -> None:
        """Apply a typed value, or show at the field why it is refused."""
        value, held = str(self.entries[key].value), self.shown[key].text
        if value == self.tried.get(key, held):
            return  # leaving a field after Enter reports the same value again
        self.tried[key] = value
        self.refuse(key, "")
        if value == held:
            return
        told = {**self.tab.overrides, key: value}
        try:
            await run.io_bound(forms.checked, self.tab.scene, told)
        except InputError as error:
            self.refuse(key, str(error).replace(" (--set)", "").removeprefix(f"{key}: "))
            return
        await self.tab.change({key: value})
        if self.tab.overrides.get(key) != value:  # the scene could not be set up with it
            self.refuse(key, self.tab.said)

    def refuse(self, key: str, why: str) -> None:
        """Show an error message at a field; an empty one removes it."""
        entry = self.entries[key]
        if why:
            entry.props("error").props["error-message"] = why
        else:
            entry.props(remove="error error-message")
        entry.update()

    def filter(self) -> None:
        """Show only keys that contain the search text, and sections with such keys."""
        letters = (self.find.value or "").lower()
        for key, box in self.boxes.items():
            box.set_visibility(letters in key.lower())
        found = {one.section for key, one in self.shown.items() if letters in key.lower()}
        for section, opened in self.opened.items():
            opened.set_visibility(section in found)
        self.none.set_visibility(not found)

    def search(self) -> None:
        """Filter, and open the first section with a matching key if none is open."""
        self.filter()
        first = next((one for one in self.opened.values() if one.visible), None)
        if self.find.value and first and not any(one.value and one.visible for one in self.opened.values()):
            first.open()

    async def save(self) -> None:
        """Save the scene as a new file in the tab's folder."""
        name = (self.name.value or "").strip()
        known = self.tab.setting.title.removesuffix(", changed") if self.tab.setting else ""
        title = f"{known}, changed" if known else name
        try:
            path = await run.io_bound(
                forms.save, self.tab.folder, name, self.tab.scene, dict(self.tab.overrides), title
            )
        except InputError as error:
            self.tab.say(str(error))
            return
        self.tab.log(f"saved {path}")
        self.tab.picker.set_options(self.tab.scenes())
        self.name.set_value("")
        self.tab.say(f"saved as {path.name}", "good")

    async def revert(self) -> None:
        """Reopen the scene without overrides."""
        self.scene = ""  # forces a rebuild, which removes refused values too
        await self.tab.open(self.tab.scene)
