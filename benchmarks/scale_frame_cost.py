"""What a labelled frame costs in CPU and bytes: a linear model, fitted, and tested on frames that it has not seen.

seconds = a + b pixels + c sources, and the same for bytes: a is the work of Python
for any frame, b that of noise, detection and files, c that of projection, drawing and labels. The fit is relative, by
least squares, so that small frames count as much as large ones. docs/explanation/scale.md uses it.
"""

from __future__ import annotations

import tempfile
import time
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from benchmarks.scale_rates import CMOS
from benchmarks.timing import figure
from skysim.core.types import Floats
from skysim.experiments import dataset_run
from skysim.experiments.dataset_shards import Storage

FRAMES = 32
REPEATS = 3
SEEN = (
    (512, 512, 6.0),
    (512, 512, 8.0),
    (1024, 1024, 5.0),
    (1024, 1024, 7.0),
    (1024, 1024, 8.0),
    (1600, 1200, 7.0),
)
UNSEEN = ((800, 600, 7.5), (1280, 960, 6.5), (1400, 1400, 8.0))


class Cost(NamedTuple):
    """What a frame of some size and limiting magnitude costs."""

    width_px: int
    height_px: int
    limit_mag: float
    sources: float
    seconds: float
    bytes_: float

    def terms(self) -> Floats:
        """(3,) 1, millions of pixels, sources."""
        return np.array([1.0, self.width_px * self.height_px / 1e6, self.sources])


def cost_of(width_px: int, height_px: int, limit_mag: float) -> Cost:
    """CPU seconds, bytes and sources a frame, written to a local folder by one process."""
    keys = {
        "camera.width_px": f"{width_px}",
        "camera.height_px": f"{height_px}",
        "light.limit_mag": f"{limit_mag}",
    }
    made = dataset_run.load(
        "shefex2",
        None,
        FRAMES * (REPEATS + 1),
        overrides=CMOS | keys,
        frames_per_shard=FRAMES,
    )
    with tempfile.TemporaryDirectory() as folder:
        storage = Storage(f"{folder}/frames")
        spent = []
        dataset_run.prepare(made, storage)
        for shard in range(REPEATS + 1):
            begin = time.process_time()
            dataset_run.make_shard(made, storage, shard)
            spent.append((time.process_time() - begin) / FRAMES)
        files = [path for path in Path(folder).rglob("*") if path.is_file()]
        size = sum(path.stat().st_size for path in files) / made.frames
    sources = np.mean(
        [len(one.sources) for _, _, _, one in dataset_run.labelled_frames(made, 0)]
    )
    return Cost(width_px, height_px, limit_mag, float(sources), min(spent[1:]), size)


def fit(costs: list[Cost], name: str) -> Floats:
    """(3,) coefficients of a cost, by relative least squares."""
    values = np.array([getattr(one, name) for one in costs])
    terms = np.array([one.terms() for one in costs])
    return np.asarray(
        np.linalg.lstsq(terms / values[:, None], np.ones(len(costs)), rcond=None)[0]
    )


def measure() -> list[dict[str, Any]]:
    """The model's coefficients, what each size costs, and the model's errors, also on what it has not seen."""
    seen = [cost_of(*one) for one in SEEN]
    models = {name: fit(seen, name) for name in ("seconds", "bytes_")}
    rows = []
    for name, coefficients in models.items():
        for term, value in zip(("any frame", "a Mpx", "a source"), coefficients, strict=True):
            rows.append(
                figure(
                    f"{name.strip('_')} of {term}", value, "s" if name == "seconds" else "B"
                )
            )
    for what, costs in (("seen", seen), ("unseen", [cost_of(*one) for one in UNSEEN])):
        for one in costs:
            size = f"{what}, {one.width_px} x {one.height_px}, V {one.limit_mag}"
            sources = f"{one.sources:.0f} sources"
            rows += [
                figure(f"{size}: CPU", 1e3 * one.seconds, "ms", sources),
                figure(f"{size}: size", one.bytes_ / 1e6, "MB", sources),
                *(
                    figure(
                        f"{size}: error of the model's {name.strip('_')}",
                        100 * (model @ one.terms() / getattr(one, name) - 1),
                        "%",
                        sources,
                    )
                    for name, model in models.items()
                ),
            ]
    return rows
