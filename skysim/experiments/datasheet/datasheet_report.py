"""The report of a datasheet: its sections with their figures, which are also written as files."""

import csv
import math
import shlex
from collections.abc import Callable
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np

from skysim.core.files import make_folder, write_bytes, write_json
from skysim.core.paths import DATA
from skysim.core.types import Floats, Record
from skysim.experiments.datasheet import performance, variance_components
from skysim.experiments.datasheet.cells import MeasuredFrames
from skysim.experiments.datasheet.statement import (
    NAMES,
    Statement,
    StatementSection,
    bounded,
    percent,
    sections,
    sizes,
)
from skysim.results.plots import INK, png
from skysim.results.report import (
    Block,
    Column,
    Figure,
    Items,
    Report,
    Section,
    Table,
    Text,
    Verdict,
    figure_files,
)

ECSS_TERMS = (
    DATA / "ecss_terms.csv"
)  # terms of the standard, their sections, how they are measured

# Figures of a datasheet.


def draw_terms(statement: Statement, fig: Any) -> None:
    """Terms as bars with their intervals, across and about the boresight."""
    shown = [
        name
        for name in variance_components.Components._fields
        if name != "thermal" or statement.sheet.designer.states > 1
    ]
    for axes, (group, table) in zip(fig.subplots(1, 2), statement.terms.items(), strict=True):
        for n, name in enumerate(shown):
            low, value, high = (
                math.sqrt(max(x, 0)) for x in np.array(table.squares[name])[[1, 0, 2]]
            )
            axes.barh(n, value, color=INK[n], height=0.6)
            axes.plot([low, high], [n, n], color="#222222")
        axes.set_yticks(range(len(shown)), [NAMES[name] for name in shown])
        axes.invert_yaxis()
        axes.set_xlabel(f"{group} the boresight, 1 σ of one axis [″]")


def draw_causes(statement: Statement, fig: Any) -> None:
    """Ratio of the mean square after each change to that before it."""
    axes = fig.subplots()
    places = np.arange(len(statement.causes))
    for n, group in enumerate(variance_components.GROUPS):
        value, *ends = 100 * np.array([one[group] for one in statement.causes]).T
        bars = np.abs(ends - value)
        label = f"{group} the boresight"
        axes.errorbar(value, places + 0.2 * n, xerr=bars, fmt="o", color=INK[n], label=label)
    axes.axvline(100, color="#888888")
    axes.set_yticks(places, [one["cause"] for one in statement.causes])
    axes.invert_yaxis()
    axes.set_xlabel("what is left of the mean square [%]")
    axes.legend()


def draw_sky(statement: Statement, fig: Any) -> None:
    """Where frames are solved: boresights on the sky, or tilts of the vehicle."""
    sheet = statement.sheet
    rows = sheet.rows("sky")
    if sheet.designer.under_stars:
        axes = fig.add_subplot(projection="mollweide")
        longitude = np.radians((sheet.columns["boresight_ra_deg"][rows] + 180) % 360 - 180)
        place = -longitude, np.radians(sheet.columns["boresight_dec_deg"][rows])
    else:
        axes = fig.add_subplot(projection="polar")
        place = (
            np.radians(sheet.columns["body_azimuth_deg"][rows]),
            sheet.columns["body_tilt_deg"][rows],
        )
    right = sheet.right(rows)
    false = sheet.false(rows)
    kinds = {"right": right, "refused": ~right & ~false, "false": false}
    for n, (name, chosen) in enumerate(kinds.items()):
        if chosen.any() or name == "right":
            x, y = (part[chosen] for part in place)
            axes.plot(
                x, y, ".", color=INK[n], markersize=2 if name == "right" else 5, label=name
            )
    axes.legend(loc="lower right", bbox_to_anchor=(1.15, 0))


def draw_by(name: str, key: str, label: str, statement: Statement, fig: Any) -> None:
    """Noise-equivalent angle, error and fraction of right attitudes in a field's rows, against a quantity."""
    rows = getattr(statement, name)
    errors, share = fig.subplots(1, 2)
    x = [row[key] for row in rows]
    for n, group in enumerate(variance_components.GROUPS):
        for kind, style in (("NEA", "o-"), ("rms", "s--")):
            what = f"{kind.lower()}_{group}"
            ends = np.array([row["intervals"][what] for row in rows]).T
            values = np.array([row[what] for row in rows])
            draw_bars(errors, x, values, ends, style, color=INK[n], label=f"{kind} {group}")
    # The intervals of few fields may go on beyond the axis.
    known = np.array([row[what] for row in rows for what in row["intervals"]])
    known = known[np.isfinite(known)]
    errors.set_yscale("log")
    if known.size:
        errors.set_ylim(known.min() / 3, known.max() * 3)
    errors.set_ylabel("one axis [″]")
    errors.legend()
    draw_right(share, x, rows)
    for axes in (errors, share):
        axes.set_xlabel(label)


