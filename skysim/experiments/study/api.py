"""Python interface to studies: run all trials of a study and return its tables.

A study is a file, or is made in Python:

1. `keys_of` gives the keys of what `run_study` gets; functions and trackers in them become names (`with_names`).
2. Overrides change them.
3. `with_part` puts a controller, tracker or profile into them.
4. The study is checked and run like one of a file, which is written beside the store.
"""

from __future__ import annotations

import hashlib
import re
from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np

from estimator.trackers.dome_tracker import DomeTracker
from estimator.trackers.star_tracker import StarTracker
from skysim.core.errors import InputError
from skysim.core.files import make_folder, write_text
from skysim.core.plugins import NO_PROGRAMS, Programs
from skysim.core.types import Record
from skysim.core.yaml_reader import (
    MAPPING,
    Keys,
    Tree,
    as_tree,
    excerpt,
    is_file,
    override_texts,
    read_yaml,
    set_key,
    value_at,
)
from skysim.dynamics import profile_samples
from skysim.dynamics.controllers import CONTROLLERS
from skysim.experiments.study import own_code, search, study_file, table
from skysim.experiments.study.execution import runner, store
from skysim.experiments.study.execution.engines import Engine, Pool, Serial
from skysim.experiments.study.factors import Settings
from skysim.experiments.study.plan import Plan, scene_texts
from skysim.experiments.study.report.study_report import study_report
from skysim.results.report import Report
from skysim.scene import loader
from skysim.scene.scene import Scene
from skysim.simulation.lab import check_controller, check_tracker, name_of
from skysim.tracking.tracker_interface import OWN

if TYPE_CHECKING:
    import pandas as pd
    from astropy.table import Table

# Keys of a study of which a scene has none.
STUDY_KEYS = {"scene", "trial", "factors", "responses"}
# Keys whose mapping is one value: names of the user's, and dotted keys.
WHOLE = ("factors", "set")


class StudyResult(NamedTuple):
    """A study with its trials in a store: plan, path of the store, number of failed trials."""

    plan: Plan
    path: Path
    failed: int

    def table(self) -> Table:
        """One row per design point: its factors, and each response with its confidence interval and trial count."""
        from astropy.table import Table

        with store.open_store(self.path) as kept:
            return Table(table.to_columns(table.table(kept, self.plan.study.responses)))

    def trials(self) -> Table:
        """One row per trial: design point, factors and every measured quantity."""
        from astropy.table import Table

        with store.open_store(self.path) as kept:
            return Table(dict(table.trial_columns(kept)))

    def report(self) -> Report:
        """The study's report: answers, figures and tables."""
        with store.open_store(self.path) as kept:
            return study_report(self.plan, kept)

    def to_pandas(self) -> pd.DataFrame:
        """`table` as a data frame; needs pandas."""
        return self.table().to_pandas()


