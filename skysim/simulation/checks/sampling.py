"""What the camera sees at the attitudes that are checked: the lights, as the renderer would draw them, in closed form.

Each attitude is an exposure for which the camera's own lights are asked. At directions without a time, lights that only
add what no tracker knows are left out.
"""

from __future__ import annotations

import math
from collections import Counter
from typing import NamedTuple

import numpy as np

from skysim.core.types import Floats
from skysim.simulation.checks.attitudes import CheckedAttitudes
from skysim.simulation.checks.detection import Context, usable
from skysim.simulation.checks.expected_error import Expected, expected
from skysim.simulation.checks.views import VISIBLE, View, view
from skysim.simulation.exposure import expected_exposure
from skysim.simulation.lights.light import Beam, Exposure, beam_of


class Sampled(NamedTuple):
    """Some attitudes, what the camera sees there, and the expected errors.

    Attributes
    ----------
    known
        The lights on the chip that the tracker knows, also hidden ones
    seen
        Of them those that nothing hides
    used
        Those that it also detects
    hidden
        How many of them are hidden, by the name of what hides them
    others
        The lights that it detects and does not know, by their names
    """

    attitudes: CheckedAttitudes
    exposures: list[Exposure]
    beams: list[Beam]
    known: list[View]
    seen: list[View]
    used: list[View]
    hidden: list[Counter[str]]
    others: list[dict[str, View]]
    error: Expected

    def counts(self) -> Floats:
        """(A,) number of lights that the tracker uses."""
        return np.array([len(view) for view in self.used])

    def hidden_counts(self) -> Floats:
        """(A,) number of lights that it knows and that are hidden."""
        return np.array([sum(hidden.values()) for hidden in self.hidden])

    def joined(self, name: str) -> Floats:
        """A column of the views of all attitudes end to end."""
        return np.concatenate([getattr(view, name) for view in self.seen])


class CheckedSamples(NamedTuple):
    """The two sets of attitudes: those of the frames, and all that the motion could reach."""

    frames: Sampled
    reach: Sampled


def sampled(at: CheckedAttitudes, context: Context) -> Sampled:
    """What the camera sees at some attitudes, and the expected errors there."""
    camera = context.lab.camera
    rows = zip(at.lab_from_body, at.rate_body_rad_s, at.t_s.tolist(), strict=True)
    exposures = [expected_exposure(camera, *row) for row in rows]
    main = [light for light in camera.lights if not light.only_adds]
    beams = [
        beam_of(main if math.isnan(t_s) else camera.lights, exposure)
        for exposure, t_s in zip(exposures, at.t_s.tolist(), strict=True)
    ]
    known = []
    seen = []
    hidden = []
    for exposure, beam, acceleration in zip(exposures, beams, at.accelerations(), strict=True):
        found, names = known_lights(beam, exposure, context, acceleration)
        known.append(found)
        seen.append(found.take(found.behind == VISIBLE))
        hidden.append(Counter(names[number] for number in found.behind[found.behind != VISIBLE]))
    used = [usable(view, context) for view in seen]
    others = [
        other_lights(beam, exposure, context)
        for beam, exposure in zip(beams, exposures, strict=True)
    ]
    return Sampled(
        at, exposures, beams, known, seen, used, hidden, others, expected(used, at, context)
    )


def known_lights(
    beam: Beam, exposure: Exposure, context: Context, acceleration_body_rad_s2: Floats
) -> tuple[View, list[str]]:
    """The lights on the chip that the tracker knows, by their rows in its beliefs, and the names of what may hide them.

    Those that something hides are among them.
    """
    lit = next(lit for lit in beam.lits if lit.known)
    assert lit.points is not None
    occluders = beam.before(lit)
    found = view(lit, exposure, context.camera, occluders, acceleration_body_rad_s2)
    row = context.rows_of(lit.points.id[found.row])
    return View(row, *found[1:]).take(row >= 0), [occluder.name for occluder in occluders]


def other_lights(beam: Beam, exposure: Exposure, context: Context) -> dict[str, View]:
    """The points of other lights that the tracker detects, by the names of the lights."""
    found = {}
    for lit in beam.lits:
        if lit.points is not None and not lit.known:
            seen = view(lit, exposure, context.camera, beam.before(lit))
            found[lit.name] = usable(seen.take(seen.behind == VISIBLE), context)
    return {name: seen for name, seen in found.items() if len(seen)}
