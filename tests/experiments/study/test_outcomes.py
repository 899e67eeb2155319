"""Rows have misidentified lights, noise and attitude: against the scene and injected errors."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from estimator.core.types import StarMatch, ra_dec_roll_rad
from estimator.trackers.pipeline import Report
from skysim.core.types import Floats
from skysim.experiments.study import study_file
from skysim.experiments.study.execution import outcomes, trials
from skysim.experiments.study.execution.outcomes import SAME_LIGHT_PX, Outcome, TrueLights
from skysim.experiments.study.execution.trials import TrialSetup
from skysim.experiments.study.plan import TrialSpec
from skysim.simulation.flight import Flight
from skysim.simulation.lab import exposure_window

SKY = TrialSpec("shefex2", ".", 1, {"light.limit_mag": 6.0}, {"kind": "centroids"}, True)
DOME = TrialSpec("afit_simsat", ".", 1, {}, {"kind": "centroids"}, True)
ARCMIN_RAD = math.radians(1 / 60)


def solved(spec: TrialSpec, seed: int = 3) -> tuple[TrialSetup, Report, TrueLights]:
    """A centroid trial's report and true lights."""
    setup = trials.prepared_setup(spec, {})
    ((lights, report),) = trials.solved_centroids(setup, [seed])
    assert report.attitude.solved
    return setup, report, lights


def scored(setup: TrialSetup, report: Report, lights: TrueLights) -> Outcome:
    return outcomes.score(setup.lab, setup.estimator, report, lights)


def with_match(report: Report, star: Floats) -> Report:
    """The report with other stars or LEDs for the same lights."""
    match = report.attitude.match
    assert match is not None
    changed = StarMatch(
        match.observed, star.astype(np.int64), match.cam_from_ref, match.log10_chance
    )
    return Report(replace(report.attitude, match=changed), report.centroids)


@pytest.mark.parametrize("spec", [SKY, DOME])
def test_a_light_matched_with_a_wrong_star_is_a_misidentification(spec: TrialSpec) -> None:
    """One of the matches is given the star of another: in a field of degrees that is tens of pixels off."""
    setup, report, lights = solved(spec)
    assert scored(setup, report, lights).misidentified == 0
    match = report.attitude.match
    assert match is not None
    for k in range(len(match.star)):
        star = match.star.copy()
        star[k] = star[k - 1]
        planted = scored(setup, with_match(report, star), lights)
        assert (planted.misidentified, planted.roll_noise, planted.wrong) == (1, 0, 0)
        # The attitude is the right one still.
        assert (planted.wrong_matches, planted.misled) == (1, 0)


@pytest.mark.parametrize("spec", [SKY, DOME])
@pytest.mark.parametrize(
    ("distance_px", "wrong"), [(SAME_LIGHT_PX - 0.6, 0), (SAME_LIGHT_PX + 0.6, 1)]
)
def test_a_light_belongs_to_a_star_within_three_pixels(
    spec: TrialSpec, distance_px: float, wrong: int
) -> None:
    setup, report, lights = solved(spec)
    match = report.attitude.match
    assert match is not None
    moved_px = report.centroids.xy_px.copy()
    moved_px[match.observed[0]] += [distance_px, 0]
    moved = Report(report.attitude, replace(report.centroids, xy_px=moved_px))
    assert scored(setup, moved, lights).misidentified == wrong


@pytest.mark.parametrize(("sigmas", "misled"), [(5.0, 0), (7.0, 1)])
def test_wrong_lights_count_as_harmful_if_the_error_exceeds_its_claim(
    sigmas: float, misled: int
) -> None:
    """NEES 25 is allowed, 49 is not (40.8 has the probability 1e-8); with the right lights neither is misled."""
    setup, report, lights = solved(SKY)
    truth = setup.lab.camera.mount.cam_from_body * lights.lab_from_body.inv()
    error = Rotation.from_rotvec([sigmas * 1e-6, 0, 0])
    attitude = replace(
        report.attitude, cam_from_ref=error * truth, covariance_rad2=1e-12 * np.eye(3)
    )
    assert scored(setup, Report(attitude, report.centroids), lights).misled == 0
    match = report.attitude.match
    assert match is not None
    star = match.star[[1, 0, *range(2, len(match.star))]]
    planted = scored(setup, with_match(Report(attitude, report.centroids), star), lights)
    assert (planted.misidentified, planted.wrong_matches, planted.misled) == (1, 2, misled)


