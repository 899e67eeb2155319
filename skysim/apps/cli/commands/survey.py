"""Command `skysim survey`: plan the survey of a dome, simulate it, or make it from images."""

from __future__ import annotations

import shlex
import sys
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from dataclasses import asdict, dataclass, replace
from enum import StrEnum
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from skysim.apps.cli import terminal
from skysim.apps.cli.options import Json, Out, Overrides, SceneArg, Seed, load, output_folder
from skysim.apps.cli.terminal import print_error, print_json, progress, progress_callback
from skysim.core.errors import InputError
from skysim.results.report import print_blocks, print_wrapped

if TYPE_CHECKING:
    from estimator.core.camera import Camera
    from estimator.trackers.pipeline import Settings
    from skysim.experiments.dome_survey.survey_findings import Coverage, SurveyRun
    from skysim.experiments.dome_survey.survey_frames import SurveyFrame
    from skysim.experiments.dome_survey.survey_images import SurveyImage
    from skysim.experiments.dome_survey.survey_prior import CalibrationPrior, SurveyUncertainty
    from skysim.experiments.dome_survey.survey_procedure import HeldAttitudes
    from skysim.scene.scene import Scene
    from skysim.simulation.lab import Lab


FRAMES = 150
NEXT = 12
CHECKS = 40


class Attitudes(StrEnum):
    """How the attitudes of a survey are chosen."""

    PLAN = "plan"
    RANDOM = "random"


@dataclass(frozen=True)
class Request:
    """What the command line asks for."""

    scene: Scene
    uncertainty: SurveyUncertainty
    folder: Path
    tilt_deg: float
    attitudes: str
    frames: int
    distortion: bool
    next_stops: int
    quiet: bool  # print the result alone


FrameCount = Annotated[
    int | None,
    typer.Option(
        min=2,
        help=f"Number of attitudes, with one frame at each; of images with --watch. Default: {FRAMES}.",
    ),
]
PlanOnly = Annotated[
    bool,
    typer.Option(
        "--plan", help="Print the attitudes to hold and the predicted errors; simulate nothing."
    ),
]
Images = Annotated[
    Path | None,
    typer.Option(
        help="Survey from the images of a folder, with the IMU's attitudes in its attitudes.csv if any."
    ),
]
CameraFile = Annotated[
    Path | None,
    typer.Option(
        help="Camera of the images: a scene (file or name), camera file or OpenCV calibration."
    ),
]
Watch = Annotated[
    bool,
    typer.Option(
        "--watch",
        help="With --images: follow the folder while the images are taken, and print which LEDs are measured and which"
        " attitudes to hold next; after the last one, or Ctrl-C, survey.",
    ),
]
Repeat = Annotated[
    int | None,
    typer.Option(
        min=2, help="Simulate so many surveys, and compare their errors with the prediction."
    ),
]
AttitudesBy = Annotated[
    Attitudes | None, typer.Option(help="Attitudes: by the plan (default), or random.")
]
Next = Annotated[
    int | None,
    typer.Option("--next", min=1, help=f"Number of attitudes to propose next; default: {NEXT}."),
]
FramesTo = Annotated[
    Path | None,
    typer.Option(help="Write the simulated frames and attitudes to a folder, for --images."),
]
Tilt = Annotated[float, typer.Option(help="Maximum tilt of the attitudes, degrees.")]
ImuSigma = Annotated[
    str, typer.Option(help="Standard error of the IMU's attitude about each axis.")
]
LedSigma = Annotated[
    str, typer.Option(help="Standard error of an LED's assumed position along each axis.")
]
LeverSigma = Annotated[str, typer.Option(help="Standard error of the camera's assumed position.")]
FocalError = Annotated[str, typer.Option(help="Error of the assumed focal length.")]
Distortion = Annotated[
    bool, typer.Option("--distortion", help="Also fit the distortion k1, k2, p1, p2.")
]
Checks = Annotated[
    int | None,
    typer.Option(
        min=1,
        help=f"Further attitudes at which the tracker is tested before and after; default: {CHECKS}.",
    ),
]


