"""Pictures of a dome's LEDs: the attitude of each, lost in space, with the tracker of a scene.

The LEDs are those of the scene's list, or of a map that `skysim survey` measured. Unlike the tracker of `skysim run`,
this one has no simulated errors of survey and calibration: a real dome has its own. Their sizes, `tracker.survey` of
the scene or those of the map, are in the covariance.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, NamedTuple

import numpy as np
from numpy.typing import NDArray

from estimator.attitude.dome_map import project
from estimator.core.types import Attitude, Centroids
from estimator.identification.chance import ACCEPT_LOG10_CHANCE, MIN_EVIDENCE_MATCHES
from estimator.identification.refusals import NO_MATCH
from estimator.trackers.pipeline import Report
from skysim.apps.plate_solver import diagnosis
from skysim.apps.plate_solver.plate_solution import PIXEL_KEYS, light_rows, picture_fields
from skysim.apps.plate_solver.solver import KnownCamera
from skysim.core.constants import ARCSEC_RAD
from skysim.core.errors import InputError
from skysim.core.images import ASSUMED_TOP_DOWN, ViewedImage
from skysim.core.types import Record, frozen

if TYPE_CHECKING:
    from estimator.trackers.dome_tracker import DomeTracker

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
    pixels: NDArray
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
    from skysim.experiments.dome_survey import survey_frames, survey_procedure
    from skysim.scene import loader
    from skysim.simulation.lab import build_lab
    from skysim.tracking import factory, onboard_model
    from skysim.tracking.tracker_interface import OWN

    scene = loader.load_scene(dome)
    light = scene.dome
    if light is None:
        raise InputError("solve.dome", f"the light of {dome} is {scene.light.kind}", "a dome")
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
