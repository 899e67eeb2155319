"""Write docs/findings/papers.md: how the papers' numbers come out, with the predictions that disagree and why.

`python docs/site/papers.py out/papers.json out/afit_fit.txt`: what `make papers` writes by `skysim reproduce all
--quick --json` and `python docs/site/afit_fit.py`.
All rows are kept beside the page as papers.csv, which the tests compare with today's code; the full page with
assumptions and fitted parameters is what `skysim reproduce all --report` writes.
"""

from __future__ import annotations

import csv
import json
import sys
from pathlib import Path
from typing import Any

sys.path.insert(0, str(Path(__file__).parent))
from stale import make_stamp
from studies import NEEDS

from skysim.experiments.papers.published import experiments
from skysim.experiments.papers.reproduction import VERDICTS

FINDINGS = Path(__file__).parents[1] / "findings"
PAGE = FINDINGS / "papers.md"
TABLE = FINDINGS / "papers.csv"
FIELDS = (
    "id",
    "quantity",
    "class",
    "published",
    "scatter",
    "tolerance",
    "ours",
    "error",
    "verdict",
)
COMMAND = "skysim reproduce all --quick"  # the whole, without --quick, takes half an hour
PAGE_TEXT = """# Do we reproduce the papers?

Of {predictions} predictions {agrees} agree with the published number, {disagrees} disagree and {undecided} are
undecided. Of the {others} other rows {others_disagree} disagree: they are bounds, inputs, repetitions, numbers to which
the experiment was fitted, and numbers that the paper does not print.

{table}

Each experiment is a scene or a study that comes with skysim; `skysim reproduce ID` prints the commands that it runs. A
verdict tests the difference between our number and the published one: it agrees within the tolerance and 1.96 standard
deviations of both, and is undecided if our own part of that is larger than the rest. Sources and tolerances are in
[`data/published`](../../data/published), all rows in [`papers.csv`](papers.csv).

```sh
{command}
```

## Predictions that disagree

{wrong}

## AFIT's one laboratory

The thesis changed neither lens nor exposure between its tests (section 3.7). A joint fit to Tables 2, 3, 4 and 7 gives
the values of `afit_laboratory`, here with their 95 % intervals, chi-square by table, and that of other exposures. What
it leaves, mostly the deviations of Tables 2 and 7, one laboratory does not explain.

```text
{laboratory}
```

{stamp}
"""

Row = dict[str, Any]


def table(heads: list[str], rows: list[list[Any]]) -> str:
    """A Markdown table."""
    lines = [heads, ["---"] * len(heads), *rows]
    return "\n".join(
        f"| {' | '.join(str(one).replace('|', '/') for one in line)} |" for line in lines
    )


def is_prediction(row: Row) -> bool:
    """Whether nothing of the row's number went into its experiment."""
    return bool(row["class"] == "prediction")


def page(rows: list[Row], laboratory: str, stamp: str) -> str:
    """The page. laboratory : what the fit of AFIT's laboratory printed"""
    predictions = [row for row in rows if is_prediction(row)]
    counts = {one: sum(row["verdict"] == one for row in predictions) for one in VERDICTS}
    disagree = sum(row["verdict"] == "disagrees" for row in rows)
    summary = []
    for id, experiment in experiments().items():
        own = [row for row in rows if row["id"] == id]
        cells = [
            sum(row["verdict"] == one and is_prediction(row) for row in own)
            for one in VERDICTS
        ]
        summary.append([id, experiment.title, f"`{experiment.file}`", *cells, len(own)])
    heads = ["experiment", "", "file", *(f"predictions: {one}" for one in VERDICTS), "rows"]
    wrong = [row for row in predictions if row["verdict"] == "disagrees"]
    lines = [
        [row["id"], row["quantity"], row["published"], f"{row['ours']:.4g}", row["note"]]
        for row in wrong
    ]
    return PAGE_TEXT.format(
        predictions=len(predictions),
        **counts,
        others=len(rows) - len(predictions),
        others_disagree=disagree - counts["disagrees"],
        table=table(heads, summary),
        command=COMMAND,
        wrong=table(["experiment", "what", "published", "ours", "remark"], lines),
        laboratory=laboratory,
        stamp=stamp,
    )


def main(path: Path, fit: Path) -> None:
    """Write the page and its table from the JSON of `skysim reproduce all --json` and the text of the fit."""
    rows: list[Row] = json.loads(path.read_text(encoding="utf-8"))
    laboratory = fit.read_text(encoding="utf-8").strip()
    with TABLE.open("w", encoding="utf-8", newline="") as file:
        writer = csv.writer(file, lineterminator="\n")
        writer.writerow(FIELDS)
        for row in rows:
            numbers = {key: f"{row[key]:.6g}" for key in ("ours", "error")}
            writer.writerow([(row | numbers)[key] for key in FIELDS])
    stamp = make_stamp([*NEEDS, "data/published"], 1).line
    PAGE.write_text(page(rows, laboratory, stamp), encoding="utf-8")
    print(PAGE)


if __name__ == "__main__":
    main(Path(sys.argv[1]), Path(sys.argv[2]))
