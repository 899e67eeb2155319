"""MuJoCo's model files: read and compiled, with its complaints told in one line."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any
from xml.etree import ElementTree  # expat stops entities that grow without end

import mujoco

from skysim.types import BadInput

# Attributes of MJCF that name a file or a folder of files.
SIDES = ("right", "left", "up", "down", "front", "back")
NAMES_FILES = {"file", "meshdir", "texturedir", "assetdir", *(f"file{side}" for side in SIDES)}


def load(path: Path) -> Any:
    """The MJCF file as an MjSpec."""
    if not path.is_file():
        raise BadInput(f"{path}: no such file; vehicle.model is a path beside the scene or in scenes/")
    confined(path, path.resolve().parent, set())
    try:
        return mujoco.MjSpec.from_file(str(path))
    except (ValueError, mujoco.FatalError) as error:
        raise BadInput(f"{path}: not a MuJoCo model: {one_line(error)}") from error


def confined(path: Path, folder: Path, seen: set[Path]) -> None:
    """Refuse a model, which may be a stranger's, that names a file outside of its own folder, by itself or in what it
    includes. MuJoCo would read any."""
    seen.add(path.resolve())
    try:
        root = ElementTree.parse(path).getroot()
    except (ElementTree.ParseError, OSError, ValueError) as error:
        raise BadInput(f"{path}: not a MuJoCo model: {one_line(error)}") from None
    for element in root.iter():
        for name in element.attrib.keys() & NAMES_FILES:
            value = element.attrib[name]
            places = [(base / value).resolve() for base in (folder, path.resolve().parent)]
            if not all(place.is_relative_to(folder) for place in places):
                raise BadInput(
                    f"{path}: {element.tag} {name}={value!r} leaves {folder}; allowed: files in it"
                )
            for place in places if element.tag == "include" else ():
                if place.is_file() and place not in seen:
                    confined(place, folder, seen)


def compiled(spec: Any, path: Path) -> Any:
    try:
        return spec.compile()
    except (ValueError, mujoco.FatalError) as error:
        raise BadInput(f"{path}: MuJoCo cannot compile it: {one_line(error)}") from error


@contextmanager
def mujoco_warnings() -> Iterator[list[str]]:
    """Collect MuJoCo's warnings, which it would print and append to a file in the user's folder."""
    caught: list[str] = []
    before = mujoco.get_mju_user_warning()
    mujoco.set_mju_user_warning(caught.append)
    try:
        yield caught
    finally:
        mujoco.set_mju_user_warning(before)


def one_line(error: Exception) -> str:
    return " ".join(str(error).split())
