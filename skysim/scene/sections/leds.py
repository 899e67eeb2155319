"""Schema of the LED type of a dome: emission lobe, drive, brightness."""

from pathlib import Path
from typing import Annotated, Any, Literal

from pydantic import (
    AfterValidator,
    Discriminator,
    Field,
    Tag,
)

from skysim.core.errors import InputError
from skysim.core.paths import DATA
from skysim.core.units import (
    BY_KIND,
    ZEROS,
    AboveZero,
    AxisAngle,
    ConfigModel,
    Duration,
    InnerFraction,
    Intensity,
    Length,
    LengthError,
    NotNegative,
    Number,
    NumberError,
    Positive,
    PositiveFraction,
    PositiveInt,
    RadiantIntensity,
    Several,
    TableConfig,
    Three,
    Time,
    Tolerance,
    above,
    with_unit,
    within,
)

Distance = Literal[3, 5, 7, 11]
ClockError = Annotated[NumberError, Field(le=10_000)]
Offset = Annotated[Length, within(-0.01, 0.01)]


class CosineLobeConfig(ConfigModel):
    """Radiant intensity proportional to cos^exponent of the angle from the normal; 1 is Lambert's law."""

    kind: Literal["cosine"] = "cosine"
    exponent: NotNegative = 1.0


class LobeTableConfig(TableConfig):
    """Measured relative intensity against angle, 1 on the axis, zero beyond the last angle."""

    kind: Literal["table"]
    angle_deg: Several[AxisAngle]
    intensity: Several[NotNegative]

    def check(self) -> None:
        if self.angle_deg[0] != 0 or abs(self.intensity[0] - 1) > 1e-6:
            raise InputError("", "the table does not begin with an intensity of 1 at 0 deg")


Lobe = Annotated[CosineLobeConfig | LobeTableConfig, BY_KIND]


class DirectConfig(ConfigModel):
    """Direct current: the LEDs are always lit, and the level scales their strength."""

    kind: Literal["direct"]


class LowPassConfig(ConfigModel):
    """An RC low-pass filter for each LED, whose light follows the filter's voltage.

    Attributes
    ----------
    time_constant
        Time constant R C
    error
        Relative standard deviation of R C from LED to LED, or its tolerance (of both parts together)
    """

    time_constant_s: Duration
    error: Annotated[NumberError, Field(lt=0.5)] = 0.0


class PwmConfig(ConfigModel):
    """Hardware PWM: an LED is lit for the fraction `level` of every led.pwm_period, with a random phase.

    Attributes
    ----------
    filter
        Filter that makes the light nearly steady; none if left out
    """

    kind: Literal["pwm"] = "pwm"
    filter: LowPassConfig | None = None


class SequentialConfig(ConfigModel):
    """Software PWM of an Arduino: its LEDs are lit in sequence, each for the fraction `level` of its slot.

    Attributes
    ----------
    slot
        Duration of a slot
    controller
        `board`: one controller for each patch board; `dome`: one for all; or the number of LEDs that share one, in the
        order of their numbers
    slots
        Number of slots in a cycle, of which those without an LED stay dark; as many as the controller has LEDs if left
        out
    """

    kind: Literal["sequential"]
    slot_s: Duration = 1e-3
    controller: Literal["board", "dome"] | PositiveInt = "board"
    slots: PositiveInt | None = None


class RefreshConfig(ConfigModel):
    """A display that is lit for the fraction `duty` of every frame.

    The rows of a panel are lit one after another from the top in the course of a frame. The pixels of a projector are
    lit together; duty is then the share of the color on its color wheel, or that of its shutter.
    """

    kind: Literal["refresh"]
    rate_hz: Positive
    duty: PositiveFraction = 1.0


Drive = Annotated[DirectConfig | PwmConfig | SequentialConfig | RefreshConfig, BY_KIND]


class ClockConfig(ConfigModel):
    """Oscillators of the controllers: a crystal of tens of ppm, in a room whose temperature changes (assumed).

    Attributes
    ----------
    offset_ppm
        Standard deviation of their frequency offsets, or its tolerance; drawn by the layout's hardware_seed
    drift_ppm_h
        Standard deviation of the frequency drift per hour, or its tolerance; drawn by the scene's seed
    """

    offset_ppm: ClockError = 50.0
    drift_ppm_h: ClockError = 1.0


