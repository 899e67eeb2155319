"""Detections of a trial without a frame: the lights in view with noise, and a sequence of them under coded light.

Under coded light (`tracker.decoder`) a trial has as many frames of one attitude as the code has bits, or fewer: it ends
with the first frame that the tracker solves. Its result is that of its last frame. A light's brightness in a frame
follows from its code and from its drive's pulses in the exposure, with photon noise and FLUX_NOISE.
"""

import itertools
from dataclasses import replace
from typing import NamedTuple

import numpy as np
from numpy.random import Generator
from scipy.spatial.transform import Rotation

from estimator.core.types import Centroids
from estimator.trackers.coded_tracker import CodedTracker
from estimator.trackers.pipeline import Report
from skysim.camera.projection import Poses, in_view, project_each, rates_e_s
from skysim.camera.render import Window
from skysim.core.constants import ARCSEC_RAD
from skysim.core.types import Floats, Ints, Trajectory, homogeneous, lengths, taken
from skysim.experiments.study.plan import CentroidTrial
from skysim.scene.scene import Scene
from skysim.simulation.exposure import exposure_of
from skysim.simulation.lab import MARGIN_S, Lab, exposure_window
from skysim.simulation.lights.effects import AirEffects
from skysim.simulation.lights.emitters import LedDome
from skysim.simulation.lights.light import Obstacle, any_of, find_light
from skysim.sources.dome.led import lit_moments_s

LEAST_SIGMA_PX = 1e-3
# Relative noise of a light's brightness in a frame; more than in rendered frames (benchmarks/codes_attitudes.py).
FLUX_NOISE = 0.02


class VisibleSources(NamedTuple):
    """The visible sources whose center is on the detector at one attitude, without occluded ones.

    Attributes
    ----------
    rows
        (N,) rows of the sources in `lab.camera.sources`
    xy_px
        (N, 2) pixel positions
    electrons
        (N,) photo-electrons of an exposure
    """

    rows: Ints
    xy_px: Floats
    electrons: Floats


def visible_rows(lab: Lab, lab_from_body: Rotation) -> list[VisibleSources]:
    """The view at each of B attitudes, all at the scene's start. The sources near all fields are projected at once."""
    camera = lab.camera
    optics = camera.optics
    R_cam_from_body = camera.mount.cam_from_body.as_matrix()
    R_lab_from_body = lab_from_body.as_matrix()
    poses = Poses(
        np.array([R_cam_from_body @ each.T for each in R_lab_from_body]),
        np.array([each @ camera.mount.camera_body_m for each in R_lab_from_body]),
    )
    rows = [
        in_view(camera.sources, optics, taken(poses, [n]), reach=0.0)
        for n in range(len(R_lab_from_body))
    ]
    ends = np.cumsum([0, *map(len, rows)])
    near = camera.sources.take(np.concatenate(rows))
    atmosphere = find_light(camera.lights, AirEffects)
    if atmosphere:
        near = atmosphere.air.at(lab.scene.start_time).points_seen(near)
    xy_px, distance_m, cos_out, cos_in = project_each(near, optics, poses, ends)
    rate_e_s = rates_e_s(near, optics, camera.known.emitter, distance_m, cos_out, cos_in)
    electrons = rate_e_s * near.duty * lab.scene.exposure.time_s
    size_px = np.array(camera.canvas.shape[::-1])
    visible = np.all((xy_px > -0.5) & (xy_px < size_px - 0.5), axis=1)
    at_rest = Trajectory.at_rest(lab.start, MARGIN_S)
    start = exposure_of(camera, at_rest, 0, Window(0.0, 0.0), None)
    obstacles = [light for light in camera.lights if isinstance(light, Obstacle)]
    views = []
    for n, (begin, end) in enumerate(itertools.pairwise(ends.tolist())):
        chosen = begin + np.flatnonzero(visible[begin:end])
        exposure = replace(start, lab_from_body=lab_from_body[n])
        tests = [light.during(exposure).hides for light in obstacles]
        if occludes := any_of([hides for hides in tests if hides]):
            chosen = chosen[~occludes(near.place[chosen])]
        views.append(
            VisibleSources(rows[n][chosen - begin], xy_px[chosen], electrons[chosen])
        )
    return views


