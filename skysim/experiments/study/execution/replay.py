"""Repeat one trial of a study and write its frames for inspection."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from itertools import islice
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from estimator.core.types import Attitude, Centroids
from estimator.trackers.pipeline import Report
from skysim.core import files as file_io
from skysim.core.errors import InputError
from skysim.core.types import Frame, Truth
from skysim.experiments.study.plan import CentroidTrial, FlightTrial, FrameTrial, Plan
from skysim.experiments.study.setups import Setup, prepared_setup
from skysim.experiments.study.store import Store, plain
from skysim.experiments.study.trials import Row, Segment, one, reseeded, shot, sight
from skysim.results.files import frames
from skysim.results.report import annotate
from skysim.simulation import run
from skysim.tracking import factory

MOST = 100  # maximum number of frames written for a flight


class Replay(NamedTuple):
    """A repeated trial: its row, names of stored quantities that differ now, frame files, annotated images."""

    row: Row
    changed: list[str]
    files: list[Path]
    pictures: list[Path]


def segment_of(plan: Plan, store: Store, trial: int) -> Segment:
    """The segment with this trial alone. Raises InputError if the study has no such trial."""
    points, each = store.points(), plan.study.replicates
    if not 0 <= trial < len(points) * each:
        raise InputError(f"trial {trial}: is none of the study's; allowed: 0 to {len(points) * each - 1}")
    point, replicate = divmod(trial, each)
    return Segment(point, points[point].settings, trial, range(replicate, replicate + 1))


def replay(plan: Plan, store: Store, trial: int, folder: Path) -> Replay:
    """Repeat a trial with its seed, and write each of its frames with an annotated image.

    Only the first MOST frames of a flight are written. An exception of the trial is in its row; frames rendered
    before it are written too.
    """
    segment = segment_of(plan, store, trial)
    row = one(plan.recipe, segment, trial, segment.replicates[0])
    kept = store.trial(trial) if store.done(trial + 1)[trial] else {}
    now = {name: plain(getattr(row.outcome, name)) for name in row.outcome.__slots__}
    changed = [name for name, value in now.items() if kept and kept[name] != value]
    files, pictures = [], []
    if row.scene:  # an invalid scene has no test bed
        ready = prepared_setup(plan.recipe, segment.settings)
        frames.clear(file_io.make_folder(folder))
        try:
            for frame, truth, report in islice(seen(ready, row.seed), MOST):
                frames.write_frame(folder, frame, truth, ready.lab.scene)
                files.append(folder / f"frame_{frame.index:04d}.fits")
                pictures.append(folder / f"frame_{frame.index:04d}.annotated.png")
                file_io.write_image(pictures[-1], picture(frame, truth, report))
        except Exception:
            if row.error is None:
                raise
    return Replay(row, changed, files, pictures)


def picture(frame: Frame, truth: Truth, report: Report) -> Any:
    """The annotated frame: truth, detections and identified detections."""
    match, xy_px = report.attitude.match, report.centroids.xy_px
    matched_px = xy_px[match.observed] if match else np.empty((0, 2))
    return annotate(frame.image_dn, xy_px, matched_px, truth_px=truth.seen.xy_px)


def seen(ready: Setup, seed: int) -> Iterator[tuple[Frame, Truth, Report]]:
    """Frames of a trial with truth and report.

    A centroid trial has no frame, so one is rendered at its attitude and shown with the trial's own centroids.
    """
    trial = ready.trial
    if isinstance(trial, CentroidTrial):
        _, _, centroids = sight(ready, seed)
        still = FrameTrial(kind="frames", **{name: getattr(trial, name) for name in ("tilt_deg", "dec_deg")})
        frame, truth, _ = shot(ready._replace(trial=still), seed)
        yield frame, truth, tried(lambda: Report(ready.estimator.solve_centroids(centroids), centroids))
    elif isinstance(trial, FlightTrial):
        lab = run.simulate_motion(reseeded(ready.lab, seed))
        for taken in run.run(lab, ready.estimator):
            yield taken.frame, taken.truth, taken.report
    else:
        frame, truth, streak_px = shot(ready, seed)
        yield frame, truth, tried(lambda: factory.solve_frame(ready.estimator, frame, streak_px))


def tried(solve: Callable[[], Report]) -> Report:
    """The tracker's report, or an empty one if it raises; the trial's row holds the exception."""
    try:
        return solve()
    except Exception as error:
        return Report(Attitude(f"failed: {error}"), Centroids.none())
