"""A study file (YAML) becomes a validated `Plan`: which scene, which trial, which points, how often, what is asked."""

from __future__ import annotations

import hashlib
import json
from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Annotated, Any, Literal

import yaml
from pydantic import Field, ValidationError

from skysim.core import yaml_reader
from skysim.core.errors import InputError
from skysim.core.paths import SCENES
from skysim.core.units import ConfigModel, NotNegative, Number, Share, Time
from skysim.core.yaml_reader import explain, is_file, put, read_yaml
from skysim.experiments.study.designs import Design, Point, points
from skysim.experiments.study.factors import Factor, Settings, Value
from skysim.scene.loader import find as find_scene
from skysim.scene.loader import load as load_scene
from skysim.scene.scene import Scene

STUDIES = SCENES / "studies"
TRIAL = "trial."
Declination = Annotated[Number, Field(ge=-90, le=90)]
Tilt = Annotated[Number, Field(ge=0, le=90)]


class Anywhere(ConfigModel):
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


class FlightTrial(ConfigModel):
    """The whole scene: flown, photographed, solved and, where it has a filter, filtered.

    settle : frames before this do not count
    """

    kind: Literal["flight"]
    settle_s: Annotated[Time, Field(ge=0)] = 0.0


Trial = Annotated[CentroidTrial | FrameTrial | FlightTrial, Field(discriminator="kind")]


class Budget(ConfigModel):
    """What a study may cost: trials in all, wall-clock time, failed trials; after the latter two it can be resumed."""

    trials: Annotated[int, Field(ge=1)] | None = None
    time_s: Annotated[Time, Field(gt=0)] | None = None
    failures: Annotated[int, Field(ge=1)] | None = None


class Curve(ConfigModel):
    """A figure: one response against a factor, a line for each level of another."""

    kind: Literal["curve"]
    x: str
    y: str
    by: str | None = None
    where: dict[str, Value] = Field(default_factory=dict)
    log: bool = False


class Heat(ConfigModel):
    """A figure: one response over two factors."""

    kind: Literal["heat"]
    x: str
    y: str
    value: str
    where: dict[str, Value] = Field(default_factory=dict)
    log: bool = False


Figure = Annotated[Curve | Heat, Field(discriminator="kind")]


class Cost(ConfigModel):
    """What a point costs: base + sum of `per` times a factor's value + the named level's price."""

    base: Number = 0.0
    per: dict[str, Number] = Field(default_factory=dict)
    levels: dict[str, dict[str, Number]] = Field(default_factory=dict)


class Objective(ConfigModel):
    """A response (or `cost`) and whether less or more of it is better."""

    response: str
    better: Literal["less", "more"] = "less"


class Constraint(ConfigModel):
    """A response (or `cost`) and what it must not leave."""

    response: str
    at_least: Number | None = None
    at_most: Number | None = None


class Search(ConfigModel):
    """What `skysim study optimise` looks for: one objective, or two and their Pareto front.

    candidates : points tried, each with all replicates
    """

    objectives: Annotated[tuple[Objective, ...], Field(min_length=1, max_length=2)]
    constraints: tuple[Constraint, ...] = ()
    candidates: Annotated[int, Field(ge=2, le=100_000)] = 60
    cost: Cost = Cost()


class Study(ConfigModel):
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
    return yaml_reader.find(name, STUDIES, "study")


def title_of(path: Path) -> str:
    """A study file's title, the rest of it unread."""
    return str(read_yaml(path)[0].get("title", ""))


def planned(path: Path, study: Study, trial: dict[str, Any], programs: Mapping[str, str]) -> Plan:
    """The study's points and what a worker has to know; `trial` as the file has it, units and all."""
    chosen = [] if study.optimise else points(study.design, study.factors, study.seed)
    folder = str(path.resolve().parent)
    told = Recipe(study.scene, folder, study.seed, study.set, trial, study.paired, dict(programs))
    return Plan(path, study, told, chosen)


def resolved(recipe: Recipe, settings: Settings) -> tuple[Scene, CentroidTrial | FrameTrial | FlightTrial]:
    """The scene and the trial at a point. Raises InputError with one line."""
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
        raise InputError(told_of(error, tree)) from None
    beside = Path(recipe.folder) / name
    path = beside if beside.suffix in {".yaml", ".yml"} and is_file(beside) else find_scene(name)
    return load_scene(path, scene_keys), trial


def told_of(error: ValidationError, tree: dict[str, Any]) -> str:
    """A fault of a trial as of any file, without a place: the factor that made it is told by who asked."""
    return explain(error, Asked, tree, [(Path(), "")], {}).removesuffix(f" ({Path()})")


class Asked(ConfigModel):
    """The section `trial` alone."""

    trial: Trial


def as_yaml(value: Value) -> str:
    """A value as YAML, on one line."""
    return yaml.safe_dump(value, default_flow_style=True, width=1_000_000).removesuffix("\n...\n")
