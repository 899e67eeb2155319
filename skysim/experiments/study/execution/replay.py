"""Repeat one trial of a study and write its frames for inspection."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from itertools import islice
from pathlib import Path
from typing import NamedTuple

import numpy as np

from estimator.core.types import Attitude, Centroids
from estimator.trackers.pipeline import Report
from skysim.core.errors import InputError
from skysim.core import files as file_io
from skysim.core.types import Frame, Truth
from skysim.experiments.study.execution import trials
from skysim.experiments.study.execution.setups import Setup, prepared_setup
from skysim.experiments.study.execution.store import Store, to_sql
from skysim.experiments.study.execution.trials import REFUSED, Row, Segment
from skysim.experiments.study.plan import CentroidTrial, FlightTrial, FrameTrial, Plan
from skysim.results.annotate import (annotate, visible)
from skysim.results.files import frame_folder
from skysim.tracking import factory

MAX_FRAMES = 100  # maximum number of frames written for a flight


class Replay(NamedTuple):
    """A repeated trial: its row, names of stored quantities that differ now, frame files, annotated images."""

    row: Row
    changed: list[str]
    files: list[Path]
    pictures: list[Path]


def segment_of(plan: Plan, store: Store, trial: int) -> Segment:
    """The segment with this trial alone. Raises InputError if the study has no such trial."""
    points = store.points()
    each = plan.study.replicates
    if not 0 <= trial < len(points) * each:
        raise InputError(f"trial {trial}", "not in the study", f"0 to {len(points) * each - 1}")
    point, replicate = divmod(trial, each)
    settings = plan.spec.trial_settings(points[point].settings, replicate)
    return Segment(point, settings, trial, range(replicate, replicate + 1))


def replay(plan: Plan, store: Store, trial: int, folder: Path) -> Replay:
    """Repeat a trial with its seed, and write each of its frames with an annotated image.

    Only the first MAX_FRAMES frames of a flight are written. An exception of the trial is in its row; frames rendered
    before it are written too.
    """
    segment = segment_of(plan, store, trial)
    row = trials.run_trial(plan.spec, segment, trial, segment.replicates[0])
    stored = store.trial(trial) if store.done(trial + 1)[trial] else {}
    now = {name: to_sql(getattr(row.outcome, name)) for name in row.outcome.__slots__}
    changed = [name for name, value in now.items() if stored and stored[name] != value]
    files = []
    pictures = []
    if row.scene not in ("", REFUSED):  # an invalid scene has no lab
        setup = prepared_setup(plan.spec, segment.settings)
        frame_folder.remove_results(file_io.make_folder(folder))
        try:
            for frame, truth, report in islice(replayed_frames(setup, row.seed), MAX_FRAMES):
                frame_folder.write_frame(folder, frame, truth, setup.lab.scene)
                files.append(folder / f"frame_{frame.index:04d}.fits")
                pictures.append(folder / f"frame_{frame.index:04d}.annotated.png")
                match = report.attitude.match
                xy_px = report.centroids.xy_px
                matched_px = xy_px[match.observed] if match else np.empty((0, 2))
                truth_px = truth.sources.xy_px[visible(truth.sources)]
                picture = annotate(frame.image_dn, xy_px, matched_px, truth_px=truth_px)
                file_io.write_image(pictures[-1], picture)
        except Exception:
            if row.error is None:
                raise
    return Replay(row, changed, files, pictures)


def replayed_frames(setup: Setup, seed: int) -> Iterator[tuple[Frame, Truth, Report]]:
    """Frames of a trial with truth and report.

    A centroid trial has no frame, so one is rendered at its attitude and shown with the trial's own centroids.
    """
    trial = setup.trial
    if isinstance(trial, CentroidTrial):
        frame_trial = FrameTrial(
            kind="frames",
            **{name: getattr(trial, name) for name in ("tilt_deg", "dec_deg", "near")},
        )
        frame, truth, _ = trials.render_trial_frame(setup._replace(trial=frame_trial), seed)
        yield frame, truth, solve_or_failed(lambda: trials.solved_centroids(setup, [seed])[0][1])
    elif isinstance(trial, FlightTrial):
        with trials.trial_flight(setup, seed) as flight:
            for shot in flight.shots(cameras=[0]):
                assert shot.report is not None
                yield shot.frame, shot.truth, shot.report
    else:
        frame, truth, streak_px = trials.render_trial_frame(setup, seed)
        yield (
            frame,
            truth,
            solve_or_failed(
                lambda: factory.solve_frame(
                    setup.estimator, frame, streak_px, trials.gyro_rate(setup, truth)
                )
            ),
        )


def solve_or_failed(solve: Callable[[], Report]) -> Report:
    """The tracker's report, or an empty one if it raises; the trial's row holds the exception."""
    try:
        return solve()
    except Exception as error:
        return Report(Attitude(f"failed: {error}"), Centroids.empty())
