"""Log panel: the events of this session, and a table of the identifications as CSV."""

import time
from collections.abc import MutableMapping
from pathlib import Path
from typing import Any

from nicegui import ui

from skysim.apps.gui.messages import FrameView, SceneInfo
from skysim.apps.gui.views import context, live, widgets

MAX_LINES = 500
MAX_ROWS = 10_000
COLUMNS = (
    "time",
    "scene",
    "noise",
    "detector",
    "identifier",
    "status",
    "detected",
    "identified",
    "true_1_deg",
    "true_2_deg",
    "true_3_deg",
    "found_1_deg",
    "found_2_deg",
    "found_3_deg",
    "cross_arcsec",
    "roll_arcsec",
    "cross_sigma_arcsec",
    "roll_sigma_arcsec",
    "wrong",
)


class LogPanel:
    """The log, newest line first.

    Attributes
    ----------
    kept
        The `lines`, and `rows` of identifications as values of COLUMNS
    """

    def __init__(self, page: context.PageContext) -> None:
        self.page = page
        self.kept: MutableMapping[str, list[Any]] = {"lines": [], "rows": []}
        self.button = widgets.button(
            "CSV of the identifications", self.download, "log-csv", "flat"
        )
        self.button.set_enabled(False)
        self.label = (
            ui.label("Nothing yet.").classes("mono lab-log").props('role="log"').mark("log")
        )

    def add(self, text: str) -> None:
        lines = [f"{time.strftime('%H:%M:%S')}  {text}", *self.kept["lines"]][:MAX_LINES]
        self.kept["lines"] = lines
        self.label.set_text("\n".join(lines))

    def keep(self, storage: MutableMapping[str, list[Any]]) -> None:
        """Go on with the log of the tab's storage, which a reload keeps."""
        for name, now in self.kept.items():
            storage[name] = [*now, *storage.get(name, ())]
        self.kept = storage
        self.label.set_text("\n".join(storage["lines"]))
        self.button.set_enabled(bool(storage["rows"]))

    def identified(self, view: FrameView, info: SceneInfo) -> None:
        """Log an identification with its attitude and error."""
        text, row = identification(view, info)
        self.add(text)
        self.kept["rows"] = [*self.kept["rows"][1 - MAX_ROWS :], row]
        self.button.set_enabled(True)

    def download(self) -> None:
        ui.download(
            live.csv_table(COLUMNS, self.kept["rows"]),
            f"{Path(self.page.state.scene).stem}_log.csv",
        )


def identification(view: FrameView, info: SceneInfo) -> tuple[str, tuple[Any, ...]]:
    """An identification as a line of text, and as values of COLUMNS; None or NaN where there is no solution."""
    assert view.result is not None
    row = view.result.row
    text = f"identify {'with' if info.noise else 'without'} noise: {row.status}"
    if row.estimate_deg is not None:
        angles = "  ".join(
            f"{name} {angle:.4f}°"
            for name, angle in zip(info.names, row.estimate_deg, strict=True)
        )
        text += (
            f", {row.matched} of {row.detected}; {angles}; error {row.cross_arcsec:.2f}″ across,"
            f" {row.roll_arcsec:+.1f}″ about the boresight"
        )
    return text, (
        time.strftime("%H:%M:%S"),
        info.scene.name,
        info.noise,
        info.stages["detector"],
        info.stages["identifier"],
        row.status,
        row.detected,
        row.matched,
        *row.truth_deg,
        *(row.estimate_deg or (None,) * 3),
        row.cross_arcsec,
        row.roll_arcsec,
        row.cross_sigma_arcsec,
        row.roll_sigma_arcsec,
        row.wrong,
    )
