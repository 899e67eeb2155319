"""Sinks of a stream: a folder or a pipe.

Each writes in its own thread behind a short queue and never delays the simulation: packets that do not fit into the
queue are dropped and counted.
"""

from __future__ import annotations

import contextlib
import functools
import json
import queue
import re
import sys
import threading
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any, BinaryIO, NamedTuple

import cv2
import numpy as np
from numpy.typing import NDArray

from skysim.core import files
from skysim.core.errors import InputError, printable
from skysim.simulation.flight import Shot

# Wire format of a frame: a header as one line of JSON, then the raw pixels.


# Limits for the reader.
MAX_HEADER_BYTES = 1 << 16
MAX_PIXELS = 1 << 28


class Packet(NamedTuple):
    """A frame to send.

    Attributes
    ----------
    header
        Data that a tracker may use: index, t_s (mid-exposure since the scene's start), exposure_s,
        width, height, dtype (numpy's, little-endian), bytes (of the pixels), due_unix_s and
        made_unix_s (wall-clock times at which the exposure ended and the frame was ready),
        dropped (frames dropped before this one)
    pixels
        (H, W) pixels
    truth
        cam_from_ref_xyzw (scalar last; ref: ICRS or the lab), rate_cam_rad_s, and ids, x_px,
        y_px of the lights on the detector
    """

    header: dict[str, Any]
    pixels: NDArray[Any]
    truth: dict[str, Any]

    @property
    def number(self) -> int:
        """Sequence number among the frames that were rendered."""
        return int(self.header["index"] - self.header["dropped"])

    def plus_dropped(self, missed: int) -> Packet:
        """The same packet for a receiver that missed further frames: its header's `dropped` is that much larger."""
        return self._replace(
            header=self.header | {"dropped": self.header["dropped"] + missed}
        )

    def pack(self) -> bytes:
        """Serialize: the header line, then the pixels row by row from the top."""
        return json.dumps(self.header).encode() + b"\n" + self.pixels.tobytes()


def build_packet(shot: Shot, due_unix_s: float, made_unix_s: float, dropped: int) -> Packet:
    """Make the packet of a shot.

    Parameters
    ----------
    due_unix_s, made_unix_s
        Unix times at which its exposure ended and the frame was ready
    dropped
        Number of frames dropped before it
    """
    frame = shot.frame
    truth = shot.truth
    pixels = np.ascontiguousarray(frame.image_dn, frame.image_dn.dtype.newbyteorder("<"))
    height, width = pixels.shape
    header = {
        "index": frame.index,
        "t_s": frame.t_mid_s,
        "exposure_s": frame.exposure_s,
        "width": width,
        "height": height,
        "dtype": pixels.dtype.str,
        "bytes": pixels.nbytes,
        "due_unix_s": due_unix_s,
        "made_unix_s": made_unix_s,
        "dropped": dropped,
    }
    truth_values = {
        "cam_from_ref_xyzw": truth.cam_from_lab.as_quat().tolist(),
        "mean_cam_from_ref_xyzw": truth.mean_cam_from_lab.as_quat().tolist(),
        "rate_cam_rad_s": truth.rate_cam_rad_s.tolist(),
        "ids": truth.sources.id.tolist(),
        "x_px": truth.sources.xy_px[:, 0].round(4).tolist(),
        "y_px": truth.sources.xy_px[:, 1].round(4).tolist(),
    }
    return Packet(header, pixels, truth_values)


def unpack(stream: BinaryIO) -> tuple[dict[str, Any], NDArray[Any]] | None:
    """Read the next header and its (H, W) pixels; None at the end. Raises InputError for malformed or cut-off data."""
    line = stream.readline(MAX_HEADER_BYTES)
    if not line:
        return None
    try:
        header = json.loads(line)
        shape = (int(header["height"]), int(header["width"]))
        dtype_name = header["dtype"]
        if not re.fullmatch(r"[<>|]?(u[1248]|f[248])", dtype_name):
            raise ValueError(dtype_name)
    except (ValueError, KeyError, TypeError, OverflowError, RecursionError) as error:
        raise InputError("", f"not a packet of skysim stream: {line[:40]!r}") from error
    count = shape[0] * shape[1]
    dtype = np.dtype(dtype_name)
    if min(shape) < 1 or count > MAX_PIXELS:
        raise InputError(
            "", f"not a packet of skysim stream: {shape[1]} x {shape[0]} pixels of {dtype}"
        )
    pixels = stream.read(count * dtype.itemsize)
    if len(pixels) < count * dtype.itemsize:
        raise InputError("", f"the stream ended within frame {header.get('index')}")
    return header, np.frombuffer(pixels, dtype).reshape(shape)


