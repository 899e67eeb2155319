"""GigE Vision: a camera, with control by GVCP and frames by GVSP; `gige_receiver` is the application that takes them.

A GenICam file tells applications what a camera can do; the simulated one's is data/gige_camera.xml. A frame (a
"block") is a leader, packets with its pixels row by row, and a trailer, numbered from 0; the newest are kept, so that
a client can have lost packets sent again. Its timestamp is the clock of the simulator at mid-exposure, in nanoseconds.

Pixels are little-endian. Mono16 holds the detector's numbers. Mono8 and Mono12 hold DN >> (bits - n), the highest n
bits of a detector with more; the numbers of one with fewer bits are sent as they are.

GVCP is the control protocol: datagrams that read and write a camera's registers.

A command is key 0x42, flags (1: an answer is wanted), command, length of what follows, number; its answer is status,
command + 1, length, number. All numbers are big-endian. Source: GigE Vision 1.2, whose registers and codes Aravis
names in arvgvcpprivate.h.
"""

from __future__ import annotations

import functools
import select
import socket
import struct
import time
import uuid
from collections import deque
from collections.abc import Container
from contextlib import suppress
from enum import IntEnum
from typing import Any

import numpy as np

from skysim.apps.live.pacing import Live
from skysim.apps.live.packets import Packet, Sink, start_thread
from skysim.core import __version__
from skysim.core.errors import InputError, reason
from skysim.core.paths import DATA

# Control.

GVCP_PORT = 3956
HEADER = struct.Struct(">BBHHH")
ANSWER = struct.Struct(">HHHH")
KEY = 0x42
MOST_BYTES = 536  # of the memory in a datagram
MOST_DATAGRAM_BYTES = 576

DISCOVERY = 0x0002
FORCEIP = 0x0004
PACKETRESEND = 0x0040
READREG = 0x0080
WRITEREG = 0x0082
READMEM = 0x0084
WRITEMEM = 0x0086
SILENT = (FORCEIP, PACKETRESEND)  # have no answer; the address is that of the machine

# Registers that the protocol itself needs.
DISCOVERY_BYTES = 0xF8
XML_ADDRESS = 0x0200  # text of 512 bytes
HEARTBEAT = 0x0938  # ms
PRIVILEGE = 0x0A00
EXCLUSIVE = 1
CONTROL = 2
STREAM_PORT = 0x0D00

Sender = tuple[str, int]


class GvcpStatus(IntEnum):
    """Status of an answer."""

    SUCCESS = 0
    NOT_IMPLEMENTED = 0x8001
    INVALID_PARAMETER = 0x8002
    INVALID_ADDRESS = 0x8003
    WRITE_PROTECT = 0x8004
    BAD_ALIGNMENT = 0x8005
    ACCESS_DENIED = 0x8006
    BUSY = 0x8007
    INVALID_HEADER = 0x800E


class RefusedError(Exception):
    """A command that is answered with the status in its argument."""


# Further registers of GigE Vision.
ADDRESS = 0x0024
PACKET_SIZE = 0x0D04
PACKET_DELAY = 0x0D08  # ns
STREAM_ADDRESS = 0x0D18
# Its own, as in data/gige_camera.xml.
PIXEL_FORMAT = 0xA008
PAYLOAD_BYTES = 0xA00C
EXPOSURE_US = 0xA010
LONGEST_US = 0xA018
CELSIUS = 0xA028
ACQUISITION_MODE = 0xA038
START = 0xA03C
STOP = 0xA040
TRIGGER_MODE = 0xA044
TRIGGER = 0xA048
XML = 0x10000
XML_BYTES = 0x4000  # room for it

