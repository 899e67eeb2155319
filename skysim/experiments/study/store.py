"""Store of a study's trials: one SQLite file with one row per trial, written by one run at a time.

Tables `trials` and `points` depend only on the study; engine, time and speed are in `timings` and `runs`. Every batch
of rows is one transaction of a write-ahead log, so a killed run leaves only complete batches.
"""

from __future__ import annotations

import json
import math
import os
import sqlite3
import time
from collections.abc import Iterable, Iterator
from contextlib import closing, contextmanager
from dataclasses import astuple
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from skysim.core.errors import InputError
from skysim.core.files import make_folder
from skysim.experiments.study.designs import Point
from skysim.experiments.study.trials import FIELDS, Row

FORMAT = 1

TEXT = {"status"}

WHOLE = {"frames", "solved", "wrong"}

COLUMNS = (
    "trial",
    "point",
    "replicate",
    "seed",
    "scene",
    "code",
    *FIELDS,
    "error",
    "time_ms",
)  # of `Store.columns`

TABLES = f"""
CREATE TABLE IF NOT EXISTS meta (key TEXT PRIMARY KEY, value TEXT NOT NULL);
CREATE TABLE IF NOT EXISTS points (point INTEGER PRIMARY KEY, levels TEXT NOT NULL, settings TEXT NOT NULL);
CREATE TABLE IF NOT EXISTS trials (
  trial INTEGER PRIMARY KEY, point INTEGER NOT NULL, replicate INTEGER NOT NULL, seed INTEGER NOT NULL,
  scene TEXT NOT NULL, code TEXT NOT NULL,
  {", ".join(f"{name} {'TEXT' if name in TEXT else 'INTEGER' if name in WHOLE else 'REAL'}" for name in FIELDS)},
  error TEXT);
CREATE INDEX IF NOT EXISTS trials_of_point ON trials (point);
CREATE TABLE IF NOT EXISTS timings (trial INTEGER PRIMARY KEY, time_ms REAL NOT NULL);
CREATE TABLE IF NOT EXISTS runs (
  run INTEGER PRIMARY KEY, began REAL NOT NULL, engine TEXT NOT NULL, workers INTEGER NOT NULL,
  trials INTEGER NOT NULL, seconds REAL NOT NULL);
"""

INSERT = f"INSERT OR REPLACE INTO trials VALUES ({', '.join('?' * (7 + len(FIELDS)))})"


