"""Memory and time of the estimator on one core; with NUMBA_NUM_THREADS=1.

A 1024 x 1024 camera of 13.5 degrees, 16-bit frames of some 25 stars, by the default settings; after `warm_up`.
"""

from __future__ import annotations

import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np

from benchmarks.timing import figure
from estimator import Camera, Centroids, StarTracker, TrackingMode
from estimator.trackers.pipeline import draw

REPEATS = 100


def rss_mb() -> float:
    """Resident memory of this process, MB."""
    lines = Path("/proc/self/status").read_text(encoding="utf-8").splitlines()
    return int(next(line for line in lines if line.startswith("VmRSS")).split()[1]) / 1024


def megabytes(index: tuple[Any, ...]) -> float:
    """Memory of an index's arrays, MB."""
    return sum(array.nbytes for array in index if isinstance(array, np.ndarray)) / 1e6


def milliseconds(call: Callable[[], object]) -> tuple[float, float]:
    """Median and 99th percentile of a call's duration."""
    taken = []
    for _ in range(REPEATS):
        begin = time.perf_counter()
        call()
        taken.append(time.perf_counter() - begin)
    return 1e3 * float(np.median(taken)), 1e3 * float(np.quantile(taken, 0.99))


def measure() -> list[dict[str, Any]]:
    """Memory, and the times of building, warming up and solving."""
    rows = [figure("libraries loaded", rss_mb(), "MB")]
    camera = Camera.from_fov(1024, 1024, fov_deg=13.5)
    begin = time.perf_counter()
    tracker = StarTracker.for_sky(camera)
    built_s = time.perf_counter() - begin
    stars = f"{len(tracker.stars)} stars"
    pairs_mb = (tracker.sky.pair.nbytes + tracker.sky.first.nbytes) / 1e6
    rows += [
        figure("tracker built in", built_s, "s", stars),
        figure("tracker built", rss_mb(), "MB", stars),
        figure("index of pairs", pairs_mb, "MB", stars),
        figure("index of quads", megabytes(tracker.quads), "MB", stars),
        figure("index of stars", megabytes(tracker.sky) - pairs_mb, "MB", stars),
    ]
    follower = TrackingMode(tracker)
    begin = time.perf_counter()
    follower.warm_up()
    rows += [
        figure("warm_up, compiled before", time.perf_counter() - begin, "s"),
        figure("warmed up", rss_mb(), "MB"),
    ]
    _, xy_px, light = tracker.rich_field()
    xy_px = xy_px[:25]
    light = light[:25]
    image = draw(camera, xy_px, 3000 * light / light.max() + 100, np.dtype("u2"))
    centroids = Centroids(xy_px, np.full(len(xy_px), 0.1), light)
    turned_px = xy_px[:, ::-1].copy()
    mirrored = Centroids(turned_px, centroids.sigma_px, light)
    for name, call in (
        ("centroids, lost in space", lambda: tracker.solve_centroids(centroids)),
        ("centroids, refused", lambda: tracker.solve_centroids(mirrored)),
        ("frame, lost in space", lambda: tracker.solve(image)),
        ("frame, tracked", lambda: follower.solve(image, 0.0)),
    ):
        median, late = milliseconds(call)
        rows += [
            figure(f"{name}: median", median, "ms", f"{REPEATS} calls"),
            figure(f"{name}: 99 %", late, "ms", f"{REPEATS} calls"),
        ]
    return [*rows, figure("at the end", rss_mb(), "MB")]
