"""A scene's flight: its motion and all its frames, computed piece by piece and kept for playback.

A survey of the dome in the page flies such a flight: attitudes to hold, frames flown at them, and results.
"""

from __future__ import annotations

import math
import pickle
import tempfile
import time
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import NamedTuple

import numpy as np
from scipy.spatial.transform import Rotation

from estimator.calibration.survey_plan import SurveyAccuracy
from estimator.core.types import Centroids
from estimator.trackers.pipeline import Report
from skysim.apps.gui.messages import (
    AtLimit,
    Curves,
    FlightRow,
    FlightStep,
    FrameView,
    PlanStep,
    Residual,
    SurveyFound,
    SurveyPlan,
)
from skysim.apps.gui.worker import pixels, workbench
from skysim.core import quaternion
from skysim.core.constants import ARCSEC_RAD
from skysim.core.errors import InputError
from skysim.core.types import Bools, Floats, Frame, Mount, Telemetry, lengths
from skysim.dynamics import guidance, multibody
from skysim.experiments.dome_survey import (
    adjust,
    survey_findings,
    survey_frames,
    survey_procedure,
    survey_report,
)
from skysim.results import telemetry_report
from skysim.results.telemetry_report import euler_deg
from skysim.scene.scene import Scene
from skysim.scene.sections.motion import HoldConfig, SlewConfig
from skysim.scene.sections.vehicle import VehicleConfig
from skysim.simulation.flight import Flight, Shot
from skysim.simulation.lab import Lab
from skysim.simulation.motion import at_limit
from skysim.tracking import dome_map_file, onboard_model
from skysim.tracking import factory as tracker_settings

MAX_POINTS = 500  # approximate maximum number of points of a curve on the page
AT_STOP_DEG = 0.1  # tilt below the vehicle's stop that touches it
FLOOR = 1e-3  # arcsec; lower limit of values on a logarithmic axis
# Maximum size of the frames in the file; further frames are rendered again when they are shown.
KEPT_BYTES = 2**28


@dataclass
class KeptFrame:
    """A frame of a flight without its pixels.

    Attributes
    ----------
    place
        Place of the pixels in the file; None if they are rendered again, which gives the same
        bits
    """

    view: FrameView
    report: Report
    place: int | None


class Playback:
    """A flight of a workbench's scene. Its frames are those of `skysim run`.

    Its computation is a series of short steps, so that the worker does other tasks between them.

    Attributes
    ----------
    file
        Pixels of the first frames, which need not be rendered again for playback
    shown
        Number of the shown frame
    reported
        Number of frames reported by `advance`
    """

    def __init__(self, bench: workbench.Workbench) -> None:
        self.bench = bench
        self.frames = list[KeptFrame]()
        self.file = tempfile.TemporaryFile()  # noqa: SIM115
        flight = self.flight = Flight(bench.whole)
        self.shown: int | None = None
        self.reported = 0
        own = flight.schedules[bench.head : bench.head + 1]
        self.events = flight.events(flight.filter_schedules or own, solves=True)

    def advance(self, budget_s: float) -> FlightStep:
        """Compute for about budget_s, and report the progress."""
        end_s = time.perf_counter() + budget_s
        is_done = False
        while not is_done and time.perf_counter() < end_s:
            try:
                shot = next(self.events)
            except StopIteration:
                is_done = True
            else:
                if shot is not None and shot.camera is self.bench.lab.camera:
                    self.add(shot)
        new = self.frames[self.reported :]
        self.reported = len(self.frames)
        rows: list[FlightRow] = []
        drawn: Curves | None = None
        limits: list[AtLimit] = []
        mount = self.bench.lab.camera.mount
        if is_done or new:
            log = self.flight.telemetry()
            rows = [frame_row(frame, log, mount) for frame in new]
            drawn = curves(log)
            limits += at_limits(log, self.bench.scene.vehicle)
        residuals = [one for frame in new for one in light_residuals(frame.view, mount)]
        flight = self.flight
        return FlightStep(
            is_done, flight.now_s, flight.duration_s, rows, drawn, residuals, limits
        )

    def add(self, shot: Shot) -> None:
        """Keep a shot, and its pixels if the file has room."""
        bench = self.bench
        assert shot.report is not None
        seconds = sum(shot.seconds.values())
        view = bench.frame_view(
            shot.frame, shot.truth, shot.report, seconds, shot.update_status
        )
        self.frames.append(KeptFrame(view, shot.report, self.keep(shot.frame)))

    def keep(self, frame: Frame) -> int | None:
        """Write a frame's pixels to the end of the file, and return their place there; None if the file is full."""
        levels = pixels.levels_of(frame.image_dn)
        place = self.file.seek(0, 2)
        if place + levels.integers.nbytes > KEPT_BYTES:
            return None
        pickle.dump(levels, self.file)
        return place

    def show(self, index: int) -> tuple[FrameView, pixels.PixelLevels]:
        """The view of a kept frame and its pixels; its attitude becomes that of the workbench."""
        kept = self.frames[index]
        bench = self.bench
        self.shown = index
        bench.frame = None
        bench.lab_from_body = quaternion.to_rotation(kept.view.body_wxyz)
        if kept.place is None:
            self.render()
            assert bench.frame is not None
            return kept.view, pixels.levels_of(bench.frame.image_dn)
        self.file.seek(kept.place)
        return kept.view, pickle.load(self.file)

    @property
    def is_shown(self) -> bool:
        """Whether the newest frame of the workbench is one of the flight."""
        return (
            self.shown is not None
            and self.frames[self.shown].view.result is self.bench.result
        )

    def render(self) -> None:
        """Render the shown frame with its truth, unless a later frame of the scene has been rendered."""
        if self.shown is None or self.bench.frame is not None:
            return
        kept = self.frames[self.shown]
        bench = self.bench
        bench.frame, bench.truth = self.flight.render(self.shown, bench.head)
        bench.report = kept.report
        bench.result = kept.view.result


