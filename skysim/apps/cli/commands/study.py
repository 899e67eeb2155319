"""Commands `skysim study`: run, inspect, resume, export and replay studies; and `skysim dataset`."""

from __future__ import annotations

from contextlib import AbstractContextManager, closing
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, NamedTuple

import typer
from typer import Argument, Option

from skysim.apps.cli.options import (
    Json,
    OpenReport,
    Out,
    Overrides,
    Programs,
    Scene3d,
    SceneArg,
    Seed,
    complete_study,
    output_folder,
    study_names,
    used_programs,
)
from skysim.apps.cli.terminal import (
    fail_if_not_met,
    print_error,
    print_json,
    print_replay,
    print_titles,
    trial_progress,
    write_3d_views,
)
from skysim.core.errors import InputError, check_name, printable
from skysim.results.report import print_wrapped

if TYPE_CHECKING:
    from skysim.core.types import Record
    from skysim.experiments.study.execution.engines import Engine
    from skysim.experiments.study.execution.store import Store
    from skysim.experiments.study.plan import Plan

app = typer.Typer(
    invoke_without_command=True,
    help="Run Monte Carlo studies: many trials of a scene with varied keys.",
)

StudyArg = Annotated[
    str,
    Argument(
        metavar="STUDY",
        help="Study file (.yaml), or name of a shipped study; once it has run, its output folder too.",
        autocompletion=complete_study,
    ),
]
Workers = Annotated[
    int | None, Option(min=1, help="Number of worker processes; default: number of cores.")
]
EngineName = Annotated[str, Option(help="How trials are run: pool, serial or dask.")]
Scheduler = Annotated[str, Option(help="Address of the Dask scheduler, tcp://HOST:PORT.")]


@app.callback()
def studies(context: typer.Context, json: Json = False) -> None:
    """List the studies that come with skysim."""
    if context.invoked_subcommand:
        return
    from skysim.core.paths import STUDIES

    print_titles(STUDIES, json)


@app.command(
    help="Run all trials of a study and write its report. After Ctrl-C, `resume` continues."
)
def run(
    context: typer.Context,
    study: StudyArg,
    out: Out = None,
    workers: Workers = None,
    engine: EngineName = "pool",
    scheduler: Scheduler = "",
    set_: Overrides = None,
    program: Programs = None,
    open_: OpenReport = False,
    json: Json = False,
) -> None:
    """Run a study, or a search if called as `optimize`, that has no store yet."""
    start_workers(engine)
    from skysim.core.yaml_reader import parse_overrides
    from skysim.experiments.study import study_file
    from skysim.tracking import tracker_interface

    overrides = parse_overrides(set_)
    plan = study_file.load(study, overrides, tracker_interface.program_commands(program))
    used_programs(program, study_names(plan) if program else ())
    search = context.info_name == "optimize"
    if search and plan.study.optimize is None:
        raise InputError(plan.path, "has no key optimize", "skysim study run")
    if not search and plan.study.optimize is not None:
        raise InputError(plan.path, "has the key optimize", "skysim study optimize")
    trial_engine = create_engine(engine, workers, scheduler)
    run_and_report(plan, Place(study, out), trial_engine, overrides, json, open_)


@app.command()
def resume(
    study: StudyArg,
    out: Out = None,
    workers: Workers = None,
    engine: EngineName = "pool",
    scheduler: Scheduler = "",
    failed: bool = False,
    set_: Overrides = None,
    program: Programs = None,
    open_: OpenReport = False,
    json: Json = False,
) -> None:
    """Continue a study or a search that was stopped or killed, or that used up its budget.

    `--set replicates=N` adds replicates to a study; its trials are kept.

    Parameters
    ----------
    failed
        Repeat failed trials too.
    """
    start_workers(engine)
    place, plan, overrides = load_stored_plan(study, out, program or [], set_, grows=True)
    trial_engine = create_engine(engine, workers, scheduler)
    run_and_report(
        plan, place, trial_engine, overrides, json, open_, resumed=True, repeat_failed=failed
    )


@app.command()
def status(study: StudyArg, out: Out = None, json: Json = False) -> None:
    """Show the progress of a study, while it runs or after."""
    place, plan, _ = load_stored_plan(study, out)
    with place.open() as stored:
        progress = study_status(plan, stored)
        failures = [
            {"trial": trial, "error": error} for trial, error in stored.failures()[:10]
        ]
    if json:
        print_json(progress | {"failures": failures})
        return
    seconds = progress["seconds"]
    speed = "its first run has not ended"
    if seconds:
        speed = f"{seconds:.1f} s, {progress['done'] / seconds:.2g} trials/s"
    print_wrapped(
        f"{progress['title']}: {progress['done']} of {progress['trials']} trials, {progress['failed']} failed,"
        f" {progress['wrong']} wrong attitudes; {speed}"
    )
    print(f"store: {progress['store']} (code {progress['code']})")
    for failure in failures:
        print(f"  trial {failure['trial']}: {printable(failure['error'])}")


