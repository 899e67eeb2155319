"""Check a plan before its run: lights in the field, accuracy of the solutions, and recommended changes.

`check` does the following:

1. Sample the attitudes of the frames, and those in reach of the motion (attitudes.py).
2. Evaluate what the camera sees there and what the tracker detects (sampling.py).
3. Collect the facts (facts.py) and the warnings (findings.py, dome_warnings.py, sky_warnings.py).
4. Do the same for each head, and combine the expected errors.
"""

import math
from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from skysim.camera import wcs
from skysim.core.errors import InputError
from skysim.core.types import Floats, Record
from skysim.simulation.checks import attitudes, dome_warnings, sky_warnings, vehicle_facts
from skysim.simulation.checks.attitudes import CheckedAttitudes
from skysim.simulation.checks.detection import context_of
from skysim.simulation.checks.facts import FACTS, Fact, errors_text
from skysim.simulation.checks.findings import FINDINGS, hidden_lights
from skysim.simulation.checks.sampling import Plan, sampled
from skysim.simulation.lab import Lab
from skysim.simulation.motion import check_reference, forecast_torque, shortfall
from skysim.sources.dome.layouts.ambiguity import Ambiguity

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
    lab
        Laboratory
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
    outside = dome_warnings.camera_outside_warning(lab)
    if outside:
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
    alike = dome_warnings.of(plan)
    if alike is not None and scene.dome:
        facts.insert(2, dome_warnings.fact(alike))
        findings += filter(None, [dome_warnings.finding(alike, scene.dome)])
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
        findings += head_findings(n, head.findings, findings)
    return Check(facts, findings)


def warnings_of(plan: Plan, drawn: bool) -> list[str]:
    """The warnings of the views; those about the directions of the frames only if these are not drawn."""
    found = (
        find(plan)
        for find in (*FINDINGS, *SKY_FINDINGS, dome_warnings.mirror_images)
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
    if reason := dome_warnings.why_not_compared(plan):
        raise InputError("", reason)
    return dome_warnings.compared(plan, LEAST_ALIKE, MAP_WORK)


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
    return dome_warnings.warnings(lab)


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
        R_main_from_cam = (main * camera.mount.cam_from_body.inv()).as_matrix()
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


def head_findings(n: int, own: Sequence[str], main: Sequence[str]) -> list[str]:
    """The warnings of head n that are not those of the main camera, with the key of the head."""
    # The mount of a head points it elsewhere, not the start of the motion.
    lines = (
        line.replace("motion.start:", "rotation_deg:", 1) for line in own if line not in main
    )
    return [f"heads.{n}.{line}" for line in lines if line.startswith(OWN_KEYS)]
