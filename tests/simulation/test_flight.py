"""One path through a flight: exposures are rendered once, in order; steps, torques and observations from outside."""

from __future__ import annotations

import itertools
import json
from collections.abc import Mapping
from typing import Any

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

import skysim
from estimator.core.types import RateEstimate
from skysim.core.errors import InputError
from skysim.core.types import Floats, Frame
from skysim.results.run import render
from skysim.scene import loader
from skysim.scene.scene import Scene
from skysim.simulation import flight as flight_module
from skysim.simulation.flight import Flight, Shot, open_flight, simulate_motion

AT_REST = {"motion.rate_deg_s": "[0, 0, 0]"}
BALANCED = {
    "vehicle.center_of_mass": "['0 m', '0 m', '0 m']",
    "vehicle.mount": "free",
    "motion.control": "none",
    "motion.maneuver": "[]",
}
SLEW = {
    "motion.maneuver": "[{kind: slew, yaw_deg: 20, rate_deg_s: 10, acceleration_deg_s2: 40}]",
    "exposure": "{time: 10 ms, rate_hz: 10, frames: 6, first: 0.1 s}",
}
PUSH_NM = np.array([0.05, -0.03, 0.3])


def scene_of(name: str, frames: int, **changes: Any) -> Scene:
    overrides = {key.replace("__", "."): value for key, value in changes.items()}
    return loader.load(name, overrides | {"exposure.frames": str(frames)})


def images(shots: list[Shot]) -> list[bytes]:
    return [shot.frame.image_dn.tobytes() for shot in shots]


@pytest.fixture
def rendered(monkeypatch: pytest.MonkeyPatch) -> list[int]:
    """Indices of the frames in the order in which a flight renders them."""
    indices: list[int] = []
    render_frame = flight_module.render_frame

    def watched(camera: Any, trajectory: Any, index: int, *rest: Any) -> Any:
        indices.append(index)
        return render_frame(camera, trajectory, index, *rest)

    monkeypatch.setattr(flight_module, "render_frame", watched)
    return indices


# --- exposures ----------------------------------------------------------------------------------------------

FILTERED = {"filter": "{start_deg: 0.5}", "vehicle__imu": "{}"}
HEADS = {"motion__maneuver": "[{kind: hold, duration: 1 s}]", "exposure__rate_hz": "10"}


@pytest.mark.slow
@pytest.mark.parametrize(
    ("name", "changes", "cameras", "has_filter"),
    [
        ("shefex2", {}, 1, False),
        ("shefex2", FILTERED, 1, True),
        ("simsat_slew", {}, 1, False),
        ("two_heads", HEADS, 2, True),
        ("two_heads", HEADS | {"filter": "null"}, 2, False),
    ],
)
def test_each_exposure_is_rendered_once(
    name: str, changes: Mapping[str, str], cameras: int, has_filter: bool, rendered: list[int]
) -> None:
    """If only the motion is requested, only frames for the filter are rendered."""
    scene = scene_of(name, 3, **changes)
    shots = list(open_flight(scene).shots())
    assert len(shots) == 3 * cameras
    assert sorted(rendered) == sorted(cameras * [0, 1, 2])
    rendered.clear()
    simulate_motion(scene)
    assert len(rendered) == (3 * cameras if has_filter else 0)


def test_a_run_renders_each_frame_once(rendered: list[int]) -> None:
    run = skysim.simulate(scene_of("shefex2", 3, **FILTERED))
    assert len(run) == 3
    assert rendered == [0, 1, 2]


def test_frames_due_after_the_motion_are_not_rendered_during_it(rendered: list[int]) -> None:
    """Of four frames 0.1 s apart two are due before the end; a loop over all exposures gets the others too."""
    late = FILTERED | {"filter": "{start_deg: 0.5, latency: 0.15 s}"}
    flight = simulate_motion(scene_of("shefex2", 4, **late))
    assert rendered == [0, 1]
    assert [shot.frame.index for shot in flight.shots()] == [2, 3]


