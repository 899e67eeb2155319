"""Command `skysim solve`."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Annotated

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
    from skysim.apps.plate_solver import Solver


def solve(
    images: Annotated[
        list[Path] | None,
        typer.Argument(
            metavar="IMAGES", help="FITS, PNG, TIFF, JPEG, BMP files, or folders."
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
    out: Annotated[Path, typer.Option(help="Folder for the annotated images.")] = Path(
        "out/solve"
    ),
    json: Json = False,
) -> None:
    """Solve the attitude of sky images, lost in space; uncertain matches are rejected.

    Exit code 0 if all images could be read, solved or not; 2 otherwise.
    """
    import skysim.core.jit  # noqa: F401  # says so if numba has to compile
    from skysim.apps import plate_solver
    from skysim.core import files

    stages = selected_stages(
        detector=detector, centroider=centroider, identifier=identifier, solver=solver
    )
    settings = plate_solver.make_solver(fov, camera, datetime_from_iso(time), stages, catalog)
    files.make_folder(out)
    solve_all(pictures(images or [], live, out), settings, out, json)


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


def solve_all(paths: list[Path], solver: Solver, out: Path, json: bool) -> None:
    """Solve the images and print the solutions. Raises typer.Exit if one could not be read."""
    from skysim.apps import plate_solver
    from skysim.core import files

    quiet = json or len(paths) == 1
    annotated = plate_solver.annotated_paths(out, paths)
    results = []
    errors = []
    warnings = []
    for n, path in enumerate(progress(paths, len(paths), "solving", quiet)):
        result = plate_solver.solve_file(path, solver, annotated[n])
        warning = result.pop("warning")
        if warning:
            warnings.append(warning)
        if result.pop("bad_input"):
            errors.append(result["status"])
        results.append(result)
    files.write_text(out / "solutions.json", files.to_json(results))
    if json:
        print_json(results)
    else:
        print_solutions(results, out)
    for message in warnings + errors:
        print_error(message)
    if errors:
        raise typer.Exit(2)
