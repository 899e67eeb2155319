"""Every command of docs/howto/study.md runs, in its order, in one folder; its study is one."""

import re
from pathlib import Path
from typing import Any

import pytest

from skysim.core.paths import ROOT
from tests.helpers import doc_pages as pages

PAGE = "docs/howto/study.md"
pytestmark = pytest.mark.long  # every command of the page, each in a process of its own


@pytest.fixture(scope="module")
def folder(tmp_path_factory) -> Path:
    """A folder that looks like the checkout, where every command of the page has been run."""
    folder = pages.checkout(tmp_path_factory.mktemp("study"))
    pages.run_commands(PAGE, folder)
    return folder


def test_the_commands_leave_a_report_and_a_table(folder):
    assert (folder / "out" / "led_count" / "report.html").is_file()
    assert (folder / "out" / "led_count.csv").is_file()


def test_the_study_block_loads_as_a_study(folder):
    path = folder / "lens.yaml"
    path.write_text(pages.yaml_block(PAGE, "trial"))
    report = pages.answer(
        folder, "study", "run", str(path), "--engine", "serial", "--set", "replicates=2"
    )
    assert (report["done"], report["failed"], report["wrong"]) == (4 * 2 * 2 * 2, 0, 0)
    assert (folder / "out" / "lens" / "report.html").is_file()


def test_the_python_blocks_run_in_order(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    session: dict[str, Any] = {}
    page = (ROOT / PAGE).read_text("utf-8")
    for block in re.findall(r"^```python\n(.*?)^```$", page, re.DOTALL | re.MULTILINE):
        exec(compile(block, PAGE, "exec"), session)
    assert list(session["result"].table()["refused"]) == [0, 1]
    assert (tmp_path / "out" / "pyramid" / "pyramid.yaml").is_file()
