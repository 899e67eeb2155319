"""Write docs/findings/papers.md: how the papers' numbers come out, with the rows that disagree and why.

`skysim reproduce all --json > out/papers.json; python docs/site/papers.py out/papers.json`, which `make papers` does.
All 311 rows are kept beside the page as papers.csv, which the tests compare with today's code; the full page with
figures, assumptions and fitted parameters is what `skysim reproduce all --report` writes.
"""

from __future__ import annotations

import csv
import io
import json
import re
import sys
from collections.abc import Sequence
from pathlib import Path
from typing import NamedTuple

sys.path.insert(0, str(Path(__file__).parent))
from stale import make_stamp
from studies import NEEDS

from skysim.experiments.papers import compare
from skysim.experiments.papers.compare import VERDICTS
from skysim.experiments.papers.published import Experiment, PublishedRow, experiments
from skysim.results.metrics import Summary

FINDINGS = Path(__file__).parents[1] / "findings"
PAGE = FINDINGS / "papers.md"
TABLE = FINDINGS / "papers.csv"
FIGURE = FINDINGS / "papers.png"
FIELDS = (
    "experiment",
    "quantity",
    "published",
    "ours",
    "low",
    "high",
    "verdict",
    "open",
    "cause",
)
KINDS = (*VERDICTS, "derived", "open")
COMMAND = "skysim reproduce all"
OPEN = ("interval wider than the tolerance", "the bound is within the interval")
CAUSE = re.compile(
    r"(?:(?<=^)|(?<=; ))with ((?:[^;:]|[;:](?! -?\d| with ))+?): (-?[\d.]+(?:e[-+]?\d+)?(?: \([^)]*\))?)(?:; |$)"
)
INTRODUCTION = """# Do we reproduce the papers?

{answer}

![Verdicts of the published numbers by experiment.](papers.png)

Each published number has a tolerance and ours an interval of 95 %. A number *agrees* if the two overlap. It is
*explained* if they overlap only with a cause that was simulated too; a fitted cause shows only that the number can
arise in this way. Otherwise it *disagrees*. It is *derived* if it follows from printed numbers. The verdict is *open*
if our interval is wider than the tolerance or contains the bound; more trials might change it.

Sources and tolerances are in [`data/published`](../../data/published), all {rows} rows in [`papers.csv`](papers.csv),
figures and fitted parameters in the full report.

```sh
{command}
```
"""
ANSWER = (
    "Of {rows} published numbers {agrees} agree with ours, {explained} are explained by a cause that we simulated and"
    " {disagrees} disagree. {most} of those that disagree are of {worst}: we found no cause of its differences between"
    " algorithm and IMU. The verdicts of {open} numbers are open."
)


class Line(NamedTuple):
    """A reproduced row. ours : value, low, high;  note : cause and remarks;  row : as published"""

    row: PublishedRow
    ours: tuple[float, float, float]
    verdict: str
    note: str

    @property
    def open(self) -> bool:
        """Whether more trials might change the verdict."""
        return any(text in self.note for text in OPEN)

    @property
    def causes(self) -> list[tuple[str, str]]:
        """Names of the causes that were simulated too, and our number with each; the first explains the row."""
        return [(one[1], one[2]) for one in CAUSE.finditer(self.note)]

    @property
    def ours_text(self) -> str:
        """Our number with its interval."""
        value, low, high = self.ours
        return compare.format_summary(Summary(value, low, high, 1))


def read(path: Path) -> dict[str, list[Line]]:
    """The rows of each experiment, from the JSON that `skysim reproduce all --json` prints."""
    listed = json.loads(path.read_text(encoding="utf-8"))
    found: dict[str, list[Line]] = {}
    for id, experiment in experiments().items():
        told = [one for one in listed if one["id"] == id]
        found[id] = []
        for row, one in zip(experiment.rows.values(), told, strict=True):
            if one["quantity"] != row.quantity:
                raise ValueError(f"{id}: '{one['quantity']}' instead of '{row.quantity}'")
            low, high = (float("nan") if end is None else end for end in one["interval"])
            line = Line(row, (one["ours"], low, high), one["verdict"], one["note"])
            found[id].append(line)
    return found


def counts(lines: Sequence[Line]) -> dict[str, int]:
    """Number of rows by verdict, of derived rows, and of open verdicts."""
    found = {verdict: sum(line.verdict == verdict for line in lines) for verdict in VERDICTS}
    derived = sum(line.row.derived for line in lines)
    return found | {"derived": derived, "open": sum(line.open for line in lines)}


