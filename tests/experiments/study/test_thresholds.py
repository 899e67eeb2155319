"""Where a proportion crosses a limit: against known curves, and coverage of the interval."""

from __future__ import annotations

import math
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import yaml
from scipy import stats

from skysim.core.errors import InputError
from skysim.experiments.datasheet import performance
from skysim.experiments.study import study_file, thresholds
from skysim.experiments.study.plan import Study, Threshold
from skysim.experiments.study.table import PointRow, PointTable
from skysim.experiments.study.thresholds import Crossing, crossing
from skysim.results import metrics

LEVELS = np.array([0.0, 1, 2, 3, 4, 6, 8, 10])
STUDY: dict[str, Any] = {
    "schema": 1,
    "title": "How fast?",
    "scene": "shefex2",
    "seed": 1,
    "trial": {"kind": "frames"},
    "factors": {
        "rate": {"key": "trial.rate_deg_s", "values": [0, 1, 2, 3, 4, 6, 8, 10]},
        "chain": {"levels": {"slow": {}, "fast": {"trial.gyro": True}}},
    },
    "responses": ["identified", "nees"],
    "thresholds": [{"response": "identified", "limit": 0.95, "along": "rate", "by": "chain"}],
}


def logistic(x: np.ndarray, middle: float, width: float) -> np.ndarray:
    """A falling curve; it is 0.95 at middle - width ln 19."""
    return 1 / (1 + np.exp((x - middle) / width))


def counted(
    hits: list[int], trials: int = 400, limit: float = 0.95, log: bool = False
) -> Crossing:
    return crossing(
        LEVELS[: len(hits)] + log,
        np.array(hits, float),
        np.full(len(hits), float(trials)),
        limit,
        log,
    )


def test_the_threshold_between_two_levels_is_interpolated_linearly() -> None:
    """From 1 at 4 to 0.8 at 6: 0.95 at 4.5; rising, the same mirrored; in the logarithm, 5 (7 / 5)^(1 / 4)."""
    falling = counted([400, 400, 400, 400, 400, 320, 200, 100])
    assert falling.value == pytest.approx(4.5)
    assert (falling.low, falling.high, falling.rising) == (4, 6, False)
    hits = np.array([100, 200, 320, 400, 400], float)
    rising = crossing(np.array([1.0, 2, 4, 6, 8]), hits, np.full(5, 400.0), 0.95)
    assert rising.value == pytest.approx(4 + 2 * 0.75)
    assert (rising.low, rising.high, rising.rising) == (4, 6, True)
    assert counted([400, 400, 400, 400, 400, 320, 200, 100], log=True).value == pytest.approx(
        5 * (7 / 5) ** 0.25
    )


def test_a_threshold_beyond_the_levels_has_no_number() -> None:
    above = counted([400] * 8)
    below = counted([320, 300, 200, 100, 50, 20, 10, 0])
    assert (above.value, above.low, above.high) == (math.inf, 10, math.inf)
    assert (below.value, below.low, below.high) == (-math.inf, -math.inf, 0)


def test_uncertain_levels_leave_the_interval_open_and_name_the_trials_needed() -> None:
    """All of 50: the exact lower bound is 0.05^(1/50) = 0.942; 59 trials would be enough."""
    found = counted([50, 50, 50, 50, 32, 10, 5, 2], trials=50)
    assert metrics.exact_bounds(50, 50)[0] == pytest.approx(0.05 ** (1 / 50))
    assert (found.low, found.high, found.needs) == (-math.inf, 4, ((0, 59),))
    assert counted([59, 59, 59, 59, 32, 12, 5, 2], trials=59).low == 3


def test_a_curve_that_falls_and_rises_has_no_threshold() -> None:
    found = counted([400, 200, 400, 200, 400, 200, 400, 200])
    assert math.isnan(found.value)
    assert (found.low, found.high) == (-math.inf, math.inf)


def test_noise_on_a_monotonic_curve_is_not_called_misfit() -> None:
    """Of 500 falling curves drawn with 100 trials a level, at most one in a hundred is called not monotonic."""
    rng = np.random.default_rng(4)
    truth = logistic(LEVELS, 5.0, 1.0)
    draws = rng.binomial(100, truth, size=(500, 8)).astype(float)
    missed = sum(
        math.isnan(crossing(LEVELS, hits, np.full(8, 100.0), 0.95).value) for hits in draws
    )
    assert missed <= 5


