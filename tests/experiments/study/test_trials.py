"""A trial depends on its seed alone and has the physics of rendered frames."""

import math
from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from astropy import units as u
from astropy.coordinates import AltAz, EarthLocation, SkyCoord
from astropy.time import Time
from astropy.utils import iers
from scipy import stats
from scipy.spatial.transform import Rotation

from skysim.core.paths import SCENES
from skysim.experiments.study import plan
from skysim.experiments.study.execution import detections, store, trials
from skysim.experiments.study.plan import CentroidTrial, FrameTrial, TrialSpec
from skysim.simulation.exposure import render_at_rest
from skysim.sources.ephemeris import observe_from, place

SKY = TrialSpec("shefex2", ".", 1, {}, {"kind": "centroids"}, True)
DOME = TrialSpec("afit_simsat", ".", 1, {}, {"kind": "centroids"}, True)


def test_a_trial_does_not_depend_on_earlier_trials():
    settings = {"trial.false_lights": 3}
    first = trials.TrialJob(SKY).run((trials.Segment(5, settings, 500, range(0, 20)),))
    again = trials.TrialJob(SKY).run(
        (
            trials.Segment(5, settings, 513, range(13, 14)),
            trials.Segment(5, settings, 500, range(1)),
        ),
    )
    assert [row[:8] for row in again] == [row[:8] for row in (first[13], first[0])]


@pytest.mark.parametrize("spec", [SKY, DOME], ids=["sky", "dome"])
def test_trials_without_noise_are_solved(spec: TrialSpec) -> None:
    for row in trials.TrialJob(spec).run(
        (trials.Segment(0, {"trial.noise_px": 0.0}, 0, range(3)),)
    ):
        assert (row.error, row.outcome.status, row.outcome.wrong) == (None, "solved", 0)


def test_points_share_attitude_and_noise_by_default():
    unpaired = replace(SKY, paired=False)
    assert trials.seed_of(SKY, 1, 7) == trials.seed_of(SKY, 2, 7) != trials.seed_of(SKY, 1, 8)
    assert trials.seed_of(unpaired, 1, 7) != trials.seed_of(unpaired, 2, 7)


def test_an_exception_of_a_trial_is_in_its_row_with_the_seed():
    row = trials.TrialJob(SKY).run(
        (trials.Segment(0, {"camera.focal_length": "-1 mm"}, 0, range(1)),)
    )[0]
    assert row.outcome.status == "failed"
    assert row.outcome.frames == 0
    assert "camera.focal_length" in row.error
    assert row.seed == trials.seed_of(SKY, 0, 0)


@pytest.mark.parametrize(("spec", "key"), [(SKY, "trial.dec_deg"), (DOME, "trial.tilt_deg")])
def test_attitudes_are_uniform_over_the_allowed_range(spec, key):
    """Boresights by area, turns about them evenly: Kolmogorov and Smirnov's test, one in 10^4."""
    low, high = (-60.0, 30.0) if spec is SKY else (10.0, 30.0)
    ready = trials.prepared_setup(spec, {key: [low, high]})
    rng = np.random.default_rng(3)
    drawn = Rotation.concatenate(
        [trials.random_attitudes(ready, [rng])[0] for _ in range(2000)]
    )
    if spec is SKY:
        boresight = drawn.apply(ready.lab.camera.mount.cam_from_body.inv().apply([0, 0, 1]))
        ends = np.sin(np.radians([low, high]))
    else:
        boresight = drawn.apply([0, 0, 1])
        ends = np.cos(np.radians([high, low]))
    level = (boresight[:, 2] - ends[0]) / (ends[1] - ends[0])
    around = np.arctan2(boresight[:, 1], boresight[:, 0]) / (2 * np.pi) % 1
    for share in (level, around):
        assert stats.kstest(share, "uniform").pvalue > 1e-4
    assert (level >= 0).all()
    assert (level <= 1).all()