@pytest.mark.slow
@pytest.mark.parametrize(
    "changes", [{}, FILTERED, {"tracker__exposure_control": "{mean_dn: 150}"}]
)
@pytest.mark.parametrize("solves", [False, True])
def test_a_shot_equals_the_frame_rendered_alone(
    changes: Mapping[str, str], solves: bool
) -> None:
    """Bit for bit: from a piece of the motion when due, from the whole motion, and from another flight."""
    scene = scene_of("shefex2", 3, **changes)
    flight = open_flight(scene)
    shots = list(flight.shots(solves=solves))
    assert [shot.frame.index for shot in shots] == [0, 1, 2]
    for shot in shots:
        for frame, truth in (
            flight.render(shot.frame.index),
            render(scene, shot.frame.index),
        ):
            np.testing.assert_array_equal(frame.image_dn, shot.frame.image_dn)
            assert (frame.t_mid_s, frame.exposure_s) == (
                shot.frame.t_mid_s,
                shot.frame.exposure_s,
            )
            assert (truth.cam_from_lab * shot.truth.cam_from_lab.inv()).magnitude() == 0
    assert all(
        (shot.report is not None) == (solves or scene.filter is not None) for shot in shots
    )


@pytest.mark.slow
@pytest.mark.parametrize("name", ["simsat_bump", "simsat_slew", "shefex2", "two_heads"])
def test_a_flight_without_history_has_the_same_shots(name: str) -> None:
    """The motion is equal bit for bit, with and without the filter in the loop."""
    scene = scene_of(name, 6)
    shots, forgetful = (
        list(open_flight(scene, keeps_history=keeps).shots()) for keeps in (True, False)
    )
    assert images(shots) == images(forgetful)
    for shot, other in zip(shots, forgetful, strict=True):
        assert (shot.camera.name, shot.frame.t_mid_s) == (
            other.camera.name,
            other.frame.t_mid_s,
        )
        assert (shot.truth.cam_from_lab * other.truth.cam_from_lab.inv()).magnitude() == 0
        for one in (shot, other):
            assert one.report.attitude.solved
        attitudes = [one.report.attitude.cam_from_ref.as_quat() for one in (shot, other)]
        np.testing.assert_array_equal(attitudes[0], attitudes[1])
        assert shot.update_status == other.update_status


@pytest.mark.slow
def test_a_flight_without_history_has_the_same_motion() -> None:
    """The motion does not depend on the kept history; older parts are dropped."""
    scene = scene_of("simsat_slew", 3)
    long = open_flight(scene)
    short = open_flight(scene, keeps_history=False)
    while not long.is_over:
        long.step()
        short.step()
    kept = short.motion.simulation
    all_of_it = long.motion.simulation
    # Twice what a frame needs: an exposure of a second, which a client may set, and two control periods.
    needed_s = 1.0 + 2 / scene.control_rate_hz + 0.05
    assert len(kept.states) * kept.step_s < 2 * needed_s + 0.01 < 0.75 * long.now_s
    for one, other in zip(
        kept.knots(kept.first_step), all_of_it.knots(kept.first_step), strict=True
    ):
        np.testing.assert_array_equal(one, other)


@pytest.mark.parametrize("filter_", ["null", "{start_deg: 0.5, latency: 0.05 s}"])
def test_shots_come_in_the_order_of_time_over_all_cameras(filter_: str) -> None:
    """Also those of one control period, and those that the latency of a filter defers beyond the end of the motion."""
    side = {"name": "side", "position": ["0.2 m", "0 m", "0 m"], "rotation_deg": [0, 90, 0]}
    side |= {"exposure": {"time": "6 ms", "rate_hz": 150.0}}
    changes = {
        "exposure": "{time: 4 ms, rate_hz: 120, first: 0.1 s}",
        "heads": json.dumps([side]),
        "filter": filter_,
        "motion.maneuver": "[{kind: hold, duration: 1 s}]",
        "camera.width_px": "64",
        "camera.height_px": "64",
    }
    scene = scene_of("two_heads", 20, **changes)
    shots = list(open_flight(scene).shots(solves=False))
    ends_s = [shot.truth.t_s + shot.frame.exposure_s / 2 for shot in shots]
    assert (np.diff(ends_s) > -1e-12).all()
    names = [shot.camera.name for shot in shots]
    assert names.count("main") == names.count("side") == 20
    turns = [one != other for one, other in itertools.pairwise(names)]
    assert sum(turns) > 15


