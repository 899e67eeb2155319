"""Factors of a study: schema of levels, values, ranges and distributions.

Every factor maps a number u in [0, 1] to a value (`at`). For a distribution this is its quantile function (inverse
transform sampling), for a range the fraction of the way, and for levels the level of that cell of [0, 1]. A sampled
design therefore only generates points in the unit cube.
"""

from __future__ import annotations

import re
from collections.abc import Callable
from typing import Annotated, Any, Literal, Self

import numpy as np
import scipy
from pydantic import Discriminator, Field, Tag, model_validator

from skysim.core.units import ConfigModel

Value = Any  # value of a key: any YAML value
Settings = dict[str, Value]  # dotted keys of the scene, or of `trial.`, to values
QUANTITY = re.compile(r"^\s*([-+]?(?:\d+\.?\d*|\.\d+)(?:[eE][-+]?\d+)?)\s*(\D.*?)?\s*$")
Name = Annotated[str, Field(pattern=r"^[a-z_]+(\.\w+)*$")]


def split(value: Value) -> tuple[float, str]:
    """Split a number, or a quantity such as "48 in", into number and unit. Raises ValueError."""
    if isinstance(value, int | float) and not isinstance(value, bool):
        return float(value), ""
    told = QUANTITY.match(value) if isinstance(value, str) else None
    if told is None:
        raise ValueError(f'{value!r} is no number; allowed: a number, or one with its unit such as "48 in"')
    return float(told[1]), told[2] or ""


def joined(number: float, unit: str) -> Value:
    """The inverse of `split`; integral numbers become int."""
    if unit:
        return f"{number:.12g} {unit}"
    return int(number) if number == int(number) and abs(number) < 2**53 else float(f"{number:.12g}")


class Levels(ConfigModel):
    """Named levels, each of which sets any number of keys."""

    levels: Annotated[dict[str, Settings], Field(min_length=1)]

    def options(self) -> list[tuple[str, Settings]]:
        """Every level: its name in tables and its settings."""
        return list(self.levels.items())

    def at(self, share: float) -> tuple[Value, Settings]:
        """The level at u = share in [0, 1]; all levels are equally likely."""
        return pick(self.options(), share)


class Keyed(ConfigModel):
    """Base of factors with one value, set at one key or at several keys that must be equal (apex and radius)."""

    key: Name | None = None
    keys: tuple[Name, ...] = ()

    @model_validator(mode="after")
    def one_way_to_say_it(self) -> Self:
        if (self.key is None) == (not self.keys):
            raise ValueError("a factor takes either key or keys")
        return self

    def sets(self, value: Value) -> Settings:
        """Settings that give every key this value."""
        return dict.fromkeys(self.keys or (self.key or "",), value)


class Values(Keyed):
    """Explicit values of a key."""

    values: Annotated[tuple[Value, ...], Field(min_length=1)]

    def options(self) -> list[tuple[Value, Settings]]:
        """Every value with its settings."""
        return [(value, self.sets(value)) for value in self.values]

    def at(self, share: float) -> tuple[Value, Settings]:
        """The value at u = share in [0, 1]; all values are equally likely."""
        return pick(self.options(), share)


class Range(Keyed):
    """A key between two bounds: `steps` values in a design with levels, uniformly distributed in a sampled design.

    scale : equal steps (linear) or equal ratios (log); whole : rounded to whole numbers
    """

    from_: Annotated[Value, Field(alias="from")]
    to: Value
    steps: Annotated[int, Field(ge=2, le=10_000)] = 5
    scale: Literal["linear", "log"] = "linear"
    whole: bool = False

    @model_validator(mode="after")
    def of_one_unit(self) -> Range:
        (low, unit), (high, other) = split(self.from_), split(self.to)
        if unit != other:
            raise ValueError(f"from {self.from_!r} and to {self.to!r} differ in their unit; allowed: one")
        if not low < high:
            raise ValueError(f"from {self.from_!r} is not below to {self.to!r}")
        if self.scale == "log" and low <= 0:
            raise ValueError(f"from {self.from_!r} is not positive, as scale: log wants")
        return self

    def options(self) -> list[tuple[Value, Settings]]:
        """`steps` values from one bound to the other, both included."""
        return [self.at(share) for share in np.linspace(0, 1, self.steps)]

    def at(self, share: float) -> tuple[Value, Settings]:
        """The value at the fraction `share` of the way from `from` to `to`."""
        (low, unit), (high, _) = split(self.from_), split(self.to)
        between = low * (high / low) ** share if self.scale == "log" else low + (high - low) * share
        value = joined(round(between) if self.whole else between, unit)
        return value, self.sets(value)


