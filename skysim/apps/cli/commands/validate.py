"""Commands `skysim validate`, `check`, `datasheet` and `availability`, which plan.

`validate` checks input files without simulating, or prints their JSON Schema for an editor; `check` says what a scene
will show and how accurate its tracker will be.
`datasheet` states how good a tracker is, and `availability` when it sees the sky in orbit.
"""

from __future__ import annotations

import contextlib
import math
from collections.abc import Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Literal, NamedTuple

import typer
from typer import Option

from skysim.apps.cli.commands.study import Workers
from skysim.apps.cli.options import (
    LOADED,
    Json,
    OpenReport,
    Overrides,
    Programs,
    SceneArg,
    Seed,
    load,
    scene_names,
    study_names,
    used_programs,
    with_location,
)
from skysim.apps.cli.terminal import (
    print_error,
    print_json,
    progress_callback,
    trial_progress,
)
from skysim.core.constants import DAY_S, EARTH_MU_M3_S2, HOUR_S, JULIAN_YEAR_DAY
from skysim.core.errors import InputError
from skysim.results.report import (
    Column,
    Facts,
    Items,
    Table,
    Text,
    page_path,
    print_blocks,
    print_table,
    print_wrapped,
)

if TYPE_CHECKING:
    from skysim.core.types import Bools
    from skysim.experiments.datasheet.cells import MeasuredFrames
    from skysim.scene.scene import Scene
    from skysim.scene.sections.surroundings import ExclusionConfig
    from skysim.sources.camera_orbit import Pointing, SkySamples


class FileVerdict(NamedTuple):
    """Result for one file: a description and warnings, or `fault`, the error in one line."""

    file: str
    what: str = ""
    doubts: tuple[str, ...] = ()
    fault: str = ""


def validate(
    files: Annotated[list[Path] | None, typer.Argument()] = None,
    program: Programs = None,
    schema: str | None = None,
    json: Json = False,
) -> None:
    """Check files: keys, units, consistency, and whether a scene can be set up. Exit code 2 if one is invalid.

    Parameters
    ----------
    files : FILES
        Scenes, studies and cameras (YAML files or names), calibrations of OpenCV (YAML), vehicles (MJCF),
        catalogs and LED maps (ECSV).
    schema
        Print the JSON Schema of a kind of file: scene or study.
    """
    if schema is not None:
        from skysim.apps.cli import json_schema

        if schema not in json_schema.KINDS:
            raise InputError(f"--schema {schema}", "", ", ".join(json_schema.KINDS))
        print_json(json_schema.json_schema(schema))
        return
    if not files:
        raise InputError("", "no files", "files, or --schema scene")
    from skysim.tracking import tracker_interface

    programs = tracker_interface.program_commands(program)
    verdicts = [check_file(path, programs) for path in files]
    if program and not any(verdict.fault for verdict in verdicts):
        used_programs(program, {name for path in files for name in names_in_file(path)})
    if json:
        print_json([verdict._asdict() for verdict in verdicts])
    for verdict in verdicts if not json else []:
        if verdict.fault:
            print_error(verdict.fault)
        else:
            print(f"{verdict.file}: {verdict.what}", *verdict.doubts, sep="\n  ")
    if any(verdict.fault for verdict in verdicts):
        raise typer.Exit(2)


def check(
    scene: SceneArg, program: Programs = None, set_: Overrides = None, json: Json = False
) -> None:
    """Check a plan before its run: field, lights in it, image size, saturation, smear, focus, expected error, warnings.

    Nothing is simulated or rendered; everything is computed at sampled attitudes.
    """
    from skysim.simulation.checks import check as check_plan
    from skysim.simulation.lab import UserParts, build_lab

    loaded = load(scene, set_)
    result = check_plan(
        build_lab(loaded, UserParts(used_programs(program, scene_names(loaded))))
    )
    findings = [with_location(finding) for finding in result.findings]
    if json:
        print_json(result._replace(findings=findings).as_dict())
    else:
        warnings = [Items(findings, tone="warning")] if findings else [Text("no warnings")]
        print_blocks([Facts([(fact.name, fact.lines) for fact in result.facts]), *warnings])


def check_file(path: Path, programs: Mapping[str, str]) -> FileVerdict:
    """Check one file; errors become the verdict's `fault`.

    Parameters
    ----------
    programs
        Commands of external trackers and controllers, by name
    """
    try:
        return FileVerdict(str(path), *describe_file(path, programs))
    except (InputError, OSError) as error:
        return FileVerdict(str(path), fault=str(error))


