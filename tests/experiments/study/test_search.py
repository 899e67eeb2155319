"""The search of studies: known optima are found, and a kill does not change its store."""

from __future__ import annotations

import itertools
import math
import sys
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import yaml

from skysim.core.errors import InputError
from skysim.experiments.study import plan, search, study_file
from skysim.experiments.study.execution import engines, runner, store
from skysim.experiments.study.execution.outcomes import FAILED, Outcome
from skysim.experiments.study.execution.trials import (
    REFUSED,
    Row,
    TrialJob,
    code_version,
    seed_of,
)
from skysim.experiments.study.factors import Point, Settings
from skysim.experiments.study.report.study_report import front_table
from skysim.results.files.parts import find_prices, parts_list, read_prices
from skysim.results.metrics import Summary
from skysim.results.report import Report
from skysim.scene import loader as scene_loader

pytest.importorskip("optuna")

STUDY: dict[str, Any] = {
    "schema": 1,
    "title": "which dome",
    "scene": "shefex2",
    "seed": 3,
    "trial": {"kind": "centroids"},
    "factors": {
        "x": {"key": "trial.noise_px", "from": 0.1, "to": 1.1, "steps": 2},
        "y": {"key": "trial.magnitude_sigma", "from": 0, "to": 1, "steps": 2},
    },
    "replicates": 4,
    "responses": ["angle_arcsec_p95"],
    "optimize": {
        "candidates": 30,
        "objectives": [{"response": "angle_arcsec_median"}],
    },
}


class Law:
    """An engine that answers by a law of the settings instead of trials."""

    name = "law"
    workers = 1

    def __init__(self, law: Callable[[Settings], Outcome]) -> None:
        self.law = law

    def run(self, job: engines.Job, chunks: engines.Chunks) -> Iterator[list[Row]]:
        assert isinstance(job, TrialJob)
        while chunk := chunks.next():
            yield [
                self.row(job.spec, segment, segment.first + n, k)
                for segment in chunk
                for n, k in enumerate(segment.replicates)
            ]
            chunks.report_time(chunk, 0.1)

    def row(self, spec: plan.TrialSpec, segment: Any, trial: int, k: int) -> Row:
        seed = seed_of(spec, segment.point, k)
        code = code_version()
        try:
            return Row(
                trial,
                segment.point,
                k,
                seed,
                "s",
                code,
                self.law(segment.settings),
                None,
                0.0,
            )
        except InputError as error:
            return Row(trial, segment.point, k, seed, REFUSED, code, FAILED, str(error), 0.0)
        except ArithmeticError as error:
            return Row(
                trial,
                segment.point,
                k,
                seed,
                "s",
                code,
                FAILED,
                f"ArithmeticError: {error}",
                0.0,
            )


def angle(arcsec: float, solved: bool = True) -> Outcome:
    """A trial with this error about the boresight."""
    return Outcome("solved", 1, 1, 0, 0.0, 0.0, arcsec) if solved else Outcome("none", 1)


def bowl(settings: Settings) -> Outcome:
    """An error whose minimum is 1 at x = 0.7, y = 0.2."""
    x = settings["trial.noise_px"]
    y = settings["trial.magnitude_sigma"]
    return angle(1 + (x - 0.7) ** 2 + (y - 0.2) ** 2)


@pytest.fixture(autouse=True)
def any_scene(monkeypatch: pytest.MonkeyPatch) -> None:
    """Disable the check of the scene's hash on resume, as a law has no scene."""
    monkeypatch.setattr(runner, "check_scene", lambda *_: None)


def loaded(folder: Path, keys: dict[str, Any]) -> plan.Plan:
    path = folder / "study.yaml"
    path.write_text(yaml.safe_dump(keys))
    made = study_file.load(path)
    search.check(made.study)
    return made


def searched(
    study_plan: plan.Plan, out: Path, engine: engines.Engine, watch: Any = None
) -> search.SearchResult:
    with store.writing(out) as kept:
        runner.prepare_store(study_plan, kept, bool(kept.meta("digest")))
        return search.search(study_plan, kept, engine, watch)


