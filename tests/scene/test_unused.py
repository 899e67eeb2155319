"""An option without effect is refused at its place, and it really has none."""

from __future__ import annotations

from pathlib import Path
from typing import NamedTuple

import numpy as np
import pytest

from skysim.core.errors import InputError
from skysim.scene import loader, unused, unused_rules
from skysim.simulation.flight import simulate_motion
from skysim.simulation.lab import build_tracker
from skysim.tracking.factory import solve_frame

SMALL = {"exposure.frames": "1", "camera.width_px": "400", "camera.height_px": "300"}
IMU = "{gyro: {bias_deg_h: 0}, accelerometer: {bias_ug: 0}}"
CMGS = "{gimbal_rate_limit_deg_s: 5, steering: pseudo_inverse}"
BOARD = "{azimuth_deg: 0, tilt_deg: 1, leds: [0, 2, 4, 7, 8]}"
BOARDS = f"{{kind: patch_boards, cap_deg: 27, pitch: 8 mm, boards: [{BOARD}]}}"
SPREAD = "{kind: patch_boards, cap_deg: 27, pitch: 8 mm, spacing: 60 mm}"
PANEL = (
    "{kind: lcd, pixels: [400, 300], pitch: 2 mm, points: {kind: celestial, cap_deg: 10, count: 20,"
    " camera: [0 m, 0 m, 0 m], zenith_ra_deg: 0, zenith_dec_deg: 90}}"
)
SPIRAL = "{kind: fibonacci, count: 900, cap_deg: 27}"


class Case(NamedTuple):
    """A key that has no effect in a scene with some settings, and settings with which it has one."""

    scene: str
    settings: dict[str, str]
    key: str
    value: str
    useful: dict[str, str]


