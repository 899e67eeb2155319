"""Artificial satellites in a frame: moving points of sunlight, at places by SGP4 or drawn at random.

1. SGP4 gives all satellites at mid-exposure; those that can cross the field, in sunlight and not behind the Earth, are
   kept (`known_satellites`).
2. Each is followed through the exposure with light time and aberration (`path`).
3. Its magnitude follows from range, phase angle and the fraction of the Sun that it sees (`magnitude`).
"""

import datetime
from collections.abc import Callable, Iterator, Sequence
from dataclasses import replace
from typing import NamedTuple

import erfa
import numpy as np

from skysim.core.constants import SPEED_OF_LIGHT_M_S
from skysim.core.random_streams import SATELLITES, random_stream
from skysim.core.time import tt_jd
from skysim.core.types import Floats, Ints, SatelliteTruth, Sources, lengths, normalized
from skysim.scene.sections.surroundings import RandomSatellitesConfig
from skysim.sources.bodies import NAMES, WHITE, reflected_chromatic, reflected_flux_e_s_m2
from skysim.sources.camera_orbit import (
    hidden_by_earth,
    sun_m,
    sunlit_fraction,
    to_astronomical,
)
from skysim.sources.ephemeris import GcrsState
from skysim.sources.orbit_elements import MeanElements, gcrs_states
from skysim.sources.photometry import Band
from skysim.sources.stars import steady_points

ID_BASE = 1_000_000_000  # a satellite's number is this + its catalog number
# The number of a random satellite is this + its number in the frame
RANDOM_BASE = 2_000_000_000
STANDARD_M = 1e6  # range of the standard magnitude
OWN_M = 10.0  # a satellite nearer than this is the camera's own
MARGIN_RAD = 1e-3  # added to the field's radius, for light time and aberration
SHORTEST_S = 1e-3  # least time over which a path is differentiated


class ExposureView(NamedTuple):
    """What the camera can see in one exposure.

    Attributes
    ----------
    boresight
        (3,) unit vector at mid-exposure, ICRS axes
    field_rad
        Angle from the boresight to the chip's corner
    turn_rad
        Angle by which the camera turns during the exposure
    duration_s
        Time from the first row's opening to the last row's end
    """

    boresight: Floats
    field_rad: float
    turn_rad: float
    duration_s: float


class MovingLight(NamedTuple):
    """A satellite as the camera sees it: its truth, and place (3,) and motion (2, 3) as in `Sources`."""

    truth: SatelliteTruth
    place: Floats
    motion: Floats


def phase_mag(phase_rad: Floats | float) -> Floats:
    """Magnitudes by which a diffuse sphere is fainter than at a phase angle of 90 degrees.

    -2.5 log10(sin a + (pi - a) cos a). By Lambert's law, integrated over the sphere's lit and visible part, its light
    at the phase angle a is 2/(3 pi) (sin a + (pi - a) cos a) times that of a matt disk of the same albedo. Source:
    Hejduk 2011, Specular and diffuse components in spherical satellite photometric modeling (AMOS conference).
    """
    light = np.sin(phase_rad) + (np.pi - phase_rad) * np.cos(phase_rad)
    return -2.5 * np.log10(np.maximum(light, 1e-12))


def magnitude(standard_mag: float, range_m: float, phase_rad: float, sunlit: float) -> float:
    """V = V(1000 km, 90 deg) + 5 log10(range / 1000 km) + phase_mag - 2.5 log10(fraction of the Sun that it sees)."""
    distance = 5 * np.log10(range_m / STANDARD_M) - 2.5 * np.log10(sunlit)
    return float(standard_mag + distance + phase_mag(phase_rad))


