"""Load a scene: `base` scenes, overrides, camera presets and calibration files, then validation.

`load` makes a scene in one pass:

1. Read the scene's file and its `base` scenes as layers (`read_layers`).
2. Merge them, each over its base, then the overrides of `--set` (`merged`, `with_overrides`). A layer that names a
   camera preset or a vehicle's model also drops the keys that this file defines from the layers below (`over_base`).
3. Merge the camera section over its preset, and the values of a calibration file over both (`apply_preset`).
4. Validate the tree by pydantic.
5. Refuse options that have no effect (unused.py).

Every error becomes an InputError of one line with key, file and line.
"""

import contextlib
import copy
import functools
import json
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any, NamedTuple

from skysim.core import yaml_reader
from skysim.core.errors import InputError, errors_under, errors_within, unknown_name
from skysim.core.paths import DATA, SCENES, shipped_files
from skysim.core.units import ConfigModel, quantity
from skysim.core.yaml_reader import (
    MAPPING,
    Files,
    Keys,
    OverrideTexts,
    Tree,
    check_version,
    explained,
    is_file,
    read_yaml,
    set_key,
    where_of,
)
from skysim.scene import unused
from skysim.scene.opencv_calibration import read as read_calibration
from skysim.scene.scene import HEAD_SECTIONS, NAME_ALIAS, RawKeys, Scene
from skysim.scene.sections.camera import CameraConfig, focus_distance
from skysim.scene.sections.tracker import ASSUMED_KEYS, SURVEYED_KEYS

PRESETS = DATA / "cameras"


def list_cameras() -> list[str]:
    """Names of the camera presets in data/cameras."""
    return list(shipped_files(PRESETS))


def preset_path(name: str) -> Path:
    """The file of a camera preset, which is a name in data/cameras or a path. Raises InputError for an unknown name."""
    path = shipped_files(PRESETS).get(name, Path(name))
    if path.suffix not in (".yaml", ".yml") or not is_file(path):
        problem, names = unknown_name("preset", name, list_cameras())
        raise InputError("camera.preset", problem, f"{names}, or a .yaml file with a camera")
    return path


def preset(name: str) -> Tree:
    """The `camera` section of data/cameras/NAME.yaml, or of a file. Raises InputError for an unknown name."""
    path = preset_path(name)
    with errors_within("camera.preset"):
        camera = resolve_files(path, read_yaml(path)[0]).get("camera")
    if not isinstance(camera, dict) or "preset" in camera:
        raise InputError(
            "camera.preset", f"{path} is not a camera", "a section camera without a preset"
        )
    return camera


def with_preset(tree: Tree) -> Tree:
    """The raw scene with the preset and the calibration of its camera applied. Raises InputError.

    The camera's own keys override those of the preset; the values of the calibration are added to both.
    """
    camera = tree.get("camera")
    if not isinstance(camera, dict) or not {"preset", "calibration"} & set(camera):
        return tree
    own = {
        key: value for key, value in camera.items() if key not in ("preset", "calibration")
    }
    base = preset(str(camera["preset"])) if camera.get("preset") is not None else {}
    if camera.get("calibration") is None:
        return tree | {"camera": merge(base, own)}
    for key in CALIBRATED_KEYS:
        if own.pop(key, None) is not None:
            raise InputError(
                f"camera.{key}",
                "conflicts with camera.calibration",
                "one of the two (null removes a base's)",
            )
    merged = merge(base, own)
    return tree | {
        "camera": merged | calibrated_keys(Path(str(camera["calibration"])), merged)
    }


def with_heads(tree: Tree) -> Tree:
    """The raw scene with complete heads: each section takes missing keys from the main camera. Raises InputError."""
    heads = tree.get("heads")
    if not isinstance(heads, list):
        return tree
    completed = list(heads)
    for n, head in enumerate(heads):
        if not isinstance(head, dict):  # which validation reports
            continue
        own = {key: head[key] for key in HEAD_SECTIONS if isinstance(head.get(key), dict)}
        main = {key: tree[key] for key in own if isinstance(tree.get(key), dict)}
        with errors_under(f"heads.{n}"):
            completed[n] = head | with_preset(over_base(main, own))
    return tree | {"heads": completed}


