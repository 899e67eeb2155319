"""Where a study keeps its trials: one SQLite file, one row a trial, written by one run at a time.

`trials` and `points` depend on the study alone; who did a trial, when and how quickly is in `timings` and `runs`.
Every batch of rows is one transaction of a write-ahead log, so a run that is killed leaves whole batches.
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
)  # of `columns`

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
    """One study's file. `open_store` makes or opens one; without `lock` it is for reading."""

    def __init__(self, path: Path, connection: sqlite3.Connection) -> None:
        self.path, self.db = path, connection

    def meta(self, key: str) -> str:
        """What is noted under a key; empty where nothing is."""
        found = self.db.execute("SELECT value FROM meta WHERE key = ?", (key,)).fetchone()
        return found[0] if found else ""

    def note(self, **values: str) -> None:
        """Note values under keys."""
        with self.db:
            self.db.executemany("INSERT OR REPLACE INTO meta VALUES (?, ?)", values.items())

    def overrides(self) -> dict[str, str]:
        """What the run's command line had put over the study: texts by key."""
        with self.sound():
            told = json.loads(self.meta("overrides") or "{}")
            if not isinstance(told, dict) or not all(isinstance(value, str) for value in told.values()):
                raise ValueError("overrides that are no texts by key")
            return told

    def begin(self, points: Iterable[Point], **values: str) -> None:
        """Make the store a study's: its points and what is noted of it, all or nothing."""
        rows = (
            (n, json.dumps(one.levels, default=str), json.dumps(one.settings, default=str))
            for n, one in enumerate(points)
        )
        with self.db:
            self.db.execute("DELETE FROM points")
            self.db.executemany("INSERT INTO points VALUES (?, ?, ?)", rows)
            self.db.executemany("INSERT OR REPLACE INTO meta VALUES (?, ?)", values.items())

    def scenes(self) -> list[tuple[int, str]]:
        """The first and the last point of trials that did not fail, with their scenes' hashes."""
        told = "SELECT point, scene FROM trials WHERE scene != '' AND error IS NULL ORDER BY trial {} LIMIT 1"
        return [row for order in ("ASC", "DESC") for row in self.db.execute(told.format(order))]

    def forget_failed(self) -> None:
        """Drop the trials that raised, so that they are done again."""
        with self.db:
            self.db.execute("DELETE FROM trials WHERE error IS NOT NULL")

    def set_points(self, points: Iterable[Point], first: int = 0) -> None:
        """Points by their numbers, from `first`."""
        rows = (
            (first + n, json.dumps(point.levels, default=str), json.dumps(point.settings, default=str))
            for n, point in enumerate(points)
        )
        with self.db:
            self.db.executemany("INSERT OR REPLACE INTO points VALUES (?, ?, ?)", rows)

    def points(self) -> list[Point]:
        """All points, in order."""
        rows = self.db.execute("SELECT levels, settings FROM points ORDER BY point")
        with self.sound():
            return [Point(json.loads(levels), json.loads(settings)) for levels, settings in rows]

    def add(self, rows: list[Row]) -> None:
        """Keep rows, all or none of them."""
        values = [(*row[:6], *map(plain, astuple(row.outcome)), row.error) for row in rows]
        with self.db:
            self.db.executemany(INSERT, values)
            times = [(row.trial, 1e3 * row.seconds) for row in rows]
            self.db.executemany("INSERT OR REPLACE INTO timings VALUES (?, ?)", times)

    def ran(self, engine: str, workers: int, trials: int, seconds: float) -> None:
        """Note that a run ended."""
        with self.db:
            row = (None, time.time() - seconds, engine, workers, trials, seconds)
            self.db.execute("INSERT INTO runs VALUES (?, ?, ?, ?, ?, ?)", row)

    def runs(self) -> list[dict[str, Any]]:
        """Every run that ended by itself: engine, workers, trials, seconds."""
        rows = self.db.execute("SELECT engine, workers, trials, seconds FROM runs ORDER BY run")
        return [dict(zip(("engine", "workers", "trials", "seconds"), row, strict=True)) for row in rows]

    def done(self, count: int) -> NDArray[np.bool_]:
        """(count,) which trials are in; those that failed too."""
        mask = np.zeros(count, bool)
        for (trial,) in self.db.execute("SELECT trial FROM trials WHERE trial < ?", (count,)):
            mask[trial] = True
        return mask

    def counts(self) -> dict[str, int]:
        """How many trials are in, failed, were answered wrongly."""
        told = "SELECT COUNT(*), COALESCE(SUM(error IS NOT NULL), 0), COALESCE(SUM(wrong), 0) FROM trials"
        return dict(zip(("done", "failed", "wrong"), self.db.execute(told).fetchone(), strict=True))

    def failures(self) -> list[tuple[int, str]]:
        """Trials that raised, and the last line of what."""
        rows = self.db.execute("SELECT trial, error FROM trials WHERE error IS NOT NULL ORDER BY trial")
        with self.sound():
            return [(trial, error.strip().splitlines()[-1]) for trial, error in rows]

    def trial(self, number: int) -> dict[str, Any]:
        """One row with its names. Raises InputError where it is not in."""
        found = self.db.execute("SELECT * FROM trials WHERE trial = ?", (number,))
        row = found.fetchone()
        if row is None:
            raise InputError(f"trial {number}: is not in {self.path}; allowed: {self.span()}")
        return dict(zip((column[0] for column in found.description), row, strict=True))

    def span(self) -> str:
        """The numbers of the trials that are in."""
        low, high = self.db.execute("SELECT MIN(trial), MAX(trial) FROM trials").fetchone()
        return "none yet" if low is None else f"{low} to {high}"

    def columns(self, where: str = "1", values: tuple[Any, ...] = ()) -> dict[str, NDArray[Any]]:
        """Every column of `trials` and `timings.time_ms` as an array, in the trials' order; NaN for what is missing."""
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
        """The columns of one point's trials."""
        return self.columns("point = ?", (point,))

    @contextmanager
    def sound(self) -> Iterator[None]:
        """Values that SQLite holds and we never wrote are told as such. Raises InputError."""
        try:
            yield
        except (ArithmeticError, AttributeError, LookupError, RecursionError, TypeError, ValueError) as error:
            raise InputError(
                f"{self.path}: no store of a study: {' '.join(str(error).split())[:120]}"
            ) from None

    def check(self) -> bool:
        """Whether SQLite finds the file whole."""
        return bool(self.db.execute("PRAGMA integrity_check").fetchone()[0] == "ok")


