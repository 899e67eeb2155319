"""LEDs that blink their names: attitudes found, and wrong ones.

Centroids of scene coded_spiral, 400 LEDs on a spiral, at random attitudes within 30 degrees of tilt, at rest or turning
at a constant rate about a random axis. A light's position and brightness have the errors of `Noise`. Some sequences are
rendered too, and other codes, levels and clocks are tried.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from benchmarks.dome_identify import attitude
from benchmarks.timing import verdict
from estimator.attitude.dome_map import project
from estimator.core.types import Attitude, Centroids
from estimator.trackers.coded_tracker import CodedTracker
from skysim.core.random_streams import random_stream
from skysim.core.types import Trajectory
from skysim.results import metrics
from skysim.scene import loader
from skysim.simulation.exposure import render_frame
from skysim.simulation.lab import MARGIN_S, Lab, build_lab, build_tracker, exposure_window
from skysim.simulation.lights.emitters import LedDome
from skysim.sources.dome.led import irradiance_e_s_m2
from skysim.tracking import factory

Ints = NDArray[np.int64]

SCENE = "coded_spiral"
ATTITUDES = 10_000
RENDERED = 50
RATES_DEG_S = (0.0, 5.0)
BORDER_PX = (
    12.0  # half of an LED's image, which the tracker drops where the border cuts it off
)


@dataclass(frozen=True)
class Noise:
    """Errors of a light, above those of rendered frames (`rendered`): pixels, and part of its brightness."""

    position_px: float = 0.2
    light: float = 0.02


@dataclass(frozen=True)
class Sequence:
    """One sequence of frames: the number of the frame with the first attitude (from 1; 0 without one), whether any
    attitude is wrong, and the least number of lights in a frame."""

    first: int
    wrong: bool
    fewest: int


class Bench:
    """The scene's dome, camera and tracker, and the light of its LEDs."""

    def __init__(self, settings: dict[str, str] | None = None) -> None:
        self.lab = build_lab(loader.load(SCENE, settings or {}))
        tracker = build_tracker(self.lab.camera)
        assert isinstance(tracker, CodedTracker)
        self.tracker = tracker
        self.noise = Noise()

    def sequence(
        self,
        rate_deg_s: float,
        seed: int,
        frames: int | None = None,
        all_frames: bool = False,
    ) -> Sequence:
        """Follow the lights over a code's length of frames from a random attitude; ends with the first attitude."""
        rng = random_stream(seed)
        frame_s = 1 / self.lab.scene.exposure.rate_hz
        lab = self.lab.in_run(seed)
        start = attitude(rng)
        axis = rng.standard_normal(3)
        turn_rad_s = np.radians(rate_deg_s) * axis / np.linalg.norm(axis)
        begin = int(rng.integers(0, 1000))
        first = 0
        wrong = False
        fewest = 99
        self.tracker.last_s = None
        for n in range(frames or self.tracker.code.bits):
            body_from_lab = Rotation.from_rotvec(turn_rad_s * n * frame_s) * start
            centroids, name = self.centroids(lab, body_from_lab, begin + n, rng)
            fewest = min(fewest, len(name))
            solved = self.tracker.solve_centroids(
                centroids,
                exposure_s=lab.scene.exposure.time_s,
                t_s=(begin + n) * frame_s,
                frame=begin + n,
            )
            if solved.solved:
                first = first or n + 1
                wrong |= is_wrong(
                    solved, self.tracker.lever.cam_from_body * body_from_lab, name
                )
                if not all_frames:
                    break
        return Sequence(first, wrong, fewest)

    def rendered(self, rate_deg_s: float, seed: int, frames: int) -> Sequence:
        """As `sequence`, in rendered frames, of which all are solved."""
        rng = random_stream(seed)
        scene = self.lab.scene
        start = attitude(rng)
        axis = rng.standard_normal(3)
        begin = int(rng.integers(0, 1000))
        turn_rad_s = np.radians(rate_deg_s) * axis / np.linalg.norm(axis)
        last = begin + frames
        t_s = np.array([exposure_window(scene, n).open_s - MARGIN_S for n in (begin, last)])
        body_from_lab = Rotation.from_rotvec(turn_rad_s * (t_s - t_s[0])[:, None]) * start
        trajectory = Trajectory(t_s, body_from_lab.inv(), np.tile(-turn_rad_s, (2, 1)))
        camera = self.lab.in_run(seed).camera
        first = 0
        wrong = False
        fewest = 99
        self.tracker.last_s = None
        for n in range(begin, last):
            frame, truth = render_frame(camera, trajectory, n)
            report = factory.solve_frame(self.tracker, frame)
            fewest = min(fewest, len(report.centroids))
            if report.attitude.solved:
                first = first or n - begin + 1
                apart = np.linalg.norm(
                    report.centroids.xy_px[:, None] - truth.sources.flux_xy_px, axis=2
                )
                wrong |= is_wrong(
                    report.attitude,
                    truth.cam_from_lab,
                    truth.sources.id[apart.argmin(axis=1)],
                )
        return Sequence(first, wrong, fewest)

    def centroids(
        self, lab: Lab, body_from_lab: Rotation, frame: int, rng: np.random.Generator
    ) -> tuple[Centroids, Ints]:
        """The lights of a frame, brightest first, and the LED of each."""
        sources = lab.camera.sources
        scene = lab.scene
        camera = self.tracker.camera
        xy_px = project(body_from_lab, sources.place[:, :3], self.tracker.lever, camera)
        seen = np.flatnonzero(camera.contains(np.nan_to_num(xy_px, nan=-1e9), BORDER_PX))
        dome = lab.camera.known
        assert isinstance(dome, LedDome)
        codes = dome.timing(lab.camera.run_seed).codes
        assert codes is not None
        middle_s = frame / scene.exposure.rate_hz
        shown = codes.shown(
            sources, middle_s - scene.exposure.time_s / 2, scene.exposure.time_s, frame
        )
        offset_m = sources.place[seen, :3] - body_from_lab.inv().apply(
            self.tracker.lever.camera_body_m
        )
        distance_m = np.linalg.norm(offset_m, axis=1)
        cos_out = -np.sum(offset_m * sources.normal[seen], axis=1) / distance_m
        cos_in = self.tracker.camera.rays(xy_px[seen])[:, 2]
        light = irradiance_e_s_m2(
            shown.strength[seen], dome.emitter, cos_out, cos_in, distance_m
        )
        light_e = light * lab.camera.optics.collecting_m2 * scene.exposure.time_s
        light_e = light_e * (1 + self.noise.light * rng.standard_normal(len(seen)))
        light_e += np.sqrt(np.maximum(light_e, 0)) * rng.standard_normal(len(seen))
        order = np.argsort(-light_e)
        order = order[light_e[order] > MIN_LIGHT_E]
        measured_px = xy_px[seen] + self.noise.position_px * rng.standard_normal(
            (len(seen), 2)
        )
        sigma_px = np.full(len(order), self.noise.position_px)
        flux = light_e[order] / scene.camera.detector.gain_e_dn
        return Centroids(measured_px[order], sigma_px, flux), seen[order]


