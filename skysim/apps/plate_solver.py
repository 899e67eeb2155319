"""Plate solver: right ascension, declination and roll of image files from any camera, lost in space.

If the field of view is known (a camera file, an OpenCV calibration or `--fov`), one `StarTracker` solves the image.
If it is unknown, 5 to 40 degrees are split into TRACKERS overlapping ranges of focal length in geometric
progression, each searched by a tracker that fits the focal length within its range. The image's stars are detected
once; all trackers are tried with little effort before any is tried with more. The solution with the lowest
probability of being due to chance is accepted only if it is significant after division of the significance level by
the number of trackers (Bonferroni), and if it beats every solution elsewhere on the sky by MARGIN_DEX.
"""

from __future__ import annotations

import datetime
import math
import time
from collections.abc import Iterator, Mapping
from dataclasses import dataclass, field, fields, replace
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from estimator.attitude.solvers import SOLVERS
from estimator.catalog import catalog
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
from skysim.core.errors import InputError
from skysim.core.paths import CATALOGUES
from skysim.core.units import require_member
from skysim.results import report
from skysim.scene import loader, scene
from skysim.scene import opencv_calibration as opencv
from skysim.scene.camera import CameraConfig as CameraPart
from skysim.tracking.onboard_model import calibration

CALIBRATED_UNCERTAINTY = (
    0.003  # relative; an OpenCV chessboard calibration gives the focal length to about 0.1 %
)
FOV_UNCERTAINTY = 0.055  # relative; the 5 % that the user is asked for, plus 0.5 % for how it was measured
PHOTO_EPOCH = datetime.datetime(2020, 1, 1, 12)

# Horizontal fields of view searched if none is given, and the number of trackers that share the range. The ranges are
# wide because one index of star pairs serves fields 1.5 times as wide, and a search takes as long for a narrow range.
WIDEST_DEG, NARROWEST_DEG = 40.0, 5.0
TRACKERS = 5
OVERLAP = 0.01  # of the focal length
DECISIVE_LOG10_CHANCE = -10.0  # a solution below this ends the search without trying other fields of view
MARGIN_DEX = 3.0  # by which a solution must beat those with another attitude
SAME_RAD = math.radians(0.2)

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
    built    : cache of the trackers for the last image size and time
    """

    fov_deg: float | None
    camera: CameraPart | None
    stars: catalog.StarCatalog
    settings: Settings
    time_utc: datetime.datetime | None = None
    calibrated: opencv.Calibration | None = None
    built: dict[Any, dict[Camera, StarTracker]] = field(default_factory=dict, compare=False, repr=False)

    def beliefs(self, width_px: int, height_px: int) -> list[tuple[Camera, float]]:
        """Cameras to try for this image size, each with its relative focal-length uncertainty, the likeliest first."""
        if self.camera:
            return [(calibration(self.camera), 0.0)]
        if self.calibrated:
            told = self.calibrated
            camera = Camera(told.width_px, told.height_px, told.focal_px, told.centre_px, told.distortion)
            return [(camera, CALIBRATED_UNCERTAINTY)]
        if self.fov_deg:
            return [(Camera.from_fov(width_px, height_px, math.radians(self.fov_deg)), FOV_UNCERTAINTY)]
        widest, narrowest = (math.tan(math.radians(deg) / 2) for deg in (WIDEST_DEG, NARROWEST_DEG))
        ratio = (widest / narrowest) ** (1 / TRACKERS)
        from_middle_out = sorted(range(TRACKERS), key=lambda n: abs(n - (TRACKERS - 1) / 2))
        # A tracker of focal length f covers f (1 - u) to f (1 + u): u = (ratio - 1) / (ratio + 1) makes neighbors meet.
        uncertainty = (ratio - 1) / (ratio + 1)
        # Half-field tangents: range n begins at widest / ratio^n, where the focal length is f (1 - u).
        tangents = [widest / ratio**n * (1 - uncertainty) for n in from_middle_out]
        return [
            (Camera.from_fov(width_px, height_px, 2 * math.atan(tangent)), uncertainty + OVERLAP)
            for tangent in tangents
        ]

    def trackers(
        self, width_px: int, height_px: int, taken: datetime.datetime | None
    ) -> Iterator[StarTracker]:
        """Yield the trackers for an image of this size and date: one, or one per range of fields of view.

        Trackers are built when first needed and cached until an image of another size or date comes.
        """
        taken = self.time_utc or taken
        if (width_px, height_px, taken) not in self.built:
            self.built.clear()  # keep the trackers of one image size and date only
        ready = self.built.setdefault((width_px, height_px, taken), {})
        for believed, uncertainty in self.beliefs(width_px, height_px):
            if believed not in ready:
                vectors = (
                    catalog.apparent(self.stars, catalog.on_earth(taken))
                    if taken
                    else catalog.at_epoch(self.stars, PHOTO_EPOCH.year)
                )
                ready[believed] = StarTracker(believed, self.stars, vectors, self.settings, uncertainty)
            yield ready[believed]


def named_scene(path: Path) -> Path:
    """Return the file's path, or that of the shipped scene of this name. Raises InputError with the allowed names."""
    return path if path.suffix or path.exists() else loader.find(str(path))