def test_a_light_displaced_by_motion_still_belongs_to_its_star() -> None:
    """Pulses and rolling shutters displace the mean image of a light: centroids there are right, others are not."""
    setup, report, lights = solved(SKY)
    shift_px = np.array([9.0, -4.0])
    displaced = lights._replace(flux_xy_px=lights.xy_px + shift_px)
    moved = Report(
        report.attitude, replace(report.centroids, xy_px=report.centroids.xy_px + shift_px)
    )
    assert scored(setup, moved, displaced).misidentified == 0
    assert scored(setup, report, displaced).misidentified == 1
    assert scored(setup, moved, displaced).centroid_px == pytest.approx(
        scored(setup, report, lights).centroid_px
    )


@pytest.mark.parametrize(
    ("roll_arcmin", "sigma_arcmin", "noise", "wrong"),
    [(12, 5, 1, 0), (9, 5, 0, 0), (12, 1, 0, 1), (70, 40, 1, 1)],
)
def test_correctly_claimed_roll_noise_beyond_ten_arcminutes_is_not_wrong(
    roll_arcmin: float, sigma_arcmin: float, noise: int, wrong: int
) -> None:
    """NEES is (roll / sigma)^2: 5.8 and 3.2 and 3.1 are allowed, 144 is not."""
    setup, report, lights = solved(DOME)
    truth = setup.lab.camera.mount.cam_from_body * lights.lab_from_body.inv()
    sigma_rad = ARCMIN_RAD * np.array([1.0, 1.0, sigma_arcmin])
    attitude = replace(
        report.attitude,
        cam_from_ref=Rotation.from_rotvec([0, 0, roll_arcmin * ARCMIN_RAD]) * truth,
        covariance_rad2=np.diag(sigma_rad**2),
    )
    outcome = scored(setup, Report(attitude, report.centroids), lights)
    assert outcome.nees == pytest.approx((roll_arcmin / sigma_arcmin) ** 2, rel=1e-6)
    assert (outcome.misidentified, outcome.roll_noise, outcome.wrong) == (0, noise, wrong)


def test_a_regular_spiral_is_refused_as_ambiguous() -> None:
    plan = study_file.load("led_count")
    point = next(
        one for one in plan.points if one.levels == {"leds": 1000, "placement": "spiral"}
    )
    rows = trials.TrialJob(plan.spec).run((trials.Segment(0, point.settings, 0, range(20)),))
    ambiguous = [row.outcome for row in rows if row.outcome.ambiguous]
    assert len(ambiguous) > 10
    assert all(one.solved == 0 and one.status.startswith("ambiguous") for one in ambiguous)


def test_centroids_scatter_as_declared_in_the_trial() -> None:
    """RMS about each axis over 200 trials of some 20 lights each: to 4 standard errors, 0.3 / sqrt(2 * 4000)."""
    rows = trials.TrialJob(SKY).run(
        (trials.Segment(0, {"trial.noise_px": 0.3}, 0, range(200)),)
    )
    weighted = [
        (row.outcome.centroid_px**2 * row.outcome.detected, row.outcome.detected)
        for row in rows
    ]
    mean_square, lights = np.sum(weighted, axis=0)
    assert math.sqrt(mean_square / lights) == pytest.approx(
        0.3, abs=4 * 0.3 / math.sqrt(4 * lights)
    )


def test_false_lights_have_no_centroid_error() -> None:
    centroids_px = np.array([[10.0, 10.3], [50.0, 50.0]])
    true_px = np.array([[10.0, 10.0], [90.0, 90.0]])
    assert outcomes.distances_px(centroids_px, true_px, 3.0) == pytest.approx([0.3])
    assert math.isnan(outcomes.rms(outcomes.distances_px(centroids_px[1:], true_px, 3.0)))
    assert math.isnan(outcomes.rms(outcomes.distances_px(np.empty((0, 2)), true_px, 3.0)))


def test_a_detection_is_of_a_light_or_of_none() -> None:
    """Of three lights one has two detections and one has none; a detection is far from all of them."""
    lights_px = np.array([[10.0, 10.0], [50.0, 50.0], [90.0, 90.0]])
    centroids_px = np.array([[10.0, 12.9], [8.0, 10.0], [53.1, 50.0], [90.0, 89.0]])
    assert len(outcomes.distances_px(lights_px, centroids_px, 3.0)) == 2
    assert len(outcomes.distances_px(centroids_px, lights_px, 3.0)) == 3
    assert not len(outcomes.distances_px(centroids_px, np.empty((0, 2)), 3.0))
    assert not len(outcomes.distances_px(np.empty((0, 2)), lights_px, 3.0))


