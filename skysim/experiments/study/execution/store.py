"""Store of a study's trials: one SQLite file with one row per trial, written by one run at a time.

Tables `trials` and `points` depend only on the study; engine, time and speed are in `timings` and `runs`. Every batch
of rows is one transaction of a write-ahead log, so a killed run leaves only complete batches.

If there are more than MOST_ROWS rows, they move, PART_ROWS at a time, to Parquet files in the folder `study.parts`
beside the SQLite file, lowest trial numbers first. SQLite keeps the list of the files, and the failed trials, which may
be run again. A part is written and synced under a temporary name and renamed; then one transaction lists it and deletes
its rows. A run that is killed before that leaves a file that is not listed, which the next run removes. Parts are never
changed. They hold point and replicate, from which the trial's number follows, since the number changes when a study
grows. All methods of `Store` treat the rows of both as one table.
"""

import json
import math
import sqlite3
import time
from collections.abc import Iterable, Iterator, Sequence
from contextlib import closing, contextmanager
from operator import attrgetter
from pathlib import Path
from typing import Any

import numpy as np

from skysim.core.errors import InputError
from skysim.core.files import make_folder, remove, room_left
from skysim.core.types import Array, Bools, Record
from skysim.experiments.study.execution.outcomes import FIELDS
from skysim.experiments.study.execution.trials import Row
from skysim.experiments.study.factors import Point
from skysim.results.files import row_parts
from skysim.results.files.row_parts import Part, Rows

STORE = "study.sqlite"  # file name in a study's results folder
FORMAT = 10  # raised when the columns of `trials` or `timings` change
FORMAT_OF_PARTS = 11  # format of a store with parts, which an earlier skysim would not see
MOST_ROWS = 1_000_000  # maximum number of rows in SQLite; beyond, rows move to parts
PART_ROWS = 250_000  # rows of a part, about 50 MB in memory
EVERY = (0, 2**62)  # range of all trials
BLOCK_TRIALS = 100_000  # trial numbers of a block of `Store.blocks`
TEXT_FIELDS = {"status"}
INTEGER_FIELDS = {"frames", "solved", "wrong", "ambiguous"}

TIMES = ("time_ms", "detect_ms", "computer_ms")
# Names of `Store.columns`.
COLUMNS = ("trial", "point", "replicate", "seed", "scene", "code", *FIELDS, "error", *TIMES)

SQL_TYPES = dict.fromkeys(TEXT_FIELDS, "TEXT") | dict.fromkeys(INTEGER_FIELDS, "INTEGER")
OUTCOME_COLUMNS = ", ".join(f"{name} {SQL_TYPES.get(name, 'REAL')}" for name in FIELDS)

TABLES = f"""
CREATE TABLE IF NOT EXISTS meta (key TEXT PRIMARY KEY, value TEXT NOT NULL);
CREATE TABLE IF NOT EXISTS points (point INTEGER PRIMARY KEY, levels TEXT NOT NULL, settings TEXT NOT NULL);
CREATE TABLE IF NOT EXISTS trials (
  trial INTEGER PRIMARY KEY, point INTEGER NOT NULL, replicate INTEGER NOT NULL, seed INTEGER NOT NULL,
  scene TEXT NOT NULL, code TEXT NOT NULL,
  {OUTCOME_COLUMNS},
  error TEXT);
CREATE TABLE IF NOT EXISTS timings (trial INTEGER PRIMARY KEY, time_ms REAL NOT NULL, detect_ms REAL, computer_ms REAL);
CREATE TABLE IF NOT EXISTS runs (
  run INTEGER PRIMARY KEY, began REAL NOT NULL, engine TEXT NOT NULL, workers INTEGER NOT NULL,
  trials INTEGER NOT NULL, seconds REAL NOT NULL);
CREATE TABLE IF NOT EXISTS parts (
  part INTEGER PRIMARY KEY, rows INTEGER NOT NULL, wrong INTEGER NOT NULL, first INTEGER NOT NULL,
  last INTEGER NOT NULL);
"""

