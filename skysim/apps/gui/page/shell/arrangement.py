"""How a user arranges the page: the width of its panels and its theme, remembered by the browser."""

from __future__ import annotations

from nicegui import ui

# The splitter works in the browser alone. An arrow key on it is not the camera's.
SPLITTER_JS = """
window.skysimSplitter = {
  set(px) {
    const wide = Math.round(Math.min(Math.max(px, 360), 0.7 * innerWidth));
    document.documentElement.style.setProperty("--lab-side", wide + "px");
    try { localStorage.setItem("skysim.side", wide); } catch { /* storage is off */ }
  },
  width: () => document.querySelector(".lab-side").getBoundingClientRect().width,
};
try {
  const wide = Number(localStorage.getItem("skysim.side"));
  if (wide) document.documentElement.style.setProperty("--lab-side", wide + "px");
} catch { /* storage is off */ }
document.addEventListener("pointerdown", event => {
  if (!event.target.classList.contains("lab-split")) return;
  event.preventDefault();
  event.target.setPointerCapture(event.pointerId);
  event.target.onpointermove = moved => skysimSplitter.set(innerWidth - moved.clientX);
  event.target.onpointerup = () => { event.target.onpointermove = null; };
});
document.addEventListener("keydown", event => {
  const step = { ArrowLeft: 24, ArrowRight: -24 }[event.key];
  if (!step || !event.target.classList.contains("lab-split")) return;
  event.preventDefault();
  event.stopImmediatePropagation();
  skysimSplitter.set(skysimSplitter.width() + step);
}, true);
"""


class Arrangement:
    """The splitter between the sensor view and the panels, and the theme.

    charts : that are drawn again in another theme
    """

    def __init__(self, charts: list[ui.echart]) -> None:
        self.charts, self.dark = charts, ui.dark_mode(True)
        ui.add_body_html(f"<script>{SPLITTER_JS}</script>")

    @staticmethod
    def splitter() -> None:
        ui.element("div").classes("lab-split").props(
            'role="separator" aria-orientation="vertical" tabindex="0" aria-label="Width of the panels"'
        )

    async def restore(self) -> None:
        """Take the theme that the browser remembers."""
        if await ui.run_javascript('localStorage.getItem("skysim.theme")', timeout=10) == "light":
            self.set_dark(False)

    def toggle(self) -> None:
        self.set_dark(not self.dark.value)
        ui.run_javascript(f'localStorage.setItem("skysim.theme", "{"dark" if self.dark.value else "light"}")')

    def set_dark(self, dark: bool) -> None:
        """Change the theme; charts take their colors from it when they are drawn."""
        self.dark.set_value(dark)
        for chart in self.charts:
            chart.update()
