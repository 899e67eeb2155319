"""A scene run from Python, and the result of a flight: its shots as numbers, its telemetry, files that show them."""

from __future__ import annotations

import html
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property
from pathlib import Path
from typing import TYPE_CHECKING, Any, overload

import numpy as np
from scipy.spatial.transform import Rotation

from skysim.core.errors import InputError
from skysim.core.files import make_folder, write_image, write_table
from skysim.core.types import (
    Floats,
    Frame,
    Record,
    Telemetry,
    Trajectory,
    Truth,
    frozen,
    median,
)
from skysim.dynamics import imu
from skysim.results import requirements, run_report, scoring, telemetry_report
from skysim.results.files.recording import remove_results, write_frame
from skysim.results.plots import annotate_truth
from skysim.results.report import Report
from skysim.results.scoring import FrameRow, Score, image_tag
from skysim.scene.scene import Scene, check_scene
from skysim.simulation.checks import Check, check
from skysim.simulation.exposure import render_frame
from skysim.simulation.flight import Flight, Progress, Shot, open_flight
from skysim.simulation.lab import MARGIN_S, Lab, StarCamera, build_lab, window_from
from skysim.tracking.computer_time import on_computer
from skysim.tracking.factory import NO_PROGRAMS

if TYPE_CHECKING:
    import pandas as pd
    from astropy.table import Table


# Write a run to a folder, frame by frame, so that a long run need not be kept in memory.


SHORT_S = 1.0  # the report of a single frame after a shorter motion has no plots against time


@dataclass(slots=True)
class Recorder:
    """The files of one camera. Files of an earlier run in the folder are removed first.

    Attributes
    ----------
    seconds
        Computing times of all frames, by stage
    shown
        The last solved frame, or the first if none was solved
    """

    folder: Path
    camera: StarCamera
    rows: list[FrameRow] = field(default_factory=list)
    seconds: dict[str, list[float]] = field(default_factory=dict)
    shown: Score | None = None

    def __post_init__(self) -> None:
        make_folder(self.folder)
        remove_results(self.folder)

    def add(self, score: Score) -> None:
        """Write one solved frame with its truth and add it to the tables."""
        shot = score.shot
        self.write(shot.frame, score.truth)
        self.rows.append(score.row)
        for stage, seconds in (shot.seconds | shot.solution.seconds).items():
            self.seconds.setdefault(stage, []).append(seconds)
        if self.shown is None or score.attitude.solved:
            self.shown = score

    def write(self, frame: Frame, truth: Truth, preview: bool = False) -> Path:
        """Write one frame with its truth; return the path of its FITS file.

        Parameters
        ----------
        preview
            Also write frame_NNNN.preview.png, an 8-bit image with the truth marked
        """
        write_frame(self.folder, frame, truth, self.camera.scene)
        path = self.folder / f"frame_{frame.index:04d}.fits"
        if preview:
            write_image(
                path.with_suffix(".preview.png"),
                annotate_truth(frame.image_dn, truth.sources),
            )
        return path

    def finish(
        self,
        command: str,
        log: Telemetry,
        imu_samples: imu.Increments | None,
        plan: Check,
        pictures: Sequence[Path] = (),
    ) -> tuple[Record, Report]:
        """Write tables, annotated image and report, with pictures of the laboratory.

        Returns the report, and before it what `skysim run --json` prints.
        """
        scene = self.camera.scene
        write_table(self.folder / "solutions.ecsv", scoring.table(self.rows, scene))
        write_table(self.folder / "telemetry.ecsv", telemetry_report.table(log))
        if imu_samples:
            write_table(self.folder / "imu.ecsv", telemetry_report.imu_table(imu_samples))
        assert self.shown is not None
        annotated = self.shown.annotated()
        write_image(self.folder / "annotated.png", annotated)
        stages_ms = {stage: 1e3 * median(seconds) for stage, seconds in self.seconds.items()}
        computer = scene.tracker.computer
        has_plot = len(self.rows) > 1 or log.t_s[-1] > SHORT_S
        flight = telemetry_report.figure(log) if has_plot else b""
        motion = telemetry_report.summary(log)
        flown = telemetry_report.findings(log)
        judged = requirements.of_run(scene.require, self.rows, plan.facts)
        report = run_report.run_report(
            scene,
            plan,
            command,
            self.rows,
            stages_ms=stages_ms,
            annotated=annotated,
            motion=run_report.motion_section(motion, flown, flight),
            views=pictures,
            judged=judged,
        )
        page = report.save(self.folder / "report.html")
        statistics = run_report.summary(self.rows) | {
            "stages_ms": stages_ms,
            **({"computer_ms": on_computer(computer, stages_ms)} if computer else {}),
            "report": str(page),
            "flight": motion,
            "pictures": [str(path) for path in pictures],
            "exposures_ms": [1e3 * row.exposure_s for row in self.rows],
            "findings": plan.findings,
            "flight_findings": flown,
            **({"requirements": [one._asdict() for one in judged]} if judged else {}),
        }
        return statistics, report


