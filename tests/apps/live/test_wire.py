"""Commands over the wire: checked, held, timed out; channels, tokens, triggers."""

import json
import socket
import threading
from collections.abc import Iterator
from typing import Any

import numpy as np
import pytest

from skysim.apps.live import wire
from skysim.apps.live.commands import CommandState, Inbox, parse
from skysim.apps.live.pacing import Live, Pace
from skysim.apps.live.packets import Packet, unpack
from skysim.apps.live.wire import WireServer
from skysim.core.errors import InputError
from skysim.scene import loader
from skysim.simulation.flight import open_flight
from tests.helpers.clock import FakeClock

FREE = {"exposure.frames": "20", "motion.maneuver": "[{kind: hold, duration: 20 s}]"}


def live_flight(scene: str = "simsat_bump", *, trigger: bool = False, **more: str) -> Live:
    """A flight that no clock paces."""
    flight = open_flight(loader.load(scene, FREE | more), keeps_history=False)
    return Live(flight, Pace(0.0, 2.0), [], CommandState(flight, 0.5, trigger))


class Client:
    """A client of the wire."""

    def __init__(self, server: WireServer, **first: Any) -> None:
        self.socket = socket.create_connection(("127.0.0.1", server.port), 10)
        self.lines = self.socket.makefile("rb")
        self.send(**first)

    def send(self, **command: Any) -> None:
        self.socket.sendall(json.dumps(command).encode() + b"\n")

    def receive(self) -> dict[str, Any] | None:
        found = unpack(self.lines)
        return found[0] if found else None


@pytest.fixture
def live() -> Iterator[Live]:
    live = live_flight()
    server = WireServer(live, "127.0.0.1", 0, "secret")
    live.outputs.append(server)
    yield live
    server.close()


def server_of(live: Live) -> WireServer:
    (server,) = live.outputs
    assert isinstance(server, WireServer)
    return server


def answer_to(live: Live, command: dict[str, Any]) -> str:
    """What a client is answered to a command; empty if it was taken."""
    answers = list[str]()
    live.inbox.put(command, answers.append)
    live.commands.receive(live.inbox)
    return "".join(answers)


@pytest.mark.parametrize(
    ("command", "problem"),
    [
        ({"torque_nm": [1, 2]}, r"torque_nm has shape \(2,\)"),
        ({"torque_nm": [1, 2, None]}, "not an array of numbers|not finite"),
        ({"torque_nm": [1, 2, 1e999]}, "not finite"),
        (
            {"wheels": [0, 0, 0]},
            "unknown key 'wheels'; allowed: torque_nm, attitude, exposure_s, triggered, trigger, abort, ideal$",
        ),
        ({"thrust": 3}, "unknown key 'thrust'; allowed: torque_nm, "),
        ({"exposure_ms" * 1000: 3}, "^unknown key '.{40}'; allowed: torque_nm, "),
        ({"exposure_s": -1}, "exposure_s: -1; allowed: more than 0"),
        ({"exposure_s": True}, "exposure_s: True"),
        ({"exposure_s": 1e9}, "allowed: more than 0, to 0.5"),
        ({"trigger": True}, "schedule exposes the frames; allowed: --trigger"),
        ({"triggered": 1}, "triggered: 1; allowed: true or false"),
        ({"attitude": 3}, "attitude: 3; allowed: t_s, cam_from_ref_xyzw"),
    ],
)
def test_a_refused_command_changes_nothing_and_says_why(
    command: dict[str, Any], problem: str
) -> None:
    live = live_flight()
    answer = answer_to(
        live, command | {"ideal": [0.1, 0, 0]} if "wheels" not in command else command
    )
    with pytest.raises(InputError, match=problem):
        raise InputError("", answer)
    assert live.commands.held == {}
    assert live.commands.refused == 1


def attitude(**changes: Any) -> dict[str, Any]:
    return {
        "t_s": 0.0,
        "cam_from_ref_xyzw": [0, 0, 0, 1],
        "covariance_rad2": np.diag([1e-9] * 3).tolist(),
    } | changes


