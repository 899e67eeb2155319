"""Command `skysim study`: run, inspect, resume, export and replay studies."""

from __future__ import annotations

import shlex
import signal
from collections.abc import Iterator
from contextlib import closing, contextmanager
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from skysim.apps.cli.terminal import print_error, print_table, print_titles, trial_progress
from skysim.core.errors import InputError, printable

if TYPE_CHECKING:
    from skysim.experiments.study.execution.engines import Engine
    from skysim.experiments.study.plan import Plan
    from skysim.experiments.study.store import Store

app = typer.Typer(
    invoke_without_command=True, help="Many trials of a scene whose fields vary, answered with error bars."
)

StudyArg = Annotated[
    str, typer.Argument(metavar="STUDY", help="A study file (.yaml) or the name of one in scenes/studies/.")
]

Out = Annotated[Path | None, typer.Option(help="Folder of the store and the report; out/NAME if left out.")]

Workers = Annotated[
    int | None, typer.Option(min=1, help="Processes; as many as there are cores if left out.")
]

EngineName = Annotated[str, typer.Option("--engine", help="pool, serial or dask.")]

Scheduler = Annotated[str, typer.Option(help="Address of a Dask scheduler, tcp://HOST:PORT.")]

Sets = Annotated[
    list[str] | None, typer.Option("--set", metavar="KEY=VALUE", help="Override a key: replicates=100.")
]

Programs = Annotated[
    list[str] | None,
    typer.Option("--program", metavar="NAME=COMMAND", help="A tracker that the study may name."),
]

Json = Annotated[bool, typer.Option("--json", help="Print JSON for machines instead of a table.")]


@app.callback()
def studies(context: typer.Context, json: Json = False) -> None:
    """List the studies that come with skysim."""
    if context.invoked_subcommand:
        return
    from skysim.core import files
    from skysim.experiments.study import plan

    print_titles(plan.STUDIES, plan.title_of, json, files.to_json)


@app.command()
def run(
    study: StudyArg,
    out: Out = None,
    workers: Workers = None,
    engine: EngineName = "pool",
    scheduler: Scheduler = "",
    set_: Sets = None,
    program: Programs = None,
    json: Json = False,
) -> None:
    """Run all trials of a study and write its report. After Ctrl-C, `resume` continues."""
    warmed(engine)
    from skysim.core.yaml_reader import parse_overrides
    from skysim.experiments.study import loader
    from skysim.tracking.external import process

    overrides = parse_overrides(set_)
    told = loader.load(study, overrides, process.named(program))
    if told.study.optimise is not None:
        raise InputError(f"{told.path}: optimise: has no design to run; allowed: skysim study optimise")
    done(told, study, out, engine_of(engine, workers, scheduler), overrides, json)


@app.command()
def resume(
    study: StudyArg,
    out: Out = None,
    workers: Workers = None,
    engine: EngineName = "pool",
    scheduler: Scheduler = "",
    failed: Annotated[bool, typer.Option("--failed", help="Also do again the trials that failed.")] = False,
    program: Programs = None,
    json: Json = False,
) -> None:
    """Continue a study or a search that was stopped or killed, or that used up its budget."""
    warmed(engine)
    told, overrides = planned(study, out, program or [])
    done(told, study, out, engine_of(engine, workers, scheduler), overrides, json, again=True, failed=failed)


@app.command()
def status(study: StudyArg, out: Out = None, json: Json = False) -> None:
    """Show the progress of a study, while it runs or after."""
    from skysim.core import files
    from skysim.experiments.study import store

    (told, _), folder = planned(study, out), folder_of(study, out)
    with store.open_store(folder / store.STORE) as kept:
        figures = facts(told, kept)
        failures = [{"trial": trial, "error": error} for trial, error in kept.failures()[:10]]
    if json:
        print(files.to_json(figures | {"failures": failures}))
        return
    print_facts(figures)
    for failure in failures:
        print(f"  trial {failure['trial']}: {printable(failure['error'])}")


@app.command()
def report(study: StudyArg, out: Out = None, json: Json = False) -> None:
    """Write the report of a study, finished or not, and print its table."""
    told, overrides = planned(study, out)
    reported(told, study, out, overrides, json)


@app.command()
def export(
    study: StudyArg,
    to: Annotated[
        list[Path],
        typer.Argument(metavar="FILES", help="Files: .csv, .parquet (a row a trial), .zarr (the responses)."),
    ],
    out: Out = None,
) -> None:
    """Write a study's results for other tools."""
    from skysim.experiments.study import store
    from skysim.experiments.study.report import export as exporting

    (told, _), folder = planned(study, out), folder_of(study, out)
    with store.open_store(folder / store.STORE) as kept:
        for path in to:
            exporting.export(kept, told.study.responses, path)
            print(path)


