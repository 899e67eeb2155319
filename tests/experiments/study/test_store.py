"""The store of a study and the distribution of work: a stopped run leaves a complete store that resumes."""

from __future__ import annotations

import os
import random
import re
import signal
import sqlite3
import time
from collections.abc import Callable
from contextlib import closing
from functools import partial
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from skysim.core.errors import InputError
from skysim.experiments.study import plan, study_file
from skysim.experiments.study.execution import runner, store, trials
from skysim.experiments.study.execution.outcomes import Outcome
from skysim.experiments.study.execution.trials import Row, TrialSetup
from skysim.experiments.study.factors import Point
from skysim.experiments.study.report import maps
from tests.helpers.clusters import study
from tests.helpers.study_stores import STRAYS, contents, done, queue_of


@pytest.fixture(scope="module")
def study_plan(tmp_path_factory: pytest.TempPathFactory) -> plan.Plan:
    path = tmp_path_factory.mktemp("study") / "strays.yaml"
    path.write_text(STRAYS)
    return study_file.load(path)


@pytest.fixture(scope="module")
def whole(study_plan: plan.Plan) -> str:
    """Contents of the store of an uninterrupted run."""
    path = study_plan.path.with_name("whole.sqlite")
    assert done(study_plan, path).failed == 0
    return contents(path)


def other(study_plan: plan.Plan, **overrides: str) -> plan.Plan:
    return study_file.load(study_plan.path, overrides)


def child(does: Callable[[], object]) -> int:
    """Fork a process that calls a function; its exit status is 0, 1 for an exception or 2 for KeyboardInterrupt."""
    pid = os.fork()
    if pid:
        return pid
    try:
        signal.signal(signal.SIGINT, signal.default_int_handler)
        does()
        os._exit(0)
    except KeyboardInterrupt:
        os._exit(2)
    finally:
        os._exit(1)


def until(path: Path, count: int) -> None:
    """Wait until a store holds this number of trials."""
    end = time.monotonic() + 20
    while time.monotonic() < end:
        if path.is_file():
            db = sqlite3.connect(path, timeout=20)
            try:
                if db.execute("SELECT COUNT(*) FROM trials").fetchone()[0] >= count:
                    return
            except sqlite3.OperationalError:
                pass  # no tables yet
            finally:
                db.close()
        time.sleep(0.002)
    raise AssertionError(f"{path}: no {count} trials within 20 s")


# One writer, however it ends.


@pytest.mark.long
def test_a_writer_killed_at_any_instant_leaves_whole_batches(
    study_plan: plan.Plan, whole: str, tmp_path: Path
) -> None:
    """A run that is resumed after each kill ends with the store of an uninterrupted run."""
    often = tmp_path / "often.sqlite"
    draw = random.Random(1)
    left = [0]
    for _ in range(6):
        pid = child(partial(done, study_plan, often, resume=left[-1] > 0))
        until(often, min(left[-1] + 1, study_plan.trials))
        time.sleep(0.05 * draw.random())
        os.kill(pid, signal.SIGKILL)
        assert os.waitpid(pid, 0)[1] in (signal.SIGKILL, 0)
        with store.writing(often) as kept:
            assert kept.db.execute("PRAGMA integrity_check").fetchone()[0] == "ok"
            left.append(kept.counts()["done"])
            assert kept.db.execute("SELECT COUNT(*) FROM timings").fetchone()[0] == left[-1]
    assert 0 < left[1] < study_plan.trials
    done(study_plan, often, resume=True)
    assert contents(often) == whole


@pytest.mark.long
def test_a_second_run_on_the_same_store_is_refused(
    study_plan: plan.Plan, tmp_path: Path
) -> None:
    path = tmp_path / "one.sqlite"
    pid = child(lambda: done(study_plan, path, watch=lambda progress: time.sleep(0.05)))
    try:
        until(path, 1)
        with pytest.raises(
            InputError, match="in use by another run; allowed: one run at a time"
        ) as refused:
            done(study_plan, path, resume=True)
        assert "\n" not in str(refused.value)
        with store.open_store(path) as kept:  # who only reads is welcome
            assert 0 < kept.counts()["done"] < study_plan.trials
    finally:
        os.kill(pid, signal.SIGKILL)
        os.waitpid(pid, 0)
    assert done(study_plan, path, resume=True).done == study_plan.trials


