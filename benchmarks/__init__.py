"""Benchmarks of skysim and the estimator: figures of the docs, bars of the project, and the best peers in the same run.

`python -m benchmarks` says how they are run. Each area is a module whose `measure` returns rows; it is imported when it
is used. Where `measure` has a `count` or a `seed`, they can be chosen.
"""

from __future__ import annotations

import importlib
import inspect
from dataclasses import dataclass
from typing import Any


@dataclass(frozen=True)
class Area:
    """What an area measures, and what of it takes a minute or less.

    quick : options of `measure` for the quick part; {} if the whole area is quick, None if nothing of it is
    """

    about: str
    quick: dict[str, int] | None = None


WHOLE: dict[str, int] = {}
# By the module's name. A name's first word is a group: `dome` stands for all areas whose names begin with `dome_`.
AREAS = {
    "instrument": Area("rendering and noise beside GalSim and getframes", WHOLE),
    "detect": Area("detection and centroids beside other packages", WHOLE),
    "identify": Area("star identification beside tetra3rs", WHOLE),
    "attitude": Area("attitude solvers beside scipy", WHOLE),
    "dynamics": Area("a vehicle's flight beside bare MuJoCo", WHOLE),
    "live": Area("delay and jitter of frames over the wire", {"count": 30}),
    "start": Area("CPU time of the first commands", WHOLE),
    "footprint": Area("memory and time of the estimator on one core", WHOLE),
    "frames": Area("from image to attitude beside tetra3rs and cedar-solve", {"count": 10}),
    "lost_in_space": Area("fields identified beside peers and an oracle", {"count": 20}),
    "nees": Area(
        "honest covariances where the tracker's noise is understated", {"count": 50}
    ),
    "lenses": Area("cameras whose model is wrong, beside tetra3rs", {"count": 5}),
    "rate": Area("angular rate from the streaks of one frame", {"count": 20}),
    "rolling": Area("rolling shutter against a global one"),
    "motion": Area(
        "honest covariances at long streaks, accelerations and in tracking mode", {"count": 6}
    ),
    "smear": Area("frames solved by rate: SHEFEX-2's chain and ours", {"count": 10}),
    "heads": Area("two star cameras: the roll, and drifting mounts", {"count": 50}),
    "photographs": Area("pictures as people take them", {"count": 1}),
    "sky": Area("planets, satellites, narrow fields and a deep sky; builds a catalog"),
    "refraction": Area("refraction in photographs of the real sky, which are needed"),
    "codes_attitudes": Area("LEDs that blink their names: attitudes found", {"count": 20}),
    "codes_bit_errors": Area("bit errors of blinking LEDs against theory", {"count": 50}),
    "codes_first_attitude": Area(
        "time to the first attitude by code, rate and number of LEDs"
    ),
    "dome_nearfield": Area(
        "six methods for lights nearby under five surfaces", {"count": 20}
    ),
    "dome_identify": Area("LEDs named without a prior attitude", {"count": 100}),
    "dome_focal": Area("LEDs named with an uncalibrated lens"),
    "dome_invariants": Area("what invariants of LED groups can tell", {"count": 3}),
    "dome_placement": Area("layouts of LEDs compared at independent attitudes"),
    "robust_hostile": Area("images that do not show the sky", {"count": 100}),
    "robust_no_sky": Area("answers to lights without a sky", {"count": 1000}),
    "robust_two_skies": Area("a second sky in the frame", {"count": 320}),
    "robust_hour": Area("an hour of closed loop: memory, time stamps, wrong attitudes"),
    "oracles_frames": Area("our frames, solved by other tools", {"count": 10}),
    "oracles_galsim": Area("GalSim's frames, solved by ours", {"count": 9}),
    "scale_rates": Area("frames, trials and closed loops a second on two cores"),
    "scale_frame_cost": Area("a model of what a labelled frame costs"),
    "scale_store": Area("reports and exports of ten million rows"),
    "scale_domes": Area(
        "places, index and identification of a dome's LEDs as their number grows"
    ),
    "scale_coordination": Area("chunks a second that a study hands out to 64 workers"),
    "lab": Area("the page in Chromium: frames a second, latency, memory, a crowd of tabs"),
}


def chosen(name: str) -> list[str]:
    """The areas of a name: itself, and those of the group. Empty if there is none."""
    return [area for area in AREAS if area == name or area.startswith(f"{name}_")]


def options(area: str) -> set[str]:
    """The options that an area takes, among `count` and `seed`."""
    module = importlib.import_module(f"benchmarks.{area}")
    return {"count", "seed"} & set(inspect.signature(module.measure).parameters)


def measure(area: str, **chosen_options: int) -> list[dict[str, Any]]:
    """The results of one area: {name, value, unit, peer, peer_value, ratio, bar, met}."""
    module = importlib.import_module(f"benchmarks.{area}")
    rows: list[dict[str, Any]] = module.measure(**chosen_options)
    return rows
