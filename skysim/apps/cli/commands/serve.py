"""Commands that serve frames: `skysim stream` to programs, `skysim gui` to a browser."""

from __future__ import annotations

import sys
from contextlib import ExitStack
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from skysim.apps.cli.options import Frames, Json, Overrides, SceneArg, Seed, load
from skysim.core.errors import InputError

if TYPE_CHECKING:
    from skysim.apps.stream.sinks import Sink
    from skysim.simulation.flight import Flight


HOST = "127.0.0.1"


def stream(
    scene: SceneArg,
    folder: Annotated[
        Path | None,
        typer.Option(
            help="Write frames to a folder: a 16-bit PNG and a JSON file per frame."
        ),
    ] = None,
    http: Annotated[
        int | None,
        typer.Option(
            min=0, max=65535, help="Serve MJPEG and packets on this port; 0: any free port."
        ),
    ] = None,
    host: Annotated[
        str, typer.Option(help="Address to serve on, without access control.")
    ] = HOST,
    pipe: Annotated[
        str | None,
        typer.Option(
            help="Write packets (a line of JSON, then pixels) to a named pipe; -: to standard output."
        ),
    ] = None,
    frames: Frames = None,
    endless: Annotated[
        bool,
        typer.Option(
            "--endless", help="Stream until Ctrl-C. Otherwise a stream lasts one day at most."
        ),
    ] = False,
    speed: Annotated[
        float,
        typer.Option(min=0, max=1000, help="Multiple of real time; 0: as fast as possible."),
    ] = 1.0,
    seed: Seed = None,
    set_: Overrides = None,
    json: Json = False,
) -> None:
    """Stream a scene's frames in real time, for hardware or a processor in the loop."""
    from skysim.apps.stream.sinks import READER_GONE
    from skysim.core import files
    from skysim.simulation.flight import open_flight

    if folder is None and http is None and pipe is None:
        raise InputError("", "no output", "--folder DIR, --http PORT or --pipe PATH")
    if http is None and host != HOST:
        raise InputError(
            f"--host {host}", "has no effect without --http", f"--http PORT --host {host}"
        )
    if endless and frames is not None:
        raise InputError("--endless", "has no effect with --frames", "one of the two")
    flight = open_flight(
        load(scene, frames, seed, set_), endless=endless, keeps_history=False
    )
    sinks = open_sinks(folder, pipe)
    statistics = send_all(flight, sinks, speed, http, host)
    output = sys.stderr if pipe == "-" else sys.stdout
    print(files.to_json(statistics) if json else summary(statistics), file=output)
    for sink in sinks:
        if sink.fault not in ("", READER_GONE):
            raise InputError(f"--{sink.name}", sink.fault)


def open_sinks(folder: Path | None, pipe: str | None) -> list[Sink]:
    """Sinks for the folder and for the pipe, if they are given."""
    from skysim.apps.stream.sinks import Sink, folder_writer, pipe_writer

    sinks = []
    if folder is not None:
        sinks.append(Sink("folder", folder_writer(folder)))
    if pipe is not None:
        sinks.append(Sink("pipe", pipe_writer(pipe)))
    return sinks


def send_all(
    flight: Flight, sinks: list[Sink], speed: float, port: int | None, host: str
) -> dict[str, Any]:
    """Send all frames of a flight, and return the counters of the sender and its receivers.

    Ctrl-C ends the stream. Flight, sinks and server are closed at its end. Raises InputError if the port cannot be
    served.
    """
    from skysim.apps.stream.http import FrameHub, start_server
    from skysim.apps.stream.sender import Pace, Sender

    sender = Sender(flight, Pace(speed, flight.lab.scene.exposure.rate_hz), sinks)
    with ExitStack() as stack:
        hub = None
        if port is not None:
            hub = FrameHub(sender.statistics)
            server = start_server(hub, host, port)
            stack.callback(server.shutdown)
            stack.callback(hub.finish)
            address = f"http://{host}:{server.server_port}/"
            print(f"skysim stream: {address}   (Ctrl-C ends it)", file=sys.stderr, flush=True)
        try:
            sender.run(hub.publish if hub else None)
        except KeyboardInterrupt:
            print(file=sys.stderr)
        finally:
            flight.close()
            for sink in sinks:
                sink.close()
    return sender.statistics() | (hub.counters() if hub else {})


def summary(statistics: dict[str, Any]) -> str:
    """Text summary of the frames rendered, sent and dropped."""
    lines = [
        f"{statistics['made']} frames rendered, {statistics['dropped']} dropped; delay: median"
        f" {statistics['late_ms_median']:.1f} ms, p99 {statistics['late_ms_p99']:.1f} ms,"
        f" worst {statistics['late_ms_worst']:.1f} ms"
    ]
    for name, sink in statistics["sinks"].items():
        lines.append(counts(name, sink) + (f"; {sink['fault']}" if sink["fault"] else ""))
    earlier = statistics.get("earlier_clients", {"clients": 0})
    if earlier["clients"]:
        lines.append(counts(f"{earlier['clients']} earlier clients", earlier))
    for number, client in enumerate(statistics.get("clients", []), earlier["clients"] + 1):
        lines.append(counts(f"client {number}", client))
    return "\n".join(lines)


def counts(receiver: str, counters: dict[str, Any]) -> str:
    return f"{receiver}: {counters['sent']} sent, {counters['dropped']} dropped"


# Command `skysim gui`.


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
    folder: Annotated[
        Path, typer.Option(help="Folder in which new scenes are saved.")
    ] = Path("."),
    out: Annotated[Path, typer.Option(help="Folder of studies and their reports.")] = Path(
        "out"
    ),
    camera: Annotated[
        list[str] | None,
        typer.Option(
            metavar="SOURCE",
            help="Live camera that the page may watch: index, file or address; repeatable.",
        ),
    ] = None,
    workers: Annotated[
        int,
        typer.Option(
            min=1, help="Most worker processes, one for each page; further pages wait."
        ),
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
