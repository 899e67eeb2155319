"""`skysim check` on stray light, exclusion angles, air, reflections and thermal drift."""

from __future__ import annotations

import re

import numpy as np
import pytest

from skysim.core.constants import ARCSEC_RAD
from skysim.core.types import Floats
from skysim.scene import loader
from skysim.simulation.checks import attitudes, findings, plan_check, sky_warnings
from skysim.simulation.checks.detection import context_of
from skysim.simulation.checks.expected_error import as_built, believed_px2, gains
from skysim.simulation.checks.plan_check import check
from skysim.simulation.checks.sampling import Plan, sampled
from skysim.simulation.flight import Flight
from skysim.simulation.lab import build_lab, build_tracker
from skysim.sources.satellites import MIRRORED
from skysim.tracking.factory import solve_frame

BAFFLE = "{angle_deg: [20, 50, 90, 120], pst: [1e-3, 1e-7, 1e-9, 1e-12]}"
ORBIT = "{kind: circular, altitude: 500 km, inclination_deg: 97, exclusion: {sun_deg: 40, earth_deg: 25}}"
SPACE = {
    "start_time": "2012-06-24T21:00:00",
    "motion.rate_deg_s": "[0, 0, 0]",
    "exposure.frames": "1",
    "background": "[]",
}
NIGHT = {
    "light__air": "{}",
    "site": "{latitude_deg: 53, longitude_deg: 9}",
    "start_time": "2012-06-24T23:00:00",
}
SHINY = {
    "light__surface": "{kind: sphere, apex: 5 ft, radius: 4 ft, rim_deg: 130}",
    "light__reflection": "{specular: 0.5}",
    "exposure__frames": "1",
}
DOES_NOT_KNOW = {"tracker__orbit_velocity": "false"}


def plan_of(scene: str, **keys: str) -> Plan:
    overrides = {key.replace("__", "."): value for key, value in keys.items()}
    lab = build_lab(loader.load(scene, (SPACE if scene == "shefex2" else {}) | overrides))
    context = context_of(lab)
    frames = sampled(attitudes.of_frames(lab), context)
    return Plan(**vars(context), frames=frames, reach=frames)


def pointing(ra_deg: float, dec_deg: float) -> str:
    return f"{{ra_deg: {ra_deg}, dec_deg: {dec_deg}, roll_deg: 0}}"


@pytest.mark.slow
def test_stray_light_that_costs_stars_is_warned_of() -> None:
    """The loss is that of the limit with and without the baffle; the cure leaves half a magnitude."""
    keys = {"motion__start": pointing(90.0, -18.0), "light__bodies": "{}"}
    plain = sky_warnings.snr_limit_mag(plan_of("shefex2", **keys))
    lit = plan_of("shefex2", **keys, camera__baffle=BAFFLE)
    (line,) = sky_warnings.stray_light(lit)
    lost = re.match(
        r"camera.baffle.pst: stray light of ([\d.]+) electrons in a pixel, most of it of the Sun, .* the faintest"
        r" star is ([\d.]+) mag brighter; change it to ([\d.]+) times as much",
        line,
    )
    assert lost
    assert float(lost[1]) == pytest.approx(lit.camera.glow_e["stray light"], rel=1e-2)
    assert float(lost[2]) == pytest.approx(plain - sky_warnings.snr_limit_mag(lit), abs=0.15)
    better = f"{{angle_deg: [20, 50, 90, 120], pst: {[float(lost[3]) * one for one in (1e-3, 1e-7, 1e-9, 1e-12)]}}}"
    cured = plan_of("shefex2", **keys, camera__baffle=better)
    assert 0.4 < plain - sky_warnings.snr_limit_mag(cured) < 0.55
    assert len(list(sky_warnings.stray_light(plan_of("shefex2", **keys)))) == 0


@pytest.mark.slow
def test_bodies_within_the_exclusion_angles_are_warned_of() -> None:
    """23 degrees south of the summer's Sun; the camera is over the equator at RA 0, so RA 180 is nadir."""
    sun, *others = sky_warnings.exclusion(
        plan_of("shefex2", motion__start=pointing(93.9, 0.0), orbit=ORBIT)
    )
    assert re.match(
        r"orbit.exclusion.sun_deg: the Sun is 23.4° from the boresight at RA 93.9° .*, within 40°",
        sun,
    )
    assert others == [line for line in others if "earth_deg" in line]
    (limb,) = sky_warnings.exclusion(
        plan_of("shefex2", motion__start=pointing(180.0, -60.0), orbit=ORBIT)
    )
    dip_deg = np.degrees(np.arccos(6378.137 / 6878.137))
    angle = re.match(
        r"orbit.exclusion.earth_deg: the Earth's limb is (-[\d.]+)° from the boresight", limb
    )
    assert angle
    # The pole's radius is 21 km less.
    assert float(angle[1]) == pytest.approx(dip_deg - 30, abs=0.15)
    assert (
        list(
            sky_warnings.exclusion(
                plan_of("shefex2", motion__start=pointing(0.0, -60.0), orbit=ORBIT)
            )
        )
        == []
    )


@pytest.mark.slow
def test_a_baffle_replaces_the_advice_to_add_one() -> None:
    keys = {"motion.start": pointing(93.9, -20.0), "light.bodies": "{planets: false}"}
    without = check(build_lab(loader.load("shefex2", SPACE | keys))).findings
    assert any("Sun" in line and "add camera.baffle" in line for line in without)
    lit = check(
        build_lab(loader.load("shefex2", SPACE | keys | {"camera.baffle": BAFFLE}))
    ).findings
    assert not any("add camera.baffle" in line for line in lit)
    assert any(line.startswith("camera.baffle.pst") for line in lit)


