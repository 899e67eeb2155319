"""The page's view in the browser: in the address, in its history and in its storage.

The browser's history serves for undo and redo: Ctrl-Z goes back, Ctrl-Shift-Z forward. So a reload, the back button, a
shared link and undo all read a view from the address in the same way.
"""

import json
from collections.abc import Awaitable, Callable
from typing import Any

from nicegui import ui

from skysim.apps.gui.views import context, state

SETTLED = (
    3  # number of timer calls without a change after which the next change is a new step
)
WRITE_S = 0.4  # interval of the timer; browsers refuse more than about 200 entries in 30 s
JS = """
window.skysimHistory = {
  index: () => (history.state && history.state.skysim) || 0,
  write(query, push, home) {
    const at = this.index() + (push ? 1 : 0);
    history[push ? "pushState" : "replaceState"]({ skysim: at }, "", query);
    try { localStorage.setItem("skysim.view", JSON.stringify({ home, query })); } catch { /* storage is off */ }
  },
  read(home) {
    if (/[?&]scene=/.test(location.search)) return location.search;
    try {
      const kept = JSON.parse(localStorage.getItem("skysim.view") || "{}");
      return kept.home === home ? kept.query : "";
    } catch { return ""; }
  },
  undo() { if (this.index() > 0) history.back(); },
  redo() { history.forward(); },
};
window.addEventListener("popstate", () => emitEvent("view", location.search));
document.addEventListener("keydown", event => {
  const typing = event.target.closest && event.target.closest("input, textarea, [contenteditable]");
  if (typing || !(event.ctrlKey || event.metaKey)) return;
  const key = event.key.toLowerCase(), redo = key === "y" || (key === "z" && event.shiftKey);
  if (key !== "z" && key !== "y") return;
  event.preventDefault();
  skysimHistory[redo ? "redo" : "undo"]();
}, true);
"""


class History:
    """Writes a page's view to the browser, and shows the view of an address.

    Attributes
    ----------
    home
        The server's scene; a stored view is used only by a server of the same scene
    show_query
        Function that shows the view of an address
    is_settling
        Function that returns whether the page does not yet show its view
    written
        View in the address
    pending
        Newest query that was requested while another one is being shown
    moving
        Whether the last change was only of attitude or time
    unchanged
        Number of timer calls since the last change
    """

    written: state.PageView | None = None
    showing = False
    moving = False
    unchanged = 0
    pending: str | None = None

    def __init__(
        self,
        page: context.PageContext,
        show_query: Callable[[str], Awaitable[None]],
        is_settling: Callable[[], bool],
    ) -> None:
        self.page = page
        self.home = page.state.scene
        self.show_query = show_query
        self.is_settling = is_settling
        ui.add_body_html(f"<script>{JS}</script>")
        ui.on("view", self.asked)
        ui.timer(WRITE_S, self.write)

    async def read(self) -> str:
        """The query of the page's address; if it has none, that of the stored view."""
        return str(
            await ui.run_javascript(
                f"skysimHistory.read({json.dumps(self.home)})", timeout=10
            )
            or ""
        )

    def write(self) -> None:
        """Timer: write a changed view. A continued movement replaces the address; other changes add a step."""
        view = self.page.state
        if view is self.written or self.showing or self.is_settling():
            self.unchanged += 1
            return
        before = self.written
        self.written = view
        moves = before is not None and view.same_step(before)
        goes_on = moves and self.moving and self.unchanged < SETTLED
        push = before is not None and before != view and not goes_on
        self.moving = moves
        self.unchanged = 0
        arguments = ", ".join(json.dumps(value) for value in (view.query(), push, self.home))
        ui.run_javascript(f"skysimHistory.write({arguments})")

    def end_step(self) -> None:
        """Make the next change of attitude a step of its own, because another action makes it."""
        self.write()
        self.moving = False

    def undo(self) -> None:
        ui.run_javascript("skysimHistory.undo()")

    def redo(self) -> None:
        ui.run_javascript("skysimHistory.redo()")

    def adopt(self) -> None:
        """Take the page's view as the one that is already in the address."""
        self.written = self.page.state
        self.moving = False

    async def asked(self, event: Any) -> None:
        """Show the view after the browser has gone to another address of this page; if to several, the newest one."""
        self.pending = str(event.args)
        if self.showing:
            return
        self.showing = True
        try:
            while self.pending is not None:
                query = self.pending
                self.pending = None
                await self.show_query(query)
                self.adopt()
        finally:
            self.showing = False
