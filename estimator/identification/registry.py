"""Star identification algorithms by name.

Each algorithm is a function of rays, a pair index, a tolerance and the keywords of `solver_options.Options`. It returns
the match or None. The tracker verifies a match with the whole field (`trackers.refinement`).
"""

from collections.abc import Callable, Iterator
from typing import Any

import numpy as np

from estimator.catalog.pair_index import PairIndex
from estimator.core.camera import Camera
from estimator.core.types import Centroids, StarMatch
from estimator.identification.published.fialho import VERSIONS
from estimator.identification.published.master_star import master_star
from estimator.identification.published.pyramid import pyramid
from estimator.identification.published.saa import saa
from estimator.identification.published.shefex import shefex
from estimator.identification.published.triangles import planar_triangle, spherical_triangle

Identifier = Callable[..., StarMatch | None]

# StarTracker does not look up `default`: it uses `star_search`. The entry is for direct callers.
IDENTIFIERS: dict[str, Identifier] = {
    "default": pyramid,
    "pyramid": pyramid,
    "saa": saa,
    "shefex": shefex,
    "master_star": master_star,
    "planar_triangle": planar_triangle,
    "spherical_triangle": spherical_triangle,
    **VERSIONS,
}

STEP = 0.02  # relative step of the focal length
CALIBRATED = 5e-4  # relative error of a calibrated focal length
STRETCH = 0.011  # relative error of an uncertain one: half a step and a margin
# Greatest numbers of triangles and of checks, round after round.
EFFORTS = (60, 1_500_000), (600, 3_000_000), (3000, 4_000_000)


def candidates(
    identifier: str,
    centroids: Centroids,
    camera: Camera,
    index: PairIndex | None,
    focal_uncertainty: float,
    sigma_px: float,
    acceptance: str = "evidence",
    **options: Any,
) -> Iterator[tuple[Camera, StarMatch]]:
    """Candidate cameras and matches from the brightest centroids, by a published method.

    If the focal length is uncertain, its interval is searched in steps of STEP from the middle outward: first with
    little effort at every step, then with more.

    Parameters
    ----------
    identifier
        Name of the method, a key of IDENTIFIERS
    index
        Catalog of the method
    focal_uncertainty
        Greatest relative error of the camera's focal length; 0 if it is calibrated
    sigma_px
        Least centroid error, pixels
    acceptance, options
        See `solver_options.Options`

    Yields
    ------
    tuple[Camera, StarMatch]
        The camera with the focal length of the step, and the match
    """
    identify = IDENTIFIERS[identifier]
    # Steps on either side of the assumed focal length, the nearest first.
    steps = int(np.ceil(focal_uncertainty / STEP - 0.5))
    stretch = STRETCH if focal_uncertainty else CALIBRATED
    zooms = sorted((n * STEP for n in range(-steps, steps + 1)), key=abs)
    # A paper's rule is that of one search.
    efforts = EFFORTS if acceptance == "evidence" else EFFORTS[-1:]
    for triangles, most_checks in efforts:
        for zoom in zooms:
            zoomed = camera.zoomed(1 + zoom)
            # The tolerance is four standard deviations, but at least a pixel, for errors of the calibration.
            match = identify(
                zoomed.rays(centroids.xy_px),
                index,
                max(1.5 if steps else 1.0, 4 * sigma_px) / zoomed.focal_px,
                stretch=stretch,
                focal_unknown=steps > 0,
                max_triangles=triangles,
                max_checks=most_checks,
                acceptance=acceptance,
                **options,
            )
            if match:
                yield zoomed, match
