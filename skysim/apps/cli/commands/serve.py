"""Commands that serve a flight: `skysim live` to programs, `skysim gui` to a browser."""

from __future__ import annotations

import secrets
import sys
import time
from contextlib import ExitStack
from pathlib import Path
from threading import Event
from typing import TYPE_CHECKING, Annotated, Any

import typer

from skysim.apps.cli.options import Frames, Json, Overrides, SceneArg, Seed, load
from skysim.core.errors import InputError

if TYPE_CHECKING:
    from skysim.apps.live.pacing import Live
    from skysim.apps.live.sinks import Output


HOST = "127.0.0.1"
PORTS = {"min": 0, "max": 65535}


def live(
    scene: SceneArg,
    tcp: Annotated[
        int | None,
        typer.Option(
            **PORTS,
            help="Send packets to clients on this port, and take their commands; 0: any free port.",
        ),
    ] = None,
    http: Annotated[
        int | None,
        typer.Option(**PORTS, help="Serve MJPEG and packets on this port; 0: any free port."),
    ] = None,
    gige: Annotated[
        bool,
        typer.Option(
            "--gige", help="Be a GigE Vision camera, which GenICam clients control."
        ),
    ] = False,
    folder: Annotated[
        Path | None,
        typer.Option(
            help="Write frames to a folder: a 16-bit PNG and a JSON file per frame."
        ),
    ] = None,
    pipe: Annotated[
        str | None,
        typer.Option(
            help="Write packets (a line of JSON, then pixels) to a named pipe; -: to standard output."
        ),
    ] = None,
    host: Annotated[
        str, typer.Option(help="Address to serve on; other than loopback with a token.")
    ] = HOST,
    token: Annotated[
        str,
        typer.Option(
            help="Token that clients must send; default: none on loopback, else a random one, which is printed."
        ),
    ] = "",
    truth: Annotated[
        bool,
        typer.Option("--truth", help="Let clients, folder and /truth.json have the truth."),
    ] = False,
    trigger: Annotated[
        bool,
        typer.Option(
            "--trigger", help="Expose frames when a client triggers, not by the scene."
        ),
    ] = False,
    client_tracker: Annotated[
        bool,
        typer.Option(
            "--client-tracker",
            help="The filter takes attitudes of clients, not of the scene's tracker.",
        ),
    ] = False,
    command_timeout: Annotated[
        float,
        typer.Option(
            min=0,
            metavar="SECONDS",
            help="Time of the simulator after which a client's command of actuators ends.",
        ),
    ] = 0.5,
    wait: Annotated[
        bool,
        typer.Option(
            "--wait",
            help="Start when the first client of --tcp takes channels, or one of --gige starts the acquisition.",
        ),
    ] = False,
    frames: Frames = None,
    endless: Annotated[
        bool,
        typer.Option("--endless", help="Fly until Ctrl-C. Otherwise one day at most."),
    ] = False,
    speed: Annotated[
        float,
        typer.Option(min=0, max=1000, help="Multiple of real time; 0: as fast as possible."),
    ] = 1.0,
    seed: Seed = None,
    set_: Overrides = None,
    json: Json = False,
) -> None:
    """Fly a scene in real time: frames, IMU and encoders to other programs, their commands to the vehicle."""
    from skysim.apps.live.commands import CommandState
    from skysim.apps.live.pacing import Live, Pace
    from skysim.apps.live.sinks import READER_GONE
    from skysim.core import files
    from skysim.simulation.flight import open_flight

    check_outputs(
        outputs={
            "--tcp": tcp,
            "--http": http,
            "--gige": gige or None,
            "--folder": folder,
            "--pipe": pipe,
        },
        needs={
            (f"--host {host}", "--tcp", "--http", "--gige"): host != HOST,
            ("--token", "--tcp", "--http"): bool(token),
            ("--trigger", "--tcp", "--gige"): trigger,
            ("--client-tracker", "--tcp"): client_tracker,
            ("--wait", "--tcp", "--gige"): wait,
        },
    )
    if endless and frames is not None:
        raise InputError("--endless", "has no effect with --frames", "one of the two")
    flight = open_flight(
        load(scene, frames, seed, set_), endless=endless, keeps_history=False
    )
    if client_tracker and not flight.lab.scene.filter:
        raise InputError("--client-tracker", "the scene has no filter", "a scene with one")
    outputs: list[Output] = []
    flown = Live(
        flight,
        Pace(speed, flight.lab.scene.exposure.rate_hz),
        outputs,
        CommandState(flight, command_timeout, trigger),
        has_truth=truth,
        solves_itself=not client_tracker,
        may_solve=tcp is not None,
    )
    with ExitStack() as stack:
        try:
            open_outputs(
                flown,
                stack,
                folder,
                pipe,
                tcp,
                http,
                gige,
                host,
                token or new_token(host),
                wait,
            )
            flown.run()
        except KeyboardInterrupt:
            print(file=sys.stderr)
        finally:
            flight.close()
    statistics = flown.statistics()
    print(
        files.to_json(statistics) if json else summary(statistics),
        file=sys.stderr if pipe == "-" else sys.stdout,
    )
    for output in outputs:
        if output.fault not in ("", READER_GONE):
            raise InputError(f"--{output.name}", output.fault)


