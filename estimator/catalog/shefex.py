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

NORTH_MAG, SOUTH_MAG = 5.2, 5.4
KEPT_MAG = 4.5
COUNT = 2023


def asymmetric(stars: StarCatalog, north_mag: float = NORTH_MAG, south_mag: float = SOUTH_MAG) -> StarCatalog:
    """Select stars to one limit north of the equator and to another (fainter by default) south of it."""
    return stars.take(stars.v_mag <= np.where(stars.vectors[:, 2] >= 0, north_mag, south_mag))


def spread(stars: StarCatalog, apart_rad: float, kept_mag: float = -np.inf) -> StarCatalog:
    """Select all stars to `kept_mag`, then, brightest first, each star with no selected one closer than an angle."""
    order = np.argsort(stars.v_mag, kind="stable")
    vectors = np.ascontiguousarray(stars.vectors[order])
    kept = int(np.searchsorted(stars.v_mag[order], kept_mag, side="right"))
    return stars.take(order[_spread(vectors, spatial_grid.build(vectors), kept, 2 * np.sin(apart_rad / 2))])


@jit
def _spread(vectors: Floats, known: Cells, kept: int, chord: float) -> NDArray:
    """Return (N,) whether each star is selected; stars are visited in order, brightest first."""
    taken = np.zeros(len(vectors), np.bool_)
    near = np.empty(len(vectors), np.int64)
    for n in range(len(vectors)):
        x, y, z = vectors[n]
        taken[n] = n < kept or not taken[near[: within(known, vectors, x, y, z, chord, near)]].any()
    return taken


def uniform(stars: StarCatalog, count: int, kept_mag: float = -np.inf) -> StarCatalog:
    """Select about `count` evenly distributed stars, including all to `kept_mag`.

    One minimum distance decides for all stars, so the number can differ from the count by about one. Raises ImageError
    if the list has fewer stars, or more stars to `kept_mag`, than the count.
    """
    bright = int((stars.v_mag <= kept_mag).sum())
    if not max(bright, 1) <= count <= len(stars):
        raise ImageError(f"{count} stars of {len(stars)}; allowed: from the {max(bright, 1)} to be kept on")
    # A larger distance selects fewer stars; `low` always gives at least `count`.
    low, high = 0.0, np.pi
    for _ in range(40):
        middle = (low + high) / 2
        low, high = (middle, high) if len(spread(stars, middle, kept_mag)) >= count else (low, middle)
    return spread(stars, low, kept_mag)


def chosen(stars: StarCatalog) -> StarCatalog:
    """Select the flown catalog: 2,023 stars, all of the asymmetric one to 4.5 and the rest evenly distributed."""
    return uniform(asymmetric(stars), COUNT, KEPT_MAG)


Selection = Callable[[StarCatalog], StarCatalog]
CATALOGUES: dict[str, Selection] = {
    "asymmetric": asymmetric,
    "uniform": lambda stars: uniform(stars.take(stars.v_mag <= 5.75), COUNT),
    "chosen": chosen,
}
