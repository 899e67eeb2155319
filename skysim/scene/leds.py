"""A dome's LEDs as a scene says it: how they are laid out, how each is driven and shines. Schema only."""

from __future__ import annotations

import datetime
from collections.abc import Sequence
from typing import Annotated, Literal, Self

from pydantic import Field, field_validator, model_validator

from skysim.core.units import (
    Ascending,
    ConfigModel,
    Intensity,
    Length,
    NotNegative,
    Number,
    RadiantIntensity,
    Time,
    check_table,
)

HOLES = 9  # on a patch board: 3x3
Level = Annotated[Number, Field(gt=0, le=1)]
Levels = Annotated[tuple[Level, ...], Field(min_length=1)]
Magnitudes = Annotated[tuple[Annotated[Number, Field(ge=-30, le=30)], ...], Field(min_length=1)]
Cap = Annotated[Number, Field(gt=0, le=90)]
Count = Annotated[int, Field(ge=1, le=100_000)]
Seed = Annotated[int, Field(ge=0)]
FieldOfView = Annotated[Number, Field(ge=1, le=90)]


def levels_of(magnitudes: Sequence[float]) -> tuple[float, ...]:
    """Pogson's law: 10^(-0.4 m), the brightest of the list at full level."""
    return tuple(10.0 ** (-0.4 * (float(one) - float(min(magnitudes)))) for one in magnitudes)


class BoardConfig(ConfigModel):
    """One patch board, glued where the bearing's centre sees its middle.

    azimuth_deg, tilt_deg : from the lab's +x towards +y, and from the zenith
    turn_deg : of its columns about its normal
    leds     : the holes that are soldered, 0 to 8, row by row; levels: of each, full if left out
    """

    azimuth_deg: Number
    tilt_deg: Annotated[Number, Field(ge=0, le=90)]
    turn_deg: Number = 0.0
    leds: Annotated[tuple[Annotated[int, Field(ge=0, lt=HOLES)], ...], Field(min_length=1)]
    levels: Levels | None = None

    @model_validator(mode="after")
    def one_led_a_hole(self) -> BoardConfig:
        if len(set(self.leds)) < len(self.leds):
            raise ValueError(f"leds: {list(self.leds)} has a hole twice")
        if self.levels is not None and len(self.levels) != len(self.leds):
            raise ValueError(f"leds has {len(self.leds)} holes, levels {len(self.levels)}")
        return self


class PatchBoardsConfig(ConfigModel):
    """3x3 LED boards on a cap of the surface: spread evenly or on a grid, each with a pattern of its own, or by list.

    cap_deg : as far from the zenith as the dome carries LEDs, seen from the bearing; so for every layout
    spacing, lit, pwm_levels : of boards that are spread; `boards` takes their place
    spread  : along a spiral, as evenly as can be, or in rows and columns of the lab's x and y, seen from above;
        on a dome of the apex's height all about, which sets how many a spiral has
    glue_scatter  : standard deviation of an LED's place along each axis of its board
    glue_tilt_deg : a board's normal is off the surface's by up to this, evenly over that cap
    """

    kind: Literal["patch_boards"]
    cap_deg: Cap
    spacing_m: Annotated[Length, Field(gt=0)] | None = None
    pitch_m: Annotated[Length, Field(gt=0)]
    spread: Literal["spiral", "grid"] = "spiral"
    lit: tuple[int, int] = (4, 6)
    pwm_levels: Levels = (1.0,)
    boards: tuple[BoardConfig, ...] = ()
    glue_scatter_m: Annotated[Length, Field(ge=0)] = 0.0
    glue_tilt_deg: Annotated[Number, Field(ge=0, le=30)] = 0.0
    hardware_seed: Seed = 0

    @field_validator("lit")
    @classmethod
    def within_board(cls, value: tuple[int, int]) -> tuple[int, int]:
        if not 1 <= value[0] <= value[1] <= HOLES:
            raise ValueError(f"{value} is no range of LEDs on a 3x3 board; allowed: 1 <= least <= most <= 9")
        return value

    @model_validator(mode="after")
    def boards_fit_beside_each_other(self) -> PatchBoardsConfig:
        if self.spacing_m is None and not self.boards:
            raise ValueError("patch_boards takes spacing, or boards by list")
        if self.spacing_m is not None and self.spacing_m < 3 * self.pitch_m:
            raise ValueError(
                f"spacing {self.spacing_m:g} m: boards of three LEDs at {self.pitch_m:g} m would overlap"
            )
        return self