# What is wrong with the first row that is none of the study's, and what is allowed. A point's number is its place in
# the list of points, and the numbers of a trial follow from one another, so that each of them can serve as an index.
STRAY = """
WITH study AS (
  SELECT COALESCE(MAX(CAST(value AS INTEGER)), 0) AS each, (SELECT COUNT(*) FROM points) AS points,
    COALESCE((SELECT value FROM meta WHERE key = 'factors'), (SELECT group_concat(key, ', ') FROM json_each(
      (SELECT levels FROM points ORDER BY point LIMIT 1)))) AS factors FROM meta WHERE key = 'replicates')
SELECT 'not a valid study store: trial ' || trial || ', point ' || quote(point) || ', replicate ' || quote(replicate),
  'trial ' || each || ' * point + replicate, of ' || points || ' points and ' || each || ' replicates'
FROM trials, study
WHERE trial < 0 OR trial >= each * points OR point IS NOT trial / each OR replicate IS NOT trial % each
UNION ALL
SELECT 'not a valid study store: point ' || point || ' of ' || points || ', levels of '
  || COALESCE((SELECT group_concat(key, ', ') FROM json_each(levels)), 'no factor'),
  'points from 0 on, levels of ' || COALESCE(factors, 'no factor')
FROM points, study
WHERE point < 0 OR point >= points OR (SELECT group_concat(key, ', ') FROM json_each(levels)) IS NOT factors
LIMIT 1
"""

# The values of an outcome; `astuple` takes twenty times longer.
values_of = attrgetter(*FIELDS)
times_of = attrgetter(*TIMES[1:])
INSERT = f"INSERT OR REPLACE INTO trials VALUES ({', '.join('?' * (7 + len(FIELDS)))})"


NONE_NEAR = (range(0), Rows((), (), ()))


