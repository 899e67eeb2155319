"""Fialho's triangle method, PTASE's identifier in its four versions: candidate lists, a triplet, the direct match.

Fialho & Saotome 2005, section 3.5: "In the first step it tries to match a triangle of observed stars (the three
brightest stars above a minimum magnitude and with a minimum angular distance) with a triangle of catalogued stars" from
a list of candidates for each star. In the second step "the remaining stars in the FOV are matched through a direct
match technique", and the identification is accepted if they are "greater than a minimum threshold (e.g, half the number
of observed stars)".

1. Take the three brightest observed stars that are far enough apart (`search`).
2. List the candidates of each star by magnitude and prior boresight (`_candidate`).
3. Test every triplet of candidates with the triangle's sides and handedness (`_test_neighbors`, `_test_lists`).
4. Match the whole field at the triplet's attitude; accept it if enough stars match, significantly (`_direct_match`).
5. If no triplet is accepted, take another triangle of observed stars (versions 3 and 4).

The paper names four improvements since alg_ide_mf1_1 of 2003 and says what mf1_2 has. mf1_3 is inferred to be between
2 and 4:

    mf1_1  the basic algorithm: every list from the whole catalog
    mf1_2  lists "assembled in an optimized way", and a prior direction of the optical axis
    mf1_3  another triangle of observed stars if the first fails: false stars are tolerated
    mf1_4  also returns mean and variance of the identified stars' magnitude errors

The paper does not say what "optimized" means. Here the first list is a range of the catalog, which is sorted by
magnitude, and the other lists are the neighbors of its stars at the observed angles. Two tests are added in all
versions: the match must be significant against chance (not with the acceptance `thesis`), and the triangles must have
the same handedness. As in the paper, the first triplet that passes is the solution. For a repetitive catalog, such as a
lattice of LEDs, use `saa`.
"""

from collections.abc import Callable
from dataclasses import replace
from functools import partial
from math import sqrt
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from estimator.catalog.pair_index import PairIndex, magnitude_range, neighbor_range
from estimator.core.checks import Floats, frozen
from estimator.core.errors import ImageError
from estimator.core.jit import inlined, jit
from estimator.core.types import StarMatch
from estimator.core.vectors import Vector, row, squared_chord
from estimator.identification.chance import ACCEPT_LOG10_CHANCE, MIN_MATCHES
from estimator.identification.direct_match import (
    DirectMatch,
    angle,
    match_field,
    no_match,
    smart_triangles,
    to_star_match,
    triangle_sides_rad,
    triple,
)
from estimator.identification.solver_options import Options

# Gate of a magnitude, in standard deviations: three stars pass with 0.9973^3 = 99.2 %, the paper's 99.12 +- 0.25 %.
MAG_GATE_SIGMA = 3.0
# Least angle between the stars of a triangle, as a fraction of the field's diagonal. The paper gives no value.
MIN_SIDE_FRACTION = 0.1
# Least fraction of the observed stars that must match: basic, and with false stars.
MIN_FRACTION_BASIC = 0.5
MIN_FRACTION_FALSE_STARS = 0.3


@frozen
class MagnitudeMatch(StarMatch):
    """A match with the errors of its magnitudes.

    Fialho, Lopes & Saotome 2005 use them to calibrate the magnitude offset of a sensor.

    Attributes
    ----------
    offset_mag, variance_mag2
        Mean and variance of observed minus catalog magnitude; NaN if magnitudes are unknown
    """

    offset_mag: float = float("nan")
    variance_mag2: float = float("nan")


class FialhoOptions(NamedTuple):
    """Search parameters. A named tuple, because numba can compile functions that take one.

    Attributes
    ----------
    tolerance_rad, stretch
        Tolerance of a direction; that of an angle is sqrt(2) times it plus stretch times the angle
    gate_mag
        Greatest difference of magnitudes
    triangles, checks, base
        Limits of observed triangles and of angles compared, and number of stars (see `Options`)
    min_fraction
        Fraction of the observed stars that must match
    optimized
        Whether the lists are assembled from neighbors
    boresight, chord2
        Prior boresight, a unit vector in the catalog's frame, and the greatest squared chord of a candidate from it
    accept
        log10 of the chance at which a match is accepted; infinite for the paper's rule, the fraction alone
    """

    tolerance_rad: float
    stretch: float
    gate_mag: float
    triangles: int
    checks: int
    base: int
    min_fraction: float
    optimized: bool
    boresight: Vector
    chord2: float
    accept: float = ACCEPT_LOG10_CHANCE


