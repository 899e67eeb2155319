"""The histogram's electrons against the full well, and the brightest pixel of each light."""

from __future__ import annotations

import re
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from astropy.io import fits
from astropy.table import Table

from tests.helpers.labpage import (
    CHROMIUM,
    NARROW,
    Server,
    come,
    exported,
    open_scene,
    opened,
    panel,
    pictured,
    screen,
)

pytest.importorskip("nicegui", reason="the extra `gui` is not installed")

from skysim.scene import loader

pytest_plugins = ["tests.helpers.labpage"]
in_browser = pytest.mark.skipif(not CHROMIUM, reason="Chromium is not installed")


@pytest.mark.browser
@in_browser
@pytest.mark.parametrize("name", ["shefex2", "afit_simsat"])
def test_the_brightest_light_is_compared_with_the_full_well(
    browser: Any, server: Server, tmp_path: Path, name: str
) -> None:
    detector = loader.load(name).camera.detector
    with opened(browser, server.login, NARROW) as page:
        plot = page.locator(".lab-plot")
        if name != "shefex2":
            before = plot.get_attribute("aria-label")
            open_scene(page, name)
            # The plot follows the picture.
            assert come(lambda: plot.get_attribute("aria-label") != before)
        told = re.compile(r"brightest pixel of (\d+) lights (\d+) of (\d+) electrons")
        assert come(lambda: told.search(str(plot.get_attribute("aria-label"))) is not None)
        count, most, full = map(int, told.search(plot.get_attribute("aria-label")).groups())
        image = fits.getdata(exported(page, "frame, FITS", tmp_path))
        top_e = detector.gain_e_dn * (float(image.max()) - detector.offset_dn)
        assert most == pytest.approx(top_e, abs=1)
        assert full == detector.full_well_e
        assert count > 5
        # The value under the cursor in electrons.
        row, column = np.unravel_index(np.argmax(image), image.shape)
        pictured(page, f"exposure_{name}")
        page.mouse.move(*screen(page, float(column), float(image.shape[0] - 1 - row)))
        share = f"{100 * top_e / detector.full_well_e:.0f} %"
        page.mouse.move(*screen(page, float(column), float(row)))
        readout = page.locator(".lab-readout span")
        assert come(lambda: share in readout.inner_text() or "DN" in readout.inner_text())
        assert " e⁻ " in readout.inner_text()


@pytest.mark.browser
@in_browser
@pytest.mark.parametrize("name", ["shefex2", "afit_simsat"])
def test_each_light_s_peak_is_that_of_the_exported_truth(
    browser: Any, server: Server, tmp_path: Path, name: str
) -> None:
    """The table's share of the full well, and which lights are saturated, from the file's columns."""
    full_well_e = loader.load(name).camera.detector.full_well_e
    with opened(browser, server.login, NARROW) as page:
        if name != "shefex2":
            open_scene(page, name)
        panel(page, "Lights")
        row = page.locator(".lab-lights:visible tbody tr").first
        prefix = "LED" if name == "afit_simsat" else ""
        assert come(lambda: row.count() == 1 and row.inner_text().startswith(prefix))
        page.wait_for_timeout(800)
        cells = {
            int(one.get_attribute("data-id")): one.locator("td").all_inner_texts()
            for one in page.locator(".lab-lights:visible tbody tr").all()
        }
        truth = Table.read(exported(page, "truth", tmp_path), format="ascii.ecsv")
        found = [line for line in truth if line["id"] in cells]
        assert len(found) > 5
        for line in found:
            peak, share = cells[line["id"]][3:5]
            number, _, unit = peak.partition(" ")
            peak_e = float(number) * {"": 1, "k": 1e3, "M": 1e6}[unit]
            assert peak_e == pytest.approx(line["peak_e"], rel=5.1e-3, abs=0.51)
            assert (share == "full") == line["saturated"]
            if not line["saturated"]:
                percent = 100 * line["peak_e"] / full_well_e
                assert float(share.removesuffix(" %")) == pytest.approx(percent, abs=0.51)
        pictured(page, f"lights_{name}")
