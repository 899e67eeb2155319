"""Garbage collection of the server, while no page gets a frame."""

from __future__ import annotations

import asyncio
import ctypes
import gc
import time

from skysim.apps.gui.views.served import FRAMES

THRESHOLDS = (
    2_000,
    10,
    1_000,
)  # new objects until a collection, and collections until one of older objects
QUIET_S = 1.0  # after a page was closed, and without a new frame on any page, before closed pages are collected
PATIENCE_S = 60.0  # after which they are collected although frames follow one another


def freeze() -> None:
    """Take what was imported out of the garbage collector's sight, and let it look at new objects alone.

    A collection of all pages takes half a second with 20 of them, in which no key is answered. Only `ClosedPages`
    makes one.
    """
    gc.collect()
    gc.freeze()
    gc.set_threshold(*THRESHOLDS)


def release_memory() -> None:
    """Collect closed pages, and return their memory to the system; glibc's allocator would keep it."""
    gc.collect()
    trim = getattr(ctypes.CDLL(None), "malloc_trim", None)
    if trim:
        trim(0)


class ClosedPages:
    """Collects closed pages, many at once if many were closed, while no page gets a frame, or PATIENCE_S later."""

    def __init__(self) -> None:
        self.waiting: asyncio.Task[None] | None = None

    def collect_soon(self) -> None:
        """Collect when the pages are quiet."""
        if self.waiting is None:
            self.waiting = asyncio.create_task(self.collect())

    async def collect(self) -> None:
        end_s = time.monotonic() + PATIENCE_S
        await asyncio.sleep(QUIET_S)
        while (now_s := time.monotonic()) < end_s and now_s - last_frame_s() < QUIET_S:
            await asyncio.sleep(QUIET_S)
        self.waiting = None  # a page that is closed from now on needs another collection
        await asyncio.to_thread(release_memory)


def last_frame_s() -> float:
    """When a page got a frame last, by `time.monotonic`; minus infinity before the first."""
    return max((frames.added_s for frames in FRAMES.values()), default=-float("inf"))
