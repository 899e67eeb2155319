"""The statement of a datasheet: what was measured, as numbers for JSON and as sections of tables for pages."""

import math
from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from skysim.core.errors import InputError
from skysim.core.types import Record
from skysim.experiments.datasheet import performance, variance_components
from skysim.experiments.datasheet.cells import TRACKED, MeasuredFrames
from skysim.experiments.datasheet.performance import Counts, Rows, bracket_text
from skysim.experiments.datasheet.variance_components import Bounded, Components
from skysim.results.metrics import TAILS, Summary

NAMES = {
    "bias": "bias",
    "thermal": "thermo-elastic",
    "field": "field-of-view spatial",
    "pixel": "pixel spatial",
    "temporal": "temporal noise",
    "total": "sum",
}
Texts = list[str]
ENSEMBLE = "ensemble: over fields, units and noise, each frame on its own"
ONE_UNIT = "ensemble: over fields and noise, for the first unit in its first thermal state"
TEMPORAL = "temporal: over frames of one attitude that differ in their noise"


class StatementSection(NamedTuple):
    """A section of the statement: text on its numbers, their table, and names of figures (`datasheet_report`)."""

    title: str
    texts: Sequence[str]
    headers: Sequence[str]
    rows: Sequence[Sequence[str]]
    figures: Sequence[str] = ()


class Statement(NamedTuple):
    """All numbers of a datasheet, and the measured frames that they are from.

    `refusal` is the reason if too few fields are solved for the error terms; then `terms` and `bias` are empty.
    """

    sheet: MeasuredFrames
    refusal: InputError | None
    terms: dict[str, variance_components.TermTable]
    fields: int
    bias: list[Bounded]
    causes: Rows
    counts: Counts
    claims: Rows
    quantiles: Rows
    consistency: Record
    rates: Rows
    boresight_rates: Rows
    accelerations: Rows
    tracked_rates: Rows
    tracked_accelerations: Rows
    magnitudes: Rows
    disturbances: Rows
    exclusions: Rows
    times_s: list[float]
    timing: Record


def state(sheet: MeasuredFrames) -> Statement:
    """The statement of a measured sheet, with times on this machine."""
    _, solved = variance_components.term_errors(sheet, least=0)
    refusal = None
    tables: dict[str, variance_components.TermTable] = {}
    bias: list[Bounded] = []
    try:
        tables = variance_components.term_tables(sheet)
        bias = variance_components.mean_errors(sheet)
    except InputError as error:
        refusal = error
    found = performance.counts(sheet, sheet.rows("sky"))
    times_s = performance.solution_times_s(sheet).tolist()
    return Statement(
        sheet,
        refusal,
        tables,
        int(solved.sum()),
        bias,
        variance_components.causes(sheet),
        found,
        performance.claims(found),
        performance.quantiles(sheet),
        performance.consistency(sheet),
        performance.by_rate(sheet, "rate"),
        performance.by_rate(sheet, "boresight"),
        performance.by_level(sheet, "acceleration", "acceleration_deg_s2"),
        performance.by_level(sheet, "tracked rate_deg_s", "rate_deg_s"),
        performance.by_level(sheet, "tracked acceleration_deg_s2", "acceleration_deg_s2"),
        performance.by_level(sheet, "magnitude", "limit_mag"),
        performance.disturbances(sheet),
        performance.exclusions(sheet),
        times_s,
        performance.timing(sheet, times_s),
    )


# As sections.


def sizes(table: variance_components.TermTable, name: str) -> Texts:
    """A term's root mean square and its percentage of the sum; its upper bounds if it is not shown to be above 0."""
    low, high = (max(end, 0.0) for end in table.squares[name][1:])
    total = table.squares["total"].value
    if not table.signs[name]:
        return [f"< {math.sqrt(high):.3g}", f"< {100 * high / total:.1f}"]
    value = table.squares[name].value
    if value < 0:
        return ["negative", f"{100 * value / total:.1f}"]
    text = f"{math.sqrt(value):.3g} ({math.sqrt(low):.3g} to {math.sqrt(high):.3g})"
    return [text, f"{100 * value / total:.1f}"]


