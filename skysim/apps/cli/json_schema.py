"""JSON Schema of scene and study files, for editors.

The schema tells an editor which keys exist and what values they may hold. It requires only the key `schema` (the
version), because an editor does not know which keys come from a `base` or a preset; `skysim validate` also reports
missing keys.
"""

from collections.abc import Mapping
from typing import Any

from pydantic import BaseModel

from skysim.core.types import Record
from skysim.experiments.study.plan import Study
from skysim.scene.scene import NAME_ALIAS, Scene
from skysim.scene.sections.camera import CameraConfig

KINDS: Mapping[str, type[BaseModel]] = {"scene": Scene, "study": Study}
EXTRA_KEYS: Mapping[str, Record] = {  # keys that the loader resolves before validation
    Scene.__name__: {
        "base": {
            "type": "string",
            "description": "another scene: its name, or a file beside this one",
        }
    },
    CameraConfig.__name__: {
        "preset": {
            "type": "string",
            "description": "a file of data/cameras that supplies the missing keys",
        },
        "calibration": {
            "type": "string",
            "description": "an OpenCV calibration file: focal length, center, distortion",
        },
    },
}
DIALECT = "https://json-schema.org/draft/2020-12/schema"
DROPPED_KEYWORDS = ("required", "discriminator", "default")
BOUND_KEYWORDS = {
    "ge": "minimum",
    "gt": "exclusiveMinimum",
    "le": "maximum",
    "lt": "exclusiveMaximum",
}


def json_schema(kind: str) -> Record:
    """The JSON Schema (draft 2020-12) of a kind of file."""
    model = KINDS[kind]
    schema = relaxed(model.model_json_schema(by_alias=True), model.__name__)
    return {"$schema": DIALECT, "title": f"A {kind} of skysim", "required": ["schema"]} | {
        key: value for key, value in schema.items() if key != "title"
    }


def relaxed(node: Any, name: str = "") -> Any:
    """Return the schema without required keys, defaults and discriminators; `oneOf` becomes `anyOf`.

    Parameters
    ----------
    name
        Name of the definition, to which EXTRA_KEYS may add keys
    """
    if isinstance(node, list):
        return [relaxed(item) for item in node]
    if not isinstance(node, dict):
        return node
    relaxed_node: Record = {}
    for key, value in node.items():
        if key == "properties":
            properties = {
                key_name: relaxed(child)
                for key_name, child in value.items()
                if key_name != NAME_ALIAS
            }
            relaxed_node[key] = properties | EXTRA_KEYS.get(name, {})
        elif key == "$defs":
            relaxed_node[key] = {
                key_name: relaxed(child, key_name) for key_name, child in value.items()
            }
        elif (
            key in BOUND_KEYWORDS
        ):  # pydantic's keyword remains where a validator precedes the bound
            if node.get("type") in ("number", "integer"):
                relaxed_node[BOUND_KEYWORDS[key]] = value
        elif key not in DROPPED_KEYWORDS and (key != "title" or name):
            relaxed_node["anyOf" if key == "oneOf" else key] = relaxed(value)
    return relaxed_node
