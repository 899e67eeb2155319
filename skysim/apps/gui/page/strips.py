"""Strip charts of a flight: curves against a common time axis, one chart above the other, drawn by strips.js."""

import math
from collections.abc import Sequence
from dataclasses import field
from functools import partial
from operator import attrgetter

import numpy as np
from nicegui import ui

from skysim.apps.gui.messages import Curves, FlightRow, Residual
from skysim.apps.gui.views.style import CURVE_COLORS
from skysim.core.types import frozen
from skysim.results.scoring import FrameRow

FLOOR = 1e-3  # arcsec; lower limit of errors on a logarithmic axis
SAME_TIME_DIGITS = (
    6  # decimals of the times, in seconds, in which frames of two flights must agree
)
MAX_DOTS = 20_000  # maximum number of dots; if there are more, some frames are left out
Points = list[list[float]]


@frozen
class StripCurve:
    """One curve of a strip.

    Attributes
    ----------
    kind
        line, dots (a value per frame), or band (an area of 3 standard errors)
    """

    name: str
    points: Points
    kind: str = "line"


@frozen
class Strip:
    """One chart with its unit in the title.

    Attributes
    ----------
    dots
        Dots of lights, drawn by strips.js: time, value, number of the light
    """

    title: str
    curves: tuple[StripCurve, ...] = ()
    logarithmic: bool = False
    dots: Points = field(default_factory=list)


class Strips(ui.element, component="js/strips.js"):  # type: ignore[call-arg]
    """The chart, implemented in strips.js; a click on a strip emits `moment` with the time there."""

    def __init__(self) -> None:
        super().__init__()
        self.props["colors"] = CURVE_COLORS


def strips(
    rows: Sequence[FlightRow],
    log: Curves,
    residuals: Sequence[Residual] = (),
    reference: Sequence[FlightRow] = (),
) -> list[Strip]:
    """Return the strips for which a flight has data.

    Parameters
    ----------
    residuals
        Residuals of the identified lights, as in `FlightStep`
    reference
        Rows of another flight, from which the errors are subtracted where frames have the same time
    """
    of_frames = partial(frame_curve, rows)

    def of_motion(name: str) -> StripCurve:
        return StripCurve(name, [*map(point, log.get("t_s", ()), log.get(name, ()))])

    found = [
        *error_strips(rows, same_times(rows, reference)),
        Strip(
            "attitude error, ″",
            (
                *map(of_motion, ("pointing", "IMU alone", "filter")),
                of_frames("innovation", "innovation_arcsec", "dots"),
            ),
            logarithmic=True,
        ),
        Strip(
            "lights",
            (
                of_frames("in the field", "lights"),
                of_frames("identified", "row.matched"),
            ),
        ),
        Strip("residual of each light, px", dots=thinned(residuals)),
        Strip("rate, °/s", (of_motion("rate"),)),
        Strip("momentum, N m s", (of_motion("momentum"),)),
    ]
    return [one for one in found if one.dots or any(curve.points for curve in one.curves)]


def error_strips(
    rows: Sequence[FlightRow], pairs: Sequence[tuple[FrameRow, FrameRow]]
) -> list[Strip]:
    """The errors of each frame with their standard errors, and the changes from another flight's frame."""
    of_frames = partial(frame_curve, rows)
    change = partial(change_curve, pairs)
    return [
        Strip(
            "cross-boresight error, ″",
            (
                of_frames("tracker", "row.cross_arcsec", "dots", least=FLOOR),
                of_frames("3σ", "row.cross_sigma_arcsec", "band", 3),
            ),
            logarithmic=True,
        ),
        Strip(
            "roll error, ″",
            (
                of_frames("tracker", "row.roll_arcsec", "dots"),
                of_frames("−3σ", "row.roll_sigma_arcsec", "band", -3),
                of_frames("+3σ", "row.roll_sigma_arcsec", "band", 3),
            ),
        ),
        Strip(
            "error minus that of the reference, ″",
            (change("cross", "cross_arcsec"), change("roll", "roll_arcsec")),
        ),
    ]


def frame_curve(
    rows: Sequence[FlightRow],
    name: str,
    field: str,
    kind: str = "line",
    factor: int = 1,
    least: float = -math.inf,
) -> StripCurve:
    """A number of each frame by its time, times a factor, and at least a lower limit."""
    found = ((one.row.t_s, factor * attrgetter(field)(one)) for one in rows)
    points = [point(t_s, max(value, least)) for t_s, value in found if value == value]
    return StripCurve(name, points, kind)


def change_curve(
    pairs: Sequence[tuple[FrameRow, FrameRow]], name: str, field: str
) -> StripCurve:
    """By how much a number of a frame exceeds that of the other flight's frame of the same time."""
    error = attrgetter(field)
    found = ((row.t_s, error(row) - error(old)) for row, old in pairs)
    return StripCurve(
        name, [point(t_s, value) for t_s, value in found if value == value], "dots"
    )


def same_times(
    rows: Sequence[FlightRow], others: Sequence[FlightRow]
) -> list[tuple[FrameRow, FrameRow]]:
    """The frames of two flights that have the same time."""
    by_time = {round(one.row.t_s, SAME_TIME_DIGITS): one.row for one in others}
    found = ((one.row, by_time.get(round(one.row.t_s, SAME_TIME_DIGITS))) for one in rows)
    return [(row, other) for row, other in found if other]


def point(t_s: float, value: float) -> list[float]:
    """A point of a curve, rounded to the digits that are drawn."""
    return [float(f"{t_s:.4f}"), float(f"{value:.5g}")]


def thinned(residuals: Sequence[Residual]) -> Points:
    """The residuals as dots: of all frames or, if they are more than MAX_DOTS, of frames at equal steps."""
    times_s = sorted({one.t_s for one in residuals})
    kept = set(times_s[:: max(math.ceil(len(residuals) / MAX_DOTS), 1)])
    return [
        [round(t_s, 4), float(f"{px:.3g}"), id] for t_s, id, px, _ in residuals if t_s in kept
    ]


def rms_line(rows: Sequence[FlightRow]) -> str:
    """Root mean squares over the flight's solved frames, and how many were solved, and wrong."""
    solved = [one.row for one in rows if one.row.estimate_deg]
    if not solved:
        return f"{len(rows)} frames, none solved" if rows else ""
    errors = [(row.cross_arcsec, row.roll_arcsec) for row in solved]
    cross, roll = np.sqrt(np.mean(np.square(errors), axis=0))
    wrong = sum(row.wrong for row in solved)
    return f"{len(solved)} of {len(rows)} frames solved, {wrong} wrong; rms: cross {cross:.3g}″, roll {roll:.3g}″"
