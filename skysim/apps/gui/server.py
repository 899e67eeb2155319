"""HTTP server of the GUI: routes, and an access check in front of all of them."""

from __future__ import annotations

import hmac
import secrets
from pathlib import Path
from typing import Any

from nicegui import app, ui
from starlette.requests import HTTPConnection
from starlette.responses import FileResponse, PlainTextResponse, RedirectResponse, Response

from skysim.apps.gui.page.page import Tab
from skysim.apps.gui.page.panels.photo import LIMIT_BYTES
from skysim.apps.gui.page.panels.sensor import FRAMES
from skysim.apps.gui.worker.session import SpareWorker
from skysim.scene.loader import find

LOOPBACK = ("127.0.0.1", "localhost", "::1", "[::1]")
COOKIE = "skysim_gui"
CONNECT_TIMEOUT_S = 50.0  # for a browser to load the page
RECONNECT_S = 6.0  # for a lost browser to reconnect, before its work ends


class Guard:
    """ASGI middleware that refuses unknown host names, requests of other sites or without token, and large requests.

    hosts : allowed Host headers ("*": any). This stops DNS rebinding: another site's name that resolves to this
        server comes with its own Host header.
    token : required if not empty; `/?token=...` stores it in a cookie
    """

    def __init__(self, app: Any, hosts: tuple[str, ...], token: str) -> None:
        self.app, self.hosts, self.token = app, hosts, token

    async def __call__(self, scope: Any, receive: Any, send: Any) -> None:
        if scope["type"] not in ("http", "websocket"):
            await self.app(scope, receive, send)
            return
        response = self.refusal(HTTPConnection(scope))
        if response is None:
            await self.app(scope, limited(receive), send)
        elif scope["type"] == "http":
            await response(scope, receive, send)
        else:
            await send({"type": "websocket.close", "code": 1008})

    def refusal(self, request: HTTPConnection) -> Response | None:
        """The response to a refused request; None if it is allowed."""
        headers = request.headers
        host, origin = headers.get("host", ""), headers.get("origin", "")
        if "*" not in self.hosts and host_of(host) not in self.hosts:
            return PlainTextResponse("host name not allowed", 403)
        if origin and origin.partition("://")[2] != host:
            return PlainTextResponse("request of another site refused", 403)
        if int(headers.get("content-length") or 0) > LIMIT_BYTES + 2**16:
            return PlainTextResponse("request too large; allowed: 64 MB", 413)
        if not self.token or token_matches(request.cookies.get(COOKIE, ""), self.token):
            return None
        if token_matches(request.query_params.get("token", ""), self.token):
            response = RedirectResponse("/", 303)
            response.set_cookie(COOKIE, self.token, httponly=True, samesite="strict")
            return response
        return PlainTextResponse("token missing or wrong; open the address that the server printed: /?token=...", 401)


def token_matches(candidate: str, token: str) -> bool:
    """Compare with the token in constant time, so that timing reveals nothing about it."""
    return hmac.compare_digest(candidate.encode(), token.encode())


def host_of(header: str) -> str:
    """The host of a Host header, without the port."""
    return header.rpartition(":")[0] if header.rpartition(":")[2].isdigit() else header


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


def routes(scene: str, folder: Path, out: Path) -> None:
    """Register all routes, with a spare worker ready for the next tab."""
    spare = SpareWorker(str(find(scene).resolve()))
    app.on_startup(spare.start)
    app.on_shutdown(spare.close)

    @app.get("/frame/{tab}/{number}")
    def frame(tab: str, number: int) -> Response:
        """A frame of a tab; 404 if it is no longer among the newest."""
        data = FRAMES.get(tab, {}).get(number)
        if data is None:
            return Response(status_code=404)
        return Response(data, media_type="image/jpeg", headers={"Cache-Control": "no-store"})

    @app.get("/report/{name}")
    def report(name: str) -> Response:
        """A finished study's report."""
        path = (out / name / "report.html").resolve()
        if not path.is_relative_to(out.resolve()) or not path.is_file():
            return Response(status_code=404)
        return FileResponse(path, media_type="text/html")

    @ui.page("/", title="skysim gui", dark=True)
    async def index() -> None:
        tab = Tab(scene, folder, out)
        tab.build()
        client = ui.context.client
        try:
            await client.connected(timeout=CONNECT_TIMEOUT_S)
        except TimeoutError:  # no browser has connected: start no worker
            return
        tab.session = spare.take()
        client.on_delete(tab.close)
        await tab.open(scene)
        await tab.scene_3d.adapt_frame_rate()
        spare.start()


def serve(scene: str, host: str, port: int, token: str, folder: Path, out: Path, show: bool) -> None:
    """Serve until Ctrl-C. token : required of browsers; if empty, a random one unless the host is a loopback address"""
    hosts = LOOPBACK if host in LOOPBACK else ("*",)
    token = token or ("" if host in LOOPBACK else secrets.token_urlsafe(16))
    app.add_middleware(Guard, hosts=hosts, token=token)
    routes(scene, folder, out)
    address = f"http://{host}:{port}/" + (f"?token={token}" if token else "")
    print(f"skysim gui: {address}   (Ctrl-C ends it)", flush=True)
    ui.run(
        host=host,
        port=port,
        show=show and not token,
        reload=False,
        show_welcome_message=False,
        reconnect_timeout=RECONNECT_S,
        uvicorn_logging_level="critical",
        storage_secret=None,
    )
