"""Overlay of a frame: its marks and their places in the frame's pixels. Each kind can be switched off."""

from __future__ import annotations

import asyncio
import math
import struct
import time
from collections.abc import AsyncIterator, Callable, Collection, Mapping
from dataclasses import dataclass, field
from itertools import compress
from typing import Any, TypeVar

import numpy as np
from nicegui import json

from skysim.apps.gui.messages import (
    LIMITS,
    Display,
    LightName,
    Lights,
    Pixels,
    TrackerResult,
    places_px,
)
from skysim.apps.gui.worker.session import Session, WorkerLost
from skysim.core.errors import InputError
from skysim.core.paths import DATA
from skysim.core.types import Bools, Floats, Record, frozen
from skysim.core.yaml_reader import read_yaml
from skysim.results.plots import CURVES

COLORS = {
    "truth": "#7a8cff",
    "detected": "#dd5a60",
    "identified": "#6ff0d8",
    "false": "#e8b90f",
    "windows": "#7f8a9a",
    "residuals": "#70c0f0",
}
KINDS = tuple(COLORS)
KIND_BY_MARK = {kind: kind for kind in KINDS} | {"faint": "truth"}
MAX_LABELS = 40  # maximum number of names; the brightest lights have them
MAX_TRUTH_MARKS = 400  # maximum number of marks of true lights
UNSOLVED_TICKS = 60  # number of brightest true lights with marks in a frame without detections; fainter ones are dots
# Proper names of bright stars by Hipparcos number.
NAMES: dict[Any, str] = read_yaml(DATA / "star_names.yaml")[0]
NEAR_PX = 4.0  # a detection within this distance of a true light is not false

T = TypeVar("T")
Points = list[list[float]]  # rounded to a tenth of a pixel, for a short message


def marks(
    lights: Lights, result: TrackerResult | None, shown: Collection[str], name: LightName
) -> Record:
    """Return the marks for frame.js.

    Returns
    -------
    marks
        Places by kind: ticks for true lights, dots for those fainter than any identified one, squares for
        detections, circles for identified ones, crosses for false ones, dashed squares for predicted windows
    names
        (x, y, name) of identified lights
    lights
        (x, y, number or -1, whether it is a detection) of all lights that the cursor may find, detections last
    residuals
        (x, y, along x, along y) of identified lights: detected minus predicted
    """
    detections = result.detections if result else ()
    ids = [one.id for one in detections]
    found_px = places_px(detections)
    is_identified = np.array(ids, np.int64) >= 0
    visible = lights[:MAX_TRUTH_MARKS]
    offset_px = np.abs(
        lights.xy_px[:, None] - found_px
    )  # of each true light and each detection
    near = np.all(offset_px < NEAR_PX, axis=2)
    bright = bright_count(visible, ids, near[: len(visible)])
    is_false = ~np.any(near, axis=0) & bool(
        len(lights)
    )  # without true lights it is not known
    true = rounded(visible.xy_px)
    found = rounded(found_px)
    points: Mapping[str, Points] = {
        "windows": rounded(np.array(result.windows_px).reshape(-1, 2)) if result else [],
        "truth": true[:bright],
        "faint": true[bright:],
        "detected": found,
        "identified": list(compress(found, is_identified)),
        "false": list(compress(found, is_false)),
    }
    true_lights = [(*at, id, 0) for at, id in zip(true, visible.id.tolist(), strict=True)]
    detected_lights = [(*at, id, 1) for at, id in zip(found, ids, strict=True)]
    named = list(compress(zip(found, ids, strict=True), is_identified))[:MAX_LABELS]
    return {
        "marks": [
            {"kind": drawn, "color": COLORS[kind], "points": points[drawn]}
            for drawn, kind in KIND_BY_MARK.items()
            if kind in shown and points.get(drawn)
        ],
        "names": [(*place, name(id)) for place, id in named] if "identified" in shown else [],
        "lights": true_lights + detected_lights,
        "residuals": [
            (one.x, one.y, *one.residual_px)
            for one in detections
            if one.id >= 0 and "residuals" in shown
        ],
    }


def bright_count(lights: Lights, identified: Collection[int], near: Bools) -> int:
    """Number of lights that are at least as bright as the faintest identified one, or else the faintest detected one.

    Detected ones alone are no measure: in a field of hundreds of faint stars, noise is detected beside some of them.

    Parameters
    ----------
    identified
        Number of the light of each detection, or -1
    near
        (lights, detections) whether they are near
    """
    if not len(identified) or not len(lights):
        return UNSOLVED_TICKS
    numbers = [id for id in identified if id >= 0]
    seen = np.isin(lights.id, numbers) if numbers else near.any(axis=1)
    return int(np.flatnonzero(seen)[-1]) + 1 if seen.any() else 0


def rounded(xy_px: Floats) -> Points:
    return np.round(xy_px, 1).tolist()


