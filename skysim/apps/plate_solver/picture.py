"""Load a picture in the orientation of viewing, solve the hypotheses about it, and diagnose a refusal."""

import math
import time
from collections.abc import Iterable
from dataclasses import asdict, fields, replace
from datetime import datetime
from pathlib import Path
from typing import NamedTuple

import numpy as np

from estimator.catalog import index_file
from estimator.core.errors import ImageError
from estimator.core.types import Centroids
from estimator.detection.detect import check_size
from estimator.trackers.pipeline import Report
from estimator.trackers.star_tracker import StarTracker
from skysim.apps.plate_solver import diagnosis
from skysim.apps.plate_solver.plate_solution import (
    DomeReading,
    DomeSolution,
    DomeSolver,
    PlateSolution,
    attitude_fields,
    camera_notes,
    dome_fields,
    make_dome_solver,
    picture_fields,
    solution_fields,
    solve_dome,
    wcs_header,
)
from skysim.apps.plate_solver.solver import (
    FOV_LIMITS_DEG,
    Circle,
    KnownCamera,
    Solver,
    kept_solver,
    make_solver,
    solve_array,
    validated_date,
)
from skysim.core import files, images
from skysim.core.errors import InputError, printable
from skysim.core.text import cells_of, column_numbers, read_lines
from skysim.core.types import Array, Record

ANNOTATED = ".annotated.png"
LIST_SUFFIXES = (".csv", ".ecsv")
LIST_SIGMA_PX = 0.1
# Exif's FocalLengthIn35mmFilm (CIPA DC-008), in whole millimeters, is the focal length of a camera of 36 x 24 mm with
# the same diagonal field (CIPA DCG-001). Some makers convert the longer side instead, which differs by 4 % for sensors
# of 4:3; the rest of the uncertainty is rounding, distortion and a small crop.
DIAGONAL_35MM = math.hypot(36, 24)
FOCAL_35MM_UNCERTAINTY = 0.10


class Reading(NamedTuple):
    """One reading of a picture: its pixels as they would be viewed, the solver for its field, and its assumptions.

    `flipped`: whether the file's first row is the lowest of these pixels.
    """

    pixels: Array
    solver: Solver
    assumption: str = ""
    flipped: bool = False


class Outputs(NamedTuple):
    """Files to write of a picture, each None for none: with marked lights; of a solved one its lights and header."""

    annotated: Path | None = None
    table: Path | None = None
    wcs: Path | None = None


NO_OUTPUTS = Outputs()


class SolvedReading(NamedTuple):
    """The hypothesis that was solved, or else the first one, with its report and tracker; and all hypotheses."""

    hypothesis: Reading
    report: Report
    tracker: StarTracker
    tried: list[Reading]

    @property
    def pixels(self) -> Array:
        """The pixels of the hypothesis."""
        return self.hypothesis.pixels


def solve(
    path: str | Path,
    *,
    fov_deg: float | None = None,
    camera: str | Path | None = None,
    time_utc: datetime | None = None,
    catalog: str | Path | None = None,
    size_px: tuple[int, int] | None = None,
    near_deg: Circle | None = None,
    dome: str | Path | None = None,
    map: str | Path | None = None,
) -> PlateSolution | DomeSolution:
    """Solve the attitude of an image file of the sky or a dome's LEDs, lost in space. Public as `skysim.solve`.

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
    size_px
        Width and height of the picture, for a list of lights (CSV or ECSV with x_px, y_px, flux)
    near_deg
        Right ascension, declination and radius: only answers within this circle are searched
    dome, map
        Scene of the dome whose LEDs the image shows, and the map of a survey in place of the scene's LEDs, lever and
        lens. The result is then a `DomeSolution`; no other keyword is allowed

    Raises
    ------
    InputError
        With one line for an image that cannot be read.
    """
    solver: Solver | DomeSolver
    sky = (fov_deg, camera, time_utc, catalog, size_px, near_deg)
    if dome:
        if any(one is not None for one in sky):
            raise InputError("solve.dome", "with a keyword of the sky", "dome and map alone")
        solver = make_dome_solver(dome, map)
    elif map:
        raise InputError("solve.map", "has no effect without a dome", "with the dome's scene")
    elif camera or catalog or near_deg or size_px:
        solver = make_solver(
            fov_deg,
            Path(camera) if camera else None,
            time_utc,
            catalog=str(catalog) if catalog else None,
            size_px=size_px,
            near_deg=near_deg,
        )
    else:
        solver = kept_solver(fov_deg, time_utc)
    result = read_and_solve(Path(path), solver)
    kind: type[PlateSolution | DomeSolution] = DomeSolution if dome else PlateSolution
    return kind(**{one.name: result[one.name] for one in fields(kind)})


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
        names = sorted(
            child
            for child in path.iterdir()
            if images.image_suffix(child.name)
            and child.name[0] != "."
            and not f".{child.name}".endswith(ANNOTATED)
        )
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
    stems = [images.stem_of(path) for path in paths]
    names = [
        path.name if stems.count(stem) > 1 else stem
        for path, stem in zip(paths, stems, strict=True)
    ]
    repeats = [names[:n].count(name) for n, name in enumerate(names)]
    return [
        folder / f"{name}{f'-{n + 1}' if n else ''}{ANNOTATED}"
        for name, n in zip(names, repeats, strict=True)
    ]


