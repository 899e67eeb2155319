"""GVCP, the control protocol of GigE Vision: datagrams that read and write a camera's registers.

A command is key 0x42, flags (1: an answer is wanted), command, length of what follows, number; its answer is status,
command + 1, length, number. All numbers are big-endian. Source: GigE Vision 1.2, whose registers and codes Aravis
names in arvgvcpprivate.h.
"""

from __future__ import annotations

import functools
import struct
from collections.abc import Container, Mapping
from enum import IntEnum
from typing import Any

from skysim.core.errors import InputError

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


class ControlChannel:
    """Registers, and the one application that may write them. A camera adds what the methods without a body do.

    Attributes
    ----------
    ranges
        First addresses and ends of what can be read
    allowed
        Allowed values of the registers that can be written, by address; None for one of 8 bytes, a float, which
        `effect` checks
    """

    ranges: tuple[tuple[int, int], ...]
    allowed: Mapping[int, Container[int] | None]

    def __init__(self) -> None:
        self.memory = bytearray(self.ranges[-1][1])
        self.controller: Sender | None = None
        self.heard_s = 0.0
        # It remembers its newest answer.
        self.answer_once = functools.lru_cache(maxsize=1)(self.first_answer)

    def refresh(self) -> None:
        """Update the registers whose values change, before they are read."""

    def effect(self, address: int, value: Any) -> None:
        """Do what the writing of a register means. Raises InputError or RefusedError, and it keeps its value."""

    def resend(self, block: int, first: int, last: int) -> None:
        """Send packets of a block again."""

    def stop(self) -> None:
        """Send no more frames."""

    # Memory

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
        if not any(first <= address <= end - size for first, end in self.ranges):
            raise RefusedError(GvcpStatus.INVALID_ADDRESS)
        self.refresh()
        return bytes(self.memory[address : address + size])

    def write_register(self, sender: Sender, address: int, data: bytes) -> None:
        """Write a register. Raises RefusedError, InputError, and struct.error for a wrong length."""
        # Anyone may take the control of a free camera.
        if sender != self.controller and (self.controller or address != PRIVILEGE):
            raise RefusedError(GvcpStatus.ACCESS_DENIED)
        self.read(address, len(data))
        if address not in self.allowed:
            raise RefusedError(GvcpStatus.WRITE_PROTECT)
        allowed = self.allowed[address]
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

    def check_heartbeat(self, now_s: float) -> None:
        """Take the control from an application that was not heard for the heartbeat's timeout."""
        if self.controller and now_s - self.heard_s > 1e-3 * self.value(HEARTBEAT):
            self.release()

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
            self.resend(block, first & 0xFFFFFF, last & 0xFFFFFF)
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
