"""Photographs as people take them: what `skysim solve` makes of them, told the field of view and not told.

`tests.helpers.photographs` draws them. Each case has the nuisance it is named for. The starless cases have it too, or
lights at random: no answer to them is right. tetra3rs is asked for the same pictures, told the field of view, with its
own detector.
"""

from __future__ import annotations

import functools
import importlib.util
from dataclasses import replace
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from estimator.catalog import catalog
from estimator.core.camera import Camera
from skysim.apps.plate_solver import picture as plate_picture
from skysim.apps.plate_solver import solver as plate_solver
from skysim.core.images import ViewedImage
from skysim.core.paths import CATALOGS
from tests.helpers.photographs import CASES, EPOCH, draw, is_same

# pictures of a case; of one with so many pixels
COUNT = 20
LARGE_COUNT = 5
LARGE_PX = 4_000_000
SOLVED_BAR = 97.0  # % of the pictures of a case


def measure(count: int = COUNT, seed: int = 25) -> list[dict[str, Any]]:
    """Share of the pictures of each case that are solved, told the field to 3 % and not told, and wrong answers.

    Each case has `count` pictures with stars and as many without; LARGE_COUNT at most where they are large.
    """
    stars = catalog.read(CATALOGS / "gaia_v8.0.ecsv")
    vectors = catalog.at_epoch(stars, EPOCH)
    blind = plate_solver.make_solver(None, None)
    rows = []
    for name, case in CASES.items():
        solved = {"told": 0, "not told": 0}
        theirs = 0
        wrong = 0
        first = case(np.random.default_rng([seed, 0]))
        is_large = first.width_px * first.height_px > LARGE_PX
        pictures = min(count, LARGE_COUNT) if is_large else count
        for n in range(pictures):
            rng = np.random.default_rng([seed, n])
            shot = case(rng)
            for starless in (False, True):
                image, truth = draw(replace(shot, starless=starless), stars, vectors, rng)
                told = plate_solver.make_solver(shot.fov_deg * rng.uniform(0.97, 1.03), None)
                for how, solver in (("told", told), ("not told", blind)):
                    found = plate_picture.solve_picture(
                        ViewedImage(image), solver
                    ).report.attitude.cam_from_ref
                    right = found is not None and not starless and is_same(found, truth)
                    solved[how] += right
                    wrong += found is not None and not right
                theirs += not starless and peer_solves(image, shot.camera, truth)
        peer = "tetra3rs, given the camera" if importlib.util.find_spec("tetra3rs") else None
        for how, right in solved.items():
            percent = 100 * right / pictures
            rows.append(
                row(
                    f"{name}: field {how}", percent, "% solved", peer, 100 * theirs / pictures
                )
            )
            rows[-1] |= {"bar": SOLVED_BAR, "met": percent >= SOLVED_BAR}
        rows.append(
            row(
                f"{name}: wrong, of {4 * pictures} answers possible",
                wrong,
                "wrong",
                None,
                None,
            )
            | {"bar": 0}
        )
        rows[-1]["met"] = wrong == 0
    return rows


def row(
    name: str, value: float, unit: str, peer: str | None, peer_value: float | None
) -> dict[str, Any]:
    """One result without a bar."""
    shown = peer_value if peer else None
    out = {"name": name, "value": value, "unit": unit, "peer": peer, "peer_value": shown}
    return out | {"ratio": None, "bar": None, "met": None}


def peer_solves(image: NDArray, camera: Camera, truth: Rotation) -> bool:
    """Whether tetra3rs, given the camera's focal length, solves a picture rightly; False if it is not installed."""
    if importlib.util.find_spec("tetra3rs") is None:
        return False
    import tetra3rs

    found = tetra3rs.extract_centroids(image.astype(np.float32), max_centroids=60, threads=1)
    model = tetra3rs.CameraModel(camera.focal_px, camera.width_px, camera.height_px)
    answer = peer_database().solve_from_centroids(found.centroids, camera_model=model)
    matrix = getattr(answer, "rotation_matrix_icrs_to_camera", None)
    return matrix is not None and is_same(Rotation.from_matrix(np.asarray(matrix)), truth)


@functools.cache
def peer_database() -> Any:
    """The pattern database of tetra3rs for the fields of all cases."""
    import tetra3rs

    return tetra3rs.SolverDatabase.generate_from_gaia(
        min_fov_deg=9.0, max_fov_deg=82.0, epoch_proper_motion_year=float(EPOCH)
    )
