"""Plate solver: right ascension, declination and roll of image files from any camera, lost in space.

If the field of view is known (a camera file, an OpenCV calibration or `--fov`), one `StarTracker` solves the image.
Otherwise 5 to 40 degrees are split into N overlapping ranges of focal length in geometric progression, each searched
by a tracker that fits the focal length within its range. The image's stars are detected once; all trackers are tried
with little effort before any is tried with more.

Every tracker is one more opportunity for a false match. With P the probability that the best match is due to chance,
it is accepted if P <= P_accept / N (Bonferroni), and if no solution elsewhere on the sky has a P less than 1000 times
as large (`FieldSearch.margin_dex`).
"""

from __future__ import annotations

import datetime
import math
import time
from collections.abc import Iterator, Mapping
from dataclasses import asdict, dataclass, field, fields, replace
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from estimator.attitude.solvers import SOLVERS
from estimator.catalog import catalog as star_catalog
from estimator.centroiding.centroid import CENTROIDERS
from estimator.core.camera import Camera
from estimator.core.errors import ImageError
from estimator.core.types import Attitude, Centroids, ra_dec_roll_rad
from estimator.detection.detect import DETECTORS, check_size
from estimator.identification.chance import ACCEPT_LOG10_CHANCE
from estimator.identification.registry import IDENTIFIERS
from estimator.trackers.pipeline import Clock, Report, Settings, detect_and_centroid
from estimator.trackers.star_tracker import NO_MATCH, StarTracker
from skysim.camera.detector.detector import saturation_dn
from skysim.core import files, images
from skysim.core.errors import InputError, unknown_name
from skysim.core.paths import CATALOGS
from skysim.results.report import annotate
from skysim.scene import loader, scene
from skysim.scene import opencv_calibration as opencv
from skysim.scene.camera import CameraConfig
from skysim.tracking.onboard_model import calibration

# Relative uncertainty of the focal length. An OpenCV chessboard calibration gives it to about 0.1 %.
CALIBRATED_UNCERTAINTY = 0.003
FOV_UNCERTAINTY = 0.055  # 5 % that --fov allows, plus 0.5 % for the definition of the field of view
CATALOG = CATALOGS / "hipparcos_hp6.5.ecsv"
DEFAULT_EPOCH = datetime.datetime(2020, 1, 1, 12)


@dataclass(frozen=True, slots=True)
class FieldSearch:
    """Options of the search over unknown horizontal fields of view.

    The ranges are wide because one index of star pairs serves fields 1.5 times as wide, and a search takes as long
    for a narrow range.

    widest_deg, narrowest_deg : limits of the fields of view
    trackers   : number of trackers that share this range
    overlap    : of neighboring ranges, as a fraction of the focal length
    decisive_log10_chance : a solution below this ends the search without trying other fields of view
    margin_dex : by which a solution must beat those with another attitude
    same_attitude_rad : solutions that differ by less than this are the same
    """

    widest_deg: float = 40.0
    narrowest_deg: float = 5.0
    trackers: int = 5
    overlap: float = 0.01
    decisive_log10_chance: float = -10.0
    margin_dex: float = 3.0
    same_attitude_rad: float = math.radians(0.2)


FIELD_SEARCH = FieldSearch()
STAGES: dict[str, Mapping[str, object]] = {
    "detector": DETECTORS,
    "centroider": CENTROIDERS,
    "identifier": IDENTIFIERS,
    "solver": SOLVERS,
}


