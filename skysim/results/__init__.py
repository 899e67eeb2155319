"""Results of a run: metrics, scores, reports and files."""

import lazy_loader

# Loaded on first use: importing one module of the package does not import the others.
__getattr__, __dir__, __all__ = lazy_loader.attach(
    __name__,
    submod_attrs={
        "metrics": ["Summary"],
        "run": ["Recorder", "Run", "ScoredFrame", "render", "score_frames", "simulate"],
    },
)
