"""LEDs that show their names: the light of each by its word, integrated over an exposure; and the controllers' clocks.

In bit k of the code's time an LED shines with the fraction of its light that its word has there, or with that of
another level if the bit fails. The code's clock is the camera's trigger, one bit a frame, or a free-running oscillator
with offset and drift (`Clocks`). An exposure that crosses a bit's edge gets the mean of both bits by their times in
it. The drive's pulses are much faster than a bit; the code scales their light.
"""

import math
from dataclasses import replace

import numpy as np

from skysim.core.constants import HOUR_S, PPM
from skysim.core.random_streams import LED_CLOCKS, LED_CODE, LED_CODE_CLOCK, random_stream
from skysim.core.types import Floats, Sources, frozen
from skysim.core.units import scaled_errors
from skysim.scene.sections.layouts import Layout, OnPoints
from skysim.scene.sections.leds import ClockConfig, Code, DirectConfig, PwmConfig
from skysim.scene.sections.light import DomeConfig
from skysim.sources.dome.codebooks import Words, codebook, light_levels

# Clocks of the LED controllers: each times its pulses with an oscillator of its own. No two oscillators agree, and they
# are not synchronized with the camera: the phase of a pulse train wanders through the exposures, and flicker averages
# out over frames as in a laboratory. A controller's time is
#
#     tau(t) = tau_0 + (1 + y) t + d t^2 / 2
#
# with its frequency offset y (of the hardware), its drift d and the time tau_0 since it was switched on (of the run).
# This is the usual model of an oscillator over minutes (Riley 2008, NIST SP 1065, section 3.1), without its noise.


# Longest time before the run at which a controller was switched on; many times any period.
LONGEST_ON_S = HOUR_S
FILTER_STREAM = 4  # spawn key, under the hardware's seed, of the filters' errors


@frozen
class Clocks:
    """The oscillators of C controllers, (C,) each.

    Attributes
    ----------
    on_s
        tau_0, the controllers' times at t = 0
    offset
        y, relative frequency offsets at t = 0
    drift_s
        d, changes of the relative frequency per second
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
    ) -> "Clocks":
        """Draw the offsets from the hardware's seed, and drifts and switch-on times from the run's."""
        offset_ppm = scaled_errors(
            config.offset_ppm, random_stream(hardware_seed, stream).standard_normal(count)
        )
        rng = random_stream(seed, stream)
        on_s = rng.uniform(0, LONGEST_ON_S, count)
        drift_ppm_h = scaled_errors(config.drift_ppm_h, rng.standard_normal(count))
        return cls(on_s, PPM * offset_ppm, PPM / HOUR_S * drift_ppm_h)

    def lights_at(self, sources: Sources, t_s: float, exposure_s: float) -> Sources:
        """The sources with their light during an exposure about t_s.

        Without filters these are their pulse trains; filters smooth each train to its mean over the exposure. In a
        rolling shutter the ripple that a filter leaves is that of the middle row's exposure.
        """
        pulses = self.pulses_at(sources, t_s)
        if self.filter_s is None:
            return pulses
        share = filtered_share(
            pulses, self.filter_s, t_s - exposure_s / 2, t_s + exposure_s / 2
        )
        return replace(pulses, strength=share * pulses.strength, on_s=pulses.period_s)

    def pulses_at(self, sources: Sources, t_s: float) -> Sources:
        """The sources with their pulse trains in the run's time, about t_s.

        The clock's rate is taken as constant: over an exposure of T the drift displaces a pulse by d T^2 / 8 at most,
        35 ps in 1 s at 1 ppm an hour.
        """
        n = sources.clock
        rate = (1 + self.offset + self.drift_s * t_s)[n]
        tau_s = (self.on_s + t_s * (1 + self.offset + self.drift_s * t_s / 2))[n]
        # In the controller's time t_s is (tau - start) mod period after the beginning of a pulse.
        since_s = np.mod(tau_s - sources.start_s, sources.period_s)
        return replace(
            sources,
            period_s=sources.period_s / rate,
            start_s=t_s - since_s / rate,
            on_s=sources.on_s / rate,
        )


def filtered_share(pulses: Sources, filter_s: Floats, begin_s: float, end_s: float) -> Floats:
    """(N,) mean of the filters' voltages between two times; 1 for an LED that is always on.

    The low-pass filter smooths the pulses u(t), 0 or 1: its voltage has RC V' = u - V, so that its mean over an
    exposure is the pulses' mean less RC (V(end) - V(begin)) / (end - begin). In the steady state, at the time s after
    a pulse's beginning, V = 1 - (1 - V0) exp(-s / RC) while it lasts, for `on` of the period T, and decays by exp(-(s
    - on) / RC) afterwards, with V0 = (exp(-(T - on) / RC) - exp(-T / RC)) / (1 - exp(-T / RC)).
    """
    period_s = pulses.period_s
    on_s = np.minimum(pulses.on_s, pulses.period_s)
    # V0, without cancellation for short periods.
    rise = np.exp(-(period_s - on_s) / filter_s)
    first = (rise - np.exp(-period_s / filter_s)) / -np.expm1(-period_s / filter_s)

    def lit_s_and_voltage(t_s: float) -> tuple[Floats, Floats]:
        # Complete periods since the train's beginning, and the time in the present one.
        cycles, since_s = np.divmod(t_s - pulses.start_s, period_s)
        lit_s = np.minimum(since_s, on_s)
        rising = 1 - (1 - first) * np.exp(-lit_s / filter_s)
        voltage = rising * np.exp((lit_s - since_s) / filter_s)
        return cycles * on_s + lit_s, voltage

    lit0_s, voltage0 = lit_s_and_voltage(begin_s)
    lit1_s, voltage1 = lit_s_and_voltage(end_s)
    return (lit1_s - lit0_s - filter_s * (voltage1 - voltage0)) / (end_s - begin_s)


def build_clocks(light: DomeConfig, sources: Sources, seed: int) -> Clocks | None:
    """The clocks of a dome's controllers in the run of that seed; None if all light is steady."""
    if not len(sources) or isinstance(light.led.drive, DirectConfig):
        return None
    hardware = hardware_seed(light.layout)
    clocks = Clocks.draw(light.led.clock, int(sources.clock.max()) + 1, hardware, seed)
    low_pass = light.led.drive.filter if isinstance(light.led.drive, PwmConfig) else None
    if low_pass is None:
        return clocks
    normal = random_stream(hardware, FILTER_STREAM).standard_normal(len(sources))
    error = scaled_errors(low_pass.error, normal)
    return replace(clocks, filter_s=low_pass.time_constant_s * (1 + error))


