"""Fuzz targets: each takes the bytes of one file and must read it or reject it with a one-line error."""

from __future__ import annotations

import datetime
import json
import math
import tempfile
from collections.abc import Callable
from contextlib import redirect_stdout
from functools import cache
from io import BytesIO, TextIOWrapper
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np

from estimator.catalog import cat_file, catalog, published_catalogs
from estimator.core.errors import ImageError
from skysim.apps.cli.commands import validate
from skysim.apps.live import gige, gige_receiver
from skysim.apps.live.commands import CommandState, Inbox, parse
from skysim.apps.live.gige import GigeCamera
from skysim.apps.live.gige_receiver import GigeReceiver
from skysim.apps.live.pacing import Live, Pace, pose_samples
from skysim.apps.live.packets import unpack
from skysim.apps.plate_solver import picture
from skysim.camera.psf import otf
from skysim.core import images, units, yaml_reader
from skysim.core.errors import InputError
from skysim.dynamics.controllers import torque_of_reply
from skysim.dynamics.multibody import mjcf
from skysim.dynamics.profile_samples import check_samples
from skysim.dynamics.profiles import read_profile
from skysim.dynamics.reference_curves import AttitudeSpline
from skysim.experiments.characterize.frame_files import read_settings
from skysim.experiments.dome_survey import survey_procedure
from skysim.experiments.study import study_file as study_loader
from skysim.experiments.study.execution import store
from skysim.results.files import recording
from skysim.results.files.parts import read_prices
from skysim.results.report import Column, Table, print_table
from skysim.scene import loader, opencv_calibration
from skysim.scene.sections.camera import read_columns
from skysim.simulation.flight import open_flight
from skysim.sources import catalog as star_catalog
from skysim.sources import photometry
from skysim.sources.dome import point_cloud
from skysim.sources.dome.layouts import listed
from skysim.sources.orbit_elements import gcrs_states, read_elements, read_oem
from skysim.tracking import dome_map_file, tracker_interface

START = datetime.datetime(2016, 12, 31)
GZIP_MAGIC = b"\x1f\x8b"
COLOR = published_catalogs.Color(0.1, 0.2, 0.0)


@cache
def folder() -> tempfile.TemporaryDirectory[str]:
    """A temporary folder of this process, removed at its end."""
    return tempfile.TemporaryDirectory(prefix="skysim-fuzz-")


def write_file(data: bytes, name: str) -> Path:
    """Write the bytes to a file in the temporary folder and return its path."""
    path = Path(folder().name) / name
    path.parent.mkdir(exist_ok=True)
    path.write_bytes(data)
    return path


def rejects(read: Callable[[], object], *exceptions: type[Exception]) -> bool:
    """Return True if `read` raises one of these exceptions. Raises AssertionError if its message is not one line."""
    try:
        read()
    except exceptions as error:
        if len(str(error).splitlines()) != 1:
            raise AssertionError(f"not one line: {str(error)!r}") from error
        return True
    return False


def scenes(data: bytes) -> None:
    path = write_file(data, "scene.yaml")
    rejects(lambda: loader.load(path), InputError)
    rejects(lambda: loader.load_camera(path), InputError)


def studies(data: bytes) -> None:
    path = write_file(data, "study.yaml")
    rejects(lambda: study_loader.load(path), InputError)


def overrides(data: bytes) -> None:
    text = data.decode("utf-8", "replace")
    rejects(
        lambda: loader.load("shefex2", yaml_reader.parse_overrides(text.split("\n"))),
        InputError,
    )


def fits(data: bytes) -> None:
    path = write_file(data, "frame.fits.gz" if data.startswith(GZIP_MAGIC) else "frame.fits")
    rejects(lambda: [images.as_light(one) for one in images.read_pictures(path)], InputError)


def pictures(data: bytes) -> None:
    suffix = "npy" if data.startswith(b"\x93NUMPY") else "png"
    path = write_file(data, f"frame.{suffix}")
    rejects(lambda: [images.as_light(one) for one in images.read_pictures(path)], InputError)


def catalogs(data: bytes) -> None:
    path = write_file(data, "stars.ecsv")
    rejects(lambda: star_catalog.read(path), InputError)
    rejects(lambda: catalog.read(path), ImageError)
    rejects(lambda: published_catalogs.read_cat(path, 5.0, 2010.0, COLOR), ImageError)
    rejects(lambda: cat_file.read_stars(write_file(data, "stars.cat")), ImageError)
    rejects(lambda: validate.describe_file(path, {}), InputError)