def search_options(
    tolerance_rad: float,
    settings: Options,
    min_fraction: float,
    optimized: bool,
    retries: bool,
) -> FialhoOptions:
    """Search parameters of one version.

    Parameters
    ----------
    min_fraction
        Fraction of the observed stars that must match
    optimized
        Whether the lists are assembled from neighbors
    retries
        Whether other observed triangles are tried if the first fails

    Raises
    ------
    ImageError
        Unless the tolerance and the magnitude error are positive.
    """
    if not min(tolerance_rad, settings.epsilon_mag) > 0:
        raise ImageError(
            f"fialho: tolerance {tolerance_rad} rad, magnitude error {settings.epsilon_mag}; allowed: more than 0"
        )
    # No chord on the unit sphere is longer than 2: without a prior boresight every star passes.
    boresight = (0.0, 0.0, 1.0)
    chord2 = 5.0
    if settings.boresight_ref is not None:
        x, y, z = settings.boresight_ref
        boresight = float(x), float(y), float(z)
        chord2 = 4 * np.sin(min(settings.within_rad, np.pi) / 2) ** 2
    return FialhoOptions(
        tolerance_rad,
        settings.stretch,
        MAG_GATE_SIGMA * settings.epsilon_mag,
        settings.max_triangles if retries else 1,
        settings.max_checks,
        settings.base_stars,
        min_fraction,
        optimized,
        boresight,
        float(chord2),
        np.inf if settings.by_paper else ACCEPT_LOG10_CHANCE,
    )


def _identify(
    min_fraction: float,
    optimized: bool,
    retries: bool,
    vectors_cam: Floats,
    index: PairIndex,
    tolerance_rad: float,
    **options: Any,
) -> StarMatch | None:
    """Identify stars with the parameters of one version; only an optimized one has a prior boresight."""
    settings = Options(**options)
    if not optimized:
        settings = replace(settings, boresight_ref=None)
    parameters = search_options(tolerance_rad, settings, min_fraction, optimized, retries)
    settings.require_known_focal("fialho")
    count = len(vectors_cam)
    if count < MIN_MATCHES:
        return None
    rays = np.ascontiguousarray(vectors_cam)
    match = search(rays, settings.magnitudes(count), index, parameters)
    return to_star_match(match, settings.by_paper)


fialho_1 = partial(_identify, MIN_FRACTION_BASIC, False, False)
"""The basic algorithm: one triangle, each list from the whole catalog, no prior boresight. See `fialho_4`."""

fialho_2 = partial(_identify, MIN_FRACTION_BASIC, True, False)
"""One triangle with optimized lists, near the prior boresight if there is one. See `fialho_4`."""

fialho_3 = partial(_identify, MIN_FRACTION_FALSE_STARS, True, True)
"""Several triangles with optimized lists, near the prior boresight if there is one. See `fialho_4`."""


def fialho_4(
    vectors_cam: Floats, index: PairIndex, tolerance_rad: float, **options: Any
) -> MagnitudeMatch | None:
    """Fialho's triangle method, latest version: as the third, and returns the errors of the magnitudes.

    Parameters
    ----------
    vectors_cam
        (N, 3) observed unit vectors, brightest first
    index
        Catalog of the stars and pairs
    tolerance_rad
        Tolerance of a direction; that of an angle is sqrt(2) times it, plus `stretch` times the angle
    options
        Keywords of `Options`. `magnitude`, if the index has magnitudes too, shortens the lists. `boresight_ref` and
        `within_rad` are the prior boresight: candidates are within that angle of it, which must therefore include half
        the field's diagonal and the error of the prior

    Returns
    -------
    MagnitudeMatch | None
        None if too few stars match, or if the match is not significant (1e-5 expected by chance)
    """
    match = fialho_3(vectors_cam, index, tolerance_rad, **options)
    if match is None:
        return None
    magnitudes = Options(**options).magnitudes(len(vectors_cam))
    # Errors of the magnitudes of the identified stars.
    offset_mag = magnitudes[match.observed] - index.magnitude[match.star]
    return MagnitudeMatch(
        match.observed,
        match.star,
        match.cam_from_ref,
        match.log10_chance,
        offset_mag=float(offset_mag.mean()),
        variance_mag2=float(np.var(offset_mag, ddof=1)),
    )


