"""Surveyed positions of LEDs, surface and camera, which the tracker assumes: the truth plus survey errors.

The errors are drawn once, from their own seed (`tracker.survey.seed`), because a survey is a property of the hardware
and not noise of a frame. Each kind of error has its own random stream, so adding one leaves the others unchanged.
"""

import numpy as np
from scipy.spatial.transform import Rotation

from skysim.core.constants import ARCSEC_RAD, PPM
from skysim.core.errors import InputError
from skysim.core.random_streams import random_stream
from skysim.core.types import Floats, azimuths_rad, normalized
from skysim.core.units import scaled_errors
from skysim.scene.sections.tracker import SurveyErrorsConfig, TotalStationConfig
from skysim.sources.dome.surface import Surface, directions
from skysim.sources.stars import axes_about_z

# A total station measures a horizontal direction, a zenith angle and a distance to each LED. The station at s sees an
# LED at p = s + D u, with the distance D and the unit vector u of the direction H and the zenith angle V. Each LED has
# errors of its own in H, V and D. The set-up has errors that all LEDs share: place, orientation and leveling of the
# station, scale and zero point of its distances. To first order an LED is displaced by
#
#     e_D u + D e_V v + D sin V e_H h          by its own errors,
#     c + r x (D u) + (m D + z) u              by those of the set-up,
#
# with u, v (toward greater V) and h (toward greater H) orthogonal, the station's displacement c, its rotation r
# (leveling about the lab's x and y, orientation about z), the relative error m of the scale and the error z of the
# zero point. So the own errors of an LED have the covariance
#
#     sigma_D^2 u u' + (D sigma_A)^2 (v v' + sin^2 V h h').
#
# (Ghilani 2017, Adjustment Computations, 6th ed., ch. 7: errors of conventional surveys; EDM law sigma^2 = a^2 +
# (b D)^2. ISO 17123-3 and 17123-4 define the figures of data sheets: 0.5" to 5", 1 mm + 1 ppm or 1.5 ppm to a prism,
# 2 mm + 2 ppm without.) Part b is an error of the meter's frequency and of the air's refraction, and so common to all
# LEDs; in a dome it is some micrometers. A direction's error grows as 1 / sin V for sights near the zenith where
# pointing dominates: `survey.led_sigma`, the target's own, contains pointing.


SETUP_ERRORS = 8  # centering 3, leveling 2, orientation, scale, zero point


def polar(config: TotalStationConfig, place_m: Floats) -> tuple[Floats, Floats, Floats]:
    """Horizontal direction H from the lab's x toward its y and zenith angle V in rad, and distance D in m, (N,) each.

    Raises
    ------
    InputError
        For an LED at the station.
    """
    sight_m = place_m - np.array(config.position_m)
    level_m = np.hypot(*sight_m.T[:2])
    distance_m = np.hypot(level_m, sight_m[:, 2])
    if not np.all(distance_m > 0):
        raise InputError(
            "tracker.survey.instrument.position",
            "an LED is there",
            "a place away from the LEDs",
        )
    return (
        azimuths_rad(sight_m),
        np.arctan2(level_m, sight_m[:, 2]),
        distance_m,
    )


def setup_sigmas(config: TotalStationConfig) -> list[float]:
    """Sizes of the common errors: place x, y, z (m); rotation about x, y, z (arcsec); scale (ppm); zero point (m)."""
    level = config.leveling_sigma_arcsec
    orientation = config.orientation_sigma_arcsec
    return [
        *3 * [config.centering_m],
        level,
        level,
        orientation,
        config.distance_ppm,
        config.zero_sigma_m,
    ]


# SI units of `setup_sigmas`.
SETUP_UNITS = np.array([1, 1, 1, ARCSEC_RAD, ARCSEC_RAD, ARCSEC_RAD, PPM, 1])


def draw_setup(config: TotalStationConfig, normal: Floats) -> Floats:
    """(8,) errors of the set-up in SI units, from standard normal numbers (8,)."""
    drawn = [
        float(scaled_errors(sigma, one))
        for sigma, one in zip(setup_sigmas(config), normal, strict=True)
    ]
    return np.array(drawn) * SETUP_UNITS


