"""Trackers side by side: the same frames, scored by the same code."""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

from skysim import io, metrics, onboard, score, simulate
from skysim.scene import Scene
from skysim.simulate import Lab, Shot
from skysim.trackers import FAILED, SOLVED
from skysim.types import BadInput, Frame, Row, Truth


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


def entrants(lab: Lab, names: Sequence[str]) -> dict[str, onboard.Estimator]:
    """The trackers, set up; the scene's own options and beliefs go to all of them. Raises BadInput."""
    twice = [name for name, count in Counter(names).items() if count > 1]
    if twice:
        raise BadInput(f"--tracker {twice[0]}: is told twice; allowed: once")
    return {name: simulate.tracker(with_tracker(lab, name)) for name in names}


def with_tracker(lab: Lab, name: str) -> Lab:
    """The same lab with another tracker on board."""
    told = lab.scene.tracker.model_copy(update={"name": name})
    return replace(lab, scene=lab.scene.model_copy(update={"tracker": told}))


def shots(
    lab: Lab, estimators: Mapping[str, onboard.Estimator]
) -> Iterator[tuple[Frame, Truth, dict[str, Row]]]:
    """Frame after frame, with each tracker's row of it. They take turns at who is asked first.

    What the first one said in flight, to the filter, is not asked again.
    """
    order = list(estimators)
    flown = order[0]
    for name in order:
        simulate.warm(lab, estimators[name])
    for frame, truth, seconds in simulate.photographs(lab):
        answers = {}
        for name in order:
            report = lab.reports.get(frame.index) if name == flown else None
            report = report or onboard.answer(estimators[name], frame)
            answers[name] = score.row(Shot(frame, truth, report, seconds), lab.scene, lab.mount)
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
        io.write_table(folder / f"solutions.{name}.ecsv", score.table(told, score.angle_names(scene)))
    io.write_table(folder / "scoreboard.ecsv", table(lines))
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