def write_table(found: dict[str, list[Line]]) -> None:
    """All rows as CSV, numbers to six digits."""
    with TABLE.open("w", encoding="utf-8", newline="") as file:
        writer = csv.writer(file, lineterminator="\n")
        writer.writerow(FIELDS)
        for id, lines in found.items():
            for line in lines:
                published = compare.format_with_source(line.row)
                numbers = [f"{one:.6g}" for one in line.ours]
                cause = ": ".join(line.causes[0]) if line.causes else ""
                about = [line.verdict, "open" if line.open else "", cause]
                writer.writerow([id, line.row.quantity, published, *numbers, *about])


def page(found: dict[str, list[Line]], stamp: str) -> str:
    """The page."""
    everything = [line for lines in found.values() for line in lines]
    total = counts(everything)
    worst = max(found, key=lambda id: counts(found[id])["disagrees"])
    most = counts(found[worst])["disagrees"]
    answer = ANSWER.format(
        rows=len(everything), most=most, worst=f"[{worst}](#{worst})", **total
    )
    parts = [INTRODUCTION.format(answer=answer, rows=len(everything), command=COMMAND)]
    parts.append(summary_table(found))
    paper = ""
    for id, experiment in experiments().items():
        if experiment.paper != paper:
            paper = experiment.paper
            parts.append(f"## {paper}\n")
        parts.append(section(id, experiment, found[id]))
    return "\n".join([*parts, f"{stamp}\n"])


def summary_table(found: dict[str, list[Line]]) -> str:
    """Number of rows of each kind, by experiment."""
    rows = [f"| experiment | {' | '.join(KINDS)} |", f"| --- |{' --- |' * len(KINDS)}"]
    for id, lines in found.items():
        rows.append(f"| [{id}](#{id}) | {' | '.join(map(str, counts(lines).values()))} |")
    return "\n".join(rows) + "\n"


def section(id: str, experiment: Experiment, lines: Sequence[Line]) -> str:
    """An experiment: what the paper gets wrong, the causes that were simulated, and the rows that disagree."""
    text = [f"### {id}\n", f"{experiment.title}.\n"]
    if experiment.wrong:
        text.append(f"The paper's errors: {experiment.wrong.rstrip('.')}.\n")
    causes = dict.fromkeys(name for line in lines for name, _ in line.causes)
    if causes:
        text.append(f"Simulated causes: {'; '.join(causes)}.\n")
    wrong = [line for line in lines if line.verdict == "disagrees"]
    if wrong:
        heads = ["what disagrees", "published", "ours (95 %)", "with each cause", "remark"]
        text.append(f"| {' | '.join(heads)} |\n| {' | '.join(['---'] * len(heads))} |")
        text += [disagreeing(line) for line in wrong]
        text.append("")
    return "\n".join(text)


def disagreeing(line: Line) -> str:
    """The table's row of a number that disagrees."""
    number = "; ".join(number for _, number in line.causes)
    remark = CAUSE.sub("", line.note)
    cells = [
        line.row.quantity,
        compare.format_with_source(line.row),
        line.ours_text,
        number,
        remark,
    ]
    return "| " + " | ".join(one.replace("|", "\\|") for one in cells) + " |"


def draw(found: dict[str, list[Line]]) -> bytes:
    """The verdicts by experiment, as bars."""
    import matplotlib

    matplotlib.use("agg")
    import matplotlib.pyplot as plt

    figure, axis = plt.subplots(figsize=(7.4, 3.9), layout="constrained")
    left = [0] * len(found)
    colors = {"agrees": "tab:green", "explained": "tab:orange", "disagrees": "tab:red"}
    for verdict, color in colors.items():
        width = [counts(lines)[verdict] for lines in found.values()]
        axis.barh(list(found), width, left=left, color=color, label=verdict)
        left = [one + more for one, more in zip(left, width, strict=True)]
    axis.invert_yaxis()
    axis.set_xlabel("published numbers")
    axis.tick_params(labelsize=8)
    axis.legend()
    buffer = io.BytesIO()
    figure.savefig(buffer, format="png", dpi=110)
    plt.close(figure)
    return buffer.getvalue()


def main(path: Path) -> None:
    """Write the page, its table and its figure."""
    found = read(path)
    write_table(found)
    FIGURE.write_bytes(draw(found))
    PAGE.write_text(
        page(found, make_stamp([*NEEDS, "data/published"], 1).line), encoding="utf-8"
    )
    print(PAGE)


if __name__ == "__main__":
    main(Path(sys.argv[1]))
