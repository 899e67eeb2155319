"""Command `skysim solve`."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import closing
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from skysim.apps.cli.options import (
    Centroider,
    Detector,
    Identifier,
    Json,
    SolverName,
    datetime_from_iso,
    selected_stages,
)
from skysim.apps.cli.terminal import print_error, print_json, print_solutions, progress
from skysim.core.errors import InputError

if TYPE_CHECKING:
    from skysim.apps.plate_solver import DomeSolver, Outputs, Solver
    from skysim.core.images import ViewedImage

VIDEO_SUFFIXES = (".avi", ".m4v", ".mkv", ".mov", ".mp4")


def solve(
    images: Annotated[
        list[Path] | None,
        typer.Argument(
            metavar="IMAGES",
            help="FITS, PNG, TIFF, JPEG, BMP files, folders, or lists of lights (CSV or ECSV: x_px, y_px, flux).",
        ),
    ] = None,
    fov: Annotated[
        float | None,
        typer.Option(
            help="Horizontal field of view in degrees, to 5 %; default: EXIF's, then 2 to 100 are searched."
        ),
    ] = None,
    camera: Annotated[
        Path | None,
        typer.Option(
            help="Camera of the images: a scene (file, or name in scenes/), camera file or OpenCV calibration."
        ),
    ] = None,
    dome: Annotated[
        str | None,
        typer.Option(
            help="Scene (file, or name in scenes/) of the dome whose LEDs the images show."
        ),
    ] = None,
    map_: Annotated[
        Path | None,
        typer.Option(
            "--map", help="Map of the dome by `skysim survey`; default: the scene's LEDs."
        ),
    ] = None,
    live: Annotated[
        str | None,
        typer.Option(
            help="Also solve a frame of a live camera: its index, a video file or an address."
        ),
    ] = None,
    time: Annotated[
        str | None,
        typer.Option(
            help="UTC at which the images were taken, 1900 to 2100, e.g. 2012-06-22T21:00:00."
        ),
    ] = None,
    catalog: Annotated[
        str | None,
        typer.Option(
            help="Star catalog: a name in data/catalogs or a file; a deep one for fields of a few degrees."
        ),
    ] = None,
    detector: Detector = None,
    centroider: Centroider = None,
    identifier: Identifier = None,
    solver: SolverName = None,
    near: Annotated[
        str | None,
        typer.Option(
            metavar="RA,DEC,DEG",
            help="Circle of the sky in which the image center is sought, in degrees.",
        ),
    ] = None,
    size: Annotated[
        str | None,
        typer.Option(
            metavar="WxH", help="Size of the picture of a list of lights, in pixels."
        ),
    ] = None,
    wcs: Annotated[
        Path | None,
        typer.Option(help="Also write the FITS header (TAN-SIP) of one image here."),
    ] = None,
    table: Annotated[
        Path | None,
        typer.Option(help="Also write the matched stars or LEDs of one image here, as ECSV."),
    ] = None,
    annotate: Annotated[
        Path | None,
        typer.Option(help="File of the annotated image of one image, in place of OUT's."),
    ] = None,
    sequence: Annotated[
        bool,
        typer.Option(
            help="The images are one camera's in the order of time: also print rates and gaps."
        ),
    ] = False,
    rate: Annotated[
        float | None,
        typer.Option(
            help="Frame rate of a sequence, Hz; default: the dates of the FITS headers."
        ),
    ] = None,
    out: Annotated[Path, typer.Option(help="Folder for the annotated images.")] = Path(
        "out/solve"
    ),
    json: Json = False,
) -> None:
    """Solve the attitude of images of the sky or of a dome's LEDs, lost in space; uncertain matches are rejected.

    Exit code 0 if all images could be read, solved or not; 2 otherwise.
    """
    import skysim.core.jit  # noqa: F401  # says so if numba has to compile
    from skysim.apps import plate_solver
    from skysim.core import files
    from skysim.core.images import stem_of

    stages = selected_stages(
        detector=detector, centroider=centroider, identifier=identifier, solver=solver
    )
    settings: Solver | DomeSolver
    if dome is None:
        if map_ is not None:
            raise InputError("--map", "has no effect without --dome", "with --dome SCENE")
        settings = plate_solver.make_solver(
            fov,
            camera,
            datetime_from_iso(time),
            stages,
            catalog,
            size_px=numbers("size", size, "x", 2, int),
            near_deg=numbers("near", near, ",", 3, float),
        )
    else:
        sky = {"fov": fov, "time": time, "catalog": catalog, "near": near, "size": size}
        for name, value in (sky | {"camera": camera, "wcs": wcs}).items():
            if value is not None:
                raise InputError(f"--{name}", "has no effect with --dome", "without it")
        settings = plate_solver.make_dome_solver(dome, map_, stages)
    files.make_folder(out)
    paths = pictures(images or [], live, out)
    if sequence:  # a frame that is there as FITS and as PNG is one
        first = {path.with_name(stem_of(path)): path for path in reversed(paths)}
        paths = list(first.values())[::-1]
    chosen = plate_solver.Outputs(annotate, table, wcs)
    if any(chosen) and len(paths) != 1:
        raise InputError("", f"{len(paths)} images", "one with --annotate, --table or --wcs")
    results, warnings, errors = solve_all(paths, settings, chosen, out, json)
    if sequence:
        plate_solver.add_rates(results, rate or video_numbers(paths[0])[0])
    files.write_text(out / "solutions.json", files.to_json(results))
    if json:
        print_json(results)
    else:
        print_solutions(results, out)
        if sequence:
            print(plate_solver.sequence_summary(results))
    for message in warnings + errors:
        print_error(message)
    if errors:
        raise typer.Exit(2)


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


def pictures(images: list[Path], live: str | None, out: Path) -> list[Path]:
    """The files to solve, with a frame of the live camera, which is written to `out`. Raises InputError without any."""
    from skysim.apps import plate_solver
    from skysim.core import files
    from skysim.core.images import grab_frame

    paths = plate_solver.pictures_in(images)
    if live is not None:
        paths.append(out / "live.png")
        files.write_image(paths[-1], grab_frame(live))
    if not paths:
        raise InputError("", "no images", "files, folders, or --live CAMERA")
    return paths


def solve_all(
    paths: list[Path],
    solver: Solver | DomeSolver,
    chosen: Outputs,
    out: Path,
    quiet: bool,
) -> tuple[list[dict[str, Any]], list[str], list[str]]:
    """Solve the images. Returns their results, warnings, and the errors of those that could not be read."""
    from skysim.apps import plate_solver

    results = []
    errors = []
    warnings = []
    annotated = plate_solver.annotated_paths(out, paths)
    videos = [video_numbers(path) for path in paths]
    count = sum(length for _, length in videos)
    frames = (
        (name, picture, marked)
        for path, (rate_hz, length), marked in zip(paths, videos, annotated, strict=True)
        for name, picture in (video_frames(path, length) if rate_hz else [(path, None)])
    )
    for name, picture, marked in progress(frames, count, "solving", quiet or count == 1):
        # The frames of a video are not drawn: they are thousands.
        outputs = chosen if picture or chosen.annotated else chosen._replace(annotated=marked)
        result = plate_solver.solve_file(name, solver, outputs, picture)
        warning = result.pop("warning")
        if warning:
            warnings.append(warning)
        if result.pop("bad_input"):
            errors.append(result["status"])
        results.append(result)
    return results, warnings, errors


def video_frames(path: Path, count: int) -> Iterator[tuple[Path, ViewedImage]]:
    """Names and pictures of a video's frames."""
    from skysim.core.images import LiveCamera, ViewedImage

    with closing(LiveCamera(str(path))) as video:
        for n in range(count):
            yield path.with_name(f"{path.name}#{n}"), ViewedImage(video.frame())


def video_numbers(path: Path) -> tuple[float | None, int]:
    """Frame rate in Hz and number of frames of a video; None and 1 of another file."""
    from skysim.core import images

    return images.video_numbers(path) if path.suffix.lower() in VIDEO_SUFFIXES else (None, 1)
