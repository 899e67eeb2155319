"""The notebooks of docs/notebooks: every code cell runs, and the stored copy was executed."""

import json

import matplotlib
import pytest

from skysim.core.paths import ROOT

NOTEBOOKS = sorted((ROOT / "docs/notebooks").glob("*.ipynb"))


def cells(path) -> list[dict]:
    return [
        cell
        for cell in json.loads(path.read_text(encoding="utf-8"))["cells"]
        if cell["cell_type"] == "code"
    ]


def test_two_notebooks_are_shipped() -> None:
    assert [path.stem for path in NOTEBOOKS] == ["error_budget", "own_tracker"]


@pytest.mark.long
@pytest.mark.parametrize("path", NOTEBOOKS, ids=lambda path: path.stem)
def test_every_cell_of_a_notebook_runs(path, monkeypatch) -> None:
    monkeypatch.setattr(matplotlib, "rcParams", matplotlib.rcParams.copy())
    matplotlib.use("agg")
    names: dict = {}
    for cell in cells(path):
        exec(compile("".join(cell["source"]), path.name, "exec"), names)
    if path.stem == "own_tracker":  # its own centroids lead to the true attitude
        assert names["error"].magnitude() < 1e-3


@pytest.mark.parametrize("path", NOTEBOOKS, ids=lambda path: path.stem)
def test_the_stored_copy_was_executed(path) -> None:
    counts = [cell["execution_count"] for cell in cells(path)]
    assert counts == list(range(1, len(counts) + 1))
    assert any(cell["outputs"] for cell in cells(path))
