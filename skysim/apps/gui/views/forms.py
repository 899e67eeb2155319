"""A scene's keys as form fields, derived from the schema: value, unit and allowed values of each."""

import re
from collections.abc import Iterator, Mapping
from functools import cache
from math import radians, tan
from pathlib import Path
from types import NoneType, UnionType
from typing import Annotated, Any, Literal, NamedTuple, Union, get_args, get_origin

from pydantic import BaseModel, ValidationError

from skysim.core.errors import InputError
from skysim.core.paths import SCENES
from skysim.core.types import Record
from skysim.core.yaml_reader import OverrideTexts, read_yaml, yaml_line
from skysim.scene import unused
from skysim.scene.loader import file_names, find, load, read, with_overrides
from skysim.scene.provenance import plain
from skysim.scene.scene import NAME_ALIAS, Scene
from skysim.scene.sections.motion import expand_control
from skysim.tracking import factory as tracker_settings

# Units of numbers without unit, by suffix of the key.
DISPLAY_UNITS = {
    "deg": "deg",
    "arcsec": "arcsec",
    "px": "px",
    "hz": "Hz",
    "e": "e-",
    "e_s": "e-/s",
    "dn": "DN",
    "mag": "mag",
    "deg_s": "deg/s",
    "deg_s2": "deg/s²",
    "rpm": "rpm",
    "c": "°C",
    "e_dn": "e-/DN",
    "deg_h": "deg/h",
    "px_s": "px/s",
}
UNIT_SUFFIX = re.compile(rf"_({'|'.join(sorted(DISPLAY_UNITS, key=len, reverse=True))})$")
SECTIONS = (
    "vehicle",
    "motion",
    "site",
    "light",
    "background",
    "camera",
    "exposure",
    "filter",
    "tracker",
)
NO_SECTION = "none"  # the kind of a section that is left out
# Values for the keys that a kind of section requires, when it is chosen. A kind without such values, for example one
# that names a file, is not offered; nor is another kind of light, which requires another start of the motion.
FIRST_VALUES: Record = {
    "row_time": "10 us",
    "fwhm_px": 2,
    "radius_px": 3,
    "cutoff_deg": 40,
    "transmission": [1, 0.8],
    "angle_deg": [0, 40],
    "intensity": [1, 0.5],
    "apex": "1.5 m",
    "radius": "1.5 m",
    "semi_axes": ["1.5 m", "1.5 m", "1.3 m"],
    "axis": "x",
    "count": 800,
    "frequency": 16,
    "spacing": "40 mm",
    "pitch": "20 mm",
    "cap_deg": 60,
    "temperature_c": 20,
    "start_c": 20,
    "rate_c_h": 1,
    "mean_c": 20,
    "amplitude_c": 2,
    "period": "1 h",
    "altitude": "500 km",
    "inclination_deg": 51.6,
}
ONE_KIND = ("light",)


class FormField(NamedTuple):
    """One key of a scene.

    Attributes
    ----------
    key
        Dotted key
    text
        Value as YAML, from the file or by default
    unit
        Unit of a number without unit
    allowed_values
        Values of an enumeration
    is_set
        Whether a file or an override sets it
    meaning
        Meaning of `null`, if that is one of the allowed values
    no_effect
        Reason why the key has no effect in this scene; empty if it has one
    """

    key: str
    text: str
    unit: str
    allowed_values: tuple[str, ...]
    is_set: bool
    meaning: str = ""
    no_effect: str = ""

    @property
    def section(self) -> str:
        first = self.key.partition(".")[0]
        return first if first in SECTIONS else "scene"

    @property
    def shown(self) -> str:
        """The text in the field."""
        return self.meaning if self.meaning and self.text == "null" else self.text


def fields(name: str, overrides: OverrideTexts) -> list[FormField]:
    """All keys that a scene has or could have, sections in the order of the README. Raises InputError."""
    scene = load(name, overrides)
    tree = with_overrides(read(find(name))[0], overrides)
    stages = tracker_settings.assumed_settings(scene)
    names = tracker_settings.algorithm_names(scene)
    meanings = {f"tracker.{stage}": getattr(stages, stage) for stage in names}
    choices = {f"tracker.{stage}": algorithms for stage, algorithms in names.items()}
    form_fields = [
        item._replace(
            text=overrides.get(item.key, item.text),
            allowed_values=choices.get(item.key, item.allowed_values),
            meaning=meanings.get(item.key, item.meaning),
            no_effect=unused.reason(item.key, scene),
        )
        for item in section_fields(scene, tree, "")
        if item.key not in (NAME_ALIAS, "schema")
    ]
    order = ("scene", *SECTIONS)
    return sorted(form_fields, key=lambda item: order.index(item.section))


