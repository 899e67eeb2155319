"""Attitude knowledge of the vehicle: integration of the gyros, its errors, and the tracker's settings."""

from __future__ import annotations

import math
import re
from pathlib import Path

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from estimator.core.types import Attitude
from estimator.trackers.exposure_control import Control
from skysim.apps.cli.commands import run as run_command
from skysim.core.errors import InputError
from skysim.core.types import Floats, Frame, Telemetry
from skysim.dynamics import imu, multibody
from skysim.scene import loader
from skysim.simulation.checks import check, plan_check
from skysim.simulation.flight import Flight, simulate_motion
from skysim.simulation.lab import build_lab, build_tracker
from skysim.tracking import factory
from skysim.tracking.factory import ExposureController
from skysim.tracking.navigation import Navigation, build_filter

PERFECT = (
    "gyro: {arw_deg_sqrt_h: 0, bias_deg_h: 0, turn_on_bias_deg_h: 0, scale_ppm: 0, misalignment_arcsec: 0,"
    " quantum_arcsec: 0}"
)
ARCSEC = math.pi / 180 / 3600
TUMBLE = "[3, -2, 20]"
SINGLE = {"tracker.detector": "default", "tracker.min_area_px": "1"}
NO_CONTROL = {
    "motion.control": "none",
    "motion.maneuver": "[]",
    "vehicle.center_of_mass": "[0 m, 0 m, 0 m]",
}


def flown(until_s: float, **changes: str) -> Flight:
    """A balanced SimSat without control, unless changed."""
    until = {"exposure": f"{{time: 10 ms, rate_hz: 1, frames: 1, first: {until_s} s}}"}
    given = (
        NO_CONTROL | until | {key.replace("__", "."): value for key, value in changes.items()}
    )
    return simulate_motion(loader.load("afit_simsat", given))


def telemetry_of(flight: Flight) -> Telemetry:
    """Telemetry of a flight with an IMU."""
    telemetry = flight.telemetry()
    assert telemetry.lab_from_imu is not None
    return telemetry


def error(telemetry: Telemetry) -> Floats:
    """(K, 3) rotation in lab axes from the true attitude to the navigator's, rad."""
    assert telemetry.lab_from_imu is not None
    return (telemetry.lab_from_imu * telemetry.lab_from_body.inv()).as_rotvec()


# --- the navigator ------------------------------------------------------------------------------------------


def test_a_perfect_navigator_follows_a_turning_vehicle() -> None:
    """At 30 deg/s about an axis that stands still, to 1e-5 arcsec after five seconds."""
    telemetry = telemetry_of(
        flown(5.0, vehicle__imu=f"{{{PERFECT}}}", motion__rate_deg_s="[0, 0, 30]")
    )
    assert np.abs(error(telemetry)).max() < 1e-5 * ARCSEC
    assert telemetry.saturated is not None
    assert not telemetry.saturated.any()


def test_a_moving_axis_costs_the_navigator_the_coning_within_its_samples() -> None:
    """An increment is no rotation vector, but short of one by w x dw/dt T^3 / 12 in every T: 0.02 arcsec here."""
    flight = flown(
        5.0, vehicle__imu=f"{{{PERFECT}, rate_hz: 100}}", motion__rate_deg_s=TUMBLE
    )
    telemetry = telemetry_of(flight)
    step_s = 1 / 100
    rate = telemetry.rate_body_rad_s
    cone = np.cross(rate, np.gradient(rate, telemetry.t_s, axis=0)) * step_s**2 / 12
    lost = telemetry.lab_from_body.apply(cone)[:-1].sum(axis=0) * 0.01
    found = error(telemetry)[-1]
    assert np.linalg.norm(found) > 0.01 * ARCSEC
    np.testing.assert_allclose(found, -lost, rtol=0, atol=0.02 * np.linalg.norm(lost))