def survey(
    scene: SceneArg,
    frames: FrameCount = None,
    plan: PlanOnly = False,
    images: Images = None,
    camera: CameraFile = None,
    watch: Watch = False,
    repeat: Repeat = None,
    attitudes: AttitudesBy = None,
    next_: Next = None,
    frames_to: FramesTo = None,
    seed: Seed = None,
    out: Out = None,
    set_: Overrides = None,
    tilt: Tilt = 25.0,
    imu_sigma: ImuSigma = "0.5 deg",
    led_sigma: LedSigma = "2 mm",
    lever_sigma: LeverSigma = "5 mm",
    focal_error: FocalError = "1%",
    distortion: Distortion = False,
    checks: Checks = None,
    json: Json = False,
) -> None:
    """Survey a dome from frames at many attitudes: LED positions, lever arm and lens, to a file for `tracker.map`.

    It says which attitudes to hold, what they will reach, which LEDs are measured, and which are dark, displaced or
    exchanged.
    """
    from skysim.experiments.dome_survey.survey_prior import survey_uncertainty

    given = {
        "frames": frames,
        "attitudes": attitudes,
        "next": next_,
        "frames-to": frames_to,
        "checks": checks,
    }
    chosen = {name for name, value in given.items() if value is not None}
    mode = survey_mode(plan, images, camera, watch, repeat, chosen)
    loaded = load(scene, None, seed, set_)
    uncertainty = survey_uncertainty(imu_sigma, led_sigma, lever_sigma, focal_error)
    folder = output_folder(out, loaded.name)
    by = (attitudes or Attitudes.PLAN).value
    request = Request(
        loaded, uncertainty, folder, tilt, by, frames or FRAMES, distortion, next_ or NEXT, json
    )
    if images is not None and camera is not None:
        statistics = from_images(request, images, camera, watch)
    elif plan:
        statistics = plan_only(request)
    elif repeat:
        statistics = repeated(request, repeat)
    else:
        statistics = simulated(request, checks or CHECKS, frames_to)
    if json:
        print_json(statistics)
    elif mode in terminal.PRINTERS:
        terminal.PRINTERS[mode](statistics)


# What each mode of the command does not use.
UNUSED = {
    "images": ("frames", "attitudes", "frames-to", "checks"),
    "watch": ("attitudes", "frames-to", "checks"),
    "plan": ("next", "frames-to", "checks"),
    "repeat": ("next", "frames-to", "checks"),
    "simulate": (),
}


def survey_mode(
    plan: bool,
    images: Path | None,
    camera: Path | None,
    watch: bool,
    repeat: int | None,
    given: set[str],
) -> str:
    """The mode that the options choose. Raises InputError for options that exclude one another or have no effect."""
    modes = [name for name, on in (("images", images), ("plan", plan), ("repeat", repeat)) if on]
    if len(modes) > 1:
        raise InputError(f"--{modes[1]}", f"has no effect with --{modes[0]}", "one of them")
    if images is not None and camera is None:
        raise InputError(
            "--images",
            "no camera",
            "with --camera FILE, a scene, camera file or OpenCV calibration",
        )
    if camera is not None and images is None:
        raise InputError("--camera", "has no effect without --images", "the scene's camera is used")
    if watch and images is None:
        raise InputError("--watch", "has no effect without --images", "with --images FOLDER")
    mode = "watch" if watch else modes[0] if modes else "simulate"
    for name in UNUSED[mode]:
        if name in given:
            raise InputError(f"--{name}", f"has no effect with --{mode}", "none")
    return mode


def planned(request: Request) -> tuple[Lab, CalibrationPrior, HeldAttitudes]:
    """The lab with the onboard model before a survey, whose errors are drawn, that model, and a plan."""
    from skysim.experiments.dome_survey import survey_procedure

    return survey_procedure.plan_survey(
        request.scene, request.uncertainty, request.frames, request.tilt_deg, request.attitudes
    )


def plan_only(request: Request) -> dict[str, Any]:
    """The attitudes of a plan and the errors predicted."""
    from skysim.core import files
    from skysim.experiments.dome_survey import survey_findings, survey_procedure

    _, _, plan = planned(request)
    path = files.make_folder(request.folder) / "plan.csv"
    survey_procedure.write_plan(path, plan)
    return {
        "scene": request.scene.name,
        "attitudes": survey_findings.stop_rows(plan.lab_from_body, plan.shown),
        "leds": plan.shown.shape[1],
        "noise_px": plan.model.sigma_px,
        "predicted": [
            {"frames": n, **survey_findings.accuracy_statistics(one)} for n, one in plan.steps()
        ],
        "plan": str(path),
    }


