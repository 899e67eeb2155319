"""`skysim reproduce`: verdicts, published data, the command, the pages, and shortened runs of every experiment."""

from __future__ import annotations

import csv
import json
import re
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
from pydantic import ValidationError
from typer.testing import CliRunner

from skysim.apps.cli.main import app
from skysim.core import files
from skysim.core.errors import InputError
from skysim.core.paths import ROOT
from skysim.experiments.papers import compare, papers_report, published
from skysim.experiments.papers.compare import (
    Cause,
    ExperimentOptions,
    ExperimentResult,
    FigureDrawing,
    RowResult,
)
from skysim.experiments.papers.published import Experiment, PublishedRow
from skysim.experiments.papers.registry import EXPERIMENTS, check_ids, reproduce
from skysim.results import metrics, plots
from skysim.results.metrics import Summary, exact, proportion

# The law of the verdict.

TEN = PublishedRow(quantity="ten", published=10.0, tolerance=0.5)


def interval(low: float, high: float) -> Summary:
    return Summary((low + high) / 2, low, high, 10)


@pytest.mark.parametrize(
    ("low", "high", "agrees"),
    [
        (9.6, 10.2, True),
        (10.4, 11.0, True),
        (8.0, 9.5, True),
        (10.51, 12.0, False),
        (8.0, 9.49, False),
        (1, 20, True),
    ],
)
def test_a_result_agrees_if_its_interval_overlaps_the_tolerance(
    low: float, high: float, agrees: bool
) -> None:
    assert compare.verdict(TEN, RowResult(interval(low, high))) == (
        "agrees" if agrees else "disagrees"
    )


def test_a_number_without_an_interval_is_compared_alone() -> None:
    nan = float("nan")
    assert compare.verdict(TEN, RowResult(Summary(10.4, nan, nan, 5))) == "agrees"
    assert compare.verdict(TEN, RowResult(Summary(10.6, nan, nan, 5))) == "disagrees"


def test_a_cause_explains_only_a_disagreement_that_it_removes() -> None:
    off = exact(12.0)
    near = exact(10.1)
    assert compare.verdict(TEN, RowResult(off, cause=Cause("tilt", near))) == "explained"
    assert (
        compare.verdict(TEN, RowResult(off, cause=Cause("tilt", exact(11.0)))) == "disagrees"
    )
    assert compare.verdict(TEN, RowResult(near, cause=Cause("tilt", off))) == "agrees"


@pytest.mark.parametrize(
    ("row", "ours", "agrees"),
    [
        (PublishedRow(quantity="x", at_least=0.9), 0.95, True),
        (PublishedRow(quantity="x", at_least=0.9), 0.85, False),
        (PublishedRow(quantity="x", at_least=0.9, tolerance=0.1), 0.85, True),
        (PublishedRow(quantity="x", at_most=0.5), 0.2, True),
        (PublishedRow(quantity="x", at_most=0.5), 0.6, False),
        (PublishedRow(quantity="x", at_least=0.9, at_most=0.97), 0.99, False),
    ],
)
def test_a_bound_is_compared_on_its_side(
    row: PublishedRow, ours: float, agrees: bool
) -> None:
    assert (compare.verdict(row, RowResult(exact(ours))) == "agrees") == agrees


def test_an_interval_wider_than_the_tolerance_is_noted() -> None:
    line = compare.Comparison("x", TEN, RowResult(interval(8, 12), note="few"), "agrees")
    assert line.note == "interval wider than the tolerance; few"
    assert line._replace(result=RowResult(interval(9.8, 10))).note == ""


def test_the_json_of_a_row_has_the_documented_keys() -> None:
    bound = PublishedRow(quantity="share", at_least=0.9, note="of frames")
    line = compare.Comparison("x", bound, RowResult(proportion(95, 100)), "agrees")
    row = line.as_dict()
    assert list(row) == [
        "id",
        "quantity",
        "published",
        "ours",
        "interval",
        "tolerance",
        "verdict",
        "note",
    ]
    assert row["published"] == [0.9, None]
    assert row["ours"] == 0.95
    assert row["interval"][0] < 0.95 < row["interval"][1]


