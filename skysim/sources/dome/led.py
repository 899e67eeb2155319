"""Light of an LED toward the camera: emission lobe, falloff with distance, drive, and on-time within an exposure.

A drive converts the level of each LED to a pulse train (`DRIVES`). `lit_moments_s` integrates such a train over an
exposure.
"""

from collections.abc import Callable
from dataclasses import field
from math import ceil, exp, floor, log, sqrt
from typing import Any, NamedTuple

import numpy as np
from numpy.random import Generator

from skysim.core.errors import InputError
from skysim.core.jit import jit
from skysim.core.types import Floats, Ints, frozen
from skysim.core.units import Tolerance, scaled_errors
from skysim.scene.sections.leds import (
    AgingConfig,
    CosineLobeConfig,
    LedConfig,
    Lobe,
    LobeTableConfig,
    RefreshConfig,
    SequentialConfig,
    WarmUpConfig,
)
from skysim.sources.photometry import (
    Band,
    led_chromatic,
    led_strength_e_s_sr,
    radiant_strength_e_s_sr,
)

LIFE_SHARE = 0.7  # fraction of initial light that an LED emits at the end of its life, L70
COLORS = 129  # number of wavelengths at which the strength of a colored LED is computed
Falloff = Callable[[Floats], Floats]


def inverse_square(distance_m: Floats) -> Floats:
    """Falloff of the flux of a point source: 1 / d^2, in m^-2."""
    return 1.0 / distance_m**2


# Laws by the name in the scene, `led.falloff`.
FALLOFF: dict[str, Falloff] = {"inverse_square": inverse_square}


def cosine_lobe(config: CosineLobeConfig, cos_emission: Floats) -> Floats:
    """Relative radiant intensity cos^m of the emission angle; m = 1 is a Lambertian disk."""
    return np.maximum(cos_emission, 0.0) ** config.exponent


def table_lobe(config: LobeTableConfig, cos_emission: Floats) -> Floats:
    """Measured lobe: relative intensity, interpolated linearly in angle, which neither overshoots nor oscillates.

    Constant within the first angle, zero beyond the last.
    """
    angle_deg = np.degrees(np.arccos(np.clip(cos_emission, -1.0, 1.0)))
    return np.interp(angle_deg, config.angle_deg, config.intensity, right=0.0)


# Arguments: its section of the scene, cosine of the angle from the LED's normal. Intensity is 1 on the normal.
LOBES: dict[str, Callable[[Any, Floats], Floats]] = {
    "cosine": cosine_lobe,
    "table": table_lobe,
}


@frozen
class Emitter:
    """Emission of a dome's LEDs: falloff with distance and lobe over angle. The default is a Lambertian disk.

    Attributes
    ----------
    falloff
        A key of FALLOFF
    lobe
        Section of the scene whose kind is a key of LOBES
    """

    falloff: str = "inverse_square"
    lobe: Lobe = field(default_factory=CosineLobeConfig)

    @classmethod
    def from_config(cls, led: LedConfig) -> "Emitter":
        """The emitter of a scene's LED section."""
        return cls(led.falloff, led.lobe)


def irradiance_e_s_m2(
    strength_e_s_sr: Floats,
    emitter: Emitter,
    cos_emission: Floats,
    cos_incidence: Floats,
    distance_m: Floats,
) -> Floats:
    """Irradiance at the aperture in photo-electrons s^-1 m^-2: E = I_0 L(theta) cos(phi) f(d).

    Zero where LED or aperture faces away. The arrays broadcast.

    Parameters
    ----------
    strength_e_s_sr
        I_0, photo-electrons s^-1 sr^-1 along the LED's normal
    emitter
        Its lobe L and its falloff f
    cos_emission
        Cosines of theta, the angle at the LED from its normal
    cos_incidence
        Cosines of phi, the angle at the aperture from the boresight
    distance_m
        Distances d
    """
    # Light leaves the front of the LED and enters the front of the lens.
    facing = (np.asarray(cos_emission) > 0) & (np.asarray(cos_incidence) > 0)
    emitted = LOBES[emitter.lobe.kind](emitter.lobe, cos_emission)
    return np.where(
        facing,
        strength_e_s_sr * emitted * cos_incidence * FALLOFF[emitter.falloff](distance_m),
        0.0,
    )


def full_strength_e_s_sr(led: LedConfig, band: Band) -> float:
    """Strength of an LED at full brightness in the chip's band: photo-electrons s^-1 sr^-1 along its normal."""
    if led.intensity_cd is not None:
        return float(led_strength_e_s_sr(led.intensity_cd, led.spectrum, band, led.fwhm_m))
    return float(
        radiant_strength_e_s_sr(
            led.radiant_intensity_w_sr or 0.0, led.spectrum, band, led.fwhm_m
        )
    )


