"""Write a run to a folder, frame by frame, so that a long run need not be kept in memory."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np

from skysim.core.files import (make_folder, write_image, write_table)
from skysim.core.types import Frame, FrameRow, Telemetry, Truth
from skysim.dynamics import imu
from skysim.results import run_report, scoring, telemetry_report
from skysim.results.annotate import annotate_truth
from skysim.results.files.frame_folder import (remove_results, write_frame)
from skysim.results.report import Report
from skysim.results.scoring import Score
from skysim.simulation.checks import Check
from skysim.simulation.lab import StarCamera

SHORT_S = 1.0  # the report of a single frame after a shorter motion has no plots against time


@dataclass(slots=True)
class Recorder:
    """The files of one camera. Files of an earlier run in the folder are removed first.

    seconds : of all frames, by stage;  shown : the last solved frame, or the first if none was solved
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
        assert score.shot.report is not None
        self.write(score.shot.frame, score.truth)
        self.rows.append(score.row)
        for stage, seconds in (score.shot.seconds | score.shot.report.seconds).items():
            self.seconds.setdefault(stage, []).append(seconds)
        if self.shown is None or score.attitude.solved:
            self.shown = score

    def write(self, frame: Frame, truth: Truth, preview: bool = False) -> Path:
        """Write one frame with its truth; return the path of its FITS file.

        preview : also write frame_NNNN.preview.png, an 8-bit image with the truth marked
        """
        write_frame(self.folder, frame, truth, self.camera.scene)
        path = self.folder / f"frame_{frame.index:04d}.fits"
        if preview:
            write_image(
                path.with_suffix(".preview.png"), annotate_truth(frame.image_dn, truth.sources)
            )
        return path

    def finish(
        self,
        command: str,
        log: Telemetry,
        imu_samples: imu.Increments | None,
        plan: Check,
        pictures: Sequence[Path] = (),
    ) -> tuple[dict[str, Any], Report]:
        """Write tables, annotated image and report. Returns the report, and before it what `skysim run --json` prints.

        pictures : image files of the laboratory
        """
        scene = self.camera.scene
        names = scoring.angle_names(scene)
        write_table(self.folder / "solutions.ecsv", scoring.table(self.rows, names))
        write_table(self.folder / "telemetry.ecsv", telemetry_report.table(log))
        if imu_samples:
            write_table(self.folder / "imu.ecsv", telemetry_report.imu_table(imu_samples))
        assert self.shown is not None
        annotated = self.shown.annotated()
        page = self.folder / "report.html"
        write_image(self.folder / "annotated.png", annotated)
        stages_ms = {
            stage: 1e3 * float(np.median(seconds)) for stage, seconds in self.seconds.items()
        }
        flight = (
            telemetry_report.figure(log) if len(self.rows) > 1 or log.t_s[-1] > SHORT_S else b""
        )
        facts = [(name, [text]) for name, text in scene.summary] + [
            (fact.name, fact.lines) for fact in plan.facts
        ]
        motion = telemetry_report.summary(log)
        report = run_report.run_report(
            scene.title,
            command,
            names,
            self.rows,
            stages_ms=stages_ms,
            annotated=annotated,
            motion=motion,
            motion_figure=flight,
            views=pictures,
            facts=facts,
            findings=plan.findings,
        )
        report.save(page)
        statistics = run_report.summary(self.rows) | {
            "stages_ms": stages_ms,
            "report": str(page),
            "flight": motion,
            "pictures": [str(path) for path in pictures],
            "exposures_ms": [1e3 * row.exposure_s for row in self.rows],
            "findings": plan.findings,
        }
        return statistics, report
