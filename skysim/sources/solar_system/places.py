"""Apparent places of the Sun, the Moon and the planets, with distances and the geometry of their light."""

from __future__ import annotations

from typing import NamedTuple

import erfa
import numpy as np

from skysim.core.constants import AU_KM, DAY_S, SPEED_OF_LIGHT_KM_S
from skysim.core.types import Floats
from skysim.sources.solar_system.ephemeris import load_ephemeris
from skysim.sources.solar_system.observer import Observer

DEFLECTION_LIMIT = 1e-6  # of `erfa.ld`: within 3' of the Sun's center its deflection is reduced


class Place(NamedTuple):
    """One body as seen by the observer, ICRS axes.

    direction   : (3,) apparent unit vector, with aberration
    from_sun_km : (3,) from the Sun to the body, when the light left it
    to_body_km  : (3,) from the observer to the body (astrometric: with light time, without aberration)
    phase_rad   : angle at the body between the Sun and the observer
    toward_sun  : (3,) unit vector perpendicular to `direction`, along which the Sun lies as seen from the body: the
                  direction of the bright limb
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


def place(name: str, observer: Observer) -> Place:
    """Apparent place of a body: light time, the Sun's deflection of light, aberration.

    The body is where it was when the light left it (the equation of light time, iterated to 1 km); the Sun
    deflects the light of bodies behind it (`erfa.ld`, up to 1.7" at its limb); the observer's velocity displaces all
    (`erfa.ab`). Neglected: deflection by the planets (0.02" at Jupiter's limb), and the outer planets' displacement
    from their systems' barycenters. Source: IERS Conventions 2010, chapter 7; Urban & Seidelmann (2013), ch. 7.
    """
    ephemeris = load_ephemeris()
    delay_s = 0.0
    for _ in range(3):
        left_jd = observer.tt_jd - delay_s / DAY_S
        to_body_km = ephemeris.barycentric_km(name, left_jd) - observer.position_km
        delay_s = float(np.linalg.norm(to_body_km)) / SPEED_OF_LIGHT_KM_S
    sun_km = ephemeris.position_km("sun", left_jd)
    from_sun_km = to_body_km + observer.position_km - sun_km
    astrometric = to_body_km / np.linalg.norm(to_body_km)
    sun_to_observer_km = observer.position_km - sun_km
    sun_km_away = float(np.linalg.norm(sun_to_observer_km))
    deflected = astrometric
    if name != "sun":
        body_from_sun = from_sun_km / np.linalg.norm(from_sun_km)
        au = sun_km_away / AU_KM
        deflected = erfa.ld(
            1.0, astrometric, body_from_sun, sun_to_observer_km / sun_km_away, au, DEFLECTION_LIMIT
        )
    beta = observer.velocity_km_s / SPEED_OF_LIGHT_KM_S
    direction = erfa.ab(deflected, beta, sun_km_away / AU_KM, np.sqrt(1 - beta @ beta))
    return lit_place(direction / np.linalg.norm(direction), from_sun_km, to_body_km)


def lit_place(direction: Floats, from_sun_km: Floats, to_body_km: Floats) -> Place:
    """The place with the geometry of its light.

    With s = -from_sun / |from_sun| toward the Sun and o = -to_body / |to_body| toward the observer, the phase angle is
    that between s and o, and the bright limb lies along the part of s perpendicular to o.
    """
    to_observer = -to_body_km / np.linalg.norm(to_body_km)
    distance_km = float(np.linalg.norm(from_sun_km))
    to_sun = (
        -from_sun_km / distance_km if distance_km > 1 else to_observer
    )  # the Sun itself is at a phase of 0
    across = to_sun - (to_sun @ to_observer) * to_observer
    phase_rad = float(np.arctan2(np.linalg.norm(across), to_sun @ to_observer))
    # The Sun itself and a body in opposition have no bright limb: any direction will do.
    along = across if np.linalg.norm(across) > 1e-12 else np.eye(3)[np.argmin(np.abs(direction))]
    along = along - (along @ direction) * direction
    return Place(direction, from_sun_km, to_body_km, phase_rad, along / np.linalg.norm(along))
