"""The answers of a study in words, and the start of its report."""

from __future__ import annotations

import math
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import yaml
from numpy.typing import NDArray
from scipy import stats

from skysim.experiments.study import answer, study_file, thresholds
from skysim.experiments.study.execution import store
from skysim.experiments.study.plan import Study, resolve_point
from skysim.experiments.study.report import overview, study_report
from skysim.experiments.study.table import PointRow, PointTable, format_summary
from skysim.results import metrics
from skysim.results.metrics import Summary
from skysim.simulation import checks
from skysim.simulation.lab import build_lab
from tests.helpers.study_stores import done

STUDY: dict[str, Any] = {
    "schema": 1,
    "title": "How many LEDs?",
    "scene": "afit_simsat",
    "seed": 1,
    "set": {"light.layout": {"kind": "random", "count": 500, "cap_deg": 40}},
    "trial": {"kind": "centroids", "noise_px": 0.2},
    "factors": {"leds": {"key": "light.layout.count", "values": [500, 900]}},
    "responses": ["identified", "roll_arcsec_p95", "misidentified"],
}
NEVER = {
    "misidentified": 0,
    "roll_noise": 0,
    "misled": 0,
    "wrong": 0,
    "ambiguous": 0,
    "refused": 0,
    "identified": 0,
}


def study(**keys: Any) -> Study:
    return Study.model_validate(STUDY | keys)


def line(n: int, leds: int, trials: int, **hits: int) -> PointRow:
    """A point with these counts of events, and a p95 of the roll of 100 arcsec times its number."""
    responses = {
        name: metrics.proportion(count, trials) for name, count in (NEVER | hits).items()
    }
    p95 = {"roll_arcsec_p95": Summary(100.0 * (n + 1), 90.0, 350.0, trials)}
    return PointRow(n, {"leds": leds}, responses | p95, trials)


def said(texts: list[str], start: str) -> str:
    (text,) = [one for one in texts if one.startswith(start)]
    return text


@pytest.mark.parametrize(
    ("wrong", "start", "brief"),
    [
        ((0, 0), "wrong ≤ 0.001: met at all 2 points, most at", "is met at all 2 points."),
        (
            (0, 40),
            "wrong ≤ 0.001: not met at 1 of 2 points, most at leds = 900: 1 %",
            "is not met",
        ),
        (
            (0, 3),
            "wrong ≤ 0.001: not shown yet at 1 of 2 points, most at leds = 900, needs",
            "not",
        ),
    ],
)
def test_a_requirement_is_answered_for_all_points_by_the_one_that_decides(
    wrong: tuple[int, int], start: str, brief: str
) -> None:
    lines = [
        line(n, leds, 4000, wrong=count)
        for n, (leds, count) in enumerate(zip((500, 900), wrong, strict=True))
    ]
    judged = thresholds.judged({"wrong": 0.001}, lines)
    assert answer.headline(PointTable(study(), lines), False, judged=judged)[0].startswith(
        start
    )
    assert answer.verdict(PointTable(study(), lines), judged).startswith("`wrong ≤ 0.001` is")
    assert brief in answer.verdict(PointTable(study(), lines), judged)


def test_without_ambiguity_the_answer_has_a_confidence() -> None:
    """1 - 0.05^(1 / 10,000) is 0.02995 %."""
    texts = answer.headline(PointTable(study(), [line(0, 500, 10_000)]), True)
    assert said(texts, "Is it ambiguous anywhere?") == (
        "Is it ambiguous anywhere? No. Ambiguous or misled: none in 10,000 (less than 0.03 % at 95 % confidence)."
    )
    assert pytest.approx(0.0002995, abs=1e-7) == 1 - 0.05 ** (1 / 10_000)
    assert [
        one
        for one in answer.headline(PointTable(study(), [line(0, 500, 10_000)]), False)
        if "ambiguous" in one
    ] == []