CALIBRATED_KEYS = (
    "width_px",
    "height_px",
    "focal_length",
    "principal_point_px",
    "distortion",
)


def calibrated_keys(path: Path, camera: Tree) -> Tree:
    """The camera keys that an OpenCV calibration defines: size, focal length, principal point, distortion.

    The focal length in meters follows from the camera's pixel pitch and focus, which the file does not contain.
    Raises InputError.
    """
    with errors_within("camera.calibration"):
        calibration = read_calibration(path)
    try:
        pixel_m = quantity("m", "length", '"5.5 um"')(camera.get("pixel"))
        focus_m = focus_distance(camera.get("focus", "infinity"))
    except InputError as error:
        allowed = f"{error.allowed}; camera.calibration requires it, and focus"
        raise InputError("camera.pixel", error.problem, allowed) from None
    calibrated_px = calibration.width_px, calibration.height_px
    size_px = (
        camera.get("width_px", calibrated_px[0]),
        camera.get("height_px", calibrated_px[1]),
    )
    if size_px != calibrated_px:
        raise InputError(
            "camera.calibration",
            f"{path}: for frames of {calibrated_px[0]}x{calibrated_px[1]}; the preset's are {size_px[0]}x{size_px[1]}",
        )
    # Thin lens: a calibration measures the image distance v, and 1/f = 1/v + 1/u, as in CameraConfig.image_distance_m.
    focal_m = 1 / (1 / (calibration.focal_px * pixel_m) + 1 / focus_m)
    return {
        "width_px": calibration.width_px,
        "height_px": calibration.height_px,
        "focal_length": f"{focal_m!r} m",
        "principal_point_px": list(calibration.center_px),
        "distortion": list(calibration.distortion),
    }


def merge(base: Tree, override: Tree) -> Tree:
    """The mapping `override` merged over `base`, recursively; a section of another kind replaces that of the base."""
    merged = base | override
    for key, value in override.items():
        if is_same_kind(value, base.get(key)):
            merged[key] = merge(base[key], value)
    return merged


def over_base(base: Tree, own: Tree) -> Tree:
    """The keys of a scene merged over the keys of its base.

    A camera preset in `own` also removes the keys of the base that it defines, another `vehicle.model` the mass
    properties of the base's model. `motion.start: profile` removes the rate of the base, which the profile defines,
    `tracker.map` the sizes of the survey's errors and the assumed camera, which the map contains.
    """
    named = plain_at(own, "camera", "preset")
    below = base.get("camera")
    if named is not None and isinstance(below, dict):
        # An unknown preset removes nothing; `with_preset` reports it.
        with contextlib.suppress(InputError):
            base = base | {"camera": undefined_keys(below, preset(str(named)))}
    if plain_at(own, "motion", "start") == "profile":
        base = without_keys(base, "motion", ("rate_deg_s",))
    if has_other_model(own, base):
        base = without_keys(base, "vehicle", MASS_KEYS)
    if plain_at(own, "tracker", "map") is not None:
        base = without_keys(base, "tracker", ASSUMED_KEYS)
        if isinstance(tracker := base.get("tracker"), dict):
            base = base | {"tracker": without_keys(tracker, "survey", SURVEYED_KEYS)}
    return merge(base, own)


# Keys that remove others of the base, see `over_base`.
REPLACING = ("camera.preset", "motion.start", "vehicle.model", "tracker.map")
MASS_KEYS = ("mass", "inertia", "center_of_mass")
# Further keys about the vehicle's body, which those of a base may not suit.
BODY_KEYS = (
    "camera",
    "camera_rotation_deg",
    "torque_limit",
    "wheels",
    "fans",
    "thrusters",
    "cmgs",
    "trim",
    "trims",
    "drag",
)


def plain_at(tree: Tree, section: str, key: str) -> Any:
    """The value of a section's key, None without one."""
    return tree[section].get(key) if isinstance(tree.get(section), dict) else None


def without_keys(tree: Tree, section: str, keys: Sequence[str]) -> Tree:
    """The tree without these keys of a section."""
    inner = tree.get(section)
    if not isinstance(inner, dict):
        return tree
    return tree | {section: {key: inner[key] for key in inner if key not in keys}}


