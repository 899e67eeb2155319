"""A flight as ROS 2 messages: read back by `rosbags` from MCAP, and received from Foxglove's server."""

from __future__ import annotations

import asyncio
import errno
import json
import re
import sys
import time
from collections import Counter
from collections.abc import Collection
from pathlib import Path
from typing import Any, NamedTuple

import cv2
import numpy as np
import pytest
from scipy.spatial.transform import Rotation
from typer.testing import CliRunner

pytest.importorskip("rosbags", reason="rosbags is not installed")
pytest.importorskip("mcap_ros2", reason="the extra `ros` is not installed")

from rosbags.highlevel import AnyReader

from skysim.apps.cli import main
from skysim.apps.live.commands import CommandState
from skysim.apps.live.pacing import Live, Pace, PosedLive
from skysim.apps.live.packets import Packet
from skysim.apps.live.ros import TOPICS, TRUE_TOPICS, FoxgloveSink, McapSink, RosEncoder
from skysim.core.errors import InputError
from skysim.scene import loader
from skysim.simulation.flight import open_flight
from tests.test_trouble import no_room

DISTORTION = [-0.3, 0.5, 1e-3, -2e-3, 0.1]
FRAMES = 3


class Kept:
    """An output that keeps all packets."""

    name = "kept"
    fault = ""
    channels: Collection[str] = ("frame", "imu", "solution", "telemetry", "truth")

    def __init__(self) -> None:
        self.packets: list[Packet] = []

    def offer(self, packet: Packet, patient: bool) -> None:
        self.packets.append(packet)

    def close(self) -> None:
        pass

    def counters(self) -> dict[str, Any]:
        return {}


class Flown(NamedTuple):
    """A flight, its packets by channel, and the messages of its file by topic."""

    live: Live
    packets: dict[str, list[Packet]]
    messages: dict[str, list[Any]]
    sink: McapSink


def read(path: Path) -> dict[str, list[Any]]:
    """Messages of a file by topic, in the order of their log times."""
    found: dict[str, list[Any]] = {}
    with AnyReader([path]) as reader:
        for one, log_ns, data in reader.messages():
            message = reader.deserialize(data, one.msgtype)
            if hasattr(message, "header"):
                assert log_ns == stamp_ns(message)
            found.setdefault(one.topic, []).append(message)
    return found


def stamp_ns(message: Any) -> int:
    stamp = message.header.stamp
    return int(stamp.sec * 10**9 + stamp.nanosec)


def rotation(quaternion: Any) -> Rotation:
    return Rotation.from_quat([getattr(quaternion, name) for name in "xyzw"])


def xyz(vector: Any) -> list[float]:
    return [vector.x, vector.y, vector.z]


@pytest.fixture(scope="module")
def flown(tmp_path_factory: pytest.TempPathFactory) -> Flown:
    """Of the bumped SimSat, as fast as possible, with a distorted lens and the truth."""
    scene = loader.load(
        "simsat_bump",
        {"exposure.frames": str(FRAMES), "camera.distortion": json.dumps(DISTORTION)},
    )
    flight = open_flight(scene, keeps_history=False)
    commands = CommandState(flight, 0.5, False)
    live = Live(flight, Pace(0.0, 2.0), [], commands, has_truth=True, may_solve=True)
    path = tmp_path_factory.mktemp("ros") / "flight.mcap"
    sink = McapSink(RosEncoder(live), path)
    kept = Kept()
    live.outputs += [kept, sink]
    live.run()
    sink.close()
    packets: dict[str, list[Packet]] = {}
    for one in kept.packets:
        packets.setdefault(one.channel, []).append(one)
    return Flown(live, packets, read(path), sink)


