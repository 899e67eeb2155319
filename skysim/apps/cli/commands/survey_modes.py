"""The modes of `skysim survey`: plan, repeat, simulate, and survey from images."""

from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager, suppress
from dataclasses import replace
from pathlib import Path

from estimator.trackers.pipeline import Settings
from skysim.apps.cli.options import command_line
from skysim.apps.cli.terminal import print_error, progress, progress_callback
from skysim.apps.plate_solver import read_camera
from skysim.core import files
from skysim.core.errors import InputError
from skysim.core.types import Record, frozen
from skysim.experiments.dome_survey import (
    adjust,
    survey_findings,
    survey_frames,
    survey_procedure,
    survey_report,
)
from skysim.experiments.dome_survey.survey_findings import Coverage, SurveyRun
from skysim.experiments.dome_survey.survey_frames import (
    CalibrationPrior,
    SurveyFrame,
    SurveyUncertainty,
)
from skysim.results.report import (
    Column,
    Table,
    print_blocks,
    print_table,
    print_wrapped,
)
from skysim.scene.scene import Scene
from skysim.simulation.lab import Lab, build_lab, build_tracker
from skysim.tracking import dome_map_file, factory

SHOWN_STOPS = 12  # number of attitudes of a plan that are printed; the file has all


@frozen
class Request:
    """The options of the command line."""

    scene: Scene
    uncertainty: SurveyUncertainty
    folder: Path
    tilt_deg: float
    attitudes: str
    frames: int
    next_stops: int
    quiet: bool  # print the result alone


def planned(request: Request) -> tuple[Lab, CalibrationPrior, survey_procedure.HeldAttitudes]:
    """The lab whose onboard model has errors as before a survey, that model, and a plan; print these errors."""

    if not request.quiet:
        print_wrapped(survey_frames.before_text(request.scene, request.uncertainty))
    return survey_procedure.plan_survey(
        request.scene,
        request.uncertainty,
        request.frames,
        request.tilt_deg,
        request.attitudes,
    )


def plan_only(request: Request) -> Record:
    """Return the attitudes of a plan and the predicted errors; print them."""

    _, _, plan = planned(request)
    path = files.make_folder(request.folder) / "plan.csv"
    survey_procedure.write_plan(path, plan)
    result: Record = {
        "scene": request.scene.name,
        "attitudes": survey_findings.stop_rows(plan.lab_from_body, plan.shown),
        "leds": plan.shown.shape[1],
        "noise_px": plan.model.sigma_px,
        "predicted": [
            {"frames": n, **survey_findings.accuracy_statistics(one)} | plan.counts(n)
            for n, one in plan.steps()
        ],
        "out_of_reach": int((~plan.in_reach).sum()),
        "tilt_deg": request.tilt_deg,
        "plan": str(path),
    }
    if request.quiet:
        return result
    print_table(survey_report.stop_table(result["attitudes"][:SHOWN_STOPS]))
    if len(result["attitudes"]) > SHOWN_STOPS:
        print(f"... {len(result['attitudes'])} attitudes in all, in {result['plan']}")
    print()
    heads = ("LED place mm", "lever mm", "focal length px")
    columns = [
        Column("frames"),
        "LEDs measured",
        *(Column(head, format=".3g") for head in heads),
    ]
    keys = ("led_mm", "lever_mm", "focal_px")
    rows = [
        [
            row["frames"],
            "{} ({} to {})".format(row["measured"], *row["measured_range"]),
            *(row[key] for key in keys),
        ]
        for row in result["predicted"]
    ]
    table = Table(columns, rows)
    print_table(
        table,
        f"predicted errors (1σ) of {result['leds']} LEDs, centroids to {result['noise_px']:.2g} px",
    )
    print_wrapped(
        f"{result['out_of_reach']} of {result['leds']} LEDs are out of reach of a tilt of {result['tilt_deg']:g}°"
    )
    return result