def test_uncompensated_earth_rate_makes_the_navigator_drift_by_15_deg_an_hour() -> None:
    """About the Earth's axis in the lab, however the vehicle turns: lab_from_imu = exp(W t) lab_from_body."""
    flight = flown(
        5.0,
        vehicle__imu=f"{{{PERFECT}, earth_rate: uncompensated}}",
        motion__rate_deg_s="[0, 0, 30]",
    )
    telemetry = telemetry_of(flight)
    drift = error(telemetry)[-1] / telemetry.t_s[-1]
    assert np.degrees(np.linalg.norm(drift)) * 3600 == pytest.approx(15.041, abs=1e-3)
    np.testing.assert_allclose(
        drift, imu.earth_rate_lab_rad_s(flight.lab.scene.site), rtol=0, atol=1e-9
    )


def test_a_compensated_earth_rate_causes_no_drift() -> None:
    flight = flown(
        5.0,
        vehicle__imu=f"{{{PERFECT}, earth_rate: compensated}}",
        motion__rate_deg_s="[0, 0, 30]",
    )
    assert np.abs(error(telemetry_of(flight))).max() < 1e-4 * ARCSEC


def test_the_reported_bias_is_the_gyros_excess_rate() -> None:
    """Turn-on bias and uncompensated Earth rate: minus the navigator's mean drift rate in body axes."""
    unit = "{gyro: {arw_deg_sqrt_h: 0, bias_deg_h: 0, turn_on_bias_deg_h: 30, scale_ppm: 0, quantum_arcsec: 0,"
    unit += " misalignment_arcsec: 0}, earth_rate: uncompensated}"
    telemetry = telemetry_of(
        flown(5.0, vehicle__imu=unit, motion__start="{roll_deg: 20, yaw_deg: 70}")
    )
    assert telemetry.lab_from_imu is not None
    assert telemetry.bias_rad_s is not None
    drift = (telemetry.lab_from_body.inv() * telemetry.lab_from_imu).as_rotvec()[
        -1
    ] / telemetry.t_s[-1]
    np.testing.assert_allclose(
        telemetry.bias_rad_s[-1], drift, rtol=0, atol=1e-4 * np.linalg.norm(drift)
    )
    assert np.degrees(np.linalg.norm(drift)) * 3600 > 20


def test_an_initial_attitude_error_stays_in_the_navigator() -> None:
    """Zeroed while the vehicle stood wrong by (roll, pitch, yaw): its Euler angles are short of it by that."""
    home = "home_error_deg: [0.5, -1.0, 2.0]"
    start = "{roll_deg: 5, pitch_deg: 10, yaw_deg: -40}"
    telemetry = telemetry_of(
        flown(1.0, vehicle__imu=f"{{{PERFECT}, {home}}}", motion__start=start)
    )
    assert telemetry.lab_from_imu is not None
    believed = telemetry.lab_from_imu.as_euler("ZYX", degrees=True)[:, ::-1]
    np.testing.assert_allclose(
        believed, np.tile([4.5, 11.0, -42.0], (len(believed), 1)), rtol=0, atol=1e-8
    )


@pytest.mark.long
def test_under_imu_control_the_vehicle_follows_the_navigator_s_error() -> None:
    """The navigator is brought to the reference, (0, 0, 0), so the vehicle stands off by the home's error."""
    home = "home_error_deg: [0.5, -1.0, 2.0]"
    flight = flown(
        12.0, vehicle__imu=f"{{{PERFECT}, {home}}}", motion__control="{feedback: imu}"
    )
    telemetry = telemetry_of(flight)
    assert telemetry.lab_from_imu is not None
    start = np.degrees(telemetry.lab_from_body[0].magnitude())
    assert start < 1e-12
    assert np.degrees(telemetry.lab_from_imu[-1].magnitude()) < 1e-3
    wrong = Rotation.from_euler("ZYX", [-2.0, 1.0, -0.5], degrees=True)
    assert np.degrees((telemetry.lab_from_body[-1] * wrong).magnitude()) < 1e-3
    ideal = telemetry_of(
        flown(12.0, vehicle__imu=f"{{{PERFECT}, {home}}}", motion__control="pid")
    )
    assert np.degrees(ideal.lab_from_body[-1].magnitude()) < 1e-12  # truth is not led astray


# --- what it feels ------------------------------------------------------------------------------------------


