"""Lost-in-space solution from centroids of SHEFEX-2's camera, compared with tetra3rs."""

from __future__ import annotations

import importlib.util
from collections.abc import Callable
from typing import Any

import numpy as np
from scipy.spatial.transform import Rotation

from benchmarks.timing import versus
from estimator.catalog import catalog
from estimator.core.camera import Camera
from estimator.core.types import Centroids
from estimator.trackers.pipeline import Settings
from estimator.trackers.star_tracker import StarTracker
from skysim.core.paths import CATALOGS

FIELDS = 100


def measure() -> list[dict[str, Any]]:
    """100 random fields of 14.87 x 11.15 deg: the 15 brightest stars to V 5.75, 0.1 px noise, no false stars."""
    camera = Camera(659, 493, 25e-3 / 9.9e-6, (329.0, 246.0))
    stars = catalog.brighter_than(catalog.read(CATALOGS / "hipparcos_hp6.5.ecsv"), 5.75)
    tracker = StarTracker(
        camera, stars, catalog.at_epoch(stars, 2020.0), Settings(centroid_sigma_px=0.1)
    )
    fields = [field(tracker, np.random.default_rng([3, n])) for n in range(FIELDS)]
    result = versus(
        f"identify + solve {FIELDS} SHEFEX fields",
        lambda: [tracker.solve_centroids(centroids) for centroids in fields],
        "tetra3rs",
        tetra3rs(camera, fields),
        repeats=5,
    )
    return [result]


def field(tracker: StarTracker, rng: np.random.Generator) -> Centroids:
    """The 15 brightest stars in the field at a random attitude, with noise."""
    camera = tracker.camera
    attitude = Rotation.random(rng=rng)
    pixels = camera.pixels(attitude.apply(tracker.stars.vectors))
    rows = np.flatnonzero(camera.contains(np.nan_to_num(pixels, nan=-1e9)))[:15]
    xy = pixels[rows] + 0.1 * rng.standard_normal((len(rows), 2))
    return Centroids(xy, np.full(len(rows), 0.1), 10 ** (-0.4 * tracker.stars.v_mag[rows]))


def tetra3rs(camera: Camera, fields: list[Centroids]) -> Callable[[], Any] | None:
    """A function that solves the same fields with tetra3rs; None if it is not installed (extra `oracle`)."""
    if importlib.util.find_spec("tetra3rs") is None:
        return None
    from tetra3rs import SolverDatabase

    database = SolverDatabase.generate_from_gaia(max_fov_deg=16.0, star_max_magnitude=6.0)
    middle = np.array([*camera.center_px])
    tables = [np.column_stack([c.xy_px - middle, c.flux]) for c in fields]
    degrees = float(np.degrees(camera.fov_rad))
    return lambda: [
        database.solve_from_centroids(
            t,
            fov_estimate_deg=degrees,
            image_width=659,
            image_height=493,
            fov_max_error_deg=0.2,
        )
        for t in tables
    ]
