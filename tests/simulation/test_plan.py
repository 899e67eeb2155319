"""The check of a plan: facts against counts and closed forms, and a warning with its key for each mistake."""

from __future__ import annotations

import math
import re
import time
from functools import cache
from pathlib import Path

import numpy as np
import pytest
from scipy.spatial import cKDTree
from scipy.spatial.transform import Rotation

from skysim.core.constants import ARCSEC_RAD
from skysim.core.errors import InputError
from skysim.dynamics import multibody
from skysim.results import telemetry_report
from skysim.scene import loader
from skysim.simulation.checks import (
    Check,
    attitudes,
    check,
    detection,
    facts,
    plan_check,
    sampling,
    sky_warnings,
)
from skysim.simulation.checks.facts import Fact
from skysim.simulation.checks.sampling import Plan
from skysim.simulation.exposure import render_at_rest
from skysim.simulation.flight import Flight, simulate_motion
from skysim.simulation.lab import Lab, build_lab, build_tracker
from skysim.tracking.factory import solve_frame

SPHERE = "{kind: sphere, apex: 1.2 m, radius: 1.2 m}"
GEODESIC = "{kind: geodesic, frequency: 24, cap_deg: 42}"
TWO_STOPS = "{kind: two_stops, cutoff_deg: 4}"
TILTED = '[{kind: slew, pitch_deg: 25, rate_deg_s: 5}, {kind: hold, duration: "30 s"}]'
AT_REST = {"motion.control": "none", "motion.maneuver": "[]", "exposure.frames": "1"}


STATION = (
    "{kind: total_station, position: [1 m, 0 m, -0.5 m], angle_sigma_arcsec: 2, "
    "distance_sigma: 0.2 mm, distance_ppm: 2"
)


def lab_of(name: str, **changes: str) -> Lab:
    return build_lab(
        loader.load(name, {key.replace("__", "."): value for key, value in changes.items()})
    )


def fact(result: Check, name: str) -> Fact:
    (found,) = [one for one in result.facts if one.name == name]
    return found


@cache
def shipped(name: str) -> Check:
    """The check of a scene as it is shipped; it takes half a second."""
    return check(lab_of(name))


def plan_of(lab: Lab) -> Plan:
    return plan_check.plan_of(lab, attitudes.of_frames(lab))


# Attitudes


@pytest.mark.slow
def test_the_check_uses_the_attitudes_of_the_planned_motion() -> None:
    """The reference at mid-exposure; the controller follows it to a hundredth of a degree."""
    lab = lab_of("afit_simsat", exposure__frames="40")
    motion = Flight(lab).simulate_motion().trajectory()
    frames = attitudes.of_frames(lab)
    apart = (motion.attitude_at(frames.t_s) * frames.lab_from_body.inv()).magnitude()
    assert np.degrees(apart).max() < 0.1
    rates = np.array([motion.rate_at(t_s) for t_s in frames.t_s])
    assert np.degrees(np.abs(rates - frames.rate_body_rad_s)).max() < 0.1
    every = [0.005 + 1 + n / 2 for n in range(40)]
    fastest = max(np.linalg.norm(motion.rate_at(t_s)) for t_s in every)
    assert np.linalg.norm(frames.rate_body_rad_s, axis=1).max() == pytest.approx(
        fastest, rel=0.01
    )


def test_checked_attitudes_are_uniform_up_to_the_largest_tilt_and_over_the_sky() -> None:
    dome = lab_of("afit_simsat")
    sky = lab_of("shefex2")
    frames = attitudes.of_frames(dome)
    reach = attitudes.within_reach(frames)
    tilt_deg = multibody.tilt_deg(reach.lab_from_body)
    assert tilt_deg.max() == pytest.approx(
        multibody.tilt_deg(frames.lab_from_body).max(), abs=1e-4
    )
    height = 1 - np.cos(np.radians(tilt_deg))
    assert np.median(height) == pytest.approx(height.max() / 2, rel=0.1)
    everywhere = attitudes.within_reach(attitudes.of_frames(sky)).lab_from_body
    boresight = (everywhere * sky.camera.mount.cam_from_body.inv()).apply([0, 0, 1])
    assert np.linalg.norm(boresight.mean(axis=0)) < 0.05
    nearest_deg = np.degrees(cKDTree(boresight).query(boresight, k=2)[0][:, 1])
    assert nearest_deg.min() > 15  # 48 even directions are some 30 deg apart


def test_without_a_controller_the_bearing_may_tilt_to_its_stop() -> None:
    lab = lab_of("afit_simsat", motion__control="none", motion__maneuver="[]")
    frames = attitudes.of_frames(lab)
    assert attitudes.greatest_tilt_deg(frames) == pytest.approx(30)


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        (
            {"motion__start": "{pitch_deg: 40}", "motion__maneuver": "[]"},
            "motion.start: tilt of 40",
        ),
        ({"motion__maneuver": TILTED.replace("25", "35")}, "motion.maneuver: tilt of 3"),
    ],
)
def test_a_tilt_beyond_the_stop_is_refused_as_by_a_run(
    changes: dict[str, str], message: str
) -> None:
    with pytest.raises(
        InputError, match=f"{message}.*allowed: up to vehicle.tilt_stop_deg 30"
    ):
        check(lab_of("afit_simsat", **changes))


