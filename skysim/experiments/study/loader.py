"""Load a study file, validate it and make its plan."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from pathlib import Path

from pydantic import ValidationError

from skysim.core.errors import InputError, unknown_name
from skysim.core.yaml_reader import check_version, explain, line_of, read_yaml, set_key
from skysim.dynamics.controllers.interface import CONTROLLERS
from skysim.experiments.study.designs import make_point
from skysim.experiments.study.factors import Factor, Settings, Value
from skysim.experiments.study.plan import (
    AttitudeRange,
    CentroidTrial,
    Curve,
    FlightTrial,
    Plan,
    Study,
    find,
    make_plan,
    resolve_point,
)
from skysim.results import metrics
from skysim.scene.light import CollimatedDisplayConfig, DomeConfig
from skysim.scene.scene import Scene
from skysim.tracking.external.interface import OWN, TRACKERS


def load(
    name: str | Path, overrides: Mapping[str, str] | None = None, programs: Mapping[str, str] | None = None
) -> Plan:
    """Read, override (`path.to.key` -> YAML value) and validate a study and every level of its factors.

    programs : commands of external trackers and controllers by name; None if the study will not be run, and its
               trackers and controllers need not be installed
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
        plan = make_plan(path, study, tree["trial"], programs or {})
        check(plan, to_run=programs is not None)
    except InputError as error:  # about a key of the study: add file and line
        message = str(error)
        line = line_of(text, message.partition(":")[0].split("."))[1]
        where = f"{path}, line {line}" if line else path
        raise InputError(f"{message.removesuffix(' (--set)')} ({where})") from None
    return plan


def check(plan: Plan, to_run: bool) -> None:
    """Validate responses, figures, budget and each level of each factor before the first trial. Raises InputError.

    to_run : whether the trackers and controllers must be installed
    """
    from skysim.experiments.study.analysis import search
    from skysim.experiments.study.analysis.table import PointRow
    from skysim.experiments.study.report import layout
    from skysim.experiments.study.store import COLUMNS

    study = plan.study
    for n, name in enumerate(study.responses):
        metrics.response(name, f"responses.{n}")
    for n, figure in enumerate(study.figures):
        for key in ("x", "by") if isinstance(figure, Curve) else ("x", "y"):
            axis = getattr(figure, key)
            if axis is not None and axis not in study.factors:
                raise InputError(f"figures.{n}.{key}: {unknown_name('factor', axis, study.factors)}")
        metrics.response(figure.y if isinstance(figure, Curve) else figure.value, f"figures.{n}")
        if plan.points:
            layout.fixed_levels(figure, study, [PointRow(k, point.levels, {}) for k, point in enumerate(plan.points)])
    if study.optimize:
        search.check(study)
    if study.budget.trials is not None and plan.trials > study.budget.trials:
        raise InputError(
            f"budget.trials: {study.budget.trials}; allowed: at least {plan.trials}, the trials of the study"
        )
    for name in study.factors:
        if name in COLUMNS or name in study.responses:
            raise InputError(f"factors.{name}: the name is that of a column of the trials; allowed: another name")
    for name, level, settings in each_level(study.factors):
        try:
            scene, trial = resolve_point(plan.spec, settings)
            if isinstance(scene.light, CollimatedDisplayConfig) and not isinstance(trial, FlightTrial):
                raise InputError(f"trial.kind: {trial.kind} with a collimated display; allowed: flight")
            if isinstance(trial, FlightTrial) and trial.start:
                check_random_start(scene, trial.start)
            if to_run:
                tracker = scene.tracker.name
                TRACKERS.check_name(tracker, plan.spec.programs)
                if scene.motion.control:
                    CONTROLLERS.check_name(scene.motion.control.law, plan.spec.programs)
                if tracker != OWN and isinstance(trial, CentroidTrial):  # an external tracker takes images
                    raise InputError(f"tracker.name: {tracker} needs frames; allowed: {OWN}, or another trial.kind")
        except InputError as error:
            key = str(error).partition(":")[0]
            owners = [other for other, factor in study.factors.items() if key in dict(factor.value_at(0.5)[1])]
            owner = name if name in owners or not owners else owners[0]
            value = level if owner == name else study.factors[owner].value_at(0.5)[0]
            raise InputError(f"factors.{owner}: {value!r}: {error}") from None


def check_random_start(scene: Scene, start: AttitudeRange) -> None:
    """Raise InputError for a random start that the scene cannot have, or whose keys have no effect in it."""
    if isinstance(scene.light, CollimatedDisplayConfig) or scene.motion.start == "profile":
        where = "a collimated display" if scene.motion.start != "profile" else "motion.start: profile"
        raise InputError(f"trial.start: random with {where}; allowed: scene")
    dome = isinstance(scene.light, DomeConfig)
    unused = "dec_deg" if dome else "tilt_deg"
    if unused in start.model_fields_set:
        raise InputError(f"trial.start.{unused}: has no effect with light of kind {scene.light.kind}; allowed: none")
    greatest_deg = max(start.tilt_deg) if isinstance(start.tilt_deg, tuple) else start.tilt_deg
    vehicle = scene.vehicle
    if dome and vehicle.mount == "air_bearing" and greatest_deg > vehicle.tilt_stop_deg:
        raise InputError(
            f"trial.start.tilt_deg: {greatest_deg:g}; allowed: up to vehicle.tilt_stop_deg {vehicle.tilt_stop_deg:g}"
        )


def each_level(factors: Mapping[str, Factor]) -> Iterator[tuple[str, Value, Settings]]:
    """Every level of every factor with the other factors at their middle: factor, level, all settings."""
    middle = {name: factor.value_at(0.5) for name, factor in factors.items()}
    for name, factor in factors.items():
        others = make_point({other: chosen for other, chosen in middle.items() if other != name}).settings
        for level, settings in factor.options() or [middle[name]]:
            yield name, level, others | settings
