"""Write docs/findings/studies/*.md, one page for each study, from the stores of completed studies.

A page has the question, the answer in three sentences, one figure, one table, the limits, the command that repeats it,
and the version of the code (stale.py). What it says is in studies.yaml, without numbers; they are filled in from the
study's own record. `make studies` runs the studies and this.

`python docs/site/studies.py [FOLDER]`: every study's store in FOLDER/NAME (out/ if left out).
"""

from __future__ import annotations

import io
import re
import sys
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import yaml

sys.path.insert(0, str(Path(__file__).parent))
from stale import Stamp, make_stamp

from skysim.core.paths import STUDIES
from skysim.experiments.study import search
from skysim.experiments.study import table as sensitivity
from skysim.experiments.study.execution import store
from skysim.experiments.study.execution.store import STORE, Store
from skysim.experiments.study.plan import Plan
from skysim.experiments.study.report.study_report import Analysis, analyze, commands, compose
from skysim.experiments.study.study_file import load
from skysim.experiments.study.table import format_level, format_response, format_summary
from skysim.results import metrics
from skysim.results.report import figures

SITE = Path(__file__).parent
PAGES = SITE.parent / "findings" / "studies"
TEXTS = SITE / "studies.yaml"
MAX_ROWS = 20  # of a page's table
# What the numbers of a study depend on; drawing and the apps are left out.
SIMULATOR = ("camera", "core", "dynamics", "experiments", "scene", "simulation", "sources")
NEEDS = (*(f"skysim.{name}" for name in SIMULATOR), "skysim.tracking", "estimator")
SHARES = {"first", "total"}  # Sobol indices, given in percent as proportions are
PLACEHOLDER = re.compile(r"\{([^{}]+)\}")
EXPRESSION = re.compile(r"(?:(min|max) )?(\w+)(?:\[(.*)\])?$", re.DOTALL)
SUMMARY = re.compile(r"(-?[\d.]+(?:e[-+]?\d+)?)(?: \((-?[\d.e+-]+?)\.\.(-?[\d.e+-]+)\))?")
EVENT = re.compile(
    r": at (?P<some>\d+) of (?P<all>\d+) points, most at .*?: (?P<most>[\d.]+ %) of the frames "
    r"\((?P<interval>[^)]+)\)(?:; none in .*?\(less than (?P<bound>\S+ %))?"
)
NONE = re.compile(r": none in .*?\(less than (\S+ %)")
UNDECIDED = re.compile(
    r"Nothing says otherwise, but NEES is known to (\S+ to \S+) only at .*$"
)
EVENTS = {  # by the beginning of the report's sentence
    "Is every": "refused",
    "Is it ambiguous": "ambiguous",
    "Misidentified": "misidentified",
    "Wrong": "wrong",
}
CLAIM = re.compile(r"too (small|large) by a factor of (\S+) at .* at (\d+ of \d+) points\.$")

Row = Mapping[str, str]  # texts by name: levels of factors and responses with their intervals


@dataclass(frozen=True)
class Record:
    """What a page takes from a study.

    counts   : "60 trials at each of 360 points" and the like;  trials, failed : in all
    rows     : of all points, of a search's front or of the Sobol indices
    headline : the answers of the study's report, for refusals, wrong attitudes and claimed errors
    pictures : PNG images by the number or name of the report's figure
    """

    name: str
    title: str
    command: str
    counts: str
    trials: int
    failed: int
    rows: Sequence[Row]
    headline: Sequence[str]
    pictures: Mapping[str, bytes]


def main(folder: Path) -> None:
    """Write a page for every study with a complete store."""
    PAGES.mkdir(exist_ok=True)
    for path in sorted(STUDIES.glob("*.yaml")):
        plan = load(path)
        store_path = folder / plan.name / STORE
        if not store_path.is_file():
            print(f"{store_path}: no such store; page not changed")
            continue
        with store.open_store(store_path) as kept:
            unfinished = kept.counts()["done"] < plan.study.trial_count(len(plan.points))
            if kept.meta("digest") != plan.digest or unfinished:
                print(f"{store_path}: not finished, or of another version; page not changed")
                continue
            made = make_stamp([*NEEDS, f"scenes/studies/{path.name}"], plan.study.seed)
            print(write_page(read_record(plan, kept), made))


# The record of a study.


def read_record(plan: Plan, kept: Store) -> Record:
    """The record of a study from its store."""
    study = plan.study
    command = commands(plan, kept, plan.name)
    found = analyze(plan, kept, command)
    report = compose(kept, found, command)
    drawn = {one.name or str(n): one.image for n, one in enumerate(figures(report.blocks), 1)}
    counts, points = kept.counts(), len(kept.points())
    each = f"at each of {points} points" if points > 1 else ""
    return Record(
        plan.name,
        study.title,
        command("optimize" if study.optimize else "run"),
        f"{study.replicates} trials {each}".strip(),
        counts["done"],
        counts["failed"],
        read_rows(plan, found),
        found.headline,
        drawn,
    )