def bounded(value: Bounded | Summary, digits: int = 3) -> str:
    """A value with its interval, or that its frames are too few for one."""
    if math.isnan(value.low):
        return "too few to say"
    return f"{value.value:.{digits}g} ({value.low:.{digits}g} to {value.high:.{digits}g})"


def percent(share: Summary) -> str:
    """A fraction in percent with its exact bounds."""
    return f"{100 * share.value:.4g} ({100 * share.low:.4g} to {100 * share.high:.4g})"


def arcsec(value: float) -> str:
    return "-" if math.isnan(value) else f"{value:.3g}"


def sections(statement: Statement) -> list[StatementSection]:
    """All sections, in order."""
    stated = {
        term_section: not statement.refusal,
        lowering_section: True,
        probability_section: True,
        quantile_section: True,
        timing_section: True,
        rate_section: True,
        boresight_section: True,
        acceleration_section: True,
        tracking_section: statement.tracked_rates,
        magnitude_section: statement.magnitudes,
        disturbance_section: True,
        exclusion_section: statement.exclusions,
    }
    return [section(statement) for section, holds in stated.items() if holds]


def term_section(statement: Statement) -> StatementSection:
    """The terms, and their sum beside the total measured at once."""
    sheet = statement.sheet
    tables = statement.terms
    rows = []
    for name in (*Components._fields, "total"):
        if name == "thermal" and sheet.designer.states < 2:
            rows.append(
                [
                    NAMES[name],
                    "not in the scene",
                    "-",
                    "not in the scene",
                    "-",
                    "a scene with section thermal has it",
                ]
            )
            continue
        row = [NAMES[name]]
        for table in tables.values():
            row += sizes(table, name)
        rows.append([*row, variance_components.TERMS.get(name, "of the terms of this scene")])
    ratios = ", ".join(f"{bounded(table.ratio)} {name}" for name, table in tables.items())
    x, y, roll = (bounded(one, 2) for one in statement.bias)
    texts = [
        "Errors of one axis at rest, 1 σ in arcseconds, with 95 % intervals over the fields: across the boresight the"
        f" mean of x and y, about it the roll. Statistical interpretation: {ENSEMBLE}; temporal noise: {TEMPORAL}."
        f" {statement.fields} fields, {sheet.designer.units} units, {sheet.designer.states} thermal states,"
        f" {sheet.size.attitudes} attitudes a few pixels apart, {sheet.size.frames} frames each.",
        f"Sum of the terms' variances over the mean square of {len(sheet.rows('total'))} frames in each of these"
        f" fields, with other attitudes and other noise: {ratios} (95 % for both together).",
        "A term that is not shown to be above 0, at 95 % for all terms together, has its upper bound at 97.5 % alone.",
        f"Mean error about the camera's axes, arcseconds: x {x}, y {y}, roll {roll}.",
    ]
    if sheet.designer.units > 1:
        texts.insert(2, unit_text(sheet.designer.units))
    return StatementSection(
        "Error terms",
        texts,
        ["term", "across ″", "%", "about ″", "%", "what it is"],
        rows,
        ["terms"],
    )


def unit_text(units: int) -> str:
    """The uncertainty from few units, which intervals over the fields leave out (chi-square of a variance)."""
    from scipy.special import chdtri

    freedom = units - 1
    low, high = (math.sqrt(freedom / chdtri(freedom, tail)) for tail in TAILS)
    return (
        f"These intervals are over the fields, for the {units} units that were measured, which both sides of the"
        f" comparison have. Where the bias scatters among units, {units} of them bound its size for all units to a"
        f" factor of {low:.2g} to {high:.2g} (95 %)."
    )


def lowering_section(statement: Statement) -> StatementSection:
    """The dominant term, and the ratio of the mean square after each change of the scene to that before it."""
    texts = [
        f"{name.capitalize()} the boresight {NAMES[table.dominant]} dominates:"
        f" {100 * table.squares[table.dominant].value / table.squares['total'].value:.0f} % of the variance."
        for name, table in statement.terms.items()
    ]
    texts.append(
        "Each change alone, at rest, on the same fields, units and noise as before: what is left of the error's mean"
        " square, in percent, with 95 % intervals. Below 100 the change lowers the error."
    )
    rows = []
    for one in statement.causes:
        percents = (np.array(one[name]) * 100 for name in variance_components.GROUPS)
        rows.append([one["cause"], *(bounded(Bounded(*ratio)) for ratio in percents)])
    return StatementSection(
        "What dominates, and what would lower it",
        texts,
        ["change", "across %", "about %"],
        rows,
        ["causes"],
    )