class Store:
    """An open store of one study. `open_store` opens one for reading, `writing` makes or opens one for writing."""

    def __init__(self, path: Path, connection: sqlite3.Connection) -> None:
        self.path = path
        self.db = connection
        self.execute = connection.execute
        self.parts_folder = path.with_suffix(".parts")
        # Further rows that SQLite takes before rows move; 0 before they are counted.
        self._room = 0
        self._parts: dict[int, Part] = {}  # open parts by number
        self._near = NONE_NEAR  # points that were read together with the last one

    def meta(self, key: str) -> str:
        """The value of a metadata key; empty if it is not set."""
        row = self.execute("SELECT value FROM meta WHERE key = ?", (key,)).fetchone()
        return self.checked(row, str)[0] if row else ""

    def overrides(self) -> dict[str, str]:
        """Overrides of study keys from the run's command line: YAML text by key. Raises InputError."""
        with self.corruption_as_input_error():
            overrides = json.loads(self.meta("overrides") or "{}")
            if not isinstance(overrides, dict) or not all(
                isinstance(v, str) for v in overrides.values()
            ):
                raise ValueError("overrides are not text values by key")
            return overrides

    def begin(
        self, points: Iterable[Point], grown: tuple[int, int] | None = None, **values: str
    ) -> None:
        """Set the study's points and metadata in one transaction.

        Parameters
        ----------
        grown
            Replicates of the stored trials and of the study, if the study has more. Trials are
            renumbered as point * replicates + replicate
        """
        with self.db:
            if grown:
                number = "trial / {0} * {1} + trial % {0}".format(*grown)
                for table in ("trials", "timings"):
                    # Negative numbers first, since a new number may be the old one of another row.
                    self.execute(f"UPDATE {table} SET trial = -1 - ({number})")
                    self.execute(f"UPDATE {table} SET trial = -1 - trial")
            self.execute("DELETE FROM points")
            self._insert_points(points)
            self.db.executemany("INSERT OR REPLACE INTO meta VALUES (?, ?)", values.items())
        self._near = NONE_NEAR

    def scenes(self) -> list[tuple[int, int, str]]:
        """Point, replicate and scene hash of the first and the last trial that did not fail."""
        query = (
            "SELECT point, replicate, scene FROM trials WHERE scene != '' AND error IS NULL "
            "ORDER BY trial {} LIMIT 1"
        )
        with self.snapshot():
            found = [
                row for order in ("ASC", "DESC") for row in self.execute(query.format(order))
            ]
            for part in self.parts():
                part.trials(self._replicates())  # is as listed
                columns = (
                    row_parts.read_column(part.path, name)[[0, -1]].tolist()
                    for name in ("point", "replicate", "scene")
                )
                found += zip(*columns, strict=True)
        found = [self.checked(row, int, int, str) for row in found]
        return [min(found), max(found)] if found else []

    def delete_failed(self) -> None:
        """Delete the failed trials, so that they are run again."""
        with self.db:
            self.execute("DELETE FROM trials WHERE error IS NOT NULL")

    def set_points(self, points: Iterable[Point], first: int = 0) -> None:
        """Insert or replace points, numbered from `first`."""
        with self.db:
            self._insert_points(points, first)

    def _insert_points(self, points: Iterable[Point], first: int = 0) -> None:
        rows = (
            (
                n,
                json.dumps(point.levels, default=str),
                json.dumps(point.settings, default=str),
            )
            for n, point in enumerate(points, first)
        )
        self.db.executemany("INSERT OR REPLACE INTO points VALUES (?, ?, ?)", rows)

    def points(self) -> list[Point]:
        """All points, in order. Raises InputError."""
        rows = self.execute("SELECT levels, settings FROM points ORDER BY point")
        with self.corruption_as_input_error():
            return [Point(*self.checked(map(json.loads, row), dict, dict)) for row in rows]

    def add(self, rows: list[Row]) -> None:
        """Store rows in one transaction."""
        values = [(*row[:6], *map(to_sql, values_of(row.outcome)), row.error) for row in rows]
        with self.db:
            self.db.executemany(INSERT, values)
            times = [
                (row.trial, 1e3 * row.seconds, *map(to_sql, times_of(row.outcome)))
                for row in rows
            ]
            self.db.executemany("INSERT OR REPLACE INTO timings VALUES (?, ?, ?, ?)", times)
        self._near = NONE_NEAR
        self._room -= len(rows)
        if self._room < 0:
            self.move_rows()

    def move_rows(self) -> None:
        """Move rows without an error to parts, a full part at a time, if there are too many for SQLite.

        No rows move without pyarrow, or before the study is known.
        """
        in_parts = sum(part.rows for part in self.parts())
        count = self.execute("SELECT COUNT(*) FROM trials").fetchone()[0]
        moved = PART_ROWS
        able = row_parts.can_write_parts() and bool(self.meta("replicates"))
        while able and in_parts + count > MOST_ROWS and count >= PART_ROWS == moved:
            moved = self._move_part()
            count -= moved
            in_parts += moved
        self._room = MOST_ROWS - in_parts - count
        if self._room < 0:
            self._room = PART_ROWS - count if count < PART_ROWS else PART_ROWS

    def _move_part(self) -> int:
        """Move the rows with the lowest trial numbers and return their number; 0 if too few are without an error."""
        where = (
            "trial IN (SELECT trial FROM trials WHERE error IS NULL ORDER BY trial LIMIT ?)"
        )
        columns = self._kept_columns(where, (PART_ROWS,))
        trial = columns.pop("trial")
        if len(trial) < PART_ROWS:
            return 0
        number = 1 + self.execute("SELECT COALESCE(MAX(part), 0) FROM parts").fetchone()[0]
        make_folder(self.parts_folder)
        row_parts.write_part(self.part_path(number), columns)
        last = (int(trial[-1]),)
        with self.db:
            ends = [int(columns["point"][row]) for row in (0, -1)]
            row = (number, len(trial), int(columns["wrong"].sum()), *ends)
            self.execute("INSERT INTO parts VALUES (?, ?, ?, ?, ?)", row)
            self.execute("DELETE FROM trials WHERE trial <= ? AND error IS NULL", last)
            self.execute(
                "DELETE FROM timings WHERE trial <= ? AND trial NOT IN (SELECT trial FROM trials)",
                last,
            )
            self.execute(
                "UPDATE meta SET value = ? WHERE key = 'format'", (str(FORMAT_OF_PARTS),)
            )
        return len(trial)

    def part_path(self, number: int) -> Path:
        """The file of a part."""
        return self.parts_folder / f"{number:06d}.parquet"

    def parts(self) -> list[Part]:
        """All parts, in the order in which they were written."""
        # A store of an earlier skysim has no such table.
        if self.meta("format") != str(FORMAT_OF_PARTS):
            return []
        # A last point that the study does not have is no integer here, which is refused.
        rows = self.execute(
            "SELECT part, rows, wrong, first, CASE WHEN typeof(last) = 'integer' AND last >= (SELECT COUNT(*) "
            "FROM points) THEN 'no point ' || last ELSE last END FROM parts ORDER BY part"
        )
        known = (self.checked(row, int, int, int, int, int) for row in rows)
        return [
            self._parts.setdefault(number, Part(self.part_path(number), *others))
            for number, *others in known
        ]

    @contextmanager
    def snapshot(self) -> Iterator[None]:
        """Within this context all queries see the rows of one instant, even while a run adds others."""
        if self.db.in_transaction:
            yield
            return
        self.execute("BEGIN")
        try:
            yield
        finally:
            self.db.rollback()

    def record_run(self, engine: str, workers: int, trials: int, seconds: float) -> None:
        """Record a finished run."""
        with self.db:
            row = (None, time.time() - seconds, engine, workers, trials, seconds)
            self.execute("INSERT INTO runs VALUES (?, ?, ?, ?, ?, ?)", row)

    def runs(self) -> list[Record]:
        """Every run that was not killed: engine, workers, trials, seconds."""
        rows = self.execute("SELECT engine, workers, trials, seconds FROM runs ORDER BY run")
        names = ("engine", "workers", "trials", "seconds")
        types = (str, int, int, float)
        return [dict(zip(names, self.checked(row, *types), strict=True)) for row in rows]

    def done(self, count: int) -> Bools:
        """(count,) mask of the trials in the store, failed ones included."""
        mask = np.zeros(count, bool)
        with self.snapshot():
            rows = self.execute(
                "SELECT trial FROM trials WHERE trial >= 0 AND trial < ?", (count,)
            )
            mask[np.fromiter((trial for (trial,) in rows), np.int64)] = True
            for part in self.parts():
                numbers = part.trials(self._replicates())
                mask[numbers[: np.searchsorted(numbers, count)]] = True
        return mask

    def counts(self) -> dict[str, int]:
        """Number of trials in the store, of failed trials, and of wrong attitudes."""
        query = "SELECT COUNT(*), COALESCE(SUM(error IS NOT NULL), 0), COALESCE(SUM(wrong), 0) FROM trials"
        with self.snapshot():
            # SQLite's sum is an integer only if all values are.
            done, failed, wrong = self.checked(self.execute(query).fetchone(), int, int, int)
            parts = self.parts()
        return {
            "done": done + sum(part.rows for part in parts),
            "failed": failed,
            "wrong": wrong + sum(part.wrong for part in parts),
        }

    def failures(self) -> list[tuple[int, str]]:
        """Number of each failed trial and the last line of its traceback. Raises InputError."""
        rows = self.execute(
            "SELECT trial, error FROM trials WHERE error IS NOT NULL ORDER BY trial"
        )
        with self.corruption_as_input_error():
            return [
                (trial, self.checked([error], str)[0].strip().splitlines()[-1])
                for trial, error in rows
            ]

    def trial(self, number: int) -> Record:
        """One row by column name. Raises InputError if the trial is not in the store."""
        rows = self._rows([(number, number + 1)])
        if not len(rows["trial"]):
            raise InputError(f"trial {number}", f"not in {self.path}", self.trial_range())
        return {name: to_sql(rows[name].tolist()[0]) for name in rows if name not in TIMES}

    def trial_range(self) -> str:
        """Range of the trial numbers in the store, as text for messages."""
        ends = self._ends()
        return f"{min(ends)} to {max(ends)}" if ends else "none yet"

    def columns(self, failed: bool = True) -> Rows:
        """Every column of `trials`, and those of `timings`, as arrays in trial order; NaN for missing values.

        Parameters
        ----------
        failed
            Whether failed trials are included
        """
        return self._rows([EVERY], "1" if failed else "error IS NULL")

    def point_columns(self, *points: int) -> Rows:
        """The columns of the trials of some points."""
        if len(points) != 1 or not (parts := self.parts()):
            return self._rows(ranges_of(points, self._replicates()))
        # Reading one point of a part takes as long as reading all of its points.
        (point,), (near, rows) = points, self._near
        if point not in near:
            last = min(
                (part.last for part in parts if part.first <= point <= part.last),
                default=point,
            )
            near = range(point, last + 1)
            rows = self._rows(ranges_of(near, self._replicates()))
            self._near = near, rows
        if len(near) == 1:
            return rows
        first, end = np.searchsorted(rows["point"], [point, point + 1]).tolist()
        return row_parts.subset(rows, slice(first, end))

    def blocks(self) -> Iterator[Rows]:
        """The columns of all trials in blocks of BLOCK_TRIALS trial numbers; at least one block."""
        for first in range(0, 1 + max(self._ends(), default=0), BLOCK_TRIALS):
            yield self._rows([(first, first + BLOCK_TRIALS)])

    def _ends(self) -> list[int]:
        """First and last trial number of SQLite and of each part."""
        with self.snapshot():
            ends = [*self.execute("SELECT MIN(trial), MAX(trial) FROM trials").fetchone()]
            for part in self.parts():
                ends += part.trials(self._replicates())[[0, -1]].tolist()
        return [end for end in ends if end is not None]

    def _rows(self, ranges: Sequence[tuple[int, int]], where: str = "1") -> Rows:
        """The columns of the trials in some ranges of numbers, in their order.

        Parameters
        ----------
        where
            SQL condition for the rows in SQLite
        """
        condition = f"trial >= ? AND trial < ? AND {where}"
        with self.snapshot():
            found = [part.source(ranges, self._replicates()) for part in self.parts()]
            found += [self._kept_columns(condition, one).__getitem__ for one in ranges]
        sources = [source for source in found if source is not None]
        numbers = [source("trial") for source in sources]
        trial = np.concatenate(numbers)
        in_order = bool(np.all(trial[1:] > trial[:-1]))
        order = None if in_order else np.argsort(trial, kind="stable")
        # The numbers are a table's key, but a part has none.
        if not in_order and len(np.unique(trial)) < len(trial):
            raise InputError(
                self.path, "not a valid study store: several rows of a trial", "one"
            )
        return Rows(COLUMNS, sources, list(map(len, numbers)), order)

    def _replicates(self) -> int:
        """Number of trials of a point."""
        with self.corruption_as_input_error():
            replicates = int(self.meta("replicates"))
            if not 1 <= replicates < 2**31:
                raise ValueError(f"replicates {replicates}")
            return replicates

    def _kept_columns(self, where: str, values: Sequence[int]) -> dict[str, Array]:
        """The columns of rows in SQLite, in trial order."""
        query = f"SELECT {', '.join(COLUMNS)} FROM trials LEFT JOIN timings USING (trial) WHERE {where} ORDER BY trial"
        cursor = self.execute(query, values)
        texts = dict[Any, Any]()
        columns = {name: [to_array(name, (), texts)] for name in COLUMNS}
        with self.corruption_as_input_error():
            while rows := cursor.fetchmany(10_000):
                for name, column in zip(COLUMNS, zip(*rows, strict=True), strict=True):
                    columns[name].append(to_array(name, column, texts))
            self.checked(
                [text for text in texts if not isinstance(text, str | None)][:1], str
            )
        return {name: np.concatenate(arrays) for name, arrays in columns.items()}

    def checked(self, row: Iterable[Any], *types: type) -> tuple[Any, ...]:
        """The values of a row. Raises InputError for a value of another type: SQLite stores any type in any column."""
        values = tuple(row)
        if not all(map(isinstance, values, types)):
            allowed = ", ".join(dict.fromkeys(one.__name__ for one in types))
            raise InputError(
                self.path, f"not a valid study store: {repr(values)[:80]}", allowed
            )
        return values

    @contextmanager
    def corruption_as_input_error(self) -> Iterator[None]:
        """Raise InputError, instead of a decoding error, for values that skysim cannot have written."""
        try:
            yield
        except InputError:
            raise
        except (
            ArithmeticError,
            AttributeError,
            LookupError,
            RecursionError,
            TypeError,
            ValueError,
        ) as error:
            raise InputError(
                self.path, f"not a valid study store: {' '.join(str(error).split())[:120]}"
            ) from None


