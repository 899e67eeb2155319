"""The noise-free chain returns the truth; frames are independent; random streams do not depend on order."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from estimator.core.types import Attitude, Centroids
from skysim.camera.optics import Optics
from skysim.core.errors import InputError
from skysim.core.random_streams import DETECTOR, random_stream
from skysim.core.types import Truth
from skysim.results import metrics
from skysim.scene import loader
from skysim.scene.scene import Scene
from skysim.simulation.exposure import render_at_rest
from skysim.simulation.flight import Flight, Shot, open_flight, simulate_motion
from skysim.simulation.lab import build_lab, build_tracker, exposure_window
from skysim.tracking import onboard_model
from skysim.tracking.factory import solve_frame

# Without noise a frame is the expectation in float64; without fixed pattern and with one exposure for all rows, a
# perfect chip's.
PERFECT_CHIP = {
    "camera.detector.cti_parallel": "0",
    "camera.detector.cti_serial": "0",
    "camera.shutter": "{kind: global}",
    "camera.detector.noise": "false",
    "camera.detector.prnu": "0",
    "camera.detector.dsnu": "0",
    "camera.detector.hot_pixels": "0",
    "camera.detector.column_offset_e": "0",
}
QUIET_DOME = PERFECT_CHIP | {
    "motion.control": "none",
    "motion.maneuver": "[]",
    "vehicle.center_of_mass": "['0 m', '0 m', '0 m']",  # balanced: it stays where it is put
    "exposure.frames": "1",
}
# Stars too faint for the catalog are light in their neighbors' fitting windows (some 10 arcsec of bias), so the
# bar of 1e-6 deg is for a sky of isolated stars that are all on board, where the tracker believes them.
QUIET_SKY = PERFECT_CHIP | {
    "motion.rate_deg_s": "[0, 0, 0]",
    "light.catalog": "hipparcos_hp6.5",
    "light.limit_mag": "5",
    "tracker.limit_mag": "5",
    "exposure.frames": "1",
}
ATTITUDES = [
    "{roll_deg: 7}",
    "{roll_deg: -15, pitch_deg: 8, yaw_deg: 100}",
    "{pitch_deg: -20, yaw_deg: -170}",
]
POINTINGS = ["{ra_deg: 83, dec_deg: 2}", "{ra_deg: 300, dec_deg: 20, roll_deg: 77}"]


def changed(name: str, **overrides: str) -> Scene:
    return loader.load(name, {k.replace("__", "."): v for k, v in overrides.items()})


def flown(name: str, **overrides: str) -> Flight:
    return simulate_motion(changed(name, **overrides))


def quiet(name: str, start: str) -> Flight:
    changes = {"afit_simsat_ideal": QUIET_DOME, "shefex2": QUIET_SKY}[name]
    return simulate_motion(loader.load(name, changes | {"motion.start": start}))


def error_deg(answer: Attitude, truth: Truth) -> float:
    assert answer.status == "solved"
    assert answer.cam_from_ref is not None
    return float(np.degrees((answer.cam_from_ref * truth.cam_from_lab.inv()).magnitude()))


def shots_of(scene: Scene) -> list[Shot]:
    return list(open_flight(scene).shots())


def true_centroids(truth: Truth) -> Centroids:
    """The true pixels, brightest first, as if they had been measured to a hundredth of a pixel.

    These are the images of the LEDs' centers; by perspective the centers of light differ by up to 1e-3 px.
    """
    order = np.argsort(-truth.sources.electrons)
    count = len(order)
    return Centroids(
        truth.sources.xy_px[order], np.full(count, 0.01), truth.sources.electrons[order]
    )


# Without noise


@pytest.mark.slow
@pytest.mark.parametrize(
    ("name", "start"),
    [("afit_simsat_ideal", s) for s in ATTITUDES] + [("shefex2", s) for s in POINTINGS],
)
def test_a_noise_free_image_gives_the_true_attitude(name: str, start: str) -> None:
    flight = quiet(name, start)
    frame, truth = flight.render(0)
    assert frame.image_dn.dtype == np.float64  # neither rounded nor clipped
    # The tracker takes the center of an LED's light for the image of its center: 1e-3 px of 22.6" at most, five LEDs.
    limit_deg = 1e-6 if name == "shefex2" else 1e-3 * 22.6 / 3600 / np.sqrt(5)
    assert (
        error_deg(build_tracker(flight.lab.camera).solve(frame.image_dn).attitude, truth)
        < limit_deg
    )


@pytest.mark.slow
@pytest.mark.parametrize("name", ["shefex2", "nps_tas2_ideal", "apl_dome_ideal"])
def test_a_shipped_scene_without_noise_and_fixed_pattern_is_solved(name: str) -> None:
    """Without noise, the images' wings and readout smear must not merge the lights into one blob."""
    off = {key: "0" for key in ("prnu", "dsnu", "hot_pixels")} | {"noise": "false"}
    lab = build_lab(
        loader.load(name, {f"camera.detector.{key}": value for key, value in off.items()})
    )
    frame, truth = render_at_rest(lab.camera, lab.start)
    # 18": the tracker takes apl_dome's stretched shell for a sphere.
    assert error_deg(build_tracker(lab.camera).solve(frame.image_dn).attitude, truth) < 5e-3


