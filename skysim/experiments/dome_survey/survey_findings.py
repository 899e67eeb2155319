"""Findings of a survey: the LEDs measured and their errors, the attitudes to hold next, and faults of the dome."""

import math
from collections.abc import Iterator, Sequence
from dataclasses import replace
from typing import NamedTuple

import numpy as np
from numpy.typing import ArrayLike
from scipy.spatial.transform import Rotation

from estimator.attitude.dome_map import LedMap, Lever, project
from estimator.calibration import survey_faults, survey_plan
from estimator.calibration.bundle_adjustment import Sightings
from estimator.calibration.dome_survey import DomeSurvey
from estimator.calibration.survey_faults import LightTable
from estimator.calibration.survey_plan import SurveyAccuracy, SurveyModel
from skysim.core.types import UP, Bools, Floats, Record, frozen, lengths, median
from skysim.experiments.dome_survey.survey_frames import (
    ANGLES,
    GATE_SIGMAS,
    CalibrationPrior,
    Correspondences,
    SurveyFrame,
    match_by_imu,
    planned_stops,
    survey_model,
)
from skysim.results.metrics import rms
from skysim.results.telemetry_report import euler_deg
from skysim.scene.scene import Scene
from skysim.sources.dome.layouts.placing import tilts_rad

# A survey after its last round: frames, correspondences, light of each LED, stray lights.


EXACT_M = 1e-9  # error of the list below which it agrees with the frames
STRAY_SIGMA_PX = 0.3  # error of a ray to a stray light, from the attitude and from blends
# Greatest distance on the dome between stray lights of two frames that may be one.
STRAY_REACH_M = 0.005


@frozen
class SurveyRun:
    """A survey with the frames and correspondences of its last round.

    Attributes
    ----------
    taken
        All frames, with the IMU's attitudes
    matches
        Correspondences of the frames in the survey, by their rows in `taken`
    listed
        The LEDs before the survey
    prior
        The model before the last round; its LEDs are the listed ones, with displaced LEDs at
        the places found
    """

    survey: DomeSurvey
    taken: Sequence[SurveyFrame]
    matches: dict[int, Correspondences]
    listed: LedMap
    prior: CalibrationPrior

    @property
    def pairs(self) -> list[tuple[SurveyFrame, Correspondences]]:
        """The frames of the survey with their adjusted attitudes, and the correspondences that were not rejected."""
        frame, row = self.survey.outliers.T
        found = zip(self.matches.items(), self.survey.body_from_lab, strict=True)
        return [
            (
                replace(self.taken[number], body_from_lab=attitude),
                Correspondences(*(np.delete(part, row[frame == k]) for part in match)),
            )
            for k, ((number, match), attitude) in enumerate(found)
        ]

    @property
    def sightings(self) -> Sightings:
        """All correspondences that were not rejected, frame by frame."""
        pairs = self.pairs
        return Sightings.of(
            [frame.lights.take(match.light) for frame, match in pairs],
            np.concatenate([match.led for _, match in pairs]),
        )

    @property
    def seen(self) -> Bools:
        """(F, N) mask of the LEDs identified in each frame."""
        return identified([match for _, match in self.pairs], len(self.listed.id))

    @property
    def noise_px(self) -> float:
        """Standard deviation of a centroid's coordinates by the residuals, for the mean information."""
        return self.survey.noise_scale / math.sqrt(np.mean(self.sightings.sigma_px**-2.0))

    @property
    def accuracy(self) -> SurveyAccuracy:
        """The standard deviations of the survey: of an LED's position, RMS of three axes.

        That of an LED that is not surveyed is as before.
        """
        survey = self.survey
        variance_m2 = np.einsum("nii->n", survey.led_covariance_m2) / 3
        before_m2 = self.prior.uncertainty.led_sigma_m**2
        return SurveyAccuracy(
            survey.surveyed,
            np.sqrt(np.where(survey.surveyed, variance_m2, before_m2)),
            np.sqrt(np.diag(survey.lever_covariance_m2)),
            np.sqrt(np.diag(survey.lens_covariance)),
        )

    @property
    def found(self) -> CalibrationPrior:
        """The model found; the uncertainty of IMU and unmeasured LEDs is as before, that of lever and lens as found."""
        accuracy = self.accuracy
        survey = self.survey
        after = self.prior.uncertainty._replace(
            lever_sigma_m=float(rms(accuracy.lever_sigma_m)),
            focal_error=float(accuracy.lens_sigma[0] / survey.camera.focal_px),
        )
        return self.prior._replace(
            camera=survey.camera, leds=survey.leds, lever=survey.lever, uncertainty=after
        )