def test_only_selected_frames_are_rendered_and_match_those_of_the_whole_run(
    rendered: list[int],
) -> None:
    scene = scene_of("shefex2", 6)
    every = images(list(open_flight(scene).shots(solves=False)))
    rendered.clear()
    asked: list[tuple[int, float]] = []

    def odd(index: int, close_s: float) -> bool:
        asked.append((index, close_s))
        return index % 2 == 1

    chosen = images(list(open_flight(scene).shots(solves=False, selects=odd)))
    assert chosen == every[1::2]
    assert rendered == [1, 3, 5]
    np.testing.assert_allclose(
        asked, [(n, 0.14 + 0.1 * n) for n in range(6)], rtol=0, atol=1e-12
    )


@pytest.mark.slow
def test_an_endless_flight_continues_the_scene_s_frames() -> None:
    scene = scene_of("shefex2", 2)
    more = scene_of("shefex2", 5)
    with open_flight(scene, endless=True, keeps_history=False) as flight:
        shots = flight.shots(solves=False)
        endless = [next(shots) for _ in range(5)]
    assert images(endless) == images(list(open_flight(more).shots(solves=False)))
    with pytest.raises(InputError, match=r"endless: .*; allowed: keeps_history=False"):
        open_flight(scene, endless=True)


def test_a_tracker_of_the_user_gets_each_frame_once_and_closes_the_loop() -> None:
    seen: list[np.ndarray] = []

    def mine(image: np.ndarray) -> None:
        seen.append(image)

    shots = list(open_flight(scene_of("shefex2", 3, **FILTERED), tracker=mine).shots())
    assert len(seen) == 3
    for image, shot in zip(seen, shots, strict=True):
        np.testing.assert_array_equal(image, shot.frame.image_dn)
        assert shot.update_status == "no attitude"


# --- steps --------------------------------------------------------------------------------------------------


def test_stepping_a_flight_inside_a_loop_over_its_shots_is_refused() -> None:
    flight = open_flight(scene_of("shefex2", 3))
    indices = []
    for shot in flight.shots(solves=False):
        indices.append(shot.frame.index)
        for move in (flight.step, flight.simulate_motion, lambda: next(flight.shots())):
            with pytest.raises(InputError, match="inside a loop over shots"):
                move()
    assert indices == [0, 1, 2]


def test_an_abandoned_loop_may_be_followed_by_steps_and_another_loop() -> None:
    scene = scene_of("shefex2", 4)
    flight = open_flight(scene)
    for shot in flight.shots(solves=False):
        assert shot.frame.index == 0
        break
    flight.step()
    rest = list(flight.shots(solves=False))
    assert [shot.frame.index for shot in rest] == [1, 2, 3]
    assert images(rest) == images(list(open_flight(scene).shots(solves=False)))[1:]


def test_steps_are_control_periods_and_end_with_the_motion() -> None:
    flight = open_flight(scene_of("simsat_slew", 1, exposure__first="0.1 s"))
    times_s = [flight.now_s]
    while not flight.is_over:
        assert flight.step() == []
        times_s.append(flight.now_s)
    np.testing.assert_allclose(np.diff(times_s[:-1]), 0.01, rtol=0, atol=1e-12)
    assert times_s[-1] == pytest.approx(flight.duration_s, abs=1e-3)
    with pytest.raises(
        InputError,
        match=r"step: the motion has ended at .* s; allowed: more frames, or endless",
    ):
        flight.step()


@pytest.mark.slow
def test_steps_are_the_same_flight_as_a_loop_over_shots() -> None:
    """And where there is a filter, each step returns the exposures that updated it."""
    scene = scene_of("shefex2", 3, **FILTERED)
    stepped = open_flight(scene)
    looped = open_flight(scene)
    updates = []
    while not stepped.is_over:
        updates += stepped.step()
    shots = list(looped.shots())
    assert images(updates) == images(shots)
    assert [shot.update_status for shot in updates] == ["used"] * 3
    one = stepped.telemetry()
    other = looped.telemetry()
    for name in ("t_s", "rate_body_rad_s", "sigma_attitude_rad", "assumed_bias_rad_s"):
        np.testing.assert_array_equal(getattr(one, name), getattr(other, name))


