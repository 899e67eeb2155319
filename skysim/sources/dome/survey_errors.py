"""Surveyed positions of LEDs, surface and camera, as the tracker believes them: the truth plus survey errors.

The errors are drawn once, from their own seed (`tracker.survey.seed`), because a survey is a property of the hardware
and not noise of a frame. Each kind of error has its own random stream, so adding one leaves the others unchanged.
"""

from __future__ import annotations

import numpy as np
from scipy.spatial.transform import Rotation

from skysim.core.errors import InputError
from skysim.core.types import Floats
from skysim.scene.tracker import SurveyErrorsConfig
from skysim.sources.dome.surface import Surface

STREAM = {"leds": 1, "lever": 2, "surface": 3}


def normals(seed: int, what: str, shape: tuple[int, ...]) -> Floats:
    """Standard normal numbers of that shape; they depend on the seed and the kind of error only."""
    stream = np.random.SeedSequence(seed, spawn_key=(STREAM[what],))
    return np.random.default_rng(stream).standard_normal(shape)


def believed_m(place_m: Floats, sigma_m: float, seed: int, what: str) -> Floats:
    """Surveyed places: the true ones (..., 3) plus a Gaussian error of sigma about each axis; unchanged for sigma 0."""
    return place_m + sigma_m * normals(seed, what, place_m.shape) if sigma_m else place_m


def surface_seed(told: SurveyErrorsConfig) -> int:
    """Seed of the surface's survey error."""
    return told.seed if told.surface_seed is None else told.surface_seed


def turned(places_m: Floats, told: SurveyErrorsConfig) -> Floats:
    """Surveyed places (..., 3) rotated by the orientation error of the survey's axes in the lab."""
    return (
        Rotation.from_rotvec(told.turn_deg, degrees=True).apply(places_m) if any(told.turn_deg) else places_m
    )


def raised_m(inside: Surface, seed: int) -> float:
    """Offset of the surveyed surface, outward along the normal of the true one: N(0, light.surface.error).

    One draw for the whole surface (the arm's zero, its probe's radius). Independent errors of a thousand points
    average out in a fitted ellipsoid.
    """
    return float(inside.survey_sigma_m * normals(seed, "surface", (1,))[0])


def believed_leds_m(inside: Surface, place_m: Floats, told: SurveyErrorsConfig) -> Floats:
    """(N, 3) surveyed LED places: independent errors, the surface's common offset and the rotation of the axes."""
    raised = raised_m(inside, surface_seed(told))
    on_it = place_m - raised * inside.inward(place_m) if raised else place_m
    return turned(believed_m(on_it, told.led_sigma_m, told.seed, "leds"), told)


def believed_ellipsoid(inside: Surface, told: SurveyErrorsConfig) -> tuple[Floats, Floats]:
    """Center and semi-axes, (3,) each, m, of the surveyed ellipsoid: the nearest one, longer by `raised_m`.

    That displaces an ellipsoid by sum(a_i n_i^2) / sqrt(sum(a_i^2 n_i^2)) of the offset where the normal is n: by all
    of it on the axes and on a sphere, and never by less than 2 sqrt(a b) / (a + b), a and b its longest and shortest
    semi-axis. Raises InputError if a semi-axis is not positive.
    """
    centre_m, semi_axes_m = inside.as_ellipsoid()
    believed = semi_axes_m + raised_m(inside, surface_seed(told))
    if believed.min() <= 0:
        raise InputError(
            f"light.surface.error: {inside.survey_sigma_m:g} m makes an ellipsoid of {believed.min():.3g} m; allowed:"
            " far less than the dome"
        )
    return turned(centre_m, told), believed