def identified(matches: Sequence[Correspondences], leds: int) -> Bools:
    """(F, N) mask of the LEDs in the correspondences of each frame."""
    return np.array([np.isin(np.arange(leds), match.led) for match in matches])


def stray_lights(run: SurveyRun) -> list[Floats]:
    """Lights at rest in the lab that are not a known LED."""
    number = [np.zeros(0, np.int64)]
    xy_px = [np.zeros((0, 2))]
    for k, (frame, match) in enumerate(run.pairs):
        if run.survey.tied[k]:
            xy_px.append(np.delete(frame.lights.xy_px, match.light, axis=0))
            number.append(np.full(len(xy_px[-1]), k))
    return survey_faults.stray_lights(
        run.survey,
        np.concatenate(number),
        np.concatenate(xy_px),
        STRAY_SIGMA_PX,
        STRAY_REACH_M,
    )


def residuals_px(run: SurveyRun) -> tuple[Floats, Floats]:
    """(M, 2) pixels of all correspondences except outliers, and their residuals, detected minus predicted."""
    survey = run.survey
    every = run.sightings
    used = every.take(survey.surveyed[every.led] & survey.tied[every.frame])
    place_m = survey.leds.position_m[used.led]
    held = survey.body_from_lab[used.frame]
    return used.xy_px, used.xy_px - project(held, place_m, survey.lever, survey.camera)


def light_table(run: SurveyRun) -> LightTable:
    """The light of each LED in the frames, measured and expected."""
    index = np.array([frame.index for frame, _ in run.pairs])
    # The margin of the chip includes the errors of the places. Two images do not merge at twice the reach of one.
    margin_px = run.prior.margin_px
    place_px = run.accuracy.led_sigma_m * run.prior.px_per_m
    return LightTable(
        light_at_unit_distance(run),
        run.survey.shown(margin_px + GATE_SIGMAS * place_px, 2 * margin_px),
        run.prior.expected_light(index),
    )


def light_at_unit_distance(run: SurveyRun) -> Floats:
    """(F, N) light of each LED in each frame, multiplied with its squared distance; NaN if it is not identified."""
    out = np.full(run.seen.shape, np.nan)
    survey = run.survey
    camera_m = survey.body_from_lab.inv().apply(survey.lever.camera_body_m)
    for k, (frame, match) in enumerate(run.pairs):
        squared_m2 = np.sum((survey.leds.position_m[match.led] - camera_m[k]) ** 2, axis=1)
        out[k, match.led] = np.maximum(frame.lights.flux[match.light], 1e-9) * squared_m2
    return out


class Coverage(NamedTuple):
    """The frames held so far, and which LEDs they measure.

    Attributes
    ----------
    model
        Model by which further attitudes are chosen
    held, seen
        body_from_lab of F frames, and (F, N) mask of the LEDs in them
    accuracy
        Accuracy of the survey, or predicted before it; no LED is measured if the frames are too few
    """

    model: SurveyModel
    held: Rotation
    seen: Bools
    accuracy: SurveyAccuracy


def coverage(run: SurveyRun) -> Coverage:
    """The coverage of a survey."""
    known = run.found._replace(uncertainty=run.prior.uncertainty)
    model = survey_model(known, run.noise_px)
    return Coverage(model, run.survey.body_from_lab, run.seen, run.accuracy)


def coverage_before(
    frames: Sequence[SurveyFrame], prior: CalibrationPrior, noise_px: float
) -> Coverage:
    """The coverage of frames before their survey: LEDs named by the IMU's attitudes, and predicted accuracy."""
    matches = [match_by_imu(frame, prior) for frame in frames]
    held = Rotation.concatenate([frame.body_from_lab for frame in frames])
    model = survey_model(prior, noise_px)
    seen = identified(matches, len(prior.leds.id))
    return Coverage(model, held, seen, predicted(model, held, seen))


class NextStops(NamedTuple):
    """Attitudes to hold next, the LEDs that each shows, and the accuracy predicted with them (`predicted`)."""

    lab_from_body: Rotation
    shown: Bools
    accuracy: SurveyAccuracy


def next_stops(
    scene: Scene, so_far: Coverage, margin_px: float, count: int, tilt_deg: float
) -> NextStops:
    """Up to `count` attitudes after those held so far."""
    model = so_far.model
    further = planned_stops(
        scene, model, margin_px, count, tilt_deg, so_far.held, so_far.seen
    )
    attitudes = Rotation.concatenate([so_far.held, further.inv()])
    shown = model.visible(further.inv(), margin_px)
    seen = np.vstack([so_far.seen, shown])
    return NextStops(further, shown, predicted(model, attitudes, seen))


