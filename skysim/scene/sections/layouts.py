"""Schema of the layouts of a dome's LEDs: positions and brightness."""

import math
from collections.abc import Sequence
from typing import Annotated, Literal

from pydantic import Field

from skysim.core.errors import InputError
from skysim.core.time import J2000, Moment
from skysim.core.units import (
    BY_KIND,
    AxisAngle,
    ConfigModel,
    Declination,
    Fractions,
    Length,
    LengthError,
    Magnitude,
    NotEmpty,
    Number,
    NumberError,
    Position,
    Positive,
    PositiveFraction,
    PositiveInt,
    PositiveLength,
    RightAscension,
    Seed,
    Spin,
    above,
    within,
)

HOLES = 9  # holes of a patch board, 3x3
Level = PositiveFraction
Levels = NotEmpty[Level]
Magnitudes = NotEmpty[Magnitude]
TypeNames = NotEmpty[str]
Pixels = Annotated[int, within(1, 20_000)]
Cap = Annotated[Number, above(0, 90)]
MAX_LEDS = 100_000
Count = Annotated[int, within(1, MAX_LEDS)]
FieldOfView = Annotated[Number, within(1, 90)]
TapeLength = Annotated[Length, Field(ge=1e-3)]
LimitMagnitude = Annotated[Number, within(-2, 15)]


def relative_levels(magnitudes: Sequence[float]) -> tuple[float, ...]:
    """Levels by Pogson's law, 10^(-0.4 m), relative to the brightest of the list, which has level 1."""
    brightest = float(min(magnitudes, default=0.0))
    return tuple(10.0 ** (-0.4 * (float(magnitude) - brightest)) for magnitude in magnitudes)


class BoardConfig(ConfigModel):
    """One patch board, glued with its center in this direction from the bearing's center.

    Attributes
    ----------
    azimuth_deg, tilt_deg
        Angles of the direction from the lab's +x toward +y, and from the zenith
    rotation_deg
        Rotation of its columns about its normal
    leds
        Holes with an LED, 0 to 8, row by row
    levels, types
        Brightness of each LED, and its type, a name in `led.types`; full brightness and `led` if left out
    """

    azimuth_deg: Spin
    tilt_deg: Annotated[Number, within(0, 90)]
    rotation_deg: Spin = 0.0
    leds: NotEmpty[Annotated[int, Field(ge=0, lt=HOLES)]]
    levels: Levels | None = None
    types: TypeNames | None = None

    def check(self) -> None:
        if len(set(self.leds)) < len(self.leds):
            raise InputError("leds", f"{list(self.leds)} has a duplicate hole")
        for name, values in (("levels", self.levels), ("types", self.types)):
            if values is not None and len(values) != len(self.leds):
                raise InputError("", f"leds has {len(self.leds)} holes, {name} {len(values)}")


class PatchBoardsConfig(ConfigModel):
    """3x3 LED boards on a cap of the surface: spread evenly or on a grid with random patterns, or listed.

    Attributes
    ----------
    cap_deg
        Greatest angle of LEDs from the zenith, seen from the bearing; the same in every layout
    spacing, lit, pwm_levels
        Distance of the boards, least and greatest number of LEDs on a board, and their levels, which are drawn;
        `boards` replaces all three
    pitch
        Distance of the holes of a board
    spread
        `spiral`: as evenly as possible, with the number of boards on a dome that has the height of the apex in all
        directions; `grid`: rows and columns along the lab's x and y, seen from above
    boards
        Boards by list
    glue_scatter
        Standard deviation of an LED's position along each axis of its board, or its tolerance
    glue_tilt_deg
        Greatest angle between the normals of a board and of the surface; normals are uniform over this cap
    """

    kind: Literal["patch_boards"]
    cap_deg: Cap
    spacing_m: PositiveLength | None = None
    pitch_m: PositiveLength
    spread: Literal["spiral", "grid"] = "spiral"
    lit: tuple[PositiveInt, PositiveInt] = (4, 6)
    pwm_levels: Levels = (1.0,)
    boards: tuple[BoardConfig, ...] = ()
    glue_scatter_m: LengthError = 0.0
    glue_tilt_deg: Annotated[Number, within(0, 30)] = 0.0
    hardware_seed: Seed = 0

    def check(self) -> None:
        if not 1 <= self.lit[0] <= self.lit[1] <= HOLES:
            raise InputError(
                "lit",
                f"{self.lit} is not a range of LEDs on a 3x3 board",
                "1 <= least <= most <= 9",
            )
        if self.spacing_m is None and not self.boards:
            raise InputError("", "patch_boards takes spacing, or boards by list")
        if self.spacing_m is not None and self.spacing_m < 3 * self.pitch_m:
            raise InputError(
                "spacing",
                f"{self.spacing_m:g} m: boards of three LEDs at {self.pitch_m:g} m would overlap",
            )


