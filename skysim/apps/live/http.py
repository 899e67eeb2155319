"""HTTP server of a live flight: MJPEG for display, packets for a tracker; newest frame, truth and counters on request.

The simulation thread posts each packet to the `FrameHub`; each client has a thread that waits on the hub's condition
variable and takes the newest packet. A slow client skips packets and does not delay the simulation or other clients.
"""

import contextlib
import json
import threading
from collections import Counter
from collections.abc import Callable
from dataclasses import asdict, dataclass
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from typing import TYPE_CHECKING, Any
from urllib.parse import parse_qs

from scipy.spatial.transform import Rotation

from skysim.apps.access import LOOPBACK, same_site, token_matches
from skysim.apps.live.packets import Packet
from skysim.apps.live.sinks import encode_png
from skysim.core import files
from skysim.core.errors import InputError
from skysim.core.paths import DATA
from skysim.results.plots import jpeg, to_8bit

if TYPE_CHECKING:
    from skysim.apps.live.display_pattern import DisplayPattern

BOUNDARY = "frame"
DISPLAY = ("/display", "/display.png")
SOCKET_TIMEOUT_S = 10.0  # timeout of a client that stops reading
FINISH_TIMEOUT_S = 5.0  # time for clients to take the last frame
INDEX = b"""<!doctype html><meta charset="utf-8"><title>skysim live</title>
<body style="margin:0;background:#0d1015;color:#8b95a5;font:13px system-ui"><img
src="/stream.mjpgQUERY" style="width:100%">
<p style="padding:0 12px">/stream.mjpg, /stream.raw, /frame.png, /frame.raw, /truth.json, /status.json</p>"""


@dataclass(eq=False)
class Client:
    """Counters of one client: frames sent, and frames dropped because it was too slow."""

    sent: int = 0
    dropped: int = 0


class FrameHub:
    """The newest packet, shared between the simulation thread and the clients' threads. It is an `Output`.

    Attributes
    ----------
    status
        Function that returns the counters of the flight
    pattern, instant
        Pattern of a display, and the function that returns the time and attitude which it shows; None without
    clients
        Connected clients
    earlier
        Number of disconnected clients, and the sums of their counters
    """

    name = "http"
    fault = ""
    channels = ("frame",)

    def __init__(self, status: Callable[[], dict[str, Any]]) -> None:
        self.status = status
        self.newest: Packet | None = None
        self.pattern: DisplayPattern | None = None
        self.instant: Callable[[], tuple[float, Rotation]] | None = None
        self.ended = False
        self.changed = threading.Condition()
        self.clients: list[Client] = []
        self.earlier = Counter(clients=0, sent=0, dropped=0)

    def connect(self) -> Client:
        with self.changed:
            self.clients.append(Client())
            return self.clients[-1]

    def disconnect(self, client: Client) -> None:
        """Merge a client into `earlier`, so that memory stays bounded."""
        with self.changed:
            self.clients.remove(client)
            self.earlier.update(clients=1, **asdict(client))
            self.changed.notify_all()

    def counters(self) -> dict[str, Any]:
        """Sums over the clients of all time."""
        with self.changed:
            sums = Counter(self.earlier)
            for client in self.clients:
                sums.update(clients=1, **asdict(client))
        return {
            "clients": sums["clients"],
            "sent": {"frame": sums["sent"]},
            "dropped": {"frame": sums["dropped"]},
        }

    def offer(self, packet: Packet, patient: bool) -> None:
        """Post a packet; a slow client skips it."""
        with self.changed:
            self.newest = packet
            self.changed.notify_all()

    def close(self) -> None:
        """End the stream; wait up to FINISH_TIMEOUT_S for the clients to take the last packet."""
        with self.changed:
            self.ended = True
            self.changed.notify_all()
            self.changed.wait_for(lambda: not self.clients, FINISH_TIMEOUT_S)

    def wait_newer(self, number: int) -> Packet | None:
        """Wait for a packet newer than `number` and return it; None if the stream has ended without one."""
        with self.changed:
            self.changed.wait_for(lambda: self.ended or self.has_newer(number))
            return self.newest if self.has_newer(number) else None

    def has_newer(self, number: int) -> bool:
        return self.newest is not None and self.newest.number > number