# A frame for the browser: its pixels, and the marks and texts that are drawn with them.


MAX_SCREEN_PX = 10**5
KEPT_FRAMES = 5
FRAMES: dict[str, TabFrames] = {}  # frames by tab
IDLE_S = 2.0  # time without a frame after which a stream ends: a browser has six connections for all tabs


@frozen
class ServedFrame:
    """A frame of a tab.

    Attributes
    ----------
    fields
        Further data for frame.js: pointing, marks, contents of live fields
    source
        Session of the tab, whose worker has all pixels of its newest images
    """

    pixels: Pixels
    fields: Mapping[str, Any]
    source: Session

    async def response(self, display: Display, whole: bool) -> bytes | None:
        """Header, pixels, fields as JSON, and the length of the fields as an unsigned integer of 32 bits.

        So a frame comes with its marks, and little is sent over the websocket, whose messages are compiled as code.
        The result is None if pixels are missing and the worker only has newer images.

        Parameters
        ----------
        display
            Display for which the worker makes the next frames
        whole
            Whether all pixels of this frame are needed
        """
        self.source.display = display
        pixels = self.pixels
        needs_all = whole or not all(display.screen_px)
        if needs_all if pixels.fields["shaded"] else pixels.display.limits != display.limits:
            try:
                pixels = await self.source.run("all_pixels", pixels.number, display)
            except (WorkerLost, InputError):
                return None
            if pixels is None:
                return None
        text = json.dumps({**self.fields, **pixels.fields}).encode()
        return b"".join((pixels.data, text, len(text).to_bytes(4, "little")))


@dataclass
class TabFrames:
    """The newest frames of a tab, and the stream that sends them to its browser while they follow one another.

    A stream is one response for many frames: a request for each would take a fifth of the time that a frame may take.

    Attributes
    ----------
    announce
        Function that sends the number of a frame to the browser, which then requests the frame
    newest
        Newest frames by number
    waiting
        Numbers of the frames to be sent over the stream; None if no stream is open
    drawn
        Number of the last frame that the browser has drawn
    alone
        Number of the last frame outside the stream, which later ones must not overtake
    added_s
        Time at which the newest frame was added, by `time.monotonic`
    """

    announce: Callable[[int], Any]
    newest: dict[int, ServedFrame] = field(default_factory=dict)
    waiting: asyncio.Queue[int] | None = None
    drawn: int = 0
    alone: int = 0
    added_s: float = -math.inf

    def add(self, number: int, frame: ServedFrame, alone: bool) -> None:
        """Keep a frame and send it, or its number.

        Parameters
        ----------
        alone
            Whether the frame is sent outside the stream, because messages belong to it
        """
        self.newest[number] = frame
        self.added_s = time.monotonic()
        self.newest.pop(number - KEPT_FRAMES, None)
        self.alone = number if alone else self.alone
        if self.waiting is None or self.drawn < self.alone:
            self.announce(number)
        else:
            self.waiting.put_nowait(number)

    async def stream(self, display: Display) -> AsyncIterator[bytes]:
        """Frames as they come, until there is none for a while: length and number as unsigned integers of 32 bits, then
        the frame's response. If there are several streams, only the newest gets the frames.
        """
        waiting = self.waiting = asyncio.Queue[int]()
        try:
            while True:
                number = await asyncio.wait_for(waiting.get(), IDLE_S)
                frame = self.newest.get(number)
                data = (
                    await frame.response(frame.source.display or display, whole=False)
                    if frame
                    else None
                )
                if data is not None:
                    yield struct.pack("<II", len(data), number) + data
        except TimeoutError:
            return
        finally:
            if self.waiting is waiting:
                self.waiting = None
                # The connection was lost before the browser got the frame.
                if self.drawn < max(self.newest, default=0):
                    self.announce(max(self.newest))


def display_of(query: Mapping[str, str]) -> Display | None:
    """The display of a browser's query; None if the query has a value that is not allowed.

    Returns
    -------
    screen
        Width and height
    near
        Column and row
    limits
        A name or two finite values in DN, the lower one first
    curve
        A name
    """
    try:
        screen_px = two(int, query.get("screen", "0,0"))
        near_px = two(int, query["near"]) if query.get("near") else None
        limits: Any = query.get("limits", LIMITS[0])
        if limits not in LIMITS:
            limits = two(float, limits)
    except ValueError:
        return None
    curve = query.get("curve", next(iter(CURVES)))
    is_allowed = (
        all(0 <= px <= MAX_SCREEN_PX for px in (*screen_px, *(near_px or ())))
        and (limits in LIMITS or -math.inf < limits[0] < limits[1] < math.inf)
        and curve in CURVES
    )
    return Display(screen_px, limits, curve, near_px) if is_allowed else None


def two(kind: Callable[[str], T], text: str) -> tuple[T, T]:
    """Two numbers separated by a comma. Raises ValueError."""
    first, second = map(kind, text.split(","))
    return first, second
