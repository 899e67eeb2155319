"""Run the missing trials of a study: chunks of trials go to an engine, and rows are stored as they arrive."""

import json
import shlex
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, replace
from functools import partial
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from estimator.core.types import Attitude, Centroids
from estimator.trackers.pipeline import Report
from skysim.core.errors import InputError
from skysim.core.files import make_folder, write_image
from skysim.core.types import Frame, Ints, Telemetry, Truth
from skysim.core.yaml_reader import OverrideTexts
from skysim.experiments.study.execution.engines import Chunk, Engine, Pool, Serial
from skysim.experiments.study.execution.outcomes import FIELDS
from skysim.experiments.study.execution.store import Store, to_sql
from skysim.experiments.study.execution.trials import (
    REFUSED,
    Row,
    Segment,
    TrialJob,
    TrialSetup,
    code_version,
    lost_in_space,
    prepared_setup,
    render_trial_frame,
    run_block,
    scene_hash,
    solved_centroids,
    trial_flight,
)
from skysim.experiments.study.factors import Point
from skysim.experiments.study.plan import (
    Budget,
    CentroidTrial,
    FlightTrial,
    FrameTrial,
    Plan,
    digest,
    resolve_point,
)
from skysim.results import run_report, scoring, telemetry_report
from skysim.results.files import recording
from skysim.results.run import Recorder
from skysim.simulation.checks import check
from skysim.simulation.lab import Lab

# Run time of a chunk: long relative to its overhead, short in case a worker dies.
CHUNK_S = 0.25
# Beyond so many workers chunks are longer, so that MANY / CHUNK_S end per second: a Dask scheduler handles hundreds.
MANY = 16
MAX_CHUNK = 5000  # maximum number of trials in a chunk


@dataclass(slots=True)
class Progress:
    """Progress of a run.

    Attributes
    ----------
    trials
        Total number of trials
    done, failed, wrong
        Numbers of trials in the store: all, failed ones, and those with a wrong attitude
    now
        Number of trials done by this run since `began`
    uncounted
        Number of failed trials that the budget does not count
    """

    trials: int
    done: int
    failed: int = 0
    wrong: int = 0
    now: int = 0
    began: float = field(default_factory=time.perf_counter)
    uncounted: int = 0

    @property
    def seconds(self) -> float:
        """Time since this run began."""
        return time.perf_counter() - self.began

    @property
    def rate(self) -> float:
        """Trials per second of this run."""
        return self.now / max(self.seconds, 1e-9)

    def exceeds(self, budget: Budget) -> bool:
        """Whether the time or the failures of a budget are spent."""
        return (budget.time_s is not None and self.seconds > budget.time_s) or (
            budget.failures is not None and self.failed - self.uncounted >= budget.failures
        )

    def add(self, rows: list[Row]) -> None:
        """Count finished rows."""
        self.done += len(rows)
        self.now += len(rows)
        self.failed += sum(row.error is not None for row in rows)
        self.wrong += sum(row.outcome.wrong for row in rows)


Watch = Callable[[Progress], Any]