def test_a_torque_accelerates_the_vehicle_by_eulers_equation() -> None:
    """From rest about a principal axis: T t / J and T t^2 / 2 J. Then about all axes, by what momentum it gives."""
    scene = scene_of("afit_simsat", 2, **BALANCED)
    flight = open_flight(scene)
    inertia = flight.lab.vehicle.inertia_kg_m2
    for _ in range(100):
        flight.step([0.0, 0.0, 0.3])
    state = flight.state
    assert state.t_s == pytest.approx(1.0, abs=1e-9)
    np.testing.assert_allclose(
        state.rate_body_rad_s, [0, 0, 0.3 / inertia[2, 2]], rtol=0, atol=1e-9
    )
    np.testing.assert_allclose(
        state.lab_from_body.as_rotvec(), [0, 0, 0.15 / inertia[2, 2]], rtol=0, atol=1e-9
    )
    np.testing.assert_array_equal(
        flight.telemetry().torque_nm, np.tile([0.0, 0.0, 0.3], (100, 1))
    )
    momentum = open_flight(scene)
    given = np.zeros(3)
    for _ in range(100):
        # A torque is constant in body axes during a period, in which the vehicle turns by less than a thousandth.
        given += momentum.state.lab_from_body.apply(PUSH_NM) * 0.01
        momentum.step(PUSH_NM)
    state = momentum.state
    np.testing.assert_allclose(
        state.lab_from_body.apply(inertia @ state.rate_body_rad_s),
        given,
        rtol=2e-3,
        atol=1e-6,
    )


@pytest.mark.parametrize("actuators", ["ideal", "wheels"])
def test_a_torque_replaces_the_controller_s_on_the_actuators_of_the_scene(
    actuators: str,
) -> None:
    """It acts in the steps for which it is given; the wheels (0.010125 kg m2) take up the opposite momentum."""
    changes = BALANCED | {
        "vehicle.wheels": "{torque_limit: '0.6 N m'}",
        "motion.control": f"{{law: pid, actuators: {actuators}}}",
        "exposure.first": "4 s",
    }
    flight = open_flight(scene_of("afit_simsat", 1, **changes))
    for _ in range(50):
        flight.step([0.0, 0.0, 0.2])
    pushed = flight.state
    inertia = flight.lab.vehicle.inertia_kg_m2[2, 2]
    assert pushed.rate_body_rad_s[2] == pytest.approx(0.2 * 0.5 / inertia, rel=5e-3)
    wheel_nms = -0.2 * 0.5 if actuators == "wheels" else 0.0
    assert 0.010125 * (pushed.wheel_rad_s[2] + pushed.rate_body_rad_s[2]) == pytest.approx(
        wheel_nms, abs=2e-4
    )
    flight.simulate_motion()
    # The controller is back.
    assert abs(flight.state.rate_body_rad_s[2]) < 0.1 * pushed.rate_body_rad_s[2]


def test_a_torque_that_cannot_be_given_is_refused() -> None:
    flight = open_flight(scene_of("shefex2", 1))
    for torque, why in (
        ([1.0, 2.0], r"shape \(2,\); allowed: \(3,\)"),
        ([np.nan, 0.0, 0.0], "not finite"),
        ("much", "not an array of numbers"),
    ):
        with pytest.raises(InputError, match=rf"^step: torque_nm .*{why}"):
            flight.step(torque)  # type: ignore[arg-type]
    assert flight.now_s == 0
    prescribed = open_flight(scene_of("afit_simsat", 1, motion__control="prescribed"))
    with pytest.raises(
        InputError,
        match=r"step: a prescribed motion takes no torque; allowed: another motion\.contr",
    ):
        prescribed.step(np.zeros(3))
    prescribed.step()
    assert prescribed.now_s == pytest.approx(0.01)


# --- the motion so far --------------------------------------------------------------------------------------


