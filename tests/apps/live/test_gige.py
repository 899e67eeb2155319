"""The GigE Vision camera: registers, privilege, frames and triggers; Aravis receives the renderer's bytes."""

from __future__ import annotations

import contextlib
import fcntl
import hashlib
import json
import shutil
import signal
import socket
import struct
import subprocess
import sys
import tempfile
import threading
import time
import xml.etree.ElementTree as ElementTree
from collections.abc import Iterator
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from typer.testing import CliRunner

from skysim.apps.cli import main
from skysim.apps.live import gige
from skysim.apps.live.commands import CommandState
from skysim.apps.live.gige import GVCP_PORT, GigeCamera, GvcpStatus
from skysim.apps.live.pacing import Live, Pace
from skysim.core.errors import InputError
from skysim.core.paths import DATA
from skysim.scene import loader
from skysim.simulation.flight import open_flight

RATE_HZ = 20
SMALL = {
    "camera.width_px": "64",
    "camera.height_px": "48",
    "exposure.rate_hz": str(RATE_HZ),
    "exposure.time": "4 ms",
}
CLIENT = ("127.0.0.1", 50000)
OTHER = ("127.0.0.1", 50001)
SYSTEM_PYTHON = "/usr/bin/python3"


def live_flight(trigger: bool = False, speed: float = 0.0, **more: str) -> Live:
    flight = open_flight(
        loader.load("shefex2", SMALL | more), keeps_history=False, endless=True
    )
    return Live(flight, Pace(speed, RATE_HZ), [], CommandState(flight, 0.5, trigger))


@contextlib.contextmanager
def camera_of(
    live: Live, port: int = 0, kind: type[GigeCamera] = GigeCamera
) -> Iterator[Any]:
    camera = kind(live, "127.0.0.1", port)
    live.outputs.append(camera)
    try:
        yield camera
    finally:
        camera.close()


@pytest.fixture
def camera() -> Iterator[GigeCamera]:
    with camera_of(live_flight()) as camera:
        yield camera


class Client:
    """An application's datagrams, given to the camera without a network."""

    def __init__(self, camera: GigeCamera, address: gige.Sender = CLIENT) -> None:
        self.camera = camera
        self.address = address
        self.number = 0
        self.now_s = time.monotonic()

    def send(self, command: int, payload: bytes = b"", length: int | None = None) -> bytes:
        """Send a command; return its status and data."""
        self.number += 1
        head = struct.pack(
            ">BBHHH",
            0x42,
            1,
            command,
            len(payload) if length is None else length,
            self.number,
        )
        answer = self.camera.answer(head + payload, self.address, self.now_s)
        assert answer is not None
        status, answered, size, number = struct.unpack_from(">4H", answer)
        assert (answered, size, number) == (command + 1, len(answer) - 8, self.number)
        return struct.pack(">H", status) + answer[8:]

    def status(self, command: int, payload: bytes = b"", length: int | None = None) -> int:
        return int.from_bytes(self.send(command, payload, length)[:2])

    def write(self, address: int, value: int) -> int:
        return self.status(gige.WRITEREG, struct.pack(">II", address, value))

    def write_exposure_us(self, value: float) -> int:
        return self.status(gige.WRITEMEM, struct.pack(">Id", gige.EXPOSURE_US, value))

    def read(self, address: int) -> int:
        answer = self.send(gige.READREG, struct.pack(">I", address))
        assert answer[:2] == b"\0\0"
        return int.from_bytes(answer[2:])

    def read_double(self, address: int) -> float:
        answer = self.send(gige.READMEM, struct.pack(">II", address, 8))
        return float(struct.unpack(">d", answer[6:])[0])

    def control(self) -> Client:
        assert self.write(gige.PRIVILEGE, gige.CONTROL) == 0
        assert self.write(gige.HEARTBEAT, 600_000) == 0
        return self


# Registers


