"""What a lab wants to know before it runs a scene: its check and its ambiguous fields."""

from __future__ import annotations

from skysim.apps.gui.messages import AmbiguityMap, PlanCheck
from skysim.experiments.dome_survey import prior
from skysim.simulation import checks
from skysim.simulation.testbed import Testbed
from skysim.tracking import onboard_model


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
