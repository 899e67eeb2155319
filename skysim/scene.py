"""A scene file (YAML) becomes a validated, frozen `Scene`.

Its sections stand in `vehicle`, `motion`, `light` and `camera`, what a value with a unit is in `quantity`; there is no
other schema.
"""

from __future__ import annotations

import datetime
import re
from collections.abc import Mapping
from pathlib import Path
from typing import Annotated, Any, Literal

from pydantic import AfterValidator, Field, ValidationError, model_validator

from skysim import yamlfile
from skysim.camera import Camera, over, with_preset
from skysim.light import Bench, Dome, Glow, Stars
from skysim.motion import Motion, Pointing
from skysim.quantity import DATA, SHIPPED, Length, NotNegative, Number, Part, Positive, Spin, Time, in_utc
from skysim.types import BadInput
from skysim.vehicle import Site, Vehicle
from skysim.yamlfile import Files, explain, is_file, of_our_version, place_of, put, read_yaml

SCENES = SHIPPED / "scenes"
STEM = "(the file's name)"  # no key that a file could have
MOST_FRAMES, MOST_S = 1_000_000, 86_400.0  # of a flight, which memory holds
CATALOGUES = DATA / "catalogues"


def in_our_time(value: datetime.datetime) -> datetime.datetime:
    """UTC without a zone. The Earth's ephemeris and straight proper motion hold for a century or so."""
    if not 1900 <= value.year <= 2100:
        raise ValueError(f"{value.isoformat()} is outside of 1900 to 2100")
    return in_utc(value)


def a_file(value: str) -> str:
    """A path that is there."""
    if not is_file(Path(value)):
        raise ValueError(f"{value!r} is no file; allowed: one beside the scene, or a path")
    return value


class Exposure(Part):
    """When the shutter opens."""

    time_s: Annotated[Time, Field(ge=1e-6)]
    rate_hz: Annotated[Number, Field(gt=0)]
    frames: Annotated[int, Field(ge=1)]
    first_s: Annotated[Time, Field(ge=0)] = 0.0

    @model_validator(mode="after")
    def fits_its_period(self) -> Exposure:
        if self.time_s > 1 / self.rate_hz:
            raise ValueError(f"time {self.time_s} s is longer than the frame period {1 / self.rate_hz} s")
        lasts_s = self.first_s + self.frames / self.rate_hz
        if self.frames > MOST_FRAMES or lasts_s > MOST_S:
            raise ValueError(
                f"{self.frames} frames over {lasts_s:g} s; allowed: up to {MOST_FRAMES}, over a day ({MOST_S:g} s)"
            )
        return self


class Survey(Part):
    """How well the lab knows what it built. Drawn once, from a seed of its own; `light.surface.error` from it too.

    led_sigma    : standard deviation of every LED's believed place, about each axis of the lab
    lever_sigma  : of the camera's believed place, about each axis of the body
    turn_deg     : rotation vector by which the survey's axes stand turned in the lab's: what level or IMU it was
        referred to erred by. All believed LEDs are turned with it
    surface_seed : draws `light.surface.error`; `seed` if left out
    """

    turn_deg: tuple[Spin, Spin, Spin] = (0.0, 0.0, 0.0)
    surface_seed: Annotated[int, Field(ge=0)] | None = None
    led_sigma_m: Annotated[Length, Field(ge=0, le=0.1)] = 0.0
    lever_sigma_m: Annotated[Length, Field(ge=0, le=0.1)] = 0.0
    seed: Annotated[int, Field(ge=0)] = 0


class ExposureControl(Part):
    """How long to expose, decided on the frame before: SHEFEX-2's chart, `estimator.exposure` (Samaan & Theil 2011).

    `exposure.time` is the first frame's. Too bright is a step shorter, else too few stars a step longer. What the
    exposure of a frame is hangs on all frames before it, so frame 57 does not render alone with this section.

    mean_dn             : of a frame, above which it is no picture of stars: twice its bias and sky, say
    least_stars         : fewer cannot be identified
    overexposed_objects : so many with more than saturated_px full pixels each are too many
    """

    mean_dn: Positive
    shortest_s: Annotated[Time, Field(ge=10e-6)] = 10e-6
    longest_s: Annotated[Time, Field(le=10.0)] = 50e-3
    step_s: Annotated[Time, Field(ge=1e-6)] = 2e-3
    least_stars: Annotated[int, Field(ge=1)] = 4
    overexposed_objects: Annotated[int, Field(ge=1)] = 4
    saturated_px: Annotated[int, Field(ge=0)] = 1

    @model_validator(mode="after")
    def in_order(self) -> ExposureControl:
        if self.shortest_s > self.longest_s:
            raise ValueError(f"shortest {self.shortest_s:g} s is above longest {self.longest_s:g} s")
        return self