def describe_file(path: Path, programs: Mapping[str, str]) -> tuple[str, tuple[str, ...]]:
    """Return a description of the file and warnings. Raises InputError with one line."""
    from skysim.core.yaml_reader import is_file, read_yaml
    from skysim.scene import opencv_calibration

    path = path if path.suffix else find_shipped(path)
    if path.suffix not in (".yaml", ".yml", ".ecsv", ".xml"):
        raise InputError(
            path, "", ".yaml, .ecsv, .xml or the name of a scene, a study or a camera"
        )
    if not is_file(path):  # reading a named pipe would block
        raise InputError(path, "not a regular file")
    if path.suffix == ".ecsv":
        return describe_table(path), ()
    if path.suffix == ".xml":
        from skysim.dynamics import multibody
        from skysim.scene.sections.vehicle import VehicleConfig

        model = multibody.build(VehicleConfig.model_validate({"model": str(path.resolve())}))
        return f"a vehicle of {model.mass.mass_kg:g} kg", ()
    if opencv_calibration.looks_like_calibration(path):
        lens = opencv_calibration.read(path)
        return f"a calibration of {lens.width_px} x {lens.height_px} pixels", ()
    keys = read_yaml(path)[0].keys()
    if keys & {"factors", "trial", "responses"}:
        from skysim.experiments.study import study_file

        plan = study_file.load(path)
        return f"a study of {plan.trials} trials" if plan.trials else "a search", ()
    if "camera" in keys and keys <= {"camera", "schema"}:
        from skysim.scene.camera_sheet import PLACEHOLDER_LENS
        from skysim.scene.loader import load_camera

        camera = load_camera(path, PLACEHOLDER_LENS)
        return f"a camera of {camera.width_px} x {camera.height_px} pixels", ()
    return check_scene(path, programs)


def names_in_file(path: Path) -> set[str | None]:
    """The names of trackers and controllers in a scene or a study; empty for other files."""
    from skysim.experiments.study import study_file
    from skysim.scene import loader

    path = path if path.suffix else find_shipped(path)
    with contextlib.suppress(InputError):
        return set(scene_names(loader.load(path)))
    with contextlib.suppress(InputError):
        return study_names(study_file.load(path))
    return set()


def find_shipped(path: Path) -> Path:
    """Path of the shipped scene, study or camera of this name. Raises InputError with the names of the scenes."""
    from skysim.core.paths import DATA, SCENES, STUDIES, shipped_files
    from skysim.core.yaml_reader import find_file

    others = shipped_files(DATA / "cameras") | shipped_files(STUDIES)
    return others.get(str(path)) or find_file(str(path), SCENES, "scene")


def check_scene(path: Path, programs: Mapping[str, str]) -> tuple[str, tuple[str, ...]]:
    """Set up a scene without simulating its motion: vehicle, lights, tracker. Returns a description and warnings."""
    from skysim.scene import loader
    from skysim.simulation.checks import check as check_plan
    from skysim.simulation.lab import UserParts, build_lab, build_tracker

    scene = loader.load(path)
    try:
        lab = build_lab(scene, UserParts(programs))
        build_tracker(lab.camera, programs)
        findings = check_plan(lab).findings
    except InputError as error:
        raise loader.located(error, str(path), {}) from None
    count = len(lab.camera.sources.id)
    frames = scene.exposure.frames
    described = f"a scene of {count} lights and {frames} frames"
    return described, tuple(with_location(finding, (str(path), {})) for finding in findings)