def to_sql(value: Any) -> Any:
    """A value as stored in SQLite: None for NaN, a Python float for a NumPy float."""
    if isinstance(value, float):
        return None if math.isnan(value) else float(value)
    return value


def to_array(name: str, column: Sequence[Any], texts: dict[Any, Any]) -> Array:
    """A column as an array: objects for text, int64 for integers, otherwise floats with NaN for null.

    Parameters
    ----------
    texts
        Texts so far; equal texts share one object

    Raises
    ------
    TypeError
        For other values in a column of numbers; NumPy would read digits in bytes.
    """
    if name in TEXT_FIELDS or name in ("scene", "code", "error"):
        return np.array([texts.setdefault(text, text) for text in column], dtype=object)
    is_integer = name in INTEGER_FIELDS or name in COLUMNS[:4]
    if not set(map(type, column)) <= ({int} if is_integer else {int, float, type(None)}):
        raise TypeError(f"{name} is not a number in each row")
    return np.array(column, dtype=np.int64 if is_integer else float)


def ranges_of(points: Sequence[int], replicates: int) -> list[tuple[int, int]]:
    """The ranges (first, end) of the trials of some points; an empty one for none."""
    if not points:
        return [(0, 0)]
    ordered = np.array(sorted(points))
    runs = np.split(ordered, np.flatnonzero(np.diff(ordered) != 1) + 1)
    return [(int(run[0]) * replicates, (int(run[-1]) + 1) * replicates) for run in runs]