@pytest.mark.parametrize(("middle", "width"), [(6.0, 0.6), (7.0, 1.2), (9.0, 0.2)])
def test_each_end_is_right_as_often_as_stated(middle: float, width: float) -> None:
    """Logistic curves cross 0.95 at middle - width ln 19. Of 600 draws each, at least 95 % to four standard errors."""
    rng = np.random.default_rng(7)
    truth = middle - width * math.log(19)
    draws = rng.binomial(100, logistic(LEVELS, middle, width), size=(600, 8)).astype(float)
    found = [crossing(LEVELS, hits, np.full(8, 100.0), 0.95) for hits in draws]
    for right in ([one.low <= truth for one in found], [truth <= one.high for one in found]):
        assert np.mean(right) >= 0.95 - 4 * math.sqrt(0.95 * 0.05 / 600)


def test_an_end_keeps_its_confidence_for_a_level_just_below_the_limit() -> None:
    """The hardest case, a level at 0.949: it is called certainly above in at most 5 % of 2,000 draws."""
    rng = np.random.default_rng(8)
    truth = np.array([1.0, 1.0, 0.949, 0.5, 0.1, 0, 0, 0])
    draws = rng.binomial(300, truth, size=(2000, 8)).astype(float)
    above = [
        thresholds.certain_levels(LEVELS, hits, np.full(8, 300.0), 0.95)[0] for hits in draws
    ]
    wrong = np.mean([level is not None and level >= 2 for level in above])
    assert 0 < wrong <= 0.05 + 4 * math.sqrt(0.05 * 0.95 / 2000)


def test_the_estimate_approaches_the_truth() -> None:
    """With 10^5 trials and levels each tenth: to a third of a step."""
    x = np.arange(0, 10, 0.1)
    hits = np.random.default_rng(9).binomial(100_000, logistic(x, 6.0, 0.8)).astype(float)
    assert crossing(x, hits, np.full(len(x), 1e5), 0.95).value == pytest.approx(
        6 - 0.8 * math.log(19), abs=0.03
    )


def test_the_isotonic_fit_pools_neighbors_that_violate_the_order() -> None:
    """By hand: 0.9 of 10 trials after 0.8 of 30 is pooled to 33 of 40."""
    fit = thresholds.isotonic(
        np.array([1.0, 0.8, 0.9, 0.1]), np.array([10.0, 30, 10, 10]), rising=False
    )
    assert fit == pytest.approx([1, 33 / 40, 33 / 40, 0.1])


# In a study.


def lines_of(study: Study, shares: dict[str, list[float]], trials: int) -> PointTable:
    rows = [
        PointRow(
            n,
            {"rate": rate, "chain": chain},
            {"identified": metrics.proportion(round(p * trials), trials)},
        )
        for chain, curve in shares.items()
        for n, (rate, p) in enumerate(zip(LEVELS.astype(int).tolist(), curve, strict=True))
    ]
    return PointTable(study, rows)


def test_a_study_states_the_rate_at_which_95_percent_are_identified() -> None:
    study = Study.model_validate(STUDY)
    curves = {"slow": [1, 1, 1, 0.9, 0.5, 0.1, 0, 0], "fast": [1.0] * 8}
    said = thresholds.sentences(study.thresholds[0], lines_of(study, curves, 400))
    assert said == [
        "chain = slow: identified falls below 95 % at rate = 2.5 deg/s (each end at 95 %: 2 to 3).",
        "chain = fast: identified is at least 95 % at all levels of rate, 0 to 10 deg/s (95 %: above 10).",
    ]
    few = thresholds.sentences(study.thresholds[0], lines_of(study, curves, 50))
    assert few[0].endswith("(95 %: below 4; needs about 59 trials at rate = 0 deg/s).")


def test_a_level_of_the_sentence_has_its_unit() -> None:
    factors = STUDY["factors"] | {
        "chain": {"key": "exposure.time", "values": ["0.5 ms", "5 ms"]}
    }
    study = Study.model_validate(STUDY | {"factors": factors})
    said = thresholds.sentences(
        study.thresholds[0], lines_of(study, {"0.5 ms": [1.0] * 8, "5 ms": [1.0] * 8}, 60)
    )
    assert [one.partition(":")[0] for one in said] == ["chain = 0.5 ms", "chain = 5 ms"]


