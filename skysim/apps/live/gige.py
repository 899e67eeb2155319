"""A GigE Vision camera: control by GVCP, frames by GVSP, and a GenICam file that tells clients what it can do.

The features are those of data/gige_camera.xml. A frame (a "block") is a leader, packets with its pixels row by row,
and a trailer, numbered from 0; the newest are kept, so that a client can have lost packets sent again. Its timestamp
is the clock of the simulator at mid-exposure, in nanoseconds.

Pixels are little-endian. Mono16 holds the detector's numbers. Mono8 and Mono12 hold DN >> (bits - n), the highest n
bits of a detector with more; the numbers of one with fewer bits are sent as they are.
"""

from __future__ import annotations

import contextlib
import math
import select
import socket
import struct
import sys
import threading
import time
import uuid
from collections import deque
from typing import Any

from skysim.apps.live.gvcp import (
    DISCOVERY,
    DISCOVERY_BYTES,
    GVCP_PORT,
    HEARTBEAT,
    PRIVILEGE,
    ControlChannel,
    GvcpStatus,
    RefusedError,
    Sender,
    Writable,
)
from skysim.apps.live.pacing import Live
from skysim.apps.live.packets import Packet
from skysim.apps.live.sinks import Sink
from skysim.core import __version__
from skysim.core.errors import InputError
from skysim.core.paths import DATA

# Registers of GigE Vision.
ADDRESS = 0x0024
STREAM_PORT = 0x0D00
PACKET_SIZE = 0x0D04
PACKET_DELAY = 0x0D08
STREAM_ADDRESS = 0x0D18
SOURCE_PORT = 0x0D1C
CLOCK_CONTROL = 0x0944
LATCHED_NS = 0x0948
# The camera's own; data/gige_camera.xml has them too.
PIXEL_FORMAT = 0xA008
PAYLOAD_BYTES = 0xA00C
EXPOSURE_US = 0xA010
ACQUISITION_MODE = 0xA038
TRIGGER_MODE = 0xA044
XML = 0x10000
SIZES = {
    0x0000: DISCOVERY_BYTES,
    0x0200: 0x0404,
    0x0900: 0x0050,
    PRIVILEGE: 4,
    STREAM_PORT: 0x0020,
    0xA000: 0x004C,
}
PIXEL_BITS = {0x01080001: 8, 0x01100005: 12, 0x01100007: 16}  # of Mono8, Mono12, Mono16

FIRE_TEST = 1 << 31
PACKET_BYTES = (576, 16128)
HEADER_BYTES = 36  # of IP, UDP and GVSP in a packet
LONGEST_DELAY_NS = 10_000_000
HEARTBEAT_MS = (500, 600_000)
LEADER, TRAILER, PIXELS = 1, 2, 3
IMAGE = 1  # type of payload
LATCH = 2
MOST_BLOCKS = 4  # that are kept
UNAVAILABLE = 0x800C  # status of a packet that is not kept
POLL_S = 0.1
IP_MTU_DISCOVER, IP_PMTUDISC_DO = 10, 2  # Linux; not in Python's module socket


