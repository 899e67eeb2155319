"""What a lab wants to know before it runs a scene: its check, its ambiguous fields, the attitudes of a survey."""

from __future__ import annotations

from skysim.apps.gui.messages import AmbiguityMap, PlanCheck, SurveyPlan
from skysim.core.errors import InputError
from skysim.experiments.dome_survey import prior, procedure, stops
from skysim.scene.scene import Scene
from skysim.simulation import checks
from skysim.simulation.testbed import Testbed
from skysim.tracking import onboard_model

SURVEY_TILT_DEG = 25.0  # greatest tilt of a survey, if the vehicle's stop allows it
MAX_STOPS = 200


def check(testbed: Testbed) -> PlanCheck:
    """The facts of a scene and its warnings, as `skysim check` prints them."""
    found = checks.check(testbed)
    return PlanCheck(tuple((fact.name, tuple(fact.lines)) for fact in found.facts), tuple(found.findings))


def ambiguity(testbed: Testbed) -> AmbiguityMap:
    """How much of the field about each LED another field shows too. Raises InputError for a scene without such fields.

    See `skysim.sources.dome.placement.ambiguity`.
    """
    found, coincidence_m = checks.ambiguity_map(testbed)
    ids = onboard_model.assumed_dome(testbed.scene, prior.require_dome(testbed.scene), testbed.sources).id
    return AmbiguityMap(ids[found.led], ids[found.other], found.fraction, checks.LEAST_ALIKE, 1e3 * coincidence_m)


def survey(scene: Scene, frames: int) -> SurveyPlan:
    """The attitudes to hold for a survey with the uncertainties that `skysim survey` assumes. Raises InputError."""
    if not 2 <= frames <= MAX_STOPS:
        raise InputError(f"frames {frames}: allowed: 2 to {MAX_STOPS}")
    tilt_deg = min(SURVEY_TILT_DEG, scene.vehicle.tilt_stop_deg)
    _, _, plan = procedure.plan_survey(scene, prior.survey_uncertainty(), frames, tilt_deg)
    angles = tuple(tuple(row) for row in stops.angles_deg(plan.lab_from_body).tolist())
    steps = tuple((count, 1e3 * accuracy.led_rms_m if accuracy else None) for count, accuracy in plan.steps())
    return SurveyPlan(angles, tuple(plan.shown.sum(axis=1).tolist()), plan.shown.shape[1], steps)
