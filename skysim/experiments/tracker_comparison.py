"""Trackers side by side: the same frames, scored by the same code."""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

from skysim.core import files
from skysim.core.errors import InputError
from skysim.core.types import Frame, Row, Truth
from skysim.results import metrics, scoring
from skysim.scene.scene import Scene
from skysim.simulation import run, testbed
from skysim.simulation.run import FrameResult
from skysim.simulation.testbed import Testbed
from skysim.tracking import factory
from skysim.tracking.external.interface import FAILED, SOLVED


@dataclass(frozen=True, slots=True)
class Line:
    """What a tracker came to.

    right    : share of all frames that were answered within ten arc-minutes, with its interval at 95 %
    wrong    : answered and farther off;  refused : not answered;  failed : raised, hung, died or answered nonsense
    refusals : how often each status that is no answer came, the most frequent first
    errors   : arc-seconds, of the right answers alone: a wrong one has no error, it is wrong
    time_ms  : from image to answer, of all frames
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
    time_ms_median: float
    time_ms_p95: float
    refusals: dict[str, int]


def entrants(lab: Testbed, names: Sequence[str]) -> dict[str, factory.Estimator]:
    """The trackers, set up; the scene's own options and beliefs go to all of them. Raises InputError."""
    twice = [name for name, count in Counter(names).items() if count > 1]
    if twice:
        raise InputError(f"--tracker {twice[0]}: is told twice; allowed: once")
    return {name: testbed.tracker(with_tracker(lab, name)) for name in names}


def with_tracker(lab: Testbed, name: str) -> Testbed:
    """The same lab with another tracker on board."""
    told = lab.scene.tracker.model_copy(update={"name": name})
    return replace(lab, scene=lab.scene.model_copy(update={"tracker": told}))


def shots(
    lab: Testbed, estimators: Mapping[str, factory.Estimator]
) -> Iterator[tuple[Frame, Truth, dict[str, Row]]]:
    """Frame after frame, with each tracker's row of it. They take turns at who is asked first.

    What the first one said in flight, to the filter, is not asked again.
    """
    order = list(estimators)
    flown = order[0]
    for name in order:
        run.warm_up(lab, estimators[name])
    for frame, truth, seconds in run.render_frames(lab):
        answers = {}
        for name in order:
            report = lab.reports.get(frame.index) if name == flown else None
            report = report or factory.answer(estimators[name], frame)
            answers[name] = scoring.row(FrameResult(frame, truth, report, seconds), lab.scene, lab.mount)
        yield frame, truth, answers
        order.append(order.pop(0))


def line(tracker: str, rows: Sequence[Row]) -> Line:
    """A tracker's rows summed up."""
    right = [row for row in rows if row.status == SOLVED and not row.wrong]
    unsolved = Counter(row.status for row in rows if row.status != SOLVED)
    failed = sum(count for status, count in unsolved.items() if status.startswith(FAILED))
    cross = np.array([row.cross_arcsec for row in right] or [np.nan])
    roll = np.abs([row.roll_arcsec for row in right] or [np.nan])
    # A frame on which it failed has no time: nobody knows for how long it would have gone on.
    ms = np.array([row.time_ms for row in rows if not row.status.startswith(FAILED)] or [np.nan])
    return Line(
        tracker,
        len(rows),
        metrics.share(len(right), len(rows)),
        sum(row.wrong for row in rows),
        sum(unsolved.values()) - failed,
        failed,
        float(np.median(cross)),
        float(np.max(cross)),
        float(np.median(roll)),
        float(np.max(roll)),
        float(np.median(ms)),
        float(np.percentile(ms, 95)),
        dict(unsolved.most_common()),
    )


def write(folder: Path, rows: Mapping[str, list[Row]], scene: Scene) -> list[Line]:
    """solutions.NAME.ecsv of every tracker, and the scoreboard."""
    lines = [line(name, told) for name, told in rows.items()]
    for name, told in rows.items():
        files.write_table(folder / f"solutions.{name}.ecsv", scoring.table(told, scoring.angle_names(scene)))
    files.write_table(folder / "scoreboard.ecsv", table(lines))
    return lines


def as_dicts(lines: Sequence[Line]) -> list[dict[str, Any]]:
    """For JSON."""
    return [
        asdict(one) | {"right": one.right.value, "right_low": one.right.low, "right_high": one.right.high}
        for one in lines
    ]


def table(lines: Sequence[Line]) -> Any:
    """One row a tracker, as an astropy table; refusals stand in the solutions."""
    from astropy.table import Table

    rows = as_dicts(lines)
    return Table({name: [row[name] for row in rows] for name in rows[0] if name != "refusals"})