@pytest.mark.long
def test_a_run_interrupted_by_the_keyboard_resumes(
    study_plan: plan.Plan, whole: str, tmp_path: Path
) -> None:
    path = tmp_path / "interrupted.sqlite"
    pid = child(lambda: done(study_plan, path, watch=lambda progress: time.sleep(0.02)))
    until(path, 5)
    os.kill(pid, signal.SIGINT)
    assert os.waitstatus_to_exitcode(os.waitpid(pid, 0)[1]) == 2
    with store.open_store(path) as kept:
        (run,) = kept.runs()  # that it ended by itself
        assert 5 <= run["trials"] == kept.counts()["done"] < study_plan.trials
    done(study_plan, path, resume=True)
    assert contents(path) == whole


# What may be resumed.


@pytest.mark.long
def test_another_study_or_other_code_is_refused(
    study_plan: plan.Plan, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    path = tmp_path / "kept.sqlite"
    done(study_plan, path)
    with pytest.raises(InputError, match="contains 120 trials; allowed: to resume the study"):
        done(study_plan, path)
    for key, value in {
        "seed": "2",
        "replicates": "39",
        "set": "{light.limit_mag: 5.5}",
    }.items():
        with pytest.raises(InputError, match="another study"):
            done(other(study_plan, **{key: value}), path, resume=True)
    for key, value in {
        "title": "another",
        "responses": "[wrong]",
        "budget": "{time: 1 h}",
    }.items():
        assert done(other(study_plan, **{key: value}), path, resume=True).now == 0
    monkeypatch.setattr(runner, "code_version", lambda: "0123456789abcdef")
    with pytest.raises(
        InputError, match=r"trials are of skysim .*; allowed: 0123456789abcdef"
    ):
        done(study_plan, path, resume=True)
    with pytest.raises(InputError, match="no trials to resume"):
        done(study_plan, tmp_path / "new.sqlite", resume=True)


@pytest.mark.slow
def test_a_study_with_more_replicates_keeps_existing_trials(
    study_plan: plan.Plan, tmp_path: Path
) -> None:
    more = other(study_plan, replicates="5")
    whole = tmp_path / "whole.sqlite"
    grown = tmp_path / "grown.sqlite"
    done(more, whole)
    done(other(study_plan, replicates="2"), grown)
    assert done(more, grown, resume=True).now == 9
    assert contents(grown) == contents(whole)
    with store.open_store(whole) as kept, store.open_store(grown) as other_store:
        assert kept.meta("replicates") == other_store.meta("replicates") == "5"
        assert (
            len(other_store.columns()["time_ms"])
            == np.count_nonzero(other_store.columns()["time_ms"] > 0)
            == 15
        )
    with pytest.raises(InputError, match="another study"):
        done(other(study_plan, replicates="4"), grown, resume=True)


def test_a_file_that_is_not_a_store_is_refused(tmp_path: Path) -> None:
    path = tmp_path / "text.sqlite"
    path.write_text("ten thousand identifications\n" * 100)
    for opened in (store.open_store, store.writing):
        with pytest.raises(InputError, match=r"text\.sqlite: .*not a database"), opened(path):
            pass
    with (
        pytest.raises(InputError, match="no such store"),
        store.open_store(tmp_path / "none.sqlite"),
    ):
        pass
    with pytest.raises(InputError, match="unable to open"), store.writing(taken(tmp_path)):
        pass


COLUMNS_READ = {  # all but the keys, for which SQLite itself refuses anything but integers
    "meta": ["value"],
    "points": ["levels", "settings"],
    "trials": [name for name in store.COLUMNS if name not in ("trial", *store.TIMES)],
    "timings": list(store.TIMES),
    "runs": ["engine", "workers", "trials", "seconds"],
}


@pytest.mark.parametrize("value", ["x'ff00'", "x'3132'"])  # the second are digits
@pytest.mark.parametrize(
    ("table", "column"),
    [(table, one) for table in COLUMNS_READ for one in COLUMNS_READ[table]],
)
def test_a_value_of_a_wrong_type_is_refused_in_one_line(
    table: str, column: str, value: str, tmp_path: Path
) -> None:
    """SQLite stores any type in any column, so a damaged file can hold bytes where skysim wrote text or numbers."""
    path = tmp_path / "odd.sqlite"
    with store.writing(path) as kept:
        kept.begin([Point({"led": "a"}, {"led": "a"})], code="1", replicates="1")
        kept.add([Row(0, 0, 0, 7, "scene", "code", Outcome("solved", 1, 1), None, 1e-3)])
        kept.record_run("serial", 1, 1, 0.1)
    with closing(sqlite3.connect(path)) as db, db:
        assert db.execute(f"UPDATE {table} SET {column} = {value}").rowcount
    with pytest.raises(InputError) as refused, store.open_store(path) as kept:
        (
            kept.meta("code"),
            kept.points(),
            kept.runs(),
            kept.failures(),
            kept.counts(),
            kept.columns(),
        )
    assert re.fullmatch(
        r"[^\n]*odd\.sqlite: not a valid study store: [^\n]+", str(refused.value)
    )
    assert str(refused.value).count("odd.sqlite") == 1


@pytest.mark.parametrize(
    ("damage", "message"),
    [
        ("trials SET point = -1 WHERE trial = 1", "trial 1, point -1, replicate 1"),
        ("trials SET point = 7 WHERE trial = 1", "trial 1, point 7, replicate 1"),
        ("trials SET replicate = 0 WHERE trial = 1", "trial 1, point 0, replicate 0"),
        ("trials SET trial = -1 WHERE trial = 1", "trial -1, point 0, replicate 1"),
        ("trials SET trial = 9 WHERE trial = 1", "trial 9, point 0, replicate 1"),
        ("meta SET value = '1' WHERE key = 'replicates'", "trial 1, point 0, replicate 1"),
        ("points SET point = 5 WHERE point = 1", "point 5 of 2, levels of led"),
        ("points SET levels = '{}' WHERE point = 1", "point 1 of 2, levels of no factor"),
    ],
)
def test_a_row_that_is_none_of_the_study_s_is_refused(
    damage: str, message: str, tmp_path: Path
) -> None:
    """Its numbers would be indices of other rows: point -1 is the last one."""
    path = tmp_path / "odd.sqlite"
    row = Row(0, 0, 0, 7, "scene", "code", Outcome("solved", 1, 1), None, 1e-3)
    with store.writing(path) as kept:
        kept.begin([Point({"led": one}, {"led": one}) for one in "ab"], replicates="2")
        kept.add([row, row._replace(trial=1, replicate=1), row._replace(trial=2, point=1)])
    with store.open_store(path) as kept:
        assert len(kept.columns()["trial"]) == 3
    with closing(sqlite3.connect(path)) as db, db:
        assert db.execute(f"UPDATE {damage}").rowcount
    for opened in (store.open_store, store.writing):
        with pytest.raises(InputError) as refused, opened(path):
            pass
        assert str(refused.value).startswith(f"{path}: not a valid study store: {message}")
        assert "; allowed: " in str(refused.value)


@pytest.mark.parametrize(
    ("levels", "message"),
    [
        (
            '{"renamed": 0}',
            r": not a valid study store: point 0 of 3, levels of renamed; .*, levels of strays$",
        ),
        (
            "{}",
            r": not a valid study store: point 0 of 3, levels of no factor; .*, levels of strays$",
        ),
        ('{"strays": 7}', r": its points are not the study's"),
        ('{"strays": [1]}', r": its points are not the study's"),
    ],
)
def test_levels_that_are_none_of_the_study_s_are_refused_at_all_points(
    tmp_path: Path, levels: str, message: str
) -> None:
    plan = study(tmp_path, STRAYS.replace("40", "1"))
    path = tmp_path / "odd.sqlite"
    done(plan, path)
    with closing(sqlite3.connect(path)) as db, db:
        assert db.execute("UPDATE points SET levels = ?", (levels,)).rowcount == 3
    with pytest.raises(InputError, match=message):
        done(plan, path, resume=True)


def test_a_study_whose_factors_have_another_order_is_not_resumed(tmp_path: Path) -> None:
    """Its points have other numbers, so that new trials would be stored as those of other levels."""
    factors = (
        "strays: {key: trial.false_lights, values: [0, 5]}",
        "noise: {key: trial.noise_px, values: [0.1, 3]}",
    )
    plans = [
        study(
            tmp_path,
            STRAYS.replace("40", "1").replace(
                "strays: {key: trial.false_lights, values: [0, 5, 9]}", ", ".join(one)
            ),
        )
        for one in (factors, factors[::-1])
    ]
    path = tmp_path / "s.sqlite"
    done(plans[0], path)
    assert plans[0].digest == plans[1].digest
    assert done(plans[0], path, resume=True).now == 0
    with pytest.raises(
        InputError, match=r"factors in another order; allowed: another store, or"
    ):
        done(plans[1], path, resume=True)


def test_several_rows_of_a_trial_are_refused(tmp_path: Path) -> None:
    path = tmp_path / "odd.sqlite"
    row = Row(0, 0, 0, 7, "scene", "code", Outcome("solved", 1, 1), None, 1e-3)
    with store.writing(path) as kept:
        kept.begin([Point({}, {})], replicates="1")
        kept.add([row])
    with closing(sqlite3.connect(path)) as db:
        db.executescript(
            "CREATE TABLE twice AS SELECT * FROM trials UNION ALL SELECT * FROM trials;"
            "DROP TABLE trials; ALTER TABLE twice RENAME TO trials"
        )
    with (
        store.open_store(path) as kept,
        pytest.raises(InputError, match=r"odd\.sqlite: .*several rows of a trial"),
    ):
        kept.columns()


def test_a_store_without_room_for_its_tables_has_none_and_says_so(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """A full disk ends the run between two tables; `resume` then says that there is nothing to resume."""
    path = tmp_path / "s.sqlite"
    with monkeypatch.context() as patch:
        patch.setattr(store, "TABLES", store.TABLES + "INSERT INTO nowhere VALUES (1)")
        with pytest.raises(InputError, match="no such table"), store.writing(path):
            pass
    with pytest.raises(InputError, match="contains no trials"), store.open_store(path):
        pass
    with store.writing(path) as kept:
        kept.begin([], replicates="1")


def test_a_store_on_a_full_disk_says_how_much_room_is_left(tmp_path: Path) -> None:

    def write() -> None:
        with store.writing(tmp_path / "s.sqlite") as kept:
            kept.db.execute("PRAGMA max_page_count = 16")
            kept.begin([Point({}, {"key": "x" * 100_000})], replicates="1")

    with pytest.raises(InputError, match=r"MB are free, nothing is half-written; .*is full"):
        write()


def test_no_points_have_columns_without_rows(tmp_path: Path) -> None:
    """A map with a panel for each level has a level without points if `where` chooses another one."""
    path = tmp_path / "s.sqlite"
    with store.writing(path) as kept:
        kept.begin([], replicates="1")
        kept.add([Row(0, 0, 0, 7, "scene", "code", Outcome("solved", 1, 1), None, 1e-3)])
        columns = kept.point_columns()
        assert len(columns["trial"]) == len(columns["status"]) == 0
        assert maps.direction_map("", columns, "wrong").cells == []


def test_a_resumed_store_with_text_for_a_number_is_refused(tmp_path: Path) -> None:
    path = tmp_path / "odd.sqlite"
    row = Row(0, 0, 0, 7, "scene", "code", Outcome("solved", 1, 1), None, 1e-3)
    with store.writing(path) as kept:
        kept.begin([Point({}, {})], replicates="3")
        kept.add([row._replace(trial=n, replicate=n) for n in range(3)])
    with closing(sqlite3.connect(path)) as db, db:
        db.execute("UPDATE trials SET point = 'two' WHERE trial = 2")
    with (
        pytest.raises(InputError, match=r"odd\.sqlite: .*trial 2, point 'two', replicate 2"),
        store.writing(path),
    ):
        pass


def taken(folder: Path) -> Path:
    """Path of a store whose lock file cannot be created."""
    (folder / "taken.lock").mkdir()
    return folder / "taken.sqlite"


# Budgets.


@pytest.mark.long
def test_a_run_out_of_time_stops_and_resumes(
    study_plan: plan.Plan, whole: str, tmp_path: Path
) -> None:
    path = tmp_path / "short.sqlite"
    short = other(study_plan, budget="{time: 1 us}")
    assert 0 < done(short, path).now < study_plan.trials
    longer = other(study_plan, budget="{time: 30 ms}")
    while (progress := done(longer, path, resume=True)).done < study_plan.trials:
        assert progress.now > 0
    assert contents(path) == whole


def test_trials_that_raise_become_rows_up_to_a_limit(
    study_plan: plan.Plan, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def fragile(ready: TrialSetup, seed: int) -> Outcome:
        if seed % 4 == 0:
            raise ZeroDivisionError(f"of {seed}")
        return Outcome("solved", 1, 1)

    monkeypatch.setitem(trials.TRIALS, "centroids", trials.one_by_one(fragile))
    monkeypatch.setattr(runner, "CHUNK_S", 0.0)  # one trial a chunk
    path = tmp_path / "fragile.sqlite"
    study_plan = other(study_plan, paired="false")
    seeds = [
        trials.seed_of(study_plan.spec, *divmod(trial, 40))
        for trial in range(study_plan.trials)
    ]
    bad = [trial for trial, seed in enumerate(seeds) if seed % 4 == 0]
    stopped = done(other(study_plan, paired="false", budget="{failures: 3}"), path)
    assert (stopped.failed, stopped.done) == (3, bad[2] + 1)
    assert done(study_plan, path, resume=True).failed == len(bad)
    with store.open_store(path) as kept:
        assert kept.counts() == {"done": study_plan.trials, "failed": len(bad), "wrong": 0}
        assert kept.failures() == [
            (trial, f"ZeroDivisionError: of {seeds[trial]}") for trial in bad
        ]
        row = kept.trial(bad[0])
        assert (row["seed"], row["status"], row["frames"]) == (seeds[bad[0]], "failed", 0)
        assert row["error"].startswith("Traceback")
        assert "in fragile" in row["error"]


# Columns.


def test_rows_round_trip_through_the_store(tmp_path: Path) -> None:
    rows = [
        Row(
            1,
            0,
            1,
            2**63 - 1,
            "scene",
            "code",
            Outcome("solved", 1, 1, 0, 1.5, -0.1),
            None,
            2e-3,
        ),
        Row(0, 0, 0, 0, "", "code", Outcome("failed"), "Traceback\nboom", 1e-3),
    ]
    with store.writing(tmp_path / "rows.sqlite") as kept:
        kept.add(rows)
        columns = kept.columns()
        assert list(columns["trial"]) == [0, 1]
        assert columns["seed"].dtype == np.int64
        assert columns["seed"][1] == 2**63 - 1
        assert np.isnan(columns["x_arcsec"][0])
        assert columns["y_arcsec"][1] == -0.1
        assert list(columns["status"]) == ["failed", "solved"]
        assert list(columns["time_ms"]) == [1.0, 2.0]
        assert list(kept.done(3)) == [True, True, False]


def test_a_batch_of_rows_is_stored_whole_or_not_at_all(tmp_path: Path) -> None:
    good = Row(0, 0, 0, 7, "scene", "code", Outcome("solved", 1, 1), None, 1e-3)
    with store.writing(tmp_path / "rows.sqlite") as kept:
        with pytest.raises(sqlite3.IntegrityError):
            kept.add([good, good._replace(trial=1, scene=None)])  # type: ignore[arg-type]
        assert kept.counts()["done"] == 0


# How work is dealt out.


@pytest.mark.long
@settings(max_examples=200, deadline=None)
@given(st.data())
def test_chunks_hold_every_missing_trial_once_and_in_order(data: st.DataObject) -> None:
    first = data.draw(st.integers(0, 5))
    count = data.draw(st.integers(1, 6))
    replicates = data.draw(st.integers(1, 50))
    points = [Point({"n": n}, {"trial.lights": n}) for n in range(first, first + count)]
    span = range(first * replicates, (first + count) * replicates)
    missing = sorted(data.draw(st.sets(st.sampled_from(span))))
    todo = queue_of(points, replicates, np.array(missing, np.int64), first)
    came = []
    size = 1
    while chunk := todo.next():
        for point, changes, number, which in chunk:
            assert changes == {"trial.lights": point}
            assert 0 <= which.start < which.stop <= replicates
            assert number == point * replicates + which.start
            came += [point * replicates + replicate for replicate in which]
        trials_in = sum(len(segment.replicates) for segment in chunk)
        # No more than was allowed for, but to the end of a point where points are smaller than chunks.
        assert trials_in <= size or size >= replicates > trials_in - size
        todo.report_time(chunk, data.draw(st.sampled_from([1e-6, 1e-3, 0.1, 10.0])))
        assert 1 <= todo.size <= max(2 * size, 2 * trials_in, 1)
        size = todo.size
    assert came == missing
    assert not todo.next()


def test_under_a_budget_of_time_no_point_waits_for_another() -> None:
    """Four points of 300 trials of 10 ms, whenever it ends: counts differ by one, later by a fifth; all run at last."""
    points = [Point({"n": n}, {}) for n in range(4)]
    todo = queue_of(points, 300, np.arange(1200), budget="{time: 1 h}")
    ran = set[int]()
    while chunk := todo.next():
        for segment in chunk:
            ran |= {segment.first + n for n in range(len(segment.replicates))}
            assert segment.point == segment.first // 300
            assert segment.replicates[0] == segment.first % 300
        todo.report_time(chunk, 0.01 * sum(len(one.replicates) for one in chunk))
        counts = np.bincount([trial // 300 for trial in ran], minlength=4)
        assert counts.max() <= max(counts.min() + 1, 2**0.25 * (counts.min() + 1))
    assert ran == set(range(1200))


def test_a_study_with_a_budget_of_time_fills_its_points_together(
    study_plan: plan.Plan, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(runner, "CHUNK_S", 0.0)  # one trial a chunk
    limited = other(study_plan, budget="{time: 1 h}")

    def stop(progress: runner.Progress) -> None:
        if progress.now == 7:
            raise KeyboardInterrupt

    path = tmp_path / "budget.sqlite"
    with pytest.raises(KeyboardInterrupt):
        done(limited, path, watch=stop)
    with store.open_store(path) as kept:
        came = kept.columns()["point"].tolist()
    assert np.bincount(came).tolist() == [3, 2, 2]


def test_chunks_are_sized_by_time() -> None:
    """Trials of 10 ms: chunks double until they take CHUNK_S, and shrink as trials take longer."""
    point = [Point({}, {})]
    todo = queue_of(point, 10_000, np.arange(10_000))
    sizes = []
    for trial_s in [0.01] * 8 + [0.1] * 2:
        chunk = todo.next()
        sizes.append(sum(len(segment.replicates) for segment in chunk))
        todo.report_time(chunk, sizes[-1] * trial_s)
    wanted = int(runner.CHUNK_S / 0.01)
    assert sizes[:8] == [min(2**n, wanted) for n in range(8)]
    assert sizes[9] == int(runner.CHUNK_S / 0.1)


@pytest.mark.parametrize(
    ("workers", "rate_hz"), [(1, 4), (2, 8), (16, 64), (64, 64), (1000, 64)]
)
def test_the_rate_of_completed_chunks_is_bounded_for_many_workers(
    workers: int, rate_hz: float
) -> None:
    """Of trials of 10 ms: the chunks of a second, from their size."""
    todo = queue_of([Point({}, {})], 100_000, np.arange(100_000), workers=workers)
    size = 0
    for _ in range(14):
        size = sum(len(segment.replicates) for segment in todo.next())
        todo.report_time((trials.Segment(0, {}, 0, range(size)),), size * 0.01)
    assert workers / (size * 0.01) == pytest.approx(rate_hz, rel=0.05)