def test_the_telemetry_of_a_flight_in_progress_has_the_ticks_so_far() -> None:
    scene = scene_of("simsat_bump", 2, exposure__first="0.2 s")
    flight = open_flight(scene)
    with pytest.raises(
        InputError, match=r"telemetry: the motion has not begun; allowed: after a step"
    ):
        flight.telemetry()
    for _ in range(17):
        flight.step()
    part = flight.telemetry()
    np.testing.assert_allclose(part.t_s, 0.01 * np.arange(17), rtol=0, atol=1e-12)
    whole = flight.simulate_motion().telemetry()
    assert len(whole.t_s) > 50
    for name in (
        "t_s",
        "rate_body_rad_s",
        "torque_nm",
        "momentum_nms",
        "sigma_attitude_rad",
        "bias_rad_s",
    ):
        np.testing.assert_array_equal(getattr(part, name), getattr(whole, name)[:17])
    for name in ("lab_from_body", "lab_from_ref", "lab_from_imu", "lab_from_filter"):
        np.testing.assert_array_equal(
            getattr(part, name).as_quat(), getattr(whole, name).as_quat()[:17]
        )


def test_the_state_is_the_trajectory_s_present_one() -> None:
    flight = open_flight(scene_of("simsat_slew", 1, exposure__first="0.5 s"))
    for _ in range(20):
        flight.step()
    state = flight.state
    motion = flight.trajectory()
    assert state.t_s == flight.now_s == motion.t_s[-1] == pytest.approx(0.2, abs=1e-12)
    assert (state.lab_from_body * motion.lab_from_body[-1].inv()).magnitude() < 1e-15
    np.testing.assert_array_equal(state.rate_body_rad_s, motion.rate_body_rad_s[-1])
    flight.step()
    assert state.t_s == pytest.approx(
        0.2, abs=1e-12
    )  # a state is not changed by what follows
    assert (flight.state.lab_from_body * state.lab_from_body.inv()).magnitude() > 0


def test_imu_samples_since_a_time_are_the_latest_ones() -> None:
    """Samples are final when the gyros deliver them: none is changed or lost later."""
    flight = open_flight(scene_of("simsat_bump", 1, exposure__first="0.6 s"))
    assert len(flight.imu_samples().t_s) == 0
    while flight.now_s < 0.5:
        flight.step()
    so_far = flight.imu_samples()
    flight.simulate_motion()
    samples = flight.imu_samples()
    late = flight.imu_samples(0.5)
    np.testing.assert_array_equal(so_far.angle_rad, samples.angle_rad[: len(so_far.t_s)])
    count = len(late.t_s)
    assert count < len(samples.t_s) / 2
    assert samples.t_s[-count - 1] < 0.5
    assert late.t_s[0] > 0.5 - 0.011  # whole control periods
    for name in ("t_s", "angle_rad", "velocity_m_s", "saturated"):
        np.testing.assert_array_equal(getattr(late, name), getattr(samples, name)[-count:])
    assert open_flight(scene_of("shefex2", 1)).imu_samples() is None


def test_a_flight_without_history_has_no_telemetry_and_no_frames_of_the_past() -> None:
    flight = open_flight(loader.load("afit_simsat", SLEW), keeps_history=False)
    with pytest.raises(
        InputError,
        match=r"telemetry: this flight keeps no history; allowed: keeps_history=True",
    ):
        flight.telemetry()
    while flight.now_s < 0.5:
        flight.step()
    with pytest.raises(
        InputError,
        match=r"shots: the flight has forgotten frame 0; allowed: keeps_history=True",
    ):
        next(flight.shots())


def test_a_frame_that_is_not_exposed_is_refused() -> None:
    flight = open_flight(scene_of("shefex2", 3))
    while flight.now_s < 0.25:
        flight.step()
    assert flight.render(1)[0].index == 1
    for index in (2, -1):
        with pytest.raises(
            InputError, match=rf"render: frame {index} is not exposed at 0\.25 s"
        ):
            flight.render(index)
    flight.simulate_motion()
    assert flight.render(2)[0].index == 2
    with pytest.raises(InputError, match="render: frame 3 is not exposed"):
        flight.render(3)
    controlled = simulate_motion(
        scene_of("shefex2", 3, tracker__exposure_control="{mean_dn: 150}")
    )
    with pytest.raises(InputError, match="render: frame 1 has no exposure time yet"):
        controlled.render(1)