@app.command()
def replay(
    study: StudyArg,
    trial: Annotated[
        int, typer.Argument(metavar="TRIAL", help="The trial's number, as report and status give it.")
    ],
    out: Out = None,
    show: Annotated[bool, typer.Option("--open/--no-open", help="Open the first picture.")] = False,
    program: Programs = None,
    json: Json = False,
) -> None:
    """Repeat one trial alone and write its frames."""
    from skysim.core import files
    from skysim.experiments.study import store
    from skysim.experiments.study.execution import replay as replaying

    (told, _), folder = planned(study, out, program or []), folder_of(study, out)
    with store.open_store(folder / store.STORE) as kept:
        again = replaying.replay(told, kept, trial, folder / f"trial_{trial}")
    row = again.row
    figures: dict[str, Any] = {
        "trial": trial,
        "point": row.point,
        "replicate": row.replicate,
        "seed": row.seed,
    }
    figures |= {name: getattr(row.outcome, name) for name in row.outcome.__slots__}
    figures |= {"changed": again.changed, "error": row.error}
    figures |= {"files": list(map(str, again.files)), "pictures": list(map(str, again.pictures))}
    if json:
        print(files.to_json(figures))
    else:
        print_replay(figures)
    if show and again.pictures:
        typer.launch(str(again.pictures[0]))


@app.command()
def optimise(
    study: StudyArg,
    out: Out = None,
    workers: Workers = None,
    engine: EngineName = "pool",
    scheduler: Scheduler = "",
    set_: Sets = None,
    program: Programs = None,
    json: Json = False,
) -> None:
    """Search a study's factors for the best point, or the Pareto front of two objectives. `resume` continues it."""
    warmed(engine)
    from skysim.core.yaml_reader import parse_overrides
    from skysim.experiments.study import loader
    from skysim.tracking.external import process

    overrides = parse_overrides(set_)
    told = loader.load(study, overrides, process.named(program))
    if told.study.optimise is None:
        raise InputError(
            f"{told.path}: optimise: missing; allowed: skysim study run, for a study with a design"
        )
    done(told, study, out, engine_of(engine, workers, scheduler), overrides, json)


def done(
    told: Plan,
    study: str,
    out: Path | None,
    engine: Engine,
    overrides: dict[str, str],
    json: bool,
    again: bool = False,
    failed: bool = False,
) -> None:
    """Run the missing trials of a study or a search with a progress bar, then report.

    again  : the store may hold trials already
    failed : repeat the failed trials too
    """
    from skysim.experiments.study import store
    from skysim.experiments.study.analysis import search
    from skysim.experiments.study.execution import runner

    on = command(study, out, "resume")
    with store.writing(folder_of(study, out) / store.STORE) as kept, stoppable(on, kept), closing(engine):
        runner.begin(told, kept, again, overrides)
        if failed:
            kept.forget_failed()
        with trial_progress(told.study.title, total(told)) as watch:
            if told.study.optimise is not None:
                whole = search.search(told, kept, engine, watch).finished
            else:
                progress = runner.run(told, kept, engine, watch)
                whole = progress.done == progress.trials
        counts = kept.counts()
    if not whole:
        print_error(f"{counts['done']} of {total(told)} trials done within the budget; {on} goes on")
    if counts["failed"]:
        print_error(f"{counts['failed']} trials failed; {command(study, out, 'status')} names them")
    reported(told, study, out, overrides, json)


def total(told: Plan) -> int:
    """Total number of trials of a study or a search."""
    return told.study.replicates * (
        told.study.optimise.candidates if told.study.optimise else len(told.points)
    )


@contextmanager
def stoppable(on: str, kept: Store) -> Iterator[None]:
    """Within this context Ctrl-C and SIGTERM print `on`, the command that continues the run, and end it."""

    def stop(*_: Any) -> None:
        raise KeyboardInterrupt

    before = signal.signal(signal.SIGTERM, stop)
    try:
        yield
    except KeyboardInterrupt:
        print_error(f"{kept.counts()['done']} trials are in; {on} goes on")
        raise
    finally:
        signal.signal(signal.SIGTERM, before)


