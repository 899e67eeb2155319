"""Python interface to a complete run: simulate a scene, render, solve and score its frames, and save them.

`simulate` is the equivalent of `skysim run` and `render` of `skysim render`; both commands use this module.
"""

from __future__ import annotations

import html
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any, overload

import cv2
import numpy as np
from numpy.typing import NDArray

from estimator.core.types import Attitude
from skysim.core.errors import InputError
from skysim.core.io.files import make_folder, write_image, write_table
from skysim.core.quantities.units import ARCSEC_RAD
from skysim.core.types import Frame, FrameRow, Telemetry, Truth
from skysim.results import report, scoring, stretch, telemetry_report
from skysim.results.files.frames import remove_results, write_frame
from skysim.scene.scene import Scene
from skysim.simulation import exposure
from skysim.simulation import run as simulation
from skysim.simulation.checks import Check, check
from skysim.simulation.testbed import Testbed, build_tracker
from skysim.simulation.user_parts import build_testbed_with
from skysim.tracking.factory import NO_PROGRAMS

if TYPE_CHECKING:
    import pandas as pd
    from astropy.table import Table

Progress = Callable[[float, float], None]
SHORT_S = 1.0  # the report of a single frame after a shorter motion has no plots against time


@dataclass(frozen=True, slots=True, repr=False)
class ScoredFrame:
    """One frame with its truth, the tracker's solution and its error.

    result : frame, truth, the tracker's report, and seconds by step
    row    : the same as numbers: angles in degrees, errors and the tracker's standard deviations in arcseconds
    """

    result: simulation.FrameResult
    row: FrameRow

    @property
    def image(self) -> NDArray[Any]:
        """(H, W) digital numbers: uint16, or float64 for a noise-free detector."""
        return self.result.frame.image_dn

    @property
    def truth(self) -> Truth:
        """Attitude, rates and sources at mid-exposure."""
        return self.result.truth

    @property
    def attitude(self) -> Attitude:
        """The tracker's solution; if it has no attitude, its `status` gives the reason."""
        return self.result.report.attitude

    @property
    def error_arcsec(self) -> float:
        """Rotation angle between the solution and the truth, arcseconds; NaN without a solution."""
        estimate = self.attitude.cam_from_ref
        if estimate is None:
            return float("nan")
        return float((estimate * self.truth.cam_from_lab.inv()).magnitude() / ARCSEC_RAD)

    def annotated(self) -> NDArray[np.uint8]:
        """(H, W, 3) stretched frame in BGR: truth in blue, detections in red, identified sources in green."""
        return scoring.annotated(self.result.frame, self.truth, self.result.report)

    def __repr__(self) -> str:
        identified = f"{self.row.matched} of {self.row.detected} detections identified"
        return f"<frame {self.row.frame}: {self.row.status}, error {self.error_arcsec:.3g} arcsec, {identified}>"

    def _repr_html_(self) -> str:
        return f"{_image_tag(self.annotated())}<p>{html.escape(repr(self)[1:-1])}</p>"


