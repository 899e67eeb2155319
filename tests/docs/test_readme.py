"""The README's blocks run, its links have targets, and its table of changes names existing files."""

import re
import subprocess
import sys
from pathlib import Path

import pytest

import skysim
from skysim.core.paths import ROOT
from tests.helpers import doc_pages as pages

README = "README.md"
ARCHITECTURE = "docs/reference/architecture.md"


@pytest.fixture(scope="module")
def folder(tmp_path_factory) -> Path:
    """A folder that looks like the checkout, where every command of the README has been run."""
    folder = pages.checkout(tmp_path_factory.mktemp("readme"))
    pages.run_commands(README, folder)
    return folder


def test_the_readme_is_short():
    assert len(pages.text(README).splitlines()) <= 65


@pytest.mark.long
def test_the_commands_leave_a_report_and_a_solution(folder):
    left = {path.name for path in (folder / "out" / "shefex2").iterdir()}
    assert {"report.html", "annotated.png", "frame_0004.fits"} <= left


@pytest.mark.slow
def test_the_python_block_solves_the_frame_that_it_saves(folder):
    (block,) = pages.blocks(README, "python")
    done = subprocess.run(
        [sys.executable, "-c", block], cwd=folder, capture_output=True, text=True
    )
    assert done.returncode == 0, done.stderr
    status, error, *_ = done.stdout.split()
    assert status == "solved"
    assert done.stdout.splitlines()[-2] == "solved"  # from centroids
    assert float(error) < 60
    # scenes/shefex2.yaml starts at (83, 2, 20) and turns by 0.06 deg before the middle of its first exposure.
    assert float(done.stdout.split()[-1]) == pytest.approx(83.0, abs=0.08)


def test_every_public_name_is_on_the_page_of_the_python_api():
    page = pages.text("docs/reference/python.md")
    assert [name for name in skysim.__all__ if f"`skysim.{name}" not in page] == []


@pytest.mark.parametrize("page", [README, ARCHITECTURE])
def test_every_link_has_an_existing_target(page):
    assert pages.missing_links(page) == []


def test_every_name_in_the_table_of_changes_is_in_its_file():
    """`NAME` in [`file`](file): ten seconds to find it."""
    rows = re.findall(r"\| ((?:`\w+`(?:, )?)+) in (.*) \|", pages.text(ARCHITECTURE))
    assert len(rows) >= 8
    for names, places in rows:
        paths = [
            (ROOT / ARCHITECTURE).parent / path
            for path in re.findall(r"\]\(([^)]+)\)", places)
        ]
        text = "".join(path.read_text(encoding="utf-8") for path in paths if path.is_file())
        assert [name for name in re.findall(r"`(\w+)`", names) if name not in text] == []


def test_every_package_is_in_the_table_of_packages():
    page = pages.text(ARCHITECTURE)
    packages = [
        path
        for root in ("skysim", "estimator")
        for path in sorted((ROOT / root).glob("*/__init__.py"))
    ]
    names = [path.parent.relative_to(ROOT).as_posix() for path in packages]
    assert [name for name in names if f"[`{name}`](../../{name})" not in page] == []
