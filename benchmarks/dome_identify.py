"""LED identification without a prior attitude: rates of correct, wrong and ambiguous results, and time.

AFIT's SimSat under its measured dome with 1,400 equal LEDs, at random attitudes up to 30 degrees of tilt.
"""

from __future__ import annotations

import time
from dataclasses import dataclass
from typing import Any

import numpy as np
from scipy.spatial.transform import Rotation

from benchmarks.timing import figure, verdict
from estimator.attitude.dome_map import LedMap, Lever, project
from estimator.core.camera import Camera
from estimator.identification import led_search
from estimator.identification.led_index import DomeIndex, build_dome_index
from skysim.core.types import Floats
from skysim.scene import loader
from skysim.simulation.lab import build_lab
from skysim.sources.dome.layouts import placing
from skysim.sources.dome.surface import Surface, build_surface
from skysim.tracking.onboard_model import calibration

TRIALS = 2000
COUNT = 1400
CAP_DEG = 40.0
TILT_DEG = 30.0


@dataclass(frozen=True)
class Case:
    """Test conditions: LED layout, centroid noise, error of the LED map per axis, fraction of LEDs off, number of
    false detections."""

    name: str
    places: str = "poisson_disk"
    noise_px: float = 0.2
    assumed_m: float = 0.2e-3
    dead: float = 0.0
    false: int = 0


CASES = (
    Case("poisson disk"),
    Case("random", "random"),
    Case("fibonacci", "fibonacci"),
    Case("half dead, 5 reflections", dead=0.5, false=5),
    Case("the same, LEDs known", dead=0.5, false=5, assumed_m=0.0),
    Case("5 reflections", false=5),
    Case("fibonacci, LEDs known", "fibonacci", assumed_m=0.0),
    Case("reflections only", dead=1.0, false=16),
)


def leds_m(places: str, count: int, surface: Surface, rng: np.random.Generator) -> Floats:
    """(count, 3) LED positions on the dome, m.

    A Poisson-disk layout comes from thinning random darts to a minimum distance; surplus LEDs are dropped at random.
    """
    half = np.radians(CAP_DEG)
    if places == "fibonacci":
        return placing.project_from_bearing(surface, placing.cap(count, half))
    darts_m = placing.project_from_bearing(
        surface, placing.scattered_cap(100 * count, half, rng)
    )
    if places == "random":
        return darts_m[:count]
    area_m2 = 2 * np.pi * 1.22**2 * (1 - np.cos(half))
    thinned = darts_m[placing.thin(darts_m, np.sqrt(0.6 * area_m2 / count))]
    return (
        thinned[:count]
        if len(thinned) < count
        else thinned[rng.permutation(len(thinned))[:count]]
    )


def attitude(rng: np.random.Generator) -> Rotation:
    """Random body_from_lab: boresight uniform in solid angle within TILT_DEG of the zenith, yaw uniform."""
    tilt = np.arccos(1 - rng.random() * (1 - np.cos(np.radians(TILT_DEG))))
    azimuth, yaw = rng.uniform(0, 2 * np.pi, 2)
    tilted = Rotation.from_rotvec(tilt * np.array([np.cos(azimuth), np.sin(azimuth), 0]))
    return Rotation.from_euler("z", yaw) * tilted


def trial(
    case: Case,
    truth_m: Floats,
    lever: Lever,
    camera: Camera,
    dome: DomeIndex,
    rng: np.random.Generator,
) -> tuple[str, float, int]:
    """Result of one frame ("identified", "WRONG" or the reason for none), its time, and the number of LEDs in it."""
    body_from_lab = attitude(rng)
    xy = project(body_from_lab, truth_m, lever, camera)
    seen = np.flatnonzero(camera.contains(np.nan_to_num(xy, nan=-1e9), 12))
    seen = seen[rng.random(len(seen)) >= case.dead]
    false = rng.random((case.false, 2)) * [camera.width_px, camera.height_px]
    detections_px = np.concatenate(
        [xy[seen] + case.noise_px * rng.standard_normal((len(seen), 2)), false]
    )
    order = rng.permutation(len(detections_px))
    detections_px = detections_px[order]
    name = np.concatenate([seen, np.full(case.false, -1)])[order]
    sigma = np.full(len(detections_px), case.noise_px / camera.focal_px)
    begin = time.perf_counter()
    match = led_search.identify(camera.rays(detections_px), sigma, dome)
    elapsed_s = time.perf_counter() - begin
    if isinstance(match, str):
        return match, elapsed_s, len(seen)
    # A reflection matched to a dead LED nearby is not an error; a true light matched to another LED is.
    named = name[match.observed]
    wrong = np.any((named != match.star) & (named >= 0)) or np.all(named < 0)
    return ("WRONG" if wrong else "identified"), elapsed_s, len(seen)


def measure(count: int = TRIALS, seed: int = 1) -> list[dict[str, Any]]:
    """Shares of results and times of all cases, `count` frames each."""
    return [row for case in CASES for row in measure_case(case, count, seed)]


def measure_case(case: Case, count: int, seed: int) -> list[dict[str, Any]]:
    """The rows of one case; a wrong identification misses its bar."""
    rng = np.random.default_rng(seed)
    lab = build_lab(loader.load("afit_simsat"))
    surface = build_surface(lab.scene.light.surface)
    truth_m = leds_m(case.places, COUNT, surface, rng)
    camera = calibration(lab.scene.camera)
    lever = Lever(np.array(lab.camera.mount.camera_body_m), lab.camera.mount.cam_from_body)
    assumed_m = truth_m + case.assumed_m * rng.standard_normal(truth_m.shape)
    leds = LedMap(
        np.arange(len(truth_m)), assumed_m, np.zeros(3), np.ones(3), sigma_m=case.assumed_m
    )
    dome = build_dome_index(leds, lever, camera)
    trial(case, truth_m, lever, camera, dome, rng)
    results = [trial(case, truth_m, lever, camera, dome, rng) for _ in range(count)]
    outcomes = np.array([outcome.split(":")[0] for outcome, _, _ in results])
    ms = 1e3 * np.array([elapsed_s for _, elapsed_s, _ in results])
    counts = [n for _, _, n in results]
    percent = {name: 100 * np.mean(outcomes == name) for name in ("identified", "ambiguous")}
    what = f"{count} frames"
    return [
        figure(f"{case.name}: LEDs seen, mean", np.mean(counts), "", what),
        figure(f"{case.name}: LEDs seen, least", min(counts), "", what),
        figure(f"{case.name}: identified", percent["identified"], "%", what),
        verdict(f"{case.name}: wrong", int(np.sum(outcomes == "WRONG")), "frames", what, 0),
        figure(f"{case.name}: ambiguous", percent["ambiguous"], "%", what),
        figure(f"{case.name}: time, median", np.median(ms), "ms", what),
        figure(f"{case.name}: time, 99 %", np.percentile(ms, 99), "ms", what),
    ]
