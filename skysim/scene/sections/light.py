"""Schema of the scene sections `light` and `lights`.

The light is a dome with its LEDs, stars, or a star simulator. The section `lights` has further
lights, of kinds that modules or installed packages add. Such a kind is a class derived from `LightConfig` with a
literal `kind`, which `simulation.lights.registry.register` adds with its function. A package offers it by an entry
point of the group `skysim.lights` with the name of the kind, which names the module that registers it.
"""

import math
from pathlib import Path
from typing import Annotated, Any, Literal

from pydantic import (
    AfterValidator,
    ConfigDict,
    Field,
    ModelWrapValidatorHandler,
    SerializeAsAny,
    model_validator,
)

from skysim.core.errors import InputError, unknown_name
from skysim.core.plugins import PluginKind
from skysim.core.units import (
    BY_KIND,
    ZEROS,
    ConfigModel,
    Declination,
    Distance,
    Fraction,
    Length,
    LengthError,
    Magnitude,
    Number,
    Position,
    Positive,
    PositiveLength,
    RightAscension,
    Seed,
    Spin,
    Three,
    ZeroOrMore,
    above,
    within,
)
from skysim.scene.sections.layouts import (
    Cap,
    Layout,
    LensDisplayConfig,
    LimitMagnitude,
    OnPoints,
    PatchBoardsConfig,
    Points,
)
from skysim.scene.sections.leds import LedConfig
from skysim.scene.sections.surroundings import AirConfig, SatellitesConfig

SKY = "gaia_v8.0"  # its faintest stars are as faint as any camera of a shipped scene detects
Tilt = Annotated[Number, within(-45, 45)]


class SurfaceConfig(ConfigModel):
    """The inside of the dome, in the lab frame (meters, bearing center at the origin): keys common to all kinds.

    Sizes, apex and rim are those of the dome before its displacement, with its axis upright through the bearing's
    center.

    Attributes
    ----------
    offset
        Displacement of the whole dome
    tilt_deg
        Rotation about the lab's x, then about its y, through the surface's own center (the origin of surveyed points)
    error
        Standard deviation of its survey along the normal, or a tolerance. There is one draw for the whole surface, by
        `tracker.survey.seed`, because errors of single points average out
    """

    kind: Literal["sphere", "ellipsoid", "flat", "cylinder", "surveyed"]
    offset_m: Position = ZEROS
    tilt_deg: tuple[Tilt, Tilt] = (0.0, 0.0)
    error_m: LengthError = 0.0

    def check(self) -> None:
        rim_m = getattr(self, "rim_height_m", None)
        if rim_m is not None and rim_m >= getattr(self, "apex_m", math.inf):
            raise InputError(
                "rim_height", f"{rim_m:g} m is not below the apex", "less than apex"
            )


class RimmedConfig(SurfaceConfig):
    """A surface with a rim at a height above the bearing, or at an angle from its axis seen from the bearing."""

    rim_height_m: Length | None = None
    rim_deg: Annotated[Number, Field(gt=0, lt=180)] | None = None

    def check(self) -> None:
        if self.rim_height_m is not None and self.rim_deg is not None:
            raise InputError("", "rim_height and rim_deg conflict", "one of the two")


class WallConfig(ConfigModel):
    """A formed sheet, thinnest at the apex: its thickness is linear in the angle about the sphere's center.

    Attributes
    ----------
    base_deg
        Angle of thickness_base, beyond which the thickness is constant
    radius_of
        Face that is a sphere: the outside, or the middle of the wall
    density_kg_m3
        Density, from which `skysim check` computes the mass; 1190 for acrylic
    """

    thickness_apex_m: PositiveLength
    thickness_base_m: PositiveLength
    base_deg: Cap
    radius_of: Literal["outside", "mid_wall"] = "outside"
    density_kg_m3: Positive | None = None


class SphereSurfaceConfig(RimmedConfig):
    """A sphere; with a wall, the inner face of a formed shell whose outside or middle is a sphere."""

    kind: Literal["sphere"]
    apex_m: PositiveLength
    radius_m: PositiveLength
    wall: WallConfig | None = None

    def check(self) -> None:
        thickest = (
            max(self.wall.thickness_apex_m, self.wall.thickness_base_m) if self.wall else 0.0
        )
        if thickest > 0.1 * self.radius_m:
            raise InputError(
                "", f"a wall of {thickest:g} m is too thick", "up to a tenth of the radius"
            )