VERSIONS: dict[str, Callable[..., StarMatch | None]] = {
    "fialho_1": fialho_1,
    "fialho_2": fialho_2,
    "fialho_3": fialho_3,
    "fialho_4": fialho_4,
}


@jit
def search(
    rays: Floats, magnitudes: Floats, index: PairIndex, options: FialhoOptions
) -> DirectMatch:
    """The compiled search over observed triangles: the brightest first, then others, with all stars changing soon.

    Parameters
    ----------
    rays, magnitudes
        (N, 3) unit vectors, brightest first, and their (N,) magnitudes, NaN if unknown

    Returns
    -------
    DirectMatch
        Empty if no match is accepted
    """
    tried = np.zeros(2, np.int64)  # triplets, angles compared
    min_side_rad = MIN_SIDE_FRACTION * index.max_angle_rad
    base = min(options.base, len(rays))
    # 1. The three brightest stars.
    corners = _brightest(rays, base, min_side_rad)
    if corners[0] < 0:
        return no_match()
    # 2. to 4. Test its triplets.
    match = triplets(rays, magnitudes, index, corners, options, tried)
    if len(match.observed):
        return match
    # 5. Other triangles, in an order in which one false star costs little.
    count = 1
    for others in smart_triangles(base):
        if count >= options.triangles or tried[1] >= options.checks:
            return no_match()
        # Not the first triangle again, and none that is too small.
        if (others == corners).all() or min(*triangle_sides_rad(rays, others)) < min_side_rad:
            continue
        match = triplets(rays, magnitudes, index, others, options, tried)
        if len(match.observed):
            return match
        count += 1
    return no_match()


@jit
def _brightest(rays: Floats, base: int, min_side_rad: float) -> NDArray:
    """Rows of the three brightest stars that are at least min_side_rad apart; -1 if there are none."""
    for i in range(base):
        for j in range(i + 1, base):
            if angle(rays[i], rays[j]) < min_side_rad:
                continue
            # The first triangle in the order of brightness whose sides are long enough.
            for k in range(j + 1, base):
                corners = np.array([i, j, k])
                if min(*triangle_sides_rad(rays, corners)) >= min_side_rad:
                    return corners
    return np.full(3, -1)


@jit
def triplets(
    rays: Floats,
    magnitudes: Floats,
    index: PairIndex,
    corners: NDArray,
    options: FialhoOptions,
    tried: NDArray,
) -> DirectMatch:
    """Test every triplet of candidates that fits an observed triangle by direct match, until one is accepted.

    Parameters
    ----------
    corners
        (3,) rows of the observed stars
    tried
        (2,) triplets tested and angles compared so far, increased in place
    """
    sides = np.array(triangle_sides_rad(rays, corners))
    # The index holds no longer pairs.
    if sides.max() > index.max_angle_rad:
        return no_match()
    tolerance = sqrt(2.0) * options.tolerance_rad + options.stretch * sides
    if options.optimized:
        return _test_neighbors(
            rays, magnitudes, index, corners, sides, tolerance, options, tried
        )
    return _test_lists(rays, magnitudes, index, corners, sides, tolerance, options, tried)


@jit
def _direct_match(
    rays: Floats,
    index: PairIndex,
    corners: NDArray,
    stars: NDArray,
    options: FialhoOptions,
    tried: int,
) -> DirectMatch:
    """Step 4: the direct match of one triplet; empty if too few stars match or it is not significant."""
    match = match_field(
        rays, index, corners, stars, options.tolerance_rad, options.stretch, tried
    )
    # The paper's threshold on the number of matches, and the added one on their significance.
    if (
        len(match.observed) <= options.min_fraction * len(rays)
        or match.log10_chance > options.accept
    ):
        return no_match()
    return match


@jit
def _candidate(index: PairIndex, star: int, magnitude: float, options: FialhoOptions) -> bool:
    """Step 2: whether a star is within the magnitude gate and near enough to the prior boresight."""
    # The comparison is False for NaN: an unknown magnitude passes.
    if abs(index.magnitude[star] - magnitude) > options.gate_mag:
        return False
    return squared_chord(row(index.vectors, star), options.boresight) <= options.chord2


