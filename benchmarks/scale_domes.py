"""What a dome costs before its first frame, as the number of LEDs grows: the places, and the tracker's index of pairs.

The places are those of AFIT's measured dome. The index holds all pairs of LEDs that one field can hold, so it grows
with the square of their number: it has no bar yet.
"""

from __future__ import annotations

import time
from typing import Any

import numpy as np

from benchmarks.timing import figure, verdict
from estimator.attitude.dome_map import LedMap, Lever
from estimator.identification.led_index import build_dome_index
from skysim.core.types import Floats
from skysim.scene import loader
from skysim.simulation.lab import build_lab
from skysim.sources import dome
from skysim.sources.photometry import Band
from skysim.tracking.onboard_model import calibration

KINDS = ("fibonacci", "random", "poisson_disk")
PLACED = (10_000, 100_000)
INDEXED = (2_500, 5_000, 10_000)
MOST_S = 5.0  # CPU time of 100,000 places
CAP_DEG = 40


def places(kind: str, count: int) -> tuple[Floats, float]:
    """(N, 3) places of a layout's LEDs in m, and the CPU seconds that they took."""
    layout = f"{{kind: {kind}, count: {count}, cap_deg: {CAP_DEG}}}"
    scene = loader.load("afit_simsat", {"light.layout": layout})
    assert scene.dome is not None
    band = Band.from_camera(scene.camera)
    begin_s = time.process_time()
    leds = dome.sources(scene.dome, band)
    return leds.place[:, :3], time.process_time() - begin_s


def measure() -> list[dict[str, Any]]:
    """CPU seconds of places by layout and number, then those of the tracker's index and its pairs."""
    rows = []
    places("poisson_disk", 100)
    for kind in KINDS:
        for count in PLACED:
            what = f"{count:,} LEDs"
            spent_s = min(places(kind, count)[1] for _ in range(2))
            rows.append(verdict(f"{kind}: places", spent_s, "s", what, MOST_S))
    lab = build_lab(loader.load("afit_simsat"))
    mount = lab.camera.mount
    lever = Lever(np.array(mount.camera_body_m), mount.cam_from_body)
    camera = calibration(lab.scene.camera)
    for count in INDEXED:
        place_m, _ = places("fibonacci", count)
        leds = LedMap(np.arange(count), place_m, np.zeros(3), np.ones(3), sigma_m=2e-4)
        begin_s = time.process_time()
        index = build_dome_index(leds, lever, camera)
        spent_s = time.process_time() - begin_s
        rows.append(figure("index of pairs", spent_s, "s", f"{count:,} LEDs"))
        pairs = len(index.pairs.pair) / 1e6
        rows.append(figure("pairs of the index", pairs, "million", f"{count:,} LEDs"))
    return rows
