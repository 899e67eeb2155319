"""A user's controller: the same motion by every interface, and an error text for every failure."""

from __future__ import annotations

import json
import os
import sys
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

import skysim
from skysim.core.errors import InputError
from skysim.core.types import Telemetry
from skysim.dynamics.controllers import (
    ControllerInput,
    ControllerSetup,
    check_torque,
    torque_of_reply,
)
from skysim.dynamics.guidance import plan
from skysim.experiments.study import study_file as study_loader
from skysim.experiments.study.execution import runner, store, trials
from skysim.experiments.study.execution.engines import Serial
from skysim.scene import loader
from skysim.simulation.checks import check
from skysim.simulation.flight import open_flight
from skysim.simulation.lab import UserParts, build_lab
from skysim.tracking import tracker_interface

PD = '''
import numpy as np


def pd(setup):
    """The law `pd`: poles placed, feed-forward by Euler's equation."""
    inertia, b, z = setup.inertia_kg_m2, setup.bandwidth_rad_s, setup.damping

    def law(now):
        body_from_ref = now.lab_from_body.inv() * now.lab_from_ref
        rate_error = now.rate_body_rad_s - body_from_ref.apply(now.rate_ref_rad_s)
        acceleration = body_from_ref.apply(now.acceleration_ref_rad_s2)
        acceleration += b**2 * body_from_ref.as_rotvec() - 2 * z * b * rate_error
        momentum = inertia @ now.rate_body_rad_s + now.momentum_nms
        return inertia @ acceleration + np.cross(now.rate_body_rad_s, momentum)

    return law


def weak(setup):
    raise ValueError(f"too weak: {setup.options['why']}")


def crashing(setup):
    def law(now):
        if now.tick == 3:
            raise RuntimeError("out of\\nfuel")
        return [0, 0, 0]

    return law
'''
PROGRAM = """
import json, sys
from mypd import pd
from skysim.dynamics.controllers import ControllerInput, ControllerSetup

law = pd(ControllerSetup.of_tree(json.loads(sys.stdin.readline())))
print(json.dumps({"ready": True}), flush=True)
for line in sys.stdin:
    now = ControllerInput.of_tree(json.loads(line))
    print(json.dumps({"tick": now.tick, "torque_nm": law(now).tolist()}), flush=True)
"""
SHORT = {
    "motion.control": {
        "law": "pd",
        "actuators": "wheels",
        "bandwidth_rad_s": 2.5,
        "damping": 0.7,
    },
    "motion.maneuver": [
        {
            "kind": "slew",
            "roll_deg": 10,
            "pitch_deg": -6,
            "yaw_deg": 15,
            "rate_deg_s": 4,
            "acceleration_deg_s2": 3,
        }
    ],
    "exposure": {"time": "10 ms", "rate_hz": 1, "frames": 1, "first": "1.5 s"},
}