def run_study(
    study: str | Path | Mapping[str, Any] | Scene,
    overrides: Mapping[str, Any] | None = None,
    *,
    controller: Any = None,
    tracker: Any = None,
    profile: Any = None,
    programs: Programs = NO_PROGRAMS,
    out: str | Path | None = None,
    workers: int | None = None,
    **keys: Any,
) -> StudyResult:
    """Run the missing trials of a study and keep them in a store.

    A script that uses several processes needs the usual `if __name__ == "__main__":`. A function that they cannot take,
    such as a lambda or one of a notebook, runs in this process, or is refused if `workers` is above 1. The store has a
    digest of its code, and refuses trials of another one. Raises InputError.

    Parameters
    ----------
    study
        Path of a study file, or name of a study in scenes/studies; a mapping with the keys of such a file, whose
        `scene` may be a mapping or a `Scene`, too, and whose file names are relative to the working directory; or a
        scene, as a mapping or a `Scene`, with the study's other keys as `keys`
    overrides, keys
        Keys of the study and their values, such as {"replicates": 20}. A mapping changes the keys in it, but
        `factors` replaces those of the study
    controller, tracker, profile
        In place of the scene's, as in `skysim.simulate`. Several, in a list or a mapping by name, are levels of a
        factor of this name. Functions and trackers may also stand in a mapping wherever a scene has the name of one
    programs
        External trackers and controllers by name, which the study names: commands, functions or trackers
    out
        Folder of the store, by default out/NAME, for a mapping that of its title; a store of the same study is
        continued
    workers
        Number of processes, by default the number of cores; 1 runs the trials in this process
    """
    made = dict(programs)
    parts = {"controller": controller, "tracker": tracker, "profile": profile}
    given = {name: part for name, part in parts.items() if part is not None}
    changes = with_names({**(overrides or {}), **keys}, made)
    path = study_file.find(str(study)) if isinstance(study, str | Path) else Path(MAPPING)
    # 1. Keys. 2. Overrides.
    tree = with_names(keys_of(study, path), made)
    texts = study_texts(changes, tree)
    is_plain = path.name != MAPPING and not given
    if is_plain:
        folder = Path(out or f"out/{path.stem}")
        plan = study_file.load(path, texts, made)
    else:
        tree, _ = as_tree(tree)
        for key, text in texts.items():
            set_key(tree, key, text)
        beside = path.resolve().parent / str(tree.get("scene", ""))
        if is_file(beside):
            tree["scene"] = str(beside)
        folder = Path(out or f"out/{slug(tree)}")
        # 3. Parts.
        for name, part in given.items():
            with_part(tree, name, part, folder, made)
        tree, text = as_tree(with_names(tree, made))
        plan = study_file.plan_of(tree, text, path.with_name(MAPPING), programs=made)
        plan = replace(plan, path=folder / f"{folder.resolve().name}.yaml")
    # 4. Trials.
    engine = engine_for(made, workers)
    try:
        with store.writing(folder / store.STORE) as kept:
            runner.prepare_store(
                plan,
                kept,
                resume=kept.counts()["done"] > 0,
                overrides=texts if is_plain else {},
            )
            if not is_plain:
                write_text(plan.path, plan.text)
            run = runner.run if plan.study.optimize is None else search.search
            run(plan, kept, engine)
            return StudyResult(plan, folder / store.STORE, kept.counts()["failed"])
    finally:
        engine.close()


def keys_of(study: Any, path: Path) -> Keys:
    """The keys of a study's file at `path`, of a mapping, or of a study of a scene. Raises InputError."""
    if isinstance(study, str | Path):
        return read_yaml(path)[0]
    if isinstance(study, Scene):
        return {"title": study.title, "seed": study.seed, "scene": loader.keys_of(study)}
    if not isinstance(study, Mapping):
        raise InputError(
            "study", excerpt(repr(study)), "a name, a path, a mapping of keys, a Scene"
        )
    if STUDY_KEYS & set(study):
        scene = study.get("scene")
        return (
            {**study, "scene": loader.keys_of(scene)} if isinstance(scene, Scene) else study
        )
    loaded = loader.load(with_names(study, {}), refuses_unused=False)
    return {"title": loaded.title, "seed": loaded.seed, "scene": study}


def with_names(value: Any, programs: Record) -> Any:
    """A value of a study or a scene with names for functions and trackers in it, which are added to `programs`.

    Raises InputError for two with one name, and for the name of one of skysim's own.
    """
    if isinstance(value, Mapping):
        return {key: with_names(inner, programs) for key, inner in value.items()}
    if isinstance(value, list | tuple):
        return [with_names(inner, programs) for inner in value]
    if not (callable(value) or isinstance(value, StarTracker | DomeTracker)):
        return value
    return register(name_of(value), value, programs)


def register(name: str, part: Any, programs: Record) -> str:
    """Add a tracker or controller to the programs, and return its name. Raises InputError if that is in use."""
    if programs.setdefault(name, part) is not part or name in (OWN, *CONTROLLERS.own):
        raise InputError(name, "name already in use", f"a mapping such as {{'my_{name}': …}}")
    return name