def test_ambiguity_is_located_and_the_rest_has_a_confidence() -> None:
    """Misled attitudes count as ambiguous ones that the tracker did not notice."""
    lines = [line(0, 500, 200, ambiguous=20, misled=10), line(1, 900, 400)]
    interval = metrics.proportion(30, 200)
    text = said(
        answer.headline(PointTable(study(), lines), True), "Is it ambiguous anywhere?"
    )
    assert text == (
        "Is it ambiguous anywhere? Yes. Ambiguous or misled: at 1 of 2 points, most at leds = 500: 15 % of the"
        f" frames ({100 * interval.low:.3g} to {100 * interval.high:.3g} %); none in 400 (less than 0.75 % at 95 %"
        " confidence) at the other points."
    )


def test_refusals_are_named_where_they_are_most_frequent() -> None:
    """No attitude is ambiguous, but 4 of 200 are not solved at 500 LEDs."""
    lines = [line(0, 500, 200, refused=4), line(1, 900, 400)]
    interval = metrics.proportion(4, 200)
    texts = answer.headline(PointTable(study(), lines), True, "skysim study worst leds.yaml")
    assert said(texts, "Is it ambiguous anywhere?").startswith(
        "Is it ambiguous anywhere? No."
    )
    assert said(texts, "Is every attitude solved?") == (
        "Is every attitude solved? No. Refused (no attitude is returned): at 1 of 2 points, most at leds = 500: 2 % of"
        f" the frames ({100 * interval.low:.3g} to {100 * interval.high:.3g} %); none in 400 (less than 0.75 % at 95 %"
        " confidence) at the other points. `skysim study worst leds.yaml --response refused` names the worst."
    )
    solved = answer.headline(
        PointTable(study(trial={"kind": "frames"}), [line(0, 500, 100)]), True
    )
    assert said(solved, "Is every frame solved?").startswith(
        "Is every frame solved? Yes. Refused"
    )


def test_misidentification_and_roll_noise_are_distinguished() -> None:
    texts = answer.headline(PointTable(study(), [line(0, 500, 1000, roll_noise=50)]), True)
    assert said(texts, "Misidentified").endswith(
        "none in 1,000 (less than 0.3 % at 95 % confidence)."
    )
    assert said(texts, "Roll noise").endswith(
        "covariance allows): 5 % of the frames (3.81 to 6.53 %)."
    )
    assert said(texts, "Wrong attitudes").endswith(
        "none in 1,000 (less than 0.3 % at 95 % confidence)."
    )


def test_the_bound_on_unseen_events_uses_the_point_with_fewest_trials() -> None:
    texts = answer.headline(
        PointTable(study(), [line(0, 500, 100), line(1, 900, 1000)]), False
    )
    assert said(texts, "Misidentified").endswith(
        "none in 100 a point (less than 3 % at 95 % confidence)."
    )


def test_wrong_matches_are_counted_and_their_effect_on_the_attitude() -> None:
    """One of 90 matches is wrong in 25 of 200 frames: not an alarm if the errors are as claimed."""
    one = line(0, 500, 200, misidentified=25)
    other = line(1, 900, 200)
    for point, share in ((one, 25 / 18_000), (other, 0.0)):
        point.responses["mismatched"] = Summary(share, math.nan, math.nan, 18_000)
    texts = answer.headline(PointTable(study(), [one, other]), True)
    assert (
        "There 25 of 18,000 matches are wrong; the attitude is unaffected: all errors are as claimed."
        in texts
    )
    assert said(texts, "Is it ambiguous anywhere?").startswith(
        "Is it ambiguous anywhere? No."
    )
    one.responses["misled"] = metrics.proportion(10, 200)
    (text,) = [
        text
        for text in answer.headline(PointTable(study(), [one, other]), True)
        if text.startswith("There 25")
    ]
    assert (
        "the attitude errs more than claimed at 1 of 2 points, most at leds = 500: 5 % of the frames (2.74"
        in text
    )


def test_a_tracker_without_matches_has_no_correctness_claim() -> None:
    unknown = line(0, 500, 100)
    unknown.responses["misidentified"] = metrics.NO_VALUE
    assert said(
        answer.headline(PointTable(study(), [unknown]), False), "Misidentified"
    ).endswith("does not name its lights.")


