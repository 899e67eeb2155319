"""Where frames go: a folder, a pipe. Each has a thread of its own and never holds up the scene: what it cannot take in
time is left out and counted."""

from __future__ import annotations

import contextlib
import functools
import queue
import sys
import threading
import time
from collections.abc import Callable
from pathlib import Path
from typing import BinaryIO

import cv2
import numpy as np

from skysim.apps.stream.packet import Packet
from skysim.core import files
from skysim.core.errors import InputError, printable

WAITING = 2  # packets that may wait for a sink
GRACE_S = 5.0  # for what still waits at the end
GONE = "its reader is gone"


class Sink:
    """A thread that hands packets on, the oldest first.

    sent, dropped : so far;  fault : why it takes no more
    """

    def __init__(self, name: str, take: Callable[[Packet], None]) -> None:
        self.name, self.take = name, take
        self.sent = self.dropped = 0
        self.busy = False  # with a packet that is neither sent nor left out as yet
        self.fault = ""
        self.waiting: queue.Queue[Packet | None] = queue.Queue(WAITING)
        self.thread = threading.Thread(target=self.work, name=f"sink {name}", daemon=True)
        self.thread.start()

    def work(self) -> None:
        """Until None comes, or what takes the packets is gone."""
        while (packet := self.waiting.get()) is not None:
            self.busy = True
            try:
                self.take(packet)
            except BrokenPipeError:
                self.fault = GONE
            except OSError as error:
                file = f"{error.filename}: " if error.filename else ""
                self.fault = file + (error.strerror or str(error))
            except Exception as error:  # whatever it is, who offers packets must not wait for us for ever
                self.fault = printable(f"{type(error).__name__}: {error}")
            if self.fault:
                self.dropped += 1
            else:
                self.sent += 1
            self.busy = False
            if self.fault:
                return

    def offer(self, packet: Packet, patient: bool) -> None:
        """Take a packet, or leave it out if too many wait; patient: wait instead."""
        packet = packet.after(self.dropped)
        while not self.fault:
            try:
                self.waiting.put(packet, timeout=0.1 if patient else 0.0001)
                return
            except queue.Full:
                if not patient:
                    break
        self.dropped += 1

    def close(self) -> None:
        """Let it finish what waits."""
        until = time.monotonic() + GRACE_S
        while self.thread.is_alive() and time.monotonic() < until:
            with contextlib.suppress(queue.Full):
                self.waiting.put(None, timeout=0.1)
                break
        self.thread.join(max(until - time.monotonic(), 0.0))
        with contextlib.suppress(queue.Empty):  # nobody takes what still waits
            while True:
                self.dropped += self.waiting.get_nowait() is not None
        self.dropped += self.busy  # of one that still holds a packet we wait no longer


def folder(path: Path) -> Callable[[Packet], None]:
    """frame_NNNNNN.png (16 bits) and .json beside it with header and truth; the .json comes last, and whole."""
    files.make_folder(path)
    if any(path.glob("frame_*.json")):
        raise InputError(f"{path}: frames of an earlier stream are there; allowed: an empty folder")

    def take(packet: Packet) -> None:
        stem = path / f"frame_{packet.header['index']:06d}"
        if packet.pixels.dtype == np.uint16:
            files.write_bytes(stem.with_suffix(".png"), png(packet))
        else:
            files.write_bytes(stem.with_suffix(".raw"), packet.pixels.tobytes())
        files.write_text(stem.with_suffix(".json"), files.to_json({**packet.header, "truth": packet.truth}))

    return take


def png(packet: Packet) -> bytes:
    """Packed with little effort: a frame is due soon again."""
    return bytes(cv2.imencode(".png", packet.pixels, [cv2.IMWRITE_PNG_COMPRESSION, 1])[1])


def pipe(path: str) -> Callable[[Packet], None]:
    """Packets as `packet.unpack` reads them, to standard output (-) or a named pipe, opened when a reader does."""
    if path != "-" and not Path(path).is_fifo():
        raise InputError(f"--pipe {path}: no named pipe; allowed: - or what mkfifo made")

    @functools.cache
    def end() -> BinaryIO:
        return sys.stdout.buffer if path == "-" else Path(path).open("wb")

    def take(packet: Packet) -> None:
        end().write(packet.pack())
        end().flush()

    return take
