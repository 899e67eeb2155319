"""HTML report of a study: one self-contained page with counts, figures and a table, made from its store."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any, NamedTuple

from skysim.core.files import write_text
from skysim.experiments.study.analysis.table import Line, cells, figure
from skysim.experiments.study.plan import Curve, Study
from skysim.experiments.study.report import figures, layout
from skysim.experiments.study.store import Store
from skysim.results.report import embed

if TYPE_CHECKING:
    from skysim.experiments.study.analysis.sensitivity import Index

LISTED = 10  # maximum number of failures listed
ROWS = 5000  # maximum number of rows in the table


class Picture(NamedTuple):
    """An image of the page: a data URI and its caption."""

    source: str
    caption: str


class Cell(NamedTuple):
    """A table cell: its text, its sort key (an empty key sorts last), and whether it is a number."""

    text: str
    key: float | str
    number: bool


def write_page(
    path: Path,
    store: Store,
    study: Study,
    command: str,
    lines: Sequence[Line],
    indices: Sequence[Index] | None = None,
    front: Sequence[int] | None = None,
    costs: Mapping[int, float] | None = None,
) -> None:
    """Write the report as one self-contained HTML file.

    command : command that repeats the study;  lines : its table with all responses of `responses`
    indices : Sobol indices, for a study of design saltelli
    front   : Pareto-optimal points of an optimization;  costs : cost by point, if the study has costs
    Raises InputError if `where` of a figure names an unknown factor or level.
    """
    from jinja2 import Environment

    heads, rows = sortable(lines, study, costs)
    page = Environment(autoescape=True, trim_blocks=True, lstrip_blocks=True).from_string(PAGE)
    text = page.render(
        study=study,
        command=command,
        facts=facts(store, study),
        failures=store.failures()[:LISTED],
        runs=store.runs(),
        text=store.meta("study"),
        pictures=[
            *searched(lines, study, front or (), costs),
            *budgeted(indices or ()),
            *illustrated(lines, study),
        ],
        indices=[(one, figure(one.first), figure(one.total)) for one in indices or ()],
        heads=heads,
        rows=rows[:ROWS],
        front=set(front or ()),
        left=undrawn(study, lines),
        more=max(len(rows) - ROWS, 0),
    )
    write_text(path, text)


# Text and tables.


def responses(study: Study) -> list[str]:
    """The study's responses and those used by its figures, objectives and constraints, without `cost`."""
    shown = [one.y if isinstance(one, Curve) else one.value for one in study.figures]
    search = study.optimise
    sought = [one.response for one in (search.objectives if search else ())]
    sought += [one.response for one in (search.constraints if search else ())]
    return [name for name in dict.fromkeys([*study.responses, *shown, *sought]) if name != "cost"]


def facts(store: Store, study: Study) -> dict[str, Any]:
    """Counts of points and trials (planned, done, failed, wrong), and the code version."""
    counts, points = store.counts(), len(store.points())
    wanted = study.optimise.candidates if study.optimise else points
    trials, by_runs = wanted * study.replicates, sum(run["trials"] for run in store.runs())
    return {
        **counts,
        "points": points,
        "wanted": wanted,
        "replicates": study.replicates,
        "trials": trials,
        "whole": points > 0 and counts["done"] >= trials,
        "code": store.meta("code"),
        "unnoted": max(counts["done"] - by_runs, 0),  # trials of killed runs
    }


def sortable(
    lines: Sequence[Line], study: Study, costs: Mapping[int, float] | None
) -> tuple[list[str], list[list[Cell]]]:
    """Column heads and cells of the table. Named levels sort in the order of the study file."""
    heads, told = cells(lines)
    axes = {name: layout.axis(study, lines, name) for name in (lines[0].levels if lines else ())}
    rows = []
    for line, texts in zip(lines[:ROWS], told[:ROWS], strict=True):
        keys = [line.point, *(axes[name].place(one) for name, one in line.levels.items())]
        keys += [one.value for one in line.responses.values()]
        numbers = [True, *(axes[name].numeric for name in line.levels), *[True] * len(line.responses)]
        row = [Cell(text, plain(key), one) for text, key, one in zip(texts, keys, numbers, strict=True)]
        if costs is not None:
            cost = costs.get(line.point, math.nan)
            row.append(Cell("-" if math.isnan(cost) else f"{cost:.4g}", plain(cost), True))
        rows.append(row)
    return heads + (["cost"] if costs is not None else []), rows