def repeated(request: Request, repeat: int) -> Record:
    """Return the predicted errors beside those of simulated surveys; print them."""

    lab, _, plan = planned(request)
    surveys = survey_procedure.repeat_survey(lab, request.uncertainty, plan, repeat)
    results = list(progress(surveys, repeat, "surveys"))
    errors = [one for one in results if isinstance(one, survey_procedure.SimulatedErrors)]
    failures = [one for one in results if isinstance(one, InputError)]
    if not errors:
        raise failures[0]
    result: Record = {
        "scene": request.scene.name,
        "frames": len(plan.shown),
        "surveys": repeat,
        "rows": survey_procedure.comparison(plan, errors),
        "measured": [one.measured for one in errors],
        "false_alarms": sum(one.false_alarms for one in errors),
        "failures": [str(one) for one in failures],
    }
    if request.quiet:
        return result
    columns = [
        "what",
        Column("predicted", format=".3g"),
        Column("simulated", format=".3g"),
        Column("ratio"),
    ]
    rows = []
    for row in result["rows"]:
        ratio = row["ratio"] and f"{row['ratio']:.2f} ± {row['ratio_sigma']:.2f}"
        rows.append([row["what"], row["predicted"], row["simulated"], ratio])
    print_table(Table(columns, rows))
    print_wrapped(
        f"{len(result['measured'])} surveys of {result['frames']} frames, {min(result['measured'])} to"
        f" {max(result['measured'])} LEDs measured; {result['false_alarms']} faults reported, of none"
    )
    for failure in result["failures"]:
        print_wrapped(f"one more survey failed: {failure}")
    return result


def simulated(request: Request, checks: int, frames_to: Path | None) -> Record:
    """A simulated survey, compared with the truth."""

    lab, before, plan = planned(request)
    first_tracker = build_tracker(lab.camera)
    taken = survey_procedure.simulated_frames(
        lab, request.uncertainty, plan.lab_from_body, frames_to
    )
    observations = list(progress(taken, len(plan.shown), "rendering"))
    with adjusting(request, observations, before, plan.model.sigma_px) as update:
        run = adjust.run_survey(observations, before, update)
    names = survey_procedure.frame_names(len(observations))
    statistics = write_results(request, run, before, lab, names)
    tracker = factory.build_tracker(
        survey_frames.with_map(lab.scene, statistics["map"]),
        lab.camera.mount,
        lab.camera.sources,
    )
    tests = survey_frames.render_stops(
        lab,
        survey_frames.stop_attitudes(lab.scene, "checks", checks, request.tilt_deg),
        len(plan.shown),
    )
    statistics |= survey_report.truth_statistics(run, before, lab)
    statistics |= survey_report.compare_trackers(
        {"before": first_tracker, "after": tracker}, progress(tests, checks, "comparing")
    )
    count = len(plan.shown)
    predicted = survey_findings.accuracy_statistics(plan.first(count))
    return write_report(request, run, statistics | {"frames": count, "predicted": predicted})


def from_images(request: Request, images: Path, camera_file: Path, watch: bool) -> Record:
    """A survey from the images of a folder; the LEDs of the scene are the list before the survey."""

    known, read = read_camera(camera_file)
    camera = known.model
    lab = build_lab(survey_frames.as_listed(request.scene))
    before = survey_frames.listed_prior(lab, camera)._replace(uncertainty=request.uncertainty)
    stages = factory.assumed_settings(lab.scene)
    if known.detector:
        stages = replace(stages, gain_e_dn=read.gain_e_dn, saturation=read.saturation)
    if watch:
        pictures = followed(request, images, before, stages)
    else:
        total = len(survey_procedure.image_files(images))
        pictures = list(
            progress(survey_procedure.read_images(images, camera, stages), total, "reading")
        )
    found = survey_procedure.frames_with_attitude(pictures, before, stages)
    with adjusting(request, found, before, None) as update:
        run = survey_procedure.survey_images(pictures, found, before, stages, update)
    names = [picture.name for picture in pictures]
    statistics = write_results(request, run, before, None, names)
    return write_report(request, run, statistics | {"frames": len(pictures)})


