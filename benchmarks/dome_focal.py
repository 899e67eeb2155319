"""LED identification with an uncalibrated lens and a poor map: rates of right, wrong and refused attitudes.

AFIT's SimSat under its measured dome, as in `dome_identify`. The focal length that the tracker assumes is wrong by up
to 10 %; focal length and map are drawn anew every second frame.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, replace
from typing import Any, NamedTuple

import numpy as np
from scipy.spatial.transform import Rotation

from benchmarks.dome_identify import attitude, leds_m
from benchmarks.timing import figure, verdict
from estimator.attitude.dome_map import LedMap, Lever, project
from estimator.core.camera import Camera
from estimator.core.checks import Ints
from estimator.core.types import Attitude, Centroids
from estimator.trackers.dome_tracker import SETTINGS, DomeTracker
from skysim.scene import loader
from skysim.simulation.lab import build_lab
from skysim.sources.dome.surface import Surface, build_surface
from skysim.tracking.onboard_model import calibration

TRIALS = 1000
NOISE_PX = 0.2
FRAMES_A_MAP = 2
# (identifier, whether the tracker knows that its focal length is uncertain)
IDENTIFIERS = (
    ("led_pairs", False),
    ("led_pairs", True),
    ("pyramid", False),
    ("saa", False),
    ("non_dimensional", False),
)


@dataclass(frozen=True)
class Case:
    """Number of LEDs, error of each in the map along each axis, error of the surface that all share (outward), greatest
    error of the focal length, the lens's focal length relative to AFIT's, and the fraction of frames."""

    leds: int = 1400
    own_m: float = 0.2e-3
    surface_m: float = 0.0
    focal: float = 0.1
    zoom: float = 1.0
    share: float = 1.0

    @property
    def name(self) -> str:
        """The case in a row's name."""
        map_error = f"{1e3 * self.own_m:g} mm"
        shared = f" and {1e3 * self.surface_m:g} mm in common" if self.surface_m else ""
        return f"{self.leds} LEDs to {map_error}{shared}, focal length to {self.focal:.0%}, zoom {self.zoom:g}"


CASES = (
    Case(focal=0.0, share=0.2),
    Case(),
    Case(own_m=1e-3),
    Case(own_m=3e-3, share=0.2),
    Case(own_m=1e-2, share=0.1),
    Case(own_m=3e-2, share=0.1),
    Case(surface_m=1e-2, share=0.2),
    Case(surface_m=3e-2),
    Case(leds=1000),
    Case(leds=700, focal=0.0, share=0.2),
    Case(leds=700),
    Case(leds=400, share=0.2),
    Case(leds=400, zoom=0.24, share=0.2),
    Case(leds=400, own_m=1e-2, zoom=0.24, share=0.2),
    Case(leds=400, own_m=3e-2, zoom=0.24, share=0.1),
)


class Frame(NamedTuple):
    """What the tracker assumes, the lights in a frame, which LED each is, and the true attitude."""

    camera: Camera
    leds: LedMap
    centroids: Centroids
    name: Ints
    cam_from_lab: Rotation


def frames(
    case: Case,
    surface: Surface,
    lens: Camera,
    lever: Lever,
    trials: int,
    rng: np.random.Generator,
) -> Iterator[Frame]:
    """Frames of one case at random attitudes, the lights in random order."""
    truth_m = leds_m("poisson_disk", case.leds, surface, rng)
    outward = -surface.inward(truth_m)
    center_m, semi_axes_m = surface.as_ellipsoid()
    common_m = case.surface_m * outward[None] if case.surface_m else None
    for n in range(trials):
        if n % FRAMES_A_MAP == 0:
            error_m = case.surface_m * rng.standard_normal() * outward
            assumed_m = truth_m + error_m + case.own_m * rng.standard_normal(truth_m.shape)
            names = np.arange(len(truth_m))
            leds = LedMap(
                names, assumed_m, center_m, semi_axes_m, None, case.own_m, None, common_m
            )
            camera = lens.zoomed(1 / (1 + rng.uniform(-case.focal, case.focal)))
        body_from_lab = attitude(rng)
        xy = project(body_from_lab, truth_m, lever, lens)
        seen = rng.permutation(np.flatnonzero(lens.contains(np.nan_to_num(xy, nan=-1e9), 12)))
        xy = xy[seen] + NOISE_PX * rng.standard_normal((len(seen), 2))
        lights = Centroids(xy, np.full(len(seen), 1e-3), np.ones(len(seen)))
        yield Frame(camera, leds, lights, seen, lever.cam_from_body * body_from_lab)


