"""Load a study file, validate it and make its plan."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from pathlib import Path

from pydantic import ValidationError

from skysim.core.errors import InputError
from skysim.core.yaml_reader import check_version, explain, line_of, read_yaml, set_key
from skysim.experiments.study.factors import Factor, Settings, Value
from skysim.experiments.study.plan import (
    CentroidTrial,
    Curve,
    FlightTrial,
    FrameTrial,
    Plan,
    Study,
    find,
    planned,
    resolved,
)
from skysim.results import metrics
from skysim.scene.light import BenchConfig
from skysim.scene.scene import Scene
from skysim.tracking.external.interface import OWN, known


def load(
    name: str | Path, overrides: Mapping[str, str] | None = None, programs: Mapping[str, str] | None = None
) -> Plan:
    """Read, override (`path.to.key` -> YAML value) and validate a study and every level of its factors.

    programs : commands of external trackers by name, for `tracker.name`; None if the study will not be run, and its
               trackers need not be installed
    Raises InputError with one line: the key, the fault, what is allowed, the file and line.
    """
    path = find(str(name))
    tree, text = read_yaml(path)
    check_version(tree, path, text)
    for key, value in (overrides or {}).items():
        set_key(tree, key, value)
    try:
        study = Study.model_validate(tree)
    except ValidationError as error:
        raise InputError(explain(error, Study, tree, [(path, text)], overrides or {})) from None
    try:
        plan = planned(path, study, tree["trial"], programs or {})
        check(plan, to_run=programs is not None)
    except InputError as error:
        raise InputError(located(str(error), path, text)) from None
    return plan


def check(plan: Plan, to_run: bool) -> None:
    """Validate responses, figures, budget and each level of each factor before the first trial. Raises InputError.

    to_run : whether the trackers must be installed
    """
    from skysim.experiments.study.analysis import search
    from skysim.experiments.study.analysis.table import Line
    from skysim.experiments.study.report import layout
    from skysim.experiments.study.store import COLUMNS

    study = plan.study
    for n, name in enumerate(study.responses):
        metrics.response(name, f"responses.{n}")
    for n, figure in enumerate(study.figures):
        for key in ("x", "by") if isinstance(figure, Curve) else ("x", "y"):
            axis = getattr(figure, key)
            if axis is not None and axis not in study.factors:
                raise InputError(f"figures.{n}.{key}: {axis!r} is none of {', '.join(study.factors)}")
        metrics.response(figure.y if isinstance(figure, Curve) else figure.value, f"figures.{n}")
        if plan.points:
            layout.held(figure, study, [Line(k, point.levels, {}) for k, point in enumerate(plan.points)])
    if study.optimise:
        search.check(study)
    if study.budget.trials is not None and plan.trials > study.budget.trials:
        raise InputError(f"budget.trials: {study.budget.trials} are fewer than the study's {plan.trials}")
    for name in study.factors:
        if name in COLUMNS or name in study.responses:
            raise InputError(f"factors.{name}: is a column of every trial; allowed: another name")
    for name, level, settings in each_level(study.factors):
        try:
            scene, trial = resolved(plan.recipe, settings)
            if isinstance(scene.light, BenchConfig) and not isinstance(trial, FlightTrial):
                raise InputError("trial.kind: a bench has no sky around it; allowed: flight")
            if to_run:
                check_tracker(plan, scene, trial)
        except InputError as error:
            key = str(error).partition(":")[0]
            owners = [other for other, factor in study.factors.items() if key in dict(factor.at(0.5)[1])]
            owner = name if name in owners or not owners else owners[0]
            told = level if owner == name else study.factors[owner].at(0.5)[0]
            raise InputError(f"factors.{owner}: {told!r}: {error}") from None


def check_tracker(plan: Plan, scene: Scene, trial: CentroidTrial | FrameTrial | FlightTrial) -> None:
    """Raise InputError for an unknown tracker, and for an external tracker in a centroid trial (it takes images)."""
    name = scene.tracker.name
    known(name, plan.recipe.programs)
    if name != OWN and isinstance(trial, CentroidTrial):
        raise InputError(f"tracker.name: {name} takes frames; allowed: {OWN}, or another trial.kind")


def each_level(factors: Mapping[str, Factor]) -> Iterator[tuple[str, Value, Settings]]:
    """Every level of every factor with the other factors at their middle: factor, level, all settings."""
    middle = {name: factor.at(0.5)[1] for name, factor in factors.items()}
    for name, factor in factors.items():
        for level, settings in factor.options() or [factor.at(0.5)]:
            others: Settings = {}
            for other, sets in middle.items():
                others |= sets if other != name else {}
            yield name, level, others | settings


def located(message: str, path: Path, text: str) -> str:
    """An error message about a key of a study, with file and line added."""
    line = line_of(text, message.partition(":")[0].split("."))[1]
    return f"{message.removesuffix(' (--set)')} ({path}{f', line {line}' if line else ''})"