QUEUE_LENGTH = 2  # length of a sink's queue, packets
CLOSE_TIMEOUT_S = 5.0  # time for a sink to write its queued packets at the end
READER_GONE = "the reader has closed the pipe"


class Sink:
    """A thread that passes packets to `write`, oldest first.

    Attributes
    ----------
    sent, dropped
        Numbers of packets so far
    fault
        Error that stopped it, or ""
    """

    sent = dropped = 0
    busy = False  # writing a packet that is counted neither as sent nor as dropped yet
    fault = ""

    def __init__(self, name: str, write: Callable[[Packet], None]) -> None:
        self.name = name
        self.write = write
        self.packets: queue.Queue[Packet | None] = queue.Queue(QUEUE_LENGTH)
        self.thread = threading.Thread(target=self.run, name=f"sink {name}", daemon=True)
        self.thread.start()

    def run(self) -> None:
        """Body of the thread: pass packets on until None arrives or `write` fails."""
        while (packet := self.packets.get()) is not None:
            self.busy = True
            try:
                self.write(packet)
            except BrokenPipeError:
                self.fault = READER_GONE
            except OSError as error:
                file = f"{error.filename}: " if error.filename else ""
                self.fault = file + (error.strerror or str(error))
            except Exception as error:  # a dead thread without `fault` would block a patient offer() for ever
                self.fault = printable(f"{type(error).__name__}: {error}")
            if self.fault:
                self.dropped += 1
            else:
                self.sent += 1
            self.busy = False
            if self.fault:
                return

    def offer(self, packet: Packet, patient: bool) -> None:
        """Queue a packet. If the queue is full, wait if `patient`, else drop the packet."""
        # The header's count includes frames dropped by this sink.
        packet = packet.plus_dropped(self.dropped)
        while not self.fault:
            try:
                self.packets.put(packet, timeout=0.1 if patient else 0.0001)
                return
            except queue.Full:
                if not patient:
                    break
        self.dropped += 1

    def close(self) -> None:
        """End the thread after its queued packets, within CLOSE_TIMEOUT_S; count what is left as dropped."""
        deadline = time.monotonic() + CLOSE_TIMEOUT_S
        while self.thread.is_alive() and time.monotonic() < deadline:
            with contextlib.suppress(queue.Full):
                self.packets.put(None, timeout=0.1)
                break
        self.thread.join(max(deadline - time.monotonic(), 0.0))
        with contextlib.suppress(queue.Empty):  # what is still queued is lost
            while True:
                self.dropped += self.packets.get_nowait() is not None
        self.dropped += self.busy  # the packet that a blocked thread still holds


def folder_writer(path: Path) -> Callable[[Packet], None]:
    """Return a function that writes frame_NNNNNN.png (16 bits; else .raw) and frame_NNNNNN.json with header and truth.

    The .json is written last and atomically, so that a reader may wait for it. Raises InputError if the folder holds
    frames of an earlier stream.
    """
    files.make_folder(path)
    if any(path.glob("frame_*.json")):
        raise InputError(path, "holds frames of an earlier stream", "an empty folder")

    def write(packet: Packet) -> None:
        stem = path / f"frame_{packet.header['index']:06d}"
        if packet.pixels.dtype == np.uint16:
            files.write_bytes(stem.with_suffix(".png"), encode_png(packet))
        else:
            files.write_bytes(stem.with_suffix(".raw"), packet.pixels.tobytes())
        files.write_text(
            stem.with_suffix(".json"), files.to_json({**packet.header, "truth": packet.truth})
        )

    return write


def encode_png(packet: Packet) -> bytes:
    """Encode the pixels as PNG at the lowest compression level, for speed."""
    return bytes(cv2.imencode(".png", packet.pixels, [cv2.IMWRITE_PNG_COMPRESSION, 1])[1])


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
