"""Every file of benchmarks/ belongs to an area, and the commands that the pages name are areas."""

from __future__ import annotations

import ast
import re
from pathlib import Path

import pytest

from benchmarks import AREAS, accept, chosen
from benchmarks.__main__ import left_out, main
from skysim.core.paths import ROOT

FOLDER = ROOT / "benchmarks"
SHARED = {"__init__", "__main__", "accept", "peers", "timing"}  # of no area


def parameters(area: str) -> set[str]:
    """The parameters of an area's `measure`, without its import."""
    tree = ast.parse((FOLDER / f"{area}.py").read_text(encoding="utf-8"))
    (measure,) = (
        node
        for node in tree.body
        if isinstance(node, ast.FunctionDef) and node.name == "measure"
    )
    return {argument.arg for argument in measure.args.args}


def test_every_file_is_an_area() -> None:
    assert {path.stem for path in FOLDER.glob("*.py")} == AREAS.keys() | SHARED


@pytest.mark.parametrize("area", AREAS)
def test_an_area_takes_the_options_of_its_quick_part(area: str) -> None:
    assert (AREAS[area].quick or {}).keys() | accept.QUICK.get(area, {}).keys() <= parameters(
        area
    )


def test_a_group_s_name_stands_for_all_its_areas() -> None:
    assert chosen("dome") == [area for area in AREAS if area.startswith("dome_")]
    assert chosen("rate") == ["rate"]
    assert chosen("nothing") == []


def test_what_a_quick_run_leaves_out_is_named() -> None:
    text = left_out(list(AREAS))
    assert "Not measured: rolling, " in text
    assert re.search(r"in part: .*\bnees\b", text)


def test_an_unknown_area_is_refused_with_the_allowed_ones(
    capsys: pytest.CaptureFixture[str],
) -> None:
    with pytest.raises(SystemExit):
        main(["optics"])
    assert "'optics' is not an area; allowed: instrument, detect" in capsys.readouterr().err


PAGES = [
    *ROOT.glob("*.md"),
    *(ROOT / "docs").rglob("*.md"),
    *(ROOT / "estimator").rglob("*.md"),
]


@pytest.mark.parametrize("page", PAGES, ids=lambda page: str(page.relative_to(ROOT)))
def test_a_page_s_benchmarks_exist(page: Path) -> None:
    """`python -m benchmarks.module` is a command of earlier versions."""
    text = page.read_text(encoding="utf-8")
    assert "python -m benchmarks." not in text
    named = re.findall(r"python -m benchmarks ((?:[a-z_]+ ?)+)", text)
    areas = {area for words in named for area in words.split()}
    assert {area for area in areas if area != "accept" and not chosen(area)} == set()


def test_rows_of_the_quick_run_are_kept_and_judged(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    """Of two areas one misses its bar; shares and times are no bars of the quick run."""
    row = {"peer": "", "peer_value": None, "ratio": None}
    measured = {
        "good": [row | {"name": "lost", "value": 0, "unit": "fields", "bar": 0, "met": True}],
        "bad": [
            row | {"name": "wrong", "value": 1, "unit": "frames", "bar": 0, "met": False},
            row | {"name": "time", "value": 9.0, "unit": "ms", "bar": 1, "met": False},
        ],
    }
    monkeypatch.setattr(accept, "QUICK", {"good": {"count": 2}, "bad": {}})
    monkeypatch.setattr(accept, "QUICK_RESULTS", tmp_path / "accept.json")
    monkeypatch.setattr(accept, "measured", lambda area, options: measured[area])
    assert accept.main(quick=True) == 1
    assert (
        "missed: bad: wrong: 1 frames, bar 0 (python -m benchmarks bad)"
        in capsys.readouterr().out
    )
    rows = accept.rows_by_command(tmp_path / "accept.json")
    assert rows.keys() == {"python -m benchmarks good --count=2", "python -m benchmarks bad"}
    ((kept,), (wrong,)) = rows.values()
    assert (kept["figure"], kept["bar"], kept["met"]) == (0, 0, True)
    assert (wrong["name"], wrong["code"]) == ("bad: wrong", kept["code"])
