"""Reports of reproduced experiments: one HTML page, or a Markdown page with its figures in a folder beside it."""

from __future__ import annotations

import shlex
from collections.abc import Sequence
from pathlib import Path
from typing import NamedTuple

from skysim.core.files import make_folder, write_bytes, write_text
from skysim.experiments.papers.compare import VERDICTS, Comparison, Reproduction, number, printed
from skysim.results.plots import png
from skysim.results.report import embed

KINDS = (*VERDICTS, "derived", "open")


class Told(NamedTuple):
    """The arguments of the command."""

    ids: tuple[str, ...]
    quick: bool
    seed: int

    @property
    def command(self) -> str:
        """The shell command that repeats the run."""
        seed = ["--seed", str(self.seed)] if self.seed != 1 else []
        return shlex.join(["skysim", "reproduce", *self.ids, *["--quick"] * self.quick, *seed])


def papers(done: Sequence[Reproduction]) -> dict[str, list[Reproduction]]:
    """Group experiments by paper, in their given order."""
    found: dict[str, list[Reproduction]] = {}
    for one in done:
        found.setdefault(one.published.paper, []).append(one)
    return found


def counts(done: Sequence[Reproduction]) -> dict[str, int]:
    """Number of rows of each kind in KINDS, over all experiments."""
    return {kind: sum(one.counts[kind] for one in done) for kind in KINDS}


def write_html(path: Path, done: Sequence[Reproduction], told: Told) -> None:
    """Write one HTML file with embedded figures."""
    from jinja2 import Environment

    page = Environment(autoescape=True, trim_blocks=True, lstrip_blocks=True).from_string(PAGE)
    drawn = {one.id: [(embed(png(d.draw, d.size_in)), d.caption) for d in one.drawings] for one in done}
    text = page.render(
        remarks=remarks,
        papers=papers(done),
        counts=counts(done),
        told=told,
        drawn=drawn,
        number=number,
        printed=printed,
    )
    write_text(path, text)


def write_markdown(path: Path, done: Sequence[Reproduction], told: Told) -> None:
    """Write a Markdown page, and its figures to a folder of the same name beside it."""
    lines = [HEAD.format(command=told.command, seed=told.seed)]
    lines += [f"| experiment | {' | '.join(KINDS)} | seconds |", "|---" * (len(KINDS) + 2) + "|"]
    for one in done:
        cells = [
            f"[{one.id}](#{one.id})",
            *(str(one.counts[kind]) for kind in KINDS),
            f"{one.seconds:.0f}",
        ]
        lines.append(f"| {' | '.join(cells)} |")
    total = counts(done)
    lines.append(f"| all | {' | '.join(str(total[kind]) for kind in KINDS)} | |")
    folder = make_folder(path.with_suffix(""))
    for paper, ones in papers(done).items():
        lines += [f"\n## {paper}"]
        for one in ones:
            lines += section(one, folder)
    write_text(path, "\n".join(lines) + "\n")


def section(one: Reproduction, folder: Path) -> list[str]:
    """Lines of an experiment's section; writes its figures to the folder."""
    published = one.published
    lines = [f"\n### {one.id}\n", f"{published.title}. {published.source}.\n"]
    for head, told in remarks(one):
        lines.append(f"*{head}:* {told}\n")
    lines += ["| what | published | ours | verdict | note |", "|---|---|---|---|---|"]
    lines += [f"| {' | '.join(cells(line))} |" for line in one.lines]
    for n, drawing in enumerate(one.drawings, 1):
        name = f"{one.id}_{n}.png"
        write_bytes(folder / name, png(drawing.draw, drawing.size_in))
        lines += [f"\n![{drawing.caption}]({folder.name}/{name})\n\n*{drawing.caption}*"]
    return lines


def remarks(one: Reproduction) -> list[tuple[str, str]]:
    """(heading, text) of the remarks above an experiment's table."""
    published = one.published
    told = [
        ("What the paper gets wrong", published.wrong),
        ("Assumed, for the paper does not tell", "; ".join(published.assumed)),
        ("Fitted", "; ".join(published.fitted)),
    ]
    return [(head, text) for head, text in told if text]


def cells(line: Comparison) -> list[str]:
    """Cells of a comparison, escaped for a Markdown table."""
    verdict = f"**{line.verdict}**" if line.verdict == "disagrees" else line.verdict
    told = [line.row.quantity, printed(line.row), number(line.answer.ours), verdict, line.note]
    return [text.replace("|", "\\|") for text in told]


