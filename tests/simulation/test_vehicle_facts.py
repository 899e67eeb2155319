"""Facts and warnings about the vehicle: names in its file, maneuvers and exposures, forecast of saturation, slews."""

import math
from pathlib import Path

import numpy as np
import pytest

from skysim.core.errors import InputError
from skysim.core.paths import SCENES
from skysim.core.types import Floats
from skysim.core.units import significant
from skysim.dynamics import guidance
from skysim.scene import loader
from skysim.scene.sections.motion import MotionConfig
from skysim.simulation import motion
from skysim.simulation.checks import facts, findings, plan_check, vehicle_facts
from skysim.simulation.lab import Lab, build_lab
from skysim.sources.dome.layouts.placing import largest_cap_deg

SLEW = "[{kind: hold, duration: 1 s}, {kind: slew, yaw_deg: 20, duration: 20 s}]"


def lab_of(name: str, **changes: str) -> Lab:
    return build_lab(
        loader.load(name, {key.replace("__", "."): value for key, value in changes.items()})
    )


def model(folder: Path, right: str, wrong: str) -> str:
    """A copy of simsat.xml with one thing changed."""
    text = (SCENES / "vehicles" / "simsat.xml").read_text(encoding="utf-8")
    assert right in text
    file = folder / "mine.xml"
    file.write_text(text.replace(right, wrong, 1), encoding="utf-8")
    return str(file)


def warned(lab: Lab) -> list[str]:
    """The warnings of vehicle_facts alone."""
    context = plan_check.context_of(lab)
    return [line for find in vehicle_facts.FINDINGS if (line := find(context))]  # type: ignore[arg-type]


def maneuver_of(lab: Lab) -> list[str]:
    found = vehicle_facts.maneuver(plan_check.context_of(lab))  # type: ignore[arg-type]
    assert found is not None
    return found.lines


@pytest.mark.parametrize("duration_s", [15.5, 30.0, 300.0])
def test_a_slew_of_a_duration_takes_it_and_keeps_to_the_acceleration(
    duration_s: float,
) -> None:
    """It ends at its angle, at the duration, and its greatest acceleration is the given one: 0.5 deg/s^2."""
    motion_config = MotionConfig.model_validate(
        {
            "control": {},
            "maneuver": [{"kind": "slew", "yaw_deg": 20, "duration": f"{duration_s} s"}],
        }
    )
    leg = guidance.plan(motion_config).legs[0]
    assert leg.duration_s == pytest.approx(duration_s, rel=1e-9)
    states = [leg.state_at(t) for t in np.linspace(0, duration_s, 20001)]
    assert 2 * math.degrees(math.asin(states[-1][0][3])) == pytest.approx(20, abs=1e-9)
    acceleration = max(abs(state[2][2]) for state in states)
    assert math.degrees(acceleration) == pytest.approx(0.5, rel=5e-3)


def test_a_slew_too_short_and_one_of_two_rates_are_refused() -> None:
    too_short = {"kind": "slew", "yaw_deg": 20, "duration": "10 s"}
    with pytest.raises(
        InputError, match=r"20 deg in 10 s needs an acceleration_deg_s2 of 1\.2"
    ):
        guidance.plan(MotionConfig.model_validate({"control": {}, "maneuver": [too_short]}))
    with pytest.raises(InputError, match="given beside rate_deg_s"):
        loader.load(
            "simsat_slew",
            {"motion.maneuver": "[{kind: slew, yaw_deg: 20, rate_deg_s: 1, duration: 60 s}]"},
        )


def test_a_maneuver_beyond_the_exposures_is_stated() -> None:
    """Frames to 5 s of a slew that ends at 21 s; with the number of frames that the row names it is seen."""
    changes = {"motion__maneuver": SLEW, "exposure__rate_hz": "2", "exposure__first": "0.5 s"}
    cut = maneuver_of(lab_of("simsat_slew", exposure__frames="10", **changes))
    assert cut[0].startswith("hold 0 to 1 s, slew 1 to 21 s; exposures from 0.5 to 5.0")
    assert cut[1].startswith("the exposures end at 5.0 s; the maneuver lasts 21.0 s")
    frames = cut[1].split("exposure.frames ")[1].split()[0]
    assert len(maneuver_of(lab_of("simsat_slew", exposure__frames=frames, **changes))) == 1


@pytest.mark.slow
def test_joints_that_nothing_drives_and_the_file_s_own_parts_are_named(
    tmp_path: Path,
) -> None:
    file = model(tmp_path, 'name="wheel_x" axis', 'name="Wheel_x" axis')
    wheels = {"vehicle__model": file, "vehicle__wheels": "{torque_limit: 1 N m}"}
    line = warned(lab_of("afit_simsat", **wheels))[-1]
    assert line.startswith("vehicle.model: joint Wheel_x: not the name of an actuator")
    assert line.endswith("change Wheel_x to wheel_x")
    more = '<sensor><gyro name="mine" site="imu"/></sensor></mujoco>'
    line = warned(lab_of("simsat_slew", vehicle__model=model(tmp_path, "</mujoco>", more)))[
        -1
    ]
    assert line.startswith("vehicle.model: sensor mine: not used")


