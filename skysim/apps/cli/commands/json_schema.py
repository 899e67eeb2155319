"""JSON Schema of scene and study files, for editors.

The schema tells an editor which keys exist and what values they may hold. It requires only the key `schema` (the
(version), because an editor does not know which keys come from a `base` or a preset; `skysim validate` also reports
missing keys.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from pydantic import BaseModel

from skysim.experiments.study.plan import Study
from skysim.scene.camera import CameraConfig
from skysim.scene.scene import STEM, Scene

KINDS: Mapping[str, type[BaseModel]] = {"scene": Scene, "study": Study}
BESIDE: Mapping[str, dict[str, Any]] = {  # keys that are taken out before a file is checked
    Scene.__name__: {"base": {"type": "string", "description": "another scene, by name or beside this one"}},
    CameraConfig.__name__: {
        "preset": {"type": "string", "description": "a file of data/cameras: what is left out is from there"},
        "calibration": {
            "type": "string",
            "description": "a file of OpenCV's: focal length, centre, distortion",
        },
    },
}
STANDARD = "https://json-schema.org/draft/2020-12/schema"
DROPPED = ("required", "discriminator", "default")
BOUNDS = {"ge": "minimum", "gt": "exclusiveMinimum", "le": "maximum", "lt": "exclusiveMaximum"}


def json_schema(kind: str) -> dict[str, Any]:
    """The JSON Schema (draft 2020-12) of a kind of file."""
    model = KINDS[kind]
    told = loosened(model.model_json_schema(by_alias=True), model.__name__)
    return {"$schema": STANDARD, "title": f"A {kind} of skysim", "required": ["schema"]} | {
        k: v for k, v in told.items() if k != "title"
    }


def loosened(node: Any, name: str = "") -> Any:
    """Return the schema without required keys, defaults and discriminators; `oneOf` becomes `anyOf`.

    name : of the definition that `node` is, for which BESIDE may add keys
    """
    if isinstance(node, list):
        return [loosened(one) for one in node]
    if not isinstance(node, dict):
        return node
    kept: dict[str, Any] = {}
    for key, value in node.items():
        if key == "properties":
            told = {one: loosened(of) for one, of in value.items() if one != STEM}
            kept[key] = told | BESIDE.get(name, {})
        elif key == "$defs":
            kept[key] = {one: loosened(of, one) for one, of in value.items()}
        elif key in BOUNDS:  # pydantic's keyword remains where a validator precedes the bound
            kept |= {BOUNDS[key]: value} if node.get("type") in ("number", "integer") else {}
        elif key not in DROPPED and (key != "title" or name):
            kept["anyOf" if key == "oneOf" else key] = loosened(value)
    return kept
