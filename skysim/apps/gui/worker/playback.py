"""A scene's flight: its motion and all its frames, computed piece by piece and kept for playback."""

import math
import pickle
import tempfile
import time
from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np
from scipy.spatial.transform import Rotation

from estimator.trackers.pipeline import Report
from skysim.apps.gui.messages import Curves, FlightRow, FlightStep, FrameView, Residual
from skysim.apps.gui.worker import pixels, workbench
from skysim.core import quaternion
from skysim.core.constants import ARCSEC_RAD
from skysim.core.types import Frame, Mount, Telemetry
from skysim.results import telemetry_report
from skysim.simulation.flight import Flight, Shot

MAX_POINTS = 500  # approximate maximum number of points of a curve on the page
FLOOR = 1e-3  # arcsec; lower limit of values on a logarithmic axis
# Maximum size of the frames in the file; further frames are rendered again when they are shown.
KEPT_BYTES = 2**28


@dataclass
class KeptFrame:
    """A frame of a flight without its pixels.

    Attributes
    ----------
    place
        Place of the pixels in the file; None if they are rendered again, which gives the same
        bits
    """

    view: FrameView
    report: Report
    place: int | None


class Playback:
    """A flight of a workbench's scene. Its frames are those of `skysim run`.

    Its computation is a series of short steps, so that the worker does other tasks between them.

    Attributes
    ----------
    file
        Pixels of the first frames, which need not be rendered again for playback
    shown
        Number of the shown frame
    reported
        Number of frames reported by `advance`
    """

    def __init__(self, bench: workbench.Workbench) -> None:
        self.bench = bench
        self.frames = list[KeptFrame]()
        self.file = tempfile.TemporaryFile()  # noqa: SIM115
        flight = self.flight = Flight(bench.lab)
        self.shown: int | None = None
        self.reported = 0
        self.events = flight.events(
            flight.filter_schedules or flight.schedules[:1], solves=True
        )

    def advance(self, budget_s: float) -> FlightStep:
        """Compute for about budget_s, and report the progress."""
        end_s = time.perf_counter() + budget_s
        is_done = False
        while not is_done and time.perf_counter() < end_s:
            try:
                shot = next(self.events)
            except StopIteration:
                is_done = True
            else:
                if shot is not None and shot.camera is self.bench.lab.camera:
                    self.add(shot)
        new = self.frames[self.reported :]
        self.reported = len(self.frames)
        rows: list[FlightRow] = []
        drawn: Curves | None = None
        if is_done or new:
            log = self.flight.telemetry()
            rows = [frame_row(frame, log, self.bench.lab.camera.mount) for frame in new]
            drawn = curves(log)
        residuals = [one for frame in new for one in light_residuals(frame.view)]
        flight = self.flight
        return FlightStep(is_done, flight.now_s, flight.duration_s, rows, drawn, residuals)

    def add(self, shot: Shot) -> None:
        """Keep a shot, and its pixels if the file has room."""
        bench = self.bench
        assert shot.report is not None
        seconds = sum(shot.seconds.values())
        view = bench.frame_view(
            shot.frame, shot.truth, shot.report, seconds, shot.update_status
        )
        self.frames.append(KeptFrame(view, shot.report, self.keep(shot.frame)))

    def keep(self, frame: Frame) -> int | None:
        """Write a frame's pixels to the end of the file, and return their place there; None if the file is full."""
        levels = pixels.levels_of(frame.image_dn)
        place = self.file.seek(0, 2)
        if place + levels.integers.nbytes > KEPT_BYTES:
            return None
        pickle.dump(levels, self.file)
        return place

    def show(self, index: int) -> tuple[FrameView, pixels.PixelLevels]:
        """The view of a kept frame and its pixels; its attitude becomes that of the workbench."""
        kept = self.frames[index]
        bench = self.bench
        self.shown = index
        bench.frame = None
        bench.lab_from_body = quaternion.to_rotation(kept.view.body_wxyz)
        if kept.place is None:
            self.render()
            assert bench.frame is not None
            return kept.view, pixels.levels_of(bench.frame.image_dn)
        self.file.seek(kept.place)
        return kept.view, pickle.load(self.file)

    @property
    def is_shown(self) -> bool:
        """Whether the newest frame of the workbench is one of the flight."""
        return (
            self.shown is not None
            and self.frames[self.shown].view.result is self.bench.result
        )

    def render(self) -> None:
        """Render the shown frame with its truth, unless a later frame of the scene has been rendered."""
        if self.shown is None or self.bench.frame is not None:
            return
        kept = self.frames[self.shown]
        bench = self.bench
        bench.frame, bench.truth = self.flight.render(self.shown)
        bench.report = kept.report
        bench.result = kept.view.result


def frame_row(kept: KeptFrame, log: Telemetry, mount: Mount) -> FlightRow:
    """A frame of a flight in numbers, with those of the attitude filter from the flight's telemetry."""
    view = kept.view
    result = view.result
    assert result is not None  # every frame of a flight is solved
    filter_arcsec = innovation_arcsec = math.nan
    if log.lab_from_filter is not None:
        n = min(int(np.searchsorted(log.t_s, result.row.t_s)), len(log.t_s) - 1)
        lab_from_filter = log.lab_from_filter[n]
        filter_arcsec = angle_arcsec(lab_from_filter, log.lab_from_body[n])
        cam_from_lab = kept.report.attitude.cam_from_ref
        if cam_from_lab is not None:
            lab_from_body = cam_from_lab.inv() * mount.cam_from_body
            innovation_arcsec = angle_arcsec(lab_from_body, lab_from_filter)
    return FlightRow(result.row, len(view.lights), filter_arcsec, innovation_arcsec)


def light_residuals(view: FrameView) -> Iterator[Residual]:
    """The residual of every light that is identified in a frame."""
    assert view.result is not None
    for spot in view.result.detections:
        if spot.id >= 0 and math.isfinite(spot.residual_px):
            yield view.result.row.t_s, spot.id, spot.residual_px


def curves(log: Telemetry) -> Curves:
    """Curves of true and estimated attitude errors (arcsec), momentum (N m s) and rate (deg/s), decimated."""
    attitudes = {
        "pointing": log.lab_from_ref,
        "IMU alone": log.lab_from_imu,
        "filter": log.lab_from_filter,
    }
    values = {
        name: np.maximum(3600 * error_deg, FLOOR)
        for name, attitude in attitudes.items()
        if (error_deg := telemetry_report.attitude_error_deg(attitude, log.lab_from_body))
        is not None
    }
    values["t_s"] = log.t_s
    values["momentum"] = np.linalg.norm(log.momentum_nms, axis=1)
    values["rate"] = np.degrees(np.linalg.norm(log.rate_body_rad_s, axis=1))
    every = max(len(log.t_s) // MAX_POINTS, 1)
    return {name: curve[::every] for name, curve in values.items()}


def angle_arcsec(first: Rotation, second: Rotation) -> float:
    """Angle of the rotation from one attitude to another."""
    return float((first.inv() * second).magnitude()) / ARCSEC_RAD
