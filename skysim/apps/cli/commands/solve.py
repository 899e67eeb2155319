"""Commands `skysim solve`, and `skysim survey`: plan the survey of a dome, simulate it, or make it from images."""

from __future__ import annotations

import datetime
from collections.abc import Collection, Iterator
from contextlib import closing, suppress
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Literal

import typer
from typer import Argument, Option

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
    given_options,
    load,
    output_folder,
)
from skysim.apps.cli.terminal import print_error, print_json, print_solutions, progress
from skysim.core.errors import InputError

if TYPE_CHECKING:
    from skysim.apps.plate_solver import DomeSolver, Outputs, Solver
    from skysim.core.images import ViewedImage
    from skysim.core.types import Record


VIDEO_SUFFIXES = (".avi", ".m4v", ".mkv", ".mov", ".mp4")


def solve(
    images: Annotated[list[Path] | None, Argument()] = None,
    fov: float | None = None,
    camera: Path | None = None,
    dome: str | None = None,
    map_: Path | None = None,
    live: str | None = None,
    time: str | None = None,
    catalog: str | None = None,
    detector: Detector = None,
    centroider: Centroider = None,
    identifier: Identifier = None,
    solver: SolverName = None,
    near: str | None = None,
    size: str | None = None,
    wcs: Path | None = None,
    table: Path | None = None,
    annotate: Path | None = None,
    sequence: Annotated[bool, Option()] = False,
    rate: float | None = None,
    out: Path = Path("out/solve"),
    json: Json = False,
) -> None:
    """Solve the attitude of images of the sky or of a dome's LEDs, lost in space; uncertain matches are rejected.

    Exit code 0 if all images could be read, solved or not; 2 otherwise.

    Parameters
    ----------
    images : IMAGES
        Images (FITS, TIFF, PNG, JPEG, NPY, camera raw and others), folders, or lists of lights (CSV or ECSV:
        x_px, y_px, flux).
    fov
        Horizontal field of view in degrees, to 5 %; default: EXIF's, then 2 to 100 are searched.
    camera
        Camera of the images: a scene (file, or name in scenes/), camera file or OpenCV calibration.
    dome
        Scene (file, or name in scenes/) of the dome whose LEDs the images show.
    map_
        Map of the dome by `skysim survey`; default: the scene's LEDs.
    live
        Also solve a frame of a live camera: its index, a video file, an address or gige://HOST.
    time
        UTC at which the images were taken, 1900 to 2100, e.g. 2012-06-22T21:00:00.
    catalog
        Star catalog: a name in data/catalogs or a file; a deep one for fields of a few degrees.
    near : RA,DEC,DEG
        Circle of the sky in which the image center is sought, in degrees.
    size : WxH
        Size of the picture of a list of lights, in pixels.
    wcs
        Also write the FITS header (TAN-SIP) of one image here.
    table
        Also write the matched stars or LEDs of one image here, as ECSV.
    annotate
        File of the annotated image of one image, in place of OUT's.
    sequence
        The images are one camera's in the order of time: also print rates and gaps.
    rate
        Frame rate of a sequence, Hz; default: the dates of the FITS headers.
    out
        Folder for the annotated images.
    """
    import skysim.core.jit  # noqa: F401  # says so if numba has to compile
    from skysim.apps import plate_solver
    from skysim.core import files

    sky = {"fov": fov, "time": time, "catalog": catalog, "near": near, "size": size}
    stages = given_options(
        detector=detector, centroider=centroider, identifier=identifier, solver=solver
    )
    settings = solver_of(sky | {"camera": camera, "wcs": wcs}, dome, map_, stages)
    files.make_folder(out)
    paths = pictures(images or [], live, out, sequence)
    chosen = plate_solver.Outputs(annotate, table, wcs)
    if any(chosen) and len(paths) != 1:
        raise InputError("", f"{len(paths)} images", "one with --annotate, --table or --wcs")
    results, messages, all_read = solve_all(paths, settings, chosen, out, json)
    if sequence:
        plate_solver.add_rates(results, rate or video_numbers(paths[0])[0])
    files.write_json(out / "solutions.json", results)
    if json:
        print_json(results)
    else:
        print_solutions(results, out)
        if sequence:
            print(plate_solver.sequence_summary(results))
    for message in messages:
        print_error(message)
    if not all_read:
        raise typer.Exit(2)


