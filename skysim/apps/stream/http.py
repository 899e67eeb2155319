"""Frames over HTTP: MJPEG for the eye, packets for a tracker, the newest frame, truth and tallies for who asks."""

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
PATIENCE_S = 10.0  # with a client that takes nothing
GRACE_S = 5.0  # for who still takes the last frame at the end
REMEMBERED = 20  # clients that left
INDEX = b"""<!doctype html><meta charset="utf-8"><title>skysim stream</title>
<body style="margin:0;background:#0d1015;color:#8b95a5;font:13px system-ui"><img src="/stream.mjpg" style="width:100%">
<p style="padding:0 12px">/stream.mjpg, /stream.raw, /frame.png, /frame.raw, /truth.json, /status.json</p>"""


@dataclass(eq=False)
class Client:
    """Of one: frames sent, frames that it was too slow for."""

    sent: int = 0
    dropped: int = 0


class Board:
    """The newest packet, and who waits for the next.

    clients : who is there, and the REMEMBERED that left last;  earlier : how many left before them, and their frames
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
        """Somebody begins to watch."""
        with self.changed:
            self.clients.append(Client())
            return self.clients[-1]

    def leave(self, client: Client) -> None:
        """And ends it. Of who left long ago the sums are kept, so that memory is constant."""
        with self.changed:
            self.left.append(client)
            self.changed.notify_all()
            if len(self.left) > REMEMBERED:
                old = self.left.popleft()
                self.clients.remove(old)
                for name, more in (("clients", 1), ("sent", old.sent), ("dropped", old.dropped)):
                    self.earlier[name] += more

    def tallies(self) -> dict[str, Any]:
        """What each client was sent, and what it was too slow for."""
        with self.changed:
            told = [{"sent": one.sent, "dropped": one.dropped} for one in self.clients]
            return {"clients": told, "earlier_clients": dict(self.earlier)}

    def post(self, packet: Packet) -> None:
        with self.changed:
            self.newest = packet
            self.changed.notify_all()

    def end(self) -> None:
        """No more packets come; who watches is given some time to take the last."""
        with self.changed:
            self.ended = True
            self.changed.notify_all()
            self.changed.wait_for(lambda: len(self.clients) == len(self.left), GRACE_S)

    def after(self, number: int) -> Packet | None:
        """The next packet that is newer; None once it has ended and the last was given."""
        with self.changed:
            self.changed.wait_for(lambda: self.ended or self.newer(number))
            return self.newest if self.newer(number) else None

    def newer(self, number: int) -> bool:
        return self.newest is not None and self.newest.number > number


class Handler(BaseHTTPRequestHandler):
    """One client. What it is too slow for it does not get; it is told by `dropped` how much that was."""

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
        """One thing, whole."""
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
        """Frame after frame: packets one after another, or parts of JPEG with their header's numbers."""
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
                mine.dropped += packet.number - number - 1 if mine.sent else 0
                number = packet.number
                told = packet.after(mine.dropped)
                self.wfile.write(told.pack() if raw else part(told))
                mine.sent += 1
        except OSError:  # it has gone
            self.close_connection = True
        finally:
            self.board.leave(mine)

    def handle(self) -> None:
        """A client that goes in the middle of an answer is no fault of ours."""
        with contextlib.suppress(ConnectionError):
            super().handle()

    def log_message(self, *_: Any) -> None:
        """Nobody reads it."""


def part(packet: Packet) -> bytes:
    """A part of a multipart answer."""
    data = jpeg(stretched(packet.pixels, "square root"))
    head = f"--{BOUNDARY}\r\nContent-Type: image/jpeg\r\nContent-Length: {len(data)}\r\n"
    head += "".join(
        f"X-{name}: {packet.header[name]}\r\n" for name in ("index", "t_s", "due_unix_s", "dropped")
    )
    return head.encode() + b"\r\n" + data + b"\r\n"


def served(board: Board, host: str, port: int) -> ThreadingHTTPServer:
    """A server in threads of its own. Raises InputError where the address is taken."""
    handler = type("Here", (Handler,), {"board": board})
    try:
        server = ThreadingHTTPServer((host, port), handler)
    except OSError as error:
        raise InputError(f"--http {port}: {host}:{port} cannot be served: {error.strerror}") from None
    server.daemon_threads = True
    threading.Thread(target=server.serve_forever, name="http", daemon=True).start()
    return server
