"""A scene's flight: its motion and all its frames, computed piece by piece and kept for playback."""

from __future__ import annotations

import math
import tempfile
import time
from collections.abc import Iterator
from dataclasses import dataclass, replace

import numpy as np

from estimator.trackers.pipeline import Report
from skysim.apps.gui.messages import NAN, FlightStep, FrameRow, FrameView, MotionLog, Phase
from skysim.apps.gui.worker import pixels
from skysim.apps.gui.worker.workbench import Workbench, tracker_result
from skysim.core import quaternion
from skysim.core.constants import ARCSEC_RAD
from skysim.core.types import Frame, Telemetry
from skysim.results import telemetry_report
from skysim.simulation import exposure, run
from skysim.simulation.lab import Lab, build_tracker
from skysim.simulation.run import FrameResult
from skysim.simulation.timing import exposure_window

MAX_POINTS = 500  # of a curve on the page, roughly
FLOOR = 1e-3  # arcsec; lower limit of values on a logarithmic axis
KEPT_BYTES = 2**28  # of frames in the file, beyond which they are rendered again when they are shown


@dataclass
class KeptFrame:
    """A frame of a flight without its pixels.

    place : of these in the file, and their number of bytes; None: they are rendered again, bit for bit
    """

    view: FrameView
    report: Report
    place: tuple[int, int] | None


class Flight:
    """A flight of a workbench's scene. Frames are those of `skysim run`.

    Its computation is a series of short steps, so that the worker does other tasks between them.

    file : pixels of the first frames, so that playing them costs no rendering;  shown : number of the shown frame
    moved : the lab after the simulation of its motion, None before;  told : number of frames reported by `advance`
    """

    def __init__(self, bench: Workbench) -> None:
        self.bench, self.frames, self.file = bench, list[KeptFrame](), tempfile.TemporaryFile()  # noqa: SIM115
        self.moved: Lab | None = None
        self.shown: int | None = None
        self.told, self.told_log = 0, False
        self.progress = (0.0, 1.0)
        self.steps = self.compute()

    def compute(self) -> Iterator[tuple[float, float]]:
        """Simulate the motion, then render and solve every frame; yields (done, total) of either."""
        self.moved = yield from run.motion_steps(self.bench.lab)
        count = self.moved.scene.exposure.frames
        yield 0, count
        tracker = build_tracker(self.moved)
        for result in run.run(self.moved, tracker):
            solved = tracker_result(self.moved, tracker, result)
            view = self.bench.frame_view(result.frame, result.truth, solved, sum(result.seconds.values()))
            t_s = exposure_window(self.moved.scene, result.frame.index, result.frame.exposure_s).open_s
            error, innovation = filter_errors(self.moved, result, t_s)
            view = replace(view, t_s=t_s, filter_arcsec=error, innovation_arcsec=innovation)
            self.frames.append(KeptFrame(view, result.report, self.keep(result.frame)))
            yield len(self.frames), count

    def advance(self, budget_s: float) -> FlightStep:
        """Compute for about a time, and report what is new."""
        end_s, is_done = time.perf_counter() + budget_s, False
        while not is_done and time.perf_counter() < end_s:
            progress = next(self.steps, None)
            is_done, self.progress = progress is None, progress or self.progress
        views = [frame.view for frame in self.frames[self.told :]]
        rows, residuals = tuple(map(frame_row, views)), tuple(row for view in views for row in light_residuals(view))
        self.told, log = len(self.frames), None
        if self.moved and not self.told_log:
            self.told_log, log = True, curves(self.moved.log)
        phase: Phase = "done" if is_done else "frames" if self.moved else "motion"
        return FlightStep(phase, *self.progress, rows, log, residuals)

    def keep(self, frame: Frame) -> tuple[int, int] | None:
        """Write a frame's pixels to the end of the file, and return their place there; None if the file is full."""
        data, begin = pixels.levels_of(frame.image_dn).data(), self.file.seek(0, 2)
        if begin + len(data) > KEPT_BYTES:
            return None
        self.file.write(data)
        return begin, len(data)

    def show(self, index: int) -> tuple[FrameView, pixels.Levels]:
        """The view of a kept frame and its pixels; the scene is seen from there from now on."""
        kept, bench = self.frames[index], self.bench
        self.shown, bench.frame = index, None
        bench.lab_from_body = quaternion.to_rotation(np.array(kept.view.body_wxyz))
        if kept.place is None:
            self.render()
            assert bench.frame is not None
            return kept.view, pixels.levels_of(bench.frame.image_dn)
        self.file.seek(kept.place[0])
        return kept.view, pixels.levels_from(self.file.read(kept.place[1]), kept.view.size_px)

    def render(self) -> None:
        """Render the shown frame with its truth, unless another frame of the scene has been rendered since."""
        if self.shown is None or self.bench.frame is not None:
            return
        assert self.moved is not None
        kept, bench = self.frames[self.shown], self.bench
        bench.frame, bench.truth = exposure.render_frame(self.moved, self.shown, exposure_s=kept.view.exposure_s)
        bench.report = kept.report


def frame_row(view: FrameView) -> FrameRow:
    """A frame of a flight in numbers."""
    result = view.result
    if result is None:
        return FrameRow(view.t_s, NAN, NAN, NAN, NAN, len(view.lights), 0, view.filter_arcsec, view.innovation_arcsec)
    cross_sigma, roll_sigma = result.sigma_arcsec
    errors = result.cross_arcsec, cross_sigma, result.roll_arcsec, roll_sigma
    counts = len(view.lights), result.identified
    return FrameRow(view.t_s, *errors, *counts, view.filter_arcsec, view.innovation_arcsec)


def light_residuals(view: FrameView) -> Iterator[tuple[float, int, float]]:
    """Time, number and residual in pixels of every light that is identified in a frame."""
    for spot in view.result.detections if view.result else ():
        if spot.id >= 0 and math.isfinite(spot.residual_px):
            yield view.t_s, spot.id, spot.residual_px


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


def filter_errors(moved: Lab, result: FrameResult, t_s: float) -> tuple[float, float]:
    """Error of the filter, and angle between the star tracker's attitude and the filter's, arcsec; NaN if none."""
    log = moved.log
    if log.lab_from_filter is None:
        return math.nan, math.nan
    n = min(int(np.searchsorted(log.t_s, t_s)), len(log.t_s) - 1)
    error_arcsec = float((log.lab_from_filter[n].inv() * log.lab_from_body[n]).magnitude()) / ARCSEC_RAD
    cam_from_lab = result.report.attitude.cam_from_ref
    if cam_from_lab is None:
        return error_arcsec, math.nan
    lab_from_body = cam_from_lab.inv() * moved.mount.cam_from_body
    return error_arcsec, float((lab_from_body.inv() * log.lab_from_filter[n]).magnitude()) / ARCSEC_RAD