class DimmedConfig(ConfigModel):
    """Base of the layouts of single LEDs: their brightness, as fractions of full brightness or as magnitudes.

    The brightness of each LED is drawn from the list (in `listed`, the list has one value for each LED). The smallest
    magnitude is full brightness.

    Attributes
    ----------
    unique_neighbors
        Number of nearest neighbors with which the levels of each LED form a pattern that is unique under rotation;
        levels are drawn independently if left out
    """

    cap_deg: Cap
    levels: Levels | None = None
    magnitudes: Magnitudes | None = None
    unique_neighbors: Annotated[int, within(3, 16)] | None = None
    hardware_seed: Seed = 0

    @property
    def dimming(self) -> tuple[float, ...]:
        """The levels, given as levels or as magnitudes."""
        return relative_levels(self.magnitudes) if self.magnitudes else self.levels or (1.0,)

    def check(self) -> None:
        if self.levels is not None and self.magnitudes is not None:
            raise InputError("", "a layout takes either levels or magnitudes")
        if self.unique_neighbors and len(set(self.dimming)) < 2:
            raise InputError(
                "unique_neighbors",
                "all LEDs are equally bright",
                "two levels or magnitudes, or more",
            )


class FibonacciConfig(DimmedConfig):
    """`count` LEDs on a Fibonacci spiral, as evenly as possible."""

    kind: Literal["fibonacci"]
    count: Count


class PoissonDiskConfig(DimmedConfig):
    """LEDs at random with a least spacing: as many as fit at `spacing`, or `count` LEDs as far apart as possible."""

    kind: Literal["poisson_disk"]
    spacing_m: PositiveLength | None = None
    count: Count | None = None

    def check(self) -> None:
        if (self.spacing_m is None) == (self.count is None):
            raise InputError("", "poisson_disk takes either spacing or count")


class RandomPlacesConfig(DimmedConfig):
    """`count` LEDs at independent random positions."""

    kind: Literal["random"]
    count: Count


class LitConfig(DimmedConfig):
    """Base of the regular layouts: the fraction `lit_fraction` of their positions, drawn by hardware_seed, has an LED.

    All fields of a regular layout look alike, so a tracker without other information cannot distinguish them unless
    LEDs are left out or differ in brightness. An LED keeps its number among all positions.
    """

    lit_fraction: PositiveFraction = 1.0


class GeodesicConfig(LitConfig):
    """LEDs at the vertices of a geodesic sphere about the bearing, with one vertex at the zenith.

    Attributes
    ----------
    frequency
        Number of parts of an edge of the icosahedron (class I), or twice the number of parts of half of a face's height
        (class II; even)
    class
        `I`: lines of the division parallel to the edges of the icosahedron; `II`: perpendicular to them
    rotation_deg
        Rotation about the zenith; at 0 one of the five edges from the vertex at the zenith is along the lab's x
    """

    kind: Literal["geodesic"]
    frequency: Annotated[int, within(1, 100)]
    class_: Annotated[Literal["I", "II"], Field(alias="class")] = "I"
    rotation_deg: Spin = 0.0

    def check(self) -> None:
        if self.class_ == "II" and self.frequency % 2:
            raise InputError("frequency", f"{self.frequency} is odd, with class: II", "even")