def plain(key: float) -> float | str:
    """Sort key of a number for the page's script; an empty string for NaN."""
    return "" if math.isnan(key) else key


# Images.


def illustrated(lines: Sequence[Line], study: Study) -> list[Picture]:
    """The study's figures."""
    return [
        Picture(embed(figures.figure_png(lines, one, study)), layout.caption(one, study, lines))
        for one in layout.figures(study, lines)
    ]


def undrawn(study: Study, lines: Sequence[Line]) -> list[str]:
    """Responses of the study that no figure shows."""
    shown = {one.y if isinstance(one, Curve) else one.value for one in layout.figures(study, lines)}
    return [name for name in study.responses if name not in shown]


def budgeted(indices: Sequence[Index]) -> list[Picture]:
    """Sobol indices, one image per response."""
    named = dict.fromkeys(one.response for one in indices)
    told = "Sobol indices of {}: the share of its variance that would go were a factor known, and that would stay"
    told += " were all others known; intervals of 95 %."
    return [Picture(embed(figures.indices_png(indices, name)), told.format(name)) for name in named]


def searched(
    lines: Sequence[Line], study: Study, front: Sequence[int], costs: Mapping[int, float] | None
) -> list[Picture]:
    """Plots of an optimization: every candidate and, with two objectives, the Pareto front."""
    if study.optimise is None or not lines:
        return []
    panels, points = layout.panels(lines, study.optimise, costs), [line.point for line in lines]
    named, marked = [one.response for one in study.optimise.objectives], ", ".join(map(str, front))
    best = f"none beats {marked} in all objectives" if front else "no candidate is marked yet"
    shown = [
        Picture(embed(figures.search_png(panels, points, front)), f"Every candidate; {best}. Dashed: bounds.")
    ]
    if len(named) == 2:
        one, other = (panels[name] for name in named)
        told = (
            f"{named[1]} against {named[0]}: the Pareto front of {len(front)} among {len(lines)} candidates."
        )
        shown.insert(0, Picture(embed(figures.pareto_png(one, other, points, front)), told))
    return shown


