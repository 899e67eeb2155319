"""Time and error from image to attitude, lost in space, compared with tetra3rs and cedar-solve.

The frames are drawn by `tests.helpers.drawn_frames`, independently of skysim's camera. All solvers process one frame at
a time on one core. Errors are those of the boresight direction in arcseconds, over correctly solved frames.
"""

from __future__ import annotations

import importlib.util
import time
from collections.abc import Callable, Iterator
from dataclasses import replace
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from benchmarks import peers
from benchmarks.timing import verdict
from estimator.catalog import catalog
from estimator.core.types import Centroids
from estimator.trackers.pipeline import Settings
from estimator.trackers.star_tracker import StarTracker
from skysim.core.constants import ARCSEC_RAD
from skysim.core.paths import CATALOGS
from skysim.results.metrics import WRONG_RAD
from tests.helpers.drawn_frames import SETUPS, CameraSetup, render

# Bright stars with readout smear, by the light of the shift over that of the exposure, and dawn up to saturation
BRIGHT = replace(SETUPS[1], zero_e=40 * SETUPS[1].zero_e)
HOSTILE = (
    *(
        replace(BRIGHT, name=f"readout smear of {100 * share:g} %", leak=share / 1024)
        for share in (0.06, 0.5)
    ),
    replace(SETUPS[1], name="dawn up to saturation", zero_e=4 * SETUPS[1].zero_e, dawn_e=8e4),
)
Solve = Callable[[NDArray], Rotation | None]


def ours(setup: CameraSetup, stars: catalog.StarCatalog) -> Solve:
    """The skysim star tracker with default settings and a calibrated camera: known gain and zero point."""
    settings = Settings(
        gain_e_dn=setup.gain_e,
        saturation=setup.depth,
        centroid_sigma_px=0.03,
        zero_point_mag=float(2.5 * np.log10(setup.zero_e / setup.gain_e)),
    )
    tracker = StarTracker(setup.camera, stars, stars.vectors, settings)
    return lambda image: tracker.solve(image).attitude.cam_from_ref


def tetra3rs(setup: CameraSetup, stars: catalog.StarCatalog, fast: bool) -> Solve | None:
    """tetra3rs with its own catalog on one thread; None if it is not installed (extra `oracle`)."""
    if importlib.util.find_spec("tetra3rs") is None:
        return None
    import tetra3rs as peer

    fov_deg = float(np.degrees(setup.camera.fov_rad))
    database = peer.SolverDatabase.generate_from_gaia(
        max_fov_deg=fov_deg * 1.1, epoch_proper_motion_year=1991.25
    )
    shape = (setup.camera.height_px, setup.camera.width_px)
    model = peer.CameraModel(setup.camera.focal_px, shape[1], shape[0])
    extract = peer.extract_centroids_fast if fast else peer.extract_centroids

    def solve(image: NDArray) -> Rotation | None:
        found = extract(image, max_centroids=40, threads=1)
        answer = database.solve_from_centroids(found.centroids, camera_model=model)
        matrix = getattr(answer, "rotation_matrix_icrs_to_camera", None)
        return None if matrix is None else Rotation.from_matrix(np.asarray(matrix))

    return solve


def cedar(setup: CameraSetup) -> Solve | None:
    """cedar-solve with its own centroids (tetra3's) and catalog; None if it is not installed (`peers`)."""
    identify = peers.cedar(setup.camera)
    if identify is None:
        return None
    from tetra3 import get_centroids_from_image

    def solve(image: NDArray) -> Rotation | None:
        yx_px = get_centroids_from_image(image, max_returned=40)
        ones = np.ones(len(yx_px))
        return identify(Centroids(yx_px[:, ::-1] - 0.5, ones, ones))

    return solve


def compare(
    setup: CameraSetup,
    solvers: dict[str, Solve | None],
    frames: list[tuple[NDArray, Rotation]],
) -> dict[str, dict[str, float]]:
    """Run all solvers frame by frame: percent solved and wrong, ms, and errors across the boresight in arcseconds."""
    available = {name: solve for name, solve in solvers.items() if solve is not None}
    ms: dict[str, list[float]] = {name: [] for name in available}
    errors: dict[str, list[NDArray]] = {name: [] for name in available}
    for solve in available.values():
        solve(frames[0][0])  # compiles
    order = list(available.items())
    for image, truth in frames:
        order.append(order.pop(0))  # rotate: the first solver finds the frame uncached
        for name, solve in order:
            begin = time.perf_counter()
            attitude = solve(image)
            ms[name].append(1e3 * (time.perf_counter() - begin))
            if attitude is not None:
                errors[name].append((attitude * truth.inv()).as_rotvec())
    out = {}
    for name in available:
        error = np.array(errors[name]).reshape(-1, 3)
        right = np.linalg.norm(error, axis=1) < WRONG_RAD
        cross = (
            np.hypot(error[right, 0], error[right, 1]) / ARCSEC_RAD
            if right.any()
            else np.full(1, np.nan)
        )
        solved, wrong = (100 * part.sum() / len(frames) for part in (right, ~right))
        middle, late = np.percentile(ms[name], [50, 99])
        rms = np.sqrt(np.mean(cross**2))
        out[name] = {
            "solved": solved,
            "wrong": wrong,
            "ms": middle,
            "p99": late,
            "cross": np.median(cross),
            "rms": rms,
        }
    return out


def scores(
    count: int, seed: int
) -> Iterator[tuple[CameraSetup, dict[str, dict[str, float]]]]:
    """Each set-up with the scores of its solvers."""
    stars = catalog.read(CATALOGS / "hipparcos_hp6.5.ecsv")
    for setup in SETUPS + HOSTILE:
        deep = catalog.brighter_than(stars, setup.deepest)
        frames = [render(setup, deep, np.random.default_rng([seed, n])) for n in range(count)]
        solvers = {
            "ours": ours(setup, deep),
            "tetra3rs fast": tetra3rs(setup, deep, True),
            "tetra3rs": tetra3rs(setup, deep, False),
            "cedar": cedar(setup),
        }
        yield setup, compare(setup, solvers, frames)


def measure(count: int = 100, seed: int = 1) -> list[dict[str, Any]]:
    """Frames solved, wrong answers, median time and error of ours beside the peer that solves most."""
    rows = []
    for setup, scored in scores(count, seed):
        mine = scored.pop("ours")
        best = max(scored, key=lambda name: scored[name]["solved"], default=None)
        for key, unit, bar, least in (
            ("solved", "%", 99.0, True),
            ("wrong", "%", 0.0, False),
            ("ms", "ms", np.inf, False),
            ("cross", "arcsec", np.inf, False),
        ):
            row = verdict(f"{setup.name}: {key}", mine[key], unit, best or "-", bar, least)
            rows.append(row | {"peer_value": scored[best][key] if best else None})
    return rows
