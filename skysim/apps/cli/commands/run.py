"""Commands `skysim run`, `render`, `compare` and `trackers`."""

from __future__ import annotations

import shlex
import sys
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from skysim.apps.cli.options import (
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
    clean_folder,
    given_stages,
    load,
)
from skysim.apps.cli.terminal import (
    eager_first,
    print_error,
    print_rows,
    print_scores,
    print_summary,
    progress,
    progress_callback,
    write_3d_views,
)

if TYPE_CHECKING:
    from skysim.core.types import Row


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
    """Simulate a scene: motion, frames, attitude solutions and their scores."""
    from skysim.core.files import to_json
    from skysim.results import scoring
    from skysim.results.report import as_dicts
    from skysim.results.run import Recorder, score_frames
    from skysim.simulation import checks
    from skysim.simulation.run import simulate_motion
    from skysim.simulation.testbed import build_testbed
    from skysim.tracking.external import process

    stages = given_stages(detector=detector, centroider=centroider, identifier=identifier, solver=solver)
    more = [f"tracker.{stage}={name}" for stage, name in stages.items()]
    more += [] if tracker is None else [f"tracker.name={tracker}"]
    loaded = load(scene, frames, seed, [*(set_ or []), *more])
    testbed = build_testbed(loaded, process.named(program))
    for doubt in checks.doubts(loaded, testbed.sources, testbed.mount):
        print_error(doubt)
    with progress_callback("flying") as watch:
        testbed = simulate_motion(testbed, watch)
    scored = eager_first(
        score_frames(testbed)
    )  # an error in the first frame comes before old results are removed
    recorder = Recorder(out or Path("out") / loaded.name, testbed)
    for frame in progress(scored, loaded.exposure.frames, loaded.title):
        recorder.add(frame)
    drawn = write_3d_views(testbed, recorder.folder) if picture else []
    figures = recorder.finish(shlex.join(["skysim", *sys.argv[1:]]), drawn)
    if json:
        print(to_json({"scene": loaded.name, **figures, "rows": as_dicts(recorder.rows)}))
    else:
        print_rows(recorder.rows, scoring.angle_names(loaded), figures["exposures_ms"])
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
    """Let trackers solve the same frames and compare their scores. With a filter, the first one closes the loop."""
    from skysim.core import files
    from skysim.experiments import tracker_comparison
    from skysim.results.files import frames as frame_files
    from skysim.simulation import run as simulation
    from skysim.simulation import testbed
    from skysim.tracking.external import process

    loaded = load(scene, frames, seed, [*(set_ or []), f"tracker.name={tracker[0]}"])
    lab = testbed.build_testbed(loaded, process.named(program))
    entrants = tracker_comparison.entrants(lab, tracker)
    with progress_callback("flying", quiet=json) as watch:
        lab = simulation.simulate_motion(lab, watch)
    shots = eager_first(tracker_comparison.shots(lab, entrants))
    folder = clean_folder(out or Path("out") / loaded.name)
    rows: dict[str, list[Row]] = {name: [] for name in entrants}
    for frame, truth, answers in progress(shots, loaded.exposure.frames, loaded.title, quiet=json):
        frame_files.write_frame(folder, frame, truth, loaded)
        for name, row in answers.items():
            rows[name].append(row)
    lines = tracker_comparison.write(folder, rows, loaded)
    if json:
        print(files.to_json({"scene": loaded.name, "scoreboard": tracker_comparison.as_dicts(lines)}))
    else:
        print_scores(lines, folder)


def trackers(json: Json = False) -> None:
    """List the available trackers, and what each still needs to be installed."""
    from skysim.core import files
    from skysim.tracking.external import interface as known

    listed = [{"name": known.OWN, "from": "skysim", "needs": ""}]
    listed += [
        {"name": name, "from": point.value, "needs": known.needs(point)}
        for name, point in known.entry_points().items()
    ]
    if json:
        print(files.to_json(listed))
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
    """Simulate a scene and write its frames with their truth, without solving them."""
    from skysim.core import files
    from skysim.results import report
    from skysim.results.files import frames as frame_files
    from skysim.simulation import run as simulation

    loaded = load(scene, frames, seed, set_)
    with progress_callback("flying") as watch:
        lab = simulation.prepare(loaded, watch)
    shots = eager_first(simulation.render_frames(lab))
    folder = clean_folder(out or Path("out") / loaded.name)
    written = []
    for frame, truth, _ in progress(shots, loaded.exposure.frames, loaded.title):
        frame_files.write_frame(folder, frame, truth, loaded)
        if preview:
            picture = report.preview(frame.image_dn, truth.seen)
            files.write_image(folder / f"frame_{frame.index:04d}.preview.png", picture)
        written.append(str(folder / f"frame_{frame.index:04d}.fits"))
    if json:
        print(files.to_json(written))
    else:
        print(f"{len(written)} frames with their truth in {folder}")
