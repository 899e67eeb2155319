"""Pre-run warnings: where the scene breaks an assumption of its tracker or of the frames' WCS."""

from __future__ import annotations

import numpy as np

from skysim.camera import wcs
from skysim.core.types import Mount, Sources
from skysim.scene.light import DomeConfig, StarsConfig, SurveyedSurfaceConfig
from skysim.scene.scene import Scene
from skysim.sources.dome import surface
from skysim.sources.dome.surface import Radial, Surface

# Largest rms distance of the fitted ellipsoid from the surface that gives no warning. For a camera whose line of
# sight passes 0.2 m beside the bearing, 1 m under the dome, it puts the intersection of the line of sight with the
# surface off by 0.2 mm: 0.01 deg, the accuracy that a dome is surveyed for.
MISFIT_M = 1e-3
# Largest diameter of an LED's image: half of a background tile of the local detector (`TILE_PX` there). The detector
# takes wider discs for background.
LOCAL_PX = 32.0


def doubts(scene: Scene, sources: Sources, mount: Mount) -> list[str]:
    """Return the warnings for a scene, one line each. A bench (collimated display) gives none."""
    if isinstance(scene.light, StarsConfig):
        return [line for line in [wcs.doubt(scene.camera)] if line]
    if not isinstance(scene.light, DomeConfig):
        return []
    inside = surface.build_surface(scene.light.surface)
    found = [
        cloud(scene.light, inside),
        no_ellipsoid(inside),
        wide_images(scene, sources, mount),
        unlit(scene, sources),
    ]
    return [line for line in found if line]


def cloud(light: DomeConfig, inside: Surface) -> str:
    """How far the points of a surveyed surface are from the smooth surface fitted to them; else empty."""
    part = light.surface
    fit = inside.survey if isinstance(inside, Radial) else None
    if fit is None or not isinstance(part, SurveyedSurfaceConfig):
        return ""
    return (
        f"light.surface: {part.file}: the points lie {fit.rms_m * 1e3:.2g} mm rms, {fit.worst_m * 1e3:.2g} mm at most,"
        f" off a smooth surface of degree {part.degree}"
    )


def no_ellipsoid(inside: Surface) -> str:
    """Warn where the surface is more than MISFIT_M rms from the ellipsoid that the tracker's methods assume."""
    rms_m = inside.believed().rms_m
    if rms_m <= MISFIT_M:
        return ""
    return (
        f"light.surface: the tracker believes an ellipsoid, which misses it by {rms_m * 1e3:.2g} mm rms; a solver that"
        " brings rays onto the surface or takes its height (ray_on_surface, thesis) is as wrong"
    )


def wide_images(scene: Scene, sources: Sources, mount: Mount) -> str:
    """Warn where the local detector would take an LED's image for background.

    The image of a disc of diameter D at a distance d is D f / d wide. Defocus by the thin lens adds the blur disc of
    the pupil A, A |1 / d - 1 / focus| f wide.
    """
    if scene.tracker.detector != "local":
        return ""
    camera = scene.camera
    reach_m = np.linalg.norm(sources.place[:, :3], axis=1) - np.linalg.norm(mount.camera_body_m)
    near_m = float(np.median(reach_m))
    blur = camera.pupil_m * abs(1 / near_m - 1 / camera.focus_m)
    wide_px = camera.focal_px * (2 * float(np.median(sources.radius_m)) / near_m + blur)
    if wide_px <= LOCAL_PX:
        return ""
    return (
        f"tracker.detector: an LED's image is {wide_px:.0f} px wide, and local takes for sky what is wider than"
        f" {LOCAL_PX:.0f} px; allowed: threshold"
    )


def unlit(scene: Scene, sources: Sources) -> str:
    """Warn where the exposure is shorter than the drive's cycle, so that a frame shows only some of the LEDs."""
    part = sources.on_s < sources.period_s
    if not part.any():
        return ""
    cycle_s = float(np.median(sources.period_s[part]))
    if scene.exposure.time_s >= cycle_s:
        return ""
    return (
        f"exposure.time: {scene.exposure.time_s:g} s of a drive's cycle of {cycle_s:g} s: a frame shows"
        f" {100 * scene.exposure.time_s / cycle_s:.2g} % of the LEDs' turns"
    )
