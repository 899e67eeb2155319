"""A study from its first missing trial to its last: work is handed out in chunks, rows are kept as they come."""

from __future__ import annotations

import json
import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np
from numpy.typing import NDArray

from skysim.core.errors import InputError
from skysim.experiments.study.designs import Point
from skysim.experiments.study.execution.engines import Chunk, Engine, Pool, Serial
from skysim.experiments.study.plan import Plan, resolved
from skysim.experiments.study.setups import code_version, scene_hash
from skysim.experiments.study.store import Store
from skysim.experiments.study.trials import Row, Segment

CHUNK_S = 0.25  # of work in a chunk: a worker that dies loses no more, and handing it over costs nothing

MOST = 5000  # trials in a chunk


@dataclass(slots=True)
class Progress:
    """How far a run is: trials in all, in the store, of those failed, and done by this run since it began."""

    trials: int
    done: int = 0
    failed: int = 0
    wrong: int = 0
    now: int = 0
    began: float = field(default_factory=time.perf_counter)

    @property
    def rate(self) -> float:
        """Trials a second of this run."""
        return self.now / max(time.perf_counter() - self.began, 1e-9)

    def add(self, rows: list[Row]) -> None:
        """Count rows that came."""
        self.done += len(rows)
        self.now += len(rows)
        self.failed += sum(row.error is not None for row in rows)
        self.wrong += sum(row.outcome.wrong for row in rows)


Watch = Callable[[Progress], Any]


class Todo:
    """The missing trials of some points as chunks, each of about CHUNK_S of work and, where that is more, whole points.

    missing : (M,) numbers of trials, ascending
    """

    def __init__(
        self, points: Sequence[Point], replicates: int, missing: NDArray[np.int64], first: int = 0
    ) -> None:
        self.points, self.replicates, self.missing, self.first = points, replicates, missing, first
        self.at, self.size = 0, 1

    def next(self) -> Chunk:
        """The next chunk; empty where nothing is left."""
        end = min(self.at + self.size, len(self.missing))
        if self.size >= self.replicates and end < len(self.missing):
            last = self.missing[end - 1] // self.replicates
            end = int(np.searchsorted(self.missing, (last + 1) * self.replicates))
        chosen, self.at = self.missing[self.at : end], end
        # A segment ends where the next trial is not the next number, or is another point's.
        breaks = np.flatnonzero((np.diff(chosen) != 1) | (chosen[1:] % self.replicates == 0)) + 1
        return tuple(self._segment(part) for part in np.split(chosen, breaks) if len(part))

    def _segment(self, part: NDArray[np.int64]) -> Segment:
        point, begin = divmod(int(part[0]), self.replicates)
        settings = self.points[point - self.first].settings
        return Segment(point, settings, int(part[0]), range(begin, begin + len(part)))

    def took(self, chunk: Chunk, seconds: float) -> None:
        """Size the next chunks by how long this one took; no more than twice the size."""
        count = sum(len(segment.replicates) for segment in chunk)
        wanted = int(CHUNK_S * count / max(seconds, 1e-6))
        self.size = int(np.clip(wanted, 1, min(2 * max(count, self.size), MOST)))


def begin(plan: Plan, store: Store, resume: bool, overrides: Mapping[str, str] | None = None) -> None:
    """Make a store the plan's, or see that it is. Raises InputError where it holds another study, or other code's rows.

    resume : whether trials that are in already are wanted there;  overrides : the command line's, kept with the store
    """
    held, done = store.meta("digest"), store.counts()["done"]
    if held and held != plan.digest:
        raise InputError(
            f"{store.path}: holds another study, or this one before it was changed; allowed: another --out"
        )
    if resume and not held:
        raise InputError(f"{store.path}: holds nothing to resume; allowed: skysim study run")
    if done and not resume:
        raise InputError(
            f"{store.path}: {done} trials are in; allowed: skysim study resume, or another --out"
        )
    if done and store.meta("code") != code_version():
        raise InputError(
            f"{store.path}: its {done} trials were made by skysim {store.meta('code')}, this is {code_version()};"
            " allowed: the same code, or another --out"
        )
    if done:
        check_scene(plan, store)
    else:
        text = plan.path.read_text(encoding="utf-8")
        told = {"study": text, "title": plan.study.title, "code": code_version(), "digest": plan.digest}
        store.begin(plan.points, overrides=json.dumps(dict(overrides or {})), **told)


def check_scene(plan: Plan, store: Store) -> None:
    """See that the first and the last point that are in were of scenes that are still the same, files and all."""
    points = store.points()
    for point, told in store.scenes():
        now = scene_hash(resolved(plan.recipe, points[point].settings)[0])
        if now != told:
            raise InputError(
                f"{store.path}: the scene of point {point} was changed since (then {told}, now {now}); allowed: another"
                " --out, or the scene as it was"
            )


def run(plan: Plan, store: Store, engine: Engine, watch: Watch | None = None) -> Progress:
    """Do all missing trials of a plan's points, or as many as its budget allows."""
    return run_points(plan, store, engine, plan.points, 0, watch)


def run_points(
    plan: Plan, store: Store, engine: Engine, points: Sequence[Point], first: int, watch: Watch | None = None
) -> Progress:
    """Do the missing trials of points `first` and following; rows are in the store once they are counted."""
    replicates = plan.study.replicates
    span = np.arange(first * replicates, (first + len(points)) * replicates)
    missing = span[~store.done(int(span[-1]) + 1)[span]]
    before = store.counts()["failed"]
    progress = Progress(len(span), len(span) - len(missing), before)
    budget = plan.study.budget
    rows = engine.run(plan.recipe, Todo(points, replicates, missing, first)) if len(missing) else iter(())
    try:
        for batch in rows:
            store.add(batch)
            progress.add(batch)
            if watch:
                watch(progress)
            over = budget.time_s is not None and time.perf_counter() - progress.began > budget.time_s
            if over or (budget.failures is not None and progress.failed - before >= budget.failures):
                break
    finally:
        if hasattr(rows, "close"):
            rows.close()
        if progress.now:
            store.ran(engine.name, engine.workers, progress.now, time.perf_counter() - progress.began)
    return progress


def _dask(count: int | None, scheduler: str) -> Engine:
    from skysim.experiments.study.execution.dask_engine import Dask  # needs the extra `dask`

    return Dask(scheduler)


ENGINES: dict[str, Callable[[int | None, str], Engine]] = {
    "pool": lambda count, scheduler: Pool(count),
    "serial": lambda count, scheduler: Serial(),
    "dask": _dask,
}