# Facts


@pytest.mark.slow
def test_field_and_pixel_scale_are_those_of_a_pinhole() -> None:
    """1600 pixels of 4 um, 36.53 mm behind the lens: 10.0 deg, as the scene says."""
    field = fact(shipped("afit_simsat"), "field of view").values
    assert field["field_deg"][0] == pytest.approx(
        2 * math.degrees(math.atan(800 * 4e-6 / 36.53e-3)), rel=1e-3
    )
    assert field["arcsec_px"] == pytest.approx(4e-6 / 36.53e-3 / ARCSEC_RAD, rel=1e-3)


@pytest.mark.slow
@pytest.mark.parametrize("name", ["afit_simsat", "shefex2", "apl_dome"])
def test_the_check_counts_the_lights_that_the_tracker_uses(name: str) -> None:
    lab = lab_of(name, exposure__frames="1")
    frame, _ = Flight(lab).simulate_motion().render(0)
    report = solve_frame(build_tracker(lab.camera), frame)
    assert report.attitude.match is not None
    found = fact(check(lab), "lights in the field").values["frames"]
    assert found["mean"] == pytest.approx(
        len(report.attitude.match.observed), rel=0.1, abs=1.5
    )
    assert found["least"] <= found["mean"] <= found["on_chip"]


def test_the_fewest_lights_are_at_the_stated_attitude() -> None:
    lab = lab_of("afit_simsat")
    plan = plan_of(lab)
    text = facts.lights_in_field(plan).values["reach"]["least_at"]
    roll, pitch, yaw = (
        float(re.search(rf"{name} (\S+)°", text)[1]) for name in ("roll", "pitch", "yaw")
    )  # type: ignore[index]
    there = attitudes.CheckedAttitudes(
        lab,
        Rotation.from_euler("ZYX", [[yaw, pitch, roll]], degrees=True),
        np.zeros((1, 3)),
        np.full(1, np.nan),
    )
    assert len(sampling.sampled(there, plan).used[0]) == pytest.approx(
        plan.reach.counts().min(), abs=1
    )


@pytest.mark.slow
def test_the_depth_of_focus_ends_where_defocus_is_a_pixel() -> None:
    """By similar triangles: a pupil of 35 / 8 mm, a chip 36.53 mm behind it focused at 33 in."""
    values = fact(shipped("afit_simsat"), "depth of focus").values
    for distance_m in (values["near_m"], values["far_m"]):
        image_m = 1 / (1 / 0.035 - 1 / distance_m)
        chip_m = 1 / (1 / 0.035 - 1 / (33 * 0.0254))
        assert 0.035 / 8 * abs(image_m - chip_m) / image_m == pytest.approx(4e-6, rel=1e-6)
    assert values["near_m"] < 33 * 0.0254 < values["far_m"]
    assert fact(shipped("shefex2"), "depth of focus").values["far_m"] == math.inf


@pytest.mark.slow
def test_smear_is_the_rate_times_the_exposure() -> None:
    """Stars cross f w T pixels; under a dome the pupil on its lever moves too: by R / (R - M) more."""
    moving = fact(check(lab_of("shefex2", motion__rate_deg_s="[3, 4, 0]")), "smear").values
    focal_px = lab_of("shefex2").scene.camera.focal_px
    assert moving["largest_px"] == pytest.approx(focal_px * math.radians(5) * 0.04, rel=0.02)
    assert moving["rate_deg_s"] == pytest.approx(5)
    dome = lab_of("afit_simsat")
    values = fact(check(dome), "smear").values
    far = np.linalg.norm(dome.camera.sources.place[:, :3], axis=1).mean() / 0.838
    assert (
        values["largest_px"]
        < far * dome.scene.camera.focal_px * math.radians(values["rate_deg_s"]) * 0.01
    )


def test_the_cap_s_margin_is_the_angle_beyond_the_field() -> None:
    """On a sphere of R about the bearing: half field h at the pupil M above is h - asin(M sin h / R) at the bearing."""
    lab = lab_of(
        "afit_simsat",
        light__surface="{kind: sphere, apex: 48 in, radius: 48 in}",
        light__layout="{kind: fibonacci, count: 900, cap_deg: 27}",
        vehicle__camera="[0 in, 0 in, 15 in]",
        motion__maneuver=TILTED,
    )
    found = facts.cap_margin(plan_of(lab))
    assert found is not None
    half = math.atan(lab.scene.camera.width_px / 2 / lab.scene.camera.focal_px)
    at_bearing = half - math.asin(15 / 48 * math.sin(half))
    assert found.tilt_deg == pytest.approx(25, abs=1e-3)
    assert found.needed_deg == pytest.approx(25 + math.degrees(at_bearing), abs=1e-3)
    corner = math.atan(lab.scene.camera.corner_px / lab.scene.camera.focal_px)
    at_bearing = corner - math.asin(15 / 48 * math.sin(corner))
    assert found.corner_deg == pytest.approx(25 + math.degrees(at_bearing), abs=1e-3)


