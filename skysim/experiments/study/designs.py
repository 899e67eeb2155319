"""Experimental designs: full factorial, one factor at a time, and samples of the unit cube of the factors.

The sampled designs (Latin hypercube, Sobol sequence, Saltelli) generate points in [0, 1]^D, one coordinate per
factor, and `value_at` of a factor maps each coordinate to a value.
"""

from __future__ import annotations

import itertools
from collections.abc import Callable, Iterator, Mapping
from typing import Annotated, Literal, NamedTuple

import numpy as np
import scipy
from pydantic import Field

from skysim.core.errors import InputError
from skysim.core.types import Floats
from skysim.core.units import ConfigModel
from skysim.experiments.study.factors import Factor, Settings, Value


class Point(NamedTuple):
    """One combination of factor levels: the level of each factor, and all settings together."""

    levels: dict[str, Value]
    settings: Settings


class Design(ConfigModel):
    """How points are chosen.

    kind  : factorial, every combination of levels; one_at_a_time, the first levels, then each other level alone;
            lhs, a Latin hypercube; sobol, a Sobol sequence; saltelli, the sample for Sobol indices: matrices A and B,
            and A with each column of B in turn, points * (factors + 2) in all (Saltelli et al. 2010)
    points: number of points, for lhs, sobol and saltelli only; a power of two for sobol and saltelli
    """

    kind: Literal["factorial", "one_at_a_time", "lhs", "sobol", "saltelli"] = "factorial"
    points: Annotated[int, Field(ge=2, le=1_000_000)] | None = None


Factors = Mapping[str, Factor]


def points(design: Design, factors: Factors, seed: int) -> list[Point]:
    """All points of a design, in order. Raises InputError if factors and design are incompatible."""
    sampled = design.kind in ("lhs", "sobol", "saltelli")
    if sampled != (design.points is not None):
        allowed = "a number of points" if sampled else "none (the levels define the points)"
        raise InputError("design.points", f"{design.points} for {design.kind}", allowed)
    if (
        design.kind in ("sobol", "saltelli")
        and design.points is not None
        and design.points & (design.points - 1)
    ):
        raise InputError("design.points", f"{design.points} for {design.kind}", "a power of two")
    for name, factor in factors.items():
        if not sampled and not factor.options():
            raise InputError(
                f"factors.{name}",
                "a distribution has no levels",
                "design.kind lhs, sobol, saltelli",
            )
    return list(DESIGNS[design.kind](design, factors, seed))


def make_point(chosen: Mapping[str, tuple[Value, Settings]]) -> Point:
    """The point with these levels and settings of each factor."""
    settings: Settings = {}
    for _, level_settings in chosen.values():
        settings |= level_settings
    return Point({name: level for name, (level, _) in chosen.items()}, settings)


def factorial(design: Design, factors: Factors, seed: int) -> Iterator[Point]:
    """Every combination; the last factor changes fastest."""
    for levels in itertools.product(*(factor.options() for factor in factors.values())):
        yield make_point(dict(zip(factors, levels, strict=True)))


def one_at_a_time(design: Design, factors: Factors, seed: int) -> Iterator[Point]:
    """The first level of every factor; then each other level of each factor alone."""
    first = {name: factor.options()[0] for name, factor in factors.items()}
    yield make_point(first)
    for name, factor in factors.items():
        for level in factor.options()[1:]:
            yield make_point(first | {name: level})


def points_at(factors: Factors, coordinates: Floats) -> Iterator[Point]:
    """The points at (P, D) coordinates in the unit cube."""
    for row in coordinates.tolist():
        yield make_point(
            {name: factors[name].value_at(u) for name, u in zip(factors, row, strict=True)}
        )


def sample(design: Design, factors: Factors, seed: int) -> Iterator[Point]:
    """A Latin hypercube, in which each factor's range is divided into as many strips as points, with one point in each;
    or a Sobol sequence, scrambled by the seed."""
    qmc = scipy.stats.qmc
    sampler = (qmc.LatinHypercube if design.kind == "lhs" else qmc.Sobol)(len(factors), rng=seed)
    yield from points_at(factors, sampler.random(design.points or 0))


def saltelli(design: Design, factors: Factors, seed: int) -> Iterator[Point]:
    """A, B, then for each factor A with that column taken from B. `sensitivity.sample_outputs` relies on this order.

    A and B are the two halves of the columns of one scrambled Sobol sequence of dimension 2 D.
    """
    count = design.points or 0
    width = len(factors)
    coordinates = scipy.stats.qmc.Sobol(2 * width, rng=seed).random(count)
    a = coordinates[:, :width]
    b = coordinates[:, width:]
    yield from points_at(factors, a)
    yield from points_at(factors, b)
    for n in range(width):
        yield from points_at(factors, np.where(np.arange(width) == n, b, a))


DESIGNS: dict[str, Callable[[Design, Factors, int], Iterator[Point]]] = {
    "factorial": factorial,
    "one_at_a_time": one_at_a_time,
    "lhs": sample,
    "sobol": sample,
    "saltelli": saltelli,
}
