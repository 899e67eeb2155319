"""Scene panel: a form with all keys and units of the scene; errors appear at the field; saves a new scene file."""

from __future__ import annotations

from collections.abc import Mapping
from functools import partial
from typing import TYPE_CHECKING

from nicegui import run, ui

from skysim.apps.gui.page import forms
from skysim.apps.gui.page.shell.wording import for_page
from skysim.core.errors import InputError

if TYPE_CHECKING:
    from skysim.apps.gui.page.page import Tab


class ScenePanel:
    """Form with one expandable section per scene section; values that differ from the file are marked.

    fields : of the loaded scene, by key;  last_typed : by key the last typed value, accepted or refused
    rows, labels, inputs : by key its elements
    """

    def __init__(self, tab: Tab) -> None:
        self.tab = tab
        with ui.row().classes("w-full no-wrap items-center gap-2").style("margin-bottom: 8px"):
            self.find = ui.input(placeholder="find a key", on_change=lambda: self.search())
            self.find.props("dense outlined clearable").classes("flex-grow").mark("find-key")
            self.name = ui.input(placeholder="new-name").props('dense outlined aria-label="Name of the new scene"')
            self.name.classes("w-36").mark("save-name")
            ui.button("Save as", on_click=self.save).props("dense outline no-wrap size=sm").mark("save")
            self.undo = ui.button("Undo all", on_click=self.revert).props("dense flat no-wrap size=sm").mark("revert")
        self.no_match = ui.label("No key contains this text.").classes("w-full empty")
        self.no_match.set_visibility(False)
        self.sections = ui.column().classes("lab-sections w-full gap-0")
        self.rows: dict[str, ui.element] = {}
        self.expansions: dict[str, ui.expansion] = {}
        self.inputs: dict[str, ui.input | ui.select] = {}
        self.scene, self.fields = "", dict[str, forms.Field]()
        self.last_typed: dict[str, str] = {}
        self.labels: dict[str, ui.label] = {}

    async def set_scene(self) -> None:
        """Show the fields of the current scene. Open sections stay open, and text being typed is kept."""
        fields = await run.io_bound(forms.fields, self.tab.scene, dict(self.tab.overrides))
        fields_by_key = {field.key: field for field in fields}
        if self.scene == self.tab.scene and fields_by_key.keys() == self.fields.keys():
            for key, field in fields_by_key.items():
                self.update_field(field, self.fields[key])
        else:
            self.build(fields_by_key)
        self.scene, self.fields = self.tab.scene, fields_by_key
        self.undo.set_visibility(bool(self.tab.overrides))
        self.filter()

    def build(self, fields_by_key: Mapping[str, forms.Field]) -> None:
        open_now = {name for name, expansion in self.expansions.items() if expansion.value}
        self.sections.clear()
        for elements in (self.expansions, self.last_typed, self.rows, self.labels, self.inputs):
            elements.clear()
        with self.sections:
            for section in dict.fromkeys(field.section for field in fields_by_key.values()):
                box = ui.expansion(section, group="scene", value=section in open_now)
                self.expansions[section] = box.classes("w-full").props("dense dense-toggle")
                with box:
                    for field in fields_by_key.values():
                        if field.section == section:
                            self.row(field)

    def row(self, field: forms.Field) -> None:
        key_in_section = field.key.removeprefix(f"{field.section}.")
        with ui.row().classes("w-full no-wrap items-start gap-2") as box:
            head = ui.label(key_in_section).classes("mono w-48 flex-none ellipsis").style("padding-top: 6px")
            head.tooltip(field.key).classes(self.style_class(field))
            if field.allowed_values:
                selected = field.text if field.text in field.allowed_values else None
                entry: ui.input | ui.select = ui.select(list(field.allowed_values), value=selected)
                entry.props("dense outlined options-dense").on_value_change(partial(self.edit, field.key))
            else:
                entry = ui.input(value=field.text).props(f'dense outlined suffix="{field.unit}"')
                leave = partial(self.edit, field.key)
                entry.on("keydown.enter", leave).on("blur", leave)
            entry.classes("flex-grow").style("width: 0; margin-bottom: 3px").mark(f"key-{field.key}")
            entry.props(f'hide-bottom-space aria-label="{field.key}"')
        self.rows[field.key], self.inputs[field.key], self.labels[field.key] = box, entry, head

    def style_class(self, field: forms.Field) -> str:
        """Style class of a key: changed by the user, set in a file, or default."""
        return "warn" if field.key in self.tab.overrides else "given" if field.is_set else "quiet"

    def update_field(self, field: forms.Field, before: forms.Field) -> None:
        """Update a field after the scene has changed; text typed since then is kept."""
        self.labels[field.key].classes(remove="warn given quiet", add=self.style_class(field))
        if field.text != before.text and (not field.allowed_values or field.text in field.allowed_values):
            self.last_typed[field.key] = field.text
            self.inputs[field.key].set_value(field.text)
            self.show_error(field.key, "")

    async def edit(self, key: str, *_: object) -> None:
        """Apply a typed value, or show at the field why it is refused."""
        value, current = str(self.inputs[key].value), self.fields[key].text
        if value == self.last_typed.get(key, current):
            return  # leaving a field after Enter reports the same value again
        self.last_typed[key] = value
        self.show_error(key, "")
        if value == current:
            return
        overrides = {**self.tab.overrides, key: value}
        try:
            await run.io_bound(forms.validated_scene, self.tab.scene, overrides)
        except InputError as error:
            self.show_error(key, for_page(str(error)).removeprefix(f"{key}: "))
            return
        await self.tab.apply_overrides({key: value})
        if self.tab.overrides.get(key) != value:  # the scene could not be set up with it
            self.show_error(key, self.tab.message_text)

    def show_error(self, key: str, message: str) -> None:
        """Show an error message at a field; an empty one removes it."""
        entry = self.inputs[key]
        if message:
            entry.props("error").props["error-message"] = message
        else:
            entry.props(remove="error error-message")
        entry.update()

    def filter(self) -> None:
        """Show only keys that contain the search text, and sections with such keys."""
        text = (self.find.value or "").lower()
        for key, box in self.rows.items():
            box.set_visibility(text in key.lower())
        visible = {field.section for key, field in self.fields.items() if text in key.lower()}
        for section, expansion in self.expansions.items():
            expansion.set_visibility(section in visible)
        self.no_match.set_visibility(not visible)

    def search(self) -> None:
        """Filter, and open the first section with a matching key if none is open."""
        self.filter()
        first = next((item for item in self.expansions.values() if item.visible), None)
        if self.find.value and first and not any(item.value and item.visible for item in self.expansions.values()):
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
            self.tab.show_message(str(error))
            return
        self.tab.log(f"saved {path}")
        self.tab.picker.set_options(self.tab.scenes())
        self.name.set_value("")
        self.tab.show_message(f"saved as {path.name}", "good")

    async def revert(self) -> None:
        """Reopen the scene without overrides."""
        self.scene = ""  # forces a rebuild, which removes refused values too
        await self.tab.open(self.tab.scene)
