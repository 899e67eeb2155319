"""Variance components: terms of known size are recovered, and their sum is the total."""

from __future__ import annotations

import itertools
from types import SimpleNamespace

import numpy as np
import pytest
from scipy import stats

from skysim.experiments.datasheet.datasheet_report import failed_checks
from skysim.experiments.datasheet.variance_components import (
    Components,
    bounded,
    contributions,
    mean_square_ratio,
    term_table,
)


def components(errors):
    """The terms: the means of the fields' contributions."""
    return Components(*(float(np.mean(one)) for one in contributions(errors)))


def total(errors):
    """Sum of the terms."""
    return sum(components(errors))


def generated(rng, shape, bias=0.0, **sigma):
    """Errors with terms of known size: each is drawn for the levels that its name lists, f, u, s, p, t."""
    errors = np.full(shape, bias)
    for name, size in sigma.items():
        levels = [shape[axis] if letter in name else 1 for axis, letter in enumerate("fuspt")]
        errors = errors + size * rng.standard_normal(levels)
    return errors


@pytest.mark.slow
def test_injected_terms_are_recovered_to_five_percent():
    """Over many experiments, whose mean is the expectation: of the thermal states those that are there."""
    rng = np.random.default_rng(1)
    sizes = {
        "u": 0.5,
        "f": 2.0,
        "fu": 1.0,
        "fs": 0.6,
        "us": 0.3,
        "fp": 1.1,
        "fusp": 0.7,
        "fuspt": 3.0,
    }
    states = np.array([1.0, -1.0, 0.5, -0.5])[:, None, None]
    found = np.mean(
        [
            components(states + generated(rng, (60, 6, 4, 2, 2), 1.5, **sizes))
            for _ in range(900)
        ],
        axis=0,
    )
    # Of effects that are drawn for each of four states a quarter is common to the four.
    thermal = np.mean(states**2) + (0.6**2 + 0.3**2) * 3 / 4
    expected = Components(
        1.5**2 + 0.5**2 + 0.3**2 / 4,
        thermal,
        2.0**2 + 1.0**2 + 0.6**2 / 4,
        1.1**2 + 0.7**2,
        3.0**2,
    )
    assert found == pytest.approx(np.array(expected), rel=0.05)


@pytest.mark.parametrize("effects", [[0.0, 3.0, -3.0], [0.0, 20.0, 70.0], [5.0]])
def test_thermal_states_are_all_that_there_are(effects):
    """Their variance is the mean square about their mean, and the bias is this mean: neither is an estimate."""
    shape = (12, 2, len(effects), 2, 2)
    found = components(np.broadcast_to(np.array(effects)[:, None, None], shape))
    assert found.thermal == pytest.approx(np.var(effects), abs=1e-9)
    assert found.bias == pytest.approx(np.mean(effects) ** 2, abs=1e-9)


def test_what_the_states_share_is_not_taken_from_them():
    """The attitudes of a field are the same in all states, so their effects do not differ among the states."""
    found = components(generated(np.random.default_rng(10), (200, 2, 3, 2, 2), fp=5.0))
    assert found.pixel == pytest.approx(25, rel=0.3)
    assert found.thermal == pytest.approx(0, abs=1e-9)


def test_the_sum_of_the_terms_is_the_mean_square_of_every_field():
    errors = generated(
        np.random.default_rng(8), (11, 3, 4, 2, 3), 2.0, f=1.0, us=2.0, fuspt=1.0
    )
    shares = sum(contributions(errors))
    assert shares.mean() == pytest.approx(np.mean(errors**2), rel=1e-12)


@pytest.mark.parametrize("name", ["bias", *Components._fields[2:]])
def test_a_single_injected_term_is_recovered_alone(name):
    """One large experiment per term: recovered to 5 %, with no leakage into the others."""
    rng = np.random.default_rng(2)
    shape = (2000, 2, 1, 4, 2)
    drawn = {
        "bias": {},
        "field": {"f": 2.0},
        "pixel": {"fusp": 2.0},
        "temporal": {"fuspt": 2.0},
    }
    found = components(generated(rng, shape, 2.0 if name == "bias" else 0.0, **drawn[name]))
    assert getattr(found, name) == pytest.approx(4.0, rel=0.05)
    others = [value for one, value in found._asdict().items() if one != name]
    assert others == pytest.approx([0.0] * 4, abs=0.12)


def test_the_sum_is_the_mean_square_without_bias():
    """E[e^2] exactly: the mean square of independent draws is the same within its error."""
    rng = np.random.default_rng(3)
    sizes = {"u": 0.4, "f": 1.0, "fu": 0.5, "s": 0.3, "fusp": 0.7, "fuspt": 1.2}
    sums = [total(generated(rng, (40, 3, 2, 2, 2), 0.6, **sizes)) for _ in range(400)]
    expected = 0.6**2 + sum(size**2 for size in sizes.values())
    assert np.mean(sums) == pytest.approx(expected, abs=4 * np.std(sums) / 20)
    assert np.std(sums) / 20 < 0.02 * expected