PAGE = """<!doctype html>
<html lang="en"><head><meta charset="utf-8"><meta name="viewport" content="width=device-width">
<title>{{ study.title }}</title>
<style>
 body { font: 15px/1.5 system-ui, sans-serif; color: #222; max-width: 1100px; margin: 2rem auto; padding: 0 1rem }
 h1 { font-size: 1.5rem; margin-bottom: .2rem } h2 { font-size: 1.1rem; margin-top: 2rem }
 code, pre { background: #f2f2f2; padding: .15rem .4rem; border-radius: 3px }
 pre { padding: .6rem 1rem; overflow: auto }
 figure { margin: 1.2rem 0 } figcaption { color: #555; font-size: 13px; max-width: 760px } img { max-width: 100% }
 .figures { display: flex; flex-wrap: wrap; gap: 1.2rem; margin: 1.2rem 0 }
 .figures div { background: #f6f8fa; padding: .6rem 1rem; border-radius: 6px }
 .figures b { display: block; font-size: 1.25rem } .bad { color: #b00020 }
 .banner { border-left: 4px solid #b00020; background: #fdf3f4; padding: .5rem 1rem; margin: 1rem 0 }
 .banner ul { margin: .3rem 0; padding-left: 1.2rem } .scroll { overflow-x: auto }
 table { border-collapse: collapse; font-variant-numeric: tabular-nums; font-size: 13px }
 th, td { text-align: left; padding: .2rem .7rem; border-bottom: 1px solid #eee; white-space: nowrap }
 .n { text-align: right } #points th { cursor: pointer; user-select: none } tr.front td { background: #fff6ee }
 th[data-way="1"]::after { content: " \\2191" } th[data-way="-1"]::after { content: " \\2193" }
</style></head><body>
<h1>{{ study.title }}</h1>
<p><code id="command">{{ command }}</code></p>
{% if not facts.whole %}
<div class="banner" id="unfinished"><b>Not finished.</b> {{ facts.done }} of {{ facts.trials }} trials are in; what
follows is of these.</div>
{% endif %}
{% if facts.failed %}
<div class="banner" id="failures"><b>{{ facts.failed }} {{ 'trial' if facts.failed == 1 else 'trials' }} failed</b> and
{{ 'counts' if facts.failed == 1 else 'count' }} in no figure but <code>failed</code>
{{- ', the first of them:' if facts.failed > failures|length else ':' }}
<ul>{% for trial, error in failures %}<li>trial <b>{{ trial }}</b>: {{ error }}</li>{% endfor %}</ul>
<code>skysim study replay FILE {{ failures[0][0] }}</code> does one again and keeps its frames.</div>
{% endif %}
<div class="figures">
 <div><b id="done">{{ facts.done }} / {{ facts.trials }}</b>trials done: {{ facts.wanted }}
 {{ 'candidates' if study.optimise else 'points' }} × {{ facts.replicates }}</div>
 <div><b id="failed" class="{{ 'bad' if facts.failed }}">{{ facts.failed }}</b>failed</div>
 <div><b id="wrong" class="{{ 'bad' if facts.wrong }}">{{ facts.wrong }}</b>wrong attitudes (over 10\u2032)</div>
 <div><b id="scene">{{ study.scene }}</b>scene, {{ study.trial.kind }}</div>
 <div><b id="seed">{{ study.seed }}</b>seed{{ ', paired' if study.paired }}</div>
 <div><b id="code">{{ facts.code }}</b>code version</div>
</div>
{% if pictures %}<h2>Figures</h2>{% endif %}
{% for picture in pictures %}
<figure><img alt="{{ picture.caption }}" src="{{ picture.source }}">
<figcaption>{{ picture.caption }}</figcaption></figure>
{% endfor %}
{% if left %}<p>In the table alone: {{ left|join(', ') }}.</p>{% endif %}
{% if indices %}
<h2>Sobol indices</h2>
<table id="indices"><tr><th>error</th><th>factor</th><th class="n">first order</th><th class="n">total</th></tr>
{% for one, first, total in indices %}
<tr><td>{{ one.response }}</td><td>{{ one.factor }}</td><td class="n">{{ first }}</td>
<td class="n">{{ total }}</td></tr>
{% endfor %}</table>
{% endif %}
<h2>Points</h2>
<div class="scroll"><table id="points"><thead><tr>
{% for head in heads %}<th{% if rows and rows[0][loop.index0].number %} class="n"{% endif %}>{{ head }}</th>{% endfor %}
</tr></thead><tbody>
{% for row in rows %}
<tr{% if row[0].key in front %} class="front"{% endif %}>
{%- for cell in row %}<td data-v="{{ cell.key }}"{% if cell.number %} class="n"{% endif %}>{{ cell.text }}</td>
{%- endfor %}</tr>
{% endfor %}</tbody></table></div>
{% if more %}<p>and {{ more }} points more: <code>skysim study export</code> writes them all.</p>{% endif %}
<p>In brackets intervals of 95 %; a click on a head sorts.{{ ' Tinted: the front.' if front }}</p>
<h2>Runs</h2>
<table id="runs"><tr><th>engine</th><th class="n">workers</th><th class="n">trials</th><th class="n">seconds</th>
<th class="n">trials/s</th></tr>
{% for run in runs %}
<tr><td>{{ run.engine }}</td><td class="n">{{ run.workers }}</td><td class="n">{{ run.trials }}</td>
<td class="n">{{ '%.1f'|format(run.seconds) }}</td>
<td class="n">{{ '%.1f'|format(run.trials / run.seconds) if run.seconds else '-' }}</td></tr>
{% endfor %}</table>
{% if facts.unnoted %}<p>{{ facts.unnoted }} trials are of runs that were killed.</p>{% endif %}
<details><summary>The study file</summary><pre id="study">{{ text }}</pre></details>
<script>
for (const [n, head] of document.querySelectorAll("#points th").entries()) head.onclick = () => {
  const way = head.dataset.way === "1" ? -1 : 1, body = document.querySelector("#points tbody");
  document.querySelectorAll("#points th").forEach(one => delete one.dataset.way);
  head.dataset.way = way;
  const key = row => row.cells[n].dataset.v === "" ? NaN : Number(row.cells[n].dataset.v);
  const after = (a, b) => isNaN(a) ? (isNaN(b) ? 0 : 1) : isNaN(b) ? -1 : way * (a - b);
  body.append(...[...body.rows].map(row => [key(row), row]).sort((a, b) => after(a[0], b[0])).map(one => one[1]));
};
</script></body></html>
"""
