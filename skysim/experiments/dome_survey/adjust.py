"""Identification of a survey's LEDs and adjustment of all unknowns, in rounds.

The IMU gives the attitude of each frame to about half a degree. In the first round the detections are matched to LEDs
by it. Its error shifts all lights of a frame together by more than the LED spacing, so the most likely common shift is
found first (`survey_frames.common_shift_px`). Then `estimator.calibration.dome_survey.survey` adjusts LED positions,
lever arm, lens and attitudes together by least squares, and places and light together give the LEDs their names. All is
repeated with the improved values. LEDs that are found far from their place in the list start the last rounds where they
were found. The result is a `DomeMap`, the file that `tracker.map` reads.
"""

import math
from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from estimator.attitude.dome_map import LedMap
from estimator.calibration import dome_survey, survey_faults, survey_subset
from estimator.calibration.bundle_adjustment import Assumed
from estimator.calibration.dome_survey import DomeFrame, DomeSurvey
from skysim.core.errors import InputError
from skysim.core.types import Bools, Floats, median
from skysim.experiments.dome_survey.survey_findings import (
    SurveyRun,
    identified,
    light_table,
    stray_lights,
)
from skysim.experiments.dome_survey.survey_frames import (
    CalibrationPrior,
    Correspondences,
    SurveyFrame,
    match_by_imu,
    match_by_survey,
    survey_model,
)
from skysim.simulation.flight import Progress
from skysim.tracking.dome_map_file import DomeMap

# Least number of LEDs that a frame shares with others: two determine its attitude.
MIN_SHARED_LEDS = 3
MAX_UNCONNECTED = 0.5  # greatest fraction of the frames that is left out at a time

# Rounds of identification and adjustment; from the second on with the adjusted values.
ROUNDS = 3
MOVED_ROUNDS = 2  # further rounds if LEDs are far from their places in the list

# Least fraction of a frame's lights that are matched, and of these that fit the adjustment; far fewer do by chance.
MIN_MATCHED = 0.5
# Least fraction that are matched in the first round, relative to the median of the frames: a field shifted by one LED
# matches about 0.6 of its lights, a right one all. Later rounds tell such fields apart by the LEDs measured, and must
# not refuse frames with displaced LEDs.
MIN_OF_MEDIAN = 0.8
# Standard deviations by which a parameter may move from the assumed one, and their least value relative to the standard
# deviation of the assumed one.
PLAUSIBLE = 6.0
LEAST_SHARE = 0.1
# Factor by which residuals may exceed the noise of the centroids before the lens is doubted.
MAX_NOISE_SCALE = 3.0
Matches = dict[int, Correspondences]  # by row of the frame
MAX_DISPLACEMENT_M = 0.1  # greatest distance of an LED from its place in the list


def run_survey(
    frames: Sequence[SurveyFrame],
    prior: CalibrationPrior,
    watch: Progress | None = None,
) -> SurveyRun:
    """Survey LEDs, lever arm, lens and attitudes from all frames, starting from `prior` with its uncertainty.

    Parameters
    ----------
    watch
        Called with the rounds done and the number of rounds after each round

    Raises
    ------
    InputError
        If the frames do not determine the unknowns, the result contradicts the prior, or the lens has a distortion that
        the prior lacks.
    """
    try:
        run = survey_in_rounds(frames, prior, watch)
    except InputError:
        check_lens(frames, prior)
        raise
    if run.survey.noise_scale > MAX_NOISE_SCALE:
        check_lens(frames, prior)
    return run


def check_lens(frames: Sequence[SurveyFrame], prior: CalibrationPrior) -> None:
    """Raise InputError if the frames are those of a lens whose distortion the survey does not model.

    More frames would not help: a survey that fits the distortion succeeds, and finds another one than assumed.
    """
    if prior.uncertainty.fit_distortion:
        return
    fitted = prior._replace(uncertainty=prior.uncertainty._replace(fit_distortion=True))
    try:
        survey = survey_in_rounds(frames, fitted).survey
    except InputError:
        return
    sigma = lens_sigma(survey)[3:7]
    change = (survey.camera.lens - prior.camera.lens)[3:7]
    if (np.abs(change) > PLAUSIBLE * sigma).any():
        raise InputError(
            "survey",
            f"the lens has k1 = {survey.camera.distortion[0]:.3g} ± {sigma[0]:.2g}, the model"
            f" {prior.camera.distortion[0]:.3g}",
            "a camera with its distortion, or a fit of the distortion",
        )


