"""SHEFEX-2's on-board catalogs: a magnitude limit for each hemisphere, and a uniform distribution over the sky.

Samaan & Theil 2011, section 3.3. The asymmetric catalog has no star fainter than 5.4 and about 180 between 5.2 and 5.4,
"the difference in stars between the hemispheres". The uniform one has about 450 stars from 5.25 to 5.75. The chosen one
has all stars of the asymmetric one to 4.5 and an evenly distributed subset of its fainter stars, 2,023 in total.

Their thinning method is unpublished (Samaan, Bruccoleri, Mortari & Junkins 2003 describe several). Ours is greedy:
stars are visited by increasing magnitude, and a star is selected if no star selected before is closer than a minimum
distance. The distance that gives the wanted number is found by bisection. From Hipparcos-2 this gives 59,410 pairs
within 18.57 deg, compared with their 54,804, and 183 stars between 5.2 and 5.4 (254 before thinning).
"""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
from numpy.typing import NDArray

from estimator.catalog import spatial_grid
from estimator.catalog.catalog import StarCatalog
from estimator.catalog.spatial_grid import Cells, within
from estimator.core.arrays import Floats
from estimator.core.errors import ImageError
from estimator.core.jit import jit

NORTH_MAG = 5.2
SOUTH_MAG = 5.4
BRIGHT_MAG = 4.5
COUNT = 2023


def asymmetric(
    stars: StarCatalog, north_mag: float = NORTH_MAG, south_mag: float = SOUTH_MAG
) -> StarCatalog:
    """Select stars to one limit north of the equator and to another (fainter by default) south of it."""
    return stars.take(stars.v_mag <= np.where(stars.vectors[:, 2] >= 0, north_mag, south_mag))


def thin(stars: StarCatalog, min_separation_rad: float, bright_mag: float = -np.inf) -> StarCatalog:
    """Select all stars to `bright_mag`, then, brightest first, each star with no selected one closer than an angle."""
    order = np.argsort(stars.v_mag, kind="stable")
    vectors = np.ascontiguousarray(stars.vectors[order])
    n_bright = int(np.searchsorted(stars.v_mag[order], bright_mag, side="right"))
    return stars.take(
        order[
            _thin(
                vectors, spatial_grid.build(vectors), n_bright, 2 * np.sin(min_separation_rad / 2)
            )
        ]
    )


@jit
def _thin(vectors: Floats, cells: Cells, n_bright: int, chord: float) -> NDArray:
    """Return (N,) whether each star is selected; stars are visited in order, brightest first."""
    selected = np.zeros(len(vectors), np.bool_)
    neighbors = np.empty(len(vectors), np.int64)
    for n in range(len(vectors)):
        x, y, z = vectors[n]
        near = neighbors[: within(cells, vectors, x, y, z, chord, neighbors)]
        selected[n] = n < n_bright or not selected[near].any()
    return selected


def uniform(stars: StarCatalog, count: int, bright_mag: float = -np.inf) -> StarCatalog:
    """Select about `count` evenly distributed stars, including all to `bright_mag`.

    One minimum distance decides for all stars, so the number can differ from the count by about one. Raises ImageError
    if the list has fewer stars, or more stars to `bright_mag`, than the count.
    """
    n_bright = int((stars.v_mag <= bright_mag).sum())
    if not max(n_bright, 1) <= count <= len(stars):
        raise ImageError(
            f"{count} of {len(stars)} stars; allowed: {max(n_bright, 1)} to {len(stars)}"
        )
    # A larger distance selects fewer stars; `low` always gives at least `count`.
    low = 0.0
    high = np.pi
    for _ in range(40):
        middle = (low + high) / 2
        low, high = (
            (middle, high) if len(thin(stars, middle, bright_mag)) >= count else (low, middle)
        )
    return thin(stars, low, bright_mag)


def chosen(stars: StarCatalog) -> StarCatalog:
    """Select the flown catalog: 2,023 stars, all of the asymmetric one to 4.5 and the rest evenly distributed."""
    return uniform(asymmetric(stars), COUNT, BRIGHT_MAG)


Selection = Callable[[StarCatalog], StarCatalog]
CATALOGS: dict[str, Selection] = {
    "asymmetric": asymmetric,
    "uniform": lambda stars: uniform(stars.take(stars.v_mag <= 5.75), COUNT),
    "chosen": chosen,
}
