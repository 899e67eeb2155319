"""A scene file (YAML) becomes a validated, frozen `Scene`. With `camera` and `quantity` the only schema."""

from __future__ import annotations

import datetime
from collections.abc import Mapping
from pathlib import Path
from typing import Annotated, Any, Literal

from pydantic import (
    AfterValidator,
    Discriminator,
    Field,
    Tag,
    ValidationError,
    field_validator,
    model_validator,
)

from skysim.camera import Camera, with_preset
from skysim.light import Dome, Glow, Stars
from skysim.quantity import (
    DATA,
    ROOT,
    Inertia,
    Length,
    Mass,
    NotNegative,
    Number,
    Part,
    Positive,
    Spin,
    Time,
    Torque,
    Triple,
)
from skysim.types import BadInput
from skysim.yamlfile import explain, place_of, put, read_yaml

SCENES = ROOT / "scenes"
STEM = "(the file's name)"  # no key that a file could have
CATALOGUES = DATA / "catalogues"


def in_our_time(value: datetime.datetime) -> datetime.datetime:
    """The Earth's ephemeris and straight proper motion hold for a century or so."""
    if not 1900 <= value.year <= 2100:
        raise ValueError(f"{value.isoformat()} is outside of 1900 to 2100")
    return value


class Vehicle(Part):
    """What moves: an MJCF file and the mass properties that the scene declares over it."""

    model: str
    mount: Literal["air_bearing", "free"] = "air_bearing"
    mass_kg: Annotated[Mass, Field(gt=0)] | None = None
    inertia_kg_m2: tuple[Inertia, Inertia, Inertia] | None = None
    centre_of_mass_m: tuple[Length, Length, Length] = (0.0, 0.0, 0.0)
    tilt_stop_deg: Annotated[Number, Field(gt=0, lt=90)] = 30.0
    torque_limit_nm: Annotated[Torque, Field(gt=0)] = 1.0

    @field_validator("inertia_kg_m2")
    @classmethod
    def principal_moments(cls, value: Triple | None) -> Triple | None:
        if value and (min(value) <= 0 or 2 * max(value) > sum(value)):
            raise ValueError(f"{value} is no rigid body's: each positive, none above the sum of the others")
        return value


class Hold(Part):
    """Keep the attitude for a while."""

    kind: Literal["hold"]
    duration_s: Annotated[Time, Field(gt=0)]


class Slew(Part):
    """Rest-to-rest eigen-axis turn to a 3-2-1 attitude, no faster than rate_deg_s."""

    kind: Literal["slew"]
    roll_deg: Number = 0.0
    pitch_deg: Number = 0.0
    yaw_deg: Number = 0.0
    rate_deg_s: Annotated[Number, Field(gt=0)] = 2.0
    acceleration_deg_s2: Annotated[Number, Field(gt=0)] = 0.5


class Attitude(Part):
    """3-2-1 Euler angles of the body in the lab."""

    roll_deg: Number = 0.0
    pitch_deg: Number = 0.0
    yaw_deg: Number = 0.0


class Pointing(Part):
    """Where the camera looks in the ICRS: its boresight, and the position angle of the image's up direction."""

    ra_deg: Annotated[Number, Field(ge=0, lt=360)]
    dec_deg: Annotated[Number, Field(ge=-90, le=90)]
    roll_deg: Number = 0.0


def where_it_starts(value: Any) -> str:
    """Which of the two starts is meant, so that a slip in one is not answered with the other's keys."""
    keys = value if isinstance(value, dict) else ()
    sky = isinstance(value, Pointing) or any(key in keys for key in ("ra_deg", "dec_deg"))
    return "Pointing" if sky else "Attitude"


Start = Annotated[
    Annotated[Attitude, Tag("Attitude")] | Annotated[Pointing, Tag("Pointing")],
    Discriminator(where_it_starts),
]


class JitterLine(Part):
    """A vibration of one frequency: rms_arcsec about each of the body's axes, phases at random."""

    kind: Literal["line"]
    frequency_hz: Positive
    rms_arcsec: tuple[NotNegative, NotNegative, NotNegative]


class JitterBand(Part):
    """Random vibration between two frequencies, power spectral density proportional to f^slope."""

    kind: Literal["band"]
    from_hz: Positive
    to_hz: Positive
    rms_arcsec: tuple[NotNegative, NotNegative, NotNegative]
    slope: Annotated[Number, Field(ge=-6, le=6)] = 0.0

    @model_validator(mode="after")
    def a_band(self) -> JitterBand:
        if self.from_hz >= self.to_hz:
            raise ValueError(f"from_hz {self.from_hz:g} is not below to_hz {self.to_hz:g}")
        return self


Jitter = Annotated[JitterLine | JitterBand, Field(discriminator="kind")]