class GigeCamera(Sink):
    """The camera of a live flight. The interface is that of `Output`.

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
        detector = live.flight.lab.scene.camera.detector
        if not detector.noise:
            raise InputError(
                "--gige", "a camera without noise has no whole numbers", "noise: true"
            )
        self.bits = detector.bits
        self.sockets = open_sockets(host, port)
        self.host, self.port = self.sockets[0].getsockname()
        self.is_local = self.host.startswith("127.")
        self.stream = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
        self.stream.bind((self.host, 0))
        if sys.platform == "linux":
            # A test packet that is too large for the network must not arrive in fragments.
            self.stream.setsockopt(socket.IPPROTO_IP, IP_MTU_DISCOVER, IP_PMTUDISC_DO)
        xml = (DATA / "gige_camera.xml").read_bytes()
        xml += b"\n" * (-len(xml) % 4)
        self.control = ControlChannel(
            SIZES | {XML: len(xml)},
            self.writable(),
            self.refresh,
            self.resend,
            self.release,
        )
        self.fill_memory(xml)
        self.start_s = 0.0
        self.block = 0
        self.blocks: deque[tuple[int, list[bytes]]] = deque(maxlen=MOST_BLOCKS)
        self.resent = 0
        self.entered = threading.Event()
        super().__init__("gige", self.send_frame, ())
        threading.Thread(target=self.serve, name="gvcp", daemon=True).start()

    # Registers

    def fill_memory(self, xml: bytes) -> None:
        """Set the registers to their first values."""
        scene = self.live.flight.lab.scene
        detector = scene.camera.detector
        celsius = detector.temperature_c
        put = self.control.put
        mac = uuid.getnode()
        smallest = min(PIXEL_BITS, key=lambda code: (PIXEL_BITS[code] < self.bits, code))
        for address, value in {
            0x0000: 0x00010002,  # version 1.2
            0x0004: 0x80000001,  # big-endian, UTF-8
            0x0008: mac >> 32,
            0x000C: mac & 0xFFFFFFFF,
            0x0010: 4,  # configured by link-local address
            0x0014: 4,
            0x0600: 1,  # network interface
            0x0904: 1,  # stream channel
            0x0934: 0xC0000007,  # name and serial number; resend, WRITEMEM, several registers in a command
            HEARTBEAT: 3000,
            0x0940: 1_000_000_000,  # ticks of the clock a second
            PACKET_SIZE: 1500,
            SOURCE_PORT: self.stream.getsockname()[1],
            0xA000: scene.camera.width_px,
            0xA004: scene.camera.height_px,
            PIXEL_FORMAT: smallest,
        }.items():
            put(address, value)
        put(ADDRESS, socket.inet_aton(self.host), "4s")
        for address, text in {
            0x0048: "skysim",
            0x0068: "star camera",
            0x0088: __version__,
            0x00A8: "simulated",
            0x00D8: f"{mac:012x}",
            0x00E8: scene.name,
            0x0200: f"Local:gige_camera.xml;{XML:X};{len(xml):X}",
        }.items():
            longest = {0x00D8: 15, 0x00E8: 15, 0x0200: 511}.get(address, 31)
            put(address, text.encode()[:longest], f"{longest}s")
        # Whole microseconds: the longest exposure must not be refused for its rounding.
        put(0xA018, math.floor(1e6 * self.live.commands.longest_exposure_s), "d")
        put(0xA020, 1 / detector.gain_e_dn, "d")
        put(0xA028, detector.dark_temperature_c if celsius is None else celsius, "d")
        put(0xA030, scene.exposure.rate_hz, "d")
        put(XML, xml, f"{len(xml)}s")

    def writable(self) -> dict[int, Writable]:
        """The registers that can be written."""
        return {
            HEARTBEAT: Writable(
                "I", lambda ms: min(max(ms, HEARTBEAT_MS[0]), HEARTBEAT_MS[1])
            ),
            CLOCK_CONTROL: Writable("I", self.latch),
            STREAM_PORT: Writable("I", self.set_stream_port),
            PACKET_SIZE: Writable("I", self.set_packet_size),
            PACKET_DELAY: Writable("I", lambda ns: checked(ns, range(LONGEST_DELAY_NS + 1))),
            STREAM_ADDRESS: Writable("I", self.set_stream_address),
            PIXEL_FORMAT: Writable("I", self.set_pixel_format),
            EXPOSURE_US: Writable("d", self.set_exposure_us),
            ACQUISITION_MODE: Writable("I", lambda mode: checked(mode, range(2))),
            0xA03C: Writable("I", self.start),
            0xA040: Writable("I", self.stop),
            TRIGGER_MODE: Writable("I", self.set_trigger_mode),
            0xA048: Writable("I", self.trigger),
        }

    def refresh(self) -> None:
        """Update the registers whose values change: what was commanded, even if it still waits for the flight."""
        inbox = self.live.inbox
        put = self.control.put
        exposure_s = inbox.newest("exposure_s", self.late_refusal)
        if exposure_s is None:
            exposure_s = self.live.flight.schedules[0].exposure_control.exposure_s
        triggered = inbox.newest("triggered", self.late_refusal)
        if triggered is None:
            triggered = self.live.commands.has_triggers
        camera = self.live.flight.lab.scene.camera
        pixel_bytes = (PIXEL_BITS[self.control.value(PIXEL_FORMAT)] + 7) // 8
        put(EXPOSURE_US, 1e6 * exposure_s, "d")
        put(TRIGGER_MODE, triggered)
        put(PAYLOAD_BYTES, camera.width_px * camera.height_px * pixel_bytes)

    def command(self, **command: Any) -> None:
        """Command the flight. Raises RefusedError if too many commands wait."""
        if not self.live.inbox.put(command, self.late_refusal):
            raise RefusedError(GvcpStatus.BUSY)

    def late_refusal(self, _: str) -> None:
        """The flight refuses a command; GigE Vision cannot tell of it, the flight's statistics do."""

    def set_exposure_us(self, exposure_us: float) -> float:
        exposure_s = self.live.commands.exposure_s(exposure_us / 1e6)
        self.command(exposure_s=exposure_s)
        return exposure_us

    def set_trigger_mode(self, mode: int) -> int:
        self.command(triggered=bool(checked(mode, range(2))))
        return mode

    def trigger(self, _: int) -> int:
        """Expose a frame, where frames are triggered."""
        self.refresh()
        if not self.control.value(TRIGGER_MODE):
            raise RefusedError(GvcpStatus.WRITE_PROTECT)
        self.command(trigger=True)
        return 0

    def start(self, _: int) -> int:
        """Send the frames whose exposure begins from now on."""
        self.start_s = self.live.flight.now_s
        self.channels = ("frame",)
        self.entered.set()
        return 0

    def stop(self, _: int) -> int:
        """Send no more frames than those that wait."""
        self.channels = ()
        return 0

    def set_pixel_format(self, code: int) -> int:
        if self.channels:
            raise RefusedError(GvcpStatus.WRITE_PROTECT)
        return checked(code, PIXEL_BITS)

    def set_stream_port(self, port: int) -> int:
        """Open the stream, or close it (0)."""
        self.block = 0
        self.blocks.clear()
        return checked(port, range(1 << 16))

    def set_stream_address(self, address: int) -> int:
        """Set the receiver of the stream; on the loopback address it is on this machine."""
        if self.is_local and address and address >> 24 != 127:
            raise RefusedError(GvcpStatus.INVALID_PARAMETER)
        return address

    def set_packet_size(self, value: int) -> int:
        """Set the packets' size, and send one of it if the client asks for a test."""
        size = checked(value & 0xFFFF, range(PACKET_BYTES[0], PACKET_BYTES[1] + 1))
        if value & FIRE_TEST:
            self.send([bytes(size - 28)])
        return value & ~FIRE_TEST

    def latch(self, value: int) -> int:
        """Keep the simulator's time for the client."""
        checked(value, (LATCH,))
        self.control.put(LATCHED_NS, round(1e9 * self.live.flight.now_s), "Q")
        return 0

    def release(self) -> None:
        """Stop, and close the stream: the application in control has gone."""
        self.stop(0)
        self.control.put(STREAM_PORT, self.set_stream_port(0))
        self.control.put(STREAM_ADDRESS, 0)

    # Control

    def serve(self) -> None:
        """Body of the thread that answers datagrams, and notices that the application in control has gone."""
        main = self.sockets[0]
        while not self.ends:
            try:
                for ready in select.select(self.sockets, (), (), POLL_S)[0]:
                    datagram, sender = ready.recvfrom(1 << 16)
                    # A camera on the loopback address does not hear other machines; by a broadcast no camera is
                    # controlled, only found.
                    is_heard = not self.is_local or sender[0].startswith("127.")
                    if is_heard and (ready is main or datagram[2:4] == bytes((0, DISCOVERY))):
                        self.reply(main, datagram, sender)
                self.control.check_heartbeat(time.monotonic())
            except (OSError, ValueError):
                # A receiver that has gone, or the socket at the end.
                if main.fileno() < 0:
                    return

    def reply(self, main: socket.socket, datagram: bytes, sender: Sender) -> None:
        """Answer a datagram, if it has an answer."""
        if self.host == "0.0.0.0":
            with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as route:
                route.connect(sender)  # sends nothing
                self.control.put(ADDRESS, socket.inet_aton(route.getsockname()[0]), "4s")
        answer = self.control.answer(datagram, sender, time.monotonic())
        if answer is not None:
            main.sendto(answer, sender)

    # Stream

    def offer(self, packet: Packet, patient: bool) -> None:
        """Take a frame that was exposed since the acquisition has begun; stop after a single one."""
        header = packet.header
        if not self.channels or header["t_s"] - header["exposure_s"] / 2 < self.start_s:
            return
        is_single = self.control.value(ACQUISITION_MODE) == 1
        if is_single:
            self.stop(0)
        super().offer(packet, patient or is_single)

    def send_frame(self, packet: Packet) -> None:
        """Send a frame, and keep its packets."""
        # The number of a block has 16 bits and is not 0.
        self.block = self.block % 0xFFFF + 1
        packets = self.packets_of(packet)
        self.blocks.append((self.block, packets))
        self.send(packets, 1e-9 * self.control.value(PACKET_DELAY))

    def packets_of(self, packet: Packet) -> list[bytes]:
        """Leader, pixels and trailer of a frame."""
        pixel_format = self.control.value(PIXEL_FORMAT)
        bits = PIXEL_BITS[pixel_format]
        pixels = packet.pixels >> max(self.bits - bits, 0)
        data = pixels.astype("<u1" if bits == 8 else "<u2").tobytes()
        height, width = pixels.shape
        t_ns = round(1e9 * packet.header["t_s"])
        leader = struct.pack(">HHQ5I4x", 0, IMAGE, t_ns, pixel_format, width, height, 0, 0)
        size = (self.control.value(PACKET_SIZE) & 0xFFFF) - HEADER_BYTES
        parts = [(LEADER, leader)]
        parts += [(PIXELS, data[at : at + size]) for at in range(0, len(data), size)]
        parts += [(TRAILER, struct.pack(">HHI", 0, IMAGE, height))]
        return [
            struct.pack(">HHI", 0, self.block, kind << 24 | number) + part
            for number, (kind, part) in enumerate(parts)
        ]

    def send(self, packets: list[bytes], delay_s: float = 0.0) -> None:
        """Send packets to the receiver of the stream; it asks again for those that the network loses."""
        address = socket.inet_ntoa(struct.pack(">I", self.control.value(STREAM_ADDRESS)))
        receiver = (address, self.control.value(STREAM_PORT))
        for packet in packets if receiver[1] else ():
            with contextlib.suppress(OSError):
                self.stream.sendto(packet, receiver)
            if delay_s:
                time.sleep(delay_s)

    def resend(self, block: int, first: int, last: int) -> None:
        """Send packets again, or say that they are no longer kept."""
        packets = dict(tuple(self.blocks)).get(block)
        if packets is None:
            self.send([struct.pack(">HHI", UNAVAILABLE, block, PIXELS << 24 | first)])
            return
        again = packets[first : last + 1]
        self.resent += len(again)
        self.send(again)

    # End

    def close(self) -> None:
        """Send the frames that wait, and close the sockets."""
        super().close()
        for one in (*self.sockets, self.stream):
            one.close()

    def counters(self) -> dict[str, Any]:
        return super().counters() | {"resent": self.resent}


def checked(value: int, allowed: Any) -> int:
    """A register's value. Raises RefusedError if it is not allowed."""
    if value not in allowed:
        raise RefusedError(GvcpStatus.INVALID_PARAMETER)
    return value


def open_sockets(host: str, port: int) -> list[socket.socket]:
    """Sockets of an address and of the broadcasts to 255.255.255.255, where the system allows it.

    Raises InputError for an address that cannot be bound.
    """
    main = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
    try:
        main.bind((host, port))
    except OSError as error:
        main.close()
        problem = f"cannot serve on {host}:{port}: {error.strerror or error}"
        raise InputError("--gige", problem, "an IPv4 address that is free") from None
    sockets = [main]
    if main.getsockname()[0] != "0.0.0.0":
        broadcast = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
        try:
            # Several cameras of a machine hear the same broadcast.
            broadcast.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
            broadcast.bind(("255.255.255.255", port))
            sockets.append(broadcast)
        except OSError:
            broadcast.close()
    return sockets
