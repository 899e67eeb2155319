"""False-alarm rate: how often the tracker answers frames that do not show the sky, or hardly.

Answers and wrong ones for five kinds of frames, with the cameras of `lost_in_space`:

    no star   : 3 to 30 lights at uniform random positions, with magnitudes of the catalog
    lattice   : lights on a square lattice, turned by any angle, with errors of the noise; a tenth as many
    clumps    : 5 to 90 lights in three clumps; a tenth as many
    mirrored  : a workload's field with its columns reversed, which no rotation of the sky gives; a tenth as many
    few stars : 3 to 5 stars of a field among 30 false lights; a tenth as many. An answer is right if it is within 10'
        of the truth, or of what the true identities of the stars give: three stars side by side hardly tell the roll

The counts so far are printed to stderr after every thousand frames, so that a run in the background can be read.
"""

from __future__ import annotations

import functools
import multiprocessing
import sys
import time
from collections.abc import Callable
from concurrent.futures import ProcessPoolExecutor
from typing import Any

import numpy as np
from scipy.spatial.transform import Rotation

from benchmarks.lost_in_space import WORKLOADS, Field, Workload, field, oracle, sky
from benchmarks.timing import figure, verdict
from estimator.catalog.catalog import StarCatalog
from estimator.core.checks import Floats
from estimator.core.types import Centroids
from estimator.trackers.pipeline import Settings
from estimator.trackers.star_tracker import StarTracker
from skysim.results.metrics import WRONG_RAD

LIGHTS = (3, 30)
FALSE_LIGHTS = 30
STARS = (3, 5)
FRAMES = 100_000
PROCESSES = 2
BATCH = 1000  # frames between two lines of the counts so far
Frame = tuple[Centroids, tuple[Rotation, ...]]  # with the right answers


def no_star(work: Workload, stars: StarCatalog, rng: np.random.Generator) -> Frame:
    """Lights at uniform random positions, brightest first."""
    return false_lights(work, stars, int(rng.integers(LIGHTS[0], LIGHTS[1] + 1)), rng), ()


def lattice(work: Workload, stars: StarCatalog, rng: np.random.Generator) -> Frame:
    """Lights on a lattice of 3 x 3 to 9 x 9 that fills half of the field or more."""
    camera = work.camera
    side = int(rng.integers(3, 10))
    size_px = rng.uniform(0.5, 1.0) * min(camera.width_px, camera.height_px)
    x, y = np.meshgrid(*2 * [np.linspace(-size_px / 2, size_px / 2, side)])
    angle = rng.uniform(0, 2 * np.pi)
    cos = np.cos(angle)
    sin = np.sin(angle)
    xy_px = np.column_stack([x.ravel(), y.ravel()]) @ [[cos, sin], [-sin, cos]]
    return placed(work, stars, xy_px + camera.center_px, rng), ()


def clumps(work: Workload, stars: StarCatalog, rng: np.random.Generator) -> Frame:
    """Lights in three clumps, each a twentieth of the field wide."""
    camera = work.camera
    size_px = np.array([camera.width_px, camera.height_px])
    middle_px = rng.uniform(0.1, 0.9, (3, 2)) * size_px
    count = int(rng.integers(5, 91))
    offset_px = 0.05 * camera.width_px * rng.standard_normal((count, 2))
    return placed(work, stars, middle_px[rng.integers(0, 3, count)] + offset_px, rng), ()


def placed(
    work: Workload, stars: StarCatalog, xy_px: Floats, rng: np.random.Generator
) -> Centroids:
    """Lights at places with the noise of the workload and magnitudes of the catalog, brightest first."""
    xy_px = xy_px + work.noise_px * rng.standard_normal(xy_px.shape)
    xy_px = rng.permutation(xy_px[work.camera.contains(xy_px)])
    mag = np.sort(rng.choice(stars.v_mag, len(xy_px)))
    return Centroids(xy_px, np.full(len(mag), work.noise_px), 10 ** (-0.4 * mag))


def mirrored(work: Workload, stars: StarCatalog, rng: np.random.Generator) -> Frame:
    """A field of the workload, seen in a mirror."""
    seen = field(work, stars, rng).centroids
    xy_px = seen.xy_px * [-1, 1] + [work.camera.width_px - 1, 0]
    return Centroids(xy_px, seen.sigma_px, seen.flux), ()


def few_stars(work: Workload, stars: StarCatalog, rng: np.random.Generator) -> Frame:
    """A few stars of a field among false lights."""
    frame = field(work, stars, rng)
    true = np.flatnonzero(frame.star >= 0)
    true = rng.permutation(true)[: rng.integers(STARS[0], STARS[1] + 1)]
    seen = frame.centroids
    false = false_lights(work, stars, FALSE_LIGHTS, rng)
    xy_px = np.concatenate([seen.xy_px[true], false.xy_px])
    flux = np.concatenate([seen.flux[true], false.flux])
    order = np.argsort(-flux)
    few = Field(seen.take(true), frame.cam_from_icrs, frame.star[true])
    by_identity = oracle(work, stars, few)
    centroids = Centroids(xy_px[order], np.full(len(flux), work.noise_px), flux[order])
    return centroids, (frame.cam_from_icrs,) if by_identity is None else (
        frame.cam_from_icrs,
        by_identity,
    )