class DimmedConfig(ConfigModel):
    """Base of the layouts of single LEDs: how bright each is made, by shares of full brightness or by magnitudes.

    Brightness is drawn from the list for each LED (in `listed`, the list is theirs, one by one); the least of the
    magnitudes is full brightness.
    """

    cap_deg: Cap
    levels: Levels | None = None
    magnitudes: Magnitudes | None = None
    hardware_seed: Seed = 0

    @property
    def dimming(self) -> tuple[float, ...]:
        """The levels, whichever way they are given."""
        return levels_of(self.magnitudes) if self.magnitudes else self.levels or (1.0,)

    @model_validator(mode="after")
    def one_way_to_say_it(self) -> Self:
        if self.levels is not None and self.magnitudes is not None:
            raise ValueError("a layout takes either levels or magnitudes")
        return self


class FibonacciConfig(DimmedConfig):
    """So many LEDs on Fibonacci's spiral: as evenly as can be."""

    kind: Literal["fibonacci"]
    count: Count


class PoissonDiscConfig(DimmedConfig):
    """LEDs at random, none nearer to another than the spacing, as many as find room; or so many, as far apart as they
    find it.
    """

    kind: Literal["poisson_disc"]
    spacing_m: Annotated[Length, Field(gt=0)] | None = None
    count: Annotated[int, Field(ge=1, le=20_000)] | None = None

    @model_validator(mode="after")
    def one_measure(self) -> Self:
        if (self.spacing_m is None) == (self.count is None):
            raise ValueError("poisson_disc takes either spacing or count")
        return self


class RandomPlacesConfig(DimmedConfig):
    """So many LEDs, each anywhere."""

    kind: Literal["random"]
    count: Count


class OptimisedConfig(DimmedConfig):
    """So many LEDs where they make the worst attitude best: of all tilts to tilt_deg and any yaw, by one camera.

    field_deg : the camera's field of view along body x and y
    camera    : its entrance pupil on the body; it looks along body z
    spacing   : no two LEDs are nearer to each other
    alike     : LEDs of two fields coincide that are nearer when one is laid on the other: a few of the survey's errors
    wanted    : LEDs that every field should hold; a field that has fewer counts as a worse one
    rounds    : how often each LED is offered another place
    """

    kind: Literal["optimised"]
    count: Annotated[int, Field(ge=3, le=2000)]
    tilt_deg: Annotated[Number, Field(ge=0, le=60)]
    field_deg: tuple[FieldOfView, FieldOfView]
    camera_m: tuple[Length, Length, Length]
    spacing_m: Annotated[Length, Field(gt=0)]
    alike_m: Annotated[Length, Field(gt=0)] = 1e-3
    wanted: Annotated[int, Field(ge=2, le=50)] = 5
    rounds: Annotated[int, Field(ge=1, le=5000)] = 100


class CelestialConfig(ConfigModel):
    """The real sky: an LED for each of the brightest stars, where the camera at its nominal place sees it.

    count or limit_mag : so many stars on the dome, or all to this V
    camera : the entrance pupil in the lab when the vehicle stands level
    zenith_ra_deg, zenith_dec_deg, roll_deg : what is overhead, and the position angle there of the lab's -y (a level
        camera's up), as `ra_deg`, `dec_deg`, `roll_deg` of a camera that looks up
    epoch  : whose apparent places they are, UTC
    brightness : band, each LED is as bright as the chip finds its star, whose colour the LED lacks; v, as its V
    brightest_mag : no star is shown brighter than this, which is full brightness; the brightest star's if left out
    """

    kind: Literal["celestial"]
    cap_deg: Cap
    catalogue: str = "hipparcos_hp6.5"
    count: Count | None = None
    limit_mag: Annotated[Number, Field(ge=-2, le=15)] | None = None
    brightness: Literal["v", "band"] = "band"
    brightest_mag: Number | None = None
    camera_m: tuple[Length, Length, Length]
    zenith_ra_deg: Annotated[Number, Field(ge=0, lt=360)]
    zenith_dec_deg: Annotated[Number, Field(ge=-90, le=90)]
    roll_deg: Number = 0.0
    epoch: datetime.datetime = datetime.datetime(2000, 1, 1, 12)
    hardware_seed: Seed = 0

    @model_validator(mode="after")
    def one_choice_of_stars(self) -> CelestialConfig:
        if (self.count is None) == (self.limit_mag is None):
            raise ValueError("celestial takes either count or limit_mag")
        if not 1900 <= self.epoch.year <= 2100:
            raise ValueError(f"epoch: {self.epoch.isoformat()} is outside of 1900 to 2100")
        return self