@pytest.mark.slow
@pytest.mark.parametrize(
    ("name", "start"),
    [("afit_simsat_ideal", s) for s in ATTITUDES] + [("shefex2", s) for s in POINTINGS],
)
def test_true_centroids_give_the_true_attitude(name: str, start: str) -> None:
    flight = quiet(name, start)
    _, truth = flight.render(0)
    assert (
        error_deg(
            build_tracker(flight.lab.camera).solve_centroids(true_centroids(truth)), truth
        )
        < 1e-6
    )


def test_true_centroids_under_the_dome_give_the_attitude_to_machine_precision() -> None:
    # Reference §5: exact PnP noise-free, 1e-14 deg; here both sides know the very same LEDs.
    flight = quiet("afit_simsat_ideal", ATTITUDES[1])
    _, truth = flight.render(0)
    assert (
        error_deg(
            build_tracker(flight.lab.camera).solve_centroids(true_centroids(truth)), truth
        )
        < 1e-12
    )


@pytest.mark.parametrize("start", POINTINGS)
def test_uneven_pixels_cause_the_error_of_their_centroid_shift(start: str) -> None:
    """PRNU moves a Gaussian star's center by prnu / sqrt(8 pi) px, whatever its width, and N stars turn by that
    over sqrt(sum r^2): from the integral of g^2 x^2, with g the star's profile. Four sigma."""
    uneven = {"camera.detector.prnu": "0.01", "motion.start": start}
    flight = simulate_motion(loader.load("shefex2", QUIET_SKY | uneven))
    frame, truth = flight.render(0)
    from_center_px = truth.sources.xy_px - flight.lab.scene.camera.center_px
    sigma_rad = 0.01 / np.sqrt(8 * np.pi) / np.sqrt(np.sum(from_center_px**2))
    error = error_deg(build_tracker(flight.lab.camera).solve(frame.image_dn).attitude, truth)
    assert 1e-6 < error < 4 * np.degrees(sigma_rad)


def test_a_known_distortion_causes_no_error() -> None:
    lens = {
        "camera.distortion": "[-0.2, 0.1, 0.001, -0.002, 0.05]",
        "camera.principal_point_px": "[340, 230]",
    }
    flight = simulate_motion(loader.load("shefex2", QUIET_SKY | lens))
    frame, truth = flight.render(0)
    assert (
        error_deg(build_tracker(flight.lab.camera).solve(frame.image_dn).attitude, truth)
        < 1e-6
    )


def test_a_wrong_lever_causes_the_reference_s_error() -> None:
    """Reference §5: 1 mm of lateral lever is .047 deg across (5 LEDs); by geometry 1 mm / 1.22 m = .047 deg."""
    moved = {
        "tracker.assumed_camera_body": "['1 mm', '0 m', '381 mm']",
        "motion.start": "{roll_deg: 7}",
    }
    flight = simulate_motion(loader.load("afit_simsat_ideal", QUIET_DOME | moved))
    _, truth = flight.render(0)
    error = error_deg(
        build_tracker(flight.lab.camera).solve_centroids(true_centroids(truth)), truth
    )
    assert error == pytest.approx(np.degrees(1e-3 / 1.22), rel=0.15)


# What the frames are made of


