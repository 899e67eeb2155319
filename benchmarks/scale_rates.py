"""Throughput from one frame to many: labelled frames in shards, centroid trials in the store, closed loops, clusters.

For a quiet machine with two cores. Rates are those of the clock; the costs of a frame's parts and of a trial are
seconds of CPU, which other load lengthens less. docs/explanation/scale.md uses them.
"""

from __future__ import annotations

import tempfile
import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import closing, contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import mujoco
import numpy as np
import yaml

from benchmarks import scale_coordination as coordination
from benchmarks.timing import figure, verdict
from skysim.camera.detector import AddedCharge
from skysim.core.errors import InputError
from skysim.experiments import dataset_run, dataset_shards
from skysim.experiments.dataset_shards import label_frame, labeller
from skysim.experiments.study import study_file as study_loader
from skysim.experiments.study.execution import engines, runner, store, trials
from skysim.experiments.study.plan import Plan
from skysim.scene import loader
from skysim.simulation.flight import Flight
from skysim.simulation.lab import build_lab

SIZE = {"camera.width_px": "1024", "camera.height_px": "1024"}
# 20 degrees and stars to V 7, as in benchmarks/instrument.py, with all noise of a CMOS chip: shot and read noise, dark
# current, PRNU, DSNU, hot pixels. The CCD of shefex2 has readout smear, transfer loss and blooming besides.
CMOS = SIZE | {
    "camera.focal_length": "28.7 mm",
    "light.limit_mag": "7",
    "camera.shutter": "{kind: global}",
    "camera.detector.cti_parallel": "0",
    "camera.detector.cti_serial": "0",
    "camera.detector.blooming": "none",
}
FRAMES = 640
PER_SHARD = 16
PARTS = 64  # frames of which the parts are timed
STUDY = """
schema: 1
title: how fast studies are
scene: shefex2
seed: 1
trial: {trial}
factors: {{{factor}}}
replicates: {replicates}
responses: [identified]
"""
CENTROIDS = {
    "trial": "{kind: centroids, noise_px: 0.1, lights: 15}",
    "factor": "strays: {key: trial.false_lights, values: [0, 5]}",
    "replicates": 5000,
}
WARM_UP = 0.2  # fraction of the trials after which every worker has its scene and full chunks
DASK_S = 1.0
DASK_CHUNKS = 12


def measure() -> list[dict[str, Any]]:
    """All results."""
    return [
        *frames(),
        *parts(),
        *centroids(),
        *closed_loop(),
        *worker_cost(),
        dask_overhead(),
    ]


# Labelled frames.


def small_plan(
    count: int = FRAMES, per_shard: int = PER_SHARD, keys: dict[str, str] = CMOS
) -> dataset_run.DatasetPlan:
    """Frames of 1024 x 1024 pixels."""
    return dataset_run.load(
        "shefex2", None, count, overrides=keys, frames_per_shard=per_shard
    )


def frames() -> list[dict[str, Any]]:
    """Frames written to shards in a second, by two workers and by one."""
    rates = {workers: frames_hz(workers) for workers in (2, 1)}
    return [
        verdict(
            "labelled 1024 x 1024 frames to shards, two workers",
            rates[2],
            "/s",
            "CMOS",
            400.0,
            True,
        ),
        verdict(
            "frames: two workers over one",
            rates[2] / rates[1],
            "x",
            f"{rates[1]:.0f}/s of one",
            1.9,
            True,
        ),
    ]


def frames_hz(workers: int) -> float:
    """Frames in a second, from the end of the second shard of each worker to that of the last one."""
    arrived: list[tuple[float, int]] = []
    with tempfile.TemporaryDirectory() as folder, closing(engines.Pool(workers)) as pool:
        dataset_run.run(
            small_plan(),
            f"{folder}/frames",
            pool,
            lambda at: arrived.append((time.perf_counter(), at.now)),
        )
    first = next(n for n, (_, now) in enumerate(arrived) if now >= 2 * workers * PER_SHARD)
    (begin_s, before), (end_s, after) = arrived[first], arrived[-1]
    return (after - before) / (end_s - begin_s)


def parts() -> list[dict[str, Any]]:
    """CPU time of a frame's parts on one core, and which of them is the greatest."""
    rows = []
    for name, keys in (("CMOS", CMOS), ("CCD", SIZE)):
        spent = parts_of(small_plan(PARTS, PARTS, keys))
        total = sum(spent.values())
        most = max(spent, key=lambda part: spent[part])
        rows += [
            figure(
                f"CPU of a {name} frame", total, "ms", f"{most} is {spent[most] / total:.0%}"
            )
        ]
        rows += [
            figure(f"- {part}", ms, "ms", f"{ms / total:.0%}") for part, ms in spent.items()
        ]
    return rows


