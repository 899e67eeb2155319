"""Check a plan before its run: what will be in the field, how accurate solutions will be, and what to change."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, NamedTuple

import numpy as np

from skysim.camera import wcs
from skysim.core.constants import ARCSEC_RAD
from skysim.core.errors import InputError
from skysim.core.types import Floats
from skysim.dynamics import guidance
from skysim.scene.sections.light import DomeConfig, StarsConfig
from skysim.simulation.checks import attitudes, dome_warnings, sky_warnings
from skysim.simulation.checks.attitudes import CheckedAttitudes
from skysim.simulation.checks.detection import Context, context_of
from skysim.simulation.checks.facts import ARCSEC, FACTS, Fact, short
from skysim.simulation.checks.findings import FINDINGS
from skysim.simulation.checks.sampling import CheckedSamples, sampled
from skysim.simulation.lab import Lab
from skysim.simulation.motion import check_reference
from skysim.sources.dome.layouts.ambiguity import Ambiguity

OWN_KEYS = (
    "camera.",
    "tracker.",
    "exposure.",
    "rotation_deg:",
)  # of a head; other findings are about the scene
# of an ambiguity map: least fraction sought, fields times LEDs in a field
LEAST_ALIKE = 0.3
MAP_WORK = 60_000
SKY_FINDINGS = (
    sky_warnings.sky_too_shallow,
    sky_warnings.tracker_too_shallow,
    sky_warnings.floor_too_small,
    sky_warnings.refraction,
)


class Check(NamedTuple):
    """The facts of a plan, and its warnings: one line each, which begins with the key to change."""

    facts: list[Fact]
    findings: list[str]

    def as_dict(self) -> dict[str, Any]:
        """For JSON."""
        numbers = {
            fact.name.replace(" ", "_"): {"text": fact.lines, **fact.values} for fact in self.facts
        }
        return {"facts": numbers, "findings": self.findings}


def check(lab: Lab, tilt_deg: float | None = None, rate_body_rad_s: Floats | None = None) -> Check:
    """Check the plan of a lab whose motion need not be simulated.

    Parameters
    ----------
    tilt_deg
        Greatest tilt under a dome, if it is not that of the scene's motion (random attitudes of
        a study)
    rate_body_rad_s
        (3,) rate of all frames in body axes, in place of the motion's, for trials of single
        frames

    Raises
    ------
    InputError
        For unreadable files, and for a maneuver that a run would refuse.
    """
    scene = lab.scene
    first = [
        line
        for line in [dome_warnings.camera_outside_warning(scene, lab.camera.mount, lab.start)]
        if line
    ]
    if first:
        return Check([], first)  # all else assumes that the camera is inside
    context = context_of(lab)
    frames = attitudes.of_frames(lab)
    if rate_body_rad_s is not None:
        rates = np.tile(rate_body_rad_s, (len(frames.t_s), 1))
        frames = frames._replace(rate_body_rad_s=rates, acceleration_body_rad_s2=None)
    check_reference(
        guidance.plan(scene.motion, lab.start, lab.profiles), scene, lab.vehicle, lab.duration_s
    )
    samples = samples_of(context, frames, tilt_deg)
    facts = [
        fact
        for build in (*FACTS, sky_warnings.faintest_star, sky_warnings.fact)
        if (fact := build(context, samples)) is not None
    ]
    findings = [
        line
        for find in (*FINDINGS, *SKY_FINDINGS, dome_warnings.mirror_images)
        if (line := find(context, samples))
    ]
    for finder in (sky_warnings.bodies_near, sky_warnings.stray_light, sky_warnings.exclusion):
        findings += finder(context, samples)
    alike = dome_warnings.of(context, samples)
    if alike is not None and isinstance(scene.light, DomeConfig):
        facts.insert(2, dome_warnings.fact(alike))
        findings += [line for line in [dome_warnings.finding(alike, scene.light)] if line]
    findings += broken_assumptions(lab)
    heads = [lab.of_camera(number) for number in range(1, len(lab.cameras))]
    checked = [check(head, tilt_deg, rate_body_rad_s) for head in heads]
    if checked:
        facts.append(heads_fact(lab, [facts, *(head.facts for head in checked)]))
    for n, head in enumerate(checked):
        findings += head_findings(n, head.findings, findings)
    return Check(facts, findings)


def ambiguity_map(lab: Lab) -> tuple[Ambiguity, float]:
    """The most similar other field of the field about each LED within the greatest tilt, and what coincides, m.

    The LEDs are numbered by their rows in the tracker's map. Raises InputError where fields are not compared.
    """
    context = context_of(lab)
    samples = samples_of(context, attitudes.of_frames(lab), None)
    if reason := dome_warnings.why_not_compared(context, samples):
        raise InputError("", reason)
    return dome_warnings.compared(context, samples, LEAST_ALIKE, MAP_WORK)


def samples_of(
    context: Context, frames: CheckedAttitudes, tilt_deg: float | None
) -> CheckedSamples:
    """What the camera sees at the frames and within reach."""
    reach = attitudes.within_reach(context.lab.scene, context.lab.camera.mount, frames, tilt_deg)
    return CheckedSamples(sampled(frames, context), sampled(reach, context))


def broken_assumptions(lab: Lab) -> list[str]:
    """Warnings where the scene breaks an assumption of its tracker, of the renderer or of the frames' WCS."""
    scene = lab.scene
    if isinstance(scene.light, StarsConfig):
        return [line for line in [wcs.accuracy_warning(scene.camera)] if line]
    if not isinstance(scene.light, DomeConfig):
        return []
    return dome_warnings.warnings(scene, lab.camera.sources, lab.camera.mount)