class StringConfig(LitConfig):
    """LED tape wound on the surface about the vertical through the bearing, numbered along the tape.

    Attributes
    ----------
    winding
        `latitude`: circles at equal angles from the zenith, each cut where it closes, the first half a spacing from the
        apex; `spiral`: one tape from the apex to the rim; `meridian`: straight strips down to the rim, each beginning
        where its neighbors are half a spacing away
    pitch
        Distance of successive LEDs of the tape, along the surface
    spacing
        Distance of two circles or turns along the surface, in the mean of all azimuths; greatest distance of two strips
    pitch_error
        Relative standard deviation of a tape's pitch, or its tolerance
    glue_scatter
        Standard deviation of the sideways position of a tape, or its tolerance; it varies over GLUE_M of tape
    """

    kind: Literal["string"]
    pitch_m: TapeLength
    spacing_m: TapeLength
    winding: Literal["latitude", "spiral", "meridian"] = "latitude"
    pitch_error: NumberError = 0.0
    glue_scatter_m: LengthError = 0.0


class OptimizedConfig(DimmedConfig):
    """`count` LEDs placed for the best accuracy of a camera at its worst attitudes: tilts to tilt_deg, any yaw.

    Attributes
    ----------
    field_deg
        Field of view of the camera along body x and y; that of the scene's camera if left out, with its rows along x
    camera
        Entrance pupil of the camera on the body, which looks along body z; `vehicle.camera` if left out
    spacing
        Least distance between two LEDs
    coincidence
        Distance below which LEDs of two fields coincide when one field is laid on the other: a few times the error of
        the survey
    min_leds
        Number of LEDs that every field should have; fewer are penalized
    rounds
        Number of times that another position is tried for each LED
    """

    kind: Literal["optimized"]
    count: Annotated[int, within(3, 2000)]
    tilt_deg: Annotated[Number, within(0, 60)]
    field_deg: tuple[FieldOfView, FieldOfView] | None = None
    camera_m: Position | None = None
    spacing_m: PositiveLength
    coincidence_m: PositiveLength = 1e-3
    min_leds: Annotated[int, within(2, 50)] = 5
    rounds: Annotated[int, within(1, 5000)] = 100


class CelestialConfig(ConfigModel):
    """The real sky: an LED for each of the brightest stars, at the direction seen from the camera's nominal position.

    Attributes
    ----------
    catalog
        Name in data/catalogs, or a file
    count, limit_mag
        Number of LEDs for the brightest stars on the dome, or the V magnitude to which all stars have an LED
    brightness
        `band`: each LED is as bright as the camera measures the star, since the LED has another color; `v`: by its V
    brightest_mag
        Magnitude of full brightness; brighter stars are limited to it. That of the brightest star if left out
    camera
        Entrance pupil in the lab when the vehicle is level
    zenith_ra_deg, zenith_dec_deg, roll_deg
        Direction at the zenith, and position angle there of the lab's -y (up for a level camera), like `ra_deg`,
        `dec_deg`, `roll_deg` of a camera that looks up
    epoch
        Time of the apparent places, UTC
    """

    kind: Literal["celestial"]
    cap_deg: Cap
    catalog: str = "hipparcos_hp6.5"
    count: Count | None = None
    limit_mag: LimitMagnitude | None = None
    brightness: Literal["v", "band"] = "band"
    brightest_mag: Magnitude | None = None
    camera_m: Position
    zenith_ra_deg: RightAscension
    zenith_dec_deg: Declination
    roll_deg: Spin = 0.0
    epoch: Moment = J2000
    hardware_seed: Seed = 0

    def check(self) -> None:
        if (self.count is None) == (self.limit_mag is None):
            raise InputError("", "celestial takes either count or limit_mag")


