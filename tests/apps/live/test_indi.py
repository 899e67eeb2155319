"""INDI camera: another library's client, and Debian's, set exposures and get FITS with the solution's WCS."""

from __future__ import annotations

import asyncio
import io
import queue
import shutil
import socket
import subprocess
import sys
import threading
import time
import warnings
from collections.abc import Iterator
from typing import Any

import numpy as np
import pytest
from astropy.io import fits
from astropy.wcs import WCS
from scipy.spatial.transform import Rotation
from typer.testing import CliRunner

from skysim.apps.cli import main
from skysim.apps.live.commands import CommandState
from skysim.apps.live.pacing import Live, Pace
from skysim.apps.live.packets import Packet
from skysim.core.errors import InputError
from skysim.scene import loader
from skysim.simulation.flight import open_flight

pytest.importorskip("indipydriver")
pytest.importorskip("indipyserver")
indipyclient = pytest.importorskip("indipyclient")

from skysim.apps.live import indi  # noqa: E402

WAIT_S = 60.0
OVERRIDES = {
    "light.limit_mag": "5",
    # The WCS needs SIP polynomials.
    "camera.distortion": "[-0.1, 0.05, 1e-4, -2e-4, 0]",
    "exposure.rate_hz": "2",
}
EXPOSURE = "CCD_EXPOSURE"
SECONDS = "CCD_EXPOSURE_VALUE"


class Client:
    """A client of the library indipyclient, in a thread of its own; `events` has what it received."""

    def __init__(self, port: int) -> None:
        events: queue.Queue[Any] = queue.Queue()

        class Library(indipyclient.IPyClient):  # type: ignore[name-defined, misc]
            async def rxevent(self, event: Any) -> None:
                events.put(event)

        async def run() -> None:
            self.library = Library(indihost="127.0.0.1", indiport=port)
            self.library.enableBLOBdefault = "Also"
            self.loop = asyncio.get_running_loop()
            await self.library.asyncrun()

        self.events = events
        self.thread = threading.Thread(target=lambda: asyncio.run(run()), daemon=True)
        self.thread.start()

    def set(self, vector: str, **members: Any) -> None:
        sent = self.library.send_newVector(indi.DEVICE, vector, members=members)
        asyncio.run_coroutine_threadsafe(sent, self.loop).result(WAIT_S)

    def close(self) -> None:
        self.loop.call_soon_threadsafe(self.library.shutdown)
        self.thread.join(WAIT_S)


class Session:
    """A flight that no clock paces, its INDI camera, a client, and the packets that were sent."""

    def __init__(self) -> None:
        flight = open_flight(
            loader.load("shefex2", OVERRIDES), endless=True, keeps_history=False
        )
        commands = CommandState(flight, 0.5, has_triggers=True)
        self.live = Live(flight, Pace(0.0, 2.0), [], commands, has_truth=True)
        self.camera = indi.IndiCamera(self.live, 0)
        self.packets: list[Packet] = []
        self.live.outputs.append(self.camera.sink)
        send = self.live.send
        self.live.send = lambda packet: (self.packets.append(packet), send(packet))[1]  # type: ignore[method-assign, assignment, func-returns-value]
        self.client = Client(self.camera.port)
        self.wait("CCD1")

    def wait(self, vector: str, *states: str, flies: bool = True) -> Any:
        """The next event of a vector in one of the states, in any without; the flight goes on."""
        end_s = time.monotonic() + WAIT_S
        while time.monotonic() < end_s:
            if flies:
                self.live.advance()
            try:
                event = self.client.events.get(timeout=0.005)
            except queue.Empty:
                continue
            if event.vectorname == vector and (not states or event.state in states):
                return event
        raise AssertionError(f"no event of {vector}")

    def image(self, **exposure: float) -> tuple[Any, dict[str, Packet]]:
        """Expose; return the image that the client got, and the packets of its frame."""
        self.packets.clear()
        self.client.set(EXPOSURE, **exposure)
        # Definitions, which another client has asked for, have no image.
        while not (event := self.wait("CCD1")).data:
            pass
        with fits.open(io.BytesIO(event["CCD1"])) as found:
            image = found[0].copy()
        return image, {one.channel: one for one in self.packets}

    def close(self) -> None:
        self.client.close()
        self.camera.sink.close()
        self.camera.close()