def make_solver(
    fov_deg: float | None,
    camera_file: Path | None,
    catalogue: str = "hipparcos_hp6.5",
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
    time_utc, doubt = believable(time_utc)
    if doubt:
        raise InputError(f"--time: {doubt}")
    named = {stage: known(stage, name) for stage, name in (stages or {}).items()}
    calibrated = opencv.read(camera_file) if camera_file and opencv.is_one(camera_file) else None
    camera = loader.load_camera(named_scene(camera_file)) if camera_file and not calibrated else None
    settings = Settings()
    if camera:
        settings = Settings(gain_e_dn=camera.detector.gain_e_dn, saturation=saturation_dn(camera.detector))
    settings = replace(settings, **named)  # type: ignore[arg-type]
    try:
        stars = catalog.read(CATALOGUES / f"{catalogue}.ecsv")
    except ImageError as error:
        raise InputError(f"{error}; make it with: skysim catalog build") from None
    return Solver(fov_deg, camera, stars, settings, time_utc, calibrated)


def believable(taken: datetime.datetime | None) -> tuple[datetime.datetime | None, str]:
    """Return (date in UTC, ""), or (None, reason) for a date outside the supported range; (None, "") without a date."""
    try:
        return (scene.in_our_time(taken) if taken else None), ""
    except ValueError as error:
        return None, str(error)


def known(stage: str, name: str) -> str:
    """Return the name if the stage has such an algorithm. Raises InputError with the allowed names."""
    try:
        return require_member(name, STAGES[stage])
    except ValueError as error:
        raise InputError(f"--{stage}: {error}") from None


@dataclass(frozen=True, slots=True)
class PlateSolution:
    """Pointing of an image; the angles are None unless `status` is solved.

    ra_deg, dec_deg : of the image center, ICRS;  roll_deg : position angle of the image's up, north through east
    fov_deg         : fitted horizontal field of view
    matches         : number of identified stars;  rms_arcsec : rms of their residuals
    """

    status: str
    ra_deg: float | None
    dec_deg: float | None
    roll_deg: float | None
    fov_deg: float | None
    matches: int
    rms_arcsec: float | None


def solve_image(
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
    answer = solve(
        Path(path), make_solver(fov_deg, Path(camera) if camera else None, time_utc=time_utc), None
    )
    if answer["bad_input"]:
        raise InputError(answer["status"])
    return PlateSolution(**{name.name: answer[name.name] for name in fields(PlateSolution)})


def solve(path: Path, solver: Solver, annotated: Path | None) -> dict[str, Any]:
    """Solve one file and return the fields of `skysim solve --json`. Writes the annotated PNG if `annotated` is given.

    An unreadable image does not raise, so that the files after it are still solved: its error line becomes `status`,
    and `bad_input` is true (for the exit code). `doubt` says why the header's date was ignored, if it was.
    """
    answer: dict[str, Any] = {
        "file": str(path),
        "status": "",
        "ra_deg": None,
        "dec_deg": None,
        "roll_deg": None,
        "fov_deg": None,
        "matches": 0,
        "rms_arcsec": None,
        "time_ms": None,
        "doubt": "",
    }
    begin = time.perf_counter()
    try:
        image = images.read_image(path)
        check(path, image, solver)
        image = images.monochrome(image)
        check_size(image)
        taken, doubt = believable(images.date_of(path))
        if doubt and not solver.time_utc:
            answer["doubt"] = f"{path}: DATE-OBS {doubt}: left out"
        found, tracker = look(image, solver, taken)
    except (InputError, ImageError) as error:
        message = str(error)
        answer["status"] = message if message.startswith(str(path)) else f"{path}: {message}"
        return answer | {"bad_input": True}
    answer["time_ms"] = 1e3 * (time.perf_counter() - begin)
    answer |= {"status": found.attitude.status, "bad_input": False}
    if found.attitude.solved:
        answer |= solution(found)
    if annotated:
        files.write_image(annotated, picture(image, found, tracker))
    return answer


def look(image: NDArray, solver: Solver, taken: datetime.datetime | None) -> tuple[Report, StarTracker]:
    """Solve one monochrome image and return the report and the tracker that made it. taken : UTC, if known."""
    height_px, width_px = image.shape
    first = next(solver.trackers(width_px, height_px, taken))
    if solver.camera or solver.calibrated or solver.fov_deg:
        return first.solve(image), first
    clock = Clock()
    centroids = detect_and_centroid(
        image, first.camera, solver.settings, clock
    )  # detection uses the camera's size only
    for effort in range(first.efforts):  # try all fields of view quickly before trying any thoroughly
        attitude, tracker = sought(centroids, solver.trackers(width_px, height_px, taken), clock, effort)
        if attitude.solved:
            break
    return Report(attitude, centroids, clock.seconds), tracker


def sought(
    centroids: Centroids, trackers: Iterator[StarTracker], clock: Clock, effort: int
) -> tuple[Attitude, StarTracker]:
    """Return the most significant attitude among those of trackers with different fields of view, and its tracker.

    Each tracker is one more opportunity for a false match, so the accepted probability of chance is divided by
    TRACKERS. The best attitude must also beat every different attitude by MARGIN_DEX; otherwise the result is NO_MATCH.
    """
    found: list[tuple[Attitude, StarTracker]] = []
    for tracker in trackers:
        attitude = tracker.solve_centroids(centroids, clock, effort)
        if log10_chance(attitude) <= DECISIVE_LOG10_CHANCE:
            return attitude, tracker
        if attitude.solved:
            found.append((attitude, tracker))
    if not found:
        return attitude, tracker
    best, its = min(found, key=lambda one: log10_chance(one[0]))
    # The same attitude found by neighboring trackers, whose ranges overlap, is no rival.
    rivals = [log10_chance(one) for one, _ in found if not alike(one, best)]
    share = ACCEPT_LOG10_CHANCE - math.log10(TRACKERS)  # Bonferroni correction for TRACKERS searches
    beyond = log10_chance(best) <= min(share, min(rivals, default=0.0) - MARGIN_DEX)
    return (best if beyond else Attitude(NO_MATCH)), its


def log10_chance(attitude: Attitude) -> float:
    """log10 of the probability that the match is due to chance; 0 without a match."""
    return attitude.match.log10_chance if attitude.match else 0.0


def alike(one: Attitude, other: Attitude) -> bool:
    """Return True if two solved attitudes differ by less than SAME_RAD."""
    assert one.cam_from_ref is not None
    assert other.cam_from_ref is not None
    return bool((one.cam_from_ref * other.cam_from_ref.inv()).magnitude() < SAME_RAD)


def check(path: Path, image: NDArray, solver: Solver) -> None:
    """Check the image's size against the known camera, and for a scene's camera also its channels and bit depth.

    Raises InputError if the image cannot come from this camera.
    """
    camera = solver.camera
    if camera and image.ndim != 2:
        raise InputError(f"{path}: a colour image of shape {image.shape}; this camera's are monochrome")
    if camera and image.dtype == np.uint8 and camera.detector.bits > 8:
        bits = camera.detector.bits
        raise InputError(
            f"{path}: an 8-bit image; this camera's have {bits} bits, in 16-bit FITS, PNG or TIFF"
        )
    known_size = camera or solver.calibrated
    if known_size and image.shape[:2] != (known_size.height_px, known_size.width_px):
        size = f"{image.shape[1]}x{image.shape[0]}"
        raise InputError(
            f"{path}: {size} pixels; this camera's are {known_size.width_px}x{known_size.height_px}"
        )


def solution(found: Report) -> dict[str, Any]:
    """Fields of a solved image for the JSON output; the angles are those of the image center."""
    attitude = found.attitude
    assert attitude.cam_from_ref is not None
    assert attitude.match is not None
    camera = attitude.camera
    assert camera is not None
    ra, dec, roll = np.degrees(ra_dec_roll_rad(at_middle(camera) * attitude.cam_from_ref))
    return {
        "ra_deg": float(ra),
        "dec_deg": float(dec),
        "roll_deg": float(roll),
        "fov_deg": float(np.degrees(camera.fov_rad)),
        "matches": len(attitude.match.observed),
        "rms_arcsec": float(np.degrees(attitude.rms_px / camera.focal_px) * 3600),
    }


def at_middle(camera: Camera) -> Any:
    """Rotation middle_from_cam into a frame with z along the ray of the image center and y along the image's down.

    The principal point need not be the image center, so the camera's own boresight is not used. The down direction
    comes from the ray of the pixel one row below, made orthogonal to z.
    """
    from scipy.spatial.transform import Rotation

    middle = np.array([(camera.width_px - 1) / 2, (camera.height_px - 1) / 2])
    sight, below = camera.rays(np.array([middle, [middle[0], middle[1] + 1]]))
    across = np.cross(below - sight, sight)
    across /= np.linalg.norm(across)
    return Rotation.from_matrix(np.array([across, np.cross(sight, across), sight]))


def picture(image: NDArray, found: Report, tracker: StarTracker) -> NDArray[np.uint8]:
    """The image annotated with detections, matched stars and their Hipparcos numbers."""
    match = found.attitude.match
    seen = found.centroids.xy_px
    if match is None:
        return report.annotate(image, seen, np.empty((0, 2)))
    names = [f"HIP {tracker.stars.id[star]}" for star in match.star]
    return report.annotate(image, seen, seen[match.observed], names)
