"""Load a study file, validate it and make its plan."""

import re
from collections.abc import Iterator, Sequence
from pathlib import Path

import numpy as np

from estimator.trackers.dome_tracker import DomeTracker
from estimator.trackers.star_tracker import StarTracker
from skysim.core.errors import OVERRIDES, InputError, check_name, errors_under, errors_within
from skysim.core.paths import STUDIES
from skysim.core.plugins import Programs
from skysim.core.yaml_reader import (
    OverrideTexts,
    Tree,
    check_version,
    explained,
    find_file,
    read_yaml,
    set_key,
    where_of,
)
from skysim.dynamics.controllers import CONTROLLERS
from skysim.experiments.study import unused_options
from skysim.experiments.study.factors import (
    Distribution,
    Levels,
    Option,
    each_level,
    points,
)
from skysim.experiments.study.own_code import digest_of
from skysim.experiments.study.plan import (
    TRIAL,
    AttitudeRange,
    CentroidTrial,
    Figure,
    FlightTrial,
    FrameTrial,
    Map,
    Plan,
    Study,
    Threshold,
    Trial,
    TrialSpec,
    resolve_point,
)
from skysim.results import metrics
from skysim.results.files.parts import find_prices, read_prices
from skysim.scene import unused
from skysim.scene.scene import Scene, ephemeris_problem
from skysim.scene.sections.light import CollimatedDisplayConfig
from skysim.tracking.tracker_interface import OWN, TRACKERS

SURVEY_SEED = "tracker.survey.seed"
HARDWARE_SEED = re.compile(r"(hardware_seed|survey\.(surface_)?seed)$")
# Kinds of trial that measure a quantity; quantities that are not listed are measured by all.
MEASURED_BY: dict[str, tuple[str, ...]] = {
    **dict.fromkeys(metrics.FLIGHT_QUANTITIES, ("flight",)),
    **dict.fromkeys(("streak_px", "detect_ms", "computer_ms"), ("frames", "flight")),
}


def find(name: str) -> Path:
    """Path of a study that is given by path, or by its name in scenes/studies/ or scenes/papers/studies/."""
    return find_file(name, STUDIES, "study")


def load(
    name: str | Path,
    overrides: OverrideTexts | None = None,
    programs: Programs | None = None,
) -> Plan:
    """Read, override (`path.to.key` -> YAML value) and validate a study and every level of its factors.

    Parameters
    ----------
    programs
        Commands of external trackers and controllers by name; None if the study will not be
        run, so that they need not be installed

    Raises
    ------
    InputError
        With one line: the key, the fault, allowed values, file and line.
    """
    path = find(str(name))
    tree, text = read_yaml(path)
    check_version(tree, path, text)
    for key, value in (overrides or {}).items():
        set_key(tree, key, value)
    return plan_of(tree, text, path, overrides=overrides, programs=programs)


def plan_of(
    tree: Tree,
    text: str,
    path: Path,
    base: Path | None = None,
    *,
    overrides: OverrideTexts | None = None,
    programs: Programs | None = None,
) -> Plan:
    """The validated plan of a study's tree, read from a text.

    Parameters
    ----------
    path
        Path of the text, for messages
    base
        File to whose folder scene paths are relative; `path` if left out

    Raises
    ------
    InputError
        With one line.
    """
    with explained(tree, [(path, text)], overrides or {}):
        study = Study.model_validate(tree)
    try:
        plan = make_plan(base or path, study, tree["trial"], programs or {}, text)
        check(plan, to_run=programs is not None)
    except InputError as error:  # about a key of the study: add file and line
        if error.where in (None, OVERRIDES):
            within = [key for key in study.set if f"{error.key}.".startswith(f"{key}.")]
            if error.key == InputError(study.scene, "").key:
                error = error.within("scene")
            key = f"set.{within[0]}" if within else error.key
            error = error.at(where_of(key, [(path, text)], {}))
        raise error from None
    return plan


def make_plan(path: Path, study: Study, trial: Tree, programs: Programs, text: str) -> Plan:
    """The plan of a study; `trial` is the section as written in the file, with units. Raises InputError for prices."""
    folder = path.resolve().parent
    spec = TrialSpec(
        study.scene,
        str(folder),
        study.seed,
        study.set,
        trial,
        study.paired,
        study.hardware,
        dict(programs),
        {name: digest_of(one) for name, one in programs.items() if not isinstance(one, str)},
    )
    if study.optimize is None:
        chosen = points(study.design, study.factors, study.seed)
        return Plan(path, study, spec, chosen, text=text)
    parts = study.optimize.cost.parts
    with errors_within("optimize.cost.parts"):
        prices = read_prices(find_prices(parts, folder)) if parts else None
    return Plan(path, study, spec, [], prices, text)