def read_rows(plan: Plan, found: Analysis) -> list[Row]:
    """Texts of the front of a search, of Sobol indices, or of all points."""
    if found.result is not None:
        heads, rows = search.front_cells(plan.study, found.result)
        named = [dict(zip(heads, row, strict=True)) for row in rows]
        return [one | {"front": str(n)} for n, one in enumerate(named, 1)]
    if found.indices:
        return [index_row(one) for one in found.indices]
    return [
        {"point": str(one.point)}
        | {name: format_level(level) for name, level in one.levels.items()}
        | {name: format_response(one, name) for name in one.responses}
        for one in found.lines
    ]


def index_row(index: sensitivity.Index) -> Row:
    """Texts of a Sobol index."""
    return {
        "error": index.response,
        "factor": index.factor,
        "alone": f"{index.rms_arcsec:.3g}",
        "first": format_summary(index.first),
        "total": format_summary(index.total),
    }


# Numbers of a record.


def evaluate(expression: str, record: Record, where: Row, interval: bool = False) -> str:
    """The text of an expression such as `identified[chain=default]`, or `trials`.

    where    : levels of the factors that it does not name
    interval : with its 95 % interval, and shares without their unit, as a table has them

    Raises ValueError if no row, or more than one, has these levels.
    """
    if expression == "trials":
        return f"{record.trials:,}"
    match = EXPRESSION.match(" ".join(expression.split()))
    if not match:
        raise ValueError(f"{record.name}: cannot read '{expression}'")
    extreme, name, given = match.groups()
    levels = dict(where)
    levels |= dict(
        part.strip().split("=") for part in (given or "").split(",") if part.strip()
    )
    if levels.get("front") == "-1":
        levels["front"] = str(len(record.rows))
    chosen = [row for row in record.rows if has_levels(row, levels)]
    texts = [row[name] for row in chosen]
    if extreme:
        known = [text for text in texts if SUMMARY.match(text) and "n=" not in text]
        pick = min if extreme == "min" else max
        texts = [pick(known, key=lambda text: float(SUMMARY.match(text)[1]))]  # type: ignore[index]
    if len(texts) != 1:
        raise ValueError(f"{record.name}: {len(texts)} rows for '{expression}' with {levels}")
    return number_text(texts[0], is_share(name), interval)


def has_levels(row: Row, levels: Row) -> bool:
    """Return True if a row has these levels; `*` stands for any."""
    return all(level in ("*", row.get(name)) for name, level in levels.items())


def is_share(name: str) -> bool:
    """Return True if a response is given in percent."""
    return name in SHARES or metrics.is_proportion(name) or name.startswith("coverage")


def number_text(text: str, share: bool, interval: bool) -> str:
    """A number of a record for people: `98.3 %`, or `98.3 (91.1–99.7)` with its interval."""
    match = SUMMARY.match(text)
    if not match or not re.fullmatch(
        r"( \(needs \d+ more values\))?( n=\d+)?", text[match.end() :]
    ):
        return text  # a level, such as `8 mm`
    factor = 100 if share else 1
    value, low, high = (plain(float(one) * factor) if one else "" for one in match.groups())
    if not interval:
        return f"{value} %" if share else value
    few = re.search(r"n=(\d+)", text)
    between = f" ({low}–{high})" if low else ""
    return value + between + (f", n={few[1]}" if few else "")


def plain(value: float) -> str:
    """Three digits without an exponent."""
    if value == 0 or abs(value) < 5e-4:
        return "0"
    return f"{value:,.0f}" if abs(value) >= 1000 else f"{float(f'{value:.3g}'):g}"


# The page.


def write_page(record: Record, stamp: Stamp) -> Path:
    """Write the page of a study and its figures. Returns the page's path."""
    said = yaml.safe_load(TEXTS.read_text(encoding="utf-8"))[record.name]
    where = texts_of(said.get("where", {}))
    answer = PLACEHOLDER.sub(lambda one: evaluate(one[1], record, where), said["answer"])
    heads, rows = table(said["table"], record, where)
    picture = ""
    for shown in [said.get("figure"), *said.get("also", [])]:
        if shown is None:
            continue
        name = f"{record.name}_{shown}.png"
        image = record.pictures.get(str(shown))
        (PAGES / name).write_bytes(image or draw_table(heads, rows))
        picture = picture or f"![{record.title}]({name})\n\n"
    study = f"[`{record.name}.yaml`](../../../scenes/studies/{record.name}.yaml)"
    lines = [
        f"# {record.title}\n",
        f"{answer}\n",
        f"{picture}{markdown_table(heads, rows)}",
        f"{said['caption']} In brackets intervals of 95 %.\n",
        *(f"- {line}" for line in limits(record, said.get("limits", ""))),
        f"\n```sh\n{record.command}\n```\n",
        f"The command writes the full report. What is varied: {study}.\n",
        stamp.line,
    ]
    path = PAGES / f"{record.name}.md"
    path.write_text("\n".join(lines) + "\n", encoding="utf-8")
    return path