def test_the_cap_of_listed_leds_ends_at_the_farthest_of_them() -> None:
    """Three LEDs to 20 deg from the zenith in a cap of 50: the row says both; a warning has nothing to change."""
    lab = lab_of(
        "afit_simsat",
        light__surface="{kind: sphere, apex: 48 in, radius: 48 in}",
        light__layout="{kind: listed, directions_deg: [[0, 20], [90, 10], [200, 5]], cap_deg: 50}",
        motion__maneuver=TILTED,
    )
    planned = check(lab)
    values = fact(planned, "LED cap").values
    assert values["cap_deg"] == pytest.approx(20, abs=1e-6)
    assert values["limit_deg"] == 50
    assert values["margin_deg"] < -5
    assert (
        "LEDs to 20° from the zenith, shell and wires to cap_deg, 50°"
        in fact(planned, "LED cap").lines[0]
    )
    assert not any("LEDs end at" in one for one in planned.findings)


@pytest.mark.slow
def test_the_cap_s_margin_at_the_tilt_stop_is_stated_and_a_study_is_warned_of_it() -> None:
    """The maneuver tilts by 9.6 deg, the stop is at 30: 5 deg of tilt more need 5 deg of LEDs more on a sphere."""
    lab = lab_of(
        "afit_simsat",
        light__surface="{kind: sphere, apex: 48 in, radius: 48 in}",
        light__layout="{kind: fibonacci, count: 900, cap_deg: 30}",
        vehicle__camera="[0 in, 0 in, 15 in]",
    )
    planned = check(lab)
    cap = fact(planned, "LED cap")
    assert cap.values["stop_deg"] == 30
    beyond_deg = 30 - cap.values["tilt_deg"]
    assert cap.values["stop_margin_deg"] == pytest.approx(
        cap.values["margin_deg"] - beyond_deg, abs=1e-3
    )
    assert cap.lines[1].startswith("at the tilt stop, 30°, the field's edge reaches 33.")
    assert not [line for line in planned.findings if "cap_deg" in line]
    (warned,) = [line for line in check(lab, 30.0).findings if "cap_deg" in line]
    assert "at a tilt of 30.0 deg" in warned
    free = check(lab_of("afit_simsat", motion__control="none", motion__maneuver="[]"))
    assert all(
        "tilt stop" not in line
        for one in free.facts
        if one.name == "LED cap"
        for line in one.lines
    )


@pytest.mark.slow
def test_the_tracker_s_knowledge_is_stated() -> None:
    changes = {
        "tracker__survey": "{led_sigma: 0.3 mm, rotation_deg: [0.01, 0, 0]}",
        "tracker__assumed_focal_length": "35.07 mm",
        "tracker__assumed_distortion": "[0.1, 0, 0, 0, 0]",
        "tracker__assumed_camera_body": "[0 mm, 0 mm, 385 mm]",
    }
    lines = " ".join(
        fact(check(lab_of("afit_simsat_ideal", **changes)), "tracker knows").lines
    )
    for words in (
        "LEDs to 0.3 mm",
        "rotated by 36″",
        "length wrong by +0.2 %",
        "another distortion",
        "lever wrong by",
    ):
        assert words in lines
    knowledge = " ".join(fact(shipped("shefex2"), "tracker knows").lines)
    assert "of hipparcos_hp6.5, epoch J1991.25 moved to 2012-06-22" in knowledge


def test_error_causes_are_ranked_and_each_injected_one_is_found() -> None:
    """Beside half a millimeter of lever, 0.1 deg of the survey's axes is the first."""
    result = check(lab_of("afit_simsat", tracker__survey__rotation_deg="[0, 0, 0.1]"))
    values = fact(result, "expected error").values["frames"]
    roll = values["roll_causes_arcsec"]
    assert next(iter(roll)) == "survey rotation"
    assert roll["survey rotation"] == pytest.approx(360, rel=0.1)
    assert list(roll.values()) == sorted(roll.values(), reverse=True)
    assert values["roll_arcsec"] == pytest.approx(
        math.sqrt(math.fsum(value**2 for value in roll.values())), rel=1e-6
    )
    assert next(iter(values["cross_causes_arcsec"])) in ("lever survey", "survey rotation")


@pytest.mark.slow
def test_the_meaning_of_cross_and_sigma_is_stated() -> None:
    """Cross is of two axes; a survey's error is constant in one dome, unlike the noise of centroids."""
    over_surveys = (
        "of the survey: 1σ over surveys; one dome has one survey, whose error stays the same"
    )
    surveyed = shipped("afit_simsat")
    exact = shipped("afit_simsat_ideal")
    assert over_surveys in fact(surveyed, "expected error").lines
    assert over_surveys not in fact(exact, "expected error").lines
    assert [
        one
        for one in fact(exact, "expected error").lines
        if one.startswith("cross: sqrt(x² + y²)")
    ]