@pytest.mark.parametrize(
    ("changes", "problem"),
    [
        ({"t_s": 5.0}, "t_s 5; allowed: 0 to 0"),
        ({"cam_from_ref_xyzw": [1, 1, 0, 0]}, "not a unit quaternion"),
        (
            {"covariance_rad2": np.diag([1e-9, 1e-9, -1e-9]).tolist()},
            "no covariance of an attitude",
        ),
        ({"covariance_rad2": np.diag([1e-300, 1e-9, 1e-9]).tolist()}, "from 1e-9 to 1 rad"),
        ({"covariance_rad2": np.diag([1e30, 1e-9, 1e-9]).tolist()}, "from 1e-9 to 1 rad"),
        ({"covariance_rad2": [1, 2, 3]}, "has shape"),
    ],
)
def test_an_attitude_is_checked(changes: dict[str, Any], problem: str) -> None:
    assert problem in answer_to(live_flight(), {"attitude": attitude(**changes)})


@pytest.mark.parametrize("line", [b"", b"[1]", b"\xff", b"[" * 100_000, b'{"a": }', b"nan"])
def test_a_line_that_is_no_object_is_refused(line: bytes) -> None:
    with pytest.raises(InputError, match="not an object of JSON"):
        parse(line)


@pytest.mark.slow
def test_a_torque_turns_as_newton_says_and_ends_at_its_timeout() -> None:
    """J dw = T t for 0.2 s; then the timeout of 0.5 s, and the law again."""
    live = live_flight(**{"vehicle.center_of_mass": "[0 mm, 0 mm, 0 mm]"})
    live.commands.timeout_s = 0.2
    before = live.flight.state.rate_body_rad_s
    assert answer_to(live, {"torque_nm": [0, 0, 0.9]}) == ""
    while live.commands.in_force().torque_nm is not None:
        live.advance()
    rate = live.flight.state.rate_body_rad_s - before
    inertia = live.flight.lab.vehicle.inertia_kg_m2[2, 2]
    seconds = live.flight.now_s
    assert 0.2 <= seconds < 0.22
    assert rate[2] == pytest.approx(0.9 / inertia * seconds, rel=1e-6)
    assert live.commands.timeouts == 1
    for _ in range(800):
        live.advance()
    assert abs(live.flight.state.rate_body_rad_s[2]) < 0.1 * rate[2]


def test_commands_of_motors_replace_the_law_only_if_they_are_its_own() -> None:
    live = live_flight("simsat_slew")
    computer = live.flight.motion.flight_computer
    assert answer_to(live, {"fans": [0.1] * 6}) == ""
    for _ in range(5):
        live.advance()
    assert np.any(computer.control_torque_nm)
    assert answer_to(live, {"wheels": [1e9] * 3}) == ""
    live.advance()
    np.testing.assert_array_equal(computer.control_torque_nm, 0)
    # Clipped to the limit.
    speeds = live.flight.motion.simulation.speeds_rad_s
    loads = computer.loads(computer.control, speeds)
    np.testing.assert_allclose(list(loads.values()), 1.0)


def test_a_trim_mass_is_moved_beside_the_law() -> None:
    live = live_flight("cubesat_table", **{"vehicle.trims": "{travel: 10 mm}"})
    start_m = live.flight.state.readings["trim_m"]
    assert answer_to(live, {"trims": [0.001, 0, 0]}) == ""
    for _ in range(20):
        live.advance()
    assert np.any(live.flight.motion.flight_computer.control_torque_nm)
    moved_m = live.flight.state.readings["trim_m"] - start_m
    np.testing.assert_allclose(moved_m, [0.001, 0, 0], atol=1e-6)


def test_thrusters_push_one_way_and_replace_the_law() -> None:
    live = live_flight("simsat_thrusters")
    assert answer_to(live, {"thrusters": [9, -9] + [0] * 10}) == ""
    live.advance()
    np.testing.assert_array_equal(live.flight.motion.flight_computer.control_torque_nm, 0)
    duty = live.flight.state.readings["thruster_duty"]
    np.testing.assert_allclose(duty, [1] + [0] * 11)


def test_each_channel_has_what_the_flight_has(live: Live) -> None:
    live.has_truth = True
    client = Client(
        server_of(live), token="secret", take=["imu", "state", "telemetry", "truth", "frame"]
    )
    hello = client.receive()
    assert hello is not None
    assert hello["channel"] == "hello"
    assert hello["actuators"] == {"ideal": {"motors": 3, "limit": 1.0}}
    angle = np.zeros(3)
    for _ in range(55):
        live.advance()
    found = dict[str, Any]()
    while set(found) < {"imu", "state", "telemetry", "truth", "frame"}:
        packet = client.receive()
        assert packet is not None
        if packet["channel"] == "imu":
            angle += np.sum(packet["angle_rad"], axis=0)
            assert packet["times_s"][-1] == pytest.approx(packet["t_s"], abs=1e-9)
        found[packet["channel"]] = packet
    assert found["frame"]["t_s"] == pytest.approx(0.505, abs=1e-3)
    assert "cam_from_ref_xyzw" in found["frame"]["truth"]
    assert np.linalg.norm(found["truth"]["lab_from_body_xyzw"]) == pytest.approx(1)


