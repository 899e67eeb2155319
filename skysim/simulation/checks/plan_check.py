"""Check a plan before its run: lights in the field, accuracy of the solutions, and recommended changes.

`check` does the following:

1. Sample the attitudes of the frames, and those in reach of the motion (attitudes.py).
2. Evaluate what the camera sees there and what the tracker detects (sampling.py).
3. Collect the facts (facts.py) and the warnings (findings.py, sky_warnings.py, and those about a dome below).
4. Do the same for each head, and combine the expected errors.

A regular layout of LEDs is ambiguous however accurate its survey. Two fields are alike if ALIKE of the LEDs of the
larger coincide when one is laid on the other, within SIGMAS standard deviations of an image position (survey and
centroid); `layouts.ambiguity` tries the pairs and their rotations. The share of such fields is the share of frames that
`led_pairs` refuses as ambiguous without a prior: to 0.15 for Poisson, Fibonacci, geodesic and two tape layouts with
surveys of 0.05, 0.2 and 1 mm, under AFIT's camera (50 attitudes each).
"""

import math
from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from skysim.camera import wcs
from skysim.core.errors import InputError
from skysim.core.types import Floats, Record, lengths, median, polar_rad
from skysim.scene.sections.light import DomeConfig, SurveyedSurfaceConfig
from skysim.simulation.checks import attitudes, sky_warnings, vehicle_facts
from skysim.simulation.checks.attitudes import CheckedAttitudes
from skysim.simulation.checks.detection import context_of, threshold_e
from skysim.simulation.checks.expected_error import believed_sigma_px
from skysim.simulation.checks.facts import FACTS, Fact, errors_text, short
from skysim.simulation.checks.findings import FINDINGS, hidden_lights
from skysim.simulation.checks.sampling import Plan, sampled
from skysim.simulation.lab import Lab
from skysim.simulation.lights.effects import IMAGES, Mirror
from skysim.simulation.lights.light import find_light
from skysim.simulation.motion import check_reference, forecast_torque, shortfall
from skysim.sources.dome.layouts.ambiguity import Ambiguity, field_ambiguity
from skysim.sources.dome.surface import Radial, build_surface

# Keys of a head; findings with other keys are about the scene.
OWN_KEYS = ("camera.", "tracker.", "exposure.", "rotation_deg:")
# Of an ambiguity map: the least fraction of coincident LEDs, and the greatest number of fields times LEDs in a field.
LEAST_ALIKE = 0.3
MAP_WORK = 60_000
SKY_FINDINGS = (
    sky_warnings.sky_too_shallow,
    sky_warnings.tracker_too_shallow,
    sky_warnings.beyond_catalog,
    sky_warnings.floor_too_small,
    sky_warnings.refraction,
)
# Findings about the directions in which the frames point.
POINTED = (sky_warnings.bodies_near, sky_warnings.stray_light, sky_warnings.exclusion)
POINTED_FINDINGS = (sky_warnings.refraction, hidden_lights)


class Check(NamedTuple):
    """The facts of a plan, and its warnings: one line each, beginning with the key to change."""

    facts: list[Fact]
    findings: list[str]

    def as_dict(self) -> Record:
        """The check as a JSON object."""
        numbers = {
            fact.name.replace(" ", "_"): {"text": fact.lines, **fact.values}
            for fact in self.facts
        }
        return {"facts": numbers, "findings": self.findings}