# --- observations -------------------------------------------------------------------------------------------


def observed_at(flight: Flight, t_s: float) -> Shot:
    """An observation by the flight at this time."""
    while flight.now_s < t_s - 1e-9:
        flight.step()
    return flight.observe(solves=False)


@pytest.mark.slow
def test_an_observation_is_the_exposure_that_ends_now() -> None:
    """Without noise it is the scheduled one that ends at the same time, in a slew."""
    scene = loader.load(
        "afit_simsat",
        SLEW | {"camera.detector.noise": "false", "camera.shutter": "{kind: global}"},
    )
    flight = open_flight(scene)
    for index in (0, 3):
        shot = observed_at(flight, 0.11 + 0.1 * index)
        frame, truth = flight.render(index)
        assert (
            shot.truth.t_s
            == pytest.approx(truth.t_s, abs=1e-9)
            == pytest.approx(0.105 + 0.1 * index, abs=1e-9)
        )
        assert (shot.truth.cam_from_lab * truth.cam_from_lab.inv()).magnitude() < 1e-9
        np.testing.assert_array_equal(shot.truth.sources.id, truth.sources.id)
        np.testing.assert_allclose(
            shot.truth.sources.electrons, truth.sources.electrons, rtol=1e-6
        )
        np.testing.assert_allclose(
            shot.frame.image_dn, frame.image_dn, rtol=0, atol=1e-3 * frame.image_dn.max()
        )
    assert np.degrees(np.linalg.norm(flight.state.rate_body_rad_s)) > 2


def test_observations_have_the_noise_of_a_scheduled_frame_and_each_its_own() -> None:
    """The differences of any two frames of a camera at rest have the same variance, those of disjoint pairs no
    correlation.
    """
    scene = scene_of(
        "shefex2", 2, **{key.replace(".", "__"): value for key, value in AT_REST.items()}
    )
    flight = simulate_motion(scene)
    scheduled = [flight.render(index)[0] for index in (0, 1)]
    observed = [flight.observe(solves=False).frame for _ in range(4)]
    noise = [
        difference_dn(*scheduled),
        difference_dn(*observed[:2]),
        difference_dn(*observed[2:]),
    ]
    sigma = [one.std() for one in noise]
    np.testing.assert_allclose(sigma, sigma[0], rtol=5 / np.sqrt(2 * noise[0].size))
    limit = 5 / np.sqrt(noise[0].size)
    assert np.abs(np.corrcoef(noise)[np.triu_indices(3, 1)]).max() < limit
    # Frames that shared their noise would differ by less.
    assert difference_dn(scheduled[0], observed[0]).std() == pytest.approx(sigma[0], rel=0.02)


def difference_dn(one: Frame, other: Frame) -> Floats:
    """(N,) differences of two frames in the pixels that no star saturates."""
    inside = (one.image_dn < 0.2 * one.saturation_dn) & (
        other.image_dn < 0.2 * other.saturation_dn
    )
    return np.where(
        inside, one.image_dn.astype(float) - other.image_dn.astype(float), 0.0
    ).ravel()


def test_an_observation_at_the_start_extrapolates_with_the_initial_rate() -> None:
    flight = open_flight(scene_of("shefex2", 1))
    shot = flight.observe()
    start = flight.state
    assert shot.truth.t_s == pytest.approx(-0.020, abs=1e-12)
    turned = Rotation.from_rotvec(0.020 * start.rate_body_rad_s)
    assert (shot.truth.lab_from_body * turned * start.lab_from_body.inv()).magnitude() < 1e-12
    assert shot.report is not None
    assert shot.report.attitude.solved
    middle = shot.truth.sources.xy_px - [329, 246]
    streaks = shot.truth.sources.streak_px[np.hypot(*middle.T) < 120]
    np.testing.assert_allclose(streaks, np.radians(0.5) * 0.040 * 25e-3 / 9.9e-6, rtol=5e-3)


