"""False-alarm rate: how often the tracker solves frames without stars.

`python -m benchmarks.false_frames [FRAMES] [SEED]`. Each frame has 3 to 30 lights at uniform random positions with
magnitudes drawn from the catalog, for the cameras of `lost_in_space`; every solution is false. A hundred thousand
frames take a quarter of an hour.
"""

from __future__ import annotations

import sys
from itertools import cycle

import numpy as np

from benchmarks.lost_in_space import WORKLOADS, Workload, sky
from estimator.core.types import Centroids
from estimator.trackers.pipeline import Settings
from estimator.trackers.star_tracker import StarTracker

LIGHTS = (3, 30)


def false_frame(work: Workload, mag: np.ndarray, rng: np.random.Generator) -> Centroids:
    """Lights at uniform random positions, brightest first."""
    count = rng.integers(LIGHTS[0], LIGHTS[1] + 1)
    camera = work.camera
    xy = rng.uniform(-0.5, [camera.width_px - 0.5, camera.height_px - 0.5], (count, 2))
    return Centroids(xy, np.full(count, work.noise_px), 10 ** (-0.4 * np.sort(rng.choice(mag, count))))


def count_solutions(count: int, seed: int) -> dict[str, tuple[int, int]]:
    """Number of frames and number of (false) solutions, by camera."""
    settings = Settings(centroid_sigma_px=0.0, field_stars=1e9, merge_px=0.0, zero_point_mag=0.0)
    trackers = []
    for work in WORKLOADS:
        stars = sky(work.limit_mag)
        trackers.append((work, stars.v_mag, StarTracker(work.camera, stars, stars.vectors, settings)))
    out = {work.name: (0, 0) for work in WORKLOADS}
    for n, (work, mag, tracker) in zip(range(count), cycle(trackers), strict=False):
        centroids = false_frame(work, mag, np.random.default_rng([seed, n]))
        frames, wrong = out[work.name]
        out[work.name] = frames + 1, wrong + tracker.solve_centroids(centroids).solved
    return out


if __name__ == "__main__":
    count, seed = (int(one) for one in (sys.argv[1:3] + ["100000", "1"][len(sys.argv[1:3]) :]))
    for name, (frames, wrong) in count_solutions(count, seed).items():
        print(f"{name:30s} {frames:7d} frames without a star, {wrong} answered")