def section_fields(
    model: BaseModel, tree: Any, prefix: str, kinds: tuple[str, ...] = ()
) -> Iterator[FormField]:
    """Yield the fields of a section. A list of sections, or a section given by a word (`control: pid`), is one field.

    Parameters
    ----------
    kinds
        Kinds that the section could have instead of its own
    """
    for name, info in type(model).model_fields.items():
        file_key = info.alias or name
        key = f"{prefix}{file_key}"
        value = getattr(model, name)
        is_set = isinstance(tree, dict) and file_key in tree
        subtree = tree[file_key] if is_set else None
        annotation: Any = info.annotation
        others = () if key in ONE_KIND else offered_kinds(annotation)
        if isinstance(value, BaseModel) and (subtree is None or isinstance(subtree, dict)):
            yield from section_fields(value, subtree, f"{key}.", others)
        elif value is None and len(others) == len(models(annotation)) + 1:
            yield FormField(f"{key}.kind", "null", "", others, is_set, NO_SECTION)
        elif file_key == "kind" and kinds:
            yield FormField(key, value, "", tuple(dict.fromkeys((*kinds, value))), is_set)
        else:
            # The path of a shipped file is shortened to its name in scenes/.
            if isinstance(subtree, str) and subtree.startswith(str(SCENES)):
                subtree = str(Path(subtree).relative_to(SCENES))
            text = yaml_line(subtree if is_set else plain(value, name))
            match = UNIT_SUFFIX.search(file_key)
            unit = DISPLAY_UNITS[match[1]] if match else ""
            yield FormField(key, text, unit, allowed_values(annotation), is_set)


def allowed_values(annotation: Any) -> tuple[str, ...]:
    """The allowed values of a Boolean or an enumeration; () for others."""
    if annotation is bool:
        return ("true", "false")
    if get_origin(annotation) is Literal:
        return tuple(str(item) for item in get_args(annotation))
    parts = [item for item in get_args(annotation) if item is not type(None)]
    return (
        allowed_values(parts[0])
        if len(parts) == 1 and get_origin(annotation) is not tuple
        else ()
    )


def models(annotation: Any) -> dict[str, type[BaseModel]]:
    """The models of a section that has several kinds, by kind."""
    if isinstance(annotation, type) and issubclass(annotation, BaseModel):
        kind = annotation.model_fields.get("kind")
        return dict.fromkeys(allowed_values(kind.annotation), annotation) if kind else {}
    found: dict[str, type[BaseModel]] = {}
    for part in (
        get_args(annotation)
        if get_origin(annotation) in (Union, UnionType, Annotated)
        else ()
    ):
        found |= models(part)
    return found


@cache
def offered_kinds(annotation: Any) -> tuple[str, ...]:
    """The kinds to choose from for a section, with NO_SECTION if it may be left out; () if there is no choice."""
    found = tuple(
        kind
        for kind, model in models(annotation).items()
        if first_section(model, kind) is not None
    )
    return (NO_SECTION, *found) if found and NoneType in get_args(annotation) else found


def first_section(
    model: type[BaseModel], kind: str, kept: Mapping[str, Any] | None = None
) -> Record | None:
    """A section of a kind with its required keys and with keys that are kept; None if required values are unknown."""
    required = [
        info.alias or name for name, info in model.model_fields.items() if info.is_required()
    ]
    section = (
        {"kind": kind}
        | {key: FIRST_VALUES[key] for key in required if key in FIRST_VALUES}
        | dict(kept or {})
    )
    try:
        model.model_validate(section)
    except ValidationError:
        return None
    return section


def with_value(name: str, overrides: OverrideTexts, key: str, text: str) -> dict[str, str]:
    """Overrides with a new value of a key, without those that lose their effect by it. Raises InputError.

    A new kind of a section replaces the section.
    """
    section = key.removesuffix(".kind")
    changed = (
        with_kind(name, overrides, section, text)
        if section != key
        else {**overrides, key: text}
    )
    scene = load(name, changed, refuses_unused=False)
    kept = {
        one: value
        for one, value in changed.items()
        if one == key or not unused.reason(one, scene)
    }
    validated_scene(name, kept)
    return kept