def false_lights(
    work: Workload, stars: StarCatalog, count: int, rng: np.random.Generator
) -> Centroids:
    """Lights at uniform random positions with magnitudes of the catalog."""
    camera = work.camera
    xy_px = rng.uniform(-0.5, [camera.width_px - 0.5, camera.height_px - 0.5], (count, 2))
    return Centroids(
        xy_px,
        np.full(count, work.noise_px),
        10 ** (-0.4 * np.sort(rng.choice(stars.v_mag, count))),
    )


KINDS: dict[
    str, tuple[Callable[[Workload, StarCatalog, np.random.Generator], Frame], float]
] = {
    "no star": (no_star, 1.0),
    "lattice": (lattice, 0.1),
    "clumps": (clumps, 0.1),
    "mirrored": (mirrored, 0.1),
    "few stars": (few_stars, 0.1),
}


@functools.cache
def trackers() -> list[tuple[Workload, StarCatalog, StarTracker]]:
    """A tracker of each workload, with its sky, built once in each process."""
    settings = Settings(
        centroid_sigma_px=0.0, field_stars=1e9, merge_px=0.0, zero_point_mag=0.0
    )
    skies = {work.limit_mag: sky(work.limit_mag) for work in WORKLOADS}
    out = []
    for work in WORKLOADS:
        stars = skies[work.limit_mag]
        uncertainty = 1.05 * work.focal_uncertainty
        camera = work.camera.zoomed(1 + work.focal_error)
        out.append(
            (work, stars, StarTracker(camera, stars, stars.vectors, settings, uncertainty))
        )
    return out


def count_answers(kind: str, first: int, count: int, seed: int) -> dict[str, list[int]]:
    """Number of frames, of answers and of wrong answers, by workload, of the frames from `first` on."""
    make = KINDS[kind][0]
    every = trackers()
    out = {f"{work.name} ({work.focal_uncertainty:g})": [0, 0, 0] for work in WORKLOADS}
    for n in range(first, first + count):
        work, stars, tracker = every[n % len(every)]
        centroids, truths = make(work, stars, np.random.default_rng([seed, n]))
        answer = tracker.solve_centroids(centroids).cam_from_ref
        right = answer is not None and any(
            (answer * truth.inv()).magnitude() < WRONG_RAD for truth in truths
        )
        found = (1, answer is not None, answer is not None and not right)
        row = out[f"{work.name} ({work.focal_uncertainty:g})"]
        row[:] = [a + b for a, b in zip(row, found, strict=True)]
        if found[2]:
            told = f"{kind}: wrong answer in frame {n} of seed {seed}, {work.name}"
            print(told, file=sys.stderr, flush=True)
    return out


def measure(count: int = FRAMES, seed: int = 1) -> list[dict[str, Any]]:
    """Answers and wrong answers of each kind of frames by workload, counted in PROCESSES processes."""
    with ProcessPoolExecutor(PROCESSES, multiprocessing.get_context("spawn")) as pool:
        return [row for kind in KINDS for row in measure_kind(kind, count, seed, pool)]


def measure_kind(
    kind: str, count: int, seed: int, pool: ProcessPoolExecutor
) -> list[dict[str, Any]]:
    """The rows of one kind. No frame without a sky may be answered; an answer to few stars may be right."""
    frames = max(round(KINDS[kind][1] * count), 1)
    firsts = range(0, frames, BATCH)
    sizes = [min(BATCH, frames - first) for first in firsts]
    total: dict[str, Any] = {}
    begin = time.perf_counter()
    batches = pool.map(count_answers, [kind] * len(sizes), firsts, sizes, [seed] * len(sizes))
    for batch in batches:
        total = {name: np.add(total.get(name, 0), row) for name, row in batch.items()}
        done, answers, wrong = np.sum(list(total.values()), axis=0)
        speed = done / (time.perf_counter() - begin)
        progress = f"{done} of {frames} frames, {answers} answered, {wrong} wrong; {speed:.0f} frames/s"
        print(f"{kind}: {progress}", file=sys.stderr, flush=True)
    rows = []
    for name, (done, answers, wrong) in total.items():
        what = f"{done} frames"
        rows += [
            figure(f"{kind}, {name}: answered", answers, "frames", what),
            verdict(f"{kind}, {name}: wrong", int(wrong), "frames", what, 0),
        ]
    return rows