def solver_of(
    sky: Record, dome: str | None, map_: Path | None, stages: dict[str, str]
) -> Solver | DomeSolver:
    """The solver of the images; `sky` has the options that have no effect with a dome, by name. Raises InputError."""
    from skysim.apps import plate_solver

    if dome is not None:
        for name in given_options(**sky):
            raise InputError(f"--{name}", "has no effect with --dome", "without it")
        return plate_solver.make_dome_solver(dome, map_, stages)
    if map_ is not None:
        raise InputError("--map", "has no effect without --dome", "with --dome SCENE")
    try:
        time_utc = sky["time"] and datetime.datetime.fromisoformat(sky["time"])
    except ValueError:
        raise InputError(
            f"--time {sky['time']}", "", "ISO 8601, e.g. 2012-06-22T21:00:00"
        ) from None
    return plate_solver.make_solver(
        sky["fov"],
        sky["camera"],
        time_utc,
        stages,
        sky["catalog"],
        size_px=numbers("size", sky["size"], "x", 2, int),
        near_deg=numbers("near", sky["near"], ",", 3, float),
    )


def numbers(name: str, text: str | None, separator: str, count: int, kind: Any) -> Any:
    """The numbers of an option, None if it is left out. Raises InputError for another count or no numbers."""
    if text is None:
        return None
    try:
        values = tuple(kind(part) for part in text.split(separator))
    except ValueError:
        values = ()
    if len(values) != count:
        raise InputError(
            f"--{name}", text, f"{count} numbers with {separator!r} between them"
        )
    return values


def pictures(images: list[Path], live: str | None, out: Path, sequence: bool) -> list[Path]:
    """The files to solve, with a frame of the live camera, which is written to `out`. Raises InputError without any."""
    from skysim.apps import plate_solver
    from skysim.core import files
    from skysim.core.images import stem_of

    paths = plate_solver.pictures_in(images)
    if live is not None:
        from skysim.apps.live.gige_receiver import open_camera

        paths.append(out / "live.png")
        with closing(open_camera(live)) as camera:
            files.write_image(paths[-1], camera.frame())
    if not paths:
        raise InputError("", "no images", "files, folders, or --live CAMERA")
    if sequence:  # a frame that is there as FITS and as PNG is one
        first = {path.with_name(stem_of(path)): path for path in reversed(paths)}
        paths = list(first.values())[::-1]
    return paths


def solve_all(
    paths: list[Path], solver: Solver | DomeSolver, chosen: Outputs, out: Path, quiet: bool
) -> tuple[list[Record], list[str], bool]:
    """Solve the images. Returns their results, warnings followed by errors, and whether all images could be read."""
    from skysim.apps import plate_solver

    results = []
    errors = []
    warnings = []
    annotated = plate_solver.annotated_paths(out, paths)
    count = sum(video_numbers(path)[1] for path in paths)
    frames = (
        frame
        for path, marked in zip(paths, annotated, strict=True)
        for frame in frames_of(path, marked, chosen)
    )
    for name, picture, marked in progress(frames, count, "solving", quiet or count == 1):
        outputs = chosen if chosen.annotated else chosen._replace(annotated=marked)
        result = plate_solver.solve_file(name, solver, outputs, picture)
        warning = result.pop("warning")
        if warning:
            warnings.append(warning)
        if result.pop("bad_input"):
            errors.append(result["status"])
        results.append(result)
    return results, warnings + errors, not errors


def frames_of(
    path: Path, marked: Path, chosen: Outputs
) -> Iterator[tuple[Path, ViewedImage | None, Path | None]]:
    """Names and pictures of a file's images, and where each is drawn; one that cannot be read has no picture.

    The frames of a video are not drawn: they are thousands. Raises InputError for several images of one output.
    """
    from skysim.core import images

    if path.suffix.lower() in VIDEO_SUFFIXES:
        with closing(images.LiveCamera(str(path))) as video:
            for n in range(video_numbers(path)[1]):
                name = path.with_name(f"{path.name}#{n}")
                yield name, images.ViewedImage(video.frame()), None
        return
    pages: list[ViewedImage] = []
    with suppress(InputError, OSError):
        pages = images.read_pictures(path)
    if len(pages) < 2:
        yield path, pages[0] if pages else None, marked
        return
    if any(chosen):
        raise InputError(
            path, f"{len(pages)} images", "one with --annotate, --table or --wcs"
        )
    for n, page in enumerate(pages):
        name = path.with_name(f"{path.name}[{n}]")
        yield name, page, marked.with_name(f"{path.name}[{n}].annotated.png")


def video_numbers(path: Path) -> tuple[float | None, int]:
    """Frame rate in Hz and number of frames of a video; None and 1 of another file."""
    from skysim.core import images

    return images.video_numbers(path) if path.suffix.lower() in VIDEO_SUFFIXES else (None, 1)


FRAMES = 150
NEXT = 12
CHECKS = 40


FrameCount = Annotated[
    int | None,
    Option(
        min=2,
        help=f"Number of attitudes, with one frame at each; of images with --watch. Default: {FRAMES}.",
    ),
]
Next = Annotated[
    int | None,
    Option("--next", min=1, help=f"Number of attitudes to propose next; default: {NEXT}."),
]
Checks = Annotated[
    int | None,
    Option(
        min=1,
        help=f"Further attitudes at which the tracker is tested before and after; default: {CHECKS}.",
    ),
]


