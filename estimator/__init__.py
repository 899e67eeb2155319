"""A star tracker: from a frame alone to an attitude, or a status that says why there is none.

Numpy arrays and floats go in, dataclasses come out. The package imports neither skysim nor MuJoCo.
"""

from estimator.core.lazy import attach

# Loaded on first use, so that `import estimator` is quick.
__getattr__, __dir__, __all__ = attach(
    __name__,
    {
        "catalog.catalog": ["StarCatalog"],
        "core.camera": ["Camera"],
        "core.errors": ["ImageError"],
        "core.types": ["Attitude", "Centroids", "ra_dec_roll_rad"],
        "filter.mekf": ["AttitudeFilter", "GyroModel"],
        "trackers.dome_tracker": ["DomeTracker"],
        "trackers.pipeline": ["Report", "Settings"],
        "trackers.star_tracker": ["StarTracker"],
        "trackers.tracking_mode": ["Health", "TrackingMode"],
    },
)
