"""Performance of a tracker: probabilities with exact bounds, quantiles, and limits in rate, acceleration, magnitude."""

import math
import time
from typing import Any, NamedTuple

import numpy as np
from scipy.special import chdtri

from skysim.core.types import Floats, Record, median
from skysim.experiments.datasheet.cells import CellRows, MeasuredFrames
from skysim.experiments.datasheet.variance_components import (
    GROUPS,
    Bounded,
    bounded,
    mean_known,
    mean_square_ratio,
    squares_by_field,
)
from skysim.experiments.study import answer
from skysim.experiments.study.execution import trials
from skysim.results import metrics
from skysim.results.metrics import Summary
from skysim.tracking import factory

Rows = list[Record]
CLAIMS = (0.95, 0.99, 0.997)  # probabilities of a right attitude that a datasheet may claim
LEVELS = (0.683, 0.954, 0.997)  # probabilities of the quantiles
LIMITS = (0.95, 0.9)  # probabilities of a right attitude that bound a rate or an acceleration
TIMED = 50  # number of frames whose solution is timed


class Counts(NamedTuple):
    """Numbers of independent frames: all, with a right attitude, refused, and with a false attitude.

    Fields with several frames count once: as right if all frames are right, as false if one is, else as refused.
    """

    frames: int
    right: int
    refused: int
    false: int

    def share(self, kind: str) -> Summary:
        """The fraction of one kind with its exact one-sided bounds, each at 95 % (Clopper & Pearson 1934)."""
        hits = getattr(self, kind)
        return Summary(
            hits / self.frames, *metrics.exact_bounds(hits, self.frames), self.frames
        )


def counts(sheet: MeasuredFrames, rows: CellRows, by_field: bool = False) -> Counts:
    """The outcomes of some cells.

    Parameters
    ----------
    by_field
        Whether the frames of a field, one in each of the cells, count as one
    """
    right: Any = sheet.right(rows)
    false: Any = sheet.false(rows)
    if by_field:
        right = right.all(axis=0)
        false = false.any(axis=0)
    refused = ~right & ~false
    return Counts(right.size, *(int(one.sum()) for one in (right, refused, false)))


def claims(found: Counts) -> Rows:
    """Which of CLAIMS the frames show, and how many more frames each needs if none of them fails."""
    failures = found.frames - found.right
    return [
        {
            "share": share,
            "shown": found.share("right").low >= share,
            "runs": found.frames,
            "failures": failures,
            "without_failure": metrics.trials_needed(1 - share),
            "more": max(metrics.trials_needed(1 - share, failures) - found.frames, 0),
        }
        for share in CLAIMS
    ]


def quantiles(sheet: MeasuredFrames) -> Rows:
    """Quantiles of the errors' magnitude over independent frames, with intervals between order statistics."""
    errors = sheet.errors(sheet.rows("sky")).reshape(3, -1)
    errors = errors[:, np.isfinite(errors).all(axis=0)]
    sizes = {"across": np.hypot(errors[0], errors[1]), "about": np.abs(errors[2])}
    return [
        {
            "level": level,
            **{name: metrics.quantile(values, level) for name, values in sizes.items()},
        }
        for level in LEVELS
    ]


def consistency(sheet: MeasuredFrames) -> Record:
    """How well the tracker's covariance P and the assumption of equal axes fit the errors e of independent frames.

    If P is right, the normalized error squared e^T P^-1 e has the chi-square distribution with three degrees of
    freedom: its mean is 3, and the fractions LEVELS are within the quantiles of these probabilities.
    """
    rows = sheet.rows("sky")
    right = sheet.right(rows)
    nees = sheet.columns["nees"][rows][right]
    within = [
        {
            "level": level,
            "share": metrics.proportion(np.sum(nees <= chdtri(3, 1 - level)), nees.size),
        }
        for level in LEVELS
    ]
    x, y, _ = sheet.errors(rows)[:, right] ** 2
    return {
        "nees": mean_nees(sheet, rows),
        "within": within,
        "y_over_x": mean_square_ratio(y, x),
    }


def noise_equivalent_angle(apart: Floats) -> float:
    """Standard deviation of the temporal noise, rms(a - b) / sqrt(2), from differences of frames with other noise."""
    return math.sqrt(mean_known(apart**2) / 2)


