"""Schema of a study file (YAML) and its validated `Plan`: scene, trial, design points, replicates and responses."""

import hashlib
import json
from collections.abc import Mapping
from dataclasses import field
from pathlib import Path
from typing import Annotated, Any, ClassVar, Literal

import numpy as np
from pydantic import (
    AfterValidator,
    BeforeValidator,
    Discriminator,
    Field,
    Tag,
    model_validator,
)

from skysim.core.errors import InputError
from skysim.core.plugins import Programs
from skysim.core.types import frozen
from skysim.core.units import (
    BY_KIND,
    AxisAngle,
    ConfigModel,
    Declination,
    Delay,
    Duration,
    Fraction,
    InnerFraction,
    NotEmpty,
    NotNegative,
    Number,
    PositiveInt,
    Seed,
    Signed,
    Three,
    within,
)
from skysim.core.yaml_reader import Tree, explained, is_file, one_line, set_key
from skysim.experiments.study.factors import (
    MAX_LEVELS,
    SAMPLED_DESIGNS,
    Design,
    Factor,
    Point,
    Settings,
    Value,
)
from skysim.results.files.parts import Prices
from skysim.scene import loader
from skysim.scene.scene import Requirements, Scene

TRIAL = "trial."
HARDWARE = 1  # first of the three numbers of a hardware seed's key; a trial's seed has one or two (`trials.seed_of`)
SeedKey = Annotated[str, Field(pattern=r"^[a-z_]+(\.\w+)*[._]seed$")]
Tilt = Annotated[Number, within(0, 90)]
BodyName = Literal[
    "zenith",
    "sun",
    "moon",
    "mercury",
    "venus",
    "mars",
    "jupiter",
    "saturn",
    "uranus",
    "neptune",
]


def check_rising(ends: tuple[float, float]) -> tuple[float, float]:
    """Check that the ends of an interval are in order."""
    if ends[0] > ends[1]:
        raise InputError("", f"{ends[0]:g} to {ends[1]:g}", "the smaller first")
    return ends


class NearBody(ConfigModel):
    """Directions within two angles of the Sun, the Moon, a planet or the zenith of `site`, at the scene's start.

    Attributes
    ----------
    body
        Also where the scene's light has no bodies, so that frames with and without it can be
        compared
    """

    body: BodyName
    off_deg: Annotated[tuple[AxisAngle, AxisAngle], AfterValidator(check_rising)] = (0.0, 5.0)


class AttitudeRange(ConfigModel):
    """A random attitude in every trial, roll or yaw uniform.

    Attributes
    ----------
    tilt_deg
        Under a dome, tilt of the body from vertical: one angle, or uniform in solid angle
        between two
    dec_deg
        Under the stars, the boresight is uniform over the sphere between two declinations
    near
        Under the stars, the boresight is uniform in solid angle between two angles from a body
        instead
    """

    tilt_deg: Tilt | tuple[Tilt, Tilt] = (0.0, 30.0)
    dec_deg: tuple[Declination, Declination] = (-90.0, 90.0)
    near: NearBody | None = None


class RandomAttitude(AttitudeRange):
    """A random attitude in every trial, and its noise.

    Attributes
    ----------
    noise_seed
        Selects the noise at unchanged attitudes; as a factor it makes noise an input, as Sobol
        indices need
    attitude_seed
        Selects the attitudes; at points of a paired study that have the same one they are the
        same
    """

    noise_seed: Seed = 0
    attitude_seed: Seed = 0


class AxisConfig(ConfigModel):
    """An axis of rotation: a vector of any length in body axes, or in camera axes (+x right, +y down, +z boresight)."""

    body: Three[Signed] | None = None
    camera: Three[Signed] | None = None

    def check(self) -> None:
        given = [vector for vector in (self.body, self.camera) if vector is not None]
        if len(given) != 1 or not any(given[0]):
            raise InputError("", "", "one of body and camera, a vector that is not zero")


def axis_tag(value: Any) -> str:
    """Tag of an axis: a word, or a section; so that an error in one is not reported as one of the other."""
    return "AxisConfig" if isinstance(value, dict | AxisConfig) else "name"


RateAxis = Annotated[
    Annotated[Literal["perpendicular", "boresight"], Tag("name")]
    | Annotated[AxisConfig, Tag("AxisConfig")],
    Discriminator(axis_tag),
]