def reported(told: Plan, study: str, out: Path | None, overrides: dict[str, str], json: bool) -> None:
    """Write the HTML report and print the table of results."""
    from skysim.core import files
    from skysim.experiments.study import store
    from skysim.experiments.study.analysis import table
    from skysim.experiments.study.report import page

    folder = folder_of(study, out)
    path, verb = folder / "report.html", "optimise" if told.study.optimise else "run"
    with store.open_store(folder / store.STORE) as kept:
        repeat = command(study, out, verb, overrides)
        lines = table.table(kept, page.responses(told.study))
        page.write_page(path, kept, told.study, repeat, lines, **findings(told, kept))
        lines = table.asked(lines, told.study.responses)
        figures = facts(told, kept)
    if json:
        print(files.to_json(figures | {"report": str(path), "points": table.flat(lines)}))
        return
    heads, cells = table.cells(lines)
    print_table("", heads, cells[:MOST_LINES])
    if len(cells) > MOST_LINES:
        print(f"and {len(cells) - MOST_LINES} points more, in the report")
    print_facts(figures)
    print(f"report: {path}")


def findings(told: Plan, kept: Store) -> dict[str, Any]:
    """Extra content of the report: Sobol indices, or a search's Pareto front and the cost of each candidate."""
    from skysim.experiments.study.analysis import search, sensitivity

    if told.study.optimise is not None:
        found = search.found(told, kept)
        costs = {one.number: one.cost for one in found.candidates}
        return {"front": [one.number for one in found.front], "costs": costs}
    return {"indices": sensitivity.indices(told, kept)} if told.study.design.kind == "saltelli" else {}


MOST_LINES = 60  # printed of a table; the report has all


def facts(told: Plan, kept: Store) -> dict[str, Any]:
    """Progress and provenance of a study: trial counts, code version, run time and store."""
    counts, trials = kept.counts(), total(told)
    return {
        "study": told.name,
        "title": told.study.title,
        "trials": trials,
        **counts,
        "code": kept.meta("code"),
        "seconds": sum(run["seconds"] for run in kept.runs()),
        "store": str(kept.path),
    }


def print_facts(figures: dict[str, Any]) -> None:
    rate = figures["done"] / figures["seconds"] if figures["seconds"] else 0.0
    print(
        f"{printable(figures['title'])}: {figures['done']} of {figures['trials']} trials, {figures['failed']} failed,"
        f" {figures['wrong']} wrong attitudes; {figures['seconds']:.1f} s, {rate:.0f} a second\n"
        f"store: {figures['store']} (code {figures['code']})"
    )


def print_replay(figures: dict[str, Any]) -> None:
    for name in (
        "trial",
        "point",
        "replicate",
        "seed",
        "status",
        "x_arcsec",
        "y_arcsec",
        "roll_arcsec",
        "stars",
        "matched",
    ):
        print(f"{name:12s} {figures[name]}")
    if figures["changed"]:
        print_error(f"differs from the store in {', '.join(figures['changed'])}: made with other code")
    if figures["error"]:
        print(figures["error"])
    for path in figures["pictures"][:10]:
        print(path)


def planned(study: str, out: Path | None, program: list[str] | None = None) -> tuple[Plan, dict[str, str]]:
    """Load the study with the overrides saved in its store; return the plan and the overrides.

    program : external trackers of the command line; None if no trial will be run

    Raises InputError if the store holds another study, or this one before it was changed.
    """
    from skysim.experiments.study import loader, store
    from skysim.tracking.external import process

    path = folder_of(study, out) / store.STORE
    with store.open_store(path) as kept:
        overrides = kept.overrides()
        held = kept.meta("digest")
    told = loader.load(study, overrides, None if program is None else process.named(program))
    if told.digest != held:
        raise InputError(
            f"{path}: holds another study, or this one before it was changed; allowed: another --out"
        )
    return told, overrides


def warmed(engine: str) -> None:
    """Start the worker processes first, so that their imports run in parallel with ours."""
    if engine == "pool":
        from skysim.experiments.study.execution import workers

        workers.warm()


def engine_of(name: str, workers: int | None, scheduler: str) -> Engine:
    """Create the engine that runs the trials. Raises InputError for an unknown name or a missing scheduler."""
    from skysim.experiments.study.execution.runner import ENGINES

    if name not in ENGINES:
        raise InputError(f"--engine: {name!r} is none of {', '.join(ENGINES)}")
    if (name == "dask") != bool(scheduler):
        raise InputError("--scheduler: goes with --engine dask, and takes tcp://HOST:PORT")
    return ENGINES[name](workers, scheduler)


def folder_of(study: str, out: Path | None) -> Path:
    """The folder of a study's store and report: `out`, or out/NAME."""
    return out or Path("out") / Path(study).stem


def command(study: str, out: Path | None, verb: str, overrides: dict[str, str] | None = None) -> str:
    """The shell command that applies `verb` to the study."""
    words = ["skysim", "study", verb, study, *(["--out", str(out)] if out else [])]
    return shlex.join([*words, *(f"--set={key}={value}" for key, value in (overrides or {}).items())])