class ListedConfig(DimmedConfig):
    """LEDs by list: positions in the lab, or directions from the bearing onto the surface, or a CSV file of either.

    Attributes
    ----------
    positions
        Positions in the lab
    directions_deg
        Azimuth from +x toward +y, and tilt from the zenith
    file
        File with columns x_m, y_m, z_m (or x_mm, x_cm, x_in) or azimuth_deg, tilt_deg; optionally level or magnitude,
        and id, the numbers of the LEDs. `skysim scenes export --out leds.csv` and `skysim survey` write such files
    types
        Type of each LED, a name in `led.types`; `led` if left out
    """

    kind: Literal["listed"]
    positions_m: NotEmpty[Position] | None = None
    directions_deg: NotEmpty[tuple[Spin, AxisAngle]] | None = None
    file: str | None = None
    types: TypeNames | None = None

    def check(self) -> None:
        lists = [
            each
            for each in (self.positions_m, self.directions_deg, self.file)
            if each is not None
        ]
        if len(lists) != 1:
            raise InputError("", "listed takes one of positions, directions_deg, file")
        dimmed = len(self.levels or self.magnitudes or ())
        if self.unique_neighbors:
            raise InputError("unique_neighbors", "a list has its own levels", "none")
        if dimmed and self.file is not None:
            raise InputError("", "levels and magnitudes of a file belong in its columns")
        if self.types and (self.file is not None or len(self.types) != len(lists[0])):
            raise InputError(
                "types", f"{len(self.types)}", "one for each listed LED, no file"
            )
        if dimmed and dimmed != len(lists[0]):
            raise InputError("", f"{len(lists[0])} LEDs, but {dimmed} levels or magnitudes")


SingleLeds = (
    FibonacciConfig
    | PoissonDiskConfig
    | RandomPlacesConfig
    | GeodesicConfig
    | StringConfig
    | OptimizedConfig
    | CelestialConfig
    | ListedConfig
)
Points = Annotated[SingleLeds, BY_KIND]


class AimingConfig(ConfigModel):
    """A laser on a two-axis mount that marks each place on the shell, where a hole is drilled (JHU/APL's dome).

    Attributes
    ----------
    laser
        Intersection of its axes, in the lab
    pointing_sigma_arcsec
        Standard deviation of its direction about two axes across it, or its tolerance; drawn for each hole
    orientation_sigma_arcsec
        Standard deviation of the mount's attitude about each axis of the lab, or its tolerance; common to all holes
    drill_sigma
        Standard deviation of a hole from its mark along two axes in the surface, or its tolerance; drawn for each hole
    """

    laser_m: Position
    pointing_sigma_arcsec: NumberError = 0.0
    orientation_sigma_arcsec: NumberError = 0.0
    drill_sigma_m: LengthError = 0.0


class FibersConfig(ConfigModel):
    """Ends of optical fibers through the shell (JHU/APL's dome), at the points of any layout of single LEDs.

    Attributes
    ----------
    points
        Layout of the fibers
    radius_variation
        Greatest error of the dome's radius at a fiber as a fraction of the distance from the bearing, uniformly
        distributed: the end is displaced along the normal of the surface, inward or outward
    aiming
        Laser that marked the positions, with its errors; the error of the shell is then along its direction. If left
        out, the positions are those of the design, except for the error of the shell
    """

    kind: Literal["fibers"]
    points: Points
    radius_variation: Annotated[Number, within(0, 0.1)] = 0.0
    aiming: AimingConfig | None = None

    def check(self) -> None:
        laser = self.aiming
        if laser and not (
            self.radius_variation
            or laser.pointing_sigma_arcsec
            or laser.orientation_sigma_arcsec
        ):
            raise InputError(
                "aiming",
                "the laser's place has no effect",
                "an error of its pointing or orientation, or a radius_variation",
            )


