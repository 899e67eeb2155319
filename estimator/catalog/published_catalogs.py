"""Published on-board catalogs: PTASE's preparation of a star list, and SHEFEX-2's selection of stars.

PTASE (Fialho & Saotome 2005, section 3.3). READCAT selects all stars to a limiting visual magnitude, is able "to
convert visual magnitudes to instrumental magnitudes through an empirical formula that relates these magnitudes with
B-V and V-I color indexes", and corrects proper motion "from the Hipparcos mean epoch (J1991.25) to the mean mission
epoch"; it keeps the file's order. PROC_CAT "merges optically double or multiple systems into a single
photometrically equivalent star and rearranges the stars in order of increasing magnitude", and logs a histogram and
every star. `cat_file` has files with the fields of theirs, whose layout is unpublished.

SHEFEX-2 (Samaan & Theil 2011, section 3.3). The asymmetric catalog has no star fainter than 5.4 and about 180 between
5.2 and 5.4, "the difference in stars between the hemispheres". The uniform one has about 450 stars from 5.25 to 5.75.
The chosen one has all stars of the asymmetric one to 4.5 and an evenly distributed subset of its fainter stars,
2,023 in total.

Their thinning method is unpublished (Samaan, Bruccoleri, Mortari & Junkins 2003 describe several). Ours is greedy:
stars are visited by increasing magnitude, and a star is selected if no star selected before is closer than a minimum
distance (`thin`). The distance that gives the wanted number is found by bisection (`uniform`). From Hipparcos-2 this
gives 59,410 pairs within 18.57 deg, compared with their 54,804, and 183 stars between 5.2 and 5.4 (254 before
thinning).
"""

from collections.abc import Callable
from pathlib import Path
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from estimator.catalog import catalog, sky_index
from estimator.catalog.catalog import StarCatalog
from estimator.catalog.sky_index import Cells, within
from estimator.core.checks import Floats, Ints, frozen
from estimator.core.errors import ImageError
from estimator.core.jit import jit
from estimator.core.vectors import normalized

# Color indexes of a G2 star, used where the catalog has no color.
SUN_B_V = 0.65
SUN_V_I = 0.72
BYTES_PER_ENTRY = (
    20  # two angles and a magnitude of 4 bytes each; id, flags and checksum in 8
)


class Color(NamedTuple):
    """Coefficients of an instrumental magnitude: m = V + constant + b_v (B - V) + v_i (V - I)."""

    constant: float = 0.0
    b_v: float = 0.0
    v_i: float = 0.0


@frozen
class OnBoard:
    """A catalog at one epoch, as a tracker stores it.

    Attributes
    ----------
    id
        (N,) identifier of the brightest star in each entry
    vectors
        (N, 3) barycentric unit vectors, ICRS axes
    magnitude
        (N,) instrumental magnitudes
    components
        (N,) number of catalog stars in each entry
    epoch_yr
        Julian year of the vectors
    """

    id: Ints
    vectors: Floats
    magnitude: Floats
    components: Ints
    epoch_yr: float

    def __len__(self) -> int:
        return len(self.id)


def read_cat(
    path: str | Path,
    limit_v_mag: float,
    epoch_yr: float | None = None,
    color: Color | None = None,
) -> OnBoard:
    """READCAT: select stars to a limiting V, propagate them to the mission epoch, compute instrumental magnitudes.

    The order of the file is kept.

    Parameters
    ----------
    path
        Catalog file, as in `catalog.read`
    limit_v_mag
        Faintest visual magnitude
    epoch_yr
        Julian year of the mission; that of the file if omitted
    color
        Coefficients of the instrument; if omitted the magnitude is V, and the file needs no color columns. A
        missing color is replaced by that of the Sun

    Raises
    ------
    ImageError
        For a file that is not a catalog, and if no star is bright enough.
    """
    numbers, file_epoch_yr = catalog.columns(
        path, catalog.COLUMNS, ("b_v", "v_i") if color else ()
    )
    numbers = numbers[:, numbers[6] <= limit_v_mag]
    if not numbers.shape[1]:
        raise ImageError(f"{path}: no star of V <= {limit_v_mag:g}; allowed: a fainter limit")
    stars = catalog.from_columns(*numbers[:7], epoch_yr=file_epoch_yr)
    epoch_yr = file_epoch_yr if epoch_yr is None else epoch_yr
    magnitude = stars.v_mag
    if color:
        b_v, v_i = np.where(np.isnan(numbers[7:]), [[SUN_B_V], [SUN_V_I]], numbers[7:])
        magnitude = stars.v_mag + color.constant + color.b_v * b_v + color.v_i * v_i
    single = np.ones(len(stars), np.int64)
    return OnBoard(stars.id, catalog.at_epoch(stars, epoch_yr), magnitude, single, epoch_yr)


def proc_cat(stars: OnBoard, closer_than_rad: float) -> OnBoard:
    """PROC_CAT: merge stars closer than an angle into one at their center of light, and sort by magnitude.

    The merged star has the total flux, m = -2.5 log10 sum 10^(-0.4 m). Groups are joined through pairs, so that a
    chain of close stars is one group.
    """
    order = np.argsort(stars.magnitude, kind="stable")
    vectors = stars.vectors[order]
    magnitude = stars.magnitude[order]
    groups = catalog.close_groups(vectors, 2 * np.sin(closer_than_rad / 2))
    means, merged = catalog.light_centers(vectors.T, magnitude, groups)
    _, first = np.unique(groups, return_index=True)  # the brightest of each group
    components = np.bincount(groups, stars.components[order]).astype(np.int64)
    by_light = np.argsort(merged, kind="stable")
    return OnBoard(
        stars.id[order][first][by_light],
        normalized(means)[by_light],
        merged[by_light],
        components[by_light],
        stars.epoch_yr,
    )