DOME = "afit_simsat"
SKY = "shefex2"
BENCH = "collimated_display"
CODED = "coded_spiral"
MANY = "{kind: fibonacci, count: 700, cap_deg: 34}"
DENSE = {"light.layout.count": "4000"}  # for the small field of these tests
TWO_LEVELS = {"light.layout.levels": "[1, 0.5]"}
BY_LEVELS = {"light.layout": MANY} | TWO_LEVELS
DIRECT = {"light.led.drive": "{kind: direct}"}
FLAT = {"light.surface": "{kind: flat, apex: 48 in}"}
FLOOR = "{share: 0.5, depth: 1 m, radius: 1 m}"
WARMING = {
    "thermal.mount_arcsec_k": "[1, 2, 3]",
    "thermal.temperature": "{kind: linear, start_c: 21, rate_c_h: 30}",
}
STEADY = {"thermal.temperature": "{kind: steady, temperature_c: 25}"}
MOON = {
    "light.bodies": "{}",
    "start_time": "2012-06-24T21:00:00",
    "motion.start": "{ra_deg: 154.5, dec_deg: 5}",
}
ORBIT = "{kind: circular, altitude: 500 km, inclination_deg: 97}"
AIR = {
    "light.air": "{}",
    "site": "{latitude_deg: 53, longitude_deg: 9}",
    "start_time": "2012-06-24T21:00:00",
}
CASES = [
    Case(DOME, {}, "tracker.catalog", "gaia_v8.0", {}),
    Case(DOME, {}, "tracker.limit_mag", "4", {}),
    Case(SKY, {}, "tracker.assumed_camera_body", "[1 m, 0 m, 0 m]", {}),
    Case(SKY, {}, "tracker.options", "{a: 1}", {"tracker.name": "tetra3rs"}),
    Case(SKY, {}, "tracker.time_limit", "3 s", {"tracker.name": "tetra3rs"}),
    Case(
        CODED,
        {"tracker.name": "guest"},
        "tracker.decoder",
        "{gate_px: 40}",
        {"tracker.name": "own"},
    ),
    Case(CODED, DENSE, "tracker.identifier", "pyramid", {"tracker.decoder": "null"}),
    Case(SKY, {}, "tracker.brightness_sigma", "0.2", {}),
    Case(
        CODED,
        DENSE | TWO_LEVELS,
        "tracker.brightness_sigma",
        "0.2",
        {"tracker.decoder": "null"},
    ),
    Case(
        DOME,
        BY_LEVELS | {"tracker.name": "guest"},
        "tracker.brightness_sigma",
        "0.2",
        {"tracker.name": "own"},
    ),
    Case(
        DOME,
        BY_LEVELS | {"tracker.identifier": "saa"},
        "tracker.brightness_sigma",
        "0.2",
        {"tracker.identifier": "led_pairs"},
    ),
    Case(SKY, {}, "tracker.acceptance", "thesis", {"tracker.identifier": "fialho_3"}),
    Case(SKY, {}, "tracker.cos_error", "5.5e-5", {"tracker.identifier": "shefex"}),
    Case(DOME, {"light.layout": MANY}, "tracker.brightness_sigma", "0.2", TWO_LEVELS),
    Case(DOME, {}, "tracker.magnitude_sigma", "0.2", {}),
    Case(
        SKY,
        {"tracker.identifier": "shefex"},
        "tracker.magnitude_sigma",
        "0.2",
        {"tracker.identifier": "fialho_4"},
    ),
    Case(
        DOME, {}, "tracker.assumed_attitude_deg", "[0, 0, 1]", {"tracker.identifier": "saa"}
    ),
    Case(
        CODED,
        DENSE | DIRECT,
        "light.led.clock.offset_ppm",
        "7",
        {"light.led.code": "{kind: cyclic, bit_time: 20 ms}"},
    ),
    Case(
        SKY, {"tracker.name": "tetra3rs"}, "tracker.solver", "quest", {"tracker.name": "own"}
    ),
    Case(
        "simsat_bump",
        {"tracker.name": "tetra3rs"},
        "tracker.gyro",
        "true",
        {"tracker.name": "own"},
    ),
    Case(
        SKY,
        {"tracker.name": "tetra3rs"},
        "tracker.threshold_sigma",
        "7",
        {"tracker.exposure_control": "{mean_dn: 150, longest: 50 ms}"},
    ),
    Case(
        DOME,
        {"tracker.detector": "thesis"},
        "tracker.min_area_px",
        "9",
        {"tracker.detector": "threshold"},
    ),
    Case(
        DOME,
        {"tracker.detector": "threshold"},
        "tracker.intensity_threshold",
        "0.1",
        {"tracker.detector": "thesis"},
    ),
    Case(
        DOME,
        {"tracker.survey": "{led_sigma: 0 m, lever_sigma: 0 m}"},
        "tracker.survey.seed",
        "5",
        {"light.surface.error": "1 mm"},
    ),
    Case(DOME, {}, "tracker.survey.surface_seed", "5", {"light.surface.error": "1 mm"}),
    Case(DOME, DIRECT, "light.led.pwm_period", "7 ms", {"light.led.drive": "{kind: pwm}"}),
    Case(
        DOME,
        FLAT | DIRECT | {"light.layout": PANEL, "light.led.spectrum": "630 nm"},
        "light.led.color_scatter",
        "5 nm",
        {},
    ),
    Case(
        DOME,
        FLAT
        | DIRECT
        | {"light.layout": PANEL, "light.led.aging": "{hours: 9000, life_hours: 30000}"},
        "light.led.aging.scatter",
        "0.2",
        {},
    ),
    Case(DOME, DIRECT, "light.led.clock.offset_ppm", "7", {"light.led.drive": "{kind: pwm}"}),
    Case(
        DOME, {"light.layout": BOARDS}, "light.layout.lit", "[1, 2]", {"light.layout": SPREAD}
    ),
    Case(
        DOME,
        DIRECT | {"light.led.scatter": "0", "light.layout": SPIRAL},
        "light.layout.hardware_seed",
        "7",
        {"light.led.scatter": "0.1"},
    ),
    Case(
        DOME,
        FLAT | {"light.reflection": f"{{floor: {FLOOR}}}"},
        "light.reflection.specular",
        "0.1",
        {"light.surface": "{kind: sphere, apex: 48 in, radius: 48 in}"},
    ),
    Case(
        DOME,
        FLAT,
        "light.reflection.diffuse",
        "0.5",
        {"light.reflection": f"{{diffuse: 0.5, floor: {FLOOR}}}"},
    ),
    Case(SKY, {}, "camera.baffle", "{angle_deg: [20, 90], pst: [1e-6, 1e-9]}", MOON),
    Case(
        SKY,
        {"camera.detector.dark_e_s": "0"},
        "camera.detector.dsnu",
        "0.5",
        {"camera.detector.dark_e_s": "20"},
    ),
    Case(
        SKY,
        {"camera.detector.hot_e_s": "0"},
        "camera.detector.hot_pixels",
        "0.01",
        {"camera.detector.hot_e_s": "9"},
    ),
    Case(
        SKY,
        {"camera.detector.hot_pixels": "0"},
        "camera.detector.hot_e_s",
        "9",
        {"camera.detector.hot_pixels": "1"},
    ),
    Case(
        SKY,
        {},
        "camera.detector.dark_doubling_c",
        "5",
        {"camera.detector.temperature_c": "30"},
    ),
    Case(
        SKY,
        {"camera.detector.dark_e_s": "0", "camera.detector.hot_pixels": "0"},
        "camera.detector.temperature_c",
        "40",
        {"camera.detector.dark_e_s": "9"},
    ),
    Case(
        SKY,
        {
            f"camera.detector.{key}": "0"
            for key in (
                "prnu",
                "dsnu",
                "hot_pixels",
                "column_offset_e",
                "hot_e_s",
                "dark_e_s",
            )
        },
        "camera.detector.hardware_seed",
        "9",
        {"camera.detector.prnu": "0.01"},
    ),
    Case(
        SKY,
        {"camera.detector.noise": "false"},
        "camera.detector.blooming",
        "column",
        {"camera.detector.noise": "true"},
    ),
    Case(
        DOME,
        {},
        "camera.detector.anti_blooming",
        "0.5",
        {"camera.detector.blooming": "column"},
    ),
    Case(
        DOME, {}, "site.latitude_deg", "10", {"vehicle.disturbances.earth_rotation": "true"}
    ),
    Case(
        DOME, {}, "site.x_azimuth_deg", "10", {"vehicle.disturbances.earth_rotation": "true"}
    ),
    Case(SKY, MOON, "site.latitude_deg", "-50", {**MOON, "site.longitude_deg": "20"}),
    Case(SKY, {}, "site.longitude_deg", "20", MOON),
    Case(SKY, MOON, "site.height", "9 km", {**MOON, "site.longitude_deg": "20"}),
    Case(DOME, {}, "vehicle.mast", "0.3 m", {"vehicle.sag_arcsec": "[5, 5]"}),
    Case(SKY, {}, "camera.pupil_walk", "[10 mm, 0 mm]", {}),
    Case(SKY, WARMING, "thermal.dome_ppm_k", "70", {}),
    Case(DOME, WARMING, "thermal.anchor_height", "1 m", {"thermal.dome_ppm_k": "70"}),
    Case(DOME, WARMING | STEADY, "thermal.speed", "60", WARMING),
    Case(
        SKY,
        {"light.satellites.random": "{per_field: 1, seed: 1}"},
        "light.satellites.standard_mag",
        "3",
        {},
    ),
    Case(SKY, {}, "tracker.orbit_velocity", "false", {"orbit": ORBIT}),
    Case(SKY, {**MOON, "orbit": ORBIT}, "site.longitude_deg", "20", {}),
    Case(SKY, {}, "tracker.refraction", "true", AIR),
    Case(SKY, AIR, "light.air.seeing_arcsec", "1", {**AIR, "camera.focal_length": "200 mm"}),
    Case(SKY, {}, "vehicle.tilt_stop_deg", "20", {"vehicle.mount": "air_bearing"}),
    Case(DOME, {}, "vehicle.cmgs", CMGS, {"motion.control": "{actuators: cmgs}"}),
    Case(
        DOME,
        {"vehicle.imu": IMU},
        "vehicle.imu.gyro.bias_time",
        "9 s",
        {"vehicle.imu.gyro.bias_deg_h": "1"},
    ),
    Case(
        DOME,
        {"vehicle.imu": IMU},
        "vehicle.imu.accelerometer.bias_time",
        "9 s",
        {"vehicle.imu.accelerometer.bias_ug": "1"},
    ),
    Case(
        DOME,
        {"motion.control": "{law: pd}"},
        "motion.control.integral_rad_s",
        "0.1",
        {"motion.control": "{law: pid}"},
    ),
]
KEYS = [case.key for case in CASES]