def test_every_published_row_has_one_answer() -> None:
    one = Experiment(title="t", source="s", rows={"ten": TEN})
    with pytest.raises(ValueError, match="eleven, ten"):
        compare.compare("x", one, ExperimentResult({"eleven": RowResult(exact(1))}), 0.0)


# Intervals of few values.


def covered(
    interval: Callable[[np.ndarray], Summary], target: Callable[[np.random.Generator], float]
) -> float:
    """Coverage of the interval of four normal draws of mean 3 and standard deviation 2."""
    hits = 0
    for n in range(TRIED):
        rng = np.random.default_rng([7, n])
        estimate = interval(rng.normal(3.0, 2.0, 4))
        hits += estimate.low <= target(rng) <= estimate.high
    return hits / TRIED


TRIED = 1500


def test_intervals_of_four_values_have_their_stated_coverage() -> None:
    """95 % by t's law; 1500 tries are good to 1.1 % (2 sigma)."""
    assert abs(covered(compare.confidence_interval, lambda rng: 3.0) - 0.95) < 0.018
    assert (
        abs(covered(compare.prediction_interval, lambda rng: rng.normal(3.0, 2.0)) - 0.95)
        < 0.018
    )


@pytest.mark.slow
def test_a_bootstrap_of_four_values_is_widened_to_its_stated_coverage() -> None:
    """Efron's own percentiles hold a mean of four in some 80 %."""
    few = np.random.default_rng(3).normal(3.0, 2.0, (300, 4))
    held = [
        [estimate.low <= 3.0 <= estimate.high for estimate in pair] for pair in map(both, few)
    ]
    bare, wide = np.mean(held, axis=0)
    assert bare < 0.88
    assert wide > 0.91


def both(values: np.ndarray) -> tuple[Summary, Summary]:
    return metrics.resampled(values, np.mean), compare.bootstrap_interval(values, np.mean)


# What was published.


def test_a_row_has_a_number_or_bounds() -> None:
    for wrong in (
        {"quantity": "x"},
        {"quantity": "x", "published": 1, "at_most": 2},
        {"published": 1},
    ):
        with pytest.raises(ValidationError):
            PublishedRow.model_validate(wrong)


def test_a_wrong_file_is_refused_in_one_line(tmp_path: Path) -> None:
    path = tmp_path / "x.yaml"
    path.write_text(
        "paper: P\nexperiments:\n  a:\n    title: T\n    source: S\n    rows:\n      r: {published: 1}\n"
    )
    with pytest.raises(
        InputError, match=r"experiments\.a\.rows\.r\.quantity: missing .*line 7"
    ):
        published.read(path)


def test_exactly_the_published_experiments_are_run() -> None:
    assert set(published.experiments()) == set(EXPERIMENTS)
    assert all(
        one.title and one.source and one.paper for one in published.experiments().values()
    )


# The command.


def asked(*words: str) -> str:
    done = CliRunner().invoke(app, ["reproduce", *words])
    assert done.exit_code == 0, done.output
    return done.output


def test_without_an_id_the_papers_are_listed() -> None:
    assert [line.split()[0] for line in asked().splitlines()] == list(published.experiments())
    assert json.loads(asked("--json"))[0].keys() == {"id", "title", "source"}


def test_an_unknown_id_is_answered_with_the_allowed_ones() -> None:
    with pytest.raises(
        InputError, match=r"unknown experiment 'afit-table-99'; allowed: all, .*afit-table-1"
    ):
        check_ids(["afit-table-99"])
    assert check_ids(["all"]) == list(published.experiments())
    assert check_ids(["afit-table-1", "afit-table-1"]) == ["afit-table-1"]