def test_a_threshold_needs_trials_at_two_levels() -> None:
    """A point without trials is left out; two levels are the least."""
    study = Study.model_validate(STUDY)
    line = PointRow(
        0, {"rate": 0, "chain": "slow"}, {"identified": metrics.proportion(9, 10)}
    )
    other = line._replace(
        levels={"rate": 1, "chain": "slow"}, responses={"identified": metrics.NO_VALUE}
    )
    assert thresholds.sentences(study.thresholds[0], PointTable(study, [line, other])) == [
        "chain = slow: identified has no trials at two levels of rate yet."
    ]


@pytest.mark.parametrize(
    ("change", "complaint"),
    [
        (
            {"response": "nees"},
            r"thresholds.0.response: nees is no proportion; allowed: identified.*\(.*line 2\d\)",
        ),
        (
            {"along": "chain", "by": None},
            "thresholds.0.along: chain has no two numeric levels",
        ),
        (
            {"along": "speed"},
            "thresholds.0.along: unknown factor 'speed'; allowed: rate, chain",
        ),
        ({"limit": 1.5}, "thresholds.0.limit: 1.5 is not allowed"),
        ({"where": {"rate": 99}}, "thresholds.0.where.rate: unknown level 99; allowed: 0, 1"),
    ],
)
def test_an_impossible_threshold_is_refused(
    tmp_path: Path, change: dict[str, Any], complaint: str
) -> None:
    tree = STUDY | {"thresholds": [STUDY["thresholds"][0] | change]}
    path = tmp_path / "study.yaml"
    path.write_text(yaml.safe_dump(tree, sort_keys=False))
    with pytest.raises(InputError, match=complaint):
        study_file.load(path)


@pytest.mark.parametrize(
    ("share", "limit", "needed"),
    [(1.0, 0.9, 29), (1.0, 0.95, 59), (1.0, 0.99, 299), (0.98, 0.95, 0)],
)
def test_an_end_needs_as_many_trials_as_the_same_claim_of_a_datasheet(
    share: float, limit: float, needed: int
) -> None:
    """ceil(ln 0.05 / ln limit): 29 at 90 %, 59 at 95 %, 299 at 99 %; of 98 % the fewest n by the binomial tail."""
    found = metrics.trials_needed(1 - limit, share=1 - share)
    if needed:
        (claim,) = [
            one
            for one in performance.claims(performance.Counts(400, 400, 0, 0))
            if one["share"] == limit
        ] or [{"without_failure": needed}]
        assert found == claim["without_failure"] == needed
    else:  # integer hits n share bracket it: 50 more than enough, 50 fewer not
        for count, enough in ((found + 50 - found % 50, True), (found - found % 50, False)):
            hits = round(share * count)
            assert (stats.binom.sf(hits - 1, count, limit) <= 0.05) == enough
    assert metrics.trials_needed(0.05, share=0.05) == 0


def test_no_number_of_trials_closes_an_interval_at_a_level_on_the_wrong_side() -> None:
    """All levels are above, so no number of trials is requested at the last one."""
    assert counted([50] * 8, trials=50).needs == ((0, 59),)
    assert counted([400] * 8).needs == ()
    both = counted([78, 77, 77, 77, 77, 76, 75, 75], trials=80)
    assert [level for level, _ in both.needs] == [0, 10]


def test_two_trials_give_two_levels_and_no_number() -> None:
    """A step of one trial in two is no proportion near 95 %; 20 trials are the fewest that have one."""
    study = Study.model_validate(STUDY)
    curves = {"slow": [1, 1, 1, 0.5, 0.5, 0, 0, 0], "fast": [1.0] * 8}
    (said, _) = thresholds.sentences(study.thresholds[0], lines_of(study, curves, 2))
    assert "identified falls below 95 % between rate = 2 and 3 deg/s (95 %: below 6" in said
    assert thresholds.too_few(np.array([19.0, 40]), 0.95)
    assert not thresholds.too_few(np.array([20.0, 40]), 0.95)


def test_only_a_proportion_has_a_threshold() -> None:
    assert Threshold.model_validate(
        {"response": "coverage_4", "limit": 0.9, "along": "x"}
    ).axes == {
        "along": "x",
        "by": None,
    }


def test_the_short_answer_has_the_interval_and_no_more_digits_than_it_knows() -> None:
    study = Study.model_validate(STUDY)
    curves = {"slow": [1, 1, 1, 0.9, 0.5, 0.1, 0, 0], "fast": [1.0] * 8}
    said = thresholds.brief(study.thresholds[0], lines_of(study, curves, 400))
    assert "at rate = 2.5 deg/s (slow) (2 to 3)" in said
    few = thresholds.brief(study.thresholds[0], lines_of(study, curves, 50))
    assert "(below 4)" in few