@pytest.mark.slow
def test_attitudes_near_the_zenith_are_at_their_altitudes():
    """Of the site at the scene's start, by astropy's AltAz."""
    site = {"latitude_deg": 53.1, "longitude_deg": 8.8}
    near = {"body": "zenith", "off_deg": [57.0, 63.0]}
    ready = trials.prepared_setup(
        SKY, {"start_time": "2012-10-29T22:00:00", "site": site, "trial.near": near}
    )
    rng = np.random.default_rng(4)
    drawn = Rotation.concatenate(
        [trials.random_attitudes(ready, [rng])[0] for _ in range(200)]
    )
    x, y, z = drawn.apply(ready.lab.camera.mount.cam_from_body.inv().apply([0, 0, 1])).T
    place = EarthLocation.from_geodetic(8.8, 53.1)
    with iers.conf.set_temp("auto_download", False):
        boresight = SkyCoord(np.arctan2(y, x) * u.rad, np.arcsin(z) * u.rad)
        altitude_deg = boresight.transform_to(
            AltAz(location=place, obstime=Time("2012-10-29T22:00:00"))
        ).alt.deg
    assert altitude_deg.min() > 27 - 0.01  # aberration
    assert altitude_deg.max() < 33 + 0.01
    assert altitude_deg.std() > 1


@pytest.mark.slow
def test_attitudes_near_a_body_are_uniform_about_it():
    """By the cosine of the angle from the Moon's place and by the angle around it."""
    near = {"body": "moon", "off_deg": [2.0, 8.0]}
    ready = trials.prepared_setup(
        SKY, {"start_time": "2012-07-03T18:00:00", "trial.near": near}
    )
    rng = np.random.default_rng(3)
    drawn = Rotation.concatenate(
        [trials.random_attitudes(ready, [rng])[0] for _ in range(2000)]
    )
    boresight = drawn.apply(ready.lab.camera.mount.cam_from_body.inv().apply([0, 0, 1]))
    moon = place(
        "moon", observe_from(ready.lab.scene.start_time, ready.lab.scene.site)
    ).direction
    low, high = np.cos(np.radians([8.0, 2.0]))
    level = (boresight @ moon - low) / (high - low)
    east = np.cross([0, 0, 1], moon)
    around = np.arctan2(boresight @ np.cross(moon, east), boresight @ east) / (2 * np.pi) % 1
    assert stats.kstest(level, "uniform").pvalue > 1e-4
    assert stats.kstest(around, "uniform").pvalue > 1e-4
    assert (level >= -1e-9).all()
    assert (level <= 1 + 1e-9).all()


def test_the_roll_about_the_boresight_is_uniform():
    """The body's x axis against the meridian through the boresight; under the dome against its own lean."""
    ready = trials.prepared_setup(DOME, {"trial.tilt_deg": 20})
    rng = np.random.default_rng(4)
    drawn = Rotation.concatenate(
        [trials.random_attitudes(ready, [rng])[0] for _ in range(2000)]
    )
    seen = drawn.inv().apply([0, 0, 1])
    assert np.degrees(np.arccos(seen[:, 2])) == pytest.approx(20, abs=1e-9)
    assert (
        stats.kstest(np.arctan2(seen[:, 1], seen[:, 0]) / (2 * np.pi) % 1, "uniform").pvalue
        > 1e-4
    )


@pytest.mark.parametrize("angles", [(0.3, 1.1, -2.0), (3.0, 0.0, 1.0), (-1.0, math.pi, 0.2)])
def test_three_successive_rotations_match_scipy(angles):
    off = (
        Rotation.from_quat(trials.zyz(*angles), scalar_first=True)
        * Rotation.from_euler("ZYZ", angles).inv()
    )
    assert off.magnitude() < 1e-14


@pytest.mark.parametrize("spec", [SKY, DOME])
def test_lights_of_a_trial_match_the_renderer_s_positions_and_brightness(spec):
    """Pixel and electrons against the truth of a rendered frame, of those lights whose whole image is on the chip."""
    ready = trials.prepared_setup(spec, {"background": []})
    lab = ready.lab
    lab_from_body = trials.random_attitudes(ready, [np.random.default_rng(5)])[0]
    _, truth = render_at_rest(lab.camera, lab_from_body)
    (view,) = detections.visible_rows(lab, Rotation.concatenate([lab_from_body]))
    xy_px = view.xy_px
    electrons = view.electrons
    size_px = np.array(lab.camera.canvas.shape[::-1])
    inner = np.flatnonzero(
        ((truth.sources.xy_px > 40) & (truth.sources.xy_px < size_px - 41)).all(axis=1)
    )
    assert len(inner) >= 5
    for n in inner:
        off = np.hypot(*(xy_px - truth.sources.xy_px[n]).T)
        assert off.min() < 1e-9
        # Patches are cut where an image is spent; PWM is lit for whole pulses or parts of one.
        assert electrons[off.argmin()] == pytest.approx(
            truth.sources.electrons[n], rel=0.11 if spec is DOME else 0.01
        )


