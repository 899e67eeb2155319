"""A small case of each findings page, computed again and compared with what the page says, within its own interval.

All of it takes less than a minute on one core with compiled code. Pages of which nothing is cheap are in NOT_CHEAP.
"""

from __future__ import annotations

import csv
import re
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import pytest
import yaml

from benchmarks import dome_identify
from skysim.core.paths import ROOT, STUDIES
from skysim.experiments.papers.reproduction import Options, reproduce
from skysim.experiments.study.api import run_study
from skysim.results import metrics
from skysim.sources import catalog
from tests.helpers import nearfield

pytestmark = pytest.mark.slow
FINDINGS = ROOT / "docs" / "findings"
NOT_CHEAP = {
    "studies/end_to_end.md": "a run of ten minutes in closed loop takes nine minutes",
    "studies/error_budget.md": "Sobol indices of eleven causes need thousands of trials, half an hour",
    "mutants.md": "runs the tests for hours",
    "robustness.md": "an absence of failures: its tests are run by CI, its long runs take hours",
    "oracles.md": "needs astrometry.net, tetra3rs or GalSim; tests/oracles runs where they are installed",
    "datasheets/shefex2.md": "thousands of frames; a short datasheet is run by the test of the how-to page",
}
ELSEWHERE = {
    "datasheets/papers.md": "docs/test_papers_claims.py",
    "studies.md": "docs/test_docs.py",
}
NUMBER = r"(-?[\d,]*\.?\d+)"
CELL = re.compile(rf"{NUMBER}(?: \({NUMBER}–{NUMBER}\))?")


class Case(NamedTuple):
    """A cell of a study's table: levels of its factors, response, row and column of the cell, and trials to run."""

    study: str
    levels: dict[str, Any]
    response: str
    row: str
    column: str
    trials: int


SEARCH = {
    "leds": 595,
    "radius": "1.277 m",
    "lever": "0.3155 m",
    "lens": "8 mm",
    "survey": "0.05 mm",
}
MONEY = {  # the tape's pitch and spacing give the number of LEDs
    "layout": "tape, 10 cm",
    "brightness": "four",
    "word": "none",
    "drive": "direct",
    "radius": "0.9601 m",
    "lever": "0.1572 m",
    "lens": "12 mm",
    "survey": "0.05 mm",
}
DOME = {
    "radius": "36 in",
    "camera": "15 in",
    "disk": "2 mm",
    "focus": "in focus",
    "f_number": 8,
}
SMEAR = {"rate_deg_s": 6, "exposure": "50 ms", "limit_mag": 5.75}
CASES = [
    Case(
        "dome_shape",
        {"dome": "sphere", "tilt_deg": 30, "solver": "thesis", "leds": 900},
        "cross_arcsec_rms",
        "| thesis |",
        "sphere ″",
        40,
    ),
    Case("dome_size", DOME, "cross_arcsec_median", "| 36 in |", "across ″", 16),
    Case(
        "led_count",
        {"leds": 700, "placement": "poisson"},
        "identified",
        "| 700 |",
        "Poisson disk, solved %",
        200,
    ),
    Case(
        "needed_leds",
        {"leds": 300, "names": "codes"},
        "identified",
        "| 300 |",
        "codes, solved %",
        20,
    ),
    Case(
        "led_brightness",
        {"leds": 400, "levels": "two"},
        "identified",
        "| 400 |",
        "two levels %",
        12,
    ),
    Case(
        "rate_smear",
        {**SMEAR, "chain": "SHEFEX-2"},
        "identified",
        "| 6 |",
        "SHEFEX-2, solved %",
        20,
    ),
    Case(
        "false_stars",
        {"strays": 20, "noise_px": 0.1, "identifier": "default"},
        "identified",
        "| 20 |",
        "default %",
        100,
    ),
    Case(
        "moon_and_planets",
        {"sky": "with bodies", "field": "Venus", "tracker": "default"},
        "identified",
        "| Venus | with bodies |",
        "default, solved %",
        6,
    ),
    Case(
        "ground_night",
        {"air": "refraction", "altitude": "45 deg", "tracker": "default"},
        "cross_arcsec_median",
        "| refraction | 45 deg |",
        "default, across ″",
        12,
    ),
    Case(
        "dome_reflections",
        {"dome": "deep dome", "wall": "silvered", "lens": "clean"},
        "detected_median",
        "| deep dome | silvered |",
        "detected lights",
        6,
    ),
    Case(
        "what_limits_a_dome",
        {"dome": "measured", "cause": "die"},
        "cross_arcsec_rms",
        "| die |",
        "across, measured dome ″",
        8,
    ),
    Case("dome_without_codes", SEARCH, "angle_arcsec_p95", "| 595 |", "within ″", 60),
    Case("dome_for_the_money", MONEY, "angle_arcsec_p95", "| 219 |", "within ″", 60),
]


def cell(page: str, row: str, column: str) -> tuple[float, float, float]:
    """Value, low and high of a cell of a page's table; its row begins with `row`."""
    lines = [
        line for line in (FINDINGS / page).read_text("utf-8").splitlines() if line[:2] == "| "
    ]
    heads = [one.strip() for one in lines[0].split("|")]
    (found,) = [line for line in lines if line.startswith(row)]
    match = CELL.match(found.split("|")[heads.index(column)].strip())
    assert match is not None, found
    value, low, high = (float((one or match[1]).replace(",", "")) for one in match.groups())
    return value, low, high