def held(out: Path) -> tuple[list[Any], list[Any]]:
    """All points and rows of a store."""
    with store.open_store(out) as kept:
        rows = kept.db.execute("SELECT * FROM trials ORDER BY trial").fetchall()
        return kept.db.execute("SELECT * FROM points ORDER BY point").fetchall(), rows


def changed(**keys: Any) -> dict[str, Any]:
    """STUDY with other keys of `optimize`."""
    return STUDY | {"optimize": STUDY["optimize"] | keys}


def test_one_objective_approaches_its_minimum(tmp_path: Path) -> None:
    """Nearer than the best of as many points drawn at random, as they come on the average over the square."""
    found = searched(loaded(tmp_path, STUDY), tmp_path / "s.db", Law(bowl))
    (best,) = found.front
    # E of the least squared distance of N uniform points from an inner point is 1 / (pi N).
    assert best.objectives[0] - 1 < 1 / (math.pi * len(found.candidates))
    assert found.finished
    assert found.candidates[0].levels == {"x": 0.6, "y": 0.5}


def test_an_objective_is_maximized_if_more_is_better(tmp_path: Path) -> None:
    keys = changed(objectives=[{"response": "angle_arcsec_median", "better": "more"}])
    (best,) = searched(loaded(tmp_path, keys), tmp_path / "s.db", Law(bowl)).front
    farthest = 1 + 0.6**2 + 0.8**2  # the corner
    assert best.objectives[0] > 1 + 0.8 * (farthest - 1)


def test_the_front_holds_the_nondominated_candidates(tmp_path: Path) -> None:
    """angle = 1 / x against a price of x: every x at y = 0 is on the true front, and its law is angle * price = 1."""
    cost = {"per": {"x": 1, "y": 1}}
    keys = changed(
        objectives=[{"response": "angle_arcsec_median"}, {"response": "cost"}],
        cost=cost,
        candidates=40,
    )
    found = searched(
        loaded(tmp_path, keys),
        tmp_path / "s.db",
        Law(lambda s: angle(1 / s["trial.noise_px"])),
    )
    on = {one.number for one in found.front}
    assert len(on) >= 5
    for one in found.candidates:
        beaten = any(
            all(a <= b for a, b in zip(two.objectives, one.objectives, strict=True))
            and two.objectives != one.objectives
            for two in found.candidates
        )
        assert beaten == (one.number not in on)
    assert [one.objectives[0] for one in found.front] == sorted(
        one.objectives[0] for one in found.front
    )
    tightness = [math.prod(one.objectives) for one in found.candidates]
    # It has learnt that y costs and brings nothing.
    assert np.median(tightness[-15:]) < np.median(tightness[:10])


def test_constraints_exclude_the_unconstrained_optimum(tmp_path: Path) -> None:
    """The bowl's minimum is identified too rarely; the best candidate is on the border x = 0.5 at 1.04."""

    def law(settings: Settings) -> Outcome:
        return bowl(settings) if settings["trial.noise_px"] <= 0.5 else angle(0, solved=False)

    keys = changed(
        constraints=[
            {"response": "identified", "at_least": 0.9},
            {"response": "cost", "at_most": 10},
        ]
    )
    found = searched(loaded(tmp_path, keys), tmp_path / "s.db", Law(law))
    (best,) = found.front
    assert 1.04 <= best.objectives[0] < 1.14
    for one in found.candidates:
        assert one.feasible == (one.levels["x"] <= 0.5)
        assert one.feasible or one.why.startswith("identified")


