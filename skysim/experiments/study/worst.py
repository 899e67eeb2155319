"""The worst trials of a study by a response: where in the sky or in the dome they are, and which trials repeat them."""

import math
from collections.abc import Callable, Iterator, Mapping, Sequence
from typing import Any, NamedTuple

import numpy as np
from scipy.spatial.transform import Rotation

from skysim.core.types import Array, Floats, Ints, positive
from skysim.experiments.study.execution.store import Store
from skysim.experiments.study.plan import Study
from skysim.experiments.study.table import without_responses
from skysim.results.files.row_parts import row_of, subset
from skysim.results.metrics import (
    COVERAGE,
    MORE_IS_BETTER,
    OVERCONFIDENT_NEES,
    QUANTITIES,
    WITHIN,
    Columns,
    right_within,
    split_name,
)
from skysim.sources.dome.surface import directions

COUNT = 3  # number of worst trials that a report lists
DIRECTION = (
    "body_tilt_deg",
    "body_azimuth_deg",
    "boresight_ra_deg",
    "boresight_dec_deg",
    "stars",
)
FIRST = 1000  # number of worst trials that are sorted first
APART_DEG = 5.0  # least angle between the directions of two listed trials
NEAR = math.cos(math.radians(APART_DEG))
# How often a trial counts for a proportion; for `identified`, how often it does not.
FLAGS: dict[str, Callable[[Columns], Array]] = {
    "identified": lambda c: c["frames"] - c["solved"] + c["wrong"],
    "refused": lambda c: c["frames"] - c["solved"],
    "overconfident": lambda c: np.nan_to_num(c["nees"]) > OVERCONFIDENT_NEES,
    "failed": lambda c: c["frames"] == 0,
}
ColumnsOf = Callable[..., Columns]  # the columns of the trials of some points


class WorstTrial(NamedTuple):
    """One of the worst trials: its number, point and attitude, and what happened in it.

    Attributes
    ----------
    value
        What ranks it: its value of the quantity, or how often it counts
    status
        "misidentified" where it is solved with wrong lights
    tilt_deg, azimuth_deg
        Direction of the body's z axis under a dome; of a flight, in its worst frame
    ra_deg, dec_deg
        Direction of the boresight under the stars
    yaw_deg, pitch_deg, roll_deg
        3-2-1 angles of the body under a dome, as in `motion.start`; NaN under the stars, and of a
        flight, which starts elsewhere
    lights
        Number of lights in the field
    cross_arcsec, roll_arcsec
        Errors; NaN without a solution
    """

    trial: int
    point: int
    value: float
    status: str
    cross_arcsec: float
    roll_arcsec: float
    tilt_deg: float
    azimuth_deg: float
    ra_deg: float
    dec_deg: float
    lights: float
    yaw_deg: float = math.nan
    pitch_deg: float = math.nan
    roll_deg: float = math.nan

    @property
    def direction(self) -> str:
        """The direction in words."""
        if math.isfinite(self.tilt_deg):
            return f"tilt {self.tilt_deg:.1f}°, azimuth {self.azimuth_deg:.0f}°"
        return f"RA {self.ra_deg:.1f}°, Dec {self.dec_deg:+.1f}°"

    @property
    def start(self) -> str:
        """The setting that starts a scene at the attitude; empty under the stars, where the direction is enough."""
        if math.isnan(self.yaw_deg):
            return ""
        angles = ", ".join(
            f"{name}: {getattr(self, name):.3f}"
            for name in ("roll_deg", "pitch_deg", "yaw_deg")
        )
        return f"motion.start: {{{angles}}}"

    @property
    def event(self) -> str:
        """What happened, in words."""
        if math.isnan(self.cross_arcsec):
            return self.status
        status = "" if self.status == "solved" else f"{self.status}, "
        return f"{status}cross {self.cross_arcsec:.3g}″, roll {self.roll_arcsec:.4g}″"


def worst_trials(
    columns: Columns, response: str, count: int = COUNT, flights: bool = False
) -> list[WorstTrial]:
    """The worst trials by a response or a quantity, worst first, unless `flights` with directions APART_DEG apart.

    For a proportion they are trials that count for it (for `identified`, that do not): trials without a solution first,
    then by error and by the number of lights. None if there is no such trial.
    """
    keys, values = ranking(columns, response)
    counted = np.isfinite(values)
    near = math.inf if flights else NEAR
    axis = np.empty((0, 3))
    chosen = list[WorstTrial]()
    for rows in worst_first(keys, np.flatnonzero(counted)):
        unit = unit_directions(subset(columns, rows))
        left = np.all(~(unit @ axis.T > near), axis=1)
        while len(chosen) < count and left.any():
            nearest = int(np.argmax(left))
            row = int(rows[nearest])
            chosen.append(worst_trial(row_of(columns, row), float(values[row]), flights))
            left[nearest] = False
            left &= ~(unit @ unit[nearest] > near)
            axis = np.concatenate([axis, unit[nearest : nearest + 1]])
        if len(chosen) == count:
            break
    return chosen


