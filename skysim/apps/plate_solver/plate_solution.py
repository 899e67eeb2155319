"""What a solved plate says: pointing, attitude, lens, matched stars; as fields, as a table, and as a FITS header."""

from collections.abc import Iterable, Sequence
from datetime import datetime
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from estimator.catalog.catalog import StarCatalog
from estimator.core.camera import Camera
from estimator.core.types import Attitude, ra_dec_roll_rad
from estimator.trackers.pipeline import Report
from estimator.trackers.star_tracker import StarTracker
from skysim.core.errors import InputError
from skysim.core.types import Floats, Record, frozen

NOTED_STRETCH = 0.002  # relative to square pixels
PIXEL_KEYS = ("x_px", "y_px", "residual_x_px", "residual_y_px")
STAR_KEYS = ("ra_deg", "dec_deg", "v_mag", *PIXEL_KEYS)


@frozen
class PlateSolution:
    """Pointing of a picture in the orientation in which it is viewed; the angles are None unless `status` is solved.

    Attributes
    ----------
    ra_deg, dec_deg
        Right ascension and declination of the image center, ICRS
    roll_deg
        Position angle of the image's up, north through east
    fov_deg
        Fitted horizontal field of view
    cam_from_icrs_xyzw
        Attitude as a quaternion, scalar last; camera axes are x right, y down, z along the principal point's ray
    covariance_rad2
        3 rows of the covariance of the small rotation about the camera axes
    focal_px, center_px, distortion
        Fitted camera: focal length along x, principal point, and k1, k2, p1, p2, k3 in OpenCV's order
    pixel_aspect
        Width over height of a pixel
    log10_chance
        Logarithm of the expected number of equally good chance matches
    matches
        Number of identified stars
    rms_arcsec
        Rms of their residuals
    stars
        The identified stars, brightest light first: name, RA and Dec (catalog's epoch), V magnitude, pixel, residual
        (measured minus expected)
    lights
        Number of detections that may be stars
    brightest_dn, background_dn
        Maximum and median of the pixels; None of a list
    tried_fov_deg
        Narrowest and widest horizontal field of each range that was tried, the likeliest first
    catalog_limit_mag
        V magnitude of the faintest stars of the catalog
    hint
        Likely cause of a refusal and a remedy, or an assumption about a solved file
    """

    status: str = ""
    ra_deg: float | None = None
    dec_deg: float | None = None
    roll_deg: float | None = None
    fov_deg: float | None = None
    cam_from_icrs_xyzw: tuple[float, ...] | None = None
    covariance_rad2: tuple[tuple[float, ...], ...] | None = None
    focal_px: float | None = None
    center_px: tuple[float, float] | None = None
    distortion: tuple[float, ...] | None = None
    pixel_aspect: float | None = None
    log10_chance: float | None = None
    matches: int = 0
    rms_arcsec: float | None = None
    stars: tuple[Record, ...] = ()
    lights: int = 0
    brightest_dn: float | None = None
    background_dn: float | None = None
    tried_fov_deg: tuple[tuple[float, float], ...] = ()
    catalog_limit_mag: float | None = None
    hint: str = ""


def picture_fields(report: Report, pixels: NDArray) -> Record:
    """The status, the number of lights and the image statistics of a picture, solved or not."""
    return {
        "status": report.attitude.status,
        "lights": len(report.centroids),
        "brightest_dn": float(pixels.max()),
        "background_dn": float(np.median(pixels)),
    }


def light_rows(names: Iterable[str], keys: Sequence[str], *columns: Floats) -> list[Record]:
    """A row for each matched light: its name, and its numbers by their keys."""
    rows = np.column_stack(columns).tolist()
    return [
        {"name": name} | dict(zip(keys, row, strict=True))
        for name, row in zip(names, rows, strict=True)
    ]