def repeated(request: Request, repeat: int) -> dict[str, Any]:
    """The errors predicted and those of simulated surveys, side by side."""
    from skysim.experiments.dome_survey import survey_procedure

    lab, _, plan = planned(request)
    surveys = survey_procedure.repeat_survey(lab, request.uncertainty, plan, repeat)
    results = list(progress(surveys, repeat, "surveys"))
    errors = [one for one in results if isinstance(one, survey_procedure.SimulatedErrors)]
    failures = [one for one in results if isinstance(one, InputError)]
    if not errors:
        raise failures[0]
    return {
        "scene": request.scene.name,
        "frames": len(plan.shown),
        "surveys": repeat,
        "rows": survey_procedure.comparison(plan, errors),
        "measured": [one.measured for one in errors],
        "false_alarms": sum(one.false_alarms for one in errors),
        "failures": [str(one) for one in failures],
    }


def simulated(request: Request, checks: int, frames_to: Path | None) -> dict[str, Any]:
    """A simulated survey, compared with the truth."""
    from skysim.experiments.dome_survey import (
        adjust,
        survey_findings,
        survey_frames,
        survey_prior,
        survey_procedure,
    )
    from skysim.experiments.dome_survey import survey_report as report
    from skysim.simulation.lab import build_tracker
    from skysim.tracking import factory

    lab, before, plan = planned(request)
    uncertainty = request.uncertainty
    first_tracker = build_tracker(lab.camera)
    taken = survey_procedure.simulated_frames(lab, uncertainty, plan.lab_from_body, frames_to)
    observations = list(progress(taken, len(plan.shown), "rendering"))
    with (
        progress_callback("adjusting") as update,
        coverage_shown(request, observations, before, plan.model.sigma_px),
    ):
        run = adjust.run_survey(observations, before, uncertainty, request.distortion, update)
    statistics = write_results(request, run, before, lab)
    tracker = factory.build_tracker(
        survey_prior.with_map(lab.scene, statistics["map"]), lab.camera.mount, lab.camera.sources
    )
    tests = survey_frames.render_stops(
        lab,
        survey_frames.stop_attitudes(lab.scene, "checks", checks, request.tilt_deg),
        len(plan.shown),
    )
    statistics |= report.truth_statistics(run, before, lab)
    statistics |= report.compare_trackers(
        {"before": first_tracker, "after": tracker}, progress(tests, checks, "comparing")
    )
    return write_report(
        request,
        run,
        statistics
        | {
            "frames": len(plan.shown),
            "predicted": survey_findings.accuracy_statistics(plan.first(len(plan.shown))),
        },
    )


def from_images(request: Request, images: Path, camera_file: Path, watch: bool) -> dict[str, Any]:
    """A survey from the images of a folder, with the LEDs of the scene as the list before it."""
    from skysim.experiments.dome_survey import survey_images, survey_prior, survey_procedure
    from skysim.simulation.lab import build_lab
    from skysim.tracking import factory

    camera, gain_and_saturation = image_camera(camera_file)
    lab = build_lab(survey_prior.as_listed(request.scene))
    before = survey_prior.listed_prior(lab, camera)
    stages = factory.assumed_settings(lab.scene)
    if gain_and_saturation is not None:
        gain_e_dn, saturation = gain_and_saturation
        stages = replace(stages, gain_e_dn=gain_e_dn, saturation=saturation)
    if watch:
        pictures = followed(request, images, before, stages)
    else:
        total = len(survey_images.image_files(images))
        pictures = list(
            progress(survey_images.read_images(images, camera, stages), total, "reading")
        )
    found = survey_images.frames_with_attitude(pictures, before, request.uncertainty, stages)
    with progress_callback("adjusting") as update, coverage_shown(request, found, before, None):
        run = survey_procedure.survey_images(
            pictures, found, before, request.uncertainty, stages, request.distortion, update
        )
    return write_report(
        request, run, write_results(request, run, before, None) | {"frames": len(pictures)}
    )


def followed(
    request: Request, images: Path, before: CalibrationPrior, stages: Settings
) -> list[SurveyImage]:
    """The images of a folder while they are taken, until there are enough or Ctrl-C; prints the coverage so far."""
    from skysim.experiments.dome_survey.survey_images import WatchedFolder

    watched = WatchedFolder(images, before.camera, stages)
    with suppress(KeyboardInterrupt):
        for news in watched.arrivals(request.frames):
            for complaint in news.complaints:
                print_error(str(complaint))
            if news.read and not request.quiet:
                print_so_far(request, watched.pictures, before, stages)
    return watched.pictures


