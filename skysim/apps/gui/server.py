"""HTTP server of the GUI: routes, and an access check in front of all of them."""

import asyncio
import ctypes
import gc
import re
import secrets
import signal
import time
from collections.abc import Mapping, Sequence
from contextlib import suppress
from functools import partial
from pathlib import Path
from posixpath import normpath
from typing import Any
from urllib.parse import quote

import nicegui
from nicegui import app, core, ui
from starlette.datastructures import MutableHeaders
from starlette.middleware.exceptions import ExceptionMiddleware
from starlette.middleware.gzip import GZipMiddleware
from starlette.requests import HTTPConnection, Request
from starlette.responses import (
    FileResponse,
    PlainTextResponse,
    RedirectResponse,
    Response,
    StreamingResponse,
)
from starlette.routing import Route, Router

from skysim.apps.access import LOOPBACK, same_site, token_matches
from skysim.apps.gui.page.photo_panel import LIMIT_BYTES
from skysim.apps.gui.page.tab import Tab
from skysim.apps.gui.views.overlay import FRAMES, display_of
from skysim.apps.gui.worker.session import Workers
from skysim.apps.gui.worker.study_process import StudyProcess, is_shown
from skysim.core.constants import DAY_S
from skysim.core.types import Record
from skysim.scene.loader import find

# Garbage collection of the server, at times when no page gets a frame.


# Number of new objects before a collection, and numbers of collections before one of older objects.
THRESHOLDS = (2_000, 10, 1_000)
QUIET_S = 1.0  # time without a closed page and without a new frame before closed pages are collected
PATIENCE_S = 60.0  # time after which they are collected even while pages get frames


def prepare() -> None:
    """Keep connections whose browsers answer late, and limit automatic garbage collections to new objects.

    A full collection takes half a second with 20 pages, during which no key is served. Only `ClosedPages` starts one.
    """
    # NiceGUI derives both times from the reconnect time.
    core.sio.eio.ping_interval = PING_INTERVAL_S
    core.sio.eio.ping_timeout = PING_TIMEOUT_S
    # Imported objects are never collected.
    gc.collect()
    gc.freeze()
    gc.set_threshold(*THRESHOLDS)


def release_memory() -> None:
    """Collect closed pages and return their memory to the system, which glibc's allocator would keep."""
    gc.collect()
    trim = getattr(ctypes.CDLL(None), "malloc_trim", None)
    if trim:
        trim(0)


class ClosedPages:
    """Collects closed pages together when no page gets a frame, at the latest after PATIENCE_S."""

    def __init__(self) -> None:
        self.waiting: asyncio.Task[None] | None = None

    def collect_soon(self) -> None:
        """Collect when the pages are quiet."""
        if self.waiting is None:
            self.waiting = asyncio.create_task(self.collect())

    async def collect(self) -> None:
        end_s = time.monotonic() + PATIENCE_S
        await asyncio.sleep(QUIET_S)
        while (now_s := time.monotonic()) < end_s and any(
            now_s - frames.added_s < QUIET_S for frames in FRAMES.values()
        ):
            await asyncio.sleep(QUIET_S)
        self.waiting = None  # pages closed from now on need another collection
        await asyncio.to_thread(release_memory)


# Only this server's own code runs in the page, and no other site may frame it. NiceGUI needs inline code and `eval`.
PAGE_POLICY = (
    "default-src 'self'; script-src 'self' 'unsafe-inline' 'unsafe-eval'; style-src 'self' 'unsafe-inline';"
    " img-src 'self' data: blob:; font-src 'self' data:; worker-src 'self' blob:; object-src 'none'; base-uri 'none';"
    " form-action 'self'; frame-ancestors 'none'"
)
REPORT_POLICY = (
    "default-src 'none'; img-src data:; style-src 'unsafe-inline'; script-src 'unsafe-inline'; "
    "frame-ancestors 'none'"
)
SECURITY_HEADERS = {
    "x-frame-options": "DENY",
    "x-content-type-options": "nosniff",
    "referrer-policy": "no-referrer",
}
# Noise is not compressible: gzip at its default level takes half a second for a frame.
FRAME_HEADERS = {"cache-control": "no-store", "content-encoding": "identity"}
FILES = f"/_nicegui/{nicegui.__version__}"
USER = "skysim_user"  # cookie with the number of a browser
USER_BYTES = 8
YEAR_S = 365 * int(DAY_S)
QUEUED = "This page opens when another one has been closed."
CONNECT_TIMEOUT_S = 50.0  # time for a browser to load the page
RECONNECT_S = 6.0  # time for a lost browser to reconnect before its work is ended
PING_INTERVAL_S = 5.0  # interval of pings on the connection
PING_TIMEOUT_S = 30.0  # long, because a busy machine answers late


