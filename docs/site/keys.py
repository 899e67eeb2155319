"""Tables of a file's keys, from the models that check it: what a key takes, and what stands for it if left out."""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any

from pydantic import BaseModel

from skysim.apps.gui.page.forms import in_yaml, plain, unit_of
from skysim.core.units import ConfigModel
from skysim.experiments.study.plan import Study  # noqa: F401  the other kind of file, whose sections are Parts too
from skysim.scene.scene import STEM

BOUNDS = {"ge": "≥", "minimum": "≥", "gt": ">", "exclusiveMinimum": ">", "le": "≤", "maximum": "≤", "lt": "<"}
BOUNDS["exclusiveMaximum"] = "<"
WORDS = {"number": "number", "integer": "whole number", "string": "text", "boolean": "true or false"}
WORDS |= {"null": "null", "object": "a section", "array": "list"}


def sections() -> dict[str, type[BaseModel]]:
    """Every section of scene and study files by its full name."""
    return {f"{one.__module__}.{one.__qualname__}": one for one in beneath(ConfigModel)}


def beneath(model: type[BaseModel]) -> Iterator[type[BaseModel]]:
    for one in model.__subclasses__():
        yield one
        yield from beneath(one)


def table(model: type[BaseModel]) -> str:
    """A section's keys as a table of Markdown; nothing for a section without any of its own."""
    schema = model.model_json_schema(by_alias=True)
    names = {one.__name__: name for name, one in sections().items()}
    rows = []
    for name, field in model.model_fields.items():
        key = field.alias or name
        if key == STEM:
            continue
        unit = unit_of(name)
        default = "needed" if field.is_required() else f"`{in_yaml(plain(stood_in(field), unit))}`"
        taken = words(schema["properties"][key], unit, names).replace("|", "\\|")
        rows.append(f"| `{key}` | {taken} | {default} |")
    return "\n".join(["| key | takes | if left out |", "|---|---|---|", *rows]) if rows else ""


def stood_in(field: Any) -> Any:
    """A field's default as the file would have it; of a section what tells its kind."""
    value = field.get_default(call_default_factory=True)
    return (
        value.model_dump(mode="json", by_alias=True, exclude_defaults=True)
        if isinstance(value, BaseModel)
        else value
    )


def words(node: dict[str, Any], unit: str, names: dict[str, str]) -> str:
    """What a key takes, in words."""
    choice = node.get("anyOf") or node.get("oneOf") or node.get("allOf")
    if choice:
        return " or ".join(dict.fromkeys(words(one, unit, names) for one in choice))
    if "$ref" in node:
        name = node["$ref"].rpartition("/")[2]
        return f"[{name}][{names[name]}]" if name in names else name
    if "const" in node or "enum" in node:
        return ", ".join(f"`{one}`" for one in node.get("enum", [node.get("const")]))
    if node.get("type") == "array":
        return listed(node, unit, names)
    told = node.get("description") or WORDS[node.get("type", "object")]
    return ", ".join([told, *bounds(node, unit)])


def listed(node: dict[str, Any], unit: str, names: dict[str, str]) -> str:
    """A list in words: of so many alike, or of any number."""
    each = list(dict.fromkeys(words(one, unit, names) for one in node.get("prefixItems", [])))
    if len(each) == 1:
        return f"list of {len(node['prefixItems'])}: {each[0]}"
    if each:
        return f"list: {'; '.join(each)}"
    return f"list of any length: {words(node['items'], unit, names)}" if node.get("items") else "list"


def bounds(node: dict[str, Any], unit: str) -> Iterator[str]:
    """Its limits, in the unit that the value is kept in."""
    after = f" {unit}" if unit and node.get("type") == "string" else ""
    for word, sign in BOUNDS.items():
        if word in node:
            yield f"{sign} {node[word]:g}{after}"
