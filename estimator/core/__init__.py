"""Array types, errors, the camera model, vectors and least squares. Imports nothing else of the estimator."""

from estimator.core.lazy import attach

# Loaded on first use: importing one module of the package does not import the others.
__getattr__, __dir__, __all__ = attach(
    __name__,
    {
        "camera": ["Camera"],
        "errors": ["ImageError"],
        "types": ["Attitude", "Centroids", "StarMatch"],
    },
)
