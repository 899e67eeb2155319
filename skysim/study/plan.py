"""A study file (YAML) becomes a validated `Plan`: which scene, which trial, which points, how often, what is asked."""

from __future__ import annotations

import hashlib
import json
from collections.abc import Iterator, Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Annotated, Any, Literal

import yaml
from pydantic import Field, ValidationError

from skysim import metrics, yamlfile
from skysim.quantity import NotNegative, Number, Part, Share, Time
from skysim.scene import SCENES, Bench, Scene
from skysim.scene import find as find_scene
from skysim.scene import load as load_scene
from skysim.study.designs import Design, Point, points
from skysim.study.factors import Factor, Settings, Value
from skysim.trackers import OWN, known
from skysim.types import BadInput
from skysim.yamlfile import explain, is_file, line_of, of_our_version, put, read_yaml

STUDIES = SCENES / "studies"
TRIAL = "trial."
Declination = Annotated[Number, Field(ge=-90, le=90)]
Tilt = Annotated[Number, Field(ge=0, le=90)]


class Anywhere(Part):
    """A random attitude in every trial, roll or yaw uniform.

    tilt_deg : under a dome the body's lean from upright, one angle or uniform over the cap's ring between two
    dec_deg  : under the stars the boresight is uniform over the sphere between two declinations
    noise_seed : other noise at the same attitudes; a factor of it makes noise an input, as Sobol indices want
    """

    noise_seed: Annotated[int, Field(ge=0)] = 0
    tilt_deg: Tilt | tuple[Tilt, Tilt] = (0.0, 30.0)
    dec_deg: tuple[Declination, Declination] = (-90.0, 90.0)


class CentroidTrial(Anywhere):
    """Star identification and attitude from centroids, without a picture.

    noise_px : of a centroid, each axis;  magnitude_sigma : of its brightness
    lights   : at most so many true ones, the brightest;  missing : share of the true lights not seen
    false_lights : so many anywhere;  false_share : of all lights seen, rounded to a whole number of false ones
    """

    kind: Literal["centroids"]
    noise_px: NotNegative = 0.1
    magnitude_sigma: NotNegative = 0.25
    lights: Annotated[int, Field(ge=1)] | None = None
    missing: Share = 0.0
    false_lights: Annotated[int, Field(ge=0, le=10_000)] = 0
    false_share: Annotated[Number, Field(ge=0, le=0.95)] = 0.0


class FrameTrial(Anywhere):
    """One whole frame: rendered, with all the camera's noise, then solved.

    rate_deg_s : about a random axis across the boresight;  gyro : whether the tracker is told how stars smear
    """

    kind: Literal["frames"]
    rate_deg_s: NotNegative = 0.0
    gyro: bool = False


class FlightTrial(Part):
    """The whole scene: flown, photographed, solved and, where it has a filter, filtered.

    settle : frames before this do not count
    """

    kind: Literal["flight"]
    settle_s: Annotated[Time, Field(ge=0)] = 0.0


Trial = Annotated[CentroidTrial | FrameTrial | FlightTrial, Field(discriminator="kind")]


class Budget(Part):
    """What a study may cost: trials in all, wall-clock time, failed trials; after the latter two it can be resumed."""

    trials: Annotated[int, Field(ge=1)] | None = None
    time_s: Annotated[Time, Field(gt=0)] | None = None
    failures: Annotated[int, Field(ge=1)] | None = None


class Curve(Part):
    """A figure: one response against a factor, a line for each level of another."""

    kind: Literal["curve"]
    x: str
    y: str
    by: str | None = None
    where: dict[str, Value] = Field(default_factory=dict)
    log: bool = False


class Heat(Part):
    """A figure: one response over two factors."""

    kind: Literal["heat"]
    x: str
    y: str
    value: str
    where: dict[str, Value] = Field(default_factory=dict)
    log: bool = False


Figure = Annotated[Curve | Heat, Field(discriminator="kind")]


class Cost(Part):
    """What a point costs: base + sum of `per` times a factor's value + the named level's price."""

    base: Number = 0.0
    per: dict[str, Number] = Field(default_factory=dict)
    levels: dict[str, dict[str, Number]] = Field(default_factory=dict)


class Objective(Part):
    """A response (or `cost`) and whether less or more of it is better."""

    response: str
    better: Literal["less", "more"] = "less"


class Constraint(Part):
    """A response (or `cost`) and what it must not leave."""

    response: str
    at_least: Number | None = None
    at_most: Number | None = None


