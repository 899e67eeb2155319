"""The program that writes the pages of the studies, on a study that was run."""

from __future__ import annotations

import importlib.util
import sys
from pathlib import Path
from typing import Any

import pytest

from skysim.core.paths import ROOT
from skysim.experiments.study import api


@pytest.fixture
def pages(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Any:
    """The program, which writes to a folder of its own."""
    path = ROOT / "docs/site/studies.py"
    spec = importlib.util.spec_from_file_location("study_pages", path)
    assert spec is not None
    assert spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    monkeypatch.setattr(sys, "path", [str(path.parent), *sys.path])
    # A data class looks its module up.
    monkeypatch.setitem(sys.modules, "study_pages", module)
    spec.loader.exec_module(module)
    monkeypatch.setattr(module, "PAGES", tmp_path)
    return module


@pytest.mark.slow
def test_a_page_has_the_numbers_of_its_study(pages: Any, tmp_path: Path) -> None:
    fewer = {
        "replicates": 5,
        "factors.tilt_deg.values": "[0, 30]",
        "factors.leds.values": "[900, 3000]",
    }
    ran = api.run_study("dome_shape", fewer, out=tmp_path, workers=1)
    with pages.store.open_store(ran.path) as kept:
        record = pages.read_record(ran.plan, kept)
    page = pages.write_page(record, pages.make_stamp(["skysim.core"], 1)).read_text("utf-8")
    assert (tmp_path / "dome_shape_3.png").is_file()
    assert len(record.rows) == len(ran.plan.points)
    place = {"solver": "thesis", "dome": "flat", "leds": "900", "tilt_deg": "30"}
    (row,) = (one for one in record.rows if one.items() >= place.items())
    error_arcsec = pages.number_text(row["cross_arcsec_rms"], share=False, interval=False)
    assert f"by {error_arcsec}″ under a flat panel" in page
    assert error_arcsec in page.partition("| thesis |")[2].partition("\n")[0]