def frame_row(kept: KeptFrame, log: Telemetry, mount: Mount) -> FlightRow:
    """A frame of a flight in numbers, with those of the attitude filter from the flight's telemetry."""
    view = kept.view
    result = view.result
    assert result is not None  # every frame of a flight is solved
    filter_arcsec = innovation_arcsec = math.nan
    if log.lab_from_filter is not None:
        n = min(int(np.searchsorted(log.t_s, result.row.t_s)), len(log.t_s) - 1)
        lab_from_filter = log.lab_from_filter[n]
        filter_arcsec = angle_arcsec(lab_from_filter, log.lab_from_body[n])
        cam_from_lab = kept.report.attitude.cam_from_ref
        if cam_from_lab is not None:
            lab_from_body = cam_from_lab.inv() * mount.cam_from_body
            innovation_arcsec = angle_arcsec(lab_from_body, lab_from_filter)
    counts = len(view.lights), view.statistics.saturated
    return FlightRow(result.row, *counts, filter_arcsec, innovation_arcsec)


def at_limits(log: Telemetry, vehicle: VehicleConfig) -> Iterator[AtLimit]:
    """The times at which actuators, gyros or the tilt were at their limits, by the flight's telemetry."""
    masks = {f"{name} limit": full for name, full in at_limit(log.loads).items()}
    if log.saturated is not None:
        masks["gyro limit"] = log.saturated
    if vehicle.mount == "air_bearing":
        least_deg = vehicle.tilt_stop_deg - AT_STOP_DEG
        masks["tilt stop"] = multibody.tilt_deg(log.lab_from_body) > least_deg
    for name, mask in masks.items():
        ends = np.flatnonzero(np.diff([False, *mask, False]))
        for first, end in ends.reshape(-1, 2):
            yield name, float(log.t_s[first]), float(log.t_s[end - 1])


def light_residuals(view: FrameView, mount: Mount) -> Iterator[Residual]:
    """The residual of every light that is identified in a frame."""
    assert view.result is not None
    lab_from_cam = quaternion.to_rotation(view.body_wxyz) * mount.body_from_cam
    across_lab = lab_from_cam.as_matrix()[:, :2]  # directions of x and y
    for spot in view.result.detections:
        px = math.hypot(*spot.residual_px)
        if spot.id >= 0 and math.isfinite(px):
            lab_px = tuple((across_lab @ spot.residual_px).tolist())
            yield Residual(view.result.row.t_s, spot.id, px, lab_px)


