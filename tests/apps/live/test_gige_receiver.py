"""The receiver of a GigE Vision camera's frames: with our camera, and with Aravis' fake one, written by others."""

from __future__ import annotations

import contextlib
import io
import re
import shutil
import socket
import struct
import subprocess
import threading
import time
import zipfile
from collections.abc import Callable, Iterator
from contextlib import closing
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from skysim.apps.gui.worker.real import RealSource
from skysim.apps.live import gige, gige_receiver
from skysim.apps.live.gige import GigeCamera
from skysim.apps.live.gige_receiver import GigeReceiver
from skysim.core.errors import InputError
from skysim.core.paths import DATA
from skysim.core.types import Array
from tests.apps.live.test_gige import camera_of, live_flight, port  # noqa: F401
from tests.helpers.labpage import CHROMIUM, NARROW, Server, opened, panel, pictured

pytest_plugins = ["tests.helpers.labpage"]

FAKE = "arv-fake-gv-camera-0.8"
FAKE_SIZE = (512, 512)
NAMES = ("AcquisitionStart", "AcquisitionStop")


class Recording(GigeCamera):
    """A camera that keeps the pixels of the frames that it sends."""

    def __init__(self, *arguments: Any) -> None:
        self.made: list[Array] = []
        super().__init__(*arguments)

    def send_frame(self, packet: Any) -> None:
        self.made.append(packet.pixels)
        super().send_frame(packet)


class Holed(Recording):
    """A camera that loses, swaps or doubles a packet of two frames of three."""

    def send(self, packets: list[bytes], delay_s: float = 0.0) -> None:
        middle = len(packets) // 2
        if len(self.made) % 3 == 1:
            packets = packets[:middle] + packets[middle + 1 :]
        elif len(self.made) % 3 == 2:
            packets = [*packets[:middle], packets[middle + 1], packets[middle], packets[-1]]
        super().send(packets, delay_s)


@contextlib.contextmanager
def flying(kind: type[GigeCamera] = Recording, **more: str) -> Iterator[Any]:
    """A camera in flight."""
    live = live_flight(speed=1.0, **more)
    live.warm_up()  # compiling takes longer than the receiver waits
    with camera_of(live, 0, kind) as camera:

        def fly() -> None:
            if camera.entered.wait(60):
                live.run()

        thread = threading.Thread(target=fly)
        thread.start()
        try:
            yield camera
        finally:
            camera.entered.set()
            while thread.is_alive():
                camera.fault = "the test is over"  # until no frame that is sent clears it
                thread.join(0.1)


def address(camera: GigeCamera) -> str:
    return f"gige://127.0.0.1:{camera.port}"


@contextlib.contextmanager
def received(camera: GigeCamera) -> Iterator[GigeReceiver]:
    with closing(GigeReceiver(address(camera))) as receiver:
        yield receiver


def is_one_of(image: Array, made: list[Array], law: Callable[[Array], Array]) -> bool:
    return any(np.array_equal(image, law(one)) for one in made)


# Our camera.


