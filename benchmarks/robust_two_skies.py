"""Two skies in one frame: a reflection of the stars, displaced, turned or mirrored, and a second field elsewhere.

Answers, wrong answers and ambiguous ones, for four cameras of 6 to 60 degrees with the default settings. Each frame has
the stars of a random field to the camera's limiting magnitude, and a second sky of the same stars:

    shift      : displaced by 12 to 60 px in any direction
    large shift: displaced by up to half of the field
    half turn  : turned by 180 degrees about the middle of the frame
    turn       : turned by any angle about any place of the frame
    mirror     : its columns are reversed, which no rotation of the sky gives
    other      : the stars of another random field
    near       : every star twice, displaced by 6 to 12 px
    weak       : half turn of a sixth of the stars, at most five, the brightest ones

The second sky is 0.5 mag fainter. An answer is wrong if it is more than 10' off the true attitude, or more than 30" and
five of its own standard deviations. An ambiguous answer is not wrong. A weak second sky must be solved.
"""

from __future__ import annotations

import functools
import multiprocessing
import sys
import time
from collections import Counter
from concurrent.futures import ProcessPoolExecutor
from dataclasses import dataclass
from typing import Any

import numpy as np
from scipy.spatial.transform import Rotation

from benchmarks.lost_in_space import sky
from benchmarks.timing import figure, verdict
from estimator.catalog.catalog import StarCatalog
from estimator.core.camera import Camera
from estimator.core.checks import Floats
from estimator.core.types import Attitude, Centroids
from estimator.trackers.pipeline import Settings
from estimator.trackers.star_tracker import StarTracker
from skysim.core.constants import ARCSEC_RAD
from skysim.results.metrics import WRONG_RAD

FRAMES = 10_000
PROCESSES = 2
BATCH = 500
FAINTER_MAG = 0.5
NOISE_PX = 0.1
MAGNITUDE_SIGMA = 0.05  # of a detected star; both of its images have it in common
SURE_RAD = 30 * ARCSEC_RAD
SURE_SIGMAS = 5.0


@dataclass(frozen=True)
class Set:
    """A camera by its field, its width in pixels, and its limiting magnitude."""

    name: str
    fov_deg: tuple[float, float]
    width_px: int
    limit_mag: float

    @property
    def camera(self) -> Camera:
        """The pinhole camera with this field of view."""
        width, height = np.tan(np.radians(self.fov_deg) / 2)
        height_px = round(self.width_px * float(height / width))
        return Camera.from_fov(self.width_px, height_px, float(np.radians(self.fov_deg[0])))


SETS = (
    Set("6 x 6 deg", (6.0, 6.0), 1024, 7.5),
    Set("SHEFEX", (14.87, 11.15), 659, 5.75),
    Set("22 x 17 deg", (22.0, 17.0), 1280, 5.5),
    Set("60 x 45 deg", (60.0, 45.0), 1280, 4.3),
)


def ghost_px(kind: str, camera: Camera, xy_px: Floats, rng: np.random.Generator) -> Floats:
    """Places of the second sky's stars, from those of the first."""
    size_px = np.array([camera.width_px, camera.height_px], float)
    middle_px = (size_px - 1) / 2
    angle = rng.uniform(0, 2 * np.pi)
    direction = np.array([np.cos(angle), np.sin(angle)])
    if kind == "shift":
        return xy_px + rng.uniform(12, 60) * direction
    if kind == "near":
        return xy_px + rng.uniform(6, 12) * direction
    if kind == "large shift":
        return xy_px + rng.uniform(0.1, 0.5) * size_px * direction
    if kind == "mirror":
        return np.asarray(xy_px * [-1, 1] + [camera.width_px - 1, 0])
    if kind == "turn":
        cos, sin = direction
        about_px = rng.uniform(0.25, 0.75, 2) * size_px
        return np.asarray((xy_px - about_px) @ [[cos, sin], [-sin, cos]] + about_px)
    return np.asarray(2 * middle_px - xy_px)


KINDS = ("shift", "large shift", "half turn", "turn", "mirror", "other", "near", "weak")


def field_px(
    one: Set, stars: StarCatalog, truth: Rotation, rng: np.random.Generator
) -> tuple[Floats, Floats]:
    """Places and magnitudes of the stars in and around a field."""
    camera = one.camera
    seen = truth.apply(stars.vectors)
    ahead = np.flatnonzero(seen[:, 2] > np.cos(camera.diagonal_rad))
    xy_px = camera.pixels(seen[ahead])
    mag = stars.v_mag[ahead] + MAGNITUDE_SIGMA * rng.standard_normal(len(ahead))
    return xy_px, mag


