"""How a user arranges the page: the sizes of its panes and its theme, remembered by the browser."""

from __future__ import annotations

from nicegui import ui

# The splitters work in the browser alone. Each sets the size of a pane in pixels, as a variable of CSS; without it the
# page has its own. Below CLOSED the pane of the 3-D view is closed. An arrow key on a splitter is not the camera's.
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

    charts : that are drawn again in another theme
    """

    def __init__(self, charts: list[ui.echart]) -> None:
        self.charts = charts
        self.dark = ui.dark_mode(True)
        ui.add_body_html(f"<script>{SPLITTER_JS}</script>")

    @staticmethod
    def splitter(kind: str, orientation: str, label: str) -> None:
        """A line that is dragged or moved by arrow keys; a double click or Enter gives the pane its first size.

        kind : side (the column of panels) or space (the 3-D view)
        """
        line = (
            ui.element("div")
            .classes(f"lab-split {orientation}")
            .props(f'role="separator" data-split="{kind}"')
        )
        line.props(f'aria-orientation="{orientation}" tabindex="0" aria-label="{label}"')
        line.props(f'title="{label}: drag, or arrow keys; double-click: as at first"')

    async def restore(self) -> None:
        """Take the theme that the browser remembers."""
        if await ui.run_javascript('localStorage.getItem("skysim.theme")', timeout=10) == "light":
            self.set_dark(False)

    def reset(self) -> None:
        """Give all panes their first sizes."""
        ui.run_javascript("skysimSplitter.reset()")

    def toggle(self) -> None:
        self.set_dark(not self.dark.value)
        ui.run_javascript(
            f'localStorage.setItem("skysim.theme", "{"dark" if self.dark.value else "light"}")'
        )

    def set_dark(self, dark: bool) -> None:
        """Change the theme; charts take their colors from it when they are drawn."""
        self.dark.set_value(dark)
        for chart in self.charts:
            chart.update()
