"""Cost of a candidate of a search: prices of its factors, and the parts list of its scene's dome."""

from __future__ import annotations

import math
from collections.abc import Mapping

from skysim.core.errors import InputError, unknown_name
from skysim.core.units import in_si
from skysim.experiments.study.designs import Point
from skysim.experiments.study.factors import Factor, Levels, Range, Value, split_quantity
from skysim.experiments.study.plan import Cost, Plan, resolve_point
from skysim.results.files.builder.parts import parts_list
from skysim.scene.scene import Scene
from skysim.scene.sections.light import DomeConfig

COST = "cost"


def check_cost(factors: Mapping[str, Factor], config: Cost) -> None:
    """Raise InputError for prices of unknown factors or levels, and for prices per unit of a factor without numbers."""
    for name in config.per:
        where = f"optimize.cost.per.{name}"
        factor = require_factor(name, factors, where)
        values = [value for value, _ in factor.options()]
        try:
            for value in values if not isinstance(factor, Levels) else [values[0]]:
                si(value)
        except InputError as error:
            allowed = (
                "numbers, or quantities with units; prices of named levels: optimize.cost.levels"
            )
            raise InputError(where, error.problem, allowed) from None
    for name, prices in config.levels.items():
        where = f"optimize.cost.levels.{name}"
        factor = require_factor(name, factors, where)
        named = (
            [str(level) for level, _ in factor.options()] if not isinstance(factor, Range) else []
        )
        if sorted(named) != sorted(prices):
            allowed = (
                f"a price of each of {', '.join(named)}"
                if named
                else "optimize.cost.per, as it is a range"
            )
            raise InputError(where, f"prices {', '.join(prices) or 'nothing'}", allowed)


def check_parts(config: Cost, scene: Scene) -> None:
    """Raise InputError if a scene whose parts are to be priced has no dome."""
    if config.parts and not isinstance(scene.light, DomeConfig):
        raise InputError(
            "optimize.cost.parts", f"light of kind {scene.light.kind} has no parts", "dome"
        )


def require_factor(name: str, factors: Mapping[str, Factor], where: str) -> Factor:
    """The factor with a name. Raises InputError if there is none."""
    if name not in factors:
        raise InputError(where, *unknown_name("factor", name, factors))
    return factors[name]


def si(value: Value) -> float:
    """A plain number unchanged, or a quantity in SI units: "48 in" is 1.2192. Raises InputError."""
    number, unit = split_quantity(value)
    return in_si(value) if unit else number


def cost(plan: Plan, point: Point) -> tuple[float, str]:
    """Cost of a point, and why it has none (NaN): base, `per` and `levels` of the factors, and the parts' total."""
    assert plan.study.optimize is not None
    config = plan.study.optimize.cost
    total = factors_cost(config, point.levels)
    if plan.prices is None:
        return total, ""
    try:
        scene, _ = resolve_point(plan.spec, point.settings)
        return total + parts_list(scene, plan.prices).total, ""
    except InputError as error:
        return math.nan, str(error)


def factors_cost(config: Cost, levels: Mapping[str, Value]) -> float:
    """base + sum of per[factor] * value + prices of the named levels, with values in SI units."""
    linear = sum(price * si(levels[name]) for name, price in config.per.items())
    return (
        config.base
        + linear
        + sum(price[str(levels[name])] for name, price in config.levels.items())
    )
