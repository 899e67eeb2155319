"""Commands that serve a flight: `skysim live` to programs, `skysim gui` to a browser."""

from __future__ import annotations

import secrets
import sys
from collections.abc import Callable
from contextlib import ExitStack
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, NamedTuple

from typer import Option

from skysim.apps.access import HOST
from skysim.apps.cli.options import Frames, Json, Overrides, SceneArg, Seed, load
from skysim.core.errors import InputError

if TYPE_CHECKING:
    from skysim.apps.live.display_pattern import DisplayPicture
    from skysim.apps.live.pacing import Live
    from skysim.apps.live.packets import Output


Port = Annotated[int | None, Option(min=0, max=65535)]


def live(
    scene: SceneArg,
    tcp: Port = None,
    http: Port = None,
    gige: bool | None = None,
    folder: Path | None = None,
    display: str | None = None,
    indi: Port = None,
    pipe: str | None = None,
    mcap: Path | None = None,
    foxglove: Port = None,
    host: str = HOST,
    token: str = "",
    truth: bool = False,
    trigger: bool = False,
    poses: bool = False,
    client_tracker: bool = False,
    command_timeout: Annotated[float, Option(min=0)] = 0.5,
    wait: bool = False,
    frames: Frames = None,
    endless: bool = False,
    speed: Annotated[float, Option(min=0, max=1000)] = 1.0,
    seed: Seed = None,
    set_: Overrides = None,
    json: Json = False,
) -> None:
    """Fly a scene in real time: frames, IMU and encoders to other programs, their commands to the vehicle.

    Parameters
    ----------
    tcp
        Send packets to clients on this port, and take their commands; 0: any free port.
    http
        Serve MJPEG on this port; 0: any free port.
    gige
        Be a GigE Vision camera, which GenICam clients control.
    folder
        Write frames to a folder: a 16-bit PNG and a JSON file per frame.
    display : BENCH
        Serve /display by --http: the sky for the display of this scene, before a real camera.
    indi
        Be an INDI camera on this port of this machine, which exposes at command; INDI's own is 7624.
    pipe
        Write packets (a line of JSON, then pixels) to a named pipe; -: to standard output.
    mcap
        Record ROS 2 messages to a new MCAP file (extra `ros`).
    foxglove
        Serve ROS 2 messages to Foxglove on this port, on loopback alone; its own is 8765 (extra `ros`).
    host
        Address to serve on; other than loopback with a token.
    token
        Token that clients must send; default: none on loopback, else a random one, which is printed.
    truth
        Let clients, files and /truth.json have the truth.
    trigger
        Expose frames when a client triggers, not by the scene.
    poses
        A client simulates the motion: expose a frame for each of its poses.
    client_tracker
        The filter takes attitudes of clients, not of the scene's tracker.
    command_timeout : SECONDS
        Time of the simulator after which a client's command of actuators ends.
    wait
        Start when the first client of --tcp takes channels, or one of --gige starts the acquisition.
    endless
        Fly until Ctrl-C. Otherwise one day at most.
    speed
        Multiple of real time; 0: as fast as possible.
    """
    options = locals()
    from skysim.apps.access import LOOPBACK
    from skysim.apps.live.commands import CommandState
    from skysim.apps.live.pacing import Live, Pace, PosedLive
    from skysim.apps.live.packets import READER_GONE
    from skysim.core import files
    from skysim.simulation.flight import open_flight

    chosen = {name: options[name] for name in OUTPUTS if options[name] is not None}
    if not chosen:
        raise InputError("", "no output", ", ".join(f"--{name}" for name in OUTPUTS))
    needs: dict[tuple[str, ...], bool] = {
        (f"--host {host}", "tcp", "http", "gige"): host != HOST,
        ("--token", "tcp", "http"): bool(token),
        ("--display", "http"): bool(display),
        ("--trigger", "tcp", "gige"): trigger,
        ("--wait", "tcp", "gige"): wait,
        ("--client-tracker", "tcp"): client_tracker,
        ("--poses", "tcp"): poses,
    }
    for (option, *servers), is_used in needs.items():
        if is_used and not chosen.keys() & set(servers):
            names = " or ".join(f"--{server}" for server in servers)
            raise InputError(option, f"has no effect without {names}", f"with {names}")
    if poses and (trigger or client_tracker or display):
        raise InputError(
            "--poses", "no motion is simulated", "no --trigger, --client-tracker, --display"
        )
    if endless and frames is not None:
        raise InputError("--endless", "has no effect with --frames", "one of the two")
    loaded = load(scene, set_, seed, frames)
    if client_tracker and not loaded.filter:
        raise InputError("--client-tracker", "the scene has no filter", "a scene with one")
    flight = open_flight(loaded, endless=endless, keeps_history=False)
    flown = (PosedLive if poses else Live)(
        flight,
        Pace(0.0 if poses else speed, loaded.exposure.rate_hz),
        [],
        CommandState(flight, command_timeout, trigger or indi is not None),
        has_truth=truth,
        solves_itself=not client_tracker,
        may_solve=bool(chosen.keys() & TAKE_SOLUTIONS),
    )
    with ExitStack() as stack:
        if not token and host not in LOOPBACK:
            token = secrets.token_urlsafe(16)
        opening = Opening(flown, stack, host, token, display)
        try:
            for name, value in chosen.items():
                open_output(opening, name, value)
            if wait:
                flown.entered.wait()
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
    for output in flown.outputs:
        if output.fault not in ("", READER_GONE):
            raise InputError(f"--{output.name}", output.fault)


