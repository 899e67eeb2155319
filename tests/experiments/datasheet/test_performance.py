"""Probabilities with exact bounds, the number of runs for a claim, and limits."""

from __future__ import annotations

import math
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
import scipy

from skysim.experiments.datasheet import cells as datasheet_run
from skysim.experiments.datasheet import performance
from skysim.experiments.datasheet.cells import DatasheetCell
from skysim.experiments.datasheet.performance import (
    Counts,
    bracket,
    bracket_text,
    claims,
    noise_equivalent_angle,
)
from skysim.results.metrics import trials_needed


def test_the_number_of_runs_without_failure_follows_the_formula():
    """ln 0.05 / ln 0.997 = 997.1: 997 runs show 99.7 % at 94.999 %, and 998 at 95 %."""
    assert math.log(0.05) / math.log(0.997) == pytest.approx(997.07, abs=0.01)
    assert trials_needed(1 - 0.997) == 998
    assert 1 - 0.997**998 >= 0.95 > 1 - 0.997**997
    assert abs(0.95 - (1 - 0.997**997)) < 2e-5
    assert trials_needed(1 - 0.95) == 59


@pytest.mark.parametrize("failures", [1, 2, 7])
def test_runs_with_failures_are_the_fewest_whose_bound_holds(failures):
    """P(at most so many failures) is the binomial's, below 5 % at the number and not at one fewer."""
    runs = trials_needed(0.01, failures)
    below = [scipy.stats.binom.cdf(failures, n, 0.01) for n in (runs, runs - 1)]
    assert below[0] <= 0.05 < below[1]


def test_a_claim_says_how_many_more_runs_it_needs():
    found = {one["share"]: one for one in claims(Counts(400, 399, 1, 0))}
    assert found[0.95]["shown"]
    assert found[0.95]["more"] == 0
    assert not found[0.997]["shown"]
    assert scipy.stats.binom.cdf(1, 400 + found[0.997]["more"], 0.003) <= 0.05
    assert scipy.stats.binom.cdf(1, 399 + found[0.997]["more"], 0.003) > 0.05


def test_bounds_cover_the_truth_as_often_as_stated():
    """Each one-sided bound at 95 %, of a share of 0.9 in 40 frames."""
    hits = np.random.default_rng(1).binomial(40, 0.9, 4000)
    shares = [Counts(40, int(n), 40 - int(n), 0).share("right") for n in hits]
    assert np.mean([one.low <= 0.9 for one in shares]) >= 0.945
    assert np.mean([one.high >= 0.9 for one in shares]) >= 0.945


def test_noise_is_separated_from_errors_that_two_frames_share():
    rng = np.random.default_rng(2)
    shared = 30 * rng.standard_normal(4000)
    first, second = (shared + 2.5 * rng.standard_normal(4000) for _ in range(2))
    first[:3] = np.nan
    assert noise_equivalent_angle(first - second) == pytest.approx(2.5, rel=0.04)
    assert math.isnan(noise_equivalent_angle((first - second)[:3]))


def test_a_limit_is_between_the_nearest_levels_shown_above_and_below():
    rows = [
        {"rate": n, "counts": Counts(200, right, 200 - right, 0)}
        for n, right in enumerate([200, 199, 190, 150, 3])
    ]
    assert bracket(rows, "rate") == (0.95, 1, 3, 200)
    assert bracket(rows[:1], "rate") == (0.95, 0, math.inf, 200)
    assert math.isnan(bracket(rows[3:], "rate").above)


def test_a_limit_uses_the_highest_share_that_its_frames_can_demonstrate():
    """59 frames without a failure show 95 %, and 29 show 90 %."""
    for frames, share, above in (
        (59, 0.95, 1),
        (58, 0.9, 1),
        (29, 0.9, 1),
        (28, 0.9, math.nan),
    ):
        found = bracket([{"rate": 1, "counts": Counts(frames, frames, 0, 0)}], "rate")
        assert found[:2] == pytest.approx((share, above), nan_ok=True)


def test_frames_of_one_field_count_once():
    """Four fields with two frames each: right, refused in the second, false in the first, refused and false."""
    outcome = {"right": [[1, 1, 0, 0], [1, 0, 1, 0]], "false": [[0, 0, 1, 0], [0, 0, 0, 1]]}
    sheet = SimpleNamespace(
        **{
            name: lambda rows, name=name: np.array(outcome[name], bool)[rows]
            for name in outcome
        }
    )
    assert performance.counts(sheet, [0, 1], by_field=True) == Counts(4, 1, 1, 2)