def solution_fields(report: Report) -> Record:
    """Pointing of a solved image; the angles are those of the image center."""
    attitude = report.attitude
    assert attitude.cam_from_ref is not None
    assert attitude.match is not None
    camera = attitude.camera
    assert camera is not None
    ra, dec, roll = np.degrees(
        ra_dec_roll_rad(center_from_cam(camera) * attitude.cam_from_ref)
    )
    return {
        "ra_deg": float(ra),
        "dec_deg": float(dec),
        "roll_deg": float(roll),
        "fov_deg": float(np.degrees(camera.fov_rad)),
        "matches": len(attitude.match.observed),
        "rms_arcsec": float(np.degrees(attitude.rms_px / camera.focal_px) * 3600),
    }


def attitude_fields(report: Report, tracker: StarTracker, stars: StarCatalog) -> Record:
    """Attitude, covariance, lens and stars of a solved image. stars : the catalog of the tracker, at its epoch"""
    attitude = report.attitude
    match = attitude.match
    camera = attitude.camera
    assert attitude.cam_from_ref is not None
    assert attitude.covariance_rad2 is not None
    assert match is not None
    assert camera is not None
    star = match.star
    xy_px = report.centroids.xy_px[match.observed]
    # Measured minus expected.
    residual_px = xy_px - camera.pixels(
        attitude.cam_from_ref.apply(tracker.stars.vectors[star])
    )
    # The tracker's directions are apparent; the table has the catalog's.
    by_id = np.argsort(stars.id)
    x, y, z = stars.vectors[
        by_id[np.searchsorted(stars.id, tracker.stars.id[star], sorter=by_id)]
    ].T
    sky = (
        np.degrees(np.arctan2(y, x)) % 360,
        np.degrees(np.arcsin(z)),
        tracker.stars.v_mag[star],
    )
    names = map(star_name, tracker.stars.id[star].tolist())
    xyzw = attitude.cam_from_ref.as_quat(canonical=True)
    return {
        "cam_from_icrs_xyzw": tuple(xyzw.tolist()),
        "covariance_rad2": tuple(map(tuple, attitude.covariance_rad2.tolist())),
        "focal_px": camera.focal_px,
        "center_px": camera.center_px,
        "distortion": camera.distortion,
        "pixel_aspect": camera.aspect,
        "log10_chance": match.log10_chance,
        "stars": tuple(light_rows(names, STAR_KEYS, *sky, xy_px, residual_px)),
    }


def camera_notes(fitted: Camera, tracker: StarTracker) -> list[str]:
    """What a fitted camera has that was not given: pixels that are not square, a field outside of its bounds."""
    notes = []
    if abs(fitted.aspect / tracker.camera.aspect - 1) > NOTED_STRETCH:
        notes.append(f"pixel aspect {fitted.aspect:.3f} (width over height)")
    wider = fitted.fov_rad / tracker.camera.fov_rad - 1
    if abs(wider) > tracker.focal_uncertainty:
        notes.append(f"the field differs by {100 * wider:+.1f} % from the one given")
    return notes


def star_name(number: int) -> str:
    """Name of a star by its number in a catalog of skysim (see `skysim.sources.catalog.Catalog`)."""
    millions, rest = divmod(number, 1_000_000)
    return f"{('HIP', 'HD', 'Gaia')[min(millions, 2)]} {rest}"