class CentroidTrial(RandomAttitude):
    """Identification and attitude from simulated centroids, without an image.

    With `tracker.decoder` they are those of successive frames at rest, to the first with an attitude, as many as the
    code has bits at most.

    Attributes
    ----------
    noise_px
        Standard deviation of a centroid, each axis
    noise_arcsec
        Standard deviation of a centroid's direction along each axis, in place of noise_px if it is given: equal in the
        whole field, as in simulations without an image
    magnitude_sigma
        Of its brightness, magnitudes
    lights
        Maximum number of true sources, the brightest
    missing
        Fraction of the true sources not detected
    false_lights
        Number of false detections, uniform over the image
    false_share
        Fraction of all detections that are false; their number is rounded
    """

    kind: Literal["centroids"]
    noise_px: NotNegative = 0.1
    noise_arcsec: NotNegative | None = None
    magnitude_sigma: NotNegative = 0.25
    lights: PositiveInt | None = None
    missing: Fraction = 0.0
    false_lights: Annotated[int, within(0, 10_000)] = 0
    false_share: Annotated[Number, within(0, 0.95)] = 0.0


class FrameTrial(RandomAttitude):
    """One frame, rendered with all camera noise, then solved.

    Attributes
    ----------
    rate_deg_s
        Rate about rate_axis
    acceleration_deg_s2
        About the same axis, in the direction of the rate
    turn_deg
        Rotation about the same axis from the random attitude to that of the frame, such as rate
        times time in a sequence of frames, or a fraction of a pixel
    rate_axis
        Perpendicular: a random axis perpendicular to the boresight; boresight; or an axis of
        body or camera
    gyro
        Whether the tracker receives the streak vector of the stars
    tracked
        Number of frames before it, at the scene's frame rate in the same motion, that the
        tracker has followed in its tracking mode; the frame is then solved in windows around
        the predicted stars, or not at all
    """

    kind: Literal["frames"]
    rate_deg_s: NotNegative = 0.0
    acceleration_deg_s2: NotNegative = 0.0
    turn_deg: Signed = 0.0
    rate_axis: RateAxis = "perpendicular"
    gyro: bool = False
    tracked: Annotated[int, within(0, 100)] = 0


def expand_start(value: Any) -> Any:
    """`start: scene` is short for none, `random` for a section of defaults."""
    if isinstance(value, str):
        return {"scene": None, "random": {}}.get(value, value)
    return value


class FlightTrial(ConfigModel):
    """The complete scene: motion simulated, frames rendered and solved, with the attitude filter if it has one.

    Attributes
    ----------
    settle
        Frames before this time are not counted
    start
        `scene`: that of the scene; `random`, or a section: a random attitude in every trial, at
        the scene's rate
    """

    kind: Literal["flight"]
    start: Annotated[
        AttitudeRange | None,
        BeforeValidator(
            expand_start,
            json_schema_input_type=AttitudeRange | Literal["scene", "random"] | None,
        ),
    ] = None
    settle_s: Delay = 0.0


Trial = Annotated[CentroidTrial | FrameTrial | FlightTrial, BY_KIND]


class Budget(ConfigModel):
    """Limits of a study: total trials, wall-clock time, failed trials; it can be resumed after the last two."""

    trials: PositiveInt | None = None
    time_s: Duration | None = None
    failures: PositiveInt | None = None


class Selection(ConfigModel):
    """Base of what a study shows: at some levels of the factors.

    Attributes
    ----------
    AXES
        Keys that name a factor
    """

    AXES: ClassVar[tuple[str, ...]]
    where: dict[str, Value] = Field(default_factory=dict)

    @property
    def axes(self) -> dict[str, str | None]:
        """The factors that it shows, by key."""
        return {key: getattr(self, key) for key in self.AXES}


class FigureKeys(Selection):
    """Base of the figures; RESPONSE is the key of the response."""

    RESPONSE: ClassVar[str]
    log: bool = False

    @property
    def response(self) -> str:
        """The response that the figure shows."""
        return str(getattr(self, self.RESPONSE))


class Curve(FigureKeys):
    """A figure: one response against a factor, with a line for each level of another factor."""

    AXES = ("x", "by")
    RESPONSE = "y"
    kind: Literal["curve"]
    x: str
    y: str
    by: str | None = None


class Map(FigureKeys):
    """A figure: one response over the directions of the random attitudes, a panel for each level of another factor.

    Under a dome the direction is that of the body's z axis, tilt as radius and azimuth as angle; under the stars it is
    the boresight's, in a projection of the whole sky.
    """

    AXES = ("by",)
    RESPONSE = "value"
    kind: Literal["map"]
    value: str
    by: str | None = None