@dataclass(frozen=True, slots=True)
class Solver:
    """Settings of the plate solver: a field of view known to 5 %, or a camera known exactly or by calibration; with
    neither, 5 to 40 degrees are searched.

    time_utc : when the images were taken; None takes the date of each FITS header. Without any date the epoch is
        2020, and stellar aberration (20") is left out because its direction depends on the season.
    tracker_cache : the trackers for the last image size and date
    """

    fov_deg: float | None
    camera: CameraConfig | None
    stars: star_catalog.StarCatalog
    settings: Settings
    time_utc: datetime.datetime | None = None
    opencv_calibration: opencv.Calibration | None = None
    tracker_cache: dict[Any, dict[Camera, StarTracker]] = field(default_factory=dict, compare=False, repr=False)

    def candidate_cameras(self, width_px: int, height_px: int) -> list[tuple[Camera, float]]:
        """Cameras to try for this image size, each with its relative focal-length uncertainty, the likeliest first."""
        if self.camera:
            return [(calibration(self.camera), 0.0)]
        if lens := self.opencv_calibration:
            camera = Camera(lens.width_px, lens.height_px, lens.focal_px, lens.center_px, lens.distortion)
            return [(camera, CALIBRATED_UNCERTAINTY)]
        if self.fov_deg:
            return [(Camera.from_fov(width_px, height_px, math.radians(self.fov_deg)), FOV_UNCERTAINTY)]
        limits_deg, count = (FIELD_SEARCH.widest_deg, FIELD_SEARCH.narrowest_deg), FIELD_SEARCH.trackers
        widest, narrowest = (math.tan(math.radians(deg) / 2) for deg in limits_deg)
        ratio = (widest / narrowest) ** (1 / count)
        from_middle_out = sorted(range(count), key=lambda n: abs(n - (count - 1) / 2))
        # A tracker of focal length f covers f (1 - u) to f (1 + u): u = (ratio - 1) / (ratio + 1) makes neighbors meet.
        uncertainty = (ratio - 1) / (ratio + 1)
        # Half-field tangents: range n begins at widest / ratio^n, where the focal length is f (1 - u).
        tangents = [widest / ratio**n * (1 - uncertainty) for n in from_middle_out]
        return [
            (Camera.from_fov(width_px, height_px, 2 * math.atan(tangent)), uncertainty + FIELD_SEARCH.overlap)
            for tangent in tangents
        ]

    def trackers(self, width_px: int, height_px: int, date_utc: datetime.datetime | None) -> Iterator[StarTracker]:
        """Yield the trackers for an image of this size and date: one, or one per range of fields of view.

        Trackers are built when first needed and cached until an image of another size or date comes.
        """
        date_utc = self.time_utc or date_utc
        if (width_px, height_px, date_utc) not in self.tracker_cache:
            self.tracker_cache.clear()  # keep the trackers of one image size and date only
        cached = self.tracker_cache.setdefault((width_px, height_px, date_utc), {})
        for camera, uncertainty in self.candidate_cameras(width_px, height_px):
            if camera not in cached:
                vectors = (
                    star_catalog.apparent(self.stars, star_catalog.on_earth(date_utc))
                    if date_utc
                    else star_catalog.at_epoch(self.stars, DEFAULT_EPOCH.year)
                )
                cached[camera] = StarTracker(camera, self.stars, vectors, self.settings, uncertainty)
            yield cached[camera]


def make_solver(
    fov_deg: float | None,
    camera_file: Path | None,
    time_utc: datetime.datetime | None = None,
    stages: Mapping[str, str] | None = None,
) -> Solver:
    """Build a Solver from user input. Raises InputError with one line.

    stages : names of algorithms by stage (keys of STAGES); the tracker's defaults for the others
    """
    if fov_deg is not None and camera_file is not None:
        raise InputError("give either --fov DEG or --camera FILE")
    if fov_deg is not None and not 1 <= fov_deg <= 120:
        raise InputError(f"--fov {fov_deg:g}: allowed: the horizontal field of view, 1 to 120 degrees")
    time_utc, warning = validated_date(time_utc)
    if warning:
        raise InputError(f"--time: {warning}")
    for stage, name in (stages or {}).items():
        if name not in STAGES[stage]:
            raise InputError(f"--{stage}: {unknown_name(stage, name, STAGES[stage])}")
    camera = lens = None
    settings = Settings()
    if camera_file and opencv.looks_like_calibration(camera_file):
        lens = opencv.read(camera_file)
    elif camera_file:
        is_file = camera_file.suffix or camera_file.exists()  # else the name of a shipped scene
        camera = loader.load_camera(camera_file if is_file else loader.find(str(camera_file)))
        settings = Settings(gain_e_dn=camera.detector.gain_e_dn, saturation=saturation_dn(camera.detector))
    settings = replace(settings, **(stages or {}))  # type: ignore[arg-type]
    try:
        stars = star_catalog.read(CATALOG)
    except ImageError as error:
        raise InputError(f"{error}; make it with: skysim catalog build") from None
    return Solver(fov_deg, camera, stars, settings, time_utc, lens)


