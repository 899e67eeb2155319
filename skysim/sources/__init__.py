"""Light sources: stars of a catalog and LEDs of a dome, as `Sources` with direction or place, strength and pulses."""

import lazy_loader

# Loaded on first use: importing one module of the package does not import the others.
__getattr__, __dir__, __all__ = lazy_loader.attach(
    __name__,
    submod_attrs={
        "catalog": ["Catalog"],
        "photometry": ["Band"],
        "stars": ["cam_from_icrs"],
    },
)
