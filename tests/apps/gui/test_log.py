"""The log of identifications with and without camera noise."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest
from astropy.io import fits
from astropy.table import Table

from tests.helpers.labpage import (
    CHROMIUM,
    angles,
    changed,
    exported,
    onto_the_page,
    panel,
    source,
    status,
)

pytest.importorskip("nicegui", reason="the extra `gui` is not installed")

from skysim.apps.gui.page import readouts
from skysim.apps.gui.views import forms
from skysim.apps.gui.views.widgets import csv_table
from skysim.apps.gui.worker.tasks import Worker
from skysim.core.errors import InputError
from skysim.scene import loader

pytest_plugins = ["tests.helpers.labpage"]


@pytest.mark.slow
def test_the_log_has_attitude_and_error_and_the_noise_keeps_the_attitude() -> None:
    worker = Worker()
    info, view = worker.open("shefex2", {}, True, (40.0, 10.0, 5.0))
    assert view.result is not None
    line, row = readouts.identification(view, info)
    assert "identify with noise: solved" in line
    assert f"error {view.result.row.cross_arcsec:.2f}″ across" in line
    one = dict(zip(readouts.COLUMNS, row, strict=True))
    np.testing.assert_allclose(
        [float(one[f"true_{n}_deg"]) for n in (1, 2, 3)], (40, 10, 5), rtol=0, atol=1e-6
    )
    assert float(one["cross_arcsec"]) == pytest.approx(view.result.row.cross_arcsec, rel=1e-8)
    info, view = worker.open("shefex2", {"camera.detector.noise": "false"}, True)
    np.testing.assert_allclose(view.angles_deg, (40, 10, 5), rtol=0, atol=1e-9)
    assert not info.noise
    assert "without noise" in readouts.identification(view, info)[0]
    assert worker.workbench.frame is not None
    first = worker.workbench.frame.image_dn
    worker.render(False)
    np.testing.assert_array_equal(worker.workbench.frame.image_dn, first)


def test_a_csv_file_reads_back_with_commas_and_unknown_values() -> None:
    rows = [("solved, but late", 1 / 3, True, None), ('a "b"', float("nan"), False, 12)]
    table = Table.read(
        csv_table(("text", "value", "flag", "count"), rows).decode(), format="ascii.csv"
    )
    assert list(table["text"]) == ["solved, but late", 'a "b"']
    assert table["value"][0] == pytest.approx(1 / 3, rel=1e-9)
    assert table["value"].mask.tolist() == [False, True]
    assert list(table["flag"]) == ["True", "False"]
    assert table["count"].mask.tolist() == [True, False]


def test_a_field_of_view_sets_the_focal_length() -> None:
    changes = forms.field_override("shefex2", {}, 20.0)
    camera = loader.load("shefex2", changes).camera
    assert 2 * np.degrees(np.arctan(camera.width_px / 2 / camera.focal_px)) == pytest.approx(
        20.0, abs=1e-3
    )
    with pytest.raises(InputError, match=r"field: allowed: 0\.5 to 120"):
        forms.field_override("shefex2", {}, 200.0)


@pytest.mark.browser
@pytest.mark.skipif(not CHROMIUM, reason="Chromium is not installed")
def test_key_1_identifies_with_and_without_noise(page: Any, tmp_path: Path) -> None:
    """Without noise every frame of an attitude is the same; the noisy ones scatter about it."""

    def frames() -> list[np.ndarray]:
        found = []
        for _ in range(2):
            frame = source(page)
            page.keyboard.press("1")
            changed(page, frame)
            found.append(fits.getdata(exported(page, "frame, FITS", tmp_path)).astype(float))
            onto_the_page(page)
        return found

    before = angles(page)
    noisy = frames()
    frame = source(page)
    page.keyboard.press("n")
    changed(page, frame)
    np.testing.assert_allclose(angles(page), before, rtol=0, atol=1e-4)
    exact, again = frames()
    np.testing.assert_array_equal(exact, again)
    assert status(page, "solved")
    sky = exact < np.quantile(exact, 0.5)
    for image in noisy:
        scatter_dn = np.std(image[sky] - exact[sky])
        assert 0.5 < scatter_dn < 5
        assert abs(np.mean(image[sky] - exact[sky])) < 5 * scatter_dn / np.sqrt(sky.sum())
    assert np.any(noisy[0] != noisy[1])
    panel(page, "Log")
    page.get_by_text("identify without noise: solved").first.wait_for()
    with page.expect_download() as comes:
        page.get_by_role("button", name="CSV of the identifications").click()
    table = Table.read(comes.value.path(), format="ascii.csv")
    assert list(table["noise"]) == ["True", "True", "False", "False"]
    np.testing.assert_allclose(
        [table[f"true_{n}_deg"][-1] for n in (1, 2, 3)], before, rtol=0, atol=1e-4
    )
    assert max(table["cross_arcsec"]) < 60
    # A reload keeps the log and its table.
    page.reload()
    status(page, "solved")
    panel(page, "Log")
    assert page.locator(".lab-log").inner_text().count("identify with") == 4
    with page.expect_download() as comes:
        page.get_by_role("button", name="CSV of the identifications").click()
    assert len(Table.read(comes.value.path(), format="ascii.csv")) == len(table)
    onto_the_page(page)
    frame = source(page)
    page.keyboard.press("n")
    changed(page, frame)