@pytest.mark.parametrize(
    ("right", "wrong", "says"),
    [
        ("</mujoco>", '<option gravity="0 0 -1.62"/></mujoco>', "<option> gravity"),
        ("</mujoco>", '<option timestep="0.005"/></mujoco>', "<option> timestep"),
        ("</mujoco>", '<option integrator="implicit"/></mujoco>', "<option> integrator"),
        (
            "</mujoco>",
            '<option><flag gravity="disable"/></option></mujoco>',
            "<option> disableflags",
        ),
        ('name="wheel_x" axis', 'springref="3" name="wheel_x" axis', "springref"),
        (
            "</mujoco>",
            '<actuator><motor joint="wheel_x" ctrlrange="-1 1"/></actuator></mujoco>',
            "actuator of wheel_x",
        ),
    ],
)
def test_what_the_scene_sets_is_refused_in_the_file(
    tmp_path: Path, right: str, wrong: str, says: str
) -> None:
    with pytest.raises(InputError, match=says):
        lab_of("simsat_slew", vehicle__model=model(tmp_path, right, wrong))


def test_the_scene_s_own_values_pass(tmp_path: Path) -> None:
    own = '<option gravity="0 0 -9.8" timestep="0.001" integrator="RK4"/></mujoco>'
    lab_of("simsat_slew", vehicle__model=model(tmp_path, "</mujoco>", own))


def test_the_largest_cap_is_that_of_the_rim() -> None:
    """AFIT's rim is at 36.66 in on an ellipsoid of 38.88 in and 28.60 in below an apex of 48 in."""
    lab = lab_of("afit_simsat")
    surface = plan_check.context_of(lab).surface
    assert surface is not None
    across = 38.88 * math.sqrt(1 - ((36.66 - (48 - 28.60)) / 28.60) ** 2)
    rim_deg = math.degrees(math.atan2(across, 36.66))
    assert rim_deg - 0.1 <= largest_cap_deg(surface) <= rim_deg
    with pytest.raises(InputError, match=rf"cap_deg up to {largest_cap_deg(surface):.1f}"):
        lab_of("afit_simsat", light__layout__cap_deg="51")


def test_a_field_that_passes_the_rim_is_covered_by_no_cap() -> None:
    """The camera looks 15 deg to the side, so at the tilt stop of 30 deg its edge is at 50."""
    lab = lab_of(
        "afit_simsat",
        motion__control="none",
        motion__maneuver="[]",
        vehicle__camera_rotation_deg="[15, 0, 0]",
    )
    plan = plan_check.plan_of(lab, plan_check.attitudes.of_frames(lab))
    margin = facts.cap_margin(plan)
    assert margin is not None
    assert math.isinf(margin.needed_deg)
    assert "no cap covers it" in margin.text
    assert "no cap covers it (40.2 at most); tilt less" in findings.cap_too_small(plan)


def test_the_forecast_of_saturation_is_that_of_the_flight() -> None:
    """Wheels that start near their limit: the forecast's times are those of a run with the same controller."""
    lab = lab_of(
        "simsat_slew",
        vehicle__wheels__start_rpm="[0, 0, -2900]",
        vehicle__imu="null",
        filter="null",
        motion__control="{law: pid, actuators: wheels, feedback: truth}",
        motion__maneuver="[{kind: slew, yaw_deg: 20, rate_deg_s: 4}]",
        exposure__frames="4",
        exposure__rate_hz="1",
    )
    forecast = motion.shortfall(lab, motion.forecast_torque(lab))
    flown = motion.Motion(lab, {}, lab.duration_s)
    while flown.simulation.steps_left:
        flown.advance(flown.period_steps)
    log = flown.telemetry()
    said = motion.saturation_text(log.t_s, log.loads)
    assert "wheel_z saturated" in said
    assert said in forecast
    needed, given = (
        np.array([float(one) for one in part.split(")")[0].split(",")])
        for part in forecast.split("(")[1:3]
    )
    assert np.linalg.norm(given) < np.linalg.norm(needed)


@pytest.mark.parametrize(
    ("values", "shown"),
    [
        ([2.2e-12, 1.3e-11, -0.0042], [0, 0, -0.0042]),
        ([0, 0], [0, 0]),
        ([1.0, 0.051], [1.0, 0.051]),
    ],
)
def test_a_component_below_the_last_digit_of_the_largest_is_zero(
    values: list[float], shown: Floats
) -> None:
    np.testing.assert_array_equal(significant(values, 2), shown)
