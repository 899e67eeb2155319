"""Calibration from frames: the camera from star fields, and the dome's LEDs, lever arm and lens at once."""

from estimator.core.lazy import attach

# Loaded on first use: importing one module of the package does not import the others.
__getattr__, __dir__, __all__ = attach(
    __name__,
    {
        "dome_survey": ["DomeSurvey"],
        "home_position": ["HomeCatalog"],
        "star_field": ["Calibration"],
    },
)
