"""Warnings about a dome: where it breaks an assumption of its tracker."""

from __future__ import annotations

import numpy as np
from scipy.spatial.transform import Rotation

from skysim.core.types import Mount, Sources
from skysim.scene.scene import Scene
from skysim.scene.sections.light import DomeConfig, SurveyedSurfaceConfig
from skysim.sources.dome.shell import surface
from skysim.sources.dome.shell.surface import Radial, Surface

# Largest rms distance of the fitted ellipsoid from the surface that gives no warning. For a camera whose line of
# sight passes 0.2 m beside the bearing, 1 m under the dome, it puts the intersection of the line of sight with the
# surface off by 0.2 mm: 0.01 deg, the accuracy that a dome is surveyed for.
MAX_ELLIPSOID_RMS_M = 1e-3
# Largest diameter of an LED's image: half of a background tile of the local detector (`TILE_PX` there). The detector
# takes wider disks for background.
MAX_IMAGE_PX = 32.0


def warnings(scene: Scene, sources: Sources, mount: Mount) -> list[str]:
    """The warnings for a dome whose inside holds the camera, one line each."""
    assert isinstance(scene.light, DomeConfig)
    inside = surface.build_surface(scene.light.surface)
    lines = [
        surface_fit_warning(scene.light, inside),
        ellipsoid_warning(inside),
        image_width_warning(scene, sources, mount),
        exposure_warning(scene, sources),
    ]
    return [line for line in lines if line]


def camera_outside_warning(scene: Scene, mount: Mount, start: Rotation) -> str:
    """Warn where the camera is outside of the dome at the start (lab_from_body), so that its frames may be black."""
    camera_m = start.apply(mount.camera_body_m)
    if not isinstance(scene.light, DomeConfig) or surface.build_surface(scene.light.surface).inside(
        camera_m
    ):
        return ""
    return (
        f"vehicle.camera: {np.linalg.norm(mount.camera_body_m):.3g} m from the bearing, outside of light.surface at the"
        " start: a frame may show no LED; allowed: inside"
    )


def surface_fit_warning(light: DomeConfig, inside: Surface) -> str:
    """How far the points of a surveyed surface are from the smooth surface fitted to them; else empty."""
    config = light.surface
    fit = inside.fit if isinstance(inside, Radial) else None
    if fit is None or not isinstance(config, SurveyedSurfaceConfig):
        return ""
    return (
        f"light.surface: {config.file}: the points differ from the fitted surface of degree {config.degree} by"
        f" {fit.rms_m * 1e3:.2g} mm rms, {fit.max_residual_m * 1e3:.2g} mm at most"
    )


def ellipsoid_warning(inside: Surface) -> str:
    """Warn where the surface is not the ellipsoid that the tracker's methods assume: MAX_ELLIPSOID_RMS_M rms."""
    rms_m = inside.nearest_ellipsoid().rms_m
    if rms_m <= MAX_ELLIPSOID_RMS_M:
        return ""
    return (
        f"light.surface: differs by {rms_m * 1e3:.2g} mm rms from the ellipsoid that the tracker assumes; solvers that"
        " use the surface (ray_on_surface, thesis) have errors of that size"
    )


def image_width_warning(scene: Scene, sources: Sources, mount: Mount) -> str:
    """Warn where the local detector would take an LED's image for background.

    The image of a disk of diameter D at a distance d is D f / d wide. Defocus by the thin lens adds the blur disk of
    the pupil A, A |1 / d - 1 / focus| f wide.
    """
    if scene.tracker.detector != "local":
        return ""
    camera = scene.camera
    distance_m = np.linalg.norm(sources.place[:, :3], axis=1) - np.linalg.norm(mount.camera_body_m)
    typical_m = float(np.median(distance_m))
    blur = camera.pupil_m * abs(1 / typical_m - 1 / camera.focus_m)
    width_px = camera.focal_px * (2 * float(np.median(sources.radius_m)) / typical_m + blur)
    if width_px <= MAX_IMAGE_PX:
        return ""
    return (
        f"tracker.detector: LED images are {width_px:.0f} px wide; local treats images wider than {MAX_IMAGE_PX:.0f} px"
        " as background; use threshold"
    )


def exposure_warning(scene: Scene, sources: Sources) -> str:
    """Warn where the exposure is shorter than the drive's cycle, so that a frame shows only some of the LEDs."""
    duty_cycled = sources.on_s < sources.period_s
    if not duty_cycled.any():
        return ""
    cycle_s = float(np.median(sources.period_s[duty_cycled]))
    if scene.exposure.time_s >= cycle_s:
        return ""
    return (
        f"exposure.time: {scene.exposure.time_s:g} s is shorter than the LED drive's cycle of {cycle_s:g} s: a frame"
        f" covers {100 * scene.exposure.time_s / cycle_s:.2g} % of a cycle"
    )
