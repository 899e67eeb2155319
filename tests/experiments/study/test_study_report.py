"""The report of a study: its numbers are the store's, and each figure is in its section."""

from __future__ import annotations

import itertools
import math
import re
from html.parser import HTMLParser
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest

from skysim.core.errors import InputError
from skysim.experiments.study import factors as designs
from skysim.experiments.study import search
from skysim.experiments.study import table as axes
from skysim.experiments.study.execution import store
from skysim.experiments.study.execution.outcomes import Outcome
from skysim.experiments.study.execution.trials import Row
from skysim.experiments.study.factors import Point
from skysim.experiments.study.plan import Curve, Heat, Study
from skysim.experiments.study.report import figures, layout, study_report
from skysim.experiments.study.report.figures import color_scale
from skysim.experiments.study.report.overview import Overview
from skysim.experiments.study.report.study_report import POINTS, Analysis
from skysim.experiments.study.table import (
    Index,
    PointRow,
    PointTable,
    format_level,
    format_response,
    has_few_values,
    table,
    without_responses,
)
from skysim.results.metrics import Summary
from skysim.results.plots import INK

COMMAND = "skysim study run 'a <b> & \"c\".yaml' --set=x=</code><script>alert(1)</script>"
REPLAY = "skysim study replay FILE"
TILT = {"key": "trial.tilt_deg", "values": [20, 0, 10]}
DOME: dict[str, Any] = {"levels": {name: {} for name in ("sphere", "flat", "cube")}}
RADIUS = {"key": "light.radius", "values": ["48 in", "24 in", "96 in"]}
RING = {"key": "trial.tilt_deg", "values": [[10, 20], [0, 10]]}


def study(**keys: Any) -> Study:
    base = {
        "schema": 1,
        "title": "Which <dome>?",
        "scene": "afit_simsat",
        "seed": 11,
        "replicates": 20,
    }
    base |= {
        "trial": {"kind": "centroids"},
        "responses": ["identified", "cross_arcsec_median"],
    }
    return Study.model_validate(base | {"factors": {"tilt": TILT}} | keys)


def points(asked: Study) -> list[Point]:
    return designs.points(asked.design, asked.factors, asked.seed)


def outcome(point: int, replicate: int) -> Outcome:
    """A known outcome: at point p the first p of each ten replicates are refused, the others err by p + 1 arcsec."""
    if replicate % 10 < point % 10:
        return Outcome("refused", 1, stars=4)
    return Outcome("solved", 1, 1, 0, 0.6 * (point + 1), 0.8 * (point + 1), 5.0, 3.0, 9)


def filled(
    path: Path,
    asked: Study,
    tried: list[Point] | None = None,
    done: int | None = None,
    failed: int = 0,
) -> Path:
    tried = points(asked) if tried is None else tried
    rows = []
    for trial in range(len(tried) * asked.replicates)[:done]:
        point, replicate = divmod(trial, asked.replicates)
        error = f"Traceback\nValueError: <b>{trial}</b>" if trial < failed else None
        result = Outcome("failed") if error else outcome(point, replicate)
        rows.append(
            Row(trial, point, replicate, trial, "scene", "cafe", result, error, 0.001)
        )
    with store.writing(path) as kept:
        kept.begin(
            kept.points(),
            study="title: Which <dome>?",
            code="cafe0123",
            replicates=str(asked.replicates),
        )
        kept.set_points(tried)
        kept.add(rows)
        kept.record_run("pool", 2, len(rows), 4.0)
    return path


def lines_of(path: Path, asked: Study) -> PointTable:
    with store.open_store(path) as kept:
        return PointTable(asked, table(kept, study_report.responses(asked)))


