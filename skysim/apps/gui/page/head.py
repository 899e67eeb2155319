"""The head of the page: its scene, the banner, messages, noise, identification, and export."""

from functools import cache
from pathlib import Path

from nicegui import ui

from skysim.apps.gui.messages import FrameView, SceneInfo
from skysim.apps.gui.views import context, forms, widgets
from skysim.apps.gui.views.context import PageView
from skysim.apps.gui.worker import photo
from skysim.core.paths import SCENES, shipped_files, title_of

NOISE = (
    "off: every pixel has its expected value. The tracker's threshold falls with the scatter, so faint lights and"
    " hot pixels are detected, and lights merge with brighter ones."
)
# Of many files, in which every page that opens would search for 13 ms.
shipped_title = cache(title_of)


class Head:
    """The elements of the head and their actions."""

    def __init__(self, page: context.PageContext) -> None:
        self.page = page
        with widgets.div("lab-head"):
            ui.label("skysim gui").classes("lab-name").props('role="heading" aria-level="1"')
            self.picker = widgets.select(
                self.scenes(),
                "borderless",
                value=page.state.scene,
                on_change=self.scene_picked,
            )
            self.picker.props('aria-label="Scene"').classes("lab-scene")
            self.camera = widgets.select([], "borderless", on_change=self.camera_picked)
            self.camera.props('aria-label="Camera"')
            self.banner = widgets.LiveText(page.contents, "live").classes("lab-banner")
            self.live_button = widgets.button("Live", self.go_live)
            self.live_button.set_visibility(False)
            page.message = ui.label().classes("lab-said").props('role="status"')
            page.busy = ui.icon("hourglass_empty", size="16px").classes("lab-busy")
            page.latency = widgets.LiveText(page.contents).classes("lab-rate mono quiet")
            page.latency.props('title="latency: from the request for a frame to its arrival"')
            self.noise = ui.switch("noise", value=True, on_change=self.switch_noise).props(
                f'dense size=xs title="{NOISE}"'
            )
            page.identifying = ui.switch("identify", value=True).props("dense size=xs")
            with ui.button("Export").props("dense flat size=sm"), ui.menu():
                for name in photo.FILE_BY_ITEM:
                    item = ui.menu_item(name, on_click=lambda name=name: self.export(name))
                    item.props("dense").style("white-space: nowrap")

    def scenes(self) -> dict[str, str]:
        """Scenes to choose from, with labels: shipped ones, those saved in the folder, and the current one."""
        current = self.page.state.scene
        own = [
            path for path in sorted(self.page.folder.glob("*.yaml")) if forms.is_scene(path)
        ]
        titles = {name: shipped_title(path) for name, path in shipped_files(SCENES).items()}
        titles |= {str(path): title_of(path) for path in own}
        if current not in titles:
            titles[current] = title_of(Path(current))
        return {
            name: ": ".join(filter(None, (Path(name).name, title)))
            for name, title in titles.items()
        }

    def update_scenes(self) -> None:
        """Add scenes that have been saved to the list."""
        self.picker.set_options(self.scenes())

    async def scene_picked(self) -> None:
        if self.picker.value != self.page.state.scene:
            await self.page.open(str(self.picker.value))

    async def camera_picked(self) -> None:
        """Show another camera of the scene at the same attitude of the vehicle."""
        state = self.page.state
        if self.camera.value not in (None, state.head):
            await self.page.open(*state.opened, head=str(self.camera.value))

    # Contents.

    def set_scene(self, info: SceneInfo) -> None:
        """Show the name and the noise of a newly opened scene."""
        self.picker.set_value(self.page.state.scene)
        self.camera.set_options(list(info.heads), value=info.head)
        self.camera.set_visibility(len(info.heads) > 1)
        self.noise.set_value(info.noise)

    def set_state(self, state: PageView) -> None:
        """Say in the banner what the page shows."""
        self.banner.set_text(state.banner, state.kind)
        self.live_button.set_visibility(state.kind != "live")

    # Actions.

    async def go_live(self) -> None:
        """Return to the live scene at the newest attitude."""
        self.page.stop_playback()
        await self.page.show_live("render")

    def toggle_noise(self) -> None:
        self.noise.set_value(not self.noise.value)

    async def switch_noise(self) -> None:
        """Render with the camera's noise, or the expected value of each pixel; the attitude is kept."""
        info = self.page.scene_info
        before = self.page.view if self.page.state.kind == "live" else None
        if info and info.noise != self.noise.value:
            await self.page.apply_overrides(
                {"camera.detector.noise": str(bool(self.noise.value)).lower()}
            )
            info = self.page.scene_info
            self.noise.set_value(info.noise if info else True)
            if before and self.page.view and not self.noise.value:
                self.page.show_message(noise_text(before, self.page.view), "quiet")

    async def export(self, item: str) -> None:
        """Download a file of the image on the page, or all of them.

        Parameters
        ----------
        item
            Entry of the menu, a key of FILE_BY_ITEM
        """
        if not self.page.sensor.has_image:
            self.page.show_message("nothing to export: the page shows no image")
            return
        files = await self.page.run_task("export")
        if not files:
            return
        name = photo.FILE_BY_ITEM[item]
        if not name:
            ui.download(photo.zip_archive(files), f"{Path(self.page.state.scene).stem}.zip")
        elif name in files:
            ui.download(files[name], name)
        else:
            reason = (
                "no solution yet: press 1"
                if name == "solution.json"
                else "not known of an image from elsewhere"
            )
            self.page.show_message(f"{item}: {reason}")


