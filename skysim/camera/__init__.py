"""Photons to digital numbers: optics, point-spread function, smear and the detector. Independent of the vehicle."""

import lazy_loader

# Loaded on first use: importing one module of the package does not import the others.
__getattr__, __dir__, __all__ = lazy_loader.attach(
    __name__,
    submod_attrs={
        "detector.detector": ["Detector"],
        "optics": ["Optics"],
        "psf.kernel": ["PsfModel"],
        "render": ["Window"],
    },
)
