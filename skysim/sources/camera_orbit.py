"""The camera's place: its orbit or its site in GCRS axes at any time of a run, and what the Earth hides from it.

`sample` follows a star tracker along its orbit: exclusion angles of Sun, Earth and Moon, and stars in view.
"""

import datetime
from collections.abc import Callable
from typing import Any, Literal, NamedTuple, Protocol

import erfa
import numpy as np
import scipy
from scipy.spatial import cKDTree

from skysim.core.constants import (
    DAY_S,
    EARTH_FLATTENING,
    EARTH_J2,
    EARTH_MU_M3_S2,
    EARTH_RADIUS_M,
    HOUR_S,
)
from skysim.core.errors import InputError
from skysim.core.time import tt_jd
from skysim.core.types import Bools, Floats, Ints, frozen, joined, lengths, normalized, taken
from skysim.scene.sections.surroundings import (
    CircularOrbitConfig,
    ExclusionConfig,
    TleOrbitConfig,
)
from skysim.scene.sections.vehicle import SiteConfig
from skysim.sources.bodies import BODIES
from skysim.sources.ephemeris import (
    GcrsState,
    ObserverPlace,
    load_ephemeris,
    observe_at,
    site_in_gcrs,
)
from skysim.sources.orbit_elements import (
    MeanElements,
    check_epochs,
    gcrs_states,
    read_elements,
    read_oem,
)
from skysim.sources.stars import sky_axes


class CameraOrbit(Protocol):
    """The camera's position and velocity in time."""

    def states(self, after_s: Floats) -> GcrsState:
        """(K, 3) positions and velocities at K times since the scene's start. Raises InputError beyond its data."""
        ...


def state_at(orbit: CameraOrbit, after_s: float) -> GcrsState:
    """(3,) position and velocity of an orbit at a time since the scene's start."""
    return taken(orbit.states(np.array([after_s])), 0)


@frozen
class CircularOrbit:
    """A circular orbit under gravity and J2, averaged over a revolution.

    With the mean motion n = sqrt(mu / a^3) and k = 1.5 J2 (R / a)^2, the node moves by -k n cos i and the argument of
    latitude by n (1 + k (3 - 4 sin^2 i)). The short-period terms (some km in a low orbit) are left out, and the
    equator is that of the GCRS. Source: Vallado 2013, Fundamentals of Astrodynamics, section 9.6.
    """

    config: CircularOrbitConfig

    @property
    def rates_rad_s(self) -> tuple[float, float]:
        """Rates of the argument of latitude and of the node."""
        radius_m = EARTH_RADIUS_M + self.config.altitude_m
        inclination = np.radians(self.config.inclination_deg)
        # Mean motion, and the size of J2's effect.
        n = np.sqrt(EARTH_MU_M3_S2 / radius_m**3)
        k = 1.5 * EARTH_J2 * (EARTH_RADIUS_M / radius_m) ** 2
        argument = n * (1 + k * (3 - 4 * np.sin(inclination) ** 2))
        return float(argument), float(-k * n * np.cos(inclination))

    def states(self, after_s: Floats) -> GcrsState:
        """Circle in the orbital plane: r (cos u N + sin u A), toward the node N and 90 degrees ahead A."""
        config = self.config
        rate, node_rate = self.rates_rad_s
        inclination = np.radians(config.inclination_deg)
        along = np.radians(config.argument_deg) + rate * after_s
        node = np.radians(config.raan_deg) + node_rate * after_s
        east, north, toward_node = sky_axes(node, np.zeros_like(node))
        ahead = np.cos(inclination) * east + np.sin(inclination) * north
        # Position and velocity in the orbital plane.
        radius_m = EARTH_RADIUS_M + config.altitude_m
        cosine = np.cos(along)[:, None]
        sine = np.sin(along)[:, None]
        position_m = radius_m * (cosine * toward_node + sine * ahead)
        velocity_m_s = radius_m * rate * (cosine * ahead - sine * toward_node)
        # The node's motion turns the whole plane about the Earth's axis.
        return GcrsState(
            position_m, velocity_m_s + np.cross([0.0, 0.0, node_rate], position_m)
        )