def has_other_model(own: Tree, base: Tree) -> bool:
    """Whether a scene names another model of the vehicle than its base does."""
    names = [plain_at(tree, "vehicle", "model") for tree in (own, base)]
    return None not in names and len({SCENES / str(name) for name in names}) == 2


def inherited_keys(trees: Sequence[Tree]) -> tuple[str, ...]:
    """The BODY_KEYS that a vehicle has from below its model, from a base with another one.

    The trees are those of the layers, the overrides' first.
    """
    for n, tree in enumerate(trees):
        below = trees[n + 1 :]
        if any(has_other_model(tree, base) for base in below):
            return tuple(
                key
                for key in BODY_KEYS
                if all(plain_at(one, "vehicle", key) is None for one in trees[: n + 1])
                and any(plain_at(one, "vehicle", key) is not None for one in below)
            )
    return ()


def undefined_keys(section: Tree, defined: Tree) -> Tree:
    """The keys of a section that another one does not define; nothing of a section of another kind."""
    kept: Tree = {}
    for key, value in section.items():
        if key not in defined:
            kept[key] = value
        elif is_same_kind(value, defined[key]):
            kept[key] = undefined_keys(value, defined[key])
    return kept


def is_same_kind(own: Any, base: Any) -> bool:
    """Whether two values are sections of one kind; a section without `kind` is of any kind."""
    return (
        isinstance(own, dict)
        and isinstance(base, dict)
        and own.get("kind") in (None, base.get("kind"))
    )


class CameraFileConfig(ConfigModel):
    """A file with a camera section only."""

    camera: CameraConfig


def find(name: str) -> Path:
    """The path of a scene given by path or by its name in scenes/. Raises InputError."""
    return yaml_reader.find_file(name, SCENES, "scene")


def load(
    name: str | Path | Keys,
    overrides: OverrideTexts | None = None,
    refuses_unused: bool = True,
    folder: Path = Path(),
) -> Scene:
    """The validated scene of a file or a mapping with overrides.

    Parameters
    ----------
    name
        Name in scenes/, or path, or a mapping with the keys of a file
    overrides
        YAML texts by dotted key, `path.to.key`
    refuses_unused
        Whether an option without effect is an error (unused.py)
    folder
        Folder of the files that a mapping names

    Raises
    ------
    InputError
        With one line: the key, the problem, the allowed values, the file and the line.
    """
    # 1. Files.
    layers = all_layers(name, folder)
    overrides = resolve_overrides(layers[0].path, overrides or {})
    # 2. to 4. Merging and validation.
    scene = validate(layers, overrides)
    changes = f", {dict(overrides)!r}" if overrides else ""
    given = dict(name) if isinstance(name, Mapping) else str(name)
    scene._source.call = f"skysim.load_scene({given!r}{changes})"
    # 5. Options without effect.
    if refuses_unused:
        unused.check(
            scene, layers[0].tree, overrides, locations(layers), lambda: validate(layers, {})
        )
    return scene


def validate(layers: list["Layer"], overrides: OverrideTexts) -> Scene:
    """The scene of layers and overrides: steps 2 to 4 of the module's docstring. Raises InputError."""
    tree = with_overrides(merged(layers), overrides)
    files = locations(layers)
    with explained(tree, files, overrides):
        raw = apply_preset(tree, files, overrides)
        scene = Scene.model_validate(raw | {NAME_ALIAS: layers[0].path.stem})
    trees = (with_overrides({}, overrides), *(layer.tree for layer in layers))
    scene._inherited = inherited_keys(trees)
    scene._source = RawKeys(tree)
    return scene


def keys_of(scene: Scene) -> Tree:
    """The keys from which a scene was loaded, with those of its bases. Raises InputError if they give another scene."""
    keys = dict(scene._source)
    made = load(keys, refuses_unused=False) if keys else None
    if made is None or made.model_dump() != scene.model_dump():
        raise InputError(
            "scene",
            "not as skysim.load_scene returned it",
            "that, a mapping, or changes as overrides",
        )
    return keys


