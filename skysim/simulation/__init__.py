"""Run a scene: build the test bed, step the dynamics, expose the frames, close the loop. Owns the random streams."""

import lazy_loader

# Loaded on first use: importing one module of the package does not import the others.
__getattr__, __dir__, __all__ = lazy_loader.attach(
    __name__,
    submod_attrs={
        "exposure": ["render_frame"],
        "run": ["FrameResult", "prepare", "render_frames", "simulate_motion"],
        "testbed": ["Testbed", "build_testbed"],
    },
)
