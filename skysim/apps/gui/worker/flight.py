"""Playback of a simulated motion: renders a frame at any time of it, solved on request."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np

from skysim.apps.gui.messages import FlightLog, FrameView
from skysim.apps.gui.worker.workbench import Workbench
from skysim.core.types import Floats, Telemetry
from skysim.core.units import ARCSEC_RAD
from skysim.results import telemetry_report
from skysim.simulation import run, testbed
from skysim.simulation.testbed import SPARE_S, Testbed

MOST_POINTS = 500  # of a curve on the page, roughly
FLOOR = 1e-3  # arcsec; lower limit of values on a logarithmic axis


@dataclass(frozen=True, slots=True)
class Flown:
    """A testbed after the simulation of its motion, and its telemetry."""

    lab: Testbed
    log: Telemetry

    @classmethod
    def of(cls, desk: Workbench, watch: Callable[[float, float], None]) -> Flown:
        """Simulate the motion of the workbench's scene. watch : progress(done, total)"""
        lab = run.simulate_motion(desk.lab, watch)
        return cls(lab, lab.log)

    @property
    def curves(self) -> FlightLog:
        """Curves of true and estimated attitude errors (arcsec), momentum (N m s) and rate (deg/s), decimated."""
        log, every = self.log, max(len(self.log.t_s) // MOST_POINTS, 1)
        off = {
            "off what was asked": log.lab_from_ref,
            "IMU alone": log.lab_from_imu,
            "filter": log.lab_from_filter,
        }
        found = {
            name: arcsec(telemetry_report.off_deg(believed, log.lab_from_body))
            for name, believed in off.items()
            if believed is not None
        }
        found["momentum"] = np.linalg.norm(log.momentum_nms, axis=1)
        found["rate"] = np.degrees(np.linalg.norm(log.rate_body_rad_s, axis=1))
        scene = self.lab.scene
        frames = [scene.exposure.first_s + n / scene.exposure.rate_hz for n in range(scene.exposure.frames)]
        thinned = {name: tuple(values[::every].tolist()) for name, values in found.items()}
        return FlightLog(tuple(log.t_s[::every].tolist()), thinned, tuple(frames))

    def at(self, desk: Workbench, t_s: float, solve: bool) -> FrameView:
        """Render the frame whose exposure begins at t_s, limited so that it ends within the motion.

        The noise seed depends on the time, so that the same time always gives the same frame.
        """
        scene = self.lab.scene
        last_s = float(self.lab.trajectory.t_s[-1]) - SPARE_S
        when = testbed.window(scene, 0)
        long_s = when.close_s(scene.camera.height_px) - when.open_s
        begin_s = min(max(t_s, 0.0), last_s - long_s)
        exposure = scene.exposure.model_copy(update={"first_s": begin_s})
        # The start time in units of 0.1 ms is part of the seed.
        seed = scene.seed + 1 + round(begin_s * 1e4)
        here = replace(self.lab, scene=scene.model_copy(update={"exposure": exposure, "seed": seed}))
        desk.lab_from_body = self.lab.trajectory.at(begin_s)
        view = desk.shown(here, solve)
        believed, innovation = self.filter_at(desk, begin_s)
        return replace(view, t_s=begin_s, filter_arcsec=believed, innovation_arcsec=innovation)

    def filter_at(self, desk: Workbench, t_s: float) -> tuple[float, float]:
        """Error of the filter, and angle between the star tracker's attitude and the filter's, arcsec; NaN if none."""
        believed = self.log.lab_from_filter
        if believed is None:
            return math.nan, math.nan
        n = min(int(np.searchsorted(self.log.t_s, t_s)), len(self.log.t_s) - 1)
        off = float((believed[n].inv() * self.log.lab_from_body[n]).magnitude()) / ARCSEC_RAD
        told = desk.report.attitude.cam_from_ref if desk.report else None
        if told is None:
            return off, math.nan
        lab_from_body = told.inv() * self.lab.mount.cam_from_body
        return off, float((lab_from_body.inv() * believed[n]).magnitude()) / ARCSEC_RAD


def arcsec(degrees: Floats | None) -> Floats:
    """Degrees to arc-seconds, at least FLOOR, for a logarithmic axis."""
    assert degrees is not None
    return np.maximum(3600 * degrees, FLOOR)