@pytest.fixture
def installed(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """An installed package with entry points, as pip makes it."""
    (tmp_path / "mypd.py").write_text(PD)
    about = tmp_path / "mypd-1.0.dist-info"
    about.mkdir()
    (about / "METADATA").write_text("Metadata-Version: 2.1\nName: mypd\nVersion: 1.0\n")
    names = "".join(
        f"{name} = mypd:{name.replace('mine', 'pd')}\n"
        for name in ("mine", "weak", "crashing")
    )
    (about / "entry_points.txt").write_text(f"[skysim.controllers]\n{names}")
    monkeypatch.syspath_prepend(str(tmp_path))
    return tmp_path


def flown(changes: dict[str, Any] | None = None, **parts: Any) -> Telemetry:
    """The motion of `skysim.simulate` without its frame."""
    scene = skysim.load_scene("simsat_slew", SHORT | (changes or {}))
    with open_flight(scene, **parts) as flight:
        return flight.simulate_motion().telemetry()


def command(folder: Path, text: str) -> dict[str, str]:
    (folder / "program.py").write_text(text)
    return {"mine": f"{sys.executable} {folder / 'program.py'}"}


# --- the same motion by every route -------------------------------------------------------------------------


@pytest.mark.slow
def test_a_user_s_pd_law_flies_like_the_built_in_one(
    installed: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """On wheels that turn, with drag and disturbances: by a function, an entry point and a program, to 1e-12."""
    from mypd import pd  # type: ignore[import-not-found]

    monkeypatch.setenv("PYTHONPATH", os.pathsep.join([str(installed), *sys.path]))
    built_in = flown()
    law = {"motion.control": SHORT["motion.control"] | {"law": "mine"}}
    routes = {
        "function": flown(controller=pd),
        "entry point": flown(changes=law),
        "name": flown(controller="mine"),
    }
    (installed / "mypd-1.0.dist-info/entry_points.txt").write_text("")
    routes["program"] = flown(changes=law, programs=command(installed, PROGRAM))
    assert np.abs(built_in.torque_nm).max() > 0.2
    assert np.abs(built_in.momentum_nms).max() > 0.1
    for route, mine in routes.items():
        off = (built_in.lab_from_body.inv() * mine.lab_from_body).magnitude()
        assert off.max() < 1e-12, route
        np.testing.assert_allclose(
            mine.torque_nm, built_in.torque_nm, rtol=0, atol=1e-11, err_msg=route
        )
        np.testing.assert_allclose(
            mine.rate_body_rad_s, built_in.rate_body_rad_s, rtol=0, atol=1e-12, err_msg=route
        )
    np.testing.assert_array_equal(routes["entry point"].torque_nm, routes["name"].torque_nm)


def recorder(
    seen: list[ControllerInput], setups: list[ControllerSetup], torque: Any = (0.0, 0.0, 0.0)
) -> Callable:
    def factory(setup: ControllerSetup) -> Callable[[ControllerInput], Any]:
        setups.append(setup)

        def law(now: ControllerInput) -> Any:
            seen.append(now)
            return torque

        return law

    return factory


def test_a_controller_gets_the_documented_setup_and_input() -> None:
    """Set-up and inputs against the scene, its reference and the telemetry of the same run."""
    seen: list[ControllerInput] = []
    setups: list[ControllerSetup] = []
    scene = skysim.load_scene("simsat_slew", SHORT)
    telemetry = flown(controller=recorder(seen, setups, (0.0, 0.0, 5.0)))
    (setup,) = setups
    assert (setup.period_s, setup.actuators, setup.feedback, setup.seed) == (
        0.01,
        "wheels",
        "truth",
        scene.seed,
    )
    assert (setup.bandwidth_rad_s, setup.damping, setup.rate_limit_rad_s) == (2.5, 0.7, None)
    np.testing.assert_allclose(
        setup.inertia_kg_m2, build_lab(scene).vehicle.inertia_kg_m2, rtol=0, atol=0
    )
    assert [now.tick for now in seen] == list(range(len(telemetry.t_s)))
    np.testing.assert_allclose([now.t_s for now in seen], telemetry.t_s, rtol=0, atol=1e-12)
    measured = Rotation.from_quat([now.lab_from_body_xyzw for now in seen])
    assert (measured.inv() * telemetry.lab_from_body).magnitude().max() < 1e-15
    np.testing.assert_array_equal(
        [now.rate_body_rad_s for now in seen], telemetry.rate_body_rad_s
    )
    np.testing.assert_array_equal([now.momentum_nms for now in seen], telemetry.momentum_nms)
    reference = plan(scene.motion)
    for now in seen[::50]:
        attitude, rate, acceleration = reference.state_at(now.t_s)
        np.testing.assert_allclose(
            now.lab_from_ref.as_quat(scalar_first=True), attitude, rtol=0, atol=1e-15
        )
        np.testing.assert_array_equal(
            [now.rate_ref_rad_s, now.acceleration_ref_rad_s2], [rate, acceleration]
        )
    np.testing.assert_array_equal(seen[0].achieved_nm, np.zeros(3))
    # The wheels' limit, not the 5 N m asked for.
    assert seen[1].achieved_nm[2] == pytest.approx(0.6, rel=1e-9)


@pytest.mark.slow
@pytest.mark.parametrize("feedback", ["imu", "filter"])
def test_a_controller_s_input_is_the_scene_s_feedback(feedback: str) -> None:
    seen: list[ControllerInput] = []
    setups: list[ControllerSetup] = []
    changes = {
        "motion.control": {"feedback": feedback},
        "motion.maneuver": [],
        "exposure": {"time": "10 ms", "rate_hz": 2, "frames": 2, "first": "0.2 s"},
        "filter.latency": "0 s",
    }
    scene = skysim.load_scene("simsat_bump", changes)
    telemetry = skysim.simulate(scene, controller=recorder(seen, setups)).telemetry
    measured = Rotation.from_quat([now.lab_from_body_xyzw for now in seen])
    by = {"imu": telemetry.lab_from_imu, "filter": telemetry.lab_from_filter}
    np.testing.assert_allclose(
        (measured.inv() * by[feedback]).magnitude(), 0, rtol=0, atol=1e-12
    )
    other = by["imu" if feedback == "filter" else "filter"]
    assert (measured.inv() * other).magnitude().max() > 1e-9
    assert setups[0].rate_limit_rad_s == pytest.approx(np.radians(7.0))


def test_controller_setup_and_input_round_trip_through_json() -> None:
    setup = ControllerSetup(
        0.01, np.eye(3) * 1.1, 0.3, None, "ideal", "truth", 3.0, 0.8, 0.6, 5, {"a": 1.5}
    )
    again = ControllerSetup.of_tree(json.loads(json.dumps(setup.as_tree())))
    assert again.as_tree() == setup.as_tree()
    vectors = np.random.default_rng(1).normal(size=(7, 4))
    now = ControllerInput(3, 0.03, vectors[0], vectors[1, :3], vectors[2], *vectors[3:, :3])
    again = ControllerInput.of_tree(json.loads(json.dumps(now.as_tree())))
    for name in ControllerInput.__slots__:
        np.testing.assert_array_equal(getattr(again, name), getattr(now, name))


# --- what goes wrong ----------------------------------------------------------------------------------------


@pytest.mark.slow
@pytest.mark.parametrize(
    ("torque", "message"),
    [
        ([0, np.nan, 0], "torque_nm has a value that is not finite"),
        ([0, 0], r"torque_nm has shape \(2,\); allowed: \(3,\)"),
        ("much", "torque_nm is not an array of numbers"),
        (None, "torque_nm has shape|torque_nm is not"),
        (
            [0, 0, 601],
            "torque_nm is 601 N m; allowed: up to 1000 times the actuators' 0.6 N m",
        ),
    ],
)
def test_an_invalid_torque_ends_the_run_in_one_line(torque: Any, message: str) -> None:
    with pytest.raises(InputError, match=message) as raised:
        flown(controller=recorder([], [], torque))
    assert str(raised.value).startswith("motion.control.law: factory: ")
    assert str(raised.value).endswith(", at 0 s")
    assert "\n" not in str(raised.value)


def test_a_large_torque_is_limited_by_the_actuators() -> None:
    np.testing.assert_array_equal(check_torque([0, 0, 599], 0.6), [0, 0, 599])


@pytest.mark.slow
def test_a_function_that_fails_is_named_with_its_time(installed: Path) -> None:
    from mypd import crashing, weak

    with pytest.raises(
        InputError,
        match=r"^motion.control.law: crashing: RuntimeError: out of fuel, at 0.03 s$",
    ):
        flown(controller=crashing)
    with pytest.raises(InputError, match=r"^motion.control.law: weak: KeyError: 'why'$"):
        flown(controller=weak)
    with pytest.raises(
        InputError,
        match=r"^motion.control.law: lambda: TypeError: it returned int for the set-up; allo",
    ):
        flown(controller=lambda setup: 5)
    with pytest.raises(InputError, match=r"controller: int; allowed: a name, or"):
        flown(controller=5)


@pytest.mark.slow
def test_an_entry_point_that_fails_is_named_with_its_time(installed: Path) -> None:
    with pytest.raises(
        InputError,
        match=r"^motion.control.law: crashing: RuntimeError: out of fuel, at 0.03 s$",
    ):
        flown(controller="crashing")
    with pytest.raises(
        InputError, match=r"^motion.control.law: weak: ValueError: too weak: 3$"
    ):
        flown(
            controller="weak",
            changes={"motion.control": {"law": "weak", "options": {"why": 3}}},
        )


READY = (
    "import json, os, sys, time\n"
    "sys.stdin.readline(); print('{\"ready\": true}', flush=True)\n"
    "sys.stdin.readline()\n"
)


@pytest.mark.slow
@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("time.sleep(60)", "no answer within 0.5 s"),
        ("sys.exit('on fire')", r"the program ended \(code 1\): on fire"),
        ("os.abort()", r"the program ended \(SIGABRT\)"),
        ("print('torque')", "'torque' is not JSON"),
        ('print(\'{"tick": 1, "torque_nm": [0, 0, 0]}\')', "no answer to tick 0"),
        ('print(\'{"tick": 0, "torque_nm": [0, 0, NaN]}\')', "not finite"),
        ("print('{\"tick\": 0}')", "torque_nm"),
        (
            'print(\'{"tick": 0, "torque_nm": [0, 0, 0], "thrust": 1}\')',
            "unknown key 'thrust'; allowed: tick, torque_nm",
        ),
        ('print(\'{"tick": 0, "status": "no fuel"}\')', "no fuel"),
    ],
)
def test_a_program_that_fails_is_named_and_ended(
    text: str, message: str, tmp_path: Path
) -> None:
    note = f"open({str(tmp_path / 'pid')!r}, 'w').write(str(os.getpid()))\n"
    control = {"motion.control": {"law": "mine", "time_limit": "0.5 s"}}
    with pytest.raises(InputError, match=message) as raised:
        flown(
            changes=control,
            programs=command(
                tmp_path, READY.replace("sys.stdin", note + "sys.stdin", 1) + text
            ),
        )
    assert str(raised.value).startswith("motion.control.law: mine: ")
    assert "\n" not in str(raised.value)
    with pytest.raises(ProcessLookupError):
        os.kill(int((tmp_path / "pid").read_text()), 0)