@frozen
class Run(Sequence[Score]):
    """The result of one camera in a flight: a sequence of scored shots.

    Attributes
    ----------
    camera
        The lab's camera that took them
    scores
        One entry per frame, in order; empty if the frames were written and not kept
    telemetry
        Motion of the vehicle, and measurements and commands of its computer, sampled at the
        control rate
    imu_samples
        Every sample of the IMU; None without one
    heads
        The runs of the scene's further star cameras, by name
    given
        Further arguments of `skysim.simulate` in Python, by name
    """

    lab: Lab
    camera: StarCamera
    scores: tuple[Score, ...] = field(repr=False)
    telemetry: Telemetry = field(repr=False)
    imu_samples: imu.Increments | None = field(repr=False, default=None)
    heads: dict[str, Run] = field(repr=False, default_factory=dict)
    given: Mapping[str, str] = field(repr=False, default_factory=dict)

    @property
    def scene(self) -> Scene:
        """The scene that was run, as this camera sees it."""
        return self.camera.scene

    @property
    def rows(self) -> list[FrameRow]:
        """One row of numbers per frame."""
        return [score.row for score in self.scores]

    def __len__(self) -> int:
        return len(self.scores)

    @overload
    def __getitem__(self, index: int) -> Score: ...
    @overload
    def __getitem__(self, index: slice) -> Sequence[Score]: ...
    def __getitem__(self, index: int | slice) -> Score | Sequence[Score]:
        return self.scores[index]

    def check(self) -> Check:
        """The check of the plan, of this camera alone if it is a head."""
        number = [camera.name for camera in self.lab.cameras].index(self.camera.name)
        return check(self.lab.of_camera(number) if number else self.lab)

    def table(self) -> Table:
        """One row per frame, as in `solutions.ecsv`: angles in degrees, errors in arcseconds."""
        return scoring.table(self.rows, self.scene)

    def to_pandas(self) -> pd.DataFrame:
        """`table` as a data frame; needs pandas."""
        return self.table().to_pandas()

    def save(self, folder: str | Path) -> Path:
        """Write the same files as `skysim run`: frames with truth, tables and report.html. Returns the folder.

        The files of a further star camera are in a folder with its name.
        """
        recorder = Recorder(Path(folder), self.camera)
        for score in self.scores:
            recorder.add(score)
        given = "".join(f", {name}={text}" for name, text in self.given.items())
        command = f"skysim.simulate({self.lab.scene.call or self.scene.name}{given})"
        recorder.finish(command, self.telemetry, self.imu_samples, self.check())
        for name, run in self.heads.items():
            run.save(recorder.folder / name)
        return recorder.folder

    def _repr_html_(self) -> str:
        title = f"{self.scene.title} ({len(self)} frames)"
        return f"<h4>{html.escape(title)}</h4>{image_tag(self.scores[-1].annotated())}{self.table()._repr_html_()}"


def run_of(flight: Flight, scores: Sequence[Sequence[Score]]) -> Run:
    """The result of a flight at its end, from the scores of each camera, the main one first."""
    telemetry = flight.telemetry()
    imu_samples = flight.imu_samples()
    main, *heads = (
        Run(flight.lab, camera, tuple(own), telemetry, imu_samples, given=flight.parts.given)
        for camera, own in zip(flight.lab.cameras, scores, strict=True)
    )
    return replace(main, heads={head.camera.name: head for head in heads})


class FlightRecorder:
    """The files of all cameras of a flight: the main one's in the folder, a head's in one with its name below it.

    The folder is cleared when the first shot comes, so that a flight that cannot begin leaves it as it is.
    """

    def __init__(self, folder: Path, flight: Flight) -> None:
        self.flight = flight
        self.folder = folder

    @cached_property
    def recorders(self) -> dict[str, Recorder]:
        """By the name of the camera."""
        main, *heads = self.flight.lab.cameras
        found = {head.name: Recorder(self.folder / head.name, head) for head in heads}
        return {main.name: Recorder(self.folder, main)} | found

    def record(self, shots: Iterable[Shot]) -> list[FrameRow]:
        """Solved shots, written as they come and not kept. Returns the rows of the main camera."""
        for shot in shots:
            self.recorders[shot.camera.name].add(Score(shot))
        return self.recorders[self.flight.lab.camera.name].rows

    def finish(
        self,
        command: str,
        plan: Check,
        draw: Callable[[Lab, Telemetry, Path], Sequence[Path]] | None = None,
    ) -> list[tuple[Record, Report]]:
        """Write tables, images and reports; return statistics and report of each camera.

        Parameters
        ----------
        draw
            Makes pictures of the laboratory for the main camera's report
        """
        main = run_of(self.flight, [() for _ in self.recorders])
        pictures = draw(main.lab, main.telemetry, self.folder) if draw else ()
        motion = main.telemetry, main.imu_samples
        first, *others = self.recorders.values()
        finished = [first.finish(command, *motion, plan, pictures)]
        for run, recorder in zip(main.heads.values(), others, strict=True):
            finished.append(recorder.finish(command, *motion, run.check()))
        return finished


