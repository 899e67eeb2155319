"""Lit time of LEDs against fine sampling and closed forms."""

from __future__ import annotations

from itertools import pairwise

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from skysim.sources.dome.led import lit_moments_s

COUNT = 400_000


def counted(
    begin: float, end: float, period: float, start: float, on: float
) -> tuple[float, float, float]:
    """The same by sampling 400,000 instants."""
    t = begin + (end - begin) * (np.arange(COUNT) + 0.5) / COUNT
    lit = t[(t - start) % period < on]
    return len(lit) / COUNT * (end - begin), float(lit.mean()), float(lit.std())


@pytest.mark.parametrize("seed", range(40))
def test_light_mean_time_and_spread_match_a_direct_count(seed: int) -> None:
    rng = np.random.default_rng(seed)
    period = rng.uniform(0.2, 3.0)
    begin = rng.uniform(-5, 5)
    length = period * 10 ** rng.uniform(-0.2, 1.3)
    pulses = (period, rng.uniform(-5, 5), period * rng.uniform(0.3, 0.95))
    ours = lit_moments_s(begin, begin + length, *pulses)
    step = length / COUNT
    # Every edge of a pulse is found to a step; each shifts the mean by at most the length times its share.
    edges = 2 * (length / period + 2)
    lit, mean, spread = counted(begin, begin + length, *pulses)
    assert ours[0] == pytest.approx(lit, abs=edges * step)
    assert ours[1] == pytest.approx(mean, abs=edges * step * length / lit)
    assert ours[2] == pytest.approx(spread, abs=2 * edges * step * length / lit)


def test_steady_light_has_the_moments_of_a_uniform_line() -> None:
    for on in (1.0, 2.0):
        assert lit_moments_s(2.0, 5.0, 1.0, 0.3, on) == pytest.approx(
            (3.0, 3.5, 3 / np.sqrt(12)), abs=1e-15
        )


def test_a_single_pulse_has_its_own_moments_and_darkness_has_none() -> None:
    assert lit_moments_s(0.0, 10.0, 100.0, 4.0, 2.0) == pytest.approx(
        (2.0, 5.0, 2 / np.sqrt(12)), abs=1e-14
    )
    assert lit_moments_s(6.5, 99.0, 100.0, 4.0, 2.0)[0] == 0.0


def test_parts_of_an_interval_add_up() -> None:
    pulses = (0.7, 0.11, 0.2)
    edges = np.sort(np.random.default_rng(3).uniform(0, 30, 50))
    parts = sum(lit_moments_s(a, b, *pulses)[0] for a, b in pairwise(edges))
    assert parts == pytest.approx(lit_moments_s(edges[0], edges[-1], *pulses)[0], rel=1e-12)


def test_a_million_pulses_are_summed_in_closed_form_without_loss() -> None:
    lit, mean, spread = lit_moments_s(0.0, 1000.0, 1e-3, 0.0, 2.5e-4)
    assert lit == pytest.approx(250.0, rel=1e-9)
    assert mean == pytest.approx(500 - 3.75e-4, abs=1e-7)
    assert spread == pytest.approx(1000 / np.sqrt(12), rel=1e-9)


def lit_s(*interval_and_pulses: float) -> float:
    """The lit time alone."""
    return float(lit_moments_s(*interval_and_pulses)[0])


def sampled_lit_s(begin: float, end: float, period: float, start: float, on: float) -> float:
    """Lit time by sampling the pulse train at the centers of 20,000 equal intervals."""
    slices = 20_000
    t = begin + (end - begin) * (np.arange(slices) + 0.5) / slices
    return float(np.mean(np.mod(t - start, period) < on) * (end - begin))


span = st.floats(0, 5)


@settings(max_examples=200, derandomize=True, deadline=None)
@given(span, span, st.floats(0.2, 3), st.floats(-2, 2), st.floats(0, 1))
def test_lit_time_matches_brute_force_sampling(
    begin: float, length: float, period: float, start: float, duty: float
) -> None:
    exact = float(lit_s(begin, begin + length, period, start, duty * period))
    # Each of the at most 2 (length / period + 2) edges falls within a slice, which is counted or not.
    edges = 2 * (length / period + 2)
    sampled = sampled_lit_s(begin, begin + length, period, start, duty * period)
    assert exact == pytest.approx(sampled, abs=edges * length / 20_000 + 1e-12)


@settings(max_examples=100, derandomize=True, deadline=None)
@given(st.floats(0, 1000), st.integers(1, 40), st.floats(0, 1e-3), st.floats(0.01, 1))
def test_whole_periods_are_lit_for_exactly_their_duty(
    begin: float, periods: int, start: float, duty: float
) -> None:
    on = duty * 1e-3
    lit = float(lit_s(begin, begin + periods * 1e-3, 1e-3, start, on))
    assert lit == pytest.approx(periods * on, abs=1e-12)  # t of 1000 s is held to 1e-13 s


@pytest.mark.slow
@settings(max_examples=100, derandomize=True, deadline=None)
@given(span, span, span, st.floats(0.1, 2), st.floats(0, 1))
def test_lit_time_of_two_intervals_adds(
    a: float, b: float, c: float, start: float, duty: float
) -> None:
    first, middle, last = sorted((a, b, c))
    whole = lit_s(first, last, 0.7, start, duty * 0.7)
    parts = lit_s(first, middle, 0.7, start, duty * 0.7) + lit_s(
        middle, last, 0.7, start, duty * 0.7
    )
    assert float(whole) == pytest.approx(float(parts), abs=1e-13)
