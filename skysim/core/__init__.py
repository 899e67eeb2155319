"""Array types, constants, time scales, errors, units, paths, compiled loops, plug-ins, and safe file access. Imports
nothing else of skysim.
"""

import lazy_loader

__version__ = "0.1.0"  # of skysim; here, so that modules can import it without the package that imports them all

# Loaded on first use: importing one module of the package does not import the others.
__getattr__, __dir__, __all__ = lazy_loader.attach(
    __name__,
    submod_attrs={
        "errors": ["InputError"],
        "types": ["Frame", "FrameRow", "Mount", "Sources", "Telemetry", "Trajectory", "Truth"],
    },
)