def probability_section(statement: Statement) -> StatementSection:
    """Probabilities of right, refused and false attitudes, and the claims that the frames support."""
    counts = statement.counts
    where = (
        "the whole sky"
        if statement.sheet.designer.under_stars
        else "the tilts of the vehicle"
    )
    shares = ", ".join(
        f"{kind} {percent(counts.share(kind))} %" for kind in ("right", "refused", "false")
    )
    texts = [
        f"{counts.frames} frames lost in space at rest, each with its own attitude from {where}, unit and noise"
        f" ({ENSEMBLE}). Shares with exact one-sided bounds, each at 95 %: {shares}. A false attitude"
        " is off by more than ten arcminutes and by more than its covariance allows (`metrics.is_wrong`).",
        "A claim needs so many runs without a failure that the upper bound of the failures' probability is below its"
        " complement: n = ln(1 - c) / ln(p), rounded up.",
    ]
    median_ms, high_ms = (
        1000 * quantile for quantile in np.quantile(statement.times_s, (0.5, 0.95))
    )
    texts.append(
        f"Time of a solution lost in space, from pixels to attitude, on the machine that wrote this: median"
        f" {median_ms:.3g} ms, 95 % within {high_ms:.3g} ms ({len(statement.times_s)} frames, one process)."
    )
    if statement.sheet.designer.under_stars:
        texts.append(
            f"Sky coverage, the share of the sky in which a frame is solved: {percent(counts.share('right'))} %."
        )
    rows = [
        [
            f"{100 * one['share']:g} %",
            "yes" if one["shown"] else "no",
            str(one["runs"]),
            str(one["failures"]),
            str(one["without_failure"]),
            str(one["more"]) if not one["shown"] else "-",
        ]
        for one in statement.claims
    ]
    headers = [
        "right attitude in",
        "shown",
        "runs",
        "failures",
        "runs needed without failure",
        "more runs, if none fails",
    ]
    return StatementSection(
        "Right, refused and false attitudes", texts, headers, rows, ["sky"]
    )


def quantile_section(statement: Statement) -> StatementSection:
    """Quantiles of the errors, how well the covariances fit them, and whether x and y have equal errors."""
    found = statement.consistency
    shares = ", ".join(
        f"{percent(one['share'])} % of {100 * one['level']:g} %" for one in found["within"]
    )
    texts = [
        "Errors that a frame at rest stays below with the probability at the left, over independent frames"
        f" ({ENSEMBLE}), with 95 % intervals between order statistics; across is the angle between the boresights.",
        f"The tracker's own covariance: normalized error squared {bounded(found['nees'])}, 3 where it is right;"
        f" within its ellipsoids {shares}. Mean square of y over that of x: {bounded(found['y_over_x'])}.",
    ]
    rows = [
        [
            f"{100 * one['level']:g} %",
            *(quantile_text(one[name]) for name in variance_components.GROUPS),
        ]
        for one in statement.quantiles
    ]
    return StatementSection(
        "Performance at a confidence",
        texts,
        ["probability", "boresight angle ″", "about ″"],
        rows,
    )


def quantile_text(found: Summary) -> str:
    """A quantile with its interval, or the number of further frames that it needs to have one."""
    if math.isnan(found.low):
        return f"not established: {found.needs} more frames needed"
    return bounded(found)


def outcome_cells(row: Record) -> Texts:
    """Cells of a row's outcomes."""
    counts = row["counts"]
    return [percent(counts.share("right")), str(counts.refused), str(counts.false)]


def outcome_row(row: Record) -> Texts:
    """Cells of a row's outcomes, and of the rms errors of its right attitudes, as OUTCOME_HEADERS."""
    return [*outcome_cells(row), arcsec(row["rms_across"]), arcsec(row["rms_about"])]


