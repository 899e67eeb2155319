"""What a solved plate says: pointing, attitude, lens, matched stars; as fields, as a table, and as a FITS header.

Pictures of a dome's LEDs: the attitude of each, lost in space, with the tracker of a scene.

The LEDs are those of the scene's list, or of a map that `skysim survey` measured. Unlike the tracker of `skysim run`,
this one has no simulated errors of survey and calibration: a real dome has its own. Their sizes, `tracker.survey` of
the scene or those of the map, are in the covariance.
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import replace
from datetime import datetime
from pathlib import Path
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np
from scipy.spatial.transform import Rotation

from estimator.attitude.dome_map import project
from estimator.catalog.catalog import StarCatalog
from estimator.core.camera import Camera
from estimator.core.types import Attitude, Centroids, ra_dec_roll_rad
from estimator.identification.chance import ACCEPT_LOG10_CHANCE, MIN_EVIDENCE_MATCHES
from estimator.identification.refusals import NO_MATCH
from estimator.trackers.pipeline import Report
from estimator.trackers.star_tracker import StarTracker
from skysim.apps.plate_solver import diagnosis
from skysim.apps.plate_solver.solver import KnownCamera
from skysim.core.constants import ARCSEC_RAD
from skysim.core.errors import InputError
from skysim.core.images import ASSUMED_TOP_DOWN, ViewedImage
from skysim.core.types import Array, Floats, Record, frozen

if TYPE_CHECKING:
    from estimator.trackers.dome_tracker import DomeTracker
    from skysim.scene.scene import Scene

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


def picture_fields(report: Report, pixels: Array) -> Record:
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


LED_KEYS = ("x_m", "y_m", "z_m", *PIXEL_KEYS)


@frozen
class DomeSolution:
    """Attitude of a picture of LEDs; the angles are None unless `status` is solved.

    Attributes
    ----------
    roll_deg, pitch_deg, yaw_deg
        Attitude of the vehicle in the dome (the angles of `motion` in a scene)
    cam_from_lab_xyzw
        Attitude of the camera as a quaternion, scalar last: from the dome's axes (lab) to camera axes, x right, y down,
        z along the principal point's ray. Its inverse turns camera axes to the dome's
    covariance_rad2
        3 rows of the covariance of the small rotation about the camera axes
    cross_sigma_arcsec, roll_sigma_arcsec
        Standard deviations across and about the boresight, from the covariance
    systematic_rad2
        The part of it that pictures with this map and camera share: errors of LEDs, lever and focal length; None if
        there is none
    log10_chance
        Logarithm of the expected number of equally good chance matches
    matches
        Number of identified LEDs
    rms_px
        Rms of the coordinates of their residuals
    leds
        The identified LEDs, brightest light first: number, place in the map, pixel, residual (measured minus expected)
    lights
        Number of detections that may be LEDs
    brightest_dn, background_dn
        Maximum and median of the pixels; None of a list
    hint
        Likely cause of a refusal and a remedy, or an assumption about a solved file
    """

    status: str = ""
    roll_deg: float | None = None
    pitch_deg: float | None = None
    yaw_deg: float | None = None
    cam_from_lab_xyzw: list[float] | None = None
    covariance_rad2: list[list[float]] | None = None
    cross_sigma_arcsec: float | None = None
    roll_sigma_arcsec: float | None = None
    systematic_rad2: list[list[float]] | None = None
    log10_chance: float | None = None
    matches: int = 0
    rms_px: float | None = None
    leds: Sequence[Record] = ()
    lights: int = 0
    brightest_dn: float | None = None
    background_dn: float | None = None
    hint: str = ""


class DomeSolver(NamedTuple):
    """Solver of pictures of one dome by one camera; it takes the place of a `Solver`.

    Attributes
    ----------
    tracker
        Lost-in-space tracker with the dome's map
    camera
        The camera of the pictures
    listed
        Number of LEDs that the scene has; a map may have fewer
    time_utc
        Not known
    """

    tracker: DomeTracker
    camera: KnownCamera
    listed: int
    time_utc: None = None


class DomeReading(NamedTuple):
    """A picture as it was read, and the tracker's report on it.

    Attributes
    ----------
    solver
        The solver of the report
    pixels
        The picture, the highest row first; blank for a list of lights
    assumption
        What was assumed to read it
    rows_known
        Whether the order of its rows is known; if not, both were tried
    """

    solver: DomeSolver
    pixels: Array
    report: Report
    assumption: str = ""
    rows_known: bool = True


def make_dome_solver(
    dome: str | Path,
    map_file: str | Path | None = None,
    stages: Mapping[str, str] | None = None,
) -> DomeSolver:
    """Build a DomeSolver from user input. Raises InputError with one line.

    Parameters
    ----------
    dome
        Scene of the dome: its name or file
    map_file
        Map that a survey wrote, with its LEDs, lever and lens; `tracker.map` of the scene if left out
    stages
        Names of algorithms by stage; the scene's for the others
    """
    from skysim.scene import loader

    return dome_solver(loader.load_scene(dome), map_file, stages)


def dome_solver(
    scene: Scene,
    map_file: str | Path | None = None,
    stages: Mapping[str, str] | None = None,
) -> DomeSolver:
    """`make_dome_solver` of a loaded scene."""
    from skysim.experiments.dome_survey import survey_frames, survey_procedure
    from skysim.simulation.lab import build_lab
    from skysim.tracking import factory, onboard_model
    from skysim.tracking.tracker_interface import OWN

    light = scene.dome
    if light is None:
        raise InputError(
            "solve.dome", f"the light of {scene.name} is {scene.light.kind}", "a dome"
        )
    # 1. The lists without simulated errors. One picture is too few for codes.
    own = scene.with_values("tracker", name=OWN, decoder=None, **(stages or {}))
    lab = build_lab(survey_frames.as_listed(own))
    sigma = onboard_model.assumed_camera(scene).focal_sigma
    camera = replace(onboard_model.assumed_camera(lab.scene), focal_sigma=sigma)
    prior = survey_frames.listed_prior(lab, camera)
    # 2. The sizes of their errors.
    doubt = onboard_model.assumed_dome(scene, light, survey_frames.design_of(lab))
    names = ("sigma_m", "covariance_m2", "common_m")
    leds = replace(prior.leds, **{name: getattr(doubt, name) for name in names})
    lever = replace(prior.lever, sigma_m=float(scene.tracker.survey.lever_sigma_m))
    # 3. A map in their place.
    path = map_file or scene.tracker.map
    if path:
        camera, leds, lever = onboard_model.surveyed_dome(lab.scene, str(path), leds, lever)
    settings = factory.assumed_settings(lab.scene)
    tracker = survey_procedure.dome_tracker(camera, leds, lever, settings)
    known = KnownCamera(camera, 0.0, scene.camera.detector)
    return DomeSolver(tracker, known, len(prior.leds.id))


def solve_dome(source: ViewedImage | Centroids, solver: DomeSolver) -> DomeReading:
    """Solve a picture of LEDs, or a list of their lights.

    If the row order of the picture is unknown, both are tried, each with half of the accepted chance of a false match.
    """
    tracker = solver.tracker
    if isinstance(source, Centroids):
        blank = np.zeros((tracker.camera.height_px, tracker.camera.width_px), np.uint8)
        return DomeReading(solver, blank, Report(tracker.solve_centroids(source), source))
    views = {"": source.pixels}
    if not source.row_order_known:
        views[ASSUMED_TOP_DOWN] = np.ascontiguousarray(source.pixels[::-1])
    readings = []
    for text, pixels in views.items():
        report = tracker.solve(pixels, exposure_s=source.exposure_s)
        match = report.attitude.match
        if match and match.log10_chance > ACCEPT_LOG10_CHANCE - math.log10(len(views)):
            report.attitude = Attitude(NO_MATCH)
        readings.append(DomeReading(solver, pixels, report, text, len(views) == 1))
    return next((one for one in readings if one.report.attitude.solved), readings[0])


def dome_fields(reading: DomeReading) -> Record:
    """The fields of DomeSolution: image statistics, and solution or likely cause of the refusal."""
    from skysim.experiments.dome_survey.survey_findings import attitude_record

    report = reading.report
    attitude = report.attitude
    seen = picture_fields(report, reading.pixels)
    match = attitude.match
    if match is None:
        return seen | {"hint": likely_cause(reading)}
    assert attitude.camera is not None
    assert attitude.covariance_rad2 is not None
    leds = reading.solver.tracker.leds
    lever = reading.solver.tracker.lever
    body_from_lab = lever.cam_from_body.inv() * attitude.cam_from_ref
    x_rad2, y_rad2, z_rad2 = np.diag(attitude.covariance_rad2).tolist()
    place_m = leds.position_m[match.star]
    xy_px = report.centroids.xy_px[match.observed]
    # Measured minus expected.
    residual_px = xy_px - project(body_from_lab, place_m, lever, attitude.camera)
    names = (f"LED {led}" for led in leds.id[match.star])
    shared = attitude.systematic_rad2
    solved = attitude_record(body_from_lab, attitude.covariance_rad2, lever)
    return (
        seen
        | solved
        | {
            "cross_sigma_arcsec": math.sqrt(x_rad2 + y_rad2) / ARCSEC_RAD,
            "roll_sigma_arcsec": math.sqrt(z_rad2) / ARCSEC_RAD,
            "systematic_rad2": None if shared is None else shared.tolist(),
            "log10_chance": match.log10_chance,
            "matches": len(match.star),
            "rms_px": attitude.rms_px,
            "leds": light_rows(names, LED_KEYS, place_m, xy_px, residual_px),
            "hint": reading.assumption,
        }
    )


def likely_cause(reading: DomeReading) -> str:
    """The likeliest cause of a refusal in one line, with a remedy."""
    tracker = reading.solver.tracker
    lights = reading.report.centroids
    if len(lights) < MIN_EVIDENCE_MATCHES:
        return f"too few lights ({len(lights)}): a longer exposure, or an attitude that shows more LEDs"
    if text := diagnosis.overexposed(diagnosis.Refusal(reading.pixels, lights, ())):
        return text
    flipped = diagnosis.reversed_columns(lights, tracker.camera.width_px)
    if reading.rows_known and tracker.solve_centroids(flipped).solved:
        return diagnosis.MIRRORED
    mapped = len(tracker.leds.id)
    text = f"the {len(lights)} lights fit the {mapped} LEDs at no attitude: is it this dome and this camera?"
    if mapped < reading.solver.listed:
        text += f" the map lacks {reading.solver.listed - mapped} LEDs of the scene: survey more of them"
    return text
