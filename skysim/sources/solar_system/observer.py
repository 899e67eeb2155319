"""Time scales, and where the observer is: at the Earth's center or at a site on the turning Earth."""

from __future__ import annotations

import datetime
from functools import lru_cache
from typing import Any, NamedTuple

import erfa
import numpy as np

from skysim.core.quantities.utc import in_utc
from skysim.core.types import Floats
from skysim.scene.sections.vehicle import SiteConfig
from skysim.sources.solar_system.ephemeris import load_ephemeris

WGS84 = 1  # ERFA's number of the reference ellipsoid
DAY_S = 86400.0
TT_MINUS_TAI_S = 32.184
J2000 = datetime.datetime(2000, 1, 1, 12)
JD_2000 = 2451545.0


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


def tt_jd(time: datetime.datetime) -> float:
    """Terrestrial Time as a Julian date; TDB is within 2 ms, in which the Moon moves by 0.001"."""
    return utc_jd(time) + (tai_minus_utc_s(time) + TT_MINUS_TAI_S) / DAY_S


def utc_jd(time: datetime.datetime) -> float:
    """UTC as a Julian date."""
    return JD_2000 + (in_utc(time) - J2000) / datetime.timedelta(days=1)


def tai_minus_utc_s(time: datetime.datetime) -> float:
    """Leap seconds: TAI - UTC by ERFA's table, whose last value holds from then on."""
    table, moment = leap_seconds(), in_utc(time)
    since = np.searchsorted(table["year"] * 12 + table["month"], moment.year * 12 + moment.month, side="right")
    return float(table["tai_utc"][since - 1])


@lru_cache(maxsize=1)
def leap_seconds() -> Any:
    """ERFA's table of leap seconds: year, month, tai_utc."""
    return erfa.leap_seconds.get()


def ut1_jd(time: datetime.datetime) -> float:
    """The Earth's rotation as a Julian date, from the table of the IERS that comes with astropy; UTC outside of it.

    A second of time is 0.24" of the Moon's place; beyond the table UT1 - UTC is below 0.9 s by definition of UTC.
    """
    mjd, ut1_minus_utc_s = ut1_table()
    utc = utc_jd(time)
    return utc + float(np.interp(utc - erfa.DJM0, mjd, ut1_minus_utc_s, left=0.0, right=0.0)) / DAY_S


@lru_cache(maxsize=1)
def ut1_table() -> tuple[Floats, Floats]:
    """Modified Julian dates (UTC) and UT1 - UTC in s; between two days a leap second would be interpolated."""
    from astropy.utils import iers

    table = iers.IERS_B.open()
    return np.asarray(table["MJD"].value), np.asarray(table["UT1_UTC"].value)


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
    velocity_km_s = erfa.epv00(tt, 0.0)[1]["v"] * (erfa.DAU / 1e3 / DAY_S)
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