@dataclass(frozen=True, slots=True)
class Run(Sequence[ScoredFrame]):
    """The result of `simulate`: a sequence of scored frames.

    testbed : the scene's test bed with its simulated trajectory
    frames  : one entry per frame, in order
    heads   : the runs of the scene's further star cameras, by name
    """

    testbed: Testbed
    frames: tuple[ScoredFrame, ...] = field(repr=False)
    heads: dict[str, Run] = field(repr=False, default_factory=dict)

    @property
    def scene(self) -> Scene:
        """The scene that was run."""
        return self.testbed.scene

    @property
    def telemetry(self) -> Telemetry:
        """Motion of the vehicle, and measurements and commands of its computer, sampled at the control rate."""
        return self.testbed.log

    @property
    def rows(self) -> list[FrameRow]:
        """One row of numbers per frame."""
        return [frame.row for frame in self.frames]

    def __len__(self) -> int:
        return len(self.frames)

    @overload
    def __getitem__(self, index: int) -> ScoredFrame: ...
    @overload
    def __getitem__(self, index: slice) -> Sequence[ScoredFrame]: ...
    def __getitem__(self, index: int | slice) -> ScoredFrame | Sequence[ScoredFrame]:
        return self.frames[index]

    def table(self) -> Table:
        """One row per frame, as in `solutions.ecsv`: angles in degrees, errors in arcseconds."""
        return scoring.table(self.rows, scoring.angle_names(self.scene))

    def to_pandas(self) -> pd.DataFrame:
        """`table` as a data frame; needs pandas."""
        return self.table().to_pandas()

    def save(self, folder: str | Path) -> Path:
        """Write the same files as `skysim run`: frames with truth, tables and report.html. Returns the folder.

        The files of a further star camera are in a folder with its name.
        """
        recorder = Recorder(Path(folder), self.testbed)
        for frame in self.frames:
            recorder.add(frame)
        recorder.finish(f"skysim.simulate(skysim.load_scene({self.scene.name!r}))")
        for name, run in self.heads.items():
            run.save(recorder.folder / name)
        return recorder.folder

    def _repr_html_(self) -> str:
        title = f"{self.scene.title} ({len(self)} frames)"
        return f"<h4>{html.escape(title)}</h4>{_image_tag(self.frames[-1].annotated())}{self.table()._repr_html_()}"


@dataclass(slots=True)
class Recorder:
    """Writes a run to a folder, frame by frame, so that a long run need not be kept in memory.

    Files of an earlier run in the folder are removed first.

    plan    : the check of the plan, for the report; computed if left out
    seconds : of all frames, by stage;  shown : the last solved frame, or the first if none was solved
    """

    folder: Path
    testbed: Testbed
    plan: Check | None = None
    rows: list[FrameRow] = field(default_factory=list)
    seconds: dict[str, list[float]] = field(default_factory=dict)
    shown: ScoredFrame | None = None

    def __post_init__(self) -> None:
        make_folder(self.folder)
        remove_results(self.folder)

    def add(self, frame: ScoredFrame) -> None:
        """Write one solved frame with its truth and add it to the tables."""
        self.write(frame.result.frame, frame.truth)
        self.rows.append(frame.row)
        for stage, seconds in (frame.result.seconds | frame.result.report.seconds).items():
            self.seconds.setdefault(stage, []).append(seconds)
        if self.shown is None or frame.attitude.solved:
            self.shown = frame

    def write(self, frame: Frame, truth: Truth, preview: bool = False) -> Path:
        """Write one frame with its truth; return the path of its FITS file.

        preview : also write frame_NNNN.preview.png, an 8-bit image with the truth marked
        """
        write_frame(self.folder, frame, truth, self.testbed.scene)
        path = self.folder / f"frame_{frame.index:04d}.fits"
        if preview:
            write_image(path.with_suffix(".preview.png"), report.annotate_truth(frame.image_dn, truth.sources))
        return path

    def finish(self, command: str, pictures: Sequence[Path] = ()) -> dict[str, Any]:
        """Write tables, annotated image and report. Returns the statistics that `skysim run --json` prints."""
        scene, log = self.testbed.scene, self.testbed.log
        names = scoring.angle_names(scene)
        write_table(self.folder / "solutions.ecsv", scoring.table(self.rows, names))
        write_table(self.folder / "telemetry.ecsv", telemetry_report.table(log))
        if self.testbed.imu_samples:
            write_table(self.folder / "imu.ecsv", telemetry_report.imu_table(self.testbed.imu_samples))
        assert self.shown is not None
        annotated, page = self.shown.annotated(), self.folder / "report.html"
        write_image(self.folder / "annotated.png", annotated)
        stages_ms = {stage: 1e3 * float(np.median(seconds)) for stage, seconds in self.seconds.items()}
        flight = telemetry_report.figure(log) if len(self.rows) > 1 or log.t_s[-1] > SHORT_S else b""
        plan = self.plan or check(self.testbed)
        facts = [(name, [text]) for name, text in scene.summary] + [(fact.name, fact.lines) for fact in plan.facts]
        report.write_page(
            page,
            scene.title,
            command,
            names,
            self.rows,
            stages_ms,
            annotated,
            flight,
            pictures,
            facts,
            plan.findings,
        )
        return report.summary(self.rows) | {
            "stages_ms": stages_ms,
            "report": str(page),
            "flight": telemetry_report.summary(log),
            "pictures": [str(path) for path in pictures],
            "exposures_ms": [1e3 * row.exposure_s for row in self.rows],
            "findings": plan.findings,
        }