PIXEL_BITS = {0x01080001: 8, 0x01100005: 12, 0x01100007: 16}  # of Mono8, Mono12, Mono16
# Allowed values of the registers that can be written; None for one of 8 bytes, a float, which `effect` checks.
WRITABLE: dict[int, Container[int] | None] = {
    HEARTBEAT: range(500, 600_001),
    PRIVILEGE: range(4),
    STREAM_PORT: range(1 << 16),
    PACKET_SIZE: range(576, 16129),
    PACKET_DELAY: range(10_000_001),
    STREAM_ADDRESS: range(1 << 32),
    PIXEL_FORMAT: PIXEL_BITS,
    EXPOSURE_US: None,
    ACQUISITION_MODE: range(2),
    START: {1},
    STOP: {1},
    TRIGGER_MODE: range(2),
    TRIGGER: {1},
}
# First addresses and ends of what can be read.
RANGES = (
    (0, 0x00F8),
    (0x0200, 0x0604),
    (0x0900, 0x0944),
    (0x0A00, 0x0A04),
    (0x0D00, 0x0D20),
    (0xA000, 0xA04C),
    (XML, XML + XML_BYTES),
)
PACKET_BYTES = 1500  # of Ethernet without jumbo frames
HEADER_BYTES = 36  # of IP, UDP and GVSP in a packet
# Status and number of the block; kind and number of the packet, in 8 and 24 bits.
PACKET_HEAD = struct.Struct(">HHI")
# Type of payload, timestamp, pixel format, width, height; offsets; padding.
LEADER_BODY = struct.Struct(">IQIII8xI")
LEADER = 1
TRAILER = 2
PIXELS = 3
IMAGE = 1  # type of payload
NUMBER = 0xFFFFFF  # bits of a packet's number
MOST_BLOCKS = 4  # that are kept
POLL_S = 0.1