@frozen
class TleOrbit:
    """The orbit of a satellite by SGP4."""

    satellite: MeanElements
    start: datetime.datetime

    def states(self, after_s: Floats) -> GcrsState:
        """States by SGP4, day by day, since the equinox moves by 0.1" a day."""
        position_m, velocity_m_s = np.empty((2, len(after_s), 3))
        day = np.round(after_s / DAY_S)
        for one in np.unique(day):
            # One matrix to GCRS axes for each day, that of the middle of its times.
            rows = np.flatnonzero(day == one)
            middle_s = float(after_s[rows].mean())
            time = self.start + datetime.timedelta(seconds=middle_s)
            place, velocity, errors = gcrs_states(
                [self.satellite], time, after_s[rows] - middle_s
            )
            if errors.any():
                raise InputError(
                    "orbit.file",
                    f"SGP4 has no place of this satellite at {time}",
                    "newer elements",
                )
            position_m[rows] = place[0]
            velocity_m_s[rows] = velocity[0]
        return GcrsState(position_m, velocity_m_s)


def tle(config: TleOrbitConfig, start: datetime.datetime) -> TleOrbit:
    """The orbit of one satellite of a file of TLEs or OMMs.

    Raises
    ------
    InputError
        For a file without the satellite, or with several if no number is given.
    """
    elements = read_elements(config.file)
    chosen = [one for one in elements if config.number in (None, one.number)]
    if len(chosen) != 1:
        listed = ", ".join(f"{one.number}" for one in elements[:5])
        raise InputError(
            "orbit.number",
            f"{config.number}: {len(chosen)} satellites of {config.file}",
            f"one of {listed}{', ...' * (len(elements) > 5)}",
        )
    check_epochs(config.file, chosen, start)
    return TleOrbit(chosen[0], start)


ORBITS: dict[str, Callable[[Any, datetime.datetime], CameraOrbit]] = {
    "circular": lambda config, _start: CircularOrbit(config),
    "tle": tle,
    "oem": lambda config, start: read_oem(config.file, start),
}


def build_orbit(config: Any, start: datetime.datetime) -> CameraOrbit | None:
    """The camera's orbit of a scene; None without the section `orbit`. Raises InputError for an unreadable file."""
    return ORBITS[config.kind](config, start) if config else None


# Viewpoint: the place of a scene's camera at any time, on the turning Earth or in its orbit.


@frozen
class Viewpoint:
    """The camera's place from the scene's start on.

    Attributes
    ----------
    start
        UTC at t = 0
    site
        Place on the ground; a site without a longitude is the Earth's center
    orbit
        The camera's orbit, None on the ground
    """

    start: datetime.datetime
    site: SiteConfig
    orbit: CameraOrbit | None = None

    def time_at(self, t_s: float) -> datetime.datetime:
        """UTC at a time since the start."""
        return self.start + datetime.timedelta(seconds=t_s)

    def state_at(self, t_s: float) -> GcrsState:
        """The state from the Earth's center at a time since the start."""
        if self.orbit:
            return state_at(self.orbit, t_s)
        time = self.time_at(t_s)
        return site_in_gcrs(time, tt_jd(time), self.site)

    def observer_at(self, t_s: float) -> ObserverPlace:
        """The state among the bodies of the solar system at a time since the start."""
        return observe_at(self.time_at(t_s), self.state_at(t_s))


# The Earth as an ellipsoid: what it hides, and how much of the Sun a satellite sees. The ellipsoid (WGS 84) is
# a unit sphere in coordinates in which z is stretched, and lines stay lines. Its axis is taken for the GCRS's z (a
# tenth of a degree off in 2020, which displaces the limb by up to 40 m). The air is left out.


SUN_RADIUS_M = 1e3 * BODIES["sun"].radius_km
TO_SPHERE = np.array([1.0, 1.0, 1 / (1 - EARTH_FLATTENING)]) / EARTH_RADIUS_M  # per meter


