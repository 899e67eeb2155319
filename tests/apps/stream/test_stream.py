"""A scene sent out as it happens: the frames are those of a run, in time or counted, whoever takes them."""

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
from dataclasses import replace
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
from typer.testing import CliRunner

from skysim.apps.cli import main
from skysim.apps.stream import http, sender, sinks
from skysim.apps.stream.pacing import Pace
from skysim.apps.stream.packet import Packet, unpack
from skysim.core.errors import InputError
from skysim.scene import loader
from skysim.simulation import run, testbed
from skysim.simulation.closed_loop import CapturedFrame, ClosedLoop, OnboardCamera
from skysim.simulation.testbed import Testbed

FRAMES = 4
OVERRIDES = {"exposure.frames": str(FRAMES), "light.limit_mag": "5"}


@pytest.fixture(scope="module")
def frames() -> list[np.ndarray]:
    """What a run makes of the scene."""
    lab = run.prepare(loader.load("shefex2", OVERRIDES))
    return [frame.image_dn for frame, _, _ in run.render_frames(lab)]


def on_the_ground() -> Testbed:
    return testbed.build_testbed(loader.load("shefex2", OVERRIDES))


def packet(index: int, dropped: int = 0, pixels: Any = None) -> Packet:
    pixels = np.arange(12, dtype="<u2").reshape(3, 4) if pixels is None else pixels
    shape = {"width": pixels.shape[1], "height": pixels.shape[0], "dtype": pixels.dtype.str}
    return Packet({"index": index, "dropped": dropped, "t_s": 0.5, "due_unix_s": 1.0, **shape}, pixels, {})


@pytest.mark.parametrize("dtype", ["<u2", "<f8"])
def test_a_packet_comes_back_as_it_was_and_one_cut_short_is_told(dtype: str) -> None:
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
def test_what_is_no_packet_is_refused_before_anything_is_read(line: bytes) -> None:
    with pytest.raises(InputError, match="no packet of skysim stream"):
        unpack(io.BytesIO(line + b"x" * 64))


class Wall:
    """A clock on the wall that only sleep moves."""

    def __init__(self) -> None:
        self.now_s = 100.0

    def monotonic(self) -> float:
        return self.now_s

    def time(self) -> float:
        return 1e9 + self.now_s

    def sleep(self, seconds: float) -> None:
        self.now_s += seconds


