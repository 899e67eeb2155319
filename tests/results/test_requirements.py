"""Requirements: tolerance limits against tables and by simulation, and each judgment from the counts that give it."""

from __future__ import annotations

import math
import sys
from pathlib import Path

import numpy as np
import pytest
from scipy import stats

from skysim import load_scene
from skysim.apps.cli import main
from skysim.core.errors import InputError
from skysim.results import metrics
from skysim.results.metrics import Summary
from skysim.results.requirements import MET, NOT_MET, NOT_SHOWN, judge, of_run, requirement
from skysim.simulation.checks.facts import REQUIREMENTS, Fact


@pytest.mark.parametrize(
    ("count", "rank"), [(59, 1), (93, 2), (124, 3), (153, 4), (181, 5), (208, 6)]
)
def test_a_95_95_tolerance_limit_is_the_order_statistic_of_the_tables(
    count: int, rank: int
) -> None:
    """Wilks's sample sizes at 95/95 (IAEA SRS-23, NUREG/CR): the largest of 59, the second largest of 93, ..."""
    values = np.random.default_rng(1).permutation(count) + 1.0
    limit = metrics.STATISTICS["tol95"](values)
    assert limit.value == count + 1 - rank
    fewer = metrics.STATISTICS["tol95"](values[:58])
    assert math.isnan(fewer.value)
    assert fewer.needs == 1


def test_tolerance_limits_and_quantile_limits_hold_as_often_as_they_say() -> None:
    """Of 1,000 samples of an exponential: the limit is above the quantile in at least 95 %, and hardly more."""
    samples = np.random.default_rng(3).exponential(size=(1000, 124))
    truth = -math.log(0.05)
    above = np.mean([metrics.tolerance_limit(one, 0.95).value >= truth for one in samples])
    exact = stats.binom.cdf(121, 124, 0.95)
    assert exact >= 0.95
    assert above == pytest.approx(exact, abs=4 * math.sqrt(0.05 * 0.95 / 1000))
    inside = [metrics.quantile(one, 0.95) for one in samples]
    held = np.mean([one.low <= truth <= one.high for one in inside])
    assert held > 0.95 - 4 * math.sqrt(0.05 * 0.95 / 1000)


def trials(cross: list[float], solved: int = 1, wrong: int = 0) -> dict[str, np.ndarray]:
    """Columns of trials with these errors, one frame each, and one that failed."""
    count = len(cross)
    return {
        "frames": np.array([1] * count + [0]),
        "solved": np.array([solved] * count + [0]),
        "wrong": np.array([wrong] * count + [0]),
        "x_arcsec": np.array([*cross, np.nan]),
        "y_arcsec": np.zeros(count + 1),
        "roll_arcsec": np.array([100.0] * count + [np.nan]),
    }


def test_right_within_counts_right_trials_with_all_errors_up_to_their_limits() -> None:
    within = metrics.response("right_within_cross_arcsec_10")
    assert within(trials([9.0, 10.0, 11.0])) == metrics.proportion(2, 3)
    assert within(trials([9.0, 10.0], wrong=1)).value == 0
    assert within(trials([np.nan, 1.0])).value == 0.5
    both = metrics.response("right_within_cross_arcsec_10_roll_arcsec_99.5")
    assert both(trials([1.0])).value == 0
    assert metrics.response("cross_arcsec_over_10")(trials([9.0, 10.0, 11.0])).value == 1 / 3
    assert metrics.is_proportion("right_within_cross_arcsec_10")
    assert metrics.is_proportion("cross_arcsec_over_10")


def test_a_quantile_may_have_any_digits() -> None:
    values = np.arange(10_001.0)
    columns = {"nees": values}
    assert metrics.response("nees_p997")(columns).value == pytest.approx(9970)
    assert metrics.response("nees_p05")(columns).value == pytest.approx(500)
    with pytest.raises(InputError, match="unknown response"):
        metrics.response("nees_p00")


@pytest.mark.parametrize(
    ("name", "limit", "value", "count", "answer", "needs"),
    [
        # ln 0.05 / ln(1 - p) draws without a miss.
        ("wrong", 0.001, 0.0, 2995, MET, 0),
        ("wrong", 0.001, 0.0, 2994, NOT_SHOWN, 2995),
        ("wrong", 0.001, 0.1, 100, NOT_MET, 0),
        ("cross_arcsec_p95", 60.0, 0.0, 59, MET, 0),
        ("cross_arcsec_p95", 60.0, 0.0, 58, NOT_SHOWN, 59),
        ("cross_arcsec_p95", 60.0, 0.2, 100, NOT_MET, 0),
        ("identified", 0.99, 1.0, 299, MET, 0),
        ("identified", 0.99, 1.0, 298, NOT_SHOWN, 299),
        ("identified", 0.99, 0.9, 298, NOT_MET, 0),
        ("right_within_cross_arcsec_10", 0.9, 1.0, 29, MET, 0),
        ("roll_arcsec_median", 5.0, 0.0, 5, MET, 0),
        ("wrong", 0.001, math.nan, 0, NOT_SHOWN, 2995),
    ],
)
def test_a_requirement_is_judged_by_the_exact_bounds(
    name: str, limit: float, value: float, count: int, answer: str, needs: int
) -> None:
    found = judge(requirement(name, limit), Summary(value, math.nan, math.nan, count))
    assert (found.answer, found.needs) == (answer, needs)
    assert answer in found.text()