def curves(log: Telemetry) -> Curves:
    """Curves of true and estimated attitude errors (arcsec), momentum (N m s) and rate (deg/s), decimated."""
    attitudes = {
        "pointing": log.lab_from_ref,
        "IMU alone": log.lab_from_imu,
        "filter": log.lab_from_filter,
    }
    values = {
        name: np.maximum(3600 * error_deg, FLOOR)
        for name, attitude in attitudes.items()
        if (error_deg := telemetry_report.attitude_error_deg(attitude, log.lab_from_body))
        is not None
    }
    values["t_s"] = log.t_s
    values["momentum"] = lengths(log.momentum_nms)
    values["rate"] = np.degrees(lengths(log.rate_body_rad_s))
    every = max(len(log.t_s) // MAX_POINTS, 1)
    return {name: curve[::every] for name, curve in values.items()}


def angle_arcsec(first: Rotation, second: Rotation) -> float:
    """Angle of the rotation from one attitude to another."""
    return float((first.inv() * second).magnitude()) / ARCSEC_RAD


SURVEY_TILT_DEG = 25.0  # greatest tilt of a survey, if the vehicle's stop allows it
MAX_STOPS = 200
REST_PX = 1.0  # maximum motion of the image during an exposure for a vehicle at rest
UNCERTAINTY = survey_frames.survey_uncertainty()  # as `skysim survey` assumes by default


@dataclass
class Survey:
    """A survey of a scene's dome, with the uncertainties that `skysim survey` assumes.

    Attributes
    ----------
    lab, before
        Lab with the errors of the onboard model before the survey, and this model
    noise_px
        Standard deviation of a centroid's coordinates, by which attitudes are chosen
    taken
        Frames that were flown
    run
        Last adjustment that succeeded
    """

    scene: Scene
    lab: Lab
    before: survey_frames.CalibrationPrior
    noise_px: float
    taken: list[TakenFrame] = field(default_factory=list)
    run: survey_findings.SurveyRun | None = None

    def is_of(self, scene: Scene) -> bool:
        """Whether a scene is the surveyed one, apart from its sections `motion` and `exposure`."""
        return self.scene.with_values(motion=scene.motion, exposure=scene.exposure) == scene

    def adjust(self, flight: Flight, views: Sequence[FrameView], count: int) -> SurveyFound:
        """Adjust the dome to all frames so far and those of a flight, and plan `count` further attitudes.

        Parameters
        ----------
        views
            The frames of the flight so far, in order

        Raises
        ------
        InputError
            If the flight has no further frames; the survey then remains unchanged.
        """
        allow(count)
        new, missed = self.new_frames(flight, views)
        taken = [*self.taken, *new]
        # Frames with the IMU's attitudes.
        measured = survey_frames.imu_attitudes(
            self.scene,
            Rotation.concatenate([frame.lab_from_body for frame in taken]),
            UNCERTAINTY.imu_sigma_rad,
        )
        frames = [
            survey_frames.SurveyFrame(frame.lights, at, frame.row)
            for frame, at in zip(taken, measured, strict=True)
        ]
        try:
            run = adjust.run_survey(frames, self.before)
            refusal = ""
            so_far = survey_findings.coverage(run)
        except InputError as error:
            run = None
            refusal = str(error)
            so_far = survey_findings.coverage_before(frames, self.before, self.noise_px)
        statistics = survey_findings.coverage_statistics(so_far)
        del statistics["by_led"]
        statistics |= {"frames": len(taken), "missed": missed, "refusal": refusal}
        faults: list[str] = []
        if run:
            statistics |= survey_report.truth_statistics(run, self.before, self.lab)
            statistics["connected"] = int(run.survey.tied.sum())
            statistics["sigma_mm"] = 1e3 * run.accuracy.led_rms_m
            faults += survey_findings.fault_lines(survey_findings.find_faults(run))
        # Attitudes to hold next.
        further = survey_findings.next_stops(
            self.scene, so_far, self.before.margin_px, count, tilt_deg(self.scene)
        )
        step = plan_step(len(taken) + len(further.shown), further.accuracy)
        plan = survey_plan(further.lab_from_body, further.shown, (step,))
        self.taken = taken
        self.run = run or self.run
        return SurveyFound(statistics, faults, so_far.model.leds.id, known_share(run), plan)

    def new_frames(
        self, flight: Flight, views: Sequence[FrameView]
    ) -> tuple[list[TakenFrame], int]:
        """The frames of a flight at which the vehicle rests, one per hold, and the number of holds without one.

        Raises
        ------
        InputError
            If there are none, or the survey already has them.
        """
        rows, holds = frames_at_rest(flight, views)
        if not rows:
            raise InputError(
                "survey",
                f"the vehicle rests at none of the flight's {holds} holds",
                "a flight of the survey's attitudes with a vehicle that holds them, such as motion.control: prescribed",
            )
        known = {frame.row for frame in self.taken if frame.flown == flight.lab.scene}
        if known >= set(rows):
            raise InputError(
                "survey", "it has the frames of this flight", "a flight of the next attitudes"
            )
        settings = tracker_settings.assumed_settings(self.lab.scene)
        camera = onboard_model.assumed_camera(self.lab.scene)
        new = []
        for row in (row for row in rows if row not in known):
            frame, _ = flight.render(row)
            lab_from_body = quaternion.to_rotation(views[row].body_wxyz)
            lights = survey_frames.detect_lights(settings, camera, frame.image_dn)
            new.append(TakenFrame(flight.lab.scene, row, lab_from_body, lights))
        return new, holds - len(rows)

    def map_file(self) -> bytes:
        """The measured LEDs, lever arm and lens as the file for `tracker.map`. Raises InputError if there are none."""
        if self.run is None:
            raise InputError(
                "", "the survey has measured no LED yet: fly its attitudes, then adjust"
            )
        with tempfile.TemporaryDirectory() as folder:
            path = Path(folder) / "leds.ecsv"
            dome_map_file.write_dome_map(path, adjust.dome_map(self.run))
            return path.read_bytes()


class TakenFrame(NamedTuple):
    """A frame of a survey: the scene that was flown, its number in it, the true attitude, and its detections."""

    flown: Scene
    row: int
    lab_from_body: Rotation
    lights: Centroids


def begin(scene: Scene, frames: int) -> tuple[Survey, SurveyPlan]:
    """A new survey of a scene's dome and its first attitudes. Raises InputError."""
    allow(frames)
    lab, before, plan = survey_procedure.plan_survey(
        scene, UNCERTAINTY, frames, tilt_deg(scene)
    )
    steps = tuple(plan_step(*step) for step in plan.steps())
    survey = Survey(scene, lab, before, plan.model.sigma_px)
    return survey, survey_plan(plan.lab_from_body, plan.shown, steps)


def allow(frames: int) -> None:
    """Raise InputError for a number of frames that is not allowed."""
    if not 2 <= frames <= MAX_STOPS:
        raise InputError("frames", frames, f"2 to {MAX_STOPS}")


def tilt_deg(scene: Scene) -> float:
    """Greatest tilt of a survey's attitudes."""
    return min(SURVEY_TILT_DEG, scene.vehicle.tilt_stop_deg)


def survey_plan(
    lab_from_body: Rotation, shown: Bools, steps: tuple[PlanStep, ...]
) -> SurveyPlan:
    """Return a plan in the form of the page.

    Parameters
    ----------
    shown
        (F, N) whether an attitude shows an LED
    """
    angles = euler_deg(lab_from_body).tolist()
    return SurveyPlan(angles, shown.sum(axis=1).tolist(), shown.shape[1], steps)


def plan_step(count: int, accuracy: SurveyAccuracy) -> PlanStep:
    """Number of frames; predicted after them, the number of LEDs measured and their rms error in mm."""
    statistics = survey_findings.accuracy_statistics(accuracy)
    return count, int(statistics["measured"] or 0), statistics["led_mm"]


def known_share(run: survey_findings.SurveyRun | None) -> Floats:
    """(N,) reduction of each LED's uncertainty by a survey, from 0 (not measured) to 1; (0,) without a survey."""
    if run is None:
        return np.zeros(0)
    share = 1 - run.accuracy.led_sigma_m / UNCERTAINTY.led_sigma_m
    return np.where(run.accuracy.measured, np.clip(share, 0.0, 1.0), 0.0)


def frames_at_rest(flight: Flight, views: Sequence[FrameView]) -> tuple[list[int], int]:
    """Return the row of the last frame at rest in each hold of a flight, and the number of holds.

    A frame is at rest if the image moves by less than REST_PX during its exposure. The true rate decides, since a
    controller may not reach the attitude or may not hold it. A hold without a frame at rest has no row.
    """
    scene = flight.lab.scene
    motion = scene.motion
    if not flight.is_over or not all(
        isinstance(one, SlewConfig | HoldConfig) for one in motion.maneuver
    ):
        return [], 0
    reference = guidance.plan(motion)
    by_hold: dict[int, int] = {}
    holds = {leg for leg, one in enumerate(motion.maneuver) if isinstance(one, HoldConfig)}
    for row, view in enumerate(views):
        assert view.result is not None  # every frame of a flight is solved
        middle_s = view.result.row.t_s
        half_s = view.exposure_s / 2
        leg = int(np.searchsorted(reference.start_s, middle_s - half_s, side="right")) - 1
        if leg in holds and middle_s + half_s <= reference.start_s[leg + 1]:
            rate_rad_s = np.linalg.norm(flight.trajectory().rate_at(middle_s))
            if rate_rad_s * view.exposure_s * scene.camera.focal_px < REST_PX:
                by_hold[leg] = row
    return list(by_hold.values()), len(holds)
