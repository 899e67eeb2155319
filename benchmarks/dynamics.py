"""Flying SimSat open loop, beside the bare mj_step on the same model."""

from __future__ import annotations

from typing import Any

import mujoco
import numpy as np
from scipy.spatial.transform import Rotation

from benchmarks.timing import versus
from skysim import scene, world


def measure() -> list[dict[str, Any]]:
    """Two seconds of flight at 1 ms."""
    ship = world.build(scene.Vehicle.model_validate({"model": "vehicles/simsat.xml", "mass": "80 kg"}))

    def bare() -> None:
        data = mujoco.MjData(ship.model)
        for _ in range(2000):
            mujoco.mj_step(ship.model, data)

    return [
        versus(
            "fly 2 s open loop",
            lambda: world.fly(ship, Rotation.identity(), np.array([0.0, 0.0, 0.1]), 2.0),
            "bare mj_step",
            bare,
            repeats=5,
        )
    ]