def survey_in_rounds(
    frames: Sequence[SurveyFrame],
    prior: CalibrationPrior,
    watch: Progress | None = None,
) -> SurveyRun:
    """As `run_survey`, with the lens model as it is."""

    def adjusted(matches: Matches, prior: CalibrationPrior) -> SurveyRun:
        pairs = [
            (replace(frames[row], body_from_lab=start[row]), match)
            for row, match in matches.items()
        ]
        selected, survey = adjust_connected(pairs, prior, before)
        named = list(matches.items())
        kept = dict(named[k] for k in selected)
        start.update(zip(kept, survey.body_from_lab, strict=True))
        return with_names(SurveyRun(survey, frames, kept, listed, prior))

    listed = prior.leds
    before = survey_model(prior, prior.floor_px).assumed
    total = ROUNDS + MOVED_ROUNDS
    start = {row: frame.body_from_lab for row, frame in enumerate(frames)}
    run = adjusted(identified_by_imu(frames, prior), prior)
    for completed in range(1, total):
        if watch:
            watch(completed, total)
        if completed == ROUNDS:
            moved = displaced_leds(run)
            if not moved:
                break
            run = with_places(run, moved)
        run = adjusted(*rematched(run))
    if watch:
        watch(total, total)
    check_plausible(run, before)
    return run


def check_plausible(run: SurveyRun, before: Assumed) -> None:
    """Raise InputError if the survey found a focal length or a lever arm that contradicts what was assumed before.

    If frames are misidentified, the adjustment can fit them with a model that is far from the real one, such as half
    the focal length with the camera close to the dome, and with small residuals and standard deviations. The assumed
    value is one of the adjustment's measurements, so its correction has the variance P0 - P, with P0 before and P after
    (the innovation of a linear estimate). Only such an error moves a value by more than PLAUSIBLE standard deviations.
    The variance is taken to be at least LEAST_SHARE^2 P0, for frames that add next to nothing.
    """
    found = run.survey
    accuracy = run.accuracy
    lever_sigma_m, focal_sigma_px = before.weight[2:] ** -0.5
    columns = (
        [before.focal_px, *(1e3 * before.camera_body_m)],
        [found.camera.focal_px, *(1e3 * found.lever.camera_body_m)],
        [accuracy.lens_sigma[0], *(1e3 * accuracy.lever_sigma_m)],
        [focal_sigma_px, *[1e3 * lever_sigma_m] * 3],
        ["focal px", *(f"lever {axis} mm" for axis in "xyz")],
    )
    for then, now, sigma, known, name in zip(*columns, strict=True):
        if abs(now - then) > PLAUSIBLE * math.sqrt(
            max(known**2 - sigma**2, (LEAST_SHARE * known) ** 2)
        ):
            raise InputError(
                "survey",
                f"{name} {now:.5g} ± {sigma:.2g} contradicts the assumed {then:.5g} ± {known:.2g}: lights are"
                " misidentified",
                "further frames, or a larger uncertainty of what is assumed",
            )


def identified_by_imu(frames: Sequence[SurveyFrame], prior: CalibrationPrior) -> Matches:
    """The correspondences of the frames that the IMU's attitudes identify, by row. Raises InputError for none."""
    matches = [match_by_imu(frame, prior) for frame in frames]
    shares = [
        matched_share(frame, match, prior)
        for frame, match in zip(frames, matches, strict=True)
    ]
    least = max(MIN_MATCHED, MIN_OF_MEDIAN * median(shares))
    rows = np.flatnonzero(np.array(shares) >= least).tolist()
    if not rows:
        raise InputError(
            "survey",
            f"in none of the {len(frames)} frames do the lights fit the LEDs of the list",
            "attitudes, LEDs and a camera that are true within the uncertainties",
        )
    return {row: matches[row] for row in rows}


def matched_share(
    frame: SurveyFrame, match: Correspondences, model: CalibrationPrior
) -> float:
    """Fraction of a frame's lights that are matched, or of its LEDs if they are fewer; 0 if too few connect it."""
    if len(match.led) < MIN_SHARED_LEDS:
        return 0.0
    visible = int(np.count_nonzero(model.camera.contains(model.pixels(frame.body_from_lab))))
    return min(1.0, len(match.led) / max(1, min(len(frame.lights), visible)))