class CodeConfig(ConfigModel):
    """A code that identifies each LED over time: its light repeats a word of levels.

    Words are assigned in the order of the LED numbers. A failed bit shows another level.

    Attributes
    ----------
    depth
        Fraction of its light that an LED loses at its lowest level; 1 is on and off
    bit_time
        Duration of a bit by the dome's own free-running clock (`clock`); `frame`: the camera's trigger advances the
        code by one bit a frame
    dropout
        Probability that a bit of an LED fails, independently of all others; drawn by the scene's seed
    """

    depth: PositiveFraction = 0.5
    bit_time_s: Literal["frame"] | Annotated[Time, Field(ge=1e-4)] = "frame"
    dropout: Annotated[Number, Field(ge=0, lt=0.5)] = 0.0


class TriggeredCodeConfig(CodeConfig):
    """Codes that need the camera's trigger, and may have more than two levels of light.

    Attributes
    ----------
    levels
        Number of levels of light, equally spaced in magnitude; 4 show two bits a frame and 8 show three
    """

    levels: Literal[2, 4, 8] = 2

    def check(self) -> None:
        if self.levels > 2 and self.depth == 1:
            raise InputError(
                "levels",
                f"{self.levels} with depth 1, equally spaced in magnitude",
                "depth below 1",
            )


class PlainCodeConfig(TriggeredCodeConfig):
    """Codes of all kinds without a parameter.

    Attributes
    ----------
    kind
        `gray`: numbers, distance 1; `hamming`: extended and shortened, distance 4; `gold`: all sequences and shifts,
        distance 12 of 31 bits; `de_bruijn`: one sequence that moves along the LEDs like the data of a shift register,
        in which a few successive LEDs, or a few successive frames of one LED, are unique
    """

    kind: Literal["gray", "hamming", "gold", "de_bruijn"]


class BchCodeConfig(TriggeredCodeConfig):
    """The shortest BCH code with enough words for the LEDs and this designed distance."""

    kind: Literal["bch"]
    distance: Distance = 5


class CyclicCodeConfig(CodeConfig):
    """Words of a cyclic BCH code that differ at all shifts, so they can be read without knowing where a word begins."""

    kind: Literal["cyclic"]
    distance: Distance = 7


Code = Annotated[PlainCodeConfig | BchCodeConfig | CyclicCodeConfig, BY_KIND]


def below_one(effect: str) -> AfterValidator:
    """A validator of a relative scatter, which refuses a tolerance of 1 or more; `effect` is that of such a one."""

    def check(value: float) -> float:
        if isinstance(value, Tolerance) and value.half_width >= 1:
            raise InputError("", f"a tolerance of {value.half_width:g} {effect}", "below 1")
        return value

    return AfterValidator(check)


class AgingConfig(ConfigModel):
    """Loss of light over the hours of operation: exp(-a hours) is left, a = ln(1 / 0.7) / life_hours (IES TM-21).

    Attributes
    ----------
    hours
        Hours of operation so far
    life_hours
        L70 of the data sheet, after which 70 % of the light is left
    scatter
        Standard deviation of ln a from LED to LED, or the tolerance of a as a fraction; drawn by the layout's
        hardware_seed
    """

    hours: Positive
    life_hours: Annotated[Number, above(0, 1e7)]
    scatter: Annotated[NumberError, Field(lt=1), below_one("makes light")] = 0.0


class WarmUpConfig(ConfigModel):
    """Loss of light while the LEDs warm up from the scene's start, when they are switched on.

    The fraction steady + (1 - steady) exp(-t / time) is left of the light of cold LEDs, for which data sheets state
    pulsed values.

    Attributes
    ----------
    steady
        Fraction that is left when they are warm
    time
        Time after which 63 % of the loss is reached
    """

    steady: InnerFraction
    time_s: Duration


def spectrum_file(spectrum: str) -> Path:
    """The file of an LED's spectrum: data/led/white.csv, or a path. Raises InputError if there is none."""
    path = DATA / "led" / "white.csv" if spectrum == "white" else Path(spectrum)
    if not path.is_file():
        raise InputError(
            "",
            f"no file {spectrum!r}",
            "white, a CSV file of wavelength_nm and power, or a wavelength",
        )
    return path


def spectrum_tag(value: Any) -> str:
    """Tag of the kind of spectrum: white, or a text that ends in .csv, is measured; any other value is a wavelength."""
    measured = isinstance(value, str) and (value == "white" or value.endswith(".csv"))
    return "measured" if measured else "wavelength"