def validated_date(date_utc: datetime.datetime | None) -> tuple[datetime.datetime | None, str]:
    """Return (date in UTC, ""), or (None, reason) for a date outside the supported range; (None, "") without a date."""
    try:
        return (scene.check_year(date_utc) if date_utc else None), ""
    except ValueError as error:
        return None, str(error)


@dataclass(frozen=True, slots=True)
class PlateSolution:
    """Pointing of an image; the angles are None unless `status` is solved.

    ra_deg, dec_deg : of the image center, ICRS;  roll_deg : position angle of the image's up, north through east
    fov_deg         : fitted horizontal field of view
    matches         : number of identified stars;  rms_arcsec : rms of their residuals
    """

    status: str = ""
    ra_deg: float | None = None
    dec_deg: float | None = None
    roll_deg: float | None = None
    fov_deg: float | None = None
    matches: int = 0
    rms_arcsec: float | None = None


def solve(
    path: str | Path,
    *,
    fov_deg: float | None = None,
    camera: str | Path | None = None,
    time_utc: datetime.datetime | None = None,
) -> PlateSolution:
    """Solve the attitude of an image file of the sky, lost in space. Public as `skysim.solve`.

    fov_deg  : horizontal field of view to 5 %; 5 to 40 degrees are tried if neither it nor `camera` is given
    camera   : a scene, a camera file or an OpenCV calibration in place of fov_deg
    time_utc : when the image was taken; the FITS header's date if left out

    Raises InputError with one line for an image that cannot be read.
    """
    solver = make_solver(fov_deg, Path(camera) if camera else None, time_utc=time_utc)
    result = solve_file(Path(path), solver, None)
    if result["bad_input"]:
        raise InputError(result["status"])
    return PlateSolution(**{name.name: result[name.name] for name in fields(PlateSolution)})


def solve_file(path: Path, solver: Solver, annotated: Path | None) -> dict[str, Any]:
    """Solve one file and return the fields of `skysim solve --json`. Writes the annotated PNG if `annotated` is given.

    An unreadable image does not raise, so that the files after it are still solved: its error line becomes `status`,
    and `bad_input` is true (for the exit code). `warning` says why the header's date was ignored, if it was.
    """
    result: dict[str, Any] = {"file": str(path), **asdict(PlateSolution()), "time_ms": None, "warning": ""}
    begin = time.perf_counter()
    try:
        image = images.read_image(path)
        check_image(path, image, solver)
        image = images.monochrome(image)
        check_size(image)
        date_utc, warning = validated_date(images.read_date_obs(path))
        if warning and not solver.time_utc:
            result["warning"] = f"{path}: DATE-OBS {warning}: ignored"
        report, tracker = solve_array(image, solver, date_utc)
    except (InputError, ImageError) as error:
        message = str(error)
        result["status"] = message if message.startswith(str(path)) else f"{path}: {message}"
        return result | {"bad_input": True}
    result["time_ms"] = 1e3 * (time.perf_counter() - begin)
    result |= {"status": report.attitude.status, "bad_input": False}
    if report.attitude.solved:
        result |= solution_fields(report)
    if annotated:
        files.write_image(annotated, annotated_image(image, report, tracker))
    return result


def solve_array(image: NDArray, solver: Solver, date_utc: datetime.datetime | None) -> tuple[Report, StarTracker]:
    """Solve one monochrome image and return the report and the tracker that made it. date_utc : None if unknown."""
    height_px, width_px = image.shape
    first = next(solver.trackers(width_px, height_px, date_utc))
    if solver.camera or solver.opencv_calibration or solver.fov_deg:
        return first.solve(image), first
    clock = Clock()
    centroids = detect_and_centroid(image, first.camera, solver.settings, clock)  # of the camera only the size is used
    for effort in range(first.efforts):  # try all fields of view quickly before trying any thoroughly
        trackers = solver.trackers(width_px, height_px, date_utc)
        attitude, tracker = best_attitude(centroids, trackers, clock, effort)
        if attitude.solved:
            break
    return Report(attitude, centroids, clock.seconds), tracker