def plain(value: Any) -> Any:
    """A value as SQLite has it: no NaN, no numpy."""
    if isinstance(value, float):
        return None if math.isnan(value) else float(value)
    return value


def as_array(name: str, column: list[Any]) -> NDArray[Any]:
    """A column: text as objects, whole numbers as such, else floats."""
    if name in TEXT or name in ("scene", "code", "error"):
        return np.array(column, dtype=object)
    if name in WHOLE or name in ("trial", "point", "replicate", "seed"):
        return np.array(column, dtype=np.int64)
    return np.array([math.nan if value is None else value for value in column], dtype=float)


@contextmanager
def open_store(path: Path) -> Iterator[Store]:
    """A store to be read while a run may write it. Raises InputError where there is none, or none that is whole."""
    if not path.is_file():
        raise InputError(f"{path}: no store; allowed: one that skysim study run made")
    with legible(path, "no store of a study: "), connected(path) as db:
        store = Store(path, db)
        if store.meta("format") != str(FORMAT):
            raise InputError(f"{path}: format {store.meta('format')!r}; allowed: {FORMAT}")
        yield store


@contextmanager
def legible(path: Path, what: str = "") -> Iterator[None]:
    """What SQLite and its adapter say of a file that is none of theirs, of bytes that are no text, and of a size that
    no memory holds is told as such. Raises InputError."""
    try:
        yield
    except (sqlite3.DatabaseError, UnicodeDecodeError, MemoryError) as error:
        said = " ".join(str(error).split()) or "it asks for more memory than there is"
        raise InputError(f"{path}: {what}{said}") from None


@contextmanager
def writing(path: Path) -> Iterator[Store]:
    """The store of a path for the one run that may write it; made where it is not there.

    A lock beside it, itself SQLite's, goes when its holder ends in whatever way. Raises InputError where another has it.
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
    """Take the lock until its connection is closed. Raises InputError where another has it."""
    try:
        lock.execute("BEGIN EXCLUSIVE")
    except sqlite3.OperationalError as error:
        if error.sqlite_errorcode != sqlite3.SQLITE_BUSY:
            raise
        told = f"{path}: another run is writing it; allowed: one at a time, or another --out"
        raise InputError(told) from None


@contextmanager
def connected(path: Path) -> Iterator[sqlite3.Connection]:
    """A connection that is closed at the end."""
    db = sqlite3.connect(os.fspath(path), timeout=30)
    try:
        yield db
    finally:
        db.close()


# What they share.

STORE = "study.sqlite"