class Heat(FigureKeys):
    """A figure: one response over two factors."""

    AXES = ("x", "y")
    RESPONSE = "value"
    kind: Literal["heat"]
    x: str
    y: str
    value: str


Figure = Annotated[Curve | Heat | Map, BY_KIND]


class Threshold(Selection):
    """Where along a factor a proportion crosses a limit, such as the rate at which 95 % of the frames are identified.

    Attributes
    ----------
    response
        A proportion (`identified`, `coverage_4`, ...), rising or falling along the factor
    along
        A factor with numeric levels
    by
        One threshold for each level of this factor
    """

    AXES = ("along", "by")
    response: str
    limit: InnerFraction
    along: str
    by: str | None = None


class Cost(ConfigModel):
    """Cost of a point: base + sum of `per` times the factor's value + the prices of its named levels + its parts.

    Attributes
    ----------
    parts
        Table of prices of the scene's parts (`skysim scenes parts`), whose total is added:
        `assumed`, or a CSV file beside the study; none if left out
    """

    parts: str | None = None
    base: Signed = 0.0
    per: dict[str, Signed] = Field(default_factory=dict)
    levels: dict[str, dict[str, Signed]] = Field(default_factory=dict)


class Objective(ConfigModel):
    """A response (or `cost`) and whether less or more of it is better."""

    response: str
    better: Literal["less", "more"] = "less"


class Constraint(ConfigModel):
    """A response (or `cost`) and its bounds."""

    response: str
    at_least: Signed | None = None
    at_most: Signed | None = None


class Search(ConfigModel):
    """The optimization of `skysim study optimize`: one objective, or the Pareto front of two.

    Attributes
    ----------
    candidates
        Number of points evaluated, each with all replicates
    """

    objectives: Annotated[tuple[Objective, ...], Field(min_length=1, max_length=2)]
    constraints: tuple[Constraint, ...] = ()
    candidates: Annotated[int, within(2, 100_000)] = 60
    cost: Cost = Cost()

    @property
    def responses(self) -> list[str]:
        """The responses of all objectives and constraints, each once."""
        names = [one.response for one in self.objectives]
        names += [one.response for one in self.constraints]
        return list(dict.fromkeys(names))


class Study(ConfigModel):
    """A study file: scene, trial, factors, design and responses.

    Attributes
    ----------
    scene
        Name, or path relative to the study file's folder, or the keys of a scene; `set`
        overrides keys of it at all points
    paired
        Use the same random attitudes and noise at every point for each replicate (common random
        numbers); by default in all designs but lhs and sobol, whose trials are evaluated together
    hardware
        Keys of seeds, such as `light.layout.hardware_seed` and `tracker.survey.seed`, that are
        drawn anew in every replicate: results then hold for all LED domes or surveys of the
        kind, not for one of them
    responses
        Names that `metrics.response` accepts
    require
        Requirements at every point, by default those of the scene: greatest quantile of an error
        (`cross_arcsec_p95: 60`), greatest share of an event (`wrong: 0.001`), least share of `identified`, `coverage_N`
        or `right_within_cross_arcsec_10`
    """

    schema_version: Annotated[Literal[1], Field(alias="schema")]
    title: str
    scene: str | Tree
    seed: Seed
    set: Settings = Field(default_factory=dict)
    trial: Trial
    factors: dict[Annotated[str, Field(pattern=r"^[a-z]\w*$")], Factor] = Field(
        default_factory=dict, max_length=100
    )
    design: Design = Design()
    replicates: Annotated[int, within(1, 10_000_000)] = 1
    hardware: tuple[SeedKey, ...] = ()
    paired: bool = True
    responses: NotEmpty[str]
    budget: Budget = Budget()
    figures: tuple[Figure, ...] = ()
    thresholds: tuple[Threshold, ...] = ()
    require: Requirements = Field(default_factory=dict)
    optimize: Search | None = None

    @model_validator(mode="before")
    @classmethod
    def default_pairing(cls, tree: Any) -> Any:
        """The same noise at all points, unless they are random points."""
        design = (
            tree.get("design")
            if isinstance(tree, dict) and not tree.get("optimize")
            else None
        )
        if isinstance(design, dict) and design.get("kind") in ("lhs", "sobol"):
            return {"paired": False} | tree
        return tree

    def check(self) -> None:
        levels = sum(len(factor.options()) for factor in self.factors.values())
        if levels > MAX_LEVELS:
            raise InputError("factors", f"{levels} levels", f"up to {MAX_LEVELS}")

    @property
    def is_sampled(self) -> bool:
        """Whether no two points share a level: a design in SAMPLED_DESIGNS, or an optimization."""
        return self.optimize is not None or self.design.kind in SAMPLED_DESIGNS

    @property
    def search(self) -> Search:
        """Section `optimize` of a study that has one."""
        assert self.optimize is not None
        return self.optimize

    def trial_count(self, points: int) -> int:
        """Number of trials of a design with so many points, or of a complete search."""
        return (self.optimize.candidates if self.optimize else points) * self.replicates


