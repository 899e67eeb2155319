"""GVCP, the control protocol of GigE Vision: datagrams that read and write a camera's registers.

A command is key 0x42, flags (1: an answer is wanted), command, length of what follows, number; its answer is status,
command + 1, length, number. All numbers are big-endian. Sources: the registers' addresses and the codes are those of
GigE Vision 1.2, which Aravis names in arvgvcpprivate.h.
"""

from __future__ import annotations

import struct
from collections.abc import Callable
from dataclasses import dataclass
from enum import IntEnum
from typing import Any

from skysim.core.errors import InputError

GVCP_PORT = 3956
HEADER = struct.Struct(">BBHHH")
ANSWER = struct.Struct(">HHHH")
KEY = 0x42
MOST_BYTES = 536  # of the memory in a datagram

DISCOVERY = 0x0002
FORCEIP = 0x0004
PACKETRESEND = 0x0040
READREG = 0x0080
WRITEREG = 0x0082
READMEM = 0x0084
WRITEMEM = 0x0086

# Registers that the protocol itself needs.
DISCOVERY_BYTES = 0xF8
HEARTBEAT = 0x0938  # ms
PRIVILEGE = 0x0A00
EXCLUSIVE = 1
CONTROL = 2

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
    """A command that is answered with an error."""

    def __init__(self, status: GvcpStatus) -> None:
        super().__init__(status.name)
        self.status = status


@dataclass(frozen=True, slots=True)
class Writable:
    """A register that the application in control may write.

    Attributes
    ----------
    code
        Its type: struct's I (unsigned, 4 bytes) or d (8 bytes)
    take
        Takes a value and returns what the register then holds. Raises InputError or RefusedError, and the register
        keeps its value
    """

    code: str
    take: Callable[[Any], Any]