def test_a_refused_candidate_is_infeasible_and_the_search_continues(tmp_path: Path) -> None:
    """Its trials fail after the first and do not count as failures of the budget."""
    asked = []

    def law(settings: Settings) -> Outcome:
        asked.append(settings["trial.noise_px"])
        if settings["trial.noise_px"] > 0.8:
            raise InputError("light.layout", "no room")
        return bowl(settings)

    study_plan = loaded(tmp_path, STUDY | {"budget": {"failures": 1}})
    found = searched(study_plan, tmp_path / "s.db", Law(law))
    refused = [one for one in found.candidates if one.refused]
    assert found.finished
    assert refused
    assert {one.why for one in refused} == {"light.layout: no room"}
    assert not any(one.feasible for one in refused)
    assert sum(x > 0.8 for x in asked) == len(refused)  # one trial each was tried
    with store.open_store(tmp_path / "s.db") as kept:
        assert kept.counts() == {"done": 120, "failed": 4 * len(refused), "wrong": 0}
        seeds = kept.point_columns(refused[0].number)["seed"]
        again = [seed_of(study_plan.spec, refused[0].number, k) for k in range(4)]
        assert seeds.tolist() == again


def test_a_refused_candidate_is_never_the_best(tmp_path: Path) -> None:
    """This holds even if cost, which it has, is the only objective."""

    def law(settings: Settings) -> Outcome:
        if settings["trial.noise_px"] < 0.5:
            raise InputError("light.layout", "no room")
        return bowl(settings)

    keys = changed(objectives=[{"response": "cost"}], cost={"per": {"x": 1}}, candidates=20)
    found = searched(loaded(tmp_path, keys), tmp_path / "s.db", Law(law))
    assert any(one.refused for one in found.candidates)
    assert (
        found.front[0].cost
        == min(one.cost for one in found.candidates if not one.refused)
        >= 0.5
    )


def test_a_search_ends_at_its_limit_of_failures(tmp_path: Path) -> None:
    def law(settings: Settings) -> Outcome:
        raise ArithmeticError("a fault")

    found = searched(
        loaded(tmp_path, STUDY | {"budget": {"failures": 6}}), tmp_path / "s.db", Law(law)
    )
    with store.open_store(tmp_path / "s.db") as kept:
        assert 6 <= kept.counts()["failed"] <= 8
    assert not found.finished
    assert not found.front


def test_a_search_ends_at_its_limit_of_time(tmp_path: Path) -> None:
    found = searched(
        loaded(tmp_path, STUDY | {"budget": {"time": "1 us"}}), tmp_path / "s.db", Law(bowl)
    )
    assert not found.finished
    assert len(found.candidates) <= 1


class Killed(Exception):
    """A kill during a search."""


def killer(after: int) -> Callable[[Any], None]:
    """A callback that raises at its nth call."""
    calls = itertools.count(1)

    def watch(progress: runner.Progress) -> None:
        if next(calls) == after:
            raise Killed

    return watch


def killed_and_resumed(
    study_plan: plan.Plan, out: Path, engine: engines.Engine, every: int
) -> int:
    """Kill a search at every nth batch until it ends normally; return the number of kills."""
    for kills in itertools.count():
        try:
            searched(study_plan, out, engine, killer(every))
        except Killed:
            continue
        return kills
    raise AssertionError


@pytest.mark.long
@pytest.mark.parametrize("every", [2, 9])
def test_a_search_killed_and_resumed_leaves_the_same_store(
    tmp_path: Path, every: int
) -> None:
    """Two objectives, a constraint, levels and a refusal: the sampler's whole input is restored from the store."""

    def law(settings: Settings) -> Outcome:
        if settings["trial.magnitude_sigma"] > 0.9:
            raise InputError("light.layout", "no room")
        return bowl(settings)

    keys = changed(
        objectives=[{"response": "angle_arcsec_median"}, {"response": "cost"}],
        cost={"per": {"x": 1}, "levels": {"z": {"3": 1, "5": 2}}},
        constraints=[{"response": "angle_arcsec_worst", "at_most": 1.2}],
        candidates=13,
    )
    keys["factors"] = STUDY["factors"] | {"z": {"key": "trial.lights", "values": [3, 5]}}
    made = loaded(tmp_path, keys)
    whole = searched(made, tmp_path / "whole.db", Law(law))
    assert killed_and_resumed(made, tmp_path / "killed.db", Law(law), every) > 2
    assert held(tmp_path / "killed.db") == held(tmp_path / "whole.db")
    with store.open_store(tmp_path / "killed.db") as kept:
        assert repr(search.collect_result(made, kept)) == repr(whole)