def rematched(run: SurveyRun) -> tuple[Matches, CalibrationPrior]:
    """The matches of the frames that are identified, by the adjusted model, and that model.

    A frame that was left out, or has too few matches with its adjusted attitude, was misidentified as a whole: it is
    matched again with the IMU's attitude, since lever and lens now are known better.
    """
    survey = run.survey
    prior = run.prior
    model = run.found
    # The attitudes are adjusted, so only the errors of the map and of the residuals remain in the predictions.
    map_px = run.accuracy.led_sigma_m * model.px_per_m
    sigma_px = np.hypot(map_px, max(survey.rms_px, prior.floor_px))
    tied = {
        row: frame
        for row, (frame, _), ok in zip(run.matches, run.pairs, survey.tied, strict=True)
        if ok
    }
    matches = {}
    for row, frame in enumerate(run.taken):
        match = match_by_survey(tied[row], model, sigma_px) if row in tied else None
        if match is None or matched_share(tied[row], match, model) < MIN_MATCHED:
            match = match_by_imu(frame, model, sigma_px)
            if matched_share(frame, match, model) < MIN_MATCHED:
                continue
        matches[row] = match
    # Keep the map from before the survey: it enters each adjustment as a measurement, as the assumed lever does.
    return matches, prior._replace(camera=survey.camera, lever=survey.lever)


def with_names(run: SurveyRun) -> SurveyRun:
    """The run with LED names by place and light together (`estimator.calibration.survey_faults.names`).

    An LED that is not measured keeps its name, or gets a free one if another LED has taken it.
    """
    survey = run.survey
    listed_m = run.listed.position_m
    old, new = survey_faults.names(
        light_table(run), listed_m, survey.leds.position_m, survey.led_covariance_m2
    )
    if (old == new).all():
        return run
    name = np.arange(len(listed_m))
    name[old] = new
    name[np.setdiff1d(new, old)] = np.setdiff1d(old, new)
    position_m = run.prior.leds.position_m.copy()
    position_m[new] = survey.leds.position_m[old]
    order = np.argsort(name)
    renamed = replace(
        survey,
        leds=replace(survey.leds, position_m=position_m),
        led_covariance_m2=survey.led_covariance_m2[order],
        surveyed=survey.surveyed[order],
        common_m=survey.common_m[:, order],
    )
    matches = {
        row: Correspondences(match.light, name[match.led])
        for row, match in run.matches.items()
    }
    return replace(run, survey=renamed, matches=matches)


def displaced_leds(run: SurveyRun) -> dict[int, Floats]:
    """Rows and places of LEDs found far from their places in the list: measured LEDs, and stray lights with a name."""
    survey = run.survey
    rows, _ = survey_faults.displaced(
        run.listed.position_m, survey.leds.position_m, survey.led_covariance_m2
    )
    places = {int(row): survey.leds.position_m[row] for row in rows}
    strays = stray_lights(run)
    missing = np.flatnonzero(~run.seen.any(axis=0))
    named = survey_faults.name_strays(
        strays, missing, run.listed.position_m, MAX_DISPLACEMENT_M
    )
    return places | {led: strays[k] for led, k in named}


def with_places(run: SurveyRun, places: dict[int, Floats]) -> SurveyRun:
    """The run with these LEDs at other places, both before and after the survey."""

    def moved(leds: LedMap) -> LedMap:
        position_m = leds.position_m.copy()
        for row, place_m in places.items():
            position_m[row] = place_m
        return replace(leds, position_m=position_m)

    prior = run.prior
    survey = run.survey
    return replace(
        run,
        prior=prior._replace(leds=moved(prior.leds)),
        survey=replace(survey, leds=moved(survey.leds)),
    )


