"""The report of a datasheet: its sections with their figures, which are written as files too."""

from __future__ import annotations

import shlex
from pathlib import Path

from skysim.core.io.files import make_folder, to_json, write_bytes, write_text
from skysim.experiments.datasheet import statement as statements
from skysim.experiments.datasheet.figures import FIGURES
from skysim.experiments.datasheet.run import Sheet
from skysim.experiments.datasheet.statement import Statement
from skysim.results.plots import png
from skysim.results.report import Block, Column, Figure, Report, Section, Table, Text, Verdict
from skysim.results.report.blocks import figure_files

STANDARD = (
    "Terms in the sense of ECSS-E-ST-60-20C (star sensors: terminology and performance specification). The numbers"
    " are of the simulated scene; compliance with the standard is not claimed."
)
PRINTED = 3  # sections on a terminal: the terms, their causes and the probabilities


def command(sheet: Sheet, quick: bool) -> str:
    """The shell command that repeats the datasheet."""
    options = ["--quick"] * quick
    for key, value in sheet.overrides.items():
        options += ["--seed", value] if key == "seed" else ["--set", f"{key}={value}"]
    return shlex.join(
        ["skysim", "datasheet", sheet.scene_name, *options, "--fields", str(sheet.size.fields)]
    )


def datasheet_report(statement: Statement, quick: bool) -> Report:
    """The report of a statement."""
    sheet = statement.sheet
    sections = [
        Section(one.title, section_blocks(one, statement), on_terminal=n < PRINTED)
        for n, one in enumerate(statements.sections(statement))
    ]
    text = Text(f"{STANDARD} {sheet.columns['trial'].size} frames.", on_terminal=False)
    return Report(
        f"Datasheet: {sheet.scene.title}",
        [verdict(statement), text, *sections],
        command(sheet, quick),
    )


def verdict(statement: Statement) -> Verdict:
    """How often an attitude is right, and its error."""
    across, about = (statements.size(table.squares["total"]) for table in statement.terms.values())
    right = statements.percent(statement.counts.share("right"))
    return Verdict(
        f"{right} % of frames lost in space have a right attitude, {statement.counts.false} of"
        f" {statement.counts.frames} a false one; error of one axis (1 σ) {across}″ across the boresight,"
        f" {about}″ about it.",
        "bad" if statement.counts.false else "good",
    )


def section_blocks(section: statements.Section, statement: Statement) -> list[Block]:
    """A section's texts, figures and table."""
    texts = [Text(text) for text in section.texts]
    figures = [
        Figure(figure_png(name, statement), FIGURES[name].caption, name=name)
        for name in section.figures
    ]
    first, *others = section.headers
    columns = [Column(head, kind="aside" if head == "what it is" else "number") for head in others]
    return [*texts, *figures, Table([Column(first, kind="text"), *columns], section.rows)]


def figure_png(name: str, statement: Statement) -> bytes:
    """A figure as PNG."""
    drawing = FIGURES[name]
    return png(lambda fig: drawing.draw(fig, statement), drawing.size_in)


def write_all(folder: Path, statement: Statement, report: Report) -> dict[str, Path]:
    """Write JSON, figures and the page to a folder; return the paths of JSON and page by kind."""
    make_folder(folder)
    for name, figure in figure_files(report.blocks):
        write_bytes(folder / name, figure.image)
    paths = {"json": folder / "datasheet.json", "report": folder / "datasheet.html"}
    write_text(paths["json"], to_json(statements.numbers(statement)))
    report.save(paths["report"])
    return paths
