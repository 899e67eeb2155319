"""GigE Vision: the application that controls a camera (`gige`) and receives its frames."""

from __future__ import annotations

import io
import re
import select
import socket
import struct
import time
import zipfile
from collections.abc import Iterator
from contextlib import suppress
from typing import Any
from urllib.parse import urlsplit
from xml.etree import ElementTree

import numpy as np

from skysim.apps.live.gige import (
    ANSWER,
    CONTROL,
    GVCP_PORT,
    HEADER,
    IMAGE,
    KEY,
    LEADER,
    LEADER_BODY,
    MOST_DATAGRAM_BYTES,
    NUMBER,
    PACKET_BYTES,
    PACKET_HEAD,
    PACKET_SIZE,
    PIXEL_BITS,
    POLL_S,
    PRIVILEGE,
    READMEM,
    READREG,
    STREAM_ADDRESS,
    STREAM_PORT,
    TRAILER,
    WRITEREG,
    XML_ADDRESS,
    pixel_type,
    udp_socket,
)
from skysim.core.errors import InputError, errors_within, refusing
from skysim.core.images import LiveCamera
from skysim.core.types import Array

SCHEME = "gige://"
TRIES = 8  # for an answer; one to an earlier try is none
ANSWER_S = 0.3
PATIENCE_S = 10.0  # for a whole frame
MOST_PACKETS = 1 << 17  # of a frame: 96 million pixels of 16 bits
MOST_XML_BYTES = 1 << 24
READ_BYTES = 512
FREE = "a camera that no other application controls (status 0x8006)"
BUFFER_BYTES = 1 << 23  # of packets that wait; the system may allow less


