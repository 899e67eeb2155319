"""A survey of the dome in the page: attitudes to hold, the frames flown at them, and what these measure."""

from __future__ import annotations

import tempfile
from dataclasses import asdict, dataclass, field
from pathlib import Path

import numpy as np
from scipy.spatial.transform import Rotation

from estimator.core.types import Centroids
from skysim.apps.gui.messages import SurveyFound, SurveyPlan
from skysim.apps.gui.worker.playback import Flight
from skysim.core import quaternion
from skysim.core.errors import InputError
from skysim.dynamics import guidance
from skysim.experiments.dome_survey import adjust, prior, procedure, stops
from skysim.experiments.dome_survey.frames import SurveyFrame, detect_lights, imu_attitudes
from skysim.experiments.dome_survey.prior import CalibrationPrior
from skysim.experiments.dome_survey.results import findings, report
from skysim.experiments.dome_survey.results.findings import Coverage
from skysim.experiments.dome_survey.survey_run import SurveyRun
from skysim.scene.scene import Scene
from skysim.scene.sections.motion import HoldConfig, SlewConfig
from skysim.simulation import exposure
from skysim.simulation.testbed import Testbed
from skysim.tracking import dome_map_file, onboard_model
from skysim.tracking import settings as tracker_settings

SURVEY_TILT_DEG = 25.0  # greatest tilt of a survey, if the vehicle's stop allows it
MAX_STOPS = 200
UNCERTAINTY = prior.survey_uncertainty()  # that `skysim survey` assumes


@dataclass
class Survey:
    """A survey of a scene's dome, with the uncertainties that `skysim survey` assumes.

    testbed, before : with the errors of the onboard model before the survey, and this model
    noise_px : standard deviation of a centroid's coordinates, by which frames are chosen
    held, lights, index : true lab_from_body, detections and number of each frame that was flown
    flight : from which the last of them are;  run : the newest adjustment
    """

    scene: Scene
    testbed: Testbed
    before: CalibrationPrior
    noise_px: float
    held: list[Rotation] = field(default_factory=list)
    lights: list[Centroids] = field(default_factory=list)
    index: list[int] = field(default_factory=list)
    flight: Flight | None = None
    run: SurveyRun | None = None

    def is_of(self, scene: Scene) -> bool:
        """Whether this is a survey of a scene, which may differ by its motion and the frames taken of it."""
        return self.scene.model_copy(update={"motion": scene.motion, "exposure": scene.exposure}) == scene

    def adjust(self, flight: Flight, count: int) -> SurveyFound:
        """Adjust the dome to all frames so far with those of a flight, and plan `count` further attitudes.

        Raises InputError if the flight has no further frames.
        """
        allow(count)
        self.take(flight)
        try:
            self.run = adjust.run_survey(self.frames(), self.before, UNCERTAINTY)
            refusal, so_far = "", findings.coverage(self.run)
        except InputError as error:
            self.run, refusal = None, str(error)
            so_far = findings.coverage_before(self.frames(), self.before, UNCERTAINTY, self.noise_px)
        counts = findings.coverage_statistics(so_far)
        before_mm, after_mm, faults = self.errors()
        return SurveyFound(
            frames=len(self.held),
            connected=int(self.run.survey.tied.sum()) if self.run else 0,
            measured=counts["measured"] if self.run else 0,
            seen_once=counts["seen_once"],
            unseen=counts["unseen"],
            sigma_mm=1e3 * self.run.accuracy.led_rms_m if self.run else None,
            before_mm=before_mm,
            error_mm=after_mm,
            faults=faults,
            refusal=refusal,
            ids=so_far.model.leds.id,
            known=self.known_share(so_far),
            plan=self.next_plan(so_far, count),
        )

    def take(self, flight: Flight) -> None:
        """Take the frames of a flight at which the vehicle rests. Raises InputError if none are new."""
        if flight is self.flight:
            raise InputError("the survey has the frames of this flight already: fly the next attitudes")
        rows = frames_at_rest(flight)
        if not rows:
            raise InputError("the flight has no frame in which the vehicle rests: fly the attitudes")
        assert flight.moved is not None
        settings = tracker_settings.assumed_settings(self.testbed.scene)
        camera = onboard_model.assumed_camera(self.testbed.scene)
        for row in rows:
            view = flight.frames[row].view
            frame, _ = exposure.render_frame(flight.moved, row, exposure_s=view.exposure_s)
            self.lights.append(detect_lights(settings, camera, frame.image_dn))
            self.held.append(quaternion.to_rotation(np.array(view.body_wxyz)))
            self.index.append(row)
        self.flight = flight

    def frames(self) -> list[SurveyFrame]:
        """The frames so far, with the IMU's attitudes."""
        measured = imu_attitudes(self.scene, Rotation.concatenate(self.held), UNCERTAINTY.imu_sigma_rad)
        return [SurveyFrame(*one) for one in zip(self.lights, measured, self.index, strict=True)]

    def errors(self) -> tuple[float | None, float | None, tuple[str, ...]]:
        """True rms errors of the measured LEDs about each axis before and after the survey, mm, and the faults."""
        if self.run is None:
            return None, None, ()
        truth = report.truth_statistics(self.run, self.before, self.testbed)
        faults = findings.fault_lines(asdict(findings.find_faults(self.run)))
        return truth["led_mm_before"], truth["led_mm_after"], tuple(faults)

    def known_share(self, so_far: Coverage) -> np.ndarray:
        """(N,) by how much the survey has reduced the uncertainty of each LED: 0, not measured, to 1."""
        if self.run is None or so_far.accuracy is None:
            return np.zeros(len(so_far.model.leds.id))
        share = 1 - so_far.accuracy.led_sigma_m / UNCERTAINTY.led_sigma_m
        return np.where(so_far.measured, np.clip(share, 0.0, 1.0), 0.0)

    def next_plan(self, so_far: Coverage, count: int) -> SurveyPlan:
        """Attitudes to hold after those so far."""
        margin_px = prior.image_sizes(self.before).margin_px
        further = findings.next_stops(self.scene, so_far, margin_px, count, tilt_deg(self.scene))
        shown = so_far.model.visible(further.lab_from_body.inv(), margin_px)
        step = plan_step(len(self.held) + len(shown), further.accuracy)
        return survey_plan(further.lab_from_body, shown, (step,))

    def map_file(self) -> bytes:
        """The measured LEDs, lever arm and lens as the file for `tracker.map`. Raises InputError if there are none."""
        if self.run is None:
            raise InputError("the survey has measured no LED yet: fly its attitudes, then adjust")
        with tempfile.TemporaryDirectory() as folder:
            path = Path(folder) / "leds.ecsv"
            dome_map_file.write_dome_map(path, adjust.dome_map(self.run.survey, UNCERTAINTY))
            return path.read_bytes()


