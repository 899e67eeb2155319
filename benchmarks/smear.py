"""Success against angular rate for SHEFEX-2: the paper's processing chain and the default one on the same frames.

The camera of scene shefex2 with 50 ms exposure, rotating about an axis
perpendicular to the boresight, at random attitudes in the southern sky, for which the paper's catalog was made. Samaan
& Theil (2011) report mostly successful identification up to 2 deg/s and rarely above 4 deg/s. Their chain: one scan of
the frame, at most 15 centroids, center of gravity, triangles and pyramids over their 2,023 stars, QUEST. The default
chain runs twice: with the streak from a gyro, and estimating the streak itself.
"""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any

import numpy as np
from scipy.spatial.transform import Rotation

from benchmarks.timing import figure
from estimator.catalog import catalog, published_catalogs
from estimator.core.errors import ImageError
from estimator.trackers.pipeline import Settings
from estimator.trackers.star_tracker import StarTracker
from skysim.core.paths import CATALOGS
from skysim.core.types import Frame, Trajectory
from skysim.results.metrics import WRONG_RAD
from skysim.scene.loader import load
from skysim.simulation.exposure import render_frame
from skysim.simulation.lab import Lab, build_lab
from skysim.tracking.onboard_model import calibration

FRAMES = 100
RATES_DEG_S = (0.0, 1.0, 2.0, 3.0, 4.0, 5.0, 6.0, 8.0)
FRAME_S = 0.1
KNOT_S = 0.5e-3

Streak = tuple[float, float] | None


def frames(
    lab: Lab, rate_deg_s: float, count: int, seed: int
) -> Iterator[tuple[Frame, Rotation, Streak]]:
    """Yield frames at random attitudes, each rotating about a random axis perpendicular to the boresight.

    Each comes with cam_from_icrs at mid-exposure and the streak vector at the image center.
    """
    for n in range(count):
        rng = np.random.default_rng([seed, n])
        middle = random_southern_attitude(rng)
        angle = rng.uniform(0, 2 * np.pi)
        rate_cam = np.radians(rate_deg_s) * np.array([np.cos(angle), np.sin(angle), 0.0])
        # Knots from 5 ms before the exposure; the attitude is `middle` at mid-exposure, 25 ms after its start.
        t_s = n * FRAME_S + np.arange(-10, 200) * KNOT_S
        rate_body = lab.camera.mount.cam_from_body.inv().apply(rate_cam)
        turned = Rotation.from_rotvec(np.outer(t_s - n * FRAME_S - 0.025, rate_body))
        lab_from_body = middle.inv() * lab.camera.mount.cam_from_body * turned
        trajectory = Trajectory(t_s, lab_from_body, np.tile(rate_body, (len(t_s), 1)))
        frame, truth = render_frame(lab.camera, trajectory, n)
        yield frame, truth.cam_from_lab, streak_of(rate_cam, lab)


def random_southern_attitude(rng: np.random.Generator) -> Rotation:
    """A random attitude whose boresight is south of the equator."""
    while True:
        cam_from_icrs = Rotation.random(rng=rng)
        if cam_from_icrs.as_matrix()[2, 2] < 0:
            return cam_from_icrs


def streak_of(rate_cam_rad_s: np.ndarray, lab: Lab) -> tuple[float, float]:
    """Streak (dx, dy) in pixels of a star on the boresight: d(x / z)/dt = -w_y, d(y / z)/dt = w_x."""
    pixels_per_rad_s = lab.scene.exposure.time_s * lab.scene.camera.focal_px
    return -rate_cam_rad_s[1] * pixels_per_rad_s, rate_cam_rad_s[0] * pixels_per_rad_s


def is_solved(
    tracker: StarTracker, frame: Frame, truth: Rotation, streak_px: Streak
) -> tuple[bool, bool]:
    """Whether a frame is solved correctly, and whether it is solved wrongly."""
    try:
        answer = tracker.solve(frame.image_dn, streak_px).attitude.cam_from_ref
    except ImageError:
        return False, False
    right = answer is not None and (answer * truth.inv()).magnitude() < WRONG_RAD
    return right, answer is not None and not right


def build_trackers(lab: Lab) -> dict[str, StarTracker]:
    """The paper's chain with its star selection, and the default chain with the paper's limiting magnitude (twice)."""
    camera = calibration(lab.scene.camera)
    scene = lab.scene
    stars = catalog.read(CATALOGS / "hipparcos_hp6.5.ecsv")
    observer = catalog.on_earth(scene.start_time)
    paper_stars = published_catalogs.chosen(stars)
    stars_default = catalog.brighter_than(stars, scene.tracker.limit_mag)
    gain = scene.camera.detector.gain_e_dn
    paper = Settings(
        detector="sequential",
        centroider="cog",
        identifier="shefex",
        solver="quest",
        max_blobs=15,
        base_stars=15,
        gain_e_dn=gain,
    )
    default = Settings(gain_e_dn=gain, centroid_sigma_px=scene.tracker.centroid_sigma_px)
    return {
        "paper": StarTracker(
            camera, paper_stars, catalog.apparent(paper_stars, observer), paper
        ),
        "default": StarTracker(
            camera, stars_default, catalog.apparent(stars_default, observer), default
        ),
        "with gyro": StarTracker(
            camera, stars_default, catalog.apparent(stars_default, observer), default
        ),
    }


def measure(count: int = FRAMES, seed: int = 1) -> list[dict[str, Any]]:
    """Solved and wrong shares of `count` frames for each rate and chain."""
    rows = []
    overrides = {
        "exposure.time": "50 ms",
        "exposure.first": "0 s",
        "exposure.frames": str(count),
    }
    lab = build_lab(load("shefex2", overrides))
    trackers = build_trackers(lab)
    for rate in RATES_DEG_S:
        score = {name: np.zeros(2, int) for name in trackers}
        for frame, truth, streak_px in frames(lab, rate, count, seed):
            for name, tracker in trackers.items():
                score[name] += is_solved(
                    tracker, frame, truth, streak_px if name == "with gyro" else None
                )
        pixels = np.radians(rate) * 0.05 * lab.scene.camera.focal_px
        what = f"smear of {pixels:.1f} px, {count} frames"
        for name, (solved, wrong) in score.items():
            case = f"{rate:g} deg/s, {name}"
            rows += [
                figure(f"{case}: solved", 100 * solved / count, "%", what),
                figure(f"{case}: wrong", 100 * wrong / count, "%", what),
            ]
    return rows
