"""Endurance test of the closed loop over an hour: memory growth, drift of time stamps, wrong attitudes.

`python -m benchmarks.endurance [SECONDS] [HERTZ]` simulates SimSat on its wheels with a slow sinusoidal reference and
feedback from the attitude filter, which is updated by every frame. It prints memory use every simulated minute. An
hour at 10 Hz takes half an hour.
"""

from __future__ import annotations

import gc
import sys
import time

import psutil

from skysim.core.constants import ARCSEC_RAD
from skysim.results import metrics
from skysim.scene.loader import load
from skysim.simulation.flight import open_flight

WARM_S = (
    60.0  # simulated time after which all code was called once; memory growth is counted from here
)
SCENE = {
    "seed": "11",
    "motion.start": "{roll_deg: 0, pitch_deg: 0, yaw_deg: 0}",
    "motion.maneuver": "[{kind: sine, amplitude_deg: [4, 3, 10], frequency_hz: 0.01, duration: 1e6 s}]",
    "motion.control.feedback": "filter",
    "exposure.first": "0.1 s",
}


def main(duration_s: float, rate_hz: float) -> None:
    """Run the simulation; print one line per simulated minute, then memory growth, drift and attitude errors."""
    frames = round(duration_s * rate_hz)
    overrides = SCENE | {"exposure.rate_hz": str(rate_hz), "exposure.frames": str(frames)}
    flight = open_flight(load("simsat_bump", overrides), keeps_history=False)
    process = psutil.Process()
    begin = time.monotonic()
    memory_mb: list[float] = []
    solved = wrong = 0
    first_s = late_s = 0.0
    print(f"{'flight':>8s} {'wall':>8s} {'memory':>10s}  solved  wrong")
    for n, shot in enumerate(flight.shots(), 1):
        first_s = first_s or shot.frame.t_mid_s
        late_s = max(late_s, abs(shot.frame.t_mid_s - first_s - (n - 1) / rate_hz))
        attitude = shot.report.attitude.cam_from_ref if shot.report else None
        solved += attitude is not None
        wrong += attitude is not None and metrics.is_wrong(
            (attitude * shot.truth.cam_from_lab.inv()).magnitude()
        )
        if n % round(60 * rate_hz) == 0 or n == frames:
            gc.collect()
            memory_mb.append(process.memory_info().rss / 1e6)
            wall_s = time.monotonic() - begin
            print(
                f"{n / rate_hz:6.0f} s {wall_s:6.0f} s {memory_mb[-1]:7.1f} MB {solved:7d} {wrong:6d}",
                flush=True,
            )
    after = memory_mb[round(WARM_S // 60) - 1 :]
    growth = max(after) / after[0] - 1
    off = (
        metrics.cross_and_roll_rad(attitude, shot.truth.cam_from_lab)[0] / ARCSEC_RAD
        if attitude
        else float("nan")
    )
    print(f"memory grew by {100 * growth:.2f} % after the first minute (bar 1 %)")
    print(f"time stamps drifted by {late_s:.2g} s")
    print(f"{solved} of {n} solved, {wrong} wrong, the last off by {off:.2g} arcsec")


if __name__ == "__main__":
    given = [float(one) for one in sys.argv[1:]]
    main(*(given + [3600.0, 10.0][len(given) :]))