@pytest.mark.parametrize(("share", "name"), [(0.05, "cross_arcsec_p95"), (0.3, "wrong")])
def test_no_judgment_is_wrong_more_often_than_5_percent(share: float, name: str) -> None:
    """At the limit itself, where both claims are easiest to make wrongly: by the binomial probabilities."""
    one = requirement(name, 60.0 if name.startswith("cross") else share)
    for count in (60, 200):
        answers = [
            judge(one, Summary(k / count, math.nan, math.nan, count)).answer
            for k in range(count + 1)
        ]
        mass = stats.binom.pmf(np.arange(count + 1), count, share)
        for claim in (MET, NOT_MET):
            assert 0 < mass[[answer == claim for answer in answers]].sum() <= 0.05 + 1e-9


def test_points_that_are_judged_together_are_seldom_not_met() -> None:
    found = Summary(0.11, math.nan, math.nan, 100)
    one = requirement("cross_arcsec_p95", 60)
    assert judge(one, found).answer == NOT_MET
    assert judge(one, found, points=20).answer == NOT_SHOWN


@pytest.mark.parametrize(
    ("name", "limit", "match"),
    [
        ("cross_arcsec_worst", 60, "nothing that a number of trials shows"),
        ("cross_arcsec_rms", 60, "nothing that a number of trials shows"),
        ("cross_arcsec_p00", 60, "nothing that a number of trials shows"),
        ("stars_p95", 5, "nothing that a number of trials shows"),
        ("mismatched", 0.1, "nothing that a number of trials shows"),
        ("identified", 1.0, "share between 0 and 1"),
    ],
)
def test_what_trials_cannot_show_is_refused(name: str, limit: float, match: str) -> None:
    with pytest.raises(InputError, match=match) as refused:
        load_scene("shefex2", {f"require.{name}": limit})
    assert str(refused.value).startswith(f"require.{name}: ")


@pytest.mark.slow
@pytest.mark.parametrize(("limit", "code"), [(1e-6, 1), (1e6, 0)])
def test_a_run_ends_with_code_1_if_a_requirement_is_not_met(
    tmp_path: Path,
    limit: float,
    code: int,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:
    """One frame of one beyond a quantile of 99 %: that has a probability of 1 %, below 5 %."""
    require = f"require={{cross_arcsec_p99: {limit}, wrong: 0.001}}"
    words = ["run", "shefex2", "--frames", "1", "--out", tmp_path, "--set", require]
    monkeypatch.setattr(sys, "argv", ["skysim", *map(str, words)])
    with pytest.raises(SystemExit) as ended:
        main.main()
    assert ended.value.code == code
    printed = capsys.readouterr().out
    assert "not shown yet, needs 2,995 draws" in printed
    answer = "not met" if code else "not shown yet, needs 299 draws"
    assert f"cross_arcsec_p99 ≤ {limit:g}: {answer}" in printed
    assert f"cross_arcsec_p99 ≤ {limit:g}: {answer}" in (tmp_path / "report.html").read_text()


class Row:
    """A frame of a run."""

    status = "solved"
    wrong = False
    cross_arcsec = 5.0
    roll_arcsec = -50.0


@pytest.mark.parametrize(("drawn_once", "draws"), [(0.0, 60.0), (1.0, 1.0), (0.5, 60 / 30.5)])
def test_frames_of_a_run_count_by_the_share_of_the_errors_that_it_draws_once(
    drawn_once: float, draws: float
) -> None:
    """The design effect of Kish: the variance of the mean of n equally correlated values is (1 + (n - 1) r) / n."""
    n = 60
    covariance = np.full((n, n), drawn_once) + (1 - drawn_once) * np.eye(n)
    assert 1 / covariance.mean() == pytest.approx(draws)
    fact = Fact(REQUIREMENTS, [], {"drawn_once": drawn_once})
    (found,) = of_run({"cross_arcsec_p95": 60.0}, [Row()] * n, [fact])
    assert found.draws == pytest.approx(draws)
    assert found.answer == (MET if drawn_once == 0 else NOT_SHOWN)
    (other,) = of_run({"coverage_4": 0.9}, [Row()] * n, [fact])
    assert (other.draws, other.answer) == (0, NOT_SHOWN)
    assert "measured by a study" in other.text()
    (unknown,) = of_run({"roll_arcsec_p95": 40.0}, [Row()] * n, [])
    assert (unknown.draws, unknown.misses) == (1.0, 1.0)
