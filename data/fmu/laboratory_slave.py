"""The process of a laboratory's unit of co-simulation: flies the scene that lies beside it, as laboratory.c asks.

Its standard input is a socket. A request is two numbers (what, periods) and the values of all variables, eight bytes
each; the answer is two numbers (status, length), then all values, or a message if the status is not 0.
"""

from __future__ import annotations

import os
import signal
import socket
import struct
import sys
from pathlib import Path
from typing import Any

import numpy as np
import yaml

SETUP = yaml.safe_load(
    (Path(__file__).parent / "laboratory.yaml").read_text(encoding="utf-8")
)
sys.path.insert(0, SETUP["path"])

from skysim.core.errors import InputError  # noqa: E402
from skysim.results.files.fmu import LabUnit, UnitVariable, variables  # noqa: E402
from skysim.scene.loader import load  # noqa: E402

BEGIN = 0
OK = 0
ERROR = 3
HEAD = struct.Struct("=qq")


class Values:
    """The values of a table of variables, in cells of eight bytes."""

    def __init__(self, table: list[UnitVariable]) -> None:
        self.table = table
        codes = (one.code.replace("?", "q") * np.size(one.start) for one in table)
        self.cells = struct.Struct("=" + "".join(codes))

    def read(self, data: bytes) -> dict[str, Any]:
        """Values by name."""
        cells = iter(self.cells.unpack(data))
        found = {}
        for one in self.table:
            values = [next(cells) for _ in range(np.size(one.start))]
            found[one.name] = np.array(values) if np.ndim(one.start) else values[0]
        return found

    def write(self, values: dict[str, Any]) -> bytes:
        """The inverse of `read`."""
        cells = [np.ravel(values[one.name]).tolist() for one in self.table]
        return self.cells.pack(*(cell for own in cells for cell in own))


def receive(channel: socket.socket, size: int) -> bytes:
    """So many bytes; the process ends where the other side has closed the socket."""
    data = b""
    while len(data) < size:
        part = channel.recv(size - len(data))
        if not part:
            raise SystemExit
        data += part
    return data


def refuse(channel: socket.socket, error: Exception) -> None:
    """Answer that something is wrong."""
    message = str(error).encode()[:2000]
    channel.sendall(HEAD.pack(ERROR, len(message)) + message)


def serve(channel: socket.socket) -> None:
    """Answer requests until the socket is closed."""
    try:
        unit = LabUnit(load(SETUP["scene"], refuses_unused=False))
    except InputError as error:
        refuse(channel, error)
        while channel.recv(4096):
            pass  # what was asked, until the host has closed the socket
        return
    values = Values(variables(unit))
    while True:
        what, periods = HEAD.unpack(receive(channel, HEAD.size))
        given = values.read(receive(channel, values.cells.size))
        try:
            if what == BEGIN:
                unit.flight.close()
                unit.begin(given["seed"])
            else:
                unit.step(given, periods)
        except (InputError, ValueError, RuntimeError) as error:
            refuse(channel, error)
        else:
            # What the host has set stays as it is.
            channel.sendall(HEAD.pack(OK, 0) + values.write(given | unit.outputs))


if __name__ == "__main__":
    signal.signal(signal.SIGINT, signal.SIG_IGN)  # of the host, which closes the socket
    to_host = socket.socket(fileno=os.dup(0))
    os.dup2(os.open(os.devnull, os.O_RDONLY), 0)
    serve(to_host)
