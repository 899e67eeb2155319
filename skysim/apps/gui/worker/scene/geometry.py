"""3-D geometry of the laboratory, as numbers for the browser to draw."""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from skysim.apps.gui.messages import LabGeometry, LookFrom
from skysim.core.types import Floats, Sources
from skysim.dynamics import multibody
from skysim.dynamics.multibody.view.mjcf_export import FOVY_DEG, LED_RADIUS_M, SKY_RADIUS_M
from skysim.simulation.lab import Lab

MAX_STARS = 600
MAX_LEDS = 4000
WIDE_DEG = 100.0  # of the view from the bearing


def lab_geometry(lab: Lab) -> LabGeometry:
    """Geometry of a lab: that of its MJCF file, its lights, and the places to look from."""
    model = multibody.laboratory(lab.export_mjcf())
    return LabGeometry(model.shapes, *lights(lab.camera.sources), views(lab, model))


def lights(sources: Sources) -> tuple[NDArray[np.int64], Floats, Floats, NDArray[np.bool_]]:
    """Ids, (N, 3) positions, (N,) drawn radii in m of the brightest lights, the brightest first, and which are lit.

    An LED's radius grows with the time-averaged power to the power of 0.3, so that faint ones remain visible; a star's
    with its square root, as in the MJCF file.
    """
    power = sources.strength * np.minimum(sources.on_s / sources.period_s, 1.0)
    stars = bool((sources.place[:, 3] == 0).any())
    rows = np.argsort(-power, kind="stable")[: MAX_STARS if stars else MAX_LEDS]
    fraction = power[rows] / power.max(initial=1e-300)
    position_m = sources.place[rows, :3] * (SKY_RADIUS_M if stars else 1.0)
    radius_m = (
        0.006 + 0.04 * np.sqrt(fraction)
        if stars
        else LED_RADIUS_M * np.clip(fraction**0.3, 0.3, 1.0)
    )
    return sources.id[rows], position_m, radius_m, power[rows] > 0


def views(lab: Lab, model: multibody.Laboratory) -> dict[str, LookFrom]:
    """The places to look from: outside, from the camera along its boresight, from the bearing up, and from above."""
    camera = lab.scene.camera
    mount = lab.camera.mount
    body_from_cam = mount.cam_from_body.inv()
    pupil_m = mount.camera_body_m
    height_m = np.linalg.norm(model.eye_m - model.target_m)
    field_deg = 2 * math.degrees(math.atan(camera.height_px / 2 / camera.focal_px))
    up = np.array([0.0, 0.0, 1.0])
    north = np.array([0.0, 1.0, 0.0])
    ahead, above = body_from_cam.apply([[0.0, 0.0, 1.0], [0.0, -1.0, 0.0]])
    return {
        "outside": look_from(model.eye_m, model.target_m, up, FOVY_DEG),
        "camera": look_from(pupil_m, pupil_m + ahead, above, field_deg, on_vehicle=True),
        "bearing": look_from(np.zeros(3), up, north, WIDE_DEG),
        "top": look_from(model.target_m + height_m * up, model.target_m, north, FOVY_DEG),
    }


def look_from(
    eye_m: Floats, target_m: Floats, up: Floats, fov_deg: float, on_vehicle: bool = False
) -> LookFrom:
    eye, target, upwards = ((float(x), float(y), float(z)) for x, y, z in (eye_m, target_m, up))
    return LookFrom(eye, target, upwards, fov_deg, on_vehicle)
