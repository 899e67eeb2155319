"""Frames over the wire: delay from the end of the exposure to the client, and its jitter, at 10 Hz.

The delay of a frame is its arrival at the client minus the end of its exposure by the wall clock, both of one machine.
Jitter is the distance of a delay from the median; p99 is its 99th percentile. The load of the machine is in the names.
The last rows are from a frame's being ready to its arrival, at clients of three protocols that take the same frames.
"""

from __future__ import annotations

import asyncio
import json
import os
import re
import shutil
import socket
import subprocess
import sys
import threading
import time
from collections.abc import Iterator
from contextlib import contextmanager
from importlib.util import find_spec
from pathlib import Path
from typing import Any

import numpy as np

from benchmarks.timing import figure, verdict
from skysim.apps.live.packets import unpack

SCENE = "shefex2"
RATE_HZ = 10
SIZE_PX = 1024
JITTER_MS = 10.0
CHANNELS = ["frame", "state"]
IMAGE_TOPIC = "/camera/image_raw"
ARAVIS_CLIENT = Path(__file__).parents[1] / "tests/helpers/aravis_client.py"
SYSTEM_PYTHON = "/usr/bin/python3"  # has Debian's packages


def measure(count: int = 300) -> list[dict[str, Any]]:
    """Delays with the simulator on one core and on all of them, and at clients of several protocols."""
    cores = sorted(os.sched_getaffinity(0))
    rows = []
    for name, chosen in (("one core", cores[:1]), ("all cores", cores)):
        load = os.getloadavg()[0]
        delays_ms, statistics = delays(count, chosen)
        middle_ms, jitter_ms = middle_and_jitter(delays_ms)
        where = f"{name}, {SIZE_PX} x {SIZE_PX} at {RATE_HZ} Hz, load {load:.1f}"
        jitter = f"p99 jitter on {where}"
        if name == "one core":
            rows.append(verdict(jitter, jitter_ms, "ms", "", JITTER_MS))
        else:
            rows.append(figure(jitter, jitter_ms, "ms"))
        rows.append(figure(f"median delay on {where}", middle_ms, "ms"))
        rows.append(figure(f"frames lost on {where}", count - len(delays_ms), ""))
        rows.append(figure(f"periods late on {where}", statistics["missed"], ""))
    load = os.getloadavg()[0]
    for protocol, delays_ms in protocol_delays(count).items():
        middle_ms, jitter_ms = middle_and_jitter(delays_ms)
        where = f"from ready to {protocol}, {len(delays_ms)} frames, load {load:.1f}"
        rows.append(figure(f"median delay {where}", middle_ms, "ms"))
        rows.append(figure(f"p99 jitter {where}", jitter_ms, "ms"))
    return rows


def middle_and_jitter(delays_ms: np.ndarray) -> tuple[float, float]:
    """Median of delays, and the 99th percentile of the distances from it."""
    middle_ms = float(np.median(delays_ms))
    return middle_ms, float(np.quantile(np.abs(delays_ms - middle_ms), 0.99))


@contextmanager
def simulator(count: int, outputs: list[str]) -> Iterator[subprocess.Popen[str]]:
    """`skysim live` with some outputs, which waits for the client of --tcp."""
    sets = {
        "exposure.rate_hz": RATE_HZ,
        "camera.width_px": SIZE_PX,
        "camera.height_px": SIZE_PX,
    }
    words = [word for key, value in sets.items() for word in ("--set", f"{key}={value}")]
    command = ["-m", "skysim", "live", SCENE, *outputs, "--wait", "--json"]
    with subprocess.Popen(
        [sys.executable, *command, "--frames", str(count), *words],
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        text=True,
    ) as process:
        yield process


def port_of(process: subprocess.Popen[str], output: str) -> int:
    """Port of an output, which the command prints."""
    assert process.stderr is not None
    for line in process.stderr:
        found = re.search(rf"live: {output} .*?:(\d+)\b", line)
        if found:
            return int(found[1])
    raise RuntimeError(f"no line of {output}")