@pytest.mark.parametrize("case", CASES, ids=KEYS)
def test_a_key_without_effect_is_refused(case: Case) -> None:
    """One line has the key, the reason, allowed values and the place; where it has an effect, it is accepted."""
    settings = case.settings
    with pytest.raises(InputError) as refused:
        loader.load(case.scene, settings | {case.key: case.value})
    message = str(refused.value)
    assert message.startswith(f"{case.key}")
    assert ": has no effect: " in message
    assert "; allowed: " in message
    assert message.endswith("(overrides)")
    if case.useful:
        loader.load(case.scene, settings | {case.key: case.value} | case.useful)


def test_every_rule_has_a_case() -> None:
    """The rule for a map needs a file and has its own test below."""
    covered = {
        rule.reason
        for case in CASES
        for rule in unused_rules.RULES
        if unused.section_of(case.key, rule)
    }
    # Set with its section.
    covered |= {
        rule.reason for rule in unused_rules.RULES if "vehicle.cmgs.steering" in rule.keys
    }
    missing = [rule.keys for rule in unused_rules.RULES if rule.reason not in covered]
    assert missing == []


def test_every_key_of_a_rule_is_a_key_of_the_schema() -> None:
    """A misspelled key would never be refused."""
    schema = (Path(__file__).parents[2] / "data/schema/scene.json").read_text()
    for rule in unused_rules.RULES:
        for key in rule.keys:
            assert f'"{key.rpartition(".")[2]}": {{' in schema, key


