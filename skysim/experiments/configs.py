"""Copies of scenes with some keys replaced."""

from __future__ import annotations

from typing import Any, TypeVar

from skysim.core.units import ConfigModel

Config = TypeVar("Config", bound=ConfigModel)


def with_config(config: Config, section: str, **values: Any) -> Config:
    """Copy a scene with values of a section replaced, without validation; `section` may be nested, as `light.led`."""
    head, _, rest = section.partition(".")
    inner = getattr(config, head)
    changed = with_config(inner, rest, **values) if rest else inner.model_copy(update=values)
    return config.model_copy(update={head: changed})
