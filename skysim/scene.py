"""A scene file (YAML) becomes a validated, frozen `Scene`. This module is the only schema.

Two rules name every key. A key whose value carries its own unit has none in its name (`focal_length: "35 mm"`);
a key whose value is a bare number ends in its unit (`tilt_stop_deg: 30`). In Python the former gains the SI
suffix (`camera.focal_length_m`), so that a unit is always in sight.
"""

from __future__ import annotations

import datetime
import math
import re
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Annotated, Any, Literal

from pydantic import (
    AfterValidator,
    BaseModel,
    BeforeValidator,
    ConfigDict,
    Discriminator,
    Field,
    Tag,
    ValidationError,
    field_validator,
    model_validator,
)

from skysim.types import BadInput
from skysim.yamlfile import explain, put, read_yaml

ROOT = Path(__file__).resolve().parents[1]
SCENES = ROOT / "scenes"
STEM = "(the file's name)"  # no key that a file could have
CATALOGUES = ROOT / "data" / "catalogues"

# Only what a quantity parser fills: `dark_e_s` and `rate_deg_s` are bare numbers and keep their unit.
SI_SUFFIX = re.compile(r"(?<!_deg)(?<!_e)_(m|s|kg|kg_m2|cd|nm)$")


def quantity(si_unit: str, what: str, examples: str) -> Callable[[Any], float]:
    """A validator that turns a quantity such as "48 in" into a float in `si_unit`."""

    def parse(value: Any) -> float:
        from astropy import units

        if not isinstance(value, str):
            raise ValueError(f"{value!r} has no unit; allowed: a {what} such as {examples}")
        try:
            # astropy spells it `inch`; the lab writes `in`.
            inch = units.def_unit("in", units.imperial.inch)
            with units.add_enabled_units([inch, units.imperial]):
                number = units.Quantity(value).to_value(si_unit)
        except (units.UnitsError, TypeError, ValueError) as error:
            raise ValueError(f"{value!r} is not a {what}; allowed: a {what} such as {examples}") from error
        return float(number)

    return parse


def finite(value: float) -> float:
    if not math.isfinite(value):
        raise ValueError(f"{value} is not a finite number")
    return value


Number = Annotated[float, AfterValidator(finite)]
Length = Annotated[Number, BeforeValidator(quantity("m", "length", '"35 mm" or "48 in"'))]
Time = Annotated[Number, BeforeValidator(quantity("s", "time", '"40 ms" or "1000 us"'))]
Mass = Annotated[Number, BeforeValidator(quantity("kg", "mass", '"80 kg"'))]
Inertia = Annotated[Number, BeforeValidator(quantity("kg m2", "moment of inertia", '"6.0 kg m2"'))]
Intensity = Annotated[Number, BeforeValidator(quantity("cd", "luminous intensity", '"7.7 mcd"'))]
Torque = Annotated[Number, BeforeValidator(quantity("N m", "torque", '"0.5 N m"'))]
SemiAxis = Annotated[Length, Field(gt=0)]
Spin = Annotated[Number, Field(ge=-360, le=360)]
Triple = tuple[Number, Number, Number]


class Part(BaseModel):
    """Base of every section: frozen, no unknown keys, units out of the YAML names."""

    model_config = ConfigDict(
        extra="forbid",
        frozen=True,
        validate_by_alias=True,
        validate_by_name=False,
        alias_generator=lambda name: SI_SUFFIX.sub("", name),
    )


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


class Motion(Part):
    """How it starts and what it is told to do."""

    start: Start = Attitude()
    rate_deg_s: tuple[Spin, Spin, Spin] = (0.0, 0.0, 0.0)
    control: Literal["none", "pid"] = "none"
    manoeuvre: tuple[Annotated[Hold | Slew, Field(discriminator="kind")], ...] = ()

    @model_validator(mode="after")
    def somebody_flies_it(self) -> Motion:
        if self.manoeuvre and self.control == "none":
            raise ValueError("a manoeuvre needs a controller; allowed: control: pid")
        return self


