"""Command `skysim datasheet`."""

from __future__ import annotations

import math
from contextlib import ExitStack
from pathlib import Path
from typing import TYPE_CHECKING

import typer

from skysim.apps.cli.commands.study import Workers
from skysim.apps.cli.options import LOADED, Json, OpenReport, Overrides, SceneArg, Seed, load
from skysim.apps.cli.terminal import print_json, trial_progress
from skysim.core.errors import InputError
from skysim.results.report import (
    Column,
    Table,
    page_path,
    print_table,
    print_wrapped,
    text_column,
)

if TYPE_CHECKING:
    from skysim.experiments.datasheet.cells import MeasuredFrames


def datasheet(
    scene: SceneArg,
    quick: bool = False,
    fields: int | None = None,
    rates: str | None = None,
    seed: Seed = None,
    set_: Overrides = None,
    workers: Workers = None,
    out: Path | None = None,
    markdown: Path | None = None,
    model: Path | None = None,
    fmu: bool = False,
    open_: OpenReport = False,
    json: Json = False,
) -> None:
    """State the performance of a scene's star tracker: error terms, probabilities, limits, robustness.

    Stopped or killed, it goes on where it was when it is called again.

    Parameters
    ----------
    quick
        Smaller experiments; the intervals are wider.
    fields
        Number of fields (attitudes) of each experiment; more narrow the intervals. With --model 20 or more.
    rates
        Rates to measure, such as 0,1,2,5, deg/s; by default doubled until fewer than half of the fields are
        solved.
    out
        Output folder; default: out/NAME_datasheet.
    markdown
        Also write a Markdown page.
    model
        Also write a fast model of the errors to a folder: a module for NumPy, its constants in JSON.
    fmu
        With --model: also as a co-simulation unit of FMI 3 (needs pythonfmu3).
    """
    from skysim.core import files
    from skysim.experiments.datasheet import cells, datasheet_report
    from skysim.experiments.datasheet.statement import state

    require_outputs(markdown, model, fmu)
    loaded = load(scene, set_, seed)
    folder = out or Path("out") / f"{loaded.name}_datasheet"
    title = f"datasheet of {loaded.name}"
    with ExitStack() as stack:
        sheet = cells.measure(
            scene,
            loaded,
            LOADED[-1][1],
            folder,
            quick=quick,
            fields=fields,
            least=cells.MODEL_FIELDS if model else cells.MIN_FIELDS,
            rates_deg_s=parse_rates(rates) if rates else [],
            workers=workers,
            watch=lambda trials: stack.enter_context(trial_progress(title, trials)),
        )
    statement = state(sheet)
    options = [f"--rates={rates}"] if rates else []
    report = datasheet_report.datasheet_report(statement, ["--quick"] * quick + options)
    page = datasheet_report.write_all(folder, statement, report)["report"]
    if markdown:
        files.write_text(markdown, report.markdown())
    if json:
        print_json(datasheet_report.numbers(statement))
    else:
        report.print()
        print(f"report: {page}")
    if open_:
        typer.launch(str(page))
    # What was measured is written; an error says what is missing.
    if statement.refusal:
        raise statement.refusal
    write_model(model, sheet, fmu, json)


def require_outputs(markdown: Path | None, model: Path | None, fmu: bool) -> None:
    """Make the folders of the page and of the model. Raises InputError for what could not be written in the end."""
    from skysim.core import files
    from skysim.results.files.fmu import require_builder

    if fmu:
        if model is None:
            raise InputError("--fmu", "has no effect without --model", "--model FOLDER --fmu")
        require_builder("datasheet.fmu")
    if markdown:
        page_path(markdown)
    if model:
        files.make_folder(model)


def parse_rates(text: str) -> list[float]:
    """Rates in degrees per second from "0,1,2". Raises InputError."""
    try:
        rates = [float(one) for one in text.split(",")]
    except ValueError:
        rates = [math.nan]
    if not all(0 <= one < math.inf for one in rates) or not any(rates):
        raise InputError(f"--rates {text}", "", "rates of 0 deg/s or more, such as 0,1,2,5")
    return rates


def write_model(folder: Path | None, sheet: MeasuredFrames, fmu: bool, json: bool) -> None:
    """Write the fast model of the errors; print its agreement with the simulation and its files, unless `json`."""
    from skysim.experiments.datasheet import model_fit

    if folder is None:
        return
    agreements = model_fit.agreements(sheet)
    agreement = [one._asdict() for one in agreements]
    written = model_fit.write_model(
        folder, model_fit.constants(sheet) | {"agreement": agreement}
    )
    if fmu:
        written.append(model_fit.write_fmu(folder))
    if json:
        return
    rows = [[*one[:3], *one.p_values, *one[4:]] for one in agreements]
    heads = {
        "rate °/s": "g",
        "frames": "d",
        "p of x": ".2g",
        "p of y": ".2g",
        "p of roll": ".2g",
        "correlation": ".3f",
        "of the model": ".3f",
    }
    columns = [Column(head, format=form) for head, form in heads.items()]
    table = Table([text_column("fitted to"), *columns], rows)
    p_values = [p for one in agreements for p in one.p_values]
    if len(p_values) * min(p_values) < 0.05:
        print_wrapped(
            f"The model does not agree with other fields: p = {min(p_values):.2g} is too small for one of"
            f" {len(p_values)} tests of a right model."
        )
    print_table(
        table,
        "The model, fitted to half of the fields (every second one: even or odd), beside the other half",
    )
    print_wrapped(
        "p: Kolmogorov-Smirnov; of a right model one in twenty is below 0.05. correlation: mean over the axes and the"
        " pairs of frames of the sequences; at faster rates of two frames of one attitude. The table has all rates"
        " that the model of this half accepts."
    )
    print()
    for path in written:
        print(path)