def test_the_imu_measures_vibration() -> None:
    """The navigator adds up the shaken vehicle's rates: it is where that is, seen from where it was zeroed."""
    shake = "[{kind: line, frequency_hz: 20, rms_arcsec: [200, 0, 0]}]"
    flight = flown(2.0, vehicle__imu=f"{{{PERFECT}}}", motion__jitter=shake)
    telemetry = telemetry_of(flight)
    assert telemetry.lab_from_imu is not None
    shaken = flight.trajectory().attitude_at(telemetry.t_s)
    expected = telemetry.lab_from_body[0] * shaken[0].inv() * shaken
    found = (expected.inv() * telemetry.lab_from_imu).as_rotvec()
    assert np.abs(found).max() < 0.01 * ARCSEC
    still = (telemetry.lab_from_body.inv() * telemetry.lab_from_imu).as_rotvec()
    assert np.ptp(still[:, 0]) > 400 * ARCSEC


@pytest.mark.slow
@pytest.mark.parametrize("rate_hz", [100, 400, 1000])
def test_the_imu_measures_the_whole_flight_tick_by_tick(rate_hz: int) -> None:
    """The samples of all ticks together are those of the whole flight at once: as many, and their sum to 1e-9 rad."""
    place = np.array([0.1, 0.1, 0.14])
    flight = flown(
        1.2345,
        vehicle__imu=f"{{{PERFECT}, rate_hz: {rate_hz}}}",
        motion__rate_deg_s=TUMBLE,
        seed="3",
    )
    telemetry = telemetry_of(flight)
    knots = flight.trajectory()
    last_s = telemetry.t_s[-1]
    ends_s = np.arange(1, round(last_s * rate_hz) + 1) / rate_hz
    whole = imu.ideal_increments(
        knots.t_s,
        knots.lab_from_body.as_quat(scalar_first=True),
        knots.rate_body_rad_s,
        ends_s,
        1 / rate_hz,
        place,
        flight.lab.vehicle.gravity_m_s2,
    )
    at_once = imu.Navigator(knots.lab_from_body[0].as_quat(scalar_first=True))
    at_once.add(whole)
    expected = Rotation.from_quat(at_once.lab_from_body_wxyz, scalar_first=True)
    assert telemetry.lab_from_imu is not None
    assert np.abs((expected.inv() * telemetry.lab_from_imu[-1]).as_rotvec()).max() < 1e-9


def test_samples_that_do_not_end_with_a_tick_are_not_lost() -> None:
    """Knots of 1 ms felt 7 ms at a time by a unit of 400 Hz: now two, now three samples, none twice."""
    flight = flown(0.1, vehicle__imu=f"{{{PERFECT}}}", motion__rate_deg_s="[0, 0, 30]")
    lab = flight.lab
    there = [lab.camera.mount], lab.start, np.zeros(3), 9.8, np.random.default_rng(1)
    navigation = Navigation(lab.scene, *there)
    knots = flight.trajectory()
    counts = []
    for end in range(7, 100, 7):
        begin = max(end - 10, 0)
        piece = slice(begin, end + 1)
        wxyz = knots.lab_from_body.as_quat(scalar_first=True)[piece]
        before = navigation.samples
        navigation.sample_imu(
            knots.t_s[end], knots.t_s[piece], wxyz, knots.rate_body_rad_s[piece]
        )
        counts.append(navigation.samples - before)
    assert set(counts) == {2, 3}
    assert sum(counts) == navigation.samples == 39  # 97.5 of 98 ms
    angle = Rotation.from_quat(navigation.attitude_wxyz("imu"), scalar_first=True).as_rotvec()
    np.testing.assert_allclose(np.degrees(angle), [0, 0, 30 * 39 * 2.5e-3], rtol=0, atol=1e-9)
    np.testing.assert_allclose(
        np.degrees(navigation.body_rate_rad_s("imu")), [0, 0, 30], rtol=0, atol=1e-9
    )