def check(
    lab: Lab,
    tilt_deg: float | None = None,
    rate_body_rad_s: Floats | None = None,
    drawn: bool = False,
) -> Check:
    """Facts and warnings of a lab. Its motion is not simulated.

    Parameters
    ----------
    tilt_deg
        Greatest tilt under a dome; None for that of the scene's motion
    rate_body_rad_s
        (3,) rate of all frames in body axes, for trials of single frames; None for the rates of the motion
    drawn
        Whether trials draw other attitudes than those of the scene's motion

    Raises
    ------
    InputError
        For unreadable files, and for a maneuver that a run would refuse.
    """
    scene = lab.scene
    # The rest assumes that the camera is inside the dome.
    if outside := camera_outside_warning(lab):
        return Check([], [outside])
    # 1. Attitudes.
    check_reference(lab, lab.reference, lab.duration_s)
    frames = attitudes.of_frames(lab)
    if rate_body_rad_s is not None:
        rates = np.tile(rate_body_rad_s, (len(frames.t_s), 1))
        frames = frames._replace(rate_body_rad_s=rates)
    # 2. Views.
    plan = plan_of(lab, frames, tilt_deg)
    # 3. Facts and warnings.
    builds = (*FACTS, sky_warnings.faintest_star, sky_warnings.fact)
    facts = list(filter(None, (build(plan) for build in builds)))
    findings = warnings_of(plan, drawn)
    alike = lookalikes(plan)
    if alike is not None and scene.dome:
        facts.insert(2, alike_fact(alike))
        findings += filter(None, [alike_finding(alike, scene.dome)])
    forecast = forecast_torque(lab)
    fuel, warning = vehicle_facts.propellant(plan, forecast)
    facts += filter(None, [fuel])
    findings += filter(None, [*broken_assumptions(lab), shortfall(lab, forecast), warning])
    # 4. Heads.
    heads = [lab.of_camera(number) for number in range(1, len(lab.cameras))]
    checked = [check(head, tilt_deg, rate_body_rad_s, drawn) for head in heads]
    if checked:
        facts.append(heads_fact(lab, [facts, *(head.facts for head in checked)]))
    for n, head in enumerate(checked):
        # Those that are not of the main camera too. Its mount points a head elsewhere, not the start of the motion.
        lines = (
            line.replace("motion.start:", "rotation_deg:", 1)
            for line in head.findings
            if line not in findings
        )
        findings += [f"heads.{n}.{line}" for line in lines if line.startswith(OWN_KEYS)]
    return Check(facts, findings)


def warnings_of(plan: Plan, drawn: bool) -> list[str]:
    """The warnings of the views; those about the directions of the frames only if these are not drawn."""
    found = (
        find(plan)
        for find in (*FINDINGS, *SKY_FINDINGS, mirror_images)
        if not drawn or find not in POINTED_FINDINGS
    )
    findings = list(filter(None, found))
    for finder in () if drawn else POINTED:
        findings += finder(plan)
    return findings


def ambiguity_map(lab: Lab) -> tuple[Ambiguity, float]:
    """The most similar other field of each field within the greatest tilt, and the distance of coincidence in m.

    A field is centered on an LED. LEDs are numbered by their rows in the tracker's map. Raises InputError if fields
    cannot be compared.
    """
    plan = plan_of(lab, attitudes.of_frames(lab))
    if reason := why_not_compared(plan):
        raise InputError("", reason)
    return compared(plan, LEAST_ALIKE, MAP_WORK)


def plan_of(lab: Lab, frames: CheckedAttitudes, tilt_deg: float | None = None) -> Plan:
    """The context with the views of the camera at the frames and at the attitudes in reach."""
    context = context_of(lab)
    reach = attitudes.within_reach(frames, tilt_deg)
    return Plan(
        **vars(context), frames=sampled(frames, context), reach=sampled(reach, context)
    )


def broken_assumptions(lab: Lab) -> list[str]:
    """Warnings that the scene breaks an assumption of its tracker, or of the WCS of its frames."""
    if lab.scene.stars:
        warning = wcs.accuracy_warning(lab.scene.camera.calibration())
        return [warning] if warning else []
    return dome_warnings(lab)


def errors_arcsec(facts: Sequence[Fact]) -> tuple[float, float]:
    """Expected cross and roll error at the frames from the facts of one camera; NaN without a solution."""
    for fact in facts:
        if fact.name == "expected error":
            frames = fact.values["frames"]
            return frames["cross_arcsec"], frames["roll_arcsec"]
    return math.nan, math.nan


def heads_fact(lab: Lab, facts: Sequence[Sequence[Fact]]) -> Fact:
    """The expected errors of each head at the frames, and of all cameras together, from the facts of each camera."""
    errors = [errors_arcsec(own) for own in facts]
    values: list[Record] = [
        {"name": head.name, "cross_arcsec": cross, "roll_arcsec": roll}
        for head, (cross, roll) in zip(lab.scene.heads, errors[1:], strict=True)
    ]
    lines = [
        f"{one['name']}: {errors_text(one['cross_arcsec'], one['roll_arcsec'])}"
        for one in values
    ]
    # Of all cameras about the boresight of the main one. The information of solutions with independent errors adds up:
    # P^-1 = sum R_n P_n^-1 R_n^T, with R_n the rotation from the axes of camera n to those of the main one. A camera
    # without a solution has none.
    total = np.zeros((3, 3))
    main = lab.camera.mount.cam_from_body
    for camera, (cross, roll) in zip(lab.cameras, errors, strict=True):
        R_main_from_cam = (main * camera.mount.body_from_cam).as_matrix()
        # The variance of cross is the sum of those about x and y, half of it each.
        information = 1 / np.array([cross**2 / 2, cross**2 / 2, roll**2])
        total += R_main_from_cam @ np.diag(np.nan_to_num(information)) @ R_main_from_cam.T
    combined = (math.nan, math.nan)
    if total.any():
        x, y, z = np.diag(np.linalg.inv(total)).tolist()
        combined = (math.sqrt(x + y), math.sqrt(z))
    lines.append(
        f"with the main camera: {errors_text(*combined)}, about its axes, without errors of the mounts"
    )
    together = {"cross_arcsec": combined[0], "roll_arcsec": combined[1]}
    return Fact("heads", lines, {"heads": values, "together": together})


