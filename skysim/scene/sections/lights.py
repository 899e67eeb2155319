"""Schema of the scene section `lights`: further lights, of kinds that modules or installed packages add.

A kind is a class derived from `LightConfig` with a literal `kind`; `simulation.lights.registry.register` adds it with
what it makes. A package offers it by an entry point of the group `skysim.lights`, with the kind's name, that names the
module which registers it.
"""

from __future__ import annotations

from typing import Annotated, Any, get_args

from pydantic import (
    AfterValidator,
    ConfigDict,
    ModelWrapValidatorHandler,
    SerializeAsAny,
    model_validator,
)

from skysim.core.errors import InputError, unknown_name
from skysim.core.plugins import PluginKind
from skysim.core.units import ConfigModel

PLUGINS = PluginKind("light", "skysim.lights", "lights.kind", ())
CONFIGS: dict[str, type[LightConfig]] = {}  # of the kinds that were added


def check_kind(kind: str) -> str:
    """The name of a kind. Raises InputError for an unknown one, with the known ones."""
    if kind not in CONFIGS:
        raise InputError(
            "", *unknown_name("light", kind, sorted({*CONFIGS, *PLUGINS.entry_points()}))
        )
    return kind


class LightConfig(ConfigModel):
    """A further light; each kind has a class derived from this one."""

    model_config = ConfigDict(json_schema_extra={"additionalProperties": True})

    kind: Annotated[str, AfterValidator(check_kind)]

    @model_validator(mode="wrap")
    @classmethod
    def validate_by_kind(
        cls, value: Any, handler: ModelWrapValidatorHandler[LightConfig]
    ) -> LightConfig:
        """Validate a section with the class of its `kind` when called on the base class."""
        kind = value.get("kind") if cls is LightConfig and isinstance(value, dict) else None
        if kind not in CONFIGS and kind in PLUGINS.entry_points():
            PLUGINS.entry_points()[kind].load()  # it registers the kind
        return CONFIGS[kind].model_validate(value) if kind in CONFIGS else handler(value)


def add_kind(config: type[LightConfig]) -> str:
    """Add a kind of light to the schema; returns its name, the literal of its `kind`."""
    (kind,) = get_args(config.model_fields["kind"].annotation)
    CONFIGS[kind] = config
    return str(kind)


FurtherLight = SerializeAsAny[LightConfig]
