"""A form with groups of a scene's keys; errors appear at the field."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from functools import partial
from typing import TYPE_CHECKING

from nicegui import run, ui

from skysim.apps.gui.page import forms, keys
from skysim.apps.gui.page.shell.wording import for_page
from skysim.core.errors import InputError

if TYPE_CHECKING:
    from skysim.apps.gui.page.page import Tab


class KeyForm:
    """Form with one expandable part per group of keys; values that differ from the file are marked.

    label  : of a field, from its key;  opens : the group that is open at first
    scene, fields : the scene whose fields are shown, and these by key
    last_typed : by key the last typed value, accepted or refused
    rows, labels, inputs : by key its elements;  expansions : by group
    """

    def __init__(self, tab: Tab, label: Callable[[forms.Field], str], opens: str = "") -> None:
        self.tab, self.label, self.opens = tab, label, opens
        self.parts = ui.column().classes("lab-sections w-full gap-0")
        self.rows: dict[str, ui.element] = {}
        self.expansions: dict[str, ui.expansion] = {}
        self.inputs: dict[str, ui.input | ui.select] = {}
        self.scene, self.fields = "", dict[str, forms.Field]()
        self.last_typed: dict[str, str] = {}
        self.labels: dict[str, ui.label] = {}

    def show(self, groups: Mapping[str, Sequence[forms.Field]]) -> None:
        """Show the fields of the current scene. Open groups stay open, and text being typed is kept."""
        by_key = {field.key: field for fields in groups.values() for field in fields}
        same = [(key, field.allowed_values) for key, field in by_key.items()] == [
            (key, field.allowed_values) for key, field in self.fields.items()
        ]
        if self.scene == self.tab.scene and same:
            for key, field in by_key.items():
                self.update_field(field, self.fields[key])
        else:
            self.build(groups)
        self.scene, self.fields = self.tab.scene, by_key

    def build(self, groups: Mapping[str, Sequence[forms.Field]]) -> None:
        open_now = {name for name, expansion in self.expansions.items() if expansion.value}
        open_now = open_now if self.expansions else {self.opens}
        self.parts.clear()
        for elements in (self.expansions, self.last_typed, self.rows, self.labels, self.inputs):
            elements.clear()
        with self.parts:
            for name, fields in groups.items():
                box = ui.expansion(name, group=f"keys-{id(self)}", value=name in open_now)
                self.expansions[name] = box.classes("w-full").props("dense dense-toggle")
                with box:
                    for field in fields:
                        self.row(field)

    def row(self, field: forms.Field) -> None:
        with ui.row().classes("w-full no-wrap items-start gap-2") as box:
            head = ui.label(self.label(field)).classes("mono w-48 flex-none ellipsis").style("padding-top: 6px")
            head.tooltip(field.key).classes(self.style_class(field))
            if field.allowed_values:
                selected = field.shown if field.shown in field.allowed_values else None
                entry: ui.input | ui.select = ui.select(list(field.allowed_values), value=selected)
                entry.props("dense outlined options-dense").on_value_change(partial(self.edit, field.key))
                entry.on("popup-hide", js_handler=keys.BLUR_JS)
                if len(field.allowed_values) == 1:
                    entry.props("readonly hide-dropdown-icon")
            else:
                entry = ui.input(value=field.shown).props(f'dense outlined suffix="{field.unit}"')
                leave = partial(self.edit, field.key)
                entry.on("keydown.enter", leave).on("blur", leave)
            entry.classes("flex-grow").style("width: 0; margin-bottom: 3px").mark(f"key-{field.key}")
            entry.props(f'hide-bottom-space aria-label="{field.key}"')
        self.rows[field.key], self.inputs[field.key], self.labels[field.key] = box, entry, head

    def style_class(self, field: forms.Field) -> str:
        """Style class of a key: changed by the user, set in a file, or default."""
        changed = any(field.key == key or field.key.startswith(f"{key}.") for key in self.tab.overrides)
        return "warn" if changed else "given" if field.is_set else "quiet"

    def update_field(self, field: forms.Field, before: forms.Field) -> None:
        """Update a field after the scene has changed; text typed since then is kept."""
        self.labels[field.key].classes(remove="warn given quiet", add=self.style_class(field))
        if field.shown != before.shown and (not field.allowed_values or field.shown in field.allowed_values):
            self.last_typed[field.key] = field.shown
            self.inputs[field.key].set_value(field.shown)
            self.show_error(field.key, "")

    async def edit(self, key: str, *_: object) -> None:
        """Apply a typed value, or show at the field why it is refused."""
        value, current = str(self.inputs[key].value), self.fields[key].shown
        if value == self.last_typed.get(key, current):
            return  # leaving a field after Enter reports the same value again
        self.last_typed[key] = value
        self.show_error(key, "")
        if value == current:
            return
        before = dict(self.tab.overrides)
        try:
            after = await run.io_bound(forms.with_value, self.tab.scene, before, key, value)
        except InputError as error:
            self.show_error(key, error.fault if error.key == key else for_page(error))
            return
        changed = {one: text for one, text in after.items() if before.get(one) != text}
        await self.tab.apply_overrides(changed, before.keys() - after.keys())
        if any(self.tab.overrides.get(one) != text for one, text in after.items()):  # it could not be set up
            self.show_error(key, self.tab.message_text)

    def show_error(self, key: str, message: str) -> None:
        """Show an error message at a field, if it is still there; an empty one removes it."""
        entry = self.inputs.get(key)
        if entry is None:
            return
        if message:
            entry.props("error").props["error-message"] = message
        else:
            entry.props(remove="error error-message")
        entry.update()
