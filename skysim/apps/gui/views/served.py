"""A frame as the browser gets it: its pixels, then marks and texts that are drawn with them."""

from __future__ import annotations

import asyncio
import math
import struct
import time
from collections.abc import AsyncIterator, Callable, Mapping
from dataclasses import dataclass, field
from typing import Any, Protocol

from nicegui import json

from skysim.apps.gui.messages import LIMITS, Display, Pixels
from skysim.apps.gui.worker.session import WorkerLost
from skysim.core.errors import InputError
from skysim.results.annotate import CURVES

MAX_SCREEN_PX = 10**5
KEPT_FRAMES = 5
FRAMES: dict[str, TabFrames] = {}  # by tab
IDLE_S = 2.0  # without a frame, after which a stream ends: a browser has six connections for all of its tabs


class Source(Protocol):
    """The session of the tab: the worker has all pixels of its newest images."""

    display: Display | None

    async def run(self, task: str, *arguments: Any) -> Any:
        """Run a task of the worker."""


@dataclass(frozen=True)
class ServedFrame:
    """A frame of a tab.

    fields : what frame.js needs beside the pixels: pointing, marks, contents of live fields
    """

    pixels: Pixels
    fields: Mapping[str, Any]
    source: Source

    async def response(self, display: Display, whole: bool) -> bytes | None:
        """Header, pixels, fields as JSON, and the length of these as an unsigned integer of 32 bits. So a frame comes
        with its marks, and little goes over the websocket, whose messages are compiled as code.

        display : for which the worker makes the next frames;  whole : whether all pixels of this one are needed

        None if pixels are missing, and the worker has newer images.
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
    """The newest frames of a tab, and the stream over which its browser gets them while they follow one another.

    A stream is one response for many frames: a request for each would take a fifth of the time that a frame may take.

    announce : sends the number of a frame to the browser, which then requests it
    newest : by number;  waiting : numbers of those to be sent over the stream; None: no stream is open
    drawn : number of the last frame that the browser has drawn
    alone : of the last one that did not go over the stream, which later ones must not overtake
    added_s : when the newest one was added, by `time.monotonic`
    """

    announce: Callable[[int], Any]
    newest: dict[int, ServedFrame] = field(default_factory=dict)
    waiting: asyncio.Queue[int] | None = None
    drawn: int = 0
    alone: int = 0
    added_s: float = -math.inf

    def add(self, number: int, frame: ServedFrame, alone: bool) -> None:
        """Keep a frame and send it, or its number. alone : not over the stream, because messages belong to it"""
        self.newest[number] = frame
        self.added_s = time.monotonic()
        self.newest.pop(min(self.newest) if len(self.newest) > KEPT_FRAMES else -1, None)
        self.alone = number if alone else self.alone
        if self.waiting is None or self.drawn < self.alone:
            self.announce(number)
        else:
            self.waiting.put_nowait(number)

    async def stream(self, display: Display) -> AsyncIterator[bytes]:
        """Frames as they come, until there is none for a while: length and number as unsigned integers of 32 bits, then
        the frame's response. Of several streams the newest gets the frames.
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
                if self.drawn < max(
                    self.newest, default=0
                ):  # the connection was lost before the browser got it
                    self.announce(max(self.newest))


def display_of(query: Mapping[str, str]) -> Display | None:
    """The display that a browser asks for; None if the query has a value that is not allowed.

    screen : width and height;  near : column and row;  limits : a name or two values in DN;  curve : a name
    """
    try:
        screen_px = pair(query.get("screen", "0,0"))
        near_px = pair(query["near"]) if query.get("near") else None
        limits = limits_from(query.get("limits", LIMITS[0]))
        curve = query.get("curve", next(iter(CURVES)))
    except ValueError:
        return None
    return Display(screen_px, limits, curve, near_px) if limits and curve in CURVES else None


def pair(text: str) -> tuple[int, int]:
    """Two numbers of pixels. Raises ValueError."""
    first, second = (int(word) for word in text.split(","))
    if not (0 <= first <= MAX_SCREEN_PX and 0 <= second <= MAX_SCREEN_PX):
        raise ValueError
    return first, second


def limits_from(text: str) -> str | tuple[float, float] | None:
    """Limits by name, or two increasing values; None if they are neither. Raises ValueError."""
    if text in LIMITS:
        return text
    low, high = (float(word) for word in text.split(","))
    return (low, high) if math.isfinite(low) and math.isfinite(high) and low < high else None