def sky_sheet(errors_over_sigma: tuple[float, float, float]) -> datasheet_run.MeasuredFrames:
    """A sheet of 4,000 frames with these errors about x, y and roll, whose covariance says 1."""
    rng = np.random.default_rng(3)
    errors = np.asarray(errors_over_sigma)[:, None, None] * rng.standard_normal((3, 10, 400))
    columns = dict(zip(datasheet_run.AXES, errors, strict=True)) | {
        "nees": np.sum(errors**2, axis=0)
    }
    columns |= {"solved": np.ones((10, 400)), "wrong": np.zeros((10, 400))}
    columns["solved"][0, :5] = 0
    columns["nees"][0, :5] = np.nan
    cells = [DatasheetCell("sky", {"draw": number}, {}) for number in range(10)]
    unused: Any = None
    return datasheet_run.MeasuredFrames(
        unused, "", {}, unused, unused, cells, columns, unused
    )


def test_a_correct_covariance_is_confirmed():
    found = performance.consistency(sky_sheet((1, 1, 1)))
    assert found["nees"].low < 3 < found["nees"].high
    for one in found["within"]:
        assert one["share"].trials == 3995
        sigma = math.sqrt(one["level"] * (1 - one["level"]) / 3995)
        assert one["share"].value == pytest.approx(one["level"], abs=3 * sigma)
    assert found["y_over_x"].low < 1 < found["y_over_x"].high


def test_a_covariance_too_small_about_y_is_detected():
    found = performance.consistency(sky_sheet((1, 1.5, 1)))
    assert found["nees"].value == pytest.approx(2 + 1.5**2, abs=0.2)
    assert found["within"][1]["share"].high < 0.954
    assert found["y_over_x"].value == pytest.approx(1.5**2, rel=0.1)


def test_a_covariance_is_judged_at_each_rate():
    """Errors twice as large as claimed have four times the NEES; few fields know it less."""
    sheet = sky_sheet((2, 2, 2))
    sheet = sheet._replace(
        cells=[DatasheetCell("rate", {"rate_deg_s": n // 2}, {}) for n in range(10)]
    )
    rows = performance.by_level(sheet, "rate", "rate_deg_s")
    assert len(rows) == 5
    for row in rows:
        assert row["nees"].low < 12 < row["nees"].high
        assert row["nees"].low > 9
    sheet.columns["solved"][:2, 9:] = 0
    few = performance.by_level(sheet, "rate", "rate_deg_s")[0]["nees"]
    assert few.low < 12 < few.high
    assert few.high / few.low > 1.5 * rows[0]["nees"].high / rows[0]["nees"].low


def test_the_interval_of_a_pair_s_noise_is_about_its_value():
    """Errors of 2 about each axis, independent from frame to frame: noise and error are 2, within intervals."""
    sheet = sky_sheet((2, 2, 2))
    sheet = sheet._replace(
        cells=[DatasheetCell("rate", {"rate_deg_s": n // 2}, {}) for n in range(10)]
    )
    for row in performance.by_level(sheet, "rate", "rate_deg_s"):
        for name in ("nea_across", "nea_about", "rms_across", "rms_about"):
            low, high = row["intervals"][name]
            assert low < row[name] < high
            assert row[name] == pytest.approx(2, rel=0.15)
            assert high / low < 1.35


def test_an_interval_covers_the_noise_of_pairs_and_shrinks_with_the_fields():
    """Noise of 2 in pairs with errors in common: its interval holds 2 in 19 of 20, here in most of 40 sheets."""
    rng = np.random.default_rng(8)
    covered = []
    for _ in range(40):
        noise = 2 * rng.standard_normal((2, 60, 2))
        low, high = performance.root_interval(
            np.mean((noise[..., 0] - noise[..., 1]) ** 2, axis=0) / 2
        )
        covered.append(low < 2 < high)
        assert high / low < 1.7
    assert sum(covered) >= 34


def test_a_limit_names_the_levels_whose_claims_are_not_true():
    """NEES of 402: errors greater than claimed by sqrt(402 / 3) = 11.6."""
    rows = [
        {
            "acceleration_deg_s2": level,
            "counts": Counts(40, 40, 0, 0),
            "nees": (nees, 0.85 * nees, 1.2 * nees),
        }
        for level, nees in ((1.6, 2.0), (26.0, 42.5), (100.0, 402.0))
    ]
    text = bracket_text("acquisition", rows, "acceleration_deg_s2")
    assert "not as claimed at 26, 100 °/s²: greater by a factor of 12 at 100" in text
    assert "claimed" not in bracket_text("acquisition", rows[:1], "acceleration_deg_s2")


def test_an_attitude_is_as_old_as_half_its_exposure_and_what_follows():
    """100 ms of exposure, 1000 rows of 20 us, and 30 ms of solving: 50 + 20 + 30 ms."""
    scene = SimpleNamespace(
        camera=SimpleNamespace(shutter=SimpleNamespace(row_time_s=20e-6), height_px=1000),
        exposure=SimpleNamespace(time_s=0.1, rate_hz=5.0),
    )
    found = performance.timing(SimpleNamespace(scene=scene), [0.03] * 5)
    assert found["latency_s"] == pytest.approx(0.1)
    assert found["greatest_rate_hz"] == pytest.approx(1 / 0.03)