def begin(scene: Scene, frames: int) -> tuple[Survey, SurveyPlan]:
    """A new survey of a scene's dome and its first attitudes. Raises InputError."""
    allow(frames)
    testbed, before, plan = procedure.plan_survey(scene, UNCERTAINTY, frames, tilt_deg(scene))
    steps = tuple(plan_step(*step) for step in plan.steps())
    survey = Survey(scene, testbed, before, plan.model.sigma_px)
    return survey, survey_plan(plan.lab_from_body, plan.shown, steps)


def allow(frames: int) -> None:
    """Raise InputError for a number of frames that is not allowed."""
    if not 2 <= frames <= MAX_STOPS:
        raise InputError(f"frames {frames}: allowed: 2 to {MAX_STOPS}")


def tilt_deg(scene: Scene) -> float:
    """Greatest tilt of a survey's attitudes."""
    return min(SURVEY_TILT_DEG, scene.vehicle.tilt_stop_deg)


def survey_plan(
    lab_from_body: Rotation, shown: np.ndarray, steps: tuple[tuple[int, int, float | None], ...]
) -> SurveyPlan:
    """A plan as the page has it. shown : (F, N) LEDs that each attitude shows"""
    angles = tuple(tuple(row) for row in stops.angles_deg(lab_from_body).tolist())
    return SurveyPlan(angles, tuple(shown.sum(axis=1).tolist()), shown.shape[1], steps)


def plan_step(count: int, accuracy: findings.SurveyAccuracy | None) -> tuple[int, int, float | None]:
    """Number of frames, and what is predicted after them: LEDs measured, and their rms error in mm."""
    statistics = findings.accuracy_statistics(accuracy)
    return count, int(statistics["measured"] or 0), statistics["led_mm"]


def frames_at_rest(flight: Flight) -> list[int]:
    """Rows of a flight's frames: of each hold of its maneuver the last whose whole exposure is in it."""
    motion = flight.bench.scene.motion
    if not all(isinstance(maneuver, SlewConfig | HoldConfig) for maneuver in motion.maneuver):
        return []
    reference = guidance.plan(motion)
    by_hold: dict[int, int] = {}
    for row, kept in enumerate(flight.frames):
        begin_s, end_s = kept.view.t_s, kept.view.t_s + kept.view.exposure_s
        leg = int(np.searchsorted(reference.start_s, begin_s, side="right")) - 1
        if leg < len(motion.maneuver) and end_s <= reference.start_s[leg + 1]:
            by_hold |= {leg: row} if isinstance(motion.maneuver[leg], HoldConfig) else {}
    return list(by_hold.values())