def known_satellites(
    elements: Sequence[MeanElements],
    standard_mag: float,
    view: ExposureView,
    time: datetime.datetime,
    observer_at: Callable[[float], GcrsState],
) -> Iterator[MovingLight]:
    """The sunlit satellites whose paths can cross the field in an exposure, and that the Earth does not hide.

    Parameters
    ----------
    time
        Mid-exposure, UTC
    observer_at
        Function that returns the camera's state at seconds after mid-exposure
    """
    # 1. States of all satellites at mid-exposure; SGP4 may fail for some, and the camera is no light.
    here = observer_at(0.0)
    sun = sun_m(tt_jd(time))
    states = gcrs_states(elements, time, np.zeros(1))
    far = lengths(states[0][:, 0] - here.position_m) > OWN_M
    others = np.flatnonzero((states[2][:, 0] == 0) & far)
    place_m = states[0][others, 0]
    velocity_m_s = states[1][others, 0]
    to_m = place_m - here.position_m
    range_m = lengths(to_m)
    # Field, and half of what camera and satellite turn during the exposure.
    across = np.cross(to_m / range_m[:, None], velocity_m_s - here.velocity_m_s)
    rate_rad_s = lengths(across) / range_m
    turn_rad = view.turn_rad + rate_rad_s * view.duration_s
    reach_rad = view.field_rad + MARGIN_RAD + turn_rad / 2
    near = to_m @ view.boresight > np.cos(np.minimum(reach_rad, np.pi)) * range_m
    sunlit = sunlit_fraction(place_m, sun)
    hidden = hidden_by_earth(here.position_m, to_m / range_m[:, None], range_m)
    # 2. and 3. Path and magnitude of each.
    for n in np.flatnonzero(near & (sunlit > 0) & ~hidden):
        one = elements[others[n]]
        seen = path(one, time, view.duration_s, observer_at)
        to_sun = sun - place_m[n]
        to_camera = -to_m[n]
        phase_rad = float(erfa.sepp(to_sun, to_camera))
        v_mag = magnitude(standard_mag, range_m[n], phase_rad, sunlit[n])
        about = (float(range_m[n] / 1e3), float(np.degrees(phase_rad)), float(sunlit[n]))
        yield moving_light(ID_BASE + one.number, one.name, v_mag, seen, about)


def path(
    one: MeanElements,
    time: datetime.datetime,
    duration_s: float,
    observer_at: Callable[[float], GcrsState],
) -> tuple[Floats, Floats]:
    """Apparent place (3,) of a satellite at mid-exposure, a unit vector, and its motion (2, 3).

    1. Take the beginning, the middle and the end of the exposure.
    2. The satellite is where it was when the light left it (light time, by iteration).
    3. Aberration: satellite and camera share the Earth's motion, so only the camera's velocity v in the GCRS displaces
       the direction u: (u + v/c) / |u + v/c|, the classical law, which is within 0.1 mas of the relativistic one.
    4. A parabola through the three places is the path, within 0.1" over ten seconds at a range of 500 km.
    """
    # 1.
    half_s = max(duration_s, SHORTEST_S) / 2
    after_s = half_s * np.array([-1.0, 0.0, 1.0])
    states = [observer_at(float(t)) for t in after_s]
    from_m = np.array([state.position_m for state in states])
    # 2. Light time.
    delay_s = np.zeros(3)
    for _ in range(3):
        to_m = gcrs_states([one], time, after_s - delay_s)[0][0] - from_m
        delay_s = lengths(to_m) / SPEED_OF_LIGHT_M_S
    range_m = lengths(to_m)[:, None]
    # 3. Aberration; lengths keep the ratios of the ranges, so that the path is that of a place in space.
    own_m_s = np.array([state.velocity_m_s for state in states])
    toward = to_m / range_m + own_m_s / SPEED_OF_LIGHT_M_S
    toward = normalized(toward) * range_m / range_m[1]
    before, place, after = toward
    # 4. Velocity and acceleration by central differences.
    motion = np.stack(
        [(after - before) / (2 * half_s), (after + before - 2 * place) / half_s**2]
    )
    return place, motion