def with_kind(name: str, overrides: OverrideTexts, section: str, kind: str) -> dict[str, str]:
    """Overrides that change a section's kind: to that of the file, or to another with the keys that it requires.

    Keys that both kinds have keep their values if the new kind allows all of them; sections do not.
    """
    rest = {
        key: text
        for key, text in overrides.items()
        if key != section and not key.startswith(f"{section}.")
    }
    info, in_file = section_at(load(name, rest, refuses_unused=False), section)
    if kind == getattr(in_file, "kind", NO_SECTION):
        return rest
    if kind == NO_SECTION:
        return rest | {section: "null"}
    model = models(info.annotation)[kind]
    now = section_at(load(name, overrides), section)[1]
    kept = {
        info.alias or field: plain(getattr(now, field), field)
        for field, info in model.model_fields.items()
        if field in getattr(now, "model_fields_set", ())
        and field != "kind"
        and not models(info.annotation)
    }
    found = first_section(model, kind, kept) or first_section(model, kind)
    return rest | {section: yaml_line(found)}


def section_at(scene: Scene, key: str) -> tuple[Any, Any]:
    """The field of a dotted key in the schema, and its value in a scene."""
    info: Any = None
    value: Any = scene
    for part in key.split("."):
        model: type[BaseModel] = type(value)
        name = unused.field_names(model)[part]
        info = model.model_fields[name]
        value = getattr(value, name)
    return info, value


def absolute_path(scene: str) -> str:
    """Absolute path of a scene's file, so that a file in any folder can refer to it."""
    return str(find(scene).resolve())


def validated_scene(name: str, overrides: OverrideTexts) -> Scene:
    """Load the scene with the overrides. Raises InputError if it is invalid or names a file outside its folder."""
    scene = load(name, overrides)
    tree = scene.model_dump(mode="json", by_alias=True)
    folder = find(name).resolve().parent
    for key, name in file_names(tree):
        if not any((at / name).resolve().is_relative_to(at) for at in (folder, SCENES)):
            raise InputError(key, f"{name!r}", "a file in the scene's own folder")
    return scene


def is_scene(path: Path) -> bool:
    """Return True if a YAML file looks like a scene: not a study, and with a camera or a base scene."""
    try:
        tree, _ = read_yaml(path)
    except InputError:
        return False
    return "factors" not in tree and not {"base", "camera"}.isdisjoint(tree)


FEEDBACKS = {
    "truth": "closed by the truth",
    "imu": "closed by the IMU",
    "filter": "closed by the filter",
    "": "open loop",
}


def field_override(name: str, overrides: OverrideTexts, field_deg: float) -> dict[str, str]:
    """Override for another horizontal field of view of a scene: f = width / (2 tan(field / 2)).

    Raises
    ------
    InputError
    """
    if not 0.5 <= field_deg <= 120:
        raise InputError("field", "", "0.5 to 120 deg")
    camera = load(name, overrides).camera
    focal_m = (
        camera.focal_length_m
        / camera.focal_px
        * camera.width_px
        / 2
        / tan(radians(field_deg / 2))
    )
    return {"camera.focal_length": f"{1e3 * focal_m:.5g} mm"}


def loop_overrides(name: str, overrides: OverrideTexts, feedback: str) -> dict[str, str]:
    """Overrides that close the loop with another feedback (a key of FEEDBACKS); "" removes controller and maneuver."""
    tree = with_overrides(read(find(name))[0], overrides)
    control = expand_control(tree.get("motion", {}).get("control"))
    if not feedback or control is None:
        return {"motion.control": "null", "motion.maneuver": "[]"}
    return {"motion.control": yaml_line(control | {"feedback": feedback})}


def save(folder: Path, name: str, base: str, overrides: OverrideTexts, title: str) -> Path:
    """Save a new scene file that consists of a base and overrides. Raises InputError, also if the file exists."""
    from skysim.apps.gui.worker.photo import base_reference, scene_yaml
    from skysim.core import files

    if not re.fullmatch(r"[A-Za-z0-9][\w-]{0,60}", name):
        raise InputError(f"{name!r}", "", "letters, digits, _ and -")
    path = folder / f"{name}.yaml"
    if path.exists():
        raise InputError(path.name, "file exists", "another name")
    validated_scene(base, overrides)
    files.write_text(path, scene_yaml(base_reference(base, folder), dict(overrides), title))
    return path
