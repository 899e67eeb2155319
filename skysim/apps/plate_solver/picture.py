"""Load a picture in the orientation of viewing, solve the hypotheses about it, and diagnose a refusal."""

from __future__ import annotations

import datetime
import math
import time
from collections.abc import Iterable
from dataclasses import asdict, fields, replace
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from estimator.core.errors import ImageError
from estimator.core.types import Centroids
from estimator.detection.detect import check_size
from estimator.trackers.pipeline import Report
from estimator.trackers.star_tracker import StarTracker
from skysim.apps.plate_solver import retries
from skysim.apps.plate_solver.solver import (
    FOV_LIMITS_DEG,
    PlateSolution,
    Solver,
    kept_solver,
    make_solver,
    solution_fields,
    solve_array,
    validated_date,
)
from skysim.core import files, images
from skysim.core.errors import InputError, printable

ANNOTATED = ".annotated.png"
# Exif's FocalLengthIn35mmFilm (CIPA DC-008), in whole millimeters, is the focal length of a camera of 36 x 24 mm with
# the same diagonal field (CIPA DCG-001). Some makers convert the longer side instead, which differs by 4 % for sensors
# of 4:3; the rest of the uncertainty is rounding, distortion and a small crop.
DIAGONAL_35MM = math.hypot(36, 24)
FOCAL_35MM_UNCERTAINTY = 0.10


class Reading(NamedTuple):
    """One reading of a picture: its pixels as they would be viewed, the solver for its field, and its assumption."""

    pixels: NDArray
    solver: Solver
    assumption: str = ""


class SolvedReading(NamedTuple):
    """The hypothesis that was solved, or else the first one, with its report and tracker; and all hypotheses."""

    hypothesis: Reading
    report: Report
    tracker: StarTracker
    tried: list[Reading]


def solve(
    path: str | Path,
    *,
    fov_deg: float | None = None,
    camera: str | Path | None = None,
    time_utc: datetime.datetime | None = None,
    catalog: str | Path | None = None,
) -> PlateSolution:
    """Solve the attitude of an image file of the sky, lost in space. Public as `skysim.solve`.

    Parameters
    ----------
    fov_deg
        Horizontal field of view to 5 %; if neither it nor `camera` is given, the field by EXIF
        and fields of 2 to 100 degrees are tried
    camera
        A scene, a camera file or an OpenCV calibration in place of fov_deg
    time_utc
        When the image was taken; the FITS header's date if left out
    catalog
        Name or file of a deeper star catalog, for fields of a few degrees

    Raises
    ------
    InputError
        With one line for an image that cannot be read.
    """
    if camera or catalog:
        solver = make_solver(
            fov_deg,
            Path(camera) if camera else None,
            time_utc,
            catalog=str(catalog) if catalog else None,
        )
    else:
        solver = kept_solver(fov_deg, time_utc)
    result = read_and_solve(Path(path), solver, None)
    return PlateSolution(**{name.name: result[name.name] for name in fields(PlateSolution)})


def pictures_in(paths: Iterable[Path]) -> list[Path]:
    """The files, with every folder replaced by its image files, sorted; without annotated images of an earlier call.

    Raises
    ------
    InputError
        For a folder without an image.
    """
    found: list[Path] = []
    for path in paths:
        if not path.is_dir():
            found.append(path)
            continue
        names = sorted(child for child in path.iterdir() if images.image_suffix(child.name))
        names = [
            child
            for child in names
            if child.name[0] != "." and not child.name.endswith(ANNOTATED)
        ]
        if not names:
            raise InputError(
                path, "a folder without images", ", ".join(images.IMAGE_SUFFIXES)
            )
        found += names
    return found


def annotated_paths(folder: Path, paths: list[Path]) -> list[Path]:
    """Paths of the annotated images: named as the pictures, with another suffix.

    If two pictures differ only in suffix, the suffix stays in the name; if they have the same name, a number is added.
    """
    stems = [stem_of(path) for path in paths]
    names = [
        path.name if stems.count(stem) > 1 else stem
        for path, stem in zip(paths, stems, strict=True)
    ]
    repeats = [names[:n].count(name) for n, name in enumerate(names)]
    return [
        folder / f"{name}{f'-{n + 1}' if n else ''}{ANNOTATED}"
        for name, n in zip(names, repeats, strict=True)
    ]