def one_point(study: str, levels: dict[str, Any], response: str, trials: int) -> str:
    """Text of a study file with a single point of another study and few trials."""
    told = yaml.safe_load((STUDIES / f"{study}.yaml").read_text("utf-8"))
    for name in ("figures", "thresholds", "optimize", "design"):
        told.pop(name, None)
    told["factors"] = {name: told["factors"][name] for name in levels}
    for name, factor in told["factors"].items():
        if "levels" in factor:
            factor["levels"] = {levels[name]: factor["levels"][levels[name]]}
        else:
            keys = {key: factor[key] for key in ("key", "keys") if key in factor}
            told["factors"][name] = keys | {"values": [levels[name]]}
    return yaml.safe_dump(
        told | {"replicates": trials, "responses": [response]}, sort_keys=False
    )


@pytest.mark.parametrize("case", CASES, ids=lambda case: case.study)
def test_a_few_trials_of_a_study_agree_with_its_page(case: Case, tmp_path: Path) -> None:
    """The two intervals of 95 % overlap."""
    path = tmp_path / f"{case.study}.yaml"
    path.write_text(one_point(case.study, case.levels, case.response, case.trials), "utf-8")
    done = run_study(path, out=tmp_path / "out", workers=1)
    assert done.failed == 0
    (row,) = done.table()
    factor = 100 if metrics.is_proportion(case.response) else 1
    ends = [factor * float(row[f"{case.response}_{end}"]) for end in ("low", "high")]
    value = factor * float(row[case.response])
    low, high = (value if np.isnan(end) else end for end in ends)
    _, page_low, page_high = cell(f"studies/{case.study}.md", case.row, case.column)
    assert low <= page_high
    assert high >= page_low


@pytest.mark.parametrize("id", ["shefex-fig-10", "shefex-figs-4-5"])
def test_a_paper_s_numbers_are_those_of_the_table(id: str) -> None:
    """Experiments of a few seconds, as the page's command runs them, to the table's digits."""
    with (FINDINGS / "papers.csv").open(encoding="utf-8", newline="") as file:
        told = [row for row in csv.DictReader(file) if row["id"] == id]
    done = reproduce(id, Options(quick=True))
    for line, row in zip(done.comparisons, told, strict=True):
        assert line.verdict == row["verdict"], line.row.quantity
        assert line.ours.value == pytest.approx(float(row["ours"]), rel=1e-4, abs=1e-9)


def test_the_dome_s_solvers_err_as_its_page_says() -> None:
    """A hundredth of the page's trials scatter by 7 %; four such errors are allowed."""
    geometry = nearfield.GEOMETRIES["sphere"]
    errors = nearfield.errors_deg("infinity", geometry, 30, 50, 1)
    (row,) = re.findall(
        r"^\| stars at infinity, 30° [^|]*\| ([\d.]+) ", dome_page(), flags=re.MULTILINE
    )
    assert nearfield.cross_and_roll(errors)[0] == pytest.approx(float(row), rel=0.3)


def test_the_dome_s_leds_are_found_as_its_page_says() -> None:
    found, _wrong = re.search(
        r"^\| Fibonacci spiral \| 10\.0 \(7\) \| ([\d.]+) % \| (\d+) ",
        dome_page(),
        re.MULTILINE,
    ).groups()  # type: ignore[union-attr]
    (case,) = [case for case in dome_identify.CASES if case.name == "fibonacci"]
    rows = {row["name"]: row["value"] for row in dome_identify.measure_case(case, 200, 2)}
    (identified,) = (value for name, value in rows.items() if "identified" in name)
    assert [value for name, value in rows.items() if "wrong" in name] == [0]
    low, high = metrics.exact_bounds(round(2 * identified), 200)
    assert 100 * low <= float(found) <= 100 * high


def dome_page() -> str:
    """The text of the page of the dome."""
    return (FINDINGS / "dome.md").read_text("utf-8")


def test_the_sky_has_as_many_stars_as_the_page_of_validation_says() -> None:
    text = (FINDINGS / "validation.md").read_text("utf-8")
    (told,) = re.findall(r"\| stars to V 5, 6, 7 \| ([\d,]+), ([\d,]+), ([\d,]+);", text)
    magnitude = catalog.read("gaia_v8.0").v_mag
    counts = [int(np.sum(magnitude < limit)) for limit in (5, 6, 7)]
    assert counts == [int(one.replace(",", "")) for one in told]


def test_every_findings_page_is_computed_again_or_says_why_not() -> None:
    pages = {path.relative_to(FINDINGS).as_posix() for path in FINDINGS.rglob("*.md")}
    covered = {f"studies/{case.study}.md" for case in CASES} | {"papers.md", "dome.md"}
    assert covered | {"validation.md"} | NOT_CHEAP.keys() | ELSEWHERE.keys() == pages
    for page, test in ELSEWHERE.items():
        assert page in (ROOT / "tests" / test).read_text("utf-8")
