"""Packets of a live flight: a header as one line of JSON, then the pixels of a frame.

| channel | once a | content |
|---|---|---|
| `frame` | exposure | pixels |
| `solution` | exposure | attitude of the scene's tracker, or why there is none |
| `imu` | control period | its samples |
| `state` | control period | encoders: speeds of wheels, angles of gimbals, readings of other actuators |
| `telemetry` | control period | what the flight computer commands and estimates |
| `truth` | control period | true attitude and rate; beside them, the truth of each frame in its header |

Sinks pass them to a folder, a pipe, or a client. Each writes in its own thread behind a short queue and never delays
the simulation: packets that do not fit into the queue are dropped and counted.
"""

from __future__ import annotations

import functools
import json
import math
import re
import sys
import threading
from collections import Counter, deque
from collections.abc import Callable, Collection, Mapping
from pathlib import Path
from types import MappingProxyType
from typing import Any, BinaryIO, NamedTuple, Protocol

import cv2
import numpy as np

from estimator.core.types import Attitude
from skysim.core import files
from skysim.core.errors import InputError, printable, reason
from skysim.core.types import Array, Record
from skysim.dynamics.imu import TIME_TOLERANCE_S
from skysim.simulation.flight import Flight, Shot

# Limits for the reader.
MAX_HEADER_BYTES = 1 << 16
MAX_PIXELS = 1 << 28

NO_PIXELS = np.empty((0, 0), np.uint8)


class Packet(NamedTuple):
    """What is sent: a frame, or the values of another channel.

    Attributes
    ----------
    header
        Data that a receiver may use. Of all channels: channel, t_s (time of the simulator, since the scene's start; of
        a frame its middle), made_unix_s (wall clock), bytes (of the pixels that follow). Of frames: index, exposure_s,
        width, height, dtype (numpy's, little-endian), due_unix_s (wall clock at which the exposure ended), dropped
        (frames dropped before this one)
    pixels
        (H, W) pixels; (0, 0) of other channels
    truth
        Of a frame: cam_from_ref_xyzw (scalar last; ref: ICRS or the lab), rate_cam_rad_s, and ids, x_px, y_px of the
        lights on the detector
    attitude
        Of a solution: all that the tracker found, for outputs in this process
    """

    header: Record
    pixels: Array = NO_PIXELS
    truth: Mapping[str, Any] = MappingProxyType({})
    attitude: Attitude | None = None

    @property
    def channel(self) -> str:
        return str(self.header["channel"])

    @property
    def header_with_truth(self) -> Record:
        return self.header | ({"truth": dict(self.truth)} if self.truth else {})

    def pack(self, has_truth: bool = False) -> bytes:
        """Serialize: the header line, with the truth if wanted, then the pixels row by row from the top."""
        header = self.header_with_truth if has_truth else self.header
        header = header | {"bytes": self.pixels.nbytes}
        return json.dumps(header).encode() + b"\n" + self.pixels.tobytes()


def unpack(stream: BinaryIO) -> tuple[Record, Array] | None:
    """Read the next header and its (H, W) pixels; None at the end. Raises InputError for malformed or cut-off data."""
    line = stream.readline(MAX_HEADER_BYTES)
    if not line:
        return None
    try:
        header = json.loads(line)
        if not header["bytes"]:
            return header, NO_PIXELS
        shape = (int(header["height"]), int(header["width"]))
        known = re.fullmatch(r"[<>|]?(u[1248]|f[248])", header["dtype"])
        if not known or min(shape) < 1 or math.prod(shape) > MAX_PIXELS:
            raise ValueError(shape)
    except (ValueError, KeyError, TypeError, OverflowError, RecursionError) as error:
        raise InputError("", f"not a packet of skysim live: {line[:80]!r}") from error
    dtype = np.dtype(known[0])
    size = math.prod(shape) * dtype.itemsize
    pixels = stream.read(size)
    if len(pixels) < size:
        raise InputError("", f"the stream ended within frame {header.get('index')}")
    return header, np.frombuffer(pixels, dtype).reshape(shape)


def plain(values: Mapping[str, Any]) -> Record:
    """Copies of the values, as Python's numbers and lists."""
    return {key: np.asarray(value).tolist() for key, value in values.items()}