class Tracker(Part):
    """What the star tracker's computer does and believes. `null` believes what the hardware is.

    name : own, or a tracker of somebody else's: an entry point, or a program that the command line names (`--program`)
    options, time_limit : what such a tracker is told, and for how long it may look at a frame
    map : a file that `skysim survey` wrote: LEDs, lever, focal length and distortion as measured
    detector, centroider, identifier, solver : if left out, under a dome local, cog, led_pairs and rotation_only, and
        under the stars all of them `default`
    believed_distortion : k1, k2, p1, p2, k3 of the lens; as it is if left out
    brightest : no more lights of a frame than that are looked at
    exposure_control : every frame is exposed for `exposure.time` if left out
    """

    name: Annotated[str, Field(pattern=r"^\w[\w.-]*$")] = "own"
    options: dict[str, bool | int | Number | str] = Field(default_factory=dict)
    time_limit_s: Annotated[Time, Field(ge=1e-3, le=3600)] = 10.0
    detector: str | None = None
    centroider: str | None = None
    identifier: str | None = None
    solver: str | None = None
    threshold_sigma: Annotated[Number, Field(gt=0)] = 5.0
    min_area_px: Annotated[int, Field(ge=1)] = 3
    limit_mag: Number = 6.0
    centroid_sigma_px: Annotated[Number, Field(gt=0)] = 0.2
    believed_focal_length_m: Annotated[Length, Field(gt=0)] | None = None
    believed_distortion: tuple[Number, Number, Number, Number, Number] | None = None
    brightest: Annotated[int, Field(ge=3, le=1000)] | None = None
    believed_camera_body_m: tuple[Length, Length, Length] | None = None
    survey: Survey = Survey()
    exposure_control: ExposureControl | None = None
    map: Annotated[str, AfterValidator(a_file)] | None = None

    @model_validator(mode="after")
    def one_lever(self) -> Tracker:
        if self.believed_camera_body_m is not None and self.survey.lever_sigma_m:
            raise ValueError(
                "survey.lever_sigma: believed_camera_body tells the place; allowed: one of the two"
            )
        return self

    @model_validator(mode="after")
    def one_map(self) -> Tracker:
        told = {
            "believed_focal_length": self.believed_focal_length_m,
            "believed_camera_body": self.believed_camera_body_m,
            "believed_distortion": self.believed_distortion,
            "survey.led_sigma": self.survey.led_sigma_m,
            "survey.lever_sigma": self.survey.lever_sigma_m,
        }
        beside = [key for key, value in told.items() if value]
        if self.map and beside:
            raise ValueError(f"{beside[0]}: the file of tracker.map tells it; allowed: one of the two")
        return self


class Filter(Part):
    """What the attitude filter believes of the gyro and of the star tracker (MEKF: attitude and gyro bias).

    The bias is believed to wander about zero in body axes. The Earth's turning where imu.earth_rate is uncompensated is
    learnt as bias while the attitude stays; a vehicle that turns takes it for another one, unless bias_deg_h has room
    for it (15) and bias_time is that of the turning. So with the gyro's scale and misalignment.

    arw_deg_sqrt_h, bias_deg_h, bias_time : of the gyro; the bias a Gauss-Markov process
    start_deg, start_bias_deg_h           : standard deviation of attitude and bias about each axis at the start
    floor_arcsec : of a star tracker's solution, added to its own covariance: what is the same in every frame
    gate_sigma   : a solution farther off than this is refused
    latency      : from the end of an exposure to its solution
    """

    arw_deg_sqrt_h: NotNegative = 0.07
    bias_deg_h: NotNegative = 1.0
    bias_time_s: Annotated[Time, Field(gt=0)] = 300.0
    start_deg: Positive = 1.0
    start_bias_deg_h: Positive = 10.0
    floor_arcsec: NotNegative = 1.0
    gate_sigma: Positive = 5.0
    latency_s: Annotated[Time, Field(ge=0)] = 0.0