class PixelsConfig(ConfigModel):
    """Grid and gray levels of a display, common to an LCD panel, a projector and a collimated micro-display.

    Attributes
    ----------
    pixels
        Numbers of columns and rows
    pitch
        Distance of neighboring pixels in both directions
    block
        Side, in pixels, of the square of one gray that shows a star
    gray_levels, gamma
        Gray g = 0, 1, ... transmits (g / (gray_levels - 1))^gamma of white. "srgb" is IEC 61966-2-1; a list is
        light as measured above that of black, at even grays from black, 0, to white, 1
    contrast
        White over black, which glows over the whole display; without it black is dark
    """

    pixels: tuple[Pixels, Pixels]
    pitch_m: PositiveLength
    block: Pixels = 1
    gray_levels: Annotated[int, within(2, 65536)] = 256
    gamma: Annotated[Number, above(0, 10)] | Literal["srgb"] | Fractions = 2.2
    contrast: Annotated[Positive, Field(ge=2)] | None = None

    def check(self) -> None:
        if self.block > min(self.pixels):
            raise InputError(
                "block",
                f"{self.block} is wider than the display",
                f"up to {min(self.pixels)} pixels",
            )
        gamma = self.gamma
        # A rise from 0 to 1 is what a sorted set of it with both ends is.
        if isinstance(gamma, tuple) and tuple(sorted({0.0, 1.0, *gamma})) != gamma:
            raise InputError("gamma", "not a rise from 0 to 1", "0 first, 1 last, increasing")


class LensDisplayConfig(PixelsConfig):
    """A display behind a lens: a projector or a collimated micro-display.

    Attributes
    ----------
    focal_length
        Focal length f of the lens
    distortion
        Coefficient k of the lens: a direction at the tangent t from the axis is at f t (1 + k t^2) on the display. The
        picture is corrected for it
    """

    focal_length_m: PositiveLength
    distortion: Annotated[Number, within(-1, 1)] = 0.0

    def check(self) -> None:
        corner = math.hypot(*self.pixels) * self.pitch_m / 2 / self.focal_length_m
        # t (1 + k t^2) has its maximum 2 t / 3 at t^2 = -1 / (3 k).
        if self.distortion < 0 and 2 / 3 / math.sqrt(-3 * self.distortion) <= corner:
            raise InputError(
                "distortion",
                f"{self.distortion:g} folds the picture's corners back",
                "nearer to 0",
            )


class LcdConfig(PixelsConfig):
    """A flat LCD panel (the Naval Postgraduate School's screen): any layout of single LEDs, drawn on its pixels.

    It is centered on the flat surface and ends at its outer pixels. Its columns are along the surface's own x and its
    rows along y, which a level camera sees as right and down. `led` is one white pixel while its backlight is lit; its
    disk_diameter is that of a disk of the pixel's area.
    """

    kind: Literal["lcd"]
    points: Points


class ProjectorConfig(LensDisplayConfig):
    """A projector in the dome that shows any layout of single LEDs on the matt inside, each on the nearest pixels.

    `led` is the light of one white pixel on the axis after reflection by the wall: the intensity along the normal of
    the wall (share / pi of the pixel's lumens, in candela), and the lobe of the wall; disk_diameter is the blur of lens
    and paint. The vehicle does not hide the beam.

    Attributes
    ----------
    points
        Layout that is shown
    position, aim
        Entrance pupil of the lens, and a point on its axis, in the lab
    rotation_deg
        Rotation of the picture about the axis; at 0 its rows are along the lab's +x, projected across the axis
    pitch
        Distance of the pixels on the projector's chip
    f_number
        F-number of the lens
    focus
        Distance along the axis at which the picture is sharp; that of `aim` if left out
    falloff
        Exponent of the cosine of a pixel's angle from the axis, by which its light decreases; 4 is the natural
        vignetting of a lens
    """

    kind: Literal["projector"]
    points: Points
    position_m: Position
    aim_m: Position
    rotation_deg: Spin = 0.0
    f_number: Positive = 2.0
    focus_m: PositiveLength | None = None
    falloff: Annotated[Number, within(0, 10)] = 4.0

    def check(self) -> None:
        sight = [end - start for start, end in zip(self.position_m, self.aim_m, strict=True)]
        if not any(sight[1:]):
            raise InputError(
                "aim", "straight along x from the position", "any other direction"
            )


OnPoints = (
    FibersConfig | LcdConfig | ProjectorConfig
)  # layouts that show the points of another one

Layout = Annotated[PatchBoardsConfig | SingleLeds | OnPoints, BY_KIND]
