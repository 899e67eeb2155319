"""Whole trackers: frame to attitude under the stars and under a dome, tracking mode, exposure control."""

import lazy_loader

# Loaded on first use: importing one module of the package does not import the others.
__getattr__, __dir__, __all__ = lazy_loader.attach(
    __name__,
    submod_attrs={
        "dome_tracker": ["DomeTracker"],
        "pipeline": ["Report", "Settings"],
        "star_tracker": ["StarTracker"],
        "tracking_mode": ["TrackingMode"],
    },
)