def color_factors(led: LedConfig, band: Band, normal: Floats) -> Floats:
    """Strengths of LEDs with scattered peak wavelengths, relative to the nominal one at the same intensity.

    `normal` (N,) are standard normal numbers. The strengths are interpolated between COLORS wavelengths.
    """
    peak_m, grid_m = peaks_m(led, normal)
    strengths = [
        full_strength_e_s_sr(led.with_values(spectrum=one), band) for one in grid_m.tolist()
    ]
    return np.interp(peak_m, grid_m, strengths) / full_strength_e_s_sr(led, band)


def peaks_m(led: LedConfig, normal: Floats) -> tuple[Floats, Floats]:
    """(N,) peak wavelengths of LEDs from standard normal numbers, and COLORS wavelengths that span them."""
    assert not isinstance(led.spectrum, str)
    # Nominal peak plus scatter.
    peak_m = led.spectrum + scaled_errors(led.color_scatter_m, normal)
    return peak_m, np.linspace(peak_m.min(), peak_m.max(), COLORS)


def chromatic_of(led: LedConfig, band: Band, normal: Floats) -> Floats | None:
    """`Sources.chromatic` of LEDs with the numbers of `color_factors`; None for a lens without aberration."""
    if band.chromatic is None:
        return None
    if not led.color_scatter_m:
        return np.tile(led_chromatic(led.spectrum, band, led.fwhm_m), (len(normal), 1))
    peak_m, grid_m = peaks_m(led, normal)
    table = np.array([led_chromatic(one, band, led.fwhm_m) for one in grid_m.tolist()])
    return np.column_stack([np.interp(peak_m, grid_m, column) for column in table.T])


def strength_factors(scatter: float, normal: Floats) -> Floats:
    """Strengths of LEDs over the nominal one, from standard normal numbers.

    exp(scatter g): lognormal with this standard deviation of the logarithm, for which AFIT's Table 2 gives .07 to .09.
    For a tolerance, 1 plus an error of the tolerance's law.
    """
    if isinstance(scatter, Tolerance):
        return 1 + scaled_errors(scatter, normal)
    return np.exp(scatter * normal)


def aging_factors(aging: AgingConfig | None, normal: Floats) -> Floats:
    """Fraction of their initial light that LEDs emit after their hours of operation: exp(-a t) (IES TM-21, eq. 1).

    a = ln(1 / 0.7) / L70, times the scatter of the rates from standard normal numbers; the projection's constant B is
    1.
    """
    if aging is None:
        return np.ones(len(normal))
    # a t of an LED with the nominal rate.
    nominal = aging.hours / aging.life_hours * log(1 / LIFE_SHARE)
    return np.exp(-nominal * strength_factors(aging.scatter, normal))


def warm_up_factor(warm_up: WarmUpConfig | None, t_s: float) -> float:
    """Light of all LEDs t_s after they were switched on, relative to cold LEDs: s + (1 - s) exp(-t / tau)."""
    if warm_up is None:
        return 1.0
    return warm_up.steady + (1 - warm_up.steady) * exp(-t_s / warm_up.time_s)


class DriveInput(NamedTuple):
    """Input of a drive, (N,) each.

    Attributes
    ----------
    level
        Fraction of full brightness
    board
        Number of the board that carries the LED
    row
        Position of a pixel's row on its panel, from 0 at the top to below 1; 0 for LEDs
    """

    level: Floats
    board: Ints
    row: Floats | float = 0.0


class PulseTrains(NamedTuple):
    """Output of a drive, (N,) each: an LED is lit from start_s for on_s in every period_s, with a relative strength.

    The times are those of the LED's controller; `clock` is the number of its oscillator (`codes.Clocks`).
    """

    period_s: Floats
    start_s: Floats
    on_s: Floats
    strength: Floats
    clock: Ints


def direct(_led: LedConfig, inputs: DriveInput, _rng: Generator) -> PulseTrains:
    """Direct current: the LED is always lit, and its level scales its strength."""
    ones = np.ones(len(inputs.level))
    return PulseTrains(ones, 0 * ones, ones, inputs.level, inputs.board)


def pwm(led: LedConfig, inputs: DriveInput, rng: Generator) -> PulseTrains:
    """Hardware PWM: V_avg = D V_max, D = t_on / T (thesis, eqs 35 and 36), with T = led.pwm_period_s.

    The channels of a board have random phases and share its oscillator.
    """
    count = len(inputs.level)
    start_s = rng.uniform(0, led.pwm_period_s, count)
    on_s = inputs.level * led.pwm_period_s
    return PulseTrains(
        np.full(count, led.pwm_period_s), start_s, on_s, np.ones(count), inputs.board
    )