@pytest.mark.slow
def test_the_tracker_of_a_plan_has_the_orbit_s_velocity() -> None:
    """Else its stars are off by the orbit's aberration, up to 5.2"."""
    errors = [
        plan_of("shefex2", orbit=ORBIT, **keys).beliefs.direction_error
        for keys in ({}, DOES_NOT_KNOW)
    ]
    off_arcsec = [
        float(np.median(np.degrees(np.linalg.norm(one, axis=1)))) * 3600 for one in errors
    ]
    assert off_arcsec[0] < 0.2
    assert 3 < off_arcsec[1] < 5.2


@pytest.mark.slow
def test_refraction_that_the_tracker_does_not_know_is_warned_of() -> None:
    """A tan h + B tan^3 h with the textbooks' 58.3" less 2 % for red light, some 25 degrees high; none if it knows."""
    low_in_the_south = {"motion__start": pointing(222.0, -10.0)}
    plan = plan_of("shefex2", **low_in_the_south, **NIGHT)
    found = re.match(
        r"tracker.refraction: the air raises stars by ([\d.]+)″ at RA 222.0° .*, ([\d.]+)° above the horizon, and"
        r" shortens the field by ([\d.]+)″, .*; change it to true",
        sky_warnings.refraction(plan),
    )
    assert found
    raised, altitude_deg, shortened = map(float, found.groups())
    assert 15 < altitude_deg < 30
    half_deg = np.degrees(plan.camera.optics.field_rad)
    middle, low, high = bent_arcsec(np.array([0.0, -half_deg, half_deg]) + altitude_deg)
    assert raised == pytest.approx(middle, rel=0.02)
    assert shortened == pytest.approx(low - high, rel=0.05)
    assert not sky_warnings.refraction(
        plan_of("shefex2", **low_in_the_south, **NIGHT, tracker__refraction="true")
    )
    assert not sky_warnings.refraction(plan_of("shefex2", **low_in_the_south))


def bent_arcsec(altitude_deg: Floats) -> Floats:
    tangent = 1 / np.tan(np.radians(altitude_deg))
    return np.asarray(57.3 * tangent - 0.067 * tangent**3)


@pytest.mark.slow
def test_detectable_reflections_in_the_wall_are_warned_of() -> None:
    """As many as the tracker detects in a frame near a mirrored LED of its truth; none in a wall as dull as advised."""
    plan = plan_of("apl_dome", **SHINY)
    line = plan_check.mirror_images(plan)
    found = re.match(
        r"light.reflection.specular: the tracker detects up to (\d+) images .* change it to ([\d.]+)$",
        line,
    )
    assert found
    frame, truth = Flight(plan.lab).simulate_motion().render(0)
    seen = solve_frame(build_tracker(plan.lab.camera), frame).centroids.xy_px
    mirrored = truth.sources.xy_px[truth.sources.id >= MIRRORED]
    near = (np.linalg.norm(mirrored[:, None] - seen, axis=2).min(axis=1) < 2).sum()
    assert near > 0
    assert abs(int(found[1]) - near) <= max(1, 0.2 * near)
    dull = SHINY | {"light__reflection": f"{{specular: {found[2]}}}"}
    assert not plan_check.mirror_images(plan_of("apl_dome", **dull))


@pytest.mark.slow
@pytest.mark.parametrize("mount", [(20.0, -15.0, 5.0), (0.0, 0.0, 0.0)])
def test_drift_is_a_rotation_of_the_mount_and_a_shift_of_the_dome(
    mount: tuple[float, ...],
) -> None:
    """25 K times the mount's coefficients, and a dome that creeps across by 1 mm, by first order about the bearing.

    A camera d from the dome, which is L from the bearing, sees a small turn w about the bearing as L w / d. So its own
    rotation r is solved as r d / L, and the creep as 1 mm / L. The roll is the mount's.
    """
    keys = {
        "temperature": "{kind: steady, temperature_c: 45}",
        "dome_ppm_k": "0.001",
        "lens_ppm_k": "0",
        "speed": "1",
    }
    keys |= {
        "mount_arcsec_k": str(list(mount)),
        "creep": f"[{0 if any(mount) else 1} mm, 0 mm, 0 mm]",
    }
    plan = plan_of(
        "thermal_drift", **{f"thermal__{key}": value for key, value in keys.items()}
    )
    view = plan.frames.used[0]
    distance_m, arm_m = (
        np.median(np.linalg.norm(one, axis=1))
        for one in (view.offset_m, plan.beliefs.lights.xyz[view.row])
    )
    moved_px = as_built(view, plan)
    assert moved_px is not None
    floor_px = plan.settings.centroid_sigma_px
    believed = believed_px2(view, plan, floor_px)
    turn_rad = np.einsum("nij,njk->i", gains(view, believed), moved_px)
    turn = turn_rad / ARCSEC_RAD
    if any(mount):
        np.testing.assert_allclose(
            turn[:2], 25 * np.array(mount[:2]) * distance_m / arm_m, rtol=0.01
        )
        assert turn[2] == pytest.approx(25 * mount[2], rel=0.01)
        line = findings.thermal_drift(plan)
        assert re.match(
            rf"thermal.reference_c: .* by {np.hypot(*turn[:2]):.0f}″ \(cross\) at 45.0 °C, t = ",
            line,
        )
    else:
        assert np.hypot(*turn[:2]) == pytest.approx(1e-3 / arm_m / ARCSEC_RAD, rel=0.01)


@pytest.mark.slow
def test_the_scene_that_drifts_stays_within_its_survey() -> None:
    assert findings.thermal_drift(plan_of("thermal_drift")) == ""