HEAD = """# The papers, reproduced

Every experiment of which the papers publish numbers, done again by our own simulator and estimator: the published
number, ours with its interval of 95 %, and a verdict. This page is written by

```sh
{command} --markdown docs/findings/papers.md
```

and by nobody else; seed {seed}. The published numbers, each with its table or page, and the tolerances are in
[`data/published`](../../data/published).

* **agrees**: our interval meets the published number's tolerance.
* **explained**: it does not, but does with causes that the row names and that were simulated too. A cause may have been
  fitted: then it stands under *Fitted*, and explains no more than that the number can come about so.
* **disagrees**: neither.

A number is *derived* where it is not printed but follows from what is, and a verdict *open* where its interval is
wider than the tolerance, or holds the bound: more trials might turn it. Nothing is tuned to hit a number unless it
stands under *Fitted*.
"""

PAGE = """<!doctype html>
<html lang="en"><head><meta charset="utf-8"><meta name="viewport" content="width=device-width">
<title>The papers, reproduced</title>
<style>
 body { font: 15px/1.5 system-ui, sans-serif; color: #222; max-width: 1240px; margin: 2rem auto; padding: 0 1rem }
 h1 { font-size: 1.5rem; margin-bottom: .2rem } h2 { font-size: 1.2rem; margin-top: 2.5rem } h3 { margin: 2rem 0 .2rem }
 code { background: #f2f2f2; padding: .15rem .4rem; border-radius: 3px }
 figure { margin: 1.2rem 0 } figcaption { color: #555; font-size: 13px; max-width: 760px } img { max-width: 100% }
 .figures { display: flex; flex-wrap: wrap; gap: 1.2rem; margin: 1.2rem 0 }
 .figures div { background: #f6f8fa; padding: .6rem 1rem; border-radius: 6px }
 .figures b { display: block; font-size: 1.25rem }
 table { border-collapse: collapse; font-variant-numeric: tabular-nums; font-size: 13px; margin: .6rem 0 }
 th, td { text-align: left; padding: .2rem .7rem; border-bottom: 1px solid #eee; vertical-align: top }
 td:first-child { min-width: 190px } .n { text-align: right }
 #contents td { white-space: nowrap } .remark { font-size: 14px; margin: .3rem 0; max-width: 860px }
 .agrees { color: #00713f } .explained { color: #9a5b00 } .disagrees { color: #b00020; font-weight: 600 }
 tr.disagrees td { background: #fdf3f4; color: #222; font-weight: 400 }
 tr.disagrees td.v { color: #b00020; font-weight: 600 }
</style></head><body>
<h1>The papers, reproduced</h1>
<p><code id="command">{{ told.command }} --report</code></p>
<div class="figures">
{% for kind, count in counts.items() %}
 <div><b id="{{ kind }}" class="{{ kind if count }}">{{ count }}</b>{{ kind }}</div>
{% endfor %}
 <div><b>{{ told.seed }}</b>seed{{ ', quick: wider intervals' if told.quick }}</div>
</div>
<p>agrees: our interval of 95 % meets the published number's tolerance. explained: it does with causes that the row
names and that were simulated too; a fitted one explains no more than that the number can come about so. disagrees:
neither. derived: the number is not printed, but follows from what is. open: our interval leaves the verdict open.</p>
<table id="contents"><tr><th>experiment</th><th></th>
{% for kind in counts %}<th class="n">{{ kind }}</th>{% endfor %}<th class="n">seconds</th></tr>
{% for ones in papers.values() %}{% for one in ones %}
<tr><td><a href="#{{ one.id }}">{{ one.id }}</a></td><td>{{ one.published.title }}</td>
{% for kind, count in one.counts.items() %}<td class="n {{ kind if count }}">{{ count or '' }}</td>{% endfor %}
<td class="n">{{ '%.1f'|format(one.seconds) }}</td></tr>
{% endfor %}{% endfor %}</table>
{% for paper, ones in papers.items() %}
<h2>{{ paper }}</h2>
{% for one in ones %}
<h3 id="{{ one.id }}">{{ one.id }}: {{ one.published.title }}</h3>
<p class="remark">{{ one.published.source }}.</p>
{% for head, text in remarks(one) %}<p class="remark"><b>{{ head }}:</b> {{ text }}</p>{% endfor %}
<table><tr><th>what</th><th class="n">published</th><th class="n">ours (95 %)</th><th>verdict</th><th>note</th></tr>
{% for line in one.lines %}
<tr class="{{ line.verdict if line.verdict == 'disagrees' }}"><td>{{ line.row.quantity }}</td>
<td class="n">{{ printed(line.row) }}</td><td class="n">{{ number(line.answer.ours) }}</td>
<td class="v {{ line.verdict }}">{{ line.verdict }}</td><td>{{ line.note }}</td></tr>
{% endfor %}</table>
{% for source, caption in drawn[one.id] %}
<figure><img alt="{{ caption }}" src="{{ source }}"><figcaption>{{ caption }}</figcaption></figure>
{% endfor %}
{% endfor %}
{% endfor %}
</body></html>
"""
