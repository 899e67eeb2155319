"""Studies of millions of rows: time, CPU and memory of `skysim study report` and `skysim study export`.

The rows, 10 million of 10 points, are drawn, not simulated: a tracker with errors of arcseconds that refuses 1 % of the
attitudes and is wrong in one of a million.
"""

from __future__ import annotations

import multiprocessing
import os
import subprocess
import sys
import tempfile
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from benchmarks.timing import verdict
from skysim.core.files import make_folder
from skysim.experiments.study import study_file
from skysim.experiments.study.execution import runner, store
from skysim.results.files import row_parts

STUDY = """
schema: 1
title: a study of many rows
scene: shefex2
seed: 1
trial: {{kind: centroids, noise_px: 0.1}}
factors: {{limit: {{key: light.limit_mag, values: {levels}}}}}
replicates: {replicates}
responses: [identified, cross_arcsec_rms, cross_arcsec_p95, roll_arcsec_mean, roll_arcsec_median, stars_least]
figures:
  - {{kind: curve, x: limit, y: cross_arcsec_p95}}
  - {{kind: map, value: cross_arcsec_p95}}
  - {{kind: map, value: refused}}
"""
ROWS = 10_000_000
POINTS = 10
FILE = "big.yaml"
REPORT_S = 60.0
REPORT_BYTES = 2e9
EXPORT_S = 600.0
EXPORT_BYTES = 1e9
ROW_BYTES = 335.0


def build(folder: Path, rows: int, points: int) -> None:
    """Write a study and its store as a run leaves it."""
    path = folder / FILE
    path.write_text(
        STUDY.format(
            levels=np.linspace(5.0, 6.5, points).round(4).tolist(), replicates=rows // points
        )
    )
    study = study_file.load(path)
    with store.writing(folder / store.STORE) as database:
        runner.prepare_store(study, database, False)
        each = study.study.replicates
        first = 0
        part = 0
        while study.trials - first > store.PART_ROWS:
            columns = drawn(first, store.PART_ROWS, each)
            part = part + 1
            del columns["trial"]
            make_folder(database.parts_folder)
            row_parts.write_part(database.part_path(part), columns)
            ends = [int(columns["point"][row]) for row in (0, -1)]
            row = (part, store.PART_ROWS, int(columns["wrong"].sum()), *ends)
            with database.db:
                database.db.execute("INSERT INTO parts VALUES (?, ?, ?, ?, ?)", row)
                database.db.execute(
                    "UPDATE meta SET value = ? WHERE key = 'format'",
                    (str(store.FORMAT_OF_PARTS),),
                )
            first += store.PART_ROWS
        insert(database, drawn(first, study.trials - first, each))
        database.record_run("pool", 2, study.trials, study.trials / 830)


def insert(database: store.Store, columns: dict[str, NDArray[Any]]) -> None:
    """Add rows to SQLite."""
    names = [name for name in store.COLUMNS if name not in store.TIMES]
    values = zip(*(map(store.to_sql, columns[name].tolist()) for name in names), strict=True)
    with database.db:
        database.db.executemany(store.INSERT, values)
        times = zip(
            *(columns[name].tolist() for name in ("trial", *store.TIMES)), strict=True
        )
        database.db.executemany("INSERT INTO timings VALUES (?, ?, ?, ?)", times)


def drawn(first: int, count: int, each: int) -> dict[str, NDArray[Any]]:
    """Rows of consecutive trials, by column; `each` is the number of a point's replicates."""
    rng = np.random.default_rng(first)
    trial = np.arange(first, first + count)
    columns: dict[str, NDArray[Any]] = {
        name: np.full(count, np.nan) for name in store.COLUMNS
    }
    columns |= {
        "trial": trial,
        "point": trial // each,
        "replicate": trial % each,
        "seed": rng.integers(2**62, size=count),
    }
    columns |= {name: np.full(count, "0" * 16, dtype=object) for name in ("scene", "code")}
    solved = rng.random(count) > 0.01
    wrong = solved & (rng.random(count) < 1e-6)
    status = np.array(["no attitude fits the lights", "solved"], dtype=object)[
        solved.astype(int)
    ]
    columns |= {"status": status, "error": np.full(count, None, dtype=object)}
    columns |= {
        "frames": np.ones(count, int),
        "solved": solved.astype(int),
        "wrong": wrong.astype(int),
    }
    columns["ambiguous"] = np.zeros(count, int)
    columns |= {
        name: np.zeros(count)
        for name in ("misidentified", "roll_noise", "misled", "wrong_matches")
    }
    scale = np.where(wrong, 1e4, 1.0)
    for name, sigma_arcsec in (("x_arcsec", 6.0), ("y_arcsec", 6.0), ("roll_arcsec", 60.0)):
        columns[name] = np.where(solved, rng.normal(0, sigma_arcsec, count) * scale, np.nan)
    columns["nees"] = np.where(solved, rng.chisquare(3, count) * scale**2, np.nan)
    stars = rng.poisson(20, count).astype(float)
    columns |= {"stars": stars, "detected": stars, "matched": np.where(solved, stars, 0.0)}
    columns |= {
        "centroid_px": rng.normal(0.1, 0.02, count),
        "time_ms": rng.gamma(9, 0.4, count),
    }
    columns |= {f"lab_from_body_{part}": rng.uniform(-0.5, 0.5, count) for part in "wxyz"}
    columns["boresight_ra_deg"] = rng.uniform(0, 360, count)
    columns["boresight_dec_deg"] = np.degrees(np.arcsin(rng.uniform(-1, 1, count)))
    return columns


def measure(count: int = ROWS) -> list[dict[str, Any]]:
    """Size of a row, time and memory of the commands, for a store of `count` rows."""
    return list(results(count, POINTS))


def results(rows: int, points: int) -> Iterator[dict[str, Any]]:
    """All results, as they come."""
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        path = folder / FILE
        what = f"{rows:,} rows of {points} points"
        # In a process of its own: a command begins with the memory of the process that starts it.
        builder = multiprocessing.get_context("spawn").Process(
            target=build, args=(folder, rows, points)
        )
        builder.start()
        builder.join()
        size = sum(file.stat().st_size for file in folder.rglob("*") if file.is_file())
        yield verdict("bytes of a row, parts and SQLite", size / rows, "B", what, ROW_BYTES)
        out = ("--out", str(folder))
        yield from timed("report", what, REPORT_S, REPORT_BYTES, str(path), *out)
        for suffix in ("parquet", "csv"):
            file = str(folder / f"rows.{suffix}")
            yield from timed(
                "export", f"{suffix}, {what}", EXPORT_S, EXPORT_BYTES, str(path), file, *out
            )


def timed(
    command: str, what: str, most_s: float, most: float, *words: str
) -> Iterator[dict[str, Any]]:
    """Seconds, with those of CPU, and greatest memory of a command."""
    begin = time.perf_counter()
    process = subprocess.Popen(
        [sys.executable, "-m", "skysim", "study", command, *words], stdout=subprocess.DEVNULL
    )
    _, status, used = os.wait4(process.pid, 0)
    if status:
        raise RuntimeError(f"skysim study {command} {' '.join(words)}: status {status}")
    cpu_s = used.ru_utime + used.ru_stime
    yield verdict(
        f"study {command}",
        time.perf_counter() - begin,
        "s",
        f"{what}; {cpu_s:.0f} s of CPU",
        most_s,
    )
    yield verdict(
        f"study {command}: memory", 1024 * used.ru_maxrss / 1e6, "MB", what, most / 1e6
    )
