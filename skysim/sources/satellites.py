"""Artificial satellites in a frame: moving points of sunlight, at places by SGP4 or drawn at random."""

from __future__ import annotations

import datetime
from collections.abc import Callable, Iterator, Sequence
from dataclasses import replace
from typing import NamedTuple

import erfa
import numpy as np
from numpy.typing import NDArray

from skysim.core.constants import SPEED_OF_LIGHT_M_S
from skysim.core.random_streams import SATELLITES, random_stream
from skysim.core.time import tt_jd
from skysim.core.types import Floats, SatelliteTruth, Sources
from skysim.scene.sections.surroundings import RandomSatellitesConfig
from skysim.sources.bodies import NAMES, WHITE, reflected_chromatic, reflected_flux_e_s_m2
from skysim.sources.camera_orbit import hidden_by_earth, sun_m, sunlit_fraction, to_astronomical
from skysim.sources.ephemeris import GcrsState
from skysim.sources.orbit_elements import MeanElements, gcrs_states
from skysim.sources.photometry import Band
from skysim.sources.stars import steady_points

ID_BASE = 1_000_000_000  # a satellite's number is this + its catalog number
RANDOM_BASE = 2_000_000_000  # a random one's is this + its number in the frame
STANDARD_M = 1e6  # range of the standard magnitude
OWN_M = 10.0  # a satellite nearer than this is the camera's own
MARGIN_RAD = 1e-3  # beyond the field: light time and aberration
SHORTEST_S = 1e-3  # time over which a path is differentiated


class ExposureView(NamedTuple):
    """What the camera can see in one exposure.

    Attributes
    ----------
    boresight
        (3,) at mid-exposure, ICRS axes
    field_rad
        From the boresight to the chip's corner
    turn_rad
        Angle by which the camera turns in the exposure
    duration_s
        From the first row's opening to the last row's end
    """

    boresight: Floats
    field_rad: float
    turn_rad: float
    duration_s: float


class MovingLight(NamedTuple):
    """A satellite as the camera sees it: its truth, place (3,) and motion (2, 3) as in `Sources`."""

    truth: SatelliteTruth
    place: Floats
    motion: Floats


def phase_mag(phase_rad: Floats | float) -> Floats:
    """Magnitudes by which a diffuse sphere is fainter than at a phase angle of 90 degrees.

    -2.5 log10(sin a + (pi - a) cos a): Lambert's law over the sphere's lit and visible part, whose light at the phase
    angle a is 2/(3 pi) (sin a + (pi - a) cos a) times that of a mirror-free disk of its albedo. Source: Hejduk 2011,
    Specular and diffuse components in spherical satellite photometric modeling (AMOS conference).
    """
    light = np.sin(phase_rad) + (np.pi - phase_rad) * np.cos(phase_rad)
    return np.asarray(-2.5 * np.log10(np.maximum(light, 1e-12)))


def magnitude(standard_mag: float, range_m: float, phase_rad: float, sunlit: float) -> float:
    """V = V(1000 km, 90 deg) + 5 log10(range / 1000 km) + phase_mag - 2.5 log10(sunlit part of the Sun)."""
    distance = 5 * np.log10(range_m / STANDARD_M) - 2.5 * np.log10(sunlit)
    return float(standard_mag + distance + phase_mag(phase_rad))


def known_satellites(
    elements: MeanElements,
    standard_mag: float,
    view: ExposureView,
    time: datetime.datetime,
    observer_at: Callable[[float], GcrsState],
) -> Iterator[MovingLight]:
    """The sunlit satellites whose paths can cross the field in an exposure, and that the Earth does not hide.

    SGP4 gives all satellites at mid-exposure; the few near the field are then followed through it (`path`).

    Parameters
    ----------
    time
        mid-exposure, UTC
    observer_at
        The camera's state, seconds after mid-exposure
    """
    here = observer_at(0.0)
    sun = sun_m(tt_jd(time))
    states = gcrs_states(elements, time, np.zeros(1))
    others = np.flatnonzero(
        (states[2][:, 0] == 0) & (np.linalg.norm(states[0][:, 0] - here.position_m, axis=1) > OWN_M)
    )
    place_m = states[0][others, 0]
    velocity_m_s = states[1][others, 0]
    to_m = place_m - here.position_m
    range_m = np.linalg.norm(to_m, axis=1)
    across_m_s = np.linalg.norm(
        np.cross(to_m / range_m[:, None], velocity_m_s - here.velocity_m_s), axis=1
    )
    reach_rad = (
        view.field_rad + MARGIN_RAD + (view.turn_rad + across_m_s / range_m * view.duration_s) / 2
    )
    near = to_m @ view.boresight > np.cos(np.minimum(reach_rad, np.pi)) * range_m
    sunlit = sunlit_fraction(place_m, sun)
    hidden = hidden_by_earth(here.position_m, to_m / range_m[:, None], range_m)
    for n in np.flatnonzero(near & (sunlit > 0) & ~hidden):
        one = elements.take([int(others[n])])
        seen = path(one, time, view.duration_s, observer_at)
        to_sun = sun - place_m[n]
        to_camera = -to_m[n]
        phase_rad = float(erfa.sepp(to_sun, to_camera))
        v_mag = magnitude(standard_mag, range_m[n], phase_rad, sunlit[n])
        about = (float(range_m[n] / 1e3), float(np.degrees(phase_rad)), float(sunlit[n]))
        yield moving_light(ID_BASE + one.numbers[0], one.names[0], v_mag, seen, about)