@contextmanager
def open_store(path: Path) -> Iterator[Store]:
    """Open a store for reading; a run may write it at the same time. Raises InputError if it is missing or damaged."""
    if not path.is_file():
        raise InputError(path, "no such store", "a store of a study's trials")
    with (
        sqlite_errors_as_input_error(path, "not a valid study store: "),
        closing(sqlite3.connect(path, timeout=30)) as db,
    ):
        store = Store(path, db)
        check_format(store)
        yield store


def check_format(store: Store) -> None:
    """Raise InputError for a store of another format, or with a row that does not belong to its study."""
    # A run that the disk had no room for leaves an empty database.
    found = store.execute("SELECT 1 FROM sqlite_master WHERE name = 'meta'").fetchone()
    stored = found and store.meta("format")
    if not stored:
        raise InputError(store.path, "contains no trials of a study", "to run the study")
    if stored in ("1", "4", "5"):
        raise InputError(
            store.path,
            "written by an earlier skysim, without all columns of the trials",
            "run the study again, to another store",
        )
    if stored not in (str(FORMAT), str(FORMAT_OF_PARTS)):
        raise InputError(store.path, f"format {stored!r}", f"{FORMAT}, {FORMAT_OF_PARTS}")
    if stray := store.execute(STRAY).fetchone():
        raise InputError(store.path, *stray)


