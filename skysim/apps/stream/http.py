"""HTTP server of a stream: MJPEG for display, packets for a tracker; newest frame, truth and counters on request.

The simulation thread posts each packet to the `Board`; each client has a thread that waits on the board's condition
variable and takes the newest packet. A slow client skips packets and does not delay the simulation or other clients.
"""

from __future__ import annotations

import contextlib
import json
import threading
from collections import deque
from collections.abc import Callable
from dataclasses import dataclass
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from typing import Any

from skysim.apps.stream.packet import Packet
from skysim.apps.stream.sinks import png
from skysim.core import files
from skysim.core.errors import InputError
from skysim.results.stretch import jpeg, stretched

BOUNDARY = "frame"
PATIENCE_S = 10.0  # socket timeout for a client that stops reading
GRACE_S = 5.0  # for clients to take the last frame at the end
REMEMBERED = 20  # disconnected clients with their own counters
INDEX = b"""<!doctype html><meta charset="utf-8"><title>skysim stream</title>
<body style="margin:0;background:#0d1015;color:#8b95a5;font:13px system-ui"><img src="/stream.mjpg" style="width:100%">
<p style="padding:0 12px">/stream.mjpg, /stream.raw, /frame.png, /frame.raw, /truth.json, /status.json</p>"""


@dataclass(eq=False)
class Client:
    """Counters of one client: frames sent, and frames dropped because it was too slow."""

    sent: int = 0
    dropped: int = 0


class Board:
    """The newest packet, shared between the simulation thread and the clients' threads.

    status  : returns the sender's counters
    clients : connected clients and the last REMEMBERED that disconnected
    earlier : number of clients that disconnected before those, and the sums of their counters
    """

    def __init__(self, status: Callable[[], dict[str, Any]]) -> None:
        self.status = status
        self.newest: Packet | None = None
        self.ended = False
        self.changed = threading.Condition()
        self.clients: list[Client] = []
        self.left: deque[Client] = deque()
        self.earlier = {"clients": 0, "sent": 0, "dropped": 0}

    def come(self) -> Client:
        """Register a client."""
        with self.changed:
            self.clients.append(Client())
            return self.clients[-1]

    def leave(self, client: Client) -> None:
        """Mark a client as disconnected. The oldest ones are merged into `earlier`, so that memory stays bounded."""
        with self.changed:
            self.left.append(client)
            self.changed.notify_all()
            if len(self.left) > REMEMBERED:
                old = self.left.popleft()
                self.clients.remove(old)
                for name, more in (("clients", 1), ("sent", old.sent), ("dropped", old.dropped)):
                    self.earlier[name] += more

    def tallies(self) -> dict[str, Any]:
        """Counters of each client, and the sums of the earlier ones."""
        with self.changed:
            told = [{"sent": one.sent, "dropped": one.dropped} for one in self.clients]
            return {"clients": told, "earlier_clients": dict(self.earlier)}

    def post(self, packet: Packet) -> None:
        with self.changed:
            self.newest = packet
            self.changed.notify_all()

    def end(self) -> None:
        """End the stream; wait up to GRACE_S for the clients to take the last packet."""
        with self.changed:
            self.ended = True
            self.changed.notify_all()
            self.changed.wait_for(lambda: len(self.clients) == len(self.left), GRACE_S)

    def after(self, number: int) -> Packet | None:
        """Wait for a packet newer than `number` and return it; None if the stream has ended without one."""
        with self.changed:
            self.changed.wait_for(lambda: self.ended or self.newer(number))
            return self.newest if self.newer(number) else None

    def newer(self, number: int) -> bool:
        return self.newest is not None and self.newest.number > number


class Handler(BaseHTTPRequestHandler):
    """Request handler of one client. A slow client skips frames; `dropped` in the header says how many so far."""

    board: Board
    timeout = PATIENCE_S

    def do_GET(self) -> None:
        path = self.path.partition("?")[0]
        newest = self.board.newest
        if path == "/":
            self.answer(INDEX, "text/html")
        elif path == "/status.json":
            self.answer(
                files.to_json(self.board.status() | self.board.tallies()).encode(), "application/json"
            )
        elif path in ("/stream.mjpg", "/stream.raw"):
            self.stream(path.endswith("raw"))
        elif path not in ("/frame.png", "/frame.raw", "/truth.json"):
            self.send_error(
                404,
                "allowed: /, /stream.mjpg, /stream.raw, /frame.png, /frame.raw, /truth.json, /status.json",
            )
        elif newest is None:
            self.send_error(503, "no frame yet")
        elif path == "/frame.png":
            self.answer(png(newest), "image/png", newest.header)
        elif path == "/frame.raw":
            self.answer(newest.pack(), "application/octet-stream", newest.header)
        else:
            self.answer(files.to_json({**newest.header, "truth": newest.truth}).encode(), "application/json")

    do_HEAD = do_GET  # the same without a body

    def answer(self, data: bytes, kind: str, header: dict[str, Any] | None = None) -> None:
        """Send a complete response."""
        self.send_response(200)
        self.send_header("Content-Type", kind)
        self.send_header("Content-Length", str(len(data)))
        self.send_header("Cache-Control", "no-store")
        if header:
            self.send_header("X-Skysim-Header", json.dumps(header))
        self.end_headers()
        if self.command != "HEAD":
            self.wfile.write(data)

    def stream(self, raw: bool) -> None:
        """Send frames until the stream ends: packets if `raw`, else multipart JPEG with numbers from the header."""
        self.send_response(200)
        kind = "application/octet-stream" if raw else f"multipart/x-mixed-replace; boundary={BOUNDARY}"
        self.send_header("Content-Type", kind)
        self.send_header("Cache-Control", "no-store")
        self.end_headers()
        if self.command == "HEAD":
            return
        mine, number = self.board.come(), -1
        try:
            while packet := self.board.after(number):
                # Packet numbers are consecutive, so a gap counts the packets that this client missed.
                mine.dropped += packet.number - number - 1 if mine.sent else 0
                number = packet.number
                told = packet.after(mine.dropped)
                self.wfile.write(told.pack() if raw else part(told))
                mine.sent += 1
        except OSError:  # the client has disconnected or timed out
            self.close_connection = True
        finally:
            self.board.leave(mine)

    def handle(self) -> None:
        """Handle the connection; ignore a client that disconnects during a response."""
        with contextlib.suppress(ConnectionError):
            super().handle()

    def log_message(self, *_: Any) -> None:
        """Suppress the access log."""


def part(packet: Packet) -> bytes:
    """One part of a multipart/x-mixed-replace response: a JPEG with header fields of the packet."""
    data = jpeg(stretched(packet.pixels, "square root"))
    head = f"--{BOUNDARY}\r\nContent-Type: image/jpeg\r\nContent-Length: {len(data)}\r\n"
    head += "".join(
        f"X-{name}: {packet.header[name]}\r\n" for name in ("index", "t_s", "due_unix_s", "dropped")
    )
    return head.encode() + b"\r\n" + data + b"\r\n"


def served(board: Board, host: str, port: int) -> ThreadingHTTPServer:
    """Start a server in background threads and return it. Raises InputError if the address cannot be bound."""
    handler = type("Here", (Handler,), {"board": board})
    try:
        server = ThreadingHTTPServer((host, port), handler)
    except OSError as error:
        raise InputError(f"--http {port}: {host}:{port} cannot be served: {error.strerror}") from None
    server.daemon_threads = True
    threading.Thread(target=server.serve_forever, name="http", daemon=True).start()
    return server