def histogram(magnitude: Floats, step_mag: float = 0.5) -> tuple[Floats, Ints]:
    """The (M,) lower edges of the magnitude bins, multiples of the step, and the (M,) numbers of stars."""
    bins = np.floor(np.asarray(magnitude) / step_mag + 1e-9).astype(np.int64)
    count = np.bincount(bins - bins.min())
    return step_mag * (bins.min() + np.arange(len(count))), count


def log(stars: OnBoard, step_mag: float = 0.5) -> str:
    """The text of PROC_CAT's log file: a magnitude histogram, the memory needed, and every star."""
    edges, count = histogram(stars.magnitude, step_mag)
    merged = stars.components[stars.components > 1]
    lines = [
        f"{len(stars)} entries from {stars.components.sum()} stars at J{stars.epoch_yr:.2f}; "
        f"{len(merged)} of them of {merged.sum()} stars",
        f"{BYTES_PER_ENTRY * len(stars)} bytes at {BYTES_PER_ENTRY} bytes an entry",
        "",
        "magnitude        stars   to here",
        *(
            f"{low:6.2f} .. {low + step_mag:5.2f} {n:6d} {total:9d}"
            for low, n, total in zip(edges, count, np.cumsum(count), strict=True)
        ),
        "",
        "    id      ra deg     dec deg     mag  stars",
    ]
    ra = np.arctan2(stars.vectors[:, 1], stars.vectors[:, 0])
    dec = np.arcsin(stars.vectors[:, 2])
    columns = zip(
        stars.id,
        np.degrees(ra) % 360,
        np.degrees(dec),
        stars.magnitude,
        stars.components,
        strict=True,
    )
    lines += [
        f"{n:6d} {ra:11.6f} {dec:+11.6f} {mag:7.3f} {c:6d}" for n, ra, dec, mag, c in columns
    ]
    return "\n".join(lines) + "\n"


# SHEFEX-2's on-board catalogs: a magnitude limit for each hemisphere, and a uniform distribution over the sky.

NORTH_MAG = 5.2
SOUTH_MAG = 5.4
BRIGHT_MAG = 4.5
FAINTEST_MAG = 5.75  # of the uniform catalog
COUNT = 2023


def asymmetric(
    stars: StarCatalog, north_mag: float = NORTH_MAG, south_mag: float = SOUTH_MAG
) -> StarCatalog:
    """Select stars to one limit north of the equator and to another (fainter by default) south of it."""
    return stars.take(stars.v_mag <= np.where(stars.vectors[:, 2] >= 0, north_mag, south_mag))


def thin(
    stars: StarCatalog, min_separation_rad: float, bright_mag: float = -np.inf
) -> StarCatalog:
    """Select all stars to `bright_mag`, then, brightest first, each star with no selected one closer than an angle."""
    order = np.argsort(stars.v_mag, kind="stable")
    vectors = np.ascontiguousarray(stars.vectors[order])
    n_bright = int(np.searchsorted(stars.v_mag[order], bright_mag, side="right"))
    chord = 2 * np.sin(min_separation_rad / 2)
    selected = _thin(vectors, sky_index.build_grid(vectors), n_bright, chord)
    return stars.take(order[selected])


@jit
def _thin(vectors: Floats, cells: Cells, n_bright: int, chord: float) -> NDArray:
    """(N,) whether each star is selected; stars are visited in order, brightest first."""
    selected = np.zeros(len(vectors), np.bool_)
    neighbors = np.empty(len(vectors), np.int64)
    for n in range(len(vectors)):
        x, y, z = vectors[n]
        near = neighbors[: within(cells, vectors, x, y, z, chord, neighbors)]
        selected[n] = n < n_bright or not selected[near].any()
    return selected


def uniform(stars: StarCatalog, count: int, bright_mag: float = -np.inf) -> StarCatalog:
    """Select about `count` evenly distributed stars, including all to `bright_mag`.

    One minimum distance decides for all stars, so that the number can differ from the count by about one.

    Raises
    ------
    ImageError
        If the list has fewer stars, or more stars to `bright_mag`, than the count.
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
        if len(thin(stars, middle, bright_mag)) >= count:
            low = middle
        else:
            high = middle
    return thin(stars, low, bright_mag)


def uniform_to_limit(
    stars: StarCatalog,
    count: int = COUNT,
    faintest_mag: float = FAINTEST_MAG,
    bright_mag: float = -np.inf,
) -> StarCatalog:
    """Select the uniform catalog: `uniform` from the stars to a limit."""
    return uniform(stars.take(stars.v_mag <= faintest_mag), count, bright_mag)


def chosen(
    stars: StarCatalog,
    count: int = COUNT,
    bright_mag: float = BRIGHT_MAG,
    north_mag: float = NORTH_MAG,
    south_mag: float = SOUTH_MAG,
) -> StarCatalog:
    """Select the flown catalog: 2,023 stars, all of the asymmetric one to 4.5 and the rest evenly distributed."""
    return uniform(asymmetric(stars, north_mag, south_mag), count, bright_mag)


CATALOGS: dict[str, Callable[..., StarCatalog]] = {
    "asymmetric": asymmetric,
    "uniform": uniform_to_limit,
    "chosen": chosen,
}
