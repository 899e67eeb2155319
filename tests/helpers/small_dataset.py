"""What tests of datasets share: a small scene, and what is in a folder."""

from __future__ import annotations

import hashlib
from pathlib import Path
from typing import Any

from skysim.experiments import dataset_run

WIDTH = 240
HEIGHT = 180
SMALL = {
    "camera.width_px": f"{WIDTH}",
    "camera.height_px": f"{HEIGHT}",
    "camera.focal_length": "12 mm",
    "exposure.time": "200 ms",
    "exposure.rate_hz": "4",
    "light.limit_mag": "7.0",
}
VARY = """
schema: 1
trial: {dec_deg: [-60, 60]}
factors:
  rate: {key: trial.rate_deg_s, from: 0.1, to: 0.5}
  lens: {key: camera.f_number, values: [1.4, 2.0]}
hardware: [camera.detector.hardware_seed]
"""


def small(vary: Path | None = None, frames: int = 5, **more: Any) -> dataset_run.DatasetPlan:
    """A dataset of small frames in shards of two."""
    more = {
        "seed": 3,
        "frames_per_shard": 2,
        "formats": dataset_run.FORMATS,
        "overrides": SMALL,
    } | more
    return dataset_run.load("shefex2", vary, frames, **more)


def contents(folder: Path) -> dict[str, str]:
    """The hash of every file of a folder by its name."""
    files = [path for path in sorted(folder.rglob("*")) if path.is_file()]
    return {
        path.relative_to(folder).as_posix(): hashlib.sha256(path.read_bytes()).hexdigest()
        for path in files
    }
