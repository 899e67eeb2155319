"""The real sky on the inside of a dome: where an LED has to be, and how bright, to pass for a star."""

from __future__ import annotations

from pathlib import Path
from typing import NamedTuple, Protocol

import numpy as np
from numpy.typing import NDArray

from skysim import catalogue, lamp, sky
from skysim.led import Emitter, irradiance_e_s_m2
from skysim.scene import CATALOGUES
from skysim.types import BadInput, Floats


class Inside(Protocol):
    """A surface, as far as LEDs have to know it."""

    def meet(self, origin_m: Floats, rays: Floats) -> Floats:
        """(N, 3) points where rays from the inside leave it."""

    def inward(self, points_m: Floats) -> Floats:
        """(N, 3) unit normals towards the inside."""


class Projected(NamedTuple):
    """Stars on the dome, brightest first: hip, v_mag (N,), place_m (N, 3) in the lab."""

    hip: NDArray[np.int64]
    v_mag: Floats
    place_m: Floats


def projected(part: lamp.Celestial, inside: Inside) -> Projected:
    """Each star's apparent direction at part.epoch followed from the camera's nominal place to the surface.

    The lab's axes have the zenith at RA, Dec, and roll is the position angle of the lab's -y there. Of the stars that
    come to lie on the dome's cap the brightest. Raises BadInput for a camera outside, and for no stars or too few.
    """
    camera_m = np.array(part.camera_m)
    out_m = np.linalg.norm(camera_m)
    if out_m > 0 and not out_m < np.linalg.norm(inside.meet(np.zeros(3), camera_m[None] / out_m)):
        raise BadInput(
            f"light.layout.camera: {out_m:g} m from the bearing's centre is outside of the dome; allowed: inside"
        )
    stars = catalogue.read(known_catalogue(part.catalogue))
    lab_from_icrs = sky.cam_from_icrs(part.zenith_ra_deg, part.zenith_dec_deg, part.roll_deg)
    direction = lab_from_icrs.apply(sky.apparent(stars, part.epoch))
    above = direction[:, 2] > 0
    stars, place_m = stars.take(above), inside.meet(camera_m, direction[above])
    within = place_m[:, 2] >= np.cos(np.radians(part.cap_deg)) * np.linalg.norm(place_m, axis=1)
    stars, place_m = stars.take(within), place_m[within]
    chosen = brightest(stars.v_mag, part)
    return Projected(stars.hip[chosen], stars.v_mag[chosen], place_m[chosen])


def brightest(v_mag: Floats, part: lamp.Celestial) -> NDArray[np.int64]:
    """Indices of the stars that the scene asks for, brightest first, of those that are on the dome."""
    order = np.argsort(v_mag, kind="stable")
    if part.count is not None and part.count > len(order):
        raise BadInput(
            f"light.layout.count: {part.count} stars, where the catalogue has {len(order)} on the dome; allowed: no"
            " more than that"
        )
    shown = int(np.sum(v_mag <= part.limit_mag)) if part.limit_mag is not None else part.count
    if not shown:
        raise BadInput("light.layout.limit_mag: no star on the dome is so bright; allowed: a fainter limit")
    return order[:shown]


def levels(part: lamp.Celestial, stars: Projected, normal: Floats, led: lamp.Led) -> Floats:
    """(N,) levels by which the light that reaches the camera's nominal place follows Pogson's law, 10^(-0.4 V).

    Each LED makes up for its own distance and angle; the one that needs most has level 1. No star is shown brighter
    than part.brightest_mag. normal : (N, 3) of the LEDs. Raises BadInput for an LED that sends the camera nothing.
    """
    to_camera = np.array(part.camera_m) - stars.place_m
    distance_m = np.linalg.norm(to_camera, axis=1)
    cos_emission = np.einsum("nj,nj->n", normal, to_camera) / distance_m
    one = np.ones(len(distance_m))
    gain = irradiance_e_s_m2(one, Emitter.of(led), cos_emission, one, distance_m)
    if not np.all(gain > 0):
        raise BadInput(
            f"light.led.lobe: the LED of HIP {stars.hip[gain <= 0][0]} sends the camera nothing; allowed: a wider lobe"
        )
    shown_mag = np.maximum(stars.v_mag, -np.inf if part.brightest_mag is None else part.brightest_mag)
    needed = 10 ** (-0.4 * shown_mag) / gain
    return np.asarray(needed / needed.max())


def known_catalogue(name: str) -> Path:
    """The catalogue's file. Raises BadInput with the names that there are."""
    path = CATALOGUES / f"{name}.ecsv"
    if not path.is_file():
        known = ", ".join(sorted(file.stem for file in CATALOGUES.glob("hipparcos*.ecsv")))
        raise BadInput(f"light.layout.catalogue: {name!r} is none of {known}; see skysim catalog build")
    return path