class Html(HTMLParser):
    """A page: texts of its elements by class or id, rows of tables and their sort keys by section, images, sources."""

    def __init__(self, text: str) -> None:
        super().__init__()
        self.said: dict[str, str] = {}
        self.tables: dict[str, list[list[str]]] = {}
        self.marked: list[bool] = []
        self.keys: list[list[str]] = []
        self.images: list[str] = []
        self.sources: list[str] = []
        self.tags: list[str] = []
        self._inside: list[str] = []
        self._title = self._section = ""
        self._in_title = self._cell = False
        self.feed(text)

    def handle_starttag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        attributes = dict(attrs)
        self.tags.append(tag)
        self.sources += [
            attributes[name] or "" for name in ("src", "href") if name in attributes
        ]
        if tag == "img":
            self.images.append(attributes["src"] or "")
        if tag in ("p", "code", "div", "pre"):
            self._inside.append(
                (attributes.get("id") or attributes.get("class") or tag).strip()
            )
        if tag in ("h2", "summary"):
            self._in_title = True
            self._title = ""
        if tag == "table":
            self.tables.setdefault(self._section, [])
        if tag == "tr":
            self.tables[self._section].append([])
            if self._section == POINTS:
                self.marked.append(False)
                self.keys.append([])
        if tag in ("td", "th"):
            self._cell = True
            self.tables[self._section][-1].append("")
        if tag == "td" and self._section == POINTS:
            self.keys[-1].append(attributes["data-key"] or "")
            self.marked[-1] |= "marked" in (attributes["class"] or "")

    def handle_endtag(self, tag: str) -> None:
        if tag in ("p", "code", "div", "pre"):
            self._inside.pop()
        if tag in ("h2", "summary"):
            self._in_title = False
            self._section = self._title
        if tag in ("td", "th"):
            self._cell = False

    def handle_data(self, data: str) -> None:
        for name in self._inside:
            self.said[name] = self.said.get(name, "") + data
        if self._in_title:
            self._title += data
        if self._cell:
            self.tables[self._section][-1][-1] += data


def written(path: Path, asked: Study, **more: Any) -> tuple[str, Html]:
    with store.open_store(path) as kept:
        scene = [("scene", "afit_simsat"), ("trials", "20 at each point; seed 11")]
        about = Overview(scene, [], False, (), {}, 0.0)
        lines = PointTable(asked, table(kept, study_report.responses(asked)))
        nothing: dict[str, Any] = dict.fromkeys(Analysis._fields[2:], ())
        nothing |= {"verdict": "", "result": None}
        found = Analysis(lines, about, **nothing | more)
        text = study_report.compose(
            kept, found, lambda verb: REPLAY if verb == "replay" else COMMAND
        ).html()
    return text, Html(text)


@pytest.fixture
def bare(monkeypatch: pytest.MonkeyPatch) -> None:
    """Pages without figures, to save time."""
    monkeypatch.setattr(study_report, "study_figures", lambda *_: [])


# The page.


@pytest.mark.usefixtures("bare")
def test_every_number_of_the_report_is_the_store_s(tmp_path: Path) -> None:
    asked = study(factors={"dome": DOME, "tilt": TILT})
    path = filled(tmp_path / "s.sqlite", asked, failed=3)
    _, html = written(path, asked)
    with store.open_store(path) as kept:
        counts, lines = kept.counts(), table(kept, asked.responses)
    said = f"{counts['done']} of {9 * 20} trials, {counts['failed']} failed, {counts['wrong']} wrong attitudes"
    assert html.said["verdict bad"].startswith(said)
    assert (counts["failed"], counts["wrong"]) == (3, 0)
    assert dict(html.tables["Scene"])["code version"] == "cafe0123"
    assert html.tables[POINTS][0] == ["point", "dome", "tilt", *asked.responses]
    assert html.tables[POINTS][1:] == [
        [
            str(one.point),
            *map(format_level, one.levels.values()),
            *(format_response(one, name) for name in one.responses),
        ]
        for one in lines
    ]
    assert html.tables["Runs"][1:] == [["pool", "2", "180", "4.0", "45"]]
    assert html.said["pre"] == "title: Which <dome>?"
    assert "Not finished" not in html.said["verdict bad"]


def test_the_command_is_escaped_and_nothing_is_loaded_from_outside(tmp_path: Path) -> None:
    asked = study()
    text, html = written(filled(tmp_path / "s.sqlite", asked, failed=1), asked)
    assert html.said["command"] == COMMAND
    assert html.tags.count("script") == 1  # the page's own
    assert "<title>Which &lt;dome&gt;?</title>" in text
    assert not re.search(
        r"https?:|//[a-z]", re.sub(r"data:image/png;base64,[\w+/=]+", "", text)
    )
    assert html.sources == html.images
    assert all(source.startswith("data:image/png;base64,") for source in html.sources)