def draw_right(axes: Any, x: list[float], rows: list[Record], **options: Any) -> None:
    """Percentages of right attitudes with their exact bounds."""
    found = 100 * np.array([row["counts"].share("right")[:3] for row in rows])
    draw_bars(axes, x, found[:, 0], found[:, 1:].T, "o-", **{"color": INK[2]} | options)
    axes.set_ylabel("right attitudes [%]")


def draw_bars(
    axes: Any, x: list[float], values: Floats, ends: Floats, style: str, **options: Any
) -> None:
    """A curve with the bars of its intervals, (2, N) ends; a value without an interval has none."""
    bars = np.nan_to_num(np.abs(ends - values))
    axes.errorbar(x, values, bars, fmt=style, elinewidth=0.8, capsize=1.5, **options)


def draw_exclusions(statement: Statement, fig: Any) -> None:
    """Fraction of right attitudes against the angle from a body."""
    axes = fig.subplots()
    for n, body in enumerate(("sun", "moon")):
        rows = [row for row in statement.exclusions if row["body"] == body]
        off_deg = [row["off_deg"] for row in rows]
        draw_right(axes, off_deg, rows, color=INK[n], label=body.capitalize())
    axes.set_xlabel("angle of the boresight from the body [°]")
    axes.legend()


# Drawing function, size in inches, and caption.
FIGURES: dict[str, tuple[Callable[[Statement, Any], None], tuple[float, float], str]] = {
    "terms": (
        draw_terms,
        (9, 2.6),
        "The terms of the error, with 95 % intervals over the fields (ensemble).",
    ),
    "causes": (
        draw_causes,
        (9, 3.4),
        "What each change of the scene leaves of the error's mean square (ensemble).",
    ),
    "sky": (
        draw_sky,
        (7, 3.6),
        "Where the frames are solved lost in space, at rest (ensemble).",
    ),
    "rates": (
        partial(draw_by, "rates", "rate_deg_s", "rate [°/s]"),
        (9, 3),
        "By rate: NEA (temporal), rms (ensemble), 95 % intervals over the fields; right attitudes, exact bounds.",
    ),
    "boresight": (
        partial(draw_by, "boresight_rates", "rate_deg_s", "rate about the boresight [°/s]"),
        (9, 3),
        "By rate about the boresight: NEA (temporal), rms (ensemble), right attitudes.",
    ),
    "exclusions": (
        draw_exclusions,
        (7, 3),
        "Right attitudes by the angle from Sun and Moon, with exact bounds.",
    ),
    "magnitudes": (
        partial(draw_by, "magnitudes", "limit_mag", "faintest star of the catalog [V]"),
        (9, 3),
        "By magnitude limit: NEA (temporal), rms (ensemble), and right attitudes.",
    ),
}


# Sentences on the whole sheet.


def failed_checks(statement: Statement) -> list[str]:
    """Sentences on what the sheet's own checks contradict: missing terms, a sum unlike the total, a negative term."""
    found = []
    if statement.refusal:
        found.append(f"The error terms are not stated. Fields {statement.refusal.fault}.")
    for name, table in statement.terms.items():
        if variance_components.sign(table.ratio, 1.0):
            found.append(
                f"The terms {name} the boresight do not add up: their sum over the mean square of other frames is"
                f" {bounded(table.ratio)}, which does not hold 1."
            )
        found += [
            f"The variance of {NAMES[term]} {name} the boresight is negative."
            for term, sign in table.signs.items()
            if sign < 0
        ]
    return found


def left_out(statement: Statement) -> list[str]:
    """What the sheet does not state, each with the reason."""
    sheet = statement.sheet
    sky = sheet.designer.under_stars
    reasons = {
        "Exclusion angles": (
            statement.exclusions,
            "the scene has no camera.baffle, whose stray light limits the angle"
            if sky
            else "a dome has no Sun and no Moon",
        ),
        "Tracking mode": (
            statement.tracked_rates,
            "the tracker has none" if sky else "a dome's tracker has none",
        ),
        "Magnitude limits": (statement.magnitudes, "a dome's tracker has a map, no catalog"),
        "Thermo-elastic error": (
            sheet.designer.states > 1,
            "the scene has no section thermal",
        ),
    }
    return [f"{name}: {reason}." for name, (stated, reason) in reasons.items() if not stated]


# The statement as numbers for JSON.


def as_numbers(value: Any) -> Any:
    """A value for JSON: named tuples as mappings."""
    if isinstance(value, performance.Counts):
        shares = {kind: value.share(kind)._asdict() for kind in ("right", "refused", "false")}
        return value._asdict() | {"shares": shares}
    if hasattr(value, "_asdict"):
        return as_numbers(value._asdict())
    if isinstance(value, dict):
        return {key: as_numbers(one) for key, one in value.items()}
    return [as_numbers(one) for one in value] if isinstance(value, list | tuple) else value