def stem_of(path: Path) -> str:
    """The file's name without the suffix of its image format."""
    suffix = images.image_suffix(path.name)
    return path.name[: -len(suffix)] if suffix else path.stem


def solve_file(path: Path, solver: Solver, annotated: Path | None) -> dict[str, Any]:
    """Solve one file and return the fields of `skysim solve --json`. Writes the annotated PNG if `annotated` is given.

    An unreadable image does not raise, so that the files after it are still solved: its error line becomes `status`,
    and `bad_input` is true (for the exit code). `warning` is the reason if the header's date was ignored.
    """
    try:
        return read_and_solve(path, solver, annotated)
    except InputError as error:
        return blank_result(path) | {"status": str(error), "bad_input": True}


def blank_result(path: Path) -> dict[str, Any]:
    """The fields of a file that is not solved."""
    return {"file": str(path), **asdict(PlateSolution()), "time_ms": None, "warning": ""}


def read_and_solve(path: Path, solver: Solver, annotated: Path | None) -> dict[str, Any]:
    """As `solve_file`, but raise InputError for an unreadable image."""
    result = blank_result(path)
    begin = time.perf_counter()
    try:
        picture = load_picture(path, solver)
        date_utc, warning = validated_date(picture.date_utc)
        if warning and not solver.time_utc:
            result["warning"] = f"{path}: DATE-OBS {warning}: ignored"
        outcome = solve_picture(picture, solver, date_utc)
    except InputError as error:
        raise error if error.key == printable(path) else error.within(path) from None
    except ImageError as error:
        raise InputError(path, error) from None
    result["time_ms"] = 1e3 * (time.perf_counter() - begin)
    result |= {"bad_input": False} | outcome_fields(outcome, date_utc)
    if annotated:
        files.write_image(
            annotated,
            annotated_image(outcome.hypothesis.pixels, outcome.report, outcome.tracker),
        )
    return result


def load_picture(path: Path, solver: Solver) -> images.ViewedImage:
    """Read a picture in monochrome, in the orientation in which it is viewed.

    Raises InputError or ImageError if the file cannot be read or does not suit the solver.
    """
    picture = images.read_picture(path)
    check_image(path, picture.pixels, solver)
    pixels = images.monochrome(picture.pixels)
    check_size(pixels)
    return replace(picture, pixels=pixels)


def check_image(path: Path, image: NDArray, solver: Solver) -> None:
    """Check the image's size against the known camera, and for a scene's camera also its channels and bit depth.

    Raises
    ------
    InputError
        If the image cannot come from this camera.
    """
    camera = solver.camera
    if camera is None:
        return
    if camera.detector and image.ndim != 2:
        raise InputError(
            path, f"a color image of shape {image.shape}; this camera's are monochrome"
        )
    bits = camera.detector.bits if camera.detector else 0
    if image.dtype == np.uint8 and bits > 8:
        raise InputError(
            path,
            f"an 8-bit image; this camera's have {bits} bits, in 16-bit FITS, PNG or TIFF",
        )
    height_px, width_px = image.shape[:2]
    model = camera.model
    if (width_px, height_px) != (model.width_px, model.height_px):
        raise InputError(
            path,
            f"{width_px}x{height_px} pixels; this camera's are {model.width_px}x{model.height_px}",
        )


def solve_picture(
    picture: images.ViewedImage, solver: Solver, date_utc: datetime.datetime | None
) -> SolvedReading:
    """Solve the hypotheses about a monochrome picture in turn, up to the first that is solved."""
    tried = hypotheses(picture, solver)
    outcomes = []
    centroids = dict[
        int, Centroids
    ]()  # by id of the pixels, shared by all fields of view tried on them
    for hypothesis in tried:
        reading = id(hypothesis.pixels)
        solved = solve_array(
            hypothesis.pixels, hypothesis.solver, date_utc, centroids.get(reading)
        )
        outcomes.append(SolvedReading(hypothesis, *solved, tried))
        centroids[reading] = outcomes[-1].report.centroids
        if outcomes[-1].report.attitude.solved:
            return outcomes[-1]
    return solve_again(outcomes, date_utc) or outcomes[0]


