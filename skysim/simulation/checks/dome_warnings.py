"""Warnings about a dome: broken assumptions of its tracker, fields that look alike, and images in its wall.

A regular layout of LEDs is ambiguous however accurate its survey. Two fields are alike if ALIKE of the LEDs of the
larger coincide when one is laid on the other, within SIGMAS standard deviations of an image position (survey and
centroid); `layouts.ambiguity` tries the pairs and their rotations. The share of such fields is the share of frames that
`led_pairs` refuses as ambiguous without a prior: to 0.15 for Poisson, Fibonacci, geodesic and two tape layouts with
surveys of 0.05, 0.2 and 1 mm, under AFIT's camera (50 attitudes each).
"""

import math
from typing import NamedTuple

import numpy as np

from skysim.scene.sections.light import DomeConfig, SurveyedSurfaceConfig
from skysim.simulation.checks.detection import threshold_e
from skysim.simulation.checks.expected_error import believed_sigma_px
from skysim.simulation.checks.facts import Fact, short
from skysim.simulation.checks.sampling import Plan
from skysim.simulation.lab import Lab
from skysim.simulation.lights.effects import IMAGES, Mirror
from skysim.simulation.lights.light import find_light
from skysim.sources.dome import surface
from skysim.sources.dome.layouts.ambiguity import Ambiguity, field_ambiguity
from skysim.sources.dome.surface import Radial

# Largest rms distance of the fitted ellipsoid from the surface that gives no warning. For a camera whose line of
# sight passes 0.2 m beside the bearing, 1 m under the dome, it puts the intersection of the line of sight with the
# surface off by 0.2 mm: 0.01 deg, the accuracy that a dome is surveyed for.
MAX_ELLIPSOID_RMS_M = 1e-3
# Largest diameter of an LED's image: half of a background tile of the local detector (`TILE_PX` there). The detector
# takes wider disks for background.
MAX_IMAGE_PX = 32.0


def warnings(lab: Lab) -> list[str]:
    """The warnings about assumptions of the tracker, one line each, for a camera inside a dome; none without one."""
    scene = lab.scene
    sources = lab.camera.sources
    light = scene.dome
    if light is None:
        return []
    config = light.surface
    inside = surface.build_surface(config)
    lines = []
    # 1. The distance of the points of a surveyed surface from the fitted one.
    fit = inside.fit if isinstance(inside, Radial) else None
    if fit and isinstance(config, SurveyedSurfaceConfig):
        lines.append(
            f"light.surface: {config.file}: the points differ from the fitted surface of degree {config.degree} by"
            f" {fit.rms_m * 1e3:.2g} mm rms, {fit.max_residual_m * 1e3:.2g} mm at most"
        )
    # 2. That of the surface from the ellipsoid.
    rms_m = inside.nearest_ellipsoid().rms_m
    if rms_m > MAX_ELLIPSOID_RMS_M:
        lines.append(
            f"light.surface: differs by {rms_m * 1e3:.2g} mm rms from the ellipsoid that the tracker assumes; solvers"
            " that use the surface (ray_on_surface, thesis) have errors of that size"
        )
    # 3. Images that the local detector takes for background. That of a disk of diameter D at the distance d has the
    # width D f / d. Defocus of a thin lens with the pupil A adds A |1 / d - 1 / focus| f.
    if scene.tracker.detector == "local":
        camera = scene.camera
        distance_m = np.linalg.norm(sources.place[:, :3], axis=1)
        typical_m = float(
            np.median(distance_m - np.linalg.norm(lab.camera.mount.camera_body_m))
        )
        blur = camera.pupil_m * abs(1 / typical_m - 1 / camera.focus_m)
        width = 2 * float(np.median(sources.radius_m)) / typical_m + blur
        if (width_px := camera.focal_px * width) > MAX_IMAGE_PX:
            lines.append(
                f"tracker.detector: LED images are {width_px:.0f} px wide; local treats images wider than"
                f" {MAX_IMAGE_PX:.0f} px as background; use threshold"
            )
    # 4. Exposures shorter than the LED drive's cycle, so that a frame shows only some of the LEDs.
    time_s = scene.exposure.time_s
    cycles_s = sources.period_s[sources.on_s < sources.period_s]
    if len(cycles_s) and time_s < (cycle_s := float(np.median(cycles_s))):
        lines.append(
            f"exposure.time: {time_s:g} s is shorter than the LED drive's cycle of {cycle_s:g} s: a frame"
            f" covers {100 * time_s / cycle_s:.2g} % of a cycle"
        )
    return lines


def camera_outside_warning(lab: Lab) -> str:
    """Warn if the camera is outside of the dome at the start, where its frames may be black."""
    lever_m = lab.camera.mount.camera_body_m
    light = lab.scene.dome
    if light is None or surface.build_surface(light.surface).inside(lab.start.apply(lever_m)):
        return ""
    return (
        f"vehicle.camera: {np.linalg.norm(lever_m):.3g} m from the bearing, outside of light.surface at the"
        " start: a frame may show no LED; allowed: inside"
    )


# Fields that look alike.

ALIKE = 0.9  # fraction of coincident LEDs from which two fields are alike
BELOW = ALIKE - 1e-9
SIGMAS = 3.0  # distance within which two LEDs coincide, in standard deviations
MAX_ALIKE = 0.05  # share of such fields that gives no warning
MAX_WORK = 20_000  # number of fields compared times LEDs in a field, which takes about 0.2 s
MIN_LEDS = 5  # mean number of LEDs in a field; with fewer, any two fields are alike