def numbers(statement: Statement) -> Record:
    """The statement for JSON; squares in arcsec^2 of one axis.

    Numbers outside `rates`, `accelerations` and those of tracking mode hold at `rate_deg_s`.
    """
    sheet = statement.sheet
    head = {
        "scene": sheet.scene.name,
        "title": sheet.scene.title,
        "overrides": dict(sheet.overrides),
        "failed_checks": failed_checks(statement),
        "seed": sheet.scene.seed,
        "rate_deg_s": 0.0,
        "fields": sheet.size.fields,
        "units": sheet.designer.units,
        "states_c": sheet.designer.temperatures_c,
        "frames": sheet.columns["trial"].size,
        "fields_solved": statement.fields,
        "limits": limits(statement),
    }
    parts = statement._asdict()
    del parts["sheet"], parts["refusal"], parts["fields"]
    return head | as_numbers(parts)


def limits(statement: Statement) -> Record:
    """The limits of acquisition and of tracking in rate and acceleration."""
    measured = {
        "acquisition": (statement.rates, statement.accelerations),
        "tracking": (statement.tracked_rates, statement.tracked_accelerations),
        "about the boresight": (statement.boresight_rates,),
    }
    found = {
        mode: {
            key: performance.bracket(rows, key)
            for key, rows in zip(performance.UNITS, tables, strict=False)
        }
        for mode, tables in measured.items()
        if tables[0]
    }
    return as_numbers(found)


STANDARD = (
    "Terms in the sense of ECSS-E-ST-60-20C (star sensors: terminology and performance specification). The numbers"
    " are of the simulated scene; compliance with the standard is not claimed."
)
PRINTED = 3  # number of sections on a terminal: the terms, their causes and the probabilities


def command(sheet: MeasuredFrames, options: list[str]) -> str:
    """The shell command that repeats the datasheet; `options` without those of the scene and its fields."""
    words = ["skysim", "datasheet", sheet.scene_name, *options]
    for key, value in sheet.overrides.items():
        words += ["--seed", value] if key == "seed" else ["--set", f"{key}={value}"]
    return shlex.join([*words, "--fields", str(sheet.size.fields)])


def datasheet_report(statement: Statement, options: list[str]) -> Report:
    """The report of a statement, measured with these options of the command (`command`)."""
    sheet = statement.sheet
    shown = [
        Section(one.title, section_blocks(one, statement), on_terminal=n < PRINTED)
        for n, one in enumerate(sections(statement))
    ]
    failed = [Verdict(line, "bad") for line in failed_checks(statement)]
    text = Text(f"{STANDARD} {sheet.columns['trial'].size} frames.", on_terminal=False)
    return Report(
        f"Datasheet: {sheet.scene.title}",
        [
            *failed,
            verdict(statement),
            text,
            *shown,
            Section("Not on this sheet", [Items(left_out(statement))]),
            standard_section(statement),
        ],
        command(sheet, options),
    )


def verdict(statement: Statement) -> Verdict:
    """How often an attitude is right, and its error."""
    right = percent(statement.counts.share("right"))
    errors = [
        f"{sizes(table, 'total')[0]}″ {name}" for name, table in statement.terms.items()
    ]
    size = f"; error of one axis at rest (1 σ) {', '.join(errors)} the boresight" * bool(
        errors
    )
    return Verdict(
        f"{right} % of frames lost in space have a right attitude, {statement.counts.false} of"
        f" {statement.counts.frames} a false one{size}.",
        "bad" if statement.counts.false else "good",
    )


def section_blocks(section: StatementSection, statement: Statement) -> list[Block]:
    """A section's texts, figures and table."""
    texts = [Text(text) for text in section.texts]
    figures = []
    for name in section.figures:
        draw, size_in, caption = FIGURES[name]
        figures.append(Figure(png(partial(draw, statement), size_in), caption, name=name))
    first, *others = section.headers
    columns = [
        Column(head, kind="aside" if head == "what it is" else "number") for head in others
    ]
    return [*texts, *figures, Table([first, *columns], section.rows)]


# The second page.


def standard_section(statement: Statement) -> Section:
    """The terms that a specification by the standard has, where this sheet has them, and how it measures them."""
    stated = {one.title for one in sections(statement)}
    rows = []
    for term, title, how in list(csv.reader(ECSS_TERMS.read_text().splitlines()))[1:]:
        where = title if title in stated else "not on this sheet" if how else "not here"
        rows.append([term, where, how])
    title = "What ECSS practice asks and where it is here"
    return Section(title, [Table(("term", "section", "how"), rows)], on_terminal=False)


def write_all(folder: Path, statement: Statement, report: Report) -> dict[str, Path]:
    """Write JSON, figures and page to a folder; return the paths of JSON and page by kind."""
    make_folder(folder)
    for name, figure in figure_files(report.blocks):
        write_bytes(folder / name, figure.image)
    paths = {"json": folder / "datasheet.json", "report": folder / "datasheet.html"}
    write_json(paths["json"], numbers(statement))
    report.save(paths["report"])
    return paths
