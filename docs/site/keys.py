"""The keys of scene and study files as Markdown, from the models that check them: a section for each model.

`reference.py` puts them into the reference.
"""

from __future__ import annotations

import inspect
import sys
import typing
from collections.abc import Iterable, Iterator
from pathlib import Path
from typing import Any

from pydantic import BaseModel

sys.path.insert(0, str(Path(__file__).parent))
from docstring_text import to_markdown

from estimator.attitude.nearfield import SOLVERS as DOME_SOLVERS
from estimator.attitude.solvers import SOLVERS as STAR_SOLVERS
from estimator.centroiding.centroid import CENTROIDERS
from estimator.detection.detect import DETECTORS
from estimator.identification.registry import IDENTIFIERS as STAR_IDENTIFIERS
from estimator.trackers.dome_tracker import IDENTIFIERS as DOME_IDENTIFIERS
from skysim.apps.gui.views.forms import yaml_line
from skysim.core.units import ConfigModel, ErrorSchema, si_unit
from skysim.experiments.study.plan import Study
from skysim.scene.provenance import plain
from skysim.scene.scene import NAME_ALIAS, Scene
from skysim.scene.sections.camera import CURVE_FOLDER

BOUNDS = {
    "ge": "≥",
    "minimum": "≥",
    "gt": ">",
    "exclusiveMinimum": ">",
    "le": "≤",
    "maximum": "≤",
    "lt": "<",
}
BOUNDS["exclusiveMaximum"] = "<"
WORDS = {
    "number": "number",
    "integer": "whole number",
    "string": "text",
    "boolean": "true or false",
}
WORDS |= {"null": "null", "object": "a section", "array": "list"}


def names(options: Iterable[str]) -> str:
    return ", ".join(f"`{option}`" for option in options)


def stems(folder: Path, ending: str) -> str:
    return names(sorted(path.stem for path in folder.glob(f"*.{ending}")))


SHIPPED = ("gaia_v8.0", "hipparcos_hp6.5")  # the folder may hold others, built here
CATALOG = f"{names(SHIPPED)}, or an `.ecsv` file of `skysim catalog build`"
# What a text may be, where the model does not say it.
TEXTS = {
    "title": "any text",
    "tracker.name": "`own`, or a tracker of `skysim trackers` or `--program`",
    "tracker.options": "a section; its keys are the tracker's",
    "tracker.detector": names(DETECTORS),
    "tracker.centroider": names(CENTROIDERS),
    "tracker.identifier": f"under stars {names(STAR_IDENTIFIERS)}; under a dome {names(DOME_IDENTIFIERS)}",
    "tracker.solver": f"under stars {names(STAR_SOLVERS)}; under a dome {names(DOME_SOLVERS)}",
    "tracker.catalog": CATALOG,
    "tracker.map": "a file of `skysim survey`",
    "optimize.cost.parts": "`assumed`, or a CSV file of prices",
    "light.catalog": CATALOG,
    "light.layout.catalog": CATALOG,
    "light.layout.file": "a CSV file",
    "light.layout.types": "names of `light.led.types`, one for each listed LED",
    "light.layout.boards.types": "names of `light.led.types`, one for each LED of the board",
    "light.surface.file": "a file of points",
    "light.satellites.file": "a TLE file, or an OMM file as CSV, XML or JSON",
    "orbit.file": "a TLE or OMM file, or with `kind: oem` a CCSDS OEM file",
    "camera.psf.file": "a table of numbers",
    "camera.transmission": "a number > 0 to 1, or a CSV file",
    "light.led.spectrum": "`white`, a CSV file, or a wavelength from 300 nm to 1100 nm",
    "camera.detector.quantum_efficiency": f"a number to 1, or {stems(CURVE_FOLDER, 'csv')}, or a CSV file",
    "camera.detector.quantum_efficiency.curve": f"{stems(CURVE_FOLDER, 'csv')}, or a CSV file",
    **dict.fromkeys(
        (f"camera.detector.quantum_efficiency.{color}" for color in ("red", "green", "blue")),
        f"{stems(CURVE_FOLDER, 'csv')}, or a CSV file",
    ),
    "heads.name": "a word in small letters, other than `main`",
    "vehicle.model": "an MJCF file",
    "motion.control.law": "`pid`, `pd`, or a controller of an entry point or of `--program`",
    "motion.maneuver.file": "a CSV, ECSV, CCSDS AEM or STK `.a` file",
    "vehicle.boxes.name": "any text",
    "lights.kind": "a kind that was [added](../howto/light.md)",
    "vehicle.surroundings.name": "any text",
    "scene": "a name of `skysim scenes`, or a file",
    "factors.key": "a dotted key of the scene, or of the trial (`trial.noise_px`)",
    "factors.keys": "a list of such keys, which all take the value",
    "figures.x": "a factor",
    "figures.by": "a factor",
    "figures.y": "a response, of a heat map a factor",
    "figures.value": "a response",
    "thresholds.response": "a proportion: `identified`, `wrong`, `coverage_4` and their like",
    "thresholds.along": "a factor with numbers",
    "thresholds.by": "a factor",
    "hardware": "a list of dotted keys of seeds",
    "optimize.objectives.response": "a response, or `cost`",
    "optimize.constraints.response": "a response, or `cost`",
    "set": "a section: dotted keys of the scene and their values",
    "responses": "a list of [responses](response_names.md)",
}