def with_overrides(tree: Tree, overrides: OverrideTexts) -> Tree:
    """The raw scene with dotted keys overridden, those in REPLACING first. `tree` may be changed."""
    for key in REPLACING:
        if key in overrides:
            named: Tree = {}
            set_key(named, key, overrides[key])
            tree = over_base(tree, named)
    for key, value in overrides.items():
        set_key(tree, key, value)
    return tree


def load_scene(name: str | Path | Keys, overrides: Keys | None = None) -> Scene:
    """`load` for Python: values of overrides may also be numbers, lists and mappings.

        load_scene("shefex2", {"exposure.frames": 3, "exposure": {"time": "20 ms"}})

    A string is YAML, as on the command line; None switches a section off. A mapping changes the keys in it, as dotted
    keys do; one with another `kind` replaces the section. Raises InputError.

    Parameters
    ----------
    name
        Name or path of a scene, or a mapping with the keys of its file, such as {"base": "shefex2", "seed": 7}, whose
        file names are relative to the working directory
    """
    base = merged(all_layers(name)) if overrides else {}
    return load(name, yaml_reader.override_texts(overrides, base))


def list_scenes() -> list[str]:
    """Names of the scenes that are shipped with skysim."""
    return list(shipped_files(SCENES))


def located(error: InputError, name: str, overrides: OverrideTexts) -> InputError:
    """The error with file and line, if it is about a key of the scene that was checked after loading."""
    if error.where or error.key.split(".")[0] not in Scene.model_fields:
        return error
    return error.at(where_of(error.key, read(find(name))[1], overrides))


class Layer(NamedTuple):
    """One file of a scene.

    Attributes
    ----------
    path, text
        Path and text
    tree
        Its keys, without `base`
    """

    path: Path
    text: str
    tree: Tree


def all_layers(name: str | Path | Keys, folder: Path = Path()) -> list[Layer]:
    """The layers of a scene; the arguments are those of `load`. Raises InputError."""
    if isinstance(name, Mapping):
        return layers_of(folder / MAPPING, *yaml_reader.as_tree(name))
    return read_layers(find(str(name)))


def read_layers(path: Path, derived: tuple[Path, ...] = ()) -> list[Layer]:
    """The layers of a scene: its file, its `base` scene, the base of that, and so on. Raises InputError.

    Parameters
    ----------
    path
        File of the scene
    derived
        Files that have this one as their base, to detect a cycle
    """
    tree, text = read_yaml(path)
    # A file with only a camera has no schema version.
    if derived or tree.keys() != {"camera"}:
        check_version(tree, path, text)
    return layers_of(path, tree, text, derived)


def layers_of(
    path: Path, tree: Tree, text: str, derived: tuple[Path, ...] = ()
) -> list[Layer]:
    """The layers of a scene with these keys; the arguments are as in `Layer` and `read_layers`. Raises InputError."""
    tree = resolve_files(path, tree)
    if "base" not in tree:
        return [Layer(path, text, tree)]
    base = tree.pop("base")
    where = where_of("base", [(path, text)], {})
    try:
        beside = path.parent / str(base)
        base_path = find(str(beside if is_file(beside) else base))
    except InputError as error:
        raise error.within("base").at(where) from None
    if base_path.resolve() in (*derived, path.resolve()):
        raise InputError("base", f"{base} leads back to this scene", where=where)
    return [Layer(path, text, tree), *read_layers(base_path, (*derived, path.resolve()))]


def merged(layers: list[Layer]) -> Tree:
    """A copy of the keys of a scene, merged over the keys of its base scenes."""
    tree = functools.reduce(over_base, (layer.tree for layer in reversed(layers)))
    return copy.deepcopy(tree)


def locations(layers: list[Layer]) -> Files:
    """Paths and texts of the layers, to locate keys for messages."""
    return [(layer.path, layer.text) for layer in layers]


def read(path: Path) -> tuple[Tree, Files]:
    """The keys of a scene merged over those of its base scenes, and its files, its own first. Raises InputError."""
    layers = read_layers(path)
    return merged(layers), locations(layers)