def maps(data: bytes) -> None:
    lights = write_file(data, "lights.ecsv")
    rejects(lambda: picture.read_lights(lights), InputError)
    path = write_file(data, "map.ecsv")
    rejects(lambda: dome_map_file.read_dome_map(path), InputError)


def truths(data: bytes) -> None:
    path = write_file(data, "frame_0000.ecsv")
    rejects(lambda: recording.read_truth(path), InputError)


def calibrations(data: bytes) -> None:
    path = write_file(data, "camera.yml")
    opencv_calibration.looks_like_calibration(path)
    rejects(lambda: opencv_calibration.read(path), InputError)


def tables(data: bytes) -> None:
    """CSV tables: LEDs, points of a dome, attitudes, exposures, a curve over wavelength, a PSF, prices, a lens."""
    path = write_file(data, "table.csv")
    rejects(lambda: survey_procedure.read_attitudes(path), InputError)
    rejects(lambda: read_settings(path), InputError)
    rejects(lambda: listed.read_csv(path), InputError)
    rejects(
        lambda: point_cloud.fit(point_cloud.read(str(path), "m"), 2, str(path)), InputError
    )
    for largest in (1.0, math.inf):  # a response, the spectrum of an LED
        # bypass the cache, whose key is the path
        rejects(
            lambda largest=largest: photometry._read_curve.__wrapped__(path, 0, largest),
            InputError,
        )
    rejects(lambda: otf.read_cells.__wrapped__(str(path)), InputError)
    rejects(lambda: read_prices(path), InputError)
    rejects(lambda: read_columns(str(path)), InputError)


def vehicles(data: bytes) -> None:
    path = write_file(data, "vehicle.xml")
    rejects(lambda: mjcf.compile_spec(mjcf.load(path), path), InputError)


def stores(data: bytes) -> None:
    """A study's store, read as for a report, and as for resuming a run."""
    path = write_file(data, "trials.sqlite")

    def read() -> None:
        with store.open_store(path) as trials:
            (
                trials.points(),
                trials.columns(),
                trials.counts(),
                trials.failures(),
                trials.runs(),
            )
            trials.trial_range(), trials.overrides()

    def resume() -> None:
        with store.writing(path) as trials:
            (
                trials.meta("digest"),
                trials.meta("code"),
                trials.counts(),
                trials.points(),
                trials.scenes(),
            )

    for journal in path.parent.glob(
        f"{path.name}-*"
    ):  # SQLite's journal of the previous file
        journal.unlink()
    rejects(read, InputError)
    rejects(resume, InputError)


def answers(data: bytes) -> None:
    """An external tracker's answer: parsed, checked, and printed without control characters."""
    try:
        tree = json.loads(data)
    except (ValueError, RecursionError):  # as in core.plugins
        return
    statuses: list[str] = []
    if rejects(
        lambda: statuses.append(
            tracker_interface.check_answer(tracker_interface.Answer.of_tree(tree)).status
        ),
        ValueError,
    ):
        return
    with redirect_stdout(TextIOWrapper(BytesIO(), "utf-8")) as output:
        print_table(Table((Column("status"),), [tuple(statuses)]))
        output.seek(0)
        printed = output.read()
    if (
        statuses[0][:80] not in printed
        or not printed.removesuffix("\n").partition("\n")[2].isprintable()
    ):
        raise AssertionError(f"not printed as it is: {statuses[0]!r}")


def orbits(data: bytes) -> None:
    """An orbit or satellites: OEM, TLE, OMM."""
    path = str(write_file(data, "orbit"))
    rejects(lambda: read_oem(path, START).states(np.zeros(1)), InputError)
    rejects(lambda: gcrs_states(read_elements(path), START, np.zeros(1)), InputError)


def profiles(data: bytes) -> None:
    """An attitude file of any format, read as a scene's maneuver is."""
    path = write_file(data, "profile.csv")
    for rotation in (None, "lab_from_body"):
        rejects(
            lambda rotation=rotation: AttitudeSpline(
                check_samples(read_profile(path, START, rotation))
            ),
            InputError,
        )


