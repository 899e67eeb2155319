"""Export of the newest frame as files: frame, truth, solution, scene."""

from __future__ import annotations

import tempfile
import zipfile
from dataclasses import asdict
from io import BytesIO
from pathlib import Path

import cv2
import yaml

from skysim.apps.gui.worker.workbench import Workbench
from skysim.core.errors import InputError
from skysim.core.io import files as file_io
from skysim.core.io.yaml_reader import VERSION, set_key
from skysim.core.paths import SCENES
from skysim.results import scoring
from skysim.results.files import frames
from skysim.scene.loader import find

FILE_BY_ITEM = {  # file by menu entry
    "frame, FITS": "frame.fits",
    "frame, PNG": "frame.png",
    "truth": "frame.ecsv",
    "solution": "solution.json",
    "figure": "figure.png",
    "scene": "scene.yaml",
    "all of them": "",
}


def frame_files(workbench: Workbench, base: str, overrides: dict[str, str]) -> dict[str, bytes]:
    """All files by name. Raises InputError if no frame has been rendered."""
    if workbench.frame is None or workbench.truth is None:
        raise InputError("no frame has been rendered yet")
    with tempfile.TemporaryDirectory() as folder:
        frames.write_frame(Path(folder), workbench.frame, workbench.truth, workbench.scene)
        contents = {
            path.name.replace("frame_0000", "frame"): path.read_bytes() for path in sorted(Path(folder).iterdir())
        }
    annotated = scoring.annotated(workbench.frame, workbench.truth, workbench.report)
    contents["figure.png"] = bytes(cv2.imencode(".png", annotated)[1])
    if result := workbench.result:
        record = asdict(result)
        record["spots"] = record.pop("detections")
        del record["windows_px"]
        contents["solution.json"] = file_io.to_json(record).encode()
    contents["scene.yaml"] = scene_yaml(base_reference(base), overrides).encode()
    return contents


def base_reference(scene: str, folder: Path | None = None) -> str:
    """The value of `base` by which a file in `folder` refers to a scene: a shipped scene's name, else a path."""
    path = find(scene).resolve()
    if path.parent == SCENES.resolve():
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
