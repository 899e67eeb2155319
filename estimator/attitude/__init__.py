"""Attitude from vectors: solvers of Wahba's problem, and of the near-field problem under an LED dome."""

from estimator.core.lazy import attach

# Loaded on first use: importing one module of the package does not import the others.
__getattr__, __dir__, __all__ = attach(
    __name__,
    {
        "dome_map": ["LedMap", "Lever"],
        "solvers": ["SOLVERS"],
    },
)