def torques(data: bytes) -> None:
    """A controller's answer to a control period."""
    try:
        reply = json.loads(data)
    except (ValueError, RecursionError):  # as in core.plugins
        return
    rejects(lambda: torque_of_reply(reply, 0, 1.0), ValueError)


def packets(data: bytes) -> None:
    rejects(lambda: unpack(BytesIO(data)), InputError)


@cache
def camera_flight() -> Any:
    """What a camera needs of a flight."""
    control = SimpleNamespace(exposure_s=0.01)
    return SimpleNamespace(
        lab=SimpleNamespace(scene=loader.load("shefex2")),
        now_s=1.0,
        schedules=[SimpleNamespace(triggers_s=None, exposure_control=control)],
    )


def datagrams(data: bytes) -> None:
    """Datagrams to a GigE Vision camera, one after another: each is ignored, or answered as the standard says."""
    flight = camera_flight()
    camera = GigeCamera(
        Live(flight, Pace(0.0, 1.0), [], CommandState(flight, 1.0, False)), "127.0.0.1", 0
    )
    camera.stream.close()  # nothing leaves the process
    sent = 0
    try:
        while sent < len(data):
            length = int.from_bytes(data[sent + 4 : sent + 6])
            one = data[sent : sent + 8 + length]
            sent += len(one)
            answer = camera.answer(one, ("127.0.0.1", 1), 0.0)
            if answer is not None:
                status, _, size, number = gige.ANSWER.unpack_from(answer)
                gige.GvcpStatus(status)
                if size != len(answer) - 8 or number != int.from_bytes(one[6:8]):
                    raise AssertionError(f"a malformed answer: {answer!r}")
    finally:
        camera.close()


def gvsp(data: bytes) -> None:
    """Packets that anyone sends to the receiver of a camera, each after its length in two bytes."""
    receiver = GigeReceiver("gige://127.0.0.1")
    sent = 0
    with receiver.control, receiver.stream:
        while sent < len(data):
            end = sent + 2 + int.from_bytes(data[sent : sent + 2])
            packet = data[sent + 2 : end]
            rejects(lambda packet=packet: receiver.take(packet), InputError)
            sent = end
            if len(receiver.parts) > gige_receiver.MOST_PACKETS:
                raise AssertionError("more packets are kept than a frame has")


def genicam(data: bytes) -> None:
    """A GenICam file of any camera: its registers are found, or it is refused."""
    receiver = GigeReceiver("gige://127.0.0.1")
    place = b"Local:camera.xml;%X;%X" % (gige.XML, len(data))
    memory = {gige.XML_ADDRESS: place.ljust(gige_receiver.READ_BYTES, b"\0")}
    memory |= {gige.XML + at: data[at : at + 512] for at in range(0, len(data), 512)}
    receiver.command = lambda _, at, *size: b"addr" + memory[at]  # type: ignore[method-assign]
    with receiver.control, receiver.stream:
        rejects(lambda: list(receiver.commands("AcquisitionStart")), InputError)


@cache
def commanded_flight() -> CommandState:
    """A flight that takes every kind of command."""
    flight = open_flight(loader.load("simsat_bump"), keeps_history=False)
    return CommandState(flight, 0.5, has_triggers=True)


def commands(data: bytes) -> None:
    """Lines of a client of the wire: what is taken must be in force without an error."""
    state = commanded_flight()
    inbox = Inbox()
    for line in data.splitlines():
        rejects(lambda line=line: inbox.put(parse(line), lambda _: None), InputError)
    state.receive(inbox)
    state.in_force()


def poses(data: bytes) -> None:
    rejects(lambda: pose_samples(parse(data).get("pose"), in_orbit=True), InputError)


def quantities(data: bytes) -> None:
    text = data.decode("utf-8", "replace")
    rejects(lambda: units.quantity("m", "length", '"35 mm"')(text), ValueError)


TARGETS: dict[str, Callable[[bytes], None]] = {
    target.__name__: target
    for target in (
        scenes,
        studies,
        overrides,
        fits,
        pictures,
        catalogs,
        maps,
        truths,
        calibrations,
        tables,
        vehicles,
        stores,
        answers,
        profiles,
        orbits,
        torques,
        packets,
        commands,
        poses,
        datagrams,
        gvsp,
        genicam,
        quantities,
    )
}
