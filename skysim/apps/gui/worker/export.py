"""Export of the newest frame as files: frame, truth, solution, scene."""

from __future__ import annotations

import tempfile
import zipfile
from io import BytesIO
from pathlib import Path

import cv2
import numpy as np
import yaml

from skysim.apps.gui.worker.workbench import Workbench
from skysim.core import files as file_io
from skysim.core.errors import InputError
from skysim.core.paths import SCENES
from skysim.core.yaml_reader import VERSION, set_key
from skysim.results.files import frames
from skysim.results.report import annotate
from skysim.scene.loader import find

KINDS = {  # file by menu entry
    "frame, FITS": "frame.fits",
    "frame, PNG": "frame.png",
    "truth": "frame.ecsv",
    "solution": "solution.json",
    "figure": "figure.png",
    "scene": "scene.yaml",
    "all of them": "",
}


def files(desk: Workbench, base: str, overrides: dict[str, str]) -> dict[str, bytes]:
    """All files by name. Raises InputError if no frame has been rendered."""
    if desk.frame is None or desk.truth is None:
        raise InputError("nothing to export yet")
    with tempfile.TemporaryDirectory() as folder:
        frames.write_frame(Path(folder), desk.frame, desk.truth, desk.scene)
        found = {
            path.name.replace("frame_0000", "frame"): path.read_bytes()
            for path in sorted(Path(folder).iterdir())
        }
    found["figure.png"] = figure(desk)
    if answer := desk.answer:
        told = {
            name: getattr(answer, name) for name in answer.__slots__ if name not in ("spots", "windows_px")
        }
        told["spots"] = [{name: getattr(spot, name) for name in spot.__slots__} for spot in answer.spots]
        found["solution.json"] = file_io.to_json(told).encode()
    found["scene.yaml"] = scene_yaml(base_of(base), overrides).encode()
    return found


def figure(desk: Workbench) -> bytes:
    """PNG of the frame with true lights, detections and identified lights marked."""
    assert desk.frame is not None
    assert desk.truth is not None
    empty = np.empty((0, 2))
    match = desk.report.attitude.match if desk.report else None
    xy_px = desk.report.centroids.xy_px if desk.report else empty
    matched_px = xy_px[match.observed] if match else empty
    drawn = annotate(desk.frame.image_dn, xy_px, matched_px, truth_px=desk.truth.seen.xy_px)
    return bytes(cv2.imencode(".png", drawn)[1])


def base_of(scene: str, folder: Path | None = None) -> str:
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


def packed(found: dict[str, bytes]) -> bytes:
    """Pack all files into a ZIP archive."""
    buffer = BytesIO()
    with zipfile.ZipFile(buffer, "w", zipfile.ZIP_DEFLATED) as archive:
        for name, data in found.items():
            archive.writestr(name, data)
    return buffer.getvalue()