def test_injected_faults_have_their_declared_size():
    """Noise, share missed, false lights: mean and spread over many fields."""
    ready = trials.prepared_setup(SKY, {})
    trial = CentroidTrial(
        kind="centroids", noise_px=0.3, missing=0.25, false_share=0.5, magnitude_sigma=0.0
    )
    xy_px = np.full((40, 2), 300.0)
    electrons = np.linspace(1e5, 2e5, 40)
    rng = np.random.default_rng(6)
    seen = [
        detections.simulate_detections(trial, xy_px, electrons, ready.lab.scene, rng)
        for _ in range(400)
    ]
    true = [np.hypot(*(one.xy_px - 300).T) < 3 for one in seen]
    kept = sum(int(one.sum()) for one in true)
    assert kept / (400 * 40) == pytest.approx(0.75, abs=4 * math.sqrt(0.75 * 0.25 / 16_000))
    strays = sum(len(one) for one in seen) - kept
    assert strays / kept == pytest.approx(1.0, abs=0.03)
    scatter = np.concatenate([one.xy_px[near] for one, near in zip(seen, true, strict=True)])
    assert scatter.std(axis=0) == pytest.approx(0.3, rel=0.03)
    assert all((np.diff(one.flux) <= 0).all() for one in seen)


def test_a_limited_number_of_lights_keeps_the_brightest():
    ready = trials.prepared_setup(SKY, {})
    trial = CentroidTrial(kind="centroids", noise_px=0.0, lights=3, magnitude_sigma=0.0)
    seen = detections.simulate_detections(
        trial, np.zeros((9, 2)), np.arange(9.0), ready.lab.scene, np.random.default_rng(1)
    )
    gain_e_dn = ready.lab.scene.camera.detector.gain_e_dn
    assert seen.flux * gain_e_dn == pytest.approx([8, 7, 6], rel=1e-12)


def test_another_noise_seed_keeps_the_attitude():
    prepared = [trials.prepared_setup(SKY, {"trial.noise_seed": n}) for n in (0, 1)]
    (first, seen), (again, other) = (
        trials.solved_centroids(ready, [12])[0] for ready in prepared
    )
    assert (first.lab_from_body * again.lab_from_body.inv()).magnitude() == 0
    assert (first.xy_px == again.xy_px).all()
    assert not np.array_equal(seen.centroids.xy_px, other.centroids.xy_px)


CODED = TrialSpec("coded_spiral", ".", 1, {}, {"kind": "centroids"}, True)


def coded(settings: dict[str, Any], count: int) -> list[Any]:
    """Outcomes of trials under the spiral of 400 coded LEDs."""
    return [
        row.outcome
        for row in trials.TrialJob(CODED).run((trials.Segment(0, settings, 0, range(count)),))
    ]


CODES = [
    {"kind": "bch", "distance": 5},
    {"kind": "cyclic", "bit_time": "20 ms"},
    {"kind": "gold", "depth": 1},
]


@pytest.mark.parametrize("code", CODES)
def test_lights_of_a_coded_trial_are_as_bright_as_rendered_ones(code):
    """Of frame 7, over the mean light of each LED: bits, edges of bits, pulses."""
    ready = trials.prepared_setup(CODED, {"light.led.code": code})
    lab = ready.lab.in_run(5)
    lab_from_body = Rotation.from_rotvec([0.1, 0.05, 1.0])
    ((rows, xy_px, electrons),) = detections.visible_rows(
        lab, Rotation.concatenate([lab_from_body])
    )
    light_e = electrons * detections.brightness(lab, rows, 7)
    _, truth = render_at_rest(lab.camera, lab_from_body, 7)
    size_px = np.array(lab.camera.canvas.shape[::-1])
    inner = np.flatnonzero(((xy_px > 40) & (xy_px < size_px - 41)).all(axis=1))
    assert len(inner) >= 2
    for n in inner:
        off_px = np.hypot(*(truth.sources.xy_px - xy_px[n]).T)
        # A dark LED is no source.
        rendered_e = truth.sources.electrons[off_px.argmin()] if off_px.min() < 0.5 else 0.0
        assert light_e[n] == pytest.approx(rendered_e, rel=0.01, abs=1)


