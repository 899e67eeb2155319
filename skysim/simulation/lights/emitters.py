"""What shines: LEDs or pixels of a panel, stars and the background, the Earth, satellites, Sun, Moon and planets."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property
from typing import NamedTuple

import numpy as np
from scipy.spatial.transform import Rotation

from skysim.camera.as_built import leds_at, off_center
from skysim.camera.glow.background import glow_map
from skysim.camera.glow.display_glow import black_glow
from skysim.camera.glow.earth_glow import earth_around, earth_light
from skysim.camera.render import Window
from skysim.core.errors import InputError
from skysim.core.types import Bools, Floats, Sources, StarSources, frozen, homogeneous
from skysim.scene.sections.light import (
    BodiesConfig,
    CollimatedDisplayConfig,
    DomeConfig,
    StarsConfig,
)
from skysim.scene.sections.surroundings import (
    EarthConfig,
    Glow,
    SatellitesConfig,
    ThermalConfig,
)
from skysim.simulation.lights.light import (
    AddedLight,
    Exposure,
    KnownLight,
    Light,
    LightPlan,
    Lit,
    Obstacle,
    Occluder,
)
from skysim.sources import dome, stars
from skysim.sources.bodies import bodies_from
from skysim.sources.camera_orbit import hidden_by_earth, sun_m
from skysim.sources.dome import display
from skysim.sources.dome.codes import Clocks, LedCodes, build_clocks, build_codes
from skysim.sources.dome.led import Emitter, warm_up_factor
from skysim.sources.ephemeris import GcrsState
from skysim.sources.orbit_elements import MeanElements
from skysim.sources.satellites import (
    MovingLight,
    as_sources,
    known_satellites,
    random_satellites,
)

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
            self._timing[seed] = LedTiming(
                build_clocks(self.config, self.sources, seed),
                build_codes(self.config, self.sources, seed),
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


# Stars of a catalog, as seen from the ground or from an orbit.


@frozen
class StarsInOrbit(KnownLight):
    """Stars displaced by the aberration of an orbit, whose velocity turns by a degree in 15 s in a low orbit.

    Attributes
    ----------
    velocity_m_s
        (3,) barycentric velocity at which `sources` are the apparent places
    """

    velocity_m_s: Floats

    def during(self, exposure: Exposure) -> Lit:
        """The stars near the field at the velocity of mid-exposure; in a second the aberration changes by 0.006"."""
        view = exposure.view
        # A margin for the corners of the field, and the rotation during the exposure.
        reach_rad = 1.25 * view.field_rad + 0.02 + view.turn_rad
        assert isinstance(self.sources, StarSources)
        near = self.sources.take(self.sources.within(view.boresight, reach_rad))
        now_m_s = 1e3 * exposure.observer.velocity_km_s
        direction = stars.seen_at_velocity(near.xyz, self.velocity_m_s, now_m_s)
        place = homogeneous(direction, 0.0)
        return Lit("stars", True, replace(near, place=place), self.emitter)


def stars_of(config: StarsConfig, plan: LightPlan) -> KnownLight:
    """The stars of a scene at its start, in the lab's axes, which are those of the ICRS.

    Raises InputError if variability is on and the catalog has no variable stars.
    """
    catalog = plan.catalog
    scene = plan.scene
    viewpoint = plan.viewpoint
    assert catalog is not None
    if config.variability_seed is not None:
        if not catalog.scatter_mag.any():
            raise InputError(
                "light.variability_seed",
                f"{config.catalog} has no variable stars",
                "gaia_v8.0",
            )
        catalog = stars.varied(catalog, config.variability_seed)
    # If other parts of the scene depend on the camera's place, the aberration by its velocity is included as well.
    velocity_m_s: Floats | tuple[float, ...] = stars.AT_REST
    if config.bodies or config.satellites or config.air or viewpoint.orbit:
        velocity_m_s = viewpoint.state_at(0.0).velocity_m_s
    shown = stars.sources(
        catalog,
        scene.start_time,
        config.limit_mag,
        Rotation.identity(),
        plan.band,
        velocity_m_s,
    )
    if viewpoint.orbit is None:
        return KnownLight(shown, Emitter())
    return StarsInOrbit(shown, Emitter(), 1e3 * viewpoint.observer_at(0.0).velocity_km_s)


# The scene's section `background`: light leaks and the glow of the sky.

BACKGROUND = "background"


@frozen
class BackgroundLight(AddedLight):
    """Extended light that does not change from frame to frame."""

    glows: tuple[Glow, ...]

    def during(self, exposure: Exposure) -> Lit:
        if not self.glows:
            return Lit(BACKGROUND)
        return Lit(BACKGROUND, glow=lambda: glow_map(self.glows, exposure.camera))


# The Earth under a camera in orbit: it hides stars, and its day side and its air shine.

NAME = "the Earth"


@frozen
class Earth(Obstacle):
    """The Earth, which hides stars one by one and bodies as a whole, and shines if it has a section `earth`."""

    config: EarthConfig | None

    def during(self, exposure: Exposure) -> Lit:
        here = exposure.observer
        position_m = here.from_earth.position_m

        def hides(place: Floats) -> Bools:
            return hidden_by_earth(position_m, place[:, :3]) & (place[:, 3] == 0)

        dark = Lit(NAME, hides=Occluder(NAME, hides, whole=True))
        if self.config is None:
            return dark
        seen_from = (self.config, position_m, sun_m(here.tt_jd))
        camera = exposure.camera
        return dark._replace(
            edged=lambda: earth_light(*seen_from, camera),
            around=lambda: earth_around(*seen_from, camera.band),
        )


# Artificial satellites: those of a file, and random ones.


@frozen
class Satellites(AddedLight):
    """Artificial satellites that can cross the field: those of a file, then random ones.

    Attributes
    ----------
    config
        The scene's section `light.satellites`
    elements
        Orbital elements of the file; empty without a file
    """

    config: SatellitesConfig
    elements: Sequence[MeanElements]

    def during(self, exposure: Exposure) -> Lit:
        """The satellites in the exposure; in the expectation, without seeds, there are no random ones."""

        def observer_at(after_s: float) -> GcrsState:
            """The camera's state at a time after mid-exposure."""
            return exposure.viewpoint.state_at(exposure.t_s + after_s)

        found: list[MovingLight] = []
        if self.elements:
            found += known_satellites(
                self.elements,
                self.config.standard_mag,
                exposure.view,
                exposure.time,
                observer_at,
            )
        if self.config.random and exposure.seeds:
            found += random_satellites(
                self.config.random, exposure.view, exposure.seeds.camera, exposure.index
            )
        points = as_sources(found, exposure.band) if found else None
        return Lit(
            "satellites", points=points, satellites=tuple(light.truth for light in found)
        )


# Sun, Moon and planets.


@frozen
class SolarSystem(Light):
    """The bodies that `light.bodies` selects, as seen from the camera's place."""

    config: BodiesConfig

    def during(self, exposure: Exposure) -> Lit:
        bodies = bodies_from(self.config, exposure.observer, exposure.band)
        return Lit("Sun, Moon and planets", discs=tuple(bodies))