def outcome(frame: Frame, answer: Attitude) -> str:
    """Whether an answer is found, WRONG (a light with another LED's name) or refused."""
    if answer.match is None:
        return "refused"
    return (
        "found" if np.all(frame.name[answer.match.observed] == answer.match.star) else "WRONG"
    )


def errors(frame: Frame, answer: Attitude, lens: Camera) -> tuple[float, float, float]:
    """Normalized squared error of a right attitude, its angle in degrees, and the focal length's relative error."""
    assert answer.cam_from_ref is not None
    assert answer.camera is not None
    error = (answer.cam_from_ref * frame.cam_from_lab.inv()).as_rotvec()
    nees = float(error @ np.linalg.solve(answer.covariance_rad2, error))
    return (
        nees,
        float(np.degrees(np.linalg.norm(error))),
        answer.camera.focal_px / lens.focal_px - 1,
    )


def measure(count: int = TRIALS, seed: int = 1) -> list[dict[str, Any]]:
    """All cases with all identifiers; `count` frames times the case's share, a tenth for the published identifiers."""
    rows = []
    for case in CASES:
        frames_of_case = max(int(case.share * count), 10)
        for identifier, knows in IDENTIFIERS:
            share = 1 if identifier == "non_dimensional" else 10
            trials = max(frames_of_case // share, 10)
            rows += measure_case(case, identifier, knows, trials, seed)
    return rows


def measure_case(
    case: Case, identifier: str, knows: bool, trials: int, seed: int
) -> list[dict[str, Any]]:
    """Found share and wrong ones of an identifier; then mean NEES, rms errors of attitude and focal length."""
    lab = build_lab(loader.load("afit_simsat"))
    surface = build_surface(lab.scene.light.surface)
    lens = calibration(lab.scene.camera).zoomed(case.zoom)
    lever = Lever(np.array(lab.camera.mount.camera_body_m), lab.camera.mount.cam_from_body)
    settings = replace(SETTINGS, identifier=identifier, centroid_sigma_px=NOISE_PX)
    outcomes = []
    right = []
    tracker = None
    for frame in frames(case, surface, lens, lever, trials, np.random.default_rng(seed)):
        camera = replace(frame.camera, focal_sigma=case.focal / np.sqrt(3) if knows else 0.0)
        if tracker is None or tracker.leds is not frame.leds:
            tracker = DomeTracker(camera, frame.leds, lever, settings)
        answer = tracker.solve_centroids(frame.centroids)
        outcomes.append(outcome(frame, answer))
        if outcomes[-1] == "found":
            right.append(errors(frame, answer, lens))
    found, wrong = (outcomes.count(name) for name in ("found", "WRONG"))
    what = f"{trials} frames"
    name = f"{case.name}, {identifier}{', sigma declared' if knows else ''}"
    rows = [
        figure(f"{name}: found", 100 * found / trials, "%", what),
        verdict(f"{name}: wrong", wrong, "frames", what, 0),
    ]
    if right:
        nees, error_deg, focal = np.array(right).T
        rows += [
            figure(f"{name}: NEES", nees.mean(), "", what),
            figure(f"{name}: attitude", np.sqrt(np.mean(error_deg**2)), "deg rms", what),
            figure(f"{name}: focal length", 100 * np.sqrt(np.mean(focal**2)), "% rms", what),
        ]
    return rows
