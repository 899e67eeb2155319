"""Store of a study's trials: one SQLite file with one row per trial, written by one run at a time.

Tables `trials` and `points` depend only on the study; engine, time and speed are in `timings` and `runs`. Every batch
of rows is one transaction of a write-ahead log, so a killed run leaves only complete batches.
"""

from __future__ import annotations

import json
import math
import sqlite3
import time
from collections.abc import Iterable, Iterator
from contextlib import closing, contextmanager
from operator import attrgetter
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from skysim.core.errors import InputError
from skysim.core.io.files import make_folder
from skysim.experiments.study.designs import Point
from skysim.experiments.study.execution.outcomes import FIELDS
from skysim.experiments.study.execution.trials import Row

STORE = "study.sqlite"  # file name in a study's results folder
FORMAT = 4  # raised when the columns of `trials` change
TEXT_FIELDS = {"status"}
INTEGER_FIELDS = {"frames", "solved", "wrong", "ambiguous"}

COLUMNS = ("trial", "point", "replicate", "seed", "scene", "code", *FIELDS, "error", "time_ms")  # of `Store.columns`

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
CREATE INDEX IF NOT EXISTS trials_of_point ON trials (point);
CREATE TABLE IF NOT EXISTS timings (trial INTEGER PRIMARY KEY, time_ms REAL NOT NULL);
CREATE TABLE IF NOT EXISTS runs (
  run INTEGER PRIMARY KEY, began REAL NOT NULL, engine TEXT NOT NULL, workers INTEGER NOT NULL,
  trials INTEGER NOT NULL, seconds REAL NOT NULL);