def solve_file(
    path: Path,
    solver: Solver | DomeSolver,
    outputs: Outputs = NO_OUTPUTS,
    picture: images.ViewedImage | None = None,
) -> Record:
    """Solve one file, return the fields of `skysim solve --json`, and write the files of `outputs`.

    An unreadable image does not raise, so that the files after it are still solved: its error line becomes `status`,
    and `bad_input` is true (for the exit code). `warning` is the reason if the header's date was ignored. A `picture`
    that was read already, as of a video, is solved in place of the file.
    """
    try:
        return read_and_solve(path, solver, outputs, picture)
    except InputError as error:
        return blank_result(path, solver) | {"status": str(error), "bad_input": True}


def blank_result(path: Path, solver: Solver | DomeSolver) -> Record:
    """The fields of a file that is not solved."""
    run = {"date_utc": None, "time_ms": None, "warning": ""}
    blank = DomeSolution() if isinstance(solver, DomeSolver) else PlateSolution()
    return {"file": str(path), **asdict(blank), **run}


def read_and_solve(
    path: Path,
    solver: Solver | DomeSolver,
    outputs: Outputs = NO_OUTPUTS,
    picture: images.ViewedImage | None = None,
) -> Record:
    """As `solve_file`, but raise InputError for an unreadable image."""
    result = blank_result(path, solver)
    begin = time.perf_counter()
    taken_utc = solver.time_utc
    reading: SolvedReading | DomeReading
    try:
        source: images.ViewedImage | Centroids
        if path.suffix.lower() in LIST_SUFFIXES:
            source = read_lights(path)
        else:
            source = load_picture(path, solver.camera, picture)
            date_utc, warning = validated_date(source.date_utc)
            taken_utc = taken_utc or date_utc
            if warning and not taken_utc:
                result["warning"] = f"{path}: DATE-OBS {warning}: ignored"
        if isinstance(solver, DomeSolver):
            reading = solve_dome(source, solver)
        elif isinstance(source, Centroids):
            reading = solve_list(path, source, solver)
        else:
            reading = solve_picture(source, replace(solver, time_utc=taken_utc))
    except InputError as error:
        raise error if error.key == printable(path) else error.within(path) from None
    except ImageError as error:
        raise InputError(path, error) from None
    finally:
        index_file.release()
    result["time_ms"] = 1e3 * (time.perf_counter() - begin)
    result["bad_input"] = False
    if isinstance(reading, DomeReading):
        result |= dome_fields(reading)
    else:
        result |= outcome_fields(reading)
    result["date_utc"] = taken_utc.isoformat() if taken_utc else None
    write_outputs(outputs, reading, result)
    return result