class Surface(Part):
    """The inside of the dome, in the lab frame (metres, bearing centre at the origin)."""

    kind: Literal["sphere", "ellipsoid", "flat"]
    apex_m: Annotated[Length, Field(gt=0)]
    radius_m: Annotated[Length, Field(gt=0)] | None = None
    semi_axes_m: tuple[SemiAxis, SemiAxis, SemiAxis] | None = None
    offset_m: tuple[Length, Length, Length] = (0.0, 0.0, 0.0)

    @model_validator(mode="after")
    def its_own_sizes(self) -> Surface:
        needs = {"sphere": {"radius"}, "ellipsoid": {"semi_axes"}, "flat": set()}[self.kind]
        has = {name for name in ("radius", "semi_axes") if getattr(self, f"{name}_m") is not None}
        if needs != has:
            wanted = ", ".join(sorted(needs)) or "neither radius nor semi_axes"
            raise ValueError(f"a {self.kind} takes {wanted}")
        return self


class PatchBoards(Part):
    """3x3 LED boards spread evenly over a cap of the surface, each with a pattern of its own."""

    kind: Literal["patch_boards"]
    cap_deg: Annotated[Number, Field(gt=0, le=90)]
    spacing_m: Annotated[Length, Field(gt=0)]
    pitch_m: Annotated[Length, Field(gt=0)]
    lit: tuple[int, int] = (4, 6)
    pwm_levels: Annotated[tuple[Annotated[Number, Field(gt=0, le=1)], ...], Field(min_length=1)] = (1.0,)
    hardware_seed: Annotated[int, Field(ge=0)] = 0

    @field_validator("lit")
    @classmethod
    def within_board(cls, value: tuple[int, int]) -> tuple[int, int]:
        if not 1 <= value[0] <= value[1] <= 9:
            raise ValueError(f"{value} is no range of LEDs on a 3x3 board; allowed: 1 <= least <= most <= 9")
        return value

    @model_validator(mode="after")
    def boards_fit_beside_each_other(self) -> PatchBoards:
        if self.spacing_m < 3 * self.pitch_m:
            raise ValueError(
                f"spacing {self.spacing_m:g} m: boards of three LEDs at {self.pitch_m:g} m would overlap"
            )
        return self


class Led(Part):
    """One kind of LED, for the whole dome."""

    intensity_cd: Annotated[Intensity, Field(gt=0)]
    disc_diameter_m: Annotated[Length, Field(gt=0)]
    falloff: str = "inverse_square"
    lobe_exponent: Annotated[Number, Field(ge=0)] = 1.0
    scatter: Annotated[Number, Field(ge=0, lt=0.5)] = 0.0
    pwm_period_s: Annotated[Time, Field(gt=0)] = 1e-3

    @field_validator("falloff")
    @classmethod
    def known_falloff(cls, value: str) -> str:
        from skysim.led import FALLOFF

        return one_of(value, FALLOFF)


class Dome(Part):
    """An LED dome as the light."""

    kind: Literal["dome"]
    surface: Surface
    layout: PatchBoards
    led: Led


class Stars(Part):
    """The real sky as the light."""

    kind: Literal["stars"]
    catalogue: str = "hipparcos_hp6.5"
    limit_mag: Annotated[Number, Field(ge=0, le=15)] = 6.5


class Psf(Part):
    """The lens's point-spread function: a Gaussian, or the disc of a lens out of focus with a Gaussian edge."""

    kind: str = "gaussian"
    sigma_px: Annotated[Number, Field(ge=0.2, le=20)] = 0.7
    radius_px: Annotated[Number, Field(ge=0, le=200)] = 0.0

    @field_validator("kind")
    @classmethod
    def known_psf(cls, value: str) -> str:
        from skysim.optics import PSFS

        return one_of(value, PSFS)

    @model_validator(mode="after")
    def a_disc_has_a_radius(self) -> Psf:
        if (self.kind == "disc") != (self.radius_px > 0):
            raise ValueError(
                f"radius_px {self.radius_px:g} with kind {self.kind}; allowed: above 0 with disc only"
            )
        return self