def test_rotation_beyond_the_gyros_limit_is_permanently_lost() -> None:
    """25 deg/s on gyros that stop at 10: two seconds lose 30 deg."""
    limited = PERFECT.replace("{arw", "{rate_limit_deg_s: 10, arw")
    telemetry = telemetry_of(
        flown(2.0, vehicle__imu=f"{{{limited}}}", motion__rate_deg_s="[0, 0, 25]")
    )
    assert telemetry.saturated is not None
    assert telemetry.saturated[1:].all()
    lost = np.degrees(error(telemetry)[-1])
    np.testing.assert_allclose(lost, [0, 0, -15 * telemetry.t_s[-1]], rtol=0, atol=1e-6)


# --- without a filter ---------------------------------------------------------------------------------------


def test_without_a_filter_the_estimate_is_the_navigator_s() -> None:
    loaded = loader.load("afit_simsat", {"vehicle.imu": "{}"})
    vehicle = multibody.build(loaded.vehicle)
    mount = multibody.camera_mount(vehicle)
    start = Rotation.from_rotvec([0.1, 0.2, 0.3])
    navigation = Navigation(
        loaded, [mount], start, np.zeros(3), 9.8, np.random.default_rng(1)
    )
    np.testing.assert_array_equal(
        navigation.attitude_wxyz("filter"), navigation.attitude_wxyz("imu")
    )
    np.testing.assert_array_equal(navigation.body_rate_rad_s("filter"), np.zeros(3))
    assert navigation.update_filter(0.0, Attitude("no stars")) == "no stars"
    expected = start.as_quat(scalar_first=True)
    np.testing.assert_allclose(navigation.attitude_wxyz("imu"), expected, rtol=0, atol=1e-15)


def test_the_filter_gets_solutions_in_body_axes() -> None:
    """A camera that looks aside: lab_from_body of the solution is the vehicle's, its roll error about the boresight.

    The tracker's covariance is in the camera's axes, ten times larger about the boresight; the filter's stays so,
    about the body axis along which the camera looks.
    """
    changes = {"vehicle.imu": f"{{{PERFECT}}}", "filter": "{start_deg: 5, floor_arcsec: 0}"}
    loaded = loader.load("afit_simsat", changes)
    mount = multibody.camera_mount(multibody.build(loaded.vehicle))
    aside = type(mount)(mount.camera_body_m, Rotation.from_euler("y", -90, degrees=True))
    boresight_body = aside.cam_from_body.inv().apply([0, 0, 1])
    truth = Rotation.from_rotvec([0.02, -0.03, 0.04])
    navigation = Navigation(
        loaded, [aside], Rotation.identity(), np.zeros(3), 9.8, np.random.default_rng(1)
    )
    spread = np.diag([1.0, 1.0, 100.0]) * (20 * ARCSEC) ** 2
    solution = Attitude("solved", aside.cam_from_body * truth.inv(), spread)
    assert navigation.update_filter(0.0, solution) == "used"
    believed = Rotation.from_quat(navigation.attitude_wxyz("filter"), scalar_first=True)
    assert (believed.inv() * truth).magnitude() < 20 * ARCSEC
    assert navigation.filter is not None
    sigma = navigation.filter.state.sigma_attitude_rad / ARCSEC
    along = int(np.argmax(np.abs(boresight_body)))
    np.testing.assert_allclose(sigma[along], 200, rtol=0.01)
    np.testing.assert_allclose(np.delete(sigma, along), 20, rtol=0.01)


def test_the_keys_of_a_filter_reach_its_states_in_their_units() -> None:
    keys = "{start_deg: 0.1, scale_ppm: 300, misalignment_arcsec: 20, mounting_arcsec: 50, rate_limit_deg_s: 10,"
    keys += " systematic_arcsec: 30, considered: [scale]}"
    loaded = loader.load("afit_simsat", {"vehicle.imu": "{}", "filter": keys})
    assert loaded.filter is not None
    built = build_filter(loaded.filter, Rotation.identity())
    for name, sigma in (
        ("scale", 300e-6),
        ("misalignment", 20 * ARCSEC),
        ("mounting", 50 * ARCSEC),
    ):
        np.testing.assert_allclose(built.state.sigma(name), sigma, rtol=1e-12, atol=0)
    # One precise solution: attitude and mount share the 50, the slow error adds its 30, of which nothing is learned.
    assert built.update(0.0, Rotation.identity(), (ARCSEC * np.eye(3)) ** 2).status == "used"
    sigma = built.state.sigma_attitude_rad / ARCSEC
    start = np.radians(0.1) / ARCSEC
    np.testing.assert_allclose(
        sigma, 1 / np.sqrt(1 / (50**2 + 30**2 + 1) + 1 / start**2), rtol=1e-3
    )
    assert (built.state.sigma("mounting") < 50 * ARCSEC).all()
    np.testing.assert_array_equal(built.state.others["scale"], np.zeros(3))
    # Nine tenths of the rate limit is a saturation, without the IMU's word.
    before = built.state.sigma_attitude_rad
    built.propagate([0.1], [[np.radians(0.95), 0.0, 0.0]], [False])
    assert (built.state.sigma_attitude_rad > before + np.radians(0.4)).all()