class EllipsoidSurfaceConfig(RimmedConfig):
    """An ellipsoid: oblate, prolate or triaxial."""

    kind: Literal["ellipsoid"]
    apex_m: PositiveLength
    semi_axes_m: Three[PositiveLength]


class FlatSurfaceConfig(SurfaceConfig):
    """A level panel, with a width along x and a height along y, or infinite."""

    kind: Literal["flat"]
    apex_m: PositiveLength
    width_m: PositiveLength | None = None
    height_m: PositiveLength | None = None


class CylinderSurfaceConfig(SurfaceConfig):
    """A vault along the lab's x or y, or a drum about z, with its highest point at apex; length is its whole length."""

    kind: Literal["cylinder"]
    axis: Literal["x", "y", "z"]
    apex_m: PositiveLength
    radius_m: PositiveLength
    length_m: PositiveLength | None = None
    rim_height_m: Length | None = None

    def check(self) -> None:
        if self.axis == "z" and self.length_m is None:
            raise InputError("", "a cylinder about z requires length, from apex down")


class SurveyedSurfaceConfig(RimmedConfig):
    """A smooth surface fitted to points of a measuring arm on the inside: Zernike polynomials to a degree.

    Attributes
    ----------
    file
        File of comments (#), a line of names, then lines of x, y, z in `unit`, z up
    degree
        Degree of the polynomials
    rms_limit
        Greatest rms distance of the points from the smooth surface
    """

    kind: Literal["surveyed"]
    file: str
    unit: Literal["m", "cm", "mm", "in"]
    degree: Annotated[int, within(0, 12)] = 6
    rms_limit_m: PositiveLength = 1e-3

    def check(self) -> None:
        if not self.file.endswith(".csv") or not Path(self.file).is_file():
            raise InputError("file", f"{self.file!r} is not a file", "a .csv file of x, y, z")


AnySurface = Annotated[
    SphereSurfaceConfig
    | EllipsoidSurfaceConfig
    | FlatSurfaceConfig
    | CylinderSurfaceConfig
    | SurveyedSurfaceConfig,
    BY_KIND,
]


class RoomConfig(ConfigModel):
    """The room for the dome; a dome that does not fit is refused. Limits that are left out are not checked.

    The shell is the surface within its rim or its width and height, else up to the layout's cap_deg, with `thickness`
    outside of it.

    Attributes
    ----------
    height
        Height of the ceiling above the floor; the top of the shell must be below it
    bearing_height
        Height of the bearing's center above the floor; the shell must end above the floor
    width, length
        Size of the floor along the lab's x and y; the shell must fit between the walls
    door
        Width and height of the narrowest opening on the way in. Every part of the shell must pass: two sides of the
        smallest box around it must fit
    segments
        Number of equal parts, cut along planes through the vertical, in which the shell is carried in
    thickness
        Thickness of the shell with its ribs
    """

    height_m: PositiveLength | None = None
    bearing_height_m: ZeroOrMore[Length] | None = None
    width_m: PositiveLength | None = None
    length_m: PositiveLength | None = None
    door_m: tuple[PositiveLength, PositiveLength] | None = None
    segments: Annotated[int, within(1, 100)] = 1
    thickness_m: ZeroOrMore[Length] = 0.0

    def check(self) -> None:
        if self.height_m is not None and self.bearing_height_m is None:
            raise InputError(
                "", "height requires bearing_height, the bearing's center above the floor"
            )
        if self.segments > 1 and self.door_m is None:
            raise InputError(
                "segments", "have no effect without a door", "door, or no segments"
            )


class FloorConfig(ConfigModel):
    """A level disc below the bearing's center that scatters light by Lambert's law: floor, table and vehicle.

    Attributes
    ----------
    share
        Fraction of the light that it scatters
    depth
        Depth below the bearing's center
    radius
        Radius, at most that of the rim, so that the wall is not between it and the LEDs
    """

    share: Annotated[Fraction, Field(gt=0, lt=1)]
    depth_m: PositiveLength
    radius_m: PositiveLength