def survey(
    scene: SceneArg,
    frames: FrameCount = None,
    plan: bool = False,
    images: Path | None = None,
    camera: Path | None = None,
    watch: bool = False,
    repeat: Annotated[int | None, Option(min=2)] = None,
    attitudes: Literal["plan", "random"] | None = None,
    next_: Next = None,
    frames_to: Path | None = None,
    seed: Seed = None,
    out: Out = None,
    set_: Overrides = None,
    tilt: float = 25.0,
    imu_sigma: str = "0.5 deg",
    led_sigma: str = "2 mm",
    lever_sigma: str = "5 mm",
    focal_error: str = "1%",
    distortion: bool = False,
    checks: Checks = None,
    json: Json = False,
) -> None:
    """Survey a dome from frames at many attitudes: LED positions, lever arm and lens, to a file for `tracker.map`.

    It says which attitudes to hold, what they will reach, which LEDs are measured, and which are dark, displaced or
    exchanged.

    Parameters
    ----------
    plan
        Print the attitudes to hold and the predicted errors; simulate nothing.
    images
        Survey from the images of a folder, with the IMU's attitudes in its attitudes.csv if any.
    camera
        Camera of the images: a scene (file or name), camera file or OpenCV calibration.
    watch
        With --images: follow the folder while the images are taken, and print which LEDs are measured and which
        attitudes to hold next; after the last one, or Ctrl-C, survey.
    repeat
        Simulate so many surveys, and compare their errors with the prediction.
    attitudes
        Attitudes: by the plan (default), or random.
    frames_to
        Write the simulated frames and attitudes to a folder, for --images.
    tilt
        Maximum tilt of the attitudes, degrees.
    imu_sigma
        Standard error of the IMU's attitude about each axis.
    led_sigma
        Standard error of an LED's assumed position along each axis.
    lever_sigma
        Standard error of the camera's assumed position.
    focal_error
        Standard error of the assumed focal length.
    distortion
        Also fit the distortion k1, k2, p1, p2.
    """
    from skysim.apps.cli.commands import survey_modes
    from skysim.experiments.dome_survey.survey_frames import survey_uncertainty

    limited = given_options(
        frames=frames, attitudes=attitudes, next=next_, frames_to=frames_to, checks=checks
    )
    check_mode(plan, images, camera, watch, repeat, limited)
    loaded = load(scene, set_, seed)
    if seed is not None:
        # The list, the lever and the focal length before a survey are drawn by the command, not by the scene.
        loaded = loaded.with_values("tracker.survey", seed=seed)
    request = survey_modes.Request(
        loaded,
        survey_uncertainty(imu_sigma, led_sigma, lever_sigma, focal_error, distortion),
        output_folder(out, loaded.name),
        tilt,
        attitudes or "plan",
        frames or FRAMES,
        next_ or NEXT,
        json,
    )
    if images is not None and camera is not None:
        statistics = survey_modes.from_images(request, images, camera, watch)
    elif plan:
        statistics = survey_modes.plan_only(request)
    elif repeat:
        statistics = survey_modes.repeated(request, repeat)
    else:
        statistics = survey_modes.simulated(request, checks or CHECKS, frames_to)
    if json:
        print_json(statistics)


# Options that have no effect, by mode.
UNUSED = {
    "images": ("frames", "attitudes", "frames_to", "checks"),
    "watch": ("attitudes", "frames_to", "checks"),
    "plan": ("next", "frames_to", "checks"),
    "repeat": ("next", "frames_to", "checks"),
    "simulate": (),
}


def check_mode(
    plan: bool,
    images: Path | None,
    camera: Path | None,
    watch: bool,
    repeat: int | None,
    limited: Collection[str],
) -> None:
    """Raise InputError for options that exclude one another or have no effect.

    Parameters
    ----------
    limited
        Those of `UNUSED` that are given
    """
    modes = [
        name for name, on in (("images", images), ("plan", plan), ("repeat", repeat)) if on
    ]
    if len(modes) > 1:
        raise InputError(f"--{modes[1]}", f"has no effect with --{modes[0]}", "one of them")
    if images is not None and camera is None:
        raise InputError(
            "--images",
            "no camera",
            "with --camera FILE, a scene, camera file or OpenCV calibration",
        )
    if camera is not None and images is None:
        raise InputError(
            "--camera", "has no effect without --images", "the scene's camera is used"
        )
    if watch and images is None:
        raise InputError("--watch", "has no effect without --images", "with --images FOLDER")
    mode = "watch" if watch else modes[0] if modes else "simulate"
    for name in UNUSED[mode]:
        if name in limited:
            option = name.replace("_", "-")
            raise InputError(f"--{option}", f"has no effect with --{mode}", "none")