def frame(
    one: Set, stars: StarCatalog, kind: str, rng: np.random.Generator
) -> tuple[Centroids, Rotation]:
    """A frame of two skies, brightest light first, and its true attitude."""
    camera = one.camera
    truth = Rotation.random(rng=rng)
    xy_px, mag = field_px(one, stars, truth, rng)
    if kind == "other":
        second_px, second_mag = field_px(one, stars, Rotation.random(rng=rng), rng)
    else:
        second_px, second_mag = ghost_px(kind, camera, xy_px, rng), mag
    second_mag = second_mag + FAINTER_MAG
    if kind == "weak":
        inside = np.flatnonzero(camera.contains(second_px) & (mag <= one.limit_mag))
        few = inside[np.argsort(second_mag[inside])[: min(len(inside) // 6, 5)]]
        second_px, second_mag = second_px[few], second_mag[few]
    xy_px = np.concatenate([xy_px, second_px])
    mag = np.concatenate([mag, second_mag])
    xy_px = xy_px + NOISE_PX * rng.standard_normal(xy_px.shape)
    shown = np.flatnonzero(camera.contains(xy_px) & (mag <= one.limit_mag))
    shown = shown[np.argsort(mag[shown])][:100]
    sigma_px = np.full(len(shown), NOISE_PX / 4)
    return Centroids(xy_px[shown], sigma_px, 10 ** (-0.4 * mag[shown])), truth


def is_wrong(answer: Attitude, truth: Rotation) -> bool:
    """Whether an attitude is 10' off, or 30" and five of its own standard deviations along the error."""
    if answer.cam_from_ref is None or answer.covariance_rad2 is None:
        return False
    error = (answer.cam_from_ref * truth.inv()).as_rotvec()
    off_rad = float(np.linalg.norm(error))
    sigmas = np.sqrt(error @ np.linalg.solve(answer.covariance_rad2, error))
    return off_rad > WRONG_RAD or (off_rad > SURE_RAD and sigmas > SURE_SIGMAS)


@functools.cache
def trackers() -> list[tuple[Set, StarCatalog, StarTracker]]:
    """A tracker of each camera with its sky, built once in each process."""
    out = []
    for one in SETS:
        stars = sky(one.limit_mag)
        out.append((one, stars, StarTracker(one.camera, stars, stars.vectors, Settings())))
    return out


def judge(kind: str, first: int, count: int, seed: int) -> list[tuple[str, str, float]]:
    """Camera, outcome and milliseconds of the frames from `first` on."""
    out = []
    for n in range(first, first + count):
        one, stars, tracker = trackers()[n % len(SETS)]
        rng = np.random.default_rng([seed, KINDS.index(kind), n])
        centroids, truth = frame(one, stars, kind, rng)
        begin = time.perf_counter()
        answer = tracker.solve_centroids(centroids)
        ms = 1e3 * (time.perf_counter() - begin)
        outcome = "solved" if answer.solved else answer.status.partition(":")[0]
        if is_wrong(answer, truth):
            outcome = "wrong"
            told = f"{kind}: wrong answer in frame {n} of seed {seed}, {one.name}"
            print(told, file=sys.stderr, flush=True)
        out.append((one.name, outcome, ms))
    return out


def measure(count: int = FRAMES, seed: int = 1) -> list[dict[str, Any]]:
    """Outcomes of `count` frames, equally many of each kind, in PROCESSES processes."""
    each = -(-count // len(KINDS))
    with ProcessPoolExecutor(PROCESSES, multiprocessing.get_context("spawn")) as pool:
        return [row for kind in KINDS for row in measure_kind(kind, each, seed, pool)]


def measure_kind(
    kind: str, count: int, seed: int, pool: ProcessPoolExecutor
) -> list[dict[str, Any]]:
    """The rows of one kind: nothing may be wrong, and a weak second sky must be solved."""
    firsts = range(0, count, BATCH)
    sizes = [min(BATCH, count - first) for first in firsts]
    batches = pool.map(judge, [kind] * len(sizes), firsts, sizes, [seed] * len(sizes))
    judged = [one for batch in batches for one in batch]
    rows = []
    for one in SETS:
        mine = [(outcome, ms) for name, outcome, ms in judged if name == one.name]
        if not mine:
            continue
        share = Counter(outcome for outcome, _ in mine)
        name = f"{kind}, {one.name}"
        what = f"{len(mine)} frames"
        rows.append(verdict(f"{name}: wrong", share["wrong"], "frames", what, 0))
        solved = 100 * share["solved"] / len(mine)
        if kind == "weak":
            rows.append(verdict(f"{name}: solved", solved, "%", what, 98.0, True))
        else:
            rows.append(figure(f"{name}: solved", solved, "%", what))
        rows += [
            figure(f"{name}: ambiguous", 100 * share["ambiguous"] / len(mine), "%", what),
            figure(f"{name}: median", float(np.median([ms for _, ms in mine])), "ms", what),
        ]
    return rows
