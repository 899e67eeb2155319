"""Warnings about a dome: where it breaks an assumption of its tracker or of the renderer."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from skysim.camera.optics import Optics, disk_image_axes
from skysim.camera.psf.kernel import build_kernel
from skysim.core.types import Floats, Mount, Sources
from skysim.dynamics import guidance
from skysim.dynamics.profiles.load import load_profiles
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
# Largest error of an image's peak from drawing LED disks round that gives no note: less than the scatter of
# brightness among LEDs of one kind (7-9 %, AFIT Table 2).
MAX_ROUND_ERROR = 0.05
REFERENCE_POSES = 33  # of the maneuver, at which LEDs in view are collected


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


def camera_outside_warning(scene: Scene, mount: Mount) -> str:
    """Warn where the camera is outside of the dome at the start, so that its frames are probably black."""
    start = guidance.start_attitude(scene.motion, load_profiles(scene, mount))
    camera_m = start.apply(mount.camera_body_m)
    if not isinstance(scene.light, DomeConfig) or surface.build_surface(scene.light.surface).inside(camera_m):
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


class RoundDisks(NamedTuple):
    """How wrong round images are, for N views of LEDs.

    axes          : (N, 2) true semi-axes of the disk's image over the drawn radius, see `optics.disk_image_axes`
    peak_error    : (N,) relative error of the drawn image's peak
    incidence_rad : (N,) between the LED's normal and the line of sight
    field_rad     : (N,) between the boresight and the line of sight
    """

    axes: Floats
    peak_error: Floats
    incidence_rad: Floats
    field_rad: Floats


def round_disks(scene: Scene, sources: Sources, mount: Mount) -> RoundDisks:
    """Errors of drawing LED disks round, for the LEDs in view during the reference maneuver.

    The renderer draws a disk of radius r as a circle of radius c = f r / d and conserves its light, so the peak goes
    as one over the image's area. Disk and point spread add in variance. With s^2 = 1 / (2 pi peak) that of a point's
    image and p, q the true semi-axes,

        peak drawn / peak true = sqrt((s^2 + p^2 / 4) (s^2 + q^2 / 4)) / (s^2 + c^2 / 4):

    p q / c^2 where the disk is resolved, c >> s, and 1 where it is not.
    """
    offset_m, normal, radius_m = np.split(led_views(scene, sources, mount), [3, 6], axis=1)
    distance_m = np.linalg.norm(offset_m, axis=1)
    axes = disk_image_axes(offset_m, normal)
    drawn_px = scene.camera.focal_px * radius_m / distance_m[:, None]
    spread_px2 = 1 / (2 * np.pi * build_kernel(scene.camera.psf, scene.camera).peak)
    true_px2, drawn_px2 = (spread_px2 + (drawn_px * scale) ** 2 / 4 for scale in (axes, np.ones(2)))
    cos_incidence = -np.sum(offset_m * normal, axis=1) / distance_m
    return RoundDisks(
        axes,
        np.sqrt(np.prod(true_px2 / drawn_px2, axis=1)) - 1,
        np.arccos(np.minimum(cos_incidence, 1)),
        np.arccos(np.minimum(offset_m[:, 2] / distance_m, 1)),
    )


def led_views(scene: Scene, sources: Sources, mount: Mount) -> Floats:
    """(N, 7) LEDs on the chip at even times of the reference maneuver: offset from the pupil in m and normal, both in
    camera axes, and radius in m.
    """
    optics, chip_px = Optics.from_camera(scene.camera), np.array([scene.camera.width_px, scene.camera.height_px])
    end_s = scene.exposure.first_s + scene.exposure.frames / scene.exposure.rate_hz
    views = []
    reference = guidance.plan(scene.motion, profiles=load_profiles(scene, mount))
    for lab_from_body in reference.attitudes(np.linspace(0, end_s, REFERENCE_POSES)):
        cam_from_lab = mount.cam_from_body * lab_from_body.inv()
        offset_m = cam_from_lab.apply(sources.place[:, :3] - lab_from_body.apply(mount.camera_body_m))
        normal, xy_px = cam_from_lab.apply(sources.normal), optics.project(offset_m)
        on_chip = ((xy_px > -0.5) & (xy_px < chip_px - 0.5)).all(axis=1)
        facing = np.sum(offset_m * normal, axis=1) < 0
        views.append(np.column_stack([offset_m, normal, sources.radius_m])[on_chip & facing])
    return np.concatenate(views)


def round_disk_note(scene: Scene, sources: Sources, mount: Mount) -> str:
    """A note where LED disks, which are drawn round, should be ellipses. Attitudes do not depend on it."""
    views = round_disks(scene, sources, mount)
    if np.abs(views.peak_error).max(initial=0.0) <= MAX_ROUND_ERROR:
        return ""
    worst = int(np.abs(views.peak_error).argmax())
    axes = " and ".join(f"{axis:.2f}" for axis in views.axes[worst])
    return (
        "LED disks are drawn as circles: places are right, peaks wrong by"
        f" {100 * np.median(np.abs(views.peak_error)):.2g} % (median),"
        f" {100 * abs(views.peak_error[worst]):.2g} % at"
        f" {np.degrees(views.incidence_rad[worst]):.0f}° of incidence and {np.degrees(views.field_rad[worst]):.0f}° off"
        f" axis, where the image's semi-axes should be {axes} of the drawn radius"
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