# --- what the star tracker will not work under, and what its beliefs are worth ------------------------------


@pytest.mark.parametrize(
    ("changes", "why"),
    [
        ({"light.layout": "{kind: fibonacci, count: 1, cap_deg: 20}"}, "0 pairs within"),
        ({"light.layout": "{kind: fibonacci, count: 6, cap_deg: 25}"}, "0 pairs within"),
        (
            {"tracker.assumed_camera_body": "[0 m, 0 m, 2 m]"},
            r"camera 2\.000 m from the bearing",
        ),
    ],
)
def test_a_dome_that_no_tracker_supports_is_refused_in_one_line(
    changes: dict[str, str], why: str
) -> None:
    """It is still rendered, as a lab may light one LED."""
    lab = build_lab(loader.load("afit_simsat_ideal", changes))
    with pytest.raises(
        InputError, match=f"light: the star tracker cannot use .*: {why}"
    ) as refused:
        build_tracker(lab.camera)
    assert "\n" not in str(refused.value)
    assert len(lab.camera.sources) >= 1


def doubted_of(name: str, changes: dict[str, str]) -> list[str]:
    return check(build_lab(loader.load(name, changes))).findings


@pytest.mark.slow
@pytest.mark.parametrize(
    ("surface", "doubted"),
    [
        ("{kind: ellipsoid, apex: 1.2 m, semi_axes: [1 m, 1 m, 0.7 m]}", False),
        (
            "{kind: ellipsoid, apex: 1.2 m, semi_axes: [1 m, 1 m, 0.7 m], tilt_deg: [3, 0]}",
            True,
        ),
        ("{kind: sphere, apex: 1.2 m, radius: 1 m, tilt_deg: [3, 0]}", False),
        ("{kind: flat, apex: 1.2 m, tilt_deg: [3, 0]}", False),
    ],
)
def test_a_surface_that_is_no_upright_ellipsoid_is_warned_of(
    surface: str, doubted: bool
) -> None:
    """Of a tilted ellipsoid by how much it misses: turned by e it moves (a - b) e at the most, along its normal."""
    lines = doubted_of("afit_simsat", {"light.surface": surface})
    doubts = [line for line in lines if line.startswith("light.surface")]
    assert len(doubts) == doubted
    for line in doubts:
        missed_mm = float(re.search(r"differs by (\S+) mm rms", line)[1])  # type: ignore[index]
        assert 1 < missed_mm < 300 * np.radians(3)


@pytest.mark.slow
@pytest.mark.parametrize("scene", ["afit_simsat", "apl_dome"])
def test_a_camera_outside_of_the_dome_is_warned_of(scene: str) -> None:
    """Its frames would be black without explanation."""
    far = {
        "vehicle.camera": "[0 m, 1.3 m, 0 m]",
        "vehicle.inertia": "[120 kg m2, 120 kg m2, 120 kg m2]",
    }
    (line,) = doubted_of(scene, far)
    assert line.startswith("vehicle.camera: 1.3 m from the bearing, outside of light.surface")
    assert not any("vehicle.camera" in line for line in doubted_of(scene, {}))


@pytest.mark.slow
def test_a_sky_scene_has_no_surface_warning() -> None:
    assert doubted_of("shefex2", {}) == []