@app.command()
def report(
    study: StudyArg, out: Out = None, open_: OpenReport = False, json: Json = False
) -> None:
    """Write the report of a study, finished or not, and print its table."""
    place, plan, _ = load_stored_plan(study, out)
    write_report(plan, place, json, open_)


@app.command()
def export(
    study: StudyArg,
    to: Annotated[list[Path], Argument()],
    out: Out = None,
) -> None:
    """Write a study's results for other tools.

    Parameters
    ----------
    to : FILES
        Output files: .csv or .parquet (a row per trial), .zarr (the responses).
    """
    from skysim.experiments.study.report import study_export

    place, plan, _ = load_stored_plan(study, out)
    with place.open() as stored:
        for path in to:
            study_export.export(stored, plan.study.responses, path)
            print(path)


@app.command()
def replay(
    study: StudyArg,
    trial: Annotated[int, Argument()],
    out: Out = None,
    show: Annotated[bool, Option("--open/--no-open")] = False,
    scene_3d: Scene3d = False,
    program: Programs = None,
    json: Json = False,
) -> None:
    """Repeat one trial and write its frames; of a flight also telemetry and report, and what went wrong in it.

    Parameters
    ----------
    trial : TRIAL
        Number of the trial, as in the report and in `status`.
    show
        Open the first image.
    """
    from skysim.experiments.study.execution import runner

    place, plan, _ = load_stored_plan(study, out, program or [])
    folder = place.folder / f"trial_{trial}"
    draw = write_3d_views if scene_3d else None
    with place.open() as stored:
        repeated = runner.replay(plan, stored, trial, folder, draw)
    row = repeated.row
    result: Record = {
        "trial": trial,
        "point": row.point,
        "replicate": row.replicate,
        "seed": row.seed,
        **{name: getattr(row.outcome, name) for name in row.outcome.__dataclass_fields__},
        "changed": repeated.changed,
        "error": row.error,
        "reasons": repeated.reasons,
        "files": list(map(str, repeated.files)),
        "pictures": list(map(str, repeated.pictures)),
    }
    if json:
        print_json(result)
    else:
        print_replay(result)
    if show and repeated.pictures:
        typer.launch(str(repeated.pictures[0]))


@app.command()
def worst(
    study: StudyArg,
    response: str = "",
    where: list[str] | None = None,
    count: Annotated[int, Option(min=1, max=100)] = 3,
    out: Out = None,
    json: Json = False,
) -> None:
    """Name the attitudes of the worst trials, and the commands that repeat them.

    Parameters
    ----------
    response
        Response or quantity (roll_arcsec) that ranks the trials; default: the study's first response.
    where : FACTOR=LEVEL
        Only points at this level; may be given several times.
    count
        Number of attitudes.
    """
    from skysim.core.yaml_reader import parse_overrides, parse_yaml
    from skysim.experiments.study import worst as analysis
    from skysim.results import metrics

    place, plan, _ = load_stored_plan(study, out)
    name = response or plan.study.responses[0]
    if name not in metrics.QUANTITIES:
        metrics.response(name, "response")
    with place.open() as stored:
        points = stored.points()
        chosen = {
            key: parse_yaml(text)[1]
            for key, text in parse_overrides(where, "where", "FACTOR=LEVEL").items()
        }
        found = analysis.worst_of_levels(plan.study, stored, name, chosen, count)
    rows = [
        one._asdict()
        | {
            "levels": points[one.point].levels,
            "command": f"{place.command('replay')} {one.trial}",
        }
        for one in found
    ]
    if json:
        print_json(rows)
        return
    ranked = analysis.ranked(name)
    if not found:
        instead = f"{place.command('worst')} --response roll_arcsec"
        print(f"no trial counts for {ranked}; rank them by an error: {instead}")
    for rank, (one, row) in enumerate(zip(found, rows, strict=True), 1):
        at = ", ".join(f"{factor} = {level}" for factor, level in row["levels"].items())
        print(
            f"{rank}. {ranked} {one.value:.4g}: {one.direction}, {one.lights:.0f} lights: {printable(one.event)}"
            f" ({printable(at)})"
        )
        if one.start:
            print(f"   {one.start}")
        print(f"   {row['command']}")