@pytest.mark.slow
def test_a_solver_s_own_error_is_listed_as_a_cause() -> None:
    """`infinity` ignores the lever: half a degree on this dome at every tilt (nearfield.py)."""
    values = fact(
        check(lab_of("afit_simsat_ideal", tracker__solver="infinity")), "expected error"
    ).values["frames"]
    assert next(iter(values["cross_causes_arcsec"])) == "solver"
    assert 0.02 < values["cross_arcsec"] / 3600 < 1


# Findings


@pytest.mark.slow
@pytest.mark.parametrize(
    ("scene", "changes", "key", "words"),
    [
        (
            "afit_simsat",
            {"light__led__intensity": "60 mcd"},
            "light.led.intensity",
            "of the lights are saturated",
        ),
        (
            "shefex2",
            {"exposure__time": "99 ms", "camera__detector__full_well_e": "300"},
            "exposure.time",
            "saturated",
        ),
        (
            "afit_simsat",
            {"light__layout__cap_deg": "25"},
            "light.layout.cap_deg",
            "its edge has no LED",
        ),
        (
            "afit_simsat",
            {"light__layout__cap_deg": "24"},
            "light.layout.cap_deg",
            "the tilt itself is not covered",
        ),
        (
            "afit_simsat",
            {"light__layout__spacing": "7 in"},
            "light.layout.spacing",
            "fewer than 4 lights",
        ),
        (
            "shefex2",
            {"tracker__limit_mag": "1.5"},
            "tracker.limit_mag",
            "fewer than 4 lights",
        ),
        (
            "afit_simsat",
            {"tracker__min_area_px": "900"},
            "tracker.min_area_px",
            "px above the threshold, it wants 900",
        ),
        (
            "shefex2",
            {"exposure__time": "1 ms"},
            "exposure.time",
            "the others are below the threshold",
        ),
        ("afit_simsat", {"camera__focus": "24 in"}, "camera.focus", "out of focus"),
        ("shefex2", {"camera__focus": "3 m"}, "camera.focus", "change it to infinity"),
        (
            "shefex2",
            {"motion__rate_deg_s": "[3, 4, 0]"},
            "exposure.time",
            "images move by up to 9 px",
        ),
        (
            "shefex2",
            {
                "camera__f_number": "0.8",
                "exposure__time": "100 ms",
                "motion__rate_deg_s": "[0, 0, 0]",
            },
            "light.catalog",
            "the sky ends at V 8.0",
        ),
        (
            "shefex2",
            {"camera__vignetting": TWO_STOPS},
            "camera.vignetting.cutoff_deg",
            "the lens is dark beyond 4 deg",
        ),
        (
            "shefex2",
            {"light__limit_mag": "4"},
            "light.limit_mag",
            "of the directions in reach",
        ),
        ("shefex2", {"light__limit_mag": "5.9"}, "light.limit_mag", "the sky ends at V 5.9"),
        (
            "shefex2",
            {"camera__preset": "imx174"},
            "tracker.limit_mag",
            "knows them to V 5.8 only, 8 % of them",
        ),
        (
            "shefex2",
            {"tracker__limit_mag": "8.5"},
            "tracker.limit_mag",
            "V 8.5, but tracker.catalog ends at V 6.7; change it to 6.5",
        ),
        (
            "shefex2",
            {
                "motion__jitter": "[{kind: line, frequency_hz: 500, rms_arcsec: [100, 100, 0]}]"
            },
            "exposure.time",
            "jitter moves images by",
        ),
        (
            "shefex2",
            {"camera__detector__prnu": "0.1"},
            "tracker.centroid_sigma_px",
            "1.3 times too small (NEES 5.3",
        ),
        (
            "shefex2",
            {"tracker__limit_mag": "3"},
            "tracker.limit_mag",
            "of the directions in reach",
        ),
        (
            "afit_simsat",
            {"tracker__brightest": "3"},
            "tracker.brightest",
            "the tracker uses 3 lights",
        ),
        (
            "shefex2",
            {"tracker__threshold_sigma": "500"},
            "tracker.threshold_sigma",
            "below the threshold of 500 sigma",
        ),
        (
            "shefex2",
            {"camera__f_number": "16"},
            "camera.f_number",
            "the others are below the threshold",
        ),
        (
            "afit_simsat",
            {"light__led__intensity": "1 ucd"},
            "light.led.intensity",
            "the others are below the threshold",
        ),
        (
            "shefex2",
            {"tracker__assumed_focal_length": "27 mm"},
            "tracker.assumed_focal_length",
            "matching radius",
        ),
        (
            "shefex2",
            {"tracker__assumed_distortion": "[1, 0, 0, 0, 0]"},
            "tracker.assumed_distortion",
            "matching radius",
        ),
        (
            "afit_simsat",
            {"vehicle__imu": "{}", "filter": "{}"},
            "filter.time_tag_sigma",
            "err by 1 ms (exposure.time_tag_jitter), in which the vehicle turns by 18″ at 5 deg/s; change it to 1 ms",
        ),
        (
            "afit_simsat",
            {
                "tracker__survey__instrument": STATION + ", zero_sigma: 20 mm}",
                "camera__focal_length": "20 mm",
            },
            "tracker.survey.instrument",
            "matching radius",
        ),
        (
            "afit_simsat",
            {"light__surface__error": "50 mm", "camera__focal_length": "20 mm"},
            "light.surface.error",
            "matching radius",
        ),
        (
            "afit_simsat",
            {"camera__preset": "lu205c", "tracker__assumed_row_time": "0 s"},
            "tracker.assumed_row_time",
            "corrects the rows",
        ),
        (
            "afit_simsat",
            {"light__surface": SPHERE, "light__layout": GEODESIC},
            "light.layout.kind",
            "refuses them as ambi",
        ),
    ],
)
def test_a_mistake_is_warned_of_with_its_key(
    scene: str, changes: dict[str, str], key: str, words: str
) -> None:
    """The warning names the remedy; the shipped plan gives no such warning."""
    tilted = {"motion__maneuver": TILTED} if key.endswith("cap_deg") else {}
    lines = [
        line
        for line in check(lab_of(scene, **tilted, **changes)).findings
        if line.startswith(f"{key}: ")
    ]
    assert [
        line
        for line in lines
        if words in line and re.search("; (change it to|leave it out|turn)", line)
    ]
    assert not [line for line in shipped(scene).findings if words in line]


