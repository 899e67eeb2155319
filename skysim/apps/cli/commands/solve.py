"""`skysim solve`, `survey`."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from skysim.apps.cli.options import (
    Centroider,
    Detector,
    Identifier,
    Json,
    Out,
    SceneArg,
    Seed,
    Sets,
    SolverName,
    given_stages,
    load,
    moment,
)
from skysim.apps.cli.terminal import print_answers, print_error, print_survey, progress, progress_callback
from skysim.core.errors import InputError

if TYPE_CHECKING:
    from typing import Any

    from numpy.typing import NDArray


def solve(
    images: Annotated[
        list[Path] | None, typer.Argument(metavar="IMAGES", help="FITS, PNG, TIFF, JPEG or BMP files.")
    ] = None,
    fov: Annotated[
        float | None,
        typer.Option(help="Horizontal field of view in degrees, to 5 %; 5 to 40 are tried if left out."),
    ] = None,
    camera: Annotated[
        Path | None,
        typer.Option(
            help="The scene (a file or a name in scenes/) or camera file that made them, or OpenCV's calibration."
        ),
    ] = None,
    live: Annotated[
        str | None,
        typer.Option(help="Also a frame of a live camera: its index, a video file or an address."),
    ] = None,
    time: Annotated[
        str | None, typer.Option(help="UTC of the pictures, 1900 to 2100, e.g. 2012-06-22T21:00:00.")
    ] = None,
    detector: Detector = None,
    centroider: Centroider = None,
    identifier: Identifier = None,
    solver: SolverName = None,
    out: Annotated[Path, typer.Option(help="Folder for the annotated pictures.")] = Path("out/solve"),
    json: Json = False,
) -> None:
    """Solve the attitude of sky images, lost in space; uncertain matches are rejected.

    Exit code 0 if all images could be read, solved or not; 2 otherwise.
    """
    from skysim.apps import plate_solver as solving
    from skysim.core import files
    from skysim.core.images import grab
    from skysim.results.files import frames

    stages = given_stages(detector=detector, centroider=centroider, identifier=identifier, solver=solver)
    how = solving.make_solver(fov, camera, time_utc=moment(time), stages=stages)
    files.make_folder(out)
    paths = [*(images or ()), *([kept(grab(live), out / "live.png")] if live is not None else ())]
    if not paths:
        raise InputError("give images, or --live CAMERA")
    pictures = frames.unlike([out / f"{path.name}.solved.png" for path in paths])
    jobs = progress(list(zip(paths, pictures, strict=True)), len(paths), "solving", quiet=json)
    answers = [solving.solve(path, how, picture) for path, picture in jobs]
    faults = [answer["status"] for answer in answers if answer.pop("bad_input")]
    doubts = [doubt for answer in answers if (doubt := answer.pop("doubt"))]
    files.write_text(out / "solutions.json", files.to_json(answers))
    if json:
        print(files.to_json(answers))
    else:
        print_answers(answers, out)
    for fault in doubts + faults:
        print_error(fault)
    if faults:
        raise typer.Exit(2)


def kept(image: NDArray[Any], path: Path) -> Path:
    """Write a camera frame to a file and return its path."""
    from skysim.core import files

    files.write_image(path, image)
    return path


def survey(
    scene: SceneArg,
    frames: Annotated[int, typer.Option(min=2, help="How many stops; a frame at each.")] = 300,
    seed: Seed = None,
    out: Out = None,
    set_: Sets = None,
    tilt: Annotated[float, typer.Option(help="Stops lean up to so many degrees, to any side.")] = 25.0,
    imu_sigma: Annotated[str, typer.Option(help="Error of the IMU's attitude about each axis.")] = "0.5 deg",
    led_sigma: Annotated[str, typer.Option(help="Of an LED's believed place along each axis.")] = "2 mm",
    lever_sigma: Annotated[str, typer.Option(help="Error of the camera's believed place.")] = "5 mm",
    focal_error: Annotated[str, typer.Option(help="Of the believed focal length.")] = "1%",
    distortion: Annotated[bool, typer.Option("--distortion", help="Fit k1, k2, p1, p2 too.")] = False,
    checks: Annotated[int, typer.Option(min=1, help="New stops where the attitude is compared.")] = 40,
    json: Json = False,
) -> None:
    """Survey a dome from frames at many attitudes: LED positions, lever arm and lens, to a file for `tracker.map`."""
    from skysim.core import files
    from skysim.experiments import dome_survey, dome_survey_report
    from skysim.simulation import testbed
    from skysim.tracking import dome_map_file, factory

    doubt = dome_survey.doubt(imu_sigma, led_sigma, lever_sigma, focal_error)
    lab = testbed.build_testbed(dome_survey.with_survey_errors(load(scene, None, seed, set_), doubt))
    belief = dome_survey.belief_of(lab)
    before = testbed.tracker(lab)
    looks = list(progress(dome_survey.looks(lab, belief, doubt, frames, tilt), frames, "photographing"))
    with progress_callback("adjusting") as watch:
        found = dome_survey.surveyed(looks, belief, doubt, distortion, watch)
    folder = files.make_folder(out or Path("out") / lab.scene.name)
    path, picture = folder / "leds.ecsv", folder / "survey.png"
    dome_map_file.write_dome_map(path, dome_survey.dome_map(found, doubt))
    files.write_image(picture, dome_survey_report.figure(dome_survey_report.misplaced(found, belief, lab)))
    after = factory.tracker(dome_survey.with_map(lab.scene, str(path)), lab.mount, lab.sources)
    stops = dome_survey.frames(lab, dome_survey.attitudes(lab.scene, "checks", checks, tilt), frames)
    errors = dome_survey_report.checked(
        {"before": before, "after": after}, progress(stops, checks, "comparing")
    )
    figures = dome_survey_report.figures(found, belief, lab, doubt) | errors
    figures |= {"scene": lab.scene.name, "frames": frames, "map": str(path), "picture": str(picture)}
    print(files.to_json(figures)) if json else print_survey(figures)
