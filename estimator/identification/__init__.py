"""Centroids to catalog entries: search for candidate attitudes, and the evidence for each."""

import lazy_loader

# Loaded on first use: importing one module of the package does not import the others.
__getattr__, __dir__, __all__ = lazy_loader.attach(
    __name__,
    submod_attrs={
        "options": ["Options"],
        "registry": ["IDENTIFIERS"],
    },
)