class Search(Part):
    """What `skysim study optimise` looks for: one objective, or two and their Pareto front.

    candidates : points tried, each with all replicates
    """

    objectives: Annotated[tuple[Objective, ...], Field(min_length=1, max_length=2)]
    constraints: tuple[Constraint, ...] = ()
    candidates: Annotated[int, Field(ge=2, le=100_000)] = 60
    cost: Cost = Cost()


class Study(Part):
    """A question, before it is answered.

    scene      : by name or by path, from the study file's folder; `set` overrides keys of it for all points
    paired     : the same random attitudes and noise at every point, replicate by replicate, so that points compare
    responses  : as `metrics.RESPONSES` names them
    """

    schema_version: Annotated[Literal[1], Field(alias="schema")]
    title: str
    scene: str
    seed: Annotated[int, Field(ge=0)]
    set: Settings = Field(default_factory=dict)
    trial: Trial
    factors: Annotated[dict[Annotated[str, Field(pattern=r"^[a-z]\w*$")], Factor], Field(min_length=1)]
    design: Design = Design()
    replicates: Annotated[int, Field(ge=1, le=10_000_000)] = 1
    paired: bool = True
    responses: Annotated[tuple[str, ...], Field(min_length=1)]
    budget: Budget = Budget()
    figures: tuple[Figure, ...] = ()
    optimise: Search | None = None


@dataclass(frozen=True, slots=True)
class Recipe:
    """What a worker has to know of a study to do any trial of it.

    folder : of the study file, against which scenes are named
    programs : commands by name, which `tracker.name` may be: of the command line, and no part of a study's digest
    """

    scene: str
    folder: str
    seed: int
    base: Settings
    trial: dict[str, Any]
    paired: bool
    programs: Mapping[str, str] = field(default_factory=dict)


@dataclass(frozen=True, slots=True)
class Plan:
    """A study with its points. Trial number = point * replicates + replicate."""

    path: Path
    study: Study
    recipe: Recipe
    points: list[Point]

    @property
    def name(self) -> str:
        """The study file's."""
        return self.path.stem

    @property
    def trials(self) -> int:
        """How many there are in all."""
        return len(self.points) * self.study.replicates

    @property
    def digest(self) -> str:
        """A hash of everything that decides on a trial; title, figures, budget and the like may change."""
        told = self.study.model_dump(mode="json", by_alias=True)
        kept = ("scene", "seed", "set", "trial", "factors", "design", "replicates", "paired", "optimise")
        return digest({key: told[key] for key in kept})


def digest(told: Any) -> str:
    """Sixteen hexadecimal digits of a JSON value's SHA-256."""
    text = json.dumps(told, sort_keys=True, separators=(",", ":"), default=str)
    return hashlib.sha256(text.encode()).hexdigest()[:16]


def find(name: str) -> Path:
    """The path of a study given by path or by its name in scenes/studies/."""
    return yamlfile.find(name, STUDIES, "study")


def title_of(path: Path) -> str:
    """A study file's title, the rest of it unread."""
    return str(read_yaml(path)[0].get("title", ""))


def load(
    name: str | Path, overrides: Mapping[str, str] | None = None, programs: Mapping[str, str] | None = None
) -> Plan:
    """Read, override (`path.to.key` -> YAML value) and validate a study and every level of its factors.

    programs : commands by name for `tracker.name`; None where the study shall not be run, and they need not be there
    Raises BadInput with one line: the key, what is wrong with it, what is allowed, the file and line.
    """
    path = find(str(name))
    tree, text = read_yaml(path)
    of_our_version(tree, path, text)
    for key, value in (overrides or {}).items():
        put(tree, key, value)
    try:
        study = Study.model_validate(tree)
    except ValidationError as error:
        raise BadInput(explain(error, Study, tree, [(path, text)], overrides or {})) from None
    try:
        plan = planned(path, study, tree["trial"], programs or {})
        check(plan, to_run=programs is not None)
    except BadInput as error:
        raise BadInput(located(str(error), path, text)) from None
    return plan


def planned(path: Path, study: Study, trial: dict[str, Any], programs: Mapping[str, str]) -> Plan:
    """The study's points and what a worker has to know; `trial` as the file has it, units and all."""
    chosen = [] if study.optimise else points(study.design, study.factors, study.seed)
    folder = str(path.resolve().parent)
    told = Recipe(study.scene, folder, study.seed, study.set, trial, study.paired, dict(programs))
    return Plan(path, study, told, chosen)