class Section(typing.NamedTuple):
    """A model and the paths of the sections that it checks."""

    model: type[BaseModel]
    paths: list[str]


def models(annotation: Any) -> Iterator[type[BaseModel]]:
    """The models within a type, in its order."""
    if isinstance(annotation, ErrorSchema):
        yield annotation.section
    if isinstance(annotation, type) and issubclass(annotation, ConfigModel):
        yield annotation
    for argument in typing.get_args(annotation):
        if not isinstance(argument, str):
            yield from models(argument)


def own_subclasses(model: type[BaseModel]) -> list[type[BaseModel]]:
    """The kinds of a section that skysim has itself."""
    return [one for one in model.__subclasses__() if one.__module__.startswith("skysim.")]


def sections(root: type[BaseModel]) -> dict[str, Section]:
    """The sections beneath a file's model by the model's name, a section before those beneath it."""
    found = {root.__name__: Section(root, [])}

    def visit(model: type[BaseModel], path: str) -> None:
        for name, field in model.model_fields.items():
            below = f"{path}.{field.alias or name}".lstrip(".")
            direct = [
                one for part in (field.annotation, *field.metadata) for one in models(part)
            ]
            for inner in (one for one in direct for one in (one, *own_subclasses(one))):
                known = inner.__name__ in found
                section = found.setdefault(inner.__name__, Section(inner, []))
                if below not in section.paths:
                    section.paths.append(below)
                if not known:
                    visit(inner, below)

    visit(root, "")
    return found


def table(
    model: type[BaseModel], paths: Iterable[str] = (), links: Iterable[str] = ()
) -> str:
    """Markdown table of a section's keys; "" for a section without keys."""
    schema = model.model_json_schema(by_alias=True)
    rows = []
    for name, field in model.model_fields.items():
        key = field.alias or name
        if key == NAME_ALIAS:
            continue
        unit = si_unit(name)
        default = (
            "required"
            if field.is_required()
            else f"`{yaml_line(plain(default_in_file(field), name))}`"
        )
        described = describe(schema["properties"][key], unit, links)
        texts = [
            TEXTS[path]
            for path in (f"{path}.{key}".lstrip(".") for path in paths or [""])
            if path in TEXTS
        ]
        allowed = (
            texts[0] + (" or null" if described.endswith(" or null") else "")
            if texts
            else described
        )
        rows.append(f"| `{key}` | {allowed.replace('|', chr(92) + '|')} | {default} |")
    return "\n".join(["| key | allowed | default |", "|---|---|---|", *rows]) if rows else ""


def default_in_file(field: Any) -> Any:
    """A field's default as written in a file; of a section only what differs from its defaults."""
    value = field.get_default(call_default_factory=True)
    return (
        value.model_dump(mode="json", by_alias=True, exclude_defaults=True)
        if isinstance(value, BaseModel)
        else value
    )


def describe(node: dict[str, Any], unit: str, links: Iterable[str]) -> str:
    """Describe the values that a key allows. links : names of the models that have a heading on the page"""
    choice = node.get("anyOf") or node.get("oneOf") or node.get("allOf")
    if choice:
        return " or ".join(dict.fromkeys(describe(option, unit, links) for option in choice))
    if "$ref" in node:
        name = node["$ref"].rpartition("/")[2]
        return f"[{name}](#{name.lower()})" if name in links else name
    if "const" in node or "enum" in node:
        return names(node.get("enum", [node.get("const")]))
    if node.get("type") == "array":
        return describe_list(node, unit, links)
    if node.get("format") == "date-time":
        return "a date and time in UTC, such as 2012-06-22T21:00:00"
    description = node.get("description") or WORDS[node.get("type", "object")]
    return ", ".join([description, *bounds(node, unit)])


def describe_list(node: dict[str, Any], unit: str, links: Iterable[str]) -> str:
    """Describe a list of fixed or of any length."""
    items = list(
        dict.fromkeys(describe(item, unit, links) for item in node.get("prefixItems", []))
    )
    if len(items) == 1:
        return f"list of {len(node['prefixItems'])}: {items[0]}"
    if items:
        return f"list: {'; '.join(items)}"
    return (
        f"list of any length: {describe(node['items'], unit, links)}"
        if node.get("items")
        else "list"
    )


def bounds(node: dict[str, Any], unit: str) -> Iterator[str]:
    """The limits of a value, in its stored unit."""
    suffix = f" {unit}" if unit and node.get("type") == "string" else ""
    for keyword, symbol in BOUNDS.items():
        if keyword in node:
            yield f"{symbol} {node[keyword]:g}{suffix}"


def model_sections(root: type[BaseModel]) -> str:
    """The sections of a kind of file: one heading per model."""
    found = sections(root)
    parts = []
    for name, (model, paths) in found.items():
        kind = model.model_fields.get("kind")
        kinds = names(typing.get_args(kind.annotation)) if kind else ""
        where = (
            f"Section {names(paths)}" + (f" of kind {kinds}." if kinds else ".")
            if paths
            else ""
        )
        parts += [f"## {name}", where, to_markdown(inspect.cleandoc(model.__doc__ or ""))]
        parts.append(table(model, paths, found))
    return "\n\n".join(part.strip() for part in parts if part.strip())


def scene_keys() -> str:
    """Every key of a scene."""
    return model_sections(Scene)


def study_keys() -> str:
    """Every key of a study."""
    return model_sections(Study)