def write_outputs(
    outputs: Outputs, reading: SolvedReading | DomeReading, result: Record
) -> None:
    """Write the files of a picture; lights and header only if it is solved."""
    rows = result["leds"] if isinstance(reading, DomeReading) else result["stars"]
    report = reading.report
    if outputs.annotated:
        from skysim.results.plots import annotate

        names = [one["name"] for one in rows]
        match = report.attitude.match
        detected_px = report.centroids.xy_px
        matched_px = detected_px[match.observed if match else []]
        files.write_image(
            outputs.annotated, annotate(reading.pixels, detected_px, matched_px, names)
        )
    if not report.attitude.solved:
        return
    if outputs.table:
        from astropy.table import Table

        files.write_table(outputs.table, Table(list(rows)))
    if outputs.wcs and isinstance(reading, SolvedReading):
        from astropy.io import fits

        header = wcs_header(report.attitude, reading.hypothesis.flipped)
        with files.atomic_file(outputs.wcs) as temporary:
            fits.PrimaryHDU(header=header).writeto(temporary, overwrite=True)


def solve_list(path: Path, centroids: Centroids, solver: Solver) -> SolvedReading:
    """Solve a list of lights.

    Raises
    ------
    InputError
        Without the picture's size, which a camera or `solver.size_px` gives.
    """
    camera = solver.camera
    size_px = (camera.model.width_px, camera.model.height_px) if camera else solver.size_px
    if size_px is None:
        raise InputError(
            path,
            "a list of lights of a picture of unknown size",
            "a size in pixels, or a camera",
        )
    reading = Reading(np.zeros(size_px[::-1], np.uint8), solver)
    report, tracker = solve_array(reading.pixels, solver, centroids)
    return SolvedReading(reading, report, tracker, [reading])


def read_lights(path: Path) -> Centroids:
    """The lights of a CSV or ECSV file, brightest first; errors of 0.1 px are assumed.

    Columns are x_px, y_px and optionally flux; without it the first light is the brightest. Raises InputError for
    others.
    """
    lines = read_lines(path)
    rows = cells_of(lines)
    if path.suffix.lower() == ".ecsv":  # whose texts may have blanks
        table = files.read_table(path)
        words = (table.colnames, *([str(one) for one in row] for row in table.iterrows()))
        rows = list(enumerate(words, len(lines) - len(rows) + 1))
    if not rows or {"x_px", "y_px"} - {*rows[0][1]}:
        raise InputError(
            path, "no lights", "columns x_px, y_px and flux or none, all numbers"
        )
    values = column_numbers(path, rows, ("x_px", "y_px", "flux"))
    flux = values[:, 2] if values.shape[1] == 3 else np.arange(len(values), 0.0, -1.0)
    order = np.argsort(-flux, kind="stable")
    return Centroids(values[order, :2], np.full(len(values), LIST_SIGMA_PX), flux[order])


def load_picture(
    path: Path, camera: KnownCamera | None = None, picture: images.ViewedImage | None = None
) -> images.ViewedImage:
    """Read a picture in monochrome, in the orientation in which it is viewed.

    Raises InputError or ImageError if the file cannot be read or does not suit the camera.
    """
    picture = picture or images.read_picture(path)
    if camera:
        check_image(path, picture.pixels, camera)
    light = images.as_light(picture)
    check_size(light.pixels)
    if light.scale != 1 and camera and (detector := camera.detector):
        # Floats up to 1 of a known camera: 1 is the end of its converter.
        top = 2**detector.bits - 1
        return replace(light, pixels=light.pixels * (top / light.scale), notes=())
    return light


def check_image(path: Path, image: Array, camera: KnownCamera) -> None:
    """Check the image's size against the known camera, and for a scene's camera also its channels and bit depth.

    Raises
    ------
    InputError
        If the image cannot come from this camera.
    """
    if detector := camera.detector:
        if image.ndim != 2:
            raise InputError(
                path, f"a color image of shape {image.shape}; this camera's are monochrome"
            )
        if image.dtype == np.uint8 and detector.bits > 8:
            raise InputError(
                path,
                f"an 8-bit image; this camera's have {detector.bits} bits, in 16-bit FITS, PNG or TIFF",
            )
    height_px, width_px = image.shape[:2]
    model = camera.model
    if (width_px, height_px) != (model.width_px, model.height_px):
        raise InputError(
            path,
            f"{width_px}x{height_px} pixels; this camera's are {model.width_px}x{model.height_px}",
        )