def test_the_xml_is_well_formed_and_every_register_of_it_is_there(camera: GigeCamera) -> None:
    """Of every register that a client may use, the bytes can be read, and those of RW and WO can be written."""
    tree = ElementTree.parse(DATA / "gige_camera.xml")
    space = {"g": "http://www.genicam.org/GenApi/Version_1_1"}
    names = {node.get("Name") for node in tree.iter() if node.get("Name")}
    for pointer in ("pValue", "pMax", "pFeature"):
        assert {node.text for node in tree.iterfind(f".//g:{pointer}", space)} <= names
    registers = [
        node for node in tree.iter() if node.tag.endswith("Reg") or "Address" in node
    ]
    for node in (one for one in tree.iter() if one.find("g:Address", space) is not None):
        address = int(node.findtext("g:Address", "", space), 16)
        length = int(node.findtext("g:Length", "", space))
        assert len(camera.read(address, length)) == length
        is_writable = node.findtext("g:AccessMode", "", space) != "RO"
        assert is_writable == (address in gige.WRITABLE), node.get("Name")
    assert registers


def test_discovery_tells_names_and_the_xml_where_it_is(camera: GigeCamera) -> None:
    client = Client(camera)
    data = client.send(gige.DISCOVERY)[2:]
    assert len(data) == 248
    assert data[0x48:0x68].rstrip(b"\0") == b"skysim"
    assert data[0xE8:].rstrip(b"\0") == b"shefex2"
    assert socket.inet_ntoa(data[0x24:0x28]) == "127.0.0.1"
    url = client.send(gige.READMEM, struct.pack(">II", 0x200, 512))[6:].rstrip(b"\0").decode()
    place, name, first, size = url.replace(":", ";").split(";")
    assert (place, name) == ("Local", "gige_camera.xml")
    at, end = int(first, 16), int(first, 16) + int(size, 16)
    parts = [
        client.send(gige.READMEM, struct.pack(">II", one, min(512, end - one)))[6:]
        for one in range(at, end, 512)
    ]
    assert b"".join(parts).rstrip(b"\n") == (DATA / "gige_camera.xml").read_bytes().rstrip()


@pytest.mark.parametrize(
    ("command", "payload", "status"),
    [
        (gige.READREG, struct.pack(">I", 0x0F00), GvcpStatus.INVALID_ADDRESS),
        (gige.READREG, struct.pack(">I", 0xA04C), GvcpStatus.INVALID_ADDRESS),
        (gige.READREG, struct.pack(">I", 0xA001), GvcpStatus.BAD_ALIGNMENT),
        (gige.READREG, b"123", GvcpStatus.INVALID_HEADER),
        (gige.READMEM, struct.pack(">II", 0x10000, 600), GvcpStatus.INVALID_PARAMETER),
        (gige.READMEM, struct.pack(">II", 0, 250), GvcpStatus.BAD_ALIGNMENT),
        (gige.READMEM, struct.pack(">II", 0xF4, 8), GvcpStatus.INVALID_ADDRESS),
        (gige.WRITEREG, struct.pack(">II", 0x0F00, 1), GvcpStatus.INVALID_ADDRESS),
        (gige.WRITEREG, struct.pack(">II", 0xA000, 9), GvcpStatus.WRITE_PROTECT),
        (
            gige.WRITEREG,
            struct.pack(">II", gige.PIXEL_FORMAT, 9),
            GvcpStatus.INVALID_PARAMETER,
        ),
        (
            gige.WRITEREG,
            struct.pack(">II", gige.ACQUISITION_MODE, 2),
            GvcpStatus.INVALID_PARAMETER,
        ),
        (gige.WRITEREG, struct.pack(">II", gige.TRIGGER, 1), GvcpStatus.WRITE_PROTECT),
        (
            gige.WRITEREG,
            struct.pack(">II", gige.PACKET_SIZE, 60),
            GvcpStatus.INVALID_PARAMETER,
        ),
        (gige.WRITEREG, struct.pack(">II", 0xA010, 1), GvcpStatus.INVALID_HEADER),
        (gige.WRITEMEM, struct.pack(">Id", 0xA020, 1.0), GvcpStatus.WRITE_PROTECT),
        (gige.WRITEMEM, b"12", GvcpStatus.INVALID_HEADER),
        (0x0100, b"", GvcpStatus.NOT_IMPLEMENTED),
    ],
)
def test_a_refused_command_says_why_and_changes_nothing(
    camera: GigeCamera, command: int, payload: bytes, status: int
) -> None:
    client = Client(camera).control()
    camera.refresh()
    before = bytes(camera.memory)
    assert client.status(command, payload) == status
    assert bytes(camera.memory) == before
    assert not camera.live.inbox.waiting