def test_ranges_name_the_extreme_points_and_skip_points_of_few_values() -> None:
    lines = [line(0, 500, 200, identified=100), line(1, 900, 200, identified=200)]
    few = line(2, 200, 200, identified=3)
    few.responses["roll_arcsec_p95"] = Summary(1.0, math.nan, math.nan, 3, 56)
    ranges = answer.ranges(PointTable(study(), [*lines, few]))
    assert ranges == [
        "identified: 0.015 (0.00511..0.0432) at leds = 200, to 1 (0.985..1) at leds = 900.",
        "roll_arcsec_p95: 100 (90..350) at leds = 500, to 200 (90..350) at leds = 900.",
    ]
    assert (
        answer.ranges(PointTable(study(), [few]))[1]
        == "roll_arcsec_p95: 1 (needs 56 more values)."
    )


def test_the_next_claim_says_how_many_trials_it_needs() -> None:
    """ln 0.05 / ln(1 - 0.001) is 2,994.2; what was seen at every point makes no claim."""
    texts = answer.headline(
        PointTable(study(), [line(0, 500, 1200), line(1, 900, 5000)]), False
    )
    assert said(texts, "None in") == (
        "None in 1,200 is less than 0.25 % at 95 % confidence; a claim of less than 0.1 % needs 2,995 in all at each"
        " point without any."
    )
    seen = line(0, 500, 1200, misidentified=1, misled=1, roll_noise=1, wrong=1, ambiguous=1)
    assert not [
        one
        for one in answer.headline(PointTable(study(), [seen]), False)
        if one.startswith("None in")
    ]


@pytest.mark.parametrize(
    ("nees", "expected"),
    [
        (
            [(3.0, 2.8, 3.2), (3.1, 2.9, 3.3)],
            "Yes: NEES is 2.5 to 3.5 at all 2 points, 95 % for all 2 points together.",
        ),
        (
            [(3.0, 2.8, 3.2), (5.07, 4.6, 5.6)],
            "No: too small by a factor of 1.3 at leds = 900 (NEES 5.07, 4.54 to 5.68, 95 % for all 2 points together"
            "; 3 if true), at 1 of 2 points.",
        ),
        (
            [(0.75, 0.7, 0.8), (3.0, 2.8, 3.2)],
            "No: too large by a factor of 2 at leds = 500 (NEES 0.75, 0.693 to 0.808, 95 % for all 2 points together"
            "; 3 if true), at 1 of 2 points.",
        ),
        (
            [(3.0, 2.8, 3.2), (1e4, math.nan, math.nan)],
            "No: too small by a factor of 58 at leds = 900 (NEES 1e+04, 1e+04 to 1e+04, 95 % for all 2 points together"
            "; 3 if true), at 1 of 2 points.",
        ),
        (
            [(3.0, 2.8, 3.2), (9.0, math.nan, math.nan)],
            "Yes: NEES is 2.5 to 3.5 at 1 of 2 points, too few to say at the others, 95 % for all 2 points together.",
        ),
        (
            [(9.0, math.nan, math.nan), (9.0, math.nan, math.nan)],
            "Too few to say: 1 trials at all 2 points, 30 are needed.",
        ),
        (
            [(3.0, 2.8, 3.2), (4.0, 2.0, 6.0)],
            "Nothing says otherwise, but NEES is known to 1.87 to 6.61 only at leds = 900, 95 % for all"
            " 2 points together. Errors too small by a factor of 1.8 would be noticed with a probability of 80 %.",
        ),
    ],
)
def test_understated_errors_are_reported(
    nees: list[tuple[float, float, float]], expected: str
) -> None:
    """The factor is sqrt(NEES / 3): 1.3 at 5.07, and 2 too large at 0.75."""
    lines = [line(n, leds, 500) for n, leds in enumerate((500, 900))]
    for one, values in zip(lines, nees, strict=True):
        one.responses["nees"] = Summary(*values, 1 if math.isnan(values[1]) else 500)
    texts = answer.headline(PointTable(study(), lines), False)
    assert (
        said(texts, "Are the claimed errors true?")
        == f"Are the claimed errors true? {expected}"
    )
    assert len(answer.ranges(PointTable(study(responses=["nees"]), lines))) == 1


