"""Commands `skysim run`, `render`, `compare` and `trackers`."""

from __future__ import annotations

import shlex
import sys
from dataclasses import asdict
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from skysim.apps.cli import terminal
from skysim.apps.cli.options import (
    LOADED,
    TRACKER_HELP,
    Centroider,
    Detector,
    Frames,
    Identifier,
    Json,
    OpenReport,
    Out,
    Overrides,
    Programs,
    SceneArg,
    Seed,
    SolverName,
    load,
    output_folder,
    scene_names,
    selected_stages,
    used_programs,
    with_location,
)
from skysim.results.report.as_text import print_facts
from skysim.results.report.blocks import Facts

if TYPE_CHECKING:
    from skysim.core.types import FrameRow
    from skysim.simulation.testbed import Testbed


def run(
    scene: SceneArg,
    frames: Frames = None,
    seed: Seed = None,
    out: Out = None,
    set_: Overrides = None,
    detector: Detector = None,
    centroider: Centroider = None,
    identifier: Identifier = None,
    solver: SolverName = None,
    tracker: Annotated[str | None, typer.Option(metavar="NAME", help=TRACKER_HELP)] = None,
    program: Programs = None,
    scene_3d: Annotated[
        bool, typer.Option("--scene-3d", help="Write 3-D views of the laboratory: scene_3d.png and scene_3d.gif.")
    ] = False,
    open_: OpenReport = False,
    json: Json = False,
) -> None:
    """Simulate a scene: motion, frames, attitude solutions and their scores."""
    from skysim.results import scoring
    from skysim.results.run import Recorder, score_frames
    from skysim.simulation.checks import check
    from skysim.simulation.compilation import on_two_processes
    from skysim.simulation.run import simulate_motion
    from skysim.simulation.testbed import build_testbed

    stages = selected_stages(detector=detector, centroider=centroider, identifier=identifier, solver=solver)
    if tracker is not None:
        stages["name"] = tracker
    loaded = load(scene, frames, seed, [*(set_ or []), *(f"tracker.{key}={name}" for key, name in stages.items())])
    testbed = build_testbed(loaded, used_programs(program, scene_names(loaded)))
    plan = check(testbed)
    for finding in plan.findings:
        terminal.print_error(with_location(finding))
    with on_two_processes(*LOADED[-1]):
        with terminal.progress_callback("simulating the motion") as update:
            testbed = simulate_motion(testbed, update)
        scored = terminal.eager_first(score_frames(testbed))
    recorder = Recorder(output_folder(out, loaded.name), testbed, plan)
    for frame in terminal.progress(scored, loaded.exposure.frames, loaded.title):
        recorder.add(frame)
    views = terminal.write_3d_views(testbed, recorder.folder) if scene_3d else []
    command = shlex.join(["skysim", *sys.argv[1:]])
    statistics = recorder.finish(command, views)
    heads = run_heads(testbed, recorder.folder, command)
    if json:
        rows = {"rows": [asdict(row) for row in recorder.rows]}
        terminal.print_json({"scene": loaded.name, **statistics, **rows, **({"heads": heads} if heads else {})})
    else:
        terminal.print_rows(recorder.rows, scoring.angle_names(loaded))
        terminal.print_summary(statistics)
        for name, head in heads.items():
            terminal.print_head(name, head)
        known = [(fact.name, fact.lines) for fact in plan.facts if fact.name == "tracker knows"]
        print_facts(Facts(known))
    if open_:
        typer.launch(statistics["report"])


def run_heads(testbed: Testbed, folder: Path, command: str) -> dict[str, dict[str, Any]]:
    """Render, solve and write the frames of the further star cameras, each to its folder; their statistics by name."""
    from skysim.results.run import Recorder, score_frames

    statistics = {}
    for config, head in zip(testbed.scene.heads, testbed.heads, strict=True):
        recorder = Recorder(folder / config.name, head)
        for frame in terminal.progress(score_frames(head), head.scene.exposure.frames, config.name):
            recorder.add(frame)
        statistics[config.name] = recorder.finish(command)
    return statistics


