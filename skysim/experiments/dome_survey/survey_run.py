"""A survey of a dome as its last round has it: frames, correspondences, what they show of each LED, stray lights."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from estimator.attitude.dome_map import LedMap, project
from estimator.calibration import survey_faults
from estimator.calibration.dome_survey import DomeSurvey
from estimator.calibration.survey_faults import HeldFrames, LightTable, StrayLight
from estimator.calibration.survey_plan import Mask, SurveyAccuracy
from skysim.core.types import Floats
from skysim.experiments.dome_survey.survey_frames import SurveyFrame
from skysim.experiments.dome_survey.matching import GATE_SIGMAS, Correspondences
from skysim.experiments.dome_survey.survey_prior import (CalibrationPrior, SurveyUncertainty, image_sizes)

STRAY_SIGMA_PX = 0.3  # of a ray to a stray light, for the errors of the attitude and of blends
STRAY_REACH_M = 0.005  # on the dome, within which stray lights of two frames may be one


@dataclass(frozen=True, slots=True)
class SurveyRun:
    """A survey with the frames and correspondences of its last round.

    taken  : all frames, with the IMU's attitudes;  rows : those of `taken` that are in the survey
    listed : the LEDs before the survey
    prior  : the model before the last round; its LEDs are the listed ones, those moved at the places found
    """

    survey: DomeSurvey
    taken: Sequence[SurveyFrame]
    rows: list[int]
    matches: list[Correspondences]
    listed: LedMap
    prior: CalibrationPrior
    uncertainty: SurveyUncertainty

    @property
    def frames(self) -> list[SurveyFrame]:
        """The frames of the survey, with their adjusted attitudes."""
        pairs = zip(self.rows, self.survey.body_from_lab, strict=True)
        return [replace(self.taken[row], body_from_lab=attitude) for row, attitude in pairs]

    @property
    def held(self) -> HeldFrames:
        """The frames with their adjusted attitudes and the model found."""
        survey = self.survey
        return HeldFrames(survey.camera, survey.leds, survey.lever, survey.body_from_lab)

    @property
    def inliers(self) -> list[Correspondences]:
        """The correspondences without those that the adjustment rejected."""
        keep = [np.ones(len(match.led), dtype=bool) for match in self.matches]
        for frame, row in self.survey.outliers.tolist():
            keep[frame][row] = False
        return [
            Correspondences(m.light[k], m.led[k]) for m, k in zip(self.matches, keep, strict=True)
        ]

    @property
    def seen(self) -> Mask:
        """(F, N) LEDs identified in each frame."""
        return identified(self.inliers, len(self.listed.id))

    @property
    def noise_px(self) -> float:
        """Standard deviation of a centroid's coordinates, as the residuals have it; of the mean information."""
        pairs = zip(self.frames, self.inliers, strict=True)
        sigma_px = np.concatenate([frame.lights.sigma_px[match.light] for frame, match in pairs])
        return self.survey.noise_scale / float(np.sqrt(np.mean(sigma_px**-2.0)))

    @property
    def accuracy(self) -> SurveyAccuracy:
        """The standard deviations of the survey."""
        survey = self.survey
        return SurveyAccuracy(
            survey.surveyed,
            led_sigma_m(survey, self.uncertainty),
            np.sqrt(np.diag(survey.lever_covariance_m2)),
            np.sqrt(np.diag(survey.lens_covariance)),
        )

    @property
    def uncertainty_after(self) -> SurveyUncertainty:
        """The uncertainty of the IMU and of LEDs that are not measured, and that of the lever and the lens found."""
        accuracy = self.accuracy
        before = self.uncertainty
        lever_m = float(np.sqrt(np.mean(accuracy.lever_sigma_m**2)))
        focal = float(accuracy.lens_sigma[0] / self.survey.camera.focal_px)
        return replace(before, lever_sigma_m=lever_m, focal_error=focal)


def identified(matches: Sequence[Correspondences], leds: int) -> Mask:
    """(F, N) LEDs that the correspondences of each frame have."""
    out = np.zeros((len(matches), leds), dtype=bool)
    for row, match in zip(out, matches, strict=True):
        row[match.led] = True
    return out


def led_sigma_m(survey: DomeSurvey, uncertainty: SurveyUncertainty) -> Floats:
    """(N,) standard deviation of each LED's position, RMS of three axes; that before the survey if not surveyed."""
    variance_m2 = np.einsum("nii->n", survey.led_covariance_m2) / 3
    return np.sqrt(np.where(survey.surveyed, variance_m2, uncertainty.led_sigma_m**2))


def stray_lights(run: SurveyRun) -> list[StrayLight]:
    """Lights at rest in the lab that are no known LED."""
    frame = [np.zeros(0, np.int64)]
    xy_px = [np.zeros((0, 2))]
    for k, match in enumerate(run.inliers):
        if run.survey.tied[k]:
            lights = run.frames[k].lights.xy_px
            xy_px.append(np.delete(lights, match.light, axis=0))
            frame.append(np.full(len(xy_px[-1]), k))
    return survey_faults.stray_lights(
        run.held, np.concatenate(frame), np.concatenate(xy_px), STRAY_SIGMA_PX, STRAY_REACH_M
    )


def residuals_px(run: SurveyRun) -> tuple[Floats, Floats]:
    """(M, 2) pixels of all correspondences without outliers, and their residuals: found minus predicted."""
    survey = run.survey
    found = [np.zeros((0, 2))]
    residual = [np.zeros((0, 2))]
    for frame, match, tied in zip(run.frames, run.inliers, survey.tied, strict=True):
        used = survey.surveyed[match.led] & tied
        xy_px = frame.lights.xy_px[match.light[used]]
        place_m = survey.leds.position_m[match.led[used]]
        found.append(xy_px)
        residual.append(xy_px - project(frame.body_from_lab, place_m, survey.lever, survey.camera))
    return np.concatenate(found), np.concatenate(residual)


def light_table(run: SurveyRun) -> LightTable:
    """What the frames show of each LED, and what each must show."""
    index = np.array([frame.index for frame in run.frames])
    return LightTable(
        light_at_unit_distance(run), run.held.shown(*margins(run)), run.prior.expected_light(index)
    )


def margins(run: SurveyRun) -> tuple[Floats, float]:
    """Margin of the chip for each LED, and distance between LEDs, by the errors of the places as well."""
    sizes = image_sizes(run.prior)
    place_px = run.accuracy.led_sigma_m * run.prior.px_per_m
    return sizes.margin_px + GATE_SIGMAS * place_px, sizes.apart_px


def light_at_unit_distance(run: SurveyRun) -> Floats:
    """(F, N) light of each LED in each frame, multiplied with its squared distance; NaN if it is not identified."""
    out = np.full(run.seen.shape, np.nan)
    survey = run.survey
    camera_m = survey.body_from_lab.inv().apply(np.tile(survey.lever.camera_body_m, (len(out), 1)))
    for k, (frame, match) in enumerate(zip(run.frames, run.inliers, strict=True)):
        squared_m2 = np.sum((survey.leds.position_m[match.led] - camera_m[k]) ** 2, axis=1)
        out[k, match.led] = np.maximum(frame.lights.flux[match.light], 1e-9) * squared_m2
    return out
