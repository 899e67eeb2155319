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

from skysim.core.random_streams import LED_CODE, LED_CODE_CLOCK, random_stream
from skysim.core.types import Floats, Sources
from skysim.scene.sections.leds import Code
from skysim.scene.sections.light import DomeConfig, Light
from skysim.sources.dome.timing.clocks import Clocks, hardware_seed
from skysim.sources.dome.timing.codebooks import Words, codebook, light_levels


@dataclass(frozen=True, slots=True)
class LedCodes:
    """The code of a dome's LEDs in one run.

    words  : (N, B) levels, in the order of the dome's LEDs
    clock  : one oscillator; None if the camera's trigger advances the code
    seed   : of the run, which draws the bits that fail
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
