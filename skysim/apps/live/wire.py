"""TCP server of a live flight: clients send lines of JSON, and receive packets of the channels that they take.

A client's first line is `{"take": ["imu", "state"], "token": "..."}`: the channels, and the token if the server has
one. Each further line is a command (commands.py), or another `take`. An error comes back as a packet of the channel
`error`; a command that is refused changes nothing.
"""

from __future__ import annotations

import contextlib
import socket
import struct
import threading
from collections import Counter
from collections.abc import Collection
from typing import Any

from skysim.apps.access import listen, token_matches
from skysim.apps.live.commands import parse
from skysim.apps.live.pacing import Live
from skysim.apps.live.packets import CHANNELS, Packet, Sink, start_thread
from skysim.core.errors import InputError

SOCKET_TIMEOUT_S = 10.0  # time for a first line, and for a client to read what was sent
MOST_LINE_BYTES = 1 << 16
MOST_CLIENTS = 32


class WireClient(Sink):
    """One client: a thread that reads its lines, and a sink that sends its packets."""

    def __init__(self, server: WireServer, connection: socket.socket) -> None:
        self.server = server
        self.connection = connection
        self.is_known = False  # it has sent the token
        connection.settimeout(SOCKET_TIMEOUT_S)
        connection.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
        super().__init__("tcp", self.send, ())
        start_thread(self.read, "wire")

    def send(self, packet: Packet) -> None:
        """Send a packet; the truth only to those who take it."""
        self.connection.sendall(packet.pack(has_truth="truth" in self.channels))

    def reply(self, problem: str) -> None:
        """Tell the client of an error."""
        self.offer(Packet({"channel": "error", "problem": problem}), patient=False)

    def read(self) -> None:
        """Body of the reader's thread: take lines until the client leaves, or breaks the rules of the first line."""
        try:
            with contextlib.suppress(OSError), self.connection.makefile("rb") as lines:
                while line := lines.readline(MOST_LINE_BYTES + 1):
                    try:
                        self.take(line)
                    except InputError as error:
                        self.reply(str(error))
                        if not self.is_known or len(line) > MOST_LINE_BYTES:
                            break
        finally:
            self.server.leave(self)

    def take(self, line: bytes) -> None:
        """Take a line: channels and a command. Raises InputError."""
        if len(line) > MOST_LINE_BYTES:
            raise InputError("", f"a line of more than {MOST_LINE_BYTES} bytes")
        server = self.server
        command = parse(line)
        token = str(command.pop("token", ""))
        if not self.is_known:
            if server.token and not token_matches(token, server.token):
                problem = "token missing or wrong; it is in the line that the server printed"
                raise InputError("", problem)
            if "take" not in command:
                raise InputError("take", "missing in the first line", '["imu", "solution"]')
            self.is_known = True
            # From now on it may be silent, but must read: a flight as fast as possible waits for it.
            self.connection.settimeout(None)
            limit = struct.pack("ll", int(SOCKET_TIMEOUT_S), 0)
            self.connection.setsockopt(socket.SOL_SOCKET, socket.SO_SNDTIMEO, limit)
        if "take" in command:
            self.channels = server.checked_channels(command.pop("take"))
            self.offer(Packet({"channel": "hello"} | server.live.greeting), False)
            server.live.entered.set()
        if command:
            server.live.inbox.put(command, self.reply)

    def close(self) -> None:
        """Send what is queued, and disconnect."""
        super().close()
        with contextlib.suppress(OSError):
            self.connection.shutdown(socket.SHUT_RDWR)
        self.connection.close()


class WireServer:
    """Server of commands and packets. The interface is that of `Output`.

    Parameters
    ----------
    live
        Flight: it takes the commands, and its greeting, as packet `hello`, answers `take`
    host, port
        Address; port 0 is any free one
    token
        Token that the first line must have; empty: none

    Raises
    ------
    InputError
        For an address that cannot be bound.
    """

    name = "tcp"
    fault = ""

    def __init__(self, live: Live, host: str, port: int, token: str) -> None:
        self.live = live
        self.token = token
        self.lock = threading.Lock()
        self.clients: list[WireClient] = []
        # Counters of clients that have left.
        self.sent = Counter[str]()
        self.dropped = Counter[str]()
        self.served = 0
        self.listener = listen("--tcp", host, port)
        self.port = int(self.listener.getsockname()[1])
        start_thread(self.accept, "wire accept")

    def accept(self) -> None:
        """Body of the thread that waits for clients."""
        with contextlib.suppress(OSError):  # closed
            while True:
                connection, _ = self.listener.accept()
                with self.lock:
                    if len(self.clients) < MOST_CLIENTS:
                        self.clients.append(WireClient(self, connection))
                        self.served += 1
                    else:
                        connection.close()

    def checked_channels(self, value: Any) -> frozenset[str]:
        """Channels that a client takes. Raises InputError for unknown ones, and for the truth where it is off."""
        has_truth = self.live.has_truth
        absent = set() if has_truth else {"truth"}
        if self.live.flight.motion.navigation is None:
            absent.add("imu")
        allowed = [name for name in CHANNELS if name not in absent]
        if not isinstance(value, list) or any(name not in allowed for name in value):
            hint = " (truth with --truth, imu with vehicle.imu)" if absent else ""
            raise InputError("take", repr(value)[:60], ", ".join(allowed) + hint)
        return frozenset(value)

    def leave(self, client: WireClient) -> None:
        """Forget a client; its counters are added to the earlier ones."""
        client.close()
        with self.lock:
            if client in self.clients:
                self.clients.remove(client)
                self.sent += client.sent
                self.dropped += client.dropped

    @property
    def channels(self) -> Collection[str]:
        """The channels that any client takes."""
        return frozenset[str]().union(*(client.channels for client in list(self.clients)))

    def offer(self, packet: Packet, patient: bool) -> None:
        """Offer a packet to each client that takes its channel."""
        for client in list(self.clients):
            if packet.channel in client.channels and not client.fault:
                client.offer(packet, patient)

    def close(self) -> None:
        """Stop listening, and disconnect the clients after their queued packets."""
        self.listener.close()
        for client in list(self.clients):
            self.leave(client)

    def counters(self) -> dict[str, Any]:
        with self.lock:
            return {
                "clients": self.served,
                "sent": dict(sum((one.sent for one in self.clients), self.sent)),
                "dropped": dict(sum((one.dropped for one in self.clients), self.dropped)),
            }
