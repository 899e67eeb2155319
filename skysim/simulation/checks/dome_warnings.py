"""Warnings about a dome: where it breaks an assumption of its tracker."""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np
from scipy.spatial.transform import Rotation

from skysim.core.types import Mount, Sources
from skysim.scene.scene import Scene
from skysim.scene.sections.layouts import OnPoints
from skysim.scene.sections.light import DomeConfig, SurveyedSurfaceConfig
from skysim.simulation.checks import attitudes
from skysim.simulation.checks.detection import Context, centroid_variance, threshold_e
from skysim.simulation.checks.expected_error import Independent, believed_sigma_px
from skysim.simulation.checks.facts import Fact, short
from skysim.simulation.checks.sampling import CheckedSamples
from skysim.simulation.lights.lab_room import IMAGES, Mirror
from skysim.simulation.lights.light import find_light
from skysim.sources.dome import surface
from skysim.sources.dome.layouts.ambiguity import Ambiguity, field_ambiguity
from skysim.sources.dome.surface import Radial, Surface

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


# Fields of an LED dome that look like another one: a regular layout is ambiguous however accurate
# its survey.


ALIKE = 0.9  # fraction of coincident LEDs
BELOW = ALIKE - 1e-9
SIGMAS = 3.0  # within which two LEDs coincide
MAX_ALIKE = 0.05  # share of the fields that gives no warning
MAX_WORK = (
    20_000  # fields that are compared, those at the least tilts, times LEDs in a field: some 0.2 s
)
MIN_LEDS = 5  # in a field, on average: with fewer, any two fields are alike


class Lookalike(NamedTuple):
    """The share of the fields that look like another one, how many were compared, and what coincides, m."""

    share: float
    fields: int
    coincidence_m: float


def of(context: Context, samples: CheckedSamples) -> Lookalike | None:
    """The fields of a dome, each about an LED within the greatest tilt; None for few or coded LEDs, or stars."""
    if why_not_compared(context, samples):
        return None
    found, coincidence_m = compared(context, samples, BELOW, MAX_WORK)
    return (
        Lookalike(float((found.fraction > BELOW).mean()), len(found.led), coincidence_m)
        if len(found.led)
        else None
    )


def why_not_compared(context: Context, samples: CheckedSamples) -> str:
    """Why fields are not compared; empty if they are."""
    if not isinstance(context.lab.scene.light, DomeConfig):
        return "light.kind: stars: only the layout of a dome can be ambiguous; allowed: dome"
    if context.lab.scene.tracker.decoder is not None:
        return "tracker.decoder: coded LEDs are named by their codes, so that no field is ambiguous; allowed: none"
    mean = float(samples.reach.counts().mean())
    if mean < MIN_LEDS:
        return f"light.layout: {mean:.2g} LEDs in a field on average; allowed: {MIN_LEDS} or more"
    return ""


def compared(
    context: Context, samples: CheckedSamples, least: float, most_work: int
) -> tuple[Ambiguity, float]:
    """The most similar other field of each field within the greatest tilt, and what coincides, m.

    a field

    Parameters
    ----------
    least
        Fraction below which none is sought
    most_work
        Fields compared, those at the least tilts, times LEDs in
    """
    lab = context.lab
    camera = context.camera.optics.camera
    sigma_px = [
        believed_sigma_px(view, Independent(centroid_variance(view, context)), context)
        for view in samples.reach.used
        if len(view)
    ]
    distance_m = float(np.median(samples.reach.joined("distance_m")))
    coincidence_m = (
        SIGMAS * float(np.median(np.concatenate(sigma_px))) * distance_m / camera.focal_px
    )
    place_m = context.beliefs.lights.place[:, :3]
    most = int(most_work / np.mean([len(view) for view in samples.reach.seen]))
    zenith_rad = np.sort(np.arctan2(np.hypot(*place_m.T[:2]), place_m[:, 2]))
    tilt_rad = float(attitudes.tilts_rad(samples.reach.attitudes).max())
    found = field_ambiguity(
        place_m,
        float(np.linalg.norm(lab.camera.mount.camera_body_m)),
        min(tilt_rad, float(zenith_rad[most - 1])) if len(zenith_rad) >= most else tilt_rad,
        math.atan(math.sqrt(camera.width_px * camera.height_px / math.pi) / camera.focal_px),
        coincidence_m,
        least,
    )
    return found, coincidence_m


def fact(found: Lookalike) -> Fact:
    """How many fields look like another one."""
    share = (
        f"{100 * found.share:.0f} % of {found.fields}" if found.share else f"none of {found.fields}"
    )
    text = f"{share}: {100 * ALIKE:.0f} % of the LEDs coincide within {short(1e3 * found.coincidence_m, 2)} mm"
    return Fact("fields alike", [text], found._asdict())


def finding(found: Lookalike, light: DomeConfig) -> str:
    """Warn where many fields look like another one."""
    if found.share <= MAX_ALIKE:
        return ""
    points = light.layout.points if isinstance(light.layout, OnPoints) else light.layout
    key = "light.layout.kind" if points is light.layout else "light.layout.points.kind"
    random = points.kind in ("poisson_disk", "random", "optimized")
    change = "add LEDs" if random else "change it to poisson_disk"
    return (
        f"{key}: {100 * found.share:.0f} % of the fields look like another one to"
        f" {short(1e3 * found.coincidence_m, 2)} mm, so that a tracker without a prior refuses them as ambiguous;"
        f" {change}, lower tracker.survey.led_sigma, or take a shorter camera.focal_length"
    )


# Whether the tracker detects images of LEDs in the dome's wall.


def mirror_images(context: Context, samples: CheckedSamples) -> str:
    """Warn where images of LEDs in the wall are bright enough to be taken for LEDs: false lights."""
    lab = context.lab
    frames = samples.frames
    mirror = find_light(lab.camera.lights, Mirror)
    found = {n: others[IMAGES] for n, others in enumerate(frames.others) if IMAGES in others}
    if mirror is None or not found:
        return ""
    n = max(found, key=lambda n: len(found[n]))
    peak_e = (
        max(float(images.peak_e.max()) for images in found.values()) - context.camera.background_e
    )
    share = threshold_e(context) / peak_e
    specular = mirror.dome.config.specular
    cure = "make the wall matt"
    key = "specular" if specular else "refractive_index"
    if specular:
        cure = f"change it to {short(share * specular, 2)}"
    return (
        f"light.reflection.{key}: the tracker detects up to {len(found[n])} images of LEDs in the wall beside"
        f" {len(frames.used[n])} LEDs, the brightest {short(1 / share, 2)} times above its threshold, at"
        f" {attitudes.describe(frames.attitudes, n, lab.scene, lab.camera.mount)}; {cure}"
    )