def describe_table(path: Path) -> str:
    """Describe an ECSV table: a star catalog if its header has a column `hip`, else an LED map."""
    from skysim.core.yaml_reader import read_limited
    from skysim.sources import catalog
    from skysim.tracking import dome_map_file

    if "{name: hip," in read_limited(path, catalog.MAX_BYTES)[:4000]:
        return f"a catalog of {len(catalog.read(path).hip)} stars"
    return f"a map of {len(dome_map_file.read_dome_map(path).id)} LEDs"


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
    with contextlib.ExitStack() as stack:
        sheet = cells.measure(
            scene,
            loaded,
            LOADED[-1][1],
            folder,
            quick=quick,
            fields=fields,
            least=cells.MODEL_FIELDS if model else cells.MIN_FIELDS,
            rates_deg_s=[] if rates is None else parse_rates(rates),
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
    table = Table(["fitted to", *columns], rows)
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


SPANS_S = {"orbit": None, "day": DAY_S, "year": JULIAN_YEAR_DAY * DAY_S}


def availability(
    scene: SceneArg,
    law: Literal["inertial", "zenith"] = "inertial",
    off_deg: float = 0.0,
    around_deg: float = 0.0,
    span: Literal["orbit", "day", "year"] = "orbit",
    samples: Annotated[int, Option(min=10, max=10_000_000)] = 20_000,
    overrides: Overrides = None,
    picture: Path | None = None,
    json: Json = False,
) -> None:
    """Fraction of an orbit or a year in which the tracker is outside its exclusion angles and sees enough stars.

    Parameters
    ----------
    law
        inertial: toward motion.start; zenith: at --off-deg from it.
    off_deg
        Angle of the boresight from the zenith, 180 is nadir.
    around_deg
        Its azimuth from the flight direction, left positive.
    span
        From the scene's start_time.
    samples
        Times that are computed.
    picture
        Also write a picture (.png) of the angles over time.
    """
    import numpy as np

    config = load(scene, overrides)
    exclusion = config.orbit.exclusion if config.orbit else None
    if exclusion is None:
        raise InputError(
            "orbit.exclusion",
            "the scene has none",
            "a scene with a section orbit with exclusion",
        )
    if law == "inertial" and (off_deg or around_deg):
        raise InputError(
            "--off-deg, --around-deg", "have no effect with --law inertial", "--law zenith"
        )
    pointing = pointing_of(config, law, off_deg, around_deg)
    with progress_callback("availability") as watch:
        found = computed(config, pointing, SPANS_S[span], samples, watch)
    outside = found.outside(exclusion)
    available = np.all(list(outside.values()), axis=0)
    holds = outside | {"all": available}
    fractions = {name: float(times.mean()) for name, times in holds.items()}
    if picture is not None:
        write_picture(picture, found, exclusion, available)
    if json:
        print_json(
            {"span": span, "law": law, "samples": len(found.t_s), "fractions": fractions}
        )
    else:
        title = f"{config.name}: {span} of {found.t_s[-1] / HOUR_S:.4g} h"
        print_table(fraction_table(fractions, exclusion), title)


def fraction_table(fractions: dict[str, float], exclusion: ExclusionConfig) -> Table:
    """The conditions with the fraction of time at which each holds."""
    conditions = {
        "Sun": f"more than {exclusion.sun_deg:g}° away",
        "Earth": f"more than {exclusion.earth_deg:g}° away",
        "Moon": f"more than {exclusion.moon_deg:g}° away",
        "stars": f"at least {exclusion.stars}",
        "all": "available",
    }
    rows = [
        [name, condition, f"{100 * fractions[name]:.2f} %"]
        for name, condition in conditions.items()
    ]
    columns = ["", Column("condition"), Column("fraction of time")]
    return Table(columns, rows)


def pointing_of(scene: Scene, law: str, off_deg: float, around_deg: float) -> Pointing:
    """The boresight's attitude law. Raises InputError for an inertial one without a direction."""
    import numpy as np

    from skysim.scene.sections.motion import PointingConfig
    from skysim.sources.camera_orbit import Pointing
    from skysim.sources.stars import directions

    start = scene.motion.start
    if law == "zenith":
        return Pointing(
            "zenith", np.zeros(3), math.radians(off_deg), math.radians(around_deg)
        )
    if not isinstance(start, PointingConfig):
        raise InputError("--law inertial", "requires motion.start with ra_deg and dec_deg")
    return Pointing("inertial", directions(start.ra_deg, start.dec_deg))


def computed(
    scene: Scene, pointing: Pointing, span_s: float | None, samples: int, watch: Any
) -> SkySamples:
    """The angles over the span; without one, over one revolution."""
    import numpy as np

    from skysim.sources import camera_orbit, catalog, stars

    orbit = camera_orbit.build_orbit(scene.orbit, scene.start_time)
    assert orbit is not None
    if span_s is None:
        first = orbit.states(np.zeros(1))
        energy = np.sum(first.velocity_m_s**2) / 2 - EARTH_MU_M3_S2 / np.linalg.norm(
            first.position_m
        )
        if energy >= 0:
            raise InputError("--span orbit", "this orbit is not closed", "day, year")
        span_s = float(2 * np.pi * EARTH_MU_M3_S2 / (-2 * energy) ** 1.5)
    t_s = np.asarray((np.arange(samples) + 0.5) * (span_s / samples), float)
    known = catalog.read_for("tracker.catalog", scene.tracker.catalog).to_limit(
        scene.tracker.limit_mag
    )
    camera = scene.camera
    area_px = camera.width_px * camera.height_px
    field_rad = math.atan(math.sqrt(area_px / math.pi) / camera.focal_px)
    return camera_orbit.sample(
        orbit,
        scene.start_time,
        t_s,
        pointing,
        stars.apparent(known, scene.start_time),
        field_rad,
        watch,
    )


def write_picture(
    path: Path, found: SkySamples, exclusion: ExclusionConfig, available: Bools
) -> None:
    """The angles over time with their limits, and the times at which the tracker is available."""
    from skysim.core.files import write_bytes
    from skysim.results.plots import INK, png

    hours = found.t_s / HOUR_S
    curves = (
        ("Sun", found.sun_deg, exclusion.sun_deg),
        ("Earth's limb", found.earth_deg, exclusion.earth_deg),
        ("Moon", found.moon_deg, exclusion.moon_deg),
    )

    def draw(fig: Any) -> None:
        axes = fig.subplots()
        for color, (name, angle_deg, limit_deg) in zip(INK, curves, strict=False):
            axes.plot(hours, angle_deg, color=color, label=name)
            axes.axhline(limit_deg, color=color, linestyle=":", linewidth=0.8)
        axes.fill_between(
            hours,
            0,
            1,
            where=available,
            transform=axes.get_xaxis_transform(),
            color="#009e73",
            alpha=0.15,
        )
        axes.set(xlabel="time [h]", ylabel="angle from the boresight [deg]")
        axes.legend()

    write_bytes(path, png(draw, (7, 3.2)))
