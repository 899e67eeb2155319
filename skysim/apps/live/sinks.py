"""Sinks of a live flight: a folder, a pipe, or a client.

Each writes in its own thread behind a short queue and never delays the simulation: packets that do not fit into the
queue are dropped and counted.
"""

from __future__ import annotations

import functools
import sys
import threading
from collections import Counter, deque
from collections.abc import Callable, Collection
from pathlib import Path
from typing import Any, BinaryIO, Protocol

import cv2
import numpy as np
from numpy.typing import NDArray

from skysim.apps.live.packets import Packet
from skysim.core import files
from skysim.core.errors import InputError, printable

MOST_FRAMES = 3  # frames in the queue of a sink, with the one that it writes
MOST_VALUES = 1000  # packets of other channels in it
CLOSE_TIMEOUT_S = 5.0  # time for a sink to write its queued packets at the end
READER_GONE = "the reader has closed the pipe"


class Output(Protocol):
    """Where a live flight sends its packets.

    Attributes
    ----------
    name
        Its option, without dashes
    channels
        What it takes now
    fault
        Error that stopped it, or ""
    """

    name: str
    fault: str

    @property
    def channels(self) -> Collection[str]: ...

    def offer(self, packet: Packet, patient: bool) -> None:
        """Take a packet; wait for room if `patient`."""
        ...

    def close(self) -> None:
        """Send what is left, and end."""
        ...

    def counters(self) -> dict[str, Any]:
        """What was sent and dropped."""
        ...


class Sink:
    """A thread that passes packets to `write`, oldest first. The attributes are those of `Output`, and

    Attributes
    ----------
    sent, dropped
        Numbers of packets so far, by channel
    """

    def __init__(
        self,
        name: str,
        write: Callable[[Packet], None],
        channels: Collection[str] = ("frame",),
    ) -> None:
        self.name = name
        self.write = write
        self.channels = channels
        self.fault = ""
        self.sent: Counter[str] = Counter()
        self.dropped: Counter[str] = Counter()
        self.packets: deque[Packet] = deque()
        self.ends = False
        self.changed = threading.Condition()
        self.thread = threading.Thread(target=self.run, name=f"sink {name}", daemon=True)
        self.thread.start()

    def run(self) -> None:
        """Body of the thread: pass packets on until the end, or until `write` fails."""
        while True:
            with self.changed:
                self.changed.wait_for(lambda: self.packets or self.ends)
                if not self.packets:
                    return
                # It stays in the queue while it is written.
                packet = self.packets[0]
            fault = self.fault_of_writing(packet)
            with self.changed:
                self.fault = fault
                self.changed.notify_all()
                # What a failed sink keeps is counted at its end.
                if fault or not self.packets:
                    return
                self.sent[packet.channel] += 1
                self.packets.popleft()

    def fault_of_writing(self, packet: Packet) -> str:
        """Write a packet; return the error, or ""."""
        try:
            self.write(packet)
        except BrokenPipeError:
            return READER_GONE
        except OSError as error:
            reason = error.strerror or str(error)
            return f"{error.filename}: {reason}" if error.filename else reason
        # A dead thread without `fault` would block a patient offer() for ever.
        except Exception as error:
            return printable(f"{type(error).__name__}: {error}")
        return ""

    def has_room(self, is_frame: bool) -> bool:
        """Whether the queue takes another frame, or another packet of the other channels."""
        queued = sum((one.channel == "frame") == is_frame for one in self.packets)
        return queued < (MOST_FRAMES if is_frame else MOST_VALUES)

    def offer(self, packet: Packet, patient: bool) -> None:
        """Queue a packet. If the queue is full, wait if `patient`, else drop the packet."""
        is_frame = packet.channel == "frame"
        with self.changed:
            if patient:
                self.changed.wait_for(lambda: self.fault or self.has_room(is_frame))
            if self.fault or not self.has_room(is_frame):
                self.dropped[packet.channel] += 1
                return
            if is_frame:
                # The header's count includes frames dropped by this sink.
                dropped = packet.header["dropped"] + self.dropped["frame"]
                packet = packet._replace(header=packet.header | {"dropped": dropped})
            self.packets.append(packet)
            self.changed.notify_all()

    def close(self) -> None:
        """End the thread after its queued packets, within CLOSE_TIMEOUT_S; count what is left as dropped."""
        with self.changed:
            self.ends = True
            self.changed.notify_all()
        self.thread.join(CLOSE_TIMEOUT_S)
        with self.changed:
            # What is still queued is lost.
            self.dropped.update(one.channel for one in self.packets)
            self.packets.clear()

    def counters(self) -> dict[str, Any]:
        return {"sent": dict(self.sent), "dropped": dict(self.dropped), "fault": self.fault}


def folder_writer(path: Path) -> Callable[[Packet], None]:
    """Return a function that writes frame_NNNNNN.png (16 bits; else .raw) and frame_NNNNNN.json with header and truth.

    The .json is written last and atomically, so that a reader may wait for it. Raises InputError if the folder holds
    frames of an earlier flight.
    """
    files.make_folder(path)
    if any(path.glob("frame_*.json")):
        raise InputError(path, "holds frames of an earlier flight", "an empty folder")

    def write(packet: Packet) -> None:
        stem = path / f"frame_{packet.header['index']:06d}"
        if packet.pixels.dtype == np.uint16:
            files.write_bytes(stem.with_suffix(".png"), encode_png(packet.pixels))
        else:
            files.write_bytes(stem.with_suffix(".raw"), packet.pixels.tobytes())
        files.write_text(stem.with_suffix(".json"), files.to_json(packet.header_with_truth))

    return write


def encode_png(pixels: NDArray[Any]) -> bytes:
    """Encode the pixels as PNG at the lowest compression level, for speed."""
    return bytes(cv2.imencode(".png", pixels, [cv2.IMWRITE_PNG_COMPRESSION, 1])[1])


def pipe_writer(path: str) -> Callable[[Packet], None]:
    """Return a function that writes packets, as `unpack` reads them, to standard output (-) or a named pipe.

    The pipe is opened at the first packet, which blocks until a reader opens it. Raises InputError if it is not a pipe.
    """
    if path != "-" and not Path(path).is_fifo():
        raise InputError(f"--pipe {path}", "not a named pipe", "- or a pipe made by mkfifo")

    @functools.cache
    def stream() -> BinaryIO:
        return sys.stdout.buffer if path == "-" else Path(path).open("wb")

    def write(packet: Packet) -> None:
        stream().write(packet.pack())
        stream().flush()

    return write