def verdicts(nees: NDArray[np.float64], survey_share: float = 0.0) -> list[str]:
    """The sentence on claimed errors of each of S studies, from the NEES of T trials at P points, (S, P, T)."""
    texts = []
    for one in nees:
        lines = []
        for n, values in enumerate(one):
            nees_of = metrics.response("nees")(
                {"nees": values, "solved": np.ones(len(values))}
            )
            lines.append(PointRow(n, {"leds": n}, {"nees": nees_of}, len(values)))
        texts += answer.claimed_errors(PointTable(study(), lines), survey_share)
    return texts


@pytest.mark.parametrize(("points", "trials"), [(1, 30), (20, 30), (20, 4), (5, 300)])
def test_true_claims_are_called_false_in_at_most_one_study_of_twenty(
    points: int, trials: int
) -> None:
    """Chi-square of three degrees times 3.5 / 3, the limit of TRUE_NEES; 100 studies, to four standard errors."""
    rng = np.random.default_rng(12)
    found = verdicts(3.5 / 3 * rng.chisquare(3, (100, points, trials)))
    assert np.mean([" No: " in one for one in found]) <= 0.05 + 4 * math.sqrt(0.0475 / 100)
    assert (trials < 30) == all("Too few to say" in one for one in found)


def test_trials_of_one_survey_do_not_decide_whether_claims_are_true() -> None:
    """One draw of three angles is the error of all 300 trials, and the claim is true: without its share all say no."""
    rng = np.random.default_rng(14)
    nees = rng.chisquare(3, (100, 1, 1)) * np.ones((1, 1, 300))
    assert np.mean([" No: " in one for one in verdicts(nees)]) > 0.5
    told = verdicts(nees, 0.99)
    assert all(
        "One survey cannot decide it: 99 % of the expected variance" in one for one in told
    )
    assert verdicts(nees, 0.05) == verdicts(nees)
    assert " No: too small" in verdicts(np.full((1, 1, 300), 100.0), 0.99)[0]


def test_attitudes_that_differ_widen_the_interval() -> None:
    """Claims that are wrong by a factor of their own at each attitude, true on average: at most 10 of 100 say no."""
    rng = np.random.default_rng(13)
    shape = (100, 20, 60)
    found = verdicts(rng.chisquare(3, shape) * rng.gamma(4, 1 / 4, shape))
    assert np.mean([" No: " in one for one in found]) <= 0.1


@pytest.mark.parametrize("points", [1, 20])
def test_a_wrong_claim_is_noticed_with_the_stated_power(points: int) -> None:
    """One point of errors that are too small by the factor that 40 true trials a point state, in 400 studies."""
    rng = np.random.default_rng(14)
    true = Summary(
        3.0, 3 * 120 / stats.chi2.isf(0.025, 120), 3 * 120 / stats.chi2.isf(0.975, 120), 40
    )
    factor = answer.noticed(answer.jointly(true, points), points)
    values = rng.chisquare(3, (400, 40)) * factor**2
    low = [
        answer.jointly(
            metrics.response("nees")({"nees": one, "solved": np.ones(40)}), points
        ).low
        for one in values
    ]
    assert np.mean(np.array(low) > 3.5) == pytest.approx(0.8, abs=4 * math.sqrt(0.16 / 400))


def test_before_the_first_trial_there_is_no_answer() -> None:
    empty = [PointRow(0, {"leds": 500}, {})]
    assert (
        answer.headline(PointTable(study(), empty), True)
        == answer.ranges(PointTable(study(), empty))
        == []
    )


def test_a_point_whose_trials_all_failed_is_left_out() -> None:
    none = {name: Summary(math.nan, math.nan, math.nan, 0) for name in NEVER}
    failed = PointRow(1, {"leds": 900}, none, 20)
    texts = answer.headline(PointTable(study(), [line(0, 500, 100), failed]), True)
    assert texts == answer.headline(PointTable(study(), [line(0, 500, 100)]), True)
    assert answer.headline(PointTable(study(), [failed]), True) == []


