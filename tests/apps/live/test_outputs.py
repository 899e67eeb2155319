"""Streams: frames are identical to those of a run, are sent in time, and every dropped frame is counted."""

from __future__ import annotations

import io
import json
import os
import signal
import socket
import struct
import subprocess
import sys
import threading
import time
import urllib.error
import urllib.request
from collections.abc import Iterator
from itertools import islice
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
from typer.testing import CliRunner

from skysim.apps.cli import main
from skysim.apps.live import http, packets
from skysim.apps.live.commands import CommandState
from skysim.apps.live.pacing import Live, Pace
from skysim.apps.live.packets import Packet, unpack
from skysim.core.errors import InputError
from skysim.scene import loader
from skysim.simulation.flight import Flight, open_flight
from tests.helpers.clock import FakeClock

FRAMES = 4
OVERRIDES = {"exposure.frames": str(FRAMES), "light.limit_mag": "5"}


@pytest.fixture(scope="module")
def frames() -> list[np.ndarray]:
    """The frames of a run of the scene."""
    return [
        shot.frame.image_dn
        for shot in open_flight(loader.load("shefex2", OVERRIDES)).shots(solves=False)
    ]


def streamed_flight(*, endless: bool = False) -> Flight:
    """A flight as `skysim live` opens it."""
    return open_flight(
        loader.load("shefex2", OVERRIDES), endless=endless, keeps_history=False
    )


def packet(index: int, dropped: int = 0, pixels: Any = None) -> Packet:
    pixels = np.arange(12, dtype="<u2").reshape(3, 4) if pixels is None else pixels
    shape = {"width": pixels.shape[1], "height": pixels.shape[0], "dtype": pixels.dtype.str}
    header = {
        "channel": "frame",
        "index": index,
        "dropped": dropped,
        "t_s": 0.5,
        "due_unix_s": 1.0,
    }
    return Packet(header | shape, pixels, {"ids": [7]})


@pytest.mark.parametrize("dtype", ["<u2", "<f8"])
def test_packets_round_trip_and_a_truncated_one_is_an_error(dtype: str) -> None:
    pixels = np.random.default_rng(1).integers(0, 65535, (5, 7)).astype(dtype)
    data = packet(3, 1, pixels).pack()
    stream = io.BytesIO(data + data)
    for _ in range(2):
        found = unpack(stream)
        assert found is not None
        assert found[0]["index"] == 3
        np.testing.assert_array_equal(found[1], pixels)
    assert unpack(stream) is None
    with pytest.raises(InputError, match="ended within frame 3"):
        unpack(io.BytesIO(data[:-1]))


@pytest.mark.parametrize(
    "line",
    [
        b"\n",
        b"no JSON\n",
        b"[1]\n",
        b'{"width": 100000, "height": 100000, "dtype": "<u2"}\n',
        b'{"width": -1, "height": 1, "dtype": "<u2"}\n',
        b'{"width": 1, "height": 1, "dtype": "O"}\n',
        b'{"width": 1, "height": 1, "dtype": "nonsense"}\n',
    ],
)
def test_invalid_headers_are_rejected_before_the_pixels_are_read(line: bytes) -> None:
    with pytest.raises(InputError, match="not a packet of skysim live"):
        unpack(io.BytesIO(line + b"x" * 64))


