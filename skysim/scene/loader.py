"""Load a scene: presets, calibration files, `base` scenes and overrides, then validation.

The raw YAML tree is built in layers, the later ones over the earlier: the `base` scene (recursively), the scene's own
keys, then the overrides of `--set`. Next, the camera's preset is put beneath the camera section and a calibration
file's values over it (`with_preset`). Only then does pydantic validate the tree. Every error becomes an InputError of
one line with key, file and line.
"""

from __future__ import annotations

import re
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from pydantic import ValidationError

from skysim.core import yaml_reader
from skysim.core.errors import InputError
from skysim.core.paths import DATA, SCENES
from skysim.core.units import ConfigModel, quantity
from skysim.core.yaml_reader import Files, check_version, explain, is_file, place_of, read_yaml, set_key
from skysim.scene.camera import CameraConfig, focus_distance
from skysim.scene.opencv_calibration import read as read_calibration
from skysim.scene.scene import STEM, Scene

PRESETS = DATA / "cameras"


def preset(name: str, where: str) -> dict[str, Any]:
    """The `camera` section of data/cameras/NAME.yaml. Raises InputError for an unknown name."""
    known = sorted(path.stem for path in PRESETS.glob("*.yaml"))
    if name not in known:
        raise InputError(f"{where}: {name!r} is none of {', '.join(known)}")
    tree: dict[str, Any] = read_yaml(Path(PRESETS / f"{name}.yaml"))[0]["camera"]
    return tree


def with_preset(tree: dict[str, Any]) -> dict[str, Any]:
    """The raw scene with its camera's preset and calibration applied.

    The camera's own keys override the preset's; the calibration's values are added to both. Raises InputError; its
    message begins with the key.
    """
    part = tree.get("camera")
    if not isinstance(part, dict) or not {"preset", "calibration"} & set(part):
        return tree
    own = {key: value for key, value in part.items() if key not in ("preset", "calibration")}
    below = preset(str(part["preset"]), "camera.preset") if part.get("preset") is not None else {}
    if part.get("calibration") is None:
        return tree | {"camera": merge(below, own)}
    for key in CALIBRATED:
        if own.pop(key, None) is not None:
            raise InputError(
                f"camera.{key}: the file of camera.calibration tells it; allowed: one of the two (null for a base's)"
            )
    whole = merge(below, own)
    return tree | {"camera": whole | calibrated(Path(str(part["calibration"])), whole)}


CALIBRATED = ("width_px", "height_px", "focal_length", "principal_point_px", "distortion")


def calibrated(path: Path, part: dict[str, Any]) -> dict[str, Any]:
    """The camera keys that an OpenCV calibration defines: size, focal length, principal point, distortion.

    The focal length in meters follows from the camera's pixel pitch and focus, which the file does not contain.
    Raises InputError.
    """
    try:
        told = read_calibration(path)
        pixel_m = quantity("m", "length", '"5.5 um"')(part.get("pixel"))
        focus_m = focus_distance(part.get("focus", "infinity"))
    except InputError as error:
        raise InputError(f"camera.calibration: {error}") from None
    except ValueError as error:
        raise InputError(f"camera.pixel: {error}; camera.calibration takes it, and focus") from None
    size = (part.get("width_px", told.width_px), part.get("height_px", told.height_px))
    if size != (told.width_px, told.height_px):
        raise InputError(
            f"camera.calibration: {path}: of frames of {told.width_px}x{told.height_px}; the preset's are"
            f" {size[0]}x{size[1]}"
        )
    # Thin lens: a calibration measures the image distance v, and 1/f = 1/v + 1/u, as in CameraConfig.image_distance_m.
    focal_m = 1 / (1 / (told.focal_px * pixel_m) + 1 / focus_m)
    return {
        "width_px": told.width_px,
        "height_px": told.height_px,
        "focal_length": f"{focal_m!r} m",
        "principal_point_px": list(told.centre_px),
        "distortion": list(told.distortion),
    }


def merge(below: dict[str, Any], above: dict[str, Any]) -> dict[str, Any]:
    """Merge two mappings, `above` over `below`, recursively; sections of different kinds are replaced, not merged."""
    merged = below | above
    for key, value in above.items():
        ground = below.get(key)
        if not isinstance(value, dict) or not isinstance(ground, dict):
            continue
        if value.get("kind") in (None, ground.get("kind")):
            merged[key] = merge(ground, value)
    return merged


class CameraFileConfig(ConfigModel):
    """A file with a camera section only."""

    camera: CameraConfig


def find(name: str) -> Path:
    """The path of a scene given by path or by its name in scenes/. Raises InputError."""
    return yaml_reader.find(name, SCENES, "scene")