@pytest.mark.slow
def test_a_coded_trial_is_a_sequence_of_frames():
    """With codes all attitudes of the spiral are solved, by one frame each or two bits would do; without them few."""
    outcomes = coded({}, 60)
    assert all(one.solved and not one.wrong and not one.misidentified for one in outcomes)
    without = coded({"light.led.code": None, "tracker.decoder": None}, 60)
    assert sum(one.solved for one in without) < 20


@pytest.mark.slow
def test_unreadable_codes_give_no_wrong_attitude():
    """Half of all bits fail, so that no word can be read."""
    outcomes = coded({"light.led.code": {"kind": "gray", "dropout": 0.49, "depth": 0.1}}, 60)
    assert sum(one.solved for one in outcomes) < 30
    assert not any(one.wrong for one in outcomes)


@pytest.mark.slow
def test_centroid_trials_have_the_theoretical_error():
    """QUEST's covariance holds: mean NEES of three degrees of freedom, to five standard errors."""
    spec = replace(
        SKY,
        base={
            "tracker.centroid_sigma_px": 1e-3,
            "light.limit_mag": 5.5,
            "tracker.limit_mag": 5.5,
        },
    )
    rows = trials.TrialJob(spec).run(
        (trials.Segment(0, {"trial.noise_px": 0.2}, 0, range(400)),)
    )
    nees = np.array(
        [row.outcome.nees for row in rows if row.outcome.solved and not row.outcome.wrong]
    )
    assert len(nees) > 350
    assert nees.mean() == pytest.approx(3, abs=5 * math.sqrt(6 / len(nees)))


@pytest.mark.slow
def test_a_rotating_frame_is_smeared_by_the_gyro_s_rate():
    """Streak length in the truth against rate times exposure, at the middle of the field."""
    spec = replace(SKY, trial={"kind": "frames", "rate_deg_s": 4.0, "gyro": True})
    ready = trials.prepared_setup(spec, {})
    assert isinstance(ready.trial, FrameTrial)
    _, truth, told_px = trials.render_trial_frame(ready, 77)
    wanted = (
        math.radians(4.0) * ready.lab.scene.exposure.time_s * ready.lab.scene.camera.focal_px
    )
    assert math.hypot(*told_px) == pytest.approx(wanted, rel=1e-12)
    middle = np.argmin(
        np.hypot(*(truth.sources.xy_px - np.array(ready.lab.camera.canvas.shape[::-1]) / 2).T)
    )
    assert truth.sources.streak_px[middle] == pytest.approx(wanted, rel=0.03)
    came = trials.run_frame_trial(ready, 77)
    assert came.frames == 1


@pytest.mark.slow
def test_a_flight_counts_its_frames_after_it_settled():
    spec = replace(
        DOME, base={"exposure.frames": 6}, trial={"kind": "flight", "settle": "2.1 s"}
    )
    ready = trials.prepared_setup(spec, {})
    came = trials.run_flight_trial(ready, 5)
    # 2 Hz from 1 s on: 1, 1.5 and 2 s are before.
    assert came.frames == 3
    assert came.solved == 3
    assert came.availability == 1
    assert math.isnan(came.filter_arcsec)


@pytest.mark.slow
def test_a_flights_filter_is_scored_at_every_tick():
    settings = {
        "vehicle.imu": {},
        "filter": {"start_deg": 0.1},
        "exposure.frames": 4,
        "motion.control": {"law": "pid", "feedback": "filter"},
    }
    spec = replace(DOME, base=settings, trial={"kind": "flight"})
    ready = trials.prepared_setup(spec, {})
    came = trials.run_flight_trial(ready, 5)
    assert came.frames == came.solved == 4
    assert 0 < came.filter_arcsec < came.filter_worst_arcsec < 600
    assert came.availability == 1
    assert math.isfinite(came.drift_arcsec)
    log = trials.trial_flight(ready, 5).simulate_motion().telemetry()
    error = (log.lab_from_ref * log.lab_from_body.inv()).magnitude()
    assert 0 < came.pointing_arcsec < came.pointing_worst_arcsec
    assert came.pointing_worst_arcsec == pytest.approx(
        np.degrees(error.max()) * 3600, rel=1e-9
    )


