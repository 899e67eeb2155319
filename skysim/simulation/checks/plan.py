"""Check a plan before its run: what will be in the field, how accurate solutions will be, and what to change."""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np

from skysim.camera import wcs
from skysim.core.types import Floats
from skysim.dynamics import guidance
from skysim.scene.sections.light import DomeConfig, StarsConfig
from skysim.simulation.checks import attitudes
from skysim.simulation.checks.attitudes import Attitudes
from skysim.simulation.checks.detection import Context, context_of, usable
from skysim.simulation.checks.dome import assumptions, lookalike, reflections
from skysim.simulation.checks.expected_error import expected
from skysim.simulation.checks.facts import FACTS, Fact, Sampled, Samples
from skysim.simulation.checks.findings import FINDINGS
from skysim.simulation.checks.sky import air, bodies, claims, depth, stray
from skysim.simulation.checks.views import views
from skysim.simulation.reference_limits import check_reference
from skysim.simulation.testbed import Testbed

SKY_FINDINGS = (depth.sky_too_shallow, depth.tracker_too_shallow, claims.floor_too_small, air.refraction)


class Check(NamedTuple):
    """The facts of a plan, and its warnings: one line each, which begins with the key to change."""

    facts: list[Fact]
    findings: list[str]

    def as_dict(self) -> dict[str, Any]:
        """For JSON."""
        numbers = {fact.name.replace(" ", "_"): {"text": fact.lines, **fact.values} for fact in self.facts}
        return {"facts": numbers, "findings": self.findings}


def check(testbed: Testbed, tilt_deg: float | None = None, rate_body_rad_s: Floats | None = None) -> Check:
    """Check the plan of a test bed whose motion need not be simulated.

    tilt_deg : greatest tilt under a dome, if it is not that of the scene's motion (random attitudes of a study)
    rate_body_rad_s : (3,) rate of all frames in body axes, in place of the motion's, for trials of single frames

    Raises InputError for unreadable files, and for a maneuver that a run would refuse.
    """
    scene = testbed.scene
    first = [line for line in [assumptions.camera_outside_warning(scene, testbed.mount)] if line]
    if first:
        return Check([], first)  # all else assumes that the camera is inside
    context = context_of(testbed)
    frames = attitudes.of_frames(testbed)
    if rate_body_rad_s is not None:
        rates = np.tile(rate_body_rad_s, (len(frames.t_s), 1))
        frames = frames._replace(rate_body_rad_s=rates, acceleration_body_rad_s2=None)
    check_reference(guidance.plan(scene.motion, testbed.trajectory.lab_from_body[0], testbed.profiles), testbed)
    reach = attitudes.within_reach(scene, testbed.mount, frames, tilt_deg)
    samples = Samples(sampled(frames, context), sampled(reach, context))
    facts = [
        fact for build in (*FACTS, depth.faintest_star, claims.fact) if (fact := build(context, samples)) is not None
    ]
    findings = [
        line for find in (*FINDINGS, *SKY_FINDINGS, reflections.mirror_images) if (line := find(context, samples))
    ]
    for finder in (bodies.bodies_near, stray.stray_light, stray.exclusion):
        findings += finder(context, samples)
    alike = lookalike.of(context, samples)
    if alike is not None and isinstance(scene.light, DomeConfig):
        facts.insert(2, lookalike.fact(alike))
        findings += [line for line in [lookalike.finding(alike, scene.light)] if line]
    return Check(facts, findings + broken_assumptions(testbed))


def sampled(at: Attitudes, context: Context) -> Sampled:
    """What the camera sees at some attitudes, and the expected errors there."""
    seen = views(context.testbed, context.beliefs.lights, at, context.camera)
    used = [usable(view, context) for view in seen]
    return Sampled(at, seen, used, expected(used, at, context))


def broken_assumptions(testbed: Testbed) -> list[str]:
    """Warnings where the scene breaks an assumption of its tracker, of the renderer or of the frames' WCS."""
    scene = testbed.scene
    if isinstance(scene.light, StarsConfig):
        return [line for line in [wcs.accuracy_warning(scene.camera)] if line]
    if not isinstance(scene.light, DomeConfig):
        return []
    return assumptions.warnings(scene, testbed.sources, testbed.mount)
