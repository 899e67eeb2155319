"""The interface of the page for its parts. The page implements it; no part imports the page."""

from collections.abc import Callable, Collection
from typing import Any, Protocol

from skysim.apps.gui.messages import FrameView, SceneInfo, Triple
from skysim.apps.gui.views.state import PageView
from skysim.apps.gui.worker.photo import Photo
from skysim.core.yaml_reader import OverrideTexts


class PageContext(Protocol):
    """The page for its parts: its contents, requests to its worker, and notifications.

    If a request fails, the error is shown in the page header, and the result is None or False.

    Attributes
    ----------
    state
        View of the page, which its address contains
    scene_info
        Facts about the open scene; None before one is open
    view
        Newest frame of the scene; None before the first
    message_text
        Message in the page header
    solving
        Whether every frame is solved
    is_open
        Whether the browser still has the page
    """

    state: PageView
    scene_info: SceneInfo | None
    view: FrameView | None
    is_open: bool
    message_text: str

    @property
    def solving(self) -> bool: ...

    # Requests to the worker.

    async def ask(self, task: str, *arguments: Any) -> Any:
        """Return the result of a task."""

    async def run_here(self, function: Callable[..., Any], *arguments: Any) -> Any:
        """Return the result of a function that runs in a thread of the server."""

    async def run_task(self, task: str, *arguments: Any, activity: str = "") -> Any:
        """Run a task as `ask` does, while the page is marked as busy.

        Parameters
        ----------
        activity
            Message until the task ends; it replaces an older one
        """

    async def show_live(self, task: str, *arguments: Any) -> FrameView | None:
        """Show the frame of the live scene that a task renders."""

    async def open(
        self,
        scene: str,
        overrides: OverrideTexts | None = None,
        angles_deg: Triple | None = None,
    ) -> bool:
        """Set up a scene and show a first frame, at its start or at other angles; keep the old scene if that fails."""

    async def apply_overrides(
        self, overrides: OverrideTexts, dropped: Collection[str] = ()
    ) -> None:
        """Reopen the scene with further overrides and without some."""

    # Notifications.

    def show_message(self, text: str, color: str = "warn") -> None:
        """Show a message in the page header until the next action."""

    def log(self, text: str) -> None:
        """Add a line to the log."""

    def set_state(self, **changes: Any) -> None:
        """Change fields of `state`."""

    def show_frame(self, view: FrameView, **state: Any) -> None:
        """Show a frame of the scene in all views.

        Parameters
        ----------
        state
            Changes of `state` that belong to the frame
        """

    def show_photo(self, image: Photo, /, **state: Any) -> None:
        """Show an image that is not of the current scene: a photograph, or a replayed trial.

        Parameters
        ----------
        state
            Changes of `state` that belong to the image
        """

    def stop_playback(self) -> None:
        """Stop playback, a pushed vehicle and the live camera before something else is shown."""

    def show_panel(self, name: str) -> None:
        """Open a panel by its name."""
