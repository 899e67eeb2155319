"""Where a scene's camera is, on the turning Earth or in its orbit, at any time."""

from __future__ import annotations

import datetime
from dataclasses import dataclass

from skysim.core.time import tt_jd
from skysim.scene.sections.vehicle import SiteConfig
from skysim.sources.orbit.camera_orbit import CameraOrbit, state_at
from skysim.sources.solar_system.observer import GcrsState, Observer, observe_at, site_in_gcrs


@dataclass(frozen=True, slots=True)
class Viewpoint:
    """The camera's place from the scene's start on.

    start : UTC at t = 0
    site  : on the ground; a site without a longitude is the Earth's center
    orbit : None on the ground
    """

    start: datetime.datetime
    site: SiteConfig
    orbit: CameraOrbit | None = None

    def time_at(self, t_s: float) -> datetime.datetime:
        """UTC at a time since the start."""
        return self.start + datetime.timedelta(seconds=t_s)

    def state_at(self, t_s: float) -> GcrsState:
        """The state from the Earth's center at a time since the start: in the orbit, else at the site."""
        if self.orbit:
            return state_at(self.orbit, t_s)
        time = self.time_at(t_s)
        return site_in_gcrs(time, tt_jd(time), self.site)

    def observer_at(self, t_s: float) -> Observer:
        """The state among the bodies of the solar system at a time since the start."""
        return observe_at(self.time_at(t_s), self.state_at(t_s))