@pytest.mark.slow
def test_a_program_ends_with_its_motion(tmp_path: Path) -> None:
    """Where the motion cannot begin it is not started: a tilt beyond the stop is found before."""
    text = (
        f"import os\nopen({str(tmp_path / 'pid')!r}, 'w').write(str(os.getpid()))\n"
        + READY.rpartition("sys.stdin")[0]
    )
    text += "for line in sys.stdin:\n    n = json.loads(line)['tick']\n"
    programs = command(
        tmp_path,
        text + "    print(json.dumps({'tick': n, 'torque_nm': [0, 0, 0]}), flush=True)\n",
    )

    def scene(maneuver: list[dict[str, Any]]) -> skysim.Scene:
        changes = {"motion.control": {"law": "mine"}, "motion.maneuver": maneuver}
        return skysim.load_scene("simsat_slew", SHORT | changes)

    pid = tmp_path / "pid"
    with pytest.raises(InputError, match="tilt of 50 deg"):
        open_flight(
            scene([{"kind": "step", "roll_deg": 50, "duration": "1 s"}]), programs=programs
        )
    assert not pid.exists()
    with open_flight(scene([]), programs=programs) as flight:
        flight.simulate_motion()
    with pytest.raises(ProcessLookupError):
        os.kill(int(pid.read_text()), 0)