"""

values_of = attrgetter(*FIELDS)  # of an outcome; `astuple` takes twenty times longer
INSERT = f"INSERT OR REPLACE INTO trials VALUES ({', '.join('?' * (7 + len(FIELDS)))})"


class Store:
    """An open store of one study. `open_store` opens one for reading, `writing` makes or opens one for writing."""

    def __init__(self, path: Path, connection: sqlite3.Connection) -> None:
        self.path, self.db = path, connection

    def meta(self, key: str) -> str:
        """The value of a metadata key; empty if it is not set."""
        row = self.db.execute("SELECT value FROM meta WHERE key = ?", (key,)).fetchone()
        return row[0] if row else ""

    def overrides(self) -> dict[str, str]:
        """Overrides of study keys from the run's command line: YAML text by key. Raises InputError."""
        with self.corruption_as_input_error():
            overrides = json.loads(self.meta("overrides") or "{}")
            if not isinstance(overrides, dict) or not all(isinstance(v, str) for v in overrides.values()):
                raise ValueError("overrides are not text values by key")
            return overrides

    def begin(self, points: Iterable[Point], grown: tuple[int, int] | None = None, **values: str) -> None:
        """Set the study's points and metadata in one transaction.

        grown : replicates of the stored trials and of the study, if it has more: trials are numbered
                point * replicates + replicate, and get their new numbers
        """
        with self.db:
            if grown:
                self._renumber(*grown)
            self.db.execute("DELETE FROM points")
            self._insert_points(points)
            self.db.executemany("INSERT OR REPLACE INTO meta VALUES (?, ?)", values.items())

    def _renumber(self, replicates: int, more: int) -> None:
        number = f"trial / {replicates} * {more} + trial % {replicates}"
        for table in ("trials", "timings"):
            # By way of negative numbers, since a new number may be the old one of another row.
            self.db.execute(f"UPDATE {table} SET trial = -1 - ({number})")
            self.db.execute(f"UPDATE {table} SET trial = -1 - trial")

    def scenes(self) -> list[tuple[int, int, str]]:
        """Point, replicate and scene hash of the first and the last trial that did not fail."""
        query = (
            "SELECT point, replicate, scene FROM trials WHERE scene != '' AND error IS NULL ORDER BY trial {} LIMIT 1"
        )
        return [row for order in ("ASC", "DESC") for row in self.db.execute(query.format(order))]

    def delete_failed(self) -> None:
        """Delete the failed trials, so that they are run again."""
        with self.db:
            self.db.execute("DELETE FROM trials WHERE error IS NOT NULL")

    def set_points(self, points: Iterable[Point], first: int = 0) -> None:
        """Insert or replace points, numbered from `first`."""
        with self.db:
            self._insert_points(points, first)

    def _insert_points(self, points: Iterable[Point], first: int = 0) -> None:
        rows = (
            (n, json.dumps(point.levels, default=str), json.dumps(point.settings, default=str))
            for n, point in enumerate(points, first)
        )
        self.db.executemany("INSERT OR REPLACE INTO points VALUES (?, ?, ?)", rows)

    def points(self) -> list[Point]:
        """All points, in order. Raises InputError."""
        rows = self.db.execute("SELECT levels, settings FROM points ORDER BY point")
        with self.corruption_as_input_error():
            return [Point(json.loads(levels), json.loads(settings)) for levels, settings in rows]

    def add(self, rows: list[Row]) -> None:
        """Store rows in one transaction."""
        values = [(*row[:6], *map(to_sql, values_of(row.outcome)), row.error) for row in rows]
        with self.db:
            self.db.executemany(INSERT, values)
            times = [(row.trial, 1e3 * row.seconds) for row in rows]
            self.db.executemany("INSERT OR REPLACE INTO timings VALUES (?, ?)", times)

    def record_run(self, engine: str, workers: int, trials: int, seconds: float) -> None:
        """Record a finished run."""
        with self.db:
            row = (None, time.time() - seconds, engine, workers, trials, seconds)
            self.db.execute("INSERT INTO runs VALUES (?, ?, ?, ?, ?, ?)", row)

    def runs(self) -> list[dict[str, Any]]:
        """Every run that was not killed: engine, workers, trials, seconds."""
        rows = self.db.execute("SELECT engine, workers, trials, seconds FROM runs ORDER BY run")
        return [dict(zip(("engine", "workers", "trials", "seconds"), row, strict=True)) for row in rows]

    def done(self, count: int) -> NDArray[np.bool_]:
        """(count,) mask of the trials in the store, failed ones included."""
        mask = np.zeros(count, bool)
        for (trial,) in self.db.execute("SELECT trial FROM trials WHERE trial < ?", (count,)):
            mask[trial] = True
        return mask

    def counts(self) -> dict[str, int]:
        """Number of trials in the store, of failed trials, and of wrong attitudes."""
        query = "SELECT COUNT(*), COALESCE(SUM(error IS NOT NULL), 0), COALESCE(SUM(wrong), 0) FROM trials"
        return dict(zip(("done", "failed", "wrong"), self.db.execute(query).fetchone(), strict=True))

    def failures(self) -> list[tuple[int, str]]:
        """Number of each failed trial and the last line of its traceback. Raises InputError."""
        rows = self.db.execute("SELECT trial, error FROM trials WHERE error IS NOT NULL ORDER BY trial")
        with self.corruption_as_input_error():
            return [(trial, error.strip().splitlines()[-1]) for trial, error in rows]

    def trial(self, number: int) -> dict[str, Any]:
        """One row by column name. Raises InputError if the trial is not in the store."""
        cursor = self.db.execute("SELECT * FROM trials WHERE trial = ?", (number,))
        row = cursor.fetchone()
        if row is None:
            raise InputError(f"trial {number}: not in {self.path}; allowed: {self.trial_range()}")
        return dict(zip((column[0] for column in cursor.description), row, strict=True))

    def trial_range(self) -> str:
        """Range of the trial numbers in the store, as text for messages."""
        low, high = self.db.execute("SELECT MIN(trial), MAX(trial) FROM trials").fetchone()
        return "none yet" if low is None else f"{low} to {high}"

    def columns(self, where: str = "1", values: tuple[Any, ...] = ()) -> dict[str, NDArray[Any]]:
        """Every column of `trials`, and `timings.time_ms`, as arrays in trial order; NaN for missing values."""
        query = f"SELECT trials.*, time_ms FROM trials LEFT JOIN timings USING (trial) WHERE {where} ORDER BY trial"
        cursor = self.db.execute(query, values)
        names = [column[0] for column in cursor.description]
        lists: list[list[Any]] = [[] for _ in names]
        while batch := cursor.fetchmany(10_000):
            for column, more in zip(lists, zip(*batch, strict=True), strict=True):
                column.extend(more)
        with self.corruption_as_input_error():
            return {name: to_array(name, column) for name, column in zip(names, lists, strict=True)}

    def point_columns(self, point: int) -> dict[str, NDArray[Any]]:
        """The columns of the trials of one point."""
        return self.columns("point = ?", (point,))

    @contextmanager
    def corruption_as_input_error(self) -> Iterator[None]:
        """Raise InputError, instead of a decoding error, for values that skysim cannot have written."""
        try:
            yield
        except (ArithmeticError, AttributeError, LookupError, RecursionError, TypeError, ValueError) as error:
            raise InputError(f"{self.path}: not a valid study store: {' '.join(str(error).split())[:120]}") from None