def predicted(model: SurveyModel, body_from_lab: Rotation, seen: Bools) -> SurveyAccuracy:
    """The accuracy predicted; no LED is measured if the frames do not determine the unknowns."""
    try:
        return survey_plan.predict(model, body_from_lab, seen)
    except ValueError:
        before_m = np.full(seen.shape[1], model.leds_sigma_m)
        measured = np.zeros_like(before_m, dtype=bool)
        return SurveyAccuracy(measured, before_m, np.empty(0), np.empty(0))


# --- faults -------------------------------------------------------------------------------------------------


def find_faults(run: SurveyRun) -> Record:
    """The faults that a survey shows, by LED number.

    Returns
    -------
    dark
        LEDs that no frame shows although it should
    displaced
        LED and its distance from the list's place, m
    list_sigma_m
        Error of the other places along each axis
    tested, tested_m
        Number of LEDs tested for displacement, and the displacement that is found (95 %) in half of
        them; None without any
    exchanged
        LED with another one at its place, that other one, and other LEDs that fit as well
    found_m
        Places, m, at which displaced LEDs and lights of exchanged ones were found
    unlisted
        Places, m, of lights at rest that are not an LED of the list
    exchange_share
        Fraction of the pairs of LEDs whose exchange would be found; 0 if all are alike, None if
        none are compared: too few are in enough frames, or the time of their code is unknown
    """
    survey = run.survey
    leds = run.listed
    table = light_table(run)
    rows, sigma_m = survey_faults.displaced(
        leds.position_m, survey.leds.position_m, survey.led_covariance_m2
    )
    size_m = survey_faults.found_displacements_m(survey.led_covariance_m2, sigma_m)
    off_m = lengths(survey.leds.position_m - leds.position_m)
    # The time of a code that runs freely is unknown, so the expected light of each LED is unknown.
    code = run.prior.code
    is_free = code is not None and code.bit_time_s is not None
    exchanges, share = ([], None) if is_free else survey_faults.exchanged(table)
    dark = survey_faults.dark(table.shown & (table.expected > 0), run.seen)
    return {
        "dark": leds.id[dark].tolist(),
        "displaced": {int(leds.id[row]): float(off_m[row]) for row in rows},
        "list_sigma_m": sigma_m,
        "tested": len(size_m),
        "tested_m": median(size_m) if len(size_m) else None,
        "exchanged": [
            (int(leds.id[x.led]), int(leds.id[x.shows]), leds.id[list(x.or_any_of)].tolist())
            for x in exchanges
        ],
        "found_m": {
            int(leds.id[row]): survey.leds.position_m[row].tolist()
            for row in (*rows, *(x.led for x in exchanges))
        },
        "unlisted": [place_m.tolist() for place_m in stray_lights(run)],
        "exchange_share": share,
    }


def fault_rows(faults: Record) -> Iterator[tuple[str, str, str, str]]:
    """LED, fault and details of each fault of `find_faults`, and a sentence on it."""
    at = {led: f"at {coordinates(place_m)} mm" for led, place_m in faults["found_m"].items()}
    for led in faults["dark"]:
        yield f"{led}", "dark", "no frame shows it", f"LED {led} is dark"
    for led, off_m in faults["displaced"].items():
        far = f"{1e3 * off_m:.1f} mm from its place in the list"
        yield f"{led}", "displaced", f"{far}, {at[led]}", f"LED {led} is {far}"
    for led, shows, others in faults["exchanged"]:
        alike = f" (or {', '.join(map(str, others))})" if others else ""
        shines = f"LED {shows}{alike} shines at"
        line = f"{shines} the place of LED {led}: wires or numbers exchanged"
        yield f"{led}", "exchanged", f"{shines} its place, {at[led]}", line
    for place_m in faults["unlisted"]:
        line = f"a light that is not in the list shines at {', '.join(f'{one:.3f}' for one in place_m)} m"
        yield "", "not in the list", f"a light at {coordinates(place_m)} mm", line


def coordinates(place_m: list[float]) -> str:
    """A place in millimeters."""
    return f"({', '.join(f'{1e3 * one:.1f}' for one in place_m)})"


def fault_lines(faults: Record) -> list[str]:
    """The faults of `find_faults` as lines of text, one per fault, and a summary line."""
    return [*(line for *_, line in fault_rows(faults)), fault_summary(faults)]