class ChunkQueue:
    """Divides the missing trials of some points into chunks with a run time of about `seconds`.

    Chunks larger than a point are extended to complete points, so that a point's setup is built on one worker only.

    Attributes
    ----------
    missing
        (M,) trial numbers in the order in which they run
    ends
        Where in them segments end: trial numbers are not consecutive, the point or the hardware is another
    """

    def __init__(
        self,
        plan: Plan,
        points: Sequence[Point],
        missing: Ints,
        first: int = 0,
        workers: int = 1,
    ) -> None:
        """Order the trials by point, or if the study's time is limited by replicate, so that no point stays empty.

        Then all points run one replicate before the next one. Beyond the sixth, rounds are a fifth of the replicates
        before them, because trials of a point that run together are faster.
        """
        self.points = points
        self.replicates = replicates = plan.study.replicates
        if plan.study.budget.time_s is not None:
            rounds = np.floor(4 * np.log2(1 + missing % replicates))
            missing = missing[np.lexsort((missing, rounds))]
        self.missing = missing
        self.first = first
        self.spec = plan.spec
        # In proportion to the workers beyond MANY, so that coordination is not the limit.
        self.seconds = CHUNK_S * max(1.0, workers / MANY)
        self.position = 0
        self.size = 1
        apart = (np.diff(missing) != 1) | (missing[1:] % replicates == 0)
        self.ends = np.append(
            np.flatnonzero(apart | bool(plan.spec.hardware)) + 1, len(missing)
        )

    def next(self) -> Chunk:
        """The next chunk; empty if nothing is left."""
        start = self.position
        end = min(start + self.size, len(self.missing))
        if self.size >= self.replicates:
            end = int(self.ends[np.searchsorted(self.ends, end)])
        self.position = end
        within = slice(*np.searchsorted(self.ends, (start + 1, end)))
        return tuple(
            self._segment(trials)
            for trials in np.split(self.missing[start:end], self.ends[within] - start)
            if len(trials)
        )

    def _segment(self, trials: Ints) -> Segment:
        point, replicate = divmod(int(trials[0]), self.replicates)
        settings = self.points[point - self.first].settings
        settings = self.spec.trial_settings(settings, replicate)
        return Segment(
            point, settings, int(trials[0]), range(replicate, replicate + len(trials))
        )

    def report_time(self, chunk: Chunk, seconds: float) -> None:
        """Set the size of the next chunks from the run time of this one; the size at most doubles."""
        count = sum(len(segment.replicates) for segment in chunk)
        size = int(self.seconds * count / max(seconds, 1e-6))
        self.size = int(np.clip(size, 1, min(2 * max(count, self.size), MAX_CHUNK)))


def prepare_store(
    plan: Plan, store: Store, resume: bool, overrides: OverrideTexts | None = None
) -> None:
    """Initialize a store for a plan, or check that it belongs to the plan.

    The store may be of the same study with fewer replicates: its trials are kept and renumbered.

    Parameters
    ----------
    resume
        Whether to continue a store that already has trials
    overrides
        Study keys from the command line, saved in the store

    Raises
    ------
    InputError
        If the store holds another study or rows of another code version, or if `resume` does
        not fit.
    """
    stored = store.meta("digest")
    done = store.counts()["done"]
    kept = stored_replicates(plan, store) if stored else plan.study.replicates
    if not kept:
        raise InputError(
            store.path,
            "contains another study, or an earlier version of this one",
            "another store",
        )
    if resume and not stored:
        raise InputError(store.path, "contains no trials to resume", "to run the study")
    if done and not resume:
        raise InputError(
            store.path,
            f"already contains {done} trials",
            "to resume the study, or another store",
        )
    if done and store.meta("code") != code_version():
        problem = f"its {done} trials are of skysim {store.meta('code')}"
        raise InputError(
            store.path, problem, f"{code_version()}, the version here, or another store"
        )
    if done:
        check_functions(plan, store)
        check_scene(plan, store)
    if stored != plan.digest or not done:
        begin_store(plan, store, (kept, plan.study.replicates) if done else None, overrides)


def begin_store(
    plan: Plan,
    store: Store,
    grown: tuple[int, int] | None = None,
    overrides: OverrideTexts | None = None,
) -> None:
    """Set the points and the metadata of a plan; its first points may be those that the store has (`Store.begin`)."""
    store.begin(
        plan.points,
        grown=grown,
        study=plan.text,
        file=str(plan.path.resolve()),
        title=plan.study.title,
        code=code_version(),
        digest=plan.digest,
        functions=json.dumps(plan.spec.digests),
        factors=", ".join(plan.study.factors),
        replicates=str(plan.study.replicates),
        overrides=json.dumps(dict(overrides or {})),
    )


def stored_replicates(plan: Plan, store: Store) -> int:
    """Number of replicates in the store if its study is the plan's, with as many replicates or fewer; else 0."""
    if plan.digest == store.meta("digest"):
        return plan.study.replicates
    if (
        plan.study.optimize is not None
    ):  # a search has chosen its candidates by all replicates
        return 0
    with store.corruption_as_input_error():
        fewer = int(store.meta("replicates") or 0)
    same = replace(plan, study=plan.study.with_values(replicates=fewer)).digest == store.meta(
        "digest"
    )
    return fewer if same and 0 < fewer < plan.study.replicates else 0