def test_all_detections_without_noise_are_of_lights_and_false_ones_are_counted() -> None:
    for false in (0, 4):
        trial = {"trial.noise_px": 0.01, "trial.false_lights": false}
        rows = trials.TrialJob(SKY).run((trials.Segment(0, trial, 0, range(5)),))
        for one in (row.outcome for row in rows):
            assert one.lights_detected == one.stars
            # A false one may fall on a light.
            assert one.detected - one.stars - 1 <= one.false_detections <= false


@pytest.mark.slow
def test_a_streak_is_as_long_as_the_rate_times_the_exposure() -> None:
    spec = replace(SKY, trial={"kind": "frames", "rate_deg_s": 4.0})
    setup = trials.prepared_setup(spec, {})
    expected_px = (
        math.radians(4.0) * setup.lab.scene.exposure.time_s * setup.lab.scene.camera.focal_px
    )
    assert trials.run_frame_trial(setup, 5).streak_px == pytest.approx(expected_px, rel=0.03)
    assert math.isnan(
        trials.run_centroid_trials(trials.prepared_setup(SKY, {}), [5])[0].streak_px
    )


@pytest.mark.slow
def test_frames_of_a_closed_loop_have_the_streaks_of_their_lights_in_the_true_motion() -> (
    None
):
    """The LEDs of each frame, projected from where the camera is as its exposure opens and closes."""
    base = {"exposure.frames": 3, "vehicle.imu": {}, "filter": {"start_deg": 0.1}}
    setup = trials.prepared_setup(replace(DOME, base=base, trial={"kind": "flight"}), {})
    flight = trials.trial_flight(setup, 4)
    streaks_px = [
        outcome.streak_px for _, outcome in trials.flight_outcomes(flight, setup.estimator)
    ]
    projected_px = [median_path_px(flight, index) for index in range(3)]
    assert max(projected_px) > 0.5
    assert streaks_px == pytest.approx(projected_px, rel=0.05)


def median_path_px(flight: Flight, index: int) -> float:
    """Median path length, px, of a frame's lights during its exposure."""
    camera = flight.lab.camera
    seen = np.isin(camera.sources.id, flight.render(index)[1].sources.id)
    window = exposure_window(camera.scene, index)
    ends_px = []
    for t_s in (window.open_s, window.open_s + window.exposure_s):
        lab_from_body = flight.trajectory().attitude_at(t_s)
        offset_m = (
            lab_from_body.inv().apply(camera.sources.place[seen, :3])
            - camera.mount.camera_body_m
        )
        ends_px.append(camera.optics.project(camera.mount.cam_from_body.apply(offset_m)))
    return float(np.median(np.hypot(*(ends_px[1] - ends_px[0]).T)))


def test_each_row_has_the_attitude_of_its_trial() -> None:
    """The quaternion is that of the draw; under the dome tilt and azimuth are those of the body's axis."""
    for spec in (SKY, DOME):
        setup = trials.prepared_setup(spec, {})
        drawn = trials.random_attitudes(setup, [trials.streams(setup, 8)[0]])[0]
        (outcome,) = trials.run_centroid_trials(setup, [8])
        wxyz = [getattr(outcome, f"lab_from_body_{axis}") for axis in "wxyz"]
        assert (Rotation.from_quat(wxyz, scalar_first=True) * drawn.inv()).magnitude() < 1e-12
        if spec is DOME:
            tilt, azimuth = np.radians([outcome.body_tilt_deg, outcome.body_azimuth_deg])
            axis = [
                math.sin(tilt) * math.cos(azimuth),
                math.sin(tilt) * math.sin(azimuth),
                math.cos(tilt),
            ]
            assert drawn.apply([0, 0, 1]) == pytest.approx(axis, abs=1e-12)
            assert math.isnan(outcome.boresight_ra_deg)
        else:
            ra, dec, _ = np.degrees(
                ra_dec_roll_rad(setup.lab.camera.mount.cam_from_body * drawn.inv())
            )
            assert (outcome.boresight_ra_deg, outcome.boresight_dec_deg) == pytest.approx(
                (ra, dec), abs=1e-9
            )
            assert math.isnan(outcome.body_tilt_deg)


def test_the_worst_frame_of_a_flight_is_a_wrong_one_then_an_unsolved_one_then_the_largest_error() -> (
    None
):
    small, large = (Outcome("solved", 1, 1, 0, error, 0.0, 0.0) for error in (1.0, 50.0))
    unsolved = Outcome("ambiguous", 1)
    wrong = Outcome("solved", 1, 1, 1, 5.0, 0.0, 0.0)
    assert outcomes.worst_frame([small, large]) is large
    assert outcomes.worst_frame([small, unsolved, large]) is unsolved
    assert outcomes.worst_frame([small, wrong, unsolved, large]) is wrong
    assert outcomes.worst_frame([]) == outcomes.FAILED
