"""Detection and centroiding speed against scipy.ndimage, OpenCV and sep, and error against the Cramer-Rao bound."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy import ndimage
from scipy.special import erf

from benchmarks.timing import verdict, versus
from estimator.centroiding.centroid import CENTROIDERS, gaussian_fit
from estimator.core.types import Centroids
from estimator.detection.detect import default, maximum, sequential

SIGMA_PX = 0.7
FLUX_E = 1e4
SKY_E = 100.0
NOISE_E = 15.0
PIXEL_NOISE_E = float(np.hypot(NOISE_E, np.sqrt(SKY_E)))
SIZES = {"1600x1200, 30 stars": (1200, 1600, 30), "659x493, 15 stars": (493, 659, 15)}
BAR_MS = {"1600x1200, 30 stars": 1.5, "659x493, 15 stars": 0.4}
Floats = NDArray[np.float64]


def measure() -> list[dict[str, Any]]:
    """Time to detect and centroid one frame on one core, and the RMS error of the centroids."""
    results = []
    for name, (height, width, stars) in SIZES.items():
        image, _ = frame(np.random.default_rng(2), height, width, stars)

        def ours(image: NDArray = image) -> Centroids:
            return gaussian_fit(image, default(image))

        for peer_name, peer in peers(image).items():
            results.append(
                versus(f"detect + centroid, {name}", ours, peer_name, peer, bar=1.0)
            )
        own = min(row["value"] for row in results if name in row["name"])
        results.append(
            verdict(
                f"detect + centroid, {name}: time",
                own,
                "ms",
                "the bar of a frame",
                BAR_MS[name],
            )
        )
    image, _ = frame(np.random.default_rng(2), 493, 659, 15)
    results.append(
        versus(
            "SHEFEX's scan, sequential",
            lambda: sequential(image),
            "maximum again and again",
            lambda: maximum(image),
            bar=1.0,
        )
    )
    return results + precision()


def precision() -> list[dict[str, Any]]:
    """RMS error of 1,200 centroids divided by the Cramer-Rao bound for a star of unknown position and flux."""
    errors: dict[str, list[Floats]] = {name: [] for name in CENTROIDERS if name != "disk"}
    errors["scipy.ndimage"] = []
    for seed in range(40):
        image, places = frame(np.random.default_rng(100 + seed), 1200, 1600, 30)
        blobs = default(image)
        for name in errors:
            found = (
                scipy_way(image)
                if name == "scipy.ndimage"
                else CENTROIDERS[name](image, blobs).xy_px
            )
            separation = np.linalg.norm(found[None] - places[:, None], axis=2)
            errors[name].append(
                (found[separation.argmin(axis=1)] - places)[separation.min(axis=1) < 1]
            )
    bound = cramer_rao_px()
    results = []
    for name, error in errors.items():
        ratio = float(np.sqrt(np.mean(np.concatenate(error) ** 2))) / bound
        row = verdict(
            f"centroid error, {name}", ratio, "x", f"the bound of {bound:.4f} px", 1.15
        )
        results.append(row if name == "gaussian_fit" else row | {"bar": None, "met": None})
    return results


def frame(
    rng: np.random.Generator, height: int, width: int, stars: int
) -> tuple[NDArray[np.uint16], Floats]:
    """A frame of pixel-integrated Gaussian stars, at least 30 px apart, with photon and read noise; true positions."""
    places = np.empty((0, 2))
    while len(places) < stars:
        place = rng.uniform(20, (width - 20, height - 20))
        if not len(places) or np.linalg.norm(places - place, axis=1).min() > 30:
            places = np.vstack([places, place])
    light = np.full((height, width), SKY_E)
    for x, y in places:
        left = round(x) - 8
        top = round(y) - 8
        across, down = (
            np.diff(erf((np.arange(18) - 0.5 + first - at) / (SIGMA_PX * 2**0.5))) / 2
            for first, at in ((left, x), (top, y))
        )
        light[top : top + 17, left : left + 17] += FLUX_E * np.outer(down, across)
    image = rng.poisson(light) + rng.normal(1000, NOISE_E, light.shape)
    return np.rint(image).clip(0, 65535).astype(np.uint16), places


def cramer_rao_px() -> float:
    """Cramer-Rao bound of either coordinate with unknown position and flux; RMS over positions within a pixel.

    It is the square root of the diagonal of the inverse Fisher matrix sum_k g_k g_k^T / var_k, where g_k is the
    gradient of pixel k with respect to x, y and flux, and var_k its photon and background noise.
    """
    edges = np.arange(18) - 8.5
    step = 1e-4

    def model(x: float, y: float) -> Floats:
        across, down = (np.diff(erf((edges - at) / (SIGMA_PX * 2**0.5))) / 2 for at in (x, y))
        return FLUX_E * np.outer(down, across).ravel()

    bounds = []
    for x in np.linspace(-0.4, 0.4, 5):
        for y in np.linspace(-0.4, 0.4, 5):
            slopes = np.array(
                [
                    (model(x + step, y) - model(x - step, y)) / (2 * step),
                    (model(x, y + step) - model(x, y - step)) / (2 * step),
                    model(x, y) / FLUX_E,
                ]
            )
            fisher = slopes / (model(x, y) + PIXEL_NOISE_E**2) @ slopes.T
            bounds.append(np.linalg.inv(fisher)[0, 0])
    return float(np.sqrt(np.mean(bounds)))


def scipy_way(image: NDArray) -> Floats:
    """Threshold, labels and center of gravity with scipy.ndimage, in the usual way."""
    level = float(np.median(image[::8, ::8]))
    labels, count = ndimage.label(image > level + 5 * PIXEL_NOISE_E)
    middles = ndimage.center_of_mass(image - level, labels, np.arange(1, count + 1))
    return np.array(middles).reshape(-1, 2)[:, ::-1]


def peers(image: NDArray) -> dict[str, Callable[[], Any] | None]:
    """Functions of the peers for the same frame; None for those not installed."""
    return {
        "scipy.ndimage": lambda: scipy_way(image),
        "cv2": cv2_way(image),
        "sep winpos": sep_way(image),
    }


def cv2_way(image: NDArray) -> Callable[[], Any] | None:
    try:
        import cv2
    except ImportError:
        return None

    def run() -> Any:
        above = (image > np.median(image[::8, ::8]) + 5 * PIXEL_NOISE_E).astype(np.uint8)
        return cv2.connectedComponentsWithStats(above, connectivity=8)

    return run


def sep_way(image: NDArray) -> Callable[[], Any] | None:
    try:
        import sep
    except ImportError:
        return None

    def run() -> Any:
        floats = image.astype(np.float32)
        sky = sep.Background(floats)
        found = sep.extract(floats - sky, 5, err=sky.globalrms)
        return sep.winpos(floats - sky, found["x"], found["y"], np.full(len(found), SIGMA_PX))

    return run
