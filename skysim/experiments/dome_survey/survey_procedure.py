"""The procedure of a survey: its plan with predicted errors, its simulation, and their comparison."""

import math
from collections.abc import Iterator, Sequence
from dataclasses import replace
from pathlib import Path
from typing import NamedTuple

import numpy as np
from scipy.spatial.transform import Rotation

from estimator.calibration.survey_plan import SurveyAccuracy, SurveyModel, measurable
from estimator.trackers.pipeline import Settings
from skysim.core import files
from skysim.core.errors import InputError
from skysim.core.random_streams import random_stream
from skysim.core.types import Bools, Record
from skysim.experiments.dome_survey.adjust import run_survey
from skysim.experiments.dome_survey.survey_findings import (
    SurveyRun,
    accuracy_statistics,
    fault_rows,
    find_faults,
    predicted,
)
from skysim.experiments.dome_survey.survey_frames import (
    CANDIDATES,
    STREAM_KEYS,
    CalibrationPrior,
    SurveyFrame,
    SurveyUncertainty,
    calibration_prior,
    centroid_noise_px,
    imu_attitudes,
    planned_stops,
    stop_attitudes,
    survey_model,
    take_frames,
    with_survey_errors,
)
from skysim.experiments.dome_survey.survey_images import (
    ATTITUDES,
    FRAME,
    SurveyImage,
    frame_names,
    frames_with_attitude,
    write_attitudes,
)
from skysim.experiments.dome_survey.survey_report import led_errors
from skysim.experiments.tracker_comparison import with_config
from skysim.results.files import recording
from skysim.scene.scene import Scene
from skysim.simulation.flight import Progress
from skysim.simulation.lab import Lab, build_lab

PLANNED = "plan"
RANDOM = "random"
DRAWS = 100  # number of domes in which the LEDs that a plan measures are counted


class HeldAttitudes(NamedTuple):
    """Attitudes to hold, one frame at each.

    Attributes
    ----------
    shown
        (F, N) mask of the LEDs that each shows
    margin_px
        Margin of the chip in which an image would be incomplete
    in_reach
        (N,) whether any attitude within the tilt shows each LED
    """

    lab_from_body: Rotation
    shown: Bools
    model: SurveyModel
    margin_px: float
    in_reach: Bools

    def first(self, count: int) -> SurveyAccuracy:
        """The accuracy predicted after the first `count` frames."""
        return predicted(self.model, self.lab_from_body[:count].inv(), self.shown[:count])

    def counts(self, count: int) -> Record:
        """The number of LEDs that the first `count` frames measure if the dome differs from the model by its sigmas.

        Mean and 95 % interval over DRAWS domes. The attitudes show more of the model's LEDs than of theirs, because
        they were chosen for it.
        """
        model = self.model
        held = self.lab_from_body[:count].inv()
        rng = random_stream(0, STREAM_KEYS["domes"])
        found = []
        for _ in range(DRAWS):
            focal, *lever = rng.standard_normal(4)
            own_m = rng.standard_normal(model.leds.position_m.shape) * model.leds_sigma_m
            leds_m = model.leds.position_m + own_m
            lever_m = model.lever.camera_body_m + np.array(lever) * model.lever_sigma_m
            zoom = 1 + focal * model.focal_sigma_px / model.camera.focal_px
            other = replace(
                model,
                camera=model.camera.zoomed(zoom),
                leds=replace(model.leds, position_m=leds_m),
                lever=replace(model.lever, camera_body_m=lever_m),
            )
            shown = other.visible(held, self.margin_px)
            found.append(int(measurable(other, held, shown).sum()))
        return {
            "measured": round(np.mean(found)),
            "measured_range": [round(end) for end in np.quantile(found, [0.025, 0.975])],
        }

    def steps(self) -> list[tuple[int, SurveyAccuracy]]:
        """The accuracy predicted after a quarter, a half, three quarters and all of the frames."""
        total = len(self.lab_from_body)
        counts = sorted({max(round(total * part / 4), 2) for part in range(1, 5)})
        return [(count, self.first(count)) for count in counts]


def plan_survey(
    scene: Scene,
    uncertainty: SurveyUncertainty,
    count: int,
    tilt_deg: float,
    kind: str = PLANNED,
) -> tuple[Lab, CalibrationPrior, HeldAttitudes]:
    """The lab whose onboard model has errors as before a survey, that model, and the attitudes: planned, or random.

    Raises
    ------
    InputError
        For a tilt beyond the vehicle's stop.
    """
    lab = build_lab(with_survey_errors(scene, uncertainty))
    prior = calibration_prior(lab)._replace(uncertainty=uncertainty)
    random = stop_attitudes(lab.scene, "attitudes", count, tilt_deg)
    model = survey_model(prior, centroid_noise_px(lab, tilt_deg))
    margin_px = prior.margin_px
    held = (
        random
        if kind == RANDOM
        else planned_stops(lab.scene, model, margin_px, count, tilt_deg)
    )
    shown = model.visible(held.inv(), margin_px)
    anywhere = stop_attitudes(lab.scene, "candidates", CANDIDATES, tilt_deg)
    in_reach = np.asarray(model.visible(anywhere.inv(), margin_px).any(axis=0))
    return lab, prior, HeldAttitudes(held, shown, model, margin_px, in_reach)