class Motion(Part):
    """How it starts and what it is told to do."""

    start: Start = Attitude()
    rate_deg_s: tuple[Spin, Spin, Spin] = (0.0, 0.0, 0.0)
    control: Literal["none", "pid"] = "none"
    manoeuvre: tuple[Annotated[Hold | Slew, Field(discriminator="kind")], ...] = ()
    jitter: tuple[Jitter, ...] = ()

    @model_validator(mode="after")
    def somebody_flies_it(self) -> Motion:
        if self.manoeuvre and self.control == "none":
            raise ValueError("a manoeuvre needs a controller; allowed: control: pid")
        return self


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
        return self


class Tracker(Part):
    """What the star tracker's computer does and believes. `null` believes what the hardware is."""

    detector: str = "local"
    centroider: str = "cog"
    identifier: str = "pyramid"
    solver: str = "quest"
    threshold_sigma: Annotated[Number, Field(gt=0)] = 5.0
    min_area_px: Annotated[int, Field(ge=1)] = 3
    limit_mag: Number = 6.0
    centroid_sigma_px: Annotated[Number, Field(gt=0)] = 0.2
    believed_focal_length_m: Annotated[Length, Field(gt=0)] | None = None
    believed_camera_body_m: tuple[Length, Length, Length] | None = None


class Scene(Part):
    """The whole story, before it happens."""

    schema_version: Annotated[Literal[1], Field(alias="schema")]
    title: str
    seed: Annotated[int, Field(ge=0)]
    start_time: Annotated[datetime.datetime, AfterValidator(in_our_time)]
    vehicle: Vehicle
    motion: Motion
    light: Annotated[Dome | Stars, Field(discriminator="kind")]
    background: tuple[Glow, ...] = ()
    camera: Camera
    exposure: Exposure
    tracker: Tracker = Tracker()
    name: Annotated[str, Field(exclude=True, alias=STEM)] = ""

    @model_validator(mode="after")
    def one_world(self) -> Scene:
        sky = self.light.kind == "stars"
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


class CameraFile(Part):
    """A file that describes a camera and nothing else."""

    camera: Camera


def find(name: str) -> Path:
    """The path of a scene given by path or by its name in scenes/."""
    path = Path(name)
    if path.suffix in {".yaml", ".yml"} and path.is_file():
        return path
    shipped = SCENES / f"{name}.yaml"
    if not path.suffix and shipped.is_file():
        return shipped
    known = sorted(p.stem for p in SCENES.glob("*.yaml"))
    raise BadInput(f"{name}: no such scene; allowed: a .yaml file or one of {', '.join(known)}")


def load(name: str | Path, overrides: Mapping[str, str] | None = None) -> Scene:
    """Read, override (`path.to.key` -> YAML value) and validate a scene.

    Raises BadInput with one line: the key, what is wrong with it, what is allowed, the file and line.
    """
    path = find(str(name))
    tree, text = read_yaml(path)
    for key, value in (overrides or {}).items():
        put(tree, key, value)
    try:
        raw = beneath(beside(path, tree), text, path, overrides or {})
        return Scene.model_validate(raw | {STEM: path.stem})
    except ValidationError as error:
        raise BadInput(explain(error, Scene, tree, text, path, overrides or {})) from None


def beneath(tree: dict[str, Any], text: str, path: Path, overrides: Mapping[str, str]) -> dict[str, Any]:
    """`with_preset`, which knows neither file nor line."""
    try:
        return with_preset(tree)
    except BadInput as error:
        raise BadInput(f"{error} {place_of(['camera', 'preset'], text, path, overrides)}") from None


def beside(path: Path, tree: dict[str, Any]) -> dict[str, Any]:
    """The scene with the files that it names taken from its own folder, where there are any of that name."""
    for keys in (("vehicle", "model"), ("camera", "psf", "file")):
        tree = anchored(path.resolve().parent, tree, *keys)
    return tree


def anchored(folder: Path, tree: dict[str, Any], key: str, *inner: str) -> dict[str, Any]:
    """A mapping in which the file named under these keys, if it is in the folder, has its whole path."""
    value = tree.get(key)
    if inner and isinstance(value, dict):
        return tree | {key: anchored(folder, value, *inner)}
    if not inner and isinstance(value, str) and (folder / value).is_file():
        return tree | {key: str(folder / value)}
    return tree


def load_camera(path: Path) -> Camera:
    """The `camera` section of a scene, or of a file that has nothing else. Raises BadInput with one line."""
    tree, text = read_yaml(path)
    try:
        own = beside(path, {key: tree[key] for key in tree if key == "camera"})
        return CameraFile.model_validate(beneath(own, text, path, {})).camera
    except ValidationError as error:
        raise BadInput(explain(error, CameraFile, tree, text, path, {})) from None
