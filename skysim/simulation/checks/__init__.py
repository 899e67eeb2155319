"""Check a plan before its run: facts about field, lights, images and expected errors, and warnings.

`plan_check.check` computes all of it from a lab whose motion is not simulated: `attitudes` samples directions, `views`
projects the lights, `detection` and `expected_error` predict the tracker, `facts` and `findings` put it into words.
"""

from skysim.simulation.checks.plan_check import LEAST_ALIKE as LEAST_ALIKE
from skysim.simulation.checks.plan_check import Check as Check
from skysim.simulation.checks.plan_check import ambiguity_map as ambiguity_map
from skysim.simulation.checks.plan_check import check as check
