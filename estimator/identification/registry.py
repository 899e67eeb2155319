"""Star identification algorithms by name.

Each is a function of rays, a pair index and a tolerance that returns the match or None; `options.Options` has its
keywords. The tracker verifies what a method answers with the whole field (`trackers.residuals.refinement`).
"""

from __future__ import annotations

from collections.abc import Callable, Iterator

import numpy as np
from scipy.spatial.transform import Rotation

from estimator.catalog.pair_index import PairIndex
from estimator.core.camera import Camera
from estimator.core.types import Centroids, StarMatch
from estimator.identification.published.fialho import VERSIONS
from estimator.identification.published.master_star import master_star
from estimator.identification.published.pyramid import pyramid
from estimator.identification.published.saa import saa
from estimator.identification.published.shefex import shefex

Identifier = Callable[..., StarMatch | None]

# StarTracker does not look up `default`: it uses identification/stars/search.py. The entry is for direct callers.
IDENTIFIERS: dict[str, Identifier] = {
    "default": pyramid,
    "pyramid": pyramid,
    "saa": saa,
    "shefex": shefex,
    "master_star": master_star,
    **VERSIONS,
}

STEP = 0.02  # of the focal length
# relative errors of the focal length: calibrated, half a step and what is over
CALIBRATED = 5e-4
STRETCH = 0.011
EFFORTS = (60, 1_500_000), (600, 3_000_000), (3000, 4_000_000)  # triangles and checks, at most


def candidates(
    identifier: str,
    centroids: Centroids,
    camera: Camera,
    index: PairIndex | None,
    focal_uncertainty: float,
    sigma_px: float,
    base_stars: int,
) -> Iterator[tuple[Camera, Rotation]]:
    """Candidate cameras and attitudes, cam_from_ref, of the brightest centroids.

    If the focal length is uncertain, its interval is searched in steps of STEP, first with little effort at all steps,
    then with more.

    Parameters
    ----------
    sigma_px
        Least centroid error
    base_stars
        Of the search (`options.Options`)
    """
    identify = IDENTIFIERS[identifier]
    steps = int(np.ceil(focal_uncertainty / STEP - 0.5))
    stretch = STRETCH if focal_uncertainty else CALIBRATED
    zooms = sorted((n * STEP for n in range(-steps, steps + 1)), key=abs)
    for triangles, most_checks in EFFORTS:
        for zoom in zooms:
            zoomed = camera.zoomed(1 + zoom)
            match = identify(
                zoomed.rays(centroids.xy_px),
                index,
                max(1.5 if steps else 1.0, 4 * sigma_px) / zoomed.focal_px,
                stretch=stretch,
                focal_unknown=steps > 0,
                max_triangles=triangles,
                max_checks=most_checks,
                base_stars=base_stars,
            )
            if match:
                yield zoomed, match.cam_from_ref
