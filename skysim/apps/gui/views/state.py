"""The state of a page: what it shows, as one value that an address can hold.

Reload, back, a shared link, undo and redo all read a `PageView` from the page's address and show it again.
"""

from __future__ import annotations

import math
from collections.abc import Collection, Mapping
from dataclasses import field, replace
from typing import Literal, get_args
from urllib.parse import parse_qsl, urlencode

from skysim.apps.gui.messages import Triple
from skysim.core.errors import InputError
from skysim.core.types import Record, frozen

Kind = Literal["live", "flight", "replay", "photo"]
KINDS: tuple[Kind, ...] = get_args(Kind)


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
    """

    scene: str
    overrides: Mapping[str, str] = field(default_factory=dict)
    kind: Kind = "live"
    angles_deg: Triple | None = None
    t_s: float = 0.0
    study: str = ""
    trial: int = -1
    photo: str = ""

    @property
    def opened(self) -> tuple[str, Mapping[str, str]]:
        """The scene and its overrides."""
        return self.scene, self.overrides

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
        photo = one.get("photo", "")
        return cls(one["scene"], overrides, kind, angles, t_s, study, trial, photo)  # type: ignore[arg-type]

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
