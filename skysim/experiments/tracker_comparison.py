"""Compare trackers on the same frames, scored by the same code."""

from collections import Counter
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import NamedTuple

import numpy as np

from skysim.core import files
from skysim.core.errors import InputError
from skysim.core.types import Frame, Record, Truth, median
from skysim.results import metrics, scoring
from skysim.results.scoring import FrameRow
from skysim.scene.scene import Scene
from skysim.simulation.flight import Flight, Progress
from skysim.simulation.lab import Lab, build_tracker
from skysim.tracking import factory
from skysim.tracking.tracker_interface import FAILED, SOLVED


class TrackerScore(NamedTuple):
    """Statistics of one tracker.

    Attributes
    ----------
    right
        Fraction of all frames solved and not wrong (`metrics.is_wrong`), with its 95% interval
    wrong
        Solutions farther off
    refused
        No solution
    failed
        Exception, timeout, crash or invalid output
    refusals
        Count of each status other than solved, most frequent first
    errors
        Arcseconds, over right solutions only
    nees
        Mean of their normalized squared errors, 3 if the claimed errors are true; nan without a claim
    time_ms
        Time from image to solution, over the frames on which the tracker did not fail
    """

    tracker: str
    frames: int
    right: metrics.Summary
    wrong: int
    refused: int
    failed: int
    cross_arcsec_median: float
    cross_arcsec_worst: float
    roll_arcsec_median: float
    roll_arcsec_worst: float
    nees: float
    time_ms_median: float
    time_ms_p95: float
    refusals: dict[str, int]


def build_trackers(
    lab: Lab, names: Sequence[str], programs: Mapping[str, str]
) -> dict[str, factory.Estimator]:
    """Set up the trackers by name, all with the scene's tracker options and onboard model. Raises InputError."""
    repeated = [name for name, count in Counter(names).items() if count > 1]
    if repeated:
        raise InputError("trackers", f"{repeated[0]} is given twice", "once")
    scenes = {name: lab.scene.with_values("tracker", name=name) for name in names}
    return {
        name: build_tracker(lab.with_scene(scene).camera, programs)
        for name, scene in scenes.items()
    }


def compare_frames(
    flight: Flight,
    estimators: Mapping[str, factory.Estimator],
    progress: Progress | None = None,
) -> Iterator[tuple[Frame, Truth, dict[str, FrameRow]]]:
    """Yield each frame of the main camera with its truth and the row of each tracker.

    The order of the trackers rotates from frame to frame, so that none always runs first (with cold caches). With an
    attitude filter the first tracker, which must be the flight's, closes the loop: its solutions are the flight's.
    """
    order = list(estimators)
    lab = flight.lab
    closed_loop_tracker = order[0] if lab.scene.filter else ""
    for shot in flight.shots(cameras=[0], solves=False, progress=progress):
        rows = {}
        for name in order:
            tracker = estimators[name]
            if shot.frame.index == 0 and not isinstance(tracker, factory.UserTracker):
                # So that it is compiled before it is timed.
                factory.solve_frame(tracker, shot.frame)
            report = shot.report if name == closed_loop_tracker else None
            report = report or factory.solve_frame(tracker, shot.frame)
            rows[name] = scoring.row(lab.camera, shot.frame, shot.truth, report)
        yield shot.frame, shot.truth, rows
        order.append(order.pop(0))


def score_tracker(tracker: str, rows: Sequence[FrameRow]) -> TrackerScore:
    """Statistics of a tracker over its rows."""
    right = [row for row in rows if row.status == SOLVED and not row.wrong]
    unsolved = Counter(row.status for row in rows if row.status != SOLVED)
    failed = sum(count for status, count in unsolved.items() if status.startswith(FAILED))
    nees = np.array([row.nees for row in right if np.isfinite(row.nees)] or [np.nan])
    # Frames on which it failed are left out of the times: the time to a solution is unknown there.
    ms = np.array(
        [row.time_ms for row in rows if not row.status.startswith(FAILED)] or [np.nan]
    )
    return TrackerScore(
        tracker,
        len(rows),
        metrics.proportion(len(right), len(rows)),
        sum(row.wrong for row in rows),
        sum(unsolved.values()) - failed,
        failed,
        **scoring.error_statistics([(row.cross_arcsec, row.roll_arcsec) for row in right]),
        nees=float(np.mean(nees)),
        time_ms_median=median(ms),
        time_ms_p95=float(np.percentile(ms, 95)),
        refusals=dict(unsolved.most_common()),
    )


def write_scores(
    folder: Path, rows: Mapping[str, list[FrameRow]], scene: Scene
) -> list[TrackerScore]:
    """Write solutions.NAME.ecsv of every tracker and scoreboard.ecsv; return the statistics of each tracker.

    The scoreboard does not have `refusals`, since the status of each frame is in the solutions.
    """
    from astropy.table import Table

    scores = [score_tracker(name, tracker_rows) for name, tracker_rows in rows.items()]
    for name, tracker_rows in rows.items():
        files.write_table(
            folder / f"solutions.{name}.ecsv",
            scoring.table(tracker_rows, scene),
        )
    board = Table(as_dicts(scores))
    del board["refusals"]
    files.write_table(folder / "scoreboard.ecsv", board)
    return scores


def as_dicts(scores: Sequence[TrackerScore]) -> list[Record]:
    """The statistics as dictionaries for JSON; `right` becomes three numbers."""
    return [
        score._asdict()
        | {
            "right": score.right.value,
            "right_low": score.right.low,
            "right_high": score.right.high,
        }
        for score in scores
    ]