@pytest.mark.slow
def test_a_lab_is_reused_if_only_the_trial_differs():
    first = trials.prepared_setup(SKY, {"trial.noise_px": 0.1})
    other = trials.prepared_setup(SKY, {"trial.noise_px": 0.2})
    assert first.lab is other.lab
    assert trials.prepared_setup(SKY, {"trial.noise_px": 0.1}) is first
    assert other.trial.noise_px == 0.2
    for n in range(trials.CACHE_SIZE):
        trials.prepared_setup(SKY, {"camera.focal_length": f"{20 + n} mm"})
    assert trials.prepared_setup(SKY, {"trial.noise_px": 0.1}) is not first


def test_the_scenes_hash_is_of_its_values_and_of_its_files(tmp_path):
    model = tmp_path / "ship.xml"
    text = (SCENES / "vehicles" / "shefex2.xml").read_text()
    model.write_text(text)
    hashes = [
        trials.scene_hash(plan.resolve_point(SKY, sets)[0])
        for sets in ({}, {"camera.f_number": 1.5}, {})
    ]
    assert hashes[0] == hashes[2] != hashes[1]
    own = {"vehicle.model": str(model)}
    first = trials.scene_hash(plan.resolve_point(SKY, own)[0])
    model.write_text(text.replace("<mujoco", "<!-- other --><mujoco", 1))
    assert trials.scene_hash(plan.resolve_point(SKY, own)[0]) != first


# --- the axis of the rate, and a flight's start ---------------------------------------------------------------

FRAMES = TrialSpec("shefex2", ".", 1, {}, {"kind": "frames", "rate_deg_s": 2.0}, True)


@pytest.mark.parametrize(
    ("axis", "frame", "expected"),
    [
        ("boresight", "cam", [0, 0, 1]),
        ({"camera": [0, 3, 0]}, "cam", [0, 1, 0]),
        ({"body": [1, 2, -2]}, "body", [1 / 3, 2 / 3, -2 / 3]),
    ],
)
def test_a_frame_rotates_about_the_named_axis(axis, frame, expected):
    """The truth's rate at mid-exposure, in that frame; the attitude and the noise are those of any other axis."""
    usual = trials.prepared_setup(FRAMES, {})
    ready = trials.prepared_setup(FRAMES, {"trial.rate_axis": axis})
    _, before, _ = trials.render_trial_frame(usual, 7)
    _, truth, _ = trials.render_trial_frame(ready, 7)
    rate = truth.rate_cam_rad_s
    if frame == "body":
        rate = ready.lab.camera.mount.cam_from_body.inv().apply(rate)
    np.testing.assert_allclose(rate, np.radians(2.0) * np.array(expected), rtol=0, atol=1e-12)
    assert (truth.cam_from_lab * before.cam_from_lab.inv()).magnitude() < 1e-12
    assert abs(before.rate_cam_rad_s[2]) < 1e-12  # perpendicular to the boresight


def test_a_rotation_about_the_boresight_keeps_its_star_in_place():
    """Streaks grow with the distance from the image's center: rate x exposure x distance."""
    ready = trials.prepared_setup(
        FRAMES, {"trial.rate_axis": "boresight", "trial.rate_deg_s": 20.0}
    )
    _, truth, streak_px = trials.render_trial_frame(ready, 3)
    sources = truth.sources
    camera = ready.lab.scene.camera
    distance_px = np.hypot(
        *(sources.xy_px - [(camera.width_px - 1) / 2, (camera.height_px - 1) / 2]).T
    )
    swept = np.radians(20.0) * ready.lab.scene.exposure.time_s * distance_px
    near = distance_px < 150  # where tan is its angle
    assert near.sum() > 3
    np.testing.assert_allclose(sources.streak_px[near], swept[near], rtol=0.02, atol=0.02)
    assert streak_px is None