@pytest.mark.slow
@pytest.mark.parametrize(
    ("changes", "key"),
    [
        ({"light.led.intensity": "60 mcd"}, "light.led.intensity"),
        ({"light.layout.spacing": "5 in"}, "light.layout.spacing"),
    ],
)
def test_following_the_advice_silences_the_warning(changes: dict[str, str], key: str) -> None:
    (line,) = [
        one
        for one in check(build_lab(loader.load("afit_simsat", changes))).findings
        if one.startswith(key)
    ]
    value = line.rpartition("change it to ")[2].partition(", or ")[0]
    again = check(build_lab(loader.load("afit_simsat", changes | {key: value}))).findings
    assert not [one for one in again if one.startswith(key)]


@pytest.mark.slow
@pytest.mark.parametrize(
    ("intensity", "keys"),
    [
        ("60 mcd", ["exposure.time", "camera.f_number"]),
        ("3 cd", ["exposure.time", "camera.transmission"]),
        ("60 cd", ["camera.transmission"]),
    ],
)
def test_saturation_can_be_cured_by_light_exposure_or_lens(
    intensity: str, keys: list[str]
) -> None:
    """Each cure alone ends the warning; LEDs 90 times too bright are not cured by f/76, nor 1,800 times by 3 us."""
    direct = {"light.led.drive": "{kind: direct}", "light.led.intensity": intensity}

    def warned(**changes: str) -> list[str]:
        found = check(build_lab(loader.load("afit_simsat", direct | changes))).findings
        return [one for one in found if "are saturated" in one]

    (line,) = warned()
    first, *cures = line.rpartition("change it to ")[2].split(", or ")
    settings = dict(cure.removesuffix(", a gray filter").split(" to ") for cure in cures)
    assert list(settings) == keys
    for key, value in {"light.led.intensity": first, **settings}.items():
        assert not warned(**{key: value})


def test_a_bright_background_is_the_only_warning_that_it_causes() -> None:
    """The lights are saturated, too, but no pixel is above a threshold."""
    (line,) = check(lab_of("shefex2", background="[{kind: uniform, e_s: 5.0e6}]")).findings
    assert line.startswith(
        "background: 200001 electrons in a pixel without a light, of 39956 at saturation; lower it"
    )


def test_smear_is_not_also_reported_as_faint_lights() -> None:
    (line,) = check(lab_of("shefex2", motion__rate_deg_s="[0, 60, 0]")).findings
    assert line.startswith("exposure.time: images move by up to 1")


@pytest.mark.slow
def test_using_the_brightest_hundred_of_many_lights_is_not_warned_of() -> None:
    """The tracker takes as many from a frame; the fact says so, and no warning blames the area or the exposure."""
    tape = "{kind: string, pitch: 4 mm, spacing: 14 mm, cap_deg: 32}"
    dense = lab_of(
        "afit_simsat_ideal",
        light__surface=SPHERE,
        light__layout=tape,
        light__led__disk_diameter="1 mm",
    )
    result = check(dense)
    assert (
        "; the tracker uses the 100 brightest)"
        in fact(result, "lights in the field").lines[0]
    )
    assert not [line for line in result.findings if "detects" in line]


@pytest.mark.slow
def test_only_an_led_s_image_size_includes_the_led_s_diameter() -> None:
    assert ", LED 2" in fact(shipped("afit_simsat"), "image size").lines[0]
    assert "LED" not in fact(shipped("shefex2"), "image size").lines[0]


