"""The page for its parts: its state, the requests to its worker, and what its parts ask of it.

`page.tab.Tab` adds the elements and the rest of the actions; no part imports it.

`PageView` is what a page shows, as one value that an address can hold. Reload, back, a shared link, undo and redo
all read a `PageView` from the page's address and show it again.
"""

from __future__ import annotations

import asyncio
import math
import time
from collections.abc import Callable, Collection, Mapping
from dataclasses import field, replace
from pathlib import Path
from typing import Any, Literal, get_args
from urllib.parse import parse_qsl, urlencode

from nicegui import run, ui

from skysim.apps.gui.messages import FrameView, SceneInfo, Triple
from skysim.apps.gui.views import widgets
from skysim.apps.gui.views.sensor import SensorView
from skysim.apps.gui.worker.photo import Photo
from skysim.apps.gui.worker.session import Session, WorkerLost
from skysim.core.errors import InputError
from skysim.core.types import Record, frozen
from skysim.core.yaml_reader import OverrideTexts
from skysim.simulation.lab import MAIN


class PageContext:
    """The page for its parts: its contents, requests to its worker, and notifications.

    If a request fails, the error is shown in the page header, and the result is None or False.

    Attributes
    ----------
    id, user
        The browser's tab, and the browser, by `server.user_of`
    folder, out
        Folder in which scenes are saved, and that of the studies
    session
        Its worker, once it has one
    editing
        Lock that is held while the scene is changed
    state
        View of the page, which its address contains
    scene_info
        Facts about the open scene; None before one is open
    view
        Newest frame of the scene; None before the first
    message_text
        Message in the page header
    is_open
        Whether the browser still has the page
    message, busy, latency, identifying
        Elements of the page header: the message, the mark of a long task, the time of the last frame, and the switch
        whether every frame is solved
    sensor, tabs
        Sensor view, and tabs of the panels
    contents
        Contents of the fields that change with every frame
    log
        Function that adds a line to the log
    end_step
        Function that makes the next change a step of its own for undo
    derived
        For each part that shows something derived from the page's view: a function that returns what it is derived
        from, and one that empties the part
    """

    id: str
    user: str
    folder: Path
    out: Path
    session: Session
    editing: asyncio.Lock
    state: PageView
    scene_info: SceneInfo | None = None
    view: FrameView | None = None
    is_open = True
    restarting = False
    message_text = ""
    message: ui.label
    busy: ui.icon
    latency: widgets.LiveText
    identifying: ui.switch
    sensor: SensorView
    tabs: ui.tabs
    contents: widgets.Contents
    log: Callable[[str], None]
    end_step: Callable[[], None]
    derived: list[tuple[Callable[[PageView], object], Callable[[], None]]]

    @property
    def solving(self) -> bool:
        """Whether every frame is solved."""
        return bool(self.identifying.value)

    # Requests to the worker.

    async def ask(self, task: str, *arguments: Any) -> Any:
        """Result of a task of the worker; None after an error, which is shown, or if the tab has been closed.

        A worker that has ended is replaced, and the task is done by the new one.
        """
        try:
            result = await self.session.run(task, *arguments)
        except InputError as error:
            if self.is_open:
                self.show_message(widgets.for_page(error))
            return None
        except WorkerLost as error:
            if self.is_open and not self.restarting:
                self.restarting = True
                self.show_message(f"{error}; a new one shows the view again")
                try:
                    await self.restart()
                    # A worker that its task ends is not started a third time.
                    return await self.ask(task, *arguments)
                finally:
                    self.restarting = False
            return None
        return result if self.is_open else None

    async def run_here(self, function: Callable[..., Any], *arguments: Any) -> Any:
        """Result of a function that runs in a thread of the server; None after an error, which is shown."""
        try:
            return await run.io_bound(function, *arguments)
        except InputError as error:
            self.show_message(widgets.for_page(error))
            return None

    async def run_task(self, task: str, *arguments: Any, activity: str = "") -> Any:
        """Run a task as `ask` does, while the page is marked as busy.

        Parameters
        ----------
        activity
            Message until the task ends; it replaces an older one
        """
        self.show_message(activity, "quiet")
        self.busy.set_visibility(True)
        try:
            return await self.ask(task, *arguments)
        finally:
            if self.is_open:
                self.busy.set_visibility(False)
                if activity and self.message_text == activity:
                    self.show_message("")

    async def show_live(
        self, task: str, *arguments: Any, solve: bool = False
    ) -> FrameView | None:
        """Show the frame of the live scene that a task renders, and return it; None after an error or a closed tab.

        Parameters
        ----------
        solve
            Whether it is solved even if not every frame is
        """
        begin = time.perf_counter()
        # Angles that are set are no part of a movement by keys or the pointer, before or after.
        is_step = task == "point"
        if is_step:
            self.end_step()
        view = await self.ask(task, *arguments, solve or self.solving)
        if view is not None:
            self.latency.set_text(f"{1e3 * (time.perf_counter() - begin):.0f} ms")
            self.show_frame(view, kind="live", angles_deg=view.angles_deg)
            if is_step:
                self.end_step()
        return view

    async def restart(self) -> None:
        """Show the view again with a new worker after the old one has ended."""

    async def open(
        self,
        scene: str,
        overrides: OverrideTexts | None = None,
        angles_deg: Triple | None = None,
        head: str = MAIN,
    ) -> bool:
        """Set up a scene and show a first frame, at its start or at other angles; keep the old scene if that fails."""
        raise NotImplementedError

    async def apply_overrides(
        self, overrides: OverrideTexts, dropped: Collection[str] = ()
    ) -> None:
        """Reopen the scene with further overrides and without some; concurrent edits are done one after another."""
        async with self.editing:
            kept = {
                key: text for key, text in self.state.overrides.items() if key not in dropped
            }
            await self.open(self.state.scene, {**kept, **overrides}, head=self.state.head)

    # Notifications.

    def show_message(self, text: str, color: str = "warn") -> None:
        """Show a message in the page header until the next action; warnings are also logged."""
        if text == self.message_text:
            return
        self.message_text = text
        self.message.props["title"] = text  # tooltip with the full text
        self.message.set_text(text)
        self.message.classes(remove="good warn quiet", add=color)
        if text and color == "warn":
            self.log(text)

    def show_panel(self, name: str) -> None:
        """Open a panel by its name."""
        self.tabs.set_value(name)

    def derive(self, source: Callable[[PageView], object], empty: Callable[[], None]) -> None:
        """Empty a part of the page whenever the view has another source, so that it never shows a former one's data."""
        self.derived.append((source, empty))

    def set_state(self, **changes: Any) -> None:
        """Change fields of `state`, and empty the parts whose source is another one. A scene that is opened is new."""
        before = self.state
        self.state = replace(before, **changes)
        for source, empty in self.derived:
            if "scene" in changes or source(before) != source(self.state):
                empty()

    def show_frame(self, view: FrameView, **state: Any) -> None:
        """Show a frame of the scene in all views.

        Parameters
        ----------
        state
            Changes of `state` that belong to the frame
        """

    def show_photo(self, photo: Photo, /, **state: Any) -> None:
        """Show an image that is not of the current scene: a photograph, or a replayed trial.

        Parameters
        ----------
        state
            Changes of `state` that belong to the image
        """

    def stop_playback(self) -> None:
        """Stop playback, a pushed vehicle and the live camera before something else is shown."""


