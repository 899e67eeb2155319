"""Angular rate from the streaks of one frame of scene shefex2 with 50 ms exposure, without a gyro.

The error across the boresight is that of the vector, as a share of the rate, with the sign that is nearer to the truth.
The NEES has three degrees of freedom.
"""

from __future__ import annotations

from typing import Any

import numpy as np

from benchmarks.rolling import Work, frame_of, nees_row, row
from skysim.results import metrics
from skysim.tracking import factory

RATES_DEG_S = (0.5, 1.0, 2.0, 3.0, 5.0, 7.0, 10.0)
BAR_PERCENT = 2.0
WORK = Work("SHEFEX", "shefex2", "80 us", 200, {"exposure.time": "50 ms"})


def measure(
    rates_deg_s: tuple[float, ...] = RATES_DEG_S, count: int = WORK.frames
) -> list[dict[str, Any]]:
    """Share of the frames that tell the rate, its error across the boresight and its NEES, for each rate."""
    lab = WORK.lab(False)
    rows = []
    for rate_deg_s in rates_deg_s:
        errors = []
        nees = []
        for seed in range(count):
            frame, truth, tracker = frame_of(WORK, lab, rate_deg_s, seed)
            rate = factory.solve_frame(tracker, frame).attitude.rate
            if rate is None:
                continue
            both = [sign * rate.rate_rad_s - truth.rate_cam_rad_s for sign in (1, -1)]
            error = min(both, key=lambda one: float(one @ one))
            errors.append(
                100 * np.linalg.norm(error[:2]) / np.linalg.norm(truth.rate_cam_rad_s[:2])
            )
            nees.append(error @ np.linalg.solve(rate.covariance_rad2_s2, error))
        name = f"SHEFEX, 50 ms, {rate_deg_s:g} deg/s"
        rows.append(
            row(
                f"{name}: frames with a rate",
                100 * len(errors) / count,
                "%",
                None,
                None,
                None,
            )
        )
        if not errors:
            continue
        rms = float(metrics.rms(np.array(errors)))
        rows += [
            row(
                f"{name}: across the boresight",
                rms,
                "% rms",
                None,
                BAR_PERCENT,
                rms <= BAR_PERCENT,
            ),
            nees_row(f"{name}: NEES", np.array(nees)),
        ]
    return rows
