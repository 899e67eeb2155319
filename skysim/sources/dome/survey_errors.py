"""What the lab believes of its dome and of its camera's place: the truth and a survey's errors.

They are drawn once, from a seed of their own (`tracker.survey.seed`): a survey is hardware, no noise of a frame. Each
kind has a stream of its own, so that one error more leaves the others as they were.
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
    """Standard normal numbers of that shape, the same for a seed whatever else is drawn."""
    stream = np.random.SeedSequence(seed, spawn_key=(STREAM[what],))
    return np.random.default_rng(stream).standard_normal(shape)


def believed_m(place_m: Floats, sigma_m: float, seed: int, what: str) -> Floats:
    """Places in space as a survey has them: true ones (..., 3) and an error of sigma about each axis, Gaussian.

    Without an error the places themselves.
    """
    return place_m + sigma_m * normals(seed, what, place_m.shape) if sigma_m else place_m


def surface_seed(told: SurveyErrorsConfig) -> int:
    """What draws the surface's error."""
    return told.seed if told.surface_seed is None else told.surface_seed


def turned(places_m: Floats, told: SurveyErrorsConfig) -> Floats:
    """Believed places (..., 3) as a survey has them whose axes stand turned in the lab's."""
    return (
        Rotation.from_rotvec(told.turn_deg, degrees=True).apply(places_m) if any(told.turn_deg) else places_m
    )


def raised_m(inside: Surface, seed: int) -> float:
    """How far outside of the true surface, along its normal, the survey has it: N(0, light.surface.error).

    One draw for all of the surface (the arm's zero, its probe's radius): what a thousand points err each by itself, an
    ellipsoid fitted to them does not.
    """
    return float(inside.survey_sigma_m * normals(seed, "surface", (1,))[0])


def believed_leds_m(inside: Surface, place_m: Floats, told: SurveyErrorsConfig) -> Floats:
    """(N, 3) LEDs as the lab has them on its map: each errs, all go with the surface and the survey's axes."""
    raised = raised_m(inside, surface_seed(told))
    on_it = place_m - raised * inside.inward(place_m) if raised else place_m
    return turned(believed_m(on_it, told.led_sigma_m, told.seed, "leds"), told)


def believed_ellipsoid(inside: Surface, told: SurveyErrorsConfig) -> tuple[Floats, Floats]:
    """Centre and semi-axes, (3,) each, m: those nearest to the surface, the axes greater by as much as it is raised.

    That raises an ellipsoid by sum(a_i n_i^2) / sqrt(sum(a_i^2 n_i^2)) of it where the normal is n: all of it on the
    axes and on a sphere, and never less than 2 sqrt(a b) / (a + b), a and b its longest and shortest.
    Raises InputError if nothing is left of it.
    """
    centre_m, semi_axes_m = inside.as_ellipsoid()
    believed = semi_axes_m + raised_m(inside, surface_seed(told))
    if believed.min() <= 0:
        raise InputError(
            f"light.surface.error: {inside.survey_sigma_m:g} m makes an ellipsoid of {believed.min():.3g} m; allowed:"
            " far less than the dome"
        )
    return turned(centre_m, told), believed