async def frame(request: Request) -> Response:
    """A frame of a tab, see `ServedFrame`; 404 if it is no longer among the newest.

    The query is that of `display_of`, and `whole`: whether all pixels are needed.
    """
    frames = FRAMES.get(request.path_params["tab"])
    served = frames and frames.newest.get(request.path_params["number"])
    display = display_of(request.query_params)
    data = (
        await served.response(display, "whole" in request.query_params)
        if served and display
        else None
    )
    if data is None:
        return Response(status_code=404)
    return Response(data, media_type="application/octet-stream", headers=FRAME_HEADERS)


async def stream(request: Request) -> Response:
    """The next frames of a tab (`TabFrames.stream`); 404 if there is no such tab. The query is that of `display_of`."""
    frames = FRAMES.get(request.path_params["tab"])
    display = display_of(request.query_params)
    if not frames or not display:
        return Response(status_code=404)
    return StreamingResponse(
        frames.stream(display), media_type="application/octet-stream", headers=FRAME_HEADERS
    )


# Frames bypass the application's own layers, each of which takes a tenth of the time that a frame may take.
FRAME_ROUTES = ExceptionMiddleware(
    Router([Route("/frame/{tab}/{number:int}", frame), Route("/frame/{tab}/next", stream)])
)


class KeptFiles:
    """ASGI layer that keeps the page's code and styles after their first response.

    A page loads about 40 of these files at once. NiceGUI's layers take 3 ms for each, during which the keys of other
    pages wait.
    """

    def __init__(self, app: Any) -> None:
        self.app = app
        self.kept = dict[tuple[str, bool], list[Record]]()

    async def __call__(self, scope: Any, receive: Any, send: Any) -> None:
        if not is_plain_file(scope):
            await self.app(scope, receive, send)
            return
        encodings = dict(scope["headers"]).get(b"accept-encoding", b"")
        key = (scope["path"], b"gzip" in encodings)
        messages: list[Record] = []

        async def keep(message: Record) -> None:
            messages.append(dict(message))  # a copy, since layers further out add headers
            await send(message)

        if key not in self.kept:
            await self.app(scope, receive, keep)
            if (
                messages
                and messages[0].get("status") == 200
                and not messages[-1].get("more_body")
            ):
                self.kept[key] = messages
            return
        for message in self.kept[key]:
            await send(dict(message))


def is_plain_file(scope: Any) -> bool:
    """Whether a request is for a whole file of NiceGUI or of this page's elements, which never changes."""
    if scope["type"] != "http" or scope["method"] != "GET" or scope["query_string"]:
        return False
    path = scope["path"]
    is_file = path.startswith(f"{FILES}/") and not path.startswith(
        f"{FILES}/dynamic_resources/"
    )
    return is_file and normpath(path) == path and b"range" not in dict(scope["headers"])


class Guard:
    """ASGI middleware that refuses unknown hosts, requests of other sites or without token, and large requests.

    Attributes
    ----------
    host
        Address that the server listens on, for `same_site`
    token
        Required access token; `/?token=...` stores it in a cookie
    port
        Port of the server. Browsers send a host's cookies to all its ports, so the name of the
        cookie contains the port
    """

    def __init__(self, app: Any, host: str, token: str, port: int) -> None:
        self.app = KeptFiles(app)
        self.host = host
        self.token = token
        self.cookie = f"skysim_gui_{port}"

    async def __call__(self, scope: Any, receive: Any, send: Any) -> None:
        if scope["type"] not in ("http", "websocket"):
            await self.app(scope, receive, send)
            return
        response = self.refusal(HTTPConnection(scope))
        if response is None:
            inner = FRAME_ROUTES if scope["path"].startswith("/frame/") else self.app
            await inner(scope, limited(receive), with_policy(send))
        elif scope["type"] == "http":
            await response(scope, receive, send)
        else:
            await send({"type": "websocket.close", "code": 1008})

    def refusal(self, request: HTTPConnection) -> Response | None:
        """The response to a refused request; None if it is allowed."""
        headers = request.headers
        refused = same_site(headers.get("host", ""), headers.get("origin", ""), self.host)
        if refused:
            return PlainTextResponse(refused, 403)
        if int(headers.get("content-length") or 0) > LIMIT_BYTES + 2**16:
            return PlainTextResponse("request too large; allowed: 64 MB", 413)
        # The token is removed from the address.
        if token_matches(request.query_params.get("token", ""), self.token):
            response = RedirectResponse("/", 303)
            user = user_of(request.cookies) or secrets.token_hex(USER_BYTES)
            for name, value, age_s in ((self.cookie, self.token, None), (USER, user, YEAR_S)):
                response.set_cookie(
                    name, value, age_s, path="/", httponly=True, samesite="strict"
                )
            return response
        if token_matches(request.cookies.get(self.cookie, ""), self.token):
            return None
        return PlainTextResponse(
            "token missing or wrong; open the address that the server printed: /?token=...",
            401,
        )