def hardware_seed(layout: Layout) -> int:
    """The seed of a layout's hardware; for points on a panel or a shell the seed of the points' layout."""
    return (
        hardware_seed(layout.points) if isinstance(layout, OnPoints) else layout.hardware_seed
    )


@frozen
class LedCodes:
    """The code of a dome's LEDs in one run.

    Attributes
    ----------
    words
        (N, B) levels of the LEDs in each bit, in the order of the dome's LEDs
    clock
        The code's oscillator; None if the camera's trigger advances the code
    seed
        Seed of the run, from which the bits that fail are drawn
    """

    words: Words
    config: Code
    clock: Clocks | None
    seed: int

    def shown(
        self, sources: Sources, open_s: float, exposure_s: float, frame: int
    ) -> Sources:
        """The dome's LEDs with their mean light in the exposure of a frame."""
        level = self.mean_level(open_s, exposure_s, frame)
        return replace(sources, strength=sources.strength * level)

    def mean_level(self, open_s: float, exposure_s: float, frame: int) -> Floats:
        """(N,) mean fraction of the LEDs' light in an exposure: sum over its bits of level times share of the time."""
        if self.clock is None:
            return self.level(frame)
        bit_s = float(self.config.bit_time_s)
        # The exposure in the code's time, in bits.
        begin, end = (self.time_s(t) / bit_s for t in (open_s, open_s + exposure_s))
        bits = range(math.floor(begin), max(math.ceil(end), math.floor(begin) + 1))
        shares = [(min(k + 1, end) - max(k, begin)) / (end - begin) for k in bits]
        levels = np.array([self.level(k) for k in bits])
        return np.array(shares) @ levels

    def level(self, bit: int) -> Floats:
        """(N,) fraction of the LEDs' light in bit number `bit` of the code's time."""
        shown = self.words[:, bit % self.words.shape[1]]
        if self.config.dropout:
            rng = random_stream(self.seed, LED_CODE, bit)
            levels = int(self.words.max()) + 1
            failed = rng.random(len(shown)) < self.config.dropout
            # A failed bit shows one of the other levels at random.
            shift = rng.integers(1, levels, len(shown)) if levels > 2 else 1
            shown = (shown + failed * shift) % levels
        return light_levels(self.config, shown)

    def time_s(self, t_s: float) -> float:
        """The time of the code's clock: tau_0 + t (1 + y + d t / 2)."""
        assert self.clock is not None
        rate = self.clock.offset[0] + self.clock.drift_s[0] * t_s / 2
        return float(self.clock.on_s[0] + t_s * (1 + rate))


def build_codes(light: DomeConfig, sources: Sources, seed: int) -> LedCodes | None:
    """The code of a dome's LEDs in the run of that seed; None without one.

    Raises
    ------
    InputError
        For more LEDs than the code has words.
    """
    code = light.led.code
    if code is None:
        return None
    clock = None
    if code.bit_time_s != "frame":
        clock = Clocks.draw(
            light.led.clock, 1, hardware_seed(light.layout), seed, LED_CODE_CLOCK
        )
    return LedCodes(codebook(code, len(sources)), code, clock, seed)