def parts_of(made: dataset_run.DatasetPlan) -> dict[str, float]:
    """Milliseconds of CPU of a frame: render; label (detection, masks); encode (COCO, numbers); write (the tar)."""
    spent = dict.fromkeys(("render", "label", "encode", "write"), 0.0)
    with tempfile.TemporaryFile() as file:
        by = None
        for number, levels, setup, one in dataset_run.labelled_frames(made, 0):
            by = by or labeller(setup.lab.scene)
            seed = made.seed(number)
            with timed(spent, "render"):
                trials.render_trial_frame(setup, seed, AddedCharge(by.threshold_e))
            with timed(spent, "label"):
                label_frame(setup, seed, by)
            with timed(spent, "encode"):
                row = dataset_shards.frame_labels(
                    one, setup.lab.scene, {"frame": number, "shard": 0, "seed": seed}
                )
                dataset_shards.coco_annotations(one, number)
            with timed(spent, "write"):
                dataset_shards.add_frame(file, number, one, row | {"levels": levels}, False)
    spent["label"] -= spent["render"]
    return {name: 1e3 * seconds / PARTS for name, seconds in spent.items()}


@contextmanager
def timed(spent: dict[str, float], name: str) -> Iterator[None]:
    """Add the CPU time of a block."""
    begin = time.process_time()
    yield
    spent[name] += time.process_time() - begin


# Trials, motion, clusters.


class TimedPool:
    """A pool that records each batch. batches : (arrival time, number of trials, seconds spent in trials) by batch."""

    def __init__(self, pool: engines.Pool) -> None:
        self.pool = pool
        self.name = pool.name
        self.workers = pool.workers
        self.batches: list[tuple[float, int, float]] = []

    def run(self, job: engines.Job, chunks: engines.Chunks) -> Iterator[list[trials.Row]]:
        """See `engines.Engine`."""
        for rows in self.pool.run(job, chunks):
            self.batches.append(
                (time.perf_counter(), len(rows), sum(row.seconds for row in rows))
            )
            yield rows


@dataclass(frozen=True)
class StudyTime:
    """Time of a study.

    total_s     : from loading the file to closing the store, including start and end of the processes
    rate        : trials per second after the first WARM_UP of them
    overhead_ms : worker time per trial that was not spent in the trial itself
    """

    total_s: float
    rate: float
    overhead_ms: float


def run_study(settings: dict[str, Any], workers: int) -> StudyTime:
    """Run a study with a pool in a temporary folder."""
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "study.yaml"
        path.write_text(STUDY.format(**settings))
        pool = TimedPool(engines.Pool(workers))
        begin = time.perf_counter()
        study = study_loader.load(path)
        with store.writing(path.with_suffix(".sqlite")) as database:
            runner.prepare_store(study, database, False)
            progress = runner.run(study, database, pool)
        total_s = time.perf_counter() - begin
    if (progress.done, progress.failed) != (study.trials, 0):
        raise RuntimeError(
            f"{progress.done} of {study.trials} trials are in, {progress.failed} of them failed"
        )
    when_s, count, worked_s = np.array(pool.batches).T
    late = np.cumsum(count) > WARM_UP * study.trials
    first = int(np.argmax(late))  # the timed window starts at its end
    window_s = when_s[-1] - when_s[first]
    done = count[first + 1 :].sum()
    beside_s = workers * window_s - worked_s[first + 1 :].sum()
    return StudyTime(total_s, done / window_s, 1e3 * beside_s / done)


def centroids() -> list[dict[str, Any]]:
    """Centroid trials in a second with the store, by two workers and by one."""
    two, one = (run_study(CENTROIDS, workers) for workers in (2, 1))
    return [
        verdict(
            "centroid trials with the store, two workers", two.rate, "/s", "", 5000.0, True
        ),
        verdict(
            "centroids: two workers over one",
            two.rate / one.rate,
            "x",
            f"{one.rate:.0f}/s of one",
            1.9,
            True,
        ),
        figure(
            "centroids: beside the trial itself",
            one.overhead_ms,
            "ms",
            "a trial of one worker",
        ),
        figure("centroids: a trial in this process", trial_ms(), "ms", "CPU"),
    ]


def trial_ms(count: int = 512) -> float:
    """CPU of a centroid trial, of both points."""
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "study.yaml"
        path.write_text(STUDY.format(**CENTROIDS))
        study = study_loader.load(path)
    job = trials.TrialJob(study.spec)
    chunk = tuple(
        trials.Segment(n, point.settings, n * count, range(count))
        for n, point in enumerate(study.points)
    )
    (spent_s,) = best_cpu_s([lambda: job.run(chunk)], repeats=3)
    return 1e3 * spent_s / (count * len(chunk))


