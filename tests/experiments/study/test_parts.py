"""Rows beyond a million: Parquet parts and SQLite together are one table, also after a kill at any time."""

from __future__ import annotations

import os
import random
import signal
import sqlite3
import time
from collections.abc import Callable
from contextlib import closing
from functools import partial
from multiprocessing import forkserver
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from skysim.core.errors import InputError
from skysim.experiments.study import plan, study_file, table, worst
from skysim.experiments.study.execution import engines, runner, store, workers
from skysim.experiments.study.execution.outcomes import Outcome
from skysim.experiments.study.execution.trials import Row
from skysim.experiments.study.factors import Point
from skysim.experiments.study.report import study_export
from skysim.results.files import row_parts
from tests.helpers.study_stores import STRAYS, done

pytest.importorskip("pyarrow")
POINTS = 3
EACH = 40
BATCH = 10
POINT = [Point({"strays": n}, {"trial.false_lights": n}) for n in range(POINTS)]


@pytest.fixture(autouse=True)
def _small(monkeypatch: pytest.MonkeyPatch) -> None:
    for name, size in {"MOST_ROWS": 50, "PART_ROWS": 20, "BLOCK_TRIALS": 30}.items():
        monkeypatch.setattr(store, name, size)


def row(trial: int, failed: bool = False, each: int = EACH) -> Row:
    """A row with a number or no value in every column, and directions over the whole sky."""
    point, replicate = divmod(trial, each)
    rng = np.random.default_rng([point, replicate])
    if failed:
        return Row(
            trial,
            point,
            replicate,
            7 * replicate,
            "",
            "code",
            Outcome("failed"),
            f"Traceback\nat {trial}",
            0.1,
        )
    errors = rng.normal(size=3).tolist() if replicate % 7 else [np.nan] * 3
    result = Outcome(
        "solved" if replicate % 7 else "refused",
        1,
        int(replicate % 7 > 0),
        int(replicate == 8),
        *errors,
    )
    for name in ("boresight_ra_deg", "boresight_dec_deg", "stars", "centroid_px"):
        setattr_frozen(result, name, float(rng.uniform(0, 60)))
    return Row(
        trial,
        point,
        replicate,
        7 * replicate,
        f"scene {point}",
        "code",
        result,
        None,
        1e-3 * (1 + replicate),
    )


def setattr_frozen(outcome: Outcome, name: str, value: float) -> None:
    object.__setattr__(outcome, name, value)


def begun(path: Path, each: int = EACH) -> Any:
    """A store for writing, of POINTS points."""
    opened = store.writing(path)

    class Begun:
        def __enter__(self) -> store.Store:
            self.kept = opened.__enter__()
            self.kept.begin(
                POINT,
                replicates=str(each),
                title="strays",
                code="code",
                study="title: strays",
            )
            return self.kept

        def __exit__(self, *error: Any) -> None:
            opened.__exit__(*error)

    return Begun()


def add_all(kept: store.Store, rows: list[Row]) -> None:
    for first in range(0, len(rows), BATCH):
        kept.add(rows[first : first + BATCH])


def filled(path: Path, rows: list[Row], parts: bool = True) -> Path:
    with pytest.MonkeyPatch.context() as patch:
        if not parts:
            patch.setattr(row_parts, "can_write_parts", lambda: False)
        with begun(path) as kept:
            add_all(kept, rows)
    return path


def whole(path: Path) -> dict[str, list[Any]]:
    """Every column as values, for comparison: NaN as None, with their types."""
    with store.open_store(path) as kept:
        columns = kept.columns()
        return {
            name: [store.to_sql(value) for value in columns[name].tolist()]
            for name in columns
        }


def in_sqlite(path: Path) -> int:
    db = sqlite3.connect(path)
    try:
        return int(db.execute("SELECT COUNT(*) FROM trials").fetchone()[0])
    finally:
        db.close()


ALL = [row(trial) for trial in range(POINTS * EACH)]