@pytest.mark.usefixtures("bare")
@pytest.mark.parametrize("done", [0, 31])
def test_a_half_finished_study_is_reported_as_such(tmp_path: Path, done: int) -> None:
    asked = study()
    _, html = written(filled(tmp_path / "s.sqlite", asked, done=done), asked)
    assert html.said["verdict warning"].startswith(f"{done} of 60 trials, ")
    assert "Not finished" in html.said["verdict warning"]
    assert html.tables[POINTS][3][2] == "-"  # a point without a trial
    assert html.keys[3][2] == ""  # sorted last


@pytest.mark.usefixtures("bare")
def test_the_first_ten_failures_are_listed_with_their_replay_command(tmp_path: Path) -> None:
    asked = study()
    _, html = written(filled(tmp_path / "s.sqlite", asked, failed=12), asked)
    items = html.said["items bad"]
    assert re.findall(r"trial (\d+): ValueError: <b>(\d+)</b>", items) == [
        (str(n), str(n)) for n in range(10)
    ]
    assert items.startswith("12 trials failed")
    assert "skysim study replay FILE 0" in items


@pytest.mark.usefixtures("bare")
def test_a_killed_run_is_reported(tmp_path: Path) -> None:
    asked = study()
    path = filled(tmp_path / "s.sqlite", asked)
    with store.writing(path) as kept, kept.db:
        kept.db.execute("DELETE FROM runs")
    assert "60 trials are of runs that were killed" in written(path, asked)[0]


@pytest.mark.usefixtures("bare")
def test_names_sort_in_the_studys_order_and_quantities_by_their_number(
    tmp_path: Path,
) -> None:
    asked = study(factors={"dome": DOME, "radius": RADIUS})
    _, html = written(filled(tmp_path / "s.sqlite", asked), asked)
    by_dome, by_radius = ({row[n]: float(key[n]) for row, key in table} for n, table in (
        (n, list(zip(html.tables[POINTS][1:], html.keys[1:], strict=True))) for n in (1, 2)
    ))  # fmt: skip
    assert by_dome == {"sphere": 0, "flat": 1, "cube": 2}
    assert by_radius == {"48 in": 48, "24 in": 24, "96 in": 96}


@pytest.mark.slow
@pytest.mark.parametrize(
    ("keys", "count"),
    [
        ({}, 2),
        ({"factors": {"dome": DOME}}, 2),
        ({"factors": {"dome": DOME, "ring": RING}}, 2),
        ({"factors": {"tilt": TILT, "dome": DOME}, "design": {"kind": "one_at_a_time"}}, 4),
        ({"figures": [{"kind": "curve", "x": "tilt", "y": "wrong", "log": True}]}, 1),
        (
            {"factors": {"tilt": TILT, "dome": DOME}}
            | {
                "figures": [
                    {
                        "kind": "heat",
                        "x": "tilt",
                        "y": "dome",
                        "value": "stars_least",
                        "log": True,
                    }
                ]
            },
            1,
        ),
        (
            {
                "factors": {"tilt": {"key": "a", "from": 1, "to": 9}},
                "design": {"kind": "lhs", "points": 80},
            },
            2,
        ),
    ],
)
def test_every_kind_of_figure_is_drawn(
    tmp_path: Path, keys: dict[str, Any], count: int
) -> None:
    asked = study(**keys)
    html = written(filled(tmp_path / "s.sqlite", asked), asked)[1]
    assert len(html.images) == count
    assert len(set(html.images)) == count


