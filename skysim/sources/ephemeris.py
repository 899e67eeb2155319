"""The solar system: barycentric positions, the observer's place, and apparent places of Sun, Moon, planets and others.

Positions are Chebyshev series fitted to JPL's DE423, of Ceres and Vesta to JPL's SB441-N16, made by
`data/ephemeris/build.py`. They are within 0.005" of them as seen from the Earth, over 1972 to 2100. Jupiter's moons are
sums of vibrations, within 0.3" of JPL's JUP365.
"""

import datetime
from functools import lru_cache
from typing import NamedTuple

import erfa
import numpy as np

from skysim.core.constants import AU_KM, DAY_S, EARTH_RATE_RAD_S, SPEED_OF_LIGHT_KM_S
from skysim.core.paths import DATA
from skysim.core.time import tt_jd, ut1_jd
from skysim.core.types import Array, Floats
from skysim.scene.sections.vehicle import SiteConfig

EPHEMERIS = DATA / "ephemeris" / "bodies.npz"
GALILEAN = ("io", "europa", "ganymede", "callisto")
# Bodies whose position is given from another one.
CENTERS = {"moon": "earth"} | dict.fromkeys(GALILEAN, "jupiter")


class ChebyshevSeries(NamedTuple):
    """The series of one body.

    Attributes
    ----------
    days
        Length of an interval; the first begins at the file's first day
    unit_km
        Unit of the coefficients
    coefficients
        (count, 3, intervals) Chebyshev coefficients of x, y, z
    """

    days: float
    unit_km: float
    coefficients: Array[np.int32]


class Ephemeris(NamedTuple):
    """The series of all bodies, from first_jd (TDB) on, and the ratio of the Earth's mass to the Moon's.

    Attributes
    ----------
    moons_rad_day, moons_km
        (4, K) rates and (4, K, 3) complex amplitudes of the vibrations of Jupiter's moons
    """

    first_jd: float
    earth_moon_ratio: float
    series: dict[str, ChebyshevSeries]
    moons_rad_day: Floats
    moons_km: Array

    def position_km(self, name: str, tdb_jd: float) -> Floats:
        """(3,) position in km, ICRS axes: from the solar system's barycenter, or from the body that CENTERS gives.

        x(t) = sum_k c_k T_k(s), with s from -1 to 1 over the interval. The outer planets' places are their systems'
        barycenters: Jupiter and Saturn are up to 0.07" from them. Jupiter's moons, whose orbits perturb each other
        quasi-periodically, are at x(t) = Re sum_k c_k exp(i w_k t), fitted to the theory L1.2 (Lainey, Duriez & Vienne
        2006, A&A 456, 783).
        """
        if name in GALILEAN:
            moon = GALILEAN.index(name)
            turned = np.exp(1j * self.moons_rad_day[moon] * (tdb_jd - self.first_jd))
            return (turned @ self.moons_km[moon]).real
        if name == "earth":
            # The Earth is opposite to the Moon about their barycenter.
            to_moon_km = self.position_km("moon", tdb_jd)
            return self.position_km("earth_moon", tdb_jd) - to_moon_km / (
                1 + self.earth_moon_ratio
            )
        series = self.series[name]
        interval, offset_days = divmod(tdb_jd - self.first_jd, series.days)
        coefficients = series.coefficients[:, :, int(interval)] * series.unit_km
        # T_k(x) = cos(k arccos x)
        angle = np.arccos(2 * offset_days / series.days - 1)
        return np.cos(angle * np.arange(len(coefficients))) @ coefficients

    def barycentric_km(self, name: str, tdb_jd: float) -> Floats:
        """(3,) position in km from the solar system's barycenter, for moons too."""
        position_km = self.position_km(name, tdb_jd)
        center = CENTERS.get(name)
        return position_km + self.position_km(center, tdb_jd) if center else position_km


