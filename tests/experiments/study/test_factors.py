"""Factors of a study: levels, ranges, distributions, and designs that combine them."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as some
from pydantic import TypeAdapter, ValidationError
from scipy import stats

from skysim.core.errors import InputError
from skysim.experiments.study.factors import (
    Design,
    Factor,
    join_quantity,
    points,
    split_quantity,
)

READ = TypeAdapter(Factor).validate_python


@pytest.mark.parametrize(
    ("value", "number", "unit"),
    [(3, 3.0, ""), ("48 in", 48.0, "in"), ("-1.5e-3 N m", -1.5e-3, "N m"), (".5", 0.5, "")],
)
def test_a_quantity_splits_into_number_and_unit(value, number, unit):
    assert split_quantity(value) == (number, unit)


@given(some.floats(-1e9, 1e9, allow_nan=False), some.sampled_from(["", "mm", "N m", "deg"]))
def test_a_quantity_is_formatted_to_twelve_digits(number, unit):
    again, its_unit = split_quantity(join_quantity(number, unit))
    assert its_unit == unit
    assert again == pytest.approx(number, rel=1e-11, abs=1e-300)


def test_a_range_includes_its_ends_and_may_be_logarithmic():
    even = READ({"key": "a.b", "from": "1 m", "to": "3 m", "steps": 3})
    assert [value for value, _ in even.options()] == ["1 m", "2 m", "3 m"]
    ratios = READ({"key": "a.b", "from": 1, "to": 100, "steps": 3, "scale": "log"})
    assert [sets for _, sets in ratios.options()] == [{"a.b": 1}, {"a.b": 10}, {"a.b": 100}]
    integer = READ({"key": "a.b", "from": 1, "to": 2, "steps": 4, "integer": True})
    assert [value for value, _ in integer.options()] == [1, 1, 2, 2]


@pytest.mark.slow
@pytest.mark.parametrize(
    ("factor", "law"),
    [
        ({"distribution": "normal", "mean": 3.0, "sigma": 2.0}, stats.norm(3, 2)),
        (
            {"distribution": "lognormal", "median": 3.0, "sigma": 0.5},
            stats.lognorm(0.5, scale=3),
        ),
        (
            {"distribution": "triangular", "low": 0.0, "mode": 1.0, "high": 4.0},
            stats.triang(0.25, 0, 4),
        ),
        (
            {
                "distribution": "truncated_normal",
                "mean": 3.0,
                "sigma": 2.0,
                "low": 2.0,
                "high": 6.0,
            },
            stats.truncnorm(-0.5, 1.5, 3, 2),
        ),
        ({"distribution": "integers", "low": 2, "high": 6}, stats.randint(2, 7)),
        ({"from": 2.0, "to": 5.0}, stats.uniform(2, 3)),
        ({"from": 2.0, "to": 50.0, "scale": "log"}, stats.loguniform(2, 50)),
    ],
)
def test_a_drawn_factor_has_its_declared_distribution(factor, law):
    """Even shares through `at` against SciPy's law: mean and spread to the grid's own error."""
    drawn = np.array(
        [
            READ(factor | {"key": "x"}).value_at(share)[0]
            for share in (np.arange(4_000) + 0.5) / 4_000
        ]
    )
    assert np.mean(drawn) == pytest.approx(law.mean(), rel=2e-3)
    assert np.std(drawn) == pytest.approx(law.std(), rel=5e-3)


@pytest.mark.parametrize(
    ("factor", "complaint"),
    [
        ({"key": "x", "from": "1 m", "to": "2 in"}, "have different units"),
        ({"key": "x", "from": 3, "to": 2}, "allowed: below to"),
        ({"key": "x", "from": 0, "to": 2, "scale": "log"}, "allowed: above 0 with"),
        (
            {"key": "x", "distribution": "normal", "mean": 1},
            "normal: parameters mean; allowed: mean, sigma",
        ),
        (
            {"key": "x", "distribution": "normal", "mean": "1 m", "sigma": "1 mm"},
            "different units",
        ),
        (
            {"key": "x", "distribution": "normal", "mean": 1, "sigma": 0},
            "sigma is 0; allowed",
        ),
        (
            {"key": "x", "distribution": "triangular", "low": 0, "mode": 5, "high": 4},
            "not in ascending order",
        ),
        (
            {
                "key": "x",
                "distribution": "truncated_normal",
                "mean": 1,
                "sigma": 1,
                "low": 3,
                "high": 2,
            },
            "low, high are not in ascending order",
        ),
        (
            {"key": "x", "distribution": "truncated_normal", "mean": 1, "sigma": 1},
            "allowed: mean, sigma, low, high",
        ),
        ({"key": "x", "from": "wide", "to": 2}, "is not a number"),
        ({"key": "X y", "values": [1]}, "pattern"),
        ({"levels": {}}, "at least 1"),
        ({"values": [1, 2]}, "key"),
    ],
)
def test_an_invalid_factor_is_refused(factor, complaint):
    with pytest.raises(ValidationError, match=complaint):
        READ(factor)


@pytest.mark.parametrize("u", [0.0, 1e-9, 0.3, 1.0])
def test_a_truncated_normal_stays_within_its_bounds(u):
    factor = {
        "key": "x",
        "distribution": "truncated_normal",
        "mean": "1 mm",
        "sigma": "5 mm",
        "low": "0 mm",
    }
    value, settings = READ(factor | {"high": "3 mm"}).value_at(u)
    assert settings == {"x": value}
    assert 0 <= float(value.removesuffix(" mm")) <= 3


THREE = {
    "a": READ({"key": "x", "values": [1, 2, 3]}),
    "b": READ({"levels": {"one": {"y": 1, "z": 1}, "two": {"y": 2}}}),
    "c": READ({"key": "w", "from": 0, "to": 1}),
}


def test_a_factorial_has_every_combination_once():
    found = points(Design(kind="factorial"), THREE, 1)
    levels = [tuple(point.levels.values()) for point in found]
    assert len(found) == len(set(levels)) == 3 * 2 * 5
    assert found[0].settings == {"x": 1, "y": 1, "z": 1, "w": 0}
    assert found[-1].settings == {"x": 3, "y": 2, "w": 1}


def test_one_at_a_time_leaves_all_others_at_their_first():
    found = points(Design(kind="one_at_a_time"), THREE, 1)
    assert len(found) == 1 + 2 + 1 + 4
    first = found[0].levels
    assert all(
        sum(point.levels[name] != first[name] for name in first) == 1 for point in found[1:]
    )


def test_a_latin_hypercube_has_one_point_in_every_strip():
    factors = {
        "a": READ({"key": "x", "from": 0.0, "to": 1.0}),
        "b": READ({"key": "y", "from": 0.0, "to": 1.0}),
    }
    found = points(Design(kind="lhs", points=50), factors, 3)
    for name in factors:
        strips = np.sort([int(50 * point.levels[name]) for point in found])
        assert strips.tolist() == list(range(50))


def test_sobols_points_cover_a_square_more_evenly_than_chance():
    """Discrepancy against the mean of random points'."""
    from scipy.stats import qmc

    factors = {
        "a": READ({"key": "x", "from": 0.0, "to": 1.0}),
        "b": READ({"key": "y", "from": 0.0, "to": 1.0}),
    }
    found = np.array(
        [list(p.levels.values()) for p in points(Design(kind="sobol", points=64), factors, 3)]
    )
    random = np.random.default_rng(1).random((20, 64, 2))
    assert qmc.discrepancy(found) < 0.3 * np.mean([qmc.discrepancy(one) for one in random])


