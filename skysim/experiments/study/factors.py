"""Factors of a study: schema of levels, values, ranges and distributions.

Every factor maps a number u in [0, 1] to a value (`value_at`). For a distribution this is its quantile function
(inverse transform sampling), for a range the fraction of the way, and for levels the level of that cell of [0, 1]. A
sampled design therefore only generates points in the unit cube.
"""

from __future__ import annotations

import inspect
import itertools
import math
import re
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from typing import Annotated, Any, Literal, NamedTuple

import numpy as np
import scipy
from pydantic import Discriminator, Field, Tag

from skysim.core.errors import InputError
from skysim.core.types import Floats
from skysim.core.units import ConfigModel, NotEmpty, within

Value = Any  # value of a key: any YAML value
Settings = dict[str, Value]  # dotted keys of the scene, or of `trial.`, to values
Option = tuple[Value, Settings]  # a level as in tables, and its settings
# Of all factors: the scene of each level is read and kept before the first trial.
MAX_LEVELS = 1000
QUANTITY = re.compile(r"^\s*([-+]?(?:\d+\.?\d*|\.\d+)(?:[eE][-+]?\d+)?)\s*(\D.*?)?\s*$")
Name = Annotated[str, Field(pattern=r"^[a-z_]+(\.\w+)*$")]


def split_quantity(value: Value) -> tuple[float, str]:
    """Split a number, or a quantity such as "48 in", into number and unit. Raises InputError."""
    if isinstance(value, int | float) and not isinstance(value, bool):
        return float(value), ""
    match = QUANTITY.match(value) if isinstance(value, str) else None
    if match is None:
        raise InputError(
            "", f"{value!r} is not a number", 'a number, or one with its unit such as "48 in"'
        )
    return float(match[1]), match[2] or ""


def join_quantity(number: float, unit: str) -> Value:
    """The inverse of `split_quantity`; integral numbers become int."""
    if unit:
        return f"{number:.12g} {unit}"
    return (
        int(number)
        if number == int(number) and abs(number) < 2**53
        else float(f"{number:.12g}")
    )


def option_at(factor: Levels | Values, u: float) -> Option:
    """The level or value at u in [0, 1], which is divided equally among all options."""
    options = factor.options()
    return options[min(int(u * len(options)), len(options) - 1)]


class Levels(ConfigModel):
    """Named levels, each of which sets any number of keys."""

    levels: Annotated[dict[str, Settings], Field(min_length=1)]
    value_at = option_at

    def options(self) -> list[Option]:
        """Every level: its name in tables and its settings."""
        return list(self.levels.items())


class KeyedFactor(ConfigModel):
    """Base of factors with one value, set at one key or at several keys that must be equal (apex and radius)."""

    key: Name | None = None
    keys: tuple[Name, ...] = ()

    def check(self) -> None:
        if (self.key is None) == (not self.keys):
            raise InputError("", "a factor needs either key or keys")

    def option(self, value: Value) -> Option:
        """A value, and the settings that give it to every key."""
        return value, dict.fromkeys(self.keys or (self.key or "",), value)


class Values(KeyedFactor):
    """Explicit values of a key."""

    values: NotEmpty[Value]
    value_at = option_at

    def options(self) -> list[Option]:
        """Every value with its settings."""
        return list(map(self.option, self.values))


class Range(KeyedFactor):
    """A key between two bounds: `steps` values in a design with levels, uniformly distributed in a sampled design.

    Attributes
    ----------
    scale
        Equal steps (linear) or equal ratios (log)
    integer
        Whether values are rounded to whole numbers
    """

    from_: Annotated[Value, Field(alias="from")]
    to: Value
    steps: Annotated[int, within(2, MAX_LEVELS)] = 5
    scale: Literal["linear", "log"] = "linear"
    integer: bool = False

    def check(self) -> None:
        (low, unit), (high, other) = split_quantity(self.from_), split_quantity(self.to)
        if unit != other:
            raise InputError(
                "", f"from {self.from_!r} and to {self.to!r} have different units", "one unit"
            )
        if not low < high:
            raise InputError("", f"from is {self.from_!r}", f"below to, {self.to!r}")
        if self.scale == "log" and low <= 0:
            raise InputError("", f"from is {self.from_!r}", "above 0 with scale: log")

    def options(self) -> list[Option]:
        """`steps` values from one bound to the other, both included."""
        return [self.value_at(u) for u in np.linspace(0, 1, self.steps)]

    def value_at(self, u: float) -> Option:
        """The value at the fraction u of the way from `from` to `to`."""
        (low, unit), (high, _) = split_quantity(self.from_), split_quantity(self.to)
        number = low * (high / low) ** u if self.scale == "log" else low + (high - low) * u
        return self.option(join_quantity(round(number) if self.integer else number, unit))


