"""Every command of docs/howto/study.md runs, in its order, in one folder; its study is one."""

from pathlib import Path

import pytest

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
