"""Errors of a survey of LEDs by a total station: a horizontal direction, a zenith angle and a distance to each.

The station at s sees an LED at p = s + D u, D its distance and u the unit vector with the direction H and the zenith
angle V. Each LED has errors of its own in H, V and D. The set-up has errors that all LEDs share: place, orientation and
leveling of the station, scale and zero point of its distances. To first order an LED is displaced by

    e_D u + D e_V v + D sin V e_H h          of its own
    c + r x (D u) + (m D + z) u              of the set-up

with u, v (toward greater V) and h (toward greater H) orthogonal, the station's displacement c, its rotation r (leveling
about the lab's x and y, orientation about z), the relative error m of the scale and the error z of the zero point. So
the own errors of an LED have the covariance

    sigma_D^2 u u' + (D sigma_A)^2 (v v' + sin^2 V h h').

(Ghilani 2017, Adjustment Computations, 6th ed., ch. 7: errors of conventional surveys; EDM law sigma^2 = a^2 +
(b D)^2. ISO 17123-3 and 17123-4 define the figures of data sheets: 0.5" to 5", 1 mm + 1 ppm or 1.5 ppm to a prism, 2 mm
+ 2 ppm without.) Part b is an error of the meter's frequency and of the air's refraction, and so common to all LEDs; in
a dome it is some micrometers. A direction's error grows as 1 / sin V for sights near the zenith where pointing
dominates: `survey.led_sigma`, the target's own, stands for pointing.
"""

from __future__ import annotations

import numpy as np
from scipy.spatial.transform import Rotation

from skysim.core.constants import ARCSEC_RAD, PPM
from skysim.core.errors import InputError
from skysim.core.tolerance import scaled_errors
from skysim.core.types import Floats
from skysim.scene.sections.tracker import TotalStationConfig

SETUP_ERRORS = 8  # centering 3, leveling 2, orientation, scale, zero point


def polar(config: TotalStationConfig, place_m: Floats) -> tuple[Floats, Floats, Floats]:
    """Horizontal direction from the lab's x toward its y and zenith angle, rad, and distance, m, (N,) each.

    Raises InputError for an LED at the station.
    """
    sight_m = place_m - np.array(config.position_m)
    level_m = np.hypot(sight_m[:, 0], sight_m[:, 1])
    distance_m = np.hypot(level_m, sight_m[:, 2])
    if not np.all(distance_m > 0):
        raise InputError(
            "tracker.survey.instrument.position", "an LED is there", "a place away from the LEDs"
        )
    return np.arctan2(sight_m[:, 1], sight_m[:, 0]), np.arctan2(level_m, sight_m[:, 2]), distance_m


def axes(direction_rad: Floats, zenith_rad: Floats) -> tuple[Floats, Floats, Floats]:
    """Unit vectors u along the sight, v toward greater zenith angles, h toward greater directions, (N, 3) each."""
    cos_h = np.cos(direction_rad)
    sin_h = np.sin(direction_rad)
    zero = np.zeros(len(direction_rad))
    cos_v = np.cos(zenith_rad)
    sin_v = np.sin(zenith_rad)
    return (
        np.column_stack([sin_v * cos_h, sin_v * sin_h, cos_v]),
        np.column_stack([cos_v * cos_h, cos_v * sin_h, -sin_v]),
        np.column_stack([-sin_h, cos_h, zero]),
    )


def setup_sigmas(config: TotalStationConfig) -> list[float]:
    """Sizes of the common errors in SI units: place x, y, z; rotation about x, y, z; scale; zero point."""
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


SETUP_UNITS = np.array([1, 1, 1, ARCSEC_RAD, ARCSEC_RAD, ARCSEC_RAD, PPM, 1])  # of setup_sigmas


def draw_setup(config: TotalStationConfig, normal: Floats) -> Floats:
    """(8,) errors of the set-up, SI units, from standard normal numbers (8,)."""
    drawn = [
        float(scaled_errors(sigma, one))
        for sigma, one in zip(setup_sigmas(config), normal, strict=True)
    ]
    return np.array(drawn) * SETUP_UNITS


def moved_m(config: TotalStationConfig, place_m: Floats, setup: Floats) -> Floats:
    """(..., 3) places moved as a rigid body by the set-up's errors: station's place, leveling and orientation."""
    station_m = np.array(config.position_m)
    return np.asarray(
        station_m + setup[:3] + Rotation.from_rotvec(setup[3:6]).apply(place_m - station_m)
    )


def surveyed_m(config: TotalStationConfig, place_m: Floats, own: Floats, setup: Floats) -> Floats:
    """(N, 3) places in the lab that the survey yields for LEDs at place_m.

    own   : (N, 3) standard normal numbers of each LED's direction, zenith angle and distance
    setup : (8,) of `draw_setup`
    """
    direction_rad, zenith_rad, distance_m = polar(config, place_m)
    angles_rad = ARCSEC_RAD * scaled_errors(config.angle_sigma_arcsec, own[:, :2])
    distance_m = (
        distance_m * (1 + setup[6]) + setup[7] + scaled_errors(config.distance_sigma_m, own[:, 2])
    )
    along, _, _ = axes(direction_rad + angles_rad[:, 0], zenith_rad + angles_rad[:, 1])
    return moved_m(config, np.array(config.position_m) + distance_m[:, None] * along, setup)


def covariance_m2(config: TotalStationConfig, place_m: Floats) -> Floats:
    """(N, 3, 3) covariance of each LED's own error, in the lab."""
    direction_rad, zenith_rad, distance_m = polar(config, place_m)
    along, down, across = axes(direction_rad, zenith_rad)
    angle_rad = ARCSEC_RAD * float(config.angle_sigma_arcsec)
    scaled = np.stack(
        [
            float(config.distance_sigma_m) * along,
            (distance_m * angle_rad)[:, None] * down,
            (distance_m * np.sin(zenith_rad) * angle_rad)[:, None] * across,
        ]
    )
    return np.einsum("kni,knj->nij", scaled, scaled)


def common_displacements_m(config: TotalStationConfig, place_m: Floats) -> Floats:
    """(M, N, 3) displacement of each LED by one standard deviation of each error of the set-up, without those of 0."""
    sight_m = place_m - np.array(config.position_m)
    unit = np.eye(3)
    fields = [np.broadcast_to(axis, sight_m.shape) for axis in unit]
    fields += [np.cross(axis, sight_m) for axis in unit]
    fields += [sight_m, sight_m / np.linalg.norm(sight_m, axis=1, keepdims=True)]
    sizes = np.array([float(sigma) for sigma in setup_sigmas(config)]) * SETUP_UNITS
    chosen = [size * field for size, field in zip(sizes, fields, strict=True) if size]
    return np.array(chosen).reshape(len(chosen), *place_m.shape)