def render(
    scene: SceneArg,
    frames: Frames = None,
    seed: Seed = None,
    out: Out = None,
    set_: Overrides = None,
    preview: Annotated[
        bool, typer.Option("--preview", help="Write an 8-bit image of each frame with the truth marked.")
    ] = False,
    json: Json = False,
) -> None:
    """Simulate a scene and write its frames with their truth, without solving them."""
    from skysim.results.run import Recorder
    from skysim.simulation import run as simulation
    from skysim.simulation.checks.dome import assumptions
    from skysim.simulation.testbed import build_testbed

    loaded = load(scene, frames, seed, set_)
    testbed = build_testbed(loaded)
    if warning := assumptions.camera_outside_warning(loaded, testbed.mount):
        terminal.print_error(warning)
    with terminal.progress_callback("simulating the motion") as update:
        testbed = simulation.simulate_motion(testbed, update)
    folder, paths = output_folder(out, loaded.name), list[str]()
    folders = [folder, *(folder / head.name for head in loaded.heads)]
    for camera, own_folder in zip(testbed.cameras, folders, strict=True):
        rendered = terminal.eager_first(simulation.render_frames(camera))
        recorder = Recorder(own_folder, camera)
        paths += [
            str(recorder.write(frame, truth, preview))
            for frame, truth, _ in terminal.progress(rendered, camera.scene.exposure.frames, loaded.title)
        ]
    if json:
        terminal.print_json(paths)
    else:
        print(f"{len(paths)} frames with their truth in {folder}")


def compare(
    scene: SceneArg,
    tracker: Annotated[list[str], typer.Option(metavar="NAME", help=f"{TRACKER_HELP[:-1]}; repeatable.")],
    program: Programs = None,
    frames: Frames = None,
    seed: Seed = None,
    out: Out = None,
    set_: Overrides = None,
    json: Json = False,
) -> None:
    """Let trackers solve the same frames and compare their scores. With a filter, the first one closes the loop."""
    from skysim.experiments import tracker_comparison
    from skysim.results.run import Recorder
    from skysim.simulation import run as simulation
    from skysim.simulation.testbed import build_testbed

    loaded = load(scene, frames, seed, set_, tracker)
    testbed = build_testbed(loaded, used_programs(program, [*tracker, *scene_names(loaded)]))
    entrants = tracker_comparison.build_trackers(testbed, tracker)
    with terminal.progress_callback("simulating the motion", quiet=json) as update:
        testbed = simulation.simulate_motion(testbed, update)
    solved = terminal.eager_first(tracker_comparison.compare_frames(testbed, entrants))
    recorder = Recorder(output_folder(out, loaded.name), testbed)
    rows: dict[str, list[FrameRow]] = {name: [] for name in entrants}
    for frame, truth, row_by_tracker in terminal.progress(solved, loaded.exposure.frames, loaded.title, quiet=json):
        recorder.write(frame, truth)
        for name, row in row_by_tracker.items():
            rows[name].append(row)
    lines = tracker_comparison.write_scores(recorder.folder, rows, loaded)
    if json:
        terminal.print_json({"scene": loaded.name, "scoreboard": tracker_comparison.as_dicts(lines)})
    else:
        terminal.print_scores(lines, recorder.folder)


def trackers(json: Json = False) -> None:
    """List the available trackers, and what each still needs to be installed."""
    from skysim.tracking.external import interface

    entries = [{"name": interface.OWN, "from": "skysim", "needs": ""}]
    entries += [
        {"name": name, "from": point.value, "needs": interface.missing_extra(point)}
        for name, point in interface.TRACKERS.entry_points().items()
    ]

    def line(entry: dict[str, str]) -> str:
        needs = f"  needs {entry['needs']}" if entry["needs"] else ""
        return f"{entry['name']:20s} {entry['from']}{needs}"

    terminal.print_list(entries, json, line)
