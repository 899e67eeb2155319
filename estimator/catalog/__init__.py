"""On-board catalogs: stars, pairs by separation, and stars by direction."""

from estimator.core.lazy import attach

# Loaded on first use: importing one module of the package does not import the others.
__getattr__, __dir__, __all__ = attach(
    __name__,
    {
        "catalog": ["Observer", "StarCatalog"],
        "pair_index": ["PairIndex"],
        "sky_index": ["SkyIndex"],
    },
)