def pair_cells(row: Record) -> Texts:
    """Cells of a pair of frames: noise-equivalent angle and error, the normalized error squared, and outcomes."""
    errors = [
        arcsec(row[f"{kind}_{name}"])
        for name in variance_components.GROUPS
        for kind in ("nea", "rms")
    ]
    return [*errors, bounded(row["nees"]), *outcome_cells(row)]


OUTCOME_HEADERS = ["right %", "refused", "false", "rms of the right: across ″", "about ″"]
PAIR_HEADERS = ["NEA across ″", "rms across ″", "NEA about ″", "rms about ″", "NEES"]
PAIR_HEADERS += ["both right %", "one refused", "one false"]


def rate_section(statement: Statement) -> StatementSection:
    """Noise-equivalent angle, error and acquisition by rate.

    The relative error of rms and NEA of F fields is 1 / sqrt(2 F) about two axes, 1 / sqrt(F) about one: for two
    Gaussian values per field and axis, if the scatter of the fields' variances doubles the square of the error.
    """
    across, about = (100 / math.sqrt(axes * statement.sheet.size.fields) for axes in (2, 1))
    texts = [
        "Two frames of each attitude that differ in their noise, at a constant rate across the boresight, each lost in"
        f" space. NEA: temporal noise of one axis, 1 σ ({TEMPORAL}). rms: all errors of one axis ({ONE_UNIT})."
        " NEES: normalized error squared of this unit; over all units 3 where the tracker's own covariance is right."
        " Shares are of attitudes that are right in both frames."
        f" NEA and rms are known to about {across:.0f} % across and {about:.0f} % about the boresight (1 σ). Each row"
        " holds at its rate, and nothing is known beyond"
        f" {statement.rates[-1]['rate_deg_s']:g} °/s.",
        bracket_text("acquisition in rate", statement.rates, "rate_deg_s"),
    ]
    return StatementSection(
        "By rate", texts, RATE_HEADERS, rate_rows(statement.rates), ["rates"]
    )


RATE_HEADERS = ["rate °/s", "streak px", *PAIR_HEADERS]


def rate_rows(rows: Rows) -> list[Texts]:
    """The cells of rows by rate."""
    return [
        [f"{row['rate_deg_s']:g}", f"{row['streak_px']:.3g}", *pair_cells(row)]
        for row in rows
    ]


def boresight_section(statement: Statement) -> StatementSection:
    """Noise-equivalent angle, error and acquisition by the rate about the boresight."""
    texts = [
        "As above, for a constant rate about the boresight: streaks are longest at the edge of the field, none in its"
        " center. The streak is the mean over the field.",
        bracket_text(
            "acquisition in rate about the boresight", statement.boresight_rates, "rate_deg_s"
        ),
    ]
    rows = rate_rows(statement.boresight_rates)
    return StatementSection(
        "By rate about the boresight", texts, RATE_HEADERS, rows, ["boresight"]
    )


def timing_section(statement: Statement) -> StatementSection:
    """Update rate and latency."""
    found = statement.timing
    texts = [
        "The update rate is that of the scene's frames. The latency is the age of an attitude when it is known, from"
        " mid-exposure on: its solution is lost in space, on the machine that wrote this.",
    ]
    if found["rate_hz"] > found["greatest_rate_hz"]:
        texts.append(
            "Not every frame can be solved before the next one on this machine: the solution of one in twenty takes"
            " longer than a period."
        )
    milliseconds = {
        "half of the exposure": "half_exposure_s",
        "read-out of the rows": "readout_s",
        "solution (median)": "solution_s",
        "latency": "latency_s",
    }
    rows = [
        ["update rate, Hz", f"{found['rate_hz']:g}"],
        ["Hz at which 95 % of the solutions are in time", f"{found['greatest_rate_hz']:.3g}"],
    ]
    rows += [
        [f"{text}, ms", f"{1000 * found[key]:.3g}"] for text, key in milliseconds.items()
    ]
    return StatementSection("Update rate and latency", texts, ["what", "value"], rows)