def apply_preset(tree: Tree, files: Files, overrides: OverrideTexts) -> Tree:
    """The tree with presets and calibrations of camera and heads applied. Raises InputError with file and line."""
    try:
        return with_preset(with_heads(tree))
    except InputError as error:
        raise error.at(where_of(error.key, files, overrides)) from None


# Keys whose value may be a file in the scene's folder; * stands for every item of a list.
FILE_KEYS: tuple[str, ...] = (
    "vehicle.model",
    "motion.maneuver.*.file",
    "camera.preset",
    "camera.psf.file",
    "camera.lens_table",
    "camera.calibration",
    "camera.transmission",
    "camera.detector.quantum_efficiency",
    "camera.detector.quantum_efficiency.curve",
    "camera.detector.quantum_efficiency.red",
    "camera.detector.quantum_efficiency.green",
    "camera.detector.quantum_efficiency.blue",
    "light.catalog",
    "light.satellites.file",
    "light.led.spectrum",
    "light.surface.file",
    "light.layout.catalog",
    "light.layout.file",
    "light.layout.points.file",
    "orbit.file",
    "tracker.catalog",
    "tracker.map",
)
FILE_KEYS += tuple(f"heads.*.{key}" for key in FILE_KEYS if key.startswith(HEAD_SECTIONS))


def resolve_files(path: Path, tree: Tree) -> Tree:
    """The raw scene with file names made absolute if the file is in the folder of the scene."""
    resolved = copy.deepcopy(tree)
    for key, name in file_names(tree):
        if is_file(found := path.resolve().parent / name):
            set_key(resolved, key, json.dumps(str(found), ensure_ascii=False))
    return resolved


def resolve_overrides(path: Path, overrides: OverrideTexts) -> dict[str, str]:
    """The overrides with the names of files in the scene's folder made absolute, unless the command runs beside them.

    A relative `vehicle.model` would be in scenes/, so this name is made absolute in both cases.
    """
    resolved = dict(overrides)
    for key, name in file_names(with_overrides({}, overrides)):
        here = is_file(Path(name))
        found = (Path.cwd() if here else path.resolve().parent) / name
        if is_file(found) and (key == "vehicle.model" or not here):
            resolved[key] = json.dumps(str(found), ensure_ascii=False)
    return resolved


def file_names(tree: Any) -> Iterator[tuple[str, str]]:
    """Yield the dotted keys under which a scene may name files, with their values."""

    def below(
        node: Any, keys: Sequence[str], path: tuple[str, ...]
    ) -> Iterator[tuple[str, str]]:
        """Those below a node that is at path, under further keys."""
        if not keys:
            if isinstance(node, str):
                yield ".".join(path), node
        elif keys[0] == "*" and isinstance(node, list | tuple | dict):
            # Overrides of items are keys of a mapping: heads.0.camera.psf.file.
            items = node.items() if isinstance(node, dict) else enumerate(node)
            for n, item in items:
                yield from below(item, keys[1:], (*path, str(n)))
        elif isinstance(node, dict) and keys[0] in node:
            yield from below(node[keys[0]], keys[1:], (*path, keys[0]))

    for key in FILE_KEYS:
        yield from below(tree, key.split("."), ())


def load_camera(
    path: Path, lens: Keys | None = None, overrides: OverrideTexts | None = None
) -> CameraConfig:
    """The `camera` section of a scene, or of a file with only a camera. Raises InputError.

    Parameters
    ----------
    path
        The file
    lens
        Values for keys that a preset leaves to its scene; keys of the file override them
    overrides
        YAML texts by dotted key
    """
    overrides = overrides or {}
    tree, files = read(path)
    tree = with_overrides(tree, overrides)
    if isinstance(tree.get("camera"), dict):
        tree = tree | {"camera": {**(lens or {}), **tree["camera"]}}
    with explained(tree, files, overrides):
        raw = camera_tree(path, tree, files, overrides)
        return CameraFileConfig.model_validate(raw).camera


def camera_tree(path: Path, tree: Tree, files: Files, overrides: OverrideTexts) -> Tree:
    """A tree with only the section `camera` of a scene, with its preset and calibration applied."""
    own = resolve_files(path, {key: tree[key] for key in tree if key == "camera"})
    return apply_preset(own, files, overrides)