def errors_arcsec(facts: Sequence[Fact]) -> tuple[float, float]:
    """Expected cross and roll error at the frames, of the facts of one camera; NaN without a solution."""
    frames = next((fact.values["frames"] for fact in facts if fact.name == "expected error"), None)
    return (
        (frames["cross_arcsec"], frames["roll_arcsec"]) if frames else (float("nan"), float("nan"))
    )


def information(cross: float, roll: float) -> Floats:
    """(3, 3) inverse covariance about the camera's axes, rad^-2; zeros without a solution."""
    if not np.isfinite([cross, roll]).all():
        return np.zeros((3, 3))
    across2 = (cross * ARCSEC_RAD) ** 2 / 2
    along2 = (roll * ARCSEC_RAD) ** 2
    return np.diag([1 / across2, 1 / across2, 1 / along2])


def together_arcsec(lab: Lab, errors: Sequence[tuple[float, float]]) -> tuple[float, float]:
    """Expected cross and roll error about the main boresight of all cameras together.

    Solutions of independent errors have the sum of their information: P^-1 = sum R_n P_n^-1 R_n^T with R_n the rotation
    from the axes of camera n to those of the main one.
    """
    total = np.zeros((3, 3))
    main = lab.camera.mount.cam_from_body
    for camera, error in zip(lab.cameras, errors, strict=True):
        R_main_from_cam = (main * camera.mount.cam_from_body.inv()).as_matrix()
        total += R_main_from_cam @ information(*error) @ R_main_from_cam.T
    if not total.any():
        return float("nan"), float("nan")
    variance = np.diag(np.linalg.inv(total)) / ARCSEC_RAD**2
    return float(np.sqrt(variance[:2].sum())), float(np.sqrt(variance[2]))


def heads_fact(lab: Lab, facts: Sequence[Sequence[Fact]]) -> Fact:
    """The expected errors of each head at the frames, and of all cameras together; facts : of each camera."""
    errors = [errors_arcsec(own) for own in facts]
    names = [head.name for head in lab.scene.heads]
    lines = [
        f"{name}: {errors_text(*error)}" for name, error in zip(names, errors[1:], strict=True)
    ]
    combined = together_arcsec(lab, errors)
    lines.append(
        f"with the main camera: {errors_text(*combined)}, about its axes, without errors of the mounts"
    )
    values = [
        {"name": name, "cross_arcsec": cross, "roll_arcsec": roll}
        for name, (cross, roll) in zip(names, errors[1:], strict=True)
    ]
    together = {"cross_arcsec": combined[0], "roll_arcsec": combined[1]}
    return Fact("heads", lines, {"heads": values, "together": together})


def errors_text(cross: float, roll: float) -> str:
    """Expected errors as a sentence."""
    return (
        f"cross {short(cross)}{ARCSEC}, roll {short(roll)}{ARCSEC} (1σ)"
        if cross == cross
        else "no solution"
    )


def head_findings(n: int, own: Sequence[str], main: Sequence[str]) -> list[str]:
    """The warnings of head n that are not those of the main camera, with the key of the head."""
    # A head is pointed elsewhere by its mount.
    lines = [
        line.replace("motion.start:", "rotation_deg:", 1) if line not in main else line
        for line in own
    ]
    return [f"heads.{n}.{line}" for line in lines if line.startswith(OWN_KEYS) and line not in main]