def moved_m(config: TotalStationConfig, place_m: Floats, setup: Floats) -> Floats:
    """(..., 3) places moved as a rigid body by the set-up's errors c and r: station's place, leveling, orientation."""
    station_m = np.array(config.position_m)
    return station_m + setup[:3] + Rotation.from_rotvec(setup[3:6]).apply(place_m - station_m)


def surveyed_m(
    config: TotalStationConfig, place_m: Floats, own: Floats, setup: Floats
) -> Floats:
    """(N, 3) places in the lab that the survey yields for LEDs at place_m (N, 3).

    1. Directions, zenith angles and distances of the LEDs, with the errors of each and of the distance meter.
    2. Places in the station's axes, moved by the set-up's errors.

    Parameters
    ----------
    own
        (N, 3) standard normal numbers for each LED's direction, zenith angle and distance
    setup
        (8,) errors from `draw_setup`
    """
    # 1.
    direction_rad, zenith_rad, distance_m = polar(config, place_m)
    angles_rad = ARCSEC_RAD * scaled_errors(config.angle_sigma_arcsec, own[:, :2])
    distance_m = (
        distance_m * (1 + setup[6])
        + setup[7]
        + scaled_errors(config.distance_sigma_m, own[:, 2])
    )
    # 2.
    along = directions(zenith_rad + angles_rad[:, 1], direction_rad + angles_rad[:, 0])
    return moved_m(config, np.array(config.position_m) + distance_m[:, None] * along, setup)


def station_covariance_m2(config: TotalStationConfig, place_m: Floats) -> Floats:
    """(N, 3, 3) covariances of the LEDs' own errors: sigma_D^2 u u' + (D sigma_A)^2 (v v' + sin^2 V h h').

    u is along the sight, v toward the zenith, h toward greater directions.
    """
    direction_rad, zenith_rad, distance_m = polar(config, place_m)
    across, up, along = axes_about_z(direction_rad, np.cos(zenith_rad), np.sin(zenith_rad))
    angle_rad = ARCSEC_RAD * float(config.angle_sigma_arcsec)
    scaled = np.stack(
        [
            float(config.distance_sigma_m) * along,
            (distance_m * angle_rad)[:, None] * up,
            (distance_m * np.sin(zenith_rad) * angle_rad)[:, None] * across,
        ]
    )
    return np.einsum("kni,knj->nij", scaled, scaled)


def station_displacements_m(config: TotalStationConfig, place_m: Floats) -> Floats:
    """(M, N, 3) displacements of the LEDs by one standard deviation of each error of the set-up that is not 0."""
    # Fields of a unit error: c along x, y, z; r x (D u) about x, y, z; m D u; z u.
    sight_m = place_m - np.array(config.position_m)
    unit = np.eye(3)
    fields = [np.broadcast_to(axis, sight_m.shape) for axis in unit]
    fields += [np.cross(axis, sight_m) for axis in unit]
    fields += [sight_m, normalized(sight_m)]
    sizes = np.array([float(sigma) for sigma in setup_sigmas(config)]) * SETUP_UNITS
    chosen = [size * field for size, field in zip(sizes, fields, strict=True) if size]
    return np.array(chosen).reshape(len(chosen), *place_m.shape)


# Random streams, one for each kind of error.
STREAM = {"leds": 1, "lever": 2, "surface": 3, "sights": 4, "setup": 5, "focal": 6}


def standard_normals(seed: int, kind: str, shape: tuple[int, ...]) -> Floats:
    """Standard normal numbers of a shape, which depend on the seed and the kind of error only."""
    return random_stream(seed, STREAM[kind]).standard_normal(shape)


def assumed_m(place_m: Floats, sigma_m: float, seed: int, kind: str) -> Floats:
    """Surveyed lengths: the true ones, of any shape, plus an error of sigma_m each; unchanged for 0."""
    if not sigma_m:
        return place_m
    return place_m + scaled_errors(sigma_m, standard_normals(seed, kind, place_m.shape))


def surface_seed(config: SurveyErrorsConfig) -> int:
    """Seed of the surface's survey error: surface_seed, or the survey's own."""
    return config.seed if config.surface_seed is None else config.surface_seed


def rotate_survey(places_m: Floats, config: SurveyErrorsConfig) -> Floats:
    """Surveyed places (..., 3) rotated by the orientation error of the survey's axes in the lab."""
    if not any(config.rotation_deg):
        return places_m
    return Rotation.from_rotvec(config.rotation_deg, degrees=True).apply(places_m)


