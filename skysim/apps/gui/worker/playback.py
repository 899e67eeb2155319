"""Playback of a simulated motion: renders a frame at any time of it, solved on request."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np

from skysim.apps.gui.messages import FrameView, MotionLog
from skysim.apps.gui.worker.workbench import Workbench
from skysim.core.quantities.units import ARCSEC_RAD
from skysim.core.types import Telemetry
from skysim.results import telemetry_report
from skysim.simulation.testbed import MARGIN_S, Testbed, exposure_window

MAX_POINTS = 500  # of a curve on the page, roughly
FLOOR = 1e-3  # arcsec; lower limit of values on a logarithmic axis


def curves(log: Telemetry) -> MotionLog:
    """Curves of true and estimated attitude errors (arcsec), momentum (N m s) and rate (deg/s), decimated."""
    attitudes = {"pointing": log.lab_from_ref, "IMU alone": log.lab_from_imu, "filter": log.lab_from_filter}
    values = {
        name: np.maximum(3600 * error_deg, FLOOR)
        for name, attitude in attitudes.items()
        if (error_deg := telemetry_report.attitude_error_deg(attitude, log.lab_from_body)) is not None
    }
    values["momentum"] = np.linalg.norm(log.momentum_nms, axis=1)
    values["rate"] = np.degrees(np.linalg.norm(log.rate_body_rad_s, axis=1))
    every = max(len(log.t_s) // MAX_POINTS, 1)
    thinned = {name: tuple(curve[::every].tolist()) for name, curve in values.items()}
    return MotionLog(tuple(log.t_s[::every].tolist()), thinned)


def render_at(workbench: Workbench, moved: Testbed, t_s: float, solve: bool) -> FrameView:
    """Render the frame whose exposure begins at t_s, limited so that it ends within the motion.

    moved : the workbench's testbed after the simulation of its motion

    The noise seed depends on the time, so that the same time always gives the same frame.
    """
    scene = moved.scene
    last_s = float(moved.trajectory.t_s[-1]) - MARGIN_S - scene.exposure.trigger_jitter_s
    window = exposure_window(scene, 0)
    duration_s = window.close_s(scene.camera.height_px) - window.open_s
    begin_s = min(max(t_s, 0.0), last_s - duration_s)
    exposure = scene.exposure.model_copy(update={"first_s": begin_s})
    # The start time in units of 0.1 ms is part of the seed.
    testbed = moved.in_run(scene.seed + 1 + round(begin_s * 1e4))
    workbench.lab_from_body = moved.trajectory.attitude_at(begin_s)
    view = workbench.render(replace(testbed, scene=testbed.scene.model_copy(update={"exposure": exposure})), solve)
    filter_error, innovation = filter_errors(workbench, moved, begin_s)
    return replace(view, t_s=begin_s, filter_arcsec=filter_error, innovation_arcsec=innovation)


def filter_errors(workbench: Workbench, moved: Testbed, t_s: float) -> tuple[float, float]:
    """Error of the filter, and angle between the star tracker's attitude and the filter's, arcsec; NaN if none."""
    log = moved.log
    if log.lab_from_filter is None:
        return math.nan, math.nan
    n = min(int(np.searchsorted(log.t_s, t_s)), len(log.t_s) - 1)
    error_arcsec = float((log.lab_from_filter[n].inv() * log.lab_from_body[n]).magnitude()) / ARCSEC_RAD
    cam_from_lab = workbench.report.attitude.cam_from_ref if workbench.report else None
    if cam_from_lab is None:
        return error_arcsec, math.nan
    lab_from_body = cam_from_lab.inv() * moved.mount.cam_from_body
    return error_arcsec, float((lab_from_body.inv() * log.lab_from_filter[n]).magnitude()) / ARCSEC_RAD