@pytest.fixture(scope="module")
def both(tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, Path]:
    """The same rows, out of order and some of them failed, in SQLite alone and with parts."""
    folder = tmp_path_factory.mktemp("both")
    rows = [row(trial, failed=trial % 29 == 5) for trial in range(POINTS * EACH)]
    random.Random(3).shuffle(rows)
    rows = sorted(rows[:100], key=lambda one: one.trial // 60) + rows[100:]
    with pytest.MonkeyPatch.context() as patch:
        for name, size in {"MOST_ROWS": 50, "PART_ROWS": 20}.items():
            patch.setattr(store, name, size)
        return filled(folder / "one.sqlite", rows, parts=False), filled(
            folder / "parts.sqlite", rows
        )


# One table.


def test_rows_beyond_the_limit_are_moved_to_parts(tmp_path: Path) -> None:
    path = filled(tmp_path / "s.sqlite", ALL)
    files = sorted((tmp_path / "s.parts").iterdir())
    assert [file.name for file in files] == [f"{n:06d}.parquet" for n in range(1, 6)]
    assert in_sqlite(path) == 20
    assert all(len(row_parts.read_column(file, "seed")) == 20 for file in files)
    few = filled(tmp_path / "few.sqlite", ALL[:50])
    assert (in_sqlite(few), (tmp_path / "few.parts").exists()) == (50, False)
    assert whole(path)["trial"] == list(range(POINTS * EACH))


@pytest.mark.slow
def test_rows_of_store_and_parts_are_one_table(both: tuple[Path, Path]) -> None:
    one, other = both
    assert (in_sqlite(one), in_sqlite(other)) == (120, 20)
    assert whole(one) == whole(other)
    with store.open_store(one) as kept, store.open_store(other) as parted:
        assert parted.counts() == kept.counts() == {"done": 120, "failed": 4, "wrong": 3}
        assert (
            parted.done(130).tolist()
            == kept.done(130).tolist()
            == [True] * 120 + [False] * 10
        )
        assert parted.failures() == kept.failures()
        assert parted.scenes() == kept.scenes()
        assert parted.trial_range() == kept.trial_range() == "0 to 119"
        for trial in range(0, 120, 7):
            assert parted.trial(trial) == kept.trial(trial)
            assert list(map(type, parted.trial(trial).values())) == list(
                map(type, kept.trial(trial).values())
            )
        with pytest.raises(InputError, match=r"trial 120: not in .*; allowed: 0 to 119"):
            parted.trial(120)
        for points in [(0,), (1,), (2,), (0, 2), (0, 1, 2), (1,), (3,)]:
            same(parted.point_columns(*points), kept.point_columns(*points))
        columns = parted.columns()
        for number in range(0, 120, 7):
            same(columns.row(number), row_parts.subset(columns, slice(number, number + 1)))
        same(parted.columns(failed=False), kept.columns(failed=False))
        assert len(parted.columns(failed=False)["trial"]) == 116


def same(columns: Any, others: Any) -> None:
    assert list(columns) == list(others)
    for name in columns:
        np.testing.assert_array_equal(columns[name], others[name])
        assert columns[name].dtype == others[name].dtype


@pytest.mark.parametrize("suffix", ["csv", "parquet"])
def test_exports_with_and_without_parts_have_the_same_bytes(
    both: tuple[Path, Path], tmp_path: Path, suffix: str
) -> None:
    for path in both:
        with store.open_store(path) as kept:
            study_export.export(kept, ("identified",), tmp_path / f"{path.stem}.{suffix}")
    one, parts = ((tmp_path / f"{path.stem}.{suffix}").read_bytes() for path in both)
    assert one == parts
    assert len(one) > 4000


def test_an_export_reads_the_trials_in_batches(
    both: tuple[Path, Path], tmp_path: Path
) -> None:
    pyarrow = pytest.importorskip("pyarrow.parquet")
    with store.open_store(both[1]) as kept, pytest.MonkeyPatch.context() as patch:
        patch.delattr(store.Store, "columns")
        assert [len(block["trial"]) for block in kept.blocks()] == [30, 30, 30, 30]
        study_export.export(kept, ("identified",), tmp_path / "rows.parquet")
        study_export.export(kept, ("identified",), tmp_path / "rows.csv")
    assert pyarrow.ParquetFile(tmp_path / "rows.parquet").num_row_groups == 4
    found = pyarrow.read_table(tmp_path / "rows.parquet").to_pydict()
    assert {name: found[name] for name in store.COLUMNS} == whole(both[1])
    assert found["strays"] == np.repeat([0, 1, 2], EACH).tolist()


def test_tables_and_worst_trials_do_not_depend_on_parts(both: tuple[Path, Path]) -> None:
    asked = plan.Study.model_validate(
        {
            "schema": 1,
            "title": "strays",
            "scene": "shefex2",
            "seed": 1,
            "trial": {"kind": "centroids"},
        }
        | {
            "factors": {"strays": {"key": "trial.false_lights", "values": [0, 1, 2]}},
            "responses": ["identified"],
        }
    )
    names = ("identified", "cross_arcsec_rms", "roll_arcsec_p90", "failed", "time_ms_mean")
    found = []
    for path in both:
        with store.open_store(path) as kept:
            rows = table.table(kept, names)
            chosen = [
                worst.worst_of_levels(asked, kept, "roll_arcsec", {"strays": n})
                for n in range(POINTS)
            ]
            found.append(repr((rows, chosen)))
    assert found[0] == found[1]


# Kept through everything.


class Killer:
    """Kill this process by SIGKILL in the named step of a move."""

    def __init__(self, step: str) -> None:
        self.step = step
        self.listed = False

    def __call__(self, step: str) -> None:
        if step == self.step:
            os.kill(os.getpid(), signal.SIGKILL)

    def trace(self, sql: str) -> None:
        """A statement of the writer's connection, before it is executed."""
        for start in ("INSERT INTO parts", "DELETE FROM trials", "DELETE FROM timings"):
            if sql.startswith(start):
                self.listed = True
                self(start)
        if self.listed and sql.startswith("COMMIT"):
            self("COMMIT")
        if self.listed and sql.startswith("INSERT OR REPLACE INTO trials"):
            self("next batch")


STEPS = ["arrow", "written", "rename", "renamed"]
STEPS += [
    "INSERT INTO parts",
    "DELETE FROM trials",
    "DELETE FROM timings",
    "COMMIT",
    "next batch",
]


def die_in_step(path: Path, step: str) -> None:
    """Add rows until the step of a move in which this process is killed."""
    kill = Killer(step)
    sync = row_parts.sync
    to_arrow = row_parts.to_arrow
    replace = os.replace

    def dying(before: str, does: Callable[..., Any]) -> Callable[..., Any]:
        return lambda *arguments: (kill(before), does(*arguments))[1]

    row_parts.to_arrow = dying("arrow", to_arrow)
    row_parts.sync = lambda path: dying("renamed" if path.is_dir() else "written", sync)(path)
    os.replace = dying("rename", replace)
    with begun(path) as kept:
        kept.db.set_trace_callback(kill.trace)
        add_all(kept, ALL)


def forked(does: Callable[[], object]) -> int:
    """Exit status of a forked process that calls a function."""
    pid = os.fork()
    if pid == 0:
        try:
            does()
        finally:
            os._exit(0)
    return os.waitstatus_to_exitcode(os.waitpid(pid, 0)[1])


@pytest.mark.slow
@pytest.mark.parametrize("step", STEPS)
def test_a_kill_in_any_step_of_a_move_loses_and_duplicates_no_row(
    step: str, tmp_path: Path
) -> None:
    path = tmp_path / "s.sqlite"
    assert forked(partial(die_in_step, path, step)) == -signal.SIGKILL
    files = sorted((tmp_path / "s.parts").iterdir())
    assert len(files) == {"arrow": 0, "next batch": 3}.get(step, 1)
    kept_rows = 0 if step == "next batch" else 60
    assert in_sqlite(path) == kept_rows
    expected = {
        name: values[:60]
        for name, values in whole(filled(tmp_path / "whole.sqlite", ALL)).items()
    }
    assert whole(path) == expected
    with store.writing(path) as kept:
        # What is not listed is gone, and the move that was cut off is made up for.
        assert sorted(part.path for part in kept.parts()) == sorted(
            (tmp_path / "s.parts").iterdir()
        )
        assert (
            kept.db.execute("SELECT COUNT(*) FROM timings").fetchone()[0]
            == in_sqlite(path)
            < 50
        )
        assert kept.counts()["done"] == 60
        add_all(kept, ALL[60:])
    assert whole(path) == whole(tmp_path / "whole.sqlite")


@pytest.mark.slow
@pytest.mark.parametrize("engine", ["serial", pytest.param("pool", marks=pytest.mark.long)])
def test_killed_at_any_instant_a_study_ends_with_the_same_rows(
    engine: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Six kills of the process that stores, while it moves rows every few milliseconds."""
    (tmp_path / "strays.yaml").write_text(STRAYS)
    study_plan = study_file.load(tmp_path / "strays.yaml")
    draw = random.Random(2)
    done(study_plan, tmp_path / "whole.sqlite")
    often = tmp_path / "often.sqlite"
    killed = 0
    monkeypatch.setattr(runner, "CHUNK_S", 0.0)  # one trial a chunk
    workers.start_fork_server()  # as an earlier test may have done

    def run(pause_s: float = 0.02) -> None:
        runs = engines.Serial() if engine == "serial" else engines.Pool(2)
        done(study_plan, often, runs, stored() > 0, lambda progress: time.sleep(pause_s))

    def stored() -> int:
        try:
            with store.open_store(often) as kept:
                return kept.counts()["done"]
        except InputError:  # no store yet
            return 0

    for _ in range(6):
        pid = os.fork()
        before = stored()
        end = time.monotonic() + 30
        if pid == 0:
            try:
                # The fork server is no child of this process, which needs its own.
                forkserver._forkserver._forkserver_pid = None  # type: ignore[attr-defined]
                run()
            finally:
                os._exit(0)
        while stored() == before < study_plan.trials and time.monotonic() < end:
            time.sleep(0.005)
        time.sleep(draw.uniform(0.0, 0.3))
        os.kill(pid, signal.SIGKILL)
        killed += os.waitpid(pid, 0)[1] == signal.SIGKILL
        if often.is_file():
            numbers = whole(often)["trial"]
            assert len(numbers) == len(set(numbers))
    assert killed >= 3
    run(0.0)
    without_time = [
        {k: v for k, v in whole(path).items() if k not in store.TIMES}
        for path in (tmp_path / "whole.sqlite", often)
    ]
    assert without_time[0] == without_time[1]
    assert len(list((tmp_path / "often.parts").iterdir())) >= 4


def test_files_that_are_not_listed_are_removed(tmp_path: Path) -> None:
    """Those of a run that was killed, and those of a study whose store was deleted."""
    path = filled(tmp_path / "s.sqlite", ALL)
    stray = tmp_path / "s.parts/000009.parquet"
    stray.write_bytes((tmp_path / "s.parts/000001.parquet").read_bytes())
    with store.open_store(path) as kept:  # who only reads removes nothing
        assert kept.counts()["done"] == len(kept.columns()["trial"]) == 120
        assert stray.is_file()
    with store.writing(path) as kept:
        assert not stray.exists()
        assert kept.counts()["done"] == len(kept.columns()["trial"]) == 120
    path.unlink()
    with store.writing(path) as kept:
        assert not list((tmp_path / "s.parts").iterdir())
        assert len(kept.columns()["trial"]) == 0


def test_a_study_with_parts_grows(tmp_path: Path) -> None:
    """Trials get new numbers, including those in parts."""
    rows = [row(point * 50 + n, each=50) for point in range(POINTS) for n in range(50)]
    with begun(tmp_path / "whole.sqlite", 50) as kept:
        add_all(kept, rows)
    path = filled(tmp_path / "s.sqlite", ALL)
    with store.writing(path) as kept:
        kept.point_columns(1)
        kept.begin(POINT, (EACH, 50), replicates="50")
        numbers = kept.columns()["trial"].tolist()
        assert numbers == [point * 50 + n for point in range(POINTS) for n in range(EACH)]
        assert np.flatnonzero(kept.done(150)).tolist() == numbers
        assert kept.point_columns(1)["replicate"].tolist() == list(range(EACH))
        add_all(kept, [one for one in rows if one.replicate >= EACH])
    assert whole(path) == whole(tmp_path / "whole.sqlite")


def test_failed_trials_are_run_again(tmp_path: Path) -> None:
    rows = [row(trial, failed=trial % 10 == 3) for trial in range(POINTS * EACH)]
    path = filled(tmp_path / "s.sqlite", rows)
    with store.writing(path) as kept:
        kept.delete_failed()
        missing = np.flatnonzero(~kept.done(POINTS * EACH)).tolist()
        assert missing == list(range(3, POINTS * EACH, 10))
        kept.add([ALL[trial] for trial in missing])
    assert whole(path) == whole(filled(tmp_path / "whole.sqlite", ALL))


def test_failed_trials_stay_in_the_store(tmp_path: Path) -> None:
    path = filled(
        tmp_path / "s.sqlite", [row(trial, failed=True) for trial in range(POINTS * EACH)]
    )
    assert in_sqlite(path) == POINTS * EACH
    assert not list(tmp_path.glob("s.parts/*"))


def test_a_reader_sees_one_consistent_state(tmp_path: Path) -> None:
    """Rows that are moved during a read are seen exactly once."""
    path = filled(tmp_path / "s.sqlite", ALL[:50])
    with store.writing(path) as kept, store.open_store(path) as reader:

        def move(sql: str) -> None:
            if "LEFT JOIN timings" in sql and in_sqlite(path) == 50:
                kept.add(ALL[50:60])

        reader.db.set_trace_callback(move)
        before = reader.columns()
        reader.db.set_trace_callback(None)
        assert in_sqlite(path) < 50
        assert before["trial"].tolist() == list(range(50))
        assert reader.columns()["trial"].tolist() == list(range(60))
        assert reader.point_columns(0)["replicate"].tolist() == list(range(EACH))


def test_a_search_reads_the_rows_it_has_just_added(tmp_path: Path) -> None:
    """Points are read together with their neighbors, but never from before the last rows."""
    with begun(tmp_path / "s.sqlite") as kept:
        add_all(kept, ALL[:90])
        assert len(kept.point_columns(2)["trial"]) == 10
        kept.add(ALL[90:100])
        assert len(kept.point_columns(2)["trial"]) == 20


# What can be wrong with them.


def test_a_part_that_is_missing_or_damaged_is_named(tmp_path: Path) -> None:
    path = filled(tmp_path / "s.sqlite", ALL)
    part = tmp_path / "s.parts/000002.parquet"
    data = part.read_bytes()
    for change in (
        lambda: part.write_bytes(data[:-9]),
        lambda: part.write_bytes(b"no"),
        part.unlink,
    ):
        change()
        with (
            store.open_store(path) as kept,
            pytest.raises(InputError, match=r"000002\.parquet: not a valid part") as found,
        ):
            kept.columns()
        assert "\n" not in str(found.value)


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (
            "UPDATE parts SET rows = 7 WHERE part = 2",
            r"000002\.parquet: has \d+ rows; allowed: 7",
        ),
        (
            "UPDATE parts SET last = 'x' WHERE part = 2",
            r"s\.sqlite: not a valid study store: .*'x'",
        ),
        (
            "UPDATE parts SET wrong = x'31' WHERE part = 2",
            r"s\.sqlite: not a valid study store: .*b'1'",
        ),
        (
            "UPDATE parts SET rows = -1 WHERE part = 2",
            r"000002\.parquet: has \d+ rows; allowed: -1",
        ),
        (
            "UPDATE parts SET last = 0 WHERE part = 3",
            r"000003\.parquet: not a valid part .* allowed: 0 to 0, 0 to 39",
        ),
        (
            "UPDATE meta SET value = '0' WHERE key = 'replicates'",
            r"s\.sqlite: not a valid study store: trial 100, .* of 3 points and 0 replicates",
        ),
        (
            "UPDATE parts SET last = 7 WHERE part = 3",
            r"s\.sqlite: not a valid study store: .*'no point 7'",
        ),
    ],
)
def test_an_invalid_list_of_parts_is_refused_in_one_line(
    change: str, message: str, tmp_path: Path
) -> None:
    path = filled(tmp_path / "s.sqlite", ALL)
    with closing(sqlite3.connect(path)) as db, db:
        assert db.execute(change).rowcount
    with pytest.raises(InputError, match=message), store.open_store(path) as kept:
        kept.trial_range()


@pytest.mark.parametrize(
    ("column", "values"),
    [
        ("point", lambda point: point.astype(str).astype(object)),
        ("point", lambda point: point + 0.5),
        ("point", lambda point: -1 - point),
        ("replicate", lambda replicate: replicate + 100),
        ("replicate", lambda replicate: replicate[:1]),
    ],
)
def test_a_part_with_invalid_values_is_refused_in_one_line(
    column: str, values: Callable[[Any], Any], tmp_path: Path
) -> None:
    path = filled(tmp_path / "s.sqlite", ALL)
    part = tmp_path / "s.parts/000002.parquet"
    columns = {
        name: row_parts.read_column(part, name) for name in store.COLUMNS if name != "trial"
    }
    changed = columns | {column: values(columns[column])}
    row_parts.write_part(
        part, {name: one[: len(changed[column])] for name, one in changed.items()}
    )
    for read in (store.Store.trial_range, store.Store.scenes, lambda kept: kept.done(10)):
        with (
            store.open_store(path) as kept,
            pytest.raises(InputError, match=r"^[^\n]*000002\.parquet: [^\n]+$"),
        ):
            read(kept)


def test_an_earlier_skysim_refuses_a_store_with_parts(tmp_path: Path) -> None:
    """It would not see their rows; a store without parts is unchanged and has no table of parts."""
    with store.open_store(filled(tmp_path / "s.sqlite", ALL)) as kept:
        assert kept.meta("format") == str(store.FORMAT_OF_PARTS)
    with store.writing(filled(tmp_path / "few.sqlite", ALL[:20])) as kept:
        kept.db.execute("DROP TABLE parts")
    with store.open_store(tmp_path / "few.sqlite") as kept:
        assert kept.meta("format") == str(store.FORMAT)
        assert kept.counts()["done"] == len(kept.columns()["trial"]) == 20


def test_columns_are_dropped_when_they_are_too_many_to_keep(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    asked: list[str] = []

    def source(name: str) -> np.ndarray:
        asked.append(name)
        return np.arange(100.0)

    rows = row_parts.Rows(("a", "b", "c"), [source], [100], np.arange(100)[::-1])
    assert rows["a"] is rows["a"]
    monkeypatch.setattr(row_parts, "KEPT_BYTES", 1000)
    for name in ("b", "c", "a", "a"):
        assert rows[name][0] == 99.0
    assert asked == ["a", "b", "c", "a"]
    with pytest.raises(KeyError):
        rows["d"]