class Lookalike(NamedTuple):
    """Fields of a dome that look like another one.

    Attributes
    ----------
    share
        Their share of the fields compared
    fields
        Number of fields compared
    coincidence_m
        Distance within which two LEDs coincide
    """

    share: float
    fields: int
    coincidence_m: float


def of(plan: Plan) -> Lookalike | None:
    """The fields of a dome that look alike; None for few or coded LEDs, or stars."""
    if why_not_compared(plan):
        return None
    found, coincidence_m = compared(plan, BELOW, MAX_WORK)
    if not len(found.led):
        return None
    return Lookalike(float((found.fraction > BELOW).mean()), len(found.led), coincidence_m)


def why_not_compared(plan: Plan) -> str:
    """The reason why fields cannot be compared; empty if they can."""
    if not plan.scene.dome:
        return "light.kind: stars: only the layout of a dome can be ambiguous; allowed: dome"
    if plan.scene.tracker.decoder is not None:
        return "tracker.decoder: coded LEDs are named by their codes, so that no field is ambiguous; allowed: none"
    mean = float(plan.reach.counts().mean())
    if mean < MIN_LEDS:
        return f"light.layout: {mean:.2g} LEDs in a field on average; allowed: {MIN_LEDS} or more"
    return ""


def compared(plan: Plan, least: float, most_work: int) -> tuple[Ambiguity, float]:
    """The most similar other field of each field within the greatest tilt, and the distance of coincidence in m.

    A field is centered on an LED.

    Parameters
    ----------
    plan
        Data of the checks
    least
        Least fraction of coincident LEDs; less similar fields are not sought
    most_work
        Greatest number of fields times LEDs in a field; the fields at the least tilts are compared
    """
    # 1. Distance within which LEDs coincide, from the tracker's standard deviation of an image position.
    lab = plan.lab
    camera = plan.camera.optics.camera
    sigma_px = [believed_sigma_px(view, plan) for view in plan.reach.used if len(view)]
    distance_m = float(np.median(plan.reach.joined("distance_m")))
    typical_px = float(np.median(np.concatenate(sigma_px)))
    coincidence_m = SIGMAS * typical_px * distance_m / camera.focal_px
    # 2. Greatest tilt of the fields, reduced to what most_work allows.
    place_m = plan.beliefs.lights.place[:, :3]
    most = int(most_work / np.mean([len(view) for view in plan.reach.seen]))
    zenith_rad = np.sort(np.arctan2(np.hypot(*place_m.T[:2]), place_m[:, 2]))
    tilt_rad = math.radians(plan.reach.attitudes.tilts_deg.max())
    if len(zenith_rad) >= most:
        tilt_rad = min(tilt_rad, float(zenith_rad[most - 1]))
    # 3. Comparison, with circular fields of the detector's area.
    radius_px = math.sqrt(camera.width_px * camera.height_px / math.pi)
    found = field_ambiguity(
        place_m,
        float(np.linalg.norm(lab.camera.mount.camera_body_m)),
        tilt_rad,
        math.atan(radius_px / camera.focal_px),
        coincidence_m,
        least,
    )
    return found, coincidence_m


def fact(found: Lookalike) -> Fact:
    """The fact about the fields that look alike."""
    share = (
        f"{100 * found.share:.0f} % of {found.fields}"
        if found.share
        else f"none of {found.fields}"
    )
    text = f"{share}: {100 * ALIKE:.0f} % of the LEDs coincide within {short(1e3 * found.coincidence_m, 2)} mm"
    return Fact("fields alike", [text], found._asdict())


def finding(found: Lookalike, light: DomeConfig) -> str:
    """Warn if many fields look like another one."""
    if found.share <= MAX_ALIKE:
        return ""
    points = light.points
    key = "light.layout.kind" if points is light.layout else "light.layout.points.kind"
    random = points.kind in ("poisson_disk", "random", "optimized")
    change = "add LEDs" if random else "change it to poisson_disk"
    return (
        f"{key}: {100 * found.share:.0f} % of the fields look like another one to"
        f" {short(1e3 * found.coincidence_m, 2)} mm, so that a tracker without a prior refuses them as ambiguous;"
        f" {change}, lower tracker.survey.led_sigma, or take a shorter camera.focal_length"
    )


# Images of LEDs in the dome's wall.


def mirror_images(plan: Plan) -> str:
    """Warn if the tracker detects images of LEDs in the wall, which are false lights."""
    lab = plan.lab
    frames = plan.frames
    mirror = find_light(lab.camera.lights, Mirror)
    found = {n: others[IMAGES] for n, others in enumerate(frames.others) if IMAGES in others}
    if mirror is None or not found:
        return ""
    n = max(found, key=lambda n: len(found[n]))
    peak_e = (
        max(float(images.peak_e.max()) for images in found.values())
        - plan.camera.background_e
    )
    share = threshold_e(plan) / peak_e
    specular = mirror.dome.config.specular
    cure = "make the wall matt"
    key = "specular" if specular else "refractive_index"
    if specular:
        cure = f"change it to {short(share * specular, 2)}"
    return (
        f"light.reflection.{key}: the tracker detects up to {len(found[n])} images of LEDs in the wall beside"
        f" {len(frames.used[n])} LEDs, the brightest {short(1 / share, 2)} times above its threshold, at"
        f" {frames.attitudes.describe(n)}; {cure}"
    )