@pytest.mark.slow
def test_the_rate_at_which_smear_equals_image_width_is_stated() -> None:
    result = shipped("shefex2")
    rate_deg_s = fact(result, "smear").values["width_rate_deg_s"]
    width_px = fact(result, "image size").values["width_px"]
    camera = loader.load("shefex2").camera
    assert math.radians(rate_deg_s) * 0.04 * camera.focal_px == pytest.approx(
        width_px, rel=0.02
    )
    assert "as long as the image is wide at" in fact(result, "smear").lines[0]


@pytest.mark.slow
@pytest.mark.parametrize(
    ("focal_length", "solved"), [("25.01 mm", 3), ("25.5 mm", 3), ("27 mm", 0)]
)
def test_a_wrong_focal_length_is_warned_of_where_the_tracker_refuses(
    focal_length: str, solved: int
) -> None:
    lab = lab_of("shefex2", tracker__assumed_focal_length=focal_length, exposure__frames="3")
    found = [shot.report.attitude.solved for shot in Flight(lab).shots()]
    assert found.count(True) == solved
    assert bool(check(lab).findings) == (solved == 0)


@pytest.mark.parametrize(
    "layout",
    [
        pytest.param(
            "{kind: poisson_disk, count: 1400, cap_deg: 42}", marks=pytest.mark.slow
        ),
        pytest.param("{kind: fibonacci, count: 1400, cap_deg: 42}", marks=pytest.mark.slow),
        pytest.param(GEODESIC, marks=pytest.mark.slow),
    ],
)
def test_similar_fields_are_those_that_the_tracker_refuses_as_ambiguous(layout: str) -> None:
    """On rendered frames at the attitudes in reach: none, some three of four, all."""
    changes = {
        "light__surface": SPHERE,
        "light__layout": layout,
        "camera__focus": "0.82 m",
        "camera__f_number": "11",
    }
    lab = lab_of("afit_simsat", **changes, motion__maneuver=TILTED)
    frames = attitudes.of_frames(lab)
    reach = attitudes.within_reach(frames).lab_from_body
    tracker = build_tracker(lab.camera)
    statuses = []
    for n, lab_from_body in enumerate(reach):
        frame, _ = render_at_rest(lab.in_run(n).camera, lab_from_body)
        statuses.append(solve_frame(tracker, frame).attitude.status)
    ambiguous = np.mean([status.startswith("ambiguous") for status in statuses])
    assert fact(check(lab), "fields alike").values["share"] == pytest.approx(
        ambiguous, abs=0.2
    )


@pytest.mark.slow
def test_fields_of_coded_leds_are_not_called_similar() -> None:
    """The same spiral with its codes and without."""
    any_attitude = {"motion__control": "null", "motion__maneuver": "[]"}
    settings = any_attitude | {
        "light__layout__count": "700",
        "tracker__survey__led_sigma": "1 mm",
    }
    without = check(
        lab_of("coded_spiral", **settings, light__led__code="null", tracker__decoder="null")
    )
    assert any("look like another one" in line for line in without.findings)
    assert not any(
        "look like another one" in line
        for line in check(lab_of("coded_spiral", **settings)).findings
    )


def test_half_of_the_stars_at_the_limit_are_detected() -> None:
    """The limit that `light.catalog` is compared with, on rendered frames: most brighter by half a magnitude are."""
    lab = lab_of("shefex2", exposure__frames="1", motion__rate_deg_s="[0, 0, 0]")
    limit = sky_warnings.detection_limit_mag(plan_of(lab))
    tracker = build_tracker(lab.camera)
    rng = np.random.default_rng(3)
    found = []
    faint = []
    for n in range(6):
        frame, truth = render_at_rest(lab.in_run(n).camera, Rotation.random(rng=rng))
        magnitude = dict(
            zip(
                lab.camera.sources.id.tolist(),
                lab.camera.sources.magnitude.tolist(),
                strict=True,
            )
        )
        near = (
            cKDTree(solve_frame(tracker, frame).centroids.xy_px).query(truth.sources.xy_px)[0]
            < 1.5
        )
        v_mag = np.array([magnitude[hip] for hip in truth.sources.id.tolist()])
        found += near[np.abs(v_mag - limit + 0.5) < 0.25].tolist()
        faint += near[np.abs(v_mag - limit - 0.5) < 0.25].tolist()
    assert np.mean(found) > 0.7
    assert np.mean(faint) < 0.3


def test_the_star_at_signal_to_noise_five_matches_the_truth_table() -> None:
    """V at which the rendered frames' stars pass 5, by their own color, against a star like the Sun: to 0.3 mag."""
    lab = lab_of("shefex2", exposure__frames="1")
    limit = fact(check(lab), "faintest star").values["snr_5_v_mag"]
    magnitude = dict(
        zip(
            lab.camera.sources.id.tolist(), lab.camera.sources.magnitude.tolist(), strict=True
        )
    )
    _, truth = Flight(lab).simulate_motion().render(0)
    v_mag = np.array([magnitude[hip] for hip in truth.sources.id.tolist()])
    near = np.abs(truth.sources.snr - 5) < 0.7
    assert near.sum() > 10
    assert np.median(v_mag[near]) == pytest.approx(limit, abs=0.3)


