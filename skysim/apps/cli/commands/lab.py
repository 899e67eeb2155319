"""Command `skysim lab`."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from skysim.core.errors import InputError

LOOPBACK = ("127.0.0.1", "localhost", "::1")


def lab(
    scene: Annotated[
        str, typer.Argument(metavar="SCENE", help="A scene file (.yaml) or the name of one in scenes/.")
    ] = "shefex2",
    host: Annotated[
        str, typer.Option(help="Address to serve on; another than this machine's own takes a token.")
    ] = "127.0.0.1",
    port: Annotated[int, typer.Option(min=1, max=65535, help="Port to serve on.")] = 8080,
    token: Annotated[
        str, typer.Option(help="Asked of every browser; one is made where --host needs it.")
    ] = "",
    folder: Annotated[Path, typer.Option(help="Where new scenes are saved.")] = Path("."),
    out: Annotated[Path, typer.Option(help="Where studies and their reports are.")] = Path("out"),
    show: Annotated[bool, typer.Option("--open/--no-open", help="Open a browser.")] = True,
) -> None:
    """Open the interactive lab in the browser (extra `lab`)."""
    from skysim.scene.loader import load

    load(scene)
    if not folder.is_dir():
        raise InputError(f"--folder {folder}: no such folder")
    try:
        from skysim.apps.gui import server
    except ModuleNotFoundError as error:
        raise InputError(f"skysim lab needs {error.name}: pip install 'skysim[lab]'") from None
    needed = token or (server.new_token() if host not in LOOPBACK else "")
    server.serve(scene, host, port, needed, folder.resolve(), out.resolve(), show)