class Distribution(KeyedFactor):
    """A random key: normal (mean, sigma), lognormal (median, sigma of the logarithm), triangular (low, mode, high),
    truncated_normal (mean and sigma before truncation to low and high), integers (low to high, both included).
    For uniform and log-uniform use `from` and `to`.

    All numbers have the same unit, except the sigma of a lognormal, which has none.
    """

    distribution: Literal["normal", "lognormal", "triangular", "truncated_normal", "integers"]
    mean: Value = None
    median: Value = None
    sigma: Value = None
    low: Value = None
    mode: Value = None
    high: Value = None

    def check(self) -> None:
        required = PARAMETERS[self.distribution]
        provided = [name for name in ALL_PARAMETERS if getattr(self, name) is not None]
        if sorted(provided) != sorted(required):
            raise InputError(
                "",
                f"{self.distribution}: parameters {', '.join(provided) or 'none'}",
                ", ".join(required),
            )
        self.parameters()

    def parameters(self) -> tuple[list[float], str]:
        """The parameters in the order of PARAMETERS, and their unit. Raises InputError."""
        names = PARAMETERS[self.distribution]
        quantities = [split_quantity(getattr(self, name)) for name in names]
        with_unit = quantities[:1] if self.distribution == "lognormal" else quantities
        units = {unit for _, unit in with_unit}
        if len(units) > 1:
            raise InputError(
                "",
                f"different units {', '.join(repr(unit) for unit in sorted(units))}",
                "one unit",
            )
        parameters = [number for number, _ in quantities]
        if self.sigma is not None and parameters[1] <= 0:
            raise InputError("", f"sigma is {self.sigma!r}", "above 0")
        ascending = [name for name in names if name in ("low", "mode", "high")]
        values = [parameters[names.index(name)] for name in ascending]
        if values and not (values == sorted(values) and values[0] < values[-1]):
            raise InputError("", f"{', '.join(ascending)} are not in ascending order")
        return parameters, units.pop()

    def options(self) -> list[Option]:
        """None: a distribution has no levels."""
        return []

    def value_at(self, u: float) -> Option:
        """The quantile at probability u."""
        parameters, unit = self.parameters()
        quantile = float(QUANTILES[self.distribution](u, *parameters))
        return self.option(join_quantity(quantile, unit))


ALL_PARAMETERS = ("mean", "median", "sigma", "low", "mode", "high")
QUANTILES: dict[str, Callable[..., Any]] = {
    "normal": lambda u, mean, sigma: scipy.stats.norm.ppf(u, mean, sigma),
    "lognormal": lambda u, median, sigma: median * np.exp(sigma * scipy.stats.norm.ppf(u)),
    "triangular": lambda u, low, mode, high: scipy.stats.triang.ppf(
        u, (mode - low) / (high - low), low, high - low
    ),
    "truncated_normal": lambda u, mean, sigma, low, high: scipy.stats.truncnorm.ppf(
        u, (low - mean) / sigma, (high - mean) / sigma, mean, sigma
    ),
    "integers": lambda u, low, high: min(np.floor(low + u * (high - low + 1)), high),
}
# Names of the parameters of a distribution.
PARAMETERS = {
    name: list(inspect.signature(quantile).parameters)[1:]
    for name, quantile in QUANTILES.items()
}


def kind_of(value: Any) -> str:
    """Tag of the kind of factor, from its keys, so that error messages name the keys of that kind only."""
    keys = value if isinstance(value, dict) else getattr(value, "__dict__", {})
    return next(
        (name for name in ("levels", "values", "distribution") if name in keys), "range"
    )


Factor = Annotated[
    Annotated[Levels, Tag("levels")]
    | Annotated[Values, Tag("values")]
    | Annotated[Distribution, Tag("distribution")]
    | Annotated[Range, Tag("range")],
    Discriminator(kind_of),
]


# Experimental designs: full factorial, one factor at a time, and samples of the factors' unit cube.


MAX_POINTS = 100_000  # which are listed before the first trial


def saltelli(count: int, width: int, seed: int) -> Floats:
    """A, B, then for each axis A with its column replaced by B's. `table.response_indices` relies on this order.

    A and B are the two halves of the columns of one scrambled Sobol sequence of dimension 2 D.
    """
    a, b = np.hsplit(scipy.stats.qmc.Sobol(2 * width, rng=seed).random(count), 2)
    return np.concatenate([a, b, *(np.where(row, b, a) for row in np.eye(width, dtype=bool))])