def noise_text(noisy: FrameView, exact: FrameView) -> str:
    """That fewer lights are identified without noise, and why; "" if it is not so.

    The frame has hardly any scatter then, and the detector's threshold is a multiple of it: lights that the noise has
    hidden are detected, and join the blobs of their neighbors.
    """
    before = noisy.result
    after = exact.result
    if before is None or after is None or after.row.matched >= before.row.matched:
        return ""
    return (
        f"{after.row.matched} of {after.row.detected} lights identified, with noise {before.row.matched} of"
        f" {before.row.detected}: the threshold falls with the scatter, {noisy.statistics.scatter_dn:.2g} to"
        f" {exact.statistics.scatter_dn:.2g} DN"
    )


# The arrangement of the page: sizes of its panes and theme, which the browser remembers.


# The splitters work only in the browser. Each sets the size of a pane in pixels as a CSS variable; without it the pane
# has its default size. Below CLOSED the pane of the 3-D view is closed. Arrow keys on a splitter do not move the
# camera.
SPLITTER_JS = """
window.skysimSplitter = (() => {
  const STEP = 24, CLOSED = 60, root = document.documentElement;
  const KINDS = {
    side: { pane: ".lab-side", grows: "ArrowLeft", shrinks: "ArrowRight", size: box => box.width,
      to: (event, box) => box.right - event.clientX, fit: px => Math.min(Math.max(px, 360), 0.7 * innerWidth) },
    space: { pane: ".lab-space-pane", grows: "ArrowDown", shrinks: "ArrowUp", size: box => box.height,
      to: (event, box) => event.clientY - box.top,
      fit: px => px < CLOSED ? 0 : Math.min(px, document.querySelector(".lab-panes").clientHeight - 60) },
  };
  const store = (kind, px) => {
    try {
      if (px === null) localStorage.removeItem("skysim." + kind);
      else localStorage.setItem("skysim." + kind, px);
    } catch { /* storage is off */ }
  };
  const box = kind => document.querySelector(KINDS[kind].pane).getBoundingClientRect();
  const set = (kind, px) => {
    const size = Math.round(KINDS[kind].fit(px));
    root.style.setProperty("--lab-" + kind, size + "px");
    store(kind, size);
  };
  const reset = kind => {
    root.style.removeProperty("--lab-" + kind);
    store(kind, null);
  };
  const at = event => event.target.dataset?.split;
  for (const kind in KINDS) {
    try {
      const kept = localStorage.getItem("skysim." + kind);
      if (kept !== null) root.style.setProperty("--lab-" + kind, Number(kept) + "px");
    } catch { /* storage is off */ }
  }
  document.addEventListener("pointerdown", event => {
    const kind = at(event), line = event.target;
    if (!kind) return;
    event.preventDefault();
    line.setPointerCapture(event.pointerId);
    line.onpointermove = moved => set(kind, KINDS[kind].to(moved, box(kind)));
    line.onpointerup = line.onpointercancel = () => { line.onpointermove = null; };
  });
  document.addEventListener("dblclick", event => at(event) && reset(at(event)));
  document.addEventListener("keydown", event => {
    const kind = at(event), { grows, shrinks, size } = KINDS[kind] ?? {};
    if (!kind || ![grows, shrinks, "Enter"].includes(event.key)) return;
    event.preventDefault();
    event.stopImmediatePropagation();
    if (event.key === "Enter") reset(kind);
    else {
      const now = size(box(kind)), step = event.key === grows ? STEP : -STEP;
      set(kind, step > 0 ? Math.max(now + step, kind === "space" ? CLOSED : 0) : now + step);
    }
  }, true);
  return { reset: () => Object.keys(KINDS).forEach(reset) };
})();
"""


class Arrangement:
    """The splitters between the frame, the 3-D view and the panels, and the theme.

    Attributes
    ----------
    chart
        Chart that is drawn again when the theme changes
    """

    def __init__(self, chart: ui.echart) -> None:
        self.chart = chart
        self.dark = ui.dark_mode(True)
        ui.add_body_html(f"<script>{SPLITTER_JS}</script>")

    @staticmethod
    def splitter(kind: str, orientation: str, label: str) -> None:
        """A line that is dragged or moved by arrow keys; a double click or Enter restores the pane's default size.

        Parameters
        ----------
        kind
            `side` (the column of panels) or `space` (the 3-D view)
        """
        widgets.div(f"lab-split {orientation}").props(
            f'role="separator" data-split="{kind}" aria-orientation="{orientation}" tabindex="0"'
            f' aria-label="{label}" title="{label}: drag, or arrow keys; double-click: as at first"'
        )

    async def restore(self) -> None:
        """Apply the theme that the browser remembers."""
        if (
            await ui.run_javascript('localStorage.getItem("skysim.theme")', timeout=10)
            == "light"
        ):
            self.set_dark(False)

    def reset(self) -> None:
        """Restore the default sizes of all panes."""
        ui.run_javascript("skysimSplitter.reset()")

    def toggle(self) -> None:
        self.set_dark(not self.dark.value)
        ui.run_javascript(
            f'localStorage.setItem("skysim.theme", "{"dark" if self.dark.value else "light"}")'
        )

    def set_dark(self, dark: bool) -> None:
        """Change the theme and draw the chart again, which takes its colors from it."""
        self.dark.set_value(dark)
        self.chart.update()
