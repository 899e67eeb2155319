"""Surveyed positions of LEDs, surface and camera, which the tracker assumes: the truth plus survey errors.

The errors are drawn once, from their own seed (`tracker.survey.seed`), because a survey is a property of the hardware
and not noise of a frame. Each kind of error has its own random stream, so adding one leaves the others unchanged.
"""

from __future__ import annotations

from scipy.spatial.transform import Rotation

from skysim.core.errors import InputError
from skysim.core.random_streams import random_stream
from skysim.core.tolerance import scaled_errors
from skysim.core.types import Floats
from skysim.scene.tracker import SurveyErrorsConfig
from skysim.sources.dome.surface import Surface

STREAM = {"leds": 1, "lever": 2, "surface": 3}


def standard_normals(seed: int, kind: str, shape: tuple[int, ...]) -> Floats:
    """Standard normal numbers of that shape; they depend on the seed and the kind of error only."""
    return random_stream(seed, STREAM[kind]).standard_normal(shape)


def assumed_m(place_m: Floats, sigma_m: float, seed: int, kind: str) -> Floats:
    """Surveyed places: the true ones (..., 3) plus an error of this size along each axis; unchanged for 0."""
    return place_m + scaled_errors(sigma_m, standard_normals(seed, kind, place_m.shape)) if sigma_m else place_m


def surface_seed(config: SurveyErrorsConfig) -> int:
    """Seed of the surface's survey error."""
    return config.seed if config.surface_seed is None else config.surface_seed


def rotate_survey(places_m: Floats, config: SurveyErrorsConfig) -> Floats:
    """Surveyed places (..., 3) rotated by the orientation error of the survey's axes in the lab."""
    if not any(config.rotation_deg):
        return places_m
    return Rotation.from_rotvec(config.rotation_deg, degrees=True).apply(places_m)


def surface_offset_m(surface: Surface, seed: int) -> float:
    """Offset of the surveyed surface, outward along the normal of the true one, of the size light.surface.error.

    One draw for the whole surface (the arm's zero, its probe's radius). Independent errors of a thousand points
    average out in a fitted ellipsoid.
    """
    return float(scaled_errors(surface.survey_sigma_m, standard_normals(seed, "surface", (1,)))[0])


def assumed_leds_m(surface: Surface, place_m: Floats, config: SurveyErrorsConfig) -> Floats:
    """(N, 3) surveyed LED places: independent errors, the surface's common offset and the rotation of the axes."""
    offset_m = surface_offset_m(surface, surface_seed(config))
    displaced_m = place_m - offset_m * surface.inward(place_m) if offset_m else place_m
    return rotate_survey(assumed_m(displaced_m, config.led_sigma_m, config.seed, "leds"), config)


def assumed_ellipsoid(surface: Surface, config: SurveyErrorsConfig) -> tuple[Floats, Floats]:
    """Center and semi-axes, (3,) each, m, of the surveyed ellipsoid: the nearest one, longer by `surface_offset_m`.

    That displaces an ellipsoid by sum(a_i n_i^2) / sqrt(sum(a_i^2 n_i^2)) of the offset where the normal is n: by all
    of it on the axes and on a sphere, and never by less than 2 sqrt(a b) / (a + b), a and b its longest and shortest
    semi-axis. Raises InputError if a semi-axis is not positive.
    """
    center_m, semi_axes_m = surface.as_ellipsoid()
    assumed_axes_m = semi_axes_m + surface_offset_m(surface, surface_seed(config))
    if assumed_axes_m.min() <= 0:
        raise InputError(
            f"light.surface.error: {surface.survey_sigma_m:g} m makes an ellipsoid of {assumed_axes_m.min():.3g} m;"
            " allowed: far less than the dome"
        )
    return rotate_survey(center_m, config), assumed_axes_m
