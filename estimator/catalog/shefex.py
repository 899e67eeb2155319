"""SHEFEX-2's on-board catalogues: one limit for each hemisphere, and stars spread evenly over the sky.

Samaan & Theil 2011, section 3.3. The asymmetric catalogue has no star fainter than 5.4 and about 180 between 5.2 and
5.4, "the difference in stars between the hemispheres"; the uniform one about 450 from 5.25 to 5.75; the chosen one all
of the asymmetric to 4.5, and of its fainter stars so many, spread evenly, that there are 2,023.

How they thinned is unpublished (Samaan, Bruccoleri, Mortari & Junkins 2003 have several ways). Ours: the brightest
first, a star is taken if none that is taken already is nearer than a distance; the distance that leaves the wanted
number is found by bisection. From Hipparcos-2 this gives 59,410 pairs within 18.57 deg where they have 54,804, and 183
stars between 5.2 and 5.4 (254 before thinning).
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
    """Stars to one limit north of the equator and to another south of it: the flight was from the south."""
    return stars.take(stars.v_mag <= np.where(stars.vectors[:, 2] >= 0, north_mag, south_mag))


def spread(stars: StarCatalog, apart_rad: float, kept_mag: float = -np.inf) -> StarCatalog:
    """The stars to `kept_mag`, and of the others, the brightest first, those with none taken nearer than an angle."""
    order = np.argsort(stars.v_mag, kind="stable")
    vectors = np.ascontiguousarray(stars.vectors[order])
    kept = int(np.searchsorted(stars.v_mag[order], kept_mag, side="right"))
    return stars.take(order[_spread(vectors, spatial_grid.build(vectors), kept, 2 * np.sin(apart_rad / 2))])


@jit
def _spread(vectors: Floats, known: Cells, kept: int, chord: float) -> NDArray:
    """(N,) whether each star is taken, the brightest deciding first."""
    taken = np.zeros(len(vectors), np.bool_)
    near = np.empty(len(vectors), np.int64)
    for n in range(len(vectors)):
        x, y, z = vectors[n]
        taken[n] = n < kept or not taken[near[: within(known, vectors, x, y, z, chord, near)]].any()
    return taken


def uniform(stars: StarCatalog, count: int, kept_mag: float = -np.inf) -> StarCatalog:
    """So many stars, spread evenly, with all to `kept_mag`; within one of the count, as one distance decides.

    Raises ImageError where the list has not so many stars, or more of the bright ones alone.
    """
    bright = int((stars.v_mag <= kept_mag).sum())
    if not max(bright, 1) <= count <= len(stars):
        raise ImageError(f"{count} stars of {len(stars)}; allowed: from the {max(bright, 1)} to be kept on")
    low, high = 0.0, np.pi
    for _ in range(40):
        middle = (low + high) / 2
        low, high = (middle, high) if len(spread(stars, middle, kept_mag)) >= count else (low, middle)
    return spread(stars, low, kept_mag)


def chosen(stars: StarCatalog) -> StarCatalog:
    """The flown catalogue: 2,023 stars, of the asymmetric one all to 4.5 and the rest spread evenly."""
    return uniform(asymmetric(stars), COUNT, KEPT_MAG)


Selection = Callable[[StarCatalog], StarCatalog]
CATALOGUES: dict[str, Selection] = {
    "asymmetric": asymmetric,
    "uniform": lambda stars: uniform(stars.take(stars.v_mag <= 5.75), COUNT),
    "chosen": chosen,
}