@pytest.mark.long
def test_indices_and_a_search_have_figures(tmp_path: Path) -> None:
    part = Summary(0.4, 0.3, 0.5, 8)
    index = [Index("tilt", name, part, part, 1.0) for name in ("cross_arcsec", "roll_arcsec")]
    factors = {"tilt": {"key": "a", "from": 1, "to": 9}}
    asked = study(
        factors=factors, design={"kind": "saltelli", "points": 4}, responses=["identified"]
    )
    html = written(filled(tmp_path / "a.sqlite", asked), asked, indices=index)[1]
    assert len(html.images) == 2 + 1
    assert html.tables["Sobol indices"][1] == [
        "cross_arcsec",
        "tilt",
        "1",
        "0.4 (0.3..0.5)",
        "0.4 (0.3..0.5)",
    ]
    objectives = [{"response": "cross_arcsec_median"}, {"response": "cost"}]
    wanted = {
        "objectives": objectives,
        "constraints": [{"response": "stars_least", "at_least": 5}],
    }
    asked = study(
        factors=factors, optimize=wanted | {"candidates": 4}, responses=["identified"]
    )
    tried = [designs.make_point({"tilt": (n, {"a": n})}) for n in range(3)]
    path = filled(tmp_path / "b.sqlite", asked, tried)
    statistics = dict.fromkeys(("cross_arcsec_median", "stars_least"), part)
    candidates = [
        search.Candidate(n, {"tilt": n}, (1.0, cost), statistics, cost, True, False, "")
        for n, cost in enumerate((7.0, 2.5))
    ]
    html = written(
        path, asked, result=search.SearchResult(candidates, candidates[1:], False)
    )[1]
    assert len(html.images) == 2 + 1
    assert html.marked[1:] == [False, True, False]
    assert [row[-1] for row in html.tables[POINTS]] == ["cost", "7", "2.5", "–"]
    assert html.tables["Front"][1:] == [["1", "1", "0.4 (0.3..0.5)", "2.5", "0.4 (0.3..0.5)"]]
    assert "Not finished" in html.said["verdict warning"]  # three of four candidates


# What is shown.


def test_a_curve_holds_the_other_factors_and_takes_its_values_from_the_trials(
    tmp_path: Path,
) -> None:
    asked = study(factors={"dome": DOME, "radius": RADIUS, "ring": RING})
    lines = lines_of(filled(tmp_path / "s.sqlite", asked), asked)
    curve = Curve(kind="curve", x="radius", y="identified", by="dome")
    for where, ring in (({}, 0), ({"ring": [0, 10]}, 1)):
        shown = layout.series(lines, curve.model_copy(update={"where": where}))
        assert [one.label for one in shown] == ["sphere", "flat", "cube"]
        for dome, one in enumerate(shown):
            # Points go with the last factor fastest; radii stand in the file as 48, 24, 96.
            numbers = [6 * dome + 2 * radius + ring for radius in (1, 0, 2)]
            assert one.x.tolist() == [24, 48, 96]
            assert one.value == pytest.approx([1 - (n % 10) / 10 for n in numbers], abs=1e-12)
            assert np.all((one.low <= one.value + 1e-12) & (one.value <= one.high + 1e-12))
    assert "at ring = 10, 20" in layout.caption(curve, lines)


def test_figures_draw_the_arranged_data(tmp_path: Path) -> None:
    from matplotlib.figure import Figure as Canvas

    asked = study(replicates=10)  # too few for a median's interval at every point
    lines = lines_of(filled(tmp_path / "s.sqlite", asked), asked)
    fig = Canvas()
    curve = Curve(kind="curve", x="tilt", y="cross_arcsec_median")
    figures.draw_curve(fig, lines, curve)
    (axes,) = fig.axes
    drawn = [line for line in axes.lines if line.get_linestyle() == "-"]
    assert [line.get_xdata().tolist() for line in drawn] == [[0, 10, 20]]
    assert drawn[0].get_ydata() == pytest.approx([2.0, 3.0, 1.0])  # file order is 20, 0, 10
    assert (axes.get_xlabel(), axes.get_ylabel()) == ("tilt [deg]", "cross median [arcsec]")


