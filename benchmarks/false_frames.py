"""False-alarm rate: how often the tracker answers frames that do not show the sky, or hardly.

`python -m benchmarks.false_frames [FRAMES] [SEED]`, with the cameras of `lost_in_space`, prints the number of answers
and of wrong ones for three kinds of frames:

    no star   : 3 to 30 lights at uniform random positions, with magnitudes of the catalog; FRAMES of them
    mirrored  : a workload's field with its columns reversed, which no rotation of the sky gives; FRAMES / 10
    few stars : 3 to 5 stars of a field among 30 false lights; FRAMES / 10. An answer may be right

A hundred thousand frames take a quarter of an hour.
"""

from __future__ import annotations

import sys
from collections.abc import Callable
from itertools import cycle

import numpy as np
from scipy.spatial.transform import Rotation

from benchmarks.lost_in_space import WORKLOADS, Workload, field, sky
from estimator.catalog.catalog import StarCatalog
from estimator.core.types import Centroids
from estimator.trackers.pipeline import Settings
from estimator.trackers.star_tracker import StarTracker
from skysim.results.metrics import WRONG_RAD

LIGHTS, FALSE_LIGHTS, STARS = (3, 30), 30, (3, 5)
Frame = tuple[Centroids, Rotation | None]  # with the true attitude, if it has one


def no_star(work: Workload, stars: StarCatalog, rng: np.random.Generator) -> Frame:
    """Lights at uniform random positions, brightest first."""
    return false_lights(work, stars, int(rng.integers(LIGHTS[0], LIGHTS[1] + 1)), rng), None


def mirrored(work: Workload, stars: StarCatalog, rng: np.random.Generator) -> Frame:
    """A field of the workload, seen in a mirror."""
    seen = field(work, stars, rng).centroids
    xy_px = seen.xy_px * [-1, 1] + [work.camera.width_px - 1, 0]
    return Centroids(xy_px, seen.sigma_px, seen.flux), None


def few_stars(work: Workload, stars: StarCatalog, rng: np.random.Generator) -> Frame:
    """A few stars of a field among false lights."""
    frame = field(work, stars, rng)
    true = np.flatnonzero(frame.star >= 0)
    true = rng.permutation(true)[: rng.integers(STARS[0], STARS[1] + 1)]
    seen, false = frame.centroids, false_lights(work, stars, FALSE_LIGHTS, rng)
    xy_px = np.concatenate([seen.xy_px[true], false.xy_px])
    flux = np.concatenate([seen.flux[true], false.flux])
    order = np.argsort(-flux)
    return Centroids(xy_px[order], np.full(len(flux), work.noise_px), flux[order]), frame.cam_from_icrs


def false_lights(work: Workload, stars: StarCatalog, count: int, rng: np.random.Generator) -> Centroids:
    """Lights at uniform random positions with magnitudes of the catalog."""
    camera = work.camera
    xy_px = rng.uniform(-0.5, [camera.width_px - 0.5, camera.height_px - 0.5], (count, 2))
    return Centroids(xy_px, np.full(count, work.noise_px), 10 ** (-0.4 * np.sort(rng.choice(stars.v_mag, count))))


KINDS: dict[str, tuple[Callable[[Workload, StarCatalog, np.random.Generator], Frame], float]] = {
    "no star": (no_star, 1.0),
    "mirrored": (mirrored, 0.1),
    "few stars": (few_stars, 0.1),
}


def count_answers(kind: str, count: int, seed: int) -> dict[str, list[int]]:
    """Number of frames, of answers and of wrong answers, by workload."""
    make = KINDS[kind][0]
    settings = Settings(centroid_sigma_px=0.0, field_stars=1e9, merge_px=0.0, zero_point_mag=0.0)
    skies = {work.limit_mag: sky(work.limit_mag) for work in WORKLOADS}
    trackers = []
    for work in WORKLOADS:
        stars, uncertainty = skies[work.limit_mag], 1.05 * work.focal_uncertainty
        camera = work.camera.zoomed(1 + work.focal_error)
        trackers.append((work, stars, StarTracker(camera, stars, stars.vectors, settings, uncertainty)))
    out = {work.name: [0, 0, 0] for work in WORKLOADS}
    for n, (work, stars, tracker) in zip(range(count), cycle(trackers), strict=False):
        centroids, truth = make(work, stars, np.random.default_rng([seed, n]))
        answer = tracker.solve_centroids(centroids).cam_from_ref
        right = answer is not None and truth is not None and (answer * truth.inv()).magnitude() < WRONG_RAD
        out[work.name] = [
            a + b
            for a, b in zip(out[work.name], (1, answer is not None, answer is not None and not right), strict=True)
        ]
    return out


if __name__ == "__main__":
    count, seed = (int(one) for one in (sys.argv[1:3] + ["100000", "1"][len(sys.argv[1:3]) :]))
    for kind, (_, share) in KINDS.items():
        rows = count_answers(kind, round(share * count), seed)
        for name, (frames, answers, wrong) in rows.items():
            print(f"{kind:10s} {name:36s} {frames:7d} frames, {answers} answered, {wrong} wrong", flush=True)
        frames, answers, wrong = np.sum(list(rows.values()), axis=0)
        print(f"{kind:10s} {'all':36s} {frames:7d} frames, {answers} answered, {wrong} wrong", flush=True)
