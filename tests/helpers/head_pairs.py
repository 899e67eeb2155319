"""Pairs of frames of two star cameras at a right angle: the roll alone and fused, against their covariances.

Each pair of frames of the scene `two_heads`, with exact mounts, is rendered at a random attitude with noise of its own,
and fused by the attitude filter from an unknown start.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from scipy.spatial.transform import Rotation

from estimator.core.types import Attitude
from estimator.filter.error_models import GyroModel
from estimator.filter.mekf import AttitudeFilter
from skysim.results.metrics import normalized_error_squared
from skysim.scene.loader import load_scene
from skysim.simulation.exposure import render_at_rest
from skysim.simulation.lab import Lab, build_lab, build_tracker
from skysim.tracking.factory import solve_frame

NO_GYRO = GyroModel(1e-5, 0.0, np.inf)
EXACT = {
    "heads.0.mount_error_arcsec": [0, 0, 0],
    "heads.0.mount_arcsec_k": [0, 0, 0],
    "thermal": None,
    "exposure.frames": 1,
    "motion.maneuver": [{"kind": "hold", "duration": "1 s"}],
}


class Pair(NamedTuple):
    """One pair of frames: errors of the roll about the main boresight and their claimed variances, rad and rad^2.

    nees : of the fused attitude
    """

    alone_rad: float
    fused_rad: float
    alone_rad2: float
    fused_rad2: float
    nees: float


class Gain(NamedTuple):
    """By what factor the second camera lowers the roll, and by what factor it should; the NEES of both together."""

    pairs: int
    factor: float
    predicted: float
    nees: float


def fused(lab: Lab, solutions: list[Attitude]) -> tuple[Rotation, np.ndarray]:
    """body_from_ref and its covariance (3, 3) in body axes from one solution of each camera."""
    start = lab.camera.mount.body_from_cam * solutions[0].cam_from_ref
    mekf = AttitudeFilter(NO_GYRO, 0.0, start, 0.1, 0.0, considered=(), heads=len(solutions))
    for head, (camera, solution) in enumerate(zip(lab.cameras, solutions, strict=True)):
        body_from_cam = camera.mount.body_from_cam
        R = body_from_cam.as_matrix()
        mekf.update(
            0.0,
            body_from_cam * solution.cam_from_ref,
            R @ solution.covariance_rad2 @ R.T,
            head=head,
        )
    return mekf.state.body_from_ref, mekf.state.covariance[:3, :3]


def measured_pairs(count: int, seed: int) -> list[Pair]:
    """Pairs at random attitudes; those that one of the trackers refuses are left out."""
    rng = np.random.default_rng(seed)
    lab = build_lab(load_scene("two_heads", EXACT))
    pairs = list[Pair]()
    trackers = [build_tracker(camera) for camera in lab.cameras]
    main = lab.camera.mount.cam_from_body
    R = lab.camera.mount.cam_from_body.as_matrix()
    for _ in range(count):
        lab_from_body = Rotation.random(random_state=rng)
        cameras = lab.in_run(int(rng.integers(2**31))).cameras
        frames = [render_at_rest(camera, lab_from_body)[0] for camera in cameras]
        solutions = [
            solve_frame(tracker, frame).attitude
            for tracker, frame in zip(trackers, frames, strict=True)
        ]
        if not all(solution.solved for solution in solutions):
            continue
        estimate, covariance = fused(lab, solutions)
        errors = main.inv() * solutions[0].cam_from_ref, estimate
        roll = [main.apply((attitude * lab_from_body).as_rotvec())[2] for attitude in errors]
        claimed = solutions[0].covariance_rad2[2, 2], (R @ covariance @ R.T)[2, 2]
        nees = normalized_error_squared(estimate, lab_from_body.inv(), covariance)
        pairs.append(Pair(*roll, *claimed, nees))
    return pairs


def gain(pairs: list[Pair]) -> Gain:
    """Factor and NEES of the pairs.

    The predicted factor is the median of sqrt(alone_rad2 / fused_rad2). Fields with few stars are worse by far than
    others, so each error is divided by its own claim, and the measured factor is the predicted one times the ratio of
    the rms of these: 1 if both claims are true.
    """
    alone, combined, alone2, combined2, nees = np.array(pairs).T
    predicted = np.sqrt(np.median(alone2 / combined2))
    scale = np.sqrt(np.mean(alone**2 / alone2) / np.mean(combined**2 / combined2))
    return Gain(len(pairs), float(scale * predicted), float(predicted), float(nees.mean()))
