"""Detection and centroids of a frame with 30 stars, beside scipy.ndimage."""

from __future__ import annotations

from typing import Any

import numpy as np
from scipy import ndimage

from benchmarks.timing import versus
from estimator.centroid import cog
from estimator.detect import local
from skysim.stamp import add_gaussian


def measure() -> list[dict[str, Any]]:
    """1600x1200, 30 stars of 20,000 electrons, sigma 1 px, noise 15."""
    rng = np.random.default_rng(2)
    image = np.full((1200, 1600), 1000.0)
    for x, y in rng.uniform(20, 1180, (30, 2)):
        add_gaussian(image, 0, 1200, x, y, 2e4, 1.0)
    frame = (
        np.rint(rng.poisson(image) + 15 * rng.standard_normal(image.shape)).clip(0, 65535).astype(np.uint16)
    )

    def ours() -> None:
        cog(frame, local(frame))

    def scipy_way() -> None:
        mask = frame > np.median(frame[::8, ::8]) + 5 * 35
        labels, count = ndimage.label(mask)
        ndimage.center_of_mass(frame, labels, np.arange(1, count + 1))

    return [versus("detect + centroid, 30 stars, 1600x1200", ours, "scipy.ndimage", scipy_way)]
