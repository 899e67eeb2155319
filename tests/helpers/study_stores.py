"""Shared by tests of studies: a study, the contents of a store, and running a study into a store."""

from __future__ import annotations

import sqlite3
from collections.abc import Callable
from pathlib import Path

import yaml

from skysim.core.types import Ints
from skysim.experiments.study import plan, study_file
from skysim.experiments.study.execution import engines, runner, store
from skysim.experiments.study.factors import Point

STRAYS = """
schema: 1
title: strays
scene: shefex2
seed: 1
set: {light.limit_mag: 5.0}
trial: {kind: centroids, lights: 15}
factors: {strays: {key: trial.false_lights, values: [0, 5, 9]}}
replicates: 40
responses: [identified]
"""


def contents(path: Path) -> str:
    """Points and trials, row for row, to the last bit and with their types."""
    db = sqlite3.connect(path)
    tables = [
        db.execute(f"SELECT * FROM {name} ORDER BY 1").fetchall()
        for name in ("points", "trials")
    ]
    db.close()
    return repr(tables)


def queue_of(
    points: list[Point],
    replicates: int,
    missing: Ints,
    first: int = 0,
    workers: int = 1,
    budget: str = "{}",
) -> runner.ChunkQueue:
    """The chunks of a study of these points."""
    tree = yaml.safe_load(STRAYS) | {
        "replicates": replicates,
        "budget": yaml.safe_load(budget),
    }
    study = plan.Study.model_validate(tree)
    made = study_file.make_plan(Path("strays.yaml"), study, tree["trial"], {}, "")
    return runner.ChunkQueue(made, points, missing, first, workers)


def done(
    study_plan: plan.Plan,
    path: Path,
    engine: engines.Engine | None = None,
    resume: bool = False,
    watch: Callable[[runner.Progress], object] | None = None,
) -> runner.Progress:
    """Run a study's missing trials, in this process if no engine is given."""
    with store.writing(path) as kept:
        runner.prepare_store(study_plan, kept, resume)
        return runner.run(study_plan, kept, engine or engines.Serial(), watch)
