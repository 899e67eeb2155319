"""HTTP server of a live flight: MJPEG for display; the newest frame, its truth and the counters on request.

The simulation thread posts each frame to the `FrameServer`; each client has a thread that waits on its condition
variable and takes the newest frame. A slow client skips frames and does not delay the simulation or other clients.
"""

import json
import threading
from collections.abc import Callable
from contextlib import suppress
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from typing import TYPE_CHECKING, Any
from urllib.parse import parse_qs

from skysim.apps.access import names_address, same_site, token_matches
from skysim.apps.live.packets import Packet, encode_png, start_thread
from skysim.core import files
from skysim.core.paths import DATA
from skysim.results.plots import jpeg, to_8bit

if TYPE_CHECKING:
    from skysim.apps.live.display_pattern import DisplayPicture

SOCKET_TIMEOUT_S = 5.0  # timeout of a client that stops reading
INDEX = """<!doctype html><meta charset="utf-8"><title>skysim live</title>
<body style="margin:0;background:#0d1015;color:#8b95a5;font:13px system-ui"><img
src="/stream.mjpgQUERY" style="width:100%">
<p style="padding:0 12px">/stream.mjpg, /frame.png, /truth.json, /status.json</p>"""


class FrameServer(ThreadingHTTPServer):
    """Server of the newest frame, which the simulation thread and the clients' threads share. It is an `Output`.

    Parameters
    ----------
    status
        Function that returns the counters of the flight
    host, port
        Address; port 0 is any free one
    token
        Token that each address must have, as `?token=...`; empty: none

    Attributes
    ----------
    show
        Function that returns the present picture for a display; None without
    sent
        Number of frames that streams have taken

    Raises
    ------
    InputError
        For an address that cannot be bound.
    """

    name = "http"
    fault = ""
    channels = ("frame",)
    daemon_threads = False  # so that `server_close` waits for the clients

    def __init__(
        self, status: Callable[[], dict[str, Any]], host: str, port: int, token: str = ""
    ) -> None:
        self.status = status
        self.host = host
        self.token = token
        self.show: Callable[[], DisplayPicture] | None = None
        self.newest: Packet | None = None
        self.ended = False
        self.sent = 0
        self.changed = threading.Condition()
        with names_address("--http", host, port):
            super().__init__((host, port), Handler)
        start_thread(self.serve_forever, "http")

    def counters(self) -> dict[str, Any]:
        return {"sent": {"frame": self.sent}, "dropped": {}}

    def offer(self, packet: Packet, patient: bool) -> None:
        """Post a frame; a slow client skips it."""
        with self.changed:
            self.newest = packet
            self.changed.notify_all()

    def close(self) -> None:
        """End the streams once the clients have taken the last frame, or have timed out."""
        with self.changed:
            self.ended = True
            self.changed.notify_all()
        self.shutdown()
        self.server_close()

    def newer_than(self, taken: Packet | None) -> Packet | None:
        """Wait for another frame than the one taken last; None at the end."""
        with self.changed:
            self.changed.wait_for(lambda: self.ended or self.newest is not taken)
            if self.newest is taken:
                return None
            self.sent += 1
            return self.newest


class Handler(BaseHTTPRequestHandler):
    """Request handler of one client."""

    server: FrameServer
    timeout = SOCKET_TIMEOUT_S

    def refusal(self, query: str) -> str:
        """Why the request is refused; empty if it is allowed."""
        server = self.server
        token = parse_qs(query).get("token", [""])[0]
        if server.token and not token_matches(token, server.token):
            return "token missing or wrong; open the address that the server printed: /?token=..."
        headers = self.headers
        return same_site(headers.get("Host", ""), headers.get("Origin", ""), server.host)

    def do_GET(self) -> None:
        path, _, query = self.path.partition("?")
        server = self.server
        newest = server.newest
        refusal = self.refusal(query)
        if refusal:
            self.send_error(403, refusal)
        elif path == "/":
            token = f"?token={server.token}" if server.token else ""
            self.respond("text/html", INDEX.replace("QUERY", token).encode())
        elif path == "/status.json":
            self.respond("application/json", files.to_json(server.status()).encode())
        elif path == "/display" and server.show:
            self.respond("text/html", (DATA / "display.html").read_bytes())
        elif path == "/display.png" and server.show:
            self.respond("image/png", encode_png(server.show().gray))
        elif path == "/stream.mjpg":
            self.stream()
        elif path not in ("/frame.png", "/truth.json"):
            self.send_error(
                404, "allowed: /, /stream.mjpg, /frame.png, /truth.json, /status.json"
            )
        elif newest is None:
            self.send_error(503, "no frame has been rendered yet")
        elif path == "/frame.png":
            header = json.dumps(newest.header)
            self.respond(
                "image/png", encode_png(newest.pixels), **{"X-Skysim-Header": header}
            )
        elif not newest.truth:
            self.send_error(404, "the truth is off; allowed: start with --truth")
        else:
            text = files.to_json(newest.header_with_truth)
            self.respond("application/json", text.encode())

    do_HEAD = do_GET  # the same without a body

    def begin(self, **fields: str) -> bool:
        """Send the head of a response; return whether a body follows."""
        self.send_response(200)
        for name, value in {"Cache-Control": "no-store", **fields}.items():
            self.send_header(name, value)
        self.end_headers()
        return self.command != "HEAD"

    def respond(self, content_type: str, data: bytes, **fields: str) -> None:
        fields |= {"Content-Type": content_type, "Content-Length": str(len(data))}
        if self.begin(**fields):
            self.wfile.write(data)

    def stream(self) -> None:
        """Send frames as multipart JPEG, with numbers from the header, until the stream ends."""
        packet = None
        if self.begin(**{"Content-Type": "multipart/x-mixed-replace; boundary=frame"}):
            while packet := self.server.newer_than(packet):
                data = jpeg(to_8bit(packet.pixels, "square root"))
                head = "--frame\r\nContent-Type: image/jpeg\r\n"
                head += f"Content-Length: {len(data)}\r\n"
                for name in ("index", "t_s", "due_unix_s", "dropped"):
                    head += f"X-{name}: {packet.header[name]}\r\n"
                self.wfile.write(head.encode() + b"\r\n" + data + b"\r\n")

    def handle(self) -> None:
        """Handle the connection; ignore a client that disconnects or times out during a response."""
        with suppress(OSError):
            super().handle()

    def log_message(self, *_: Any) -> None:
        """Suppress the access log."""