def check(plan: Plan, to_run: bool) -> None:
    """Validate responses, figures, budget and each level of each factor before the first trial. Raises InputError.

    Parameters
    ----------
    to_run
        Whether the trackers and controllers must be installed
    """
    from skysim.experiments.study import search
    from skysim.experiments.study.execution.store import COLUMNS

    study = plan.study
    for n, name in enumerate(study.responses):
        metrics.response(name, f"responses.{n}")
    check_figures(plan)
    if study.optimize:
        if study.require:
            raise InputError("require", "has no effect in a search", "optimize.constraints")
        search.check(study)
    trials = study.trial_count(len(plan.points))
    if study.budget.trials is not None and trials > study.budget.trials:
        whole = "search" if study.optimize else "study"
        raise InputError(
            "budget.trials",
            study.budget.trials,
            f"at least {trials}, the trials of the {whole}",
        )
    for name in study.factors:
        if name in COLUMNS or name in study.responses:
            raise InputError(
                f"factors.{name}",
                "the name is that of a column of the trials",
                "another name",
            )
    check_hardware(study)
    points = []
    for name, level, own, settings in each_level(study.factors):
        try:
            scene, trial = resolve_point(plan.spec, plan.spec.trial_settings(settings, 0))
            check_trial(plan, scene, trial, to_run)
            if study.optimize and study.optimize.cost.parts and not scene.dome:
                problem = f"light of kind {scene.light.kind} has no parts"
                raise InputError("optimize.cost.parts", problem, "dome")
        except InputError as error:
            raise at_factor(study, name, (level, own), error) from None
        points.append(unused_options.CheckedPoint(name, level, own, settings, scene, trial))
    check_measured(study, points)
    unused_options.check(plan, points)


def check_figures(plan: Plan) -> None:
    """Raise InputError for a figure or threshold of an unknown factor, level or response."""
    from skysim.experiments.study import table, thresholds

    study = plan.study
    lines = table.without_responses(study, plan.points)
    for where, one in named_sections(study):
        for key, factor in one.axes.items():
            if factor is not None:
                check_name(f"{where}.{key}", "factor", factor, study.factors)
        metrics.response(one.response, where)
        if isinstance(one, Map) and study.trial.kind == "flight":
            raise InputError(
                f"{where}.kind",
                "a map of flights, which have no single attitude",
                "curve, heat",
            )
        if isinstance(one, Threshold):
            thresholds.check(one, where, lines)
        if plan.points:
            with errors_under(where):
                lines.fixed_levels(one)


def named_sections(study: Study) -> Iterator[tuple[str, Figure | Threshold]]:
    """Every figure and threshold with its key in the study file."""
    for section in ("figures", "thresholds"):
        for n, one in enumerate(getattr(study, section)):
            yield f"{section}.{n}", one


def check_hardware(study: Study) -> None:
    """Raise InputError if a key of `hardware` is of the trial or is also set by a factor, or a factor sets a seed."""
    for n, key in enumerate(study.hardware):
        if key.startswith(TRIAL):
            raise InputError(
                f"hardware.{n}", f"{key} is no hardware", "seeds of the scene's hardware"
            )
        for name, factor in study.factors.items():
            if key in factor.value_at(0.5)[1]:
                raise InputError(
                    f"hardware.{n}", f"{key} is set by factors.{name} too", "one of the two"
                )
    for name, factor in study.factors.items():
        keys = (
            [] if isinstance(factor, Levels | Distribution) else list(factor.value_at(0.5)[1])
        )
        if keys and all(HARDWARE_SEED.search(key) for key in keys):
            raise InputError(
                f"factors.{name}",
                f"{keys[0]} numbers draws of the hardware",
                f"hardware: [{', '.join(keys)}], which draws them anew in every replicate, or levels with a name for"
                " each unit",
            )


def check_trial(plan: Plan, scene: Scene, trial: Trial, to_run: bool) -> None:
    """Raise InputError if the trial does not fit the scene of a level."""
    if isinstance(scene.light, CollimatedDisplayConfig) and not isinstance(
        trial, FlightTrial
    ):
        raise InputError("trial.kind", f"{trial.kind} with a collimated display", "flight")
    if scene.tracker.decoder and isinstance(trial, FrameTrial):
        raise InputError(
            "trial.kind", "frames with tracker.decoder, which needs many", "centroids, flight"
        )
    if SURVEY_SEED in plan.spec.hardware and unused.reason(SURVEY_SEED, scene):
        raise InputError(
            "hardware",
            "tracker.survey.seed has no effect without errors of the survey",
            "with tracker.survey.led_sigma, lever_sigma or light.surface.error",
        )
    others = [key for key in plan.spec.hardware if key.startswith("light.layout.")]
    if scene.tracker.map and others:
        raise InputError(
            "hardware", f"{others[0]} draws other domes than that of tracker.map", "no map"
        )
    if isinstance(trial, FlightTrial) and trial.start:
        check_random_start(scene, trial.start)
    near = getattr(trial.start if isinstance(trial, FlightTrial) else trial, "near", None)
    if near and near.body == "zenith" and scene.site.longitude_deg is None:
        raise InputError("trial.near.body", "zenith requires site.longitude_deg in the scene")
    if near and (problem := ephemeris_problem(scene.start_time)):
        raise InputError("trial.near", problem, "none")
    if to_run:
        tracker = scene.tracker.name
        TRACKERS.check_name(tracker, plan.spec.programs)
        if scene.motion.control:
            CONTROLLERS.check_name(scene.motion.control.law, plan.spec.programs)
        # An external tracker takes images.
        given = plan.spec.programs.get(tracker)
        takes_centroids = tracker == OWN or isinstance(given, StarTracker | DomeTracker)
        if isinstance(trial, CentroidTrial) and not takes_centroids:
            raise InputError(
                "tracker.name", f"{tracker} needs frames", f"{OWN}, or another trial.kind"
            )


