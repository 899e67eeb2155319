"""Where the observer is: at the Earth's center or at a site on the turning Earth."""

from __future__ import annotations

import datetime
from typing import NamedTuple

import erfa
import numpy as np

from skysim.core.constants import AU_KM, DAY_S
from skysim.core.time import tt_jd, ut1_jd
from skysim.core.types import Floats
from skysim.scene.sections.vehicle import SiteConfig
from skysim.sources.solar_system.ephemeris import load_ephemeris


class GcrsState(NamedTuple):
    """(3,) position in m and velocity in m/s from the Earth's center, GCRS axes."""

    position_m: Floats
    velocity_m_s: Floats


class Observer(NamedTuple):
    """Barycentric position in km and velocity in km/s, ICRS axes (3,); from_earth: the same from the Earth's center."""

    tt_jd: float
    position_km: Floats
    velocity_km_s: Floats
    from_earth: GcrsState


def observe_from(time: datetime.datetime, site: SiteConfig) -> Observer:
    """The observer at a time: at the site if it has a longitude, else at the Earth's center.

    A site's place is that of WGS 84, turned by UT1 and by precession and nutation of IAU 2006/2000A (`erfa.pvtob`,
    `erfa.c2i06a`). Polar motion (0.3", which moves the Moon by 0.005") is neglected. Source: IERS Conventions 2010,
    chapter 5.
    """
    return observe_at(time, site_in_gcrs(time, tt_jd(time), site))


def observe_at(time: datetime.datetime, from_earth: GcrsState) -> Observer:
    """The observer at a time in this state from the Earth's center.

    The Earth's position is the ephemeris's, its velocity `erfa.epv00`'s (5 mm/s), as for the stars.
    """
    tt = tt_jd(time)
    velocity_km_s = erfa.epv00(tt, 0.0)[1]["v"] * (AU_KM / DAY_S)
    position_km = load_ephemeris().position_km("earth", tt) + from_earth.position_m / 1e3
    return Observer(tt, position_km, velocity_km_s + from_earth.velocity_m_s / 1e3, from_earth)


def site_in_gcrs(time: datetime.datetime, tt: float, site: SiteConfig) -> GcrsState:
    """The state of a site; zeros for one without longitude."""
    if site.longitude_deg is None:
        return GcrsState(np.zeros(3), np.zeros(3))
    longitude_rad, latitude_rad = np.radians([site.longitude_deg, site.latitude_deg])
    theta_rad = erfa.era00(ut1_jd(time), 0.0)
    state = erfa.pvtob(longitude_rad, latitude_rad, site.height_m, 0.0, 0.0, 0.0, theta_rad)
    gcrs_from_cirs = erfa.c2i06a(tt, 0.0).T
    return GcrsState(gcrs_from_cirs @ state["p"], gcrs_from_cirs @ state["v"])