def solve_again(
    refused: list[SolvedReading], date_utc: datetime.datetime | None
) -> SolvedReading | None:
    """The first hypothesis that is solved by other centroids of its picture (`retries`), if any."""
    camera = refused[0].hypothesis.solver.camera
    if camera and camera.detector:
        return None  # the camera is known with its saturation: its frames need no retries
    for pixels in {
        id(one.hypothesis.pixels): one.hypothesis.pixels for one in refused
    }.values():
        readings = [one for one in refused if one.hypothesis.pixels is pixels]
        settings = readings[0].hypothesis.solver.settings
        for retry in retries.retries(pixels, readings[0].report.centroids, settings):
            for one in (one.hypothesis for one in readings):
                tries = one.solver.hypotheses * retries.EXTRA_TRIES
                solver = replace(one.solver, hypotheses=tries, upper_half=retry.upper_half)
                report, tracker = solve_array(
                    pixels, solver, date_utc, retry.centroids, retry.efforts
                )
                if report.attitude.solved:
                    notes = [one.assumption] * bool(one.assumption) + [retry.note]
                    return SolvedReading(
                        one._replace(assumption="; ".join(notes)),
                        report,
                        tracker,
                        refused[0].tried,
                    )
    return None


def hypotheses(picture: images.ViewedImage, solver: Solver) -> list[Reading]:
    """Hypotheses about a picture, likeliest first: field by EXIF or unknown; both row orders, if the order is unknown.

    A field or a camera given by the user takes precedence over EXIF.
    """
    height_px, width_px = picture.pixels.shape
    solvers = [solver]
    readings = [(picture.pixels, "")]
    if picture.focal_35mm and not solver.field_is_known:
        focal_px = picture.focal_35mm / DIAGONAL_35MM * math.hypot(width_px, height_px)
        fov_deg = math.degrees(2 * math.atan((width_px - 1) / 2 / focal_px))
        if FOV_LIMITS_DEG[0] <= fov_deg <= FOV_LIMITS_DEG[1]:
            solvers.insert(
                0, replace(solver, fov_deg=fov_deg, fov_uncertainty=FOCAL_35MM_UNCERTAINTY)
            )
    if not picture.row_order_known:
        readings.append((np.ascontiguousarray(picture.pixels[::-1]), images.ASSUMED_TOP_DOWN))
    count = len(solvers) * len(readings)
    return [
        Reading(pixels, replace(one, hypotheses=count), text)
        for one in solvers
        for pixels, text in readings
    ]


def outcome_fields(
    outcome: SolvedReading, date_utc: datetime.datetime | None
) -> dict[str, Any]:
    """The fields of PlateSolution: image statistics, tried fields, and solution or likely cause of the refusal."""
    report = outcome.report
    (pixels, solver, assumption) = outcome.hypothesis
    height_px, width_px = pixels.shape
    solvers = {one.solver.fov_deg: one.solver for one in outcome.tried}.values()
    seen = {
        "status": report.attitude.status,
        "lights": len(report.centroids),
        "brightest_dn": float(pixels.max()),
        "background_dn": float(np.median(pixels)),
        "tried_fov_deg": [one.tried_fov_deg(width_px, height_px) for one in solvers],
        "catalog_limit_mag": round(float(solver.stars.v_mag[-1]), 1),
    }
    if report.attitude.solved:
        return seen | solution_fields(report) | {"hint": assumption}
    from skysim.apps.plate_solver import diagnosis

    rows_known = len({id(one.pixels) for one in outcome.tried}) == 1
    refusal = diagnosis.Refusal(
        pixels, report.centroids, tuple(solvers), date_utc, rows_known
    )
    return seen | {"hint": diagnosis.likely_cause(refusal)}


def annotated_image(
    image: NDArray, report: Report, tracker: StarTracker
) -> NDArray[np.uint8]:
    """The image annotated with detections, matched stars and their numbers."""
    from skysim.results.plots import annotate

    match = report.attitude.match
    detected_px = report.centroids.xy_px
    if match is None:
        return annotate(image, detected_px, np.empty((0, 2)))
    names = [star_name(int(tracker.stars.id[star])) for star in match.star]
    return annotate(image, detected_px, detected_px[match.observed], names)


def star_name(number: int) -> str:
    """Name of a star by its number in a catalog of skysim (see `skysim.sources.catalog.Catalog`)."""
    millions, rest = divmod(number, 1_000_000)
    return f"{('HIP', 'HD', 'Gaia')[min(millions, 2)]} {rest}"
