"""A two-axis mount, which turns the camera by azimuth and elevation (Padro 2012, 2.6: JHU/APL's dome).

    lab_from_body = Rz(azimuth) Ry(elevation),

so its second column is (-sin azimuth, cos azimuth, 0) and its third row (-sin elevation, 0, cos elevation): both angles
follow from any attitude that the mount can take. At elevation 0 the boresight (body z) is the azimuth's axis: gimbal
lock. There the azimuth does not move the boresight, and beside it a light's path needs azimuth rates as high as its own
rate over sin(elevation).
"""

from dataclasses import replace

import numpy as np
from scipy.spatial.transform import Rotation

from skysim.core.constants import ARCSEC_RAD
from skysim.core.types import Floats
from skysim.dynamics.profile_samples import Samples
from skysim.scene.sections.vehicle import GimbalsConfig

THIRD_AXIS_RAD = 1e-6  # greatest rotation about a third axis that counts as rounding
AXES = ("azimuth", "elevation")


def on_gimbals(samples: Samples, config: GimbalsConfig) -> Samples:
    """The attitudes that a mount takes if it is commanded checked samples of lab_from_body.

    1. Angles of both axes, without jumps of whole turns.
    2. Limits of the angles and of their mean rates between samples.
    3. Angles are rounded to the resolution. After each reversal an axis rests until the play of its gears is used up.

    Raises
    ------
    InputError
        For an attitude that needs a third axis, and beyond the limits.
    """
    # 1. Angles.
    R = samples.a_from_b.as_matrix()
    azimuth = np.arctan2(-R[:, 0, 1], R[:, 1, 1])
    angle_rad = np.unwrap(np.stack([azimuth, np.arctan2(-R[:, 2, 0], R[:, 2, 2])]))
    third_rad = (Rotation.from_euler("ZY", angle_rad.T).inv() * samples.a_from_b).magnitude()
    if third_rad.max() > THIRD_AXIS_RAD:
        n = int(third_rad.argmax())
        raise samples.error(
            n,
            f"an attitude {np.degrees(third_rad[n]):.3g} deg from any of a two-axis mount",
            "columns azimuth_deg, elevation_deg",
        )
    # The turn of the azimuth in which the profile begins.
    first_rad = np.radians(config.azimuth_deg[0])
    angle_rad[0] += 2 * np.pi * np.ceil((first_rad - angle_rad[0, 0]) / (2 * np.pi) - 1e-9)
    # 2. Limits.
    check_limits(samples, np.degrees(angle_rad).round(9), config)
    # 3. Resolution and play.
    if config.resolution_arcsec:
        step_rad = config.resolution_arcsec * ARCSEC_RAD
        angle_rad = np.round(angle_rad / step_rad) * step_rad
    half_rad = config.backlash_arcsec * ARCSEC_RAD / 2
    for n in range(1, angle_rad.shape[1] if half_rad else 0):
        commanded = angle_rad[:, n]
        angle_rad[:, n] = np.clip(
            angle_rad[:, n - 1], commanded - half_rad, commanded + half_rad
        )
    return replace(samples, a_from_b=Rotation.from_euler("ZY", angle_rad.T))


def check_limits(samples: Samples, angle_deg: Floats, config: GimbalsConfig) -> None:
    """Raise InputError for (2, N) angles beyond the limits, and for rates beyond theirs."""
    low_high_deg = np.array([config.azimuth_deg, config.elevation_deg])
    beyond = np.argwhere(angle_deg != np.clip(angle_deg, *low_high_deg.T[:, :, None]))
    if len(beyond):
        axis, n = beyond[0].tolist()
        low, high = low_high_deg[axis]
        raise samples.error(
            n,
            f"{AXES[axis]} {angle_deg[axis, n]:.6g} deg",
            f"{low:g} to {high:g}, vehicle.gimbals.{AXES[axis]}_deg",
        )
    rate_deg_s = (np.abs(np.diff(angle_deg)) / np.diff(samples.t_s)).round(9)
    axis, n = divmod(int(rate_deg_s.argmax()), len(samples.t_s) - 1)
    if rate_deg_s[axis, n] > config.rate_limit_deg_s:
        raise samples.error(
            n + 1,
            f"{AXES[axis]} at {rate_deg_s[axis, n]:.4g} deg/s, at elevation {angle_deg[1, n]:.3g} deg;"
            " 0 is gimbal lock",
            f"up to vehicle.gimbals.rate_limit_deg_s {config.rate_limit_deg_s:g}",
        )