class ReflectionConfig(ConfigModel):
    """Light that the dome's inside and the floor reflect.

    Attributes
    ----------
    diffuse
        Fraction of the light on the wall that it scatters by Lambert's law, which makes a glow
    specular
        Fraction that it mirrors at any angle, which makes images of the LEDs
    refractive_index
        Refractive index of a polished wall, which mirrors by Fresnel's equations for unpolarized light, instead of
        specular; 1.49 for acrylic
    floor
        Floor that scatters light; black if left out
    """

    diffuse: Annotated[Fraction, Field(lt=1)] = 0.0
    specular: Annotated[Fraction, Field(lt=1)] = 0.0
    refractive_index: Annotated[Number, above(1, 4)] | None = None
    floor: FloorConfig | None = None

    def check(self) -> None:
        if self.specular and self.refractive_index is not None:
            raise InputError("", "specular and refractive_index conflict", "one of the two")
        if self.diffuse + self.specular >= 1:
            raise InputError(
                "",
                f"diffuse {self.diffuse:g} and specular {self.specular:g} leave no loss",
                "below 1",
            )
        if not (self.diffuse or self.mirrors or self.floor):
            raise InputError(
                "",
                "nothing reflects",
                "diffuse, specular, refractive_index or floor, or no reflection",
            )

    @property
    def mirrors(self) -> bool:
        """Whether the wall makes images of the LEDs."""
        return self.specular > 0 or self.refractive_index is not None


class DomeConfig(ConfigModel):
    """An LED dome as the light source.

    Attributes
    ----------
    occlusion
        Whether parts of the vehicle and the wall of the dome hide LEDs
    reflection
        Reflection of wall and floor; black if left out
    room
        Limits of the room for the dome; unlimited if left out
    """

    kind: Literal["dome"]
    surface: AnySurface
    layout: Layout
    led: LedConfig
    occlusion: bool = True
    reflection: ReflectionConfig | None = None
    room: RoomConfig | None = None

    @property
    def points(self) -> PatchBoardsConfig | Points:
        """The layout of single LEDs or boards: of fibers and displays, that of the points that they show."""
        return self.layout.points if isinstance(self.layout, OnPoints) else self.layout

    def check(self) -> None:
        """Check that the layout fits the LEDs' controller, types and drive, and the surface."""
        layout = self.layout
        kind = layout.kind
        controller = getattr(self.led.drive, "controller", None)
        if controller == "board" and kind != "patch_boards":
            raise InputError(
                "led.drive.controller", f"{kind} has no boards", "dome, or a number of LEDs"
            )
        used = {
            name
            for part in (layout, *getattr(layout, "boards", ()))
            for name in getattr(part, "types", None) or ()
        }
        for name in sorted(used - {*self.led.types}):
            raise InputError("layout.types", *unknown_name("LED type", name, self.led.types))
        if set(self.led.types) - used or getattr(
            getattr(layout, "points", None), "types", None
        ):
            raise InputError(
                "led.types", "not all are used", "names in a list's or board's types"
            )
        drive = self.led.drive.kind
        display = kind in ("lcd", "projector")
        if kind == "lcd" and self.surface.kind != "flat":
            raise InputError(
                "layout", f"lcd does not fit a surface of kind {self.surface.kind}", "flat"
            )
        if display and drive not in ("direct", "refresh"):
            article = "an" if kind == "lcd" else "a"
            raise InputError(
                "led.drive", f"{drive} cannot drive {article} {kind}", "direct, refresh"
            )
        if not display and drive == "refresh":
            raise InputError(
                "led.drive",
                f"refresh requires a layout of kind lcd or projector, not {kind}",
            )


class BodiesConfig(ConfigModel):
    """Bodies of the solar system at the scene's time, from `site` if it has a longitude, else from the Earth's center.

    Attributes
    ----------
    planets
        Whether to show Mercury, Venus, Mars, Jupiter, Saturn, Uranus and Neptune
    minor
        Whether to show Jupiter's four large moons, Ceres and Vesta; without planets Jupiter does not hide its moons
    """

    sun: bool = True
    moon: bool = True
    planets: bool = True
    minor: bool = False

    def check(self) -> None:
        if not (self.sun or self.moon or self.planets or self.minor):
            raise InputError(
                "", "no body is left", "sun, moon, planets or minor, or no bodies"
            )