@pytest.fixture(scope="module")
def session() -> Iterator[Session]:
    session = Session()
    session.client.set("CONNECTION", CONNECT="On", DISCONNECT="Off")
    session.wait("CONNECTION", "Ok")
    yield session
    session.close()
    assert not session.camera.thread.is_alive()


@pytest.mark.slow
def test_an_exposure_comes_back_as_fits(session: Session) -> None:
    """Pixels are the renderer's; date and exposure time are those of the frame."""
    image, packets = session.image(**{SECONDS: 0.1})
    frame = packets["frame"]
    np.testing.assert_array_equal(image.data, frame.pixels)
    assert image.header["EXPTIME"] == 0.1
    start = session.live.flight.lab.scene.start_time
    date = np.datetime64(image.header["DATE-OBS"].removesuffix("+00:00"))
    since_s = (date - np.datetime64(start.replace(tzinfo=None))) / np.timedelta64(1, "s")
    assert since_s == pytest.approx(frame.header["t_s"], abs=1e-6)


@pytest.mark.slow
def test_the_wcs_is_that_of_the_solution(session: Session) -> None:
    """On the truth's stars it is the solution's projection to 1e-3 px, and the truth within its sigma."""
    image, packets = session.image(**{SECONDS: 0.1})
    attitude = packets["solution"].attitude
    assert attitude is not None
    assert attitude.cam_from_ref is not None
    assert attitude.camera is not None
    assert attitude.covariance_rad2 is not None
    truth = packets["frame"].truth
    true_px = np.column_stack([truth["x_px"], truth["y_px"]])
    rays = attitude.camera.rays(true_px)
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        wcs = WCS(image.header)
    assert wcs.sip is not None

    def places(cam_from_ref: Rotation) -> np.ndarray:
        """Pixels by the WCS of the directions in which an attitude has the truth's stars."""
        x, y, z = cam_from_ref.inv().apply(rays).T
        sky = np.degrees([np.arctan2(y, x), np.arcsin(z)])
        return np.column_stack(wcs.all_world2pix(*sky, 0, tolerance=1e-6))

    own_px = places(attitude.cam_from_ref)
    assert len(own_px) > 5
    assert np.linalg.norm(own_px - true_px, axis=1).max() < 1e-3
    mean = Rotation.from_quat(truth["mean_cam_from_ref_xyzw"])
    error_rad = (attitude.cam_from_ref * mean.inv()).as_rotvec()
    # Five standard deviations along each of the covariance's axes.
    distance = error_rad @ np.linalg.solve(attitude.covariance_rad2, error_rad)
    assert distance < 3 * 5**2
    sigma_px = attitude.camera.focal_px * np.sqrt(np.trace(attitude.covariance_rad2))
    assert np.linalg.norm(places(mean) - true_px, axis=1).max() < 5 * sigma_px


@pytest.mark.slow
@pytest.mark.parametrize(
    ("seconds", "problem"),
    [
        ("0", "allowed: more than 0"),
        ("1e9", "to 0.5"),
        ("nan", "more than 0"),
        ("x", "not a number"),
    ],
)
def test_a_refused_exposure_says_why(session: Session, seconds: str, problem: str) -> None:
    session.client.set(EXPOSURE, **{SECONDS: seconds})
    assert problem in session.wait(EXPOSURE, "Alert").message
    session.client.set(EXPOSURE, **{SECONDS: 0.1})
    assert session.wait(EXPOSURE, "Busy").message == "exposing"
    assert session.wait(EXPOSURE, "Ok").message == "exposed"


@pytest.mark.slow
def test_without_a_connection_nothing_is_exposed(session: Session) -> None:
    session.client.set("CONNECTION", DISCONNECT="On", CONNECT="Off")
    session.wait("CONNECTION", "Idle")
    session.client.set(EXPOSURE, **{SECONDS: 0.1})
    assert (
        session.wait(EXPOSURE, "Alert").message
        == "not connected: set CONNECTION.CONNECT first"
    )
    session.client.set("CONNECTION", CONNECT="On", DISCONNECT="Off")
    session.wait("CONNECTION", "Ok")