def adjust_connected(
    pairs: Sequence[tuple[SurveyFrame, Correspondences]],
    prior: CalibrationPrior,
    before: Assumed,
) -> tuple[list[int], DomeSurvey]:
    """Adjust the largest group of connected frames. Returns its rows and the survey.

    A frame may be connected only by misidentified lights. The adjustment rejects these and refuses the frame, or it
    keeps the few lights that fit a wrong attitude by chance. Such frames are left out. Raises InputError if the
    frames that remain do not determine the unknowns.
    """
    selected = largest_connected_group(led_visibility(pairs, prior), MIN_SHARED_LEDS)
    while True:
        try:
            # The loss is robust, and the values assumed before the survey are measurements.
            survey = dome_survey.survey(
                [
                    DomeFrame(
                        match.led,
                        frame.lights.xy_px[match.light],
                        frame.lights.sigma_px[match.light],
                        frame.body_from_lab,
                    )
                    for frame, match in map(pairs.__getitem__, selected)
                ],
                prior.leds,
                prior.lever,
                prior.camera,
                fit_distortion=prior.uncertainty.fit_distortion,
                leds_sigma_m=prior.uncertainty.led_sigma_m,
                fit_noise=True,
                assumed=before,
            )
        except survey_subset.Unconnected as error:
            if len(error.frames) > MAX_UNCONNECTED * len(selected):
                raise InputError("", error) from None
            selected = np.delete(selected, error.frames).tolist()
        except ValueError as error:
            raise InputError("", error) from None
        else:
            matched = np.array([len(pairs[k][1].led) for k in selected])
            rejected = np.bincount(survey.outliers[:, 0], minlength=len(selected))
            is_wrong = survey.tied & (matched - rejected < MIN_MATCHED * matched)
            if not is_wrong.any():
                return selected, survey
            selected = np.array(selected)[~is_wrong].tolist()


def led_visibility(
    pairs: Sequence[tuple[SurveyFrame, Correspondences]], prior: CalibrationPrior
) -> Bools:
    """(F, N) mask of the LEDs in each frame, without LEDs whose rays are nearly parallel in all frames.

    Such an LED, seen from camera positions close together, has no measurable distance and connects no frames.
    """
    visible = identified([match for _, match in pairs], len(prior.leds.id))
    camera_m = np.array(
        [frame.body_from_lab.inv().apply(prior.lever.camera_body_m) for frame, _ in pairs]
    ).reshape(-1, 3)
    angle_rad = survey_subset.ray_angles(
        prior.leds.position_m, camera_m, *np.nonzero(visible)
    )
    return visible & (angle_rad > survey_subset.CONNECTING_RAD)


def largest_connected_group(visible: Bools, min_shared: int) -> list[int]:
    """Indices of the largest group of frames connected by shared LEDs.

    Frames outside the group have an undetermined position relative to it, which `dome_survey.survey` rejects. A group
    grows from the frame with the most LEDs, adding connected frames until none is left.

    Parameters
    ----------
    visible
        (F, N) mask of the LEDs in each frame
    min_shared
        Minimum number of LEDs that a frame shares with the rest of the group
    """
    remaining = np.ones(len(visible), dtype=bool)
    best = np.zeros_like(remaining)
    while remaining.any():
        first = int(np.argmax(remaining * (1 + visible.sum(axis=1))))
        left = visible & remaining[:, None]
        group = survey_subset.connected_group(left, first, min_shared)
        remaining &= ~group
        best = max(best, group, key=np.sum)
    return np.flatnonzero(best).tolist()


def lens_sigma(survey: DomeSurvey) -> Floats:
    """(8,) standard deviations of focal_px, center x and y, k1, k2, p1, p2, k3; 0 for those not fitted."""
    fitted = np.sqrt(np.maximum(np.diag(survey.lens_covariance), 0))
    return np.concatenate([fitted, np.zeros(8 - len(fitted))])


def dome_map(run: SurveyRun) -> DomeMap:
    """The map file of a survey for the tracker: surveyed LEDs, lever arm, lens, and their standard deviations."""
    survey = run.survey
    leds = survey.surveyed_leds
    focal_sigma_px, x_sigma_px, y_sigma_px, *k_sigma = lens_sigma(survey).tolist()
    return DomeMap(
        id=leds.id,
        position_m=leds.position_m,
        sigma_m=run.accuracy.led_sigma_m[survey.surveyed],
        camera_body_m=survey.lever.camera_body_m,
        lever_sigma_m=math.sqrt(np.trace(survey.lever_covariance_m2) / 3),
        size_px=(survey.camera.width_px, survey.camera.height_px),
        focal_px=survey.camera.focal_px,
        focal_sigma_px=focal_sigma_px,
        center_px=survey.camera.center_px,
        center_sigma_px=(x_sigma_px, y_sigma_px),
        distortion=survey.camera.distortion,
        distortion_sigma=tuple(k_sigma),
        own_m2=leds.covariance_m2,
        common_m=leds.common_m,
        common_camera=leds.common_camera,
    )