def test_saltellis_blocks_are_a_b_and_a_with_a_column_of_b():
    factors = {name: READ({"key": name, "from": 0.0, "to": 1.0}) for name in "xyz"}
    found = np.array(
        [
            list(p.levels.values())
            for p in points(Design(kind="saltelli", points=8), factors, 5)
        ]
    )
    a, b, *mixed = found.reshape(5, 8, 3)
    assert not np.isin(a, b).any()
    for n, block in enumerate(mixed):
        columns = np.arange(3) == n
        assert (block[:, columns] == b[:, columns]).all()
        assert (block[:, ~columns] == a[:, ~columns]).all()


@pytest.mark.parametrize("kind", ["lhs", "sobol", "saltelli"])
def test_a_drawn_design_depends_on_its_seed_alone(kind):
    design = Design(kind=kind, points=8)
    assert points(design, THREE, 1) == points(design, THREE, 1)
    assert points(design, THREE, 1) != points(design, THREE, 2)


@pytest.mark.parametrize(
    ("design", "factors", "complaint"),
    [
        (Design(kind="sobol", points=12), THREE, "12 for sobol; allowed: a power of two"),
        (Design(kind="lhs"), THREE, "None for lhs; allowed: a number"),
        (Design(kind="factorial", points=4), THREE, "4 for factorial; allowed: none"),
        (
            Design(kind="factorial"),
            {"n": READ({"key": "x", "distribution": "normal", "mean": 0, "sigma": 1})},
            "factors.n: a distribution has no levels",
        ),
    ],
)
def test_incompatible_factors_and_design_are_refused(design, factors, complaint):
    with pytest.raises(InputError, match=complaint):
        points(design, factors, 1)
