"""Attitude error of six near-field methods under five surfaces, without noise and with: the first table of dome.md.

The trials are those of `tests.helpers.nearfield`. The methods receive the true positions of the lights, and a centered
sphere as the assumed surface of the dome.
"""

from __future__ import annotations

from typing import Any

from benchmarks.timing import figure
from estimator.attitude.nearfield import SOLVERS
from tests.helpers.nearfield import GEOMETRIES, NOISE_PX, cross_and_roll, errors_deg

TRIALS = 500


def measure(count: int = TRIALS, seed: int = 1) -> list[dict[str, Any]]:
    """RMS errors across the boresight and in roll, by noise, method, tilt and surface; `count` trials each."""
    rows = []
    for noise_px in (0.0, NOISE_PX):
        for method in SOLVERS:
            for surface, geometry in GEOMETRIES.items():
                for tilt_deg in geometry.tilts_deg:
                    errors = errors_deg(method, geometry, tilt_deg, count, seed, noise_px)
                    cross, roll = cross_and_roll(errors)
                    name = f"{method}, {surface}, {tilt_deg:g} deg of tilt, {noise_px} px"
                    rows += [
                        figure(f"{name}: cross", cross, "deg rms", f"{count} trials"),
                        figure(f"{name}: roll", roll, "deg rms", f"{count} trials"),
                    ]
    return rows
