"""Surveyed positions of LEDs, surface and camera, which the tracker assumes: the truth plus survey errors.

The errors are drawn once, from their own seed (`tracker.survey.seed`), because a survey is a property of the hardware
and not noise of a frame. Each kind of error has its own random stream, so adding one leaves the others unchanged.
"""

from __future__ import annotations

import numpy as np
from scipy.spatial.transform import Rotation

from skysim.core.errors import InputError
from skysim.core.random_streams import random_stream
from skysim.core.tolerance import scaled_errors
from skysim.core.types import Floats
from skysim.scene.sections.tracker import SurveyErrorsConfig
from skysim.sources.dome.shell.surface import Surface
from skysim.sources.dome.survey import total_station

STREAM = {"leds": 1, "lever": 2, "surface": 3, "sights": 4, "setup": 5, "focal": 6}


def standard_normals(seed: int, kind: str, shape: tuple[int, ...]) -> Floats:
    """Standard normal numbers of that shape; they depend on the seed and the kind of error only."""
    return random_stream(seed, STREAM[kind]).standard_normal(shape)


def assumed_m(place_m: Floats, sigma_m: float, seed: int, kind: str) -> Floats:
    """Surveyed places: the true ones (..., 3) plus an error of this size along each axis; unchanged for 0."""
    return (
        place_m + scaled_errors(sigma_m, standard_normals(seed, kind, place_m.shape))
        if sigma_m
        else place_m
    )


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
    """(N, 3) surveyed LED places: independent errors, the surface's common offset and the rotation of the axes.

    An instrument adds the errors of its sights and of its set-up.
    """
    offset_m = surface_offset_m(surface, surface_seed(config))
    displaced_m = place_m - offset_m * surface.inward(place_m) if offset_m else place_m
    if config.instrument is not None:
        sights = standard_normals(config.seed, "sights", place_m.shape)
        displaced_m = total_station.surveyed_m(
            config.instrument, displaced_m, sights, setup_errors(config)
        )
    return rotate_survey(assumed_m(displaced_m, config.led_sigma_m, config.seed, "leds"), config)


def setup_errors(config: SurveyErrorsConfig) -> Floats:
    """(8,) errors of the instrument's set-up, drawn."""
    assert config.instrument is not None
    drawn = standard_normals(config.seed, "setup", (total_station.SETUP_ERRORS,))
    return total_station.draw_setup(config.instrument, drawn)


def led_covariance_m2(place_m: Floats, config: SurveyErrorsConfig) -> Floats | None:
    """(N, 3, 3) covariance of each LED's own error; None if it is that of led_sigma alone."""
    if config.instrument is None:
        return None
    return total_station.covariance_m2(config.instrument, place_m) + config.led_sigma_m**2 * np.eye(
        3
    )


def across_sigma_m(place_m: Floats, covariance_m2: Floats) -> Floats:
    """(N,) standard deviation of LEDs across the line from the bearing, per axis, from their (N, 3, 3) covariances.

    sigma^2 = (trace C - u' C u) / 2, u the direction from the bearing. The error along u hardly moves an image.
    """
    along = place_m / np.linalg.norm(place_m, axis=1, keepdims=True)
    along_m2 = np.einsum("ni,nij,nj->n", along, covariance_m2, along)
    return np.asarray(np.sqrt((np.trace(covariance_m2, axis1=1, axis2=2) - along_m2) / 2))


def common_displacements_m(
    surface: Surface, place_m: Floats, config: SurveyErrorsConfig
) -> Floats | None:
    """(M, N, 3) displacement of each LED by one standard deviation of each error that all share; None without any.

    The survey error of the surface, along its normals, and the errors of the instrument's set-up.
    """
    fields = []
    if surface.survey_sigma_m:
        fields.append(-surface.survey_sigma_m * surface.inward(place_m)[None])
    if config.instrument is not None:
        fields.append(total_station.common_displacements_m(config.instrument, place_m))
    joined = np.concatenate(fields) if fields else np.zeros((0, *place_m.shape))
    return joined if len(joined) else None


def assumed_ellipsoid(surface: Surface, config: SurveyErrorsConfig) -> tuple[Floats, Floats]:
    """Center and semi-axes, (3,) each, m, of the surveyed ellipsoid: the nearest one, longer by `surface_offset_m`.

    That displaces an ellipsoid by sum(a_i n_i^2) / sqrt(sum(a_i^2 n_i^2)) of the offset where the normal is n: by all
    of it on the axes and on a sphere, and never by less than 2 sqrt(a b) / (a + b), a and b its longest and shortest
    semi-axis. An instrument's set-up moves it as a rigid body. Raises InputError if a semi-axis is not positive.
    """
    center_m, semi_axes_m = surface.as_ellipsoid()
    assumed_axes_m = semi_axes_m + surface_offset_m(surface, surface_seed(config))
    if assumed_axes_m.min() <= 0:
        raise InputError(
            "light.surface.error",
            f"{surface.survey_sigma_m:g} m makes an ellipsoid of {assumed_axes_m.min():.3g} m",
            "far less than the dome",
        )
    if config.instrument is not None:
        center_m = total_station.moved_m(config.instrument, center_m, setup_errors(config))
    return rotate_survey(center_m, config), assumed_axes_m


def assumed_focal_length_m(focal_length_m: float, config: SurveyErrorsConfig) -> float:
    """The focal length that the tracker assumes: the true one plus its survey error."""
    if not config.focal_length_sigma_m:
        return focal_length_m
    drawn = standard_normals(config.seed, "focal", (1,))
    return focal_length_m + float(scaled_errors(config.focal_length_sigma_m, drawn)[0])
