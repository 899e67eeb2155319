"""Whole trackers: frame to attitude under the stars and under a dome, tracking mode, exposure control."""

from estimator.core.lazy import attach

# Loaded on first use: importing one module of the package does not import the others.
__getattr__, __dir__, __all__ = attach(
    __name__,
    {
        "dome_tracker": ["DomeTracker"],
        "pipeline": ["Report", "Settings"],
        "star_tracker": ["StarTracker"],
        "tracking_mode": ["TrackingMode"],
    },
)