@contextmanager
def sqlite_errors_as_input_error(path: Path, what: str = "") -> Iterator[None]:
    """Raise InputError instead of the errors of SQLite for a damaged file.

    It may be no database, or have invalid text or a declared size that exceeds memory.
    """
    try:
        yield
    except (sqlite3.DatabaseError, UnicodeDecodeError, MemoryError) as error:
        if str(error).endswith(("is full", "I/O error")):
            what = f"{room_left(path)}; "
        raise InputError(path, f"{what}{str(error) or 'not enough memory'}") from None


@contextmanager
def writing(path: Path) -> Iterator[Store]:
    """Open a store for writing by one run; it is created if missing.

    The lock is an SQLite transaction on a second file. The operating system releases it even if the run is killed.
    Raises InputError if another run holds it.
    """
    make_folder(path.parent)
    lock_file = path.with_suffix(".lock")
    with (
        sqlite_errors_as_input_error(path),
        closing(sqlite3.connect(lock_file, timeout=0, isolation_level=None)) as lock,
    ):
        try:
            lock.execute("BEGIN EXCLUSIVE")
        except sqlite3.OperationalError as error:
            if error.sqlite_errorcode != sqlite3.SQLITE_BUSY:
                raise
            raise InputError(
                path, "in use by another run", "one run at a time, or another store"
            ) from None
        with closing(sqlite3.connect(path, timeout=30)) as db:
            db.execute("PRAGMA journal_mode = WAL")
            db.execute("PRAGMA synchronous = NORMAL")
            store = Store(path, db)
            with db:
                # Python begins no transaction for tables, and a full disk must not leave some of them.
                db.execute("BEGIN")
                for statement in TABLES.split(";"):
                    db.execute(statement)
                db.execute("INSERT OR IGNORE INTO meta VALUES ('format', ?)", (str(FORMAT),))
            check_format(store)
            # Part files of a run that was killed before it listed them.
            for part in {*store.parts_folder.glob("*")} - {one.path for one in store.parts()}:
                remove(part)
            store.move_rows()
            yield store