def check(plan: Plan, to_run: bool) -> None:
    """Refuse, before the first trial, what cannot be asked: responses, figures, budget, and levels one by one.

    to_run : whether the trackers have to be there
    """
    from skysim.study import arrange, search
    from skysim.study.store import COLUMNS
    from skysim.study.table import Line

    study = plan.study
    for n, name in enumerate(study.responses):
        metrics.response(name, f"responses.{n}")
    for n, figure in enumerate(study.figures):
        for key in ("x", "by") if isinstance(figure, Curve) else ("x", "y"):
            axis = getattr(figure, key)
            if axis is not None and axis not in study.factors:
                raise BadInput(f"figures.{n}.{key}: {axis!r} is none of {', '.join(study.factors)}")
        metrics.response(figure.y if isinstance(figure, Curve) else figure.value, f"figures.{n}")
        if plan.points:
            arrange.held(figure, study, [Line(k, point.levels, {}) for k, point in enumerate(plan.points)])
    if study.optimise:
        search.check(study)
    if study.budget.trials is not None and plan.trials > study.budget.trials:
        raise BadInput(f"budget.trials: {study.budget.trials} are fewer than the study's {plan.trials}")
    for name in study.factors:
        if name in COLUMNS or name in study.responses:
            raise BadInput(f"factors.{name}: is a column of every trial; allowed: another name")
    for name, level, settings in one_by_one(study.factors):
        try:
            scene, trial = resolved(plan.recipe, settings)
            if isinstance(scene.light, Bench) and not isinstance(trial, FlightTrial):
                raise BadInput("trial.kind: a bench has no sky around it; allowed: flight")
            if to_run:
                check_tracker(plan, scene, trial)
        except BadInput as error:
            key = str(error).partition(":")[0]
            owners = [other for other, factor in study.factors.items() if key in dict(factor.at(0.5)[1])]
            owner = name if name in owners or not owners else owners[0]
            told = level if owner == name else study.factors[owner].at(0.5)[0]
            raise BadInput(f"factors.{owner}: {told!r}: {error}") from None


def check_tracker(plan: Plan, scene: Scene, trial: CentroidTrial | FrameTrial | FlightTrial) -> None:
    """Refuse a tracker that no worker would find, or that a trial of centroids has nothing to show. Raises BadInput."""
    name = scene.tracker.name
    known(name, plan.recipe.programs)
    if name != OWN and isinstance(trial, CentroidTrial):
        raise BadInput(f"tracker.name: {name} takes frames; allowed: {OWN}, or another trial.kind")


def one_by_one(factors: Mapping[str, Factor]) -> Iterator[tuple[str, Value, Settings]]:
    """Every level of every factor, the others at their middle: which factor, the level, all that is set."""
    middle = {name: factor.at(0.5)[1] for name, factor in factors.items()}
    for name, factor in factors.items():
        for level, settings in factor.options() or [factor.at(0.5)]:
            others: Settings = {}
            for other, sets in middle.items():
                others |= sets if other != name else {}
            yield name, level, others | settings


def resolved(recipe: Recipe, settings: Settings) -> tuple[Scene, CentroidTrial | FrameTrial | FlightTrial]:
    """The scene and the trial at a point. Raises BadInput with one line."""
    told = recipe.base | settings
    name = str(told.get("scene", recipe.scene))
    tree: dict[str, Any] = {"trial": dict(recipe.trial)}
    scene_keys = {}
    for key, value in told.items():
        if key.startswith(TRIAL):
            put(tree, key, as_yaml(value))
        elif key != "scene":
            scene_keys[key] = as_yaml(value)
    try:
        trial = Asked.model_validate(tree).trial
    except ValidationError as error:
        raise BadInput(told_of(error, tree)) from None
    beside = Path(recipe.folder) / name
    path = beside if beside.suffix in {".yaml", ".yml"} and is_file(beside) else find_scene(name)
    return load_scene(path, scene_keys), trial


def told_of(error: ValidationError, tree: dict[str, Any]) -> str:
    """A fault of a trial as of any file, without a place: the factor that made it is told by who asked."""
    return explain(error, Asked, tree, [(Path(), "")], {}).removesuffix(f" ({Path()})")


class Asked(Part):
    """The section `trial` alone."""

    trial: Trial


def as_yaml(value: Value) -> str:
    """A value as YAML, on one line."""
    return yaml.safe_dump(value, default_flow_style=True, width=1_000_000).removesuffix("\n...\n")


def located(message: str, path: Path, text: str) -> str:
    """A complaint of a study's key with its file and line."""
    line = line_of(text, message.partition(":")[0].split("."))[1]
    return f"{message.removesuffix(' (--set)')} ({path}{f', line {line}' if line else ''})"