@pytest.mark.slow
def test_observations_do_not_change_the_flight() -> None:
    """In a loop over shots, with a filter: frames, updates and motion are those of a flight without them."""
    scene = scene_of("two_heads", 4, **HEADS)
    flight = open_flight(scene)
    alone = open_flight(scene)
    shots = []
    seen = []
    for shot in flight.shots():
        shots.append(shot)
        seen.append(flight.observe(camera=1 if shot.camera is flight.lab.camera else 0))
    expected = list(alone.shots())
    assert images(shots) == images(expected)
    assert (
        [shot.update_status for shot in shots]
        == [shot.update_status for shot in expected]
        == ["used"] * 8
    )
    assert {shot.update_status for shot in seen} == {""}
    assert [shot.camera.name for shot in seen] == ["side", "main"] * 4
    assert all(shot.report is not None and shot.report.attitude.solved for shot in seen)
    np.testing.assert_array_equal(
        flight.telemetry().sigma_attitude_rad, alone.telemetry().sigma_attitude_rad
    )


def test_an_observation_gets_the_gyro_s_rate_of_its_own_exposure() -> None:
    imu = "{gyro: {arw_deg_sqrt_h: 0, bias_deg_h: 0, turn_on_bias_deg_h: 0, scale_ppm: 0, quantum_arcsec: 0}}"
    flight = open_flight(
        scene_of(
            "shefex2", 1, vehicle__imu=imu, tracker__gyro="true", exposure__first="0.5 s"
        )
    )
    shot = observed_at(flight, 0.3)
    assert isinstance(shot.rate, RateEstimate)
    np.testing.assert_allclose(
        shot.rate.rate_rad_s, shot.truth.rate_cam_rad_s, rtol=0, atol=1e-6
    )


@pytest.mark.slow
def test_a_control_loop_of_twenty_lines_brings_the_vehicle_to_its_target() -> None:
    """Attitudes from observations ten times a second, rates between them, a torque in every period."""
    changes = BALANCED | {
        "vehicle.imu": "{gyro: {turn_on_bias_deg_h: 0}}",
        "exposure.first": "8 s",
    }
    scene = scene_of(
        "afit_simsat_ideal",
        1,
        **{key.replace(".", "__"): value for key, value in changes.items()},
    )
    target = Rotation.from_euler("ZYX", [8.0, -3.0, 4.0], degrees=True)
    flight = open_flight(scene)
    inertia = flight.lab.vehicle.inertia_kg_m2
    mount = flight.lab.camera.mount
    ticks = 0
    while not flight.is_over:
        samples = flight.imu_samples(flight.now_s - 0.005)
        rate = samples.angle_rad[-4:].mean(axis=0) / samples.step_s if ticks else np.zeros(3)
        if ticks % 10 == 0:
            attitude = flight.observe().report.attitude
            lab_from_body = attitude.cam_from_ref.inv() * mount.cam_from_body
        else:
            lab_from_body = lab_from_body * Rotation.from_rotvec(rate * 0.01)
        error = (lab_from_body.inv() * target).as_rotvec()
        flight.step(inertia @ (2.0 * error - 2.4 * rate))
        ticks += 1
    assert np.degrees((target.inv() * flight.state.lab_from_body).magnitude()) < 0.05
    assert np.degrees(np.linalg.norm(flight.state.rate_body_rad_s)) < 0.05


@pytest.mark.parametrize("rate_hz", [20, 50])
@pytest.mark.parametrize("offset", ["0 s", "-0.1 s", "33 ms"])
def test_telemetry_covers_every_frame(rate_hz: int, offset: str) -> None:
    """Telemetry is as slow as the controller; it has a row at or after each mid-exposure and time tag."""
    exposure = "time: 4 ms, rate_hz: 10, frames: 3, first: 0.105 s"
    scene = loader.load(
        "simsat_slew",
        {
            "exposure": f"{{{exposure}, time_tag_offset: {offset}}}",
            "motion.control.rate_hz": str(rate_hz),
        },
    )
    last_s = simulate_motion(scene).telemetry().t_s[-1]
    middle_s = 0.305 + 0.002
    assert last_s >= middle_s
    assert last_s >= middle_s + scene.exposure.time_tag_offset_s
