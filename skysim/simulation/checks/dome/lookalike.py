"""Fields of an LED dome that look like another one: a regular layout is ambiguous however accurate its survey.

Two fields are alike if ALIKE of the LEDs of the larger coincide when one is laid on the other, within SIGMAS standard
deviations of an image position (survey and centroid); `placement.ambiguity` tries the pairs and their rotations. The
share of such fields is the share of frames that `led_pairs` refuses as ambiguous without a prior: to 0.15 for Poisson,
Fibonacci, geodesic and two tape layouts with surveys of 0.05, 0.2 and 1 mm, under AFIT's camera (50 attitudes each).
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np

from skysim.scene.sections.layouts import OnPoints
from skysim.scene.sections.light import DomeConfig
from skysim.simulation.checks import attitudes
from skysim.simulation.checks.detection import Context, centroid_variance
from skysim.simulation.checks.expected_error import Independent, believed_sigma_px
from skysim.simulation.checks.facts import Fact, short
from skysim.simulation.checks.sampling import Samples
from skysim.sources.dome.placement.ambiguity import Ambiguity, field_ambiguity

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


def of(context: Context, samples: Samples) -> Lookalike | None:
    """The fields of a dome, each about an LED within the greatest tilt; None for few or coded LEDs, or stars."""
    if why_not_compared(context, samples):
        return None
    found, coincidence_m = compared(context, samples, BELOW, MAX_WORK)
    return (
        Lookalike(float((found.fraction > BELOW).mean()), len(found.led), coincidence_m)
        if len(found.led)
        else None
    )


def why_not_compared(context: Context, samples: Samples) -> str:
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
    context: Context, samples: Samples, least: float, most_work: int
) -> tuple[Ambiguity, float]:
    """The most similar other field of each field within the greatest tilt, and what coincides, m.

    least : fraction below which none is sought;  most_work : fields compared, those at the least tilts, times LEDs in
    a field
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
