"""Calibration from frames: the camera from star fields, and the dome's LEDs, lever arm and lens at once."""

import lazy_loader

# Loaded on first use: importing one module of the package does not import the others.
__getattr__, __dir__, __all__ = lazy_loader.attach(
    __name__,
    submod_attrs={
        "dome_survey": ["DomeSurvey"],
        "home_position": ["HomeCatalog"],
        "star_field": ["Calibration"],
    },
)
