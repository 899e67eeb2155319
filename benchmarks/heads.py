"""Two star cameras at a right angle: the roll alone and fused, against what their covariances predict.

The errors of the roll about the main boresight are compared with what the trackers and the filter claim. Then the scene
`two_heads` flies with other seeds, and the second boresight relative to the first and the first relative to the gyro
are compared with the truth at the end.
"""

from __future__ import annotations

from typing import Any

import numpy as np

from benchmarks.timing import figure
from skysim.core.constants import ARCSEC_RAD
from skysim.scene.loader import load_scene
from skysim.simulation.flight import simulate_motion
from tests.helpers.head_pairs import gain, measured_pairs

PAIRS = 2000
PAIRS_A_FLIGHT = 200


def measure(count: int = PAIRS, seed: int = 1) -> list[dict[str, Any]]:
    """The roll's gain of `count` pairs of frames beside the predicted one, and the drift errors of some flights."""
    found = gain(measured_pairs(count, seed))
    flights = max(count // PAIRS_A_FLIGHT, 1)
    drift = drift_errors_arcsec(flights, seed)
    return [
        figure("pairs solved", 100 * found.pairs / count, "%", f"of {count}"),
        figure("roll: lower by", found.factor, "x", "covariances")
        | {"peer_value": found.predicted, "ratio": found.factor / found.predicted},
        figure("fused attitude: NEES", found.nees, "", "3 for an honest covariance"),
        *(
            figure(
                f"boresight {name}: rms",
                float(np.sqrt(np.mean(errors**2))),
                "arcsec",
                f"{flights} flights",
            )
            for name, errors in zip(("side to main", "main to gyro"), drift.T, strict=True)
        ),
    ]


def drift_errors_arcsec(flights: int, seed: int) -> np.ndarray:
    """(flights, 2) errors at the end of the scene: side boresight relative to the main one, and that to the gyro."""
    errors = []
    for n in range(flights):
        flight = simulate_motion(load_scene("two_heads", {"seed": seed + n}))
        mountings = flight.telemetry().mountings
        row = []
        for camera in flight.lab.cameras:
            mounting = mountings[camera.name]
            error = camera.mount.cam_from_body.apply(
                mounting.estimate_rad[-1] - mounting.true_rad[-1]
            )
            row.append(np.linalg.norm(error[:2]) / ARCSEC_RAD)
        errors.append(row[::-1])
    return np.array(errors)