def write_plan(path: Path, plan: HeldAttitudes) -> None:
    """Write the attitudes as CSV with the names of the images to take, as `attitudes.csv` has them."""
    leds = plan.shown.sum(axis=1).tolist()
    write_attitudes(path, frame_names(len(leds)), plan.lab_from_body, {"leds": leds})


def simulated_frames(
    lab: Lab,
    uncertainty: SurveyUncertainty,
    lab_from_body: Rotation,
    folder: Path | None = None,
) -> Iterator[SurveyFrame]:
    """The frames of a simulated survey, which are also written to a folder as FITS with the IMU's attitudes."""
    measured = imu_attitudes(lab.scene, lab_from_body, uncertainty.imu_sigma_rad)
    if folder is not None:
        names = frame_names(len(lab_from_body))
        write_attitudes(files.make_folder(folder) / ATTITUDES, names, measured.inv())
    for (frame, truth, lights), body_from_lab in zip(
        take_frames(lab, lab_from_body), measured, strict=True
    ):
        if folder is not None:
            recording.write_fits(folder / FRAME.format(frame.index), frame, truth, lab.scene)
        yield SurveyFrame(lights, body_from_lab, frame.index)


def survey_images(
    pictures: Sequence[SurveyImage],
    frames: list[SurveyFrame],
    prior: CalibrationPrior,
    settings: Settings,
    watch: Progress | None,
) -> SurveyRun:
    """Survey from images. `frames` are those with an attitude; the others are identified with the LEDs so far.

    Raises
    ------
    InputError
        If too few images have an attitude, or they do not determine the unknowns.
    """
    if len(frames) < 2:
        raise InputError(
            "survey",
            f"{len(frames)} of {len(pictures)} images identified",
            f"2 or more: give their attitudes in {ATTITUDES}",
        )
    run = run_survey(frames, prior, watch)
    while len(frames) < len(pictures):
        found = run.found
        measured = found.uncertainty._replace(led_sigma_m=run.accuracy.led_rms_m)
        model = found._replace(leds=run.survey.surveyed_leds, uncertainty=measured)
        known = {frame.index: frame.body_from_lab.inv() for frame in frames}
        named = [
            picture._replace(lab_from_body=known.get(n)) for n, picture in enumerate(pictures)
        ]
        more = frames_with_attitude(named, model, settings)
        if len(more) == len(frames):
            break
        frames = more
        run = run_survey(frames, prior, watch)
    return run


# Comparison of the prediction with simulated surveys.


class SimulatedErrors(NamedTuple):
    """Errors of one simulated survey: mean squares of coordinates of LEDs and lever (m2) and of the focal length (px2).

    Also the number of measured LEDs, and of faults reported although the dome has none.
    """

    led_m2: float
    lever_m2: float
    focal_px2: float
    measured: int
    false_alarms: int


def repeat_survey(
    lab: Lab, uncertainty: SurveyUncertainty, plan: HeldAttitudes, repeats: int
) -> Iterator[SimulatedErrors | InputError]:
    """The errors of simulated surveys at the attitudes of a plan, each with its own noise, IMU errors and list.

    For a survey that does not determine the dome, the InputError that says why.
    """
    for n in range(repeats):
        again = in_survey(lab, n)
        prior = calibration_prior(again)._replace(uncertainty=uncertainty)
        frames = list(simulated_frames(again, uncertainty, plan.lab_from_body))
        try:
            yield survey_errors(run_survey(frames, prior), prior, again)
        except InputError as error:
            yield error


def in_survey(lab: Lab, n: int) -> Lab:
    """The lab of another survey: with other noise, and other errors of list, lever and IMU."""
    scene = lab.scene
    again = lab.in_run(scene.seed + n)
    return replace(
        again,
        scene=with_config(again.scene, "tracker.survey", seed=scene.tracker.survey.seed + n),
    )


def survey_errors(run: SurveyRun, prior: CalibrationPrior, lab: Lab) -> SimulatedErrors:
    """The errors of one survey against the truth."""
    survey = run.survey
    lever_m = survey.lever.camera_body_m - lab.camera.mount.camera_body_m
    return SimulatedErrors(
        float(np.mean(led_errors(survey, prior, lab).after_m ** 2)),
        float(np.mean(lever_m**2)),
        (survey.camera.focal_px - lab.scene.camera.focal_px) ** 2,
        int(survey.surveyed.sum()),
        len([*fault_rows(find_faults(run))]),
    )


def comparison(plan: HeldAttitudes, errors: list[SimulatedErrors]) -> list[Record]:
    """Rows with predicted errors, simulated errors (rms over all surveys), and their ratio with its standard error."""
    accuracy = accuracy_statistics(plan.first(len(plan.lab_from_body)))
    led_m2, lever_m2, focal_px2, *_ = np.array(errors).T
    rows = []
    for what, key, squares in (
        ("LED place mm", "led_mm", 1e6 * led_m2),
        ("lever mm", "lever_mm", 1e6 * lever_m2),
        ("focal length px", "focal_px", focal_px2),
    ):
        mean = float(squares.mean())
        sigma = accuracy[key]
        ratio = math.sqrt(mean) / sigma if sigma else None
        # The relative error of the root of a mean square.
        relative = float(squares.std() / (2 * mean * np.sqrt(len(squares))))
        rows.append(
            {
                "what": what,
                "predicted": sigma,
                "simulated": math.sqrt(mean),
                "ratio": ratio,
                "ratio_sigma": ratio and ratio * relative,
            }
        )
    return rows