class Handler(BaseHTTPRequestHandler):
    """Request handler of one client. A slow client skips frames; `dropped` in the header counts them."""

    hub: FrameHub
    hosts: tuple[str, ...]
    token: str
    timeout = SOCKET_TIMEOUT_S

    def refusal(self) -> str:
        """Why the request is refused; empty if it is allowed."""
        headers = self.headers
        query = parse_qs(self.path.partition("?")[2])
        if self.token and not token_matches(query.get("token", [""])[0], self.token):
            return "token missing or wrong; open the address that the server printed: /?token=..."
        return same_site(headers.get("Host", ""), headers.get("Origin", ""), self.hosts)

    def do_GET(self) -> None:
        path = self.path.partition("?")[0]
        newest = self.hub.newest
        refusal = self.refusal()
        if refusal:
            self.send_error(403, refusal)
        elif path == "/":
            query = f"?token={self.token}" if self.token else ""
            self.respond(INDEX.replace(b"QUERY", query.encode()), "text/html")
        elif path == "/status.json":
            self.respond(
                files.to_json(self.hub.status()).encode(),
                "application/json",
            )
        elif path in DISPLAY and self.hub.pattern and self.hub.instant:
            if path.endswith(".png"):
                picture = self.hub.pattern.picture(*self.hub.instant())
                self.respond(encode_png(picture.gray), "image/png")
            else:
                self.respond((DATA / "display.html").read_bytes(), "text/html")
        elif path in ("/stream.mjpg", "/stream.raw"):
            self.stream(path.endswith("raw"))
        elif path not in ("/frame.png", "/frame.raw", "/truth.json"):
            self.send_error(
                404,
                "allowed: /, /stream.mjpg, /stream.raw, /frame.png, /frame.raw, /truth.json, /status.json",
            )
        elif newest is None:
            self.send_error(503, "no frame has been rendered yet")
        elif path == "/frame.png":
            self.respond(encode_png(newest.pixels), "image/png", newest.header)
        elif path == "/frame.raw":
            self.respond(newest.pack(), "application/octet-stream", newest.header)
        elif not newest.truth:
            self.send_error(404, "the truth is off; allowed: start with --truth")
        else:
            self.respond(
                files.to_json({**newest.header, "truth": dict(newest.truth)}).encode(),
                "application/json",
            )

    do_HEAD = do_GET  # the same without a body

    def respond(
        self, data: bytes, content_type: str, header: dict[str, Any] | None = None
    ) -> None:
        self.send_response(200)
        self.send_header("Content-Type", content_type)
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
        content_type = (
            "application/octet-stream"
            if raw
            else f"multipart/x-mixed-replace; boundary={BOUNDARY}"
        )
        self.send_header("Content-Type", content_type)
        self.send_header("Cache-Control", "no-store")
        self.end_headers()
        if self.command == "HEAD":
            return
        client = self.hub.connect()
        number = -1
        try:
            while packet := self.hub.wait_newer(number):
                # Packet numbers are consecutive, so a gap counts the packets that this client missed.
                client.dropped += packet.number - number - 1 if client.sent else 0
                number = packet.number
                packet = packet.plus_dropped(client.dropped)
                self.wfile.write(packet.pack() if raw else mjpeg_part(packet))
                client.sent += 1
        except OSError:  # the client has disconnected or timed out
            self.close_connection = True
        finally:
            self.hub.disconnect(client)

    def handle(self) -> None:
        """Handle the connection; ignore a client that disconnects during a response."""
        with contextlib.suppress(ConnectionError):
            super().handle()

    def log_message(self, *_: Any) -> None:
        """Suppress the access log."""


def mjpeg_part(packet: Packet) -> bytes:
    """One part of a multipart/x-mixed-replace response: a JPEG with header fields of the packet."""
    data = jpeg(to_8bit(packet.pixels, "square root"))
    head = f"--{BOUNDARY}\r\nContent-Type: image/jpeg\r\nContent-Length: {len(data)}\r\n"
    head += "".join(
        f"X-{name}: {packet.header[name]}\r\n"
        for name in ("index", "t_s", "due_unix_s", "dropped")
    )
    return head.encode() + b"\r\n" + data + b"\r\n"


def start_server(hub: FrameHub, host: str, port: int, token: str = "") -> ThreadingHTTPServer:
    """Start a server in background threads and return it.

    Parameters
    ----------
    token
        Token that each address must have, as `?token=...`; empty: none

    Raises
    ------
    InputError
        For an address that cannot be bound.
    """
    hosts = LOOPBACK if host in LOOPBACK else ("*",)
    handler = type("HubHandler", (Handler,), {"hub": hub, "hosts": hosts, "token": token})
    try:
        server = ThreadingHTTPServer((host, port), handler)
    except OSError as error:
        raise InputError(
            f"--http {port}", f"cannot listen on {host}:{port}: {error.strerror}"
        ) from None
    server.daemon_threads = True
    threading.Thread(target=server.serve_forever, name="http", daemon=True).start()
    return server