def solve_picture(picture: images.ViewedImage, solver: Solver) -> SolvedReading:
    """Solve the hypotheses about a monochrome picture in turn, up to the first that is solved."""
    tried = hypotheses(picture, solver)
    outcomes = []
    # By the order of the rows, shared by all fields of view tried on the same pixels.
    centroids: dict[bool, Centroids] = {}
    for one in tried:
        known = centroids.get(one.flipped)
        report, tracker = solve_array(one.pixels, one.solver, known)
        outcomes.append(SolvedReading(one, report, tracker, tried))
        centroids[one.flipped] = report.centroids
        if report.attitude.solved:
            return outcomes[-1]
    return solve_again(outcomes) or outcomes[0]


def solve_again(refused: list[SolvedReading]) -> SolvedReading | None:
    """The first hypothesis that is solved by other centroids of its picture (`retries`), if any."""
    camera = refused[0].hypothesis.solver.camera
    if camera and camera.detector:
        return None  # the camera is known with its saturation: its frames need no retries
    for flipped in dict.fromkeys(one.hypothesis.flipped for one in refused):
        readings = [one for one in refused if one.hypothesis.flipped == flipped]
        pixels = readings[0].pixels
        settings = readings[0].hypothesis.solver.settings
        for retry in diagnosis.retries(pixels, readings[0].report.centroids, settings):
            for one in (one.hypothesis for one in readings):
                tries = one.solver.hypotheses * diagnosis.EXTRA_TRIES
                solver = replace(one.solver, hypotheses=tries, upper_half=retry.upper_half)
                report, tracker = solve_array(pixels, solver, retry.centroids, retry.efforts)
                if report.attitude.solved:
                    notes = "; ".join(filter(None, (one.assumption, retry.note)))
                    return SolvedReading(
                        one._replace(assumption=notes),
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
    notes = list(picture.notes)
    readings = [(picture.pixels, notes, picture.flipped)]
    if picture.focal_35mm and not solver.field_is_known:
        focal_px = picture.focal_35mm / DIAGONAL_35MM * math.hypot(width_px, height_px)
        fov_deg = math.degrees(2 * math.atan((width_px - 1) / 2 / focal_px))
        if FOV_LIMITS_DEG[0] <= fov_deg <= FOV_LIMITS_DEG[1]:
            solvers.insert(
                0, replace(solver, fov_deg=fov_deg, fov_uncertainty=FOCAL_35MM_UNCERTAINTY)
            )
    if not picture.row_order_known:
        turned = np.ascontiguousarray(picture.pixels[::-1])
        readings.append((turned, [*notes, images.ASSUMED_TOP_DOWN], not picture.flipped))
    count = len(solvers) * len(readings)
    return [
        Reading(pixels, replace(one, hypotheses=count), "; ".join(texts), flipped)
        for one in solvers
        for pixels, texts, flipped in readings
    ]


def outcome_fields(outcome: SolvedReading) -> Record:
    """The fields of PlateSolution: image statistics, tried fields, and solution or likely cause of the refusal."""
    report = outcome.report
    (pixels, solver, assumption, _) = outcome.hypothesis
    height_px, width_px = pixels.shape
    solvers = {one.solver.fov_deg: one.solver for one in outcome.tried}.values()
    seen = picture_fields(report, pixels) | {
        "tried_fov_deg": [one.tried_fov_deg(width_px, height_px) for one in solvers],
        "catalog_limit_mag": round(float(solver.stars.v_mag[-1]), 1),
    }
    if report.attitude.solved:
        solved = solution_fields(report) | attitude_fields(
            report, outcome.tracker, solver.stars
        )
        assert report.attitude.camera is not None
        notes = camera_notes(report.attitude.camera, outcome.tracker)
        return seen | solved | {"hint": "; ".join([assumption] * bool(assumption) + notes)}
    rows_known = len({one.flipped for one in outcome.tried}) == 1
    refusal = diagnosis.Refusal(pixels, report.centroids, tuple(solvers), rows_known)
    assumed = outcome.tried[0].assumption
    hint = diagnosis.likely_cause(refusal) + f" ({assumed})" * bool(assumed)
    return seen | {"hint": hint}