def test_a_forced_address_and_what_is_no_command_are_ignored(camera: GigeCamera) -> None:
    for datagram in (
        struct.pack(">BBHHH", 0x42, 1, 4, 56, 1) + bytes(56),
        b"\x42\1\0",
        b"A" * 8,
    ):
        assert camera.answer(datagram, CLIENT, 0.0) is None


def test_a_broadcast_only_finds_a_camera_and_only_from_where_it_can_be_reached(
    camera: GigeCamera, monkeypatch: pytest.MonkeyPatch
) -> None:
    heard: list[bytes] = []
    monkeypatch.setattr(camera, "answer", lambda datagram, *_: heard.append(datagram))
    discovery = struct.pack(">BBHHH", 0x42, 0x11, gige.DISCOVERY, 0, 1)
    reading = struct.pack(">BBHHHI", 0x42, 1, gige.READREG, 4, 1, 0)
    camera.reply(discovery, ("192.0.2.9", 1), True)
    camera.reply(reading, CLIENT, True)
    assert not heard
    camera.reply(discovery, CLIENT, True)
    camera.is_local = False
    camera.reply(discovery, ("192.0.2.9", 1), True)
    assert heard == [discovery] * 2


def test_a_command_of_another_length_than_it_says_is_refused(camera: GigeCamera) -> None:
    client = Client(camera)
    assert client.status(gige.READREG, bytes(4), 8) == GvcpStatus.INVALID_HEADER


@pytest.mark.parametrize("exposure_us", [-1.0, 0.0, 1e9, np.nan, np.inf])
def test_a_refused_exposure_does_not_stay_in_the_register(
    camera: GigeCamera, exposure_us: float
) -> None:
    client = Client(camera).control()
    assert client.write_exposure_us(3000) == 0
    assert client.write_exposure_us(exposure_us) == GvcpStatus.INVALID_PARAMETER
    assert client.read_double(gige.EXPOSURE_US) == pytest.approx(3000, rel=1e-12)


def test_the_exposure_reads_as_written_before_and_after_the_flight_takes_it(
    camera: GigeCamera,
) -> None:
    client = Client(camera).control()
    live = camera.live
    assert client.read_double(gige.EXPOSURE_US) == pytest.approx(4000, rel=1e-12)
    assert client.write_exposure_us(client.read_double(gige.LONGEST_US)) == 0  # the longest
    assert client.write_exposure_us(2500) == 0
    assert client.read_double(gige.EXPOSURE_US) == pytest.approx(2500, rel=1e-12)
    live.commands.receive(live.inbox)
    assert live.flight.schedules[0].exposure_control.exposure_s == pytest.approx(
        2.5e-3, 1e-12
    )
    assert client.read_double(gige.EXPOSURE_US) == pytest.approx(2500, rel=1e-12)
    live.inbox.put({"exposure_s": "text"}, lambda _: None)  # another client's, yet unchecked
    assert client.read_double(gige.EXPOSURE_US) == pytest.approx(2500, rel=1e-12)


def test_zero_degrees_is_a_temperature() -> None:
    for detector, celsius in (({"camera.detector.temperature_c": "0"}, 0.0), ({}, 20.0)):
        with camera_of(live_flight(**detector)) as camera:
            assert Client(camera).read_double(gige.CELSIUS) == celsius


def test_a_camera_without_noise_is_refused() -> None:
    with pytest.raises(InputError, match="--gige: a camera without noise"):
        GigeCamera(live_flight(**{"camera.detector.noise": "false"}), "127.0.0.1", 0)


def test_an_address_that_is_taken_is_refused(camera: GigeCamera) -> None:
    with pytest.raises(InputError, match=r"cannot serve on 127\.0\.0\.1"):
        GigeCamera(camera.live, "127.0.0.1", camera.port)


# Privilege


def test_one_application_controls_until_it_leaves(camera: GigeCamera) -> None:
    client, other = Client(camera), Client(camera, OTHER)
    assert client.write(gige.PACKET_SIZE, 1000) == GvcpStatus.ACCESS_DENIED
    client.control()
    assert client.write(gige.PACKET_SIZE, 1000) == 0
    assert other.write(gige.PACKET_SIZE, 2000) == GvcpStatus.ACCESS_DENIED
    assert other.write(gige.PRIVILEGE, gige.CONTROL) == GvcpStatus.ACCESS_DENIED
    assert other.write(gige.PRIVILEGE, 0) == GvcpStatus.ACCESS_DENIED
    assert other.read(gige.PACKET_SIZE) == 1000
    assert client.write(gige.PRIVILEGE, gige.EXCLUSIVE) == 0
    assert other.status(gige.READREG, bytes(4)) == GvcpStatus.ACCESS_DENIED
    assert other.status(gige.DISCOVERY) == 0
    assert client.write(gige.PRIVILEGE, 0) == 0
    other.control()


