"""Known lights: the LEDs of a dome or pixels of a panel, the stars of a collimated display, and stars of the sky."""

from collections.abc import Callable
from dataclasses import dataclass, field, replace
from functools import cached_property
from typing import NamedTuple

import numpy as np

from skysim.camera.as_built import leds_at, off_center
from skysim.camera.glow.display_glow import black_glow
from skysim.camera.render import Window
from skysim.core.types import Floats, Sources
from skysim.scene.sections.light import CollimatedDisplayConfig, DomeConfig, StarsConfig
from skysim.scene.sections.surroundings import ThermalConfig
from skysim.simulation.lights.light import Exposure, KnownLight, LightPlan, Lit
from skysim.simulation.lights.starlight import stars_of
from skysim.sources import dome
from skysim.sources.dome import display
from skysim.sources.dome.codes import Clocks, LedCodes, build_clocks, build_codes
from skysim.sources.dome.led import Emitter, warm_up_factor

MAX_RUNS = 4  # number of runs whose timing is cached


class LedTiming(NamedTuple):
    """The timing of the LEDs in one run.

    Attributes
    ----------
    clocks
        Oscillators of the LED controllers; None if all light is steady
    codes
        Code words of the LEDs and the clock of their bits; None without light.led.code
    """

    clocks: Clocks | None
    codes: LedCodes | None


@dataclass(frozen=True)
class LedDome(KnownLight):
    """The LEDs of a dome, with warm-up, thermal motion, and the pulses and codes of their controllers.

    Attributes
    ----------
    config
        The scene's section `light`
    thermal
        Thermal motion since the survey; None if there is none
    """

    config: DomeConfig
    thermal: ThermalConfig | None
    _timing: dict[int, LedTiming] = field(init=False, repr=False, default_factory=dict)

    @cached_property
    def dies(self) -> Sources:
        """The LEDs with their light beside the surveyed centers of their windows."""
        die_m = np.array(self.config.led.die_m)
        return off_center(self.sources, die_m) if die_m.any() else self.sources

    def during(self, exposure: Exposure) -> Lit:
        """The LEDs and the light of black pixels. Without seeds the LEDs are lit for their share of the time.

        1. Warm-up reduces the strength of all LEDs.
        2. Temperature moves them.
        3. Pulses and codes of this run set their on-times.
        """
        # 1. Warm-up.
        left = warm_up_factor(self.config.led.warm_up, exposure.t_s)
        leds = self.dies
        if left < 1:
            leds = replace(leds, strength=left * leds.strength)
        # 2. Thermal motion.
        if self.thermal is not None:
            leds = leds_at(self.thermal, leds, exposure.t_s)
        # 3. Pulses and codes.
        if exposure.seeds is not None:
            leds = self.pulsed(
                leds, exposure.seeds.run, exposure.index, exposure.window, exposure.t_s
            )
        return Lit(
            "LEDs", True, leds, self.emitter, edged=black_pixels(self.config, exposure, left)
        )

    def pulsed(
        self, leds: Sources, seed: int, index: int, window: Window, middle_s: float
    ) -> Sources:
        """The LEDs with their pulses and codes in a frame of the run with this seed; middle_s is mid-exposure."""
        timing = self.timing(seed)
        if timing.clocks:
            leds = timing.clocks.lights_at(leds, middle_s, window.exposure_s)
        if timing.codes:
            leds = timing.codes.shown(leds, window.open_s, window.exposure_s, index)
        return leds

    def timing(self, seed: int) -> LedTiming:
        """The timing in the run with this seed, which is drawn once and cached."""
        if seed not in self._timing:
            while len(self._timing) >= MAX_RUNS:
                self._timing.pop(next(iter(self._timing)))
            clocks = build_clocks(self.config, self.sources, seed)
            self._timing[seed] = LedTiming(
                clocks, build_codes(self.config, self.sources, seed)
            )
        return self._timing[seed]


@dataclass(frozen=True)
class CollimatedDisplay(KnownLight):
    """The stars on a display behind a collimator, and the light of its black pixels."""

    config: CollimatedDisplayConfig

    def during(self, exposure: Exposure) -> Lit:
        return super().during(exposure)._replace(edged=black_pixels(self.config, exposure))


def black_pixels(
    config: DomeConfig | CollimatedDisplayConfig, exposure: Exposure, share: float = 1.0
) -> Callable[[], Floats | None]:
    """The light of a display's black pixels, of which a share is left; none without a display or if black is dark."""

    def e_s() -> Floats | None:
        glow = black_glow(config, exposure.camera)
        return None if glow is None else share * glow

    return e_s


def known_light(plan: LightPlan) -> KnownLight:
    """The light of the scene's section `light`, at the scene's start; that of the plan if it has one.

    Raises InputError for LEDs off the surface, and for a dome that does not fit its room.
    """
    scene = plan.scene
    light = scene.light
    if plan.known:
        return plan.known
    if isinstance(light, DomeConfig):
        leds = dome.sources(light, plan.band)
        return LedDome(leds, Emitter.from_config(light.led), light, scene.thermal)
    assert plan.catalog is not None
    if isinstance(light, StarsConfig):
        return stars_of(light, plan)
    shown = display.display_sources(light, plan.catalog, scene.start_time, plan.band)
    return CollimatedDisplay(shown, Emitter(), light)
