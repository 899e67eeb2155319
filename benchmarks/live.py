"""Frames over the wire: delay from the end of the exposure to the client, and its jitter, at 10 Hz.

The delay of a frame is its arrival at the client minus the end of its exposure by the wall clock, both of one machine.
Jitter is the distance of a delay from the median; p99 is its 99th percentile. The load of the machine is in the names.
"""

from __future__ import annotations

import json
import os
import re
import socket
import subprocess
import sys
import time
from typing import Any

import numpy as np

from benchmarks.timing import figure, verdict
from skysim.apps.live.packets import unpack

SCENE = "shefex2"
RATE_HZ = 10
SIZE_PX = 1024
JITTER_MS = 10.0
CHANNELS = ["frame", "state"]


def measure(count: int = 300) -> list[dict[str, Any]]:
    """Delays with the simulator on one core and on all of them."""
    cores = sorted(os.sched_getaffinity(0))
    rows = []
    for name, chosen in (("one core", cores[:1]), ("all cores", cores)):
        load = os.getloadavg()[0]
        delays_ms, statistics = delays(count, chosen)
        middle_ms = float(np.median(delays_ms))
        jitter_ms = float(np.quantile(np.abs(delays_ms - middle_ms), 0.99))
        where = f"{name}, {SIZE_PX} x {SIZE_PX} at {RATE_HZ} Hz, load {load:.1f}"
        jitter = f"p99 jitter on {where}"
        if name == "one core":
            rows.append(verdict(jitter, jitter_ms, "ms", "", JITTER_MS))
        else:
            rows.append(figure(jitter, jitter_ms, "ms"))
        rows.append(figure(f"median delay on {where}", middle_ms, "ms"))
        rows.append(figure(f"frames lost on {where}", count - len(delays_ms), ""))
        rows.append(figure(f"periods late on {where}", statistics["missed"], ""))
    return rows


def delays(count: int, cores: list[int]) -> tuple[np.ndarray, dict[str, Any]]:
    """Delays in ms of the frames at a client, and the counters of the simulator, which runs on some cores."""
    sets = {
        "exposure.rate_hz": RATE_HZ,
        "camera.width_px": SIZE_PX,
        "camera.height_px": SIZE_PX,
    }
    words = [word for key, value in sets.items() for word in ("--set", f"{key}={value}")]
    command = [
        sys.executable,
        "-m",
        "skysim",
        "live",
        SCENE,
        "--tcp",
        "0",
        "--wait",
        "--json",
    ]
    simulator = subprocess.Popen(
        [*command, "--frames", str(count), *words],
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        text=True,
    )
    os.sched_setaffinity(simulator.pid, cores)
    assert simulator.stderr is not None
    found = re.search(r":(\d+) ", simulator.stderr.readline())
    assert found is not None
    delays_ms = []
    with socket.create_connection(("127.0.0.1", int(found[1]))) as wire:
        wire.sendall(json.dumps({"take": CHANNELS}).encode() + b"\n")
        stream = wire.makefile("rb")
        while packet := unpack(stream):
            if packet[0]["channel"] == "frame":
                delays_ms.append(1e3 * (time.time() - packet[0]["due_unix_s"]))
    statistics: dict[str, Any] = json.loads(simulator.communicate()[0])
    return np.array(delays_ms), statistics
