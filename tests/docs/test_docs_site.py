"""What the site makes from the code: the reference of commands, keys and responses; and what pages say to make."""

from __future__ import annotations

import importlib.util
import os
import re
import shutil
import subprocess
from pathlib import Path
from types import ModuleType

import pytest
from typer.testing import CliRunner

from skysim.apps.cli import main
from skysim.core.paths import ROOT
from skysim.results import metrics
from skysim.scene.scene import ExposureConfig
from skysim.scene.sections.tracker import SurveyErrorsConfig


def of_the_site(name: str) -> ModuleType:
    """A module next to the site's settings, outside of any package."""
    spec = importlib.util.spec_from_file_location(name, ROOT / "docs" / "site" / f"{name}.py")
    assert spec is not None
    assert spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


keys, reference = of_the_site("keys"), of_the_site("reference")
GENERATED = {name: part() for name, part in reference.PARTS.items()}
PAGES = {
    path: path.read_text(encoding="utf-8")
    for path in sorted((ROOT / "docs" / "reference").glob("*.md"))
}
SECTIONS = dict(
    re.findall(
        r"^##+ `skysim ?([^`]*)`\n(.*?)(?=^##|\Z)",
        GENERATED["commands"],
        re.DOTALL | re.MULTILINE,
    )
)


def helped(*words: str) -> str:
    """Text of --help on a wide terminal."""
    result = CliRunner().invoke(
        main.app, [*words, "--help"], env={"COLUMNS": "300", "TERMINAL_WIDTH": "300"}
    )
    assert result.exit_code == 0, result.output
    return re.sub(r"\x1b\[[0-9;]*m", "", result.output)


@pytest.mark.slow
def test_every_command_that_help_names_has_its_section() -> None:
    shown = {
        name: re.findall(r"^│ ([a-z][a-z-]*)  ", helped(*name.split()), re.MULTILINE)
        for name in SECTIONS
    }
    assert len(shown[""]) >= 15
    named_commands = {
        f"{name} {below}".strip() for name, all_below in shown.items() for below in all_below
    }
    assert named_commands | {""} == set(SECTIONS)


@pytest.mark.slow
@pytest.mark.parametrize("name", SECTIONS)
def test_a_section_has_the_options_that_help_shows(name: str) -> None:
    """Each option and argument has a description."""
    starts = re.findall(r"^│[ *]+((?:--[a-z0-9-]+ +)+)", helped(*name.split()), re.MULTILINE)
    shown = {option for start in starts for option in start.split()}
    rows = dict(re.findall(r"^\| `([^`]+)` \| (.*) \|$", SECTIONS[name], re.MULTILINE))
    listed = {option for what in rows for option in re.findall(r"--[a-z0-9-]+", what)}
    assert listed | {"--help"} == shown
    assert [what for what, meaning in rows.items() if not re.match(r"\w", meaning)] == []


def test_a_key_s_row_states_its_type_and_default() -> None:
    exposure = keys.table(ExposureConfig)
    survey = keys.table(SurveyErrorsConfig)
    assert (
        '| `time` | a time such as "40 ms" or "1000 us", ≥ 1e-06 s | required |' in exposure
    )
    assert "| `rate_hz` | number, > 0, ≤ 1e+06 | required |" in exposure
    assert (
        '| `led_sigma` | a length such as "35 mm" or "48 in" or LengthToleranceConfig | `0 m` |'
        in survey
    )
    assert "| `surface_seed` | whole number, ≥ 0, ≤ 1e+18 or null | `null` |" in survey


def test_every_generated_part_has_its_place_on_one_page() -> None:
    """And no page asks for another."""
    marked = [name for text in PAGES.values() for name in reference.MARKER.findall(text)]
    assert sorted(marked) == sorted(GENERATED)


@pytest.mark.parametrize("path", PAGES, ids=lambda path: path.stem)
def test_a_page_is_complete_once_its_parts_are_inserted(path: Path) -> None:
    names = reference.MARKER.findall(PAGES[path])
    complete = reference.insert_parts(PAGES[path])
    assert "<!--" not in complete
    assert [name for name in names if GENERATED[name] not in complete] == []


def test_links_of_generated_parts_lead_to_pages_and_headings() -> None:
    """The site's build would fail, but not before `make docs`."""
    for text in GENERATED.values():
        for page, anchor in re.findall(r"\]\(([\w/.]+\.md)(?:#([\w-]+))?\)", text):
            linked = (ROOT / "docs" / "reference" / page).read_text(encoding="utf-8")
            headings = re.findall(r"^#+ (.*)$", linked, re.MULTILINE)
            slugs = {
                re.sub(r"[^\w -]", "", title).lower().replace(" ", "-") for title in headings
            }
            assert not anchor or anchor in slugs


@pytest.mark.parametrize("name", ["scene_keys", "study_keys"])
def test_the_keys_link_to_their_sections_and_name_what_a_text_may_be(name: str) -> None:
    page = GENERATED[name]
    linked = set(re.findall(r"\]\(#(\w+)\)", page))
    headings = set(re.findall(r"^## (\w+)$", page, re.MULTILINE))
    assert len(linked) > 10
    assert linked <= {heading.lower() for heading in headings}
    assert re.findall(r".*\| (?:list of any length: )?text(?: or null)? \|.*", page) == []
    # Every section has a link.
    assert re.findall(r"^\| `\w+` \|.* (?!\[)\w+Config\b.*", page, re.MULTILINE) == []