@inlined
def _test_neighbors(
    rays: Floats,
    magnitudes: Floats,
    index: PairIndex,
    corners: NDArray,
    sides: Floats,
    tolerance: Floats,
    options: FialhoOptions,
    tried: NDArray,
) -> DirectMatch:
    """Steps 2 and 3, optimized: the first list is a range of the sorted catalog, the others are its neighbors."""
    # 2. and 3. For each candidate a of the first star: collect candidates b of the second at the angle of side 0, then
    # test each candidate c of the third at the angle of side 1 against all of them.
    handedness = triple(rays[corners[0]], rays[corners[1]], rays[corners[2]])
    second = np.empty(len(index.vectors), np.int64)
    begin, end = magnitude_range(index, magnitudes[corners[0]], options.gate_mag)
    for a in range(begin, end):
        if tried[1] >= options.checks:
            break
        tried[1] += 1
        if not _candidate(index, a, magnitudes[corners[0]], options):
            continue
        # Candidates b at the angle of side 0 from a.
        count = 0
        low, high = neighbor_range(index, a, sides[0] - tolerance[0], sides[0] + tolerance[0])
        tried[1] += high - low
        for b in index.neighbor[low:high]:
            if _candidate(index, b, magnitudes[corners[1]], options):
                second[count] = b
                count += 1
        # Candidates c at the angle of side 1 from a.
        if count == 0:
            continue
        low, high = neighbor_range(index, a, sides[1] - tolerance[1], sides[1] + tolerance[1])
        for c in index.neighbor[low:high]:
            tried[1] += count
            if not _candidate(index, c, magnitudes[corners[2]], options):
                continue
            # Side 2, and the handedness.
            for b in second[:count]:
                if abs(angle(index.vectors[b], index.vectors[c]) - sides[2]) > tolerance[2]:
                    continue
                if (
                    handedness * triple(index.vectors[a], index.vectors[b], index.vectors[c])
                    <= 0
                ):
                    continue
                # 4. The direct match.
                tried[0] += 1
                match = _direct_match(
                    rays, index, corners, np.array([a, b, c]), options, tried[0]
                )
                if len(match.observed):
                    return match
    return no_match()


@jit
def _all_candidates(index: PairIndex, magnitude: float, options: FialhoOptions) -> NDArray:
    """Candidates for one star, from the whole catalog."""
    out = np.empty(len(index.vectors), np.int64)
    count = 0
    for star in range(len(index.vectors)):
        if _candidate(index, star, magnitude, options):
            out[count] = star
            count += 1
    return out[:count]


@inlined
def _test_lists(
    rays: Floats,
    magnitudes: Floats,
    index: PairIndex,
    corners: NDArray,
    sides: Floats,
    tolerance: Floats,
    options: FialhoOptions,
    tried: NDArray,
) -> DirectMatch:
    """Steps 2 and 3, basic: three lists, each from the whole catalog, and every triplet of them."""
    # 2. The three lists.
    first = _all_candidates(index, magnitudes[corners[0]], options)
    second = _all_candidates(index, magnitudes[corners[1]], options)
    third = _all_candidates(index, magnitudes[corners[2]], options)
    handedness = triple(rays[corners[0]], rays[corners[1]], rays[corners[2]])
    vectors = index.vectors
    # 3. Every triplet with the three sides and the handedness.
    for a in first:
        if tried[1] >= options.checks:
            break
        for b in second:
            tried[1] += 1
            if abs(angle(vectors[a], vectors[b]) - sides[0]) > tolerance[0]:
                continue
            for c in third:
                tried[1] += 1
                if abs(angle(vectors[a], vectors[c]) - sides[1]) > tolerance[1]:
                    continue
                if abs(angle(vectors[b], vectors[c]) - sides[2]) > tolerance[2]:
                    continue
                if handedness * triple(vectors[a], vectors[b], vectors[c]) <= 0:
                    continue
                # 4. The direct match.
                tried[0] += 1
                match = _direct_match(
                    rays, index, corners, np.array([a, b, c]), options, tried[0]
                )
                if len(match.observed):
                    return match
    return no_match()