@pytest.mark.slow
@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"light.led.disk_diameter": "8 mm"}, "tracker.detector: LED images are 87 px wide"),
        ({"camera.focus": "20 in"}, "tracker.detector: LED images are 54 px wide"),
        (
            {"light.led.drive": "{kind: sequential, controller: dome}"},
            "exposure.time: 0.01 s is shorter than the LED drive's cycle",
        ),
    ],
)
def test_conditions_beyond_every_tracker_are_warned_of(
    changes: dict[str, str], message: str
) -> None:
    """By hand: 8 mm at 33 in, 36.5 mm before pixels of 4 um, is 87 px; focused at 20 in 4.4 mm of pupil blur by 32."""
    lab = build_lab(loader.load("afit_simsat", changes))
    lines = plan_check.dome_warnings(lab)
    assert len(lines) == 1
    assert lines[0].startswith(message)
    assert lines[0] in check(lab).findings


@pytest.mark.slow
def test_a_warning_is_one_line_before_the_run_which_continues(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    changes = ["light.surface.tilt_deg=[8, 0]", "exposure.first=0 s"]
    run_command.run(
        "afit_simsat",
        frames=1,
        seed=None,
        out=tmp_path,
        set_=changes,
        scene_3d=False,
        json=True,
    )
    said = capsys.readouterr()
    assert said.err.startswith("skysim: light.surface: differs by")
    assert said.err.count("\n") == 1
    assert '"frames": 1' in said.out


# --- how long to expose ---------------------------------------------------------------------------------------


def test_exposure_control_has_the_chart_s_defaults() -> None:
    """The schema repeats the estimator's constants, as it may not ask it for them."""
    plain = factory.control_settings(
        loader.load("shefex2", {"tracker.exposure_control": "{mean_dn: 150}"})
    )
    assert plain == Control(mean_dn=150.0)
    part = "{mean_dn: 99, shortest: 1 ms, longest: 90 ms, step: 3 ms, min_stars: 5, overexposed_objects: 6,"
    control = factory.control_settings(
        loader.load("shefex2", {"tracker.exposure_control": part + " saturated_px: 7}"})
    )
    assert control == Control(99.0, 1e-3, 90e-3, 3e-3, 5, 6, 7)
    assert factory.control_settings(loader.load("shefex2")) is None


def test_without_exposure_control_every_frame_has_the_same_exposure() -> None:
    meter = ExposureController(loader.load("shefex2"))
    meter.update(Frame(0, np.full((493, 659), 4000, np.uint16), 0.0, 0.04, 4080.0))
    assert meter.exposure_s == 0.04


def test_defective_pixels_are_no_stars_so_the_exposure_grows() -> None:
    """Five stars are enough; five bright pixels, sharper than any optics, are none."""
    meter = ExposureController(
        loader.load("shefex2", {"tracker.exposure_control": "{mean_dn: 500}"} | SINGLE)
    )
    rng = np.random.default_rng(5)
    y, x = np.mgrid[:493, :659]
    places = [(100, 100), (200, 400), (300, 150), (400, 500), (250, 600)]
    spots = np.sum(
        [600 * np.exp(-((x - a) ** 2 + (y - b) ** 2) / 2 / 0.8**2) for b, a in places], axis=0
    )
    spikes = np.zeros((493, 659))
    for place in places:
        spikes[place] = 600
    for light, expected_s in ((spots, 0.04), (spikes, 0.042)):
        image = np.rint(100 + light + rng.normal(0, 2, light.shape)).astype(np.uint16)
        meter.update(Frame(0, image, 0.0, 0.04, 4080.0))
        assert meter.exposure_s == pytest.approx(expected_s, abs=1e-12)


def test_an_empty_frame_of_a_coarse_converter_lengthens_the_exposure() -> None:
    """Every pixel equals the offset: no star, and nothing too bright."""
    meter = ExposureController(
        loader.load("shefex2", {"tracker.exposure_control": "{mean_dn: 9}"})
    )
    meter.update(Frame(0, np.full((493, 659), 4, np.uint16), 0.0, 0.04, 255.0))
    assert meter.exposure_s == pytest.approx(0.042, abs=1e-12)