@pytest.mark.slow
def test_a_search_of_a_real_scene_killed_and_resumed_leaves_the_same_store(
    tmp_path: Path,
) -> None:
    keys = changed(candidates=4) | {"replicates": 3}
    made = loaded(tmp_path, keys)
    searched(made, tmp_path / "whole.db", engines.Serial())
    assert killed_and_resumed(made, tmp_path / "killed.db", engines.Serial(), 3) > 1
    points, rows = held(tmp_path / "killed.db")
    assert (points, rows) == held(tmp_path / "whole.db")
    assert len(rows) == 12
    assert all(error is None for *_, error in rows)


def test_a_store_of_another_search_is_refused(tmp_path: Path) -> None:
    """As of another version of the sampler: its rows would be taken for another point's."""
    made = loaded(tmp_path, changed(candidates=3))
    searched(made, tmp_path / "s.db", Law(bowl))
    with store.writing(tmp_path / "s.db") as kept:
        kept.set_points(
            [Point({"x": 1, "y": 1}, {"trial.noise_px": 1, "trial.magnitude_sigma": 1})],
            first=1,
        )
        with pytest.raises(InputError, match=r"candidate 1 is .*version of optuna"):
            search.search(made, kept, Law(bowl))


def test_each_of_few_points_is_tried_once(tmp_path: Path) -> None:
    keys = changed(candidates=30)
    keys["factors"] = {
        "x": {"key": "trial.noise_px", "values": [0.1, 0.5, 0.9]},
        "y": {"key": "trial.magnitude_sigma", "values": [0.2, 0.4]},
    }
    found = searched(loaded(tmp_path, keys), tmp_path / "s.db", Law(bowl))
    assert found.finished
    assert sorted((one.levels["x"], one.levels["y"]) for one in found.candidates) == [
        (x, y) for x in (0.1, 0.5, 0.9) for y in (0.2, 0.4)
    ]
    assert {one.levels["y"] for one in found.front} == {0.2}
    # As near to 0.7, but for rounding.
    assert {one.levels["x"] for one in found.front} <= {0.5, 0.9}


def test_the_callback_gets_the_progress_of_the_whole_search(tmp_path: Path) -> None:
    seen = []
    made = loaded(tmp_path, changed(candidates=5))
    searched(
        made,
        tmp_path / "s.db",
        Law(bowl),
        lambda now: seen.append((now.trials, now.done, now.now)),
    )
    assert {trials for trials, _, _ in seen} == {20}
    assert [done for _, done, _ in seen] == sorted({done for _, done, _ in seen})
    assert seen[-1] == (20, 20, 20)


def test_cost_is_per_si_unit(tmp_path: Path) -> None:
    """base 1 + 2 a meter of 48 in + 0.01 of each of 300 + the level's 5."""
    wanted = plan.Search.model_validate(
        {
            "objectives": [{"response": "cost"}],
            "cost": {
                "base": 1,
                "per": {"size": 2, "leds": 0.01},
                "levels": {"dome": {"cheap": 1, "precise": 5}},
            },
        }
    )
    price = search.factors_cost(
        wanted.cost, {"size": "48 in", "leds": 300, "dome": "precise"}
    )
    assert price == pytest.approx(1 + 2 * 1.2192 + 3 + 5, rel=1e-12)


DOME = STUDY | {
    "scene": "coded_spiral",
    "factors": {
        "leds": {"key": "light.layout.count", "values": [100, 200]},
        "survey": {"key": "tracker.survey.led_sigma", "values": ["0.2 mm", "1 mm"]},
    },
}


def priced(folder: Path, parts: str) -> plan.Plan:
    config = {
        "candidates": 2,
        "objectives": [{"response": "cost"}],
        "cost": {"parts": parts, "base": 7},
    }
    return loaded(folder, DOME | {"optimize": config})


