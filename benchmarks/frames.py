"""Time and error from image to attitude, lost in space, compared with tetra3rs and cedar-solve.

`python -m benchmarks.frames [FRAMES] [SEED]`. The frames are drawn by this module, independently of skysim's camera:
Gaussian stars of the Hipparcos catalog along a streak, with photon and read noise. All solvers process one frame at a
time on one core. Errors are those of the boresight direction in arcseconds, over correctly solved frames.
"""

from __future__ import annotations

import importlib.util
import sys
import time
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from typing import Any

import numba
import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from benchmarks import peers
from benchmarks.timing import verdict
from estimator.catalog import catalog
from estimator.core.camera import Camera
from estimator.core.types import Centroids
from estimator.trackers.pipeline import Settings
from estimator.trackers.star_tracker import StarTracker
from skysim.core.constants import ARCSEC_RAD
from skysim.core.files import CATALOGS
from skysim.results.metrics import WRONG_RAD

STEP_PX = 0.1  # step of the Gaussians along a streak


@dataclass(frozen=True)
class CameraSetup:
    """A camera and its signal levels.

    zero_e : electrons of a star of magnitude 0; deepest : magnitude of the faintest star drawn
    gain_e : electrons per count; depth : maximum count
    leak   : share of a column's light in each of its pixels: readout smear
    nuisances : whether there are hot pixels, cosmic rays, a satellite's trail, false stars and a gradient of the sky
    """

    name: str
    camera: Camera
    zero_e: float
    deepest: float
    sky_e: float
    read_e: float
    gain_e: float
    depth: int
    psf_px: float = 0.7
    streak_px: float = 0.0
    leak: float = 0.0
    nuisances: bool = False


EC655 = Camera.from_fov(659, 493, float(np.radians(14.87)))
SQUARE = Camera.from_fov(1024, 1024, float(np.radians(13.5)))  # holds 22 stars brighter than 6
LIEBE_E = 6008 * 10 ** (0.4 * 4)  # EC655, f/1.4, 50 ms: a star of magnitude 4 gives 6008 e
SETUPS = (
    CameraSetup("EC655, 50 ms", EC655, LIEBE_E, 7.0, 60, 15, 16, 4095),
    CameraSetup("1024 x 1024", SQUARE, LIEBE_E, 7.0, 60, 15, 16, 4095, psf_px=0.9),
    CameraSetup(
        "1024 x 1024, smear of 12 px",
        SQUARE,
        LIEBE_E,
        7.0,
        60,
        15,
        16,
        4095,
        psf_px=0.9,
        streak_px=12,
    ),
    CameraSetup(
        "saturated, readout smear",
        SQUARE,
        40 * LIEBE_E,
        7.5,
        600,
        15,
        16,
        4095,
        psf_px=0.9,
        leak=5e-4,
    ),
    CameraSetup(
        "all nuisances",
        SQUARE,
        4 * LIEBE_E,
        7.0,
        100,
        15,
        16,
        4095,
        psf_px=0.9,
        leak=2e-5,
        nuisances=True,
    ),
)


@numba.njit(cache=True)
def paint(light: NDArray, xy: NDArray, flux: NDArray, streak: NDArray, psf_px: float) -> None:
    """Add stars to `light`: each is a sum of Gaussians at equal steps along a streak (dx, dy) centered at xy."""
    reach, height, width = int(5 * psf_px) + 2, *light.shape
    for n in range(len(xy)):
        steps = int(np.hypot(streak[n, 0], streak[n, 1]) / STEP_PX) + 1
        for k in range(steps):
            along = (k + 0.5) / steps - 0.5
            x = xy[n, 0] + along * streak[n, 0]
            y = xy[n, 1] + along * streak[n, 1]
            for row in range(max(round(y) - reach, 0), min(round(y) + reach + 1, height)):
                down = np.exp(-((row - y) ** 2) / 2 / psf_px**2)
                for column in range(max(round(x) - reach, 0), min(round(x) + reach + 1, width)):
                    across = np.exp(-((column - x) ** 2) / 2 / psf_px**2)
                    light[row, column] += flux[n] / steps * down * across / (2 * np.pi * psf_px**2)


def render(
    setup: CameraSetup, stars: catalog.StarCatalog, rng: np.random.Generator
) -> tuple[NDArray, Rotation]:
    """One frame at a random attitude, and that attitude at mid-exposure."""
    camera = setup.camera
    truth = Rotation.random(rng=rng)
    xy = camera.pixels(truth.apply(stars.vectors))
    inside = camera.contains(np.nan_to_num(xy, nan=-1e9), -10.0)
    angle = rng.uniform(0, 2 * np.pi)
    streak = np.tile(setup.streak_px * np.array([np.cos(angle), np.sin(angle)]), (inside.sum(), 1))
    light = np.full((camera.height_px, camera.width_px), float(setup.sky_e))
    paint(
        light, xy[inside], setup.zero_e * 10 ** (-0.4 * stars.v_mag[inside]), streak, setup.psf_px
    )
    if setup.nuisances:
        disturb(light, setup, rng)
    light += setup.leak * light.sum(axis=0)
    noisy = rng.poisson(light) + rng.normal(0, setup.read_e, light.shape)
    return np.clip(noisy / setup.gain_e + 16, 0, setup.depth).astype(np.uint16), truth


def disturb(light: NDArray, setup: CameraSetup, rng: np.random.Generator) -> None:
    """Add a gradient of the sky, hot pixels, cosmic rays, a satellite's trail and false stars."""
    height, width = light.shape
    light += setup.sky_e * np.linspace(0, 3, width) * np.linspace(0.5, 1.5, height)[:, None]
    hot = rng.integers(0, [width, height], (200, 2))
    light[hot[:, 1], hot[:, 0]] += rng.uniform(1e3, 5e4, len(hot))
    rays, trail, false = (rng.uniform(0, [width, height], (count, 2)) for count in (8, 1, 15))
    length = rng.uniform(3, 20, (len(rays), 1)) * rng.normal(size=(len(rays), 2))
    paint(light, rays, rng.uniform(5e3, 5e4, len(rays)), length, 0.25)
    paint(light, trail, np.array([3e5]), rng.uniform(200, 600, (1, 2)), setup.psf_px)
    mag = rng.uniform(2.0, 6.0, len(false))
    paint(light, false, setup.zero_e * 10 ** (-0.4 * mag), np.zeros((len(false), 2)), setup.psf_px)


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
    setup: CameraSetup, solvers: dict[str, Solve | None], frames: list[tuple[NDArray, Rotation]]
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


def scores(count: int, seed: int) -> Iterator[tuple[CameraSetup, dict[str, dict[str, float]]]]:
    """Each set-up with the scores of its solvers."""
    stars = catalog.read(CATALOGS / "hipparcos_hp6.5.ecsv")
    for setup in SETUPS:
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


if __name__ == "__main__":
    count, seed = (int(one) for one in (sys.argv[1:3] + ["300", "1"][len(sys.argv[1:3]) :]))
    print(f'{"":28s} {"":14s} solved %  wrong %       ms   p99 ms   cross"    rms"')
    for setup, scored in scores(count, seed):
        for name, found in scored.items():
            numbers = (
                "{solved:8.2f} {wrong:7.2f} {ms:8.3f} {p99:8.2f} {cross:8.2f} {rms:8.2f}".format(
                    **found
                )
            )
            print(f"{setup.name:28s} {name:14s} {numbers}", flush=True)
