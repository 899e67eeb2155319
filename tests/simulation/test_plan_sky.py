"""What `skysim check` says of stray light, exclusion angles, the air, reflections and drift with the temperature."""

from __future__ import annotations

import re

import numpy as np
import pytest

from skysim.scene import loader
from skysim.simulation.checks import attitudes
from skysim.simulation.checks.detection import Context, context_of
from skysim.simulation.checks.facts import Samples
from skysim.simulation.checks.plan import check, sampled
from skysim.simulation.checks.sky import depth, stray
from skysim.simulation.testbed import build_testbed

BAFFLE = "{angle_deg: [20, 50, 90, 120], pst: [1e-3, 1e-7, 1e-9, 1e-12]}"
ORBIT = "{kind: circular, altitude: 500 km, inclination_deg: 97, exclusion: {sun_deg: 40, earth_deg: 25}}"
SPACE = {
    "start_time": "2012-06-24T21:00:00",
    "motion.rate_deg_s": "[0, 0, 0]",
    "exposure.frames": "1",
    "background": "[]",
}
DOES_NOT_KNOW = {"tracker__orbit_velocity": "false"}


def plan_of(scene: str, **keys: str) -> tuple[Context, Samples]:
    overrides = {key.replace("__", "."): value for key, value in keys.items()}
    testbed = build_testbed(loader.load(scene, (SPACE if scene == "shefex2" else {}) | overrides))
    context = context_of(testbed)
    frames = sampled(attitudes.of_frames(testbed), context)
    return context, Samples(frames, frames)


def pointing(ra_deg: float, dec_deg: float) -> str:
    return f"{{ra_deg: {ra_deg}, dec_deg: {dec_deg}, roll_deg: 0}}"


@pytest.mark.slow
def test_stray_light_that_costs_stars_is_warned_of() -> None:
    """The loss is that of the limit with and without the baffle; the cure leaves half a magnitude."""
    keys = {"motion__start": pointing(90.0, -18.0), "light__bodies": "{}"}
    plain = depth.snr_limit_mag(*plan_of("shefex2", **keys))
    lit = plan_of("shefex2", **keys, camera__baffle=BAFFLE)
    (line,) = stray.stray_light(*lit)
    lost = re.match(
        r"camera.baffle.pst: stray light of ([\d.]+) electrons in a pixel, most of it of the Sun, .* the faintest"
        r" star is ([\d.]+) mag brighter; change it to ([\d.]+) times as much",
        line,
    )
    assert lost
    assert float(lost[1]) == pytest.approx(lit[0].camera.stray_e, rel=1e-2)
    assert float(lost[2]) == pytest.approx(plain - depth.snr_limit_mag(*lit), abs=0.15)
    better = f"{{angle_deg: [20, 50, 90, 120], pst: {[float(lost[3]) * one for one in (1e-3, 1e-7, 1e-9, 1e-12)]}}}"
    cured = plan_of("shefex2", **keys, camera__baffle=better)
    assert 0.4 < plain - depth.snr_limit_mag(*cured) < 0.55
    assert len(list(stray.stray_light(*plan_of("shefex2", **keys)))) == 0


@pytest.mark.slow
def test_bodies_within_the_exclusion_angles_are_warned_of() -> None:
    """23 degrees south of the summer's Sun; the camera is over the equator at RA 0, so RA 180 is nadir."""
    sun, *others = stray.exclusion(*plan_of("shefex2", motion__start=pointing(93.9, 0.0), orbit=ORBIT))
    assert re.match(r"orbit.exclusion.sun_deg: the Sun is 23.4° from the boresight at RA 93.9° .*, within 40°", sun)
    assert others == [line for line in others if "earth_deg" in line]
    (limb,) = stray.exclusion(*plan_of("shefex2", motion__start=pointing(180.0, -60.0), orbit=ORBIT))
    dip_deg = np.degrees(np.arccos(6378.137 / 6878.137))
    angle = re.match(r"orbit.exclusion.earth_deg: the Earth's limb is (-[\d.]+)° from the boresight", limb)
    assert angle
    assert float(angle[1]) == pytest.approx(dip_deg - 30, abs=0.15)  # the pole's radius is 21 km less
    assert list(stray.exclusion(*plan_of("shefex2", motion__start=pointing(0.0, -60.0), orbit=ORBIT))) == []


@pytest.mark.slow
def test_a_baffle_replaces_the_advice_to_add_one() -> None:
    keys = {"motion.start": pointing(93.9, -20.0), "light.bodies": "{planets: false}"}
    without = check(build_testbed(loader.load("shefex2", SPACE | keys))).findings
    assert any("Sun" in line and "add camera.baffle" in line for line in without)
    lit = check(build_testbed(loader.load("shefex2", SPACE | keys | {"camera.baffle": BAFFLE}))).findings
    assert not any("add camera.baffle" in line for line in lit)
    assert any(line.startswith("camera.baffle.pst") for line in lit)


@pytest.mark.slow
def test_the_tracker_of_a_plan_knows_the_orbit_s_velocity() -> None:
    """Else its stars are off by the orbit's aberration, up to 5.2"."""
    errors = [plan_of("shefex2", orbit=ORBIT, **keys)[0].beliefs.direction_error for keys in ({}, DOES_NOT_KNOW)]
    off_arcsec = [float(np.median(np.degrees(np.linalg.norm(one, axis=1)))) * 3600 for one in errors]
    assert off_arcsec[0] < 0.2
    assert 3 < off_arcsec[1] < 5.2