def test_cost_is_the_total_of_the_parts(tmp_path: Path) -> None:
    """As `skysim scenes parts` has it, of the candidate's own scene; a survey that no line reaches has none."""
    made = priced(tmp_path, "assumed")
    settings: Settings = {"light.layout.count": 200, "tracker.survey.led_sigma": "1 mm"}
    scene = scene_loader.load(
        "coded_spiral", {key: str(value) for key, value in settings.items()}
    )
    total = parts_list(scene, read_prices(find_prices("assumed"))).total
    found, why = search.cost(made, Point({"leds": 200, "survey": "1 mm"}, settings))
    assert (found, why) == (pytest.approx(7 + total, abs=1e-9), "")
    refused, why = search.cost(
        made, Point({}, settings | {"tracker.survey.led_sigma": "1 um"})
    )
    assert math.isnan(refused)
    assert "no survey reaches 0.001 mm" in why


def test_other_prices_are_another_search(tmp_path: Path) -> None:
    text = find_prices("assumed").read_text()
    (tmp_path / "mine.csv").write_text(text)
    first = priced(tmp_path, "mine.csv")
    assert first.digest != priced(tmp_path, "assumed").digest
    (tmp_path / "mine.csv").write_text(text.replace("led,each,0.4", "led,each,0.5"))
    again = priced(tmp_path, "mine.csv")
    assert again.digest != first.digest
    settings: Settings = {"light.layout.count": 200}
    prices = [search.cost(one, Point({}, settings))[0] for one in (first, again)]
    assert prices[1] - prices[0] == pytest.approx(200 * 0.1, abs=0.01)


def test_bad_prices_are_reported_as_errors_of_the_study(tmp_path: Path) -> None:
    with pytest.raises(InputError, match=r"none\.csv: cannot be read: .*study\.yaml"):
        priced(tmp_path, "none.csv")
    with pytest.raises(
        InputError,
        match=r"optimize\.cost\.parts: light of kind stars has no parts; allowed: dome",
    ):
        loaded(tmp_path, changed(cost={"parts": "assumed"}))