def to_sql(value: Any) -> Any:
    """A value as stored in SQLite: None for NaN, a Python float for a NumPy float."""
    if isinstance(value, float):
        return None if math.isnan(value) else float(value)
    return value


def to_array(name: str, column: list[Any]) -> NDArray[Any]:
    """A column as an array: objects for text, int64 for integers, otherwise floats with NaN for null."""
    if name in TEXT_FIELDS or name in ("scene", "code", "error"):
        return np.array(column, dtype=object)
    if name in INTEGER_FIELDS or name in ("trial", "point", "replicate", "seed"):
        return np.array(column, dtype=np.int64)
    return np.array([math.nan if value is None else value for value in column], dtype=float)


@contextmanager
def open_store(path: Path) -> Iterator[Store]:
    """Open a store for reading; a run may write it at the same time. Raises InputError if it is missing or damaged."""
    if not path.is_file():
        raise InputError(f"{path}: no such store; allowed: a store written by skysim study run")
    with (
        sqlite_errors_as_input_error(path, "not a valid study store: "),
        closing(sqlite3.connect(path, timeout=30)) as db,
    ):
        store = Store(path, db)
        check_format(store)
        yield store


def check_format(store: Store) -> None:
    """Raise InputError for a store of another format."""
    stored = store.meta("format")
    if stored == "1":
        raise InputError(
            f"{store.path}: written by an earlier skysim, without the attitudes of the trials; allowed: run the study"
            " again, with another --out"
        )
    if stored != str(FORMAT):
        raise InputError(f"{store.path}: format {stored!r}; allowed: {FORMAT}")


@contextmanager
def sqlite_errors_as_input_error(path: Path, what: str = "") -> Iterator[None]:
    """Raise InputError instead of the errors of SQLite for a damaged file: not a database, invalid text, or a declared
    size that exceeds memory."""
    try:
        yield
    except (sqlite3.DatabaseError, UnicodeDecodeError, MemoryError) as error:
        message = " ".join(str(error).split()) or "not enough memory"
        raise InputError(f"{path}: {what}{message}") from None


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
            raise InputError(f"{path}: in use by another run; allowed: one run at a time, or another --out") from None
        with closing(sqlite3.connect(path, timeout=30)) as db:
            db.execute("PRAGMA journal_mode = WAL")
            db.execute("PRAGMA synchronous = NORMAL")
            store = Store(path, db)
            with db:
                for statement in TABLES.split(";"):
                    db.execute(statement)
                db.execute("INSERT OR IGNORE INTO meta VALUES ('format', ?)", (str(FORMAT),))
            check_format(store)
            yield store