class Distribution(Keyed):
    """A random key: normal (mean, sigma), lognormal (median, sigma of the logarithm), triangular (low, mode, high),
    integers (low to high, both included). For uniform and log-uniform use `from` and `to`.

    All numbers have the same unit, except the sigma of a lognormal, which has none.
    """

    distribution: Literal["normal", "lognormal", "triangular", "integers"]
    mean: Value = None
    median: Value = None
    sigma: Value = None
    low: Value = None
    mode: Value = None
    high: Value = None

    @model_validator(mode="after")
    def told(self) -> Distribution:
        wanted = PARAMETERS[self.distribution]
        given = [name for name in ALL if getattr(self, name) is not None]
        if sorted(given) != sorted(wanted):
            raise ValueError(
                f"{self.distribution} takes {', '.join(wanted)}, not {', '.join(given) or 'nothing'}"
            )
        self.numbers()
        return self

    def numbers(self) -> tuple[list[float], str]:
        """The parameters in the order of PARAMETERS, and their unit. Raises ValueError."""
        parts = [split(getattr(self, name)) for name in PARAMETERS[self.distribution]]
        units = {unit for _, unit in (parts[:1] if self.distribution == "lognormal" else parts)}
        if len(units) > 1:
            raise ValueError(f"units {', '.join(repr(unit) for unit in sorted(units))} differ; allowed: one")
        numbers = [number for number, _ in parts]
        if self.sigma is not None and numbers[1] <= 0:
            raise ValueError(f"sigma {self.sigma!r} is not positive")
        if self.low is not None and not (numbers == sorted(numbers) and numbers[0] < numbers[-1]):
            raise ValueError(f"{', '.join(PARAMETERS[self.distribution])} do not ascend")
        return numbers, units.pop()

    def options(self) -> list[tuple[Value, Settings]]:
        """None: a distribution has no levels."""
        return []

    def at(self, share: float) -> tuple[Value, Settings]:
        """The quantile at probability `share`."""
        numbers, unit = self.numbers()
        value = joined(float(QUANTILES[self.distribution](share, *numbers)), unit)
        return value, self.sets(value)


ALL = ("mean", "median", "sigma", "low", "mode", "high")
PARAMETERS = {
    "normal": ("mean", "sigma"),
    "lognormal": ("median", "sigma"),
    "triangular": ("low", "mode", "high"),
    "integers": ("low", "high"),
}
QUANTILES: dict[str, Callable[..., Any]] = {
    "normal": lambda share, mean, sigma: scipy.stats.norm.ppf(share, mean, sigma),
    "lognormal": lambda share, median, sigma: median * np.exp(sigma * scipy.stats.norm.ppf(share)),
    "triangular": lambda share, low, mode, high: scipy.stats.triang.ppf(
        share, (mode - low) / (high - low), low, high - low
    ),
    "integers": lambda share, low, high: min(np.floor(low + share * (high - low + 1)), high),
}


def pick(options: list[tuple[Any, Settings]], share: float) -> tuple[Value, Settings]:
    """The option at u = share, with [0, 1] divided equally among the options."""
    return options[min(int(share * len(options)), len(options) - 1)]


def kind_of(value: Any) -> str:
    """Tag of the kind of factor, from its keys, so that error messages name the keys of that kind only."""
    keys = value if isinstance(value, dict) else getattr(value, "__dict__", {})
    for name in ("levels", "values", "distribution"):
        if name in keys:
            return name
    return "range"


Factor = Annotated[
    Annotated[Levels, Tag("levels")]
    | Annotated[Values, Tag("values")]
    | Annotated[Distribution, Tag("distribution")]
    | Annotated[Range, Tag("range")],
    Discriminator(kind_of),
]