def test_the_camera_has_the_scene_s_pointing() -> None:
    flight = quiet("shefex2", "{ra_deg: 83, dec_deg: 2, roll_deg: 20}")
    _, truth = flight.render(0)
    right, down, sight = truth.cam_from_lab.as_matrix()
    ra, dec = np.radians([83.0, 2.0])
    wanted = [np.cos(dec) * np.cos(ra), np.cos(dec) * np.sin(ra), np.sin(dec)]
    np.testing.assert_allclose(sight, wanted, rtol=0, atol=1e-14)
    # Position angle of the image's up: from north through east, and east is to the left.
    north = np.array([-np.sin(dec) * np.cos(ra), -np.sin(dec) * np.sin(ra), np.cos(dec)])
    east = np.array([-np.sin(ra), np.cos(ra), 0])
    assert np.degrees(np.arctan2(-down @ east, -down @ north)) == pytest.approx(20, abs=1e-10)
    assert -right @ (
        east * np.cos(np.radians(20)) - north * np.sin(np.radians(20))
    ) == pytest.approx(1, abs=1e-12)


def test_the_truth_is_the_attitude_at_mid_exposure() -> None:
    """The attitude in the truth puts the stars on the pixels in the truth, while the camera slews."""
    flight = flown("shefex2", exposure__frames="4")
    frame, truth = flight.render(3)
    assert frame.t_mid_s == truth.t_s == pytest.approx(0.1 + 3 * 0.1 + 0.020, abs=1e-12)
    rows = {hip: n for n, hip in enumerate(flight.lab.camera.sources.id)}
    direction = flight.lab.camera.sources.place[[rows[hip] for hip in truth.sources.id], :3]
    x, y, z = truth.cam_from_lab.apply(direction).T
    pinhole = np.column_stack([329 + x / z * 25e-3 / 9.9e-6, 246 + y / z * 25e-3 / 9.9e-6])
    np.testing.assert_allclose(truth.sources.xy_px, pinhole, rtol=0, atol=1e-9)


def test_the_truth_moves_at_the_rate_of_the_scene() -> None:
    """A sphere of 120 kg m2 in free flight turns evenly: .5 deg/s for the 2 s between frames 0 and 20."""
    flight = flown("shefex2", exposure__frames="21")
    first, last = (flight.render(k)[1] for k in (0, 20))
    assert last.t_s - first.t_s == pytest.approx(2.0, abs=1e-12)
    turned = (last.cam_from_lab * first.cam_from_lab.inv()).magnitude()
    assert np.degrees(turned) == pytest.approx(1.0, abs=1e-9)
    assert np.degrees(np.linalg.norm(last.rate_cam_rad_s)) == pytest.approx(0.5, abs=1e-9)


def test_streaks_are_rate_times_exposure_times_focal_length() -> None:
    """Near the axis; .5 deg/s, 40 ms, 2,525 px: .88 px."""
    flight = flown("shefex2", exposure__frames="1")
    seen = flight.render(0)[1].sources
    middle = np.hypot(*(seen.xy_px - [329, 246]).T) < 120
    assert middle.sum() >= 3
    wanted = np.radians(0.5) * 0.040 * 25e-3 / 9.9e-6
    # 1 + tan^2 at 120 px: .2 %.
    np.testing.assert_allclose(seen.streak_px[middle], wanted, rtol=5e-3, atol=0)


def test_the_camera_rides_fifteen_inches_above_the_bearing() -> None:
    mount = build_lab(loader.load("afit_simsat")).camera.mount
    np.testing.assert_allclose(mount.camera_body_m, [0, 0, 15 * 0.0254], rtol=0, atol=1e-12)
    np.testing.assert_allclose(mount.cam_from_body.as_matrix(), np.eye(3), rtol=0, atol=1e-12)


def test_shutters_open_at_their_scheduled_times() -> None:
    windows = [exposure_window(loader.load("shefex2"), k) for k in (0, 1, 39)]
    assert [when.open_s for when in windows] == pytest.approx([0.1, 0.2, 4.0], abs=1e-12)
    assert {when.exposure_s for when in windows} == {0.040}
    assert [when.close_s for when in windows] == pytest.approx([0.14, 0.24, 4.04], abs=1e-12)