class ListedConfig(DimmedConfig):
    """LEDs by list: places in the lab, or directions from the bearing onto the surface, or a CSV file of either.

    directions_deg : azimuth from +x towards +y, and tilt from the zenith
    file : columns x_m, y_m, z_m or azimuth_deg, tilt_deg, and level or magnitude
    """

    kind: Literal["listed"]
    positions_m: Annotated[tuple[tuple[Length, Length, Length], ...], Field(min_length=1)] | None = None
    directions_deg: Annotated[tuple[tuple[Number, Number], ...], Field(min_length=1)] | None = None
    file: str | None = None

    @model_validator(mode="after")
    def one_list(self) -> ListedConfig:
        given = [one for one in (self.positions_m, self.directions_deg, self.file) if one is not None]
        if len(given) != 1:
            raise ValueError("listed takes one of positions, directions_deg, file")
        dimmed = len(self.levels or self.magnitudes or ())
        if dimmed and self.file is not None:
            raise ValueError("levels and magnitudes of a file are its own columns")
        if dimmed and dimmed != len(given[0]):
            raise ValueError(f"{len(given[0])} LEDs, but {dimmed} levels or magnitudes")
        return self


Points = Annotated[
    FibonacciConfig
    | PoissonDiscConfig
    | RandomPlacesConfig
    | OptimisedConfig
    | CelestialConfig
    | ListedConfig,
    Field(discriminator="kind"),
]


class FibresConfig(ConfigModel):
    """Ends of optical fibres through the shell (JHU/APL's dome), where any layout of single LEDs has its points.

    radius_variation : the dome's radius is another at every fibre, by up to this share of the distance from the
        bearing, evenly: the end stands off the surface along its normal, inwards or outwards
    """

    kind: Literal["fibres"]
    points: Points
    radius_variation: Annotated[Number, Field(ge=0, le=0.1)] = 0.0

    @property
    def cap_deg(self) -> float:
        """As far from the zenith as there are points."""
        return self.points.cap_deg


class PixelsConfig(ConfigModel):
    """A display's grid and its greys: what a panel on the ceiling and a micro-display on a bench have alike.

    pixels : columns and rows;  pitch : from a pixel to the next, along both
    block  : a star is drawn as so many by so many pixels, all of one grey
    grey_levels, gamma : grey g = 0, 1, ... lets (g / (grey_levels - 1))^gamma of white through
    contrast : white over black, which glows all over the display; none: black is dark
    """

    pixels: tuple[Annotated[int, Field(ge=1, le=20_000)], Annotated[int, Field(ge=1, le=20_000)]]
    pitch_m: Annotated[Length, Field(gt=0)]
    block: Annotated[int, Field(ge=1)] = 1
    grey_levels: Annotated[int, Field(ge=2, le=65536)] = 256
    gamma: Annotated[Number, Field(gt=0, le=10)] = 2.2
    contrast: Annotated[Number, Field(ge=2)] | None = None

    @model_validator(mode="after")
    def block_fits(self) -> Self:
        if self.block > min(self.pixels):
            raise ValueError(
                f"block {self.block} is wider than the display; allowed: to {min(self.pixels)} pixels"
            )
        return self