def path(
    one: MeanElements,
    time: datetime.datetime,
    duration_s: float,
    observer_at: Callable[[float], GcrsState],
) -> tuple[Floats, Floats]:
    """Apparent place (3,) of a satellite at mid-exposure, a unit vector, and its motion (2, 3).

    At the beginning, the middle and the end of the exposure: the place when the light left (light time), as seen from
    the camera, displaced by aberration. Satellite and camera share the Earth's motion, so only the camera's velocity
    in the GCRS displaces it: (u + v/c) / |u + v/c|, the classical law, which is within 0.1 mas of the relativistic one.
    A parabola through the three places is the path, and within 0.1" over ten seconds at a range of 500 km.
    """
    half_s = max(duration_s, SHORTEST_S) / 2
    after_s = half_s * np.array([-1.0, 0.0, 1.0])
    states = [observer_at(float(t)) for t in after_s]
    from_m = np.array([state.position_m for state in states])
    delay_s = np.zeros(3)
    for _ in range(3):
        to_m = gcrs_states(one, time, after_s - delay_s)[0][0] - from_m
        delay_s = np.linalg.norm(to_m, axis=1) / SPEED_OF_LIGHT_M_S
    range_m = np.linalg.norm(to_m, axis=1, keepdims=True)
    toward = (
        to_m / range_m + np.array([state.velocity_m_s for state in states]) / SPEED_OF_LIGHT_M_S
    )
    before, place, after = (
        toward / np.linalg.norm(toward, axis=1, keepdims=True) * range_m / range_m[1]
    )
    motion = np.stack([(after - before) / (2 * half_s), (after + before - 2 * place) / half_s**2])
    return place, motion


def random_satellites(
    config: RandomSatellitesConfig, view: ExposureView, run_seed: int, index: int
) -> Iterator[MovingLight]:
    """Random satellites that can cross the field in the exposure of a frame of the run with a scene's seed.

    They are uniformly distributed over a cone that holds all paths through the field, as many (Poisson) as `per_field`
    gives for its solid angle, and move along great circles.
    """
    rng = random_stream(config.seed, SATELLITES, run_seed, index)
    slowest, fastest = np.radians(config.rate_deg_s)
    reach_rad = min(view.field_rad + (view.turn_rad + fastest * view.duration_s) / 2, np.pi)
    mean = config.per_field * (1 - np.cos(reach_rad)) / (1 - np.cos(view.field_rad))
    axes = erfa.rz(
        rng.uniform(0, 2 * np.pi), np.eye(3)
    )  # any two axes across the boresight will do
    east = np.cross(view.boresight, axes[np.argmin(np.abs(axes @ view.boresight))])
    east /= np.linalg.norm(east)
    north = np.cross(view.boresight, east)
    for n in range(rng.poisson(mean)):
        cosine, around, heading = rng.uniform(np.cos(reach_rad), 1), *rng.uniform(0, 2 * np.pi, 2)
        outward = np.cos(around) * east + np.sin(around) * north
        sine = np.sqrt(1 - cosine**2)
        place = cosine * view.boresight + sine * outward
        inward = cosine * outward - sine * view.boresight
        along = np.cos(heading) * inward + np.sin(heading) * np.cross(place, inward)
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
    id: int, name: str, v_mag: float, seen: tuple[Floats, Floats], about: tuple[float, float, float]
) -> MovingLight:
    """The light of a satellite on its path; about: range_km, phase_deg, sunlit."""
    place, motion = seen
    rate_deg_s = float(np.degrees(np.linalg.norm(np.cross(place, motion[0]))))
    return MovingLight(
        SatelliteTruth(id, name, v_mag, *to_astronomical(place), rate_deg_s, *about), place, motion
    )


def as_sources(lights: Sequence[MovingLight], band: Band) -> Sources:
    """The satellites as moving points of the Sun's color."""
    v_mag = np.array([light.truth.v_mag for light in lights])
    flux = np.array([reflected_flux_e_s_m2(one, WHITE, band) for one in v_mag])
    ids: NDArray[np.int64] = np.array([light.truth.id for light in lights], np.int64)
    colors = reflected_chromatic(WHITE, band)
    chromatic = None if colors is None else np.tile(colors, (len(lights), 1))
    points = steady_points(ids, np.array([light.place for light in lights]), flux, v_mag, chromatic)
    return replace(points, motion=np.array([light.motion for light in lights]))


# Numbers of lights that no star and no LED has, in the truth of frames: reflections of LEDs and
# ghosts of a lens.


MIRRORED = 10_000_000  # the n-th image of an LED in the wall has n times this number and the LED's
GHOST = 1_000_000_000_000  # the n-th ghost of a light has n times this number and the light's


def light_name(id: int) -> str:
    """What a number of the truth stands for: a body's name, a reflection's or a ghost's source; else the number."""
    if id >= GHOST:
        return f"ghost of {light_name(id % GHOST)}"
    if MIRRORED <= id < ID_BASE:
        return f"reflection of {id % MIRRORED}"
    return NAMES.get(id, str(id))