@pytest.mark.slow
def test_an_aborted_or_replaced_exposure_gives_no_frame(session: Session) -> None:
    client = session.client
    session.packets.clear()
    client.set(EXPOSURE, **{SECONDS: 0.4})
    session.wait(EXPOSURE, "Busy", flies=False)
    client.set("CCD_ABORT_EXPOSURE", ABORT="On")
    session.wait("CCD_ABORT_EXPOSURE", "Ok", flies=False)
    for _ in range(200):
        session.live.advance()
    assert not [one for one in session.packets if one.channel == "frame"]
    client.set(EXPOSURE, **{SECONDS: 0.4})
    session.wait(EXPOSURE, "Busy", flies=False)
    image, _ = session.image(**{SECONDS: 0.05})
    assert image.header["EXPTIME"] == 0.05
    assert len([one for one in session.packets if one.channel == "frame"]) == 1


@pytest.mark.slow
@pytest.mark.skipif(not shutil.which("indi_getprop"), reason="no indi_getprop")
def test_indi_getprop_lists_the_properties(session: Session) -> None:
    command = ["indi_getprop", "-p", str(session.camera.port), "-t", "2"]
    found = subprocess.run(command, capture_output=True, text=True, check=True).stdout
    values = dict(line.split("=", 1) for line in found.splitlines())
    assert float(values["skysim.CCD_INFO.CCD_MAX_X"]) == 659
    assert float(values["skysim.CCD_INFO.CCD_PIXEL_SIZE"]) == pytest.approx(9.9)
    assert values["skysim.DRIVER_INFO.DRIVER_INTERFACE"] == "2"
    vectors = {name.split(".")[1] for name in values}
    assert vectors == set(session.camera.vectors) - {"CCD1"}  # it has no value yet


@pytest.mark.slow
def test_bad_and_leaving_clients_leave_the_server_as_it_was(session: Session) -> None:
    """More of them than the server has places."""
    for sent in (b"<no XML", b"</root><x>", b"POST / HTTP/1.1\r\n\r\n", b"\xff\0", b"") * 3:
        with socket.create_connection(("127.0.0.1", session.camera.port)) as connection:
            connection.sendall(sent)
            connection.shutdown(socket.SHUT_WR)
            connection.settimeout(WAIT_S)
            assert connection.recv(1) == b""
    for text in ("", "On"):
        bad = f"<newSwitchVector device='skysim' name='CONNECTION'><oneSwitch name='y'>{text}"
        with socket.create_connection(("127.0.0.1", session.camera.port)) as connection:
            connection.sendall(f"{bad}</oneSwitch></newSwitchVector>".encode())
    image, _ = session.image(**{SECONDS: 0.1})
    assert image.header["EXPTIME"] == 0.1


@pytest.mark.slow
def test_a_port_in_use_is_one_line(session: Session) -> None:
    with pytest.raises(InputError, match=r"--indi \d+: cannot listen on 127.0.0.1"):
        indi.IndiCamera(session.live, session.camera.port)


@pytest.mark.parametrize(
    ("celsius", "shown"), [("0", "0.0"), ("-15.5", "-15.5"), ("null", "20.0")]
)
def test_the_temperature_is_the_detector_s(celsius: str, shown: str) -> None:
    scene = loader.load("shefex2", {"camera.detector.temperature_c": celsius})
    vectors = {one.name: one for one in indi.properties(scene)}
    assert vectors["CCD_TEMPERATURE"]["CCD_TEMPERATURE_VALUE"] == shown


@pytest.mark.parametrize(
    ("scene", "status", "comment"),
    [
        ("afit_simsat", None, "the lights are in the laboratory"),
        ("shefex2", "no_match", "the tracker's status: no_match"),
    ],
)
def test_without_a_solution_there_is_no_wcs(
    scene: str, status: str | None, comment: str
) -> None:
    from estimator.core.types import Attitude

    pixels = np.arange(12, dtype="<u2").reshape(3, 4)
    head = {"channel": "frame", "index": 0, "t_s": 1.0, "exposure_s": 0.1}
    solution = Packet({}, attitude=Attitude(status) if status else None)
    data = indi.fits_bytes(Packet(head, pixels), solution, loader.load(scene))
    with fits.open(io.BytesIO(data)) as found:
        np.testing.assert_array_equal(found[0].data, pixels)
        assert "CTYPE1" not in found[0].header
        assert comment in str(found[0].header["COMMENT"])


def test_a_missing_package_is_one_line(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "indipyserver", None)
    monkeypatch.delitem(sys.modules, "skysim.apps.live.indi")
    done = CliRunner().invoke(main.app, ["live", "shefex2", "--indi", "0"])
    assert isinstance(done.exception, InputError)
    assert "indipyserver is not installed" in str(done.exception)
    assert "pip install 'skysim[indi]'" in str(done.exception)