@pytest.mark.slow
def test_the_centroid_floor_proposed_by_the_check_makes_claims_correct() -> None:
    """Of a chip whose pixels differ by 10 %, NEES is 5.4 as expected and 5.7 (median of 40 frames) as measured."""
    floor_px = 0.02
    nees = [
        plan_of(
            lab_of(
                "shefex2",
                camera__detector__prnu="0.1",
                tracker__centroid_sigma_px=str(px),
            )
        ).claimed_nees
        for px in (0.007, floor_px)
    ]
    assert nees == [pytest.approx(5.4, abs=0.3), pytest.approx(3, abs=0.15)]


MOON = {
    "start_time": "2012-06-24T21:00:00",
    "motion__rate_deg_s": "[0, 0, 0]",
    "light__bodies": "{}",
}


def warned_of_bodies(ra_deg: float, dec_deg: float, **changes: str) -> list[str]:
    scene = lab_of(
        "shefex2", motion__start=f"{{ra_deg: {ra_deg}, dec_deg: {dec_deg}}}", **MOON | changes
    )
    drawn = check(scene, drawn=True).findings
    assert not [line for line in drawn if line.startswith("light.bodies")]
    return [line for line in check(scene).findings if line.startswith("light.bodies")]


@pytest.mark.slow
def test_bodies_in_the_field_and_near_it_are_warned_of() -> None:
    """The Moon at RA 154.9, Dec +4.8 of V -8.8; Mars of V 0.8 is 20 degrees from it."""
    (inside,) = warned_of_bodies(154.9, 2.0)
    assert re.match(
        r"light.bodies: Moon \(V -8.8, 1900″ wide\) is in the field, 2.8° from the boresight at",
        inside,
    )
    (near,) = warned_of_bodies(154.9, -15.0)
    assert re.match(
        r"light.bodies: Moon .* is 19.8° from the boresight .* background of kind stray", near
    )
    mars = next(line for line in warned_of_bodies(174.9, 2.0) if "Mars" in line)
    assert "is in the field" in mars
    assert warned_of_bodies(340.0, -5.0) == []
    assert warned_of_bodies(154.9, 2.0, light__bodies="{moon: false, sun: false}") == []


@pytest.mark.slow
@pytest.mark.parametrize(
    ("ra_deg", "dec_deg", "name"), [(174.9, 2.0, "Mars"), (154.9, 4.8, "Moon")]
)
def test_a_body_s_expected_pixel_value_matches_its_frame(
    ra_deg: float, dec_deg: float, name: str
) -> None:
    """Within a factor of 1.5 of the brightest pixel's electrons: its place in the pixel, and the phase's shape."""
    start = f"{{ra_deg: {ra_deg}, dec_deg: {dec_deg}}}"
    lab = lab_of("shefex2", motion__start=start, exposure__frames="1", **MOON)
    line = next(line for line in check(lab).findings if name in line)
    fill = float(re.search(r"([\d.]+) times saturation", line)[1])
    _, truth = simulate_motion(lab.scene).render(0)
    row = list(truth.sources.id).index(
        next(body.id for body in truth.bodies if body.name == name.lower())
    )
    full_e = detection.context_of(lab).full_e
    assert fill == pytest.approx(truth.sources.peak_e[row] / full_e, rel=0.5)


@pytest.mark.slow
@pytest.mark.parametrize(
    "name", ["afit_simsat", "nps_tas2", "shefex2", "scoreboard", "collimated_display"]
)
def test_a_shipped_plan_gives_no_warning(name: str) -> None:
    assert check(lab_of(name)).findings == []


@pytest.mark.long
def test_only_the_plans_with_saturated_and_too_few_leds_are_warned_of() -> None:
    """AFIT's tests of two and of five LEDs, as they were made, and of nine in a square, which looks alike turned."""
    warned = {
        name for name in loader.list_scenes() if check(build_lab(loader.load(name))).findings
    }
    assert {name.removesuffix("_ideal") for name in warned} == {
        "afit_test1",
        "afit_test2",
        "afit_test3",
    }


@pytest.mark.slow
def test_a_check_costs_a_fraction_of_a_second() -> None:
    """Of CPU, after its functions were loaded once: against the time to set up the same scene, ten times."""
    lab = lab_of("shefex2")
    check(lab)
    began = time.process_time()
    check(lab)
    checked = time.process_time()
    for _ in range(10):
        build_tracker(lab_of("shefex2").camera)
    assert checked - began < time.process_time() - checked


@pytest.mark.slow
def test_a_profile_that_is_too_fast_is_refused_before_the_run(tmp_path: Path) -> None:
    """180 deg about z in two seconds need 2.5 rad/s^2; the wheels give a hundredth of that."""
    t_s = np.linspace(0, 2, 41)
    yaw_deg = 90 * (1 - np.cos(np.pi * t_s / 2))
    file = tmp_path / "fast.csv"
    rows = [f"{t},0,0,{yaw}" for t, yaw in zip(t_s, yaw_deg, strict=True)]
    file.write_text("\n".join(["t_s,roll_deg,pitch_deg,yaw_deg", *rows]))
    changes = {
        "motion__start": "profile",
        "motion__maneuver": f"[{{kind: profile, file: {file}}}]",
    }
    with pytest.raises(
        InputError, match=r"motion\.maneuver\.0: profile: needs a torque of .* times what the"
    ):
        check(lab_of("simsat_slew", **changes))
    check(lab_of("simsat_slew", motion__control="prescribed", filter="null", **changes))


