"""Fields of a camera whose model is wrong: pixels that are not square, shear, distortion, a focal length off bounds.

The tracker assumes a pinhole with square pixels, and knows its focal length exactly or to 5 %. A solution is wrong if
it is more than 10' off, or more than 30" and five of its own standard deviations. A refusal should name the camera
model. NEES is e' P^-1 e of the attitude error, 3 in the mean.
"""

from __future__ import annotations

import time
from collections.abc import Iterator
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from benchmarks import peers
from benchmarks.lost_in_space import DENSE, NARROW, SHEFEX, Field, Workload, field
from benchmarks.lost_in_space import sky as sky_of
from benchmarks.rolling import row
from estimator.catalog import catalog
from estimator.core.camera import Camera
from estimator.core.types import Attitude
from estimator.trackers.pipeline import Settings
from estimator.trackers.star_tracker import StarTracker
from skysim.core.constants import ARCSEC_RAD
from skysim.results.metrics import WRONG_RAD

NEES_RANGE = 2.5, 3.5
NAMED = "camera model"


@dataclass(frozen=True)
class Lens:
    """How the true camera differs from the one that the tracker assumes.

    uncertainty : relative uncertainty of the focal length in the settings; focal_error : the true error
    aspect      : ratio of the focal lengths along y and along x
    row_shear   : displacement of the last row against the middle one, along x
    corner_px   : displacement of a corner by radial distortion with the power `power` of the radius
    rate_deg_s, readout_s : rolling shutter, taken for a global one: rate about random axes, time from first to last row
    bar         : least share that is solved, or refused by name; nees : greatest mean NEES
    """

    name: str
    uncertainty: float = 0.0
    focal_error: float = 0.0
    aspect: float = 1.0
    row_shear_px: float = 0.0
    corner_px: float = 0.0
    power: int = 3
    rate_deg_s: float = 0.0
    readout_s: float = 0.03
    bar: float = 0.0
    nees: float = np.inf

    def apply(self, frame: Field, camera: Camera, rng: np.random.Generator) -> Field:
        """The frame as this camera sees it."""
        offset = frame.centroids.xy_px - camera.center_px
        half_px = np.array([camera.width_px, camera.height_px]) / 2
        corner = np.linalg.norm(offset, axis=1) / np.linalg.norm(half_px)
        radial = self.corner_px / np.linalg.norm(half_px) * corner ** (self.power - 1)
        offset = offset * (1 + self.focal_error + radial[:, None]) * [1, self.aspect]
        offset[:, 0] += self.row_shear_px * offset[:, 1] / half_px[1]
        if self.rate_deg_s:
            axis = rng.standard_normal(3)
            w = np.radians(self.rate_deg_s) * axis / np.linalg.norm(axis)
            tangent = offset / camera.focal_px
            rays = np.column_stack([tangent, np.ones(len(tangent))])
            moved = np.cross(-w, rays)
            speed = camera.focal_px * (moved[:, :2] - tangent * moved[:, 2:])
            offset = offset + speed * (self.readout_s / 2 * offset[:, 1:] / half_px[1])
        seen = camera.center_px + offset
        inside = camera.contains(seen)
        lights = replace(frame.centroids, xy_px=seen).take(inside)
        return replace(frame, centroids=lights, star=frame.star[inside])


TOLD = 0.05
LENSES = (
    Lens("uncertain, square", TOLD, 0.02, bar=99.5, nees=3.5),
    *(
        Lens(f"uncertain, aspect {aspect:g}", TOLD, 0.02, aspect, bar=95, nees=4)
        for aspect in (0.98, 1.02, 1.04, 1.09)
    ),
    Lens("uncertain, rows sheared 2 px", TOLD, row_shear_px=2.0, bar=95),
    Lens("uncertain, 8 px cubic", TOLD, 0.01, corner_px=8.0, bar=95, nees=4),
    Lens("focal off 1.05 times what was told", TOLD, 1.05 * TOLD, bar=99),
    Lens("known, square", bar=99.5, nees=3.5),
    Lens("known, aspect 1.003", aspect=1.003, bar=95, nees=4),
    Lens("known, rows sheared 2 px", row_shear_px=2.0, bar=95),
    Lens("known, 3 deg/s rolling as global", rate_deg_s=3.0, bar=95),
    Lens("known, 8 px cubic", corner_px=8.0, bar=95, nees=4),
    Lens("known, 8 px fifth power", corner_px=8.0, power=5, bar=95, nees=4),
    Lens("known, off 1 %", focal_error=0.01, bar=99.5),
)
WORKS = (
    Workload("6 x 6 deg", *NARROW),
    Workload("SHEFEX, a fifth false", SHEFEX, 659, 5.75, 0.1, brightest=20, false_share=0.2),
    Workload("17 x 13 deg, 30 % false", *DENSE, false_share=0.3),
    Workload("60 x 45 deg", (60, 45), 1280, 4.5, 0.2, false_share=0.1),
)