@lru_cache(maxsize=1)
def load_ephemeris() -> Ephemeris:
    """The ephemeris that is shipped with skysim."""
    with np.load(EPHEMERIS, allow_pickle=False) as arrays:
        names = [
            name.removesuffix("_days") for name in arrays.files if name.endswith("_days")
        ]
        series = {
            name: ChebyshevSeries(
                float(arrays[f"{name}_days"]), float(arrays[f"{name}_unit_km"]), arrays[name]
            )
            for name in names
        }
        return Ephemeris(
            float(arrays["first_jd"]),
            float(arrays["earth_moon_ratio"]),
            series,
            arrays["moons_rad_day"],
            arrays["moons_km"],
        )


# The observer: at the Earth's center or at a site on the turning Earth.


class GcrsState(NamedTuple):
    """(3,) position in m and velocity in m/s from the Earth's center, GCRS axes."""

    position_m: Floats
    velocity_m_s: Floats


class ObserverPlace(NamedTuple):
    """The observer among the bodies of the solar system.

    Attributes
    ----------
    position_km, velocity_km_s
        (3,) barycentric, ICRS axes
    from_earth
        State from the Earth's center
    """

    tt_jd: float
    position_km: Floats
    velocity_km_s: Floats
    from_earth: GcrsState


def observe_from(time: datetime.datetime, site: SiteConfig) -> ObserverPlace:
    """The observer at a time: at the site if it has a longitude, else at the Earth's center.

    A site's place is that of WGS 84, turned by UT1 and by precession and nutation of IAU 2006/2000A (`erfa.pvtob`,
    `erfa.c2i06a`). Polar motion (0.3", which moves the Moon by 0.005") is neglected. Source: IERS Conventions 2010,
    chapter 5.
    """
    return observe_at(time, site_in_gcrs(time, tt_jd(time), site))


def observe_at(time: datetime.datetime, from_earth: GcrsState) -> ObserverPlace:
    """The observer at a time, for its state from the Earth's center.

    The Earth's position is the ephemeris's, its velocity that of `erfa.epv00` (5 mm/s), as for the stars.
    """
    tt = tt_jd(time)
    velocity_km_s = erfa.epv00(tt, 0.0)[1]["v"] * (AU_KM / DAY_S)
    position_km = load_ephemeris().position_km("earth", tt) + from_earth.position_m / 1e3
    return ObserverPlace(
        tt, position_km, velocity_km_s + from_earth.velocity_m_s / 1e3, from_earth
    )


def site_in_gcrs(time: datetime.datetime, tt: float, site: SiteConfig) -> GcrsState:
    """The state of a site from the Earth's center; zeros for a site without longitude (see `observe_from`)."""
    if site.longitude_deg is None:
        return GcrsState(np.zeros(3), np.zeros(3))
    longitude_rad, latitude_rad = np.radians([site.longitude_deg, site.latitude_deg])
    # On the turning Earth, then to GCRS axes by precession and nutation.
    theta_rad = erfa.era00(ut1_jd(time), 0.0)
    state = erfa.pvtob(longitude_rad, latitude_rad, site.height_m, 0.0, 0.0, 0.0, theta_rad)
    gcrs_from_cirs = erfa.c2i06a(tt, 0.0).T
    return GcrsState(gcrs_from_cirs @ state["p"], gcrs_from_cirs @ state["v"])


def earth_rate_rad_s(time: datetime.datetime) -> Floats:
    """(3,) rate of the Earth, ICRS axes: about the pole of the date (IAU 2006/2000A; no polar motion)."""
    pole = erfa.c2i06a(tt_jd(time), 0.0)[2]
    return EARTH_RATE_RAD_S * pole


# Apparent places of the bodies, with distances and the geometry of their light.


# Of `erfa.ld`: within 3' of the Sun's center its deflection is reduced
DEFLECTION_LIMIT = 1e-6