def check_functions(plan: Plan, store: Store) -> None:
    """Raise InputError if a tracker or controller given in Python differs from that of the stored trials."""
    with store.corruption_as_input_error():
        kept = dict(json.loads(store.meta("functions") or "{}"))
    now = plan.spec.digests
    for name in sorted({*kept, *now}):
        if kept.get(name) != now.get(name):
            then = f"code {kept[name]} then" if name in kept else "not given in Python then"
            problem = f"{name}: {then}, {now.get(name, 'not given')} now"
            raise InputError(store.path, problem, "another store, or the original function")


def check_scene(plan: Plan, store: Store) -> None:
    """Raise InputError if a point, the scene of the first or the last stored one, or a file it names, has changed."""
    points = store.points()
    if plan.study.optimize is None and digest(points) != digest(plan.points):
        raise InputError(
            store.path,
            "its points are not the study's: other levels, or factors in another order",
            "another store, or the original study",
        )
    for point, replicate, stored in store.scenes():
        with store.corruption_as_input_error():
            settings = plan.spec.trial_settings(points[point].settings, replicate)
        now = scene_hash(resolve_point(plan.spec, settings)[0], plan.spec.digests)
        if now != stored:
            raise InputError(
                store.path,
                f"the scene of point {point} has changed (hash {stored} then, {now} now)",
                "another store, or the original scene",
            )


def run(
    plan: Plan,
    store: Store,
    engine: Engine,
    watch: Watch | None = None,
    points: Sequence[Point] = (),
    first: int = 0,
    total: Progress | None = None,
) -> Progress:
    """Run all missing trials of a plan, or of these `points` numbered from `first`, within its time and failures.

    Rows are stored before they are counted, so a killed run loses at most the chunks in flight.

    Parameters
    ----------
    total
        Progress of the search that these points are part of
    """
    points = points or plan.points
    replicates = plan.study.replicates
    numbers = np.arange(first * replicates, (first + len(points)) * replicates)
    missing = numbers[~store.done(int(numbers[-1]) + 1)[numbers]]
    failed = store.counts()["failed"]
    own = Progress(len(numbers), len(numbers) - len(missing), failed, uncounted=failed)
    progress = total or own
    before = progress.now
    queue = ChunkQueue(plan, points, missing, first, engine.workers)
    rows = engine.run(TrialJob(plan.spec), queue) if len(missing) else iter(())
    try:
        for batch in rows:
            store.add(batch)
            progress.add(batch)
            if watch:
                watch(progress)
            if progress.exceeds(plan.study.budget):
                break
    finally:
        if hasattr(rows, "close"):
            rows.close()
        if done := progress.now - before:
            store.record_run(engine.name, engine.workers, done, own.seconds)
    return progress


def _dask(count: int | None, scheduler: str) -> Engine:
    from skysim.experiments.study.execution.dask_engine import Dask  # needs the extra `dask`

    return Dask(scheduler)


ENGINES: dict[str, Callable[[int | None, str], Engine]] = {
    "pool": lambda count, scheduler: Pool(count),
    "serial": lambda count, scheduler: Serial(),
    "dask": _dask,
}


# Repeat one trial of a study and write its frames for inspection.


MAX_FRAMES = 100  # maximum number of frames annotated for a flight


class Replay(NamedTuple):
    """A repeated trial: its row, names of stored quantities that differ now, files, annotated images.

    Attributes
    ----------
    reasons
        Why a flight went wrong, in words: actuators at their limits, pointing, refused frames
    """

    row: Row
    changed: list[str]
    files: list[Path]
    pictures: list[Path]
    reasons: list[str]


# Makes pictures of a laboratory and its motion in a folder.
Draw = Callable[[Lab, Telemetry, Path], Sequence[Path]]


def segment_of(plan: Plan, store: Store, trial: int) -> Segment:
    """The segment with this trial alone. Raises InputError if the study has no such trial."""
    points = store.points()
    each = plan.study.replicates
    if not 0 <= trial < len(points) * each:
        raise InputError(
            f"trial {trial}", "not in the study", f"0 to {len(points) * each - 1}"
        )
    (segment,) = ChunkQueue(plan, points, np.array([trial])).next()
    return segment


