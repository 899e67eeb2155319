"""A star tracker: from a frame alone to an attitude, or a status that says why there is none.

Numpy arrays and floats go in, dataclasses come out. The package imports neither skysim nor MuJoCo.
"""

import lazy_loader

# Loaded on first use, so that `import estimator` is quick.
__getattr__, __dir__, __all__ = lazy_loader.attach(
    __name__,
    submod_attrs={
        "catalog.catalog": ["StarCatalog"],
        "core.camera": ["Camera"],
        "core.errors": ["ImageError"],
        "core.types": ["ra_dec_roll_rad"],
        "filter.mekf": ["AttitudeFilter"],
        "trackers.dome_tracker": ["DomeTracker"],
        "trackers.pipeline": ["Settings"],
        "trackers.star_tracker": ["StarTracker"],
        "trackers.tracking_mode": ["TrackingMode"],
    },
)
