"""Whether the star tracker's covariance is honest, from centroids of random fields, where its error model is wrong.

NEES is e' P^-1 e of the attitude error: 3 in the mean, and 16.3 at the 99.9th percentile of chi-square with three
degrees of freedom. The tracker does not know what the fields have: noise greater than claimed, a focal length that
drifted, a radial distortion. A solution is wrong if it is more than 10' off.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
import scipy.stats
from scipy.spatial.transform import Rotation

from benchmarks.lost_in_space import DENSE, SHEFEX, Field, Workload, field
from benchmarks.rolling import row
from estimator.catalog import catalog
from estimator.core.camera import Camera
from estimator.core.checks import Floats
from estimator.core.types import Centroids
from estimator.trackers.pipeline import Settings
from estimator.trackers.star_tracker import StarTracker
from skysim.results import metrics

FIELDS = 500
SEED = 25
NEES_RANGE = 2.5, 3.5
TAIL = float(scipy.stats.chi2.ppf(0.999, 3))
TAIL_FACTOR = 2.0


@dataclass(frozen=True)
class Condition:
    """What the tracker does not know: true over claimed noise, relative focal drift, distortion at the corner."""

    name: str
    noise_factor: float = 1.0
    focal_drift: float = 0.0
    corner_px: float = 0.0

    def apply(self, frame: Field, camera: Camera) -> Field:
        """The frame with these errors."""
        offset_px = frame.centroids.xy_px - camera.center_px
        corner2_px2 = (camera.width_px**2 + camera.height_px**2) / 4
        cubic = self.corner_px / corner2_px2**1.5
        radial = 1 + self.focal_drift + cubic * np.sum(offset_px**2, axis=1)
        xy_px = camera.center_px + radial[:, None] * offset_px
        sigma_px = frame.centroids.sigma_px / self.noise_factor
        return replace(
            frame, centroids=replace(frame.centroids, xy_px=xy_px, sigma_px=sigma_px)
        )


CONDITIONS = (
    Condition("right model"),
    *(
        Condition(f"noise understated {factor:g}x", noise_factor=factor)
        for factor in (2, 3, 5)
    ),
    *(
        Condition(f"focal length off {percent:g} %", focal_drift=percent / 100)
        for percent in (0.1, 0.2, 0.3)
    ),
    *(Condition(f"distortion of {px:g} px", corner_px=px) for px in (1, 2, 3)),
)
WORKS = tuple(
    Workload(f"{name}, {100 * share:.0f} % false", *camera, false_share=share, **rest)
    for name, camera, rest in (
        ("SHEFEX", (SHEFEX, 659, 5.75, 0.1), {"brightest": 15}),
        ("17 x 13 deg", DENSE, {}),
    )
    for share in (0.0, 0.3)
)


# True floors of the centroids' errors, their own noise, and numbers of stars, for the default settings
FLOORS_PX = 0.01, 0.03, 0.1, 0.3
OWN_PX = 0.01, 0.1, 0.5
STARS = 4, 6, 10, 30


def floors(count: int) -> list[dict[str, Any]]:
    """Rows of the default settings, whose floor is estimated from each frame: all floors and noises together."""
    work = WORKS[-1]
    camera = work.camera
    stars = catalog.brighter_than(catalog.hipparcos(), work.limit_mag)
    tracker = StarTracker(camera, stars, stars.vectors, Settings(zero_point_mag=0.0))
    rows = []
    for kept in STARS:
        for floor_px in FLOORS_PX:
            frames = (
                lights(
                    stars, camera, kept, floor_px, own_px, np.random.default_rng([SEED, n])
                )
                for own_px in OWN_PX
                for n in range(count)
            )
            name = f"floor of {floor_px:g} px by the frame, {kept} stars"
            rows += _rows(name, scores(tracker, frames), count * len(OWN_PX))
    return rows


def lights(
    stars: catalog.StarCatalog,
    camera: Camera,
    kept: int,
    floor_px: float,
    own_px: float,
    rng: np.random.Generator,
) -> Field:
    """The brightest stars of a random field that has as many, with known noise and an unknown floor."""
    inside = np.empty(0, int)
    while len(inside) < kept:
        truth = Rotation.random(rng=rng)
        xy_px = np.nan_to_num(camera.pixels(truth.apply(stars.vectors)), nan=-1e9)
        inside = np.flatnonzero(camera.contains(xy_px, 5.0))[:kept]
    sigma_px = own_px * rng.uniform(0.5, 1.5, kept)
    error_px = np.hypot(sigma_px, floor_px)[:, None] * rng.standard_normal((kept, 2))
    light = 10 ** (-0.4 * stars.v_mag[inside])
    return Field(Centroids(xy_px[inside] + error_px, sigma_px, light), truth, inside)


def measure(
    works: tuple[Workload, ...] = WORKS,
    conditions: tuple[Condition, ...] = CONDITIONS,
    count: int = FIELDS,
) -> list[dict[str, Any]]:
    """Solved and wrong share, mean NEES and its 99.9th percentile, for each camera and condition."""
    rows = []
    for work in works:
        stars = catalog.brighter_than(catalog.hipparcos(), work.limit_mag)
        settings = Settings(
            centroid_sigma_px=0.0, field_stars=1e9, merge_px=0.0, zero_point_mag=0.0
        )
        tracker = StarTracker(work.camera, stars, stars.vectors, settings)
        for condition in conditions:
            frames = (
                condition.apply(
                    field(work, stars, np.random.default_rng([SEED, n])), work.camera
                )
                for n in range(count)
            )
            rows += _rows(f"{work.name}, {condition.name}", scores(tracker, frames), count)
    return rows + floors(count // 2)


def scores(tracker: StarTracker, frames: Iterator[Field]) -> Floats:
    """(N, 2) NEES and error angle in radians of the frames that are solved."""
    out = []
    for frame in frames:
        attitude = tracker.solve_centroids(frame.centroids)
        if attitude.cam_from_ref is None or attitude.covariance_rad2 is None:
            continue
        error = (attitude.cam_from_ref * frame.cam_from_icrs.inv()).as_rotvec()
        out.append(
            (error @ np.linalg.solve(attitude.covariance_rad2, error), np.linalg.norm(error))
        )
    return np.array(out).reshape(-1, 2)


def _rows(name: str, found: Floats, fields: int) -> list[dict[str, Any]]:
    """Rows of one camera and condition."""
    nees = found[:, 0]
    wrong = int(np.sum(found[:, 1] > metrics.WRONG_RAD))
    rows = [
        row(f"{name}: solved", 100 * len(found) / fields, "%", None, None, None),
        row(f"{name}: wrong", wrong, "fields", None, 0, wrong == 0),
    ]
    if not len(found):
        return rows
    mean = float(nees.mean())
    tail = float(np.percentile(nees, 99.9))
    low, high = NEES_RANGE
    return [
        *rows,
        row(f"{name}: NEES", mean, "", None, high, low <= mean <= high),
        row(
            f"{name}: NEES, 99.9 %",
            tail,
            "",
            TAIL,
            TAIL_FACTOR * TAIL,
            tail <= TAIL_FACTOR * TAIL,
        ),
    ]
