"""What is fuzzed: each target takes the bytes of one file and must read it or refuse it in one line."""

from __future__ import annotations

import os
import tempfile
from collections.abc import Callable
from pathlib import Path

from estimator import catalog
from estimator.types import BadImage
from skysim import catalogue, io, quantity, scene, yamlfile
from skysim.study import plan
from skysim.types import BadInput

FOLDER = Path(tempfile.gettempdir()) / f"skysim-fuzz-{os.getuid()}"


def written(data: bytes, name: str) -> Path:
    """The bytes as a file of a folder of this process's own."""
    folder = FOLDER / str(os.getpid())
    folder.mkdir(parents=True, exist_ok=True)
    path = folder / name
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


def maps(data: bytes) -> None:
    path = written(data, "map.ecsv")
    refused(lambda: io.read_dome_map(path), BadInput)


def quantities(data: bytes) -> None:
    text = data.decode("utf-8", "replace")
    refused(lambda: quantity.quantity("m", "length", '"35 mm"')(text), ValueError)


TARGETS: dict[str, Callable[[bytes], None]] = {
    one.__name__: one for one in (scenes, studies, overrides, fits, pictures, catalogues, maps, quantities)
}
