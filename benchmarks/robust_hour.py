"""Endurance test of the closed loop over an hour: memory growth, drift of time stamps, wrong attitudes.

SimSat on its wheels follows a slow sinusoidal reference, with feedback from the attitude filter, which is updated by
every frame. An hour at 10 Hz takes half an hour. Progress is printed to stderr every simulated minute.
"""

from __future__ import annotations

import gc
import sys
from typing import Any

import psutil

from benchmarks.timing import figure, verdict
from skysim.core.constants import ARCSEC_RAD
from skysim.results import metrics
from skysim.scene.loader import load
from skysim.simulation.flight import open_flight

FRAMES = 36_000
RATE_HZ = 10.0
WARM_S = (
    60.0  # simulated time after which all code was called once; growth is counted from here
)
MOST_GROWTH = 1.0  # %
SCENE = {
    "seed": "11",
    "motion.start": "{roll_deg: 0, pitch_deg: 0, yaw_deg: 0}",
    "motion.maneuver": "[{kind: sine, amplitude_deg: [4, 3, 10], frequency_hz: 0.01, duration: 1e6 s}]",
    "motion.control.feedback": "filter",
    "exposure.first": "0.1 s",
}


def measure(count: int = FRAMES) -> list[dict[str, Any]]:
    """Memory growth, drift of the time stamps, and solved and wrong attitudes of `count` frames."""
    timing = {"exposure.rate_hz": str(RATE_HZ), "exposure.frames": str(count)}
    flight = open_flight(load("simsat_bump", SCENE | timing), keeps_history=False)
    process = psutil.Process()
    memory_mb: list[float] = []
    solved = wrong = 0
    first_s = late_s = 0.0
    for n, shot in enumerate(flight.shots(), 1):
        first_s = first_s or shot.frame.t_mid_s
        late_s = max(late_s, abs(shot.frame.t_mid_s - first_s - (n - 1) / RATE_HZ))
        attitude = shot.report.attitude.cam_from_ref if shot.report else None
        solved += attitude is not None
        wrong += attitude is not None and metrics.is_wrong(
            (attitude * shot.truth.cam_from_lab.inv()).magnitude()
        )
        if n % round(WARM_S * RATE_HZ) == 0 or n == count:
            gc.collect()
            memory_mb.append(process.memory_info().rss / 1e6)
            progress = (
                f"{n / RATE_HZ:.0f} s, {memory_mb[-1]:.1f} MB, {solved} solved, {wrong} wrong"
            )
            print(progress, file=sys.stderr, flush=True)
    growth = 100 * (max(memory_mb) / memory_mb[0] - 1)
    off_rad = (
        metrics.cross_and_roll_rad(attitude, shot.truth.cam_from_lab)[0] if attitude else None
    )
    what = f"{count} frames at {RATE_HZ:g} Hz"
    return [
        verdict("memory: growth after the first minute", growth, "%", what, MOST_GROWTH),
        figure("time stamps: drift", late_s, "s", what),
        figure("solved", solved, "frames", what),
        verdict("wrong", wrong, "frames", what, 0),
        figure(
            "last attitude: cross",
            float("nan") if off_rad is None else off_rad / ARCSEC_RAD,
            "arcsec",
        ),
    ]
