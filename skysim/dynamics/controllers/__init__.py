"""External attitude controllers: interface, law of the flight computer, and process of a plug-in."""

import lazy_loader

# Loaded on first use: importing one module of the package does not import the others.
__getattr__, __dir__, __all__ = lazy_loader.attach(
    __name__,
    submod_attrs={
        "interface": ["ControllerInput", "ControllerSetup"],
    },
)
