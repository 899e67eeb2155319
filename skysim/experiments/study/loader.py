"""Load a study file, validate it and make its plan."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from functools import partial
from pathlib import Path

from pydantic import ValidationError

from skysim.core.errors import InputError, unknown_name
from skysim.core.yaml_reader import check_version, explain, line_of, read_yaml, set_key
from skysim.experiments.study import unused_options
from skysim.experiments.study.designs import make_point
from skysim.experiments.study.factors import Factor, Settings, Value
from skysim.experiments.study.plan import CentroidTrial, Curve, FlightTrial, Plan, Study, find, make_plan, resolve_point
from skysim.results import metrics
from skysim.scene.light import CollimatedDisplayConfig
from skysim.tracking.external.interface import OWN, check_tracker_name


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

    to_run : whether the trackers must be installed
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
    points = []
    for name, level, own, settings in each_level(study.factors):
        try:
            scene, trial = resolve_point(plan.spec, settings)
            points.append(unused_options.CheckedPoint(name, level, own, settings, scene, trial))
            if isinstance(scene.light, CollimatedDisplayConfig) and not isinstance(trial, FlightTrial):
                raise InputError(f"trial.kind: {trial.kind} with a collimated display; allowed: flight")
            if to_run:
                tracker = scene.tracker.name
                check_tracker_name(tracker, plan.spec.programs)
                if tracker != OWN and isinstance(trial, CentroidTrial):  # an external tracker takes images
                    raise InputError(f"tracker.name: {tracker} needs frames; allowed: {OWN}, or another trial.kind")
        except InputError as error:
            key = str(error).partition(":")[0]
            owners = [other for other, factor in study.factors.items() if key in dict(factor.value_at(0.5)[1])]
            owner = name if name in owners or not owners else owners[0]
            value = level if owner == name else study.factors[owner].value_at(0.5)[0]
            raise InputError(f"factors.{owner}: {value!r}: {error}") from None
    unused_options.check(plan, points, partial(resolve_point, plan.spec))


def each_level(factors: Mapping[str, Factor]) -> Iterator[tuple[str, Value, Settings, Settings]]:
    """Every level of every factor with the other factors at their middle: factor, level, its settings, all settings."""
    middle = {name: factor.value_at(0.5) for name, factor in factors.items()}
    for name, factor in factors.items():
        others = make_point({other: chosen for other, chosen in middle.items() if other != name}).settings
        for level, settings in factor.options() or [middle[name]]:
            yield name, level, settings, others | settings
