"""Commands `skysim solve` and `survey`."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from skysim.apps.cli.options import (
    Centroider,
    Detector,
    Identifier,
    Json,
    Out,
    Overrides,
    SceneArg,
    Seed,
    SolverName,
    datetime_from_iso,
    load,
    output_folder,
    selected_stages,
)
from skysim.apps.cli.terminal import print_error, print_json, print_solutions, print_survey, progress, progress_callback
from skysim.core.errors import InputError


def solve(
    images: Annotated[
        list[Path] | None,
        typer.Argument(metavar="IMAGES", help="FITS, PNG, TIFF, JPEG, BMP files, or folders."),
    ] = None,
    fov: Annotated[
        float | None,
        typer.Option(help="Horizontal field of view in degrees, to 5 %; default: EXIF's, then 2 to 100 are searched."),
    ] = None,
    camera: Annotated[
        Path | None,
        typer.Option(
            help="Camera of the images: a scene (file, or name in scenes/), camera file or OpenCV calibration."
        ),
    ] = None,
    live: Annotated[
        str | None, typer.Option(help="Also solve a frame of a live camera: its index, a video file or an address.")
    ] = None,
    time: Annotated[
        str | None, typer.Option(help="UTC at which the images were taken, 1900 to 2100, e.g. 2012-06-22T21:00:00.")
    ] = None,
    catalog: Annotated[
        str | None,
        typer.Option(help="Star catalog: a name in data/catalogs or a file; a deep one for fields of a few degrees."),
    ] = None,
    detector: Detector = None,
    centroider: Centroider = None,
    identifier: Identifier = None,
    solver: SolverName = None,
    out: Annotated[Path, typer.Option(help="Folder for the annotated images.")] = Path("out/solve"),
    json: Json = False,
) -> None:
    """Solve the attitude of sky images, lost in space; uncertain matches are rejected.

    Exit code 0 if all images could be read, solved or not; 2 otherwise.
    """
    import skysim.core.jit  # noqa: F401  # says so if numba has to compile
    from skysim.apps import plate_solver
    from skysim.core.io import files
    from skysim.core.io.images import grab_frame

    stages = selected_stages(detector=detector, centroider=centroider, identifier=identifier, solver=solver)
    settings = plate_solver.make_solver(fov, camera, datetime_from_iso(time), stages, catalog)
    files.make_folder(out)
    paths = plate_solver.pictures_in(images or ())
    if live is not None:
        paths.append(out / "live.png")
        files.write_image(paths[-1], grab_frame(live))
    if not paths:
        raise InputError("no images; give files, folders, or --live CAMERA")
    annotated = plate_solver.annotated_paths(out, paths)
    jobs = progress(list(zip(paths, annotated, strict=True)), len(paths), "solving", quiet=json or len(paths) == 1)
    results = [plate_solver.solve_file(path, settings, image) for path, image in jobs]
    errors = [result["status"] for result in results if result.pop("bad_input")]
    warnings = [warning for result in results if (warning := result.pop("warning"))]
    files.write_text(out / "solutions.json", files.to_json(results))
    if json:
        print_json(results)
    else:
        print_solutions(results, out)
    for message in warnings + errors:
        print_error(message)
    if errors:
        raise typer.Exit(2)


def survey(
    scene: SceneArg,
    frames: Annotated[int, typer.Option(min=2, help="Number of attitudes, with one frame at each.")] = 300,
    seed: Seed = None,
    out: Out = None,
    set_: Overrides = None,
    tilt: Annotated[float, typer.Option(help="Maximum tilt of the attitudes, degrees.")] = 25.0,
    imu_sigma: Annotated[str, typer.Option(help="Standard error of the IMU's attitude about each axis.")] = "0.5 deg",
    led_sigma: Annotated[
        str, typer.Option(help="Standard error of an LED's assumed position along each axis.")
    ] = "2 mm",
    lever_sigma: Annotated[str, typer.Option(help="Standard error of the camera's assumed position.")] = "5 mm",
    focal_error: Annotated[str, typer.Option(help="Error of the assumed focal length.")] = "1%",
    distortion: Annotated[bool, typer.Option("--distortion", help="Also fit the distortion k1, k2, p1, p2.")] = False,
    checks: Annotated[
        int, typer.Option(min=1, help="Number of further attitudes at which the tracker is tested before and after.")
    ] = 40,
    json: Json = False,
) -> None:
    """Survey a dome from frames at many attitudes: LED positions, lever arm and lens, to a file for `tracker.map`."""
    from skysim.core.io import files
    from skysim.experiments import dome_survey, dome_survey_report
    from skysim.simulation.testbed import build_testbed, build_tracker
    from skysim.tracking import dome_map_file, factory

    uncertainty = dome_survey.survey_uncertainty(imu_sigma, led_sigma, lever_sigma, focal_error)
    testbed = build_testbed(dome_survey.with_survey_errors(load(scene, None, seed, set_), uncertainty))
    prior = dome_survey.calibration_prior(testbed)
    before = build_tracker(testbed)
    stops = dome_survey.take_survey_frames(testbed, prior, uncertainty, frames, tilt)
    observations = list(progress(stops, frames, "rendering"))
    with progress_callback("adjusting") as update:
        result = dome_survey.run_survey(observations, prior, uncertainty, distortion, update)
    folder = files.make_folder(output_folder(out, testbed.scene.name))
    path, figure = folder / "leds.ecsv", folder / "survey.png"
    dome_map_file.write_dome_map(path, dome_survey.dome_map(result, uncertainty))
    files.write_image(
        figure, dome_survey_report.led_error_figure(dome_survey_report.led_errors(result, prior, testbed))
    )
    after = factory.build_tracker(dome_survey.with_map(testbed.scene, str(path)), testbed.mount, testbed.sources)
    tests = dome_survey.render_stops(testbed, dome_survey.stop_attitudes(testbed.scene, "checks", checks, tilt), frames)
    errors = dome_survey_report.compare_trackers(
        {"before": before, "after": after}, progress(tests, checks, "comparing")
    )
    statistics = dome_survey_report.survey_statistics(result, prior, testbed, uncertainty) | errors
    statistics |= {"scene": testbed.scene.name, "frames": frames, "map": str(path), "picture": str(figure)}
    if json:
        print_json(statistics)
    else:
        print_survey(statistics)