def test_a_point_without_an_interval_has_no_bar_and_the_caption_names_the_trials_needed() -> (
    None
):
    from matplotlib.figure import Figure as Canvas

    nan = math.nan
    levels = zip(
        [20, 0, 10], [(5, 4, 9, 70, 0), (3, 0, 6, 70, 0), (8, nan, nan, 40, 19)], strict=True
    )
    lines = [
        PointRow(n, {"tilt": one}, {"roll_arcsec_p95": Summary(*summary)}, 70)
        for n, (one, summary) in enumerate(levels)
    ]
    for log in (False, True):
        fig = Canvas()
        curve = Curve(kind="curve", x="tilt", y="roll_arcsec_p95", log=log)
        figures.draw_curve(fig, PointTable(study(), lines), curve)
        (axes,) = fig.axes
        low = axes.get_ylim()[0]
        ends = {
            round(one[0, 0]): sorted(one[:, 1])
            for one in axes.collections[0].get_segments()
            if len(one)
        }
        assert ends[20] == [4, 9]
        assert ends[0][0] == (low / 10 if log else 0)
        assert np.isnan(ends.get(10, [nan])).all()
        assert "none where a point needs up to 19 more trials" in layout.caption(
            curve, PointTable(study(), lines)
        )


def test_points_of_few_values_are_hollow_numbered_and_not_connected() -> None:
    """Of 60 trials each, 60, 12 and 50 have a value: the middle one has a marker of its own and parts the line."""
    from matplotlib.figure import Figure as Canvas

    lines = [
        PointRow(
            n, {"tilt": tilt}, {"cross_arcsec_median": Summary(3.0 + n, 2.0, 9.0, count)}, 60
        )
        for n, (tilt, count) in enumerate([(0, 60), (10, 12), (20, 50)])
    ]
    curve = Curve(kind="curve", x="tilt", y="cross_arcsec_median")
    fig = Canvas()
    figures.draw_curve(fig, PointTable(study(), lines), curve)
    (axes,) = fig.axes
    joined = next(line for line in axes.lines if line.get_linestyle() == "-")
    assert joined.get_ydata() == pytest.approx([3, np.nan, 5], nan_ok=True)
    hollow = [
        line
        for line in axes.lines
        if line.get_markerfacecolor() == "white" and len(line.get_xdata())
    ]
    assert [(line.get_xdata().tolist(), line.get_ydata().tolist()) for line in hollow] == [
        ([10], [4.0])
    ]
    assert [text.get_text() for text in axes.texts] == ["n=12"]
    assert "Hollow, without a line: few of the point's trials" in layout.caption(
        curve, PointTable(study(), lines)
    )
    heat = layout.grid(
        PointTable(study(), lines),
        Heat(kind="heat", x="tilt", y="tilt", value="cross_arcsec_median"),
    )
    assert [[bool(heat.few[n, n]), int(heat.values[n, n])] for n in range(3)] == [
        [False, 60],
        [True, 12],
        [False, 50],
    ]


@pytest.mark.parametrize(
    ("values", "trials", "few"),
    [
        (60, 60, False),
        (30, 60, False),
        (29, 60, True),
        (9, 10, False),
        (4, 6, True),
        (3, 3, False),
        (0, 60, False),
    ],
)
def test_points_have_few_values_below_half_or_below_five(
    values: int, trials: int, few: bool
) -> None:
    row = PointRow(0, {}, {"nees_mean": Summary(1.0, 1.0, 1.0, values)}, trials)
    assert has_few_values(row, "nees_mean") == few


def test_shares_are_drawn_from_zero_to_one() -> None:
    """Curves, heat maps and the panels of searches alike, whatever the values."""
    from matplotlib.figure import Figure as Canvas

    responses = {"identified": Summary(0.31, 0.3, 0.32, 99)}
    lines = [PointRow(n, {"tilt": tilt}, responses, 99) for n, tilt in enumerate((0, 10, 20))]
    fig = Canvas()
    figures.draw_curve(
        fig, PointTable(study(), lines), Curve(kind="curve", x="tilt", y="identified")
    )
    assert fig.axes[0].get_ylim() == (-0.03, 1.03)
    heat = Heat(kind="heat", x="tilt", y="tilt", value="identified")
    scales = [color_scale(np.array(values), heat) for values in ([0.3, 0.31], [0.9, 1.0], [])]
    assert {(one["cmap"], one["norm"].vmin, one["norm"].vmax) for one in scales} == {
        ("cividis", 0, 1)
    }
    other = color_scale(np.array([3.0, 9.0]), heat.model_copy(update={"value": "nees_mean"}))
    assert (other["cmap"] != "cividis", other["norm"].vmin, other["norm"].vmax) == (
        True,
        3,
        9,
    )


