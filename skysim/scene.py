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
from skysim.quantity import (
    DATA,
    ROOT,
    Ascending,
    Inertia,
    Intensity,
    Length,
    Mass,
    NotNegative,
    Number,
    Part,
    Positive,
    SemiAxis,
    Share,
    Spin,
    Time,
    Torque,
    Triple,
    a_table,
    one_of,
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


class CosineLobe(Part):
    """Radiant intensity as cos^exponent of the angle from the normal; 1 is Lambert's law."""

    kind: Literal["cosine"] = "cosine"
    exponent: NotNegative = 1.0


class LobeTable(Part):
    """Relative intensity against angle as it was measured, 1 on the axis, nothing beyond the last angle."""

    kind: Literal["table"]
    angle_deg: Ascending
    intensity: Annotated[tuple[NotNegative, ...], Field(min_length=2)]

    @model_validator(mode="after")
    def a_table(self) -> LobeTable:
        a_table(self.angle_deg, self.intensity, "intensity")
        return self


Lobe = Annotated[CosineLobe | LobeTable, Field(discriminator="kind")]


class Led(Part):
    """One kind of LED, for the whole dome."""

    intensity_cd: Annotated[Intensity, Field(gt=0)]
    disc_diameter_m: Annotated[Length, Field(gt=0)]
    falloff: str = "inverse_square"
    lobe: Lobe = CosineLobe()
    spectrum: Literal["white"] | Annotated[Length, Field(ge=300e-9, le=1100e-9)] = "white"
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


class UniformGlow(Part):
    """The same everywhere: e_s electrons a second in every pixel (a light leak, a lit room)."""

    kind: Literal["uniform"]
    e_s: NotNegative


class SkyGlow(Part):
    """The night sky's surface brightness at the boresight, with a relative slope along the image's axes."""

    kind: Literal["sky"]
    mag_arcsec2: Annotated[Number, Field(ge=0, le=30)]
    gradient_per_deg: tuple[Number, Number] = (0.0, 0.0)


class MoonGlow(Part):
    """Moonlight scattered by the air (Krisciunas & Schaefer 1991), the Moon at ra_deg, dec_deg.

    phase_angle_deg : 0 at full moon, 90 at the quarters
    extinction_mag  : of the air at the zenith, in V
    moon_zenith_deg, field_zenith_deg : zenith distances of the Moon and of the boresight
    """

    kind: Literal["moon"]
    ra_deg: Annotated[Number, Field(ge=0, lt=360)]
    dec_deg: Annotated[Number, Field(ge=-90, le=90)]
    phase_angle_deg: Annotated[Number, Field(ge=0, le=180)]
    extinction_mag: Annotated[Number, Field(ge=0, le=2)] = 0.172
    moon_zenith_deg: Annotated[Number, Field(ge=0, lt=90)]
    field_zenith_deg: Annotated[Number, Field(ge=0, lt=90)]


class StrayLight(Part):
    """A bright body outside of the field through baffle and lens, by their point source transmittance.

    ra_deg, dec_deg : where it stands, in the lab's axes (under the stars those of the ICRS)
    v_mag           : how bright it is; the Sun's -26.74 if left out
    angle_deg, pst  : irradiance on the chip over irradiance before the lens, against the angle from the boresight
    """

    kind: Literal["stray"]
    ra_deg: Annotated[Number, Field(ge=0, lt=360)]
    dec_deg: Annotated[Number, Field(ge=-90, le=90)]
    v_mag: Number = -26.74
    angle_deg: Ascending
    pst: Annotated[tuple[Share, ...], Field(min_length=2)]

    @model_validator(mode="after")
    def a_table(self) -> StrayLight:
        a_table(self.angle_deg, self.pst, "pst")
        return self


Glow = Annotated[UniformGlow | SkyGlow | MoonGlow | StrayLight, Field(discriminator="kind")]


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