@pytest.mark.slow
def test_report_and_page_show_the_numbers_of_the_json(tmp_path: Path) -> None:
    markdown = tmp_path / "papers.md"
    words = ["afit-table-1", "--report", "--out", str(tmp_path), "--markdown", str(markdown)]
    shown = asked(*words)
    rows = json.loads(asked("afit-table-1", "--json"))
    html = (tmp_path / "report.html").read_text("utf-8")
    text = markdown.read_text("utf-8")
    for row in rows:
        assert row["quantity"] in shown
        assert row["quantity"] in html
        assert re.search(
            rf"\| {re.escape(row['quantity'])} \| .* \| \**{row['verdict']}\** \|", text
        )
    assert (tmp_path / "papers/afit-table-1_1.png").stat().st_size > 1000
    assert html.count("data:image/png") == 1


def test_disagreements_are_red_in_the_report_and_bold_in_the_page() -> None:
    one = Experiment(title="t", source="s", rows={"ten": TEN, "a | b": TEN})
    found = ExperimentResult(
        {"ten": RowResult(exact(12)), "a | b": RowResult(exact(10))},
        (FigureDrawing("<empty>", lambda fig: None),),
    )
    report = papers_report.papers_report(
        [compare.compare("x", one, found, 0.0)], ("x",), True, 3
    )
    html = report.html()
    text = report.markdown()
    assert re.findall(r'<td class="text (\w+)">(agrees|disagrees)</td>', html) == [
        ("bad", "disagrees"),
        ("good", "agrees"),
    ]
    assert (
        html.count("skysim reproduce x --quick --seed 3")
        == text.count("skysim reproduce x --quick --seed 3")
        == 1
    )
    assert "&lt;empty&gt;" in html
    assert "Of 2 published numbers 1 agree, 0 are explained and 1 disagree" in report.verdict
    assert "| **disagrees** |" in text
    assert "| agrees |" in text


# The page in docs/findings/papers.md and its table, which docs/site/papers.py writes.

FINDINGS = ROOT / "docs/findings"
PAGE = FINDINGS / "papers.md"
NUMBER = r"(-?[\d.]+(?:e[-+]?\d+)?)"
CAUSE = re.compile(rf": {NUMBER}(?: \({NUMBER}\.\.{NUMBER}\))?$")


def parts() -> dict[str, list[dict[str, str]]]:
    """The rows of each experiment in papers.csv by id."""
    found: dict[str, list[dict[str, str]]] = {}
    with (FINDINGS / "papers.csv").open(encoding="utf-8", newline="") as file:
        for row in csv.DictReader(file):
            found.setdefault(row["experiment"], []).append(row)
    return found


def our_summary(cells: dict[str, str]) -> Summary:
    """Our number with its interval."""
    value, low, high = (float(cells[name]) for name in ("ours", "low", "high"))
    return Summary(value, low, high, 1)


def summary_with_cause(text: str) -> Summary:
    """The number with a cause, `name: number (low..high)`, of four digits."""
    found = CAUSE.search(text)
    assert found is not None, text
    value, low, high = (float(one) if one else float(found[1]) for one in found.groups())
    return Summary(value, low, high, 1)


def eased(ours: Summary, share: float) -> Summary:
    """The interval wider by a share of the number, or narrower: texts have four digits."""
    by = share * abs(ours.value)
    return ours._replace(low=ours.low - by, high=ours.high + by)


def rows() -> list[tuple[str, PublishedRow, dict[str, str]]]:
    """Every published row with its row of the table."""
    table = parts()
    return [
        (id, row, cells)
        for id, experiment in published.experiments().items()
        for row, cells in zip(experiment.rows.values(), table[id], strict=True)
    ]


def test_the_table_has_every_published_row_as_it_is_published() -> None:
    assert list(parts()) == list(published.experiments())
    for id, row, cells in rows():
        assert cells["quantity"] == row.quantity, id
        assert cells["published"] == compare.format_with_source(row), id