def test_a_curve_of_nees_has_a_line_at_three() -> None:
    from matplotlib.figure import Figure as Canvas

    lines = [
        PointRow(n, {"tilt": tilt}, {"nees": Summary(9.0, 8.0, 10.0, 99)}, 99)
        for n, tilt in enumerate((0, 10))
    ]
    curve = Curve(kind="curve", x="tilt", y="nees")
    fig = Canvas()
    figures.draw_curve(fig, PointTable(study(), lines), curve)
    (axes,) = fig.axes
    assert [one.get_ydata() for one in axes.lines if one.get_linestyle() == ":"] == [[3, 3]]
    assert axes.get_ylim()[0] < 3
    assert "Dotted: 3, where the claimed errors are true." in layout.caption(
        curve, PointTable(study(), lines)
    )
    assert (
        layout.expected_value("nees_p95")
        is layout.expected_value("cross_arcsec_mean")
        is None
    )


def test_a_heat_map_has_its_cells_in_order_and_nan_where_nothing_is(tmp_path: Path) -> None:
    asked = study(factors={"dome": DOME, "tilt": TILT})
    lines = lines_of(filled(tmp_path / "s.sqlite", asked, done=8 * 20), asked)
    heat = Heat(kind="heat", x="tilt", y="dome", value="cross_arcsec_median")
    cell = layout.grid(lines, heat)
    assert (cell.x.levels, cell.y.levels) == ([0, 10, 20], ["sphere", "flat", "cube"])
    # Tilts stand in the file as 20, 0, 10; the last point, cube at 10 degrees, is not done.
    assert cell.value == pytest.approx(
        np.array([[2, 3, 1], [5, 6, 4], [8, np.nan, 7.0]]), nan_ok=True
    )


def test_axes_know_numbers_quantities_names_and_lists() -> None:
    def axis(factor: dict[str, Any], levels: list[Any]) -> axes.Axis:
        lines = [PointRow(n, {"a": one}, {}) for n, one in enumerate(levels)]
        return PointTable(study(factors={"a": factor}), lines).axes["a"]

    quantity = axis(RADIUS, ["96 in", "24 in", "48 in"])
    assert quantity[:3] == ("a [in]", ["24 in", "48 in", "96 in"], True)
    rings = axis(RING, [[0, 10], [10, 20]])
    assert rings[:3] == ("a [deg]", [[10, 20], [0, 10]], False)
    assert rings.coordinate([0, 10]) == 1
    assert axis({"key": "x", "values": [True, False]}, [False, True])[1:3] == (
        [True, False],
        False,
    )
    assert axis({"key": "x", "values": ["1 m", "1 ft"]}, ["1 ft", "1 m"])[1:3] == (
        ["1 m", "1 ft"],
        False,
    )
    steps = {"key": "x", "from": 1, "to": 1000}
    assert [
        axis(steps | {"scale": one}, [1, 10, 100, 1000]).log for one in ("linear", "log")
    ] == [
        False,
        True,
    ]
    assert [
        axis({"key": "x", "values": v}, v).log
        for v in ([50, 100, 200, 800], [0, 1, 10, 100], [1, 5, 9, 13])
    ] == [
        True,
        False,
        False,
    ]


def test_equal_levels_in_different_units_are_one() -> None:
    assert axes.same("5 m", "5.0 m")
    assert axes.same([0, 10], [0.0, 10.0])
    assert not axes.same("5 m", "5 ft")
    assert not axes.same("5 m", 5)


def test_an_unknown_name_in_where_is_answered_with_the_known_ones() -> None:
    asked = study(factors={"dome": DOME, "tilt": TILT})
    lines = without_responses(asked, points(asked))
    for where, said in (
        ({"dome": "bowl"}, "unknown level 'bowl'; allowed: sphere, flat, cube"),
        ({"x": 1}, "allowed: dome, tilt"),
    ):
        with pytest.raises(InputError, match=said):
            lines.shown_in(Curve(kind="curve", x="tilt", y="wrong", where=where))


