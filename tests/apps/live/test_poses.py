"""A client simulates the motion: its frames are those of a flight, its solutions are right, wrong poses are refused."""

import json
from collections.abc import Iterator
from typing import Any

import numpy as np
import pytest
from scipy.spatial.transform import Rotation
from typer.testing import CliRunner

from skysim.apps.cli import main
from skysim.apps.live.commands import CommandState
from skysim.apps.live.pacing import MOST_SAMPLES, PLACE, Pace, PosedLive
from skysim.apps.live.packets import Packet
from skysim.apps.live.wire import MOST_LINE_BYTES
from skysim.core.types import Trajectory
from skysim.scene import loader
from skysim.simulation.flight import Flight, open_flight, simulate_motion
from skysim.simulation.lab import exposure_window

ORBIT = {
    "exposure.frames": "2",
    "light.bodies": "{}",
    "orbit": "{kind: circular, altitude: 500 km, inclination_deg: 90, raan_deg: 83, argument_deg: 0, earth: {}}",
}
ARCSEC_RAD = np.radians(1 / 3600)


class Receiver:
    """An output that keeps what it is offered."""

    name = "tcp"
    fault = ""
    channels = ("frame", "solution")

    def __init__(self) -> None:
        self.packets: list[Packet] = []

    def offer(self, packet: Packet, patient: bool) -> None:
        self.packets.append(packet)

    def close(self) -> None: ...

    def counters(self) -> dict[str, Any]:
        return {}


def posed(more: dict[str, str] = ORBIT) -> PosedLive:
    flight = open_flight(loader.load("shefex2", more), keeps_history=False)
    return PosedLive(
        flight,
        Pace(0.0, 10.0),
        [Receiver()],
        CommandState(flight, 0.5, False),
        has_truth=True,
        may_solve=True,
    )


def packets_of(live: PosedLive) -> list[Packet]:
    (output,) = live.outputs
    assert isinstance(output, Receiver)
    return output.packets


def answer_to(live: PosedLive, *commands: dict[str, Any]) -> list[str]:
    """Errors that answer commands, as the flight's loop gives them; they pass as JSON."""
    answers = list[str]()
    for command in commands:
        live.inbox.put(json.loads(json.dumps(command)), answers.append)
    # The loop ends with the commands: its output fails after them.
    (output,) = live.outputs
    live.inbox.put({"end": 0}, lambda _: setattr(output, "fault", "end"))
    live.run()
    output.fault = ""
    return answers


def pose_of(trajectory: Trajectory, places: Any, open_s: float, close_s: float) -> Any:
    """The pose of a motion over an exposure, from the sample before it to its end."""
    own_s = trajectory.t_s
    inside = own_s[(own_s > open_s + 1e-5) & (own_s < close_s - 1e-5)]
    t_s = np.array([open_s, *inside, close_s])
    rates = [trajectory.rate_at(t) for t in t_s]
    pose = {
        "t_s": t_s,
        "lab_from_body_xyzw": trajectory.attitude_at(t_s).as_quat(),
        "rate_body_rad_s": np.array(rates),
    }
    if places:
        states = places.states(t_s)
        pose |= {"position_m": states.position_m, "velocity_m_s": states.velocity_m_s}
    return {key: value.tolist() for key, value in pose.items()}


@pytest.fixture(scope="module")
def flown() -> Iterator[Flight]:
    with simulate_motion(loader.load("shefex2", ORBIT)) as flight:
        yield flight


def flown_pose(flown: Flight, index: int) -> Any:
    scene = flown.lab.scene
    window = exposure_window(scene, index)
    return pose_of(flown.trajectory(), flown.lab.camera.orbit, window.open_s, window.close_s)


def good_pose(**changes: Any) -> dict[str, Any]:
    """At rest over the exposure of 40 ms that ends at 1 s."""
    pose = {
        "t_s": [0.95, 1.0],
        "lab_from_body_xyzw": [[0, 0, 0, 1]] * 2,
        "rate_body_rad_s": [[0, 0, 0]] * 2,
        "position_m": [[7e6, 0, 0]] * 2,
        "velocity_m_s": [[0, 7500, 0]] * 2,
    }
    return {key: value for key, value in (pose | changes).items() if value is not None}