def test_a_rolling_shutter_s_truth_is_at_its_middle_row() -> None:
    """493 rows, each 80 us after the one above: the last closes 39.36 ms late, the middle one 19.68 ms."""
    # The first and last rows are .35 px off the middle's: a tracker that trusts to .03 px would leave them out.
    loose = {"tracker__centroid_sigma_px": "0.2", "exposure__frames": "1"}
    flight = flown(
        "shefex2", camera__shutter="{kind: rolling, row_time: '80 us'}", seed="3", **loose
    )
    assert exposure_window(flight.lab.scene, 0).close_s == pytest.approx(
        0.1 + 0.040 + 0.03936, abs=1e-12
    )
    frame, truth = flight.render(0)
    assert frame.t_mid_s == truth.t_s == pytest.approx(0.1 + 0.020 + 0.01968, abs=1e-12)
    lab = flight.lab
    blind = lab.scene.tracker.model_copy(update={"assumed_row_time_s": 0.0})
    errors = []
    for one in lab, lab.with_scene(lab.scene.model_copy(update={"tracker": blind})):
        report = build_tracker(one.camera).solve(frame.image_dn, exposure_s=frame.exposure_s)
        answer = report.attitude
        assert answer.cam_from_ref is not None
        errors.append(
            np.degrees(metrics.cross_and_roll_rad(answer.cam_from_ref, truth.cam_from_lab))
            * 3600
        )
    # At the first row's time the boresight was 35 arcsec from this.
    assert errors[0][0] < 10
    assert errors[1][0] < 10
    # Rows shear along x by .4 deg/s x 39.4 ms = .70 px in 493; the best turn takes y^2 / (x^2 + y^2) of a shear, over
    # the stars about their mean. A tracker that knows its rows is off by their noise only.
    assert abs(errors[0][1]) < 30
    xx, yy = report.centroids.xy_px[answer.match.observed].var(axis=0)
    assert abs(errors[1][1]) == pytest.approx(
        np.degrees(0.695 / 493 * yy / (xx + yy)) * 3600, rel=0.3
    )


def test_a_background_is_added_to_every_pixel() -> None:
    """1000 e-/s of glow for 40 ms at 10 e-/DN: 4 DN more in every pixel, and the same stars on top."""
    dark, lit = (
        simulate_motion(loader.load("shefex2", QUIET_SKY | {"background": glow})).render(0)
        for glow in ("[]", "[{kind: uniform, e_s: 1000}]")
    )
    np.testing.assert_allclose(lit[0].image_dn - dark[0].image_dn, 4.0, rtol=0, atol=1e-6)
    np.testing.assert_allclose(
        lit[1].sources.electrons, dark[1].sources.electrons, rtol=1e-12, atol=0
    )
    assert (lit[1].sources.snr < dark[1].sources.snr).all()


def test_jitter_moves_the_camera_by_its_declared_rms() -> None:
    """100 arcsec rms about the body's x, at 20 Hz: the path's turns away from the unshaken one have that rms."""
    line = "[{kind: line, frequency_hz: 20, rms_arcsec: [100, 0, 0]}]"
    still, shaken = (
        flown("shefex2", exposure__frames="11", motion__jitter=j).trajectory()
        for j in ("[]", line)
    )
    t_s = np.linspace(0, 1, 2000, endpoint=False)  # twenty whole periods
    turned = (
        np.degrees((still.attitude_at(t_s).inv() * shaken.attitude_at(t_s)).as_rotvec())
        * 3600
    )
    np.testing.assert_allclose(
        np.sqrt(np.mean(turned**2, axis=0)), [100, 0, 0], rtol=1e-3, atol=1e-3
    )


def test_a_chip_s_fixed_pattern_does_not_depend_on_the_run_s_seed() -> None:
    one, same, other = (
        build_lab(
            changed("shefex2", seed=seed, camera__detector__hardware_seed=detector)
        ).camera.detector
        for seed, detector in (("1", "5"), ("2", "5"), ("1", "6"))
    )
    for name in ("sensitivity", "dark_e_s"):
        np.testing.assert_array_equal(getattr(one, name), getattr(same, name))
        assert np.mean(getattr(one, name) != getattr(other, name)) > 0.9


# Random streams


def test_frames_do_not_depend_on_earlier_ones() -> None:
    flight = flown("shefex2", exposure__frames="4")
    in_order = [flight.render(k)[0].image_dn for k in range(4)]
    backwards = [flight.render(k)[0].image_dn for k in (3, 2, 1, 0)][::-1]
    for one, other in zip(in_order, backwards, strict=True):
        np.testing.assert_array_equal(one, other)