@pytest.mark.parametrize(
    ("code", "dtype", "law"),
    [
        (0x01080001, "u1", lambda dn: dn // 16),  # 8 of 12 bits
        (0x01100005, "u2", lambda dn: dn),
        (0x01100007, "u2", lambda dn: dn),
    ],
)
def test_frames_are_those_of_the_camera(code: int, dtype: str, law: Any) -> None:
    with flying() as camera, received(camera) as receiver:
        camera.put(gige.PIXEL_FORMAT, code)
        for _ in range(3):
            image = receiver.frame()
            assert image.shape == (48, 64)
            assert image.dtype == dtype
            assert is_one_of(image, camera.made, law)
            assert image.any()


def test_a_frame_with_a_hole_is_never_given() -> None:
    with flying(Holed) as camera, received(camera) as receiver:
        for _ in range(4):
            image = receiver.frame()
            number = [np.array_equal(image, one) for one in camera.made].index(True)
            assert number % 3 == 2  # the first two of three were damaged on the way


def test_what_came_before_is_old(monkeypatch: pytest.MonkeyPatch) -> None:
    with flying() as camera, received(camera) as receiver:
        receiver.frame()
        time.sleep(0.5)
        count = len(camera.made)
        assert count > 5
        image = receiver.frame()
        assert is_one_of(image, camera.made[count - 1 :], lambda dn: dn)


def test_the_control_is_kept_given_back_and_taken_again() -> None:
    with flying() as camera:
        with received(camera) as receiver:
            receiver.frame()
            assert camera.controller == receiver.control.getsockname()
            # It was busy: the camera has given it up, and closed the stream.
            camera.release()
            assert not camera.channels
            receiver.frame()
            assert camera.controller == receiver.control.getsockname()
        assert camera.controller is None
        assert not camera.channels
        assert camera.value(gige.STREAM_PORT) == 0
        with received(camera) as receiver:
            receiver.frame()


def test_a_long_wait_for_a_frame_keeps_the_control() -> None:
    """The scene exposes no frame before a trigger; the camera's timeout is shorter than the wait for it."""
    with camera_of(live_flight(trigger=True)) as camera, received(camera) as receiver:
        camera.put(gige.HEARTBEAT, 500)
        found: list[str] = []

        def wait() -> None:
            try:
                receiver.frame()
            except InputError as error:
                found.append(str(error))

        with pytest.MonkeyPatch.context() as patch:
            patch.setattr(gige_receiver, "PATIENCE_S", 2.0)
            thread = threading.Thread(target=wait)
            thread.start()
            time.sleep(1.5)
            assert camera.controller == receiver.control.getsockname()
            thread.join(20)
    assert found == [
        f"{address(camera)}: no whole frame in 2 s; allowed: a camera whose trigger mode is off"
    ]


def test_a_camera_of_another_application_is_refused_by_one_line() -> None:
    with flying() as camera, received(camera) as receiver, received(camera) as other:
        receiver.frame()
        with pytest.raises(InputError) as refused:
            other.frame()
        assert str(refused.value) == (
            f"{address(camera)}: answers 0x0082 by status 0x8006; allowed: a camera that no other application"
            " controls (status 0x8006)"
        )
        other.close()
        assert camera.controller == receiver.control.getsockname()


def test_no_answer_is_one_line() -> None:
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as silent:
        silent.bind(("127.0.0.1", 0))
        source = f"gige://127.0.0.1:{silent.getsockname()[1]}"
        began_s = time.monotonic()
        with closing(GigeReceiver(source)) as receiver, pytest.raises(InputError) as refused:
            receiver.frame()
        assert time.monotonic() - began_s < 10
    assert str(refused.value).startswith(f"{source}: no GigE Vision camera answers")


@pytest.mark.parametrize(
    "source", ["gige://", "gige://host.invalid", "gige://127.0.0.1:99999", "gige://a:b:c"]
)
def test_what_is_no_address_is_refused(source: str) -> None:
    with pytest.raises(InputError) as refused:
        GigeReceiver(source)
    assert str(refused.value).startswith(f"{source}: no such address")


@pytest.mark.parametrize(
    ("field", "value"),
    [("kind", 4), ("code", 0x010C0006), ("code", 0x02180014), ("padding", 2)],
)
def test_frames_of_another_kind_are_refused(field: str, value: int) -> None:
    """Other payloads than images, packed and color pixels, padding."""
    fields = {"kind": 1, "t": 0, "code": 0x01080001, "width": 3, "height": 2, "padding": 0}
    leader = struct.pack(">IQIII8xI", *(fields | {field: value}).values())
    receiver = GigeReceiver("gige://127.0.0.1")
    with receiver.control, receiver.stream:
        receiver.take(struct.pack(">HHI", 0, 1, 1 << 24) + leader)
        receiver.take(struct.pack(">HHI", 0, 1, 3 << 24 | 1) + bytes(6))
        with pytest.raises(
            InputError, match=r"sends payload 0x.*allowed: Mono of \[8, 12, 16\] bits"
        ):
            receiver.take(struct.pack(">HHI", 0, 1, 2 << 24 | 2) + bytes(8))


def test_strange_packets_make_no_frame_and_spoil_none() -> None:
    """Of other frames, too short, out of their order, doubled: before, between and after a whole frame's."""
    head = struct.Struct(">HHI")
    pixels = np.arange(12, dtype="<u2").reshape(3, 4)
    leader = struct.pack(">IQIII8xI", 1, 0, 0x01100007, 4, 3, 0)
    whole = [
        head.pack(0, 7, 1 << 24) + leader,
        head.pack(0, 7, 3 << 24 | 1) + pixels.tobytes()[:16],
        head.pack(0, 7, 3 << 24 | 2) + pixels.tobytes()[16:],
        head.pack(0, 7, 2 << 24 | 3) + bytes(8),
    ]
    strange = [
        b"",
        b"\0" * 7,
        head.pack(0, 6, 3 << 24 | 2) + b"late",
        head.pack(0, 7, 3 << 24 | 9) + b"beyond",
        head.pack(0, 0xFFFF, 2 << 24 | 0xFFFFFF),
        head.pack(0, 7, 2 << 24 | 0),
    ]
    receiver = GigeReceiver("gige://127.0.0.1")
    with receiver.control, receiver.stream:
        for packet in (*strange, *whole[2:]):
            assert receiver.take(packet) is None
        for packet in whole[:3]:
            assert receiver.take(packet) is None
            for other in strange:
                assert receiver.take(other) is None
            if packet is not whole[0]:
                assert receiver.take(packet) is None
        np.testing.assert_array_equal(receiver.take(whole[3]), pixels)
        for packet in whole[1:]:
            assert receiver.take(packet) is None
        # A frame that is shorter than its leader says is none.
        for packet in (whole[0], whole[1], head.pack(0, 7, 2 << 24 | 2) + bytes(8)):
            assert receiver.take(packet) is None


# GenICam files.


def registers_of(data: bytes, place: bytes = b"") -> list[tuple[int, int]]:
    """The registers by a camera with this file."""
    with camera_of(live_flight()) as camera, received(camera) as receiver:
        camera.memory[gige.XML :] = data.ljust(gige.XML_BYTES, b"\0")
        place = place or b"Local:x;%x;%X" % (gige.XML, len(data))
        camera.memory[gige.XML_ADDRESS : gige.XML_ADDRESS + 512] = place.ljust(512, b"\0")
        return list(receiver.commands(*NAMES))


def xml() -> bytes:
    return (DATA / "gige_camera.xml").read_bytes()


def test_a_packed_genicam_file_is_read_as_the_plain_one() -> None:
    registers = [(gige.START, 1), (gige.STOP, 1)]
    assert registers_of(xml()) == registers
    with io.BytesIO() as file:
        with zipfile.ZipFile(file, "w", zipfile.ZIP_DEFLATED) as packed:
            packed.writestr("camera.xml", xml())
        assert registers_of(file.getvalue()) == registers


@pytest.mark.parametrize(
    ("old", "new"),
    [
        (b"<Address>0xA03C</Address>", b"<Address>0xA03C</Address><pAddress>Base</pAddress>"),
        (b"<Address>0xA03C</Address>", b"<Address>8</Address><pIndex>Selector</pIndex>"),
        (
            b"<Address>0xA03C</Address>",
            b"<IntSwissKnife><Formula>8</Formula></IntSwissKnife>",
        ),
        (b"<pValue>AcquisitionStartReg</pValue>", b"<pValue>A'][']</pValue>"),
        (b'<Command Name="AcquisitionStart"', b'<Command Name="Other"'),
        (b"</RegisterDescription>", b""),
    ],
)
def test_a_file_without_plain_registers_is_refused_by_one_line(
    old: bytes, new: bytes
) -> None:
    assert old in xml()
    with pytest.raises(InputError, match="no GenICam file in it with plain registers") as no:
        registers_of(xml().replace(old, new))
    assert "\n" not in str(no.value)


@pytest.mark.parametrize(
    "place", [b"File:C:\\x.xml", b"http://x/y.xml", b"Local:x;FFFFFFF0;400000", b"\0"]
)
def test_a_file_that_is_not_in_the_camera_is_refused(place: bytes) -> None:
    with pytest.raises(InputError, match="no GenICam file in it"):
        registers_of(xml(), place)


# The page's source.


def test_the_page_reads_it_like_its_other_sources() -> None:
    with flying() as camera:
        source = RealSource(address(camera))
        name, picture = source.picture() or ("", None)
        assert name == "camera"
        assert picture is not None
        assert is_one_of(picture.pixels, camera.made, lambda dn: dn)
        source.close()
        assert camera.controller is None


@pytest.mark.browser
@pytest.mark.skipif(not CHROMIUM, reason="Chromium is not installed")
def test_the_page_compares_its_frames_with_the_simulation(
    browser: Any, tmp_path: Path
) -> None:
    size = {"camera.width_px": "659", "camera.height_px": "493", "exposure.rate_hz": "4"}
    with (
        flying(**size, **{"exposure.time": "40 ms"}) as camera,
        Server(tmp_path, "--camera", address(camera)) as server,
        opened(browser, server.login, NARROW) as page,
    ):
        panel(page, "Image")
        page.get_by_role("checkbox", name="as the scene's camera").click()
        page.get_by_role("button", name="Watch").click()
        page.get_by_text(re.compile("^camera: solved, [0-9]+ of [0-9]+ lights")).wait_for()
        assert camera.controller
        page.get_by_role("button", name="Stop").click()
        page.get_by_role("button", name="Watch").wait_for()
        assert camera.controller is None
        pictured(page, "gige_camera")


# Aravis' fake camera.


@contextlib.contextmanager
def fake_camera(*options: str) -> Iterator[None]:
    if not shutil.which(FAKE):
        pytest.skip(f"needs {FAKE}; Debian's aravis-tools")
    with subprocess.Popen([FAKE, "-i", "127.0.0.1", *options]) as process:
        try:
            time.sleep(1)
            yield
        finally:
            process.kill()


def is_ramp(image: Array) -> bool:
    """Aravis' test picture: a pixel is x + y + the number of the frame, in 8 bits."""
    y, x = np.indices(FAKE_SIZE)
    return image.shape == FAKE_SIZE and np.array_equal(image, (x + y + image[0, 0]) % 255)


@pytest.mark.slow
@pytest.mark.usefixtures("port")
@pytest.mark.parametrize("lost_per_mille", [0, 2])
def test_frames_of_aravis_camera_are_whole(lost_per_mille: int) -> None:
    """With 180 packets a frame, every third frame has a hole at 2 lost packets of a thousand."""
    with (
        fake_camera("-r", str(lost_per_mille)),
        closing(GigeReceiver("gige://127.0.0.1")) as receiver,
    ):
        images = [receiver.frame() for _ in range(20)]
        assert all(is_ramp(image) for image in images)
        starts = [int(image[0, 0]) for image in images]
        steps = np.diff(starts) % 255
        assert np.all(steps >= 1)
        receiver.close()
        with closing(GigeReceiver("gige://127.0.0.1")) as again:
            assert is_ramp(again.frame())
