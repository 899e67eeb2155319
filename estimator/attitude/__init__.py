"""Attitude from vectors: solvers of Wahba's problem, and of the near-field problem under an LED dome."""

import lazy_loader

# Loaded on first use: importing one module of the package does not import the others.
__getattr__, __dir__, __all__ = lazy_loader.attach(
    __name__,
    submod_attrs={
        "dome_map": ["LedMap", "Lever"],
        "solvers": ["SOLVERS"],
    },
)
