"""INDI camera of a live flight, for programs of astronomers such as KStars/Ekos and CCDciel.

An exposure that a client sets is triggered, and comes back as FITS: under the stars with the WCS of the tracker's
solution. INDI has no token, so the server listens on the loopback address only.
"""

from __future__ import annotations

import asyncio
import io
import logging
import time
from typing import Any

from indipydriver import (
    BLOBMember,
    BLOBVector,
    Device,
    IPyDriver,
    NumberMember,
    NumberVector,
    SwitchMember,
    SwitchVector,
    TextMember,
    TextVector,
)
from indipyserver import IPyServer

from skysim.apps.access import HOST, listen
from skysim.apps.live.pacing import Live
from skysim.apps.live.packets import CLOSE_TIMEOUT_S, Packet, Sink, start_thread
from skysim.apps.plate_solver.plate_solution import wcs_header
from skysim.camera.detector import saturation_dn
from skysim.core.types import Frame
from skysim.results.files.recording import fits_image
from skysim.scene.scene import Scene
from skysim.simulation.lab import longest_live_s

DEVICE = "skysim"
GROUP = "Main"
CCD_INTERFACE = "2"  # the bit of a camera in DRIVER_INTERFACE
MOST_CLIENTS = 10  # the most that IPyServer takes
EXPOSURE = "CCD_EXPOSURE"
SECONDS = "CCD_EXPOSURE_VALUE"


class IndiServer(IPyServer):
    """The library's server, which forgets clients that leave; its own loop would spin on their empty reads."""

    async def handle_data(self, reader: Any, writer: Any) -> None:
        read = reader.read

        async def read_or_leave(size: int) -> bytes:
            data: bytes = await read(size)
            # A page in a browser could send elements behind the head of a request.
            if not data or data.startswith((b"POST", b"PUT")):
                raise ConnectionResetError
            return data

        reader.read = read_or_leave
        await super().handle_data(reader, writer)


class IndiCamera(IPyDriver):
    """The camera, its server in a thread of its own, and the sink that gives it frames and solutions.

    Raises InputError for a port that cannot be bound; port 0 is any free one.
    """

    def __init__(self, live: Live, port: int) -> None:
        self.scene = live.flight.lab.scene
        self.inbox = live.inbox
        self.vectors = Device(DEVICE, properties(self.scene))
        super().__init__(self.vectors)
        self.exposure = self.vectors[EXPOSURE]
        with listen("--indi", HOST, port) as free:
            self.port = int(free.getsockname()[1])
        # Malformed elements are ignored, and not reported by their tracebacks.
        for package in ("indipydriver", "indipyserver"):
            logging.getLogger(package).setLevel(logging.CRITICAL)
        self.server = IndiServer(self, host=HOST, port=self.port, maxconnections=MOST_CLIENTS)
        self.thread = start_thread(lambda: asyncio.run(self.serve()), "indi")
        while self.server.server is None and self.thread.is_alive():
            time.sleep(0.01)
        self.frame = Packet({"index": -1})
        self.last = "solution" if self.scene.stars else "frame"
        self.sink = Sink("indi", self.write, {"frame", self.last})

    async def serve(self) -> None:
        self.loop = asyncio.get_running_loop()
        await self.server.asyncrun()

    def close(self) -> None:
        """End the server, once it has sent what waits."""
        if self.thread.is_alive():
            asyncio.run_coroutine_threadsafe(self.end(), self.loop)
            self.thread.join(CLOSE_TIMEOUT_S)

    async def end(self) -> None:
        await self.server.xml_data_que.join()
        self.server.shutdown()

    async def rxevent(self, event: Any) -> None:
        """Take what a client sets; properties that are read only stay as they are."""
        vector = event.vector
        if vector.name == "CONNECTION":
            is_on = event.get("CONNECT") == "On"
            vector["CONNECT"] = "On" if is_on else "Off"
            vector["DISCONNECT"] = "Off" if is_on else "On"
            await vector.send_setVector(state="Ok" if is_on else "Idle")
        elif vector.name == "CCD_ABORT_EXPOSURE":
            self.inbox.put({"abort": True}, self.refuse)
            await self.show(0, "Idle", "aborted")
            await vector.send_setVector(state="Ok")
        elif vector is self.exposure:
            await self.expose(event)

    async def expose(self, event: Any) -> None:
        """Trigger an exposure, in place of one that is under way."""
        if self.vectors["CONNECTION"]["CONNECT"] == "Off":
            return self.refuse("not connected: set CONNECTION.CONNECT first")
        try:
            exposure_s = event.getfloatvalue(SECONDS)
        except TypeError:
            return self.refuse(f"{EXPOSURE}: not a number")
        abort = self.exposure.state == "Busy"
        await self.show(exposure_s, "Busy", "exposing")
        self.inbox.put(
            {"exposure_s": exposure_s, "trigger": True, "abort": abort}, self.refuse
        )

    async def show(self, exposure_s: float, state: str, message: str) -> None:
        """Tell the clients the state of the exposure; an empty message would repeat the one before it."""
        self.exposure[SECONDS] = exposure_s
        await self.exposure.send_setVector(message, state=state)

    def refuse(self, problem: str) -> None:
        """Tell the clients why there is no exposure."""
        answer = self.exposure.send_setVector(message=problem, state="Alert")
        asyncio.run_coroutine_threadsafe(answer, self.loop)

    def write(self, packet: Packet) -> None:
        """Keep a frame until its solution has come, then send both."""
        if packet.channel == "frame":
            self.frame = packet
        is_same = packet.header["index"] == self.frame.header["index"]
        if packet.channel == self.last and is_same:
            sent = self.send_image(fits_bytes(self.frame, packet, self.scene))
            asyncio.run_coroutine_threadsafe(sent, self.loop).result()

    async def send_image(self, data: bytes) -> None:
        """Send the image that the clients wait for; there is none after an abort."""
        if self.exposure.state != "Busy":
            return
        await self.show(0, "Ok", "exposed")
        blob = self.vectors["CCD1"]
        blob["CCD1"] = data
        # Else it stays that of the first image.
        blob.set_blobsize("CCD1", len(data))
        await blob.send_setVectorMembers(state="Ok", members=["CCD1"])


