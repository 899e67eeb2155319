"""Optical fibers in a shell (JHU/APL's dome): their ends at another layout's points, with the errors of making them.

JHU/APL put a laser on the star tracker's mount, turned it to each star's direction and drilled where its spot was
(Boone et al. 2005, as described by Padro 2012, section 2.6; the procedure is what Padro's section 5.2.2 recommends). So
a hole errs by the laser's direction, and an error of the shell displaces it along the laser's line, where a camera at
the laser's place does not see it. Without a laser the error of the shell displaces it along the surface's normal.
"""

from __future__ import annotations

import dataclasses

import numpy as np
from scipy.spatial.transform import Rotation

from skysim.core.constants import ARCSEC_RAD
from skysim.core.errors import InputError
from skysim.core.random_streams import random_stream
from skysim.core.tolerance import scaled_errors
from skysim.core.types import Floats, Sources
from skysim.scene.sections.layouts import AimingConfig, FibersConfig
from skysim.sources.dome.shell.surface import Surface, perpendicular

SHELL_STREAM = (
    2  # spawn key of the shell's own random stream, which leaves the fibers' places unchanged
)
AIMING_STREAM = 5  # spawn key of the laser's errors


def displace_ends(config: FibersConfig, surface: Surface, fibers: Sources) -> Sources:
    """Displace each fiber's end by the errors of its hole and by v R, the radius error of a stretched shell.

    v is uniform in +-config.radius_variation, R the end's distance from the bearing; positive is outward, along the
    surface's normal, or with a laser along its line by v R / cos(incidence). A camera r off the place from which the
    error is along the line of sight sees an end displaced by up to (r / R) v rad (JHU/APL's .4 % of 4 ft, 50 mm off:
    34"). Normals are those of the design. The random stream is that of config.points.hardware_seed.
    """
    seed = config.points.hardware_seed
    place_m = fibers.place[:, :3]
    fraction = config.radius_variation * random_stream(seed, SHELL_STREAM).uniform(
        -1, 1, len(fibers)
    )
    outward_m = fraction * np.linalg.norm(place_m, axis=1)
    if config.aiming is None:
        moved = place_m - outward_m[:, None] * fibers.normal
    else:
        moved = marked_m(
            config.aiming, surface, place_m, outward_m, random_stream(seed, AIMING_STREAM)
        )
    return dataclasses.replace(fibers, place=np.column_stack([moved, fibers.place[:, 3]]))


def marked_m(
    config: AimingConfig,
    surface: Surface,
    place_m: Floats,
    outward_m: Floats,
    rng: np.random.Generator,
) -> Floats:
    """(N, 3) places of holes that a laser marks for designed places (N, 3) of a surface that is outward_m off there.

    From the laser at s toward p the line has the direction u = (p - s) / |p - s|. It is rotated by the mount's common
    error and by two angles across it, meets the surface at q, and the real shell, e outward, at q + e / (n . u) u, n
    the outward normal. The drill then errs along two axes in the surface. So an angle a displaces a hole by D a across
    its line, D the distance, and by D a / (n . u) along the surface in the plane of incidence.
    Raises InputError for a laser outside the dome, and for a line that passes below its rim.
    """
    laser_m = np.array(config.laser_m)
    if not surface.inside(laser_m):
        raise InputError(
            "light.layout.aiming.laser", f"{config.laser_m} m is outside of the dome", "inside"
        )
    sight_m = place_m - laser_m
    line = sight_m / np.linalg.norm(sight_m, axis=1, keepdims=True)
    common = scaled_errors(config.orientation_sigma_arcsec, rng.standard_normal(3)) * ARCSEC_RAD
    angles = (
        scaled_errors(config.pointing_sigma_arcsec, rng.standard_normal((len(line), 2)))
        * ARCSEC_RAD
    )
    line = Rotation.from_rotvec(common).apply(line + along_two_axes(line, angles))
    line /= np.linalg.norm(line, axis=1, keepdims=True)
    mark_m = surface.meet(laser_m, line)
    if np.isnan(mark_m).any():
        raise InputError(
            "light.layout.aiming", "the laser's line passes below the rim", "a smaller cap_deg"
        )
    normal = surface.inward(mark_m)
    mark_m += (-outward_m / np.sum(normal * line, axis=1))[:, None] * line
    drill_m = scaled_errors(config.drill_sigma_m, rng.standard_normal((len(line), 2)))
    return np.asarray(mark_m + along_two_axes(normal, drill_m))


def along_two_axes(unit: Floats, size: Floats) -> Floats:
    """(N, 3) vectors perpendicular to unit vectors (N, 3), with components (N, 2) along two axes across them."""
    first = perpendicular(unit)
    return np.asarray(size[:, :1] * first + size[:, 1:] * np.cross(unit, first))