class GigeCamera(Sink):
    """The camera of a live flight: registers, and the one application that may write them.

    The interface is that of `Output`.

    Parameters
    ----------
    live
        The flight; commands go into its inbox
    host, port
        IPv4 address or name to serve on

    Raises
    ------
    InputError
        For an address that cannot be bound, and a detector whose frames are not whole numbers.
    """

    def __init__(self, live: Live, host: str, port: int = GVCP_PORT) -> None:
        self.live = live
        self.scene = live.flight.lab.scene
        if not self.scene.camera.detector.noise:
            raise InputError(
                "--gige", "a camera without noise has no whole numbers", "noise: true"
            )
        self.socket = udp_socket()
        try:
            self.socket.bind((host, port))
        except OSError as error:
            self.socket.close()
            problem = f"cannot serve on {host}:{port}: {reason(error)}"
            raise InputError("--gige", problem, "an IPv4 address that is free") from None
        self.host, self.port = self.socket.getsockname()
        self.is_local = self.host.startswith("127.")
        self.broadcasts = udp_socket()
        # Several cameras of a machine hear the same broadcast.
        self.broadcasts.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
        # Not every system allows it, and 0.0.0.0 hears broadcasts by itself.
        with suppress(OSError):
            self.broadcasts.bind(("255.255.255.255", port))
        self.stream = udp_socket()
        self.stream.bind((self.host, 0))
        self.start_s = 0.0
        self.block = 0
        self.blocks: deque[tuple[int, list[bytes]]] = deque(maxlen=MOST_BLOCKS)
        self.entered = live.entered
        self.memory = bytearray(XML + XML_BYTES)
        self.controller: Sender | None = None
        self.heard_s = 0.0
        # It remembers its newest answer.
        self.answer_once = functools.lru_cache(maxsize=1)(self.first_answer)
        self.fill_memory()
        super().__init__("gige", self.send_frame, ())
        start_thread(self.serve, "gvcp")

    # Registers

    def fill_memory(self) -> None:
        """Set the registers to their first values."""
        camera = self.scene.camera
        detector = camera.detector
        serial = uuid.getnode()
        for address, value in {
            0x0000: struct.pack(
                ">IIQII12x4s32x32s32s32s48s16s15s",
                0x00010002,  # version 1.2
                0x80000001,  # big-endian, UTF-8
                serial,  # address of the hardware
                4,  # configured by link-local address
                4,
                socket.inet_aton(self.host),
                b"skysim",
                b"star camera",
                __version__.encode(),
                b"simulated",
                b"%012x" % serial,
                self.scene.name.encode(),
            ),
            XML_ADDRESS: b"Local:gige_camera.xml;%X;%X" % (XML, XML_BYTES),
            0x0600: 1,  # network interface
            0x0904: 1,  # stream channel
            0x0934: 0xC0000007,  # name, serial number; resend, WRITEMEM, several registers in a command
            HEARTBEAT: 3000,
            0x0940: 1_000_000_000,  # ticks of the clock a second
            PACKET_SIZE: PACKET_BYTES,
            0x0D1C: self.stream.getsockname()[1],
            0xA000: camera.width_px,
            0xA004: camera.height_px,
            PIXEL_FORMAT: next(code for code, n in PIXEL_BITS.items() if n >= detector.bits),
            # Whole microseconds: the longest exposure must not be refused for its rounding.
            LONGEST_US: 1e6 * self.live.commands.longest_exposure_s // 1,
            0xA020: 1 / detector.gain_e_dn,
            CELSIUS: detector.own_c,
            0xA030: self.scene.exposure.rate_hz,
            XML: (DATA / "gige_camera.xml").read_bytes().ljust(XML_BYTES, b"\n"),
        }.items():
            self.put(address, value)

    def put(self, address: int, value: float | bytes) -> None:
        """Set a register: an int of 4 bytes, a float of 8, or bytes."""
        if not isinstance(value, bytes):
            value = struct.pack(">d" if isinstance(value, float) else ">I", value)
        self.memory[address : address + len(value)] = value

    def value(self, address: int) -> int:
        """A register of 4 bytes."""
        return int.from_bytes(self.memory[address : address + 4])

    def read(self, address: int, size: int) -> bytes:
        """Bytes at an address, up to date. Raises RefusedError."""
        if address % 4 or size % 4:
            raise RefusedError(GvcpStatus.BAD_ALIGNMENT)
        if size > MOST_BYTES:
            raise RefusedError(GvcpStatus.INVALID_PARAMETER)
        if not any(first <= address <= end - size for first, end in RANGES):
            raise RefusedError(GvcpStatus.INVALID_ADDRESS)
        self.refresh()
        return bytes(self.memory[address : address + size])

    def write_register(self, sender: Sender, address: int, data: bytes) -> None:
        """Write a register. Raises RefusedError, InputError, and struct.error for a wrong length."""
        # Anyone may take the control of a free camera.
        if sender != self.controller and (self.controller or address != PRIVILEGE):
            raise RefusedError(GvcpStatus.ACCESS_DENIED)
        self.read(address, len(data))
        if address not in WRITABLE:
            raise RefusedError(GvcpStatus.WRITE_PROTECT)
        allowed = WRITABLE[address]
        (value,) = struct.unpack(">d" if allowed is None else ">I", data)
        if allowed is not None and value not in allowed:
            raise RefusedError(GvcpStatus.INVALID_PARAMETER)
        self.effect(address, value)
        self.put(address, data)
        if address == PRIVILEGE:
            self.controller = sender
            if not value:
                self.release()

    def release(self) -> None:
        """Take the control from its application, stop, and close the stream."""
        self.controller = None
        self.put(PRIVILEGE, 0)
        self.stop()
        self.put(STREAM_PORT, 0)

    # Datagrams

    def answer(self, datagram: bytes, sender: Sender, now_s: float) -> bytes | None:
        """Carry out a command; return the answer, or None for a datagram that has none.

        A datagram that comes twice in succession is a client's second try: it gets the first answer once more, and a
        trigger in it is not taken twice.

        Parameters
        ----------
        sender
            Address and port of the client
        now_s
            Monotonic time
        """
        answer = self.answer_once(datagram, sender)
        if sender == self.controller:
            self.heard_s = now_s
        return answer

    def first_answer(self, datagram: bytes, sender: Sender) -> bytes | None:
        """Carry out a command that is no second try; return as `answer` does."""
        if len(datagram) < HEADER.size or datagram[0] != KEY:
            return None
        _, flags, command, length, number = HEADER.unpack_from(datagram)
        status = GvcpStatus.SUCCESS
        data = b""
        try:
            (payload,) = struct.unpack(f"{length}s", datagram[HEADER.size :])
            data = self.execute(command, payload, sender)
        except RefusedError as error:
            status = error.args[0]
        except InputError:
            status = GvcpStatus.INVALID_PARAMETER
        except struct.error:
            status = GvcpStatus.INVALID_HEADER
        if not flags & 1 or command in SILENT:
            return None
        return ANSWER.pack(status, (command + 1) & 0xFFFF, len(data), number) + data

    def execute(self, command: int, payload: bytes, sender: Sender) -> bytes:
        """Carry out a command; return the answer's data. Raises as `write_register` does."""
        if command == DISCOVERY:
            return self.read(0, DISCOVERY_BYTES)
        if command == PACKETRESEND:
            block, first, last = struct.unpack(">2xHII", payload)
            self.resend(block, first & NUMBER, last & NUMBER)
            return b""
        if sender != self.controller and self.value(PRIVILEGE) & EXCLUSIVE:
            raise RefusedError(GvcpStatus.ACCESS_DENIED)
        if command == READREG:
            return b"".join(self.read(one, 4) for (one,) in struct.iter_unpack(">I", payload))
        if command == READMEM:
            return payload[:4] + self.read(*struct.unpack(">II", payload))
        if command in (WRITEREG, WRITEMEM):
            # Several registers, or one of any size; the answer is their number, or this size.
            size = 4 if command == WRITEREG else len(payload) - 4
            for address, data in struct.iter_unpack(f">I{size}s", payload):
                self.write_register(sender, address, data)
            return struct.pack(">I", len(payload) // 8 if command == WRITEREG else size)
        raise RefusedError(GvcpStatus.NOT_IMPLEMENTED)

    # What registers mean

    def refresh(self) -> None:
        """Update the registers whose values change."""
        pixel_bytes = pixel_type(self.value(PIXEL_FORMAT)).itemsize
        self.put(PAYLOAD_BYTES, self.value(0xA000) * self.value(0xA004) * pixel_bytes)
        # While commands wait for the flight, the registers hold what was commanded.
        if not self.live.inbox.waiting:
            control = self.live.flight.schedules[0].exposure_control
            self.put(EXPOSURE_US, 1e6 * control.exposure_s)
            self.put(TRIGGER_MODE, self.live.commands.has_triggers)

    def command(self, **command: Any) -> None:
        """Command the flight, whose statistics count a late refusal. Raises RefusedError if too many commands wait."""
        if not self.live.inbox.put(command, lambda _: None):
            raise RefusedError(GvcpStatus.BUSY)

    def effect(self, address: int, value: Any) -> None:
        """Do what the writing of a register means.

        Raises InputError for an exposure time that is not allowed, and RefusedError for a pixel format while frames
        are sent, and for a trigger where the schedule exposes the frames.
        """
        if (address == PIXEL_FORMAT and self.channels) or (
            address == TRIGGER and not self.value(TRIGGER_MODE)
        ):
            raise RefusedError(GvcpStatus.WRITE_PROTECT)
        if address == EXPOSURE_US:
            self.command(exposure_s=self.live.commands.exposure_s(value / 1e6))
        elif address == TRIGGER_MODE:
            self.command(triggered=value == 1)
        elif address == TRIGGER:
            self.command(trigger=True)
        elif address == START:
            # The frames whose exposure begins from now on are sent.
            self.start_s = self.live.flight.now_s
            self.channels = ("frame",)
            self.entered.set()
        elif address == STOP:
            self.stop()
        elif address == STREAM_PORT:
            # A new receiver's frames are numbered from 1 on.
            self.block = 0

    def stop(self) -> None:
        """Send no more frames than those that wait."""
        self.channels = ()

    # Network

    def serve(self) -> None:
        """Body of the thread that answers datagrams, and notices that the application in control has gone."""
        sockets = (self.socket, self.broadcasts)
        with self.socket, self.broadcasts, self.stream:
            # The sink's thread ends when the frames that wait are sent.
            while self.thread.is_alive():
                # An answer to a client that has gone raises OSError.
                with suppress(OSError):
                    for ready in select.select(sockets, (), (), POLL_S)[0]:
                        datagram, sender = ready.recvfrom(MOST_DATAGRAM_BYTES)
                        self.reply(datagram, sender, ready is self.broadcasts)
                    # An application that was not heard for the heartbeat's timeout has gone.
                    silent_s = time.monotonic() - self.heard_s
                    if self.controller and silent_s > 1e-3 * self.value(HEARTBEAT):
                        self.release()

    def reply(self, datagram: bytes, sender: Sender, is_broadcast: bool) -> None:
        """Answer a datagram, if it has an answer."""
        # A broadcast finds a camera (command 2) and does nothing else; on the loopback address only this machine's.
        is_foreign = self.is_local and not sender[0].startswith("127.")
        if is_broadcast and (is_foreign or datagram[2:4] != b"\0\2"):
            return
        if self.host == "0.0.0.0":
            with udp_socket() as route:
                route.connect(sender)  # sends nothing
                self.put(ADDRESS, socket.inet_aton(route.getsockname()[0]))
        if answer := self.answer(datagram, sender, time.monotonic()):
            self.socket.sendto(answer, sender)

    def offer(self, packet: Packet, patient: bool) -> None:
        """Take a frame that was exposed since the acquisition has begun; stop after a single one."""
        header = packet.header
        if header["t_s"] - header["exposure_s"] / 2 >= self.start_s:
            # All modes but the first, Continuous, are of a single frame.
            if self.value(ACQUISITION_MODE):
                self.stop()
            super().offer(packet, patient)

    def send_frame(self, packet: Packet) -> None:
        """Send a frame, and keep its packets."""
        # The number of a block has 16 bits and is not 0.
        self.block = self.block % 0xFFFF + 1
        packets = self.packets_of(packet)
        self.blocks.append((self.block, packets))
        self.send(packets, 1e-9 * self.value(PACKET_DELAY))

    def packets_of(self, packet: Packet) -> list[bytes]:
        """Leader, pixels and trailer of a frame."""
        pixel_format = self.value(PIXEL_FORMAT)
        bits = PIXEL_BITS[pixel_format]
        pixels = packet.pixels >> max(self.scene.camera.detector.bits - bits, 0)
        data = pixels.astype(pixel_type(pixel_format)).tobytes()
        height, width = pixels.shape
        t_ns = round(1e9 * packet.header["t_s"])
        size = self.value(PACKET_SIZE) - HEADER_BYTES
        parts = [
            (LEADER, LEADER_BODY.pack(IMAGE, t_ns, pixel_format, width, height, 0)),
            *((PIXELS, data[at : at + size]) for at in range(0, len(data), size)),
            (TRAILER, struct.pack(">II", IMAGE, height)),
        ]
        return [
            PACKET_HEAD.pack(0, self.block, kind << 24 | number) + part
            for number, (kind, part) in enumerate(parts)
        ]

    def send(self, packets: list[bytes], delay_s: float = 0.0) -> None:
        """Send packets to the receiver of the stream; it asks again for those that the network loses."""
        address = socket.inet_ntoa(self.memory[STREAM_ADDRESS : STREAM_ADDRESS + 4])
        for packet in packets:
            with suppress(OSError):
                self.stream.sendto(packet, (address, self.value(STREAM_PORT)))
            if delay_s:
                time.sleep(delay_s)

    def resend(self, block: int, first: int, last: int) -> None:
        """Send packets again, if their frame is still kept."""
        self.send(dict(tuple(self.blocks)).get(block, [])[first : last + 1])


def udp_socket() -> socket.socket:
    """A socket for datagrams."""
    return socket.socket(socket.AF_INET, socket.SOCK_DGRAM)


def pixel_type(pixel_format: int) -> np.dtype:
    """Type of a pixel: the second byte of a format is the number of bits that it takes."""
    return np.dtype(f"<u{(pixel_format >> 16 & 0xFF) // 8}")