# (P, D) points in the unit cube of a number of points, of factors, and a seed that scrambles them. In a Latin hypercube
# each axis is divided into as many strips as points, with one point in each.
CUBES: dict[str, Callable[[int, int, int], Floats]] = {
    "lhs": lambda n, width, seed: scipy.stats.qmc.LatinHypercube(width, rng=seed).random(n),
    "sobol": lambda n, width, seed: scipy.stats.qmc.Sobol(width, rng=seed).random(n),
    "saltelli": saltelli,
}
SAMPLED_DESIGNS = tuple(CUBES)  # designs in which no two points share a level


class Point(NamedTuple):
    """One combination of factor levels: the level of each factor, and all settings together."""

    levels: dict[str, Value]
    settings: Settings


class Design(ConfigModel):
    """How points are chosen.

    Attributes
    ----------
    kind
        Factorial, every combination of levels; one_at_a_time, the first levels, then each other
        level alone; lhs, a Latin hypercube; sobol, a Sobol sequence; saltelli, the sample for
        Sobol indices: matrices A and B, and A with each column of B in turn, points * (factors
        + 2) in all (Saltelli et al. 2010)
    points
        Number of points, for lhs, sobol and saltelli only; a power of two for sobol and
        saltelli
    """

    kind: Literal["factorial", "one_at_a_time", "lhs", "sobol", "saltelli"] = "factorial"
    points: Annotated[int, within(2, MAX_POINTS)] | None = None


Factors = Mapping[str, Factor]
Options = Iterable[Sequence[Option]]  # a level of each factor, for some points


def one_at_a_time(levels: list[list[Option]]) -> Options:
    """The first level of every factor; then each other level of each factor alone."""
    first = [one[0] for one in levels]
    yield first
    for n, one in enumerate(levels):
        for level in one[1:]:
            yield [*first[:n], level, *first[n + 1 :]]


# Points of the levels of each factor. In a factorial the last factor changes fastest.
GRIDS: dict[str, Callable[[list[list[Option]]], Options]] = {
    "factorial": lambda levels: itertools.product(*levels),
    "one_at_a_time": one_at_a_time,
}


def points(design: Design, factors: Factors, seed: int) -> list[Point]:
    """All points of a design, in order. Raises InputError if factors and design are incompatible."""
    sampled = design.kind in SAMPLED_DESIGNS
    count = design.points or 0
    if sampled != (design.points is not None):
        allowed = "a number of points" if sampled else "none (the levels define the points)"
        raise InputError("design.points", f"{design.points} for {design.kind}", allowed)
    if sampled and not factors:
        raise InputError(
            "factors", f"missing: {design.kind} draws their values", "one or more"
        )
    if design.kind in ("sobol", "saltelli") and count & (count - 1):
        raise InputError(
            "design.points", f"{design.points} for {design.kind}", "a power of two"
        )
    for name, factor in factors.items():
        if not sampled and not factor.options():
            raise InputError(
                f"factors.{name}",
                "a distribution has no levels",
                "design.kind lhs, sobol, saltelli",
            )
    # Counts multiply, so they are checked before the points are made.
    levels = [factor.options() for factor in factors.values()]
    totals = {
        "factorial": math.prod(map(len, levels)),
        "saltelli": count * (len(factors) + 2),
    }
    if (total := totals.get(design.kind, 0)) > MAX_POINTS:
        raise InputError("design", f"{design.kind} of {total} points", f"up to {MAX_POINTS}")
    chosen: Options = (
        (
            [factor.value_at(u) for factor, u in zip(factors.values(), row, strict=True)]
            for row in CUBES[design.kind](count, len(factors), seed).tolist()
        )
        if sampled
        else GRIDS[design.kind](levels)
    )
    return [make_point(dict(zip(factors, one, strict=True))) for one in chosen]


def make_point(chosen: Mapping[str, Option]) -> Point:
    """The point with these levels and settings of each factor."""
    settings: Settings = {}
    for _, level_settings in chosen.values():
        settings |= level_settings
    return Point({name: level for name, (level, _) in chosen.items()}, settings)


def each_level(factors: Factors) -> Iterator[tuple[str, Value, Settings, Settings]]:
    """Every level of every factor with the other factors at their middle: factor, level, its settings, all settings.

    Without factors the one point.
    """
    if not factors:
        yield "", "", {}, {}
    middle = {name: factor.value_at(0.5) for name, factor in factors.items()}
    for name, factor in factors.items():
        # Its own settings are the last: they replace those of others.
        others = {other: option for other, option in middle.items() if other != name}
        for option in factor.options() or [middle[name]]:
            yield name, *option, make_point(others | {name: option}).settings
