"""Simulation speed of SimSat: open loop against bare mj_step on the same model, closed loop against real time."""

from __future__ import annotations

import time
from collections.abc import Callable
from typing import Any

import mujoco
import numpy as np

from benchmarks.timing import verdict, versus
from skysim.scene import loader
from skysim.simulation.flight import Flight, simulate_motion
from skysim.simulation.lab import build_lab

FLOWN_S = 5.0
POSES = 200


def measure() -> list[dict[str, Any]]:
    """Open loop of each SimSat model, closed loop of three scenes, and interpolation of poses in an exposure."""
    return [*open_loops(), *closed_loops(), poses()]


def open_loops() -> list[dict[str, Any]]:
    """FLOWN_S seconds at 1 ms steps: the vehicle alone, with wheels, and with all actuators."""
    sets = {
        "alone": {},
        "wheels": {"wheels": "{}"},
        "everything": {"wheels": "{}", "cmgs": "{}", "fans": "{}"},
    }
    return [open_loop(name, more) for name, more in sets.items()]


def open_loop(name: str, more: dict[str, str]) -> dict[str, Any]:
    """The simulation of `skysim run` without control, against bare mj_step."""
    overrides = {f"vehicle.{key}": part for key, part in more.items()}
    overrides |= {"motion.control": "none", "motion.maneuver": "[]", "exposure.frames": "1"}
    lab = build_lab(
        loader.load("afit_simsat", overrides | {"exposure.first": f"{FLOWN_S - 0.012} s"})
    )
    model = lab.vehicle.model

    def bare() -> None:
        data = mujoco.MjData(model)
        for _ in range(round(FLOWN_S / 1e-3)):
            mujoco.mj_step(model, data)

    what = f"fly {FLOWN_S:g} s open loop, {name}"
    return versus(what, lambda: Flight(lab).simulate_motion(), "bare mj_step", bare, bar=0.9)


def closed_loops() -> list[dict[str, Any]]:
    """Simulated seconds per second, with a controller in Python at 100 Hz and the scenes' own disturbances."""
    return [closed_loop(name) for name in ("afit_simsat", "simsat_slew", "simsat_cmg")]


def closed_loop(name: str) -> dict[str, Any]:
    lab = build_lab(loader.load(name, {"exposure.frames": "3"}))
    ratio = lab.duration_s / best(lambda: Flight(lab).simulate_motion(), 30)
    return verdict(
        f"{name} closed loop, 100 Hz", ratio, "x real time", "the clock", 30.0, least=True
    )


def poses() -> dict[str, Any]:
    """Time to interpolate the attitudes at POSES moments of one exposure."""
    trajectory = simulate_motion(
        loader.load("simsat_slew", {"exposure.frames": "1"})
    ).trajectory()
    moments = np.linspace(0.5, 0.51, POSES)
    return verdict(
        f"{POSES} poses in an exposure",
        1e3 * best(lambda: trajectory.attitude_at(moments)),
        "ms",
        "",
        0.3,
    )


def best(work: Callable[[], Any], repeats: int = 30) -> float:
    """Minimum run time in seconds, after one warm-up run."""
    work()
    spent = []
    for _ in range(repeats):
        begin = time.perf_counter()
        work()
        spent.append(time.perf_counter() - begin)
    return min(spent)
