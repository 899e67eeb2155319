"""What a lab wants to know before it runs a scene: its check and its ambiguous fields."""

from __future__ import annotations

from skysim.apps.gui.messages import AmbiguityMap, PlanCheck
from skysim.experiments.dome_survey import prior
from skysim.simulation import checks
from skysim.simulation.lab import Lab
from skysim.tracking import onboard_model


def check(lab: Lab) -> PlanCheck:
    """The facts of a scene and its warnings, as `skysim check` prints them."""
    found = checks.check(lab)
    return PlanCheck(
        tuple((fact.name, tuple(fact.lines)) for fact in found.facts), tuple(found.findings)
    )


def ambiguity(lab: Lab) -> AmbiguityMap:
    """How much of the field about each LED another field shows too. Raises InputError for a scene without such fields.

    See `skysim.sources.dome.placement.ambiguity`.
    """
    found, coincidence_m = checks.ambiguity_map(lab)
    ids = onboard_model.assumed_dome(
        lab.scene, prior.require_dome(lab.scene), lab.camera.sources
    ).id
    return AmbiguityMap(
        ids[found.led], ids[found.other], found.fraction, checks.LEAST_ALIKE, 1e3 * coincidence_m
    )