def score_frames(testbed: Testbed) -> Iterator[ScoredFrame]:
    """Render, solve and score the frames of a test bed one after another; its motion must be simulated already."""
    for result in simulation.run(testbed, build_tracker(testbed)):
        verdict = testbed.update_statuses.get(result.frame.index, "")
        yield ScoredFrame(result, scoring.row(result, testbed.scene, testbed.mount, verdict))


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

    controller : in place of the scene's: its name, or a callable that takes a `ControllerSetup` and returns the law, a
        callable that takes a `ControllerInput` and returns the torque (3,) in N m (docs/howto/controller.md)
    tracker  : in place of the scene's: its name, a `StarTracker` or `DomeTracker` of the estimator, or a function that
        takes an image (H, W) and returns the attitude cam_from_ref as a Rotation, a unit quaternion (4,) scalar last or
        an `Answer`, or None for no attitude. The reference is the ICRS under the stars, else the lab
    profile  : in place of the scene's start and maneuvers: an attitude file, or an astropy Table, pandas DataFrame or
        mapping of columns (docs/howto/profile.md). The scene's controller follows it; without one the vehicle moves
        exactly along it
    programs : commands of external trackers and controllers by name
    progress : called as progress(t_s, duration_s) during the motion simulation

    All frames are kept in memory; `skysim run` writes them one by one. Raises InputError.
    """
    testbed = build_testbed_with(scene, programs, controller, tracker, profile)
    testbed = simulation.simulate_motion(testbed, progress)
    main, *heads = (
        Run(camera, tuple(_with_own_image(frame) for frame in score_frames(camera))) for camera in testbed.cameras
    )
    return replace(main, heads={head.name: run for head, run in zip(scene.heads, heads, strict=True)})


def render(scene: Scene, index: int = 0) -> tuple[Frame, Truth]:
    """One frame of a scene with its truth, bit-identical to that frame of the complete run.

    Earlier frames are not rendered, except with a `filter` section or exposure control, where a frame depends on
    them. Raises InputError for an index outside the scene's frames.
    """
    frames = scene.exposure.frames
    if not 0 <= index < frames:
        raise InputError("index", f"{index} is outside of the scene's frames", f"0 to {frames - 1}")
    testbed = simulation.prepare(scene)
    if scene.tracker.exposure_control is None and index not in testbed.exposures_s:
        return exposure.render_frame(testbed, index)
    return next((frame, truth) for frame, truth, _ in simulation.render_frames(testbed) if frame.index == index)


def _with_own_image(frame: ScoredFrame) -> ScoredFrame:
    """The frame with a copy of its image, because the next frame may be rendered into the same memory."""
    image = frame.result.frame
    owned = replace(image, image_dn=np.array(image.image_dn))
    return replace(frame, result=replace(frame.result, frame=owned))


def _image_tag(image: NDArray[np.uint8]) -> str:
    """An HTML <img> element of an image, reduced to at most 800 pixels in width."""
    data = cv2.imencode(".jpg", stretch.reduce_width(image, 800))[1].tobytes()
    return f'<img src="{report.embed(data, "jpeg")}">'
