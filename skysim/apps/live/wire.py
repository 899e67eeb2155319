"""TCP server of a live flight: clients send lines of JSON, and receive packets of the channels that they take.

A client's first line is `{"take": ["imu", "state"], "token": "..."}`: the channels, and the token if the server has
one. Each further line is a command (commands.py), or another `take`. An error comes back as a packet of the channel
`error`; a command that is refused changes nothing.
"""

from __future__ import annotations

import contextlib
import functools
import socket
import threading
from collections import Counter
from collections.abc import Collection
from typing import Any

from skysim.apps.access import listen, token_matches
from skysim.apps.live.commands import Inbox, parse
from skysim.apps.live.packets import CHANNELS, Packet
from skysim.apps.live.sinks import Sink
from skysim.core.errors import InputError

SOCKET_TIMEOUT_S = 10.0  # time for a first line, and for a client to read what was sent
MOST_LINE_BYTES = 1 << 16
MOST_CLIENTS = 32


class WireClient:
    """One client: a thread that reads its lines, and a sink that sends its packets."""

    def __init__(self, server: WireServer, connection: socket.socket) -> None:
        self.server = server
        self.connection = connection
        connection.settimeout(SOCKET_TIMEOUT_S)
        connection.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
        self.sink = Sink("tcp", self.write, ())
        threading.Thread(target=self.read, name="wire", daemon=True).start()

    def write(self, packet: Packet) -> None:
        """Send a packet; the truth only to those who take it."""
        # A packet that is being read slowly must not block the reader's timeout, so both have the same.
        self.connection.sendall(packet.pack(has_truth="truth" in self.sink.channels))

    def reply(self, problem: str) -> None:
        """Tell the client of an error."""
        self.sink.offer(Packet({"channel": "error", "problem": problem}), patient=False)

    def read(self) -> None:
        """Body of the reader's thread: take lines until the client leaves, or breaks the rules of the first line."""
        try:
            with self.connection.makefile("rb") as lines:
                read_line = functools.partial(lines.readline, MOST_LINE_BYTES + 1)
                if self.enter(read_line()):
                    self.connection.settimeout(None)
                    for line in iter(read_line, b""):
                        if len(line) > MOST_LINE_BYTES:
                            self.reply(f"a line of more than {MOST_LINE_BYTES} bytes")
                            break
                        self.take(line)
        except OSError:
            pass
        finally:
            self.server.leave(self)

    def enter(self, line: bytes) -> bool:
        """Take the first line; return whether the client may go on."""
        try:
            token = parse(line).get("token", "")
        except InputError as error:
            self.reply(str(error))
            return False
        if self.server.token and not token_matches(str(token), self.server.token):
            self.reply("token missing or wrong; it is in the line that the server printed")
            return False
        self.take(line)
        return True

    def take(self, line: bytes) -> None:
        """Take a line: channels and a command."""
        try:
            command = parse(line)
            command.pop("token", None)
            if "take" in command:
                self.sink.channels = self.server.checked_channels(command.pop("take"))
                self.sink.offer(Packet({"channel": "hello"} | self.server.greeting), False)
                self.server.entered.set()
        except InputError as error:
            self.reply(str(error))
            return
        if command:
            self.server.inbox.put(command, self.reply)

    def close(self) -> None:
        """Send what is queued, and disconnect."""
        self.sink.close()
        with contextlib.suppress(OSError):
            self.connection.shutdown(socket.SHUT_RDWR)
        self.connection.close()


class WireServer:
    """Server of commands and packets. The interface is that of `Output`.

    Parameters
    ----------
    host, port
        Address; port 0 is any free one
    token
        Token that the first line must have; empty: none
    greeting
        Values of the packet `hello`, which answers `take`
    inbox
        Where commands go
    has_truth
        Whether clients may take the truth

    Raises
    ------
    InputError
        For an address that cannot be bound.
    """

    def __init__(
        self,
        host: str,
        port: int,
        token: str,
        greeting: dict[str, Any],
        inbox: Inbox,
        has_truth: bool = False,
    ) -> None:
        self.name = "tcp"
        self.fault = ""
        self.token = token
        self.greeting = greeting
        self.inbox = inbox
        self.has_truth = has_truth
        self.entered = threading.Event()
        self.lock = threading.Lock()
        self.clients: list[WireClient] = []
        self.earlier: dict[str, Counter[str]] = {"sent": Counter(), "dropped": Counter()}
        self.served = 0
        self.listener = listen("--tcp", host, port)
        self.port = int(self.listener.getsockname()[1])
        threading.Thread(target=self.accept, name="wire accept", daemon=True).start()

    def accept(self) -> None:
        """Body of the thread that waits for clients."""
        while True:
            try:
                connection, _ = self.listener.accept()
            except OSError:  # closed
                return
            with self.lock:
                if len(self.clients) < MOST_CLIENTS:
                    self.clients.append(WireClient(self, connection))
                    self.served += 1
                else:
                    connection.close()

    def checked_channels(self, value: Any) -> frozenset[str]:
        """Channels that a client takes. Raises InputError for unknown ones, and for the truth where it is off."""
        allowed = [name for name in CHANNELS if name != "truth" or self.has_truth]
        if not isinstance(value, list) or any(name not in allowed for name in value):
            hint = "" if self.has_truth else " (truth with --truth)"
            raise InputError("take", repr(value)[:60], ", ".join(allowed) + hint)
        return frozenset(value)

    def leave(self, client: WireClient) -> None:
        """Forget a client; its counters are added to the earlier ones."""
        client.close()
        with self.lock:
            if client in self.clients:
                self.clients.remove(client)
                self.add_counts(self.earlier, client)

    @staticmethod
    def add_counts(sums: dict[str, Counter[str]], client: WireClient) -> None:
        sums["sent"].update(client.sink.sent)
        sums["dropped"].update(client.sink.dropped)

    @property
    def channels(self) -> Collection[str]:
        """The channels that any client takes."""
        with self.lock:
            return frozenset[str]().union(*(client.sink.channels for client in self.clients))

    def offer(self, packet: Packet, patient: bool) -> None:
        """Offer a packet to each client that takes its channel."""
        with self.lock:
            clients = list(self.clients)
        for client in clients:
            if packet.channel in client.sink.channels and not client.sink.fault:
                client.sink.offer(packet, patient)

    def close(self) -> None:
        """Stop listening, and disconnect the clients after their queued packets."""
        self.listener.close()
        for client in list(self.clients):
            self.leave(client)

    def counters(self) -> dict[str, Any]:
        with self.lock:
            sums = {name: Counter(counter) for name, counter in self.earlier.items()}
            for client in self.clients:
                self.add_counts(sums, client)
        return {"clients": self.served} | {name: dict(sums[name]) for name in sums}