def load(name: str | Path, overrides: Mapping[str, str] | None = None) -> Scene:
    """Read, override (`path.to.key` -> YAML value) and validate a scene.

    Raises InputError with one line: the key, what is wrong with it, what is allowed, the file and line.
    """
    path = find(str(name))
    tree, files = read(path)
    for key, value in (overrides or {}).items():
        set_key(tree, key, value)
    try:
        raw = apply_preset(tree, files, overrides or {})
        return Scene.model_validate(raw | {STEM: path.stem})
    except ValidationError as error:
        raise InputError(explain(error, Scene, tree, files, overrides or {})) from None


def load_scene(name: str | Path, overrides: Mapping[str, Any] | None = None) -> Scene:
    """`load` for Python: override values may also be numbers, lists and mappings.

        load_scene("shefex2", {"exposure.frames": 3, "exposure.time": "20 ms"})

    A string is YAML, as on the command line; None switches a section off. Raises InputError with one line.
    """
    return load(name, yaml_reader.override_texts(overrides))


def list_scenes() -> list[str]:
    """Names of the scenes that are shipped with skysim."""
    return sorted(path.stem for path in SCENES.glob("*.yaml"))


def with_location(message: str, name: str, overrides: Mapping[str, str]) -> str:
    """A message that begins with a scene's key, with file and line appended; any other message unchanged."""
    key = message.partition(":")[0]
    # Unchanged: messages that do not begin with a key of the scene, or that already end with a place.
    told = re.fullmatch(r"[a-z_]+(\.\w+)*", key)
    if (
        not told
        or key.partition(".")[0] not in Scene.model_fields
        or re.search(r"\((--set|.*, line \d+)\)$", message)
    ):
        return message
    return f"{message} {place_of(key.split('.'), read(find(name))[1], overrides)}"


def read(path: Path, above: tuple[Path, ...] = ()) -> tuple[dict[str, Any], Files]:
    """A scene's keys merged over those of its `base` scene, and the files read, this one first. Raises InputError."""
    tree, text = read_yaml(path)
    if above or tree.keys() != {"camera"}:  # a file with a camera only has no schema version
        check_version(tree, path, text)
    tree = resolve_files(path, tree)
    if "base" not in tree:
        return tree, [(path, text)]
    base = tree.pop("base")
    place = place_of(["base"], [(path, text)], {})
    try:
        below = find(str(path.parent / base) if is_file(path.parent / str(base)) else str(base))
    except InputError as error:
        raise InputError(f"base: {error} {place}") from None
    if below.resolve() in above or below.resolve() == path.resolve():
        raise InputError(f"base: {base} is this scene itself, or has it for its base {place}")
    beneath_it, files = read(below, (*above, path.resolve()))
    return merge(beneath_it, tree), [(path, text), *files]


def apply_preset(tree: dict[str, Any], files: Files, overrides: Mapping[str, str]) -> dict[str, Any]:
    """`with_preset`, with file and line added to its errors."""
    try:
        return with_preset(tree)
    except InputError as error:
        key = str(error).partition(":")[0]
        raise InputError(f"{error} {place_of(key.split('.'), files, overrides)}") from None


# Keys whose value may be a file in the scene's folder.
FILES = (
    ("vehicle", "model"),
    ("camera", "psf", "file"),
    ("camera", "calibration"),
    ("light", "surface", "file"),
    ("light", "layout", "file"),
    ("light", "layout", "points", "file"),
    ("tracker", "map"),
)


def resolve_files(path: Path, tree: dict[str, Any]) -> dict[str, Any]:
    """The scene with file names made absolute if such a file exists in the scene's folder."""
    for keys in FILES:
        tree = resolve_file(path.resolve().parent, tree, *keys)
    return tree


def resolve_file(folder: Path, tree: dict[str, Any], key: str, *inner: str) -> dict[str, Any]:
    """The mapping with the file name under these nested keys made absolute if the file is in the folder."""
    value = tree.get(key)
    if inner and isinstance(value, dict):
        return tree | {key: resolve_file(folder, value, *inner)}
    if not inner and isinstance(value, str) and is_file(folder / value):
        return tree | {key: str(folder / value)}
    return tree


def load_camera(path: Path, lens: Mapping[str, Any] | None = None) -> CameraConfig:
    """The `camera` section of a scene, or of a file with a camera only. Raises InputError with one line.

    lens : values for keys that a preset leaves to its scene; keys of the file override them
    """
    tree, files = read(path)
    if isinstance(tree.get("camera"), dict):
        tree = tree | {"camera": {**(lens or {}), **tree["camera"]}}
    try:
        own = resolve_files(path, {key: tree[key] for key in tree if key == "camera"})
        return CameraFileConfig.model_validate(apply_preset(own, files, {})).camera
    except ValidationError as error:
        raise InputError(explain(error, CameraFileConfig, tree, files, {})) from None
