"""Tables of the keys of scene and study files, from the models that check them: allowed values and defaults."""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any

from pydantic import BaseModel

from skysim.apps.gui.page.forms import file_value, yaml_line
from skysim.core.units import ConfigModel, si_unit
from skysim.experiments.study.plan import Study  # noqa: F401  so that `subclasses` finds its sections
from skysim.scene.scene import NAME_ALIAS

BOUNDS = {"ge": "≥", "minimum": "≥", "gt": ">", "exclusiveMinimum": ">", "le": "≤", "maximum": "≤", "lt": "<"}
BOUNDS["exclusiveMaximum"] = "<"
WORDS = {"number": "number", "integer": "whole number", "string": "text", "boolean": "true or false"}
WORDS |= {"null": "null", "object": "a section", "array": "list"}


def sections() -> dict[str, type[BaseModel]]:
    """Every section of scene and study files by its full name."""
    return {f"{section.__module__}.{section.__qualname__}": section for section in subclasses(ConfigModel)}


def subclasses(model: type[BaseModel]) -> Iterator[type[BaseModel]]:
    for subclass in model.__subclasses__():
        yield subclass
        yield from subclasses(subclass)


def table(model: type[BaseModel]) -> str:
    """Markdown table of a section's keys; "" for a section without keys."""
    schema = model.model_json_schema(by_alias=True)
    names = {section.__name__: name for name, section in sections().items()}
    rows = []
    for name, field in model.model_fields.items():
        key = field.alias or name
        if key == NAME_ALIAS:
            continue
        unit = si_unit(name)
        default = "required" if field.is_required() else f"`{yaml_line(file_value(default_in_file(field), unit))}`"
        description = describe(schema["properties"][key], unit, names).replace("|", "\\|")
        rows.append(f"| `{key}` | {description} | {default} |")
    return "\n".join(["| key | allowed | default |", "|---|---|---|", *rows]) if rows else ""


def default_in_file(field: Any) -> Any:
    """A field's default as written in a file; of a section only what differs from its defaults."""
    value = field.get_default(call_default_factory=True)
    return (
        value.model_dump(mode="json", by_alias=True, exclude_defaults=True) if isinstance(value, BaseModel) else value
    )


def describe(node: dict[str, Any], unit: str, names: dict[str, str]) -> str:
    """Describe the values that a key allows."""
    choice = node.get("anyOf") or node.get("oneOf") or node.get("allOf")
    if choice:
        return " or ".join(dict.fromkeys(describe(option, unit, names) for option in choice))
    if "$ref" in node:
        name = node["$ref"].rpartition("/")[2]
        return f"[{name}][{names[name]}]" if name in names else name
    if "const" in node or "enum" in node:
        return ", ".join(f"`{option}`" for option in node.get("enum", [node.get("const")]))
    if node.get("type") == "array":
        return describe_list(node, unit, names)
    description = node.get("description") or WORDS[node.get("type", "object")]
    return ", ".join([description, *bounds(node, unit)])


def describe_list(node: dict[str, Any], unit: str, names: dict[str, str]) -> str:
    """Describe a list of fixed or of any length."""
    items = list(dict.fromkeys(describe(item, unit, names) for item in node.get("prefixItems", [])))
    if len(items) == 1:
        return f"list of {len(node['prefixItems'])}: {items[0]}"
    if items:
        return f"list: {'; '.join(items)}"
    return f"list of any length: {describe(node['items'], unit, names)}" if node.get("items") else "list"


def bounds(node: dict[str, Any], unit: str) -> Iterator[str]:
    """The limits of a value, in its stored unit."""
    suffix = f" {unit}" if unit and node.get("type") == "string" else ""
    for keyword, symbol in BOUNDS.items():
        if keyword in node:
            yield f"{symbol} {node[keyword]:g}{suffix}"