class Scene(Part):
    """The whole story, before it happens."""

    schema_version: Annotated[Literal[1], Field(alias="schema")]
    title: str
    seed: Annotated[int, Field(ge=0)]
    start_time: Annotated[datetime.datetime, AfterValidator(in_our_time)]
    lab: Site = Site()
    vehicle: Vehicle
    motion: Motion
    light: Annotated[Dome | Stars | Bench, Field(discriminator="kind")]
    background: tuple[Glow, ...] = ()
    camera: Camera
    exposure: Exposure
    tracker: Tracker = Tracker()
    filter: Filter | None = None
    name: Annotated[str, Field(exclude=True, alias=STEM)] = ""

    @model_validator(mode="after")
    def one_world(self) -> Scene:
        sky = self.light.kind == "stars"
        told = self.tracker
        if not isinstance(self.light, Dome) and (told.survey != Survey() or told.map):
            key = "map" if told.map else "survey"
            raise ValueError(
                f"tracker.{key}: light of kind {self.light.kind} has nothing to survey; allowed: dome"
            )
        if sky != isinstance(self.motion.start, Pointing):
            wanted = "ra_deg, dec_deg, roll_deg" if sky else "roll_deg, pitch_deg, yaw_deg"
            raise ValueError(f"motion.start: light of kind {self.light.kind} takes {wanted}")
        read_s = getattr(self.camera.shutter, "row_time_s", 0.0) * (self.camera.height_px - 1)
        if read_s > 1 / self.exposure.rate_hz:
            raise ValueError(
                f"camera.shutter: reading takes {read_s:g} s, longer than the frame period"
                f" {1 / self.exposure.rate_hz:g} s"
            )
        return self

    @model_validator(mode="after")
    def exposures(self) -> Scene:
        """Any exposure that the tracker may ask for ends before the next begins."""
        told, period_s = self.tracker.exposure_control, 1 / self.exposure.rate_hz
        if told is None:
            return self
        if told.longest_s > period_s:
            raise ValueError(
                f"tracker.exposure_control.longest: {told.longest_s:g} s is longer than the frame period {period_s:g} s"
            )
        if not told.shortest_s <= self.exposure.time_s <= told.longest_s:
            raise ValueError(
                f"tracker.exposure_control: exposure.time {self.exposure.time_s:g} s, the first, is outside of"
                f" {told.shortest_s:g} s to {told.longest_s:g} s"
            )
        return self

    @model_validator(mode="after")
    def who_flies(self) -> Scene:
        told = self.motion.control
        imu = self.vehicle.imu
        if self.filter and not imu:
            raise ValueError("filter: takes a gyro; allowed beside vehicle.imu")
        if told is None:
            return self
        has = {"ideal": True} | {kind: getattr(self.vehicle, kind) for kind in ("wheels", "fans", "cmgs")}
        if not has[told.actuators]:
            raise ValueError(f"motion.control.actuators: vehicle.{told.actuators} is not switched on")
        if told.desaturation and (not self.vehicle.fans or told.actuators not in ("wheels", "cmgs")):
            raise ValueError("motion.control.desaturation: takes vehicle.fans, and actuators: wheels or cmgs")
        if {"truth": False, "imu": not imu, "filter": not self.filter}[told.feedback]:
            section = "vehicle.imu" if told.feedback == "imu" else "filter"
            raise ValueError(f"motion.control.feedback: {told.feedback} takes the section {section}")
        return self

    @model_validator(mode="after")
    def clocks(self) -> Scene:
        """Steps in a control period, and IMU samples in one, come out whole."""
        rate_hz = self.control_rate_hz
        if abs(1000 / rate_hz - round(1000 / rate_hz)) > 1e-9:
            raise ValueError(f"motion.control.rate_hz: {rate_hz:g} Hz is no whole number of milliseconds")
        imu = self.vehicle.imu
        if imu and self.filter and self.filter.bias_time_s < 10 / imu.rate_hz:
            raise ValueError(f"filter.bias_time: shorter than ten samples of the IMU, {10 / imu.rate_hz:g} s")
        fastest_hz = max(
            (part.frequency_hz for part in self.motion.manoeuvre if part.kind == "sine"), default=0
        )
        if 2 * fastest_hz >= rate_hz:
            raise ValueError(
                f"motion.manoeuvre: a sine of {fastest_hz:g} Hz takes a motion.control.rate_hz of more than twice that"
            )
        if imu and abs(imu.rate_hz / rate_hz - round(imu.rate_hz / rate_hz)) > 1e-9:
            raise ValueError(
                f"vehicle.imu.rate_hz: {imu.rate_hz:g} Hz is no multiple of motion.control.rate_hz {rate_hz:g} Hz"
            )
        return self

    @property
    def control_rate_hz(self) -> float:
        """The vehicle's computer ticks at this rate, whether it steers or listens only."""
        return self.motion.control.rate_hz if self.motion.control else 100.0