def worst_first(keys: Sequence[Floats], rows: Ints) -> Iterator[Ints]:
    """Rows in the order of their keys, in blocks: about FIRST, then ten times as many, since few are needed."""
    most = FIRST
    while len(rows) and keys:
        first = keys[0][rows]
        limit = np.partition(first, most - 1)[most - 1] if most < len(rows) else first.max()
        below = rows[first < limit]
        yield below[np.lexsort([key[below] for key in reversed(keys)])]
        yield from worst_first(keys[1:], rows[first == limit])
        rows = rows[first > limit]
        most = 10 * most
    if len(rows):
        yield rows


def worst_trial(columns: Columns, value: float, flight: bool) -> WorstTrial:
    """The trial in columns of a single trial."""
    return WorstTrial(
        int(columns["trial"][0]),
        int(columns["point"][0]),
        value,
        "misidentified" if columns["misidentified"][0] > 0 else str(columns["status"][0]),
        *(float(QUANTITIES[name](columns)[0]) for name in ("cross_arcsec", "roll_arcsec")),
        *(float(columns[name][0]) for name in DIRECTION),
        *([] if flight else body_angles_deg(columns)),
    )


def body_angles_deg(columns: Columns) -> list[float]:
    """Yaw, pitch and roll of a trial's body under a dome; none under the stars, where the lab is the sky."""
    wxyz = [float(columns[f"lab_from_body_{part}"][0]) for part in "wxyz"]
    if not np.isfinite([columns["body_tilt_deg"][0], *wxyz]).all():
        return []
    return Rotation.from_quat(wxyz, scalar_first=True).as_euler("ZYX", degrees=True).tolist()


def unit_directions(columns: Columns) -> Floats:
    """(N, 3) direction of each trial's attitude: the body's z axis in the lab, or the boresight on the sky."""
    in_dome = np.isfinite(columns["body_tilt_deg"])
    body = columns["body_tilt_deg"], columns["body_azimuth_deg"]
    boresight = 90 - columns["boresight_dec_deg"], columns["boresight_ra_deg"]
    zenith, azimuth = np.radians(np.where(in_dome, body, boresight))
    return directions(zenith, azimuth)


def ranked(response: str) -> str:
    """What ranks the trials by a response: its quantity, or the proportion itself."""
    quantity = response if response in QUANTITIES else split_name(response)[0]
    return quantity if quantity in QUANTITIES else response


def ranking(columns: Columns, response: str) -> tuple[list[Floats], Floats]:
    """(N,) sort keys, the most important first, smaller is worse; and (N,) values, NaN if a trial does not qualify."""
    angle = QUANTITIES["angle_arcsec"](columns)
    unsolved_first = np.where(np.isnan(angle), -np.inf, -angle)
    fewest_first = np.nan_to_num(columns["stars"], nan=0.0)
    quantity = ranked(response)
    if COVERAGE.match(response):
        return [fewest_first], np.where(columns["frames"] > 0, columns["stars"], np.nan)
    if quantity in QUANTITIES:
        values = QUANTITIES[quantity](columns)
        key = values if quantity in MORE_IS_BETTER else -values
        return [key, fewest_first], values
    flags = (
        (columns["frames"] > 0) & ~right_within(response, columns)
        if WITHIN.match(response)
        else FLAGS.get(response, lambda c: c[response])(columns)
    )
    flagged = np.nan_to_num(np.asarray(flags, dtype=float))
    return [-flagged, unsolved_first, fewest_first], positive(flagged)


def worst_of_levels(
    study: Study, store: Store, response: str, levels: Mapping[str, Any], count: int = COUNT
) -> list[WorstTrial]:
    """The worst trials of the points at some levels. Raises InputError for an unknown factor or level."""
    chosen = without_responses(study, store.points()).at(levels)
    columns = store.point_columns(*(row.point for row in chosen))
    return worst_trials(columns, response, count, study.trial.kind == "flight")
