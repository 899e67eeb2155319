"""Images from files, of any camera, to right ascension, declination and roll, or a refusal."""

from __future__ import annotations

import datetime
import time
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from estimator import catalog
from estimator.attitude import radecroll_rad
from estimator.camera import Camera
from estimator.detect import check_size
from estimator.stages import Report, Settings
from estimator.tracker import StarTracker
from estimator.types import BadImage
from skysim import io, report, scene
from skysim.camera import Camera as CameraPart
from skysim.detector import saturation_dn
from skysim.onboard import calibration
from skysim.scene import CATALOGUES
from skysim.types import BadInput

FOV_UNCERTAINTY = 0.055  # "to 5 %", with half a per cent for how people measure it
PHOTO_EPOCH = datetime.datetime(2020, 1, 1, 12)


@dataclass(frozen=True, slots=True)
class Solver:
    """How to look at images: a field of view known to 5 %, or a camera known exactly.

    time_utc : when the pictures were taken; None takes each FITS file's own, or 2020, when aberration (20") is
        left out because it turns with the season.
    """

    fov_deg: float | None
    camera: CameraPart | None
    stars: catalog.StarList
    settings: Settings
    time_utc: datetime.datetime | None = None

    def tracker(self, image: NDArray, taken: datetime.datetime | None) -> StarTracker:
        """The star tracker for an image of this size, taken then."""
        height, width = image.shape
        taken = self.time_utc or taken
        vectors = (
            catalog.apparent(self.stars, catalog.on_earth(taken))
            if taken
            else catalog.at_epoch(self.stars, PHOTO_EPOCH.year)
        )
        if self.camera is None:
            believed = Camera.from_fov(width, height, float(np.radians(self.fov_deg or 0)))
            return StarTracker(believed, self.stars, vectors, self.settings, FOV_UNCERTAINTY)
        return StarTracker(calibration(self.camera), self.stars, vectors, self.settings)


def make_solver(
    fov_deg: float | None,
    camera_file: Path | None,
    catalogue: str = "hipparcos_hp6.5",
    time_utc: datetime.datetime | None = None,
) -> Solver:
    """Check what the user gave. Raises BadInput with one line."""
    if (fov_deg is None) == (camera_file is None):
        raise BadInput("give either --fov DEG or --camera FILE")
    if fov_deg is not None and not 1 <= fov_deg <= 120:
        raise BadInput(f"--fov {fov_deg:g}: allowed: the horizontal field of view, 1 to 120 degrees")
    camera = scene.load_camera(camera_file) if camera_file else None
    settings = Settings()
    if camera:
        settings = Settings(
            centroider="gaussian_fit",
            gain_e_dn=camera.detector.gain_e_dn,
            saturation=saturation_dn(camera.detector),
        )
    try:
        stars = catalog.read(CATALOGUES / f"{catalogue}.ecsv")
    except BadImage as error:
        raise BadInput(f"{error}; make it with: skysim catalog build") from None
    return Solver(fov_deg, camera, stars, settings, time_utc)


def solve(path: Path, solver: Solver, annotated: Path | None) -> dict[str, Any]:
    """One file to one answer: the fields of `skysim solve --json`. Writes the annotated PNG.

    Bad input does not raise here, for other files wait behind it: its line becomes the status, with
    `bad_input` true for the exit code.
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
    }
    begin = time.perf_counter()
    try:
        image = io.read_image(path)
        check(path, image, solver.camera)
        image = io.monochrome(image)
        check_size(image)
        tracker = solver.tracker(image, io.date_of(path))
        found = tracker.solve(image)
    except (BadInput, BadImage) as error:
        message = str(error)
        answer["status"] = message if message.startswith(str(path)) else f"{path}: {message}"
        return answer | {"bad_input": True}
    answer["time_ms"] = 1e3 * (time.perf_counter() - begin)
    answer |= {"status": found.attitude.status, "bad_input": False}
    if found.attitude.solved:
        answer |= solution(found)
    if annotated:
        io.write_image(annotated, picture(image, found, tracker))
    return answer


def check(path: Path, image: NDArray, camera: CameraPart | None) -> None:
    """A known camera makes frames of one size, one channel and one depth; anything else is another's."""
    if camera is None:
        return
    bits = camera.detector.bits
    if image.ndim != 2:
        raise BadInput(f"{path}: a colour image of shape {image.shape}; this camera's are monochrome")
    if image.dtype == np.uint8 and bits > 8:
        raise BadInput(f"{path}: an 8-bit image; this camera's have {bits} bits, in 16-bit FITS, PNG or TIFF")
    if image.shape != (camera.height_px, camera.width_px):
        size = f"{image.shape[1]}x{image.shape[0]}"
        raise BadInput(f"{path}: {size} pixels; this camera's are {camera.width_px}x{camera.height_px}")


def solution(found: Report) -> dict[str, Any]:
    """The numbers of a solved image, at the image's middle."""
    attitude = found.attitude
    assert attitude.cam_from_ref is not None
    assert attitude.match is not None
    camera = attitude.camera
    assert camera is not None
    ra, dec, roll = np.degrees(radecroll_rad(at_middle(camera) * attitude.cam_from_ref))
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