def simulate_detections(
    trial: CentroidTrial,
    xy_px: Floats,
    electrons: Floats,
    scene: Scene,
    rng: Generator,
) -> Centroids:
    """Simulated detections, brightest first: some true sources missed, all with noise, false detections added.

    The stated error of each is the true one, or LEAST_SIGMA_PX without noise: a tracker takes no detection without an
    error. The flux of a false detection is that of a random true source, detected or missed.
    """
    # Draw noise for all sources, also the missing ones, so that the stream does not depend on which are missing.
    sigma_px = trial.noise_px
    if trial.noise_arcsec is not None:
        sigma_px = trial.noise_arcsec * ARCSEC_RAD * scene.camera.focal_px
    sigma_px = max(sigma_px, LEAST_SIGMA_PX)
    detected = np.flatnonzero(rng.random(len(xy_px)) >= trial.missing)
    flux = electrons / scene.camera.detector.gain_e_dn
    flux = flux * 10 ** (0.4 * trial.magnitude_sigma * rng.standard_normal(len(xy_px)))
    if trial.noise_arcsec is None:
        xy_px = xy_px + trial.noise_px * rng.standard_normal(xy_px.shape)
    else:
        xy_px = with_direction_noise(xy_px, trial.noise_arcsec * ARCSEC_RAD, scene, rng)
    detected = detected[np.argsort(-flux[detected], kind="stable")][: trial.lights]
    false = trial.false_lights + round(
        len(detected) * trial.false_share / (1 - trial.false_share)
    )
    false_px = rng.random((false, 2)) * scene.camera.size_px - 0.5
    if len(flux):
        false_flux = flux[rng.integers(len(flux), size=false)]
    else:
        false_flux = rng.random(false) + 1.0
    all_flux = np.concatenate([flux[detected], false_flux])
    order = np.argsort(-all_flux, kind="stable")
    all_px = np.concatenate([xy_px[detected], false_px])
    return Centroids(all_px[order], np.full(len(order), sigma_px), all_flux[order])


def with_direction_noise(
    xy_px: Floats, sigma_rad: float, scene: Scene, rng: Generator
) -> Floats:
    """(N, 2) images of directions with normal errors of every component of the unit vector.

    The error of the tangents, times the focal length, is added: it is that of an undistorted lens.
    """
    focal_px = scene.camera.focal_px
    rays = homogeneous((xy_px - scene.camera.center_px) / focal_px, 1.0)
    moved = rays + sigma_rad * lengths(rays)[:, None] * rng.standard_normal(rays.shape)
    return xy_px + focal_px * (moved[:, :2] / moved[:, 2:] - rays[:, :2])


def solve_coded(
    lab: Lab,
    tracker: CodedTracker,
    trial: CentroidTrial,
    lab_from_body: Rotation,
    rng: Generator,
) -> tuple[Floats, Report]:
    """(N, 2) true pixel positions, and the report of the first frame with an attitude, or of the code's last one."""
    lab = lab.in_run(int(rng.integers(2**62)))
    ((rows, xy_px, electrons),) = visible_rows(lab, Rotation.concatenate([lab_from_body]))
    electrons = electrons * 10 ** (
        0.4 * trial.magnitude_sigma * rng.standard_normal(len(rows))
    )
    # The error of the magnitude is the LED's, equal in all frames, so `simulate_detections` adds none.
    per_frame = trial.with_values(magnitude_sigma=0.0)
    tracker.last_s = None  # forget the frames of an earlier trial
    first = int(rng.integers(tracker.code.bits))
    for frame in range(first, first + tracker.code.bits):
        noise = 1 + FLUX_NOISE * rng.standard_normal(len(rows))
        light_e = electrons * brightness(lab, rows, frame) * noise
        light_e += np.sqrt(np.maximum(light_e, 0)) * rng.standard_normal(len(rows))
        lit = light_e > 0
        detections = simulate_detections(per_frame, xy_px[lit], light_e[lit], lab.scene, rng)
        window = exposure_window(lab.scene, frame)
        attitude = tracker.solve_centroids(
            detections, exposure_s=window.exposure_s, t_s=window.middle_s, frame=frame
        )
        if attitude.solved:
            break
    return xy_px, Report(attitude, detections)


def brightness(lab: Lab, rows: Ints, frame: int) -> Floats:
    """(K,) light of LEDs in the exposure of a frame over their mean light: the effect of codes, pulses and filters."""
    window = exposure_window(lab.scene, frame)
    steady = lab.camera.sources.take(rows)
    begin_s = window.open_s
    end_s = window.open_s + window.exposure_s
    dome = lab.camera.known
    assert isinstance(dome, LedDome)
    middle_s = (begin_s + end_s) / 2
    shown = dome.pulsed(dome.sources, lab.camera.run_seed, frame, window, middle_s).take(rows)
    pulses = np.column_stack([shown.period_s, shown.start_s, shown.on_s]).tolist()
    lit_s = np.array([lit_moments_s(begin_s, end_s, *one)[0] for one in pulses])
    mean = steady.strength * steady.duty
    return shown.strength * lit_s / window.exposure_s / mean
