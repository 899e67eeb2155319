"""On-board catalogs: stars, pairs by separation, and stars by direction."""

import lazy_loader

# Loaded on first use: importing one module of the package does not import the others.
__getattr__, __dir__, __all__ = lazy_loader.attach(
    __name__,
    submod_attrs={
        "catalog": ["Observer", "StarCatalog"],
        "pair_index": ["PairIndex"],
        "sky_index": ["SkyIndex"],
    },
)