def pair_row(sheet: MeasuredFrames, rows: CellRows) -> Record:
    """Outcomes, temporal noise and rms error about one axis of a pair of cells, arcseconds."""
    errors = sheet.errors(rows)
    found: Record = {
        "counts": counts(sheet, rows, by_field=True),
        **rms_by_group(sheet, rows),
        "nees": mean_nees(sheet, rows),
        "intervals": {},
    }
    for name, axes in GROUPS.items():
        apart = errors[axes, 0] - errors[axes, 1]
        squares = mean_known(apart**2, 0) / 2
        found[f"nea_{name}"] = noise_equivalent_angle(apart)
        found["intervals"][f"nea_{name}"] = root_interval(squares)
        found["intervals"][f"rms_{name}"] = root_interval(squares_by_field(sheet, rows, axes))
    return found


def root_interval(squares: Floats) -> list[float]:
    """Ends of the interval of the root of the mean of (fields,) mean squares; NaN for few fields."""
    return np.sqrt(np.maximum(bounded(squares[np.isfinite(squares)])[1:], 0.0)).tolist()


def mean_nees(sheet: MeasuredFrames, rows: CellRows) -> Bounded:
    """The mean normalized error squared of right attitudes: 3 if their covariances are right."""
    nees = np.where(sheet.right(rows), sheet.columns["nees"][rows], np.nan)
    solved = np.isfinite(nees).sum(axis=0)
    return Bounded(*metrics.mean_nees({"nees": mean_known(nees, 0), "solved": solved})[:3])


def rms_by_group(sheet: MeasuredFrames, rows: CellRows) -> dict[str, float]:
    """The rms error of right attitudes about one axis, by `rms_` and the name of the group of axes."""
    squares = sheet.errors(rows) ** 2
    return {
        f"rms_{name}": math.sqrt(mean_known(squares[axes])) for name, axes in GROUPS.items()
    }


def by_rate(sheet: MeasuredFrames, experiment: str) -> Rows:
    """Noise-equivalent angle, error and outcomes by rate; at rest from the terms' first attitude.

    Parameters
    ----------
    experiment
        One of `cells.RATES`
    """
    rest = sheet.rows("terms", unit=0, state=0, attitude=0)
    found = [{"rate_deg_s": 0.0, "streak_px": 0.0, **pair_row(sheet, rest)}]
    for rate in sheet.levels(experiment, "rate_deg_s"):
        rows = sheet.rows(experiment, rate_deg_s=rate)
        streak_px = float(mean_known(sheet.columns["streak_px"][rows]))
        found.append({"rate_deg_s": rate, "streak_px": streak_px, **pair_row(sheet, rows)})
    return found


def by_level(sheet: MeasuredFrames, experiment: str, key: str) -> Rows:
    """Noise-equivalent angle, error and outcomes by the levels of a key, ascending; empty without the experiment."""
    return [
        {key: level, **pair_row(sheet, sheet.rows(experiment, **{key: level}))}
        for level in sorted(sheet.levels(experiment, key))
    ]


class Limit(NamedTuple):
    """The two levels between which the probability of a right attitude falls below `share`, each at 95 % confidence.

    Attributes
    ----------
    share
        The highest of LIMITS that the frames of a level can show
    above
        Greatest level up to which all probabilities are shown to be above `share`; NaN if none is
    below
        Least level from which all are shown to be below `share`; infinite if none is
    fields
        Least number of fields at a level
    """

    share: float
    above: float
    below: float
    fields: int


def bracket(rows: Rows, key: str) -> Limit:
    """The limit in a rate or an acceleration, from rows in ascending order of it."""
    fewest = min(row["counts"].frames for row in rows)
    share = next(
        (one for one in LIMITS if metrics.trials_needed(1 - one) <= fewest), LIMITS[-1]
    )
    above = math.nan
    below = math.inf
    for row in rows:
        if row["counts"].share("right").low < share:
            break
        above = row[key]
    for row in reversed(rows):
        if row["counts"].share("right").high >= share:
            break
        below = row[key]
    return Limit(share, above, below, fewest)


UNITS = {"rate_deg_s": "°/s", "acceleration_deg_s2": "°/s²", "off_deg": "°"}