def test_a_frame_waits_for_its_time_and_is_left_out_a_period_after_it(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    wall = Wall()
    monkeypatch.setattr("skysim.apps.stream.pacing.time", wall)
    pace = Pace(2.0, 10.0)  # a period is 50 ms on the wall
    assert pace.in_time(0, 123.0)  # what is before the first frame is nobody's delay
    pace.start(0.3)
    pace.wait(0.5)
    assert wall.now_s == pytest.approx(100.1, abs=1e-12)
    wall.now_s += 0.05 - 1e-6
    assert pace.in_time(1, 0.5)
    wall.now_s += 2e-6
    assert not pace.in_time(1, 0.5)
    assert pace.due_s(0.5) + pace.offset_s == pytest.approx(1e9 + 100.1, abs=1e-6)


def test_frames_that_are_late_are_left_out_and_all_are_accounted_for(frames: list[np.ndarray]) -> None:
    """With time for every other frame, those that come are the run's; the header says how many did not."""
    came: list[Packet] = []

    class Slow(Pace):
        def in_time(self, index: int, t_s: float) -> bool:
            return index % 2 == 0

    tally = sender.Tally()
    sender.send(on_the_ground(), Slow(0.0, 10.0), [], tally, came.append)
    assert [one.header["index"] for one in came] == list(range(0, FRAMES, 2))
    assert [one.header["dropped"] for one in came] == list(range(FRAMES // 2))
    assert (tally.made, tally.dropped) == (
        FRAMES // 2,
        FRAMES - FRAMES // 2,
    )  # with the last, after which none came
    for one in came:
        np.testing.assert_array_equal(one.pixels, frames[one.header["index"]])


def test_a_slow_sink_holds_nobody_up_and_its_losses_are_counted() -> None:
    free, got = threading.Event(), list[int]()

    def take(one: Packet) -> None:
        free.wait(10)
        got.append(one.header["dropped"])

    sink = sinks.Sink("slow", take)
    for index in range(20):
        sink.offer(packet(index), patient=False)
    free.set()
    sink.close()
    assert sink.sent == len(got)
    assert sink.sent + sink.dropped == 20
    assert sink.dropped >= 16  # one at hand, two waiting, one that came between
    sink = sinks.Sink("gone", lambda _: (_ for _ in ()).throw(BrokenPipeError))
    sink.offer(packet(0), patient=True)
    sink.close()
    assert (sink.sent, sink.dropped, sink.fault) == (0, 1, "its reader is gone")


def test_a_packet_in_the_hands_of_a_sink_that_never_ends_is_left_out(monkeypatch: pytest.MonkeyPatch) -> None:
    """As of a pipe that nobody opens."""
    monkeypatch.setattr(sinks, "GRACE_S", 0.3)
    free = threading.Event()

    def take(_: Packet) -> None:
        free.wait(30)

    sink = sinks.Sink("stuck", take)
    for index in range(10):
        sink.offer(packet(index), patient=False)
    sink.close()
    assert (sink.sent, sink.dropped) == (0, 10)
    free.set()


def test_a_sink_that_fails_in_whatever_way_is_told_and_waited_for_no_longer() -> None:
    sink = sinks.Sink("odd", lambda _: (_ for _ in ()).throw(ValueError("no such\nthing")))

    def send() -> None:
        for index in range(5):
            sink.offer(packet(index), patient=True)

    sending = threading.Thread(target=send, daemon=True)
    sending.start()
    sending.join(10)
    assert not sending.is_alive()
    sink.close()
    assert (sink.sent, sink.dropped, sink.fault) == (0, 5, "ValueError: no such thing")


def test_a_folder_gets_every_frame_whole_with_its_truth(tmp_path: Path, frames: list[np.ndarray]) -> None:
    sets = [word for key, value in OVERRIDES.items() for word in ("--set", f"{key}={value}")]
    command = ["stream", "shefex2", "--folder", str(tmp_path), "--speed", "0", "--json", *sets]
    done = CliRunner().invoke(main.app, command)
    assert json.loads(done.stdout)["sinks"]["folder"] == {"sent": FRAMES, "dropped": 0, "fault": ""}
    for n, image in enumerate(frames):
        told = json.loads((tmp_path / f"frame_{n:06d}.json").read_text())
        np.testing.assert_array_equal(cv2.imread(str(tmp_path / f"frame_{n:06d}.png"), -1), image)
        assert np.linalg.norm(told["truth"]["cam_from_ref_xyzw"]) == pytest.approx(1, abs=1e-12)
        assert len(told["truth"]["ids"]) == len(told["truth"]["x_px"]) > 5
    with pytest.raises(InputError, match="frames of an earlier stream are there"):
        sinks.folder(tmp_path)
    with pytest.raises(InputError, match="no named pipe"):
        sinks.pipe(str(tmp_path / "none"))


@pytest.fixture
def board() -> Iterator[tuple[http.Board, str]]:
    """A server with one packet posted."""
    board = http.Board(lambda: {"made": 1})
    server = http.served(board, "127.0.0.1", 0)
    board.post(packet(0))
    yield board, f"http://127.0.0.1:{server.server_port}"
    board.end()
    server.shutdown()


def test_the_newest_frame_and_the_tallies_are_served(board: tuple[http.Board, str]) -> None:
    def got(path: str) -> bytes:
        return bytes(urllib.request.urlopen(board[1] + path, timeout=10).read())

    found = unpack(io.BytesIO(got("/frame.raw")))
    assert found is not None
    np.testing.assert_array_equal(found[1], packet(0).pixels)
    image = cv2.imdecode(np.frombuffer(got("/frame.png"), np.uint8), -1)
    np.testing.assert_array_equal(image, packet(0).pixels)
    assert json.loads(got("/truth.json"))["index"] == 0
    assert json.loads(got("/status.json")) == {"made": 1} | board[0].tallies()
    assert b"/stream.mjpg" in got("/")
    with pytest.raises(urllib.error.HTTPError, match="404"):
        got("/etc/passwd")


def test_streams_bring_every_next_frame(board: tuple[http.Board, str]) -> None:
    raw = urllib.request.urlopen(board[1] + "/stream.raw", timeout=10)
    movie = urllib.request.urlopen(board[1] + "/stream.mjpg", timeout=10)
    for index in range(3):
        found = unpack(raw)
        assert found is not None
        assert (found[0]["index"], found[0]["dropped"]) == (index, 0)
        assert movie.readline() == b"--frame\r\n"
        head = dict(line.decode().split(": ") for line in iter(movie.readline, b"\r\n"))
        assert int(head["X-index"]) == index
        data = movie.read(int(head["Content-Length"]))
        assert cv2.imdecode(np.frombuffer(data, np.uint8), -1).shape == (3, 4)
        movie.readline()
        board[0].post(packet(index + 1))
    assert [client.dropped for client in board[0].clients] == [0, 0]


def test_the_last_frame_reaches_who_watches_though_the_stream_ends_with_it() -> None:
    board = http.Board(dict)
    server = http.served(board, "127.0.0.1", 0)
    raw = urllib.request.urlopen(f"http://127.0.0.1:{server.server_port}/stream.raw", timeout=10)
    board.post(packet(0))
    assert unpack(raw) is not None
    late = threading.Timer(0.1, lambda: unpack(raw))
    late.start()
    board.post(packet(1, pixels=np.zeros((3000, 3000), "<u2")))  # more than a socket holds
    board.end()
    late.join()
    assert board.tallies()["clients"] == [{"sent": 2, "dropped": 0}]
    server.shutdown()


def test_a_client_that_goes_within_an_answer_is_nothing_to_tell(
    board: tuple[http.Board, str], capfd: pytest.CaptureFixture[str]
) -> None:
    board[0].post(packet(1, pixels=np.zeros((3000, 3000), "<u2")))
    with socket.create_connection(("127.0.0.1", int(board[1].rpartition(":")[2])), 10) as client:
        client.setsockopt(socket.SOL_SOCKET, socket.SO_LINGER, struct.pack("ii", 1, 0))  # reset by closing
        client.sendall(b"GET /frame.raw HTTP/1.0\r\n\r\n")
        assert client.recv(100)
    time.sleep(0.3)
    assert capfd.readouterr().err == ""


def test_clients_that_left_cost_no_memory_but_count(board: tuple[http.Board, str]) -> None:
    """A hundred come, each for a frame; what the newest were sent is told one by one, of the others the sum."""
    stays = urllib.request.urlopen(board[1] + "/stream.raw", timeout=10)
    assert unpack(stays) is not None
    for _ in range(100):
        with urllib.request.urlopen(board[1] + "/stream.raw", timeout=10) as raw:
            assert unpack(raw) is not None
    until = time.monotonic() + 60
    index = 0
    while len(board[0].left) + board[0].earlier["clients"] < 100:  # who left is found out by sending
        assert time.monotonic() < until
        index += 1
        board[0].post(packet(index))
        while (found := unpack(stays)) and found[0]["index"] < index:
            pass
    told = board[0].tallies()
    assert len(told["clients"]) == 1 + http.REMEMBERED == len(board[0].clients)
    assert told["earlier_clients"]["clients"] == 100 - http.REMEMBERED
    assert told["earlier_clients"]["sent"] >= 100 - http.REMEMBERED
    assert told["clients"][0]["sent"] in (index, index + 1)


@pytest.mark.parametrize(
    "path", ["/", "/frame.png", "/frame.raw", "/truth.json", "/stream.raw", "/stream.mjpg"]
)
def test_head_is_told_what_get_is_without_the_body(board: tuple[http.Board, str], path: str) -> None:
    with urllib.request.urlopen(urllib.request.Request(board[1] + path, method="HEAD"), timeout=10) as told:
        assert told.status == 200
        assert told.read() == b""
    assert board[0].clients == []
    with urllib.request.urlopen(board[1] + path, timeout=10) as got:
        same = ("Content-Type", "Content-Length", "X-Skysim-Header")
        assert [told.headers[name] for name in same] == [got.headers[name] for name in same]


def test_an_endless_flight_goes_on_beyond_the_scene_s_frames_and_beyond_a_day() -> None:
    """The clock is put forward by ten days, which a body that turns freely does not feel."""
    lab = replace(on_the_ground(), endless=True)
    aloft = ClosedLoop(lab, forgets=True)
    room = aloft.flight.states.nbytes
    eyes, later = OnboardCamera(aloft, None), 10 * 86_400
    aloft.flight.step = aloft.flight.first = round(later / aloft.flight.step_s)
    eyes.index = round(later * lab.scene.exposure.rate_hz)
    came: list[CapturedFrame] = []
    while len(came) < FRAMES + 1:
        aloft.tick(10)
        came += eyes.looks()
    mids_s = [look.frame.t_mid_s - later for look in came]
    first_s = lab.scene.exposure.first_s + lab.scene.exposure.time_s / 2
    np.testing.assert_allclose(
        mids_s, first_s + np.arange(len(came)) / lab.scene.exposure.rate_hz, rtol=0, atol=1e-8
    )
    assert aloft.flight.states.nbytes == room
    turned = came[-1].truth.cam_from_lab * came[0].truth.cam_from_lab.inv()
    rate_rad_s = np.radians(np.linalg.norm(lab.scene.motion.rate_deg_s))
    assert turned.magnitude() == pytest.approx(rate_rad_s * (mids_s[-1] - mids_s[0]), rel=1e-6)


def test_an_endless_stream_ends_by_sigterm_with_whole_frames_and_its_tallies(tmp_path: Path) -> None:
    command = [sys.executable, "-m", "skysim", "stream", "shefex2", "--set", "light.limit_mag=5", "--endless"]
    stream = subprocess.Popen([*command, "--folder", str(tmp_path), "--json"], stdout=-1)
    until = time.monotonic() + 300
    while not (tmp_path / "frame_000002.json").exists():
        assert stream.poll() is None
        assert time.monotonic() < until
        time.sleep(0.02)
    stream.send_signal(signal.SIGTERM)
    told = json.loads(stream.communicate(timeout=60)[0])
    assert stream.returncode == 0
    stems = {path.stem for path in tmp_path.iterdir()}
    assert {path.name for path in tmp_path.iterdir()} == {
        f"{stem}.{end}" for stem in stems for end in ("png", "json")
    }
    assert len(stems) == told["sinks"]["folder"]["sent"] >= 3
    with pytest.raises(InputError, match="either --frames N or --endless"):
        CliRunner().invoke(main.app, [*command[3:], "--frames", "3", "--pipe", "-"], catch_exceptions=False)


@pytest.mark.long
def test_a_pipe_ends_with_its_reader_and_sigterm_ends_a_stream_with_its_tallies(tmp_path: Path) -> None:
    command = [sys.executable, "-m", "skysim", "stream", "shefex2", "--set", "light.limit_mag=5", "--endless"]
    piped = subprocess.Popen([*command, "--pipe", "-", "--speed", "0"], stdout=-1, stderr=-1)
    assert piped.stdout is not None
    assert piped.stderr is not None
    assert unpack(piped.stdout) is not None
    piped.stdout.close()
    assert piped.wait(60) == 0
    told = piped.stderr.read().decode()
    assert "its reader is gone" in told
    assert "Exception" not in told
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
    told = json.loads(named.communicate(timeout=60)[0])
    assert named.returncode == 0
    assert told["made"] >= told["sinks"]["pipe"]["sent"] >= 2