class Opening(NamedTuple):
    """What the outputs of a flight share.

    Attributes
    ----------
    live, stack
        The flight, and what closes its outputs
    host, token
        Address to serve on, and the token of its clients
    display
        Scene of the bench whose display shows the sky
    """

    live: Live
    stack: ExitStack
    host: str
    token: str
    display: str | None

    def say(self, text: str) -> None:
        print(f"skysim live: {text}   (Ctrl-C ends it)", file=sys.stderr, flush=True)


def open_http(opening: Opening, port: int) -> Output:
    from skysim.apps.live.http import FrameServer

    show = shown(opening.live, opening.display) if opening.display else None
    server = FrameServer(opening.live.statistics, opening.host, port, opening.token)
    server.show = show
    query = f"?token={opening.token}" if opening.token else ""
    opening.say(f"http://{opening.host}:{server.server_port}/{query}")
    if show:
        picture = show()
        opening.say(
            f"/display shows {picture.shown} lights at the start;"
            f" {picture.faint} are too faint for its gray levels"
        )
    return server


def shown(live: Live, bench: str) -> Callable[[], DisplayPicture]:
    """The function that returns the present picture for the display of a bench."""
    from skysim.apps.live.display_pattern import DisplayPattern
    from skysim.scene.loader import load as load_scene
    from skysim.simulation.lab import build_lab

    # A lab of its own: the server's threads draw beside the flight.
    lab = build_lab(live.flight.lab.scene)
    pattern = DisplayPattern.of_bench(lab, build_lab(load_scene(bench)))

    def show() -> DisplayPicture:
        state = live.flight.state
        return pattern.picture(state.t_s, state.lab_from_body)

    return show


# The options of outputs, in the order in which they are opened.
OUTPUTS = ("folder", "pipe", "http", "gige", "indi", "mcap", "foxglove", "tcp")
EXTRAS = {"indi": "indi", "mcap": "ros", "foxglove": "ros"}
TAKE_SOLUTIONS = {"indi", "mcap", "foxglove", "tcp"}


def open_output(opening: Opening, name: str, value: Any) -> None:
    """Send the flight's packets to an output, which the stack closes; name the extra that it needs."""
    from skysim.apps.live import packets

    live, stack, host, token, _ = opening
    output: Output
    try:
        match name:
            case "folder":
                output = packets.Sink(name, packets.folder_writer(value))
            case "pipe":
                output = packets.Sink(name, packets.pipe_writer(value))
            case "http":
                output = open_http(opening, value)
            case "gige":
                from skysim.apps.live.gige import GigeCamera

                output = GigeCamera(live, host)
                risk = (
                    "" if output.is_local else ", no token: all that reach it can control it"
                )
                opening.say(f"gige {output.host}:{output.port}{risk}")
            case "indi":
                from skysim.apps.live.indi import IndiCamera

                camera = IndiCamera(live, value)
                stack.callback(camera.close)
                opening.say(f"indi {HOST}:{camera.port}")
                output = camera.sink
            case "mcap":
                from skysim.apps.live.ros import McapSink, RosEncoder

                output = McapSink(RosEncoder(live), value)
            case "foxglove":
                from skysim.apps.live.ros import FoxgloveSink, RosEncoder

                output = FoxgloveSink(RosEncoder(live), value)
                opening.say(f"foxglove ws://{HOST}:{output.server.port}")
            case "tcp":
                from skysim.apps.live.wire import WireServer

                output = WireServer(live, host, value, token)
                key = f", token {token}" if token else ""
                opening.say(f"tcp {host}:{output.port}{key}")
    except ModuleNotFoundError as error:
        allowed = f"after pip install 'skysim[{EXTRAS[name]}]'"
        raise InputError(f"--{name}", f"{error.name} is not installed", allowed) from None
    live.outputs.append(output)
    stack.callback(output.close)


def summary(statistics: dict[str, Any]) -> str:
    """Text summary of the frames rendered, sent and dropped, and of the control periods."""
    delay = (
        f"; delay: median {statistics['late_ms_median']:.1f} ms,"
        f" p99 {statistics['late_ms_p99']:.1f} ms, worst {statistics['late_ms_worst']:.1f} ms"
    )
    made = statistics["made"]
    lines = [
        f"{made} frames rendered, {statistics['dropped']} dropped{delay if made else ''}",
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
    lines += [counts(*output) for output in statistics["outputs"].items()]
    return "\n".join(lines)


def counts(receiver: str, counters: dict[str, Any]) -> str:
    """What an output has sent and dropped, by channel, and its fault."""
    parts = [f"{counters['clients']} clients"] if "clients" in counters else []
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
    host: str = HOST,
    port: Annotated[int, Option(min=1, max=65535)] = 8080,
    token: str = "",
    folder: Path = Path("."),
    out: Path = Path("out"),
    camera: list[str] | None = None,
    workers: Annotated[int, Option(min=1)] = 12,
    show: Annotated[bool, Option("--open/--no-open")] = True,
) -> None:
    """Open the interactive simulator in the browser (extra `gui`).

    Parameters
    ----------
    host
        Address to serve on; 0.0.0.0 serves other machines too.
    port
        Port to serve on.
    token
        Access token that browsers must send; default: a random one, in the printed link.
    folder
        Folder in which new scenes are saved.
    out
        Folder of studies and their reports.
    camera : SOURCE
        Camera that the page may watch: index, folder of images, video file, address or gige://HOST; repeatable.
    workers
        Most worker processes, one for each page; further pages wait.
    show
        Open a browser.
    """
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