# Warnings about a dome: broken assumptions of its tracker, fields that look alike, and images in its wall.


# Largest rms distance of the fitted ellipsoid from the surface that gives no warning. For a camera whose line of
# sight passes 0.2 m beside the bearing, 1 m under the dome, it puts the intersection of the line of sight with the
# surface off by 0.2 mm: 0.01 deg, the accuracy that a dome is surveyed for.
MAX_ELLIPSOID_RMS_M = 1e-3
# Largest diameter of an LED's image: half of a background tile of the local detector (`TILE_PX` there). The detector
# takes wider disks for background.
MAX_IMAGE_PX = 32.0


def dome_warnings(lab: Lab) -> list[str]:
    """The warnings about assumptions of the tracker, one line each, for a camera inside a dome; none without one."""
    scene = lab.scene
    sources = lab.camera.sources
    light = scene.dome
    if light is None:
        return []
    config = light.surface
    inside = build_surface(config)
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
        distance_m = lengths(sources.xyz)
        typical_m = median(distance_m - np.linalg.norm(lab.camera.mount.camera_body_m))
        blur = camera.pupil_m * abs(1 / typical_m - 1 / camera.focus_m)
        width = 2 * median(sources.radius_m) / typical_m + blur
        if (width_px := camera.focal_px * width) > MAX_IMAGE_PX:
            lines.append(
                f"tracker.detector: LED images are {width_px:.0f} px wide; local treats images wider than"
                f" {MAX_IMAGE_PX:.0f} px as background; use threshold"
            )
    # 4. Exposures shorter than the LED drive's cycle, so that a frame shows only some of the LEDs.
    time_s = scene.exposure.time_s
    cycles_s = sources.period_s[sources.on_s < sources.period_s]
    if len(cycles_s) and time_s < (cycle_s := median(cycles_s)):
        lines.append(
            f"exposure.time: {time_s:g} s is shorter than the LED drive's cycle of {cycle_s:g} s: a frame"
            f" covers {100 * time_s / cycle_s:.2g} % of a cycle"
        )
    return lines


def camera_outside_warning(lab: Lab) -> str:
    """Warn if the camera is outside of the dome at the start, where its frames may be black."""
    lever_m = lab.camera.mount.camera_body_m
    light = lab.scene.dome
    if light is None or build_surface(light.surface).inside(lab.start.apply(lever_m)):
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


def lookalikes(plan: Plan) -> Lookalike | None:
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
    reach = plan.reach
    sigma_px = [believed_sigma_px(view, plan) for view in reach.used]
    distance_m = median(reach.joined("distance_m"))
    typical_px = median(np.concatenate(sigma_px))
    coincidence_m = SIGMAS * typical_px * distance_m / camera.focal_px
    # 2. Greatest tilt of the fields, reduced to what most_work allows.
    place_m = plan.beliefs.lights.xyz
    most = int(most_work / np.mean([len(view) for view in reach.seen]))
    zenith_rad = np.sort(polar_rad(place_m))
    tilt_rad = math.radians(reach.attitudes.tilts_deg.max())
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


def alike_fact(found: Lookalike) -> Fact:
    """The fact about the fields that look alike."""
    share = (
        f"{100 * found.share:.0f} % of {found.fields}"
        if found.share
        else f"none of {found.fields}"
    )
    text = f"{share}: {100 * ALIKE:.0f} % of the LEDs coincide within {short(1e3 * found.coincidence_m, 2)} mm"
    return Fact("fields alike", [text], found._asdict())


def alike_finding(found: Lookalike, light: DomeConfig) -> str:
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
