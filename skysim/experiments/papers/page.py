"""Reports of reproduced experiments: one HTML page, or a Markdown page with its figures in a folder beside it."""

from __future__ import annotations

import shlex
from collections.abc import Sequence
from pathlib import Path
from typing import NamedTuple

from skysim.core.io.files import make_folder, write_bytes, write_text
from skysim.experiments.papers.compare import VERDICTS, Comparison, Reproduction, format_summary, format_with_source
from skysim.results.plots import png
from skysim.results.report import embed, render_page

KINDS = (*VERDICTS, "derived", "open")


class CommandArguments(NamedTuple):
    """The arguments of the command."""

    ids: tuple[str, ...]
    quick: bool
    seed: int

    @property
    def command(self) -> str:
        """The shell command that repeats the run."""
        seed = ["--seed", str(self.seed)] if self.seed != 1 else []
        return shlex.join(["skysim", "reproduce", *self.ids, *["--quick"] * self.quick, *seed])


def group_by_paper(reproductions: Sequence[Reproduction]) -> dict[str, list[Reproduction]]:
    """Group experiments by paper, in their given order."""
    groups: dict[str, list[Reproduction]] = {}
    for reproduction in reproductions:
        groups.setdefault(reproduction.published.paper, []).append(reproduction)
    return groups


def total_counts(reproductions: Sequence[Reproduction]) -> dict[str, int]:
    """Number of rows of each kind in KINDS, over all experiments."""
    return {kind: sum(one.counts[kind] for one in reproductions) for kind in KINDS}


def write_html(path: Path, reproductions: Sequence[Reproduction], arguments: CommandArguments) -> None:
    """Write one HTML file with embedded figures."""
    figures = {one.id: [(embed(png(d.draw, d.size_in)), d.caption) for d in one.drawings] for one in reproductions}
    text = render_page(
        "papers.html",
        command=arguments.command,
        seed=arguments.seed,
        quick=arguments.quick,
        remarks=remarks,
        papers=group_by_paper(reproductions),
        counts=total_counts(reproductions),
        figures=figures,
        format_summary=format_summary,
        format_with_source=format_with_source,
    )
    write_text(path, text)


def write_markdown(path: Path, reproductions: Sequence[Reproduction], arguments: CommandArguments) -> None:
    """Write a Markdown page, and its figures to a folder of the same name beside it."""
    lines = [HEAD.format(command=arguments.command, seed=arguments.seed)]
    lines += [f"| experiment | {' | '.join(KINDS)} | seconds |", "|---" * (len(KINDS) + 2) + "|"]
    for reproduction in reproductions:
        id, counts = reproduction.id, reproduction.counts
        lines.append(markdown_row([f"[{id}](#{id})", *map(str, counts.values()), f"{reproduction.seconds:.0f}"]))
    lines.append(markdown_row(["all", *map(str, total_counts(reproductions).values())]) + " |")
    folder = make_folder(path.with_suffix(""))
    for paper, group in group_by_paper(reproductions).items():
        lines += [f"\n## {paper}"]
        for reproduction in group:
            lines += markdown_section(reproduction, folder)
    write_text(path, "\n".join(lines) + "\n")


def markdown_section(reproduction: Reproduction, folder: Path) -> list[str]:
    """Lines of an experiment's section; writes its figures to the folder."""
    published = reproduction.published
    lines = [f"\n### {reproduction.id}\n", f"{published.title}. {published.source}.\n"]
    lines += [f"*{heading}:* {text}\n" for heading, text in remarks(reproduction)]
    lines += ["| what | published | ours | verdict | note |", "|---|---|---|---|---|"]
    lines += [markdown_row(table_cells(comparison)) for comparison in reproduction.comparisons]
    for n, drawing in enumerate(reproduction.drawings, 1):
        name = f"{reproduction.id}_{n}.png"
        write_bytes(folder / name, png(drawing.draw, drawing.size_in))
        lines += [f"\n![{drawing.caption}]({folder.name}/{name})\n\n*{drawing.caption}*"]
    return lines


def markdown_row(cells: Sequence[str]) -> str:
    """A row of a Markdown table."""
    return f"| {' | '.join(cells)} |"


def remarks(reproduction: Reproduction) -> list[tuple[str, str]]:
    """(heading, text) of the remarks above an experiment's table."""
    published = reproduction.published
    texts = [
        ("What the paper gets wrong", published.wrong),
        ("Assumed, as the paper gives no value", "; ".join(published.assumed)),
        ("Fitted", "; ".join(published.fitted)),
    ]
    return [(heading, text) for heading, text in texts if text]


def table_cells(comparison: Comparison) -> list[str]:
    """Cells of a comparison, escaped for a Markdown table."""
    row, verdict = comparison.row, comparison.verdict
    cells = [
        row.quantity,
        format_with_source(row),
        format_summary(comparison.result.ours),
        f"**{verdict}**" if verdict == "disagrees" else verdict,
        comparison.note,
    ]
    return [text.replace("|", "\\|") for text in cells]


HEAD = """# The papers, reproduced

All experiments with published numbers, repeated with our simulator and estimator: the published number, ours with its
95 % interval, and a verdict. This page is written by

```sh
{command} --markdown docs/findings/papers.md
```

with seed {seed}. The published numbers with their sources and tolerances are in
[`data/published`](../../data/published).

* **agrees**: our interval overlaps the published number with its tolerance.
* **explained**: it overlaps only with causes that the row names and that were simulated too. A fitted cause is listed
  under *Fitted*; it shows only that the number can arise in this way.
* **disagrees**: neither.

A number is *derived* if it is not printed but follows from printed ones. A verdict is *open* if our interval is wider
than the tolerance or contains the bound: more trials might change it. No parameter is tuned to a number unless it is
listed under *Fitted*.
"""