def test_noise_differs_from_frame_to_frame_and_seed_to_seed() -> None:
    draws = [
        random_stream(seed, DETECTOR, k).standard_normal(1000)
        for seed, k in ((1, 0), (1, 1), (2, 0))
    ]
    correlation = np.corrcoef(draws)
    assert np.abs(correlation[np.triu_indices(3, 1)]).max() < 4 / np.sqrt(1000)


def test_the_run_s_seed_does_not_change_the_hardware() -> None:
    domes = [
        build_lab(changed("afit_simsat", seed=seed)).camera.sources for seed in ("1", "2")
    ]
    np.testing.assert_array_equal(domes[0].place, domes[1].place)
    np.testing.assert_array_equal(domes[0].strength, domes[1].strength)


# The run


@pytest.fixture(scope="module")
def shots() -> list[Shot]:
    return shots_of(changed("shefex2", exposure__frames="3"))


def test_a_run_has_an_answer_for_every_frame(shots: list[Shot]) -> None:
    assert [shot.frame.index for shot in shots] == [0, 1, 2]
    for shot in shots:
        assert error_deg(shot.report.attitude, shot.truth) < 10 / 60
        assert all(spent >= 0 for spent in shot.seconds.values())


def test_a_blinded_frame_has_a_status_and_no_attitude() -> None:
    (shot,) = shots_of(
        changed("shefex2", exposure__frames="1", background="[{kind: uniform, e_s: 1e8}]")
    )
    assert "saturated" in shot.report.attitude.status
    assert shot.report.attitude.cam_from_ref is None


@pytest.mark.slow
def test_a_starless_frame_has_a_status_and_no_attitude() -> None:
    starless = {"light__limit_mag": "0", "motion__start": "{ra_deg: 10, dec_deg: 60}"}
    (shot,) = shots_of(changed("shefex2", exposure__frames="1", **starless))
    assert shot.report.attitude.status != "solved"
    assert shot.report.attitude.cam_from_ref is None
    assert len(shot.truth.sources.id) == 0


@pytest.mark.parametrize("stage", ["detector", "centroider", "identifier", "solver"])
@pytest.mark.parametrize("name", ["shefex2", "afit_simsat"])
def test_an_unknown_algorithm_is_refused_before_the_flight(name: str, stage: str) -> None:
    loaded = loader.load(name, {f"tracker.{stage}": "magic"})
    with pytest.raises(
        InputError, match=rf"^tracker\.{stage}: unknown {stage} 'magic'; allowed: \w+"
    ):
        open_flight(loaded)


@pytest.mark.parametrize(
    ("name", "solver"), [("shefex2", "rotation_only"), ("afit_simsat", "quest")]
)
def test_a_solver_for_the_other_sky_is_refused(name: str, solver: str) -> None:
    loaded = loader.load(name, {"tracker.solver": solver})
    with pytest.raises(
        InputError, match=rf"^tracker\.solver: unknown solver '{solver}'; allowed: "
    ):
        open_flight(loaded)


def test_the_tracker_s_camera_is_the_true_one_by_default() -> None:
    loaded = loader.load("shefex2", {"camera.distortion": "[-0.2, 0.1, 0, 0, 0]"})
    believed = onboard_model.assumed_camera(loaded)
    lens = Optics.from_camera(loaded.camera)
    vectors = Rotation.from_rotvec([0.05, -0.08, 0]).apply([[0, 0, 1.0], [0.02, 0, 1.0]])
    np.testing.assert_allclose(
        believed.pixels(vectors), lens.project(vectors), rtol=0, atol=1e-10
    )
    longer = onboard_model.assumed_camera(
        loader.load("shefex2", {"tracker.assumed_focal_length": "25.25 mm"})
    )
    assert longer.focal_px == pytest.approx(believed.focal_px * 1.01, rel=1e-12)


def test_a_calibrated_tracker_uses_the_focused_image_distance() -> None:
    """Reference §1.2: 35 mm at 33 in is 36.53 mm, whose 1,600 pixels of 4 um see 10.01 deg."""
    believed = onboard_model.assumed_camera(loader.load("afit_simsat"))
    assert believed.focal_px * 4e-3 == pytest.approx(36.53, abs=5e-3)
    assert np.degrees(2 * np.arctan(800 / believed.focal_px)) == pytest.approx(
        10.01, abs=5e-3
    )