@pytest.mark.compiles
def test_the_frames_are_those_of_a_flight_with_this_motion(flown: Flight) -> None:
    live = posed()
    poses = [{"pose": flown_pose(flown, index)} for index in range(2)]
    assert answer_to(live, *poses) == []
    frames = [one for one in packets_of(live) if one.channel == "frame"]
    solutions = [one for one in packets_of(live) if one.channel == "solution"]
    assert len(frames) == len(solutions) == 2
    for index, (frame, solution) in enumerate(zip(frames, solutions, strict=True)):
        own, truth = flown.render(index)
        np.testing.assert_array_equal(frame.pixels, own.image_dn)
        assert frame.header["t_s"] == pytest.approx(own.t_mid_s, abs=1e-9)
        assert solution.header["status"] == "solved"
        # The claimed errors of this camera are 1" across the boresight and 10" about it.
        found = np.array(solution.header["cam_from_ref_xyzw"])
        true = truth.mean_cam_from_lab.as_quat()
        error_rad = 2 * np.arccos(min(abs(found @ true), 1.0))
        claimed_rad = np.sqrt(np.trace(solution.header["covariance_rad2"]))
        assert error_rad < 4 * claimed_rad
        assert claimed_rad < 60 * ARCSEC_RAD


@pytest.mark.compiles
def test_the_place_of_the_client_moves_the_stars_by_aberration() -> None:
    """Two opposite velocities move a star by 2 v / c times the sine of its angle from the velocity."""
    live = posed(ORBIT | {"exposure.frames": "3"})
    speed_m_s = 7500.0
    # The camera looks away from the Earth, across the velocity.
    cam_from_body = live.flight.lab.camera.mount.cam_from_body
    across = cam_from_body.inv().apply([1.0, 0.0, 0.0]) * speed_m_s
    away = cam_from_body.inv().apply([0.0, 0.0, 1.0]) * 7e6
    commands = []
    for n, sign in enumerate((1, -1)):
        pose = good_pose(
            t_s=[0.95 + n, 1.0 + n],
            position_m=[away.tolist(), (away + 0.05 * sign * across).tolist()],
            velocity_m_s=[(sign * across).tolist()] * 2,
        )
        commands.append({"pose": pose})
    assert answer_to(live, *commands) == []
    places = []
    for packet in packets_of(live):
        if packet.channel == "frame":
            truth = packet.truth
            places.append(dict(zip(truth["ids"], truth["x_px"], strict=True)))
    shared = sorted(set(places[0]) & set(places[1]))
    assert len(shared) > 10
    moved_px = np.mean([places[0][n] - places[1][n] for n in shared])
    focal_px = live.flight.lab.scene.camera.focal_px
    expected_px = 2 * speed_m_s / 299792458.0 * focal_px
    assert abs(moved_px) == pytest.approx(expected_px, rel=0.05)
    # The tracker knows the velocities: both attitudes are the client's.
    for header in (one.header for one in packets_of(live) if one.channel == "solution"):
        found = Rotation.from_quat(header["cam_from_ref_xyzw"])
        error_rad = (found * cam_from_body.inv()).as_rotvec()
        assert np.linalg.norm(error_rad[:2]) < 3 * ARCSEC_RAD