def test_the_table_s_verdicts_follow_from_its_numbers() -> None:
    slack = 1e-3
    for id, row, cells in rows():
        ours = our_summary(cells)
        explains = bool(cells["cause"]) and compare.intervals_overlap(
            row, eased(summary_with_cause(cells["cause"]), slack)
        )
        allowed = {
            "agrees": compare.intervals_overlap(row, eased(ours, slack)),
            "explained": explains and not compare.intervals_overlap(row, eased(ours, -slack)),
            "disagrees": not compare.intervals_overlap(row, eased(ours, -slack)),
        }
        assert allowed[cells["verdict"]], f"{id}: {row.quantity}"


def test_the_page_counts_the_table_s_verdicts_and_shows_all_that_disagree() -> None:
    text = PAGE.read_text("utf-8")
    table = [cells for lines in parts().values() for cells in lines]
    verdicts = [cells["verdict"] for cells in table]
    counts = [verdicts.count(name) for name in ("agrees", "explained", "disagrees")]
    assert (
        "Of {} published numbers {} agree with ours, {} are explained by a cause that we simulated"
        " and {} disagree.".format(len(table), *counts)
    ) in text
    for cells in table:
        assert (f"\n| {cells['quantity']} |" in text) == (cells["verdict"] == "disagrees")
    assert all(f"\n### {id}\n" in text for id in published.experiments())
    assert (FINDINGS / "papers.png").is_file()


@pytest.mark.long
def test_the_table_is_what_the_command_prints() -> None:
    """All but what is timed."""
    again = json.loads(asked("all", "--json"))
    table = [cells for lines in parts().values() for cells in lines]
    for one, cells in zip(again, table, strict=True):
        if one["id"] not in TIMED:
            assert one["quantity"] == cells["quantity"]
            assert f"{one['ours']:.6g}" == cells["ours"], one["quantity"]
            assert one["verdict"] == cells["verdict"], one["quantity"]


# Every experiment, quickly.

TIMED = {"shefex-fig-3"}  # whose ratio another machine may double
QUICK = ("afit-table-1", "shefex-fig-3", "shefex-figs-4-5")  # about a second each


@pytest.mark.slow
@pytest.mark.parametrize(
    "id",
    [
        pytest.param(id, marks=() if id in QUICK else pytest.mark.long)
        for id in published.experiments()
    ],
)
def test_a_shortened_experiment_has_correct_intervals(id: str) -> None:
    """Each inside its interval; the whole experiment's, on the page, within the two intervals' widths of it; and what
    agrees on the page does not disagree."""
    done = reproduce(id, ExperimentOptions(quick=True))
    lines = list(zip(done.comparisons, parts()[id], strict=True))
    for line, cells in lines:
        ours = line.result.ours
        whole = our_summary(cells)
        assert not ours.low > ours.value + 1e-12, line.row.quantity
        assert not ours.high < ours.value - 1e-12, line.row.quantity
        assert ours.trials > 0, line.row.quantity
        widths = [one.high - one.low for one in (ours, whole)]
        worst_of_few = any(width != width for width in widths)
        share = 1.0 if id in TIMED else 0.35 if worst_of_few else 0.02
        reach = share * abs(whole.value) + (0.0 if worst_of_few else 1.5 * sum(widths))
        assert abs(ours.value - whole.value) <= reach + line.row.tolerance + 1e-9, (
            line.row.quantity
        )
    turned = [
        line.row.quantity
        for line, cells in lines
        if cells["verdict"] == "agrees" and line.verdict == "disagrees"
    ]
    assert turned == [] or id in TIMED
    for drawing in done.drawings:
        assert len(plots.png(drawing.draw, drawing.size_in)) > 1000


@pytest.mark.long
@pytest.mark.parametrize("id", ["afit-table-1", "shefex-figs-4-5", "apl"])
def test_the_same_seed_gives_the_same_numbers(id: str) -> None:
    first, again = (reproduce(id, ExperimentOptions(quick=True, seed=5)) for _ in range(2))
    # NaN is not NaN.
    said = [
        files.to_json([line.as_dict() for line in one.comparisons]) for one in (first, again)
    ]
    assert said[0] == said[1]