def sun_m(tt_jd: float) -> Floats:
    """(3,) geometric position of the Sun from the Earth's center in m, GCRS axes."""
    ephemeris = load_ephemeris()
    return 1e3 * (ephemeris.position_km("sun", tt_jd) - ephemeris.position_km("earth", tt_jd))


def hidden_by_earth(
    observer_m: Floats, direction: Floats, distance_m: Floats | float = np.inf
) -> Bools:
    """Whether the Earth is between an observer and points in unit directions (..., 3) at these distances.

    On the stretched sphere the line p + s d comes nearest to the center at s = -p.d, where its distance is
    sqrt(p^2 - (p.d)^2). An observer on or below the ellipsoid sees what is above the plane that touches it there.
    """
    place = observer_m * TO_SPHERE
    along = direction * TO_SPHERE
    length = lengths(along)
    # Nearest point of the line to the center, and the center's distance squared.
    inward = -(along @ place if place.ndim == 1 else np.sum(along * place, axis=-1)) / length
    square = np.sum(place * place, axis=-1)
    # The line meets the sphere, ahead and before the point; the last term is for observers on or below it.
    below = square - inward**2 < np.minimum(1.0, square * (1 - 1e-12))
    # Where the line enters the sphere.
    entry = inward - np.sqrt(np.maximum(1 - square + inward**2, 0.0))
    return (inward > 0) & below & (np.maximum(entry, 0.0) < distance_m * length)


def sunlit_fraction(place_m: Floats, sun_m: Floats) -> Floats:
    """(...,) fraction of the Sun's disc that the Earth does not hide at places (..., 3): 1 in sunlight, 0 in the umbra.

    The limb crosses the Sun's disc as a straight line, at h solar radii from its center toward the Earth:
    f = 1/2 + (h sqrt(1 - h^2) + arcsin h) / pi, for |h| < 1. The Sun's elevation above the limb is computed on the
    stretched sphere (to 0.4 %). Refraction and the limb's curvature across the Sun (0.7 % of the light in a
    low orbit) are left out. Source: Montenbruck & Gill 2000, Satellite Orbits, section 3.4.2.
    """
    to_sun = sun_m - place_m
    # Elevation above the limb in units of the Sun's angular radius.
    h_rad = limb_elevation_rad(place_m, to_sun)
    h = np.clip(h_rad * lengths(to_sun) / SUN_RADIUS_M, -1, 1)
    return 0.5 + (h * np.sqrt(1 - h**2) + np.arcsin(h)) / np.pi


def limb_elevation_rad(place_m: Floats, direction: Floats) -> Floats:
    """(...,) angles of directions (..., 3) above the Earth's limb, seen from places (..., 3); below it negative.

    The elevation above the local horizontal, plus the dip of the limb below it, arccos(1 / r).
    """
    place = place_m * TO_SPHERE
    toward = direction * TO_SPHERE
    radius = lengths(place)
    length = lengths(toward)
    # Elevation above the plane across the vertical, then the dip of the limb.
    above_horizon = np.arcsin(
        np.clip(np.sum(place * toward, axis=-1) / (radius * length), -1, 1)
    )
    return above_horizon + np.arccos(1 / np.maximum(radius, 1.0))


def to_astronomical(direction: Floats) -> tuple[float, float]:
    """Right ascension and declination of a vector in degrees."""
    ra, dec = erfa.c2s(direction)
    return float(np.degrees(ra)) % 360, float(np.degrees(dec))


# Availability of a star tracker in orbit: exclusion angles of Sun, Earth and Moon, and stars in view.


CHUNK = 20_000  # times that are computed at once
# Interval of the Sun's and the Moon's places, between which a cubic spline is right to 0.01".
NODE_S = HOUR_S

Law = Literal["inertial", "zenith"]