def surface_offset_m(surface: Surface, seed: int) -> float:
    """Offset of the surveyed surface in m, outward along the normal of the true one.

    One draw for the whole surface, of the size light.surface.error (the arm's zero, its probe's radius). Independent
    errors of a thousand points would average out in a fitted ellipsoid.
    """
    return float(
        scaled_errors(surface.survey_sigma_m, standard_normals(seed, "surface", (1,)))[0]
    )


def assumed_leds_m(surface: Surface, place_m: Floats, config: SurveyErrorsConfig) -> Floats:
    """(N, 3) surveyed places of the LEDs.

    1. The surface's common offset along its normals.
    2. With an instrument, the errors of its sights and of its set-up.
    3. Independent errors, and the rotation of the axes.
    """
    # 1.
    offset_m = surface_offset_m(surface, surface_seed(config))
    displaced_m = place_m - offset_m * surface.inward(place_m) if offset_m else place_m
    # 2.
    if config.instrument is not None:
        sights = standard_normals(config.seed, "sights", place_m.shape)
        displaced_m = surveyed_m(config.instrument, displaced_m, sights, setup_errors(config))
    # 3.
    return rotate_survey(
        assumed_m(displaced_m, config.led_sigma_m, config.seed, "leds"), config
    )


def setup_errors(config: SurveyErrorsConfig) -> Floats:
    """(8,) errors of the instrument's set-up, drawn from the survey's seed."""
    assert config.instrument is not None
    drawn = standard_normals(config.seed, "setup", (SETUP_ERRORS,))
    return draw_setup(config.instrument, drawn)


def led_covariance_m2(place_m: Floats, config: SurveyErrorsConfig) -> Floats | None:
    """(N, 3, 3) covariances of the LEDs' own errors; None if they are those of led_sigma alone."""
    if config.instrument is None:
        return None
    return station_covariance_m2(config.instrument, place_m) + config.led_sigma_m**2 * np.eye(
        3
    )


def across_sigma_m(place_m: Floats, covariance_m2: Floats) -> Floats:
    """(N,) standard deviations of LEDs across the line from the bearing, per axis, from their (N, 3, 3) covariances.

    sigma^2 = (trace C - u' C u) / 2, with the direction u from the bearing. The error along u hardly moves an image.
    """
    along = normalized(place_m)
    along_m2 = np.einsum("ni,nij,nj->n", along, covariance_m2, along)
    return np.sqrt((np.trace(covariance_m2, axis1=1, axis2=2) - along_m2) / 2)


def common_displacements_m(
    surface: Surface, place_m: Floats, config: SurveyErrorsConfig
) -> Floats | None:
    """(M, N, 3) displacements of the LEDs by one standard deviation of each error that all share; None without any.

    These are the survey error of the surface, along its normals, and the errors of the instrument's set-up.
    """
    fields = []
    if surface.survey_sigma_m:
        fields.append(-surface.survey_sigma_m * surface.inward(place_m)[None])
    if config.instrument is not None:
        fields.append(station_displacements_m(config.instrument, place_m))
    joined = np.concatenate(fields) if fields else np.zeros((0, *place_m.shape))
    return joined if len(joined) else None


def assumed_ellipsoid(surface: Surface, config: SurveyErrorsConfig) -> tuple[Floats, Floats]:
    """Center and semi-axes of the surveyed ellipsoid, (3,) each in m.

    The nearest ellipsoid, with semi-axes longer by the offset `surface_offset_m`. That displaces an ellipsoid by
    sum(a_i n_i^2) / sqrt(sum(a_i^2 n_i^2)) of the offset where the normal is n: by all of it on the axes and on a
    sphere, and never by less than 2 sqrt(a b) / (a + b), with a and b its longest and shortest semi-axis. An
    instrument's set-up moves it as a rigid body.

    Raises
    ------
    InputError
        If a semi-axis is not positive.
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
        center_m = moved_m(config.instrument, center_m, setup_errors(config))
    return rotate_survey(center_m, config), assumed_axes_m


def assumed_focal_length_m(focal_length_m: float, config: SurveyErrorsConfig) -> float:
    """The focal length that the tracker assumes: the true one plus its survey error."""
    true_m = np.array([focal_length_m])
    return float(assumed_m(true_m, config.focal_length_sigma_m, config.seed, "focal")[0])