WEAK = {"vehicle__wheels__torque_limit": "0.05 N m"}


@pytest.mark.slow
@pytest.mark.parametrize(
    ("changes", "words", "lost"),
    [
        # A slew needs 0.2 N m.
        (WEAK, "wheel_z saturated from", True),
        # A hold: gravity on 90 kg whose center of mass is 1 mm aside, 0.9 N m, beyond 0.6 N m.
        (
            {
                "vehicle__center_of_mass": '["1 mm", "0 m", "-0.5 mm"]',
                "motion__maneuver": '[{kind: hold, duration: "1 s"}]',
            },
            "wheel_y saturated from 0.2 s",
            True,
        ),
        # Momentum runs out, although the torque would do.
        (
            {
                "vehicle__wheels__speed_limit_rpm": "400",
                "vehicle__wheels__start_rpm": "[0, 0, 0]",
            },
            "wheel_",
            False,
        ),
        ({}, "", False),
    ],
)
def test_what_the_actuators_cannot_give_is_forecast_and_reported(
    changes: dict[str, str], words: str, lost: bool
) -> None:
    """The forecast names the actuators that the flight then saturates; a shipped scene has no warning."""
    lab = lab_of("simsat_slew", **changes)
    found = [
        line for line in check(lab).findings if line.startswith("motion.maneuver: needs")
    ]
    log = Flight(lab).simulate_motion().telemetry()
    assert bool(found) == bool(words)
    assert words in "".join(found)
    flown = telemetry_report.findings(log)
    for name in re.findall(r"(wheel_\w) saturated", "".join(found)):
        assert f"{name} saturated from" in flown[0]
    off = [line for line in flown if "from its commanded attitude" in line]
    assert bool(off) == lost
    assert telemetry_report.saturated_s(log) > (1.0 if words else 0.0)


def test_a_torque_of_statics_is_that_of_gravity() -> None:
    """m g times the horizontal distance of the center of mass, against the inverse dynamics."""
    lab = lab_of("simsat_slew", vehicle__center_of_mass='["1 mm", "0 m", "0 m"]')
    at_rest = multibody.Simulation(lab.vehicle, Rotation.identity(), np.zeros(3), 1.0)
    still = np.zeros_like(at_rest.speeds_rad_s)
    torque_nm = at_rest.required_torque_nm(at_rest.angles_rad, still, np.zeros(3))
    weight_n = lab.vehicle.mass.mass_kg * lab.vehicle.gravity_m_s2
    assert torque_nm == pytest.approx([0, -1e-3 * weight_n, 0], rel=1e-6, abs=1e-4)


def test_check_and_run_refuse_a_tilt_in_the_same_words() -> None:
    """A rate goes on after its maneuver, to 32 deg; a run refused it only within the maneuver."""
    rate = '[{kind: rate, rate_deg_s: [5, 0, 0], duration: "1 s"}]'
    lab = lab_of("afit_simsat", motion__maneuver=rate)
    messages = []
    for simulate in (check, Flight):
        with pytest.raises(InputError, match=r"motion\.maneuver: tilt of 30\.2 deg") as found:
            simulate(lab)
        messages.append(str(found.value))
    assert messages[0] == messages[1]


@pytest.mark.slow
def test_forecasts_are_of_the_rate_that_they_state() -> None:
    """A faster scene has fewer lights and larger errors also in reach, and its claims are of that rate."""
    slow, fast = (
        check(lab_of("shefex2", motion__rate_deg_s=f"[0, {rate}, 0]")) for rate in (0.5, 12)
    )
    for name in ("expected error", "lights in the field", "claimed errors"):
        assert "at 12 deg/s" in fact(fast, name).lines[-1 if name == "claimed errors" else 1]
    errors = [
        fact(one, "expected error").values["reach"]["roll_arcsec"] for one in (slow, fast)
    ]
    assert errors[1] > 3 * errors[0]


@pytest.mark.slow
@pytest.mark.parametrize(
    ("detector", "level", "warned"), [("thesis", 42, 1), ("thesis", 40, 0), ("local", 42, 0)]
)
def test_a_black_level_above_the_thesis_s_threshold_is_warned_of(
    detector: str, level: int, warned: int
) -> None:
    """4 % of some 1017 DN are 40.7."""
    lab = lab_of(
        "afit_simsat", tracker__detector=detector, camera__detector__offset_dn=str(level)
    )
    lines = [one for one in check(lab).findings if "above the threshold of 4 %" in one]
    assert len(lines) == warned
    assert all(line.startswith("camera.detector.offset_dn: ") for line in lines)