@frozen
class TrialSpec:
    """The part of a study that a worker needs to run any of its trials.

    Attributes
    ----------
    folder
        Folder of the study file, to which scene paths are relative
    hardware
        Keys of the seeds that every replicate draws anew
    programs
        External trackers and controllers by name: commands from the command line, functions and
        objects from Python; not part of the study's digest
    digests
        Digests of these functions and objects
    """

    scene: str | Tree
    folder: str
    seed: int
    base: Settings
    trial: Tree
    paired: bool
    hardware: tuple[str, ...] = ()
    programs: Programs = field(default_factory=dict)
    digests: Mapping[str, str] = field(default_factory=dict)

    def trial_settings(self, settings: Settings, replicate: int) -> Settings:
        """The settings of a point's trial: those of the point, and the replicate's draws of the hardware.

        A replicate draws the same hardware at every point, so that points are compared on the same units.
        """
        if not self.hardware:
            return settings
        seeds = np.random.SeedSequence(
            self.seed, spawn_key=(HARDWARE, replicate, 0)
        ).generate_state(len(self.hardware))
        return settings | dict(zip(self.hardware, seeds.tolist(), strict=True))


@frozen
class Plan:
    """A study with its design points. Trial number = point * replicates + replicate.

    Attributes
    ----------
    prices
        Prices of `optimize.cost.parts`
    text
        Text of the study's file
    """

    path: Path
    study: Study
    spec: TrialSpec
    points: list[Point]
    prices: Prices | None = None
    text: str = ""

    @property
    def name(self) -> str:
        """Name of the study: the stem of its file."""
        return self.path.stem

    @property
    def trials(self) -> int:
        """Total number of trials."""
        return len(self.points) * self.study.replicates

    @property
    def digest(self) -> str:
        """Hash of everything that affects a trial's outcome; title, figures, responses and budget may change."""
        keys = {
            "scene",
            "seed",
            "set",
            "trial",
            "factors",
            "design",
            "replicates",
            "paired",
            "hardware",
            "optimize",
        }
        tree = self.study.model_dump(mode="json", by_alias=True, include=keys)
        if self.prices:
            tree["prices"] = self.prices.parts
        return digest(tree)


def digest(value: Any) -> str:
    """First 16 hexadecimal digits of the SHA-256 of a JSON value."""
    text = json.dumps(value, sort_keys=True, separators=(",", ":"), default=str)
    return hashlib.sha256(text.encode()).hexdigest()[:16]


def resolve_point(spec: TrialSpec, settings: Settings) -> tuple[Scene, Trial]:
    """The scene and the trial at a point, with its settings applied. Raises InputError with one line."""
    trial = resolve_trial(spec, settings)
    values = spec.base | settings
    name = values.pop("scene", spec.scene)
    folder = Path(spec.folder)
    local = folder / str(name)
    if local.suffix in {".yaml", ".yml"} and is_file(local):
        name = local
    # `unused_options` refuses unused keys, for the whole study.
    overrides = scene_texts(values)
    return loader.load(name, overrides, refuses_unused=False, folder=folder), trial


def scene_texts(settings: Settings) -> dict[str, str]:
    """The settings of the scene, without those of the trial, as YAML texts."""
    return {
        key: one_line(value) for key, value in settings.items() if not key.startswith(TRIAL)
    }


def resolve_trial(spec: TrialSpec, settings: Settings) -> Trial:
    """The trial at a point, with its settings applied. Raises InputError with one line."""
    tree: Tree = {"trial": dict(spec.trial)}
    for key, value in (spec.base | settings).items():
        if key.startswith(TRIAL):
            set_key(tree, key, one_line(value))
    # Errors without file and line number; the caller adds the factor.
    with explained(tree, [], {}):
        return TrialSection.model_validate(tree).trial


class TrialSection(ConfigModel):
    """Wrapper that validates section `trial` alone."""

    trial: Trial