def test_default_figures_follow_from_the_factors() -> None:
    many = {"key": "x", "from": 0, "to": 1, "steps": 12}

    def chosen(**keys: Any) -> list[tuple[Any, ...]]:
        asked = study(responses=["wrong"], **keys)
        tried = points(asked)
        lines = [
            PointRow(n, one.levels, {"wrong": Summary(0.0, 0.0, 0.1, 9)})
            for n, one in enumerate(tried)
        ]
        return [
            tuple(one.model_dump(exclude={"where", "log"}).values())
            for one in layout.figures(PointTable(asked, lines))
        ]

    assert chosen() == [("curve", "tilt", "wrong", None)]
    assert chosen(factors={"dome": DOME, "tilt": TILT}) == [
        ("curve", "tilt", "wrong", "dome")
    ]
    assert chosen(factors={"tilt": TILT, "n": many}) == [("heat", "tilt", "n", "wrong")]
    assert chosen(factors={"tilt": TILT, "dome": DOME, "n": many}) == [
        ("curve", "tilt", "wrong", "dome")
    ]
    assert chosen(factors={"tilt": {"key": "x", "values": [5]}}) == []
    drawn = {"factors": {"n": many, "dome": DOME}, "design": {"kind": "lhs", "points": 9}}
    assert chosen(**drawn) == [
        ("curve", "n", "wrong", None),
        ("curve", "dome", "wrong", None),
    ]


def test_drawn_factors_divide_points_into_equal_bands() -> None:
    rng = np.random.default_rng(3)
    asked = study(
        factors={name: {"key": name, "from": 0, "to": 1} for name in "xb"},
        design={"kind": "lhs", "points": 40},
    )
    lines = [
        PointRow(n, {"x": float(x), "b": float(b)}, {"nees_mean": Summary(float(b), 0, 1, 5)})
        for n, (x, b) in enumerate(rng.random((40, 2)))
    ]
    shown = layout.series(
        PointTable(asked, lines), Curve(kind="curve", x="x", y="nees_mean", by="b")
    )
    assert [len(one.x) for one in shown] == [10] * 4
    assert all(
        before.value.max() < after.value.min() for before, after in itertools.pairwise(shown)
    )
    assert all((np.diff(one.x) > 0).all() for one in shown)


def test_a_search_is_shown_by_candidate_with_its_bounds() -> None:
    constraints = [
        {"response": "cost", "at_most": 9},
        {"response": "wrong", "at_least": 0, "at_most": 0.1},
    ]
    asked = study(
        optimize={
            "objectives": [{"response": "identified", "better": "more"}],
            "constraints": constraints,
        }
    )
    assert asked.optimize is not None
    responses = {"identified": Summary(0.5, 0.4, 0.6, 9), "wrong": Summary(0.2, 0.1, 0.3, 9)}
    panels = layout.panels(
        [PointRow(n, {"tilt": n}, responses) for n in (0, 1)], asked.optimize, {1: 4.0}
    )
    assert list(panels) == ["identified", "cost", "wrong"]
    assert panels["identified"].label == "identified [share], more is better"
    assert panels["cost"].value == pytest.approx([np.nan, 4.0], nan_ok=True)
    assert panels["cost"].bounds == [9]
    assert panels["wrong"].bounds == [0, 0.1]
    assert panels["wrong"].high.tolist() == [0.3, 0.3]


def test_each_figure_is_a_file_of_its_own(tmp_path: Path) -> None:
    asked = study(factors={"dome": DOME, "tilt": TILT})
    lines = lines_of(filled(tmp_path / "s.sqlite", asked), asked)
    curve = Curve(kind="curve", x="tilt", y="identified", by="dome")
    shown = figures.figure_png(lines, curve)
    picture = cv2.imdecode(np.frombuffer(shown, np.uint8), cv2.IMREAD_COLOR)
    assert picture.shape[1] == 888
    for ink in INK[:3]:  # every line's
        bgr = [int(ink[n : n + 2], 16) for n in (5, 3, 1)]
        assert (picture == bgr).all(axis=2).sum() > 50
    assert shown == figures.figure_png(lines, curve)
