"""Command `skysim stream`."""

from __future__ import annotations

import signal
import sys
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from skysim.core.errors import InputError

if TYPE_CHECKING:
    from skysim.apps.stream.sinks import Sink


def stream(
    scene: Annotated[
        str, typer.Argument(metavar="SCENE", help="A scene file (.yaml) or the name of one in scenes/.")
    ],
    folder: Annotated[
        Path | None, typer.Option(help="Into a folder: PNG of 16 bits and JSON a frame.")
    ] = None,
    http: Annotated[
        int | None,
        typer.Option(min=0, max=65535, help="Serve MJPEG and packets on this port; 0 takes a free one."),
    ] = None,
    host: Annotated[
        str, typer.Option(help="Address to serve on; anybody who reaches it may watch.")
    ] = "127.0.0.1",
    pipe: Annotated[
        str | None,
        typer.Option(help="Packets (a line of JSON, then pixels) to a named pipe, or - for standard output."),
    ] = None,
    frames: Annotated[
        int | None, typer.Option(min=1, help="How many; the scene's own number if left out.")
    ] = None,
    endless: Annotated[
        bool,
        typer.Option("--endless", help="Until Ctrl-C, however long; without it a day at most."),
    ] = False,
    speed: Annotated[
        float,
        typer.Option(min=0, max=1000, help="So many times real time; 0: as fast as frames can be made."),
    ] = 1.0,
    seed: Annotated[
        int | None, typer.Option(help="Of all random streams; the scene's own if left out.")
    ] = None,
    set_: Annotated[
        list[str] | None,
        typer.Option("--set", metavar="KEY=VALUE", help="Override a key: exposure.rate_hz=10."),
    ] = None,
    json: Annotated[bool, typer.Option("--json", help="Print the tallies as JSON.")] = False,
) -> None:
    """Stream a scene's frames in real time, for hardware or a processor in the loop."""
    from skysim.apps.stream import http as http_server
    from skysim.apps.stream import sender, sinks
    from skysim.apps.stream.pacing import Pace
    from skysim.apps.stream.sinks import GONE
    from skysim.core import files
    from skysim.core.yaml_reader import parse_overrides
    from skysim.scene.loader import load
    from skysim.simulation import testbed

    if folder is None and http is None and pipe is None:
        raise InputError("skysim stream: give where to: --folder DIR, --http PORT or --pipe PATH")
    if endless and frames is not None:
        raise InputError("skysim stream: give either --frames N or --endless")
    told = parse_overrides(set_) | ({"seed": str(seed)} if seed is not None else {})
    told |= {"exposure.frames": str(frames)} if frames is not None else {}
    lab = replace(testbed.build_testbed(load(scene, told)), endless=endless)
    takers: list[Sink] = []
    if folder is not None:
        takers.append(sinks.Sink("folder", sinks.folder(folder)))
    if pipe is not None:
        takers.append(sinks.Sink("pipe", sinks.pipe(pipe)))
    tally, pace = sender.Tally(), Pace(speed, lab.scene.exposure.rate_hz)
    board = http_server.Board(lambda: tally.figures(takers)) if http is not None else None
    server = http_server.served(board, host, http) if board and http is not None else None
    if server:
        print(
            f"skysim stream: http://{host}:{server.server_port}/   (Ctrl-C ends it)",
            file=sys.stderr,
            flush=True,
        )
    before = signal.signal(signal.SIGTERM, signal.default_int_handler)
    try:
        sender.send(lab, pace, takers, tally, board.post if board else None)
    except KeyboardInterrupt:
        print(file=sys.stderr)
    finally:
        signal.signal(signal.SIGTERM, before)
        for taker in takers:
            taker.close()
        if board and server:
            board.end()
            server.shutdown()
    figures = tally.figures(takers) | (board.tallies() if board else {})
    where = sys.stderr if pipe == "-" else sys.stdout
    print(files.to_json(figures) if json else summary(figures), file=where)
    for taker in takers:
        if taker.fault not in ("", GONE):
            raise InputError(f"--{taker.name}: {taker.fault}")


def summary(figures: dict[str, Any]) -> str:
    """Text summary of the frames made, sent and dropped."""
    lines = [
        f"{figures['made']} frames, {figures['dropped']} left out for want of time; late by a median of"
        f" {figures['late_ms_median']:.1f} ms, p99 {figures['late_ms_p99']:.1f}, worst {figures['late_ms_worst']:.1f}"
    ]
    for name, one in figures["sinks"].items():
        lines.append(
            f"{name}: {one['sent']} sent, {one['dropped']} left out"
            + (f"; {one['fault']}" if one["fault"] else "")
        )
    before = figures.get("earlier_clients", {"clients": 0})
    if before["clients"]:
        lines.append(
            f"{before['clients']} earlier clients: {before['sent']} sent, {before['dropped']} left out"
        )
    for n, one in enumerate(figures.get("clients", [])):
        lines.append(f"client {before['clients'] + n + 1}: {one['sent']} sent, {one['dropped']} left out")
    return "\n".join(lines)