@pytest.mark.slow
def test_the_file_has_every_packet(flown: Flown) -> None:
    packets = flown.packets
    assert len(packets["frame"]) == FRAMES
    assert flown.sink.sent == {name: len(ones) for name, ones in packets.items()}
    assert (flown.sink.dropped, flown.sink.fault) == ({}, "")
    count = {name: len(messages) for name, messages in flown.messages.items()}
    solved = [one for one in packets["solution"] if one.header["status"] == "solved"]
    assert len(solved) > 0
    samples = sum(len(one.header["times_s"]) for one in packets["imu"])
    numbers = {"frame": FRAMES, "solution": len(solved), "imu": samples}
    periodic = {"telemetry": len(packets["telemetry"]), "truth": len(packets["truth"])}
    wanted = {one.name: (numbers | periodic)[one.channel] for one in TOPICS + TRUE_TOPICS}
    assert count == wanted


def test_images_are_the_frames_and_have_their_calibration_beside_them(flown: Flown) -> None:
    infos = flown.messages["/camera/camera_info"]
    for packet, image, info in zip(
        flown.packets["frame"], flown.messages["/camera/image_raw"], infos, strict=True
    ):
        assert bytes(image.data) == packet.pixels.tobytes()
        assert (image.encoding, image.is_bigendian) == ("mono16", 0)
        assert (image.height, image.step // 2) == (image.height, image.width)
        assert (image.height, image.width) == packet.pixels.shape == (info.height, info.width)
        assert stamp_ns(info) == stamp_ns(image)


def test_samples_of_the_imu_add_up_to_its_increments(flown: Flown) -> None:
    headers = [one.header for one in flown.packets["imu"]]
    step_s = headers[0]["step_s"]
    messages = flown.messages["/imu/data_raw"]
    for field, key in (
        ("angular_velocity", "angle_rad"),
        ("linear_acceleration", "velocity_m_s"),
    ):
        sums = np.sum([xyz(getattr(one, field)) for one in messages], axis=0) * step_s
        increments = np.concatenate([header[key] for header in headers])
        np.testing.assert_allclose(sums, increments.sum(axis=0), rtol=1e-12, atol=1e-15)
    # At rest the specific force is gravity, upward (REP 145).
    np.testing.assert_allclose(xyz(messages[0].linear_acceleration)[2], 9.8, atol=0.1)
    assert all(one.orientation_covariance[0] == -1 for one in messages)
    assert not any(one.angular_velocity_covariance.any() for one in messages)
    assert not any(one.linear_acceleration_covariance.any() for one in messages)


def test_stamps_are_the_start_s_wall_clock_plus_the_simulator_s_time(flown: Flown) -> None:
    pace = flown.live.pace
    assert pace.zero_s is not None
    start_ns = round(1e9 * (pace.zero_s + pace.offset_s))
    times_s = {
        "/camera/image_raw": [one.header["t_s"] for one in flown.packets["frame"]],
        "/imu/data_raw": [t for one in flown.packets["imu"] for t in one.header["times_s"]],
        "/truth/attitude": [one.header["t_s"] for one in flown.packets["truth"]],
    }
    for topic, wanted_s in times_s.items():
        stamps_ns = [stamp_ns(one) - start_ns for one in flown.messages[topic]]
        np.testing.assert_allclose(stamps_ns, 1e9 * np.array(wanted_s), rtol=0, atol=0.51)
        assert np.diff(stamps_ns).min() > 0


def test_rectified_pixels_are_those_of_a_pinhole(flown: Flown) -> None:
    """OpenCV undistorts the true pixels, as image_proc does; the pinhole is of the dome's geometry alone."""
    main_camera = flown.live.flight.lab.camera
    mount = main_camera.mount
    sources = main_camera.sources
    places_m = dict(zip(sources.id.tolist(), sources.place[:, :3], strict=True))
    info = flown.messages["/camera/camera_info"][0]
    assert info.distortion_model == "plumb_bob"
    k = info.k.reshape(3, 3)
    p = info.p.reshape(3, 4)
    for packet in flown.packets["frame"]:
        truth = packet.truth
        xy_px = np.column_stack([truth["x_px"], truth["y_px"]])
        assert len(xy_px) > 5
        rectified = cv2.undistortPoints(
            xy_px[:, None], k, info.d, R=info.r.reshape(3, 3), P=p
        )
        cam_from_lab = Rotation.from_quat(truth["cam_from_ref_xyzw"])
        lab_from_body = cam_from_lab.inv() * mount.cam_from_body
        lens_m = lab_from_body.apply(mount.camera_body_m)
        seen = cam_from_lab.apply([places_m[one] - lens_m for one in truth["ids"]])
        pinhole = (seen @ p[:, :3].T)[:, :2] / seen[:, 2:]
        np.testing.assert_allclose(rectified[:, 0], pinhole, rtol=0, atol=1e-3)
        # The distortion is there to be removed.
        assert np.abs(xy_px - pinhole).max() > 0.1


def test_attitudes_turn_the_child_s_vectors_into_the_parent_s(flown: Flown) -> None:
    messages = flown.messages
    truth = {stamp_ns(one): one for one in messages["/truth/camera"]}
    for solved in messages["/star_tracker/attitude"]:
        true = truth[stamp_ns(solved)]
        assert solved.header.frame_id == true.header.frame_id == "lab"
        error = rotation(solved.quaternion).inv() * rotation(true.quaternion)
        assert np.degrees(error.magnitude()) < 0.1
    links = {one.child_frame_id: one for one in messages["/tf"][-1].transforms}
    body = links["body"]
    camera = links["camera_optical_frame"]
    assert (body.header.frame_id, camera.header.frame_id) == ("lab", "body")
    mount = flown.live.flight.lab.camera.mount
    chain = rotation(body.transform.rotation) * rotation(camera.transform.rotation)
    true_chain = (
        rotation(messages["/truth/attitude"][-1].quaternion) * mount.cam_from_body.inv()
    )
    assert np.degrees((chain.inv() * true_chain).magnitude()) < 0.3
    np.testing.assert_allclose(
        xyz(camera.transform.translation), mount.camera_body_m, rtol=0, atol=0.01
    )


def noisy_frame(flown: Flown, index: int) -> Packet:
    """A frame of pixels that cannot be compressed."""
    packet = flown.packets["frame"][0]
    pixels = np.random.default_rng(index).integers(0, 65536, packet.pixels.shape, np.uint16)
    return Packet(packet.header | {"index": index}, pixels, packet.truth)


@pytest.mark.parametrize("room", [200, 12_000_000, 15_360_000])
def test_a_full_disk_leaves_a_whole_file_and_counts_what_it_lacks(
    flown: Flown, tmp_path: Path, room: int
) -> None:
    path = tmp_path / "flight.mcap"
    sink = McapSink(RosEncoder(flown.live), path)
    offered = 8
    with no_room(room):
        for index in range(offered):
            sink.offer(noisy_frame(flown, index), patient=True)
        sink.close()
    assert sink.fault == f"{path}: File too large"
    assert sink.sent["frame"] + sink.dropped["frame"] == offered
    images = read(path).get("/camera/image_raw", [])
    assert len(images) == sink.sent["frame"] == room // (3_840_000 + 100)
    for index, image in enumerate(images):
        assert bytes(image.data) == noisy_frame(flown, index).pixels.tobytes()


def test_the_message_of_a_full_disk_says_that_whole_chunks_are_kept(
    flown: Flown, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    path = tmp_path / "flight.mcap"
    sink = McapSink(RosEncoder(flown.live), path)

    def full(*_: object, **__: object) -> None:
        raise OSError(errno.ENOSPC, "No space left on device")

    monkeypatch.setattr(sink.writer, "add_message", full)
    sink.offer(noisy_frame(flown, 0), patient=True)
    sink.close()
    assert re.fullmatch(
        rf"{path}: No space left on device; \S+ MB are free, its whole chunks are kept",
        sink.fault,
    )


def test_a_file_is_never_overwritten(flown: Flown, tmp_path: Path) -> None:
    path = tmp_path / "flight.mcap"
    path.write_text("mine")
    with pytest.raises(InputError, match=r"flight\.mcap: File exists; allowed: a new file"):
        McapSink(RosEncoder(flown.live), path)
    assert path.read_text() == "mine"
    with no_room(20), pytest.raises(InputError, match=r"new\.mcap: File too large"):
        McapSink(RosEncoder(flown.live), tmp_path / "new.mcap")


def test_without_the_extra_a_line_says_what_to_install(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    monkeypatch.delitem(sys.modules, "skysim.apps.live.ros")
    monkeypatch.delattr("skysim.apps.live.ros")
    monkeypatch.setitem(sys.modules, "foxglove", None)
    command = ["live", "shefex2", "--mcap", str(tmp_path / "a.mcap"), "--frames", "1"]
    done = CliRunner().invoke(main.app, command)
    assert str(done.exception) == (
        "--mcap: foxglove is not installed; allowed: after pip install 'skysim[ros]'"
    )
    assert list(tmp_path.iterdir()) == []


def test_foxglove_sends_the_same_messages_to_who_takes_them(flown: Flown) -> None:
    websockets = pytest.importorskip("websockets")
    sink = FoxgloveSink(RosEncoder(flown.live), 0)
    address = f"ws://127.0.0.1:{sink.server.port}"
    other_site: Any = "http://other.example"  # which the server lets in, as the page says
    frames = flown.packets["frame"]
    (image,) = (one for one in TOPICS if one.name == "/camera/image_raw")

    async def receive() -> tuple[dict[str, Any], list[bytes]]:
        async with websockets.connect(
            address, subprotocols=["foxglove.sdk.v1"], origin=other_site, max_size=None
        ) as client:
            await client.recv()
            offered = {
                one["topic"]: one for one in json.loads(await client.recv())["channels"]
            }
            wanted = {"id": 7, "channelId": offered[image.name]["id"]}
            await client.send(json.dumps({"op": "subscribe", "subscriptions": [wanted]}))
            while not sink.outlets[image].has_sinks():
                await asyncio.sleep(0.01)
            for frame in frames:
                sink.offer(frame, patient=True)
            return offered, [await client.recv() for _ in frames]

    offered, received = asyncio.run(asyncio.wait_for(receive(), 30))
    sink.close()
    assert set(offered) == {one.name for one in TOPICS + TRUE_TOPICS}
    assert offered[image.name]["schema"] == image.definition
    for frame, data in zip(frames, received, strict=True):
        ((_, stamp, message),) = sink.encoder.encode(frame, [image])
        # Message data: opcode 1, subscription, and log time, little-endian; then the message.
        assert data[:5] == b"\x01\x07\x00\x00\x00"
        assert int.from_bytes(data[5:13], "little") == stamp
        assert data[13:] == message
    assert (sink.sent, sink.dropped) == (Counter(frame=FRAMES), Counter())


def test_foxglove_says_which_port_is_taken(flown: Flown) -> None:
    encoder = RosEncoder(flown.live)
    sink = FoxgloveSink(encoder, 0)
    port = sink.server.port
    with pytest.raises(
        InputError, match=f"--foxglove {port}: cannot listen on 127.0.0.1:{port}"
    ):
        FoxgloveSink(encoder, port)
    sink.close()


def test_without_truth_no_topic_tells_it(flown: Flown) -> None:
    live = flown.live
    hidden = Live(live.flight, live.pace, [], live.commands, has_truth=False)
    assert not any("truth" in one.name for one in RosEncoder(hidden).topics)


def test_a_flight_of_poses_has_stamps(flown: Flown) -> None:
    """They are the start's wall clock plus the poses' times; the flight is over, so that it ends at once."""
    live = PosedLive(flown.live.flight, Pace(0.0, 2.0), [], flown.live.commands)
    before_ns = time.time_ns()
    live.run()
    stamp_ns, _ = RosEncoder(live).stamped(2.0, "lab")
    assert before_ns < stamp_ns - 2 * 10**9 < time.time_ns()