def fits_bytes(frame: Packet, solution: Packet, scene: Scene) -> bytes:
    """A frame as a FITS file, with the WCS of its solution."""
    head = frame.header
    image = Frame(
        head["index"],
        frame.pixels,
        head["t_s"],
        head["exposure_s"],
        saturation_dn(scene.camera.detector),
    )
    attitude = solution.attitude
    cards = {}
    comment = "no WCS: the lights are in the laboratory"
    if attitude:
        comment = f"WCS: of the solution; the tracker's status: {attitude.status}"
        if attitude.status == "solved":
            cards = wcs_header(attitude, flipped=False)
    file = io.BytesIO()
    fits_image(image, scene, cards, comment).writeto(file)
    return file.getvalue()


def properties(scene: Scene) -> list[Any]:
    """The standard properties of an INDI camera, https://docs.indilib.org/drivers/standard-properties."""
    camera = scene.camera
    detector = camera.detector
    pixel_um = 1e6 * camera.pixel_m
    numbers: dict[str, dict[str, float]] = {
        EXPOSURE: {SECONDS: 0},
        "CCD_INFO": {
            "CCD_MAX_X": camera.width_px,
            "CCD_MAX_Y": camera.height_px,
            "CCD_PIXEL_SIZE": pixel_um,
            "CCD_PIXEL_SIZE_X": pixel_um,
            "CCD_PIXEL_SIZE_Y": pixel_um,
            "CCD_BITSPERPIXEL": 16 if detector.noise else 64,
        },
        "CCD_FRAME": {"X": 0, "Y": 0, "WIDTH": camera.width_px, "HEIGHT": camera.height_px},
        "CCD_BINNING": {"HOR_BIN": 1, "VER_BIN": 1},
        "CCD_TEMPERATURE": {"CCD_TEMPERATURE_VALUE": detector.own_c},
    }
    driver = [
        TextMember("DRIVER_NAME", membervalue=DEVICE),
        TextMember("DRIVER_INTERFACE", membervalue=CCD_INTERFACE),
    ]
    connection = [SwitchMember("CONNECT"), SwitchMember("DISCONNECT", membervalue="On")]
    abort = "CCD_ABORT_EXPOSURE"
    image = [BLOBMember("CCD1", blobformat=".fits")]
    vectors = [
        SwitchVector(
            "CONNECTION", "CONNECTION", GROUP, "rw", "OneOfMany", "Idle", connection
        ),
        SwitchVector(abort, abort, GROUP, "rw", "AtMostOne", "Idle", [SwitchMember("ABORT")]),
        TextVector("DRIVER_INFO", "Driver", GROUP, "ro", "Idle", driver),
    ]
    for name, values in numbers.items():
        most = longest_live_s(scene) if name == EXPOSURE else 0
        members = [NumberMember(key, None, "%g", 0, most, 0, values[key]) for key in values]
        perm = "rw" if most else "ro"
        vectors.append(NumberVector(name, name, GROUP, perm, "Idle", members))
    return [*vectors, BLOBVector("CCD1", "Image", GROUP, "ro", "Idle", image)]
