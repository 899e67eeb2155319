"""A star tracker: from a frame alone to an attitude, or a status that says why there is none.

Numpy arrays and floats go in, dataclasses come out. The package imports neither skysim nor MuJoCo.
"""

import importlib
from typing import Any

MODULE_OF = {
    "Attitude": "core.types",
    "AttitudeFilter": "filter.mekf",
    "Camera": "core.camera",
    "Centroids": "core.types",
    "DomeTracker": "trackers.dome_tracker",
    "GyroModel": "filter.error_models",
    "Health": "trackers.tracking_mode",
    "ImageError": "core.errors",
    "LedMap": "attitude.dome_map",
    "Lever": "attitude.dome_map",
    "Report": "trackers.pipeline",
    "Settings": "trackers.pipeline",
    "StarCatalog": "catalog.catalog",
    "StarTracker": "trackers.star_tracker",
    "TrackingMode": "trackers.tracking_mode",
    "ra_dec_roll_rad": "core.types",
}
__all__ = sorted(MODULE_OF)


def __getattr__(name: str) -> Any:
    """A public name, loaded on first use (PEP 562), so that `import estimator` is quick."""
    if name not in MODULE_OF:
        raise AttributeError(
            f"module estimator has no attribute {name}; public: {', '.join(__all__)}"
        )
    value = getattr(importlib.import_module(f"estimator.{MODULE_OF[name]}"), name)
    globals()[name] = value
    return value


def __dir__() -> list[str]:
    return __all__
