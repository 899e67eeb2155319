"""Refuse options that have no effect by the rules of unused_rules.py.

A key is refused where it is written: in a scene's own file if it has no effect in the scene of this file, and in an
override (`--set`, a study's `set` or factor) if it has none in the resulting scene. Keys of a base scene or a preset
are tolerated. So are keys of the file that only an override makes useless, and values that equal the default.

Studies have further rules (experiments/study/unused_options.py), which `find` searches in the same way.
"""

from collections.abc import Callable, Iterable, Iterator, Sequence
from functools import cache
from typing import Any

from pydantic.fields import FieldInfo

from skysim.core.errors import OVERRIDES, InputError
from skysim.core.units import ConfigModel
from skysim.core.yaml_reader import Files, Keys, OverrideTexts, parse_yaml, where_of
from skysim.scene.scene import HEAD_SECTIONS, Scene
from skysim.scene.unused_rules import RULES, Rule


def check(
    scene: Scene,
    own: Keys,
    overrides: OverrideTexts,
    files: Files,
    without_overrides: Callable[[], Scene],
) -> None:
    """Raise InputError for the first key that has no effect, of the overrides or of the scene's own file.

    Parameters
    ----------
    scene
        The scene, with the overrides
    own
        Keys of its own file, without those of its base
    overrides
        YAML texts by dotted key
    files
        Paths and texts of the files, to locate a key
    without_overrides
        Returns the scene of the file alone
    """
    check_overrides([scene], overrides)
    for key in set_keys(own):
        broken = find(RULES, [key], scene)
        if broken and (not overrides or useless_in_file(key, without_overrides)):
            raise no_effect(*broken).at(where_of(key, files, {}))
    # Keys of heads that have no effect in the head's scene.
    for n, head in enumerate(own.get("heads") or () if not overrides else ()):
        sections = {section: head[section] for section in HEAD_SECTIONS if section in head}
        if broken := find(RULES, set_keys(sections), scene.of_head(n)):
            error = no_effect(*broken).under(f"heads.{n}")
            raise error.at(where_of(error.key, files, {}))


def check_overrides(scenes: Sequence[Scene], overrides: OverrideTexts) -> None:
    """Raise InputError for the first key of the overrides that has no effect in any of the scenes."""
    for key in override_keys(overrides):
        broken = [find(RULES, [key], scene) for scene in scenes]
        if broken[0] and all(broken):
            raise no_effect(*broken[0]).at(OVERRIDES)


def useless_in_file(key: str, without_overrides: Callable[[], Scene]) -> bool:
    """Whether a key of a file has no effect without overrides; False if the file alone is not a valid scene."""
    try:
        return find(RULES, [key], without_overrides()) is not None
    except InputError:
        return False


def no_effect(key: str, rule: Rule) -> InputError:
    """The error for a key that has no effect, with the rule's reason and alternative."""
    last = key.rpartition(".")[2]
    return InputError(key, f"has no effect: {rule.reason}", f"{rule.allowed}, or no {last}")


def find(
    rules: Iterable[Rule], keys: Iterable[str], model: ConfigModel, *subject: Any
) -> tuple[str, Rule] | None:
    """The first dotted key whose value has no effect and is not the default, and the rule; None without such a key.

    Parameters
    ----------
    rules, keys
        Rules and dotted keys to search
    model
        Validated section with the values, usually the scene
    subject
        Arguments of the rules; the model by default
    """
    arguments = subject or (model,)
    for key in keys:
        for rule in rules:
            section = section_of(key, rule)
            if section and differs(model, section) and rule.applies(*arguments):
                return key, rule
    return None


def reason(key: str, scene: Scene) -> str:
    """The reason why a dotted key has no effect in a scene; empty if it has one, or if the scene has no such key."""
    for rule in RULES:
        section = section_of(key, rule)
        if section and field_at(scene, section) and rule.applies(scene):
            return rule.reason
    return ""


def section_of(key: str, rule: Rule) -> str:
    """The rule's key that equals a dotted key or names a section that contains it; empty if there is none."""
    return next((name for name in rule.keys if key == name or key.startswith(f"{name}.")), "")


def differs(model: ConfigModel, dotted: str) -> bool:
    """Whether the model has a value at a dotted key of YAML that is not the default of its field."""
    found = field_at(model, dotted)
    if found is None:
        return False
    field, value = found
    return field.is_required() or bool(value != field.get_default(call_default_factory=True))


def field_at(model: Any, dotted: str) -> tuple[FieldInfo, Any] | None:
    """The field at a dotted key of YAML and its value; None if a section that would contain it is absent."""
    for key in dotted.split("."):
        name = field_names(type(model)).get(key) if isinstance(model, ConfigModel) else None
        if name is None:
            return None
        field = type(model).model_fields[name]
        model = getattr(model, name)
    return field, model


@cache
def field_names(model: type[ConfigModel]) -> dict[str, str]:
    """Names of a model's fields by YAML key."""
    return {field.alias or name: name for name, field in model.model_fields.items()}


def set_keys(tree: Keys, parent: str = "") -> Iterator[str]:
    """Yield the dotted keys that a raw section sets; a list is a value."""
    for key, value in tree.items():
        if isinstance(value, dict) and value:
            yield from set_keys(value, f"{parent}{key}.")
        else:
            yield f"{parent}{key}"


def override_keys(overrides: OverrideTexts) -> list[str]:
    """The dotted keys that overrides set; a value that is a section sets all keys in it."""
    return list(set_keys({key: parse_yaml(text)[1] for key, text in overrides.items()}))