def print_so_far(
    request: Request, pictures: list[SurveyImage], before: CalibrationPrior, stages: Settings
) -> None:
    """Print how many images there are, which LEDs they measure, and the attitudes to hold next."""
    from skysim.experiments.dome_survey import survey_findings
    from skysim.experiments.dome_survey.survey_images import frames_with_attitude
    from skysim.experiments.dome_survey.survey_report import coverage_blocks

    found = frames_with_attitude(pictures, before, request.uncertainty, stages)
    print(f"{len(pictures)} of {request.frames} images, {len(found)} with an attitude")
    if found:
        so_far = survey_findings.coverage_before(
            found, before, request.uncertainty, before.floor_px
        )
        print_blocks(coverage_blocks(with_next(request, so_far, before)))


def image_camera(path: Path) -> tuple[Camera, tuple[float, float] | None]:
    """The camera of a file, and its gain (e-/DN) and saturation (DN) if the file has them. Raises InputError."""
    from estimator.core.camera import Camera
    from skysim.apps.plate_solver.solver import read_camera
    from skysim.tracking.onboard_model import calibration

    config, lens, stages = read_camera(path)
    if config is not None:
        return calibration(config), (stages.gain_e_dn, stages.saturation)
    assert lens is not None
    return Camera(
        lens.width_px, lens.height_px, lens.focal_px, lens.center_px, lens.distortion
    ), None


@contextmanager
def coverage_shown(
    request: Request, frames: list[SurveyFrame], prior: CalibrationPrior, noise_px: float | None
) -> Iterator[None]:
    """Print which LEDs the frames show, and the attitudes to hold next, if they are too few for a survey."""
    from skysim.experiments.dome_survey import survey_findings
    from skysim.experiments.dome_survey.survey_report import coverage_blocks

    try:
        yield
    except InputError:
        if frames:
            so_far = survey_findings.coverage_before(
                frames, prior, request.uncertainty, noise_px or prior.floor_px
            )
            print_blocks(coverage_blocks(with_next(request, so_far, prior)))
        raise


def with_next(request: Request, so_far: Coverage, prior: CalibrationPrior) -> dict[str, Any]:
    """Statistics of a coverage with the attitudes to hold next, and what they will reach."""
    from skysim.experiments.dome_survey import survey_findings
    from skysim.experiments.dome_survey.survey_prior import image_sizes

    margin_px = image_sizes(prior).margin_px
    further = survey_findings.next_stops(
        request.scene, so_far, margin_px, request.next_stops, request.tilt_deg
    )
    shown = so_far.model.visible(further.lab_from_body.inv(), margin_px)
    return {
        "coverage": survey_findings.coverage_statistics(so_far),
        "next": survey_findings.stop_rows(further.lab_from_body, shown),
        "next_reaches": survey_findings.accuracy_statistics(further.accuracy),
    }


def write_results(
    request: Request, run: SurveyRun, before: CalibrationPrior, lab: Lab | None
) -> dict[str, Any]:
    """Write map and picture of a survey, and return its statistics; a simulated one is drawn with its errors."""
    from skysim.core import files
    from skysim.experiments.dome_survey import adjust, survey_findings, survey_frames
    from skysim.experiments.dome_survey import survey_report as report
    from skysim.tracking import dome_map_file

    folder = files.make_folder(request.folder)
    path = folder / "leds.ecsv"
    picture = folder / "survey.png"
    dome_map_file.write_dome_map(path, adjust.dome_map(run.survey, request.uncertainty))
    so_far = survey_findings.coverage(run)
    faults = survey_findings.find_faults(run)
    statistics = report.survey_statistics(run, before) | with_next(request, so_far, before)
    statistics |= {
        "scene": request.scene.name,
        "faults": asdict(faults),
        "map": str(path),
        "picture": str(picture),
    }
    further = survey_frames.from_rows(statistics["next"])
    errors = report.led_errors(run.survey, before, lab) if lab else None
    files.write_image(
        picture, report.survey_figure(so_far, faults, further, errors, report.list_shifts(run))
    )
    return statistics


def write_report(request: Request, run: SurveyRun, statistics: dict[str, Any]) -> dict[str, Any]:
    """Write a survey's statistics as JSON, and its report, which is printed too; return them with the report's path."""
    from skysim.core import files
    from skysim.experiments.dome_survey.survey_report import survey_report

    path = request.folder / "report.html"
    statistics |= {"report": str(path)}
    report = survey_report(statistics, run, shlex.join(["skysim", *sys.argv[1:]]))
    report.save(path)
    files.write_text(request.folder / "survey.json", files.to_json(statistics))
    if not request.quiet:
        report.print()
        print_wrapped(f"{statistics['map']}: for tracker.map; report: {path}")
    return statistics