# What the report begins with.


def loaded(folder: Path, **keys: Any) -> Any:
    path = folder / "study.yaml"
    path.write_text(yaml.safe_dump(STUDY | {"replicates": 2} | keys, sort_keys=False))
    return study_file.load(path)


@pytest.mark.slow
def test_the_scene_is_in_a_table(tmp_path: Path) -> None:
    rows = dict(
        overview.overview(loaded(tmp_path, hardware=["light.layout.hardware_seed"])).rows
    )
    assert (
        rows["light"]
        == "dome (ellipsoid, 1.219 m above the bearing) with 500 LEDs (random) within 40°"
    )
    assert rows["camera"].endswith("f/8, field 10° × 7.52°, 22.6″ a pixel")
    assert rows["trial"] == "kind: centroids, noise_px: 0.2"
    assert rows["varied: leds"] == "500, 900 (light.layout.count)"
    assert (
        rows["trials"] == "2 at each of 2 points, the same attitudes at every point; seed 1"
    )
    assert rows["drawn in every trial"] == "light.layout.hardware_seed"


@pytest.mark.slow
def test_the_tracker_s_knowledge_is_stated_as_in_the_check(tmp_path: Path) -> None:
    station = {
        "kind": "total_station",
        "position": ["1 m", "0 m", "-0.5 m"],
        "angle_sigma_arcsec": 2,
    }
    survey = {
        "tracker.survey": {
            "instrument": station | {"distance_sigma": "1 mm"},
            "led_sigma": "0.1 mm",
        }
    }
    plan = loaded(tmp_path, set=STUDY["set"] | survey)
    scene, _ = resolve_point(plan.spec, plan.points[0].settings)
    (fact,) = [
        one for one in checks.check(build_lab(scene)).facts if one.name == "tracker knows"
    ]
    knowledge = dict(overview.overview(plan).rows)["tracker knows"]
    assert knowledge == "; ".join(fact.lines)
    assert "measured by a total station" in knowledge
    assert "LEDs to 0.1 mm" not in knowledge


@pytest.mark.slow
def test_intervals_of_one_dome_name_the_fixed_hardware(tmp_path: Path) -> None:
    survey = "tracker.survey.seed"
    layout = "light.layout.hardware_seed"
    about = overview.overview(loaded(tmp_path))
    assert 0.1 < about.survey_share < 1
    (said_,) = answer.one_unit(about.fixed)
    assert said_ == (
        "Intervals cover other attitudes, with one survey and one draw of the LEDs:"
        f" `hardware: [{survey}, {layout}]` in the study draws the hardware anew in every replicate, and they cover it"
        " too."
    )
    (said_,) = answer.one_unit(overview.overview(loaded(tmp_path, hardware=[survey])).fixed)
    assert f"with one draw of the LEDs: `hardware: [{layout}]`" in said_
    assert (
        answer.one_unit(overview.overview(loaded(tmp_path, hardware=[survey, layout])).fixed)
        == []
    )
    drawn = overview.overview(loaded(tmp_path, hardware=[survey]))
    assert drawn.survey_share == 0
    units = {"unit": {"levels": {"a": {survey: 1}, "b": {survey: 2}}}}
    assert overview.overview(loaded(tmp_path, factors=units)).fixed == (layout,)


@pytest.mark.slow
def test_a_dome_is_checked_up_to_the_tilt_of_the_trials(tmp_path: Path) -> None:
    """LEDs end at 27 deg: within the reach of the scene's maneuver, 20 deg, and not of trials at 20 deg and more."""
    layout = {"light.layout": {"kind": "random", "count": 900, "cap_deg": 27}}
    factors = {"leds": {"key": "light.layout.count", "values": [900]}}

    def warned(tilt_deg: int) -> list[str]:
        trial = {"kind": "centroids", "tilt_deg": [0, tilt_deg]}
        summary = overview.overview(
            loaded(tmp_path, set=layout, trial=trial, factors=factors)
        )
        return [one for one in summary.findings if "LEDs end at 27 deg" in one]

    assert not warned(10)
    assert "at a tilt of 25.0 deg" in warned(25)[0]