def study_status(plan: Plan, store: Store) -> Record:
    """Progress and provenance of a study: trial counts, code version, run time and store."""
    return {
        "study": plan.name,
        "title": plan.study.title,
        "trials": plan.study.trial_count(len(plan.points)),
        **store.counts(),
        "code": store.meta("code"),
        "seconds": sum(run["seconds"] for run in store.runs()),
        "store": store.path,
    }


# Registered last to be the last in `skysim study --help`.
SEARCH_HELP = (
    "Search a study's factors for the best point, or the Pareto front of two objectives."
    " `resume` continues it."
)
app.command("optimize", help=SEARCH_HELP)(run)


def run_and_report(
    plan: Plan,
    place: Place,
    engine: Engine,
    overrides: dict[str, str],
    json: bool,
    open_: bool,
    resumed: bool = False,
    repeat_failed: bool = False,
) -> None:
    """Run the missing trials of a study or a search with a progress bar, then report.

    Parameters
    ----------
    resumed
        Whether the store may already hold trials
    repeat_failed
        Whether failed trials are repeated
    """
    from skysim.experiments.study import search
    from skysim.experiments.study.execution import runner, store

    total = plan.study.trial_count(len(plan.points))
    resume_command = place.command("resume")
    with store.writing(place.store) as stored, closing(engine):
        try:
            runner.prepare_store(plan, stored, resumed, overrides)
            if repeat_failed:
                stored.delete_failed()
            with trial_progress(plan.study.title, total) as update:
                if plan.study.optimize is not None:
                    finished = search.search(plan, stored, engine, update).finished
                else:
                    progress = runner.run(plan, stored, engine, update)
                    finished = progress.done == progress.trials
        except KeyboardInterrupt:  # Ctrl-C or SIGTERM
            print_error(
                f"{stored.counts()['done']} trials are stored; continue: {resume_command}"
            )
            raise
        counts = stored.counts()
    if not finished:
        print_error(
            f"{counts['done']} of {total} trials done within the budget; continue: {resume_command}"
        )
    if counts["failed"]:
        print_error(f"{counts['failed']} trials failed; list them: {place.command('status')}")
    write_report(plan, place, json, open_)


def write_report(plan: Plan, place: Place, json: bool, open_: bool) -> None:
    """Write the HTML report, print it, and open it in the browser if `open_`."""
    from skysim.experiments.study import answer, search, table, thresholds
    from skysim.experiments.study.report import study_report

    path = place.folder / "report.html"
    with place.open() as stored:
        command = study_report.commands(plan, stored, *place)
        found = study_report.analyze(plan, stored, command)
        report = study_report.compose(stored, found, command)
        progress = study_status(plan, stored)
    report.save(path)
    if open_:
        typer.launch(str(path))
    judged = [one._asdict() for row in found.judged for one in row]
    if not json:
        report.print()
        print(f"store: {progress['store']} (code {progress['code']})")
        print(f"report: {path}")
        fail_if_not_met(judged)
        return
    columns = table.to_columns(table.select_responses(found.lines, plan.study.responses))
    told = {
        "report": path,
        "points": columns,
        "answers": found.answers,
        "findings": found.about.findings,
    }
    if judged:
        lines = answer.answered(found.lines)
        progress["requirements"] = [
            row[thresholds.decisive(row)[0]]._asdict()
            | {
                "points": [
                    one._asdict() | {"point": line.point}
                    for one, line in zip(row, lines, strict=False)
                ]
            }
            for row in found.judged
        ]
    print_json(progress | told | (search.front_columns(found.result) if found.result else {}))
    fail_if_not_met(judged)


class Place(NamedTuple):
    """A study's file or name, and the folder of --out; store and report are in its folder."""

    study: str
    out: Path | None

    @property
    def folder(self) -> Path:
        return output_folder(self.out, Path(self.study).stem)

    @property
    def store(self) -> Path:
        from skysim.experiments.study.execution import store

        return self.folder / store.STORE

    def open(self) -> AbstractContextManager[Store]:
        """The study's store, opened for reading. Raises InputError if there is none."""
        from skysim.experiments.study.execution import store

        return store.open_store(self.store)

    def command(self, verb: str) -> str:
        """The shell command that applies `verb` to the study."""
        from skysim.experiments.study.report.study_report import shell_command

        return shell_command(*self, {}, verb)


