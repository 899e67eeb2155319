"""Which mass properties a flight has not shown well enough, what was missing, and how much more would do."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from estimator.calibration.mass_properties.record import BearingRecord, MassEstimate, Prior
from skysim.core.errors import InputError
from skysim.core.types import Floats

LEAST_RATE_DEG_S = 0.05  # below which there is no turn to speak of
LEAST_INFORMATION = 1e-3  # of what is needed: below it, more of the same does not help
AXES = "xyz"


def check_observed(
    estimate: MassEstimate,
    prior: Prior,
    records: Sequence[BearingRecord],
    inertia_bar: float,
    moment_bar_kg_m: Floats,
) -> None:
    """Raise InputError, in one line, if moments of inertia or the moment are less certain than asked.

    inertia_bar : standard deviation of a moment of inertia over its value;  moment_bar_kg_m : (3,) standard deviations
    of the components of the moment
    """
    values = estimate.values
    sigma = estimate.sigma
    rate_deg_s = largest_rates_deg_s(records)
    tilt_deg = largest_tilt_deg(records)
    faults = []
    for axis in range(3):
        bar = inertia_bar * abs(values[axis])
        if sigma[axis] > bar:
            known = f"inertia about {AXES[axis]} is known to {100 * sigma[axis] / abs(values[axis]):.3g} %"
            shown = f"after turns of {rate_deg_s[axis]:.2g} deg/s"
            if rate_deg_s[axis] < LEAST_RATE_DEG_S:
                shown = "after no turn about it"
            needed = remedy("turn", sigma[axis], prior.sigma[axis], bar)
            faults.append(f"{known}, not {100 * inertia_bar:.3g} %, {shown}: {needed}")
    for axis in range(3):
        if sigma[6 + axis] > moment_bar_kg_m[axis]:
            known = f"moment along {AXES[axis]} is known to {1e6 * sigma[6 + axis]:.4g} g mm"
            needed = remedy("tilt", sigma[6 + axis], prior.sigma[6 + axis], moment_bar_kg_m[axis])
            faults.append(
                f"{known}, not {1e6 * moment_bar_kg_m[axis]:.3g}, after tilts of {tilt_deg:.1f} deg: {needed}"
            )
    if faults:
        raise InputError(
            "balance", f"{faults[0]}{f' ({len(faults) - 1} more)' if len(faults) > 1 else ''}"
        )


def remedy(motion: str, sigma: float, prior_sigma: float, bar: float) -> str:
    """What would do: the information is that beyond the assumed, which grows with the square of the motion and time."""
    needed = bar**-2 - prior_sigma**-2
    gained = max(sigma**-2 - prior_sigma**-2, 0.0)
    if gained < LEAST_INFORMATION * needed:
        return f"a {motion} is needed that the wheels' known momentum or a known trim weighs"
    factor = needed / gained
    return f"{motion} {np.sqrt(factor):.1f} times as far, or fly {factor:.1f} times as long"


def largest_rates_deg_s(records: Sequence[BearingRecord]) -> Floats:
    """(3,) largest rate about each body axis between two attitudes."""
    rates = [
        np.abs(
            (one.lab_from_body[:-1].inv() * one.lab_from_body[1:]).as_rotvec()
            / np.diff(one.t_s)[:, None]
        )
        for one in records
    ]
    return np.degrees(np.concatenate(rates).max(axis=0))


def largest_tilt_deg(records: Sequence[BearingRecord]) -> float:
    """Largest angle between body z and lab z."""
    cosines = np.concatenate([one.lab_from_body.as_matrix()[:, 2, 2] for one in records])
    return float(np.degrees(np.arccos(np.clip(cosines, -1, 1))).max())
