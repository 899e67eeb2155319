"""Drawing stars and making noise, beside numpy."""

from __future__ import annotations

from typing import Any

import numpy as np

from benchmarks.timing import versus
from skysim.detector import expose
from skysim.render import splat
from skysim.scene import Detector

SIZE = (1200, 1600)


def measure() -> list[dict[str, Any]]:
    """500 Gaussian stars on 1600x1200, and the detector's noise on that frame."""
    rng = np.random.default_rng(1)
    xy = rng.uniform((5, 5), (SIZE[1] - 5, SIZE[0] - 5), (1, 500, 2))
    electrons = rng.uniform(1e3, 1e4, (1, 500))
    sigma = np.full(500, 0.8)
    image = np.zeros(SIZE)
    chip = Detector.model_validate(
        {
            "quantum_efficiency": 0.5,
            "full_well_e": 4e4,
            "gain_e_dn": 10,
            "bits": 12,
            "read_noise_e": 15,
            "dark_e_s": 100,
        }
    )

    def numpy_noise() -> None:
        frame = rng.poisson(image + 1.0).astype(np.float64)
        frame += 15 * rng.standard_normal(SIZE)
        np.clip(np.rint(frame / 10), 0, 4095).astype(np.uint16)

    return [
        versus(
            "draw 500 stars, 1600x1200",
            lambda: splat(image, xy, electrons, np.zeros(500), sigma),
            "numpy",
            lambda: numpy_stars(image, xy[0], electrons[0]),
        ),
        versus(
            "noise of a frame, 1600x1200",
            lambda: expose(image, 0.01, chip, rng),
            "numpy Poisson + normal",
            numpy_noise,
        ),
    ]


def numpy_stars(image: np.ndarray, xy: np.ndarray, electrons: np.ndarray) -> None:
    """The same Gaussians, all 15x15 stamps at once, added by index."""
    from scipy.special import erf

    corner = np.floor(xy).astype(int) - 7
    grid = np.arange(16) - 0.5
    edges = [erf((corner[:, axis, None] + grid - xy[:, axis, None]) / (0.8 * np.sqrt(2))) for axis in (0, 1)]
    across, down = (np.diff(edge, axis=1) / 2 for edge in edges)
    stamps = electrons[:, None, None] * down[:, :, None] * across[:, None, :]
    rows = np.clip(corner[:, 1, None] + np.arange(15), 0, image.shape[0] - 1)
    columns = np.clip(corner[:, 0, None] + np.arange(15), 0, image.shape[1] - 1)
    np.add.at(image, (rows[:, :, None], columns[:, None, :]), stamps)
