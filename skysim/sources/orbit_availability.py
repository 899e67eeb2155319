"""Availability of a star tracker in orbit: exclusion angles of Sun, Earth and Moon, and stars in view."""

import datetime
from collections.abc import Callable
from typing import Literal, NamedTuple

import erfa
import numpy as np
from scipy.interpolate import CubicSpline
from scipy.spatial import cKDTree

from skysim.core.constants import DAY_S, HOUR_S
from skysim.core.time import tt_jd
from skysim.core.types import Bools, Floats, Ints, joined, normalized
from skysim.scene.sections.surroundings import ExclusionConfig
from skysim.sources.camera_orbit import CameraOrbit, limb_elevation_rad
from skysim.sources.ephemeris import GcrsState, load_ephemeris

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


def place_spline(name: str, start: datetime.datetime, last_s: float) -> CubicSpline:
    """A body's place (3,) from the Earth's center in m, as a spline in seconds since the start."""
    ephemeris = load_ephemeris()
    first_jd = tt_jd(start)
    # One node more at either end, away from the spline's edges.
    nodes_s = np.arange(-NODE_S, last_s + 2 * NODE_S, NODE_S)
    dates = first_jd + nodes_s / DAY_S
    earth_km = [ephemeris.position_km("earth", jd) for jd in dates]
    body_km = [ephemeris.barycentric_km(name, jd) for jd in dates]
    return CubicSpline(nodes_s, 1e3 * (np.array(body_km) - np.array(earth_km)))
