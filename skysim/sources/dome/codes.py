"""LEDs that show their names: the light of each by its word, integrated over an exposure.

In bit k of the code's time an LED shines with the part of its light that its word has there, or with that of another
level if the bit fails. The code's clock is the camera's trigger, one bit a frame, or a free-running oscillator with
offset and drift (`clocks`). An exposure that crosses a bit's edge gets the mean of both bits by their times in it. The
drive's pulses are much faster than a bit; the code scales their light.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace

import numpy as np

from skysim.core.constants import HOUR_S, PPM
from skysim.core.random_streams import LED_CLOCKS, LED_CODE, LED_CODE_CLOCK, random_stream
from skysim.core.tolerance import scaled_errors
from skysim.core.types import Floats, Sources
from skysim.scene.sections.layouts import Layout, OnPoints
from skysim.scene.sections.leds import ClockConfig, Code, DirectConfig, PwmConfig
from skysim.scene.sections.light import DomeConfig, Light
from skysim.sources.dome.codebooks import Words, codebook, light_levels

# Clocks of the LED controllers: each times its pulses with an oscillator of its own.


# A controller was switched on up to so long before the run; many times any period.
LONGEST_ON_S = HOUR_S
FILTER_STREAM = 4  # spawn key, under the hardware's seed, of the filters' errors


@dataclass(frozen=True, slots=True)
class Clocks:
    """The oscillators of C controllers, (C,) each.

    Attributes
    ----------
    on_s
        tau_0, controller's time at t = 0
    offset
        Y, relative frequency offset at t = 0
    drift_s
        D, change of the relative frequency per second
    filter_s
        (N,) time constants of the LEDs' low-pass filters; None without them
    """

    on_s: Floats
    offset: Floats
    drift_s: Floats
    filter_s: Floats | None = None

    @classmethod
    def draw(
        cls,
        config: ClockConfig,
        count: int,
        hardware_seed: int,
        seed: int,
        stream: int = LED_CLOCKS,
    ) -> Clocks:
        """Draw the offsets from the hardware's seed, drifts and switch-on times from the run's."""
        offset_ppm = scaled_errors(
            config.offset_ppm, random_stream(hardware_seed, stream).standard_normal(count)
        )
        rng = random_stream(seed, stream)
        on_s = rng.uniform(0, LONGEST_ON_S, count)
        drift_ppm_h = scaled_errors(config.drift_ppm_h, rng.standard_normal(count))
        return cls(on_s, PPM * offset_ppm, PPM / HOUR_S * drift_ppm_h)

    def lights_at(self, sources: Sources, t_s: float, exposure_s: float) -> Sources:
        """The sources with their pulse trains about t_s, or as their filters smooth them over an exposure about it.

        In a rolling shutter the ripple that a filter leaves is that of the middle row's exposure.
        """
        pulses = self.pulses_at(sources, t_s)
        if self.filter_s is None:
            return pulses
        share = filtered_share(pulses, self.filter_s, t_s - exposure_s / 2, t_s + exposure_s / 2)
        return replace(pulses, strength=share * pulses.strength, on_s=pulses.period_s)

    def pulses_at(self, sources: Sources, t_s: float) -> Sources:
        """The sources with their pulse trains in the run's time, about t_s.

        The clock's rate is taken as constant: over an exposure of T the drift displaces a pulse by d T^2 / 8 at most,
        35 ps in 1 s at 1 ppm an hour.
        """
        n = sources.clock
        rate = (1 + self.offset + self.drift_s * t_s)[n]
        tau_s = (self.on_s + t_s * (1 + self.offset + self.drift_s * t_s / 2))[n]
        # In the controller's time t_s lies (tau - start) mod period after the beginning of a pulse.
        since_s = np.mod(tau_s - sources.start_s, sources.period_s)
        return replace(
            sources,
            period_s=sources.period_s / rate,
            start_s=t_s - since_s / rate,
            on_s=sources.on_s / rate,
        )


def filtered_share(pulses: Sources, filter_s: Floats, begin_s: float, end_s: float) -> Floats:
    """(N,) mean of the filters' voltages, 1 if always on, from begin to end."""
    period_s = pulses.period_s
    on_s = np.minimum(pulses.on_s, pulses.period_s)
    rise = np.exp(-(period_s - on_s) / filter_s)
    first = (rise - np.exp(-period_s / filter_s)) / -np.expm1(-period_s / filter_s)

    def lit_s_and_voltage(t_s: float) -> tuple[Floats, Floats]:
        cycles, since_s = np.divmod(t_s - pulses.start_s, period_s)
        lit_s = np.minimum(since_s, on_s)
        voltage = (1 - (1 - first) * np.exp(-lit_s / filter_s)) * np.exp(
            (lit_s - since_s) / filter_s
        )
        return cycles * on_s + lit_s, voltage

    (lit0_s, voltage0), (lit1_s, voltage1) = lit_s_and_voltage(begin_s), lit_s_and_voltage(end_s)
    return np.asarray((lit1_s - lit0_s - filter_s * (voltage1 - voltage0)) / (end_s - begin_s))


