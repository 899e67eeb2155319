"""What is fuzzed: each target takes the bytes of one file and must read it or refuse it in one line."""

from __future__ import annotations

import json
import tempfile
from collections.abc import Callable
from contextlib import redirect_stdout
from functools import cache
from io import BytesIO, TextIOWrapper
from pathlib import Path

from estimator import catalog, ptasecat
from estimator.types import BadImage
from skysim import (
    calibration,
    catalogue,
    io,
    layout,
    photometry,
    pointcloud,
    psf,
    quantity,
    recording,
    scene,
    terminal,
    trackers,
    validate,
    yamlfile,
)
from skysim.stream import packet
from skysim.study import plan, store
from skysim.types import BadInput
from skysim.world import spec

COLOUR = ptasecat.Colour(0.1, 0.2, 0.0)


@cache
def folder() -> tempfile.TemporaryDirectory[str]:
    """Of this process alone; it goes with it."""
    return tempfile.TemporaryDirectory(prefix="skysim-fuzz-")


def written(data: bytes, name: str) -> Path:
    """The bytes as a file."""
    path = Path(folder().name) / name
    path.parent.mkdir(exist_ok=True)
    path.write_bytes(data)
    return path


def refused(read: Callable[[], object], *ways: type[Exception]) -> bool:
    """Whether it was refused, in one of these ways and in one line."""
    try:
        read()
    except ways as error:
        if len(str(error).splitlines()) != 1:
            raise AssertionError(f"not one line: {str(error)!r}") from error
        return True
    return False


def scenes(data: bytes) -> None:
    path = written(data, "scene.yaml")
    refused(lambda: scene.load(path), BadInput)
    refused(lambda: scene.load_camera(path), BadInput)


def studies(data: bytes) -> None:
    path = written(data, "study.yaml")
    refused(lambda: plan.load(path), BadInput)


def overrides(data: bytes) -> None:
    text = data.decode("utf-8", "replace")
    refused(lambda: scene.load("shefex2", yamlfile.overridden(text.split("\n"))), BadInput)


def fits(data: bytes) -> None:
    path = written(data, "frame.fits")
    refused(lambda: io.monochrome(io.read_image(path)), BadInput)
    io.date_of(path)


def pictures(data: bytes) -> None:
    path = written(data, "frame.png")
    refused(lambda: io.monochrome(io.read_image(path)), BadInput)


def catalogues(data: bytes) -> None:
    path = written(data, "stars.ecsv")
    refused(lambda: catalogue.read(path), BadInput)
    refused(lambda: catalog.read(path), BadImage)
    refused(lambda: ptasecat.read_cat(path, 5.0, 2010.0, COLOUR), BadImage)
    refused(lambda: validate.looked_at(path), BadInput)


def maps(data: bytes) -> None:
    path = written(data, "map.ecsv")
    refused(lambda: io.read_dome_map(path), BadInput)


def truths(data: bytes) -> None:
    path = written(data, "frame_0000.ecsv")
    refused(lambda: recording.truth(path), BadInput)


def calibrations(data: bytes) -> None:
    path = written(data, "camera.yml")
    calibration.is_one(path)
    refused(lambda: calibration.read(path), BadInput)


def tables(data: bytes) -> None:
    """LEDs, points of a dome, a curve over the wavelength, a point-spread function."""
    path = written(data, "table.csv")
    refused(lambda: layout.read_csv(path), BadInput)
    refused(lambda: pointcloud.fit(pointcloud.read(str(path), "m"), 2, str(path)), BadInput)
    refused(lambda: photometry._read.__wrapped__(path), BadInput)  # what is cached goes by the file's name
    refused(lambda: psf.cells_of.__wrapped__(str(path)), BadInput)


def vehicles(data: bytes) -> None:
    path = written(data, "vehicle.xml")
    refused(lambda: spec.compiled(spec.load(path), path), BadInput)


def stores(data: bytes) -> None:
    """The file of a study, as its reports read it, and as a run that goes on does."""
    path = written(data, "trials.sqlite")

    def read() -> None:
        with store.open_store(path) as kept:
            kept.points(), kept.columns(), kept.counts(), kept.failures(), kept.runs(), kept.span()
            kept.overrides()

    def resume() -> None:
        with store.writing(path) as kept:
            kept.meta("digest"), kept.meta("code"), kept.counts(), kept.points(), kept.scenes()

    for beside in path.parent.glob(f"{path.name}-*"):  # a log of the file before
        beside.unlink()
    refused(read, BadInput)
    refused(resume, BadInput)


def answers(data: bytes) -> None:
    """What a tracker says, which may be anybody's program."""
    try:
        told = json.loads(data)
    except (ValueError, RecursionError):  # as `programs` has it
        return
    statuses: list[str] = []
    if refused(lambda: statuses.append(trackers.checked(trackers.Answer.of_tree(told)).status), ValueError):
        return
    with redirect_stdout(TextIOWrapper(BytesIO(), "utf-8")) as screen:
        terminal.print_table("", ["status"], [statuses])
        screen.seek(0)
        shown = screen.read()
    if statuses[0][:80] not in shown or not shown.removesuffix("\n").partition("\n")[2].isprintable():
        raise AssertionError(f"not shown as it is: {statuses[0]!r}")


def packets(data: bytes) -> None:
    refused(lambda: packet.unpack(BytesIO(data)), BadInput)


def quantities(data: bytes) -> None:
    text = data.decode("utf-8", "replace")
    refused(lambda: quantity.quantity("m", "length", '"35 mm"')(text), ValueError)


TARGETS: dict[str, Callable[[bytes], None]] = {
    one.__name__: one
    for one in (
        *(scenes, studies, overrides, fits, pictures, catalogues, maps, truths, calibrations),
        *(tables, vehicles, stores, answers, packets, quantities),
    )
}