def study_texts(changes: Keys, tree: Keys) -> dict[str, str]:
    """Overrides of a study's keys as YAML texts; those of `set` are added to the study's."""
    if isinstance(changes.get("set"), Mapping):
        changes = {**changes, "set": {**tree.get("set", {}), **changes["set"]}}
    return override_texts(changes, dict(tree), WHOLE)


def slug(tree: Tree) -> str:
    """A study's title as the name of a folder."""
    return re.sub(r"\W+", "_", str(tree.get("title", ""))).strip("_").lower() or "study"


def with_part(tree: Tree, name: str, given: Any, folder: Path, programs: Record) -> None:
    """Put a controller, tracker or profile into a study's keys; several become levels of a factor of its name."""
    many = isinstance(given, list | tuple) or (
        isinstance(given, Mapping) and not set(profile_samples.TIMES) & set(given)
    )
    names = given if many and isinstance(given, Mapping) else {}
    named = names or {
        Path(one).stem if isinstance(one, str | Path) else name_of(one): one
        for one in (given if many else [given])
    }
    levels = {}
    for key, one in named.items():
        if name == "tracker":
            check_tracker(one)
        elif name == "controller":
            check_controller(one)
        is_code = name != "profile" and not isinstance(one, str)
        part = register(key, one, programs) if is_code else one
        levels[str(key)] = part_settings(tree, name, part, folder)
    if not many:
        tree["set"] = tree.get("set", {}) | next(iter(levels.values()))
        return
    if len(levels) < len(given) or name in tree.get("factors", {}):
        raise InputError(name, "two have the same name", "other names, as a mapping")
    tree["factors"] = tree.get("factors", {}) | {name: {"levels": levels}}


def part_settings(tree: Tree, name: str, part: Any, folder: Path) -> Settings:
    """The settings of a study with a controller, tracker or profile, as `simulation.lab.with_parts` has them."""
    if name == "tracker":
        return {"tracker.name": part}
    texts = scene_texts(tree.get("set", {}))
    scene = loader.with_overrides(loader.merged(loader.all_layers(tree["scene"])), texts)
    control = value_at(scene, "motion.control")
    if name == "controller":
        has_section = isinstance(control, dict) and control
        return (
            {"motion.control.law": part} if has_section else {"motion.control": {"law": part}}
        )
    file = part if isinstance(part, str | Path) else table_file(part, folder)
    maneuver = [{"kind": "profile", "file": str(Path(file).resolve())}]
    prescribed = {"motion.control": "prescribed"} if control in ({}, None, "none") else {}
    return {"motion.start": "profile", "motion.maneuver": maneuver, **prescribed}


def table_file(given: Any, folder: Path) -> Path:
    """Write a table of attitudes to an ECSV file named by its content, and return its path. Raises InputError."""
    from astropy.table import Table

    if not hasattr(given, "keys"):
        raise InputError("profile", type(given).__name__, "a file, or a table")
    columns = {
        str(name): profile_samples.to_epochs(given[name]) if name == "utc" else given[name]
        for name in given.keys()  # noqa: SIM118 - a table yields its rows
    }
    content = repr({name: np.asarray(column).tolist() for name, column in columns.items()})
    path = (
        make_folder(folder)
        / f"profile_{hashlib.sha256(content.encode()).hexdigest()[:8]}.ecsv"
    )
    if not is_file(path):
        Table(columns).write(path, format="ascii.ecsv")
    return path


def engine_for(programs: Programs, workers: int | None) -> Engine:
    """The engine of a study with these trackers and controllers, see `run_study`. Raises InputError."""
    if workers == 1:
        return Serial()
    reason = own_code.unsendable(programs)
    if reason and workers:
        raise InputError(
            "workers",
            f"{workers} processes cannot take {reason}",
            "1, or functions of a module or a script",
        )
    return Serial() if reason else Pool(workers)