# Run a scene from Python: `simulate` is the equivalent of `skysim run` and `render` of `skysim render`.


KNOTS = 9  # samples of the attitude in the exposure of `render_at`


def simulate(
    scene: Scene,
    *,
    controller: Any = None,
    tracker: Any = None,
    profile: Any = None,
    programs: Mapping[str, str] = NO_PROGRAMS,
    progress: Progress | None = None,
) -> Run:
    """Simulate a scene's motion, render every frame, solve it and score the solution against the truth.

    All frames are kept in memory; `skysim run` writes them one by one. Raises InputError.

    Parameters
    ----------
    controller
        In place of the scene's: its name, or a callable that takes a `ControllerSetup` and
        returns the law, a callable that takes a `ControllerInput` and returns the torque (3,)
        in N m (docs/howto/controller.md)
    tracker
        In place of the scene's: its name, a `StarTracker` or `DomeTracker` of the estimator, or
        a function that takes an image (H, W) and returns the attitude cam_from_ref as a
        Rotation, a unit quaternion (4,) scalar last or an `Answer`, or None for no attitude.
        The reference is the ICRS under the stars, else the lab
    profile
        In place of the scene's start and maneuvers: an attitude file, or an astropy Table,
        pandas DataFrame or mapping of columns (docs/howto/profile.md). The scene's controller
        follows it; without one the vehicle moves exactly along it
    programs
        Commands of external trackers and controllers by name
    progress
        Called as progress(t_s, duration_s) during the flight
    """
    with open_flight(
        scene, controller=controller, tracker=tracker, profile=profile, programs=programs
    ) as flight:
        scores: dict[str, list[Score]] = {camera.name: [] for camera in flight.lab.cameras}
        for shot in flight.shots(progress=progress):
            scores[shot.camera.name].append(Score(shot))
        return run_of(flight, list(scores.values()))


def render(scene: Scene, index: int = 0) -> tuple[Frame, Truth]:
    """One frame of a scene with its truth, bit-identical to that frame of the complete run.

    Earlier frames are not rendered, except with a `filter` section or exposure control, where a frame depends on
    them. Raises InputError for an index outside the scene's frames.
    """
    check_scene(scene)
    frames = scene.exposure.frames
    if not 0 <= index < frames:
        raise InputError(
            "index", f"{index} is outside of the scene's frames", f"0 to {frames - 1}"
        )
    needs_all = scene.filter is not None or scene.tracker.exposure_control is not None
    with open_flight(scene) as flight:
        shots = flight.shots(
            solves=False, selects=None if needs_all else lambda number, _: number == index
        )
        return next(
            (shot.frame, shot.truth)
            for shot in shots
            if shot.frame.index == index and shot.camera is flight.lab.camera
        )


def render_at(
    scene: Scene | Lab,
    lab_from_body: Rotation,
    rate_body_rad_s: Floats | tuple[float, float, float] = (0.0, 0.0, 0.0),
    t_s: float = 0.0,
    index: int = 0,
    camera: int = 0,
) -> tuple[Frame, Truth]:
    """One frame for a plant outside of skysim: the vehicle's attitude and rate are the caller's.

    Parameters
    ----------
    scene
        Or a lab of `skysim.build_lab`, which is then not built for every frame
    lab_from_body, rate_body_rad_s
        Attitude at mid-exposure, and rate (3,) in body axes, constant in the exposure
    t_s
        Time of mid-exposure since the scene's start
    index
        Number of the frame. It selects the noise, which is independent between frames of
        different numbers

    Raises
    ------
    InputError
        For a negative number, and for a camera that the lab does not have.
    """
    lab = build_lab(scene) if not isinstance(scene, Lab) else scene
    if index < 0:
        raise InputError("index", f"{index} is negative", "0 or more")
    if not 0 <= camera < len(lab.cameras):
        raise InputError(
            "camera", f"{camera} is none of the lab's", f"0 to {len(lab.cameras) - 1}"
        )
    own = lab.cameras[camera]
    window = window_from(own.scene, 0.0)
    window = window._replace(open_s=t_s - window.middle_s)
    times_s = np.linspace(window.open_s - MARGIN_S, window.close_s + MARGIN_S, KNOTS)
    rate = np.asarray(rate_body_rad_s, dtype=np.float64)
    return render_frame(
        own, Trajectory.at_rate(lab_from_body, rate, t_s, times_s), index, None, window
    )
