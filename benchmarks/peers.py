"""Other lost-in-space solvers on the same centroids, set up as their authors do: tetra3rs 0.14 and cedar-solve 0.5.

`make bench` installs both. A peer that is not installed, or has no database for a field, is None: its rows are left
out. Each gets the field of view with an error that covers what the row hides, and 1 s for a frame.

cedar-solve : its own database, Hipparcos for fields of 10 to 30 degrees. It pins numpy below 2, where np.math was
    removed; it is installed without its dependencies, and np.math is put back
tetra3rs    : patterns of Gaia for the field, from stars as faint as the row's; with many false lights it forms
    patterns of more centroids, as its documentation asks for
"""

from __future__ import annotations

import importlib.util
import logging
import math
from collections.abc import Callable

import numpy as np
from scipy.spatial.transform import Rotation

from estimator.core.camera import Camera
from estimator.core.checks import Floats
from estimator.core.types import Centroids

TIMEOUT_MS = 1000
LEAST_FIELD_ERROR = 0.02  # relative
CENTROIDS = 40  # tetra3rs: centroids that form patterns
# tetra3rs: least error of a ratio of edges; noise of one, of a field's width
PATTERN_ERROR = 0.001
PATTERN_NOISE = 5.0
CEDAR_DEG = 10.0, 30.0  # fields of its database

Solve = Callable[[Centroids], Rotation | None]


def tetra3rs(camera: Camera, noise_px: float, focal_uncertainty: float = 0.0) -> Solve | None:
    """tetra3rs; None if it is not installed."""
    if importlib.util.find_spec("tetra3rs") is None:
        return None
    import tetra3rs as peer

    fov_deg = math.degrees(2 * math.atan(camera.width_px / 2 / camera.focal_px))
    database = peer.SolverDatabase.generate_from_gaia(
        max_fov_deg=1.1 * fov_deg,
        pattern_max_error=max(PATTERN_ERROR, PATTERN_NOISE * noise_px / camera.width_px),
        epoch_proper_motion_year=1991.25,
    )

    def solve(seen: Centroids) -> Rotation | None:
        answer = database.solve_from_centroids(
            np.column_stack([seen.xy_px - camera.center_px, seen.flux]),
            fov_estimate_deg=fov_deg,
            fov_max_error_deg=fov_deg * max(focal_uncertainty, LEAST_FIELD_ERROR),
            image_width=camera.width_px,
            image_height=camera.height_px,
            solve_timeout_ms=TIMEOUT_MS,
            pattern_checking_stars=CENTROIDS,
        )
        return (
            Rotation.from_matrix(np.asarray(answer.rotation_matrix_icrs_to_camera))
            if answer
            else None
        )

    return solve


def cedar(camera: Camera, focal_uncertainty: float = 0.0) -> Solve | None:
    """cedar-solve; None if it is not installed, or the field is not one of its database."""
    fov_deg = math.degrees(2 * math.atan(camera.width_px / 2 / camera.focal_px))
    if (
        importlib.util.find_spec("tetra3") is None
        or not CEDAR_DEG[0] <= fov_deg <= CEDAR_DEG[1]
    ):
        return None
    vars(np).setdefault("math", math)
    from tetra3 import Tetra3

    logging.getLogger("tetra3.Tetra3").setLevel(logging.ERROR)
    solver = Tetra3("default_database")

    def solve(seen: Centroids) -> Rotation | None:
        answer = solver.solve_from_centroids(
            seen.xy_px[:, ::-1] + 0.5,
            (camera.height_px, camera.width_px),
            fov_estimate=fov_deg,
            fov_max_error=fov_deg * max(focal_uncertainty, LEAST_FIELD_ERROR),
            solve_timeout=TIMEOUT_MS,
        )
        if answer["RA"] is None:
            return None
        return cam_from_icrs(*np.radians([answer["RA"], answer["Dec"], answer["Roll"]]))

    return solve


def cam_from_icrs(ra_rad: float, dec_rad: float, roll_rad: float) -> Rotation:
    """The attitude of a boresight; the roll is the angle from the image's up to north, counter-clockwise."""
    sa = math.sin(ra_rad)
    ca = math.cos(ra_rad)
    sd = math.sin(dec_rad)
    cd = math.cos(dec_rad)
    north = [-sd * ca, -sd * sa, cd]
    east = [-sa, ca, 0.0]
    boresight = [cd * ca, cd * sa, sd]
    s = math.sin(roll_rad)
    c = math.cos(roll_rad)
    # Of north, east and the boresight.
    seen: Floats = np.array([[-s, -c, 0.0], [-c, s, 0.0], [0.0, 0.0, 1.0]])
    return Rotation.from_matrix(seen.T @ np.array([north, east, boresight]))