class ControlChannel:
    """Registers, and the one application that may write them.

    Parameters
    ----------
    sizes
        Bytes of each range of addresses that can be read, by its first address
    writable
        Registers that can be written, by their address; the privilege is not among them
    refresh
        Updates the registers whose values change, before they are read
    resend
        Sends packets again: resend(block, first, last)
    released
        Called when the application has given up the control, or was not heard for the heartbeat's timeout
    """

    def __init__(
        self,
        sizes: dict[int, int],
        writable: dict[int, Writable],
        refresh: Callable[[], None],
        resend: Callable[[int, int, int], None],
        released: Callable[[], None],
    ) -> None:
        self.memory = {first: bytearray(size) for first, size in sizes.items()}
        self.writable = writable
        self.refresh = refresh
        self.resend = resend
        self.released = released
        self.controller: Sender | None = None
        self.heard_s = 0.0
        self.newest: tuple[Sender, bytes] | None = None
        self.newest_answer: bytes | None = None

    # Memory

    def place(self, address: int, size: int) -> tuple[bytearray, int]:
        """The range that holds some bytes, and their place in it. Raises RefusedError if there is none."""
        for first, data in self.memory.items():
            if first <= address and address + size <= first + len(data):
                return data, address - first
        raise RefusedError(GvcpStatus.INVALID_ADDRESS)

    def put(self, address: int, value: Any, code: str = "I") -> None:
        """Set a register, by its type in struct."""
        data, at = self.place(address, struct.calcsize(f">{code}"))
        struct.pack_into(f">{code}", data, at, value)

    def value(self, address: int) -> int:
        """A register's four bytes."""
        data, at = self.place(address, 4)
        return int.from_bytes(data[at : at + 4])

    def read(self, address: int, size: int) -> bytes:
        """Bytes at an address, up to date."""
        if address % 4 or size % 4:
            raise RefusedError(GvcpStatus.BAD_ALIGNMENT)
        data, at = self.place(address, size)
        self.refresh()
        return bytes(data[at : at + size])

    def write(self, sender: Sender, address: int, data: bytes) -> None:
        """Write the registers from an address on, one after another, until one refuses."""
        if address == PRIVILEGE and len(data) == 4:
            self.set_privilege(sender, int.from_bytes(data))
            return
        if sender != self.controller:
            raise RefusedError(GvcpStatus.ACCESS_DENIED)
        while data:
            self.place(address, 4)
            register = self.writable.get(address)
            if register is None:
                raise RefusedError(GvcpStatus.WRITE_PROTECT)
            size = struct.calcsize(f">{register.code}")
            if len(data) < size:
                raise RefusedError(GvcpStatus.BAD_ALIGNMENT)
            try:
                held = register.take(struct.unpack(f">{register.code}", data[:size])[0])
            except InputError:
                raise RefusedError(GvcpStatus.INVALID_PARAMETER) from None
            self.put(address, held, register.code)
            address += size
            data = data[size:]

    # Privilege

    def set_privilege(self, sender: Sender, value: int) -> None:
        """Give the control to an application, or take it back from it."""
        if self.controller not in (None, sender):
            raise RefusedError(GvcpStatus.ACCESS_DENIED)
        if value & (CONTROL | EXCLUSIVE):
            self.controller = sender
            self.put(PRIVILEGE, value & (CONTROL | EXCLUSIVE))
        else:
            self.release()

    def release(self) -> None:
        """Take the control from the application that has it."""
        self.put(PRIVILEGE, 0)
        if self.controller is not None:
            self.controller = None
            self.released()

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
        self.check_heartbeat(now_s)
        if len(datagram) < HEADER.size or datagram[0] != KEY:
            return None
        if sender == self.controller:
            self.heard_s = now_s
        if (sender, datagram) == self.newest:
            return self.newest_answer
        _, flags, command, length, number = HEADER.unpack_from(datagram)
        if command == FORCEIP:
            return None  # the address is that of the machine
        payload = datagram[HEADER.size :]
        data = b""
        try:
            if len(payload) != length:
                raise RefusedError(GvcpStatus.INVALID_HEADER)
            data = self.execute(command, payload, sender)
            status = GvcpStatus.SUCCESS
        except RefusedError as error:
            status = error.status
        except struct.error:
            status = GvcpStatus.INVALID_HEADER
        if sender == self.controller:
            self.heard_s = now_s  # by this command, perhaps
        self.newest = (sender, datagram)
        wants_answer = flags & 1 and command != PACKETRESEND
        head = ANSWER.pack(status, (command + 1) & 0xFFFF, len(data), number)
        self.newest_answer = head + data if wants_answer else None
        return self.newest_answer

    def execute(self, command: int, payload: bytes, sender: Sender) -> bytes:
        """Carry out a command; return the answer's data. Raises RefusedError, and struct.error for a wrong length."""
        if command == DISCOVERY:
            return self.read(0, DISCOVERY_BYTES)
        if command == PACKETRESEND:
            _, block, first, last = struct.unpack(">HHII", payload)
            self.resend(block, first & 0xFFFFFF, last & 0xFFFFFF)
            return b""
        if self.controller != sender and self.value(PRIVILEGE) & EXCLUSIVE:
            raise RefusedError(GvcpStatus.ACCESS_DENIED)
        if command == READREG:
            addresses = struct.unpack(f">{len(payload) // 4}I", payload)
            if len(payload) > MOST_BYTES:
                raise RefusedError(GvcpStatus.INVALID_PARAMETER)
            return b"".join(self.read(address, 4) for address in addresses)
        if command == READMEM:
            address, size = struct.unpack(">II", payload)
            if size > MOST_BYTES:
                raise RefusedError(GvcpStatus.INVALID_PARAMETER)
            return struct.pack(">I", address) + self.read(address, size)
        if command == WRITEREG:
            pairs = list(struct.iter_unpack(">I4s", payload))
            for address, data in pairs:
                self.write(sender, address, data)
            return struct.pack(">HH", 0, len(pairs))
        if command == WRITEMEM:
            (address,) = struct.unpack_from(">I", payload)
            self.write(sender, address, payload[4:])
            return struct.pack(">HH", 0, len(payload) - 4)
        raise RefusedError(GvcpStatus.NOT_IMPLEMENTED)