def build_clocks(light: Light, sources: Sources, seed: int) -> Clocks | None:
    """The clocks of a dome's controllers in the run of that seed; None where all light is steady."""
    if (
        not isinstance(light, DomeConfig)
        or isinstance(light.led.drive, DirectConfig)
        or not len(sources)
    ):
        return None
    hardware = hardware_seed(light.layout)
    clocks = Clocks.draw(light.led.clock, int(sources.clock.max()) + 1, hardware, seed)
    low_pass = light.led.drive.filter if isinstance(light.led.drive, PwmConfig) else None
    if low_pass is None:
        return clocks
    normal = random_stream(hardware, FILTER_STREAM).standard_normal(len(sources))
    return replace(
        clocks, filter_s=low_pass.time_constant_s * (1 + scaled_errors(low_pass.error, normal))
    )


def hardware_seed(layout: Layout) -> int:
    """The seed of a layout's hardware; a panel's or a shell's is that of the points on it."""
    return hardware_seed(layout.points) if isinstance(layout, OnPoints) else layout.hardware_seed


@dataclass(frozen=True, slots=True)
class LedCodes:
    """The code of a dome's LEDs in one run.

    Attributes
    ----------
    words
        (N, B) levels, in the order of the dome's LEDs
    clock
        One oscillator; None if the camera's trigger advances the code
    seed
        Of the run, which draws the bits that fail
    """

    words: Words
    config: Code
    clock: Clocks | None
    seed: int

    def shown(self, sources: Sources, open_s: float, exposure_s: float, frame: int) -> Sources:
        """The dome's LEDs with their mean light in the exposure of a frame."""
        return replace(
            sources, strength=sources.strength * self.mean_level(open_s, exposure_s, frame)
        )

    def mean_level(self, open_s: float, exposure_s: float, frame: int) -> Floats:
        """(N,) mean part of their light in an exposure: sum over its bits of level and share of the time."""
        if self.clock is None:
            return self.level(frame)
        bit_s = float(self.config.bit_time_s)
        begin, end = (self.time_s(t) / bit_s for t in (open_s, open_s + exposure_s))
        bits = range(math.floor(begin), max(math.ceil(end), math.floor(begin) + 1))
        shares = [(min(k + 1, end) - max(k, begin)) / (end - begin) for k in bits]
        levels = np.array([self.level(k) for k in bits])
        return np.array(shares) @ levels

    def level(self, bit: int) -> Floats:
        """(N,) part of their light in bit number `bit` of the code's time."""
        shown = self.words[:, bit % self.words.shape[1]]
        if self.config.dropout:
            rng = random_stream(self.seed, LED_CODE, bit)
            levels = int(self.words.max()) + 1
            failed = rng.random(len(shown)) < self.config.dropout
            shown = (
                shown + failed * (rng.integers(1, levels, len(shown)) if levels > 2 else 1)
            ) % levels
        return light_levels(self.config, shown)

    def time_s(self, t_s: float) -> float:
        """The code clock's time."""
        assert self.clock is not None
        rate = self.clock.offset[0] + self.clock.drift_s[0] * t_s / 2
        return float(self.clock.on_s[0] + t_s * (1 + rate))


def build_codes(light: Light, sources: Sources, seed: int) -> LedCodes | None:
    """The code of a dome's LEDs in the run of that seed; None without one. Raises InputError for too many LEDs."""
    if not isinstance(light, DomeConfig) or light.led.code is None:
        return None
    code = light.led.code
    clock = (
        None
        if code.bit_time_s == "frame"
        else Clocks.draw(light.led.clock, 1, hardware_seed(light.layout), seed, LED_CODE_CLOCK)
    )
    return LedCodes(codebook(code, len(sources)), code, clock, seed)
