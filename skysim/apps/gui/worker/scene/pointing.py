"""Camera pointing: from typed angles, or by rotations about the camera's own axes, which have no singularity."""

from __future__ import annotations

import math

import numpy as np
from scipy.spatial.transform import Rotation

from skysim.core.errors import InputError
from skysim.core.types import Mount
from skysim.dynamics import guidance, multibody
from skysim.results import scoring
from skysim.scene.scene import Scene
from skysim.scene.sections.light import StarsConfig
from skysim.scene.sections.motion import AttitudeConfig
from skysim.sources import stars

# step of an arrow key without and with shift, in fields of view
FINE = 0.02
COARSE = 0.2
ROLL_FINE_DEG = 1.0
ROLL_COARSE_DEG = 10.0
RANGES = {  # degrees
    "RA": (0.0, 360.0),
    "Dec": (-90.0, 90.0),
    "roll": (-360.0, 360.0),
    "pitch": (-90.0, 90.0),
    "yaw": (-360.0, 360.0),
}


def from_angles(scene: Scene, mount: Mount, angles_deg: tuple[float, float, float]) -> Rotation:
    """lab_from_body from RA, Dec, roll of the camera under stars, else from roll, pitch, yaw of the vehicle; degrees.

    Raises InputError for an angle out of range, or a tilt beyond the vehicle's stop.
    """
    for name, angle in zip(scoring.angle_names(scene), angles_deg, strict=True):
        low, high = RANGES[name]
        if not (math.isfinite(angle) and low <= angle <= high):
            raise InputError(name, f"{angle:g} deg is not allowed", f"{low:g} to {high:g}")
    if isinstance(scene.light, StarsConfig):
        return stars.cam_from_icrs(*angles_deg).inv() * mount.cam_from_body
    roll, pitch, yaw = angles_deg
    start = AttitudeConfig.model_validate({"roll_deg": roll, "pitch_deg": pitch, "yaw_deg": yaw})
    return within_stop(scene, guidance.attitude(start))


def moved(
    scene: Scene, mount: Mount, lab_from_body: Rotation, right: float, up: float, roll_deg: float
) -> Rotation:
    """lab_from_body after moving the boresight right and up (in fields of view) and rolling the camera clockwise.

    The three form one rotation vector about the camera's axes (x right, y down, z boresight). Raises InputError
    beyond the tilt stop.
    """
    camera = scene.camera
    field_rad = 2 * math.atan(camera.width_px / 2 / camera.focal_px)
    rotation_vector = np.array([up * field_rad, right * field_rad, math.radians(roll_deg)])
    new_from_cam = Rotation.from_rotvec(rotation_vector).inv()
    cam_from_lab = new_from_cam * mount.cam_from_body * lab_from_body.inv()
    return within_stop(scene, cam_from_lab.inv() * mount.cam_from_body)


def within_stop(scene: Scene, lab_from_body: Rotation) -> Rotation:
    """Return the attitude. Raises InputError if its tilt is beyond the air bearing's stop."""
    vehicle = scene.vehicle
    tilt_deg = float(multibody.tilt_deg(lab_from_body))
    if vehicle.mount == "air_bearing" and tilt_deg > vehicle.tilt_stop_deg:
        raise InputError(
            "", f"tilt of {tilt_deg:.1f} deg: the bearing stops at {vehicle.tilt_stop_deg:g} deg"
        )
    return lab_from_body