def frame_packet(shot: Shot, due_unix_s: float, made_unix_s: float, dropped: int) -> Packet:
    """Packet of a shot's frame.

    Parameters
    ----------
    due_unix_s, made_unix_s
        Wall-clock times at which the exposure ended and the frame was ready
    dropped
        Number of frames dropped before it
    """
    frame = shot.frame
    truth = shot.truth
    sources = truth.sources
    pixels = np.ascontiguousarray(frame.image_dn)
    pixels = pixels.astype(pixels.dtype.newbyteorder("<"), copy=False)
    height, width = pixels.shape
    header = {
        "channel": "frame",
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
    truths = {
        "cam_from_ref_xyzw": truth.cam_from_lab.as_quat(),
        "mean_cam_from_ref_xyzw": truth.mean_cam_from_lab.as_quat(),
        "rate_cam_rad_s": truth.rate_cam_rad_s,
        "ids": sources.id,
        "x_px": sources.xy_px[:, 0].round(4),
        "y_px": sources.xy_px[:, 1].round(4),
    }
    return Packet(header, pixels, plain(truths))


def solution_packet(shot: Shot, made_unix_s: float) -> Packet:
    """Packet of a shot's solution, at mid-exposure: `covariance_rad2` is that of a small rotation in camera axes."""
    assert shot.report is not None
    solution = shot.report.attitude
    header = {
        "channel": "solution",
        "index": shot.frame.index,
        "t_s": shot.frame.t_mid_s,
        "made_unix_s": made_unix_s,
        "status": solution.status,
    }
    if solution.cam_from_ref is not None and solution.covariance_rad2 is not None:
        header["cam_from_ref_xyzw"] = solution.cam_from_ref.as_quat()
        header["covariance_rad2"] = solution.covariance_rad2
    return Packet(plain(header), attitude=solution)


# The values of the periodic channels at the end of a control period that began at a time.


PERIODIC = ("imu", "state", "telemetry", "truth")  # have values every control period
CHANNELS = ("frame", "solution", *PERIODIC)


def values_of(channel: str, flight: Flight, began_s: float) -> Record:
    """The values of a channel for a control period from its beginning to now."""
    match channel:
        case "imu":
            # A unit slower than the control has no sample in most periods. Those of earlier periods were sent.
            samples = flight.imu_samples(began_s)
            if samples is None or not (new := samples.t_s > began_s + TIME_TOLERANCE_S).any():
                return {}
            return {
                "step_s": samples.step_s,
                "times_s": samples.t_s[new],
                "angle_rad": samples.angle_rad[new],
                "velocity_m_s": samples.velocity_m_s[new],
            }
        case "state":  # the encoders
            state = flight.state
            joints = {"wheel_rad_s": state.wheel_rad_s, "gimbal_rad": state.gimbal_rad}
            return joints | state.readings
        case "truth":
            state = flight.state
            return {
                "lab_from_body_xyzw": state.lab_from_body.as_quat(),
                "rate_body_rad_s": state.rate_body_rad_s,
            }
    # What the flight computer commands and estimates.
    computer = flight.motion.flight_computer
    navigation = flight.motion.navigation
    values: Record = {
        "torque_nm": computer.control_torque_nm,
        "loads": computer.loads(computer.control, flight.motion.simulation.speeds_rad_s),
    }
    if navigation:
        values["lab_from_imu_xyzw"] = np.roll(navigation.attitude_wxyz("imu"), -1)
        if navigation.filter:
            attitude_wxyz = navigation.attitude_wxyz("filter")
            values["lab_from_filter_xyzw"] = np.roll(attitude_wxyz, -1)
            values["bias_rad_s"] = navigation.filter.state.bias_rad_s
    return values


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

    def counters(self) -> Record:
        """What was sent and dropped."""
        ...


def start_thread(target: Callable[[], None], name: str) -> threading.Thread:
    """A thread that does not keep the process from ending, started."""
    thread = threading.Thread(target=target, name=name, daemon=True)
    thread.start()
    return thread


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
        self.thread = start_thread(self.run, f"sink {name}")

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
            file = f"{error.filename}: " if error.filename else ""
            return file + reason(error)
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

    def counters(self) -> Record:
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
        files.write_json(stem.with_suffix(".json"), packet.header_with_truth)

    return write


def encode_png(pixels: Array) -> bytes:
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
