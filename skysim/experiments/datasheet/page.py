"""Pages of a datasheet: HTML with its figures embedded, Markdown with them beside it, and JSON."""

from __future__ import annotations

import shlex
from pathlib import Path

from skysim.core.io.files import make_folder, to_json, write_bytes, write_text
from skysim.experiments.datasheet.figures import FIGURES
from skysim.experiments.datasheet.run import Sheet
from skysim.experiments.datasheet.statement import Section, Statement, numbers, sections
from skysim.results.plots import png
from skysim.results.report import embed, render_page

STANDARD = (
    "Terms in the sense of ECSS-E-ST-60-20C (star sensors: terminology and performance specification). The numbers"
    " are of the simulated scene; compliance with the standard is not claimed."
)


def command(sheet: Sheet, quick: bool) -> str:
    """The shell command that repeats the datasheet."""
    options = ["--quick"] * quick
    for key, value in sheet.overrides.items():
        options += ["--seed", value] if key == "seed" else ["--set", f"{key}={value}"]
    return shlex.join(["skysim", "datasheet", sheet.scene_name, *options, "--fields", str(sheet.size.fields)])


def figure_png(name: str, statement: Statement) -> bytes:
    """A figure as PNG."""
    drawing = FIGURES[name]
    return png(lambda fig: drawing.draw(fig, statement), drawing.size_in)


def write_all(folder: Path, statement: Statement, quick: bool) -> dict[str, Path]:
    """Write JSON, figures and HTML to a folder; return their paths by kind."""
    made = sections(statement)
    images = {name: figure_png(name, statement) for section in made for name in section.figures}
    for name, image in images.items():
        write_bytes(make_folder(folder) / f"{name}.png", image)
    paths = {"json": folder / "datasheet.json", "report": folder / "datasheet.html"}
    write_text(paths["json"], to_json(numbers(statement)))
    text = render_page(
        "datasheet.html",
        title=f"Datasheet: {statement.sheet.scene.title}",
        command=command(statement.sheet, quick),
        standard=STANDARD,
        frames=statement.sheet.columns["trial"].size,
        sections=made,
        figures={name: (embed(image), FIGURES[name].caption) for name, image in images.items()},
    )
    write_text(paths["report"], text)
    return paths


def write_markdown(path: Path, statement: Statement, quick: bool) -> None:
    """Write the statement as a Markdown page without figures."""
    sheet = statement.sheet
    written_by = f"{command(sheet, quick)} --markdown {path.as_posix()}"
    lines = [f"# Datasheet: {sheet.scene.name}", "", f"{sheet.scene.title}. {STANDARD}", ""]
    lines.append(f"This page is written by `{written_by}`.")
    for section in sections(statement):
        lines += markdown(section)
    write_text(path, "\n".join(lines) + "\n")


def markdown(section: Section) -> list[str]:
    """Lines of a section."""
    lines = ["", f"## {section.title}", ""]
    for text in section.texts:
        lines += [text, ""]
    rows = [section.headers, ["---"] * len(section.headers), *section.rows]
    return lines + [f"| {' | '.join(cell.replace('|', chr(92) + '|') for cell in row)} |" for row in rows]