class CameraFile(Part):
    """A file that describes a camera and nothing else."""

    camera: Camera


def find(name: str) -> Path:
    """The path of a scene given by path or by its name in scenes/."""
    return yamlfile.find(name, SCENES, "scene")


def load(name: str | Path, overrides: Mapping[str, str] | None = None) -> Scene:
    """Read, override (`path.to.key` -> YAML value) and validate a scene.

    Raises BadInput with one line: the key, what is wrong with it, what is allowed, the file and line.
    """
    path = find(str(name))
    tree, files = read(path)
    for key, value in (overrides or {}).items():
        put(tree, key, value)
    try:
        raw = beneath(tree, files, overrides or {})
        return Scene.model_validate(raw | {STEM: path.stem})
    except ValidationError as error:
        raise BadInput(explain(error, Scene, tree, files, overrides or {})) from None


def where(message: str, name: str, overrides: Mapping[str, str]) -> str:
    """A complaint that begins with a key of a scene, and where that stands; any other as it is."""
    key = message.partition(":")[0]
    told = re.fullmatch(r"[a-z_]+(\.\w+)*", key)
    if (
        not told
        or key.partition(".")[0] not in Scene.model_fields
        or re.search(r"\((--set|.*, line \d+)\)$", message)
    ):
        return message
    return f"{message} {place_of(key.split('.'), read(find(name))[1], overrides)}"


def read(path: Path, above: tuple[Path, ...] = ()) -> tuple[dict[str, Any], Files]:
    """A scene's keys over those of its `base`, another scene by name or path; and the files, this one first."""
    tree, text = read_yaml(path)
    if above or tree.keys() != {"camera"}:  # a camera's file, which is no scene
        of_our_version(tree, path, text)
    tree = beside(path, tree)
    if "base" not in tree:
        return tree, [(path, text)]
    base = tree.pop("base")
    place = place_of(["base"], [(path, text)], {})
    try:
        below = find(str(path.parent / base) if is_file(path.parent / str(base)) else str(base))
    except BadInput as error:
        raise BadInput(f"base: {error} {place}") from None
    if below.resolve() in above or below.resolve() == path.resolve():
        raise BadInput(f"base: {base} is this scene itself, or has it for its base {place}")
    beneath_it, files = read(below, (*above, path.resolve()))
    return over(beneath_it, tree), [(path, text), *files]


def beneath(tree: dict[str, Any], files: Files, overrides: Mapping[str, str]) -> dict[str, Any]:
    """`with_preset`, which knows neither file nor line."""
    try:
        return with_preset(tree)
    except BadInput as error:
        key = str(error).partition(":")[0]
        raise BadInput(f"{error} {place_of(key.split('.'), files, overrides)}") from None


# Keys that name a file of the scene's own.
FILES = (
    ("vehicle", "model"),
    ("camera", "psf", "file"),
    ("camera", "calibration"),
    ("light", "surface", "file"),
    ("light", "layout", "file"),
    ("light", "layout", "points", "file"),
    ("tracker", "map"),
)


def beside(path: Path, tree: dict[str, Any]) -> dict[str, Any]:
    """The scene with the files that it names taken from its own folder, where there are any of that name."""
    for keys in FILES:
        tree = anchored(path.resolve().parent, tree, *keys)
    return tree


def anchored(folder: Path, tree: dict[str, Any], key: str, *inner: str) -> dict[str, Any]:
    """A mapping in which the file named under these keys, if it is in the folder, has its whole path."""
    value = tree.get(key)
    if inner and isinstance(value, dict):
        return tree | {key: anchored(folder, value, *inner)}
    if not inner and isinstance(value, str) and is_file(folder / value):
        return tree | {key: str(folder / value)}
    return tree


def load_camera(path: Path, lens: Mapping[str, Any] | None = None) -> Camera:
    """The `camera` section of a scene, or of a file that has nothing else. Raises BadInput with one line.

    lens : keys that stand in for those which a preset leaves to its scene
    """
    tree, files = read(path)
    if isinstance(tree.get("camera"), dict):
        tree = tree | {"camera": {**(lens or {}), **tree["camera"]}}
    try:
        own = beside(path, {key: tree[key] for key in tree if key == "camera"})
        return CameraFile.model_validate(beneath(own, files, {})).camera
    except ValidationError as error:
        raise BadInput(explain(error, CameraFile, tree, files, {})) from None
