"""Commands `skysim run`, `render`, `compare` and `trackers`."""

from __future__ import annotations

from dataclasses import asdict
from typing import TYPE_CHECKING, Annotated

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
    Scene3d,
    SceneArg,
    Seed,
    SolverName,
    command_line,
    given_options,
    load,
    output_folder,
    scene_names,
    used_programs,
    with_location,
)

if TYPE_CHECKING:
    from skysim.core.types import Record
    from skysim.results.report import Report
    from skysim.results.scoring import FrameRow
    from skysim.scene.scene import Scene
    from skysim.simulation.checks import Check


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
    scene_3d: Scene3d = False,
    open_: OpenReport = False,
    json: Json = False,
) -> None:
    """Simulate a scene: motion, frames, attitude solutions and their scores."""
    from skysim.results.run import FlightRecorder
    from skysim.simulation.checks import check
    from skysim.simulation.compilation import on_two_processes
    from skysim.simulation.flight import open_flight

    stages = given_options(
        detector=detector,
        centroider=centroider,
        identifier=identifier,
        solver=solver,
        name=tracker,
    )
    overrides = [*(set_ or []), *(f"tracker.{key}={name}" for key, name in stages.items())]
    loaded = load(scene, overrides, seed, frames)
    with open_flight(loaded, programs=used_programs(program, scene_names(loaded))) as flight:
        plan = check(flight.lab)
        for finding in plan.findings:
            terminal.print_error(with_location(finding))
        recorder = FlightRecorder(output_folder(out, loaded.name), flight)
        with (
            on_two_processes(*LOADED[-1]),
            terminal.progress_callback(loaded.title) as update,
        ):
            rows = recorder.record(flight.shots(progress=update))
        finished = recorder.finish(
            command_line(), plan, terminal.write_3d_views if scene_3d else None
        )
    statistics = print_results(loaded, finished, rows, plan, json)
    if open_:
        typer.launch(statistics["report"])
    terminal.fail_if_not_met(statistics.get("requirements", ()))


def print_results(
    scene: Scene,
    finished: list[tuple[Record, Report]],
    rows: list[FrameRow],
    plan: Check,
    json: bool,
) -> Record:
    """Print the results of the main camera and of the further heads; return the main camera's statistics."""
    from skysim.results.report import Facts, print_blocks
    from skysim.simulation.checks.facts import TRACKER_KNOWS

    (statistics, report), *others = finished
    heads = dict(zip([head.name for head in scene.heads], others, strict=True))
    if json:
        result = {"scene": scene.name, **statistics, "rows": [asdict(row) for row in rows]}
        head_results = {name: head for name, (head, _) in heads.items()}
        terminal.print_json(result | {"heads": head_results} if heads else result)
        return statistics
    known = [(fact.name, fact.lines) for fact in plan.facts if fact.name == TRACKER_KNOWS]
    print_blocks([Facts(known)])
    report.print()
    print(f"report: {statistics['report']}")
    for name, (head, head_report) in heads.items():
        terminal.print_wrapped(f"{name}: {head_report.verdict}; report: {head['report']}")
    return statistics


def render(
    scene: SceneArg,
    frames: Frames = None,
    seed: Seed = None,
    out: Out = None,
    set_: Overrides = None,
    preview: bool = False,
    json: Json = False,
) -> None:
    """Simulate a scene and write its frames with their truth, without solving them.

    Parameters
    ----------
    preview
        Write an 8-bit image of each frame with the truth marked.
    """
    from skysim.results.run import FlightRecorder
    from skysim.simulation.checks.plan_check import camera_outside_warning
    from skysim.simulation.flight import open_flight

    loaded = load(scene, set_, seed, frames)
    folder = output_folder(out, loaded.name)
    with open_flight(loaded) as flight:
        if warning := camera_outside_warning(flight.lab):
            terminal.print_error(warning)
        recorder = FlightRecorder(folder, flight)
        with terminal.progress_callback(loaded.title) as update:
            paths = [
                str(
                    recorder.recorders[shot.camera.name].write(
                        shot.frame, shot.truth, preview
                    )
                )
                for shot in flight.shots(solves=False, progress=update)
            ]
    if json:
        terminal.print_json(paths)
    else:
        print(f"{len(paths)} frames with their truth in {folder}")


def compare(
    scene: SceneArg,
    tracker: Annotated[
        list[str], typer.Option(metavar="NAME", help=f"{TRACKER_HELP[:-1]}; repeatable.")
    ],
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
    from skysim.simulation.flight import Flight
    from skysim.simulation.lab import UserParts, build_lab

    loaded = load(scene, set_, seed, frames, tracker)
    programs = used_programs(program, [*tracker, *scene_names(loaded)])
    lab = build_lab(loaded, UserParts(programs))
    entrants = tracker_comparison.build_trackers(lab, tracker, programs)
    rows: dict[str, list[FrameRow]] = {name: [] for name in entrants}
    recorder = None
    with (
        Flight(lab, UserParts(programs, tracker=entrants[tracker[0]])) as flight,
        terminal.progress_callback(loaded.title) as update,
    ):
        for frame, truth, row_by_tracker in tracker_comparison.compare_frames(
            flight, entrants, update
        ):
            recorder = recorder or Recorder(output_folder(out, loaded.name), lab.camera)
            recorder.write(frame, truth)
            for name, row in row_by_tracker.items():
                rows[name].append(row)
    assert recorder is not None
    lines = tracker_comparison.write_scores(recorder.folder, rows, loaded)
    if json:
        terminal.print_json(
            {"scene": loaded.name, "scoreboard": tracker_comparison.as_dicts(lines)}
        )
    else:
        terminal.print_scores(lines, recorder.folder)


def trackers(json: Json = False) -> None:
    """List the available trackers, and what each still needs to be installed."""
    from skysim.tracking import tracker_interface

    entries = [{"name": tracker_interface.OWN, "from": "skysim", "needs": ""}]
    entries += [
        {"name": name, "from": point.value, "needs": tracker_interface.missing_extra(point)}
        for name, point in tracker_interface.TRACKERS.entry_points().items()
    ]

    def line(entry: dict[str, str]) -> str:
        needs = f"  needs {entry['needs']}" if entry["needs"] else ""
        return f"{entry['name']:20s} {entry['from']}{needs}"

    terminal.print_list(entries, json, line)