def dome_seeds(scene: Scene) -> list[str]:
    """Keys of the seeds of the survey and of the LEDs that can be others in a scene; a map is of these LEDs."""
    seeds = [] if unused.reason(SURVEY_SEED, scene) else [SURVEY_SEED]
    if scene.dome and not scene.tracker.map and hasattr(scene.dome.points, "hardware_seed"):
        nested = scene.dome.points is not scene.dome.layout
        seeds.append(f"light.layout{'.points' * nested}.hardware_seed")
    return seeds


def fixed_seeds(study: Study, scene: Scene) -> list[str]:
    """Seeds of the survey and of the LEDs that a scene draws once, and the study neither draws anew nor varies."""
    varied = {*study.hardware, *study.set}.union(
        *(factor.value_at(0.5)[1] for factor in study.factors.values())
    )
    return [seed for seed in dome_seeds(scene) if seed not in varied]


def at_factor(study: Study, name: str, option: Option, error: InputError) -> InputError:
    """An error of a factor's option, with the factor that sets the key at fault and its value; others at their middle.

    One of `hardware` is unchanged; so is an error of a key that no factor sets, nor a section of it or a key in it.
    """
    if error.key == "hardware":
        return error
    options = {name: option} | {
        other: factor.value_at(0.5)
        for other, factor in study.factors.items()
        if other != name
    }
    for owner, (value, settings) in options.items():
        for key in settings:
            if f"{key}.".startswith(f"{error.key}.") or f"{error.key}.".startswith(f"{key}."):
                return error.within(f"{value!r}").within(f"factors.{owner}")
    return error


def check_measured(study: Study, points: Sequence[unused_options.CheckedPoint]) -> None:
    """Raise InputError for a response that no trial of the study measures."""
    kinds = {point.trial.kind for point in points}
    scenes = [point.scene for point in points]
    where = {name: f"responses.{n}" for n, name in enumerate(study.responses)}
    where |= {one.response: key for key, one in named_sections(study)}
    where |= {name: f"require.{name}" for name in study.require}
    for name, key in where.items():
        measured = MEASURED_BY.get(metrics.split_name(name)[0], kinds)
        if not kinds & set(measured):
            raise InputError(
                key,
                f"{name} in trials of kind {', '.join(kinds)}",
                f"of {', '.join(measured)}",
            )
        if name == "ambiguous" and not any(map(may_report_ambiguity, scenes)):
            raise InputError(
                key,
                "no tracker of this study reports ambiguity",
                "under a dome, with the default identifier",
            )
        counts = any(scene.tracker.identifier == "shefex" for scene in scenes)
        if name.startswith("angles_compared") and not counts:
            raise InputError(
                key, "no identifier of this study counts angles", "tracker.identifier: shefex"
            )


def may_report_ambiguity(scene: Scene) -> bool:
    """Whether the tracker of a scene can refuse a frame as ambiguous."""
    from estimator.trackers.dome_tracker import SETTINGS

    may = scene.dome is not None and scene.tracker.identifier in (None, SETTINGS.identifier)
    return may or scene.tracker.name != OWN


def check_random_start(scene: Scene, start: AttitudeRange) -> None:
    """Raise InputError for a random start that the scene cannot have, or whose keys have no effect in it."""
    if isinstance(scene.light, CollimatedDisplayConfig) or scene.motion.start == "profile":
        where = (
            "a collimated display"
            if scene.motion.start != "profile"
            else "motion.start: profile"
        )
        raise InputError("trial.start", f"random with {where}", "scene")
    for key in ("dec_deg", "near") if scene.dome else ("tilt_deg",):
        if key in start.model_fields_set:
            raise InputError(
                f"trial.start.{key}",
                f"has no effect with light of kind {scene.light.kind}",
                "none",
            )
    greatest_deg = np.max(start.tilt_deg)
    vehicle = scene.vehicle
    if scene.dome and vehicle.mount == "air_bearing" and greatest_deg > vehicle.tilt_stop_deg:
        raise InputError(
            "trial.start.tilt_deg",
            f"{greatest_deg:g}",
            f"up to vehicle.tilt_stop_deg {vehicle.tilt_stop_deg:g}",
        )