class Place(NamedTuple):
    """One body as seen by the observer, ICRS axes.

    Attributes
    ----------
    direction
        (3,) apparent unit vector, with aberration
    from_sun_km
        (3,) vector from the Sun to the body, when the light left it
    to_body_km
        (3,) vector from the observer to the body (astrometric: with light time, without aberration)
    phase_rad
        Angle at the body between the Sun and the observer
    toward_sun
        (3,) unit vector perpendicular to `direction`, toward the Sun as seen from the body: the direction of the bright
        limb
    """

    direction: Floats
    from_sun_km: Floats
    to_body_km: Floats
    phase_rad: float
    toward_sun: Floats

    @property
    def distance_km(self) -> float:
        return float(np.linalg.norm(self.to_body_km))

    @property
    def sun_distance_km(self) -> float:
        return float(np.linalg.norm(self.from_sun_km))


def place(name: str, observer: ObserverPlace) -> Place:
    """Apparent place of a body.

    1. Light time: the body is where it was when the light left it (iterated to 1 km).
    2. The Sun deflects the light of bodies behind it (`erfa.ld`, up to 1.7" at its limb).
    3. Aberration: the observer's velocity displaces all directions (`erfa.ab`).

    Neglected: deflection by the planets (0.02" at Jupiter's limb), and the outer planets' displacement from their
    systems' barycenters. Source: IERS Conventions 2010, chapter 7; Urban & Seidelmann (2013), ch. 7.
    """
    ephemeris = load_ephemeris()
    # 1. Light time.
    delay_s = 0.0
    for _ in range(3):
        left_jd = observer.tt_jd - delay_s / DAY_S
        to_body_km = ephemeris.barycentric_km(name, left_jd) - observer.position_km
        delay_s = float(np.linalg.norm(to_body_km)) / SPEED_OF_LIGHT_KM_S
    sun_km = ephemeris.position_km("sun", left_jd)
    from_sun_km = to_body_km + observer.position_km - sun_km
    # 2. Deflection.
    astrometric = to_body_km / np.linalg.norm(to_body_km)
    sun_to_observer_km = observer.position_km - sun_km
    sun_km_away = float(np.linalg.norm(sun_to_observer_km))
    deflected = astrometric
    if name != "sun":
        body_from_sun = from_sun_km / np.linalg.norm(from_sun_km)
        au = sun_km_away / AU_KM
        deflected = erfa.ld(
            1.0,
            astrometric,
            body_from_sun,
            sun_to_observer_km / sun_km_away,
            au,
            DEFLECTION_LIMIT,
        )
    # 3. Aberration.
    beta = observer.velocity_km_s / SPEED_OF_LIGHT_KM_S
    direction = erfa.ab(deflected, beta, sun_km_away / AU_KM, np.sqrt(1 - beta @ beta))
    return lit_place(direction / np.linalg.norm(direction), from_sun_km, to_body_km)


def lit_place(direction: Floats, from_sun_km: Floats, to_body_km: Floats) -> Place:
    """The place with the geometry of its light.

    With s = -from_sun / |from_sun| toward the Sun and o = -to_body / |to_body| toward the observer, the phase angle is
    that between s and o, and the bright limb is along the part of s perpendicular to o.
    """
    to_observer = -to_body_km / np.linalg.norm(to_body_km)
    distance_km = float(np.linalg.norm(from_sun_km))
    # The Sun itself is at a phase of 0.
    to_sun = -from_sun_km / distance_km if distance_km > 1 else to_observer
    across = to_sun - (to_sun @ to_observer) * to_observer
    phase_rad = float(np.arctan2(np.linalg.norm(across), to_sun @ to_observer))
    # The Sun itself and a body in opposition have no bright limb, so any direction serves.
    along = (
        across if np.linalg.norm(across) > 1e-12 else np.eye(3)[np.argmin(np.abs(direction))]
    )
    along = along - (along @ direction) * direction
    return Place(direction, from_sun_km, to_body_km, phase_rad, along / np.linalg.norm(along))