@pytest.mark.parametrize("name", ["shefex2", "afit_simsat"])
def test_a_flight_starts_anywhere_and_the_same_for_the_same_seed(name):
    """Start attitudes are uniform, drawn from the same stream as those of other trials."""
    trial = {"kind": "flight", "start": "random"}
    ready = trials.prepared_setup(
        TrialSpec(name, ".", 1, {"exposure.frames": 1}, trial, True), {}
    )
    kind = {"kind": "frames"}
    other = trials.prepared_setup(
        TrialSpec(name, ".", 1, {"exposure.frames": 1}, kind, True), {}
    )
    starts = [trials.trial_flight(ready, seed).state.lab_from_body for seed in (5, 6, 5)]
    assert (starts[0].inv() * starts[2]).magnitude() == 0
    assert (starts[0].inv() * starts[1]).magnitude() > 0.01
    drawn = trials.random_attitudes(other, [trials.streams(other, 5)[0]])[0]
    assert (starts[0].inv() * drawn).magnitude() == 0
    scene_start = ready._replace(trial=plan.FlightTrial(kind="flight"))
    fixed = trials.trial_flight(scene_start, 5).state.lab_from_body
    assert (fixed.inv() * ready.lab.start).magnitude() == 0


@pytest.mark.slow
def test_a_flight_with_a_random_start_starts_there():
    changes = {"exposure.frames": 2, "exposure.first": "0.2 s"}
    trial = {"kind": "flight", "start": {"tilt_deg": [5, 12]}}
    spec = TrialSpec("afit_simsat", ".", 1, changes, trial, True)
    ready = trials.prepared_setup(spec, {})
    flown = trials.trial_flight(ready, 9).simulate_motion().trajectory()
    tilt_deg = np.degrees(np.arccos(flown.lab_from_body.as_matrix()[:, 2, 2]))
    assert 5 < tilt_deg[0] < 12
    assert tilt_deg[-1] == pytest.approx(tilt_deg[0], abs=0.2)  # held for a second
    (row,) = trials.TrialJob(spec).run((trials.Segment(0, {}, 0, range(1)),))
    assert row.error is None
    assert row.outcome.frames == 2


def rendered(settings: dict[str, Any], seed: int = 5) -> Any:
    """The truth of a frame trial of the shipped scene with stars."""
    return trials.render_trial_frame(trials.prepared_setup(AT_REST, settings), seed)[1]


AT_REST = TrialSpec("shefex2", ".", 1, {}, {"kind": "frames"}, True)


def test_a_frame_rotates_about_the_axis_of_its_rate():
    """By this angle across the boresight, the same axis at every angle; other attitudes have another seed."""
    first, small, large = (rendered({"trial.turn_deg": turn}) for turn in (0.0, 0.5, 2.0))
    turns = [
        (one.cam_from_lab * first.cam_from_lab.inv()).as_rotvec(degrees=True)
        for one in (small, large)
    ]
    assert np.linalg.norm(turns, axis=1) == pytest.approx([0.5, 2.0], rel=1e-9)
    assert turns[0] * 4 == pytest.approx(turns[1], abs=1e-9)
    assert turns[0][2] == pytest.approx(0, abs=1e-12)
    moving = rendered({"trial.rate_deg_s": 1.0})
    assert np.cross(moving.rate_cam_rad_s, turns[0]) == pytest.approx(0, abs=1e-12)
    other = rendered({"trial.attitude_seed": 1})
    assert (other.cam_from_lab * first.cam_from_lab.inv()).magnitude() > 0.1


def test_accelerated_lights_are_at_their_predicted_positions():
    """From rest at mid-exposure they move by a t^2 / 2: their mean is a T^2 / 24 away, and they are a T^2 / 8 long."""
    acceleration = 200.0
    time_s = 0.04
    truth = rendered({"trial.acceleration_deg_s2": acceleration})
    focal_px = 25e-3 / 9.9e-6
    sources = truth.sources
    # Where the image's scale is that of the center.
    near = np.hypot(*(sources.xy_px - [329, 246]).T) < 150
    lag_px = np.hypot(*(sources.flux_xy_px - sources.xy_px)[near].T)
    bend_px = np.radians(acceleration) * time_s**2 * focal_px
    assert near.sum() >= 3
    assert lag_px == pytest.approx(bend_px / 24, rel=0.03)
    assert np.linalg.norm(truth.rate_cam_rad_s) == pytest.approx(0, abs=1e-12)