def test_every_response_has_a_row_with_its_meaning() -> None:
    """Proportions, quantities and statistics that the code has, and no others; meanings of several lines are whole."""
    page = "\n".join(GENERATED[name] for name in ("proportions", "quantities", "statistics"))
    rows = [
        (set(re.findall(r"`(\w+)`", names)), text)
        for names, text in re.findall(r"^\| (`.*`) \| (.*) \|$", page, re.M)
    ]
    named = set().union(*(names for names, _ in rows))
    wanted = {
        *metrics.PROPORTIONS,
        "coverage_N",
        "right_within_cross_arcsec_10",
        "right_within_cross_arcsec_10_roll_arcsec_60",
        "cross_arcsec_over_60",
        *metrics.QUANTITIES,
        *(f"_{name}" for name in metrics.STATISTICS),
    }
    assert named == wanted
    assert min(len(text) for _, text in rows) > 15
    assert "ten arcminutes that the tracker's covariance allows |" in page


def test_names_that_a_key_allows_are_on_its_row() -> None:
    rows = dict(
        re.findall(r"^\| `(\w+)` \| (.*) \|.*\|$", GENERATED["scene_keys"], re.MULTILINE)
    )
    assert {"`sequential`", "`local`"} <= set(rows["detector"].split(", "))
    assert "`default`" in rows["identifier"]
    assert "`led_pairs`" in rows["identifier"]
    assert "`hipparcos_hp6.5`" in rows["catalog"]


@pytest.mark.browser
def test_the_site_s_search_needs_no_server(tmp_path: Path) -> None:
    """Chromium opens the site of `make docs` as a file, with a search in its address."""
    chromium = shutil.which("chromium")
    site = ROOT / "out" / "site" / "index.html"
    if chromium is None or not site.exists():
        pytest.skip("needs Chromium and the site of `make docs`")
    words = [
        "--headless",
        "--no-sandbox",
        "--disable-gpu",
        "--virtual-time-budget=10000",
        "--dump-dom",
    ]
    done = subprocess.run(
        [chromium, *words, f"--user-data-dir={tmp_path}", f"{site.as_uri()}?q=parallax"],
        capture_output=True,
        text=True,
        timeout=120,
    )
    assert re.search(r"md-search-result__meta\">[0-9]+ matching documents", done.stdout)


def test_every_make_target_named_by_a_page_exists() -> None:
    pages = [ROOT / "README.md", ROOT / "CONTRIBUTING.md", *(ROOT / "docs").rglob("*.md")]
    pages += (ROOT / ".github").rglob("*.md")
    named_targets = {
        name
        for path in pages
        for name in re.findall(
            r"(?:^|`)make ([a-z-]+)", path.read_text(encoding="utf-8"), re.MULTILINE
        )
    }
    makefile = (ROOT / "Makefile").read_text(encoding="utf-8")
    assert len(named_targets) >= 10
    assert named_targets <= set(re.findall(r"^([a-z-]+):", makefile, re.MULTILINE))


@pytest.mark.parametrize("name", ["run", "weekly"])
def test_every_make_target_of_ci_exists(name: str) -> None:
    """The scripts parse in bash and are executable; CONTRIBUTING names them and the parts of the weekly one."""
    script = ROOT / ".ci" / name
    subprocess.run(["bash", "-n", script], check=True)
    assert os.access(script, os.X_OK)
    text = script.read_text(encoding="utf-8")
    targets, parts = (
        re.findall(rf"^{head}make ([a-z-]+)", text, re.MULTILINE)
        for head in ("", r"part \w+ ")
    )
    assert len(targets) + len(parts) >= 4
    assert {*targets, *parts} <= set(
        re.findall(r"^([a-z-]+):", (ROOT / "Makefile").read_text(), re.MULTILINE)
    )
    pages = (ROOT / "CONTRIBUTING.md").read_text(encoding="utf-8")
    assert [
        one
        for one in (f".ci/{name}", *(f"make {one}" for one in parts))
        if f"`{one}" not in pages
    ] == []


def test_the_weekly_script_runs_every_part_and_reports_failures(tmp_path: Path) -> None:
    """With a `make` that fails at the oracles."""
    (tmp_path / ".ci").mkdir()
    weekly = shutil.copy(ROOT / ".ci/weekly", tmp_path / ".ci/weekly")
    (tmp_path / "make").write_text('#!/bin/sh\necho "did $*"\n[ "$1" != oracle ]\n')
    (tmp_path / "make").chmod(0o755)
    path = f"{tmp_path}:{os.environ['PATH']}"
    done = subprocess.run(
        [weekly], env={"PATH": path, "FUZZ_S": "5"}, capture_output=True, text=True
    )
    assert done.returncode == 1
    lines = done.stdout.splitlines()
    assert [line.split(" ")[0] for line in lines] == [
        "long:",
        "oracle:",
        "did",
        "lowest:",
        "fuzz:",
        "failed:",
    ]
    assert lines[-2].endswith("did fuzz FUZZ_S=5")
    assert lines[-1] == "failed: oracle"