@pytest.mark.parametrize(
    ("changes", "problem"),
    [
        ({"t_s": None}, "allowed: t_s, lab_from_body_xyzw, rate_body_rad_s"),
        ({"more": 1}, "allowed: t_s, lab_from_body_xyzw, rate_body_rad_s"),
        ({"position_m": None, "velocity_m_s": None}, "allowed: t_s, .*, position_m"),
        ({"t_s": 3}, "number of samples 0; allowed: 2 to 150"),
        ({"t_s": [1.0]}, "number of samples 1; allowed: 2 to 150"),
        ({"t_s": list(range(MOST_SAMPLES + 1))}, "number of samples 151"),
        ({"t_s": [0.95, "x"]}, "t_s is not an array of numbers"),
        ({"t_s": [1.0, 0.95]}, "step of t_s -0.05; allowed: 1e-06 to 1"),
        ({"t_s": [-0.05, 0.0]}, "t_s -0.05; allowed: 0 to 10000000"),
        ({"t_s": [1e308, 1.0]}, r"t_s 1e\+308; allowed"),
        ({"t_s": [0.98, 1.0]}, "exposure's start 0.96; allowed: 0.98 to 10000000"),
        ({"lab_from_body_xyzw": [[0, 0, 0, 1]]}, r"lab_from_body_xyzw has shape \(1, 4\)"),
        ({"lab_from_body_xyzw": [[0, 0, 0, 2]] * 2}, "length of lab_from_body_xyzw 2"),
        (
            {"rate_body_rad_s": [[0, 0, 1e200]] * 2},
            "length of rate_body_rad_s .*; allowed: 0 to 10",
        ),
        ({"rate_body_rad_s": [[0, 0, None]] * 2}, "not finite|not an array"),
        ({"position_m": [[6e6, 0, 0]] * 2}, "length of position_m 6000000; allowed: 6360000"),
        ({"velocity_m_s": [[1e6, 0, 0]] * 2}, "length of velocity_m_s 1000000"),
    ],
)
def test_a_wrong_pose_is_refused_in_one_line(changes: dict[str, Any], problem: str) -> None:
    live = posed_without_warm_up()
    answers = answer_to(live, {"pose": good_pose(**changes)})
    with pytest.raises(AssertionError, match=problem):
        raise AssertionError(*answers)
    assert "\n" not in answers[0]
    assert packets_of(live) == []
    assert live.flight.schedules[0].index == 0


@pytest.mark.parametrize(
    ("command", "problem"),
    [
        ({"pose": 3}, "pose: 3; allowed: t_s"),
        ({"pose": [[]]}, r"pose: \[\[\]\]; allowed: t_s"),
        ({"torque_nm": [0, 0, 0]}, r"no commands \['torque_nm'\]; allowed: pose"),
        ({}, r"no commands \[\]; allowed: pose"),
    ],
)
def test_another_command_is_refused(command: dict[str, Any], problem: str) -> None:
    live = posed_without_warm_up()
    with pytest.raises(AssertionError, match=problem):
        raise AssertionError(*answer_to(live, command))
    assert live.commands.refused == 2  # with the end of the loop


def posed_without_warm_up() -> PosedLive:
    live = posed()
    live.warm_up = lambda: None  # type: ignore[method-assign]
    return live


@pytest.mark.compiles
def test_time_does_not_go_back() -> None:
    live = posed()
    again, later = good_pose(), good_pose(t_s=[1.0, 1.04])
    answers = answer_to(live, {"pose": again}, {"pose": again}, {"pose": later})
    assert answers == ["pose: exposure's start 0.96; allowed: 1 to 10000000"]
    headers = [one.header for one in packets_of(live) if one.channel == "frame"]
    assert [one["index"] for one in headers] == [0, 1]
    assert [one["t_s"] for one in headers] == pytest.approx([0.98, 1.02])


def test_a_scene_without_an_orbit_takes_no_place() -> None:
    live = posed({})
    live.warm_up = lambda: None  # type: ignore[method-assign]
    (answer,) = answer_to(live, {"pose": good_pose()})
    assert answer.endswith("allowed: t_s, lab_from_body_xyzw, rate_body_rad_s")


def test_the_greeting_tells_the_time_that_samples_cover() -> None:
    assert posed({}).greeting["exposure_s"] == pytest.approx(0.04)


def test_the_longest_pose_fits_in_a_line() -> None:
    longest = -1.2345678901234567e-100
    line = json.dumps(
        {
            "pose": {
                "t_s": [longest] * MOST_SAMPLES,
                "lab_from_body_xyzw": [[longest] * 4] * MOST_SAMPLES,
                "rate_body_rad_s": [[longest] * 3] * MOST_SAMPLES,
                **{key: [[longest] * 3] * MOST_SAMPLES for key in PLACE},
            }
        }
    )
    assert len(line) < MOST_LINE_BYTES


@pytest.mark.parametrize("option", ["--trigger", "--client-tracker"])
def test_what_needs_a_simulated_motion_is_refused(option: str) -> None:
    words = ["live", "shefex2", "--tcp", "0", "--poses", option]
    done = CliRunner().invoke(main.app, words)
    assert str(done.exception).startswith(
        "--poses: no motion is simulated; allowed: no --trigger"
    )
