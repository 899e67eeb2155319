"""A star tracker: from a frame alone to an attitude, or a status that says why there is none.

Numpy arrays and floats go in, dataclasses come out. The package imports neither skysim nor MuJoCo.
"""

from typing import Any

# The public names and where they are defined; loaded on first use, so that `import estimator` is quick.
_PUBLIC = {
    "AttitudeFilter": ("filter.mekf", "Mekf"),
    "Camera": ("core.camera", "Camera"),
    "DomeTracker": ("trackers.dome_tracker", "DomeTracker"),
    "ImageError": ("core.errors", "ImageError"),
    "Settings": ("trackers.pipeline", "Settings"),
    "StarCatalog": ("catalog.catalog", "StarCatalog"),
    "StarTracker": ("trackers.star_tracker", "StarTracker"),
    "TrackingMode": ("trackers.tracking_mode", "TrackingMode"),
    "ra_dec_roll_rad": ("core.types", "ra_dec_roll_rad"),
}
__all__ = list(_PUBLIC)


def __getattr__(name: str) -> Any:
    if name not in _PUBLIC:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    from importlib import import_module

    module, attribute = _PUBLIC[name]
    return getattr(import_module(f"{__name__}.{module}"), attribute)
