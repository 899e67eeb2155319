"""Command `skysim solve`."""

from __future__ import annotations

import datetime
from collections.abc import Iterator
from contextlib import closing, suppress
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer
from typer import Argument, Option

from skysim.apps.cli.options import (
    Centroider,
    Detector,
    Identifier,
    Json,
    SolverName,
    given_options,
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
        Also solve a frame of a live camera: its index, a video file or an address.
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
    files.write_text(out / "solutions.json", files.to_json(results))
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
    from skysim.core.images import grab_frame, stem_of

    paths = plate_solver.pictures_in(images)
    if live is not None:
        paths.append(out / "live.png")
        files.write_image(paths[-1], grab_frame(live))
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
