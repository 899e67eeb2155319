"""Command `skysim gui`."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from skysim.apps.cli.options import SceneArg
from skysim.core.errors import InputError


def gui(
    scene: SceneArg = "shefex2",
    host: Annotated[
        str, typer.Option(help="Address to serve on; 0.0.0.0 serves other machines too.")
    ] = "127.0.0.1",
    port: Annotated[int, typer.Option(min=1, max=65535, help="Port to serve on.")] = 8080,
    token: Annotated[
        str,
        typer.Option(
            help="Access token that browsers must send; default: a random one, in the printed link."
        ),
    ] = "",
    folder: Annotated[Path, typer.Option(help="Folder in which new scenes are saved.")] = Path("."),
    out: Annotated[Path, typer.Option(help="Folder of studies and their reports.")] = Path("out"),
    camera: Annotated[
        list[str] | None,
        typer.Option(
            metavar="SOURCE",
            help="Live camera that the page may watch: index, file or address; repeatable.",
        ),
    ] = None,
    workers: Annotated[
        int,
        typer.Option(min=1, help="Most worker processes, one for each page; further pages wait."),
    ] = 12,
    show: Annotated[bool, typer.Option("--open/--no-open", help="Open a browser.")] = True,
) -> None:
    """Open the interactive simulator in the browser (extra `gui`)."""
    from skysim.scene.loader import load

    load(scene)
    if not folder.is_dir():
        raise InputError(f"--folder {folder}", "folder does not exist")
    try:
        from skysim.apps.gui import server
    except ModuleNotFoundError as error:
        raise InputError(
            "", f"skysim gui needs {error.name}", "after pip install 'skysim[gui]'"
        ) from None
    server.serve(
        scene, host, port, token, folder.resolve(), out.resolve(), camera or [], workers, show
    )