def followed(
    request: Request, images: Path, before: CalibrationPrior, stages: Settings
) -> list[survey_procedure.SurveyImage]:
    """The images of a folder, read while they are taken, until there are enough or Ctrl-C; print the coverage."""

    watched = survey_procedure.WatchedFolder(images, before.camera, stages)
    with suppress(KeyboardInterrupt):
        for news in watched.arrivals(request.frames):
            for complaint in news.complaints:
                print_error(str(complaint))
            if news.read and not request.quiet:
                pictures = watched.pictures
                found = survey_procedure.frames_with_attitude(pictures, before, stages)
                print(
                    f"{len(pictures)} of {request.frames} images, {len(found)} with an attitude"
                )
                if found:
                    print_coverage(request, found, before, None)
    return watched.pictures


@contextmanager
def adjusting(
    request: Request,
    frames: list[SurveyFrame],
    prior: CalibrationPrior,
    noise_px: float | None,
) -> Iterator[Callable[[float, float], None]]:
    """Show progress; if the frames are too few, print the LEDs that they show and the attitudes to hold next."""

    try:
        with progress_callback("adjusting") as update:
            yield update
    except InputError:
        if frames:
            print_coverage(request, frames, prior, noise_px)
        raise


def print_coverage(
    request: Request,
    frames: list[SurveyFrame],
    prior: CalibrationPrior,
    noise_px: float | None,
) -> None:
    """Print the LEDs that the frames show, and the attitudes to hold next."""
    so_far = survey_findings.coverage_before(frames, prior, noise_px or prior.floor_px)
    print_blocks(survey_report.coverage_blocks(with_next(request, so_far, prior)))


def with_next(request: Request, so_far: Coverage, prior: CalibrationPrior) -> Record:
    """Statistics of a coverage, with the attitudes to hold next and the accuracy predicted with them."""

    further = survey_findings.next_stops(
        request.scene, so_far, prior.margin_px, request.next_stops, request.tilt_deg
    )
    return {
        "coverage": survey_findings.coverage_statistics(so_far),
        "next": survey_findings.stop_rows(further.lab_from_body, further.shown),
        "next_reaches": survey_findings.accuracy_statistics(further.accuracy),
    }


def write_results(
    request: Request,
    run: SurveyRun,
    before: CalibrationPrior,
    lab: Lab | None,
    names: Sequence[str],
) -> Record:
    """Write map, attitudes and picture of a survey of images of these names, and return its statistics.

    The picture of a simulated one shows its errors.
    """

    folder = files.make_folder(request.folder)
    path = folder / "leds.ecsv"
    picture = folder / "survey.png"
    dome_map_file.write_dome_map(path, adjust.dome_map(run))
    so_far = survey_findings.coverage(run)
    faults = survey_findings.find_faults(run)
    statistics = survey_report.survey_statistics(run, before) | with_next(
        request, so_far, before
    )
    statistics |= {
        "scene": request.scene.name,
        "faults": faults,
        "attitudes": survey_findings.attitude_rows(run, names),
        "map": str(path),
        "picture": str(picture),
    }
    survey_procedure.write_solved(folder / survey_report.SOLVED, statistics["attitudes"])
    further = survey_frames.from_rows(statistics["next"])
    errors = survey_report.led_errors(run.survey, before, lab) if lab else None
    files.write_bytes(
        picture, survey_report.survey_figure(so_far, faults, further, errors, run)
    )
    return statistics


def write_report(request: Request, run: SurveyRun, statistics: Record) -> Record:
    """Write a survey's statistics as JSON, write and print its report; return the statistics with the report's path."""

    path = request.folder / "report.html"
    statistics |= {"report": str(path)}
    report = survey_report.survey_report(statistics, run, command_line())
    report.save(path)
    files.write_json(request.folder / "survey.json", statistics)
    if not request.quiet:
        report.print()
        print(
            f"report: {path}\nthe map in a scene, in place of any tracker.survey of its base:"
        )
        print(f"tracker: {{map: {statistics['map']}}}")
    return statistics


# Terminal output of `--plan` and `--repeat`: the attitudes to hold, predicted and simulated errors.
