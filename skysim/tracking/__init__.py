"""The star tracker on board: build the estimator of a scene with the hardware parameters that it assumes."""

import lazy_loader

# Loaded on first use: importing one module of the package does not import the others.
__getattr__, __dir__, __all__ = lazy_loader.attach(
    __name__,
    submod_attrs={
        "external.adapter": ["ExternalTracker"],
        "factory": ["build_tracker", "solve_frame"],
        "navigation": ["Navigation"],
    },
)
