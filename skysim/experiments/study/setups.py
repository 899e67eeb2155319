"""Prepared test beds and trackers for trials, cached per worker; hashes and seeds that record a row's origin."""

from __future__ import annotations

import threading
from collections import OrderedDict
from dataclasses import replace
from functools import cache
from hashlib import sha256
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from skysim.core.paths import DATA, ROOT
from skysim.experiments.study.factors import Settings
from skysim.experiments.study.plan import CentroidTrial, FlightTrial, FrameTrial, TrialSpec, digest, resolved
from skysim.scene.loader import FILES
from skysim.scene.scene import Scene
from skysim.simulation import testbed
from skysim.simulation.testbed import Testbed
from skysim.tracking import factory
from skysim.tracking.external import interface

KEPT = 4  # benches that a worker caches


class Setup(NamedTuple):
    """A scene prepared for trials: hardware without simulated motion, tracker with its index, trial, scene hash."""

    lab: Testbed
    estimator: factory.Estimator
    trial: CentroidTrial | FrameTrial | FlightTrial
    scene_hash: str


class Shelf(threading.local):
    """Least-recently-used cache of benches. One per thread, because a test bed's canvas serves one trial at a time."""

    def __init__(self) -> None:
        self.benches: OrderedDict[str, Setup] = OrderedDict()


SHELF = Shelf()


def prepared_setup(recipe: TrialSpec, settings: Settings) -> Setup:
    """The bench of a design point, from the cache if it is there. Raises InputError."""
    key = digest([recipe.scene, recipe.folder, recipe.base, recipe.trial, recipe.programs, settings])
    shelf = SHELF.benches
    if key not in shelf:
        shelf[key] = set_up(recipe, settings)
        while len(shelf) > KEPT:
            shelf.popitem(last=False)
    shelf.move_to_end(key)
    return shelf[key]


def set_up(recipe: TrialSpec, settings: Settings) -> Setup:
    """Build hardware and tracker of a point, or reuse those of a cached bench that differs only in its trial."""
    scene, trial = resolved(recipe, settings)
    told = scene_hash(scene)
    for ready in SHELF.benches.values():
        if ready.scene_hash == told and ready.lab.programs == recipe.programs:
            return ready._replace(trial=trial)
    lab = like_before(scene) or testbed.build_testbed(scene, recipe.programs)
    lab = replace(lab, programs=recipe.programs)
    return Setup(lab, testbed.tracker(lab), trial, told)


def like_before(scene: Scene) -> Testbed | None:
    """The test bed of a cached bench whose scene differs only in section `tracker`, so that the hardware is the same.

    Returns None if there is no such bench.
    """
    for ready in SHELF.benches.values():
        if ready.lab.scene.model_copy(update={"tracker": scene.tracker}) == scene:
            return replace(ready.lab, scene=scene)
    return None


def scene_hash(scene: Scene) -> str:
    """Hash of a scene, of the contents of the files it names, and of the release of an external tracker."""
    tree = scene.model_dump(mode="json", by_alias=True)
    named = [sha256(Path(path).read_bytes()).hexdigest() for path in files_of(tree)]
    return digest([tree, named, interface.release(scene.tracker.name)])


def files_of(tree: dict[str, Any]) -> list[str]:
    """Paths of the files that a scene names in its keys, if they exist."""
    found = []
    for keys in FILES:
        node: Any = tree
        for key in keys:
            node = node.get(key) if isinstance(node, dict) else None
        if isinstance(node, str) and Path(node).is_file():
            found.append(node)
    return found


@cache
def code_version() -> str:
    """Hash of the source code of skysim and estimator and of their data; stored with each trial."""
    told = sha256()
    sources = [path for package in ("skysim", "estimator") for path in (ROOT / package).rglob("*.py")]
    data = [
        path
        for part in ("qe", "led", "bands", "cameras")
        for path in (DATA / part).rglob("*")
        if path.is_file()
    ]
    for path in sorted(sources + data):
        told.update(path.relative_to(ROOT).as_posix().encode() + b"\0" + path.read_bytes() + b"\0")
    return told.hexdigest()[:16]


def seed_of(recipe: TrialSpec, point: int, replicate: int) -> int:
    """Seed of a trial, 63 bits, derived from the study's seed; with `paired` it is the same at every point."""
    key = (replicate,) if recipe.paired else (replicate, point)
    return int(np.random.SeedSequence(recipe.seed, spawn_key=key).generate_state(1, np.uint64)[0] >> 1)