def fault_summary(faults: Record) -> str:
    """The numbers of faults, the error of the other places, and the exchanges that can be found."""
    share = faults["exchange_share"]
    observable = "exchanged LEDs cannot be found: all shine alike; codes or brightness levels would tell them apart"
    if share is None:
        observable = (
            f"exchanged LEDs are not searched for: too few are in {survey_faults.MIN_FRAMES} frames, or their code runs"
            " freely"
        )
    elif share > 0:
        observable = f"{100 * share:.0f} % of exchanges would be found"
    tested = f" of {faults['tested']} tested"
    if faults["tested"]:
        tested += f" (half of them show {1e3 * faults['tested_m']:.2g} mm or more)"
    list_m = faults["list_sigma_m"]
    others = (
        f"err by {1e3 * list_m:.2g} mm about each axis"
        if list_m > EXACT_M
        else "agree with the frames exactly"
    )
    return (
        f"{len(faults['dark'])} dark, {len(faults['displaced'])} displaced{tested}, {len(faults['exchanged'])}"
        f" exchanged; the other places of the list {others}; {observable}"
    )


# --- as numbers ---------------------------------------------------------------------------------------------


def attitude_record(body_from_lab: Rotation, covariance_rad2: Floats, lever: Lever) -> Record:
    """An attitude as numbers, with the covariance of its small rotation about the camera axes.

    Roll, pitch and yaw are the vehicle's. The quaternion, scalar last, turns the dome's axes (lab) to the camera's.
    """
    angles_deg = euler_deg(body_from_lab.inv()).tolist()
    cam_from_lab = lever.cam_from_body * body_from_lab
    return {
        **dict(zip(ANGLES, angles_deg, strict=True)),
        "cam_from_lab_xyzw": cam_from_lab.as_quat(canonical=True).tolist(),
        "covariance_rad2": covariance_rad2.tolist(),
    }


def attitude_rows(run: SurveyRun, names: Sequence[str]) -> list[Record]:
    """The attitude of each image by the survey (`attitude_record`), in the order of their names.

    The covariance includes the errors of LEDs, lever and lens. An image without an attitude has only a status.
    """
    survey = run.survey
    R_cam_from_body = survey.lever.cam_from_body.as_matrix()
    rows: list[Record] = [{"file": name, "status": "not identified"} for name in names]
    for k, (frame, match) in enumerate(run.pairs):
        row = rows[frame.index]
        row |= {"status": "too few surveyed LEDs", "matches": len(match.led)}
        if survey.tied[k]:
            covariance = (
                R_cam_from_body @ survey.attitude_covariance_rad2[k] @ R_cam_from_body.T
            )
            row |= attitude_record(frame.body_from_lab, covariance, survey.lever)
            row["status"] = "solved"
    return rows


def coverage_statistics(so_far: Coverage) -> Record:
    """Counts and errors of a coverage, one row for each LED."""
    frames = so_far.seen.sum(axis=0)
    measured = so_far.accuracy.measured
    return {
        "leds": len(frames),
        "measured": int(measured.sum()),
        "seen_once": int(np.sum(frames == 1)),
        "unseen": int(np.sum(frames == 0)),
        "by_led": rows_of_columns(
            led=so_far.model.leds.id,
            frames=frames,
            measured=measured,
            sigma_mm=1e3 * so_far.accuracy.led_sigma_m,
        ),
    }


def rows_of_columns(**columns: ArrayLike) -> list[Record]:
    """Rows as numbers from columns by name."""
    rows = zip(*(np.asarray(column).tolist() for column in columns.values()), strict=True)
    return [dict(zip(columns, row, strict=True)) for row in rows]


def accuracy_statistics(accuracy: SurveyAccuracy) -> Record:
    """Number of measured LEDs, rms errors of LEDs and lever in mm, and of focal length in px; None if undetermined."""
    if not accuracy.measured.any():
        return {"measured": 0, "led_mm": None, "lever_mm": None, "focal_px": None}
    return {
        "measured": int(accuracy.measured.sum()),
        "led_mm": 1e3 * accuracy.led_rms_m,
        "lever_mm": 1e3 * float(rms(accuracy.lever_sigma_m)),
        "focal_px": float(accuracy.lens_sigma[0]),
    }


def stop_rows(lab_from_body: Rotation, shown: Bools) -> list[Record]:
    """Attitudes as rows: roll, pitch, yaw and tilt in degrees, and the number of LEDs that each shows."""
    tilt_deg = np.degrees(tilts_rad(lab_from_body.apply(UP)))
    angles = dict(zip(ANGLES, euler_deg(lab_from_body).T, strict=True))
    return rows_of_columns(**angles, tilt_deg=tilt_deg, leds=shown.sum(axis=1))
