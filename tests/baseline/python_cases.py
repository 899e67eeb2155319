"""Runs from Python, with parts of the user's own. Each function writes its results to the folder `out`."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np

import skysim


def simulated(scene: str, changes: dict[str, Any], **parts: Any) -> None:
    """Simulate a scene and save what `skysim run` writes."""
    skysim.simulate(skysim.load_scene(scene, changes), **parts).save("out")


def own_profile() -> None:
    """A table of attitudes in place of start and maneuvers."""
    t_s = np.linspace(0, 3, 13)
    columns = {"t_s": t_s, "roll_deg": 0.1 * t_s, "pitch_deg": -0.1 * t_s, "yaw_deg": 0.5 * t_s}
    scene = skysim.load_scene("afit_simsat", {"exposure.frames": 3, "motion.control": "prescribed"})
    run = skysim.simulate(scene, profile=columns)
    Path("out").mkdir()  # `save` fails: the check before it reads the table's file, which there is not
    run.table().write("out/solutions.ecsv")
    for frame in run:
        np.save(f"out/{frame.row.frame}", frame.image)


def single_frames() -> None:
    """One frame of a complete run each."""
    Path("out").mkdir()
    for name, index in (("shefex2", 2), ("afit_simsat", 1), ("simsat_bump", 1)):
        frame, truth = skysim.render(skysim.load_scene(name, {"exposure.frames": 3}), index)
        np.save(f"out/{name}", frame.image_dn)
        np.save(f"out/{name} attitude", truth.cam_from_lab.as_quat())


def study() -> None:
    """The tables of a study."""
    result = skysim.run_study("led_count", {"replicates": 1}, out="study", workers=1)
    Path("out").mkdir()
    result.table().write("out/table.ecsv")
    result.trials().write("out/trials.ecsv")


def turned(image: Any) -> tuple[float, ...]:
    """A tracker whose answer is always the same attitude."""
    return (0.0, 0.0, np.sin(0.01), np.cos(0.01))


PYTHON_CASES: dict[str, Callable[[], None]] = {
    "heads": lambda: simulated("two_heads", {"exposure.frames": 2}),
    "tracker": lambda: simulated("simsat_bump", {"exposure.frames": 3}, tracker=turned),
    "controller": lambda: simulated(
        "afit_simsat", {"exposure.frames": 3}, controller=lambda setup: lambda now: np.array([1e-3, -2e-3, 3e-3])
    ),
    "profile": own_profile,
    "render": single_frames,
    "study": study,
}
