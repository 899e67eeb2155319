"""The page of the papers' claims: its bounds follow from the numbers of runs."""

from __future__ import annotations

import math

import pytest
import scipy.optimize
import scipy.stats

from skysim.core.paths import ROOT

PAGE = (ROOT / "docs/findings/datasheets/papers.md").read_text(encoding="utf-8")


def row(begin: str) -> str:
    """The only row of the table that starts with this text."""
    (found,) = [line for line in PAGE.splitlines() if line.startswith(f"| {begin}")]
    return found


def lowest(failures: int, runs: int) -> float:
    """Success probability at which this few failures have a binomial probability of 5 %."""
    return float(
        scipy.optimize.brentq(
            lambda p: scipy.stats.binom.cdf(failures, runs, 1 - p) - 0.05, 0.01, 1 - 1e-9
        )
    )


@pytest.mark.parametrize(
    ("begin", "failures", "runs", "text"),
    [
        ("PTASE, table 1 | 99.12", 44, 5000, "**98.87 %**"),
        ("PTASE, real sky | 18", 0, 18, "**84.7 %**"),
        ("SHEFEX-2, figure 10", 0, 1000, "99.701"),
        ("SHEFEX-2, conclusion", 30, 1000, "**95.95 %**"),
        ("SHEFEX-2, night sky", 100, 1000, "88.3 %"),
        ("AFIT, conclusion | below 1", 0, 5, "**54.9 %**"),
    ],
)
def test_bounds_of_success_in_papers_follow_from_their_trials(begin, failures, runs, text):
    assert text in row(begin)
    digits = len(text.strip("*% ").split(".")[1])
    assert float(text.strip("*% ")) == pytest.approx(
        100 * lowest(failures, runs), abs=0.5 * 10**-digits
    )


def test_no_false_attitude_in_ten_thousand_bounds_its_probability():
    assert "(3.0e-4)" in row("PTASE, text")
    assert 1 - lowest(0, 10_000) == pytest.approx(3.0e-4, abs=0.05e-4)


def test_the_number_of_runs_for_97_percent_matches_the_papers():
    assert "99 runs without" in row("SHEFEX-2, conclusion")
    assert lowest(0, 99) >= 0.97 > lowest(0, 98)
    needed = next(n for n in range(1000, 3000) if scipy.stats.binom.cdf(30, n, 0.03) <= 0.05)
    assert f"{needed:,} with 30" in row("SHEFEX-2, conclusion")


def test_means_of_gaussian_errors_in_papers_follow_from_their_sigma():
    """The mean length of two Gaussian axes is sigma sqrt(pi / 2), the mean size of one is sigma sqrt(2 / pi)."""
    axis = 0.962 / math.sqrt(math.pi / 2)
    roll = 4.69 / math.sqrt(2 / math.pi)
    assert f"{axis:.2f}″ an axis" in row("PTASE, table 1 | mean error of the optical")
    assert f"{scipy.stats.rayleigh.ppf(0.997, scale=axis):.1f}″ in 99.7 %" in row(
        "PTASE, table 1 | mean error of"
    )
    assert f"{roll:.1f}″, 1 σ; {scipy.stats.halfnorm.ppf(0.997, scale=roll):.1f}″" in row(
        "PTASE, table 1 | mean error in"
    )


def test_a_mapping_error_converts_to_an_angle():
    assert f"{math.degrees(2e-3 / (33 * 0.0254)):.2f}°" in row("AFIT, calibration")
