"""Array types, errors, the camera model, vectors and least squares. Imports nothing else of the estimator."""

import lazy_loader

# Loaded on first use: importing one module of the package does not import the others.
__getattr__, __dir__, __all__ = lazy_loader.attach(
    __name__,
    submod_attrs={
        "camera": ["Camera"],
        "errors": ["ImageError"],
        "types": ["Attitude", "Centroids", "StarMatch"],
    },
)