class Store:
    """An open store of one study. `open_store` opens one for reading, `writing` makes or opens one for writing."""

    def __init__(self, path: Path, connection: sqlite3.Connection) -> None:
        self.path, self.db = path, connection

    def meta(self, key: str) -> str:
        """The value of a metadata key; empty if it is not set."""
        found = self.db.execute("SELECT value FROM meta WHERE key = ?", (key,)).fetchone()
        return found[0] if found else ""

    def note(self, **values: str) -> None:
        """Set metadata keys."""
        with self.db:
            self.db.executemany("INSERT OR REPLACE INTO meta VALUES (?, ?)", values.items())

    def overrides(self) -> dict[str, str]:
        """Overrides of study keys from the run's command line: YAML text by key. Raises InputError."""
        with self.sound():
            told = json.loads(self.meta("overrides") or "{}")
            if not isinstance(told, dict) or not all(isinstance(value, str) for value in told.values()):
                raise ValueError("overrides that are no texts by key")
            return told

    def begin(self, points: Iterable[Point], **values: str) -> None:
        """Initialize the store with a study's points and metadata, in one transaction."""
        rows = (
            (n, json.dumps(one.levels, default=str), json.dumps(one.settings, default=str))
            for n, one in enumerate(points)
        )
        with self.db:
            self.db.execute("DELETE FROM points")
            self.db.executemany("INSERT INTO points VALUES (?, ?, ?)", rows)
            self.db.executemany("INSERT OR REPLACE INTO meta VALUES (?, ?)", values.items())

    def scenes(self) -> list[tuple[int, str]]:
        """Point and scene hash of the first and the last trial that did not fail."""
        told = "SELECT point, scene FROM trials WHERE scene != '' AND error IS NULL ORDER BY trial {} LIMIT 1"
        return [row for order in ("ASC", "DESC") for row in self.db.execute(told.format(order))]

    def forget_failed(self) -> None:
        """Delete the failed trials, so that they are run again."""
        with self.db:
            self.db.execute("DELETE FROM trials WHERE error IS NOT NULL")

    def set_points(self, points: Iterable[Point], first: int = 0) -> None:
        """Insert or replace points, numbered from `first`."""
        rows = (
            (first + n, json.dumps(point.levels, default=str), json.dumps(point.settings, default=str))
            for n, point in enumerate(points)
        )
        with self.db:
            self.db.executemany("INSERT OR REPLACE INTO points VALUES (?, ?, ?)", rows)

    def points(self) -> list[Point]:
        """All points, in order. Raises InputError."""
        rows = self.db.execute("SELECT levels, settings FROM points ORDER BY point")
        with self.sound():
            return [Point(json.loads(levels), json.loads(settings)) for levels, settings in rows]

    def add(self, rows: list[Row]) -> None:
        """Store rows in one transaction."""
        values = [(*row[:6], *map(plain, astuple(row.outcome)), row.error) for row in rows]
        with self.db:
            self.db.executemany(INSERT, values)
            times = [(row.trial, 1e3 * row.seconds) for row in rows]
            self.db.executemany("INSERT OR REPLACE INTO timings VALUES (?, ?)", times)

    def ran(self, engine: str, workers: int, trials: int, seconds: float) -> None:
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
        told = "SELECT COUNT(*), COALESCE(SUM(error IS NOT NULL), 0), COALESCE(SUM(wrong), 0) FROM trials"
        return dict(zip(("done", "failed", "wrong"), self.db.execute(told).fetchone(), strict=True))

    def failures(self) -> list[tuple[int, str]]:
        """Number of each failed trial and the last line of its traceback. Raises InputError."""
        rows = self.db.execute("SELECT trial, error FROM trials WHERE error IS NOT NULL ORDER BY trial")
        with self.sound():
            return [(trial, error.strip().splitlines()[-1]) for trial, error in rows]

    def trial(self, number: int) -> dict[str, Any]:
        """One row by column name. Raises InputError if the trial is not in the store."""
        found = self.db.execute("SELECT * FROM trials WHERE trial = ?", (number,))
        row = found.fetchone()
        if row is None:
            raise InputError(f"trial {number}: is not in {self.path}; allowed: {self.span()}")
        return dict(zip((column[0] for column in found.description), row, strict=True))

    def span(self) -> str:
        """Range of the trial numbers in the store, as text for messages."""
        low, high = self.db.execute("SELECT MIN(trial), MAX(trial) FROM trials").fetchone()
        return "none yet" if low is None else f"{low} to {high}"

    def columns(self, where: str = "1", values: tuple[Any, ...] = ()) -> dict[str, NDArray[Any]]:
        """Every column of `trials`, and `timings.time_ms`, as arrays in trial order; NaN for missing values."""
        told = f"SELECT trials.*, time_ms FROM trials LEFT JOIN timings USING (trial) WHERE {where} ORDER BY trial"
        found = self.db.execute(told, values)
        names = [column[0] for column in found.description]
        lists: list[list[Any]] = [[] for _ in names]
        while batch := found.fetchmany(10_000):
            for column, more in zip(lists, zip(*batch, strict=True), strict=True):
                column.extend(more)
        with self.sound():
            return {name: as_array(name, column) for name, column in zip(names, lists, strict=True)}

    def of_point(self, point: int) -> dict[str, NDArray[Any]]:
        """The columns of the trials of one point."""
        return self.columns("point = ?", (point,))

    @contextmanager
    def sound(self) -> Iterator[None]:
        """Raise InputError, instead of a decoding error, for values that skysim cannot have written."""
        try:
            yield
        except (ArithmeticError, AttributeError, LookupError, RecursionError, TypeError, ValueError) as error:
            raise InputError(
                f"{self.path}: no store of a study: {' '.join(str(error).split())[:120]}"
            ) from None

    def check(self) -> bool:
        """Whether SQLite's integrity check passes."""
        return bool(self.db.execute("PRAGMA integrity_check").fetchone()[0] == "ok")


