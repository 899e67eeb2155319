"""Frame to blobs: background, thresholding, connected components, and blob classification."""

from estimator.core.lazy import attach

# Loaded on first use: importing one module of the package does not import the others.
__getattr__, __dir__, __all__ = attach(
    __name__,
    {
        "classify": ["Flag"],
        "detect": ["DETECTORS"],
    },
)