class Pointing(NamedTuple):
    """The attitude law of the boresight.

    Attributes
    ----------
    law
        `inertial`: the boresight is toward `direction`; `zenith`: it is off_rad from the zenith
    direction
        (3,) unit vector, ICRS axes
    off_rad, around_rad
        Angle from the zenith, and azimuth from the flight direction, left of it positive
    """

    law: Law
    direction: Floats
    off_rad: float = 0.0
    around_rad: float = 0.0

    def boresights(self, states: GcrsState) -> Floats:
        """(K, 3) boresights for these states of the camera."""
        if self.law == "inertial":
            return np.broadcast_to(self.direction, states.position_m.shape)
        # Local axes: up, left of the flight direction, ahead.
        up = normalized(states.position_m)
        left = normalized(np.cross(states.position_m, states.velocity_m_s))
        ahead = np.cross(left, up)
        level = np.cos(self.around_rad) * ahead + np.sin(self.around_rad) * left
        return np.cos(self.off_rad) * up + np.sin(self.off_rad) * level


class SkySamples(NamedTuple):
    """What surrounds the tracker's boresight at K times.

    Attributes
    ----------
    t_s
        (K,) times since the start
    sun_deg, moon_deg
        (K,) angles from the bodies' centers
    earth_deg
        (K,) angles from the Earth's limb, negative on its disc
    stars
        (K,) numbers of stars in the field that the Earth does not hide
    """

    t_s: Floats
    sun_deg: Floats
    earth_deg: Floats
    moon_deg: Floats
    stars: Ints

    def outside(self, exclusion: ExclusionConfig) -> dict[str, Bools]:
        """(K,) whether the boresight is outside each body's exclusion angle, and whether there are enough stars."""
        return {
            "Sun": self.sun_deg > exclusion.sun_deg,
            "Earth": self.earth_deg > exclusion.earth_deg,
            "Moon": self.moon_deg > exclusion.moon_deg,
            "stars": self.stars >= exclusion.stars,
        }


def sample(
    orbit: CameraOrbit,
    start: datetime.datetime,
    t_s: Floats,
    pointing: Pointing,
    stars: Floats,
    field_rad: float,
    watch: Callable[[float, float], None] = lambda done, total: None,
) -> SkySamples:
    """Angles and stars at K times since the start.

    Parameters
    ----------
    stars
        (N, 3) directions of the stars that the tracker detects
    field_rad
        Half-angle of a round field
    watch
        Called with the numbers of times that are done and in all
    """
    # The stars in a field are looked up in a tree.
    tree = cKDTree(stars)
    parts = []
    places_m = {name: place_spline(name, start, float(t_s[-1])) for name in ("sun", "moon")}
    # Memory limits the number of times that are computed at once.
    for first in range(0, len(t_s), CHUNK):
        times = t_s[first : first + CHUNK]
        states = orbit.states(times)
        boresight = pointing.boresights(states)
        angles = {
            name: erfa.sepp(place(times) - states.position_m, boresight)
            for name, place in places_m.items()
        }
        limb = limb_elevation_rad(states.position_m, boresight)
        # A chord replaces the angle in the search; near the limb the Earth hides a part of the
        # field, which counts as none.
        seen = tree.query_ball_point(boresight, 2 * np.sin(field_rad / 2), return_length=True)
        seen = np.where(limb > field_rad, seen, 0)
        sun_deg, limb_deg, moon_deg = np.degrees([angles["sun"], limb, angles["moon"]])
        parts.append(
            SkySamples(times, sun_deg, limb_deg, moon_deg, np.asarray(seen, np.int64))
        )
        watch(first + len(times), len(t_s))
    return joined(parts)


def place_spline(
    name: str, start: datetime.datetime, last_s: float
) -> "scipy.interpolate.CubicSpline":
    """A body's place (3,) from the Earth's center in m, as a spline in seconds since the start."""
    ephemeris = load_ephemeris()
    first_jd = tt_jd(start)
    # One node more at either end, away from the spline's edges.
    nodes_s = np.arange(-NODE_S, last_s + 2 * NODE_S, NODE_S)
    dates = first_jd + nodes_s / DAY_S
    earth_km = [ephemeris.position_km("earth", jd) for jd in dates]
    body_km = [ephemeris.barycentric_km(name, jd) for jd in dates]
    return scipy.interpolate.CubicSpline(
        nodes_s, 1e3 * (np.array(body_km) - np.array(earth_km))
    )
