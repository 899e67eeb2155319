"""Centroids to catalog entries: search for candidate attitudes, and the evidence for each."""

from estimator.core.lazy import attach

# Loaded on first use: importing one module of the package does not import the others.
__getattr__, __dir__, __all__ = attach(
    __name__,
    {
        "options": ["Options"],
        "registry": ["IDENTIFIERS"],
    },
)
