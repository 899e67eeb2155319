"""`skysim run`, `render`, `compare`, `trackers`."""

from __future__ import annotations

import shlex
import sys
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from skysim.commands.options import (
    Centroider,
    Detector,
    Frames,
    Identifier,
    Json,
    Out,
    Programs,
    SceneArg,
    Seed,
    Sets,
    SolverName,
    fresh,
    load,
    named,
)
from skysim.terminal import begun, complain, draw, print_rows, print_scores, print_summary, progress, watched

if TYPE_CHECKING:
    from skysim.types import Row


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
        str | None,
        typer.Option(metavar="NAME", help="Who solves: own, or a name of `skysim trackers` or --program."),
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


def compare(
    scene: SceneArg,
    tracker: Annotated[
        list[str],
        typer.Option(metavar="NAME", help="Who solves: own, or a name of `skysim trackers` or --program."),
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


def trackers(json: Json = False) -> None:
    """List the trackers that are there, and what they still need."""
    from skysim import io
    from skysim import trackers as known

    listed = [{"name": known.OWN, "from": "skysim", "needs": ""}]
    listed += [
        {"name": name, "from": point.value, "needs": known.needs(point)}
        for name, point in known.entry_points().items()
    ]
    if json:
        print(io.to_json(listed))
        return
    for entry in listed:
        print(
            f"{entry['name']:20s} {entry['from']}" + (f"  needs {entry['needs']}" if entry["needs"] else "")
        )


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