def test_the_terminal_s_front_has_levels_error_and_cost(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """A table of the two nondominated candidates of three."""
    study = loaded(
        tmp_path,
        changed(objectives=[{"response": "angle_arcsec_median"}, {"response": "cost"}]),
    ).study
    assert study.optimize is not None
    values = ((40.0, 100.0), (30.0, 200.0), (50.0, 300.0))
    candidates = [
        search.Candidate(n, {"x": 0.25 * n, "y": 0.5}, one, {"angle_arcsec_median": Summary(one[0], 20, 60, 9)}, one[1],
                         True, False, "")
        for n, one in enumerate(values)
    ]  # fmt: skip
    result = search.SearchResult(candidates, search.front(study.optimize, candidates), True)
    heads, cells = search.front_cells(study, result)
    assert heads == ["candidate", "x", "y", "angle_arcsec_median", "cost"]
    assert cells == [
        ["1", "0.25", "0.5", "30 (20..60)", "200"],
        ["0", "0", "0.5", "40 (20..60)", "100"],
    ]
    Report("", front_table(study, result)).print()
    lines = capsys.readouterr().out.splitlines()
    assert lines[0] == "3 candidates, 3 of them feasible; the front:"
    assert [line.split() for line in lines[-2:]] == [" ".join(one).split() for one in cells]
    none = [one._replace(feasible=False) for one in candidates]
    Report("", front_table(study, search.SearchResult(none, [], True))).print()
    assert capsys.readouterr().out == "3 candidates, 0 of them feasible.\n"
    assert search.front_columns(result) == {"front": [1, 0], "costs": [100.0, 200.0, 300.0]}


LEVELS = {"levels": {"cheap": {"trial.missing": 0.1}, "precise": {"trial.missing": 0.0}}}


@pytest.mark.parametrize(
    ("keys", "says"),
    [
        (
            {"cost": {"per": {"radius": 1}}},
            r"optimize\.cost\.per\.radius: unknown factor 'radius'; allowed: x, y, z",
        ),
        ({"cost": {"per": {"z": 1}}}, r"optimize\.cost\.per\.z: 'cheap' is not a number"),
        (
            {"cost": {"levels": {"lens": {}}}},
            r"optimize\.cost\.levels\.lens: unknown factor 'lens'; allowed: x, y, z",
        ),
        (
            {"cost": {"levels": {"z": {"dear": 5, "cheap": 1}}}},
            r"levels\.z: .*allowed: a price of each of cheap, precise",
        ),
        (
            {"cost": {"levels": {"x": {"a": 1}}}},
            r"levels\.x: .*optimize\.cost\.per, as it is a range",
        ),
        (
            {"objectives": [{"response": "beauty"}]},
            r"objectives\.0\.response: unknown response 'beauty'; allowed: .*, or cost",
        ),
        ({"objectives": [{"response": "time_ms_mean"}]}, r"time_ms_mean is not reproducible"),
        (
            {"objectives": [{"response": "cost"}, {"response": "cost"}]},
            r"objectives: cost occurs twice",
        ),
        (
            {"constraints": [{"response": "identified"}]},
            r"constraints\.0: no bound; allowed: at_least, at_most",
        ),
    ],
)
def test_wrong_names_are_answered_with_the_allowed_ones(
    keys: dict[str, Any], says: str
) -> None:
    study = changed(**keys) | {
        "factors": STUDY["factors"] | {"z": LEVELS},
        "budget": {"trials": 1000},
    }
    with pytest.raises(InputError, match=says):
        search.check(plan.Study.model_validate(study))


def test_a_search_must_fit_into_its_budget(tmp_path: Path) -> None:
    keys = changed(candidates=300) | {"budget": {"trials": 1000}}
    allowed = r"budget\.trials: 1000; allowed: at least 1200, the trials of the search"
    with pytest.raises(InputError, match=allowed):
        loaded(tmp_path, keys)


def test_a_distribution_cannot_be_searched() -> None:
    drawn = {"key": "trial.noise_px", "distribution": "normal", "mean": 0.5, "sigma": 0.1}
    with pytest.raises(InputError, match=r"factors\.x: a distribution cannot be optimized"):
        search.check(plan.Study.model_validate(STUDY | {"factors": {"x": drawn}}))


def test_without_optuna_one_line_names_the_extra_to_install(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setitem(sys.modules, "optuna", None)
    with pytest.raises(InputError, match=r"^[^\n]*pip install 'skysim\[optuna\]'$"):
        search.create_sampler(plan.Study.model_validate(STUDY))


@pytest.mark.parametrize(
    "factor",
    [
        {"values": ["1 m", "2 m"]},
        {"from": "1 m", "to": "2 m"},
        {"distribution": "triangular", "low": "1 m", "mode": "1.5 m", "high": "2 m"},
    ],
)
def test_a_factor_sets_several_keys_alike(factor: dict[str, Any]) -> None:
    """Apex and radius of a dome about the bearing."""
    keys = ["light.surface.apex", "light.surface.radius"]
    study = plan.Study.model_validate(STUDY | {"factors": {"size": factor | {"keys": keys}}})
    value, settings = study.factors["size"].value_at(0.75)
    assert settings == dict.fromkeys(keys, value)
    assert 1 < search.si(value) <= 2
    for wrong in ({}, {"key": "a", "keys": ["b"]}):
        with pytest.raises(ValueError, match="needs either key or keys"):
            plan.Study.model_validate(STUDY | {"factors": {"size": factor | wrong}})


@pytest.mark.slow
def test_the_shipped_search_has_its_documented_settings(tmp_path: Path) -> None:
    made = study_file.load("dome_for_the_money")
    search.check(made.study)
    first = {name: factor.value_at(0.5) for name, factor in made.study.factors.items()}
    settings: Settings = {}
    for _, sets in first.values():
        settings |= sets
    scene, _ = plan.resolve_point(made.spec, settings)
    surface: Any = scene.light.surface  # type: ignore[union-attr]
    assert surface.apex_m == surface.radius_m == search.si(first["radius"][0])
    assert scene.vehicle.camera_m == (0.0, 0.0, search.si(first["lever"][0]))
