"""External star trackers: the interface, the process that runs one, and the plug-in for tetra3rs."""

import lazy_loader

# Loaded on first use: importing one module of the package does not import the others.
__getattr__, __dir__, __all__ = lazy_loader.attach(
    __name__,
    submod_attrs={
        "interface": ["Answer", "Picture", "Setup"],
    },
)