def test_an_application_that_is_not_heard_loses_the_control(camera: GigeCamera) -> None:
    client = Client(camera).control()
    client.write(gige.HEARTBEAT, 500)
    client.write(gige.STREAM_PORT, 4000)
    client.write(gige.START, 1)
    for _ in range(3):
        client.now_s += 0.4
        assert client.read(gige.PRIVILEGE) == gige.CONTROL
    assert camera.channels
    # The camera's own thread sees it, without a datagram. Its clock is that of the client's last one.
    camera.heard_s = time.monotonic() - 0.4
    deadline_s = time.monotonic() + 10
    while camera.channels and time.monotonic() < deadline_s:
        time.sleep(0.02)
    assert not camera.channels
    assert client.read(gige.PRIVILEGE) == 0
    assert client.read(gige.STREAM_PORT) == 0


# Frames


def frames_of(camera: GigeCamera, periods: int) -> list[Any]:
    """Packets of the frames of some control periods."""
    kept: list[Any] = []
    camera.write = kept.append
    for _ in range(periods):
        camera.live.advance()
    deadline_s = time.monotonic() + 10
    while camera.packets and time.monotonic() < deadline_s:
        time.sleep(0.01)
    return kept


def assembled(packets: list[bytes]) -> tuple[dict[str, Any], bytes]:
    """Leader's values and pixels of a block, read by the standard's layout."""
    heads = [struct.unpack_from(">HHI", one) for one in packets]
    assert {(status, block) for status, block, _ in heads} == {(0, heads[0][1])}
    kinds = [one >> 24 for *_, one in heads]
    assert kinds == [1, *[3] * (len(packets) - 2), 2]
    assert [one & 0xFFFFFF for *_, one in heads] == list(range(len(packets)))
    _, kind, t_ns, code, width, height, x, y, _, _ = struct.unpack(
        ">HHQIIIIIHH", packets[0][8:]
    )
    assert (kind, x, y) == (1, 0, 0)
    assert struct.unpack(">HHI", packets[-1][8:]) == (0, 1, height)
    return {"t_ns": t_ns, "code": code, "shape": (height, width)}, b"".join(
        one[8:] for one in packets[1:-1]
    )


