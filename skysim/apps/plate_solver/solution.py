"""The solution of a plate: its fields for Python and JSON, and the annotated image."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from estimator.core.camera import Camera
from estimator.core.types import ra_dec_roll_rad
from estimator.trackers.pipeline import Report
from estimator.trackers.star_tracker import StarTracker


@dataclass(frozen=True, slots=True)
class PlateSolution:
    """Pointing of a picture as it is viewed; the angles are None unless `status` is solved.

    ra_deg, dec_deg : of the image center, ICRS;  roll_deg : position angle of the image's up, north through east
    fov_deg         : fitted horizontal field of view
    matches         : number of identified stars;  rms_arcsec : rms of their residuals
    lights          : number of detections that may be stars
    brightest_dn, background_dn : maximum and median of the pixels
    tried_fov_deg   : narrowest and widest horizontal field of each range that was tried, the likeliest first
    catalog_limit_mag : V magnitude of the faintest stars of the catalog
    hint            : of a refusal, the likely cause and what to do; of a solution, an assumption about the file
    """

    status: str = ""
    ra_deg: float | None = None
    dec_deg: float | None = None
    roll_deg: float | None = None
    fov_deg: float | None = None
    matches: int = 0
    rms_arcsec: float | None = None
    lights: int = 0
    brightest_dn: float | None = None
    background_dn: float | None = None
    tried_fov_deg: tuple[tuple[float, float], ...] = ()
    catalog_limit_mag: float | None = None
    hint: str = ""


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
    """The image annotated with detections, matched stars and their numbers."""
    from skysim.results.annotate import annotate

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
