"""Prepared labs and trackers for trials, cached per worker; hashes and seeds that record a row's origin."""

import threading
from collections import OrderedDict
from collections.abc import Mapping
from functools import cache
from hashlib import sha256
from pathlib import Path
from typing import NamedTuple

import numpy as np

from skysim.core.paths import DATA, ROOT
from skysim.core.plugins import NO_PROGRAMS, Programs
from skysim.dynamics.controllers import CONTROLLERS
from skysim.experiments.study.factors import Settings
from skysim.experiments.study.plan import Trial, TrialSpec, digest, resolve_point
from skysim.scene.loader import file_names
from skysim.scene.scene import Scene
from skysim.scene.sections.light import PLUGINS
from skysim.simulation.lab import Lab, UserParts, build_lab, build_tracker
from skysim.tracking import factory
from skysim.tracking.tracker_interface import TRACKERS

CACHE_SIZE = 4  # setups that a worker caches


class TrialSetup(NamedTuple):
    """A scene prepared for trials: lab, tracker with its index, trial, scene hash, commands of external programs."""

    lab: Lab
    estimator: factory.Estimator
    trial: Trial
    scene_hash: str
    programs: Programs = NO_PROGRAMS


class SetupCache(threading.local):
    """Least-recently-used cache of setups. One per thread, because a lab's canvas serves one trial at a time."""

    def __init__(self) -> None:
        self.setups: OrderedDict[str, TrialSetup] = OrderedDict()


CACHE = SetupCache()


def prepared_setup(spec: TrialSpec, settings: Settings) -> TrialSetup:
    """The setup of a design point, from the cache if it is there. Raises InputError."""
    programs = {**spec.programs, **spec.digests}
    key = digest([spec.scene, spec.folder, spec.base, spec.trial, programs, settings])
    cached = CACHE.setups
    if key not in cached:
        cached[key] = build_setup(spec, settings)
        while len(cached) > CACHE_SIZE:
            cached.popitem(last=False)
    cached.move_to_end(key)
    return cached[key]


def build_setup(spec: TrialSpec, settings: Settings) -> TrialSetup:
    """Build hardware and tracker of a point, or reuse those of a cached setup that differs only in its trial."""
    scene, trial = resolve_point(spec, settings)
    hash_ = scene_hash(scene, spec.digests)
    for setup in CACHE.setups.values():
        if setup.scene_hash == hash_ and setup.programs == spec.programs:
            return setup._replace(trial=trial)
    # A lab whose scene differs only in section `tracker` has the same hardware.
    cached = (setup.lab for setup in CACHE.setups.values())
    same = (
        one
        for one in cached
        if one.scene.model_copy(update={"tracker": scene.tracker}) == scene
    )
    lab = next(same, None) or build_lab(scene, UserParts(spec.programs))
    lab = lab.with_scene(scene)
    return TrialSetup(
        lab, build_tracker(lab.camera, spec.programs), trial, hash_, spec.programs
    )


def scene_hash(scene: Scene, digests: Mapping[str, str] = NO_PROGRAMS) -> str:
    """Hash of a scene, of the files it names, and of the releases of external tracker, controller and lights.

    A tracker or controller given in Python has a digest by its name.
    """
    tree = scene.model_dump(mode="json", by_alias=True)
    contents = [
        sha256(Path(path).read_bytes()).hexdigest()
        for _, path in file_names(tree)
        if Path(path).is_file()
    ]
    releases = [
        TRACKERS.release(scene.tracker.name),
        *(PLUGINS.release(light.kind) for light in scene.lights),
    ]
    law = scene.motion.control.law if scene.motion.control else ""
    if release := CONTROLLERS.release(law):
        releases.append(release)
    releases += [digests[name] for name in (scene.tracker.name, law) if name in digests]
    return digest([tree, contents, *releases])


@cache
def code_version() -> str:
    """Hash of the source code of skysim and estimator and of their data; stored with each trial."""
    code = sha256()
    sources = [
        path for package in ("skysim", "estimator") for path in (ROOT / package).rglob("*.py")
    ]
    data = [
        path
        for folder in ("qe", "led", "bands", "cameras", "ephemeris")
        for path in (DATA / folder).rglob("*")
    ]
    for path in sorted(sources + [path for path in data if path.is_file()]):
        code.update(
            path.relative_to(ROOT).as_posix().encode() + b"\0" + path.read_bytes() + b"\0"
        )
    return code.hexdigest()[:16]


def seed_of(spec: TrialSpec, point: int, replicate: int) -> int:
    """Seed of a trial, 63 bits, derived from the study's seed; with `paired` it is the same at every point."""
    key = (replicate,) if spec.paired else (replicate, point)
    return int(
        np.random.SeedSequence(spec.seed, spawn_key=key).generate_state(1, np.uint64)[0] >> 1
    )