def check_outputs(outputs: dict[str, Any], needs: dict[tuple[str, ...], bool]) -> None:
    """Raise InputError if there is no output, or for an option that has no effect without another.

    Parameters
    ----------
    outputs
        Value of each output's option; None without it
    needs
        Whether an option is used, by it and the outputs of which it needs one
    """
    if all(value is None for value in outputs.values()):
        raise InputError("", "no output", ", ".join(outputs))
    for (option, *servers), is_used in needs.items():
        if is_used and all(outputs[server] is None for server in servers):
            raise InputError(
                option,
                f"has no effect without {' or '.join(servers)}",
                "one of them" if servers[1:] else "--tcp PORT",
            )


def new_token(host: str) -> str:
    """A random token where other machines can connect, else none."""
    from skysim.apps.access import LOOPBACK

    return "" if host in LOOPBACK else secrets.token_urlsafe(16)


def open_outputs(
    flown: Live,
    stack: ExitStack,
    folder: Path | None,
    pipe: str | None,
    tcp: int | None,
    http: int | None,
    gige: bool,
    host: str,
    token: str,
    wait: bool,
) -> None:
    """Open the outputs that are given, print the addresses of servers, and wait for a client if wanted.

    The stack closes them. Raises InputError for a port that cannot be served, and for a folder or pipe that cannot be
    used.
    """
    from skysim.apps.live.gige import GigeCamera
    from skysim.apps.live.http import FrameHub, start_server
    from skysim.apps.live.sinks import Sink, folder_writer, pipe_writer
    from skysim.apps.live.wire import WireServer

    started = list[Event]()

    def add(output: Output) -> None:
        flown.outputs.append(output)
        stack.callback(output.close)

    def tell(text: str) -> None:
        print(f"skysim live: {text}   (Ctrl-C ends it)", file=sys.stderr, flush=True)

    if folder is not None:
        add(Sink("folder", folder_writer(folder)))
    if pipe is not None:
        add(Sink("pipe", pipe_writer(pipe)))
    if http is not None:
        hub = FrameHub(flown.statistics)
        http_server = start_server(hub, host, http, token)
        stack.callback(http_server.server_close)
        stack.callback(http_server.shutdown)
        add(hub)
        query = f"?token={token}" if token else ""
        tell(f"http://{host}:{http_server.server_port}/{query}")
    if tcp is not None:
        server = WireServer(host, tcp, token, flown.greeting, flown.inbox, flown.has_truth)
        add(server)
        tell(f"tcp {host}:{server.port}" + (f", token {token}" if token else ""))
        started.append(server.entered)
    if gige:
        camera = GigeCamera(flown, host)
        add(camera)
        risk = "" if camera.is_local else ", no token: all that reach it can control it"
        tell(f"gige {camera.host}:{camera.port}{risk}")
        started.append(camera.entered)
    while wait and not any(one.is_set() for one in started):
        time.sleep(0.05)


def summary(statistics: dict[str, Any]) -> str:
    """Text summary of the frames rendered, sent and dropped, and of the control periods."""
    lines = [
        f"{statistics['made']} frames rendered, {statistics['dropped']} dropped; delay: median"
        f" {statistics['late_ms_median']:.1f} ms, p99 {statistics['late_ms_p99']:.1f} ms,"
        f" worst {statistics['late_ms_worst']:.1f} ms",
        f"{statistics['periods']} control periods, {statistics['missed']} late by one or more",
    ]
    commands = statistics["commands"]
    if commands["received"] or commands["refused"]:
        lines.append(
            f"commands: {commands['received']} taken, {commands['refused']} refused,"
            f" {commands['timeouts']} timed out"
        )
        updates = [f"{number} {status}" for status, number in commands["updates"].items()]
        if updates:
            lines.append("attitudes of clients: " + ", ".join(updates))
    for name, output in statistics["outputs"].items():
        lines.append(counts(name, output))
    return "\n".join(lines)


def counts(receiver: str, counters: dict[str, Any]) -> str:
    """What an output has sent and dropped, by channel, and its fault."""
    parts = []
    if "clients" in counters:
        parts.append(f"{counters['clients']} clients")
    for word in ("sent", "dropped"):
        numbers = [f"{number} {name}" for name, number in counters[word].items() if number]
        if numbers or word == "sent":
            parts.append(f"{word} {', '.join(numbers) or 'nothing'}")
    if counters.get("fault"):
        parts.append(counters["fault"])
    return f"{receiver}: " + "; ".join(parts)


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
