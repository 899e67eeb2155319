"""Views of the camera at the attitudes that are checked: the lights that the renderer would draw, in closed form.

`sampled` evaluates the camera's lights for an exposure at each attitude. At an attitude without a time, lights that
only add light unknown to the tracker are left out.
"""

import math
from collections import Counter
from dataclasses import dataclass
from functools import cached_property
from typing import NamedTuple

import numpy as np

from estimator.identification.chance import MIN_EVIDENCE_MATCHES
from skysim.core.types import Bools, Floats, median
from skysim.simulation.checks.attitudes import CheckedAttitudes
from skysim.simulation.checks.detection import Context, broken, usable, with_noise
from skysim.simulation.checks.expected_error import (
    Expected,
    believed_px2,
    expected,
    gains,
    of_common,
    of_independent,
    star_places,
    within_gate,
)
from skysim.simulation.checks.views import View, view
from skysim.simulation.exposure import expected_exposure
from skysim.simulation.lights.light import Beam, Exposure, beam_of


class Sampled(NamedTuple):
    """A attitudes, the views of the camera there, and the expected errors.

    Attributes
    ----------
    attitudes
        The attitudes
    exposures, beams
        Exposure and light at each attitude
    known
        Lights on the detector that the tracker knows, hidden ones included
    seen
        Those of `known` that are not hidden
    used
        Those of `seen` that the tracker detects and uses, with the noise of their centroids
    others
        Lights that the tracker detects and does not know, by name
    error
        Expected errors
    """

    attitudes: CheckedAttitudes
    exposures: list[Exposure]
    beams: list[Beam]
    known: list[View]
    seen: list[View]
    used: list[View]
    others: list[dict[str, View]]
    error: Expected

    def counts(self) -> Floats:
        """(A,) number of lights that the tracker uses."""
        return np.array([len(view) for view in self.used])

    def broken(self) -> Bools:
        """(A,) whether the errors are unknown because most streaks break, see `detection.broken`."""
        return np.isnan(self.error.total("roll")) & (self.counts() >= MIN_EVIDENCE_MATCHES)

    def predicted(self) -> bool:
        """Whether the errors are known at most of the attitudes; those where few streaks break are not typical."""
        return bool(2 * self.broken().sum() <= len(self.used))

    @property
    def hidden(self) -> list[Counter[str]]:
        """Numbers of hidden lights that the tracker knows by the name of the occluder, at each attitude."""
        return [Counter(view.behind[~view.visible]) for view in self.known]

    def hidden_counts(self) -> Floats:
        """(A,) number of hidden lights that the tracker knows."""
        return np.array([sum(hidden.values()) for hidden in self.hidden])

    def joined(self, name: str) -> Floats:
        """A column of the views `seen`, concatenated over all attitudes."""
        return np.concatenate([getattr(view, name) for view in self.seen])


@dataclass(frozen=True)
class Plan(Context):
    """The data of the checks, with the samples at the attitudes of the frames and at those in reach of the motion."""

    frames: Sampled
    reach: Sampled

    @cached_property
    def claimed_nees(self) -> float:
        """The expected NEES over the whole sky with the tracker's least centroid error; NaN without one."""
        floor_px = self.settings.centroid_sigma_px
        if not self.scene.stars or floor_px is None:
            return math.nan
        return self.expected_nees(floor_px)

    def expected_nees(self, floor_px: float) -> float:
        """Median of the expected NEES over the attitudes in reach; NaN without lights, or if most streaks break.

        The tracker claims the covariance M^-1, the inverse Fisher information for the covariances C_i that it
        believes: those of photon and read-out noise, and the least centroid error floor_px, which is
        `tracker.centroid_sigma_px`, in quadrature. The errors of the centroids have a covariance C of noise, the
        pixels' sensitivity and star places. The mean of the NEES, e' M e, is trace(M C): 3 if the claim is true.
        """
        reach = self.reach
        if not reach.predicted():
            return math.nan
        found = []
        for lights in reach.used:
            if len(lights) <= 2:
                continue
            believed = believed_px2(with_noise(lights, self, prnu=0.0), self, floor_px)
            try:
                gain = gains(lights, believed)
            except np.linalg.LinAlgError:
                continue
            # C, then M.
            places = star_places(lights, self)
            errors = of_independent(gain, lights.noise_px2)
            errors = errors if places is None else errors + of_common(gain, places)
            weighted = np.linalg.solve(believed, lights.jacobian)
            information = np.einsum("nij,nik->jk", lights.jacobian, weighted)
            found.append(float(np.trace(information @ errors)))
        return median(found) if found else math.nan


def sampled(at: CheckedAttitudes, context: Context) -> Sampled:
    """The views at some attitudes, and the expected errors there."""
    camera = context.lab.camera
    main = [light for light in camera.lights if not light.only_adds]
    rows = []
    fits = []
    for lab_from_body, rate_body_rad_s, t_s in zip(
        at.lab_from_body, at.rate_body_rad_s, at.t_s.tolist(), strict=True
    ):
        # 1. Light of the exposure.
        exposure = expected_exposure(camera, lab_from_body, rate_body_rad_s, t_s)
        beam = beam_of(main if math.isnan(t_s) else camera.lights, exposure)
        # 2. Known and other lights on the detector.
        known, breaks = known_lights(beam, exposure, context)
        others = other_lights(beam, exposure, context)
        seen = known.take(known.visible)
        # 3. Detected lights, and those of a solution with them.
        detected = usable(known.take(known.visible & ~breaks), context)
        used = with_noise(within_gate(detected, context), context)
        # Those that are left where most streaks break are not fitted as well as expected.
        most_break = breaks.any() and 2 * len(detected) < len(usable(seen, context))
        fits.append(used.take(used.row < 0) if most_break else used)
        rows.append((exposure, beam, known, seen, used, others))
    columns = map(list, zip(*rows, strict=True))
    return Sampled._make((at, *columns, expected(fits, context)))


def known_lights(beam: Beam, exposure: Exposure, context: Context) -> tuple[View, Bools]:
    """The lights on the detector that the tracker knows, hidden ones included, and which are `broken`.

    `row` of the view is the row in the tracker's beliefs.
    """
    lit = next(lit for lit in beam.lits if lit.known)
    assert lit.points is not None
    found = view(lit, exposure, context.camera, beam.before(lit))
    row = context.rows_of(lit.points.id[found.row])
    known = row >= 0
    named = View(*found[:2], row, *found[3:])
    return named.take(known), broken(found, context)[known]


def other_lights(beam: Beam, exposure: Exposure, context: Context) -> dict[str, View]:
    """The points of unknown lights that the tracker detects, by the name of the light."""
    found = {}
    for lit in beam.lits:
        if lit.points is not None and not lit.known:
            seen = view(lit, exposure, context.camera, beam.before(lit))
            found[lit.name] = usable(seen.take(seen.visible), context)
    return {name: seen for name, seen in found.items() if len(seen)}