Wavelength = Annotated[
    Number,
    Positive,
    with_unit("m", "wavelength", '"630 nm", or white, or a CSV file'),
    within(300e-9, 1100e-9),
]
LedSpectrum = Annotated[
    Annotated[
        Annotated[str, AfterValidator(lambda name: spectrum_file(name) and name)],
        Tag("measured"),
    ]
    | Annotated[Wavelength, Tag("wavelength")],
    Discriminator(spectrum_tag),
]


class LedLightConfig(ConfigModel):
    """Brightness and color of an LED.

    Attributes
    ----------
    intensity, radiant_intensity
        Intensity along its normal in candela, or in watts per steradian
    spectrum
        `white` (data/led/white.csv), a CSV file of wavelength_nm and relative power, or the peak wavelength of a
        colored LED
    fwhm
        Full width at half maximum of a colored LED's spectrum, a Gaussian in power; a narrow line if left out
    color_scatter
        Standard deviation of the peak wavelength from LED to LED at the same intensity, or its tolerance (a bin); drawn
        by the layout's hardware_seed
    """

    intensity_cd: AboveZero[Intensity] | None = None
    radiant_intensity_w_sr: AboveZero[RadiantIntensity] | None = None
    spectrum: LedSpectrum = "white"
    fwhm_m: Annotated[Length, within(3e-9, 200e-9)] | None = None
    color_scatter_m: Annotated[LengthError, Field(le=30e-9)] = 0.0

    def check(self) -> None:
        if (self.intensity_cd is None) == (self.radiant_intensity_w_sr is None):
            raise InputError("", "an LED takes either intensity or radiant_intensity")
        if isinstance(self.spectrum, str) and (
            self.fwhm_m is not None or self.color_scatter_m
        ):
            key = "color_scatter" if self.fwhm_m is None else "fwhm"
            raise InputError(
                key, f"{self.spectrum} is a whole spectrum", "a wavelength as spectrum"
            )


class LedTypeConfig(LedLightConfig):
    """A further type of LEDs, by its brightness and color; the other keys are those of `led`."""


class LedConfig(LedLightConfig):
    """The LEDs of the dome, and the type of those to which the layout gives none of `types`.

    Attributes
    ----------
    disk_diameter
        Diameter of the emitting disk
    die
        Apparent place of the disk beside the center of the LED's window, which a survey measures: level, across, and
        outward along the normal (the lens of an LED magnifies it). All LEDs of a batch share it
    types
        Further types by name, for `types` of a layout; all share the keys below. A series resistor scales the current,
        so LEDs of one type with several resistors have levels, by the drive `direct`
    scatter
        Standard deviation of the logarithm of the intensity from LED to LED, or the tolerance of the intensity as a
        fraction (a bin of ±10 %: {tolerance: 0.1})
    aging, warm_up
        Loss of light by operation and by warm-up
    drive
        Generation of its level; pwm_period belongs to the kind pwm
    clock
        Oscillators that time the pulses; every run has its own phases at the start
    code
        Code of the light over the frames, from which the tracker identifies an LED (`tracker.decoder`); steady light if
        left out
    """

    disk_diameter_m: Annotated[Length, above(0, 0.1)]
    die_m: Three[Offset] = ZEROS
    falloff: Literal["inverse_square"] = "inverse_square"
    lobe: Lobe = CosineLobeConfig()
    types: dict[str, LedTypeConfig] = Field(default_factory=dict)
    scatter: Annotated[NumberError, Field(lt=0.5), below_one("leaves no light")] = 0.0
    aging: AgingConfig | None = None
    warm_up: WarmUpConfig | None = None
    drive: Drive = PwmConfig()
    clock: ClockConfig = ClockConfig()
    code: Code | None = None
    pwm_period_s: Duration = 1e-3

    def of_type(self, name: str) -> "LedConfig":
        """The LED with brightness and color of one of its types; itself for an empty name."""
        return self.with_values(**dict(self.types[name])) if name else self

    def check(self) -> None:
        if self.code and self.code.kind != "cyclic" and self.code.bit_time_s != "frame":
            raise InputError(
                "code.bit_time",
                f"a {self.code.kind} code cannot be read without the camera's trigger",
                "frame, or kind cyclic",
            )