def frames(
    work: Workload, lens: Lens, stars: catalog.StarCatalog, count: int, seed: int
) -> Iterator[Field]:
    """Random frames of a camera with this lens."""
    for n in range(count):
        rng = np.random.default_rng([seed, n])
        yield lens.apply(field(work, stars, rng), work.camera, rng)


def judge(attitude: Attitude, frame: Field) -> tuple[bool, float]:
    """Whether an answer is wrong, and its NEES; NaN without an answer."""
    if attitude.cam_from_ref is None or attitude.covariance_rad2 is None:
        return False, np.nan
    error = (attitude.cam_from_ref * frame.cam_from_icrs.inv()).as_rotvec()
    nees = float(error @ np.linalg.solve(attitude.covariance_rad2, error))
    size = np.linalg.norm(error)
    return bool(size > WRONG_RAD or (size > 30 * ARCSEC_RAD and nees > 25)), nees


def measure(
    count: int = 200,
    seed: int = 51,
    lenses: tuple[Lens, ...] = LENSES,
    works: tuple[Workload, ...] = WORKS,
) -> list[dict[str, Any]]:
    """Fields of each camera that are solved or refused by name, wrong answers, NEES and time, beside tetra3rs."""
    rows = []
    for lens in lenses:
        for work in works:
            rows += _rows(work, lens, count, seed)
    return rows


def _rows(work: Workload, lens: Lens, count: int, seed: int) -> list[dict[str, Any]]:
    """Rows of one camera."""
    stars: catalog.StarCatalog = sky_of(work.limit_mag)
    settings = Settings(centroid_sigma_px=0.0, field_stars=1e9, merge_px=0.0)
    tracker = StarTracker(work.camera, stars, stars.vectors, settings, lens.uncertainty)
    peer = peers.tetra3rs(work.camera, work.noise_px, lens.uncertainty)
    wrong = []
    nees = []
    ms = []
    named = 0
    theirs = 0
    for n, frame in enumerate(frames(work, lens, stars, count, seed)):
        if n == 0:
            tracker.solve_centroids(frame.centroids)  # compiles
        begin = time.perf_counter()
        attitude = tracker.solve_centroids(frame.centroids)
        ms.append(1e3 * (time.perf_counter() - begin))
        is_wrong, size = judge(attitude, frame)
        wrong.append(is_wrong)
        nees.append(size)
        named += NAMED in attitude.status
        answer = peer(frame.centroids) if peer else None
        theirs += answer is not None and (
            (answer * frame.cam_from_icrs.inv()).magnitude() < WRONG_RAD
        )
    solved = 100 * float(np.isfinite(nees).mean())
    told = solved + 100 * named / count
    name = f"{lens.name}, {work.name}"
    who, peer_value = ("tetra3rs", 100 * theirs / count) if peer else (None, None)
    out = [
        row(f"{name}: wrong", sum(wrong), "fields", None, 0, not any(wrong)),
        row(f"{name}: solved", solved, "%", None, None, None),
        row(f"{name}: solved or named", told, "%", peer_value, lens.bar, told >= lens.bar),
        row(f"{name}: median", float(np.median(ms)), "ms", None, None, None),
    ]
    out[2]["peer"] = who
    if np.isfinite(nees).any():
        mean = float(np.nanmean(nees))
        out.append(row(f"{name}: NEES", mean, "", None, lens.nees, mean <= lens.nees))
    return out