def best_attitude(
    centroids: Centroids, trackers: Iterator[StarTracker], clock: Clock, effort: int
) -> tuple[Attitude, StarTracker]:
    """Return the most significant attitude among those of trackers with different fields of view, and its tracker.

    The accepted probability of chance is divided by the number of trackers. The best attitude must also beat every
    different attitude by `margin_dex`; otherwise the result is NO_MATCH.
    """
    solutions: list[tuple[Attitude, StarTracker]] = []
    for tracker in trackers:
        attitude = tracker.solve_centroids(centroids, clock, effort)
        if log10_chance(attitude) <= FIELD_SEARCH.decisive_log10_chance:
            return attitude, tracker
        if attitude.solved:
            solutions.append((attitude, tracker))
    if not solutions:
        return attitude, tracker
    best, best_tracker = min(solutions, key=lambda solution: log10_chance(solution[0]))
    # The same attitude from neighboring trackers, whose ranges overlap, is no rival.
    rivals = [log10_chance(other) for other, _ in solutions if not same_attitude(other, best)]
    threshold = ACCEPT_LOG10_CHANCE - math.log10(FIELD_SEARCH.trackers)  # Bonferroni correction
    significant = log10_chance(best) <= min(threshold, min(rivals, default=0.0) - FIELD_SEARCH.margin_dex)
    return (best if significant else Attitude(NO_MATCH)), best_tracker


def log10_chance(attitude: Attitude) -> float:
    """log10 of the probability that the match is due to chance; 0 without a match."""
    return attitude.match.log10_chance if attitude.match else 0.0


def same_attitude(first: Attitude, second: Attitude) -> bool:
    """Return True if two solved attitudes differ by less than `same_attitude_rad`."""
    assert first.cam_from_ref is not None
    assert second.cam_from_ref is not None
    return bool((first.cam_from_ref * second.cam_from_ref.inv()).magnitude() < FIELD_SEARCH.same_attitude_rad)


def check_image(path: Path, image: NDArray, solver: Solver) -> None:
    """Check the image's size against the known camera, and for a scene's camera also its channels and bit depth.

    Raises InputError if the image cannot come from this camera.
    """
    camera = solver.camera
    if camera and image.ndim != 2:
        raise InputError(f"{path}: a color image of shape {image.shape}; this camera's are monochrome")
    if camera and image.dtype == np.uint8 and camera.detector.bits > 8:
        bits = camera.detector.bits
        raise InputError(f"{path}: an 8-bit image; this camera's have {bits} bits, in 16-bit FITS, PNG or TIFF")
    sensor = camera or solver.opencv_calibration
    if sensor and image.shape[:2] != (sensor.height_px, sensor.width_px):
        size = f"{image.shape[1]}x{image.shape[0]}"
        raise InputError(f"{path}: {size} pixels; this camera's are {sensor.width_px}x{sensor.height_px}")


def solution_fields(report: Report) -> dict[str, Any]:
    """Fields of a solved image for the JSON output; the angles are those of the image center."""
    attitude = report.attitude
    assert attitude.cam_from_ref is not None
    assert attitude.match is not None
    camera = attitude.camera
    assert camera is not None
    ra, dec, roll = np.degrees(ra_dec_roll_rad(center_from_cam(camera) * attitude.cam_from_ref))
    return {
        "ra_deg": float(ra),
        "dec_deg": float(dec),
        "roll_deg": float(roll),
        "fov_deg": float(np.degrees(camera.fov_rad)),
        "matches": len(attitude.match.observed),
        "rms_arcsec": float(np.degrees(attitude.rms_px / camera.focal_px) * 3600),
    }


def center_from_cam(camera: Camera) -> Rotation:
    """Rotation from the camera frame into a frame with z along the ray of the image center and y along image down.

    The principal point need not be the image center, so the camera's own boresight is not used. The down direction
    comes from the ray of the pixel one row below, made orthogonal to z.
    """
    center = np.array([(camera.width_px - 1) / 2, (camera.height_px - 1) / 2])
    z, below = camera.rays(np.array([center, [center[0], center[1] + 1]]))
    x = np.cross(below - z, z)
    x /= np.linalg.norm(x)
    return Rotation.from_matrix(np.array([x, np.cross(z, x), z]))


def annotated_image(image: NDArray, report: Report, tracker: StarTracker) -> NDArray[np.uint8]:
    """The image annotated with detections, matched stars and their Hipparcos numbers."""
    match, detected_px = report.attitude.match, report.centroids.xy_px
    if match is None:
        return annotate(image, detected_px, np.empty((0, 2)))
    names = [f"HIP {tracker.stars.id[star]}" for star in match.star]
    return annotate(image, detected_px, detected_px[match.observed], names)