def bracket_text(what: str, rows: Rows, key: str) -> str:
    """A sentence on a limit, for fields that are right in both of their frames."""
    limit = bracket(rows, key)
    unit = UNITS[key]
    needed = metrics.trials_needed(1 - limit.share)
    if limit.fields < needed:
        return f"Limit of {what}: not established: {limit.fields} attitudes, {needed} needed."
    above = (
        "at no level tested"
        if math.isnan(limit.above)
        else f"{'down' if key == 'off_deg' else 'up'} to {limit.above:g} {unit}"
    )
    below = "at none tested" if math.isinf(limit.below) else f"from {limit.below:g} {unit} on"
    share = f"{100 * limit.share:g} %"
    text = f"Limit of {what}: {share} of right attitudes are shown {above}; fewer than {share} are shown {below}."
    return f"{text}{false_claims_text(rows, key)}" if "nees" in rows[0] else text


def false_claims_text(rows: Rows, key: str) -> str:
    """A sentence on the levels at which the errors are not as the tracker claims; empty without any.

    All levels together at CONFIDENCE, as a study judges its points (`answer.jointly`).
    """
    false = {}
    for row in rows:
        value, low, high = row["nees"]
        nees = Summary(value, low, high, row["counts"].frames)
        if answer.jointly(nees, len(rows)).low > answer.TRUE_NEES[1]:
            false[row[key]] = value
    if not false:
        return ""
    worst = max(false, key=lambda level: false[level])
    return (
        f" But the errors are not as claimed at {', '.join(f'{level:g}' for level in false)} {UNITS[key]}: greater by a"
        f" factor of {math.sqrt(false[worst] / 3):.2g} at {worst:g} (NEES {false[worst]:.3g}, 3 if true)."
    )


def solution_times_s(sheet: MeasuredFrames) -> Floats:
    """(TIMED,) seconds that the tracker took for frames lost in space, from pixels to attitude, on this machine.

    All are solved twice, and the second time counts: the first one compiles and loads what the solutions need.
    """
    setup = trials.prepared_setup(sheet.spec, sheet.cells[sheet.rows("sky")[0]].settings)
    seeds = (trials.seed_of(sheet.spec, 0, replicate) for replicate in range(TIMED))
    frames = [trials.render_trial_frame(setup, seed)[0] for seed in seeds]
    found = []
    for frame in frames * 2:
        begin_s = time.perf_counter()
        factory.solve_frame(setup.estimator, frame)
        found.append(time.perf_counter() - begin_s)
    return np.array(found[TIMED:])


def disturbances(sheet: MeasuredFrames) -> Rows:
    """Outcomes and errors under each disturbance, the undisturbed frames first."""
    undisturbed = [row for row in sheet.rows("total") if sheet.cells[row].levels["draw"] == 0]
    cases = {"none": undisturbed}
    cases |= {
        name: sheet.rows("disturbance", disturbance=name)
        for name in sheet.levels("disturbance", "disturbance")
    }
    return [{"disturbance": name} | outcome(sheet, rows) for name, rows in cases.items()]


def outcome(sheet: MeasuredFrames, rows: CellRows) -> Record:
    """Counts and rms errors of some cells, each frame on its own."""
    return {"counts": counts(sheet, rows)} | rms_by_group(sheet, rows)


def exclusions(sheet: MeasuredFrames) -> Rows:
    """Outcomes and errors by the angle of the boresight from bright bodies, the farthest first."""
    angles = sorted(sheet.levels("exclusion", "off_deg"), reverse=True)
    return [
        {"body": body, "off_deg": off_deg}
        | outcome(sheet, sheet.rows("exclusion", body=body, off_deg=off_deg))
        for body in sheet.levels("exclusion", "body")
        for off_deg in angles
    ]


def timing(sheet: MeasuredFrames, times_s: list[float]) -> Record:
    """Update rate, and the age of an attitude when it is known: half the exposure, reading out, solving.

    The age is that of the middle of the exposure. Rows that are read one after the other delay it.
    """
    scene = sheet.scene
    row_s = getattr(scene.camera.shutter, "row_time_s", 0.0)
    parts_s = {
        "half_exposure_s": scene.exposure.time_s / 2,
        "readout_s": row_s * scene.camera.height_px,
        "solution_s": median(times_s),
    }
    return {
        "rate_hz": scene.exposure.rate_hz,
        "greatest_rate_hz": 1 / float(np.quantile(times_s, 0.95)),
        **parts_s,
        "latency_s": sum(parts_s.values()),
    }