def test_a_check_does_not_start_a_program(tmp_path: Path) -> None:
    """Otherwise `skysim run`, which checks its plan first, would start it twice."""
    started = tmp_path / "started"
    programs = command(tmp_path, f"open({str(started)!r}, 'w')\n{READY}")
    lab = build_lab(
        skysim.load_scene("simsat_slew", SHORT | {"motion.control": {"law": "mine"}}),
        UserParts(programs),
    )
    check(lab)
    assert not started.exists()


def test_an_unknown_law_is_refused_before_the_motion() -> None:
    with pytest.raises(
        InputError,
        match=r"motion.control.law: unknown law 'lqr'; allowed: pid, pd, prescribed, or a program",
    ):
        build_lab(loader.load("simsat_slew", {"motion.control": "lqr"}))


@pytest.mark.parametrize("name", ["pid", "pd", "prescribed", "mine"])
def test_a_program_with_an_existing_name_is_refused(name: str, installed: Path) -> None:
    with pytest.raises(InputError, match=f"programs.{name}: name already in use"):
        tracker_interface.program_commands([f"{name}=x"])


@pytest.mark.parametrize(
    "reply",
    [5, None, [], {"tick": 7}, {"torque_nm": [0, 0, 0]}, {"tick": 0, "torque_nm": {}}],
)
def test_a_reply_of_another_form_is_refused_in_one_line(reply: object) -> None:
    with pytest.raises(ValueError, match=r"tick 0|torque_nm") as raised:
        torque_of_reply(reply, 0, 1.0)
    assert "\n" not in str(raised.value)


# --- studies ------------------------------------------------------------------------------------------------

STUDY = """
schema: 1
title: Which law?
scene: simsat_slew
seed: 1
set: {exposure.frames: 1, motion.control: {law: pd}}
trial: {kind: flight}
factors: {law: {key: motion.control.law, values: [pd, mine]}}
responses: [identified]
"""


@pytest.mark.slow
def test_a_controller_can_be_a_study_s_factor(installed: Path, tmp_path: Path) -> None:
    path = tmp_path / "which.yaml"
    path.write_text(STUDY.replace("mine", "other"))
    with pytest.raises(
        InputError,
        match=r"factors\.law: 'other': motion\.control\.law: unknown law 'other'; allowed:",
    ):
        study_loader.load(path, programs={})
    path.write_text(STUDY)
    plan_ = study_loader.load(path, programs={})
    with store.writing(tmp_path / "trials.sqlite") as kept:
        runner.prepare_store(plan_, kept, resume=False, overrides={})
        runner.run(plan_, kept, Serial())
        rows = [kept.trial(n) for n in range(2)]
    assert [row["status"] for row in rows] == ["solved", "solved"]
    assert rows[0]["x_arcsec"] == pytest.approx(rows[1]["x_arcsec"], abs=1e-6)


def test_another_release_of_a_controller_changes_the_trial_s_hash(installed: Path) -> None:
    scene = loader.load("simsat_slew", {"motion.control": "mine"})
    before = trials.scene_hash(scene)
    (installed / "mypd-1.0.dist-info/METADATA").write_text(
        "Metadata-Version: 2.1\nName: mypd\nVersion: 1.1\n"
    )
    assert trials.scene_hash(scene) != before
