"""Images from files, of any camera, to right ascension, declination and roll, or a refusal."""

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
from estimator.trackers.pipeline import Clock, Report, Settings, see
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
    0.003  # of a focal length by OpenCV: a chessboard's is good to a part in a thousand or so
)
FOV_UNCERTAINTY = 0.055  # "to 5 %", with half a per cent for how people measure it
PHOTO_EPOCH = datetime.datetime(2020, 1, 1, 12)

# Where nobody tells the field of view: horizontal, and how many trackers share it, each a range of focal lengths. Wide
# ranges, as the index of a field serves another 1.5 times as wide, and a search takes its time however wide.
WIDEST_DEG, NARROWEST_DEG = 40.0, 5.0
TRACKERS = 5
OVERLAP = 0.01  # of the focal length
DECISIVE_LOG10_CHANCE = -10.0  # beyond which no other field of view is looked at
MARGIN_DEX = 3.0  # by which an answer must beat one elsewhere
SAME_RAD = math.radians(0.2)

STAGES: dict[str, Mapping[str, object]] = {
    "detector": DETECTORS,
    "centroider": CENTROIDERS,
    "identifier": IDENTIFIERS,
    "solver": SOLVERS,
}


@dataclass(frozen=True, slots=True)
class Solver:
    """How to look at images: a field of view known to 5 %, a camera known exactly or by calibration, or neither: 5 to
    40 degrees.

    time_utc : when the pictures were taken; None takes each FITS file's own, or 2020, when aberration (20") is
        left out because it turns with the season.
    built    : the trackers for images of the last one's size and time
    """

    fov_deg: float | None
    camera: CameraPart | None
    stars: catalog.StarCatalog
    settings: Settings
    time_utc: datetime.datetime | None = None
    calibrated: opencv.Calibration | None = None
    built: dict[Any, dict[Camera, StarTracker]] = field(default_factory=dict, compare=False, repr=False)

    def beliefs(self, width_px: int, height_px: int) -> list[tuple[Camera, float]]:
        """Cameras to try on images of this size, and how uncertain the focal length of each is; the likeliest first."""
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
        # A tracker of focal length f finds those from f (1 - u) to f (1 + u), ratio times as long.
        uncertainty = (ratio - 1) / (ratio + 1)
        tangents = [widest / ratio**n * (1 - uncertainty) for n in from_middle_out]
        return [
            (Camera.from_fov(width_px, height_px, 2 * math.atan(tangent)), uncertainty + OVERLAP)
            for tangent in tangents
        ]

    def trackers(
        self, width_px: int, height_px: int, taken: datetime.datetime | None
    ) -> Iterator[StarTracker]:
        """The star trackers for an image of this size, taken then: one, or those that share the fields of view."""
        taken = self.time_utc or taken
        if (width_px, height_px, taken) not in self.built:
            self.built.clear()
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
    """The file, or the path of the shipped scene of that name. Raises InputError with the allowed names."""
    return path if path.suffix or path.exists() else loader.find(str(path))


def make_solver(
    fov_deg: float | None,
    camera_file: Path | None,
    catalogue: str = "hipparcos_hp6.5",
    time_utc: datetime.datetime | None = None,
    stages: Mapping[str, str] | None = None,
) -> Solver:
    """Check what the user gave; stages: names of algorithms by STAGES. Raises InputError with one line."""
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
    """A picture's date, if there is one for which we know the Earth's and the stars' motion, and else why not."""
    try:
        return (scene.in_our_time(taken) if taken else None), ""
    except ValueError as error:
        return None, str(error)


def known(stage: str, name: str) -> str:
    """The name, if there is such an algorithm."""
    try:
        return require_member(name, STAGES[stage])
    except ValueError as error:
        raise InputError(f"--{stage}: {error}") from None


@dataclass(frozen=True, slots=True)
class PlateSolution:
    """Where an image looks; the angles are None unless `status` is solved.

    ra_deg, dec_deg : of the image's middle, ICRS;  roll_deg : position angle of the image's up, north through east
    fov_deg         : horizontal field of view as fitted
    matches         : identified stars;  rms_arcsec : their residual
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
    """Attitude of an image file of the sky, lost in space. It is `skysim.solve`.

    fov_deg  : horizontal field of view to 5 %; 5 to 40 degrees are tried if neither it nor `camera` is given
    camera   : a scene, a camera file or OpenCV's calibration in place of fov_deg
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
    """One file to one answer: the fields of `skysim solve --json`. Writes the annotated PNG.

    Bad input does not raise here, for other files wait behind it: its line becomes the status, with
    `bad_input` true for the exit code. `doubt` is what of the header was not believed.
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
    """An image's answer, and the tracker whose it is."""
    height_px, width_px = image.shape
    first = next(solver.trackers(width_px, height_px, taken))
    if solver.camera or solver.calibrated or solver.fov_deg:
        return first.solve(image), first
    clock = Clock()
    centroids = see(image, first.camera, solver.settings, clock)  # of which only the camera's size counts
    for effort in range(first.efforts):  # a little at all fields of view before much at any
        attitude, tracker = sought(centroids, solver.trackers(width_px, height_px, taken), clock, effort)
        if attitude.solved:
            break
    return Report(attitude, centroids, clock.seconds), tracker


def sought(
    centroids: Centroids, trackers: Iterator[StarTracker], clock: Clock, effort: int
) -> tuple[Attitude, StarTracker]:
    """Of the attitudes that trackers of different fields of view find, the one beyond chance and beyond its rivals.

    Each field of view is one more occasion for a wrong answer, so each is allowed its share of the chance.
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
    rivals = [log10_chance(one) for one, _ in found if not alike(one, best)]
    share = ACCEPT_LOG10_CHANCE - math.log10(TRACKERS)
    beyond = log10_chance(best) <= min(share, min(rivals, default=0.0) - MARGIN_DEX)
    return (best if beyond else Attitude(NO_MATCH)), its


def log10_chance(attitude: Attitude) -> float:
    """Of the answer being due to chance; 0 where there is none."""
    return attitude.match.log10_chance if attitude.match else 0.0


def alike(one: Attitude, other: Attitude) -> bool:
    """Whether two answers are one."""
    assert one.cam_from_ref is not None
    assert other.cam_from_ref is not None
    return bool((one.cam_from_ref * other.cam_from_ref.inv()).magnitude() < SAME_RAD)


def check(path: Path, image: NDArray, solver: Solver) -> None:
    """A known camera makes frames of one size, a scene's of one channel and one depth; anything else is another's."""
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
    """The numbers of a solved image, at the image's middle."""
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
    """middle_from_cam: turns the boresight onto the image's middle, its y onto the image's down there."""
    from scipy.spatial.transform import Rotation

    middle = np.array([(camera.width_px - 1) / 2, (camera.height_px - 1) / 2])
    sight, below = camera.rays(np.array([middle, [middle[0], middle[1] + 1]]))
    across = np.cross(below - sight, sight)
    across /= np.linalg.norm(across)
    return Rotation.from_matrix(np.array([across, np.cross(sight, across), sight]))


def picture(image: NDArray, found: Report, tracker: StarTracker) -> NDArray[np.uint8]:
    """The image with what was seen and who it is."""
    match = found.attitude.match
    seen = found.centroids.xy_px
    if match is None:
        return report.annotate(image, seen, np.empty((0, 2)))
    names = [f"HIP {tracker.stars.id[star]}" for star in match.star]
    return report.annotate(image, seen, seen[match.observed], names)