def plain(value: Any) -> Any:
    """A value as stored in SQLite: None for NaN, a Python float for a NumPy float."""
    if isinstance(value, float):
        return None if math.isnan(value) else float(value)
    return value


def as_array(name: str, column: list[Any]) -> NDArray[Any]:
    """A column as an array: objects for text, int64 for integers, otherwise floats with NaN for null."""
    if name in TEXT or name in ("scene", "code", "error"):
        return np.array(column, dtype=object)
    if name in WHOLE or name in ("trial", "point", "replicate", "seed"):
        return np.array(column, dtype=np.int64)
    return np.array([math.nan if value is None else value for value in column], dtype=float)


@contextmanager
def open_store(path: Path) -> Iterator[Store]:
    """Open a store for reading; a run may write it at the same time. Raises InputError if it is missing or damaged."""
    if not path.is_file():
        raise InputError(f"{path}: no store; allowed: one that skysim study run made")
    with legible(path, "no store of a study: "), connected(path) as db:
        store = Store(path, db)
        if store.meta("format") != str(FORMAT):
            raise InputError(f"{path}: format {store.meta('format')!r}; allowed: {FORMAT}")
        yield store


@contextmanager
def legible(path: Path, what: str = "") -> Iterator[None]:
    """Raise InputError instead of the errors of SQLite for a damaged file: not a database, invalid text, or a declared
    size that exceeds memory."""
    try:
        yield
    except (sqlite3.DatabaseError, UnicodeDecodeError, MemoryError) as error:
        said = " ".join(str(error).split()) or "it asks for more memory than there is"
        raise InputError(f"{path}: {what}{said}") from None


@contextmanager
def writing(path: Path) -> Iterator[Store]:
    """Open a store for writing by one run; it is created if missing.

    The lock is an SQLite transaction on a second file. The operating system releases it even if the run is killed.
    Raises InputError if another run holds it.
    """
    make_folder(path.parent)
    lock_file = path.with_suffix(".lock")
    with legible(path), closing(sqlite3.connect(lock_file, timeout=0, isolation_level=None)) as lock:
        hold(lock, path)
        with connected(path) as db:
            db.execute("PRAGMA journal_mode = WAL")
            db.execute("PRAGMA synchronous = NORMAL")
            store = Store(path, db)
            with db:
                for statement in TABLES.split(";"):
                    db.execute(statement)
                db.execute("INSERT OR IGNORE INTO meta VALUES ('format', ?)", (str(FORMAT),))
            if store.meta("format") != str(FORMAT):
                raise InputError(f"{path}: format {store.meta('format')!r}; allowed: {FORMAT}")
            yield store


def hold(lock: sqlite3.Connection, path: Path) -> None:
    """Hold the lock until its connection is closed. Raises InputError if another run holds it."""
    try:
        lock.execute("BEGIN EXCLUSIVE")
    except sqlite3.OperationalError as error:
        if error.sqlite_errorcode != sqlite3.SQLITE_BUSY:
            raise
        told = f"{path}: another run is writing it; allowed: one at a time, or another --out"
        raise InputError(told) from None


@contextmanager
def connected(path: Path) -> Iterator[sqlite3.Connection]:
    """A database connection that is closed on exit."""
    db = sqlite3.connect(os.fspath(path), timeout=30)
    try:
        yield db
    finally:
        db.close()


# File name of the store in a study's results folder.

STORE = "study.sqlite"