def sequential(led: LedConfig, inputs: DriveInput, rng: Generator) -> PulseTrains:
    """Software PWM of a controller that lights its LEDs one after another: D_i = t_on,i / sum T (thesis, eq. 37).

    Each LED of a controller has a slot T and is lit for the fraction `level` of it; the controller's cycle is the sum
    of its slots, also of those without an LED. The controllers' phases are random. The microcontroller's own delays are
    neglected, as in the thesis. Raises InputError for a controller with more LEDs than slots.
    """
    drive = led.drive
    count = len(inputs.level)
    assert isinstance(drive, SequentialConfig)
    # Number of each LED's controller.
    if drive.controller == "board":
        group = inputs.board
    elif drive.controller == "dome":
        group = np.zeros(count, dtype=np.int64)
    else:
        group = np.arange(count) // drive.controller
    _, controller, led_count = np.unique(group, return_inverse=True, return_counts=True)
    # Number the LEDs of each controller: in the stable order they are consecutive, minus the index of its first.
    order = np.argsort(controller, kind="stable")
    slot = np.empty(count)  # number of the LED's slot on its controller: 0, 1, ...
    slot[order] = np.arange(count) - np.repeat(np.cumsum(led_count) - led_count, led_count)
    if drive.slots and led_count.max() > drive.slots:
        raise InputError(
            "light.led.drive.slots",
            f"{drive.slots}",
            f"{led_count.max()} LEDs of a controller or more",
        )
    slots = np.full(len(led_count), drive.slots) if drive.slots else led_count
    cycle_s = slots * np.float64(drive.slot_s)
    start_s = rng.uniform(0, cycle_s)[controller] + slot * drive.slot_s
    return PulseTrains(
        cycle_s[controller], start_s, inputs.level * drive.slot_s, np.ones(count), controller
    )


def refresh(led: LedConfig, inputs: DriveInput, rng: Generator) -> PulseTrains:
    """A panel whose rows are lit one after another once a frame, each for duty / rate.

    A row is delayed by its position on the panel, `row` / rate. A gray level is in the strength, because the liquid
    crystal keeps its state. All pixels of a row are lit together; the panel's phase is random. The mean light is
    level * duty. Over an exposure of n + f frames, n complete, the relative flicker is
    sqrt(f (1 - f) - duty / 3) / (n + f) where duty <= f <= 1 - duty, and zero for f = 0 (reference 1.3).
    """
    drive = led.drive
    ones = np.ones(len(inputs.level))
    assert isinstance(drive, RefreshConfig)
    # One frame of the panel.
    period_s = 1 / drive.rate_hz
    return PulseTrains(
        ones * period_s,
        ones * (rng.random() + inputs.row) * period_s,
        ones * drive.duty * period_s,
        inputs.level,
        np.zeros(len(ones), dtype=np.int64),
    )


# Drives by kind: (the LED section, the drive's input, the hardware's random stream) to the pulse trains.
DRIVES: dict[str, Callable[[LedConfig, DriveInput, Generator], PulseTrains]] = {
    "direct": direct,
    "pwm": pwm,
    "sequential": sequential,
    "refresh": refresh,
}


@jit
def lit_moments_s(
    begin_s: float, end_s: float, period_s: float, start_s: float, on_s: float
) -> Any:
    """On-time of a pulse train within [begin, end] in s, its mean time, and the standard deviation about the mean.

    The train is lit from start_s for on_s in every period_s, before and after. Sums of w, w t and w (t^2 + w^2 / 12)
    over the pulses, each of width w and center t, are exact for any interval:

    1. The first and the last pulse are clipped to the interval.
    2. The n complete pulses between them have the moments of a comb, whose centers have the variance
       period^2 (n^2 - 1) / 12; each pulse adds on^2 / 12.

    Returns (0, the middle, 0) if the interval is dark.
    """
    middle = (begin_s + end_s) / 2
    if on_s >= period_s:  # always lit
        return end_s - begin_s, middle, (end_s - begin_s) / sqrt(12.0)
    # Numbers of the first and the last pulse that are lit within the interval.
    first = floor((begin_s - start_s - on_s) / period_s) + 1
    last = ceil((end_s - start_s) / period_s) - 1
    lit_s = 0.0
    sum1 = 0.0
    sum2 = 0.0
    # 1. The two pulses at the ends, or the only one. Times are taken from the middle of the interval, where the squares
    # lose the fewest digits.
    for j in range(first, last + 1, max(last - first, 1)):
        edge = max(start_s + j * period_s, begin_s)
        width = min(start_s + j * period_s + on_s, end_s) - edge
        if width > 0:
            center = edge + width / 2 - middle
            lit_s = lit_s + width
            sum1 = sum1 + width * center
            sum2 = sum2 + width * (center**2 + width**2 / 12)
    # 2. The complete pulses in between.
    n = last - first - 1
    if n > 0:
        center = start_s + (first + 1) * period_s + on_s / 2 + (n - 1) * period_s / 2 - middle
        lit_s += n * on_s
        sum1 += n * on_s * center
        sum2 += n * on_s * (center**2 + (period_s**2 * (n * n - 1) + on_s**2) / 12)
    # Mean, and variance by <t^2> - <t>^2.
    if lit_s <= 0:
        return 0.0, middle, 0.0
    mean = sum1 / lit_s
    return lit_s, middle + mean, sqrt(max(sum2 / lit_s - mean**2, 0.0))