def wcs_header(attitude: Attitude, flipped: bool) -> Any:
    """The FITS header of a solved image (`wcs.header`), for the rows as its file stores them.

    Turned upside down, a row y is H - 1 - y: the column of CD for y and the odd powers of y change their signs.

    Parameters
    ----------
    flipped
        Whether the file's first row is the lowest of the image that was solved
    """
    from astropy.io.fits import Header

    from skysim.camera import wcs
    from skysim.scene.opencv_calibration import OpencvCalibration

    camera = attitude.camera
    assert camera is not None
    assert attitude.cam_from_ref is not None
    size_px = camera.width_px, camera.height_px
    lens = OpencvCalibration(*size_px, camera.focal_px, camera.center_px, camera.distortion)
    cards = wcs.header(lens, attitude.cam_from_ref)
    # From square pixels to the camera's: y is longer by the aspect.
    for name in cards:
        if name in ("CD1_2", "CD2_2"):
            cards[name] /= camera.aspect
        elif name[0] in "AB" and name[-1].isdigit():
            cards[name] *= camera.aspect ** (name.startswith("B") - int(name[-1]))
    if flipped:
        cards["CRPIX2"] = camera.height_px + 1 - cards["CRPIX2"]
        for name in cards:
            odd = name.startswith(("A_", "AP_", "B_", "BP_")) and name[-1] in "13579"
            down = name.startswith(("B_", "BP_")) and name[-1].isdigit()
            if name in ("CD1_2", "CD2_2") or odd != down:
                cards[name] = -cards[name]
    rows = "BOTTOM-UP" if flipped else "TOP-DOWN"
    cards |= {"IMAGEW": camera.width_px, "IMAGEH": camera.height_px, "ROWORDER": rows}
    header = Header(list(cards.items()))
    header["COMMENT"] = "apparent directions in ICRS axes, by skysim solve"
    return header


def add_rates(results: list[Record], rate_hz: float | None) -> None:
    """Add to the results of one camera's images, in the order of time, `t_s` and the rate since the last solved one.

    The rate is the vector of the shortest rotation between the two, over their time, in camera axes.

    Parameters
    ----------
    rate_hz
        Frame rate; None: the times are the dates of the images

    Raises
    ------
    InputError
        For an image without a date, or one that is not after the image before it.
    """
    dates = [one["date_utc"] for one in results]
    if rate_hz is None and None in dates:
        raise InputError(
            results[dates.index(None)]["file"],
            "no date",
            "DATE-OBS in its header, or a frame rate",
        )
    last: Record | None = None
    for n, one in enumerate(results):
        if rate_hz is None:
            since = datetime.fromisoformat(dates[n]) - datetime.fromisoformat(dates[0])
            one["t_s"] = since.total_seconds()
        else:
            one["t_s"] = n / rate_hz
        if n and one["t_s"] <= results[n - 1]["t_s"]:
            raise InputError(
                one["file"],
                "its date is not after that of the image before it",
                "the order of time",
            )
        one["rate_deg_s"] = None
        if quaternion_of(one) is None:
            continue
        if last is not None:
            first = Rotation.from_quat(quaternion_of(last))
            second = Rotation.from_quat(quaternion_of(one))
            turn_rad = (first * second.inv()).as_rotvec()
            one["rate_deg_s"] = np.degrees(turn_rad / (one["t_s"] - last["t_s"])).tolist()
        last = one


def quaternion_of(result: Record) -> Any:
    """The camera's attitude in the sky or in a dome, None of a refusal."""
    return result["cam_from_lab_xyzw" if "leds" in result else "cam_from_icrs_xyzw"]


def sequence_summary(results: list[Record]) -> str:
    """A sentence on a sequence: solved images, gaps, rate."""
    solved = [quaternion_of(one) is not None for one in results]
    edges = np.flatnonzero(np.diff([True, *solved, True]))
    gaps = [
        results[min(end, len(results) - 1)]["t_s"] - results[max(begin - 1, 0)]["t_s"]
        for begin, end in edges.reshape(-1, 2)
    ]
    rates = [np.linalg.norm(one["rate_deg_s"]) for one in results if one["rate_deg_s"]]
    text = f"{sum(solved)} of {len(results)} solved over {results[-1]['t_s']:.6g} s"
    text += (
        f"; {len(gaps)} gaps without an attitude, the longest {max(gaps):.3g} s"
        if gaps
        else "; no gap"
    )
    return text + (
        f"; rate median {np.median(rates):.4g} °/s, largest {max(rates):.4g} °/s"
        if rates
        else ""
    )


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