def replay(
    plan: Plan, store: Store, trial: int, folder: Path, draw: Draw | None = None
) -> Replay:
    """Repeat a trial with its seed, and write its frame, or the files of `skysim run` for a flight, annotated.

    Only the first MAX_FRAMES frames of a flight are annotated. An exception of the trial is in its row; frames
    rendered before it are also written.
    """
    segment = segment_of(plan, store, trial)
    (row,) = run_block(plan.spec, segment)
    reasons: list[str] = []
    stored = store.trial(trial) if store.done(trial + 1)[trial] else {}
    changed = [
        name
        for name in FIELDS
        if stored and stored[name] != to_sql(getattr(row.outcome, name))
    ]
    if row.scene not in ("", REFUSED):  # an invalid scene has no lab
        setup = prepared_setup(plan.spec, segment.settings)
        recording.remove_results(make_folder(folder))
        try:
            if isinstance(setup.trial, FlightTrial):
                command = shlex.join(
                    ["skysim", "study", "replay", str(plan.path), str(trial)]
                )
                reasons = replay_flight(setup, row.seed, folder, command, draw)
            else:
                frame, truth, report = replayed_frame(setup, row.seed)
                recording.write_frame(folder, frame, truth, setup.lab.scene)
                write_annotated(folder, frame, truth, report)
        except Exception:
            if row.error is None:
                raise
    files = [*sorted(folder.glob("frame_*.fits")), *sorted(folder.glob("[rst]*.*"))]
    pictures = sorted(folder.glob("frame_*.annotated.png"))
    return Replay(row, changed, files, pictures, reasons)


def write_annotated(folder: Path, frame: Frame, truth: Truth, report: Report) -> None:
    """Write a frame with the lights that the tracker found, those that it matched, and the true ones."""
    picture = scoring.annotated(frame, truth, report)
    write_image(folder / f"frame_{frame.index:04d}.annotated.png", picture)


def replay_flight(
    setup: TrialSetup, seed: int, folder: Path, command: str, draw: Draw | None
) -> list[str]:
    """Fly a trial again and write its frames, solutions, telemetry, report and pictures. Returns what went wrong."""
    with trial_flight(setup, seed) as flight:
        recorder = Recorder(folder, flight.lab.camera)
        for shot in flight.shots(cameras=[0]):
            recorder.add(scoring.Score(shot))
            if shot.frame.index < MAX_FRAMES:
                write_annotated(folder, shot.frame, shot.truth, shot.solution)
        if not recorder.rows:
            return []
        log = flight.telemetry()
        plan = check(flight.lab)
        pictures = draw(flight.lab, log, folder) if draw else ()
        recorder.finish(command, log, flight.imu_samples(), plan, pictures)
        return [
            *telemetry_report.findings(log),
            *run_report.refusals(recorder.rows, plan.findings),
        ]


def replayed_frame(setup: TrialSetup, seed: int) -> tuple[Frame, Truth, Report]:
    """The frame of a trial, of a flight the first one, with truth and report.

    A centroid trial has no frame, so one is rendered at its attitude and shown with the trial's own centroids.
    """
    trial = setup.trial
    if isinstance(trial, CentroidTrial):
        attitude = trial.model_dump(include={"tilt_deg", "dec_deg", "near"})
        frame_trial = FrameTrial(kind="frames", **attitude)
        frame, truth, _ = render_trial_frame(setup._replace(trial=frame_trial), seed)
        return (
            frame,
            truth,
            solve_or_failed(lambda: solved_centroids(setup, [seed])[0][1]),
        )
    if isinstance(trial, FlightTrial):
        with trial_flight(setup, seed) as flight:
            shot = next(flight.shots(cameras=[0]))
            return shot.frame, shot.truth, shot.solution
    frame, truth, streak_px = render_trial_frame(setup, seed)
    solve = partial(lost_in_space, setup, frame, truth, streak_px)
    return frame, truth, solve_or_failed(solve)


def solve_or_failed(solve: Callable[[], Report]) -> Report:
    """The tracker's report, or an empty one if it raises; the trial's row holds the exception."""
    try:
        return solve()
    except Exception as error:
        return Report(Attitude(f"failed: {error}"), Centroids.empty())
