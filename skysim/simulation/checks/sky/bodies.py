"""Whether the Sun, the Moon or a planet is in the field of a scene's frames, and whether Sun or Moon is near it."""

from __future__ import annotations

import math
from collections.abc import Iterator

import numpy as np

from skysim.core.types import Floats
from skysim.scene.sections.camera import CameraConfig
from skysim.simulation.checks import attitudes
from skysim.simulation.checks.detection import Context, full_scale_e
from skysim.simulation.checks.facts import short
from skysim.simulation.checks.sampling import Samples
from skysim.simulation.checks.views import peak_share
from skysim.sources.solar_system.bodies import NAMES, BodyLight

NEAR_DEG = {"sun": 60.0, "moon": 30.0}  # from the boresight, where their stray light would matter


def bodies_near(context: Context, samples: Samples) -> Iterator[str]:
    """A line for each body: the frame at which it is nearest to the boresight, if it is in the field or near it."""
    lab = context.lab
    at = samples.frames.attitudes
    cam_from_lab = lab.camera.mount.cam_from_body * at.lab_from_body.inv()
    closest: dict[str, tuple[float, int, BodyLight]] = {}
    for n, beam in enumerate(samples.frames.beams):
        for body in beam.discs:
            z = float(cam_from_lab[n].apply(body.place.direction)[2])
            off = math.acos(max(min(z, 1.0), -1.0)), n, body
            closest[body.name] = min(closest.get(body.name, off), off, key=lambda found: found[0])
    for name, (off_rad, n, body) in closest.items():
        seen = body.truth()
        where = attitudes.describe(at, n, lab.scene, lab.camera.mount)
        what = f"light.bodies: {NAMES[body.id]} (V {seen.v_mag:.1f}, {short(seen.diameter_arcsec, 2)}″ wide)"
        far = f"{math.degrees(off_rad):.1f}° from the boresight at {where}"
        if in_field(cam_from_lab[n].apply(body.place.direction), body.radius_rad, lab.scene.camera):
            yield f"{what} is in the field, {far}: {short(peak_fill(context, body), 2)} times saturation"
        elif lab.scene.camera.baffle is None and off_rad < math.radians(NEAR_DEG.get(name, 0.0)):
            yield f"{what} is {far}; its stray light is not drawn: add camera.baffle, or a background of kind stray"


def in_field(direction_cam: Floats, radius_rad: float, camera: CameraConfig) -> bool:
    """Whether a disc about a direction (3,) overlaps the chip of a lens without distortion."""
    if direction_cam[2] <= 0:
        return False
    xy_px = camera.focal_px * np.abs(direction_cam[:2]) / direction_cam[2]
    half_px = np.array([camera.width_px, camera.height_px]) / 2 + camera.focal_px * math.tan(
        radius_rad
    )
    return bool((xy_px < half_px).all())


def peak_fill(context: Context, body: BodyLight) -> float:
    """Electrons in the brightest pixel of a body at rest over saturation; a phase is a disk of its bright area."""
    camera = context.camera
    scene = context.lab.scene
    lit = (1 + math.cos(body.place.phase_rad)) / 2
    radius_px = scene.camera.focal_px * math.tan(body.radius_rad) * math.sqrt(lit)
    lens2_px2 = np.array([camera.lens_px**2])
    radius = np.array([radius_px])
    none = np.zeros(1)
    electrons = body.flux_e_s_m2 * camera.optics.collecting_m2 * camera.exposure_s
    return (
        electrons
        * float(peak_share(lens2_px2, radius, none, none)[0])
        / full_scale_e(scene.camera.detector)
    )