def outcome(
    scene: str, settings: dict[str, str]
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """One frame after a short motion, its solution, and the attitude and bias at the end."""
    flight = simulate_motion(loader.load(scene, settings, refuses_unused=False))
    frame, _ = flight.render(0)
    attitude = solve_frame(build_tracker(flight.lab.camera), frame).attitude.cam_from_ref
    solved = np.full(4, np.nan) if attitude is None else attitude.as_quat()
    return frame.image_dn, solved, flight.trajectory().lab_from_body[-1].as_quat()


SAMPLE = (
    "tracker.limit_mag",
    "tracker.survey.surface_seed",
    "light.led.pwm_period",
    "camera.detector.dark_doubling_c",
)


@pytest.mark.slow
@pytest.mark.parametrize(
    "case", [case for case in CASES if case.key in SAMPLE], ids=lambda case: case.key
)
def test_a_refused_key_changes_neither_motion_nor_frame_nor_solution(case: Case) -> None:
    check_no_effect(case)


OTHERS = [
    case for case in CASES if case.key not in SAMPLE and "tracker.name" not in case.settings
]


@pytest.mark.long
@pytest.mark.parametrize("case", OTHERS, ids=lambda case: case.key)
def test_no_other_refused_key_changes_anything(case: Case) -> None:
    """Keys of external trackers, which are other programs, are excepted."""
    check_no_effect(case)


def check_no_effect(case: Case) -> None:
    settings = SMALL | {"exposure.first": "50 ms"} | case.settings
    if (
        case.key == "vehicle.cmgs"
    ):  # switched on in both: only the limit and the steering differ
        settings |= {case.key: "{}"}
    if case.key == "light.layout.lit":
        settings |= {"light.layout": BOARDS}
    plain = outcome(case.scene, settings)
    changed = outcome(case.scene, settings | {case.key: case.value})
    for one, other in zip(plain, changed, strict=True):
        np.testing.assert_array_equal(one, other)


@pytest.mark.parametrize(
    "case",
    [
        case
        for case in CASES
        if case.key in ("light.led.pwm_period", "tracker.survey.surface_seed")
    ],
    ids=lambda case: case.key,
)
def test_an_allowed_key_changes_the_result(case: Case) -> None:
    """This shows that the test above can fail."""
    settings = SMALL | {"exposure.first": "50 ms"} | case.settings | case.useful
    plain = outcome(case.scene, settings)
    changed = outcome(case.scene, settings | {case.key: case.value})
    assert any((one != other).any() for one, other in zip(plain, changed, strict=True))


def written(folder: Path, text: str) -> Path:
    path = folder / "mine.yaml"
    path.write_text(f"schema: 1\n{text}")
    return path


def test_a_key_of_the_file_is_refused_with_its_line(tmp_path: Path) -> None:
    path = written(
        tmp_path,
        "base: afit_simsat\nlight:\n  led:\n    drive: {kind: direct}\n    pwm_period: 2 ms\n",
    )
    with pytest.raises(
        InputError, match=r"light.led.pwm_period: has no effect.*mine.yaml, line 6\)"
    ):
        loader.load(path)


def test_a_key_of_a_base_or_a_preset_is_tolerated(tmp_path: Path) -> None:
    """The base has pwm_period and clock, the preset lu205c dark_doubling_c without a temperature."""
    loaded = loader.load(
        written(tmp_path, "base: afit_simsat\nlight: {led: {drive: {kind: direct}}}\n")
    )
    assert loaded.light.led.pwm_period_s == 1e-3  # type: ignore[union-attr]
    assert loaded.light.led.clock.offset_ppm == 2000  # type: ignore[union-attr]
    assert loaded.camera.detector.dark_doubling_c != 7


def test_a_key_that_only_an_override_makes_useless_is_tolerated(tmp_path: Path) -> None:
    path = written(tmp_path, "base: shefex2\ntracker: {threshold_sigma: 6}\n")
    assert loader.load(path, {"tracker.detector": "thesis"}).tracker.threshold_sigma == 6
    with pytest.raises(InputError, match=r"tracker.threshold_sigma: has no effect"):
        loader.load(path, {"tracker.detector": "thesis", "tracker.threshold_sigma": "7"})


def test_a_useless_key_at_its_default_is_tolerated() -> None:
    for value in ("{catalog: hipparcos_hp6.5, limit_mag: 6.0}", "{}"):
        assert loader.load("afit_simsat_ideal", {"tracker": value}).tracker.limit_mag == 6


def test_a_section_as_an_override_sets_its_keys() -> None:
    with pytest.raises(InputError, match=r"tracker.limit_mag: has no effect"):
        loader.load("afit_simsat_ideal", {"tracker": "{limit_mag: 4, detector: local}"})


def test_with_a_map_the_survey_has_no_effect(tmp_path: Path) -> None:
    """Solvers that use the surveyed surface are excepted."""
    (tmp_path / "leds.ecsv").write_text("")
    own = written(tmp_path, "base: afit_simsat_ideal\ntracker: {map: leds.ecsv}\n")
    with pytest.raises(
        InputError,
        match=r"light.surface.error: has no effect: tracker.map replaces the survey",
    ):
        loader.load(own, {"light.surface.error": "1 mm"})
    assert loader.load(own, {"light.surface.error": "1 mm", "tracker.solver": "thesis"})


@pytest.mark.parametrize("name", loader.list_scenes())
def test_no_shipped_scene_breaks_a_rule(name: str) -> None:
    assert loader.load(name).name == name