def load_stored_plan(
    study: str,
    out: Path | None,
    program: list[str] | None = None,
    set_: list[str] | None = None,
    grows: bool = False,
) -> tuple[Place, Plan, dict[str, str]]:
    """Load the study with the overrides saved in its store; return its place, the plan and the overrides.

    Parameters
    ----------
    program
        External trackers of the command line; None if no trial will be run
    set_
        Further overrides
    grows
        Whether the study may have more replicates than its store

    Raises
    ------
    InputError
        If the store holds another study, or this one before it was changed.
    """
    from skysim.core.yaml_reader import parse_overrides
    from skysim.experiments.study import study_file
    from skysim.experiments.study.execution import runner
    from skysim.tracking import tracker_interface

    # The study's file, or the folder of its store.
    place = Place(study, out)
    inside = Place(study, Path(study))
    if out is None and inside.store.is_file():
        with inside.open() as stored:
            file = stored.meta("file")
        if not Path(file).is_file():
            raise InputError(
                study,
                f"no such file as its study, {file or 'not stored'}",
                f"STUDY --out {study}",
            )
        place = Place(file, Path(study))
    with place.open() as stored:
        overrides = stored.overrides() | parse_overrides(set_)
        plan = study_file.load(
            place.study,
            overrides,
            None if program is None else tracker_interface.program_commands(program),
        )
        kept = runner.stored_replicates(plan, stored)
    if not kept or (kept < plan.study.replicates and not grows):
        raise InputError(
            place.store,
            "contains another study or an earlier version of this one",
            "another store",
        )
    return place, plan, overrides


def start_workers(engine: str) -> None:
    """Start the worker processes first, so that their imports run in parallel with ours."""
    if engine == "pool":
        from skysim.experiments.study.execution import workers

        workers.start_fork_server()


def create_engine(name: str, workers: int | None, scheduler: str) -> Engine:
    """Create the engine that runs the trials. Raises InputError for an unknown name or a missing scheduler."""
    from skysim.experiments.study.execution.runner import ENGINES

    check_name("--engine", "engine", name, ENGINES)
    if workers is not None and name != "pool":
        raise InputError(
            f"--workers {workers}", f"has no effect with --engine {name}", "--engine pool"
        )
    if (name == "dask") != bool(scheduler):
        raise InputError(
            "--scheduler", "required with --engine dask and only then", "tcp://HOST:PORT"
        )
    return ENGINES[name](workers, scheduler)


def dataset(
    scene: SceneArg,
    frames: int,
    out: str,
    vary: Path | None = None,
    to: list[str] | None = None,
    shard_frames: int = 64,
    compress: bool = False,
    seed: Seed = None,
    set_: Overrides = None,
    workers: Workers = None,
    engine: EngineName = "pool",
    scheduler: Scheduler = "",
    json: Json = False,
) -> None:
    """Write labelled frames at random attitudes, for those who train and test detectors.

    Stopped or killed, it goes on where it was when it is called again.

    Parameters
    ----------
    frames
        Number of frames.
    out : URL
        Output folder, or a URL such as s3://bucket/folder.
    vary : FILE
        Variations: YAML with the study's keys set, trial, factors, hardware.
    to
        Format: webdataset, zarr, coco; repeatable. Default: webdataset and coco.
    shard_frames
        Frames of a shard.
    compress
        Compress the images of the tars: .npz in place of .npy.
    """
    start_workers(engine)
    from skysim.core.yaml_reader import parse_overrides
    from skysim.experiments import dataset_run
    from skysim.experiments.dataset_shards import Storage

    Storage(out)  # raises for a wrong URL before the scene is read
    made = dataset_run.load(
        scene,
        vary,
        frames,
        seed=seed,
        overrides=parse_overrides(set_),
        frames_per_shard=shard_frames,
        formats=tuple(to or ("webdataset", "coco")),
        compress=compress,
    )
    with (
        closing(create_engine(engine, workers, scheduler)) as chosen,
        trial_progress(f"dataset of {scene}", frames, "frames") as update,
    ):
        progress = dataset_run.run(made, out, chosen, update)
    if json:
        print_json(
            {
                "out": out,
                "frames": progress.done,
                "shards": made.shards,
                "failed": progress.failed,
                "rate_hz": progress.rate,
            }
        )
    else:
        print(f"{progress.done} of {frames} frames in {made.shards} shards: {out}")
    if progress.failed:
        print_error(
            f"{progress.failed} frames are missing: their workers died; the same command tries them again"
        )
        raise typer.Exit(2)
