"""JSON messages to and from plug-ins: arrays to lists, and lists to checked arrays."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np
from numpy.typing import NDArray

Floats = NDArray[np.float64]


def to_lists(value: Any) -> Any:
    """Convert arrays to lists, in mappings and sequences at any depth."""
    if isinstance(value, np.ndarray | np.generic):
        return value.tolist()
    if isinstance(value, Mapping):
        return {name: to_lists(inner) for name, inner in value.items()}
    return [to_lists(inner) for inner in value] if isinstance(value, list | tuple) else value


def finite_array(value: Any, name: str, shape: tuple[int, ...]) -> Floats:
    """An array of finite numbers of the given shape. Raises ValueError."""
    try:
        array = np.array(value, dtype=np.float64)
    except (TypeError, ValueError, OverflowError):
        raise ValueError(f"{name} is not an array of numbers") from None
    if array.shape != shape:
        raise ValueError(f"{name} has shape {array.shape}; allowed: {shape}")
    if not np.isfinite(array).all():
        raise ValueError(f"{name} has a value that is not finite")
    return array