def test_the_shutter_s_smear_adds_to_saturation_and_noise() -> None:
    """A sky of 24,000 e- smears to half as much again in 493 rows of 40 us: stars that fit a well no longer do."""
    bright = QUIET_SKY | {
        "background": "[{kind: uniform, e_s: 600000}]",
        "light.limit_mag": "4",
        "motion.rate_deg_s": "[0, 0, 0]",
        "camera.detector.noise": "true",
    }
    plain, shifted = (
        simulate_motion(loader.load("shefex2", bright | {"camera.shutter": shutter}))
        .render(0)[1]
        .sources
        for shutter in ("{kind: global}", '{kind: frame_transfer, row_time: "40 us"}')
    )
    assert not plain.saturated.all()
    assert shifted.saturated.sum() > plain.saturated.sum()
    smeared = (24_000 * (1 + 492 * 40e-6 / 0.04) + 0.8) / 24_000.8
    faint = np.argmin(plain.electrons)
    assert (plain.snr[faint] / shifted.snr[faint]) ** 2 == pytest.approx(smeared, rel=0.02)


# Exposure control

# No bright stars.
COMA = {"motion.start": "{ra_deg: 190, dec_deg: 25}", "motion.rate_deg_s": "[0, 0, 0]"}


def controlled(frames: int, start: str, control: str, **more: str) -> Scene:
    given = {
        "exposure.frames": str(frames),
        "exposure.time": start,
        "tracker.exposure_control": control,
    }
    return changed("shefex2", **(COMA | given | more))


def exposures_ms(shots: list[Shot]) -> list[float]:
    return [1e3 * shot.frame.exposure_s for shot in shots]


def test_an_exposure_too_short_for_stars_grows_until_there_are_four() -> None:
    shots = shots_of(controlled(10, "1 ms", "{mean_dn: 150}"))
    enough = next(n for n, shot in enumerate(shots) if len(shot.report.centroids) >= 4)
    assert 1 <= enough < 9
    grown = 1.0 + 2.0 * np.minimum(np.arange(10), enough)
    assert exposures_ms(shots) == pytest.approx(list(grown), abs=1e-9)
    assert all(len(shot.report.centroids) >= 4 for shot in shots[enough:])
    assert error_deg(shots[-1].report.attitude, shots[-1].truth) < 10 / 60


def test_a_frame_has_the_commanded_exposure_time() -> None:
    """It opens on time; its truth and glare (1e5 e-/s) are those of its own exposure."""
    glare = "[{kind: uniform, e_s: 1e5}]"
    scene = controlled(3, "4 ms", "{mean_dn: 1000, min_stars: 1000}", background=glare)
    shots = shots_of(scene)
    detector = scene.camera.detector
    assert exposures_ms(shots) == pytest.approx([4, 6, 8], abs=1e-9)
    for n, shot in enumerate(shots):
        assert (
            shot.frame.t_mid_s
            == shot.truth.t_s
            == pytest.approx(0.1 + n * 0.1 + (2 + n) * 1e-3, abs=1e-12)
        )
        gathered_dn = 1e5 * shot.frame.exposure_s / detector.gain_e_dn
        assert np.median(shot.frame.image_dn) == pytest.approx(
            detector.offset_dn + gathered_dn, abs=1.0
        )


@pytest.mark.long
def test_a_bright_body_shortens_the_exposure_and_turning_away_restores_the_stars() -> None:
    """A body at the baffle's edge while the camera turns by 6.4 degrees away from it, its light gone after four."""
    body = "[{kind: stray, ra_deg: 190, dec_deg: 5, angle_deg: [0, 23.9, 24, 180], pst: [4e-6, 4e-6, 0, 0]}]"
    away = {"motion__rate_deg_s": "[2, 0, 0]", "background": body}
    shots = shots_of(controlled(33, "24 ms", "{mean_dn: 150}", **away))
    exposure_ms = exposures_ms(shots)
    mean_dn = np.array([shot.frame.image_dn.mean() for shot in shots])
    gone = int(np.argmax(mean_dn < 70))
    assert 15 < gone < 25  # four degrees at 2 deg/s, ten frames a second
    # In its light every frame above the reference is followed by one a step shorter, down to the least.
    assert exposure_ms[1] == pytest.approx(22)
    assert min(exposure_ms[:gone]) < 5
    for n in range(gone):
        assert (mean_dn[n] > 150) == (exposure_ms[n + 1] < exposure_ms[n])
    # After that it grows to what four stars take, and stays.
    assert exposure_ms[-1] == exposure_ms[-5] > min(exposure_ms)
    assert [shot.report.attitude.status for shot in shots[-5:]] == ["solved"] * 5
    assert not any(shot.report.attitude.solved for shot in shots[5:gone])


