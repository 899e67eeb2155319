"""Memory and time of the estimator on one core: `NUMBA_NUM_THREADS=1 python -m benchmarks.footprint`.

A 1024 x 1024 camera of 13.5 degrees, 16-bit frames of some 25 stars, by the default settings; after `warm_up`.
"""

from __future__ import annotations

import time
from collections.abc import Callable, Iterator
from pathlib import Path

import numpy as np

from estimator import Camera, Centroids, StarTracker, TrackingMode
from estimator.trackers.warm_up import draw

REPEATS = 200


def rss_mb() -> float:
    """Resident memory of this process, MB."""
    lines = Path("/proc/self/status").read_text(encoding="utf-8").splitlines()
    return int(next(line for line in lines if line.startswith("VmRSS")).split()[1]) / 1024


def milliseconds(call: Callable[[], object]) -> tuple[float, float]:
    """Median and 99th percentile of a call's duration."""
    taken = []
    for _ in range(REPEATS):
        begin = time.perf_counter()
        call()
        taken.append(time.perf_counter() - begin)
    return 1e3 * float(np.median(taken)), 1e3 * float(np.quantile(taken, 0.99))


def measured() -> Iterator[str]:
    """The lines of the table."""
    yield f"libraries loaded: {rss_mb():.0f} MB"
    camera = Camera.from_fov(1024, 1024, fov_deg=13.5)
    begin = time.perf_counter()
    tracker = StarTracker.for_sky(camera)
    yield f"tracker of {len(tracker.stars)} stars built: {time.perf_counter() - begin:.2f} s, {rss_mb():.0f} MB"
    pairs_mb = (tracker.sky.pair.nbytes + tracker.sky.first.nbytes) / 1e6
    yield f"index of pairs: {pairs_mb:.1f} MB, of stars: {tracker.sky.bytes / 1e6 - pairs_mb:.1f} MB"
    follower = TrackingMode(tracker)
    begin = time.perf_counter()
    follower.warm_up()
    yield f"warm_up, compiled before: {time.perf_counter() - begin:.1f} s, {rss_mb():.0f} MB"
    _, xy_px, light = tracker.rich_field()
    xy_px = xy_px[:25]
    light = light[:25]
    image = draw(camera, xy_px, 3000 * light / light.max() + 100, np.dtype("u2"))
    centroids = Centroids(xy_px, np.full(len(xy_px), 0.1), light)
    for name, call in (
        ("centroids, lost in space", lambda: tracker.solve_centroids(centroids)),
        ("frame, lost in space", lambda: tracker.solve(image)),
        ("frame, tracked", lambda: follower.solve(image, 0.0)),
    ):
        median, late = milliseconds(call)
        yield f"{name}: median {median:.2f} ms, 99 % {late:.2f} ms"
    yield f"at the end: {rss_mb():.0f} MB"


if __name__ == "__main__":
    for line in measured():
        print(line, flush=True)
