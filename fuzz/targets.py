"""Fuzz targets: each takes the bytes of one file and must read it or reject it with a one-line error."""

from __future__ import annotations

import json
import tempfile
from collections.abc import Callable
from contextlib import redirect_stdout
from functools import cache
from io import BytesIO, TextIOWrapper
from pathlib import Path

from estimator.catalog import catalog, ptase
from estimator.core.errors import ImageError
from skysim.apps.cli import terminal
from skysim.apps.cli.commands import validate
from skysim.apps.stream import packet
from skysim.camera.psf import otf
from skysim.core import images, units, yaml_reader
from skysim.core.errors import InputError
from skysim.dynamics.multibody import mjcf
from skysim.experiments.study import loader as study_loader
from skysim.experiments.study import store
from skysim.results.files import recording
from skysim.scene import loader, opencv_calibration
from skysim.sources import catalog as star_catalog
from skysim.sources import photometry
from skysim.sources.dome import layout, point_cloud
from skysim.tracking import dome_map_file
from skysim.tracking.external import interface

COLOUR = ptase.Colour(0.1, 0.2, 0.0)


@cache
def folder() -> tempfile.TemporaryDirectory[str]:
    """A temporary folder of this process, removed at its end."""
    return tempfile.TemporaryDirectory(prefix="skysim-fuzz-")


def written(data: bytes, name: str) -> Path:
    """Write the bytes to a file in the temporary folder and return its path."""
    path = Path(folder().name) / name
    path.parent.mkdir(exist_ok=True)
    path.write_bytes(data)
    return path


def refused(read: Callable[[], object], *ways: type[Exception]) -> bool:
    """Return True if `read` raises one of these exceptions. Raises AssertionError if its message is not one line."""
    try:
        read()
    except ways as error:
        if len(str(error).splitlines()) != 1:
            raise AssertionError(f"not one line: {str(error)!r}") from error
        return True
    return False


def scenes(data: bytes) -> None:
    path = written(data, "scene.yaml")
    refused(lambda: loader.load(path), InputError)
    refused(lambda: loader.load_camera(path), InputError)


def studies(data: bytes) -> None:
    path = written(data, "study.yaml")
    refused(lambda: study_loader.load(path), InputError)


def overrides(data: bytes) -> None:
    text = data.decode("utf-8", "replace")
    refused(lambda: loader.load("shefex2", yaml_reader.parse_overrides(text.split("\n"))), InputError)


def fits(data: bytes) -> None:
    path = written(data, "frame.fits")
    refused(lambda: images.monochrome(images.read_image(path)), InputError)
    images.date_of(path)


def pictures(data: bytes) -> None:
    path = written(data, "frame.png")
    refused(lambda: images.monochrome(images.read_image(path)), InputError)


def catalogues(data: bytes) -> None:
    path = written(data, "stars.ecsv")
    refused(lambda: star_catalog.read(path), InputError)
    refused(lambda: catalog.read(path), ImageError)
    refused(lambda: ptase.read_cat(path, 5.0, 2010.0, COLOUR), ImageError)
    refused(lambda: validate.looked_at(path), InputError)


def maps(data: bytes) -> None:
    path = written(data, "map.ecsv")
    refused(lambda: dome_map_file.read_dome_map(path), InputError)


def truths(data: bytes) -> None:
    path = written(data, "frame_0000.ecsv")
    refused(lambda: recording.truth(path), InputError)


def calibrations(data: bytes) -> None:
    path = written(data, "camera.yml")
    opencv_calibration.is_one(path)
    refused(lambda: opencv_calibration.read(path), InputError)


def tables(data: bytes) -> None:
    """CSV tables: LEDs, surveyed points of a dome, a curve over wavelength, a point-spread function."""
    path = written(data, "table.csv")
    refused(lambda: layout.read_csv(path), InputError)
    refused(lambda: point_cloud.fit(point_cloud.read(str(path), "m"), 2, str(path)), InputError)
    refused(lambda: photometry._read.__wrapped__(path), InputError)  # bypass the cache, whose key is the path
    refused(lambda: otf.cells_of.__wrapped__(str(path)), InputError)


def vehicles(data: bytes) -> None:
    path = written(data, "vehicle.xml")
    refused(lambda: mjcf.compiled(mjcf.load(path), path), InputError)


def stores(data: bytes) -> None:
    """A study's store, read as for a report, and as for resuming a run."""
    path = written(data, "trials.sqlite")

    def read() -> None:
        with store.open_store(path) as kept:
            kept.points(), kept.columns(), kept.counts(), kept.failures(), kept.runs(), kept.span()
            kept.overrides()

    def resume() -> None:
        with store.writing(path) as kept:
            kept.meta("digest"), kept.meta("code"), kept.counts(), kept.points(), kept.scenes()

    for beside in path.parent.glob(f"{path.name}-*"):  # SQLite's journal of the previous file
        beside.unlink()
    refused(read, InputError)
    refused(resume, InputError)


def answers(data: bytes) -> None:
    """An external tracker's answer: parsed, checked, and printed without control characters."""
    try:
        told = json.loads(data)
    except (ValueError, RecursionError):  # as in tracking.external.process
        return
    statuses: list[str] = []
    if refused(lambda: statuses.append(interface.checked(interface.Answer.of_tree(told)).status), ValueError):
        return
    with redirect_stdout(TextIOWrapper(BytesIO(), "utf-8")) as screen:
        terminal.print_table("", ["status"], [statuses])
        screen.seek(0)
        shown = screen.read()
    if statuses[0][:80] not in shown or not shown.removesuffix("\n").partition("\n")[2].isprintable():
        raise AssertionError(f"not shown as it is: {statuses[0]!r}")


def packets(data: bytes) -> None:
    refused(lambda: packet.unpack(BytesIO(data)), InputError)


def quantities(data: bytes) -> None:
    text = data.decode("utf-8", "replace")
    refused(lambda: units.quantity("m", "length", '"35 mm"')(text), ValueError)


TARGETS: dict[str, Callable[[bytes], None]] = {
    one.__name__: one
    for one in (
        *(scenes, studies, overrides, fits, pictures, catalogues, maps, truths, calibrations),
        *(tables, vehicles, stores, answers, packets, quantities),
    )
}