class LcdConfig(PixelsConfig):
    """A flat LCD panel (the Naval Postgraduate School's screen): any layout of single LEDs, drawn on its pixels.

    It lies in the middle of the flat surface and ends where its pixels end, columns along the surface's own x, rows
    along its y, which a level camera sees as right and down. `led` is one white pixel while its backlight is lit, its
    disc_diameter that of a disc of its area.
    """

    kind: Literal["lcd"]
    points: Points

    @property
    def cap_deg(self) -> float:
        """As far from the zenith as there are points."""
        return self.points.cap_deg


Layout = Annotated[
    PatchBoardsConfig
    | FibonacciConfig
    | PoissonDiscConfig
    | RandomPlacesConfig
    | OptimisedConfig
    | CelestialConfig
    | ListedConfig
    | FibresConfig
    | LcdConfig,
    Field(discriminator="kind"),
]


class CosineLobeConfig(ConfigModel):
    """Radiant intensity as cos^exponent of the angle from the normal; 1 is Lambert's law."""

    kind: Literal["cosine"] = "cosine"
    exponent: NotNegative = 1.0


class LobeTableConfig(ConfigModel):
    """Relative intensity against angle as it was measured, 1 on the axis, nothing beyond the last angle."""

    kind: Literal["table"]
    angle_deg: Ascending
    intensity: Annotated[tuple[NotNegative, ...], Field(min_length=2)]

    @model_validator(mode="after")
    def a_table(self) -> LobeTableConfig:
        check_table(self.angle_deg, self.intensity, "intensity")
        if self.angle_deg[0] != 0 or abs(self.intensity[0] - 1) > 1e-6:
            raise ValueError("the table does not begin with an intensity of 1 at 0 deg")
        return self


Lobe = Annotated[CosineLobeConfig | LobeTableConfig, Field(discriminator="kind")]


class DirectConfig(ConfigModel):
    """Direct current: always lit, the level in its strength."""

    kind: Literal["direct"]


class PwmConfig(ConfigModel):
    """Hardware PWM: lit for its level of every led.pwm_period, each LED with a phase of its own."""

    kind: Literal["pwm"] = "pwm"


class SequentialConfig(ConfigModel):
    """An Arduino's software PWM: its LEDs one after another, each lit for its level of its slot.

    controller : `board`, one to each patch board; `dome`, one for all; or how many LEDs, by number, share one
    """

    kind: Literal["sequential"]
    slot_s: Annotated[Time, Field(gt=0)] = 1e-3
    controller: Literal["board", "dome"] | Annotated[int, Field(ge=1)] = "board"


class RefreshConfig(ConfigModel):
    """A panel's backlight, lit for `duty` of every frame: row after row from the top, in the course of a frame."""

    kind: Literal["refresh"]
    rate_hz: Annotated[Number, Field(gt=0)]
    duty: Annotated[Number, Field(gt=0, le=1)] = 1.0


Drive = Annotated[DirectConfig | PwmConfig | SequentialConfig | RefreshConfig, Field(discriminator="kind")]


class LedConfig(ConfigModel):
    """One kind of LED, for the whole dome: so bright along its normal, in candela or in watts a steradian.

    drive : what makes its level; pwm_period belongs to the kind pwm
    """

    intensity_cd: Annotated[Intensity, Field(gt=0)] | None = None
    radiant_intensity_w_sr: Annotated[RadiantIntensity, Field(gt=0)] | None = None
    disc_diameter_m: Annotated[Length, Field(gt=0, le=0.1)]
    falloff: Literal["inverse_square"] = "inverse_square"
    lobe: Lobe = CosineLobeConfig()
    spectrum: Literal["white"] | Annotated[Length, Field(ge=300e-9, le=1100e-9)] = "white"
    scatter: Annotated[Number, Field(ge=0, lt=0.5)] = 0.0
    drive: Drive = PwmConfig()
    pwm_period_s: Annotated[Time, Field(gt=0)] = 1e-3

    @model_validator(mode="after")
    def one_brightness(self) -> LedConfig:
        if (self.intensity_cd is None) == (self.radiant_intensity_w_sr is None):
            raise ValueError("an LED takes either intensity or radiant_intensity")
        return self