@pytest.mark.slow
def test_frames_that_the_filter_used_are_rendered_again_with_the_same_exposures() -> None:
    given = {"vehicle__imu": "{}", "filter": "{start_deg: 0.1}", "motion__control": "none"}
    growing = "{mean_dn: 4000, min_stars: 100000, step: 1 ms, longest: 7 ms, overexposed_objects: 100000}"
    exposure = '{time: "4 ms", rate_hz: 5, frames: 5}'
    given |= {
        "motion__maneuver": "[]",
        "exposure": exposure,
        "tracker__exposure_control": growing,
    }
    flight = open_flight(changed("afit_simsat", **given))
    shots = list(flight.shots())
    assert exposures_ms(shots) == pytest.approx([4, 5, 6, 7, 7], abs=1e-9)
    # The flight lasts until the longest exposure of the last frame, so the filter gets that one too.
    assert [shot.update_status for shot in shots] == ["used"] * 5
    for shot in shots:
        assert shot.report is not None
        frame, _ = flight.render(shot.frame.index)
        assert frame.exposure_s == shot.frame.exposure_s
        np.testing.assert_array_equal(frame.image_dn, shot.frame.image_dn)
        again = solve_frame(build_tracker(flight.lab.camera), frame)
        assert np.abs(again.centroids.xy_px - shot.report.centroids.xy_px).max() < 1e-6


MOON = {
    "light.bodies": "{}",
    "start_time": "2012-06-24T21:00:00",
    "motion.start": "{ra_deg: 154.5, dec_deg: 5}",
    "motion.rate_deg_s": "[0, 0, 0]",
    "exposure.frames": "1",
}


def test_the_moon_is_in_the_frame_and_in_its_truth_table() -> None:
    frame, truth = simulate_motion(loader.load("shefex2", MOON)).render(0)
    (moon,) = (body for body in truth.bodies if body.name == "moon")
    row = list(truth.sources.id).index(moon.id)
    x, y = truth.sources.xy_px[row].round().astype(int)
    assert truth.sources.saturated[row]
    bright = frame.image_dn[y - 2 : y + 3, x + 7 : x + 10]
    dark = frame.image_dn[y - 2 : y + 3, x - 8 : x - 5]
    assert (bright > 0.98 * frame.saturation_dn).all()
    assert (dark > 150).all()  # earthshine: the sky is at 65
    assert (dark < 0.5 * frame.saturation_dn).all()
    assert moon.v_mag == pytest.approx(-8.84, abs=0.01)
    assert 1800 < moon.diameter_arcsec < 2000
    occulted = loader.load("shefex2", MOON | {"light.bodies": "{moon: false}"})
    _, without = simulate_motion(occulted).render(0)
    assert not any(body.name == "moon" for body in without.bodies)


@pytest.mark.slow
def test_the_moon_moves_among_the_stars_during_a_run() -> None:
    """By half a second of arc a second, so a frame a minute later has it elsewhere."""
    settings = MOON | {"exposure.frames": "2", "exposure.rate_hz": "0.0167"}
    flight = simulate_motion(loader.load("shefex2", settings))
    place = [flight.render(index)[1].bodies[0] for index in (0, 1)]
    moved_arcsec = (
        np.hypot(place[1].ra_deg - place[0].ra_deg, place[1].dec_deg - place[0].dec_deg)
        * 3600
    )
    assert 25 < moved_arcsec < 40


def test_bodies_require_a_sky_and_a_date_within_the_ephemeris() -> None:
    with pytest.raises(InputError, match=r"light.*bodies"):
        loader.load("afit_simsat", {"light.bodies": "{}"})
    with pytest.raises(
        InputError, match=r"light.bodies: start_time 1960.* is outside 1972 to 2100"
    ):
        loader.load("shefex2", {"light.bodies": "{}", "start_time": "1960-01-01T00:00:00"})
    with pytest.raises(InputError, match=r"no body is left"):
        loader.load("shefex2", {"light.bodies": "{sun: false, moon: false, planets: false}"})