def with_policy(send: Any) -> Any:
    """Wrap `send` so that every response has the security headers, and a policy unless it has its own."""

    async def send_with_headers(message: Any) -> None:
        if message["type"] == "http.response.start":
            headers = MutableHeaders(scope=message)
            headers.setdefault("content-security-policy", PAGE_POLICY)
            headers.update(SECURITY_HEADERS)
        await send(message)

    return send_with_headers


def limited(receive: Any) -> Any:
    """Wrap `receive` so that a body beyond the limit ends the request, whatever its Content-Length says."""
    received = 0

    async def receive_limited() -> Any:
        nonlocal received
        message = await receive()
        if message["type"] == "http.request":
            received += len(message.get("body", b""))
            if received > LIMIT_BYTES + 2**16:
                return {"type": "http.disconnect"}
        return message

    return receive_limited


def user_of(cookies: Mapping[str, str]) -> str:
    """The number of a browser from its cookie; empty if it has none."""
    user = cookies.get(USER, "")
    return user if re.fullmatch(rf"[0-9a-f]{{{2 * USER_BYTES}}}", user) else ""


def report_path(out: Path, name: str, user: str = "") -> Path | None:
    """Path of the report of a study in the folder; None if there is none, or it belongs to another user."""
    try:
        path = (out / name / "report.html").resolve()
        is_here = path.parent.parent == out.resolve() and is_shown(path.parent.name, user)
        return path if is_here and path.is_file() else None
    except (ValueError, OSError):  # a name with a null byte, or too long
        return None


def stop_studies() -> None:
    """End the studies of all pages with the server; their trials so far are kept."""
    for process in StudyProcess.begun:
        process.stop(signal.SIGTERM)


def routes(scene: str, folder: Path, out: Path, cameras: Sequence[str], workers: int) -> None:
    """Register all routes, and prepare the workers of tabs."""
    pool = Workers(workers)
    closed_pages = ClosedPages()
    app.on_startup(prepare)
    app.on_startup(partial(pool.prepare, str(find(scene).resolve())))
    app.on_shutdown(stop_studies)

    @app.get("/report/{name}")
    def report(name: str, request: Request) -> Response:
        """A finished study's report, for its user."""
        path = report_path(out, name, user_of(request.cookies))
        if path is None:
            return Response(status_code=404)
        return FileResponse(
            path, media_type="text/html", headers={"content-security-policy": REPORT_POLICY}
        )

    # NiceGUI allows three seconds for building a page; many pages that are built at once need longer.
    @ui.page(
        "/",
        title="skysim gui",
        dark=True,
        language="en-US",
        response_timeout=CONNECT_TIMEOUT_S,
    )
    async def index(request: Request) -> None:
        tab = Tab(scene, folder, out, cameras, user_of(request.cookies))
        await tab.build()
        client = ui.context.client

        async def close() -> None:
            """Release the resources of the tab."""
            await tab.close()
            closed_pages.collect_soon()

        client.on_delete(close)
        # A browser that has not connected, or hangs, does not answer.
        with suppress(TimeoutError):
            await client.connected(timeout=CONNECT_TIMEOUT_S)
            session = await pool.wait(
                lambda: tab.is_open, lambda text: tab.sensor.show_waiting(text, QUEUED)
            )
            if session:
                await tab.start(session, pool.take)


def serve(
    scene: str,
    host: str,
    port: int,
    token: str,
    folder: Path,
    out: Path,
    cameras: Sequence[str],
    workers: int,
    show: bool,
) -> None:
    """Serve until Ctrl-C.

    Parameters
    ----------
    token
        Token that browsers must send, also those of this machine, which has other users and
        pages of other sites; a random one if empty
    cameras
        Live cameras that the page may watch, see `skysim.core.images`
    workers
        Maximum number of worker processes; further pages wait for one
    """
    token = token or secrets.token_urlsafe(16)
    layers = app.build_middleware_stack
    # NiceGUI adds further layers when it runs; the guard is outside of them.
    app.build_middleware_stack = lambda: Guard(layers(), host, token, port)
    routes(scene, folder, out, cameras, workers)
    login = f"/?token={quote(token)}"
    address = f"http://{host}:{port}{login}"
    print(f"skysim gui: {address}   (Ctrl-C ends it)", flush=True)
    ui.run(
        host=host,
        port=port,
        show=login if show else False,
        reload=False,
        show_welcome_message=False,
        reconnect_timeout=RECONNECT_S,
        uvicorn_logging_level="critical",
        storage_secret=None,
        # Responses to this machine are not compressed; others are, at the fastest level.
        gzip_middleware_factory=None
        if host in LOOPBACK
        else partial(GZipMiddleware, compresslevel=1),
    )