def tracked_statuses(settings: dict[str, Any], seeds: range) -> list[str]:
    """Statuses of frames in tracking mode after two of the same motion."""
    setup = trials.prepared_setup(AT_REST, {"trial.tracked": 2} | settings)
    return [trials.run_frame_trial(setup, seed).status for seed in seeds]


@pytest.mark.slow
@pytest.mark.parametrize("gyro", [False, True])
def test_tracking_follows_a_motion_until_its_prediction_leaves_the_windows(gyro):
    """The mean rate of the last two frames misses by a t^2, and streaks tell its change until stars are too smeared.

    All are found at 4 px, and at 30 px, which is far outside windows of 8 px; none at 120 px, also with a gyro.
    """
    pixel_deg = math.degrees(9.9e-6 / 25e-3)
    between_s = 0.1
    accelerations = [missed_px * pixel_deg / between_s**2 for missed_px in (4.0, 30.0, 120.0)]
    near, outside, far = (
        tracked_statuses({"trial.acceleration_deg_s2": one, "trial.gyro": gyro}, range(3))
        for one in accelerations
    )
    assert near == outside == ["solved"] * 3
    assert all(status.startswith("tracking lost") for status in far)
    assert (
        tracked_statuses({"trial.rate_deg_s": 2.0, "trial.gyro": gyro}, range(3))
        == ["solved"] * 3
    )


def test_a_tracked_frame_has_the_motion_of_its_time():
    """The attitude of the last frame is the trial's, and that of the frame before is a step of the rate behind it."""
    settings = {"trial.rate_deg_s": 2.0}
    truth = rendered(settings | {"trial.tracked": 2})
    assert (truth.cam_from_lab * rendered(settings).cam_from_lab.inv()).magnitude() < 1e-12
    setup = trials.prepared_setup(AT_REST, settings | {"trial.tracked": 2})
    moving = trials.moving_camera(setup, 5)
    step = trials.rotation_between(moving, truth.t_s - 0.1, truth.t_s)
    assert np.degrees(step.magnitude()) == pytest.approx(0.2, rel=1e-9)


@pytest.mark.slow
@pytest.mark.parametrize(("frames", "exposure_ms"), [(1, 44), (3, 48), (6, 50)])
def test_a_flight_in_the_dark_ends_with_the_exposure_that_its_control_has_reached(
    frames: int, exposure_ms: float
) -> None:
    """Steps of 2 ms from 44 ms, to 50 ms at most (Samaan & Theil 2011, section 3.1)."""
    settings = {
        "tracker.exposure_control": {"mean_dn": 150},
        "camera.transmission": 1e-6,
        "exposure.time": "44 ms",
        "exposure.frames": frames,
    }
    flights = replace(SKY, base=settings, trial={"kind": "flight"})
    came = trials.run_flight_trial(trials.prepared_setup(flights, {}), 5)
    assert came.exposure_ms == pytest.approx(exposure_ms, abs=1e-9)


@pytest.mark.slow
def test_the_time_of_a_detection_is_stored_beside_the_trial_and_is_not_compared(tmp_path):
    rows = {}
    for name in ("sequential", "maximum"):
        settings = {"tracker.detector": name}
        spec = replace(SKY, trial={"kind": "frames"})
        rows[name] = trials.TrialJob(spec).run((trials.Segment(0, settings, 0, range(4)),))
    # Every object costs the maximum search another pass over the image.
    sequential, maximum = ([row.outcome.detect_ms for row in each] for each in rows.values())
    assert np.median(maximum) > 3 * np.median(sequential) > 0
    outcome = rows["maximum"][0].outcome
    assert outcome == replace(outcome, detect_ms=-1.0)
    with store.writing(tmp_path / "study.sqlite") as kept:
        kept.add(rows["maximum"])
        assert kept.columns()["detect_ms"].tolist() == maximum
        assert not {"detect_ms", "time_ms"} & set(kept.trial(0))