@pytest.mark.parametrize(("units", "states"), list(itertools.product((1, 3), (1, 2))))
def test_a_factor_with_one_level_is_left_out(units, states):
    rng = np.random.default_rng(4)
    found = components(generated(rng, (3000, units, states, 2, 2), f=1.0, fuspt=1.0))
    assert found.field == pytest.approx(1.0, rel=0.08)
    assert found.temporal == pytest.approx(1.0, rel=0.05)
    assert (found.thermal == 0) == (states == 1)


@pytest.mark.slow
@pytest.mark.parametrize("fields", [16, 60])
def test_intervals_cover_the_truth_as_often_as_stated(fields):
    """Also with few fields, of which some err much more than others; a term that is not there is hardly ever seen."""
    rng = np.random.default_rng(5)
    held = []
    seen = []
    for _ in range(200):
        scale = np.exp(0.3 * rng.standard_normal((fields, 1, 1, 1, 1)))
        errors = scale * generated(rng, (fields, 2, 1, 2, 2), f=1.0, fuspt=1.5)
        square = np.exp(2 * 0.3**2)
        shares = contributions(errors)
        for name, truth in (("field", square), ("pixel", 0.0), ("temporal", 2.25 * square)):
            found = bounded(getattr(shares, name))
            held.append(found.low <= truth <= found.high)
        seen.append(term_table(errors[None], np.ones((1, fields, 1))).signs["pixel"])
    assert (np.mean(np.reshape(held, (-1, 3)), axis=0) > 0.88).all()
    assert np.mean(seen) < 0.02


def test_too_few_fields_have_no_interval():
    assert np.isnan(bounded(np.arange(9.0))[1:]).all()
    assert np.isfinite(bounded(np.arange(10.0))).all()
    assert bounded(np.ones(10)) == (1, 1, 1)


@pytest.mark.parametrize("verdicts", [1, 2, 10])
def test_an_interval_of_normal_shares_is_student_s_of_both_sides(verdicts: int) -> None:
    """2.5 % beyond each end for one verdict; that of ten at once (Bonferroni) leaves 0.25 %."""
    shares = np.random.default_rng(11).standard_normal(300)
    found = bounded(shares, verdicts)
    half = stats.t.ppf(1 - 0.05 / 2 / verdicts, 299) * shares.std(ddof=1) / np.sqrt(300)
    assert (found.high - found.low) / 2 == pytest.approx(half, rel=0.08)


def test_a_ratio_is_precise_if_both_terms_share_their_fields():
    rng = np.random.default_rng(6)
    squares = rng.lognormal(0, 1, 200)
    assert mean_square_ratio(0.5 * squares, squares) == pytest.approx(
        (0.5, 0.5, 0.5), rel=1e-12
    )
    apart = mean_square_ratio(0.5 * rng.lognormal(0, 1, 200), squares)
    assert apart.low < 0.5 < apart.high
    missing = np.where(np.arange(200) < 7, np.nan, squares)
    assert mean_square_ratio(missing, squares) == pytest.approx((1, 1, 1), rel=1e-12)


def experiment(rng, fields):
    """Errors of the design, and independent frames with new units, attitudes and noise in the same fields."""
    field = 2 * rng.standard_normal((1, fields, 1))
    errors = field[..., None, None, None] + generated(
        rng, (fields, 3, 1, 3, 2), fu=0.5, fusp=0.8, fuspt=1.5
    )
    return errors, field + np.hypot(np.hypot(0.5, 0.8), 1.5) * rng.standard_normal(
        (1, fields, 20)
    )


def test_terms_sum_to_the_error_of_independent_frames():
    """Within 3 %: the mean of 40 experiments, and the interval of one."""
    rng = np.random.default_rng(7)
    ratios = [
        total(errors) / np.mean(at_once**2)
        for errors, at_once in (experiment(rng, 400) for _ in range(40))
    ]
    assert np.mean(ratios) == pytest.approx(1, abs=0.01)
    assert np.std(ratios) < 0.03
    errors, at_once = experiment(rng, 400)
    found = term_table(errors, at_once).ratio
    assert found.low < 1 < found.high
    # Both groups of axes together at 95 %: 2.24 sigma each.
    assert (found.high - found.low) / 2 / 2.24 == pytest.approx(np.std(ratios), rel=0.3)
    at_once[0, :5] = np.nan
    assert term_table(errors, 1.2 * at_once).ratio.high < 1


def test_a_sheet_whose_terms_do_not_add_up_says_so_first():
    """Frames a fifth worse than the terms contradict them; the same frames do not."""
    errors, at_once = experiment(np.random.default_rng(9), 400)
    for factor, failed in ((1.0, 0), (1.2, 1)):
        terms = {"across": term_table(errors, factor * at_once)}
        found = failed_checks(SimpleNamespace(refusal=None, terms=terms))
        assert len(found) == failed
        assert all("do not add up" in line for line in found)