Kind = Literal["live", "flight", "replay", "photo"]
KINDS: tuple[Kind, ...] = get_args(Kind)
# Keys of an address
KEYS = ("scene", "set", "view", "at", "t", "study", "trial", "photo", "head", "token")


@frozen
class PageView:
    """The view of a page.

    Attributes
    ----------
    scene, overrides
        The scene and the keys that differ from its file
    kind
        Live scene at rest, a moment of its flight, a replayed trial of a study, or an image that
        is not of the scene
    angles_deg
        Attitude of the live scene; None: the scene's own start
    t_s
        Beginning of the shown frame of a flight
    study, trial
        Folder of the study in the Monte Carlo panel, and the trial that is replayed
    photo
        Name of the image that is not of the scene
    head
        Name of the scene's camera that is shown
    """

    scene: str
    overrides: Mapping[str, str] = field(default_factory=dict)
    kind: Kind = "live"
    angles_deg: Triple | None = None
    t_s: float = 0.0
    study: str = ""
    trial: int = -1
    photo: str = ""
    head: str = MAIN

    @property
    def name(self) -> str:
        """The scene with its overrides, and the camera if it is a further one."""
        camera = [f"camera {self.head}"] * (self.head != MAIN)
        overrides = map("=".join, self.overrides.items())
        return ", ".join((Path(self.scene).stem, *overrides, *camera))

    @property
    def opened(self) -> tuple[str, Mapping[str, str]]:
        """The scene and its overrides."""
        return self.scene, self.overrides

    @property
    def image(self) -> object:
        """What the image on the page is of: the scene, or else a photograph or the trial of a study."""
        other = self.study, self.trial, self.photo
        return self.opened if self.kind in ("live", "flight") else (self.kind, *other)

    def query(self) -> str:
        """The view as the query of an address, without default values."""
        pairs = [
            ("scene", self.scene),
            *(("set", f"{key}={value}") for key, value in self.overrides.items()),
        ]
        at = ",".join(f"{angle:.6f}" for angle in self.angles_deg or ())
        optional = (
            ("view", self.kind if self.kind != "live" else ""),
            ("at", at),
            ("t", f"{self.t_s:.4f}" if self.kind == "flight" else ""),
            ("study", self.study),
            ("trial", str(self.trial) if self.kind == "replay" else ""),
            ("photo", self.photo if self.kind == "photo" else ""),
            ("head", self.head if self.head != MAIN else ""),
        )
        return "?" + urlencode(pairs + [pair for pair in optional if pair[1]])

    @classmethod
    def from_query(cls, query: str, scenes: Collection[str]) -> PageView | None:
        """The view that an address names; None if it names none.

        Parameters
        ----------
        scenes
            Scenes that the page offers; an address can open no other file

        Raises
        ------
        InputError
            For an address with other scenes or invalid values.
        """
        pairs = parse_qsl(query.removeprefix("?"))
        one: Record = dict(pairs)
        for key in one:
            if key not in KEYS:
                raise InputError("link", f"key {key!r}", ", ".join(KEYS))
        if "scene" not in one:
            return None
        if one["scene"] not in scenes:
            raise InputError(
                "link",
                f"scene {one['scene']!r} is not offered here; choose one from the list",
            )
        kind = one.get("view", "live")
        if kind not in KINDS:
            raise InputError("link", f"view {kind!r}", ", ".join(KINDS))
        try:
            angles = tuple(map(float, one["at"].split(","))) if "at" in one else None
            t_s = float(one.get("t", 0))
            trial = int(one.get("trial", -1))
        except ValueError:
            raise InputError("link", "at, t, trial", "numbers") from None
        if not all(map(math.isfinite, (*(angles or ()), t_s))) or (
            angles and len(angles) != 3
        ):
            raise InputError("link", "at", "three angles in degrees; t: seconds")
        overrides = dict(value.partition("=")[::2] for key, value in pairs if key == "set")
        study = one.get("study", "")
        names = one.get("photo", ""), one.get("head", MAIN)
        return cls(one["scene"], overrides, kind, angles, t_s, study, trial, *names)  # type: ignore[arg-type]

    def same_step(self, other: PageView) -> bool:
        """Whether only attitude or time differ, which change continuously."""
        return self == replace(other, angles_deg=self.angles_deg, t_s=self.t_s)

    @property
    def banner(self) -> str:
        """The view in words."""
        return {
            "live": "live",
            "flight": f"flight at {self.t_s:.2f} s",
            "replay": f"trial {self.trial} of {self.study}",
            "photo": f"image {self.photo}",
        }[self.kind]
