"""Whether the errors that the tracker will claim are true: the mean NEES that the checks expect under the stars.

The tracker claims M^-1, the inverse Fisher information for the standard deviations that it believes: those of photon
and read-out noise, and `tracker.centroid_sigma_px` in quadrature. The errors of the centroids have a covariance C, of
noise, the pixels' sensitivity, and star places. The mean of e' M e is trace(M C): 3 if the claim is true.
"""

from __future__ import annotations

import math

import numpy as np

from skysim.scene.sections.light import StarsConfig
from skysim.simulation.checks.detection import Context, centroid_variance
from skysim.simulation.checks.expected_error import Independent, covariance, gains, star_places
from skysim.simulation.checks.facts import Fact, short
from skysim.simulation.checks.sampling import Sampled, Samples

MAX_FACTOR = 1.3  # by which claimed errors may be too small
TRUE_NEES = 3.0
LARGEST_FLOOR_PX = 1.0


def expected_nees(sampled: Sampled, context: Context, floor_px: float) -> float:
    """Median of the expected NEES over some attitudes, with a least error of the centroids; NaN without lights."""
    found = []
    cam_from_body = context.lab.camera.mount.cam_from_body
    for view, lab_from_body in zip(sampled.used, sampled.attitudes.lab_from_body, strict=True):
        own = centroid_variance(view, context, prnu=0.0)
        sigma_px = np.sqrt(np.trace(own, axis1=1, axis2=2) / 2 + floor_px**2)
        try:
            gain = gains(view, sigma_px) if len(view) > 2 else None
        except np.linalg.LinAlgError:
            gain = None
        if gain is None:
            continue
        places = star_places(view, lab_from_body * cam_from_body.inv(), context)
        errors = covariance(gain, Independent(centroid_variance(view, context)))
        errors = errors if places is None else errors + covariance(gain, places)
        information = np.einsum("nij,nik,n->jk", view.jacobian, view.jacobian, 1 / sigma_px**2)
        found.append(float(np.trace(information @ errors)))
    return float(np.median(found)) if found else math.nan


def claimed(context: Context, samples: Samples) -> float:
    """The expected NEES over the whole sky with the tracker's floor; NaN under other lights."""
    if not isinstance(context.lab.scene.light, StarsConfig):
        return math.nan
    return expected_nees(samples.reach, context, context.settings.centroid_sigma_px)


def fact(context: Context, samples: Samples) -> Fact | None:
    """The expected NEES in words."""
    nees = claimed(context, samples)
    if math.isnan(nees):
        return None
    floor_px = context.settings.centroid_sigma_px
    text = f"NEES {nees:.2g} over the sky (3 if true), with a least centroid error of {short(floor_px)} px"
    return Fact("claimed errors", [text], {"nees": nees, "centroid_sigma_px": floor_px})


def floor_too_small(context: Context, samples: Samples) -> str:
    """Warn where the tracker will claim errors that are too small, because its floor of the centroids' error is."""
    nees = claimed(context, samples)
    factor = math.sqrt(nees / TRUE_NEES) if nees > 0 else 0.0
    if factor <= MAX_FACTOR:
        return ""
    low = context.settings.centroid_sigma_px
    high = LARGEST_FLOOR_PX
    while high / low > 1.02:
        middle = math.sqrt(low * high)
        low, high = (
            (middle, high)
            if expected_nees(samples.reach, context, middle) > TRUE_NEES
            else (low, middle)
        )
    return (
        f"tracker.centroid_sigma_px: the tracker will claim errors that are {factor:.2g} times too small (NEES"
        f" {nees:.2g}; 3 if true); change it to {short(high, 2)}"
    )