@pytest.mark.parametrize(
    ("code", "dtype", "law"),
    [
        (0x01080001, "u1", lambda dn: dn // 16),  # 8 of 12 bits
        (0x01100005, "<u2", lambda dn: dn),
        (0x01100007, "<u2", lambda dn: dn),
    ],
)
def test_packets_hold_the_pixels_by_the_law_of_their_format(
    camera: GigeCamera, code: int, dtype: str, law: Any
) -> None:
    client = Client(camera).control()
    assert client.write(gige.PIXEL_FORMAT, code) == 0
    assert client.write(gige.PACKET_SIZE, 576) == 0
    client.write(gige.START, 1)
    assert client.write(gige.PIXEL_FORMAT, code) == GvcpStatus.WRITE_PROTECT
    (frame, *_) = frames_of(camera, 12)
    packets = camera.packets_of(frame)
    assert max(map(len, packets)) == 576 - 28
    leader, data = assembled(packets)
    assert leader == {
        "t_ns": round(1e9 * frame.header["t_s"]),
        "code": code,
        "shape": (48, 64),
    }
    assert len(data) == client.read(gige.PAYLOAD_BYTES)
    assert np.frombuffer(data, dtype).tolist() == law(frame.pixels.ravel()).tolist()


def test_single_frame_stops_after_one(camera: GigeCamera) -> None:
    client = Client(camera).control()
    assert client.write(gige.ACQUISITION_MODE, 1) == 0
    assert not frames_of(camera, 20)  # not started
    for _ in range(2):
        assert client.write(gige.START, 1) == 0
        started_s = camera.live.flight.now_s
        (frame,) = frames_of(camera, 30)
        assert frame.header["t_s"] > started_s
        assert not camera.channels


def test_triggers_take_the_place_of_the_schedule_and_give_it_back(camera: GigeCamera) -> None:
    client = Client(camera).control()
    client.write(gige.START, 1)
    scheduled = frames_of(camera, 30)
    assert len(scheduled) >= 3
    assert client.write(gige.TRIGGER_MODE, 1) == 0
    assert client.read(gige.TRIGGER_MODE) == 1
    assert not frames_of(camera, 30)
    now_s = camera.live.flight.now_s
    assert client.write(gige.TRIGGER, 1) == 0
    # The same datagram again is a second try: the trigger is not taken twice.
    client.number -= 1
    assert client.write(gige.TRIGGER, 1) == 0
    (frame,) = frames_of(camera, 30)
    assert frame.header["t_s"] == pytest.approx(now_s + 2e-3, abs=1e-9)
    assert client.write(gige.TRIGGER_MODE, 0) == 0
    again = frames_of(camera, 30)
    assert client.read(gige.TRIGGER_MODE) == 0
    first_s = scheduled[0].header["t_s"]
    steps = [(one.header["t_s"] - first_s) * RATE_HZ for one in again]
    assert len(again) >= 3
    np.testing.assert_allclose(steps, np.round(steps), atol=1e-6)
    assert np.all(np.diff(np.round(steps)) == 1)
    indices = [one.header["index"] for one in (*scheduled, frame, *again)]
    assert indices == list(range(indices[0], indices[0] + len(indices)))
    assert camera.live.commands.refused == 0


def test_lost_packets_come_again_while_they_are_kept(camera: GigeCamera) -> None:
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as receiver:
        receiver.bind(("127.0.0.1", 0))
        receiver.settimeout(10)
        client = Client(camera).control()
        client.write(gige.STREAM_ADDRESS, 0x7F000001)
        client.write(gige.STREAM_PORT, receiver.getsockname()[1])
        client.write(gige.ACQUISITION_MODE, 1)
        client.write(gige.START, 1)
        for _ in range(12):
            camera.live.advance()
        packets = [receiver.recv(2000) for _ in range(7)]
        assembled(packets)
        resend = struct.pack(">BBHHHHHII", 0x42, 0, gige.PACKETRESEND, 12, 9, 0, 1, 2, 3)
        assert camera.answer(resend, OTHER, client.now_s) is None
        assert [receiver.recv(2000) for _ in range(2)] == packets[2:4]
        resend = struct.pack(">BBHHHHHII", 0x42, 0, gige.PACKETRESEND, 12, 9, 0, 7, 2, 3)
        assert camera.answer(resend, OTHER, client.now_s) is None
        assert camera.answer(resend[:-1], OTHER, client.now_s) is None
        receiver.setblocking(False)
        with pytest.raises(BlockingIOError):
            receiver.recv(2000)


def test_any_datagram_is_answered_or_ignored(camera: GigeCamera) -> None:
    """Over the network, by the camera's own thread, which is alive after them."""
    rng = np.random.default_rng(7)
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as client:
        client.connect((camera.host, camera.port))
        client.settimeout(10)
        for size in rng.integers(0, 40, 200):
            data = bytearray(rng.bytes(size))
            data[:1] = b"\x42"
            client.send(data)
        client.send(struct.pack(">BBHHH", 0x42, 1, gige.DISCOVERY, 0, 0xFFFF))
        while client.recv(2000)[2:] != struct.pack(">HHH", 3, 248, 0xFFFF) + bytes(
            camera.memory[:248]
        ):
            pass


# Aravis


@cache
def aravis_problem() -> str:
    """Why Aravis cannot be used; empty if it can."""
    for program in ("arv-tool-0.8", SYSTEM_PYTHON):
        if not shutil.which(program):
            return f"needs {program}; Debian's aravis-tools-cli, python3"
    check = "import gi; gi.require_version('Aravis', '0.8'); from gi.repository import Aravis"
    done = subprocess.run([SYSTEM_PYTHON, "-c", check], capture_output=True, check=False)
    return "needs Debian's python3-gi and gir1.2-aravis-0.8" if done.returncode else ""


@pytest.fixture
def port() -> Iterator[None]:
    """The one port of GigE Vision, of which all tests of a machine take turns."""
    if aravis_problem():
        pytest.skip(aravis_problem())
    with (Path(tempfile.gettempdir()) / "skysim-gige.lock").open("w") as lock:
        fcntl.flock(lock, fcntl.LOCK_EX)
        yield


class Lossy(GigeCamera):
    """A camera that loses every 97th packet."""

    count = 0
    resent = 0

    def resend(self, *words: int) -> None:
        self.resent += 1
        super().resend(*words)

    def send(self, packets: list[bytes], delay_s: float = 0.0) -> None:
        kept = []
        for packet in packets:
            self.count += 1
            if self.count % 97:
                kept.append(packet)
        super().send(kept, delay_s)


@pytest.mark.slow
@pytest.mark.usefixtures("port")
@pytest.mark.parametrize("kind", [GigeCamera, Lossy])
def test_aravis_receives_a_hundred_frames_as_the_renderer_makes_them(
    kind: type[GigeCamera],
) -> None:
    """With an exposure time that Aravis has set; with lost packets, all are sent again."""
    live = live_flight(speed=1.0)
    features = {"ExposureTime": 6000.0, "GevSCPSPacketSize": 576, "PixelFormat": "Mono16"}
    with camera_of(live, GVCP_PORT, kind) as camera:

        def fly() -> None:
            if camera.entered.wait(60):
                live.run()

        flying = threading.Thread(target=fly)
        flying.start()
        client = Path(__file__).parents[2] / "helpers" / "aravis_client.py"
        done = subprocess.run(
            [SYSTEM_PYTHON, str(client), json.dumps(features), "100"],
            capture_output=True,
            text=True,
            timeout=100,
            check=False,
        )
        camera.fault = "the test is over"
        camera.entered.set()
        flying.join(20)
    assert done.returncode == 0, done.stderr
    received = [json.loads(line) for line in done.stdout.splitlines()]
    assert len(received) == 100
    assert {one["status"] for one in received} == {"success"}
    if isinstance(camera, Lossy):
        assert camera.resent > 10
    flight = open_flight(loader.load("shefex2", SMALL | {"exposure.frames": "2000"}))
    flight.schedules[0].exposure_control.exposure_s = 6e-3
    wanted = {one["t_ns"]: one["digest"] for one in received}
    assert len(wanted) == 100
    with flight:
        for shot in flight.shots(cameras=[0], solves=False):
            digest = wanted.pop(round(1e9 * shot.frame.t_mid_s), None)
            assert digest in (None, hashlib.sha256(shot.frame.image_dn.tobytes()).hexdigest())
            if not wanted:
                break
    assert not wanted


@pytest.mark.slow
@pytest.mark.usefixtures("port")
def test_the_command_line_serves_a_camera_that_aravis_lists_and_reads() -> None:
    overrides = [word for item in SMALL.items() for word in ("--set", "=".join(item))]
    words = ["live", "shefex2", "--gige", "--host", "localhost", "--endless", *overrides]
    with subprocess.Popen(
        [Path(sys.executable).with_name("skysim"), *words], stderr=subprocess.PIPE, text=True
    ) as flight:
        assert flight.stderr is not None
        line = flight.stderr.readline()
        assert line == f"skysim live: gige 127.0.0.1:{GVCP_PORT}   (Ctrl-C ends it)\n"
        listed = subprocess.run("arv-tool-0.8", capture_output=True, text=True, check=True)
        tool = ["arv-tool-0.8", "-a", "127.0.0.1"]
        values = subprocess.run([*tool, "values"], capture_output=True, text=True, check=True)
        changed = subprocess.run(
            [*tool, "control", "ExposureTime=2000", "Width", "ExposureTime", "TriggerMode"],
            capture_output=True,
            text=True,
            check=True,
        )
        flight.send_signal(signal.SIGINT)
        flight.wait(20)
    assert "skysim-star camera-" in listed.stdout
    assert "(127.0.0.1)" in listed.stdout
    for text in ("'Width' = 64", "'Height' = 48", "'DeviceTemperature' = 20 C", "'Mono12'"):
        assert text in values.stdout
    assert "ExposureTime = 2000" in changed.stdout
    assert "Width = 64" in changed.stdout
    assert not changed.stderr


def test_options_of_a_server_need_one() -> None:
    run = CliRunner().invoke
    done = run(main.app, ["live", "shefex2", "--folder", "x", "--trigger"])
    assert "--trigger: has no effect without --tcp or --gige" in str(done.exception)