@pytest.mark.slow
def test_checks_run_at_every_level_and_name_the_levels_of_findings(
    tmp_path: Path,
) -> None:
    """The image of a disk of 10 mm at 0.8 m is 110 px wide, which the detector takes for background."""
    levels = {"small": {}, "large": {"light.led.disk_diameter": "10 mm"}}
    summary = overview.overview(
        loaded(tmp_path, trial={"kind": "frames"}, factors={"disk": {"levels": levels}})
    )
    wide = [one for one in summary.findings if "px wide; local treats" in one]
    assert len(wide) == 1
    assert wide[0].endswith("[disk = large]")
    assert summary.may_be_ambiguous


@pytest.mark.long
@pytest.mark.parametrize(
    ("texts", "expected"),
    [
        (["12 px of 3"] * 3, "12 px of 3"),
        (
            ["12 px of 3", "13 px of 3", "12 px of 3"],
            "12 px of 3 [a = 1; with other numbers at all others]",
        ),
        (["12 px of 3", "13 px of 3"], "12 px of 3 [a = 1; a = 2]"),
    ],
)
def test_findings_that_differ_only_in_numbers_are_merged(
    texts: list[str], expected: str
) -> None:
    at = [(text, f"a = {n}") for n, text in enumerate(texts, 1)]
    assert overview.finding_text(at, checked=3) == expected


def test_the_location_of_an_extreme_has_its_unit() -> None:
    rates = study(
        factors={"rate": {"key": "trial.rate_deg_s", "values": [0, 8]}},
        trial={"kind": "frames"},
    )
    lines = [
        line(0, 500, 100)._replace(levels={"rate": 0}),
        line(1, 500, 100, wrong=3)._replace(levels={"rate": 8}),
    ]
    assert "most at rate = 8 deg/s: 3 %" in said(
        answer.headline(PointTable(rates, lines), True), "Wrong attitudes"
    )


def test_a_rounding_error_of_zero_is_zero() -> None:
    assert format_summary(Summary(4.5e-13, 3e-13, 4.6e-13, 9)) == "0"
    assert format_summary(Summary(4.5e-8, 3e-13, 4.6e-3, 9)) == "4.5e-08 (0..0.0046)"


@pytest.mark.slow
def test_findings_of_many_levels_are_summarized(tmp_path: Path) -> None:
    """Three widths of LEDs, all of them too wide: one warning, not three that differ in their numbers."""
    sizes = {"key": "light.led.disk_diameter", "values": ["20 mm", "25 mm", "30 mm"]}
    found = overview.overview(
        loaded(tmp_path, trial={"kind": "frames"}, factors={"size": sizes})
    ).findings
    (wide,) = [one for one in found if "px wide; local treats" in one]
    assert wide.endswith("[first levels; with other numbers at all others]")


@pytest.mark.slow
def test_a_finding_names_the_number_of_leds_where_the_study_varies_it(tmp_path: Path) -> None:
    """A finding names the number of LEDs of each checked point."""
    factors = {
        "leds": {"key": "light.layout.count", "values": [60, 900]},
        "disk": {"levels": {"small": {}, "large": {"light.led.disk_diameter": "10 mm"}}},
    }
    found = overview.overview(
        loaded(tmp_path, trial={"kind": "frames"}, factors=factors)
    ).findings
    (wide,) = [one for one in found if "px wide; local treats" in one]
    assert "disk = large, 60 LEDs" in wide


