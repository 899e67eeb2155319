"""User-facing programs: command line, browser GUI, real-time stream and plate solver."""

import lazy_loader

# Loaded on first use: importing one module of the package does not import the others.
__getattr__, __dir__, __all__ = lazy_loader.attach(
    __name__, submod_attrs={"plate_solver": ["solve"]}
)