class StarsConfig(ConfigModel):
    """The real sky as the light source.

    Attributes
    ----------
    catalog
        Name in data/catalogs, or a file of `skysim catalog build`; the tracker has its own catalog
    limit_mag
        Faintest V magnitude; all stars of the catalog if left out
    variability_seed
        Seed of the magnitudes of variable stars at the scene's time, with the scatter that Hipparcos measured; mean
        magnitudes if left out
    bodies
        Sun, Moon and planets; none if left out
    satellites
        Artificial satellites; none if left out
    air
        Atmosphere over `site`, which needs a longitude; none if left out
    occlusion
        Whether parts of the vehicle hide stars
    """

    kind: Literal["stars"]
    catalog: str = SKY
    limit_mag: Annotated[Number, within(0, 15)] | None = None
    variability_seed: Seed | None = None
    bodies: BodiesConfig | None = None
    satellites: SatellitesConfig | None = None
    air: AirConfig | None = None
    occlusion: bool = True


class CollimatedDisplayConfig(LensDisplayConfig):
    """A star simulator: a micro-display in the focus of a collimator, above the level camera.

    Its axis is the lab's zenith; the columns of the display are along the lab's x and its rows along y. The exit pupil
    covers the lens at every attitude. Color of the collimator, its other image errors and the refresh of the display
    are neglected.

    Attributes
    ----------
    catalog, limit_mag
        Catalog of the stars that are shown at the scene's start_time, and their faintest V (all if left out)
    axis_ra_deg, axis_dec_deg, roll_deg
        Direction at the center of the display, and position angle there of the lab's -y (up for a level camera), like
        `ra_deg`, `dec_deg`, `roll_deg` of a camera that looks up
    brightest_mag
        V magnitude of a white block for the camera, in the Sun's color; brighter stars are limited to it
    conjugate
        Distance of the stars from the bearing's center, by an error of collimation; infinite if left out
    """

    kind: Literal["collimated_display"]
    catalog: str = SKY
    limit_mag: LimitMagnitude | None = None
    axis_ra_deg: RightAscension
    axis_dec_deg: Declination
    roll_deg: Spin = 0.0
    brightest_mag: Magnitude
    conjugate_m: Annotated[Distance, Field(ge=10)] | None = None


Light = DomeConfig | StarsConfig | CollimatedDisplayConfig


# The scene section `lights`: further lights.

PLUGINS = PluginKind("light", "skysim.lights", "lights.kind", ())
CONFIGS: dict[str, type["LightConfig"]] = {}  # schemas of the kinds that were added


def check_kind(kind: str) -> str:
    """The name of a kind of light. Raises InputError, with the known kinds, for an unknown one."""
    if kind not in CONFIGS:
        raise InputError(
            "", *unknown_name("light", kind, sorted({*CONFIGS, *PLUGINS.entry_points()}))
        )
    return kind


class LightConfig(ConfigModel):
    """A further light. Each kind has a class derived from this one."""

    model_config = ConfigDict(json_schema_extra={"additionalProperties": True})

    kind: Annotated[str, AfterValidator(check_kind)]

    @model_validator(mode="wrap")
    @classmethod
    def validate_by_kind(
        cls, value: Any, handler: ModelWrapValidatorHandler["LightConfig"]
    ) -> "LightConfig":
        """Validate a section with the class of its `kind` when called on the base class."""
        # As text, because a kind that is a mapping is no key.
        is_any = cls is LightConfig and isinstance(value, dict) and "kind" in value
        kind = str(value["kind"]) if is_any else ""
        if kind not in CONFIGS and kind in PLUGINS.entry_points():
            PLUGINS.entry_points()[kind].load()  # the module registers the kind
        if kind in CONFIGS:
            return CONFIGS[kind].model_validate(value)
        # The other keys of an unknown light are unknown too.
        return handler({"kind": value["kind"]} if is_any else value)


FurtherLight = SerializeAsAny[LightConfig]
