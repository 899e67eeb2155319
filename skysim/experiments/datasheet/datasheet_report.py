"""The report of a datasheet: its sections with their figures, which are also written as files."""

from __future__ import annotations

import math
import shlex
from collections.abc import Callable
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np

from skysim.core.files import make_folder, to_json, write_bytes, write_text
from skysim.experiments.datasheet.cells import MeasuredFrames
from skysim.experiments.datasheet.statement import (
    NAMES,
    Statement,
    StatementSection,
    failed_checks,
    numbers,
    percent,
    sections,
    sizes,
)
from skysim.experiments.datasheet.variance_components import GROUPS, Components
from skysim.results.plots import INK, png
from skysim.results.report import Report
from skysim.results.report_blocks import (
    Block,
    Column,
    Figure,
    Section,
    Table,
    Text,
    Verdict,
    figure_files,
)

# Figures of a datasheet.


def draw_terms(statement: Statement, fig: Any) -> None:
    """Terms as bars with their intervals, across and about the boresight."""
    shown = [
        name
        for name in Components._fields
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
    for n, group in enumerate(GROUPS):
        for k, one in enumerate(statement.causes):
            value, low, high = (100 * part for part in one[group])
            axes.plot([low, high], [k + 0.2 * n] * 2, color=INK[n])
            axes.plot(
                value,
                k + 0.2 * n,
                "o",
                color=INK[n],
                label=f"{group} the boresight" if k == 0 else None,
            )
    axes.axvline(100, color="#888888")
    axes.set_yticks(range(len(statement.causes)), [one["cause"] for one in statement.causes])
    axes.invert_yaxis()
    axes.set_xlabel("what is left of the mean square [%]")
    axes.legend()


def draw_sky(statement: Statement, fig: Any) -> None:
    """Where frames are solved: boresights on the sky, or tilts of the vehicle."""
    sheet = statement.sheet
    rows = sheet.rows("sky")
    if sheet.designer.under_stars:
        axes = fig.add_subplot(projection="mollweide")
        longitude = np.radians((sheet.column("boresight_ra_deg", rows) + 180) % 360 - 180)
        place = -longitude, np.radians(sheet.column("boresight_dec_deg", rows))
    else:
        axes = fig.add_subplot(projection="polar")
        place = (
            np.radians(sheet.column("body_azimuth_deg", rows)),
            sheet.column("body_tilt_deg", rows),
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


def draw_by(fig: Any, rows: list[dict[str, Any]], key: str, label: str) -> None:
    """Noise-equivalent angle, error and fraction of right attitudes against a quantity."""
    errors, share = fig.subplots(1, 2)
    x = [row[key] for row in rows]
    for n, group in enumerate(GROUPS):
        for kind, style in (("NEA", "o-"), ("rms", "s--")):
            values = [row[f"{kind.lower()}_{group}"] for row in rows]
            errors.plot(x, values, style, color=INK[n], label=f"{kind} {group}")
    errors.set_yscale("log")
    errors.yaxis.set_major_formatter("{x:g}")
    errors.set_ylabel("one axis [″]")
    errors.legend()
    found = [row["counts"].share("right") for row in rows]
    right = np.array([one.value for one in found])
    ends = np.array([[one.value - one.low, one.high - one.value] for one in found]).T
    share.errorbar(x, 100 * right, 100 * ends, fmt="o-", color=INK[2])
    share.set_ylabel("right attitudes [%]")
    for axes in (errors, share):
        axes.set_xlabel(label)


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
        lambda statement, fig: draw_by(fig, statement.rates, "rate_deg_s", "rate [°/s]"),
        (9, 3),
        "By rate: NEA (temporal), rms (ensemble), and right attitudes with exact bounds.",
    ),
    "magnitudes": (
        lambda statement, fig: draw_by(
            fig, statement.magnitudes, "limit_mag", "faintest star of the catalog [V]"
        ),
        (9, 3),
        "By magnitude limit: NEA (temporal), rms (ensemble), and right attitudes.",
    ),
}


STANDARD = (
    "Terms in the sense of ECSS-E-ST-60-20C (star sensors: terminology and performance specification). The numbers"
    " are of the simulated scene; compliance with the standard is not claimed."
)
PRINTED = 3  # number of sections on a terminal: the terms, their causes and the probabilities


def command(sheet: MeasuredFrames, quick: bool) -> str:
    """The shell command that repeats the datasheet."""
    options = ["--quick"] * quick
    for key, value in sheet.overrides.items():
        options += ["--seed", value] if key == "seed" else ["--set", f"{key}={value}"]
    return shlex.join(
        [
            "skysim",
            "datasheet",
            sheet.scene_name,
            *options,
            "--fields",
            str(sheet.size.fields),
        ]
    )


def datasheet_report(statement: Statement, quick: bool) -> Report:
    """The report of a statement."""
    sheet = statement.sheet
    shown = [
        Section(one.title, section_blocks(one, statement), on_terminal=n < PRINTED)
        for n, one in enumerate(sections(statement))
    ]
    failed = [Verdict(line, "bad") for line in failed_checks(statement)]
    text = Text(f"{STANDARD} {sheet.columns['trial'].size} frames.", on_terminal=False)
    return Report(
        f"Datasheet: {sheet.scene.title}",
        [*failed, verdict(statement), text, *shown],
        command(sheet, quick),
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
    return [*texts, *figures, Table([Column(first, kind="text"), *columns], section.rows)]


def write_all(folder: Path, statement: Statement, report: Report) -> dict[str, Path]:
    """Write JSON, figures and page to a folder; return the paths of JSON and page by kind."""
    make_folder(folder)
    for name, figure in figure_files(report.blocks):
        write_bytes(folder / name, figure.image)
    paths = {"json": folder / "datasheet.json", "report": folder / "datasheet.html"}
    write_text(paths["json"], to_json(numbers(statement)))
    report.save(paths["report"])
    return paths
