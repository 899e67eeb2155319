"""Scene panel: a form of all keys of the scene; F6 and F7 show those of image processing and of identification."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import partial

from nicegui import run, ui

from skysim.apps.gui.views import context, forms, keys, widgets
from skysim.core.errors import InputError
from skysim.core.yaml_reader import OverrideTexts

# Keys that are shown by the name of a key on the keyboard: those of PTASE's settings, without keys that have no effect.
KEYS_OF = {
    "F6": (
        "tracker.detector",
        "tracker.centroider",
        "tracker.threshold_sigma",
        "tracker.min_area_px",
        "camera.detector.noise",
        "camera.detector.read_noise_e",
        "light.limit_mag",
    ),
    "F7": (
        "tracker.identifier",
        "tracker.solver",
        "tracker.limit_mag",
        "tracker.catalog",
        "tracker.centroid_sigma_px",
        "tracker.brightest",
        "tracker.brightness_sigma",
        "tracker.decoder.gate_px",
        "tracker.decoder.frames",
    ),
}
FOCUS_S = 0.2  # time until a section that opens is drawn


@dataclass
class KeyRow:
    """The elements of a key.

    Attributes
    ----------
    field
        The key as it is shown
    typed
        Last typed value, accepted or refused
    """

    field: forms.FormField
    box: ui.element
    label: ui.label
    entry: ui.input | ui.select
    typed: str


class ScenePanel:
    """The form with one part per section of the scene; values that differ from the file are marked.

    It has a search field for keys, and a button to save a new scene file.

    Attributes
    ----------
    saved
        Function that is called when a scene has been saved
    shown
        Scene and overrides in the form; None if the scene has been opened since then
    scene
        Scene whose fields are shown
    rows
        Rows by key
    expansions
        Expandable parts by section
    """

    shown: tuple[str, OverrideTexts] | None = None

    def __init__(self, page: context.PageContext, saved: Callable[[], None]) -> None:
        self.page = page
        self.saved = saved
        with widgets.row().style("margin-bottom: 8px"):
            self.find = ui.input(placeholder="find a key", on_change=self.search)
            self.find.props("dense outlined clearable").classes("flex-grow")
            self.name = ui.input(placeholder="new-name").props(
                'dense outlined aria-label="Name of the new scene"'
            )
            self.name.classes("w-36")
            widgets.button("Save as", self.save).props("no-wrap")
            self.undo = widgets.button("Undo all", self.revert, "flat").props("no-wrap")
        self.no_match = ui.label("No key contains this text.").classes("w-full empty")
        self.no_match.set_visibility(False)
        self.parts = ui.column().classes("lab-sections w-full gap-0")
        self.rows: dict[str, KeyRow] = {}
        self.expansions: dict[str, ui.expansion] = {}
        self.scene = ""

    def hide_others(self, scene: str) -> None:
        """Hide the fields of another scene until those of this one are shown: what is typed there would be lost."""
        self.shown = None  # the file of this name may have changed
        self.parts.set_visibility(self.scene == scene)

    def set_scene(self, fields: Sequence[forms.FormField]) -> None:
        """Show the fields of the current scene. Open sections stay open, and text being typed is kept."""
        same = [(field.key, field.allowed_values) for field in fields] == [
            (key, row.field.allowed_values) for key, row in self.rows.items()
        ]
        scene = self.page.state.scene
        if self.scene == scene and same:
            for field in fields:
                self.update_row(self.rows[field.key], field)
        else:
            self.build(fields)
        self.scene = scene
        self.parts.set_visibility(True)
        self.undo.set_visibility(bool(self.page.state.overrides))
        self.search()

    def build(self, fields: Sequence[forms.FormField]) -> None:
        open_now = {name for name, expansion in self.expansions.items() if expansion.value}
        self.parts.clear()
        self.expansions.clear()
        self.rows.clear()
        for field in fields:
            name = field.section
            if name not in self.expansions:
                with self.parts:
                    box = ui.expansion(name, group=f"keys-{id(self)}", value=name in open_now)
                self.expansions[name] = box.classes("w-full").props("dense dense-toggle")
            with self.expansions[name]:
                self.row(field)

    def row(self, field: forms.FormField) -> None:
        edit = partial(self.edit, field.key)
        with ui.row().classes("w-full no-wrap items-start gap-2") as box:
            head = (
                ui.label(field.key.removeprefix(f"{field.section}."))
                .classes("mono w-48 flex-none ellipsis")
                .style("padding-top: 6px")
            )
            head.tooltip(field.key).classes(self.style_class(field))
            if field.allowed_values:
                selected = field.shown if field.shown in field.allowed_values else None
                entry: ui.input | ui.select = widgets.select(
                    list(field.allowed_values), value=selected
                ).on_value_change(edit)
                if len(field.allowed_values) == 1:
                    entry.props("readonly hide-dropdown-icon")
            else:
                entry = ui.input(value=field.shown).props(
                    f'dense outlined suffix="{field.unit}"'
                )
                entry.on("keydown.enter", edit).on("blur", edit)
            entry.classes("flex-grow").style("width: 0; margin-bottom: 3px")
            entry.props(f'hide-bottom-space aria-label="{field.key}"')
        self.rows[field.key] = KeyRow(field, box, head, entry, field.shown)

    def style_class(self, field: forms.FormField) -> str:
        """Style class of a key: changed by the user, set in a file, or default."""
        changed = any(
            field.key == key or field.key.startswith(f"{key}.")
            for key in self.page.state.overrides
        )
        return "warn" if changed else "given" if field.is_set else "quiet"

    def update_row(self, row: KeyRow, field: forms.FormField) -> None:
        """Update a key after the scene has changed; text typed since then is kept."""
        before = row.field
        row.field = field
        row.label.classes(remove="warn given quiet", add=self.style_class(field))
        if field.shown != before.shown and (
            not field.allowed_values or field.shown in field.allowed_values
        ):
            row.typed = field.shown
            row.entry.set_value(field.shown)
            self.show_error(field.key, "")

    async def edit(self, key: str, *_: object) -> None:
        """Apply a typed value, or show the reason of its refusal at the field."""
        row = self.rows[key]
        value = str(row.entry.value)
        if value == row.typed:
            return  # leaving a field after Enter reports the same value again
        row.typed = value
        self.show_error(key, "")
        if value == row.field.shown:
            return
        before = self.page.state.overrides
        try:
            after = await run.io_bound(
                forms.with_value, self.page.state.scene, before, key, value
            )
        except InputError as error:
            self.show_error(key, error.fault if error.key == key else widgets.for_page(error))
            return
        changed = {one: text for one, text in after.items() if before.get(one) != text}
        await self.page.apply_overrides(changed, before.keys() - after.keys())
        now = self.page.state.overrides
        if any(
            now.get(one) != text for one, text in after.items()
        ):  # the scene could not be set up
            self.show_error(key, self.page.message_text)

    def show_error(self, key: str, message: str) -> None:
        """Show an error message at a field if the field still exists; an empty message removes it."""
        if key not in self.rows:
            return
        entry = self.rows[key].entry
        if message:
            entry.props("error").props["error-message"] = message
        else:
            entry.props(remove="error error-message")
        entry.update()

    def search(self) -> None:
        """Show only keys that contain the search text, or those of F6 or F7, and sections with such keys.

        The first one is opened if none is open.
        """
        text = self.find.value or ""
        visible = set()
        for key, row in self.rows.items():
            is_found = text.lower() in key.lower()
            if text in KEYS_OF:
                is_found = key in KEYS_OF[text] and not row.field.no_effect
            row.box.set_visibility(is_found)
            if is_found:
                visible.add(row.field.section)
        for section, expansion in self.expansions.items():
            expansion.set_visibility(section in visible)
        self.no_match.set_visibility(not visible)
        expansions = self.expansions.values()
        first = next((item for item in expansions if item.visible), None)
        if (
            self.find.value
            and first
            and not any(item.value and item.visible for item in expansions)
        ):
            first.open()

    async def save(self) -> None:
        name = (self.name.value or "").strip()
        info = self.page.scene_info
        title_before = info.scene.title.removesuffix(", changed") if info else ""
        title = f"{title_before}, changed" if title_before else name
        path = await self.page.run_here(
            forms.save, self.page.folder, name, *self.page.state.opened, title
        )
        if path is None:
            return
        self.page.log(f"saved {path}")
        self.saved()
        self.name.set_value("")
        self.page.show_message(f"saved as {path.name}", "good")

    async def revert(self) -> None:
        """Reopen the scene without overrides."""
        self.scene = ""  # forces a rebuild, which also removes refused values
        await self.page.open(self.page.state.scene)

    def open(self, name: str) -> None:
        """Show only the keys of F6 or F7, and focus the first one."""
        self.find.set_value(name)
        if row := self.rows.get(KEYS_OF[name][0]):
            self.expansions["tracker"].open()
            ui.timer(FOCUS_S, partial(keys.focus, row.entry), once=True)