def test_a_client_without_the_token_gets_nothing(live: Live) -> None:
    for first in ({"take": ["imu"]}, {"token": "wrong", "take": ["imu"]}):
        client = Client(server_of(live), **first)
        packet = client.receive()
        assert packet is not None
        assert "token missing or wrong" in packet["problem"]
        assert client.receive() is None
    assert not live.entered.is_set()


def test_the_truth_is_off_by_default(live: Live) -> None:
    client = Client(server_of(live), token="secret", take=["truth"])
    packet = client.receive()
    assert packet is not None
    assert "(truth with --truth, " in packet["problem"]


def test_lines_and_commands_without_end_are_refused(live: Live) -> None:
    client = Client(server_of(live), token="secret", take=["imu"])
    client.receive()
    client.socket.sendall(b'{"a": "' + b"x" * 70_000)
    packet = client.receive()
    assert packet is not None
    assert "a line of more than 65536 bytes" in packet["problem"]
    assert client.receive() is None
    inbox = Inbox()
    answers = list[str]()
    for _ in range(1001):
        inbox.put({}, answers.append)
    assert answers == ["more than 1000 commands in a control period"]


@pytest.mark.slow
def test_a_client_that_does_not_read_is_not_waited_for(
    live: Live, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Also by a flight as fast as possible, which waits for those that read."""
    monkeypatch.setattr(wire, "SOCKET_TIMEOUT_S", 1.0)
    client = Client(server_of(live), token="secret", take=["frame"])
    client.receive()
    # The server adds a client while it has the lock; its greeting may come first.
    with server_of(live).lock:
        (served,) = server_of(live).clients
    large = Packet(
        {"channel": "frame", "index": 0, "dropped": 0}, np.zeros((4000, 4000), "<u2")
    )
    sending = threading.Thread(
        target=lambda: [server_of(live).offer(large, True) for _ in range(6)], daemon=True
    )
    sending.start()
    sending.join(20)
    assert not sending.is_alive()
    assert served.fault


def test_a_trigger_exposes_from_now_on_one_after_another() -> None:
    live = live_flight(trigger=True)
    packets = list[Any]()
    live.send = packets.append  # type: ignore[method-assign]
    for _ in range(30):
        live.advance()
    assert packets == []
    now_s = live.flight.now_s
    assert answer_to(live, {"exposure_s": 0.02, "trigger": True}) == ""
    assert answer_to(live, {"trigger": True}) == ""
    for _ in range(10):
        live.advance()
    frames = [one.header for one in packets if one.channel == "frame"]
    middles_s = [now_s + 0.01, now_s + 0.03]
    assert [one["t_s"] for one in frames] == pytest.approx(middles_s, abs=1e-3)
    assert [one["exposure_s"] for one in frames] == [0.02, 0.02]
    for _ in range(100):
        live.commands.apply({"trigger": True})
    with pytest.raises(InputError, match="100 exposures are waiting"):
        live.commands.apply({"trigger": True})


def test_an_abort_forgets_the_exposures_that_have_not_ended() -> None:
    live = live_flight(trigger=True)
    packets = list[Any]()
    live.send = packets.append  # type: ignore[method-assign]
    assert answer_to(live, {"trigger": True}) == ""
    assert answer_to(live, {"abort": True}) == ""
    for _ in range(10):
        live.advance()
    assert packets == []


def test_a_client_switches_between_triggers_and_the_schedule() -> None:
    """Without frames for a time, then by the schedule again from its next time on."""
    live = live_flight()
    packets = list[Any]()
    live.send = packets.append  # type: ignore[method-assign]
    assert answer_to(live, {"triggered": True}) == ""
    for _ in range(130):
        live.advance()
    assert packets == []
    assert answer_to(live, {"triggered": False}) == ""
    for _ in range(60):
        live.advance()
    times_s = [one.header["t_s"] for one in packets if one.channel == "frame"]
    # The schedule of 2 Hz from 0.5 s on; exposures of 10 ms.
    assert times_s == pytest.approx([1.505], abs=1e-3)


def test_a_client_s_attitudes_update_the_filter() -> None:
    live = live_flight()
    live.solves_itself = False
    flight = live.flight
    assert flight.motion.navigation is not None
    mount = flight.lab.cameras[0].mount.cam_from_body
    for _ in range(50):
        live.advance()
    lab_from_body = flight.state.lab_from_body
    before = estimate_error_deg(live)
    solution = attitude(
        t_s=flight.now_s, cam_from_ref_xyzw=(mount * lab_from_body.inv()).as_quat().tolist()
    )
    assert answer_to(live, {"attitude": solution}) == ""
    assert dict(live.commands.updates) == {"used": 1}
    assert estimate_error_deg(live) < 0.1 * before


def estimate_error_deg(live: Live) -> float:
    assert live.flight.motion.navigation is not None
    wxyz = live.flight.motion.navigation.attitude_wxyz("filter")
    true_wxyz = live.flight.state.lab_from_body.as_quat(scalar_first=True)
    return float(np.degrees(2 * np.arccos(min(1.0, abs(wxyz @ true_wxyz)))))


def test_late_periods_are_counted(monkeypatch: pytest.MonkeyPatch) -> None:
    """Late by a period of 10 ms or more."""
    clock = FakeClock()
    monkeypatch.setattr("skysim.apps.live.pacing.time", clock)
    live = live_flight()
    live.pace = Pace(1.0, 2.0)
    live.pace.start(0.0)
    began_s = clock.now_s
    for periods, (delay_s, missed) in enumerate(
        [(0.0, 0), (0.0101, 0), (0.0199, 0), (0.0201, 1)], 1
    ):
        clock.now_s = began_s + 0.01 * (periods - 1) + delay_s
        live.advance()
        assert (live.periods, live.missed) == (periods, missed)
        assert clock.now_s == pytest.approx(
            began_s + 0.01 * (periods - 1) + max(0.01, delay_s)
        )


class Kept:
    """An output that keeps the packets of two channels."""

    name = "kept"
    fault = ""
    channels = ("frame", "state")

    def __init__(self) -> None:
        self.packets: list[Packet] = []

    def offer(self, packet: Packet, patient: bool) -> None:
        self.packets.append(packet)


@pytest.mark.parametrize(("after_s", "is_first"), [(0.002, True), (0.008, False)])
def test_a_frame_waits_for_half_a_control_period_at_most(
    after_s: float, is_first: bool
) -> None:
    """One that ends early in a period comes before the values of the period's end, which take no time."""
    exact = {"exposure.trigger_jitter": "0 s", "exposure.time_tag_jitter": "0 s"}
    live = live_flight(**exact, **{"exposure.first": f"{0.19 + after_s} s"})
    kept = Kept()
    live.outputs.append(kept)  # type: ignore[arg-type]
    period_s = live.flight.motion.flight_computer.period_s
    assert period_s == pytest.approx(0.01)
    while not any(one.channel == "frame" for one in kept.packets):
        live.advance()
    names = [one.channel for one in kept.packets]
    (frame,) = (one.header for one in kept.packets if one.channel == "frame")
    closed_s = frame["t_s"] + frame["exposure_s"] / 2
    assert closed_s == pytest.approx(0.2 + after_s)
    states_s = [one.header["t_s"] for one in kept.packets if one.channel == "state"]
    assert states_s[-1] == pytest.approx(0.21)
    assert names.index("frame") == len(states_s) - is_first


def test_a_first_line_without_channels_is_answered(live: Live) -> None:
    client = Client(server_of(live), token="secret", torque_nm=[0, 0, 0])
    packet = client.receive()
    assert packet is not None
    assert (
        packet["problem"] == 'take: missing in the first line; allowed: ["imu", "solution"]'
    )
    assert client.receive() is None


def test_a_scene_without_gyros_has_no_samples_to_take() -> None:
    live = live_flight("afit_simsat")
    server = WireServer(live, "127.0.0.1", 0, "")
    try:
        client = Client(server, take=["imu"])
        packet = client.receive()
        assert packet is not None
        assert packet["problem"].startswith("take: ['imu']; allowed: frame, solution, state")
        assert "imu with vehicle.imu" in packet["problem"]
    finally:
        server.close()