def frames_of(port: int) -> Iterator[tuple[dict[str, Any], float]]:
    """Headers of a flight's frames, and the Unix times of their arrival."""
    with socket.create_connection(("127.0.0.1", port)) as wire:
        wire.sendall(json.dumps({"take": CHANNELS}).encode() + b"\n")
        stream = wire.makefile("rb")
        while packet := unpack(stream):
            if packet[0]["channel"] == "frame":
                yield packet[0], time.time()


def delays(count: int, cores: list[int]) -> tuple[np.ndarray, dict[str, Any]]:
    """Delays in ms of the frames at a client, and the counters of the simulator, which runs on some cores."""
    with simulator(count, ["--tcp", "0"]) as process:
        os.sched_setaffinity(process.pid, cores)
        frames = frames_of(port_of(process, "tcp"))
        delays_ms = [1e3 * (arrival_s - head["due_unix_s"]) for head, arrival_s in frames]
        statistics: dict[str, Any] = json.loads(process.communicate()[0])
    return np.array(delays_ms), statistics


def protocol_delays(count: int) -> dict[str, np.ndarray]:
    """Delays in ms from a frame's being ready to its arrival at clients of each protocol, all at once."""
    outputs = ["--tcp", "0"]
    arrivals: dict[str, dict[int, float]] = {"tcp": {}}
    if find_spec("foxglove"):
        outputs = ["--foxglove", "0", *outputs]
        arrivals["foxglove"] = {}
    has_aravis = shutil.which("arv-tool-0.8") is not None
    if has_aravis:
        outputs = ["--gige", *outputs]
    ready_s = {}
    has_subscribed = threading.Event()
    with simulator(count, outputs) as process:
        if has_aravis:
            port_of(process, "gige")
            # It may miss the flight's first frames.
            aravis = subprocess.Popen(
                [SYSTEM_PYTHON, ARAVIS_CLIENT, "{}", str(count // 2)],
                stdout=subprocess.PIPE,
                text=True,
            )
        if "foxglove" in arrivals:
            what = (port_of(process, "foxglove"), arrivals["foxglove"], has_subscribed)
            watching = threading.Thread(target=watch, args=what)
            watching.start()
            has_subscribed.wait(30)
        port = port_of(process, "tcp")
        for head, arrival_s in frames_of(port):
            t_ns = round(1e9 * head["t_s"])
            ready_s[t_ns] = head["made_unix_s"]
            arrivals["tcp"][t_ns] = arrival_s
        if "foxglove" in arrivals:
            watching.join()
    if has_aravis:
        lines = map(json.loads, aravis.communicate(timeout=60)[0].splitlines())
        arrivals["gige"] = {one["t_ns"]: one["arrival_s"] for one in lines}
    # Stamps of ROS are on the wall's clock, whose start the first of them tells.
    if arrivals.get("foxglove"):
        shift_ns = min(arrivals["foxglove"]) - min(ready_s)
        arrivals["foxglove"] = {t - shift_ns: s for t, s in arrivals["foxglove"].items()}
    return {
        name: np.array([1e3 * (at[t] - ready_s[t]) for t in at.keys() & ready_s.keys()])
        for name, at in arrivals.items()
    }


def watch(port: int, arrivals: dict[int, float], has_subscribed: threading.Event) -> None:
    """A client of Foxglove: Unix times of arrival of the images, by their stamps in ns."""
    import websockets

    async def receive() -> None:
        async with websockets.connect(
            f"ws://127.0.0.1:{port}",
            subprotocols=[websockets.Subprotocol("foxglove.sdk.v1")],
            max_size=None,
        ) as client:
            await client.recv()
            channels = json.loads(await client.recv())["channels"]
            (image,) = (one["id"] for one in channels if one["topic"] == IMAGE_TOPIC)
            wanted = {"id": 1, "channelId": image}
            await client.send(json.dumps({"op": "subscribe", "subscriptions": [wanted]}))
            # The server has no answer to a subscription.
            await asyncio.sleep(0.5)
            has_subscribed.set()
            async for data in client:
                # Message data: opcode 1, subscription, and log time, little-endian.
                assert isinstance(data, bytes)
                arrivals[int.from_bytes(data[5:13], "little")] = time.time()

    asyncio.run(receive())