def exclusion_section(statement: Statement) -> StatementSection:
    """Outcomes and errors beside the Sun and the Moon."""
    texts = [
        "Lost in space at rest with the boresight at an angle from the center of a body, whose light the scene's"
        f" baffle lets through (`camera.baffle`). One frame in each field ({ONE_UNIT});"
        " the other bodies shine too. For the Earth's limb and the"
        " share of an orbit in which all angles are kept see `skysim availability`.",
    ]
    for body in ("sun", "moon"):
        beside = [row for row in statement.exclusions if row["body"] == body]
        texts.append(
            bracket_text(f"the angle from the {body.capitalize()}", beside, "off_deg")
        )
    rows = [
        [row["body"].capitalize(), f"{row['off_deg']:g}", *outcome_row(row)]
        for row in statement.exclusions
    ]
    headers = ["body", "angle °", *OUTCOME_HEADERS]
    return StatementSection("Exclusion angles", texts, headers, rows, ["exclusions"])


def acceleration_section(statement: Statement) -> StatementSection:
    """Error and acquisition by acceleration."""
    texts = [
        "Two frames of each attitude, with no rate at mid-exposure and a constant acceleration across the boresight"
        f" ({ONE_UNIT}). Errors are relative to the mean attitude over the exposure, which is a T² / 24 from that at"
        " mid-exposure.",
        bracket_text(
            "acquisition in acceleration", statement.accelerations, "acceleration_deg_s2"
        ),
    ]
    rows = [
        [f"{row['acceleration_deg_s2']:g}", *pair_cells(row)]
        for row in statement.accelerations
    ]
    headers = ["acceleration °/s²", *PAIR_HEADERS]
    return StatementSection("By acceleration", texts, headers, rows)


def tracking_section(statement: Statement) -> StatementSection:
    """Error and outcomes in tracking mode."""
    rates = statement.tracked_rates
    accelerations = statement.tracked_accelerations
    texts = [
        f"Two frames of each attitude that differ in their noise, solved in tracking mode after {TRACKED} frames of the"
        " same motion, without a gyro: stars are detected in windows of 8 pixels around their predicted places. A frame"
        " that only the lost-in-space search would solve counts as refused. The prediction extrapolates the rate"
        " between the last two frames, and its change by the lengths of the streaks. Without the change, an"
        " acceleration a misses by a t².",
        bracket_text("tracking in rate", rates, "rate_deg_s"),
        bracket_text("tracking in acceleration", accelerations, "acceleration_deg_s2"),
    ]
    rows = [[f"{row['rate_deg_s']:g}", "", *pair_cells(row)] for row in rates]
    rows += [
        ["", f"{row['acceleration_deg_s2']:g}", *pair_cells(row)] for row in accelerations
    ]
    return StatementSection(
        "In tracking mode",
        texts,
        ["rate °/s", "acceleration °/s²", *PAIR_HEADERS],
        rows,
    )


def magnitude_section(statement: Statement) -> StatementSection:
    """Noise-equivalent angle by the limit of the catalog."""
    texts = [
        "The faintest stars of the tracker's catalog, at rest: two frames of each attitude that differ in their noise"
        f" (NEA: {TEMPORAL}; rms: {ONE_UNIT})."
    ]
    own = statement.sheet.scene.tracker.limit_mag
    rows = [
        [
            f"{row['limit_mag']:g}{' (of the scene)' * (row['limit_mag'] == own)}",
            *pair_cells(row),
        ]
        for row in statement.magnitudes
    ]
    return StatementSection(
        "By magnitude limit",
        texts,
        ["limit V", *PAIR_HEADERS],
        rows,
        ["magnitudes"],
    )


def disturbance_section(statement: Statement) -> StatementSection:
    """Outcomes and errors under disturbances."""
    texts = [
        f"One frame in each field at rest with a disturbance beyond what the scene has ({ONE_UNIT}); the Moon's"
        " frames have attitudes of their own, with the Moon in the field. rms: of one axis, over the right attitudes"
        " alone, which may be those of the fields with the brightest stars. False stars are added to centroids, not to"
        " frames."
    ]
    rows = [[row["disturbance"], *outcome_row(row)] for row in statement.disturbances]
    headers = ["disturbance", *OUTCOME_HEADERS]
    return StatementSection("Under disturbances", texts, headers, rows)