def random_satellites(
    config: RandomSatellitesConfig, view: ExposureView, run_seed: int, index: int
) -> Iterator[MovingLight]:
    """Random satellites that can cross the field during one exposure.

    They are uniformly distributed over a cone that contains all paths through the field, as many (Poisson) as
    `per_field` gives for its solid angle, and move along great circles.

    Parameters
    ----------
    run_seed, index
        Seed of the scene, and number of the frame
    """
    rng = random_stream(config.seed, SATELLITES, run_seed, index)
    slowest, fastest = np.radians(config.rate_deg_s)
    reach_rad = min(view.field_rad + (view.turn_rad + fastest * view.duration_s) / 2, np.pi)
    mean = config.per_field * (1 - np.cos(reach_rad)) / (1 - np.cos(view.field_rad))
    # Two axes across the boresight; the cone's symmetry makes any two equivalent.
    axes = erfa.rz(rng.uniform(0, 2 * np.pi), np.eye(3))
    east = np.cross(view.boresight, axes[np.argmin(np.abs(axes @ view.boresight))])
    east /= np.linalg.norm(east)
    north = np.cross(view.boresight, east)
    for n in range(rng.poisson(mean)):
        # A place uniform over the cone's cap, and a heading.
        cosine, around, heading = (
            rng.uniform(np.cos(reach_rad), 1),
            *rng.uniform(0, 2 * np.pi, 2),
        )
        outward = np.cos(around) * east + np.sin(around) * north
        sine = np.sqrt(1 - cosine**2)
        place = cosine * view.boresight + sine * outward
        inward = cosine * outward - sine * view.boresight
        along = np.cos(heading) * inward + np.sin(heading) * np.cross(place, inward)
        # The rate is uniform in its logarithm; on a great circle p'' = -rate^2 p.
        rate = np.exp(rng.uniform(np.log(slowest), np.log(fastest)))
        motion = np.stack([rate * along, -(rate**2) * place])
        about = float("nan"), float("nan"), 1.0
        yield moving_light(
            RANDOM_BASE + n,
            f"random {n}",
            float(rng.uniform(*config.v_mag)),
            (place, motion),
            about,
        )


def moving_light(
    id: int,
    name: str,
    v_mag: float,
    seen: tuple[Floats, Floats],
    about: tuple[float, float, float],
) -> MovingLight:
    """The light of a satellite on its path.

    Parameters
    ----------
    seen
        Place (3,) and motion (2, 3)
    about
        Range in km, phase angle in degrees, and the fraction of the Sun that it sees
    """
    place, motion = seen
    rate_deg_s = float(np.degrees(np.linalg.norm(np.cross(place, motion[0]))))
    return MovingLight(
        SatelliteTruth(id, name, v_mag, *to_astronomical(place), rate_deg_s, *about),
        place,
        motion,
    )


def as_sources(lights: Sequence[MovingLight], band: Band) -> Sources:
    """The satellites as moving points with the Sun's color."""
    v_mag = np.array([light.truth.v_mag for light in lights])
    flux = np.array([reflected_flux_e_s_m2(one, WHITE, band) for one in v_mag])
    ids: Ints = np.array([light.truth.id for light in lights], np.int64)
    colors = reflected_chromatic(WHITE, band)
    chromatic = None if colors is None else np.tile(colors, (len(lights), 1))
    points = steady_points(
        ids, np.array([light.place for light in lights]), flux, v_mag, chromatic
    )
    return replace(points, motion=np.array([light.motion for light in lights]))


# Numbers of lights in the truth of frames that no star and no LED has: reflections of LEDs and ghosts of a lens.


# The n-th image of an LED in the wall has n times this number and the LED's
MIRRORED = 10_000_000
GHOST = 1_000_000_000_000  # the n-th ghost of a light has n times this number and the light's


def light_name(id: int) -> str:
    """Name of the light that has a number in the truth: a body's, a reflection's or a ghost's; else the number."""
    if id >= GHOST:
        return f"ghost of {light_name(id % GHOST)}"
    if MIRRORED <= id < ID_BASE:
        return f"reflection of {id % MIRRORED}"
    return NAMES.get(id, str(id))
