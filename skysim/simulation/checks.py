"""What a user should know before the flight: where the scene is not what its tracker takes it for."""

from __future__ import annotations

import numpy as np

from skysim.camera import wcs
from skysim.core.types import Mount, Sources
from skysim.scene.light import DomeConfig, StarsConfig, SurveyedSurfaceConfig
from skysim.scene.scene import Scene
from skysim.sources.dome import surface
from skysim.sources.dome.surface import Radial, Surface

# Of the ellipsoid from the surface, rms. A camera 0.2 m beside the line through the bearing along which it looks, 1 m
# under the dome, has a sight's point wrong by 0.2 mm for it: 0.01 deg, which is what a dome is surveyed for.
MISFIT_M = 1e-3
# Of an LED's image: half of a tile of the local detector's sky (`TILE_PX` there), beyond which the disc is its own sky.
LOCAL_PX = 32.0


def doubts(scene: Scene, sources: Sources, mount: Mount) -> list[str]:
    """A line each; none in front of a bench."""
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
    """How well a surveyed cloud is a smooth surface."""
    part = light.surface
    fit = inside.survey if isinstance(inside, Radial) else None
    if fit is None or not isinstance(part, SurveyedSurfaceConfig):
        return ""
    return (
        f"light.surface: {part.file}: the points lie {fit.rms_m * 1e3:.2g} mm rms, {fit.worst_m * 1e3:.2g} mm at most,"
        f" off a smooth surface of degree {part.degree}"
    )


def no_ellipsoid(inside: Surface) -> str:
    """How far the surface is from the ellipsoid that the tracker's methods know."""
    rms_m = inside.believed().rms_m
    if rms_m <= MISFIT_M:
        return ""
    return (
        f"light.surface: the tracker believes an ellipsoid, which misses it by {rms_m * 1e3:.2g} mm rms; a solver that"
        " brings rays onto the surface or takes its height (ray_on_surface, thesis) is as wrong"
    )


def wide_images(scene: Scene, sources: Sources, mount: Mount) -> str:
    """Discs that are their own sky for a detector that looks for it beside each blob.

    The image of a disc D at a distance d is D f / d wide; out of focus by the thin lens it is wider by the pupil's
    shadow, A |1 / d - 1 / focus| f.
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
    """LEDs that wait for their turn longer than the shutter is open."""
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
