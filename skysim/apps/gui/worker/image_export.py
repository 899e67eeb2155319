"""Export of the image on the page as files: frame, truth, solution, scene."""

import shlex
import tempfile
import zipfile
from dataclasses import asdict
from io import BytesIO
from pathlib import Path

import cv2
import numpy as np
import yaml
from astropy.io import fits
from numpy.typing import NDArray

from skysim.apps.gui.messages import TrackerResult, places_px
from skysim.apps.gui.worker.photo import Photo
from skysim.apps.gui.worker.workbench import Workbench
from skysim.core import files as file_io
from skysim.core.errors import InputError
from skysim.core.images import TOP_DOWN_CARD
from skysim.core.paths import PAPERS, SCENES
from skysim.core.types import Record
from skysim.core.yaml_reader import VERSION, set_key
from skysim.results import scoring
from skysim.results.files import recording
from skysim.results.plots import annotate
from skysim.scene.loader import find

FILE_BY_ITEM = {  # file by menu entry
    "frame, FITS": "frame.fits",
    "frame, PNG": "frame.png",
    "truth": "frame.ecsv",
    "solution": "solution.json",
    "figure": "figure.png",
    "scene": "scene.yaml",
    "command line": "command.txt",
    "Python": "scene.py",
    "all of them": "",
}
PYTHON = """import skysim

scene = skysim.load_scene({!r}, {!r})
for frame in skysim.simulate(scene):
    print(frame)
"""


def frame_files(
    workbench: Workbench, base: str, overrides: dict[str, str]
) -> dict[str, bytes]:
    """All files by name. Raises InputError if no frame has been rendered."""
    if workbench.frame is None or workbench.truth is None:
        raise InputError("", "no frame has been rendered yet")
    with tempfile.TemporaryDirectory() as folder:
        recording.write_frame(Path(folder), workbench.frame, workbench.truth, workbench.scene)
        contents = {
            f"frame{path.suffix}": path.read_bytes()
            for path in sorted(Path(folder).iterdir())
        }
    annotated = scoring.annotated(workbench.frame, workbench.truth, workbench.report)
    contents["figure.png"] = bytes(cv2.imencode(".png", annotated)[1])
    if workbench.result:
        solution = file_io.to_json(solution_record(workbench.result))
        contents["solution.json"] = solution.encode()
    name = base_reference(base)
    sets = [word for pair in overrides.items() for word in ("--set", "=".join(pair))]
    contents["scene.yaml"] = scene_yaml(name, overrides).encode()
    contents["command.txt"] = shlex.join(["skysim", "run", name, *sets]).encode()
    contents["scene.py"] = PYTHON.format(name, overrides).encode()
    return contents


def photo_files(photo: Photo, image: NDArray) -> dict[str, bytes]:
    """The files of an image that is not of the scene, by name: it has no truth, and the scene says nothing about it."""
    detected = places_px(photo.result.detections)
    identified = np.array([spot.id >= 0 for spot in photo.result.detections], bool)
    record = solution_record(photo.result) | {"solution": photo.solution, "hint": photo.hint}
    buffer = BytesIO()
    fits.PrimaryHDU(image, fits.Header([TOP_DOWN_CARD])).writeto(buffer)
    return {
        "frame.fits": buffer.getvalue(),
        "frame.png": bytes(cv2.imencode(".png", image)[1]),
        "figure.png": bytes(
            cv2.imencode(".png", annotate(image, detected, detected[identified]))[1]
        ),
        "solution.json": file_io.to_json(record).encode(),
    }


def solution_record(result: TrackerResult) -> Record:
    """The tracker's result for JSON."""
    return asdict(result.row) | {"spots": [asdict(spot) for spot in result.detections]}


def base_reference(scene: str, folder: Path | None = None) -> str:
    """The value of `base` by which a file in `folder` refers to a scene: a shipped scene's name, else a path."""
    path = find(scene).resolve()
    if path.parent in (SCENES.resolve(), PAPERS.resolve()):
        return path.stem
    return path.name if path.parent == folder else str(path)


def scene_yaml(base: str, overrides: dict[str, str], title: str = "") -> str:
    """YAML of a scene that consists of a base and overrides."""
    tree: dict[str, object] = {"schema": VERSION, "base": base}
    if title:
        tree["title"] = title
    for key, value in overrides.items():
        set_key(tree, key, value)
    return yaml.safe_dump(tree, sort_keys=False, allow_unicode=True)


def zip_archive(contents: dict[str, bytes]) -> bytes:
    buffer = BytesIO()
    with zipfile.ZipFile(buffer, "w", zipfile.ZIP_DEFLATED) as archive:
        for name, data in contents.items():
            archive.writestr(name, data)
    return buffer.getvalue()