class GigeReceiver:
    """The application that controls a camera and takes its frames. The interface is that of `LiveCamera`.

    Parameters
    ----------
    source
        gige://HOST or gige://HOST:PORT

    Attributes
    ----------
    stop
        Register that ends the acquisition, and the value for it; None before the acquisition has begun
    block, parts
        Number of the frame that comes, and its packets so far, without their heads

    Raises
    ------
    InputError
        For what is no address.
    """

    stop: tuple[int, int] | None = None
    number = 0
    block = 0

    def __init__(self, source: str) -> None:
        self.source = source
        self.parts: list[bytes] = []
        self.control = udp_socket()
        self.control.settimeout(ANSWER_S)
        self.stream = udp_socket()
        self.stream.setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, BUFFER_BYTES)
        # Without a host, for one that is not known, and a port that is none.
        with refusing((TypeError, OSError, ValueError), source, "no such address"):
            place = urlsplit(source)
            self.control.connect((place.hostname, place.port or GVCP_PORT))
            self.stream.bind((self.control.getsockname()[0], 0))

    def frame(self) -> Array:
        """The next whole frame, (H, W).

        1. Forget the packets that have come before: they are of old frames.
        2. Take the control, or keep it. A camera takes it from an application that it does not hear for some seconds,
           and closes the stream: then open it again, and start.
        3. Take the packets that come. A frame with a hole is not given.

        Raises
        ------
        InputError
            For a camera that does not answer, is controlled by another application, has no plain registers to start
            by, sends another kind of frames than `GigeCamera`, or none.
        """
        with errors_within(self.source):
            # 1. Old packets.
            end_s = time.monotonic() + PATIENCE_S
            while select.select([self.stream], (), (), 0)[0] and time.monotonic() < end_s:
                self.stream.recv(PACKET_BYTES)
            # 2. Control.
            self.write(PRIVILEGE, CONTROL)
            here, port = self.stream.getsockname()
            if self.command(READREG, STREAM_PORT)[2:] != port.to_bytes(2):
                start, self.stop = self.commands("AcquisitionStart", "AcquisitionStop")
                self.write(PACKET_SIZE, PACKET_BYTES)
                self.write(STREAM_ADDRESS, int.from_bytes(socket.inet_aton(here)))
                self.write(STREAM_PORT, port)
                self.write(*start)
            # 3. Packets.
            host, _ = self.control.getpeername()
            while time.monotonic() < end_s:
                if not select.select([self.stream], (), (), POLL_S)[0]:
                    self.write(PRIVILEGE, CONTROL)
                    continue
                packet, (sender, _) = self.stream.recvfrom(PACKET_BYTES)
                image = self.take(packet) if sender == host else None
                if image is not None:
                    return image
            raise InputError(
                "",
                f"no whole frame in {PATIENCE_S:g} s",
                "a camera whose trigger mode is off",
            )

    def close(self) -> None:
        """Stop the acquisition, and give the control back."""
        with self.control, self.stream, suppress(InputError):
            if self.stop:
                self.write(*self.stop)
                self.write(PRIVILEGE, 0)

    # Control

    def command(self, command: int, *words: int) -> bytes:
        """Give a command of these words until it is answered; return the answer's data. Raises InputError."""
        self.number = self.number % 0xFFFF + 1
        payload = struct.pack(f">{len(words)}I", *words)
        datagram = HEADER.pack(KEY, 1, command, len(payload), self.number) + payload
        for _ in range(TRIES):
            with suppress(OSError, struct.error):
                self.control.send(datagram)
                answer = self.control.recv(MOST_DATAGRAM_BYTES)
                status, answered, _, number = ANSWER.unpack_from(answer)
                if (answered, number) != (command + 1, self.number):
                    continue
                if status:
                    raise InputError(
                        "", f"answers {command:#06x} by status {status:#06x}", FREE
                    )
                return answer[ANSWER.size :]
        raise InputError("", "no GigE Vision camera answers", FREE)

    def write(self, address: int, value: int) -> None:
        """Write a register of 4 bytes. Raises InputError."""
        self.command(WRITEREG, address, value)

    def commands(self, *names: str) -> Iterator[tuple[int, int]]:
        """Register and value of commands, by the camera's GenICam file, which may be packed. Raises InputError."""
        # A damaged file gives errors of many types.
        with refusing(
            Exception, "", f"no GenICam file in it with plain registers for {names}"
        ):
            ((at, size),) = re.findall(
                rb"(?i)local:[^;]*;([\da-f]+);([\da-f]+)",
                self.command(READMEM, XML_ADDRESS, READ_BYTES),
            )
            first = int(at, 16)
            end = first + min(int(size, 16), MOST_XML_BYTES)
            # Registers have 4 bytes.
            data = b"".join(
                self.command(READMEM, at, min(READ_BYTES, end - at + -end % 4))[4:]
                for at in range(first, end, READ_BYTES)
            )[: end - first]
            if data.startswith(b"PK"):
                packed = zipfile.ZipFile(io.BytesIO(data))
                data = packed.open(packed.namelist()[0]).read(MOST_XML_BYTES)
            root: Any = ElementTree.fromstring(data.strip(b"\0\n"))
            for name in names:
                command = root.find(f".//{{*}}Command[@Name='{name}']")
                value = int(command.findtext("{*}CommandValue"), 0)
                node = root.find(f".//{{*}}IntReg[@Name='{command.findtext('{*}pValue')}']")
                # Its address must be a number, to which nothing is added.
                (address,) = (one.text for one in node if re.search("Addr|Ind|Kni", one.tag))
                yield int(address, 0), value

    # Frames

    def take(self, packet: bytes) -> Array | None:
        """Take a packet, of anyone; return the frame that it completes. A packet that is lost ends its frame.

        Raises
        ------
        InputError
            For a frame of another kind than `GigeCamera` sends.
        """
        try:
            _, number, word = PACKET_HEAD.unpack_from(packet)
            if word == LEADER << 24:
                self.block = number
                self.parts.clear()
            if number != self.block or not word & NUMBER == len(self.parts) < MOST_PACKETS:
                return None
            self.parts.append(packet[PACKET_HEAD.size :])
            if word >> 24 != TRAILER:
                return None
            leader, *pixels, _ = self.parts
            kind, _, code, width, height, padding = LEADER_BODY.unpack_from(leader)
            if kind == IMAGE and code in PIXEL_BITS and not padding:
                data = b"".join(pixels)
                return np.frombuffer(data, pixel_type(code)).reshape(height, width)
        except (ValueError, struct.error):
            return None
        raise InputError(
            "",
            f"sends payload {kind:#x} in pixel format {code:#010x}",
            f"Mono of {[*PIXEL_BITS.values()]} bits, not padded",
        )


def open_camera(source: str) -> LiveCamera | GigeReceiver:
    """The camera at gige://HOST, or a device, a video file or an address. Raises InputError."""
    return GigeReceiver(source) if source.startswith(SCHEME) else LiveCamera(source)