def closed_loop() -> list[dict[str, Any]]:
    """SimSat on its wheels under control, against mj_step with the same controls, which ends in the same state."""
    wheels = {
        "vehicle.wheels": "{}",
        "motion.control": "{actuators: wheels}",
        "exposure.frames": "3",
    }
    lab = build_lab(loader.load("afit_simsat", wheels))
    model = lab.vehicle.model
    controls: list[np.ndarray] = []

    def replay() -> None:
        data = mujoco.MjData(model)
        for control in controls:
            data.ctrl[:] = control
            for _ in range(10):
                mujoco.mj_step(model, data)

    flight = Flight(lab)
    while not flight.is_over:
        flight.advance([])
    controls.extend(flight.motion.rows["control"])
    works = (lambda: Flight(lab).simulate_motion(), replay, lambda: Flight(lab))
    flown_s, alone_s, start_s = best_cpu_s(works)
    part_us = 1e6 * (flown_s - start_s - alone_s) / len(controls)
    name = "closed loop on wheels"
    return [
        verdict(name, alone_s / flown_s, "x", "mj_step alone, CPU", 0.9, True),
        verdict(name, lab.duration_s / flown_s, "x real time", "CPU", 100.0, True),
        figure(f"{name}: beside mj_step", part_us, "us", "a control period of 10 ms"),
        figure(f"{name}: its start", 1e3 * start_s, "ms"),
    ]


def best_cpu_s(works: Sequence[Callable[[], object]], repeats: int = 20) -> list[float]:
    """The least CPU time of each, of some rounds in which they take turns."""
    spent_s = np.empty((repeats, len(works)))
    for n in range(repeats):
        for k, work in enumerate(works):
            work()  # refill the caches, which the other works have used
            begin_s = time.process_time()
            work()
            spent_s[n, k] = time.process_time() - begin_s
    return spent_s.min(axis=0).tolist()


def worker_cost() -> list[dict[str, Any]]:
    """Start of a worker after the first, and its memory with as many setups as it keeps, of the worst shipped scene."""
    started_s = {}
    held_mb = {}
    for name in loader.list_scenes():
        try:
            study = four_exposures(name)
        except InputError:  # its lights are not solved frame by frame
            continue
        engines.start_pool(1, trials.TrialJob(study.spec)).shutdown()
        begin_s = time.perf_counter()
        with engines.start_pool(1, trials.TrialJob(study.spec)) as pool:
            started_s[name] = time.perf_counter() - begin_s
            for n, point in enumerate(study.points):
                pool.submit(
                    engines.run_chunk, (trials.Segment(n, point.settings, n, range(1)),)
                ).result()
            held_mb[name] = private_mb(next(iter(pool._processes)))
    slowest = max(started_s, key=started_s.__getitem__)
    largest = max(held_mb, key=held_mb.__getitem__)
    return [
        verdict("start of a worker after the first", started_s[slowest], "s", slowest, 1.0),
        verdict(
            "memory of a worker with four setups", held_mb[largest], "MB", largest, 350.0
        ),
    ]


def four_exposures(name: str) -> Plan:
    """A study of a scene with four exposure times, each of which is a setup of its own."""
    scene = loader.load(name)
    kind = "centroids" if scene.tracker.decoder else "frames"
    times = [
        f"{1e3 * scene.exposure.time_s * share:.6g} ms" for share in (1.0, 0.99, 0.98, 0.97)
    ]
    tree = {
        "scene": name,
        "seed": 1,
        "trial": {"kind": kind},
        "factors": {"time": {"key": "exposure.time", "values": times}},
    }
    with tempfile.NamedTemporaryFile("w", suffix=".yaml") as file:
        yaml.safe_dump(
            tree
            | {"schema": 1, "title": "memory", "replicates": 1, "responses": ["identified"]},
            file,
        )
        file.flush()
        return study_loader.load(Path(file.name))


def private_mb(pid: int) -> float:
    """Memory that a process shares with no other, which is what a further worker takes."""
    lines = Path(f"/proc/{pid}/smaps_rollup").read_text().splitlines()
    return sum(int(line.split()[1]) for line in lines if line.startswith("Private_")) / 1024


def dask_overhead() -> dict[str, Any]:
    """What Dask adds to chunks of one second on two workers that do nothing but wait."""
    with coordination.dask(workers=2) as engine:
        hertz = coordination.pace(engine, 2, DASK_S, rounds=DASK_CHUNKS // 2).hertz
    percent = 100 * (2 / DASK_S / hertz - 1)
    return verdict("overhead of Dask, chunks of 1 s", percent, "%", "two workers", 10.0)