def texts_of(levels: Mapping[str, Any]) -> Row:
    """Levels as texts."""
    return {name: str(level) for name, level in levels.items()}


def table(
    said: Mapping[str, Any], record: Record, where: Row
) -> tuple[list[str], list[list[str]]]:
    """Heads and cells of the page's table. said : its description in studies.yaml"""
    factors = said.get("rows", {})
    fixed = {name: level for name, level in where.items() if name not in factors}
    if "front" in said:
        places = [{"front": str(n)} for n in range(1, len(record.rows) + 1)]
    elif "points" in said:
        places = [{"point": str(n)} for n in said["points"]]
    else:
        places = list(
            map(
                dict,
                dict.fromkeys(tuple((f, row[f]) for f in factors) for row in record.rows),
            )
        )
    if len(places) > MAX_ROWS:
        raise ValueError(f"{record.name}: a table of {len(places)} rows")
    rows = []
    for place in places:
        levels = fixed | place
        labels = [
            evaluate(name, record, levels) if name not in place else place[name]
            for name in factors
        ]
        values = [
            evaluate(one, record, levels, interval=True) for one in said["columns"].values()
        ]
        rows.append([*labels, *values])
    return [*factors.values(), *said["columns"]], rows


def markdown_table(heads: Sequence[str], rows: Sequence[Sequence[str]]) -> str:
    """A table in Markdown."""
    lines = [heads, ["---"] * len(heads), *rows]
    return "\n".join(f"| {' | '.join(line)} |" for line in lines) + "\n"


def draw_table(heads: Sequence[str], rows: Sequence[Sequence[str]]) -> bytes:
    """A figure of a table's last columns in ″, for a study without figures of its own: a dot and its interval a row."""
    import matplotlib

    matplotlib.use("agg")
    import matplotlib.pyplot as plt

    columns = [n for n, head in enumerate(heads) if head.endswith("″")]
    named = next(n for n, head in enumerate(heads) if head.endswith("%"))
    labels = [", ".join(row[:named]) for row in rows]
    figure, axes = plt.subplots(
        1, len(columns), figsize=(7.4, 3.9), sharey=True, layout="constrained"
    )
    for axis, column in zip(np.atleast_1d(axes), columns, strict=True):
        for y, row in enumerate(rows):
            value, *ends = (
                float(one.replace(",", ""))
                for one in re.findall(r"[\d.,]*\d", row[column])[:3]
            )
            axis.plot(ends, [y] * len(ends), color="tab:blue", linewidth=1)
            axis.plot(value, y, "o", color="tab:blue", markersize=4)
        axis.set(
            xlabel=heads[column].replace("″", "[″]"),
            yticks=range(len(rows)),
            yticklabels=labels,
        )
        axis.tick_params(labelsize=7)
        axis.grid(alpha=0.3)
    np.atleast_1d(axes)[0].invert_yaxis()
    buffer = io.BytesIO()
    figure.savefig(buffer, format="png", dpi=110)
    plt.close(figure)
    return buffer.getvalue()


def limits(record: Record, more: str) -> list[str]:
    """What a reader needs to judge the answer: trials, refusals, wrong attitudes, claimed errors, hardware."""
    failed = "none failed" if not record.failed else f"{record.failed} failed"
    lines = [f"N: {record.counts}, {record.trials:,} in all, {failed}."]
    events = [
        event(name, line)
        for begin, name in EVENTS.items()
        for line in record.headline
        if line.startswith(begin)
    ]
    lines.append(f"Trials ([terms](../studies.md)): {'; '.join(events)}.")
    for line in record.headline:
        if line.startswith("Are the claimed"):
            lines.append(claim(line))
        elif line.startswith("Intervals cover"):
            lines.append(f"{line.partition(':')[0]}.")
        elif " reaches " in line or " falls below " in line:
            lines.append(line)
    return [*lines, *([more] if more else [])]


def event(name: str, line: str) -> str:
    """How often something happened, from a sentence of the report, without the point's levels."""
    if match := EVENT.search(line):
        rest = f", elsewhere none (below {match['bound']})" if match["bound"] else ""
        return (
            f"{name} at {match['some']} of {match['all']} points, there at most {match['most']} "
            f"({match['interval']}){rest}"
        )
    match = NONE.search(line)
    return f"{name} none (below {match[1]})" if match else line.rstrip(".")


def claim(line: str) -> str:
    """Whether the claimed errors are true, from a sentence of the report."""
    if match := CLAIM.search(line):
        factor = plain(float(match[2]))
        return f"Claimed errors: too {match[1]} at {match[3]} points, by a factor of up to {factor}."
    said = line.removeprefix("Are the claimed errors true? ")
    said = UNDECIDED.sub(
        r"no fault is seen, but at one point NEES is known to \1 only (3 if true).", said
    )
    return f"Claimed errors: {said[0].lower()}{said[1:]}"


if __name__ == "__main__":
    main(Path(sys.argv[1]) if len(sys.argv) > 1 else Path("out"))