class Detector(Part):
    """The chip and its electronics. A step is switched off by its parameter."""

    quantum_efficiency: Annotated[Number, Field(gt=0, le=1)]
    dark_e_s: Annotated[Number, Field(ge=0)] = 0.0
    sky_e_s: Annotated[Number, Field(ge=0)] = 0.0
    read_noise_e: Annotated[Number, Field(ge=0)] = 0.0
    full_well_e: Annotated[Number, Field(gt=0)]
    gain_e_dn: Annotated[Number, Field(gt=0)]
    offset_dn: Annotated[Number, Field(ge=0)] = 0.0
    bits: Annotated[int, Field(ge=1, le=16)]
    noise: bool = True

    @model_validator(mode="after")
    def offset_within_the_converter(self) -> Detector:
        if self.offset_dn >= 2**self.bits:
            raise ValueError(f"offset_dn {self.offset_dn:g} is beyond a converter of {self.bits} bits")
        return self


class Camera(Part):
    """Lens and chip as they are. What the tracker believes of them stands in `tracker`."""

    width_px: Annotated[int, Field(ge=16, le=20000)]
    height_px: Annotated[int, Field(ge=16, le=20000)]
    pixel_m: Annotated[Length, Field(gt=0)]
    focal_length_m: Annotated[Length, Field(gt=0)]
    f_number: Annotated[Number, Field(gt=0)]
    transmission: Annotated[Number, Field(gt=0, le=1)] = 1.0
    distortion: tuple[Number, Number, Number, Number, Number] = (0.0, 0.0, 0.0, 0.0, 0.0)
    principal_point_px: tuple[Number, Number] | None = None
    psf: Psf = Psf()
    detector: Detector

    @property
    def focal_px(self) -> float:
        return self.focal_length_m / self.pixel_m

    @property
    def centre_px(self) -> tuple[float, float]:
        """The principal point: as given, or the chip's middle."""
        return self.principal_point_px or ((self.width_px - 1) / 2, (self.height_px - 1) / 2)


class Exposure(Part):
    """When the shutter opens."""

    time_s: Annotated[Time, Field(gt=0)]
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
        return self


class CameraFile(Part):
    """A file that describes a camera and nothing else."""

    camera: Camera


def one_of(value: str, allowed: Mapping[str, Any]) -> str:
    """The value, if it is a key of `allowed`."""
    if value not in allowed:
        raise ValueError(f"{value!r} is none of {', '.join(allowed)}")
    return value


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
        return Scene.model_validate(beside(path, tree) | {STEM: path.stem})
    except ValidationError as error:
        raise BadInput(explain(error, Scene, tree, text, path, overrides or {})) from None


def beside(path: Path, tree: dict[str, Any]) -> dict[str, Any]:
    """The scene with its vehicle's MJCF taken from the scene's own folder, where there is one of that name."""
    vehicle = tree.get("vehicle")
    if not isinstance(vehicle, dict) or not isinstance(vehicle.get("model"), str):
        return tree
    own = path.resolve().parent / vehicle["model"]
    return tree | {"vehicle": vehicle | {"model": str(own)}} if own.is_file() else tree


def load_camera(path: Path) -> Camera:
    """The `camera` section of a scene, or of a file that has nothing else. Raises BadInput with one line."""
    tree, text = read_yaml(path)
    try:
        return CameraFile.model_validate({key: tree[key] for key in tree if key == "camera"}).camera
    except ValidationError as error:
        raise BadInput(explain(error, CameraFile, tree, text, path, {})) from None