MIN_LIGHT_E = 5000.0  # of a light that is detected


def is_wrong(solved: Attitude, cam_from_lab: Rotation, name: Ints) -> bool:
    """Whether an attitude is worse than none, or any light has another LED's name."""
    assert solved.cam_from_ref is not None
    assert solved.match is not None
    assert solved.covariance_rad2 is not None
    error_rad = float((solved.cam_from_ref * cam_from_lab.inv()).magnitude())
    nees = metrics.normalized_error_squared(
        solved.cam_from_ref, cam_from_lab, solved.covariance_rad2
    )
    return metrics.is_wrong(error_rad, nees) or bool(
        np.any(name[solved.match.observed] != solved.match.star)
    )


# Other codes than the scene's, failing bits, and clocks of their own: a bit of 20 ms is one frame.
VARIANTS = {
    "BCH, 4 levels": {"light.led.code": "{kind: bch, distance: 5, depth: 0.75, levels: 4}"},
    "De Bruijn": {"light.led.code": "{kind: de_bruijn}"},
    "De Bruijn, 4 levels": {"light.led.code": "{kind: de_bruijn, depth: 0.75, levels: 4}"},
    "on and off": {"light.led.code.depth": "1"},
    "2 % of the bits fail": {"light.led.code.dropout": "0.02"},
    "free-running": {"light.led.code": "{kind: cyclic, bit_time: 20 ms}"},
    "free-running, 2,000 ppm fast": {
        "light.led.code": "{kind: cyclic, bit_time: 20 ms}",
        "light.led.clock": "{offset_ppm: 2000}",
    },
}
MOST_FRAMES = 40  # of a variant's sequence: a De Bruijn word is much longer


def measure(count: int = ATTITUDES) -> list[dict[str, Any]]:
    """`count` attitudes from centroids, RENDERED of a full run from frames, and a twentieth for each variant."""
    rendered = max(round(count * RENDERED / ATTITUDES), 2)
    rows = identified("centroids", count) + identified("rendered", rendered)
    for name, settings in VARIANTS.items():
        rows += identified("centroids", max(count // 20, 2), name, settings)
    return rows


def identified(
    kind: str, attitudes: int, variant: str = "", settings: dict[str, str] | None = None
) -> list[dict[str, Any]]:
    """Attitudes found within the code's length of frames, and wrong ones, at rest and turning."""
    bench = Bench(settings)
    rows = list[dict[str, Any]]()
    one = bench.rendered if kind == "rendered" else bench.sequence
    for rate_deg_s in RATES_DEG_S:
        bits = min(bench.tracker.code.bits, MOST_FRAMES)
        results = [one(rate_deg_s, seed, bits) for seed in range(attitudes)]
        found = 100 * float(np.mean([result.first > 0 for result in results]))
        name = f"spiral of 400, {variant or kind}, {rate_deg_s:g} deg/s"
        wrong = sum(result.wrong for result in results)
        rows += [
            verdict(
                f"{name}: attitude within {bits} frames",
                found,
                "%",
                f"{attitudes} attitudes",
                99.9,
                least=True,
            ),
            verdict(f"{name}: wrong", wrong, "attitudes", f"{attitudes} attitudes", 0),
        ]
    return rows