def test_a_frame_is_sent_when_due_and_dropped_one_period_later(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    clock = FakeClock()
    monkeypatch.setattr("skysim.apps.live.pacing.time", clock)
    pace = Pace(2.0, 10.0)  # a period is 50 ms on the wall
    assert pace.is_on_time(0, 123.0)  # the clock has not started yet
    pace.start(0.3)
    pace.wait(0.5)
    assert clock.now_s == pytest.approx(100.1, abs=1e-12)
    clock.now_s += 0.05 - 1e-6
    assert pace.is_on_time(1, 0.5)
    clock.now_s += 2e-6
    assert not pace.is_on_time(1, 0.5)
    assert pace.due_s(0.5) + pace.offset_s == pytest.approx(1e9 + 100.1, abs=1e-6)


def test_late_frames_are_dropped_and_counted(frames: list[np.ndarray]) -> None:
    """With time for every second frame, received frames equal the run's; the header counts dropped ones."""
    received: list[Packet] = []

    class Slow(Pace):
        def is_on_time(self, index: int, t_s: float) -> bool:
            return index % 2 == 0

    sink = packets.Sink("folder", received.append)
    flight = streamed_flight()
    stats = Live(flight, Slow(0.0, 10.0), [sink], CommandState(flight, 0.5, False))
    stats.run()
    sink.close()
    assert [one.header["index"] for one in received] == list(range(0, FRAMES, 2))
    assert [one.header["dropped"] for one in received] == list(range(FRAMES // 2))
    # With the last, after which none came.
    counted = stats.statistics()
    assert (counted["made"], counted["dropped"]) == (FRAMES // 2, FRAMES - FRAMES // 2)
    for one in received:
        np.testing.assert_array_equal(one.pixels, frames[one.header["index"]])


def test_a_slow_sink_delays_nothing_and_its_drops_are_counted() -> None:
    released = threading.Event()
    received = list[int]()

    def take(one: Packet) -> None:
        released.wait(10)
        received.append(one.header["dropped"])

    sink = packets.Sink("slow", take)
    for index in range(20):
        sink.offer(packet(index), patient=False)
    released.set()
    sink.close()
    assert sink.sent["frame"] == len(received)
    assert sink.sent["frame"] + sink.dropped["frame"] == 20
    assert sink.dropped["frame"] >= 16  # one at hand, two waiting, one that came between
    sink = packets.Sink("gone", lambda _: (_ for _ in ()).throw(BrokenPipeError))
    sink.offer(packet(0), patient=True)
    sink.close()
    assert (sink.sent, sink.dropped) == ({}, {"frame": 1})
    assert sink.fault == "the reader has closed the pipe"


def test_the_packet_of_a_blocked_sink_is_counted_as_dropped(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """For example a pipe without a reader."""
    monkeypatch.setattr(packets, "CLOSE_TIMEOUT_S", 0.3)
    released = threading.Event()

    def take(_: Packet) -> None:
        released.wait(30)

    sink = packets.Sink("stuck", take)
    for index in range(10):
        sink.offer(packet(index), patient=False)
    sink.close()
    assert (sink.sent, sink.dropped) == ({}, {"frame": 10})
    released.set()


def test_a_failing_sink_reports_its_fault_and_is_not_waited_for() -> None:
    sink = packets.Sink("odd", lambda _: (_ for _ in ()).throw(ValueError("no such\nthing")))

    def send() -> None:
        for index in range(5):
            sink.offer(packet(index), patient=True)

    sending = threading.Thread(target=send, daemon=True)
    sending.start()
    sending.join(10)
    assert not sending.is_alive()
    sink.close()
    assert (sink.sent, sink.dropped) == ({}, {"frame": 5})
    assert sink.fault == "ValueError: no such thing"


def test_a_folder_receives_every_frame_with_its_truth(
    tmp_path: Path, frames: list[np.ndarray]
) -> None:
    sets = [word for key, value in OVERRIDES.items() for word in ("--set", f"{key}={value}")]
    command = [
        "live",
        "shefex2",
        "--folder",
        str(tmp_path),
        "--speed",
        "0",
        "--json",
        "--truth",
        *sets,
    ]
    done = CliRunner().invoke(main.app, command)
    assert json.loads(done.stdout)["outputs"]["folder"] == {
        "sent": {"frame": FRAMES},
        "dropped": {},
        "fault": "",
    }
    for n, image in enumerate(frames):
        result = json.loads((tmp_path / f"frame_{n:06d}.json").read_text())
        np.testing.assert_array_equal(
            cv2.imread(str(tmp_path / f"frame_{n:06d}.png"), -1), image
        )
        assert np.linalg.norm(result["truth"]["cam_from_ref_xyzw"]) == pytest.approx(
            1, abs=1e-12
        )
        assert len(result["truth"]["ids"]) == len(result["truth"]["x_px"]) > 5
    with pytest.raises(InputError, match="holds frames of an earlier flight"):
        packets.folder_writer(tmp_path)
    with pytest.raises(InputError, match="not a named pipe"):
        packets.pipe_writer(str(tmp_path / "none"))


@pytest.fixture
def server() -> Iterator[http.FrameServer]:
    """A server with one frame posted."""
    server = http.FrameServer(lambda: {"made": 1}, "127.0.0.1", 0)
    server.offer(packet(0), False)
    yield server
    server.close()


def address(server: http.FrameServer, path: str = "") -> str:
    return f"http://127.0.0.1:{server.server_port}{path}"


def part(movie: Any) -> tuple[dict[str, str], Any]:
    """The next head and picture of a stream."""
    assert movie.readline() == b"--frame\r\n"
    head = dict(line.decode().split(": ") for line in iter(movie.readline, b"\r\n"))
    data = movie.read(int(head["Content-Length"]))
    movie.readline()
    return head, cv2.imdecode(np.frombuffer(data, np.uint8), -1)


def test_the_newest_frame_and_the_counters_are_served(server: http.FrameServer) -> None:
    def received(path: str) -> bytes:
        return bytes(urllib.request.urlopen(address(server, path), timeout=10).read())

    image = cv2.imdecode(np.frombuffer(received("/frame.png"), np.uint8), -1)
    np.testing.assert_array_equal(image, packet(0).pixels)
    assert json.loads(received("/truth.json"))["index"] == 0
    assert json.loads(received("/status.json")) == {"made": 1}
    assert b"/stream.mjpg" in received("/")
    with pytest.raises(urllib.error.HTTPError, match="404"):
        received("/etc/passwd")


def test_streams_send_every_frame(server: http.FrameServer) -> None:
    movies = [
        urllib.request.urlopen(address(server, "/stream.mjpg"), timeout=10) for _ in range(2)
    ]
    for index in range(3):
        for movie in movies:
            head, picture = part(movie)
            assert (int(head["X-index"]), int(head["X-dropped"])) == (index, 0)
            assert picture.shape == (3, 4)
        server.offer(packet(index + 1), False)
    assert server.counters()["sent"]["frame"] >= 6


def test_clients_receive_the_last_frame_before_the_stream_ends() -> None:
    server = http.FrameServer(dict, "127.0.0.1", 0)
    movie = urllib.request.urlopen(address(server, "/stream.mjpg"), timeout=10)
    server.offer(packet(0), False)
    part(movie)
    found = list[Any]()
    late = threading.Timer(0.1, lambda: found.append(part(movie)))
    late.start()
    noise = np.random.default_rng(1).integers(0, 65535, (3000, 3000)).astype("<u2")
    server.offer(packet(1, pixels=noise), False)  # more than a socket holds
    server.close()
    late.join()
    assert found[0][0]["X-index"].strip() == "1"
    assert server.counters() == {"sent": {"frame": 2}, "dropped": {}}


def test_a_client_that_disconnects_during_a_response_is_ignored(
    server: http.FrameServer, capfd: pytest.CaptureFixture[str]
) -> None:
    noise = np.random.default_rng(1).integers(0, 65535, (3000, 3000)).astype("<u2")
    server.offer(packet(1, pixels=noise), False)
    with socket.create_connection(("127.0.0.1", server.server_port), 10) as client:
        # Reset by closing.
        client.setsockopt(socket.SOL_SOCKET, socket.SO_LINGER, struct.pack("ii", 1, 0))
        client.sendall(b"GET /frame.png HTTP/1.0\r\n\r\n")
        assert client.recv(100)
    time.sleep(0.3)
    assert capfd.readouterr().err == ""


@pytest.mark.parametrize("path", ["/", "/frame.png", "/truth.json", "/stream.mjpg"])
def test_head_answers_like_get_without_the_body(server: http.FrameServer, path: str) -> None:
    with urllib.request.urlopen(
        urllib.request.Request(address(server, path), method="HEAD"), timeout=10
    ) as result:
        assert result.status == 200
        assert result.read() == b""
    assert server.sent == 0
    with urllib.request.urlopen(address(server, path), timeout=10) as received:
        same = ("Content-Type", "Content-Length", "X-Skysim-Header")
        assert [result.headers[name] for name in same] == [
            received.headers[name] for name in same
        ]


def test_an_endless_stream_continues_beyond_the_scene_s_frames_and_a_day() -> None:
    """The clock is set forward by ten days; the free rotation does not depend on it."""
    flight = streamed_flight(endless=True)
    scene = flight.lab.scene
    simulation = flight.motion.simulation
    size_bytes = simulation.states.nbytes
    offset_s = 10 * 86_400
    simulation.step = simulation.first_step = round(offset_s / simulation.step_s)
    flight.schedules[0].index = round(offset_s * scene.exposure.rate_hz)
    shots = list(islice(flight.shots(solves=False), FRAMES + 1))
    mids_s = [shot.frame.t_mid_s - offset_s for shot in shots]
    first_s = scene.exposure.first_s + scene.exposure.time_s / 2
    np.testing.assert_allclose(
        mids_s, first_s + np.arange(len(shots)) / scene.exposure.rate_hz, rtol=0, atol=1e-8
    )
    assert simulation.states.nbytes == size_bytes
    rotation = shots[-1].truth.cam_from_lab * shots[0].truth.cam_from_lab.inv()
    rate_rad_s = np.radians(np.linalg.norm(scene.motion.rate_deg_s))
    assert rotation.magnitude() == pytest.approx(
        rate_rad_s * (mids_s[-1] - mids_s[0]), rel=1e-6
    )


@pytest.mark.long
def test_an_endless_stream_ends_at_sigterm_with_complete_frames_and_counters(
    tmp_path: Path,
) -> None:
    command = [
        sys.executable,
        "-m",
        "skysim",
        "live",
        "shefex2",
        "--set",
        "light.limit_mag=5",
        "--endless",
    ]
    stream = subprocess.Popen([*command, "--folder", str(tmp_path), "--json"], stdout=-1)
    until = time.monotonic() + 300
    while not (tmp_path / "frame_000002.json").exists():
        assert stream.poll() is None
        assert time.monotonic() < until
        time.sleep(0.02)
    stream.send_signal(signal.SIGTERM)
    result = json.loads(stream.communicate(timeout=60)[0])
    assert stream.returncode == 0
    stems = {path.stem for path in tmp_path.iterdir()}
    assert {path.name for path in tmp_path.iterdir()} == {
        f"{stem}.{end}" for stem in stems for end in ("png", "json")
    }
    assert len(stems) == result["outputs"]["folder"]["sent"]["frame"] >= 3
    with pytest.raises(InputError, match="--endless: has no effect with --frames"):
        CliRunner().invoke(
            main.app, [*command[3:], "--frames", "3", "--pipe", "-"], catch_exceptions=False
        )


@pytest.mark.long
def test_a_stream_ends_with_the_reader_of_its_pipe_and_at_sigterm(tmp_path: Path) -> None:
    command = [
        sys.executable,
        "-m",
        "skysim",
        "live",
        "shefex2",
        "--set",
        "light.limit_mag=5",
        "--endless",
    ]
    piped = subprocess.Popen([*command, "--pipe", "-", "--speed", "0"], stdout=-1, stderr=-1)
    assert piped.stdout is not None
    assert piped.stderr is not None
    assert unpack(piped.stdout) is not None
    piped.stdout.close()
    assert piped.wait(60) == 0
    result = piped.stderr.read().decode()
    assert "the reader has closed the pipe" in result
    assert "Exception" not in result
    fifo = tmp_path / "frames"
    os.mkfifo(fifo)
    named = subprocess.Popen([*command, "--pipe", str(fifo), "--json"], stdout=-1)
    with fifo.open("rb") as reader:
        began = [unpack(reader) for _ in range(2)]
        assert all(began)
        time.sleep(0.1)
        named.send_signal(signal.SIGTERM)
        while unpack(reader):
            pass
    result = json.loads(named.communicate(timeout=60)[0])
    assert named.returncode == 0
    assert result["made"] >= result["outputs"]["pipe"]["sent"]["frame"] >= 2


@pytest.mark.parametrize(
    ("headers", "status"),
    [
        ({}, 200),
        ({"Host": "localhost:1"}, 200),
        ({"Host": "rebound.example"}, 403),
        ({"Origin": "http://other.example"}, 403),
        ({"Origin": "null"}, 403),
    ],
)
@pytest.mark.parametrize("path", ["/", "/frame.png", "/stream.mjpg", "/truth.json"])
def test_requests_that_a_browser_makes_for_another_site_are_refused(
    server: http.FrameServer, path: str, headers: dict[str, str], status: int
) -> None:
    request = urllib.request.Request(address(server, path), method="HEAD", headers=headers)
    if status == 200:
        assert urllib.request.urlopen(request, timeout=10).status == 200
    else:
        with pytest.raises(urllib.error.HTTPError, match=str(status)):
            urllib.request.urlopen(request, timeout=10)


def test_a_server_with_a_token_wants_it_in_every_address() -> None:
    server = http.FrameServer(dict, "127.0.0.1", 0, "secret")
    server.offer(packet(0), False)
    for query in ("", "?token=wrong", "?token=secre"):
        with pytest.raises(urllib.error.HTTPError, match="403"):
            urllib.request.urlopen(address(server, f"/frame.png{query}"), timeout=10)
    page = urllib.request.urlopen(address(server, "/?token=secret"), timeout=10).read()
    assert b"/stream.mjpg?token=secret" in page
    server.close()


def test_the_truth_is_served_only_where_it_is_on() -> None:
    server = http.FrameServer(dict, "127.0.0.1", 0)
    server.offer(packet(0)._replace(truth={}), False)
    with pytest.raises(urllib.error.HTTPError, match="start with --truth"):
        urllib.request.urlopen(address(server, "/truth.json"), timeout=10)
    server.close()