@pytest.mark.slow
def test_the_corners_of_a_design_are_checked(tmp_path: Path) -> None:
    """Neither a long exposure at rest nor a fast rate with a short one smears; both together do."""
    factors = {
        "exposure": {"key": "exposure.time", "values": ["20 ms", "2 ms", "100 ms"]},
        "rate": {"key": "trial.rate_deg_s", "values": [0.1, 4, 1]},
    }
    keys: dict[str, Any] = {"scene": "shefex2", "set": {}, "trial": {"kind": "frames"}}
    plan = loaded(tmp_path, factors=factors, **keys)
    names = [name for name, _ in overview.checked_points(plan)]
    assert names[:2] == ["first levels", "exposure = 100 ms, rate = 4"]
    assert len(names) == len(set(names))
    (smear,) = [
        line for line in overview.overview(plan).findings if "images move by up to" in line
    ]
    assert "exposure = 100 ms, rate = 4" in smear
    assert "exposure = 2 ms" not in smear


@pytest.mark.slow
def test_a_rolling_shutter_is_checked_at_the_rates_of_the_trials(tmp_path: Path) -> None:
    """The scene turns by 0.5 deg/s and its trials by up to 20: the warning is of 20, and none is given at rest."""
    shutter = {
        "camera.shutter": {"kind": "rolling", "row_time": "80 us"},
        "tracker.assumed_row_time": "0 s",
    }
    rates = {"key": "trial.rate_deg_s", "values": [0, 20, 5]}
    keys: dict[str, Any] = {"scene": "shefex2", "set": shutter, "trial": {"kind": "frames"}}
    found = overview.overview(loaded(tmp_path, factors={"rate": rates}, **keys)).findings
    (text,) = [one for one in found if one.startswith("tracker.assumed_row_time: ")]
    assert (
        "at up to 20 deg/s; leave it out, so that the tracker corrects the rows for 80 us each, or turn "
        in text
    )
    assert text.endswith("[rate = 20]")
    still = overview.overview(
        loaded(tmp_path, factors={"rate": rates | {"values": [0]}}, **keys)
    ).findings
    assert [one for one in still if one.startswith("tracker.assumed_row_time: ")] == []
    keys["set"] = {"camera.shutter": shutter["camera.shutter"]}
    known = overview.overview(loaded(tmp_path, factors={"rate": rates}, **keys)).findings
    assert [one for one in known if "row_time" in one] == []


@pytest.mark.slow
def test_a_report_begins_with_its_answer_and_one_figure(tmp_path: Path) -> None:
    plan = loaded(tmp_path, figures=[{"kind": "map", "value": "stars_least"}])
    assert done(plan, tmp_path / "study.sqlite").failed == 0
    with store.open_store(tmp_path / "study.sqlite") as kept:
        command = study_report.commands(plan, kept, "again")
        found = study_report.analyze(plan, kept, command)
        report = study_report.compose(kept, found, command)
    text = report.save(tmp_path / "r.html").read_text(encoding="utf-8")
    parts = (
        'class="verdict good"',
        "trials, 0 failed",
        "<figure>",
        "<summary>All answers",
        "<h2>Points",
        "<summary>Checks of the scene",
        "<summary>Scene",
    )
    places = [text.index(part) for part in parts]
    assert places == sorted(places)
    assert "Is it ambiguous anywhere?" in text
    # The worst trials of a map of two attitudes.
    assert text.count("<code>skysim study replay again ") == 2


def test_frames_without_an_attitude_have_no_wrong_one() -> None:
    """Forty of the hundred frames are refused: none of sixty is wrong."""
    lines = [line(0, 500, 50, refused=40), line(1, 900, 50)]
    text = answer.verdict(PointTable(study(), lines))
    assert "No attitude is wrong (in 60 of 100 frames)." in text
    assert "(in 100)" in answer.verdict(
        PointTable(study(), [line(0, 500, 50), line(1, 900, 50)])
    )


@pytest.mark.parametrize(("nees", "false"), [(12.0, True), (3.0, False)])
def test_the_last_line_says_that_claimed_errors_are_false(nees: float, false: bool) -> None:
    lines = [line(0, 500, 400)]
    known = {"nees": Summary(nees, 0.9 * nees, 1.1 * nees, 400)}
    lines = [one._replace(responses=one.responses | known) for one in lines]
    said_so = "Are the claimed errors true? No: too small by a factor of 2 (NEES 12"
    assert (said_so in answer.verdict(PointTable(study(), lines))) == false
